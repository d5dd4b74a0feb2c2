"""Gradients written out by hand against those of PyTorch, and where each is taken."""

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal import embeddings, likelihoods, priors
from torchcal.inference import by_hand, hmc_step, nuts_step
from torchcal.inference.arrays import Host
from torchcal.inference.coordinates import Whitened, slopes_of
from torchcal.models import Problem
from torchcal.propagation import NISP

X = torch.linspace(-1, 1, 15, dtype=torch.float64)  # more than any polynomial here has terms
Y = X.pow(3) + X

LINE = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")], degree=1)
BOUNDED = tc.Simulator(
    lambda x, p: p["a"] + p["b"] * x * p["a"] + 0.1 * p["b"] ** 3,
    [tc.Parameter("a", low=-2, high=3), tc.Parameter("b", low=0.1)],
    degree=3,
)
THREE = tc.Simulator(
    lambda x, p: p["a"] + p["b"] * x + p["c"] * p["a"] * x**2,
    [tc.Parameter("a"), tc.Parameter("b", high=4.0), tc.Parameter("c")],
    degree=2,
)
ANY = tc.Simulator(
    lambda x, p: p["a"] * torch.exp(p["b"] * x), [tc.Parameter("a", low=0.0, high=5.0), tc.Parameter("b", initial=1.0)]
)
LOGARITHMIC = tc.Simulator(
    lambda x, p: p["k"] * x + p["b"], [tc.Parameter("k", low=0.1, high=10, transform="log"), tc.Parameter("b")]
)


def problem(simulator, embedding=None, likelihood=None, prior=priors.Flat, dtype=torch.float64, **options):
    embedding = embedding or embeddings.Gaussian()
    fields = {name: options.pop(name, None) for name in ("noise", "observed")}
    propagate = NISP(simulator, embedding, X, sd_floor=1e-4, **options)
    likelihood = likelihood or likelihoods.ABC(epsilon=0.05)
    return Problem(y=Y, propagate=propagate, likelihood=likelihood, prior=prior(propagate), **fields).cast(dtype)


def density(target):
    transform = target.prior.transform
    return lambda u: target.log_prob(transform.bound(u)) + transform.log_slope(u)


CASES = {
    "line": {"simulator": LINE},
    "line, first order": {"simulator": LINE, "order": 1},
    "independent": {"simulator": LINE, "embedding": embeddings.IndependentGaussian()},
    "one parameter": {"simulator": LINE, "embedding": embeddings.Gaussian(parameters=["a"])},
    "bounded": {"simulator": BOUNDED},
    "bounded, first order": {"simulator": BOUNDED, "order": 1},
    "bounded, few nodes": {"simulator": BOUNDED, "rule": 2},
    "uniform germs of second order": {
        "simulator": BOUNDED,
        "embedding": embeddings.PolynomialChaos(order=2, germ="legendre"),
    },
    "three": {"simulator": THREE},
    "any": {"simulator": ANY},
    "any, first order": {"simulator": ANY, "order": 1},
    "logarithmic": {"simulator": LOGARITHMIC},
    "missing": {"simulator": BOUNDED, "observed": X.abs() > 0.1},
    "missing, any": {"simulator": ANY, "observed": X.abs() > 0.1},
    "noise": {"simulator": LINE, "noise": torch.full_like(X, 0.3)},
    "tolerances": {"simulator": ANY, "likelihood": likelihoods.ABC(epsilon=0.05 + X.abs(), gamma=0.7)},
    "box": {"simulator": LINE, "prior": priors.Uniform},
}


@pytest.mark.parametrize("name", CASES)
def test_values_and_gradients_are_those_of_the_pyro_model(name):
    target = problem(**CASES[name])
    closed = CASES[name]["simulator"] not in (ANY, LOGARITHMIC)
    assert (target.propagate._table is not None) == closed  # every polynomial goes the way of polynomials
    hand = by_hand.by_hand(target, None)  # which would be called for anything else
    generator = torch.Generator().manual_seed(1)
    u = torch.randn(40, target.propagate.num_alpha, dtype=torch.float64, generator=generator)
    u[0] *= 20  # where logistic and softplus coordinates are flat
    value, slope = hand(u)
    wanted, gradient = slopes_of(density(target))(u)
    told = wanted.abs() < 1e12  # past which the exponential of a parameter is near the end of numbers
    assert int(told.sum()) >= 30
    torch.testing.assert_close(value[told], wanted[told], rtol=1e-10, atol=1e-10)
    off = (slope - gradient).norm(dim=1) / gradient.norm(dim=1)
    assert float(off[told].max()) < 1e-10


