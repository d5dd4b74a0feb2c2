"""A diagnosis as one self-contained HTML page, to be read, printed and sent."""

import math
import os
import re
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from torchcal.display import between, error_unit, percent, unit_of, units_of, up_to, version
from torchcal.files import check_target, replacing
from torchcal.plots.discovery import FigurePart, figure_parts
from torchcal.plots.discovery.pieces import likeliest_with
from torchcal.report.markup import (
    STYLE,
    Right,
    bullets,
    drawing,
    escaped,
    figure,
    in_digits,
    in_words,
    listing,
    section,
    table,
)

__all__ = ["page", "write"]


PACKAGES = ("torchcal", "torch", "pyro-ppl", "numpy", "matplotlib")

MEANING = {
    "consistent": "no missing physics is needed",
    "named": "the data name what was left out",
    "ambiguous": "something was left out, and these data cannot tell what",
    "unexplained": "something was left out that is not in this library",
}

SETTINGS = {
    "withdrawn": "why a name was withdrawn",
    "doubt": "why there is no name",
    "depends": "what an estimate rests on",
    "unknown_beside": "beside these, something unknown is likelier than alone",
    "pliant": "all that is tied may stand for what is in no list",
    "nearly": "the name rests on the share of the misfit removed",
    "lost": "the base explains no more than a constant would",
    "unlike": "some runs, sweeps or outliers are unlike the others",
    "larger_noise": "the fastest part of the residual, beside the given noise",
    "set_aside": "these may explain the outliers",
    "interrupted": "left undone at an interruption",
    "region": "where the named term acts",
}
"""What the settings of a diagnosis are called; the others speak for themselves."""


def write(diagnosis: Any, path: str | os.PathLike[str]) -> Path:
    """Write a diagnosis as an HTML page that needs no other file, no network and no script.

    The page is written whole or not at all.

    Args:
        diagnosis: The result of ``torchcal.diagnose``, or anything with its attributes.
        path: The file; an older one is replaced. Its folder must exist.

    Returns:
        The path.

    Raises:
        DomainError: If the folder does not exist, the path is a folder, or ``diagnosis`` is none.
        OSError: If the file cannot be written.
    """
    target = check_target(path)
    text = page(diagnosis)
    with replacing(target) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="xmlcharrefreplace", newline="\n")
    return target


def _meaning(diagnosis: Any) -> str:
    """The verdict in other words, or what an interruption left undone."""
    return str(getattr(diagnosis, "settings", {}).get("interrupted") or MEANING.get(diagnosis.verdict, ""))


def page(diagnosis: Any) -> str:
    """The page's text.

    Raises:
        DomainError: If ``diagnosis`` is none.
    """
    figures = {part.key: (part, drawing(part)) for part in figure_parts(diagnosis)}
    headline = _headline(diagnosis)
    units = units_of(diagnosis.recording, diagnosis.simulator)
    body = [
        f"<h1>{escaped(headline)}</h1>",
        f'<p class="meaning">{escaped(_meaning(diagnosis))}</p>',
        f'<p class="words">{escaped(str(diagnosis))}</p>',
        _facts(diagnosis),
        listing("Equations", _get(diagnosis, "equations")),
        *_take(figures, "fits"),
        _where(diagnosis, units),
        *_take(figures, "residuals"),
        *_take(figures, "shift"),
        *_take(figures, "missing"),
        bullets("Symptoms", _get(diagnosis, "symptoms")),
        _ranking(diagnosis),
        *_take(figures, "ranking"),
        _estimates(diagnosis),
        _held_out(diagnosis),
        *_take(figures, "scores", "held out"),
        _limits(diagnosis),
        *_take(figures, "limits"),
        *_take(figures, *figures),
        _experiment(diagnosis),
        bullets("What these data cannot tell", _get(diagnosis, "identifiability")),
        _noise(diagnosis, units),
        _settings(diagnosis),
    ]
    when = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta http-equiv="Content-Security-Policy" '
            "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">",
            f"<title>{escaped(headline)}</title>",
            f"<style>{STYLE}</style>",
            "</head>",
            "<body>",
            "<main>",
            *[part for part in body if part],
            "</main>",
            f"<footer>Written by torchcal {escaped(version('torchcal'))} on {when}.</footer>",
            "</body>",
            "</html>",
            "",
        ]
    )


