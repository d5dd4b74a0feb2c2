"""Embeddings λ(ξ; α): layout and names of α, and what leaves the density of λ as it is."""

import itertools
import math

import pytest
import torch
from scipy import stats

from torchcal import NISP, Parameter, Simulator, polychaos
from torchcal.embeddings import EXHAUSTED, Gaussian, IndependentGaussian, PolynomialChaos, Uniform
from torchcal.errors import DomainError, EmbeddingError

NAMES = ("a", "b", "c")
EMBEDDINGS = [
    pytest.param(Gaussian(), id="gaussian"),
    pytest.param(IndependentGaussian(), id="independent"),
    pytest.param(Uniform(), id="uniform"),
    pytest.param(PolynomialChaos(order=2), id="pc2"),
    pytest.param(PolynomialChaos(order=3, germ="legendre", triangular=False), id="legendre3"),
    pytest.param(Gaussian(parameters=("c", "a")), id="subset"),
]

# Sums of a dozen float64 terms of size one.
ROUNDING = 1e-13


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def propagate(embedding, **options):
    simulator = Simulator(lambda x, p: sum(p[name] for name in NAMES) * x, [Parameter(n) for n in NAMES])
    return NISP(simulator, embedding, torch.ones(2, dtype=torch.float64), **options)


# --- layout ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("embedding", "names"),
    [
        (Gaussian(), "a[0] a[xi1] b[0] b[xi1] b[xi2] c[0] c[xi1] c[xi2] c[xi3]"),
        (IndependentGaussian(), "a[0] a[xi1] b[0] b[xi2] c[0] c[xi3]"),
        (Uniform(), "a[0] a[xi1] b[0] b[xi2] c[0] c[xi3]"),
        (Gaussian(parameters=("b",)), "a[0] b[0] b[xi1] c[0]"),
        (Gaussian(parameters=("c", "a")), "a[0] a[xi1] b[0] c[0] c[xi1] c[xi2]"),
        (PolynomialChaos(order=0), "a[0] b[0] c[0]"),
        (PolynomialChaos(parameters=("a",), order=3), "a[0] a[xi1] a[xi1^2] a[xi1^3] b[0] c[0]"),
        (
            PolynomialChaos(parameters=("a", "b"), order=2),
            "a[0] a[xi1] a[xi1^2] b[0] b[xi1] b[xi2] b[xi1^2] b[xi1*xi2] b[xi2^2] c[0]",
        ),
        (PolynomialChaos(("a", "b"), order=2, triangular=False), "a[0] a[xi1] a[xi1^2] b[0] b[xi2] b[xi2^2] c[0]"),
    ],
)
def test_alpha_is_laid_out_parameter_after_parameter_with_the_mean_first(embedding, names):
    pattern = embedding.bind(NAMES)
    assert pattern.alpha_names == tuple(names.split())
    assert pattern.num_alpha == len(pattern.alpha_names)
    leading = [name for name, first in zip(pattern.alpha_names, pattern.leading.tolist(), strict=True) if first]
    assert leading == ["a[0]", "b[0]", "c[0]"]


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_number_of_coefficients(dim, order):
    names = [f"p{i}" for i in range(dim)]
    triangular = PolynomialChaos(order=order).bind(names).num_alpha
    assert triangular == sum(math.comb(j + order, order) for j in range(1, dim + 1))
    assert PolynomialChaos(order=order, triangular=False).bind(names).num_alpha == dim * (order + 1)


@pytest.mark.parametrize("embedding", EMBEDDINGS)
def test_matrix_holds_every_alpha_once_where_its_name_says(embedding):
    pattern = embedding.bind(NAMES)
    alpha = torch.arange(1, pattern.num_alpha + 1, dtype=torch.float64)
    matrix = pattern.matrix(alpha)
    assert sorted(matrix[matrix != 0].tolist()) == alpha.tolist()
    for value, name in zip(alpha.tolist(), pattern.alpha_names, strict=True):
        row, column = (matrix == value).nonzero()[0].tolist()
        assert name.startswith(NAMES[row] + "[")
        assert (column == 0) == name.endswith("[0]")
    stacked = pattern.matrix(torch.stack([alpha, 2 * alpha]).reshape(2, 1, -1))
    torch.testing.assert_close(stacked[1, 0], 2 * matrix, rtol=0, atol=0)


