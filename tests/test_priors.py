"""Priors on α: densities, supports and their coordinates, draws, and Pyro's NUTS."""

import math
import warnings

import numpy as np
import pyro
import pytest
import torch
from pyro.infer import MCMC, NUTS
from scipy import stats
from torch.distributions import biject_to, transform_to

import torchcal as tc
from torchcal import Parameter, Simulator
from torchcal.embeddings import Gaussian, PolynomialChaos
from torchcal.errors import DomainError, ShapeError
from torchcal.priors import Bounds, Flat, Normal, Uniform

X = torch.linspace(-1, 1, 4, dtype=torch.float64)
INF = math.inf


def propagate(parameters=None, embedding=None):
    parameters = parameters or [Parameter("a"), Parameter("b")]
    return tc.NISP(
        Simulator(lambda x, p: sum(p[q.name] for q in parameters) * x, parameters), embedding or Gaussian(), X
    )


# One parameter of each kind: leading bounds (-1, 1), (0, inf), (-inf, 2), none.
MIXED = [Parameter("two", low=10.0, high=20.0), Parameter("low", low=0.0), Parameter("high", high=2.0), Parameter("no")]
PRIORS = [Flat, Uniform, Normal]


def mixed():
    return propagate(MIXED)


# --- the change of coordinates --------------------------------------------------------------------

LOW = torch.tensor([-1.0, 0.0, -INF, -INF], dtype=torch.float64)
HIGH = torch.tensor([3.0, INF, 2.0, INF], dtype=torch.float64)
TRIANGLE = torch.tensor(
    [[0.5, 0, 0, 0], [0.2, 1.5, 0, 0], [-0.3, 0.1, 0.7, 0], [0.4, -0.6, 0.2, 1.1]], dtype=torch.float64
)
TRANSFORMS = [
    pytest.param(Bounds(LOW, HIGH), id="plain"),
    pytest.param(Bounds(LOW, HIGH, torch.tensor([0.1, -0.2, 0.3, 1.0]).double(), TRIANGLE), id="whitened"),
    pytest.param(Bounds(-INF * torch.ones(4).double(), INF * torch.ones(4).double()), id="unbounded"),
]


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_coordinates_lead_inside_and_back(transform):
    z = 3 * torch.randn(20, 4, dtype=torch.float64)
    alpha = transform(z)
    assert (alpha >= transform.low).all()
    assert (alpha <= transform.high).all()
    # A sigmoid at 12 is 6e-6 from its end, which float64 resolves to 2e-11 of itself.
    torch.testing.assert_close(transform.inv(alpha), z, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_jacobian_agrees_with_autograd(transform):
    for z in 2 * torch.randn(5, 4, dtype=torch.float64):
        jacobian = torch.autograd.functional.jacobian(transform, z)
        expected = torch.linalg.slogdet(jacobian)[1]
        found = transform.log_abs_det_jacobian(z, transform(z))
        assert found.shape == ()
        assert float(found) == pytest.approx(float(expected), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_coordinates_have_right_gradients(transform):
    z = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(transform, z)
    assert torch.autograd.gradcheck(lambda v: transform.log_abs_det_jacobian(v, transform(v)), z)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_on_and_beyond_a_bound_have_finite_coordinates(dtype):
    transform = Bounds(LOW, HIGH)
    for alpha in (LOW, HIGH, LOW - 1, HIGH + 1):
        alpha = alpha.nan_to_num(posinf=5.0, neginf=-5.0).to(dtype)
        u = transform.unbound(alpha)
        assert torch.isfinite(u).all()
        assert torch.isfinite(transform.log_slope(u)).all()


def test_far_out_coordinates_stay_numbers():
    transform = Bounds(LOW, HIGH)
    for size in (40.0, 800.0, -40.0, -800.0):
        u = torch.full((4,), size, dtype=torch.float64, requires_grad=True)
        value = transform.bound(u)
        (slope,) = torch.autograd.grad(value.sum() + transform.log_slope(u), u)
        assert torch.isfinite(value).all()
        assert torch.isfinite(slope).all()


# --- densities ------------------------------------------------------------------------------------


@pytest.mark.parametrize("prior", PRIORS)
def test_physical_bounds_bound_the_means_alone(prior):
    module = mixed()
    distribution = prior(module)
    leading = module.pattern.leading
    bounds = torch.stack([distribution.low, distribution.high])
    if prior is not Uniform:
        # 'low' is scaled by 1 and 'high' too: their bounds stay as they are.
        expected = torch.tensor([[-1.0, 0.0, -INF, -INF], [1.0, INF, 2.0, INF]], dtype=torch.float64)
        torch.testing.assert_close(bounds[:, leading], expected, rtol=1e-12, atol=1e-12)
        assert torch.isinf(bounds[:, ~leading]).all()
    inside = torch.zeros(module.num_alpha, dtype=torch.float64)
    inside[leading] = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)
    assert torch.isfinite(distribution.log_prob(inside))
    assert bool(distribution.support.check(inside))
    for which, value in ((0, 1.01), (0, -1.01), (1, -0.01), (2, 2.01)):
        outside = inside.clone()
        outside[leading.nonzero()[which]] = value
        assert distribution.log_prob(outside) == -INF
        assert not bool(distribution.support.check(outside))


def test_flat_is_zero_everywhere_it_is_not_impossible():
    distribution = Flat(propagate())
    value = 1e6 * torch.randn(3, 2, 5, dtype=torch.float64)
    assert distribution.log_prob(value).shape == (3, 2)
    assert (distribution.log_prob(value) == 0).all()
    assert not distribution.proper


def test_uniform_is_a_normalised_box():
    module = mixed()
    distribution = Uniform(module, leading=4.0, spread=0.5)
    leading = module.pattern.leading
    sides = (distribution.high - distribution.low)[leading]
    # Two bounds: as given; one: 2 × leading from it, if that reaches further than leading; none: ± leading.
    torch.testing.assert_close(sides, torch.tensor([2.0, 8.0, 8.0, 8.0], dtype=torch.float64))
    assert ((distribution.high - distribution.low)[~leading] == 1.0).all()
    volume = float((distribution.high - distribution.low).prod())
    center = 0.5 * (distribution.low + distribution.high)
    assert float(distribution.log_prob(center)) == pytest.approx(-math.log(volume), rel=1e-12)
    assert distribution.log_prob(center + torch.eye(module.num_alpha)[1]) == -INF
    assert distribution.proper


def test_normal_is_scipys():
    module = propagate()
    loc = torch.linspace(-1, 1, 5, dtype=torch.float64)
    scale = torch.linspace(0.5, 2, 5, dtype=torch.float64)
    value = torch.randn(3, 5, dtype=torch.float64)
    expected = stats.norm(loc.numpy(), scale.numpy()).logpdf(value.numpy()).sum(-1)
    np.testing.assert_allclose(Normal(module, loc=loc, scale=scale).log_prob(value).numpy(), expected, rtol=1e-12)
    assert Normal(module).proper


def test_a_prior_is_folded_only_where_reversing_a_germ_leaves_it():
    module = propagate()  # a[0], a[xi1], b[0], b[xi1], b[xi2]
    assert Flat(module).symmetric
    assert Uniform(module).symmetric
    assert Normal(module).symmetric
    leading = torch.tensor([1.0, 0.0, 2.0, 0.0, 0.0], dtype=torch.float64)
    assert Normal(module, loc=leading).symmetric
    assert not Normal(module, loc=leading + torch.eye(5, dtype=torch.float64)[1]).symmetric


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda m: Uniform(m, leading=0.0), DomainError),
        (lambda m: Uniform(m, spread=-1.0), DomainError),
        (lambda m: Uniform(m, spread=math.nan), DomainError),
        (lambda m: Normal(m, scale=0.0), DomainError),
        (lambda m: Normal(m, scale=torch.tensor([1.0, 1.0, -1.0, 1.0, 1.0])), DomainError),
        (lambda m: Normal(m, loc=math.nan), DomainError),
        (lambda m: Normal(m, loc=torch.zeros(4)), ShapeError),
        (lambda m: Normal(m, scale=torch.ones(6)), ShapeError),
        (lambda m: Flat("propagate"), DomainError),
    ],
)
def test_bad_priors_are_refused(make, error):
    with pytest.raises(error, match="Expected"):
        make(propagate())


