"""Likelihoods against independent numpy and scipy formulas, and where they cease to exist."""

import math

import numpy as np
import pytest
import torch
from scipy import optimize, stats

from torchcal import NISP, Parameter, Recording, Simulator, calibrate
from torchcal.embeddings import Gaussian
from torchcal.errors import DegenerateLikelihoodError, DomainError, ShapeError
from torchcal.likelihoods import (
    ABC,
    DEFAULT_TOLERANCE,
    SMOOTHING,
    ABCMean,
    Additive,
    Full,
    GaussianMarginal,
    Likelihood,
    Marginal,
    abc_log_prob,
    get,
)

# Formulas of a few float64 terms, evaluated twice in different orders.
EXACT = {"rtol": 1e-12, "atol": 1e-12}


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


Y = draw(6, seed=1)
MEAN = draw(2, 3, 6, seed=2)
SD = draw(2, 3, 6, seed=3).abs() + 0.1
NOISE = torch.tensor([0.3, 0.1, 0.5, 0.2, 1.5, 0.4], dtype=torch.float64)


# --- moment likelihoods ---------------------------------------------------------------------------


@pytest.mark.parametrize("gamma", [1.0, 0.5, 200.0])
@pytest.mark.parametrize("epsilon", [0.1, 2.0])
@pytest.mark.parametrize("noise", [None, NOISE])
def test_abc_is_equation_24(epsilon, gamma, noise):
    found = ABC(epsilon=epsilon, gamma=gamma).log_prob(Y, MEAN, SD, noise)
    assert found.shape == (2, 3)
    r2 = (MEAN - Y).numpy() ** 2
    unexplained = r2 if noise is None else np.maximum(r2 - noise.numpy() ** 2, 0)
    delta = 1e-3 * epsilon / max(1, gamma)
    wanted = gamma * np.sqrt(unexplained + delta**2)
    expected = -(r2 + (SD.numpy() - wanted) ** 2).sum(-1) / (2 * epsilon**2)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)
    torch.testing.assert_close(
        abc_log_prob(Y, MEAN, SD, epsilon=epsilon, gamma=gamma, noise=noise), found, rtol=0, atol=0
    )


def test_abc_without_smoothing_is_the_papers_formula():
    """δ moves a wanted sd |r| by δ²/(2|r|), and the sum of squares by less than δ²·n·max|σ − r|/|r| / ε²."""
    epsilon = 0.1
    r = (MEAN - Y).abs()
    exact = -0.5 * (r**2 + (SD - r) ** 2).sum(-1) / epsilon**2
    bound = 0.5 * SMOOTHING**2 * ((SD - r).abs() / r).sum(-1) + SMOOTHING**4 * 6
    assert ((ABC(epsilon=epsilon).log_prob(Y, MEAN, SD) - exact).abs() <= bound + 1e-9).all()


@pytest.mark.parametrize("gamma", [1.0, 1e4])
def test_a_model_that_is_right_wants_no_spread_however_large_the_ratio(gamma):
    line = Simulator(lambda x, p: p["a"] + p["b"] * x, [Parameter("a"), Parameter("b")])
    x = torch.linspace(0, 1, 6, dtype=torch.float64)
    found = calibrate(line, Recording(x=x, y=1 + x), likelihood=ABC(0.01, gamma), num_samples=0, progress=False)
    assert float(found.predict().map.sd.max()) <= 1.1e-5  # a thousandth of the tolerance


def test_abc_asks_the_sd_for_what_noise_does_not_explain():
    """A residual of 5 with a noise of 3 wants a spread of 4; a residual below the noise wants none."""
    y, noise = torch.zeros(1, dtype=torch.float64), torch.full((1,), 3.0, dtype=torch.float64)
    sd = torch.linspace(0, 6, 601, dtype=torch.float64)[:, None]
    for residual, best in ((5.0, 4.0), (2.0, 0.0)):
        value = ABC(epsilon=0.1).log_prob(y, torch.full_like(sd, residual), sd, noise)
        assert float(sd[value.argmax(), 0]) == pytest.approx(best, abs=0.01)


@pytest.mark.parametrize("noise", [None, NOISE])
def test_abc_mean_is_equation_20_up_to_its_constant(noise):
    epsilon = 0.3
    found = ABCMean(epsilon=epsilon).log_prob(Y, MEAN, None, noise)
    width = np.hypot(epsilon, 0 if noise is None else noise.numpy())
    logpdf = stats.norm(MEAN.numpy(), width).logpdf(Y.numpy()).sum(-1)
    constant = stats.norm(0, width).logpdf(np.zeros(6)).sum()
    np.testing.assert_allclose(found.numpy(), logpdf - constant, rtol=1e-12)


