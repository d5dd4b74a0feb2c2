"""`calibrate_additive`: the conventional calibration, which stands beside the embedded one."""

import dataclasses
import math
from collections.abc import Mapping

import torch

from torchcal import likelihoods, models
from torchcal.data import Recording
from torchcal.errors import IdentifiabilityWarning, ImproperPosteriorError, warn
from torchcal.inference.estimate import maximise
from torchcal.inference.fitting import LeastSquares, least_squares, plain_propagation
from torchcal.inference.sampling import Plan, draw_unless_interrupted
from torchcal.inference.setup import check_dtype, check_inputs, check_run
from torchcal.inference.summary import diagnose, settings_of, to_result, warn_of_bounds, warn_of_box, warn_of_chains
from torchcal.models import Problem
from torchcal.priors import CoefficientPrior, Flat
from torchcal.propagation import NISP
from torchcal.results import AdditiveCalibration, MapEstimate, sigma_unit
from torchcal.simulators import Simulator
from torchcal.threads import few_threads, with_torch_settings

__all__ = ["calibrate_additive"]


@with_torch_settings
def calibrate_additive(
    simulator: Simulator,
    recording: Recording,
    *,
    fixed: Mapping[str, float] | None = None,
    num_samples: int | None = None,
    num_chains: int | None = None,
    num_warmup: int | None = None,
    target_ess: float | None = None,
    num_starts: int = 32,
    seed: int = 0,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float64,
    sampler: str = "nuts",
    target_accept: float | None = None,
    progress: bool = True,
) -> AdditiveCalibration:
    r"""Calibrate the conventional way: λ and ln σ of an additive Gaussian discrepancy (Eqs. 2-4).

    Of several outputs, σ is that of the first; the others' are in proportion to the spread of their data, so that
    units do not matter. Flat priors on λ (within its bounds) and ln σ; with known noise, where data that need no σ
    would leave ln σ free, this ends at a thousandth of the smallest noise sd. This is the baseline whose push-forward
    shrinks with more data, however wrong the model is.

    Args:
        simulator: The model, as for `torchcal.calibrate`.
        recording: The data. A known noise sd s adds s² to σ².
        fixed: Parameters to hold.
        num_samples: Posterior draws a chain; 0 for the MAP alone; by default 1000. With ``target_ess`` the most of
            them, by default 20,000.
        num_chains: Chains; by default 4, and with ``target_ess`` one for every 120 effective draws wanted, 32 to 400,
            or fewer where an evaluation is dear.
        num_warmup: Draws thrown away a chain; by default as for `torchcal.calibrate`.
        target_ess: Draw until the effective sample size of every α, bulk and tail, is at least this and every R-hat
            below 1.01.
        num_starts: Starting points of the optimiser.
        seed: Of every random number.
        device: Where the tensors live.
        dtype: Of the sampler's arithmetic; the maximum is always found in float64.
        sampler: ``"nuts"``, all chains as one batched tensor program; ``"hmc"``, the same with one trajectory length
            for all chains, faster where many draws of a few α are wanted; or ``"pyro"``, Pyro's NUTS on the Pyro
            model, chain after chain, which is the reference.
        target_accept: Mean acceptance that the step size aims at, between 0 and 1; by default 0.65 for
            ``"nuts"``, 0.8 for the others, and more where trajectories diverge: draws among which more than one in
            10,000 diverged are drawn anew with smaller steps, up to three times (not by ``"pyro"``, nor where this is
            given).
        progress: Whether to show a bar where it takes more than two seconds.

    Returns:
        A `torchcal.results.AdditiveCalibration`.

    Raises:
        TorchcalError: A subclass that says what was expected, what came and what to do.
        ImproperPosteriorError: If the model fits the data exactly, or has as many parameters as there are data, and
            the noise is not known: the likelihood then grows without limit as σ → 0. With known noise, if it has as
            many parameters without two bounds.

    Warns:
        ConvergenceWarning: If starts or chains disagree.
        InterruptionWarning: After Ctrl-C while it draws: the result has the draws that there are, or the maximum alone.
        IdentifiabilityWarning: If the data do not determine a parameter, or the posterior has no finite variance.
        TorchcalWarning: If a table or a run of the recording is there twice.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 2-4.
    """
    plan = Plan(
        num_samples, num_chains, num_warmup, sampler, seed, dtype, target_accept, progress, target_ess
    )
    seed, num_starts = plan.seed, check_run(num_starts, device)
    simulator, free = check_inputs(simulator, recording, fixed)
    check_dtype(recording, plan.dtype)
    observed = recording.observed
    count = int(observed.sum())
    unbounded = sum(parameter.low is None or parameter.high is None for parameter in free)
    if recording.noise_sd is None and count <= len(free):
        raise ImproperPosteriorError(
            f"Expected more data than parameters for the additive likelihood. Got N = {count} and d = "
            f"{len(free)}: the residuals can vanish, and the likelihood grows without limit as σ → 0. Record more, "
            "hold parameters fixed, give the recording's noise=, or use torchcal.calibrate."
        )
    if count <= unbounded:
        raise ImproperPosteriorError(
            f"Expected more data than parameters without two bounds for the additive likelihood. Got N = {count} and "
            f"{unbounded}: the likelihood does not fall with σ faster than more of their values come to be likely, and "
            "the posterior has no finite integral. Record more, give bounds, hold parameters fixed, or use "
            "torchcal.calibrate."
        )
    if recording.noise_sd is None and plan.samples and count - unbounded <= 2:
        warn(
            f"With N = {count} data and d = {unbounded} parameters without two bounds the posterior has no finite "
            "variance: its tails are those of Student's t with N − d degrees of freedom, and the sd of its draws say "
            "nothing. Record more, hold parameters with fixed=, or give the recording's noise=.",
            IdentifiabilityWarning,
        )
    fit = least_squares(simulator, recording, fixed, seed=seed)
    simulator = fit.simulator
    if fit.relative < 1e-7 and recording.noise_sd is None:
        raise ImproperPosteriorError(
            f"Expected residuals for the additive likelihood. Got a fit that is exact to {fit.relative:.1e} of the "
            "data's spread: the likelihood grows without limit as σ → 0. Give the recording's noise=, or use "
            "torchcal.calibrate."
        )
    y = torch.where(observed, recording.y, torch.zeros_like(recording.y))
    propagate = plain_propagation(simulator, recording, fixed, fit.scaling).to(device=device)
    noise = recording.noise_sd
    problem = Problem(
        y=y.to(device=device),
        propagate=propagate,
        likelihood=likelihoods.Additive(),
        prior=_additive_prior(propagate, fit, recording),
        noise=None if noise is None else noise.to(device=device),
        observed=None if bool(observed.all()) else observed.to(device=device),
        unit=None if len(recording.outputs) == 1 else sigma_unit(recording).to(device=device),
    )
    with few_threads(problem.cost * num_starts):
        estimate = maximise(problem, fit.scaled, starts=None, num_starts=num_starts, seed=seed, progress=progress)
    draws = None
    if plan.samples:
        with few_threads(problem.cost * plan.chains(problem.cost)):
            draws = draw_unless_interrupted(problem, estimate, models.additive, plan)
    names = (*propagate.pattern.names, "ln sigma")
    samples = None if draws is None else draws.alpha
    quality = diagnose(estimate, draws, samples, None, names, None)
    warn_of_chains(quality)
    warn_of_box(simulator, propagate, estimate.alpha[:-1], None if samples is None else samples[..., :-1])
    warn_of_bounds(problem, estimate.alpha)
    mean = propagate.scaling.physical(estimate.alpha[:-1])
    result = AdditiveCalibration(
        map=MapEstimate(
            alpha=to_result(estimate.alpha),
            mean=to_result(mean),
            covariance=torch.zeros(len(free), len(free), dtype=torch.float64),
            objective=estimate.objective,
            alpha_names=names,
            parameters=propagate.pattern.names,
        ),
        samples=samples,
        diagnostics=quality,
        recording=recording,
        propagate=propagate,
        settings=settings_of(problem, fit, "additive", seed, plan.warmup),
    )
    if result.noise_suffices:  # the posterior is flat in ln σ, then, which says nothing about the data
        others = quality.null_directions.clone()
        others[:, -1] = 0.0
        _, size, rows = torch.linalg.svd(others, full_matrices=False)
        quality = dataclasses.replace(quality, null_directions=rows[size > 0.1])
        result = dataclasses.replace(result, diagnostics=quality)
    return result


def _additive_prior(propagate: NISP, fit: LeastSquares, recording: Recording) -> CoefficientPrior:
    flat = Flat(propagate)
    like = flat.low
    unit = sigma_unit(recording)[recording.observed]
    noise = recording.noise_sd
    size = float((fit.residual / unit).square().mean().sqrt())
    # With known noise the likelihood no longer falls as σ → 0, and a flat ln σ needs a floor to be proper.
    floor = -math.inf if noise is None else math.log(1e-3 * float((noise[recording.observed] / unit).min()))
    center = math.log(size) if size > 0 else floor + 1
    if noise is not None:
        center = max(center, floor + 1)
    return CoefficientPrior(
        torch.cat([flat.low, torch.tensor([floor]).to(like)]),
        torch.cat([flat.high, torch.tensor([math.inf]).to(like)]),
        torch.cat([fit.scaled.to(like), torch.tensor([center]).to(like)]),
        torch.cat([0.3 * torch.ones_like(flat.low), torch.tensor([0.5]).to(like)]),
    )
