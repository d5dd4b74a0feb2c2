"""Is there more in a residual than noise, and where does it sit?

The residual of a fit, whitened and projected off the fit's tangent space, is compared with unknown smooth changes of
every channel against every driver, and with oscillations of every output. Probabilities come from simulated noise that
went through the same projection.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.channels import Channel, channels
from torchcal.discovery.fitting import Fitted
from torchcal.discovery.lines import Lines, lines_of
from torchcal.discovery.local import Span
from torchcal.discovery.noise import GRID, Noise, orthonormal, quantisation
from torchcal.discovery.problem import Problem

__all__ = ["Place", "Residual", "Structure", "analyse", "evidences", "responses_of"]

#: Radial functions along time, and along any other driver: the evidence chooses how many.
IN_TIME, ALONG = (12, 24, 48), (12, 24)
#: Of more functions than the fewest, how many data there must be for each, in time and among conditions.
DATA_EACH = (4, 3)
#: Singular values below this share of the largest are none.
SMALL = 1e-6
#: Sizes of an unknown change that are tried, in noise sd.
SIZES = torch.logspace(-0.3, 3.0, 14, dtype=torch.float64)


class Residual:
    """A fit's residual, whitened and projected off its tangents, with draws of what noise alone would leave.

    Args:
        found: The fit.
        noise: The noise model.
        draws: Number of simulated residuals.
        seed: Of the draws.
        without: Places of fitted parameters whose tangents are left in.
    """

    def __init__(
        self, found: Fitted, noise: Noise, *, draws: int = 1000, seed: int = 0, without: Sequence[int] = ()
    ) -> None:
        self.found = found
        self.noise = noise
        w = found.whitening
        mine = torch.tensor([i not in without for i in found.free], dtype=torch.bool)
        tangents = w(found.jacobian[:, mine & ~found.at_bound])
        self.basis = orthonormal(tangents, cut=1e-7)
        self.e = self.project(w.vector(found.residual)[:, None])[:, 0]
        self.freedom = len(self.e) - self.basis.shape[1]
        self.null = self.project(_noise_draws(found, noise, draws, seed))

    def project(self, values: Tensor) -> Tensor:
        """Off the tangent space, ``(n, m)``."""
        return values - self.basis @ (self.basis.T @ values)

    def tangent(self, values: Tensor) -> Tensor:
        """Whitened and projected ``(n, m)``."""
        return self.project(self.found.whitening(values))

    @property
    def excess(self) -> float:
        """Squared misfit beyond noise, never negative."""
        return max(float(self.e.square().sum()) - self.freedom, 0.0)


def _noise_draws(found: Fitted, noise: Noise, draws: int, seed: int) -> Tensor:
    """Whitened noise ``(n, draws)``, as uncertain in size and correlation as the noise model is."""
    generator = torch.Generator().manual_seed(seed + 7919)
    problem, w = found.problem, found.whitening
    if not draws:
        return torch.zeros(problem.n, 0, dtype=torch.float64)
    e = torch.randn(problem.n, draws, generator=generator, dtype=torch.float64)
    if bool((noise.posterior[:, 1:].sum(1) > 1e-3).any()):
        groups = 20
        each = math.ceil(draws / groups)
        for output in range(len(noise.posterior)):
            chosen = torch.multinomial(noise.posterior[output], groups, replacement=True, generator=generator)
            for places in problem.recorded:
                if int(problem.output_of[places[0]]) != output:
                    continue
                rho = GRID[chosen].repeat_interleave(each)[:draws]
                fresh = (1 - rho.square()).sqrt()
                walk = e[places]
                for k in range(1, len(places)):
                    walk[k] = rho * walk[k - 1] + fresh * walk[k]
                e[places] = walk
        unit = w.sd.clone()
        e = w(e * unit[:, None])
    if math.isfinite(noise.freedom):
        half = torch.full((draws,), 0.5 * noise.freedom, dtype=torch.float64)
        chi2 = 2 * torch._standard_gamma(half, generator=generator)
        e = e * (noise.freedom / chi2).sqrt()
    return e


@dataclass(frozen=True, eq=False)
class Place:
    """An unknown change of one channel against one driver: smooth, or an oscillation.

    Attributes:
        channel: Where.
        driver: Against what.
        evidence: Log evidence against no change.
        share: Share of the excess misfit that it removes.
        profile: Estimated change at the channel's points, ``(K,)``.
        sd: Its standard deviation there.
        size: Chosen prior size; of an oscillation its amplitude.
        period: Of an oscillation, in units of the driver; None of a smooth change.
    """

    channel: Channel
    driver: str
    evidence: float
    share: float
    profile: Tensor
    sd: Tensor
    size: float
    period: float | None = None


@dataclass(frozen=True, eq=False)
class Structure:
    """What an analysis of a residual found.

    Attributes:
        places: By falling evidence.
        p_value: Probability of so much structure by noise alone.
        channels: All of them.
        null_best: Largest evidence in each simulated residual.
    """

    places: list[Place]
    p_value: float
    channels: list[Channel]
    null_best: Tensor


def _features(driver: Tensor, count: int) -> Tensor:
    """Radial functions ``(K, count)`` that sum to smooth curves along a driver."""
    low, high = float(driver.min()), float(driver.max())
    centres = torch.linspace(low, high, count, dtype=torch.float64)
    width = 1.2 * (high - low) / (count - 1)
    return torch.exp(-0.5 * ((driver[:, None] - centres) / width).square())


def _evidence(u: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """Log evidence with every one of `SIZES` as likely, ``(B,)``, and the likeliest size; u ``(r, B)``, s ``(r,)``."""
    gain = (SIZES[:, None] * s).square()  # (G, r)
    shrink = gain / (1 + gain)
    logs = 0.5 * shrink @ u.square() - 0.5 * torch.log1p(gain).sum(-1, keepdim=True)
    return logs.logsumexp(0) - math.log(len(SIZES)), SIZES[logs.argmax(0)]


@dataclass(frozen=True, eq=False)
class _Change:
    """Smooth changes of a channel along a driver, in principal directions.

    Attributes:
        features: Radial functions at the channel's points, ``(K, m)``.
        scale: Of their responses, which are divided by it.
        s: Singular values of the responses, ``(m,)``.
        v: Right singular vectors, ``(m, m)``.
        along: The residual along the left ones, ``(m,)``.
        null: The simulated residuals along them, ``(m, draws)``.
    """

    features: Tensor
    scale: float
    s: Tensor
    v: Tensor
    along: Tensor
    null: Tensor

    @classmethod
    def of(cls, features: Tensor, columns: Tensor, least: float, residuals: Tensor) -> "_Change | None":
        """From the responses, projected; None where there are none beyond rounding, ``least``."""
        scale = float(columns.norm()) / math.sqrt(columns.shape[1])
        if scale <= least:
            return None
        columns = columns / scale
        values, v = torch.linalg.eigh(columns.T @ columns)
        s = values.clamp_min(0.0).sqrt()
        there = s > SMALL * s[-1]
        along = (v[:, there].T @ (columns.T @ residuals)) / s[there, None]
        return cls(features, scale, s[there], v[:, there], along[:, 0], along[:, 1:])

    def place(self, channel: Channel, driver: str, residual: "Residual", excess: float) -> "Place":
        """The estimate."""
        evidence, size = _evidence(self.along[:, None], self.s)
        gain = (float(size[0]) * self.s).square()
        shrink = gain / (1 + gain)
        weights = (self.v * (shrink / self.s)) @ self.along / self.scale
        removed = float(((1 - (1 - shrink).square()) * self.along.square()).sum())
        left = float(residual.e.square().sum()) - removed
        rest = max(left - residual.freedom + float(shrink.sum()), 0.0)
        within = (self.features @ self.v) / (1 + gain).sqrt()
        # What the data say nothing about keeps its prior sd.
        beyond = (self.features.square().sum(1) - (self.features @ self.v).square().sum(1)).clamp_min(0.0)
        sd = (within.square().sum(1) + beyond).sqrt() * float(size[0]) / self.scale
        return Place(
            channel, driver, float(evidence[0]), 1.0 - min(rest / excess, 1.0), self.features @ weights, sd,
            float(size[0]),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Look:
    """Smooth changes of a channel along a driver: functions ``(K, m)`` and responses ``(n, m)``, not whitened."""

    channel: Channel
    driver: str
    features: list[Tensor]
    responses: Tensor


def responses_of(problem: Problem, available: Sequence[Channel]) -> list[_Look]:
    """Every channel along every driver, and its logarithm over decades, with fewer and more functions."""
    found = []
    for channel in available:
        data = problem.n if channel.kind != "output" else int((channel.matrix != 0).sum())
        for name, driver in channel.drivers.items():
            distinct = len(driver.unique())
            if distinct < 2:
                continue
            counts = dict.fromkeys(min(count, distinct) for count in _counts(problem, data, name))
            scales = [driver, driver.log()] if name != "t" and Span.of(driver).log else [driver]
            parts = [_features(scale, count) for scale in scales for count in counts]
            found.append(_Look(channel, name, parts, channel.response(torch.cat(parts, dim=1))))
    return found


def _counts(problem: Problem, data: int, driver: str) -> list[int]:
    """Numbers of smooth functions along a driver that are tried with some data."""
    most = max(ALONG[0], data // DATA_EACH[0 if problem.in_time else 1])
    return [count for count in (IN_TIME if driver == "t" else ALONG) if count <= most]


def _lines(residual: Residual, available: Sequence[Channel]) -> list[Lines]:
    """Oscillations of every output."""
    problem = residual.found.problem
    x = problem.recording.x
    driver = "t" if problem.in_time else next(iter(x)) if isinstance(x, dict) else "x"
    return lines_of(
        problem, available, quantisation(problem), residual.found.whitening.sd, driver,
        lambda data: _counts(problem, data, driver)[-1],
    )  # fmt: skip


def _line_place(lines: Lines, residual: Residual, excess: float) -> Place:
    """The likeliest oscillation of an output."""
    found = residual.found
    evidence, number = lines.evidence(residual.e[:, None], SIZES)
    profile, removed = lines.wave(found.residual, residual.e, number, SIZES)
    taken = 2.0 * len(lines.parts) + 1.0  # two amplitudes in every run, and the frequency
    left = max(float(residual.e.square().sum()) - removed - residual.freedom + taken, 0.0)
    return Place(
        lines.channel, lines.driver, float(evidence[0]), 1.0 - min(left / excess, 1.0), profile,
        lines.sd(found.whitening.sd),
        float(profile.abs().max()), 1.0 / float(lines.frequencies[number]),
    )  # fmt: skip


def evidences(
    residual: Residual, looks: Sequence[_Look], available: Sequence[Channel]
) -> tuple[list[float], Tensor | None]:
    """Log evidence for a smooth change of each channel against each driver, and for oscillations of each output.

    Also returns the oscillation ``(n,)`` that the residual has where one is likelier than all else.
    """
    smooth: dict[int, float] = {}
    for key, _, change in _changes(residual, looks, residual.e[:, None]):
        smooth[key] = max(smooth.get(key, -math.inf), float(_evidence(change.along[:, None], change.s)[0]))
    found, wave = list(smooth.values()), None
    for lines in _lines(residual, available):
        evidence, number = lines.evidence(residual.e[:, None], SIZES)
        if float(evidence[0]) > max([0.0, *found]):
            wave = lines.wave(residual.found.residual, residual.e, number, SIZES)[0]
        found.append(float(evidence[0]))
    return found, wave


def _changes(residual: Residual, looks: Sequence[_Look], residuals: Tensor) -> Iterator[tuple[int, _Look, _Change]]:
    """Changes of every channel along every driver, under the residual's noise."""
    for number, look in enumerate(looks):
        responses = residual.found.whitening(look.responses)
        columns = residual.project(responses)
        if not bool(torch.isfinite(columns).all()):
            continue
        sizes = [part.shape[1] for part in look.features]
        pieces = zip(look.features, columns.split(sizes, 1), responses.split(sizes, 1), strict=True)
        for features, block, whole in pieces:
            change = _Change.of(features, block, 1e-9 * float(whole.norm()), residuals)
            if change is not None:
                yield number, look, change


