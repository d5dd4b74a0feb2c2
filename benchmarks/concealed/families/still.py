"""Static families: a dose-response curve, a solar cell, the calibration of a spring."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, Setting
from benchmarks.concealed.families.effects import swing

Rng = np.random.Generator


def _draw_dose(rng: Rng) -> Setting:
    number = int(rng.integers(60, 140))
    dose = np.exp(np.linspace(np.log(0.01), np.log(100.0), number))
    if rng.random() < 0.5:
        dose = np.sort(np.repeat(dose[::3], 3)[:number])
    return Setting(x={"dose": dose, "age": rng.uniform(20, 70, len(dose))}, observed=("effect",))


def _hill(t, s, p, u):  # type: ignore[no-untyped-def]
    return p["top"] * u["dose"] / (p["half"] + u["dose"])


dose = Family(
    "dose response",
    "kinetics",
    (Base("top", "", (0.8, 1.5)), Base("half", "mg", (0.5, 4.0))),
    _draw_dose,
    {"effect": _hill},
    (
        Effect("cooperativity", outputs={
            "effect": lambda t, s, p, u, y, c: p["top"] / (1 + (p["half"] / u["dose"]) ** (1 + c["a"]))
        }, sign=0, guess=0.3, most=0.4),
        Effect("inhibition by excess", outputs={
            "effect": lambda t, s, p, u, y, c: p["top"] * u["dose"] / (p["half"] + u["dose"] + c["a"] * u["dose"] ** 2)
        }, guess=0.01),
        Effect("offset of effect", outputs={"effect": lambda t, s, p, u, y, c: y + c["a"]}),
        Effect("unspecific binding", outputs={"effect": lambda t, s, p, u, y, c: y + c["a"] * u["dose"]}, guess=0.01,
               drivers=("age",)),
        Effect("effect of age", outputs={
            "effect": lambda t, s, p, u, y, c: y * (1 + c["a"] * (u["age"] - 45) / 25)
        }, sign=0, drivers=("dose",)),
        Effect("potency by age", outputs={
            "effect": lambda t, s, p, u, y, c: p["top"] * u["dose"]
            / (p["half"] * np.exp(c["a"] * (u["age"] - 45) / 25) + u["dose"])
        }, sign=0, guess=0.3),
        Effect("second site", outputs={
            "effect": lambda t, s, p, u, y, c: y + c["a"] * u["dose"] / (u["dose"] + c["far"])
        }, shapes={"far": (20.0, 60.0, None)}),
        Effect("ripple in the dose", outputs={
            "effect": lambda t, s, p, u, y, c: y + c["a"] * np.sin(c["turns"] * np.log(u["dose"]))
        }, shapes={"turns": (2.0, 4.0, None)}, library=False, most=0.3),
        Effect("responders by age", outputs={
            "effect": lambda t, s, p, u, y, c: y * (1 - c["a"] * swing((u["age"] - c["middle"]) / 6))
        }, shapes={"middle": (35.0, 55.0, None)}, library=False, guess=0.3),
    ),
    ("unspecific binding", "second site"),
    units={"dose": "mg", "age": "a"},
)  # fmt: skip


# --- a solar cell in the ideal one-diode model ---------------------------------------------------------


def _draw_cell(rng: Rng) -> Setting:
    number = int(rng.integers(60, 120))
    return Setting(x={"V": np.linspace(-0.2, 0.59, number)}, observed=("I",))


def _cell(t, s, p, u):  # type: ignore[no-untyped-def]
    return p["Ip"] - 1e-6 * p["I0"] * np.expm1(u["V"] / p["n"])


def _series(t, s, p, u, y, c):  # type: ignore[no-untyped-def]
    current = y
    for _ in range(30):  # Newton
        inner = (u["V"] + current * c["a"]) / p["n"]
        value = p["Ip"] - 1e-6 * p["I0"] * np.expm1(inner) - current
        slope = -1e-6 * p["I0"] * np.exp(inner) * c["a"] / p["n"] - 1
        current = current - value / slope
    return current


cell = Family(
    "solar cell",
    "electrical",
    (
        Base("Ip", "A", (0.6, 0.9)),
        Base("I0", "uA", (0.2, 1.0)),
        Base("n", "V", (0.036, 0.042), 0.01, 0.1),
    ),
    _draw_cell,
    {"I": _cell},
    (
        Effect("series resistance", outputs={"I": _series}, guess=0.03, most=0.5),
        Effect("shunt", outputs={"I": lambda t, s, p, u, y, c: y - c["a"] * u["V"]}, guess=0.02,
               drivers=("V",)),
        Effect("recombination diode", outputs={
            "I": lambda t, s, p, u, y, c: y - c["a"] * np.expm1(u["V"] / (2 * p["n"]))
        }, guess=1e-5),
        Effect("soft breakdown", outputs={"I": lambda t, s, p, u, y, c: y + c["a"] * np.maximum(-u["V"], 0.0)},
               guess=0.1),
        Effect("voltage offset", outputs={
            "I": lambda t, s, p, u, y, c: y - c["a"] * 1e-6 * p["I0"] * u["V"] * np.exp(u["V"] / p["n"])
        }, guess=0.1, sign=0),
        Effect("square shunt", outputs={"I": lambda t, s, p, u, y, c: y - c["a"] * abs(u["V"]) * u["V"]}, guess=0.05),
        Effect("stepped converter", outputs={
            "I": lambda t, s, p, u, y, c: y + c["a"] * np.sin(2 * np.pi * u["V"] / c["pitch"])
        }, shapes={"pitch": (0.12, 0.25, None)}, library=False, most=0.3),
        Effect("shaded corner", outputs={
            "I": lambda t, s, p, u, y, c: y - c["a"] * swing((u["V"] - c["knee"]) / 0.07)
        }, shapes={"knee": (0.05, 0.3, None)}, library=False, most=0.3),
    ),
    ("shunt", "square shunt"),
    units={"V": "V", "I": "A"},
)  # fmt: skip


# --- a spring's force against its length, at several temperatures --------------------------------------


def _draw_spring(rng: Rng) -> Setting:
    number = int(rng.integers(80, 180))
    return Setting(
        x={"x": rng.uniform(-1.5, 1.5, number), "T": rng.uniform(10, 60, number)}, observed=("force",)
    )


spring = Family(
    "spring",
    "mechanics",
    (Base("k", "N/m", (5.0, 15.0)), Base("F0", "N", (-1.0, 1.0), None, None)),
    _draw_spring,
    {"force": lambda t, s, p, u: p["F0"] + p["k"] * u["x"]},
    (
        Effect("cubic stiffness", outputs={"force": lambda t, s, p, u, y, c: y + c["a"] * u["x"] ** 3}, sign=0,
               drivers=("x", "T")),
        Effect("quadratic stiffness", outputs={"force": lambda t, s, p, u, y, c: y + c["a"] * u["x"] ** 2}, sign=0),
        Effect("fifth-power stiffness", outputs={"force": lambda t, s, p, u, y, c: y + c["a"] * u["x"] ** 5}, sign=0),
        Effect("softening by heat", outputs={
            "force": lambda t, s, p, u, y, c: y - c["a"] * p["k"] * u["x"] * (u["T"] - 35) / 25
        }, drivers=("x",)),
        Effect("thermal expansion", outputs={
            "force": lambda t, s, p, u, y, c: y - c["a"] * p["k"] * (u["T"] - 35) / 25
        }, sign=0),
        Effect("end stop", outputs={
            "force": lambda t, s, p, u, y, c: y + c["a"] * np.maximum(u["x"] - c["gap"], 0.0)
        }, shapes={"gap": (0.4, 0.8, "x")}, guess=10.0),
        Effect("wavy thread", outputs={
            "force": lambda t, s, p, u, y, c: y + c["a"] * np.sin(2 * np.pi * u["x"] / c["pitch"])
        }, shapes={"pitch": (0.5, 0.9, None)}, library=False),
        Effect("soft phase", outputs={
            "force": lambda t, s, p, u, y, c: y - c["a"] * u["x"] * swing((u["T"] - c["melts"]) / 7)
        }, shapes={"melts": (20.0, 50.0, None)}, library=False),
    ),
    ("cubic stiffness", "fifth-power stiffness"),
    units={"x": "m", "T": "degC", "force": "N"},
)  # fmt: skip

FAMILIES = (dose, cell, spring)