# --- draws ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("prior", PRIORS)
def test_draws_have_their_shape_and_lie_inside(prior):
    distribution = prior(mixed())
    for shape in ((), (7,), (2, 3)):
        draws = distribution.sample(shape)
        assert draws.shape == (*shape, 14)
        assert distribution.support.check(draws).all()
        assert torch.isfinite(distribution.log_prob(draws)).all()
    assert distribution.expand((4,)).sample((3,)).shape == (3, 4, 14)


def test_draws_of_a_proper_uniform_fill_its_box():
    distribution = Uniform(mixed())
    draws = distribution.sample((4000,))
    unit = ((draws - distribution.low) / (distribution.high - distribution.low)).numpy()
    for column in unit.T:
        # Fourteen columns, of which one in 700 runs falls below 1e-4 by chance; the seed is fixed.
        assert stats.kstest(column, "uniform").pvalue > 1e-4


def test_draws_of_a_proper_normal_are_cut_at_its_bounds():
    module = mixed()
    distribution = Normal(module, loc=0.4, scale=0.8)
    draws = distribution.sample((4000,)).numpy()
    for i, column in enumerate(draws.T):
        low, high = ((float(end[i]) - 0.4) / 0.8 for end in (distribution.low, distribution.high))
        assert stats.kstest(column, stats.truncnorm(low, high, 0.4, 0.8).cdf).pvalue > 1e-4


def test_draws_start_from_the_seed():
    distribution = Flat(mixed())
    torch.manual_seed(5)
    first = distribution.sample((3,))
    torch.manual_seed(5)
    torch.testing.assert_close(distribution.sample((3,)), first, rtol=0, atol=0)


@pytest.mark.parametrize("prior", PRIORS)
def test_priors_follow_the_modules_dtype(prior):
    module = mixed().to(torch.float32)
    distribution = prior(module)
    draws = distribution.sample((3,))
    assert draws.dtype == torch.float32
    assert distribution.log_prob(draws).dtype == torch.float32


