"""A fit's residual, whitened and projected off the fit's tangent space, and what noise alone would leave of it."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.problem import remembered
from torchcal.discovery.misfit.curves import orthonormal
from torchcal.discovery.misfit.noise import GRID, Noise

__all__ = ["Residual"]


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

    def share(self, removed: float, taken: float) -> float:
        """Share of the excess that a change removes which takes some degrees of freedom; none where there is none."""
        left = max(float(self.e.square().sum()) - removed - self.freedom + taken, 0.0)
        return max(1.0 - left / self.excess, 0.0) if self.excess > 0 else 0.0


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
            for places in problem.recorded_of(output):
                phi = GRID[chosen].repeat_interleave(each)[:draws]
                walk = e[places]
                for k, rho in enumerate(remembered(phi, problem.gaps(places)), start=1):
                    walk[k] = rho * walk[k - 1] + (1 - rho.square()).sqrt() * walk[k]
                e[places] = walk
        unit = w.sd.clone()
        e = w(e * unit[:, None])
    for output, freedom in enumerate(noise.freedom.tolist()):
        if not math.isfinite(freedom):
            continue
        mine = problem.output_of == output
        half = torch.full((draws,), 0.5 * freedom, dtype=torch.float64)
        chi2 = 2 * torch._standard_gamma(half, generator=generator)
        e[mine] = e[mine] * (freedom / chi2).sqrt()
    return e
