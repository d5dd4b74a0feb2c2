"""Polynomial chaos: multi-indices, bases and quadrature rules."""

import copy
import importlib
import math
import pickle
import time
import warnings

import numpy as np
import pytest
import torch

from torchcal.errors import DomainError, ShapeError
from torchcal.polychaos import (
    HERMITE,
    LEGENDRE,
    Rule,
    evaluate,
    get_basis,
    multi_indices,
    norms,
    qmc_rule,
    smolyak_rule,
    tensor_rule,
)

BASES = [pytest.param(HERMITE, id="hermite"), pytest.param(LEGENDRE, id="legendre")]
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")),
]


def moment(basis, degree):
    """E[xi^degree], exactly."""
    if degree % 2:
        return 0.0
    return float(math.prod(range(1, degree, 2))) if basis is HERMITE else 1.0 / (degree + 1)


def monomial_errors(basis, rule, indices):
    """Error of every monomial, relative to the sum of the absolute terms of the rule."""
    powers = rule.nodes[:, None, :].pow(indices).prod(dim=-1)
    exact = [math.prod(moment(basis, k) for k in row) for row in indices.tolist()]
    scale = rule.weights.abs() @ powers.abs()
    return (rule.weights @ powers - torch.tensor(exact, dtype=torch.float64)).abs() / scale.clamp_min(1e-300)


# --- multi-indices --------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", range(5))
@pytest.mark.parametrize("order", range(5))
def test_multi_indices_are_the_graded_total_degree_set(dim, order):
    indices = multi_indices(dim, order)
    assert indices.dtype == torch.int64
    assert indices.shape == (math.comb(dim + order, dim), dim)
    assert len({tuple(row) for row in indices.tolist()}) == len(indices)
    degrees = indices.sum(dim=-1)
    assert (degrees.diff() >= 0).all()
    assert degrees.max() <= order
    if order >= 1:
        assert torch.equal(indices[1 : dim + 1], torch.eye(dim, dtype=torch.int64))
        assert torch.equal(indices[: len(multi_indices(dim, order - 1))], multi_indices(dim, order - 1))


