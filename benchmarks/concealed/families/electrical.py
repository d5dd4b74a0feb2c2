"""Electricity: a capacitor charged through a resistor, a series resonant circuit."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import sensors
from benchmarks.concealed.families.inputs import sines, steps, times

Rng = np.random.Generator


def _draw_charge(rng: Rng) -> Setting:
    runs = []
    for _ in range(int(rng.integers(1, 3))):
        t = times(rng, rng.uniform(8, 16), 120, 240)
        source = steps(rng, t, -3.0, 5.0, 5) + sines(rng, t, 1.0, 1.0, 6.0)
        runs.append(RunSetting(t, {"e": source}, {"v": rng.uniform(-1, 1)}, ()))
    return Setting(tuple(runs), observed=("v",))


charge = Family(
    "charged capacitor",
    "electrical",
    (Base("tau", "s", (0.5, 2.0)),),
    _draw_charge,
    {"v": lambda t, s, p, u: s["v"]},
    (
        Effect("shunt", {"v": lambda t, s, p, u, c: -c["a"] * s["v"]}, drivers=("t", "v")),
        Effect("leakage current", {"v": lambda t, s, p, u, c: -c["a"] + 0 * s["v"]}, sign=0, drivers=("t",)),
        Effect(
            "diode conduction",
            {"v": lambda t, s, p, u, c: -c["a"] * np.expm1(np.minimum(s["v"] / c["knee"], 60.0))},
            shapes={"knee": (0.15, 0.4, "v")},
            guess=0.1,
        ),
        Effect("non-linear conductance", {"v": lambda t, s, p, u, c: -c["a"] * s["v"] ** 3}, guess=0.02),
        Effect(
            "non-linear capacitance",
            {"v": lambda t, s, p, u, c: (u["e"] - s["v"]) / p["tau"]
             * (1 / (1 + np.maximum(c["a"] * s["v"], -0.95)) - 1)},
            sign=0, guess=0.05, most=0.4,
        ),
        Effect(
            "dielectric absorption",
            {
                "v": lambda t, s, p, u, c: -c["a"] * (s["v"] - s["bound"]),
                "bound": lambda t, s, p, u, c: (s["v"] - s["bound"]) / c["time"],
            },
            hidden={"bound": "v"},
            shapes={"time": (0.08, 0.3, "t")},
        ),
        Effect(
            "square-law resistor",
            {"v": lambda t, s, p, u, c: c["a"] * (u["e"] - s["v"]) * abs(u["e"] - s["v"])},
            drivers=("t", "e"),
        ),
        Effect("cubic resistor", {"v": lambda t, s, p, u, c: c["a"] * (u["e"] - s["v"]) ** 3}, guess=0.02),
        *sensors("v", only=("offset", "gain error", "drift", "lag", "non-linearity")),
        Effect(
            "magnetic relay",
            {
                "v": lambda t, s, p, u, c: -c["a"] * s["pulled"],
                "pulled": lambda t, s, p, u, c: (np.tanh(4 * (s["v"] - 1)) - s["pulled"]) / c["time"],
            },
            hidden={"pulled": 0.0},
            shapes={"time": (0.05, 0.12, "t")},
            library=False,
        ),
        Effect(
            "mains hum",
            {"v": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t)},
            shapes={"rate": (2.0, 5.0, None)},
            library=False,
        ),
        Effect("leak of power 0.5", {"v": lambda t, s, p, u, c: -c["a"] * np.sign(s["v"]) * np.sqrt(abs(s["v"]))},
               library=False),
    ),
    ("square-law resistor", "cubic resistor"),
    {"v": "V"},
    lambda t, s, p, u: {"v": (u["e"] - s["v"]) / p["tau"]},
    {"e": "V"},
)  # fmt: skip


# --- a series resonant circuit -----------------------------------------------------------------------


def _draw_resonant(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(15, 25), 150, 280)
    source = sines(rng, t, rng.uniform(2, 6), 0.5, 3.0, 4)
    run = RunSetting(t, {"e": source}, {"v": rng.uniform(-1, 1), "i": rng.uniform(-1, 1)}, ())
    return Setting((run,), observed=("v", "i") if rng.random() < 0.4 else ("i",) if rng.random() < 0.5 else ("v",))


resonant = Family(
    "resonant circuit",
    "electrical",
    (Base("L", "H", (0.5, 1.5)), Base("R", "ohm", (0.2, 0.6)), Base("C", "F", (0.2, 0.6))),
    _draw_resonant,
    {"v": lambda t, s, p, u: s["v"], "i": lambda t, s, p, u: s["i"]},
    (
        Effect("shunt", {"v": lambda t, s, p, u, c: -c["a"] * s["v"]}, drivers=("t", "v")),
        Effect("non-linear conductance", {"v": lambda t, s, p, u, c: -c["a"] * s["v"] ** 3}, guess=0.02,
               drivers=("t",)),
        Effect(
            "non-linear capacitance",
            {"v": lambda t, s, p, u, c: s["i"] / p["C"] * (1 / (1 + np.maximum(c["a"] * s["v"], -0.95)) - 1)},
            factors={"C": lambda t, s, p, u, c: 1 + np.maximum(c["a"] * s["v"], -0.95)},
            sign=0, guess=0.05, most=0.3,
        ),
        Effect(
            "saturation of the inductance",
            {"i": lambda t, s, p, u, c: c["a"] * s["i"] ** 2 * (u["e"] - p["R"] * s["i"] - s["v"]) / p["L"]},
            factors={"L": lambda t, s, p, u, c: 1 / (1 + c["a"] * s["i"] ** 2)},
            guess=0.1,
        ),
        Effect("cubic resistor", {"i": lambda t, s, p, u, c: -c["a"] * s["i"] ** 3 / p["L"]}, drivers=("t",)),
        Effect("square-law resistor", {"i": lambda t, s, p, u, c: -c["a"] * abs(s["i"]) * s["i"] / p["L"]}),
        Effect(
            "arc", {"i": lambda t, s, p, u, c: -c["a"] * np.tanh(s["i"] / c["width"])},
            shapes={"width": (0.02, 0.05, "i")},
        ),
        Effect(
            "inductance that pulsates",
            {"i": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t) * (u["e"] - s["v"]) / p["L"]},
            shapes={"rate": (0.5, 1.2, None)},
            library=False,
        ),
        Effect(
            "coupled loop",
            {
                "i": lambda t, s, p, u, c: -c["a"] * s["loop"],
                "loop": lambda t, s, p, u, c: s["loop rate"],
                "loop rate": lambda t, s, p, u, c: s["i"] - c["tuned"] ** 2 * s["loop"],
            },
            hidden={"loop": 0.0, "loop rate": 0.0},
            shapes={"tuned": (0.7, 1.2, None)},
            library=False,
        ),
    ),
    ("cubic resistor", "square-law resistor"),
    {"v": "V", "i": "A"},
    lambda t, s, p, u: {"v": s["i"] / p["C"], "i": (u["e"] - p["R"] * s["i"] - s["v"]) / p["L"]},
    {"e": "V"},
)  # fmt: skip

FAMILIES = (charge, resonant)
