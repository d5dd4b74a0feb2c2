"""Least squares, whitening and simulated noise of a diagnosis, against scipy, Cholesky and what follows by hand."""

import dataclasses
import math
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

import torchcal as tc
from torchcal.discovery import conclude
from torchcal.discovery.fits.candidates import Candidate
from torchcal.discovery.fits.fitting import FINISH, finished, fit, refit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.starts import starts
from torchcal.discovery.hypotheses import base, refitting
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.discovery.misfit.noise import GRID, Noise
from torchcal.discovery.misfit.residual import Residual, _noise_draws
from torchcal.discovery.verdicts.explain import deeper
from torchcal.errors import ConvergenceWarning
from torchcal.simulators.dual import transformed

F64 = torch.float64


def draws(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def white(problem, sd):
    """Whitening of white noise of one sd."""
    recording = problem.recording
    return problem.whitening(torch.full_like(recording.y, sd), torch.zeros(len(recording.outputs), dtype=F64))


def solve(simulator, recording, sd=1.0, *, count=8, free=None, begin=None):
    problem = Problem.of(simulator, recording)
    free = list(range(len(problem.parameters))) if free is None else free
    begin = starts(problem, count, 0) if begin is None else torch.as_tensor(begin, dtype=F64)
    return fit(problem, white(problem, sd), begin, free)


def exponential(x, p):
    return p["a"] * torch.exp(-p["k"] * x) + p["b"]


def rational(x, p):
    return p["a"] * x / (p["K"] + x)


def wave(x, p):
    return p["a"] * torch.sin(p["w"] * x) * torch.exp(-p["c"] * x)


X = torch.linspace(0.1, 5, 40, dtype=F64)
#: Function, the same for numpy, parameters, truth, and where scipy starts.
PROBLEMS = {
    "exponential": (
        exponential,
        lambda x, a, k, b: a * np.exp(-k * x) + b,
        [tc.Parameter("a"), tc.Parameter("k", low=0.0, initial=1.0), tc.Parameter("b")],
        (2.0, 0.8, 0.5),
    ),
    "rational": (
        rational,
        lambda x, a, K: a * x / (K + x),
        [tc.Parameter("a", low=0.0), tc.Parameter("K", low=1e-6, transform="log", initial=1.0)],
        (3.0, 1.4),
    ),
    "wave": (
        wave,
        lambda x, a, w, c: a * np.sin(w * x) * np.exp(-c * x),
        [tc.Parameter("a"), tc.Parameter("w", low=0.5, high=4.0), tc.Parameter("c", low=0.0, initial=0.1)],
        (1.5, 2.2, 0.3),
    ),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_minimum_is_scipys(name):
    optimize = pytest.importorskip("scipy.optimize")
    function, plain, parameters, truth = PROBLEMS[name]
    y = torch.from_numpy(plain(X.numpy(), *truth)) + 0.05 * draws(40, seed=3)
    found = solve(tc.Simulator(function, parameters), tc.Recording(x=X, y=y), 0.05, count=12)
    wanted = optimize.least_squares(
        lambda v: (plain(X.numpy(), *v) - y.numpy()) / 0.05, truth, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    # χ² converges to a relative change of 1e-7; the estimates to the root of that in units of their sd.
    assert found.chi2 == pytest.approx(2 * wanted.cost, rel=1e-6)
    covariance = np.linalg.inv(wanted.jac.T @ wanted.jac)
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_array_less(np.abs(found.values.numpy() - wanted.x) / sd, 0.02)
    np.testing.assert_allclose(found.sd().numpy(), sd, rtol=0.02)
    np.testing.assert_allclose(found.covariance().numpy(), covariance, rtol=0.05, atol=0.02 * sd.min() ** 2)
    assert not bool(found.at_bound.any())


@pytest.mark.parametrize("name", PROBLEMS)
def test_many_starts_agree(name):
    function, plain, parameters, truth = PROBLEMS[name]
    y = torch.from_numpy(plain(X.numpy(), *truth)) + 0.05 * draws(40, seed=4)
    found = solve(tc.Simulator(function, parameters), tc.Recording(x=X, y=y), 0.05, count=12)
    assert found.ends.shape[1] == len(parameters)
    assert found.agreeing >= 0.25
    assert float(found.ends_chi2.min()) == pytest.approx(found.chi2)


@pytest.mark.parametrize(("low", "high", "wanted"), [(None, 1.0, 1.0), (3.0, None, 3.0), (2.5, 4.0, 2.5)])
def test_a_bound_that_the_data_want_to_cross(low, high, wanted):
    # y = a x + b with a = 2: the other parameter is then the mean of what is left.
    x = torch.linspace(-1, 2, 20, dtype=F64)
    y = 2.0 * x + 1.0 + 0.01 * draws(20)
    simulator = tc.Simulator(
        lambda x, p: p["a"] * x + p["b"], [tc.Parameter("a", low=low, high=high), tc.Parameter("b")]
    )
    found = solve(simulator, tc.Recording(x=x, y=y), 0.01)
    assert float(found.values[0]) == wanted
    assert found.at_bound.tolist() == [True, False]
    assert float(found.values[1]) == pytest.approx(float((y - wanted * x).mean()), abs=1e-6)


def test_a_bound_that_the_minimum_only_touches_is_no_symptom():
    x = torch.linspace(0, 1, 30, dtype=F64)
    simulator = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a", low=0.0)])
    found = solve(simulator, tc.Recording(x=x, y=1e-9 * x), 1.0)
    assert not bool(found.at_bound.any())
    # An estimate one sd beyond the bound is what noise alone gives.
    size = 1.0 / float(x.square().sum().sqrt())
    found = solve(simulator, tc.Recording(x=x, y=-1.0 * size * x), 1.0)
    assert float(found.values[0]) == 0.0
    assert not bool(found.at_bound.any())


def test_bounds_hold_at_every_start_and_end():
    simulator = tc.Simulator(wave, [tc.Parameter("a", low=-1.0, high=1.0), tc.Parameter("w", low=1.0, high=2.0),
                                    tc.Parameter("c", low=0.0, high=0.1)])  # fmt: skip
    y = 1.5 * torch.sin(2.2 * X) * torch.exp(-0.3 * X)
    found = solve(simulator, tc.Recording(x=X, y=y), 0.05, begin=20 * draws(10, 3))
    low, high = torch.tensor([-1.0, 1.0, 0.0], dtype=F64), torch.tensor([1.0, 2.0, 0.1], dtype=F64)
    assert bool(((found.ends >= low) & (found.ends <= high)).all())


def test_the_logarithm_does_not_change_the_minimum():
    x = torch.linspace(0, 3, 30, dtype=F64)
    y = 1.3 * torch.exp(-0.4 * x) + 0.01 * draws(30)
    fits = []
    for transform in (None, "log"):
        simulator = tc.Simulator(
            lambda x, p: p["a"] * torch.exp(-p["k"] * x),
            [tc.Parameter("a", low=1e-6, initial=1.0), tc.Parameter("k", low=1e-9, transform=transform, initial=0.5)],
        )
        fits.append(solve(simulator, tc.Recording(x=x, y=y), 0.01))
    assert fits[0].chi2 == pytest.approx(fits[1].chi2, rel=1e-6)
    torch.testing.assert_close(fits[0].values, fits[1].values, rtol=1e-4, atol=0)
    torch.testing.assert_close(fits[0].sd(), fits[1].sd(), rtol=1e-3, atol=0)


def test_the_logarithm_crosses_decades():
    # From 1 down to 1e-5 for a rate whose tangent is nearly flat at the start.
    x = torch.linspace(0, 1e5, 50, dtype=F64)
    y = torch.exp(-1e-5 * x) + 1e-3 * draws(50)
    simulator = tc.Simulator(
        lambda x, p: torch.exp(-p["k"] * x), [tc.Parameter("k", low=1e-12, transform="log", initial=1e-3)]
    )
    found = solve(simulator, tc.Recording(x=x, y=y), 1e-3)
    assert float(found.values[0]) == pytest.approx(1e-5, rel=5e-3)


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_units_do_not_matter(scale):
    x = torch.linspace(0, 3, 30, dtype=F64)
    y = scale * (torch.exp(-0.4 * x) + 0.01 * draws(30))
    simulator = tc.Simulator(
        lambda x, p: p["a"] * torch.exp(-p["k"] * x / scale),
        [tc.Parameter("a", low=0.0, initial=0.7 * scale), tc.Parameter("k", low=0.0, initial=1.0 * scale)],
    )
    found = solve(simulator, tc.Recording(x=x, y=y), 0.01 * scale)
    assert float(found.values[1]) / scale == pytest.approx(0.4, abs=0.03)
    assert found.chi2 == pytest.approx(28.0, abs=5 * math.sqrt(56))


def test_a_direction_that_the_data_do_not_tell():
    # Only a + b enters: its variance is that of a mean, the other direction's is huge, and nothing is NaN.
    x = torch.linspace(0, 1, 25, dtype=F64)
    simulator = tc.Simulator(
        lambda x, p: p["a"] + p["b"] + p["c"] * (x - 0.5), [tc.Parameter(name) for name in ("a", "b", "c")]
    )
    found = solve(simulator, tc.Recording(x=x, y=1.0 + 0.1 * draws(25)), 0.1)
    assert bool(torch.isfinite(found.values).all())
    assert float(found.values[0] + found.values[1]) == pytest.approx(float((0.1 * draws(25)).mean()) + 1.0, abs=1e-5)
    covariance = found.covariance()
    ones = torch.tensor([1.0, 1.0, 0.0], dtype=F64)
    assert float(ones @ covariance @ ones) == pytest.approx(0.1**2 / 25, rel=1e-2)
    assert float(found.sd()[0]) > 1e3
    assert float(found.sd()[2]) == pytest.approx(0.1 / float((x - 0.5).norm()), rel=1e-6)


def test_a_parameter_without_effect_stays_where_it_was():
    simulator = tc.Simulator(lambda x, p: p["a"] * x + 0.0 * p["b"], [tc.Parameter("a"), tc.Parameter("b")])
    found = solve(simulator, tc.Recording(x=X, y=2 * X), 0.1, begin=[[1.0, 7.0]])
    assert found.values.tolist() == pytest.approx([2.0, 7.0])


def test_held_parameters_stay():
    simulator = tc.Simulator(lambda x, p: p["a"] * x + p["b"], [tc.Parameter("a"), tc.Parameter("b")])
    found = solve(simulator, tc.Recording(x=X, y=2 * X + 1), 0.1, free=[0], begin=[[0.0, 0.5]])
    assert float(found.values[1]) == 0.5
    assert float(found.sd()[1]) == 0.0
    assert float(found.values[0]) == pytest.approx(float(((2 * X + 0.5) * X).sum() / X.square().sum()))


def test_starts_without_a_finite_output_are_left_out():
    def root(x, p):
        return torch.sqrt(p["a"] - x)

    x = torch.linspace(0, 1, 20, dtype=F64)
    recording = tc.Recording(x=x, y=torch.sqrt(2.0 - x))
    simulator = tc.Simulator(root, [tc.Parameter("a")])
    found = solve(simulator, recording, 0.01, begin=[[-1.0], [3.0], [0.5]])
    assert float(found.values[0]) == pytest.approx(2.0, abs=1e-4)
    assert solve(simulator, recording, 0.01, begin=[[-1.0], [0.5]]) is None


def test_starting_values_are_reproducible_and_within_bounds():
    simulator = tc.Simulator(
        lambda x, p: x, [tc.Parameter("a", low=1.0, high=2.0), tc.Parameter("b", low=0.0, initial=3.0),
                         tc.Parameter("c"), tc.Parameter("d", low=1e-3, high=1e3, transform="log")]
    )  # fmt: skip
    problem = Problem.of(simulator, tc.Recording(x=X, y=X))
    first, again, other = (starts(problem, 16, seed) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert float(first[0, 1]) == 3.0
    assert bool(((first[:, 0] >= 1) & (first[:, 0] <= 2) & (first[:, 1] >= 0) & (first[:, 3] >= 1e-3)).all())
    assert float(starts(problem, 4, 0, {2: 5.0})[3, 2]) == 5.0


def oscillator(n=60):
    time = torch.linspace(0, 12, n, dtype=F64)
    simulator = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"]},
        {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, initial=1.0), tc.Parameter("c", low=0.0, initial=0.2)],
        observe=("x",),
    )
    return simulator, time


def test_a_trajectory_fit_is_the_closed_form():
    optimize = pytest.importorskip("scipy.optimize")
    simulator, time = oscillator()

    def closed(p):
        k, c, x0, v0 = p
        w = np.sqrt(k - c * c / 4)
        t = time.numpy()
        return np.exp(-c * t / 2) * (x0 * np.cos(w * t) + (v0 + c * x0 / 2) / w * np.sin(w * t))

    y = closed((1.3, 0.15, 1.0, 0.2)) + 0.02 * draws(60, seed=1).numpy()
    recording = tc.Recording(runs=[tc.Run(time, outputs={"x": y})])
    found = solve(simulator, recording, 0.02, begin=[[1.2, 0.1, 1.0, 0.0]])
    wanted = optimize.least_squares(lambda p: (closed(p) - y) / 0.02, (1.3, 0.15, 1.0, 0.2), xtol=1e-12, ftol=1e-12)
    # The solver's steps leave an error of a few 1e-5 in x at the default length.
    assert found.chi2 == pytest.approx(2 * wanted.cost, rel=1e-2)
    np.testing.assert_allclose(found.values.numpy(), wanted.x, atol=3e-3)


def test_refit_to_part_of_the_data():
    simulator = tc.Simulator(lambda x, p: p["a"] * x + p["b"], [tc.Parameter("a"), tc.Parameter("b")])
    y = torch.where(X < 2.5, X, 3 * X - 5)
    recording = tc.Recording(x=X, y=y)
    found = solve(simulator, recording, 0.1)
    part = found.problem.keeping(X < 2.5)
    again = refit(found, white(part, 0.1), part)
    assert again.values.tolist() == pytest.approx([1.0, 0.0], abs=1e-5)


# --- whitening ------------------------------------------------------------------------------------------------


def dense(time, sd, phi, usual):
    """Covariance of AR(1) noise sampled at given times."""
    gap = (time[:, None] - time[None, :]).abs() / usual
    return sd[:, None] * phi**gap * sd[None, :]


@pytest.mark.parametrize("phi", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("even", [True, False])
def test_whitening_is_choleskys(phi, even):
    n = 25
    time = torch.arange(n, dtype=F64) if even else torch.rand(n, generator=torch.Generator().manual_seed(2)).double()
    time = time if even else (0.2 + time).cumsum(0)
    simulator, _ = oscillator()
    recording = tc.Recording(runs=[tc.Run(time, outputs={"x": draws(n)})])
    problem = Problem.of(simulator, recording)
    sd = 0.5 + torch.rand(n, generator=torch.Generator().manual_seed(1)).double()
    w = problem.whitening(sd, torch.tensor([phi], dtype=F64))
    usual = float(time.diff().median())
    covariance = dense(time, sd, phi, usual) if phi else torch.diag(sd.square())
    r = draws(n, 3, seed=5)
    factor = torch.linalg.cholesky(covariance)
    wanted = torch.linalg.solve_triangular(factor, r, upper=False)
    torch.testing.assert_close(w(r), wanted, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(w.vector(r[:, 0]), wanted[:, 0], rtol=1e-9, atol=1e-9)


def test_runs_and_outputs_are_whitened_apart():
    time = torch.arange(10, dtype=F64)
    simulator, _ = oscillator()
    simulator = tc.ODESimulator(simulator.rates, simulator.states, simulator.parameters)
    y = draws(4, 10)
    y[1, 3] = math.nan
    recording = tc.Recording(
        runs=[tc.Run(time, outputs={"x": y[0], "v": y[1]}), tc.Run(time, outputs={"x": y[2], "v": y[3]})], missing=True
    )
    problem = Problem.of(simulator, recording)
    assert problem.n == 39
    phi = torch.tensor([0.5, 0.8], dtype=F64)
    sd = torch.full((40,), 2.0, dtype=F64)
    r = draws(39, 1, seed=6)
    found = problem.whitening(sd, phi)(r)[:, 0]
    blocks = []
    for name, rho in (("x", 0.5), ("v", 0.8)):
        for run in (0, 1):
            kept = [k for k in range(10) if not (name == "v" and run == 0 and k == 3)]
            blocks.append(dense(time[kept], torch.full((len(kept),), 2.0, dtype=F64), rho, 1.0))
    covariance = torch.block_diag(*blocks)
    wanted = torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), r, upper=False)[:, 0]
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)


def test_static_noise_is_correlated_in_the_order_of_recording():
    x = torch.tensor([0.0, 3.0, 1.0, 2.0], dtype=F64)
    simulator = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")])
    problem = Problem.of(simulator, tc.Recording(x=x, y=x))
    w = problem.whitening(torch.ones(4, dtype=F64), torch.tensor([0.6], dtype=F64))
    r = draws(4, seed=1)
    torch.testing.assert_close(w.vector(r)[1:], (r[1:] - 0.6 * r[:-1]) / 0.8, rtol=1e-12, atol=0)


# --- simulated residuals ------------------------------------------------------------------------------------


def line(n, noise=1.0):
    x = torch.linspace(0, 1, n, dtype=F64)
    simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    return solve(simulator, tc.Recording(x=x, y=x + noise * draws(n)), 1.0)


def noise_model(n, phi=0.0, freedom=math.inf):
    posterior = torch.zeros(1, len(GRID), dtype=F64)
    posterior[0, int((GRID - phi).abs().argmin())] = 1.0
    sizes = torch.ones_like(posterior)
    told = torch.tensor([freedom], dtype=F64)
    return Noise(torch.ones(n, dtype=F64), torch.tensor([phi], dtype=F64), told, posterior, "estimated", sizes)


def test_simulated_noise_is_white_where_noise_is():
    e = _noise_draws(line(30), noise_model(30), 4000, 0)
    assert e.shape == (30, 4000)
    # sd of a variance of 120 000 draws: √(2/120000) = 0.004; of a mean 0.003; five of each.
    assert float(e.mean()) == pytest.approx(0.0, abs=0.015)
    assert float(e.var()) == pytest.approx(1.0, abs=0.02)
    torch.testing.assert_close(e @ e.T / 4000, torch.eye(30, dtype=F64), rtol=0, atol=5 * math.sqrt(2 / 4000))


def test_simulated_correlated_noise_is_white_once_whitened():
    found = line(30)
    noise = noise_model(30, 0.6)
    found = refit(found, noise.whitening(found.problem))
    e = _noise_draws(found, noise, 4000, 0)
    torch.testing.assert_close(e @ e.T / 4000, torch.eye(30, dtype=F64), rtol=0, atol=5 * math.sqrt(2 / 4000))


def test_a_size_from_few_data_widens_the_tails():
    # Student's t with 5 degrees of freedom has the variance 5/3.
    e = _noise_draws(line(30), noise_model(30, freedom=5.0), 20000, 0)[0]
    assert float(e.var()) == pytest.approx(5 / 3, abs=0.15)
    assert float((e.abs() > 3).double().mean()) == pytest.approx(0.0301, abs=5 * math.sqrt(0.03 / 20000))


def test_simulated_noise_is_reproducible_and_leaves_the_global_state_alone():
    found, noise = line(20), noise_model(20, freedom=8.0)
    before = torch.random.get_rng_state()
    one, two, three = (_noise_draws(found, noise, 50, seed) for seed in (1, 1, 2))
    assert torch.equal(before, torch.random.get_rng_state())
    assert torch.equal(one, two)
    assert not torch.equal(one, three)


def test_projection_takes_the_tangents_away():
    found = line(25, noise=0.3)
    residual = Residual(found, noise_model(25))
    tangents = torch.stack([torch.ones(25, dtype=F64), found.problem.recording.x], dim=-1)
    torch.testing.assert_close(residual.project(tangents), torch.zeros(25, 2, dtype=F64), rtol=0, atol=1e-12)
    assert residual.freedom == 23
    # The fit is a least-squares fit: its residual is orthogonal to the tangents already.
    torch.testing.assert_close(residual.e, found.residual, rtol=0, atol=1e-6)
    assert float((tangents.T @ residual.null).abs().max()) < 1e-10


@pytest.mark.parametrize(("low", "high"), [(-0.05, 0.05), (-0.1, 0.1), (0.0, None)])
@pytest.mark.parametrize("start", [0.0, 0.03])
def test_a_bound_beside_a_nearly_parallel_tangent(low, high, start):
    optimize = pytest.importorskip("scipy.optimize")
    x = torch.linspace(0, 1, 40, dtype=F64)
    y = x - 0.2 * x**3 + 0.01 * draws(40)
    simulator = tc.Simulator(
        lambda x, p: p["k"] * x + p["c"] * x**3, [tc.Parameter("k"), tc.Parameter("c", low=low, high=high)]
    )
    found = solve(simulator, tc.Recording(x=x, y=y), 0.01, begin=[[0.85, start]])
    wanted = optimize.lsq_linear(
        torch.stack([x, x**3], 1).numpy() / 0.01,
        y.numpy() / 0.01,
        bounds=([-1e9, low], [1e9, 1e9 if high is None else high]),
    )
    assert found.chi2 == pytest.approx(2 * wanted.cost, rel=1e-6)
    assert found.at_bound.tolist() == [False, True]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_unknown_velocities_under_much_noise(star, seed):
    """One and a half orbits: the slope of the first few positions is noise, and a wrong one leads to another orbit."""
    t = torch.linspace(0, 6.6, 154, dtype=F64)
    blank = torch.zeros(154, dtype=F64)
    known = {"x": 0.17, "y": -0.79, "vx": 1.19, "vy": 0.26}
    orbit = star.bind(tc.Recording(runs=[tc.Run(time=t, outputs={"x": blank, "y": blank}, initial=known)]))
    clean = orbit.at(orbit.x)(torch.tensor([0.9], dtype=F64)).reshape(2, -1)
    noisy = clean + 0.07 * draws(2, 154, seed=seed)
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"x": noisy[0], "y": noisy[1]})], noise=0.07)
    base, _ = calibrate_base(Problem.of(star, recording), {}, 12, 0)
    assert base.chi2 < 308 + 5 * math.sqrt(2 * 308)


