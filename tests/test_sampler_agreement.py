"""The batched sampler against Pyro: the same density, value by value, and the same posterior, draw by draw."""

import dataclasses
import importlib
import math
import warnings

import pyro
import pytest
import torch
from pyro.infer.mcmc.util import initialize_model
from pyro.ops.stats import effective_sample_size

import torchcal as tc
from examples import cubic
from torchcal import likelihoods, priors
from torchcal.errors import ConvergenceWarning, IdentifiabilityWarning, ToleranceWarning
from torchcal.inference import sampling

stats = pytest.importorskip("scipy.stats")

ALPHA = 1e-3
"""Chance that one test fails though the samplers agree; shared out among what it compares."""


# --- the density, value by value -----------------------------------------------------------------------------

X = torch.linspace(-1, 1, 14, dtype=torch.float64)
BOUNDED = [tc.Parameter("a", low=0.0, high=4.0), tc.Parameter("b", low=-0.5), tc.Parameter("c", high=3.0)]
FREE = [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("c")]


def one_output(x, p):
    return p["a"] * (1 + 0.3 * torch.sin(p["b"] * x)) + p["c"] * x**2


def two_outputs(x, p):
    return {"first": p["a"] + p["b"] * x * p["c"], "second": 100 * torch.exp(0.3 * p["c"]) - 50 * p["b"] * x**2}


def one_recording(n, noise):
    x = X if n == len(X) else torch.tensor([-0.7, 0.8], dtype=torch.float64)
    return tc.Recording(x=x, y=2 + x + x**2 + 0.3 * torch.sin(5 * x), noise=noise)


def two_recordings():
    """Two outputs of different size and noise, and a datum of each missing."""
    first, second = 2 + X + 0.2 * torch.cos(4 * X), 130 - 40 * X**2 + 5 * torch.sin(6 * X)
    first[3], second[10] = torch.nan, torch.nan
    noise = {"first": 0.05, "second": 2.0}
    return tc.Recording(x={"x": X}, y={"first": first, "second": second}, noise=noise, missing=True)


def two_outputs_by_name(x, p):
    return two_outputs(x["x"], p)


def normal(module):
    return priors.Normal(module, loc=0.1, scale=0.8)


def uniform(module):
    return priors.Uniform(module, leading=12.0, spread=3.0)


LIKELIHOODS = {
    "abc": likelihoods.ABC(epsilon=0.1, gamma=1.3),
    "abc_mean": likelihoods.ABCMean(epsilon=0.1),
    "gaussian_marginal": likelihoods.GaussianMarginal(),
    "marginal": likelihoods.Marginal(num_samples=24, floor=0.02),
    "full": likelihoods.Full(num_samples=24, floor=0.02),
}
PRIORS = {"flat": priors.Flat, "uniform": uniform, "normal": normal}
# Flat is improper with these two, and is refused. Each likelihood runs always with each prior, by turns with bounds.
CASES = [
    pytest.param(
        LIKELIHOODS[name], PRIORS[prior], bounded, noise, id=f"{name}, {prior}, {words}",
        marks=() if (i + j + bounded) % 2 else pytest.mark.slow,
    )
    for i, name in enumerate(LIKELIHOODS)
    for j, prior in enumerate(PRIORS)
    for bounded, noise, words in ((True, None, "bounds"), (False, 0.1, "no bounds, noise"))
    if prior != "flat" or name not in ("full", "abc_mean")
]  # fmt: skip


