"""Where the shape parameters of candidates are tried: a grid over their bounds and the values of what drives them."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.problem import Problem
from torchcal.simulators import Parameter
from torchcal.terms import Term

__all__ = [
    "beside", "combined", "driver_values", "lies_anywhere", "looked_at", "points_of_shapes", "shape_points",
]  # fmt: skip

#: Points of a grid of shape parameters: along one, two, three and more of them.
GRID_POINTS = (1, 9, 5, 4)
#: Of a shape measured on a driver's scale, how many more lie at the driver's own values: thresholds do.
DRIVER_POINTS = (0, 7, 3, 2)
#: Of a shape that may lie anywhere, as nobody said where, how many more lie at the values of all drivers.
ANYWHERE_POINTS = (0, 6, 4, 2)
#: Points of the grid at most, and the fraction whose multiples spread them over all.
MOST_POINTS, GOLDEN = 256, 0.5 * (math.sqrt(5.0) - 1.0)
#: Share of a tangent that its neighbour has, below which a grid is too coarse; how often values between are added, not
#: to gaps of less than this share of the range; points of other shapes that are enough then; and the size of a tangent,
#: in that of the largest, below which it is none.
SHARED, ROUNDS, FINEST, FEWEST, NOTHING = 0.3, 5, 0.004, 3, 1e-6
#: Share of what the best tangent takes of what is left that one at a period or a frequency of that must take.
AS_MUCH = 0.5


def shape_points(parameter: Parameter, count: int) -> list[float]:
    """So many values of a shape parameter over its bounds, or about what is said of it; of one the middle."""
    low, high = parameter.low, parameter.high
    if low is None or high is None:
        if low is None and high is None and parameter.initial == 0 and count > 1:
            return torch.linspace(-2, 2, count).tolist()
        middle = parameter.initial or parameter.neutral or 1.0
        end = low if low is not None else high if high is not None else 0.0
        away = middle - end
        on_it = away == 0 and count == 1  # as the user may have it
        if not on_it and ((low is not None and away <= 0) or (high is not None and away >= 0)):
            away = math.copysign(abs(end) or 1.0, 1.0 if low is not None else -1.0)
        factors = torch.linspace(-2, 2, count).tolist() if count > 1 else [0.0]
        return [end + away * 2.0**k for k in factors]
    at = torch.linspace(0, 1, count + 2, dtype=torch.float64)[1:-1]
    if _over_decades(parameter):
        return [float(low * (high / low) ** a) for a in at]
    return [float(low + (high - low) * a) for a in at]


def beside(q: Parameter, value: float, share: float) -> tuple[float, float]:
    """Values of a shape below and above one, by a share of its range, or of itself where it has none; within bounds."""
    low, high = -math.inf if q.low is None else q.low, math.inf if q.high is None else q.high
    if _over_decades(q):
        factor = (high / low) ** share
        return max(value / factor, low), min(value * factor, high)
    away = share * (high - low if math.isfinite(high - low) else abs(value) or 1.0)
    return max(value - away, low), min(value + away, high)


def _over_decades(q: Parameter) -> bool:
    """Whether values are laid out over the logarithm of a shape with bounds."""
    return q.low is not None and q.high is not None and (q.transform == "log" or (q.low > 0 and q.high / q.low > 20))


def lies_anywhere(q: Parameter) -> bool:
    """Whether nobody says where a shape lies."""
    return q.transform is None and all(value is None for value in (q.low, q.high, q.initial, q.neutral))


def driver_values(
    base: Problem, found: Fitted, terms: Sequence[Term], shape: Sequence[Parameter]
) -> dict[str, list[Tensor]]:
    """Sorted magnitudes on the calibrated trajectory of the driver that each shape is measured on, by its name; of one
    that may lie anywhere the values of all drivers."""
    anywhere = [q.name for q in shape if lies_anywhere(q)]
    if not anywhere and not any(term.scales for term in terms):
        return {}
    drivers = base.drivers(found.values[None], found.warm)
    every = [each.flatten().sort().values for each in drivers.values() if bool(each.isfinite().all())]
    for number, name in enumerate(base.recording.outputs):
        drivers.setdefault(name, found.y[base.output_of == number])
    return dict.fromkeys(anywhere, every) | {
        term.full(own): [drivers[driver].abs().flatten().sort().values]
        for term in terms for own, driver in term.scales.items()
        if driver in drivers and not base.is_time(driver)
    }  # fmt: skip


def points_of_shapes(
    problem: Problem, shape: Sequence[int], drivers: Mapping[str, Sequence[Tensor]], usual: Mapping[int, float]
) -> list[list[float]]:
    """Values at which each of the parameters at places ``shape`` is tried, with what `driver_values` tells of them; one
    that has a ``usual`` value there, and half-way to its bounds."""
    level = min(len(shape) - len(usual), len(GRID_POINTS) - 1)
    count, more = GRID_POINTS[level], DRIVER_POINTS[level]
    points = []
    for place in shape:
        q = problem.parameters[place]
        if place in usual:
            ends = [end for end in (q.low, q.high) if end is not None]
            points.append([usual[place], *(0.5 * (usual[place] + end) for end in ends)])
            continue
        values = [each for each in drivers.get(q.name, ()) if len(each)]
        if not values:
            points.append(shape_points(q, count))
        elif lies_anywhere(q):
            each = max(ANYWHERE_POINTS[level] // len(values), 2)
            there = list(dict.fromkeys(v for one in values for v in _spaced(one, each)))
            points.append(there[::2] + shape_points(q, count) + there[1::2])  # what is tried first is in the middle
        else:
            low, high = q.low or 0.0, q.high if q.high is not None else math.inf
            there = [min(max(v, low), high) for v in _spaced(values[0], more)]
            points.append(shape_points(q, count - more // 2) + there)
    return points


def combined(points: Sequence[Sequence[float]]) -> Tensor:
    """Combinations ``(G, len(points))`` of a value of each shape."""
    number = math.prod(len(each) for each in points)
    if number <= MOST_POINTS:
        rows = list(itertools.product(*points))
    else:  # some of all, none of them alike in most
        numbers = dict.fromkeys(int(number * (k * GOLDEN % 1.0)) for k in range(2 * MOST_POINTS))
        rows = [_combination(points, k) for k in list(numbers)[:MOST_POINTS]]
    return torch.tensor(rows, dtype=torch.float64).reshape(len(rows), len(points))


def looked_at(
    problem: Problem,
    shape: Sequence[int],
    points: Sequence[Sequence[float]],
    given: Sequence[bool],
    look: Callable[[Tensor], Tensor],
    fitted: Fitted,
) -> tuple[Tensor, Tensor]:
    """Combinations of shapes ``(G, len(points))`` and tangents there ``(G, n, amplitudes)``.

    Where tangents differ so much from one value of a shape to the next that what lies between is not seen, values
    between are looked at too: of a frequency, say, of which a whole cycle more fits into the recording. Where they are
    too many the shape may be the period, or the frequency, of what is left of the data.

    Args:
        problem: Of the candidate.
        shape: Places of the shapes.
        points: Their values to begin with.
        given: Which of them stay as they are.
        look: Tangents at rows of shapes.
        fitted: What the tangents are taken at.
    """
    sd = fitted.whitening.sd
    found, stays, grown = [list(each) for each in points], list(given), [False] * len(points)
    grid = combined(found)
    tangents = look(grid)

    def shares() -> list[Tensor]:
        counts = [len(each) for each in found]
        if math.prod(counts) != len(grid) or not tangents.numel():
            return [sd[:0]] * len(shape)
        whole = (tangents / sd[:, None]).reshape(*counts, *tangents.shape[1:])
        return [sd[:0] if stays[d] else _shared(whole, d, each) for d, each in enumerate(found)]

    for _ in range(ROUNDS):
        counts = [len(each) for each in found]
        more = [
            _between(problem.parameters[place], each, shared)
            for place, each, shared in zip(shape, found, shares(), strict=True)
        ]
        grown = [so_far or bool(new) for so_far, new in zip(grown, more, strict=True)]
        if math.prod(len(each) + len(new) for each, new in zip(found, more, strict=True)) > MOST_POINTS:
            for d, each in enumerate(found):
                if not (stays[d] or grown[d]):  # a few are enough of what changes less
                    found[d], stays[d] = each[:: max(len(each) // FEWEST, 1)], True
        for d, new in enumerate(more):
            room = MOST_POINTS // math.prod(len(each) for k, each in enumerate(found) if k != d) - len(found[d])
            if new and room > 0:
                found[d] = sorted(found[d] + new[:: -(-len(new) // room)])
        if [len(each) for each in found] == counts:
            break
        known = {tuple(row): k for k, row in enumerate(grid.tolist())}
        grid = combined(found)
        places = [known.get(tuple(row), -1) for row in grid.tolist()]
        anew = torch.tensor([k < 0 for k in places])
        tangents = tangents[places]
        if bool(anew.any()):
            tangents[anew] = look(grid[anew])
    if not any(grown):  # no grid was too coarse
        return grid, tangents
    least = AS_MUCH * _gains(tangents, fitted).max()
    for d, shared in enumerate(shares()):
        coarse = bool((shared < SHARED).any())
        offered = _of_periods(problem.parameters[shape[d]], fitted.rhythms) if coarse else []
        if not offered:
            continue
        rows = combined([offered if k == d else each for k, each in enumerate(found)])
        seen = look(rows)
        better = _gains(seen, fitted) > least
        grid, tangents = torch.cat([grid, rows[better]]), torch.cat([tangents, seen[better]])
    return grid, tangents


def _of_periods(q: Parameter, periods: Sequence[float]) -> list[float]:
    """Values within the bounds of a shape that may be a period, a frequency or an angular frequency."""
    values = [value for period in periods for value in (period, 1.0 / period, 2 * math.pi / period)]
    return [v for v in values if (q.low is None or v > q.low) and (q.high is None or v < q.high)]


def _gains(tangents: Tensor, fitted: Fitted) -> Tensor:
    """How much of what is left of the data a tangent of each row takes, the best of its amplitudes', ``(G,)``."""
    sd = fitted.whitening.sd
    along = torch.einsum("gna,n->ga", tangents / sd[:, None], fitted.residual / sd)
    size = (tangents / sd[:, None]).square().sum(1)
    return (along.square() / size.clamp_min(1e-300)).amax(1)


