"""Steps of an output, which slow noise may take as well as physics."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import toeplitz

import torchcal as tc
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.discovery.misfit.channels import channels
from torchcal.discovery.misfit.likeliest import Tangents, settled, with_unknown
from torchcal.discovery.misfit.places import SIZES
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.misfit.steps import LEAST, MOST, Steps, steps_of

X = np.linspace(0, 10, 60)


def line(x, p):
    return p["a"] + p["b"] * x


def parameters():
    return [tc.Parameter("a", initial=0.5), tc.Parameter("b", initial=0.5)]


def calibrated(y, x=X, **options):
    """A straight line fitted to data, and the noise."""
    simulator = tc.Simulator(line, parameters())
    recording = tc.Recording(x=torch.as_tensor(x), y=torch.as_tensor(y), **options)
    return calibrate_base(Problem.of(simulator, recording), {}, 2, 0)


def stepped(seed, size=1.0, at=6.0, sd=0.1, x=X):
    return 1 + 0.3 * x + size * (x > at) + sd * np.random.default_rng(seed).standard_normal(len(x))


def only(found):
    (steps,) = steps_of(found.problem, channels(found.problem, found))
    return steps


def test_the_evidence_of_a_step_is_the_ratio_of_two_normal_densities():
    found, noise = calibrated(stepped(0, size=0.3), noise=0.1)
    steps, residual = only(found), Residual(found, noise, draws=0)
    places = range(LEAST, len(X) - LEAST + 1)
    assert steps.functions.shape == (60, len(places))
    evidence, step = steps.evidence(residual)
    # Within what the line does not make up for, of white noise: the residual with and without a step of a normal size.
    rho = float(noise.correlation[0])
    white = np.linalg.inv(np.linalg.cholesky(0.01 * toeplitz(rho ** np.arange(60))))
    q = np.linalg.qr(white @ np.stack([np.ones(60), X], axis=1), mode="complete")[0][:, 2:]
    e, each = q.T @ white @ found.residual.numpy(), []
    for k in places:
        h = q.T @ white @ (np.arange(60) >= k)
        h = h / np.linalg.norm(h)
        for size in SIZES.tolist():
            larger = np.eye(58) + size**2 * np.outer(h, h)
            each.append(-0.5 * np.linalg.slogdet(larger)[1] - 0.5 * e @ np.linalg.solve(larger, e) + 0.5 * e @ e)
    assert evidence == pytest.approx(np.logaddexp.reduce(each) - math.log(len(each)), abs=1e-6)
    assert int((step != 0).sum()) == 24
    assert float(step.max()) == pytest.approx(0.3, abs=0.1)


def test_noise_alone_has_no_more_evidence_than_it_should():
    """A ratio of likelihoods has the mean 1 under noise, so that at most a share 1/c of it is larger than c."""
    found, noise = calibrated(stepped(1, size=0.0), noise=0.1)
    steps, residual = only(found), Residual(found, noise, draws=2000)
    ratio = []
    for e in residual.null.T:
        residual.e = e
        ratio.append(math.exp(steps.evidence(residual)[0]))
    for c in (2.0, 5.0, 20.0):
        assert np.mean(np.array(ratio) > c) < 1 / c + 4 * math.sqrt(1 / c / 2000)
    assert np.median(ratio) > 0.05


def test_steps_are_of_one_output_in_one_run_between_different_conditions():
    x = X.copy()
    x[20:24] = x[20]  # replicates are on one side
    found, _ = calibrated(stepped(2, x=x), x, noise=0.1)
    assert only(found).functions.shape[1] == 51 - 3
    long = np.linspace(0, 10, 1000)
    found, _ = calibrated(stepped(2, x=long), long, noise=0.1)
    assert only(found).functions.shape == (1000, 199)
    assert only(found).functions.shape[1] <= MOST
    few, _ = calibrated(stepped(2)[:9], X[:9], noise=0.1)
    assert steps_of(few.problem, channels(few.problem, few)) == []
    two = tc.ODESimulator(
        rates=lambda t, s, p, u: {"T": -p["k"] * s["T"], "S": -p["k"] * s["S"]},
        states={"T": "K", "S": "K"}, parameters=[tc.Parameter("k", low=0, initial=0.3)],
    )  # fmt: skip
    t = torch.linspace(0, 8, 20, dtype=torch.float64)
    runs = [tc.Run(time=t, outputs={"T": size * torch.exp(-0.3 * t), "S": torch.exp(-0.3 * t)},
                   initial={"T": size, "S": 1.0}) for size in (5.0, 3.0)]  # fmt: skip
    found, _ = calibrate_base(Problem.of(two, tc.Recording(runs=runs, noise=0.1)), {}, 2, 0)
    each = steps_of(found.problem, channels(found.problem, found))
    assert [steps.functions.shape for steps in each] == [(80, 22), (80, 22)]
    for k, steps in enumerate(each):
        output, run = found.problem.output_of, found.problem.recording.x["run"][found.problem.condition_of]
        for column in steps.functions.T:
            assert set(output[column != 0].tolist()) == {k}
            assert len(run[column != 0].unique()) == 1
    x = {"x": torch.as_tensor(X), "z": torch.as_tensor(np.random.default_rng(0).uniform(0, 1, 60))}
    simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["x"] + 0 * x["z"], parameters())
    several = Problem.of(simulator, tc.Recording(x=x, y=torch.as_tensor(stepped(3)), noise=0.1))
    found, _ = calibrate_base(several, {}, 2, 0)
    assert [Steps.of(several, c) for c in channels(several, found) if c.kind == "output"] == [None]


@pytest.mark.parametrize("seed", range(3))
def test_a_step_in_white_noise_is_no_slow_noise(seed):
    found, noise = calibrated(stepped(seed, size=0.8))
    tangents = Tangents.of(found, noise)
    unknown, evidence = with_unknown(found, None, tangents, noise.unit)
    assert evidence > settled(found, noise, tangents)[1] + 10
    assert float(unknown.correlation[0]) <= 0.2
    assert float(unknown.sd[0]) == pytest.approx(0.1, rel=0.35)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_step_that_is_in_no_list_is_something_missing_where_the_noise_is_unknown(seed):
    simulator = tc.Simulator(line, parameters())
    recording = tc.Recording(x=torch.as_tensor(X), y=torch.as_tensor(stepped(seed, size=0.8)))
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["c"] * x**2}, parameters=[tc.Parameter("c")])
    d = tc.diagnose(simulator, recording, [bend], seed=0, progress=False)
    assert d.verdict == "unexplained"
    assert float(d.noise.sd["y"]) < 0.2
