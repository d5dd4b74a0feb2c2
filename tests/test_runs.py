"""Recordings in time: runs, their inputs between samples, masks, and what is refused with which words."""

import copy
import dataclasses
import pickle
import time as clock
import warnings

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.data import Recording, Run
from torchcal.errors import DomainError, RecordingError, ShapeError, TorchcalError
from torchcal.results import in_time

NAN, INF = float("nan"), float("inf")
T = [0.0, 1.0, 3.0]
X = [1.0, 4.0, 2.0]
F = [0.0, 2.0, 6.0]


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def run(**change):
    return Run(**({"time": T, "outputs": {"x": X}, "inputs": {"f": F}} | change))


def uneven(count, seed=0):
    """Times from 0 to 2 with steps between 0.5 and 1.5 times their mean."""
    steps = np.random.default_rng(seed).uniform(0.5, 1.5, count - 1)
    return np.concatenate([[0.0], 2 * np.cumsum(steps) / steps.sum()])


# --- a run ------------------------------------------------------------------------------------------


def test_a_run_holds_float64_copies():
    time, x, f = np.array(T, dtype=np.float32), torch.tensor([1, 4, 2]), list(F)
    one = Run(time, {"x": x, "v": [1, NAN, 2]}, {"f": f}, {"x": np.float32(1), "v": torch.tensor(2)}, "zero")
    time[0], x[0], f[0] = -9, 9, 9
    assert torch.equal(one.time, tensor(T))
    assert torch.equal(one.outputs["x"], tensor(X))
    assert torch.equal(one.inputs["f"], tensor(F))
    assert list(one.outputs) == ["x", "v"]
    assert one.outputs["v"].isnan().tolist() == [False, True, False]
    assert one.initial == {"x": 1.0, "v": 2.0}
    assert {type(value) for value in one.initial.values()} == {float}
    assert (one.hold, one.units) == ("zero", {})
    bare = Run(T, {"x": X})
    assert (bare.inputs, bare.initial, bare.hold) == ({}, {}, "linear")


