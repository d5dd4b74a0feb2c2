"""How likely the data are under a hypothesis with the noise that suits it best.

Noise of unknown size or correlation and physics that is left out are two explanations of one residual. No hypothesis is
judged by the noise that another one needs: each has its own, and the data decide between the pairs.
"""

import dataclasses
import itertools
import math

import torch
from torch import Tensor

from torchcal.discovery.channels import channels
from torchcal.discovery.fitting import Fitted, refit, weighed
from torchcal.discovery.noise import GRID, LEAST, SHRINK, Noise, estimate, least, mine
from torchcal.discovery.problem import Whitening
from torchcal.discovery.structure import Residual, evidences

__all__ = ["alone", "log_likelihood", "settled", "with_unknown"]

#: Places in `GRID` of the coefficients that are tried beside something unknown, and how often for every output.
TRIED, ROUNDS = (0, 8, 16, 24, 30, 36), 2
#: Shares of the noise sd beyond smooth curves that are tried where there are several conditions: these curves may not
#: bend as much there as what is unknown.
SMALLER = (1.0, 0.75, 0.5, 0.35, 0.25)

#: Places in `GRID` and in `SMALLER`, by output.
_Places = tuple[tuple[int, ...], tuple[int, ...]]


def log_likelihood(found: Fitted, noise: Noise) -> float:
    """Of the data by a fit under a noise model, the log prior of its correlation included."""
    w = noise.whitening(found.problem)
    return _log_density(w, w.vector(found.residual), noise)


def _log_density(w: Whitening, e: Tensor, noise: Noise) -> float:
    size = 0.5 * float(torch.log1p(-w.correlation.square()).sum()) + float(w.sd.log().sum())
    return -size - 0.5 * float(e.square().sum()) - SHRINK * float(noise.correlation.sum())


def alone(found: Fitted, noise: Noise) -> tuple[Noise, float]:
    """The likeliest noise of a model that leaves nothing else, and the log-likelihood with it.

    Args:
        found: The model's fit.
        noise: Estimated before; it says what is known.
    """
    problem = found.problem
    if noise.source == "replicates":
        return noise, log_likelihood(found, noise)
    unit = torch.ones_like(noise.sd) if noise.open else noise.sd
    squares, logs = [], []
    for rho in GRID:
        w = problem.whitening(unit, torch.full_like(noise.correlation, float(rho)))
        squares.append(w.vector(found.residual).square())
        logs.append(0.5 * torch.log1p(-w.correlation.square()))
    sd, correlation, posterior = noise.sd.clone(), noise.correlation.clone(), noise.posterior.clone()
    least_freedom = math.inf
    for output in range(len(correlation)):
        here = problem.output_of == output
        n = int(here.sum())
        if n == 0:
            continue
        square = torch.stack([part[here].sum() for part in squares])
        freedom = n * (1 - len(found.free) / problem.n)
        size = (square / freedom).clamp_min(1e-300) if noise.open else torch.ones_like(square)
        logs_here = torch.stack([part[here].sum() for part in logs])
        like = -logs_here - 0.5 * square / size - 0.5 * n * size.log() - SHRINK * GRID
        if n < LEAST:
            like[1:] = -math.inf
        best = int(like.argmax())
        posterior[output] = (like - like[best]).exp() / (like - like[best]).exp().sum()
        correlation[output] = GRID[best]
        if noise.open:
            sd[mine(problem, output)] = size[best].sqrt()
            least_freedom = min(least_freedom, freedom)
    if noise.open:
        sd = torch.maximum(sd, least(problem, noise.step))
        noise = dataclasses.replace(noise, freedom=least_freedom)
    fresh = dataclasses.replace(noise, sd=sd, correlation=correlation, posterior=posterior)
    return fresh, log_likelihood(found, fresh)


def settled(found: Fitted, noise: Noise) -> tuple[Noise, float]:
    """The same with the model fitted again under that noise."""
    fresh, _ = alone(found, noise)
    return alone(refit(found, fresh.whitening(found.problem)), noise)


def with_unknown(model: Fitted, given: Tensor | str | None) -> tuple[Noise, float]:
    """The likeliest noise beside a model and something smooth and unknown, and the log evidence of the two.

    Args:
        model: The model's fit.
        given: As ``recording.noise``.
    """
    noise = estimate(model.problem, model.residual, model.jacobian, given)
    problem = model.problem
    available = [c for c in channels(problem, model) if c.kind in problem.kinds]
    found: dict[_Places, tuple[Noise, float]] = {}

    def evidence(at: _Places) -> float:
        if at not in found:
            tried = _at(model, noise, *at)
            residual = Residual(weighed(model, tried.whitening(problem)), tried, draws=0)
            seen = evidences(residual, available)
            gain = max(seen) - math.log(len(seen)) if seen else -math.inf
            found[at] = tried, _log_density(residual.found.whitening, residual.e, tried) + gain
        return found[at][1]

    factors = range(len(SMALLER) if noise.open and problem.order is None else 1)
    places = tuple(int((GRID - rho).abs().argmin()) for rho in noise.correlation)
    best = places, (0,) * len(places)
    evidence(best)
    for _ in range(ROUNDS if noise.source != "replicates" else 0):
        before = best
        for k, n in enumerate(torch.bincount(problem.output_of, minlength=len(places)).tolist()):
            rhos = {best[0][k], *TRIED} if n >= LEAST else {best[0][k]}
            wanted = itertools.product(rhos, factors if n else (0,))
            best = max((_with(best, k, *one) for one in wanted), key=evidence)
        if best == before:
            break
    return found[best]


def _with(at: _Places, k: int, rho: int, factor: int) -> _Places:
    """Another coefficient and size of output k."""
    return (*at[0][:k], rho, *at[0][k + 1 :]), (*at[1][:k], factor, *at[1][k + 1 :])


def _at(model: Fitted, noise: Noise, places: tuple[int, ...], smaller: tuple[int, ...]) -> Noise:
    """The noise model at other coefficients, by their places in `GRID`, and sizes, by those in `SMALLER`."""
    correlation = GRID[list(places)]
    sd = noise.sd.clone()
    if noise.open:
        for output, (place, factor) in enumerate(zip(places, smaller, strict=True)):
            here = mine(model.problem, output)
            if correlation[output] != noise.correlation[output]:
                sd[here] = noise.sizes[output, place]
            sd[here] *= SMALLER[factor]
        sd = torch.maximum(sd, least(model.problem, noise.step))
    return dataclasses.replace(noise, sd=sd, correlation=correlation)
