"""Calibration of models in time: initial states as nuisance, step sizes, predictions elsewhere, files."""

import warnings
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

import torchcal as tc
from torchcal.errors import (
    ConvergenceWarning,
    DomainError,
    EmbeddingError,
    PropagationWarning,
    RecordingError,
    SimulatorError,
)
from torchcal.inference import estimate, tangent
from torchcal.inference.estimate import maximise
from torchcal.inference.fitting import least_squares
from torchcal.inference.newton import Minima
from torchcal.inference.setup import check_inputs, embedded_problem
from torchcal.plots import additive_fit as plot_additive_fit
from torchcal.plots import fit as plot_fit
from torchcal.priors import Flat
from torchcal.results import AdditiveCalibration, Calibration
from torchcal.simulators import Simulator, Trajectories
from torchcal.terms import extend

F64 = torch.float64
K, C, DRAG = 4.0, 0.3, 0.25


def body(**options) -> tc.ODESimulator:
    """A linear oscillator: what the recordings' drag is missing from."""
    return tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]},
        {"x": "m", "v": "m/s"},
        [tc.Parameter("k", unit="1/s^2", low=0.0, initial=3.0), tc.Parameter("c", unit="1/s", low=0.0, initial=0.1)],
        observe=("x",),
        **options,
    )


def drag() -> tc.Term:
    return tc.Term("drag", equation="v", rate=lambda t, s, p, u: -p["d"] * s["v"].abs() * s["v"],
                   parameters=[tc.Parameter("d", low=0.0)])  # fmt: skip


def simulate(t: np.ndarray, start: tuple[float, float], c: float = C, d: float = DRAG, k: float = K) -> np.ndarray:
    def rates(now: float, s: np.ndarray) -> list[float]:
        return [s[1], -k * s[0] - c * s[1] - d * s[1] * abs(s[1]) + np.interp(now, t, np.sin(1.3 * t))]

    return solve_ivp(rates, (t[0], t[-1]), start, t_eval=t, rtol=1e-8, atol=1e-9, max_step=0.05).y[0]


def run_of(t: np.ndarray, start: tuple[float, float], known: str = "x", noise: float = 0.0, **options: float) -> tc.Run:
    x = simulate(t, start, **options)
    x = x + noise * np.random.default_rng(len(t)).standard_normal(len(t))
    initial = {name: value for name, value in zip("xv", start, strict=True) if name in known}
    return tc.Run(time=t, outputs={"x": x}, inputs={"f": np.sin(1.3 * t)}, initial=initial)


@pytest.fixture(scope="module")
def recording() -> tc.Recording:
    return tc.Recording(runs=[run_of(np.linspace(0, 5, 50), (1.0, 0.5), noise=0.01)], noise=0.01, units={"x": "m"})


@pytest.fixture(scope="module")
def calibration(recording: tc.Recording) -> Calibration:
    return tc.calibrate(body(), recording, num_samples=0, seed=0)


# --- what is inferred, and what is embedded --------------------------------------------------------------


def test_the_truth_is_found_from_data_of_the_model_itself() -> None:
    t = np.linspace(0, 5, 60)
    runs = [run_of(t, (1.0, 0.5), "", 0.01, d=0.0), run_of(t[:30], (-0.7, 1.0), "x", 0.01, d=0.0)]
    found = tc.calibrate_additive(body(), tc.Recording(runs=runs), num_samples=0, seed=0)
    assert found.map.parameters == ("k", "c", "x(0)[0]", "v(0)[0]", "v(0)[1]")
    assert found.map.alpha_names == (*found.map.parameters, "ln sigma")
    # The sd of each estimate under this noise, from the tangents at the truth.
    truth = torch.tensor([K, C, 1.0, 0.5, 1.0], dtype=F64)
    bound = found.propagate.simulator
    jacobian = bound.linearise(bound.x, truth[None]).jacobian[0]
    sd = 0.01 * torch.linalg.inv(jacobian.T @ jacobian).diagonal().sqrt()
    assert float(((found.map.mean - truth) / sd).abs().max()) < 4.0  # 5 normal numbers: missed once in 3000 times
    assert float(found.map.alpha[-1].exp()) == pytest.approx(0.01, rel=4 / np.sqrt(2 * 85))


def test_initial_states_are_inferred_but_not_embedded(calibration: Calibration) -> None:
    assert calibration.map.parameters == ("k", "c", "v(0)")
    assert calibration.embedding.parameters == ("k", "c")
    assert calibration.propagate.pattern.embedded == ("k", "c")
    assert calibration.alpha_names == ("k[0]", "k[xi1]", "c[0]", "c[xi1]", "c[xi2]", "v(0)[0]")
    assert calibration.map.sd[2] == 0
    assert float(calibration.map.sd[:2].max()) > 0
    assert calibration.map.mean[2] == pytest.approx(0.5, abs=0.2)
    prediction = calibration.predict()
    assert prediction.sd[0] < 1e-12
    assert float(prediction.sd.max()) > 0.005
    error = (prediction.mean - calibration.recording.y).square().mean().sqrt()
    assert float(prediction.sd.square().mean().sqrt()) == pytest.approx(float(error), rel=0.6)  # as γ = 1 asks


