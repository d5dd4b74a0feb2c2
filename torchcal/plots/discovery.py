"""Figures of a diagnosis: both fits, where the mismatch sits, the ranking, and the proof.

Everything is taken as plain tensors or as any object with the attributes that are named, so that a figure can be
drawn again from stored numbers. The base is orange, dashed or open; the accepted model blue, solid or filled.
"""

import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.errors import DomainError, ShapeError
from torchcal.plots import style
from torchcal.plots.selection import conditions_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "both_fits",
    "detection_limits",
    "discovery_overview",
    "driver_values",
    "held_out",
    "held_out_scores",
    "missing_rate",
    "needed_shift",
    "ranking",
    "residual_map",
]

BASE, ACCEPTED = style.MAP, style.POSTERIOR
DASHES = (0, (4, 1.6))
HELD_OUT = "#e4e4e4"  # grey (91)
NOISE = "#d9d9d9"  # grey (87)
LOCATED, EDGE = style.ADDITIVE_BAND, style.ADDITIVE
NONE = ("none of these",)
DENSE = 80  # data in one panel above which each is a dot instead of a circle
MOST_POINTS = 2000  # drawn in one panel; more cannot be told apart


# --- both fits -------------------------------------------------------------------------------------------------


def both_fits(
    recording: Recording,
    before: Any,
    after: Any = None,
    *,
    held_out: Any = None,
    ax: Any = None,
    along: str | None = None,
    output: str | None = None,
    run: int | None = None,
    most: int = 6,
    names: tuple[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> Any:
    """The data with the base model and with the accepted one.

    A recording in time is drawn over time, one panel for each run and output. A static one is drawn against its
    condition; with several conditions against ``along``, one panel for each combination of the others that has at
    least three data, else fitted against measured.

    Args:
        recording: The data.
        before: Fitted outputs of the base, ``(n_total,)``, or anything that has them as ``prediction``.
        after: The accepted model's, or None.
        held_out: Mask ``(n_total,)`` of data that were held out: shaded where they lie together, ringed elsewhere.
        ax: Axes, or an array of them, one for each panel; a new figure by default.
        along: The condition on the abscissa.
        output: Draw this one alone.
        run: Draw this one alone.
        most: Largest number of panels: the worst fitted outputs, and runs or conditions evenly spaced.
        names: What to call the two models.
        units: Units by name, beside the recording's.
        labels: How to write names on the axes, by name.
        legend: Whether to draw one.

    Returns:
        The axes: one where there is one panel or ``ax`` is one, else an array of them ``(panels,)``.

    Raises:
        DomainError: If a name or run does not exist.
        ShapeError: If fits, mask and recording do not fit, or there are fewer axes than one.
    """
    fits = _fits(recording, before, after, names)
    mask = _mask(held_out, recording)
    look = _Look(units={**recording.units, **(units or {})}, labels=labels or {})
    panels = _panels(recording, fits[0].values, along, output, run, most, look)
    axes, made = _axes(ax, len(panels))
    for i, (place, panel) in enumerate(zip(axes, panels, strict=False)):
        _draw_panel(place, recording, panel, fits, mask, look)
        if legend and not made and i == 0:
            _key(place)
    if legend and made:
        _figure_key(axes[0].figure, axes)
    return axes[0] if len(axes) == 1 and not isinstance(ax, np.ndarray | list | tuple) else np.array(axes)


@dataclass(frozen=True)
class _Look:
    units: Mapping[str, str]
    labels: Mapping[str, str]

    def axis(self, name: str) -> str:
        """A quantity's name and unit."""
        unit = self.unit(name)
        return f"{self.shown(name)} [{unit}]" if unit else self.shown(name)

    def shown(self, name: str) -> str:
        """A quantity's name; "t" is time where a recording has one."""
        if name == "t" and name not in self.units and "time" in self.units:
            name = "time"
        return self.labels.get(name, _plain(name, 28))

    def unit(self, name: str) -> str | None:
        other = {"t": "time", "time": "t"}.get(name, name)
        unit = self.units.get(name) or self.units.get(other)
        return _plain(unit) if unit else None

    def value(self, name: str, value: float) -> str:
        unit = self.unit(name)
        return f"{self.shown(name)} = {style.number(value)}" + (f" {unit}" if unit else "")


@dataclass(frozen=True)
class _Curve:
    """One model's outputs, and how they are drawn."""

    values: np.ndarray
    name: str
    color: str
    line: Any
    marker: str
    face: str
    zorder: float


@dataclass(frozen=True)
class _Panel:
    """One output of some of the conditions.

    Attributes:
        output: Its name.
        places: Where the values stand among all outputs, in the order of ``x``, ``(m,)``.
        x: The abscissa, ``(m,)``; None for fitted against measured.
        along: Its name.
        joined: Whether the fits are lines.
        title: What is held, in words.
    """

    output: str
    places: np.ndarray
    x: np.ndarray | None
    along: str
    joined: bool
    title: str = ""


def _fits(recording: Recording, before: Any, after: Any, names: tuple[str, str] | None) -> list[_Curve]:
    given = [_numbers(before, "before", len(recording.y))]
    if after is not None:
        given.append(_numbers(after, "after", len(recording.y)))
    if names is None:
        terms = tuple(getattr(after, "terms", ()))
        names = ("base model", "with " + _terms(terms) if terms else "accepted model")
    looks = (
        _Curve(given[0], names[0], BASE, DASHES, "s", "none", 6),
        _Curve(given[-1], names[1], ACCEPTED, "-", "o", ACCEPTED, 5),
    )
    return list(looks[: len(given)])


def _panels(
    recording: Recording,
    fitted: np.ndarray,
    along: str | None,
    output: str | None,
    run: int | None,
    most: int,
    look: _Look,
) -> list[_Panel]:
    columns, n = conditions_of(recording.x, recording), recording.n
    if output is not None and output not in recording.outputs:
        raise DomainError(f"Expected output among {list(recording.outputs)}. Got {output!r} (check the spelling).")
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise DomainError(f"Expected most: a number of panels, at least 1. Got {most!r}.")
    in_time = set(columns) == {"time", "run"}
    if along == "t" and in_time:
        along = "time"
    if along is None and (in_time or len(columns) == 1):
        along = "time" if in_time else next(iter(columns))
    if along is not None and along not in columns:
        raise DomainError(f"Expected along: a condition among {list(columns)}. Got {along!r} (check the spelling).")
    if run is not None and (not in_time or run not in columns["run"]):
        known = np.unique(columns["run"]).astype(int).tolist() if in_time else "none (a static recording)"
        raise DomainError(f"Expected run among {known}. Got {run!r}.")

    residual = (recording.y.cpu().numpy() - fitted) / recording.spread.cpu().numpy()
    outputs = [output] if output is not None else list(recording.outputs)
    if len(outputs) > most:
        size = {name: _rms(residual[_part(recording, name)]) for name in outputs}
        worst = sorted(outputs, key=lambda name: -size[name])[:most]
        outputs = [name for name in outputs if name in worst]
    groups: list[tuple[np.ndarray, str]] = [(np.arange(n), "")]
    joined = True
    others = [name for name in columns if name != along]
    if along is not None and others:
        if run is None:
            groups = _groups(columns, others, look)
        else:
            groups = [(np.flatnonzero(columns["run"] == run), f"run {run}")]
        if len(groups) == 1 and in_time and run is None:
            groups = [(groups[0][0], "")]
        kept = [group for group in groups if len(np.unique(columns[along][group[0]])) >= 3]
        joined = in_time or len(kept) > len(groups) / 2
        groups = (kept or groups) if joined else [(np.arange(n), "")]
    quota = max(1, most // len(outputs))
    panels = []
    for name in outputs:
        start = recording.outputs.index(name) * n
        seen = recording.observed.cpu().numpy()[start : start + n]
        chosen = [group for group in groups if seen[group[0]].any()] or groups[:1]
        if len(chosen) > quota:
            chosen = [chosen[i] for i in np.unique(np.linspace(0, len(chosen) - 1, quota).round().astype(int))]
        for rows, title in chosen:
            if along is None:
                panels.append(_Panel(name, start + rows, None, "", False, title))
                continue
            order = rows[np.argsort(columns[along][rows], kind="stable")]
            panels.append(_Panel(name, start + order, columns[along][order], along, joined, title))
    return panels


def _groups(columns: Mapping[str, np.ndarray], others: Sequence[str], look: _Look) -> list[tuple[np.ndarray, str]]:
    """Rows that agree in the other conditions, up to rounding."""
    key = np.array([[float(f"{value:.9g}") for value in columns[name]] for name in others]).T
    values, which = np.unique(key, axis=0, return_inverse=True)
    which = which.reshape(-1)
    if list(others) == ["run"]:
        return [(np.flatnonzero(which == i), f"run {int(value[0])}") for i, value in enumerate(values)]
    return [
        (np.flatnonzero(which == i), ", ".join(look.value(k, v) for k, v in zip(others, value, strict=True)))
        for i, value in enumerate(values)
    ]


def _draw_panel(
    ax: "Axes", recording: Recording, panel: _Panel, fits: Sequence[_Curve], mask: np.ndarray | None, look: _Look
) -> None:
    y = recording.y.cpu().numpy()[panel.places]
    held = np.zeros(len(y), dtype=bool) if mask is None else mask[panel.places] & np.isfinite(y)
    seen = np.isfinite(y)
    if panel.x is None:
        _draw_parity(ax, y, held, [fit.values[panel.places] for fit in fits], fits, look.axis(panel.output), look)
        _finish(ax, f"measured {look.axis(panel.output)}", f"fitted {look.axis(panel.output)}", panel.title)
        return
    spans = _held_spans(panel.x[seen], held[seen])
    for i, (low, high) in enumerate(spans):
        ax.axvspan(low, high, color=HELD_OUT, lw=0, zorder=0, label="held out" if i == 0 else "_held out")
    keep = np.flatnonzero(seen)
    keep = keep[_thinned(len(keep))]
    noise = recording.noise_sd
    errors = None if noise is None or len(keep) > DENSE else noise.cpu().numpy()[panel.places][keep]
    if len(keep) > DENSE:
        ax.plot(panel.x[keep], y[keep], "o", ms=2.2, mfc="0.45", mec="none", label="data", zorder=2)
    else:
        ax.errorbar(
            panel.x[keep], y[keep], errors, fmt="o", ms=4, mfc="white", mec=style.DATA, mew=0.9, ecolor=style.DATA,
            elinewidth=0.8, label="data", zorder=4,
        )  # fmt: skip
    rest = held & ~np.any([(panel.x >= low) & (panel.x <= high) for low, high in spans], axis=0) if spans else held
    if rest.any():
        ax.plot(panel.x[rest], y[rest], "o", ms=8, mfc="none", mec="0.4", mew=0.8, label="held out", zorder=3)
    for fit in fits:
        values = fit.values[panel.places]
        if panel.joined:
            ax.plot(panel.x, values, color=fit.color, ls=fit.line, lw=1.5, label=fit.name, zorder=fit.zorder)
        else:
            ax.plot(
                panel.x[keep], values[keep], fit.marker, ms=4 if fit.face == "none" else 2.6, mfc=fit.face,
                mec=fit.color, mew=0.9, label=fit.name, zorder=fit.zorder,
            )  # fmt: skip
    _finish(ax, look.axis(panel.along), look.axis(panel.output), panel.title)


def _draw_parity(
    ax: "Axes",
    y: np.ndarray,
    held: np.ndarray,
    values: Sequence[np.ndarray],
    fits: Sequence[_Curve],
    name: str,
    look: _Look,
) -> None:
    every = np.concatenate([y, *values])
    low, high = np.nanmin(every), np.nanmax(every)
    ax.plot([low, high], [low, high], color="0.6", lw=0.9, label="equal", zorder=1)
    keep = np.flatnonzero(np.isfinite(y))
    keep = keep[_thinned(len(keep))]
    for fit, value in zip(fits, values, strict=True):
        ax.plot(
            y[keep], value[keep], fit.marker, ms=4.5 if fit.face == "none" else 3.2, mfc=fit.face, mec=fit.color,
            mew=0.9, label=fit.name, zorder=fit.zorder,
        )  # fmt: skip
    if held.any() and not held[np.isfinite(y)].all():
        value = values[-1]
        ax.plot(y[held], value[held], "o", ms=8, mfc="none", mec="0.4", mew=0.8, label="held out", zorder=3)


def _held_spans(x: np.ndarray, held: np.ndarray) -> list[tuple[float, float]]:
    """Ranges of ascending x in which everything is held out, to the middle between neighbours.

    None where they are scattered: more than four, or of less than three values each.
    """
    values = np.unique(x)
    out = np.array([held[x == value].all() for value in values], dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], out, [False]]).astype(int)))
    spans = []
    for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
        low = values[first] if first == 0 else (values[first - 1] + values[first]) / 2
        high = values[last] if last == len(values) - 1 else (values[last] + values[last + 1]) / 2
        spans.append((float(low), float(high)))
    return spans if out.sum() >= 3 * len(spans) and len(spans) <= 4 else []