def valley(steep):
    """A bent valley, (1 − a)² + steep² (b − a²)², at its far end."""

    def bent(x, p):
        return torch.where(x < 1, steep * (p["b"] - p["a"] ** 2), torch.where(x < 2, 1 - p["a"], 0 * x))

    x = torch.arange(4.0, dtype=F64)
    return Problem.of(
        tc.Simulator(bent, [tc.Parameter("a"), tc.Parameter("b")]), tc.Recording(x=x, y=0 * x, noise=1.0)
    )


@pytest.fixture
def linearised(monkeypatch):
    """How often slopes were worked out, in a list of one."""
    count, plain = [0], Problem.evaluate

    def counted(self, values, free, *args, **options):
        count[0] += bool(free)
        return plain(self, values, free, *args, **options)

    monkeypatch.setattr(Problem, "evaluate", counted)
    return count


def test_a_step_that_bends_with_its_valley_is_taken_less_often(linearised):
    problem, taken = valley(1000.0), []
    for bend in (False, True):
        linearised[0] = 0
        found = fit(problem, white(problem, 1.0), torch.tensor([[-1.2, 1.0]], dtype=F64), [0, 1], max_steps=600,
                    finish=0, bend=bend)  # fmt: skip
        assert found.values.tolist() == pytest.approx([1.0, 1.0], abs=1e-6)
        taken.append(linearised[0])
    assert 2.5 * taken[1] < taken[0]


