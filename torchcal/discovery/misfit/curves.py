"""Smooth curves over the data of a sequence: what physics may do that is slow against the sampling."""

import math

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem

__all__ = ["beyond", "orthonormal", "smooth_columns", "spread"]

#: Share of a sequence's degrees of freedom that smooth curves may take, and how many they are at most.
SMOOTH_SHARE, MOST_CURVES = 1.0 / 6.0, 256
#: Levels of a condition up to which they are no row; the ratio of the last to the first from which on a geometric one
#: is uneven; and how much unlike its steps may be in logarithms, as those of 1, 2, 5, 10 are.
FEW, WIDE, EVENLY = 4, 10.0, 1.5
#: Share of the gaps beside it from which on neighbours in time are a step of their ranks apart: no curve tells closer
#: ones.
CLOSE = 0.1


def smooth_columns(problem: Problem, places: Tensor, *, ends: bool = False, ranks: bool = False) -> Tensor:
    """Smooth curves over one sequence, ``(len(places), m)``, m about a sixth of its length and 256 at most.

    Cosines are flat at both ends; with ``ends`` come two powers that are not. With ``ranks`` geometric rows of one of
    several conditions count as even: no curve is bound to the last of them, but not all that is smooth is smooth then.
    """
    n = len(places)
    count = min(int(n * SMOOTH_SHARE), MOST_CURVES)
    if problem.order is not None:
        at = problem.order[problem.condition_of[places]]
        gaps, span = at.diff(), float(at.max() - at.min())
        # Equal steps where sampling is even; ranks where it is not, so that curves bend where there are data.
        uneven = float(gaps.max()) > 3 * float(gaps.median()) if n > 2 else False
        along = (at - at.min()) / span if span > 0 else torch.linspace(0, 1, n, dtype=torch.float64)
        if uneven:
            # Of the gaps beside it, so that those of a geometric row are ranks.
            beside = torch.maximum(torch.cat([gaps[1:], gaps[-2:-1]]), torch.cat([gaps[1:2], gaps[:-1]])) * CLOSE
            ordered = float(gaps.min()) >= 0
            steps = (gaps / beside.clamp_min(1e-300)).clamp_max(1.0) if ordered else torch.ones_like(gaps)
            along = torch.cat([steps.new_zeros(1), steps.cumsum(0)]) / steps.sum()
        waves = torch.cos(math.pi * along[:, None] * torch.arange(count, dtype=torch.float64))
        return torch.cat([waves, along[:, None], along[:, None].square()], dim=1) if ends else waves
    given = problem.recording.columns[problem.condition_of[places]].unbind(-1)
    columns = torch.stack([spread(column) if ranks else column for column in given], dim=-1)
    columns = (columns - columns.mean(0)) / columns.std(0).clamp_min(1e-300)
    powers = [torch.ones(n, 1, dtype=torch.float64)]
    for _ in range(6):
        if sum(p.shape[1] for p in powers) >= count:
            break
        last = powers[-1]
        powers.append((last[:, :, None] * columns[:, None]).flatten(1))
    design = torch.cat(powers, dim=1)
    u, s, _ = torch.linalg.svd(design, full_matrices=False)
    return u[:, : min(count, int((s > 1e-9 * s[0]).sum()))]


def spread(column: Tensor) -> Tensor:
    """A condition, or the ranks of its levels where these are in a geometric row, whose last ones bind any curve."""
    levels, rank = column.unique(return_inverse=True)
    if len(levels) <= FEW or not float(levels[0]) > 0 or float(levels[-1]) < WIDE * float(levels[0]):
        return column
    steps = levels.double().log().diff()
    return rank.double() if float(steps.max()) < EVENLY * float(steps.min()) else column


def beyond(problem: Problem, places: Tensor, design: Tensor, unit: Tensor, *, ends: bool = False) -> Tensor:
    """Orthonormal directions of one sequence that noise is looked for beyond, ``(len(places), m)``: smooth curves and
    tangents, both in units of the noise.

    What is smooth is not so in these units: where they are a share of what was read, a constant and a tangent of the
    output would take up all noise.
    """
    each = unit[problem.index[places]][:, None]
    own, smooth = design[places] / each, smooth_columns(problem, places, ends=ends) / each
    share = max(int(len(places) * SMOOTH_SHARE), min(design.shape[1], len(places) // 2))
    wide = torch.cat([smooth, orthonormal(own, most=share)], dim=1)
    return orthonormal(wide, most=int(0.6 * len(places)))


def orthonormal(columns: Tensor, *, most: int | None = None, cut: float = 1e-8) -> Tensor:
    """Orthonormal directions that columns ``(n, m)`` span, the strongest first.

    Args:
        columns: Of any lengths; those of length zero are left out.
        most: How many directions at most.
        cut: Share of the largest singular value, with columns of unit length, up to which there is no direction.
    """
    size = columns.norm(dim=0)
    columns = columns[:, size > 0] / size[size > 0]
    if columns.shape[1] == 0:
        return columns
    u, s, _ = torch.linalg.svd(columns, full_matrices=False)
    return u[:, s > cut * s[0]][:, :most]
