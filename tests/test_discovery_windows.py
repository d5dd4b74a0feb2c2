"""Terms that act in a range of a driver only: strong ones, steep ones, and what is no window."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc

F64 = torch.float64
NOISE = 0.01


def diagnose(*args, **options):
    return tc.diagnose(*args, **{"seed": 0, "progress": False, **options})


def oscillator():
    return tc.ODESimulator(
        rates=lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]},
        states={"x": "m", "v": "m/s"},
        parameters=[
            tc.Parameter("k", unit="1/s^2", low=0.0, initial=4.0),
            tc.Parameter("c", unit="1/s", low=0.0, initial=0.1),
        ],
        observe=("x",),
    )


def recorded(extra, *, n=200, seed=0, kick=0.0):
    """A driven oscillator by SciPy, with an acceleration ``extra(t, x, v)`` and a kick of the velocity at t = 7.3."""
    t = np.linspace(0, 15, n)

    def rate(t, z):
        return [z[1], -4 * z[0] - 0.1 * z[1] + 2 * math.sin(1.3 * t) + extra(t, *z)]

    first = solve_ivp(rate, (0, 7.3), [0.5, 0.0], t_eval=t[t < 7.3], rtol=1e-9, atol=1e-10, max_step=0.02)
    middle = solve_ivp(rate, (0, 7.3), [0.5, 0.0], rtol=1e-9, atol=1e-10, max_step=0.02).y[:, -1] + [0, kick]
    last = solve_ivp(rate, (7.3, 15), middle, t_eval=t[t >= 7.3], rtol=1e-9, atol=1e-10, max_step=0.02)
    x = np.concatenate([first.y[0], last.y[0]])
    x += NOISE * np.random.default_rng(seed).standard_normal(n)
    run = tc.Run(time=t, inputs={"f": 2 * np.sin(1.3 * t)}, outputs={"x": x}, initial={"x": 0.5, "v": 0.0})
    return tc.Recording(runs=[run], noise=NOISE)


def library(*names):
    return [term for term in tc.terms.mechanics() if term.name in names]


@pytest.mark.parametrize(
    ("extra", "driver", "term", "span"),
    [
        (lambda t, x, v: -1.5 * v**3 if 4 < t < 9 else 0.0, "t", "cubic drag", (4.0, 9.0)),
        (lambda t, x, v: -6.0 * x**3 if 0.3 < x < 0.8 else 0.0, "x", "cubic stiffness", (0.3, 0.8)),
    ],
)
def test_a_strong_effect_with_sharp_ends_is_named_where_it_acts(extra, driver, term, span):
    # At the base's fit the best window is far from this one, and the base's misfit looks like correlated noise.
    terms = library("quadratic drag", "cubic drag", "quadratic stiffness", "cubic stiffness", "bias force")
    d = diagnose(oscillator(), recorded(extra), terms)
    assert d.verdict == "named"
    assert d.terms == [term]
    ((low, high),) = d.where[0].spans
    assert d.where[0].driver == driver
    assert (low, high) == pytest.approx(span, abs=0.1 * (span[1] - span[0]))
    assert d.noise.correlation["x"] < 0.15


def test_a_kick_at_one_moment_is_no_window():
    data = recorded(lambda t, x, v: 0.0, kick=0.3)
    d = diagnose(oscillator(), data, library("quadratic drag", "cubic drag", "bias force", "cubic stiffness"))
    assert d.verdict in ("unexplained", "ambiguous")
    for row in d.ranking:
        assert row.region is None or row.probability < 0.5


def test_opposite_terms_of_one_sign_each_are_no_aliases():
    # With the base calibrated, what one of them does is minus what the other does. Six others are refitted before them.
    def term(name, change, **bounds):
        return tc.Term(name, outputs={"y": change}, parameters=[tc.Parameter("a", **bounds)])

    base = tc.Simulator(
        lambda x, p: p["top"] * x["dose"] / (p["half"] + x["dose"]),
        parameters=[tc.Parameter("top", low=0.1, high=5.0), tc.Parameter("half", low=0.05, high=20.0)],
    )
    terms = [
        term("loss with dose", lambda x, p, y: y - p["a"] * x["dose"], low=0.0),
        term("unspecific binding", lambda x, p, y: y + p["a"] * x["dose"], low=0.0),
        *(term(f"age to the {k}", lambda x, p, y, k=k: y + p["a"] * (x["age"] / 25 - 1.8) ** k) for k in (1, 3, 5)),
        *(term(f"age to the {k}, in proportion", lambda x, p, y, k=k: y * (1 + p["a"] * (x["age"] / 25 - 1.8) ** k))
          for k in (1, 3, 5)),
    ]  # fmt: skip
    rng = np.random.default_rng(3)
    dose, age = np.exp(rng.uniform(-4, 4, 140)), rng.uniform(20, 70, 140)
    effect = 1.3 * dose / (1 + dose) + 0.1 * (age / 25 - 1.8) + 0.005 * rng.standard_normal(140)
    data = tc.Recording(x={"dose": torch.tensor(dose), "age": torch.tensor(age)}, y=torch.tensor(effect), noise=0.005)
    d = diagnose(base, data, terms)
    assert d.verdict == "named"
    assert d.terms == ["age to the 1"]
    notes = {row.term: row.note for row in d.detection_limit}
    assert "also" not in notes["loss with dose"]
    assert "unspecific binding" in notes


def test_outliers_that_a_strong_local_effect_hid_are_set_aside():
    # No smooth curve follows the step that the effect makes in the base's residual, so that nothing sticks out of it.
    rng = np.random.default_rng(5)
    dose, age = np.exp(rng.uniform(-4, 4, 130)), rng.uniform(20, 70, 130)
    effect = 1.3 * dose / (1 + dose) * (1 + 0.5 * (age / 25 - 1.8) * (dose < 0.8)) + 0.01 * rng.standard_normal(130)
    wrong = np.array([7, 40, 66, 95, 121])
    effect[wrong] += 0.01 * np.array([9, -12, 10, 14, -8])
    base = tc.Simulator(
        lambda x, p: p["top"] * x["dose"] / (p["half"] + x["dose"]),
        parameters=[tc.Parameter("top", low=0.1, high=5.0), tc.Parameter("half", low=0.05, high=20.0)],
    )
    terms = [
        tc.Term("effect of age", outputs={"y": lambda x, p, y: y * (1 + p["a"] * (x["age"] / 25 - 1.8))},
                parameters=[tc.Parameter("a")]),
        tc.Term("offset", outputs={"y": lambda x, p, y: y + p["a"]}, parameters=[tc.Parameter("a")]),
        tc.Term("unspecific binding", outputs={"y": lambda x, p, y: y + p["a"] * x["dose"]},
                parameters=[tc.Parameter("a", low=0.0)]),
    ]  # fmt: skip
    data = tc.Recording(x={"dose": torch.tensor(dose), "age": torch.tensor(age)}, y=torch.tensor(effect), noise=0.01)
    d = diagnose(base, data, terms)
    assert d.verdict in ("named", "ambiguous")
    best = next(row for row in d.ranking if row.terms and row.terms != ("none of these",))
    assert best.terms == ("effect of age",)
    end = next(e for e in best.estimates if e.name == "effect of age.window to")
    assert end.value == pytest.approx(0.8, rel=0.1)
    assert len(wrong) <= d.noise.outliers <= 2 * len(wrong)
