"""What a diagnosis says of its numbers: the place of a name, its rivals, spans, bounds, limits and distances."""

import dataclasses
import functools
import math
import sys
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal.discovery.findings import called, symptoms, where, words
from torchcal.discovery.findings import where_in_words as where_text
from torchcal.discovery.findings.where_in_words import where_in_words
from torchcal.discovery.fits import local
from torchcal.discovery.fits.candidates import Candidate
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.misfit.channels import Channel
from torchcal.discovery.misfit.places import Place
from torchcal.discovery.records import Estimate, Experiment, Hypothesis, Limit, Location, MissingRate, Table
from torchcal.discovery.verdicts import doubts, explain
from torchcal.display import IN_BASE, NONE
from torchcal.plots.discovery.pieces import likeliest_with
from torchcal.report import diagnosis_page

F64 = torch.float64
T = torch.linspace(0, 10, 11, dtype=F64)
WHOLE, PART = ((0.0, 10.0),), ((2.0, 5.0),)


def row(terms, probability, **more):
    more = {"refitted": terms != NONE, "misfit_removed": 0.9, **more}
    return Hypothesis(tuple(terms), 0.0, probability, **more)


def finding(verdict="named", **more):
    """What the sentences of a diagnosis are made of."""
    score = SimpleNamespace(rmse=0.1)
    return SimpleNamespace(**{
        "verdict": verdict, "terms": ["drag"] if verdict == "named" else [], "tied": [], "where": [], "ranking": [],
        "settings": {}, "remaining": 0.0, "after": None, "embedded": [], "experiment": None, "held_out": None,
        "missing": None, "detection_limit": [], "p_detect": 0.5, "confidence": 0.99, "drivers": {"t": T},
        "before": SimpleNamespace(fitted=score, held_out=None, model_error_sd=None),
        "noise": SimpleNamespace(source="given", correlation={}),
        "recording": SimpleNamespace(
            runs=[SimpleNamespace(units={})] * 4, outputs=("y",), units={}, split=lambda values: {"y": values}),
        "simulator": SimpleNamespace(states={"T": "K", "n": None}),
        "base": SimpleNamespace(prediction=2 * T), **more,
    })  # fmt: skip


def said(d):
    return " ".join(part for part in getattr(words, d.verdict)(d) if part)


# --- where -----------------------------------------------------------------------------------------------------


def channel(kind, target, **rates):
    return Channel(kind, target, None, {"t": T}, T, torch.eye(11, dtype=F64), {name: T for name in rates})


def located(term, *, inside=(), named=True):
    """Places by falling evidence: a parameter before the equations and the output."""
    kinds = {("parameter", "kd"): 50.0, ("equation", "M"): 40.0, ("parameter", "kp"): 30.0, ("output", "y"): 20.0,
             ("equation", "R"): 10.0}  # fmt: skip
    places = [Place(channel(*key), "t", evidence, 0.5, T, T) for key, evidence in kinds.items()]
    search = SimpleNamespace(
        structure=SimpleNamespace(places=places, together=None), unnamed=None,
        problem=SimpleNamespace(in_time=True, recording=SimpleNamespace(outputs=("y",))),
    )
    model = SimpleNamespace(
        window=None, candidate=SimpleNamespace(terms=[term]), structure=SimpleNamespace(channels=list(inside))
    )
    unknown = {"_reads": lambda model: set(), "_elsewhere": lambda search, model, place: None}
    with mock.patch.multiple(where, removed=lambda search, model: 0.5, **unknown):
        return [(place.kind, place.target) for place in where.locate(search, places, model, named=named)]


def rate(t, s, p, u):
    return p["q"]


Q = {"parameters": [tc.Parameter("q")]}
ACTS = {
    "equation": (tc.Term("one", equation="R", rate=rate, **Q), (), ("equation", "R")),
    "parameter": (tc.Term("one", shifts={"kp": rate}, **Q), (), ("parameter", "kp")),
    "value of a run": (tc.Term("one", frees=("k",)), [channel("parameter", "k[1]", M=1)], ("equation", "M")),
    "no place": (tc.Term("one", frees=("ki",)), [channel("parameter", "ki", R=1)], ("equation", "R")),
    "hidden state of an output": (
        tc.Term("one", states={"z": None}, initial={"z": 0.0}, rates={"z": rate},
                outputs={"y": lambda t, s, p, u, y: y + s["z"]}, **Q), (), ("output", "y")),
    "hidden state of a parameter": (
        tc.Term("one", states={"z": None}, initial={"z": 0.0}, rates={"z": rate}, shifts={"kp": rate}, **Q), (),
        ("parameter", "kp")),
    "output": (tc.Term("one", outputs={"y": lambda t, s, p, u, y: y + p["q"]}, **Q), (), ("output", "y")),
}


@pytest.mark.parametrize(("term", "inside", "first"), ACTS.values(), ids=ACTS)
def test_what_a_name_acts_on_comes_first(term, inside, first):
    found = located(term, inside=inside)
    assert found[0] == first
    others = located(term, inside=inside, named=False)  # of a tie nobody knows
    assert others[0] == ("parameter", "kd")
    assert found[1:] == [key for key in others if key != first]


def captured(monkeypatch, base, recording, terms):
    """The search behind a diagnosis, and its best model."""
    seen = []
    locate = where.locate

    def spy(search, places, shown, **kwargs):
        seen.append((search, shown))
        return locate(search, places, shown, **kwargs)

    monkeypatch.setattr(sys.modules["torchcal.discovery.conclude"], "locate", spy)
    tc.diagnose(base, recording, terms, progress=False)
    return seen[0]


def test_a_parameter_that_was_dormant_is_where_its_contribution_is_large(monkeypatch):
    x, z = torch.linspace(0, 1, 40, dtype=F64), torch.linspace(-1, 1, 40, dtype=F64)[torch.arange(40) * 7 % 40]
    base = tc.Simulator(
        lambda x, p: p["a"] + p["b"] * x["x"] + p["c"] * x["z"] ** 4,
        [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("c", neutral=0.0)],
    )
    noise = torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=F64)
    recording = tc.Recording(x={"x": x, "z": z}, y=1 + x + 2 * z**4 + 0.05 * noise, noise=0.05)
    search, best = captured(monkeypatch, base, recording, [tc.Term("bowl", frees=("c",))])
    assert best.names == ("bowl",)
    first = where.locate(search, search.structure.places, best, named=True)[0]
    assert (first.kind, first.target, first.driver) == ("parameter", "c", "z")
    assert first.share > 0.95
    # What no constant and slope can do: z⁴ without its mean is large at the end, and small near 0.67.
    assert first.spans[0] == (-1.0, pytest.approx(-0.85, abs=0.08))
    assert not any(low < -0.67 < high for low, high in first.spans)


