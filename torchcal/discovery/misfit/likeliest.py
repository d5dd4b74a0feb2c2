"""How likely the data are under a hypothesis with the noise that suits it best.

Noise of unknown size or correlation and physics that is left out are two explanations of one residual. No hypothesis is
judged by the noise that another one needs: each has its own, and the data decide between the pairs.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted, refit, weighed
from torchcal.discovery.fits.problem import Problem, Whitening
from torchcal.discovery.misfit.channels import channels
from torchcal.discovery.misfit.curves import orthonormal
from torchcal.discovery.misfit.noise import GRID, LEAST, Noise, estimate, least, log_prior, mine, slack
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.misfit.steps import sudden_changes
from torchcal.discovery.misfit.structure import Rough, evidences, responses_of, together_of

__all__ = ["Tangents", "alone", "density", "log_likelihood", "settled", "with_unknown"]

#: Places in `GRID` of the coefficients that are tried beside something unknown, and how often for every output.
TRIED, ROUNDS = (0, 8, 16, 24, 30, 36), 2
#: Waves and sudden changes that are taken out of what is left, one after another.
ROUGH = 4
#: Shares of the noise sd beyond smooth curves that are tried where there are several conditions: these curves may not
#: bend as much there as what is unknown.
SMALLER = (1.0, 0.75, 0.5, 0.35, 0.25)
#: Times that runs share from which on what they differ by there tells of the noise, and by how much less it must be.
SHARED, LESS = 6, 0.9

#: Places in `GRID` and among the shares of the sd that are tried, by output.
_Places = tuple[tuple[int, ...], tuple[int, ...]]


@dataclass(frozen=True, eq=False)
class Tangents:
    """Directions in which the base can move the data, which every likelihood is integrated over.

    Fits are normal in all parameters: what integrating does is a determinant, and that of the base's tangents alone
    differs from noise to noise for every hypothesis alike.

    Attributes:
        directions: Orthonormal, ``(n, r)``.
        grams: Of the whitened directions within each output, for noise of unit size (or of the size that is given) and
            each coefficient in `GRID`, ``(outputs, grid, r, r)``.
        logs: Half the log determinant of the noise's correlation, ``(outputs, grid)``.
    """

    directions: Tensor
    grams: Tensor
    logs: Tensor

    @classmethod
    def of(cls, base: Fitted, noise: Noise) -> "Tangents":
        """Of the base's fit."""
        slope = orthonormal(base.jacobian[:, ~base.at_bound], cut=1e-7)
        problem, outputs, unit = base.problem, len(noise.correlation), _unit(noise)
        parts = [problem.output_of == k for k in range(outputs)]
        grams, logs = [], []
        for memory in _memories(outputs):  # one by one: all at once they are 39 times as large
            w = problem.whitening(unit, memory)
            white, half = w(slope), 0.5 * torch.log1p(-w.correlation.square())
            grams.append(torch.stack([white[part].T @ white[part] for part in parts]))
            logs.append(torch.stack([half[part].sum() for part in parts]))
        return cls(slope, torch.stack(grams, 1), torch.stack(logs, 1))


def _counts(problem: Problem) -> Tensor:
    """Used data of every output, ``(outputs,)``."""
    return torch.bincount(problem.output_of, minlength=len(problem.recording.outputs)).double()


def _freedom(found: Fitted) -> Tensor:
    """Degrees of freedom of every output, ``(outputs,)``."""
    return (_counts(found.problem) * (1 - len(found.free) / found.problem.n)).clamp_min(1.0)


def _memories(outputs: int) -> Tensor:
    """Those of `GRID`, of every output alike, ``(grid, outputs)``."""
    return GRID[:, None].expand(-1, outputs)


def _unit(noise: Noise) -> Tensor:
    return noise.unit if noise.open else noise.sd


def log_likelihood(found: Fitted, noise: Noise, tangents: Tangents) -> float:
    """Of the data by a fit under a noise model, the base's parameters integrated out.

    The log prior of the correlation is included.
    """
    w = noise.whitening(found.problem)
    return _log_density(w, w.vector(found.residual), noise, tangents, found.problem)


def _log_density(w: Whitening, e: Tensor, noise: Noise, tangents: Tangents, problem: Problem) -> float:
    found = log_normal(w, e) + float(log_prior(noise.correlation, _counts(problem)).sum())
    if tangents.directions.shape[1]:
        found -= float(torch.linalg.qr(w(tangents.directions)).R.diagonal().abs().log().sum())
    return found


def density(found: Fitted, w: Whitening) -> float:
    """Log density of the data with a fit and a noise, without the constant of 2π."""
    return log_normal(w, w.vector(found.residual))


