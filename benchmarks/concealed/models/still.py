"""Static models: base models and candidates."""

from typing import Any

import torch

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, seen
from torchcal.terms import Term


def _dose(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.Simulator(
        lambda x, p: {"effect": p["top"] * x["dose"] / (p["half"] + x["dose"])},
        [positive("top", "", 1.0), positive("half", "mg", 1.5)],
    )
    own = [
        seen("cooperativity", "effect",
             lambda x, p, y: p["top"] / (1 + torch.exp((1 + p["a"]) * (torch.log(p["half"]) - torch.log(x["dose"])))),
             low=None, formula="Hill exponent 1 + a"),
        seen("inhibition by excess", "effect",
             lambda x, p, y: p["top"] * x["dose"] / (p["half"] + x["dose"] + p["a"] * x["dose"] ** 2)),
        seen("unspecific binding", "effect", lambda x, p, y: y + p["a"] * x["dose"]),
        seen("effect of age", "effect", lambda x, p, y: y * (1 + p["a"] * (x["age"] - 45) / 25), low=None),
        seen("potency by age", "effect",
             lambda x, p, y: p["top"] * x["dose"] / (p["half"] * torch.exp(p["a"] * (x["age"] - 45) / 25) + x["dose"]),
             low=None),
        seen("second site", "effect", lambda x, p, y: y + p["a"] * x["dose"] / (x["dose"] + p["far"]),
             shapes={"far": (5.0, 100.0)}),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(("effect",), static=True)]


def _cell(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.Simulator(
        lambda x, p: {"I": p["Ip"] - 1e-6 * p["I0"] * torch.expm1(x["V"] / p["n"])},
        [positive("Ip", "A", 0.75), positive("I0", "uA", 0.5),
         tc.Parameter("n", unit="V", low=0.01, high=0.1, initial=0.039)],
    )  # fmt: skip

    def series(x: Any, p: Any, y: Any) -> Any:
        current = y
        for _ in range(12):  # Newton
            inner = (x["V"] + current * p["a"]) / p["n"]
            value = p["Ip"] - 1e-6 * p["I0"] * torch.expm1(inner) - current
            current = current + value / (1e-6 * p["I0"] * torch.exp(inner) * p["a"] / p["n"] + 1)
        return current

    own = [
        seen("series resistance", "I", series, formula="V → V + I a"),
        seen("shunt", "I", lambda x, p, y: y - p["a"] * x["V"], formula="I ∋ -a V"),
        seen("recombination diode", "I", lambda x, p, y: y - p["a"] * torch.expm1(x["V"] / (2 * p["n"]))),
        seen("soft breakdown", "I", lambda x, p, y: y + p["a"] * torch.relu(-x["V"])),
        seen("voltage offset", "I", lambda x, p, y: y - p["a"] * 1e-6 * p["I0"] * x["V"] * torch.exp(x["V"] / p["n"]),
             low=None),
        seen("square shunt", "I", lambda x, p, y: y - p["a"] * x["V"].abs() * x["V"]),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(("I",), static=True)]


def _spring(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.Simulator(
        lambda x, p: {"force": p["F0"] + p["k"] * x["x"]}, [positive("k", "N/m", 10.0), tc.Parameter("F0", unit="N")]
    )
    own = [
        seen("cubic stiffness", "force", lambda x, p, y: y + p["a"] * x["x"] ** 3, low=None),
        seen("quadratic stiffness", "force", lambda x, p, y: y + p["a"] * x["x"] ** 2, low=None),
        seen("fifth-power stiffness", "force", lambda x, p, y: y + p["a"] * x["x"] ** 5, low=None),
        seen("softening by heat", "force", lambda x, p, y: y - p["a"] * p["k"] * x["x"] * (x["T"] - 35) / 25),
        seen("thermal expansion", "force", lambda x, p, y: y - p["a"] * p["k"] * (x["T"] - 35) / 25, low=None),
        seen("end stop", "force", lambda x, p, y: y + p["a"] * torch.relu(x["x"] - p["gap"]), shapes={"gap": "x"}),
    ]
    return body, [*own, *tc.terms.sensor(("force",), static=True)]


BUILDERS: dict[str, Builder] = {
    "dose response": _dose,
    "solar cell": _cell,
    "spring": _spring,
}