def test_a_name_acts_by_what_it_is_a_function_of(monkeypatch):
    g = torch.Generator().manual_seed(3)
    first, second = (torch.rand(60, generator=g, dtype=F64) for _ in range(2))
    x = {"Re": 500 + 9500 * first, "Pr": 1 + 9 * second}
    base = tc.Simulator(
        lambda x, p: p["C"] * x["Re"] ** p["m"] * x["Pr"] ** 0.33,
        [tc.Parameter("C", low=0.01, high=3.0, initial=0.3), tc.Parameter("m", low=0.2, high=1.2, initial=0.6)],
    )
    onset = tc.Term(
        "onset", shifts={"m": lambda x, p: p["a"] * torch.sigmoid((x["Re"] - p["Rc"]) / 500)},
        parameters=[tc.Parameter("a"), tc.Parameter("Rc", low=1e3, high=9e3)],
    )  # fmt: skip
    y = 0.25 * x["Re"] ** (0.6 + 0.02 * torch.sigmoid((x["Re"] - 4000) / 500)) * x["Pr"] ** 0.33
    y = y + 0.01 * y.std() * torch.randn(60, generator=g, dtype=F64)
    search, best = captured(monkeypatch, base, tc.Recording(x=x, y=y), [onset])
    assert where._reads(best) == {"Re"}
    mine = [place for place in search.structure.places if place.channel.target == "m"]
    along = {place.driver: place for place in mine}
    # However likely the other condition is: the term is no function of it.
    search.structure.places[:] = [dataclasses.replace(along["Pr"], evidence=900.0), *search.structure.places]
    assert where.locate(search, search.structure.places, best, named=True)[0].driver == "Re"
    assert where.locate(search, search.structure.places, best)[0].driver == "Pr"


def test_what_a_term_in_time_is_a_function_of():
    drivers = {name: torch.ones(3, dtype=F64) for name in ("t", "z", "v", "F")}
    problem = SimpleNamespace(
        in_time=True, drivers_at_data=lambda values, warm: dict(drivers), recording=SimpleNamespace(x={"time": T}),
        parameters_at_data=lambda values: {"k": T[0], "one.q": T[1]},
    )  # fmt: skip
    problem.arguments = functools.partial(Problem.arguments, problem)
    found = SimpleNamespace(problem=problem, values=T, warm=None, y=T)
    for term, read in (
        (tc.Term("one", rates={"v": lambda t, s, p, u: p["q"] * s["v"] * u["F"]}, **Q), {"v", "F"}),
        (tc.Term("one", shifts={"k": lambda t, s, p, u: p["q"] * t}, **Q), set()),
        (tc.Term("one", outputs={"y": lambda t, s, p, u, y: y + p["q"] * s["z"]}, **Q), {"z"}),
        (tc.Term("one", rates={"v": lambda t, s, p, u: p["of each run"] * s["v"]}, **Q), set()),
    ):
        model = SimpleNamespace(found=found, candidate=SimpleNamespace(terms=[term]))
        assert where._reads(model) == read


@pytest.mark.parametrize(("low", "high", "met"), [(72.9, 78.6, (80.0, 80.0)), (1.0, 9.0, (0.0, 0.0)),
                                                  (70.0, 85.0, (70.0, 85.0)), (60.0, 61.0, (60.0, 61.0))])  # fmt: skip
def test_a_window_between_the_levels_of_a_driver_acts_at_the_nearest(low, high, met):
    assert where._met(torch.tensor([0.0, 60.0, 80.0, 60.0], dtype=F64), low, high) == met


@pytest.mark.parametrize(
    ("driver", "hold", "levels"), [("I", "zero", True), ("I", "linear", False), ("T", "zero", False)]
)
def test_an_input_that_is_held_has_levels(driver, hold, levels):
    runs = (tc.Run(time=T, outputs={"T": T}, inputs={"I": T}, hold=hold),)
    search = SimpleNamespace(problem=SimpleNamespace(recording=SimpleNamespace(runs=runs)))
    assert where._has_levels(search, driver) is levels


def test_slivers_are_no_spans():
    x = torch.linspace(0, 1, 200, dtype=F64)
    change = ((x > 0.2) & (x < 0.6)).double()
    change[60] = change[61] = 0.0  # a gap of two points in a hundred each
    change[150] = 1.0
    assert where._ranges(x, change) == ((float(x[40]), float(x[119])),)
    alone = torch.zeros(200, dtype=F64)
    alone[150] = 1.0
    assert where._ranges(x, alone) == ((float(x[150]), float(x[150])),)
    # Nor is what may be nothing, unless all of it may.
    sd = torch.where(x > 0.5, 2.0, 0.1)
    assert where._ranges(x, change, sd) == ((float(x[40]), float(x[99])),)
    assert where._ranges(x, change, 2 * torch.ones_like(x)) == where._ranges(x, change)
    sd[150] = 0.01  # and what is surest is told, however narrow
    assert where._ranges(x, change, sd) == ((float(x[40]), float(x[99])), (float(x[150]), float(x[150])))


def test_the_missing_rate_is_told_where_the_change_without_a_name_acts():
    places = [Place(channel(*key), driver, 9.0, 0.5, T, T)
              for key in (("equation", "R"), ("equation", "M")) for driver in ("t", "R")]  # fmt: skip
    nameless = tc.Term("a constant", rates={"M": rate}, **Q)
    unnamed = SimpleNamespace(
        window=SimpleNamespace(driver="R"), candidate=SimpleNamespace(terms=[nameless]), structure=None
    )
    found = where._first_unnamed(SimpleNamespace(unnamed=unnamed), places)
    assert [(p.channel.target, p.driver) for p in found] == [("M", "R"), ("R", "t"), ("R", "R"), ("M", "t")]
    assert where._first_unnamed(SimpleNamespace(unnamed=None), places) == places


@pytest.mark.parametrize(
    ("driver", "spans", "told"),
    [
        ("t", PART, " (largest at 2 to 5)"), ("t", WHOLE, ""), ("t", ((0.3, 4.9), (5.0, 9.9)), ""),
        ("y itself", ((0.0, 20.0),), ""), ("y itself", WHOLE, " (largest at 0 to 10)"),
        ("run", ((1.0, 1.0),), " (largest in 1, counted from 0)"), ("run", ((0.0, 3.0),), ""),
        ("run", ((0.0, 0.0), (2.0, 3.0)), " (largest in 0, 2 to 3, counted from 0)"),
        ("run", ((0.0, 1.0), (2.0, 3.0)), ""),
    ],
)  # fmt: skip
def test_spans_are_told_where_they_are_not_everywhere(driver, spans, told):
    for verdict in ("named", "unexplained"):
        text = where_in_words(finding(verdict, where=[Location("parameter", "k", driver, spans, 0.5, 20.0)]))
        verb = "differs from run to run" if driver == "run" else f"varies with {driver}"
        assert f"{verb}{told}: " in text
        assert ("per_run=True" in text) == (driver == "run" and verdict != "named")


def test_a_term_in_a_window_is_told_by_its_name_and_steps_by_where_they_are():
    term = where_in_words(finding(where=[Location("parameter", "k", "t", PART, 0.5, 20.0, terms=("drag",))]))
    assert "varies with t (largest at 2 to 5): adding drag there removes 50 % of" in term
    step = Location("output", "y", "t", PART, 0.5, 20.0, edges=(2.0,))
    timed = finding(where=[step])
    timed.recording.units = {"time": "min"}
    assert "jumps with t (at 2 min): one constant change on one side removes" in where_in_words(timed)
    assert "jumps with t (at 2): one constant change on one side removes" in where_in_words(finding(where=[step]))
    steps = Location("output", "y", "t", PART, 0.5, 20.0, extent=10.0, edges=(2.0, 5.0))
    assert "jumps with t (at 2 and 5): one constant change in between removes" in where_in_words(finding(where=[steps]))
    told = "in the equation v and the equation w and is sudden, at t = 3.457 min: one change in that moment removes"
    place = Location("equation", "v", "t", PART, 0.5, 20.0, extent=10.0, also=(("equation", "w"),), moment=3.45678)
    knocked = finding(where=[place])
    knocked.recording.units = {"time": "min"}
    assert told in where_in_words(knocked)
    ends = dataclasses.replace(steps, spans=((0.0, 1.9), (5.1, 10.0)))
    assert "(at 2 and 5): one constant change outside of these removes" in where_in_words(finding(where=[ends]))