def test_a_run_is_frozen_and_copyable():
    one = run(initial={"x": 1}, hold="cubic")
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.time = tensor(T)
    one.inputs_at(0.5)
    for twin in (copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
        assert repr(twin) == repr(one)
        assert torch.equal(twin.inputs_at(0.5)["f"], one.inputs_at(0.5)["f"])
    assert dataclasses.replace(one, hold="zero").inputs_at(0.5)["f"] == 0


def test_each_input_may_go_on_in_its_own_way():
    inputs = {"valve": F, "room": [0, 2, 8], "load": [1, 2, 4]}
    one = Run(T, {"x": X}, inputs, hold={"valve": "zero", "load": "cubic"})
    assert one.holds == one.hold == {"valve": "zero", "room": "linear", "load": "cubic"}
    at = 0.5 * (T[0] + T[1])
    got = one.inputs_at([at, T[2]])
    assert list(got) == list(inputs)
    for name, hold in one.holds.items():
        alone = Run(T, {"x": X}, {name: inputs[name]}, hold=hold)
        assert torch.equal(got[name], alone.inputs_at([at, T[2]])[name])
    assert "input (zero) valve" in repr(one)
    assert "input (linear) room" in repr(one)
    assert dataclasses.replace(one, hold={"valve": "cubic", "room": "cubic", "load": "cubic"}).hold == "cubic"
    assert Run(T, {"x": X}, inputs, hold={}).hold == "linear"


def test_samples_between_and_runs_that_are_given_again_keep_the_hold_of_each_input():
    one = Run(T, {"x": X}, {"f": F, "g": F}, hold={"f": "zero"})
    more, _ = in_time._with_times(tc.Recording(runs=[one]), {"time": tensor([2.0]), "run": tensor([0.0])})
    assert more.runs[0].holds == one.holds
    assert float(more.runs[0].inputs["f"][2]) == F[1]
    assert in_time._may_be(Run(T, {"x": X}, {"f": F}, hold="zero"), one)
    assert not in_time._may_be(Run(T, {"x": X}, {"f": F}), one)


REFUSED_RUNS = {
    "time nan": ({"time": [0, NAN, 1]}, RecordingError, r"in time\. Got nan at index 1.*a time must be known"),
    "time inf": ({"time": [0, 1, INF]}, RecordingError, r"in time\. Got inf at index 2"),
    "time text": ({"time": ["a", "b", "c"]}, RecordingError, r"Expected time as real numbers.*'a' at index 0"),
    "time 2-D": ({"time": [T]}, ShapeError, r"Expected time of shape \(T,\)\. Got shape \(1, 3\)"),
    "time scalar": ({"time": 1.0}, ShapeError, r"Expected time of shape \(T,\)\. Got a scalar"),
    "time stands": ({"time": [0, 1, 1]}, RecordingError, r"increase strictly\. Got 1 after 1 at index 2 \(sort"),
    "time goes back": ({"time": [0, -1, 1]}, RecordingError, r"increase strictly\. Got -1 after 0 at index 1"),
    "one time": ({"time": [0], "outputs": {"x": [0]}, "inputs": None}, RecordingError, r"at least 2 times\. Got 1"),
    "no times": ({"time": [], "outputs": {"x": []}, "inputs": None}, RecordingError, r"at least 2 times\. Got 0"),
    "output length": ({"outputs": {"x": [1, 2]}}, RecordingError, r"outputs\['x'\] of the length of time, 3\. Got 2"),
    "input length": ({"inputs": {"f": [1] * 4}}, RecordingError, r"inputs\['f'\] of the length of time, 3\. Got 4"),
    "output inf": ({"outputs": {"x": [1, -INF, 2]}}, RecordingError, r"outputs\['x'\]\. Got -inf at index 1"),
    "input nan": ({"inputs": {"f": [0, 1, NAN]}}, RecordingError, r"\['f'\]\. Got nan at index 2.*an input must be"),
    "outputs missing": ({"outputs": None}, RecordingError, r"outputs: a dict.*Got NoneType"),
    "outputs an array": ({"outputs": X}, RecordingError, r"outputs: a dict.*Got list"),
    "no outputs": ({"outputs": {}}, RecordingError, r"outputs: a dict with an array\. Got none"),
    "inputs an array": ({"inputs": F}, RecordingError, r"inputs: a dict.*Got list"),
    "output number": ({"outputs": {1: X}}, RecordingError, r"names in outputs: non-empty strings\. Got 1"),
    "input empty": ({"inputs": {"": F}}, RecordingError, r"names in inputs: non-empty strings\. Got ''"),
    "output t": ({"outputs": {"t": X}}, RecordingError, r"names in outputs other than .*Got 't'"),
    "output run": ({"outputs": {"run": X}}, RecordingError, r"names in outputs other than .*Got 'run'"),
    "input time": ({"inputs": {"time": F}}, RecordingError, r"names in inputs other than .*Got 'time'"),
    "both": ({"inputs": {"x": F}}, RecordingError, r"outputs and inputs with different names\. Got 'x' in both"),
    "hold": ({"hold": "nearest"}, RecordingError, r"hold among \['linear', 'zero', 'cubic'\]\. Got 'nearest'"),
    "hold of none": ({"hold": {"g": "zero"}}, RecordingError, r"names in hold among the inputs \['f'\]\. Got 'g'"),
    "hold by input": ({"hold": {"f": "late"}}, RecordingError, r"hold of input 'f' among .*Got 'late'"),
    "hold None": ({"hold": None}, RecordingError, r"hold among .*Got None"),
    "initial a number": ({"initial": 1.0}, RecordingError, r"initial: a dict.*Got float"),
    "initial name": ({"initial": {0: 1.0}}, RecordingError, r"names in initial: non-empty strings\. Got 0"),
    "initial nan": ({"initial": {"x": NAN}}, RecordingError, r"initial\['x'\]: a finite number\. Got nan"),
    "initial array": ({"initial": {"x": X}}, RecordingError, r"initial\['x'\]: a finite number\. Got shape \(3,\)"),
    "initial text": ({"initial": {"x": "0"}}, RecordingError, r"initial\['x'\] as real numbers"),
    "initial None": ({"initial": {"x": None}}, RecordingError, r"initial\['x'\] as real numbers"),
}


@pytest.mark.parametrize(("change", "error", "message"), REFUSED_RUNS.values(), ids=REFUSED_RUNS)
def test_refused_runs(change, error, message):
    with pytest.raises(error, match=message) as caught:
        run(**change)
    assert isinstance(caught.value, TorchcalError)
    assert str(caught.value).startswith("Expected ")


def test_repr_of_a_run():
    one = Run(T, {"x": X, "v": [NAN, 1, 2]}, {"f": F}, {"x": 1, "v": 0.5}, "zero")
    assert repr(one).splitlines() == [
        "Run: 3 samples, time 0 to 3",
        "  output x: 1 to 4",
        "  output v: 1 to 2, 1 of 3 missing",
        "  input (zero) f: 0 to 6",
        "  initial x = 1, v = 0.5",
    ]
    assert repr(Run(T, {"x": [NAN] * 3})).splitlines()[1] == "  output x: nothing observed, 3 of 3 missing"


# --- inputs between samples -------------------------------------------------------------------------


def test_linear_inputs_by_hand():
    got = run(inputs={"f": F, "g": [1, 0, 0]}).inputs_at([[0, 0.5], [2, 3]])
    assert list(got) == ["f", "g"]
    assert got["f"].tolist() == [[0, 1], [4, 6]]
    assert got["g"].tolist() == [[1, 0.5], [0, 0]]


def test_zero_hold_keeps_a_value_until_the_next_sample():
    one = run(hold="zero")
    at = [0, 0.999, 1, 2.999, 3]
    assert one.inputs_at(at)["f"].tolist() == [0, 0, 2, 2, 6]
    assert one.inputs_at(at, side="left")["f"].tolist() == [0, 0, 0, 2, 2]


@pytest.mark.parametrize("hold", ["linear", "cubic"])
def test_a_continuous_input_has_no_sides(hold):
    one = run(time=uneven(9), outputs={"x": [0] * 9}, inputs={"f": np.sin(uneven(9))}, hold=hold)
    left, right = (one.inputs_at(one.time, side=side)["f"] for side in ("left", "right"))
    torch.testing.assert_close(left, one.inputs["f"], rtol=0, atol=1e-14)
    torch.testing.assert_close(right, one.inputs["f"], rtol=0, atol=1e-14)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 40])
