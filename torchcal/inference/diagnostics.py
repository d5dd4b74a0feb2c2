"""Convergence of chains: rank-normalised R-hat, bulk and tail effective sample size.

Source: Vehtari, Gelman, Simpson, Carpenter & Bürkner (2021), Bayesian Analysis 16, 667-718.
"""

import torch
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor

__all__ = ["bulk_ess", "r_hat", "tail_ess"]


def r_hat(draws: Tensor) -> Tensor:
    """Larger of the rank-normalised split R-hat of the draws and of their distances from the median.

    Args:
        draws: ``(chains, draws, ...)``.

    Returns:
        Shape of the rest; 1 where nothing varies, NaN with fewer than 4 draws.
    """
    if draws.shape[1] < 4:
        return torch.full(draws.shape[2:], torch.nan, dtype=torch.float64)
    flat = draws.to(torch.float64).flatten(0, 1)
    folded = (draws - flat.median(0).values).abs()
    bulk, spread = (split_gelman_rubin(_even(_normal_scores(v))) for v in (draws, folded))
    return _where_varying(draws, torch.maximum(bulk, spread), 1.0)


def bulk_ess(draws: Tensor) -> Tensor:
    """Effective sample size of the rank-normalised split chains: how well the centre is known."""
    return _ess(draws, _normal_scores(draws))


def tail_ess(draws: Tensor) -> Tensor:
    """Smaller effective sample size of the 5 % and 95 % quantiles: how well the tails are known."""
    flat = draws.flatten(0, 1).to(torch.float64)
    ends = [(draws <= torch.quantile(flat, q, dim=0)).to(torch.float64) for q in (0.05, 0.95)]
    return torch.minimum(*(_ess(draws, end) for end in ends))


def _ess(draws: Tensor, values: Tensor) -> Tensor:
    if draws.shape[1] < 4:
        return torch.full(draws.shape[2:], torch.nan, dtype=torch.float64)
    half = values.shape[1] // 2
    split = torch.cat([values[:, :half], values[:, -half:]])
    total = float(draws.shape[0] * draws.shape[1])
    found = torch.nan_to_num(effective_sample_size(split), nan=total, posinf=total)
    found = found.clamp_min(1.0)  # the estimate from a few draws can be negative
    return _where_varying(draws, found, total)


def _even(values: Tensor) -> Tensor:
    return values[:, : values.shape[1] // 2 * 2]


def _normal_scores(draws: Tensor) -> Tensor:
    flat = draws.to(torch.float64).flatten(0, 1)
    count = len(flat)
    order = flat.argsort(dim=0)
    ranks = torch.empty_like(flat)
    places = torch.arange(1, count + 1, dtype=torch.float64).reshape(-1, *[1] * (flat.ndim - 1))
    ranks.scatter_(0, order, places.expand_as(flat).clone())
    uniform = (ranks - 0.375) / (count + 0.25)
    return (torch.special.ndtri(uniform)).reshape(draws.shape)


def _where_varying(draws: Tensor, value: Tensor, otherwise: float) -> Tensor:
    flat = draws.flatten(0, 1)
    constant = (flat == flat[:1]).all(0)
    return torch.where(constant, torch.full_like(value, otherwise), value)
