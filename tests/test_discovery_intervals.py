"""Intervals of estimates by the profile of χ², against a grid of values that are held one by one."""

import dataclasses
import math

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.records import Estimate
from torchcal.discovery.verdicts.intervals import FITS, JUMP, NEAR, SIDES, _End, by_profile

F64 = torch.float64
X = torch.linspace(0.1, 6, 40, dtype=F64)
K = 2


def uptake(x, p):
    return p["a"] + p["c"] * x / (x + p["K"])


def line(x, p):
    return p["a"] + p["c"] * x


def fitted(y, sd, model=uptake, truth=(1.0, 3.0, 4.0), **k):
    """The best fit, from the truth."""
    parameters = [tc.Parameter("a"), tc.Parameter("c")]
    if len(truth) > 2:
        parameters.append(tc.Parameter("K", **{"low": 0.01, "initial": 1.0} | k))
    problem = Problem.of(tc.Simulator(model, parameters), tc.Recording(x=X, y=y, noise=sd))
    whitening = problem.whitening(torch.full_like(y, sd), torch.zeros(1, dtype=F64))
    return fit(problem, whitening, torch.tensor([truth], dtype=F64), list(range(len(truth))))


def data(seed, sd=0.03, truth=(1.0, 3.0, 4.0)):
    a, c, k = truth
    noise = torch.randn(len(X), generator=torch.Generator().manual_seed(seed), dtype=F64)
    return a + c * X / (X + k) + sd * noise


def on_a_grid(y, sd, grid):
    """χ² at values of K that are held, the others by linear least squares."""
    x, y = X.numpy(), y.numpy()
    designs = (np.stack([np.ones_like(x), x / (x + k)], 1) for k in grid)
    return np.array([((y - a @ np.linalg.lstsq(a, y, rcond=None)[0]) ** 2).sum() / sd**2 for a in designs])


@pytest.mark.parametrize("scale", [{}, {"transform": "log"}])
@pytest.mark.parametrize("seed", range(3))
def test_ends_are_where_chi2_has_risen_enough(seed, scale):
    y = data(seed, 0.2)
    found = fitted(y, 0.2, **scale)
    low, high = by_profile(found, [K])[K]
    rise = on_a_grid(y, 0.2, [low, high]) - found.chi2
    assert rise == pytest.approx(SIDES**2, rel=0.05)
    value, sd = float(found.values[K]), float(found.sd()[K])
    assert high - value > 1.3 * SIDES * sd > SIDES * sd > value - low  # it is skewed, towards large values


def test_where_the_sd_tell_it_there_is_no_interval():
    y = 1.0 + 0.5 * X + 0.1 * torch.randn(40, generator=torch.Generator().manual_seed(1), dtype=F64)
    found = fitted(y, 0.1, line, (1.0, 0.5))
    assert by_profile(found, [0, 1]) == {}
    assert by_profile(fitted(data(0, 1e-3), 1e-3), [0, 1, K]) == {}  # so precise that the curve is straight


def test_an_end_on_a_bound_is_the_bound():
    y = data(0, 0.2)
    low, high = by_profile(fitted(y, 0.2), [K])[K]
    wall = 0.95 * high
    assert by_profile(fitted(y, 0.2, high=wall), [K])[K] == (pytest.approx(low), wall)


def test_an_end_that_the_data_leave_open_is_infinite():
    """Where a curve saturates far beyond the data it is nearly straight: any larger K will do."""
    truth = (1.0, 6.0, 25.0)
    y = data(2, 0.1, truth)
    found = fitted(y, 0.1, truth=truth)
    low, high = by_profile(found, [K])[K]
    assert on_a_grid(y, 0.1, [1e6])[0] - found.chi2 < SIDES**2
    assert math.isinf(high)
    assert on_a_grid(y, 0.1, [low])[0] - found.chi2 == pytest.approx(SIDES**2, rel=0.05)


