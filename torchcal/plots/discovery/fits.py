"""The data with both fits."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcal.data import Recording
from torchcal.plots import style
from torchcal.plots.discovery.panels import Curve, Panel, curves_of, panels_of
from torchcal.plots.discovery.pieces import (
    DENSE,
    HELD_OUT,
    Look,
    as_mask,
    draw_figure_key,
    draw_key,
    finish,
    is_log,
    take_axes,
    thinned,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
    fits = curves_of(recording, before, after, names)
    mask = as_mask(held_out, recording)
    look = Look(units={**recording.units, **(units or {})}, labels=labels or {})
    panels = panels_of(recording, fits[0].values, along, output, run, most, look)
    axes, made = take_axes(ax, len(panels))
    for i, (place, panel) in enumerate(zip(axes, panels, strict=False)):
        draw_panel(place, recording, panel, fits, mask, look)
        if legend and not made and i == 0:
            draw_key(place)
    if legend and made:
        draw_figure_key(axes[0].figure, axes)
    return axes[0] if len(axes) == 1 and not isinstance(ax, np.ndarray | list | tuple) else np.array(axes)


def draw_panel(
    ax: "Axes", recording: Recording, panel: Panel, fits: Sequence[Curve], mask: np.ndarray | None, look: Look
) -> None:
    """Data, fits and held-out spans of one panel."""
    y = recording.y.cpu().numpy()[panel.places]
    held = np.zeros(len(y), dtype=bool) if mask is None else mask[panel.places] & np.isfinite(y)
    seen = np.isfinite(y)
    if panel.x is None:
        _draw_parity(ax, y, held, [fit.values[panel.places] for fit in fits], fits)
        finish(ax, f"measured {look.axis(panel.output)}", f"fitted {look.axis(panel.output)}", panel.title)
        return
    spans = held_spans(panel.x[seen], held[seen])
    if is_log(panel.x):
        ax.set_xscale("log")
    for i, (low, high) in enumerate(spans):
        ax.axvspan(low, high, color=HELD_OUT, lw=0, zorder=0, label="held out" if i == 0 else "_held out")
    keep = np.flatnonzero(seen)
    keep = keep[thinned(len(keep))]
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
    finish(ax, look.axis(panel.along), look.axis(panel.output), panel.title)


def _draw_parity(
    ax: "Axes",
    y: np.ndarray,
    held: np.ndarray,
    values: Sequence[np.ndarray],
    fits: Sequence[Curve],
) -> None:
    every = np.concatenate([y, *values])
    low, high = np.nanmin(every), np.nanmax(every)
    ax.plot([low, high], [low, high], color="0.6", lw=0.9, label="equal", zorder=1)
    keep = np.flatnonzero(np.isfinite(y))
    keep = keep[thinned(len(keep))]
    for fit, value in zip(fits, values, strict=True):
        ax.plot(
            y[keep], value[keep], fit.marker, ms=4.5 if fit.face == "none" else 3.2, mfc=fit.face, mec=fit.color,
            mew=0.9, label=fit.name, zorder=fit.zorder,
        )  # fmt: skip
    if held.any() and not held[np.isfinite(y)].all():
        value = values[-1]
        ax.plot(y[held], value[held], "o", ms=8, mfc="none", mec="0.4", mew=0.8, label="held out", zorder=3)


def held_spans(x: np.ndarray, held: np.ndarray) -> list[tuple[float, float]]:
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
