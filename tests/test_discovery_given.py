"""Inputs that were recorded at samples and held from one to the next, or not: what they do between is a guess."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.hypotheses.base import runs_away
from torchcal.discovery.verdicts import given
from torchcal.errors import DomainError

N, STEP = 150, 0.1
A, GAIN = 1.5, 2.0


def motor() -> tc.ODESimulator:
    return tc.ODESimulator(
        rates=lambda t, s, p, u: {"w": p["a"] * (p["g"] * u["c"] - s["w"])},
        states={"w": "rad/s"},
        parameters=[tc.Parameter("a", unit="1/s", low=0.0, initial=1.0), tc.Parameter("g", low=0.0, initial=1.0)],
    )


def candidates() -> list[tc.Term]:
    return [
        tc.Term(
            "dead time",
            outputs={"w": lambda t, s, p, u, y: y - p["tau"] * p["a"] * (p["g"] * u["c"] - s["w"])},
            parameters=[tc.Parameter("tau", unit="s", low=0.0)],
        ),
        tc.Term(
            "friction",
            equation="w",
            rate=lambda t, s, p, u: -p["f"] * torch.tanh(s["w"] / 0.02),
            parameters=[tc.Parameter("f", unit="rad/s^2", low=0.0)],
        ),
        tc.Term("drift", equation="w", rate=lambda t, s, p, u: p["b"] * t, parameters=[tc.Parameter("b")]),
    ]


def command(generator: torch.Generator) -> torch.Tensor:
    levels = 2 * torch.rand(N // 15, generator=generator, dtype=torch.float64) - 1
    return levels.repeat_interleave(15)


def recording(seed: int, hold: str, friction: float = 0.0) -> tc.Recording:
    """The answer to a command that is held from sample to sample, solved with short steps between."""
    generator = torch.Generator().manual_seed(seed)
    c = command(generator)
    w, short = [torch.tensor(0.3, dtype=torch.float64)], 50
    decay = math.exp(-A * STEP / short)
    for now in c[:-1]:
        speed = w[-1]
        for _ in range(short):
            drive = GAIN * now - friction / A * torch.tanh(speed / 0.02)
            speed = speed * decay + (1 - decay) * drive
        w.append(speed)
    y = torch.stack(w)
    sd = 0.02 * float(y.std())
    y = y + sd * torch.randn(N, generator=generator, dtype=torch.float64)
    time = STEP * torch.arange(N, dtype=torch.float64)
    return tc.Recording(runs=[tc.Run(time=time, outputs={"w": y}, inputs={"c": c}, hold=hold)], noise=sd)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_wrong_guess_between_samples_is_no_dead_time(seed):
    d = tc.diagnose(motor(), recording(seed, "linear"), candidates(), seed=0, progress=False)
    assert d.verdict == "ambiguous"
    assert ["none of these"] in d.tied
    assert "(hold=) would do nearly as well" in str(d).replace("\n", " ")
    assert any("with hold='zero' the base leaves no more than noise" in row for row in d.symptoms)


@pytest.mark.slow
def test_no_tie_of_names_alone_for_a_wrong_guess():
    filtered = tc.Term(
        "filter",
        outputs={"w": lambda t, s, p, u, y: y - p["tau"] * (p["a"] * (p["g"] * u["c"] - s["w"]) + 0.001 * s["w"])},
        parameters=[tc.Parameter("tau", unit="s", low=0.0)],
    )
    d = tc.diagnose(motor(), recording(0, "linear"), [candidates()[0], filtered], seed=0, progress=False)
    assert d.verdict in ("ambiguous", "unexplained")
    assert d.verdict == "unexplained" or ["none of these"] in d.tied


@pytest.mark.slow
def test_a_wrong_guess_adds_no_name_to_a_right_one():
    d = tc.diagnose(motor(), recording(0, "linear", friction=0.3), candidates(), seed=0, progress=False)
    assert "dead time" not in d.terms
    assert "(hold=) would do nearly as well without all or a part of it" in " ".join(str(d).split())


@pytest.mark.slow
def test_a_wrong_guess_in_one_of_two_runs_is_told_of_that_run():
    right, wrong = recording(0, "zero"), recording(1, "linear")
    both = tc.Recording(runs=[right.runs[0], wrong.runs[0]], noise=0.02)
    d = tc.diagnose(motor(), both, candidates(), seed=0, progress=False)
    assert d.verdict in ("ambiguous", "unexplained")
    assert any("with hold='zero' in run 1 the base leaves no more than noise" in row for row in d.symptoms)


def test_what_is_held_and_stays_is_no_ramp():
    assert not given._far(recording(0, "zero").runs[0])
    assert given._far(recording(0, "linear").runs[0])
    run = recording(0, "zero").runs[0]
    rough = torch.randn(N, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert given._far(tc.Run(time=run.time, outputs=run.outputs, inputs={"c": rough}, hold="zero"))
    assert not given._far(tc.Run(time=run.time, outputs=run.outputs, inputs={"c": rough}, hold="cubic"))
    assert not given._far(tc.Run(time=run.time, outputs=run.outputs, inputs={"c": 0 * rough + 1}))


def test_of_several_inputs_those_that_change_far_are_suspected():
    run = recording(0, "linear").runs[0]
    inputs = {"c": run.inputs["c"], "room": torch.sin(0.5 * run.time)}
    both = tc.Run(time=run.time, outputs=run.outputs, inputs=inputs)
    assert given._far(both) == ["c"]
    assert given._far(tc.Run(time=run.time, outputs=run.outputs, inputs=inputs, hold={"c": "zero"})) == []


@pytest.mark.slow
def test_of_several_inputs_one_may_go_on_otherwise():
    run = recording(0, "linear").runs[0]
    both = tc.Run(
        time=run.time, outputs=run.outputs, inputs={"c": run.inputs["c"], "room": torch.sin(0.5 * run.time)}
    )
    recorded = tc.Recording(runs=[both], noise=0.02)
    warm = tc.ODESimulator(
        rates=lambda t, s, p, u: {"w": p["a"] * (p["g"] * u["c"] + p["h"] * u["room"] - s["w"])},
        states={"w": "rad/s"}, parameters=[*motor().parameters, tc.Parameter("h")],
    )  # fmt: skip
    d = tc.diagnose(warm, recorded, [], seed=0, progress=False)
    assert any("with hold={'c': 'zero', 'room': 'linear'} the base" in row for row in d.symptoms)
    again = recorded.with_hold([{"c": "zero", "room": "linear"}])
    assert tc.diagnose(warm, again, [], seed=0, progress=False).verdict == "consistent"
    assert recorded.with_hold([{"c": "zero", "room": "zero"}]).runs[0].hold == "zero"


def test_the_right_guess_leaves_nothing():
    d = tc.diagnose(motor(), recording(0, "zero"), candidates(), seed=0, progress=False)
    assert d.verdict == "consistent"
    assert d.symptoms == []


@pytest.mark.slow
def test_what_no_other_guess_explains_is_named():
    d = tc.diagnose(motor(), recording(0, "zero", friction=0.3), candidates(), seed=0, progress=False)
    assert d.terms == ["friction"]
    assert not any("inputs change far" in row for row in d.symptoms)


def test_smooth_inputs_are_taken_as_they_are(monkeypatch):
    smooth = recording(0, "linear")
    run = smooth.runs[0]
    inputs = {"c": torch.sin(0.5 * run.time)}
    smooth = tc.Recording(runs=[tc.Run(time=run.time, outputs=run.outputs, inputs=inputs)], noise=smooth.noise)
    monkeypatch.setattr(given, "_refitted", lambda *_: pytest.fail("no other hold is to be tried"))
    assert tc.diagnose(motor(), smooth, [], seed=0, progress=False).verdict != "consistent"


def test_another_hold_for_each_run():
    twin = recording(0, "linear").with_hold(["zero"])
    assert twin.runs[0].hold == "zero"
    assert float(twin.runs[0].inputs_at(0.05)["c"]) == float(twin.runs[0].inputs["c"][0])
    with pytest.raises(tc.errors.RecordingError, match=r"hold for each run. Got 2 for 1"):
        twin.with_hold(["zero", "zero"])


@pytest.mark.parametrize("sd", [*(pytest.param(sd, marks=pytest.mark.slow) for sd in (1e-7, 1e-9)), 1e-160])
def test_a_noise_too_small_for_the_arithmetic_is_taken_as_large_as_it_must_be(sd: float, tmp_path: Path) -> None:
    # χ² of 1e18 has no digits left for what one explanation is better than another by.
    x = torch.linspace(0, 5, 40, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    y = 1 + 2 * x + 0.3 * x**2 + sd * torch.randn(40, generator=generator, dtype=torch.float64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")], degree=1)
    terms = [
        tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"] * x**2}, parameters=[tc.Parameter("q")]),
        tc.Term("wave", outputs={"y": lambda x, p, y: y + p["w"] * torch.sin(x)}, parameters=[tc.Parameter("w")]),
    ]
    recording = tc.Recording(x=x, y=y, noise=sd)
    d = tc.diagnose(line, recording, terms, progress=False)
    assert d.recording is recording
    assert d.terms == ["bend"]
    assert any("arithmetic" in text for text in d.symptoms)
    assert not any("smaller one" in text for text in d.symptoms)
    assert d.noise.sd["y"] > sd
    assert d.noise.enlarged == pytest.approx(d.noise.sd["y"] / sd)
    d.report(tmp_path / "report.html")
    assert "times as large, since arithmetic cannot weigh it" in (tmp_path / "report.html").read_text("utf-8")
    assert 0.1 * given.DIGITS < d.base.chi2 < 1.01 * given.DIGITS  # less what is set aside


def test_a_recording_with_another_noise_is_the_same_otherwise() -> None:
    data = tc.Recording(x=torch.arange(4.0), y=torch.tensor([0.0, 1.0, 3.0, 2.0]), noise=0.5)
    other = data.with_noise([0.1, 0.2, 0.3, 0.4])
    torch.testing.assert_close(other.noise, torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64))
    assert float(data.noise[0]) == 0.5  # type: ignore[index]
    assert other.y is data.y
    with pytest.raises(DomainError, match="sd > 0"):
        data.with_noise(0.0)


@pytest.mark.slow
@pytest.mark.parametrize("in_time", [False, True])
def test_a_bound_that_is_wrong_is_told(in_time):
    x = torch.linspace(0, 1, 40, dtype=torch.float64)
    sd = 0.01 * torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    a, b = tc.Parameter("a", unit="V", low=0.0, high=2.0), tc.Parameter("b", unit="1/s", low=0.0, high=10.0)

    def told(shift: float) -> tuple[str, list[str]]:
        y = 3 * torch.exp(-2 * x) + shift * torch.sin(9 * x) + sd
        offset = tc.Term("offset", outputs={"y": lambda *given: given[-1] + given[-3 if in_time else 1]["o"]},
                         parameters=[tc.Parameter("o")])  # fmt: skip
        if in_time:
            base = tc.ODESimulator(
                lambda t, s, p, u: {"z": -p["b"] * s["z"]}, ["z"], [a, b], initial={"z": lambda s, p: p["a"]},
                observe={"y": lambda t, s, p, u: s["z"]},
            )  # fmt: skip
            data = tc.Recording(runs=[tc.Run(x, {"y": y})], noise=0.01)
        else:
            base = tc.Simulator(lambda x, p: p["a"] * torch.exp(-p["b"] * x), [a, b])
            data = tc.Recording(x=x, y={"y": y}, noise=0.01)
        d = tc.diagnose(base, data, [offset], seed=0, progress=False)
        return d.verdict, d.symptoms

    verdict, rows = told(0.0)
    assert verdict != "consistent"
    assert rows[0].startswith(("without its bound a is 3.0", "without its bound a is 2.9"))
    assert rows[0].endswith(" V, and the base leaves no more than noise: a bound that is wrong looks like this")
    assert not any(row.startswith("without its bound") for row in told(0.1)[1])  # something else is missing


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_a_fast_misfit_is_no_slow_noise_beside_a_base_that_misses_the_data(seed):
    """Of counts, whose sd falls with them: a memory of slow noise frees the base to leave ten times what it must."""
    t = np.arange(0.1, 12, 0.2)
    base = tc.Simulator(
        lambda x, p: p["N"] * torch.exp(-x["t"] / p["tau"]),
        [tc.Parameter("N", low=0.0, initial=900.0), tc.Parameter("tau", low=0.1, high=10.0, initial=2.0)],
    )
    flat = tc.Term("flat background", outputs={"y": lambda x, p, y: y + p["b"]}, parameters=[tc.Parameter("b", low=0)])
    counts = np.random.default_rng(seed).poisson(
        1500 * np.exp(-t / 2.197) * (1 + 0.12 * np.cos(2 * np.pi * t / 1.5))
    ).astype(float)  # fmt: skip
    recording = tc.Recording(x={"t": t}, y=counts, noise=np.sqrt(np.maximum(counts, 1)))
    found = tc.diagnose(base, recording, [flat], seed=0, progress=False)
    assert found.verdict == "unexplained"
    assert {e.name: e.value for e in found.base.estimates}["tau"] == pytest.approx(2.15, abs=0.1)


def test_a_given_noise_is_not_larger_where_that_frees_the_base_to_miss_the_data():
    """Of counts that fade in a wave: with slow noise of any size the base had left sixteen times what it must."""
    t = np.linspace(0, 18, 90)
    base = tc.Simulator(
        lambda x, p: {"N": p["A"] * torch.exp(-x / p["tau"]) + p["b"]},
        [tc.Parameter("A", low=0, initial=100), tc.Parameter("tau", low=0.2, high=30, initial=2.5),
         tc.Parameter("b", low=0, initial=1)],
    )  # fmt: skip
    mean = (1500 * np.exp(-t / 3.0) + 1.5) * (1 + 0.12 * np.sin(2 * np.pi * t / 1.9))
    counts = np.random.default_rng(12).poisson(mean).astype(float)
    recording = tc.Recording(x=t, y={"N": counts}, noise=np.sqrt(np.maximum(counts, 1)))
    found = tc.diagnose(base, recording, [tc.Term("offset", outputs={"N": lambda x, p, y: y + p["o"]},
                                                  parameters=[tc.Parameter("o")])], seed=0, progress=False)  # fmt: skip
    assert found.verdict == "unexplained"
    assert found.base.estimates[0].value == pytest.approx(1500, rel=0.1)
    assert not any("times the sd that was given" in row for row in found.symptoms)


def test_an_output_of_few_data_runs_away_beside_one_of_many():
    noise = torch.ones(1050, dtype=torch.float64)
    output_of = (torch.arange(1050) < 50).long()
    problem = SimpleNamespace(
        recording=SimpleNamespace(noise=noise, outputs=("many", "few")), index=torch.arange(1050), output_of=output_of,
        n=1050,
    )  # fmt: skip
    before = SimpleNamespace(problem=problem, residual=noise)
    after = SimpleNamespace(problem=problem, residual=torch.where(output_of == 1, 7.9, 1.0).double())
    assert runs_away(after, before).tolist() == [False, True]
    assert not runs_away(before, before).any()
