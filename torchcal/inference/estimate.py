"""The maximum a posteriori from many starts, and directions that the data do not see."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchcal.display import PATIENCE
from torchcal.errors import ConvergenceError, ConvergenceWarning, IdentifiabilityWarning, SimulatorError, warn
from torchcal.inference.newton import Minima, hessian, minimise
from torchcal.inference.starts import check_starts, starting_points
from torchcal.inference.tangent import few_nodes, pieces, search, search_with_few_nodes
from torchcal.models import Problem
from torchcal.propagation import NISP
from torchcal.propagation.convergence import SETTLED
from torchcal.results.in_time import NODE_TOLERANCE
from torchcal.simulators import Trajectories

__all__ = ["SAME_MEANS", "Estimate", "maximise"]

NULL_CURVATURE = 1e-7
"""Curvature, relative to the largest, below which a direction counts as not seen by the data. The differences
behind the Hessian are good to about 1e-9 of its largest entry."""

AGREEMENT = 1e-6
"""Relative difference of objectives up to which two starts count as the same maximum."""

MODE_GAP = 15.0
"""Log-posterior below the best from which on a maximum is not worth a chain, unless it is a million times wider."""

DEAR, MOST_KEPT = 1_000_000, 8
"""Numbers that one gradient of all starts handles from which on the search begins with few quadrature nodes; where it
cannot, the worse starts are given up, and how many are not."""

MOST_REFINED = 4
"""Times that the quadrature is made finer for the best minimum."""

SAME_MEANS = 1e-3
"""Difference of scaled means up to which two starts ended at one maximum."""

QUADRATIC, FARTHEST = 0.5, 1e5
"""Relative difference of a fall from what a curvature says, one and two standard deviations away, up to which it is
one; and how many scaled units away these are at most: farther off, differences of large numbers are rounding."""

FAR, FORTH, LONGER = 30.0, 0.3, 1.5
"""Sizes of the parameters, or scaled units, along a ridge of maxima from which on it has no end; the part of a step
along it that must be gone; and how much longer the next step is."""


@dataclass(frozen=True)
class Estimate:
    """The best of many starts.

    Attributes:
        alpha: MAP, ``(P,)``.
        objective: Negative log-likelihood there.
        posterior_objective: Negative log-posterior there, what was minimised.
        starts: Number of starts.
        agreeing: Number of starts that reached the best objective.
        ties: Number of different densities of λ that reach it: a symmetry of model and data makes more than one.
        null_directions: Unit vectors in α along which the log-posterior does not change, ``(k, P)``.
        improper: Those of them that no bounds hold either, or whose spread is as free; or those of an endless ridge.
        others: Where the other starts ended, if not far below the best, ``(k, P)``.
    """

    alpha: Tensor
    objective: float
    posterior_objective: float
    starts: int
    agreeing: int
    ties: int
    null_directions: Tensor
    improper: tuple[str, ...]
    others: Tensor


def maximise(
    problem: Problem,
    leading: Tensor,
    *,
    starts: Tensor | None,
    num_starts: int,
    seed: int,
    progress: bool = False,
) -> Estimate:
    """Maximise the posterior of α.

    Args:
        problem: What to maximise.
        leading: Least-squares estimate of the scaled parameters, where the means start, ``(d,)``.
        starts: A user's own starting points ``(S, P)``, or None.
        num_starts: Number of starting points made otherwise.
        seed: Of the starting points.
        progress: Whether to show a bar.

    Raises:
        ConvergenceError: If the posterior is not finite at any start.

    Warns:
        ConvergenceWarning: If fewer than two starts of many reached the best objective.
    """
    starts = check_starts(problem, starts)
    if starts is None:
        starts = starting_points(problem, leading.to(problem.propagate.nodes), num_starts, seed)
    with tqdm(desc="maximum", unit="step", disable=not progress, delay=PATIENCE, leave=False) as bar:

        def show(_iteration: int, values: Tensor) -> None:
            bar.update(1)
            bar.set_postfix(objective=f"{float(values.min()):.6g}", refresh=False)

        found = _searched(problem, starts, leading, show)
        if not bool(torch.isfinite(found.values[0])):
            raise ConvergenceError(
                f"Expected a finite posterior at some starting point. Got none at {len(starts)}. Check the "
                "simulator over the parameters' ranges, or pass starts=."
            )
        agreeing, ends, given_up = _agreeing(found), found.values, found.given_up
        found = _refined(problem, found, show)
    best, ties = _first_of_the_tied(problem, found)
    if agreeing < 2 <= len(ends):
        warn(_lonely(problem, ends, given_up), ConvergenceWarning)
    curvature = _curvature(problem, best)
    null = _flat_directions(problem, best, curvature)
    unseen = _unseen_means(problem, best, curvature)
    if unseen:
        warn(
            f"The data do not determine {', '.join(unseen)}. Hold a parameter with fixed=, give a proper prior, or "
            "record conditions in which it matters.",
            IdentifiabilityWarning,
        )
    together, middle, along = ((), best, null) if unseen else _ridge(problem, found, best, null)
    if together:
        warn(
            f"The data determine {', '.join(together)} only together: other values of them give the same maximum, as "
            "where a model has nothing but their product. Hold one of them with fixed=, or give a proper prior.",
            IdentifiabilityWarning,
        )
    with torch.no_grad():
        likelihood = float(problem.log_likelihood(best))
    return Estimate(
        alpha=best,
        objective=-likelihood,
        posterior_objective=float(found.values[0]),
        starts=len(ends),
        agreeing=agreeing,
        ties=ties,
        null_directions=null,
        improper=_unheld(problem, unseen) or _endless(problem, middle, along, together),
        others=problem.prior.transform.bound(found.points[found.values - found.values[0] < MODE_GAP]),
    )


def _searched(problem: Problem, starts: Tensor, leading: Tensor, show: Callable[[int, Tensor], None]) -> Minima:
    """Where the starts ``(S, P)`` end, by the way that suits the problem: a cheaper one finds no minimum at times."""
    propagate, transform, outputs = problem.propagate, problem.prior.transform, len(problem.y)
    objective = _objective(problem)
    begin = transform.unbound(starts)
    places = propagate.pattern.leading.nonzero()[:, 0].to(begin.device)
    dear = propagate.num_evaluations * outputs * begin.numel() > DEAR
    found: Minima | None = None
    if propagate.simulator.dear:
        if len(begin) > 2:
            found = search(objective, propagate, begin, leading, progress=show)
    elif dear and problem.likelihood.needs != "samples" and (coarse := few_nodes(propagate)) is not None:
        found = search_with_few_nodes(
            objective, propagate, coarse, begin, outputs,
            alpha=lambda u: transform.bound(u)[..., : propagate.num_alpha], places=places, progress=show,
        )  # fmt: skip
    if found is not None:
        return found
    piece = pieces(propagate, outputs)
    return minimise(
        lambda u: objective(propagate, u),
        begin,
        keep=MOST_KEPT if dear else None,
        piece=piece,
        places=places,
        progress=show,
    )


def _refined(problem: Problem, found: Minima, show: Callable[[int, Tensor], None]) -> Minima:
    """The minima with as many quadrature nodes as the best one needs: with more of them it may move."""
    propagate, transform = problem.propagate, problem.prior.transform
    if not propagate.pattern.num_germs or propagate.rule_choice.asked:
        return found
    objective, total = _objective(problem), len(found.values)
    in_time = isinstance(propagate.simulator, Trajectories)
    places = propagate.pattern.leading.nonzero()[:, 0].to(found.points.device)
    for _ in range(MOST_REFINED):
        best = transform.bound(found.points[:1])[..., : propagate.num_alpha]
        if not propagate.refine(best, tolerance=NODE_TOLERANCE if in_time else SETTLED):
            break
        points = found.points[torch.isfinite(found.values)]
        different = (points.diff(dim=0) != 0).any(-1)  # those that joined are one
        points = torch.cat([points[:1], points[1:][different]])[: 1 if in_time else max(4, total // 4)]
        piece = pieces(propagate, len(problem.y))
        found = minimise(lambda u: objective(propagate, u), points, piece=piece, places=places, progress=show)
    return found


def _objective(problem: Problem) -> Callable[[NISP, Tensor], Tensor]:
    """The negative log-posterior in unbounded coordinates, for any propagation in place of the problem's."""

    def objective(propagate: NISP, u: Tensor) -> Tensor:
        other = dataclasses.replace(problem, propagate=propagate)
        return -other.log_prob(problem.prior.transform.bound(u))

    return objective