@pytest.mark.parametrize("noise", [None, NOISE])
def test_gaussian_marginal_is_equation_17(noise):
    width = SD.numpy() if noise is None else np.hypot(SD.numpy(), noise.numpy())
    expected = stats.norm(MEAN.numpy(), width).logpdf(Y.numpy()).sum(-1)
    np.testing.assert_allclose(GaussianMarginal().log_prob(Y, MEAN, SD, noise).numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("noise", [None, NOISE])
def test_additive_is_equation_4(noise):
    log_sigma = draw(2, 3, seed=4)
    sigma = log_sigma.exp().numpy()[..., None]
    width = sigma if noise is None else np.hypot(sigma, noise.numpy())
    expected = stats.norm(MEAN.numpy(), width).logpdf(Y.numpy()).sum(-1)
    np.testing.assert_allclose(Additive().log_prob(Y, MEAN, log_sigma, noise).numpy(), expected, rtol=1e-12)


def test_mean_only_abc_is_the_additive_likelihood_with_sigma_epsilon():
    """The text under Eq. 20: they differ by a constant that does not depend on the model."""
    epsilon = 0.37
    log_sigma = torch.full((2, 3), math.log(epsilon), dtype=torch.float64)
    difference = Additive().log_prob(Y, MEAN, log_sigma) - ABCMean(epsilon=epsilon).log_prob(Y, MEAN)
    torch.testing.assert_close(difference, difference[:1, :1].expand(2, 3), **EXACT)
    assert float(difference[0, 0]) == pytest.approx(-6 * math.log(epsilon * math.sqrt(2 * math.pi)), rel=1e-12)


def test_a_tolerance_for_each_output():
    epsilon = torch.linspace(0.1, 0.6, 6, dtype=torch.float64)
    whole = ABC(epsilon=epsilon).log_prob(Y, MEAN, SD)
    parts = sum(
        ABC(epsilon=float(epsilon[i])).log_prob(Y[i : i + 1], MEAN[..., i : i + 1], SD[..., i : i + 1])
        for i in range(6)
    )
    torch.testing.assert_close(whole, parts, **EXACT)


# --- gradients ------------------------------------------------------------------------------------

MOMENTS = [ABC(epsilon=0.3), ABC(epsilon=0.3, gamma=0.5), GaussianMarginal()]


@pytest.mark.parametrize("likelihood", MOMENTS, ids=repr)
@pytest.mark.parametrize("noise", [None, NOISE])
def test_gradients_of_moment_likelihoods(likelihood, noise):
    mean, sd = MEAN.clone().requires_grad_(), SD.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda m, s: likelihood.log_prob(Y, m, s, noise), (mean, sd))


@pytest.mark.parametrize("likelihood", [*MOMENTS, ABCMean(epsilon=0.1)], ids=repr)
@pytest.mark.parametrize("noise", [None, NOISE])
def test_gradients_are_finite_where_the_mean_meets_the_data(likelihood, noise):
    mean, sd = Y.clone().requires_grad_(), SD[0, 0].clone().requires_grad_()
    value = likelihood.log_prob(Y, mean, sd, noise)
    slopes = torch.autograd.grad(value, (mean, sd), allow_unused=True)
    assert torch.isfinite(value)
    assert all(slope is None or torch.isfinite(slope).all() for slope in slopes)
    assert (slopes[0] == 0).all()  # a maximum in the mean there, on both sides of the kink


def test_the_gradient_is_finite_where_the_residual_equals_the_noise():
    noise = torch.full((6,), 0.5, dtype=torch.float64)
    mean = (Y + 0.5).requires_grad_()
    (slope,) = torch.autograd.grad(ABC(epsilon=0.1).log_prob(Y, mean, SD[0, 0], noise), mean)
    assert torch.isfinite(slope).all()


@pytest.mark.parametrize("likelihood", [Marginal(num_samples=8), Full(num_samples=8)], ids=repr)
@pytest.mark.parametrize("noise", [None, NOISE[:2]])
def test_gradients_of_sample_likelihoods(likelihood, noise):
    samples = draw(2, 8, 2, seed=7).requires_grad_()
    assert torch.autograd.gradcheck(lambda s: likelihood.log_prob(Y[:2], s, noise), samples)


