"""Separate maxima of the posterior, as normal approximations with weights."""

import torch
from torch import Tensor

from torchcal.inference.coordinates import Laplace
from torchcal.inference.estimate import Estimate
from torchcal.inference.newton import gradient, hessian, minimise
from torchcal.inference.tangent import pieces
from torchcal.models import Problem

__all__ = ["laplace", "modes_of"]

LEAST_WEIGHT = 1e-3
"""Share of the posterior from which on a mode is told."""

MOST_MODES = 6
"""Ends of starts, away from the maxima that are known, that are looked at."""

BETWEEN, LEVEL = 9, 0.01
"""Points of a straight line between two maxima, ends included, and the difference in log-posterior along it up to which
it is level."""

DIP, HALVINGS = 0.5, 6
"""How much lower the log-posterior may be half-way between two places of one ridge that are near each other; and how
often the way is halved until they are."""


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

    A straight one keeps its height between them. A bent one does along a curve: the middle of the straight line,
    brought up to the maximum next to it, is another place of it, and the nearer two are, the less the line between them
    dips. Between separate ones it dips as deep however near the places are otherwise.
    """
    transform = problem.prior.transform
    share = torch.linspace(0, 1, BETWEEN).to(one)[:, None]
    with torch.no_grad():
        line = one + share * (other - one)
        heights = problem.log_prob(line)
    if not abs(float(heights[-1] - heights[0])) <= LEVEL:
        return False
    if bool(((heights - heights[0]).abs() <= LEVEL).all()):
        return True

    def objective(u: Tensor) -> Tensor:
        return -problem.log_prob(transform.bound(u))

    piece = pieces(problem.propagate, len(problem.y))

    def connected(first: Tensor, last: Tensor, halvings: int) -> bool:
        middle = 0.5 * (first + last)
        with torch.no_grad():
            if float(problem.log_prob(middle)) >= float(heights[0]) - DIP:
                return True
        if not halvings:
            return False
        top = minimise(objective, transform.unbound(middle)[None], piece=piece)
        if not abs(float(-top.values[0] - heights[0])) <= LEVEL:
            return False
        between = transform.bound(top.points[0])
        return connected(first, between, halvings - 1) and connected(between, last, halvings - 1)

    return connected(one, other, HALVINGS)


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
