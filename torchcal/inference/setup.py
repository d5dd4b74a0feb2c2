"""From a simulator, a recording and choices to a well-posed problem in good coordinates."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import pyro
import torch
from torch import Tensor

from torchcal import likelihoods
from torchcal.data import Recording
from torchcal.embeddings import Embedding, PolynomialChaos
from torchcal.errors import (
    DomainError,
    EmbeddingError,
    ImproperPosteriorError,
    RecordingError,
    SimulatorError,
)
from torchcal.inference.newton import minimise
from torchcal.models import Problem
from torchcal.priors import CoefficientPrior, Flat
from torchcal.propagation import NISP
from torchcal.simulators import Parameter, Scaling, Simulator, free_parameters

__all__ = ["LeastSquares", "check_inputs", "embedded_problem", "least_squares", "preserve_random_state"]

PriorMaker = Callable[[NISP], CoefficientPrior]

_LEAST_SQUARES_STARTS = 64


@dataclass(frozen=True)
class LeastSquares:
    """The best single parameter vector, which sets coordinates and starting points.

    Attributes:
        scaling: Coordinates of the free parameters.
        scaled: The estimate in them, ``(d,)``.
        residual: y − f(x; λ) over the observed data.
        relative: RMS residual relative to the spread of the data.
    """

    scaling: Scaling
    scaled: Tensor
    residual: Tensor
    relative: float


class preserve_random_state:
    """Seed every random generator inside a ``with`` block and restore them all afterwards."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __enter__(self) -> None:
        self._state = pyro.util.get_rng_state()
        pyro.set_rng_seed(self.seed)

    def __exit__(self, *_: object) -> None:
        pyro.util.set_rng_state(self._state)


def check_inputs(
    simulator: Simulator, recording: Recording, fixed: Mapping[str, float] | None
) -> tuple[tuple[Parameter, ...], dict[str, float]]:
    """Raise for what cannot be calibrated, before any long work; return free and held parameters."""
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
    free, held = free_parameters(simulator.parameters, fixed)
    scaling = Scaling.from_parameters(free)
    generator = torch.Generator().manual_seed(0)
    tries = torch.randn(32, len(free), generator=generator, dtype=torch.float64)
    tries = tries * torch.logspace(-3, 0.5, 32, dtype=torch.float64)[:, None]
    low, high = scaling.bounds(free)
    tries[0] = 0
    tries = torch.maximum(torch.minimum(tries, high), low)
    physical = scaling.physical(tries)
    columns = {parameter.name: physical[:, i] for i, parameter in enumerate(free)}
    columns |= {name: torch.full((32,), value, dtype=torch.float64) for name, value in held.items()}
    values = torch.stack([columns[name] for name in simulator.names], dim=-1)
    count = simulator.check(recording.x, values, recording.outputs)
    if count != len(recording.y):
        raise SimulatorError(
            f"Expected {len(recording.y)} output values, as in the recording ({recording.n} conditions × "
            f"{len(recording.outputs)} outputs). Got {count} from the simulator."
        )
    return free, held


def least_squares(
    simulator: Simulator, recording: Recording, fixed: Mapping[str, float] | None, *, seed: int
) -> LeastSquares:
    """Fit one parameter vector from many starts, and scale parameters without two bounds by the fit.

    The scale of such a parameter is the shift that moves the outputs by the spread of the data.
    """
    free, _ = free_parameters(simulator.parameters, fixed)
    observed, y, spread = recording.observed, recording.y, recording.spread
    y = torch.where(observed, y, torch.zeros_like(y))

    def residual(propagate: NISP, scaled: Tensor) -> Tensor:
        return ((propagate.mean(scaled) - y) / spread)[..., observed]

    def build(scaling: Scaling) -> tuple[NISP, Flat]:
        propagate = NISP(
            simulator,
            PolynomialChaos(order=0),
            recording.x,
            fixed=fixed,
            outputs=recording.outputs,
            scaling=scaling,
        )
        return propagate, Flat(propagate)

    scaling = Scaling.from_parameters(free)
    with preserve_random_state(seed):
        propagate, prior = build(scaling)
        reach = 10 ** (torch.rand(_LEAST_SQUARES_STARTS, 1, dtype=torch.float64) * 2.5 - 1)
        unbounded = ~torch.isfinite(prior.low - prior.high)
        starts = prior.sample((_LEAST_SQUARES_STARTS,))
        starts = torch.where(unbounded, starts * reach, starts)
        starts[0] = 0
    best = _fit(propagate, prior, residual, prior.transform.unbound(starts))
    for _ in range(2):  # once more in the coordinates that the first fit suggests
        slope = _sensitivity(propagate, best, residual)
        center = propagate.scaling.scaled(propagate.scaling.physical(best))
        natural = propagate.scaling.center + propagate.scaling.scale * center
        size = propagate.scaling.scale / slope
        fallback = torch.maximum(natural.abs(), torch.ones_like(natural))
        scale = torch.where(torch.isfinite(size) & (size > 0), size, fallback)
        physical = propagate.scaling.physical(best)
        scaling = Scaling.from_parameters(free, center=natural, scale=scale)
        propagate, prior = build(scaling)
        near = scaling.scaled(physical)
        starts = near + 0.1 * torch.randn(
            8, len(near), dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
        )
        starts[0] = near
        best = _fit(propagate, prior, residual, prior.transform.unbound(starts))
    with torch.no_grad():
        relative = residual(propagate, best)
    return LeastSquares(
        scaling, best, relative * spread[observed], float(relative.square().mean().sqrt())
    )