def log_normal(w: Whitening, e: Tensor) -> float:
    """Log density of data by their whitened residual ``(n,)``, without the constant of 2π."""
    size = 0.5 * float(torch.log1p(-w.correlation.square()).sum()) + float(w.sd.log().sum())
    return -size - 0.5 * float(e.square().sum())


def alone(found: Fitted, noise: Noise, tangents: Tangents) -> tuple[Noise, float]:
    """The likeliest noise of a model that leaves nothing else, and the log-likelihood with it.

    Args:
        found: The model's fit.
        noise: Estimated before; it says what is known.
        tangents: The base's.
    """
    problem = found.problem
    if noise.source == "replicates":
        return noise, log_likelihood(found, noise, tangents)
    unit, outputs = _unit(noise), len(noise.correlation)
    squares = problem.whitening(unit, _memories(outputs)).vector(found.residual).square()
    count = _counts(problem)
    freedom = _freedom(found)
    square = torch.stack([squares[:, problem.output_of == k].sum(1) for k in range(outputs)])  # (outputs, grid)
    sizes = (square / freedom[:, None]).clamp_min(1e-300) if noise.open else torch.ones_like(square)
    blocks = tangents.grams / sizes[:, :, None, None]
    best = [int((GRID - rho).abs().argmin()) for rho in noise.correlation]
    posterior = noise.posterior.clone()
    for k in range(outputs):
        if not count[k]:
            continue
        others = torch.zeros_like(blocks[0, 0])
        for j in range(outputs):
            others = others + blocks[j, best[j]] if j != k else others
        like = log_prior(GRID, count[k]) - tangents.logs[k]
        like = like - 0.5 * count[k] * sizes[k].log() - 0.5 * square[k] / sizes[k]
        like = like - 0.5 * torch.linalg.slogdet(others + blocks[k])[1]
        if noise.source == "given":
            like = like + slack(freedom[k], square[k] / freedom[k])
        if count[k] < LEAST or problem.sweeps is None:
            like[1:] = -math.inf
        best[k] = int(like.argmax())
        posterior[k] = (like - like[best[k]]).exp() / (like - like[best[k]]).exp().sum()
    sd, correlation = noise.sd.clone(), noise.correlation.clone()
    for k in range(outputs):
        if count[k]:
            correlation[k] = GRID[best[k]]
            if noise.open:
                here = mine(problem, k)
                sd[here] = sizes[k, best[k]].sqrt() * unit[here]
    if noise.open:
        sd = torch.maximum(sd, least(problem, noise.step, unit))
        noise = dataclasses.replace(noise, freedom=torch.where(count > 0, freedom, math.inf))
    fresh = dataclasses.replace(noise, sd=sd, correlation=correlation, posterior=posterior)
    return fresh, log_likelihood(found, fresh, tangents)


def settled(found: Fitted, noise: Noise, tangents: Tangents) -> tuple[Noise, float]:
    """The same with the model fitted again under that noise."""
    fresh, _ = alone(found, noise, tangents)
    return alone(refit(found, fresh.whitening(found.problem)), noise, tangents)


def with_unknown(
    model: Fitted, given: Tensor | str | None, tangents: Tangents, unit: Tensor
) -> tuple[Noise, float]:
    """The likeliest noise beside a model and something unknown, and the log evidence of the two.

    That is smooth, a wave, a step or a bump.

    Args:
        model: The model's fit.
        given: As ``recording.noise``.
        tangents: The base's.
        unit: Of unknown noise, as in `Noise`.
    """
    problem = model.problem
    available = [c for c in channels(problem, model) if c.kind in problem.kinds]
    looks = [*responses_of(problem, available), *together_of(problem, available)]
    sudden = sudden_changes(problem, available)

    def likeliest(peeled: list[Fitted], taken: list[Rough]) -> tuple[Noise, float, Rough | None]:
        """Beside what is unknown, and the waves and sudden changes taken out so far, near what is estimated without."""
        noise = estimate(problem, peeled[-1].residual, model.jacobian, given, unit)
        found: dict[_Places, tuple[Noise, float, Rough | None]] = {}
        smaller = torch.zeros_like(noise.sizes)
        if noise.source == "given":
            smaller = slack(_freedom(model)[:, None], noise.sizes.square())

        def evidence(at: _Places) -> float:
            """By which one is chosen: a noise that is given may be smaller."""
            if at not in found:
                tried = _at(model, noise, *at, shares)
                w = tried.whitening(problem)
                residuals = [Residual(weighed(one, w), tried, draws=0) for one in peeled]
                seen, rough = evidences(residuals[-1], looks, available, sudden)
                gain = max(seen) - math.log(len(seen)) if seen else -math.inf
                gain += sum(
                    _credit(one, before, after)
                    for one, (before, after) in zip(taken, itertools.pairwise(residuals), strict=True)
                )
                gain -= len(taken) * math.log(2 * len(places))  # a wave or a sudden change of any output
                like = _log_density(w, residuals[0].e, tried, tangents, problem)
                found[at] = tried, like + gain, rough
            return found[at][1] + float(smaller[range(len(places)), list(at[0])].sum())

        shares = _shares(problem, noise, peeled[-1].residual)
        places = tuple(int((GRID - rho).abs().argmin()) for rho in noise.correlation)
        best = places, (0,) * len(places)
        evidence(best)
        for _ in range(ROUNDS if noise.source != "replicates" else 0):
            before = best
            for k, n in enumerate(torch.bincount(problem.output_of, minlength=len(places)).tolist()):
                rhos = {best[0][k], *TRIED} if n >= LEAST and problem.sweeps is not None else {best[0][k]}
                wanted = itertools.product(rhos, range(len(shares[k])) if n else (0,))
                best = max((_with(best, k, *one) for one in wanted), key=evidence)
            if best == before:
                break
        return found[best]

    peeled, taken = [model], list[Rough]()
    noise, evidence, rough = likeliest(peeled, taken)
    while rough is not None and len(taken) < ROUGH:  # no noise is estimated from these
        peeled.append(dataclasses.replace(peeled[-1], y=peeled[-1].y + rough.curve))
        taken.append(rough)
        fresh, more, rough = likeliest(peeled, taken)
        if more <= evidence:
            break
        noise, evidence = fresh, more
    return noise, evidence


