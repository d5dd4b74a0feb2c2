"""Data that are no noise of the rest: single samples far from their neighbours, or from a model that explains these."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.misfit.curves import smooth_columns

__all__ = ["chance_of_pairs", "clustered", "gross", "lone", "lone_values", "spikes"]

#: A sample that leaves its neighbours' range by more than this many robust sd, alone or with one beside it, is one.
SPIKE = 4.5
#: Robust sd from which on a residual of a model that explains the rest is an outlier, where its neighbours' are not
#: half as large that way.
LONE = 4.5
#: How many times as far as the bend of those beside it would take it a sample must be off to be an outlier.
BENT = 3.0
#: Distance, in that of the farthest neighbour, below which two neighbours tell no more of a bend than one.
APART = 0.1
#: How many times as large the product of the distances to both neighbours must be in places for a table to be uneven.
UNEVEN = 2.0
#: Share of the largest sample below which a bend is rounding.
ROUNDED = 1e-12
#: Columns of a robust fit at most, as a share of its data: of more than two in five it bends to what is off.
MOST_COLUMNS = 0.4
#: Share of supposed outliers with another one as nearest neighbour above which they are no outliers.
TOGETHER = 0.4
#: How many times as far off as all others a few data are that are outliers whatever the noise is; the share that they
#: are at most; and data of an output at least that tell.
GROSS, RARE, FEWEST = 8.0, 0.05, 20
#: Share of the distance of another one beside it up to which a sample is not off itself, but by a fit that this bends.
DWARFED = 0.02
#: Probability of as many of them at one value of a condition by chance, below which they are no outliers; and of as
#: many on end along one, `BESIDE` places apart at most and on the same side.
CHANCE, IN_ROW, BESIDE = 0.1, 0.02, 2


def spikes(problem: Problem, residual: Tensor, sd: Tensor | None, tangents: Tensor | None = None) -> Tensor:
    """Used data that stick out alone from their neighbours, bool ``(n,)``.

    Along one order they are compared with two neighbours on either side. Among several conditions the
    residual of a robust smooth fit takes its place. Where that finds none, the ``tangents`` ``(n, P)`` of the fit that
    left it are fitted too: two data among few have drawn it to them.
    """
    found = torch.zeros(problem.n, dtype=torch.bool)
    for places in problem.sequences:
        if len(places) < 10:
            continue
        r = residual[places]
        if sd is not None:
            r = r / sd[problem.index[places]]
        if problem.order is None:
            curves = smooth_columns(problem, places, ranks=True)[:, : max(1, len(places) // 8)]
            found[places] = _off_curves(problem, places, curves, r, sd is not None)
            if tangents is not None and not bool(found[places].any()):
                slope = tangents[places] if sd is None else tangents[places] / sd[problem.index[places]][:, None]
                curves = torch.cat([curves, slope / slope.norm(dim=0).clamp_min(1e-300)], dim=1)
                if curves.shape[1] <= MOST_COLUMNS * len(places):
                    found[places] = _off_curves(problem, places, curves, r, sd is not None)
            continue
        at = problem.order[problem.condition_of[places]].double()
        # A curve leaves its neighbours' range nowhere, but bends everywhere.
        least = SPIKE * math.sqrt(1.3) * _bends(at, r).clamp_min(float(sd is not None))  # 1 is what white noise gives
        if bool((least > 0).all()):
            found[places] = _alone(at, r, _with_ends(at, r, _off_neighbours(r), least), least)
    return found


def lone(problem: Problem, residual: Tensor, sd: Tensor | None, ends: bool = False) -> Tensor:
    """Used data that a model that explains the others misses by far, bool ``(n,)``.

    In an order their neighbours, or those of two side by side, must not be half as far off that way, and the ends are
    not judged unless that is wanted: a quick beginning is physics as likely as not. Among several conditions they must
    not be together.
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
            far = _first(far, r)
            found[places] = far & (not clustered(problem, places, far, r))
            continue
        beside = torch.full_like(r, -math.inf)
        beside[1:] = r[:-1] * r[1:].sign()
        beside[:-1] = torch.maximum(beside[:-1], r[1:] * r[:-1].sign())
        if not ends:
            far[[0, -1]] = False
        found[places] = (far & (beside < 0.5 * r.abs())) | _twins(r, far)
    return found


