"""The late families: base models and candidates."""

from typing import Any

import torch

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, seen, term
from torchcal.terms import Term


def _motor(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {
            "i": (u["e"] - p["R"] * s["i"] - p["K"] * s["w"]) / 0.5,
            "w": p["K"] * s["i"] - p["b"] * s["w"],
        },
        {"i": "A", "w": "rad/s"},
        [positive("R", "ohm", 1.2), positive("K", "N m/A", 0.8), positive("b", "1/s", 0.2)],
        observe=outputs,
    )
    friction = [
        found for found in tc.terms.mechanics("turn", "w", angle=False)
        if found.name in ("linear drag", "quadratic drag", "cubic drag", "Coulomb friction", "Stribeck friction",
                          "bias force", "viscoelastic branch")
    ]  # fmt: skip
    own = [
        term("brush drop", "i", lambda t, s, p, u: -p["a"] * torch.tanh(s["i"] / p["w0"]), shapes={"w0": "i"}),
        term("iron saturation", {
            "w": lambda t, s, p, u: -p["a"] * p["K"] * s["i"] ** 3,
            "i": lambda t, s, p, u: p["a"] * p["K"] * s["i"] ** 2 * s["w"] / 0.5,
        }),
    ]  # fmt: skip
    return body, [*friction, *own, *tc.terms.sensor(outputs)]


def _growth(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def monod(s: Any, p: Any) -> Any:
        return p["m"] * s["S"] / (p["K"] + s["S"]) * s["X"]

    body = tc.ODESimulator(
        lambda t, s, p, u: {
            "X": monod(s, p) - 0.2 * s["X"],
            "S": 0.2 * (u["Sf"] - s["S"]) - monod(s, p) / p["Y"],
        },
        {"X": "g/l", "S": "g/l"},
        [positive("m", "1/h", 0.45), tc.Parameter("K", unit="g/l", low=1e-3, initial=0.6),
         tc.Parameter("Y", low=1e-2, initial=0.5)],
        observe=outputs,
    )  # fmt: skip

    def inhibited(s: Any, p: Any) -> Any:
        return p["a"] * s["S"] * monod(s, p) / (1 + p["a"] * s["S"])

    own = [
        term("death", "X", lambda t, s, p, u: -p["a"] * s["X"]),
        term("crowding", "X", lambda t, s, p, u: -p["a"] * s["X"] ** 2),
        term("upkeep", "S", lambda t, s, p, u: -p["a"] * s["X"] * s["S"] / (s["S"] + 0.05)),
        term("inhibition by excess", {
            "X": lambda t, s, p, u: -inhibited(s, p),
            "S": lambda t, s, p, u: inhibited(s, p) / p["Y"],
        }),
        term("growth on the wall", "X", lambda t, s, p, u: p["a"]),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(outputs, time="h")]


def _thermistor(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.Simulator(
        lambda x, p: {"lnR": p["lnR0"] + p["B"] * (1 / x["T"] - 1 / 298.15)},
        [tc.Parameter("lnR0", initial=2.0), positive("B", "K", 3500.0)],
    )
    cold = lambda x: 1e3 / x["T"] - 1e3 / 298.15  # noqa: E731
    own = [
        seen("self-heating", "lnR",
             lambda x, p, y: p["lnR0"] + p["B"] * (1 / (x["T"] + p["a"] * x["power"]) - 1 / 298.15)),
        seen("Steinhart curvature", "lnR", lambda x, p, y: y + p["a"] * cold(x) ** 2, low=None),
        seen("cubic curvature", "lnR", lambda x, p, y: y + p["a"] * cold(x) ** 3, low=None),
        seen("lead resistance", "lnR", lambda x, p, y: torch.log(torch.exp(y) + p["a"])),
        seen("shunt", "lnR", lambda x, p, y: y - torch.log1p(p["a"] * torch.exp(y))),
        seen("power coefficient", "lnR", lambda x, p, y: y - p["a"] * (x["power"] - 1.5)),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(("lnR",), static=True)]


BUILDERS: dict[str, Builder] = {
    "motor": _motor,
    "growth": _growth,
    "thermistor": _thermistor,
}
