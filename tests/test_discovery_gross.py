"""A reading in the wrong unit, or with its decimal point in the wrong place: set aside, and nothing else with it."""

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.outliers import gross
from torchcal.errors import SimulatorError

F64 = torch.float64


def diagnose(simulator, recording, terms):
    return tc.diagnose(simulator, recording, terms, seed=0, progress=False)


def curve(kind, seed, at, times):
    """40 data of a right model in white noise of 0.5, one of them so many times as large as it is."""
    g = torch.Generator().manual_seed(seed)
    x = torch.linspace(0, 10, 40, dtype=F64)
    if kind == "peak":
        y = 20 * torch.exp(-(((x - 5) / 1.5) ** 2)) + 5
        simulator = tc.Simulator(
            lambda x, p: p["a"] * torch.exp(-(((x - p["b"]) / p["w"]) ** 2)) + p["c"],
            parameters=[
                tc.Parameter("a", low=0.0, initial=10.0),
                tc.Parameter("b", low=0.0, high=10.0, initial=4.5),
                tc.Parameter("w", low=0.2, high=10.0, initial=2.0),
                tc.Parameter("c", initial=1.0),
            ],
        )
    else:
        y = 20 * x / (2 + x) + 1
        simulator = tc.Simulator(
            lambda x, p: p["a"] * x / (p["b"] + x) + p["c"],
            parameters=[
                tc.Parameter("a", low=0.0, initial=10.0),
                tc.Parameter("b", low=0.01, high=100.0, initial=5.0),
                tc.Parameter("c", initial=0.0),
            ],
        )
    y = y + 0.5 * torch.randn(40, generator=g, dtype=F64)
    y[at] *= times
    slope = tc.Term("slope", outputs={"y": lambda x, p, y: y + p["m"] * x}, parameters=[tc.Parameter("m")])
    recording = tc.Recording(x=x, y=y)
    return simulator, recording, [slope, *tc.terms.sensor(outputs=recording.outputs, static=True)]


@pytest.mark.parametrize(
    ("kind", "seed", "at", "times"),
    [("peak", 0, 8, 1e3), ("peak", 1, 30, 1e2), ("peak", 3, 20, 10.0), ("rate", 0, 20, 1e3), ("rate", 2, 20, 1e2)],
)
def test_a_gross_reading_is_set_aside_and_leaves_nothing_missing(kind, seed, at, times):
    told = diagnose(*curve(kind, seed, at, times))
    assert told.verdict == "consistent"
    assert told.set_aside.nonzero().flatten().tolist() == [at]
    assert float(told.noise.sd["y"]) == pytest.approx(0.5, rel=0.25)


