"""Minimisation from many starts at once, as one batched tensor program."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Minima", "directions", "finite_values", "gradient", "hessian", "join", "minimise"]

Objective = Callable[[Tensor], Tensor]
"""``(*batch, P) -> (*batch,)``."""

_STEP = 1e-5
"""Central-difference step of the Hessian in scaled coordinates: gradients are good to 1e-12, so the
Hessian is good to 1e-7 of its largest entry, and Newton steps need no more."""

_SAME, _NEAR = 1e-8, 0.1
"""Relative difference of two objectives, and difference of the coordinates that count, below which two starts are taken
to be in one basin."""

_ROUND = 6
"""Iterations after which the worse half of the starts is given up where they are dear."""

_LADDER = [0.0, 1e-12, 1e-10, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 1e3]
"""Dampings, relative to the largest curvature."""

_LENGTHS = [2.0, 4.0, 0.5, 0.25]
"""Of undamped steps."""

_ALONG = [1e-3, 1e-2, 1e-1, 0.5]
"""Steps along the most negative curvature, either way."""


@dataclass(frozen=True)
class Minima:
    """Where each start ended, best first.

    Attributes:
        points: ``(S, P)``.
        values: Objective there, ``(S,)``; +inf where it was never finite.
        iterations: Iterations of the longest run.
        given_up: Starts that were left on the way for better ones, and have ended nowhere.
    """

    points: Tensor
    values: Tensor
    iterations: int
    given_up: int = 0


def gradient(objective: Objective, points: Tensor, *, piece: int | None = None) -> tuple[Tensor, Tensor]:
    """Values ``(*batch,)`` and gradients ``(*batch, P)``; what is not finite becomes +inf and 0.

    Of points ``(B, P)`` a ``piece`` is taken at once.
    """
    if piece is not None and len(points) > piece:
        parts = [gradient(objective, block) for block in points.split(piece)]
        return torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])
    leaf = points.detach().requires_grad_(True)
    with torch.enable_grad():
        values = objective(leaf)
        (slope,) = torch.autograd.grad(values.sum(), leaf)
    values = torch.nan_to_num(values.detach(), nan=torch.inf)
    good = torch.isfinite(values) & torch.isfinite(slope).all(-1)
    return torch.where(good, values, torch.inf), torch.where(good[..., None], slope, 0.0)


def hessian(objective: Objective, points: Tensor, *, step: float = _STEP, piece: int | None = None) -> Tensor:
    """Hessians ``(B, P, P)`` by central differences of the gradient.

    The objective gets all points in one batch ``(2, P, B, P)``, or ``(B, P)`` piece by piece.
    """
    length = step * points.abs().clamp_min(1.0)  # coordinates that are not scaled yet may be large
    shift = torch.diag_embed(length).transpose(0, 1)
    both = torch.stack([points + shift, points - shift])
    if piece is None:
        slopes = gradient(objective, both)[1]
    else:
        slopes = gradient(objective, both.flatten(0, 2), piece=piece)[1].reshape(both.shape)
    result = ((slopes[0] - slopes[1]) / (2 * length.T[..., None])).transpose(0, 1)
    return 0.5 * (result + result.transpose(-1, -2))


def finite_values(objective: Objective, points: Tensor, *, piece: int | None = None) -> Tensor:
    """Values ``(B,)`` without gradients, ``piece`` points at once; what is not finite becomes +inf."""
    with torch.no_grad():
        values = torch.cat([objective(block) for block in points.split(piece or max(1, len(points)))])
    return torch.nan_to_num(values, nan=torch.inf, posinf=torch.inf)


def minimise(
    objective: Objective,
    starts: Tensor,
    *,
    max_iterations: int = 200,
    tolerance: float = 1e-10,
    keep: int | None = None,
    piece: int | None = None,
    curvature: Objective | None = None,
    places: Tensor | None = None,
    progress: Callable[[int, Tensor], None] | None = None,
) -> Minima:
    r"""Damped Newton steps with absolute curvatures, from every start at once.

    With the Hessian :math:`H = Q \Lambda Q^T` each iteration tries the steps
    :math:`-Q (|\Lambda| + \mu)^{-1} Q^T g` for a ladder of dampings μ, longer steps for flat valleys, and both
    directions of a negative curvature (a germ's column leaves zero spread along one), and keeps the best.

    Args:
        objective: ``(*batch, P) -> (*batch,)``, differentiable.
        starts: ``(S, P)``.
        max_iterations: Most iterations.
        tolerance: A start is done when three iterations in a row gain less than this, relative to the objective plus
            one: log-densities differ by nothing that matters then.
        keep: For dear objectives: every six iterations the worse half of the starts still under way is left where it
            is, until so many are.
        piece: Points whose objective is taken at once; all of them by default.
        curvature: A cheaper objective to take Hessians of, close to this one.
        places: Coordinates in which two minima of the same height are two; without them one start finishes for all
            that are equally high.
        progress: Called with the iteration and the values so far.
    """
    points = starts.detach().clone()
    size = points.shape[1]
    values = finite_values(objective, points, piece=piece)
    stalls = torch.zeros(len(points), dtype=torch.long, device=points.device)
    active = torch.isfinite(values)
    leader = torch.arange(len(points), device=points.device)
    left = torch.zeros_like(active)
    iteration = 0
    for iteration in range(1, max_iterations + 1):
        rows = active.nonzero()[:, 0]
        if not len(rows):
            break
        here = points[rows]
        _, slope = gradient(objective, here, piece=piece)
        bend = hessian(objective if curvature is None else curvature, here, piece=piece)
        tries = here[:, None] + directions(slope, bend)
        found = finite_values(objective, tries.reshape(-1, size), piece=piece).reshape(tries.shape[:2])
        best, which = found.min(1)
        gain = values[rows] - best
        better = gain > 0
        points[rows[better]] = tries[better.nonzero()[:, 0], which[better]]
        small = gain <= tolerance * (1 + values[rows].abs())
        values[rows[better]] = best[better]
        stalls[rows] = torch.where(small, stalls[rows] + 1, 0)
        active[rows] = (stalls[rows] < 3) & (better | (stalls[rows] < 1))
        if iteration % 4 == 0:
            join(values, active, leader, None if places is None else points[:, places])
        if keep is not None and iteration % _ROUND == 0:
            rows = active.nonzero()[:, 0]
            worse = rows[values[rows].argsort()[max(keep, -(-len(rows) // 2)) :]]
            active[worse], left[worse] = False, True
        if progress is not None:
            progress(iteration, values)
    for _ in range(len(points)):  # a leader may itself have joined another
        leader = leader[leader]
    points, values = points[leader], values[leader]
    order = values.argsort(stable=True)
    return Minima(points[order], values[order], iteration, given_up=int(left[leader].sum()))


def directions(slope: Tensor, curvature: Tensor) -> Tensor:
    """Steps to try, ``(B, 26, P)``, for gradients ``(B, P)`` and Hessians ``(B, P, P)``; see `minimise`."""
    ladder = slope.new_tensor(_LADDER)
    lengths = slope.new_tensor([1.0] * len(_LADDER) + _LENGTHS)
    ladder = torch.cat([ladder, ladder.new_zeros(len(_LENGTHS))])
    along = slope.new_tensor(_ALONG)
    along = torch.cat([along, -along])
    values, vectors = torch.linalg.eigh(torch.nan_to_num(curvature))
    top = values.abs().amax(-1).clamp_min(1e-300)[:, None, None]
    weight = values.abs()[:, None, :] + ladder[:, None] * top + 1e-15 * top
    rotated = torch.einsum("bij,bi->bj", vectors, slope)
    steps = -torch.einsum("bij,bcj->bci", vectors, rotated[:, None] / weight) * lengths[:, None]
    down = torch.where(values[:, :1] < 0, 1.0, 0.0)[..., None] * vectors[:, :, 0][:, None]
    return torch.cat([steps, along[:, None] * down], dim=1)


def join(values: Tensor, active: Tensor, leader: Tensor, where: Tensor | None = None) -> None:
    """Starts whose objectives agree, and which are near each other, run towards one minimum: let the best finish."""
    rows = active.nonzero()[:, 0]
    if len(rows) < 2:
        return
    rows = rows[values[rows].argsort()]
    here = values[rows]
    same = here[:, None] - here <= _SAME * (1 + here.abs())
    if where is not None:
        same &= (where[rows][:, None] - where[rows]).abs().amax(-1) <= _NEAR
    first = same.to(torch.uint8).argmax(1)  # of those that are as good, the best: itself where there is no better one
    leader[rows] = rows[first]
    active[rows[first < torch.arange(len(rows), device=rows.device)]] = False
