"""What `diagnose` makes of data without noise, numbers of other packages, and simulators or terms that misbehave."""

import dataclasses
import math
import types
import warnings

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.fits.candidates import prepare
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses import base as base_of
from torchcal.discovery.verdicts import decision as decision_of
from torchcal.errors import ConvergenceWarning, DomainError, SimulatorError

F64 = torch.float64

X = torch.linspace(0.1, 2.0, 30, dtype=torch.float64)
AB = [tc.Parameter("a"), tc.Parameter("b")]
LINE = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, AB)


def noise(*shape, seed=1):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def term(name, function):
    return tc.Term(name, outputs={"y": function}, parameters=[tc.Parameter("q")])


def bend():
    return term("bend", lambda x, p, y: y + p["q"] * x**2)


# --- exact data ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [12, 30, 100])
@pytest.mark.parametrize("law", ["line", "constant", "rounding", "power"])
def test_exactly_fitted_data_leave_nothing_to_explain(law, count):
    x = torch.linspace(0.1, 2.0, count, dtype=torch.float64)
    rounded = 1 / 3 + x / 7 + 1e-12 * noise(count)
    y = {"line": 1 + 2 * x, "constant": 0 * x + 3, "rounding": rounded, "power": 2 * x**0.37}
    power = tc.Simulator(lambda x, p: p["a"] * x ** p["b"], [tc.Parameter("a", initial=1.0), tc.Parameter("b")])
    inverse = term("inverse", lambda x, p, y: y + p["q"] / x)
    d = tc.diagnose(
        power if law == "power" else LINE, tc.Recording(x=x, y=y[law]), [bend(), inverse], progress=False
    )
    assert (d.verdict, d.terms) == ("consistent", [])
    assert "nothing is missing" in str(d)


# --- numbers ---------------------------------------------------------------------------------------------


def test_integers_of_numpy_are_integers():
    data = tc.Recording(x=X, y=1 + 2 * X + 0.5 * X**2 + 0.05 * noise(30), noise=0.05)
    numbers = {"seed": np.int64(3), "max_terms": np.int64(2), "num_starts": np.uint8(5)}
    given, plain = (
        tc.diagnose(LINE, data, [bend()], progress=False, **{key: kind(value) for key, value in numbers.items()})
        for kind in (lambda v: v, int)
    )
    assert str(given) == str(plain)
    assert type(given.settings["seed"]) is int
    for key, value in (("seed", 1.5), ("seed", True), ("seed", "1"), ("max_terms", np.float64(2)), ("num_starts", 0)):
        with pytest.raises(DomainError, match=f"Expected {key}"):
            tc.diagnose(LINE, data, [bend()], progress=False, **{key: value})


# --- simulators and terms that misbehave -----------------------------------------------------------------


def pendulum(rate=lambda s, p: -p["k"] * s["x"]):
    body = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": rate(s, p)}, {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, initial=4.0)], observe=("x",),
    )  # fmt: skip
    t = torch.linspace(0, 3, 40, dtype=torch.float64)
    runs = [tc.Run(t, {"x": a * torch.cos(2 * t) + 0.01 * noise(40)}, initial={"x": a, "v": 0.0}) for a in (1.0, 2.0)]
    return body, tc.Recording(runs=runs, noise=0.01)


@pytest.mark.parametrize("candidates", [[], [bend()]])
def test_a_simulator_with_random_numbers_is_refused_as_that(candidates):
    def noisy(x, p):
        return p["a"] + p["b"] * x + 0.01 * torch.randn(x.shape, dtype=torch.float64)

    data = tc.Recording(x=X, y=1 + 2 * X, noise=0.05)
    with pytest.raises(SimulatorError, match=r"whenever the simulator is called.*output 'y' at x = .*random numbers"):
        tc.diagnose(tc.Simulator(noisy, AB), data, candidates, progress=False)


def test_random_rates_are_refused_too():
    body, motion = pendulum(lambda s, p: -p["k"] * s["x"] + 0.1 * torch.randn_like(s["x"]))
    with pytest.raises(SimulatorError, match=r"the simulator is called.*output 'x' at time = .*, run = [01]\."):
        tc.diagnose(body, motion, progress=False)


