"""Families written after the tool was frozen at commit b95a60c: they are alone in sets from seed 5000 on."""

import numpy as np

from benchmarks.concealed.families.base import Array, Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import sensors, swing
from benchmarks.concealed.families.inputs import sines, steps, times

Rng = np.random.Generator


# --- a quarter of a car: body and wheel on a rough road, whose height is given --------------------------------

BODY = 0.32
"""Mass of the body, t: it was weighed."""


def _road(rng: Rng, t: Array) -> Array:
    """Height in cm: long waves, short ones, and two bumps."""
    height = sines(rng, t, rng.uniform(1.2, 2.5), 3.0, 12.0, 4) + sines(rng, t, rng.uniform(0.4, 0.9), 12.0, 45.0, 4)
    for at in rng.uniform(0.1, 0.8, 2) * t[-1]:
        height += rng.uniform(1.5, 4.0) * np.maximum(1 - abs(t - at) / rng.uniform(0.06, 0.15), 0.0)
    return height


def _draw_quarter(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(2.0, 2.8), 115, 165)
    rested = rng.random() < 0.6
    road = _road(rng, t)
    if rested:
        start = {"x": 0.0, "v": 0.0, "w": 0.0, "q": 0.0}
        road *= np.clip(t / 0.1, 0.0, 1.0)
    else:
        start = {"x": rng.uniform(-1.5, 1.5), "v": rng.uniform(-10, 10), "w": road[0], "q": rng.uniform(-10, 10)}
    observed = [("x", "w"), ("x",), ("w",)][int(rng.choice(3, p=[0.5, 0.35, 0.15]))]
    return Setting((RunSetting(t, {"h": road}, start, tuple(start) if rested else ()),), observed=observed)


def _strut(force):  # type: ignore[no-untyped-def]
    """A force ``force(z, rate, s, c)`` between body and wheel, z apart, that draws them together."""

    def between(s, c):  # type: ignore[no-untyped-def]
        return force(s["x"] - s["w"], s["v"] - s["q"], s, c)

    return {
        "v": lambda t, s, p, u, c: -between(s, c) / BODY,
        "q": lambda t, s, p, u, c: between(s, c) / p["m"],
    }


