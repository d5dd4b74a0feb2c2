"""float32 within stated error of float64; and on a GPU, where there is one."""

import contextlib
import dataclasses
import math
import warnings

import pytest
import torch
from test_sampler_agreement import check_same_distribution, quietly, with_moments

import torchcal as tc
from examples import cubic
from torchcal.errors import DomainError

ROUNDING = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}
"""Largest relative error of one rounding."""

GPU = pytest.param(
    "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device here")
)
DEVICES = ["cpu", GPU]

X = torch.linspace(-1, 1, 21, dtype=torch.float32).double()  # the same numbers in either dtype
SMOOTH = tc.Simulator(
    lambda x, p: torch.exp(0.3 * p["a"] * x) + p["b"] * x + 0.5 * p["a"] * p["b"],
    [tc.Parameter("a"), tc.Parameter("b")],
)
EMBEDDINGS = {
    "normal": tc.embeddings.Gaussian(),
    "uniform": tc.embeddings.Uniform(),
    "second order": tc.embeddings.PolynomialChaos(order=2),
}


def densities(module):
    """Coefficients that both dtypes hold exactly, with a spread that is a visible part of the outputs."""
    alpha = torch.randn(16, module.num_alpha, dtype=torch.float32)
    first = module.pattern.indices[module.pattern.columns].sum(-1) == 1
    return torch.where(first, 0.3 + 0.3 * alpha.abs(), 0.3 * alpha)


def moments_and_slopes(module, alpha):
    """Mean and sd, ``(2, batch, n)``, and the gradients of their sums over the data, ``(2, batch, P)``."""
    leaf = alpha.clone().requires_grad_(True)
    values = module(leaf)
    slopes = [torch.autograd.grad(value.sum(), leaf, retain_graph=True)[0] for value in values]
    return torch.stack(values).detach().double().cpu(), torch.stack(slopes).double().cpu()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("order", [None, 2])
@pytest.mark.parametrize("name", EMBEDDINGS)
def test_moments_and_gradients_are_within_rounding(name, order, dtype, device):
    if device == "cpu" and dtype == torch.float64:
        pytest.skip("this is what the others are held against")
    exact = tc.NISP(SMOOTH, EMBEDDINGS[name], X, order=order, rule=6)
    module = exact.copy().to(device=device, dtype=dtype)
    alpha = densities(exact)
    expected, expected_slopes = moments_and_slopes(exact, alpha.double())
    found, slopes = moments_and_slopes(module, alpha.to(device=device, dtype=dtype))
    # To first order the errors add up: of the K terms of λ and its scaling, of ten operations of the model, and of a
    # sum over Q nodes, each of at most one rounding of what is summed. The variance sums squares of offsets from the
    # mean, and sd is a norm of them: as well known as the outputs, in absolute terms. The order's projection is a sum
    # of as many terms with |Ψ| weights, whose square sums to one.
    terms = len(exact.pattern.indices) + 2 + 10 + exact.num_nodes
    with torch.no_grad():
        outputs = exact.outputs_at(alpha.double(), exact.nodes)
    size = outputs.abs().amax((-1, -2))[:, None]
    bound = 2 * terms * ROUNDING[dtype] * size  # once for the outputs and once for their mean
    assert bool(((found - expected).abs() < bound).all())
    # Slopes of sd are those of the outputs times offset / sd, which is known to the outputs' error over the sd.
    sd = expected[1]
    slope_bound = 2 * terms * ROUNDING[dtype] * expected_slopes.abs().amax((0, -1))[:, None]
    assert bool(((slopes[0] - expected_slopes[0]).abs() < slope_bound).all())
    amplified = slope_bound * (size / sd.amin(-1, keepdim=True))
    assert bool(((slopes[1] - expected_slopes[1]).abs() < amplified).all())
    # The error is that of float32 and not of something that merely passes for it.
    if dtype == torch.float32:
        assert float((found - expected).abs().max()) > ROUNDING[torch.float64]
    assert float((bound / sd).max()) < 1e-2  # and the bound says something


@pytest.mark.parametrize("floor", [None, 1e-4])
@pytest.mark.parametrize("device", DEVICES)
def test_zero_spread_has_a_finite_gradient(device, floor):
    module = tc.NISP(SMOOTH, tc.embeddings.Gaussian(), X, sd_floor=floor).to(device=device, dtype=torch.float32)
    alpha = torch.zeros(3, module.num_alpha, dtype=torch.float32, device=device)
    alpha[1, 0], alpha[2, 1] = 1.0, 1e-12
    values, slopes = moments_and_slopes(module, alpha)
    assert bool(torch.isfinite(values).all())
    assert bool(torch.isfinite(slopes).all())
    assert bool((values[1] > 0).all())


def cubic_draws(**options):
    options = {"num_samples": 60, "num_chains": 48, "num_warmup": 60, **options}
    # Germs of either sign are the same density: which of them is the maximum found is a matter of rounding.
    return quietly(cubic.estimate, "linear", 11, epsilon=0.1, **options).relabelled()


@pytest.fixture(scope="module")
def reference():
    return cubic_draws(seed=0)


