"""Predictive moments (Table AI), the density of λ (Eq. 44), other quantities of interest, scores."""

import math
import warnings

import numpy as np
import pytest
import torch
from scipy import integrate, stats

import torchcal as tc
from torchcal import NISP, Parameter, Simulator
from torchcal.embeddings import Gaussian, IndependentGaussian, PolynomialChaos, Uniform
from torchcal.errors import DomainError, ShapeError
from torchcal.prediction import (
    Moments,
    additive_prediction,
    embedded_prediction,
    kernel_density,
    parameter_density,
    scores,
)

X = torch.linspace(-1, 1, 4, dtype=torch.float64)
AB = [Parameter("a"), Parameter("b")]
SMOOTH = Simulator(lambda x, p: torch.exp(0.4 * p["a"]) + p["b"] * x, AB)
EXACT = {"rtol": 1e-11, "atol": 1e-12}


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


CENTER = torch.tensor([0.5, 0.4, -0.3, 0.2, 0.5], dtype=torch.float64)
DRAWS = CENTER + 0.2 * draw(60, 5, seed=1)


# --- Table AI -------------------------------------------------------------------------------------


def moments_of(alpha):
    """μ(α) and σ(α)² in closed form: a lognormal plus a correlated normal."""
    a0, a1, b0, b1, b2 = (alpha[..., i : i + 1] for i in range(5))
    m, s = 0.4 * a0, 0.4 * a1
    lift = torch.exp(m + s**2 / 2)
    mean = lift + b0 * X
    variance = lift**2 * torch.expm1(s**2) + (b1**2 + b2**2) * X**2 + 2 * lift * s * b1 * X
    return mean, variance


def test_table_ai():
    propagate = NISP(SMOOTH, Gaussian(), X, rule=20)
    found = embedded_prediction(propagate, CENTER, DRAWS)
    mean, variance = moments_of(DRAWS)
    at_map, at_mean = moments_of(CENTER), moments_of(DRAWS.mean(0))
    close = {"rtol": 1e-9, "atol": 1e-10}  # twenty nodes for exp(0.4 · a few)
    torch.testing.assert_close(found.map.mean, at_map[0], **close)
    torch.testing.assert_close(found.map.sd, at_map[1].sqrt(), **close)
    torch.testing.assert_close(found.posterior.mean, mean.mean(0), **close)
    # Eq. A2: E[σ²] + V[μ], the variance over the draws themselves.
    torch.testing.assert_close(found.posterior.sd**2, variance.mean(0) + mean.var(0, unbiased=False), **close)
    torch.testing.assert_close(found.mean_predictive.mean, at_mean[0], **close)
    torch.testing.assert_close(found.mean_predictive.sd, at_mean[1].sqrt(), **close)
    torch.testing.assert_close(found.sd_model_error, variance.mean(0).sqrt(), **close)
    torch.testing.assert_close(found.sd_posterior, mean.var(0, unbiased=False).sqrt(), **close)
    torch.testing.assert_close(found.sd_model_error**2 + found.sd_posterior**2, found.sd**2, **EXACT)
    torch.testing.assert_close(found.mean, found.posterior.mean, rtol=0, atol=0)


def test_equations_a1_and_a2_against_sampling():
    """Draw α, then ξ, then look at f: the mean and variance of that mixture are A1 and A2."""
    propagate = NISP(SMOOTH, Gaussian(), X)
    found = embedded_prediction(propagate, CENTER, DRAWS)
    count = 200_000
    generator = torch.Generator().manual_seed(3)
    chosen = torch.randint(len(DRAWS), (count,), generator=generator)
    outputs = propagate.outputs_at(DRAWS[chosen], propagate.draw_germ(count, seed=4), paired=True)
    # Five standard errors of a mean and of a variance.
    assert ((outputs.mean(0) - found.mean).abs() < 5 * found.sd / math.sqrt(count)).all()
    error = (((outputs - found.mean) ** 4).mean(0) - found.sd**4).div(count).sqrt()
    assert ((outputs.var(0) - found.sd**2).abs() < 5 * error).all()


