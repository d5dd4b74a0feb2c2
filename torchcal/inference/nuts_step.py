r"""The No-U-Turn transition of many chains as one tensor program.

Every call of `step` is one leapfrog step of every chain. Chains do not wait for each other: one whose trajectory has
ended starts the next in the same call, so that no gradient is wasted on the longest tree. Trees are built leaf by leaf
with a logarithmic number of checkpoints; the trajectory's state is drawn multinomially, with the bias towards later
subtrees, and ends at the generalised U-turn. The mass matrix is the identity: whiten the coordinates.

Sources: Hoffman & Gelman (2014), J. Mach. Learn. Res. 15, 1593-1623; Betancourt (2017), arXiv:1701.02434, A.4;
Phan, Pradhan & Jankowiak (2019), arXiv:1912.11554 (the iterative tree).
"""

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["Outcome", "State", "Tables", "init", "step"]

Potential = Callable[[Tensor], tuple[Tensor, Tensor]]
"""``z (C, P) -> (U (C,), dU/dz (C, P))``, the negative log-density; +inf with a zero gradient where undefined."""

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

    slot: Tensor
    check: Tensor
    depth: int

    @classmethod
    def build(cls, max_depth: int, device: torch.device) -> "Tables":
        """Tables for trees up to ``max_depth``."""
        leaves = range(2**max_depth)
        last = [bin(leaf >> 1).count("1") for leaf in leaves]
        trailing = [(leaf ^ (leaf + 1)).bit_length() - 1 for leaf in leaves]
        first = [high - ones + 1 for high, ones in zip(last, trailing, strict=True)]
        slot = [max_depth if leaf % 2 else last[leaf] for leaf in leaves]
        check = [[leaf % 2 == 1 and first[leaf] <= k <= last[leaf] for k in range(max_depth)] for leaf in leaves]
        return cls(torch.tensor(slot, device=device), torch.tensor(check, device=device), max_depth)