@pytest.mark.parametrize(
    ("device", "dtype"),
    [
        pytest.param("cpu", torch.float32, id="cpu, float32"),
        pytest.param(*GPU.values, torch.float32, marks=GPU.marks, id="cuda, float32"),
        pytest.param(*GPU.values, torch.float64, marks=GPU.marks, id="cuda, float64"),
    ],
)
def test_the_cubic_posterior_is_the_same(device, dtype, reference):
    found = cubic_draws(seed=0, device=device, dtype=dtype)
    # Numbers in results are float64 on the CPU; the maximum is found in float64 whatever the sampler's dtype.
    assert found.samples.dtype == torch.float64
    assert found.samples.device.type == "cpu"
    torch.testing.assert_close(found.map.alpha, reference.map.alpha, rtol=0, atol=1e-6)
    assert torch.equal(found.samples, found.samples.float().double()) == (dtype == torch.float32)
    (one, names), (other, _) = (with_moments(_on_cpu(result)) for result in (found, reference))
    check_same_distribution(one, other, names)


@pytest.mark.parametrize("device", DEVICES)
def test_the_additive_posterior_is_the_same(device):
    options = {"num_samples": 50, "num_chains": 32, "num_warmup": 50}
    one = quietly(cubic.conventional, "linear", 11, dtype=torch.float32, device=device, seed=1, **options)
    other = quietly(cubic.conventional, "linear", 11, seed=0, **options)
    check_same_distribution(one.samples, other.samples, one.alpha_names)


def _on_cpu(result):
    return dataclasses.replace(result, propagate=result.propagate.copy().to(device="cpu", dtype=torch.float64))


@pytest.mark.parametrize(("scale", "told"), [(1e-20, True), (1e-12, False), (1e12, False), (1e20, True)])
def test_units_beyond_single_precision_are_told(scale, told):
    x = torch.linspace(0, 4, 12, dtype=torch.float64)
    line = tc.Simulator(lambda x, p: scale * (p["a"] + p["b"] * x), [tc.Parameter("a"), tc.Parameter("b")])
    recording = tc.Recording(x=x, y=scale * (1 + x + 0.1 * torch.sin(5 * x)))
    options = {"num_samples": 4, "num_warmup": 20, "num_chains": 2, "seed": 0, "dtype": torch.float32}
    for calibrate in (tc.calibrate, tc.calibrate_additive):
        if told:
            with pytest.raises(DomainError, match="Use other units"):
                calibrate(line, recording, **options)
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", tc.errors.TorchcalWarning)
            found = calibrate(line, recording, **options)
        assert bool(found.samples.isfinite().all())


def test_a_tolerance_that_single_precision_cannot_resolve_is_refused_before_the_warm_up():
    x = torch.linspace(-1, 1, 21, dtype=torch.float64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    recording = tc.Recording(x=x, y=1 + 1.2 * x + 0.2 * x**2)
    options = {"num_samples": 4, "num_warmup": 20, "num_chains": 2, "num_starts": 8, "dtype": torch.float32}
    with pytest.raises(DomainError, match=r"differences of about 0\.5 can be told in torch\.float32.*float64"):
        tc.calibrate(line, recording, likelihood=tc.likelihoods.ABC(epsilon=5e-5), **options)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        tc.calibrate(line, recording, likelihood=tc.likelihoods.ABC(epsilon=3e-4), **options)
    assert any("distorts the draws. Use dtype=torch.float64" in str(w.message) for w in told)


@pytest.mark.parametrize("calibrate", [tc.calibrate, tc.calibrate_additive])
def test_what_is_small_beside_an_offset_is_not_drawn_in_single_precision(calibrate):
    x = torch.linspace(-1, 1, 21, dtype=torch.float64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    options = {"num_samples": 4, "num_warmup": 20, "num_chains": 2, "num_starts": 8, "dtype": torch.float32}
    refused = pytest.raises(DomainError, match=r"torch\.float32.*data that are not small beside an offset")
    for offset in (0.0, 1e6):
        with warnings.catch_warnings(), (refused if offset else contextlib.nullcontext()):
            warnings.simplefilter("ignore", tc.errors.TorchcalWarning)
            calibrate(line, tc.Recording(x=x, y=offset + x + 0.3 * x**2), **options)


@pytest.mark.filterwarnings("ignore::torchcal.errors.TorchcalWarning")
def test_single_precision_is_held_against_double_where_there_are_numbers():
    x = torch.linspace(-1, 1, 21, dtype=torch.float64)

    def line(x, p):
        return p["a"] + torch.where(p["b"] > 1.15, math.nan, p["b"]) * x

    model = tc.Simulator(line, [tc.Parameter("a"), tc.Parameter("b")])
    options = {"num_samples": 4, "num_warmup": 20, "num_chains": 2, "num_starts": 8, "dtype": torch.float32}
    with pytest.raises(DomainError, match="data that are not small beside an offset"):
        tc.calibrate_additive(model, tc.Recording(x=x, y=1e6 + x + 0.3 * x**2), **options)
