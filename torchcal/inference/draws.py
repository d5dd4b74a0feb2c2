"""What a sampler returns."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.inference.diagnostics import Figures
from torchcal.results.diagnostics import Mode

__all__ = ["WORTH_CHAINS", "Draws", "most_divergences"]

WORTH_CHAINS = 0.05
"""Weight from which on chains begin at a mode: one of a few dozen chains at a mode of 2 % would be too many."""

_DIVERGING = 1e-4
"""Share of transitions that may diverge: one of ten thousand is no region that chains cannot enter."""

_CHANCE = 0.95
"""Probability with which that share leaves no more divergences than may be."""


def most_divergences(transitions: int) -> int:
    """How many transitions may diverge: no more than chance makes of one in ten thousand.

    >>> [most_divergences(n) for n in (100, 5_000, 100_000)]
    [0, 2, 15]
    """
    mean = torch.tensor(_DIVERGING * transitions, dtype=torch.float64)
    most = int(mean)
    while float(torch.special.gammaincc(torch.full_like(mean, most + 1), mean)) < _CHANCE:  # Poisson's distribution
        most += 1
    return most


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