# --- sections --------------------------------------------------------------------------------------------------


def _headline(diagnosis: Any) -> str:
    verdict = str(diagnosis.verdict)
    terms = [str(term) for term in _get(diagnosis, "terms")]
    if verdict == "ambiguous":
        told = [(tied, likeliest_with(_get(diagnosis, "ranking"), tied)) for tied in _get(diagnosis, "tied")]
        return "Ambiguous: " + " or ".join(_where_it_acts(tied, getattr(row, "region", None)) for tied, row in told)
    if terms:
        return f"{verdict.capitalize()}: " + _where_it_acts(terms, getattr(diagnosis, "settings", {}).get("region"))
    return verdict.capitalize()


def _where_it_acts(terms: Iterable[str], region: str | None) -> str:
    return " + ".join(map(str, terms)) + (f" where {region}" if region else "")


def _facts(diagnosis: Any) -> str:
    recording = diagnosis.recording
    facts = [("data", f"{int(recording.observed_once.sum())}")]
    if _has(diagnosis, "p_detect"):
        facts.append(
            (
                "probability of so much misfit by noise alone",
                in_digits(diagnosis.p_detect, 2) if diagnosis.p_detect >= 0.001 else "<0.001",
            )
        )
    if _has(diagnosis, "confidence"):
        facts.append(("confidence", percent(diagnosis.confidence)))
    if _has(diagnosis, "remaining"):
        facts.append(("of the misfit beyond noise unexplained", percent(diagnosis.remaining)))
    before, after = getattr(diagnosis, "before", None), getattr(diagnosis, "after", None)
    old, new = (getattr(scores, "held_out", None) for scores in (before, after))
    if old is not None and new is not None and _accepted(diagnosis):
        unit = error_unit(diagnosis.recording, diagnosis.simulator).replace("spread", "of the spread")
        change = f"{in_digits(old.rmse, 3)} → {in_digits(new.rmse, 3)} {unit}".rstrip()
        facts.append(("RMSE on held-out data", change))
    cells = "".join(f"<div><dt>{escaped(name)}</dt><dd>{escaped(value)}</dd></div>" for name, value in facts)
    return f'<dl class="facts">{cells}</dl>'


def _spans(item: Any) -> str:
    """Where a location's change is large, or the period of an oscillation."""
    if item.period is not None:
        return f"everywhere, with a period of {in_digits(item.period)}"
    if item.together:
        return "both together"
    return ", ".join(between(item.spans, "…", item.extent)).replace("-", "−") or "everywhere"


def _where(diagnosis: Any, units: Mapping[str, str]) -> str:
    rows = [
        {
            "where": item.called,
            "varies with": "time" if item.driver == "t" and "time" in units else item.driver,
            "from … to": _spans(item),
            "unit": unit_of(item.driver, units),
            "share of misfit": Right(percent(item.share)),
            "log evidence": Right(in_digits(item.evidence)),
        }
        for item in _get(diagnosis, "where")
    ]
    caption = "Share of the misfit beyond noise that a change there, varying with the driver, can remove."
    return section("Where", table(rows, caption))


