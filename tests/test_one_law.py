"""Power laws of the library are one law for all runs, and constants of terms come from the base's fit."""

import math
import warnings

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal.discovery.fits.ranges import sized
from torchcal.errors import DomainError, UnitWarning

F64 = torch.float64


def diagnose(model, recording, terms, **options):
    return tc.diagnose(model, recording, terms, seed=0, progress=False, **options)


def decay(starts=(1.0, 3.0), sd=0.01, units=None):
    """-dA/dt = 0.4 A^1.5 from several beginnings, which the base takes for first order."""
    rng, t = np.random.default_rng(0), np.linspace(0, 8, 41)
    runs = [
        tc.Run(t, {"A": (a**-0.5 + 0.2 * t) ** -2.0 + sd * rng.standard_normal(41)}, initial={"A": a}) for a in starts
    ]
    model = tc.ODESimulator(
        lambda t, s, p, u: {"A": -p["k"] * s["A"]}, {"A": "mol/L"}, [tc.Parameter("k", low=0.0, initial=0.5)]
    )
    return model, tc.Recording(runs=runs, units=units, noise=sd)


def test_a_reaction_order_is_one_law_for_runs_that_begin_elsewhere():
    d = diagnose(*decay(), tc.terms.kinetics("A", rate="k"))
    assert d.terms == ["reaction order"]
    assert d.ranking[0].estimates[0].value == pytest.approx(0.5, abs=4 * d.ranking[0].estimates[0].sd)
    assert d.equations[0].startswith("k → k (A/A_ref)^m, A_ref = 3, with")
    _, (term,) = d.improved.extended
    assert (term.constants, term.states) == ({"A_ref": 3.0}, {})
    # The improved model goes on as the same law where another run begins.
    t = torch.linspace(0, 8, 41, dtype=F64)
    further = tc.Recording(runs=[tc.Run(t, {"A": (6.0**-0.5 + 0.2 * t) ** -2.0}, initial={"A": 6.0})])
    bound = d.improved.bind(further)
    values = torch.tensor([0.4 * 3.0**0.5, 0.5], dtype=F64)
    assert list(bound.names) == ["k", "reaction order.m"]
    torch.testing.assert_close(bound.at(further.x)(values), further.y, rtol=1e-5, atol=1e-6)


def test_a_discharge_exponent_is_one_law_for_tanks_that_begin_elsewhere():
    rng, t = np.random.default_rng(1), np.linspace(0, 60, 41)
    runs = []
    for level in (0.3, 0.6, 0.9):
        h = solve_ivp(lambda t, h: -0.012 * h**0.8, (0, 60), [level], t_eval=t, rtol=1e-9, atol=1e-12).y[0]
        runs.append(tc.Run(t, {"h": h + 0.002 * rng.standard_normal(41)}, initial={"h": level}))
    model = tc.ODESimulator(
        lambda t, s, p, u: {"h": -p["c"] * s["h"].clamp_min(1e-9).sqrt()},
        {"h": "m"},
        [tc.Parameter("c", low=0.0, initial=0.01)],
    )
    terms = tc.terms.hydraulics("h", outlet="c")
    d = diagnose(model, tc.Recording(runs=runs, noise=0.002), terms)
    assert d.terms == ["discharge exponent"]
    estimate = d.ranking[0].estimates[0]
    assert estimate.value == pytest.approx(0.3, abs=4 * estimate.sd)


def test_constants_are_measured_on_what_the_base_does():
    def term(**constants):
        return tc.Term(
            "power", equation="x", rate=lambda t, s, p, u: p["q"] * (s["x"] / p["c"]) ** 2, formula="dx/dt ∋ q (x/c)²",
            parameters=[tc.Parameter("q")], constants=constants,
        )  # fmt: skip

    recording = tc.Recording(runs=[tc.Run([0.0, 1.0, 2.0], {"x": [1.0, 2.0, 3.0]})])
    scale = {"x": 3.0001, "y": 4.0, "t": 2.0, "none": 0.0}
    found = sized(term(c="x"), scale, recording)
    assert (found.constants, found.formula) == ({"c": 3.0}, "dx/dt ∋ q (x/c)², c = 3")
    assert sized(found, {"x": 7.0}, recording).constants == {"c": 3.0}
    assert sized(term(c=("x", "y")), scale, recording).constants == {"c": 5.0}
    assert sized(term(c="none"), scale, recording).constants == {"c": 1.0}
    assert sized(term(c=2), scale, recording).constants == {"c": 2.0}
    assert term(c="x").own({"power.q": 1.0})["c"] == 1.0
    with pytest.raises(DomainError, match="'z'"):
        sized(term(c="z"), scale, recording)


@pytest.mark.parametrize("given", [{"q": 1.0}, {"c": math.nan}, {"c": True}, {"c": ()}, {"c": ""}, {"c": None}])
def test_constants_that_cannot_be(given):
    with pytest.raises(DomainError, match="constants="):
        tc.Term("t", equation="x", rate=lambda t, s, p, u: p["q"], parameters=[tc.Parameter("q")], constants=given)


@pytest.mark.parametrize(
    ("time", "mine", "told"),
    [("s", "min", True), ("h", "min", True), ("min", "minutes", False), ("s", "ticks", False), ("min", None, False)],
)
def test_a_library_in_another_unit_of_time_is_told(time, mine, told):
    model, recording = decay((1.0,), units={"time": mine, "A": "mol/L"} if mine else None)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        diagnose(model, recording, tc.terms.kinetics("A", rate=None, time=time)[:2], holdout=False, num_starts=2)
    texts = [str(w.message) for w in caught if w.category is UnitWarning]
    assert len(texts) == told
    if told:
        assert "'reverse reaction', 'autocatalysis'" in texts[0]
        assert f"time={mine!r}" in texts[0]
