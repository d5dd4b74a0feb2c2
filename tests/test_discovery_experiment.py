"""Experiments that are proposed where hypotheses are tied: which there are, and when more samples are asked for."""

import dataclasses
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.findings import conditions, experiment
from torchcal.discovery.findings.feasible import Feasible
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.fits.problem import Problem
from torchcal.simulators import Trajectories

F64 = torch.float64


@pytest.mark.parametrize("hold", ["linear", "zero"])
def test_denser_samples_lie_between_the_others_and_inputs_hold_as_they_did(hold):
    t = torch.tensor([0.0, 1.0, 3.0], dtype=F64)
    u = torch.tensor([1.0, 3.0, 5.0], dtype=F64)
    run = tc.Run(time=t, outputs={"x": torch.zeros(3, dtype=F64)}, inputs={"f": u}, hold=hold)
    proposed = ("a run", tc.Recording(runs=[run]), {"time": t, "initial": {"x": 2.0}, "inputs": {"f": u}})
    text, recording, dense = conditions.denser(proposed, tc.Recording(runs=[run]), 4)
    assert text == "a run, sampled 4 times as densely"
    wanted = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0], dtype=F64)
    assert torch.equal(dense["time"], wanted)
    assert recording.runs[0].initial == {"x": 2.0}
    between = [1.5, 2.0, 2.5] if hold == "linear" else [1.0, 1.0, 1.0]
    assert dense["inputs"]["f"][1:4].tolist() == between
    assert torch.equal(dense["inputs"]["f"][::4], u)


def test_static_options_keep_to_what_they_say_and_to_positive_conditions():
    x = {"dose": torch.logspace(-2, 2, 30, dtype=F64), "shift": torch.linspace(-1, 1, 30, dtype=F64)}
    options = conditions._static(tc.Recording(x=x, y=torch.zeros(30, dtype=F64)), conditions.ANYWHERE)
    texts = [text for text, _, _ in options]
    assert texts[0] == "the same conditions again"
    assert len(texts) == len(set(texts)) == 11
    for text, recording, chosen in options:
        assert recording.n == 30
        assert bool((chosen["x"]["dose"] > 0).all())
        if "dose above" in text:
            assert float(chosen["x"]["dose"].min()) == pytest.approx(100.0)
        if "dose below" in text:
            assert float(chosen["x"]["dose"].max()) == pytest.approx(0.01)
        if "shift below" in text:
            assert float(chosen["x"]["shift"].min()) == pytest.approx(-2.0)


def test_noise_of_new_data_is_that_of_the_nearest_recorded_ones():
    f = torch.logspace(0, 4, 5, dtype=F64)
    sd = torch.tensor([100.0, 10.0, 1.0, 0.1, 0.01], dtype=F64)
    static = tc.Recording(x={"f": f, "T": 300.0 + 0 * f}, y=0 * f, noise=sd)
    new = tc.Recording(x={"f": [0.1, 5.0, 900.0, 2e5], "T": [300.0, 310.0, 290.0, 300.0]}, y=[0.0] * 4)
    problem = Problem.of(tc.Simulator(lambda x, p: p["a"] + 0 * x["f"], [tc.Parameter("a")]), static)
    noise = SimpleNamespace(sd=sd)
    found = experiment._sd_there(SimpleNamespace(problem=problem, y=0 * f), new, torch.zeros(4, dtype=F64), noise)
    assert found.tolist() == [100.0, 10.0, 0.1, 0.01]
    even = experiment._sd_there(SimpleNamespace(problem=problem, y=0 * f), new, 0 * f, SimpleNamespace(sd=0 * sd + 2))
    assert even.tolist() == [2.0] * 4
    far = tc.Recording(x={"f": f.sort().values[[0, 0]], "T": [300.0, 300.0]}, y=[0.0] * 2)
    twice = tc.Recording(x={"f": f[[0, 0, 1]], "T": [300.0] * 3}, y=[0.0] * 3, noise=[3.0, 4.0, 9.0])
    two = SimpleNamespace(problem=Problem.of(problem.simulator, twice), y=torch.zeros(3, dtype=F64))
    noise = SimpleNamespace(sd=torch.tensor([3.0, 4.0, 9.0], dtype=F64))
    there = experiment._sd_there(two, far, torch.zeros(2, dtype=F64), noise)
    assert there.tolist() == pytest.approx([math.sqrt(12.5)] * 2)  # of replicates with several


