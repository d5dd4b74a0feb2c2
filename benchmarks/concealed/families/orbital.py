"""A planet around its star, in the plane. Units: the orbit's size and the year over 2π."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.inputs import times

Rng = np.random.Generator
LIGHT = 3.0


def _draw(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(4, 9), 120, 240)
    angle = rng.uniform(0, 2 * np.pi)
    eccentricity = rng.uniform(0.1, 0.5)
    # It starts at its pericentre.
    distance, speed = 1 - eccentricity, np.sqrt((1 + eccentricity) / (1 - eccentricity))
    start = {
        "x": distance * np.cos(angle),
        "y": distance * np.sin(angle),
        "vx": -speed * np.sin(angle),
        "vy": speed * np.cos(angle),
    }
    return Setting((RunSetting(t, {}, start, ()),), observed=("x", "y"))


def _radius(s):  # type: ignore[no-untyped-def]
    return np.sqrt(s["x"] ** 2 + s["y"] ** 2)


def _speed(s):  # type: ignore[no-untyped-def]
    return np.sqrt(s["vx"] ** 2 + s["vy"] ** 2)


def _toward(s, c):  # type: ignore[no-untyped-def]
    return np.cos(c["angle"]) * s["x"] + np.sin(c["angle"]) * s["y"]


def _radial(strength):  # type: ignore[no-untyped-def]
    """A pull towards the star."""
    return {
        "vx": lambda t, s, p, u, c: -c["a"] * strength(s, p, c) * s["x"] / _radius(s),
        "vy": lambda t, s, p, u, c: -c["a"] * strength(s, p, c) * s["y"] / _radius(s),
    }


def _relativity(s, p, x, v):  # type: ignore[no-untyped-def]
    """First post-Newtonian order, for light that is only `LIGHT` times faster than the planet."""
    r, speed2 = _radius(s), s["vx"] ** 2 + s["vy"] ** 2
    along = s["x"] * s["vx"] + s["y"] * s["vy"]
    return p["mu"] / (LIGHT**2 * r**3) * ((4 * p["mu"] / r - speed2) * s[x] + 4 * along * s[v])


orbit = Family(
    "orbit",
    "orbital",
    (Base("mu", "", (0.9, 1.1)),),
    _draw,
    {"x": lambda t, s, p, u: s["x"], "y": lambda t, s, p, u: s["y"]},
    (
        Effect(
            "relativity",
            {
                "vx": lambda t, s, p, u, c: c["a"] * _relativity(s, p, "x", "vx"),
                "vy": lambda t, s, p, u, c: c["a"] * _relativity(s, p, "y", "vy"),
            },
            within=(0.05, 1.8, None),
        ),
        Effect("oblateness", _radial(lambda s, p, c: 1.5 * p["mu"] / _radius(s) ** 4), most=0.2, guess=0.05),
        Effect(
            "drag",
            {
                "vx": lambda t, s, p, u, c: -c["a"] * _speed(s) * s["vx"],
                "vy": lambda t, s, p, u, c: -c["a"] * _speed(s) * s["vy"],
            },
            drivers=("t",),
            most=0.12,
            guess=0.05,
        ),
        Effect("dark halo", _radial(lambda s, p, c: _radius(s)), most=0.2, guess=0.05),
        Effect(
            "third body",
            {
                "vx": lambda t, s, p, u, c: c["a"] * (3 * _toward(s, c) * np.cos(c["angle"]) - s["x"]),
                "vy": lambda t, s, p, u, c: c["a"] * (3 * _toward(s, c) * np.sin(c["angle"]) - s["y"]),
            },
            shapes={"angle": (0.5, 2.8, None)},
            guess=0.05,
            most=0.15,
        ),
        Effect("thrust", {
            "vx": lambda t, s, p, u, c: c["a"] * s["vx"] / _speed(s),
            "vy": lambda t, s, p, u, c: c["a"] * s["vy"] / _speed(s),
        }, sign=0, drivers=("t",), most=0.2, guess=0.05),
        Effect(
            "turning bar",
            {
                "vx": lambda t, s, p, u, c: c["a"] * (np.cos(c["rate"] * t) * s["x"] + np.sin(c["rate"] * t) * s["y"]),
                "vy": lambda t, s, p, u, c: c["a"] * (np.sin(c["rate"] * t) * s["x"] - np.cos(c["rate"] * t) * s["y"]),
            },
            shapes={"rate": (0.4, 0.8, None)},
            library=False,
            most=0.2,
            guess=0.05,
        ),
        Effect(
            "magnetic turn",
            {
                "vx": lambda t, s, p, u, c: c["a"] * s["vy"] * np.sin(c["rate"] * t),
                "vy": lambda t, s, p, u, c: -c["a"] * s["vx"] * np.sin(c["rate"] * t),
            },
            shapes={"rate": (0.5, 1.5, None)},
            library=False,
            most=0.2,
            guess=0.05,
        ),
    ),
    ("drag", "thrust"),
    {"x": "AU", "y": "AU", "vx": "", "vy": ""},
    lambda t, s, p, u: {
        "x": s["vx"],
        "y": s["vy"],
        "vx": -p["mu"] * s["x"] / _radius(s) ** 3,
        "vy": -p["mu"] * s["y"] / _radius(s) ** 3,
    },
    {},
)  # fmt: skip

FAMILIES = (orbit,)
