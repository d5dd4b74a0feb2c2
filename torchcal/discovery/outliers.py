"""Data that are no noise of the rest: single samples far from their neighbours, or from a model that explains these."""

import math

import torch
from torch import Tensor

from torchcal.discovery.noise import smooth_columns
from torchcal.discovery.problem import Problem

__all__ = ["lone", "spikes"]

#: A sample that leaves its neighbours' range by more than this many robust sd, alone or with one beside it, is one.
SPIKE = 4.5
#: Robust sd from which on a residual of a model that explains the rest is an outlier, where its neighbours' are not
#: half as large that way.
LONE = 4.5
#: By how many times the bend behind it a first or last sample must be off to be an outlier.
BENT = 10.0
#: Share of supposed outliers with another one as nearest neighbour above which they are no outliers.
TOGETHER = 0.4
#: Probability of as many of them at one value of a condition by chance, below which they are no outliers.
CHANCE = 0.1


def spikes(problem: Problem, residual: Tensor, sd: Tensor | None) -> Tensor:
    """Used data that stick out alone from their neighbours, bool ``(n,)``.

    Along one order they are compared with two neighbours on either side. Among several conditions the
    residual of a robust smooth fit takes its place.
    """
    found = torch.zeros(problem.n, dtype=torch.bool)
    for places in problem.sequences:
        if len(places) < 10:
            continue
        r = residual[places]
        if sd is not None:
            r = r / sd[problem.index[places]]
        if problem.order is None:
            left, scale = _robust_left(smooth_columns(problem, places), r)
            high, far = (_high(values, sd is not None) for values in (left, left / scale))
            found[places] = high & far if not _clustered(problem, places, high) else False
            continue
        off = _off_neighbours(r)
        bend = r[1:-1] - 0.5 * (r[:-2] + r[2:])  # a curve leaves its neighbours' range nowhere, but bends everywhere
        robust = math.sqrt(1.3 / 1.5) * 1.4826 * float(bend.abs().median())
        if sd is not None:
            robust = max(robust, math.sqrt(1.3))  # what white noise gives
        if robust > 0:
            found[places] = _alone(r, _with_ends(r, off, SPIKE * robust), SPIKE * robust)
    return found


def lone(problem: Problem, residual: Tensor, sd: Tensor | None, ends: bool = False) -> Tensor:
    """Used data that a model that explains the others misses by far, bool ``(n,)``.

    In an order their neighbours must not be half as far off that way, and the ends are not judged unless that is
    wanted: a quick beginning is physics as likely as not. Among several conditions they must not be together.
    """
    found = torch.zeros(problem.n, dtype=torch.bool)
    for places in problem.sequences:
        if len(places) < 10:
            continue
        r = residual[places]
        size = (1.4826 * r.abs().median()).expand(len(r))
        if sd is not None:
            size = size.maximum(sd[problem.index[places]])
        far = (r.abs() > LONE * size) & (size > 0)
        if problem.order is None:
            worst = far & (r.abs() >= 0.5 * r.abs().max())
            far = worst if int(worst.sum()) == 1 else far  # it draws the fit off those around it
            found[places] = far & (not _clustered(problem, places, far))
            continue
        beside = torch.full_like(r, -math.inf)
        beside[1:] = r[:-1] * r[1:].sign()
        beside[:-1] = torch.maximum(beside[:-1], r[1:] * r[:-1].sign())
        if not ends:
            far[[0, -1]] = False
        found[places] = far & (beside < 0.5 * r.abs())
    return found


def _off_neighbours(r: Tensor) -> Tensor:
    """By how much samples ``(m,)`` leave the range of the two middle ones of their four neighbours.

    Beside two spikes that range reaches from the other samples to the spikes, so that these alone leave it.
    """
    padded = torch.cat([r[:1].expand(2), r, r[-1:].expand(2)])
    around = torch.stack([padded[k : k + len(r)] for k in (0, 1, 3, 4)]).sort(0).values
    off: Tensor = r - torch.maximum(torch.minimum(r, around[2]), around[1])
    return off


