"""Simulators of known degree: their coefficients give what the nodes give, and no more calls."""

import functools
import itertools
import math
import pickle

import pytest
import torch

from torchcal import NISP, ExternalSimulator, Parameter, Simulator, polychaos
from torchcal.embeddings import Gaussian, PolynomialChaos
from torchcal.errors import PropagationWarning
from torchcal.likelihoods import Full
from torchcal.polychaos import basis
from torchcal.simulators import PolynomialSurrogate

F64 = torch.float64
X = torch.linspace(-1.0, 1.0, 25, dtype=F64)
PARAMETERS = [Parameter("a", low=-2.0, high=4.0), Parameter("b"), Parameter("c", low=0.1, high=0.9, initial=0.3)]

# Sums of some tens of terms, through coefficients that a least-squares fit gives to about 1e-13.
CLOSE = {"rtol": 1e-10, "atol": 1e-10}


def cubic(degree, x, p):
    """Every product of a, b and c up to a degree, each with its own dependence on x."""
    total = torch.cos(x) + 0 * p["a"]
    for number, powers in enumerate(itertools.product(range(degree + 1), repeat=3)):
        if 0 < sum(powers) <= degree:
            product = p["a"] ** powers[0] * p["b"] ** powers[1] * p["c"] ** powers[2]
            total = total + torch.sin(0.7 * number + (1 + number) * x) * product
    return total


class Counted:
    """A function that counts its calls, and can be sent away."""

    def __init__(self, degree, function=cubic):
        self.degree, self.function, self.calls = degree, function, 0

    def __call__(self, x, p):
        self.calls += 1
        return self.function(self.degree, x, p)


def pair(function, embedding, x=X, *, degree, parameters=PARAMETERS, **options):
    """The propagation of one function, told its degree and not."""
    return [NISP(Simulator(function, parameters, degree=k), embedding, x, **options) for k in (degree, None)]


def draw(*shape, seed=0):
    return 0.4 * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def check_same(one, other, *, seed=0, close=CLOSE, rows=(4, 2)):
    """Moments, their gradient, mean, expansion, samples."""
    assert one.num_nodes == other.num_nodes
    alpha = draw(*rows, one.num_alpha, seed=seed)
    # At germs that are no nodes, so that more than sums at nodes is compared.
    found, slopes = [], []
    for propagate in (one, other):
        leaf = alpha.clone().requires_grad_(True)
        mean, variance = propagate.moments(leaf)
        mix = torch.linspace(1, 2, mean.shape[-1], dtype=F64)
        (slope,) = torch.autograd.grad((mix * mean).sum() + (mix * variance).sum(), leaf)
        slopes.append(slope)
        _, sd = propagate(alpha)
        found.append([mean, variance, sd, propagate.mean(alpha), propagate.outputs_at(alpha, one.draw_germ(5, seed=1)),
                      propagate.coefficients(alpha)[0], propagate.coefficients(alpha, 1)[0]])  # fmt: skip
    for left, right in zip(*found, strict=True):
        size = float(right.detach().abs().max())
        torch.testing.assert_close(left, right, rtol=close["rtol"], atol=close["atol"] * max(1.0, size))
    size = float(slopes[1].abs().max())
    assert size > 0
    torch.testing.assert_close(slopes[0], slopes[1], rtol=close["rtol"], atol=close["atol"] * max(1.0, size))


def calls_of(function, propagate):
    """How often moments and their gradient call the function."""
    before = function.calls
    alpha = draw(3, propagate.num_alpha).to(propagate.nodes).requires_grad_(True)
    mean, variance = propagate.moments(alpha)
    (mean.sum() + variance.sum()).backward()
    return function.calls - before


# --- the same numbers ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [None, 1, 2])
@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("nodes", [2, 5])  # too few for the variance of all but the line, and enough
def test_moments_gradients_and_expansion(degree, order, nodes):
    function = Counted(degree)
    one, other = pair(function, Gaussian(), degree=degree, order=order, rule=nodes)
    check_same(one, other)
    assert calls_of(function, one) == 0
    assert calls_of(function, other) > 0


class Rows:
    """A function that notes how many values of the parameters it was called with last."""

    def __init__(self, function):
        self.function, self.rows = function, 0

    def __call__(self, x, p):
        result = self.function(x, p)
        self.rows = result.numel() // len(x)
        return result