def test_cubic_is_scipys_spline(count):
    interpolate = pytest.importorskip("scipy.interpolate")
    time = uneven(count, seed=count) - 0.7
    values = np.random.default_rng(count).normal(size=(2, count))
    one = Run(time, {"x": time}, {"f": values[0], "g": values[1]}, hold="cubic")
    at = np.linspace(time[0], time[-1], 201)
    for got, wanted in zip(one.inputs_at(at).values(), values, strict=True):
        np.testing.assert_allclose(got.numpy(), interpolate.CubicSpline(time, wanted)(at), rtol=0, atol=1e-11)


@pytest.mark.parametrize(("hold", "order"), [("zero", 1), ("linear", 2), ("cubic", 4)])
def test_order_of_convergence(hold, order):
    def function(t):
        return np.sin(3 * t) + np.exp(-t)

    at = np.linspace(0, 2, 2001)
    errors = []
    for count in (41, 81, 161):
        # A smooth map of an even grid: uneven, and every step halves.
        grid = np.linspace(0, 1, count)
        time = 2 * (grid - 0.1 * np.sin(2 * np.pi * grid))
        got = Run(time, {"x": time}, {"f": function(time)}, hold=hold).inputs_at(at)["f"]
        errors.append(np.abs(got.numpy() - function(at)).max())
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(rates, order, atol=0.1)


@pytest.mark.parametrize("hold", ["zero", "linear", "cubic"])
def test_a_long_input_is_quick(hold):
    time = torch.arange(100_000, dtype=torch.float64)
    one = Run(time, {"x": time}, {"f": torch.sin(time / 10)}, hold=hold)
    begin = clock.perf_counter()
    got = one.inputs_at(time[:-1] + 0.5)["f"]
    assert clock.perf_counter() - begin < 5.0  # a dense spline of this length would need 80 GB
    wanted = torch.sin((time[:-1] + 0.5) / 10)
    assert (got - wanted).abs().max() < {"zero": 0.06, "linear": 2e-3, "cubic": 1e-5}[hold]


