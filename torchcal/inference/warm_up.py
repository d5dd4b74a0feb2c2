"""The warm-up of batched chains: coordinates and step size, adapted across all of them."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchcal.inference.coordinates import Whitened
from torchcal.inference.kernels import Kernel

__all__ = ["DualAveraging", "warm_up"]

_WINDOWS = (0.3, 0.3, 0.4)
"""Shares of the warm-up: two windows that end in new coordinates, and one that sets the step size for good."""

_DIVERGING = 5e-4
"""Share of divergent transitions at the end of the warm-up from which on smaller steps are tried."""

_STRICT, _STRICTEST = 0.9, 0.98
"""Mean acceptance where trajectories have diverged, at least; and from which on that is no matter of the step size."""


@dataclass
class DualAveraging:
    """Step size for a wanted acceptance (Hoffman & Gelman 2014, section 3.2), fed with means over chains."""

    log_step: float
    target: float
    count: int = 0
    error: float = 0.0
    averaged: float = 0.0

    def __post_init__(self) -> None:
        self.center = self.log_step + math.log(2.0)

    def update(self, accept: float) -> None:
        """Take in a mean acceptance with the step size tried."""
        self.count += 1
        share = 1 / (self.count + 10)
        self.error = (1 - share) * self.error + share * (self.target - accept)
        wanted = self.center - math.sqrt(self.count) / 0.05 * self.error
        self.log_step += min(max(wanted - self.log_step, -0.7), 0.7)
        decay = self.count**-0.75
        self.averaged = decay * self.log_step + (1 - decay) * self.averaged

    @property
    def step_size(self) -> float:
        """To try next."""
        return math.exp(min(self.log_step, 3.0))

    @property
    def settled(self) -> float:
        """To sample with."""
        return math.exp(self.averaged)

    def stricter(self) -> "DualAveraging":
        """From here, for half the rejections or fewer."""
        return DualAveraging(self.averaged, max(0.5 * (1 + self.target), _STRICT))


def warm_up(
    moves: Kernel,
    space: Whitened,
    z: Tensor,
    groups: Tensor,
    num_warmup: int,
    averaging: DualAveraging,
    bar: tqdm,
    *,
    stricter: bool,
) -> tuple[Whitened, Tensor, DualAveraging]:
    """Coordinates, positions in them, and the step size."""
    diverging, length = 0.0, 0
    for number, share in enumerate(_WINDOWS):
        length = max(4, round(share * num_warmup))
        last = number == len(_WINDOWS) - 1
        pooled, owners, z, diverging = _adapt(moves, space, z, averaging, length, bar, settle=last)
        other = space.refined(pooled, groups[owners], owners)
        # A bend shows only when chains have come near the ridge, and then best in coordinates that follow it already.
        if last and other.bend is None:
            break
        z = other.inner(space.outer(z))
        space = other
        z = moves.tune(z, groups, space, averaging.settled)
        averaging = DualAveraging(averaging.averaged, averaging.target)
        if last:
            _, _, z, diverging = _adapt(moves, space, z, averaging, length, bar, settle=True)
    while stricter and diverging > _DIVERGING and averaging.target < _STRICTEST:
        averaging = averaging.stricter()
        _, _, z, diverging = _adapt(moves, space, z, averaging, length, bar, settle=True)
    return space, z, averaging


def _adapt(
    moves: Kernel,
    space: Whitened,
    z: Tensor,
    averaging: DualAveraging,
    length: int,
    bar: tqdm,
    *,
    settle: bool = False,
) -> tuple[Tensor, Tensor, Tensor, float]:
    """One warm-up window: draws of its second half, whose they are, where all chains end, and the share diverged.

    Where the window is to ``settle``, that half has the step size that was found, and the share is that of its steps;
    elsewhere nothing is judged, and it is 0.
    """
    chains = len(z)
    state = moves.init(z, space, averaging.step_size)
    finished = shown = 0
    pooled: list[np.ndarray] = []
    owners: list[np.ndarray] = []
    accepted: list[np.ndarray] = []
    waiting = diverged = counted = 0
    begun = np.zeros(chains, dtype=bool)  # whose trajectory has the step size that is judged
    while finished < length * chains:
        settled = settle and finished > length * chains // 2
        state, outcome = moves.step(state, space, averaging.settled if settled else averaging.step_size)
        count = int(outcome.done.sum())
        if not count:
            continue
        finished += count
        if not settled:
            waiting += count
            accepted.append(outcome.accept[outcome.done])
        # One update for every half of the crowd: a step size is judged by trajectories that used it, not by those
        # still on the way from before, and short ones do not count more than long ones.
        if 2 * waiting >= chains:
            averaging.update(float(np.concatenate(accepted).mean()))
            accepted.clear()
            waiting = 0
        if finished > length * chains // 2:
            pooled.append(outcome.position[outcome.done])
            owners.append(outcome.done.nonzero()[0])
            diverged += int((outcome.divergent & begun).sum())
            counted += int((outcome.done & begun).sum())
            if settled:
                begun = begun | outcome.done
        bar.update(finished // chains - shown)
        shown = finished // chains
    drawn, whose = (torch.as_tensor(np.concatenate(parts), device=z.device) for parts in (pooled, owners))
    return drawn, whose, moves.positions(state), diverged / max(counted, 1)
