"""How good draws are: signs folded, effective sample sizes and R-hat by torchcal's own diagnostics, moments."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch

from benchmarks.sampling.density import Arrays
from torchcal.inference.diagnostics import figures

CONVERGED = 1.01
"""R-hat of every α below which chains count as converged."""

MOST = 1_000_000
"""Draws in all chains beyond which they are thinned before they are judged: only slow chains ever have so many."""


@dataclass(frozen=True)
class Quality:
    """Of draws of α, per coefficient ``(P,)``.

    Attributes:
        ess: The smaller of bulk and tail effective sample size.
        r_hat: Rank-normalised split R-hat.
        mean: Of all draws.
        sd: Likewise.
    """

    ess: np.ndarray
    r_hat: np.ndarray
    mean: np.ndarray
    sd: np.ndarray

    @property
    def worst(self) -> float:
        """The smallest effective sample size."""
        return float(self.ess.min())

    @property
    def converged(self) -> bool:
        """Whether every R-hat is small enough."""
        return bool((self.r_hat < CONVERGED).all())


def fold(arrays: Arrays, draws: np.ndarray) -> np.ndarray:
    """Reverse germs draw by draw so that each draw agrees best with the maximum: as torchcal does with its own.

    Where a posterior is its own mirror image, draws are brought to the maximum's side too: a sampler that visits one
    half alone and one that visits both are then judged by the same figures.
    """
    combinations = np.array(list(itertools.product((0, 1), repeat=arrays.odd.shape[1])))
    signs = 1.0 - 2.0 * (combinations @ arrays.odd.T % 2)
    if arrays.mirror is not None:
        signs = np.concatenate([signs, signs * arrays.mirror])
    score = (draws * arrays.map) @ signs.T
    return draws * signs[score.argmax(-1)]


def judge(arrays: Arrays, draws: np.ndarray) -> Quality:
    """Of draws ``(chains, draws, P)``."""
    thin = -(-draws.shape[0] * draws.shape[1] // MOST)
    folded = fold(arrays, draws[:, ::thin])
    tensor = torch.from_numpy(folded)
    found = figures(tensor)
    ess = torch.minimum(found.ess_bulk, found.ess_tail).numpy()
    flat = folded.reshape(-1, folded.shape[-1])
    return Quality(ess, found.r_hat.numpy(), flat.mean(0), flat.std(0))


def errors(found: Quality, reference: Quality) -> dict[str, float]:
    """Largest errors of mean and sd in posterior sd, and of the mean in units of both runs' Monte-Carlo error."""
    off = np.abs(found.mean - reference.mean) / reference.sd
    wide = np.abs(found.sd / reference.sd - 1)
    expected = np.sqrt(1 / found.ess + 1 / reference.ess)
    return {
        "error_mean": float(off.max()),
        "error_sd": float(wide.max()),
        "expected_error": float(expected.max()),
        "z": float((off / expected).max()) if math.isfinite(float(expected.max())) else math.nan,
    }