def _with_ends(r: Tensor, off: Tensor, least: float) -> Tensor:
    """The same with both ends measured from a line through the next four.

    Scaled to vary as much as the others do by noise alone; 0 where one of the four is off itself, by more than
    ``least``, or where they bend: a parabola with their bend b would end 3.4 b off the line, and a decay more.
    """
    off = off.clone()
    for end, next_ in ((0, r[1:5]), (-1, r[-5:-1].flip(0))):
        beside = off[1:5] if end == 0 else off[-5:-1]
        near, far = next_[:2].mean(), next_[2:].mean()
        here = float((r[end] - near - 0.75 * (near - far)) * math.sqrt(1.3 / 2.8))
        bend = float((next_[1] + next_[2] - next_[0] - next_[3]).abs()) / 4
        plain = abs(here) > BENT * bend and not bool((beside.abs() > least).any())
        off[end] = here if plain else 0.0
    return off


def _alone(r: Tensor, off: Tensor, least: float) -> Tensor:
    """Which differences from neighbours are at least so large, singly or two together, bool ``(m,)``.

    Those beside the top of a curve are nearly as large as at its top; those beside a spike are not. Before and behind a
    step the values differ; before and behind a spike they do not.
    """
    high = (off.abs() > least).tolist()
    size = [*off.abs().tolist(), 0.0]
    found = torch.zeros(len(off), dtype=torch.bool)
    k = 0
    while k < len(high):
        end = k
        while end < len(high) and high[end]:
            end += 1
        if 0 < end - k <= 2:
            inside = 0 < k and end < len(high)
            step = abs(float(r[max(k - 3, 0) : k].median() - r[end : end + 3].median())) if inside else 0.0
            found[k:end] = max(size[k - 1] if k else 0.0, size[end], step) < 0.5 * max(size[k:end])
        k = end + 1
    return found


def _clustered(problem: Problem, places: Tensor, high: Tensor) -> bool:
    """Whether data that stick out lie together among the conditions, as outliers do not."""
    count = int(high.sum())
    if count < 3:
        return False
    x = problem.recording.x
    columns = [c[problem.condition_of[places]] for c in (x.values() if isinstance(x, dict) else [x])]
    if any(_one_level(column, high, CHANCE / len(columns)) for column in columns):
        return True
    ranks = torch.stack([c.unique(return_inverse=True)[1].double() for c in columns], dim=-1)
    ranks = ranks * (len(places) / (ranks.amax(0) + 1))
    distance = torch.cdist(ranks[high], ranks)
    distance[torch.arange(count), high.nonzero()[:, 0]] = math.inf
    together = float(high[distance.argmin(1)].double().mean())
    return together > TOGETHER


def _one_level(column: Tensor, high: Tensor, chance: float) -> bool:
    """Whether more data that stick out share one value of a condition than by chance of less than this."""
    levels, which = column.unique(return_inverse=True)
    count = int(high.sum())
    if 2 * len(levels) > len(column):
        return False
    there = torch.bincount(which[high], minlength=len(levels)).tolist()
    share = (torch.bincount(which, minlength=len(levels)).double() / len(column)).tolist()
    least = min(
        sum(math.comb(count, k) * q**k * (1 - q) ** (count - k) for k in range(seen, count + 1))
        for seen, q in zip(there, share, strict=True)
    )
    return least * len(levels) < chance


def _high(left: Tensor, known: bool) -> Tensor:
    """Which residuals exceed `SPIKE` robust sd, or noise of unit size where that is ``known``."""
    size = max(1.4826 * float(left.abs().median()), float(known))
    return left.abs() > SPIKE * size if size > 0 else torch.zeros_like(left, dtype=torch.bool)


def _robust_left(columns: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """What a smooth fit with Tukey's biweight leaves, and the sd of that by white noise of unit size.

    At an edge the fit follows a datum that it takes in, and is uncertain where it leaves one out: the variance is near
    1 + q (1 − 2 w²), with w the datum's weight and q the variance of the curve.
    """
    columns = columns[:, : max(1, len(values) // 8)]
    weight = torch.ones_like(values)
    left = values - values.median()
    for _ in range(10):
        size = max(1.4826 * float(left.abs().median()), 1e-300)
        weight = (1 - (left / (4.685 * size)).square()).clamp_min(0)
        solution = torch.linalg.lstsq(columns * weight[:, None], (values * weight)[:, None], driver="gelsd").solution
        left = values - (columns @ solution)[:, 0]
    curve = (columns @ torch.linalg.pinv(columns * weight[:, None], rtol=1e-9)).square().sum(1)
    return left, (1 + curve * (1 - 2 * weight.square())).clamp_min(0.1).sqrt()