@pytest.mark.parametrize("embedding", [Gaussian(), PolynomialChaos(germ="legendre"), PolynomialChaos(order=2)])
def test_a_polynomial_is_interpolated_at_as_many_nodes_as_it_has_terms(embedding):
    """Where outputs are fewer than Legendre products, the function itself is called, at few nodes."""
    function = Rows(functools.partial(cubic, 2))
    one, other = pair(function, embedding, X[:4], degree=2)
    other.set_rule(one.rule_choice)
    terms = math.comb(3 + 2 * embedding.order, 3)
    assert one.num_evaluations == terms < one.num_nodes == other.num_evaluations
    alpha = draw(7, one.num_alpha)
    one.moments(alpha)
    assert function.rows == 7 * terms
    check_same(one, other, close={"rtol": 1e-9, "atol": 1e-9})
    coarse = NISP(one.simulator, embedding, X[:4], rule=one.rule_choice, max_elements=50)
    for whole, cut in zip(one.moments(alpha), coarse.moments(alpha), strict=True):
        torch.testing.assert_close(whole, cut, rtol=1e-12, atol=1e-12)


def test_a_degree_that_does_not_hold_takes_all_nodes():
    simulator = Simulator(lambda x, p: x * (p["a"] * p["b"] + p["c"]).abs(), PARAMETERS, degree=2)
    with pytest.warns(PropagationWarning, match="polynomials of degree 2 .*: drop degree="):
        bent = NISP(simulator, Gaussian(), X[:4])
    plain = NISP(Simulator(simulator.function, PARAMETERS), Gaussian(), X[:4])
    assert bent.num_evaluations == bent.num_nodes == plain.num_nodes > 27


@pytest.mark.parametrize(
    ("embedding", "nodes"),
    [
        (PolynomialChaos(order=2, germ="legendre"), 6),
        (PolynomialChaos(order=2), 3),
        (PolynomialChaos(parameters=("b",)), 4),
        (Gaussian(parameters=("c", "a")), 4),
    ],
)
def test_other_embeddings(embedding, nodes):
    function = Counted(2)
    one, other = pair(function, embedding, degree=2, rule=nodes)
    check_same(one, other)
    assert calls_of(function, one) == 0


def test_the_rule_chosen_for_a_degree_is_exact():
    """By itself the polynomial takes the fewest nodes; many more give the same."""
    function = Counted(3)
    one = NISP(Simulator(function, PARAMETERS, degree=3), Gaussian(), X)
    assert one.rule_choice.size == 4
    other = NISP(Simulator(function, PARAMETERS), Gaussian(), X, rule=7)
    alpha = draw(6, one.num_alpha)
    for left, right in zip(one.moments(alpha), other.moments(alpha), strict=True):
        torch.testing.assert_close(left, right, rtol=1e-10, atol=1e-10 * float(right.abs().max()))


@pytest.mark.parametrize("rule", [polychaos.tensor_rule(polychaos.HERMITE, 2, 4),
                                  polychaos.qmc_rule(polychaos.HERMITE, 2, 64, seed=3)])  # fmt: skip
def test_a_rule_of_ones_own(rule):
    function = Counted(2)
    embedding = Gaussian(parameters=("a", "b"))
    one, other = pair(function, embedding, degree=2, rule=rule)
    check_same(one, other)
    assert calls_of(function, one) == 0


def test_held_parameters():
    function = Counted(3)
    one, other = pair(function, Gaussian(), degree=3, fixed={"b": 1.7}, rule=4)
    assert one.num_alpha == 5
    check_same(one, other)
    assert calls_of(function, one) == 0
    another, _ = pair(function, Gaussian(), degree=3, fixed={"b": 1.6}, rule=4)
    alpha = draw(5)
    assert float((another.mean(alpha) - one.mean(alpha)).abs().max()) > 1e-3


def test_neutral_parameters_are_held():
    parameters = [*PARAMETERS[:2], Parameter("c", neutral=0.4)]
    one, other = pair(Counted(3), Gaussian(), degree=3, parameters=parameters, rule=4)
    assert one.num_alpha == 5
    check_same(one, other)


def outputs(degree, x, p):
    t = x["t"]
    return {"u": 1e3 * cubic(degree, t, p), "rest": t + p["a"], "w": p["b"] * p["c"] * t**2 + 1 + x["s"]}


