"""What a sampler returns."""

from dataclasses import dataclass

from torch import Tensor

from torchcal.inference.diagnostics import Figures
from torchcal.results.diagnostics import Mode

__all__ = ["WORTH_CHAINS", "Draws", "most_divergences"]

WORTH_CHAINS = 0.05
"""Weight from which on chains begin at a mode: one of a few dozen chains at a mode of 2 % would be too many."""

_DIVERGING = 1e-4
"""Share of transitions that may diverge: one of ten thousand or more is no region that chains cannot enter."""


def most_divergences(transitions: int) -> int:
    """How many transitions may diverge."""
    return int(_DIVERGING * transitions)


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