def test_without_draws_the_map_is_the_prediction():
    found = embedded_prediction(NISP(SMOOTH, Gaussian(), X), CENTER, None)
    assert found.mean is found.map.mean
    assert found.sd is found.map.sd
    assert found.sd_model_error is found.map.sd
    assert found.sd_posterior is None
    assert found.posterior is None
    assert found.mean_predictive is None


def test_results_are_detached_float64_on_the_cpu():
    propagate = NISP(SMOOTH, Gaussian(), X).to(torch.float32)
    found = embedded_prediction(propagate, CENTER.requires_grad_(), DRAWS)
    CENTER.requires_grad_(False)
    for value in (found.mean, found.sd, found.map.mean, found.map.sd, found.sd_posterior, found.mean_predictive.sd):
        assert value.dtype == torch.float64
        assert not value.requires_grad
        assert value.device.type == "cpu"


def test_additive_prediction_keeps_push_forward_and_posterior_apart():
    propagate = NISP(SMOOTH, PolynomialChaos(order=0), X)
    draws = torch.cat([DRAWS[:, [0, 2]], draw(60, 1, seed=5)], dim=1)
    found = additive_prediction(propagate, CENTER[[0, 2]], draws, log_sigma_map=-1.0)
    outputs = torch.exp(0.4 * draws[:, :1]) + draws[:, 1:2] * X
    torch.testing.assert_close(found.push_forward.mean, outputs.mean(0), **EXACT)
    torch.testing.assert_close(found.push_forward.sd, outputs.std(0, unbiased=False), **EXACT)
    torch.testing.assert_close(found.posterior.mean, outputs.mean(0), **EXACT)
    noise = (2 * draws[:, 2]).exp().mean()
    torch.testing.assert_close(found.posterior.sd**2, outputs.var(0, unbiased=False) + noise, **EXACT)
    torch.testing.assert_close(found.map.sd, torch.full_like(X, math.exp(-1)), **EXACT)
    alone = additive_prediction(propagate, CENTER[[0, 2]], None, log_sigma_map=-1.0)
    assert (alone.push_forward.sd == 0).all()
    torch.testing.assert_close(alone.posterior.sd, found.map.sd, rtol=0, atol=0)


# --- ln k(T), Eqs. 45-48 --------------------------------------------------------------------------

R = 1.9872041  # cal/mol/K


@pytest.fixture(scope="module")
def rate():
    """A two-parameter rate law that is wrong by a curvature in 1/T."""
    parameters = [Parameter("lnA", low=28.5, high=36.0), Parameter("E", unit="cal/mol", low=36315.5, high=56954.0)]
    simulator = Simulator(lambda x, p: p["E"] / (R * x["T0"]) - p["lnA"] + 0.1 * x["phi"], parameters)
    t0 = torch.linspace(1000, 1300, 8, dtype=torch.float64)
    phi = torch.ones(8, dtype=torch.float64)
    y = 46_000 / (R * t0) - 32 + 0.1 + 2e-5 * (t0 - 1150) ** 2
    recording = tc.Recording(x={"T0": t0, "phi": phi}, y=y, noise="none")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tc.errors.ConvergenceWarning)
        return tc.calibrate(simulator, recording, likelihood=tc.likelihoods.ABC(epsilon=0.05), num_samples=0)


TEMPERATURE = torch.linspace(900, 1500, 5, dtype=torch.float64)


