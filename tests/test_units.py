"""Results do not depend on the units that conditions, outputs and parameters are written in."""

import math

import pyro
import pytest
import torch
from pyro.infer import MCMC, NUTS

import torchcal as tc
from torchcal.errors import DomainError, RecordingError
from torchcal.prediction import Moments

X = torch.linspace(0.1, 1.0, 9, dtype=torch.float64)


def pair(scale):
    """A line and an exponential of one parameter; the first output in a unit of its own."""
    return tc.Simulator(
        lambda x, p: {"a": scale * p["q"] * x, "b": torch.exp(2 * p["q"] * x)}, [tc.Parameter("q", low=0.0, high=2.0)]
    )


def pair_data(scale):
    return tc.Recording(x=X, y={"a": scale * (X + 0.1 * X**2), "b": torch.exp(1.8 * X) + 0.2 * X})


def test_nodes_are_enough_for_the_small_output_too():
    simulator = tc.Simulator(
        lambda x, p: {"a": 1e9 * p["q"] * x, "b": 1e-3 * torch.exp(5 * p["q"] * x)}, [tc.Parameter("q")]
    )
    alpha = torch.tensor([0.1, 0.3], dtype=torch.float64)
    module = tc.NISP(simulator, tc.embeddings.Gaussian(), torch.ones(1, dtype=torch.float64), outputs=("a", "b"))
    exact = 1e-3 * math.exp(0.5 + 1.5**2 / 2) * math.sqrt(math.expm1(1.5**2))
    assert float(module(alpha)[1][1]) == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("unit", [1e-12, 1e9])
def test_a_standalone_propagation_in_small_and_large_units(unit):
    module = tc.NISP(tc.Simulator(lambda x, p: unit * p["q"] * x, [tc.Parameter("q")]), tc.embeddings.Gaussian(), X)
    _, sd = module(torch.tensor([1.0, 0.05], dtype=torch.float64))
    torch.testing.assert_close(sd / unit, 0.05 * X, rtol=1e-9, atol=0)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_both_calibrations_of_two_outputs(scale):
    found = [
        (
            tc.calibrate(pair(s), pair_data(s), num_samples=0).map,
            tc.calibrate_additive(pair(s), pair_data(s), num_samples=0).predict().map.sd[len(X) :],
        )
        for s in (1.0, scale)
    ]
    torch.testing.assert_close(found[0][0].mean, found[1][0].mean, rtol=1e-5, atol=0)
    torch.testing.assert_close(found[0][0].covariance, found[1][0].covariance, rtol=1e-4, atol=1e-12)
    # σ of the first output follows its unit; that of the second is what it was.
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-4, atol=0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchcal.errors.ToleranceWarning")  # the model is exact: there is only noise
def test_the_default_tolerance_respects_known_noise():
    """An exact line with noise s = 0.3: the slope's posterior cannot be much narrower than least squares allows."""
    noise = 0.3
    x = torch.linspace(-1, 1, 21, dtype=torch.float64)
    sd = noise / float((x - x.mean()).square().sum().sqrt())
    z = []
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        y = 1 + 2 * x + noise * torch.randn(21, generator=generator, dtype=torch.float64)
        simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
        result = tc.calibrate(simulator, tc.Recording(x=x, y=y, noise=noise), num_samples=60, num_chains=8, seed=seed)
        slope = result.propagate.parameter_moments(result.draws)[0][:, 1]
        assert float(slope.std()) > 0.5 * sd
        z.append((float(slope.mean()) - 2) / float(slope.std()))
    # Four standard normal numbers: the largest is past 4 once in 4000 times; a posterior half as wide doubles them.
    assert max(abs(value) for value in z) < 8


@pytest.mark.parametrize("kind", ["Unit", "Quantity"])
def test_a_unit_that_is_no_text_is_told_how_to_be_one(kind):
    unit = getattr(pytest.importorskip("pint").UnitRegistry(), kind)("m/s")
    with pytest.raises(DomainError, match=r"unit of parameter 'v' as a string or None\. Got .*unit=str\(unit\)"):
        tc.Parameter("v", unit=unit)
    assert tc.Parameter("v", unit=str(unit)).unit == str(unit)


def test_scores_refuse_units_that_a_prediction_does_not_know():
    quantity = pytest.importorskip("pint").UnitRegistry().Quantity
    moments = Moments(torch.tensor([1.0, 2.0]).double(), torch.ones(2).double())
    plain = tc.scores([1.0, 2.5], moments, noise=0.1)
    y = quantity([1000.0, 2500.0], "mm")
    assert tc.scores(y.to("m").magnitude, moments, noise=0.1) == plain
    for data, noise, label in [(y, 0.1, "y"), ([1.0, 2.5], quantity(100.0, "mm"), "noise"), (list(y), 0.1, "y")]:
        with pytest.raises(DomainError, match=rf"Expected {label} as numbers.* Got some in 'millimeter' \("):
            tc.scores(data, moments, noise=noise)
    xarray = pytest.importorskip("xarray")
    for data in (xarray.DataArray(y, dims="n"), xarray.DataArray([1.0, 2.5], dims="n", attrs={"units": "mm"})):
        with pytest.raises(DomainError, match="Expected y as numbers"):
            tc.scores(data, moments)
    noise = xarray.DataArray(0.1, attrs={"units": "cm"})
    with pytest.raises(RecordingError, match="a known unit of output 'y', because noise has one"):
        tc.Recording(x=[0.0, 1.0], y=[1.0, 2.0], noise=noise)
    assert tc.Recording(x=[0.0, 1.0], y=[1.0, 2.0], noise=noise, units={"y": "cm"}).noise.tolist() == [0.1, 0.1]


def test_a_guess_with_a_unit_is_refused_with_what_to_give():
    quantity = pytest.importorskip("pint").UnitRegistry().Quantity
    with pytest.raises(DomainError, match=r"finite number for initial.*Give its magnitude in the parameter's unit"):
        tc.Parameter("g", unit="m/s^2", initial=quantity(9.81, "m/s^2"))


@pytest.mark.slow
def test_a_users_own_bounded_model_is_sampled_with_the_defaults_of_nuts():
    """Pyro starts in the middle of the support's coordinates: spreads there are small against the ranges."""
    x = torch.linspace(0, 3, 6, dtype=torch.float64)
    y = 2 * torch.exp(-0.8 * x) + 0.1 * x
    simulator = tc.Simulator(
        lambda x, p: p["A"] * torch.exp(-p["k"] * x), [tc.Parameter("A", low=0.0), tc.Parameter("k", low=0.0, high=5.0)]
    )
    propagate = tc.NISP(simulator, tc.embeddings.Gaussian(), x, rule=5)
    likelihood = tc.likelihoods.ABC(epsilon=0.05)

    def model():
        alpha = pyro.sample("alpha", tc.priors.Flat(propagate))
        pyro.factor("abc", likelihood.log_prob(y, *propagate(alpha)))

    means = []
    state = pyro.util.get_rng_state()
    for seed in (0, 3):
        pyro.set_rng_seed(seed)
        chain = MCMC(NUTS(model), num_samples=60, warmup_steps=80, disable_progbar=True)
        chain.run()
        draws = propagate.parameter_moments(chain.get_samples()["alpha"])[0]
        assert float(draws[:, 1].std()) > 0
        means.append(draws.mean(0))
    pyro.util.set_rng_state(state)
    for other in means[1:]:  # within a few posterior sds of each other: one mode, no chain frozen
        torch.testing.assert_close(means[0], other, rtol=0.05, atol=0.05)
