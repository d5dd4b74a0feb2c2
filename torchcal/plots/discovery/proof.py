"""The proof: what models predict that were fitted without the held-out data, and their scores."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcal.data import Recording
from torchcal.errors import DomainError, ShapeError
from torchcal.plots import style
from torchcal.plots.discovery.fits import draw_panel, held_spans
from torchcal.plots.discovery.panels import curves_of, panels_of
from torchcal.plots.discovery.pieces import (
    ACCEPTED,
    BASE,
    Look,
    as_mask,
    draw_key,
    expect,
    finite,
    places_of,
    plain,
    take_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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

    Of the runs and outputs with held-out data, the one is drawn where the two predictions differ most there, or the
    only one differs most from the data, over time or against the condition; held-out data that lie scattered among the
    others are drawn as predicted against measured.

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
    fits = curves_of(recording, before, after, names)
    held = as_mask(mask, recording)
    seen = recording.observed.cpu().numpy()
    if held is None or not (held & seen).any():
        raise DomainError("Expected a mask with observed data that were held out. Got none.")
    look = Look(units={**recording.units, **(units or {})}, labels=labels or {})
    panels = panels_of(recording, fits[0].values, along, None, None, 10**6, look)
    wanted = held & seen
    with np.errstate(invalid="ignore"):  # predictions may be infinite
        apart = (fits[-1].values if len(fits) > 1 else recording.y.cpu().numpy()) - fits[0].values
    apart = np.where(wanted & np.isfinite(apart), apart / recording.spread.cpu().numpy(), 0.0)
    panels = [item for item in panels if wanted[item.places].any()]
    panel = max(panels, key=lambda item: (float(np.square(apart[item.places]).sum()), wanted[item.places].sum()))
    titles = {item.title for item in panels if item.output == panel.output}
    if len(titles) > 1:
        panel = replace(panel, title=f"{panel.title} (one of {len(titles)} with held-out data)")
    there = seen[panel.places]
    spans = [] if panel.x is None else held_spans(panel.x[there], held[panel.places][there])
    ax = style.new_axes(ax)
    if spans:
        draw_panel(ax, recording, panel, fits, held, look)
    else:
        places = places_of(recording, panel.output)
        places = places[held[places] & seen[places]]
        alone = replace(panel, places=places, x=None, title="held-out data alone")
        draw_panel(ax, recording, alone, fits, held, look)
        ax.set_ylabel(ax.get_ylabel().replace("fitted", "predicted", 1))
    if legend:
        draw_key(ax)
    return ax


def held_out_scores(before: Any, after: Any = None, *, ax: Any = None, unit: str | None = None) -> np.ndarray:
    """RMSE, log score and coverage before and after, on fitted and held-out data.

    Args:
        before: The base's, with ``fitted`` and ``held_out`` (or None), each with ``rmse``, ``log_score``,
            ``coverage`` and ``n``.
        after: The accepted model's, or None.
        ax: Three axes; a new figure by default.
        unit: Unit of the RMSE; by default it is in units of each output's spread, and where it is empty nobody told it.

    Returns:
        The axes, ``(3,)``.

    Raises:
        DomainError: If an attribute is not there.
        ShapeError: If ``ax`` are not three axes.
    """
    for what, scores in (("before", before), ("after", after)):
        if scores is not None or what == "before":
            expect(what, scores, ("fitted", "held_out"), f".{what}")
    axes, _ = take_axes(ax, 3, (7.2, 2.0), one_row=True)
    if len(axes) != 3:
        raise ShapeError(f"Expected ax: three axes. Got {len(axes)} (plt.subplots(1, 3)[1]).")
    parts = [name for name in ("fitted", "held_out") if getattr(before, name) is not None]
    models = [(before, "s", BASE, "none", "before")]
    models += [] if after is None else [(after, "o", ACCEPTED, ACCEPTED, "after")]
    heads = (
        ("rmse", "RMSE [spread]" if unit is None else f"RMSE [{plain(unit)}]" if unit else "RMSE"),
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
                value = math.nan if score is None else finite(getattr(score, field), math.nan)
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
            place.set_xlim(min([0.5, *(value - 0.2 for value in found)]), 1.08)
        place.set_yticks(range(len(parts)), [name.replace("_", " ").replace("held ", "held-") for name in parts])
        place.set_ylim(len(parts) - 0.4, -0.6)
        place.set_xlabel(head, fontsize="small")
        style.dress(place)
        place.tick_params(axis="y", length=0, labelleft=place is axes[0])
    if after is not None:
        draw_key(axes[0], across=2)
    return np.array(axes)


def _room(ax: "Axes", values: Sequence[float]) -> None:
    """Widen the abscissa so that the numbers beside the outermost dots fit, with few ticks."""
    if not values:
        return
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    low, high = min(values), max(values)
    if ax.get_xscale() == "log":
        room = (high / low) ** 0.3
        low, high = low / room, high * room
        ax.set_xlim(low, high)
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if high < 70 * low else (1.0,), numticks=4))
        ax.xaxis.set_major_formatter(lambda value, _: style.number(value))
        ax.xaxis.set_minor_formatter(NullFormatter())
        return
    room = 0.25 * ((high - low) or abs(high) or 1.0)
    ax.set_xlim(low - room, high + room)
    ax.xaxis.set_major_locator(MaxNLocator(3))