@pytest.mark.parametrize("first", [0, 1])
def test_noise_of_a_new_run_is_that_of_data_of_like_values(first):
    decay = tc.ODESimulator(lambda t, s, p, u: {"x": -p["k"] * s["x"]}, {"x": "m"}, [tc.Parameter("k", initial=1.0)])
    t = torch.linspace(0, 4, 41, dtype=F64)
    y = torch.exp(-t)
    runs = [tc.Run(time=t, outputs={"x": y}, initial={"x": 1.0})] * 2
    sd = torch.cat([y, 3 * y]) if first else torch.cat([3 * y, y])
    problem = Problem.of(decay, tc.Recording(runs=runs))
    new = tc.Recording(runs=[tc.Run(time=[0.0, 9.0], outputs={"x": [0.5, 0.0]}, initial={"x": 0.5})])
    found = SimpleNamespace(problem=problem, y=torch.cat([y, y]))
    there = experiment._sd_there(found, new, torch.tensor([0.5, 0.0], dtype=F64), SimpleNamespace(sd=sd))
    mean = math.sqrt(5.0)  # of both runs
    assert there.tolist() == pytest.approx([0.5 * mean, float(y[-2]) * mean], rel=0.2)


def rivals():
    """Base, recording and terms: an offset, and a signal in proportion to a small dose, apart only far below the doses
    recorded."""
    base = tc.Simulator(
        lambda x, p: p["top"] * x["dose"] / (1.0 + x["dose"]),
        parameters=[tc.Parameter("top", low=0.1, high=5.0)],
    )
    offset = tc.Term("offset", outputs={"y": lambda x, p, y: y + p["b"]}, parameters=[tc.Parameter("b")])
    steep = tc.Term(
        "steep onset",
        outputs={"y": lambda x, p, y: y + p["b"] * x["dose"] / (0.02 + x["dose"])},
        parameters=[tc.Parameter("b")],
    )
    g = torch.Generator().manual_seed(4)
    dose = torch.logspace(-0.7, 2, 60, dtype=F64)
    y = 2 * dose / (1 + dose) + 0.1 + 0.02 * torch.randn(60, generator=g, dtype=F64)
    return base, tc.Recording(x={"dose": dose}, y=y, noise=0.02), [offset, steep]


def test_the_condition_at_which_the_models_differ_is_proposed_and_more_samples_where_they_hardly_do():
    d = tc.diagnose(*rivals(), seed=0, progress=False)
    assert d.verdict == "ambiguous"
    assert "dose below" in d.experiment.description
    assert ("each 4 times" in d.experiment.description) == (len(d.experiment.conditions["x"]["dose"]) == 240)
    assert d.experiment.separation > 0


@pytest.mark.parametrize(("height", "bearable"), [(1.0, True), (0.5, False)])
def test_an_experiment_that_a_model_does_not_bear_is_none(height, bearable):
    """A body that falls into an attracting centre at t = 1.11 from 1.0, and at 0.39 from 0.5."""
    fall = tc.ODESimulator(
        rates=lambda t, s, p, u: {"r": s["v"], "v": -p["mu"] / s["r"] ** 2},
        states={"r": "m", "v": "m/s"},
        parameters=[tc.Parameter("mu", low=0.1, initial=1.0)],
        observe=("r",),
    )
    t = torch.linspace(0, 0.9, 10, dtype=F64)

    def runs(start):
        return tc.Recording(runs=[tc.Run(time=t, outputs={"r": torch.ones_like(t)}, initial={"r": start, "v": 0.0})])

    bound = Trajectories(fall, runs(1.0))
    model = SimpleNamespace(
        found=SimpleNamespace(problem=SimpleNamespace(simulator=bound), values=torch.ones(1, dtype=F64))
    )
    noise = SimpleNamespace(sd=torch.full((10,), 0.01, dtype=F64))
    assert experiment._bearable([model], runs(height), noise) == bearable


