"""Where the search for the maximum begins."""

import torch
from torch import Tensor

from torchcal.errors import ShapeError
from torchcal.inference.randomness import preserve_random_state
from torchcal.models import Problem

__all__ = ["check_starts", "starting_points"]


def check_starts(problem: Problem, starts: Tensor | None) -> Tensor | None:
    """A user's starting points as a tensor of the problem's kind, or an error."""
    if starts is None:
        return None
    size = problem.prior.low.shape[0]
    try:
        points = torch.as_tensor(starts).to(problem.propagate.nodes)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ShapeError(f"Expected starts as a tensor of shape (S, {size}). Got {starts!r}.") from error
    if points.ndim != 2 or points.shape[1] != size or not len(points):
        raise ShapeError(f"Expected starts of shape (S, {size}), one column an α. Got {tuple(points.shape)}.")
    return points


def starting_points(problem: Problem, leading: Tensor, num_starts: int, seed: int) -> Tensor:
    """Half around the least-squares fit and half from the prior, with spreads over two decades."""
    pattern = problem.propagate.pattern
    with preserve_random_state(seed):
        points = problem.prior.sample((num_starts,))
        extra = points.shape[1] - pattern.num_alpha  # ln σ of the additive model
        is_leading = torch.cat([pattern.leading, torch.zeros(extra, dtype=torch.bool)]).to(points.device)
        single = torch.float32  # whatever the default is: other draws would follow
        jitter = 0.1 * torch.randn(num_starts, len(leading), dtype=single).to(points)
        spread = 10 ** (2 * torch.rand(num_starts, 1, dtype=single).to(points) - 2)
        normal = torch.randn(points.shape, dtype=single).to(points)
    near = torch.arange(num_starts) % 2 == 0
    anchor = leading + jitter
    anchor[0] = leading
    columns = is_leading.nonzero()[:, 0]
    rows = near.nonzero()[:, 0].to(points.device)
    points[rows[:, None], columns] = anchor[rows]
    if extra == 0:
        points = torch.where(is_leading, points, spread * normal)
    low, high = problem.prior.low, problem.prior.high
    inner = 0.01 * torch.where(torch.isfinite(high - low), high - low, torch.ones_like(low))
    return torch.maximum(torch.minimum(points, high - inner), low + inner)