def _credit(one: Rough, before: Residual, after: Residual) -> float:
    """Log evidence of a wave or a sudden change under some noise, at most what it removes there as it was taken out
    under another one: beside that, what is left is judged."""
    return min(one.evidence(before), 0.5 * float(before.e.square().sum() - after.e.square().sum()))


def _with(at: _Places, k: int, rho: int, factor: int) -> _Places:
    """Another coefficient and size of output k."""
    return (*at[0][:k], rho, *at[0][k + 1 :]), (*at[1][:k], factor, *at[1][k + 1 :])


def _shares(problem: Problem, noise: Noise, residual: Tensor) -> list[Tensor]:
    """Shares of the sd beyond smooth curves that are tried with each coefficient in `GRID`, by output ``(m, grid)``,
    the whole first.

    What is unknown may be quicker than these curves. Where runs share their times it may be the same in all of them,
    and noise is what they differ by.
    """
    whole, found = torch.ones(1, len(GRID), dtype=torch.float64), []
    for k in range(len(noise.correlation)):
        shares = whole
        if noise.open and problem.order is None:
            shares = torch.tensor(SMALLER, dtype=torch.float64)[:, None] * whole
        elif noise.open and (size := _between_runs(problem, noise, residual, k)) is not None:
            shares = torch.cat([whole, size / noise.sizes[k].clamp_min(1e-300)[None]])
        found.append(shares)
    return found


def _between_runs(problem: Problem, noise: Noise, residual: Tensor, output: int) -> float | None:
    """Noise sd of an output by what its runs differ by at the times that they share, where that is less than its sd."""
    own = problem.output_of == output
    if not problem.in_time or len(problem.recorded_of(output)) < 2:
        return None
    at = problem.order[problem.condition_of[own]]  # type: ignore[index]
    times, which, count = at.unique(return_inverse=True, return_counts=True)
    n = int(own.sum())
    if len(times) < SHARED or n < 2 * len(times):
        return None
    unit = noise.unit[problem.index[own]]
    size = residual[own] / unit
    mean = torch.zeros(len(times), dtype=torch.float64).index_add_(0, which, size) / count
    within = math.sqrt(float((size - mean[which]).square().sum()) / (n - len(times)))
    return within if 0 < within < LESS * float((noise.sd[problem.index[own]] / unit).median()) else None


def _at(
    model: Fitted, noise: Noise, places: tuple[int, ...], smaller: tuple[int, ...], shares: Sequence[Tensor]
) -> Noise:
    """The noise model at other coefficients, by their places in `GRID`, and sizes, by those in ``shares``."""
    correlation = GRID[list(places)]
    sd, posterior = noise.sd.clone(), noise.posterior.clone()
    for output, (place, factor) in enumerate(zip(places, smaller, strict=True)):
        here, other = mine(model.problem, output), correlation[output] != noise.correlation[output]
        if other:
            posterior[output] = (torch.arange(len(GRID)) == place).to(posterior)
        if noise.open:
            size = noise.sizes[output, place] * noise.unit[here] if other else sd[here]
            sd[here] = shares[output][factor, place] * size
    if noise.open:
        sd = torch.maximum(sd, least(model.problem, noise.step, noise.unit))
    return dataclasses.replace(noise, sd=sd, correlation=correlation, posterior=posterior)