def models_of(names: str) -> tuple[list[SimpleNamespace], tc.Recording]:
    recording = tc.Recording(x={"x": torch.linspace(-1, 1, 9, dtype=F64)}, y=torch.zeros(9, dtype=F64))
    problem = SimpleNamespace(in_time=False, recording=recording, simulator=None)
    found = SimpleNamespace(problem=problem)
    models = [
        SimpleNamespace(names=(name,), content=frozenset(name), where=None, window=None, found=found) for name in names
    ]
    return models, recording


def test_pairs_that_nothing_tells_apart_are_left_aside_and_said(monkeypatch):
    """Of three models two are alike: 0.6 sd, and 1.9 with more samples. The third is told from both."""
    models, _ = models_of("abc")
    monkeypatch.setattr(
        experiment, "_separations", lambda pairs, new, noise: [0.6, 19.0, 18.0] if new.n == 9 else [1.9, 99.0, 98.0]
    )
    found = experiment.propose(models, SimpleNamespace())
    assert found.separation == 18.0
    assert found.untold == [("a", "b")]
    monkeypatch.setattr(experiment, "_separations", lambda pairs, new, noise: [0.1, 0.2, 0.3])
    assert experiment.propose(models, SimpleNamespace()) is None


@pytest.mark.parametrize(
    ("distances", "wanted"),
    [
        ([1.0, 30.0, 900.0], "to 2"),  # far enough: the milder one
        ([1.0, 8.0, 15.0], "to -2"),  # the one that tells most
        ([3.5, 1.0, 1.0], "again, each 4 times"),
        ([1.2, 1.0, 1.0], "again, each 16 times"),
    ],
)
def test_the_mildest_experiment_that_tells_plenty_is_proposed_and_no_more_samples_than_it_takes(
    monkeypatch, distances, wanted
):
    models, recording = models_of("ab")
    first, above, below = distances

    def separations(pairs, new, noise):
        x = new.x["x"]
        again = torch.equal(x.unique(), recording.x["x"])
        plain = first if again else above if x.max() > 1 else below if x.min() < -1 else 0.0
        return [plain * (new.n / 9) ** 0.5]

    monkeypatch.setattr(experiment, "_separations", separations)
    found = experiment.propose(models, SimpleNamespace())
    assert found.description.endswith(wanted)


def test_a_solution_that_blows_up_is_not_bearable():
    growth = tc.ODESimulator(
        rates=lambda t, s, p, u: {"r": p["a"] * s["r"] ** 2},
        states={"r": "m"},
        parameters=[tc.Parameter("a", low=0.1, initial=1.0)],
        observe=("r",),
    )
    t = torch.linspace(0, 1.02, 10, dtype=F64)
    blank = tc.Recording(runs=[tc.Run(time=t, outputs={"r": torch.ones_like(t)}, initial={"r": 1.0})])
    model = SimpleNamespace(
        found=SimpleNamespace(
            problem=SimpleNamespace(simulator=Trajectories(growth, blank)), values=torch.ones(1, dtype=F64)
        )
    )
    noise = SimpleNamespace(sd=torch.full((10,), 0.01, dtype=F64))
    assert not experiment._bearable([model], blank, noise)


def drifting(y: torch.Tensor) -> SimpleNamespace:
    """A model of a constant, and its problem."""
    ode = tc.ODESimulator(
        lambda t, s, p, u: {"x": 0 * s["x"] + p["a"]}, {"x": "K"}, [tc.Parameter("a", initial=0.0)], observe=("x",)
    )
    t = torch.arange(len(y), dtype=F64)
    problem = Problem.of(ode, tc.Recording(runs=[tc.Run(time=t, outputs={"x": y}, initial={"x": 0.0})]))
    return SimpleNamespace(found=SimpleNamespace(problem=problem))


