"""Where the mismatch sits: residuals against what they vary with."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.errors import DomainError
from torchcal.plots import style
from torchcal.plots.discovery.panels import curves_of
from torchcal.plots.discovery.pieces import (
    EDGE,
    LOCATED,
    NOISE,
    Look,
    as_mask,
    as_numbers,
    draw_key,
    finish,
    finite,
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
    set_aside: Any = None,
    output: str | None = None,
    ax: "Axes | None" = None,
    names: tuple[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    """Residuals, data minus model, of both models against what the mismatch varies with.

    With more than 40 data their means over neighbouring data are drawn as lines. Where the noise sd varies more than
    fivefold, residuals are divided by it: in the output's unit the smallest would all look like zero.

    Args:
        recording: The data.
        before: Fitted outputs of the base, ``(n_total,)``, or anything that has them as ``prediction``.
        after: The accepted model's, or None.
        driver: What is on the abscissa: see `driver_values`; the first condition (time) by default.
        values: The driver's values ``(n,)``, where the recording does not hold them.
        spans: Ranges of the driver in which the mismatch sits, shaded.
        share: Share of the misfit that sits there.
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
    fits = curves_of(recording, before, after, names)
    look = Look(units={**recording.units, **(units or {})}, labels=labels or {})
    y = recording.y.cpu().numpy()
    mask = as_mask(set_aside, recording)
    if output is None:
        scaled = (y - fits[0].values) / recording.spread.cpu().numpy()
        scaled = scaled if mask is None else np.where(mask, np.nan, scaled)
        output = max(recording.outputs, key=lambda name: finite(rms(scaled[places_of(recording, name)]), -1.0))
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
    x = as_numbers(values, "values", recording.n)
    part = places_of(recording, output)
    ax = style.new_axes(ax)
    located = f"mismatch located here ({100 * share:.0f} % of it)" if share is not None else "mismatch located here"
    seen = np.isfinite(y[part]) & np.isfinite(x)
    aside = np.zeros_like(seen) if mask is None else mask[part] & seen
    shown = seen & ~aside
    if is_log(x[seen]):
        ax.set_xscale("log")
    low, high = float(x[seen].min()), float(x[seen].max())
    inside = [(start, end) for start, end in spans if end >= low and start <= high]
    for i, (start, end) in enumerate(inside):
        ax.axvspan(
            max(start, low), min(end, high), facecolor=LOCATED, edgecolor=EDGE, ls=":", lw=0.8, zorder=0,
            label=located if i == 0 else "_located",
        )  # fmt: skip
    sd = _noise_of(noise, recording, output)
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
    dots = keep[thinned(len(keep))]
    for fit in fits:
        residual = (y[part] - fit.values[part]) / unit_of
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
            centers = [np.median(x[rows]) for rows in bins]
            means = [np.nanmean(residual[rows]) for rows in bins]
            ax.plot(
                centers, means, color=fit.color, ls=fit.line, lw=1.7, label=fit.name + ", local mean",
                zorder=fit.zorder,
            )  # fmt: skip
    if aside.any():
        residual = (y - fits[-1].values)[part] / unit_of
        ax.plot(x[aside], residual[aside], "x", ms=5, mew=1.1, color="0.25", zorder=5, label="set aside as outliers")
    finish(ax, look.axis(driver), label, "")
    if legend:
        draw_key(ax)
    return ax


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