# --- where the mismatch sits -----------------------------------------------------------------------------------


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
    share: float | None = None,
    noise: Any = None,
    output: str | None = None,
    ax: "Axes | None" = None,
    names: tuple[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    """Residuals, data minus model, of both models against what the mismatch varies with.

    With more than 40 data their means over neighbouring data are drawn as lines.

    Args:
        recording: The data.
        before: Fitted outputs of the base, ``(n_total,)``, or anything that has them as ``prediction``.
        after: The accepted model's, or None.
        driver: What is on the abscissa: see `driver_values`; the first condition (time) by default.
        values: The driver's values ``(n,)``, where the recording does not hold them.
        spans: Ranges of the driver in which the mismatch sits, shaded.
        share: Share of the misfit that sits there.
        noise: Noise sd of the output, in its unit, or anything with a dict ``sd`` by output; by default the
            recording's. Drawn as a band of ±2 sd.
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
    fits = _fits(recording, before, after, names)
    look = _Look(units={**recording.units, **(units or {})}, labels=labels or {})
    y = recording.y.cpu().numpy()
    if output is None:
        scaled = (y - fits[0].values) / recording.spread.cpu().numpy()
        output = max(recording.outputs, key=lambda name: _rms(scaled[_part(recording, name)]))
    elif output not in recording.outputs:
        raise DomainError(f"Expected output among {list(recording.outputs)}. Got {output!r} (check the spelling).")
    columns = conditions_of(recording.x, recording)
    if driver is None:
        driver = "time" if "time" in columns else next(iter(columns))
    if values is None:
        values = driver_values(recording, driver, fits[-1].values if driver not in columns else None)
    if values is None:
        raise DomainError(
            f"Expected driver: a condition, input or output of the recording. Got {driver!r} (give its values=)."
        )
    x = _numbers(values, "values", recording.n)
    part = _part(recording, output)
    ax = style.new_axes(ax)
    located = f"mismatch located here ({100 * share:.0f} % of it)" if share is not None else "mismatch located here"
    shown = np.isfinite(y[part]) & np.isfinite(x)
    low, high = float(x[shown].min()), float(x[shown].max())
    inside = [(start, end) for start, end in spans if end >= low and start <= high]
    for i, (start, end) in enumerate(inside):
        ax.axvspan(
            max(start, low), min(end, high), facecolor=LOCATED, edgecolor=EDGE, ls=":", lw=0.8, zorder=0,
            label=located if i == 0 else "_located",
        )  # fmt: skip
    sd = _noise_of(noise, recording, output)
    if sd:
        ax.axhspan(-2 * sd, 2 * sd, facecolor=NOISE, lw=0, zorder=1, label="±2 noise sd", alpha=0.75)
    ax.axhline(0.0, color="0.35", lw=0.7, zorder=2)
    keep = np.flatnonzero(shown)
    keep = keep[np.argsort(x[keep], kind="stable")]
    many = len(keep) > 40
    dots = keep[_thinned(len(keep))]
    for fit in fits:
        residual = y[part] - fit.values[part]
        ax.plot(
            x[dots], residual[dots], fit.marker, ms=2.2 if many else 4.5, mfc=fit.face if not many else fit.color,
            mec="none" if many else fit.color, mew=0.9, alpha=0.3 if many else 1.0, zorder=fit.zorder - 3,
            label="_points" if many else fit.name,
        )  # fmt: skip
        if many:
            levels = np.unique(x[keep])
            if len(levels) <= 30:
                bins = [keep[x[keep] == level] for level in levels]
            else:
                bins = np.array_split(keep, min(30, len(keep) // 8))
            centers = [x[rows].mean() for rows in bins]
            means = [np.nanmean(residual[rows]) for rows in bins]
            ax.plot(
                centers, means, color=fit.color, ls=fit.line, lw=1.7, label=fit.name + ", local mean",
                zorder=fit.zorder,
            )  # fmt: skip
    _finish(ax, look.axis(driver), f"data − model, {look.axis(output)}", "")
    if legend:
        _key(ax)
    return ax


def _noise_of(noise: Any, recording: Recording, output: str) -> float | None:
    if noise is None:
        given = recording.noise_sd
        return None if given is None else float(given[_part(recording, output)].median())
    sd = getattr(noise, "sd", noise)
    if isinstance(sd, Mapping):
        sd = sd.get(output)
    return float(sd) if sd is not None and math.isfinite(float(sd)) else None


# --- ranking ---------------------------------------------------------------------------------------------------


def ranking(
    hypotheses: Iterable[Any],
    *,
    accepted: Sequence[str] = (),
    tied: Iterable[Sequence[str]] = (),
    value: str = "log_evidence",
    most: int = 12,
    ax: "Axes | None" = None,
    legend: bool = True,
) -> "Axes":
    """The hypotheses, best first, with their log evidence and probability.

    Args:
        hypotheses: Each with ``terms`` (empty for the base), ``log_evidence`` (natural logarithm, relative to the
            base), ``probability`` and ``physical``.
        accepted: Terms of the accepted hypothesis.
        tied: Each the terms of a hypothesis that the data cannot tell from the best.
        value: What the bars show: ``"log_evidence"`` or ``"probability"``.
        most: Largest number of bars; the base, "none of these" and the tied ones are among them.
        ax: Where to draw; a new figure by default.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If there is no hypothesis, or ``value`` is another one.
    """
    if value not in ("log_evidence", "probability"):
        raise DomainError(f"Expected value: 'log_evidence' or 'probability'. Got {value!r}.")
    rows = sorted(hypotheses, key=lambda item: -_finite(getattr(item, value), -math.inf))
    if not rows:
        raise DomainError("Expected at least one hypothesis. Got none.")
    chosen, sets = frozenset(accepted), {frozenset(terms) for terms in tied}
    kept = [h for h in rows if not h.terms or tuple(h.terms) == NONE or frozenset(h.terms) in {*sets, chosen}]
    kept += [h for h in rows if all(h is not other for other in kept)][: max(0, most - len(kept))]
    left_out = len(rows) - len(kept)
    rows = [h for h in rows if any(h is other for other in kept)]
    if ax is None:
        ax = style.new_axes(None, (6.4, 1.2 + 0.3 * len(rows)))
    else:
        ax = style.new_axes(ax)

    looks: dict[str, dict[str, Any]] = {
        "accepted": {"facecolor": ACCEPTED, "edgecolor": ACCEPTED},
        "tied": {"facecolor": style.MODEL_ERROR_BAND, "edgecolor": ACCEPTED, "hatch": "////"},
        "considered": {"facecolor": style.POSTERIOR_BAND, "edgecolor": ACCEPTED},
        "not physical": {"facecolor": "white", "edgecolor": "0.35", "hatch": "xxxx"},
        "base, or none of these": {"facecolor": "0.6", "edgecolor": "0.25"},
    }

    def kind(item: Any) -> str:
        if not item.terms or tuple(item.terms) == NONE:
            return "base, or none of these"
        if chosen and frozenset(item.terms) == chosen:
            return "accepted"
        if not item.physical:
            return "not physical"
        return "tied" if frozenset(item.terms) in sets else "considered"

    kinds = [kind(item) for item in rows]
    numbers = [_finite(getattr(item, value), math.nan) for item in rows]
    top = max([number for number in numbers if math.isfinite(number)], default=0.0)
    # A hopeless hypothesis would squeeze all others: its bar is cut, its number is written beside it.
    floor = 0.0 if value == "probability" else -max(0.3 * top, 5.0)
    for name, options in looks.items():
        places = [i for i, other in enumerate(kinds) if other == name]
        if places:
            widths = [max(numbers[i], floor) if math.isfinite(numbers[i]) else 0.0 for i in places]
            ax.barh(places, widths, height=0.66, lw=0.7, label=name, zorder=3, **options)
    ax.axvline(0.0, color="0.25", lw=0.7, zorder=4)
    names = [_terms(item.terms) if item.terms else "base model alone" for item in rows]
    ax.set_yticks(range(len(rows)), names)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    low = min([number for number in numbers if math.isfinite(number)], default=0.0)
    ax.set_xlim(max(min(low, 0.0) * 1.05, floor), max(top, 0.01) * 1.05 if value == "log_evidence" else 1.0)
    for i, item in enumerate(rows):
        _beside(ax, i, 46, _signed(item.log_evidence))
        _beside(ax, i, 92, _percent(item.probability))
    _beside(ax, None, 46, "ln K")
    _beside(ax, None, 92, "prob.")
    shown = "log evidence against the base, ln K [1]" if value == "log_evidence" else "probability [1]"
    ax.set_xlabel(shown + (f"\n({left_out} weaker ones not shown)" if left_out else ""))
    style.dress(ax)
    ax.tick_params(axis="y", length=0)
    if legend and len(set(kinds)) > 1:
        _key(ax, right=True)
    return ax


# --- needed shift, missing rate --------------------------------------------------------------------------------


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
    look = _Look(units=units or {}, labels=labels or {})
    x = _numbers(needed.values, "values")
    shift, sd = _numbers(needed.shift, "shift", len(x)), _numbers(needed.sd, "sd", len(x))
    ax = style.new_axes(ax)
    ax.axhline(0.0, color="0.35", lw=0.7, zorder=1)
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
    unit = f" [{_plain(needed.unit)}]" if needed.unit else ""
    name = look.shown(needed.parameter)
    _finish(ax, look.axis(needed.driver), f"needed shift of {name}{unit}, ±1 sd", "")
    if math.isfinite(_finite(needed.correlation, math.nan)):
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
    look = _Look(units=units or {}, labels=labels or {})
    x = _numbers(missing.values, "values")
    rate, sd = _numbers(missing.rate, "rate", len(x)), _numbers(missing.sd, "sd", len(x))
    ax = style.new_axes(ax)
    ax.axhline(0.0, color="0.35", lw=0.7, zorder=1)
    ax.fill_between(x, rate - 2 * sd, rate + 2 * sd, color=style.MODEL_ERROR_BAND, lw=0, label="±2 sd", zorder=2)
    ax.plot(x, rate, color=ACCEPTED, lw=1.5, label="estimate", zorder=3)
    target = look.shown(missing.target)
    what = f"missing rate of d{target}/dt" if missing.kind == "equation" else f"missing shift of {target}"
    _finish(ax, look.axis(missing.driver), what + (f" [{_plain(missing.unit)}]" if missing.unit else ""), "")
    if legend:
        _key(ax)
    return ax


# --- proof -----------------------------------------------------------------------------------------------------


def held_out(
    recording: Recording,
    before: Any,
    after: Any,
    mask: Any,
    *,
    ax: "Axes | None" = None,
    along: str | None = None,
    names: tuple[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    """What models fitted without the held-out data predict there.

    The run and output with most held-out data is drawn, over time or against the condition; held-out data that
    lie scattered among the others are drawn as predicted against measured.

    Args:
        recording: The data.
        before: Outputs ``(n_total,)`` that the base predicts, or anything that has them as ``prediction``.
        after: The accepted model's, or None.
        mask: True where data were held out, ``(n_total,)``.
        ax: Where to draw; a new figure by default.
        along: As for `both_fits`.
        names: What to call the two models.
        units: Units by name, beside the recording's.
        labels: How to write names on the axes, by name.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If nothing was held out.
        ShapeError: If predictions, mask and recording do not fit.
    """
    fits = _fits(recording, before, after, names)
    held = _mask(mask, recording)
    seen = recording.observed.cpu().numpy()
    if held is None or not (held & seen).any():
        raise DomainError("Expected a mask with observed data that were held out. Got none.")
    look = _Look(units={**recording.units, **(units or {})}, labels=labels or {})
    panels = _panels(recording, fits[0].values, along, None, None, 10**6, look)
    panel = max(panels, key=lambda item: int((held & seen)[item.places].sum()))
    there = seen[panel.places]
    spans = [] if panel.x is None else _held_spans(panel.x[there], held[panel.places][there])
    ax = style.new_axes(ax)
    if spans:
        _draw_panel(ax, recording, panel, fits, held, look)
    else:
        places = _part(recording, panel.output)
        places = places[held[places] & seen[places]]
        alone = replace(panel, places=places, x=None, title="held-out data alone")
        _draw_panel(ax, recording, alone, fits, held, look)
        ax.set_ylabel(ax.get_ylabel().replace("fitted", "predicted", 1))
    if legend:
        _key(ax)
    return ax


def held_out_scores(before: Any, after: Any = None, *, ax: Any = None, unit: str | None = None) -> np.ndarray:
    """RMSE, log score and coverage before and after, on fitted and held-out data.

    Args:
        before: The base's, with ``fitted`` and ``held_out`` (or None), each with ``rmse``, ``log_score``,
            ``coverage`` and ``n``.
        after: The accepted model's, or None.
        ax: Three axes; a new figure by default.
        unit: Unit of the RMSE; by default it is in units of each output's spread.

    Returns:
        The axes, ``(3,)``.

    Raises:
        ShapeError: If ``ax`` are not three axes.
    """
    axes, _ = _axes(ax, 3, (7.2, 2.0), one_row=True)
    if len(axes) != 3:
        raise ShapeError(f"Expected ax: three axes. Got {len(axes)} (plt.subplots(1, 3)[1]).")
    parts = [name for name in ("fitted", "held_out") if getattr(before, name) is not None]
    models = [(before, "s", BASE, "none", "before")]
    models += [] if after is None else [(after, "o", ACCEPTED, ACCEPTED, "after")]
    heads = (
        ("rmse", f"RMSE [{_plain(unit)}]" if unit else "RMSE [spread]"),
        ("log_score", "log score [nat]"),
        ("coverage", "coverage [1]"),
    )
    for place, (field, head) in zip(axes, heads, strict=True):
        if field == "coverage":
            place.axvline(0.95, color="0.4", lw=0.8, ls=(0, (2, 2)), zorder=1)
        found = []
        for i, part in enumerate(parts):
            here = []
            for model, marker, color, face, name in models:
                score = getattr(model, part)
                value = math.nan if score is None else _finite(getattr(score, field), math.nan)
                here.append(value)
                place.plot(
                    [value], [i], marker, ms=6, mfc=face, mec=color, mew=1.2, zorder=4, ls="none",
                    label=name if i == 0 else "_" + name,
                )  # fmt: skip
                if math.isfinite(value):
                    above = name == "before"
                    place.annotate(
                        style.number(float(f"{value:.3g}")), (value, i), (0, 6 if above else -6), ha="center",
                        textcoords="offset points", va="bottom" if above else "top", fontsize="x-small",
                        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.3}, zorder=3,
                    )  # fmt: skip
            if len(here) == 2 and all(math.isfinite(value) for value in here):
                place.plot(here, [i, i], color="0.7", lw=1.2, zorder=2)
            found += [value for value in here if math.isfinite(value)]
        if field == "rmse" and found and min(found) > 0 and max(found) / min(found) > 5:
            place.set_xscale("log")
        _room(place, found)
        if field == "coverage":
            place.set_xlim(min([0.5, *(value - 0.15 for value in found)]), 1.08)
        place.set_yticks(range(len(parts)), [name.replace("_", " ").replace("held ", "held-") for name in parts])
        place.set_ylim(len(parts) - 0.4, -0.6)
        place.set_xlabel(head, fontsize="small")
        style.dress(place)
        place.tick_params(axis="y", length=0, labelleft=place is axes[0])
    if after is not None:
        _key(axes[0], across=2)
    return np.array(axes)


def _room(ax: "Axes", values: Sequence[float]) -> None:
    """Widen the abscissa so that the numbers beside the outermost dots fit, with few ticks."""
    if not values:
        return
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    low, high = min(values), max(values)
    if ax.get_xscale() == "log":
        room = (high / low) ** 0.25
        ax.set_xlim(low / room, high * room)
        ax.xaxis.set_major_locator(LogLocator(numticks=4))
        ax.xaxis.set_minor_formatter(NullFormatter())
        return
    room = 0.25 * ((high - low) or abs(high) or 1.0)
    ax.set_xlim(low - room, high + room)
    ax.xaxis.set_major_locator(MaxNLocator(3))


# --- detection limits ------------------------------------------------------------------------------------------


def detection_limits(limits: Iterable[Any], *, most: int = 16, ax: "Axes | None" = None, legend: bool = True) -> "Axes":
    """The smallest effect of each candidate that these data could have shown, and the estimate over it.

    Args:
        limits: Each with ``term``, ``parameter``, ``smallest``, ``unit`` and ``estimate`` (or None).
        most: Largest number of rows: those with the largest estimates, then the others.
        ax: Where to draw; a new figure by default.
        legend: Whether to draw one.

    Returns:
        The axes, with \\|estimate\\| / smallest on a logarithmic abscissa.

    Raises:
        DomainError: If there is no candidate.
    """
    rows = list(limits)
    if not rows:
        raise DomainError("Expected at least one candidate. Got none.")

    def ratio(item: Any) -> float:
        if item.estimate is None or not math.isfinite(item.estimate) or not 0 < item.smallest < math.inf:
            return math.nan
        return abs(item.estimate) / float(item.smallest)

    rows.sort(key=lambda item: (-_finite(ratio(item), -1.0), not math.isfinite(item.smallest)))
    left_out, rows = len(rows) - most, rows[:most]
    ax = style.new_axes(None, (6.4, 1.2 + 0.28 * len(rows))) if ax is None else style.new_axes(ax)
    ratios = np.array([ratio(item) for item in rows])
    shown = ratios[np.isfinite(ratios) & (ratios > 0)]
    low = max(min(0.3, 0.7 * shown.min(initial=1.0)), 0.01)
    high = max(3.0, 1.6 * shown.max(initial=1.0))
    ax.set_xscale("log")
    ax.set_xlim(low, high)
    ax.axvspan(low, 1.0, facecolor=NOISE, lw=0, zorder=0, label="too small to be seen in these data")
    ax.axvline(1.0, color="0.25", lw=1.0, zorder=2)
    terms = [item.term for item in rows]
    names = [_plain(item.term if terms.count(item.term) == 1 else f"{item.term}.{item.parameter}") for item in rows]
    for i, (item, value) in enumerate(zip(rows, ratios, strict=True)):
        if math.isfinite(value):
            place = min(max(value, low), high)
            ax.plot([1.0, place], [i, i], color="0.6", lw=1.0, zorder=3)
            seen = value >= 1
            ax.plot(
                [place], [i], "o" if value > low else "<", ms=5.5, mfc=ACCEPTED if seen else "white", mec=ACCEPTED,
                mew=1.1, zorder=4,
            )  # fmt: skip
        unit = f" {_plain(item.unit)}" if item.unit else ""
        smallest = f"{style.number(float(f'{item.smallest:.2g}'))}{unit}" if math.isfinite(item.smallest) else "∞"
        note = str(getattr(item, "note", "") or "")
        text = smallest if not note else _plain(note, 30)
        _beside(ax, i, 6, text, "left")
    _beside(ax, None, 6, "smallest", "left")
    ax.plot([], [], "o", ms=5.5, mfc=ACCEPTED, mec=ACCEPTED, label="estimate, where fitted")
    ax.set_yticks(range(len(rows)), names)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    more = f"\n({left_out} more not shown)" if left_out > 0 else ""
    ax.set_xlabel("|estimate| / smallest detectable effect [1]" + more)
    style.dress(ax)
    ax.tick_params(axis="y", length=0)
    if legend:
        _key(ax, right=True)
    return ax


# --- overview --------------------------------------------------------------------------------------------------


def discovery_overview(diagnosis: Any, fig: Any = None) -> Any:
    """One figure with every panel that this diagnosis has.

    Args:
        diagnosis: The result of ``torchcal.diagnose``, or anything with its attributes.
        fig: A figure or subfigure to draw in; a new one by default.

    Returns:
        The figure.

    Raises:
        DomainError: If ``fig`` is no figure.
    """
    parts = figure_parts(diagnosis)
    wide = [part for part in parts if part.wide]
    rest = [part for part in parts if not part.wide]
    pairs = [rest[i : i + 2] for i in range(0, len(rest), 2)]
    heights = [part.height for part in wide] + [max(part.height for part in pair) for pair in pairs]
    if fig is None:
        import matplotlib.pyplot as plt

        fig = plt.figure(figsize=(11.0, sum(heights) + 0.4), layout="constrained")
    elif not callable(getattr(fig, "add_subfigure", None)):
        raise DomainError(f"Expected fig: a matplotlib figure or None. Got {type(fig).__name__}.")
    elif fig.get_layout_engine() is None:
        fig.set_layout_engine("constrained")
    grid = fig.add_gridspec(len(heights), 2, height_ratios=heights)
    for i, part in enumerate(wide):
        part.place(fig.add_subfigure(grid[i, :]))
    for i, pair in enumerate(pairs, start=len(wide)):
        for j, part in enumerate(pair):
            part.place(fig.add_subfigure(grid[i, j] if len(pair) == 2 else grid[i, :]))
    return fig


@dataclass(frozen=True)
class FigurePart:
    """One figure of a diagnosis.

    Attributes:
        key: ``"fits"``, ``"residuals"``, ``"ranking"``, ``"shift"``, ``"missing"``, ``"held out"``, ``"scores"`` or
            ``"limits"``.
        name: Its title.
        caption: What it shows, in a sentence or two.
        draw: Draws it on an empty figure or subfigure.
        width: Inches, on its own.
        height: Inches.
        wide: Whether it takes a whole row of the overview.
    """

    key: str
    name: str
    caption: str
    draw: Callable[[Any], None]
    width: float
    height: float
    wide: bool = False

    def place(self, fig: Any) -> None:
        """Draw it with its title."""
        self.draw(fig)
        fig.suptitle(self.name, fontsize="medium", fontweight="bold", x=0.01, ha="left")


def figure_parts(diagnosis: Any) -> list[FigurePart]:
    """The figures that this diagnosis has something to show in.

    Raises:
        DomainError: If it is no diagnosis.
    """
    for name in ("recording", "base", "verdict"):
        if not hasattr(diagnosis, name):
            raise DomainError(
                f"Expected diagnosis: a result of torchcal.diagnose. Got {type(diagnosis).__name__}, which has no "
                f"{name!r}."
            )
    recording: Recording = diagnosis.recording
    units = dict(getattr(getattr(diagnosis, "simulator", None), "states", None) or {})
    units = {name: unit for name, unit in units.items() if isinstance(unit, str)}
    for run in getattr(recording, "runs", None) or ():
        units |= dict(getattr(run, "units", None) or {})
    units |= dict(recording.units)
    base, final = diagnosis.base, getattr(diagnosis, "final", None)
    after = final if final is not None and tuple(final.terms) != tuple(base.terms) else None
    mask = getattr(diagnosis, "held_out", None)
    where = list(getattr(diagnosis, "where", None) or [])
    shifts = list(getattr(diagnosis, "shifts", None) or [])
    columns = conditions_of(recording.x, recording)
    in_time = set(columns) == {"time", "run"}
    drivers = [item.driver for item in [*where, *shifts] if item.driver in columns]
    along = None if in_time or len(columns) == 1 else next(iter(drivers), None)
    parts: list[FigurePart] = []

    def called(driver: str) -> str:
        return "time" if in_time and driver == "t" else driver

    look = _Look(units, {})
    panels = _panels(recording, _numbers(base, "base", len(recording.y)), along, None, None, 6, look)
    if along is not None and not panels[0].joined:  # nothing to join the fits along: fitted against measured tells more
        along = None
        panels = _panels(recording, _numbers(base, "base", len(recording.y)), along, None, None, 6, look)
    count = len(panels)
    across = 2 if count in (2, 4) else min(count, 3)

    def fits(fig: Any) -> None:
        axes = list(fig.subplots(math.ceil(count / across), across, squeeze=False).flat)
        both_fits(recording, base, after, held_out=mask, along=along, ax=axes[:count], units=units, legend=False)
        for spare in axes[count:]:
            spare.remove()
        _figure_key(fig, axes[:count])

    said = "The data with the recalibrated base model" + ("" if after is None else " and with the accepted model")
    said += (", " if after is None else ", both ") + "fitted to all data."
    said += "" if mask is None else " Data that were held out for the proof lie in the grey region or are ringed."
    parts.append(
        FigurePart(
            "fits",
            "Data and fit" if after is None else "Data and both fits",
            said,
            fits,
            {1: 6.4, 2: 8.4}.get(across, 9.6),
            {1: 3.3, 2: 3.0}.get(across, 2.8) * (1 if count <= 3 else 1.75),
            wide=True,
        )
    )

    best = where[0] if where else None
    driver = best.driver if best is not None else None
    values = None if driver is None else _driver_of(diagnosis, driver, final if after is not None else base)
    if values is None:
        driver = None
    spans = best.spans if best is not None and driver is not None else ()
    output = best.target if best is not None and best.target in recording.outputs else None

    def mismatch(fig: Any) -> None:
        residual_map(
            recording, base, after, driver=driver, values=values, spans=spans, output=output, units=units,
            share=best.share if best is not None and spans else None, noise=getattr(diagnosis, "noise", None),
            ax=fig.subplots(),
        )  # fmt: skip

    said = "What the models leave of the data"
    said += f", against {called(driver)}." if driver is not None else "."
    said += " Shaded: where the mismatch sits." if spans else ""
    parts.append(FigurePart("residuals", "Where the mismatch sits" if spans else "Residuals", said, mismatch, 6.0, 3.5))

    hypotheses = list(getattr(diagnosis, "ranking", None) or [])
    if hypotheses:
        bars = min(len(hypotheses), 12)
        parts.append(
            FigurePart(
                "ranking",
                "Ranking of the hypotheses",
                "Log evidence against the base model, ln K, and probability among all hypotheses considered.",
                lambda fig: _ignore(
                    ranking(
                        hypotheses, accepted=diagnosis.terms, tied=getattr(diagnosis, "tied", ()), ax=fig.subplots()
                    )
                ),
                7.0,
                max(3.2, 1.4 + 0.26 * bars),
            )
        )
    if shifts:
        parts.append(
            FigurePart(
                "shift",
                f"Shift that {_plain(shifts[0].parameter)} would need",
                f"The shift of {shifts[0].parameter} that each stretch of data needs by itself, ±1 sd, against "
                f"{called(shifts[0].driver)}. Were the base model complete, it would scatter around zero.",
                lambda fig: _ignore(needed_shift(shifts[0], ax=fig.subplots(), units=units)),
                6.0,
                3.3,
            )
        )
    missing = getattr(diagnosis, "missing", None)
    if missing is not None:
        parts.append(
            FigurePart(
                "missing",
                "What is missing, without a formula",
                f"A smooth estimate of what is missing, ±2 sd, as a function of {called(missing.driver)}.",
                lambda fig: _ignore(missing_rate(missing, ax=fig.subplots(), units=units)),
                6.0,
                3.3,
            )
        )
    scores = (getattr(diagnosis, "before", None), getattr(diagnosis, "after", None))
    pair = (scores[0], scores[1] if after is not None else None)
    predicted = getattr(scores[0], "prediction", None)
    if mask is not None and predicted is not None:
        second = pair[1] if getattr(pair[1], "prediction", None) is not None else None
        names = ("base model", "accepted model" if after is None else "with " + _terms(after.terms))
        parts.append(
            FigurePart(
                "held out",
                "Prediction of held-out data",
                "What the models, fitted without the held-out data, predict for them.",
                lambda fig: _ignore(
                    held_out(
                        recording, scores[0], second, mask, ax=fig.subplots(), along=along, names=names, units=units
                    )
                ),
                6.0,
                3.5,
            )
        )
    if scores[0] is not None:
        unit = units.get(recording.outputs[0]) if len(recording.outputs) == 1 else None
        parts.append(
            FigurePart(
                "scores",
                "Scores before and after" if pair[1] is not None else "Scores",
                "RMSE, mean log predictive density a datum, and share of the data in the 95 % interval, whose wanted "
                "value is dotted.",
                lambda fig: _ignore(held_out_scores(*pair, ax=fig.subplots(1, 3), unit=unit)),
                7.2,
                2.2,
            )
        )
    limits = list(getattr(diagnosis, "detection_limit", None) or [])
    if limits:
        parts.append(
            FigurePart(
                "limits",
                "Detection limits",
                "The smallest effect of each candidate that these data could have shown, and the estimate as a "
                "multiple of it.",
                lambda fig: _ignore(detection_limits(limits, ax=fig.subplots())),
                7.0,
                max(3.2, 1.4 + 0.26 * min(len(limits), 16)),
            )
        )
    return parts


def _driver_of(diagnosis: Any, driver: str, fit: Any) -> Any:
    """A driver's values ``(n,)``: those that the diagnosis keeps, or the recording's."""
    kept = getattr(diagnosis, "drivers", None) or {}
    return kept[driver] if driver in kept else driver_values(diagnosis.recording, driver, fit)


def _ignore(_: Any) -> None:
    """The axes are of no use to the caller."""


# --- small helpers ---------------------------------------------------------------------------------------------


def _axes(
    ax: Any, count: int, size: tuple[float, float] | None = None, *, one_row: bool = False
) -> tuple[list[Any], bool]:
    """Axes to draw on, and whether they were made here."""
    if ax is None:
        import matplotlib.pyplot as plt

        across = count if one_row else min(count, 3 if count != 4 else 2)
        down = math.ceil(count / across)
        if size is None:
            size = (5.0, 3.6) if count == 1 else (3.6 * across, 2.9 * down)
        made = list(plt.subplots(down, across, figsize=size, layout="constrained", squeeze=False)[1].flat)
        for spare in made[count:]:
            spare.remove()
        return made[:count], True
    given = list(np.asarray(ax, dtype=object).flat)
    if not given:
        raise ShapeError("Expected ax: at least one axes. Got none.")
    return [style.new_axes(place) for place in given[:count]], False


def _finish(ax: "Axes", x_label: str, y_label: str, title: str) -> None:
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label if len(y_label) <= 30 or "$" in y_label.replace(r"\$", "") else textwrap.fill(y_label, 30))
    if title:
        ax.set_title(title, fontsize="small", loc="left")
    ax.margins(x=0.03)
    style.dress(ax)


def _beside(ax: "Axes", row: int | None, points: float, text: str, side: str = "right") -> None:
    """A number beside a row, at a fixed distance from the axes so that the layout finds room; None is the head."""
    ax.annotate(
        text, (1.0, 1.0 if row is None else row), (points, 2 if row is None else 0), textcoords="offset points",
        xycoords="axes fraction" if row is None else ax.get_yaxis_transform(), ha=side, fontsize="small",
        va="bottom" if row is None else "center", color="0.35" if row is None else "black", annotation_clip=False,
    )  # fmt: skip


def _key(ax: "Axes", *, right: bool = False, across: int | None = None) -> None:
    """A legend above the axes, where it can hide nothing; a title goes on with it.

    Args:
        ax: The axes.
        right: Whether it ends above the right edge, because the rows' names take the width on the left.
        across: How many entries stand side by side; as many as fit by default.
    """
    handles, names = _entries([ax])
    if not handles:
        return
    # The layout will take a part of the present width for the labels.
    across = across or _across(names, (0.5 if right else 0.85) * ax.get_window_extent().width / ax.figure.dpi)
    title = ax.get_title(loc="left")
    ax.set_title("", loc="left")
    ax.legend(
        handles, names, loc="lower right" if right else "lower left",
        bbox_to_anchor=(1.0 if right else 0.0, 1.0), ncols=across, title=title or None,
        alignment="left", title_fontsize="small", borderaxespad=0.2, borderpad=0.1, **KEY,
    )  # fmt: skip


def _figure_key(fig: Any, axes: Sequence["Axes"]) -> None:
    """One legend for several panels, above them; on the left there is room for a title."""
    handles, names = _entries(axes)
    if handles:
        across = _across(names, 0.75 * fig.bbox.width / fig.dpi)
        fig.legend(handles, names, loc="outside upper right", ncols=across, **KEY)


KEY: dict[str, Any] = {
    "fontsize": "small", "frameon": False, "handlelength": 1.8, "columnspacing": 1.2, "labelspacing": 0.3,
}  # fmt: skip


def _entries(axes: Sequence["Axes"]) -> tuple[list[Any], list[str]]:
    """What the legend of some axes holds, each name once, the data first."""
    found: dict[str, Any] = {}
    for place in axes:
        for handle, name in zip(*place.get_legend_handles_labels(), strict=True):
            found.setdefault(name, handle)
    names = sorted(found, key=lambda name: name != "data")
    return [found[name] for name in names], names


def _across(names: Sequence[str], inches: float) -> int:
    """How many entries of a legend stand side by side: about 0.07 inches a letter, 0.45 a handle."""
    for count in range(len(names), 1, -1):
        columns = [names[i::count] for i in range(count)]
        if sum(0.45 + 0.07 * max(len(name) for name in column) for column in columns) <= inches:
            return count
    return 1


def _plain(text: Any, most: int = 44) -> str:
    """A user's text on a figure: one line, no mathematics by accident, not too long."""
    text = " ".join(str(text).split())
    text = text if len(text) <= most else text[: most - 1].rstrip() + "…"
    return text.replace("$", r"\$")


def _terms(terms: Iterable[str]) -> str:
    return _plain(" + ".join(str(term) for term in terms))


def _numbers(value: Any, what: str, length: int | None = None) -> np.ndarray:
    """Float64 numbers ``(length,)``, NaN allowed, of an array or of something with a ``prediction``."""
    given = getattr(value, "prediction", value)
    if isinstance(given, Tensor):
        given = given.detach().cpu().numpy()
    try:
        numbers = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"Expected {what}: an array of real numbers. Got {type(value).__name__}: {error}.") from error
    if numbers.ndim != 1 or (length is not None and len(numbers) != length):
        wanted = f"({length},)" if length is not None else "(m,)"
        raise ShapeError(f"Expected {what} of shape {wanted}. Got shape {tuple(numbers.shape)}.")
    return numbers


