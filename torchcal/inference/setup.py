"""From a simulator, a recording and choices to a well-posed problem, with every check before any long work."""

import copy
from collections.abc import Callable, Mapping
from typing import Any

import torch

from torchcal import likelihoods
from torchcal.checks import outside_inference_mode, whole
from torchcal.data import Recording
from torchcal.display import raised
from torchcal.embeddings import Embedding, Pattern
from torchcal.errors import (
    DomainError,
    EmbeddingError,
    IdentifiabilityWarning,
    ImproperPosteriorError,
    RecordingError,
    SimulatorError,
    TorchcalError,
    TorchcalWarning,
    warn,
)
from torchcal.inference.fitting import allowed_solver_error, plain_propagation
from torchcal.models import Problem
from torchcal.polychaos import Rule
from torchcal.priors import CoefficientPrior
from torchcal.propagation import NISP, RuleChoice
from torchcal.simulators import Parameter, Scaling, Simulator, Trajectories, check_slopes, free_parameters, workable

__all__ = ["PriorMaker", "check_dtype", "check_inputs", "check_rule", "check_run", "embedded_problem", "warn_of_tails"]

PriorMaker = Callable[[NISP], CoefficientPrior]

RANGES = {torch.float32: (1e-15, 1e17), torch.float64: (1e-140, 1e150)}
"""Spread at least, and values at most, of data whose likelihood a dtype can hold."""

NODES_IN_TIME = 3
"""Gauss nodes for each germ with which the search for trajectories begins; at the maximum they are refined."""