def test_another_place_in_one_run_is_told_with_that_run():
    places = [
        Location("equation", "v", "t", PART, 0.5, 20.0, run=0), Location("equation", "z", "t", PART, 0.5, 19.0, run=1),
    ]  # fmt: skip
    text = where_in_words(finding("unexplained", where=places))
    assert "and one of the equation z of run 1 (counted from 0) with t about as much" in text


@pytest.mark.slow
def test_a_named_instrument_that_remembers_is_told_by_what_it_removes():
    t = np.linspace(0, 30, 121)
    u = np.where((t // 5) % 2 == 0, 1.0, 0.0)
    rate = lambda s, y: [-0.4 * (y[0] - np.interp(s, t, u)), (y[0] - y[1]) / 1.5]  # noqa: E731
    y = solve_ivp(rate, (0, 30), [0.0, 0.0], t_eval=t, max_step=0.05, rtol=1e-8).y[1]
    base = tc.ODESimulator(
        lambda t, s, p, u: {"x": -p["k"] * (s["x"] - p["g"] * u["u"])},
        {"x": "m"},
        [tc.Parameter("k", low=0.0, initial=0.5), tc.Parameter("g", initial=1.0)],
    )
    y += 0.01 * np.random.default_rng(0).standard_normal(121)
    runs = [tc.Run(t, {"x": y}, initial={"x": 0.0}, inputs={"u": u})]
    terms = [term for term in tc.terms.sensor(outputs=("x",), units={"x": "m"}) if term.name != "delay of x"]
    d = tc.diagnose(base, tc.Recording(runs=runs, noise=0.01, units={"time": "s"}), terms, seed=0, progress=False)
    assert (d.verdict, d.terms) == ("named", ["lag of x"])
    assert (d.where[0].kind, d.where[0].target, d.where[0].driver) == ("output", "x", "t")
    assert d.where[0].share > 0.99
    assert "adding lag of x there removes" in " ".join(str(d).split())
    assert d.equations[0].startswith("x → x + a (x_shown - x), dx_shown/dt = 2.303 (x - x_shown)/t90")


def test_a_change_of_an_output_that_removes_more_is_told_to_copy_any_other():
    physics = Location("equation", "v", "t", PART, 0.84, 20.0)
    text = where_in_words(finding("unexplained", where=[physics, Location("output", "y", "t", PART, 0.97, 25.0)]))
    assert "and one of the output y with t 97 %, though a change of an output can copy that of any equation" in text
    text = where_in_words(finding("unexplained", where=[physics, Location("output", "y", "t", PART, 0.87, 25.0)]))
    assert "and one of the output y with t about as much" in text


def test_a_change_at_some_levels_of_another_condition_is_told_with_these():
    step = Location("parameter", "a", "m", PART, 0.5, 20.0, edges=(2.0, 5.0), at="I = 4")
    text = where_in_words(finding(where=[step]))
    assert "jumps with m (at 2 and 5) where I = 4: one constant change in between removes" in text


def test_what_varies_with_a_driver_is_what_several_terms_do_together():
    terms = [
        tc.Term("one", frees=("D",)), tc.Term("two", frees=("d",)), tc.Term("three", frees=("d",)),
    ]  # fmt: skip
    model = SimpleNamespace(candidate=SimpleNamespace(terms=terms))
    first, *also = where._act_on(model)
    place = Location(*first, "t", PART, 0.5, 20.0, terms=("one", "two", "three"), also=tuple(also))
    text = where_in_words(finding(where=[place]))
    assert "sits in the parameter D and the parameter d and varies with t" in text


def test_spans_over_decades_are_measured_in_decades():
    place = Location("parameter", "k", "c", ((1e3, 1e6),), 0.5, 20.0)
    assert not where_text._everywhere(finding(drivers={"c": torch.logspace(0, 6, 13, dtype=F64)}), place)


def test_a_name_is_in_one_place():
    places = [Location("equation", "R", "t", PART, 0.5, 20.0), Location("parameter", "kd", "t", PART, 0.6, 40.0)]
    assert "kd" not in where_in_words(finding(where=places))
    assert "kd" in where_in_words(finding("ambiguous", where=places))


# --- a name and its rivals -------------------------------------------------------------------------------------

TOP = Estimate("drag.c", 1.0, 0.1, "1/m")


def test_a_rival_does_not_hold_the_name():
    rows = [row(["drag", "offset"], 0.5), row(["drag"], 0.4, estimates=(TOP,)), row(["spring"], 0.02),
            row(["spring"], 0.02, region="t > 3"), row([], 0.03)]  # fmt: skip
    text = said(finding(ranking=rows))
    assert "probability alone or with others 0.900" in text
    assert "The next best without it, spring, has a probability of 0.04 (3.1 behind the name in log odds)." in text


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ([row(NONE, 0.02), row(["spring"], 0.01)], "something that is not in this library, has a probability of "
         "0.02 (3.9 behind"),
        ([row([], 0.02), row(["spring"], 0.01)], "the base alone, has a probability of 0.02"),
        ([row(["spring"], 0.0), row([], 0.0)], "spring, has a probability of < 0.001 (more than 100 behind"),
        ([row(["spring"], 1e-90), row([], 0.0)], "spring, has a probability of < 0.001 (more than 100 behind"),
    ],
)  # fmt: skip
def test_the_likeliest_rival_is_told(rows, told):
    assert told in said(finding(ranking=[row(["drag"], 0.97, estimates=(TOP,)), *rows]))


@pytest.mark.parametrize(
    ("beside", "told"),
    [
        ((), "The next best without it, something that is not in this library, has a probability of 0.03"),
        (("drag",), "not in this library acts beside it, or in its place, has a probability of 0.03."),
        (("drag", "bias"), "not in this library acts beside it, or in its place, has a probability of 0.03."),
        (("bias",), "The next best without it, something that is not in this library, has a probability of 0.03"),
    ],
)
def test_something_unknown_beside_a_name_is_told_as_that(beside, told):
    found = finding(ranking=[row(["drag"], 0.97, estimates=(TOP,)), row(["none of these"], 0.03)])
    found.settings["unknown_beside"] = beside
    assert told in said(found)


def test_what_has_a_part_of_a_name_is_a_rival():
    rows = [row(["drag", "bias"], 0.9), row(["drag"], 0.06)]
    assert "The next best without all of them, drag, has" in said(finding(terms=["bias", "drag"], ranking=rows))


def test_an_embedded_error_is_not_told_by_thousands():
    errors = [SimpleNamespace(parameter=name, sd=0.1, log_likelihood=value) for name, value in (("a", 4e5), ("b", 1.0))]
    assert "(sd 0.1; more than 100 in log-likelihood before b)" in where_text._embedded(finding(embedded=errors))
    errors[0].log_likelihood = 21.0
    assert "20.0 in log-likelihood before b" in where_text._embedded(finding(embedded=errors))
    errors[1].log_likelihood = errors[0].log_likelihood - 0.04
    assert "about as likely in a (sd 0.1) as in b (sd" in where_text._embedded(finding(embedded=errors))


