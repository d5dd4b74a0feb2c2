"""Which sampler draws, from where, and how much."""

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from torchcal import models
from torchcal.checks import as_seed, whole
from torchcal.errors import ConvergenceWarning, DomainError, ImproperPosteriorError, InterruptionWarning, warn
from torchcal.inference.batched import MOST_ELEMENTS, TARGET, run_batched
from torchcal.inference.by_hand import by_hand
from torchcal.inference.coordinates import Laplace, dealt_out, slopes_of
from torchcal.inference.diagnostics import Figures, figures
from torchcal.inference.draws import WORTH_CHAINS, Draws
from torchcal.inference.estimate import Estimate
from torchcal.inference.modes import modes_of
from torchcal.inference.nuts import run_nuts
from torchcal.models import Problem
from torchcal.results.diagnostics import R_HAT_THRESHOLD, Mode

__all__ = ["Plan", "draw"]

_FEWEST_CHAINS, _MOST_CHAINS, _DRAWS_EACH = 32, 400, 120
"""Where there is a target: so few chains cost no more than one, so many use all of a core, so long each is to be."""

MOST_DRAWS = 20_000
"""Draws of a chain at which a search for a wanted sample size gives up."""

FELT, LOST = 0.2, 0.5
"""Rounding of a log-density that distorts draws, and that hides differences of about 0.5, which a sampler goes by."""

_ROUNDINGS = 4
"""Of a sum of squares, in roundings of its value; measured on straight lines."""


_ROUNDED = 9
"""Points at which data are rounded anew."""

_TRIED, _FAR = 64, 20.0
"""Points at which roundings are looked at, and log-density below the largest from which on a point plays no part."""