def _ranking(diagnosis: Any) -> str:
    chosen = set(_get(diagnosis, "terms"))
    region = getattr(diagnosis, "settings", {}).get("region")
    hypotheses = sorted(_get(diagnosis, "ranking"), key=lambda item: -_comparable(item.log_evidence))
    tied = [likeliest_with(hypotheses, terms) for terms in _get(diagnosis, "tied") if set(terms) != chosen]
    rows, marked = [], []
    for place, item in enumerate(hypotheses):
        is_chosen = bool(chosen) and set(item.terms) == chosen and item.region == region
        remarks = ["accepted"] if is_chosen else ["tied"] if any(item is other for other in tied) else []
        remarks += [] if item.physical else ["not physical"]
        remarks += [item.region] if item.region else []
        remarks += ["same as " + ", ".join(item.aliases)] if item.aliases else []
        remarks += [item.note] if item.note else []
        remarks += [] if item.refitted or not item.terms or item.terms == ("none of these",) else ["screened only"]
        if is_chosen:
            marked.append(place)
        rows.append(
            {
                "hypothesis": " + ".join(item.terms) or "base model alone",
                "log evidence": Right(in_digits(item.log_evidence)),
                "probability": Right(percent(item.probability)),
                "misfit removed": Right(percent(item.misfit_removed)),
                "held-out RMSE": Right(in_digits(item.held_out_rmse)),
                "p white": Right(in_digits(item.p_white, 2)),
                "z": Right(in_digits(item.score, 3)),
                "estimates": "; ".join(map(str, item.estimates)),
                "remarks": "; ".join(remarks),
            }
        )
    caption = (
        "Log evidence is relative to the base (natural logarithm); p white is the probability of so much structure "
        "in what is left by noise alone; z is the screening's score."
    )
    return section("Ranking", table(rows, caption, marked))


def _estimates(diagnosis: Any) -> str:
    base = {item.name: item for item in diagnosis.base.estimates}
    final = {item.name: item for item in diagnosis.final.estimates} if _accepted(diagnosis) else {}
    rows = []
    for name in [*base, *(name for name in final if name not in base)]:
        some = base.get(name) or final[name]
        row = {"parameter": name, "unit": some.unit or "", "base model": Right(_estimate(base.get(name)))}
        if final:
            row["accepted model"] = Right(_estimate(final.get(name)))
        rows.append(row)
    caption = "Value ± standard deviation, fitted to all data"
    if any(item.interval for item in final.values()):
        caption += "; the 95 % interval, by profile likelihood, where 1.96 standard deviations on either side are none"
    return section("Estimates", table(rows, f"{caption}."))


def _held_out(diagnosis: Any) -> str:
    unit = error_unit(diagnosis.recording, diagnosis.simulator)
    rows = []
    models = [("base model", getattr(diagnosis, "before", None))]
    if _accepted(diagnosis):
        models.append(("accepted model", getattr(diagnosis, "after", None)))
    for part in ("fitted", "held_out"):
        for name, scores in models:
            score = getattr(scores, part, None)
            if score is None:
                continue
            rows.append(
                {
                    "data": part.replace("_", " "),
                    "model": name,
                    f"RMSE [{unit}]" if unit else "RMSE": Right(in_digits(score.rmse)),
                    "log score": Right(in_digits(score.log_score)),
                    "coverage": Right(percent(score.coverage)),
                    "data points": Right(str(score.n)),
                    "model-error sd": Right(in_digits(getattr(scores, "model_error_sd", None))),
                }
            )
    caption = (
        "Log score: mean log predictive density. Coverage: share of the data in the 95 % predictive interval. "
        "Model-error sd: root mean square of the embedded model error over the data."
    )
    return section("Proof", table(rows, caption))


def _limits(diagnosis: Any) -> str:
    rows = [
        {
            "term": item.term,
            "parameter": item.parameter,
            "smallest": Right(in_digits(item.smallest, 2)),
            "estimate": Right(in_digits(item.estimate)),
            "unit": item.unit or "",
            "power": Right(percent(item.power)),
            "remarks": item.note,
        }
        for item in _get(diagnosis, "detection_limit")
    ]
    caption = "The smallest effect that these data would have shown, with the probability given as power."
    return section("Detection limits", table(rows, caption))


def _experiment(diagnosis: Any) -> str:
    experiment = getattr(diagnosis, "experiment", None)
    if experiment is None:
        return ""
    rows = [{"condition": str(name), "value": in_words(value)} for name, value in experiment.conditions.items()]
    distance = up_to(experiment.separation)
    text = (
        f"<p>{escaped(experiment.description)}</p><p>The two nearest hypotheses that it tells apart would differ there "
        f"by {escaped(distance)} noise sd.</p>"
    )
    for one, other in getattr(experiment, "untold", ()):
        text += f"<p>No experiment that was tried in thought tells {escaped(one)} from {escaped(other)}.</p>"
    return section("Experiment that would decide", text + table(rows))