@pytest.mark.parametrize("hold", ["linear", "cubic"])
def test_inputs_are_differentiable_in_time(hold):
    one = Run(uneven(8), {"x": [0] * 8}, {"f": np.cos(3 * uneven(8))}, hold=hold)
    at = torch.linspace(0.05, 1.95, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: one.inputs_at(t)["f"], at)


def test_shapes_and_times_of_other_kinds():
    one = run()
    assert one.inputs_at(0.5)["f"].shape == ()
    assert one.inputs_at(torch.zeros(2, 0, 3))["f"].shape == (2, 0, 3)
    assert one.inputs_at(np.float32(2))["f"].item() == 4
    assert one.inputs_at(torch.tensor([0, 3]))["f"].tolist() == [0, 6]
    assert one.inputs_at([0.1])["f"].item() == pytest.approx(0.2, rel=1e-15)
    assert run(inputs=None).inputs_at(1.0) == {}


@pytest.mark.parametrize("at", [-1e-9, 3 + 1e-9, [1, 4], NAN, INF])
@pytest.mark.parametrize("inputs", [None, {"f": F}])
def test_outside_the_run(at, inputs):
    with pytest.raises(DomainError, match=r"times within the run, from 0 to 3\. Got (-1e-09|3|4|nan|inf) \("):
        run(inputs=inputs).inputs_at(at)


def test_the_ends_may_be_rounded():
    step = 0.1
    time = step * torch.arange(4, dtype=torch.float64)
    one = Run(time, {"x": [0] * 4}, {"f": [0, 1, 2, 3]}, hold="zero")
    assert step + step + step != 0.3
    assert one.inputs_at([step + step + step, 0.3 * (1 + 1e-15), 0.0])["f"].tolist() == [3, 3, 0]


def test_side():
    with pytest.raises(DomainError, match=r"side 'right' or 'left'\. Got 'both'"):
        run().inputs_at(1.0, side="both")


# --- a recording in time ----------------------------------------------------------------------------


def three():
    """Runs of unequal length; the second lacks output v."""
    return [
        Run([0, 1, 2], {"x": [1, 2, 3], "v": [4, 5, 6]}, {"f": [0, 1, 0]}, {"x": 1}),
        Run([5, 7], {"x": [7, 8]}, {"f": [2, 2]}, {"x": 7, "v": 0}, "zero"),
        Run([0, 1, 2, 3], {"v": [9, 9, 9, 9], "x": [0, 0, 1, 1]}, {"f": [0, 0, 0, 0]}),
    ]


def test_runs_stand_one_after_another():
    recording = Recording(runs=three())
    assert list(recording.x) == list(recording.conditions) == ["time", "run"]
    assert recording.x["time"].tolist() == [0, 1, 2, 5, 7, 0, 1, 2, 3]
    assert recording.x["run"].tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 2]
    assert recording.x["run"].dtype == recording.x["time"].dtype == torch.float64
    assert torch.equal(recording.time, recording.x["time"])
    assert recording.run_index.dtype == torch.int64
    assert recording.run_index.tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 2]
    assert (recording.n, recording.outputs, recording.noise, recording.missing) == (9, ("x", "v"), None, True)
    parts = recording.split(recording.y)
    assert parts["x"].tolist() == [1, 2, 3, 7, 8, 0, 0, 1, 1]
    torch.testing.assert_close(parts["v"], tensor([4, 5, 6, NAN, NAN, 9, 9, 9, 9]), equal_nan=True)
    assert recording.observed.tolist() == [True] * 9 + [True] * 3 + [False] * 2 + [True] * 4
    assert [r.initial for r in recording.runs] == [{"x": 1}, {"x": 7, "v": 0}, {}]
    assert [r.hold for r in recording.runs] == ["linear", "zero", "linear"]
    spread = recording.split(recording.spread)
    assert spread["x"][0].item() == pytest.approx(np.std([1, 2, 3, 7, 8, 0, 0, 1, 1], ddof=1))
    assert spread["v"][4].item() == pytest.approx(np.std([4, 5, 6, 9, 9, 9, 9], ddof=1))
    assert spread["v"].shape == (9,)