@pytest.mark.parametrize("likelihood", [Marginal(num_samples=8), Full(num_samples=8)], ids=repr)
def test_sample_likelihoods_of_no_spread_stay_numbers(likelihood):
    samples = torch.zeros(8, 2, dtype=torch.float64).requires_grad_()
    value = likelihood.log_prob(Y[:2], samples)
    (slope,) = torch.autograd.grad(value, samples)
    assert torch.isfinite(value)
    assert torch.isfinite(slope).all()


# --- sample likelihoods ---------------------------------------------------------------------------


@pytest.mark.parametrize("bandwidth", [None, 0.3])
@pytest.mark.parametrize("noise", [None, NOISE])
def test_marginal_is_equation_16_with_scipys_kernel_density(bandwidth, noise):
    samples = draw(3, 40, 6, seed=5)
    found = Marginal(bandwidth=bandwidth).log_prob(Y, samples, noise)
    expected = np.zeros(3)
    for batch in range(3):
        for i in range(6):
            column = samples[batch, :, i].numpy()
            # scipy's "silverman" in one dimension is (4 / 3S)^(1/5) times the samples' sd.
            kernel = stats.gaussian_kde(column, bandwidth or "silverman")
            width = math.sqrt(kernel.covariance[0, 0] + (0 if noise is None else float(noise[i]) ** 2))
            expected[batch] += np.log(stats.norm(column, width).pdf(float(Y[i])).mean())
            if noise is None:
                assert np.log(kernel(float(Y[i]))[0]) == pytest.approx(
                    np.log(stats.norm(column, width).pdf(float(Y[i])).mean()), rel=1e-9
                )
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9)


@pytest.mark.parametrize("bandwidth", [None, 0.4])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_full_is_scipys_joint_kernel_density(bandwidth, n):
    samples = draw(2, 50, n, seed=6) @ draw(n, n, seed=8)
    found = Full(bandwidth=bandwidth).log_prob(Y[:n], samples)
    expected = [
        stats.gaussian_kde(s.T.numpy(), bandwidth or "silverman").logpdf(Y[:n].numpy())[0] for s in samples
    ]
    # The floor of 1e-10 of the largest kernel variance, against the smallest one, is what is left.
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6)


def test_full_with_noise_widens_every_kernel():
    samples = draw(50, 2, seed=6)
    kernel = stats.gaussian_kde(samples.T.numpy(), 0.4).covariance + np.diag(NOISE[:2].numpy() ** 2)
    density = np.mean([stats.multivariate_normal(s.numpy(), kernel).pdf(Y[:2].numpy()) for s in samples])
    found = Full(bandwidth=0.4).log_prob(Y[:2], samples, NOISE[:2])
    assert float(found) == pytest.approx(math.log(density), rel=1e-6)


LINE = Simulator(lambda x, p: p["a"] + p["b"] * x, [Parameter("a"), Parameter("b")])


def test_full_converges_to_the_exact_density_where_it_exists():
    """N = d = 2: (f_1, f_2) is an invertible linear map of two normals, whose density is known (Eq. 13)."""
    x = torch.tensor([0.0, 1.0], dtype=torch.float64)
    propagate = NISP(LINE, Gaussian(), x)
    alpha = torch.tensor([0.3, 0.8, -0.2, 0.3, 0.6], dtype=torch.float64)
    matrix = torch.tensor([[0.8, 0.0], [1.1, 0.6]], dtype=torch.float64)
    y = torch.tensor([0.6, 0.5], dtype=torch.float64)
    exact = stats.multivariate_normal([0.3, 0.1], (matrix @ matrix.T).numpy()).logpdf(y.numpy())
    errors, counts = [], (100, 1000, 10_000, 100_000)
    for count in counts:
        likelihood = Full(num_samples=count)
        samples = propagate.sample(alpha, count, seed=0)
        errors.append(abs(float(likelihood.log_prob(y, samples)) - exact))
    # A KDE in two dimensions errs by about S^(-1/3); at S = 1e5 that is 0.02, of which three are allowed.
    assert errors[-1] < 3 * counts[-1] ** (-1 / 3)
    assert errors[-1] < errors[0]


def test_marginals_converge_to_the_gaussian_marginals_of_a_linear_model():
    x = torch.linspace(-1, 1, 4, dtype=torch.float64)
    propagate = NISP(LINE, Gaussian(), x)
    alpha = torch.tensor([0.3, 0.8, -0.2, 0.3, 0.6], dtype=torch.float64)
    y = propagate.mean(alpha) + torch.tensor([0.3, -0.2, 0.5, 0.1], dtype=torch.float64)
    count = 100_000
    found = Marginal(num_samples=count).log_prob(y, propagate.sample(alpha, count, seed=0))
    exact = GaussianMarginal().log_prob(y, *propagate(alpha))
    # A KDE in one dimension errs by about S^(-2/5) = 0.01 relative in each of four factors.
    assert float(found) == pytest.approx(float(exact), abs=4 * count**-0.4)