def test_a_term_with_random_numbers_is_told_from_the_simulator():
    shaky = term("shaky", lambda x, p, y: y + p["q"] + 0.01 * torch.randn_like(y))
    with pytest.raises(SimulatorError, match="whenever the simulator with the term 'shaky' is called"):
        tc.diagnose(LINE, tc.Recording(x=X, y=1 + 2 * X, noise=0.05), [shaky], progress=False)


@pytest.mark.parametrize(
    ("function", "got"),
    [
        (lambda x, p, y: y + p["q"] * torch.log(x - 0.1), "nan for 1 of 30 data, first output 'y' at x = 0.1 "),
        (lambda x, p, y: torch.where(x > 1.7, math.inf, y), "inf for 5 of 30 data, first output 'y' at x = 1.7"),
    ],
)
def test_a_term_without_finite_outputs_at_neutral_says_where(function, got):
    data = tc.Recording(x=X, y=1 + 2 * X + 0.05 * noise(30), noise=0.05)
    with pytest.raises(SimulatorError) as caught:
        tc.diagnose(LINE, data, [bend(), term("edge", function)], progress=False)
    assert "Expected finite outputs with the term 'edge' at its neutral values {'edge.q': 0.0}" in str(caught.value)
    assert f"Got {got}" in str(caught.value)


def test_a_rate_that_is_not_finite_is_told_with_its_run():
    body, motion = pendulum()
    push = {"equation": "v", "rate": lambda t, s, p, u: p["q"] / (s["x"].abs() < 1.5)}
    heavy = tc.Term("heavy", parameters=[tc.Parameter("q")], **push)
    with pytest.raises(SimulatorError, match=r"term 'heavy' at its neutral.*Got inf.*output 'x' at time = .*, run = 1"):
        tc.diagnose(body, motion, [heavy], progress=False)


def emptied():
    """A tank that would be empty before the end of its run at c = 3: a root of less than nothing."""
    t = torch.linspace(0, 3, 12, dtype=F64)
    tank = tc.ODESimulator(
        rates=lambda t, s, p, u: {"h": -p["c"] * torch.sqrt(s["h"])}, states={"h": "m"},
        parameters=[tc.Parameter("c", low=0.0, initial=0.1)],
    )  # fmt: skip
    data = tc.Recording(runs=[tc.Run(time=t, outputs={"h": (1 - 0.1 * t) ** 2}, initial={"h": 1.0})], noise=0.005)
    return Problem.of(tank, data)


def moved(found):
    return dataclasses.replace(found, values=torch.tensor([3.0], dtype=F64), warm=None)


FINITE = r"the base where its calibration ends, with c = 3\. Got inf for .* of 12 data, first output 'h' at time"


def test_a_base_that_is_not_finite_where_its_fit_ends_is_told():
    """A tank that runs empty, with a root of less than nothing: a fit ends at the edge of what is finite."""
    t = torch.linspace(0, 10, 60, dtype=F64)
    y = (1 - 0.14 * t).clamp_min(0) ** 2 + torch.as_tensor(0.005 * np.random.default_rng(0).standard_normal(60))
    tank = emptied().simulator.ode
    with pytest.raises(SimulatorError, match=r"base where its calibration ends, with c = .* Got inf for .* of 60 data"):
        tc.diagnose(tank, tc.Recording(runs=[tc.Run(time=t, outputs={"h": y})], noise=0.005), [], progress=False)


def test_no_term_is_blamed_for_what_the_base_alone_does():
    found, _ = base_of.calibrate_base(emptied(), {}, 2, 0)
    (offset,) = tc.terms.sensor(outputs=("h",))[:1]
    assert prepare(found.problem, found, [offset], {}).name == offset.name
    with pytest.raises(SimulatorError, match=FINITE):
        prepare(found.problem, moved(found), [offset], {})


