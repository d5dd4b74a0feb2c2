"""The corner plot: all marginals and all pairs."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchcal.errors import ShapeError
from torchcal.plots import style
from torchcal.plots.densities import check_levels, contour_heights, curve, pair_density, side_of_zero

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

__all__ = ["corner"]


def corner(
    draws: Tensor,
    names: Sequence[str],
    *,
    map_point: Tensor | None = None,
    axes: Any = None,
    levels: Sequence[float] = (0.5, 0.9),
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
) -> np.ndarray:
    """Marginals on the diagonal, contours of the pairs below it, the MAP marked.

    Pairs are estimated along their principal axes, so that strongly correlated ones are resolved. Densities are
    reflected at 0 where all draws of a quantity lie on one side of it and crowd there, and its axis ends. Where the
    values of a quantity differ only far behind the decimal point, its ticks count from a number that stands in
    the label.

    Args:
        draws: ``(S, P)``, all chains in one.
        names: Of the P columns.
        map_point: The MAP, ``(P,)``, or None.
        axes: A P × P array of axes to draw on; a new figure by default.
        levels: Probabilities that the contours enclose.
        units: Units by name; α in scaled coordinates have none.
        labels: How to write names on the axes, by name.

    Returns:
        P × P array of axes; those above the diagonal are switched off.

    Raises:
        ShapeError: If draws, names, MAP and axes do not fit.
        DomainError: If a number is not finite, or a level not between 0 and 1.

    Source: Sargsyan, Najm & Ghanem (2015), Figs. 13, 19.
    """
    values = style.array(draws, "draws", 2)
    size = values.shape[1]
    if isinstance(names, str) or len(names) != size:
        raise ShapeError(f"Expected {size} names, one for each column of draws. Got {names!r}.")
    if len(values) < 3:
        raise ShapeError(f"Expected at least 3 draws for a density. Got {len(values)}.")
    levels = check_levels(levels)
    point = None if map_point is None else style.array(map_point, "map_point", 1)
    if point is not None and len(point) != size:
        raise ShapeError(f"Expected map_point of shape ({size},). Got ({len(point)},).")
    axes = _axes(axes, size)
    sides = [side_of_zero(values[:, i] if point is None else np.append(values[:, i], point[i])) for i in range(size)]
    limits = [_limits(values[:, i], None if point is None else float(point[i]), sides[i]) for i in range(size)]
    for i in range(size):
        for j in range(size):
            ax = axes[i, j]
            if j > i:
                ax.set_axis_off()
                continue
            if i == j:
                _draw_marginal(ax, values[:, i], None if point is None else float(point[i]), sides[i])
            else:
                marked = None if point is None else point[[j, i]]
                _draw_pair(ax, values[:, [j, i]], marked, levels, (sides[j], sides[i]))
                ax.set_ylim(limits[i])
            ax.set_xlim(limits[j])
            style.dress(ax)
            _ticks(ax.xaxis, limits[j], names[j], i == size - 1, True, units, labels)
            if i == j:
                ax.set_yticks([])
                ax.spines["left"].set_visible(False)
            else:
                _ticks(ax.yaxis, limits[i], names[i], j == 0, False, units, labels)
    if size == 1:
        axes[0, 0].set_ylabel(style.per_unit("probability density", (units or {}).get(names[0])))
    axes[0, 0].figure.align_labels(axes.ravel())
    _legend(axes, levels, point is not None)
    return axes


def _axes(axes: Any, size: int) -> np.ndarray:
    if axes is None:
        import matplotlib.pyplot as plt

        # Panels shrink as they become more, down to what two tick labels need.
        panel = max(1.05, min(1.9, 9.0 / size))
        side = max(panel * size, 3.0)
        return plt.subplots(size, size, figsize=(side, side), squeeze=False, layout="constrained")[1]
    array = np.asarray(axes, dtype=object)
    array = array.reshape(1, 1) if array.size == 1 else array
    if array.shape != (size, size):
        raise ShapeError(f"Expected axes: a {size} × {size} array of axes. Got shape {array.shape}.")
    for ax in array.flat:
        style.new_axes(ax)
    return array


def _limits(values: np.ndarray, point: float | None, side: int) -> tuple[float, float]:
    low, high = (float(value) for value in np.quantile(values, [0.001, 0.999]))
    if point is not None:
        low, high = min(low, point), max(high, point)
    span = high - low
    if not span > 1e-12 * max(abs(low), abs(high)):
        span = max(abs(low), 1e-6) * 1e-3
    low, high = low - 0.08 * span, high + 0.08 * span
    return max(low, 0.0) if side > 0 else low, min(high, 0.0) if side < 0 else high


def _draw_marginal(ax: "Axes", values: np.ndarray, point: float | None, side: int) -> None:
    found = curve(values, num=200, max_draws=5000, side=side)
    if found is None:
        ax.axvline(float(values.mean()), color=style.POSTERIOR, lw=1.2)
    else:
        ax.fill_between(*found, color=style.POSTERIOR_BAND, lw=0)
        ax.plot(*found, color=style.POSTERIOR, lw=1.2)
    ax.set_ylim(bottom=0)
    if point is not None:
        ax.axvline(point, color=style.MAP, lw=1.2, ls=(0, (4, 2)))


def _draw_pair(
    ax: "Axes", values: np.ndarray, point: np.ndarray | None, levels: Sequence[float], sides: tuple[int, int]
) -> None:
    found = pair_density(values, bins=72, sides=sides)
    heights = []
    if found is not None:
        inside = (found[0] * sides[0] >= 0) & (found[1] * sides[1] >= 0)  # the limits cut off what is beyond
        heights = contour_heights(found[2][inside], levels)
    if found is None or not heights:
        ax.plot(*values.T, ".", ms=1.5, color=style.POSTERIOR, rasterized=True)
    else:
        shades = [style.POSTERIOR_BAND, style.MODEL_ERROR_BAND]
        fill = [shades[min(i, 1)] for i in range(len(heights))]
        top = 1.01 * max(float(found[2].max()), heights[-1])
        ax.contourf(*found, [*heights, top], colors=fill)
        ax.contour(*found, heights, colors=style.POSTERIOR, linewidths=0.8)
    if point is not None:
        ax.plot(*point, marker="+", ms=6, mew=1.4, color=style.MAP, zorder=5)


def _ticks(
    axis: "Axis",
    limits: tuple[float, float],
    name: str,
    outer: bool,
    horizontal: bool,
    units: Mapping[str, str] | None,
    labels: Mapping[str, str] | None,
) -> None:
    """Two or three ticks; figures and the name only along the outer edge."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator

    ticks = MaxNLocator(nbins=3, steps=[1, 2, 5, 10]).tick_values(*limits)
    ticks = [float(tick) for tick in ticks if limits[0] <= tick <= limits[1]]
    step = (ticks[1] - ticks[0]) if len(ticks) > 1 else limits[1] - limits[0]
    axis.set_major_locator(FixedLocator(ticks))
    if not outer:
        axis.set_tick_params(labelleft=False, labelbottom=False)
        return
    size = max(abs(limits[0]), abs(limits[1]))
    start = 0.0
    if step < 2e-4 * size:  # many common digits: count from a round number
        start = _roundest(*limits)
    reach = max(abs(limits[0] - start), abs(limits[1] - start))
    power = math.floor(math.log10(reach))
    if -4 <= power < 5 and step >= 1e-4:
        power = 0
    factor = 10.0**-power
    times = rf"$10^{{{power}}}$ " if power else ""
    digits = max(0, -math.floor(math.log10(step * factor) + 1e-9))
    axis.set_major_formatter(
        FuncFormatter(lambda tick, _: f"{(tick - start) * factor + 0.0:.{digits}f}".replace("-", "−"))
    )
    shown = (labels or {}).get(name, style.pretty(name))
    if start:
        shown += f" {'−' if start > 0 else '+'} {abs(start):.10g}"
    unit = (units or {}).get(name, "")
    bracket = f"{times}{unit}".strip()
    axis.set_label_text(f"{shown} [{bracket}]" if bracket else shown, fontsize="small")
    axis.set_tick_params(labelsize="x-small", labelrotation=45 if horizontal else 0)


def _roundest(low: float, high: float) -> float:
    """The number between two that has the fewest digits.

    >>> _roundest(0.82999961, 0.83000032)
    0.83
    """
    power = math.floor(math.log10(max(abs(low), abs(high))))
    while math.floor(high / 10.0**power) * 10.0**power < low:
        power -= 1
    return round(math.floor(high / 10.0**power) * 10.0**power, max(0, -power))


def _legend(axes: np.ndarray, levels: Sequence[float], marked: bool) -> None:
    from matplotlib.lines import Line2D

    size = len(axes)
    if size == 1:
        return
    shares = ", ".join(f"{100 * level:g}" for level in levels)
    handles = [Line2D([], [], color=style.POSTERIOR, lw=1.2, label="posterior")]
    if marked:
        handles.append(Line2D([], [], color=style.MAP, lw=1.2, ls=(0, (4, 2)), marker="+", mew=1.4, label="MAP"))
    # The empty corner above the diagonal; it takes no part in the layout of the panels.
    box = axes[0, size - 1].legend(
        handles=handles,
        title=f"contours hold {shares} %",
        loc="upper right",
        fontsize="small",
        title_fontsize="small",
        frameon=False,
    )
    box.set_in_layout(False)