# --- degeneracy (Eqs. 14-15) ----------------------------------------------------------------------


def test_lambda_x_has_a_likelihood_only_if_the_data_lie_on_one_line():
    """Eqs. 14-15: f = λx at x = 1, 2 fills the line y_2 = 2 y_1, and any other pair has likelihood zero."""
    ray = Simulator(lambda x, p: p["lam"] * x, [Parameter("lam")])
    x = torch.tensor([1.0, 2.0], dtype=torch.float64)
    propagate = NISP(ray, Gaussian(), x)
    on_line, off_line = torch.tensor([[1.0, 2.0], [1.0, 2.5]], dtype=torch.float64)
    spread = torch.ones(2, dtype=torch.float64)
    with pytest.raises(DegenerateLikelihoodError, match=r"N = 2 > d = 1.*Eqs. 14-15.*ABC"):
        Full().resolve(off_line, spread, 1)
    # What the error says: as the kernel narrows across the line, the density off it falls for every α.
    alphas = torch.tensor([[m, s] for m in (0.5, 1.0, 1.5) for s in (0.1, 1.0)], dtype=torch.float64)
    off, on = [], []
    for count in (100, 1000, 10_000):
        samples = propagate.sample(alphas, count, seed=0)
        off.append(Full(num_samples=count).log_prob(off_line, samples).max())
        on.append(Full(num_samples=count).log_prob(on_line, samples).max())
    assert off[0] > off[1] > off[2]
    assert off[-1] < -1e4
    assert on[-1] > 0


def test_full_exists_for_no_more_data_than_uncertain_parameters():
    one = torch.ones(2, dtype=torch.float64)
    likelihood = Full()
    assert isinstance(likelihood.resolve(one, one, 2), Full)
    assert isinstance(likelihood.resolve(one, one, 3), Full)
    with pytest.raises(DegenerateLikelihoodError):
        likelihood.resolve(torch.ones(3, dtype=torch.float64), one, 2)


def test_the_gaussian_marginal_likelihood_is_unbounded_without_noise():
    """Where one σ_i vanishes on its datum it grows without limit (Fig. 6); a noise sd bounds it."""
    y, mean = torch.zeros(2, dtype=torch.float64), torch.tensor([0.0, 1.0], dtype=torch.float64)
    sd = torch.tensor([[1e-2, 1.0], [1e-4, 1.0], [1e-8, 1.0]], dtype=torch.float64)
    value = GaussianMarginal().log_prob(y, mean, sd)
    assert float(value[2] - value[1]) == pytest.approx(math.log(1e4), rel=1e-9)
    assert float(value[1] - value[0]) == pytest.approx(math.log(1e2), rel=1e-9)
    bounded = GaussianMarginal().log_prob(y, mean, sd, torch.full((2,), 0.1, dtype=torch.float64))
    assert float(bounded.max()) < 2 * math.log(10)


def test_abc_of_one_free_mean_and_sd_is_best_at_the_data_scatter():
    """γ = 1 and a constant model: the best mean is the data's mean, the best sd minimises Σ(σ − |r|)²."""
    y = draw(30, seed=11)

    def objective(v):
        mean = torch.full_like(y, v[0])
        return -float(ABC(epsilon=1.0).log_prob(y, mean, torch.full_like(y, v[1])))

    best = optimize.minimize(objective, [0.5, 0.5], method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-12})
    r = np.abs(y.numpy() - best.x[0])
    assert best.x[1] == pytest.approx(r.mean(), abs=1e-5)  # rounded by δ = 1e-3 to about δ²


# --- defaults and names ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [ABC, ABCMean])
def test_the_default_tolerance_is_a_share_of_the_spread(kind):
    spread = torch.tensor([1.0, 2.0], dtype=torch.float64)
    resolved = kind().resolve(Y[:2], spread, 1)
    torch.testing.assert_close(resolved.epsilon, DEFAULT_TOLERANCE * spread, rtol=0, atol=0)
    given = kind(epsilon=0.5)
    assert given.resolve(Y[:2], spread, 1) is given
    moments = (MEAN,) if kind is ABCMean else (MEAN, SD)
    torch.testing.assert_close(
        kind().log_prob(Y, *moments), kind(epsilon=DEFAULT_TOLERANCE * float(Y.std())).log_prob(Y, *moments)
    )
    with pytest.raises(DomainError, match=r"Pass epsilon="):
        kind().log_prob(torch.ones(6, dtype=torch.float64), *moments)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("full", Full),
        ("marginal", Marginal),
        ("marg", Marginal),
        ("gaussian_marginal", GaussianMarginal),
        ("gausmarg", GaussianMarginal),
        ("abc_mean", ABCMean),
        ("abcm", ABCMean),
        ("abc", ABC),
        ("additive", Additive),
        ("classical", Additive),
    ],
)
def test_names_of_the_paper_and_of_existing_tools(name, kind):
    assert type(get(name)) is kind
    assert isinstance(get(name), Likelihood)
    likelihood = kind()
    assert get(likelihood) is likelihood


