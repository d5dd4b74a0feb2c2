"""Families kept for the test: no development set may hold them."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import sensors, swing
from benchmarks.concealed.families.inputs import sines, steps, times

Rng = np.random.Generator


# --- a motor with its load; the voltage is given, speed and current are measured --------------------------


def _draw_motor(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(8, 14), 150, 260)
    voltage = steps(rng, t, -6.0, 8.0, 5) + sines(rng, t, 2.0, 1.0, 5.0)
    run = RunSetting(t, {"e": voltage}, {"i": rng.uniform(-0.5, 0.5), "w": rng.uniform(-1, 1)})
    return Setting((run,), observed=("w", "i") if rng.random() < 0.5 else ("w",))


motor = Family(
    "motor",
    "electromechanics",
    (Base("R", "ohm", (0.8, 2.0)), Base("K", "N m/A", (0.5, 1.2)), Base("b", "1/s", (0.1, 0.4))),
    _draw_motor,
    {"w": lambda t, s, p, u: s["w"], "i": lambda t, s, p, u: s["i"]},
    (
        Effect("quadratic drag", {"w": lambda t, s, p, u, c: -c["a"] * abs(s["w"]) * s["w"]}, drivers=("t", "w")),
        Effect("cubic drag", {"w": lambda t, s, p, u, c: -c["a"] * s["w"] ** 3}),
        Effect("Coulomb friction", {"w": lambda t, s, p, u, c: -c["a"] * np.tanh(s["w"] / c["width"])},
               shapes={"width": (0.02, 0.05, "w")}, drivers=("t",)),
        Effect("bias force", {"w": lambda t, s, p, u, c: c["a"] + 0 * s["w"]}, sign=0, drivers=("t",)),
        Effect("brush drop", {"i": lambda t, s, p, u, c: -c["a"] * np.tanh(s["i"] / c["width"])},
               shapes={"width": (0.02, 0.05, "i")}),
        Effect("iron saturation", {
            "w": lambda t, s, p, u, c: -c["a"] * p["K"] * s["i"] ** 3,
            "i": lambda t, s, p, u, c: c["a"] * p["K"] * s["i"] ** 2 * s["w"] / 0.5,
        }, guess=0.01),
        *sensors("w", only=("offset", "gain error", "lag")),
        Effect("torque that ripples", {"w": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t) * s["i"]},
               shapes={"rate": (3.0, 7.0, None)}, library=False),
        Effect("soft shaft", {
            "w": lambda t, s, p, u, c: -c["a"] * s["twist"],
            "twist": lambda t, s, p, u, c: s["w"] - s["load"],
            "load": lambda t, s, p, u, c: c["tuned"] ** 2 * s["twist"],
        }, hidden={"twist": 0.0, "load": 0.0}, shapes={"tuned": (3.0, 6.0, None)}, library=False),
    ),
    ("quadratic drag", "cubic drag"),
    {"i": "A", "w": "rad/s"},
    lambda t, s, p, u: {
        "i": (u["e"] - p["R"] * s["i"] - p["K"] * s["w"]) / 0.5,
        "w": p["K"] * s["i"] - p["b"] * s["w"],
    },
    {"e": "V"},
    late=1,
)  # fmt: skip


# --- bacteria that grow on sugar, fed in pulses ---------------------------------------------------------


def _draw_growth(rng: Rng) -> Setting:
    runs = []
    for _ in range(int(rng.integers(1, 3))):
        t = times(rng, rng.uniform(25, 40), 120, 220)
        feed = steps(rng, t, 0.5, 4.0, 5)
        runs.append(RunSetting(t, {"Sf": feed}, {"X": rng.uniform(0.2, 0.6), "S": rng.uniform(1.0, 4.0)}))
    return Setting(tuple(runs), observed=("X", "S") if rng.random() < 0.6 else ("X",))


def _monod(s, p):  # type: ignore[no-untyped-def]
    return p["m"] * s["S"] / (p["K"] + s["S"]) * s["X"]


growth = Family(
    "growth",
    "biology",
    (Base("m", "1/h", (0.35, 0.6)), Base("K", "g/l", (0.3, 1.0)), Base("Y", "", (0.4, 0.6))),
    _draw_growth,
    {"X": lambda t, s, p, u: s["X"], "S": lambda t, s, p, u: s["S"]},
    (
        Effect("death", {"X": lambda t, s, p, u, c: -c["a"] * s["X"]}, drivers=("t", "Sf")),
        Effect("crowding", {"X": lambda t, s, p, u, c: -c["a"] * s["X"] ** 2}, drivers=("t",)),
        Effect("upkeep", {"S": lambda t, s, p, u, c: -c["a"] * s["X"] * s["S"] / (s["S"] + 0.05)}),
        Effect("inhibition by excess", {
            "X": lambda t, s, p, u, c: -c["a"] * s["S"] * _monod(s, p) / (1 + c["a"] * s["S"]),
            "S": lambda t, s, p, u, c: c["a"] * s["S"] * _monod(s, p) / (1 + c["a"] * s["S"]) / p["Y"],
        }, guess=0.1),
        Effect("growth on the wall", {"X": lambda t, s, p, u, c: c["a"] + 0 * s["X"]}),
        *sensors("X", only=("offset", "gain error", "drift")),
        Effect("day and night", {"X": lambda t, s, p, u, c: c["a"] * np.sin(c["rate"] * t) * s["X"]},
               shapes={"rate": (0.6, 1.2, None)}, library=False),
        Effect("toxin", {
            "X": lambda t, s, p, u, c: -c["a"] * s["toxin"] * s["X"],
            "toxin": lambda t, s, p, u, c: s["X"] - s["toxin"] / c["time"],
        }, hidden={"toxin": 0.0}, shapes={"time": (0.15, 0.4, "t")}, library=False),
    ),
    ("death", "upkeep"),
    {"X": "g/l", "S": "g/l"},
    lambda t, s, p, u: {
        "X": _monod(s, p) - 0.2 * s["X"],
        "S": 0.2 * (u["Sf"] - s["S"]) - _monod(s, p) / p["Y"],
    },
    {"Sf": "g/l"},
    late=1,
    positive=("X", "S"),
)  # fmt: skip


# --- a thermistor's resistance against temperature, in two media ------------------------------------------


def _draw_thermistor(rng: Rng) -> Setting:
    number = int(rng.integers(60, 150))
    return Setting(
        x={"T": np.sort(rng.uniform(250, 380, number)), "power": rng.uniform(0.1, 3.0, number)}, observed=("lnR",)
    )


thermistor = Family(
    "thermistor",
    "electrical",
    (Base("lnR0", "", (1.5, 3.0), None, None), Base("B", "K", (3000.0, 4200.0))),
    _draw_thermistor,
    {"lnR": lambda t, s, p, u: p["lnR0"] + p["B"] * (1 / u["T"] - 1 / 298.15)},
    (
        Effect("self-heating", outputs={
            "lnR": lambda t, s, p, u, y, c: p["lnR0"] + p["B"] * (1 / (u["T"] + c["a"] * u["power"]) - 1 / 298.15)
        }, guess=5.0, drivers=("T",)),
        Effect("Steinhart curvature", outputs={
            "lnR": lambda t, s, p, u, y, c: y + c["a"] * (1e3 / u["T"] - 1e3 / 298.15) ** 2
        }, sign=0),
        Effect("cubic curvature", outputs={
            "lnR": lambda t, s, p, u, y, c: y + c["a"] * (1e3 / u["T"] - 1e3 / 298.15) ** 3
        }, sign=0),
        Effect("lead resistance", outputs={"lnR": lambda t, s, p, u, y, c: np.log(np.exp(y) + c["a"])}, guess=0.3),
        Effect("shunt", outputs={"lnR": lambda t, s, p, u, y, c: y - np.log1p(c["a"] * np.exp(y))}, guess=0.003),
        Effect("power coefficient", outputs={"lnR": lambda t, s, p, u, y, c: y - c["a"] * (u["power"] - 1.5)},
               drivers=("T",)),
        Effect("bridge ripple", outputs={"lnR": lambda t, s, p, u, y, c: y + c["a"] * np.sin(u["T"] / c["pitch"])},
               shapes={"pitch": (4.0, 8.0, None)}, library=False, most=0.3),
        Effect("phase change", outputs={
            "lnR": lambda t, s, p, u, y, c: y - c["a"] * swing((u["T"] - c["at"]) / 9)
        }, shapes={"at": (280.0, 350.0, None)}, library=False, most=0.3),
    ),
    ("self-heating", "power coefficient"),
    units={"T": "K", "power": "mW"},
    late=1,
)  # fmt: skip

FAMILIES = (motor, growth, thermistor)
