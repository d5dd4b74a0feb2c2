r"""The No-U-Turn transition of many chains as one array program.

Every call of `step` is one leapfrog step of every chain. Chains do not wait for each other: one whose trajectory has
ended starts the next in the same call, so that no gradient is wasted on the longest tree. Trees are built leaf by leaf
with a logarithmic number of checkpoints; the trajectory's state is drawn multinomially, with the bias towards later
subtrees, and ends at the generalised U-turn. The mass matrix is the identity: whiten the coordinates.

Sources: Hoffman & Gelman (2014), J. Mach. Learn. Res. 15, 1593-1623; Betancourt (2017), arXiv:1701.02434, A.4;
Phan, Pradhan & Jankowiak (2019), arXiv:1912.11554 (the iterative tree).
"""

import dataclasses
from typing import Any

import numpy as np

from torchcal.inference.arrays import Array, Arrays, Potential

__all__ = ["Outcome", "State", "Tables", "init", "step"]

_QUIET = np.errstate(all="ignore")
"""Energies may be infinite, and sums of them undefined; the potential keeps its own warnings."""

DIVERGENCE = 1000.0
"""Energy error past which a trajectory counts as divergent, as in Stan."""


@dataclasses.dataclass(frozen=True)
class Tables:
    """By the leaf number of a subtree, which checkpoint it writes and which it closes a U-turn check with.

    Attributes:
        slot: Written by even leaves, ``(2**max_depth,)``; others write one past all that are read.
        check: Closed by odd leaves, ``(2**max_depth, max_depth)`` bool.
        depth: The largest.
    """

    slot: Array
    check: Array
    depth: int

    @classmethod
    def build(cls, max_depth: int, arrays: Arrays) -> "Tables":
        """Tables for trees up to ``max_depth``."""
        leaves = range(2**max_depth)
        last = [bin(leaf >> 1).count("1") for leaf in leaves]
        trailing = [(leaf ^ (leaf + 1)).bit_length() - 1 for leaf in leaves]
        first = [high - ones + 1 for high, ones in zip(last, trailing, strict=True)]
        slot = [max_depth if leaf % 2 else last[leaf] for leaf in leaves]
        check = [[leaf % 2 == 1 and first[leaf] <= k <= last[leaf] for k in range(max_depth)] for leaf in leaves]
        return cls(arrays.table(slot), arrays.table(check), max_depth)