def gross(r: Tensor) -> Tensor:
    """Which of some data ``(n,)`` are so far off beside all others that they are outliers whatever the noise is, bool
    ``(n,)``: one decimal point in the wrong place would make noise grow with the value.

    >>> gross(torch.tensor([1.0, -2.0, 1.5, 900.0, 0.5])).tolist()
    [False, False, False, True, False]
    """
    size = r.abs().sort(descending=True).values
    most = min(max(int(RARE * len(r)), 1), len(r) - 1)
    apart = (size[:most] > GROSS * size[1 : most + 1]).nonzero()[:, 0]
    least = size[apart[-1]] if len(apart) else torch.inf
    found: Tensor = r.abs() >= least
    return found


def lone_values(problem: Problem) -> Tensor:
    """Used data whose values are far beyond those of all others of their output, singly and not at an end, bool
    ``(n,)``: of what is recorded in an order."""
    found = torch.zeros(problem.n, dtype=torch.bool)
    for output in range(len(problem.recording.outputs) if problem.order is not None else 0):
        mine = problem.output_of == output
        if int(mine.sum()) >= FEWEST:
            found[mine] = gross(problem.y[mine] - problem.y[mine].median())
    for places in problem.sequences if bool(found.any()) else ():
        out = found[places]
        beside = torch.zeros_like(out)
        beside[1:] |= out[:-1]
        beside[:-1] |= out[1:]
        beside[[0, -1]] = True
        found[places] = out & ~beside
    return found


def _off_curves(problem: Problem, places: Tensor, curves: Tensor, r: Tensor, known: bool) -> Tensor:
    """Which data of a sequence ``(m,)`` a robust fit of curves misses by far, but not where they lie together."""
    left, scale = _robust_left(curves, r)
    high, far = (_high(values, known) for values in (left, left / scale))
    return torch.zeros_like(high) if clustered(problem, places, high, left) else _first(high & far, left / scale)


def _twins(r: Tensor, far: Tensor) -> Tensor:
    """Which of some data ``(m,)`` are two side by side, far off on one side, and those around not half as far."""
    found = torch.zeros_like(far)
    both = far[1:-2] & far[2:-1] & (r[1:-2] * r[2:-1] > 0)
    around = torch.maximum(r[:-3] * r[1:-2].sign(), r[3:] * r[1:-2].sign())
    both &= around < 0.5 * torch.minimum(r[1:-2].abs(), r[2:-1].abs())
    found[1:-2] |= both
    found[2:-1] |= both
    return found


def _first(far: Tensor, r: Tensor) -> Tensor:
    """Of data that are far off the one that is off twice as far as any other, as it draws the fit off those around it;
    all of them where there is none."""
    worst = far & (r.abs() >= 0.5 * r[far].abs().max()) if bool(far.any()) else far
    return worst if int(worst.sum()) == 1 else far


def _off_neighbours(r: Tensor) -> Tensor:
    """By how much samples ``(m,)`` leave the range of the two middle ones of their four neighbours.

    Beside two spikes that range reaches from the other samples to the spikes, so that these alone leave it.
    """
    padded = torch.cat([r[:1].expand(2), r, r[-1:].expand(2)])
    around = torch.stack([padded[k : k + len(r)] for k in (0, 1, 3, 4)]).sort(0).values
    off: Tensor = r - torch.maximum(torch.minimum(r, around[2]), around[1])
    return off


