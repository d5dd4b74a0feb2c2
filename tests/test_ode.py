"""ODE simulators bound to runs: the solver against SciPy's, and every derivative against differences."""

import itertools
import math
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

import torchcal as tc
from torchcal.errors import DomainError, RecordingError, SimulatorError
from torchcal.simulators import Solution, Trajectories, focused, settled, steps
from torchcal.simulators.careful import takes_inputs
from torchcal.simulators.recurrence import recur
from torchcal.terms import extend

F64 = torch.float64


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def oscillator(**options) -> tc.ODESimulator:
    """A damped, driven oscillator with a quadratic drag, so that nothing about it is linear."""
    return tc.ODESimulator(
        lambda t, s, p, u: {
            "x": s["v"],
            "v": -p["k"] * s["x"] - p["c"] * s["v"] * s["v"].abs() + u["f"] * torch.cos(0.3 * t),
        },
        {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, initial=4.0), tc.Parameter("c", low=0.0, initial=0.2)],
        **options,
    )


def drive(t: np.ndarray) -> np.ndarray:
    return np.sin(1.3 * t) + 0.2 * t


def run_of(t: np.ndarray, initial: dict[str, float], hold: str = "linear", **outputs: np.ndarray) -> tc.Run:
    outputs = outputs or {"x": np.zeros_like(t)}
    return tc.Run(time=t, outputs=outputs, inputs={"f": drive(t)}, initial=initial, hold=hold)