def test_what_is_removed_and_what_remains_are_all():
    rows = [row(["drag"], 0.99, misfit_removed=1.0, estimates=(TOP,))]
    text = said(finding(ranking=rows, remaining=0.031))
    assert "removes 97 % of the misfit" in text
    assert "3.1 % of the misfit remains unexplained" in text


def test_an_estimate_that_depends_on_what_acts_beside_it_is_told():
    mass = Estimate("m", 2.0, 0.1, "kg")
    other = [dataclasses.replace(TOP, value=1.5, sd=0.2), Estimate("offset.b", 3.0, 0.1), mass]
    told = "drag.c depends on what acts beside it: 1.5 ± 0.2 1/m with offset."
    assert explain.depends([mass, TOP], other, ["offset"]) == told
    near = [dataclasses.replace(TOP, value=1.19), mass]
    assert explain.depends([mass, TOP], near, ["offset"]) == ""  # within 2 sd
    # One of the base's own may move most.
    assert explain.depends([mass, TOP], [*near[:1], dataclasses.replace(mass, value=3.0)], ["offset"]).startswith("m ")
    rows = [row(["drag", "offset"], 0.6), row(["drag"], 0.3, estimates=(TOP,))]
    found = finding(ranking=rows, tied=[["drag", "offset"], ["drag"]])
    assert "depends on" not in said(found)
    found.settings["depends"] = told
    assert told in said(found)


# --- no name ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "best", "unknown", "told"),
    [
        ("given", {"p_white": 0.3}, 0.9, ", but something unknown is likelier by 2.9 in log odds."),
        ("given", {"p_white": 1 / 501}, 0.01, ", but what it leaves is not noise (probability < 0.002)."),
        ("given", {"p_white": 0.004}, 1.0, ", but something unknown is likelier by 3.0 in log odds and what it leaves "
         "is not noise (probability 0.004)."),
        ("given", {"p_white": 0.3}, 0.01, ", but it leaves more than the noise that is given."),
        ("estimated", {"note": "its window has closed"}, 0.9, " (its window has closed)."),
    ],
)  # fmt: skip
def test_why_the_best_of_the_library_is_no_name(source, best, unknown, told):
    rows = [row(["drag"], 0.05, **{"misfit_removed": 1.0, **best}), row(NONE, unknown)]
    noise = SimpleNamespace(source=source, correlation={})
    share = "99.9 %" if best.get("p_white", 1.0) > 0.005 else "most"  # which is of a noise that it does not leave
    text = said(finding("unexplained", ranking=rows, noise=noise))
    assert f"removes {share} of the misfit beyond noise{told}" in text


def test_without_noise_a_name_is_lost_on_held_out_data():
    rows, noise = [row(["drag"], 0.05, misfit_removed=0.95)], SimpleNamespace(source="none", correlation={})
    d = finding("unexplained", ranking=rows, noise=noise, held_out=T > 5)
    assert "removes 95 % of the misfit beyond noise, but not of what was held out." in said(d)
    rows[0] = row(["drag"], 0.05, misfit_removed=0.5)
    assert "removes 50 % of the misfit beyond noise." in said(d)


@pytest.mark.parametrize(("count", "told"), [(6, "term5 0.5."), (7, ", and 1 other."), (9, ", and 3 others.")])
def test_limits_that_are_left_out_are_counted(count, told):
    limits = [Limit(f"term{k}", "c", 0.5, None, 0.95) for k in range(count)]
    assert said(finding("consistent", detection_limit=limits)).endswith(told)


def test_effects_that_would_not_have_shown_are_told():
    rows = [Limit(name, "c", size, None, 0.95, note=note) for name, size, note in (
        ("drag", 0.5, ""), ("sag", math.inf, "calibration hides effects of 9, the largest that was tried"),
        ("offset", math.inf, IN_BASE),
    )]  # fmt: skip
    text = said(finding("consistent", detection_limit=rows))
    assert "No effect of any size that was tried would have shown of sag. The smallest" in text


@pytest.mark.parametrize(
    ("p", "told"), [(0.5, "no sign"), (0.02, "no sure sign"), (0.001, "base alone remains likelier")]
)
def test_no_sign_is_told_with_what_chance_has_to_do_for_it(p, told):
    d = finding("consistent", p_detect=p, noise=SimpleNamespace(source="given", correlation={}))
    assert told in said(d)


def test_a_probability_below_what_names_is_told_below_it():
    d = finding("ambiguous", tied=[["drag"], list(NONE)], ranking=[row(["drag"], 0.8496), row(NONE, 0.15)])
    assert "has a probability of 0.84, which is too little" in said(d)


def test_what_was_not_refitted_has_removed_nothing_that_is_known():
    table = Table([Hypothesis(NONE, 1.0, 0.4), row(["drag"], 0.6)], ("terms", "misfit_removed"))
    assert [line.split()[-1] for line in str(table).splitlines()[1:]] == ["-", "0.9"]


@pytest.mark.parametrize("region", ["t < 3", "390 < t < 480", "x > 2", None])
def test_an_experiment_that_takes_an_event_for_granted_says_so(region):
    rows = [row(["drag"], 0.5, region=region), row(["friction"], 0.4)]
    d = finding("ambiguous", experiment=Experiment("longer", 5.0), tied=[["drag"], ["friction"]], ranking=rows)
    text = "It takes for granted that what acts in a span of time does so again."
    assert (text in called.experiment_told(d)[0]) is (region is not None and "t" in region)
    d.recording.runs = None  # where "t" is a condition
    assert text not in called.experiment_told(d)[0]


@pytest.mark.parametrize(("separation", "told"), [(12.34, "12.3"), (99.96, "100"), (35e4, "more than 100")])
def test_no_distance_is_told_by_thousands(separation, told):
    experiment = Experiment("longer", separation)
    assert f"(predicted distance {told}" in called.experiment_told(finding(experiment=experiment))[0]
    assert f"would differ there by {told}" in diagnosis_page._experiment(finding(experiment=experiment))


# --- symptoms and what is not identified -----------------------------------------------------------------------


def parabola(noise=0.02):
    x = torch.linspace(0, 1, 30, dtype=F64)
    base = tc.Simulator(lambda x, p: p["a"] + p["kd"] * x, [tc.Parameter("a"), tc.Parameter("kd", low=0.0)])
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y - p["q"] * x**2}, parameters=[tc.Parameter("q")])
    wobble = noise * torch.randn(30, generator=torch.Generator().manual_seed(1), dtype=F64)
    return base, tc.Recording(x=x, y=1 + 0.5 * x - 2 * x**2 + wobble, noise=noise), [bend]


def test_a_parameter_on_its_bound_is_told_once(monkeypatch):
    search, best = captured(monkeypatch, *parabola())
    (line,) = [line for line in symptoms.symptoms(search, best, "") if line.startswith("kd")]
    assert line.startswith("kd runs to its bound, 0, in the calibrated base; it is 0.")
    assert line.endswith("with bend")


@pytest.mark.parametrize("stuck", [["k"], []])
def test_a_bound_of_the_base_may_be_why_a_size_is_open(monkeypatch, stuck):
    problem = SimpleNamespace(parameters=[tc.Parameter("k"), tc.Parameter("drag.a")])
    candidate = SimpleNamespace(terms=[SimpleNamespace(brings="drag.a".__eq__)], own=[1], amplitudes=[1])
    model = SimpleNamespace(candidate=candidate, window=None, found=SimpleNamespace(problem=problem))
    search = SimpleNamespace(
        exact=False, base=SimpleNamespace(stuck=stuck), problem=SimpleNamespace(in_time=bool(stuck)),
        noise=SimpleNamespace(open=False),
    )  # fmt: skip
    monkeypatch.setattr(doubts, "_distance", lambda *given: 0.0)
    told = doubts.left_open(search, model)
    assert told.startswith("The data leave the size of what it adds open")
    assert ("k ran to a bound in the base" in told) is bool(stuck)
    assert ("another run would tell" if stuck else "more conditions would tell") in told


