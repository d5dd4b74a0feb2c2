"""Shapes of terms that lie anywhere within wide bounds: periods, frequencies and phases."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal.discovery import windows
from torchcal.discovery.fits.candidates import prepare
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.rhythm import rhythms
from torchcal.discovery.fits.shapes import _between, _shared, looked_at, points_of_shapes
from torchcal.discovery.hypotheses.beginnings import learned

F64 = torch.float64
LINE = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a", initial=1.0), tc.Parameter("b", initial=1.0)])


def diagnose(simulator, recording, terms):
    return tc.diagnose(simulator, recording, terms, seed=0, progress=False)


def wavy(period, n, seed, size=0.6):
    x = np.linspace(0, 20, n)
    y = 1 + 0.5 * x + size * np.cos(2 * np.pi * (x - 2) / period)
    return tc.Recording(x=x, y=y + 0.07 * np.random.default_rng(seed).standard_normal(n), noise=0.07)


def cosine():
    return tc.Term(
        "cosine",
        outputs={"y": lambda x, p, y: y + p["A"] * torch.cos(2 * math.pi * (x - p["x0"]) / p["P"])},
        parameters=[tc.Parameter("A"), tc.Parameter("P", low=3.0, high=20.0), tc.Parameter("x0", low=0.0, high=20.0)],
    )


@pytest.mark.parametrize(("period", "n"), [(3.7, 28), (4.3, 60), pytest.param(3.3, 60, marks=pytest.mark.slow)])
def test_a_period_of_which_many_fit_into_the_recording_is_found(period, n):
    d = diagnose(LINE, wavy(period, n, 300), [cosine()])
    assert d.terms == ["cosine"]
    (found,) = [e for e in d.final.estimates if e.name == "cosine.P"]
    assert abs(found.value - period) < 4 * found.sd


@pytest.mark.parametrize("phase", [-2.25, pytest.param(1.5, marks=pytest.mark.slow)])
def test_a_phase_does_not_end_at_its_bound(phase):
    x = np.linspace(0, 20, 28)
    seed = {-2.25: 1, 1.5: 6}[phase]
    y = 1 + 0.5 * x + 0.5 * np.sin(0.5 * x + phase) + 0.1 * np.random.default_rng(seed).standard_normal(28)
    wave = tc.Term(
        "wave",
        outputs={"y": lambda x, p, y: y + p["A"] * torch.sin(p["om"] * x + p["ph"])},
        parameters=[
            tc.Parameter("A"), tc.Parameter("om", low=0.2, high=3.0), tc.Parameter("ph", low=-3.2, high=3.2)
        ],
    )  # fmt: skip
    assert diagnose(LINE, tc.Recording(x=x, y=y, noise=0.1), [wave]).terms == ["wave"]


@pytest.mark.slow
def test_many_shapes_name_nothing_in_noise():
    # Of 30 a test at 0.01 alarms in more than 3 with probability 0.0002.
    alarms = [diagnose(LINE, wavy(3.7, 40, seed, size=0.0), [cosine()]).verdict != "consistent" for seed in range(30)]
    assert sum(alarms) <= 3


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.1, 0.6])
def test_a_drive_of_unknown_frequency_is_found_in_a_rate(size):
    t = np.linspace(0, 40, 161)
    rates = lambda q, y: [y[1], -2.3 * y[0] - 0.3 * y[1] + size * np.sin(5.1 * q + 0.7)]  # noqa: E731
    x = solve_ivp(rates, (0, 40), [1.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-10).y[0]
    sd = 0.02 * x.std()
    recording = tc.Recording(
        runs=[tc.Run(time=t, outputs={"x": x + sd * np.random.default_rng(0).normal(size=161)})], noise=sd
    )
    model = tc.ODESimulator(
        rates=lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"]},
        states={"x": "m", "v": "m/s"},
        parameters=[tc.Parameter("k", low=0.1, high=9.0), tc.Parameter("c", low=0.0, high=3.0)],
        observe=("x",),
    )
    shaker = tc.Term(
        "shaker",
        equation="v",
        rate=lambda t, s, p, u: p["a"] * torch.sin(p["w"] * t) + p["b"] * torch.cos(p["w"] * t),
        parameters=[tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("w", low=0.3, high=8.0)],
    )
    d = diagnose(model, recording, [shaker])
    assert d.terms == ["shaker"]
    (found,) = [e for e in d.final.estimates if e.name == "shaker.w"]
    assert abs(found.value - 5.1) < 4 * found.sd


def looked(points, low, high, given=False, transform=None, others=(0.0, 0.8, 1.6), also=0, wave=0.0, periods=()):
    """Values that are looked at of a frequency, and of a phase beside it; and how many tangents that takes."""
    x = torch.linspace(0, 1, 200, dtype=F64)
    q = tc.Parameter("w", low=low, high=high, transform=transform)
    problem = SimpleNamespace(parameters=[q, tc.Parameter("phase", low=0.0, high=4.0)])
    asked = []

    def look(rows):
        asked.append(len(rows))
        smooth = [(x**k).expand(len(rows), -1) for k in range(2, 2 + also)]
        return torch.stack([torch.sin(2 * math.pi * rows[:, :1] * x + rows[:, 1:]), *smooth], dim=-1)

    fitted = SimpleNamespace(
        whitening=SimpleNamespace(sd=torch.ones(200, dtype=F64)), rhythms=periods, residual=torch.sin(wave * x + 0.3)
    )
    grid, tangents = looked_at(problem, [0, 1], [points, list(others)], [given, False], look, fitted)
    assert torch.equal(tangents, look(grid))
    return grid[:, 0].unique().tolist(), grid[:, 1].unique().tolist(), sum(asked[:-1])


def test_a_grid_is_finer_only_where_it_is_too_coarse():
    assert looked([1.0, 1.1, 1.2], 0.9, 1.3)[0] == [1.0, 1.1, 1.2]
    assert looked([10.0, 20.0], 5.0, 25.0, given=True)[0] == [10.0, 20.0]
    frequencies, phases, asked = looked([10.0, 20.0, 20.1, 20.2], 5.0, 20.3)
    assert phases == [0.0, 0.8, 1.6]
    assert max(np.diff([5.0, *frequencies])) < 1.0
    assert [w for w in frequencies if w >= 20.0] == [20.0, 20.1, 20.2]
    assert asked == 3 * len(frequencies)  # none twice
    assert looked([10.0, 20.0, 20.1, 20.2], 5.0, 20.3, also=2)[0] == frequencies  # of an amplitude beside others too


def test_a_grid_is_of_bounded_size_and_spares_what_changes_less():
    nine = torch.linspace(0, 3, 9).tolist()
    frequencies, phases, _ = looked(torch.linspace(0, 200, 9).tolist(), 0.0, 200.0, others=nine)
    assert phases == nine[::3]
    assert len(frequencies) * len(phases) <= 256 < len(frequencies) * 9


def test_a_grid_that_stays_too_coarse_is_offered_periods_and_frequencies_of_what_is_left():
    nine = torch.linspace(0, 3, 9).tolist()
    many = torch.linspace(0, 2000, 9).tolist()
    coarse, phases, _ = looked(many, 0.0, 2000.0, others=nine, wave=2 * math.pi * 81.3)
    for period in (1 / 81.3, 81.3, 2 * math.pi / 81.3):  # it may be called by any of these names
        found, same, _ = looked(many, 0.0, 2000.0, others=nine, wave=2 * math.pi * 81.3, periods=[0.5, period])
        assert sorted({*found} - {*coarse}) == pytest.approx([81.3])  # nothing that takes little is added
        assert same == phases
    fine = looked([1.0, 1.1, 1.2], 0.01, 1.3, wave=2 * math.pi * 1.15, periods=[1.15])
    assert fine[0] == [1.0, 1.1, 1.2]


@pytest.mark.parametrize("period", [0.083, 0.71])
@pytest.mark.parametrize("beside", ["nothing", "shuffled", "sorted"])
def test_rhythms_are_periods_of_the_strongest_waves_of_uneven_data(period, beside):
    rng = np.random.default_rng(0)
    x = np.sort(rng.uniform(0, 10, 300))
    left = 2.0 * np.sin(2 * np.pi * x / period + 1.0) + np.sin(2 * np.pi * x / 0.23) + 0.3 * rng.standard_normal(300)
    order = np.arange(300) if beside == "nothing" else rng.permutation(300)
    others = {"z": np.arange(300.0) if beside == "sorted" else rng.uniform(0, 1, 300), "k": np.arange(300.0) % 2}
    conditions = {"x": x[order]} | ({} if beside == "nothing" else others)
    recording = tc.Recording(x={k: torch.as_tensor(v) for k, v in conditions.items()}, y=torch.as_tensor(left[order]))
    problem = Problem.of(tc.Simulator(lambda x, p: p["a"] + 0 * x["x"], [tc.Parameter("a")]), recording)
    found = rhythms(problem, problem.y)
    assert abs(1 / found[0] - 1 / period) < 0.05  # half a cycle over all data
    assert abs(1 / found[1] - 1 / 0.23) < 0.05
    assert rhythms(problem, problem.y * math.nan) == []
    few = problem.keeping(torch.arange(300) < 20)
    assert rhythms(few, few.y) == []


def test_rhythms_of_many_data_and_of_bursts_are_sought_from_the_slowest_on():
    t = torch.linspace(0, 990, 100, dtype=F64)[:, None] + 1e-3 * torch.arange(10, dtype=F64)
    for at in (t.flatten(), torch.linspace(0, 990, 20_000, dtype=F64)):
        recording = tc.Recording(x=at, y=torch.sin(2 * math.pi * at / 90))
        problem = Problem.of(tc.Simulator(lambda x, p: p["a"] + 0 * x, [tc.Parameter("a")]), recording)
        assert rhythms(problem, problem.y)[0] == pytest.approx(90, rel=0.02)


def test_a_period_of_many_decades_is_found():
    rng = np.random.default_rng(0)
    x = torch.as_tensor(np.sort(rng.uniform(0, 10, 300)))
    y = 2 + 0.5 * x + 0.1 * x**2 + 0.2 * torch.sin(2 * math.pi * x / 0.083 + 1) + 0.1 * torch.as_tensor(
        rng.standard_normal(300)
    )
    model = tc.Simulator(
        lambda x, p: p["a"] + p["b"] * x + p["c"] * x**2, [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("c")]
    )
    fringe = tc.Term(
        "fringe",
        shifts={"a": lambda x, p: p["A"] * torch.sin(2 * math.pi * x / p["P"] + p["phase"])},
        parameters=[tc.Parameter("A"), tc.Parameter("P", low=0.01, high=10.0),
                    tc.Parameter("phase", low=0.0, high=6.2832)],
    )  # fmt: skip
    cubic = tc.Term("cubic", shifts={"a": lambda x, p: p["e"] * x**3}, parameters=[tc.Parameter("e")])
    d = tc.diagnose(model, tc.Recording(x=x, y=y, noise=0.1), [fringe, cubic], seed=0, progress=False)
    assert d.terms == ["fringe"]
    (found,) = [e for e in d.final.estimates if e.name == "fringe.P"]
    assert abs(found.value - 0.083) < 4 * found.sd


def test_values_between_decades_are_their_geometric_means_and_a_jump_is_no_end_of_them():
    q = tc.Parameter("w", low=1.0, high=400.0, transform="log")
    assert _between(q, [4.0, 100.0], torch.tensor([0.1])) == pytest.approx([2.0, 20.0, 200.0])
    close = [100.0, 100.001, 300.0]
    assert _between(q, close, torch.tensor([0.0, 0.9])) == pytest.approx([10.0])
    far = tc.Parameter("t0", low=1.7e9, high=1.7e9 + 10)
    tangents = torch.tensor([1.0, 1.0, 1e-9], dtype=F64)[:, None, None] * torch.ones(3, 5, 1, dtype=F64)
    shared = _shared(tangents, 0, [1.7e9 + 2, 1.7e9, 1.7e9 + 1])
    assert shared.tolist() == [1.0, 1.0]  # in ascending order, and what is nothing is none
    assert _between(far, [1.7e9, 1.7e9 + 1], torch.tensor([0.1])) == [1.7e9 + 0.5, 1.7e9 + 5.5]


def test_shapes_of_what_is_dear_are_not_looked_at_more_and_the_best_begin_at_another_fit():
    recording = wavy(3.7, 40, 1)
    for dear in (False, True):
        simulator = tc.Simulator(LINE.function, LINE.parameters)
        simulator.dear = dear
        problem = Problem.of(simulator, recording)
        found = fit(problem, problem.whitening(0.07 * torch.ones(40, dtype=F64), torch.zeros(1, dtype=F64)),
                    torch.ones(1, 2, dtype=F64), [0, 1])  # fmt: skip
        candidate = prepare(problem, found, [cosine()], {})
        assert (len(candidate.shapes) > 25) is not dear
        assert len(prepare(problem, found, [cosine()], {}, screened=False).tangents) == 0
        if not dear:
            rows = learned(found, found, candidate)
            names = [q.name for q in candidate.problem.parameters]
            assert float((rows[:, names.index("cosine.P")] - 3.7).abs().min()) < 0.15


def test_what_fits_better_in_a_window_begins_there_everywhere(monkeypatch):
    asked = []
    parameters = [tc.Parameter("a"), tc.Parameter("wave.A")]
    candidate = SimpleNamespace(problem=SimpleNamespace(parameters=parameters))
    lead = SimpleNamespace(
        numbers=(0,), window=SimpleNamespace(),
        found=SimpleNamespace(
            problem=SimpleNamespace(parameters=[tc.Parameter(name) for name in ("wave.window to", "wave.A", "a")]),
            values=torch.tensor([3.0, 2.0, 1.0], dtype=F64),
        ),
    )  # fmt: skip
    search = SimpleNamespace(
        physical_leader=lead, candidates=[candidate], prior=0.0, reweigh=lambda: None, plain={0: object()}
    )
    monkeypatch.setattr(windows, "improve", lambda search, wanted: asked.extend(wanted))
    windows._hand_back(search)
    assert asked[0].begin.tolist() == [[1.0, 2.0]]
    assert asked[0].candidate is candidate
    search.plain = {}  # which the base has everywhere
    windows._hand_back(search)
    lead.window = None
    windows._hand_back(search)
    assert len(asked) == 1


def test_a_shape_with_a_usual_value_is_looked_at_around_it_and_leaves_the_others_their_points():
    parameters = [tc.Parameter("tau", low=1.0, high=2.0), tc.Parameter("start", low=-1.0, high=3.0, neutral=1.0)]
    problem = SimpleNamespace(parameters=parameters)
    times, starts = points_of_shapes(problem, [0, 1], {}, {1: 1.0})
    assert (times, starts) == (points_of_shapes(problem, [0], {}, {})[0], [1.0, 0.0, 2.0])
    assert len(times) > len(points_of_shapes(problem, [0, 1], {}, {})[0])
