"""What is noise and what may be physics: the noise model, from the recording itself where nobody knows it.

Physics moves slowly against the sampling, or along the tangents of the model. Whatever is left beyond a smooth curve
and those tangents is taken for noise, and its size and correlation are estimated by restricted maximum likelihood.
"""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem, Whitening, remembered
from torchcal.discovery.misfit.curves import beyond
from torchcal.discovery.misfit.replicates import replicates
from torchcal.discovery.records import NoiseModel
from torchcal.errors import DomainError

__all__ = [
    "EXCESS", "GRID", "LEAST", "Noise", "decorrelated", "estimate", "least", "log_prior", "mine", "quantisation",
    "slack",
]  # fmt: skip

#: AR(1) coefficients that are tried.
GRID = torch.linspace(0.0, 0.95, 39, dtype=torch.float64)
#: Weights against correlation, in log prior density: of φ, and of the share of a recording that it lasts.
SHRINK, SLOW = 1.0, 20.0
#: Fewest data of an output whose noise may be correlated.
LEAST = 40
#: Posterior probability of the two smallest coefficients below which a correlation is clear, and the quantile of the
#: posterior at which it is taken then.
CLEAR, CAUTION = 0.05, 0.6
#: Smallest noise sd that is estimated, in the output's spread; of noise that grows, where it is largest.
FLOOR = 1e-7
#: Ratio of the largest to the smallest sd of an output from which on both are told.
VARIES = 1.05
#: How much larger the noise found may be than the noise given before the given one is doubted.
EXCESS = 1.1


@dataclass(frozen=True, eq=False)
class Noise:
    """A noise model of the used data.

    Attributes:
        sd: ``(n_total,)``.
        correlation: AR(1) coefficient by output, ``(outputs,)``.
        freedom: Degrees of freedom that the size was estimated with, by output, ``(outputs,)``; infinite where it is
            known.
        posterior: Probability of each coefficient in `GRID`, by output, ``(outputs, grid)``.
        source: As in `NoiseModel`.
        sizes: Noise sd at each coefficient in `GRID`, by output, ``(outputs, grid)``; of a known noise, in its sd; of
            an unknown one, in `unit`.
        excess: How many times the noise given the residual's fastest part is, of the outputs where that is a
            contradiction.
        step: As in `NoiseModel`.
        unit: Of unknown noise, its sd in units of its median, ``(n_total,)``; see `growth`.
        log_density: Of what it was estimated from, with the prior of the correlation, up to a constant.
    """

    sd: Tensor
    correlation: Tensor
    freedom: Tensor
    posterior: Tensor
    source: str
    sizes: Tensor
    excess: dict[str, float] = dataclasses.field(default_factory=dict)
    step: dict[str, float] = dataclasses.field(default_factory=dict)
    unit: Tensor = dataclasses.field(default_factory=lambda: torch.ones(()))
    log_density: float = 0.0

    @property
    def open(self) -> bool:
        """Whether its size is neither given nor known from replicates."""
        return self.source == "estimated"

    def whitening(self, problem: Problem) -> Whitening:
        """Of a problem's residuals."""
        return problem.whitening(self.sd, self.correlation)

    def record(self, problem: Problem) -> NoiseModel:
        """For the result."""
        names = problem.recording.outputs
        used = problem.recording.split(torch.where(problem.recording.observed, self.sd, math.nan))
        used = {name: values[torch.isfinite(values)] for name, values in used.items()}
        ends = {name: (float(values.min()), float(values.max())) for name, values in used.items() if len(values)}
        return NoiseModel(
            sd={name: float(values.median()) if len(values) else math.nan for name, values in used.items()},
            range={name: (low, high) for name, (low, high) in ends.items() if high > VARIES * low},
            correlation={name: float(c) for name, c in zip(names, self.correlation, strict=True)},
            source=self.source,
            outliers=int((problem.recording.observed_once & ~problem.keep).sum()),
            quantisation=self.step,
            memory=("sample" if problem.by_sample else "time") if problem.uneven and self.correlation.any() else "",
        )


