"""The maximum a posteriori from many starts, its curvature, and directions that the data do not see."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchcal.display import PATIENCE
from torchcal.errors import ConvergenceError, ConvergenceWarning, IdentifiabilityWarning, ShapeError, warn
from torchcal.inference.coordinates import Laplace
from torchcal.inference.newton import Minima, gradient, hessian, minimise
from torchcal.inference.randomness import preserve_random_state
from torchcal.inference.tangent import few_nodes, pieces, search, search_with_few_nodes
from torchcal.models import Problem
from torchcal.propagation import NISP
from torchcal.propagation.convergence import SETTLED
from torchcal.results.in_time import NODE_TOLERANCE
from torchcal.simulators import Trajectories

__all__ = ["Estimate", "check_starts", "laplace", "maximise", "modes_of"]

NULL_CURVATURE = 1e-7
"""Curvature, relative to the largest, below which a direction counts as not seen by the data. The differences
behind the Hessian are good to about 1e-9 of its largest entry."""

AGREEMENT = 1e-6
"""Relative difference of objectives up to which two starts count as the same maximum."""

MODE_GAP = 15.0
"""Log-posterior below the best from which on a maximum is not worth a chain, unless it is a million times wider."""

LEAST_WEIGHT = 1e-3
"""Share of the posterior from which on a mode is told."""

MOST_MODES = 6
"""Ends of starts, away from the maxima that are known, that are looked at."""

DEAR, MOST_KEPT = 1_000_000, 8
"""Numbers that one gradient of all starts handles from which on the search begins with few quadrature nodes; where it
cannot, the worse starts are given up, and how many are not."""

SAME_MEANS = 1e-3
"""Difference of scaled means up to which two starts ended at one maximum."""


BETWEEN, LEVEL = 9, 0.01
"""Points of a straight line between two maxima, ends included, and the difference in log-posterior along it up to which
it is level."""


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
        improper: Those of them that no bounds hold either, or whose spread is as free.
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
    like = problem.propagate.nodes
    transform = problem.prior.transform
    starts = check_starts(problem, starts)
    if starts is None:
        starts = _starting_points(problem, leading.to(like), num_starts, seed)

    in_time = isinstance(problem.propagate.simulator, Trajectories)
    with tqdm(desc="maximum", unit="step", disable=not progress, delay=PATIENCE, leave=False) as bar:

        def show(_iteration: int, values: Tensor) -> None:
            bar.update(1)
            bar.set_postfix(objective=f"{float(values.min()):.6g}", refresh=False)

        def coefficients(points: Tensor) -> Tensor:
            return transform.bound(points)[..., : problem.propagate.num_alpha]

        objective = _objective(problem)
        begin = transform.unbound(starts)
        outputs = len(problem.y)
        cost = problem.propagate.num_evaluations * outputs * begin.numel()
        places = problem.propagate.pattern.leading.nonzero()[:, 0].to(begin.device)
        coarse = few_nodes(problem.propagate) if cost > DEAR and problem.likelihood.needs != "samples" else None
        found: Minima | None = None
        if in_time and len(begin) > 2:
            found = search(objective, problem.propagate, begin, leading, progress=show)
        elif not in_time and coarse is not None:
            found = search_with_few_nodes(
                objective, problem.propagate, coarse, begin, outputs, alpha=coefficients, places=places, progress=show
            )
        if found is None:
            found = minimise(
                lambda u: objective(problem.propagate, u),
                begin,
                keep=MOST_KEPT if cost > DEAR else None,
                piece=pieces(problem.propagate, outputs),
                places=places,
                progress=show,
            )
        if not bool(torch.isfinite(found.values[0])):
            raise ConvergenceError(
                f"Expected a finite posterior at some starting point. Got none at {len(starts)}. Check the "
                "simulator over the parameters' ranges, or pass starts=."
            )
        agreeing = _agreeing(found)
        total = len(found.values)
        if problem.propagate.pattern.num_germs:
            for _ in range(4):  # a maximum found with too few nodes may move with more of them
                best = coefficients(found.points[:1])
                if not problem.propagate.refine(best, tolerance=NODE_TOLERANCE if in_time else SETTLED):
                    break
                points = found.points[torch.isfinite(found.values)]
                different = (points.diff(dim=0) != 0).any(-1)  # those that joined are one
                points = torch.cat([points[:1], points[1:][different]])[: 1 if in_time else max(4, total // 4)]
                piece = pieces(problem.propagate, outputs)
                found = minimise(
                    lambda u: objective(problem.propagate, u), points, piece=piece, places=places, progress=show
                )
    best, ties = _first_of_the_tied(problem, found)
    if agreeing < 2 <= len(found.values):
        warn(
            f"Only 1 of {total} starts reached the best objective {float(found.values[0]):.6g}; the next ended at "
            f"{float(found.values[1]):.6g}. The maximum may not be the global one. Raise num_starts=.",
            ConvergenceWarning,
        )
    piece = pieces(problem.propagate, outputs)
    curvature = hessian(lambda a: -problem.log_prob(a), _inside(problem, best)[None], piece=piece)[0]
    values, vectors = torch.linalg.eigh(torch.nan_to_num(curvature))
    top = float(values.abs().max().clamp_min(1e-300))
    # Flat beside the steepest direction and flat in itself: at a spike every other direction is only the former.
    null = vectors.T[values.abs() <= min(NULL_CURVATURE * top, max(1.0, 1e-9 * top))]
    unseen = _unseen_means(problem, best, curvature)
    if unseen:
        warn(
            f"The data do not determine {', '.join(unseen)}. Hold a parameter with fixed=, give a proper prior, or "
            "record conditions in which it matters.",
            IdentifiabilityWarning,
        )
    elif together := _known_together(problem, found, null):
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
        starts=total,
        agreeing=agreeing,
        ties=ties,
        null_directions=null,
        improper=_unheld(problem, unseen),
        others=transform.bound(found.points[found.values - found.values[0] < MODE_GAP]),
    )


def _objective(problem: Problem) -> Callable[[NISP, Tensor], Tensor]:
    """The negative log-posterior in unbounded coordinates, for any propagation in place of the problem's."""

    def objective(propagate: NISP, u: Tensor) -> Tensor:
        other = dataclasses.replace(problem, propagate=propagate)
        return -other.log_prob(problem.prior.transform.bound(u))

    return objective


