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
    """For each leaf number of a subtree, the checkpoints that it closes a U-turn check with, ``(2**depth,)`` twice."""

    first: Tensor
    last: Tensor
    max_depth: int

    @classmethod
    def build(cls, max_depth: int, device: torch.device) -> "Tables":
        """Tables for trees up to ``max_depth``."""
        leaves = range(2**max_depth)
        last = [bin(leaf >> 1).count("1") for leaf in leaves]
        trailing = [(leaf ^ (leaf + 1)).bit_length() - 1 for leaf in leaves]
        first = [high - ones + 1 for high, ones in zip(last, trailing, strict=True)]
        return cls(torch.tensor(first, device=device), torch.tensor(last, device=device), max_depth)


@dataclasses.dataclass(frozen=True)
class State:
    """Where every chain is in its trajectory. Points are stacked as (position, momentum, gradient), ``(C, 3, P)``."""

    cursor: Tensor
    left: Tensor
    right: Tensor
    proposal: Tensor
    proposal_energy: Tensor
    sub_proposal: Tensor
    sub_energy: Tensor
    momentum_sum: Tensor
    sub_momentum_sum: Tensor
    checkpoints: Tensor
    start_energy: Tensor
    weight: Tensor
    sub_weight: Tensor
    direction: Tensor
    step_size: Tensor
    leaf: Tensor
    depth: Tensor
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
    point = torch.stack([position, momentum, slope], dim=1)
    zero = torch.zeros_like(energy)
    count = torch.zeros(chains, dtype=torch.long, device=position.device)
    return State(
        cursor=point,
        left=point,
        right=point,
        proposal=point[:, ::2],
        proposal_energy=energy,
        sub_proposal=point[:, ::2],
        sub_energy=energy,
        momentum_sum=momentum,
        sub_momentum_sum=torch.zeros_like(momentum),
        checkpoints=position.new_zeros(chains, max(1, tables.max_depth), 2, size),
        start_energy=energy + 0.5 * momentum.square().sum(-1),
        weight=zero,
        sub_weight=zero - torch.inf,
        direction=_sign(energy, generator)[:, None],
        step_size=torch.full_like(energy, step_size)[:, None],
        leaf=count,
        depth=count,
        accept_sum=zero,
        leaves=zero,
    )


def step(
    state: State, potential: Potential, *, step_size: float, tables: Tables, generator: torch.Generator
) -> tuple[State, Outcome]:
    """One leapfrog step of every chain; ``step_size`` holds for trajectories that start in this call."""
    s = state
    move = s.direction * s.step_size
    position, momentum, slope = s.cursor.unbind(1)
    momentum = momentum - 0.5 * move * slope
    position = position + move * momentum
    energy, slope = potential(position)
    momentum = momentum - 0.5 * move * slope
    cursor = torch.stack([position, momentum, slope], dim=1)

    error = energy + 0.5 * momentum.square().sum(-1) - s.start_energy
    error = torch.nan_to_num(error, nan=torch.inf)
    divergent = error > DIVERGENCE
    accept_sum = s.accept_sum + (-error.clamp_min(0)).exp()
    leaves = s.leaves + 1
    log_uniform = torch.rand((2, len(error)), dtype=error.dtype, device=error.device, generator=generator).log()

    # The leaf joins the subtree.
    sub_weight = torch.logaddexp(s.sub_weight, -error)
    take = log_uniform[0] < -error - sub_weight
    sub_proposal = torch.where(take[:, None, None], cursor[:, ::2], s.sub_proposal)
    sub_energy = torch.where(take, energy, s.sub_energy)
    sub_sum = s.sub_momentum_sum + momentum
    first, last = tables.first[s.leaf][:, None], tables.last[s.leaf][:, None]
    even = (s.leaf % 2 == 0)[:, None]
    number = torch.arange(s.checkpoints.shape[1], device=error.device)
    write = (number == last) & even
    pair = torch.stack([momentum, sub_sum], dim=1)[:, None]
    checkpoints = torch.where(write[:, :, None, None], pair, s.checkpoints)
    opened = checkpoints[:, :, 0]
    turns = _turning(opened, momentum[:, None], sub_sum[:, None] - checkpoints[:, :, 1] + opened)
    stop = (turns & (number >= first) & (number <= last) & ~even).any(-1) | divergent

    # A complete subtree joins the tree.
    merge = (s.leaf + 1 == 2**s.depth) & ~stop
    take = merge & (log_uniform[1] < sub_weight - s.weight)
    proposal = torch.where(take[:, None, None], sub_proposal, s.proposal)
    proposal_energy = torch.where(take, sub_energy, s.proposal_energy)
    weight = torch.where(merge, torch.logaddexp(s.weight, sub_weight), s.weight)
    total = torch.where(merge[:, None], s.momentum_sum + sub_sum, s.momentum_sum)
    rightward = s.direction[:, 0] > 0
    left = torch.where((merge & ~rightward)[:, None, None], cursor, s.left)
    right = torch.where((merge & rightward)[:, None, None], cursor, s.right)
    depth = s.depth + merge
    full = _turning(left[:, 1], right[:, 1], total) | (depth >= tables.max_depth)
    done = stop | (merge & full)

    # Ended trajectories start anew from their proposal; all others go on, some with a new subtree.
    fresh = _normal(position, generator)
    start = torch.stack([proposal[:, 0], fresh, proposal[:, 1]], dim=1)
    again = done[:, None, None]
    left = torch.where(again, start, left)
    right = torch.where(again, start, right)
    restart = done | merge
    direction = torch.where(restart, _sign(error, generator), s.direction[:, 0])
    end = torch.where((direction > 0)[:, None, None], right, left)
    zero = torch.zeros_like(error)
    outcome = Outcome(done, proposal[:, 0], accept_sum / leaves, divergent & done, leaves)
    state = State(
        cursor=torch.where(restart[:, None, None], end, cursor),
        left=left,
        right=right,
        proposal=proposal,
        proposal_energy=proposal_energy,
        sub_proposal=sub_proposal,
        sub_energy=sub_energy,
        momentum_sum=torch.where(done[:, None], fresh, total),
        sub_momentum_sum=torch.where(restart[:, None], torch.zeros_like(sub_sum), sub_sum),
        checkpoints=checkpoints,
        start_energy=torch.where(done, proposal_energy + 0.5 * fresh.square().sum(-1), s.start_energy),
        weight=torch.where(done, zero, weight),
        sub_weight=torch.where(restart, zero - torch.inf, sub_weight),
        direction=direction[:, None],
        step_size=torch.where(done[:, None], torch.full_like(s.step_size, step_size), s.step_size),
        leaf=torch.where(restart, 0, s.leaf + 1),
        depth=torch.where(done, 0, depth),
        accept_sum=torch.where(done, zero, accept_sum),
        leaves=torch.where(done, zero, leaves),
    )
    return state, outcome


def _turning(left: Tensor, right: Tensor, total: Tensor) -> Tensor:
    """Whether a trajectory with these end momenta and this sum of momenta has made a U-turn."""
    middle = total - 0.5 * (left + right)
    return ((left * middle).sum(-1) <= 0) | ((right * middle).sum(-1) <= 0)


def _normal(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, dtype=like.dtype, device=like.device, generator=generator)


def _sign(like: Tensor, generator: torch.Generator) -> Tensor:
    uniform = torch.rand(like.shape, dtype=like.dtype, device=like.device, generator=generator)
    return torch.where(uniform < 0.5, -1.0, 1.0).to(like.dtype)
