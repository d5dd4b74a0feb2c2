"""Convergence of chains: rank-normalised R-hat, bulk and tail effective sample size.

Source: Vehtari, Gelman, Simpson, Carpenter & Bürkner (2021), Bayesian Analysis 16, 667-718.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from pyro.ops.stats import split_gelman_rubin
from torch import Tensor

__all__ = ["FEWEST", "Figures", "figures"]

FEWEST = 4
"""Draws a chain from which figures can be had: halves of two."""


class Figures(NamedTuple):
    """Convergence of every quantity, the shape of the draws without chains and draws.

    Attributes:
        r_hat: The larger of the rank-normalised split R-hat of the draws and of their distances from the median; 1
            where nothing varies, NaN with fewer than 4 draws.
        ess_bulk: Effective sample size of the rank-normalised split chains: how well the centre is known.
        ess_tail: Smaller effective sample size of the 5 % and 95 % quantiles: how well the tails are known.
    """

    r_hat: Tensor
    ess_bulk: Tensor
    ess_tail: Tensor

    @property
    def least_ess(self) -> float:
        """The smallest effective sample size of all quantities."""
        return float(torch.minimum(self.ess_bulk, self.ess_tail).min())

    @property
    def worst_r_hat(self) -> float:
        """The largest R-hat of all quantities."""
        return float(self.r_hat.max())


def figures(draws: Tensor) -> Figures:
    """R-hat and effective sample sizes of draws ``(chains, draws, ...)``."""
    chains, count = draws.shape[:2]
    rest = draws.shape[2:]
    values = draws.to(torch.float64).flatten(2).permute(2, 0, 1).contiguous()  # (Q, C, n)
    if count < FEWEST:
        nothing = torch.full(rest, torch.nan, dtype=torch.float64)
        return Figures(nothing, nothing, nothing)
    quantiles = _by_double_rank(chains * count)
    ordered, scores = _normal_scores(values.flatten(1), quantiles)
    middle = ordered[:, (chains * count - 1) // 2, None, None]
    _, folded = _normal_scores((values - middle).abs().flatten(1), quantiles)
    scores, folded = scores.reshape(values.shape), folded.reshape(values.shape)
    spread = torch.maximum(_split_r_hat(scores), _split_r_hat(folded))
    ends = [_quantile(ordered, q) for q in (0.05, 0.95)]
    tail = torch.minimum(*(_ess((values <= end[:, None, None]).to(torch.float64)) for end in ends))
    constant = ordered[:, 0] == ordered[:, -1]
    total = torch.full_like(tail, float(chains * count))
    undefined = ~torch.isfinite(values).all(-1).all(-1)

    def told(figure: Tensor, otherwise: Tensor) -> Tensor:
        figure = torch.where(constant, otherwise, figure)
        return torch.where(undefined, torch.full_like(figure, torch.nan), figure).reshape(rest)

    return Figures(told(spread, torch.ones_like(total)), told(_ess(scores), total), told(tail, total))


def _split_r_hat(values: Tensor) -> Tensor:
    """Of ``(Q, C, n)``, ``(Q,)``."""
    even = values.shape[2] // 2 * 2
    return split_gelman_rubin(values[:, :, :even].permute(1, 2, 0))


def _ess(values: Tensor) -> Tensor:
    """Of ``(Q, C, n)``, chains split in halves, ``(Q,)``."""
    half = values.shape[2] // 2
    return torch.stack([_effective(torch.cat([value[:, :half], value[:, -half:]])) for value in values])


def _effective(chains: Tensor) -> Tensor:
    """Of chains ``(C, n)``: sums of neighbouring autocorrelations while positive, made to fall (Geyer 1992)."""
    count, n = chains.shape
    total = float(count * n)
    offset = chains - chains.mean(1, keepdim=True)
    power = torch.view_as_real(torch.fft.rfft(offset, 2 * n)).square().sum(-1).mean(0)
    covariance = torch.fft.irfft(power, 2 * n)[:n] / n
    within = covariance[0] * n / (n - 1)
    across = chains.mean(1).var() if count > 1 else torch.zeros_like(within)
    correlation = 1 - (within - covariance * n / (n - 1)) / (covariance[0] + across)
    correlation[0] = 1.0
    pairs = correlation[: n // 2 * 2].reshape(-1, 2).sum(1)
    positive = (pairs >= 0).to(torch.int64).cumprod(0).to(torch.bool)
    time = 2 * (torch.cummin(pairs, 0).values * positive).sum() - 1
    # Antithetic draws may count for more than one, but not without limit (Vehtari et al. 2021, app. A).
    return total / torch.nan_to_num(time, nan=1.0).clamp_min(1 / math.log10(max(total, 11.0)))


def _by_double_rank(count: int) -> np.ndarray:
    """Normal quantiles of the ranks 1, 3/2, 2 … ``count``: draws that tie share the mean of their ranks."""
    ranks = torch.arange(2, 2 * count + 1, dtype=torch.float64) / 2
    return torch.special.ndtri((ranks - 0.375) / (count + 0.25)).numpy()


def _normal_scores(values: Tensor, quantiles: np.ndarray) -> tuple[Tensor, Tensor]:
    """Sorted values ``(Q, S)``, and of each value the normal quantile of its rank. NumPy sorts faster than PyTorch."""
    every = values.cpu().numpy()
    ordered, scores = np.empty_like(every), np.empty_like(every)
    for row, sorted_row, score in zip(every, ordered, scores, strict=True):
        order = row.argsort()
        sorted_row[:] = row[order]
        first = np.flatnonzero(np.concatenate([[True], sorted_row[1:] != sorted_row[:-1]]))
        last = np.concatenate([first[1:], [len(row)]]) - 1
        score[order] = np.repeat(quantiles[first + last], last - first + 1)
    return torch.from_numpy(ordered), torch.from_numpy(scores)


def _quantile(ordered: Tensor, q: float) -> Tensor:
    """Of sorted values ``(Q, S)``, between neighbours in proportion, ``(Q,)``."""
    place = q * (ordered.shape[1] - 1)
    low = int(place)
    high = min(low + 1, ordered.shape[1] - 1)
    return ordered[:, low] + (place - low) * (ordered[:, high] - ordered[:, low])
