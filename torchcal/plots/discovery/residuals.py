"""Where the mismatch sits: residuals against what they vary with."""

import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.display import percent
from torchcal.errors import DomainError
from torchcal.plots import style
from torchcal.plots.discovery.panels import curves_of, groups_of
from torchcal.plots.discovery.pieces import (
    EDGE,
    LOCATED,
    NOISE,
    Look,
    as_mask,
    as_numbers,
    broken,
    draw_key,
    finish,
    finite,
    holes,
    is_log,
    places_of,
    rms,
    thinned,
)
from torchcal.plots.selection import conditions_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Largest noise sd over the smallest, above which residuals are drawn in units of it.
UNEVEN = 5.0
#: Levels of another condition up to which the residuals of each have their own shade, and up to which all are named.
MOST_LEVELS, NAMED_LEVELS = 6, 4
#: Data up to which their dots hide each other so little that these need not be transparent.
OPAQUE = 200
#: Letters on a line of the legend: a longer one would widen the panel.
ENTRY = 60
#: Local means in one period of an oscillation: fewer would not show it.
PER_PERIOD = 6
#: Parts of the range of a driver over which residuals are averaged, and the fewest data of a mean.
PARTS, FEWEST = 25, 8


def driver_values(recording: Recording, driver: str, fitted: Any = None) -> Tensor | None:
    """Values of a driver at the recording's conditions.

    Args:
        recording: The data.
        driver: A condition, ``"t"`` for time, an input of the runs, or an output.
        fitted: Fitted outputs ``(n_total,)``, taken where the driver is an output; the data by default.

    Returns:
        Shape ``(n,)``, in the driver's unit; None where the recording does not hold it (a hidden state, say).
    """
    columns = recording.x if isinstance(recording.x, dict) else {"x": recording.x}
    name = "time" if driver == "t" and "t" not in columns else driver
    if name in columns:
        return columns[name]
    if driver in recording.outputs:
        return recording.split(recording.y if fitted is None else getattr(fitted, "prediction", fitted))[driver]
    runs = getattr(recording, "runs", None)
    if runs and all(driver in run.inputs for run in runs):
        return torch.cat([run.inputs[driver] for run in runs])
    return None


