"""The Pyro models: calibration with embedded model error, and with an additive Gaussian discrepancy.

They are ordinary Pyro models and take their observations as arguments. The log-likelihoods beside them are the same
densities without Pyro, for the optimiser and for batched samplers.
"""

from dataclasses import dataclass, replace

import pyro
import torch
from torch import Tensor

from torchcal.likelihoods import DRAWS, Additive, Likelihood
from torchcal.priors import CoefficientPrior
from torchcal.propagation import NISP

__all__ = ["Problem", "additive", "embedded", "log_likelihood"]


@dataclass(frozen=True)
class Problem:
    """What is inferred from what: data, propagation, likelihood and prior.

    Attributes:
        y: Recorded outputs, ``(n,)``, missing ones of any value.
        propagate: From α to output moments.
        likelihood: With its defaults resolved.
        prior: On α (on α and ln σ for the additive likelihood, ln σ last).
        noise: Sd of the measurement noise, ``(n,)``, or None.
        observed: Which outputs were recorded and take part, ``(n,)`` bool, or None for all.
        germ: Fixed germ draws for sample likelihoods, ``(S, germs)``.
        unit: What the additive σ is measured in at each datum, ``(n,)``, where outputs have units of their own.
    """

    y: Tensor
    propagate: NISP
    likelihood: Likelihood
    prior: CoefficientPrior
    noise: Tensor | None = None
    observed: Tensor | None = None
    germ: Tensor | None = None
    unit: Tensor | None = None

    @property
    def cost(self) -> int:
        """How many outputs are computed for one α."""
        return self.propagate.num_evaluations * len(self.y)

    def cast(self, dtype: torch.dtype) -> "Problem":
        """The same problem in another dtype."""
        if dtype == self.y.dtype:
            return self
        return replace(
            self,
            y=self.y.to(dtype),
            propagate=self.propagate.copy().to(dtype),
            prior=self.prior.cast(dtype),
            noise=None if self.noise is None else self.noise.to(dtype),
            germ=None if self.germ is None else self.germ.to(dtype),
            unit=None if self.unit is None else self.unit.to(dtype),
        )

    def log_likelihood(self, alpha: Tensor) -> Tensor:
        """``(*batch,)``."""
        return log_likelihood(
            alpha,
            self.y,
            self.propagate,
            self.likelihood,
            noise=self.noise,
            observed=self.observed,
            germ=self.germ,
            unit=self.unit,
        )

    def log_prob(self, alpha: Tensor) -> Tensor:
        """Log-posterior up to a constant, ``(*batch,)``."""
        return self.log_likelihood(alpha) + self.prior.log_prob(alpha)


def log_likelihood(
    alpha: Tensor,
    y: Tensor,
    propagate: NISP,
    likelihood: Likelihood,
    *,
    noise: Tensor | None = None,
    observed: Tensor | None = None,
    germ: Tensor | None = None,
    unit: Tensor | None = None,
) -> Tensor:
    """Log-likelihood of α (with ln σ last for the additive one), ``(*batch, P)`` to ``(*batch,)``.

    Args:
        alpha: Coefficients, ``(*batch, P)``, in scaled coordinates.
        y: Recorded outputs, ``(n,)``.
        propagate: From α to the outputs' mean and sd, at the recording's conditions.
        likelihood: One of `torchcal.likelihoods`.
        noise: Sd of the measurement noise, ``(n,)`` in the outputs' units, or None.
        observed: Which outputs take part, ``(n,)`` bool, or None for all.
        germ: Draws of the germ for likelihoods of samples, ``(S, germs)``; by default the same for every call.
        unit: What the additive σ is measured in at each datum, ``(n,)``, or None.

    Raises:
        ShapeError: If α does not have as many columns as the propagation has coefficients.
    """

    def pick(values: Tensor) -> Tensor:
        return values if observed is None else values[..., observed]

    y = pick(y)
    noise = None if noise is None else pick(noise)
    if isinstance(likelihood, Additive):
        mean = pick(propagate.mean(alpha[..., :-1]))
        log_sigma = alpha[..., -1:].expand(mean.shape)
        if unit is not None:
            log_sigma = log_sigma + pick(unit).log()
        return likelihood.log_prob(y, mean, log_sigma, noise)
    if likelihood.needs == "mean":
        return likelihood.log_prob(y, pick(propagate.mean(alpha)), None, noise)
    if likelihood.needs == "samples":
        if germ is None:
            germ = propagate.draw_germ(getattr(likelihood, "num_samples", DRAWS), seed=0)
        return likelihood.log_prob(y, pick(propagate.outputs_at(alpha, germ)), noise)
    mean, sd = propagate(alpha)
    return likelihood.log_prob(y, pick(mean), pick(sd), noise)


def embedded(
    y: Tensor,
    propagate: NISP,
    likelihood: Likelihood,
    prior: CoefficientPrior,
    noise: Tensor | None = None,
    observed: Tensor | None = None,
    germ: Tensor | None = None,
) -> None:
    """Pyro model of the embedded calibration: α from its prior, the likelihood as a factor (Eq. 11).

    The arguments are those of `log_likelihood`; ``prior`` is one of `torchcal.priors`. The site is ``"alpha"``.
    """
    alpha = pyro.sample("alpha", prior)
    value = log_likelihood(
        alpha, y, propagate, likelihood, noise=noise, observed=observed, germ=germ
    )
    pyro.factor("log_likelihood", value)


def additive(
    y: Tensor,
    propagate: NISP,
    prior: CoefficientPrior,
    noise: Tensor | None = None,
    observed: Tensor | None = None,
    unit: Tensor | None = None,
) -> None:
    """Pyro model of the conventional calibration: (λ, ln σ) from their prior, Eq. 4 as a factor (Eq. 3).

    The arguments are those of `log_likelihood`; ``prior`` is on λ in scaled coordinates with ln σ last. The site is
    ``"alpha"``.
    """
    alpha = pyro.sample("alpha", prior)
    value = log_likelihood(alpha, y, propagate, Additive(), noise=noise, observed=observed, unit=unit)
    pyro.factor("log_likelihood", value)


