"""Trajectories at some parameter values, and a guess of those at others."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Solution"]


@dataclass(frozen=True, eq=False)
class Solution:
    """Trajectories, from which those at nearby parameter values are found in a pass or two.

    Attributes:
        states: At the ends of all steps, ``(H, R, K + 1, S)``.
        values: Parameter values, ``(H, P)``; None where the states are a guess for other parameters than their own.
        columns: Places of the parameters that derivatives are known by.
        tangents: ∂ states / ∂ columns, ``(H, R, K + 1, S, C)``; None where they are not kept.
    """

    states: Tensor
    values: Tensor | None = None
    columns: Sequence[int] = ()
    tangents: Tensor | None = None

    def near(self, values: Tensor) -> Tensor:
        """States at other values ``(H, P)``, to first order."""
        if self.values is None or self.tangents is None:
            return self.states
        moved = (values - self.values)[:, list(self.columns), None]
        found = self.states + (self.tangents.flatten(1, 3) @ moved).view_as(self.states)
        sound = torch.isfinite(found).flatten(1).all(-1)
        return torch.where(sound[:, None, None, None], found, self.states)

    def rows(self, which: Tensor) -> "Solution":
        """Some of the trajectories, by their places or as a mask."""
        return dataclasses.replace(
            self,
            states=self.states[which],
            values=None if self.values is None else self.values[which],
            tangents=None if self.tangents is None else self.tangents[which],
        )

    @property
    def spare(self) -> Tensor | None:
        """The states as they are, where a prediction has left the range in which rates are defined."""
        return None if self.tangents is None else self.states

    def repeated(self, count: int) -> "Solution":
        """A single trajectory so many times, as a guess for any parameters."""
        return Solution(self.states.expand(count, *self.states.shape[1:]))

    def updated(self, which: Tensor, other: "Solution") -> "Solution":
        """With other trajectories in some places, given as a mask."""
        if self.values is None or self.tangents is None or other.values is None or other.tangents is None:
            return Solution(_put(self.states, which, other.states))
        return dataclasses.replace(
            other,
            states=_put(self.states, which, other.states),
            values=_put(self.values, which, other.values),
            tangents=_put(self.tangents, which, other.tangents),
        )


def _put(old: Tensor, which: Tensor, new: Tensor) -> Tensor:
    found = old.clone()
    found[which] = new
    return found
