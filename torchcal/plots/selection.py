"""Which predicted and recorded values go on an axes: one output along one condition."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.errors import DomainError, ShapeError
from torchcal.plots.style import array, label, number

__all__ = ["View", "close", "conditions_of", "output_part", "select"]


@dataclass(frozen=True)
class View:
    """One output along one condition.

    Attributes:
        x: The drawn condition of the prediction, ascending, ``(m,)``.
        rows: Numbers of the predicted conditions drawn, in that order, ``(m,)``.
        places: Numbers of the predicted values drawn, among all outputs, ``(m,)``.
        data_x: The drawn condition of the observed data, ``(k,)``.
        data_y: The observed data, ``(k,)``.
        data_noise: Their noise sd, ``(k,)``, or None.
        x_label: Label of the condition.
        y_label: Label of the output.
        y_name: Name of the output as shown.
        unit: Its unit, or None.
        title: The conditions that are held, in words; empty where there are none.
    """

    x: np.ndarray
    rows: np.ndarray
    places: np.ndarray
    data_x: np.ndarray
    data_y: np.ndarray
    data_noise: np.ndarray | None
    x_label: str
    y_label: str
    y_name: str
    unit: str | None
    title: str

    def take(self, values: Tensor) -> np.ndarray:
        """The drawn ones of predicted values ``(n_total,)``."""
        return array(values, "the prediction", 1)[self.places]


def close(values: np.ndarray, target: float) -> np.ndarray:
    """Where values equal a target up to a millionth of itself, and of their range where they differ."""
    span = float(np.ptp(values)) if len(values) else 0.0
    few = 1e-6 * min(abs(target), span or abs(target))  # of a clock, and of what spans decades
    return np.isclose(values, target, rtol=8 * np.finfo(float).eps, atol=max(few, 1e-9 * span))


def conditions_of(x: Any, recording: Recording | None) -> dict[str, np.ndarray]:
    """Conditions by name, ``(n,)`` each."""
    if not isinstance(x, Mapping):
        names = recording.conditions if recording is not None else ("x",)
        if len(names) != 1:
            raise ShapeError(
                f"Expected a prediction at conditions {list(names)}, as the recording's. Got one array without a "
                "name (predict at a dict of conditions)."
            )
        x = {names[0]: x}
    columns = {name: array(values, f"condition {name!r}", 1) for name, values in x.items()}
    lengths = {len(values) for values in columns.values()}
    if len(lengths) != 1:
        raise ShapeError(f"Expected conditions of one length. Got lengths {sorted(lengths)}.")
    return columns


def output_part(total: int, n: int, recording: Recording | None, output: str | int | None) -> tuple[int, str]:
    """Number and name of the output to draw, of predicted values ``(total,)`` at n conditions."""
    if total % n or total == 0:
        raise ShapeError(f"Expected predicted values for {n} conditions, or a multiple of it. Got {total}.")
    count = total // n
    if recording is not None and count != len(recording.outputs):
        raise ShapeError(
            f"Expected a prediction of the recording's outputs {list(recording.outputs)}. Got {count} value(s) for "
            "each condition (leave recording= out for another quantity, and give units=)."
        )
    names = recording.outputs if recording is not None else tuple(str(i) for i in range(count))
    if output is None:
        if count > 1:
            raise DomainError(f"Expected output=: one of {list(names)}. Got none (a figure shows one output).")
        return 0, names[0] if recording is not None else "y"
    if isinstance(output, str):
        if output in names:
            return names.index(output), output
        if recording is None and count == 1:
            return 0, output
        raise DomainError(f"Expected output among {list(names)}. Got {output!r} (check the spelling).")
    if isinstance(output, bool) or not isinstance(output, int) or not 0 <= output < count:
        raise DomainError(f"Expected output as a name or a number from 0 to {count - 1}. Got {output!r}.")
    return output, names[output]


def select(
    x: Any,
    total: int,
    recording: Recording | None,
    *,
    x_name: str | None,
    output: str | int | None,
    where: Any,
    units: Mapping[str, str] | None,
    labels: Mapping[str, str] | None,
    by: str | None = None,
) -> View:
    """Choose what to draw.

    Args:
        x: The prediction's conditions.
        total: Number of predicted values, all outputs.
        recording: The data, or None.
        x_name: The condition on the axis; may be left out where one alone is not held by ``where``, and for time.
        output: The output, by name or number; may be left out where there is one.
        where: ``{condition: value}`` to hold others; or a mask, slice or numbers of the conditions.
        units: Units beside the recording's.
        labels: How to show names.
        by: A condition that may vary all the same.

    Raises:
        DomainError: If a name or value does not exist, or the choice leaves more than one curve.
        ShapeError: If sizes disagree.
    """
    columns = conditions_of(x, recording)
    n = len(next(iter(columns.values())))
    place, name = output_part(total, n, recording, output)
    held = dict(where) if isinstance(where, Mapping) else {}
    for key in [*held, *([] if x_name is None else [x_name]), *([] if by is None else [by])]:
        if key not in columns:
            raise DomainError(f"Expected a condition among {list(columns)}. Got {key!r} (check the spelling).")
    left = [key for key in columns if key not in held and key != by]
    if x_name is None and "time" in left and recording is not None and recording.runs is not None:
        x_name = "time"
    if x_name is None:
        if len(left) != 1:
            raise DomainError(
                f"Expected x_name=: the condition on the axis, one of {list(columns)}. Got none (name it, and hold "
                "the others with where={name: value})."
            )
        x_name = left[0]

    rows = _chosen(columns, n, where, "the prediction")
    if not len(rows):
        key, value = (
            next((k, v) for k, v in held.items() if not close(columns[k], float(v)).any())
            if any(not close(columns[k], float(v)).any() for k, v in held.items())
            else ("where", where)
        )
        known = np.unique(columns[key])[:12].tolist() if key in columns else "none"
        raise DomainError(f"Expected where to choose predicted conditions. Got {key}={value!r}; there are {known}.")
    for key in left:
        if key != x_name and not close(columns[key][rows], columns[key][rows[0]]).all():
            values = np.unique(columns[key][rows])
            raise DomainError(
                f"Expected one value of {key!r} along the curve. Got {len(values)}, from {values[0]:g} to "
                f"{values[-1]:g} (hold it with where={{{key!r}: value}}, or choose with a mask)."
            )
    rows = rows[np.argsort(columns[x_name][rows], kind="stable")]

    data_x = data_y = np.empty(0)
    noise = None
    if recording is not None:
        recorded = conditions_of(recording.x, recording)
        if set(recorded) != set(columns):
            raise ShapeError(
                f"Expected a prediction at the recording's conditions {list(recorded)}. Got {list(columns)}."
            )
        if where is not None and not held and recording.n != n:
            raise ShapeError(
                f"Expected a prediction at the recording's {recording.n} conditions where a mask chooses. Got {n} "
                "(choose with where={condition: value})."
            )
        keep = _chosen(recorded, recording.n, where, "the recording")
        part = slice(place * recording.n, (place + 1) * recording.n)
        keep = keep[recording.observed[part].cpu().numpy()[keep]]
        data_x, data_y = recorded[x_name][keep], recording.y[part].cpu().numpy()[keep]
        if recording.noise_sd is not None:
            noise = recording.noise_sd[part].cpu().numpy()[keep]
    known_units = {**(recording.units if recording is not None else {}), **(units or {})}
    title = ", ".join(
        f"{(labels or {}).get(key, key)} = {number(float(value))}"
        + (f" {known_units[key]}" if key in known_units else "")
        for key, value in held.items()
    )
    return View(
        x=columns[x_name][rows],
        rows=rows,
        places=place * n + rows,
        data_x=data_x,
        data_y=data_y,
        data_noise=noise,
        x_label=label(x_name, known_units, labels),
        y_label=label(name, known_units, labels),
        y_name=label(name, None, labels),
        unit=known_units.get(name),
        title=title,
    )


def _chosen(columns: dict[str, np.ndarray], n: int, where: Any, what: str) -> np.ndarray:
    """Numbers of the conditions that ``where`` chooses."""
    if where is None:
        return np.arange(n)
    if isinstance(where, Mapping):
        keep = np.ones(n, dtype=bool)
        for key, value in where.items():
            keep &= close(columns[key], float(value))
        return np.flatnonzero(keep)
    if isinstance(where, Tensor):
        where = where.detach().cpu().numpy()
    try:
        chosen = np.arange(n)[where if isinstance(where, slice) else torch.as_tensor(where).numpy()]
    except (IndexError, TypeError, ValueError, RuntimeError) as error:
        raise ShapeError(
            f"Expected where: a dict, a slice, a mask of shape ({n},) or numbers of conditions of {what}. Got: {error}."
        ) from error
    return np.atleast_1d(chosen)
