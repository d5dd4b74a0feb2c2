"""What was set aside as outliers and may be none, in words."""

import dataclasses

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.trial import place_of
from torchcal.discovery.misfit.outliers import chance_of_pairs

__all__ = ["side_by_side"]

#: Probability by chance of as many outliers side by side, on the same side, below which they are told.
CHANCE = 0.1
#: Rows on end that were all set aside, at least, to be told; and probability by chance below which they are.
ON_END, SELDOM = 3, 0.01


def side_by_side(problem: Problem, off: Tensor, aside: Tensor) -> list[str]:
    """Outliers that are neighbours, and on the same side, where that is hardly chance (`chance_of_pairs`), or no others
    tell that this recording has any: two of few data are easily neighbours, however far they are off.

    Neighbours are those in time, along the only condition, or along one of several where the others are the same. Rows
    on end come first, as of a sweep that is off as a whole.

    Args:
        problem: The used data.
        off: How far all data are off the fit that the verdict rests on, in noise sd, ``(n_total,)``.
        aside: Which of them were set aside, bool ``(n_total,)``.
    """
    if int(aside.sum()) < 2:
        return []
    problem = dataclasses.replace(problem, keep=problem.keep | aside)
    far, out = off[problem.index], aside[problem.index]
    told, together = _on_end(problem, far, out)
    out &= ~together
    curves = _curves(problem)
    pairs = [pair for places, at in curves for pair in _pairs(places, far, out, at)]
    if not pairs:
        return told
    above, below = (int((out & (far * sign > 0)).sum()) for sign in (1, -1))
    # 1 of data in one row; replicates are no neighbours.
    ways = sum(int((at[places].diff() != 0).sum()) for places, at in curves) / max(problem.n - 1, 1)
    chance = chance_of_pairs(len(pairs), above, below, problem.n, ways)
    others = int(aside.sum()) > len({k for pair in pairs for k in pair})
    if chance >= CHANCE and others:
        return told
    first, second = max(pairs, key=lambda pair: float(far[list(pair)].abs().min()))
    alone = ", and there are no others" if int(aside.sum()) == 2 else ""
    return [
        *told,
        f"two that were set aside as outliers are neighbours, {place_of(problem, first)} and "
        f"{place_of(problem, second)}, off by {float(far[first]):+.1f} and {float(far[second]):+.1f} noise sd: "
        f"outliers are so by chance with a probability of {chance:.2g}{alone}. Something short may act there; repeat "
        "them, or record more densely there"
    ]


def _on_end(problem: Problem, far: Tensor, out: Tensor) -> tuple[list[str], Tensor]:
    """Rows of a table that were all set aside, one after the other and on the same side, where that is no chance; and
    which data these are, bool ``(n,)``. Of a table in the order of its only condition they are neighbours."""
    told, together = list[str](), torch.zeros_like(out)
    steps = None if problem.order is None else problem.order.diff()
    if problem.in_time or (steps is not None and bool((steps >= 0).all() | (steps <= 0).all())):
        return told, together
    sign = torch.where(out, far.sign(), 0.0)
    for number, name in enumerate(problem.recording.outputs):
        mine = (problem.output_of == number).nonzero()[:, 0]
        sides, counts = sign[mine].unique_consecutive(return_counts=True)
        lengths = counts.where(sides != 0, 0)
        size = int(lengths.max()) if len(mine) else 0
        if size < ON_END or len(mine) * float((sign[mine] != 0).double().mean()) ** size >= SELDOM:
            continue
        rows = mine[int(counts[: int(lengths.argmax())].sum()) :][:size]
        first, last = (int(problem.condition_of[rows[k]]) + 1 for k in (0, -1))
        of = f" of {name}" if len(problem.recording.outputs) > 1 else ""
        together[rows] = True
        told.append(
            f"all data{of} in rows {first} to {last}, {size} of them, were set aside as outliers, all on one side, by "
            f"{float(far[rows].mean()):+.1f} noise sd on average: what these rows have in common, as a sweep, a day or "
            "a sample, is off as a whole. If that is no mistake, give a condition that says so, and let a parameter or "
            "an offset differ with it"
        )
    return told, together


def _curves(problem: Problem) -> list[tuple[Tensor, Tensor]]:
    """Places among the used data that follow each other, with what they follow each other in at every used datum."""
    if problem.order is not None:
        return [(places, problem.order[problem.condition_of]) for places in problem.sequences]
    columns, found = problem.recording.columns[problem.condition_of], []
    for k in range(columns.shape[1]):
        others = torch.cat([problem.output_of[:, None].double(), columns[:, :k], columns[:, k + 1 :]], dim=1)
        curve = others.unique(dim=0, return_inverse=True)[1]
        along = columns[:, k].argsort(stable=True)
        along = along[curve[along].argsort(stable=True)]  # curve by curve
        found += [(each, columns[:, k]) for each in along.split(torch.bincount(curve).tolist()) if len(each) > 1]
    return found


def _pairs(places: Tensor, far: Tensor, out: Tensor, at: Tensor) -> list[tuple[int, int]]:
    """Neighbours in a sequence, and no replicates, that are both out, on the same side."""
    one, other = places[:-1], places[1:]
    both = out[one] & out[other] & (far[one] * far[other] > 0) & (at[one] != at[other])
    return list(zip(one[both].tolist(), other[both].tolist(), strict=True))
