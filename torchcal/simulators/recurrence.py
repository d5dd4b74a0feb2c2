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
    steps = flow.shape[2]
    block = max(1, math.ceil(math.sqrt(steps)))
    count = math.ceil(steps / block)
    pad = count * block - steps
    if pad:
        eye = torch.eye(flow.shape[-1], dtype=flow.dtype).expand(*flow.shape[:2], pad, -1, -1)
        flow = torch.cat([flow, eye], dim=2)
        forcing = torch.cat([forcing, forcing.new_zeros(*forcing.shape[:2], pad, *forcing.shape[3:])], dim=2)
    # Columns of the identity ride along: they carry what enters a block to every step of it.
    flow = flow.unflatten(2, (count, block))
    forcing = forcing.unflatten(2, (count, block))
    size = flow.shape[-1]
    carried = torch.cat([torch.zeros_like(flow[:, :, :, 0]), forcing.new_zeros(*forcing[:, :, :, 0].shape)], dim=-1)
    carried[..., :size] += torch.eye(size, dtype=flow.dtype)
    inside = []
    zeros = torch.zeros_like(carried[..., :size])
    for k in range(block):
        carried = flow[:, :, :, k] @ carried + torch.cat([zeros, forcing[:, :, :, k]], dim=-1)
        inside.append(carried)
    within = torch.stack(inside, dim=3)  # (H, R, count, block, S, S + C)
    entering = [forcing.new_zeros(*forcing.shape[:2], size, forcing.shape[-1])]
    for j in range(count - 1):
        end = within[:, :, j, -1]
        entering.append(end[..., :size] @ entering[-1] + end[..., size:])
    enters = torch.stack(entering, dim=2).unsqueeze(3)
    found = within[..., :size] @ enters + within[..., size:]
    return found.flatten(2, 3)[:, :, :steps]