@pytest.mark.parametrize(("aim", "early"), [(np.inf, False), (40.0, False), (1.0, True)])
def test_a_fit_ends_early_where_its_pace_does_not_lead_to_where_it_is_wanted(linearised, aim, early):
    problem = valley(10000.0)
    found = fit(problem, white(problem, 1.0), torch.tensor([[-6.0, 36.001]], dtype=F64), [0, 1], max_steps=60,
                finish=40, aim=aim)  # fmt: skip
    assert (found.chi2 > 45.0) is early
    assert (linearised[0] < 30) is early


@pytest.mark.slow
def test_a_fit_that_is_to_be_finished_later_is_not_ended_for_the_steps_that_come_then():
    problem = valley(1000.0)
    begin, free = torch.tensor([[-30.0, 901.0]], dtype=F64), [0, 1]
    whole = fit(problem, white(problem, 1.0), begin, free, aim=480.5)
    first = fit(problem, white(problem, 1.0), begin, free, aim=480.5, finish=0, later=FINISH)
    assert first.leads_to(480.5)
    assert finished(first, 480.5).chi2 == pytest.approx(whole.chi2, rel=1e-3)
    assert whole.chi2 < 480.5 < first.chi2
    assert not first.leads_to(-1e9)
    assert finished(first, -1e9) is first
    assert finished(finished(first), 0.0).falling == 0.0


