"""Minimisation where the model is dear: first on its tangents or with few quadrature nodes, then with all of it."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchcal.inference.newton import Minima, directions, finite_values, gradient, hessian, join, minimise
from torchcal.propagation import NISP
from torchcal.simulators import Conditions, Simulator

__all__ = ["few_nodes", "minimise_by_tangents", "pieces", "search", "search_with_few_nodes"]

Objective = Callable[[NISP, Tensor], Tensor]

_INNER = 8
"""Newton steps on the tangents for one linearisation: the objective is far from quadratic where spreads vanish."""

_SAME = 1e-5
"""Relative difference of objectives on the tangent plane from which on two starts are followed apart."""

_DISTINCT = 4
"""Points on the tangent plane that are followed with the model."""

_ROUGH = 15
"""Iterations of those points; then Newton's method on the model itself takes fewer."""

_FINISHED = 2
"""The best of those points, which are followed to the end."""

_SHARES = (1.0, 0.5, 0.2, 0.05, 0.01)
"""Of the way to the tangents' minimum at which the model itself is tried."""

_ELEMENTS = 2**23
"""Numbers of outputs on tangents at once, 64 MiB."""

_PIECE = 2**17
"""Numbers of outputs at once on a CPU, whose caches hold them: larger pieces take several times longer each."""

_FEWER = 4
"""How many times fewer nodes make a search with them worth its while."""

_ENDS, _FAR, _POLISHED = 12, 100, 4
"""Ends of a search with few nodes that are followed with a few more, for how many iterations; and how many of them are
then followed with all nodes."""

_GAP = 15.0
"""Objective above the best end's from which on only the `_DISTINCT` best are followed, and none is polished: little is
to be won there."""

_NEAR = 0.1
"""Difference of scaled means from which on ends of equal objectives are followed apart: they may be two that tie."""


class _Tangents(Simulator):
    """A simulator's tangents at the parameter values at which it was last linearised.

    Values come as ``(*batch, B, nodes, d)`` for the B points of the linearisation; each number of nodes (those of a
    quadrature, those of a sample) has tangents of its own.
    """

    def __init__(self, simulator: Simulator, columns: Sequence[int]) -> None:
        self.simulator = simulator
        self.parameters = simulator.parameters
        self.degree = None  # no plane holds everywhere
        self.columns = list(columns)
        self.known: dict[int, tuple[Tensor, Tensor, Tensor]] = {}

    def at(self, x: Conditions, outputs: Sequence[str] | None = None) -> Callable[[Tensor], Tensor]:
        """The tangents at fixed conditions, made at the first call after `forget`."""

        def evaluate(values: Tensor) -> Tensor:
            nodes = values.shape[-2]
            if nodes not in self.known:
                base = values.detach().to(device="cpu", dtype=torch.float64)
                found = self.simulator.linearise(x, base.flatten(0, -2), outputs, self.columns)
                y = found.y.reshape(*base.shape[:-1], -1)
                slope = found.jacobian.reshape(*y.shape, len(self.columns))
                self.known[nodes] = (base.to(values), y.to(values), slope.to(values))
            base, y, slope = self.known[nodes]
            offset = (values - base)[..., self.columns]
            ahead = offset.reshape(-1, *offset.shape[-3:]).permute(1, 2, 0, 3)  # (B, nodes, batch, columns)
            moved = (ahead @ slope.transpose(-1, -2)).permute(2, 0, 1, 3)
            return y + moved.reshape(*offset.shape[:-1], -1)

        return evaluate

    def forget(self) -> None:
        """Linearise anew at the next call."""
        self.known.clear()


class _Plane(Simulator):
    """A simulator's tangent plane at one point, for any values."""

    def __init__(self, simulator: Simulator, point: Tensor) -> None:
        self.simulator = simulator
        self.parameters = simulator.parameters
        self.degree = 1
        self.point = point

    def at(self, x: Conditions, outputs: Sequence[str] | None = None) -> Callable[[Tensor], Tensor]:
        """The plane at fixed conditions."""
        found = self.simulator.linearise(x, self.point[None], outputs)
        y, slope = found.y[0], found.jacobian[0]
        return lambda values: y.to(values) + (values - self.point.to(values)) @ slope.T.to(values)


