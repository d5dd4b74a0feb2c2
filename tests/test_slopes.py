"""Whether a simulator differentiates is asked before any long work, and it need not do so in forward mode."""

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.errors import SimulatorError
from torchcal.inference.setup import check_inputs
from torchcal.simulators import check_slopes

F64 = torch.float64
X = torch.linspace(0, 4, 30, dtype=F64)
DECAY = [tc.Parameter("a", low=0.0, initial=2.0), tc.Parameter("k", initial=0.5)]


def lost(what):
    """A decay that loses the derivative of its size, of its rate, or of a part of its rate."""

    def decay(x, p):
        if what == "a":
            return p["a"].detach() * torch.exp(-p["k"] * x)
        if what == "k":
            return p["a"] * torch.as_tensor(np.exp(-p["k"].detach().numpy() * x.numpy()))
        return p["a"] * torch.exp(-0.5 * (p["k"] + p["k"].detach()) * x)

    return decay


def recorded():
    return tc.Recording(x=X, y=3 * torch.exp(-0.7 * X), noise=0.02)


def noisy():
    noise = 0.02 * torch.randn(30, dtype=F64, generator=torch.Generator().manual_seed(0))
    return tc.Recording(x=X, y=3 * torch.exp(-0.7 * X) + noise, noise=0.02)


@pytest.mark.parametrize("what", ["a", "k", "a part of k"])
def test_calibration_refuses_a_static_simulator_that_loses_a_derivative(what):
    simulator = tc.Simulator(lost(what), DECAY)
    with pytest.raises(SimulatorError, match=f"the simulator to depend on {what[-1]!r} through torch operations alone"):
        tc.calibrate(simulator, recorded())


@pytest.mark.parametrize("what", ["k", "a part of k", "y"])
def test_calibration_refuses_rates_that_lose_a_derivative(what):
    def rates(t, s, p, u):
        k = p["k"].detach() if what == "k" else 0.5 * (p["k"] + p["k"].detach()) if what == "a part of k" else p["k"]
        return {"y": -k * (s["y"] if what != "y" else s["y"].detach())}

    ode = tc.ODESimulator(rates, ["y"], [tc.Parameter("k", low=0.0, initial=0.5)])
    run = tc.Run(time=X, outputs={"y": 3 * torch.exp(-0.7 * X)}, initial={"y": 3.0})
    with pytest.raises(SimulatorError, match=r"depend on '.*' through torch operations alone"):
        tc.calibrate(ode, tc.Recording(runs=[run], noise=0.02))


def large(x, p):
    return {"large": 1e6 * p["a"] * torch.exp(-0.3 * x), "small": lost("k")(x, p)}


def both(x, p):
    return {"large": 1e3 * p["a"] * torch.exp(-p["k"] * x), "small": lost("k")(x, p)}


@pytest.mark.parametrize(
    ("function", "parameters"),
    [
        (lost("k"), [tc.Parameter("a"), tc.Parameter("k")]),
        (lost("k"), [DECAY[0], tc.Parameter("k", low=0.0, initial=1e-8)]),
        (lambda x, p: 1e6 + p["b"] + lost("k")(x, p), [*DECAY, tc.Parameter("b")]),
        (large, DECAY),
        (both, DECAY),
    ],
    ids=["no first guess: 0, without effect", "next to its bound", "an offset", "a larger output", "one of two"],
)
def test_what_hides_a_lost_derivative_does_not_help(function, parameters):
    y = 3 * torch.exp(-0.7 * X)
    recording = tc.Recording(x=X, y={"large": 1e6 * y, "small": y} if function in (large, both) else y)
    with pytest.raises(SimulatorError, match="depend on 'k'"):
        check_inputs(tc.Simulator(function, parameters), recording, None)


def test_a_parameter_that_is_held_may_be_a_number():
    simulator = tc.Simulator(lost("k"), DECAY)
    check_inputs(simulator, recorded(), {"k": 0.7})


def test_a_parameter_whose_guess_is_on_its_bound_is_asked_within():
    on_bound = [DECAY[0], tc.Parameter("k", low=0.0, high=5.0, initial=0.0)]
    with pytest.raises(SimulatorError, match="depend on 'k'"):
        check_inputs(tc.Simulator(lost("k"), on_bound), recorded(), None)
    sound = tc.Simulator(lambda x, p: p["a"] * torch.exp(-p["k"] * x), on_bound)
    check_inputs(sound, recorded(), None)
    values = torch.tensor([[2.0, 0.0]], dtype=F64)
    check_slopes(tc.Simulator(lost("k"), on_bound), X, values, [1])  # no room for a step, and no other values


def test_other_code_is_not_asked():
    calls = []

    def decay(x, p):
        calls.append(1)
        return p["a"] * np.exp(-p["k"] * x)

    simulator = tc.ExternalSimulator(decay, DECAY, vectorized=True)
    check_slopes(simulator, X, torch.tensor([[2.0, 0.5]], dtype=F64), [0, 1])
    assert not calls


