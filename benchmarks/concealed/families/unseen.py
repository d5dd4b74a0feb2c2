"""Families written after the tool was frozen at commit 3e06f15: they are alone in sets from seed 4000 on."""

import numpy as np

from benchmarks.concealed.families.base import Array, Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import sensors, swing
from benchmarks.concealed.families.inputs import sines, steps, times

Rng = np.random.Generator
GRAVITY = 9.81


# --- a battery cell: charge, one branch of resistor and capacitor; the current is given -------------------


def _draw_cell(rng: Rng) -> Setting:
    while True:
        t = times(rng, rng.uniform(7, 12), 130, 230)
        current = steps(rng, t, -2.2, 2.2, 7) + sines(rng, t, 0.7, 1.0, 6.0)
        rested = rng.random() < 0.5
        start = {"z": rng.uniform(0.35, 0.65), "v": 0.0 if rested else rng.uniform(-0.04, 0.04)}
        moved = np.append(0.0, np.cumsum(0.5 * (current[1:] + current[:-1]) * np.diff(t)))
        charge = start["z"] + moved / 10.0
        if 0.08 < charge.min() and charge.max() < 0.95 and np.ptp(charge) > 0.25:
            return Setting((RunSetting(t, {"i": current}, start, ("v",) if rested else ()),), observed=("V",))


def _voltage(s, p, u):  # type: ignore[no-untyped-def]
    """At the terminals: at rest, over the series resistance and over the branch."""
    z = s["z"]
    return 3.45 + 0.55 * z + 0.25 * z**3 - 0.3 * np.exp(-8 * z) + p["R0"] * u["i"] + s["v"]


cell = Family(
    "battery cell",
    "electrochemistry",
    (Base("Q", "A h", (10.0, 16.0), 1.0), Base("R0", "ohm", (0.03, 0.07)), Base("R1", "ohm", (0.03, 0.08)),
     Base("tau", "h", (0.15, 0.4), 0.01)),
    _draw_cell,
    {"V": lambda t, s, p, u: _voltage(s, p, u)},
    (
        Effect("self-discharge", {"z": lambda t, s, p, u, c: -c["a"] * s["z"]}, guess=0.05, drivers=("t",)),
        Effect("parasitic load", {"z": lambda t, s, p, u, c: -c["a"] / p["Q"] + 0 * s["z"]}, guess=0.3,
               drivers=("t",)),
        Effect("side reaction on charge", {"z": lambda t, s, p, u, c: -c["a"] * np.maximum(u["i"], 0.0) / p["Q"]},
               guess=0.1, drivers=("t", "z")),
        Effect("charge transfer", outputs={"V": lambda t, s, p, u, y, c: y + c["a"] * np.arcsinh(u["i"] / c["i0"])},
               shapes={"i0": (0.05, 0.25, "i")}, guess=0.02),
        Effect("resistance of an empty cell", outputs={
            "V": lambda t, s, p, u, y, c: y + c["a"] * u["i"] * (1 - s["z"]) ** 2
        }, guess=0.1, drivers=("t",)),
        Effect("slow diffusion", {"slow": lambda t, s, p, u, c: (u["i"] - s["slow"]) / c["time"]},
               outputs={"V": lambda t, s, p, u, y, c: y + c["a"] * s["slow"]}, hidden={"slow": 0.0},
               shapes={"time": (0.12, 0.4, "t")}, guess=0.03),
        Effect("non-linear conductance", {"v": lambda t, s, p, u, c: -c["a"] * s["v"] ** 3}, guess=300.0),
        Effect("offset of the ammeter", {
            "z": lambda t, s, p, u, c: c["a"] / p["Q"] + 0 * s["z"],
            "v": lambda t, s, p, u, c: c["a"] * p["R1"] / p["tau"] + 0 * s["z"],
        }, outputs={"V": lambda t, s, p, u, y, c: y + c["a"] * p["R0"]}, sign=0, guess=0.2),
        *sensors("V", only=("offset", "drift")),
        Effect("hysteresis", {"side": lambda t, s, p, u, c: c["rate"] * (u["i"] - abs(u["i"]) * s["side"])},
               outputs={"V": lambda t, s, p, u, y, c: y + c["a"] * s["side"]}, hidden={"side": 0.0},
               shapes={"rate": (0.4, 1.2, None)}, library=False, guess=0.02),
        Effect("phase change in the electrode", outputs={
            "V": lambda t, s, p, u, y, c: y + c["a"] * swing((s["z"] - c["at"]) / 0.08)
        }, shapes={"at": (0.45, 0.65, "z")}, sign=0, library=False, guess=0.03),
    ),
    ("self-discharge", "parasitic load"),
    {"z": "", "v": "V"},
    lambda t, s, p, u: {"z": u["i"] / p["Q"], "v": (p["R1"] * u["i"] - s["v"]) / p["tau"]},
    {"i": "A", "V": "V"},
    late=4,
    positive=("z",),
    scales={"z": 0.5, "v": 0.05},
)  # fmt: skip