def test_more_samples_of_slow_noise_tell_hardly_more():
    found = drifting(torch.arange(50, dtype=F64)).found
    noise = SimpleNamespace(sd=torch.ones(50, dtype=F64), correlation=torch.tensor([0.9], dtype=F64))
    told = []
    for times in (1, 4, 16):
        t = torch.arange(49 * times + 1, dtype=F64) / times
        blank = tc.Recording(runs=[tc.Run(time=t, outputs={"x": torch.zeros_like(t)}, initial={"x": 0.0})])
        white = experiment._whitening(found, blank, torch.zeros_like(t), noise)
        told.append(float(white.vector(torch.ones_like(t)).norm()))
    assert told[2] < 1.05 * told[0]


def test_an_output_that_was_zero_may_move_but_not_explode():
    model = drifting(torch.zeros(50, dtype=F64))
    noise = SimpleNamespace(sd=torch.full((50,), 0.1, dtype=F64))
    assert not experiment._explodes(model, torch.full((50,), 1.0, dtype=F64), noise)
    assert experiment._explodes(model, torch.full((50,), 1e6, dtype=F64), noise)


def driven(begin: dict[str, float]) -> SimpleNamespace:
    """Fit of a spring that a force drives, from known initial states."""
    ode = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": u["f"] - p["k"] * s["x"]},
        {"x": "m", "v": "m/s"},
        [tc.Parameter("k", initial=4.0)],
        observe=("x",),
    )
    t = torch.linspace(0, 6, 40, dtype=F64)
    force = 1.0 + 0.5 * torch.sin(t)
    run = tc.Run(time=t, outputs={"x": torch.zeros_like(t)}, inputs={"f": force}, initial=begin)
    problem = Problem.of(ode, tc.Recording(runs=[run]))
    return SimpleNamespace(problem=problem, values=torch.tensor([4.0], dtype=F64), warm=None)


def test_bolder_runs_are_what_their_texts_say():
    model = driven({"x": 0.5, "v": 0.0})
    first = model.problem.recording.runs[0]
    options = {text: chosen for text, _, chosen in conditions.bolder(model)}
    assert len(options) == len(conditions.bolder(model))
    far = options["a run that starts from 5 times the initial states of the first"]
    assert far["initial"] == {"x": 2.5, "v": 0.0}
    assert torch.equal(far["inputs"]["f"], first.inputs["f"])
    both = options["a run with 5 times the inputs and initial states of the first"]
    assert both["initial"] == far["initial"]
    assert torch.equal(both["inputs"]["f"], 5 * first.inputs["f"])
    assert options["a run that starts from 3 times the initial x of the first, all else as there"]["initial"] == {
        "x": 1.5, "v": 0.0,
    }  # fmt: skip
    (moved,) = [chosen for text, chosen in options.items() if "starts from v = " in text]
    assert moved["initial"]["x"] == 0.5
    assert abs(moved["initial"]["v"]) > 0.1
    steady = options["a run with the inputs held at their largest"]
    assert steady["inputs"]["f"].unique().tolist() == [float(first.inputs["f"].max())]
    slow = options["a run with the inputs of the first twice as slowly"]
    assert float(slow["time"][-1]) == pytest.approx(12.0)
    assert torch.equal(slow["inputs"]["f"], first.inputs["f"])


def test_a_multiple_of_an_initial_state_that_was_calibrated_has_to_be_known_from_elsewhere():
    model = driven({"x": 0.5})
    model.values = torch.cat([model.values, torch.tensor([0.3], dtype=F64)])
    texts = [text for text, _, _ in (*conditions.simple(model), *conditions.bolder(model))]
    multiples = [text for text in texts if "times the initial" in text or "inputs and initial states" in text]
    assert len(multiples) > 8
    assert all(text.endswith(", with initial v known from elsewhere") for text in multiples)


