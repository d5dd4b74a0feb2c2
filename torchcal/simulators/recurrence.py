"""A linear recurrence in time, solved in blocks that run side by side."""

import math

import torch
from torch import Tensor

__all__ = ["recur"]


def recur(flow: Tensor, forcing: Tensor) -> Tensor:
    """x₁ … x_K of x_{k+1} = flow_k x_k + forcing_k with x₀ = 0, in blocks that run side by side.

    Args:
        flow: ``(H, R, K, S, S)``.
        forcing: ``(H, R, K, S, C)``.
    """
    hyper, runs, steps, size, columns = forcing.shape
    block = max(1, math.ceil(math.sqrt(steps)))
    count = math.ceil(steps / block)
    # Columns of the identity ride along: they carry what enters a block to every step of it.
    both = torch.cat([flow, torch.zeros_like(flow), forcing], dim=-1).flatten(0, 1)
    pad = count * block - steps
    if pad:
        still = torch.cat([torch.eye(size, dtype=flow.dtype), flow.new_zeros(size, size + columns)], dim=-1)
        both = torch.cat([both, still.expand(hyper * runs, pad, -1, -1)], dim=1)
    both = both.unflatten(1, (count, block)).movedim(2, 0).flatten(1, 2).contiguous()  # (block, H R count, S, 2 S + C)
    carried = torch.eye(size, size + columns, dtype=flow.dtype).expand(both.shape[1], -1, -1)
    inside = []
    for step, push in zip(both[..., :size].unbind(0), both[..., size:].unbind(0), strict=True):
        carried = torch.baddbmm(push, step, carried)
        inside.append(carried)
    within = torch.stack(inside)  # (block, H R count, S, S + C)
    ends = carried.unflatten(0, (hyper * runs, count)).movedim(1, 0)
    entering = [forcing.new_zeros(hyper * runs, size, columns)]
    for step, push in zip(ends[:-1, :, :, :size].unbind(0), ends[:-1, :, :, size:].unbind(0), strict=True):
        entering.append(torch.baddbmm(push, step, entering[-1]))
    enters = torch.stack(entering, dim=1).flatten(0, 1)  # (H R count, S, C)
    found = within[..., :size] @ enters + within[..., size:]
    found = found.unflatten(1, (hyper * runs, count)).movedim(0, 2).flatten(1, 2)[:, :steps]
    return found.unflatten(0, (hyper, runs))
