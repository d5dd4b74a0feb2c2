"""Noise of unknown size or correlation against physics: every hypothesis with the noise that suits it."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.linalg import toeplitz

import torchcal as tc
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.discovery.misfit.likeliest import Tangents, alone, log_likelihood, settled, with_unknown
from torchcal.discovery.misfit.noise import GRID

F64 = torch.float64
TERMS = ("cubic drag", "quadratic drag", "Coulomb friction", "cubic stiffness")


def diagnose(*args, **options):
    return tc.diagnose(*args, **{"seed": 0, "progress": False, **options})


def correlated(rng, n, rho):
    """AR(1) noise of unit variance."""
    e = rng.standard_normal(n)
    for k in range(1, n):
        e[k] = rho * e[k - 1] + math.sqrt(1 - rho**2) * e[k]
    return e


def curve(y, size=2, **options):
    """A polynomial of some coefficients fitted to data, the noise estimated, and the fit's tangents."""
    x = torch.linspace(-1, 1, len(y), dtype=F64)
    names = [f"c{k}" for k in range(size)]
    simulator = tc.Simulator(
        lambda x, p: sum(p[name] * x**k for k, name in enumerate(names)),
        [tc.Parameter(name, initial=0.1) for name in names],
    )
    found, noise = calibrate_base(Problem.of(simulator, tc.Recording(x=x, y=torch.tensor(y), **options)), {}, 2, 0)
    return found, noise, Tangents.of(found, noise)


def test_log_likelihood_is_the_normal_one_but_for_a_constant():
    rng = np.random.default_rng(0)
    found, noise, tangents = curve(2 + 0.3 * correlated(rng, 60, 0.6))
    rho, sd = float(noise.correlation[0]), float(noise.sd[0])
    covariance = sd**2 * toeplitz(rho ** np.arange(60))
    expected = stats.multivariate_normal(cov=covariance).logpdf(found.residual.numpy())
    # Both coefficients integrated out.
    q = np.linalg.qr(found.jacobian.numpy())[0]
    expected -= 0.5 * np.linalg.slogdet(q.T @ np.linalg.solve(covariance, q))[1]
    expected += 30 * math.log(2 * math.pi) - rho + 20 / 60 / math.log(rho)  # and the prior
    assert log_likelihood(found, noise, tangents) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize(
    "rho", [pytest.param(0.0, marks=pytest.mark.slow), 0.5, pytest.param(0.8, marks=pytest.mark.slow)]
)
def test_the_likeliest_noise_of_a_right_model_is_the_true_one(rho):
    found, size = [], []
    for seed in range(20):
        fit, first, tangents = curve(2 + 0.3 * correlated(np.random.default_rng(seed), 300, rho))
        noise, value = settled(fit, first, tangents)
        found.append(float(noise.correlation[0]))
        size.append(float(noise.sd[0]) / 0.3)
        assert value >= log_likelihood(fit, first, tangents) - 1e-3
    # sd of an estimate of ρ: √((1 − ρ²)/300), at most 0.06; four times that of the mean of 20, and the grid's step.
    assert np.mean(found) == pytest.approx(rho, abs=4 * 0.06 / math.sqrt(20) + 0.025)
    # The variance has 300 (1 − ρ²)/(1 + ρ²) independent values.
    worth = 300 * (1 - rho**2) / (1 + rho**2)
    assert np.mean(size) == pytest.approx(1.0, abs=4 / math.sqrt(2 * worth * 20) + 0.02)


def test_a_known_size_stays_and_replicates_stay():
    rng = np.random.default_rng(1)
    found, noise, tangents = curve(2 + 0.3 * correlated(rng, 100, 0.7), noise=0.3)
    fresh, _ = alone(found, noise, tangents)
    assert torch.equal(fresh.sd, noise.sd)
    assert float(fresh.correlation[0]) == pytest.approx(0.7, abs=0.2)
    x = torch.linspace(0, 1, 20, dtype=F64).repeat_interleave(3)
    simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    data = tc.Recording(x=x, y=torch.tensor(2 + 0.3 * rng.standard_normal(60)))
    found, noise = calibrate_base(Problem.of(simulator, data), {}, 4, 0)
    assert noise.source == "replicates"
    assert alone(found, noise, Tangents.of(found, noise))[0] is noise


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 8])
def test_noise_alone_is_not_taken_for_something_unknown(size):
    # A Bayes factor above e^4.6 has a probability of at most 1 % by noise alone: 3 or more of 40, one of 1000. Without
    # the determinant of what is calibrated, eight coefficients would make it a quarter at ρ = 0.9.
    odds = []
    for seed in range(24):
        rng = np.random.default_rng(100 + seed)
        found, noise, tangents = curve(2 + 0.3 * correlated(rng, 90, (0.0, 0.9, 0.7, 0.9)[seed % 4]), size)
        odds.append(with_unknown(found, None, tangents, noise.unit)[1] - settled(found, noise, tangents)[1])
    assert sum(value > 4.6 for value in odds) <= 2


