"""Kinetics: a batch reactor A → B → C, a stirred tank with its temperature."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import sensors
from benchmarks.concealed.families.inputs import sines, times

Rng = np.random.Generator


def _draw_batch(rng: Rng) -> Setting:
    runs = []
    for _ in range(int(rng.integers(2, 4))):
        t = times(rng, rng.uniform(8, 16), 60, 120)
        start = {"A": rng.uniform(0.5, 2.5), "B": rng.uniform(0.0, 0.3)}
        runs.append(RunSetting(t, {}, start, ("B",) if rng.random() < 0.3 else ()))
    return Setting(tuple(runs), observed=("A", "B") if rng.random() < 0.7 else ("B",))


def _moved(rate):  # type: ignore[no-untyped-def]
    """A rate from A to B."""
    return {
        "A": lambda t, s, p, u, c: -rate(t, s, p, u, c),
        "B": lambda t, s, p, u, c: rate(t, s, p, u, c),
    }


batch = Family(
    "batch reactor",
    "kinetics",
    (Base("k1", "1/h", (0.3, 0.8)), Base("k2", "1/h", (0.1, 0.4))),
    _draw_batch,
    {"A": lambda t, s, p, u: s["A"], "B": lambda t, s, p, u: s["B"]},
    (
        Effect("reverse reaction", _moved(lambda t, s, p, u, c: -c["a"] * s["B"])),
        Effect("second-order decay", {"A": lambda t, s, p, u, c: -c["a"] * s["A"] ** 2}, drivers=("t",)),
        Effect(
            "reaction order",
            _moved(lambda t, s, p, u, c: p["k1"] * s["A"] * (np.maximum(s["A"], 1e-6) ** c["a"] - 1)),
            factors={"k1": lambda t, s, p, u, c: np.maximum(s["A"], 1e-6) ** c["a"]},
            sign=0, guess=0.3,
        ),
        Effect(
            "saturation",
            _moved(lambda t, s, p, u, c: -p["k1"] * s["A"] * (c["a"] * s["A"] / (1 + c["a"] * s["A"]))), guess=0.3,
            factors={"k1": lambda t, s, p, u, c: 1 / (1 + c["a"] * s["A"])},
        ),
        Effect("autocatalysis", _moved(lambda t, s, p, u, c: c["a"] * s["A"] * s["B"]), drivers=("t",)),
        Effect("second branch", {"A": lambda t, s, p, u, c: -c["a"] * s["A"]}),
        Effect(
            "product inhibition",
            _moved(lambda t, s, p, u, c: -p["k1"] * s["A"] * (c["a"] * s["B"] / (1 + c["a"] * s["B"]))), guess=0.3,
            factors={"k1": lambda t, s, p, u, c: 1 / (1 + c["a"] * s["B"])},
        ),
        Effect(
            "deactivation",
            _moved(lambda t, s, p, u, c: p["k1"] * s["A"] * np.expm1(-c["a"] * t)), guess=0.05,
            factors={"k1": lambda t, s, p, u, c: np.exp(-c["a"] * t)},
        ),
        *sensors("B", only=("offset", "gain error", "drift", "lag")),
        Effect(
            "poisoned catalyst",
            _moved(lambda t, s, p, u, c: -p["k1"] * s["A"] * (1 - np.exp(-((t / c["time"]) ** 4))) * c["a"]),
            shapes={"time": (0.2, 0.45, "t")},
            library=False,
            most=0.6,
        ),
        Effect(
            "light that flickers",
            {"B": lambda t, s, p, u, c: -c["a"] * np.sin(c["rate"] * t) * s["B"]},
            shapes={"rate": (1.0, 2.5, None)},
            library=False,
        ),
        Effect(
            "stored intermediate",
            {
                "B": lambda t, s, p, u, c: -c["a"] * (s["B"] - s["store"]),
                "store": lambda t, s, p, u, c: (s["B"] - s["store"]) / c["time"],
            },
            hidden={"store": 0.0},
            shapes={"time": (0.1, 0.3, "t")},
            library=False,
        ),
    ),
    ("reaction order", "saturation"),
    {"A": "mol/l", "B": "mol/l"},
    lambda t, s, p, u: {"A": -p["k1"] * s["A"], "B": p["k1"] * s["A"] - p["k2"] * s["B"]},
    {},
)  # fmt: skip


# --- a stirred tank: concentration and temperature, both fed -----------------------------------------


def _draw_stirred(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(20, 35), 150, 260)
    feed = 1.5 + sines(rng, t, rng.uniform(0.6, 1.0), 0.3, 1.5)
    jacket = 300 + sines(rng, t, rng.uniform(10, 18), 0.2, 1.2)
    run = RunSetting(t, {"cf": feed, "Tj": jacket}, {"C": rng.uniform(0.5, 1.5), "T": rng.uniform(305, 325)}, ())
    return Setting((run,), observed=("C", "T") if rng.random() < 0.6 else ("T",))


def _arrhenius(s, p):  # type: ignore[no-untyped-def]
    return p["k"] * np.exp(p["E"] * (1 - 315.0 / s["T"])) * s["C"]


def _both(rate, heat=20.0):  # type: ignore[no-untyped-def]
    return {
        "C": lambda t, s, p, u, c: -rate(t, s, p, u, c),
        "T": lambda t, s, p, u, c: heat * rate(t, s, p, u, c),
    }


stirred = Family(
    "stirred tank",
    "kinetics",
    (
        Base("k", "1/min", (0.3, 0.9)),
        Base("E", "", (8.0, 18.0)),
        Base("U", "1/min", (0.2, 0.6)),
    ),
    _draw_stirred,
    {"C": lambda t, s, p, u: s["C"], "T": lambda t, s, p, u: s["T"]},
    (
        Effect(
            "reaction order",
            _both(lambda t, s, p, u, c: _arrhenius(s, p) * (np.maximum(s["C"], 1e-6) ** c["a"] - 1)),
            factors={"k": lambda t, s, p, u, c: np.maximum(s["C"], 1e-6) ** c["a"]},
            sign=0, guess=0.3,
        ),
        Effect("second-order decay", {"C": lambda t, s, p, u, c: -c["a"] * s["C"] ** 2}, drivers=("t",)),
        Effect(
            "saturation",
            _both(lambda t, s, p, u, c: -_arrhenius(s, p) * (c["a"] * s["C"] / (1 + c["a"] * s["C"]))), guess=0.3,
            factors={"k": lambda t, s, p, u, c: 1 / (1 + c["a"] * s["C"])},
        ),
        Effect("second branch", {"C": lambda t, s, p, u, c: -c["a"] * s["C"]}, drivers=("t", "T")),
        Effect("radiation", {
            "T": lambda t, s, p, u, c: -c["a"] * ((s["T"] / 100) ** 4 - (u["Tj"] / 100) ** 4)
        }),
        Effect("natural convection", {
            "T": lambda t, s, p, u, c: -c["a"] * np.sign(s["T"] - u["Tj"]) * abs(s["T"] - u["Tj"]) ** 1.25
        }, drivers=("t",)),
        *sensors("T", only=("offset", "drift", "lag")),
        Effect(
            "jacket that fouls",
            {"T": lambda t, s, p, u, c: c["a"] * p["U"] * (s["T"] - u["Tj"]) * (1 - np.exp(-((t / c["time"]) ** 4)))},
            shapes={"time": (0.3, 0.6, "t")},
            library=False,
        ),
        Effect(
            "stirrer that pulsates",
            {"T": lambda t, s, p, u, c: -c["a"] * np.sin(c["rate"] * t) * (s["T"] - u["Tj"])},
            shapes={"rate": (1.0, 3.0, None)},
            library=False,
        ),
    ),
    ("reaction order", "saturation"),
    {"C": "mol/l", "T": "K"},
    lambda t, s, p, u: {
        "C": 0.5 * (u["cf"] - s["C"]) - _arrhenius(s, p),
        "T": 0.5 * (300.0 - s["T"]) + 20.0 * _arrhenius(s, p) - p["U"] * (s["T"] - u["Tj"]),
    },
    {"cf": "mol/l", "Tj": "K"},
    scales={"C": 1.0, "T": 10.0},
)  # fmt: skip

FAMILIES = (batch, stirred)
