"""Terms that set in at once: the time or the threshold of it has no slope, and is found all the same."""

import numpy as np
import pytest
import torch

import torchcal as tc

F64 = torch.float64


def diagnose(simulator, recording, terms):
    return tc.diagnose(simulator, recording, terms, seed=0, progress=False)


def population(seed, terms):
    """Selection of an allele that turns after 30 of 100 generations."""
    t = np.linspace(0.0, 100.0, 51)
    p = np.empty(51)
    now, at = 0.1, 0.0
    p[0] = now
    for k, end in enumerate(t[1:], 1):
        while at < end - 1e-9:
            now += 0.02 * (0.08 if at < 30.0 else 0.03) * now * (1 - now)
            at += 0.02
        p[k] = now
    p += 0.012 * np.random.default_rng(seed).standard_normal(51)
    simulator = tc.ODESimulator(
        lambda t, s, p, u: {"p": p["s"] * s["p"] * (1 - s["p"])}, {"p": "1"}, [tc.Parameter("s", initial=0.05)]
    )
    return simulator, tc.Recording(runs=[tc.Run(time=t, outputs={"p": p})]), terms


WHERE = tc.Term(
    "selection changes",
    shifts={"s": lambda t, s, p, u: torch.where(t > p["t1"], p["ds"], 0.0 * p["ds"])},
    parameters=[tc.Parameter("ds"), tc.Parameter("t1", low=5.0, high=100.0)],
)
MIGRATION = tc.Term("migration", equation="p", rate=lambda t, s, p, u: p["m"] * (0.5 - s["p"]),
                    parameters=[tc.Parameter("m", low=0.0)])  # fmt: skip
EARLY = tc.Term("already there", shifts={"s": lambda t, s, p, u: p["e"] + 0.0 * t}, parameters=[tc.Parameter("e")])


@pytest.mark.parametrize("seed", [1, 2])
def test_an_onset_in_time_is_named_though_it_has_no_slope(seed):
    told = diagnose(*population(seed, [MIGRATION, WHERE]))
    assert told.verdict == "named"
    assert told.terms == ["selection changes"]
    onset = next(e for e in told.ranking[0].estimates if e.name == "selection changes.t1")
    assert onset.value == pytest.approx(30.0, abs=3.0)
    assert onset.interval is not None
    assert onset.interval[0] < 30.5 < onset.interval[1] + 1.0


def test_the_same_in_a_window_is_tied_with_what_sets_in_then():
    told = diagnose(*population(1, [MIGRATION, EARLY, WHERE]))
    assert told.verdict == "ambiguous"
    assert told.tied[:2] == [["selection changes"], ["already there"]]


def test_an_onset_whose_slope_is_that_of_something_else_is_found():
    """An afterpulse of a scintillator: its slope by the onset tells of its decay and not of its edge."""
    g = np.random.default_rng(1)
    t = np.sort(g.uniform(0.0, 400.0, 160))
    y = np.exp(-t / 40) + 0.06 * np.where(t > 180, np.exp(-(t - 180) / 40), 0.0) + 0.008 * g.standard_normal(160)
    simulator = tc.Simulator(
        lambda x, p: p["A"] * torch.exp(-x / p["tau"]),
        parameters=[tc.Parameter("A", low=0.0, initial=0.9), tc.Parameter("tau", low=5.0, high=500.0, initial=50.0)],
    )

    def afterpulse(x, p, y):
        late = x - p["t0"]
        return y + p["a"] * torch.where(late > 0, torch.exp(-late.clamp_min(-10.0) / p["tau"]), 0.0)

    terms = [
        tc.Term("afterpulse", outputs={"y": afterpulse},
                parameters=[tc.Parameter("a", low=0.0), tc.Parameter("t0", low=30.0, high=350.0)]),
        tc.Term("baseline", outputs={"y": lambda x, p, y: y + p["b"]}, parameters=[tc.Parameter("b")]),
    ]  # fmt: skip
    told = diagnose(simulator, tc.Recording(x=torch.as_tensor(t), y=torch.as_tensor(y), noise=0.008), terms)
    assert told.verdict == "named"
    assert told.terms == ["afterpulse"]
    onset = next(e for e in told.ranking[0].estimates if e.name == "afterpulse.t0")
    assert onset.value == pytest.approx(180.0, abs=3.0)


