"""Densities on grids that follow the draws: binned kernel estimates, and contours of given probability."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchcal.errors import DomainError
from torchcal.prediction import kernel_density

__all__ = [
    "check_levels",
    "contour_heights",
    "curve",
    "ellipse",
    "oblique_grid",
    "pair_density",
    "principal_axes",
    "side_of_zero",
    "smooth",
]


#: Draws from which on it is told where they end; and the share of them within so many sd of 0 from which on they are
#: crowded there, as those of an ordinary density that stays on one side are not.
ENOUGH, CROWD, NEAR = 100, 0.05, 0.25


def side_of_zero(draws: np.ndarray) -> int:
    """On which side of 0 all draws ``(S,)`` lie, crowded at it, 1 or -1; else 0, and where they are too few to say.

    A coefficient whose sign means nothing ends there, and a kernel estimate would not.
    """
    if len(draws) < ENOUGH or (np.abs(draws) < NEAR * draws.std()).mean() < CROWD:
        return 0
    return int(bool((draws >= 0).all())) - int(bool((draws <= 0).all()))


def check_levels(levels: Sequence[float]) -> tuple[float, ...]:
    """Probabilities, ascending and distinct.

    Raises:
        DomainError: If one is not between 0 and 1, or there is none.
    """
    try:
        values = sorted({float(level) for level in levels})
    except TypeError as error:
        raise DomainError(f"Expected levels: a sequence of probabilities. Got {levels!r}.") from error
    if not values or not all(0 < level < 1 for level in values):
        raise DomainError(f"Expected levels: probabilities between 0 and 1. Got {levels!r}.")
    return tuple(values)


def principal_axes(covariance: np.ndarray) -> np.ndarray:
    """A matrix whose columns are the principal axes, one sd long each, ``(2, 2)``.

    The axes are found in units of each quantity's sd, so that K and cal/mol may stand side by side.
    """
    scale = np.sqrt(np.diagonal(covariance).clip(0))
    safe = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    return scale[:, None] * vectors * np.sqrt(values.clip(0))


def oblique_grid(center: np.ndarray, axes: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points ``center + axes @ (u, v)``, two arrays ``(len(v), len(u))``."""
    across, along = np.meshgrid(u, v)
    return (
        center[0] + axes[0, 0] * across + axes[0, 1] * along,
        center[1] + axes[1, 0] * across + axes[1, 1] * along,
    )


def contour_heights(density: np.ndarray, levels: Sequence[float]) -> list[float]:
    """Heights above which the given shares of a density on cells of equal area lie, ascending.

    >>> contour_heights(np.array([0.1, 0.6, 0.3]), [0.5])
    [0.6]
    """
    ordered = np.sort(density, axis=None)[::-1]
    share = np.cumsum(ordered) / ordered.sum()
    heights = {float(ordered[min(int(np.searchsorted(share, level)), len(ordered) - 1)]) for level in levels}
    return sorted(height for height in heights if height > 0)


def ellipse(center: np.ndarray, axes: np.ndarray, level: float, num: int = 361) -> np.ndarray:
    """The closed curve that holds the probability ``level`` of a normal density, ``(num, 2)``."""
    radius = math.sqrt(-2 * math.log1p(-level))
    angle = np.linspace(0, 2 * np.pi, num)
    return center + radius * np.stack([np.cos(angle), np.sin(angle)], -1) @ axes.T


def pair_density(
    draws: np.ndarray, bins: int = 96, sides: Sequence[int] = (0, 0)
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Normal kernel density estimate of draws ``(S, 2)`` on a grid along their principal axes.

    The draws are counted in cells first, so that the cost does not grow with S times the size of the grid.

    Args:
        draws: ``(S, 2)``.
        bins: Cells along each axis.
        sides: For each quantity, 0, or the sign of all its draws, at whose end the density is reflected: beyond 0 it
            goes on as its mirror image.

    Returns:
        x, y and the density (not normalised), ``(bins, bins)`` each; None where the draws lie on a line.
    """
    center = draws.mean(0)
    axes = principal_axes(np.cov(draws.T))
    lengths = np.linalg.norm(axes / np.maximum(draws.std(0), 1e-300)[:, None], axis=0)
    if not lengths.min() > 1e-9 * max(lengths.max(), 1e-300):
        return None
    white = np.linalg.solve(axes, (draws - center).T).T
    width = len(draws) ** (-1 / 6)  # Silverman's, in two dimensions
    # A few far draws must not make the cells of all the others coarse.
    low, high = np.quantile(white, [0.0005, 0.9995], axis=0)
    low, high = low - 3 * width, high + 3 * width
    counts, u, v = np.histogram2d(white[:, 0], white[:, 1], bins, range=[(low[0], high[0]), (low[1], high[1])])
    for axis, edges in enumerate((u, v)):
        counts = smooth(counts, width / (edges[1] - edges[0]), axis)
    u, v = 0.5 * (u[1:] + u[:-1]), 0.5 * (v[1:] + v[:-1])
    x, y = oblique_grid(center, axes, u, v)
    density = counts.T
    for place in (place for place, side in enumerate(sides) if side):
        mirrored = np.stack([x, y])
        mirrored[place] *= -1.0
        across, along = np.linalg.solve(axes, mirrored.reshape(2, -1) - center[:, None])
        shares = np.stack([(across - u[0]) / (u[-1] - u[0]), (along - v[0]) / (v[-1] - v[0])], -1)
        at = torch.from_numpy(2.0 * shares - 1.0).reshape(1, bins, bins, 2)
        image = torch.nn.functional.grid_sample(torch.from_numpy(density.copy())[None, None], at, align_corners=True)
        density = density + image[0, 0].numpy()
    return x, y, density


def smooth(counts: np.ndarray, width: float, axis: int) -> np.ndarray:
    """Convolve with a normal kernel of ``width`` cells."""
    place = np.arange(counts.shape[axis])
    kernel = np.exp(-0.5 * ((place[:, None] - place) / max(width, 1e-3)) ** 2)
    return np.moveaxis(np.tensordot(kernel / kernel.sum(0), counts, (1, axis)), 0, axis)


def curve(
    draws: np.ndarray, *, num: int = 400, max_draws: int = 20_000, tails: bool = False, side: int | None = None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Normal kernel density estimate of draws ``(S,)`` on ``num`` points across them, reflected at 0 where they end.

    Args:
        draws: ``(S,)``.
        num: Number of points.
        max_draws: At most this many draws, evenly spaced, are used: more do not change a drawn line.
        tails: Whether to reach the farthest draws; otherwise all but a thousandth of them.
        side: On which side of 0 they end; by default as `side_of_zero` says.

    Returns:
        Points and density, ``(num,)`` each; None where all draws are one value.
    """
    side = side_of_zero(draws) if side is None else side
    draws = draws[np.linspace(0, len(draws) - 1, min(len(draws), max_draws)).round().astype(int)]
    spread = float(draws.std())
    if len(draws) < 2 or not spread > 1e-13 * float(np.abs(draws).max()):
        return None
    margin = 3 * spread * len(draws) ** -0.2
    low, high = np.quantile(draws, [0.0, 1.0] if tails else [0.0005, 0.9995])
    low, high = low - margin, high + margin
    ends = side != 0 and low < 0 < high
    if ends:
        low, high = (0.0, high) if side > 0 else (low, 0.0)
    points = np.linspace(low, high, num)
    density = kernel_density(_column(draws), _column(points)).numpy()
    if ends:
        density = density + kernel_density(_column(draws), _column(-points)).numpy()
    return points, density


def _column(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).unsqueeze(-1)
