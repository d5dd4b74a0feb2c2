"""The best single parameter vector, and the coordinates that it suggests."""

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.embeddings import PolynomialChaos
from torchcal.errors import ConvergenceWarning, SimulatorError, warn
from torchcal.inference.newton import minimise
from torchcal.inference.randomness import preserve_random_state
from torchcal.inference.tangent import minimise_by_tangents
from torchcal.priors import Flat
from torchcal.propagation import NISP
from torchcal.simulators import Parameter, Scaling, Simulator, Trajectories, free_parameters, settled

__all__ = ["LeastSquares", "allowed_solver_error", "least_squares", "plain_propagation"]

_LEAST_SQUARES_STARTS = 64
_PROBES = 8
"""Gradients from which the size of a slight derivative is taken."""

_FOLLOWED = 8
"""Of the starts of trajectories, those that are followed to the end."""


@dataclass(frozen=True)
class LeastSquares:
    """The best single parameter vector, which sets coordinates and starting points.

    Attributes:
        scaling: Coordinates of the free parameters.
        scaled: The estimate in them, ``(d,)``.
        residual: y − f(x; λ) over the observed data.
        relative: RMS residual relative to the spread of the data.
        simulator: The simulator; in time, with steps short enough at the estimate.
    """

    scaling: Scaling
    scaled: Tensor
    residual: Tensor
    relative: float
    simulator: Simulator


def least_squares(
    simulator: Simulator, recording: Recording, fixed: Mapping[str, float] | None, *, seed: int
) -> LeastSquares:
    """Fit one parameter vector from many starts, and scale parameters without two bounds by the fit.

    The scale of such a parameter is the shift that moves the outputs by the spread of the data. A simulator in time is
    fitted again with shorter steps where halving them changes the outputs at the estimate.
    """
    found = _least_squares(simulator, recording, fixed, seed=seed)
    if not isinstance(simulator, Trajectories):
        return found
    for _ in range(4):
        values = found.scaling.physical(found.scaled)
        held = plain_propagation(simulator, recording, fixed, found.scaling)
        finer = settled(simulator, held.with_held(values)[None], allowed_solver_error(recording))
        if finer is simulator:
            break
        simulator = finer
        found = _least_squares(simulator, recording, fixed, seed=seed, begin=values)
    return found


def allowed_solver_error(recording: Recording) -> Tensor:
    """Largest change of each output when time steps are halved, ``(n_total,)``.

    A hundredth of the default tolerance ε, and where the noise is known a fiftieth of it: that is far below what data
    can tell for as many as a thousand samples.
    """
    allowed = 1e-4 * recording.spread
    return allowed if recording.noise_sd is None else torch.minimum(allowed, 0.02 * recording.noise_sd)


def _least_squares(
    simulator: Simulator,
    recording: Recording,
    fixed: Mapping[str, float] | None,
    *,
    seed: int,
    begin: Tensor | None = None,
) -> LeastSquares:
    free, _ = free_parameters(simulator.parameters, fixed)
    observed, y, spread = recording.observed, recording.y, recording.spread
    y = torch.where(observed, y, torch.zeros_like(y))

    def residual(propagate: NISP, scaled: Tensor) -> Tensor:
        return ((propagate.mean(scaled) - y) / spread)[..., observed]

    def build(scaling: Scaling) -> tuple[NISP, Flat]:
        propagate = plain_propagation(simulator, recording, fixed, scaling)
        return propagate, Flat(propagate)

    scaling = Scaling.from_parameters(free)
    with preserve_random_state(seed):
        propagate, prior = build(scaling)
        starts = prior.sample((_LEAST_SQUARES_STARTS,))
        # Without two bounds the size is unknown: decades up to that of the data, parameter by parameter.
        decades = max(1.5, 1 + float(y[observed].abs().max().clamp_min(1.0).log10()))
        reach = 10 ** (torch.rand(starts.shape, dtype=torch.float64) * (decades + 1) - 1)
        reach[::2] = 10 ** (torch.rand(len(starts[::2]), 1, dtype=torch.float64) * 2.5 - 1)
    unbounded = ~torch.isfinite(prior.high - prior.low)
    starts = torch.where(unbounded, starts * reach, starts)
    starts[0] = _first_guess(free, scaling) if begin is None else scaling.scaled(begin)
    if begin is not None:
        starts = starts[:1]
    best = _fit(propagate, prior, residual, prior.transform.unbound(starts))
    for _ in range(2):  # once more in the coordinates that the first fit suggests
        slope = _sensitivity(propagate, best, residual, free)
        center = propagate.scaling.scaled(propagate.scaling.physical(best))
        natural = propagate.scaling.center + propagate.scaling.scale * center
        size = propagate.scaling.scale / slope
        fallback = torch.maximum(natural.abs(), torch.ones_like(natural))
        scale = torch.where(torch.isfinite(size) & (size > 0), size, fallback)
        physical = propagate.scaling.physical(best)
        scaling = Scaling.from_parameters(free, center=natural, scale=scale)
        propagate, prior = build(scaling)
        near = scaling.scaled(physical)
        count = 1 if isinstance(simulator, Trajectories) else 8
        starts = near + 0.1 * torch.randn(
            count, len(near), dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
        )
        starts[0] = near
        best = _fit(propagate, prior, residual, prior.transform.unbound(starts))
    with torch.no_grad():
        relative = residual(propagate, best)
    left = float(relative.square().mean().sqrt())
    guessed = [p.name for p in free if p.initial is None and (p.low is None or p.high is None)]
    if left > 1 and guessed:
        warn(
            f"The best single parameter vector leaves residuals of {left:.3g} times the spread of the data, so it fits "
            f"no better than a constant. If a better one exists, give {', '.join(guessed)} initial= or bounds.",
            ConvergenceWarning,
        )
    return LeastSquares(scaling, best, relative * spread[observed], left, simulator)