@pytest.mark.parametrize(
    ("count", "away", "is_open"), [(1, 1.0, False), (1, 0.05, True), (2, 1.0, True), (2, 3.0, False)]
)
def test_what_one_of_several_adds_must_be_clearly_there(monkeypatch, count, away, is_open):
    problem = SimpleNamespace(parameters=[tc.Parameter("drag.a"), tc.Parameter("bias.b")][:count])
    terms = [SimpleNamespace(brings=q.name.__eq__) for q in problem.parameters]
    candidate = SimpleNamespace(terms=terms, own=[*range(count)], amplitudes=[*range(count)])
    found = SimpleNamespace(problem=problem, free=[*range(count)])
    model = SimpleNamespace(candidate=candidate, window=None, found=found)
    search = SimpleNamespace(
        exact=False, base=SimpleNamespace(stuck=[]), problem=SimpleNamespace(in_time=False),
        noise=SimpleNamespace(open=False),
    )  # fmt: skip
    monkeypatch.setattr(doubts, "_distance", lambda *given: away)
    monkeypatch.setattr(doubts, "distinct", lambda problem: 100)
    assert doubts.left_open(search, model).startswith("The data leave the size") is is_open


def test_an_estimate_on_its_bound_says_so():
    parameters = [tc.Parameter("k", low=0.0), tc.Parameter("c", low=0.0), tc.Parameter("held", low=0.0)]
    found = SimpleNamespace(
        values=torch.tensor([0.0, 1.0, 0.0], dtype=F64), free=[0, 1], at_bound=torch.tensor([False, False]),
        sd=lambda: torch.tensor([0.1, 0.1, 0.0], dtype=F64),
        jacobian=torch.eye(2, dtype=F64), whitening=lambda values: values,
        problem=SimpleNamespace(parameters=parameters, recording=SimpleNamespace(noise=None), in_time=True),
    )  # fmt: skip
    assert [e.at_bound for e in explain.estimates(found, range(3))] == [True, False, False]


def test_what_only_a_combination_tells_has_no_sd_of_its_own():
    """Its sd is what rounding makes of that of an unseen direction."""
    column = torch.linspace(1, 2, 5, dtype=F64)
    found = SimpleNamespace(
        values=torch.tensor([2.0, 3.0, 1.0], dtype=F64), free=[0, 1, 2], at_bound=torch.zeros(3, dtype=torch.bool),
        sd=lambda: torch.tensor([800.0, 700.0, 0.1], dtype=F64),
        jacobian=torch.stack([column, -2 * column, column**2], dim=-1), whitening=lambda values: values,
        problem=SimpleNamespace(
            parameters=[tc.Parameter(name) for name in "abc"], recording=SimpleNamespace(noise=None), in_time=True
        ),
    )  # fmt: skip
    told = [str(e) for e in explain.estimates(found, range(3))]
    assert told == ["a = 2 (not determined)", "b = 3 (not determined)", "c = 1 ± 0.1"]


@pytest.mark.parametrize("noise", [None, 0.01])
def test_an_estimate_that_is_zero_but_for_rounding_keeps_its_sd(noise):
    """What rounding leaves of it is no size that an sd could be large beside."""
    x = torch.arange(20, dtype=F64)
    curve = tc.Simulator(
        lambda x, p: p["a"] + p["b"] * x + p["c"] * x**2, [tc.Parameter(name, initial=1.0) for name in "abc"]
    )
    d = tc.diagnose(curve, tc.Recording(x=x, y=x**2, noise=noise), [], progress=False)
    a, b, c = d.base.estimates
    assert abs(a.value) + abs(b.value) < 1e-9
    assert 0 < c.sd < b.sd < a.sd < 0.01
    assert "not determined" not in str(d)


@pytest.mark.parametrize(("value", "sd", "slope"), [(1e-5, 1e38, 1e-40), (0.0, 1e150, 0.0), (100.0, 3e6, 0.0)])
def test_an_estimate_that_moves_no_datum_is_not_determined(value, sd, slope):
    """As a time constant far below the first sample."""
    found = SimpleNamespace(
        values=torch.tensor([value], dtype=F64), free=[0], at_bound=torch.zeros(1, dtype=torch.bool),
        sd=lambda: torch.tensor([sd], dtype=F64), jacobian=torch.full((5, 1), slope, dtype=F64),
        whitening=lambda values: values,
        problem=SimpleNamespace(
            parameters=[tc.Parameter("tau", initial=100.0)], in_time=True, index=torch.arange(5),
            recording=SimpleNamespace(noise=None, spread=torch.ones(5, dtype=F64)),
        ),
    )  # fmt: skip
    assert str(explain.estimates(found, [0])[0]).endswith("(not determined)")


def test_what_is_hardly_told_apart_keeps_its_sd():
    """As a slope far from where its line begins."""
    x = torch.linspace(1000, 1001, 60, dtype=F64)
    y = -2100 + 2.1 * x + 0.5 * torch.as_tensor(np.random.default_rng(0).standard_normal(60))
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    found = {e.name: e for e in tc.diagnose(line, tc.Recording(x=x, y=y), [], seed=0, progress=False).base.estimates}
    assert 0.1 < found["b"].sd < 0.5
    assert 100 < found["a"].sd < 500


def test_the_fastest_part_is_that_of_the_best_model(monkeypatch):
    search, best = captured(monkeypatch, *parabola(noise=0.002))
    x = torch.linspace(-1, 1, 30, dtype=F64)
    rough = 0.5 * torch.sin(40 * x)  # no curve that is smooth on this spacing follows it
    base = dataclasses.replace(search.base, y=search.problem.y - rough, chi2=1e9)
    search.base, search.noise = base, dataclasses.replace(search.noise, excess={"y": 8.2})
    assert symptoms.larger_than_given(search, best) == symptoms.larger_than_given(search, None) == {}
    search.models = []
    assert symptoms.larger_than_given(search, None)["y"] > 2


def untold(columns, sd):
    names = "abcdef"[: columns.shape[1]]
    return explain._untold(SimpleNamespace(
        jacobian=columns, whitening=lambda values: values, free=list(range(len(names))), chi2=1.0,
        values=torch.ones(len(names), dtype=F64), sd=lambda: torch.tensor(sd, dtype=F64),
        problem=SimpleNamespace(parameters=[tc.Parameter(name) for name in names],
                                recording=SimpleNamespace(noise=None), n=len(columns)),
    ))  # fmt: skip


def test_a_direction_is_told_where_it_leaves_parameters_open():
    x = torch.linspace(0, 1, 20, dtype=F64)
    same = torch.stack([x, x, x**2, 0 * x], dim=1)
    assert untold(same, [torch.inf, 0.5, 0.01, 0.0]) == (["d"], [["a", "b"]])
    assert untold(same, [0.01, 0.02, 0.01, 0.0]) == (["d"], [])  # stiff, and each is known well
    assert untold(same, [0.5, 0.02, 0.01, 0.0]) == (["d"], [])
    assert untold(same[:, 3:], [0.0]) == (["a"], [])


