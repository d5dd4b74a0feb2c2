"""Every panel that a diagnosis has, in one figure or one by one."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from torchcal.data import Recording
from torchcal.display import ITSELF, error_unit, units_of
from torchcal.errors import DomainError
from torchcal.plots.discovery.fits import both_fits
from torchcal.plots.discovery.hypotheses import ranking
from torchcal.plots.discovery.limits import detection_limits
from torchcal.plots.discovery.panels import panels_of
from torchcal.plots.discovery.pieces import Look, as_numbers, draw_figure_key, join_terms, plain
from torchcal.plots.discovery.proof import held_out, held_out_scores
from torchcal.plots.discovery.residuals import driver_values, joint_map, residual_map
from torchcal.plots.discovery.shifts import missing_rate, needed_shift
from torchcal.plots.selection import conditions_of

#: Letters of a name in a title, beside which there is a second one.
TITLED = 18
#: Data of a sweep along a condition, at least, and levels of one that the residuals are drawn against by choice.
SWEPT = 6


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
    units = units_of(recording, diagnosis.simulator)
    base, final = diagnosis.base, diagnosis.final
    after = final if tuple(final.terms) != tuple(base.terms) else None
    mask = diagnosis.held_out
    where = list(diagnosis.where)
    shifts = list(diagnosis.shifts)
    columns = conditions_of(recording.x, recording)
    in_time = set(columns) == {"time", "run"}
    drivers = [item.driver for item in [*where, *shifts] if item.driver in columns]
    along = None if in_time or len(columns) == 1 else next(iter(drivers), None)
    parts: list[FigurePart] = []

    def called(driver: str) -> str:
        return "time" if in_time and driver == "t" else driver

    look = Look(units, {})
    panels = panels_of(recording, as_numbers(base, "base", len(recording.y)), along, None, None, 6, look)
    if along is not None and not panels[0].joined:  # nothing to join the fits along: fitted against measured tells more
        along = None
        panels = panels_of(recording, as_numbers(base, "base", len(recording.y)), along, None, None, 6, look)
    count = len(panels)
    across = 2 if count in (2, 4) else min(count, 3)

    def fits(fig: Any) -> None:
        axes = list(fig.subplots(math.ceil(count / across), across, squeeze=False).flat)
        both_fits(recording, base, after, held_out=mask, along=along, ax=axes[:count], units=units, legend=False)
        for spare in axes[count:]:
            spare.remove()
        draw_figure_key(fig, axes[:count])

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

    best, values = None, None
    for place in where:  # the likeliest whose driver is known
        values = _driver_of(diagnosis, place.driver, final if after is not None else base)
        if values is not None:
            best = place
            break
    driver = None if best is None else best.driver
    waves = best is not None and best.period is not None
    spans = () if best is None or waves else best.spans  # a wave is everywhere
    told = {} if best is None else {"edges": best.edges, "period": best.period, "change": _change(best)}
    output = best.target if best is not None and best.target in recording.outputs else None
    if best is None:  # no place is known: where neighbours are most alike
        output, driver = _most_alike(recording, base if after is None else after, getattr(diagnosis, "set_aside", None))

    def mismatch(fig: Any) -> None:
        residual_map(
            recording, base, after, driver=driver, values=values, spans=spans, output=output, units=units,
            share=best.share if best is not None and spans else None, noise=diagnosis.noise,
            set_aside=getattr(diagnosis, "set_aside", None), ax=fig.subplots(), **told,
        )  # fmt: skip

    name, said = "Residuals", "What the models leave of the data"
    said += "." if driver is None else f", against {called(driver)}."
    if best is not None and driver is not None:
        by = plain(called(driver), TITLED, middle=True)
        name = f"Mismatch in the {best.kind} {plain(best.target, TITLED, middle=True)}, along {by}"
        name = f"Mismatch along {by}" if getattr(best, "also", ()) else name  # of several places there are too many
    if spans:
        said += (
            f" Shaded: where the {_change(best)} is largest. What that does to the output may be largest elsewhere: "
            "later, or where no calibrated parameter takes it up."
        )
    both = tuple(getattr(where[0], "together", ())) if where else ()

    def both_ways(fig: Any) -> None:
        joint_map(
            recording, base, both, output=where[0].target, noise=diagnosis.noise, units=units,
            set_aside=getattr(diagnosis, "set_aside", None), ax=fig.subplots(),
        )  # fmt: skip

    if both:
        by = " and ".join(plain(one, TITLED, middle=True) for one in both)
        said = f"What the base leaves of the data, over {' and '.join(both)}: triangles point to the side of the data."
        parts.append(FigurePart("residuals", f"Mismatch along {by} together", said, both_ways, 6.0, 3.8))
    else:
        parts.append(FigurePart("residuals", name, said, mismatch, 6.0, 3.8))

    hypotheses = list(diagnosis.ranking)
    if hypotheses:
        bars = min(len(hypotheses), 12)
        parts.append(
            FigurePart(
                "ranking",
                "Ranking of the hypotheses",
                "Log evidence against the base model, ln K, and probability among all hypotheses considered.",
                lambda fig: _ignore(
                    ranking(
                        hypotheses,
                        accepted=diagnosis.terms,
                        region=getattr(diagnosis, "settings", {}).get("region"),
                        tied=diagnosis.tied,
                        ax=fig.subplots(),
                    )
                ),
                7.0,
                max(3.2, 1.5 + 0.35 * bars),
            )
        )
    if shifts:  # of the parameter that the residuals' panel tells of, where there is one, else against its driver
        shift = min(shifts, key=lambda item: (best is None or item.parameter != best.target, item.driver != driver))
        parts.append(
            FigurePart(
                "shift",
                f"Shift that {plain(shift.parameter)} would need",
                f"The shift of {shift.parameter} that each stretch of data needs by itself, ±1 sd, against "
                f"{called(shift.driver)}. Were the base model complete, it would scatter around zero.",
                lambda fig: _ignore(needed_shift(shift, ax=fig.subplots(), units=units)),
                6.0,
                3.3,
            )
        )
    missing = diagnosis.missing
    if missing is not None:
        parts.append(
            FigurePart(
                "missing",
                "What is missing, without a formula",
                f"An estimate of what is missing, ±2 sd, as a function of {called(missing.driver)}, up to what "
                "a change of the base's own parameters does.",
                lambda fig: _ignore(missing_rate(missing, ax=fig.subplots(), units=units)),
                6.0,
                3.3,
            )
        )
    scores = (diagnosis.before, diagnosis.after)
    pair = (scores[0], scores[1] if after is not None else None)
    predicted = getattr(scores[0], "prediction", None)
    if mask is not None and predicted is not None:
        second = pair[1] if getattr(pair[1], "prediction", None) is not None else None
        names = ("base model", "accepted model" if after is None else "with " + join_terms(after.terms))
        parts.append(
            FigurePart(
                "held out",
                "Prediction of held-out data",
                "What the models, fitted without the held-out data, predict for them; of several runs, the one where "
                "the two predictions, or the one and the data, are farthest apart.",
                lambda fig: _ignore(
                    held_out(
                        recording, scores[0], second, mask, ax=fig.subplots(), along=along, names=names, units=units
                    )
                ),
                6.0,
                3.5,
            )
        )
    if None not in pair:  # without an accepted term there is nothing to compare
        unit = error_unit(recording, diagnosis.simulator)
        parts.append(
            FigurePart(
                "scores",
                "Scores before and after",
                "RMSE, mean log predictive density a datum, and share of the data in the 95 % interval, whose wanted "
                "value is dotted.",
                lambda fig: _ignore(held_out_scores(*pair, ax=fig.subplots(1, 3), unit=unit)),
                7.2,
                2.2,
            )
        )
    limits = list(diagnosis.detection_limit)
    if limits:
        parts.append(
            FigurePart(
                "limits",
                "Detection limits",
                "The smallest effect of each candidate that these data could have shown, and the estimate as a "
                "multiple of it where both are of one shape.",
                lambda fig: _ignore(detection_limits(limits, ax=fig.subplots())),
                7.0,
                max(3.2, 1.4 + 0.3 * min(len(limits), 16)),
            )
        )
    return parts


def _driver_of(diagnosis: Any, driver: str, fit: Any) -> Any:
    """A driver's values ``(n,)``: those that the diagnosis keeps, or the recording's."""
    kept = getattr(diagnosis, "drivers", None) or {}
    if driver in kept:
        return kept[driver]
    own = driver.removesuffix(ITSELF)
    return driver_values(diagnosis.recording, own, fit if own == driver else diagnosis.base)


def _most_alike(recording: Recording, fit: Any, set_aside: Any) -> tuple[str | None, str | None]:
    """The output, and the condition, along which the residuals of neighbours in a sweep are most alike.

    Each is None where there is no choice, or nothing to choose by; the condition of runs is time.
    """
    predicted = getattr(fit, "prediction", None)
    columns = conditions_of(recording.x, recording)
    in_time = set(columns) == {"time", "run"}
    if predicted is None or (len(recording.outputs) < 2 and (in_time or len(columns) < 2)):
        return None, None
    residual = recording.y - predicted
    residual = residual if set_aside is None else residual.where(~set_aside, torch.nan)
    along = [name for name, values in columns.items() if len(set(values.tolist())) >= SWEPT] or list(columns)
    along = ["time"] if in_time else along
    best: tuple[float, str | None, str | None] = (-math.inf, None, None)
    for output, part in recording.split(residual).items():
        seen = part.isfinite()
        scaled = part[seen] / part[seen].square().mean().sqrt().clamp_min(1e-300)
        at = {name: torch.as_tensor(values)[seen] for name, values in columns.items()}
        for driver in along:
            others = [values.to(torch.float64) for name, values in at.items() if name != driver]
            group = torch.zeros(len(scaled), dtype=torch.long)
            if others:
                group = torch.stack(others).unique(dim=1, return_inverse=True)[1]
            if len(group) < SWEPT * (len(group.unique())):  # no sweeps
                group = torch.zeros_like(group)
            order = at[driver].argsort(stable=True)
            order = order[group[order].argsort(stable=True)]
            pairs = group[order[1:]] == group[order[:-1]]
            alike = (scaled[order[1:]] * scaled[order[:-1]])[pairs].sum() / math.sqrt(max(int(pairs.sum()), 1))
            if float(alike) > best[0]:
                best = float(alike), output, None if in_time else driver
    return best[1:]


def _change(place: Any) -> str:
    """What is largest in the spans of a place, in words."""
    if terms := getattr(place, "terms", ()):
        return f"effect of {join_terms(terms)}"
    target = plain(place.target, TITLED, middle=True)
    run = "" if place.run is None else f" in run {place.run}"
    if place.kind == "equation":
        return f"missing rate of d{target}/dt{run}"
    return f"{'needed' if place.kind == 'parameter' else 'missing'} shift of {target}{run}"


def _ignore(_: Any) -> None:
    """The axes are of no use to the caller."""
