"""Work on large batches in pieces of bounded size, in the forward pass and in the backward pass."""

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchcal.simulators.dual import transformed

__all__ = ["CACHED", "MANY", "MOST", "forgetful", "over_batch"]

MOST = 2**24
"""Numbers at once, 128 MiB."""

CACHED = 2**20
"""Numbers of outputs at once that a CPU's caches hold."""

MANY = 2**21
"""Numbers of outputs from which on such pieces are faster than all at once, though they are computed twice."""

Moments = Callable[[Tensor], tuple[Tensor, ...]]


def forgetful(function: Moments, alpha: Tensor) -> tuple[Tensor, ...]:
    """``function(alpha)``, whose intermediate values are computed again in the backward pass instead of kept."""
    if torch.is_grad_enabled() and alpha.requires_grad and not transformed(alpha):
        return checkpoint(function, alpha, use_reentrant=False)
    return function(alpha)


def over_batch(function: Moments, alpha: Tensor, size: int, *, whole: bool) -> tuple[Tensor, ...]:
    """Apply a function of a batch of α ``(*batch, P)`` to ``size`` of them at a time.

    Where a single α is not one ``whole`` piece, the function cuts it further, and forgets by itself.
    """
    batch = alpha.shape[:-1]
    rows = math.prod(batch)
    if rows <= size:
        return function(alpha)
    flat = alpha.reshape(rows, -1)
    apply = (lambda block: forgetful(function, block)) if whole else function
    parts = [apply(flat[start : start + size]) for start in range(0, rows, size)]
    return tuple(torch.cat(items).reshape(*batch, *items[0].shape[1:]) for items in zip(*parts, strict=True))