def test_directions_that_share_a_parameter_are_one_line():
    groups = [["a", "b"], ["c", "d"], ["e"], ["b", "c"], ["f", "g"]]
    assert explain._merged(groups) == [["e"], ["a", "b", "c", "d"], ["f", "g"]]
    assert explain._merged([]) == []


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        (lambda x: x**2, lambda x: x**3, True),
        (lambda x: x**2, lambda x: torch.sin(40 * x), False),
        # alike in what the base does too, and in nothing else
        (lambda x: 1 + 0.1 * torch.sin(40 * x), lambda x: 1 + 0.1 * torch.cos(40 * x), False),
    ],
)
def test_two_terms_that_do_much_the_same_may_stand_for_one_law(first, second, told):
    x = torch.linspace(0.3, 1.0, 200, dtype=F64)
    shapes = torch.stack([torch.ones_like(x), first(x), second(x)])
    terms = [tc.Term(name, outputs={"y": lambda x, p, y: y}, parameters=[tc.Parameter("q")]) for name in ("one", "two")]
    values = torch.tensor([0.3, 1.0, 2.0], dtype=F64)
    model = SimpleNamespace(
        found=SimpleNamespace(
            values=values, y=values @ shapes, whitening=lambda change: change / 0.1, free=[0, 1, 2],
            jacobian=shapes.T, problem=SimpleNamespace(
                parameters=[tc.Parameter(name) for name in ("a", "one.q", "two.q")],
                evaluate=lambda rows, columns: (rows @ shapes, None, None),
            ),
        ),
        candidate=Candidate(tuple(terms), None, [0, 1, 2], [1, 2], [1, 2], *torch.zeros(4, 2, dtype=F64)),
    )  # fmt: skip
    rows = explain.one_law(model)
    assert [row.startswith("one and two do much the same here (correlation 0.9") for row in rows] == [True] * told


def test_places_are_told_to_a_thousandth_of_their_extent():
    spans = ((1.7e9, 1.7e9 + 120.0), (1.7e9 + 300.0, 1.7e9 + 600.0))
    assert "largest at 1700000000 to 1700000120, 1700000300 to 1700000600)" in where_in_words(
        finding(where=[Location("parameter", "k", "c", spans, 0.5, 20.0)])
    )
    span = local.Span(2459000.0, 2459030.0, False)
    assert local.region_text("t", 2459012.341, math.inf, span) == "t > 2459012.34"
    assert local.region_text("t", 12.3456, 20.0, None) == "12.35 < t < 20"
    assert local.region_text("t", 7.998, 7.996, None) == "t near 7.997"  # it has closed
    begun = local.Span(0.03, 5.0, log=False)  # at an end of all data a window lets half of the term act
    assert local.region_text("x", -math.inf, 0.031, begun) == "x near 0.031"
    assert local.region_text("x", 5.0, math.inf, begun) == "x near 5"
    assert local.region_text("x", -math.inf, 0.1, begun) == "x < 0.1"
    decades = local.Span(0.01, 100.0, log=True)
    assert [decades.holds(at) for at in (0.01, 0.011, 50.0, 100.0, 200.0)] == [False, True, True, False, False]
    for extent in (600.0, 3600.0, 86400.0):
        start = 1.7e9 + 0.412 * extent
        span = local.Span(1.7e9, 1.7e9 + extent, False)
        assert abs(float(local.region_text("t", start, math.inf, span).split()[-1]) - start) < 0.002 * extent
    alone = Location("parameter", "k", "t", ((1.7e9 + 60, 1.7e9 + 60),), 0.5, 20.0, extent=600.0)
    assert "1700000060" in where_in_words(finding(where=[alone]))
    assert "1700000060" in str(Table([alone], ("driver", "spans")))
    assert diagnosis_page._spans(alone) == "1700000060"


@pytest.mark.parametrize(("given", "told"), [((0.01, 0.01), ()), ((0.03, 0.03), ("y", "z")), ((0.01, 0.1), ("z",))])
def test_noise_that_is_given_too_large_is_a_symptom(given, told):
    x, generator = torch.linspace(-1, 1, 60, dtype=F64), torch.Generator().manual_seed(2)
    base = tc.Simulator(lambda x, p: {"y": p["a"] * x, "z": p["b"] + 0 * x}, [tc.Parameter("a"), tc.Parameter("b")])
    y = {name: clean + 0.01 * torch.randn(60, generator=generator, dtype=F64)
         for name, clean in {"y": x, "z": 1 + 0 * x}.items()}  # fmt: skip
    noise = dict(zip("yz", given, strict=True))
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y - p["q"] * x**2}, parameters=[tc.Parameter("q")])
    d = tc.diagnose(base, tc.Recording(x=x, y=y, noise=noise), [bend], progress=False)
    lines = [line for line in d.symptoms if "times the noise sd that was given" in line]
    assert [line.split(" is white")[0] for line in lines] == [f"the residual of {name}" for name in told]


def test_noise_that_is_given_too_small_says_of_what():
    x, generator = torch.linspace(-1, 1, 60, dtype=F64), torch.Generator().manual_seed(2)
    base = tc.Simulator(lambda x, p: {"y": p["a"] * x, "z": p["b"] + 0 * x}, [tc.Parameter("a"), tc.Parameter("b")])
    y = {"y": x + 0.01 * torch.randn(60, generator=generator, dtype=F64),
         "z": 1 + 1.0 * torch.randn(60, generator=generator, dtype=F64)}  # fmt: skip
    d = tc.diagnose(base, tc.Recording(x=x, y=y, noise=0.01), [], progress=False)
    assert any(row.startswith("the noise of z is ") and row.endswith(" the sd that was given") for row in d.symptoms)
    recording = tc.Recording(x=x, y={"y": y["y"], "z": y["z"] + 5 * (x > 0)}, noise=0.01)
    d = tc.diagnose(base, recording, [], progress=False)
    assert any(row.startswith("the fastest part of the residual of z is ") for row in d.symptoms)


@pytest.mark.parametrize("given", [0.01, 0.5])
def test_noise_that_is_given_too_large_for_a_plain_misfit_is_a_symptom(given):
    x, generator = torch.linspace(-1, 1, 60, dtype=F64), torch.Generator().manual_seed(2)
    base = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")])
    y = x + 0.2 * x**2 + 0.01 * torch.randn(60, generator=generator, dtype=F64)
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y - p["q"] * x**2}, parameters=[tc.Parameter("q")])
    d = tc.diagnose(base, tc.Recording(x=x, y=y, noise=given), [bend], progress=False)
    assert d.verdict == ("named" if given == 0.01 else "consistent")
    told = [line for line in d.symptoms if "or the sd that was given is too large" in line]
    assert [line.startswith("the fastest part of the residual is 0.0") for line in told] == [True] * (given > 0.01)


@pytest.mark.parametrize("order", [np.arange(60), np.random.default_rng(0).permutation(60)])
def test_slow_noise_that_a_fit_takes_up_is_not_given_too_large(order):
    rng, found = np.random.default_rng(3), 0
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x + p["c"] * x**2, [tc.Parameter(name) for name in "abc"])
    x = np.linspace(0, 1, 60)
    for _ in range(6):
        e = np.zeros(60)
        for i in range(60):
            e[i] = 0.93 * e[i - 1] + np.sqrt(1 - 0.93**2) * rng.standard_normal()
        d = tc.diagnose(base, tc.Recording(x=x[order], y=(1 + x + 0.05 * e)[order], noise=0.05), [], progress=False)
        found += any("times the noise sd" in line for line in d.symptoms)
    assert found == 0


