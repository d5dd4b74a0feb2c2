"""Power laws of the library are one law for all runs, and constants of terms come from the base's fit."""

import math
import warnings

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.ranges import Scale, drivers_scale, sized
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.discovery.hypotheses.search import Search
from torchcal.errors import DomainError, UnitWarning
from torchcal.terms.labels import labelled

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


@pytest.mark.slow
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


@pytest.mark.slow
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
    turning = {"x": torch.tensor([[3.0001], [0.0]]), "y": torch.tensor([[0.0], [-4.0]])}
    scale = Scale({"x": 3.0001, "y": 4.0, "t": 2.0, "none": 0.0}, turning)
    found = sized(term(c="x"), scale, recording)
    assert (found.constants, found.formula) == ({"c": 3.0}, "dx/dt ∋ q (x/c)², c = 3")
    assert sized(found, Scale({"x": 7.0}, {}), recording).constants == {"c": 3.0}
    assert sized(term(c=("x", "y")), scale, recording).constants == {"c": 4.0}  # of the vector, not of its parts
    assert sized(term(c="none"), scale, recording).constants == {"c": 1.0}
    assert sized(term(c=2), scale, recording).constants == {"c": 2.0}
    assert term(c="x").own({"power.q": 1.0})["c"] == 1.0


@pytest.mark.parametrize("given", [{"constants": {"c": "z"}}, {"constants": {"c": ("x", "z")}}, {"scales": {"q": "z"}}])
@pytest.mark.parametrize("static", [False, True])
def test_what_a_term_is_measured_on_is_there_before_any_long_work(monkeypatch, given, static):
    def calibrated(search):
        raise AssertionError("the base was calibrated before the names were looked at")

    monkeypatch.setattr(Search, "calibrate_base", calibrated)
    parameters = [tc.Parameter("k", initial=1.0)]
    x = torch.arange(10.0, dtype=torch.float64)
    if static:
        model, recording = tc.Simulator(lambda x, p: p["k"] * x, parameters), tc.Recording(x={"x": x}, y=2 * x)
        parts = {"outputs": {"y": lambda x, p, y: y + p["q"]}}
    else:
        model = tc.ODESimulator(lambda t, s, p, u: {"x": -p["k"] * s["x"] + u["f"]}, {"x": None}, parameters)
        recording = tc.Recording(runs=[tc.Run(x, {"x": x}, inputs={"f": x})])
        parts = {"equation": "x", "rate": lambda t, s, p, u: p["q"]}
    term = tc.Term("power", parameters=[tc.Parameter("q")], **parts, **given)
    known = r"\['x'(, 'y')?\]" if static else r"\['t', 'x', 'f'\]"
    with pytest.raises(DomainError, match=rf"scale of some of {known}. Got 'z'"):
        tc.diagnose(model, recording, [term], seed=0, progress=False)


@pytest.mark.parametrize("given", [{"q": 1.0}, {"c": math.nan}, {"c": True}, {"c": ()}, {"c": ""}, {"c": None}])
def test_constants_that_cannot_be(given):
    with pytest.raises(DomainError, match="constants="):
        tc.Term("t", equation="x", rate=lambda t, s, p, u: p["q"], parameters=[tc.Parameter("q")], constants=given)


def test_labels_without_time_are_not_told_and_every_unit_is():
    untimed = {term.name for term in tc.terms.kinetics("A", time="h") if term.time is None}
    assert untimed == {"reaction order", "saturation"}
    timed = {term.name for term in tc.terms.sensor(("A",), time="h") if term.time == "h"}
    assert timed == {"drift of A", "lag of A", "delay of A"}
    model, recording = decay((1.0,), units={"time": "min", "A": "mol/L"})
    two = [tc.terms.kinetics("A", rate=None, time="s")[0], tc.terms.kinetics("A", rate=None, time="h", label="b")[1]]
    with pytest.warns(UnitWarning) as caught:
        diagnose(model, recording, two, holdout=False, num_starts=2)
    texts = [str(w.message) for w in caught if w.category is UnitWarning]
    assert ["'reverse reaction'" in texts[0], "'autocatalysis (b)'" in texts[1]] == [True, True]
    with pytest.raises(DomainError, match="time as the name"):
        tc.Term("t", equation="x", rate=lambda t, s, p, u: p["q"], parameters=[tc.Parameter("q")], time=60)


def test_the_reference_of_gravity_is_the_largest_distance():
    t = torch.linspace(0, 6, 40, dtype=F64)
    runs = [tc.Run(t, {"x": t.cos(), "y": t.sin()}, initial={"x": 1.0, "y": 0.0, "vx": 0.0, "vy": 1.0})]

    def rates(t, s, p, u):
        pull = -p["mu"] / (s["x"] ** 2 + s["y"] ** 2) ** 1.5
        return {"x": s["vx"], "y": s["vy"], "vx": pull * s["x"], "vy": pull * s["y"]}

    states = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}
    model = tc.ODESimulator(rates, states, [tc.Parameter("mu", low=0.1, initial=1.0)], observe=("x", "y"))
    problem = Problem.of(model.bind(tc.Recording(runs=runs)), tc.Recording(runs=runs))
    base, _ = calibrate_base(problem, {}, 2, 0)
    (term,) = [one for one in tc.terms.orbital(("x", "y"), ("vx", "vy")) if one.name == "exponent of gravity"]
    assert sized(term, drivers_scale(problem, base), problem.recording).constants == {"r_ref": 1.0}


