"""`calibrate` and `calibrate_additive`: from a simulator and a recording to a result."""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchcal import likelihoods, models
from torchcal.data import Recording
from torchcal.embeddings import Embedding, Gaussian, PolynomialChaos
from torchcal.errors import (
    ConvergenceWarning,
    DomainError,
    ExtrapolationWarning,
    ImproperPosteriorError,
    ToleranceWarning,
)
from torchcal.inference import diagnostics as measure
from torchcal.inference.estimate import Estimate, laplace, maximise
from torchcal.inference.batched import run_batched_nuts
from torchcal.inference.draws import Draws
from torchcal.inference.nuts import run_nuts
from torchcal.inference.setup import LeastSquares, PriorMaker, check_inputs, embedded_problem, least_squares
from torchcal.models import Problem
from torchcal.prediction import embedded_prediction
from torchcal.priors import CoefficientPrior, Flat
from torchcal.propagation import NISP, PropagationCheck
from torchcal.results import AdditiveCalibration, Calibration, Diagnostics, MapEstimate, Quality
from torchcal.results.diagnostics import ESS_THRESHOLD, R_HAT_THRESHOLD
from torchcal.simulators import Simulator

__all__ = ["calibrate", "calibrate_additive"]


def calibrate(
    simulator: Simulator,
    recording: Recording,
    *,
    embedding: Embedding | None = None,
    likelihood: likelihoods.Likelihood | str = "abc",
    prior: PriorMaker = Flat,
    fixed: Mapping[str, float] | None = None,
    num_samples: int = 1000,
    num_chains: int = 4,
    num_warmup: int | None = None,
    order: int | None = None,
    rule: Any = None,
    starts: Tensor | None = None,
    num_starts: int = 32,
    seed: int = 0,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float64,
    sampler: str = "nuts",
    progress: bool = False,
) -> Calibration:
    r"""Calibrate a simulator whose model error is embedded in its parameters.

    Infers α, the coefficients of the density of λ, from :math:`p(\alpha | D) \propto p(D | \alpha) p(\alpha)` (Eq. 11).

    Args:
        simulator: The model.
        recording: The data.
        embedding: Which parameters are uncertain, and how; by default all, as a multivariate normal (Eq. 10).
        likelihood: One of `torchcal.likelihoods`, or its name; by default ABC with a tolerance of 1 % of the
            data's sd.
        prior: A function from the propagation to a prior on α, such as a class of `torchcal.priors`.
        fixed: Parameters to hold, ``{name: physical value}``.
        num_samples: Posterior draws a chain; 0 for the MAP alone.
        num_chains: Chains.
        num_warmup: Draws thrown away a chain; by default 100, and half of ``num_samples`` but at least 300 for
            ``sampler="pyro"``.
        order: Degree of the output expansion; None for the full variance, 1 as in the paper's case studies.
        rule: Quadrature, see `torchcal.NISP`; by default found by itself.
        starts: Starting points of the optimiser ``(S, P)`` in scaled coordinates; by default made.
        num_starts: How many are made.
        seed: Of every random number; the global state is left as it was.
        device: Where the tensors live; the CPU by default.
        dtype: Of the arithmetic.
        sampler: ``"nuts"``, all chains as one batched tensor program; or ``"pyro"``, Pyro's NUTS on the Pyro model,
            chain after chain, which is the reference.
        progress: Whether to show a bar.

    Returns:
        A `torchcal.results.Calibration`.

    Raises:
        TorchcalError: A subclass that says what was expected, what came and what to do.

    Warns:
        ConvergenceWarning: If starts or chains disagree.
        ToleranceWarning: If the tolerance rather than the model error sets the width of the prediction.
        PropagationWarning: If moments have not converged in nodes or order.
        ExtrapolationWarning: If the calibration leaves the box of a surrogate.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276.
    """
    num_samples, num_chains, num_warmup = _check_counts(num_samples, num_chains, num_warmup, num_starts, sampler)
    embedding = Gaussian() if embedding is None else embedding
    if not isinstance(embedding, Embedding):
        raise DomainError(f"Expected one of torchcal.embeddings. Got {type(embedding).__name__}.")
    likelihood = likelihoods.get(likelihood)
    free, _ = check_inputs(simulator, recording, fixed)
    embedding.bind([parameter.name for parameter in free])
    fit = least_squares(simulator, recording, fixed, seed=seed)
    problem = embedded_problem(
        simulator,
        recording,
        embedding,
        likelihood,
        prior,
        fit,
        fixed=fixed,
        order=order,
        rule=rule,
        device=device,
        dtype=dtype,
    )
    estimate = maximise(problem, fit.scaled, starts=starts, num_starts=num_starts, seed=seed)
    propagate = problem.propagate
    check = propagate.check(estimate.alpha) if propagate.pattern.num_germs else None
    draws: Draws | None = None
    samples: Tensor | None = None
    if num_samples:
        draws = _sample(
            problem, estimate, models.embedded, num_samples, num_chains, num_warmup, seed, sampler, progress
        )
        samples = draws.alpha
        if problem.prior.symmetric:
            samples = propagate.pattern.flip(samples, estimate.alpha.to(samples))
    prediction = embedded_prediction(propagate, estimate.alpha, None if samples is None else samples.flatten(0, 1))
    quality = _diagnose(estimate, draws, samples, propagate, propagate.alpha_names, check)
    posterior = math.nan if prediction.sd_posterior is None else _mean_square(prediction.sd_posterior)
    quality = dataclasses.replace(
        quality, model_error_variance=_mean_square(prediction.sd_model_error), posterior_variance=posterior
    )
    _warn_of_tolerance(quality, problem.likelihood)
    _warn_of_box(simulator, propagate, estimate.alpha)
    _warn_of_chains(quality)
    mean, covariance = propagate.parameter_moments(estimate.alpha)
    return Calibration(
        map=MapEstimate(
            alpha=_result(estimate.alpha),
            mean=_result(mean),
            covariance=_result(covariance),
            objective=estimate.objective,
            alpha_names=propagate.alpha_names,
            parameters=propagate.pattern.names,
        ),
        samples=samples,
        diagnostics=quality,
        recording=recording,
        embedding=embedding,
        likelihood=problem.likelihood,
        propagate=propagate,
        settings=_settings(propagate, fit, type(embedding).__name__, seed, num_warmup),
    )