def test_what_acts_beside_one_of_the_tied_is_told_without_them():
    tied = [["drag", "lag"], ["drag"]]
    rows = [row(["drag", "lag"], 0.4), row(["drag"], 0.3), row(["drag", "offset"], 0.2)]
    assert "beside one of them has a probability of 0.20" in said(finding("ambiguous", tied=tied, ranking=rows))
    assert "beside one" not in said(finding("ambiguous", tied=tied, ranking=rows[:2]))


@pytest.mark.parametrize(("share", "told"), [(0.2, "probability 0.20"), (0.0, "though its probability is < 0.001")])
def test_something_unknown_that_tied_hypotheses_may_stand_for_is_told_with_its_probability(share, told):
    tied = [["drag"], ["lag"], list(NONE)]
    rows = [row(["drag"], 0.5), row(["lag"], 0.3), row(NONE, share)]
    text = said(finding("ambiguous", tied=tied, ranking=rows))
    assert f"Nor can these data exclude something that is not in the library ({told})." in text


@pytest.mark.parametrize(("share", "sign"), [(0.5, "no sure sign"), (0.1, "no sign")])
def test_there_is_no_sure_sign_where_a_term_is_likelier_than_the_base(share, sign):
    text = said(finding("consistent", ranking=[row(["drag"], share), row([], 0.3)]))
    assert f"There is {sign} of missing physics." in text
    assert ("Yet drag is likelier" in text) == (share > 0.3)
    text = said(finding("consistent", ranking=[row(["drag"], 0.6 * share), row(["sag"], 0.55 * share), row([], 0.3)]))
    together = "Yet the terms that were tried are, taken together, likelier than the base alone (probability 0.57 and"
    assert (together in text) == (share > 0.3)


def test_a_term_that_frees_what_is_free_is_told():
    base = tc.Simulator(lambda x, p: p["a"] + p["k"] * x, [tc.Parameter("a"), tc.Parameter("k")])
    x = torch.linspace(0, 1, 20, dtype=F64)
    y = 1 + 2 * x + 0.01 * torch.randn(20, generator=torch.Generator().manual_seed(1), dtype=F64)
    d = tc.diagnose(base, tc.Recording(x=x, y=y), [tc.Term("slope", frees=("k",))], progress=False)
    assert "slope frees what is calibrated already, and was no candidate" in d.identifiability
    with pytest.raises(tc.errors.DomainError, match=r"without the parameters that candidates free\. Got 'k'"):
        tc.diagnose(base, tc.Recording(x=x, y=y), [tc.Term("slope", frees=("k",))], fixed={"k": 1.0}, progress=False)


@pytest.mark.parametrize(
    ("shares", "told"),
    [((0.4, 0.35, 0.2), "3 hypotheses explain it about as well, and"),
     ((0.6, 0.3, 0.05), "3 hypotheses explain it with probabilities from 0.60 to 0.05, and"),
     ((0.6, 0.3, 0.0002), "3 hypotheses explain it with probabilities from 0.60 to < 0.001, and"),
     ((0.3, 0.3), "2 hypotheses explain it about as well, and these data cannot exclude either"),
     ((0.9, 0.05), "The best of them is b0 (probability 0.90); these data cannot exclude the other.")],
)  # fmt: skip
def test_how_well_tied_hypotheses_do_is_their_probability(shares, told):
    names = [f"b{k}" for k in range(len(shares))]
    rows = [row((name,), share) for name, share in zip(names, shares, strict=True)]
    assert told in said(finding("ambiguous", tied=[[name] for name in names], ranking=rows))


@pytest.mark.parametrize(("low", "told"), [(0.0, False), (None, True)])
def test_opposites_that_have_one_sign_each_are_not_the_same(low, told):
    x = torch.linspace(1, 3, 40, dtype=F64)
    base = tc.Simulator(lambda x, p: p["k"] / x, [tc.Parameter("k", low=0.0)])
    less = tc.Term("less", outputs={"y": lambda x, p, y: y + p["b"] / x**2}, parameters=[tc.Parameter("b", low=low)])
    more = tc.Term("more", outputs={"y": lambda x, p, y: y - p["d"] / x**2}, parameters=[tc.Parameter("d", low=low)])
    wobble = 0.01 * torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=F64)
    d = tc.diagnose(base, tc.Recording(x=x, y=1 / x + wobble, noise=0.01), [less, more], progress=False)
    assert any("less and more are nearly the same" in row for row in d.identifiability) is told


@pytest.mark.parametrize("size", [0.1, pytest.param(-0.1, marks=pytest.mark.slow)])
def test_what_may_not_have_the_sign_that_was_found_is_no_alias(size):
    x = torch.linspace(1, 3, 40, dtype=F64)
    base = tc.Simulator(lambda x, p: p["k"] / x, [tc.Parameter("k", low=0.0)])
    either = tc.Term("either", outputs={"y": lambda x, p, y: y + p["b"] / x**2}, parameters=[tc.Parameter("b")])
    less = tc.Term("less", outputs={"y": lambda x, p, y: y - p["d"] / x**2}, parameters=[tc.Parameter("d", low=0.0)])
    others = [
        tc.Term(f"power {n}", outputs={"y": lambda x, p, y, n=n: y + p["c"] * x**n}, parameters=[tc.Parameter("c")])
        for n in range(1, 8)
    ]
    wobble = 0.01 * torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=F64)
    data = tc.Recording(x=x, y=1 / x + size / x**2 + wobble, noise=0.01)
    d = tc.diagnose(base, data, [either, less, *others], progress=False)
    (row,) = [row for row in d.ranking if row.terms == ("either",) and row.region is None]
    assert row.aliases == (() if size > 0 else ("less",))
    assert ("less" in {name for terms in d.tied for name in terms}) is (size < 0)


def test_candidates_that_are_nearly_the_same_are_told_in_groups():
    x = torch.linspace(0, 1, 40, dtype=F64)
    base = tc.Simulator(lambda x, p: p["k"] + 0 * x, [tc.Parameter("k")])

    def bump(name, power, amplitude):
        return tc.Term(
            name, outputs={"y": lambda x, p, y: y + p[amplitude] * x**power}, parameters=[tc.Parameter(amplitude)]
        )

    candidates = [bump("two", 2.0, "a"), bump("nine", 9.0, "b"), bump("more", 2.2, "c"), bump("most", 2.4, "d")]
    wobble = 0.01 * torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=F64)
    d = tc.diagnose(base, tc.Recording(x=x, y=1 + 0.1 * x**2 + wobble, noise=0.01), candidates, progress=False)
    (row,) = [row for row in d.identifiability if "nearly the same" in row]
    assert row.startswith("two, more and most are nearly the same here (correlation from 0.99")


@pytest.mark.parametrize(
    ("rates", "told"),
    [((0.30, 0.31, 0.29), "is the same in every run: one constant change there removes 50 %"),
     ((0.30, 0.10, 0.29), "differs from run to run"), ((0.001, -0.002, 0.0), "differs from run to run")],
)  # fmt: skip
def test_one_change_for_all_runs_does_not_differ_from_run_to_run(rates, told):
    place = Location("equation", "w", "run", ((0.0, 2.0),), 0.5, 20.0)
    runs = torch.tensor([0.0, 0.0, 1.0, 1.0, 2.0], dtype=F64)
    rate = torch.tensor(rates, dtype=F64)[runs.long()]
    missing = MissingRate("equation", "w", "run", runs, rate, torch.full_like(rate, 0.01), None, runs, rate)
    text = where_in_words(finding("unexplained", where=[place], missing=missing))
    assert f"The mismatch sits in the equation w and {told}" in text
    assert ("What differs between the runs" in text) is ("differs" in told)
    assert "What differs" not in where_in_words(finding("ambiguous", tied=[["drag"]], where=[place], missing=missing))