@pytest.mark.parametrize("seed", [2, 6, 13, 16])
def test_a_fit_in_a_side_valley_is_no_end(seed):
    """Held far from the best, a fit may end with K on its bound, and all that begin there do so too."""
    truth = (1.0, 6.0, 15.0)
    y = data(seed, 0.3, truth)
    found = fitted(y, 0.3, truth=truth, low=0.01, high=20.0)
    low, high = by_profile(found, [1])[1]
    x, y = X.numpy(), y.numpy()
    shapes = x / (x + np.linspace(0.01, 20.0, 20001)[:, None])

    def rise(c):
        left = y - c * shapes
        return ((left - left.mean(1, keepdims=True)) ** 2).sum(1).min() / 0.09 - found.chi2

    assert rise(low) == pytest.approx(SIDES**2, rel=0.05)
    assert rise(high) == pytest.approx(SIDES**2, rel=0.05)


@pytest.mark.parametrize("seed", [1, 10, 11])
def test_an_end_that_another_valley_refutes_is_sought_farther(seed):
    """Of two decays the first may take the place of the second: fits from the best one do not see it."""

    def model(x, p):
        return p["a"] * torch.exp(-p["k"] * x) + p["b"] * torch.exp(-p["m"] * x)

    truth = {"a": 1.0, "k": 0.3, "b": 1.5, "m": 1.0}
    noise = 0.05 * torch.randn(40, generator=torch.Generator().manual_seed(seed), dtype=F64)
    y = model(X, {name: torch.tensor(value, dtype=F64) for name, value in truth.items()}) + noise
    parameters = [tc.Parameter(name, initial=value) for name, value in truth.items()]
    problem = Problem.of(tc.Simulator(model, parameters), tc.Recording(x=X, y=y, noise=0.05))
    whitening = problem.whitening(torch.full_like(y, 0.05), torch.zeros(1, dtype=F64))
    found = fit(problem, whitening, torch.tensor([[*truth.values()]], dtype=F64), [0, 1, 2, 3])
    rates = np.concatenate([np.linspace(-2, 0, 60), np.geomspace(0.01, 60, 500)])
    waves, data = np.exp(-rates[:, None] * X.numpy()), y.numpy()
    for end in by_profile(found, [2])[2]:
        left = data - end * waves  # the other decay at any rate, by linear least squares
        chi2 = (left**2).sum(1)[:, None] - (left @ waves.T) ** 2 / (waves**2).sum(1)
        assert math.sqrt(chi2.min() / 0.05**2 - found.chi2) == pytest.approx(SIDES, abs=0.1)


@pytest.mark.parametrize(
    ("rise", "where"),
    [
        (lambda away: 1.1 if away < 3.9 else 97.0, 3.9),
        (lambda away: 0.3 * away**0.5 if away < 11.0 else 5.0, 11.0),
        (lambda away: 2.5 * away**0.5, (SIDES / 2.5) ** 2),
        (lambda away: 0.2 * away**3, (SIDES / 0.2) ** (1 / 3)),
    ],
)
def test_an_end_is_found_where_the_rise_jumps_and_where_it_does_not(rise, where):
    none = torch.zeros(1)
    end = _End(1, 0.1, math.inf, none, none)
    count = 0
    while not end.ended and count < FITS:
        end.see(rise(end.away), none)
        count += 1
    assert end.ended
    assert end.distance == pytest.approx(where, rel=max(2 * JUMP, 2 * NEAR / SIDES))


def test_a_threshold_between_two_levels_lies_anywhere_between_them():
    """Only what it gives at the highest of four levels is seen: a later beginning and a steeper rise do the same."""
    levels = torch.tensor([2.0, 5.0, 8.0, 12.0], dtype=F64).repeat(10)
    noise = 0.002 * torch.randn(40, generator=torch.Generator().manual_seed(3), dtype=F64)
    y = 0.02 * (levels - 9).clamp_min(0) + noise
    model = tc.Simulator(
        lambda x, p: p["c"] * (x - p["s"]).clamp_min(0), [tc.Parameter("c", low=0.0), tc.Parameter("s", low=0.0)]
    )
    problem = Problem.of(model, tc.Recording(x=levels, y=y, noise=0.002))
    whitening = problem.whitening(torch.full_like(y, 0.002), torch.zeros(1, dtype=F64))
    found = fit(problem, whitening, torch.tensor([[0.015, 7.9]], dtype=F64), [0, 1])
    ends = by_profile(found, [0, 1])
    assert ends[1][0] < 8.0
    assert ends[1][1] > 11.5
    assert ends[0][1] > 0.1