# --- a car on a road: force at the wheels, grade and heading are given; a run without force may follow ------


def _draw_car(rng: Rng) -> Setting:
    def run(t: Array, force: Array, speed: float) -> RunSetting:
        grade = sines(rng, t, rng.uniform(0.01, 0.025), 0.015, 0.1, 4)
        heading = rng.uniform(0, 2 * np.pi) + sines(rng, t, rng.uniform(1.5, 3.5), 0.008, 0.04)
        return RunSetting(t, {"F": force, "grade": grade, "H": heading}, {"v": speed})

    t = times(rng, rng.uniform(260, 420), 130, 220)
    runs = [run(t, steps(rng, t, 0.25, 1.0, 7), rng.uniform(14, 26))]
    if rng.random() < 0.5:
        t = times(rng, rng.uniform(50, 80), 60, 80)
        runs.append(run(t, 0 * t, rng.uniform(30, 36)))
    return Setting(tuple(runs), observed=("v",))


def _pull(s, p, u):  # type: ignore[no-untyped-def]
    return u["F"] / p["m"] - GRAVITY * (p["c"] + u["grade"]) - p["k"] * s["v"] ** 2 / 1000


def _wind(along):  # type: ignore[no-untyped-def]
    """Drag in a wind against the car, ``along(t, s, u, c)`` in m/s, without that of still air."""

    def rate(t, s, p, u, c):  # type: ignore[no-untyped-def]
        w = along(t, s, u, c)
        return -p["k"] * w * (2 * s["v"] + w) / 1000

    return {"v": rate}