def test_milder_multiples_are_tried_first():
    # Where twice the initial states is more than a model bears (a pendulum's past the top) half as much more may do.
    chosen = {text: conditions for text, _, conditions in conditions.simple(driven({"x": 0.5, "v": 0.0}))}
    milder = chosen["a run that starts from 1.5 times the initial states of the first"]
    assert milder["initial"] == {"x": 0.75, "v": 0.0}
    texts = [text for text in chosen if "times the initial states of the first" in text]
    assert texts.index(texts[0].replace("1.5", "2")) > texts.index(texts[0])


def test_multiples_of_a_state_of_rest_are_no_experiments():
    model = driven({"x": 0.0, "v": 0.0})
    texts = [text for text, _, _ in (*conditions.simple(model), *conditions.bolder(model))]
    assert not [text for text in texts if "times the initial" in text or "initial states" in text]
    assert "a run with 2 times the inputs of the first" in texts


def test_bolder_conditions_go_further_and_two_move_together_without_going_together():
    x = {"dose": torch.logspace(-2, 2, 30, dtype=F64), "shift": torch.linspace(-1, 1, 30, dtype=F64)}
    options = conditions._static_bolder(tc.Recording(x=x, y=torch.zeros(30, dtype=F64)), conditions.ANYWHERE)
    assert len({text for text, _, _ in options}) == len(options) == 8
    (far,) = [chosen["x"] for text, _, chosen in options if text.startswith("conditions with shift above")]
    assert float(far["shift"].max()) == pytest.approx(4.0)
    (corner,) = [chosen["x"] for text, _, chosen in options if "dose below" in text and "shift above" in text]
    assert bool((corner["dose"] > 0).all())
    assert float(corner["dose"].max()) == pytest.approx(0.01)
    assert float(corner["shift"].min()) == pytest.approx(1.0)
    assert float(corner["shift"].max()) == pytest.approx(2.0)
    assert abs(float(torch.corrcoef(torch.stack([corner["dose"], corner["shift"]]))[0, 1])) < 0.2


def test_bolder_experiments_are_tried_where_no_simple_one_tells_enough(monkeypatch):
    models, _ = models_of("ab")
    tried = []

    def separations(pairs, new, noise):
        far = float(new.x["x"].max())
        tried.append(far)
        return [9.0 if far > 3 else simple]

    monkeypatch.setattr(experiment, "_separations", separations)
    simple = 7.0
    assert experiment.propose(models, SimpleNamespace()).separation == 7.0
    assert max(tried) < 3
    simple = 3.0
    found = experiment.propose(models, SimpleNamespace())
    assert (found.separation, found.description) == (9.0, "conditions with x above the recorded range, to 4")


def test_a_temperature_is_multiplied_by_its_rise_and_not_from_absolute_zero():
    ode = tc.ODESimulator(
        lambda t, s, p, u: {"T": p["k"] * (u["Ta"] - s["T"]) + s["c"], "c": -s["c"]},
        {"T": "K", "c": "mol/L"}, [tc.Parameter("k", initial=0.5)], observe=("T",),
    )  # fmt: skip
    t = torch.linspace(0, 20, 60, dtype=F64)
    outside = 290.0 + 3.0 * torch.sin(t)
    run = tc.Run(time=t, outputs={"T": 0 * t}, inputs={"Ta": outside}, initial={"T": 350.0, "c": 2.0})
    problem = Problem.of(ode, tc.Recording(runs=[run], units={"Ta": "K"}))
    model = SimpleNamespace(problem=problem, values=torch.tensor([0.5], dtype=F64), warm=None)
    options = [*conditions.simple(model), *conditions.bolder(model)]
    chosen = {text: conditions for text, _, conditions in options}
    lowest = min(float(one["inputs"]["Ta"].min()) for one in chosen.values())
    assert lowest > 260.0
    (twice,) = [text for text in chosen if text.startswith("a run that starts from 2 times the initial states of the")]
    told = float(re.search(r"\(T counted from ([\d.]+)\)", twice)[1])
    assert 285.0 < told < 295.0
    assert chosen[twice]["initial"]["T"] == pytest.approx(2 * 350.0 - told, abs=0.1)
    assert chosen[twice]["initial"]["c"] == 4.0
    counted = f"(Ta counted from {float(outside.min()):.4g})"
    assert any(f"2 times the inputs of the first {counted}" in text for text in chosen)