def captured(monkeypatch, calibrate, *arguments, **options):
    """What `calibrate` hands to either sampler: the batched log-density; the Pyro model and its arguments."""
    module = importlib.import_module(calibrate.__module__)
    given = {}

    class EnoughSeen(Exception):
        pass

    def batched(log_density, *_, **__):
        given["batched"] = log_density
        raise EnoughSeen

    def reference(model, model_arguments, *_, **__):
        given["pyro"] = (model, model_arguments)
        raise EnoughSeen

    original = sampling.draw

    def draw(problem, estimate, model, plan, **rest):
        for sampler in ("nuts", "pyro"):
            with pytest.raises(EnoughSeen):
                original(problem, estimate, model, dataclasses.replace(plan, sampler=sampler), **rest)
        raise EnoughSeen

    monkeypatch.setattr(sampling, "run_batched", batched)
    monkeypatch.setattr(sampling, "run_nuts", reference)
    monkeypatch.setattr(module, "draw_unless_interrupted", draw)
    with warnings.catch_warnings():
        # Two starts, which need not find the maximum: any point will do to compare densities around.
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        with pytest.raises(EnoughSeen):
            calibrate(*arguments, num_samples=10, num_starts=2, **options)
    return given


def check_same_density(given):
    log_density, (model, arguments) = given["batched"], given["pyro"]
    (prior,) = (argument for argument in arguments if isinstance(argument, priors.CoefficientPrior))
    transform = prior.support.transform
    z = 1.5 * torch.randn(15, len(prior.low), dtype=torch.float64)
    found = log_density(transform.unwhiten(z))
    expected, potential = [], initialize_model(model, arguments)[1]
    for point in z:
        alpha = transform(point)
        conditioned = pyro.poutine.condition(model, data={"alpha": alpha})
        value = pyro.poutine.trace(conditioned).get_trace(*arguments).log_prob_sum()
        value = value + transform.log_abs_det_jacobian(point, alpha)
        # This is the function whose gradient Pyro's NUTS follows.
        assert float(potential({"alpha": point})) == pytest.approx(-float(value), rel=1e-10, abs=1e-10)
        expected.append(value)
    expected = torch.stack(expected).detach()
    assert bool(torch.isfinite(expected).all())
    # Where nothing changed from point to point, two constants would agree too.
    assert float(expected.max() - expected.min()) > 1
    # The constant is known as well: the volume of the whitening, which the batched sampler leaves out.
    constant = transform.scale_tril.diagonal().log().sum()
    torch.testing.assert_close(found.detach() + constant, expected, rtol=1e-10, atol=1e-10)
    return prior


@pytest.mark.parametrize(("likelihood", "prior", "bounded", "noise"), CASES)
def test_the_density_is_that_of_the_pyro_model(likelihood, prior, bounded, noise, monkeypatch):
    full = likelihood.name == "full"
    simulator = tc.Simulator(one_output, BOUNDED if bounded else FREE)
    # Without noise the densities of the outputs' moments are singular at zero spread: they come with noise here.
    noise = 0.1 if likelihood.name in ("gaussian_marginal", "marginal", "full") else noise
    recording = one_recording(2 if full else len(X), noise)
    given = captured(monkeypatch, tc.calibrate, simulator, recording, likelihood=likelihood, prior=prior, rule=3)
    used = check_same_density(given)
    assert used.transform.free == (not bounded and prior is not uniform)


@pytest.mark.parametrize("likelihood", LIKELIHOODS.values(), ids=LIKELIHOODS)
def test_the_density_with_several_outputs_and_missing_data(likelihood, monkeypatch):
    simulator = tc.Simulator(two_outputs_by_name, BOUNDED)
    recording = two_recordings()
    if likelihood.name == "full":
        keep = torch.tensor([3, 5])  # three outputs are left of four, as many as there are parameters
        runs = {name: recording.y.reshape(2, -1)[i, keep] for i, name in enumerate(recording.outputs)}
        recording = tc.Recording(x={"x": X[keep]}, y=runs, noise={"first": 0.05, "second": 2.0}, missing=True)
    elif hasattr(likelihood, "epsilon"):
        sizes = torch.where(torch.arange(2 * len(X)) < len(X), 0.1, 4.0).to(torch.float64)
        likelihood = dataclasses.replace(likelihood, epsilon=sizes[recording.observed])
    given = captured(monkeypatch, tc.calibrate, simulator, recording, likelihood=likelihood, prior=normal, rule=3)
    check_same_density(given)