@pytest.mark.parametrize("names", [("u", "w"), ("w", "u"), ("w", "rest", "u")])
def test_several_outputs(names):
    function = Counted(2, outputs)
    x = {"t": X, "s": X**2}
    one, other = pair(function, Gaussian(), x, degree=2, outputs=names, rule=4)
    check_same(one, other)
    assert calls_of(function, one) == 0


@pytest.mark.parametrize("elements", [1, 60, 1000])
def test_work_in_pieces(elements):
    one, other = pair(Counted(2), Gaussian(), degree=2, rule=3)
    one.max_elements = elements
    check_same(one, other, rows=(2, 2))


def test_second_derivatives():
    one, other = pair(Counted(2), Gaussian(), degree=2, rule=3)
    alpha = draw(one.num_alpha)
    left, right = (
        torch.autograd.functional.hessian(lambda a, p=p: p.moments(a)[1].log().sum(), alpha) for p in (one, other)
    )
    torch.testing.assert_close(left, right, rtol=1e-9, atol=1e-9 * float(right.abs().max()))


@pytest.mark.parametrize("embedding", [PolynomialChaos(), Gaussian(), PolynomialChaos(order=2, parameters=("a", "c"))])
def test_outputs_that_are_linear_in_the_parameters_are_linear_in_alpha(embedding):
    """A matrix product in place of nodes: moments and gradients are those of the nodes."""
    simulator = Simulator(functools.partial(cubic, 1), PARAMETERS, degree=1)
    fast = NISP(simulator, embedding, X)
    nodes = NISP(Simulator(functools.partial(cubic, 1), PARAMETERS), embedding, X)
    assert fast._affine is not None
    assert NISP(Simulator(functools.partial(cubic, 2), PARAMETERS, degree=2), embedding, X)._affine is None
    assert fast.moments(torch.zeros(0, fast.num_alpha, dtype=F64))[0].shape == (0, 25)
    constant = NISP(Simulator(lambda x, p: torch.cos(x) + 0 * p["a"], PARAMETERS, degree=0), embedding, X, order=1)
    torch.testing.assert_close(constant.mean(torch.zeros(constant.num_alpha, dtype=F64)), torch.cos(X), **CLOSE)
    constant.moments(torch.zeros(3, constant.num_alpha, dtype=F64))
    alpha = torch.randn(5, 2, fast.num_alpha, generator=torch.Generator().manual_seed(0), dtype=F64)
    for part in range(2):
        one, other = alpha.clone().requires_grad_(True), alpha.clone().requires_grad_(True)
        a, b = fast(one)[part], nodes(other)[part]
        torch.testing.assert_close(a, b, **CLOSE)
        a.square().sum().backward()
        b.square().sum().backward()
        torch.testing.assert_close(one.grad, other.grad, **CLOSE)


def test_other_conditions_and_other_functions():
    function = Counted(2)
    one, other = pair(function, Gaussian(), degree=2, rule=4)
    x = torch.linspace(0.0, 3.0, 31, dtype=F64)
    check_same(one.at(x), other.at(x))
    square = Simulator(lambda x, p: p["a"] ** 2 * x, PARAMETERS, degree=2)
    plain = Simulator(lambda x, p: p["a"] ** 2 * x, PARAMETERS)
    check_same(one.at(x, simulator=square), other.at(x, simulator=plain))


@pytest.mark.parametrize("outputs", [None, ("u", "v")])
@pytest.mark.parametrize("n", [3, 30])
def test_surrogates(outputs, n):
    """Of few outputs too: their coefficients are there anyway."""
    count = math.comb(4 + 2, 2)
    parameters = [PARAMETERS[0], Parameter("b", low=-1.0, high=2.0), PARAMETERS[2]]
    surrogate = PolynomialSurrogate(
        draw(len(outputs or "x"), count, seed=4), conditions=(0.0, 2.0), order=2, parameters=parameters, outputs=outputs
    )
    x = torch.linspace(0.0, 2.0, n, dtype=F64)
    plain = Simulator(surrogate.function, parameters)
    one, other = (NISP(s, Gaussian(), x, rule=4, outputs=outputs) for s in (surrogate, plain))
    check_same(one, other)
    assert one._polynomial is not None
    assert other._polynomial is None


# --- where nodes are evaluated as ever -----------------------------------------------------------------------


def wave(degree, x, p):
    return torch.exp(0.3 * p["a"] + 0.2 * p["b"] * x) + p["c"]