def log_prior(rho: Tensor, n: Tensor | float) -> Tensor:
    """Of AR(1) coefficients of n data, up to a constant.

    Noise that is correlated over 1/ln(1/φ) data, a good part of them, looks like physics, and is the less likely.
    """
    return -SHRINK * rho + SLOW / rho.clamp_min(1e-9).log() / torch.as_tensor(n).clamp_min(1)


def slack(count: Tensor | float, square: Tensor | float) -> Tensor:
    """What the largest log density of so many data, with noise of a size up to the one that is given, has beyond that
    of the given one.

    Of noise that is smaller than given a correlation would make up for that: innovations are smaller than the noise.

    Args:
        count: Data, or degrees of freedom.
        square: Their mean square, in units of the variance that is given.
    """
    square = torch.as_tensor(square, dtype=torch.float64).clamp(1e-300, 1.0)
    return -0.5 * count * (square.log() + 1 - square)


def estimate(
    problem: Problem, residual: Tensor, design: Tensor, given: Tensor | str | None, unit: Tensor | None = None
) -> Noise:
    """The noise model from the residual of a fitted model.

    Args:
        problem: The used data.
        residual: ``(n,)``.
        design: Tangents that a further refit could use, ``(n, k)``; what they explain is not noise.
        given: As ``recording.noise``.
        unit: As `growth` found it, where the size is unknown; 1 by default.

    Raises:
        DomainError: If there are too few data to tell noise from anything else.
    """
    recording = problem.recording
    outputs = len(recording.outputs)
    correlation = torch.zeros(outputs, dtype=torch.float64)
    posterior = torch.zeros(outputs, len(GRID), dtype=torch.float64)
    posterior[:, 0] = 1.0
    table = torch.ones(outputs, len(GRID), dtype=torch.float64)
    freedom = torch.full((outputs,), math.inf, dtype=torch.float64)
    if isinstance(given, str):  # a detailed simulation: what counts is the misfit in units of the spread
        sd = recording.spread * 1e-3
        return Noise(sd, correlation, freedom, posterior, "none", table, unit=torch.ones_like(sd))
    unit = torch.ones_like(recording.y) if unit is None else unit
    known = given if isinstance(given, Tensor) else unit
    replicated = replicates(problem) if given is None else None
    sd = known.clone()
    excess: dict[str, float] = {}
    log_density = 0.0
    for output in range(outputs):
        parts = problem.recorded_of(output)
        n = sum(len(places) for places in parts)
        if n == 0:
            continue
        scaled = [residual[places] / known[problem.index[places]] for places in parts]
        bases = [beyond(problem, places, design, known, ends=isinstance(given, Tensor)) for places in parts]
        usable = sum(len(basis) - basis.shape[1] for basis in bases)
        if usable < 2 and given is not None:
            continue
        if usable < 2:
            raise DomainError(
                f"Expected enough data to tell noise from misfit. Got {n} of output {recording.outputs[output]!r}. "
                "Give noise= its standard deviation."
            )
        correlated = n >= LEAST and problem.sweeps is not None and replicated is None
        gaps = [problem.gaps(places) for places in parts]
        logs, sizes = [], []
        for rho in GRID if correlated else GRID[:1]:
            square, log_det, count = 0.0, 0.0, 0
            for places, r, basis, apart in zip(parts, scaled, bases, gaps, strict=True):
                each = remembered(rho, apart)
                e, b = (decorrelated(values, each[:, None]) for values in (r[:, None], basis))
                e = e[:, 0]
                q, upper = torch.linalg.qr(b)
                left = e - q @ (q.T @ e)
                square += float(left.square().sum())
                log_det += 0.5 * float(torch.log1p(-each.square()).sum())
                log_det += float(upper.diagonal().abs().log().sum())
                count += len(places) - b.shape[1]
            sizes.append(square / count)
            if given is None:
                size = 0.5 * count * math.log(max(square, 1e-300))
            else:
                size = 0.5 * square - float(slack(count, square / count))
            logs.append(-size - log_det + float(log_prior(rho, n)))
        likelihood = torch.tensor(logs, dtype=torch.float64)
        log_density += float(likelihood.max())
        weight = (likelihood - likelihood.max()).exp()
        posterior[output, : len(weight)] = weight / weight.sum()
        best = int(likelihood.argmax())
        if float(posterior[output, :2].sum()) < CLEAR:  # too little of it would pass noise off as physics
            best = _cautious(posterior[output])
        correlation[output] = GRID[best]
        scale = math.sqrt(sizes[best])
        mask = mine(problem, output)
        table[output, : len(sizes)] = torch.tensor(sizes, dtype=torch.float64).sqrt()
        if given is None:
            if replicated is not None:
                own = replicated[output]
                size = own.sd(problem, unit)
                if n >= LEAST and problem.sweeps is not None and (told := own.memory(problem, unit, GRID)) is not None:
                    weight = (told[0] + log_prior(GRID, n)).softmax(0)
                    if float(weight[:2].sum()) < CLEAR:  # else they are taken to be independent
                        best = _cautious(weight)
                        correlation[output], posterior[output], size = GRID[best], weight, float(told[1][best])
                sd[mask], freedom[output] = size * unit[mask], own.freedom
            else:
                sd[mask], freedom[output] = scale * unit[mask], usable
        elif scale > EXCESS * (1 + 2 / math.sqrt(2 * usable)):
            excess[recording.outputs[output]] = scale
    step = quantisation(problem) if given is None else {}
    if given is None:
        sd = torch.maximum(sd, least(problem, step, unit))
    source = "given" if isinstance(given, Tensor) else "replicates" if replicated is not None else "estimated"
    return Noise(sd, correlation, freedom, posterior, source, table, excess, step, unit, log_density)


