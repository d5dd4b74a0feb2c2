"""The ranking of the hypotheses."""

import math
import re
import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from torchcal.display import NONE, percent
from torchcal.errors import DomainError
from torchcal.plots import style
from torchcal.plots.discovery.pieces import (
    ACCEPTED,
    LINESPACING,
    beside,
    draw_key,
    finite,
    likeliest_with,
    listed,
    signed,
    told_apart,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Letters of a hypothesis on one line; longer ones have two.
LINE = 40


def ranking(
    hypotheses: Iterable[Any],
    *,
    accepted: Sequence[str] = (),
    region: str | None = None,
    tied: Iterable[Sequence[str]] = (),
    value: str = "log_evidence",
    most: int = 12,
    ax: "Axes | None" = None,
    legend: bool = True,
) -> "Axes":
    """The hypotheses, best first, with their log evidence and probability.

    Args:
        hypotheses: Each with ``terms`` (empty for the base), ``log_evidence`` (natural logarithm, relative to the
            base), ``probability`` and ``physical``; ``region`` in words where it acts there alone.
        accepted: Terms of the accepted hypothesis.
        region: Where these act, if locally: other rows of the same terms are other hypotheses.
        tied: Each the terms of a hypothesis that the data cannot tell from the best; the likeliest of these terms is.
        value: What the bars show: ``"log_evidence"`` or ``"probability"``.
        most: Largest number of bars; the base, "none of these" and the tied ones are among them.
        ax: Where to draw; a new figure by default.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If there is no hypothesis, or one without these attributes, or ``value`` is another one.
    """
    if value not in ("log_evidence", "probability"):
        raise DomainError(f"Expected value: 'log_evidence' or 'probability'. Got {value!r}.")
    rows = listed("hypotheses", hypotheses, ("terms", "log_evidence", "probability", "physical"), ".ranking")
    rows.sort(key=lambda item: (-finite(item.probability, -1.0), -finite(item.log_evidence, -math.inf)))
    if not rows:
        raise DomainError("Expected at least one hypothesis. Got none.")
    chosen = frozenset(accepted)
    others = [likeliest_with(rows, terms) for terms in tied if frozenset(terms) != chosen]
    same = [h for h in rows if chosen and frozenset(h.terms) == chosen]
    named = [h for h in same if getattr(h, "region", None) == region] or same
    told = [*others, *(h for h in rows if not h.terms or tuple(h.terms) == NONE or frozenset(h.terms) == chosen)]
    kept = [h for h in rows if any(h is other for other in told)]
    kept += [h for h in rows if all(h is not other for other in kept)][: max(0, most - len(kept))]
    left_out = len(rows) - len(kept)
    rows = [h for h in rows if any(h is other for other in kept)]
    if ax is None:
        ax = style.new_axes(None, (6.4, 1.2 + 0.32 * len(rows)))
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
        if any(item is other for other in named):
            return "accepted"
        if not item.physical:
            return "not physical"
        return "tied" if any(item is other for other in others) else "considered"

    kinds = [kind(item) for item in rows]
    numbers = [finite(getattr(item, value), math.nan) for item in rows]
    top = max([number for number in numbers if math.isfinite(number)], default=0.0)
    # A hopeless hypothesis would squeeze all others: its bar is cut, its number is written beside it.
    floor = 0.0 if value == "probability" else -max(0.3 * top, 5.0)
    for name, options in looks.items():
        places = [i for i, other in enumerate(kinds) if other == name]
        if places:
            widths = [max(numbers[i], floor) if math.isfinite(numbers[i]) else 0.0 for i in places]
            ax.barh(places, widths, height=0.66, lw=0.7, label=name, zorder=3, **options)
    ax.axvline(0.0, color="0.25", lw=0.7, zorder=4)
    names = told_apart([_name(item) for item in rows], 2 * LINE - 6)
    ax.set_yticks(range(len(rows)), [_in_lines(name) for name in names], linespacing=LINESPACING)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    low = min([number for number in numbers if math.isfinite(number)], default=0.0)
    ax.set_xlim(max(min(low, 0.0) * 1.05, floor), max(top, 0.01) * 1.05 if value == "log_evidence" else 1.0)
    for i, item in enumerate(rows):
        beside(ax, i, 46, signed(item.log_evidence))
        beside(ax, i, 92, percent(item.probability))
    beside(ax, None, 46, "ln K")
    beside(ax, None, 92, "prob.")
    evidence = value == "log_evidence"
    notes = ["probabilities include priors"] if evidence else []
    notes += [f"{left_out} weaker ones not shown"] if left_out else []
    shown = "log evidence against the base, ln K [1]" if evidence else "probability, priors included [1]"
    ax.set_xlabel(shown + (f"\n({'; '.join(notes)})" if notes else ""))
    style.dress(ax)
    ax.tick_params(axis="y", length=0)
    if legend and len(set(kinds)) > 1:
        draw_key(ax, right=True)
    return ax


def _name(item: Any) -> str:
    """A hypothesis's terms, and where they act."""
    region = getattr(item, "region", None)
    if not item.terms:
        return "base model alone"
    return " + ".join(item.terms) + (f", {region}" if region else "")


def _in_lines(name: str) -> str:
    """A name on one line or two, broken between terms where that will do."""
    if len(name) <= LINE:
        return name
    between = [place.end() - 1 for place in re.finditer(r" \+ ", name)]
    place = min(between, key=lambda at: max(at, len(name) - at), default=0)
    if place and max(place, len(name) - place) <= LINE + 2:
        return f"{name[:place]}\n{name[place + 1 :]}"
    return textwrap.fill(name, LINE)