@pytest.mark.parametrize("bad", ["mcmc", "", None, 3, ABC])
def test_an_unknown_likelihood_is_refused(bad):
    with pytest.raises(DomainError, match=r"Expected a torchcal\.likelihoods object or one of"):
        get(bad)


@pytest.mark.parametrize("bad", [0.0, -0.1, math.nan, math.inf, "small", [0.1, -0.1]])
def test_bad_tolerances_are_refused(bad):
    for call in (lambda: ABC(epsilon=bad), lambda: ABCMean(epsilon=bad), lambda: ABC(epsilon=0.1, gamma=bad)):
        with pytest.raises(DomainError, match="Expected"):
            call()
    with pytest.raises(DomainError, match="Expected epsilon"):
        abc_log_prob(Y, MEAN, SD, epsilon=bad)
    with pytest.raises(DomainError, match="Expected gamma"):
        abc_log_prob(Y, MEAN, SD, epsilon=0.1, gamma=bad)


@pytest.mark.parametrize("kind", [Marginal, Full])
@pytest.mark.parametrize("bad", [{"num_samples": 1}, {"num_samples": 2.5}, {"num_samples": True}, {"bandwidth": 0.0}])
def test_bad_kernels_are_refused(kind, bad):
    with pytest.raises(DomainError):
        kind(**bad)


def test_shapes_that_broadcasting_would_hide_are_refused():
    for likelihood in (ABC(epsilon=0.1), GaussianMarginal()):
        for mean, sd in ((MEAN[..., :1], SD), (MEAN, SD[..., :1]), (MEAN[..., :5], SD[..., :5])):
            with pytest.raises(ShapeError, match=r"\(\.\.\., 6\)"):
                likelihood.log_prob(Y, mean, sd)
        with pytest.raises(ShapeError, match="noise"):
            likelihood.log_prob(Y, MEAN, SD, NOISE[:1])
    with pytest.raises(ShapeError):
        ABCMean(epsilon=0.1).log_prob(Y, MEAN[..., :1])
    with pytest.raises(ShapeError):
        Additive().log_prob(Y, MEAN[..., :1], MEAN[..., 0])
    with pytest.raises(ShapeError, match="epsilon"):
        ABC(epsilon=torch.ones(3)).log_prob(Y, MEAN, SD)
    for kernel in (Marginal(), Full()):
        with pytest.raises(ShapeError, match="samples"):
            kernel.log_prob(Y, draw(8, 1))
    with pytest.raises(ShapeError, match=r"y as a tensor of shape \(n,\)"):
        ABC(epsilon=0.1).log_prob(Y[:, None], MEAN, SD)


@pytest.mark.parametrize("likelihood", [*MOMENTS, Marginal(num_samples=8), Full(num_samples=8)], ids=repr)
def test_float32_is_taken(likelihood):
    if likelihood.needs == "samples":
        arguments = (Y[:2], draw(8, 2, seed=3))
    else:
        arguments = (Y, MEAN, SD)
    value = likelihood.log_prob(*(a.float() for a in arguments))
    assert value.dtype == torch.float32
    # Sums of a few terms of single precision, whose logarithms and squares amplify it by less than a hundred.
    torch.testing.assert_close(value.double(), likelihood.log_prob(*arguments), rtol=1e-5, atol=1e-4)


def test_likelihoods_are_frozen():
    with pytest.raises(AttributeError):
        ABC(epsilon=0.1).epsilon = 0.2


def test_data_that_are_no_tensor_or_not_finite_are_told():
    one = torch.ones(2, dtype=torch.float64)
    with pytest.raises(ShapeError, match="y as a tensor of shape"):
        ABC(epsilon=0.1).log_prob([1.0, 2.0], one, one)
    with pytest.raises(DomainError, match="Got NaN or infinity in y"):
        ABC().log_prob(torch.tensor([1.0, math.nan], dtype=torch.float64), one, one)