def test_naming_an_initial_state_embeds_it(recording: tc.Recording) -> None:
    found = tc.calibrate(
        body(), recording, embedding=tc.embeddings.IndependentGaussian(parameters=("c", "v(0)")), num_samples=0,
        num_starts=8, seed=0,
    )  # fmt: skip
    assert found.propagate.pattern.embedded == ("c", "v(0)")
    assert found.map.parameters == ("k", "c", "v(0)")


def test_a_known_or_fixed_initial_state_is_no_parameter(recording: tc.Recording) -> None:
    start = (1.0, 0.5)
    known = tc.Recording(runs=[run_of(np.linspace(0, 5, 40), start, "xv")])
    assert tc.calibrate_additive(body(), known, num_samples=0, seed=0).map.parameters == ("k", "c")
    held = tc.calibrate_additive(body(), recording, fixed={"v(0)": 0.5, "k": 4.0}, num_samples=0, seed=0)
    assert held.map.parameters == ("c",)
    assert 0.3 < float(held.map.mean[0]) < 0.7


def test_per_run_parameters_are_inferred_but_not_embedded() -> None:
    model = tc.ODESimulator(
        lambda t, s, p, u: {"c": -p["k"] * (s["c"] - p["room"]) + 0.1 * s["c"] ** 2},
        {"c": "K"},
        [tc.Parameter("k", low=0.0, initial=1.0), tc.Parameter("room", unit="K", per_run=True)],
    )
    t = np.linspace(0, 3, 25)
    runs = [
        tc.Run(time=t, outputs={"c": room + (2.0 - room) * np.exp(-0.8 * t) + 0.02 * np.sin(5 * t)}, initial={"c": 2.0})
        for room in (0.0, 0.5)
    ]
    found = tc.calibrate(model, tc.Recording(runs=runs), num_samples=0, num_starts=8, seed=0)
    assert found.map.parameters == ("k", "room[0]", "room[1]")
    assert found.propagate.pattern.embedded == ("k",)
    assert float(found.map.mean[2] - found.map.mean[1]) == pytest.approx(0.5, abs=0.2)
    rooms = found.predict([0.0], function=lambda x, p: (p["room[1]"] - p["room[0]"]) * (1 + x))
    assert float(rooms.mean) == pytest.approx(float(found.map.mean[2] - found.map.mean[1]))
    one = tc.calibrate(model, tc.Recording(runs=runs[:1]), num_samples=0, num_starts=8, seed=0)
    assert one.propagate.pattern.embedded == ("k", "room")  # of one run, it is a parameter like any other


def test_a_per_run_parameter_is_fixed_in_every_run_by_its_name(tmp_path: Path) -> None:
    model = tc.ODESimulator(
        lambda t, s, p, u: {"c": -p["k"] * (s["c"] - p["room"])}, {"c": "K"},
        [tc.Parameter("k", low=0.0, initial=1.0), tc.Parameter("room", unit="K", per_run=True)],
    )  # fmt: skip
    t, rng = np.linspace(0, 3, 25), np.random.default_rng(0)
    runs = [
        tc.Run(time=t, outputs={"c": 0.2 + (2.0 - 0.2) * np.exp(-0.8 * t) + 0.02 * rng.standard_normal(25)},
               initial={"c": 2.0})
        for _ in range(2)
    ]  # fmt: skip
    recording = tc.Recording(runs=runs, noise=0.02)
    held = tc.calibrate(model, recording, fixed={"room": 0.2}, num_samples=0, num_starts=8, seed=0)
    assert held.map.parameters == ("k",)
    assert held.propagate.held == {"room[0]": 0.2, "room[1]": 0.2}
    held.save(tmp_path / "held.nc")
    again = tc.results.Calibration.load(tmp_path / "held.nc", simulator=model)
    torch.testing.assert_close(again.predict().mean, held.predict().mean)
    one = tc.calibrate(model, recording, fixed={"room": 0.2, "room[1]": 0.3}, num_samples=0, num_starts=8, seed=0)
    assert one.propagate.held == {"room[0]": 0.2, "room[1]": 0.3}
    d = tc.diagnose(model, recording, [], fixed={"room": 0.2}, seed=0, progress=False)
    assert d.verdict == "consistent"
    with pytest.raises(EmbeddingError, match="Check the spelling"):
        tc.calibrate(model, recording, fixed={"rooms": 0.2}, num_samples=0)


