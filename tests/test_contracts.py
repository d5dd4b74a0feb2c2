"""What docstrings promise and hard cases broke: units, signs, scales, names and files, each once."""

import math
import os
import stat
import warnings

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.errors import DomainError, SimulatorError
from torchcal.files import replacing
from torchcal.results import AdditiveCalibration
from torchcal.terms import extend

T = torch.linspace(0, 5, 11, dtype=torch.float64)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def still(observe, parameters, **options) -> tc.ODESimulator:
    return tc.ODESimulator(lambda t, s, p, u: {"x": 0 * s["x"]}, {"x": "m"}, parameters, observe=observe, **options)


# --- predictions elsewhere -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def decay() -> tc.results.Calibration:
    pint = pytest.importorskip("pint")
    time = np.linspace(0, 60, 13)
    run = tc.Run(pint.Quantity(time, "s"), outputs={"x": np.exp(-0.02 * time)}, initial={"x": 1.0})
    model = tc.ODESimulator(lambda t, s, p, u: {"x": -p["k"] * s["x"]}, {"x": None}, [tc.Parameter("k", low=0.0)])
    likelihood = tc.likelihoods.ABC(epsilon=0.01)
    return tc.calibrate(model, tc.Recording(runs=[run]), likelihood=likelihood, num_samples=0)


def test_other_times_and_runs_are_converted_to_the_units_of_the_recording(decay):
    pint = pytest.importorskip("pint")
    expected = decay.predict([0.0, 30.0, 60.0]).mean
    minutes = pint.Quantity(np.array([0.0, 0.5, 1.0]), "min")
    torch.testing.assert_close(decay.predict(minutes).mean, expected)
    run = tc.Run(minutes, outputs={"x": [0.0, 0.0, 0.0]}, initial={"x": 1.0})
    torch.testing.assert_close(decay.predict(run).mean, expected, rtol=1e-6, atol=1e-8)


def test_times_a_rounding_beside_a_sample_do_not_bend_a_cubic_input():
    time = torch.arange(21, dtype=torch.float64) / 10
    u = 5 + torch.sin(7 * time)
    x = 2.5 * (1 - torch.exp(-2 * time))
    run = tc.Run(time, outputs={"x": x}, inputs={"u": u}, initial={"x": 0.0}, hold="cubic")
    model = tc.ODESimulator(lambda t, s, p, u: {"x": u["u"] - p["k"] * s["x"]}, {"x": None}, [tc.Parameter("k")])
    fit = tc.calibrate(model, tc.Recording(runs=[run]), likelihood=tc.likelihoods.ABC(epsilon=0.1), num_samples=0)
    exact = fit.predict(time).map.mean
    torch.testing.assert_close(fit.predict(0.1 * torch.arange(21, dtype=torch.float64)).map.mean, exact)


def test_times_are_not_moved_to_samples_that_are_near_on_a_long_clock():
    time = 1.7e9 + torch.arange(40, dtype=torch.float64) / 1000
    run = tc.Run(time, outputs={"x": torch.exp(-40 * (time - time[0]))}, initial={"x": 1.0})
    model = tc.ODESimulator(lambda t, s, p, u: {"x": -p["k"] * s["x"]}, {"x": None}, [tc.Parameter("k", initial=40.0)])
    fit = tc.calibrate(model, tc.Recording(runs=[run]), likelihood=tc.likelihoods.ABC(epsilon=0.01), num_samples=0)
    wanted = time[10] + tensor(0.0, 2e-4, 4e-4)
    torch.testing.assert_close(fit.predict(wanted).map.mean, torch.exp(-40 * (wanted - time[0])), rtol=1e-4, atol=1e-4)


def test_outputs_of_other_runs_are_not_looked_at(decay):
    pint = pytest.importorskip("pint")
    run = tc.Run(
        pint.Quantity(np.array([0.0, 30.0]), "s"), outputs={"x": pint.Quantity(np.zeros(2), "kg")}, initial={"x": 1.0}
    )
    torch.testing.assert_close(decay.predict(run).mean, decay.predict([0.0, 30.0]).mean, rtol=1e-6, atol=1e-8)


def test_an_additive_calibration_is_loaded_with_its_own_simulator_alone(tmp_path):
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    other = tc.Simulator(lambda x, p: p["a"] - 50 * p["b"] * x, line.parameters)
    tc.calibrate_additive(line, tc.Recording(x=T, y=1 + T + torch.sin(9 * T)), num_samples=0).save(tmp_path / "a.nc")
    AdditiveCalibration.load(tmp_path / "a.nc", simulator=line)
    with pytest.raises(DomainError, match="the simulator that was calibrated"):
        AdditiveCalibration.load(tmp_path / "a.nc", simulator=other)


