"""A diagnosis as one self-contained HTML page, to be read, printed and sent."""

import base64
import contextlib
import html
import io
import math
import os
import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from torch import Tensor

from torchcal.errors import DomainError
from torchcal.plots.discovery import FigurePart, figure_parts

__all__ = ["page", "write"]

HEAVY = 400_000
"""Bytes of a drawing above which it is stored as pixels."""

MOST_ROWS = 40
"""Rows of a table; a library has seldom more."""

SHORT = 6
"""Numbers of an array that are written out."""

PACKAGES = ("torchcal", "torch", "pyro-ppl", "numpy", "matplotlib")

MEANING = {
    "consistent": "no missing physics is needed",
    "named": "the data name what was left out",
    "ambiguous": "something was left out, and these data cannot tell what",
    "unexplained": "something was left out that is not in this library",
}

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, "Segoe UI", Helvetica, Arial, sans-serif; color: #1a1a1a; background: #fff;
  max-width: 62rem; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.8rem; line-height: 1.25; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #c8c8c8; padding-bottom: .2rem; }
.meaning { color: #444; margin: 0 0 1.2rem; }
.words { white-space: pre-line; border-left: 4px solid #0b4f8a; padding: .2rem 0 .2rem 1rem; overflow-wrap: anywhere; }
dl.facts { display: flex; flex-wrap: wrap; gap: .8rem 2.2rem; margin: 1.2rem 0; }
dl.facts dt { font-size: .8rem; color: #555; }
dl.facts dd { margin: 0; font-size: 1.15rem; font-variant-numeric: tabular-nums; }
.table { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; line-height: 1.35; }
caption { text-align: left; color: #444; padding-bottom: .4rem; }
th, td { padding: .3rem .9rem .3rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid #e2e2e2; }
th { font-weight: 600; border-bottom: 1px solid #777; }
td { overflow-wrap: break-word; max-width: 22rem; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
td.number { white-space: nowrap; }
tr.chosen td { font-weight: 600; }
pre { background: #f4f4f4; padding: .7rem 1rem; white-space: pre-wrap; overflow-wrap: anywhere; }
figure { margin: 1.4rem 0; }
figure img { max-width: 100%; height: auto; }
figcaption, .note { font-size: .88rem; color: #444; }
footer { margin-top: 3rem; font-size: .8rem; color: #555; border-top: 1px solid #c8c8c8; padding-top: .5rem; }
@media print {
  @page { margin: 16mm; }
  body { font-size: 10pt; max-width: none; margin: 0; padding: 0; }
  figure, tr, dl.facts, .words { break-inside: avoid; }
  h2 { break-after: avoid; }
  .table { overflow: visible; }
  table { font-size: 7.5pt; }
  th, td { padding-right: .5rem; }
}
"""


def write(diagnosis: Any, path: str | os.PathLike[str]) -> Path:
    """Write a diagnosis as an HTML page that needs no other file, no network and no script.

    The page is written whole or not at all: to a temporary file beside it first, which is then moved into place.

    Args:
        diagnosis: The result of ``torchcal.diagnose``, or anything with its attributes.
        path: The file; an older one is replaced. Its folder must exist.

    Returns:
        The path.

    Raises:
        DomainError: If the folder does not exist, the path is a folder, or ``diagnosis`` is none.
        OSError: If the file cannot be written.
    """
    if not isinstance(path, str | os.PathLike):
        raise DomainError(f"Expected path: the name of a file. Got {type(path).__name__}.")
    target = Path(os.fspath(path))
    if target.is_dir():
        raise DomainError(f"Expected path: the name of a file. Got the folder {target} (add 'report.html').")
    if not target.absolute().parent.is_dir():
        raise DomainError(f"Expected a path in a folder that exists. Got {target} (make {target.parent} first).")
    text = page(diagnosis)
    handle, temporary = tempfile.mkstemp(suffix=".html", dir=target.absolute().parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8", errors="xmlcharrefreplace", newline="\n") as file:
            file.write(text)
        os.chmod(temporary, 0o644)
        os.replace(temporary, target)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.remove(temporary)
    return target


def page(diagnosis: Any) -> str:
    """The page's text.

    Raises:
        DomainError: If ``diagnosis`` is none.
    """
    figures = {part.key: (part, _picture(part)) for part in figure_parts(diagnosis)}
    headline = _headline(diagnosis)
    units = dict(diagnosis.recording.units)
    body = [
        f"<h1>{_text(headline)}</h1>",
        f'<p class="meaning">{_text(MEANING.get(diagnosis.verdict, ""))}</p>',
        f'<p class="words">{_text(str(diagnosis))}</p>',
        _facts(diagnosis),
        _listing("Equations", _get(diagnosis, "equations")),
        *_take(figures, "fits"),
        _where(diagnosis, units),
        *_take(figures, "residuals"),
        *_take(figures, "shift"),
        *_take(figures, "missing"),
        _bullets("Symptoms", _get(diagnosis, "symptoms")),
        _ranking(diagnosis),
        *_take(figures, "ranking"),
        _estimates(diagnosis),
        _held_out(diagnosis),
        *_take(figures, "scores", "held out"),
        _limits(diagnosis),
        *_take(figures, "limits"),
        *_take(figures, *figures),
        _experiment(diagnosis),
        _bullets("What these data cannot tell", _get(diagnosis, "identifiability")),
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
            f"<title>{_text(headline)}</title>",
            f"<style>{STYLE}</style>",
            "</head>",
            "<body>",
            "<main>",
            *[part for part in body if part],
            "</main>",
            f"<footer>Written by torchcal {_text(_version('torchcal'))} on {when}.</footer>",
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
        return "Ambiguous: " + " or ".join(" + ".join(map(str, tied)) for tied in _get(diagnosis, "tied"))
    if terms:
        return f"{verdict.capitalize()}: " + " + ".join(terms)
    return verdict.capitalize()


def _facts(diagnosis: Any) -> str:
    recording = diagnosis.recording
    facts = [("data", f"{int(recording.observed.sum())}")]
    if _has(diagnosis, "p_detect"):
        facts.append(
            (
                "probability of so much misfit by noise alone",
                _number(diagnosis.p_detect, 2) if diagnosis.p_detect else "<1e−300",
            )
        )
    if _has(diagnosis, "confidence"):
        facts.append(("confidence", _percent(diagnosis.confidence)))
    if _has(diagnosis, "remaining"):
        facts.append(("of the misfit beyond noise unexplained", _percent(diagnosis.remaining)))
    before, after = getattr(diagnosis, "before", None), getattr(diagnosis, "after", None)
    old, new = (getattr(scores, "held_out", None) for scores in (before, after))
    if old is not None and new is not None and _accepted(diagnosis):
        unit = _rmse_unit(diagnosis) or " of the spread"
        facts.append(("RMSE on held-out data", f"{_number(old.rmse, 3)} → {_number(new.rmse, 3)}{unit}"))
    cells = "".join(f"<div><dt>{_text(name)}</dt><dd>{_text(value)}</dd></div>" for name, value in facts)
    return f'<dl class="facts">{cells}</dl>'


def _where(diagnosis: Any, units: Mapping[str, str]) -> str:
    rows = [
        {
            "where": f"{item.kind} {item.target}",
            "varies with": "time" if item.driver == "t" and "time" in units else item.driver,
            "from … to": ", ".join(f"{_number(low)} … {_number(high)}" for low, high in item.spans) or "everywhere",
            "unit": _unit(units, item.driver),
            "share of misfit": _Right(_percent(item.share)),
            "log evidence": _Right(_number(item.evidence)),
        }
        for item in _get(diagnosis, "where")
    ]
    caption = "Share of the misfit beyond noise that a change there, varying with the driver, can remove."
    return _section("Where", _table(rows, caption))


def _ranking(diagnosis: Any) -> str:
    chosen = set(_get(diagnosis, "terms"))
    tied = {frozenset(terms) for terms in _get(diagnosis, "tied")}
    hypotheses = sorted(_get(diagnosis, "ranking"), key=lambda item: -_comparable(item.log_evidence))
    rows, marked = [], []
    for place, item in enumerate(hypotheses):
        is_chosen = bool(chosen) and set(item.terms) == chosen
        remarks = ["accepted"] if is_chosen else ["tied"] if frozenset(item.terms) in tied else []
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
                "log evidence": _Right(_number(item.log_evidence)),
                "probability": _Right(_percent(item.probability)),
                "misfit removed": _Right(_percent(item.misfit_removed)),
                "held-out RMSE": _Right(_number(item.held_out_rmse)),
                "p white": _Right(_number(item.p_white, 2)),
                "z": _Right(_number(item.score, 3)),
                "estimates": "; ".join(map(str, item.estimates)),
                "remarks": "; ".join(remarks),
            }
        )
    caption = (
        "Log evidence is relative to the base (natural logarithm); p white is the probability of so much structure "
        "in what is left by noise alone; z is the screening's score."
    )
    return _section("Ranking", _table(rows, caption, marked))


def _estimates(diagnosis: Any) -> str:
    base = {item.name: item for item in diagnosis.base.estimates}
    final = {item.name: item for item in diagnosis.final.estimates} if _accepted(diagnosis) else {}
    rows = []
    for name in [*base, *(name for name in final if name not in base)]:
        some = base.get(name) or final[name]
        row = {"parameter": name, "unit": some.unit or "", "base model": _Right(_estimate(base.get(name)))}
        if final:
            row["accepted model"] = _Right(_estimate(final.get(name)))
        rows.append(row)
    return _section("Estimates", _table(rows, "Value ± standard deviation, fitted to all data."))


def _held_out(diagnosis: Any) -> str:
    unit = _rmse_unit(diagnosis).strip()
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
                    f"RMSE [{unit}]" if unit else "RMSE [spread]": _Right(_number(score.rmse)),
                    "log score": _Right(_number(score.log_score)),
                    "coverage": _Right(_percent(score.coverage)),
                    "data points": _Right(str(score.n)),
                    "model-error sd": _Right(_number(getattr(scores, "model_error_sd", None))),
                }
            )
    caption = (
        "Log score: mean log predictive density. Coverage: share of the data in the 95 % predictive interval. "
        "Model-error sd: root mean square of the embedded model error over the data."
    )
    return _section("Proof", _table(rows, caption))


def _limits(diagnosis: Any) -> str:
    rows = [
        {
            "term": item.term,
            "parameter": item.parameter,
            "smallest": _Right(_number(item.smallest, 2)),
            "estimate": _Right(_number(item.estimate)),
            "unit": item.unit or "",
            "power": _Right(_percent(item.power)),
            "remarks": item.note,
        }
        for item in _get(diagnosis, "detection_limit")
    ]
    caption = "The smallest effect that these data would have shown, with the probability given as power."
    return _section("Detection limits", _table(rows, caption))


def _experiment(diagnosis: Any) -> str:
    experiment = getattr(diagnosis, "experiment", None)
    if experiment is None:
        return ""
    rows = [{"condition": str(name), "value": _value(value)} for name, value in experiment.conditions.items()]
    text = (
        f"<p>{_text(experiment.description)}</p><p>The two nearest hypotheses would differ there by "
        f"{_text(_number(experiment.separation, 3))} noise sd.</p>"
    )
    return _section("Experiment that would decide", text + _table(rows))


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
    if noise.outliers:
        text += f" Samples set aside as outliers: {noise.outliers}."
    rows = [
        {
            "output": name,
            "sd": _Right(_number(sd)),
            "unit": units.get(name, ""),
            "correlation of neighbours": _Right(_number(noise.correlation.get(name), 2)),
            "step of quantisation": _Right(_number(noise.quantisation.get(name))),
        }
        for name, sd in noise.sd.items()
    ]
    return _section("Noise", f"<p>{_text(text)}</p>" + _table(rows))


def _settings(diagnosis: Any) -> str:
    flat = _flat(getattr(diagnosis, "settings", None) or {})
    rows = [{"setting": name, "value": _value(value)} for name, value in flat.items()]
    known = " ".join(flat)
    rows += [
        {"setting": f"version {name}", "value": _version(name)}
        for name in PACKAGES
        if not re.search(rf"\bversions?[.\s_]{re.escape(name)}", known)
    ]
    library = [str(name) for name in _get(diagnosis, "library")]
    if library:
        rows.append({"setting": f"library ({len(library)} candidates)", "value": ", ".join(library)})
    if _has(diagnosis, "seconds"):
        rows.append({"setting": "run time", "value": f"{_number(diagnosis.seconds, 3)} s"})
    rows.append({"setting": "recording", "value": _recording(diagnosis.recording)})
    return _section("Settings", _table(rows))


def _recording(recording: Any) -> str:
    runs = getattr(recording, "runs", None)
    kind = f"{len(runs)} run{'s' * (len(runs) > 1)}, {recording.n} samples" if runs else f"{recording.n} conditions"
    return f"{kind}; outputs {', '.join(recording.outputs)}; {int(recording.observed.sum())} data"


# --- figures ---------------------------------------------------------------------------------------------------


def _take(figures: dict[str, tuple[FigurePart, str]], *keys: str) -> list[str]:
    """These figures, each once."""
    return [_figure(*figures.pop(key)) for key in keys if key in figures]


def _figure(part: FigurePart, source: str) -> str:
    caption = _text(part.caption)
    title = _text(part.name.replace(r"\$", "$"))
    return (
        f'<figure><img src="{source}" alt="{title}. {caption}">'
        f"<figcaption><strong>{title}.</strong> {caption}</figcaption></figure>"
    )


def _picture(part: FigurePart) -> str:
    """A figure as a data URI: a drawing, or pixels where that would be too heavy."""
    import matplotlib
    from matplotlib.figure import Figure

    # A figure of its own: pyplot, its current figure and the user's settings stay as they are.
    with matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "torchcal", "text.usetex": False}):
        figure = Figure(figsize=(part.width, part.height), layout="constrained")
        part.draw(figure)
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None})
        kind = "svg+xml"
        if file.tell() > HEAVY:
            file, kind = io.BytesIO(), "png"
            figure.savefig(file, format="png", dpi=170)
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


# --- text ------------------------------------------------------------------------------------------------------


class _Right(str):
    """A cell that stands on the right."""

    __slots__ = ()


def _text(value: Any) -> str:
    """Escaped, without the control characters that HTML forbids."""
    return html.escape(re.sub(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]", "�", str(value)))


def _section(title: str, content: str) -> str:
    return f"<section>\n<h2>{_text(title)}</h2>\n{content}\n</section>" if content else ""


def _bullets(title: str, items: Sequence[Any]) -> str:
    return _section(title, "<ul>" + "".join(f"<li>{_text(item)}</li>" for item in items) + "</ul>") if items else ""


def _listing(title: str, items: Sequence[Any]) -> str:
    return _section(title, "<pre>" + "\n".join(_text(item) for item in items) + "</pre>") if items else ""


def _table(rows: Sequence[Mapping[str, str]], caption: str = "", marked: Iterable[int] = ()) -> str:
    """Rows as a table, without the columns that are empty."""
    if not rows:
        return ""
    heads = [name for name in rows[0] if any(row[name] not in ("", "–") for row in rows)]
    right = {name for name in heads if isinstance(rows[0][name], _Right)}
    lines = ['<div class="table"><table>']
    if caption:
        lines.append(f"<caption>{_text(caption)}</caption>")
    number = ' class="number"'
    head = "".join(f'<th scope="col"{number if name in right else ""}>{_text(name)}</th>' for name in heads)
    lines.append(f"<thead><tr>{head}</tr></thead>\n<tbody>")
    for place, row in enumerate(rows[:MOST_ROWS]):
        cells = "".join(f"<td{number if name in right else ''}>{_text(row[name])}</td>" for name in heads)
        lines.append(f'<tr class="chosen">{cells}</tr>' if place in set(marked) else f"<tr>{cells}</tr>")
    lines.append("</tbody></table></div>")
    if len(rows) > MOST_ROWS:
        lines.append(f'<p class="note">{len(rows) - MOST_ROWS} more rows are not shown.</p>')
    return "\n".join(lines)


def _number(value: Any, digits: int = 4) -> str:
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{value:.{digits}g}".replace("-", "−")


def _percent(value: Any) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    if 0 < value < 0.001:
        return "<0.1 %"
    if 0.999 < value < 1:
        return ">99.9 %"
    return f"{100 * value:.1f} %".replace("-", "−")


def _estimate(item: Any) -> str:
    if item is None:
        return "–"
    text = f"{_number(item.value)} ± {_number(item.sd, 2)}"
    return text + (" (at its bound)" if item.at_bound else "")


def _value(value: Any) -> str:
    """A setting or condition in a few words."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, float):
        return _number(value, 6)
    if isinstance(value, Tensor):
        numbers = value.detach().cpu().flatten().tolist()
        if len(numbers) > SHORT:
            return f"{_value(min(numbers))} … {_value(max(numbers))} ({len(numbers)} values)"
        return ", ".join(_value(number) for number in numbers)
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {_value(inner)}" for name, inner in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_value(item) for item in value)
    text = str(value)
    return text if len(text) <= 300 else text[:299] + "…"


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def _get(diagnosis: Any, name: str) -> list[Any]:
    return list(getattr(diagnosis, name, None) or [])


def _has(diagnosis: Any, name: str) -> bool:
    return isinstance(getattr(diagnosis, name, None), int | float)


def _accepted(diagnosis: Any) -> bool:
    """Whether there is a model beside the base."""
    final = getattr(diagnosis, "final", None)
    return final is not None and tuple(final.terms) != tuple(diagnosis.base.terms)


def _rmse_unit(diagnosis: Any) -> str:
    recording = diagnosis.recording
    unit = recording.units.get(recording.outputs[0]) if len(recording.outputs) == 1 else None
    return f" {unit}" if unit else ""


def _unit(units: Mapping[str, str], name: str) -> str:
    return units.get(name) or (units.get("time", "") if name == "t" else "")


def _comparable(value: float) -> float:
    return -math.inf if value is None or math.isnan(value) else value