@dataclasses.dataclass(frozen=True)
class State:
    """Where every chain is in its trajectory.

    Few large arrays rather than many small ones, since a step costs by the number of operations. A draw is
    (position, gradient, energy), ``(C, 2P + 1)``; a point is a draw with its momentum behind it, ``(C, 3P + 1)``. A
    checkpoint is (momentum, half sum): the sum of the subtree's momenta up to it, its own counted by half.

    Attributes:
        cursor: The point that moves.
        left: End of the trajectory, ``(C, 3P + 1)``.
        right: Its other end.
        proposal: The draw that the trajectory would end with.
        sub_proposal: The same of the subtree.
        momentum_sum: Over the trajectory, ``(C, P)``.
        sub_momentum_sum: Over the subtree.
        checkpoints: ``(C, depth + 1, 2P)``, written in place: a state can be stepped on from once.
        start_energy: Total energy at the start, ``(C,)``.
        weight: Log of the trajectory's summed weights.
        sub_weight: The same of the subtree.
        rightward: Which way the subtree grows, bool.
        step_size: Of this trajectory.
        leaf: Number of the subtree's next leaf.
        size: Leaves of the trajectory, and so of the subtree when it is whole.
        accept_sum: Of acceptance probabilities over the trajectory.
        leaves: Number of its leapfrog steps.
        rows: Numbers of the chains.
    """

    cursor: Array
    left: Array
    right: Array
    proposal: Array
    sub_proposal: Array
    momentum_sum: Array
    sub_momentum_sum: Array
    checkpoints: Array
    start_energy: Array
    weight: Array
    sub_weight: Array
    rightward: Array
    step_size: Array
    leaf: Array
    size: Array
    accept_sum: Array
    leaves: Array
    rows: Array


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one call of `step` finished, brought to the host.

    Attributes:
        done: Which chains ended a trajectory, ``(C,)`` bool.
        position: Their new draws, ``(C, P)``; meaningless elsewhere.
        accept: Mean acceptance over the ended trajectory, ``(C,)``.
        divergent: Which of them diverged, ``(C,)`` bool.
        leaves: Their number of leapfrog steps, ``(C,)``.
    """

    done: np.ndarray
    position: np.ndarray
    accept: np.ndarray
    divergent: np.ndarray
    leaves: np.ndarray


def init(position: Array, potential: Potential, *, step_size: float, tables: Tables, arrays: Arrays) -> State:
    """Chains at the start of their first trajectory, from positions ``(C, P)``."""
    xp = arrays.xp
    chains, size = position.shape
    energy, slope = potential(position)
    momentum = arrays.normal(position)
    draw = xp.concatenate([position, slope, energy[:, None]], 1)
    point = xp.concatenate([draw, momentum], 1)
    zero = xp.zeros_like(energy)
    count = arrays.table([0] * chains)
    return State(
        cursor=point,
        left=point,
        right=point,
        proposal=draw,
        sub_proposal=draw,
        momentum_sum=momentum,
        sub_momentum_sum=xp.zeros_like(momentum),
        checkpoints=xp.stack([xp.zeros_like(point[:, : 2 * size])] * (tables.depth + 1), 1),
        start_energy=energy + 0.5 * (momentum * momentum).sum(-1),
        weight=zero,
        sub_weight=zero - np.inf,
        rightward=arrays.uniform((chains,), energy) >= 0.5,
        step_size=xp.full_like(energy, step_size),
        leaf=count,
        size=count + 1,
        accept_sum=zero,
        leaves=zero,
        rows=arrays.table(range(chains)),
    )


def step(
    state: State, potential: Potential, *, step_size: float, tables: Tables, arrays: Arrays
) -> tuple[State, Outcome]:
    """One leapfrog step of every chain; ``step_size`` holds for trajectories that start in this call."""
    position, momentum, move = _half_way(state, arrays)
    draw = (position, *potential(position))
    return _joined(state, draw, momentum, move, step_size=step_size, tables=tables, arrays=arrays)


@_QUIET
def _half_way(s: State, arrays: Arrays) -> tuple[Array, Array, Array]:
    """Positions after a leapfrog step, momenta half a step before, and the signed step ``(C, 1)``."""
    size = s.momentum_sum.shape[1]
    move = arrays.xp.where(s.rightward, s.step_size, -s.step_size)[:, None]
    momentum = s.cursor[:, 2 * size + 1 :] - 0.5 * move * s.cursor[:, size : 2 * size]
    return s.cursor[:, :size] + move * momentum, momentum, move


@_QUIET
def _joined(
    s: State,
    point: tuple[Array, Array, Array],
    momentum: Array,
    move: Array,
    *,
    step_size: float,
    tables: Tables,
    arrays: Arrays,
) -> tuple[State, Outcome]:
    """Trees with one leaf more: position, energy and gradient of each."""
    xp = arrays.xp
    chains, size = s.momentum_sum.shape
    position, energy, slope = point
    momentum = momentum - 0.5 * move * slope
    draw = xp.concatenate([position, slope, energy[:, None]], 1)
    cursor = xp.concatenate([draw, momentum], 1)

    gain = s.start_energy - energy - 0.5 * (momentum * momentum).sum(-1)
    gain = xp.nan_to_num(gain, nan=-np.inf, neginf=-np.inf)  # finite above, so that a chain leaves where it is none
    divergent = gain < -DIVERGENCE
    accept_sum = s.accept_sum + xp.exp(xp.where(gain < 0, gain, 0.0))
    leaves = s.leaves + 1
    log_uniform = xp.log(arrays.uniform((2, chains), gain))
    coin = arrays.uniform((chains,), gain) >= 0.5
    fresh = arrays.normal(position)

    # The leaf joins the subtree.
    sub_weight = xp.logaddexp(s.sub_weight, gain)
    take = log_uniform[0] < gain - sub_weight
    sub_proposal = xp.where(take[:, None], draw, s.sub_proposal)
    sub_sum = s.sub_momentum_sum + momentum
    half = sub_sum - 0.5 * momentum
    s.checkpoints[s.rows, tables.slot[s.leaf]] = xp.concatenate([momentum, half], 1)
    depth = int(s.leaf.max()).bit_length()  # of the checkpoints in use
    opened, closed = s.checkpoints[:, :depth, :size], s.checkpoints[:, :depth, size:]
    turns = _turning(xp, opened, momentum[:, None], half[:, None] - closed)
    stop = (turns & tables.check[s.leaf, :depth]).any(-1) | divergent

    # A complete subtree joins the tree.
    leaf = s.leaf + 1
    merge = (leaf == s.size) & ~stop
    take = merge & (log_uniform[1] < sub_weight - s.weight)
    proposal = xp.where(take[:, None], sub_proposal, s.proposal)
    weight = xp.where(merge, xp.logaddexp(s.weight, sub_weight), s.weight)
    total = xp.where(merge[:, None], s.momentum_sum + sub_sum, s.momentum_sum)
    left = xp.where((merge & ~s.rightward)[:, None], cursor, s.left)
    right = xp.where((merge & s.rightward)[:, None], cursor, s.right)
    count = xp.where(merge, 2 * s.size, s.size)
    first, last = left[:, 2 * size + 1 :], right[:, 2 * size + 1 :]
    full = _turning(xp, first, last, total - 0.5 * (first + last)) | (count >= 2**tables.depth)
    done = stop | (merge & full)

    # Ended trajectories start anew from their proposal; all others go on, some with a new subtree.
    start = xp.concatenate([proposal, fresh], 1)
    anew = done[:, None]
    left, right = xp.where(anew, start, left), xp.where(anew, start, right)
    restart = done | merge
    rightward = xp.where(restart, coin, s.rightward)
    end = xp.where(rightward[:, None], right, left)
    outcome = Outcome(*arrays.host(done, proposal[:, :size], accept_sum / leaves, divergent & done, leaves))
    state = State(
        cursor=xp.where(restart[:, None], end, cursor),
        left=left,
        right=right,
        proposal=proposal,
        sub_proposal=sub_proposal,
        momentum_sum=xp.where(anew, fresh, total),
        sub_momentum_sum=xp.where(restart[:, None], 0.0, sub_sum),
        checkpoints=s.checkpoints,
        start_energy=xp.where(done, proposal[:, 2 * size] + 0.5 * (fresh * fresh).sum(-1), s.start_energy),
        weight=xp.where(done, 0.0, weight),
        sub_weight=xp.where(restart, -np.inf, sub_weight),
        rightward=rightward,
        step_size=xp.where(done, step_size, s.step_size),
        leaf=xp.where(restart, 0, leaf),
        size=xp.where(done, 1, count),
        accept_sum=xp.where(done, 0.0, accept_sum),
        leaves=xp.where(done, 0.0, leaves),
        rows=s.rows,
    )
    return state, outcome


def _turning(xp: Any, left: Array, right: Array, middle: Array) -> Array:
    """Whether a trajectory with these end momenta, and this sum of momenta with theirs by half, has made a U-turn."""
    return xp.minimum((left * middle).sum(-1), (right * middle).sum(-1)) <= 0
