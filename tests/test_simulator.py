"""Parameters, scalings and static simulators."""

import math
import warnings

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import torchcal as tc
from torchcal.errors import DomainError, EmbeddingError, ShapeError, SimulatorError
from torchcal.simulators import Scaling, free_parameters

X = torch.linspace(0.0, 2.0, 5, dtype=torch.float64)
AB = [tc.Parameter("a"), tc.Parameter("b")]

# Different orders of the same float64 sums differ by a few units in the last place.
ROUNDING = 1e-13


def values(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# --- parameters -----------------------------------------------------------------------------------


def test_parameter_keeps_what_it_was_given_as_floats():
    parameter = tc.Parameter("k", unit="1/s", low=1, high=torch.tensor(3), initial=2)
    assert (parameter.low, parameter.high, parameter.initial) == (1.0, 3.0, 2.0)
    assert all(type(v) is float for v in (parameter.low, parameter.high, parameter.initial))
    assert parameter.contains(1.0)
    assert parameter.contains(3.0)
    assert not parameter.contains(3.1)
    with pytest.raises(AttributeError):
        parameter.low = 0.0


@pytest.mark.parametrize("kind", [tc.Simulator, tc.ExternalSimulator])
def test_a_parameter_of_each_run_is_refused_where_there_are_no_runs(kind):
    with pytest.raises(DomainError, match=r"Got per_run=True for \['k'\]: a static recording has no runs"):
        kind(lambda x, p: p["a"] + p["k"] * x, [tc.Parameter("a"), tc.Parameter("k", per_run=True)])


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"name": ""}, "non-empty string"),
        ({"name": 3}, "non-empty string"),
        ({"low": math.nan}, "finite number for low"),
        ({"high": math.inf}, "finite number for high"),
        ({"initial": "guess"}, "finite number for initial"),
        ({"initial": True}, "finite number for initial"),
        ({"initial": np.True_}, "finite number for initial"),
        ({"low": np.array("1")}, "finite number for low"),
        ({"high": torch.tensor(True)}, "finite number for high"),
        ({"per_run": "yes"}, "per_run of parameter 'k' as True or False"),
        ({"neutral": [1.0, 2.0]}, "finite number for neutral"),
        ({"low": 2.0, "high": 1.0}, "low < high"),
        ({"low": 1.0, "high": 1.0}, "low < high"),
        ({"low": 0.0, "initial": -1.0}, "between its bounds"),
        ({"high": 0.0, "initial": 1.0}, "between its bounds"),
        ({"transform": "sqrt"}, "None or 'log'"),
        ({"transform": "log", "low": 0.0}, "positive low"),
        ({"transform": "log", "initial": -2.0}, "positive initial"),
        ({"transform": "log", "neutral": 0.0}, "positive neutral"),
    ],
)
def test_bad_parameter_is_refused(bad, message):
    with pytest.raises(DomainError, match=message):
        tc.Parameter(**{"name": "k", **bad})


def test_free_parameters_are_those_neither_fixed_nor_dormant():
    parameters = [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("m", neutral=1.0), tc.Parameter("c")]
    free, held = free_parameters(parameters, {"b": 2})
    assert [p.name for p in free] == ["a", "c"]
    assert held == {"b": 2.0, "m": 1.0}
    _, held = free_parameters(parameters, {"m": 5.0})
    assert held == {"m": 5.0}


def test_free_parameters_refuses_what_it_cannot_hold():
    with pytest.raises(EmbeddingError, match=r"Got \['z'\]"):
        free_parameters(AB, {"z": 1.0})
    with pytest.raises(EmbeddingError, match="at least one free parameter"):
        free_parameters(AB, {"a": 1.0, "b": 1.0})
    with pytest.raises(DomainError, match="finite number"):
        free_parameters(AB, {"a": math.inf})


