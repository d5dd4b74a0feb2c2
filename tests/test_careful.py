"""Functions of users that change in place what they are given: told at the first call, and nothing is altered."""

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.errors import SimulatorError
from torchcal.simulators import Trajectories
from torchcal.terms import Term, extend

X = torch.linspace(-1.0, 1.0, 11, dtype=torch.float64)
AB = [tc.Parameter("a"), tc.Parameter("b")]


def clamps(x, p):
    return p["a"] + p["b"] * x.clamp_(min=-0.5)


def subtracts(x, p):
    x -= x.mean()
    return p["a"] + p["b"] * x


def clamps_nothing(x, p):
    return p["a"] + p["b"] * x.clamp_(min=-5.0)


def works_on_an_array(x, p):
    values = x.numpy()
    values *= 2
    return p["a"] + p["b"] * x


def clamps_a_parameter(x, p):
    p["b"].clamp_(min=0.0)
    return p["a"] + p["b"] * x


@pytest.mark.parametrize(
    ("function", "changed"),
    [
        (clamps, "x"),
        (subtracts, "x"),
        (clamps_nothing, "x"),
        (works_on_an_array, "x"),
        (clamps_a_parameter, r"p\['b'\]"),
    ],
)
def test_a_simulator_that_works_in_place_is_refused_and_the_recording_kept(function, changed):
    recording = tc.Recording(x=X + 0.25, y=1 + 2 * X)
    with pytest.raises(SimulatorError, match=rf"Got {changed} changed in place.*\.clone\(\)"):
        tc.calibrate(tc.Simulator(function, AB), recording, num_samples=0, progress=False)
    assert torch.equal(recording.x, X + 0.25)


def test_the_condition_that_was_changed_is_named():
    def function(x, p):
        x["T"] /= 1000
        return p["a"] + p["b"] * x["T"] + x["q"]

    recording = tc.Recording(x={"T": 300 + X, "q": X}, y=1 + 2 * X)
    with pytest.raises(SimulatorError, match=r"Got x\['T'\] changed in place"):
        tc.calibrate(tc.Simulator(function, AB), recording, num_samples=0, progress=False)
    assert torch.equal(recording.x["T"], 300 + X)


def test_what_a_function_puts_into_a_dict_is_its_own():
    def function(x, p):
        x["T"] = x["T"] / 1000
        p["b"] = 2 * p["b"]
        return p["a"] + p["b"] * x["T"]

    given = {"T": 1000 * X}
    evaluate = tc.Simulator(function, AB).at(given)
    values = torch.tensor([1.0, 3.0], dtype=torch.float64)
    for _ in range(3):
        torch.testing.assert_close(evaluate(values), 1 + 6 * X)
    assert torch.equal(given["T"], 1000 * X)


TIME = np.linspace(0.0, 2.0, 9)
DRIVEN = tc.Recording(
    runs=[tc.Run(time=TIME, outputs={"c": np.exp(-TIME)}, inputs={"T": 1 + 0 * TIME}, initial={"c": 1.0})]
)


def decay(t, s, p, u):
    return {"c": -p["k"] * s["c"] * u["T"]}


def bound(rates=decay, **options):
    return tc.ODESimulator(rates, ["c"], [tc.Parameter("k", initial=1.0)], **options).bind(DRIVEN)


def solved(simulator: Trajectories) -> torch.Tensor:
    return simulator.at(DRIVEN.x)(torch.ones(1, len(simulator.names), dtype=torch.float64))[0]


@pytest.mark.parametrize(("letter", "name"), [("s", "c"), ("p", "k"), ("u", "T")])
def test_rates_and_outputs_that_work_in_place_are_refused(letter, name):
    def clamped(t, s, p, u):
        {"s": s, "p": p, "u": u}[letter][name].clamp_(min=0.0)
        return s["c"]

    changed = rf"Got {letter}\['{name}'\] changed in place"
    with pytest.raises(SimulatorError, match=rf"Expected rates\(t, s, p, u\) to leave.*{changed}"):
        solved(bound(lambda t, s, p, u: {"c": -clamped(t, s, p, u)}))
    with pytest.raises(SimulatorError, match=rf"the function of the output 'c' to leave.*{changed}"):
        solved(bound(observe={"c": clamped}))