def test_a_threshold_of_a_condition_is_found_though_a_function_raises_beyond():
    x = torch.linspace(0.0, 10.0, 60, dtype=F64)
    noise = 0.05 * torch.randn(60, generator=torch.Generator().manual_seed(4), dtype=F64)
    y = 1.0 + 0.5 * x + torch.where(x > 6.4, 0.4 * (x - 6.4) + 0.3, 0.0) + noise
    simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, parameters=[tc.Parameter("a"), tc.Parameter("b")])

    def breaks(x, p, y):
        if bool((p["c"] > 9.0).any()):
            raise ValueError("no threshold there")
        return y + torch.where(x > p["c"], p["h"] + p["k"] * x, 0.0)

    kink = tc.Term("breaks", outputs={"y": breaks},
                   parameters=[tc.Parameter("h"), tc.Parameter("k"), tc.Parameter("c", low=0.5, high=9.5)])  # fmt: skip
    told = diagnose(simulator, tc.Recording(x=x, y=y), [kink])
    assert ["breaks"] in [told.terms, *told.tied]
    (row,) = (row for row in told.ranking if list(row.terms) == ["breaks"] and not row.region)
    c = next(e for e in row.estimates if e.name == "breaks.c")
    assert c.value == pytest.approx(6.4, abs=0.2)


def test_the_interval_of_a_threshold_is_the_gap_between_data_and_it_has_an_effect():
    x = torch.linspace(0.0, 10.0, 60, dtype=F64)
    noise = 0.05 * torch.randn(60, generator=torch.Generator().manual_seed(4), dtype=F64)
    y = 1.0 + 0.5 * x + torch.where(x > 6.4, 0.5, 0.0) + noise
    simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, parameters=[tc.Parameter("a"), tc.Parameter("b")])
    step = tc.Term("step", outputs={"y": lambda x, p, y: y + torch.where(x > p["c"], p["h"], 0.0)},
                   parameters=[tc.Parameter("h"), tc.Parameter("c", low=0.5, high=9.5)])  # fmt: skip
    told = diagnose(simulator, tc.Recording(x=x, y=y), [step])
    assert told.terms == ["step"]
    c = next(e for e in told.ranking[0].estimates if e.name == "step.c")
    low, high = c.interval
    assert 6.0 < low <= c.value <= high < 6.8
    assert "not determined" not in str(told)
    assert "has no effect" not in str(told)


def test_a_time_that_nobody_says_anything_of_is_no_amplitude():
    """At 0, where parameters of terms are neutral unless somebody says otherwise, its rate is infinite."""
    t = np.linspace(0.0, 10.0, 80)
    x = np.exp(-0.5 * t) * (1 + 0.0 * t) + 0.004 * np.random.default_rng(0).standard_normal(80)
    base = tc.ODESimulator(
        lambda t, s, p, u: {"x": -p["k"] * s["x"]}, {"x": "m"}, [tc.Parameter("k", low=0.0, initial=0.3)]
    )
    eddy = tc.Term(
        "eddy", states={"e": "m"}, initial={"e": 0.0},
        rates={"x": lambda t, s, p, u: -p["k"] * (s["x"] - s["e"]),
               "e": lambda t, s, p, u: (s["x"] - s["e"]) / p["te"]},
        parameters=[tc.Parameter("k", low=0.0), tc.Parameter("te")],
    )  # fmt: skip
    told = diagnose(base, tc.Recording(runs=[tc.Run(time=t, outputs={"x": x})]), [eddy])
    assert told.verdict == "consistent"
    assert [row.term for row in told.detection_limit] == ["eddy"]