quarter = Family(
    "quarter car",
    "vehicle dynamics",
    (Base("m", "t", (0.03, 0.055), 0.005), Base("k", "kN/m", (14.0, 28.0)), Base("c", "kN s/m", (0.9, 2.0)),
     Base("kt", "kN/m", (110.0, 190.0))),
    _draw_quarter,
    {"x": lambda t, s, p, u: s["x"], "w": lambda t, s, p, u: s["w"]},
    (
        Effect("progressive spring", _strut(lambda z, rate, s, c: c["a"] * z**3), drivers=("t",)),
        Effect("bump stop", _strut(lambda z, rate, s, c: c["a"] * np.sign(z) * np.maximum(abs(z) - c["gap"], 0.0)),
               shapes={"gap": (0.3, 0.7, "x")}, guess=20.0),
        Effect("turbulent damper", _strut(lambda z, rate, s, c: c["a"] * abs(rate) * rate), guess=0.01,
               drivers=("t",)),
        Effect("damper that hardens", _strut(lambda z, rate, s, c: c["a"] * rate**3), guess=1e-4, drivers=("t",)),
        Effect("damper softer in compression", _strut(lambda z, rate, s, c: c["a"] * abs(rate)), guess=0.5,
               drivers=("t", "x")),
        Effect("friction in the strut", _strut(lambda z, rate, s, c: c["a"] * np.tanh(rate / c["width"])),
               shapes={"width": (0.05, 0.12, "v")}, guess=20.0, drivers=("t",)),
        Effect("rubber mount", {
            **_strut(lambda z, rate, s, c: c["a"] * s["give"]),
            "give": lambda t, s, p, u, c: s["v"] - s["q"] - s["give"] / c["time"],
        }, hidden={"give": 0.0}, shapes={"time": (0.03, 0.12, "t")}, guess=10.0),
        Effect("tyre that hardens", {"q": lambda t, s, p, u, c: -c["a"] * (s["w"] - u["h"]) ** 3 / p["m"]}, guess=30.0,
               drivers=("t", "h")),
        Effect("tyre that leaves the road", {
            "q": lambda t, s, p, u, c: c["a"] * np.maximum(s["w"] - u["h"] - c["sag"], 0.0) / p["m"]
        }, shapes={"sag": (0.05, 0.15, "w")}, guess=80.0, within=(0.0, 190.0, None)),
        *sensors("x", only=("offset", "gain error", "drift")),
        Effect("seat on a spring", {
            "v": lambda t, s, p, u, c: c["a"] * (s["seat"] - s["x"]) / BODY,
            "seat": lambda t, s, p, u, c: s["seat rate"],
            "seat rate": lambda t, s, p, u, c: c["tuned"] ** 2 * (s["x"] - s["seat"]),
        }, hidden={"seat": "x", "seat rate": "v"}, shapes={"tuned": (12.0, 28.0, None)}, library=False, guess=5.0),
        Effect("wheel out of round", {"q": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t) / p["m"]},
               shapes={"rate": (25.0, 60.0, None)}, library=False, guess=30.0),
        Effect("spring with a clonk", _strut(lambda z, rate, s, c: c["a"] * swing((z - c["at"]) / 0.4)),
               shapes={"at": (-0.2, 0.2, "x")}, sign=0, library=False, guess=20.0),
    ),
    ("turbulent damper", "damper that hardens"),
    {"x": "cm", "v": "cm/s", "w": "cm", "q": "cm/s"},
    lambda t, s, p, u: {
        "x": s["v"],
        "v": -(p["k"] * (s["x"] - s["w"]) + p["c"] * (s["v"] - s["q"])) / BODY,
        "w": s["q"],
        "q": (p["k"] * (s["x"] - s["w"]) + p["c"] * (s["v"] - s["q"]) - p["kt"] * (s["w"] - u["h"])) / p["m"],
    },
    {"h": "cm"},
    late=5,
    scales={"x": 2.0, "v": 15.0, "w": 2.0, "q": 40.0},
)  # fmt: skip


# --- an enzyme in a fed batch: substrate flows in, product stays; Michaelis and Menten's law ------------------

FEED = 150.0
"""Substrate in the feed, mmol/l, as its label says."""


def _draw_reactor(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(12, 24), 80, 140)
    flow = steps(rng, t, 0.0, 0.06, 5) * rng.uniform(0.7, 1.2)
    start = {"S": rng.uniform(8, 40), "P": 0.0 if rng.random() < 0.7 else rng.uniform(2, 15), "V": 1.0}
    known = ("S", "P", "V") if rng.random() < 0.4 else ("P", "V")
    observed = [("S", "P"), ("S",), ("P",)][int(rng.choice(3, p=[0.65, 0.1, 0.25]))]
    return Setting((RunSetting(t, {"F": flow}, start, known),), observed=observed)


def _converted(s, p):  # type: ignore[no-untyped-def]
    return p["r"] / s["V"] * s["S"] / (p["K"] + s["S"])


def _hindered(factor):  # type: ignore[no-untyped-def]
    """What a factor on the enzyme adds to both equations, and the factor itself."""
    return {
        "rates": {
            "S": lambda t, s, p, u, c: -_converted(s, p) * (factor(t, s, p, c) - 1),
            "P": lambda t, s, p, u, c: _converted(s, p) * (factor(t, s, p, c) - 1),
        },
        "factors": {"r": lambda t, s, p, u, c: factor(t, s, p, c)},
    }


def _together(s, p, c):  # type: ignore[no-untyped-def]
    """Hill's law over Michaelis and Menten's."""
    ratio = np.maximum(s["S"], 1e-6) / p["K"]
    return ratio ** c["a"] * (1 + ratio) / (1 + ratio ** (1 + c["a"]))