def test_a_best_term_that_removes_nothing_is_not_told():
    rows = [row(("drag",), 0.1, misfit_removed=0.0), row(NONE, 0.9)]
    assert "The best of the library" not in said(finding("unexplained", ranking=rows))
    rows = [row(("drag",), 0.1, misfit_removed=0.5), row(NONE, 0.9)]
    assert "The best of the library, drag, removes 50 %" in said(finding("unexplained", ranking=rows))


def test_another_name_of_a_term_in_a_window_is_told_with_the_window():
    x = torch.linspace(0, 10, 80, dtype=F64)
    wobble = 0.05 * torch.randn(80, generator=torch.Generator().manual_seed(1), dtype=F64)
    base = tc.Simulator(lambda x, p: p["a"] * torch.exp(-p["k"] * x), [tc.Parameter("a", initial=1.0),
                                                                     tc.Parameter("k", initial=0.3)])  # fmt: skip
    y = 2 * torch.exp(-0.3 * x) + torch.where(x > 6, 0.1 * x, 0 * x) + wobble
    one, other = (
        tc.Term(name, outputs={"y": lambda x, p, y, b=b: y + p[b] * x}, parameters=[tc.Parameter(b)])
        for name, b in (("slope", "b"), ("drift", "d"))
    )
    d = tc.diagnose(base, tc.Recording(x=x, y=y, noise=0.05), [one, other], progress=False)
    assert ["slope"] in d.tied
    assert ["drift"] in d.tied
    regions = {r.terms[0]: (r.region, r.probability) for r in reversed(d.ranking) if r.region}
    assert regions["slope"] == regions["drift"]
    assert likeliest_with(d.ranking, ["drift"]).region == regions["drift"][0]
    assert d.ranking[0].terms == ("slope",)
    assert d.ranking[0].refitted
    assert f"drift where {regions['drift'][0]}" in " ".join(str(d).split())
    assert sum(r.probability for r in d.ranking) == pytest.approx(1.0)


def test_another_range_that_is_nearly_as_likely_is_told_beside_the_named_one():
    rows = [
        row(["saturation"], 0.45, region="T < 1796"),
        row(["saturation"], 0.38, region="tau < 11.8"),
        row(["saturation"], 0.02),
        row(["saturation"], 0.3, region="p > 3", physical=False),
        row(["offset"], 0.4, region="p > 2"),
    ]
    d = SimpleNamespace(ranking=rows, terms=["saturation"], settings={"region": "T < 1796"})
    assert called.with_region(d, "saturation") == "saturation, where T < 1796 (or, nearly as likely, tau < 11.8)"
    d.ranking = [rows[0], rows[2]]
    assert called.with_region(d, "saturation") == "saturation, where T < 1796"
    d.ranking = [rows[0], row(["saturation"], 0.2)]
    assert called.with_region(d, "saturation") == "saturation, where T < 1796 (or, nearly as likely, everywhere)"


def test_all_that_is_tied_is_printed_with_the_best():
    rows = [row([f"term {k}"], 0.1) for k in range(9)] + [row(["late"], 0.02, region="x > 2"), row(["late"], 0.01)]
    d = SimpleNamespace(ranking=rows, tied=[["term 0"], ["late"]])
    assert words.listed(d) == rows[:8] + rows[9:10]
    d.tied = []
    assert words.listed(d) == rows[:8]


def test_evidence_that_was_not_worked_out_is_no_number():
    unfitted = dataclasses.replace(row(["a"], 0.0), log_evidence=-math.inf)
    table = Table([unfitted], ("terms", "log_evidence", "probability"))
    assert str(table).splitlines()[1].split() == ["a", "-", "0"]


@pytest.mark.parametrize(("low", "verdict"), [(5.0, "ambiguous"), (4.05, "named")])
def test_a_shape_at_a_given_bound_along_which_the_size_is_open_is_no_name(low, verdict):
    x = torch.linspace(0.1, 4, 50, dtype=F64)
    noise = 0.03 * torch.randn(50, generator=torch.Generator().manual_seed(0), dtype=F64)
    base = tc.Simulator(lambda x, p: p["a"] + p["r"] * x, [tc.Parameter("a"), tc.Parameter("r")])
    term = tc.Term(
        "overpotential",
        outputs={"y": lambda x, p, y: y - p["b"] * torch.log1p(-x / p["il"])},
        parameters=[tc.Parameter("b", low=0.0), tc.Parameter("il", low=low, high=50.0)],
    )
    recording = tc.Recording(x=x, y=1.2 + 0.3 * x - 0.25 * torch.log1p(-x / 4.4) + noise, noise=0.03)
    d = tc.diagnose(base, recording, [term], seed=0, progress=False)
    assert d.verdict == verdict
    assert ("ends at a bound of overpotential.il" in d.settings["doubt"]) == (verdict == "ambiguous")


@pytest.mark.parametrize("reach", [1.0, 6.0])
def test_parameters_of_a_valley_are_said_to_be_hardly_known_apart(reach):
    """Early on a saturating rise tells its slope, and neither how high it ends nor how fast."""
    x = torch.linspace(0.05, reach, 40, dtype=torch.float64)
    base = tc.Simulator(
        lambda x, p: p["a"] * (1 - torch.exp(-p["k"] * x)), [tc.Parameter("a", low=0.0), tc.Parameter("k", low=0.0)]
    )
    noise = torch.randn(40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    recording = tc.Recording(x=x, y=2 * (1 - torch.exp(-x)) + 0.04 * noise, noise=0.04)
    d = tc.diagnose(base, recording, tc.terms.sensor(("y",), static=True), seed=0, progress=False)
    rows = [row for row in d.identifiability if "hardly known apart" in row]
    a, k = (100 * e.sd / e.value for e in d.base.estimates)
    told = f"a and k are hardly known apart (correlation of their estimates 0.993; sd of {a:.0f} %, {k:.0f} %)"
    assert rows == ([told] if reach == 1.0 else [])


@pytest.mark.parametrize(
    ("outputs", "told"), [({"T": "K"}, " K"), ({"T": None}, ""), ({"T": "K", "n": None}, " of each output's spread")]
)
def test_noise_and_errors_have_their_units(outputs, told):
    x = torch.linspace(0, 1, 12, dtype=F64)
    line = tc.Simulator(lambda x, p: {name: p["a"] * x for name in outputs}, [tc.Parameter("a")])
    y = {name: 2 * x + 0.2 * (-1.0) ** torch.arange(12) for name in outputs}
    units = {name: unit for name, unit in outputs.items() if unit}
    d = tc.diagnose(line, tc.Recording(x=x, y=y, noise=0.2, units=units), [], seed=0, progress=False)
    text = words.paragraph(d).replace("\n", " ")
    assert f"T 0.2{' K' if outputs['T'] else ''}{', n 0.2' if 'n' in outputs else ''}. The calibrated" in text
    assert f"an RMSE of {d.before.fitted.rmse:.4g}{told}; noise alone" in text