def search(
    objective: Objective,
    propagate: NISP,
    starts: Tensor,
    leading: Tensor,
    *,
    progress: Callable[[int, Tensor], None] | None = None,
) -> Minima:
    """Minimise from every start on the tangent plane at one point, then with the model from where those ended.

    Args:
        objective: Of a propagation and points ``(*batch, P)``, ``(*batch,)``.
        propagate: The propagation.
        starts: ``(S, P)``.
        leading: Scaled parameters at which the plane touches, ``(d,)``.
        progress: Called with the iteration and the values so far.

    Returns:
        One row for each start: those that end in one point on the plane end in one point of the model. All but the
        `_DISTINCT` best points on the plane are given up, with the value +inf.
    """
    point = propagate.with_held(propagate.scaling.physical(leading.detach())).to(device="cpu", dtype=torch.float64)
    plane = propagate.copy(simulator=_Plane(propagate.simulator, point))
    rough = minimise(lambda u: objective(plane, u), starts, max_iterations=30, tolerance=1e-6, progress=progress)
    apart = rough.values.diff() > _SAME * (1 + rough.values[1:].abs())
    group = torch.cat([torch.zeros_like(apart[:1], dtype=torch.long), apart.cumsum(0)])
    first = torch.cat([torch.ones_like(apart[:1]), apart])
    begin = torch.cat([rough.points[first][:_DISTINCT], starts[:1]])
    points, values, iterations = _iterate(objective, propagate, begin, _ROUGH, 1e-7, progress)
    best = values.argsort(stable=True)
    best = best[torch.isfinite(values[best])]
    apart = values[best].diff() > _SAME * (1 + values[best][1:].abs())
    place = torch.cat([torch.zeros_like(best[:1]), apart.cumsum(0)])
    followed = torch.zeros_like(values, dtype=torch.bool).index_copy(0, best, place < _FINISHED)
    best = best[torch.cat([torch.ones_like(best[:1], dtype=torch.bool), apart])][:_FINISHED]
    for row in best.tolist():
        # What the tangents leave out, the model's curvature times its error, makes the end of the way slow.
        end = minimise(lambda u: objective(propagate, u), points[row : row + 1], progress=progress)
        points[row], values[row] = end.points[0], end.values[0]
    kept = group < len(begin) - 1
    ends = rough.points.clone()
    results = torch.full_like(rough.values, torch.inf)
    ends[kept], results[kept] = points[group[kept]], values[group[kept]]
    arrived = kept.index_put((kept,), followed[group[kept]])
    if bool(values[-1] < results.min()):  # the plane led astray
        ends[-1], results[-1], arrived[-1] = points[-1], values[-1], True
    order = results.argsort(stable=True)
    return Minima(ends[order], results[order], rough.iterations + iterations, given_up=int((~arrived).sum()))


def few_nodes(propagate: NISP) -> NISP | None:
    """The same propagation with the fewest nodes that see every coefficient; None where those are hardly fewer."""
    count, germs = max(propagate.pattern.order, propagate.order or 1) + 1, propagate.pattern.num_germs
    if germs == 0 or _FEWER * count**germs > propagate.num_evaluations:
        return None
    return propagate.copy(rule=count)