def test_the_rate_has_its_analytic_moments(rate):
    """Eqs. 45-48, with ln A_0, E_0, Δln A and ΔE the centres and half-widths of the bounds."""
    found = rate.predict({"T": TEMPERATURE}, function=lambda x, p: p["lnA"] - p["E"] / (R * x["T"]))
    a0, a1, b0, b1, b2 = rate.map.alpha.tolist()
    assert rate.alpha_names == ("lnA[0]", "lnA[xi1]", "E[0]", "E[xi1]", "E[xi2]")
    ln_a0, d_ln_a = (36.0 + 28.5) / 2, (36.0 - 28.5) / 2
    e0, d_e = (56954.0 + 36315.5) / 2, (56954.0 - 36315.5) / 2
    rt = R * TEMPERATURE
    mean = ln_a0 - e0 / rt + a0 * d_ln_a - b0 * d_e / rt
    variance = (a1 * d_ln_a - b1 * d_e / rt) ** 2 + (b2 * d_e / rt) ** 2
    torch.testing.assert_close(found.map.mean, mean, rtol=1e-11, atol=0)
    # At a ridge the two terms of the variance cancel: absolute, against the mean's size of 10.
    torch.testing.assert_close(found.map.sd, variance.sqrt(), rtol=1e-6, atol=1e-9)
    assert torch.equal(found.x["T"], TEMPERATURE)


def test_another_function_may_have_conditions_of_its_own(rate):
    by_name = rate.predict({"T": TEMPERATURE}, function=lambda x, p: p["lnA"] - p["E"] / (R * x["T"]))
    plain = rate.predict(TEMPERATURE, function=lambda x, p: p["lnA"] - p["E"] / (R * x))
    torch.testing.assert_close(plain.map.sd, by_name.map.sd, rtol=0, atol=0)
    at_data = rate.predict(function=lambda x, p: p["lnA"] - p["E"] / (R * x["T0"]))
    assert at_data.mean.shape == (8,)


def test_a_nonlinear_function_of_a_linear_calibration():
    x = torch.linspace(-1, 1, 6, dtype=torch.float64)
    line = Simulator(lambda x, p: p["a"] + p["b"] * x, AB, degree=1)
    found = tc.calibrate(
        line, tc.Recording(x=x, y=1 + x + x**2), likelihood=tc.likelihoods.ABC(epsilon=0.1), num_samples=0
    )
    m, v = float(found.map.mean[1]), float(found.map.covariance[1, 1])
    prediction = found.predict([0.0], function=lambda x, p: torch.exp(3 * p["b"]) + 0 * x)
    assert float(prediction.mean) == pytest.approx(math.exp(3 * m + 4.5 * v), rel=1e-6)
    assert float(prediction.sd) == pytest.approx(
        math.sqrt(math.expm1(9 * v)) * math.exp(3 * m + 4.5 * v), rel=1e-5
    )


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (TEMPERATURE, r"dict with \['T0', 'phi'\]"),
        ({"T0": TEMPERATURE}, r"dict with \['T0', 'phi'\]"),
        ({"T0": TEMPERATURE, "phi": [1.0]}, "one length"),
        ({"T0": [1000.0, math.nan], "phi": [1.0, 1.0]}, "not finite"),
        ({"T0": TEMPERATURE[None], "phi": [1.0]}, r"shape \(1, 5\)"),
        ({"T0": ["hot"], "phi": [1.0]}, "as real numbers"),
    ],
)
def test_conditions_other_than_the_recordings_are_refused(rate, x, message):
    with pytest.raises(DomainError, match=message):
        rate.predict(x)


def test_predictions_elsewhere_take_arrays_of_any_kind(rate):
    expected = rate.predict({"T0": [1050.0, 1250.0], "phi": [1.0, 2.0]})
    for x in (
        {"T0": np.array([1050, 1250]), "phi": np.array([1.0, 2.0], dtype=np.float32)},
        {"phi": torch.tensor([1, 2]), "T0": torch.tensor([1050.0, 1250.0])},
    ):
        torch.testing.assert_close(rate.predict(x).mean, expected.mean, rtol=0, atol=0)
    assert rate.predict({"T0": 1050.0, "phi": 1.0}).mean.shape == (1,)


# --- the density of λ, Eq. 44 ---------------------------------------------------------------------