def truth(run: tc.Run, start: tuple[float, float], k: float, c: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity at the samples by SciPy, piece by piece between samples, where the input is smooth."""
    t = run.time.numpy()
    states = [np.array(start)]
    for a, b in itertools.pairwise(t):

        def rates(now: float, s: np.ndarray, a: float = a, b: float = b) -> list[float]:
            # At the end of a piece a held input is still that of its beginning.
            inside = min(max(now, a), b - 1e-9 * (b - a))
            f = float(run.inputs_at([inside])["f"][0])
            return [s[1], -k * s[0] - c * s[1] * abs(s[1]) + f * math.cos(0.3 * now)]

        states.append(solve_ivp(rates, (a, b), states[-1], method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1])
    x, v = np.array(states).T
    return x, v


# --- the solver ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hold", ["linear", "zero", "cubic"])
def test_the_solution_is_of_fourth_order_for_every_kind_of_input(hold: str) -> None:
    t = np.array([0.0, 0.4, 0.9, 1.1, 2.0, 2.6, 3.0])
    run = run_of(t, {"x": 1.0, "v": 0.5}, hold)
    model = tc.ODESimulator(  # without |v|, which is not smooth enough for order four
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * torch.sin(s["x"]) + u["f"]},
        {"x": "m", "v": "m/s"},
        [tc.Parameter("k")],
    )
    recording = tc.Recording(runs=[run])

    def rates(now: float, s: np.ndarray, a: float, b: float) -> list[float]:
        inside = min(max(now, a), b - 1e-9 * (b - a))
        return [s[1], -4.0 * math.sin(s[0]) + float(run.inputs_at([inside])["f"][0])]

    state, exact = np.array([1.0, 0.5]), [1.0]
    for a, b in itertools.pairwise(t):
        state = solve_ivp(rates, (a, b), state, args=(a, b), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        exact.append(state[0])
    errors, steps = [], []
    model.max_step = 1.0
    for factor in (2, 4, 8, 16):
        bound = Trajectories(model, recording, subdivide=factor)
        errors.append(np.abs(bound.at(bound.x)(tensor(4.0)).numpy() - exact).max())
        steps.append(factor)
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(-4.0, abs=0.35)
    assert errors[-1] < 1e-5


@pytest.mark.parametrize("hold", ["linear", "zero", "cubic"])
def test_runs_of_unequal_length_agree_with_scipy(hold: str) -> None:
    runs = [
        run_of(np.linspace(0.0, 4.0, 21), {"x": 1.0, "v": 0.0}, hold),
        run_of(np.array([1.0, 1.1, 1.7, 3.0, 3.2]), {"x": -0.5, "v": 2.0}, hold),
    ]
    bound = oscillator().bind(tc.Recording(runs=runs))
    fine = settled(bound, tensor(4.0, 0.2)[None], torch.full((26,), 1e-7, dtype=F64))
    found = fine.at(fine.x)(tensor(4.0, 0.2))
    exact = np.concatenate([truth(runs[0], (1.0, 0.0), 4.0, 0.2)[0], truth(runs[1], (-0.5, 2.0), 4.0, 0.2)[0]])
    assert np.abs(found.numpy() - exact).max() < 1e-6


def test_inputs_that_go_on_in_different_ways_add_up() -> None:
    t = np.linspace(0.0, 4.0, 11)
    inputs = {"valve": np.where(t < 1.5, 1.0, -2.0), "room": np.cos(2 * t)}
    lag = tc.ODESimulator(
        rates=lambda t, s, p, u: {"x": u["valve"] + u["room"] - p["k"] * s["x"]},
        states={"x": "m"}, parameters=[tc.Parameter("k", low=0.1, high=9.0)],
    )  # fmt: skip

    def solved(given: dict[str, np.ndarray], hold: str | dict[str, str]) -> torch.Tensor:
        run = tc.Run(time=t, outputs={"x": t}, inputs=given, initial={"x": 0.0}, hold=hold)
        bound = settled(lag.bind(tc.Recording(runs=[run])), tensor(2.0)[None], torch.full((11,), 1e-9, dtype=F64))
        return bound.at(bound.x)(tensor(2.0))

    both = solved(inputs, {"valve": "zero", "room": "cubic"})
    parts = [solved(inputs | {other: 0 * t}, hold) for other, hold in (("room", "zero"), ("valve", "cubic"))]
    torch.testing.assert_close(both, parts[0] + parts[1], rtol=0, atol=1e-8)
    assert float((both - solved(inputs, "linear")).abs().max()) > 0.01


def test_a_padded_short_run_is_the_same_alone() -> None:
    short = run_of(np.array([1.0, 1.1, 1.7]), {"x": -0.5, "v": 2.0})
    both = tc.Recording(runs=[run_of(np.linspace(0.0, 9.0, 200), {"x": 1.0, "v": 0.0}), short])
    alone = oscillator().bind(tc.Recording(runs=[short]))
    together = oscillator().bind(both)
    found, expected = together.at(together.x)(tensor(4.0, 0.2))[-3:], alone.at(alone.x)(tensor(4.0, 0.2))
    torch.testing.assert_close(found, expected, rtol=1e-14, atol=1e-15)  # vector lanes may round differently


def test_batches_of_any_shape_and_of_none() -> None:
    bound = oscillator().bind(tc.Recording(runs=[run_of(np.linspace(0, 2, 7), {"x": 1.0, "v": 0.0})]))
    values = tensor(4.0, 0.2) + 0.1 * torch.rand(3, 5, 2, dtype=F64)
    evaluate = bound.at(bound.x)
    assert evaluate(values).shape == (3, 5, 7)
    assert evaluate(values[:0]).shape == (0, 5, 7)
    torch.testing.assert_close(evaluate(values)[2, 1], evaluate(values[2, 1]), rtol=1e-13, atol=1e-14)
    leaf = values.clone().requires_grad_(True)
    (together,) = torch.autograd.grad(evaluate(leaf).square().sum(), leaf)
    one = values[2, 1].clone().requires_grad_(True)
    (alone,) = torch.autograd.grad(evaluate(one).square().sum(), one)
    torch.testing.assert_close(together[2, 1], alone, rtol=1e-12, atol=1e-12)


def test_float32_values_give_float32_outputs_and_gradients() -> None:
    bound = oscillator().bind(tc.Recording(runs=[run_of(np.linspace(0, 2, 7), {"x": 1.0, "v": 0.0})]))
    leaf = torch.tensor([4.0, 0.2], requires_grad=True)
    y = bound.at(bound.x)(leaf)
    (slope,) = torch.autograd.grad(y.sum(), leaf)
    assert y.dtype == slope.dtype == torch.float32
    assert bound.at(bound.x)(tensor(4.0, 0.2)).numpy() == pytest.approx(y.detach().numpy(), abs=1e-6)


def test_steps_are_halved_until_the_solution_settles() -> None:
    recording = tc.Recording(runs=[run_of(np.linspace(0, 8, 60), {"x": 1.0, "v": 0.0})])
    coarse = oscillator().bind(recording)
    point = tensor(30.0, 0.1)[None]
    allowed = torch.full((60,), 1e-4, dtype=F64)
    fine = settled(coarse, point, allowed)
    assert fine.num_steps > coarse.num_steps
    finest = fine.refined(4)
    errors = [(b.at(b.x)(point) - finest.at(finest.x)(point)).abs().max() for b in (coarse, fine)]
    assert errors[0] > 1e-4
    assert errors[1] < 1.1e-4
    assert settled(oscillator(max_step=0.3).bind(recording), point, 1e-12 * allowed).num_steps < 200


def test_shorter_steps_where_they_err(star: tc.ODESimulator) -> None:
    """Two eccentric orbits: nearly all of the error comes from the passages close to the star."""
    e = 0.9
    t = np.linspace(0, 4 * np.pi, 201)
    anomaly = t.copy()
    for _ in range(100):  # Kepler's equation
        anomaly = anomaly - (anomaly - e * np.sin(anomaly) - t) / (1 - e * np.cos(anomaly))
    exact = np.concatenate([np.cos(anomaly) - e, math.sqrt(1 - e * e) * np.sin(anomaly)])
    start = {"x": 1 - e, "y": 0.0, "vx": 0.0, "vy": math.sqrt((1 + e) / (1 - e))}
    run = run_of(t, start, x=exact[:201], y=exact[201:])
    bound = star.bind(tc.Recording(runs=[run]))
    values = tensor(1.0)
    steps = bound.refined(8)
    for _ in range(4):
        states = steps.solve(values[None])
        error = float((steps.outputs_of(values[None], states)[0] - torch.as_tensor(exact)).abs().max())
        if error < 1e-4:
            break
        steps = focused(steps, values, states, 2 * error / 1e-4)
    assert error < 1e-4
    even = bound.refined(math.ceil(2 * steps.num_steps / bound.num_steps))
    assert even.num_steps > 1.9 * steps.num_steps
    worse = (even.outputs_of(values[None], even.solve(values[None]))[0] - torch.as_tensor(exact)).abs().max()
    assert float(worse) > error
    # A term added keeps them, another recording has its own.
    nothing = tc.Term("push", equation="vx", rate=lambda t, s, p, u: p["a"], parameters=[tc.Parameter("a")])
    assert extend(steps, [nothing]).num_steps == steps.num_steps
    assert steps.refined(2).num_steps == 2 * steps.num_steps
    other = steps.bind(tc.Recording(runs=[run]))
    error = (other.outputs_of(values[None], other.solve(values[None]))[0] - torch.as_tensor(exact)).abs().max()
    assert float(error) < 0.01


def test_a_stiff_model_is_refined_or_told_apart_clearly() -> None:
    fast = tc.ODESimulator(
        lambda t, s, p, u: {"c": -p["k"] * (s["c"] - torch.cos(t))}, {"c": None}, [tc.Parameter("k", initial=900.0)]
    )
    t = np.linspace(0, 3, 20)
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"c": np.cos(t)}, initial={"c": 1.0})])
    bound = fast.bind(recording)
    point, allowed = tensor(900.0)[None], torch.full((20,), 1e-5, dtype=F64)
    exact = solve_ivp(lambda t, s: -900 * (s - np.cos(t)), (0, 3), [1.0], "Radau", t, rtol=1e-9, atol=1e-11).y[0]
    assert np.abs(bound.at(bound.x)(point)[0].numpy() - exact).max() > 1e3  # the coarse steps are unstable
    found = settled(bound, point, allowed)
    assert np.abs(found.at(found.x)(point)[0].numpy() - exact).max() < 2e-5

    switching = tc.ODESimulator(
        lambda t, s, p, u: {"c": p["k"] * torch.sign(torch.sin(9.0 * t)).expand(s["c"].shape)},
        {"c": None},
        [tc.Parameter("k")],
    )
    with pytest.raises(SimulatorError, match=r"settle when time steps are halved.*smooth it"):
        settled(switching.bind(recording), tensor(1.0)[None], 0.1 * allowed)


def test_a_solution_that_blows_up_is_infinite_and_raises_nothing() -> None:
    model = tc.ODESimulator(
        lambda t, s, p, u: {"c": p["a"] * s["c"] ** 3}, {"c": None}, [tc.Parameter("a")]
    )
    t = np.linspace(0, 3, 10)
    bound = model.bind(tc.Recording(runs=[tc.Run(time=t, outputs={"c": t}, initial={"c": 1.0})]))
    values = torch.tensor([[-1.0], [10.0]], dtype=F64)
    y = bound.at(bound.x)(values)
    assert bool(torch.isfinite(y[0]).all())
    assert y[1, -1] == math.inf
    assert not bool(y.isnan().any())
    leaf = values.clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(bound.at(bound.x)(leaf)[:, 1].sum(), leaf)
    assert bool(torch.isfinite(slope[0]).all())  # the good trajectory keeps its derivative
    warm = bound.solve(values)
    assert torch.equal(bound.steps.solve(values, warm)[0], warm)


# --- observation -----------------------------------------------------------------------------------------


def test_observe_functions_see_time_states_parameters_and_inputs() -> None:
    t = np.linspace(0, 2, 9)
    model = oscillator(
        observe={"energy": lambda t, s, p, u: 0.5 * s["v"] ** 2 + 0.5 * p["k"] * s["x"] ** 2,
                 "mixed": lambda t, s, p, u: t * s["x"] + u["f"],
                 "still": lambda t, s, p, u: 3.0}
    )  # fmt: skip
    run = run_of(t, {"x": 1.0, "v": 0.3}, energy=t, mixed=t, still=t)
    bound = model.bind(tc.Recording(runs=[run]))
    fine = bound.refined(8)
    energy, mixed, still = fine.at(fine.x)(tensor(4.0, 0.2)).numpy().reshape(3, 9)
    x, v = truth(run, (1.0, 0.3), 4.0, 0.2)
    assert energy == pytest.approx(0.5 * v**2 + 2.0 * x**2, abs=1e-6)
    assert mixed == pytest.approx(t * x + drive(t), abs=1e-6)
    assert np.all(still == 3.0)
    assert fine.at(fine.x, ["mixed"])(tensor(4.0, 0.2)).numpy() == pytest.approx(mixed, abs=1e-14)


def test_outputs_that_a_run_lacks_and_missing_samples_are_simulated_all_the_same() -> None:
    t = np.linspace(0, 2, 9)
    x = np.ones(9)
    x[[0, 4]] = np.nan
    recording = tc.Recording(
        runs=[run_of(t, {"x": 1.0}, x=x, v=np.ones(9)), run_of(t, {"x": 1.0}, v=np.full(9, 2.0))], missing=True
    )
    bound = oscillator(observe=("v", "x")).bind(recording)
    assert bound.initial_names == ["v(0)[0]", "v(0)[1]"]
    assert [p.initial for p in bound.parameters[-2:]] == [1.0, 2.0]
    y = bound.at(bound.x)(tensor(4.0, 0.2, 1.0, 2.0))
    assert y.shape == (36,)
    assert bool(torch.isfinite(y).all())
    assert recording.outputs == ("x", "v")
    assert y[0] == 1.0
    assert y[18] == 1.0
    assert y[27] == 2.0


def test_the_first_guess_of_an_initial_state_is_the_first_sample_that_is_not_missing() -> None:
    t = np.linspace(0, 2, 5)
    recording = tc.Recording(runs=[run_of(t, {}, x=np.array([np.nan, 7.0, 1.0, 1.0, 1.0]))], missing=True)
    bound = oscillator(observe=("x",)).bind(recording)
    assert {p.name: p.initial for p in bound.parameters} == {"k": 4.0, "c": 0.2, "x(0)": 7.0, "v(0)": None}
    assert [p.unit for p in bound.parameters[2:]] == ["m", "m/s"]


def test_an_output_is_a_state_only_as_it_is() -> None:
    model = tc.ODESimulator(
        lambda t, s, p, u: {"angle": s["rate"], "rate": -p["k"] * s["angle"]},
        {"angle": "rad", "rate": "rad/s"},
        [tc.Parameter("k", low=0.0, initial=4.0)],
        observe={
            "angle": lambda t, s, p, u: 57.2958 * s["angle"],  # converted: no first guess in rad
            "gyroscope": lambda t, s, p, u: s["rate"],  # the state under another name
            "energy": lambda t, s, p, u: s["rate"] ** 2 + p["k"] * s["angle"] ** 2,
        },
    )
    assert model.reads == {"gyroscope": "rate"}
    assert tc.terms.extend(model, tc.terms.sensor(outputs=("gyroscope",))[:1]).reads == model.reads
    t = np.linspace(0, 3, 20)
    run = tc.Run(time=t, outputs={"angle": 28.6 * np.cos(t), "gyroscope": 0.1 - np.sin(t)})
    bound = model.bind(tc.Recording(runs=[run]))
    assert {p.name: p.initial for p in bound.parameters} == {"k": 4.0, "angle(0)": None, "rate(0)": 0.1}


def test_a_state_observed_in_another_unit_is_calibrated_like_itself() -> None:
    t = torch.linspace(0, 5, 50, dtype=torch.float64)
    found = []
    for scale in (1.0, 1000.0):
        model = tc.ODESimulator(
            lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - 8 * s["x"] ** 3},
            {"x": "m", "v": "m/s"},
            [tc.Parameter("k", initial=4.0)],
            observe={"x": lambda t, s, p, u, scale=scale: scale * s["x"]},
        )
        known = model.bind(tc.Recording(runs=[tc.Run(time=t, outputs={"x": t}, initial={"x": 0.5, "v": 0.0})]))
        x = known.at(known.x)(torch.tensor([4.2], dtype=torch.float64))
        x = x + scale * 0.002 * torch.randn(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        recording = tc.Recording(runs=[tc.Run(time=t, outputs={"x": x})])
        found.append(tc.diagnose(model, recording, [], seed=0, progress=False).base.estimates)
    for one, other in zip(*found, strict=True):
        assert other.value == pytest.approx(one.value, abs=1e-3 * one.sd)


# --- parameters, runs and initial states -----------------------------------------------------------------


def per_run_model() -> tc.ODESimulator:
    """Every kind of number that can be free: shared, per run, initial, hidden initial from a function, log scale."""
    return tc.ODESimulator(
        lambda t, s, p, u: {
            "x": -p["k"] * s["x"] + p["g"] * u["f"] + 0.3 * s["z"],
            "z": (s["x"] - s["z"]) / p["tau"],
            "w": -0.1 * s["w"] * s["x"],
        },
        {"x": "m", "z": None, "w": None},
        [tc.Parameter("g", per_run=True), tc.Parameter("k"), tc.Parameter("tau", transform="log", initial=0.5)],
        observe={"x": lambda t, s, p, u: s["x"], "y": lambda t, s, p, u: p["g"] * s["w"] + s["z"] * t},
        initial={"z": lambda s, p: s["x"] * p["tau"] + p["g"], "w": "x"},
    )


def two_runs() -> tc.Recording:
    t, r = np.linspace(0, 2, 8), np.array([0.5, 0.6, 1.4])
    return tc.Recording(
        runs=[
            tc.Run(time=t, outputs={"x": t, "y": t}, inputs={"f": np.sin(t)}, initial={"x": 0.7}),
            tc.Run(time=r, outputs={"x": r, "y": r}, inputs={"f": np.cos(r)}, hold="cubic"),
        ]
    )


def test_names_of_what_is_free() -> None:
    bound = per_run_model().bind(two_runs())
    assert bound.names == ("g[0]", "g[1]", "k", "tau", "x(0)[1]")
    assert bound.initial_names == ["x(0)[1]"]
    assert bound.nuisance == ("g[0]", "g[1]", "x(0)[1]")
    single = per_run_model().bind(tc.Recording(runs=[two_runs().runs[1]]))
    assert single.names == ("g", "k", "tau", "x(0)")
    assert single.nuisance == ("x(0)",)


def test_each_run_has_its_own_parameter() -> None:
    bound = per_run_model().bind(two_runs())
    base = tensor(1.0, 2.0, 0.8, 0.5, 0.3)
    moved = base + tensor(0.0, 0.5, 0.0, 0.0, 0.0)
    change = (bound.at(bound.x)(moved) - bound.at(bound.x)(base)).abs().reshape(2, 11)
    assert bool((change[:, :8] == 0).all())
    assert bool((change[:, 8:].amax(-1) > 0).all())


def differences(bound: Trajectories, values: Tensor, step: float = 1e-6) -> Tensor:
    """∂y/∂λ by central differences of the step-by-step solution."""
    shift = step * torch.eye(len(values), dtype=F64)
    with torch.no_grad():
        evaluate = bound.at(bound.x)
        return ((evaluate(values + shift) - evaluate(values - shift)) / (2 * step)).T


@pytest.mark.parametrize("subdivide", [1, 3])
def test_sensitivities_of_everything_agree_with_differences(subdivide: int) -> None:
    bound = per_run_model().bind(two_runs()).refined(subdivide)
    values = tensor(1.0, 2.0, 0.8, 0.5, 0.3)
    found = bound.linearise(bound.x, torch.stack([values, 1.1 * values]))
    for row, point in enumerate([values, 1.1 * values]):
        expected = differences(bound, point)
        torch.testing.assert_close(found.jacobian[row], expected, rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(found.y[row], bound.at(bound.x)(point), rtol=1e-13, atol=1e-14)
    assert bool((found.jacobian[0].abs().amax(0) > 1e-3).all())  # no column is trivial


@pytest.mark.parametrize("count", [1, 2, 7, 16])
def test_a_recurrence_in_blocks_is_that_step_by_step(count: int) -> None:
    generator = torch.Generator().manual_seed(0)
    flow = torch.randn(2, 3, count, 4, 4, dtype=F64, generator=generator)
    forcing = torch.randn(2, 3, count, 4, 2, dtype=F64, generator=generator)
    x, expected = torch.zeros(2, 3, 4, 2, dtype=F64), []
    for k in range(count):
        x = flow[:, :, k] @ x + forcing[:, :, k]
        expected.append(x)
    torch.testing.assert_close(recur(flow, forcing), torch.stack(expected, dim=2), rtol=1e-10, atol=1e-10)


def test_chosen_columns_and_outputs_are_parts_of_the_whole() -> None:
    bound = per_run_model().bind(two_runs())
    values = tensor(1.0, 2.0, 0.8, 0.5, 0.3)[None]
    whole = bound.linearise(bound.x, values)
    part = bound.linearise(bound.x, values, ["y"], [4, 1])
    torch.testing.assert_close(part.jacobian, whole.jacobian[:, 11:, [4, 1]], rtol=1e-13, atol=1e-14)
    none = bound.linearise(bound.x, values, columns=[])
    assert none.jacobian.shape == (1, 22, 0)


def test_gradients_by_autograd_pass_gradcheck() -> None:
    bound = per_run_model().bind(two_runs())
    values = torch.stack([tensor(1.0, 2.0, 0.8, 0.5, 0.3), tensor(0.5, 1.0, 1.2, 0.9, -0.4)]).requires_grad_(True)
    torch.autograd.gradcheck(bound.at(bound.x), values, eps=1e-6, atol=1e-7, rtol=1e-5)


def test_an_initial_value_may_depend_on_what_an_input_is_when_a_run_begins() -> None:
    model = tc.ODESimulator(
        lambda t, s, p, u: {"T": s["W"] - s["T"], "W": p["k"] * (u["out"] - s["W"])},
        ["T", "W"], [tc.Parameter("k"), tc.Parameter("a")],
        observe=("T",), initial={"W": lambda s, p, u: u["out"] + p["a"] * (s["T"] - u["out"])},
    )  # fmt: skip
    wall = tc.Term(
        "wall", rates={"T": lambda t, s, p, u: -p["c"] * (s["T"] - s["Z"]), "Z": lambda t, s, p, u: s["T"] - s["Z"]},
        states={"Z": None}, initial={"Z": lambda s, p, u: p["d"] * u["out"]},
        parameters=[tc.Parameter("c"), tc.Parameter("d", low=0.0, high=1.0)],
    )  # fmt: skip
    t = np.linspace(1.0, 3.0, 9)
    recording = tc.Recording(
        runs=[tc.Run(time=t, outputs={"T": t}, inputs={"out": 3.0 + t}, hold=hold) for hold in ("linear", "zero")]
        + [tc.Run(time=t + 1, outputs={"T": t}, inputs={"out": np.cos(t)}, initial={"T": 2.0})]
    )
    bound = tc.terms.extend(model, [wall]).bind(recording)
    assert bound.names == ("k", "a", "wall.c", "wall.d", "T(0)[0]", "T(0)[1]")
    values = tensor(0.3, 0.25, 0.7, 0.5, 6.0, 8.0)
    out, first = tensor(4.0, 4.0, float(np.cos(1.0))), tensor(6.0, 8.0, 2.0)
    expected = torch.stack([first, out + 0.25 * (first - out), 0.5 * out], dim=-1)
    torch.testing.assert_close(bound.layout.start(values[None])[0], expected, rtol=1e-14, atol=0)
    found = bound.linearise(bound.x, values[None]).jacobian[0]
    torch.testing.assert_close(found, differences(bound, values), rtol=1e-6, atol=1e-8)


def test_an_instrument_that_lags_begins_at_an_output_that_depends_on_an_input() -> None:
    model = tc.ODESimulator(
        lambda t, s, p, u: {"v": u["i"] - p["k"] * s["v"]}, ["v"], [tc.Parameter("k")],
        observe={"w": lambda t, s, p, u: s["v"] + 0.5 * u["i"]},
    )  # fmt: skip
    lag = next(
        term for term in tc.terms.sensor({"w": lambda t, s, p, u: s["v"] + 0.5 * u["i"]}) if term.name == "lag of w"
    )
    t = np.linspace(0.0, 2.0, 9)
    run = tc.Run(time=t, outputs={"w": t}, inputs={"i": 3.0 + t}, initial={"v": 1.0})
    bound = tc.terms.extend(model, [lag]).bind(tc.Recording(runs=[run]))
    assert bound.layout.start(tensor(0.3, 1.0, 0.7, 0.1)[None]).tolist() == [[[1.0, 2.6]]]  # a tenth of 1


def test_a_function_of_an_initial_value_takes_inputs_only_where_it_asks_for_them() -> None:
    assert takes_inputs(lambda s, p, u: 0.0)
    assert not takes_inputs(lambda s, p: 0.0)
    assert not takes_inputs(lambda s, p, late=1.0: 0.0)  # a number that a loop has left it
    assert not takes_inputs(lambda *given: 0.0)
    assert not takes_inputs(max)


def test_sensitivities_of_a_term_with_a_hidden_state_and_a_sensor() -> None:
    terms = [
        tc.Term(
            "memory", equation="v", rate=lambda t, s, p, u: -p["a"] * s["m"],
            rates={"m": lambda t, s, p, u: (s["x"] - s["m"]) / p["tau"]},
            states={"m": None}, initial={"m": lambda s, p: s["x"] * p["tau"]},
            parameters=[tc.Parameter("a"), tc.Parameter("tau", low=0.1, high=5.0)],
        ),
        tc.Term("offset", outputs={"x": lambda t, s, p, u, y: y * (1 + p["gain"]) + p["k"] * p["b"]},
                parameters=[tc.Parameter("gain"), tc.Parameter("b")]),
    ]  # fmt: skip
    model = tc.terms.extend(oscillator(observe=("x",)), terms)
    bound = model.bind(tc.Recording(runs=[run_of(np.linspace(0, 3, 12), {"x": 1.0})]))
    assert bound.names == ("k", "c", "memory.a", "memory.tau", "offset.gain", "offset.b", "v(0)")
    values = tensor(4.0, 0.2, 0.7, 0.6, 0.1, 0.05, 0.3)
    found = bound.linearise(bound.x, values[None]).jacobian[0]
    torch.testing.assert_close(found, differences(bound, values), rtol=1e-6, atol=1e-8)


def test_many_rows_are_cut_into_pieces_that_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    bound = per_run_model().bind(two_runs())
    values = tensor(1.0, 2.0, 0.8, 0.5, 0.3) * (1 + 0.1 * torch.rand(7, 5, dtype=F64))
    whole, y = bound.linearise(bound.x, values), bound.at(bound.x)(values)
    monkeypatch.setattr("torchcal.simulators.trajectories.POINTS", 200)
    monkeypatch.setattr("torchcal.simulators.trajectories.NUMBERS", 700)
    pieces = bound.linearise(bound.x, values)
    torch.testing.assert_close(pieces.jacobian, whole.jacobian, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(pieces.y, whole.y, rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(bound.at(bound.x)(values), y, rtol=1e-8, atol=1e-9)


# --- Newton's method on whole trajectories ---------------------------------------------------------------


def test_a_warm_start_gives_the_stepwise_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    bound = oscillator().bind(tc.Recording(runs=[run_of(np.linspace(0, 10, 80), {"x": 1.0})]))
    near, there = tensor(4.0, 0.2, 0.1)[None], tensor(4.1, 0.25, 0.2)[None]
    warm, right = bound.steps._march(near), bound.steps._march(there)
    cold = bound.linearise(bound.x, there)
    monkeypatch.setattr(type(bound.steps), "_march", lambda self, values: pytest.fail("Newton's method did not settle"))
    hot = bound.linearise(bound.x, there, warm=Solution(warm))
    torch.testing.assert_close(hot.warm.states, right, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(hot.jacobian, cold.jacobian, rtol=1e-6, atol=1e-7)


def test_a_solution_predicts_its_neighbours_to_first_order() -> None:
    bound = oscillator().bind(tc.Recording(runs=[run_of(np.linspace(0, 10, 80), {"x": 1.0})]))
    point, way = tensor(4.0, 0.2, 0.1)[None], tensor(1.0, -0.1, 0.3)[None]
    for columns in (None, [2, 0, 1]):
        warm = bound.linearise(bound.x, point, columns=columns).warm
        off = [float((warm.near(point + h * way) - bound.solve(point + h * way)).abs().max()) for h in (0.04, 0.02)]
        assert off[0] / off[1] == pytest.approx(4, rel=0.1)
    there = point + 0.04 * way
    torch.testing.assert_close(bound.linearise(bound.x, there, columns=[0], warm=warm).y, bound.at(bound.x)(there))


def test_solutions_are_parted_and_joined() -> None:
    bound = oscillator().bind(tc.Recording(runs=[run_of(np.linspace(0, 10, 80), {"x": 1.0})]))
    points = tensor(4.0, 0.2, 0.1) * torch.linspace(0.9, 1.1, 3, dtype=F64)[:, None]
    warm = bound.linearise(bound.x, points).warm
    swapped = warm.updated(torch.tensor([True, False, True]), warm.rows(torch.tensor([2, 0])))
    expected = bound.linearise(bound.x, points[[2, 1, 0]]).warm
    for name in ("values", "states", "tangents"):
        assert torch.equal(getattr(swapped, name), getattr(expected, name))
    assert torch.equal(warm.rows(torch.tensor([1])).repeated(2).near(points[[1, 1]]), warm.states[[1, 1]])


def test_derivatives_from_a_warm_start_are_exact_where_a_state_is_small() -> None:
    """ln A of a decay: where A has all but gone, a correction of a thousandth of the largest A is one of all of it."""
    t = np.linspace(0, 20, 41)
    decay = tc.ODESimulator(
        lambda t, s, p, u: {"A": -p["k"] * s["A"]}, ["A"], [tc.Parameter("k")],
        observe={"lnA": lambda t, s, p, u: s["A"].clamp_min(1e-300).log()},
    )  # fmt: skip
    bound = decay.bind(tc.Recording(runs=[tc.Run(time=t, outputs={"lnA": t}, initial={"A": 1.0})]))
    warm = bound.linearise(bound.x, tensor(1.0)[None]).warm
    cold = bound.linearise(bound.x, tensor(1.05)[None])
    hot = bound.linearise(bound.x, tensor(1.05)[None], warm=warm)
    torch.testing.assert_close(hot.y, cold.y, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(hot.jacobian, cold.jacobian, rtol=1e-4, atol=1e-6)


def test_a_prediction_that_leaves_the_range_of_the_rates_is_not_used() -> None:
    t = np.linspace(0, 8, 41)
    fed = tc.ODESimulator(
        lambda t, s, p, u: {"A": -p["k"] * s["A"], "B": p["c"] * s["A"].sqrt() - s["B"]}, ["A", "B"],
        [tc.Parameter("k"), tc.Parameter("c")],
    )  # fmt: skip
    bound = fed.bind(tc.Recording(runs=[tc.Run(time=t, outputs={"B": t}, initial={"A": 1.0, "B": 0.0})]))
    warm = bound.linearise(bound.x, tensor(1.0, 1.0)[None]).warm
    there = tensor(1.3, 1.0)[None]
    assert float(warm.near(there).min()) < 0
    found = bound.linearise(bound.x, there, warm=warm, march=False)
    torch.testing.assert_close(found.y, bound.linearise(bound.x, there).y, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("guess", [1e3, math.nan, math.inf])
def test_newton_from_a_bad_guess_falls_back_to_steps(guess: float) -> None:
    bound = oscillator().bind(tc.Recording(runs=[run_of(np.linspace(0, 10, 80), {"x": 1.0})]))
    point = tensor(4.0, 0.2, 0.1)[None]
    right = bound.steps._march(point)
    generator = torch.Generator().manual_seed(0)
    bad = guess * torch.randn(right.shape, generator=generator, dtype=F64)
    for warm in (bad, bad[:, :, :-1].expand(2, -1, -1, -1)):  # the second is of another batch, and not looked at
        torch.testing.assert_close(bound.steps.solve(point, warm)[0], right, rtol=1e-8, atol=1e-8)
    found = bound.linearise(bound.x, torch.cat([point, point]), warm=Solution(torch.cat([right, bad])))
    torch.testing.assert_close(found.warm.states, torch.cat([right, right]), rtol=1e-8, atol=1e-8)


def swinging(t, s, p, u):
    return {"x": s["v"], "v": -p["k"] * torch.sin(s["x"]) - p["c"] * s["v"].abs() * s["v"]}


def relaxing(t, s, p, u):  # stiff at the beginning, then slow
    return {"x": -p["k"] * s["x"] * s["x"] + 1e-4 * s["v"], "v": p["c"] * (s["x"] - s["v"]).clamp_min(-0.1)}


def bursting(t, s, p, u):
    return {"x": p["k"] * s["x"] * s["x"], "v": p["c"] * s["x"].clamp_max(1e6)}


def hunting(t, s, p, u):
    return {"x": p["k"] * s["x"] * (1 - s["v"]), "v": p["c"] * s["v"] * (s["x"] - 1)}


def regrowing(t, s, p, u):  # killed until t = 18
    rate = torch.where(torch.as_tensor(t, dtype=F64) < 18, -p["k"], p["k"])
    return {"x": rate * s["x"] * (1 - s["x"]), "v": p["c"] * s["x"]}


@pytest.mark.parametrize(
    ("rates", "initial", "values"),
    [
        (hunting, {"x": 20.0, "v": 2.0}, [(1.0, 1.0), (0.5, 0.7)]),  # what has decayed to 1e-7 grows again
        (regrowing, {"x": 0.5, "v": 0.0}, [(1.0, 1.0)]),
        (swinging, {"x": 2.5, "v": 0.0}, [(9.0, 0.01), (4.0, 0.3)]),
        (swinging, {"x": 0.0, "v": 0.0}, [(9.0, 0.01)]),  # at rest for good
        (relaxing, {"x": 20.0, "v": 1e-9}, [(0.5, 0.2), (0.01, 0.0)]),
        (bursting, {"x": 1.0, "v": 0.0}, [(0.01, 0.2), (0.05, 0.1)]),  # the second is infinite at t = 20
    ],
)
def test_spans_give_what_single_steps_give(rates, initial, values, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = tc.ODESimulator(
        rates, {"x": None, "v": None}, [tc.Parameter("k"), tc.Parameter("c")], observe=("x",), max_step=0.05
    )
    short = run_of(np.linspace(0, 7, 30), initial)
    bound = simulator.bind(tc.Recording(runs=[run_of(np.linspace(0, 40, 200), initial), short]))
    point = tensor(*values)
    passes = []
    newton = steps.close_gaps
    monkeypatch.setattr(
        steps, "close_gaps", lambda *args, **kwargs: passes.append(args[0].grid.num_steps) or newton(*args, **kwargs)
    )
    found = bound.solve(point)
    single = bound.steps._one_by_one(point, bound.layout.start(point))
    right = torch.where(torch.isfinite(single), single, torch.full_like(single, math.inf))
    near = right.abs() < 1e6  # beyond, on the way to infinity, every step multiplies the last digit
    size = torch.where(near, right, torch.zeros_like(right)).abs().amax((1, 2), keepdim=True)
    assert max(passes) > 100 or rates is hunting  # most of it is not solved step by step
    assert bool((torch.isfinite(found).all(-1) == torch.isfinite(right).all(-1)).all())
    gap = torch.where(near & torch.isfinite(found), found - right, torch.zeros_like(right)).abs()
    assert bool((gap <= 1e-8 * size).all())


def test_without_steps_what_newton_does_not_reach_is_infinite() -> None:
    bound = oscillator().bind(tc.Recording(runs=[run_of(np.linspace(0, 10, 80), {"x": 1.0})]))
    point = tensor(4.0, 0.2, 0.1).expand(2, -1)
    warm = bound.steps._march(point)
    warm[1] = math.nan
    found = bound.linearise(bound.x, point, warm=Solution(warm), march=False)
    assert bool(torch.isfinite(found.y[0]).all())
    assert bool((found.warm.states[1] == math.inf).all())


# --- errors ----------------------------------------------------------------------------------------------


def short_recording(**outputs: np.ndarray) -> tc.Recording:
    return tc.Recording(runs=[run_of(np.linspace(0, 2, 7), {"x": 1.0, "v": 0.0}, **outputs)])


def bad_rates(rates) -> tc.ODESimulator:
    return tc.ODESimulator(rates, {"x": None, "v": None}, [tc.Parameter("k")], observe=("x",))


@pytest.mark.parametrize(
    ("rates", "message"),
    [
        (lambda t, s, p, u: {"x": s["v"]}, r"rates of \['x', 'v'\] as a dict. Got \['x'\]"),
        (lambda t, s, p, u: s["v"], "rates of .* as a dict. Got Tensor"),
        (lambda t, s, p, u: {"x": s["v"], "v": p["q"] * s["x"]}, r"It raised KeyError: 'q'.*\(k (=|from) [12]"),
        (lambda t, s, p, u: {"x": s["v"], "v": u["g"]},
         r"It raised KeyError: 'g'.*no 'g' among states \['x', 'v'\], parameters \['k'.*Run\(inputs=\.\.\.\)"),
        (lambda t, s, p, u: {"x": s["v"], "v": torch.ones(5, 7)}, r"rate of 'v' of shape .* \(write it elementwise"),
        (lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * (1.0 if t > 1 else 2.0)}, "It raised RuntimeError"),
        (lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"].mean()}, "in a batch|at many times at once"),
        (lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"].mean(-1, keepdim=True)}, "in a batch|at many times"),
    ],
)
def test_rates_that_cannot_be_used_are_told_at_once(rates, message: str) -> None:
    bound = bad_rates(rates).bind(short_recording())
    tries = torch.linspace(1.0, 2.0, 4, dtype=F64)[:, None]
    with pytest.raises(SimulatorError, match=message):
        bound.check(bound.x, tries)


def test_a_name_that_an_output_asks_for_in_vain_is_told_with_what_there_is() -> None:
    model = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"]}, {"x": None, "v": None}, [tc.Parameter("k")],
        observe={"x": lambda t, s, p, u: s["x"] + u["g"]},
    )  # fmt: skip
    bound = model.bind(short_recording())
    there = r"no 'g' among states \['x', 'v'\], .*Run\(inputs="
    with pytest.raises(SimulatorError, match=f"output 'x'.*KeyError: 'g'.*{there}"):
        bound.at(bound.x)(torch.ones(len(bound.names), dtype=F64))


def test_good_rates_pass_the_check() -> None:
    bound = oscillator().bind(tc.Recording(runs=[run_of(np.linspace(0, 2, 7), {"x": 1.0})]))
    assert bound.check(bound.x, tensor(4.0, 0.2, 0.0).expand(4, -1)) == 7


def test_what_an_ode_simulator_refuses() -> None:
    rates, k = (lambda t, s, p, u: {"x": -p["k"] * s["x"]}), [tc.Parameter("k")]
    with pytest.raises(DomainError, match=r"rates as a function f\(t, s, p, u\)"):
        tc.ODESimulator(3.0, {"x": None}, k)
    for states in ("x", {}, {"": None}, [3]):
        with pytest.raises(DomainError, match="states as a dict"):
            tc.ODESimulator(rates, states, k)
    for observe in (("z",), "z"):
        with pytest.raises(DomainError, match=r"observed states among \['x'\]"):
            tc.ODESimulator(rates, ["x"], k, observe=observe)
    with pytest.raises(DomainError, match="at least one observed state"):
        tc.ODESimulator(rates, ["x"], k, observe=())
    with pytest.raises(DomainError, match=r"observe as \{output: function"):
        tc.ODESimulator(rates, ["x"], k, observe={"x": 1.0})
    for step in (0.0, math.nan, "a", True, [0.1]):
        with pytest.raises(DomainError, match="max_step as a number > 0"):
            tc.ODESimulator(rates, ["x"], k, max_step=step)
    with pytest.raises(DomainError, match="states as a dict"):
        tc.ODESimulator(rates, 3, k)
    with pytest.raises(DomainError, match="initial as a dict"):
        tc.ODESimulator(rates, ["x"], k, initial=[2.0])
    with pytest.raises(DomainError, match="observed states among"):
        tc.ODESimulator(rates, ["x"], k, observe=3)
    with pytest.raises(DomainError, match="initial values of states"):
        tc.ODESimulator(rates, ["x"], k, initial={"z": 0.0})
    for value in ("z", "x", [1.0], True, math.nan, math.inf):
        with pytest.raises(DomainError, match=r"initial value of 'x' as a .*number, another state's name or a"):
            tc.ODESimulator(rates, ["x"], k, initial={"x": value})
    for value in (2, np.float32(2), np.array(2), torch.tensor(2.0)):
        assert tc.ODESimulator(rates, ["x"], k, initial={"x": value}).initial == {"x": 2.0}
    with pytest.raises(DomainError, match="at least one parameter"):
        tc.ODESimulator(rates, ["x"], [])
    with pytest.raises(SimulatorError, match=r"recording in time for an ODESimulator.*bind"):
        tc.ODESimulator(rates, ["x"], k).at(tensor(1.0))


def test_what_cannot_be_bound() -> None:
    model = oscillator(observe=("x",))
    with pytest.raises(RecordingError, match=r"recording in time.*Got a static recording"):
        model.bind(tc.Recording(x=[0.0, 1.0], y=[0.0, 1.0]))
    with pytest.raises(RecordingError, match="Got list"):
        model.bind([1.0])
    with pytest.raises(SimulatorError, match=r"outputs among \['x'\]. Got \['y'\]"):
        model.bind(short_recording(y=np.zeros(7)))
    t = np.linspace(0, 1, 5)
    with pytest.raises(RecordingError, match=r"initial values of states .* Got \['z'\]"):
        model.bind(tc.Recording(runs=[run_of(t, {"z": 1.0})]))
    with pytest.raises(DomainError, match="2,000,000 steps"):
        oscillator(max_step=1e-9).bind(short_recording())
    bound = model.bind(short_recording())
    for x in (bound.x["time"], {"time": bound.x["time"][:3], "run": bound.x["run"][:3]}, {"time": bound.x["time"] + 1}):
        with pytest.raises(DomainError, match="the simulator was bound to"):
            bound.at(x)
    lost = tc.ODESimulator(
        lambda t, s, p, u: {"x": -p["k"] * s["x"], "z": s["x"]}, ["x", "z"], [tc.Parameter("k")],
        initial={"z": lambda s, p: s["q"]}, observe=("x",),
    )  # fmt: skip
    late = lost.bind(tc.Recording(runs=[tc.Run(time=t, outputs={"x": t})]))
    with pytest.raises(SimulatorError, match=r"initial value of 'z' from those of .*KeyError: 'q'"):
        late.at(late.x)(tensor(1.0, 1.0))


def test_binding_again_keeps_or_changes_the_recording() -> None:
    first, second = short_recording(), tc.Recording(runs=[run_of(np.linspace(0, 4, 9), {"x": 0.0})])
    bound = oscillator(observe=("x",)).bind(first).refined(4)
    assert bound.bind(first) is bound
    other = bound.bind(second)
    assert other.recording is second
    assert other.subdivide == 4
    assert other.names == ("k", "c", "v(0)")


@pytest.mark.parametrize(
    ("wrong", "got"),
    [(None, "NoneType"), ("a", "str"), (1j, "complex"), (torch.tensor(1j), "torch.complex64"), ([None], "list"),
     ([torch.ones(1, requires_grad=True)], "list")],
)
def test_what_is_no_real_number_is_told_of_the_function_that_gave_it(wrong, got) -> None:
    def decay(**changes) -> tc.ODESimulator:
        rates = changes.pop("rates", lambda t, s, p, u: {"x": -p["k"] * s["x"]})
        return tc.ODESimulator(rates, ["x"], [tc.Parameter("k")], **changes)

    run = run_of(np.linspace(0, 2, 7), {"x": 1.0})
    unknown = tc.Run(run.time, {"x": torch.ones(7, dtype=F64)})
    for name, simulator, recorded in [
        ("the rate of 'x'", decay(rates=lambda t, s, p, u: {"x": wrong}), run),
        ("the output 'x'", decay(observe={"x": lambda t, s, p, u: wrong}), run),
        ("the initial value of 'x'", decay(initial={"x": lambda s, p: wrong}), unknown),
    ]:
        bound = simulator.bind(tc.Recording(runs=[recorded]))
        with pytest.raises(SimulatorError, match=f"Expected {name} as a tensor of real numbers. Got {got} "):
            bound.check(bound.x, tensor(1.0).expand(4, -1))


@pytest.mark.parametrize("tenth", [0.1, Fraction(1, 10), Decimal("0.1"), np.float64(0.1)])
def test_plain_numbers_are_taken_with_all_their_digits(tenth) -> None:
    simulator = tc.ODESimulator(
        lambda t, s, p, u: {"x": tenth, "y": p["k"]}, ["x", "y"], [tc.Parameter("k")], initial={"x": 0.0, "y": 0.0},
        observe={"x": lambda t, s, p, u: s["x"], "c": lambda t, s, p, u: tenth},
    )  # fmt: skip
    t = torch.linspace(0, 2, 7, dtype=F64)
    bound = simulator.bind(tc.Recording(runs=[tc.Run(t, {"x": t, "c": t})]))
    torch.testing.assert_close(
        bound.at(bound.x)(tensor(1.0)), torch.cat([0.1 * t, torch.full((7,), 0.1, dtype=F64)]), rtol=1e-14, atol=1e-15
    )


def test_a_parameter_may_be_called_as_an_initial_state_is() -> None:
    t = torch.linspace(0, 2, 20, dtype=torch.float64)
    model = tc.ODESimulator(lambda t, s, p, u: {"x": -p["x(0)"] * s["x"]}, ["x"], [tc.Parameter("x(0)", initial=0.7)])
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"x": a * torch.exp(-0.7 * t)}) for a in (2.0, 3.0)])
    bound, values = model.bind(recording), torch.tensor([[0.7, 2.0, 3.0]], dtype=torch.float64)
    slopes = bound.linearise(recording.x, values, recording.outputs, [0, 1, 2]).jacobian[0]
    expected = torch.zeros(2, 20, 3, dtype=torch.float64)
    for run, begin in enumerate((2.0, 3.0)):
        expected[run, :, 0], expected[run, :, run + 1] = -begin * t * torch.exp(-0.7 * t), torch.exp(-0.7 * t)
    torch.testing.assert_close(slopes, expected.flatten(0, 1), rtol=1e-6, atol=1e-8)