def plain_propagation(
    simulator: Simulator, recording: Recording, fixed: Mapping[str, float] | None, scaling: Scaling
) -> NISP:
    """The simulator itself, without model error, at a recording's conditions."""
    return NISP(
        simulator,
        PolynomialChaos(order=0),
        recording.x,
        fixed=fixed,
        outputs=recording.outputs,
        scaling=scaling,
    )


def _first_guess(free: Sequence[Parameter], scaling: Scaling) -> Tensor:
    """The user's ``initial`` values, and the centre of the others, in scaled coordinates."""
    center = scaling.physical(torch.zeros(len(free), dtype=torch.float64))
    guess = [float(center[i]) if p.initial is None else p.initial for i, p in enumerate(free)]
    return scaling.scaled(torch.tensor(guess, dtype=torch.float64))


def _fit(
    propagate: NISP, prior: Flat, residual: Callable[[NISP, Tensor], Tensor], starts: Tensor
) -> Tensor:
    def objective(model: NISP, u: Tensor) -> Tensor:
        return 0.5 * residual(model, prior.transform.bound(u)).square().mean(-1)

    if isinstance(propagate.simulator, Trajectories):
        if len(starts) > _FOLLOWED:
            starts = minimise_by_tangents(objective, propagate, starts, max_iterations=10).points[:_FOLLOWED]
        found = minimise_by_tangents(objective, propagate, starts, tolerance=1e-13)
    else:
        found = minimise(lambda u: objective(propagate, u), starts, tolerance=1e-13)
    if not math.isfinite(float(found.values[0])):
        raise SimulatorError(
            "Expected finite outputs for some parameter values. Got none from any of "
            f"{len(starts)} starting points. Give the parameters bounds or initial=."
        )
    return prior.transform.bound(found.points[0])


def _sensitivity(
    propagate: NISP, point: Tensor, residual: Callable[[NISP, Tensor], Tensor], free: Sequence[Parameter]
) -> Tensor:
    """RMS over the data of ∂(output / spread)/∂λ̃, by central differences, ``(d,)``."""
    step = 1e-5 * point.abs().clamp_min(1.0)
    shift = torch.diag(step)
    with torch.no_grad():
        change = residual(propagate, point + shift) - residual(propagate, point - shift)
    found = (change / (2 * step[:, None])).square().mean(-1).sqrt()
    # Of two bounds the scale is theirs; of one, large steps go away from it.
    away = torch.tensor([0.0 if p.low is not None and p.high is not None else -1.0 if p.high is not None else 1.0
                         for p in free], dtype=point.dtype)  # fmt: skip
    if not bool(((found == 0) & (away != 0)).any()):
        return found
    return torch.where((found == 0) & (away != 0), _slight(propagate, point, residual, away), found)


def _slight(
    propagate: NISP, point: Tensor, residual: Callable[[NISP, Tensor], Tensor], away: Tensor
) -> Tensor:
    """The same of parameters whose small steps are lost in rounding, about; 0 where no step ``away`` moves the outputs
    so.

    A derivative is not lost. Gradients along random directions in the data have its RMS.
    """
    with torch.enable_grad():
        leaf = point.detach().clone().requires_grad_(True)
        left = residual(propagate, leaf)
        probes = torch.randn(_PROBES, len(left), dtype=left.dtype, generator=torch.Generator().manual_seed(0))
        slopes = torch.stack([torch.autograd.grad(left @ probe, leaf, retain_graph=True)[0] for probe in probes])
    found = (slopes / math.sqrt(len(left))).square().mean(0).sqrt()
    for i in range(len(found)):
        change = 0.0
        if float(found[i]) > 0 and float(away[i]) != 0:
            moved = point.clone()
            moved[i] += away[i] / found[i]
            with contextlib.suppress(SimulatorError), torch.no_grad():  # so far out nobody is asked to have an answer
                change = float((residual(propagate, moved) - left).square().mean().sqrt())
        if not 0.1 < change < 10:
            found[i] = 0.0
    return found
