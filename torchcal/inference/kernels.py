"""What moves batched chains: No-U-Turn and Hamiltonian Monte Carlo behind one interface."""

from typing import Any, Protocol

from torch import Tensor

from torchcal.inference import hmc_step, nuts_step
from torchcal.inference.arrays import Arrays
from torchcal.inference.coordinates import Whitened
from torchcal.inference.nuts_step import Outcome

__all__ = ["HMC", "NUTS", "Kernel"]


class Kernel(Protocol):
    """Moves all chains on; every call finishes some of their transitions."""

    def init(self, z: Tensor, space: Whitened, step_size: float) -> Any:
        """The state of chains at ``z`` ``(chains, P)``, in coordinates of the space."""
        ...

    def step(self, state: Any, space: Whitened, step_size: float) -> tuple[Any, Outcome]:
        """The next state, and which chains have finished a transition, where."""
        ...

    def positions(self, state: Any) -> Tensor:
        """Where every chain stands, ``(chains, P)``."""
        ...

    def tune(self, z: Tensor, groups: Tensor, space: Whitened, step_size: float) -> Tensor:
        """Set what depends on the coordinates once they are found; where the chains stand then."""
        ...


class NUTS:
    """See `nuts_step`. Trees are short at first: a step size that starts far too small must not cost thousands."""

    def __init__(self, max_tree_depth: int, arrays: Arrays) -> None:
        self.arrays = arrays
        self.full = nuts_step.Tables.build(max_tree_depth, arrays)
        self.tables = nuts_step.Tables.build(min(max_tree_depth, 6), arrays)

    def init(self, z: Tensor, space: Whitened, step_size: float) -> nuts_step.State:
        """No tree yet."""
        start = self.arrays.take(z)
        return nuts_step.init(start, space.potential, step_size=step_size, tables=self.tables, arrays=self.arrays)

    def step(
        self, state: nuts_step.State, space: Whitened, step_size: float
    ) -> tuple[nuts_step.State, Outcome]:
        """One leapfrog step of every tree."""
        return nuts_step.step(state, space.potential, step_size=step_size, tables=self.tables, arrays=self.arrays)

    def positions(self, state: nuts_step.State) -> Tensor:
        """Proposals of the trees so far."""
        return self.arrays.give(state.proposal[:, : state.momentum_sum.shape[1]])

    def tune(self, z: Tensor, groups: Tensor, space: Whitened, step_size: float) -> Tensor:
        """Trees may be as deep as was asked for from now on."""
        self.tables = self.full
        return z


class HMC:
    """See `hmc_step`."""

    def __init__(self, arrays: Arrays) -> None:
        self.arrays = arrays
        self.length = hmc_step.QUARTER

    def init(self, z: Tensor, space: Whitened, step_size: float) -> hmc_step.State:
        """Before the first trajectory."""
        return hmc_step.init(self.arrays.take(z), space.potential)

    def step(
        self, state: hmc_step.State, space: Whitened, step_size: float
    ) -> tuple[hmc_step.State, Outcome]:
        """One whole trajectory of every chain."""
        return hmc_step.step(
            state, space.potential, step_size=step_size, length=self.length, arrays=self.arrays
        )

    def positions(self, state: hmc_step.State) -> Tensor:
        """Ends of the last trajectories."""
        return self.arrays.give(state.position)

    def tune(self, z: Tensor, groups: Tensor, space: Whitened, step_size: float) -> Tensor:
        """The length of trajectories is found."""
        state = self.init(z, space, step_size)
        self.length, state = hmc_step.tuned_length(
            state, space.potential, groups, step_size=step_size, arrays=self.arrays
        )
        return self.positions(state)
