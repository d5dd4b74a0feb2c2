"""What a sampler returns."""

from dataclasses import dataclass

from torch import Tensor

from torchcal.results.diagnostics import Mode

__all__ = ["Draws"]


@dataclass(frozen=True)
class Draws:
    """Posterior draws.

    Attributes:
        alpha: ``(chains, draws, P)``.
        divergences: Number of divergent transitions among them.
        modes: Where chains began.
    """

    alpha: Tensor
    divergences: int
    modes: tuple[Mode, ...] = ()