def _curvature(problem: Problem, alpha: Tensor) -> Tensor:
    """Of the negative log-posterior, ``(P, P)``."""
    piece = pieces(problem.propagate, len(problem.y))
    return torch.nan_to_num(hessian(lambda a: -problem.log_prob(a), _inside(problem, alpha)[None], piece=piece)[0])


def _flat_directions(problem: Problem, alpha: Tensor, curvature: Tensor) -> Tensor:
    """Unit vectors ``(k, P)`` along which there is none at a point.

    Flat beside the steepest direction and flat in itself: at a spike every other direction is only the former.
    """
    values, vectors = torch.linalg.eigh(curvature)
    top = float(values.abs().max().clamp_min(1e-300))
    flat = vectors.T[values.abs() <= min(NULL_CURVATURE * top, max(1.0, 1e-9 * top))]
    return flat[[not _bends(problem, alpha, direction, curvature) for direction in flat]]


def _bends(problem: Problem, alpha: Tensor, direction: Tensor, curvature: Tensor) -> bool:
    """Whether the log-posterior falls along a direction ``(P,)`` as its curvature says, small as it may be.

    Intercept and slope of a line that is seen far from its origin make up for each other over many scaled units.
    """
    own = direction @ curvature @ direction
    if not float(own) > FARTHEST**-2:
        return False
    sizes = torch.tensor([1.0, 2.0], dtype=alpha.dtype, device=alpha.device)
    steps = (sizes / own.sqrt())[:, None] * direction
    try:
        with torch.no_grad():  # both ways: so far away a gradient of rounding counts
            fall = problem.log_prob(alpha) - 0.5 * (problem.log_prob(alpha + steps) + problem.log_prob(alpha - steps))
    except SimulatorError:  # it may work near its best values alone
        return False
    return bool(((fall / (0.5 * sizes.square()) - 1).abs() < QUADRATIC).all())