def _unseen_means(problem: Problem, alpha: Tensor, curvature: Tensor) -> tuple[str, ...]:
    """Parameters whose means can move by one scaled unit at no cost.

    Curvatures alone would not do: at a spike of the density every other direction looks flat beside it.
    """
    pattern = problem.propagate.pattern
    rows = pattern.leading.nonzero()[:, 0].to(alpha.device)
    values, vectors = torch.linalg.eigh(torch.nan_to_num(curvature)[rows][:, rows])
    flat = vectors.T[values.abs() <= NULL_CURVATURE * values.abs().max().clamp_min(1e-300)]
    names: list[str] = []
    with torch.no_grad():
        here = problem.log_likelihood(alpha)
        for direction in flat:
            step = torch.zeros_like(alpha)
            step[rows] = direction
            there = problem.log_likelihood(torch.stack([alpha + step, alpha - step, alpha + 10 * step]))
            if bool(((there - here).abs() <= 1e-6 * (1 + here.abs())).all()):
                names += [name for name, part in zip(pattern.names, direction.abs(), strict=True) if part > 0.1]
    return tuple(dict.fromkeys(names))


def _known_together(problem: Problem, found: Minima, null: Tensor) -> tuple[str, ...]:
    """Parameters whose means differ between maxima of the same objective that a flat direction of means joins.

    Such a ridge may be bent, so that no straight step along it is free.
    """
    rows = problem.propagate.pattern.leading.nonzero()[:, 0].to(null.device)
    flat = (null[:, rows].abs() > SAME_MEANS).any(0)
    means = _tied(problem, found)[:, rows]
    apart = flat & (means.amax(0) - means.amin(0) > SAME_MEANS)
    names = [name for name, far in zip(problem.propagate.pattern.names, apart.tolist(), strict=True) if far]
    return tuple(names) if len(names) > 1 else ()