def test_numbers_of_other_packages_can_be_saved(tmp_path):
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    likelihood = tc.likelihoods.ABC(epsilon=np.float32(0.1))
    fit = tc.calibrate(
        line,
        tc.Recording(x=T, y=1 + T + 0.1 * T**2),
        fixed={"a": torch.tensor(1.0)},
        likelihood=likelihood,
        num_samples=0,
    )
    fit.save(tmp_path / "a.nc")
    assert tc.results.Calibration.load(tmp_path / "a.nc").settings["fixed"] == {"a": 1.0}


# --- outputs of different size ---------------------------------------------------------------------------


def test_each_output_has_an_sd_floor_of_its_own_whether_it_is_named_or_not():
    model = tc.Simulator(
        lambda x, p: {"P": 1e6 * (p["a"] + x), "v": 1e-4 * (p["a"] + 2 * x)}, [tc.Parameter("a", low=0.0, high=1.0)]
    )
    alpha = torch.zeros(2, dtype=torch.float64)
    free, named = (tc.NISP(model, tc.embeddings.Gaussian(), T, outputs=names)(alpha)[1] for names in (None, ("P", "v")))
    torch.testing.assert_close(free, named)
    assert float(free[-1]) < 1e-4


def test_another_function_has_an_sd_floor_of_its_own():
    model = tc.Simulator(lambda x, p: (p["a"] * x).exp(), [tc.Parameter("a", low=0.1, high=1.0)])
    propagate = tc.NISP(model, tc.embeddings.Gaussian(), T, sd_floor=1.0)
    assert propagate.at(T + 1).sd_floor == 1.0
    assert propagate.at(T, simulator=tc.Simulator(lambda x, p: 1e6 * p["a"] * x, model.parameters)).sd_floor is None


def test_variances_are_means_over_what_was_recorded():
    y = 1 + T + 0.3 * T**2
    y[6:] = math.nan
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    fit = tc.calibrate(line, tc.Recording(x=T, y=y, missing=True), num_samples=0)
    wanted = fit.predict().map.sd[:6].square().mean()
    assert fit.diagnostics.map_variance == pytest.approx(float(wanted), rel=1e-9)


# --- terms -----------------------------------------------------------------------------------------------


def sensor(name: str, signal) -> tc.Term:
    return next(term for term in tc.terms.sensor({"y": signal}) if term.name == name)


def test_an_instruments_own_amplitude_is_not_the_users_parameter_of_that_name():
    def signal(t, s, p, u):
        return p["a"] * s["x"]

    base = still({"y": signal}, [tc.Parameter("a", initial=2.0)], initial={"x": 1.0})
    recording = tc.Recording(runs=[tc.Run(time=T, outputs={"y": torch.full((11,), 2.0)})])
    bound = extend(base, [sensor("lag of y", signal)]).bind(recording)
    torch.testing.assert_close(
        bound.at(recording.x)(tensor(2.0, 0.5, 0.01, 0.0)), torch.full((11,), 2.0, dtype=torch.float64)
    )


def test_a_quantity_of_the_users_reads_the_users_parameters():
    """The large-angle term has a ``fraction`` of its own; with none of it nothing changes, whatever the user's is."""
    states = {"x": "m", "v": "m/s"}
    base = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["fraction"] * s["x"]}, states, [tc.Parameter("fraction", low=0.1)]
    )
    other = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"]}, states, [tc.Parameter("k", low=0.1)]
    )
    recording = tc.Recording(runs=[tc.Run(time=T, outputs={"x": torch.zeros(11)}, initial={"x": 1.0, "v": 0.0})])
    found = []
    for model, stiffness in ((base, lambda p: p["fraction"]), (other, lambda p: p["k"])):
        terms = tc.terms.mechanics(position="x", velocity="v", stiffness=stiffness)
        sine = next(term for term in terms if term.name == "large-angle sine")
        found.append(extend(model, [sine]).bind(recording).at(recording.x)(tensor(3.0, 0.5)))
    torch.testing.assert_close(found[0], found[1])


def test_a_lag_of_an_output_that_depends_on_time_is_refused():
    def signal(t, s, p, u):
        return s["x"] + p["k"] * t

    base = still({"y": signal}, [tc.Parameter("k", initial=1.0)], initial={"x": 0.0})
    recording = tc.Recording(runs=[tc.Run(time=T + 100, outputs={"y": torch.ones(11)})])
    with pytest.raises(DomainError, match="from states, parameters and inputs"):
        extend(base, [sensor("lag of y", signal)]).bind(recording).at(recording.x)(tensor(0.01, 1.0, 2.0, 0.0))


