"""The newest families: base models and candidates."""

from typing import Any

import torch

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, seen, term
from torchcal.terms import Term


def _prey(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {
            "N": p["r"] * s["N"] - p["b"] * s["N"] * s["P"],
            "P": p["g"] * s["N"] * s["P"] - p["d"] * s["P"],
        },
        {"N": "1", "P": "1"},
        [positive("r", "1/a", 0.8), positive("b", "1/a", 0.7), positive("g", "1/a", 0.5), positive("d", "1/a", 0.6)],
        observe=outputs,
    )

    def busy(s: Any, p: Any) -> Any:
        return p["a"] * s["N"] / (1 + p["a"] * s["N"]) * s["N"] * s["P"]

    own = [
        term("crowding", "N", lambda t, s, p, u: -p["a"] * s["N"] ** 2),
        term("strong crowding", "N", lambda t, s, p, u: -p["a"] * s["N"] ** 3),
        term("sated predators", {
            "N": lambda t, s, p, u: p["b"] * busy(s, p),
            "P": lambda t, s, p, u: -p["g"] * busy(s, p),
        }),
        term("immigration", "N", lambda t, s, p, u: p["a"]),
        term("crowded predators", "P", lambda t, s, p, u: -p["a"] * s["P"] ** 2),
        term("predators that come by", "P", lambda t, s, p, u: p["a"]),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(outputs, time="a")]


def _tumbling(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    axes = ("w1", "w2", "w3")
    body = tc.ODESimulator(
        lambda t, s, p, u: {
            "w1": p["A"] * s["w2"] * s["w3"] - p["c"] * s["w1"] + u["m"],
            "w2": -p["B"] * s["w1"] * s["w3"] - p["c"] * s["w2"],
            "w3": p["C"] * s["w1"] * s["w2"] - p["c"] * s["w3"] + u["n"],
        },
        {axis: "rad/s" for axis in axes},
        [positive("A", "", 0.5), positive("B", "", 0.6), positive("C", "", 0.35), positive("c", "1/s", 0.05)],
        observe=outputs,
    )

    def speed(s: Any) -> Any:
        return torch.sqrt(s["w1"] ** 2 + s["w2"] ** 2 + s["w3"] ** 2 + 1e-12)

    own = [
        term("quadratic drag", {w: (lambda t, s, p, u, w=w: -p["a"] * speed(s) * s[w]) for w in axes}),
        term("cubic drag", {w: (lambda t, s, p, u, w=w: -p["a"] * speed(s) ** 2 * s[w]) for w in axes}),
        term("misaligned thruster", "w2", lambda t, s, p, u: p["a"] * u["m"], low=None),
        term("bias torque", "w3", lambda t, s, p, u: p["a"], low=None),
        term("spinning wheel", {
            "w1": lambda t, s, p, u: -p["a"] * s["w2"],
            "w2": lambda t, s, p, u: p["a"] * s["w1"],
        }, low=None),
        term("product of inertia", "w1", lambda t, s, p, u: p["a"] * (s["w3"] ** 2 - s["w2"] ** 2), low=None),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(outputs)]


def _valve(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.Simulator(
        lambda x, p: {"Q": p["C"] * torch.exp(p["R"] * (x["x"] - 1)) * torch.sqrt(x["dp"])},
        [positive("C", "m^3/h", 2.0), positive("R", "", 3.0)],
    )
    root = lambda x: torch.sqrt(x["dp"])  # noqa: E731
    own = [
        seen("leakage", "Q", lambda x, p, y: y + p["a"] * root(x)),
        seen("linear trim", "Q", lambda x, p, y: y + p["a"] * x["x"] * root(x), low=None),
        seen("square trim", "Q", lambda x, p, y: y + p["a"] * x["x"] ** 2 * root(x), low=None),
        seen("choked flow", "Q", lambda x, p, y: y / torch.sqrt(1 + p["a"] * x["dp"])),
        seen("viscosity", "Q", lambda x, p, y: y * (1 + p["a"] * (x["T"] - 45) / 35), low=None),
    ]
    return body, [*own, *tc.terms.sensor(("Q",), static=True)]


BUILDERS: dict[str, Builder] = {
    "prey and predators": _prey,
    "tumbling body": _tumbling,
    "valve": _valve,
}
