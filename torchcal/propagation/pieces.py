"""Work on large batches in pieces of bounded size, in the forward pass and in the backward pass."""

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

__all__ = ["forgetful", "over_batch"]

Moments = Callable[[Tensor], tuple[Tensor, ...]]


def forgetful(function: Moments, alpha: Tensor) -> tuple[Tensor, ...]:
    """``function(alpha)``, whose intermediate values are computed again in the backward pass instead of kept."""
    if torch.is_grad_enabled() and alpha.requires_grad:
        return checkpoint(function, alpha, use_reentrant=False)
    return function(alpha)


def over_batch(function: Moments, alpha: Tensor, size: int) -> tuple[Tensor, ...]:
    """Apply a function of a batch of α ``(*batch, P)`` to ``size`` of them at a time.

    One α at a time is left to the function itself, which then has pieces of its own.
    """
    batch = alpha.shape[:-1]
    rows = math.prod(batch)
    if rows <= size:
        return function(alpha)
    flat = alpha.reshape(rows, -1)
    apply = function if size == 1 else lambda block: forgetful(function, block)
    parts = [apply(flat[start : start + size]) for start in range(0, rows, size)]
    return tuple(torch.cat(items).reshape(*batch, *items[0].shape[1:]) for items in zip(*parts, strict=True))
