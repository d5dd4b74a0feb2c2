"""What a sampler returns."""

from dataclasses import dataclass

from torch import Tensor

__all__ = ["Draws"]


@dataclass(frozen=True)
class Draws:
    """Posterior draws of α ``(chains, draws, P)`` and the number of divergent transitions."""

    alpha: Tensor
    divergences: int