def _unseen_means(problem: Problem, alpha: Tensor, curvature: Tensor) -> tuple[str, ...]:
    """Parameters whose means can move by one scaled unit at no cost.

    Curvatures alone would not do: at a spike of the density every other direction looks flat beside it.
    """
    pattern = problem.propagate.pattern
    rows = pattern.leading.nonzero()[:, 0].to(alpha.device)
    values, vectors = torch.linalg.eigh(curvature[rows][:, rows])
    flat = vectors.T[values.abs() <= NULL_CURVATURE * values.abs().max().clamp_min(1e-300)]
    names: list[str] = []
    with torch.no_grad():
        here = problem.log_likelihood(alpha)
        for direction in flat:
            step = torch.zeros_like(alpha)
            step[rows] = direction
            there = problem.log_likelihood(torch.stack([alpha + step, alpha - step, alpha + 10 * step]))
            level = bool(((there - here).abs() <= 1e-6 * (1 + here.abs())).all())
            if level and not _bends(problem, alpha, step, curvature):
                names += [name for name, part in zip(pattern.names, direction.abs(), strict=True) if part > 0.1]
    return tuple(dict.fromkeys(names))


def _ridge(problem: Problem, found: Minima, best: Tensor, null: Tensor) -> tuple[tuple[str, ...], Tensor, Tensor]:
    """Parameters that are known together alone, if any; the point ``(P,)`` of their ridge where its flat directions
    ``(k, P)`` tell so, and these: in the middle of it, or, as it may be bent, at ``best``, where they are ``null``."""
    middle = _middle_of_the_tied(problem, found, best)
    if middle is not best:
        along = _flat_directions(problem, middle, _curvature(problem, middle))
        if together := _known_together(problem, found, middle, along):
            return together, middle, along
    return _known_together(problem, found, best, null), best, null