def calibrate_additive(
    simulator: Simulator,
    recording: Recording,
    *,
    fixed: Mapping[str, float] | None = None,
    num_samples: int = 1000,
    num_chains: int = 4,
    num_warmup: int | None = None,
    num_starts: int = 32,
    seed: int = 0,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float64,
    sampler: str = "nuts",
    progress: bool = False,
) -> AdditiveCalibration:
    r"""Calibrate the conventional way: λ and ln σ of an additive Gaussian discrepancy (Eqs. 2-4).

    Flat priors on λ (within its bounds) and ln σ. This is the baseline whose push-forward shrinks with more data,
    however wrong the model is.

    Args:
        simulator: The model.
        recording: The data. A known noise sd s adds s² to σ².
        fixed: Parameters to hold.
        num_samples: Posterior draws a chain; 0 for the MAP alone.
        num_chains: Chains.
        num_warmup: Draws thrown away a chain.
        num_starts: Starting points of the optimiser.
        seed: Of every random number.
        device: Where the tensors live.
        dtype: Of the arithmetic.
        sampler: ``"nuts"``, all chains as one batched tensor program; or ``"pyro"``, Pyro's NUTS on the Pyro model,
            chain after chain, which is the reference.
        progress: Whether to show a bar.

    Raises:
        ImproperPosteriorError: If the model fits the data exactly, or has as many parameters as there are data:
            the likelihood then grows without limit as σ → 0.
    """
    num_samples, num_chains, num_warmup = _check_counts(num_samples, num_chains, num_warmup, num_starts, sampler)
    free, _ = check_inputs(simulator, recording, fixed)
    observed = recording.observed
    count = int(observed.sum())
    if count <= len(free):
        raise ImproperPosteriorError(
            f"Expected more data than parameters for the additive likelihood. Got N = {count} and d = "
            f"{len(free)}: the residuals can vanish, and the likelihood grows without limit as σ → 0. Record more, "
            "hold parameters fixed, or use torchcal.calibrate."
        )
    fit = least_squares(simulator, recording, fixed, seed=seed)
    if fit.relative < 1e-7 and recording.noise_sd is None:
        raise ImproperPosteriorError(
            f"Expected residuals for the additive likelihood. Got a fit that is exact to {fit.relative:.1e} of the "
            "data's spread: the likelihood grows without limit as σ → 0. Give the recording's noise=, or use "
            "torchcal.calibrate."
        )
    y = torch.where(observed, recording.y, torch.zeros_like(recording.y))
    propagate = NISP(
        simulator,
        PolynomialChaos(order=0),
        recording.x,
        fixed=fixed,
        outputs=recording.outputs,
        scaling=fit.scaling,
    ).to(device=device, dtype=dtype)
    noise = recording.noise_sd
    problem = Problem(
        y=y.to(device=device, dtype=dtype),
        propagate=propagate,
        likelihood=likelihoods.Additive(),
        prior=_additive_prior(propagate, fit, noise),
        noise=None if noise is None else noise.to(device=device, dtype=dtype),
        observed=None if bool(observed.all()) else observed.to(device=device),
    )
    estimate = maximise(problem, fit.scaled, starts=None, num_starts=num_starts, seed=seed)
    draws = None
    if num_samples:
        draws = _sample(
            problem, estimate, models.additive, num_samples, num_chains, num_warmup, seed, sampler, progress
        )
    names = (*propagate.pattern.names, "ln sigma")
    samples = None if draws is None else draws.alpha
    quality = _diagnose(estimate, draws, samples, None, names, None)
    _warn_of_chains(quality)
    _warn_of_box(simulator, propagate, estimate.alpha[:-1])
    mean = propagate.scaling.physical(estimate.alpha[:-1])
    return AdditiveCalibration(
        map=MapEstimate(
            alpha=_result(estimate.alpha),
            mean=_result(mean),
            covariance=torch.zeros(len(free), len(free), dtype=torch.float64),
            objective=estimate.objective,
            alpha_names=names,
            parameters=propagate.pattern.names,
        ),
        samples=samples,
        diagnostics=quality,
        recording=recording,
        propagate=propagate,
        settings=_settings(propagate, fit, "additive", seed, num_warmup),
    )