reactor = Family(
    "enzyme reactor",
    "biochemistry",
    (Base("r", "mmol/h", (5.0, 11.0)), Base("K", "mmol/l", (4.0, 15.0), 0.05)),
    _draw_reactor,
    {"S": lambda t, s, p, u: s["S"], "P": lambda t, s, p, u: s["P"]},
    (
        Effect("substrate inhibition", **_hindered(
            lambda t, s, p, c: (p["K"] + s["S"]) / (p["K"] + s["S"] + c["a"] * s["S"] ** 2)
        ), guess=0.02),
        Effect("product inhibition", **_hindered(lambda t, s, p, c: 1 / (1 + c["a"] * np.maximum(s["P"], 0.0))),
               guess=0.01),
        Effect("product that competes", **_hindered(
            lambda t, s, p, c: (p["K"] + s["S"]) / (p["K"] * (1 + c["a"] * np.maximum(s["P"], 0.0)) + s["S"])
        ), guess=0.03),
        Effect("deactivation", **_hindered(lambda t, s, p, c: np.exp(-c["a"] * t)), guess=0.03),
        Effect("cooperative binding", **_hindered(lambda t, s, p, c: _together(s, p, c)), guess=0.3,
               within=(0.0, 2.0, None)),
        Effect("reverse reaction", {
            "S": lambda t, s, p, u, c: c["a"] * s["P"],
            "P": lambda t, s, p, u, c: -c["a"] * s["P"],
        }, guess=0.02, drivers=("t",)),
        Effect("consecutive reaction", {"P": lambda t, s, p, u, c: -c["a"] * s["P"]}, guess=0.02, drivers=("t", "P")),
        Effect("second branch", {"S": lambda t, s, p, u, c: -c["a"] * s["S"]}, guess=0.03, drivers=("t", "S")),
        Effect("feed off its label", {"S": lambda t, s, p, u, c: c["a"] * u["F"] / s["V"]}, sign=0, guess=15.0,
               within=(0.0, 75.0, None), drivers=("t",)),
        *sensors("P", only=("gain error", "drift")),
        *sensors("S", only=("offset",)),
        Effect("jacket that cycles", **_hindered(lambda t, s, p, c: 1 + c["a"] * np.sin(c["rate"] * t)),
               shapes={"rate": (0.7, 1.6, None)}, library=False, guess=0.3, within=(0.0, 0.9, None)),
        Effect("acid that swings", **_hindered(lambda t, s, p, c: 1 + c["a"] * swing((s["P"] - c["at"]) / 8)),
               shapes={"at": (0.3, 0.7, "P")}, sign=0, library=False, guess=0.3, within=(0.0, 0.9, None)),
        Effect("powder that dissolves late", {
            "S": lambda t, s, p, u, c: c["a"] * np.exp(-(((t - c["at"]) / 0.8) ** 2)) / s["V"]
        }, shapes={"at": (0.2, 0.7, "t")}, library=False, guess=3.0),
    ),
    ("product inhibition", "product that competes"),
    {"S": "mmol/l", "P": "mmol/l", "V": "l"},
    lambda t, s, p, u: {
        "S": u["F"] / s["V"] * (FEED - s["S"]) - _converted(s, p),
        "P": _converted(s, p) - u["F"] / s["V"] * s["P"],
        "V": u["F"],
    },
    {"F": "l/h"},
    late=5,
    positive=("S",),
    scales={"S": 20.0, "P": 30.0, "V": 1.0},
)  # fmt: skip


# --- carbon that a leaf takes up, by light, carbon dioxide, temperature and dryness of the air -----------------


def _draw_leaf(rng: Rng) -> Setting:
    number = int(rng.integers(75, 121))
    warmth = rng.uniform(12, 37, number)
    return Setting(
        x={
            "I": 20 + 1800 * rng.uniform(0, 1, number) ** 1.5,
            "C": np.exp(rng.uniform(np.log(75.0), np.log(1100.0), number)),
            "T": warmth,
            "D": 0.4 + 0.06 * (warmth - 12) + rng.uniform(0, 1.6, number),
        },
        observed=("A",),
    )


