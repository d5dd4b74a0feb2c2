"""Mechanics: base models and candidates."""

from typing import Any

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, term
from torchcal.terms import Term


def _oscillator(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]},
        {"x": "m", "v": "m/s"},
        [positive("k", "1/s^2", 5.0), positive("c", "1/s", 0.2)],
        observe=outputs,
    )
    return body, [*tc.terms.mechanics("x", "v", force="f", angle=False), *tc.terms.sensor(("x",))]


def _pendulum(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {"q": s["w"], "w": -p["k"] * s["q"] - p["c"] * s["w"]},
        {"q": "rad", "w": "rad/s"},
        [positive("k", "1/s^2", 6.0), positive("c", "1/s", 0.06)],
        observe=outputs,
    )
    return body, [*tc.terms.mechanics("q", "w", length="rad"), *tc.terms.sensor(("q",))]


def _falling(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {"z": s["v"], "v": p["g"] - p["c"] * s["v"]},
        {"z": "m", "v": "m/s"},
        [positive("g", "m/s^2", 9.8), positive("c", "1/s", 0.05)],
        observe=outputs,
    )
    return body, [*tc.terms.mechanics("z", "v", angle=False), *tc.terms.sensor(("z",))]


def _two_masses(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def rates(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        pull = p["k2"] * (s["x2"] - s["x1"])
        return {
            "x1": s["v1"],
            "v1": -p["k1"] * s["x1"] - p["c1"] * s["v1"] + pull + u["f"],
            "x2": s["v2"],
            "v2": -pull - p["c2"] * s["v2"],
        }

    body = tc.ODESimulator(
        rates,
        {"x1": "m", "v1": "m/s", "x2": "m", "v2": "m/s"},
        [positive("k1", "1/s^2", 5.0), positive("k2", "1/s^2", 3.0), positive("c1", "1/s", 0.2),
         positive("c2", "1/s", 0.2)],
        observe=outputs,
    )  # fmt: skip
    apart = lambda s: s["x2"] - s["x1"]  # noqa: E731
    own = [
        term("cubic coupling", {
            "v1": lambda t, s, p, u: p["a"] * apart(s) ** 3,
            "v2": lambda t, s, p, u: -p["a"] * apart(s) ** 3,
        }, low=None, formula="spring between the masses ∋ a (x2 - x1)³"),
        term("linear coupling damping", {
            "v1": lambda t, s, p, u: p["a"] * (s["v2"] - s["v1"]),
            "v2": lambda t, s, p, u: -p["a"] * (s["v2"] - s["v1"]),
        }, formula="damper between the masses, a (v2 - v1)"),
        term("force that leaks to the second mass", "v2", lambda t, s, p, u: p["a"] * u["f"], formula="dv2/dt ∋ a f"),
    ]  # fmt: skip
    return body, [
        *tc.terms.mechanics("x1", "v1", force="f", angle=False),
        *tc.terms.mechanics("x2", "v2", angle=False, label="second mass"),
        *own,
        *tc.terms.sensor(outputs),
    ]


BUILDERS: dict[str, Builder] = {
    "oscillator": _oscillator,
    "pendulum": _pendulum,
    "falling body": _falling,
    "two masses": _two_masses,
}
