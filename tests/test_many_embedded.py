"""The maximum with many embedded parameters: the same as on the whole rule from all starts, for far fewer runs."""

import math

import pytest
import torch

import torchcal as tc
from torchcal.inference import estimate, newton
from torchcal.inference.tangent import few_nodes, pieces
from torchcal.propagation import NISP

F64 = torch.float64
X = torch.linspace(0.0, 3.0, 12, dtype=F64)


def truth():
    y = 2 * torch.exp(-0.7 * X) + 0.5 * torch.sin(2.2 * X)
    return tc.Recording(x=X, y=y + 0.05 * torch.cos(7 * X))


class Counted:
    """A decay, and with ``c`` and ``d`` an oscillation on it; how many parameter vectors it was called with."""

    def __init__(self, *names):
        self.rows = 0
        bounds = {"a": (0, 5), "b": (0, 3), "c": (0, 2), "d": (0, 5)}
        self.simulator = tc.Simulator(
            self.run, [tc.Parameter(name, low=low, high=high) for name, (low, high) in bounds.items() if name in names]
        )

    def run(self, x, p):
        self.rows += p["a"].numel()
        return p["a"] * torch.exp(-p["b"] * x) + p["c"] * torch.sin((p["d"] if "d" in p else 2.2) * x)


def test_the_maximum_of_four_embedded_parameters_takes_few_runs():
    counted = Counted("a", "b", "c", "d")
    cal = tc.calibrate(counted.simulator, truth(), num_samples=0, seed=0, progress=False)
    assert cal.propagate.num_nodes == 7**4
    # One iteration of 32 starts on the whole rule takes 55 × 32 × 2401 = 4.2e6, and there are some 60.
    assert counted.rows < 4e6
    assert cal.diagnostics.agreeing >= 2


def followed(monkeypatch):
    """Let every search begin with few nodes, and say what came of it."""
    results = []
    search = estimate.search_with_few_nodes

    def told(*args, **kwargs):
        results.append(search(*args, **kwargs))
        return results[-1]

    monkeypatch.setattr(estimate, "DEAR", 0)
    monkeypatch.setattr(estimate, "search_with_few_nodes", told)
    return results


@pytest.mark.filterwarnings("ignore:The best density is a spike")  # that of the marginal likelihood is
@pytest.mark.parametrize(
    ("names", "embedding", "likelihood"),
    [
        pytest.param("abc", tc.embeddings.Gaussian(), "abc", marks=pytest.mark.slow),
        ("ab", tc.embeddings.PolynomialChaos(order=2), "abc"),
        pytest.param("ab", tc.embeddings.Gaussian(), "gaussian_marginal", marks=pytest.mark.slow),
    ],
)
def test_the_same_maximum_as_on_the_whole_rule_from_every_start(monkeypatch, names, embedding, likelihood):
    def maximum():
        counted = Counted("a", "b", "c", "d")
        fixed = {"c": 0.5, "d": 2.2} if names == "ab" else {"d": 2.2}
        options = {"embedding": embedding, "likelihood": likelihood, "fixed": fixed, "seed": 0, "progress": False}
        return tc.calibrate(counted.simulator, truth(), num_samples=0, **options)

    results = followed(monkeypatch)
    found = maximum()
    assert results[0] is not None
    monkeypatch.setattr(estimate, "few_nodes", lambda propagate: None)
    expected = maximum()
    assert found.map.objective == pytest.approx(expected.map.objective, abs=1e-4)  # in units of a log-density
    torch.testing.assert_close(found.map.mean, expected.map.mean, rtol=1e-3, atol=1e-4)
    assert found.propagate.rule_choice == expected.propagate.rule_choice


@pytest.mark.filterwarnings("ignore")
def test_a_model_that_does_not_bear_the_outermost_nodes(monkeypatch):
    """Few nodes find a wide density, whose tail reaches where the logarithm ends; all of them a narrower one."""

    def maximum():
        simulator = tc.Simulator(
            lambda x, p: torch.log(p["a"]) + p["b"] * x, [tc.Parameter("a", initial=1.0), tc.Parameter("b")]
        )
        recording = tc.Recording(x=X, y=0.3 * X + 0.6 * torch.sign(torch.cos(9 * X)))
        return tc.calibrate(simulator, recording, num_samples=0, seed=0, rule=12, progress=False)

    results = followed(monkeypatch)
    found = maximum()
    assert results == [None]
    monkeypatch.setattr(estimate, "few_nodes", lambda propagate: None)
    assert found.map.objective == pytest.approx(maximum().map.objective, abs=1e-6)


