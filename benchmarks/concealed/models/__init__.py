"""The side of the tool under test: each family's base model and candidates, written anew in PyTorch.

Candidates are torchcal's library for the family's field, with a few terms of its own as a user would write them.
Nothing here knows which effects the generator plants, nor with what strength.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

import torchcal as tc
from benchmarks.concealed.models import (
    blind,
    chemical,
    electrical,
    fresh,
    hydraulic,
    late,
    mechanical,
    newest,
    orbital,
    still,
    thermal,
    unseen,
)
from benchmarks.concealed.models.base import Builder
from torchcal.terms import Term

BUILDERS: dict[str, Builder] = {
    family: builder
    for module in (
        mechanical, thermal, hydraulic, chemical, electrical, orbital, still, late, newest, fresh, unseen, blind
    )
    for family, builder in module.BUILDERS.items()
}


@dataclass(frozen=True)
class Problem:
    """What the tool gets."""

    name: str
    family: str
    simulator: tc.Simulator
    recording: tc.Recording
    candidates: list[Term]


def numbers(values: Any) -> torch.Tensor:
    """A JSON list as a tensor; null is a missing sample."""
    return torch.tensor([float("nan") if value is None else float(value) for value in values], dtype=torch.float64)


def recording(case: Mapping[str, Any]) -> tc.Recording:
    """The recording of a case."""
    units = {name: unit for name, unit in case["units"].items() if unit}
    if "runs" not in case:
        y = {name: numbers(values) for name, values in case["y"].items()}
        missing = any(bool(values.isnan().any()) for values in y.values())
        x = {name: numbers(values) for name, values in case["x"].items()}
        known = {name: unit for name, unit in units.items() if name in (*x, *y)}
        return tc.Recording(x=x, y=y, noise=case["noise"], missing=missing, units=known)
    runs, missing = [], False
    for run in case["runs"]:
        outputs = {name: numbers(values) for name, values in run["outputs"].items()}
        missing = missing or any(bool(values.isnan().any()) for values in outputs.values())
        inputs = {name: numbers(values) for name, values in run["inputs"].items()}
        runs.append(tc.Run(time=numbers(run["time"]), outputs=outputs, inputs=inputs, initial=dict(run["initial"])))
    known = {name: unit for name, unit in units.items() if name in runs[0].outputs}
    return tc.Recording(runs=runs, noise=case["noise"], missing=missing, units=known)


def observed(case: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(case["y"] if "y" in case else case["runs"][0]["outputs"])


def fitting(candidates: list[Term], outputs: tuple[str, ...]) -> list[Term]:
    """The candidates that do not act on an output that was not recorded."""
    return [candidate for candidate in candidates if set(candidate.outputs) <= set(outputs)]


def problem(case: Mapping[str, Any]) -> Problem:
    """Base model, recording and candidates of a case."""
    outputs = observed(case)
    simulator, candidates = BUILDERS[case["family"]](outputs)
    return Problem(case["id"], case["family"], simulator, recording(case), fitting(candidates, outputs))


def load(path: Path) -> Problem:
    """The same from a file."""
    return problem(json.loads(path.read_text()))