def test_only_what_each_run_has_for_itself_is_called_by_its_name_alone():
    named = [tc.Parameter("k[1]"), tc.Parameter("c")]
    with pytest.raises(EmbeddingError, match=r"Got \['k'\]"):
        free_parameters(named, {"k": 7.0})
    assert free_parameters(named, {"k[1]": 7.0})[1] == {"k[1]": 7.0}
    _, held = free_parameters([tc.Parameter("k"), *named], {"k": 7.0})
    assert held == {"k": 7.0}
    runs = [tc.Run([0.0, 1.0, 2.0], outputs={"z": [1.0, 0.6, 0.4]}) for _ in range(2)]
    model = tc.ODESimulator(lambda t, s, p, u: {"z": -p["k"] * s["z"]}, ["z"], [tc.Parameter("k", per_run=True)])
    bound = model.bind(tc.Recording(runs=runs)).parameters
    assert free_parameters(bound, {"k": 2.0, "z(0)[1]": 1.0})[1] == {"k[0]": 2.0, "k[1]": 2.0, "z(0)[1]": 1.0}
    assert free_parameters(bound, {"z(0)": 1.0})[1] == {"z(0)[0]": 1.0, "z(0)[1]": 1.0}


# --- scaling --------------------------------------------------------------------------------------

SCALED = [
    tc.Parameter("both", low=10.0, high=20.0),
    tc.Parameter("low", low=1.0),
    tc.Parameter("log", low=1e-3, high=1e3, transform="log"),
    tc.Parameter("guess", initial=-4.0),
    tc.Parameter("plain"),
]


def test_two_bounds_become_minus_one_and_one():
    """Eq. 40 of the paper."""
    scaling = Scaling.from_parameters(SCALED)
    low, high = scaling.bounds(SCALED)
    # The scaled bounds come from one subtraction and one division.
    torch.testing.assert_close(low[[0, 2]], -torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-15)
    torch.testing.assert_close(high[[0, 2]], torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-15)
    assert low.tolist()[1] == 1.0
    assert high.tolist()[1] == math.inf
    assert (low[3:] == -math.inf).all()
    assert (high[3:] == math.inf).all()
    ends = scaling.physical(torch.stack([low, high]).nan_to_num(posinf=0.0, neginf=0.0))
    torch.testing.assert_close(ends[:, 2], torch.tensor([1e-3, 1e3], dtype=torch.float64), rtol=1e-13, atol=0)


def test_a_first_guess_centres_and_scales():
    scaling = Scaling.from_parameters(SCALED)
    assert (scaling.center[3], scaling.scale[3]) == (-4.0, 4.0)
    assert (scaling.center[4], scaling.scale[4]) == (0.0, 1.0)


def test_scaling_and_back_is_the_identity():
    scaling = Scaling.from_parameters(SCALED)
    scaled = values(3, 2, 5)
    torch.testing.assert_close(scaling.scaled(scaling.physical(scaled)), scaled, rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradcheck(scaling.physical, scaled.requires_grad_())


@pytest.mark.parametrize("energy", [1.0, 800.0, 1e5])
def test_a_large_value_beside_a_logarithmic_one_has_a_derivative(energy):
    """exp(800) is not finite, and no parameter of that size is to be sought along NaN."""
    factor, height = tc.Parameter("A", transform="log", initial=2.0), tc.Parameter("E", initial=energy)
    scaling = Scaling.from_parameters([factor, height])
    point = torch.tensor([0.3, 0.1], dtype=torch.float64, requires_grad=True)
    values = scaling.physical(point)
    (slope,) = torch.autograd.grad(values.sum(), point)
    assert slope.tolist() == pytest.approx([values[0].item(), energy], rel=1e-12)


def test_the_transform_of_a_factor_changes_no_calibration_of_an_activation_energy():
    x = torch.linspace(300.0, 400.0, 15, dtype=torch.float64)
    y = 2.0 * torch.exp(-5000.0 * (1 / x - 1 / 350)) * (1 + 0.1 * torch.sin(x / 10))

    def rate(x, p):
        return p["A"] * torch.exp(-p["E"] * (1 / x - 1 / 350))

    maps = []
    for transform in (None, "log"):
        parameters = [tc.Parameter("A", transform=transform, initial=2.0), tc.Parameter("E", unit="K", initial=5e3)]
        found = tc.calibrate(tc.Simulator(rate, parameters), tc.Recording(x=x, y=y), num_samples=0, progress=False).map
        maps.append(torch.stack([found.mean, found.sd]))
    # ln A and A bear a density of the same width a little differently.
    torch.testing.assert_close(maps[1], maps[0], rtol=0.03, atol=0)


def test_bounds_of_a_logarithmic_parameter_limit_its_median():
    # The data ask for more than high=: the median stays at it, and the mean goes beyond.
    x = torch.linspace(0.2, 2, 8, dtype=torch.float64)
    k = tc.Parameter("k", low=0.1, high=1.0, transform="log")
    simulator = tc.Simulator(lambda x, p: p["k"] * x, [k])
    data = tc.Recording(x=x, y=3 * x)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tc.errors.IdentifiabilityWarning)
        fit = tc.calibrate(simulator, data, likelihood=tc.likelihoods.ABC(epsilon=0.1), num_samples=0)
    drawn = fit.sample_parameters(4001, kind="map")[:, 0]
    assert float(drawn.median()) < 1.1
    assert float(fit.map.mean[0]) > 1.2
    assert "median" in (tc.Parameter.__doc__ or "")