def test_another_valley_may_leave_an_end_open():
    """A decay that is hardly seen is a slow one of any size too."""
    y = 1 + 0.5 * torch.exp(-1.5 * X) + 0.15 * torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=F64)
    model = tc.Simulator(
        lambda x, p: p["a"] + p["c"] * torch.exp(-p["k"] * x),
        [tc.Parameter("a"), tc.Parameter("c"), tc.Parameter("k", low=0.0, initial=1.0)],
    )
    problem = Problem.of(model, tc.Recording(x=X, y=y, noise=0.15))
    whitening = problem.whitening(torch.full_like(y, 0.15), torch.zeros(1, dtype=F64))
    found = fit(problem, whitening, torch.tensor([[1.0, 0.5, 1.5]], dtype=F64), [0, 1, 2])
    ends = by_profile(found, [1, 2])
    assert math.isinf(ends[1][1])  # on a grid of k χ² rises by 1.001 up to c = 10,000
    assert ends[2][0] == 0.0


def test_no_interval_is_told_of_a_fit_that_is_not_the_best_or_of_what_cannot_be_called():
    found, asked = fitted(data(0, 0.2), 0.2), []
    assert by_profile(found, [K])
    assert by_profile(dataclasses.replace(found, chi2=found.chi2 + 5.0), [K]) == {}  # it ends lower beside it

    def raising(x, p):
        asked.append(1)
        if len(asked) > 4:
            raise ValueError("no more")
        return uptake(x, p)

    model = tc.Simulator(raising, found.problem.parameters)
    problem = Problem.of(model, found.problem.recording)
    assert by_profile(dataclasses.replace(found, problem=problem), [1, K]) == {}
    assert by_profile(fitted(data(0, 0.2), 0.2), [1, K], stopped=lambda: True) == {}


def test_what_lies_at_a_bound_or_is_held_is_left_out():
    y = data(0, 0.1)
    found = fitted(y, 0.1, high=2.0)
    assert found.stuck == ["K"]
    assert by_profile(found, [K]) == {}


@pytest.mark.slow
def test_they_hold_the_truth_as_often_as_they_say():
    """Of 120 recordings; the standard deviations, of the same fits, do so less often."""
    truth, trials = (1.0, 3.0, 4.0), 120
    held = usual = 0
    for seed in range(trials):
        found = fitted(data(100 + seed, 0.2), 0.2)
        value, sd = float(found.values[K]), float(found.sd()[K])
        low, high = by_profile(found, [K]).get(K, (value - SIDES * sd, value + SIDES * sd))
        held += low <= truth[2] <= high
        usual += abs(value - truth[2]) <= SIDES * sd
    tolerance = 3.0 * math.sqrt(0.95 * 0.05 * trials)
    assert abs(held - 0.95 * trials) <= tolerance
    assert held > usual


def test_a_diagnosis_tells_them():
    term = tc.Term(
        "uptake",
        outputs={"y": lambda x, p, y: y + p["c"] * x / (x + p["K"])},
        parameters=[tc.Parameter("c"), tc.Parameter("K", low=0.01, high=200.0, initial=1.0)],
    )
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    diagnosis = tc.diagnose(base, tc.Recording(x=X, y=data(0, 0.1) + 0.5 * X, noise=0.1), [term], progress=False)
    assert diagnosis.verdict == "named"
    estimate = next(e for e in diagnosis.final.estimates if e.name == "uptake.K")
    assert estimate.interval is not None
    assert estimate.interval[0] < estimate.value < estimate.interval[1]
    assert str(estimate) in str(diagnosis)
    assert "95 %: " in str(estimate)
    assert all(e.interval is None for e in diagnosis.base.estimates)


def test_in_words():
    both = Estimate("drag.c", 2.744, 0.58, "1/m", interval=(1.963, 4.574))
    assert str(both) == "drag.c = 2.744 ± 0.58 1/m (95 %: 1.963 to 4.574)"
    assert str(Estimate("k", 2.0, 0.5, interval=(1.1, math.inf))) == "k = 2 ± 0.5 (95 %: above 1.1)"
    assert str(Estimate("k", 2.0, 0.5, interval=(-math.inf, 2.5))) == "k = 2 ± 0.5 (95 %: below 2.5)"
    assert str(Estimate("k", 2.0, math.inf, interval=(1.1, 4.5))) == "k = 2 (95 %: 1.1 to 4.5)"
    assert both.asymmetry == " (95 %: 1.963 to 4.574)"
