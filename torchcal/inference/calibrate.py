"""`calibrate`: from a simulator and a recording to the density of its parameters."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchcal import likelihoods, models
from torchcal.data import Recording
from torchcal.embeddings import Embedding, Gaussian
from torchcal.errors import DomainError
from torchcal.inference.draws import Draws
from torchcal.inference.estimate import maximise
from torchcal.inference.fitting import allowed_solver_error, least_squares
from torchcal.inference.sampling import Plan, draw_unless_interrupted
from torchcal.inference.setup import (
    PriorMaker,
    check_dtype,
    check_inputs,
    check_rule,
    check_run,
    embedded_problem,
    warn_of_tails,
)
from torchcal.inference.starts import check_starts
from torchcal.inference.summary import (
    diagnose,
    mean_square,
    settings_of,
    to_result,
    warn_of_bounds,
    warn_of_box,
    warn_of_chains,
    warn_of_moments,
    warn_of_spike,
    warn_of_tolerance,
)
from torchcal.models import Problem
from torchcal.prediction import embedded_prediction
from torchcal.priors import Flat
from torchcal.propagation import NISP, PropagationCheck
from torchcal.results import Calibration, MapEstimate
from torchcal.results.in_time import check_nodes_in_time
from torchcal.simulators import Scaling, Simulator, Trajectories, settled
from torchcal.threads import few_threads, with_torch_settings

__all__ = ["calibrate"]


@with_torch_settings
def calibrate(
    simulator: Simulator,
    recording: Recording,
    *,
    embedding: Embedding | None = None,
    likelihood: likelihoods.Likelihood | str = "abc",
    prior: PriorMaker = Flat,
    fixed: Mapping[str, float] | None = None,
    num_samples: int | None = None,
    num_chains: int | None = None,
    num_warmup: int | None = None,
    target_ess: float | None = None,
    order: int | None = None,
    rule: Any = None,
    starts: Tensor | None = None,
    num_starts: int = 32,
    seed: int = 0,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float64,
    sampler: str = "nuts",
    target_accept: float | None = None,
    progress: bool = True,
) -> Calibration:
    r"""Calibrate a simulator whose model error is embedded in its parameters.

    Infers α, the coefficients of the density of λ, from :math:`p(\alpha | D) \propto p(D | \alpha) p(\alpha)` (Eq. 11).

    Args:
        simulator: The model. An `ODESimulator` takes a recording in time, and is solved with steps so short that
            halving them changes no output by more than 1e-4 of its spread, or 2 % of a known noise.
        recording: The data.
        embedding: Which parameters are uncertain, and how; by default all, as a multivariate normal (Eq. 10). In
            time the initial states that nobody knows, and parameters that each of several runs has one of, are
            inferred beside them without model error, unless the embedding names them.
        likelihood: One of `torchcal.likelihoods`, or its name; by default ABC with a tolerance of 1 % of the
            data's sd, or √((1 %)² + s²) where the noise's sd s is known.
        prior: A function from the propagation to a prior on α, such as a class of `torchcal.priors`.
        fixed: Parameters to hold, ``{name: physical value}``.
        num_samples: Posterior draws a chain; 0 for the MAP alone; by default 1000. With ``target_ess`` the most of
            them, by default 20,000.
        num_chains: Chains; by default 4, and with ``target_ess`` one for every 120 effective draws wanted, 32 to 400,
            or fewer where an evaluation is dear.
        num_warmup: Draws thrown away a chain, beside those that find the trajectory length of ``"hmc"`` and the smaller
            steps that divergences call for; by default 100 (60 with ``target_ess``), and half of ``num_samples`` but at
            least 300 for ``sampler="pyro"``.
        target_ess: Draw until the effective sample size of every α, bulk and tail, is at least this and every R-hat
            below 1.01.
        order: Degree of the output expansion; None for the full variance, 1 as in the paper's case studies.
        rule: Quadrature, see `torchcal.NISP`; by default found by itself. What is asked for is kept to, in predictions
            too: a `PropagationWarning` says where it is not enough.
        starts: Starting points of the optimiser ``(S, P)`` in scaled coordinates; by default made.
        num_starts: How many are made.
        seed: Of every random number; the global state is left as it was.
        device: Where the tensors live; the CPU by default.
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
        A `torchcal.results.Calibration`.

    Raises:
        TorchcalError: A subclass that says what was expected, what came and what to do.

    Warns:
        ConvergenceWarning: If starts or chains disagree.
        InterruptionWarning: After Ctrl-C while it draws: the result has the draws that there are, or the maximum alone.
        ToleranceWarning: If the tolerance rather than the model error sets the width of the prediction.
        PropagationWarning: If moments have not converged in nodes or order, or the best density has none.
        ExtrapolationWarning: If the calibration leaves the box of a surrogate.
        IdentifiabilityWarning: If the data do not determine a parameter, its bound does, or the posterior has no
            finite variance.
        TorchcalWarning: If a table or a run of the recording is there twice.
        UnitWarning: If units of recording and simulator differ.
        WorkerWarning: If workers that evaluate the simulator died, and their work was done again.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276.
    """
    plan = Plan(
        num_samples, num_chains, num_warmup, sampler, seed, dtype, target_accept, progress, target_ess
    )
    seed, num_starts = plan.seed, check_run(num_starts, device)
    embedding = Gaussian() if embedding is None else embedding
    if not isinstance(embedding, Embedding):
        instead = " (write Gaussian(), with brackets)" if isinstance(embedding, type) else ""
        raise DomainError(
            f"Expected embedding as one of torchcal.embeddings, such as Gaussian(). Got {embedding!r}{instead}."
        )
    simulator, free = check_inputs(simulator, recording, fixed)
    check_dtype(recording, plan.dtype)
    if isinstance(simulator, Trajectories):
        embedding = embedding.sparing([parameter.name for parameter in free], simulator.nuisance)

    def build(scaling: Scaling, rule: Any) -> Problem:
        return embedded_problem(
            simulator,
            recording,
            embedding,
            likelihoods.get(likelihood),
            prior,
            scaling,
            fixed=fixed,
            order=order,
            rule=rule,
            device=device,
        )

    check_rule(rule, embedding.bind([parameter.name for parameter in free]))
    # Once with one node, which calls no simulator, so that what cannot work is told at once.
    trial = build(Scaling.from_parameters(free), 1 if rule is None else rule)
    check_starts(trial, starts)
    if plan.samples:
        warn_of_tails(trial)
    fit = least_squares(simulator, recording, fixed, seed=seed)
    simulator = fit.simulator
    problem = build(fit.scaling, rule)
    with few_threads(problem.cost * (num_starts if starts is None else len(starts))):
        estimate = maximise(
            problem, fit.scaled, starts=starts, num_starts=num_starts, seed=seed, progress=progress
        )
    for _ in range(2):  # steps that were short enough at one point may not be at all nodes
        finer = _settled(problem.propagate, estimate.alpha, recording)
        if finer is simulator:
            break
        simulator = finer
        problem = build(fit.scaling, problem.propagate.rule_choice)
        again = maximise(
            problem, fit.scaled, starts=estimate.alpha.expand(2, -1), num_starts=2, seed=seed, progress=progress
        )
        estimate = dataclasses.replace(
            again, starts=estimate.starts, agreeing=estimate.agreeing, ties=estimate.ties
        )
    propagate = problem.propagate
    warn_of_spike(problem, estimate.alpha)  # where nothing keeps chains from it drawing may take for ever
    draws: Draws | None = None
    samples: Tensor | None = None
    if plan.samples:
        with few_threads(problem.cost * plan.chains(problem.cost)):
            draws = draw_unless_interrupted(problem, estimate, models.embedded, plan)
        samples = None if draws is None else draws.alpha
    check = _check_propagation(propagate, estimate.alpha, samples)
    prediction = embedded_prediction(propagate, estimate.alpha, None if samples is None else samples.flatten(0, 1))
    quality = diagnose(estimate, draws, samples, propagate, propagate.alpha_names, check)
    posterior = math.nan if prediction.sd_posterior is None else mean_square(prediction.sd_posterior, recording)
    quality = dataclasses.replace(
        quality,
        model_error_variance=mean_square(prediction.sd_model_error, recording),
        posterior_variance=posterior,
        map_variance=mean_square(prediction.map.sd, recording),
    )
    if propagate.pattern.num_germs:
        warn_of_tolerance(quality, problem.likelihood, recording, prediction.map.sd)
    warn_of_box(simulator, propagate, estimate.alpha, samples)
    warn_of_bounds(problem, estimate.alpha)
    warn_of_chains(quality)
    mean, covariance = propagate.parameter_moments(estimate.alpha)
    warn_of_moments(propagate, mean, covariance)
    return Calibration(
        map=MapEstimate(
            alpha=to_result(estimate.alpha),
            mean=to_result(mean),
            covariance=to_result(covariance),
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
        settings=settings_of(problem, fit, type(embedding).__name__, seed, plan.warmup),
    )


def _settled(propagate: NISP, alpha: Tensor, recording: Recording) -> Simulator:
    """The simulator, with time steps short enough at all nodes of a density."""
    simulator = propagate.simulator
    if not isinstance(simulator, Trajectories):
        return simulator
    with torch.no_grad():
        nodes = propagate.with_held(propagate.parameters_at(alpha, propagate.nodes))
    return settled(simulator, nodes.cpu(), allowed_solver_error(recording))


def _check_propagation(propagate: NISP, alpha: Tensor, samples: Tensor | None) -> PropagationCheck | None:
    """Convergence of the moments at the MAP and at a few draws."""
    if propagate.pattern.num_germs == 0:
        return None
    points = alpha[None]
    if samples is not None:
        points = torch.cat([points, samples[:8, -1].to(points)])
    if isinstance(propagate.simulator, Trajectories):
        return check_nodes_in_time(propagate, points)
    return propagate.check(points)