def pieces(propagate: NISP, outputs: int) -> int | None:
    """Points whose objective is taken at once; None for all, as for simulators with much to do for each call."""
    if propagate.nodes.device.type != "cpu" or propagate.simulator.dear:
        return None
    return max(1, _PIECE // (propagate.num_evaluations * outputs))


def search_with_few_nodes(
    objective: Objective,
    propagate: NISP,
    coarse: NISP,
    starts: Tensor,
    outputs: int,
    *,
    alpha: Callable[[Tensor], Tensor],
    places: Tensor,
    progress: Callable[[int, Tensor], None] | None = None,
) -> Minima | None:
    """Minimise with few nodes from every start, then with more of them from the best of where those ended.

    Near a minimum the densities are narrow, and one node more for each germ than the coarse rule has all but settles
    the moments there. On the whole rule, the objective of interest, the Hessians with few nodes serve again for the
    step or two that are left.

    Args:
        objective: Of a propagation and points ``(*batch, P)``, ``(*batch,)``.
        propagate: The propagation.
        coarse: The same with fewer nodes.
        starts: ``(S, P)``.
        outputs: Number of outputs n.
        alpha: From points ``(S, P)`` to coefficients ``(S, num_alpha)``.
        places: Columns of the means.
        progress: Called with the iteration and the values so far.

    Returns:
        One row for each start: those that end in one point with few nodes end in one point with all of them. None where
        few nodes lead astray: the outermost of all of them reach values that the model does not bear.
    """

    def of(model: NISP) -> Callable[[Tensor], Tensor]:
        return lambda u: objective(model, u)

    rough = minimise(
        of(coarse),
        starts,
        max_iterations=30,
        tolerance=1e-6,
        piece=pieces(coarse, outputs),
        places=places,
        progress=progress,
    )
    if not bool(torch.isfinite(rough.values[0])):
        return None
    group = _told_apart(rough.values, alpha(rough.points)[:, places])
    first = torch.stack([(group == number).nonzero()[0, 0] for number in range(int(group.max()) + 1)])
    points = rough.points[first]
    middle = coarse.copy(rule=coarse.rule_choice.size + 1)
    piece = pieces(middle, outputs)
    values = finite_values(of(middle), points, piece=piece)
    order = values.argsort(stable=True)
    near = values[order] <= values[order[0]] + _GAP
    near[:_DISTINCT] = True
    iterations = rough.iterations
    for row in order[near & torch.isfinite(values[order])][:_ENDS].tolist():
        end = minimise(of(middle), points[row : row + 1], max_iterations=_FAR, piece=piece, progress=progress)
        points[row], values[row] = end.points[0], end.values[0]
        iterations = max(iterations, rough.iterations + end.iterations)
    piece, promised = pieces(propagate, outputs), values.argmin()
    values = finite_values(of(propagate), points, piece=piece)
    if not bool(torch.isfinite(values[promised])):
        return None
    order = values.argsort(stable=True)
    best = order[values[order] <= values[order[0]] + _GAP]
    same = _told_apart(values[best], alpha(points[best])[:, places])
    for number in range(min(int(same.max()) + 1, _POLISHED)):
        rows = best[same == number]
        end = minimise(of(propagate), points[rows[:1]], piece=piece, curvature=of(middle), progress=progress)
        points[rows], values[rows] = end.points[0], end.values[0]
    rows = (values == values.min()).nonzero()[:, 0]
    end = minimise(of(propagate), points[rows[:1]], piece=piece, progress=progress)  # most often one step, of no gain
    points[rows], values[rows] = end.points[0], end.values[0]
    ends, results = points[group], torch.where(torch.isfinite(rough.values), values[group], torch.inf)
    order = results.argsort(stable=True)
    return Minima(ends[order], results[order], iterations)


def minimise_by_tangents(
    objective: Objective,
    propagate: NISP,
    starts: Tensor,
    *,
    max_iterations: int = 100,
    tolerance: float = 1e-10,
    progress: Callable[[int, Tensor], None] | None = None,
) -> Minima:
    """Minimise from every start at once, as `torchcal.inference.newton.minimise` does, with far fewer model calls.

    At each point the model is linearised at every node. Newton's method runs on the objective of these tangents,
    within a trust region; then the model itself is tried at shares of the way, and the best is kept. What is exact in
    the objective (its kinks and its behaviour at zero spread) stays exact; a model that is linear takes one iteration.

    Args:
        objective: Of a propagation and points ``(*batch, P)``, ``(*batch,)``.
        propagate: The propagation.
        starts: ``(S, P)``.
        max_iterations: Most iterations.
        tolerance: A start is done when one whole step, or three iterations in a row, gain less than this, relative to
            the objective plus one.
        progress: Called with the iteration and the values so far.
    """
    points, values, iterations = _iterate(objective, propagate, starts, max_iterations, tolerance, progress)
    order = values.argsort(stable=True)
    return Minima(points[order], values[order], iterations)


def _iterate(
    objective: Objective,
    propagate: NISP,
    starts: Tensor,
    max_iterations: int,
    tolerance: float,
    progress: Callable[[int, Tensor], None] | None,
) -> tuple[Tensor, Tensor, int]:
    """Points and values in the order of the starts, and the number of iterations."""
    simulator, free = propagate.simulator, propagate.pattern.names
    tangents = _Tangents(simulator, [i for i, name in enumerate(simulator.names) if name in free])
    tangent = propagate.copy(simulator=tangents, max_elements=2**62)
    points = starts.detach().clone()
    with torch.no_grad():
        values = torch.nan_to_num(objective(propagate, points), nan=torch.inf, posinf=torch.inf)
    stalls = torch.zeros(len(points), dtype=torch.long, device=points.device)
    active = torch.isfinite(values)
    leader = torch.arange(len(points), device=points.device)
    radius = torch.ones_like(values)
    with torch.no_grad():
        numbers = tangent.num_evaluations * propagate.mean(points[:1, : propagate.num_alpha]).shape[-1]
    most = max(1, _ELEMENTS // (max(26, 2 * points.shape[1]) * numbers))
    iteration = 0
    for iteration in range(1, max_iterations + 1):
        rows = active.nonzero()[:, 0]
        if not len(rows):
            break
        for group in rows.split(most):
            tangents.forget()
            here = points[group]
            with torch.enable_grad():
                objective(tangent, here)
            ahead = _descend(lambda u: objective(tangent, u), here, radius[group])
            step = ahead - here
            shares = torch.tensor(_SHARES, dtype=step.dtype, device=step.device)[:, None]
            with torch.no_grad():
                tries = here + shares[..., None] * step
                found = torch.nan_to_num(objective(propagate, tries), nan=torch.inf, posinf=torch.inf)
            best, which = found.min(0)
            gain = values[group] - best
            better = gain > 0
            points[group[better]] = tries[which, torch.arange(len(group))][better]
            small = gain <= tolerance * (1 + values[group].abs())
            values[group[better]] = best[better]
            whole = better & (which == 0)
            stalls[group] = torch.where(small, stalls[group] + 1 + 2 * whole, 0)
            active[group] = stalls[group] < 3
            length = step.norm(dim=-1)
            share = torch.where(better, shares[:, 0][which], 0.1 * _SHARES[-1])
            radius[group] = torch.where(whole, torch.maximum(radius[group], 2 * length), 1.5 * share * length)
        radius = radius.clamp(1e-12, 1e6)
        if iteration % 4 == 0:
            join(values, active, leader)
        if progress is not None:
            progress(iteration, values)
    for _ in range(len(points)):  # a leader may itself have joined another
        leader = leader[leader]
    return points[leader], values[leader], iteration


def _descend(objective: Callable[[Tensor], Tensor], here: Tensor, radius: Tensor) -> Tensor:
    """The best point found within a radius of each point ``(B, P)``; objective ``(*batch, B, P) -> (*batch, B)``."""
    at = here
    with torch.no_grad():
        value = torch.nan_to_num(objective(at), nan=torch.inf, posinf=torch.inf)
    total = torch.zeros_like(value)
    for _ in range(_INNER):
        tries = at[:, None] + directions(gradient(objective, at)[1], hessian(objective, at))
        offset = tries - here[:, None]
        length = offset.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        tries = here[:, None] + offset * (radius[:, None, None] / length).clamp_max(1.0)
        with torch.no_grad():
            found = torch.nan_to_num(objective(tries.transpose(0, 1)), nan=torch.inf, posinf=torch.inf)
        best, which = found.min(0)
        gain = (value - best).clamp_min(0)
        chosen = tries[torch.arange(len(tries)), which]
        at = torch.where((best < value)[:, None], chosen, at)
        value = torch.minimum(value, best)
        total = total + gain
        if bool((gain <= 0.1 * total + 1e-13 * (1 + value.abs())).all()):
            break
    return at


def _told_apart(values: Tensor, means: Tensor) -> Tensor:
    """The group of each of sorted values ``(S,)``: of those before it that are equal and whose means are near."""
    group = torch.arange(len(values), device=values.device)
    for i in range(1, len(values)):
        same = values[i] - values[:i] <= _SAME * (1 + values[i].abs())
        same = same & ((means[i] - means[:i]).abs() <= _NEAR).all(-1)
        if bool(same.any()):
            group[i] = group[same.nonzero()[0, 0]]
    return group.unique(return_inverse=True)[1]
