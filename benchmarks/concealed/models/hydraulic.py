"""Hydraulics: base models and candidates."""

from typing import Any

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, term
from torchcal.terms import Term


def _root(h: Any) -> Any:
    return h / (h**2 + 1e-8) ** 0.25


def _tank(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {"h": p["b"] * u["q"] - p["a"] * _root(s["h"])},
        {"h": "m"},
        [positive("a", "m^0.5/s", 0.4), positive("b", "", 1.0)],
        observe=outputs,
    )
    return body, [*tc.terms.hydraulics("h", inflow="q", outlet="a"), *tc.terms.sensor(("h",))]


def _two_tanks(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {
            "h1": u["q"] - p["a1"] * _root(s["h1"]),
            "h2": p["a1"] * _root(s["h1"]) - p["a2"] * _root(s["h2"]),
        },
        {"h1": "m", "h2": "m"},
        [positive("a1", "m^0.5/s", 0.45), positive("a2", "m^0.5/s", 0.45)],
        observe=outputs,
    )
    back = term("back pressure", {
        "h1": lambda t, s, p, u: p["a"] * s["h2"],
        "h2": lambda t, s, p, u: -p["a"] * s["h2"],
    }, formula="dh1/dt ∋ a h2, dh2/dt ∋ -a h2")  # fmt: skip
    return body, [
        *tc.terms.hydraulics("h1", inflow="q", downstream="h2", label="upper"),
        *tc.terms.hydraulics("h2", outlet="a2", label="lower"),
        back,
        *tc.terms.sensor(outputs),
    ]


BUILDERS: dict[str, Builder] = {
    "tank": _tank,
    "two tanks": _two_tanks,
}