def _gross(p, light, carbon):  # type: ignore[no-untyped-def]
    """Before respiration: a rectangular hyperbola in light, whose ceiling is one in carbon dioxide."""
    slope, ceiling = p["f"] * light, p["Am"] * carbon / (carbon + p["Kc"])
    return slope * ceiling / (slope + ceiling)


def _bent(p, u, c):  # type: ignore[no-untyped-def]
    """The smaller root G of a G² - (x + y) G + x y = 0."""
    x, y = p["f"] * u["I"], p["Am"] * u["C"] / (u["C"] + p["Kc"])
    return 2 * x * y / (x + y + np.sqrt((x + y) ** 2 - 4 * c["a"] * x * y))


def _sharper(p, u, c):  # type: ignore[no-untyped-def]
    x, y, n = p["f"] * u["I"], p["Am"] * u["C"] / (u["C"] + p["Kc"]), 1 + c["a"]
    return (x**-n + y**-n) ** (-1 / n)


def _drawn_down(p, u, c):  # type: ignore[no-untyped-def]
    """G = gross(C - a (G - R)), a quadratic equation in G."""
    light, start = p["f"] * u["I"], u["C"] + c["a"] * p["R"]
    square = c["a"] * (light + p["Am"])
    linear = light * p["Kc"] + (light + p["Am"]) * start + c["a"] * light * p["Am"]
    rest = light * p["Am"] * start
    return 2 * rest / (linear + np.sqrt(linear**2 - 4 * square * rest))


def _instead(gross):  # type: ignore[no-untyped-def]
    """Another gross uptake ``gross(p, u, c)`` in place of the base's."""
    return {"A": lambda t, s, p, u, y, c: y + gross(p, u, c) - _gross(p, u["I"], u["C"])}


def _scaled(factor):  # type: ignore[no-untyped-def]
    """The gross uptake times ``factor(u, c)``."""
    return {"A": lambda t, s, p, u, y, c: y + _gross(p, u["I"], u["C"]) * (factor(u, c) - 1)}


