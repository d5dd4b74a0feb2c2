"""Results: reading, printing, freezing, saving and loading, export."""

import dataclasses
import json
import math
import os
import random
import subprocess
import sys
import textwrap
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.errors import DomainError, MissingDependencyError, TorchcalError
from torchcal.results import AdditiveCalibration, Calibration
from torchcal.results.storage import CHECKSUM

xarray = pytest.importorskip("xarray")

N = 6
T = torch.linspace(0.0, 1.0, N, dtype=torch.float64)
SHORT = {"num_samples": 12, "num_warmup": 10, "num_chains": 2, "num_starts": 4}


def model(x, p):
    return {"u": p["a"] + p["b"] * x["t"] + p["m"], "v<w>": p["b"] * x["t"] ** 2 * p["s"]}


SIMULATOR = tc.Simulator(
    model,
    [
        tc.Parameter("a", unit="m"),
        tc.Parameter("b", low=0.0),
        tc.Parameter("s"),
        tc.Parameter("m", neutral=0.0),
    ],
)


def recording():
    u = 1 + 2 * T + 0.5 * T**2
    v = 2 * T**2 + 0.1 * torch.sin(7 * T)
    v[2] = math.nan
    return tc.Recording(
        x={"t": T, "unused": T + 1},
        y={"u": u, "v<w>": v},
        noise={"u": 0.05, "v<w>": 0.02},
        missing=True,
        units={"u": "m"},
    )


def quietly(function, *arguments, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tc.errors.ConvergenceWarning)
        warnings.simplefilter("ignore", tc.errors.ToleranceWarning)
        return function(*arguments, **options)


@pytest.fixture(scope="module")
def sampled():
    return quietly(
        tc.calibrate,
        SIMULATOR,
        recording(),
        embedding=tc.embeddings.Gaussian(parameters=("a",)),
        likelihood=tc.likelihoods.ABC(epsilon=0.1),
        fixed={"s": 1.0},
        **SHORT,
    )


@pytest.fixture(scope="module")
def point():
    return quietly(tc.calibrate, SIMULATOR, recording(), fixed={"s": 1.0}, num_samples=0, num_starts=4)


@pytest.fixture(scope="module")
def additive():
    return quietly(tc.calibrate_additive, SIMULATOR, recording(), fixed={"s": 1.0}, **SHORT)


RESULTS = ["sampled", "point", "additive"]


# --- what they hold -------------------------------------------------------------------------------


def tensors(value, seen=None):
    """All tensors of a result, but for those of its propagation."""
    if isinstance(value, torch.Tensor):
        yield value
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from tensors(getattr(value, field.name))
    elif isinstance(value, dict):
        for item in value.values():
            yield from tensors(item)


@pytest.mark.parametrize("name", RESULTS)
def test_numbers_are_detached_float64(name, request):
    result = request.getfixturevalue(name)
    found = list(tensors(result))
    assert len(found) > 5
    for value in found:
        assert value.dtype in (torch.float64, torch.bool)
        assert not value.requires_grad
        assert value.device.type == "cpu"


def test_shapes_are_as_documented(sampled, additive, point):
    assert sampled.samples.shape == (2, 12, 3)
    assert sampled.alpha_names == ("a[0]", "a[xi1]", "b[0]")
    assert sampled.draws.shape == (24, 3)
    assert sampled.map.mean.shape == (2,)
    assert sampled.map.covariance.shape == (2, 2)
    assert sampled.map.sd[1] == 0
    assert isinstance(sampled.map.objective, float)
    assert additive.samples.shape == (2, 12, 3)
    assert additive.alpha_names == ("a", "b", "ln sigma")
    assert additive.parameters.shape == (24, 2)
    assert (additive.parameters[:, 1] >= 0).all()
    assert (additive.sigma > 0).all()
    assert point.samples is None
    assert point.draws is None
    assert sampled.predict().mean.shape == (2 * N,)


def test_map_moments_are_those_of_the_propagation(sampled):
    mean, covariance = sampled.propagate.parameter_moments(sampled.map.alpha)
    torch.testing.assert_close(sampled.map.mean, mean, rtol=0, atol=0)
    torch.testing.assert_close(sampled.map.covariance, covariance, rtol=0, atol=0)
    prediction = sampled.predict()
    y, observed = recording().y, recording().observed
    value = sampled.likelihood.log_prob(
        y[observed], prediction.map.mean[observed], prediction.map.sd[observed], recording().noise_sd[observed]
    )
    # The prediction lacks the floor of 1e-3 ε under the sd, which moves the objective by less than 1e-3.
    assert -float(value) == pytest.approx(sampled.map.objective, abs=1e-2)


