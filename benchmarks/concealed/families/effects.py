"""Effects that several families share, written for the truth. Names are spelled as the candidate lists spell them."""

from typing import Any

import numpy as np

from benchmarks.concealed.families.base import Effect


def swing(z: Any) -> Any:
    """Up before 0 and down behind it: no window of another effect looks like this."""
    return -2.33 * z * np.exp(-(z**2))


def mechanics(x: str, v: str, *, only: tuple[str, ...] = (), most: float = 0.5) -> tuple[Effect, ...]:
    """Forces on the coordinate ``x`` with velocity ``v``, in and out of the library."""
    every = (
        Effect("quadratic drag", {v: lambda t, s, p, u, c: -c["a"] * abs(s[v]) * s[v]}, drivers=("t", x, v)),
        Effect("cubic drag", {v: lambda t, s, p, u, c: -c["a"] * s[v] ** 3}, drivers=("t", x)),
        Effect(
            "Coulomb friction",
            {v: lambda t, s, p, u, c: -c["a"] * np.tanh(s[v] / c["width"])},
            shapes={"width": (0.02, 0.05, v)},
            drivers=("t", x),
        ),
        Effect(
            "cubic stiffness", {v: lambda t, s, p, u, c: -c["a"] * s[x] ** 3}, sign=0, drivers=("t", x), most=0.4
        ),
        Effect("quadratic stiffness", {v: lambda t, s, p, u, c: -c["a"] * s[x] ** 2}, sign=0, most=0.25),
        Effect(
            "position-dependent damping", {v: lambda t, s, p, u, c: -c["a"] * s[x] ** 2 * s[v]}, drivers=("t",)
        ),
        Effect("bias force", {v: lambda t, s, p, u, c: c["a"] + 0 * s[v]}, sign=0, drivers=("t",)),
        Effect(
            "stiffness that pulsates",
            {v: lambda t, s, p, u, c: -c["a"] * np.cos(c["rate"] * t) * s[x]},
            shapes={"rate": (0.8, 1.6, None)},
            library=False,
        ),
        Effect(
            "washboard",
            {v: lambda t, s, p, u, c: c["a"] * np.cos(2 * np.pi * s[x] / c["pitch"])},
            shapes={"pitch": (0.4, 0.8, x)},
            sign=0,
            library=False,
        ),
        Effect(
            "hidden absorber",
            {
                v: lambda t, s, p, u, c: c["a"] * (s["rider"] - s[x]),
                "rider": lambda t, s, p, u, c: s["rider rate"],
                "rider rate": lambda t, s, p, u, c: c["tuned"] ** 2 * (s[x] - s["rider"]),
            },
            hidden={"rider": x, "rider rate": 0.0},
            shapes={"tuned": (1.5, 3.0, None)},
            library=False,
        ),
        Effect(
            "drag of power 1.5",
            {v: lambda t, s, p, u, c: -c["a"] * np.sqrt(abs(s[v])) * s[v]},
            library=False,
        ),
    )
    return tuple(effect for effect in every if not only or effect.name in only)


def sensors(y: str, *, only: tuple[str, ...] = ("offset", "gain error", "drift")) -> tuple[Effect, ...]:
    """What an instrument does to the output ``y``, which is a state."""
    source = y
    every = (
        Effect(f"offset of {y}", outputs={y: lambda t, s, p, u, y, c: y + c["a"]}, sign=0, most=0.3),
        Effect(f"gain error of {y}", outputs={y: lambda t, s, p, u, y, c: y * (1 + c["a"])}, sign=0, most=0.3),
        Effect(f"drift of {y}", outputs={y: lambda t, s, p, u, y, c: y + c["a"] * t}, sign=0, most=0.4),
        Effect(
            f"lag of {y}",
            {"reading": lambda t, s, p, u, c: (s[source] - s["reading"]) / c["a"]},
            outputs={y: lambda t, s, p, u, y, c: s["reading"]},
            hidden={"reading": source},
            guess=0.2,
            stiff=True,
            within=(0.009, 0.35, "t"),
        ),
        Effect(f"non-linearity of {y}", outputs={y: lambda t, s, p, u, y, c: y + c["a"] * y**2}, sign=0, most=0.25),
        Effect(
            f"saturation of {y}",
            outputs={y: lambda t, s, p, u, y, c: y - c["a"] * np.sign(y) * np.maximum(abs(y) - c["rim"], 0.0)},
            shapes={"rim": (0.4, 0.75, source)},
            within=(0.2, 1.0, None),
        ),
    )
    return tuple(effect for effect in every if effect.name.split(" of ")[0] in only)