def _noise(diagnosis: Any, units: Mapping[str, str]) -> str:
    noise = getattr(diagnosis, "noise", None)
    if noise is None:
        return ""
    known = {
        "given": "Noise sd as given.",
        "replicates": "Noise sd from replicates.",
        "estimated": "Noise sd estimated from the recording.",
        "none": "The recording was declared free of noise.",
    }
    text = known.get(noise.source, str(noise.source))
    if (times := getattr(noise, "enlarged", 1.0)) > 1:
        text = f"Noise sd given, and taken for {times:.2g} times as large, since arithmetic cannot weigh it."
    if noise.source != "given" and getattr(diagnosis, "settings", {}).get("larger_noise"):
        text += " It is larger than given."
    if noise.outliers:
        text += f" Samples set aside as outliers: {noise.outliers}."
    rows = [
        {
            "output": name,
            "sd": Right(in_digits(sd)),
            "from": Right(in_digits(noise.range.get(name, (sd, sd))[0])),
            "to": Right(in_digits(noise.range.get(name, (sd, sd))[1])),
            "unit": units.get(name, ""),
            "correlation of neighbours": Right(in_digits(noise.correlation.get(name), 2)),
            "step of quantisation": Right(in_digits(noise.quantisation.get(name))),
        }
        for name, sd in noise.sd.items()
    ]
    return section("Noise", f"<p>{escaped(text)}</p>" + table(rows))


def _settings(diagnosis: Any) -> str:
    flat = _flat(getattr(diagnosis, "settings", None) or {})
    rows = [
        {"setting": SETTINGS.get(name, name).replace("feasible.", "feasible values of "), "value": told}
        for name, value in flat.items()
        if (told := in_words(value)) not in ("", "–")  # there is nothing to tell
    ]
    known = " ".join(flat)
    rows += [
        {"setting": f"version {name}", "value": version(name)}
        for name in PACKAGES
        if not re.search(rf"\bversions?[.\s_]{re.escape(name)}", known)
    ]
    library = [str(name) for name in _get(diagnosis, "library")]
    if library:
        rows.append({"setting": f"library ({len(library)} candidates)", "value": ", ".join(library)})
    if _has(diagnosis, "seconds"):
        rows.append({"setting": "run time", "value": f"{in_digits(diagnosis.seconds, 3)} s"})
    rows.append({"setting": "recording", "value": _recording(diagnosis.recording)})
    return section("Settings", table(rows))


def _recording(recording: Any) -> str:
    runs = getattr(recording, "runs", None)
    kind = f"{len(runs)} run{'s' * (len(runs) > 1)}, {recording.n} samples" if runs else f"{recording.n} conditions"
    return f"{kind}; outputs {', '.join(recording.outputs)}; {int(recording.observed_once.sum())} data"


# --- figures ---------------------------------------------------------------------------------------------------


def _take(figures: dict[str, tuple[FigurePart, str]], *keys: str) -> list[str]:
    """These figures, each once."""
    return [figure(*figures.pop(key)) for key in keys if key in figures]


def _estimate(item: Any) -> str:
    if item is None:
        return "–"
    text = f"{in_digits(item.value)} ± {in_digits(item.sd, 2)}"
    return text + (" (at its bound)" if item.at_bound else "") + item.asymmetry


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def _get(diagnosis: Any, name: str) -> list[Any]:
    return list(getattr(diagnosis, name, None) or [])


def _has(diagnosis: Any, name: str) -> bool:
    return isinstance(getattr(diagnosis, name, None), int | float)


def _accepted(diagnosis: Any) -> bool:
    """Whether there is a model beside the base."""
    final = getattr(diagnosis, "final", None)
    return final is not None and tuple(final.terms) != tuple(diagnosis.base.terms)


def _comparable(value: float) -> float:
    return -math.inf if value is None or math.isnan(value) else value