# --- Pyro -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("prior", PRIORS)
def test_pyro_samples_from_priors_and_finds_their_coordinates(prior):
    module = mixed()
    trace = pyro.poutine.trace(lambda: pyro.sample("alpha", prior(module))).get_trace()
    assert trace.nodes["alpha"]["value"].shape == (14,)
    trace.compute_log_prob()
    assert torch.isfinite(trace.log_prob_sum())
    support = prior(module).support
    for registry in (biject_to, transform_to):
        value = registry(support)(3 * torch.randn(50, 14, dtype=torch.float64))
        assert support.check(value).all()


def test_the_users_own_pyro_model():
    """The third part of the code in the design: NISP, a prior and a likelihood inside a model of one's own."""
    x = torch.linspace(-1, 1, 11, dtype=torch.float64)
    y = 2 + 2 * x + 3 * x**2 - 5 * x**3
    simulator = tc.Simulator(
        lambda x, p: p["intercept"] + p["slope"] * x,
        parameters=[tc.Parameter("intercept"), tc.Parameter("slope")],
    )
    recording = tc.Recording(x=x, y=y)
    module = tc.NISP(simulator, tc.embeddings.Gaussian(), x=recording.x)
    likelihood = tc.likelihoods.ABC(epsilon=0.1)

    def model():
        alpha = pyro.sample("alpha", tc.priors.Flat(module))
        mean, sd = module(alpha)
        pyro.factor("abc", likelihood.log_prob(recording.y, mean, sd))

    mcmc = MCMC(NUTS(model, max_tree_depth=5), num_samples=10, warmup_steps=20, disable_progbar=True)
    mcmc.run()
    draws = mcmc.get_samples()["alpha"]
    assert draws.shape == (10, 5)
    assert draws.dtype == torch.float64
    assert torch.isfinite(draws).all()
    mean, _ = module(draws)
    # After the warm-up the chain is where the likelihood is: far better than the prior's guesses.
    value = likelihood.log_prob(recording.y, *module(draws)).max()
    assert value > likelihood.log_prob(recording.y, *module(torch.zeros(5, dtype=torch.float64)))
    assert mean.shape == (10, 11)


@pytest.mark.parametrize("prior", PRIORS)
def test_nuts_starts_by_itself_and_stays_inside_bounds(prior):
    module = propagate([Parameter("a", low=0.0, high=1.0), Parameter("b", low=0.0)])
    distribution = prior(module)
    y = -X  # pulls both means against their bounds

    def model():
        alpha = pyro.sample("alpha", distribution)
        mean, sd = module(alpha)
        pyro.factor("fit", tc.likelihoods.ABC(epsilon=0.5).log_prob(y, mean, sd))

    mcmc = MCMC(NUTS(model, max_tree_depth=4), num_samples=15, warmup_steps=15, disable_progbar=True)
    mcmc.run()
    draws = mcmc.get_samples()["alpha"]
    assert distribution.support.check(draws).all()
    mean, _ = module.parameter_moments(draws)
    assert (mean >= 0).all()
    assert (mean[:, 0] <= 1).all()


def test_nuts_draws_a_cut_normal_as_it_is():
    """The support's Jacobian inside Pyro: with no data the posterior is the prior, cut at 0 and 1."""
    module = propagate([Parameter("a", low=0.0, high=1.0)], PolynomialChaos(order=0))
    distribution = Normal(module, loc=0.5, scale=0.5)  # of the scaled mean, within (-1, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mcmc = MCMC(
            NUTS(lambda: pyro.sample("alpha", distribution)),
            num_samples=400,
            warmup_steps=100,
            disable_progbar=True,
        )
        mcmc.run()
    draws = mcmc.get_samples()["alpha"][:, 0]
    oracle = stats.truncnorm(-3.0, 1.0, 0.5, 0.5)
    # 400 draws of NUTS are worth at least 100 here: four standard errors of the mean and of the sd.
    assert float(draws.mean()) == pytest.approx(oracle.mean(), abs=4 * oracle.std() / 10)
    assert float(draws.std()) == pytest.approx(oracle.std(), abs=4 * oracle.std() / math.sqrt(200))


@pytest.mark.parametrize("prior", PRIORS)
def test_whitening_changes_coordinates_and_not_the_density(prior):
    distribution = prior(mixed())
    loc = torch.linspace(-0.5, 0.5, 14, dtype=torch.float64)
    factor = 0.3 * torch.eye(14, dtype=torch.float64) + 0.02 * torch.ones(14, 14, dtype=torch.float64).tril(-1)
    whitened = distribution.whitened(loc, factor)
    draws = distribution.sample((5,))
    torch.testing.assert_close(whitened.log_prob(draws), distribution.log_prob(draws), rtol=0, atol=0)
    z = torch.randn(5, 14, dtype=torch.float64)
    reached = biject_to(whitened.support)(z)
    torch.testing.assert_close(reached, distribution.transform.bound(loc + z @ factor.T), rtol=1e-12, atol=1e-12)
    assert distribution.transform.loc is not whitened.transform.loc