def grid(mean, sd, width, count):
    ends = [(float(m - width * s), float(m + width * s)) for m, s in zip(mean, sd, strict=True)]
    axes = [torch.linspace(low, high, count, dtype=torch.float64) for low, high in ends]
    return torch.cartesian_prod(*axes).reshape(-1, len(axes)), axes


@pytest.mark.parametrize("embedding", [Gaussian(), IndependentGaussian()])
def test_normal_embeddings_are_averaged_exactly(embedding):
    parameters = [Parameter("a", low=10.0, high=20.0), Parameter("b", initial=-3.0)]
    propagate = NISP(Simulator(lambda x, p: p["a"] + p["b"] * x, parameters), embedding, X)
    alpha = torch.where(propagate.pattern.leading, 0.0, 0.4) + 0.05 * draw(7, propagate.num_alpha)
    mean, covariance = propagate.parameter_moments(alpha)
    points = mean.mean(0) + draw(20, 2) * covariance.diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    densities = [
        stats.multivariate_normal(m.numpy(), c.numpy()).pdf(points.numpy())
        for m, c in zip(mean, covariance, strict=True)
    ]
    expected = np.mean(densities, axis=0)
    np.testing.assert_allclose(parameter_density(propagate, alpha, points).numpy(), expected, rtol=1e-9)


@pytest.mark.parametrize("sd", [0.5, 3.0])
@pytest.mark.parametrize("order", [1, 2])
def test_the_density_of_a_parameter_on_a_logarithmic_scale_is_none_below_zero(order, sd):
    propagate = NISP(
        Simulator(lambda x, p: p["k"].log() + x, [Parameter("k", transform="log", initial=2.0)]),
        PolynomialChaos(order=order), X,
    )  # fmt: skip
    alpha = torch.tensor([[0.3, sd, 0.0][: order + 1], [0.1, sd, 0.0][: order + 1]], dtype=torch.float64)
    k = torch.tensor([[-1.0], [0.0], [2 * math.exp(-sd)], [2.0], [2 * math.exp(1.2 * sd)]], dtype=torch.float64)
    expected = [stats.lognorm(sd, scale=2 * math.exp(m)).pdf(k[:, 0].numpy()) for m in (0.3, 0.1)]
    # With the square, draws: 20000, bandwidth 0.15 of the sd.
    tolerance = 1e-9 if order == 1 else 0.1
    found = parameter_density(propagate, alpha, k).numpy()
    np.testing.assert_allclose(found, np.mean(expected, axis=0), rtol=tolerance)


@pytest.mark.parametrize(
    ("embedding", "parameters", "tolerance"),
    [
        # Sums over a grid of smooth densities converge spectrally; six sd hold all of a normal.
        pytest.param(Gaussian(), AB, 1e-6, id="exact"),
        # A kernel density too, but for what lies outside the grid and its kernels, narrower than the grid's steps.
        pytest.param(Uniform(), AB, 1e-2, id="uniform"),
        pytest.param(PolynomialChaos(order=2), AB, 2e-2, id="second order"),
        pytest.param(Gaussian(), [Parameter("a", transform="log"), Parameter("b")], 2e-2, id="log"),
    ],
)
def test_the_density_integrates_to_one(embedding, parameters, tolerance):
    propagate = NISP(Simulator(lambda x, p: p["a"] + p["b"] * x, parameters), embedding, X)
    first_order = propagate.pattern.indices[propagate.pattern.columns].sum(-1) == 1
    alpha = torch.where(first_order, 0.4, 0.0).to(torch.float64) + 0.05 * draw(5, propagate.num_alpha)
    mean, covariance = propagate.parameter_moments(alpha)
    points, axes = grid(mean.mean(0), covariance.mean(0).diagonal().sqrt(), 6, 41)
    density = parameter_density(propagate, alpha, points).reshape(41, 41)
    assert (density >= 0).all()
    total = torch.trapezoid(torch.trapezoid(density, axes[1]), axes[0])
    assert float(total) == pytest.approx(1.0, abs=tolerance)