def test_densities_that_tie_are_told_where_nodes_are_dear(monkeypatch):
    """With a² in place of a either sign of it fits, at the same height."""
    monkeypatch.setattr(estimate, "DEAR", 0)
    x = torch.linspace(0.5, 3.0, 12, dtype=F64)
    simulator = tc.Simulator(
        lambda x, p: p["a"] ** 2 * torch.exp(-p["b"] * x),
        [tc.Parameter("a", low=-3, high=3), tc.Parameter("b", low=0, high=3)],
    )
    recording = tc.Recording(x=x, y=2 * torch.exp(-0.7 * x) + 0.05 * torch.cos(7 * x))
    found = [tc.calibrate(simulator, recording, num_samples=0, seed=seed, progress=False) for seed in (0, 1)]
    assert found[0].diagnostics.ties == 2
    assert all(float(cal.map.mean[0]) > 0 for cal in found)
    assert found[0].map.objective == pytest.approx(found[1].map.objective, rel=1e-9)


@pytest.mark.parametrize(
    ("embedding", "nodes"), [(tc.embeddings.Gaussian(), 4), (tc.embeddings.PolynomialChaos(order=2), 9)]
)
def test_few_nodes_see_every_coefficient(embedding, nodes):
    simulator = Counted("a", "b", "c", "d").simulator
    propagate = NISP(simulator, embedding, X, fixed={"b": 0.7, "d": 2.0}, rule=12)
    coarse = few_nodes(propagate)
    assert coarse.num_nodes == nodes
    alpha = torch.full((propagate.num_alpha,), 0.1, dtype=F64)
    slope = torch.func.jacrev(lambda a: torch.cat(coarse.moments(a)))(alpha)
    assert bool((slope.abs().amax(0) > 1e-6).all())


def test_few_nodes_carry_the_expansion():
    propagate = NISP(Counted("a", "b").simulator, tc.embeddings.Gaussian(), X, order=3, rule=12)
    assert few_nodes(propagate).num_nodes == 4**2


def test_few_nodes_only_where_they_are_fewer():
    simulator = Counted("a", "b").simulator
    assert few_nodes(NISP(simulator, tc.embeddings.Gaussian(), X, rule=3)) is None
    assert few_nodes(NISP(simulator, tc.embeddings.PolynomialChaos(order=0), X)) is None


def test_pieces_change_nothing():
    def objective(u):
        return (u**4).sum(-1) + torch.sin(u).prod(-1)

    points = torch.randn(7, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    rounding = {"rtol": 1e-13, "atol": 1e-14}  # a sine's last bit changes with its place in a vector register
    for piece in (1, 3, 7, 50):
        parts = newton.gradient(objective, points, piece=piece)
        torch.testing.assert_close(parts, newton.gradient(objective, points), **rounding)
        torch.testing.assert_close(
            newton.hessian(objective, points, piece=piece), newton.hessian(objective, points), rtol=1e-9, atol=1e-9
        )
    whole, part = newton.minimise(objective, points), newton.minimise(objective, points, piece=2)
    torch.testing.assert_close(part.values, whole.values, **rounding)


def test_a_piece_holds_at_least_one_point():
    propagate = NISP(Counted("a", "b").simulator, tc.embeddings.Gaussian(), X, rule=3)
    assert pieces(propagate, 12) == 2**17 // (9 * 12)
    assert pieces(propagate, 10**9) == 1


def test_a_curvature_that_is_near_enough_leads_to_the_same_minimum():
    center = torch.tensor([0.3, -0.2, 0.1], dtype=F64)

    def objective(u):
        return (u - center).square().sum(-1) + 0.01 * torch.cos(3 * u).sum(-1)

    found = newton.minimise(objective, torch.zeros(1, 3, dtype=F64), curvature=lambda u: (u - 1).square().sum(-1))
    assert math.isfinite(float(found.values[0]))
    expected = newton.minimise(objective, torch.zeros(1, 3, dtype=F64))
    assert float(found.values[0]) == pytest.approx(float(expected.values[0]), abs=1e-9)