def test_temperatures_are_counted_from_the_lowest_in_any_run_and_faded_differences_from_nothing():
    ode = tc.ODESimulator(
        lambda t, s, p, u: {"dT": p["k"] * (u["Ta"] - 290) - s["dT"]}, {"dT": "K"}, [tc.Parameter("k", initial=0.5)]
    )
    t = torch.linspace(0, 20, 60, dtype=F64)
    runs = [tc.Run(time=t, outputs={"dT": 0 * t}, inputs={"Ta": 0 * t + outside}, initial={"dT": 20.0})
            for outside in (320.0, 290.0)]  # fmt: skip
    problem = Problem.of(ode, tc.Recording(runs=runs, units={"Ta": "K"}))
    model = SimpleNamespace(problem=problem, values=torch.tensor([0.0], dtype=F64), warm=None)
    options = {text: chosen for text, _, chosen in conditions.simple(model)}
    doubled = options["a run with 2 times the inputs of the first (Ta counted from 290)"]
    assert doubled["inputs"]["Ta"].unique().tolist() == [350.0]
    assert options["a run that starts from 2 times the initial states of the first"]["initial"] == {"dT": 40.0}


def test_a_constant_temperature_outside_is_no_input_to_multiply():
    ode = tc.ODESimulator(
        lambda t, s, p, u: {"T": p["k"] * (u["Ta"] - s["T"])}, {"T": "degC"}, [tc.Parameter("k", initial=0.5)]
    )
    t = torch.linspace(0, 20, 60, dtype=F64)
    run = tc.Run(time=t, outputs={"T": 0 * t}, inputs={"Ta": 0 * t + 20.0}, initial={"T": 20.0})
    problem = Problem.of(ode, tc.Recording(runs=[run], units={"Ta": "degC"}))
    model = SimpleNamespace(problem=problem, values=torch.tensor([0.5], dtype=F64), warm=None)
    texts = [text for text, _, _ in (*conditions.simple(model), *conditions.bolder(model))]
    assert "the first run again" in texts
    assert not [text for text in texts if "times the in" in text]


def test_what_each_run_has_for_itself_is_unknown_in_a_new_one():
    """Models that differ in the zero of every run's instrument alone are told apart by no run, which has another."""
    ode = tc.ODESimulator(
        lambda t, s, p, u: {"x": -p["k"] * s["x"]},
        {"x": "V"},
        [tc.Parameter("zero", per_run=True, initial=0.0), tc.Parameter("k", initial=0.4)],
        observe={"y": lambda t, s, p, u: s["x"] + p["zero"]},
    )
    t = torch.linspace(0, 5, 20, dtype=F64)
    rows = [2 * torch.exp(-0.5 * t) + zero for zero in (0.1, -0.2)]
    problem = Problem.of(ode, tc.Recording(runs=[tc.Run(time=t, outputs={"y": y}, initial={"x": 2.0}) for y in rows]))
    white = problem.whitening(torch.full((40,), 0.01, dtype=F64), torch.zeros(1, dtype=F64))
    found = fit(problem, white, torch.tensor([[0.0, 0.0, 0.4]], dtype=F64), [0, 1, 2])
    assert found.values.tolist() == pytest.approx([0.1, -0.2, 0.5])
    blank = tc.Recording(runs=[tc.Run(time=t, outputs={"y": torch.zeros_like(t)}, initial={"x": 2.0})])
    y, slopes = experiment._predict(found, blank)
    assert y.tolist() == pytest.approx((2 * torch.exp(-0.5 * t) - 0.05).tolist(), rel=1e-6)
    assert slopes[:, :2].abs().max() == 0.0
    assert slopes[:, 2].tolist() == pytest.approx((-2 * t * torch.exp(-0.5 * t)).tolist(), abs=1e-5)
    assert slopes[:, 3].tolist() == pytest.approx([1.0] * 20)
    noise = SimpleNamespace(sd=torch.full((40,), 0.01, dtype=F64), correlation=torch.zeros(1, dtype=F64))
    other = dataclasses.replace(found, values=found.values + torch.tensor([5.0, 3.0, 0.0], dtype=F64))
    models = [dataclasses.make_dataclass("Rival", ["found"], eq=False)(one) for one in (found, other)]
    (same,) = experiment._separations([tuple(models)], blank, noise)
    assert same < 1e-6
    known = dataclasses.replace(found, free=[2], jacobian=found.jacobian[:, 2:])
    assert experiment._predict(known, blank)[1].shape == (20, 1)


