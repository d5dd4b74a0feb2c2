"""The fresh families: base models and candidates."""

from collections.abc import Callable
from typing import Any

import torch

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, term
from torchcal.terms import Term


def _infusion(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {
            "C": (u["r"] - p["CL"] * s["C"]) / p["V"] + p["Q"] / p["V"] * (s["P"] - s["C"]),
            "P": p["Q"] / p["W"] * (s["C"] - s["P"]),
        },
        {"C": "mg/l", "P": "mg/l"},
        [tc.Parameter("V", unit="l", low=1.0, initial=20.0), positive("CL", "l/h", 4.0), positive("Q", "l/h", 6.0),
         tc.Parameter("W", unit="l", low=1.0, initial=30.0)],
        observe=outputs,
    )  # fmt: skip
    laws = [
        found for found in tc.terms.kinetics("C", rate="CL", reference=10.0, amount="mg/l", time="h")
        if found.name in ("second-order decay", "reversible adsorption", "constant source", "reaction order",
                          "saturation", "deactivation")
    ]  # fmt: skip

    def blocked(s: Any, p: Any) -> Any:
        return p["Q"] * s["C"] * (1 - 1 / (1 + p["a"] * s["C"]))

    enzyme = "enzyme induction: enzyme"
    own = [
        Term("enzyme induction",
             rates={"C": lambda t, s, p, u: -p["a"] * s[enzyme] * s["C"],
                    enzyme: lambda t, s, p, u: (s["C"] - s[enzyme]) / 12.0},
             states={enzyme: "mg/l"}, initial={enzyme: 0.0}, parameters=[tc.Parameter("a", low=0.0, neutral=0.0)],
             formula="dC/dt ∋ -a z C, dz/dt = (C - z)/12 h, z(0) = 0"),
        term("loss in the tissue", "P", lambda t, s, p, u: -p["a"] * s["P"], formula="dP/dt ∋ -a P"),
        term("saturable uptake", {
            "C": lambda t, s, p, u: blocked(s, p) / p["V"],
            "P": lambda t, s, p, u: -blocked(s, p) / p["W"],
        }, formula="uptake Q C → Q C/(1 + a C)"),
        term("pump that falls short", "C", lambda t, s, p, u: -p["a"] * u["r"] ** 2 / p["V"], formula="r → r - a r²"),
    ]  # fmt: skip
    return body, [*laws, *own, *tc.terms.sensor(outputs, time="h")]


def _ship(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {
            "q": s["w"],
            "w": p["e"] * u["b"] + p["r"] * u["d"] * u["U"] ** 2 / 64.0 - p["k"] * s["q"] - p["c"] * s["w"],
        },
        {"q": "rad", "w": "rad/s"},
        [positive("k", "1/s^2", 0.3), positive("c", "1/s", 0.05), positive("e", "1/s^2", 0.3),
         positive("r", "1/s^2", 0.08)],
        observe=outputs,
    )  # fmt: skip
    own = [
        term("damping by lift", "w", lambda t, s, p, u: -p["a"] * u["U"] * s["w"], formula="dw/dt ∋ -a U w"),
        term("rudder that stalls", "w", lambda t, s, p, u: -p["a"] * u["d"] ** 3 * u["U"] ** 2 / 64.0,
             formula="dw/dt ∋ -a (U/8)² d³"),
        term("stiffness on the wave", "w", lambda t, s, p, u: -p["a"] * u["b"] * s["q"], low=None,
             formula="dw/dt ∋ -a b q"),
    ]  # fmt: skip
    return body, [*tc.terms.mechanics("q", "w", angle=False, length="rad"), *own, *tc.terms.sensor(outputs)]


def _exchanger(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def outlets(p: Any, mh: Any, mc: Any, hot: Any, cold: Any = 12.0, film: Any = 1.0, more: Any = 0.0) -> Any:
        """Both outlets, of the warmed water and of the hot, by the hot side's number of transfer units."""
        conductance = 1 / (1 / (p["H"] * film * mh**0.8) + 1 / (p["K"] * mc**0.8) + more)
        units = conductance / (4.19 * mh)
        excess = conductance / (4.19 * mc) - units
        drop = units / (units - excess / torch.expm1(-excess)) * (hot - cold)
        return {"Tw": cold + drop * mh / mc, "To": hot - drop}

    body = tc.Simulator(
        lambda x, p: {name: value for name, value in outlets(p, x["mh"], x["mc"], x["Ti"]).items() if name in outputs},
        [tc.Parameter("H", unit="kW/K", low=0.1, initial=6.0), tc.Parameter("K", unit="kW/K", low=0.1, initial=6.0)],
    )

    def both(name: str, function: Callable[..., Any], *, low: float | None = 0.0, high: float | None = None,
             formula: str = "") -> Term:  # fmt: skip
        """A term that makes of the outlets what ``function(x, p)`` says."""

        def one(output: str) -> Callable[..., Any]:
            return lambda x, p, y: y + function(x, p)[output] - outlets(p, x["mh"], x["mc"], x["Ti"])[output]

        amplitude = tc.Parameter("a", low=low, high=high, neutral=0.0)
        return Term(name, outputs={output: one(output) for output in outputs}, parameters=[amplitude], formula=formula)

    def past(x: Any, p: Any) -> Any:
        found = outlets(p, x["mh"], x["mc"] * (1 - p["a"]), x["Ti"])
        return {"Tw": p["a"] * 12.0 + (1 - p["a"]) * found["Tw"], "To": found["To"]}

    own = [
        both("fouling", lambda x, p: outlets(p, x["mh"], x["mc"], x["Ti"], more=p["a"] * x["days"] / 1000),
             formula="1/UA → 1/UA + a days/1000"),
        both("fouling that levels off",
             lambda x, p: outlets(p, x["mh"], x["mc"], x["Ti"], more=p["a"] * (1 - torch.exp(-x["days"] / 250))),
             formula="1/UA → 1/UA + a (1 - exp(-days/250))"),
        both("resistance of the wall", lambda x, p: outlets(p, x["mh"], x["mc"], x["Ti"], more=p["a"]),
             formula="1/UA → 1/UA + a"),
        both("heat loss",
             lambda x, p: outlets(p, x["mh"], x["mc"], x["Ti"] - p["a"] * (x["Ti"] - 20) / (4.19 * x["mh"])),
             formula="Ti → Ti - a (Ti - 20)/(4.19 mh)"),
        both("bypass", past, high=0.9, formula="a mc flows past the plates"),
        both("cold flow meter", lambda x, p: outlets(p, x["mh"], x["mc"] * (1 + p["a"]), x["Ti"]), low=-0.5, high=1.0,
             formula="mc → mc (1 + a)"),
        both("viscosity",
             lambda x, p: outlets(p, x["mh"], x["mc"], x["Ti"], film=torch.exp(p["a"] * (x["Ti"] - 75) / 20)),
             low=None, formula="H → H exp(a (Ti - 75)/20)"),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(outputs, static=True)]


BUILDERS: dict[str, Builder] = {
    "infusion": _infusion,
    "rolling ship": _ship,
    "heat exchanger": _exchanger,
}