car = Family(
    "car on a road",
    "vehicle dynamics",
    (Base("m", "t", (1.1, 2.0), 0.1), Base("c", "", (0.008, 0.018)), Base("k", "1/km", (0.25, 0.5))),
    _draw_car,
    {"v": lambda t, s, p, u: s["v"]},
    (
        Effect("linear drag", {"v": lambda t, s, p, u, c: -c["a"] * s["v"]}, guess=0.01, drivers=("t", "v")),
        Effect("cubic drag", {"v": lambda t, s, p, u, c: -c["a"] * s["v"] ** 3}, guess=1e-5, drivers=("t",)),
        Effect("copper loss", {"v": lambda t, s, p, u, c: -c["a"] * u["F"] ** 2 / p["m"]}, guess=0.3, drivers=("t",)),
        Effect("iron that saturates", {"v": lambda t, s, p, u, c: -c["a"] * u["F"] ** 3 / p["m"]}, guess=0.3,
               drivers=("t",)),
        Effect("loss with speed and force", {"v": lambda t, s, p, u, c: -c["a"] * u["F"] * s["v"] / (30 * p["m"])},
               guess=0.3, drivers=("t",)),
        Effect("wind from the north", _wind(lambda t, s, u, c: c["a"] * np.cos(u["H"])), sign=0, guess=3.0,
               within=(0.0, 15.0, None), drivers=("t",)),
        Effect("wind from the east", _wind(lambda t, s, u, c: c["a"] * np.sin(u["H"])), sign=0, guess=3.0,
               within=(0.0, 15.0, None), drivers=("t",)),
        Effect("rotating masses", {"v": lambda t, s, p, u, c: -c["a"] / (1 + c["a"]) * _pull(s, p, u)}, guess=0.2,
               within=(0.0, 0.6, None)),
        Effect("tyres that warm up", {"v": lambda t, s, p, u, c: -GRAVITY * p["c"] * c["a"] * np.exp(-t / 100)},
               guess=1.0),
        *sensors("v", only=("offset", "gain error")),
        Effect("gusts", _wind(lambda t, s, u, c: c["a"] * np.sin(c["rate"] * t)),
               shapes={"rate": (0.08, 0.2, None)}, library=False, guess=3.0),
        Effect("load that sloshes", {
            "v": lambda t, s, p, u, c: c["a"] * c["tuned"] ** 2 * s["slosh"],
            "slosh": lambda t, s, p, u, c: s["flow"],
            "flow": lambda t, s, p, u, c: -c["tuned"] ** 2 * s["slosh"] - 0.05 * s["flow"] - _pull(s, p, u),
        }, hidden={"slosh": 0.0, "flow": 0.0}, shapes={"tuned": (0.15, 0.35, None)}, library=False, guess=0.3),
    ),
    ("copper loss", "iron that saturates"),
    {"v": "m/s"},
    lambda t, s, p, u: {"v": _pull(s, p, u)},
    {"F": "kN", "grade": "", "H": "rad"},
    late=4,
    positive=("v",),
    scales={"v": 10.0},
)  # fmt: skip


# --- water in the root zone of a field; rain and potential evaporation are given ---------------------------


def _draw_soil(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(60, 110), 130, 240)
    rain = np.zeros_like(t)
    at = rng.uniform(0, 6)
    while at < t[-1]:
        rain += rng.uniform(8, 35) * np.maximum(1 - abs(t - at) / rng.uniform(0.8, 1.8), 0.0)
        at += rng.exponential(6.0)
    air = 3.5 + sines(rng, t, 1.5, 0.06, 1.0)
    run = RunSetting(t, {"R": rain, "E": air}, {"S": rng.uniform(80, 170)}, ("S",) if rng.random() < 0.2 else ())
    return Setting((run,), observed=("S", "D") if rng.random() < 0.4 else ("S",))


def _drained(s, p):  # type: ignore[no-untyped-def]
    return p["d"] * (np.maximum(s["S"], 0.15) / 150) ** p["b"]


def _drunk(s, p, u):  # type: ignore[no-untyped-def]
    return p["e"] * u["E"] * s["S"] / 150


def _ease(s, c):  # type: ignore[no-untyped-def]
    """What a dry soil leaves of the evaporation."""
    return s["S"] ** 2 / (s["S"] ** 2 + c["a"] * 150**2)