def test_a_dormant_parameter_stays_neutral(recording: tc.Recording) -> None:
    model = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - (p["c"] + p["c2"]) * s["v"] * p["one"] + u["f"]},
        {"x": "m", "v": "m/s"},
        [tc.Parameter("c2", neutral=0.0), tc.Parameter("k", initial=3.0), tc.Parameter("c", initial=0.1),
         tc.Parameter("one", neutral=1.0)],
        observe=("x",),
    )  # fmt: skip
    found = tc.calibrate_additive(model, recording, num_samples=0, seed=0)
    plain = tc.calibrate_additive(body(), recording, num_samples=0, seed=0)
    assert found.map.parameters == plain.map.parameters == ("k", "c", "v(0)")
    torch.testing.assert_close(found.map.mean, plain.map.mean, rtol=1e-5, atol=1e-5)


def test_nothing_left_to_embed_is_told(recording: tc.Recording) -> None:
    with pytest.raises(EmbeddingError, match=r"besides initial states .* Got \['v\(0\)'\] alone"):
        tc.calibrate(body(), recording, fixed={"k": 4.0, "c": 0.3}, num_samples=0)
    with pytest.raises(EmbeddingError, match="embedded parameters among the free ones"):
        tc.calibrate(body(), recording, embedding=tc.embeddings.Gaussian(parameters=("x(0)",)), num_samples=0)


def test_missing_samples_do_not_count() -> None:
    t = np.linspace(0, 5, 50)
    run = run_of(t, (1.0, 0.5), d=0.0)
    spoiled = run.outputs["x"].clone()
    spoiled[10:20] = torch.nan
    holes = tc.Recording(runs=[tc.Run(t, {"x": spoiled}, run.inputs, run.initial)], missing=True, noise=0.01)
    wild = run.outputs["x"].clone()
    wild[10:20] = 99.0
    masked = tc.Recording(runs=[tc.Run(t, {"x": wild}, run.inputs, run.initial)], noise=0.01).masked(
        np.arange(50) // 10 != 1
    )
    first, second = (tc.calibrate_additive(body(), data, num_samples=0, seed=0) for data in (holes, masked))
    assert first.map.mean.tolist() == pytest.approx([K, C, 0.5], abs=2e-3)
    assert second.map.mean.tolist() == pytest.approx(first.map.mean.tolist(), abs=1e-6)


# --- wrong combinations ----------------------------------------------------------------------------------


@pytest.mark.parametrize("calibrate", [tc.calibrate, tc.calibrate_additive])
def test_a_model_in_time_with_a_static_recording_and_the_reverse(calibrate, recording: tc.Recording) -> None:
    static = tc.Recording(x=[0.0, 1.0, 2.0, 3.0], y=[1.0, 0.5, 0.2, 0.1])
    for model in (body(), body().bind(recording)):
        with pytest.raises(RecordingError, match=r"recording in time.*Got a static recording"):
            calibrate(model, static)
    line = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")])
    with pytest.raises(SimulatorError, match=r"recording is one in time and the simulator static.*ODESimulator"):
        calibrate(line, recording)
    with pytest.raises(RecordingError, match=r"Expected a torchcal.Recording. Got list"):
        calibrate(body(), [1.0])
    with pytest.raises(SimulatorError, match=r"outputs among \['x'\]. Got \['y'\]"):
        calibrate(body(), tc.Recording(runs=[tc.Run([0.0, 1.0], {"y": [0.0, 1.0]}, {"f": [0.0, 0.0]})]))


def test_a_formula_of_time_is_a_static_simulator_on_a_recording_in_time() -> None:
    t = np.linspace(0, 3, 30)
    runs = [tc.Run(t, {"c": a * np.exp(-0.8 * t)}) for a in (1.0, 2.0)]
    formula = tc.Simulator(
        lambda x, p: (p["a"] + p["b"] * x["run"]) * torch.exp(-p["k"] * x["time"]),
        [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("k", initial=1.0)],
    )
    found = tc.calibrate(formula, tc.Recording(runs=runs, noise=0.01), num_samples=0, num_starts=8, seed=0)
    assert found.map.mean.tolist() == pytest.approx([1.0, 1.0, 0.8], abs=1e-3)
    new = {"time": torch.tensor([10.0], dtype=F64), "run": torch.tensor([1.0], dtype=F64)}
    assert float(found.predict(new).mean) == pytest.approx(2 * np.exp(-8.0), rel=0.01)


# --- steps and the search --------------------------------------------------------------------------------


