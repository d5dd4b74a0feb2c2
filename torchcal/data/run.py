"""Runs: one experiment recorded in time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchcal.checks import by_default_on_cpu
from torchcal.data.arrays import check_finite, is_quantity, to_tensor, value_range
from torchcal.data.frames import check_columns, column_names
from torchcal.data.interpolation import HOLDS, evaluate_pieces, pieces
from torchcal.errors import DomainError, RecordingError, ShapeError

__all__ = ["SEVERAL", "Run", "change", "convert", "fingerprint", "together"]

RESERVED = ("time", "run", "t")
"""Names that a recording in time has for itself."""

SEVERAL = 5
"""Fewest samples, or rows of a table, that are known to have been read twice."""

OUTSIDE = 1e-12
"""How far outside the span a time counts as its end, as share of the largest time: a few roundings."""


@dataclass(frozen=True, init=False, repr=False, eq=False)
class Run:
    """One experiment in time: when samples were taken, what was measured, what drove it, where it began.

    Arrays may be of any kind that `Recording` takes. They are matched by position, copied and checked here.
    Times need not be even, nor begin at zero; the first one is where a simulation begins.

    Args:
        time: Times of the samples, strictly increasing, shape ``(T,)``, ``T >= 2``.
        outputs: Dict from output names to measured values ``(T,)``. NaN is a missing sample; a `Recording` takes
            it with ``missing=True`` only.
        inputs: Dict from input names to values ``(T,)`` at the same times: what drove the experiment. Never NaN.
        initial: Dict from state names to values at ``time[0]``, in the units of the simulator's states. A state
            that is not named is calibrated.
        hold: How the inputs go on between samples: ``"linear"``, ``"zero"`` (each value stays until the next
            sample), or ``"cubic"`` (a spline); or a dict of these by input, where those not named go on linearly.

    Attributes:
        time: Tensor ``(T,)``.
        outputs: Dict of tensors ``(T,)``; NaN where missing.
        inputs: Dict of tensors ``(T,)``; empty if there are none.
        initial: Dict of floats; empty if nothing is known.
        hold: For all inputs, or a dict by input where they differ; see `holds`.
        units: Dict from names of outputs and inputs, and ``"time"``, to the units that the arrays came with.

    Raises:
        RecordingError: If an array is not of finite real numbers, too short or of another length than ``time``,
            if time does not increase, or if a name is empty, taken, or one of ``"time"``, ``"run"``, ``"t"``.
        ShapeError: If an array has no or several dimensions.

    >>> run = Run([0.0, 1.0, 3.0], outputs={"x": [0, 1, 2]}, inputs={"f": [0, 2, 6]}, initial={"x": 0})
    >>> run.inputs_at([0.5, 2.0])["f"].tolist()
    [1.0, 4.0]
    """

    time: Tensor
    outputs: dict[str, Tensor]
    inputs: dict[str, Tensor]
    initial: dict[str, float]
    hold: str | dict[str, str]
    units: dict[str, str] = field(init=False)
    _quantities: dict[str, Any] = field(init=False)

    def __init__(
        self,
        time: Any,
        outputs: Mapping[str, Any],
        inputs: Mapping[str, Any] | None = None,
        initial: Mapping[str, Any] | None = None,
        hold: str | Mapping[str, str] = "linear",
    ) -> None:
        by_default_on_cpu()
        given_outputs, given_inputs = _series(outputs, "outputs"), _series(inputs, "inputs")
        if not given_outputs:
            raise RecordingError("Expected outputs: a dict with an array. Got none (give outputs={name: array}).")
        if both := [name for name in given_outputs if name in given_inputs]:
            raise RecordingError(
                f"Expected outputs and inputs with different names. Got {both[0]!r} in both (rename one)."
            )
        holds = _holds(hold, given_inputs)
        known = _initial(initial)

        labelled = {"time": ("time", time)}
        labelled |= {name: (f"outputs[{name!r}]", values) for name, values in given_outputs.items()}
        labelled |= {name: (f"inputs[{name!r}]", values) for name, values in given_inputs.items()}
        arrays: dict[str, Tensor] = {}
        units: dict[str, str] = {}
        quantities: dict[str, Any] = {}
        for name, (label, values) in labelled.items():
            array, unit = to_tensor(values, label, None)
            _check_shape(array, label, arrays.get("time"))
            kind = "a time" if name == "time" else "an input"
            check_finite(array, label, is_output=name in given_outputs, missing=True, kind=kind)
            arrays[name] = array
            if unit is not None:
                units[name] = unit
            if (quantity := _quantity(values)) is not None:
                quantities[name] = type(quantity)(0.0, unit)  # converts later; pint's class itself does not pickle
        _check_increasing(arrays["time"])

        put = object.__setattr__
        put(self, "time", arrays["time"])
        put(self, "outputs", {name: arrays[name] for name in given_outputs})
        put(self, "inputs", {name: arrays[name] for name in given_inputs})
        put(self, "initial", known)
        put(self, "hold", holds)
        put(self, "units", units)
        put(self, "_quantities", quantities)

    def inputs_at(self, times: Any, *, side: str = "right") -> dict[str, Tensor]:
        """Inputs at any times within the run, between samples as ``hold`` says; differentiable in the times.

        Args:
            times: Of any shape, from ``time[0]`` to ``time[-1]``, in the unit of ``time``.
            side: What ``hold="zero"`` gives at the time of a sample: that sample's value (``"right"``), or the one
                before (``"left"``), which is what holds at the end of a step up to there.

        Returns:
            Dict from input names to tensors of the shape of ``times``.

        Raises:
            DomainError: If a time is outside the run, or ``side`` is something else.
        """
        if side not in ("right", "left"):
            raise DomainError(f"Expected side 'right' or 'left'. Got {side!r} (of a sample's time).")
        if isinstance(times, Tensor):
            at = times.to(self.time)
        else:
            at = to_tensor(times, "times", self.units.get("time"))[0].to(self.time)
        first, last = float(self.time[0]), float(self.time[-1])
        slack = OUTSIDE * max(abs(first), abs(last))
        outside = ~((at >= first - slack) & (at <= last + slack))
        if outside.any():
            raise DomainError(
                f"Expected times within the run, from {first:.6g} to {last:.6g}. "
                f"Got {at[outside].flatten()[0].item():.6g} (inputs are not known there)."
            )
        if not self.inputs:
            return {}
        found: dict[str, Tensor] = {}
        for names, coefficients in self._pieces:
            found |= zip(names, evaluate_pieces(coefficients, self.time, at.clamp(first, last), side), strict=True)
        return {name: found[name] for name in self.inputs}

    @property
    def holds(self) -> dict[str, str]:
        """How each input goes on between samples."""
        return dict.fromkeys(self.inputs, self.hold) if isinstance(self.hold, str) else dict(self.hold)

    @cached_property
    def _pieces(self) -> list[tuple[list[str], Tensor]]:
        """Names and coefficients of the inputs that go on alike."""
        groups = [[name for name, hold in self.holds.items() if hold == one] for one in HOLDS]
        return [
            (names, pieces(self.time, torch.stack([self.inputs[name] for name in names]), hold))
            for hold, names in zip(HOLDS, groups, strict=True) if names
        ]  # fmt: skip

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        time: str,
        outputs: str | Sequence[str],
        inputs: str | Sequence[str] | None = None,
        **options: Any,
    ) -> "Run":
        """Make a run from columns of a data frame. Rows of several runs: give the rows of one at a time.

        Args:
            frame: A pandas DataFrame, or anything with ``columns`` and ``frame[column]``.
            time: The column of times.
            outputs: A column name or a list of names.
            inputs: A column name, a list of names, or None.
            **options: ``initial`` and ``hold`` as for `Run`.

        Raises:
            RecordingError: If a column does not exist or is named twice, or as `Run`.
        """
        measured, driven = column_names(outputs), column_names(inputs)
        check_columns(frame, [time, *measured, *driven], "Run(time, outputs, ...)")
        return cls(
            frame[time],
            outputs={name: frame[name] for name in measured},
            inputs={name: frame[name] for name in driven},
            **options,
        )

    def __repr__(self) -> str:
        unit = f" {self.units['time']}" if "time" in self.units else ""
        lines = [f"Run: {len(self.time)} samples, time {value_range(self.time)}{unit}"]
        series = [("output", name, values) for name, values in self.outputs.items()]
        series += [(f"input ({hold})", name, self.inputs[name]) for name, hold in self.holds.items()]
        for kind, name, values in series:
            title = f"{name} [{self.units[name]}]" if name in self.units else name
            line = f"  {kind} {title}: {value_range(values[~torch.isnan(values)])}"
            lost = int(torch.isnan(values).sum())
            lines.append(line + (f", {lost} of {len(values)} missing" if lost else ""))
        if self.initial:
            lines.append("  initial " + ", ".join(f"{name} = {value:.6g}" for name, value in self.initial.items()))
        return "\n".join(lines)


def change(run: Run, **changes: Any) -> Run:
    """A run with other tensors in place of its own, which are not checked again."""
    twin = object.__new__(Run)
    for name in ("time", "outputs", "inputs", "initial", "hold", "units", "_quantities"):
        object.__setattr__(twin, name, changes.get(name, getattr(run, name)))
    return twin


def fingerprint(run: Run) -> tuple[Any, ...] | None:
    """What two runs share that are one, number for number, as of a file that was read twice.

    None where there are too few samples to tell.
    """
    seen = torch.stack([~torch.isnan(values) for values in run.outputs.values()]).any(0)
    if int(seen.sum()) < SEVERAL:
        return None
    series = {f"output {name}": values for name, values in run.outputs.items()}
    series |= {f"input {name}": values for name, values in run.inputs.items()} | {"time": run.time}
    held = tuple(sorted((name, values.nan_to_num(nan=torch.inf).numpy().tobytes()) for name, values in series.items()))
    return tuple(sorted(run.holds.items())), tuple(sorted(run.initial.items())), held


def convert(run: Run, units: Mapping[str, str], where: str) -> Run:
    """The run in these units; ``where`` names it in errors."""

    def converted(name: str, array: Tensor, label: str) -> Tensor:
        source, target = run.units.get(name), units.get(name)
        if source is None or target is None or source == target:
            return array.clone()
        if name not in run._quantities:
            raise RecordingError(
                f"Expected {label} of {where} in {target!r}. Got {source!r} (convert it, or spell them alike)."
            )
        given = type(run._quantities[name])(array.numpy(), source)
        return to_tensor(given, f"{label} of {where}", target)[0]

    names = ("time", *run.outputs, *run.inputs)
    return change(
        run,
        time=converted("time", run.time, "time"),
        outputs={name: converted(name, array, f"outputs[{name!r}]") for name, array in run.outputs.items()},
        inputs={name: converted(name, array, f"inputs[{name!r}]") for name, array in run.inputs.items()},
        units={name: unit for name, unit in units.items() if name in names},
    )


def together(holds: Mapping[str, str]) -> str | dict[str, str]:
    """How inputs go on, in a word where all go on alike."""
    kinds = set(holds.values()) or {HOLDS[0]}
    return kinds.pop() if len(kinds) == 1 else dict(holds)


def _holds(given: Any, inputs: Mapping[str, Any]) -> str | dict[str, str]:
    """How inputs go on between samples, checked."""
    by_input = isinstance(given, Mapping)
    if by_input and (unknown := [name for name in given if name not in inputs]):
        raise RecordingError(f"Expected names in hold among the inputs {list(inputs)}. Got {unknown[0]!r}.")
    for name, one in given.items() if by_input else [("", given)]:
        if not isinstance(one, str) or one not in HOLDS:
            of = f" of input {name!r}" if by_input else ""
            raise RecordingError(
                f"Expected hold{of} among {list(HOLDS)}. Got {one!r} (how inputs go on between samples; a dict says "
                "it for each)."
            )
    return together({name: given.get(name, HOLDS[0]) for name in inputs}) if by_input else given


def _series(given: Any, what: str) -> dict[str, Any]:
    """A dict of series with names that are free."""
    if given is None and what == "inputs":
        return {}
    if not isinstance(given, Mapping):
        raise RecordingError(
            f"Expected {what}: a dict from names to arrays. Got {type(given).__name__} "
            f"(give {what}={{name: array}})."
        )
    for name in given:
        if not isinstance(name, str) or not name:
            raise RecordingError(f"Expected names in {what}: non-empty strings. Got {name!r} (rename it).")
        if name in RESERVED:
            raise RecordingError(
                f"Expected names in {what} other than {list(RESERVED)}. Got {name!r} (a recording in time has "
                "these for itself: rename it)."
            )
    return dict(given)


def _initial(given: Any) -> dict[str, float]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise RecordingError(
            f"Expected initial: a dict from states to numbers. Got {type(given).__name__} "
            "(give initial={state: value})."
        )
    known = {}
    for name, value in given.items():
        if not isinstance(name, str) or not name:
            raise RecordingError(f"Expected names in initial: non-empty strings. Got {name!r} (rename it).")
        if _quantity(value) is not None:
            raise RecordingError(
                f"Expected initial[{name!r}]: a number without a unit. Got {value} "
                "(give the number in the unit of the simulator's state)."
            )
        number, _ = to_tensor(value, f"initial[{name!r}]", None)
        if number.ndim or not torch.isfinite(number):
            got = f"shape {tuple(number.shape)}" if number.ndim else number.item()
            raise RecordingError(
                f"Expected initial[{name!r}]: a finite number. Got {got} (leave an unknown state out)."
            )
        known[name] = number.item()
    return known


def _quantity(value: Any) -> Any:
    """The quantity that a value is or wraps, else None."""
    if is_quantity(value):
        return value
    inner = getattr(value, "data", None) if hasattr(value, "attrs") else None
    return inner if is_quantity(inner) else None


def _check_shape(array: Tensor, label: str, time: Tensor | None) -> None:
    if array.ndim != 1:
        got = "a scalar" if array.ndim == 0 else f"shape {tuple(array.shape)}"
        raise ShapeError(f"Expected {label} of shape (T,). Got {got} (give one value per sample).")
    if time is not None and len(array) != len(time):
        raise RecordingError(
            f"Expected {label} of the length of time, {len(time)}. Got {len(array)} (mark missing outputs by NaN; "
            "inputs are sampled at the same times)."
        )
    if time is None and len(array) < 2:
        raise RecordingError(f"Expected at least 2 times. Got {len(array)} (a run has a beginning and an end).")


def _check_increasing(time: Tensor) -> None:
    back = time.diff() <= 0
    if back.any():
        index = int(back.nonzero()[0]) + 1
        raise RecordingError(
            f"Expected time to increase strictly. Got {time[index].item():.6g} after {time[index - 1].item():.6g} "
            f"at index {index} (sort the samples and keep one of those at equal times; give each experiment a "
            "Run of its own)."
        )