soil = Family(
    "soil moisture",
    "hydrology",
    (Base("e", "", (0.6, 1.2)), Base("d", "mm/d", (2.0, 8.0)), Base("b", "", (3.0, 6.0), 1.0, 15.0)),
    _draw_soil,
    {"S": lambda t, s, p, u: s["S"], "D": lambda t, s, p, u: _drained(s, p)},
    (
        Effect("bypass", {"S": lambda t, s, p, u, c: -c["a"] * u["R"]}, guess=0.2, drivers=("t", "R", "S")),
        Effect("pump saturation", {"S": lambda t, s, p, u, c: -c["a"] * np.maximum(u["R"] - c["knee"], 0.0)},
               shapes={"knee": (0.15, 0.5, "R")}, guess=0.5),
        Effect("overflow", {"S": lambda t, s, p, u, c: -c["a"] * np.maximum(s["S"] - c["rim"], 0.0) ** 1.5},
               shapes={"rim": (0.6, 0.85, "S")}, guess=0.02),
        Effect("seepage", {"S": lambda t, s, p, u, c: -c["a"] * s["S"]}, guess=0.01, drivers=("t", "S")),
        Effect("evaporation", {"S": lambda t, s, p, u, c: -c["a"] + 0 * s["S"]}, drivers=("t",)),
        Effect("second tank", {
            "S": lambda t, s, p, u, c: -c["a"] * (s["S"] - s["deep"]),
            "deep": lambda t, s, p, u, c: (s["S"] - s["deep"]) / c["time"],
        }, hidden={"deep": "S"}, shapes={"time": (0.1, 0.3, "t")}, guess=0.02),
        Effect("runoff from wet soil", {"S": lambda t, s, p, u, c: -c["a"] * u["R"] * (s["S"] / 150) ** 2}, guess=0.2,
               drivers=("t",)),
        Effect("roots that run dry", {"S": lambda t, s, p, u, c: _drunk(s, p, u) * (1 - _ease(s, c))}, guess=0.2,
               factors={"e": lambda t, s, p, u, c: _ease(s, c)}),
        Effect("crop that grows", {"S": lambda t, s, p, u, c: -_drunk(s, p, u) * c["a"] * t / 100}, guess=0.5,
               factors={"e": lambda t, s, p, u, c: 1 + c["a"] * t / 100}),
        *sensors("S", only=("offset", "gain error", "drift")),
        Effect("water table that swings", {"S": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t)},
               shapes={"rate": (0.3, 0.8, None)}, library=False),
        Effect("cracks in dry soil", {
            "S": lambda t, s, p, u, c: -c["a"] * u["R"] / (1 + np.exp(np.clip((s["S"] - c["at"]) / 4, -60, 60)))
        }, shapes={"at": (0.5, 0.7, "S")}, library=False, guess=0.5),
    ),
    ("bypass", "pump saturation"),
    {"S": "mm"},
    lambda t, s, p, u: {"S": u["R"] - _drunk(s, p, u) - _drained(s, p)},
    {"R": "mm/d", "E": "mm/d", "D": "mm/d"},
    late=4,
    positive=("S",),
    scales={"S": 100.0},
)  # fmt: skip


# --- an epidemic; how often people meet is given; the ill are counted, and those with antibodies -------------


def _draw_epidemic(rng: Rng) -> Setting:
    length = int(rng.integers(110, 180))
    t = np.arange(length + 1.0)
    meet = steps(rng, t, 0.35, 1.1, 6)
    ill = rng.uniform(1, 12)
    start = {"S": rng.uniform(850, 990) - ill, "I": ill}
    run = RunSetting(t, {"m": meet}, start, ("S",) if rng.random() < 0.6 else ())
    return Setting((run,), observed=("I", "A") if rng.random() < 0.5 else ("I",))


def _caught(s, p, u):  # type: ignore[no-untyped-def]
    return p["b"] * u["m"] * s["S"] * s["I"] / 1000


def _spread(factor):  # type: ignore[no-untyped-def]
    """What a factor on the contacts adds to both equations, and the factor itself."""
    return {
        "rates": {
            "S": lambda t, s, p, u, c: -_caught(s, p, u) * (factor(t, s, c) - 1),
            "I": lambda t, s, p, u, c: _caught(s, p, u) * (factor(t, s, c) - 1),
        },
        "factors": {"b": lambda t, s, p, u, c: factor(t, s, c)},
    }


