"""What is missing, without a formula: the shift a parameter would need, and a smooth missing rate."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcal.plots import style
from torchcal.plots.discovery.pieces import ACCEPTED, Look, as_numbers, draw_key, finish, finite, is_log, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def needed_shift(
    needed: Any,
    *,
    ax: "Axes | None" = None,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
) -> "Axes":
    """The shift of a parameter that each stretch of data would need, ±1 sd, against its driver.

    Args:
        needed: With ``parameter``, ``unit``, ``driver``, ``values``, ``shift`` and ``sd`` ``(m,)`` and
            ``correlation``.
        ax: Where to draw; a new figure by default.
        units: Units by name.
        labels: How to write names on the axes, by name.

    Returns:
        The axes. Stretches that say nearly nothing are drawn, but do not set the ordinate's range.

    Raises:
        ShapeError: If values, shift and sd are not of one length.
    """
    look = Look(units=units or {}, labels=labels or {})
    x = as_numbers(needed.values, "values")
    shift, sd = as_numbers(needed.shift, "shift", len(x)), as_numbers(needed.sd, "sd", len(x))
    ax = style.new_axes(ax)
    ax.axhline(0.0, color="0.35", lw=0.7, zorder=1)
    if is_log(x):
        ax.set_xscale("log")
    seen = np.isfinite(x) & np.isfinite(shift) & np.isfinite(sd)
    ax.errorbar(
        x[seen], shift[seen], sd[seen], fmt="o", ms=4, mfc=ACCEPTED, mec=ACCEPTED, ecolor="0.35", elinewidth=0.9,
        capsize=2, zorder=3,
    )  # fmt: skip
    if seen.any():
        sure = seen & (sd <= 4 * np.median(sd[seen]))
        low, high = np.min((shift - sd)[sure]), np.max((shift + sd)[sure])
        low, high = min(low, 0.0), max(high, 0.0)
        room = 0.08 * ((high - low) or 1.0)
        ax.set_ylim(low - room, high + room)
    unit = f" [{plain(needed.unit)}]" if needed.unit else ""
    name = look.shown(needed.parameter)
    finish(ax, look.axis(needed.driver), f"needed shift of {name}{unit}, ±1 sd", "")
    if math.isfinite(finite(needed.correlation, math.nan)):
        ax.set_title(f"rank correlation {needed.correlation:+.2f}".replace("-", "−"), fontsize="small", loc="right")
    return ax


def missing_rate(
    missing: Any,
    *,
    ax: "Axes | None" = None,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    """What is missing, as a smooth function of one driver, with a band of ±2 sd.

    Args:
        missing: With ``kind`` (``"equation"``, ``"output"`` or ``"parameter"``), ``target``, ``driver``,
            ``values``, ``rate`` and ``sd`` ``(m,)``, and ``unit``.
        ax: Where to draw; a new figure by default.
        units: Units by name.
        labels: How to write names on the axes, by name.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        ShapeError: If values, rate and sd are not of one length.
    """
    look = Look(units=units or {}, labels=labels or {})
    x = as_numbers(missing.values, "values")
    rate, sd = as_numbers(missing.rate, "rate", len(x)), as_numbers(missing.sd, "sd", len(x))
    ax = style.new_axes(ax)
    ax.axhline(0.0, color="0.35", lw=0.7, zorder=1)
    if is_log(x):
        ax.set_xscale("log")
    ax.fill_between(x, rate - 2 * sd, rate + 2 * sd, color=style.MODEL_ERROR_BAND, lw=0, label="±2 sd", zorder=2)
    ax.plot(x, rate, color=ACCEPTED, lw=1.5, label="estimate", zorder=3)
    target = look.shown(missing.target)
    what = f"missing rate of d{target}/dt" if missing.kind == "equation" else f"missing shift of {target}"
    finish(ax, look.axis(missing.driver), what + (f" [{plain(missing.unit)}]" if missing.unit else ""), "")
    if legend:
        draw_key(ax)
    return ax
