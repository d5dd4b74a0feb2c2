"""Which outputs, runs and conditions of a recording make a panel, and how the two models are drawn in it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchcal.checks import whole
from torchcal.data import Recording
from torchcal.errors import DomainError
from torchcal.plots.discovery.pieces import ACCEPTED, BASE, DASHES, Look, as_numbers, join_terms, places_of, rms
from torchcal.plots.selection import conditions_of


@dataclass(frozen=True)
class Curve:
    """One model's outputs, and how they are drawn."""

    values: np.ndarray
    name: str
    color: str
    line: Any
    marker: str
    face: str
    zorder: float


@dataclass(frozen=True)
class Panel:
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


def curves_of(recording: Recording, before: Any, after: Any, names: tuple[str, str] | None) -> list[Curve]:
    """The base's fit and, where there is one, the accepted model's."""
    given = [as_numbers(before, "before", len(recording.y))]
    if after is not None:
        given.append(as_numbers(after, "after", len(recording.y)))
    if names is None:
        terms = tuple(getattr(after, "terms", ()))
        names = ("base model", "with " + join_terms(terms) if terms else "accepted model")
    looks = (
        Curve(given[0], names[0], BASE, DASHES, "s", "none", 6),
        Curve(given[-1], names[1], ACCEPTED, "-", "o", ACCEPTED, 5),
    )
    return list(looks[: len(given)])


def panels_of(
    recording: Recording,
    fitted: np.ndarray,
    along: str | None,
    output: str | None,
    run: int | None,
    most: int,
    look: Look,
) -> list[Panel]:
    """The panels of a recording, ``most`` at most."""
    columns, n = conditions_of(recording.x, recording), recording.n
    if output is not None and output not in recording.outputs:
        raise DomainError(f"Expected output among {list(recording.outputs)}. Got {output!r} (check the spelling).")
    most = whole("most", most, 1, advice="the number of panels")
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
        size = {name: rms(residual[places_of(recording, name)]) for name in outputs}
        worst = sorted(outputs, key=lambda name: -size[name])[:most]
        outputs = [name for name in outputs if name in worst]
    groups: list[tuple[np.ndarray, str]] = [(np.arange(n), "")]
    joined = True
    others = [name for name in columns if name != along]
    if along is not None and others:
        if run is None:
            groups = groups_of(columns, others, look)
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
                panels.append(Panel(name, start + rows, None, "", False, title))
                continue
            order = rows[np.argsort(columns[along][rows], kind="stable")]
            panels.append(Panel(name, start + order, columns[along][order], along, joined, title))
    return panels


def groups_of(columns: Mapping[str, np.ndarray], others: Sequence[str], look: Look) -> list[tuple[np.ndarray, str]]:
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