def _additive_prior(propagate: NISP, fit: LeastSquares, noise: Tensor | None) -> CoefficientPrior:
    flat = Flat(propagate)
    like = flat.low
    size = float(fit.residual.square().mean().sqrt())
    # With known noise the likelihood no longer falls as σ → 0, and a flat ln σ needs a floor to be proper.
    floor = -math.inf if noise is None else math.log(1e-3 * float(noise.min()))
    center = math.log(size) if size > 0 else floor + 1
    if noise is not None:
        center = max(center, floor + 1)
    return CoefficientPrior(
        torch.cat([flat.low, torch.tensor([floor]).to(like)]),
        torch.cat([flat.high, torch.tensor([math.inf]).to(like)]),
        torch.cat([fit.scaled.to(like), torch.tensor([center]).to(like)]),
        torch.cat([0.3 * torch.ones_like(flat.low), torch.tensor([0.5]).to(like)]),
    )


def _sample(
    problem: Problem,
    estimate: Estimate,
    model: Any,
    num_samples: int,
    num_chains: int,
    num_warmup: int,
    seed: int,
    sampler: str,
    progress: bool,
) -> Draws:
    approximation = laplace(problem, estimate)
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


def _check_counts(
    num_samples: int, num_chains: int, num_warmup: int | None, num_starts: int, sampler: str
) -> tuple[int, int, int]:
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


def _diagnose(
    estimate: Estimate,
    draws: Draws | None,
    samples: Tensor | None,
    propagate: NISP | None,
    names: tuple[str, ...],
    check: PropagationCheck | None,
) -> Diagnostics:
    alpha: dict[str, Quality] = {}
    parameters: dict[str, Quality] = {}
    problems: list[str] = []
    converged: bool | None = None
    if draws is not None and samples is not None:
        alpha = _quality(samples, names)
        if propagate is not None:
            labels, moments = _parameter_draws(propagate, samples)
            parameters = _quality(moments, labels)
        everything = {**alpha, **parameters}
        wanted = min(ESS_THRESHOLD, samples.shape[0] * samples.shape[1] / 4)
        loud = {name: q for name, q in everything.items() if not q.r_hat <= R_HAT_THRESHOLD}
        if loud:
            worst = max(loud, key=lambda name: loud[name].r_hat if loud[name].r_hat == loud[name].r_hat else 9e9)
            problems.append(
                f"R-hat of {worst} is {loud[worst].r_hat:.3f} (threshold {R_HAT_THRESHOLD}); {len(loud)} of "
                f"{len(everything)} quantities are past it"
            )
        few = {name: min(q.ess_bulk, q.ess_tail) for name, q in everything.items()}
        worst = min(few, key=lambda name: few[name])
        if not few[worst] >= wanted:
            problems.append(f"effective sample size of {worst} is {few[worst]:.0f} (threshold {wanted:.0f})")
        if draws.divergences:
            problems.append(f"{draws.divergences} divergent transitions")
        converged = not problems
    return Diagnostics(
        alpha=alpha,
        parameters=parameters,
        divergences=0 if draws is None else draws.divergences,
        null_directions=_result(estimate.null_directions),
        starts=len(estimate.minima.values),
        agreeing=estimate.agreeing,
        propagation=check,
        model_error_variance=math.nan,
        posterior_variance=math.nan,
        converged=converged,
        problems=tuple(problems),
    )