def test_a_look_ahead_goes_no_farther_than_steps_do_along_a_flat_logarithm():
    farthest = [0.0]

    def flat(x, p):
        if not transformed(p["k"]):
            farthest[0] = max(farthest[0], float(forward_ad.unpack_dual(p["k"]).primal.abs().max()))
        bent = torch.where(x < 1, 1000.0 * (p["b"] - p["a"] ** 2), torch.where(x < 2, 1 - p["a"], 0 * x))
        return torch.where(x == 2, p["k"] / (1 + p["k"]), bent)

    x = torch.arange(6.0, dtype=F64)
    simulator = tc.Simulator(flat, [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("k", transform="log")])
    problem = Problem.of(simulator, tc.Recording(x=x, y=2.0 * (x == 2), noise=1.0))
    reached = []
    for bend in (False, True):
        farthest[0] = 0.0
        found = fit(problem, white(problem, 1.0), torch.tensor([[-1.2, 1.0, 1e4]], dtype=F64), [0, 1, 2], max_steps=25,
                    finish=0, bend=bend)  # fmt: skip
        assert math.isfinite(found.chi2)
        reached.append(math.log(farthest[0] / 1e4))
    assert max(reached) <= 2.0 * 26


def test_what_is_named_is_told_at_its_lowest_minimum():
    """A sine whose frequency was found in another minimum than the lowest."""
    x = torch.linspace(0, 6, 80, dtype=F64)
    parameters = [tc.Parameter("w", low=0.5, high=6.0, initial=2.0), tc.Parameter("b")]
    wave = tc.Simulator(lambda x, p: torch.sin(p["w"] * x) + p["b"] * x, parameters)
    recording = tc.Recording(x=x, y=torch.sin(2.0 * x) + 0.3 * x + 0.1 * draws(1, 80, seed=3)[0], noise=0.1)
    problem = Problem.of(wave, recording)
    whitening = problem.whitening(recording.noise, torch.zeros(1, dtype=F64))

    def search():
        return SimpleNamespace(exact=False, seed=0, from_guesses=lambda found, begin, steps: fit(
            problem, whitening, begin, found.free, max_steps=steps, finish=0))  # fmt: skip

    def named(w):
        found = fit(problem, whitening, torch.tensor([[w, 0.3]], dtype=F64), [0, 1])
        candidate = Candidate((), problem, [0, 1], [1], [1], *torch.zeros(4, 1, dtype=F64))
        return SimpleNamespace(found=found, candidate=candidate, window=None)

    astray, right = named(4.6), named(2.1)
    assert astray.found.chi2 > right.found.chi2 + 100
    assert deeper(search(), right) is None
    assert deeper(search(), astray).chi2 == pytest.approx(right.found.chi2, abs=1e-3)
    # A bound that it had run to is no place to stay; to run to one is no way to get lower.
    astray.found = dataclasses.replace(astray.found, at_bound=torch.tensor([True, False]))
    assert deeper(search(), astray).chi2 == pytest.approx(right.found.chi2, abs=1e-3)


