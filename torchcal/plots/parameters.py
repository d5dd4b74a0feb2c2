"""The joint density of two parameters, under the MAP and averaged over the posterior."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchcal import prediction
from torchcal.errors import DomainError, ShapeError
from torchcal.plots import style
from torchcal.plots.densities import (
    check_levels,
    contour_heights,
    ellipse,
    oblique_grid,
    pair_density,
    principal_axes,
    smooth,
)
from torchcal.propagation import NISP

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["parameter_density"]

#: Draws that give the extent of a density without a variance.
DRAWN = 4000


def parameter_density(
    propagate: NISP,
    alpha_map: Tensor,
    draws: Tensor | None = None,
    names: Sequence[str] | None = None,
    *,
    ax: "Axes | None" = None,
    levels: Sequence[float] = (0.5, 0.9),
    remove_slope: bool = False,
    max_draws: int = 4000,
    grid: int = 161,
    num_samples: int = 100_000,
    seed: int = 0,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    r"""Contours of :math:`\pi_\lambda(\lambda; \alpha_{MAP})` and of its average over the posterior (Eq. 44).

    A contour encloses the most likely region of a given probability, by the density of ln λ where a parameter has
    ``transform="log"``. Grids follow the principal axes of each density, so that a narrow sloping ridge is resolved.
    Normal densities are drawn as exact ellipses; a singular one is the line, or point, that it is. The average over
    draws is exact where there are two normal parameters (see `torchcal.prediction.parameter_density`), else a kernel
    estimate.

    Args:
        propagate: The propagation that α belongs to.
        alpha_map: MAP α, ``(P,)``.
        draws: Posterior draws of α, ``(S, P)``, or None for the MAP alone.
        names: Two free parameters, abscissa first; by default the only two.
        ax: Where to draw; a new figure by default.
        levels: Probabilities that the contours enclose.
        remove_slope: Whether the ordinate is what is left of the second parameter after its regression on the
            first under the MAP, so that a narrow ridge lies flat and its width can be seen.
        max_draws: At most this many draws, evenly spaced, are averaged over.
        grid: Points along each axis of the grid.
        num_samples: Draws of λ, where a kernel estimate is needed.
        seed: Of those.
        labels: How to write names on the axes, by name.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If the names are not two free parameters, or a level is not between 0 and 1.
        ShapeError: If α does not fit the propagation.

    Source: Sargsyan, Najm & Ghanem (2015), Eq. 44, Figs. 12, 18.
    """
    if not isinstance(propagate, NISP):
        raise DomainError(
            f"Expected the propagation first, then α: parameter_density(result.propagate, result.map.alpha). Got "
            f"{type(propagate).__name__} first."
        )
    pair = _pair(propagate, names)
    levels = check_levels(levels)
    if grid < 16:
        raise DomainError(f"Expected a grid of at least 16 points along each axis. Got {grid}.")
    like = propagate.nodes
    size = propagate.num_alpha
    estimate = torch.from_numpy(style.array(alpha_map, "alpha_map", 1)).to(like)
    if estimate.shape != (size,):
        raise ShapeError(f"Expected alpha_map of shape ({size},). Got {tuple(estimate.shape)}.")
    average: Tensor | None = None
    if draws is not None:
        average = torch.from_numpy(style.array(draws, "draws", 2)).to(like)
        if average.shape[1] != size:
            raise ShapeError(f"Expected draws of shape (S, {size}), all chains in one. Got {tuple(average.shape)}.")
        average = average[torch.linspace(0, len(average) - 1, min(len(average), max_draws)).round().long()]
    ax = style.new_axes(ax, (4.4, 3.8))
    with torch.no_grad():
        shear = _shear(propagate, estimate, pair) if remove_slope else None
        parts = []
        if average is not None:
            parts.append(_draw_average(ax, propagate, average, pair, levels, grid, num_samples, seed, shear))
        parts.append(_draw_one(ax, propagate, estimate, pair, levels, num_samples, seed, shear))
    shown = [propagate.free[i] for i in pair]
    units = {parameter.name: parameter.unit for parameter in shown if parameter.unit}
    ax.set_xlabel(style.label(shown[0].name, units, labels))
    across = style.label(shown[1].name, units, labels)
    if shear is not None:
        first, second = (style.label(parameter.name, None, labels) for parameter in shown)
        across = f"{second} − {shear[0]:.5g} ({first} − {style.number(shear[1])})".replace("− -", "+ ")
        across += f" [{shown[1].unit}]" if shown[1].unit else ""
    ax.set_ylabel(across)
    _set_limits(ax, np.concatenate(parts))
    style.dress(ax)
    if legend:
        style.legend(ax, title="contours hold " + ", ".join(f"{100 * level:g}" for level in levels) + " %")
    return ax


def _pair(propagate: NISP, names: Sequence[str] | None) -> tuple[int, int]:
    known = [parameter.name for parameter in propagate.free]
    if names is None:
        if len(known) != 2:
            raise DomainError(f"Expected names=: two of the free parameters {known}. Got none.")
        return 0, 1
    if isinstance(names, str) or len(names) != 2 or names[0] == names[1]:
        raise DomainError(f"Expected names=: two different free parameters of {known}. Got {names!r}.")
    unknown = [name for name in names if name not in known]
    if unknown:
        raise DomainError(f"Expected names among the free parameters {known}. Got {unknown} (check the spelling).")
    return known.index(names[0]), known.index(names[1])


def _is_normal(propagate: NISP, pair: tuple[int, int]) -> bool:
    pattern = propagate.pattern
    return pattern.order <= 1 and pattern.basis.name == "hermite" and not bool(propagate.scaling.log[list(pair)].any())


def _moments(propagate: NISP, alpha: Tensor, pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of two parameters, averaged over draws of α, ``(S, P)``; medians where there is no mean."""
    mean, covariance = propagate.parameter_moments(alpha)
    mean, covariance = (
        mean[:, list(pair)].cpu().double(),
        covariance[:, list(pair)][:, :, list(pair)].cpu().double(),
    )
    offset = mean - mean.mean(0)
    total = covariance.mean(0) + offset.T @ offset / len(offset)
    if not bool(torch.isfinite(total).all()):  # a square in ln λ may leave λ without a variance
        points = _samples(propagate, alpha, pair, DRAWN, seed=0)
        return np.median(points, axis=0), np.cov(points.T)
    return mean.mean(0).numpy(), total.numpy()


