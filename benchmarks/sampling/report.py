"""The table and the figures of a finished benchmark."""

import math
import platform
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.sampling.judge import CONVERGED, Quality
from benchmarks.sampling.samplers import SAMPLERS

Row = dict[str, Any]
OURS = "torchcal"
COLOURS = {"torchcal": "#0b4f8a", "pyro": "#e07b00", "numpyro": "#009e73", "pytuq": "#7a3b00", "emcee": "#cc79a7"}
MARKERS = ("o", "s", "^", "D", "v")
WRONG = 4.0
"""Error of a mean, in units of the Monte-Carlo error of both runs, from which on it counts as wrong."""


# --- words -----------------------------------------------------------------------------------------------------


def line(row: Row) -> str:
    """One row, for the console."""
    head = f"{row['key']}: "
    if "failed" in row:
        return head + f"failed: {row['failed']}"
    times = ", ".join(f"{goal} in {_seconds(found)} s" for goal, found in row["times"].items())
    return head + f"{times}; {row['rate']:.3g} a second; R-hat {row['r_hat']:.4f}"


def markdown(
    settings: Any, rows: list[Row], growth: list[Row], facts: dict[str, Row], references: dict[str, Quality | None]
) -> str:
    """The tables of all posteriors, and the growth."""
    few, many = settings.goals[0], settings.goals[-1]
    parts = [
        f"{platform.machine()}, {settings.threads} threads a process; seconds from cold after imports to {few:,} and "
        f"{many:,} effective samples of the worst α, optimisation, compilation and warm-up included. ~: extrapolated "
        f"from the steady rate after {settings.limit:g} s. Ratio: to torchcal's time. Converged: seconds until there "
        f"are {few:,} and every R-hat is below {CONVERGED}. Errors: the largest of any α, in "
        "posterior sd, of the mean against the reference; in brackets what Monte-Carlo error of both runs makes "
        f"likely for one α. Bold where it is {WRONG:g} times that or more, or R-hat is {CONVERGED} or more.\n"
    ]
    for name, about in facts.items():
        mine = [row for row in rows if row["posterior"] == name]
        parts.append(f"\n### {about['title']}\n\n{_about(about, references[name])}\n\n{_table(mine, few, many)}")
    if growth:
        parts.append(f"\n### Growth\n\n{_growth_table(growth)}")
    return "\n".join(parts)


def _about(facts: Row, reference: Quality | None) -> str:
    charged = min(facts["torchcal_seconds"], facts["search_seconds"]) if facts["search_found_it"] else None
    search = (
        f"SciPy's search finds the maximum in {facts['search_seconds']:.2g} s"
        if facts["search_found_it"]
        else f"SciPy's search misses the maximum, in {facts['search_seconds']:.2g} s"
    )
    text = (
        f"{facts['P']} α of {facts['d']} parameters, {facts['N']} data, {facts['nodes']} nodes. torchcal finds the "
        f"maximum in {facts['torchcal_seconds']:.2g} s; {search}. Samplers that start from it are charged "
        f"{facts['torchcal_seconds'] if charged is None else charged:.2g} s."
    )
    if reference is not None:
        text += (
            f" Reference: {reference.worst:,.0f} effective samples, R-hat {float(reference.r_hat.max()):.4f}; its own "
            f"error is {1 / math.sqrt(reference.worst):.2g} sd."
        )
    return text


def _table(rows: list[Row], few: int, many: int) -> str:
    head = ["sampler", f"{few:,}", "ratio", "converged", f"{many:,}", "ratio", "ESS/s", "R-hat", "error", "of sd"]
    head += ["MiB", "chains"]
    lines = [_cells(head), _cells(["---"] * len(head))]
    ours = next((row for row in rows if row["sampler"] == OURS and "times" in row), None)
    for row in rows:
        if "failed" in row:
            lines.append(_cells([row["sampler"], row["failed"], *[""] * (len(head) - 2)]))
            continue
        cells = [row["sampler"]]
        for goal in (few, many):
            found = row["times"].get(str(goal), {})
            cells += [_seconds(found), _ratio(found, ours, goal)]
            if goal == few:
                cells += [_seconds({"seconds": found.get("converged", math.nan)})]
        cells += [f"{row['rate']:,.3g}" if row["rate"] < 1000 else f"{row['rate']:,.0f}"]
        cells += [_bold(f"{row['r_hat']:.4f}", not row["r_hat"] < CONVERGED), *_errors(row)]
        cells += [f"{row['memory'] / 2**20:.0f}", f"{row['chains']}"]
        lines.append(_cells(cells))
    return "\n".join(lines) + "\n"


def _errors(row: Row) -> list[str]:
    if "error_mean" not in row:
        return ["–", "–"]
    wrong = not row["z"] < WRONG
    return [_bold(f"{row['error_mean']:.3f} ({row['expected_error']:.3f})", wrong), f"{row['error_sd']:.3f}"]


def _growth_table(growth: list[Row]) -> str:
    goals = list(next((row["times"] for row in growth if "times" in row), {}))
    head = ["what grows", "size", "sampler", *(f"{int(goal):,}" for goal in goals), "ESS/s", "R-hat"]
    lines = [_cells(head), _cells(["---"] * len(head))]
    for row in sorted(growth, key=lambda row: (_axis(row), row["sampler"])):
        axis, size = _axis(row)
        cells = [axis, str(size), row["sampler"]]
        if "failed" in row:
            cells += [row["failed"], *[""] * (len(goals) + 1)]
        else:
            cells += [_seconds(row["times"].get(goal, {})) for goal in goals]
            cells += [f"{row['rate']:,.0f}", _bold(f"{row['r_hat']:.4f}", not row["r_hat"] < CONVERGED)]
        lines.append(_cells(cells))
    return "\n".join(lines) + "\n"