def test_a_complete_recording_in_time_and_a_static_one():
    recording = Recording(runs=[run()])
    assert (recording.missing, len(recording.runs)) == (False, 1)
    assert isinstance(Recording(runs=(run(), run())).runs, tuple)
    assert Recording(runs=[run(outputs={"x": [1, NAN, 2]})], missing=True).observed.tolist() == [True, False, True]
    static = Recording(x=T, y=X)
    assert static.runs is None
    for name in ("time", "run_index"):
        with pytest.raises(RecordingError, match=r"a recording in time\. Got a static one"):
            getattr(static, name)


def test_an_output_may_be_unobserved_in_one_run():
    dark = Run([0, 1], {"x": [NAN, NAN]})
    recording = Recording(runs=[Run([0, 1], {"x": [1, 2]}), dark], missing=True)
    assert recording.observed.tolist() == [True, True, False, False]


def test_the_recording_does_not_share_its_runs():
    one = run()
    recording = Recording(runs=[one])
    one.outputs["x"][0] = 99
    assert recording.y[0] == recording.runs[0].outputs["x"][0] == 1


@pytest.mark.parametrize(
    ("noise", "wanted"),
    [
        (0.5, [0.5] * 18),
        (list(range(1, 10)), [*range(1, 10), *range(1, 10)]),
        (list(range(1, 19)), list(range(1, 19))),
        ({"v": 2, "x": list(range(1, 10))}, [*range(1, 10), *[2] * 9]),
    ],
)
def test_noise_of_runs(noise, wanted):
    assert Recording(runs=three(), noise=noise).noise_sd.tolist() == wanted


def test_noise_that_is_none():
    recording = Recording(runs=three(), noise="none")
    assert recording.noise == "none"
    assert recording.noise_sd is None


REFUSED = {
    "beside x": ({"x": T}, RecordingError, r"x= and y=, or runs=\. Got runs= and x="),
    "beside y": ({"y": X}, RecordingError, r"x= and y=, or runs=\. Got runs= and y="),
    "one run": ({"runs": run()}, RecordingError, r"runs: a list of Run\. Got Run"),
    "text": ({"runs": "runs"}, RecordingError, r"runs: a list of Run\. Got str"),
    "something else": ({"runs": [run(), {"x": X}]}, RecordingError, r"a list of Run\. Got dict as run 1"),
    "no runs": ({"runs": []}, RecordingError, r"at least one Run\. Got an empty list"),
    "other inputs": (
        {"runs": [run(), run(), run(inputs={"g": F})]},
        RecordingError,
        r"same inputs in every run\. Got \['f'\] in run 0, \['g'\] in run 2",
    ),
    "no inputs": (
        {"runs": [run(), run(inputs=None)]},
        RecordingError,
        r"same inputs in every run\. Got \['f'\] in run 0, \[\] in run 1",
    ),
    "nan": (
        {"runs": [run(), run(outputs={"x": [1, NAN, 2]})]},
        RecordingError,
        r"outputs\['x'\] of run 1\. Got nan at index 1, 1 of 3 entries \(if it marks a missing sample",
    ),
    "all missing": (
        {"runs": [run(outputs={"x": X, "v": [NAN] * 3})], "missing": True},
        RecordingError,
        r"observed values of output 'v'\. Got 3 missing samples of 3",
    ),
    "one observed": (
        {"runs": [run(outputs={"x": [1, NAN, NAN]})], "missing": True},
        RecordingError,
        r"at least 2 data points\. Got 1",
    ),
    "unit of nothing": ({"units": {"v": "m"}}, RecordingError, r"among \['time', 'x', 'f'\]\. Got 'v'"),
    "noise length": ({"noise": [1, 2]}, ShapeError, r"noise: a number or shape \(3,\)\. Got shape \(2,\)"),
    "noise names": ({"noise": {"f": 1}}, RecordingError, r"noise for exactly the outputs \['x'\]"),
}


@pytest.mark.parametrize(("change", "error", "message"), REFUSED.values(), ids=REFUSED)
def test_refused_recordings(change, error, message):
    with pytest.raises(error, match=message) as caught:
        Recording(**({"runs": [run()]} | change))
    assert str(caught.value).startswith("Expected ")