def check_inputs(
    simulator: Simulator, recording: Recording, fixed: Mapping[str, float] | None
) -> tuple[Simulator, tuple[Parameter, ...]]:
    """Raise for what cannot be calibrated, before any long work.

    Returns:
        The simulator, in time bound to the recording and with time steps that work at the first guess, and without a
        degree that does not hold; and its free parameters.

    Warns:
        PropagationWarning: Where the degree does not hold.
    """
    if not isinstance(simulator, Simulator):
        raise DomainError(
            f"Expected a torchcal.Simulator. Got {type(simulator).__name__}. Wrap the function: "
            "torchcal.Simulator(f, parameters=[...])."
        )
    if not isinstance(recording, Recording):
        raise RecordingError(
            f"Expected a torchcal.Recording. Got {type(recording).__name__}. Wrap the data: "
            "torchcal.Recording(x=x, y=y)."
        )
    if count := int(recording.copies.sum()):
        todo = "drop them with recording.subset(~recording.copies)" if recording.runs is None else "leave the run out"
        warn(
            f"{count} of {recording.n} rows are others once more, as of a table or a run that was read twice. They "
            f"count as data of their own, and the posterior is too narrow: {todo}.",
            TorchcalWarning,
        )
    simulator = simulator.bind(recording)
    free, held = free_parameters(simulator.parameters, fixed)
    scaling = Scaling.from_parameters(free)
    generator = torch.Generator().manual_seed(0)
    tries = torch.randn(32, len(free), generator=generator, dtype=torch.float64)
    tries = tries * torch.logspace(-3, 0.5, 32, dtype=torch.float64)[:, None]
    low, high = scaling.bounds(free)
    tries[0] = 0
    tries = torch.maximum(torch.minimum(tries, high), low)
    physical = scaling.physical(tries)
    named = {parameter.name: physical[:, i] for i, parameter in enumerate(free)}
    named |= {name: torch.full((32,), value, dtype=torch.float64) for name, value in held.items()}
    values = torch.stack([named[name] for name in simulator.names], dim=-1)
    if isinstance(simulator, Trajectories):
        guess = values[0].clone()
        for parameter in free:
            if parameter.initial is not None:
                guess[simulator.names.index(parameter.name)] = parameter.initial
        simulator = workable(simulator, guess[None], 100 * allowed_solver_error(recording))
    count = simulator.check(recording.x, values, recording.outputs)
    if count != len(recording.y):
        raise SimulatorError(
            f"Expected {len(recording.y)} output values, as in the recording ({recording.n} conditions × "
            f"{len(recording.outputs)} outputs). Got {count} from the simulator."
        )
    columns = [simulator.names.index(parameter.name) for parameter in free]
    # In the middle of the scales; and for what tells nothing there, ever farther off.
    asked = torch.cat([values[:1], values[len(values) // 2 :: 4]])
    check_slopes(simulator, recording.x, asked, columns, recording.outputs, kept=recording.observed)
    if simulator.degree is not None and plain_propagation(simulator, recording, fixed, scaling).degree is None:
        simulator = copy.copy(simulator)  # which has told of it; every propagation to come would again
        simulator.degree = None
    return simulator, free


def check_dtype(recording: Recording, dtype: torch.dtype) -> None:
    """Raise for data whose squares, and those of what is small beside them, a dtype cannot hold."""
    seen = recording.observed
    size, spread = float(recording.y[seen].abs().max()), float(recording.spread[seen].min())
    for wanted, instead in ((torch.float64, ""), (dtype, ", or dtype=torch.float64")):
        smallest, largest = RANGES[wanted]
        if spread < smallest or size > largest:
            raise DomainError(
                f"Expected data between {smallest:g} and {largest:g} for {wanted}: squares of others are 0 or infinite "
                f"there. Got a spread of {spread:.3g} and values up to {size:.3g}. Use other units, in which they are "
                f"near 1{instead}."
            )


def check_rule(rule: Any, pattern: Pattern) -> None:
    """Raise for so few nodes that a user asks for that outputs do not tell all coefficients."""
    least = pattern.order + 1
    if rule is None or isinstance(rule, Rule) or not pattern.num_germs:
        return
    if whole("rule", rule, 1, also="a torchcal.polychaos.Rule or None") < least:
        raise DomainError(
            f"Expected rule= of at least {least} Gauss nodes a germ for an embedding of order {pattern.order}: with "
            f"fewer the spread of outputs does not tell all coefficients. Got {rule} (leave it out, and enough are "
            "found)."
        )


def check_run(num_starts: int, device: torch.device | str | None) -> int:
    """The number of starts; raise for one or a device that cannot be used, or where no derivatives are taken."""
    outside_inference_mode()
    num_starts = whole("num_starts", num_starts, 1)
    if device is None:
        return num_starts
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:
        raise DomainError(
            f"Expected a device that torch can use here. Got {device!r} ({error}). Use 'cpu', or leave it out."
        ) from error
    return num_starts


def warn_of_tails(problem: Problem) -> None:
    """Warn where draws from a posterior have no finite variance, whatever they look like.

    Warns:
        IdentifiabilityWarning: With the numbers.
    """
    flat = _flat(problem.likelihood, problem.prior)
    count = len(problem.y) if problem.observed is None else int(problem.observed.sum())
    # On a logarithmic scale outputs grow faster than any power.
    if flat and count - flat <= 2 and not bool(problem.propagate.scaling.log.any()):
        warn(
            f"With N = {count} data and {flat} flat coefficients the posterior of the {problem.likelihood.name} "
            "likelihood has no finite variance: far out it falls with the spread to the power of -N only, and the sd "
            "of its draws say nothing. Use a Uniform or Normal prior, ABC(), or more data.",
            IdentifiabilityWarning,
        )


def _flat(likelihood: likelihoods.Likelihood, prior: CoefficientPrior) -> int:
    """Coefficients without a bound in whose direction a marginal likelihood alone makes the posterior fall."""
    if likelihood.name not in ("marginal", "gaussian_marginal") or prior.proper:
        return 0
    return int((~torch.isfinite(prior.high - prior.low)).sum())


def embedded_problem(
    simulator: Simulator,
    recording: Recording,
    embedding: Embedding,
    likelihood: likelihoods.Likelihood,
    prior: PriorMaker,
    scaling: Scaling,
    *,
    fixed: Mapping[str, float] | None,
    order: int | None,
    rule: Any,
    device: torch.device | str | None,
) -> Problem:
    """The problem of the embedded calibration, or an error that says why it has no answer.

    With a ``rule`` it does not call the simulator, so that every check can be made before any long work.
    """
    if isinstance(likelihood, likelihoods.Additive):
        raise EmbeddingError(
            "Expected a likelihood of an embedded model. Got the additive one, whose discrepancy lies outside "
            "the model. Use torchcal.calibrate_additive(simulator, recording)."
        )
    observed = recording.observed
    noise = recording.noise_sd
    y = torch.where(observed, recording.y, torch.zeros_like(recording.y))
    if rule is None and isinstance(simulator, Trajectories):
        free, _ = free_parameters(simulator.parameters, fixed)
        uncertain = embedding.bind([parameter.name for parameter in free]).num_germs
        if uncertain and NODES_IN_TIME**uncertain <= 4096:
            rule = RuleChoice("tensor", NODES_IN_TIME)
    propagate = NISP(
        simulator,
        embedding,
        recording.x,
        fixed=fixed,
        outputs=recording.outputs,
        scaling=scaling,
        order=order,
        rule=rule,
        trial_spread=0.2,  # enough to start with: the rule is refined at the maximum
    )
    germs = propagate.pattern.num_germs
    if order is not None and order < propagate.pattern.order:
        raise DomainError(
            f"Expected order= of at least the embedding's, {propagate.pattern.order}: outputs whose expansion is cut "
            f"below it do not tell all coefficients. Got {order}."
        )
    if germs == 0 and likelihood.needs != "mean":
        raise EmbeddingError(
            f"Expected an embedding with at least one uncertain parameter for the {likelihood.name} likelihood. "
            "Got none: there is no model-error sd. Embed a parameter, or use ABCMean()."
        )
    likelihood = likelihood.resolve(
        y[observed], recording.spread[observed], germs, None if noise is None else noise[observed]
    )
    for name in ("epsilon", "floor"):
        value = getattr(likelihood, name, None)
        given = torch.as_tensor(0.0 if value is None else value)
        if given.ndim and given.shape != y[observed].shape:
            raise DomainError(
                f"Expected {name} as a number or of shape {tuple(y[observed].shape)}, one for each observed "
                f"output. Got {tuple(given.shape)}."
            )
    epsilon = getattr(likelihood, "epsilon", None)
    if epsilon is not None:
        propagate.sd_floor = likelihoods.SMOOTHING * float(torch.as_tensor(epsilon, dtype=torch.float64).min())
    else:
        # Likelihoods without a tolerance are singular at zero spread; the floor is where that is cut off.
        propagate.sd_floor = 1e-6 * float(recording.spread.min())
    propagate = propagate.to(device=device)
    if isinstance(prior, CoefficientPrior):
        kind = type(prior).__name__
        raise DomainError(
            f"Expected prior as a function from a NISP to a torchcal prior, such as torchcal.priors.{kind} itself. Got "
            f"an instance, {kind}(...). Write prior=torchcal.priors.{kind}, or with options prior=lambda propagate: "
            f"torchcal.priors.{kind}(propagate, ...)."
        )
    if not callable(prior):
        raise DomainError(
            "Expected prior as a function from a NISP to a torchcal prior, such as torchcal.priors.Flat. "
            f"Got {prior!r}."
        )
    try:
        distribution = prior(propagate)
    except TorchcalError:
        raise
    except Exception as error:
        raise DomainError(
            "Expected prior as a function from a NISP to a torchcal prior, such as torchcal.priors.Flat. Got one that "
            f"raised {raised(error)}."
        ) from error
    if not isinstance(distribution, CoefficientPrior):
        raise DomainError(
            "Expected prior as a function from a NISP to a torchcal prior, such as torchcal.priors.Flat. "
            f"Got one that returns {type(distribution).__name__}."
        )
    if isinstance(likelihood, likelihoods.Full) and not distribution.proper:
        raise ImproperPosteriorError(
            "Expected a proper prior with the full likelihood. Got a flat one: no more data than uncertain parameters "
            "do not constrain all coefficients, and the density at the data grows without limit as the spread "
            "vanishes. Use a Uniform or Normal prior, or ABC()."
        )
    count, flat = int(observed.sum()), _flat(likelihood, distribution)
    if flat and count <= flat:
        raise ImproperPosteriorError(
            f"Expected more data than flat coefficients for the {likelihood.name} likelihood. Got N = {count} and "
            f"{flat}: far out the likelihood falls with the spread to the power of -N only, and the posterior has no "
            "finite integral. Use a Uniform or Normal prior, ABC(), or more data."
        )
    if likelihood.needs == "mean" and germs and not distribution.proper:
        raise ImproperPosteriorError(
            "Expected a proper prior with the mean-only ABC likelihood. Got a flat one: the likelihood does not "
            "constrain the non-leading coefficients, and the posterior has no finite integral (text under "
            "Eq. 20). Use ABC(), a Uniform or Normal prior, or PolynomialChaos(order=0)."
        )

    germ = None
    if likelihood.needs == "samples":
        germ = propagate.draw_germ(getattr(likelihood, "num_samples", likelihoods.DRAWS), seed=0)
    return Problem(
        y=y.to(device=device),
        propagate=propagate,
        likelihood=likelihood,
        prior=distribution,
        noise=None if noise is None else noise.to(device=device),
        observed=None if bool(observed.all()) else observed.to(device=device),
        germ=germ,
    )