@pytest.mark.parametrize("bounds", [{"low": 0.3}, {"high": 0.3}, {"low": -0.1, "high": 0.3}])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_coordinates_far_out_stay_within_bounds(bounds, dtype):
    """Where the simulator is singular beyond them, and a rounding error would be no number."""
    edge = bounds.get("high", bounds.get("low"))
    root = tc.Simulator(lambda x, p: p["a"] + torch.sqrt((p["b"] - edge).abs() * x.sign().abs() + 1e-30) * x,
                        [tc.Parameter("a"), tc.Parameter("b", **bounds)])  # fmt: skip
    target = problem(root, embeddings.Gaussian(parameters=["a"]), dtype=dtype, rule=2)
    u = torch.zeros(161, target.propagate.num_alpha, dtype=dtype)
    u[:, -1] = torch.linspace(-40, 40, 161, dtype=dtype)
    value, _ = by_hand.by_hand(target, None)(u)
    wanted, _ = slopes_of(density(target))(u)
    scale = 1e-10 if dtype == torch.float64 else 1e-4
    torch.testing.assert_close(value, wanted, rtol=scale, atol=scale)
    alpha = torch.from_numpy(by_hand._Coordinates(target.prior.transform)(u.numpy())[0])
    torch.testing.assert_close(alpha, target.prior.transform.bound(u), rtol=4 * torch.finfo(dtype).eps, atol=1e-12)
    assert bool(((alpha >= target.prior.low) & (alpha <= target.prior.high)).all())


@pytest.mark.parametrize(
    "options",
    [
        {"gamma": np.sqrt(2 / np.pi)},
        {"gamma": torch.tensor(0.8)},
        {"epsilon": torch.tensor(0.05, requires_grad=True)},
    ],
)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_numbers_of_any_kind(options, dtype):
    target = problem(BOUNDED, likelihood=likelihoods.ABC(**{"epsilon": 0.05, **options}), dtype=dtype)
    u = torch.zeros(3, target.propagate.num_alpha, dtype=dtype)
    value, _ = by_hand.by_hand(target, None)(u)
    assert value.dtype == dtype
    torch.testing.assert_close(value, density(target)(u).detach().to(dtype), rtol=1e-5, atol=0)


def test_simulators_keep_their_own_arithmetic_warnings():
    seen = []

    def model(x, p):
        seen.append(np.geterr()["over"])
        return p["a"] * x

    target = problem(tc.Simulator(model, [tc.Parameter("a")]), rule=3)
    seen.clear()
    hand = by_hand.by_hand(target, None)
    space = Whitened(density(target), torch.zeros(2).double(), torch.eye(2).double(), slopes=hand)
    for kernel in (nuts_step, hmc_step):
        arrays = Host(0)
        options = {"step_size": 0.1, "arrays": arrays}
        start = np.zeros((2, 2))
        if kernel is nuts_step:
            options["tables"] = nuts_step.Tables.build(3, arrays)
            state = nuts_step.init(start, space.potential, **options)
        else:
            options["length"] = 0.5
            state = hmc_step.init(start, space.potential)
        with np.errstate(over="raise"):
            kernel.step(state, space.potential, **options)
    assert seen.count("raise") >= 2


def test_single_precision_stays_single():
    target = problem(BOUNDED, dtype=torch.float32)
    u = torch.randn(5, target.propagate.num_alpha, generator=torch.Generator().manual_seed(1))
    value, slope = by_hand.by_hand(target, None)(u)
    wanted, gradient = slopes_of(density(target))(u)
    assert value.dtype == slope.dtype == torch.float32
    torch.testing.assert_close(value, wanted, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(slope, gradient, rtol=1e-3, atol=1e-3 * float(gradient.abs().max()))


def test_what_is_no_number_is_told_and_not_warned_of():
    broken = tc.Simulator(lambda x, p: torch.log(p["a"]) * x, [tc.Parameter("a", initial=1.0)])
    target = problem(broken, rule=3)
    u = torch.tensor([[1.0, 0.1], [-1.0, 0.1]], dtype=torch.float64)
    value, _ = by_hand.by_hand(target, None)(u)
    assert torch.isfinite(value).tolist() == [True, False]


@pytest.mark.parametrize(
    "options",
    [
        {"likelihood": likelihoods.GaussianMarginal()},
        {"likelihood": likelihoods.ABCMean(epsilon=0.1)},
        {"prior": priors.Normal},
    ],
)
def test_everything_else_is_left_to_pytorch(options):
    left = object()
    assert by_hand.by_hand(problem(LINE, **options), left) is left


def test_many_chains_are_left_to_pytorch(monkeypatch):
    monkeypatch.setattr(by_hand, "MOST_BY_HAND", 1000)
    target = problem(ANY)
    hand = by_hand.by_hand(target, lambda u: "PyTorch")
    few = 1000 // (target.propagate.num_nodes * len(X))
    assert hand(torch.zeros(few + 1, target.propagate.num_alpha, dtype=torch.float64)) == "PyTorch"
    assert len(hand(torch.zeros(few, target.propagate.num_alpha, dtype=torch.float64))[0]) == few
