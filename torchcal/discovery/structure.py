"""Is there more in a residual than noise, and where does it sit?

The residual of a fit, whitened and projected off the fit's tangent space, is compared with unknown smooth changes of
every channel against every driver. Probabilities come from simulated noise that went through the same projection.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.channels import Channel, channels
from torchcal.discovery.fitting import Fitted
from torchcal.discovery.noise import GRID, Noise

__all__ = ["Place", "Residual", "Structure", "analyse"]

#: Radial functions along a driver.
FEATURES = 12
#: Sizes of an unknown change that are tried, in noise sd.
SIZES = torch.logspace(-0.3, 3.0, 14, dtype=torch.float64)


class Residual:
    """A fit's residual, whitened and projected off its tangents, with draws of what noise alone would leave.

    Args:
        found: The fit.
        noise: The noise model.
        draws: Number of simulated residuals.
        seed: Of the draws.
    """

    def __init__(self, found: Fitted, noise: Noise, *, draws: int = 1000, seed: int = 0) -> None:
        self.found = found
        self.noise = noise
        w = found.whitening
        tangents = w(found.jacobian[:, ~found.at_bound])
        size = tangents.norm(dim=0)
        tangents = tangents[:, size > 0] / size[size > 0]
        if tangents.shape[1]:
            u, s, _ = torch.linalg.svd(tangents, full_matrices=False)
            self.basis = u[:, s > 1e-7 * s[0]]
        else:
            self.basis = tangents
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
    """An unknown smooth change of one channel against one driver.

    Attributes:
        channel: Where.
        driver: Against what.
        evidence: Log evidence against no change.
        share: Share of the excess misfit that it removes.
        profile: Estimated change at the channel's points, ``(K,)``.
        sd: Its standard deviation there.
        size: Chosen prior size.
    """

    channel: Channel
    driver: str
    evidence: float
    share: float
    profile: Tensor
    sd: Tensor
    size: float


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


def _features(driver: Tensor) -> Tensor:
    """Radial functions ``(K, m)`` that sum to smooth curves along a driver."""
    low, high = float(driver.min()), float(driver.max())
    if not high > low:
        return driver.new_zeros(len(driver), 0)
    distinct = len(driver.unique())
    count = min(FEATURES, distinct)
    centres = torch.linspace(low, high, count, dtype=torch.float64)
    width = 1.2 * (high - low) / max(count - 1, 1)
    return torch.exp(-0.5 * ((driver[:, None] - centres) / width).square())


def _evidence(u: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """Largest log evidence over `SIZES`, and its size; u ``(r, B)``, s ``(r,)``."""
    gain = (SIZES[:, None] * s).square()  # (G, r)
    shrink = gain / (1 + gain)
    logs = 0.5 * shrink @ u.square() - 0.5 * torch.log1p(gain).sum(-1, keepdim=True)
    best = logs.max(0)
    return best.values.clamp_min(0.0), SIZES[best.indices]


def analyse(residual: Residual, *, every: bool = False) -> Structure:
    """Look for smooth changes of every channel against every driver.

    Args:
        residual: The fit's.
        every: Also look at channels of kinds that do not count for the test, for the report.
    """
    found = residual.found
    available = channels(found.problem, found)
    kinds = found.problem.kinds
    chosen = [c for c in available if every or c.kind in kinds]
    places: list[Place] = []
    nulls: list[Tensor] = []
    excess = max(residual.excess, 1e-300)
    for channel in chosen:
        for name, driver in channel.drivers.items():
            features = _features(driver)
            if features.shape[1] < 2:
                continue
            columns = residual.tangent(channel.response(features))
            if not bool(torch.isfinite(columns).all()):
                continue
            scale = float(columns.norm()) / math.sqrt(columns.shape[1])
            if scale <= 1e-9 * float(found.whitening(channel.response(features)).norm() + 1e-300):
                continue
            u, s, v = torch.linalg.svd(columns / scale, full_matrices=False)
            along = u.T @ residual.e[:, None]
            evidence, size = _evidence(along, s)
            if channel.kind in kinds:
                nulls.append(_evidence(u.T @ residual.null, s)[0])
            gain = (float(size[0]) * s).square()
            shrink = gain / (1 + gain)
            weights = (v.T * (shrink / s.clamp_min(1e-12))) @ along[:, 0] / scale
            left = residual.e - u @ (shrink * along[:, 0])
            rest = max(float(left.square().sum()) - residual.freedom + float(shrink.sum()), 0.0)
            spread = (features @ v.T) * (float(size[0]) / (1 + gain).sqrt()) / scale
            places.append(
                Place(channel, name, float(evidence[0]), 1.0 - min(rest / excess, 1.0), features @ weights,
                      spread.norm(dim=1), float(size[0]))
            )  # fmt: skip
    places.sort(key=lambda place: -place.evidence)
    if not nulls:
        return Structure(places, 1.0, available, torch.zeros(1, dtype=torch.float64))
    null = torch.stack(nulls).amax(0)
    seen = max((p.evidence for p in places if p.channel.kind in kinds), default=0.0)
    p_value = (1.0 + float((null >= seen).sum())) / (1.0 + len(null))
    return Structure(places, p_value, available, null)