def _samples(propagate: NISP, alpha: Tensor, pair: tuple[int, int], num_samples: int, seed: int) -> np.ndarray:
    """Draws of two parameters: the same number, with germs of their own, for each α."""
    num = max(1, num_samples // len(alpha))
    germs = propagate.draw_germ(num * len(alpha), seed=seed).reshape(len(alpha), num, -1)
    parts = [propagate.parameters_at(a, xi)[:, list(pair)] for a, xi in zip(alpha, germs, strict=True)]
    return torch.cat(parts).cpu().double().numpy()


def _density(
    propagate: NISP, alpha: Tensor, pair: tuple[int, int], num_samples: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """A kernel density of two parameters on a grid, per unit of ln λ where one is on a logarithmic scale."""
    draws = _samples(propagate, alpha, pair, num_samples, seed)
    log = propagate.scaling.log[list(pair)].tolist()
    found = pair_density(np.stack([np.log(d) if on else d for d, on in zip(draws.T, log, strict=True)], -1))
    if found is None:
        return None
    x, y = (np.exp(grid) if on else grid for grid, on in zip(found[:2], log, strict=True))
    return x, y, found[2]


def _flat(axes: np.ndarray, covariance: np.ndarray) -> bool:
    """Whether a density lies on a line, to the digits that a grid can carry."""
    scale = np.sqrt(np.diagonal(covariance).clip(0))
    if not (scale > 0).all():
        return True
    lengths = np.linalg.norm(axes / scale[:, None], axis=0)
    return bool(lengths.min() < 1e-6 * lengths.max())


def _shear(propagate: NISP, alpha: Tensor, pair: tuple[int, int]) -> tuple[float, float]:
    """Slope of the second parameter on the first, and the mean of the first."""
    center, covariance = _moments(propagate, alpha[None], pair)
    slope = covariance[0, 1] / covariance[0, 0] if covariance[0, 0] > 0 else 0.0
    return float(slope), float(center[0])


def _level(x: np.ndarray, y: np.ndarray, shear: tuple[float, float] | None) -> tuple[np.ndarray, np.ndarray]:
    """Take the slope off; areas, and with them densities, stay as they are."""
    return (x, y) if shear is None else (x, y - shear[0] * (x - shear[1]))


def _ellipse(center: np.ndarray, axes: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    points = ellipse(center, axes, level)
    return points[:, 0], points[:, 1]


def _set_limits(ax: "Axes", outline: np.ndarray) -> None:
    """Show the outermost contours, not the empty rest of their grids."""
    low, high = outline.min(0), outline.max(0)
    margin = np.where(high > low, 0.06 * (high - low), 1e-3 * np.maximum(np.abs(low), 1e-6))
    ax.set_xlim(low[0] - margin[0], high[0] + margin[0])
    ax.set_ylim(low[1] - margin[1], high[1] + margin[1])


def _inside(x: np.ndarray, y: np.ndarray, z: np.ndarray, height: float) -> np.ndarray:
    """The grid points of a contour's inside, ``(M, 2)``."""
    return np.stack([x[z >= height], y[z >= height]], -1)


def _draw_one(
    ax: "Axes",
    propagate: NISP,
    alpha: Tensor,
    pair: tuple[int, int],
    levels: Sequence[float],
    num: int,
    seed: int,
    shear: tuple[float, float] | None,
) -> np.ndarray:
    """Draw the density under one α; return points that span it, ``(M, 2)``."""
    center, covariance = _moments(propagate, alpha[None], pair)
    middle = _level(center[:1], center[1:], shear)
    ax.plot(*middle, marker="+", ms=7, mew=1.2, ls="none", color=style.MAP, zorder=6, label="_MAP mean")
    axes = principal_axes(covariance)
    look: dict[str, Any] = {"color": style.MAP, "ls": (0, (4, 2)), "lw": 1.2}
    if _is_normal(propagate, pair) or _flat(axes, covariance):
        for i, level in enumerate(levels):
            outline = _level(*_ellipse(center, axes, level), shear)
            ax.plot(*outline, **look, zorder=5, label="MAP predictive" if i == 0 else "_MAP predictive")
        return np.stack(outline, -1)
    found = _density(propagate, alpha[None], pair, num, seed)
    if found is None:
        return np.stack(middle, -1)
    x, y = _level(found[0], found[1], shear)
    heights = contour_heights(found[2], levels)
    ax.contour(x, y, found[2], heights, colors=look["color"], linestyles=[look["ls"]], linewidths=look["lw"], zorder=5)
    ax.plot([], [], **look, label="MAP predictive")
    return _inside(x, y, found[2], heights[0])


def _draw_average(
    ax: "Axes",
    propagate: NISP,
    alpha: Tensor,
    pair: tuple[int, int],
    levels: Sequence[float],
    grid: int,
    num: int,
    seed: int,
    shear: tuple[float, float] | None,
) -> np.ndarray:
    """Draw the density averaged over α; return points that span it, ``(M, 2)``."""
    center, covariance = _moments(propagate, alpha, pair)
    axes = principal_axes(covariance)
    look: dict[str, Any] = {"color": style.POSTERIOR, "lw": 1.0, "label": "posterior predictive"}
    flat = _flat(axes, covariance)
    found = None
    if not flat and _is_normal(propagate, pair) and len(propagate.free) == 2:
        reach = np.linspace(-5, 5, grid)
        x, y = oblique_grid(center, axes, reach, reach)
        points = np.stack([x.ravel(), y.ravel()], -1)[:, np.argsort(pair)]
        density = prediction.parameter_density(propagate, alpha, torch.from_numpy(points), seed=seed)
        z = density.numpy().reshape(x.shape)
        # Under 1 % wider: hides the specks of single draws that are narrower than a cell.
        found = x, y, smooth(smooth(z, 1.5, 0), 1.5, 1)
    elif not flat:
        found = _density(propagate, alpha, pair, num, seed)
    heights = [] if found is None else contour_heights(found[2], levels)
    if found is None or not heights:
        outline = _level(*_ellipse(center, axes, levels[-1]), shear)
        ax.plot(*outline, **look, zorder=4)
        return np.stack(outline, -1)
    x, y = _level(found[0], found[1], shear)
    z = found[2]
    shades = [style.POSTERIOR_BAND, "#a9caea", style.MODEL_ERROR_BAND]
    fill = [shades[min(i, 2)] for i in range(len(heights))]
    ax.contourf(x, y, z, [*heights, 1.01 * max(float(z.max()), heights[-1])], colors=fill, zorder=2)
    ax.contour(x, y, z, heights, colors=look["color"], linewidths=look["lw"], zorder=4)
    ax.plot([], [], **look)
    return _inside(x, y, z, heights[0])
