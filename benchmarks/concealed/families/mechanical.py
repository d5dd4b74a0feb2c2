"""Mechanics: a forced oscillator, a pendulum, falling bodies, two coupled masses."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import mechanics, sensors
from benchmarks.concealed.families.inputs import sines, times

Rng = np.random.Generator


# --- a mass on a spring, driven by a measured force (per unit mass) ---------------------------------


def _draw_oscillator(rng: Rng) -> Setting:
    only_position = rng.random() < 0.5
    runs = []
    for _ in range(int(rng.integers(1, 3))):
        t = times(rng, rng.uniform(12, 25), 100, 240)
        force = sines(rng, t, rng.uniform(2, 6), 0.6, 4.0)
        start = {"x": rng.uniform(-1, 1), "v": rng.uniform(-1, 1)}
        runs.append(RunSetting(t, {"f": force}, start, ("x",) if rng.random() < 0.4 else ()))
    return Setting(tuple(runs), observed=("x",) if only_position else ("x", "v"))


oscillator = Family(
    "oscillator",
    "mechanics",
    (Base("k", "1/s^2", (2.0, 9.0)), Base("c", "1/s", (0.1, 0.5))),
    _draw_oscillator,
    {"x": lambda t, s, p, u: s["x"], "v": lambda t, s, p, u: s["v"]},
    (
        *mechanics("x", "v"),
        *sensors("x", only=("gain error", "drift", "lag", "saturation", "non-linearity")),
    ),
    ("quadratic drag", "cubic drag"),
    {"x": "m", "v": "m/s"},
    lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]},
    {"f": "m/s^2"},
)


# --- a pendulum in the small-angle model, let go from large angles -----------------------------------


def _draw_pendulum(rng: Rng) -> Setting:
    runs = []
    for _ in range(int(rng.integers(1, 4))):
        t = times(rng, rng.uniform(12, 20), 100, 200)
        runs.append(RunSetting(t, {}, {"q": rng.choice([-1, 1]) * rng.uniform(0.5, 2.0), "w": rng.uniform(-0.5, 0.5)}))
    return Setting(tuple(runs), observed=("q",))


pendulum = Family(
    "pendulum",
    "mechanics",
    (Base("k", "1/s^2", (3.0, 12.0)), Base("c", "1/s", (0.02, 0.15))),
    _draw_pendulum,
    {"q": lambda t, s, p, u: s["q"]},
    (
        Effect(
            "large-angle sine",
            {"w": lambda t, s, p, u, c: c["a"] * (s["q"] - np.sin(s["q"]))},
            most=0.4,
        ),
        *mechanics(
            "q",
            "w",
            only=(
                "quadratic drag",
                "cubic drag",
                "Coulomb friction",
                "cubic stiffness",
                "position-dependent damping",
                "stiffness that pulsates",
                "hidden absorber",
            ),
        ),
    ),
    ("large-angle sine", "cubic stiffness"),
    {"q": "rad", "w": "rad/s"},
    lambda t, s, p, u: {"q": s["w"], "w": -p["k"] * s["q"] - p["c"] * s["w"]},
    {},
)


# --- bodies thrown up and dropped; gravity and linear drag are calibrated -----------------------------


def _draw_falling(rng: Rng) -> Setting:
    runs = []
    for _ in range(int(rng.integers(2, 4))):
        t = times(rng, rng.uniform(2.5, 5.0), 60, 120)
        speed = rng.uniform(-25, 8)
        runs.append(RunSetting(t, {}, {"z": 0.0, "v": speed}, ("z",)))
    return Setting(tuple(runs), observed=("z", "v") if rng.random() < 0.5 else ("z",))


falling = Family(
    "falling body",
    "mechanics",
    (Base("g", "m/s^2", (9.0, 10.5)), Base("c", "1/s", (0.02, 0.1))),
    _draw_falling,
    {"z": lambda t, s, p, u: s["z"], "v": lambda t, s, p, u: s["v"]},
    (
        *mechanics(
            "z", "v", only=("quadratic drag", "cubic drag", "Coulomb friction", "drag of power 1.5"), most=0.5
        ),
        *sensors("z", only=("gain error", "drift", "lag")),
        Effect(
            "gusts",
            {"v": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t)},
            shapes={"rate": (3.0, 8.0, None)},
            library=False,
        ),
        Effect(
            "added mass at start",
            {"v": lambda t, s, p, u, c: -c["a"] * p["g"] * np.exp(-t / c["time"])},
            shapes={"time": (0.1, 0.25, "t")},
            library=False,
        ),
    ),
    ("quadratic drag", "cubic drag"),
    {"z": "m", "v": "m/s"},
    lambda t, s, p, u: {"z": s["v"], "v": p["g"] - p["c"] * s["v"]},
    {},
    scales={"z": 10.0, "v": 10.0},
)


# --- two masses on springs, the first one driven ----------------------------------------------------


def _draw_two_masses(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(15, 25), 150, 260)
    force = sines(rng, t, rng.uniform(3, 8), 0.6, 4.0, 4)
    start = {"x1": rng.uniform(-1, 1), "v1": 0.0, "x2": rng.uniform(-1, 1), "v2": 0.0}
    run = RunSetting(t, {"f": force}, start, ("v1", "v2") if rng.random() < 0.5 else ())
    return Setting((run,), observed=("x1", "x2") if rng.random() < 0.7 else ("x1",))


def _two_masses(t, s, p, u):  # type: ignore[no-untyped-def]
    pull = p["k2"] * (s["x2"] - s["x1"])
    return {
        "x1": s["v1"],
        "v1": -p["k1"] * s["x1"] - p["c1"] * s["v1"] + pull + u["f"],
        "x2": s["v2"],
        "v2": -pull - p["c2"] * s["v2"],
    }


def _coupling(t, s, p, u, c):  # type: ignore[no-untyped-def]
    return c["a"] * (s["x2"] - s["x1"]) ** 3


two_masses = Family(
    "two masses",
    "mechanics",
    (
        Base("k1", "1/s^2", (3.0, 8.0)),
        Base("k2", "1/s^2", (1.5, 5.0)),
        Base("c1", "1/s", (0.1, 0.4)),
        Base("c2", "1/s", (0.1, 0.4)),
    ),
    _draw_two_masses,
    {"x1": lambda t, s, p, u: s["x1"], "x2": lambda t, s, p, u: s["x2"]},
    (
        *mechanics(
            "x1",
            "v1",
            only=(
                "quadratic drag",
                "cubic drag",
                "Coulomb friction",
                "cubic stiffness",
                "stiffness that pulsates",
                "washboard",
            ),
        ),
        Effect("cubic coupling", {"v1": _coupling, "v2": lambda t, s, p, u, c: -_coupling(t, s, p, u, c)}, sign=0),
        Effect("linear coupling damping", {
            "v1": lambda t, s, p, u, c: c["a"] * (s["v2"] - s["v1"]),
            "v2": lambda t, s, p, u, c: -c["a"] * (s["v2"] - s["v1"]),
        }),
        Effect(
            "force that leaks to the second mass",
            {"v2": lambda t, s, p, u, c: c["a"] * u["f"]},
        ),
        Effect(
            "third mass",
            {
                "v2": lambda t, s, p, u, c: c["a"] * (s["rider"] - s["x2"]),
                "rider": lambda t, s, p, u, c: s["rider rate"],
                "rider rate": lambda t, s, p, u, c: c["tuned"] ** 2 * (s["x2"] - s["rider"]),
            },
            hidden={"rider": "x2", "rider rate": 0.0},
            shapes={"tuned": (0.8, 1.6, None)},
            library=False,
        ),
    ),
    ("quadratic drag", "cubic drag"),
    {"x1": "m", "v1": "m/s", "x2": "m", "v2": "m/s"},
    _two_masses,
    {"f": "m/s^2"},
)  # fmt: skip

FAMILIES = (oscillator, pendulum, falling, two_masses)