def residual_map(
    recording: Recording,
    before: Any,
    after: Any = None,
    *,
    driver: str | None = None,
    values: Any = None,
    spans: Iterable[tuple[float, float]] = (),
    change: str = "needed change",
    edges: Iterable[float] = (),
    period: float | None = None,
    share: float | None = None,
    noise: Any = None,
    set_aside: Any = None,
    output: str | None = None,
    ax: "Axes | None" = None,
    names: tuple[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    """Residuals, data minus model, of both models against what the mismatch varies with.

    With more than 40 data their means over neighbouring data are drawn as lines. Where another condition has few
    levels, or there are few runs, the base's residuals of each have their own shade, from dark to light: a mean over
    them hides signs that differ. Where the noise sd varies more than fivefold, residuals are divided by it: in the
    output's unit the smallest would all look like zero.

    Args:
        recording: The data.
        before: Fitted outputs of the base, ``(n_total,)``, or anything that has them as ``prediction``.
        after: The accepted model's, or None.
        driver: What is on the abscissa: see `driver_values`; the first condition (time) by default.
        values: The driver's values ``(n,)``, where the recording does not hold them.
        spans: Ranges of the driver in which a change is largest that would remove the misfit, shaded. What it does to
            the output may be largest elsewhere: later in time, or where no calibrated parameter takes it up.
        change: What is largest there, in words.
        edges: Values of the driver at which a constant change begins or ends, drawn as vertical lines.
        period: Of an oscillation, in the driver's unit: the means are then finer than it, or left out where the data
            are too few for that.
        share: Share of the misfit that a change along the driver explains.
        noise: Noise sd of the output, in its unit, a number or one for each condition ``(n,)``; or anything with a
            dict ``sd`` of them by output; where it is known, and by default, the recording's. Drawn as a band of ±2 sd.
        set_aside: Mask ``(n_total,)`` of data that were taken for outliers: crosses, which no mean counts.
        output: By default the output that the base fits worst.
        ax: Where to draw; a new figure by default.
        names: What to call the two models.
        units: Units by name, beside the recording's.
        labels: How to write names on the axes, by name.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If the output does not exist, or the recording does not hold the driver.
        ShapeError: If fits or driver and recording do not fit.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.patheffects import withStroke

    fits = curves_of(recording, before, after, names)
    look = Look(units={**recording.units, **(units or {})}, labels=labels or {})
    y = recording.y.cpu().numpy()
    mask = as_mask(set_aside, recording)
    if output is None:
        scaled = (y - fits[0].values) / recording.spread.cpu().numpy()
        scaled = scaled if mask is None else np.where(mask, np.nan, scaled)
        output = max(recording.outputs, key=lambda name: finite(rms(scaled[places_of(recording, name)]), -1.0))
    _known(output, "output", recording.outputs)
    columns = conditions_of(recording.x, recording)
    if driver is None:
        driver = "time" if "time" in columns else next(iter(columns))
    if values is None:
        values = driver_values(recording, driver, fits[-1].values if driver not in columns else None)
    if values is None:
        raise DomainError(
            f"Expected driver: a condition, input or output of the recording. Got {driver!r} (give its values=)."
        )
    x = as_numbers(values, "values", recording.n)
    part = places_of(recording, output)
    ax = style.new_axes(ax)
    takes = "" if share is None else f"({percent(share)} of the misfit)".replace(" ", "\xa0")  # is not broken
    located = textwrap.fill(f"{change} largest here {takes}", ENTRY).replace("\xa0", " ")
    seen = np.isfinite(y[part]) & np.isfinite(x)
    aside = np.zeros_like(seen) if mask is None else mask[part] & seen
    shown = seen & ~aside
    if is_log(x[seen]):
        ax.set_xscale("log")
    low, high = float(x[seen].min()), float(x[seen].max())
    inside = _widened([(start, end) for start, end in spans if end >= low and start <= high], np.unique(x[seen]))
    for i, (start, end) in enumerate(inside):
        ax.axvspan(
            max(start, low), min(end, high), facecolor=LOCATED, edgecolor=EDGE, ls=":", lw=0.8, zorder=0,
            label=located if i == 0 else "_located",
        )  # fmt: skip
    sd = _noise_of(noise, recording, output)
    for i, edge in enumerate(edge for edge in edges if low <= edge <= high):
        ax.axvline(edge, color=EDGE, lw=1.0, zorder=2, label="change begins or ends" if i == 0 else "_edge")
    unit_of = np.ones(recording.n)
    label = f"data − model, {look.axis(output)}"
    if sd is not None and shown.any() and 0 < UNEVEN * sd[shown].min() < sd[shown].max():
        unit_of, sd = np.where(sd > 0, sd, np.nan), np.ones(recording.n)
        label = f"(data − model) / noise sd, {look.shown(output)}"
    if sd is not None and shown.any():
        band: dict[str, Any] = {"facecolor": NOISE, "lw": 0, "zorder": 1, "label": "±2 noise sd", "alpha": 0.75}
        levels, which = np.unique(x[shown], return_inverse=True)
        if np.ptp(sd[shown]) <= 1e-6 * sd[shown].max() or len(levels) < 2:
            ax.axhspan(-2 * sd[shown].max(), 2 * sd[shown].max(), **band)
        else:
            size = np.sqrt(np.bincount(which, sd[shown] ** 2) / np.bincount(which))
            ax.fill_between(levels, -2 * size, 2 * size, **band)
    ax.axhline(0.0, color="0.35", lw=0.7, zorder=2)
    keep = np.flatnonzero(shown)
    keep = keep[np.argsort(x[keep], kind="stable")]
    many = len(keep) > 40
    bins = _bins(x, keep, period) if many else []
    along = "time" if driver == "t" else driver
    between = holes(_spans(recording)) if along == "time" else []
    bins = [part for rows in bins for part in np.split(rows, np.searchsorted(x[rows], between)) if len(part)]
    dots = keep[thinned(len(keep))]
    outline = [withStroke(linewidth=3.5, foreground="white")] if len(dots) > OPAQUE else []  # or it would hide dots
    groups = _levels({name: column[dots] for name, column in columns.items() if name != along}, dots, look)
    for i, fit in enumerate(fits):
        residual = (y[part] - fit.values[part]) / unit_of
        for rows, level, shade in groups if i == 0 else [(dots, "", 1.0)]:
            color = tuple(shade * part for part in to_rgb(fit.color))
            name = f"{fit.name}, {level}" if level else "_points" if bins or rows is not dots else fit.name
            ax.plot(
                x[rows], residual[rows], fit.marker, ms=3.0 if many else 4.5, mfc=color if many else fit.face,
                mec="none" if many else color, mew=0.9, alpha=(OPAQUE / max(len(dots), OPAQUE)) ** 0.5,
                zorder=fit.zorder - 3, label=name,
            )  # fmt: skip
        if bins:
            centers = np.array([np.median(x[rows]) for rows in bins])
            means = np.array([np.nanmean(residual[rows]) for rows in bins])
            ax.plot(
                *broken(centers, between, means), color=fit.color, ls=fit.line, lw=1.7,
                label=fit.name + ", local mean", zorder=fit.zorder, path_effects=outline,
            )  # fmt: skip
    if aside.any():
        residual = (y - fits[-1].values)[part] / unit_of
        ax.plot(x[aside], residual[aside], "x", ms=5, mew=1.1, color="0.25", zorder=5, label="set aside as outliers")
    finish(ax, look.axis(driver), label, "")
    if legend:
        draw_key(ax)
    return ax


def joint_map(
    recording: Recording,
    before: Any,
    conditions: tuple[str, str],
    *,
    output: str | None = None,
    noise: Any = None,
    set_aside: Any = None,
    ax: "Axes | None" = None,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
) -> "Axes":
    """Residuals of the base over two conditions: triangles that point up where the data are above it, down where below.

    Their height goes with the residual; those within ±2 noise sd are open.

    Args:
        recording: The data.
        before: Fitted outputs of the base, ``(n_total,)``, or anything that has them as ``prediction``.
        conditions: What is on the abscissa and on the ordinate.
        output: The first by default.
        noise: As of `residual_map`.
        set_aside: Mask ``(n_total,)`` of data that were taken for outliers: crosses.
        ax: Where to draw; a new figure by default.
        units: Units by name, beside the recording's.
        labels: How to write names on the axes, by name.

    Returns:
        The axes.

    Raises:
        DomainError: If the output or a condition does not exist.
        ShapeError: If the fit and the recording do not fit.
    """
    look = Look(units={**recording.units, **(units or {})}, labels=labels or {})
    columns = conditions_of(recording.x, recording)
    for name in conditions:
        _known(name, "conditions", columns)
    output = recording.outputs[0] if output is None else output
    _known(output, "output", recording.outputs)
    part, mask = places_of(recording, output), as_mask(set_aside, recording)
    off = (recording.y.cpu().numpy() - curves_of(recording, before, None, None)[0].values)[part]
    a, b = (columns[name] for name in conditions)
    aside = np.zeros(len(off), dtype=bool) if mask is None else mask[part]
    shown = np.isfinite(off) & np.isfinite(a) & np.isfinite(b) & ~aside
    ax = style.new_axes(ax)
    sd = _noise_of(noise, recording, output)
    small = np.zeros(len(off), dtype=bool) if sd is None else np.abs(off) <= 2 * sd
    largest = float(np.abs(off[shown]).max()) if shown.any() else 1.0
    area = 6.0 + 110.0 * (np.abs(off) / (largest or 1.0)) ** 2
    for above, marker, color, word in ((True, "^", style.MAP, "above"), (False, "v", style.POSTERIOR, "below")):
        for open_ in (False, True):
            rows = shown & ((off > 0) == above) & (small == open_)
            if rows.any():
                ax.scatter(
                    a[rows], b[rows], s=area[rows], marker=marker, linewidths=0.9, edgecolors=color,
                    facecolors="none" if open_ else color, zorder=3,
                    label=f"data {word} the base" + (", within 2 noise sd" if open_ else ""),
                )  # fmt: skip
    if (crossed := aside & np.isfinite(a) & np.isfinite(b)).any():
        ax.plot(a[crossed], b[crossed], "x", ms=5, mew=1.1, color="0.25", zorder=5, label="set aside as outliers")
    for values, scale in ((a, ax.set_xscale), (b, ax.set_yscale)):
        if is_log(values):
            scale("log")
    finish(ax, look.axis(conditions[0]), look.axis(conditions[1]), "")
    ax.margins(0.08)
    unit = look.unit(output)
    ax.set_title(f"largest residual {largest:.3g}{f' {unit}' if unit else ''}", fontsize="small", loc="right")
    draw_key(ax)
    return ax


def _known(name: str, what: str, names: Collection[str]) -> None:
    """Raises a `DomainError` where a name is none of those that there are."""
    if name not in names:
        raise DomainError(f"Expected {what} among {list(names)}. Got {name!r} (check the spelling).")


def _widened(spans: Sequence[tuple[float, float]], levels: np.ndarray) -> list[tuple[float, float]]:
    """Spans of a single level of the driver, which have no width, half way to the next levels."""
    steps = np.sqrt(levels[1:] * levels[:-1]) if is_log(levels) else (levels[1:] + levels[:-1]) / 2
    below = dict(zip(levels[1:], steps, strict=True))
    above = dict(zip(levels[:-1], steps, strict=True))
    return [(below.get(a, a), above.get(b, b)) if a == b else (a, b) for a, b in spans]


def _bins(x: np.ndarray, keep: np.ndarray, period: float | None) -> list[np.ndarray]:
    """Rows over which residuals are averaged, of those to keep in ascending order; none where that would hide a period.

    Each holds one level of the driver where it has few, else at least eight data in a part of its range, or two in one
    of a period.
    """
    levels = np.unique(x[keep])
    if len(levels) <= 30:
        return [keep[x[keep] == level] for level in levels]
    if period is None:
        return _in_parts(np.log(x[keep]) if is_log(levels) else x[keep], keep)
    part = np.floor((x[keep] - levels[0]) * PER_PERIOD / period)
    bins = [keep[part == number] for number in np.unique(part)]
    return bins if np.median([len(rows) for rows in bins]) >= 2 else []


def _spans(recording: Recording) -> list[tuple[float, float]]:
    """First and last time of every run."""
    return [(float(run.time[0]), float(run.time[-1])) for run in getattr(recording, "runs", None) or ()]


def _levels(others: Mapping[str, np.ndarray], rows: np.ndarray, look: Look) -> list[tuple[np.ndarray, str, float]]:
    """Rows of each level of the condition with the fewest, its name (empty for none) and its shade, dark to light."""
    each = [groups for name in others if 1 < len(groups := groups_of(others, [name], look)) <= MOST_LEVELS]
    if not each:
        return [(rows, "", 0.75)]
    few = min(each, key=len)
    last = len(few) - 1
    return [
        (rows[places], called if last < NAMED_LEVELS or i in (0, last) else "", 0.3 + 0.7 * i / last)
        for i, (places, called) in enumerate(few)
    ]


def _noise_of(noise: Any, recording: Recording, output: str) -> np.ndarray | None:
    """Noise sd of each datum of the output, ``(n,)``; None where it is unknown."""
    source = getattr(noise, "source", None)
    given = recording.noise_sd
    if (noise is None or source == "given") and given is not None:
        return given.cpu().numpy()[places_of(recording, output)] * getattr(noise, "enlarged", 1.0)
    if noise is None or source == "none":  # a detailed simulation: what it counts as noise is no one's
        return None
    sd = getattr(noise, "sd", noise)
    if isinstance(sd, Mapping):
        sd = sd.get(output)
    if sd is None:
        return None
    numbers = np.asarray(sd, dtype=np.float64)
    every = as_numbers(np.full(recording.n, numbers) if numbers.ndim == 0 else numbers, "noise", recording.n)
    return every if np.isfinite(every).all() and every.max() > 0 else None


def _in_parts(along: np.ndarray, keep: np.ndarray) -> list[np.ndarray]:
    """Rows by the parts of a range that some ascending values lie in, several parts where these hold few: bins of as
    many data each would be so narrow where data are dense that their means scatter."""
    part = np.minimum(PARTS * (along - along[0]) / np.ptp(along), PARTS - 1).astype(int)
    bins: list[np.ndarray] = []
    few = keep[:0]
    for number in np.unique(part):
        few = np.concatenate([few, keep[part == number]])
        if len(few) >= FEWEST:
            bins.append(few)
            few = keep[:0]
    if len(few):
        bins[-1:] = [np.concatenate([*bins[-1:], few])]
    equal = np.array_split(keep, min(PARTS, len(keep) // FEWEST))
    return bins if len(bins) > len(equal) / 5 else equal  # nearly all are in a small part of the range