def nearly(degree, x, p):
    return p["a"] + p["b"] * x + 1e-6 * p["c"] ** 2


@pytest.mark.filterwarnings("ignore:Expected outputs that are polynomials")
@pytest.mark.parametrize(("function", "degree"), [(wave, 1), (wave, 3), (nearly, 1), (nearly, 0)])
@pytest.mark.parametrize("order", [None, 1])
def test_a_wrong_degree_is_not_believed(function, degree, order):
    counted = Counted(degree, function)
    one, other = pair(counted, Gaussian(), degree=degree, order=order, rule=5)
    check_same(one, other)
    assert calls_of(counted, one) > 0


def test_a_degree_higher_than_needed_does_no_harm():
    counted = Counted(1)
    one, other = pair(counted, Gaussian(), degree=3, rule=5)
    check_same(one, other)
    assert calls_of(counted, one) == 0


def test_outputs_that_are_no_numbers():
    """A function with no answer at some values (the square root of a negative number) has no coefficients."""
    counted = Counted(1, lambda degree, x, p: torch.where(p["b"] > 0.3, torch.nan, 1.0) * p["a"] * x)
    one, other = pair(counted, Gaussian(), degree=1, rule=2)
    alpha = torch.zeros(one.num_alpha, dtype=F64)
    alpha[one.alpha_names.index("a[xi1]")] = 0.1
    for left, right in zip(one.moments(alpha), other.moments(alpha), strict=True):
        torch.testing.assert_close(left, right, **CLOSE)
        assert bool(torch.isfinite(left).all())
    assert calls_of(counted, one) > 0


def test_logarithmic_scales():
    """A line in a is no polynomial in ln a."""
    parameters = [Parameter("a", low=0.5, high=4.0, transform="log"), *PARAMETERS[1:]]
    counted = Counted(1)
    one, other = pair(counted, Gaussian(), degree=1, parameters=parameters, rule=6)
    check_same(one, other)
    assert calls_of(counted, one) > 0
    # Held, it has no scale.
    one, other = pair(counted, Gaussian(), degree=1, parameters=parameters, fixed={"a": 2.0}, rule=2)
    check_same(one, other)
    assert calls_of(counted, one) == 0


@pytest.mark.parametrize(("n", "used"), [(9, False), (10, True)])  # ten terms of degree 2 in three parameters
def test_fewer_outputs_than_terms(n, used):
    counted = Counted(2)
    one, other = pair(counted, Gaussian(), X[:n], degree=2, rule=3)
    check_same(one, other)
    assert (calls_of(counted, one) == 0) is used


# --- simulators that are dear to call ------------------------------------------------------------------------


class Line:
    """Plain numbers in and out."""

    def __init__(self):
        self.calls = 0

    def __call__(self, x, p):
        self.calls += 1
        return p["a"] + p["b"] * x + 0.5 * p["c"] * x**2


@pytest.mark.parametrize("n", [2, 12])  # fewer outputs than the four coefficients, and more
def test_an_external_simulator_is_not_called_again(n):
    function = Line()
    x = X[:n]
    one = NISP(ExternalSimulator(function, PARAMETERS, degree=1), Gaussian(), x)
    built = function.calls
    assert 4 * n <= built <= 16 * n + n  # twice as many points as coefficients, and eight to test them
    assert calls_of(function, one) == 0
    one.mean(draw(5, one.num_alpha))
    one.coefficients(draw(5, one.num_alpha))
    assert function.calls == built
    other = NISP(Simulator(Line(), PARAMETERS), Gaussian(), x, rule=one.rule_choice.size)
    check_same(one, other)


@pytest.mark.filterwarnings("ignore:Expected outputs that are polynomials")
def test_an_external_simulator_with_a_wrong_degree_is():
    function = Counted(1, lambda degree, x, p: math.exp(p["a"]) * x)
    one = NISP(ExternalSimulator(function, PARAMETERS[:1], degree=1), Gaussian(), X[:3], rule=4)
    other = NISP(Simulator(lambda x, p: torch.exp(p["a"]) * x, PARAMETERS[:1]), Gaussian(), X[:3], rule=4)
    alpha = draw(4, 2)
    for left, right in zip(one.moments(alpha), other.moments(alpha), strict=True):
        torch.testing.assert_close(left, right, **CLOSE)
    assert calls_of(function, one) > 0


