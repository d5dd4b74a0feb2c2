"""What a sampler returns."""

from dataclasses import dataclass

from torch import Tensor

from torchcal.inference.diagnostics import Figures
from torchcal.results.diagnostics import Mode

__all__ = ["Draws"]


@dataclass(frozen=True)
class Draws:
    """Posterior draws.

    Attributes:
        alpha: ``(chains, draws, P)``.
        divergences: Number of divergent transitions among them.
        modes: Where chains began.
        figures: R-hat and effective sample sizes of α, where they are known already.
    """

    alpha: Tensor
    divergences: int
    modes: tuple[Mode, ...] = ()
    figures: Figures | None = None
