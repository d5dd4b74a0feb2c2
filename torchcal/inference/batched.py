"""Batched No-U-Turn sampling: many chains at once, step size and coordinates adapted across them."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchcal.errors import ConvergenceError, ConvergenceWarning
from torchcal.inference import nuts_step
from torchcal.inference.draws import Draws
from torchcal.priors import Bounds

__all__ = ["run_batched_nuts"]

_WINDOWS = (0.3, 0.3, 0.4)
"""Shares of the warm-up: two windows that end in new coordinates, and one that sets the step size for good."""

DIVERGING = 5e-4
"""Share of divergent transitions at the end of the warm-up from which on smaller steps are tried."""

_WARM_UP_CHAINS = 64
"""Chains that adapt together: pooled draws make the covariance reliable after a few transitions each."""


@dataclass
class _DualAveraging:
    """Step size for a wanted acceptance (Hoffman & Gelman 2014, section 3.2), fed with means over chains."""

    log_step: float
    target: float
    count: int = 0
    error: float = 0.0
    averaged: float = 0.0

    def __post_init__(self) -> None:
        self.center = self.log_step + math.log(2.0)

    def update(self, accept: float) -> None:
        self.count += 1
        share = 1 / (self.count + 10)
        self.error = (1 - share) * self.error + share * (self.target - accept)
        wanted = self.center - math.sqrt(self.count) / 0.05 * self.error
        self.log_step += min(max(wanted - self.log_step, -0.7), 0.7)
        decay = self.count**-0.75
        self.averaged = decay * self.log_step + (1 - decay) * self.averaged

    @property
    def step_size(self) -> float:
        return math.exp(min(self.log_step, 3.0))


class _Whitened:
    """A log-density in coordinates z with u = loc + scale_tril z, with its gradient for the sampler."""

    def __init__(self, log_density: Callable[[Tensor], Tensor], loc: Tensor, scale_tril: Tensor) -> None:
        self.log_density, self.loc, self.scale_tril = log_density, loc, scale_tril

    def potential(self, z: Tensor) -> tuple[Tensor, Tensor]:
        leaf = z.detach().requires_grad_(True)
        with torch.enable_grad():
            energy = -self.log_density(self.outer(leaf))
            (slope,) = torch.autograd.grad(energy.sum(), leaf)
        energy = energy.detach()
        good = torch.isfinite(energy) & torch.isfinite(slope).all(-1)
        return torch.where(good, energy, torch.inf), torch.where(good[:, None], slope, 0.0)

    def outer(self, z: Tensor) -> Tensor:
        return self.loc + z @ self.scale_tril.T

    def refined(self, z: Tensor) -> tuple["_Whitened", Tensor]:
        """Coordinates in which the pooled draws z ``(S, P)`` are white, and the map of positions into them."""
        count, size = z.shape
        mean = z.mean(0)
        offset = z - mean
        identity = torch.eye(size, dtype=z.dtype, device=z.device)
        # Shrunk to what the coordinates assume already, with the weight of a few draws (as in Stan).
        covariance = (offset.T @ offset + 5 * identity) / (count + 5)
        factor = torch.linalg.cholesky(covariance)
        other = _Whitened(self.log_density, self.outer(mean), self.scale_tril @ factor)
        return other, factor

    def moved(self, z: Tensor, other: "_Whitened") -> Tensor:
        """Positions z of these coordinates in the other ones."""
        offset = (self.outer(z) - other.loc).T
        return torch.linalg.solve_triangular(other.scale_tril, offset, upper=False).T


def run_batched_nuts(
    log_density: Callable[[Tensor], Tensor],
    transform: Bounds,
    *,
    loc: Tensor,
    scale_tril: Tensor,
    num_samples: int,
    num_chains: int,
    num_warmup: int,
    seed: int,
    cost: int = 1,
    target_accept: float | None = None,
    max_tree_depth: int = 10,
    progress: bool = False,
) -> Draws:
    """Draw from a density of unbounded coordinates u.

    Args:
        log_density: ``u (C, P) -> (C,)``, the transform's Jacobian included.
        transform: From u to α.
        loc: Where chains start, ``(P,)``.
        scale_tril: Their spread, ``(P, P)``: the Laplace approximation.
        num_samples: Draws a chain.
        num_chains: Chains.
        num_warmup: Transitions of a chain that are thrown away.
        seed: Of every random number.
        cost: Numbers that one evaluation of one chain handles; dear densities warm up with fewer chains.
        target_accept: Mean acceptance that the step size aims at; by default 0.8, and more where trajectories
            diverge at the end of the warm-up: a curved ridge needs smaller steps than its width suggests.
        max_tree_depth: Largest depth of a trajectory, 2**depth steps.
        progress: Whether to show a bar.

    Raises:
        ConvergenceError: If the density is not finite around ``loc``, or it was interrupted before any draw.
    """
    device = loc.device
    generator = torch.Generator(device=device).manual_seed(seed)
    tables = nuts_step.Tables.build(max_tree_depth, device)
    crowd = max(num_chains, min(_WARM_UP_CHAINS, max(4, 2**22 // max(1, cost))))
    space = _Whitened(log_density, loc, scale_tril)
    z = _starting_points(space, crowd, generator)
    accept = 0.8 if target_accept is None else target_accept
    averaging = _DualAveraging(math.log(0.5), accept)
    bar = tqdm(total=num_warmup + num_samples, desc="NUTS", disable=not progress, leave=False)
    stored = torch.full((num_samples, num_chains, len(loc)), torch.nan, dtype=loc.dtype, device=device)
    filled = torch.zeros(num_chains, dtype=torch.long, device=device)
    divergences = steps = 0
    try:
        for number, share in enumerate(_WINDOWS):
            length = max(4, round(share * num_warmup))
            # Short trees at first: a step size that starts far too small must not cost thousands of gradients.
            depth = min(max_tree_depth, 6) if number == 0 else max_tree_depth
            window = nuts_step.Tables.build(depth, device)
            pooled, z, diverging = _adapt(space, z, averaging, length, window, generator, bar)
            if number < len(_WINDOWS) - 1:
                other, _ = space.refined(pooled)
                z = space.moved(z, other)
                space = other
                averaging = _DualAveraging(averaging.averaged, accept)
        while target_accept is None and diverging > DIVERGING and accept < 0.98:
            accept = 0.5 * (1 + accept)
            averaging = _DualAveraging(averaging.averaged, accept)
            _, z, diverging = _adapt(space, z, averaging, length, window, generator, bar)
        step_size = math.exp(averaging.averaged)
        state = nuts_step.init(
            z[:num_chains], space.potential, step_size=step_size, tables=tables, generator=generator
        )
        rows = torch.arange(num_chains, device=device)
        while int(filled.min()) < num_samples:
            state, outcome = nuts_step.step(
                state, space.potential, step_size=step_size, tables=tables, generator=generator
            )
            steps += 1
            take = outcome.done & (filled < num_samples)
            chosen = rows[take]
            if not len(chosen):
                continue
            before = int(filled.min())
            stored[filled[chosen], chosen] = outcome.position[chosen]
            filled[chosen] += 1
            divergences += int((outcome.divergent & take).sum())
            bar.update(int(filled.min()) - before)
    except KeyboardInterrupt:
        have = int(filled.min())
        if have < 4:
            raise ConvergenceError("The sampler was interrupted before it had drawn anything.") from None
        stored = stored[:have]
        warnings.warn(
            f"The sampler was interrupted. It keeps {have} of {num_samples} draws of each of {num_chains} chains.",
            ConvergenceWarning,
            stacklevel=2,
        )
    finally:
        bar.close()
    alpha = transform.bound(space.outer(stored)).transpose(0, 1)
    return Draws(alpha.detach().to(device="cpu", dtype=torch.float64), divergences)


def _starting_points(space: _Whitened, count: int, generator: torch.Generator) -> Tensor:
    """Draws of the normal approximation, drawn in where the density is not finite there."""
    z = torch.randn((count, len(space.loc)), dtype=space.loc.dtype, device=space.loc.device, generator=generator)
    for _ in range(20):
        bad = ~torch.isfinite(space.potential(z)[0])
        if not bool(bad.any()):
            return z
        z = torch.where(bad[:, None], 0.5 * z, z)
    raise ConvergenceError(
        "Expected a finite posterior around the best point found. Got none. Look at the simulator there."
    )


def _adapt(
    space: _Whitened,
    z: Tensor,
    averaging: _DualAveraging,
    length: int,
    tables: nuts_step.Tables,
    generator: torch.Generator,
    bar: tqdm,
) -> tuple[Tensor, Tensor, float]:
    """One warm-up window: the draws of its second half, where every chain is, and the share that diverged in it."""
    chains = len(z)
    state = nuts_step.init(
        z, space.potential, step_size=averaging.step_size, tables=tables, generator=generator
    )
    finished = shown = 0
    pooled: list[Tensor] = []
    accepted: list[Tensor] = []
    waiting = diverged = 0
    while finished < length * chains:
        state, outcome = nuts_step.step(
            state, space.potential, step_size=averaging.step_size, tables=tables, generator=generator
        )
        count = int(outcome.done.sum())
        if not count:
            continue
        finished += count
        waiting += count
        accepted.append(outcome.accept[outcome.done])
        # One update for every half of the crowd: a step size is judged by trajectories that used it, not by those
        # still on the way from before, and short ones do not count more than long ones.
        if 2 * waiting >= chains:
            averaging.update(float(torch.cat(accepted).mean()))
            accepted.clear()
            waiting = 0
        if finished > length * chains // 2:
            pooled.append(outcome.position[outcome.done])
            diverged += int(outcome.divergent.sum())
        bar.update(finished // chains - shown)
        shown = finished // chains
    draws = torch.cat(pooled)
    return draws, state.proposal[:, 0], diverged / len(draws)
