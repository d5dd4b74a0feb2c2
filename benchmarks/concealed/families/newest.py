"""Families written after the tool was frozen at commit 7703746: they are alone in sets from seed 2000 on."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import sensors, swing
from benchmarks.concealed.families.inputs import sines, steps, times

Rng = np.random.Generator


# --- prey and predators, counted through the years ------------------------------------------------------


def _draw_prey(rng: Rng) -> Setting:
    runs = []
    for _ in range(int(rng.integers(1, 3))):
        t = times(rng, rng.uniform(18, 30), 120, 220)
        runs.append(RunSetting(t, {}, {"N": rng.uniform(0.5, 2.0), "P": rng.uniform(0.4, 1.5)}))
    return Setting(tuple(runs), observed=("N", "P") if rng.random() < 0.8 else ("N",))


def _busy(s, p, c):  # type: ignore[no-untyped-def]
    return c["a"] * s["N"] / (1 + c["a"] * s["N"]) * s["N"] * s["P"]


prey = Family(
    "prey and predators",
    "ecology",
    (Base("r", "1/a", (0.6, 1.2)), Base("b", "1/a", (0.5, 1.0)), Base("g", "1/a", (0.3, 0.8)),
     Base("d", "1/a", (0.4, 0.8))),
    _draw_prey,
    {"N": lambda t, s, p, u: s["N"], "P": lambda t, s, p, u: s["P"]},
    (
        Effect("crowding", {"N": lambda t, s, p, u, c: -c["a"] * s["N"] ** 2}, drivers=("t", "P")),
        Effect("strong crowding", {"N": lambda t, s, p, u, c: -c["a"] * s["N"] ** 3}),
        Effect("sated predators", {
            "N": lambda t, s, p, u, c: p["b"] * _busy(s, p, c),
            "P": lambda t, s, p, u, c: -p["g"] * _busy(s, p, c),
        }, guess=0.1),
        Effect("immigration", {"N": lambda t, s, p, u, c: c["a"] + 0 * s["N"]}, drivers=("t",)),
        Effect("crowded predators", {"P": lambda t, s, p, u, c: -c["a"] * s["P"] ** 2}, drivers=("t",)),
        Effect("predators that come by", {"P": lambda t, s, p, u, c: c["a"] + 0 * s["P"]}),
        *sensors("N", only=("offset", "drift")),
        Effect("seasons", {"N": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t) * s["N"]},
               shapes={"rate": (1.5, 3.0, None)}, library=False),
        Effect("disease", {
            "P": lambda t, s, p, u, c: -c["a"] * s["germs"] * s["P"],
            "germs": lambda t, s, p, u, c: s["P"] - s["germs"] / c["time"],
        }, hidden={"germs": 0.0}, shapes={"time": (0.1, 0.3, "t")}, library=False),
    ),
    ("crowding", "strong crowding"),
    {"N": "1", "P": "1"},
    lambda t, s, p, u: {
        "N": p["r"] * s["N"] - p["b"] * s["N"] * s["P"],
        "P": p["g"] * s["N"] * s["P"] - p["d"] * s["P"],
    },
    late=2,
    positive=("N", "P"),
)  # fmt: skip


# --- a tumbling body with thrusters about two axes -----------------------------------------------------------


def _draw_tumbling(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(12, 20), 140, 240)
    torques = {"m": steps(rng, t, -0.6, 0.8, 5), "n": sines(rng, t, 0.5, 0.4, 2.0)}
    start = {name: rng.uniform(0.5, 1.5) * rng.choice([-1, 1]) for name in ("w1", "w2", "w3")}
    observed = ("w1", "w2", "w3") if rng.random() < 0.6 else ("w1", "w2")
    return Setting((RunSetting(t, torques, start),), observed=observed)


def _speed(s):  # type: ignore[no-untyped-def]
    return np.sqrt(s["w1"] ** 2 + s["w2"] ** 2 + s["w3"] ** 2 + 1e-12)


AXES = ("w1", "w2", "w3")

tumbling = Family(
    "tumbling body",
    "rigid bodies",
    (Base("A", "", (0.3, 0.7)), Base("B", "", (0.4, 0.9)), Base("C", "", (0.2, 0.5)), Base("c", "1/s", (0.02, 0.08))),
    _draw_tumbling,
    {"w1": lambda t, s, p, u: s["w1"], "w2": lambda t, s, p, u: s["w2"], "w3": lambda t, s, p, u: s["w3"]},
    (
        Effect("quadratic drag", {w: (lambda t, s, p, u, c, w=w: -c["a"] * _speed(s) * s[w]) for w in AXES},
               drivers=("t",)),
        Effect("cubic drag", {w: (lambda t, s, p, u, c, w=w: -c["a"] * _speed(s) ** 2 * s[w]) for w in AXES}),
        Effect("misaligned thruster", {"w2": lambda t, s, p, u, c: c["a"] * u["m"]}, sign=0, drivers=("t", "w1")),
        Effect("bias torque", {"w3": lambda t, s, p, u, c: c["a"] + 0 * s["w3"]}, sign=0, drivers=("t", "w2")),
        Effect("spinning wheel", {
            "w1": lambda t, s, p, u, c: -c["a"] * s["w2"],
            "w2": lambda t, s, p, u, c: c["a"] * s["w1"],
        }, sign=0),
        Effect("product of inertia", {"w1": lambda t, s, p, u, c: c["a"] * (s["w3"] ** 2 - s["w2"] ** 2)}, sign=0),
        *sensors("w1", only=("offset", "gain error", "lag")),
        Effect("torque that swings", {"w2": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t)},
               shapes={"rate": (2.0, 4.0, None)}, library=False),
        Effect("sloshing fuel", {
            "w1": lambda t, s, p, u, c: c["a"] * (s["fuel"] - s["w1"]),
            "fuel": lambda t, s, p, u, c: s["flow"],
            "flow": lambda t, s, p, u, c: c["tuned"] ** 2 * (s["w1"] - s["fuel"]),
        }, hidden={"fuel": "w1", "flow": 0.0}, shapes={"tuned": (2.0, 4.0, None)}, library=False),
    ),
    ("quadratic drag", "cubic drag"),
    {"w1": "rad/s", "w2": "rad/s", "w3": "rad/s"},
    lambda t, s, p, u: {
        "w1": p["A"] * s["w2"] * s["w3"] - p["c"] * s["w1"] + u["m"],
        "w2": -p["B"] * s["w1"] * s["w3"] - p["c"] * s["w2"],
        "w3": p["C"] * s["w1"] * s["w2"] - p["c"] * s["w3"] + u["n"],
    },
    {"m": "rad/s^2", "n": "rad/s^2"},
    late=2,
)  # fmt: skip


# --- the flow through a control valve --------------------------------------------------------------------------


def _draw_valve(rng: Rng) -> Setting:
    number = int(rng.integers(70, 150))
    return Setting(
        x={"x": rng.uniform(0.1, 1.0, number), "dp": rng.uniform(0.2, 6.0, number), "T": rng.uniform(10, 80, number)},
        observed=("Q",),
    )


valve = Family(
    "valve",
    "hydraulics",
    (Base("C", "m^3/h", (1.0, 3.0)), Base("R", "", (2.5, 4.0))),
    _draw_valve,
    {"Q": lambda t, s, p, u: p["C"] * np.exp(p["R"] * (u["x"] - 1)) * np.sqrt(u["dp"])},
    (
        Effect("leakage", outputs={"Q": lambda t, s, p, u, y, c: y + c["a"] * np.sqrt(u["dp"])}, drivers=("T",)),
        Effect("linear trim", outputs={"Q": lambda t, s, p, u, y, c: y + c["a"] * u["x"] * np.sqrt(u["dp"])}, sign=0),
        Effect("square trim", outputs={"Q": lambda t, s, p, u, y, c: y + c["a"] * u["x"] ** 2 * np.sqrt(u["dp"])},
               sign=0),
        Effect("choked flow", outputs={"Q": lambda t, s, p, u, y, c: y / np.sqrt(1 + c["a"] * u["dp"])}, guess=0.03,
               drivers=("x",)),
        Effect("viscosity", outputs={"Q": lambda t, s, p, u, y, c: y * (1 + c["a"] * (u["T"] - 45) / 35)}, sign=0,
               drivers=("x", "dp")),
        Effect("offset of Q", outputs={"Q": lambda t, s, p, u, y, c: y + c["a"]}, sign=0),
        Effect("whistling", outputs={"Q": lambda t, s, p, u, y, c: y + c["a"] * np.sin(u["dp"] / c["pitch"])},
               shapes={"pitch": (0.2, 0.4, None)}, library=False, most=0.3),
        Effect("cavitation", outputs={
            "Q": lambda t, s, p, u, y, c: y * (1 - c["a"] * swing((u["dp"] - c["at"]) / 0.8))
        }, shapes={"at": (2.0, 4.5, None)}, library=False, guess=0.1),
    ),
    ("leakage", "square trim"),
    units={"x": "1", "dp": "bar", "T": "degC"},
    late=2,
)  # fmt: skip

FAMILIES = (prey, tumbling, valve)