@pytest.mark.parametrize(("error", "looked"), [(0.1, False), (2.0, True)])
def test_what_shorter_steps_cannot_bring_to_the_best_is_not_refitted_with_them(monkeypatch, error, looked):
    """Of 40 data with residuals of 3 sd each, where another model leaves those of 1 sd."""
    line = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")])
    problem = Problem.of(line, tc.Recording(x=torch.linspace(0, 1, 40, dtype=F64), y=torch.zeros(40), noise=1.0))
    whitening = white(problem, 1.0)
    coarse = SimpleNamespace(chi2=360.0, y=problem.y, problem=problem, whitening=whitening)
    searched = SimpleNamespace(exact=False, noise=SimpleNamespace(sd=torch.ones(40, dtype=F64)))
    monkeypatch.setattr(refitting, "accurate", lambda found, sd: False)
    monkeypatch.setattr(refitting, "halved", lambda found: found.y + error)
    monkeypatch.setattr(refitting, "sharpen", lambda *given, **options: ("finer", 0.0))
    found = refitting._in_short_steps(searched, coarse, 40.0)
    assert (found == "finer") is looked
    assert refitting._in_short_steps(searched, coarse, math.inf) == "finer"


@pytest.mark.parametrize(
    ("numbers", "gain", "window", "sharpened"),
    [
        ((0,), 35.0, None, True), ((0,), 25.0, None, False),  # half of 100, less what noise may change
        ((0, 1), 85.0, None, True), ((0, 1), 75.0, None, False), ((0,), 99.0, "t > 3", False),
    ],
)  # fmt: skip
def test_steps_are_looked_at_of_what_may_matter_beside_the_best(monkeypatch, numbers, gain, window, sharpened):
    """Of refits with more room for a shape as of all others."""
    asked = []
    monkeypatch.setattr(refitting, "_in_short_steps", lambda search, found, wanted: asked.append(wanted) or "finer")
    searched = SimpleNamespace(gain=lambda chi2: 0.5 * (1000.0 - chi2), base=SimpleNamespace(chi2=1000.0))
    one, fitted = SimpleNamespace(numbers=numbers, window=window), SimpleNamespace(chi2=1000.0 - 2 * gain)
    found = refitting._sharp_enough(searched, one, fitted, 100.0)
    assert (found == "finer") is sharpened
    assert asked == ([840.0] if sharpened else [])