leaf = Family(
    "leaf",
    "plant physiology",
    (Base("f", "", (0.03, 0.08)), Base("Am", "umol/m^2/s", (25.0, 60.0)), Base("Kc", "ppm", (200.0, 500.0), 1.0),
     Base("R", "umol/m^2/s", (0.8, 3.0), None)),
    _draw_leaf,
    {"A": lambda t, s, p, u: _gross(p, u["I"], u["C"]) - p["R"]},
    (
        Effect("curvature of the light response", outputs=_instead(_bent), guess=0.5, within=(0.0, 0.97, None)),
        Effect("sharper limit", outputs=_instead(_sharper), guess=0.5, within=(0.0, 5.0, None)),
        Effect("photoinhibition", outputs=_scaled(lambda u, c: np.exp(-c["a"] * u["I"] / 1000)), guess=0.2,
               drivers=("T", "I")),
        Effect("photorespiration", outputs=_instead(lambda p, u, c: _gross(p, u["I"], u["C"] - c["a"])), guess=40.0,
               within=(0.0, 65.0, None)),
        Effect("optimum of temperature", outputs=_scaled(lambda u, c: np.exp(-c["a"] * ((u["T"] - 25) / 10) ** 2)),
               guess=0.3, drivers=("I", "C")),
        Effect("respiration that warms", outputs={
            "A": lambda t, s, p, u, y, c: y - p["R"] * np.expm1(c["a"] * (u["T"] - 25) / 10)
        }, guess=0.7, within=(0.0, 1.6, None)),
        Effect("stomata that close", outputs=_instead(
            lambda p, u, c: _gross(p, u["I"], u["C"] / (1 + c["a"] * u["D"]))
        ), guess=0.2, drivers=("T", "D")),
        Effect("resistance in the leaf", outputs=_instead(_drawn_down), guess=5.0, within=(0.0, 40.0, None)),
        Effect("leak of the chamber", outputs={"A": lambda t, s, p, u, y, c: y + c["a"] * (u["C"] - 400) / 100},
               sign=0, guess=0.3, drivers=("T", "D")),
        Effect("light wasted on oxygen", outputs=_instead(
            lambda p, u, c: _gross(p, u["I"] * u["C"] / (u["C"] + c["a"]), u["C"])
        ), guess=80.0, within=(0.0, 400.0, None)),
        Effect("drift of A", outputs={"A": lambda t, s, p, u, y, c: y + c["a"] * (u["D"] - 1.5)}, sign=0),
        Effect("chloroplasts that turn", outputs=_scaled(
            lambda u, c: 1 + c["a"] * swing(np.log(u["I"] / c["at"]) / 0.5)
        ), shapes={"at": (200.0, 900.0, None)}, sign=0, library=False, guess=0.2),
        Effect("membrane that melts", outputs=_scaled(lambda u, c: 1 + c["a"] * swing((u["T"] - c["at"]) / 4)),
               shapes={"at": (19.0, 31.0, None)}, sign=0, library=False, guess=0.2),
        Effect("stomata that snap open", outputs=_scaled(
            lambda u, c: 1 + c["a"] * swing((u["D"] - c["at"]) / 0.5)
        ), shapes={"at": (1.2, 2.3, None)}, sign=0, library=False, guess=0.2),
    ),
    ("curvature of the light response", "sharper limit"),
    units={"I": "umol/m^2/s", "C": "ppm", "T": "degC", "D": "kPa", "A": "umol/m^2/s"},
    late=5,
)  # fmt: skip


# --- a generator that swings against a grid; the load beside it is given --------------------------------------


def _draw_generator(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(4.0, 6.5), 110, 170)
    load = steps(rng, t, 0.0, 0.75, 6) + sines(rng, t, 0.08, 1.0, 9.0)
    start = {"d": rng.uniform(0.15, 0.6), "w": 0.0 if rng.random() < 0.5 else rng.uniform(-0.8, 0.8)}
    known = ("w",) if start["w"] == 0 else ()
    observed = [("d", "w"), ("w",), ("d",)][int(rng.choice(3, p=[0.45, 0.35, 0.2]))]
    return Setting((RunSetting(t, {"L": load}, start, known),), observed=observed)


def _torque(power):  # type: ignore[no-untyped-def]
    """A power ``power(t, s, p, u, c)`` that speeds the rotor up."""
    return {"w": lambda t, s, p, u, c: power(t, s, p, u, c) / p["M"]}