def test_the_density_of_a_uniform_parameter_is_flat():
    propagate = NISP(Simulator(lambda x, p: p["a"] * x, [Parameter("a")]), Uniform(), X)
    alpha = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    points = torch.tensor([[-2.0], [0.0], [1.0], [2.0], [4.0]], dtype=torch.float64)
    found = parameter_density(propagate, alpha, points)
    # 20000 draws, bandwidth 0.15 of the sd: relative error 1 / sqrt(20000 · 0.16 · 3.5 / 4) = 2 %; three allowed.
    torch.testing.assert_close(found[1:4], torch.full((3,), 0.25, dtype=torch.float64), rtol=0.06, atol=0)
    assert found[0] < 1e-6
    assert found[4] < 1e-6


def test_a_parameter_of_one_value_has_no_density():
    propagate = NISP(Simulator(lambda x, p: p["a"] + p["b"] * x, AB), Gaussian(("a",)), X)
    with pytest.raises(DomainError, match="no density"):
        parameter_density(propagate, torch.tensor([[1.0, 0.5, 2.0]], dtype=torch.float64), torch.ones(1, 2))
    alpha = torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64) + 0.1 * draw(50, 3)
    assert float(parameter_density(propagate, alpha, torch.tensor([[1.0, 2.0]]).double())) > 0


@pytest.mark.parametrize("points", [torch.ones(2), torch.ones(3, 1), torch.ones(1, 2, 2)])
def test_points_need_a_column_for_each_parameter(points):
    propagate = NISP(SMOOTH, Gaussian(), X)
    with pytest.raises(ShapeError, match=r"\(M, 2\)"):
        parameter_density(propagate, CENTER[None], points)


@pytest.mark.parametrize("size", [1, 2])
def test_kernel_density_is_scipys(size):
    draws = draw(200, size) @ draw(size, size, seed=2) * torch.logspace(0, 3, size, dtype=torch.float64)
    points = draws[:7] * 1.1
    expected = stats.gaussian_kde(draws.T.numpy(), "silverman")(points.T.numpy())
    np.testing.assert_allclose(kernel_density(draws, points).numpy(), expected, rtol=1e-6)


def test_one_dimensional_density_is_normalised():
    draws = draw(300, 1)
    total = integrate.quad(lambda t: float(kernel_density(draws, torch.tensor([[t]], dtype=torch.float64))), -9, 9)[0]
    assert total == pytest.approx(1.0, abs=1e-6)


# --- scores ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [None, 0.7])
def test_scores_are_scipys(noise):
    y, mean, sd = draw(40), draw(40, seed=2), draw(40, seed=3).abs() + 0.2
    s = None if noise is None else torch.full((40,), noise, dtype=torch.float64)
    width = sd.numpy() if noise is None else np.hypot(sd.numpy(), noise)
    oracle = stats.norm(mean.numpy(), width)
    found = scores(y, Moments(mean, sd), noise=s, level=0.9)
    assert found.rmse == pytest.approx(float(np.sqrt(np.mean((y - mean).numpy() ** 2))), rel=1e-12)
    assert found.log_score == pytest.approx(oracle.logpdf(y.numpy()).mean(), rel=1e-12)
    low, high = oracle.interval(0.9)
    assert found.coverage == pytest.approx(np.mean((y.numpy() >= low) & (y.numpy() <= high)), abs=1e-12)
    assert found.level == 0.9


def test_missing_data_count_nowhere():
    y, mean, sd = draw(40), draw(40, seed=2), draw(40, seed=3).abs() + 0.2
    gaps = y.clone()
    gaps[::3] = math.nan
    known = ~gaps.isnan()
    noise = draw(40, seed=4).abs()
    there = scores(y[known], Moments(mean[known], sd[known]), noise=noise[known])
    noise[~known] = math.nan
    for moments in (Moments(mean, sd), Moments(mean, torch.where(known, sd, 0 * sd))):
        assert scores(gaps, moments, noise=noise) == there
    with pytest.raises(DomainError, match="at least one datum"):
        scores(0 * y / 0, Moments(mean, sd))