def test_steps_are_chosen_by_themselves() -> None:
    t = np.linspace(0, 6, 25)
    run = run_of(t, (1.0, 0.5), "xv", k=60.0, d=0.0)
    model = body()
    coarse = model.bind(tc.Recording(runs=[run]))
    found = tc.calibrate_additive(model, tc.Recording(runs=[run]), num_samples=0, seed=0, fixed={"c": C})
    simulator = found.propagate.simulator
    assert isinstance(simulator, Trajectories)
    assert simulator.num_steps > coarse.num_steps
    assert found.settings["subdivide"] == simulator.subdivide > 1
    assert float(found.map.mean[0]) == pytest.approx(60.0, abs=2e-3)
    point = torch.tensor([float(found.map.mean[0]), C], dtype=F64)
    finer = simulator.refined(8)
    assert float((finer.at(finer.x)(point) - simulator.at(simulator.x)(point)).abs().max()) < 2e-4


def test_a_stiff_start_gets_implicit_steps_before_anything_else() -> None:
    model = tc.ODESimulator(
        lambda t, s, p, u: {"c": -p["k"] * (s["c"] - torch.cos(t))}, {"c": None},
        [tc.Parameter("k", low=1.0, initial=400.0)],
    )  # fmt: skip
    t = np.linspace(0, 3, 40)
    y = solve_ivp(lambda t, s: -300.0 * (s - np.cos(t)), (0, 3), [3.0], "Radau", t, rtol=1e-8, atol=1e-10).y[0]
    recording = tc.Recording(runs=[tc.Run(t, {"c": y}, initial={"c": 3.0})], noise=1e-3)
    bound, _ = check_inputs(model, recording, None)
    assert bound.implicit
    assert bound.num_steps < 10 * model.bind(recording).num_steps
    y0 = bound.at(bound.x)(torch.tensor([400.0], dtype=F64))
    assert float((y0 - torch.cos(bound.x["time"]))[1:].abs().max()) < 0.01


