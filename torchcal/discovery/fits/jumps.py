"""Shapes at which outputs jump, such as the time at which something sets in at once: no slope tells where they fit."""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted, fit
from torchcal.discovery.fits.local import is_window
from torchcal.discovery.fits.shapes import beside, shape_points
from torchcal.errors import SimulatorError

__all__ = ["placed", "within"]

#: Shares of its range by which a shape is moved, either way, to see whether outputs do what their slopes say: a bend
#: makes less of a smaller one, and a jump does not. How many noise sd they must move to tell; the share of that which
#: slopes must miss each time; and the share of it below which they say nothing.
NUDGES, SEEN, MISSED, FLAT = (0.02, 0.05), 0.5, 0.5, 1e-6
#: Values over the range that are tried, then between the neighbours of the best one; and how often.
COARSE, FINE, ROUNDS = 48, 12, 3
#: How often the gap in which an end of an interval lies is divided, and the root of the rise of χ² there: 95 %.
HALVED, SIDES = 2, 1.96
#: Of those the ones that are refitted, in so many steps; and by how much χ² must fall.
TRIED, STEPS, LOWER = 2, 12, 0.1


def placed(found: Fitted, shapes: Sequence[int]) -> Fitted:
    """The fit with each of its shapes at which outputs jump where it fits best, out of values over its range.

    Whether they jump is seen where outputs move otherwise than their slopes say. At every value the rest is estimated
    linearly, and refitted at the best ones, of one shape after the other: two that must move together may not be found.
    A smooth shape stays where the fit has left it, unless it bends as much within a few hundredths of its range; so
    does any of a simulator that is dear to call.
    """
    if found.problem.dear:
        return found
    for place in _jumping(found, [i for i in shapes if i in found.free]):
        found = _placed(found, place)
    return found


def _jumping(found: Fitted, shapes: Sequence[int]) -> list[int]:
    """Those of some shapes that move outputs otherwise than by their slopes."""
    problem, w, jumping = found.problem, found.whitening, []
    for place in shapes:
        q, value = problem.parameters[place], float(found.values[place])
        if is_window(q.name):
            continue
        points = [point for share in NUDGES for point in beside(q, value, share)]
        rows = found.values.repeat(len(points), 1)
        rows[:, place] = torch.tensor(points, dtype=torch.float64)
        y = _evaluated(found, rows, [])[0]
        moved = w.vector(y[1::2] - y[::2])
        by = rows[1::2, place] - rows[::2, place]
        told = w.vector(found.jacobian[:, found.free.index(place)] * by[:, None])
        size = moved.norm(dim=-1)
        missed = (size > SEEN) & ((moved - told).norm(dim=-1) > MISSED * size)  # not where they are NaN
        if bool(missed.all() or (missed & (told.norm(dim=-1) < FLAT * size)).any()):
            jumping.append(place)
    return jumping


def _placed(found: Fitted, place: int) -> Fitted:
    """The fit with one shape where it fits best."""
    q = found.problem.parameters[place]
    values = sorted(shape_points(q, COARSE))
    for _ in range(ROUNDS):
        found = _best_of(found, place, values)
        value = float(found.values[place])
        below = max((v for v in values if v < value), default=value if q.low is None else q.low)
        above = min((v for v in values if v > value), default=value if q.high is None else q.high)
        values = torch.linspace(below, above, FINE + 2, dtype=torch.float64)[1:-1].tolist()
    return found


def within(found: Fitted, shapes: Sequence[int]) -> dict[int, tuple[float, float]]:
    """95 % intervals of those of some shapes at which outputs jump, by their places: where χ² stays within 1.96² of the
    fit's, the rest estimated linearly, or up to where a bound is. Slopes say nothing of them."""
    result = {}
    for place in _jumping(found, [i for i in shapes if i in found.free]) if not found.problem.dear else ():
        q, at = found.problem.parameters[place], float(found.values[place])
        values = sorted({*shape_points(q, COARSE), at})
        ends = []
        for side in (-1, 1):
            row = [v for v in values if side * (v - at) >= 0][:: side]
            end = q.low if side < 0 else q.high
            row += [end] if end is not None and end != row[-1] else []
            for _ in range(HALVED + 1):
                far = (_chi2(found, place, row)[0] > found.chi2 + SIDES**2).nonzero()[:, 0].tolist()
                if not far or far[0] == 0:
                    break
                row = torch.linspace(row[far[0] - 1], row[far[0]], FINE, dtype=torch.float64).tolist()
            ends.append(row[far[0]] if far else row[-1] if end is not None else side * math.inf)
        result[place] = (ends[0], ends[1])
    return result


def _best_of(found: Fitted, place: int, values: Sequence[float]) -> Fitted:
    """The fit with one shape at the best of some values, or as it is where it fits better."""
    problem, w = found.problem, found.whitening
    others = [i for i in found.free if i != place]
    chi2, rows = _chi2(found, place, values)
    best = chi2.argsort()[:TRIED]
    best = best[chi2[best] < found.chi2 - LOWER]
    if not len(best):
        return found
    try:
        warm = problem.guess(found.warm, rows[best])
        held = fit(problem, w, rows[best], others, warm=warm, max_steps=STEPS, finish=0)
        again = None if held is None else fit(problem, w, held.values[None], found.free, warm=held.warm, finish=0)
    except SimulatorError:
        return found
    if again is None or not again.chi2 < found.chi2 - LOWER:
        return found
    return dataclasses.replace(again, ends=found.ends, ends_chi2=found.ends_chi2, agreeing=found.agreeing)


def _chi2(found: Fitted, place: int, values: Sequence[float]) -> tuple[Tensor, Tensor]:
    """χ² ``(H,)`` with one shape at some values and the rest estimated linearly, and rows ``(H, P)`` before that."""
    rows = found.values.repeat(len(values), 1)
    rows[:, place] = torch.tensor(values, dtype=torch.float64)
    y, jacobian = _evaluated(found, rows, [i for i in found.free if i != place])
    left, slope = found.whitening.vector(found.problem.y - y), found.whitening(jacobian)
    fine = left.isfinite().all(-1) & slope.isfinite().flatten(1).all(-1)
    chi2 = torch.full((len(rows),), torch.inf, dtype=torch.float64)
    if bool(fine.any()):
        chi2[fine] = _left_over(left[fine], slope[fine])
    return chi2, rows


def _evaluated(found: Fitted, rows: Tensor, columns: list[int]) -> tuple[Tensor, Tensor]:
    """Outputs ``(H, n)`` and slopes ``(H, n, columns)`` at parameters ``(H, P)``; NaN where a function raises."""
    problem = found.problem
    try:
        return problem.evaluate(rows, columns, problem.guess(found.warm, rows))[:2]
    except SimulatorError:
        if len(rows) == 1:
            y = torch.full((1, problem.n), torch.nan, dtype=torch.float64)
            return y, y.unsqueeze(-1).expand(-1, -1, len(columns))
    halves = [_evaluated(found, part, columns) for part in rows.tensor_split(2)]
    return torch.cat([y for y, _ in halves]), torch.cat([slopes for _, slopes in halves])


def _left_over(left: Tensor, slope: Tensor) -> Tensor:
    """χ² of residuals ``(H, n)`` when parameters with slopes ``(H, n, P)`` have been estimated linearly, ``(H,)``."""
    size = slope.norm(dim=1, keepdim=True).clamp_min(1e-300)
    u, s, _ = torch.linalg.svd(slope / size, full_matrices=False)
    along = torch.einsum("hnp,hn->hp", u, left) * (s > 1e-9 * s[:, :1])
    return left.square().sum(-1) - along.square().sum(-1)
