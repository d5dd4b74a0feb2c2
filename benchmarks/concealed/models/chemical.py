"""Kinetics: base models and candidates."""

from typing import Any

import torch

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive
from torchcal.terms import Term


def _batch(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {"A": -p["k1"] * s["A"], "B": p["k1"] * s["A"] - p["k2"] * s["B"]},
        {"A": "mol/l", "B": "mol/l"},
        [positive("k1", "1/h", 0.5), positive("k2", "1/h", 0.2)],
        observe=outputs,
    )
    return body, [
        *tc.terms.kinetics("A", "B", rate="k1", reference=1.0, amount="mol/l", time="h"),
        *tc.terms.sensor(outputs, time="h"),
    ]


def _stirred(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def rates(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        reaction = p["k"] * torch.exp(p["E"] * (1 - 315.0 / s["T"])) * s["C"]
        return {
            "C": 0.5 * (u["cf"] - s["C"]) - reaction,
            "T": 0.5 * (300.0 - s["T"]) + 20.0 * reaction - p["U"] * (s["T"] - u["Tj"]),
        }

    body = tc.ODESimulator(
        rates,
        {"C": "mol/l", "T": "K"},
        [positive("k", "1/min", 0.5), positive("E", "", 12.0), positive("U", "1/min", 0.4)],
        observe=outputs,
    )
    return body, [
        *tc.terms.kinetics("C", rate="k", temperature="T", reference=1.0, reference_temperature=315.0,
                           amount="mol/l", time="min"),
        *tc.terms.thermal("T", ambient="Tj", unit="K", time="min"),
        *tc.terms.sensor(outputs, time="min"),
    ]  # fmt: skip


BUILDERS: dict[str, Builder] = {
    "batch reactor": _batch,
    "stirred tank": _stirred,
}