def test_the_maximum_is_that_of_the_plain_search(recording: tc.Recording) -> None:
    class Plain(Simulator):
        """The same model, but for the search a static one."""

        def __init__(self, bound: Trajectories) -> None:
            self.bound, self.parameters, self.degree = bound, bound.parameters, None

        def at(self, x, outputs=None):
            return self.bound.at(x, outputs)

    bound, _ = check_inputs(body(), recording, {"c": 0.5})
    fit = least_squares(bound, recording, {"c": 0.5}, seed=0)
    objectives, means = [], []
    for simulator in (fit.simulator, Plain(fit.simulator)):
        problem = embedded_problem(
            simulator, recording, tc.embeddings.Gaussian(parameters=("k",)), tc.likelihoods.ABC(), Flat, fit.scaling,
            fixed={"c": 0.5}, order=None, rule=5, device=None,
        )  # fmt: skip
        found = maximise(problem, fit.scaled, starts=None, num_starts=4, seed=0)
        objectives.append(found.objective)
        means.append(fit.scaling.physical(found.alpha[[0, 2]]))
    assert objectives[0] == pytest.approx(objectives[1], rel=1e-6)
    torch.testing.assert_close(means[0], means[1], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("apart", [pytest.param(0.0, marks=pytest.mark.slow), 1.0])
def test_starts_that_disagree_are_told_also_where_the_best_is_refined(
    monkeypatch: pytest.MonkeyPatch, apart: float
) -> None:
    recording = tc.Recording(runs=[run_of(np.linspace(0, 10, 80), (2.0, 0.5), noise=0.01)], noise=0.01)

    def search(*args: object, **options: object) -> Minima:
        found = tangent.search(*args, **options)
        values = found.values[:1] + apart * torch.arange(len(found.values), dtype=F64)
        return Minima(found.points, values, found.iterations)

    monkeypatch.setattr(estimate, "search", search)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tc.calibrate(body(), recording, fixed={"c": 0.5}, num_samples=0, num_starts=4, seed=0)
    told = [str(one.message) for one in caught if issubclass(one.category, ConvergenceWarning)]
    assert len(told) == (apart > 0)
    assert all(message.startswith("Only 1 of 4 starts reached the best objective") for message in told)


def test_several_likelihoods_and_embeddings(recording: tc.Recording) -> None:
    options = {"fixed": {"c": 0.5}, "num_samples": 0, "num_starts": 6, "seed": 0}
    marginal = tc.calibrate(body(), recording, likelihood="gaussian_marginal", **options)
    uniform = tc.calibrate(body(), recording, embedding=tc.embeddings.Uniform(), **options)
    plain = tc.calibrate(
        body(), recording, embedding=tc.embeddings.PolynomialChaos(order=0), likelihood="abc_mean", **options
    )
    for found in (marginal, uniform, plain):
        assert found.map.parameters == ("k", "v(0)")
        assert 3.5 < float(found.map.mean[0]) < 4.5
    assert marginal.map.sd[0] > 0
    assert uniform.map.sd[0] > 0
    assert plain.map.sd[0] == 0


# --- predictions -----------------------------------------------------------------------------------------


def test_prediction_at_the_data_and_at_other_times_agree(calibration: Calibration, recording: tc.Recording) -> None:
    at_data = calibration.predict()
    time, zeros = recording.time, torch.zeros(50, dtype=F64)
    order = torch.randperm(50)
    for x in (time, {"time": time}, {"time": time, "run": zeros}, recording, recording.masked(np.arange(50) < 9)):
        again = calibration.predict(x)
        torch.testing.assert_close(again.mean, at_data.mean, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(again.sd, at_data.sd, rtol=1e-4, atol=1e-6)
    mixed = calibration.predict(time[order])
    torch.testing.assert_close(mixed.mean, at_data.mean[order], rtol=1e-6, atol=1e-6)
    between = calibration.predict([0.123, 3.21])
    model = calibration.propagate.simulator
    k, c, v0 = calibration.map.mean.tolist()
    t = np.unique(np.append(recording.time.numpy(), [0.123, 3.21]))
    smooth = solve_ivp(
        lambda now, s: [s[1], -k * s[0] - c * s[1] + np.interp(now, recording.time, recording.runs[0].inputs["f"])],
        (0, 5), [1.0, v0], t_eval=t, rtol=1e-8, atol=1e-9, max_step=0.05,
    ).y[0]  # fmt: skip
    expected = smooth[np.searchsorted(t, [0.123, 3.21])]
    assert between.mean.numpy() == pytest.approx(expected, abs=0.02)  # the mean of f is not f of the mean
    assert model.recording is recording


def test_prediction_for_other_runs(calibration: Calibration) -> None:
    other = run_of(np.linspace(0, 8, 60), (-0.5, 1.0), "xv", d=DRAG)
    found = calibration.predict(other)
    assert found.x["time"].shape == found.mean.shape == (60,)
    error = (found.mean - other.outputs["x"]).abs().max()
    assert float(error) < 0.15 < float(other.outputs["x"].abs().max())
    both = calibration.predict([other, run_of(np.linspace(0, 2, 7), (0.3, 0.0), "xv")])
    torch.testing.assert_close(both.mean[:60], found.mean, rtol=1e-6, atol=1e-6)
    assert both.x["run"].tolist() == [0.0] * 60 + [1.0] * 7
    recorded = calibration.predict(tc.Recording(runs=[other]))
    torch.testing.assert_close(recorded.mean, found.mean, rtol=1e-8, atol=1e-8)


def test_predictions_that_cannot_be_made(calibration: Calibration) -> None:
    t = np.linspace(0, 2, 7)
    with pytest.raises(DomainError, match=r"Got \['v\(0\)'\] open \(give a Run its initial="):
        calibration.predict(run_of(t, (1.0, 0.0), "x"))
    with pytest.raises(DomainError, match=r"inputs \['f'\] in every run.*Got \[\] in run 0"):
        calibration.predict(tc.Run(t, {"x": t}, initial={"x": 0.0, "v": 0.0}))
    with pytest.raises(DomainError, match=r"within the run, from 0 to 5. Got 5.5"):
        calibration.predict([1.0, 5.5])
    with pytest.raises(DomainError, match="times from 0 on in run 0"):
        calibration.predict([-0.1, 1.0])
    with pytest.raises(DomainError, match=r"runs as whole numbers from 0 to 0. Got 1"):
        calibration.predict({"time": [1.0], "run": [1.0]})
    with pytest.raises(DomainError, match="Got a static recording"):
        calibration.predict(tc.Recording(x=[0.0, 1.0], y=[0.0, 1.0]))
    with pytest.raises(DomainError, match="as a dict with"):
        calibration.predict({"t": [1.0]})


def test_what_a_run_has_for_itself_is_known_of_the_runs_that_were_calibrated_alone() -> None:
    t = torch.linspace(0, 4, 30, dtype=F64)
    decay = tc.ODESimulator(
        rates=lambda t, s, p, u: {"z": -p["k"] * s["z"]},
        states=["z"],
        parameters=[tc.Parameter("k", low=0.0, high=3.0, per_run=True)],
    )

    def run(k: float, start: float | None = None) -> tc.Run:
        noise = 0.01 * torch.randn(30, generator=torch.Generator().manual_seed(int(10 * k)), dtype=F64)
        return tc.Run(t, {"z": torch.exp(-k * t) + noise}, initial={} if start is None else {"z": start})

    runs = [run(0.5, 1.0), run(2.0)]
    found = tc.calibrate_additive(decay, tc.Recording(runs=runs), num_samples=0, seed=0, progress=False)
    at_data = found.predict().map.mean
    for r in (0, 1):
        again = found.predict(runs[r]).map.mean
        torch.testing.assert_close(again, at_data[30 * r :][:30], rtol=1e-6, atol=1e-6)
    swapped = found.predict(runs[::-1]).map.mean
    torch.testing.assert_close(swapped, torch.cat([at_data[30:], at_data[:30]]), rtol=1e-6, atol=1e-6)
    with pytest.raises(DomainError, match=r"Got \['k\[0\]', 'k\[1\]'"):
        found.predict([run(1.0, 1.0), run(1.1)])
    with pytest.raises(DomainError, match=r"Got \['k'\] open"):  # the same times and initial state, other data
        found.predict(run(1.0, 1.0))
    # A run that was held out is itself, whatever another of the same times was; one that shares no datum is none.
    kept = tc.Recording(runs=[run(0.5), run(2.0)]).masked(torch.arange(60) >= 30)
    held = tc.calibrate_additive(
        decay, kept, num_samples=0, seed=0, fixed={"k[0]": 1.0, "z(0)[0]": 5.0}, progress=False
    )
    at_data = held.predict().map.mean
    for same in (kept, tc.Recording(runs=[run(0.5), run(2.0)])):
        torch.testing.assert_close(held.predict(same).map.mean, at_data, rtol=1e-6, atol=1e-6)
    with pytest.raises(DomainError, match=r"Got \['k', 'z\(0\)'\] open"):
        held.predict(run(0.7))
    single = tc.calibrate_additive(decay, tc.Recording(runs=runs[:1]), num_samples=0, seed=0, progress=False)
    with pytest.raises(DomainError, match=r"Got \['k'\] open"):
        single.predict(run(1.0, 1.0))


def test_what_counts_from_the_recordings_first_sample_does_so_in_a_later_run() -> None:
    t = torch.linspace(0, 10, 41, dtype=F64)

    def truth(t: torch.Tensor) -> torch.Tensor:
        return 2 * torch.exp(-0.3 * t) + 0.05 * t

    decay = tc.ODESimulator(
        rates=lambda t, s, p, u: {"z": -p["k"] * s["z"]},
        states=["z"],
        parameters=[tc.Parameter("k", low=0.0, high=3.0)],
    )
    drifting = extend(decay, [term for term in tc.terms.sensor("z") if term.name == "drift of z"])
    noise = 0.005 * torch.randn(41, generator=torch.Generator().manual_seed(0), dtype=F64)
    recording = tc.Recording(runs=[tc.Run(100 + t, {"z": truth(t) + noise}, initial={"z": 2.0})])
    found = tc.calibrate_additive(drifting, recording, num_samples=0, seed=0, progress=False)
    later = torch.linspace(10, 20, 5, dtype=F64)
    start = {"z": 2 * float(torch.exp(torch.tensor(-3.0)))}
    predicted = found.predict(tc.Run(100 + later, {"z": later}, initial=start)).map.mean
    torch.testing.assert_close(predicted, truth(later), rtol=0, atol=0.01)


def test_a_forecast_beyond_the_data_where_no_input_is_needed() -> None:
    t = np.linspace(0, 2, 20)
    model = tc.ODESimulator(lambda t, s, p, u: {"c": -p["k"] * s["c"]}, ["c"], [tc.Parameter("k", initial=0.5)])
    data = tc.Recording(runs=[tc.Run(t, {"c": a * np.exp(-0.8 * t)}, initial={"c": a}) for a in (1.0, 3.0)], noise=1e-3)
    found = tc.calibrate_additive(model, data, num_samples=0, seed=0)
    late = found.predict({"time": [4.0, 9.0, 4.0], "run": [1.0, 0.0, 0.0]}).push_forward.mean
    assert late.tolist() == pytest.approx([3 * np.exp(-3.2), np.exp(-7.2), np.exp(-3.2)], rel=1e-3)


def test_a_density_that_reaches_where_the_model_has_no_solution_is_told() -> None:
    model = tc.ODESimulator(lambda t, s, p, u: {"c": p["a"] * s["c"] ** 3}, ["c"], [tc.Parameter("a", initial=-0.5)])
    t = np.linspace(0, 2, 15)
    y = 1 / np.sqrt(1 + 0.2 * t) + 0.04 * np.sin(4 * t)
    data = tc.Recording(runs=[tc.Run(t, {"c": y}, initial={"c": 1.0})])
    found = tc.calibrate(model, data, num_samples=0, num_starts=6, seed=0)
    mean, sd = float(found.map.mean[0]), float(found.map.sd[0])
    assert mean + 2 * sd < 0 < 0.01 < mean + 6 * sd  # some of seven nodes are where c grows beyond all bounds
    with pytest.warns(PropagationWarning, match="blows up at the outermost of"):
        prediction = found.predict(tc.Run(t, {"c": t}, initial={"c": 10.0}))
    assert bool(torch.isfinite(prediction.mean).all() & torch.isfinite(prediction.sd).all())


def test_another_quantity_of_the_same_parameters(calibration: Calibration) -> None:
    period = calibration.predict(torch.tensor([1.0], dtype=F64), function=lambda x, p: 6.283185 * x / p["k"].sqrt())
    assert float(period.mean) == pytest.approx(3.14, abs=0.1)
    assert float(period.sd) > 0


# --- files and figures -----------------------------------------------------------------------------------


def test_a_calibration_in_time_survives_a_file(calibration: Calibration, tmp_path: Path) -> None:
    calibration.save(tmp_path / "c.nc")
    bare = Calibration.load(tmp_path / "c.nc")
    assert bare.recording.runs is not None
    assert len(bare.recording.runs) == 1
    run, original = bare.recording.runs[0], calibration.recording.runs[0]
    assert torch.equal(run.time, original.time)
    assert torch.equal(run.inputs["f"], original.inputs["f"])
    assert run.initial == original.initial
    assert run.hold == original.hold
    assert bare.recording.units == {"x": "m"}
    assert torch.equal(bare.predict().mean, calibration.predict().mean)
    back = Calibration.load(tmp_path / "c.nc", simulator=body())
    assert back.propagate.simulator.subdivide == calibration.propagate.simulator.subdivide
    torch.testing.assert_close(back.predict([1.23]).mean, calibration.predict([1.23]).mean, rtol=1e-10, atol=1e-12)
    with pytest.raises(EmbeddingError, match="the simulator of this calibration"):
        Calibration.load(tmp_path / "c.nc", simulator=tc.terms.extend(body(), [drag()]))


def test_runs_of_all_kinds_survive_a_file(tmp_path: Path) -> None:
    t = np.linspace(0, 2, 15)
    gaps = np.exp(-t)
    gaps[3] = np.nan
    model = tc.ODESimulator(
        lambda t, s, p, u: {"c": -p["k"] * s["c"] + 0.0 * u["in/flow"], "d": -s["d"]}, {"c": None, "d": None},
        [tc.Parameter("k", initial=0.8)],
    )  # fmt: skip
    data = tc.Recording(
        runs=[
            tc.Run(t, {"c": gaps, "d": np.exp(-t)}, {"in/flow": t}, {"c": 1.0, "d": 1.0}, "zero"),
            tc.Run(t[:5], {"c": np.exp(-t[:5])}, {"in/flow": -t[:5]}, {"c": 1.0}, {"in/flow": "cubic"}),
        ],
        missing=True, units={"c": "mol", "time": "s", "in/flow": "L/s"}, noise=0.01,
    )  # fmt: skip
    found = tc.calibrate_additive(model, data, num_samples=0, seed=0, fixed={"d(0)[1]": 1.0})
    found.save(tmp_path / "a.nc")
    back = AdditiveCalibration.load(tmp_path / "a.nc", simulator=model)
    again = back.recording
    assert torch.equal(again.y.nan_to_num(nan=9.0), data.y.nan_to_num(nan=9.0))
    assert torch.equal(again.noise, data.noise)
    assert again.outputs == data.outputs
    assert again.units == data.units
    for run, old in zip(again.runs, data.runs, strict=True):
        assert (list(run.outputs), run.hold, run.initial, run.units) == (
            list(old.outputs), old.hold, old.initial, old.units
        )  # fmt: skip
        assert torch.equal(run.inputs["in/flow"], old.inputs["in/flow"])
    torch.testing.assert_close(back.predict().map.mean, found.predict().map.mean, rtol=1e-12, atol=1e-12)


def test_a_model_in_time_with_another_constant_is_not_the_one_that_was_calibrated(tmp_path: Path) -> None:
    t = torch.linspace(0, 2, 20, dtype=F64)

    def model(c: float, **options: Any) -> tc.ODESimulator:
        rates = lambda t, s, p, u: {"z": -c * p["k"] * s["z"]}  # noqa: E731
        return tc.ODESimulator(rates, ["z"], [tc.Parameter("k", low=0.0, high=3.0)], **options)

    data = tc.Recording(runs=[tc.Run(t, {"z": torch.exp(-t) + 0.01 * torch.sin(40 * t)}, initial={"z": 1.0})])
    for calibrate, kind in ((tc.calibrate, Calibration), (tc.calibrate_additive, AdditiveCalibration)):
        calibrate(model(1.0), data, num_samples=0, seed=0).save(tmp_path / "o.nc")
        kind.load(tmp_path / "o.nc", simulator=model(1.0))
        kind.load(tmp_path / "o.nc", simulator=model(1.0, stiff=True))  # other steps
        with pytest.raises(DomainError, match="predicts something else"):
            kind.load(tmp_path / "o.nc", simulator=model(2.0))
        static = tc.Simulator(lambda x, p: p["k"] * x, [tc.Parameter("k", low=0.0, high=3.0)])
        with pytest.raises(SimulatorError, match=r"a static Simulator, which cannot predict it.*Give the ODES"):
            kind.load(tmp_path / "o.nc", simulator=static)


def test_a_static_result_and_a_model_in_time_do_not_mix(tmp_path: Path) -> None:
    line = tc.Simulator(lambda x, p: p["k"] * x, [tc.Parameter("k")])
    static = tc.calibrate(line, tc.Recording(x=[0.0, 1.0, 2.0], y=[0.0, 1.1, 1.8]), num_samples=0, num_starts=4)
    static.save(tmp_path / "s.nc")
    with pytest.raises(RecordingError, match="static simulator for a static recording"):
        Calibration.load(tmp_path / "s.nc", simulator=body())


def test_the_figure_of_a_fit_is_drawn_against_time(calibration: Calibration, recording: tc.Recording) -> None:
    ax = plot_fit(calibration.predict(), recording)
    assert ax.get_xlabel() == "time"
    assert ax.get_ylabel() == "x [m]"
    curve = max((line.get_xdata() for line in ax.get_lines()), key=len)
    assert np.allclose(curve, recording.time.numpy())
    plt.close("all")
    two = tc.Recording(runs=[recording.runs[0], run_of(np.linspace(0, 2, 9), (1.0, 0.5))], units={"x": "m"})
    found = tc.calibrate_additive(body(), two, num_samples=0, seed=0)
    with pytest.raises(DomainError, match="one value of 'run' along the curve"):
        plot_additive_fit(found.predict(), two)
    ax = plot_additive_fit(found.predict(), two, where={"run": 1})
    assert ax.get_xlabel() == "time"
    assert ax.get_xlim()[1] < 2.2


# --- the whole way ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_missing_physics_added_shrinks_the_model_error(recording: tc.Recording, calibration: Calibration) -> None:
    improved = tc.terms.extend(body(), [drag()])
    after = tc.calibrate(improved, recording, num_samples=0, seed=0)
    assert after.map.parameters == ("k", "c", "drag.d", "v(0)")
    assert after.propagate.pattern.embedded == ("k", "c", "drag.d")
    before_sd, after_sd = (c.predict().sd_model_error.square().mean().sqrt() for c in (calibration, after))
    assert float(after_sd) < 0.7 * float(before_sd)
    best = tc.calibrate_additive(improved, recording, num_samples=0, seed=0)
    truth = torch.tensor([K, C, DRAG, 0.5], dtype=F64)
    bound = best.propagate.simulator
    jacobian = bound.linearise(bound.x, truth[None]).jacobian[0]
    sd = 0.01 * torch.linalg.inv(jacobian.T @ jacobian).diagonal().sqrt()
    assert float(((best.map.mean - truth) / sd).abs().max()) < 4.0
    future = tc.Run(*_future())  # predicted from the mean alone: a spread of d reaches values that feed the swing
    plain = tc.calibrate_additive(body(), recording, num_samples=0, seed=0)
    errors = [(c.predict(future).map.mean - future.outputs["x"]).square().mean().sqrt() for c in (plain, best)]
    assert float(errors[1]) < 0.3 * float(errors[0])


def _future() -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray], dict[str, float]]:
    """A wider swing than the one that was calibrated on."""
    t = np.linspace(0, 5, 40)
    return t, {"x": simulate(t, (2.0, 0.0))}, {"f": np.sin(1.3 * t)}, {"x": 2.0, "v": 0.0}


@pytest.mark.filterwarnings("ignore::torchcal.errors.ConvergenceWarning")  # of few draws; the bounds allow for it
def test_draws_from_the_posterior_of_a_model_in_time() -> None:
    t = np.linspace(0, 2, 12)
    model = tc.ODESimulator(lambda t, s, p, u: {"c": -p["k"] * s["c"]}, ["c"], [tc.Parameter("k", initial=0.5)])
    noise = 0.02 * np.random.default_rng(1).standard_normal(12)
    data = tc.Recording(runs=[tc.Run(t, {"c": np.exp(-0.8 * t) + noise}, initial={"c": 1.0})], noise=0.02)
    found = tc.calibrate_additive(model, data, num_samples=60, num_chains=2, num_warmup=40, seed=0)
    draws: Tensor = found.parameters[:, 0]
    jacobian = t * np.exp(-0.8 * t)
    sd = 0.02 / np.sqrt((jacobian**2).sum())
    assert float(draws.mean()) == pytest.approx(0.8, abs=4 * sd)
    assert 0.5 * sd < float(draws.std()) < 3 * sd