# --- elsewhere -----------------------------------------------------------------------------------------------


def test_single_precision_and_back():
    function = Counted(2)
    one, other = pair(function, Gaussian(), degree=2, rule=4)
    alpha = draw(6, one.num_alpha)
    wanted = [value.clone() for value in one.moments(alpha)]
    single = one.copy().to(torch.float32)
    assert calls_of(function, single) == 0
    for left, right in zip(single.moments(alpha.float()), other.moments(alpha), strict=True):
        assert left.dtype == torch.float32
        # 1e-7 a number, some tens of them of mixed signs.
        torch.testing.assert_close(left.double(), right, rtol=1e-4, atol=1e-4 * float(right.abs().max()))
    for left, right in zip(one.moments(alpha), wanted, strict=True):
        assert torch.equal(left, right)
    single.to(torch.float64)
    single.set_rule(single.rule_choice)
    assert single.moments(alpha)[0].dtype == F64


@pytest.mark.parametrize("degree", [2, None])
def test_pickle_after_use(degree):
    function = Counted(2)
    propagate = NISP(Simulator(function, PARAMETERS, degree=degree), Gaussian(), X, rule=4)
    alpha = draw(6, propagate.num_alpha)
    germ = propagate.draw_germ(3, seed=0)
    wanted = [*propagate.moments(alpha), propagate.outputs_at(alpha, germ)]
    other = pickle.loads(pickle.dumps(propagate))
    for left, right in zip([*other.moments(alpha), other.outputs_at(alpha, germ)], wanted, strict=True):
        assert torch.equal(left, right)


def test_building_one_leaves_the_random_state():
    state = torch.random.get_rng_state()
    pair(Counted(2), Gaussian(), degree=2, rule=3)
    assert torch.equal(state, torch.random.get_rng_state())


# --- products of many polynomials ----------------------------------------------------------------------------


@pytest.mark.parametrize("family", [polychaos.HERMITE, polychaos.LEGENDRE])
@pytest.mark.parametrize(("germs", "order"), [(1, 0), (1, 5), (3, 4), (5, 2)])
def test_products_are_the_same_however_many(family, germs, order, monkeypatch):
    indices = polychaos.multi_indices(germs, order)
    indices = torch.cat([indices.flip(0), indices[:2]])  # in no order, some twice
    points = 2 * draw(3, 7, germs)

    def both():
        leaf = points.clone().requires_grad_(True)
        value = polychaos.evaluate(family, indices, leaf)
        weights = torch.linspace(1, 2, value.numel(), dtype=F64).reshape(value.shape)
        if order == 0:
            return (value,)
        return value.detach(), torch.autograd.grad((weights * value).sum(), leaf)[0]

    used = []
    inside = basis._by_prefixes
    monkeypatch.setattr(basis, "_by_prefixes", lambda *arguments: used.append(1) or inside(*arguments))
    few = both()
    assert used == []
    monkeypatch.setattr(basis, "_MANY", 1)
    many = both()
    assert used == [1]
    for left, right in zip(many, few, strict=True):
        assert left.shape == right.shape
        torch.testing.assert_close(left, right, rtol=1e-12, atol=1e-12)


def test_products_of_single_precision_stay_single(monkeypatch):
    monkeypatch.setattr(basis, "_MANY", 1)
    value = polychaos.evaluate(polychaos.LEGENDRE, polychaos.multi_indices(2, 2), draw(9, 2).float())
    assert value.dtype == torch.float32
    assert value.shape == (9, 6)


# --- trials that overflow ------------------------------------------------------------------------------------


def test_samples_that_overflow_make_a_trial_impossible_and_no_other():
    full = Full(floor=0.1)
    y = torch.zeros(2, dtype=F64)
    assert full.log_prob(y, torch.full((3, 8, 2), math.inf, dtype=F64)).tolist() == [-math.inf] * 3
    good = draw(4, 8, 2)
    alone = full.log_prob(y, good)
    assert bool(torch.isfinite(alone).all())
    for bad in (math.inf, -math.inf, math.nan):
        mixed = good.clone()
        mixed[1] = bad
        mixed[3, 2, 0] = bad
        value = full.log_prob(y, mixed)
        assert value[[1, 3]].tolist() == [-math.inf] * 2
        assert torch.equal(value[[0, 2]], alone[[0, 2]])