def _fit(
    propagate: NISP, prior: Flat, residual: Callable[[NISP, Tensor], Tensor], starts: Tensor
) -> Tensor:
    def objective(u: Tensor) -> Tensor:
        return 0.5 * residual(propagate, prior.transform.bound(u)).square().mean(-1)

    found = minimise(objective, starts, tolerance=1e-13)
    if not math.isfinite(float(found.values[0])):
        raise SimulatorError(
            "Expected finite outputs for some parameter values. Got none from any of "
            f"{len(starts)} starting points. Give the parameters bounds or initial=."
        )
    return prior.transform.bound(found.points[0])


def _sensitivity(propagate: NISP, point: Tensor, residual: Callable[[NISP, Tensor], Tensor]) -> Tensor:
    """RMS over the data of ∂(output / spread)/∂λ̃, by central differences, ``(d,)``."""
    step = 1e-5
    shift = step * torch.eye(len(point), dtype=point.dtype)
    with torch.no_grad():
        change = residual(propagate, point + shift) - residual(propagate, point - shift)
    return (change / (2 * step)).square().mean(-1).sqrt()


def embedded_problem(
    simulator: Simulator,
    recording: Recording,
    embedding: Embedding,
    likelihood: likelihoods.Likelihood,
    prior: PriorMaker,
    fit: LeastSquares,
    *,
    fixed: Mapping[str, float] | None,
    order: int | None,
    rule: Any,
    device: torch.device | str | None,
) -> Problem:
    """The problem of the embedded calibration, or an error that says why it has no answer."""
    if isinstance(likelihood, likelihoods.Additive):
        raise EmbeddingError(
            "Expected a likelihood of an embedded model. Got the additive one, whose discrepancy lies outside "
            "the model. Use torchcal.calibrate_additive(simulator, recording)."
        )
    observed = recording.observed
    noise = recording.noise_sd
    y = torch.where(observed, recording.y, torch.zeros_like(recording.y))
    propagate = NISP(
        simulator,
        embedding,
        recording.x,
        fixed=fixed,
        outputs=recording.outputs,
        scaling=fit.scaling,
        order=order,
        rule=rule,
        trial_spread=0.2,  # enough to start with: the rule is refined at the maximum
    )
    germs = propagate.pattern.num_germs
    if germs == 0 and likelihood.needs != "mean":
        raise EmbeddingError(
            f"Expected an embedding with at least one uncertain parameter for the {likelihood.name} likelihood. "
            "Got none: there is no model-error sd. Embed a parameter, or use ABCMean()."
        )
    likelihood = likelihood.resolve(y[observed], recording.spread[observed], germs)
    epsilon = getattr(likelihood, "epsilon", None)
    if epsilon is not None:
        epsilon = torch.as_tensor(epsilon, dtype=torch.float64)
        if epsilon.ndim and epsilon.shape != y[observed].shape:
            raise DomainError(
                f"Expected epsilon as a number or of shape {tuple(y[observed].shape)}, one for each observed "
                f"output. Got {tuple(epsilon.shape)}."
            )
        propagate.sd_floor = likelihoods.SMOOTHING * float(epsilon.min())
    else:
        # Likelihoods without a tolerance are singular at zero spread; the floor is where that is cut off.
        propagate.sd_floor = 1e-6 * float(recording.spread.min())
    propagate = propagate.to(device=device)
    distribution = prior(propagate)
    if not isinstance(distribution, CoefficientPrior):
        raise DomainError(
            "Expected prior as a function from a NISP to a torchcal prior, such as torchcal.priors.Flat. "
            f"Got one that returns {type(distribution).__name__}."
        )
    if likelihood.needs == "mean" and germs and not distribution.proper:
        raise ImproperPosteriorError(
            "Expected a proper prior with the mean-only ABC likelihood. Got a flat one: the likelihood does not "
            "constrain the non-leading coefficients, and the posterior has no finite integral (text under "
            "Eq. 20). Use ABC(), a Uniform or Normal prior, or PolynomialChaos(order=0)."
        )

    germ = None
    if likelihood.needs == "samples":
        germ = propagate.draw_germ(getattr(likelihood, "num_samples", 256), seed=0)
    return Problem(
        y=y.to(device=device),
        propagate=propagate,
        likelihood=likelihood,
        prior=distribution,
        noise=None if noise is None else noise.to(device=device),
        observed=None if bool(observed.all()) else observed.to(device=device),
        germ=germ,
    )


