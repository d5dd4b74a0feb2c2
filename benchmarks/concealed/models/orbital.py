"""Orbits: base models and candidates."""

from typing import Any

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, term
from torchcal.terms import Term

LIGHT = 3.0


def _orbit(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def rates(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        pull = -p["mu"] / (s["x"] ** 2 + s["y"] ** 2) ** 1.5
        return {"x": s["vx"], "y": s["vy"], "vx": pull * s["x"], "vy": pull * s["y"]}

    body = tc.ODESimulator(
        rates, {"x": "AU", "y": "AU", "vx": "", "vy": ""}, [positive("mu", "", 1.0)], observe=outputs
    )
    speed = lambda s: (s["vx"] ** 2 + s["vy"] ** 2).sqrt()  # noqa: E731
    own = [
        term("dark halo", {
            "vx": lambda t, s, p, u: -p["a"] * s["x"],
            "vy": lambda t, s, p, u: -p["a"] * s["y"],
        }, formula="dv/dt ∋ -a r"),
        term("thrust", {
            "vx": lambda t, s, p, u: p["a"] * s["vx"] / speed(s),
            "vy": lambda t, s, p, u: p["a"] * s["vy"] / speed(s),
        }, low=None, formula="dv/dt ∋ a v/|v|"),
    ]  # fmt: skip
    return body, [
        *tc.terms.orbital(("x", "y"), ("vx", "vy"), mu="mu", light=LIGHT, reference=1.0, length="AU", time="yr"),
        *own,
    ]


BUILDERS: dict[str, Builder] = {
    "orbit": _orbit,
}