def _known_together(problem: Problem, found: Minima, point: Tensor, null: Tensor) -> tuple[str, ...]:
    """Parameters whose means differ between maxima of the same objective that a flat direction of means joins.

    Such a ridge may be bent, so that no straight step along it is free. Where all starts ended at one point of it, or
    were given up for the one that did, another is sought a step away.
    """
    rows = problem.propagate.pattern.leading.nonzero()[:, 0].to(null.device)
    flat = (null[:, rows].abs() > SAME_MEANS).any(0)
    if int(flat.sum()) < 2:
        return ()
    means = _tied(problem, found)[:, rows]
    if not bool((means.amax(0) - means.amin(0) > SAME_MEANS).any()):
        along = _along_means(null, rows)
        ahead = (_ahead(problem, point, sign * along, 1.0) for sign in (1.0, -1.0))  # one way may lead out of bounds
        means = torch.stack([point, next((there for there in ahead if there is not None), point)])[:, rows]
    apart = flat & (means.amax(0) - means.amin(0) > SAME_MEANS)
    names = [name for name, far in zip(problem.propagate.pattern.names, apart.tolist(), strict=True) if far]
    return tuple(names) if len(names) > 1 else ()


def _along_means(null: Tensor, rows: Tensor) -> Tensor:
    """The means' part of the flat direction that has most of them, ``(P,)``."""
    means = torch.zeros_like(null).index_copy(1, rows, null[:, rows])
    return torch.linalg.svd(means, full_matrices=False).Vh[0]


def _ahead(problem: Problem, point: Tensor, along: Tensor, step: float) -> Tensor | None:
    """The maximum that is found from a step along a ridge; None where it is lower, or the way back to where it began.

    Args:
        problem: Of which ``point`` is a maximum.
        point: ``(P,)``.
        along: The direction ``(P,)``, of means alone.
        step: Its length.
    """
    objective, piece = _objective(problem), pieces(problem.propagate, len(problem.y))
    rows = problem.propagate.pattern.leading.nonzero()[:, 0].to(point.device)
    start = point + step * along / along.norm()
    start = torch.maximum(torch.minimum(start, problem.prior.high), problem.prior.low)
    found = minimise(
        lambda u: objective(problem.propagate, u), problem.prior.transform.unbound(start[None]), piece=piece
    )
    there = problem.prior.transform.bound(found.points)[0]
    highest = -float(problem.log_prob(point).detach())
    lower = float(found.values[0]) > highest + AGREEMENT * (1 + abs(highest))
    return None if lower or float((there - point)[rows].norm()) < FORTH * step else there


def _endless(problem: Problem, point: Tensor, null: Tensor, together: tuple[str, ...]) -> tuple[str, ...]:
    """Parameters that are known together alone, where the ridge of their maxima goes on far beyond the scale.

    One that is closed, as where a model has the sum of two squares, has a finite integral.
    """
    if not together or len(_unheld(problem, together)) < len(together):
        return ()
    scaling = problem.propagate.scaling
    rows = problem.propagate.pattern.leading.nonzero()[:, 0].to(null.device)
    size = (scaling.physical(point[rows]) / scaling.scale.to(point))[~scaling.log.to(point.device)]
    far = FAR * max(1.0, float(size.norm()))
    begin = _along_means(null, rows)
    for sign in (1.0, -1.0):
        here, along, step = point, sign * begin, 1.0
        while float((here - point)[rows].norm()) < far:
            ahead = _ahead(problem, here, along, step)
            if ahead is None:
                break
            along = torch.zeros_like(point).index_copy(0, rows, (ahead - here)[rows])
            here, step = ahead, LONGER * step
        else:
            return together
    return ()


