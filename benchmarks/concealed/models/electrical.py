"""Electricity: base models and candidates."""

import torch

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, term
from torchcal.terms import Term


def _charge(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {"v": (u["e"] - s["v"]) / p["tau"]},
        {"v": "V"},
        [tc.Parameter("tau", unit="s", low=1e-3, initial=1.0)],
        observe=outputs,
    )
    own = [
        term("square-law resistor", "v",
             lambda t, s, p, u: p["a"] * (u["e"] - s["v"]) * (u["e"] - s["v"]).abs(),
             formula="dv/dt ∋ a |e - v| (e - v)"),
        term("cubic resistor", "v", lambda t, s, p, u: p["a"] * (u["e"] - s["v"]) ** 3,
             formula="dv/dt ∋ a (e - v)³"),
    ]  # fmt: skip
    return body, [*tc.terms.electrical("v", capacitance="tau"), *own, *tc.terms.sensor(("v",))]


def _resonant(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {"v": s["i"] / p["C"], "i": (u["e"] - p["R"] * s["i"] - s["v"]) / p["L"]},
        {"v": "V", "i": "A"},
        [tc.Parameter("L", unit="H", low=1e-2, initial=1.0), positive("R", "ohm", 0.4),
         tc.Parameter("C", unit="F", low=1e-2, initial=0.4)],
        observe=outputs,
    )  # fmt: skip
    own = [
        term("cubic resistor", "i", lambda t, s, p, u: -p["a"] * s["i"] ** 3 / p["L"], formula="R → R + a i²"),
        term("square-law resistor", "i", lambda t, s, p, u: -p["a"] * s["i"].abs() * s["i"] / p["L"],
             formula="R → R + a |i|"),
        term("arc", "i", lambda t, s, p, u: -p["a"] * torch.tanh(s["i"] / p["w"]), shapes={"w": "i"},
             formula="di/dt ∋ -a tanh(i/w)"),
    ]  # fmt: skip
    return body, [
        *tc.terms.electrical("v", "i", capacitance="C", resistance="R", inductance="L"),
        *own,
        *tc.terms.sensor(outputs),
    ]


BUILDERS: dict[str, Builder] = {
    "charged capacitor": _charge,
    "resonant circuit": _resonant,
}