def _cautious(posterior: Tensor) -> int:
    """Place in `GRID` at which a clear correlation is taken, by its posterior ``(grid,)``."""
    return int((posterior.cumsum(0) < CAUTION).sum())


def mine(problem: Problem, output: int) -> Tensor:
    """Which of all data are of an output, bool ``(n_total,)``."""
    return torch.arange(len(problem.recording.y)) // problem.recording.n == output


def least(problem: Problem, step: dict[str, float], unit: Tensor) -> Tensor:
    """Smallest noise sd of all data ``(n_total,)``, in proportion to a unit as that of `Noise`: a perfect fit would
    leave nothing to measure anything in."""
    by_output = unit.expand_as(problem.recording.y).reshape(len(problem.recording.outputs), -1)
    sd = FLOOR * problem.recording.spread * (by_output / by_output.amax(1, keepdim=True)).flatten()
    for name, size in step.items():
        mask = mine(problem, problem.recording.outputs.index(name))
        sd[mask] = sd[mask].clamp_min(size / math.sqrt(12.0))
    return sd


def decorrelated(values: Tensor, rho: Tensor) -> Tensor:
    """Successive values ``(m, k)`` with what follows from the one before, by correlations ``(m - 1, k)``, taken out;
    one column of either goes with all of the other."""
    rest = (values[1:] - rho * values[:-1]) / (1 - rho.square()).sqrt()
    return torch.cat([values[:1].expand(1, rest.shape[1]), rest])


def quantisation(problem: Problem) -> dict[str, float]:
    """Step of each output whose values are few multiples of one number apart."""
    found = {}
    for name, values in problem.recording.split(problem.recording.y).items():
        seen = values[torch.isfinite(values)].unique()
        if len(seen) < 3 or len(seen) > 0.8 * int(torch.isfinite(values).sum()) or len(values) < 20:
            continue
        step, size = float(seen.diff().min()), float(seen.abs().max())
        # 0 °C is no multiple of half a kelvin.
        even = _whole((seen - seen[0]) / step) and (_whole(seen / step) or _round(step))
        if step > 1e-6 * size and even:
            found[name] = step
    return found


def _whole(values: Tensor) -> bool:
    """Whether all are whole numbers, up to rounding."""
    return float((values - values.round()).abs().max()) < 1e-3


def _round(step: float) -> bool:
    """Whether a step has two digits at most, as those of readings have, and of an even row of values hardly any."""
    return abs(step - float(f"{step:.1e}")) < 1e-6 * step