epidemic = Family(
    "epidemic",
    "epidemiology",
    (Base("b", "1/d", (0.2, 0.4)), Base("g", "1/d", (0.08, 0.15))),
    _draw_epidemic,
    {"I": lambda t, s, p, u: s["I"], "A": lambda t, s, p, u: 1000 - s["S"] - s["I"]},
    (
        Effect("waning immunity", {"S": lambda t, s, p, u, c: c["a"] * (1000 - s["S"] - s["I"])}, guess=0.005,
               drivers=("t",)),
        Effect("births and deaths", {
            "S": lambda t, s, p, u, c: c["a"] * (1000 - s["S"]),
            "I": lambda t, s, p, u, c: -c["a"] * s["I"],
        }, guess=0.005),
        Effect("vaccination", {"S": lambda t, s, p, u, c: -c["a"] * s["S"]}, guess=0.003, drivers=("t",)),
        Effect("imported cases", {"I": lambda t, s, p, u, c: c["a"] + 0 * s["I"]}, drivers=("t",)),
        Effect("caution", **_spread(lambda t, s, c: 1 / (1 + c["a"] * s["I"] / 100)), guess=0.3),
        Effect("unequal contacts", **_spread(lambda t, s, c: (np.maximum(s["S"], 1e-3) / 1000) ** c["a"]), guess=0.5),
        Effect("season", **_spread(lambda t, s, c: 1 + c["a"] * np.cos(2 * np.pi * t / 365)), sign=0, guess=0.2,
               within=(0.0, 0.9, None)),
        Effect("isolation", {"I": lambda t, s, p, u, c: -c["a"] * s["I"] ** 2 / 100}, guess=0.03, drivers=("t",)),
        Effect("tests that run short", outputs={"I": lambda t, s, p, u, y, c: y / (1 + c["a"] * y / 100)}, guess=0.3),
        *sensors("I", only=("gain error", "drift")),
        Effect("weeks of the calendar", **_spread(lambda t, s, c: 1 + c["a"] * np.sin(2 * np.pi * t / 7 + c["day"])),
               shapes={"day": (0.5, 6.0, None)}, library=False, guess=0.3),
        Effect("festival", {
            "S": lambda t, s, p, u, c: -c["a"] * np.exp(-(((t - c["at"]) / 4) ** 2)) * s["S"] / 1000,
            "I": lambda t, s, p, u, c: c["a"] * np.exp(-(((t - c["at"]) / 4) ** 2)) * s["S"] / 1000,
        }, shapes={"at": (0.15, 0.6, "t")}, library=False),
        Effect("late onset", {
            "I": lambda t, s, p, u, c: -c["a"] * _caught(s, p, u) + s["latent"] / c["time"],
            "latent": lambda t, s, p, u, c: c["a"] * _caught(s, p, u) - s["latent"] / c["time"],
        }, hidden={"latent": 0.0}, shapes={"time": (4.0, 12.0, None)}, library=False, guess=0.3,
               within=(0.0, 1.0, None)),
    ),
    ("waning immunity", "births and deaths"),
    {"S": "1/1000", "I": "1/1000"},
    lambda t, s, p, u: {"S": -_caught(s, p, u), "I": _caught(s, p, u) - p["g"] * s["I"]},
    {"m": "", "A": "1/1000"},
    late=4,
    positive=("S", "I"),
    scales={"S": 500.0, "I": 50.0},
)  # fmt: skip


# --- adsorption of a gas over pressure and temperature, with some water in the gas ---------------------------


def _draw_isotherm(rng: Rng) -> Setting:
    number = int(rng.integers(80, 160))
    return Setting(
        x={
            "p": np.exp(rng.uniform(np.log(0.05), np.log(12.0), number)),
            "T": rng.uniform(283, 343, number),
            "w": rng.uniform(0, 20, number),
        },
        observed=("q",),
    )


def _affinity(p, u):  # type: ignore[no-untyped-def]
    return p["K"] * np.exp(p["H"] / 8.314e-3 * (1 / u["T"] - 1 / 313))