# --- initial states that outputs are functions of ------------------------------------------------------------------


def logged(runs=6, *, outputs=("L",), seed=0):
    """Amounts that decay, of which a logarithm is recorded, or what an instrument of unknown gain shows of them."""
    t = torch.linspace(0, 4, 12, dtype=F64)
    each = []
    for i in range(runs):
        c = 60.0 * (i + 1) * torch.exp(-0.9 * t)
        shown = {"L": c.log() + 0.05 * draws(12, seed=seed + i), "A": 0.02 * c + 0.01 * draws(12, seed=90 + seed + i)}
        each.append(tc.Run(t, {name: shown[name] for name in outputs}))
    seen = {"L": lambda t, s, p, u: torch.log(s["c"]), "A": lambda t, s, p, u: p["gain"] * s["c"]}
    parameters = [tc.Parameter("k", low=0.0, initial=1.0)]
    if "A" in outputs:
        parameters.append(tc.Parameter("gain", low=0.0, initial=0.01))
    base = tc.ODESimulator(lambda t, s, p, u: {"c": -p["k"] * s["c"]}, {"c": "mg/L"}, parameters,
                           observe={name: seen[name] for name in outputs})  # fmt: skip
    return base, tc.Recording(runs=each)


@pytest.mark.parametrize("outputs", [("L",), ("A",), ("L", "A")])
def test_every_second_start_begins_where_the_outputs_do(outputs):
    base, recording = logged(outputs=outputs)
    problem = Problem.of(base, recording)
    values = starts(problem, 8, 0)
    bound = problem.simulator
    shown = bound.readings(values, bound.layout.start(values)).reshape(8, len(outputs), -1)
    first, spread = (values.reshape(len(outputs), 6, 12)[..., 0] for values in (recording.y, recording.spread))
    off = (shown.reshape(8, len(outputs), 6, 12)[..., 0] - first) / spread
    assert float(off[1::2].abs().max()) < (0.05 if len(outputs) == 1 else 2.0)