generator = Family(
    "power grid swing",
    "power systems",
    (Base("M", "s^2", (0.02, 0.045), 0.002), Base("D", "s", (0.02, 0.06)), Base("b", "", (1.4, 2.3)),
     Base("Pm", "", (0.7, 1.0))),
    _draw_generator,
    {"d": lambda t, s, p, u: s["d"], "w": lambda t, s, p, u: s["w"]},
    (
        Effect("salient poles", _torque(lambda t, s, p, u, c: -c["a"] * np.sin(2 * s["d"])), guess=0.2,
               drivers=("t",)),
        Effect("voltage that sags", _torque(lambda t, s, p, u, c: c["a"] * p["b"] * np.sin(s["d"]) ** 3), guess=0.3,
               drivers=("t",)),
        Effect("losses in the line", _torque(lambda t, s, p, u, c: -c["a"] * np.cos(s["d"])), sign=0, guess=0.2,
               drivers=("t",)),
        Effect("governor", {
            **_torque(lambda t, s, p, u, c: -c["a"] * s["gate"]),
            "gate": lambda t, s, p, u, c: (s["w"] - s["gate"]) / c["time"],
        }, hidden={"gate": 0.0}, shapes={"time": (0.03, 0.15, "t")}, guess=0.1),
        Effect("flux that decays", {
            **_torque(lambda t, s, p, u, c: c["a"] * p["b"] * s["flux"] * np.sin(s["d"])),
            "flux": lambda t, s, p, u, c: (1 - np.cos(s["d"]) - s["flux"]) / c["time"],
        }, hidden={"flux": 0.0}, shapes={"time": (0.04, 0.3, "t")}, guess=0.5, within=(0.0, 3.0, None)),
        Effect("windage", _torque(lambda t, s, p, u, c: -c["a"] * abs(s["w"]) * s["w"]), guess=0.03,
               drivers=("t", "d")),
        Effect("damper that fades with the angle", _torque(
            lambda t, s, p, u, c: -c["a"] * np.cos(s["d"]) ** 2 * s["w"]
        ), guess=0.05, drivers=("t",)),
        Effect("load that follows the frequency", _torque(lambda t, s, p, u, c: -c["a"] * u["L"] * s["w"]), guess=0.1,
               drivers=("t", "w")),
        Effect("load that follows the voltage", _torque(
            lambda t, s, p, u, c: c["a"] * u["L"] * (1 - np.cos(s["d"]))
        ), guess=1.0, within=(0.0, 4.0, None), drivers=("t",)),
        *sensors("w", only=("offset", "gain error")),
        *sensors("d", only=("drift",)),
        Effect("shaft that twists", {
            **_torque(lambda t, s, p, u, c: c["a"] * (s["turbine"] - s["d"])),
            "turbine": lambda t, s, p, u, c: s["turbine rate"],
            "turbine rate": lambda t, s, p, u, c: c["tuned"] ** 2 * (s["d"] - s["turbine"]),
        }, hidden={"turbine": "d", "turbine rate": "w"}, shapes={"tuned": (10.0, 18.0, None)}, library=False),
        Effect("wind farm that pulsates", _torque(lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t)),
               shapes={"rate": (3.5, 12.0, None)}, library=False, guess=0.1),
        Effect("relay that chatters", _torque(lambda t, s, p, u, c: c["a"] * swing((s["d"] - c["at"]) / 0.08)),
               shapes={"at": (0.3, 0.7, "d")}, sign=0, library=False, guess=0.1),
    ),
    ("salient poles", "voltage that sags"),
    {"d": "rad", "w": "rad/s"},
    lambda t, s, p, u: {
        "d": s["w"],
        "w": (p["Pm"] - u["L"] - p["b"] * np.sin(s["d"]) - p["D"] * s["w"]) / p["M"],
    },
    {"L": ""},
    late=5,
    scales={"d": 0.5, "w": 1.0},
)  # fmt: skip


# --- a catchment: soil over groundwater, both of which feed the stream; rain and possible evaporation are given -


def _draw_catchment(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(80, 130), 110, 170)
    rain = np.zeros_like(t)
    at = rng.uniform(0, 5)
    while at < t[-1]:
        rain += rng.uniform(5, 25) * np.maximum(1 - abs(t - at) / rng.uniform(0.9, 2.0), 0.0)
        at += min(rng.exponential(5.0), 12.0)
    air = 2.8 + sines(rng, t, 1.5, 0.04, 0.8)
    start = {"S": rng.uniform(5, 35), "G": rng.uniform(15, 70)}
    run = RunSetting(t, {"R": rain, "E": air}, start)
    return Setting((run,), observed=("Q", "G") if rng.random() < 0.5 else ("Q",))


def _evaporated(s, p, u):  # type: ignore[no-untyped-def]
    return p["e"] * u["E"] * s["S"] / (20 + s["S"])


def _to_stream(flow):  # type: ignore[no-untyped-def]
    """Water ``flow(s, u, c)`` that the soil loses to the stream at once."""
    return {
        "rates": {"S": lambda t, s, p, u, c: -flow(s, u, c)},
        "outputs": {"Q": lambda t, s, p, u, y, c: y + flow(s, u, c)},
    }


