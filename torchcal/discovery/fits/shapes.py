"""Where the shape parameters of candidates are tried: a grid over their bounds and the values of what drives them."""

import itertools
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.problem import Problem
from torchcal.simulators import Parameter
from torchcal.terms import Term

__all__ = ["driver_values", "grid_of_shapes", "lies_anywhere", "shape_points"]

#: Points of a grid of shape parameters: along one, two, three and more of them.
GRID_POINTS = (1, 9, 5, 4)
#: Of a shape measured on a driver's scale, how many more lie at the driver's own values: thresholds do.
DRIVER_POINTS = (0, 7, 3, 2)
#: Of a shape that may lie anywhere, as nobody said where, how many more lie at the values of all drivers.
ANYWHERE_POINTS = (0, 6, 4, 2)
#: Points of the grid at most, and the fraction whose multiples spread them over all.
MOST_POINTS, GOLDEN = 256, 0.5 * (math.sqrt(5.0) - 1.0)


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
    if parameter.transform == "log" or (low > 0 and high / low > 20):
        return [float(low * (high / low) ** a) for a in at]
    return [float(low + (high - low) * a) for a in at]


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


def grid_of_shapes(problem: Problem, shape: list[int], drivers: Mapping[str, Sequence[Tensor]]) -> Tensor:
    """Combinations ``(G, len(shape))`` of values of the parameters at places ``shape``, with what `driver_values` tells
    of them."""
    level = min(len(shape), len(GRID_POINTS) - 1)
    count, more = GRID_POINTS[level], DRIVER_POINTS[level]
    points = []
    for place in shape:
        q = problem.parameters[place]
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
    number = math.prod(len(each) for each in points)
    if number <= MOST_POINTS:
        rows = list(itertools.product(*points))
    else:  # some of all, none of them alike in most
        numbers = dict.fromkeys(int(number * (k * GOLDEN % 1.0)) for k in range(2 * MOST_POINTS))
        rows = [_combination(points, k) for k in list(numbers)[:MOST_POINTS]]
    return torch.tensor(rows, dtype=torch.float64).reshape(len(rows), len(shape))


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