def test_rates_and_outputs_may_put_into_their_dicts():
    def rates(t, s, p, u):
        s["c"], p["k"], u["T"] = 2 * s["c"], 0.5 * p["k"], 3 * u["T"]
        return {"c": -p["k"] * s["c"] * u["T"] / 3}

    def seen(t, s, p, u):
        s["c"], u["T"] = s["c"] * u["T"], 2 * u["T"]
        return s["c"]

    simulator = bound(rates, observe={"c": seen, "d": lambda t, s, p, u: s["c"] * u["T"]})
    for _ in range(2):
        torch.testing.assert_close(solved(simulator), solved(bound()))


def test_an_initial_value_that_works_in_place_is_refused():
    recording = tc.Recording(runs=[tc.Run(time=TIME, outputs={"c": np.exp(-TIME)}, initial={"c": 1.0})])
    ode = tc.ODESimulator(
        lambda t, s, p, u: {"c": -p["k"] * s["c"], "d": 0 * s["d"]},
        ["c", "d"],
        [tc.Parameter("k", initial=1.0)],
        observe=("c",),
        initial={"d": lambda s, p: s["c"].mul_(2.0)},
    )
    with pytest.raises(SimulatorError, match=r"the initial value of 'd' to leave.*Got s\['c'\] changed in place"):
        ode.bind(recording).at(recording.x)(torch.ones(1, 1, dtype=torch.float64))


@pytest.mark.parametrize(
    ("acts", "changed"),
    [
        ({"equation": "c", "rate": lambda t, s, p, u: p["g"] * s["c"].clamp_(min=0.0)}, r"s\['c'\]"),
        ({"shifts": {"k": lambda t, s, p, u: p["g"] * u["T"].sub_(1.0)}}, r"u\['T'\]"),
        ({"outputs": {"c": lambda t, s, p, u, y: y.add_(p["g"])}}, "y"),
    ],
)
def test_a_term_that_works_in_place_is_refused(acts, changed):
    term = Term("leak", parameters=[tc.Parameter("g")], **acts)
    with pytest.raises(SimulatorError, match=rf"Expected the term 'leak' to leave.*Got {changed} changed in place"):
        solved(extend(bound(), [term]))


def test_a_term_of_a_static_simulator_that_works_in_place_is_refused():
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, AB)
    term = Term("shift", parameters=[tc.Parameter("g")], shifts={"a": lambda x, p: p["g"] * x.abs_()})
    with pytest.raises(SimulatorError, match=r"Expected the term 'shift' to leave.*Got x changed in place"):
        extend(line, [term]).at(X)(torch.ones(3, dtype=torch.float64))


def test_terms_may_put_into_their_dicts():
    def scaled(t, s, p, u):
        s["c"], u["T"], p["g"] = 2 * s["c"], 5 * u["T"], 0 * p["g"]
        return p["g"] * s["c"]

    terms = [Term(name, parameters=[tc.Parameter("g")], equation="c", rate=scaled) for name in ("one", "two")]
    torch.testing.assert_close(solved(extend(bound(), terms)), solved(bound()))


def test_a_first_call_in_a_transform_shows_nothing_and_counts_for_none():
    def doubles(x, p):
        return p["b"].mul_(2) * x

    simulator = tc.Simulator(doubles, [tc.Parameter("b")])
    x = torch.linspace(0, 1, 5, dtype=torch.float64)
    evaluate = simulator.at(x, ("y",))
    torch.func.vmap(evaluate)(torch.tensor([[1.0], [2.0]], dtype=torch.float64))
    with pytest.raises(SimulatorError, match=r"p\['b'\] changed in place"):
        evaluate(torch.tensor([[1.0], [-1.0]], dtype=torch.float64))


def test_conditions_may_be_arrays():
    simulator = tc.Simulator(lambda x, p: p["b"] * x, [tc.Parameter("b")])
    found = simulator.at(np.linspace(0, 1, 5), ("y",))(torch.tensor([2.0], dtype=torch.float64))
    assert found.tolist() == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0])
