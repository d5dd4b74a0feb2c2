"""Functions of plain numbers as simulators: values, gradients, executors, failures."""

import copy
import math
import multiprocessing
import os
import pickle
from collections import Counter
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
import torch

from torchcal import Recording, Term, calibrate
from torchcal.embeddings import Gaussian
from torchcal.errors import DomainError, ShapeError, SimulatorError
from torchcal.likelihoods import ABC
from torchcal.propagation import NISP
from torchcal.simulators import ExternalSimulator, Parameter, Simulator
from torchcal.terms import extend

PARAMETERS = [Parameter("a", low=0.5, high=2.0), Parameter("b")]
X = {"s": torch.tensor([0.1, 0.5, 0.5, 0.9]).double(), "t": torch.tensor([1.0, 2.0, 2.0, 3.0]).double()}


def scalar(x, p):
    return math.exp(p["a"] * x["s"]) * math.sin(p["b"] * x["t"])


def arrays(x, p):
    return np.exp(p["a"] * x["s"]) * np.sin(p["b"] * x["t"])


def two(x, p):
    return {"y": scalar(x, p), "z": p["a"] * x["t"]}


def in_torch(x, p):
    return torch.exp(p["a"] * x["s"]) * torch.sin(p["b"] * x["t"])


def plain(x, p):
    return p["a"] * x + p["b"] ** 2


def fails(x, p):
    if p["a"] > 1.5 and x["t"] == 2.0:
        raise ValueError("no root")
    return scalar(x, p)


class OddError(Exception):
    """Pickles, but cannot be unpickled: its arguments are not its message."""

    def __init__(self, code, where):
        super().__init__(f"code {code} in {where}")


def fails_oddly(x, p):
    raise OddError(3, "inlet")


def dies(x, p):
    os._exit(1)


class Counted:
    def __init__(self, function):
        self.function, self.calls = function, Counter()

    def __call__(self, x, p):
        self.calls[str((x, p))] += 1
        return self.function(x, p)


@pytest.fixture(scope="module")
def pool():
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        yield executor


@pytest.fixture
def values():
    return torch.tensor([[1.0, 0.3], [1.2, -0.7], [1.0, 0.3]]).double()


@pytest.mark.parametrize(("function", "vectorized"), [(scalar, False), (arrays, True)])
def test_values_are_those_of_the_torch_model(function, vectorized, values):
    found = ExternalSimulator(function, PARAMETERS, vectorized=vectorized).at(X)
    oracle = Simulator(in_torch, PARAMETERS).at(X)
    for batch in (values, values[0], values.reshape(3, 1, 2), values[:0]):
        assert found(batch).shape == oracle(batch).shape
        torch.testing.assert_close(found(batch), oracle(batch), rtol=1e-14, atol=1e-15)


def test_a_plain_condition_is_a_float():
    simulator = ExternalSimulator(plain, PARAMETERS)
    assert simulator.at(torch.tensor([1.0, 2.0]))(torch.tensor([3.0, 2.0])).tolist() == [7.0, 10.0]


def test_dtype_follows_the_values(values):
    result = ExternalSimulator(scalar, PARAMETERS).at(X)(values.float())
    assert result.dtype == torch.float32


def test_several_outputs_one_after_another_in_the_order_asked_for(values):
    simulator = ExternalSimulator(two, PARAMETERS)
    y, z = ExternalSimulator(scalar, PARAMETERS).at(X)(values), values[:, :1] * X["t"]
    assert torch.equal(simulator.at(X)(values), torch.cat([y, z], -1))
    assert torch.equal(simulator.at(X, ["z", "y"])(values), torch.cat([z, y], -1))
    assert torch.equal(simulator.at(X, ["z"])(values), z)
    with pytest.raises(SimulatorError, match="'w'"):
        simulator.at(X, ["w"])(values)


def test_identical_evaluations_are_not_repeated(values):
    function = Counted(scalar)
    ExternalSimulator(function, PARAMETERS).at(X)(values)
    assert len(function.calls) == 6  # 2 different rows x 3 different conditions
    assert set(function.calls.values()) == {1}


# --- gradients -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("function", "vectorized"), [(scalar, False), (arrays, True)])
def test_gradient_is_that_of_autograd(function, vectorized, values):
    weight = torch.randn(3, 4, dtype=torch.float64)
    slopes = []
    for simulator in (
        ExternalSimulator(function, PARAMETERS, vectorized=vectorized),
        Simulator(in_torch, PARAMETERS),
    ):
        leaf = values.clone().requires_grad_(True)
        (simulator.at(X)(leaf) * weight).sum().backward()
        slopes.append(leaf.grad)
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-6, atol=1e-7)