def _unheld(problem: Problem, unseen: tuple[str, ...]) -> tuple[str, ...]:
    if problem.prior.proper:
        return ()
    bounded = {p.name for p in problem.propagate.free if p.low is not None and p.high is not None}
    plain = bounded - set(problem.propagate.pattern.embedded)
    return tuple(name for name in unseen if name not in plain)


def check_starts(problem: Problem, starts: Tensor | None) -> Tensor | None:
    """A user's starting points as a tensor of the problem's kind, or an error."""
    if starts is None:
        return None
    size = problem.prior.low.shape[0]
    try:
        points = torch.as_tensor(starts).to(problem.propagate.nodes)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ShapeError(f"Expected starts as a tensor of shape (S, {size}). Got {starts!r}.") from error
    if points.ndim != 2 or points.shape[1] != size or not len(points):
        raise ShapeError(f"Expected starts of shape (S, {size}), one column an α. Got {tuple(points.shape)}.")
    return points


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


def _inside(problem: Problem, alpha: Tensor) -> Tensor:
    """A point far enough from the bounds to take differences at."""
    low, high = problem.prior.low, problem.prior.high
    margin = 2e-5 * alpha.abs().clamp_min(1.0)
    return torch.maximum(torch.minimum(alpha, high - margin), low + margin)


def _starting_points(problem: Problem, leading: Tensor, num_starts: int, seed: int) -> Tensor:
    """Half around the least-squares fit and half from the prior, with spreads over two decades."""
    pattern = problem.propagate.pattern
    with preserve_random_state(seed):
        points = problem.prior.sample((num_starts,))
        extra = points.shape[1] - pattern.num_alpha  # ln σ of the additive model
        is_leading = torch.cat([pattern.leading, torch.zeros(extra, dtype=torch.bool)]).to(points.device)
        jitter = 0.1 * torch.randn(num_starts, len(leading)).to(points)
        spread = 10 ** (2 * torch.rand(num_starts, 1).to(points) - 2)
        normal = torch.randn(points.shape).to(points)
    near = torch.arange(num_starts) % 2 == 0
    anchor = leading + jitter
    anchor[0] = leading
    columns = is_leading.nonzero()[:, 0]
    rows = near.nonzero()[:, 0].to(points.device)
    points[rows[:, None], columns] = anchor[rows]
    if extra == 0:
        points = torch.where(is_leading, points, spread * normal)
    low, high = problem.prior.low, problem.prior.high
    inner = 0.01 * torch.where(torch.isfinite(high - low), high - low, torch.ones_like(low))
    return torch.maximum(torch.minimum(points, high - inner), low + inner)