def test_what_is_held_or_read_already_is_not_moved():
    base, recording = logged()
    problem = Problem.of(base, recording)
    place = next(i for i, q in enumerate(problem.parameters) if q.name == "c(0)[2]")
    assert starts(problem, 8, 0, {place: 3.0})[:, place].tolist() == [3.0] * 8
    read = tc.ODESimulator(lambda t, s, p, u: {"c": -p["k"] * s["c"]}, {"c": "mg/L"}, [tc.Parameter("k", low=0.0)])
    t = torch.linspace(0, 4, 12, dtype=F64)
    problem = Problem.of(read, tc.Recording(runs=[tc.Run(t, {"c": torch.exp(-t)})]))
    assert starts(problem, 8, 0)[0, -1] == pytest.approx(1.0)


def test_outputs_that_raise_and_readings_that_are_not_used_move_no_start():
    base, recording = logged(2)

    def shown(t, s, p, u):
        if bool((s["c"].abs() > 500).any()):
            raise ValueError("outside the calibrated range")
        return s["c"].clamp(1e-3).log()

    narrow = tc.ODESimulator(base.rates, base.states, [tc.Parameter("k", low=0.0)], observe={"L": shown})
    problem = Problem.of(narrow, recording)
    moved = starts(problem, 8, 0)[1::2, -2:]
    assert moved.tolist() == [pytest.approx([60.0, 120.0], rel=0.2)] * 4  # the sizes that it does not raise for
    problem = Problem.of(base, recording)
    used = problem.keeping(torch.tensor([0] * 12 + [1] * 12).bool())
    assert starts(used, 8, 0)[1::2, -2:].tolist() == [[pytest.approx(v, abs=9), pytest.approx(120.0, rel=0.2)]
                                                     for v in starts(used, 8, 0)[1::2, -2].tolist()]  # fmt: skip
    assert float(starts(used, 8, 0)[:, -2].abs().max()) < 9.0


def test_a_base_whose_outputs_are_logarithms_of_unknown_amounts_is_consistent():
    base, recording = logged()
    d = tc.diagnose(base, recording, [], progress=False)
    assert d.verdict == "consistent"
    k = next(e for e in d.base.estimates if e.name == "k")
    assert abs(k.value - 0.9) < 4 * k.sd < 0.1