def _attracted(p, u, c):  # type: ignore[no-untyped-def]
    """Coverage θ = K e^(aθ) p/(1 + K e^(aθ) p), by a damped iteration."""
    bare = _affinity(p, u) * u["p"]
    share = bare / (1 + bare)
    for _ in range(200):
        pulled = bare * np.exp(c["a"] * share)
        share = 0.5 * share + 0.5 * pulled / (1 + pulled)
    return share


def _sips(p, u, c):  # type: ignore[no-untyped-def]
    x = (_affinity(p, u) * u["p"]) ** (1 - c["a"])
    return p["qm"] * x / (1 + x)


def _toth(p, u, c):  # type: ignore[no-untyped-def]
    x, n = _affinity(p, u) * u["p"], 1 - c["a"]
    return p["qm"] * x / (1 + x**n) ** (1 / n)


def _beside_water(p, u, c):  # type: ignore[no-untyped-def]
    x = _affinity(p, u) * u["p"]
    return p["qm"] * x / (1 + x + c["a"] * u["w"] / 10)


isotherm = Family(
    "adsorption",
    "surface chemistry",
    (Base("qm", "mol/kg", (2.0, 5.0)), Base("K", "1/bar", (0.3, 1.5)), Base("H", "kJ/mol", (14.0, 30.0), None)),
    _draw_isotherm,
    {"q": lambda t, s, p, u: p["qm"] * _affinity(p, u) * u["p"] / (1 + _affinity(p, u) * u["p"])},
    (
        Effect("Sips's law", outputs={"q": lambda t, s, p, u, y, c: _sips(p, u, c)}, guess=0.2,
               within=(0.0, 0.7, None)),
        Effect("Toth's law", outputs={"q": lambda t, s, p, u, y, c: _toth(p, u, c)}, guess=0.2,
               within=(0.0, 0.7, None)),
        Effect("lateral attraction", outputs={"q": lambda t, s, p, u, y, c: p["qm"] * _attracted(p, u, c)}, sign=0,
               guess=0.5, within=(0.0, 2.0, None)),
        Effect("water on the sites", outputs={"q": lambda t, s, p, u, y, c: _beside_water(p, u, c)}, guess=0.3,
               drivers=("w", "T")),
        Effect("several layers", outputs={"q": lambda t, s, p, u, y, c: y / (1 - c["a"] * u["p"] / 12)}, guess=0.1,
               within=(0.0, 0.8, None), drivers=("p",)),
        Effect("second site", outputs={"q": lambda t, s, p, u, y, c: y + c["a"] * u["p"] / (u["p"] + c["far"])},
               shapes={"far": (0.5, 3.0, "p")}),
        Effect("capacity that falls with heat", outputs={
            "q": lambda t, s, p, u, y, c: y * (1 - c["a"] * (u["T"] - 313) / 30)
        }, sign=0, guess=0.2, drivers=("p", "w")),
        Effect("void volume", outputs={"q": lambda t, s, p, u, y, c: y + c["a"] * u["p"] * 313 / u["T"]}, sign=0,
               guess=0.05, drivers=("T", "w")),
        *sensors("q", only=("offset",)),
        Effect("gate that opens", outputs={
            "q": lambda t, s, p, u, y, c: y + c["a"] / (1 + np.exp(-(u["p"] - c["at"]) / 0.15))
        }, shapes={"at": (0.15, 0.5, "p")}, library=False),
        Effect("framework that turns", outputs={
            "q": lambda t, s, p, u, y, c: y * (1 + c["a"] * swing((u["T"] - c["at"]) / 9))
        }, shapes={"at": (300.0, 325.0, None)}, sign=0, library=False, guess=0.2),
    ),
    ("Sips's law", "Toth's law"),
    units={"p": "bar", "T": "K", "w": "mbar", "q": "mol/kg"},
    late=4,
)  # fmt: skip

FAMILIES = (cell, car, soil, epidemic, isotherm)