@pytest.mark.parametrize("noise", [0.7, 1, [0.7] * 6, np.full(6, 0.7), torch.full((6,), 0.7), torch.tensor(0.7)])
def test_noise_is_a_number_or_one_for_each_datum(noise):
    y, mean, sd = draw(6), draw(6, seed=2), draw(6, seed=3).abs() + 0.2
    wanted = (sd.square() + (1.0 if isinstance(noise, int) else 0.49)).sqrt()
    found, plain = scores(y.tolist(), Moments(mean, sd), noise=noise), scores(y, Moments(mean, wanted))
    assert found.log_score == pytest.approx(plain.log_score, rel=1e-6)
    assert found.coverage == plain.coverage


@pytest.mark.parametrize(
    ("noise", "error", "message"),
    [
        ([0.1, 0.1], ShapeError, r"noise of shape \(6,\).*Got \(2,\)"),
        (torch.ones(6, 1), ShapeError, r"noise of shape \(6,\).*Got \(6, 1\)"),
        ("none", DomainError, "noise as one number"),
        (-0.1, DomainError, "noise >= 0"),
        (math.nan, DomainError, "Got NaN"),
    ],
)
def test_noise_of_another_kind_is_refused(noise, error, message):
    y = torch.ones(6, dtype=torch.float64)
    with pytest.raises(error, match=message):
        scores(y, Moments(y, y), noise=noise)


def test_scores_refuse_what_has_no_score():
    y = torch.ones(4, dtype=torch.float64)
    with pytest.raises(ShapeError, match="as the mean"):
        scores(y[:, None], Moments(y, y))
    for level in (2.0, "a", True, None):
        with pytest.raises(DomainError, match="level between 0 and 1"):
            scores(y, Moments(y, y), level=level)
    with pytest.raises(DomainError, match="sd > 0"):
        scores(y, Moments(y, 0 * y))
    with pytest.raises(DomainError, match=r"finite data\. Got an infinite one"):
        scores(y / 0, Moments(y, y))
    assert scores(1e14 * y, Moments(y, y)).coverage == 0.0


def test_masked_data_count_nowhere():
    moments = Moments(torch.zeros(3), torch.ones(3))
    masked = np.ma.array([1.0, 999.0, 3.0], mask=[False, True, False])
    assert scores(masked, moments).rmse == pytest.approx(5**0.5)
    assert scores(np.array([1.0, 2.0, 3.0], dtype=">f8"), moments).rmse == pytest.approx((14 / 3) ** 0.5)


def test_a_parameter_without_a_density_is_told_as_it_is():
    parameter = Parameter("k", transform="log", initial=100.0)
    propagate = NISP(Simulator(lambda x, p: p["k"] * x, [parameter]), Gaussian(), X)
    alpha = torch.tensor([[0.0, 0.0]], dtype=torch.float64)
    with pytest.raises(DomainError, match="Got the value 100 alone in column 0"):
        parameter_density(propagate, alpha, torch.ones(1, 1, dtype=torch.float64))


def test_results_are_shown_in_lines_that_can_be_read():
    x = torch.linspace(0, 1, 200, dtype=torch.float64)
    line = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")], degree=1)
    fit = tc.calibrate(line, tc.Recording(x=x, y=2 * x + x**2), num_samples=0, seed=0, progress=False)
    additive = tc.calibrate_additive(line, tc.Recording(x=x, y=2 * x + x**2), num_samples=0, seed=0, progress=False)
    for shown in (fit.predict(), fit.predict().map, fit.map, fit.diagnostics, additive.predict(), additive.map):
        assert "tensor" not in repr(shown)
        assert max(map(len, repr(shown).splitlines())) < 160
        assert len(repr(shown)) < 1000
    assert repr(fit.predict()).startswith("prediction of 200 outputs: mean 0 to ")
    assert "E[λ]" in repr(fit.map)