@pytest.mark.slow
def test_an_upper_bound_is_no_neutral_value_however_small():
    size = 1e-9
    torch.manual_seed(0)
    time = torch.linspace(0, 10, 60, dtype=torch.float64)
    y = 0.4 * torch.exp(-0.5 * time) + 0.6 + 0.005 * torch.randn(60, dtype=torch.float64)
    base = tc.ODESimulator(
        lambda t, s, p, u: {"x": -p["k"] * s["x"]}, {"x": "mol"}, [tc.Parameter("k", low=0.0, initial=0.5)]
    )
    feed = tc.Term(
        "feed", equation="x", rate=lambda t, s, p, u: p["b"], parameters=[tc.Parameter("b", low=0.0, high=0.2 * size)]
    )
    recording = tc.Recording(runs=[tc.Run(time=time, outputs={"x": size * y}, initial={"x": size})])
    ranking = tc.diagnose(base, recording, [feed]).ranking
    row = next(row for row in ranking if row.terms == ("feed",) and row.region is None)
    assert "feed.b" in row.note
    assert row.note.startswith("at its bound")
    assert not row.physical


def test_terms_act_on_external_simulators_with_several_outputs():
    def function(x, p):
        return {"u": p["a"] * x, "v": p["a"] + x}

    offset = tc.Term("offset of u", outputs={"u": lambda x, p, y: y + p["b"]}, parameters=[tc.Parameter("b")])
    shift = tc.Term("drifts", shifts={"a": lambda x, p: p["m"] * x}, parameters=[tc.Parameter("m")])
    outside = tc.ExternalSimulator(function, [tc.Parameter("a")])
    inside = tc.Simulator(function, [tc.Parameter("a")])
    for term in (offset, shift):
        found, wanted = (extend(model, [term]).at(T, ["u", "v"])(tensor(2.0, 0.5)) for model in (outside, inside))
        torch.testing.assert_close(found, wanted)


# --- functions of others ---------------------------------------------------------------------------------


def test_the_step_of_a_difference_is_relative_to_the_parameter():
    log = tc.ExternalSimulator(lambda x, p: math.log(p["k"]) * x, [tc.Parameter("k", low=0.0)])
    k = tensor(1e-5).requires_grad_()
    log.at(tensor(1.0))(k).sum().backward()
    assert k.grad is not None
    assert float(k.grad) == pytest.approx(1e5, rel=1e-4)


@pytest.mark.parametrize("words", ["math domain error", "expected a positive input, got -1.0"])
def test_what_math_says_outside_its_domain_is_no_answer(words):
    def function(x, p):
        if p["a"] < 0:
            raise ValueError(words)
        return p["a"] * x

    found = tc.ExternalSimulator(function, [tc.Parameter("a")]).at(tensor(1.0))(tensor(-1.0, 2.0)[:, None])
    assert math.isnan(float(found[0]))
    assert float(found[1]) == 2.0


def test_what_a_user_expects_is_told_and_no_missing_answer():
    def function(x, p):
        if p["a"] < 0:
            raise ValueError("expected a positive area, got -1: check the input file")
        return p["a"] * x

    with pytest.raises(SimulatorError, match="check the input file"):
        tc.ExternalSimulator(function, [tc.Parameter("a")]).at(tensor(1.0))(tensor(-1.0, 2.0)[:, None])


def test_slopes_of_a_parameter_that_may_be_zero_hold_beside_it():
    line = tc.ExternalSimulator(lambda x, p: 300 + p["b"] * x, [tc.Parameter("b")])
    for value in (1e-12, 1e-8, 1e-3):
        b = tensor(value).requires_grad_()
        line.at(tensor(1.0))(b).sum().backward()
        assert b.grad is not None
        assert float(b.grad) == pytest.approx(1.0, rel=1e-6)


def test_the_evaluation_with_other_outputs_is_told_by_its_own_row():
    def function(x, p):
        if p["a"] < 0:
            raise ZeroDivisionError
        return {"u": 1.0} if p["a"] < 1.5 else {"v": 1.0}

    simulator = tc.ExternalSimulator(function, [tc.Parameter("a")])
    with pytest.raises(SimulatorError, match=r"in row \[0\.0, 2\.0\]"):
        simulator.at(tensor(0.0))(tensor(-3.0, 1.0, 2.0)[:, None])


def test_a_named_output_of_a_function_without_names_is_refused():
    with pytest.raises(SimulatorError, match=r"outputs \['T'\]. Got one without a name"):
        tc.build_surrogate(
            lambda x, p: p["a"] * x,
            conditions=(0, 1),
            parameters=[tc.Parameter("a", low=0, high=1)],
            order=2,
            outputs=["T"],
        )


def test_values_of_another_number_of_parameters_are_refused():
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    for values in (tensor(2.0), tensor(2.0, 3.0, 99.0)):
        with pytest.raises(tc.errors.ShapeError, match="a, b"):
            line.at(T)(values)


