"""Water: a tank that drains, two tanks in series. Flows are per unit of the tank's area."""

import numpy as np

from benchmarks.concealed.families.base import Base, Effect, Family, RunSetting, Setting
from benchmarks.concealed.families.effects import sensors
from benchmarks.concealed.families.inputs import sines, steps, times

Rng = np.random.Generator


def _root(h):  # type: ignore[no-untyped-def]
    """√h, continued smoothly below 1e-4."""
    return h / np.sqrt(np.sqrt(h**2 + 1e-8))


def _draw_tank(rng: Rng) -> Setting:
    runs = []
    for _ in range(int(rng.integers(1, 3))):
        t = times(rng, rng.uniform(40, 80), 120, 240)
        flow = steps(rng, t, 0.1, 1.0, int(rng.integers(4, 7)))
        runs.append(RunSetting(t, {"q": flow}, {"h": rng.uniform(0.8, 2.5)}, ("h",) if rng.random() < 0.3 else ()))
    return Setting(tuple(runs), observed=("h",))


def _leaks(h: str, of: str = "") -> tuple[Effect, ...]:
    return (
        Effect(f"seepage{of}", {h: lambda t, s, p, u, c: -c["a"] * s[h]}, drivers=("t", h)),
        Effect(f"evaporation{of}", {h: lambda t, s, p, u, c: -c["a"] + 0 * s[h]}, drivers=("t",)),
        Effect(
            f"overflow{of}",
            {h: lambda t, s, p, u, c: -c["a"] * np.maximum(s[h] - c["level"], 0.0) ** 1.5},
            shapes={"level": (0.4, 0.7, h)},
        ),
    )


def _surge(h: str) -> Effect:
    """A second vessel behind a long pipe, in which the water swings."""
    return Effect(
        "surge vessel",
        {
            h: lambda t, s, p, u, c: -c["a"] * s["flow"],
            "flow": lambda t, s, p, u, c: c["tuned"] ** 2 * (s[h] - s["vessel"]) - 0.1 * s["flow"],
            "vessel": lambda t, s, p, u, c: s["flow"],
        },
        hidden={"flow": 0.0, "vessel": h},
        shapes={"tuned": (0.5, 1.0, None)},
        library=False,
    )


tank = Family(
    "tank",
    "hydraulics",
    (Base("a", "m^0.5/s", (0.25, 0.6)), Base("b", "", (0.7, 1.3))),
    _draw_tank,
    {"h": lambda t, s, p, u: s["h"]},
    (
        *_leaks("h"),
        Effect(
            "pump saturation",
            {"h": lambda t, s, p, u, c: -c["a"] * np.maximum(u["q"] - c["knee"], 0.0)},
            shapes={"knee": (0.4, 0.7, "q")},
        ),
        Effect(
            "clogging",
            {"h": lambda t, s, p, u, c: p["a"] * _root(s["h"]) * -np.expm1(-c["a"] * t)},
            factors={"a": lambda t, s, p, u, c: np.exp(-c["a"] * t)},
            guess=0.01,
        ),
        *sensors("h", only=("offset", "gain error", "drift", "lag")),
        Effect(
            "valve that hunts",
            {"h": lambda t, s, p, u, c: -c["a"] * np.sin(c["rate"] * t) * _root(s["h"])},
            shapes={"rate": (0.3, 0.7, None)},
            library=False,
        ),
        _surge("h"),
        Effect("leak of power 1.5", {"h": lambda t, s, p, u, c: -c["a"] * abs(s["h"]) ** 1.5}, library=False),
    ),
    ("seepage", "evaporation"),
    {"h": "m"},
    lambda t, s, p, u: {"h": p["b"] * u["q"] - p["a"] * _root(s["h"])},
    {"q": "m/s"},
    positive=("h",),
)


# --- two tanks: the first feeds the second -----------------------------------------------------------


def _draw_two(rng: Rng) -> Setting:
    t = times(rng, rng.uniform(60, 120), 150, 280)
    flow = 0.5 + sines(rng, t, 0.25, 0.08, 0.6) + steps(rng, t, -0.15, 0.2, 4)
    run = RunSetting(t, {"q": flow}, {"h1": rng.uniform(0.6, 2.0), "h2": rng.uniform(0.4, 1.5)})
    return Setting((run,), observed=("h1", "h2") if rng.random() < 0.6 else ("h2",))


two_tanks = Family(
    "two tanks",
    "hydraulics",
    (Base("a1", "m^0.5/s", (0.35, 0.6)), Base("a2", "m^0.5/s", (0.35, 0.6))),
    _draw_two,
    {"h1": lambda t, s, p, u: s["h1"], "h2": lambda t, s, p, u: s["h2"]},
    (
        *_leaks("h2", " (lower)"),
        Effect(
            "bypass (upper)",
            {
                "h1": lambda t, s, p, u, c: -c["a"] * u["q"],
                "h2": lambda t, s, p, u, c: c["a"] * u["q"],
            },
            drivers=("q",),
        ),
        Effect(
            "pump saturation (upper)",
            {"h1": lambda t, s, p, u, c: -c["a"] * np.maximum(u["q"] - c["knee"], 0.0)},
            shapes={"knee": (0.4, 0.7, "q")},
        ),
        Effect(
            "back pressure",
            {
                "h1": lambda t, s, p, u, c: c["a"] * s["h2"],
                "h2": lambda t, s, p, u, c: -c["a"] * s["h2"],
            },
        ),
        *sensors("h2", only=("offset", "gain error", "drift")),
        Effect(
            "valve that hunts",
            {"h2": lambda t, s, p, u, c: -c["a"] * np.sin(c["rate"] * t) * _root(s["h2"])},
            shapes={"rate": (0.3, 0.7, None)},
            library=False,
        ),
        _surge("h2"),
    ),
    ("seepage (lower)", "evaporation (lower)"),
    {"h1": "m", "h2": "m"},
    lambda t, s, p, u: {
        "h1": u["q"] - p["a1"] * _root(s["h1"]),
        "h2": p["a1"] * _root(s["h1"]) - p["a2"] * _root(s["h2"]),
    },
    {"q": "m/s"},
    positive=("h1", "h2"),
)

FAMILIES = (tank, two_tanks)
