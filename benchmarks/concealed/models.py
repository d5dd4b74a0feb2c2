"""The side of the tool under test: each family's base model and candidates, written anew in PyTorch.

Candidates are torchcal's library for the family's field, with a few terms of its own as a user would write them.
Nothing here knows which effects the generator plants, nor with what strength.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

import torchcal as tc
from torchcal.terms import Term

Builder = Callable[[tuple[str, ...]], tuple[tc.Simulator, list[Term]]]
ZERO = 273.15


def positive(name: str, unit: str, initial: float) -> tc.Parameter:
    return tc.Parameter(name, unit=unit, low=0.0, initial=initial)


def term(
    name: str,
    equation: str | Mapping[str, Callable[..., Any]],
    rate: Callable[..., Any] | None = None,
    *,
    low: float | None = 0.0,
    shapes: Mapping[str, str] | None = None,
    formula: str = "",
) -> Term:
    """A user's term with the amplitude ``a``, and shape parameters measured on the scale of a driver."""
    parameters = [tc.Parameter("a", low=low, neutral=0.0), *(tc.Parameter(shape) for shape in shapes or {})]
    where: dict[str, Any] = (
        {"rates": dict(equation)} if isinstance(equation, Mapping) else {"equation": equation, "rate": rate}
    )
    return Term(name, **where, parameters=parameters, scales=dict(shapes or {}), formula=formula)


def seen(name: str, output: str, function: Callable[..., Any], *, low: float | None = 0.0, formula: str = "",
         shapes: Mapping[str, tuple[float, float] | str] | None = None) -> Term:  # fmt: skip
    """A user's term of a static model, ``function(x, p, y)`` in place of its response y."""
    bounds = {name: ends for name, ends in (shapes or {}).items() if not isinstance(ends, str)}
    scales = {name: driver for name, driver in (shapes or {}).items() if isinstance(driver, str)}
    parameters = [
        tc.Parameter("a", low=low, neutral=0.0),
        *(tc.Parameter(shape, low=ends[0], high=ends[1]) for shape, ends in bounds.items()),
        *(tc.Parameter(shape) for shape in scales),
    ]
    return Term(name, outputs={output: function}, parameters=parameters, scales=scales, formula=formula)


def fitting(candidates: list[Term], outputs: tuple[str, ...]) -> list[Term]:
    """The candidates that do not act on an output that was not recorded."""
    return [candidate for candidate in candidates if set(candidate.outputs) <= set(outputs)]


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


def _cooling(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {"T": -p["h"] * (s["T"] - u["Ta"])},
        {"T": "degC"},
        [positive("h", "1/min", 0.02)],
        observe=outputs,
    )
    return body, [
        *tc.terms.thermal("T", ambient="Ta", loss="h", humidity=1.0, time="min"),
        *tc.terms.sensor(("T",), time="min"),
    ]


def _room(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {
            "T": -p["a"] * (s["T"] - u["To"]) - p["b"] * (s["T"] - s["W"]) + p["e"] * u["q"],
            "W": p["d"] * (s["T"] - s["W"]),
        },
        {"T": "degC", "W": "degC"},
        [positive("a", "1/h", 0.25), positive("b", "1/h", 0.5), positive("d", "1/h", 0.05),
         positive("e", "K/h/kW", 1.0)],
        observe=outputs,
    )  # fmt: skip
    own = [
        term("window", "T",
             lambda t, s, p, u: -p["a"] * (s["T"] - u["To"]) * torch.sigmoid((s["T"] - p["opens"]) / 0.15),
             shapes={"opens": "T"}, formula="dT/dt ∋ -a (T - To) where T > opens"),
        term("heater that saturates", "T", lambda t, s, p, u: -p["a"] * u["q"] ** 2, formula="dT/dt ∋ -a q²"),
        term("sun", "T",
             lambda t, s, p, u: p["a"] * torch.relu(torch.sin(2 * torch.pi * (torch.as_tensor(t) - 6) / 24)),
             formula="dT/dt ∋ a max(0, sin(2π (t - 6)/24))"),
    ]  # fmt: skip
    return body, [
        *tc.terms.thermal("T", ambient="To", humidity=1.0, time="h"),
        *own,
        *tc.terms.sensor(("T",), time="h"),
    ]


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


LIGHT = 3.0


def _orbit(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def rates(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        pull = -p["mu"] / (s["x"] ** 2 + s["y"] ** 2) ** 1.5
        return {"x": s["vx"], "y": s["vy"], "vx": pull * s["x"], "vy": pull * s["y"]}

    body = tc.ODESimulator(
        rates, {"x": "AU", "y": "AU", "vx": "", "vy": ""}, [positive("mu", "", 1.0)], observe=outputs
    )
    speed = lambda s: (s["vx"] ** 2 + s["vy"] ** 2).sqrt()  # noqa: E731
    own = [
        term("dark halo", {
            "vx": lambda t, s, p, u: -p["a"] * s["x"],
            "vy": lambda t, s, p, u: -p["a"] * s["y"],
        }, formula="dv/dt ∋ -a r"),
        term("thrust", {
            "vx": lambda t, s, p, u: p["a"] * s["vx"] / speed(s),
            "vy": lambda t, s, p, u: p["a"] * s["vy"] / speed(s),
        }, low=None, formula="dv/dt ∋ a v/|v|"),
    ]  # fmt: skip
    return body, [
        *tc.terms.orbital(("x", "y"), ("vx", "vy"), mu="mu", light=LIGHT, reference=1.0, length="AU", time="yr"),
        *own,
    ]


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


# --- the late families ------------------------------------------------------------------------------


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


# --- the newest -------------------------------------------------------------------------------------------


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


# --- the fresh ones -----------------------------------------------------------------------------------------


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
    "oscillator": _oscillator,
    "pendulum": _pendulum,
    "falling body": _falling,
    "two masses": _two_masses,
    "cooling body": _cooling,
    "heated room": _room,
    "tank": _tank,
    "two tanks": _two_tanks,
    "batch reactor": _batch,
    "stirred tank": _stirred,
    "charged capacitor": _charge,
    "resonant circuit": _resonant,
    "orbit": _orbit,
    "dose response": _dose,
    "solar cell": _cell,
    "spring": _spring,
    "motor": _motor,
    "growth": _growth,
    "thermistor": _thermistor,
    "prey and predators": _prey,
    "tumbling body": _tumbling,
    "valve": _valve,
    "infusion": _infusion,
    "rolling ship": _ship,
    "heat exchanger": _exchanger,
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


def problem(case: Mapping[str, Any]) -> Problem:
    """Base model, recording and candidates of a case."""
    outputs = observed(case)
    simulator, candidates = BUILDERS[case["family"]](outputs)
    return Problem(case["id"], case["family"], simulator, recording(case), fitting(candidates, outputs))


def load(path: Path) -> Problem:
    """The same from a file."""
    return problem(json.loads(path.read_text()))