def test_integers_of_numpy_are_whole_numbers():
    two = np.int64(2)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")], degree=two)
    assert tc.embeddings.PolynomialChaos(order=two).order == 2
    assert tc.NISP(line, tc.embeddings.Gaussian(), T, rule=two, order=two).num_nodes == 4
    assert tc.likelihoods.Marginal(num_samples=two).num_samples == 2
    box = [tc.Parameter("a", low=0, high=1), tc.Parameter("b", low=0, high=1)]
    assert tc.build_surrogate(line, conditions=(0, 1), parameters=box, order=two).order == 2


def test_integers_of_numpy_are_seeds_and_counts(tmp_path):
    one, two, ten = (np.int64(number) for number in (1, 2, 10))
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a", low=0, high=2), tc.Parameter("b")])
    recording = tc.Recording(x=T, y=1 + T + 0.1 * T**2)
    for calibrate in (tc.calibrate, tc.calibrate_additive):
        found, same = (
            calibrate(line, recording, num_samples=0, num_starts=starts, seed=seed)
            for starts, seed in ((ten, one), (10, 1))
        )
        found.save(tmp_path / "a.nc")
        assert torch.equal(found.map.alpha, same.map.alpha)
        assert type(found.settings["seed"]) is int
    likelihood = tc.likelihoods.Marginal(num_samples=ten)
    assert type(likelihood.num_samples) is int
    fit = tc.calibrate(line, recording, num_samples=0)
    for draw in (fit.sample_outputs, fit.sample_parameters):
        assert torch.equal(draw(ten, kind="map", seed=one), draw(10, kind="map", seed=1))
    with pytest.raises(DomainError, match="seed"):
        fit.sample_outputs(3, kind="map", seed="one")
    box = [tc.Parameter("a", low=0, high=1), tc.Parameter("b", low=0, high=1)]
    surrogate = tc.build_surrogate(line, conditions=(0, 1), parameters=box, order=two, holdout=ten, seed=one)
    again = tc.PolynomialSurrogate(surrogate.coefficients, conditions=(0, 1), parameters=box, order=two)
    for one_of_them in (surrogate, again):
        one_of_them.save(tmp_path / "s.npz")
    assert surrogate.error.num == 10


@pytest.mark.parametrize(("fixed", "told"), [({"a": None}, "a finite number"), ({"a": -1.0}, "positive values")])
def test_diagnose_takes_the_fixed_values_that_calibrate_takes(fixed, told):
    model = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a", transform="log"), tc.Parameter("b")])
    with pytest.raises(DomainError, match=told):
        tc.diagnose(model, tc.Recording(x=T, y=1 + T), fixed=fixed)


def test_alike_parts_that_may_be_exchanged_are_no_ridge():
    x = torch.linspace(0, 4, 41, dtype=torch.float64)

    def function(x, p):
        return p["a1"] * (-p["k1"] * x).exp() + p["a2"] * (-p["k2"] * x).exp() + 1e-6 * p["c"] * torch.sin(5 * x)

    names = {"a1": 5.0, "k1": 6.0, "a2": 5.0, "k2": 6.0, "c": 1.0}
    model = tc.Simulator(function, [tc.Parameter(name, low=0.01, high=high) for name, high in names.items()])
    y = 2 * (-0.4 * x).exp() + (-3 * x).exp() + 1e-4 * torch.randn(41, dtype=torch.float64)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        tc.calibrate_additive(model, tc.Recording(x=x, y=y), num_samples=0)
    assert not [one for one in told if "only together" in str(one.message)]


# --- priors and files ------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_normal_prior_cut_far_from_its_mean_is_drawn_at_the_bound(side):
    model = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a", low=-1.0, high=1.0)])
    propagate = tc.NISP(model, tc.embeddings.PolynomialChaos(order=0), T)
    torch.manual_seed(0)
    draws = side * tc.priors.Normal(propagate, loc=1.5 * side, scale=0.05).sample((2000,))[:, 0]
    # Ten sd from the mean the tail is exponential, with a mean of σ²/0.5 beyond the bound, less σ²/0.5 · σ²/0.25.
    assert float((1 - draws).mean()) == pytest.approx(0.005 * (1 - 0.01), rel=4 / math.sqrt(2000))
    assert len(draws.unique()) > 1900


def test_a_private_file_stays_private(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    target.chmod(0o600)
    with replacing(target) as temporary:
        temporary.write_text("new")
    assert stat.S_IMODE(target.stat().st_mode) == 0o600
    with replacing(tmp_path / "b.txt") as temporary:
        temporary.write_text("new")
    os.umask(mask := os.umask(0o077))
    assert stat.S_IMODE((tmp_path / "b.txt").stat().st_mode) == 0o666 & ~mask