@pytest.mark.parametrize(
    ("time", "mine", "told"),
    [("s", "min", True), pytest.param("h", "min", True, marks=pytest.mark.slow),
     ("min", "minutes", False), pytest.param("s", "ticks", False, marks=pytest.mark.slow),
     pytest.param("min", None, False, marks=pytest.mark.slow)],
)  # fmt: skip
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


def test_estimates_are_in_the_units_of_the_states_whatever_a_library_calls_them():
    t = torch.linspace(0, 3, 40, dtype=F64)
    fall = 9.81e3 * t.square() / 2
    ball = tc.ODESimulator(
        lambda t, s, p, u: {"z": s["v"], "v": p["g"]},
        {"z": "mm", "v": "mm/s"},
        [tc.Parameter("g", unit="mm/s^2", initial=9.81e3)],
        observe=("z",),
    )
    runs = [tc.Run(time=t, outputs={"z": fall}, initial={"z": 0.0, "v": 0.0})]
    terms = [*tc.terms.mechanics("z", "v", angle=False), *tc.terms.sensor(("z",))]
    told = {q.name: q.unit for q in terms[1].parameters}
    d = diagnose(ball, tc.Recording(runs=runs, noise=5.0, units={"z": "mm"}), terms, holdout=False, num_starts=2)
    units = {row.term: row.unit for row in d.detection_limit}
    assert told == {"c": "1/m"}
    assert units["quadratic drag"] == units["non-linearity of z"] == "1/mm"
    assert units["cubic drag"] == "s/mm^2"
    assert units["offset of z"] == "mm"


@pytest.mark.parametrize(
    ("known", "told"),
    [
        ({"y": "mm"}, "1/mm"),
        ({"y": "mol/L"}, "1/(mol/L)"),
        ({"y": "kN·m"}, "1/(kN·m)"),
        ({"y": "m-1"}, "1/(m-1)"),
        ({"y": "dB(A)"}, "1/(dB(A))"),
        ({"y": "degC"}, "1/degC"),
        ({"x": "K"}, "1/([y])"),
        ({"y": None}, "1/([y])"),
    ],
)
def test_a_unit_that_is_known_takes_the_place_of_its_name(known, told):
    bend = labelled(tc.terms.sensor(("y",), static=True)[2], known, {})
    assert [q.unit for q in bend.parameters] == [told]
    if known.get("y"):
        assert [q.unit for q in tc.terms.sensor(("y",), units=known, static=True)[2].parameters] == [told]
    offset = labelled(tc.terms.sensor(("y",), static=True)[0], known, {})
    assert [q.unit for q in offset.parameters] == [known.get("y") or "[y]"]


def test_own_states_of_a_term_are_in_the_units_of_what_they_follow():
    (second,) = [term for term in tc.terms.hydraulics("h") if term.states]
    assert [*labelled(second, {}, {"h": "cm"}).states.values()] == ["cm"]
    with pytest.raises(DomainError, match=r"labels= of the term 't' as names of units\. Got 'x': 3"):
        tc.Term("t", frees=["a"], labels={"x": 3})


def test_axes_in_different_units_and_numbers_without_one_keep_what_they_are_called():
    drag = tc.terms.mechanics(("x", "y"), ("vx", "vy"))[1]
    assert labelled(drag, {}, {"x": "mm", "y": "km"}) is drag
    assert [q.unit for q in labelled(drag, {}, {"x": "mm", "y": "mm"}).parameters] == ["1/mm"]
    swing = tc.terms.mechanics(length="1")[0]
    assert labelled(swing, {}, {"x": "rad"}) is swing  # 1/s is no rad/s
    assert [q.unit for q in labelled(tc.terms.mechanics()[1], {}, {"x": "1"}).parameters] == ["1/[x]"]


def test_an_output_that_is_called_as_a_state_has_its_own_unit():
    t = torch.linspace(0, 4, 30, dtype=F64)
    model = tc.ODESimulator(
        lambda t, s, p, u: {"h": -p["k"] * s["h"]},
        {"h": "m"},
        [tc.Parameter("k", low=0.0, initial=0.5)],
        observe={"h": lambda t, s, p, u: 100 * s["h"]},
    )
    runs = [tc.Run(time=t, outputs={"h": 100 * torch.exp(-0.5 * t)}, initial={"h": 1.0})]
    terms = [tc.terms.sensor(("h",))[0], tc.terms.hydraulics("h")[3]]
    found = diagnose(model, tc.Recording(runs=runs, noise=0.1, units={"h": "cm"}), terms, holdout=False, num_starts=2)
    assert {row.term: row.unit for row in found.detection_limit} == {"offset of h": "cm", "evaporation": "m/s"}


def test_a_term_of_a_class_of_its_own_keeps_it():
    class Bend(tc.Term):
        def __init__(self, power):
            super().__init__(f"bend {power}", outputs={"y": lambda x, p, y: y + p["c"] * x**power},
                             parameters=[tc.Parameter("c", unit="[y]")])  # fmt: skip

    bend = Bend(2)
    other = labelled(bend, {"y": "K"}, {})
    assert type(other) is Bend
    assert [q.unit for q in (*other.parameters, *bend.parameters)] == ["K", "[y]"]
    assert labelled(bend, {"x": "m"}, {}) is bend