def test_order_one_equals_gaussian():
    first, second = PolynomialChaos(order=1).bind(NAMES), Gaussian().bind(NAMES)
    assert first.alpha_names == second.alpha_names
    assert (first.indices == second.indices).all()
    independent = PolynomialChaos(order=1, germ="legendre", triangular=False).bind(NAMES)
    assert independent.alpha_names == Uniform().bind(NAMES).alpha_names


@pytest.mark.parametrize(
    ("embedding", "message"),
    [
        (Gaussian(parameters=("d",)), r"Got \['d'\]"),
        (Gaussian(parameters=("a", "a")), r"\['a'\] more than once"),
        (Gaussian(parameters=()), "at least one embedded parameter"),
        (PolynomialChaos(parameters=("d",), order=0), r"Got \['d'\]"),
    ],
)
def test_embedding_of_what_is_not_there_is_refused(embedding, message):
    with pytest.raises(EmbeddingError, match=message):
        embedding.bind(NAMES)


@pytest.mark.parametrize("kind", [Gaussian, PolynomialChaos])
@pytest.mark.parametrize("given", ["a", 5])
def test_parameters_that_are_no_sequence_are_refused_at_once(kind, given):
    with pytest.raises(EmbeddingError, match="Write parameters="):
        kind(parameters=given)


def test_names_may_come_one_by_one():
    assert Gaussian(parameters=(name for name in "ab")).bind(["a", "b", "c"]).embedded == ("a", "b")


@pytest.mark.parametrize("bad", [{"order": -1}, {"order": 1.0}, {"order": True}, {"germ": "cauchy"}])
def test_bad_expansion_is_refused(bad):
    with pytest.raises(DomainError):
        PolynomialChaos(**bad)


# --- the density of λ -----------------------------------------------------------------------------


def test_gaussian_is_the_multivariate_normal_of_its_triangle():
    """Eq. 10: Cov[λ] = L Lᵀ, against scipy's normal by moments and by the density of samples."""
    module = propagate(Gaussian())
    alpha = draw(module.num_alpha)
    mean, covariance = module.parameter_moments(alpha)
    triangle = module.pattern.matrix(alpha)[:, 1:]
    assert (triangle.triu(1) == 0).all()
    torch.testing.assert_close(covariance, triangle @ triangle.T, rtol=ROUNDING, atol=ROUNDING)
    samples = module.parameters_at(alpha, module.draw_germ(4000, seed=1))
    white = torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), (samples - mean).T, upper=False)
    # A true hypothesis is rejected at p < 1e-4 once in 1e4 seeds; this seed is fixed.
    assert stats.kstest(white.flatten().numpy(), "norm").pvalue > 1e-4


def test_uniform_lies_between_its_ends():
    module = propagate(Uniform())
    alpha = torch.tensor([1.0, 0.5, 2.0, -1.0, 0.0, 0.25], dtype=torch.float64)
    samples = module.parameters_at(alpha, module.draw_germ(4000, seed=1))
    for i, (center, half) in enumerate([(1.0, 0.5), (2.0, 1.0), (0.0, 0.25)]):
        # One in 1e4 seeds fails by chance; this seed is fixed.
        assert stats.kstest(samples[:, i].numpy(), "uniform", (center - half, 2 * half)).pvalue > 1e-4
    mean, covariance = module.parameter_moments(alpha)
    torch.testing.assert_close(mean, alpha[[0, 2, 4]], rtol=0, atol=ROUNDING)
    expected = torch.diag(alpha[[1, 3, 5]] ** 2 / 3)  # the variance of U(-1, 1) is 1/3
    torch.testing.assert_close(covariance, expected, rtol=ROUNDING, atol=ROUNDING)