def test_thinning_takes_draws_evenly(sampled):
    few = sampled.predict(max_draws=2)
    ends = sampled.draws[[0, -1]]
    mean = sampled.propagate.mean(ends).mean(0)
    torch.testing.assert_close(few.mean, mean, rtol=1e-12, atol=1e-12)


# --- draws of outputs and parameters --------------------------------------------------------------


@pytest.mark.parametrize("kind", ["posterior", "map"])
def test_sampled_outputs_have_the_predicted_moments(sampled, kind):
    count = 4000
    outputs = sampled.sample_outputs(count, kind=kind, seed=1)
    assert outputs.shape == (count, 2 * N)
    prediction = sampled.predict()
    moments = prediction.map if kind == "map" else prediction.posterior
    # Five standard errors.
    assert ((outputs.mean(0) - moments.mean).abs() <= 5 * moments.sd / math.sqrt(count) + 1e-9).all()
    error = (((outputs - moments.mean) ** 4).mean(0) - moments.sd**4).clamp_min(0).div(count).sqrt()
    assert ((outputs.var(0) - moments.sd**2).abs() <= 5 * error + 1e-9).all()
    torch.testing.assert_close(sampled.sample_outputs(count, kind=kind, seed=1), outputs, rtol=0, atol=0)


def test_sampled_parameters_have_their_moments(sampled):
    count = 4000
    parameters = sampled.sample_parameters(count, kind="map", seed=2)
    assert parameters.shape == (count, 2)
    assert ((parameters.mean(0) - sampled.map.mean).abs() <= 5 * sampled.map.sd / math.sqrt(count) + 1e-9).all()
    assert (parameters[:, 1] - sampled.map.mean[1]).abs().max() < 1e-12


def test_posterior_figures_need_draws(point):
    for call in (
        lambda: point.sample_outputs(3),
        lambda: point.sample_parameters(3),
        lambda: point.parameter_density(torch.ones(1, 2)),
    ):
        with pytest.raises(DomainError, match=r"num_samples=0.*kind='map'"):
            call()
    with pytest.raises(DomainError, match="'posterior' or 'map'"):
        point.sample_outputs(3, kind="prior")
    assert point.sample_outputs(3, kind="map").shape == (3, 2 * N)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: r.predict(max_draws=0), "max_draws"),
        (lambda r: r.sample_outputs(-1), "num"),
        (lambda r: r.sample_parameters(1.5), "num"),
        (lambda r: r.predict({"t": [], "unused": []}), "condition 't'"),
    ],
)
def test_bad_numbers_are_refused(sampled, call, message):
    with pytest.raises(DomainError, match=message):
        call(sampled)