# --- bases ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("basis", BASES)
def test_polynomials_agree_with_numpy(basis):
    x = np.linspace(-1.5, 1.5, 31)
    package = np.polynomial.hermite_e if basis is HERMITE else np.polynomial.legendre
    expected = (package.hermevander if basis is HERMITE else package.legvander)(x, 12)
    np.testing.assert_allclose(
        basis.evaluate(torch.from_numpy(x), 12).numpy(), expected, rtol=1e-10, atol=1e-10
    )


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("order", [0, 1, 7, 30])
def test_orthonormal_in_one_germ(basis, order):
    nodes, weights = basis.gauss(order + 1)
    psi = basis.evaluate(nodes, order) / basis.norms(order).sqrt()
    gram = psi.T @ (weights[:, None] * psi)
    torch.testing.assert_close(gram, torch.eye(order + 1, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize(("dim", "order"), [(0, 2), (1, 5), (2, 4), (3, 3), (5, 2)])
def test_orthonormal_in_several_germs(basis, dim, order):
    indices = multi_indices(dim, order)
    rule = tensor_rule(basis, dim, order + 1)
    psi = evaluate(basis, indices, rule.nodes) / norms(basis, indices).sqrt()
    gram = psi.T @ (rule.weights[:, None] * psi)
    torch.testing.assert_close(gram, torch.eye(len(indices), dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize("basis", BASES)
def test_germ_moments_of_draws_and_icdf(basis):
    variance = moment(basis, 2)
    draws = basis.sample((200_000,), torch.Generator().manual_seed(0))
    assert draws.dtype == torch.float64
    assert abs(draws.mean()) < 4 * math.sqrt(variance / 200_000)
    assert abs(draws.var() / variance - 1) < 0.02
    u = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000
    assert abs(basis.icdf(u).square().mean() / variance - 1) < 0.01
    again = basis.sample((5, 2), torch.Generator().manual_seed(1), torch.float32)
    assert again.dtype == torch.float32
    assert torch.equal(again, basis.sample((5, 2), torch.Generator().manual_seed(1), torch.float32))


def test_normal_icdf_agrees_with_scipy():
    stats = pytest.importorskip("scipy.stats")
    u = torch.tensor([1e-12, 1e-3, 0.2, 0.5, 0.9, 1 - 1e-9], dtype=torch.float64)
    np.testing.assert_allclose(HERMITE.icdf(u).numpy(), stats.norm.ppf(u.numpy()), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("name", ["hermite", "HG", "Hermite"])
def test_bases_are_found_by_name(name):
    assert get_basis(name) is HERMITE
    assert get_basis("LU") is get_basis("legendre") is get_basis(LEGENDRE) is LEGENDRE


@pytest.mark.parametrize("basis", BASES)
def test_bases_survive_pickle_and_copy(basis):
    assert pickle.loads(pickle.dumps(basis)) == basis
    assert copy.deepcopy(basis) == basis


# --- evaluation: autograd, dtype, device ----------------------------------------------------------


@pytest.mark.parametrize("basis", BASES)
def test_evaluate_gradcheck(basis):
    indices = multi_indices(3, 4)
    xi = basis.sample((2, 3), torch.Generator().manual_seed(3)).requires_grad_()
    assert torch.autograd.gradcheck(lambda z: evaluate(basis, indices, z), xi)
    assert torch.autograd.gradgradcheck(lambda z: evaluate(basis, indices, z), xi)


def test_evaluate_has_finite_gradients_at_zero():
    xi = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    evaluate(LEGENDRE, multi_indices(2, 3), xi).sum().backward()
    torch.testing.assert_close(xi.grad, torch.full((2,), 1.0 - 0.5 - 1.5, dtype=torch.float64))


def test_evaluate_under_vmap_and_jacrev():
    indices = multi_indices(2, 3)
    xi = torch.randn(4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    jacobian = torch.func.vmap(torch.func.jacrev(lambda z: evaluate(HERMITE, indices, z)))(xi)
    # d He_2(x) / dx = 2 x, in row 3, the index (2, 0).
    torch.testing.assert_close(jacobian[:, 3, 0], 2 * xi[:, 0])


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("device", DEVICES)
def test_evaluate_keeps_dtype_and_device(basis, dtype, device):
    indices = multi_indices(3, 3)
    xi = basis.sample((4, 5, 3), torch.Generator().manual_seed(0))
    got = evaluate(basis, indices, xi.to(device, dtype))
    assert got.shape == (4, 5, len(indices))
    assert got.dtype == dtype
    assert got.device.type == device
    tolerance = 1e-4 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(
        got.cpu().double(), evaluate(basis, indices, xi), rtol=tolerance, atol=tolerance
    )


@pytest.mark.parametrize("basis", BASES)
def test_evaluate_mixes_no_devices(basis):
    """The meta device has no data, and refuses a CPU tensor in the arithmetic."""
    got = evaluate(basis, multi_indices(2, 3), torch.empty(7, 2, device="meta"))
    assert got.shape == (7, 10)
    assert got.device.type == "meta"


def test_evaluate_without_germs_is_one():
    assert evaluate(HERMITE, multi_indices(0, 3), torch.empty(4, 0)).tolist() == [[1.0]] * 4
    assert norms(HERMITE, multi_indices(0, 3)).tolist() == [1.0]


@pytest.mark.parametrize("default", [torch.float32, torch.float64])
def test_constants_are_float64_whatever_the_default(default):
    before = torch.get_default_dtype()
    torch.set_default_dtype(default)
    try:
        rules = [tensor_rule(HERMITE, 2, 3), smolyak_rule(HERMITE, 2, 2), qmc_rule(HERMITE, 2, 8, 0)]
        rules += [tensor_rule(HERMITE, 0, 3)]
        constants = [t for rule in rules for t in (rule.nodes, rule.weights)]
        constants += [*LEGENDRE.gauss(4), LEGENDRE.norms(4), norms(LEGENDRE, multi_indices(2, 2))]
    finally:
        torch.set_default_dtype(before)
    assert all(t.dtype == torch.float64 for t in constants)
    torch.testing.assert_close(rules[2].nodes, qmc_rule(HERMITE, 2, 8, 0).nodes, rtol=0, atol=0)


# --- Gauss and tensor rules -----------------------------------------------------------------------


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("n", [1, 2, 3, 5, 8, 12])
def test_gauss_is_exact_to_degree_2n_minus_1_and_no_further(basis, n):
    rule = tensor_rule(basis, 1, n)
    assert (monomial_errors(basis, rule, torch.arange(2 * n)[:, None]) < 1e-13).all()
    # The error at degree 2n is known: the squared norm of the monic polynomial of degree n.
    leading = 1.0 if basis is HERMITE else math.comb(2 * n, n) / 2**n
    missing = float(basis.norms(n)[n]) / leading**2
    got = moment(basis, 2 * n) - float(rule.weights @ rule.nodes[:, 0].pow(2 * n))
    assert got == pytest.approx(missing, rel=1e-6)


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("n", [50, 100, 200, 369])
def test_long_gauss_rules_neither_overflow_nor_underflow(basis, n):
    with warnings.catch_warnings(), np.errstate(all="raise"):
        warnings.simplefilter("error")
        nodes, weights = basis.gauss(n)
    assert (weights > 0).all()
    assert (nodes.diff() > 0).all()
    torch.testing.assert_close(nodes, -nodes.flip(0), rtol=0, atol=0)
    assert float(weights.sum()) == pytest.approx(1, abs=1e-14)
    for degree in (2, 4, 10, 20):
        assert float(weights @ nodes**degree) == pytest.approx(moment(basis, degree), rel=1e-12)
    # E[cos(3 xi)] has no polynomial form.
    exact = math.exp(-4.5) if basis is HERMITE else math.sin(3) / 3
    assert float(weights @ torch.cos(3 * nodes)) == pytest.approx(exact, abs=1e-13)


@pytest.mark.parametrize("basis", BASES)
def test_a_gauss_rule_is_worked_out_once_and_belongs_to_who_asks(basis, monkeypatch):
    nodes, weights = (column.clone() for column in basis.gauss(7))
    for column in basis.gauss(7):
        column.zero_()
    monkeypatch.setattr(np.linalg, "eigvalsh", None)
    again = basis.gauss(7)
    assert torch.equal(again[0], nodes)
    assert torch.equal(again[1], weights)
    assert pickle.loads(pickle.dumps(basis)).gauss(7)[0].tolist() == nodes.tolist()


@pytest.mark.parametrize("basis", BASES)
def test_tensor_rule_with_a_number_for_each_germ(basis):
    rule = tensor_rule(basis, 2, (2, 4))
    assert (rule.num, rule.dim, rule.positive) == (8, 2, True)
    box = torch.cartesian_prod(torch.arange(4), torch.arange(8))
    assert (monomial_errors(basis, rule, box) < 1e-13).all()
    # The last germ varies fastest.
    torch.testing.assert_close(rule.nodes[:4, 1], basis.gauss(4)[0])


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize(
    "build",
    [lambda b: tensor_rule(b, 0, 3), lambda b: smolyak_rule(b, 0, 3), lambda b: qmc_rule(b, 0, 3, 0)],
    ids=["tensor", "smolyak", "qmc"],
)
def test_no_germ_gives_one_node(basis, build):
    rule = build(basis)
    assert rule.nodes.shape == (1, 0)
    assert rule.weights.tolist() == [1.0]
    assert rule.positive


# --- Smolyak --------------------------------------------------------------------------------------


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize(("dim", "level"), [(1, 3), (2, 0), (2, 1), (2, 4), (3, 3), (4, 2), (6, 2), (10, 1)])
def test_smolyak_is_exact_to_total_degree_2_level_plus_1(basis, dim, level):
    rule = smolyak_rule(basis, dim, level)
    assert float(rule.weights.sum()) == pytest.approx(1, abs=1e-12)
    assert (monomial_errors(basis, rule, multi_indices(dim, 2 * level + 1)) < 1e-12).all()
    assert len(torch.unique(rule.nodes, dim=0)) == rule.num
    assert rule.positive == bool((rule.weights >= 0).all())


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize(("dim", "level"), [(2, 2), (2, 4), (3, 2), (4, 3)])
def test_smolyak_is_not_exact_one_degree_further(basis, dim, level):
    errors = monomial_errors(basis, smolyak_rule(basis, dim, level), multi_indices(dim, 2 * level + 2))
    assert errors.max() > 1e-3


def test_smolyak_is_much_smaller_than_the_tensor_grid():
    assert [smolyak_rule(HERMITE, dim, 2).num for dim in (4, 6, 10)] == [25, 73, 201]
    assert not smolyak_rule(HERMITE, 10, 2).positive
    assert smolyak_rule(LEGENDRE, 100, 1).num == 201


def test_smolyak_in_one_germ_is_gauss():
    rule = smolyak_rule(LEGENDRE, 1, 2)
    torch.testing.assert_close(rule.nodes[:, 0], LEGENDRE.gauss(3)[0])
    torch.testing.assert_close(rule.weights, LEGENDRE.gauss(3)[1])


@pytest.mark.parametrize("basis", BASES)
def test_smolyak_converges_on_a_smooth_integrand(basis):
    exact = math.exp(0.5 * 3 * 0.25) if basis is HERMITE else (math.sinh(0.5) / 0.5) ** 3
    errors = []
    for level in (1, 3, 5):
        rule = smolyak_rule(basis, 3, level)
        errors.append(abs(float(rule.weights @ torch.exp(0.5 * rule.nodes.sum(dim=-1))) - exact))
    assert errors[1] < errors[0] / 20
    assert errors[2] < errors[1] / 20


# --- quasi-Monte Carlo ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("basis", "steepest"), [(HERMITE, -0.7), (LEGENDRE, -1.0)], ids=["hermite", "legendre"]
)
def test_qmc_order_of_convergence(basis, steepest):
    """The rms error over scramblings falls faster than the num^-0.5 of random draws."""
    exact = math.exp(0.125 * 3) if basis is HERMITE else (math.sinh(0.5) / 0.5) ** 3
    logs = range(4, 13)
    rms = []
    for log in logs:
        rules = [qmc_rule(basis, 3, 2**log, seed) for seed in range(24)]
        errors = [float(r.weights @ torch.exp(0.5 * r.nodes.sum(dim=-1))) - exact for r in rules]
        rms.append(math.sqrt(sum(e * e for e in errors) / len(errors)))
    assert np.polyfit(list(logs), np.log2(rms), 1)[0] < steepest


@pytest.mark.parametrize("seed", range(5))
def test_qmc_points_are_a_net(seed):
    """Every germ has one point in each of 256 slices of equal probability."""
    u = (qmc_rule(LEGENDRE, 4, 256, seed).nodes + 1) / 2
    for j in range(4):
        assert len(torch.unique((u[:, j] * 256).long())) == 256


def test_qmc_is_reproducible_finite_and_leaves_the_global_state_alone():
    state = torch.get_rng_state()
    first, again, other = (qmc_rule(HERMITE, 3, 1000, seed) for seed in (7, 7, 8))
    assert torch.equal(state, torch.get_rng_state())
    assert torch.equal(first.nodes, again.nodes)
    assert not torch.equal(first.nodes, other.nodes)
    assert torch.isfinite(first.nodes).all()
    assert first.positive
    assert qmc_rule(HERMITE, 2, 1, 0).nodes.shape == (1, 2)


# --- an independent implementation ----------------------------------------------------------------


def _chaospy():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip("chaospy")


@pytest.mark.parametrize("basis", BASES)
def test_agrees_with_chaospy(basis):
    chaospy = _chaospy()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        germ = chaospy.Normal(0, 1) if basis is HERMITE else chaospy.Uniform(-1, 1)
        joint = chaospy.Iid(germ, 2)
        expansion, their_norms = chaospy.generate_expansion(4, joint, retall=True)
        nodes, weights = chaospy.generate_quadrature(4, joint, rule="gaussian")
        points = np.linspace(-0.9, 0.9, 14).reshape(2, 7)
        values = np.array([np.broadcast_to(polynomial(*points), 7) for polynomial in expansion])

    indices = multi_indices(2, 4)
    # chaospy's polynomials are monic and in an order of their own: match each by its values.
    ours = evaluate(basis, indices, torch.from_numpy(points.T.copy())).T.numpy()
    highest = [1.0 if basis is HERMITE else math.comb(2 * k, k) / 2**k for k in range(5)]
    leading = np.array([math.prod(highest[k] for k in row) for row in indices.tolist()])
    matched = []
    for row, norm in zip(ours / leading[:, None], norms(basis, indices).numpy() / leading**2, strict=True):
        hits = [i for i, value in enumerate(values) if np.allclose(value, row, rtol=1e-8, atol=1e-10)]
        assert len(hits) == 1
        assert their_norms[hits[0]] == pytest.approx(norm, rel=1e-8)
        matched += hits
    assert sorted(matched) == list(range(len(values))) == list(range(len(indices)))

    rule = tensor_rule(basis, 2, 5)
    order = np.lexsort(np.round(nodes, 8))
    mine = np.lexsort(np.round(rule.nodes.numpy().T, 8))
    np.testing.assert_allclose(rule.nodes.numpy()[mine], nodes.T[order], rtol=0, atol=1e-9)
    np.testing.assert_allclose(rule.weights.numpy()[mine], weights[order], rtol=1e-8, atol=0)


# --- bad input ------------------------------------------------------------------------------------

NOT_COUNTS = [-1, 1.0, 2.5, "2", None, True, float("nan")]


@pytest.mark.parametrize("bad", NOT_COUNTS)
def test_what_is_not_a_count_is_refused(bad):
    calls = [
        lambda: multi_indices(bad, 2),
        lambda: multi_indices(2, bad),
        lambda: HERMITE.evaluate(torch.zeros(3), bad),
        lambda: HERMITE.norms(bad),
        lambda: LEGENDRE.gauss(bad),
        lambda: tensor_rule(HERMITE, bad, 2),
        lambda: tensor_rule(HERMITE, 2, bad),
        lambda: tensor_rule(HERMITE, 2, (2, bad)),
        lambda: smolyak_rule(HERMITE, bad, 2),
        lambda: smolyak_rule(HERMITE, 2, bad),
        lambda: qmc_rule(HERMITE, bad, 8, 0),
        lambda: qmc_rule(HERMITE, 2, bad, 0),
        lambda: qmc_rule(HERMITE, 2, 8, bad),
    ]
    for call in calls:
        with pytest.raises(DomainError, match=r"Expected .* Got "):
            call()


@pytest.mark.parametrize(
    "call",
    [
        lambda: HERMITE.gauss(0),
        lambda: tensor_rule(LEGENDRE, 2, 0),
        lambda: qmc_rule(HERMITE, 2, 0, 0),
        lambda: HERMITE.gauss(370),
        lambda: HERMITE.norms(171),
        lambda: multi_indices(50, 20),
        lambda: tensor_rule(HERMITE, 30, 3),
        lambda: smolyak_rule(HERMITE, 30, 20),
        lambda: qmc_rule(HERMITE, 30_000, 8, 0),
        lambda: qmc_rule(HERMITE, 2, 10**9, 0),
        lambda: get_basis("laguerre"),
        lambda: get_basis(3),
        lambda: HERMITE.icdf(torch.tensor([0.5, 1.5])),
        lambda: HERMITE.icdf(torch.tensor([float("nan")])),
        lambda: HERMITE.icdf(torch.tensor([1])),
        lambda: HERMITE.evaluate(torch.tensor([1, 2]), 2),
        lambda: evaluate(HERMITE, torch.tensor([[-1]]), torch.zeros(1)),
        lambda: evaluate(HERMITE, torch.tensor([[1.0]]), torch.zeros(1)),
        lambda: norms(HERMITE, torch.tensor([[150, 150]])),
    ],
)
def test_numbers_outside_the_domain_are_refused(call):
    with pytest.raises(DomainError, match=r"Expected .*\. Got "):
        call()


def test_too_large_a_grid_is_refused_at_once():
    start = time.perf_counter()
    for call in (lambda: smolyak_rule(HERMITE, 30, 20), lambda: multi_indices(50, 20)):
        with pytest.raises(DomainError, match="at most"):
            call()
    assert time.perf_counter() - start < 1


@pytest.mark.parametrize(
    "call",
    [
        lambda: tensor_rule(HERMITE, 3, (2, 2)),
        lambda: evaluate(HERMITE, multi_indices(2, 2), torch.zeros(5, 3)),
        lambda: evaluate(HERMITE, multi_indices(2, 2), torch.tensor(0.0)),
        lambda: norms(HERMITE, torch.tensor([1, 2])),
        lambda: Rule(torch.zeros(3, 2), torch.zeros(2), True),
    ],
)
def test_shapes_that_disagree_are_refused(call):
    with pytest.raises(ShapeError, match=r"Expected .*\. Got "):
        call()


def test_numpy_and_torch_whole_numbers_are_accepted():
    assert multi_indices(np.int64(2), torch.tensor(1)).shape == (3, 2)
    assert tensor_rule(HERMITE, 2, [np.int32(2), 3]).num == 6


def test_public_names_exist():
    package = importlib.import_module("torchcal.polychaos")
    assert all(hasattr(package, name) for name in package.__all__)
    assert package.__all__ == sorted(
        package.__all__, key=lambda name: (not name.isupper(), not name[0].isupper(), name)
    )