def test_scaling_refuses_unequal_lengths():
    with pytest.raises(ShapeError, match="one shape"):
        Scaling(torch.zeros(2), torch.ones(3), torch.zeros(2, dtype=torch.bool))


# --- simulators -----------------------------------------------------------------------------------


def line(x, p):
    return p["a"] + p["b"] * x


@pytest.mark.parametrize("batch", [(), (3,), (4, 3), (0,)])
def test_batches_of_parameters_go_through_elementwise_code(batch):
    simulate = tc.Simulator(line, AB).at(X)
    points = values(*batch, 2)
    result = simulate(points)
    assert result.shape == (*batch, 5)
    torch.testing.assert_close(result, points[..., :1] + points[..., 1:] * X, rtol=ROUNDING, atol=ROUNDING)


def test_named_conditions_and_several_outputs_come_one_after_another():
    simulator = tc.Simulator(lambda x, p: {"u": p["a"] * x["t"], "v": p["b"] * x["s"], "w": p["a"]}, AB)
    conditions = {"t": X, "s": X**2}
    points = values(3, 2)
    result = simulator.at(conditions, ["w", "v"])(points)
    expected = torch.cat([points[:, :1].expand(3, 5), points[:, 1:] * X**2], dim=-1)
    torch.testing.assert_close(result, expected, rtol=0, atol=0)
    assert simulator.at(conditions)(points).shape == (3, 15)


def test_an_output_that_ignores_the_conditions_is_spread_over_them():
    result = tc.Simulator(lambda x, p: p["a"] * p["b"], AB).at(X)(values(3, 2))
    assert result.shape == (3, 5)
    assert (result == result[:, :1]).all()


def test_one_condition_only():
    result = tc.Simulator(line, AB).at(X[:1])(values(3, 2))
    assert result.shape == (3, 1)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, p: 1 / 0, "ZeroDivisionError"),
        (lambda x, p: p["c"] * x, "KeyError"),
        (lambda x, p: (p["a"] * x).detach().numpy(), "torch tensor. Got ndarray"),
        (lambda x, p: None, "torch tensor. Got NoneType"),
        (lambda x, p: torch.complex(p["a"] * x, x), "real floating-point"),
        (lambda x, p: (p["a"] * x).long(), "real floating-point"),
        (lambda x, p: (p["a"] * x)[..., :-1], "of shape"),
        (lambda x, p: (p["a"] * x).sum(), "of shape"),
        (lambda x, p: (p["a"] * x).sum(-1), "of shape"),
        (lambda x, p: (p["a"] * x).unsqueeze(-1), "of shape"),
        (lambda x, p: (p["a"] * x).transpose(0, -1), "of shape"),
        (lambda x, p: {}, "at least one output"),
    ],
)
def test_a_result_of_the_wrong_kind_is_named(function, message):
    with pytest.raises(SimulatorError, match=message):
        tc.Simulator(function, AB).at(X)(values(3, 2))


def test_names_that_can_be_gone_through_but_once_are_kept():
    both = tc.Simulator(lambda x, p: {"u": p["a"] * x, "v": p["a"]}, iter([tc.Parameter("a", low=0, high=1)]))
    evaluate = both.at(torch.zeros(3, dtype=torch.float64), iter(["v"]))
    for _ in range(2):
        assert evaluate(torch.ones(1, dtype=torch.float64)).tolist() == [1.0, 1.0, 1.0]
    assert tc.build_surrogate(both, conditions=(0, 1), order=1, outputs=iter(["v"])).outputs == ("v",)
    rates = lambda t, s, p, u: {"x": -p["k"] * s["x"], "z": s["x"]}  # noqa: E731
    model = tc.ODESimulator(rates, iter(["x", "z"]), iter([tc.Parameter("k")]), observe=iter(["z"]))
    assert (list(model.states), model.names, model.outputs) == (["x", "z"], ("k",), ("z",))