# --- what can be done ----------------------------------------------------------------------------------------------


def test_static_experiments_stay_within_what_is_feasible_and_go_up_to_its_ends():
    x = {"T": torch.linspace(290, 320, 30, dtype=F64), "dose": torch.linspace(1, 2, 30, dtype=F64)[_order(30)]}
    recording = tc.Recording(x=x, y=torch.zeros(30, dtype=F64), units={"T": "K"})
    model = SimpleNamespace(problem=SimpleNamespace(in_time=False, recording=recording))
    feasible = Feasible.of({"T": (285.0, 320.0), "dose": (None, 2.2)}, None, recording)
    options = [*conditions.simple(model, feasible), *conditions.bolder(model, feasible)]
    assert options
    for text, new, chosen in options:
        assert torch.equal(new.x["T"], chosen["x"]["T"])
        assert 285.0 <= float(new.x["T"].min()) <= float(new.x["T"].max()) <= 320.0
        assert float(new.x["dose"].max()) <= 2.2 + 1e-9
        assert "T above" not in text
    texts = [text for text, _, _ in options]
    assert "conditions with T below the recorded range, to 285 K" in texts
    assert "conditions with dose above the recorded range, to 2.2" in texts
    assert any(float(new.x["dose"].min()) < 0.9 for _, new, _ in options)  # that end is open


def _order(n):
    return torch.randperm(n, generator=torch.Generator().manual_seed(0))


def test_runs_stay_within_what_is_feasible_and_are_tried_at_its_ends():
    model = driven({"x": 0.5, "v": 0.0})
    recording = model.problem.recording
    given = {"x": (0.0, 1.2), "f": (-2.0, 2.0), "t": (None, 6.0)}
    feasible = Feasible.of(given, model.problem.simulator.ode, recording)
    assert not feasible.allows(tc.Recording(runs=[_begun(recording, 1.3)]))
    options = [*conditions.simple(model, feasible), *conditions.bolder(model, feasible)]
    for _, new, chosen in options:
        assert 0.0 <= chosen["initial"]["x"] <= 1.2
        assert float(new.runs[0].inputs["f"].abs().max()) <= 2.0
        assert float(new.runs[0].time[-1]) <= 6.0
    found = {text: chosen for text, _, chosen in options}
    assert "a run that starts from 2 times the initial states of the first" in found
    assert "a run that starts from 3 times the initial states of the first" not in found
    assert not [text for text in found if ("twice" in text and "fast" not in text) or "three times" in text]
    assert found["a run that starts from x = 1.2, all else as in the first"]["initial"] == {"x": 1.2, "v": 0.0}
    assert found["a run with f held at -2"]["inputs"]["f"].unique().tolist() == [-2.0]


def _begun(recording, x):
    first = recording.runs[0]
    return tc.Run(first.time, first.outputs, inputs=first.inputs, initial={"x": x, "v": 0.0})


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"z": (0, 1)}, r"some of \['t', 'x', 'v', 'f'\].*Got 'z'"),
        ({"x": (2, 1)}, r"low <= high.*Got \(2, 1\)"),
        ({"x": 3.0}, r"'x': \(low, high\).*Got 3.0"),
        ({"x": ("a", None)}, r"'x': \(low, high\)"),
        ({"x": (math.nan, 1)}, r"'x': \(low, high\)"),
        ({"x": (0, 10**400)}, r"'x': \(low, high\)"),
        ({"x": {0: 1, 2: 3}}, r"'x': \(low, high\)"),
        ([("x", (0, 1))], r"feasible=\{name"),
    ],
)
def test_what_is_feasible_is_told_in_ranges_of_what_can_be_chosen(given, told):
    model = driven({"x": 0.5, "v": 0.0})
    with pytest.raises(tc.errors.DomainError, match=told):
        tc.diagnose(model.problem.simulator.ode, model.problem.recording, feasible=given, progress=False)