def test_the_order_of_inputs_does_not_matter():
    recording = Recording(runs=[run(inputs={"f": F, "g": X}), run(inputs={"g": X, "f": F})])
    assert [set(r.inputs) for r in recording.runs] == [{"f", "g"}] * 2


def test_repr():
    runs = three()
    units = {"time": "s", "x": "m", "f": "N"}
    assert repr(Recording(runs=runs, units=units, noise={"x": 0.1, "v": 2})).splitlines() == [
        "Recording in time: 3 runs, 9 samples, 2 of 18 values missing",
        "  time [s]: 0 to 7",
        "  output    x [m]: 0 to 8, noise sd 0.1",
        "  output    v: 4 to 9, noise sd 2",
        "  input     f [N]: 0 to 2",
    ]
    assert repr(Recording(runs=[run()])).splitlines()[0] == "Recording in time: 1 run, 3 samples"
    assert repr(Recording(runs=[run()])).splitlines()[-1] == "  noise     unknown"


def test_a_recording_in_time_is_copyable():
    recording = Recording(runs=three(), noise=0.1)
    for twin in (copy.deepcopy(recording), pickle.loads(pickle.dumps(recording))):
        assert torch.equal(twin.noise, recording.noise)
        assert repr(twin) == repr(recording)
        assert repr(twin.runs[1]) == repr(recording.runs[1])


# --- masks ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("convert", [list, np.array, torch.tensor])
def test_masked_static(convert):
    recording = Recording(
        x={"T": [1, 2, 3, 4]},
        y={"a": [1, NAN, 3, 5], "b": [5, 6, 7, 9]},
        noise=list(range(1, 9)),
        missing=True,
        units={"a": "s"},
    )
    part = recording.masked(convert([True, True, True, False]))
    assert part.observed.tolist() == [True, False, True, False, True, True, True, False]
    assert torch.equal(part.y.isnan(), ~part.observed)
    assert part.y[part.observed].tolist() == [1, 3, 5, 6, 7]
    assert part.x["T"].tolist() == [1, 2, 3, 4]
    assert torch.equal(part.noise_sd, recording.noise_sd)
    assert (part.n, part.units, part.outputs, part.missing) == (4, {"a": "s"}, ("a", "b"), True)
    spread = part.split(part.spread)
    torch.testing.assert_close(spread["a"], torch.full((4,), 2**0.5).double(), rtol=1e-7, atol=0)
    assert spread["b"].tolist() == [1.0] * 4
    assert recording.observed.sum() == 7
    assert recording.y[3] == 5


def test_masked_by_output():
    recording = Recording(x=T, y={"a": X, "b": [5.0, 6.0, 8.0]})
    part = recording.masked([True, False, True, False, False, False])
    assert part.observed.tolist() == [True, False, True, False, False, False]
    assert torch.equal(part.split(part.spread)["b"], recording.split(recording.spread)["b"])
    assert part.split(part.spread)["a"][0].item() == pytest.approx(np.std([1, 2], ddof=1))
    assert "output    b: nothing observed" in repr(part)


def test_masks_add_up():
    recording = Recording(x=range(4), y=[1, 2, 3, 4])
    part = recording.masked([True, True, True, False]).masked([False, True, True, True])
    assert part.observed.tolist() == [False, True, True, False]