class OneWay(torch.autograd.Function):
    """An exponential that somebody has written with a backward pass alone."""

    passes = 0

    @staticmethod
    def forward(ctx, value):
        ctx.save_for_backward(value)
        return value.exp()

    @staticmethod
    def backward(ctx, grad):
        OneWay.passes += 1
        return grad * ctx.saved_tensors[0].exp()


class Once(OneWay):
    """The same, whose backward pass is not differentiated either."""

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        return grad * ctx.saved_tensors[0].exp()


def inner(x, p):
    """One that differentiates forwards by itself: torch does not nest that."""
    whole = -p["k"] * x
    found, _ = torch.func.jvp(torch.exp, (whole,), (torch.ones_like(whole),))
    return p["a"] * found


@pytest.mark.parametrize(
    "function",
    [lambda x, p: p["a"] * OneWay.apply(-p["k"] * x), lambda x, p: p["a"] * Once.apply(-p["k"] * x), inner],
    ids=["no jvp", "backward once", "jvp inside"],
)
def test_a_function_without_forward_derivatives_is_linearised_in_reverse(function):
    one_way = tc.Simulator(function, DECAY)
    both = tc.Simulator(lambda x, p: p["a"] * torch.exp(-p["k"] * x), DECAY)
    values = torch.tensor([[2.0, 0.5], [1.0, 0.1], [3.0, 2.0]], dtype=F64)
    for columns in (None, [1], [1, 0]):
        found, wanted = (each.linearise(X, values, columns=columns) for each in (one_way, both))
        torch.testing.assert_close(found.y, wanted.y)
        torch.testing.assert_close(found.jacobian, wanted.jacobian)
    diagnosis = tc.diagnose(one_way, noisy(), progress=False)
    assert diagnosis.verdict == "consistent"


def test_many_outputs_take_a_few_backward_passes():
    many = torch.linspace(0, 4, 5000, dtype=F64)
    simulator = tc.Simulator(lambda x, p: p["a"] * OneWay.apply(-p["k"] * x), DECAY)
    before = OneWay.passes
    check_inputs(simulator, tc.Recording(x=many, y=3 * torch.exp(-0.7 * many), noise=0.02), None)
    simulator.linearise(many, torch.tensor([[2.0, 0.5]], dtype=F64))
    assert 0 < OneWay.passes - before < 50


def test_a_simulator_that_has_not_written_something_says_so():
    def unwritten(x, p):
        raise NotImplementedError("not yet")

    with pytest.raises(SimulatorError, match="raised NotImplementedError: not yet"):
        tc.Simulator(unwritten, DECAY).linearise(X, torch.ones(1, 2, dtype=F64))


class InNumPy(OneWay):
    """One whose backward pass is right, and is not differentiated, without a word."""

    @staticmethod
    def backward(ctx, grad):
        return torch.as_tensor(grad.detach().numpy() * np.exp(ctx.saved_tensors[0].detach().numpy()))


@pytest.mark.parametrize("scale", [1.0, 1e-12])
def test_a_part_that_is_lost_in_two_backward_passes_is_not_lost(scale):
    """However small it is, beside others or in its units."""
    outputs = ("large", "small")

    def two(x, p, exp):
        return {"large": 1e6 * p["a"] * torch.exp(-p["k"] * x), "small": scale * p["a"] * exp(-p["k"] * x)}

    one_way = tc.Simulator(lambda x, p: two(x, p, InNumPy.apply), DECAY)
    both = tc.Simulator(lambda x, p: two(x, p, torch.exp), DECAY)
    values = torch.tensor([[2.0, 0.5], [1.0, 0.1]], dtype=F64)
    found, wanted = (each.linearise(X, values, outputs).jacobian for each in (one_way, both))
    torch.testing.assert_close(found, wanted, atol=0.0, rtol=1e-9)


def test_a_failing_simulator_is_called_once():
    calls = []

    def failing(x, p):
        calls.append(1)
        raise MemoryError("too much")

    for simulator in (tc.Simulator(failing, DECAY), tc.ExternalSimulator(failing, DECAY, vectorized=True)):
        calls.clear()
        with pytest.raises(SimulatorError, match="too much"):
            simulator.linearise(X, torch.ones(1, 2, dtype=F64))
        assert len(calls) == 1


def test_a_diagnosis_asks_for_the_derivatives_that_it_goes_by():
    """Forward mode passes through no_grad(), which a backward pass does not."""

    def partly(x, p):
        with torch.no_grad():
            decaying = torch.exp(-p["k"] * x)
        return p["a"] * decaying

    simulator = tc.Simulator(partly, DECAY)
    diagnosis = tc.diagnose(simulator, noisy(), progress=False)
    assert diagnosis.verdict == "consistent"
    with pytest.raises(SimulatorError, match="depend on 'k'"):
        check_inputs(simulator, recorded(), None)