def test_a_missing_output_is_named():
    with pytest.raises(SimulatorError, match=r"\['y'\] missing"):
        tc.Simulator(lambda x, p: {"z": p["a"] * x}, AB).at(X, ["y"])(values(2, 2))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, p: line(x, p).detach(), "without a gradient"),
        (lambda x, p: x + 0 * x, "without a gradient"),
        (lambda x, p: line(x, p) + torch.rand(()), "in a batch as one at a time"),
        (lambda x, p: line(x, p) - line(x, p).mean(), "in a batch as one at a time"),
        (lambda x, p: line(x, p) * math.nan, "Expected finite outputs. Got nan"),
        (lambda x, p: line(x, p) / 0, "Expected finite outputs. Got -?inf"),
    ],
)
def test_check_finds_what_a_single_call_does_not_show(function, message):
    with pytest.raises(SimulatorError, match=message):
        tc.Simulator(function, AB).check(X, values(8, 2))


def test_check_passes_where_one_point_of_many_is_finite():
    simulator = tc.Simulator(lambda x, p: p["a"].sqrt() * x + p["b"], AB)
    assert simulator.check(X, torch.tensor([[-1.0, 0.0], [1.0, 0.0]], dtype=torch.float64)) == 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((3, AB), "callable"),
        ((line, []), "at least one parameter"),
        ((line, ["a", "b"]), "Parameter objects"),
        ((line, tc.Parameter("a")), r"a list of .*in brackets"),
        ((line, 3), r"a list of .*Got 3"),
        ((line, [*AB, tc.Parameter("a")]), r"\['a'\] more than once"),
    ],
)
def test_bad_simulator_is_refused(arguments, message):
    with pytest.raises(DomainError, match=message):
        tc.Simulator(*arguments)


@pytest.mark.parametrize("degree", [-1, 1.5, True, "two"])
def test_bad_degree_is_refused(degree):
    with pytest.raises(DomainError, match="degree"):
        tc.Simulator(line, AB, degree=degree)


def test_constants_beside_parameters_change_no_derivative():
    # Inside, numbers and plain tensors beside dual ones get tangents; the values are those of plain code.
    x = torch.linspace(0.5, 2, 7, dtype=torch.float64)
    plain = torch.linspace(1, 3, 7, dtype=torch.float64)

    def function(x, p):
        a = p["a"]
        return (a * 2 + 1.5 - x) / 3 + 2 / a - (4 - a) * plain / x + torch.sub(a, 1, alpha=2) + (x > 1) * a + 3 * a**2

    simulator = tc.Simulator(function, [tc.Parameter("a")])
    values = torch.tensor([[0.7], [1.9]], dtype=torch.float64)
    found = simulator.linearise(x, values)
    torch.testing.assert_close(found.y, simulator.at(x)(values), rtol=0, atol=0)
    h = 1e-6
    slope = (simulator.at(x)(values + h) - simulator.at(x)(values - h)) / (2 * h)
    torch.testing.assert_close(found.jacobian[..., 0], slope, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, p: p["a"] / x + 1 / x + 2 / p["a"],
        lambda x, p: torch.where(x > 1, p["a"] * x, 0.5) + torch.where(x > 1, 2.0, x * p["a"]),
        lambda x, p: torch.maximum(p["a"] * x, torch.ones(7, dtype=torch.float64)),
        lambda x, p: torch.minimum(torch.tensor(1.2, dtype=torch.float64), p["a"] * x),
        lambda x, p: (x > 1) * p["a"] + p["a"] * torch.arange(7),
    ],
)
def test_no_operation_beside_parameters_falls_back_to_implicit_tangents(function):
    # They cost a hundred times what the operation does.
    class Watch(TorchDispatchMode):
        implicit = 0

        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            self.implicit += "_efficientzerotensor" in str(func)
            return func(*args, **(kwargs or {}))

    x, values = torch.linspace(0.5, 2, 7, dtype=torch.float64), torch.tensor([[0.7]], dtype=torch.float64)
    simulator = tc.Simulator(function, [tc.Parameter("a")])
    with Watch() as watch:
        found = simulator.linearise(x, values)
    assert watch.implicit == 0
    torch.testing.assert_close(found.y, simulator.at(x)(values), rtol=0, atol=0)
    h = 1e-6
    slope = (simulator.at(x)(values + h) - simulator.at(x)(values - h)) / (2 * h)
    torch.testing.assert_close(found.jacobian[..., 0], slope, rtol=1e-7, atol=1e-7)


