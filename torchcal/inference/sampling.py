"""Which sampler draws, from where, and how much."""

import warnings
from dataclasses import dataclass
from typing import Any

import torch

from torchcal import models
from torchcal.errors import ConvergenceWarning, DomainError, ImproperPosteriorError
from torchcal.inference.batched import run_batched_nuts
from torchcal.inference.draws import Draws
from torchcal.inference.estimate import Estimate, Laplace, laplace
from torchcal.inference.nuts import run_nuts
from torchcal.models import Problem

__all__ = ["Plan", "draw"]


@dataclass(frozen=True)
class Plan:
    """How much to draw, how, and with which seed. Checked when it is made.

    Attributes:
        num_samples: Draws a chain; 0 for none.
        num_chains: Chains.
        num_warmup: Draws thrown away a chain; None for the sampler's default.
        sampler: ``"nuts"`` or ``"pyro"``.
        seed: Of every random number.
        dtype: Of the sampler's arithmetic.
        target_accept: Mean acceptance that the step size aims at; None to choose.
        progress: Whether to show a bar.
    """

    num_samples: int
    num_chains: int
    num_warmup: int | None
    sampler: str
    seed: int
    dtype: torch.dtype
    target_accept: float | None
    progress: bool

    def __post_init__(self) -> None:
        if self.sampler not in ("nuts", "pyro"):
            raise DomainError(f"Expected sampler 'nuts' or 'pyro'. Got {self.sampler!r}.")
        for name, least in (("num_samples", 0), ("num_chains", 1), ("num_warmup", 1), ("seed", 0)):
            value = getattr(self, name)
            if name == "num_warmup" and value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise DomainError(f"Expected {name} as an integer of at least {least}. Got {value!r}.")
        if self.dtype not in (torch.float32, torch.float64):
            raise DomainError(f"Expected dtype torch.float64 or torch.float32. Got {self.dtype!r}.")
        accept = self.target_accept
        if accept is not None and not (isinstance(accept, float) and 0 < accept < 1):
            raise DomainError(f"Expected target_accept between 0 and 1, or None. Got {accept!r}.")

    @property
    def warmup(self) -> int:
        """Draws thrown away a chain. Pooled over a crowd, adaptation needs fewer of each than chain by chain."""
        if self.num_warmup is not None:
            return self.num_warmup
        return 100 if self.sampler == "nuts" else max(300, self.num_samples // 2)


def draw(problem: Problem, estimate: Estimate, model: Any, plan: Plan) -> Draws:
    """Draw from the posterior of a problem, in coordinates whitened at its mode, as planned."""
    if estimate.improper:
        raise ImproperPosteriorError(
            "Expected a proper posterior to draw from. Got one that does not change with "
            f"{', '.join(estimate.improper)}, under a flat prior. Hold a parameter with fixed=, use a Uniform prior, "
            "or num_samples=0 for the maximum alone."
        )
    approximation = laplace(problem, estimate)
    _warn_of_rounding(estimate, plan.dtype)
    problem = problem.cast(plan.dtype)
    approximation = Laplace(approximation.loc.to(plan.dtype), approximation.scale_tril.to(plan.dtype))
    if plan.sampler == "nuts":
        transform = problem.prior.transform
        return run_batched_nuts(
            lambda u: problem.log_prob(transform.bound(u)) + transform.log_slope(u),
            transform,
            loc=approximation.loc,
            scale_tril=approximation.scale_tril,
            num_samples=plan.num_samples,
            num_chains=plan.num_chains,
            num_warmup=plan.warmup,
            seed=plan.seed,
            cost=problem.propagate.num_nodes * len(problem.y),
            target_accept=plan.target_accept,
            progress=plan.progress,
        )
    prior = problem.prior.whitened(approximation.loc, approximation.scale_tril)
    arguments: tuple[Any, ...] = (problem.y, problem.propagate)
    if model is models.additive:
        arguments += (prior, problem.noise, problem.observed, problem.unit)
    else:
        arguments += (problem.likelihood, prior, problem.noise, problem.observed, problem.germ)
    return run_nuts(
        model,
        arguments,
        prior,
        num_samples=plan.num_samples,
        num_chains=plan.num_chains,
        num_warmup=plan.warmup,
        seed=plan.seed,
        target_accept=0.8 if plan.target_accept is None else plan.target_accept,
        progress=plan.progress,
    )


def _warn_of_rounding(estimate: Estimate, dtype: torch.dtype) -> None:
    """Differences of a log-density are known to its magnitude times the dtype's resolution; 0.05 of one matters."""
    error = abs(estimate.posterior_objective) * torch.finfo(dtype).eps
    if error > 0.05:
        warnings.warn(
            f"In {dtype} the log-posterior, {estimate.posterior_objective:.3g} at the mode, is known to "
            f"{error:.2g} only, which distorts the draws. Use dtype=torch.float64, or a larger epsilon.",
            ConvergenceWarning,
            stacklevel=4,
        )
