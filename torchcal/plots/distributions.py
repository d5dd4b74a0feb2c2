"""Marginal densities of one quantity, overlaid."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchcal.errors import DomainError
from torchcal.plots import style
from torchcal.plots.densities import curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["marginals"]


def marginals(
    groups: Sequence[tuple[str, Tensor]],
    name: str,
    *,
    ax: "Axes | None" = None,
    unit: str | None = None,
    log: bool = False,
    marks: Sequence[float | None] | None = None,
    legend: bool = True,
) -> "Axes":
    """Kernel density estimates of draws of one quantity from several posteriors.

    Draws that are all one value are a vertical line.

    Args:
        groups: Pairs of a label and draws ``(S,)``; or a dict of them.
        name: The quantity, as shown on the axis.
        ax: Where to draw; a new figure by default.
        unit: Its unit.
        log: Whether the ordinate is logarithmic, so that narrow and wide densities can be read together.
        marks: A value to mark for each group, its MAP say; None for none.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If there is no group, or not one mark for each.
        ShapeError: If draws are not of shape ``(S,)``.

    Source: Sargsyan, Najm & Ghanem (2015), Fig. 11.
    """
    pairs = list(groups.items()) if isinstance(groups, Mapping) else list(groups)
    if not pairs or any(not isinstance(pair, tuple | list) or len(pair) != 2 for pair in pairs):
        raise DomainError("Expected groups: pairs of a label and draws, at least one. Got " + _short(groups))
    if marks is not None and len(marks) != len(pairs):
        raise DomainError(f"Expected one mark for each of {len(pairs)} groups. Got {len(marks)}.")
    arrays = [(str(key), style.array(draws, f"draws of {key!r}", 1)) for key, draws in pairs]
    ax = style.new_axes(ax, (4.8, 3.4))
    peaks = []
    for i, (key, draws) in enumerate(arrays):
        color, dashes = style.CYCLE[i % len(style.CYCLE)]
        found = curve(draws, tails=log)
        if found is None:
            ax.axvline(float(draws.mean()), color=color, ls=dashes, lw=1.4, label=f"{key} (no spread)", zorder=3)
        else:
            peaks.append(float(found[1].max()))
            ax.plot(*found, color=color, ls=dashes, lw=1.4, label=key, zorder=3)
        mark = None if marks is None else marks[i]
        if mark is not None:
            ax.axvline(mark, color=color, ls=(0, (1, 2)), lw=1.0, label=f"_mark {key}", zorder=2)
    ax.set_xlabel(style.label(name, {name: unit} if unit else None))
    ax.set_ylabel(style.per_unit("probability density", unit))
    if log and peaks:
        ax.set_yscale("log")
        # Below 1 % of the lowest peak a kernel estimate is made of single draws.
        ax.set_ylim(0.01 * min(peaks), 2 * max(peaks))
    else:
        ax.set_ylim(bottom=0)
    style.dress(ax)
    if legend:
        style.legend(ax)
    return ax


def _short(value: Any) -> str:
    text = repr(value) if not isinstance(value, Tensor | np.ndarray) else type(value).__name__
    return text if len(text) < 60 else text[:57] + "..."