def _bends(at: Tensor, r: Tensor) -> Tensor:
    """Usual distance of samples ``(m,)`` from the lines through their neighbours, in that of white noise of unit size.

    White noise bends alike whatever the spacing; a curve bends with the product of the distances to both neighbours. By
    how much more they bend where that is large is seen from the thirds where it is smallest and largest.
    """
    before, behind = at.diff()[:-1], at.diff()[1:]
    span = before + behind
    share = torch.where(span > 0, before / span.clamp_min(1e-300), torch.full_like(span, 0.5))
    line = r[:-2] + share * (r[2:] - r[:-2])
    size = ((r[1:-1] - line).square() / (1 + share.square() + (1 - share).square())).sqrt()
    reach = before * behind
    third = len(size) // 3
    order = reach.argsort()
    near, far = (float(reach[part].median().clamp_min(1e-300)) for part in (order[:third], order[-third:]))
    moving = size > ROUNDED * r.abs().max()
    if not bool(moving.any()):
        return torch.zeros_like(r)
    usual = size[moving].median()  # equal readings at equal conditions tell nothing of the others
    power = 0.0
    if far > UNEVEN * near and float(usual) > 0:
        less, more = (float(size[part].median().clamp_min(1e-300)) for part in (order[:third], order[-third:]))
        power = min(max(math.log(more / less) / math.log(far / near), 0.0), 1.0)
    grown = reach.clamp_min(1e-300) ** power
    found = 1.4826 * torch.maximum(usual, (size / grown)[moving].median() * grown)
    return torch.cat([found[:1], found, found[-1:]])


def _with_ends(at: Tensor, r: Tensor, off: Tensor, least: Tensor) -> Tensor:
    """The same with both ends measured from a line through the next four.

    Scaled to vary as much as the others do by noise alone; 0 where one of the four is off itself, by more than
    ``least``, or where they bend: a decay ends farther off the line than the parabola through them.
    """
    off = off.clone()
    for end, next_, x in ((0, r[1:5], at[1:5] - at[0]), (-1, r[-5:-1].flip(0), at[-1] - at[-5:-1].flip(0))):
        beside = slice(1, 5) if end == 0 else slice(-5, -1)
        parabola = _through(x, 2)
        if len(parabola) < 3:
            off[end] = 0.0
            continue
        near, far = x[:2].mean(), x[2:].mean()
        away = float(near / (far - near))
        line = torch.tensor([1 + away, 1 + away, -away, -away], dtype=r.dtype) / 2
        here = float(r[end] - line @ next_)
        bend = float((line @ x.square()) * (parabola[2] @ next_))
        plain = abs(here) > BENT * abs(bend) and not bool((off[beside].abs() > least[beside]).any())
        off[end] = here * math.sqrt(1.3 / (1 + float(line.square().sum()))) if plain else 0.0
    return off


def _through(x: Tensor, degree: int) -> Tensor:
    """What gives the coefficients of the polynomial that comes nearest to samples at x ``(k,)``, ``(degree + 1, k)``;
    of a lower degree where they are at too few places."""
    size = x.abs().max().clamp_min(1e-300)
    powers = torch.arange(min(degree, len((x / size / APART).round().unique()) - 1) + 1)
    return torch.linalg.pinv((x / size)[:, None] ** powers) / (size**powers)[:, None]


def _alone(at: Tensor, r: Tensor, off: Tensor, least: Tensor) -> Tensor:
    """Which differences from neighbours are at least so large, singly or two together, bool ``(m,)``.

    Those beside the top of a curve are nearly as large as at its top; those beside a spike are not. Before and behind a
    step the values differ; before and behind a spike they do not. Two at the top of a curve are off their neighbours,
    but not off the parabola through those.
    """
    around = torch.nn.functional.max_pool1d(off.abs()[None], 2 * BESIDE + 1, 1, BESIDE)[0]
    high = ((off.abs() > least) & (off.abs() > DWARFED * around)).tolist()
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
            alone = max(size[k - 1] if k else 0.0, size[end], step) < 0.5 * max(size[k:end])
            found[k:end] = alone and _off_curve(at, r, high, k, end, least)
        k = end + 1
    return found


def _off_curve(at: Tensor, r: Tensor, high: Sequence[bool], k: int, end: int, least: Tensor) -> bool:
    """Whether one of the samples from k to ``end`` is as far off the parabola through two before and two behind, and
    not for how these bend.

    By the farther the worse that tells for how they are spaced. Samples that are ``high`` themselves are passed over.
    """
    before = [i for i in range(max(k - 4, 0), k) if not high[i]][-2:]
    behind = [i for i in range(end, min(end + 4, len(r))) if not high[i]][:2]
    around = torch.tensor([*before, *behind])
    if not before or not behind:
        return True
    for i in range(k, end):
        x = at[around] - at[i]
        weights, even = (_through(part, 2)[0] for part in (x, around.double() - i))
        worse = float((1 + weights.square().sum()) / (1 + even.square().sum()))
        off = abs(float(r[i] - weights @ r[around]))
        bend = abs(float((weights - _through(x, 1)[0]) @ r[around]))
        if off > float(least[i]) * math.sqrt(max(worse, 1.0)) and off > BENT * bend:
            return True
    return False