@dataclasses.dataclass(frozen=True)
class State:
    """Where every chain is in its trajectory.

    Few large tensors rather than many small ones, since a step costs by the number of operations. A draw is
    (position, gradient, energy), ``(C, 2P + 1)``; a point is a draw with its momentum behind it, ``(C, 3P + 1)``. A
    checkpoint is (momentum, half sum): the sum of the subtree's momenta up to it, its own counted by half.

    Attributes:
        cursor: The point that moves.
        ends: Of the trajectory, left and right, ``(C, 2, 3P + 1)``.
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
    """

    cursor: Tensor
    ends: Tensor
    proposal: Tensor
    sub_proposal: Tensor
    momentum_sum: Tensor
    sub_momentum_sum: Tensor
    checkpoints: Tensor
    start_energy: Tensor
    weight: Tensor
    sub_weight: Tensor
    rightward: Tensor
    step_size: Tensor
    leaf: Tensor
    size: Tensor
    accept_sum: Tensor
    leaves: Tensor


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one call of `step` finished.

    Attributes:
        done: Which chains ended a trajectory, ``(C,)`` bool.
        position: Their new draws, ``(C, P)``; meaningless elsewhere.
        accept: Mean acceptance over the ended trajectory, ``(C,)``.
        divergent: Which of them diverged, ``(C,)`` bool.
        leaves: Their number of leapfrog steps, ``(C,)``.
    """

    done: Tensor
    position: Tensor
    accept: Tensor
    divergent: Tensor
    leaves: Tensor


def init(
    position: Tensor, potential: Potential, *, step_size: float, tables: Tables, generator: torch.Generator
) -> State:
    """Chains at the start of their first trajectory, from positions ``(C, P)``."""
    chains, size = position.shape
    energy, slope = potential(position)
    momentum = _normal(position, generator)
    draw = torch.cat([position, slope, energy[:, None]], dim=1)
    point = torch.cat([draw, momentum], dim=1)
    zero = torch.zeros_like(energy)
    count = torch.zeros(chains, dtype=torch.long, device=position.device)
    return State(
        cursor=point,
        ends=torch.stack([point, point], dim=1),
        proposal=draw,
        sub_proposal=draw,
        momentum_sum=momentum,
        sub_momentum_sum=torch.zeros_like(momentum),
        checkpoints=position.new_zeros(chains, tables.depth + 1, 2 * size),
        start_energy=energy + 0.5 * momentum.square().sum(-1),
        weight=zero,
        sub_weight=zero - torch.inf,
        rightward=_coin(energy, generator),
        step_size=torch.full_like(energy, step_size),
        leaf=count,
        size=count + 1,
        accept_sum=zero,
        leaves=zero,
    )


def step(
    state: State, potential: Potential, *, step_size: float, tables: Tables, generator: torch.Generator
) -> tuple[State, Outcome]:
    """One leapfrog step of every chain; ``step_size`` holds for trajectories that start in this call."""
    s = state
    size = s.momentum_sum.shape[1]
    position, slope, _, momentum = s.cursor.split([size, size, 1, size], dim=1)
    move = torch.where(s.rightward, s.step_size, -s.step_size)[:, None]
    momentum = torch.addcmul(momentum, move, slope, value=-0.5)
    position = torch.addcmul(position, move, momentum)
    energy, slope = potential(position)
    momentum = torch.addcmul(momentum, move, slope, value=-0.5)
    cursor = torch.cat([position, slope, energy[:, None], momentum], dim=1)

    gain = s.start_energy - torch.add(energy, momentum.square().sum(-1), alpha=0.5)
    gain = torch.nan_to_num(gain, nan=-torch.inf, neginf=-torch.inf)
    divergent = gain < -DIVERGENCE
    accept_sum = s.accept_sum + gain.clamp_max(0).exp()
    leaves = s.leaves + 1
    log_uniform = torch.rand((2, len(gain)), dtype=gain.dtype, device=gain.device, generator=generator).log()

    # The leaf joins the subtree.
    sub_weight = torch.logaddexp(s.sub_weight, gain)
    take = log_uniform[0] < gain - sub_weight
    sub_proposal = torch.where(take[:, None], cursor[:, : 2 * size + 1], s.sub_proposal)
    sub_sum = s.sub_momentum_sum + momentum
    half = torch.sub(sub_sum, momentum, alpha=0.5)
    chains = torch.arange(len(gain), device=gain.device)
    s.checkpoints[chains, tables.slot[s.leaf]] = torch.cat([momentum, half], dim=1)
    depth = int(s.leaf.max()).bit_length()  # of the checkpoints in use
    opened, closed = s.checkpoints[:, :depth].split(size, dim=2)
    check = tables.check[s.leaf, :depth]
    turns = _turning(opened, momentum[:, None], half[:, None] - closed)
    stop = (turns & check).any(-1) | divergent

    # A complete subtree joins the tree.
    leaf = s.leaf + 1
    merge = (leaf == s.size) & ~stop
    take = merge & (log_uniform[1] < sub_weight - s.weight)
    proposal = torch.where(take[:, None], sub_proposal, s.proposal)
    weight = torch.where(merge, torch.logaddexp(s.weight, sub_weight), s.weight)
    total = torch.where(merge[:, None], s.momentum_sum + sub_sum, s.momentum_sum)
    grown = torch.stack([merge & ~s.rightward, merge & s.rightward], dim=1)
    ends = torch.where(grown[:, :, None], cursor[:, None], s.ends)
    count = torch.where(merge, 2 * s.size, s.size)
    left, right = ends[:, :, 2 * size + 1 :].unbind(1)
    full = _turning(left, right, torch.sub(total, left + right, alpha=0.5)) | (count >= 2**tables.depth)
    done = stop | (merge & full)

    # Ended trajectories start anew from their proposal; all others go on, some with a new subtree.
    fresh = _normal(position, generator)
    start = torch.cat([proposal, fresh], dim=1)
    ends = torch.where(done[:, None, None], start[:, None], ends)
    restart = done | merge
    rightward = torch.where(restart, _coin(gain, generator), s.rightward)
    end = torch.where(rightward[:, None], ends[:, 1], ends[:, 0])
    outcome = Outcome(done, proposal[:, :size], accept_sum / leaves, divergent & done, leaves)
    state = State(
        cursor=torch.where(restart[:, None], end, cursor),
        ends=ends,
        proposal=proposal,
        sub_proposal=sub_proposal,
        momentum_sum=torch.where(done[:, None], fresh, total),
        sub_momentum_sum=torch.where(restart[:, None], 0.0, sub_sum),
        checkpoints=s.checkpoints,
        start_energy=torch.where(
            done, torch.add(proposal[:, 2 * size], fresh.square().sum(-1), alpha=0.5), s.start_energy
        ),
        weight=torch.where(done, 0.0, weight),
        sub_weight=torch.where(restart, -torch.inf, sub_weight),
        rightward=rightward,
        step_size=torch.where(done, step_size, s.step_size),
        leaf=torch.where(restart, 0, leaf),
        size=torch.where(done, 1, count),
        accept_sum=torch.where(done, 0.0, accept_sum),
        leaves=torch.where(done, 0.0, leaves),
    )
    return state, outcome


def _turning(left: Tensor, right: Tensor, middle: Tensor) -> Tensor:
    """Whether a trajectory with these end momenta, and this sum of momenta with theirs by half, has made a U-turn."""
    return torch.minimum((left * middle).sum(-1), (right * middle).sum(-1)) <= 0


def _normal(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, dtype=like.dtype, device=like.device, generator=generator)


def _coin(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.rand(like.shape, dtype=like.dtype, device=like.device, generator=generator) >= 0.5