def test_powers_of_a_condition_that_is_zero_are_derived():
    x = torch.linspace(0, 3, 7, dtype=torch.float64)
    simulator = tc.Simulator(
        lambda x, p: p["m"] * x["x"] ** p["n"] + p["a"] * x["x"].sqrt(), [tc.Parameter(name) for name in "mna"]
    )
    found = simulator.linearise({"x": x}, torch.tensor([[2.0, 0.5, 0.3]], dtype=torch.float64))
    root = x.sqrt()
    wanted = torch.stack([root, 2 * root * x.clamp_min(1e-300).log(), root], dim=-1)
    torch.testing.assert_close(found.jacobian[0], wanted)


def test_a_function_that_maps_over_its_conditions_is_derived():
    x = torch.linspace(0, 1, 5, dtype=torch.float64)
    simulator = tc.Simulator(lambda x, p: p["a"] * torch.vmap(lambda t: t * 2.0 + 1.0)(x), [tc.Parameter("a")])
    found = simulator.linearise(x, torch.tensor([[3.0]], dtype=torch.float64))
    torch.testing.assert_close(found.jacobian[0, :, 0], 2 * x + 1)


def test_a_function_that_raises_is_told_with_the_values_it_was_called_with() -> None:
    def picky(x, p):
        raise ValueError("not here")

    base = tc.Simulator(picky, parameters=[tc.Parameter("a"), tc.Parameter("b")])
    values = torch.tensor([[1.0, 2.0], [1.0, 5.0]], dtype=torch.float64)
    with pytest.raises(SimulatorError, match=r"ValueError: not here\. .* shape \(2, 1\) \(a = 1, b from 2 to 5\)"):
        base.at(torch.zeros(3, dtype=torch.float64))(values)


def test_random_numbers_in_a_small_output_are_found_beside_a_large_one():
    def both(x, p, noise):
        strain = 2e-3 * p["a"] * x
        return {"stress": 2e6 * p["a"] * x, "strain": strain * (1 + noise * torch.rand_like(strain))}

    x = torch.linspace(0.1, 1, 5, dtype=torch.float64)
    only = [tc.Parameter("a")]
    with pytest.raises(SimulatorError, match="in a batch as one at a time"):
        tc.Simulator(lambda x, p: both(x, p, 0.2), only).check(x, values(8, 1), ["stress", "strain"])
    assert tc.Simulator(lambda x, p: both(x, p, 0.0), only).check(x, values(8, 1), ["stress", "strain"]) == 10


def test_what_rounding_leaves_of_a_system_that_is_solved_is_no_difference():
    n = 40
    matrix = torch.diag(torch.full((n,), 2.0)) - torch.diag(torch.ones(n - 1), 1) - torch.diag(torch.ones(n - 1), -1)
    matrix, x = matrix.double(), torch.linspace(0, 1, n, dtype=torch.float64)

    def solved(x, p):
        rows = 100.0 * p["a"].unsqueeze(-1) * matrix
        right = 1e4 * torch.ones(*p["a"].shape[:-1], n, 1, dtype=torch.float64)
        found = torch.linalg.solve(rows, right)
        return {"T": found[..., 0], "closing": (rows @ found - right)[..., 0] / 1e4}

    simulator = tc.Simulator(solved, [tc.Parameter("a")])
    assert simulator.check(x, 1 + values(8, 1).abs(), ["T", "closing"]) == 2 * n


def test_parameter_values_are_floating_point_numbers():
    with pytest.raises(ShapeError, match=r"floating-point numbers\. Got torch.int64"):
        tc.Simulator(line, AB).at(X)(torch.tensor([1, 2]))