def test_a_base_that_explains_nothing_is_told_of_where_noise_may_be_all_there_is():
    generator = torch.Generator().manual_seed(1)
    steps = torch.randn(120, generator=generator, dtype=F64)
    y = [steps[0]]
    for step in steps[1:]:
        y.append(0.9 * y[-1] + step)
    x, y = torch.linspace(0, 1, 120, dtype=F64), torch.stack(y)
    wave = tc.Simulator(lambda x, p: p["a"] * (2 + torch.sin(40 * x)), [tc.Parameter("a", low=3.0)])
    with pytest.warns(ConvergenceWarning, match="no more than a constant"):
        d = tc.diagnose(wave, tc.Recording(x=x, y=5 + y, noise=2.3), progress=False)
    assert "no more than a constant would: before anything is called missing, or nothing" in str(d)
    # A base that holds the constant explains as much, whatever slope slow noise gives it.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(4):
            slow = noise(120, seed=seed)
            for k in range(1, 120):
                slow[k] += 0.8 * slow[k - 1]
            d = tc.diagnose(LINE, tc.Recording(x=x, y=5 + 0.1 * slow), [bend()], progress=False)
            assert not d.settings["lost"]


def test_three_data_show_no_effect_of_any_size():
    x = torch.tensor([0.0, 1.0, 2.0], dtype=F64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")], degree=1)
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"] * x**2}, parameters=[tc.Parameter("q")])
    y = torch.tensor([1.0, 0.1, 3.0], dtype=F64)
    d = tc.diagnose(line, tc.Recording(x=x, y=y), [bend], progress=False)
    assert d.verdict == "consistent"
    assert math.isinf(d.detection_limit[0].smallest)
    assert "so few data" in d.detection_limit[0].note
    known = tc.diagnose(line, tc.Recording(x=x, y=y, noise=0.1), [bend], progress=False)
    assert math.isfinite(known.detection_limit[0].smallest)


def test_a_name_is_tied_once_wherever_it_acts(monkeypatch):
    monkeypatch.setattr(decision_of, "other_names", lambda search, model: [(1, "night loss", "deposition")])
    decision = decision_of.Decision()
    decision.tied = [["night loss"], ["deposition"]]
    model = types.SimpleNamespace(names=("deposition",), numbers=(0,), window=None)
    search = types.SimpleNamespace(merged={1: "its model"})
    decision_of.tie_other_names(search, model, decision)
    assert decision.tied == [["night loss"], ["deposition"]]
    decision.tied = [["deposition"]]
    decision_of.tie_other_names(search, model, decision)
    assert decision.tied == [["deposition"], ["night loss"]]


def test_where_a_name_acts_is_told_though_an_unknown_change_may_be_elsewhere():
    """Storage in a well acts at first; the base makes up for it, so that it may as well be something later."""

    def theis(x, p):
        """With the well function of Swamee & Ohija (2003, J. Irrig. Drain. Eng. 129, 70-76)."""
        u = p["S"] * x["r"] ** 2 / (4 * p["T"] * x["t"])
        early = (torch.log((0.56146 / u + 0.65).clamp_min(1.0001)) * (1 + u)) ** -7.7
        return {"s": 20 / (4 * math.pi * p["T"]) * (early + u**4 * torch.exp(7.7 * u) * (2 + u) ** 3.7) ** -0.13}

    t, r = np.meshgrid(np.geomspace(0.05, 72, 16), [10.0, 30.0, 90.0], indexing="ij")
    x = {"t": torch.tensor(t.ravel()), "r": torch.tensor(r.ravel())}
    y = theis(x, {"T": 6.0, "S": 8e-4})["s"] * (1 - 0.4 * torch.exp(-x["t"] / 0.5))
    y += 0.01 * torch.tensor(np.random.default_rng(5).standard_normal(48))
    well = tc.Simulator(
        theis,
        [tc.Parameter("T", low=0.5, high=50, initial=5.0), tc.Parameter("S", low=1e-5, high=2e-3, initial=1e-3)],
    )
    storage = tc.Term(
        "storage",
        outputs={"s": lambda x, p, y: y * (1 - p["on"] * torch.exp(-x["t"] / p["tw"]))},
        parameters=[tc.Parameter("on", low=0.0, high=1.0), tc.Parameter("tw", low=0.05, high=5.0)],
    )
    d = tc.diagnose(well, tc.Recording(x=x, y={"s": y}), [storage], progress=False)
    assert d.terms == ["storage"], str(d)
    first = d.where[0]
    assert (first.kind, first.target, first.driver) == ("output", "s", "t")
    assert first.spans[-1][1] < 2, d.where
    later = next(place for place in d.where[1:] if (place.kind, place.target, place.driver) == ("output", "s", "t"))
    assert later.spans[-1][1] > 50  # what an unknown change tells is told as well