@pytest.mark.parametrize("count", [60, 120])
def test_a_gross_reading_makes_no_noise_that_grows(count):
    x = torch.linspace(0, 10, count, dtype=F64)
    y = 1 + 10 * x + 0.5 * torch.randn(count, generator=torch.Generator().manual_seed(1), dtype=F64)
    y[3 * count // 4] += 200.0
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, parameters=[tc.Parameter("a"), tc.Parameter("b")])
    told = diagnose(line, tc.Recording(x=x, y=y), tc.terms.sensor(outputs=("y",), static=True))
    assert told.verdict == "consistent"
    assert told.set_aside.nonzero().flatten().tolist() == [3 * count // 4]
    assert not told.noise.range


def test_noise_in_proportion_over_decades_has_no_gross_data():
    x = torch.logspace(-3, 3, 50, dtype=F64)
    e = torch.randn(200, 50, generator=torch.Generator().manual_seed(0), dtype=F64)
    told = torch.stack([gross(row) for row in 0.03 * x * e])
    assert float(told.double().mean()) < 0.002  # the largest alone, and rarely
    y = 2 * x * (1 + 0.03 * e[0])
    line = tc.Simulator(lambda x, p: p["b"] * x, parameters=[tc.Parameter("b")])
    offset = tc.Term("offset", outputs={"y": lambda x, p, y: y + p["c"]}, parameters=[tc.Parameter("c")])
    told = diagnose(line, tc.Recording(x=x, y=y), [offset])
    assert told.verdict == "consistent"
    assert told.noise.outliers == 0


def test_a_narrow_peak_that_one_datum_shows_is_no_outlier():
    """The rest is met as well with it as without it."""
    x = torch.linspace(0, 10, 41, dtype=F64)
    y = 300 * torch.exp(-(((x - 5.0) / 0.12) ** 2)) + 5
    y = y + 0.5 * torch.randn(41, generator=torch.Generator().manual_seed(5), dtype=F64)
    line = tc.Simulator(
        lambda x, p: p["a"] * torch.exp(-(((x - 5.0) / 0.12) ** 2)) + p["c"],
        parameters=[tc.Parameter("a", low=0.0, initial=100.0), tc.Parameter("c", initial=1.0)],
    )
    told = diagnose(line, tc.Recording(x=x, y=y), tc.terms.sensor(outputs=("y",), static=True))
    assert told.verdict == "consistent"
    assert told.noise.outliers == 0
    assert np.isclose(float(told.before.fitted.rmse), 0.5, rtol=0.3)


@pytest.mark.parametrize("seed", [0, 2, 6, 10, 19])
def test_few_large_values_in_proportional_noise_are_no_gross_readings(seed):
    """The largest calibrators of a table are off by as much as all others together: that is how noise grows."""
    g = np.random.default_rng(seed)
    x = np.concatenate([np.linspace(0.5, 10.0, 38), [800.0, 1000.0]])
    y = 2 * x * (1 + 0.1 * g.standard_normal(40))
    line = tc.Simulator(lambda x, p: p["b"] * x, parameters=[tc.Parameter("b", initial=1.0)])
    recording = tc.Recording(x=torch.as_tensor(x), y=torch.as_tensor(y))
    told = diagnose(line, recording, tc.terms.sensor(outputs=recording.outputs, static=True))
    assert told.verdict == "consistent"
    assert told.noise.outliers == 0


@pytest.mark.parametrize(("at", "times"), [(8, 1e3), (20, 10.0), (20, 1e3)])
def test_a_gross_reading_of_one_output_beside_another_one(at, times):
    g = torch.Generator().manual_seed(1)
    x = torch.linspace(0, 10, 40, dtype=F64)
    y = 20 * torch.exp(-(((x - 5) / 1.5) ** 2)) + 5 + 0.5 * torch.randn(40, generator=g, dtype=F64)
    z = 1 + 2 * x + 0.5 * torch.randn(40, generator=g, dtype=F64)
    y[at] *= times
    simulator = tc.Simulator(
        lambda x, p: {"y": p["a"] * torch.exp(-(((x - p["b"]) / p["w"]) ** 2)) + p["c"], "z": p["d"] + p["e"] * x},
        parameters=[
            tc.Parameter("a", low=0.0, initial=10.0),
            tc.Parameter("b", low=0.0, high=10.0, initial=4.5),
            tc.Parameter("w", low=0.2, high=10.0, initial=2.0),
            *(tc.Parameter(name, initial=1.0) for name in "cde"),
        ],
    )
    terms = tc.terms.sensor(outputs=("y", "z"), static=True)
    told = diagnose(simulator, tc.Recording(x=x, y={"y": y, "z": z}), terms)
    assert told.verdict == "consistent"
    assert told.set_aside.nonzero().flatten().tolist() == [at]


def test_a_base_that_cannot_be_calibrated_without_outliers_ends_no_diagnosis(monkeypatch):
    """What is set aside may have been all that told of an initial state: the first search stays."""
    usual, refused = Search.calibrate_base, []

    def calibrated(search, *given):
        if search.clean:
            refused.append(search.problem.n)
            raise SimulatorError("Expected the solution to settle. Got none.")
        return usual(search, *given)

    monkeypatch.setattr(Search, "calibrate_base", calibrated)
    x = torch.linspace(0, 10, 60, dtype=F64)
    y = 1 + 2 * x + 0.4 * x**2 + 0.3 * torch.randn(60, generator=torch.Generator().manual_seed(2), dtype=F64)
    y[20] += 1.8
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, parameters=[tc.Parameter("a"), tc.Parameter("b")])
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"] * x**2}, parameters=[tc.Parameter("q")])
    told = diagnose(line, tc.Recording(x=x, y=y), [bend])
    assert refused
    assert ["bend"] in [told.terms, *told.tied]


def test_a_gross_reading_that_a_wrong_term_bends_to_does_not_keep_the_right_one_from_leading(battery):
    rng, sd = np.random.default_rng(1005), 0.12
    x = {"I": rng.uniform(0.2, 6, 72), "T": rng.uniform(-10, 45, 72), "N": rng.uniform(0, 500, 72)}
    y = 10 / x["I"] ** 1.12 * (1 - 0.006 * np.clip(25 - x["T"], 0, None))
    y += sd * np.random.default_rng(0).standard_normal(72)
    y[[41, 46]] -= sd * np.array([7, 15])  # of the first a gain error where it is cold takes a part
    base, cold = battery
    ageing = tc.Term(
        "ageing", outputs={"y": lambda x, p, y: y * (1 - p["a"] * x["N"])},
        parameters=[tc.Parameter("a", low=0.0, high=0.0018)],
    )  # fmt: skip
    data = tc.Recording(x={name: torch.tensor(values) for name, values in x.items()}, y=torch.tensor(y), noise=sd)
    d = tc.diagnose(base, data, [cold, ageing, *tc.terms.sensor("y", static=True)], seed=0, progress=False)
    assert d.terms == ["loss in the cold"]
    assert d.set_aside.nonzero()[:, 0].tolist() == [41, 46]
