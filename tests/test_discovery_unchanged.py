"""What must not change a verdict: the origin of a unit or of a clock, an output with few data, how fast runs are
sampled, how large their noise is, and numbers of another type."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.fits.local import Span
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.shapes import combined, points_of_shapes
from torchcal.discovery.misfit.growth import _fastest, growth
from torchcal.discovery.misfit.noise import estimate, quantisation
from torchcal.discovery.misfit.residual import _noise_draws

F64 = torch.float64


def diagnose(simulator, recording, terms, **options):
    return tc.diagnose(simulator, recording, terms, seed=0, progress=False, **options)


def white(n, seed):
    return torch.randn(n, generator=torch.Generator().manual_seed(seed), dtype=F64)


def line(**names):
    return tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])


def fitted(simulator, recording):
    problem = Problem.of(simulator, recording)
    begin = torch.zeros(1, len(problem.parameters), dtype=F64)
    whitening = problem.whitening(0.1 * recording.spread, torch.zeros(len(recording.outputs), dtype=F64))
    return fit(problem, whitening, begin, list(range(begin.shape[1])))


def cooling(steps, counts, sds, seed=0, tau=0.0):
    """Runs of a cooling body that its model describes, with noise that forgets in a time τ."""
    rng, runs = np.random.default_rng(seed), []
    for k, (step, n, sd) in enumerate(zip(steps, counts, sds, strict=True)):
        t, e = np.arange(n) * step, rng.standard_normal(n)
        phi = math.exp(-step / tau) if tau else 0.0
        for i in range(1, n):
            e[i] = phi * e[i - 1] + math.sqrt(1 - phi**2) * e[i]
        outputs = {"T": (5 + k) * np.exp(-0.3 * t) + 1 + sd * e}
        runs.append(tc.Run(time=t, outputs=outputs, initial={"T": 6.0 + k}))
    model = tc.ODESimulator(
        rates=lambda t, s, p, u: {"T": -p["k"] * (s["T"] - p["room"])},
        states={"T": "K"},
        parameters=[tc.Parameter("k", low=0.0, initial=0.4), tc.Parameter("room", initial=0.5)],
    )
    return model, tc.Recording(runs=runs)


LOSS = [
    tc.Term("ramp", equation="T", rate=lambda t, s, p, u: p["q"] * t, parameters=[tc.Parameter("q")]),
    tc.Term(
        "quadratic loss", equation="T", rate=lambda t, s, p, u: -p["q"] * s["T"] ** 2, parameters=[tc.Parameter("q")]
    ),
]


# --- an output with few data --------------------------------------------------------------------------------


def two(keep, size=0.2):
    x, n = torch.linspace(0, 3, 60, dtype=F64), 60
    y = {"A": 1 + 2 * x + size * torch.sin(4 * x) + 0.05 * white(n, 1), "B": 2 - x + 0.05 * white(n, 2)}
    y["B"] = torch.where(torch.isin(torch.arange(n), torch.tensor(list(keep))), y["B"], math.nan)
    model = tc.Simulator(
        lambda x, p: {"A": p["a"] + p["b"] * x, "B": p["c"] + p["d"] * x}, [tc.Parameter(name) for name in "abcd"]
    )
    return model, tc.Recording(x=x, y=y, missing=True)


def test_every_output_has_its_own_degrees_of_freedom():
    found = fitted(*two([3, 17, 31, 44, 57]))
    noise = estimate(found.problem, found.residual, found.jacobian, None)
    assert float(noise.freedom[0]) > 30
    assert float(noise.freedom[1]) <= 3
    white_draws = _noise_draws(found, dataclasses.replace(noise, correlation=torch.zeros(2, dtype=F64)), 20000, 0)
    wide = white_draws[found.problem.output_of == 1].abs() > 6
    assert float((white_draws[found.problem.output_of == 0].abs() > 6).double().mean()) < 1e-4
    assert float(wide.double().mean()) > 5e-3


def test_an_output_of_few_data_does_not_hide_the_misfit_of_another():
    # By noise alone these have a probability of 0.001 where both outputs have 60 data, the least that can be seen; with
    # the tails of the few data in all of them it was 0.019 beside twelve and 0.067 beside five.
    assert diagnose(*two(range(0, 60, 5)), []).p_detect < 0.01
    assert diagnose(*two([3, 17, 31, 44, 57]), []).p_detect < 0.03
    assert diagnose(*two(range(0, 60, 5), 0.3), []).verdict == "unexplained"


# --- runs that are sampled or measured otherwise --------------------------------------------------------------


def test_noise_forgets_over_the_same_time_in_all_runs():
    model, recording = cooling((0.05, 0.5), (200, 25), (0.05, 0.05), tau=0.3)
    problem = Problem.of(model, recording)
    fast, slow = problem.recorded
    assert float(problem.gaps(fast).median()) == pytest.approx(1.0)
    assert float(problem.gaps(slow).median()) == pytest.approx(10.0)
    assert problem.uneven


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_runs_of_unlike_rates_are_no_missing_physics(seed):
    model, recording = cooling((0.05, 0.5), (200, 25), (0.05, 0.05), seed, tau=0.3)
    d = diagnose(model, recording, LOSS)
    assert d.verdict == "consistent"
    assert d.noise.memory == "time"
    assert d.noise.correlation["T"] == pytest.approx(math.exp(-0.05 / 0.3), abs=0.25)


def test_a_noisier_run_is_seen():
    model, recording = cooling((0.1,) * 3, (100,) * 3, (0.02, 0.02, 0.1))
    problem = Problem.of(model, recording)
    begin = torch.tensor([[0.3, 1.0]], dtype=F64)
    found = fit(problem, problem.whitening(0.05 * torch.ones(300, dtype=F64), torch.zeros(1, dtype=F64)), begin, [0, 1])
    one = torch.ones(300, dtype=F64)
    unit = growth(problem, found.residual, found.jacobian, found.y, one)
    run = recording.x["run"]
    # A mean of 98 differences, of which neighbours share two of three, has a relative sd of 0.75 / √58, twice.
    ratio = float(unit[run == 2].median() / unit[run == 0].median())
    assert abs(math.log(ratio / 5.0)) < 5 * 0.14
    alike = cooling((0.1,) * 3, (100,) * 3, (0.05,) * 3, seed=1)
    problem = Problem.of(*alike)
    found = fit(problem, problem.whitening(0.05 * one, torch.zeros(1, dtype=F64)), begin, [0, 1])
    assert torch.equal(growth(problem, found.residual, found.jacobian, found.y, one), one)


def test_a_noisier_run_is_seen_beside_one_that_is_sampled_at_another_rate():
    model, recording = cooling((0.1, 0.1, 0.1, 0.5), (100, 100, 100, 30), (0.02, 0.02, 0.1, 0.02))
    problem = Problem.of(model, recording)
    one = torch.ones(330, dtype=F64)
    begin = torch.tensor([[0.3, 1.0]], dtype=F64)
    found = fit(problem, problem.whitening(0.05 * one, torch.zeros(1, dtype=F64)), begin, [0, 1])
    unit = growth(problem, found.residual, found.jacobian, found.y, one)
    by_run = [float(unit[recording.x["run"] == r].median()) for r in range(4)]
    assert abs(math.log(by_run[2] / by_run[0] / 5.0)) < 5 * 0.14
    # Nobody is sampled as the last one is, so that its noise is as that of all others together.
    told = (2 * by_run[0] + by_run[2]) / 3
    assert by_run[3] == pytest.approx(told, rel=0.1)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_noisier_run_is_no_missing_physics(seed):
    model, recording = cooling((0.1,) * 4, (100,) * 4, (0.01, 0.01, 0.01, 0.2), seed)
    d = diagnose(model, recording, LOSS)
    assert d.verdict == "consistent"
    assert "from run to run" in str(d)
    low, high = d.noise.range["T"]
    assert low == pytest.approx(0.01, rel=0.4)
    assert high == pytest.approx(0.2, rel=0.4)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_run_whose_noise_goes_on_is_not_taken_for_a_quieter_one(seed):
    model, plain = cooling((0.1,) * 3, (100,) * 3, (0.05,) * 3, seed)
    runs = list(plain.runs)
    t, e = runs[2].time, np.convolve(np.random.default_rng(seed).standard_normal(104), np.ones(5) / 5, "valid")
    outputs = {"T": 7 * torch.exp(-0.3 * t) + 1 + 0.05 * torch.as_tensor(e)}
    runs[2] = tc.Run(time=t, outputs=outputs, initial={"T": 8.0})
    assert not diagnose(model, tc.Recording(runs=runs), LOSS).noise.range


# --- the origin of a unit, or of a clock -----------------------------------------------------------------------


@pytest.mark.parametrize(("origin", "size"), [(0.0, 1.0), (273.15, 1.0), (32.0, 1.8)])
def test_steps_of_a_reading_are_seen_in_any_unit(origin, size):
    x = torch.linspace(0, 10, 100, dtype=F64)
    y = ((20 + 0.31 * x + 0.05 * white(100, 4)) / 0.5).round() * 0.5
    problem = Problem.of(line(), tc.Recording(x=x, y=y * size + origin))
    assert quantisation(problem)["y"] == pytest.approx(0.5 * size)
    fine = Problem.of(line(), tc.Recording(x=x, y=origin + 0.31 * x + 0.05 * white(100, 4)))
    assert not quantisation(fine)
    even = torch.arange(11, dtype=F64).repeat(2)
    assert not quantisation(Problem.of(line(), tc.Recording(x=even, y=1.234 + 0.0777 * even)))


def test_time_is_on_no_logarithmic_scale_wherever_its_clock_begins():
    at = torch.linspace(0.05, 30.0, 200, dtype=F64)
    assert not Span.of(at, time=True).log
    assert Span.of(at, time=False).log


@pytest.mark.parametrize(
    ("origin", "size"), [pytest.param(0.0, 1.0, marks=pytest.mark.slow), (-10.0, 1.0), (0.0, 1000.0)]
)
def test_a_shape_without_bounds_is_sought_where_the_data_are(origin, size):
    z = torch.linspace(0, 5, 60, dtype=F64)
    x, y = z * size + origin, 1 + 2 * z + 0.5 * torch.exp(-(((z - 3) / 0.5) ** 2)) + 0.05 * white(60, 0)
    model = tc.Simulator(
        lambda x, p: p["a"] + p["b"] * (x - origin) / size, [tc.Parameter("a"), tc.Parameter("b")]
    )
    bump = tc.Term(
        "bump",
        shifts={"a": lambda x, p: p["q"] * torch.exp(-(((x - p["x0"]) / (0.5 * size)) ** 2))},
        parameters=[tc.Parameter("q"), tc.Parameter("x0")],
    )
    d = diagnose(model, tc.Recording(x=x, y=y), [bump])
    assert d.terms == ["bump"]
    assert not any("no bounds" in row for row in d.identifiability)
    flat = diagnose(model, tc.Recording(x=x, y=1 + 2 * z + 0.05 * white(60, 0)), [bump])
    (told,) = [row for row in flat.identifiability if "bump.x0 has no bounds" in row]
    assert "was sought from" in told


def test_many_shapes_are_all_tried_at_several_values():
    parameters = [tc.Parameter(f"s{k}", low=1.0, high=2.0) for k in range(6)]
    problem = Problem.of(tc.Simulator(lambda x, p: x + p["s0"], parameters), tc.Recording(x=[0.0, 1.0], y=[1.0, 2.0]))
    grid = combined(points_of_shapes(problem, list(range(6)), {}, {}))
    assert len(grid) == 256
    for column in grid.T:
        values, counts = column.unique(return_counts=True)
        assert len(values) == 4
        assert int(counts.min()) > 40


# --- few replicates, and numbers of another type ----------------------------------------------------------------


@pytest.mark.parametrize("seed", [28, 34, 175])
def test_three_replicates_do_not_make_the_noise_known(seed):
    x = torch.linspace(0.1, 3, 30, dtype=F64)
    x = torch.cat([x, x[[3, 14, 25]]])
    y = 1 + 2 * x + 0.05 * white(33, seed)
    terms = [
        tc.Term(
            f"power {n}", outputs={"y": lambda x, p, y, n=n: y + p["q"] * x**n}, parameters=[tc.Parameter("q")]
        )
        for n in (2, 3)
    ]
    assert diagnose(line(), tc.Recording(x=x, y=y), terms).verdict == "consistent"


def test_numbers_of_any_type():
    x = torch.linspace(0, 3, 40, dtype=F64)
    recording = tc.Recording(x=x, y=1 + 2 * x + 0.05 * white(40, 0))
    d = diagnose(line(), recording, [], confidence=np.float32(0.99), holdout=np.float32(0.25))
    assert d.verdict == "consistent"
    with pytest.raises(tc.errors.DomainError, match="as a number"):
        diagnose(line(), recording, [], confidence=True)


# --- what is told of a range, and of an instrument ---------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_range_holds_the_data_that_it_is_told_by(seed):
    f, ph = (g.ravel() for g in np.meshgrid(np.linspace(0.2, 0.7, 9), np.arange(2.5, 8), indexing="ij"))
    model = tc.Simulator(lambda x, p: p["k"] - p["S"] * x["f"], [tc.Parameter("k"), tc.Parameter("S", low=0.0)])
    y = 6 - 8 * f + 0.2 * (ph == 4.5) + 0.03 * np.random.default_rng(seed).standard_normal(54)
    recording = tc.Recording(x={"f": f, "pH": ph}, y={"y": y}, noise=0.03)
    d = diagnose(model, recording, tc.terms.sensor(outputs=("y",), static=True))
    told = [row.region or row.note for row in d.ranking if row.probability > 0.01]
    ranges = [re.search(r"([\d.]+) < pH < ([\d.]+)", text) for text in told]
    assert any(ranges)
    assert all(float(found[1]) < 4.5 < float(found[2]) for found in ranges if found)


@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_jump_at_zero_is_no_instrument_that_saturates_below_all_data(seed):
    x = np.tile(np.linspace(-3, 3, 25), 2)
    model = tc.Simulator(
        lambda x, p: p["a"] * torch.tanh(x["x"] / p["w"]),
        [tc.Parameter("a", low=0.0, initial=1.0), tc.Parameter("w", low=0.05, initial=0.8)],
    )
    noise, true = 0.01 * np.random.default_rng(seed).standard_normal(50), np.tanh(x)
    terms = tc.terms.sensor(outputs=("y",), static=True)

    def verdict(y):
        return diagnose(model, tc.Recording(x={"x": x}, y={"y": y + noise}, noise=0.01), terms)

    assert verdict(true + 0.1 * np.sign(x)).verdict != "named"
    assert verdict(true - 0.5 * np.sign(x) * np.maximum(np.abs(true) - 0.6, 0)).terms == ["saturation of y"]


def fading(n, left, uneven=False):
    """How noise grows with a decay over ``n`` data; what a fit leaves is a function of times, decay and white noise."""
    t = np.linspace(0, 18, n)
    if uneven:
        t = np.sort(t + 0.3 * 18 / n * np.random.default_rng(1).uniform(-1, 1, n))
    f = 1500 * np.exp(-t / 3)
    e = np.random.default_rng(0).standard_normal(n)
    recording = tc.Recording(x=torch.as_tensor(t), y=torch.as_tensor(f))
    problem = Problem.of(tc.Simulator(lambda x, p: p["a"] + 0 * x, [tc.Parameter("a")]), recording)
    one = torch.ones(n, dtype=F64)
    return growth(problem, torch.as_tensor(left(t, f, e)), torch.ones(n, 1, dtype=F64), torch.as_tensor(f), one)


@pytest.mark.parametrize("uneven", [False, True])
@pytest.mark.parametrize("n", [60, 90])
def test_a_wave_that_fades_with_the_output_is_no_noise_that_grows_with_it(n, uneven):
    wave = fading(n, lambda t, f, e: 0.24 * f * np.sin(2 * np.pi * t / 1.9) + 12 * e, uneven)
    assert torch.equal(wave, torch.ones(n, dtype=F64))
    noise = fading(n, lambda t, f, e: 0.1 * f * e, uneven)
    assert noise.max() > 30 * noise.min()
    counts = fading(n, lambda t, f, e: np.sqrt(f) * e, uneven)
    assert 8 < counts.max() / counts.min() < 30  # the root of e^6 is 20


def test_noise_that_grows_is_told_of_few_data_and_of_short_runs():
    noise = fading(24, lambda t, f, e: 0.1 * f * e)
    assert noise.max() > 30 * noise.min()


def test_differences_taken_again_leave_white_noise_as_it_is_and_lose_waves():
    n = 4000
    t = torch.sort(torch.rand(n, dtype=F64)).values
    problem = Problem.of(tc.Simulator(lambda x, p: p["a"] + 0 * x, [tc.Parameter("a")]), tc.Recording(x=t, y=t))
    e = torch.randn(n, generator=torch.Generator().manual_seed(0), dtype=F64)
    one, (places,) = torch.ones(n, dtype=F64), problem.recorded_of(0)
    for times in (1, 3):
        left, inside = _fastest(problem, places, e, one[:, None], one, times)
        assert len(left) == len(e[inside]) == n - 2 * times
        assert abs(float(left.square().mean()) - 1) < 0.15
    even = Problem.of(tc.Simulator(lambda x, p: p["a"] + 0 * x, [tc.Parameter("a")]),
                      tc.Recording(x=torch.arange(n, dtype=F64), y=t))  # fmt: skip
    wave = torch.cos(2 * math.pi * torch.arange(n, dtype=F64) / 6)
    sizes = [float(_fastest(even, places, wave, one[:, None], one, times)[0].abs().max()) for times in (1, 3)]
    assert sizes == pytest.approx([1 / math.sqrt(6), 1 / math.sqrt(924)])  # of 1, -2, 1 and of binomials