def clustered(problem: Problem, places: Tensor, high: Tensor, r: Tensor) -> bool:
    """Whether data of a sequence that stick out ``(m,)`` lie together among the conditions, as outliers do not; ``r``
    is by how much."""
    count = int(high.sum())
    if count < 2:
        return False
    columns = problem.recording.columns[problem.condition_of[places]].unbind(-1)
    if any(_one_level(column, high, CHANCE / len(columns)) for column in columns):
        return True
    many = [column for column in columns if 2 * len(column.unique()) >= len(column)]  # levels, so that there is a row
    if any(test(one, high, r, IN_ROW / len(columns)) for one in many for test in (_in_a_row, _at_an_end)):
        return True
    if count < 3:
        return False
    ranks = torch.stack([c.unique(return_inverse=True)[1].double() for c in columns], dim=-1)
    ranks = ranks * (len(places) / (ranks.amax(0) + 1))
    distance = torch.cdist(ranks[high], ranks)
    distance[torch.arange(count), high.nonzero()[:, 0]] = math.inf
    nearest = (distance <= distance.amin(1, keepdim=True) * (1 + 1e-9)).double()
    together = float((nearest @ high.double() / nearest.sum(1)).mean())
    return together > TOGETHER


def _in_a_row(column: Tensor, high: Tensor, r: Tensor, chance: float) -> bool:
    """Whether more data that stick out to one side follow each other along a condition than by chance of less than
    this (`chance_of_pairs`)."""
    m = len(column)
    order = column.argsort(stable=True)
    at, side = high[order].nonzero()[:, 0], r[order][high[order]].sign()
    pairs = int(((at.diff() <= BESIDE) & (side.diff() == 0)).sum())
    return chance_of_pairs(pairs, int((side > 0).sum()), int((side < 0).sum()), m, BESIDE) < chance


def _at_an_end(column: Tensor, high: Tensor, r: Tensor, chance: float) -> bool:
    """Whether the lowest or the highest values of a condition, two at least, stick out to one side, as so many would by
    chance of less than this: there what a law lacks shows first."""
    side = r.sign().where(high, 0.0)[column.argsort(stable=True)]
    most = max(int((end * end[0] > 0).long().cumprod(0).sum()) for end in (side, side.flip(0)))
    return most > 1 and 2 * (int(high.sum()) / len(column)) ** most * 0.5 ** (most - 1) < chance


def chance_of_pairs(pairs: int, above: int, below: int, m: int, beside: float = 1) -> float:
    """Probability that so many or more pairs of data that stick out to one side lie at most ``beside`` places apart in
    a row; of other arrangements it is half the number of neighbours that a datum has.

    Outliers do not know of each other: of a above and b below among m, as many do as a binomial variable of
    (a - 1) + (b - 1) with a mean of (a (a - 1) + b (b - 1)) ``beside`` / m.
    """
    if pairs == 0:
        return 1.0
    most = max(above - 1, 0) + max(below - 1, 0)
    share = min(beside * (above * (above - 1) + below * (below - 1)) / m / max(most, 1), 1.0)
    return sum(math.comb(most, k) * share**k * (1 - share) ** (most - k) for k in range(pairs, most + 1))


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
    weight = torch.ones_like(values)
    left = values - values.median()
    for _ in range(10):
        size = max(1.4826 * float(left.abs().median()), 1e-300)
        weight = (1 - (left / (4.685 * size)).square()).clamp_min(0)
        solution = torch.linalg.lstsq(columns * weight[:, None], (values * weight)[:, None], driver="gelsd").solution
        left = values - (columns @ solution)[:, 0]
    curve = (columns @ torch.linalg.pinv(columns * weight[:, None], rtol=1e-9)).square().sum(1)
    return left, (1 + curve * (1 - 2 * weight.square())).clamp_min(0.1).sqrt()