def decays(rates, sizes=(100.0, 90.0, 150.0, 120.0), stiff=None, source=False):
    """Runs of a decay with a rate and an unknown beginning of their own, and a source that all share, of nothing."""
    t = torch.tensor([0.0, 10, 15, 20, 30, 45, 60, 90, 120, 180, 240, 300, 360], dtype=F64)
    generator = torch.Generator().manual_seed(0)
    runs = []
    for k, size in zip(rates, sizes, strict=True):
        y = size * torch.exp(-k * t) * (1 + 0.02 * torch.randn(13, generator=generator, dtype=F64))
        runs.append(tc.Run(time=t, outputs={"c": torch.where(t > 0, y, math.nan)}))
    model = tc.ODESimulator(
        rates=lambda t, s, p, u: {"c": p["b"] - p["k"] * s["c"]},
        states={"c": "mg/L"},
        parameters=[tc.Parameter("k", low=0.0, high=50.0, initial=1.0, per_run=True),
                    tc.Parameter("b", neutral=None if source else 0.0, initial=0.0)],
        stiff=stiff,
    )
    return model, tc.Recording(runs=runs, missing=True)


def test_each_run_goes_on_from_where_it_fits_best():
    # From an initial value that is 20 to 50 times too fast hardly a start finds the right rates of all runs.
    true = (0.058, 0.047, 0.036, 0.02)
    model, recording = decays(true, source=True)
    found, _ = calibrate_base(Problem.of(model, recording), {}, 16, 0)
    assert torch.allclose(found.values[:4], torch.tensor(true, dtype=F64), rtol=0.15)
    assert torch.allclose(found.values[5:], torch.tensor([100.0, 90.0, 150.0, 120.0], dtype=F64), rtol=0.15)


#: Places of the decays' parameters but for the source.
FREE = [0, 1, 2, 3, 5, 6, 7, 8]


def test_runs_are_not_crossed_where_one_start_is_best_in_all_of_them(monkeypatch):
    model, recording = decays((0.058, 0.047, 0.036, 0.02), stiff=True)
    problem = Problem.of(model, recording)
    true = torch.tensor([[0.058, 0.047, 0.036, 0.02, 0.0, 100.0, 90.0, 150.0, 120.0]], dtype=F64)
    bad = true.clone()
    bad[:, 1] = 40.0
    found = fit(problem, white(problem, 1.0), torch.cat([true, bad]), FREE)
    assert found.ends_chi2.amax() > 10 * found.chi2
    monkeypatch.setattr(base, "fit", None)
    assert base._best_of_each_run(found) is found
    one = dataclasses.replace(found, ends=None, ends_chi2=None)
    assert base._best_of_each_run(one) is one


def test_runs_are_crossed_from_two_starts_that_are_each_wrong_in_one_of_them():
    model, recording = decays((0.058, 0.047, 0.036, 0.02), stiff=True)
    problem = Problem.of(model, recording)
    begin = torch.tensor([[0.058, 0.047, 0.036, 0.02, 0.0, 100.0, 90.0, 150.0, 120.0]], dtype=F64).repeat(2, 1)
    begin[0, 1], begin[1, 3] = 40.0, 40.0
    found = fit(problem, white(problem, 1.0), begin, FREE, max_steps=0, finish=0)
    assert float(found.chi2) > 1000
    again = base._best_of_each_run(found)
    assert again.chi2 < 100
    assert torch.allclose(again.values[:4], torch.tensor([0.058, 0.047, 0.036, 0.02], dtype=F64), rtol=0.1)


@pytest.mark.parametrize(("w", "alike"), [(17.0, False), (0.9, True)])
def test_more_starts_are_tried_and_told_where_few_come_to_the_best_fit(w, alike):
    x = torch.linspace(0, 3, 60, dtype=F64)
    y = 1.3 * torch.sin(w * x + 0.4) + 0.02 * draws(60)
    model = tc.Simulator(
        lambda x, p: p["a"] * torch.sin(p["w"] * x + p["phase"]),
        [tc.Parameter("a", low=0.0, high=5.0), tc.Parameter("w", low=0.1, high=2.0 if alike else 60.0),
         tc.Parameter("phase", low=-3.2, high=3.2)],
    )  # fmt: skip
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        d = tc.diagnose(model, tc.Recording(x=x, y=y, noise=0.02), [], seed=0, progress=False)
    assert d.verdict == "consistent"
    assert d.base.estimates[1].value == pytest.approx(w, rel=0.02)
    assert any("of the base's starting values came to the best fit" in str(one.message) for one in told) is not alike


@pytest.mark.parametrize("high", [None, 2.0])
def test_what_is_bounded_already_is_not_told_to_be_given_bounds(high):
    parameters = [tc.Parameter("a", low=0.0, high=high, initial=1.0)]
    base = SimpleNamespace(agreeing=0.1, free=[0], problem=SimpleNamespace(parameters=parameters))
    with pytest.warns(ConvergenceWarning, match="10% of the base's starting values") as told:
        conclude._warn(SimpleNamespace(base=base), lost=False)
    assert ("Give initial= or bounds" in str(told[0].message)) is (high is None)