def test_masked_runs_stay_whole():
    recording = Recording(runs=three(), noise=0.1)
    keep = torch.ones(18, dtype=torch.bool)
    keep[[1, 4, 9, 17]] = False
    part = recording.masked(keep)
    assert torch.equal(part.observed, recording.observed & keep)
    assert torch.equal(part.y.isnan(), ~part.observed)
    assert [r.outputs["x"].isnan().nonzero().flatten().tolist() for r in part.runs] == [[1], [1], []]
    assert [list(r.outputs) for r in part.runs] == [["x", "v"], ["x"], ["v", "x"]]
    assert part.runs[0].outputs["v"].isnan().tolist() == [True, False, False]
    assert part.runs[2].outputs["v"].isnan().tolist() == [False, False, False, True]
    for before, after in zip(recording.runs, part.runs, strict=True):
        assert torch.equal(before.time, after.time)
        assert torch.equal(before.inputs["f"], after.inputs["f"])
        assert (before.initial, before.hold) == (after.initial, after.hold)
        assert not before.outputs["x"].isnan().any()
    assert torch.equal(part.time, recording.time)
    again = Recording(runs=part.runs, noise=0.1, missing=True)
    torch.testing.assert_close(again.y, part.y, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(again.spread, part.spread)


@pytest.mark.parametrize(
    "keep", [[0, 1], [True, False], [[True, True, True]], True, torch.ones(3), [True] * 4, [True] * 9]
)
def test_masked_refuses_what_is_not_a_mask(keep):
    with pytest.raises(ShapeError, match=r"keep of dtype bool and shape \(3,\) or \(6,\)\. Got"):
        Recording(x=T, y={"a": X, "b": X}).masked(keep)


def test_masked_leaves_two():
    recording = Recording(runs=[run(outputs={"x": [1, 2, NAN]})], missing=True)
    with pytest.raises(RecordingError, match=r"at least 2 observed values to keep\. Got 1"):
        recording.masked([False, True, True])


def test_no_subset_in_time():
    with pytest.raises(RecordingError, match=r"static recording\. Got one in time.*use masked"):
        Recording(runs=[run()]).subset([True, True, False])


# --- units, frames ----------------------------------------------------------------------------------


def test_units_are_converted_in_every_run():
    pint = pytest.importorskip("pint")
    quantity = pint.UnitRegistry().Quantity
    one = Run(quantity([0, 1, 2], "min"), {"x": quantity([1, 2, 3], "mm")}, {"f": quantity([1, 2, 3], "kN")})
    two = Run(quantity([0, 30, 60], "s"), {"x": quantity([1, 2, 3], "m")}, {"f": quantity([1, 2, 3], "N")})
    assert one.units == {"time": "minute", "x": "millimeter", "f": "kilonewton"}
    assert one.inputs_at(quantity(30, "s"))["f"].item() == pytest.approx(1.5)
    recording = Recording(runs=[one, two], units={"time": "s", "x": "m", "f": "N"}, noise=quantity(1, "mm"))
    assert recording.units == {"time": "s", "x": "m"}
    torch.testing.assert_close(recording.time, tensor([0, 60, 120, 0, 30, 60]))
    torch.testing.assert_close(recording.y, tensor([1e-3, 2e-3, 3e-3, 1, 2, 3]))
    torch.testing.assert_close(recording.noise_sd, tensor([1e-3] * 6))
    torch.testing.assert_close(recording.runs[0].inputs["f"], tensor([1e3, 2e3, 3e3]))
    torch.testing.assert_close(recording.runs[0].inputs_at(30.0)["f"], tensor(1500.0))
    assert recording.runs[1].units == {"time": "s", "x": "m", "f": "N"}
    first = Recording(runs=[one, two])
    assert first.units == {"time": "minute", "x": "millimeter"}
    torch.testing.assert_close(first.y, tensor([1, 2, 3, 1e3, 2e3, 3e3]))
    torch.testing.assert_close(first.time, tensor([0, 1, 2, 0, 0.5, 1]))
    torch.testing.assert_close(one.time, tensor([0, 1, 2]))
    again = Recording(runs=first.runs, units={"x": "m"})
    torch.testing.assert_close(again.y, recording.y)
    assert pickle.loads(pickle.dumps(first)).units == first.units
    with pytest.raises(RecordingError, match=r"outputs\['x'\] of run 0 in a unit that converts to 'K'\. Got 'milli"):
        Recording(runs=[one, two], units={"x": "K"})
    with pytest.raises(RecordingError, match=r"initial\['x'\]: a number without a unit\. Got 1 meter"):
        Run(T, {"x": X}, initial={"x": quantity(1, "m")})


def test_temperatures_have_an_offset():
    pint = pytest.importorskip("pint")
    xarray = pytest.importorskip("xarray")
    quantity = pint.UnitRegistry().Quantity
    one = Run(T, {"T": quantity([0, 10, 20], "degC")})
    two = Run(T, {"T": xarray.DataArray(quantity([300, 310, 320], "K"), dims="t")})
    torch.testing.assert_close(
        Recording(runs=[one, two], units={"T": "K"}).y, tensor([273.15, 283.15, 293.15, 300, 310, 320])
    )


def test_units_that_are_words():
    xarray = pytest.importorskip("xarray")

    def one(unit):
        attributes = {} if unit is None else {"units": unit}
        return Run(T, {"x": xarray.DataArray(X, dims="t", attrs=attributes)})

    assert Recording(runs=[one("m"), one("m")]).units == {"x": "m"}
    assert Recording(runs=[one("m"), one(None)], units={"x": "m"}).runs[1].units == {"x": "m"}
    with pytest.raises(RecordingError, match=r"outputs\['x'\] of run 1 in 'm'\. Got 'mm'"):
        Recording(runs=[one("m"), one("mm")])
    with pytest.raises(RecordingError, match=r"outputs\['x'\] of run 0 in 'm'\. Got 'mm'"):
        Recording(runs=[one("mm")], units={"x": "m"})
    with pytest.raises(RecordingError, match=r"'x' with a unit in every run, or in none\. Got .m. in run 1 and no"):
        Recording(runs=[one(None), one("m")])
    lacks = Run(T, {"v": X})
    assert Recording(runs=[lacks, one("m")]).units == {"x": "m"}
    dataset = xarray.Dataset({"x": ("t", X), "v": ("t", X)})
    assert list(Run(T, dataset).outputs) == ["x", "v"]


def test_masked_arrays_are_missing_samples():
    one = Run(T, {"x": np.ma.array(X, mask=[False, True, False])})
    assert Recording(runs=[one], missing=True).observed.tolist() == [True, False, True]


def test_from_frame():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(
        {"t": [0, 1, 0, 2], "x": [1, 2, 3, 4], "v": [5, None, 7, 8], "f": [0, 0, 1, 1], "which": [0, 0, 1, 1]}
    )
    runs = [
        Run.from_frame(rows, "t", ["x", "v"], "f", initial={"x": rows["x"].iloc[0]}, hold="zero")
        for _, rows in frame.groupby("which")
    ]
    recording = Recording(runs=runs, missing=True)
    assert recording.time.tolist() == [0, 1, 0, 2]
    assert recording.split(recording.y)["x"].tolist() == [1, 2, 3, 4]
    assert recording.observed.tolist() == [True] * 5 + [False] + [True] * 2
    assert recording.runs[1].initial == {"x": 3.0}
    assert recording.runs[1].hold == "zero"
    assert Run.from_frame(frame[:2], "t", "x").inputs == {}
    with pytest.raises(RecordingError, match=r"columns among .*Got 'time'"):
        Run.from_frame(frame, "time", "x")
    with pytest.raises(RecordingError, match=r"each column once\. Got 'x' twice"):
        Run.from_frame(frame, "t", "x", ["x"])
    with pytest.raises(RecordingError, match=r"a data frame\. Got dict \(use Run"):
        Run.from_frame({"t": T}, "t", "x")
    with pytest.raises(RecordingError, match="increase strictly"):
        Run.from_frame(frame, "t", "x")


# --- like any other recording -----------------------------------------------------------------------


def test_a_static_simulator_calibrates_on_it_and_the_result_is_stored(tmp_path):
    pytest.importorskip("h5netcdf")
    xarray = pytest.importorskip("xarray")
    simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["time"], [tc.Parameter("a"), tc.Parameter("b")])
    time = np.linspace(0, 1, 6)
    force = xarray.DataArray(np.zeros(6), dims="t", attrs={"units": "N"})
    runs = [Run(time, {"u": 1 + 2 * time + shift * time**2}, {"f": force}) for shift in (0.3, 0.5)]
    recording = Recording(runs=runs, units={"time": "s", "u": "m"}, noise=0.01).masked([True] * 10 + [False] * 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tc.errors.ConvergenceWarning)
        warnings.simplefilter("ignore", tc.errors.ToleranceWarning)
        result = tc.calibrate(simulator, recording, num_samples=0, num_starts=4, seed=0, progress=False)
    result.save(tmp_path / "result.nc")
    loaded = type(result).load(tmp_path / "result.nc").recording
    torch.testing.assert_close(loaded.y, recording.y, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(loaded.x["run"], recording.x["run"])
    assert torch.equal(loaded.spread, recording.spread)
    assert loaded.units == recording.units == {"time": "s", "u": "m"}
    assert len(loaded.runs) == 2