def test_gradcheck_and_second_derivatives(values):
    evaluate = ExternalSimulator(scalar, PARAMETERS).at(X)
    leaf = values.clone().requires_grad_(True)
    assert torch.autograd.gradcheck(evaluate, leaf, eps=1e-5, atol=1e-6)

    def hessian(function):
        return torch.autograd.functional.hessian(lambda v: function(v).square().sum(), values[0])

    torch.testing.assert_close(hessian(evaluate), hessian(Simulator(in_torch, PARAMETERS).at(X)), rtol=1e-5, atol=1e-6)


def test_differences_are_second_order_in_the_step(values):
    errors = []
    for step in (0.02, 0.01):
        leaf = values[0].clone().requires_grad_(True)
        ExternalSimulator(scalar, PARAMETERS, step=step).at(X)(leaf).sum().backward()
        exact = values[0].clone().requires_grad_(True)
        Simulator(in_torch, PARAMETERS).at(X)(exact).sum().backward()
        errors.append((leaf.grad - exact.grad).abs())
    ratio = errors[0] / errors[1]
    assert torch.all((ratio - 4).abs() < 0.02), ratio


def slope_of(evaluate, values):
    leaf = values.clone().requires_grad_(True)
    evaluate(leaf).square().sum().backward()
    return leaf.grad


def test_gradient_of_several_outputs(values):
    model = Simulator(lambda x, p: {"y": in_torch(x, p), "z": p["a"] * x["t"]}, PARAMETERS)
    found = slope_of(ExternalSimulator(two, PARAMETERS).at(X, ["z", "y"]), values)
    torch.testing.assert_close(found, slope_of(model.at(X, ["z", "y"]), values), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("function", "vectorized"), [(scalar, False), (arrays, True)])
