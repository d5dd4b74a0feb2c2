"""What is missing, without a formula: the shift a parameter would need, and a smooth missing rate."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcal.plots import style
from torchcal.plots.discovery.pieces import (
    ACCEPTED,
    Look,
    as_numbers,
    broken,
    draw_key,
    expect,
    finish,
    finite,
    is_log,
    plain,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Difference of the runs at the same time, as a share of the range, up to which one curve shows them all, as up to an
#: sd; and how many runs the legend names.
SAME, NAMED_RUNS = 0.02, 6
#: How many times as long as the longest of some before and after a step is that lies between two runs.
HOLE, BESIDE = 8.0, 3
#: Times the sd of the better known quarter of the stretches up to which one tells something, and sd of its own from
#: which on its shift does.
KNOWN, CLEAR = 4.0, 2.0


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
        DomainError: If an attribute is not there.
        ShapeError: If values, shift and sd are not of one length.
    """
    expect(
        "needed", needed, ("parameter", "unit", "driver", "values", "shift", "sd", "correlation"), "one of .shifts"
    )
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
        sure = seen & ((sd <= KNOWN * np.quantile(sd[seen], 0.25)) | (np.abs(shift) > CLEAR * sd))
        low, high = np.min((shift - sd)[sure]), np.max((shift + sd)[sure])
        low, high = min(low, 0.0), max(high, 0.0)
        room = 0.08 * ((high - low) or 1.0)
        ax.set_ylim(low - room, high + room)
    unit = f" [{plain(needed.unit)}]" if needed.unit else ""
    name = look.shown(needed.parameter)
    finish(ax, look.axis(needed.driver), f"needed shift of {name}{unit}, ±1 sd", _removes(needed))
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
    """What is missing, as a function of one driver, with a band of ±2 sd; a curve for every run where runs differ.

    Args:
        missing: With ``kind`` (``"equation"``, ``"output"`` or ``"parameter"``), ``target``, ``driver``,
            ``values``, ``rate`` and ``sd`` ``(m,)``, and ``unit``; ``time`` and ``along``, where it is drawn against
            time, run after run.
        ax: Where to draw; a new figure by default.
        units: Units by name.
        labels: How to write names on the axes, by name.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If an attribute is not there.
        ShapeError: If values, rate and sd are not of one length.
    """
    in_time = ("time", "along") if getattr(missing, "driver", None) == "t" else ()
    expect("missing", missing, ("kind", "target", "driver", "values", "rate", "sd", "unit", *in_time), ".missing")
    look = Look(units=units or {}, labels=labels or {})
    x = as_numbers(missing.values, "values")
    rate, sd = as_numbers(missing.rate, "rate", len(x)), as_numbers(missing.sd, "sd", len(x))
    ax = style.new_axes(ax)
    ax.axhline(0.0, color="0.35", lw=0.7, zorder=1)
    if is_log(x):
        ax.set_xscale("log")
    curves = _by_run(missing, x, rate, sd)
    for number, (at, height, wide) in enumerate(curves):
        alone = len(curves) == 1
        color, dashes = (ACCEPTED, "-") if alone else style.CYCLE[number % len(style.CYCLE)]
        name = "estimate" if alone else f"run {number}" if number < NAMED_RUNS else None
        if missing.driver == "t":
            at, height, wide = broken(at, _between_runs(at), height, wide)
        ax.fill_between(
            at, height - 2 * wide, height + 2 * wide, lw=0, zorder=2, color=style.MODEL_ERROR_BAND if alone else color,
            alpha=None if alone else 0.15, label="±2 sd" if number == 0 else None,
        )  # fmt: skip
        ax.plot(at, height, color=color, ls=dashes, lw=1.5, label=name, zorder=3)
    target = look.shown(missing.target)
    what = f"missing rate of d{target}/dt" if missing.kind == "equation" else f"missing shift of {target}"
    unit = f" [{plain(missing.unit)}]" if missing.unit else ""
    finish(ax, look.axis(missing.driver), what + unit, _removes(missing))
    if legend:
        draw_key(ax)
    return ax


def _removes(found: Any) -> str:
    """How much of the misfit it explains, which tells two estimates apart that are not of one place."""
    share = finite(getattr(found, "share", math.nan), math.nan)
    return f"removes {100 * share:.0f} % of the misfit" if math.isfinite(share) else ""


def _between_runs(times: np.ndarray) -> list[float]:
    """Middles of what lies between one run and a later one, by times in ascending order: steps that are far longer than
    those before and after."""
    steps = np.diff(times)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(steps, BESIDE), 2 * BESIDE + 1).copy()
    around[:, BESIDE] = 0.0
    there = np.flatnonzero(steps > HOLE * around.max(1, initial=0.0))
    return [float(0.5 * (times[k] + times[k + 1])) for k in there]


def _by_run(
    missing: Any, x: np.ndarray, rate: np.ndarray, sd: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Curves along time of runs that differ at the same time; otherwise their mean."""
    if missing.driver != "t":
        return [(x, rate, sd)]
    time, along = as_numbers(missing.time, "time", len(x)), as_numbers(missing.along, "along", len(x))
    ends = np.flatnonzero(np.diff(time) < 0) + 1
    pieces = list(zip(np.split(time, ends), np.split(along, ends), strict=True))
    first = pieces[0]
    apart = max((np.max(np.abs(a - np.interp(t, *first))[(t >= first[0][0]) & (t <= first[0][-1])], initial=0.0)
                 for t, a in pieces), default=0.0)  # fmt: skip
    if apart <= max(SAME * np.ptp(rate), float(np.median(sd))):
        at, which = np.unique(x, return_inverse=True)
        count = np.bincount(which)
        return [(at, np.bincount(which, rate) / count, np.bincount(which, sd) / count)]
    wide = np.empty_like(sd)
    wide[np.argsort(time, kind="stable")] = sd
    return [(t, a, w) for (t, a), w in zip(pieces, np.split(wide, ends), strict=True)]
