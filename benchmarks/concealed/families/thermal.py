"""Heat: a cooling body, a heated room with its wall."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import sensors, swing
from benchmarks.concealed.families.inputs import sines, steps, times

Rng = np.random.Generator
ZERO = 273.15


def vapour(celsius):  # type: ignore[no-untyped-def]
    """Saturation pressure of water in hPa (Magnus formula)."""
    return 6.112 * np.exp(17.62 * celsius / (243.12 + celsius))


def _convection(t, s, p, u, c):  # type: ignore[no-untyped-def]
    gap = s["T"] - u["Ta"]
    return -c["a"] * np.sign(gap) * abs(gap) ** 1.25


def _radiation(t, s, p, u, c):  # type: ignore[no-untyped-def]
    return -c["a"] * (((s["T"] + ZERO) / 100) ** 4 - ((u["Ta"] + ZERO) / 100) ** 4)


def _evaporation(t, s, p, u, c):  # type: ignore[no-untyped-def]
    return -c["a"] * (vapour(s["T"]) - vapour(u["Ta"]))


def _draw_cooling(rng: Rng) -> Setting:
    runs = []
    for _ in range(int(rng.integers(1, 3))):
        t = times(rng, rng.uniform(120, 200), 100, 220)
        ambient = rng.uniform(10, 25) + sines(rng, t, rng.uniform(0.5, 3), 0.02, 0.1)
        runs.append(RunSetting(t, {"Ta": ambient}, {"T": rng.uniform(70, 95)}))
    return Setting(tuple(runs), observed=("T",))


cooling = Family(
    "cooling body",
    "thermal",
    (Base("h", "1/min", (0.01, 0.03)),),
    _draw_cooling,
    {"T": lambda t, s, p, u: s["T"]},
    (
        Effect("natural convection", {"T": _convection}, drivers=("t", "T")),
        Effect("radiation", {"T": _radiation}, drivers=("t",)),
        Effect("evaporation", {"T": _evaporation}, drivers=("t",)),
        Effect(
            "second heat capacity",
            {
                "T": lambda t, s, p, u, c: c["a"] * (s["core"] - s["T"]),
                "core": lambda t, s, p, u, c: (s["T"] - s["core"]) / c["time"],
            },
            hidden={"core": "T"},
            shapes={"time": (0.15, 0.5, "t")},
        ),
        Effect("ambient drift", {"T": lambda t, s, p, u, c: p["h"] * c["a"] * t}, sign=0, guess=0.01),
        Effect(
            "temperature-dependent loss",
            {"T": lambda t, s, p, u, c: -c["a"] * abs(s["T"] - u["Ta"]) * (s["T"] - u["Ta"])}, sign=0, most=0.4,
        ),
        Effect("internal heat source", {"T": lambda t, s, p, u, c: c["a"] + 0 * s["T"]}, sign=0, drivers=("t",)),
        *sensors("T", only=("offset", "gain error", "drift")),
        Effect(
            "fan that cycles",
            {"T": lambda t, s, p, u, c: -c["a"] * np.sin(c["rate"] * t) * (s["T"] - u["Ta"])},
            shapes={"rate": (0.08, 0.2, None)},
            library=False,
        ),
        Effect(
            "supercooling and release",
            {
                "T": lambda t, s, p, u, c: c["a"] * p["h"] * (s["T"] - u["Ta"])
                * swing((s["T"] - c["melts"]) / c["width"])
            },
            shapes={"melts": (0.5, 0.7, "T"), "width": (0.04, 0.08, "T")},
            library=False,
            most=0.5,
        ),
    ),
    ("natural convection", "radiation"),
    {"T": "degC"},
    lambda t, s, p, u: {"T": -p["h"] * (s["T"] - u["Ta"])},
    {"Ta": "degC"},
    scales={"T": 20.0},
)  # fmt: skip


# --- a heated room: air and wall, the air is measured -------------------------------------------------


def _draw_room(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(48, 96), 150, 280)
    outside = rng.uniform(0, 12) + rng.uniform(3, 7) * np.sin(2 * np.pi * t / 24 + rng.uniform(0, 6)) + sines(
        rng, t, 1.5, 0.3, 1.5
    )
    heat = steps(rng, t, 0.0, 8.0, int(rng.integers(5, 9)))
    run = RunSetting(t, {"To": outside, "q": heat}, {"T": rng.uniform(15, 22), "W": rng.uniform(12, 20)})
    return Setting((run,), observed=("T",))


room = Family(
    "heated room",
    "thermal",
    (
        Base("a", "1/h", (0.15, 0.4)),
        Base("b", "1/h", (0.3, 0.8)),
        Base("d", "1/h", (0.03, 0.1)),
        Base("e", "K/h/kW", (0.6, 1.4)),
    ),
    _draw_room,
    {"T": lambda t, s, p, u: s["T"]},
    (
        Effect(
            "natural convection",
            {"T": lambda t, s, p, u, c: -c["a"] * np.sign(s["T"] - u["To"]) * abs(s["T"] - u["To"]) ** 1.25},
            drivers=("t", "T"),
        ),
        Effect(
            "radiation",
            {"T": lambda t, s, p, u, c: -c["a"] * (((s["T"] + ZERO) / 100) ** 4 - ((u["To"] + ZERO) / 100) ** 4)},
            drivers=("t",),
        ),
        Effect(
            "window",
            {"T": lambda t, s, p, u, c: -c["a"] * (s["T"] - u["To"]) * _open(s["T"], c["opens"], 0.15)},
            shapes={"opens": (0.7, 0.9, "T")},
        ),
        Effect(
            "heater that saturates",
            {"T": lambda t, s, p, u, c: -c["a"] * p["e"] * u["q"] ** 2},
            guess=0.02,
        ),
        Effect(
            "sun",
            {"T": lambda t, s, p, u, c: c["a"] * np.maximum(0.0, np.sin(2 * np.pi * (t - 6) / 24))},
        ),
        *sensors("T", only=("offset", "gain error", "drift", "lag")),
        Effect(
            "people at work",
            {"T": lambda t, s, p, u, c: c["a"] * np.sin(2 * np.pi * t / c["period"])},
            shapes={"period": (9.0, 15.0, None)},
            library=False,
        ),
        Effect(
            "wind on the wall",
            {"W": lambda t, s, p, u, c: -c["a"] * (s["W"] - u["To"]) * (1 + np.sin(c["rate"] * t))},
            shapes={"rate": (0.15, 0.22, None)},
            library=False,
        ),
    ),
    ("natural convection", "radiation"),
    {"T": "degC", "W": "degC"},
    lambda t, s, p, u: {
        "T": -p["a"] * (s["T"] - u["To"]) - p["b"] * (s["T"] - s["W"]) + p["e"] * u["q"],
        "W": p["d"] * (s["T"] - s["W"]),
    },
    {"To": "degC", "q": "kW"},
    scales={"T": 10.0, "W": 10.0},
)


def _open(z, threshold, width):  # type: ignore[no-untyped-def]
    return 0.5 * (1 + np.tanh(0.5 * (z - threshold) / width))


FAMILIES = (cooling, room)
