"""Which sampler draws, from where, and how much."""

import warnings
from typing import Any

import torch

from torchcal import models
from torchcal.errors import ConvergenceWarning, DomainError, ImproperPosteriorError
from torchcal.inference.batched import run_batched_nuts
from torchcal.inference.draws import Draws
from torchcal.inference.estimate import Estimate, Laplace, laplace
from torchcal.inference.nuts import run_nuts
from torchcal.models import Problem

__all__ = ["check_counts", "draw"]


def draw(
    problem: Problem,
    estimate: Estimate,
    model: Any,
    num_samples: int,
    num_chains: int,
    num_warmup: int,
    seed: int,
    sampler: str,
    dtype: torch.dtype,
    progress: bool,
) -> Draws:
    """Draw from the posterior of a problem, in coordinates whitened at its mode, with arithmetic in ``dtype``."""
    if estimate.unseen and not problem.prior.proper:
        raise ImproperPosteriorError(
            "Expected a proper posterior to draw from. Got one that does not change with "
            f"{', '.join(estimate.unseen)}, under a flat prior. Hold a parameter with fixed=, give it bounds and a "
            "Uniform prior, or use num_samples=0 for the maximum alone."
        )
    approximation = laplace(problem, estimate)
    _warn_of_rounding(estimate, dtype)
    problem = problem.cast(dtype)
    approximation = Laplace(approximation.loc.to(dtype), approximation.scale_tril.to(dtype))
    if sampler == "nuts":
        transform = problem.prior.transform
        return run_batched_nuts(
            lambda u: problem.log_prob(transform.bound(u)) + transform.log_slope(u),
            transform,
            loc=approximation.loc,
            scale_tril=approximation.scale_tril,
            num_samples=num_samples,
            num_chains=num_chains,
            num_warmup=num_warmup,
            seed=seed,
            cost=problem.propagate.num_nodes * len(problem.y),
            progress=progress,
        )
    prior = problem.prior.whitened(approximation.loc, approximation.scale_tril)
    arguments: tuple[Any, ...] = (problem.y, problem.propagate)
    if model is models.additive:
        arguments += (prior, problem.noise, problem.observed)
    else:
        arguments += (problem.likelihood, prior, problem.noise, problem.observed, problem.germ)
    return run_nuts(
        model,
        arguments,
        prior,
        num_samples=num_samples,
        num_chains=num_chains,
        num_warmup=num_warmup,
        seed=seed,
        progress=progress,
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


def check_counts(
    num_samples: int, num_chains: int, num_warmup: int | None, num_starts: int, sampler: str
) -> tuple[int, int, int]:
    """Raise for numbers that make no sense; fill in the default warm-up."""
    if sampler not in ("nuts", "pyro"):
        raise DomainError(f"Expected sampler 'nuts' or 'pyro'. Got {sampler!r}.")
    # Pooled over a crowd of chains, adaptation needs fewer transitions of each than chain by chain.
    default = 100 if sampler == "nuts" else max(300, num_samples // 2)
    warmup = default if num_warmup is None else num_warmup
    for name, value, least in (
        ("num_samples", num_samples, 0),
        ("num_chains", num_chains, 1),
        ("num_warmup", warmup, 1),
        ("num_starts", num_starts, 1),
    ):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise DomainError(f"Expected {name} as an integer of at least {least}. Got {value!r}.")
    return num_samples, num_chains, warmup