def analyse(residual: Residual, *, every: bool = False) -> Structure:
    """Look for smooth changes of every channel against every driver, and for oscillations of every output.

    Args:
        residual: The fit's.
        every: Also look at channels of kinds that do not count for the test, for the report.
    """
    found = residual.found
    available = channels(found.problem, found)
    kinds = found.problem.kinds
    chosen = [c for c in available if every or c.kind in kinds]
    best: dict[int, Place] = {}
    nulls: dict[int, Tensor] = {}
    excess = max(residual.excess, 1e-300)
    both = torch.cat([residual.e[:, None], residual.null], dim=1)
    for key, look, change in _changes(residual, responses_of(found.problem, chosen), both):
        place = change.place(look.channel, look.driver, residual, excess)
        if key not in best or place.evidence > best[key].evidence:
            best[key] = place
        if look.channel.kind in kinds:
            simulated = _evidence(change.null, change.s)[0]
            nulls[key] = torch.maximum(nulls[key], simulated) if key in nulls else simulated
    places = list(best.values())
    for lines in _lines(residual, chosen):
        places.append(_line_place(lines, residual, excess))
        nulls[-len(places)] = lines.evidence(residual.null, SIZES)[0]
    places.sort(key=lambda place: -place.evidence)
    if not nulls:
        return Structure(places, 1.0, available, torch.zeros(1, dtype=torch.float64))
    null = torch.stack(list(nulls.values())).amax(0)
    seen = max((p.evidence for p in places if p.channel.kind in kinds), default=0.0)
    p_value = (1.0 + float((null >= seen).sum())) / (1.0 + len(null))
    return Structure(places, p_value, available, null)