def _quality(draws: Tensor, names: tuple[str, ...]) -> dict[str, Quality]:
    figures = (measure.r_hat(draws), measure.bulk_ess(draws), measure.tail_ess(draws))
    return {name: Quality(*(float(figure[i]) for figure in figures)) for i, name in enumerate(names)}


def _parameter_draws(propagate: NISP, samples: Tensor) -> tuple[tuple[str, ...], Tensor]:
    """E[λ] and the lower triangle of Cov[λ] for every draw, with their names."""
    with torch.no_grad():
        mean, covariance = propagate.parameter_moments(samples.to(propagate.nodes))
    names = propagate.pattern.names
    labels = [f"E[{name}]" for name in names]
    columns = [mean]
    embedded = [i for i, name in enumerate(names) if name in propagate.pattern.embedded]
    for i in embedded:
        for j in embedded:
            if j <= i:
                labels.append(f"Cov[{names[i]}, {names[j]}]" if i != j else f"Var[{names[i]}]")
                columns.append(covariance[..., i, j, None])
    return tuple(labels), _result(torch.cat(columns, dim=-1))


def _warn_of_chains(quality: Diagnostics) -> None:
    if quality.problems:
        warnings.warn(
            "The chains have not converged: " + "; ".join(quality.problems) + ". Draw more, or look at the "
            "diagnostics before using the posterior.",
            ConvergenceWarning,
            stacklevel=3,
        )


def _warn_of_tolerance(quality: Diagnostics, likelihood: likelihoods.Likelihood) -> None:
    if getattr(likelihood, "epsilon", None) is None or not quality.posterior_variance > 0:
        return
    if quality.posterior_variance > quality.model_error_variance:
        warnings.warn(
            f"The tolerance ε sets the width of the prediction: V[μ] = {quality.posterior_variance:.3g} against "
            f"E[σ²] = {quality.model_error_variance:.3g}, means over the data. Use a smaller epsilon=, unless the "
            "model is as good as exact.",
            ToleranceWarning,
            stacklevel=3,
        )


def _warn_of_box(simulator: Simulator, propagate: NISP, alpha: Tensor) -> None:
    leaves = getattr(simulator, "leaves_box", None)
    if leaves is None:
        return
    num = 512
    xi = propagate.draw_germ(num, seed=0)
    with torch.no_grad():
        values = propagate.with_held(propagate.parameters_at(alpha.to(propagate.nodes), xi))
        share = float(leaves(values).to(torch.float64).mean())
    if share > 0.05:
        warnings.warn(
            f"{share:.0%} of the calibrated density of the parameters lies outside the box that the surrogate was "
            "built on. Build it on a larger box.",
            ExtrapolationWarning,
            stacklevel=3,
        )


def _settings(propagate: NISP, fit: LeastSquares, embedding: str, seed: int, num_warmup: int) -> dict[str, Any]:
    choice = propagate.rule_choice
    return {
        "embedding": embedding,
        "seed": seed,
        "num_warmup": num_warmup,
        "order": propagate.order,
        "gauss_nodes": choice.size if choice.kind == "tensor" else None,
        "sd_floor": propagate.sd_floor,
        "center": fit.scaling.center.tolist(),
        "scale": fit.scaling.scale.tolist(),
        "log": fit.scaling.log.tolist(),
        "fixed": dict(propagate.fixed),
        "units": {parameter.name: parameter.unit for parameter in propagate.free},
    }


def _mean_square(sd: Tensor) -> float:
    return float(sd.square().mean())


def _result(value: Tensor) -> Tensor:
    return value.detach().to(device="cpu", dtype=torch.float64)