def test_relabelling_keeps_predictions_and_makes_the_last_row_positive(sampled, point):
    again = sampled.relabelled()
    assert (again.samples[..., 1] >= 0).all()
    assert again.map.alpha[1] >= 0
    torch.testing.assert_close(again.predict().sd, sampled.predict().sd, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(again.predict().map.sd, sampled.predict().map.sd, rtol=1e-12, atol=1e-12)
    assert point.relabelled().samples is None


# --- frozen and readable --------------------------------------------------------------------------


@pytest.mark.parametrize("name", RESULTS)
def test_results_are_frozen(name, request):
    result = request.getfixturevalue(name)
    for owner, field in ((result, "samples"), (result.map, "mean"), (result.diagnostics, "divergences")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(owner, field, None)


@pytest.mark.parametrize("name", RESULTS)
def test_results_print_themselves(name, request):
    result = request.getfixturevalue(name)
    text = str(result)
    assert repr(result) == text
    assert "a [m]" in text
    assert "6 conditions, outputs u, v<w>" in text
    assert f"{float(result.map.mean[0]):.6g}" in text
    assert ("R-hat" in text) == (name != "point")
    assert max(len(line) for line in text.splitlines() if not line.strip().startswith("problem")) <= 120
    html = result._repr_html_()
    assert "v&lt;w&gt;" in html
    assert "<w>" not in html


def test_diagnostics_hold_alpha_and_moments(sampled):
    diagnostics = sampled.diagnostics
    assert tuple(diagnostics.alpha) == sampled.alpha_names
    assert tuple(diagnostics.parameters) == ("E[a]", "E[b]", "Var[a]")
    assert diagnostics.starts == 4
    assert 1 <= diagnostics.agreeing <= 4
    assert diagnostics.null_directions.shape[1] == 3
    qualities = [*diagnostics.alpha.values(), *diagnostics.parameters.values()]
    assert diagnostics.r_hat == max(q.r_hat for q in qualities)
    assert diagnostics.ess == min(min(q.ess_bulk, q.ess_tail) for q in qualities)
    assert diagnostics.converged == (not diagnostics.problems)
    prediction = sampled.predict()
    unit, seen = sampled.recording.spread, sampled.recording.observed  # each output in units of its own spread
    model_error = (prediction.sd_model_error / unit).square()[seen].mean()
    posterior = (prediction.sd_posterior / unit).square()[seen].mean()
    assert diagnostics.model_error_variance == pytest.approx(float(model_error), rel=1e-9)
    assert diagnostics.posterior_variance == pytest.approx(float(posterior), rel=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("calibrate", [tc.calibrate, tc.calibrate_additive])
def test_few_draws_are_said_to_be_too_few_to_judge(calibrate, count):
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        fit = calibrate(SIMULATOR, recording(), fixed={"s": 1.0}, **{**SHORT, "num_samples": count})
    said = " ".join(str(one.message) for one in given if one.category is tc.errors.ConvergenceWarning)
    assert f"{count} draw{'s' if count > 1 else ''} a chain cannot be judged" in said
    assert "nan" not in said
    assert fit.diagnostics.converged is False


def test_without_draws_diagnostics_say_so(point):
    assert point.diagnostics.converged is None
    assert math.isnan(point.diagnostics.r_hat)
    assert math.isnan(point.diagnostics.ess)
    assert math.isnan(point.diagnostics.posterior_variance)


# --- files ----------------------------------------------------------------------------------------


def same(one, other, path=""):
    """Whether two results hold the same, NaN equal to NaN."""
    if isinstance(one, torch.Tensor):
        assert isinstance(other, torch.Tensor), path
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True, msg=path)
    elif dataclasses.is_dataclass(one):
        assert type(one) is type(other), path
        for field in dataclasses.fields(one):
            same(getattr(one, field.name), getattr(other, field.name), f"{path}.{field.name}")
    elif isinstance(one, dict):
        assert set(one) == set(other), path
        for key in one:
            same(one[key], other[key], f"{path}[{key!r}]")
    elif isinstance(one, float) and math.isnan(one):
        assert math.isnan(other), path
    elif isinstance(one, tuple | list):
        assert list(one) == list(other), path
    else:
        assert one == other, path


@pytest.mark.parametrize("name", RESULTS)
def test_a_round_trip_without_a_simulator_keeps_everything_but_the_code(name, request, tmp_path):
    result = request.getfixturevalue(name)
    path = tmp_path / "result.nc"
    result.save(path)
    loaded = type(result).load(path)
    for field in ("map", "samples", "diagnostics", "recording", "settings"):
        same(getattr(result, field), getattr(loaded, field), field)
    if name != "additive":
        same(result.embedding, loaded.embedding)
        same(result.likelihood, loaded.likelihood)
    assert loaded.propagate is None
    before, after = result.predict(), loaded.predict()
    same(dataclasses.replace(before, x=None), dataclasses.replace(after, x=None), "prediction")
    same(recording().x, dict(after.x))
    assert "E[λ]" in str(loaded) or "MAP" in str(loaded)
    with pytest.raises(DomainError, match=r"load\(path, simulator=\.\.\.\)"):
        loaded.predict({"t": [0.5], "unused": [1.0]})


@pytest.mark.parametrize("name", RESULTS)
def test_a_round_trip_with_the_simulator_predicts_elsewhere(name, request, tmp_path):
    result = request.getfixturevalue(name)
    result.save(tmp_path / "result.nc")
    loaded = type(result).load(tmp_path / "result.nc", simulator=SIMULATOR)
    for x in (None, {"t": [0.25, 2.0], "unused": [0.0, 0.0]}):
        before, after = result.predict(x), loaded.predict(x)
        for kind in ("posterior", "map"):
            if getattr(before, kind) is None:
                continue
            torch.testing.assert_close(getattr(after, kind).mean, getattr(before, kind).mean, rtol=1e-12, atol=1e-14)
            torch.testing.assert_close(getattr(after, kind).sd, getattr(before, kind).sd, rtol=1e-12, atol=1e-14)
    assert str(loaded) == str(result)
    loaded.save(tmp_path / "again.nc")
    same(type(result).load(tmp_path / "again.nc").map, result.map)


@pytest.mark.parametrize("samples", [0, 12])
def test_a_result_in_which_nothing_is_uncertain_comes_back_with_its_simulator(samples, tmp_path):
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    other = tc.Simulator(lambda x, p: p["a"] - p["b"] * x, line.parameters)
    data = tc.Recording(x=T, y=1 + 2 * T + 0.5 * T**2)
    settings = {**SHORT, "num_samples": samples}
    plain = tc.embeddings.PolynomialChaos(order=0)
    fit = quietly(tc.calibrate, line, data, embedding=plain, likelihood="abcm", **settings)
    fit.save(tmp_path / "plain.nc")
    loaded = Calibration.load(tmp_path / "plain.nc", simulator=line)
    same(dataclasses.replace(loaded.predict([0.3, 2.0]), x=None), dataclasses.replace(fit.predict([0.3, 2.0]), x=None))
    assert float(loaded.predict().map.sd.max()) == 0.0
    with pytest.raises(DomainError, match="predicts something else"):
        Calibration.load(tmp_path / "plain.nc", simulator=other)


def test_an_additive_result_without_its_simulator_still_has_its_parameters(additive, tmp_path):
    additive.save(tmp_path / "result.nc")
    loaded = AdditiveCalibration.load(tmp_path / "result.nc")
    same(additive.parameters, loaded.parameters)
    assert str(loaded) == str(additive)


@pytest.mark.parametrize("name", RESULTS)
def test_a_missing_folder_is_named(name, request, tmp_path):
    result = request.getfixturevalue(name)
    with pytest.raises(DomainError, match=r"folder that exists.*no folder '.*nowhere'. Make it"):
        result.save(tmp_path / "nowhere" / "result.nc")
    with pytest.raises(DomainError, match="name of a file"):
        result.save(tmp_path)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("likelihood", ["abc", "gausmarg", tc.likelihoods.Marginal(num_samples=16, bandwidth=0.5)])
@pytest.mark.parametrize(
    "embedding",
    [tc.embeddings.Uniform(), tc.embeddings.PolynomialChaos(("a",), order=2, germ="legendre", triangular=False)],
)
def test_choices_survive_a_round_trip(likelihood, embedding, tmp_path):
    simulator = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a", low=0.1, high=9.0, transform="log")])
    data = tc.Recording(x=T + 1, y=(T + 1) ** 2, noise=0.1)
    result = quietly(
        tc.calibrate, simulator, data, likelihood=likelihood, embedding=embedding, num_samples=0, num_starts=4, order=2
    )
    result.save(tmp_path / "result.nc")
    loaded = Calibration.load(tmp_path / "result.nc", simulator=simulator)
    assert type(loaded.embedding) is type(embedding)
    same(loaded.embedding, result.embedding)
    same(loaded.likelihood, result.likelihood)
    torch.testing.assert_close(loaded.predict([3.0]).sd, result.predict([3.0]).sd, rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("rule", "nodes"), [(tc.polychaos.qmc_rule(tc.polychaos.HERMITE, 1, 64, seed=1), 64), (2, 2)]
)
def test_a_rule_of_ones_own_is_kept_to_and_survives_a_round_trip(tmp_path, rule, nodes):
    simulator = tc.Simulator(lambda x, p: torch.exp(p["a"] * x), [tc.Parameter("a", low=0.0, high=2.0)])
    data = tc.Recording(x=T + 1, y=1 + (T + 1) ** 2)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        result = tc.calibrate(simulator, data, rule=rule, num_samples=0, num_starts=4)
    assert any(f"{nodes} quadrature nodes" in str(each.message) for each in told)
    assert result.propagate.num_nodes == nodes
    result.save(tmp_path / "result.nc")
    loaded = Calibration.load(tmp_path / "result.nc", simulator=simulator)
    with pytest.warns(tc.errors.PropagationWarning, match=f"{nodes} quadrature nodes"):
        expected = result.predict([1.5]).sd
    with pytest.warns(tc.errors.PropagationWarning, match=f"{nodes} quadrature nodes"):
        torch.testing.assert_close(loaded.predict([1.5]).sd, expected, rtol=1e-10, atol=0)


def test_the_tree_has_its_groups(sampled, additive, point):
    tree = sampled.to_datatree()
    assert isinstance(tree, xarray.DataTree)
    assert {"posterior", "map", "prediction", "observed_data", "constant_data"} <= set(tree.children)
    alpha = tree["posterior"]["alpha"]
    assert alpha.dims == ("chain", "draw", "coefficient")
    assert list(alpha.coords["coefficient"].values) == list(sampled.alpha_names)
    np.testing.assert_array_equal(alpha.sel(coefficient="b[0]").values, sampled.samples[..., 2].numpy())
    np.testing.assert_array_equal(tree["observed_data"]["u"].values, recording().split(recording().y)["u"].numpy())
    np.testing.assert_array_equal(tree["constant_data"]["t"].values, T.numpy())
    assert "posterior" not in point.to_datatree().children
    assert {"push_forward_sd", "posterior_sd", "map_sd"} <= set(additive.to_datatree()["prediction"].data_vars)


@pytest.mark.parametrize("name", RESULTS)
def test_arviz_reads_the_tree(name, request):
    pytest.importorskip("arviz")
    result = request.getfixturevalue(name)
    data = result.to_arviz()
    if name == "point":
        return
    posterior = data.posterior if hasattr(data, "posterior") else data["posterior"]
    assert posterior["alpha"].shape == (2, 12, 3)
    import arviz

    table = arviz.summary(data, kind="stats")
    assert len(table) == 3
    assert float(table["mean"].iloc[0]) == pytest.approx(float(result.draws[:, 0].mean()), abs=6e-3)  # rounded


@pytest.fixture(scope="module")
def elsewhere(sampled, tmp_path_factory):
    """A saved result, its bytes, and what another process did with it: it read it without pickle, and saved it on a
    full disk, where HDF5 itself takes the interpreter down with it."""
    path = tmp_path_factory.mktemp("elsewhere") / "result.nc"
    sampled.save(path)
    before = path.read_bytes()
    code = f"""
        import sys, pickle
        def forbidden(*a, **k): raise RuntimeError('pickle')
        import torchcal as tc
        pickle.loads = pickle.load = pickle.Unpickler = forbidden
        result = tc.results.Calibration.load({str(path)!r})
        print(result.samples.shape, flush=True)
        try:
            import resource
        except ImportError:
            sys.exit()
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY))
        try:
            result.save({str(path)!r})
        except OSError as error:
            print("refused:", error.strerror)
        print("alive", tc.results.Calibration.load({str(path)!r}).alpha_names)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=False)
    return path, before, done


def test_no_pickle_is_read_or_written(elsewhere):
    _, before, done = elsewhere
    assert before[:8] == b"\x89HDF\r\n\x1a\n"
    assert "torch.Size([2, 12, 3])" in done.stdout, done.stderr


def test_a_file_is_written_whole_or_not_at_all(sampled, tmp_path, monkeypatch):
    path = tmp_path / "result.nc"
    path.write_text("precious")

    def break_down(self, data):
        with open(self, "wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", break_down)
    with pytest.raises(OSError, match="disk full"):
        sampled.save(path)
    assert path.read_text() == "precious"
    assert os.listdir(tmp_path) == ["result.nc"]
    monkeypatch.undo()
    sampled.save(path)
    assert Calibration.load(path).alpha_names == sampled.alpha_names
    assert os.listdir(tmp_path) == ["result.nc"]


def test_a_full_disk_is_an_error_and_leaves_the_old_file(elsewhere):
    pytest.importorskip("resource")
    path, before, done = elsewhere
    assert done.returncode == 0, done.stderr
    assert "refused: File too large" in done.stdout
    assert "alive" in done.stdout
    assert "Exception ignored" not in done.stderr
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == ["result.nc"]


def rewrite(path, change, checked=False):
    """A file with a change to its attributes' text or its groups, with or without its old checksum."""
    with xarray.open_datatree(path, engine="h5netcdf") as file:
        tree = file.load()
        meta = json.loads(tree.attrs["torchcal"])
        mark = tree.attrs[CHECKSUM]
        tree = change(tree, meta) or tree
    tree.attrs = {"torchcal": json.dumps(meta), **({CHECKSUM: mark} if checked else {})}
    tree.to_netcdf(path, engine="h5netcdf")


@pytest.mark.parametrize("name", RESULTS)
def test_a_file_without_a_checksum_is_read_as_well(name, request, tmp_path):
    result = request.getfixturevalue(name)
    result.to_datatree().to_netcdf(tmp_path / "plain.nc", engine="h5netcdf")
    result.save(tmp_path / "checked.nc")
    rewrite(tmp_path / "checked.nc", lambda tree, meta: None)
    for file in ("plain.nc", "checked.nc"):
        loaded = type(result).load(tmp_path / file)
        same(loaded.map, result.map)
        same(loaded.recording, result.recording)


def test_a_changed_number_or_word_is_noticed(sampled, tmp_path):
    def number(tree, meta):
        tree["map"]["mean"].values[0] += 1e-9

    def word(tree, meta):
        meta["settings"]["seed"] += 1

    def nothing(tree, meta):
        pass

    path = tmp_path / "result.nc"
    for change in (number, word):
        sampled.save(path)
        rewrite(path, change, checked=True)
        with pytest.raises(TorchcalError, match=r"damaged or changed since: its checksum differs \(take a whole copy"):
            Calibration.load(path)
    sampled.save(path)
    rewrite(path, nothing, checked=True)
    same(Calibration.load(path).map, sampled.map)


def test_damage_is_told_or_does_no_harm(sampled, tmp_path):
    path = tmp_path / "result.nc"
    sampled.save(path)
    whole = path.read_bytes()
    told = []
    for seed in range(60):
        damage = random.Random(seed)
        data, start = bytearray(whole), damage.randrange(len(whole) - 20)
        data[start : start + 20] = damage.randbytes(20)
        path.write_bytes(bytes(data))
        try:
            loaded = Calibration.load(path)
        except TorchcalError as error:
            told.append(str(error))
        else:
            same(loaded.map, sampled.map)
            same(loaded.samples, sampled.samples)
            same(loaded.recording, sampled.recording)
            same(loaded.settings, sampled.settings)
            assert str(loaded) == str(sampled)
    assert len(told) > 20
    assert all("Expected" in text and str(path) in text for text in told)


@pytest.mark.parametrize("end", [0, 8, 100, 5000])
def test_a_part_of_a_file_is_told(sampled, tmp_path, end):
    path = tmp_path / "result.nc"
    sampled.save(path)
    path.write_bytes(path.read_bytes()[:end])
    with pytest.raises(TorchcalError, match=r"damaged or incomplete: .*\(take a whole copy of it, or remove it"):
        Calibration.load(path)


@pytest.mark.parametrize(
    ("name", "lost"),
    [
        *(("point", lost) for lost in ("map", "prediction", "observed_data", "constant_data")),
        ("additive", "prediction"),  # the others are read by the same lines
        *(pytest.param("additive", lost, marks=pytest.mark.slow) for lost in ("map", "observed_data", "constant_data")),
    ],
)
def test_a_file_that_lacks_a_group_is_told(name, request, tmp_path, lost):
    result = request.getfixturevalue(name)
    path = tmp_path / "result.nc"
    result.save(path)
    rewrite(path, lambda tree, meta: xarray.DataTree(children={k: v for k, v in tree.children.items() if k != lost}))
    with pytest.raises(TorchcalError, match="damaged or incomplete"):
        type(result).load(path, simulator=SIMULATOR)


@pytest.mark.parametrize(
    "lost",
    [
        pytest.param(("settings",), marks=pytest.mark.slow),
        ("diagnostics",),
        ("recording",),
        ("kind",),
        pytest.param(("format",), marks=pytest.mark.slow),
        ("settings", "center"),
        pytest.param(("settings", "order"), marks=pytest.mark.slow),
        ("settings", "units"),
        pytest.param(("settings", "embedding"), marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("name", ["point", pytest.param("additive", marks=pytest.mark.slow)])  # read by the same lines
def test_a_file_that_lacks_a_setting_is_told(name, request, tmp_path, lost):
    result = request.getfixturevalue(name)
    path = tmp_path / "result.nc"
    result.save(path)

    def change(tree, meta):
        for key in lost[:-1]:
            meta = meta[key]
        del meta[lost[-1]]

    rewrite(path, change)
    with pytest.raises(TorchcalError, match="damaged or incomplete: KeyError"):
        type(result).load(path)


@pytest.mark.parametrize("kind", [Calibration, AdditiveCalibration])
def test_what_is_no_path_or_no_simulator_is_told(kind, sampled, additive, tmp_path):
    (sampled if kind is Calibration else additive).save(tmp_path / "result.nc")
    for path in (None, 3, b"result.nc"):
        with pytest.raises(DomainError, match=r"Expected path: the name of a netCDF file\. Got (NoneType|int|bytes)"):
            kind.load(path)
    with pytest.raises(DomainError, match=r"Expected simulator as a torchcal\.Simulator or None\. Got int"):
        kind.load(tmp_path / "result.nc", simulator=3)


@pytest.mark.parametrize("package", ["xarray", "h5netcdf", "h5py"])
def test_a_missing_package_is_told(package, sampled, tmp_path, monkeypatch):
    sampled.save(tmp_path / "old.nc")
    tree = sampled.to_datatree()
    monkeypatch.setattr(type(sampled), "to_datatree", lambda self: tree)
    monkeypatch.setitem(sys.modules, package, None)
    told = rf"Expected {package} for trees and netCDF files\..* pip install 'torchcal\[arviz\]'"
    with pytest.raises(MissingDependencyError, match=told):
        sampled.save(tmp_path / "new.nc")
    with pytest.raises(MissingDependencyError, match=told):
        Calibration.load(tmp_path / "old.nc")

    def never(x, p):
        raise AssertionError("evaluated")

    simulator = tc.Simulator(never, [tc.Parameter("a")])
    with pytest.raises(MissingDependencyError, match=told):
        tc.calibrate_many(simulator, [tc.Recording(x=T, y=T)], folder=tmp_path / "many")
    assert os.listdir(tmp_path) == ["old.nc"]


def test_conditions_keep_their_order(tmp_path):
    simulator = tc.Simulator(lambda x, p: {"z": p["a"] * x["s"], "b": p["a"] + x["c"]}, [tc.Parameter("a")])
    data = tc.Recording(x={"s": T, "c": T + 1}, y={"z": T + 1, "b": T**2})
    quietly(tc.calibrate, simulator, data, num_samples=0, num_starts=4).save(tmp_path / "result.nc")
    loaded = Calibration.load(tmp_path / "result.nc").recording
    assert loaded.conditions == ("s", "c")
    assert loaded.outputs == ("z", "b")


def test_what_torchcal_did_not_write_is_refused(sampled, additive, tmp_path):
    missing, text, other = tmp_path / "none.nc", tmp_path / "text.nc", tmp_path / "other.nc"
    text.write_text("not netCDF")
    xarray.Dataset({"a": ("n", np.arange(3.0))}).to_netcdf(other, engine="h5netcdf")
    for path in (missing, text, other):
        with pytest.raises(TorchcalError, match=r"netCDF file that torchcal wrote"):
            Calibration.load(path)
    sampled.save(tmp_path / "embedded.nc")
    additive.save(tmp_path / "additive.nc")
    with pytest.raises(TorchcalError, match="other class"):
        AdditiveCalibration.load(tmp_path / "embedded.nc")
    with pytest.raises(TorchcalError, match="other class"):
        Calibration.load(tmp_path / "additive.nc")


def test_another_simulator_is_refused(sampled, tmp_path):
    sampled.save(tmp_path / "result.nc")
    other = tc.Simulator(lambda x, p: p["q"] * x["t"], [tc.Parameter("q"), tc.Parameter("a"), tc.Parameter("s")])
    with pytest.raises(TorchcalError, match=r"\['a', 'b'\]"):
        Calibration.load(tmp_path / "result.nc", simulator=other)


@pytest.mark.parametrize("name", ["condition", "datum", "x", "chain"])
def test_names_of_the_files_own_dimensions_are_taken(name, tmp_path):
    """A condition or an output may be called what a dimension of the file is called."""
    simulator = tc.Simulator(
        lambda x, p: {name + "_": p["a"] * x[name], "datum_": p["a"] + x[name]}, [tc.Parameter("a")]
    )
    data = tc.Recording(x={name: T}, y={name + "_": T + 1, "datum_": T**2})
    result = quietly(tc.calibrate, simulator, data, num_samples=0, num_starts=4)
    result.save(tmp_path / "result.nc")
    same(Calibration.load(tmp_path / "result.nc").recording, result.recording)


@pytest.mark.parametrize(("condition", "output"), [("x", "."), (".", "y")])
def test_a_name_of_a_dot_is_taken(condition, output, tmp_path):
    simulator = tc.Simulator(
        lambda x, p: {output: p["a"] * x[condition], "|": p["a"] + x[condition]}, [tc.Parameter("a")]
    )
    data = tc.Recording(x={condition: T}, y={output: T + 1, "|": T**2})
    result = quietly(tc.calibrate, simulator, data, num_samples=0, num_starts=4)
    result.save(tmp_path / "result.nc")
    same(Calibration.load(tmp_path / "result.nc").recording, result.recording)


def test_names_with_a_slash_are_taken(tmp_path):
    simulator = tc.Simulator(lambda x, p: {"p/q": p["a/b"] * x["m/s"], "r": p["a/b"] + x["m/s"]}, [tc.Parameter("a/b")])
    data = tc.Recording(x={"m/s": T}, y={"p/q": T + 1, "r": T**2})
    result = quietly(tc.calibrate, simulator, data, num_samples=0, num_starts=4)
    result.save(tmp_path / "result.nc")
    same(Calibration.load(tmp_path / "result.nc").recording, result.recording)


def test_another_simulator_than_the_calibrated_one_is_refused(tmp_path):
    line, other = (tc.Simulator(lambda x, p, n=n: p["a"] + p["b"] * x**n, [tc.Parameter("a"), tc.Parameter("b")])
                   for n in (1, 2))  # fmt: skip
    x = torch.linspace(-1, 1, 11, dtype=torch.float64)
    recording = tc.Recording(x=x, y=2 + x + x**3)
    fit = tc.calibrate(line, recording, likelihood=tc.likelihoods.ABC(epsilon=0.1), num_samples=0)
    fit.save(tmp_path / "line.nc")
    with pytest.raises(tc.errors.DomainError, match="predicts something else"):
        tc.results.Calibration.load(tmp_path / "line.nc", simulator=other)
    tc.results.Calibration.load(tmp_path / "line.nc", simulator=line)


@pytest.mark.parametrize("in_time", [False, True])
def test_an_output_that_was_held_out_whole_survives_a_round_trip(tmp_path, in_time):
    a, b = 2 * T + 0.1 * T**2, 3 * T**2 + 0.1
    if in_time:
        simulator = tc.ODESimulator(
            lambda t, s, p, u: {"a": p["k"] + 0 * s["a"]},
            ["a"],
            [tc.Parameter("k")],
            observe={"a": lambda t, s, p, u: s["a"], "b": lambda t, s, p, u: s["a"] ** 2},
        )
        data = tc.Recording(runs=[tc.Run(T, {"a": a, "b": b}, initial={"a": 0.0})], missing=True)
    else:
        simulator = tc.Simulator(lambda x, p: {"a": p["k"] * x, "b": p["k"] * x**2}, [tc.Parameter("k")])
        data = tc.Recording(x=T, y={"a": a, "b": b}, missing=True)
    kept = data.masked(torch.arange(2 * N) < N)
    for calibrate, kind in ((tc.calibrate, Calibration), (tc.calibrate_additive, AdditiveCalibration)):
        result = quietly(calibrate, simulator, kept, num_samples=0, num_starts=4, seed=0)
        result.save(tmp_path / "result.nc")
        loaded = kind.load(tmp_path / "result.nc", simulator=simulator)
        assert torch.equal(loaded.recording.observed, kept.observed)
        assert torch.equal(loaded.recording.spread, kept.spread)
        assert torch.equal(loaded.recording.y.isnan(), kept.y.isnan())
        whole = quietly(calibrate, simulator, data, num_samples=0, num_starts=4, seed=0)
        whole.save(tmp_path / "whole.nc")
        assert kind.load(tmp_path / "whole.nc").recording.missing is True  # as given, though nothing is