def _unheld(problem: Problem, unseen: tuple[str, ...]) -> tuple[str, ...]:
    if problem.prior.proper:
        return ()
    bounded = {p.name for p in problem.propagate.free if p.low is not None and p.high is not None}
    plain = bounded - set(problem.propagate.pattern.embedded)
    return tuple(name for name in unseen if name not in plain)


def _lonely(problem: Problem, ends: Tensor, given_up: int) -> str:
    """What to say of a best objective that one start alone reached, of those whose ``ends`` came best first."""
    best, followed = float(ends[0]), len(ends) - given_up
    others = f"{given_up} other{'s were' if given_up > 1 else ' was'} given up on the way, behind it"
    if followed < 2:
        told = f"Only 1 of {len(ends)} starts was followed to the end, to the objective {best:.6g}; the {others}."
    else:
        of = f"{followed} starts that were followed to the end" if given_up else f"{followed} starts"
        second = float(ends[1])
        then = f"the next ended at {second:.6g}" if math.isfinite(second) else "no other ended at a finite one"
        told = f"Only 1 of {of} reached the best objective {best:.6g}; {then}"
        told += f", and {others}." if given_up else "."
    # A dear model's starts meet on its tangents: more of them end at the same few points.
    more = "" if problem.propagate.simulator.dear else "Raise num_starts=, or give "
    more = f"{more or 'Give '}the parameters bounds or initial= near their values."
    return f"{told} The maximum may not be the global one. {more}"


def _agreeing(found: Minima) -> int:
    scale = 1 + float(found.values[0].abs())
    return int((found.values - found.values[0] <= AGREEMENT * scale).sum())


def _tied(problem: Problem, found: Minima) -> Tensor:
    """α of the starts that ended at the best objective, ``(S, P)``."""
    tied = found.points[found.values - found.values[0] <= 1e-9 * (1 + found.values[0].abs())]
    return problem.prior.transform.bound(tied)


def _first_of_the_tied(problem: Problem, found: Minima) -> tuple[Tensor, int]:
    """One of the densities that tie for the best objective, the same from any seed, and how many there are.

    The tie is broken by the larger mean of the first parameter in which they differ.
    """
    propagate = problem.propagate
    alpha = _tied(problem, found)
    means = alpha[:, : propagate.num_alpha][:, propagate.pattern.leading]
    best, different = 0, [0]
    for i in range(1, len(means)):
        if all(bool(((means[i] - means[j]).abs() > SAME_MEANS).any()) for j in different):
            different.append(i)
        apart = ((means[i] - means[best]).abs() > SAME_MEANS).nonzero()
        if len(apart) and bool(means[i, apart[0, 0]] > means[best, apart[0, 0]]):
            best = i
    return alpha[best], len(different)


def _middle_of_the_tied(problem: Problem, found: Minima, best: Tensor) -> Tensor:
    """Of the densities that tie for the best objective, the one nearest the middle of the scales, ``(P,)``.

    At a bound, or far out, a ridge on which they lie is hard to see in the curvature. ``best`` itself where it is one.
    """
    rows = problem.propagate.pattern.leading.nonzero()[:, 0].to(best.device)
    alpha = _tied(problem, found)
    middle = alpha[alpha[:, rows].norm(dim=-1).argmin()]
    return middle if float((middle - best)[rows].abs().max()) > SAME_MEANS else best


def _inside(problem: Problem, alpha: Tensor) -> Tensor:
    """A point far enough from the bounds to take differences at."""
    low, high = problem.prior.low, problem.prior.high
    margin = 2e-5 * alpha.abs().clamp_min(1.0)
    return torch.maximum(torch.minimum(alpha, high - margin), low + margin)