def reversals(pattern):
    """Sign vectors of α for every combination of reversed germs, from the names alone."""
    for flipped in itertools.product([False, True], repeat=pattern.num_germs):
        signs = []
        for row in pattern.indices[pattern.columns].tolist():
            signs.append((-1.0) ** sum(k for k, reverse in zip(row, flipped, strict=True) if reverse))
        yield torch.tensor(flipped), torch.tensor(signs, dtype=torch.float64)


@pytest.mark.parametrize("embedding", EMBEDDINGS)
def test_reversing_germs_leaves_moments_and_samples(embedding):
    module = propagate(embedding)
    alpha = draw(module.num_alpha)
    xi = module.draw_germ(16, seed=2)
    moments = module.parameter_moments(alpha)
    samples = module.parameters_at(alpha, xi)
    for flipped, signs in reversals(module.pattern):
        for one, other in zip(module.parameter_moments(alpha * signs), moments, strict=True):
            torch.testing.assert_close(one, other, rtol=ROUNDING, atol=ROUNDING)
        reversed_xi = torch.where(flipped, -xi, xi)
        torch.testing.assert_close(
            module.parameters_at(alpha * signs, reversed_xi), samples, rtol=ROUNDING, atol=ROUNDING
        )


@pytest.mark.parametrize("embedding", EMBEDDINGS)
def test_flip_undoes_any_reversal(embedding):
    pattern = embedding.bind(NAMES)
    reference = draw(pattern.num_alpha)
    for _, signs in reversals(pattern):
        torch.testing.assert_close(pattern.flip(reference * signs, reference), reference, rtol=0, atol=0)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_flip_gives_all_draws_of_a_density_the_same_signs_with_many_germs(order):
    names = [f"p{i}" for i in range(EXHAUSTED + 1)]
    pattern = PolynomialChaos(order=order).bind(names)
    reference, alpha = draw(pattern.num_alpha, seed=5), draw(20, pattern.num_alpha, seed=6)
    flipped = pattern.flip(alpha, reference)
    odd = pattern.indices[pattern.columns] % 2
    for seed in range(5):
        germs = torch.randint(2, (len(names),), generator=torch.Generator().manual_seed(seed))
        twin = alpha * (1 - 2 * ((odd * germs).sum(-1) % 2))
        torch.testing.assert_close(pattern.flip(twin, reference), flipped, rtol=0, atol=0)
    score = (flipped * reference).sum(-1)
    for germ in range(len(names)):
        other = (flipped * (1 - 2 * odd[:, germ]) * reference).sum(-1)
        assert bool((other <= score + 1e-12).all())


@pytest.mark.parametrize("embedding", EMBEDDINGS)
def test_flip_takes_the_best_of_all_reversals_of_each_draw(embedding):
    pattern = embedding.bind(NAMES)
    reference = draw(pattern.num_alpha, seed=3)
    draws = draw(2, 10, pattern.num_alpha, seed=4)
    flipped = pattern.flip(draws, reference)
    best = torch.stack([(draws * signs * reference).sum(-1) for _, signs in reversals(pattern)]).amax(0)
    torch.testing.assert_close((flipped * reference).sum(-1), best, rtol=ROUNDING, atol=ROUNDING)
    torch.testing.assert_close(flipped.abs(), draws.abs(), rtol=0, atol=0)
    torch.testing.assert_close(flipped[..., pattern.leading], draws[..., pattern.leading], rtol=0, atol=0)
    torch.testing.assert_close(pattern.flip(flipped, reference), flipped, rtol=0, atol=0)


