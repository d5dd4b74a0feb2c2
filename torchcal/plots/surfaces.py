"""A prediction over two conditions."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchcal.data import Recording
from torchcal.errors import DomainError, ShapeError
from torchcal.plots import style
from torchcal.plots.selection import conditions_of, output_part

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]

__all__ = ["surface"]


def surface(
    x1: Tensor,
    x2: Tensor,
    mean: Tensor,
    data: Recording | Sequence[Tensor] | None = None,
    *,
    ax: "Axes3D | None" = None,
    names: Sequence[str] | None = None,
    output: str | None = None,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes3D":
    """The predicted mean over two conditions, and the data.

    Args:
        x1: First condition, ``(n1,)`` with a mean ``(n1, n2)``, or ``(n,)``.
        x2: Second condition, ``(n2,)``, or ``(n,)``.
        mean: Predicted mean, ``(n1, n2)`` on the grid, or ``(n,)`` point by point.
        data: A recording at two conditions, or three arrays ``(k,)``: x1, x2, y.
        ax: 3-D axes; a new figure by default.
        names: Of x1, x2 and the output; the recording's by default. They say which of its conditions is x1.
        output: The recording's output, where it has several.
        units: Units by name, beside the recording's.
        labels: How to write names on the axes, by name.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        ShapeError: If sizes disagree.
        DomainError: If a name does not exist, or the axes are not 3-D.

    Source: Sargsyan, Najm & Ghanem (2015), Fig. 15.
    """
    first, second = style.array(x1, "x1", 1), style.array(x2, "x2", 1)
    height = style.array(mean, "mean", (1, 2))
    if height.ndim == 2 and height.shape != (len(first), len(second)):
        raise ShapeError(f"Expected mean of shape ({len(first)}, {len(second)}). Got {height.shape}.")
    if height.ndim == 1 and not len(first) == len(second) == len(height):
        raise ShapeError(
            f"Expected x1, x2 and mean of one length. Got {len(first)}, {len(second)}, {len(height)} "
            "(a grid needs a mean of shape (n1, n2))."
        )
    shown, points, known = _data(data, names, output)
    units = {**known, **(units or {})}
    grid = (*np.meshgrid(first, second, indexing="ij"), height) if height.ndim == 2 else _grid(first, second, height)
    from matplotlib.ticker import MaxNLocator

    ax = style.new_axes(ax, (5.6, 4.6), three_d=True)
    if grid is None:
        if len(np.unique(first)) < 2 or len(np.unique(second)) < 2:
            raise ShapeError("Expected x1 and x2 to vary: a surface needs 2 values of each. Got one.")
        ax.plot_trisurf(
            first,
            second,
            height,
            color=style.MODEL_ERROR_BAND,
            alpha=0.55,
            edgecolor=style.POSTERIOR,
            lw=0.4,
            zorder=1,
        )
    else:
        if min(grid[2].shape) < 2:
            raise ShapeError(f"Expected at least 2 values of x1 and of x2. Got a grid {grid[2].shape}.")
        ax.plot_surface(
            *grid,
            color=style.MODEL_ERROR_BAND,
            alpha=0.55,
            edgecolor=style.POSTERIOR,
            lw=0.4,
            rcount=40,
            ccount=40,
            shade=False,
            zorder=1,
        )
    if points is not None:
        for a, b, below, above in _stems(first, second, height, points):
            ax.plot([a, a], [b, b], [below, above], color=style.DATA, lw=0.6, label="_error", zorder=4)
        ax.plot(*points, "o", ms=3.5, mfc="white", mec=style.DATA, mew=0.9, label="data", zorder=5)
    ax.plot([], [], [], color=style.POSTERIOR, lw=4, alpha=0.55, label="predicted mean")
    ax.set_xlabel(style.label(shown[0], units, labels))
    ax.set_ylabel(style.label(shown[1], units, labels))
    ax.set_zlabel(style.label(shown[2], units, labels))
    ax.tick_params(labelsize="small", pad=1)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axis.pane.set_visible(False)
        axis._axinfo["grid"].update(linewidth=0.3, color="0.8")
    style.scale_in_label(ax.xaxis, ax.yaxis, ax.zaxis)
    ax.view_init(elev=22, azim=-55)
    ax.set_box_aspect(None, zoom=0.9)
    if legend:
        style.legend(ax)
    return ax


def _data(
    data: Any, names: Sequence[str] | None, output: str | None
) -> tuple[tuple[str, ...], tuple[np.ndarray, ...] | None, dict[str, str]]:
    """Names, the points, and units."""
    if names is not None and (isinstance(names, str) or len(names) not in (2, 3)):
        raise DomainError(f"Expected names of x1, x2 and the output. Got {names!r}.")
    given = tuple(names or ())
    if not isinstance(data, Recording):
        shown = (*given, "y") if len(given) == 2 else (given or ("x1", "x2", "y"))
        if data is None:
            return shown, None, {}
        if len(data) != 3:
            raise ShapeError(f"Expected data: a recording, or three arrays x1, x2, y. Got {len(data)} arrays.")
        points = tuple(style.array(values, f"data {name}", 1) for name, values in zip(shown, data, strict=True))
        if len({len(values) for values in points}) != 1:
            raise ShapeError(f"Expected data of one length. Got {[len(values) for values in points]}.")
        return shown, points, {}
    columns = conditions_of(data.x, data)
    pair = given[:2] or tuple(columns)
    if len(pair) != 2 or any(name not in columns for name in pair):
        raise DomainError(
            f"Expected names: two of the recording's conditions {list(columns)}. Got {list(pair)} (names=)."
        )
    number, name = output_part(len(data.y), data.n, data, output)
    keep = data.observed.cpu().numpy()[number * data.n : (number + 1) * data.n]
    y = data.y.cpu().numpy()[number * data.n : (number + 1) * data.n]
    shown = (pair[0], pair[1], given[2] if len(given) == 3 else name)
    units = dict(data.units)
    if name in units:
        units[shown[2]] = units[name]
    return shown, (columns[pair[0]][keep], columns[pair[1]][keep], y[keep]), units


def _stems(
    first: np.ndarray, second: np.ndarray, height: np.ndarray, points: tuple[np.ndarray, ...]
) -> list[tuple[float, float, float, float]]:
    """Lines from the surface to the data, where both have the same conditions: x1, x2, mean, datum."""
    a, b = (first, second) if height.ndim == 1 else (g.ravel() for g in np.meshgrid(first, second, indexing="ij"))
    found = {(f"{u:.9g}", f"{v:.9g}"): float(z) for u, v, z in zip(a, b, height.ravel(), strict=True)}
    keys = [(f"{u:.9g}", f"{v:.9g}") for u, v in zip(*points[:2], strict=True)]
    return [
        (float(u), float(v), found[key], float(y)) for key, u, v, y in zip(keys, *points, strict=True) if key in found
    ]


def _grid(
    first: np.ndarray, second: np.ndarray, height: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Points that fill a grid, as that grid."""
    a, b = np.unique(first), np.unique(second)
    order = np.lexsort((second, first))
    if len(a) * len(b) != len(height) or not (
        np.array_equal(first[order], np.repeat(a, len(b))) and np.array_equal(second[order], np.tile(b, len(a)))
    ):
        return None
    return (*np.meshgrid(a, b, indexing="ij"), height[order].reshape(len(a), len(b)))
