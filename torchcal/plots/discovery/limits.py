"""The smallest effects that a recording could have shown."""

import math
import re
import textwrap
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcal.errors import DomainError
from torchcal.plots import style
from torchcal.plots.discovery.pieces import (
    ACCEPTED,
    LINESPACING,
    NOISE,
    beside,
    draw_key,
    finite,
    listed,
    plain,
    told_apart,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Letters of a name up to which it stands on one line; longer ones have two.
NAME = 28
#: Inches of a letter, and of what stands beside the names and the notes: the axes, and some air.
LETTER, AXES = 0.07, 1.7
#: Inches of a line of a note, and of the legend.
LINE, KEY = 0.15, 0.5
#: Letters on a line of a note: as many as there is room for, within these.
LEAST, MOST = 20, 60


def detection_limits(limits: Iterable[Any], *, most: int = 16, ax: "Axes | None" = None, legend: bool = True) -> "Axes":
    """The smallest effect of each candidate that these data could have shown, and the estimate over it.

    Args:
        limits: Each with ``term``, ``parameter``, ``smallest``, ``unit`` and ``estimate`` (or None). An estimate of
            another shape than the limit, where ``comparable`` is not true, is not drawn.
        most: Largest number of rows: those with the largest estimates, then the others.
        ax: Where to draw; a new figure by default.
        legend: Whether to draw one.

    Returns:
        The axes, with \\|estimate\\| / smallest on a logarithmic abscissa.

    Raises:
        DomainError: If there is no candidate, or one without these attributes.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    rows = listed("limits", limits, ("term", "parameter", "smallest", "unit", "estimate"), ".detection_limit")
    if not rows:
        raise DomainError("Expected at least one candidate. Got none.")

    def ratio(item: Any) -> float:
        if item.estimate is None or not getattr(item, "comparable", True):
            return math.nan
        if not math.isfinite(item.estimate) or not 0 < item.smallest < math.inf:
            return math.nan
        return abs(item.estimate) / float(item.smallest)

    rows.sort(key=lambda item: (-finite(ratio(item), -1.0), not math.isfinite(item.smallest)))
    left_out, rows = len(rows) - most, rows[:most]
    ax = style.new_axes(None, (6.4, 1.2 + 0.3 * len(rows))) if ax is None else style.new_axes(ax)
    ratios = np.array([ratio(item) for item in rows])
    shown = ratios[np.isfinite(ratios) & (ratios > 0)]
    low = max(min(0.3, 0.7 * shown.min(initial=1.0)), 0.01)
    high = max(3.0, 1.6 * shown.max(initial=1.0))
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if high < 100 * low else (1.0,)))
    ax.xaxis.set_major_formatter(lambda value, _: style.number(value))
    ax.xaxis.set_minor_formatter(NullFormatter())  # their labels would overlap
    ax.set_xlim(low, high)
    ax.axvspan(low, 1.0, facecolor=NOISE, lw=0, zorder=0, label="too small to be seen in these data")
    ax.axvline(1.0, color="0.25", lw=1.0, zorder=2)
    terms = [item.term for item in rows]
    names = told_apart(
        [item.term if terms.count(item.term) == 1 else f"{item.term}.{item.parameter}" for item in rows], 2 * NAME
    )
    names = [_in_two(name) for name in names]
    longest = max(len(line) for name in names for line in name.split("\n"))
    room = ax.get_window_extent().width / ax.figure.dpi / ax.get_position().width - AXES - LETTER * longest
    across = int(min(max(room / LETTER, LEAST), MOST))
    down = max(2, int((ax.get_window_extent().height / ax.figure.dpi - KEY) / len(rows) / LINE))
    for i, (item, value) in enumerate(zip(rows, ratios, strict=True)):
        if math.isfinite(value):
            place = min(max(value, low), high)
            ax.plot([1.0, place], [i, i], color="0.6", lw=1.0, zorder=3)
            seen = value >= 1
            ax.plot(
                [place], [i], "o" if value > low else "<", ms=5.5, mfc=ACCEPTED if seen else "white", mec=ACCEPTED,
                mew=1.1, zorder=4,
            )  # fmt: skip
        unit = f" {item.unit}" if item.unit not in (None, "", "1") else ""
        smallest = f"{style.number(float(f'{item.smallest:.2g}'))}{unit}" if math.isfinite(item.smallest) else ""
        note = str(getattr(item, "note", "") or "")
        text = ", ".join(part for part in (smallest, note) if part)
        lines = textwrap.wrap(_held(text) or "∞", across, max_lines=down, placeholder=" …")
        beside(ax, i, 6, "\n".join(plain(line, MOST) for line in lines), "left")
    beside(ax, None, 6, "smallest", "left")
    ax.plot([], [], "o", ms=5.5, mfc=ACCEPTED, mec=ACCEPTED, label="estimate, where fitted")
    ax.set_yticks(range(len(rows)), names, linespacing=LINESPACING)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    more = f"\n({left_out} more not shown)" if left_out > 0 else ""
    ax.set_xlabel("|estimate| / smallest detectable effect [1]" + more)
    style.dress(ax)
    ax.tick_params(axis="y", length=0)
    if legend:
        draw_key(ax, right=True)
    return ax


def _in_two(name: str) -> str:
    """A name on one line, or on two as even as its words allow."""
    if len(name) <= NAME:
        return name
    tries = (textwrap.fill(name, width) for width in range(NAME // 2, len(name) + 1))
    return next(text for text in tries if text.count("\n") < 2)


def _held(text: str) -> str:
    """A note whose units and equations are not broken between lines."""
    for pattern in (r"\([^()]*\)", r"[^ ]+ = [^ ]+( [^ ]+)?"):
        text = re.sub(pattern, lambda found: found[0].replace(" ", "\xa0"), text)
    return text