catchment = Family(
    "catchment",
    "hydrology",
    (Base("e", "", (0.6, 1.1)), Base("r", "", (0.3, 0.6), 0.0, 1.0), Base("T1", "d", (2.5, 6.0), 0.3),
     Base("T2", "d", (15.0, 45.0), 1.0)),
    _draw_catchment,
    {"Q": lambda t, s, p, u: (1 - p["r"]) * s["S"] / p["T1"] + s["G"] / p["T2"], "G": lambda t, s, p, u: s["G"]},
    (
        Effect("paved ground", **_to_stream(lambda s, u, c: c["a"] * u["R"]), guess=0.1, drivers=("t", "S")),
        Effect("runoff from wet soil", **_to_stream(lambda s, u, c: c["a"] * u["R"] * s["S"] / 50), guess=0.2,
               drivers=("t", "S")),
        Effect("overflow", **_to_stream(lambda s, u, c: c["a"] * np.maximum(s["S"] - c["rim"], 0.0)),
               shapes={"rim": (0.4, 0.75, "S")}, guess=0.2),
        Effect("quick flow that grows", **_to_stream(lambda s, u, c: c["a"] * (s["S"] / 20) ** 2), guess=0.5),
        Effect("flow through macropores", **_to_stream(lambda s, u, c: c["a"] * (s["S"] / 20) ** 3), guess=0.3),
        Effect("deep leakage", {"G": lambda t, s, p, u, c: -c["a"] * s["G"]}, guess=0.01, drivers=("t",)),
        Effect("deep aquifer", {
            "G": lambda t, s, p, u, c: -c["a"] * (s["G"] - s["deep"]),
            "deep": lambda t, s, p, u, c: (s["G"] - s["deep"]) / c["time"],
        }, hidden={"deep": "G"}, shapes={"time": (0.08, 0.3, "t")}, guess=0.03),
        Effect("leaves that grow", {"S": lambda t, s, p, u, c: -_evaporated(s, p, u) * c["a"] * t / 100}, guess=0.5,
               within=(0.0, 2.5, None), factors={"e": lambda t, s, p, u, c: 1 + c["a"] * t / 100}),
        Effect("rain gauge in the wind", {"S": lambda t, s, p, u, c: c["a"] * u["R"]}, guess=0.1,
               within=(0.0, 0.6, None), drivers=("t", "R")),
        *sensors("Q", only=("gain error", "drift")),
        *sensors("G", only=("offset",)),
        Effect("mill with a sluice", outputs={
            "Q": lambda t, s, p, u, y, c: y * (1 + c["a"] * np.sin(2 * np.pi * t / 7 + c["day"]))
        }, shapes={"day": (0.5, 6.0, None)}, library=False, guess=0.2, within=(0.0, 0.9, None)),
        Effect("siphon in the karst", {"G": lambda t, s, p, u, c: c["a"] * swing((s["G"] - c["at"]) / 4)},
               shapes={"at": (0.55, 0.85, "G")}, sign=0, library=False),
        Effect("cloudburst beside the gauge", {
            "S": lambda t, s, p, u, c: c["a"] * np.exp(-(((t - c["at"]) / 1.5) ** 2))
        }, shapes={"at": (0.15, 0.8, "t")}, library=False, guess=5.0),
    ),
    ("quick flow that grows", "flow through macropores"),
    {"S": "mm", "G": "mm"},
    lambda t, s, p, u: {
        "S": u["R"] - _evaporated(s, p, u) - s["S"] / p["T1"],
        "G": p["r"] * s["S"] / p["T1"] - s["G"] / p["T2"],
    },
    {"R": "mm/d", "E": "mm/d", "Q": "mm/d"},
    late=5,
    positive=("S", "G"),
    scales={"S": 20.0, "G": 40.0},
)  # fmt: skip

FAMILIES = (quarter, reactor, leaf, generator, catchment)