def modes_of(problem: Problem, estimate: Estimate) -> list[Laplace]:
    """Normal approximations at the separate maxima that starts have found, best first, weights adding up to one.

    Each weight is the integral of the approximation, density times width. Where an end of a start is no maximum yet (a
    long flat valley), or is one of the others seen through a reversed germ, it does not count.
    """
    pattern = problem.propagate.pattern
    best, height = laplace(problem, estimate.alpha)
    found, heights = [best], [height]
    ends = estimate.others
    if problem.prior.symmetric and pattern.num_germs:
        ends = pattern.flip(ends, estimate.alpha)

    def objective(u: Tensor) -> Tensor:
        return -problem.log_prob(problem.prior.transform.bound(u)) - problem.prior.transform.log_slope(u)

    ridge = len(estimate.null_directions) > 0
    tried, places = 0, [estimate.alpha]
    for end in ends:
        start = problem.prior.transform.unbound(end)
        if any(_apart(start, mode) < 1 for mode in found) or (ridge and any(_joined(problem, end, p) for p in places)):
            continue
        tried += 1
        if tried > MOST_MODES:
            break
        mode, height = laplace(problem, end)
        slope = gradient(objective, mode.loc[None])[1][0]
        if any(_apart(mode.loc, other) < 1 for other in found) or float((mode.scale_tril.T @ slope).norm()) > 0.1:
            continue
        found.append(mode)
        heights.append(height)
        places.append(end)
    share = torch.tensor(heights, dtype=torch.float64).softmax(0)
    kept = [(mode, float(w)) for mode, w in zip(found, share, strict=True) if mode is best or w >= LEAST_WEIGHT]
    total = sum(w for _, w in kept)
    return [Laplace(mode.loc, mode.scale_tril, w / total) for mode, w in kept]


def _joined(problem: Problem, one: Tensor, other: Tensor) -> bool:
    """Whether two maxima ``(P,)`` are places of one ridge that the data do not see along.

    A straight one keeps its height between them; along a bent one the density of λ changes in what the data see nothing
    of, but neither in its mean nor in its covariance.
    """
    propagate = problem.propagate
    share = torch.linspace(0, 1, BETWEEN).to(one)[:, None]
    with torch.no_grad():
        heights = problem.log_prob(one + share * (other - one))
        if not abs(float(heights[-1] - heights[0])) <= LEVEL:
            return False
        if bool(((heights - heights[0]).abs() <= LEVEL).all()):
            return True
        if not propagate.pattern.num_germs:
            return False
        coefficients = torch.stack([one, other])[:, : propagate.num_alpha]
        mean, covariance = (moment.double() for moment in propagate.parameter_moments(coefficients))
    spread = covariance.diagonal(dim1=-2, dim2=-1).amax(0).sqrt()
    unit = torch.maximum(spread, SAME_MEANS * mean.abs().amax(0)).clamp_min(1e-300)
    apart = torch.maximum(
        ((mean[1] - mean[0]) / unit).abs().max(),
        ((covariance[1] - covariance[0]) / unit[:, None] / unit).abs().max(),
    )
    return float(apart) <= SAME_MEANS


def _apart(point: Tensor, mode: Laplace) -> float:
    """Distance from a mode in its own widths."""
    offset = (point - mode.loc)[:, None]
    return float(torch.linalg.solve_triangular(mode.scale_tril, offset, upper=False).norm())


def laplace(problem: Problem, alpha: Tensor) -> tuple[Laplace, float]:
    """The normal approximation at a mode in the sampler's coordinates, which differ from α at bounds only.

    Directions that the data do not see get one unit of scaled coordinates, rather than an infinite width. With it
    comes the logarithm of its integral, up to a constant.
    """
    transform = problem.prior.transform
    loc = transform.unbound(alpha)

    def objective(u: Tensor) -> Tensor:
        return -problem.log_prob(transform.bound(u)) - transform.log_slope(u)

    piece = pieces(problem.propagate, len(problem.y))
    if not transform.free:
        starts = torch.stack([loc, loc.clamp(-4.0, 4.0)])
        loc = minimise(objective, starts, piece=piece).points[0]
    curvature = torch.nan_to_num(hessian(objective, loc[None], piece=piece)[0])
    values, vectors = torch.linalg.eigh(curvature)
    values = values.abs().clamp_min(max(1.0, 1e-12 * float(values.abs().max())))
    covariance = (vectors / values) @ vectors.T
    factor = torch.linalg.cholesky(0.5 * (covariance + covariance.T))
    with torch.no_grad():
        height = -float(objective(loc[None])[0]) + float(factor.diagonal().log().sum())
    return Laplace(loc, factor), height