def test_a_ripple_in_white_noise_is_no_correlated_noise():
    x = np.linspace(0, 1, 90)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        found, noise, tangents = curve(2 + 0.3 * np.sin(2 * np.pi * 5 * x) + 0.05 * rng.standard_normal(90))
        unknown, evidence = with_unknown(found, None, tangents, noise.unit)
        assert evidence > settled(found, noise, tangents)[1] + 10
        # What noise alone gives is simulated with the correlation in use.
        assert float((unknown.posterior[0] * GRID).sum()) == pytest.approx(float(unknown.correlation[0]), abs=0.1)
        assert float(unknown.sd[0]) == pytest.approx(0.05, rel=0.6)


def dose_response(binding, ripple, seed, *, rho=0.0, n=90):
    """Responses at doses over decades, in rising order, with a ripple in the dose that no library has."""
    rng = np.random.default_rng(seed)
    dose, age = np.exp(np.linspace(-4.5, 4.5, n)), rng.uniform(20, 70, n)
    effect = 1.3 * dose / (1.2 + dose) + ripple * np.sin(2 * np.pi * 3 * np.linspace(0, 1, n))
    effect += 0.01 * correlated(rng, n, rho)
    base, terms = binding
    data = tc.Recording(x={"dose": torch.tensor(dose), "age": torch.tensor(age)}, y=torch.tensor(effect))
    return diagnose(base, data, terms)


@pytest.mark.slow
def test_a_ripple_over_decades_of_a_condition_is_something_unknown(binding):
    # Taken for noise, it has a correlation of 0.9.
    d = dose_response(binding, 0.06, 0)
    assert d.verdict == "unexplained"
    assert d.noise.sd["y"] == pytest.approx(0.01, rel=1.0)


@pytest.mark.parametrize(
    "rho", [pytest.param(0.0, marks=pytest.mark.slow), 0.6, pytest.param(0.9, marks=pytest.mark.slow)]
)
def test_without_the_ripple_nothing_is_missing(binding, rho):
    assert dose_response(binding, 0.0, 1, rho=rho).verdict == "consistent"


def oscillator(rho, size, seed, n=250):
    """A driven oscillator with cubic drag, by classical Runge-Kutta steps of a tenth of a sample."""
    t = np.linspace(0, 20, n)

    def rate(time, z):
        return np.array([z[1], -4 * z[0] - 0.3 * z[1] - 0.05 * z[1] ** 3 + 2 * math.sin(1.7 * time)])

    z, x = np.array([0.8, 0.0]), []
    for k, now in enumerate(t):
        x.append(z[0])
        h = (t[1] - t[0]) / 10
        for part in range(10 if k + 1 < n else 0):
            begin = now + part * h
            a = rate(begin, z)
            b = rate(begin + h / 2, z + h / 2 * a)
            c = rate(begin + h / 2, z + h / 2 * b)
            z = z + h / 6 * (a + 2 * b + 2 * c + rate(begin + h, z + h * c))
    x = np.array(x) + size * correlated(np.random.default_rng(seed), n, rho)
    run = tc.Run(time=t, inputs={"f": 2 * np.sin(1.7 * t)}, outputs={"x": x}, initial={"x": 0.8, "v": 0.0})
    base = tc.ODESimulator(
        rates=lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]},
        states={"x": "m", "v": "m/s"},
        parameters=[
            tc.Parameter("k", unit="1/s^2", low=0.0, initial=4.0),
            tc.Parameter("c", unit="1/s", low=0.0, initial=0.3),
        ],
        observe=("x",),
    )
    return base, tc.Recording(runs=[run])


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_correlated_noise_is_estimated_beside_the_term_that_is_there(seed):
    base, data = oscillator(0.75, 0.02, seed)
    library = [term for term in tc.terms.mechanics() if term.name in TERMS]
    d = diagnose(base, data, library)
    assert d.verdict in ("named", "ambiguous")
    assert ["cubic drag"] in ([d.terms] if d.verdict == "named" else d.tied)
    # sd of ρ from 250 samples: 0.04.
    assert d.noise.correlation["x"] == pytest.approx(0.75, abs=0.16)