@dataclass(frozen=True)
class Plan:
    """How much to draw, how, and with which seed. Checked when it is made.

    Attributes:
        num_samples: Draws a chain, the most of them where there is a target; 0 for none; None to choose.
        num_chains: Chains; None to choose.
        num_warmup: Draws thrown away a chain; None for the sampler's default.
        sampler: ``"nuts"``, ``"hmc"`` or ``"pyro"``.
        seed: Of every random number.
        dtype: Of the sampler's arithmetic.
        target_accept: Mean acceptance that the step size aims at; None to choose.
        progress: Whether to show a bar.
        target_ess: Effective sample size of the worst α at which to stop, or None.
    """

    num_samples: int | None
    num_chains: int | None
    num_warmup: int | None
    sampler: str
    seed: int
    dtype: torch.dtype
    target_accept: float | None
    progress: bool
    target_ess: float | None = None

    def __post_init__(self) -> None:
        if self.sampler not in ("nuts", "hmc", "pyro"):
            raise DomainError(f"Expected sampler 'nuts', 'hmc' or 'pyro'. Got {self.sampler!r}.")
        object.__setattr__(self, "seed", as_seed(self.seed))
        for name, least in (("num_samples", 0), ("num_chains", 1), ("num_warmup", 1)):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, whole(name, value, least))  # an integer of NumPy's is one too
        if self.dtype not in (torch.float32, torch.float64):
            raise DomainError(f"Expected dtype torch.float64 or torch.float32. Got {self.dtype!r}.")
        accept = self.target_accept
        if accept is not None:
            if not (isinstance(accept, Real) and 0 < float(accept) < 1):
                raise DomainError(f"Expected target_accept between 0 and 1, or None. Got {accept!r}.")
            object.__setattr__(self, "target_accept", float(accept))
        if self.target_ess is not None:
            self._check_target(self.target_ess)
            object.__setattr__(self, "target_ess", float(self.target_ess))

    def _check_target(self, target: Any) -> None:
        if isinstance(target, bool) or not isinstance(target, Real) or not 0 < float(target) < math.inf:
            raise DomainError(f"Expected target_ess as a positive number or None. Got {target!r}.")
        if self.sampler == "pyro":
            raise DomainError(
                "Expected sampler 'nuts' or 'hmc' with target_ess=. Got 'pyro', whose chains run one after another: "
                "give num_samples= and look at the diagnostics."
            )
        if self.num_samples == 0:
            raise DomainError("Expected num_samples of at least 1 with target_ess=. Got 0.")

    @property
    def samples(self) -> int:
        """Draws a chain, or the most of them."""
        if self.num_samples is not None:
            return self.num_samples
        return 1000 if self.target_ess is None else MOST_DRAWS

    def chains(self, cost: int) -> int:
        """Chains; with a target about 120 draws of each are meant to reach it, as R-hat asks for long chains."""
        if self.num_chains is not None:
            return self.num_chains
        if self.target_ess is None:
            return 4
        wanted = min(max(_FEWEST_CHAINS, math.ceil(self.target_ess / _DRAWS_EACH)), _MOST_CHAINS)
        return max(4, min(wanted, MOST_ELEMENTS // max(1, cost)))

    @property
    def warmup(self) -> int:
        """Draws thrown away a chain. Pooled over a crowd, adaptation needs fewer of each than chain by chain."""
        if self.num_warmup is not None:
            return self.num_warmup
        if self.sampler == "pyro":
            return max(300, self.samples // 2)
        return 100 if self.target_ess is None else 60  # a target is reached by many chains, which adapt together


def draw(problem: Problem, estimate: Estimate, model: Any, plan: Plan) -> Draws:
    """Draw from the posterior of a problem, in coordinates whitened at its mode, as planned.

    Germs are reversed, draw by draw, to agree with the maximum where the prior does not tell either way.
    """
    if estimate.improper:
        raise ImproperPosteriorError(
            "Expected a proper posterior to draw from. Got one that does not change along "
            f"{', '.join(estimate.improper)}, under a flat prior. Hold a parameter with fixed=, use a Uniform prior, "
            "or num_samples=0 for the maximum alone."
        )
    _check_rounding(plan.dtype, _ROUNDINGS * abs(estimate.posterior_objective) * torch.finfo(plan.dtype).eps)
    modes = modes_of(problem, estimate)
    cast = problem.cast(plan.dtype)
    # Outputs that are small beside an offset are known less well than their squares.
    _check_rounding(torch.float64, _rounding_of_data(problem, modes[0]))
    if cast is not problem:
        _check_rounding(plan.dtype, _rounding(problem, cast, modes[0]))
    worth = [k for k, mode in enumerate(modes) if k == 0 or (mode.weight >= WORTH_CHAINS and plan.sampler != "pyro")]
    starts = [modes[k].to(plan.dtype) for k in worth]
    begun = {worth[k] for k in dealt_out([mode.weight for mode in starts], plan.chains(cast.cost))}
    pattern = problem.propagate.pattern

    def folded(alpha: Tensor) -> Tensor:
        return pattern.flip(alpha, estimate.alpha.to(alpha)) if problem.prior.symmetric else alpha

    seen: list[tuple[Tensor, Figures]] = []  # the last look

    def enough(alpha: Tensor, groups: Tensor) -> float:
        alpha = folded(alpha)
        seen[:] = [(alpha, figures(alpha))]
        return _more(*seen[0], groups.cpu(), plan.target_ess or 0.0)

    if plan.sampler == "pyro":
        draws = _draw_with_pyro(cast, starts[0], model, plan)
    else:
        transform = cast.prior.transform

        def log_density(u: Tensor) -> Tensor:
            return cast.log_prob(transform.bound(u)) + transform.log_slope(u)

        draws = run_batched(
            log_density,
            transform,
            modes=starts,
            slopes=by_hand(cast, slopes_of(log_density)),
            num_samples=plan.samples,
            num_chains=plan.chains(cast.cost),
            num_warmup=plan.warmup,
            seed=plan.seed,
            kernel=plan.sampler,
            cost=cast.cost,
            target_accept=plan.target_accept,
            enough=enough if plan.target_ess is not None else None,
            progress=plan.progress,
        )
    alpha = folded(draws.alpha)
    found = seen[0][1] if seen and torch.equal(seen[0][0], alpha) else figures(alpha)
    if plan.target_ess is not None and _missing(found, plan.target_ess) > 1:
        warn(
            f"Wanted an effective sample size of {plan.target_ess:g} and R-hat below {R_HAT_THRESHOLD}. Got "
            f"{found.least_ess:.0f} and {found.worst_r_hat:.3f} after {alpha.shape[1]} draws of each of "
            f"{alpha.shape[0]} chains.",
            ConvergenceWarning,
        )
    told = tuple(_mode(problem, mode, k in begun) for k, mode in enumerate(modes))
    return Draws(alpha, draws.divergences, told, found)


def draw_unless_interrupted(problem: Problem, estimate: Estimate, model: Any, plan: Plan) -> Draws | None:
    """As `draw`; None after Ctrl-C before there were draws to keep: the maximum is there, and took its time.

    Warns:
        InterruptionWarning: Then.
    """
    try:
        return draw(problem, estimate, model, plan)
    except KeyboardInterrupt:
        warn(
            "The sampler was interrupted before there were draws to keep. The result is the maximum alone.",
            InterruptionWarning,
        )
        return None


def _mode(problem: Problem, mode: Laplace, started: bool) -> Mode:
    with torch.no_grad():
        alpha = problem.prior.transform.bound(mode.loc)
        objective = -float(problem.log_prob(alpha))
    return Mode(tuple(alpha.cpu().tolist()), objective, mode.weight, started)


def _more(alpha: Tensor, found: Figures, groups: Tensor, target: float) -> float:
    """By which factor draws ``(C, n, P)`` must grow to reach a sample size and an R-hat; at most 1 if they do.

    Where all chains together do not, each group ``(C,)`` of them, those that began at one mode, is judged by itself and
    must reach its share of the target: modes that chains never leave would otherwise keep R-hat up however long they
    are.
    """
    if alpha.shape[1] < 4:
        return 2.0
    whole = _missing(found, target)
    if whole <= 1 or len(groups.unique()) == 1:
        return whole
    shares = [(alpha[groups == group], float((groups == group).double().mean())) for group in groups.unique()]
    return min(whole, max(_missing(figures(chains), target * share) for chains, share in shares))


def _missing(found: Figures, target: float) -> float:
    excess = found.worst_r_hat - 1
    factor = target / found.least_ess
    if not excess < R_HAT_THRESHOLD - 1:  # the excess falls in proportion to the length
        factor = max(factor, excess / (R_HAT_THRESHOLD - 1), 1.2)
    return factor


def _draw_with_pyro(problem: Problem, mode: Laplace, model: Any, plan: Plan) -> Draws:
    prior = problem.prior.whitened(mode.loc, mode.scale_tril)
    arguments: tuple[Any, ...] = (problem.y, problem.propagate)
    if model is models.additive:
        arguments += (prior, problem.noise, problem.observed, problem.unit)
    else:
        arguments += (problem.likelihood, prior, problem.noise, problem.observed, problem.germ)
    return run_nuts(
        model,
        arguments,
        prior,
        num_samples=plan.samples,
        num_chains=plan.chains(1),
        num_warmup=plan.warmup,
        seed=plan.seed,
        target_accept=TARGET["pyro"] if plan.target_accept is None else plan.target_accept,
        progress=plan.progress,
    )


def _check_rounding(dtype: torch.dtype, error: float) -> None:
    """Raise or warn for a log-density that is known to an error.

    Where that is `FELT`, draws are distorted; where it is `LOST`, no step is short enough, and the warm-up hardly ends.
    """
    instead = "data and outputs without the large offset that they may have in common, or a larger epsilon="
    if dtype != torch.float64:
        instead = "dtype=torch.float64, or data that are not small beside an offset, or a larger epsilon="
    if error > LOST:
        raise DomainError(
            f"Expected a log-posterior whose differences of about 0.5 can be told in {dtype}. Got one that is known to "
            f"{error:.2g} only near the mode. Use {instead}, or num_samples=0 for the maximum alone."
        )
    if error > FELT:
        warn(
            f"In {dtype} the log-posterior is known to {error:.2g} only near the mode, which distorts the draws. Use "
            f"{instead}.",
            ConvergenceWarning,
        )


def _rounding_of_data(problem: Problem, mode: Laplace) -> float:
    """Sd of what a log-density errs by where the posterior is, if every datum is rounded, as predictions of it are."""
    random = torch.Generator().manual_seed(0)
    z = torch.randn(_ROUNDED, len(mode.loc), generator=random, dtype=torch.float64).to(mode.loc)
    last = torch.finfo(problem.y.dtype).eps * problem.y
    errors = []
    with torch.no_grad():
        for alpha in problem.prior.transform.bound(mode.loc + z @ mode.scale_tril.T):
            other = problem.y + last * torch.randn(len(last), generator=random, dtype=torch.float64).to(last)
            errors.append(replace(problem, y=other).log_prob(alpha) - problem.log_prob(alpha))
    error = torch.stack(errors)
    error = error[error.isfinite()]
    return 1.4826 * float(error.abs().median()) if len(error) else 0.0


def _rounding(problem: Problem, cast: Problem, mode: Laplace) -> float:
    """Sd of what a log-density in a coarser dtype errs by where the posterior is, but for a constant."""
    random = torch.Generator().manual_seed(0)
    z = torch.randn(_TRIED, len(mode.loc), generator=random, dtype=torch.float64).to(mode.loc)
    u = mode.loc + z @ mode.scale_tril.T
    with torch.no_grad():
        exact, rounded = (
            one.log_prob(one.prior.transform.bound(at)) + one.prior.transform.log_slope(at)
            for one, at in ((problem, u), (cast, u.to(cast.y.dtype)))
        )
        known = exact.isfinite()
        largest = exact[known].max() if bool(known.any()) else exact.new_zeros(())
        error = (rounded.to(exact) - exact)[known & (exact > largest - _FAR) & rounded.isfinite()]
    return 1.4826 * float((error - error.median()).abs().median()) if len(error) else math.inf
