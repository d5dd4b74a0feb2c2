"""Shapes at which outputs jump, such as the time at which something sets in at once: no slope tells where they fit."""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted, fit
from torchcal.discovery.fits.local import is_window
from torchcal.discovery.fits.shapes import beside, shape_points
from torchcal.errors import SimulatorError

__all__ = ["placed"]

#: Shares of its range by which a shape is moved, either way, to see whether outputs do what their slopes say: a bend
#: makes less of a smaller one, and a jump does not. How many noise sd they must move to tell; the share of that which
#: slopes must miss each time; and the share of it below which they say nothing.
NUDGES, SEEN, MISSED, FLAT = (0.02, 0.05), 0.5, 0.5, 1e-6
#: Values over the range that are tried, then between the neighbours of the best one; and how often.
COARSE, FINE, ROUNDS = 48, 12, 3
#: Of those the ones that are refitted, in so many steps; and by how much χ² must fall.
TRIED, STEPS, LOWER = 2, 12, 0.1


def placed(found: Fitted, shapes: Sequence[int]) -> Fitted:
    """The fit with each of its shapes at which outputs jump where it fits best, out of values over its range.

    Whether they jump is seen where outputs move otherwise than their slopes say. At every value the rest is estimated
    linearly, and refitted at the best ones. A smooth shape stays where the fit has left it, as does any of a simulator
    that is dear to call.
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
        try:
            y = problem.evaluate(rows, [], problem.guess(found.warm, rows))[0]
        except SimulatorError:
            continue
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


def _best_of(found: Fitted, place: int, values: Sequence[float]) -> Fitted:
    """The fit with one shape at the best of some values, or as it is where it fits better."""
    problem, w = found.problem, found.whitening
    others = [i for i in found.free if i != place]
    rows = found.values.repeat(len(values), 1)
    rows[:, place] = torch.tensor(values, dtype=torch.float64)
    try:
        y, jacobian, warm = problem.evaluate(rows, others, problem.guess(found.warm, rows))
        left, slope = w.vector(problem.y - y), w(jacobian)
        fine = left.isfinite().all(-1) & slope.isfinite().flatten(1).all(-1)
        chi2 = torch.full((len(rows),), torch.inf, dtype=torch.float64)
        chi2[fine] = _left_over(left[fine], slope[fine])
        best = chi2.argsort()[:TRIED]
        best = best[chi2[best] < found.chi2 - LOWER]
        if not len(best):
            return found
        warm = None if warm is None else warm.rows(best)
        held = fit(problem, w, rows[best], others, warm=warm, max_steps=STEPS, finish=0)
        again = None if held is None else fit(problem, w, held.values[None], found.free, warm=held.warm, finish=0)
    except SimulatorError:
        return found
    if again is None or not again.chi2 < found.chi2 - LOWER:
        return found
    return dataclasses.replace(again, ends=found.ends, ends_chi2=found.ends_chi2, agreeing=found.agreeing)


def _left_over(left: Tensor, slope: Tensor) -> Tensor:
    """χ² of residuals ``(H, n)`` when parameters with slopes ``(H, n, P)`` have been estimated linearly, ``(H,)``."""
    size = slope.norm(dim=1, keepdim=True).clamp_min(1e-300)
    u, s, _ = torch.linalg.svd(slope / size, full_matrices=False)
    along = torch.einsum("hnp,hn->hp", u, left) * (s > 1e-9 * s[:, :1])
    return left.square().sum(-1) - along.square().sum(-1)