def test_numbers_of_any_kind_are_ends():
    model = driven({"x": 0.5, "v": 0.0})
    given = {"x": torch.tensor([0.0, 1.0]), "v": [np.float32(-1), None], "f": (torch.tensor(0.5), 2)}
    found = Feasible.of(given, model.problem.simulator.ode, model.problem.recording)
    assert found == {"x": (0.0, 1.0), "v": (-1.0, math.inf), "f": (0.5, 2.0)}


def test_a_state_that_the_simulator_begins_itself_is_none_to_choose():
    model = driven({"x": 0.5, "v": 0.0})
    ode = tc.ODESimulator(
        lambda t, s, p, u: {"x": -p["k"] * s["x"]}, {"x": "m"}, [tc.Parameter("k")], initial={"x": lambda s, p: 2.0}
    )
    with pytest.raises(tc.errors.DomainError, match=r"some of \['t', 'f'\]"):
        Feasible.of({"x": (0, 1)}, ode, model.problem.recording)


def test_experiments_begin_where_that_is_feasible_and_end_in_time():
    model = driven({"x": 0.5, "v": 0.0})
    feasible = Feasible.of({"x": (0.7, 1.0), "t": (0, 4.0)}, model.problem.simulator.ode, model.problem.recording)
    options = [*conditions.simple(model, feasible), *conditions.bolder(model, feasible)]
    texts = [text for text, _, _ in options]
    assert "the first run again, but from x = 0.7, until t = 4" in texts
    assert "a run with 2 times the inputs of the first, but from x = 0.7, until t = 4" in texts
    assert not [text for text in texts if "three times as long" in text]
    for _, new, chosen in options:
        assert 0.7 <= chosen["initial"]["x"] <= 1.0
        assert new.runs[0].time[-1] <= 4.0
        assert len(chosen["inputs"]["f"]) == len(chosen["time"]) == len(new.runs[0].time)


def test_conditions_that_are_feasible_beside_or_within_the_recorded_ones_are_tried():
    x = torch.linspace(10, 20, 30, dtype=F64)
    recording = tc.Recording(x={"T": x, "L": x.flip(0)}, y=torch.zeros(30, dtype=F64))
    model = SimpleNamespace(problem=SimpleNamespace(in_time=False, recording=recording))
    for low, high in ((12.0, 13.0), (2.0, 3.0), (25.0, 30.0)):
        feasible = Feasible.of({"T": (low, high)}, None, recording)
        options = {text: chosen["x"]["T"] for text, _, chosen in conditions.simple(model, feasible)}
        there = options[f"conditions with T between {low:g} and {high:g}"]
        assert [float(there.min()), float(there.max())] == pytest.approx([low, high])
        assert all(low <= float(T.min()) <= float(T.max()) <= high for T in options.values())
        assert "the same conditions again" not in options


def test_a_diagnosis_proposes_what_is_feasible():
    base, recording, terms = rivals()
    free = tc.diagnose(base, recording, terms, seed=0, progress=False)
    assert free.verdict == "ambiguous"
    assert float(free.experiment.conditions["x"]["dose"].min()) < 0.5 * float(recording.x["dose"].min())
    low = float(recording.x["dose"].min())
    kept = tc.diagnose(base, recording, terms, seed=0, progress=False, feasible={"dose": (low, None)})
    assert kept.tied == free.tied
    assert kept.experiment is None or float(kept.experiment.conditions["x"]["dose"].min()) >= low
