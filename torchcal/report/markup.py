"""Building blocks of an HTML page: text, numbers, tables and pictures."""

import base64
import html
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from torch import Tensor

from torchcal.plots.discovery import FigurePart

__all__ = [
    "STYLE", "Right", "bullets", "drawing", "escaped", "figure", "in_digits", "in_words", "listing",
    "section", "table",
]  # fmt: skip

HEAVY = 400_000
"""Bytes of a drawing above which it is stored as pixels."""

MOST_ROWS = 40
"""Rows of a table; a library has seldom more."""

SHORT = 6
"""Numbers of an array that are written out."""

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


class Right(str):
    """A cell that stands on the right."""

    __slots__ = ()


def escaped(value: Any) -> str:
    """Escaped, without the control characters that HTML forbids."""
    return html.escape(re.sub(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]", "�", str(value)))


def section(title: str, content: str) -> str:
    """A titled section; nothing where there is no content."""
    return f"<section>\n<h2>{escaped(title)}</h2>\n{content}\n</section>" if content else ""


def bullets(title: str, items: Sequence[Any]) -> str:
    """A section of points."""
    return section(title, "<ul>" + "".join(f"<li>{escaped(item)}</li>" for item in items) + "</ul>") if items else ""


def listing(title: str, items: Sequence[Any]) -> str:
    """A section of lines of code."""
    return section(title, "<pre>" + "\n".join(escaped(item) for item in items) + "</pre>") if items else ""


def table(rows: Sequence[Mapping[str, str]], caption: str = "", marked: Iterable[int] = ()) -> str:
    """Rows as a table, without the columns that are empty."""
    if not rows:
        return ""
    heads = [name for name in rows[0] if any(row[name] not in ("", "–") for row in rows)]
    right = {name for name in heads if isinstance(rows[0][name], Right)}
    lines = ['<div class="table"><table>']
    if caption:
        lines.append(f"<caption>{escaped(caption)}</caption>")
    number = ' class="number"'
    head = "".join(f'<th scope="col"{number if name in right else ""}>{escaped(name)}</th>' for name in heads)
    lines.append(f"<thead><tr>{head}</tr></thead>\n<tbody>")
    for place, row in enumerate(rows[:MOST_ROWS]):
        cells = "".join(f"<td{number if name in right else ''}>{escaped(row[name])}</td>" for name in heads)
        lines.append(f'<tr class="chosen">{cells}</tr>' if place in set(marked) else f"<tr>{cells}</tr>")
    lines.append("</tbody></table></div>")
    if len(rows) > MOST_ROWS:
        lines.append(f'<p class="note">{len(rows) - MOST_ROWS} more rows are not shown.</p>')
    return "\n".join(lines)


def in_digits(value: Any, digits: int = 4) -> str:
    """A number with so many digits."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{value:.{digits}g}".replace("-", "−")


def in_words(value: Any) -> str:
    """A setting or condition in a few words."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, float):
        return in_digits(value, 6)
    if isinstance(value, Tensor):
        numbers = value.detach().cpu().flatten().tolist()
        if len(numbers) > SHORT:
            return f"{in_words(min(numbers))} … {in_words(max(numbers))} ({len(numbers)} values)"
        return ", ".join(in_words(number) for number in numbers)
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {in_words(inner)}" for name, inner in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(in_words(item) for item in value)
    text = str(value)
    return text if len(text) <= 300 else text[:299] + "…"


def figure(part: FigurePart, source: str) -> str:
    """A drawing, by its data URI, with its caption."""
    caption = escaped(part.caption)
    title = escaped(part.name.replace(r"\$", "$"))
    return (
        f'<figure><img src="{source}" alt="{title}. {caption}">'
        f"<figcaption><strong>{title}.</strong> {caption}</figcaption></figure>"
    )


def drawing(part: FigurePart) -> str:
    """A figure as a data URI: a drawing, or pixels where that would be too heavy."""
    import matplotlib
    from matplotlib.figure import Figure

    # A figure of its own: pyplot, its current figure and the user's settings stay as they are.
    with matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "torchcal", "text.usetex": False}):
        canvas = Figure(figsize=(part.width, part.height), layout="constrained")
        part.draw(canvas)
        file = io.BytesIO()
        canvas.savefig(file, format="svg", metadata={"Date": None})
        kind = "svg+xml"
        if file.tell() > HEAVY:
            file, kind = io.BytesIO(), "png"
            canvas.savefig(file, format="png", dpi=170)
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode('ascii')}"