def _mask(mask: Any, recording: Recording) -> np.ndarray | None:
    if mask is None:
        return None
    given = mask.detach().cpu().numpy() if isinstance(mask, Tensor) else np.asarray(mask)
    if given.dtype != bool or given.shape not in {(len(recording.y),), (recording.n,)}:
        raise ShapeError(
            f"Expected a mask of dtype bool and shape ({len(recording.y)},). Got {given.dtype}, {given.shape}."
        )
    return given if len(given) == len(recording.y) else np.tile(given, len(recording.outputs))


def _part(recording: Recording, output: str) -> np.ndarray:
    return recording.outputs.index(output) * recording.n + np.arange(recording.n)


def _thinned(count: int) -> np.ndarray:
    if count <= MOST_POINTS:
        return np.arange(count)
    return np.linspace(0, count - 1, MOST_POINTS).round().astype(int)


def _rms(values: np.ndarray) -> float:
    seen = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(seen**2))) if len(seen) else 0.0


def _finite(value: Any, otherwise: float) -> float:
    return float(value) if value is not None and math.isfinite(value) else otherwise


def _signed(value: float) -> str:
    if not math.isfinite(_finite(value, math.nan)):
        return "–"
    text = f"{value:+.0f}" if abs(value) >= 1000 else f"{value:+.1f}"
    return ("0" if value == 0 else text).replace("-", "−")


def _percent(value: float) -> str:
    if not math.isfinite(_finite(value, math.nan)):
        return "–"
    if value in (0, 1):
        return f"{100 * value:.0f} %"
    if value < 0.001:
        return "<0.1 %"
    if value > 0.999:
        return ">99.9 %"
    return f"{100 * value:.1f} %" if value < 0.1 or value > 0.99 else f"{100 * value:.0f} %"
