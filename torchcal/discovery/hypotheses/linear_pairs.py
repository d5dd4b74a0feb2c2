"""Pairs of candidates in the tangent space of the base: which explain most together, and where their refits begin."""

import itertools

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate
from torchcal.discovery.hypotheses.beginnings import make_up
from torchcal.discovery.hypotheses.search import Search

__all__ = ["linear_pairs", "linear_row"]

#: Correlation of two tangents from which on they are one.
NEARLY_SAME = 0.999


def linear_pairs(search: Search, most: int) -> list[tuple[int, int]]:
    """Columns of two candidates, each at any of its shapes, that explain most together; the best of each two."""
    screening = search.screening
    sided = []  # columns of every candidate, and the sides to which they may act
    for i, candidate in enumerate(search.candidates):
        columns = screening.usable(i)
        if len(columns) and i not in search.gone:
            sided.append((columns, torch.tensor([candidate.one_sided(search.amplitude(int(k))) for k in columns])))
    found = [_best_pair(search, *first, *second) for first, second in itertools.combinations(sided, 2)]
    return [pair for gain, pair in sorted(found, key=lambda one: -one[0])[:most] if gain > 0]


def _best_pair(
    search: Search, first: Tensor, side: Tensor, second: Tensor, other_side: Tensor
) -> tuple[float, tuple[int, int]]:
    """What the best pair of two sets of columns explains together, with signs that physics allows, and the pair."""
    screening = search.screening
    a, b = screening.columns[:, first], screening.columns[:, second]
    za, zb, c = (a.T @ search.residual.e)[:, None], b.T @ search.residual.e, a.T @ b
    rest = (1 - c.square()).clamp_min(1e-6)
    gain = (za.square() + zb.square() - 2 * c * za * zb) / rest
    allowed = (side[:, None] * (za - c * zb) >= 0) & (other_side * (zb - c * za) >= 0) & (c.abs() < NEARLY_SAME)
    gain = torch.where(allowed, gain, torch.zeros_like(gain))
    best = int(gain.argmax())
    one, other = divmod(best, len(second))
    return float(gain[one, other]), (int(first[one]), int(second[other]))


def linear_row(search: Search, candidate: Candidate, columns: tuple[int, int]) -> Tensor:
    """Starting values of a pair: the linear estimate at the shapes of two columns, the base moved to make up for it."""
    screening = search.screening
    pair = screening.columns[:, list(columns)]
    sizes = torch.linalg.lstsq(pair, search.residual.e[:, None], driver="gelsd").solution[:, 0]
    sizes = sizes / screening.norm[list(columns)]
    names = [q.name for q in candidate.problem.parameters]
    row = candidate.begin.clone()
    effect = torch.zeros(search.base.problem.n, dtype=torch.float64)
    for column, size in zip(columns, sizes, strict=True):
        single = search.candidates[int(screening.owner[column])]
        g, place = int(screening.shape[column]), search.amplitude(column)
        for i, value in zip(single.own, single.shapes[g].tolist(), strict=True):
            row[names.index(single.problem.parameters[i].name)] = value
        row[names.index(single.problem.parameters[place].name)] += float(size)
        effect += size * single.tangents[g, :, int(screening.amplitude[column])]
    return make_up(search.base, candidate, row, effect)
