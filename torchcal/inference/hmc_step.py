r"""Hamiltonian Monte Carlo of many chains with one trajectory length for all of them.

Where coordinates are white, the trajectories that a No-U-Turn tree finds for every chain anew are all about a quarter
of a period long. One length, found once for all chains, needs no tree: half the gradients or fewer a draw, and no
chain waits for another. A random factor on the length keeps trajectories from closing on themselves.

Sources: Neal (2011), Handbook of Markov Chain Monte Carlo, ch. 5; the length shared and adapted across chains:
Hoffman, Radul & Sountsov (2021), Proc. AISTATS 130, 3907-3915.
"""

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from torchcal.inference.arrays import Array, Arrays, Potential
from torchcal.inference.coordinates import group_means
from torchcal.inference.nuts_step import DIVERGENCE, Outcome

__all__ = ["QUARTER", "State", "init", "step", "tuned_length"]

QUARTER = 0.5 * math.pi
"""A quarter of the period of a normal density in white coordinates: where a trajectory forgets its start."""

_JITTER = 0.35
"""Lengths vary by this much to either side, evenly."""

_LADDER = (0.5, 0.75, 1.0, 1.5, 2.25, 3.4, 5.0)
"""Lengths that are tried, in quarters."""

_PAIRS = 640
"""Transitions, over all chains, that each length is judged by: correlations are then known to 0.04."""

_MOST_ROUNDS = 40
"""Transitions of each chain, however few chains there are."""

MAX_STEPS = 1024
"""Most leapfrog steps of a trajectory, as many as a No-U-Turn tree of depth 10 has."""


@dataclasses.dataclass(frozen=True)
class State:
    """Where every chain is: position ``(C, P)``, energy ``(C,)`` and its gradient ``(C, P)``."""

    position: Array
    energy: Array
    slope: Array


def init(position: Array, potential: Potential) -> State:
    """Chains at positions ``(C, P)``."""
    return State(position, *potential(position))


def step(
    state: State, potential: Potential, *, step_size: float, length: float, arrays: Arrays
) -> tuple[State, Outcome]:
    """One transition of every chain: a trajectory of about ``length``, in steps of at most ``step_size``."""
    xp = arrays.xp
    position, start = state.position, state.energy
    uniform = arrays.uniform((1 + len(start),), start)
    time = length * (1 + _JITTER * (2 * float(uniform[0]) - 1))
    count = min(max(1, math.ceil(time / step_size)), MAX_STEPS)
    size = min(time / count, step_size)
    momentum = arrays.normal(position)
    kinetic = 0.5 * (momentum * momentum).sum(-1)
    energy, slope = start, state.slope
    for number in range(count):
        with np.errstate(all="ignore"):  # where a trajectory diverges; the potential keeps its own warnings
            momentum = momentum - (size if number else 0.5 * size) * slope
            position = position + size * momentum
        energy, slope = potential(position)
    with np.errstate(all="ignore"):
        momentum = momentum - 0.5 * size * slope
        error = energy + 0.5 * (momentum * momentum).sum(-1) - start - kinetic
        error = xp.where(error < np.inf, error, np.inf)  # where it is no number too
        accept = xp.exp(-xp.where(error > 0, error, 0.0))
    take = uniform[1:] < accept
    row = take[:, None]
    moved = State(
        xp.where(row, position, state.position),
        xp.where(take, energy, start),
        xp.where(row, slope, state.slope),
    )
    drawn, accepted, divergent = arrays.host(moved.position, accept, error > DIVERGENCE)
    everyone, steps = np.ones(len(start), dtype=bool), np.full(len(start), float(count))
    return moved, Outcome(everyone, drawn, accepted, divergent, steps)


def tuned_length(
    state: State, potential: Potential, groups: Tensor, *, step_size: float, arrays: Arrays
) -> tuple[float, State]:
    """The trajectory length with the most effective draws a gradient, and the chains moved on.

    The effective share of draws is :math:`(1 - \rho)/(1 + \rho)` with ρ the correlation of successive draws, of the
    coordinate or of its squared distance from the mean, whichever is worst over all coordinates. Means are those of
    the chains that began at the same mode, ``groups (C,)``.
    """
    best, best_rate = QUARTER, -math.inf
    falling = 0
    rounds = min(max(8, -(-_PAIRS // len(state.position))), _MOST_ROUNDS)
    for quarters in _LADDER:
        length = quarters * QUARTER
        draws, work = [*arrays.host(state.position)], 0.0
        for _ in range(rounds):
            state, outcome = step(state, potential, step_size=step_size, length=length, arrays=arrays)
            draws.append(outcome.position)
            work += float(outcome.leaves[0])
        rate = _share(torch.from_numpy(np.stack(draws)), groups.cpu()) * rounds / work
        if rate > best_rate:
            best, best_rate, falling = length, rate, 0
        else:
            falling += 1
        if falling == 2:
            break
    return best, state


def _share(draws: Tensor, groups: Tensor) -> float:
    """Effective share of draws ``(T, C, P)``, of the worst coordinate."""
    centred = draws - group_means(draws.mean(0), groups)[groups]
    values = torch.cat([centred, centred.square()], dim=-1)
    values = values - values.mean((0, 1))
    lagged = (values[1:] * values[:-1]).mean((0, 1))
    rho = (lagged / values.square().mean((0, 1)).clamp_min(torch.finfo(values.dtype).tiny)).clamp(-0.99, 0.999)
    return float(((1 - rho) / (1 + rho)).min())
