"""Families written after the tool was frozen at commit 8208168: they are alone in sets from seed 3000 on."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import mechanics, sensors, swing
from benchmarks.concealed.families.inputs import sines, steps, times

Rng = np.random.Generator


# --- a drug in blood and tissue; the infusion is given ---------------------------------------------------


def _draw_infusion(rng: Rng) -> Setting:
    runs = []
    for _ in range(int(rng.integers(1, 3))):
        t = times(rng, rng.uniform(24, 48), 80, 160)
        pump = steps(rng, t, 0.0, 120.0, 5)
        runs.append(RunSetting(t, {"r": pump}, {"C": rng.uniform(1, 8), "P": rng.uniform(1, 8)}))
    return Setting(tuple(runs), observed=("C", "P") if rng.random() < 0.5 else ("C",))


def _cleared(s, p):  # type: ignore[no-untyped-def]
    return p["CL"] * s["C"] / p["V"]


def _share(s, c):  # type: ignore[no-untyped-def]
    return c["a"] * s["C"] / (1 + c["a"] * s["C"])


infusion = Family(
    "infusion",
    "pharmacology",
    (Base("V", "l", (15.0, 30.0), 1.0), Base("CL", "l/h", (3.0, 6.0)), Base("Q", "l/h", (4.0, 9.0)),
     Base("W", "l", (20.0, 45.0), 1.0)),
    _draw_infusion,
    {"C": lambda t, s, p, u: s["C"], "P": lambda t, s, p, u: s["P"]},
    (
        Effect("saturation", {"C": lambda t, s, p, u, c: _cleared(s, p) * _share(s, c)}, guess=0.03,
               factors={"CL": lambda t, s, p, u, c: 1 / (1 + c["a"] * s["C"])}),
        Effect("reaction order", {
            "C": lambda t, s, p, u, c: -_cleared(s, p) * (np.maximum(s["C"] / 10, 1e-6) ** c["a"] - 1)
        }, factors={"CL": lambda t, s, p, u, c: np.maximum(s["C"] / 10, 1e-6) ** c["a"]}, sign=0, guess=0.3),
        Effect("deactivation", {"C": lambda t, s, p, u, c: -_cleared(s, p) * np.expm1(-c["a"] * t)}, guess=0.02,
               factors={"CL": lambda t, s, p, u, c: np.exp(-c["a"] * t)}),
        Effect("constant source", {"C": lambda t, s, p, u, c: c["a"] + 0 * s["C"]}, drivers=("t",)),
        Effect("enzyme induction", {
            "C": lambda t, s, p, u, c: -c["a"] * s["enzyme"] * s["C"],
            "enzyme": lambda t, s, p, u, c: (s["C"] - s["enzyme"]) / 12,
        }, hidden={"enzyme": 0.0}, guess=0.01),
        Effect("loss in the tissue", {"P": lambda t, s, p, u, c: -c["a"] * s["P"]}, drivers=("t", "P")),
        Effect("saturable uptake", {
            "C": lambda t, s, p, u, c: p["Q"] / p["V"] * s["C"] * _share(s, c),
            "P": lambda t, s, p, u, c: -p["Q"] / p["W"] * s["C"] * _share(s, c),
        }, guess=0.03),
        Effect("pump that falls short", {"C": lambda t, s, p, u, c: -c["a"] * u["r"] ** 2 / p["V"]}, guess=1e-3,
               drivers=("t",)),
        *sensors("C", only=("drift", "non-linearity")),
        Effect("blood flow that follows meals", {
            "C": lambda t, s, p, u, c: -c["a"] * np.sin(c["rate"] * t) * _cleared(s, p)
        }, shapes={"rate": (0.8, 1.3, None)}, library=False),
        Effect("return with the bile", {
            "C": lambda t, s, p, u, c: c["a"] * (s["gut"] - s["C"]),
            "bile": lambda t, s, p, u, c: (s["C"] - s["bile"]) / c["time"],
            "gut": lambda t, s, p, u, c: (s["bile"] - s["gut"]) / c["time"],
        }, hidden={"bile": "C", "gut": "C"}, shapes={"time": (0.05, 0.12, "t")}, library=False),
    ),
    ("saturation", "reaction order"),
    {"C": "mg/l", "P": "mg/l"},
    lambda t, s, p, u: {
        "C": (u["r"] - p["CL"] * s["C"] - p["Q"] * (s["C"] - s["P"])) / p["V"],
        "P": p["Q"] * (s["C"] - s["P"]) / p["W"],
    },
    {"r": "mg/h"},
    late=3,
    positive=("C", "P"),
    scales={"C": 10.0, "P": 10.0},
)  # fmt: skip


# --- a ship that rolls; slope of the waves, rudder and speed are measured ---------------------------------


def _draw_ship(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(110, 180), 150, 280)
    inputs = {
        "b": sines(rng, t, rng.uniform(0.06, 0.12), 0.35, 1.0, 4),
        "d": steps(rng, t, -0.5, 0.5, 5),
        "U": steps(rng, t, 5.0, 11.0, 4),
    }
    start = {"q": rng.uniform(-0.2, 0.2), "w": rng.uniform(-0.1, 0.1)}
    return Setting((RunSetting(t, inputs, start),), observed=("q", "w") if rng.random() < 0.5 else ("q",))


ship = Family(
    "rolling ship",
    "naval architecture",
    (Base("k", "1/s^2", (0.2, 0.5)), Base("c", "1/s", (0.03, 0.09)), Base("e", "1/s^2", (0.2, 0.45)),
     Base("r", "1/s^2", (0.04, 0.12))),
    _draw_ship,
    {"q": lambda t, s, p, u: s["q"], "w": lambda t, s, p, u: s["w"]},
    (
        *mechanics("q", "w", only=("quadratic drag", "cubic drag", "cubic stiffness", "position-dependent damping",
                                   "bias force")),
        Effect("damping by lift", {"w": lambda t, s, p, u, c: -c["a"] * u["U"] * s["w"]}, drivers=("t",)),
        Effect("rudder that stalls", {"w": lambda t, s, p, u, c: -c["a"] * (u["U"] / 8) ** 2 * u["d"] ** 3},
               drivers=("t",)),
        Effect("stiffness on the wave", {"w": lambda t, s, p, u, c: -c["a"] * u["b"] * s["q"]}, sign=0,
               drivers=("t",)),
        *sensors("q", only=("drift", "saturation")),
        Effect("swell from elsewhere", {"w": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t)},
               shapes={"rate": (0.2, 0.4, None)}, library=False),
        Effect("free water in a tank", {
            "w": lambda t, s, p, u, c: c["a"] * (s["water"] - s["q"]),
            "water": lambda t, s, p, u, c: s["flow"],
            "flow": lambda t, s, p, u, c: c["tuned"] ** 2 * (s["q"] - s["water"]) - 0.1 * s["flow"],
        }, hidden={"water": "q", "flow": 0.0}, shapes={"tuned": (0.5, 1.0, None)}, library=False),
    ),
    ("quadratic drag", "cubic drag"),
    {"q": "rad", "w": "rad/s"},
    lambda t, s, p, u: {
        "q": s["w"],
        "w": -p["k"] * s["q"] - p["c"] * s["w"] + p["e"] * u["b"] + p["r"] * (u["U"] / 8) ** 2 * u["d"],
    },
    {"b": "rad", "d": "rad", "U": "m/s"},
    late=3,
    scales={"q": 0.3, "w": 0.2},
)  # fmt: skip


# --- a plate heat exchanger in counterflow: both outlets, water on both sides ------------------------------


def _draw_exchanger(rng: Rng) -> Setting:
    number = int(rng.integers(80, 160))
    return Setting(
        x={
            "mh": rng.uniform(0.3, 2.0, number),
            "mc": rng.uniform(0.3, 2.0, number),
            "Ti": rng.uniform(55, 95, number),
            "days": np.sort(rng.uniform(0, 700, number)),
        },
        observed=("Tw", "To"),
    )


def _outlets(p, u, *, inlet=0.0, mains=12.0, through=1.0, past=0.0, hot=1.0, more=0.0):  # type: ignore[no-untyped-def]
    """Outlet temperatures of warmed and of hot water.

    ``inlet`` is added to the hot inlet's, ``mains`` is the cold inlet's; ``through`` and ``past`` are what flows
    through the plates and past them, in units of the cold flow; ``hot`` multiplies the hot film's conductance, and
    ``more`` is a resistance in K/kW.
    """
    ti, plates, wall = u["Ti"] + inlet, through * u["mc"], more
    wall = wall + 1 / (p["H"] * hot * u["mh"] ** 0.8) + 1 / (p["K"] * plates**0.8)
    gap = 1 / (4.19 * u["mh"]) - 1 / (4.19 * plates)
    duty = (ti - mains) / (1 / (4.19 * u["mh"]) + gap / np.expm1(gap / wall))
    return {"Tw": mains + duty / (4.19 * (plates + past * u["mc"])), "To": ti - duty / (4.19 * u["mh"])}


def _moved(**changes):  # type: ignore[no-untyped-def]
    """What such changes, functions of ``(u, c)``, make of the two outlets."""

    def one(output):  # type: ignore[no-untyped-def]
        def seen(t, s, p, u, y, c):  # type: ignore[no-untyped-def]
            found = _outlets(p, u, **{name: change(u, c) for name, change in changes.items()})
            return y + found[output] - _outlets(p, u)[output]

        return seen

    return {output: one(output) for output in ("Tw", "To")}


exchanger = Family(
    "heat exchanger",
    "process engineering",
    (Base("H", "kW/K", (4.0, 9.0), 0.1), Base("K", "kW/K", (4.0, 9.0), 0.1)),
    _draw_exchanger,
    {"Tw": lambda t, s, p, u: _outlets(p, u)["Tw"], "To": lambda t, s, p, u: _outlets(p, u)["To"]},
    (
        Effect("fouling", outputs=_moved(more=lambda u, c: c["a"] * u["days"] / 1000), guess=0.3),
        Effect("fouling that levels off", outputs=_moved(more=lambda u, c: -c["a"] * np.expm1(-u["days"] / 250)),
               guess=0.2),
        Effect("resistance of the wall", outputs=_moved(more=lambda u, c: c["a"]), guess=0.2),
        Effect("heat loss", outputs=_moved(inlet=lambda u, c: -c["a"] * (u["Ti"] - 20) / (4.19 * u["mh"])), guess=0.1,
               drivers=("days",)),
        Effect("bypass", outputs=_moved(through=lambda u, c: 1 - c["a"], past=lambda u, c: c["a"]), guess=0.1,
               drivers=("days", "mc"), within=(0.0, 0.9, None)),
        Effect("cold flow meter", outputs=_moved(through=lambda u, c: 1 + c["a"]), sign=0, guess=0.1,
               drivers=("mc",), within=(0.0, 0.5, None)),
        Effect("viscosity", outputs=_moved(hot=lambda u, c: np.exp(c["a"] * (u["Ti"] - 75) / 20)), sign=0, guess=0.3,
               drivers=("mh",)),
        *sensors("Tw", only=("offset", "gain error")),
        Effect("seasons in the mains", outputs=_moved(
            mains=lambda u, c: 12 + c["a"] * np.sin(2 * np.pi * (u["days"] - c["spring"]) / 365)
        ), shapes={"spring": (50.0, 300.0, None)}, library=False, most=0.2),
        Effect("film that turns turbulent", outputs=_moved(
            hot=lambda u, c: np.exp(c["a"] * swing((u["mh"] - c["at"]) / 0.2))
        ), shapes={"at": (0.6, 1.4, None)}, library=False, guess=0.3),
    ),
    ("fouling", "fouling that levels off"),
    units={"mh": "kg/s", "mc": "kg/s", "Ti": "degC", "days": "d", "Tw": "degC", "To": "degC"},
    late=3,
)  # fmt: skip

FAMILIES = (infusion, ship, exchanger)