@pytest.mark.parametrize("kind", ["one output", "bounds", "noise", "several outputs"])
def test_the_density_of_the_additive_model(kind, monkeypatch):
    parameters = FREE if kind == "one output" else BOUNDED
    if kind == "several outputs":
        simulator = tc.Simulator(two_outputs_by_name, parameters)
        recording = two_recordings()
    else:
        simulator = tc.Simulator(one_output, parameters)
        recording = one_recording(len(X), 0.1 if kind == "noise" else None)
    given = captured(monkeypatch, tc.calibrate_additive, simulator, recording)
    used = check_same_density(given)
    assert len(used.low) == 4
    assert used.transform.free == (kind == "one output")


# --- the posterior, draw by draw -----------------------------------------------------------------------------


def mean_ess(values):
    """Effective sample size of the mean of ``(chains, draws)``, at most the number of draws."""
    half = values.shape[1] // 2
    found = float(effective_sample_size(torch.cat([values[:, :half], values[:, -half:]])[..., None]))
    return min(max(found, 4.0), float(values.numel())) if math.isfinite(found) else 4.0


def independent(values):
    """Draws of ``(chains, draws)`` far enough apart to count as independent."""
    every = max(1, math.ceil(2 * values.numel() / mean_ess(values)))
    return values[:, ::every].flatten().numpy()


def check_same_distribution(found, expected, names, *, level=ALPHA, least=100):
    """Mean, variance and distribution of each column of draws ``(chains, draws, columns)``."""
    count = found.shape[-1]
    worst = stats.norm.isf(level / (3 * count) / 2)
    for i, name in enumerate(names):
        one, other = found[..., i], expected[..., i]
        center = other.mean()
        for what, power in (("mean", 1), ("variance", 2)):
            a, b = (one - center) ** power, (other - center) ** power
            sizes = mean_ess(a), mean_ess(b)
            # A comparison of a few effective draws would pass whatever they are.
            assert min(sizes) > least, f"{what} of {name}: {sizes}"
            error = math.sqrt(float(a.var()) / sizes[0] + float(b.var()) / sizes[1])
            assert abs(float(a.mean() - b.mean())) < worst * error, f"{what} of {name}"
        p = stats.ks_2samp(independent(one), independent(other)).pvalue
        assert p > level / (3 * count), f"distribution of {name}: p = {p:.2g}"


def with_moments(calibration):
    """α, and E[λ] and Cov[λ], which no sign of a germ touches, ``(chains, draws, columns)``, with names."""
    mean, covariance = calibration.propagate.parameter_moments(calibration.samples)
    row, column = torch.tril_indices(*covariance.shape[-2:])
    scale = calibration.propagate.scaling.scale
    moments = [mean / scale, (covariance / scale.outer(scale))[..., row, column]]
    names = [*calibration.alpha_names, *(f"E[λ{i}]" for i in range(len(scale)))]
    names += [f"Cov[λ{i}, λ{j}]" for i, j in zip(row.tolist(), column.tolist(), strict=True)]
    return torch.cat([calibration.samples, *moments], dim=-1), names


def quietly(calibrate, *arguments, **options):
    """Short chains are announced; here the tolerances follow from their effective sample sizes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.simplefilter("ignore", ToleranceWarning)
        return calibrate(*arguments, **options)


def check_same_posterior(found, expected):
    # Signs of germs are folded towards the maximum, which has to be the same one.
    torch.testing.assert_close(found.map.alpha, expected.map.alpha, rtol=0, atol=1e-8)
    (one, names), (other, _) = with_moments(found), with_moments(expected)
    check_same_distribution(one, other, names)


@pytest.fixture(scope="module", params=[pytest.param(0.1, marks=pytest.mark.slow), 0.01])
def cubic_reference(request):
    """The tolerance, and Pyro's draws."""
    options = {"num_samples": 240, "num_chains": 2, "num_warmup": 100, "sampler": "pyro"}
    return request.param, quietly(cubic.estimate, "linear", 11, epsilon=request.param, **options)