def test_flip_of_more_than_eight_germs_finds_a_first_order_reversal():
    pattern = Gaussian().bind([f"p{i}" for i in range(10)])
    reference = draw(pattern.num_alpha)
    signs = torch.where(pattern.indices[pattern.columns][:, 3] == 1, -1.0, 1.0).to(torch.float64)
    signs = torch.where(pattern.indices[pattern.columns][:, 8] == 1, -signs, signs)
    torch.testing.assert_close(pattern.flip(reference * signs, reference), reference, rtol=0, atol=0)


def test_flip_without_germs_changes_nothing():
    pattern = PolynomialChaos(order=0).bind(NAMES)
    draws = draw(4, 3)
    assert pattern.flip(draws, draws[0]) is draws
    torch.testing.assert_close(pattern.positive_last_row(draws), draws, rtol=0, atol=0)


def test_positive_last_row_is_the_papers_label():
    pattern = Gaussian().bind(NAMES)
    draws = draw(50, pattern.num_alpha)
    labelled = pattern.positive_last_row(draws)
    last = [i for i, name in enumerate(pattern.alpha_names) if name.startswith("c[xi")]
    assert (labelled[:, last] >= 0).all()
    torch.testing.assert_close(labelled.abs(), draws.abs(), rtol=0, atol=0)
    module = propagate(Gaussian())
    for one, other in zip(module.parameter_moments(labelled), module.parameter_moments(draws), strict=True):
        torch.testing.assert_close(one, other, rtol=ROUNDING, atol=ROUNDING)


def test_positive_last_row_touches_only_germs_of_the_last_row():
    pattern = IndependentGaussian().bind(NAMES)
    draws = draw(50, pattern.num_alpha)
    labelled = pattern.positive_last_row(draws)
    assert (labelled[:, -1] >= 0).all()
    torch.testing.assert_close(labelled[:, :-1], draws[:, :-1], rtol=0, atol=0)


# --- moments of the expansion ---------------------------------------------------------------------


@pytest.mark.parametrize("germ", ["hermite", "legendre"])
@pytest.mark.parametrize("triangular", [True, False])
def test_parameter_moments_are_sums_of_squares_over_norms(germ, triangular):
    """Eq. 9, against an independent quadrature of λ(ξ) and λ(ξ)²."""
    module = propagate(PolynomialChaos(order=3, germ=germ, triangular=triangular))
    alpha = draw(2, module.num_alpha)
    # λ² has degree 6 in every germ: four Gauss nodes are exact.
    rule = polychaos.tensor_rule(polychaos.get_basis(germ), 3, 4)
    samples = module.parameters_at(alpha, rule.nodes)
    mean = torch.einsum("q,aqd->ad", rule.weights, samples)
    offset = samples - mean[:, None]
    covariance = torch.einsum("q,aqd,aqe->ade", rule.weights, offset, offset)
    found = module.parameter_moments(alpha)
    torch.testing.assert_close(found[0], mean, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found[1], covariance, rtol=1e-11, atol=1e-11)


def test_parameters_outside_the_embedding_have_no_spread():
    module = propagate(Gaussian(parameters=("b",)))
    _, covariance = module.parameter_moments(draw(module.num_alpha))
    assert (covariance[[0, 2]] == 0).all()
    assert (covariance[:, [0, 2]] == 0).all()
    assert covariance[1, 1] > 0


def test_moments_come_in_physical_units():
    parameters = [Parameter("a", low=100.0, high=300.0), Parameter("b", low=-2.0, high=0.0)]
    module = NISP(Simulator(lambda x, p: p["a"] + p["b"] * x, parameters), Gaussian(), torch.ones(2))
    mean, covariance = module.parameter_moments(torch.tensor([0.5, 0.1, 0.0, 0.2, 0.3], dtype=torch.float64))
    torch.testing.assert_close(mean, torch.tensor([250.0, -1.0], dtype=torch.float64), rtol=ROUNDING, atol=0)
    expected = torch.tensor([[100.0, 2.0], [2.0, 0.13]], dtype=torch.float64)
    torch.testing.assert_close(covariance, expected, rtol=ROUNDING, atol=0)