def _shared(whole: Tensor, d: int, points: Sequence[float]) -> Tensor:
    """Share of the tangents at each value of shape ``d``, in ascending order, that those at the one before have,
    ``(len(points) - 1,)``; the least of the amplitudes', and the median over the other shapes."""
    order = torch.tensor(points, dtype=torch.float64).argsort(stable=True)
    whole = whole.movedim(d, 0)[order].reshape(len(points), -1, *whole.shape[-2:])
    size = whole.norm(dim=-2)
    basis = torch.linalg.qr(whole[:-1]).Q
    share = (basis.transpose(-1, -2) @ whole[1:]).norm(dim=-2) / size[1:]
    # What is nothing beside the rest is rounding.
    tiny = (size[:-1] <= NOTHING * size.max()) | (size[1:] <= NOTHING * size.max())
    return share.masked_fill(tiny, 1.0).nan_to_num(nan=1.0).amin(-1).median(-1).values


def _between(q: Parameter, points: Sequence[float], shared: Tensor) -> list[float]:
    """Values of a shape between those that share too little, and beyond the outermost if these do, unless they lie
    close beside each other."""
    if not len(shared):
        return []
    over, values = _over_decades(q), sorted(points)
    ends = [values[0] if q.low is None else q.low, *values, values[-1] if q.high is None else q.high]
    few = [bool(shared[0] < SHARED), *(shared < SHARED).tolist(), bool(shared[-1] < SHARED)]
    scale = [math.log(value) for value in ends] if over else ends
    least = FINEST * (scale[-1] - scale[0])
    return [
        math.sqrt(low * high) if over else 0.5 * (low + high)
        for low, high, gap, more in zip(ends, ends[1:], itertools.pairwise(scale), few, strict=False)
        if more and gap[1] - gap[0] > least
    ]


def _spaced(values: Tensor, count: int) -> list[float]:
    """So many of sorted values ``(n,)``, evenly spaced in rank."""
    at = ((torch.arange(count) + 0.5) / count * (len(values) - 1)).round().long()
    return [float(v) for v in values[at]]


def _combination(points: Sequence[Sequence[float]], number: int) -> tuple[float, ...]:
    """One of the combinations of a point of each, by its number."""
    found = []
    for each in points:
        number, place = divmod(number, len(each))
        found.append(each[place])
    return tuple(found)