def test_parameters_that_vary_with_the_conditions(function, vectorized, values):
    def shifted(simulator):
        return lambda v: simulator.function(X, {"a": v[..., :1] * X["t"], "b": v[..., 1:]})

    external = shifted(ExternalSimulator(function, PARAMETERS, vectorized=vectorized))
    model = shifted(Simulator(in_torch, PARAMETERS))
    torch.testing.assert_close(external(values), model(values), rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(slope_of(external, values), slope_of(model, values), rtol=1e-6, atol=1e-6)


def test_a_vectorized_function_is_called_once_for_each_value_of_a_shifted_parameter(values):
    def mixes(x, p):  # what is at one condition depends on them all
        calls.append(p["a"])
        return {"y": p["a"] * np.cumsum(x["t"]), "z": x["s"] ** p["b"]}

    calls = []
    simulator = ExternalSimulator(mixes, PARAMETERS, vectorized=True)
    a = torch.tensor([[1.0, 1.0, 2.0, 2.0], [1.0, math.nan, 3.0, 3.0], [math.nan] * 4]).double()
    found = simulator.function(X, {"a": a, "b": torch.ones(3, 1).double()})
    assert sorted(calls) == [1.0, 2.0, 3.0]
    torch.testing.assert_close(found["y"], a * torch.cumsum(X["t"], 0), equal_nan=True)
    torch.testing.assert_close(found["z"], torch.where(a.isnan(), a, X["s"]), equal_nan=True)
    backwards = simulator.function(X, {"a": a.flip(0), "b": torch.ones(3, 1).double()})  # the first has no answer
    torch.testing.assert_close(backwards["y"], found["y"].flip(0), equal_nan=True)


def test_gradient_takes_2d_evaluations_a_row_and_only_when_needed(values):
    function = Counted(scalar)
    evaluate = ExternalSimulator(function, PARAMETERS).at({k: v[:1] for k, v in X.items()})
    with torch.no_grad():
        evaluate(values)
    assert sum(function.calls.values()) == 2
    leaf = values.clone().requires_grad_(True)
    result = evaluate(leaf)
    function.calls.clear()
    result[1].sum().backward()
    assert sum(function.calls.values()) == 4


def test_parameters_with_bounds_initial_or_logarithm_get_their_own_step():
    points = []

    def record(x, p):
        points.append(tuple(p.values()))
        return sum(p.values())

    parameters = [
        Parameter("bounded", low=0.0, high=1000.0),
        Parameter("guessed", initial=1e-6),
        Parameter("open"),
        Parameter("log", transform="log"),
    ]
    leaf = torch.tensor([0.0, 0.0, 0.0, 1e-9], dtype=torch.float64, requires_grad=True)
    result = ExternalSimulator(record, parameters).at(torch.zeros(1))(leaf)
    points.clear()
    result.sum().backward()
    widest = np.ptp(np.array(points), axis=0) / 2
    np.testing.assert_allclose(widest, [0.05, 1e-10, 1e-4, 1e-13], rtol=1e-9)


def test_an_initial_value_gives_a_tiny_parameter_its_scale():
    value = 3e-7
    wave = ExternalSimulator(lambda x, p: math.sin(1e6 * p["a"] * x), [Parameter("a", initial=value)])
    leaf = torch.tensor([value], dtype=torch.float64, requires_grad=True)
    wave.at(torch.ones(1, dtype=torch.float64))(leaf).sum().backward()
    assert float(leaf.grad) == pytest.approx(1e6 * math.cos(1e6 * value), rel=1e-6)


# --- executors -----------------------------------------------------------------------------------------


def test_process_pool(pool, values):
    serial, pooled = ExternalSimulator(scalar, PARAMETERS), ExternalSimulator(scalar, PARAMETERS, executor=pool)
    assert torch.equal(serial.at(X)(values), pooled.at(X)(values))
    many = torch.rand(500, 2).double()
    assert torch.equal(serial.at(X)(many), pooled.at(X)(many))


def test_threads_and_executors_that_do_not_say_how_many_workers(values):
    class Anonymous(Executor):
        def submit(self, fn, /, *args, **kwargs):
            future = Future()
            future.set_result(fn(*args, **kwargs))
            return future

    expected = ExternalSimulator(scalar, PARAMETERS).at(X)(values)
    with ThreadPoolExecutor(2) as threads:
        for executor in (threads, Anonymous()):
            assert torch.equal(ExternalSimulator(scalar, PARAMETERS, executor=executor).at(X)(values), expected)


def test_a_function_that_cannot_be_pickled_is_refused_at_once(pool):
    with pytest.raises(SimulatorError, match="top level of a module") as caught:
        ExternalSimulator(lambda x, p: 0.0, PARAMETERS, executor=pool)
    assert caught.value.__cause__ is not None


def test_a_closed_executor_is_named():
    with ThreadPoolExecutor(1) as closed:
        pass
    with pytest.raises(DomainError, match="shutdown"):
        ExternalSimulator(scalar, PARAMETERS, executor=closed).at(X)(torch.ones(2))


def test_the_simulator_itself_pickles_and_copies(pool, values):
    simulator = ExternalSimulator(scalar, PARAMETERS, executor=pool, step=1e-3)
    sent = pickle.loads(pickle.dumps(simulator))
    assert sent.executor is None
    assert torch.equal(sent.at(X)(values), simulator.at(X)(values))
    assert copy.deepcopy(simulator).executor is pool
    assert copy.copy(simulator).step == 1e-3


# --- failures ------------------------------------------------------------------------------------------


def test_a_failure_is_named_with_its_point(pool):
    values = torch.tensor([[1.0, 0.3], [1.75, 0.5]]).double()
    for executor in (None, pool):
        with pytest.raises(SimulatorError, match="no root") as caught:
            ExternalSimulator(fails, PARAMETERS, executor=executor).at(X)(values)
        assert "x = {'s': 0.5, 't': 2.0}, p = {'a': 1.75, 'b': 0.5}" in str(caught.value)
        assert isinstance(caught.value.__cause__, ValueError)


def test_the_worker_shows_where_it_failed(pool):
    with pytest.raises(SimulatorError) as caught:
        ExternalSimulator(fails, PARAMETERS, executor=pool).at(X)(torch.tensor([1.75, 0.5]).double())
    assert "raise ValueError" in "".join(caught.value.__cause__.__notes__)


def test_an_exception_that_cannot_be_pickled_does_not_break_the_pool(pool, values):
    with pytest.raises(SimulatorError, match="OddError: code 3 in inlet"):
        ExternalSimulator(fails_oddly, PARAMETERS, executor=pool).at(X)(values)
    assert pool.submit(abs, -1).result() == 1


def test_a_worker_that_dies_is_named(values):
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as short_lived:
        with pytest.raises(SimulatorError, match=r"worker process died at x = \{'s': 0.1"):
            ExternalSimulator(dies, PARAMETERS, executor=short_lived).at(X)(values)


@pytest.mark.parametrize("wrong", ["text", None, 1j, True, [1.0, 2.0], {}, {"y": "text"}, object()])
def test_a_result_that_is_no_real_number_is_named(wrong, values):
    with pytest.raises(SimulatorError, match=r"Expected .* Got .*x = \{'s': 0.1") as caught:
        ExternalSimulator(lambda x, p: wrong, PARAMETERS).at(X)(values)
    assert "complex" in str(caught.value) or wrong != 1j


@pytest.mark.parametrize("right", [2, 2.0, np.float32(2), np.array([2.0]), torch.tensor(2.0), [2.0]])
def test_results_that_are_one_real_number(right, values):
    assert ExternalSimulator(lambda x, p: right, PARAMETERS).at(X)(values).unique().tolist() == [2.0]


@pytest.mark.parametrize("dtype", [float, int])
def test_a_masked_value_is_missing(dtype, values):
    masked = np.ma.masked_array([-999, 2, 3, -999], [True, False, False, True], dtype=dtype)
    result = ExternalSimulator(lambda x, p: masked, PARAMETERS, vectorized=True).at(X)(values)
    np.testing.assert_equal(result.numpy(), np.tile([np.nan, 2.0, 3.0, np.nan], (3, 1)))
    result = ExternalSimulator(lambda x, p: {"y": masked[0], "z": masked[:1]}, PARAMETERS).at(X)(values)
    assert result.isnan().all()
    assert masked.data[0] == -999


@pytest.mark.parametrize("wrong", [1.0, np.ones(3), np.ones((4, 1)), np.ones(1)])
def test_a_vectorized_result_of_the_wrong_shape(wrong, values):
    with pytest.raises(SimulatorError, match=r"shape \(4,\)"):
        ExternalSimulator(lambda x, p: wrong, PARAMETERS, vectorized=True).at(X)(values)


def test_nan_is_a_value_and_check_decides(values):
    simulator = ExternalSimulator(lambda x, p: math.nan if p["a"] > 1.1 else scalar(x, p), PARAMETERS)
    result = simulator.at(X)(values)
    assert result.isfinite().all(-1).tolist() == [True, False, True]
    assert simulator.check(X, values) == 4
    with pytest.raises(SimulatorError, match="finite"):
        simulator.check(X, values[1:2])


def test_parameters_that_are_not_finite_are_not_tried(values):
    function = Counted(scalar)
    values[1, 0] = math.nan
    result = ExternalSimulator(function, PARAMETERS).at(X)(values)
    assert result.isfinite().all(-1).tolist() == [True, False, True]
    function.calls.clear()
    assert ExternalSimulator(function, PARAMETERS).at(X)(values[1]).isnan().all()
    assert not function.calls


def test_outputs_must_be_the_same_everywhere(values):
    function = lambda x, p: {"y": 1.0} if p["a"] > 1.1 else 1.0  # noqa: E731
    with pytest.raises(SimulatorError, match="same outputs"):
        ExternalSimulator(function, PARAMETERS).at(X)(values)


def test_bad_arguments():
    with pytest.raises(DomainError, match="callable"):
        ExternalSimulator(3.0, PARAMETERS)
    for step in (0.0, "1e-4", True):
        with pytest.raises(DomainError, match="step"):
            ExternalSimulator(scalar, PARAMETERS, step=step)
    assert ExternalSimulator(scalar, PARAMETERS, step=np.float32(0.5)).step == 0.5
    with pytest.raises(DomainError, match=r"vectorized as True or False\. Got 'no'"):
        ExternalSimulator(scalar, PARAMETERS, vectorized="no")
    with pytest.raises(DomainError, match="executor"):
        ExternalSimulator(scalar, PARAMETERS, executor=2)
    with pytest.raises(ShapeError, match="one length"):
        ExternalSimulator(scalar, PARAMETERS).at({"s": torch.ones(2), "t": torch.ones(3)})
    with pytest.raises(ShapeError, match=r"\(\*batch, 2\)"):
        ExternalSimulator(scalar, PARAMETERS).at(X)(torch.ones(3))


def test_nisp_through_an_external_code_is_nisp_through_torch():
    parameters = [Parameter("a", low=0.5, high=2.0), Parameter("b", low=-1.0, high=1.0)]
    alpha = torch.tensor([0.1, 0.2, 0.3, 0.1, 0.2]).double()
    slopes, moments = [], []
    for simulator in (ExternalSimulator(scalar, parameters), Simulator(in_torch, parameters)):
        module = NISP(simulator, Gaussian(), X, rule=5)
        leaf = alpha.clone().requires_grad_(True)
        mean, sd = module(leaf)
        (mean + sd).square().sum().backward()
        slopes.append(leaf.grad)
        moments.append(torch.stack([mean, sd]).detach())
    torch.testing.assert_close(moments[0], moments[1], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-6, atol=1e-7)


def test_arithmetic_without_an_answer_far_away_is_no_number_and_not_the_end():
    def decay(x, p):
        return p["A"] * math.exp(-p["k"] * x) + 0.0 * math.log(p["A"])

    def broken(x, p):
        raise ValueError("no such file")

    parameters = [Parameter("A", low=1.0, high=6.0), Parameter("k", low=0.1, high=3.0)]
    far = torch.tensor([[2.0, 1.0], [2.0, -1e4], [-1.0, 1.0]], dtype=torch.float64)
    x = torch.linspace(0.1, 3.0, 5, dtype=torch.float64)
    found = ExternalSimulator(decay, parameters).at(x)(far)
    assert torch.allclose(found[0], 2 * torch.exp(-x))
    assert bool(found[1:].isnan().all())
    with pytest.raises(SimulatorError, match="no such file"):
        ExternalSimulator(broken, parameters).at(x)(far)


@pytest.mark.parametrize("kind", ["plain", "named", "vectorized", "pool"])
def test_where_no_point_has_an_answer_the_reason_is_named(kind, pool):
    x = torch.linspace(0.1, 3.0, 5, dtype=torch.float64)
    where = {"s": x, "t": x} if kind == "named" else x
    simulator = ExternalSimulator(
        divides, [Parameter("a", low=1.0, high=2.0)], vectorized=kind == "vectorized",
        executor=pool if kind == "pool" else None,
    )  # fmt: skip
    with pytest.raises(SimulatorError, match=r"none of 3 .* raised ZeroDivisionError: float division") as caught:
        simulator.check(where, torch.tensor([[1.0], [1.5], [2.0]]).double())
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def divides(x, p):
    return p["a"] / (p["a"] - p["a"])


def test_a_calibration_without_any_answer_says_why():
    def half(x, p):
        return {"y": p["a"] * math.log(1.5 - x), "z": x * p["a"]}

    x = torch.linspace(1.0, 2.0, 5, dtype=torch.float64)
    simulator = ExternalSimulator(half, [Parameter("a", low=1.0, high=2.0)])
    with pytest.raises(SimulatorError, match="raised ValueError: math domain error"):
        calibrate(simulator, Recording(x=x, y={"z": x, "y": x}), num_samples=0)


def test_a_function_that_returns_nan_itself_is_not_said_to_raise(values):
    with pytest.raises(SimulatorError, match=r"everywhere\. Check the simulator") as caught:
        ExternalSimulator(lambda x, p: math.nan, PARAMETERS).check(X, values)
    assert caught.value.__cause__ is None


def test_random_numbers_in_a_code_are_told_as_such(values):
    random = np.random.default_rng(0)
    simulator = ExternalSimulator(lambda x, p: scalar(x, p) + random.normal(), PARAMETERS)
    with pytest.raises(SimulatorError, match="same numbers for the same arguments: seed random numbers"):
        simulator.check(X, values)


@pytest.mark.parametrize("bent", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_black_box_is_searched_on_its_tangents(bent):
    """With a term it is a black box still."""
    calls = 0

    def decay(x, p):
        nonlocal calls
        calls += 1
        return p["a"] * math.exp(-p["k"] * x)

    x = torch.linspace(0, 3, 6, dtype=torch.float64)
    y = 2 * torch.exp(-0.8 * x) + 0.1 * x
    parameters = [Parameter("a", low=0.0, high=5.0), Parameter("k", low=0.01, high=3.0, transform="log")]
    simulators = (
        ExternalSimulator(decay, parameters),
        Simulator(lambda x, p: p["a"] * torch.exp(-p["k"] * x), parameters),
    )
    options, most = {"likelihood": ABC(epsilon=0.02), "num_samples": 0}, 1_000_000
    if bent:
        tilt = Term(
            "tilt", outputs={"y": lambda x, p, y: y + p["q"] * x}, parameters=[Parameter("q", low=-0.2, high=0.5)]
        )
        simulators = tuple(extend(one, [tilt]) for one in simulators)
        y, options, most = y + 0.05 * torch.sin(9 * x), {**options, "fixed": {"a": 2.0}}, 600_000
    box, model = (calibrate(one, Recording(x=x, y=y), **options).map for one in simulators)
    assert box.objective == pytest.approx(model.objective, rel=1e-6)
    if not bent:
        torch.testing.assert_close(box.mean, model.mean, rtol=1e-4, atol=0)
    assert calls < most  # of 10 data ten million with every start on the model itself