def _axis(row: Row) -> tuple[str, int]:
    _, axis, size = row["key"].split("__")[0].split("-")
    return axis, int(size)


def _cells(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _bold(text: str, really: bool) -> str:
    return f"**{text}**" if really else text


def _seconds(found: Row) -> str:
    seconds = found.get("seconds", math.nan)
    if not math.isfinite(seconds):
        return "–"
    text = f"{seconds:.2f}" if seconds < 100 else f"{seconds:,.0f}"
    return ("~" if found.get("extrapolated") else "") + text


def _ratio(found: Row, ours: Row | None, goal: int) -> str:
    mine = math.nan if ours is None else ours["times"].get(str(goal), {}).get("seconds", math.nan)
    ratio = found.get("seconds", math.nan) / mine
    if not math.isfinite(ratio):
        return "–"
    return f"{ratio:.2f}" if ratio < 10 else f"{ratio:,.0f}"


# --- figures ---------------------------------------------------------------------------------------------------


def draw(settings: Any, rows: list[Row], growth: list[Row], folder: Path) -> None:
    """``times.png`` and, where there are rows for it, ``growth.png``."""
    import matplotlib.pyplot as plt

    if any("times" in row for row in rows):
        figure = _times(plt, settings, rows)
        figure.savefig(folder / "times.png", dpi=150)
        plt.close(figure)
    if any("times" in row for row in growth):
        figure = _growth(plt, growth)
        figure.savefig(folder / "growth.png", dpi=150)
        plt.close(figure)


def _times(plt: Any, settings: Any, rows: list[Row]) -> Any:
    goals = list(dict.fromkeys((settings.goals[0], settings.goals[-1])))
    posteriors = list(dict.fromkeys(row["posterior"] for row in rows))
    samplers = [name for name in SAMPLERS if any(row["sampler"] == name and "times" in row for row in rows)]
    size = (11.0, 1.4 + 0.55 * len(posteriors) * max(1.0, len(samplers) / 8))
    figure, axes = plt.subplots(1, len(goals), figsize=size, sharey=True, layout="constrained")
    for ax, goal in zip(np.atleast_1d(axes), goals, strict=True):
        for i, sampler in enumerate(samplers):
            family, style = _style(sampler)
            for row in rows:
                found = row.get("times", {}).get(str(goal))
                if row["sampler"] != sampler or not found or not math.isfinite(found["seconds"]):
                    continue
                place = posteriors.index(row["posterior"]) + 0.8 * ((i + 0.5) / len(samplers) - 0.5)
                face = "white" if found["extrapolated"] else COLOURS[family]
                ax.plot(found["seconds"], place, style, color=COLOURS[family], mfc=face, ms=5)
        for k in range(1, len(posteriors)):
            ax.axhline(k - 0.5, color="0.85", lw=0.6)
        ax.set_xscale("log")
        ax.grid(axis="x", color="0.9", lw=0.6)
        ax.set_axisbelow(True)
        ax.set_xlabel(f"time to {goal:,} effective samples (s)")
        ax.set_yticks(range(len(posteriors)), posteriors)
    first = np.atleast_1d(axes)[0]
    first.set_ylim(len(posteriors) - 0.5, -0.5)
    first.set_ylabel("posterior")
    marks = [
        plt.Line2D([], [], ls="", marker=_style(name)[1], color=COLOURS[_style(name)[0]], label=name)
        for name in samplers
    ]
    marks.append(plt.Line2D([], [], ls="", marker="o", color="0.4", mfc="white", label="extrapolated"))
    figure.legend(handles=marks, loc="outside lower center", ncols=min(5, len(marks)), fontsize="small", frameon=False)
    return figure


def _growth(plt: Any, growth: list[Row]) -> Any:
    titles = {"N": "number of data", "d": "number of parameters", "order": "order of the output", "chains": "chains"}
    figure, axes = plt.subplots(1, len(titles), figsize=(12.0, 3.6), layout="constrained")
    for ax, (axis, title) in zip(axes, titles.items(), strict=True):
        mine = sorted((row for row in growth if _axis(row)[0] == axis and "times" in row), key=lambda r: _axis(r)[1])
        for sampler in dict.fromkeys(row["sampler"] for row in mine):
            picked = [row for row in mine if row["sampler"] == sampler]
            for goal, dash in zip(picked[0]["times"], ("--", "-"), strict=False):
                points = [(_axis(row)[1], row["times"][goal]["seconds"]) for row in picked if goal in row["times"]]
                look = {"marker": "o", "ms": 3, "color": COLOURS[_style(sampler)[0]]}
                ax.plot(*zip(*points, strict=True), dash, label=f"{sampler}, {int(goal):,}", **look)
        ax.set_yscale("log")
        if axis in ("N", "chains"):
            ax.set_xscale("log")
        sizes = sorted({_axis(row)[1] for row in mine})
        ax.set_xticks(sizes, [str(size) for size in sizes])
        ax.xaxis.set_minor_locator(plt.NullLocator())
        ax.set_xlabel(title)
        ax.grid(color="0.9", lw=0.6)
    axes[0].set_ylabel("time to effective samples (s)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize="small", frameon=False)
    return figure


def _style(sampler: str) -> tuple[str, str]:
    family = sampler.split("-")[0]
    relatives = [name for name in SAMPLERS if name.split("-")[0] == family]
    return family, MARKERS[relatives.index(sampler) % len(MARKERS)]
