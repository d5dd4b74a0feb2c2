"""What a recording is made of, from conditions and outputs or from runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchcal.data.arrays import check_finite, check_lengths, declared_units, named, to_tensor
from torchcal.data.run import Run, convert
from torchcal.errors import RecordingError, ShapeError

__all__ = ["Parts", "run_parts", "static_parts"]


@dataclass(frozen=True)
class Parts:
    """Checked tensors of one length, on one device, in the units that are named."""

    x: Tensor | dict[str, Tensor]
    y: dict[str, Tensor]
    units: dict[str, str]
    missing: bool
    runs: tuple[Run, ...] | None = None


def static_parts(x: Any, y: Any, units: Any, missing: bool) -> Parts:
    """Conditions and outputs as the user gave them."""
    given_x, given_y = named(x, "x"), named(y, "y")
    if both := [name for name in given_y if name in given_x]:
        raise RecordingError(
            f"Expected outputs and conditions with different names. Got {both[0]!r} in both (rename one; "
            "an array without a name is called 'x' as condition, 'y' as output: give a dict to name it)."
        )
    declared = declared_units(units, [*given_x, *given_y])

    known: dict[str, str] = {}
    arrays: dict[str, Tensor] = {}
    for letter, given, original in (("x", given_x, x), ("y", given_y, y)):
        for name, values in given.items():
            label = f"{letter}[{name!r}]" if isinstance(original, Mapping) else letter
            array, unit = to_tensor(values, label, declared.get(name))
            if array.ndim != 1:
                what = "a scalar" if array.ndim == 0 else f"shape {tuple(array.shape)}"
                raise ShapeError(
                    f"Expected {label} of shape (n,). Got {what} (give one value per condition; several "
                    "conditions or outputs go into a dict from names to arrays)."
                )
            check_finite(array, label, is_output=letter == "y", missing=missing)
            arrays[name] = array
            if unit is not None:
                known[name] = unit
    check_lengths(arrays)
    return Parts(
        x={name: arrays[name] for name in given_x} if isinstance(x, Mapping) else arrays["x"],
        y={name: arrays[name] for name in given_y},
        units=known,
        missing=missing,
    )


def run_parts(runs: Any, units: Any, missing: bool) -> Parts:
    """Runs one after another, with the outputs of all of them; NaN where a run lacks one."""
    if isinstance(runs, str) or not isinstance(runs, Sequence) or not all(isinstance(run, Run) for run in runs):
        got = type(runs).__name__
        if isinstance(runs, Sequence) and not isinstance(runs, str):
            got = next(f"{type(run).__name__} as run {i}" for i, run in enumerate(runs) if not isinstance(run, Run))
        raise RecordingError(f"Expected runs: a list of Run. Got {got} (give runs=[Run(time, outputs), ...]).")
    if not runs:
        raise RecordingError("Expected runs: at least one Run. Got an empty list (give runs=[Run(time, outputs)]).")
    outputs = list(dict.fromkeys(name for run in runs for name in run.outputs))
    inputs = list(runs[0].inputs)
    for i, run in enumerate(runs):
        if set(run.inputs) != set(inputs):
            raise RecordingError(
                f"Expected the same inputs in every run. Got {inputs} in run 0, {list(run.inputs)} in run {i} "
                "(give each run all of them, zeros where one was off)."
            )
        for name, values in run.outputs.items():
            check_finite(values, f"outputs[{name!r}] of run {i}", is_output=True, missing=missing)
    known = _common_units(runs, declared_units(units, ["time", *outputs, *inputs]))
    runs = tuple(convert(run, known, f"run {i}") for i, run in enumerate(runs))

    def values_of(name: str, run: Run) -> Tensor:
        return run.outputs[name] if name in run.outputs else torch.full_like(run.time, torch.nan)

    return Parts(
        x={
            "time": torch.cat([run.time for run in runs]),
            "run": torch.cat([torch.full_like(run.time, i) for i, run in enumerate(runs)]),
        },
        y={name: torch.cat([values_of(name, run) for run in runs]) for name in outputs},
        units={name: unit for name, unit in known.items() if name not in inputs},
        missing=missing or any(len(run.outputs) < len(outputs) for run in runs),
        runs=runs,
    )


def _common_units(runs: Sequence[Run], declared: Mapping[str, str]) -> dict[str, str]:
    """Unit of each name: as declared, else that of the first run that has it; then every run must say its own."""
    known = dict(declared)
    for name in dict.fromkeys(name for run in runs for name in run.units if name not in declared):
        have = [(i, run) for i, run in enumerate(runs) if name in ("time", *run.outputs, *run.inputs)]
        first = next(i for i, run in have if name in run.units)
        if bare := [i for i, run in have if name not in run.units]:
            raise RecordingError(
                f"Expected {name!r} with a unit in every run, or in none. Got {runs[first].units[name]!r} in run "
                f"{first} and no unit in run {bare[0]} (give units={{{name!r}: unit}}: numbers without a unit are "
                "taken to be in it)."
            )
        known[name] = runs[first].units[name]
    return known