@pytest.mark.parametrize("sampler", ["nuts", "hmc"])
def test_pyro_draws_the_same_cubic_posterior(sampler, cubic_reference):
    epsilon, expected = cubic_reference
    options = {"num_samples": 60, "num_chains": 48, "num_warmup": 60, "sampler": sampler}
    check_same_posterior(quietly(cubic.estimate, "linear", 11, epsilon=epsilon, **options), expected)


def test_the_comparison_notices_a_posterior_that_is_too_wide_or_shifted():
    found, expected = (torch.randn(8, 100, 1, dtype=torch.float64) for _ in range(2))
    check_same_distribution(found, expected, ["z"])
    for wrong in (1.3 * found, found + 0.3):
        with pytest.raises(AssertionError, match="of z"):
            check_same_distribution(wrong, expected, ["z"])


@pytest.mark.slow
def test_pyro_draws_the_same_posterior_of_ignition_1(tmp_path):
    pytest.importorskip("cantera")
    from examples.ignition import study

    prepared = study.prepare("1a", tmp_path)
    draws = {"num_samples": 600, "num_chains": 2, "num_warmup": 300}
    expected = quietly(study.calibrate, prepared, 0.01, sampler="pyro", **draws)
    for sampler in ("nuts", "hmc"):
        found = quietly(study.calibrate, prepared, 0.01, sampler=sampler, num_samples=150, num_chains=48)
        check_same_posterior(found, expected)


def moved(log_density, u, *, steps, seed=0):
    """Points ``(S, P)`` after so many random-walk Metropolis steps, which leave the density as it is."""
    generator = torch.Generator().manual_seed(seed)
    factor = torch.linalg.cholesky(torch.cov(u.T))
    with torch.no_grad():
        value = log_density(u)
        for step in range(steps):
            noise = torch.randn(u.shape, dtype=u.dtype, generator=generator)
            trial = u + (0.1, 0.3, 0.7)[step % 3] * noise @ factor.T
            there = log_density(trial)
            accept = torch.rand(len(u), dtype=u.dtype, generator=generator).log() < there - value
            u, value = torch.where(accept[:, None], trial, u), torch.where(accept, there, value)
    return u


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["nuts", "hmc"])
def test_metropolis_leaves_the_posterior_of_ignition_2_as_it_is(sampler, tmp_path, monkeypatch):
    """Here the reference is a Metropolis kernel: Pyro's NUTS does not reach the ends of this bent posterior in minutes.

    Of two of Pyro's chains of 300 draws at ε = 0.01 the sd of E[xi1] was two thirds of the batched samplers', with a
    hundred effective draws by their own account. Under Metropolis they widen, and the batched samplers' draws stay.
    """
    pytest.importorskip("cantera")
    from examples.ignition import study

    prepared = study.prepare("2", tmp_path)
    found = quietly(study.calibrate, prepared, 0.01, sampler=sampler, num_samples=120, num_chains=48)
    options = {"order": study.OUTPUT_ORDER, "likelihood": likelihoods.ABC(epsilon=0.01)}
    given = captured(monkeypatch, tc.calibrate, prepared.surrogate, prepared.recording, **options)
    (prior,) = (argument for argument in given["pyro"][1] if isinstance(argument, priors.CoefficientPrior))
    pattern, log_density = found.propagate.pattern, given["batched"]

    def folded(u):
        return pattern.flip(prior.transform.bound(u), found.map.alpha)

    # Fewer than there are effective draws, so that they count as independent.
    start = prior.transform.unbound(found.draws[torch.randperm(len(found.draws))[:300]])
    after = folded(moved(log_density, start, steps=1500))
    check_same_distribution(folded(start)[None], after[None], found.alpha_names)
    narrow = start.mean(0) + 0.6 * (start - start.mean(0))
    after = folded(moved(log_density, narrow, steps=1500))
    with pytest.raises(AssertionError, match=r"variance|distribution"):
        check_same_distribution(folded(narrow)[None], after[None], found.alpha_names)
