"""Recordings: what they accept, what they refuse and with which words."""

import copy
import dataclasses
import pickle
import sys

import numpy as np
import pytest
import torch

from torchcal.data import Recording, Run
from torchcal.errors import DomainError, MissingDependencyError, RecordingError, ShapeError, TorchcalError

NAN, INF = float("nan"), float("inf")
X = [0.0, 1.0, 2.0]
Y = [1.0, 3.0, 2.0]


SCALES = {
    "m": ("length", 1.0, 0.0),
    "mm": ("length", 1e-3, 0.0),
    "K": ("temperature", 1.0, 0.0),
    "degC": ("temperature", 1.0, 273.15),
}


class Quantity:
    """The part of a pint Quantity that a recording uses, for lengths and temperatures."""

    def __init__(self, magnitude, units):
        self.magnitude, self.units = np.asarray(magnitude, dtype=float), units

    def to(self, unit):
        kind, scale, offset = SCALES[self.units]
        other, to_scale, to_offset = SCALES[unit]
        if kind != other:
            raise TypeError(f"cannot convert {kind} to {other}")
        return Quantity((self.magnitude * scale + offset - to_offset) / to_scale, unit)


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


# --- what comes out ---------------------------------------------------------------------------------


def test_one_condition_one_output():
    recording = Recording(x=X, y=Y)
    assert torch.equal(recording.x, tensor(X))
    assert torch.equal(recording.y, tensor(Y))
    assert recording.x.dtype == recording.y.dtype == recording.spread.dtype == torch.float64
    assert (recording.n, recording.outputs, recording.conditions) == (3, ("y",), ("x",))
    assert recording.noise is None
    assert recording.noise_sd is None
    assert recording.observed.tolist() == [True] * 3
    assert (recording.units, recording.missing) == ({}, False)


def test_several_conditions_and_outputs_stand_in_the_order_given():
    recording = Recording(x={"T0": X, "phi": [1, 1, 2]}, y={"b": Y, "a": [7, 8, 9]})
    assert list(recording.x) == list(recording.conditions) == ["T0", "phi"]
    assert recording.outputs == ("b", "a")
    assert recording.y.tolist() == [1, 3, 2, 7, 8, 9]
    assert recording.n == 3


@pytest.mark.parametrize(
    "convert",
    [
        tuple,
        np.array,
        lambda v: np.array(v, dtype=np.float32),
        lambda v: np.array(v, dtype=np.longdouble),
        lambda v: np.array(v, dtype=np.uint8),
        lambda v: np.array(v, dtype=">f8"),
        lambda v: np.array(v[::-1])[::-1],
        lambda v: [int(value) for value in v],
        lambda v: torch.tensor(v, dtype=torch.float16),
        lambda v: torch.tensor(v, dtype=torch.int64),
        lambda v: torch.tensor(v, requires_grad=True),
        lambda v: torch.nn.Parameter(torch.tensor(v)),
        lambda v: [torch.tensor(value) for value in v],
    ],
)
def test_real_arrays_of_any_kind(convert):
    recording = Recording(x=convert(X), y=convert(Y), noise=convert([1.0, 2.0, 3.0]))
    for got, wanted in ((recording.x, X), (recording.y, Y), (recording.noise_sd, [1.0, 2.0, 3.0])):
        assert torch.equal(got, tensor(wanted))
        assert type(got) is torch.Tensor
        assert not got.requires_grad


def test_arrays_are_copied():
    x, y, sd = tensor(X), np.array(Y), np.ones(3)
    recording = Recording(x=x, y=y, noise=sd)
    x[0], y[0], sd[0] = 99, 99, 99
    assert (recording.x[0], recording.y[0], recording.noise_sd[0]) == (0, 1, 1)


def test_frozen_and_copyable():
    recording = Recording(x={"a": X}, y=Y, noise=0.1, units={"a": "m"})
    for name in ("x", "y", "noise", "noise_sd", "spread", "new"):
        with pytest.raises((dataclasses.FrozenInstanceError, AttributeError)):
            setattr(recording, name, 1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        del recording.y
    for twin in (copy.deepcopy(recording), pickle.loads(pickle.dumps(recording))):
        assert torch.equal(twin.y, recording.y)
        assert torch.equal(twin.noise, recording.noise)
        assert repr(twin) == repr(recording)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_arrays_on_an_accelerator_are_copied_from_there():
    recording = Recording(x=X, y=torch.tensor(Y, device="cuda"), noise=[1, 2, 3])
    tensors = (recording.x, recording.y, recording.noise_sd, recording.observed, recording.spread)
    assert {t.device.type for t in tensors} == {"cpu"}
    assert recording.subset(torch.tensor([True, False, True], device="cuda")).n == 2


# --- missing samples --------------------------------------------------------------------------------


def test_nan_is_missing_where_declared():
    recording = Recording(x=X, y={"a": [1, NAN, 3], "b": [4, 5, NAN]}, missing=True)
    assert recording.observed.tolist() == [True, False, True, True, True, False]
    assert torch.equal(torch.isnan(recording.y), ~recording.observed)
    assert torch.isfinite(recording.spread).all()


def test_masked_entries_are_missing():
    y = np.ma.array([1, 2, 3], mask=[False, True, False])
    assert Recording(x=X, y=y, missing=True).observed.tolist() == [True, False, True]
    with pytest.raises(RecordingError, match=r"in y\. Got nan at index 1.*missing=True"):
        Recording(x=X, y=y)


def test_complete_data_may_be_declared_incomplete():
    assert Recording(x=X, y=Y, missing=True).observed.all()


# --- noise ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("noise", "wanted"),
    [
        (0.5, [0.5] * 4),
        (2, [2.0] * 4),
        (np.float32(0.5), [0.5] * 4),
        (torch.tensor(0.5), [0.5] * 4),
        ([1.0, 2.0], [1.0, 2.0, 1.0, 2.0]),
        ([1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0]),
        ({"b": 3.0, "a": [1.0, 2.0]}, [1.0, 2.0, 3.0, 3.0]),
    ],
)
def test_noise_sd_of_two_outputs(noise, wanted):
    recording = Recording(x=[0, 1], y={"a": [1, 2], "b": [3, 4]}, noise=noise)
    assert torch.equal(recording.noise_sd, tensor(wanted))
    assert recording.noise is recording.noise_sd


def test_no_noise():
    recording = Recording(x=X, y=Y, noise="none")
    assert recording.noise == "none"
    assert recording.noise_sd is None


# --- spread -----------------------------------------------------------------------------------------


def test_spread_is_each_outputs_sd_over_what_was_observed():
    recording = Recording(x=X, y={"a": [1, NAN, 3], "b": [10, 20, 60]}, missing=True)
    spread = recording.split(recording.spread)
    torch.testing.assert_close(spread["a"], torch.full((3,), 2**0.5, dtype=torch.float64))
    torch.testing.assert_close(spread["b"], torch.full((3,), float(np.std([10, 20, 60], ddof=1))).double())


@pytest.mark.parametrize(
    ("y", "wanted"),
    [
        ([0.1, 0.1, 0.1], 0.1),
        ([0.3, 0.1 + 0.2, 0.3], 0.3),  # but for rounding
        ([-4, -4, -4], 4.0),
        ([0, 0, 0], 1.0),
        ([1e-200, 2e-200, 3e-200], 1e-200),
        ([-1e308, 0, 1e308], 1e308),
    ],
)
def test_spread_is_positive_and_finite(y, wanted):
    spread = Recording(x=X, y=y).spread
    torch.testing.assert_close(spread, torch.full((3,), wanted, dtype=torch.float64), rtol=1e-12, atol=0)


# --- split and subset -------------------------------------------------------------------------------


def test_split_keeps_batch_dimensions_and_gradients():
    recording = Recording(x=X, y={"a": Y, "b": Y})
    values = torch.arange(48.0).reshape(2, 4, 6).requires_grad_()
    parts = recording.split(values)
    assert list(parts) == ["a", "b"]
    assert torch.equal(torch.cat(list(parts.values()), dim=-1), values)
    parts["b"].sum().backward()
    assert values.grad.sum(dim=(0, 1)).tolist() == [0, 0, 0, 8, 8, 8]


@pytest.mark.parametrize("values", [torch.zeros(5), torch.zeros(6, 3), torch.tensor(1.0), [0.0] * 6])
def test_split_refuses_other_shapes(values):
    with pytest.raises(ShapeError, match=r"shape \(\.\.\., 6\)"):
        Recording(x=X, y={"a": Y, "b": Y}).split(values)


@pytest.mark.parametrize("convert", [list, np.array, torch.tensor])
def test_subset(convert):
    recording = Recording(
        x={"T": [1, 2, 3, 4]},
        y={"a": [1, NAN, 3, 4], "b": [5, 6, 7, 8]},
        noise=list(range(1, 9)),
        missing=True,
        units={"a": "s"},
    )
    part = recording.subset(convert([True, True, False, True]))
    assert part.n == 3
    assert part.x["T"].tolist() == [1, 2, 4]
    assert part.observed.tolist() == [True, False, True, True, True, True]
    assert part.y[3:].tolist() == [5, 6, 8]
    assert part.noise_sd.tolist() == [1, 2, 4, 5, 6, 8]
    assert (part.units, part.outputs, part.missing) == ({"a": "s"}, ("a", "b"), True)
    assert recording.n == 4


@pytest.mark.parametrize("noise", [None, "none"])
def test_subset_of_a_plain_recording_stays_plain(noise):
    part = Recording(x=X, y=Y, noise=noise).subset([True, False, True])
    assert part.x.tolist() == [0, 2]
    assert part.outputs == ("y",)
    assert part.noise == noise


@pytest.mark.parametrize("mask", [[0, 1], [True, False], [[True, True, True]], True, torch.ones(3)])
def test_subset_refuses_what_is_not_a_mask(mask):
    with pytest.raises(ShapeError, match=r"dtype bool and shape \(3,\)"):
        Recording(x=X, y=Y).subset(mask)


def test_subset_of_one_condition_is_one_data_point():
    with pytest.raises(RecordingError, match=r"at least 2 data points\. Got 1"):
        Recording(x=X, y=Y).subset([True, False, False])


# --- what is refused --------------------------------------------------------------------------------

REFUSED = {
    "no y": ({"y": None}, RecordingError, r"Expected y: .*Got None"),
    "no x": ({"x": None}, RecordingError, r"Expected x: .*Got None"),
    "nan in y": ({"y": [1, NAN, NAN]}, RecordingError, r"in y\. Got nan at index 1, 2 of 3.*missing=True"),
    "nan in named y": (
        {"y": {"a": Y, "b": [1, 2, NAN]}},
        RecordingError,
        r"in y\['b'\]\. Got nan at index 2",
    ),
    "nan in x": ({"x": [0, NAN, 1]}, RecordingError, r"in x\. Got nan at index 1.*condition must be known"),
    "nan in x, missing": (
        {"x": {"T": [0, NAN, 1]}, "missing": True},
        RecordingError,
        r"in x\['T'\]\. Got nan at index 1.*condition must be known",
    ),
    "inf in x": ({"x": [0, 1, INF]}, RecordingError, r"in x\. Got inf at index 2"),
    "inf in y": ({"y": [-INF, 1, NAN]}, RecordingError, r"in y\. Got -inf at index 0"),
    "inf in y, missing": (
        {"y": [1, INF, NAN], "missing": True},
        RecordingError,
        r"in y\. Got inf at index 1",
    ),
    "too large for float64": ({"y": [1, 2, 10**400]}, RecordingError, r"Expected y as real numbers"),
    "lengths": ({"y": [1, 2]}, RecordingError, r"one length\. Got x: 3, y: 2"),
    "lengths within x": ({"x": {"T": X, "p": [1, 2]}}, RecordingError, r"T: 3, p: 2, y: 3"),
    "lengths within y": ({"y": {"a": Y, "b": [1, 2]}}, RecordingError, r"x: 3, a: 3, b: 2"),
    "scalar y": ({"y": 1.0}, ShapeError, r"Expected y of shape \(n,\)\. Got a scalar"),
    "scalar x": ({"x": torch.tensor(1)}, ShapeError, r"Expected x of shape \(n,\)\. Got a scalar"),
    "2-D y": ({"y": [[1], [2], [3]]}, ShapeError, r"Expected y of shape \(n,\)\. Got shape \(3, 1\)"),
    "2-D x": ({"x": {"T": torch.zeros(1, 3)}}, ShapeError, r"Expected x\['T'\] .*Got shape \(1, 3\)"),
    "ragged": ({"y": [[1, 2], [3]]}, ShapeError, r"Expected y: an array.*Got list"),
    "complex tensor": ({"y": torch.zeros(3, dtype=torch.complex64)}, RecordingError, r"y as real.*complex64"),
    "complex array": ({"x": np.zeros(3, dtype=complex)}, RecordingError, r"x as real.*complex128"),
    "bool tensor": ({"y": torch.ones(3) > 0}, RecordingError, r"y as real.*torch\.bool"),
    "bool list": ({"y": [True, False, True]}, RecordingError, r"y as real.*dtype bool"),
    "sparse": ({"y": torch.eye(3)[0].to_sparse()}, RecordingError, r"y as real.*sparse"),
    "text": ({"y": ["1", "x", "3"]}, RecordingError, r"y as real numbers.*'x' at index 1"),
    "numbers as text": ({"y": ["1", "2", "3"]}, RecordingError, r"y as real numbers.*dtype <U1"),
    "a string": ({"y": "data"}, RecordingError, r"y as real numbers.*'data' at index 0"),
    "None within": ({"y": [1.0, 2.0, None]}, RecordingError, r"None at index 2.*missing sample is NaN"),
    "None as array": ({"y": {"a": None}}, RecordingError, r"Expected y\['a'\].*None at index 0"),
    "dates": ({"x": np.arange(3).astype("M8[s]")}, RecordingError, r"x as real numbers.*datetime64.*as seconds"),
    "generator": ({"y": (v for v in Y)}, RecordingError, r"Expected y as real.*object"),
    "list of quantities": ({"x": [Quantity(1, "m")] * 3}, RecordingError, r"a Quantity at index 0"),
    "one data point": ({"x": [1], "y": [1]}, RecordingError, r"at least 2 data points\. Got 1"),
    "no data points": ({"x": [], "y": []}, RecordingError, r"at least 2 data points\. Got 0"),
    "all missing": (
        {"y": [NAN] * 3, "missing": True},
        RecordingError,
        r"output 'y'\. Got 3 missing samples of 3",
    ),
    "one output missing": (
        {"y": {"a": Y, "b": [NAN] * 3}, "missing": True},
        RecordingError,
        r"output 'b'\. Got 3 missing",
    ),
    "one observed": (
        {"y": [NAN, 1, NAN], "missing": True},
        RecordingError,
        r"2 data points\. Got 1, the others",
    ),
    "missing is an array": (
        {"missing": [True] * 3},
        RecordingError,
        r"missing=True or missing=False\. Got list",
    ),
    "empty dict y": ({"y": {}}, RecordingError, r"Expected y .*Got an empty dict"),
    "empty dict x": ({"x": {}}, RecordingError, r"Expected x .*Got an empty dict"),
    "name not a string": ({"x": {1: X}}, RecordingError, r"names in x.*Got 1"),
    "empty name": ({"y": {"": Y}}, RecordingError, r"names in y.*Got ''"),
    "same name": ({"x": {"a": X}, "y": {"a": Y}}, RecordingError, r"different names\. Got 'a' in both"),
    "output called x": ({"y": {"x": Y}}, RecordingError, r"Got 'x' in both.*called 'x' as condition"),
    "condition called y": ({"x": {"y": X}}, RecordingError, r"Got 'y' in both.*'y' as output"),
    "units of unknown": ({"units": {"T": "K"}}, RecordingError, r"among \['x', 'y'\]\. Got 'T'"),
    "units not a dict": ({"units": "m"}, RecordingError, r"Expected units: a dict\. Got 'm'"),
    "unit not a string": ({"units": {"x": 1}}, RecordingError, r"unit of 'x'\. Got 1"),
    "runs beside x": ({"runs": []}, RecordingError, r"x= and y=, or runs=\. Got runs= and x="),
    "noise zero": ({"noise": 0.0}, DomainError, r'Expected noise as finite sd > 0\. Got 0\.0 .*noise="none"'),
    "noise negative": ({"noise": [1, -2, -3]}, DomainError, r'Got -2\.0 at index 1.*noise="none"'),
    "noise nan": ({"noise": NAN}, DomainError, r'Got nan .*noise="none"'),
    "noise inf": ({"noise": [1, 1, INF]}, DomainError, r"Got inf at index 2"),
    "noise by name": ({"noise": {"y": [0, 1, 1]}}, DomainError, r"noise\['y'\] .*Got 0\.0 at index 0"),
    "noise string": ({"noise": "None"}, RecordingError, r"Got 'None' .*noise=\"none\""),
    "noise length": ({"noise": [1, 2]}, ShapeError, r"noise: a number or shape \(3,\)\. Got shape \(2,\)"),
    "noise 2-D": ({"noise": [[1, 1, 1]]}, ShapeError, r"Got shape \(1, 3\)"),
    "noise of an unknown output": ({"noise": {"z": 1.0}}, RecordingError, r"outputs \['y'\]\. Got \['z'\]"),
    "noise of some outputs": (
        {"y": {"a": Y, "b": Y}, "noise": {"a": 1.0}},
        RecordingError,
        r"outputs \['a', 'b'\]\. Got \['a'\]",
    ),
    "noise dict, length n_total": (
        {"y": {"a": Y, "b": Y}, "noise": {"a": [1] * 6, "b": 1}},
        ShapeError,
        r"noise\['a'\]: a number or shape \(3,\)\. Got shape \(6,\)",
    ),
    "noise, two outputs": ({"y": {"a": Y, "b": Y}, "noise": [1, 2]}, ShapeError, r"\(3,\) or \(6,\)"),
    "noise bool": ({"noise": True}, RecordingError, r"noise as real numbers.*bool"),
    "noise string in dict": ({"noise": {"y": "none"}}, RecordingError, r"noise\['y'\] as real numbers"),
    "noise quantity, output without": (
        {"noise": Quantity(1, "m")},
        RecordingError,
        r"known unit of output 'y'.*give units=",
    ),
}


@pytest.mark.parametrize(("change", "error", "message"), REFUSED.values(), ids=REFUSED)
def test_refused(change, error, message):
    with pytest.raises(error, match=message) as caught:
        Recording(**({"x": X, "y": Y} | change))
    assert isinstance(caught.value, TorchcalError)
    assert isinstance(caught.value, ValueError)
    assert str(caught.value).startswith("Expected ")


def test_arguments_are_keyword_only():
    with pytest.raises(TypeError):
        Recording(X, Y)


# --- units ------------------------------------------------------------------------------------------


def test_quantities_convert_to_the_declared_unit_or_declare_their_own():
    recording = Recording(
        x={"d": Quantity(X, "m"), "T": Quantity([300, 310, 320], "K")},
        y=Quantity([1000, 2000, 4000], "mm"),
        noise=Quantity(5, "mm"),
        units={"y": "m", "T": "degC"},
    )
    assert recording.units == {"d": "m", "T": "degC", "y": "m"}
    torch.testing.assert_close(recording.y, tensor([1.0, 2.0, 4.0]))
    torch.testing.assert_close(recording.x["T"], tensor([26.85, 36.85, 46.85]))
    torch.testing.assert_close(recording.noise_sd, tensor([0.005] * 3))


def test_a_noise_sd_is_a_difference_of_temperatures():
    recording = Recording(x=X, y=Y, units={"y": "degC"}, noise=Quantity([0.5, 1.0, 2.0], "K"))
    torch.testing.assert_close(recording.noise_sd, tensor([0.5, 1.0, 2.0]))


def test_noise_converts_to_the_unit_of_each_output():
    recording = Recording(x=X, y={"a": Y, "b": Y}, units={"a": "m", "b": "mm"}, noise=Quantity(1, "mm"))
    torch.testing.assert_close(recording.noise_sd, tensor([1e-3] * 3 + [1.0] * 3))


def test_a_noise_sd_does_not_convert_between_logarithmic_and_linear_units():
    quantity = pytest.importorskip("pint").UnitRegistry().Quantity
    power = quantity([1.0, 2.0, 3.0], "dBm")
    assert Recording(x=X, y=power, noise=quantity(0.5, "dBm")).noise_sd.tolist() == [0.5] * 3
    assert Recording(x=X, y=power, noise=0.1, units={"y": "mW"}).noise_sd.tolist() == [0.1] * 3
    told = r"Expected noise in a unit that converts to .*one of the two is logarithmic"
    for y, noise, units in [(power, "dBm", {"y": "mW"}), (power, "mW", None), (quantity(Y, "mW"), "dBm", None)]:
        with pytest.raises(RecordingError, match=told):
            Recording(x=X, y=y, noise=quantity(0.5, noise), units=units)


def test_units_that_do_not_convert():
    with pytest.raises(RecordingError, match=r"Expected x in a unit that converts to 'K'\. Got 'm': cannot"):
        Recording(x=Quantity(X, "m"), y=Y, units={"x": "K"})


def test_quantity_errors_are_those_of_its_magnitude():
    with pytest.raises(RecordingError, match=r"in x\. Got nan at index 0"):
        Recording(x=Quantity([NAN, 1, 2], "mm"), y=Y, units={"x": "m"})
    with pytest.raises(ShapeError, match="Expected y of shape"):
        Recording(x=X, y=Quantity(1.0, "m"))


def test_pint():
    pint = pytest.importorskip("pint")
    unit = pint.UnitRegistry()
    quantity = unit.Quantity
    recording = Recording(
        x=quantity(X, "mm"),
        y={"T": quantity([300, 310, 320], "K"), "E": quantity([1, 2, 3], "cal/mol")},
        noise={"T": quantity(0.5, "delta_degC"), "E": quantity(4.184, "J/mol")},
        units={"x": "m", "T": "degC"},
    )
    assert recording.units == {"x": "m", "T": "degC", "E": "calorie / mole"}
    torch.testing.assert_close(recording.x, tensor([0, 1e-3, 2e-3]))
    torch.testing.assert_close(recording.y[:3], tensor([26.85, 36.85, 46.85]))
    torch.testing.assert_close(recording.noise_sd, tensor([0.5] * 3 + [1.0] * 3))
    kelvin = Recording(x=X, y=quantity(Y, "K"), noise=quantity([1, 2, 3], "delta_degC"))
    torch.testing.assert_close(kelvin.noise_sd, tensor([1.0, 2.0, 3.0]))
    rise = Recording(x=X, y=quantity(Y, "delta_degC"), noise=quantity(1, "K"))
    torch.testing.assert_close(rise.noise_sd, tensor([1.0] * 3))
    fahrenheit = Recording(x=X, y=quantity(Y, "degF"), noise=quantity(1, "K"))
    torch.testing.assert_close(fahrenheit.noise_sd, tensor([1.8] * 3))
    with pytest.raises(RecordingError, match=r"converts to 'K'\. Got 'meter'"):
        Recording(x=quantity(X, "m"), y=Y, units={"x": "K"})
    with pytest.raises(RecordingError, match="converts to 'nonsense'"):
        Recording(x=quantity(X, "m"), y=Y, units={"x": "nonsense"})
    xarray = pytest.importorskip("xarray")
    wrapped = xarray.DataArray(quantity(X, "mm"), dims="condition")
    assert Recording(x=wrapped, y=Y, units={"x": "m"}).x.tolist() == [0, 1e-3, 2e-3]
    with pytest.raises(RecordingError, match="a Quantity at index 0"):
        Recording(x=[1 * unit.m, 2 * unit.m, 3 * unit.m], y=Y)


# --- pandas, xarray, CSV ----------------------------------------------------------------------------


def test_xarray():
    xarray = pytest.importorskip("xarray")
    x = xarray.DataArray(X, dims="condition", attrs={"units": "K"})
    recording = Recording(x=x, y=xarray.DataArray(Y, dims="condition"))
    assert recording.units == {"x": "K"}
    assert recording.y.tolist() == Y
    assert Recording(x=x, y=Y, units={"x": "K"}).units == {"x": "K"}
    with pytest.raises(RecordingError, match=r"Expected x in 'degC'\. Got attrs\['units'\] = 'K'"):
        Recording(x=x, y=Y, units={"x": "degC"})
    wrapped = xarray.DataArray(X, dims="condition").copy()
    dataset = xarray.Dataset({"a": wrapped, "b": wrapped})
    assert Recording(x=X, y=dataset).outputs == ("a", "b")


def test_pandas_series_are_matched_by_position():
    pandas = pytest.importorskip("pandas")
    y = pandas.Series([1, 2, None], index=[5, 6, 7], dtype="Float64")
    recording = Recording(x=pandas.Series([3, 1, 2], dtype="Int64"), y=y, missing=True)
    assert recording.x.tolist() == [3, 1, 2]
    assert recording.observed.tolist() == [True, True, False]
    with pytest.raises(RecordingError, match=r"y as real numbers.*'b' at index 1"):
        Recording(x=X, y=pandas.Series(["1", "b", "3"]))


def test_from_frame():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"T0": [800, 900, 1000], "phi": [0.5, 1, 2], "tau": Y, "other": list("abc")})
    units = {"T0": "K", "tau": "s"}
    recording = Recording.from_frame(frame, x=["T0", "phi"], y="tau", noise="none", units=units)
    assert recording.conditions == ("T0", "phi")
    assert recording.outputs == ("tau",)
    assert (recording.noise, recording.units) == ("none", units)
    plain = Recording.from_frame(frame, "T0", ["tau", "phi"], units=units)
    assert plain.x.tolist() == [800, 900, 1000]
    assert plain.units == {"x": "K", "tau": "s"}
    with pytest.raises(RecordingError, match=r"among \['T0', .*Got 'T_0'"):
        Recording.from_frame(frame, x=["T_0"], y="tau")
    with pytest.raises(RecordingError, match=r"each column once\. Got 'tau' twice"):
        Recording.from_frame(frame, x=["tau"], y=["tau"])
    with pytest.raises(RecordingError, match=r"y\['other'\] as real numbers.*'a' at index 0"):
        Recording.from_frame(frame, x="T0", y="other")
    with pytest.raises(RecordingError, match="Got an empty dict"):
        Recording.from_frame(frame, x=[], y="tau")
    with pytest.raises(RecordingError, match=r"a data frame\. Got dict"):
        Recording.from_frame({"T0": X}, x="T0", y="tau")
    twice = pandas.DataFrame([[1, 2, 3], [4, 5, 6]], columns=["a", "b", "b"])
    with pytest.raises(ShapeError, match=r"y\['b'\] of shape \(n,\)\. Got shape \(2, 2\)"):
        Recording.from_frame(twice, x=["a"], y=["b"])


def test_from_csv(tmp_path):
    pytest.importorskip("pandas")
    path = tmp_path / "delays.csv"
    path.write_text("T0, phi, tau\n800, 0.5, 1e-3\n900, 1.0,\n1000, 2.0, 3e-3\n")
    recording = Recording.from_csv(path, x=["T0", "phi"], y=["tau"], missing=True, noise=1e-4)
    assert recording.x["T0"].tolist() == [800, 900, 1000]
    assert recording.observed.tolist() == [True, False, True]
    with pytest.raises(RecordingError, match=r"in y\['tau'\]\. Got nan at index 1"):
        Recording.from_csv(str(path), x=["T0"], y=["tau"])
    with pytest.raises(FileNotFoundError):
        Recording.from_csv(tmp_path / "none.csv", x=["T0"], y=["tau"])


@pytest.mark.parametrize(
    "content", [b"", b"a,b\n1,2\n1,2,3,4\n", b"a,b\n0,1,2\n1,3,4\n", b"a,b\n\xff\xfe,1\n"]
)
def test_from_csv_of_something_else(tmp_path, content):
    pytest.importorskip("pandas")
    path = tmp_path / "broken.csv"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"Expected a CSV file with a header line in .*broken\.csv"):
        Recording.from_csv(path, x=["a"], y=["b"])


def test_from_csv_with_a_delimiter_at_the_end_of_each_line(tmp_path):
    pytest.importorskip("pandas")
    path = tmp_path / "trailing.csv"
    path.write_text("a,b\n1,2,\n3,4,\n")
    recording = Recording.from_csv(path, x="a", y="b")
    assert (recording.x.tolist(), recording.y.tolist()) == ([1, 3], [2, 4])


def test_from_csv_with_two_columns_of_one_name(tmp_path):
    pytest.importorskip("pandas")
    path = tmp_path / "twice.csv"
    path.write_text("a, b, c, b, c.1\n1, 2, 3, 4, 5\n2, 3, 4, 5, 6\n")
    for x, y in (("a", ["c", "b"]), (["b"], "a")):
        with pytest.raises(RecordingError, match=r"one column 'b' in .*twice\.csv\. Got 2 of that name"):
            Recording.from_csv(path, x=x, y=y)
    recording = Recording.from_csv(path, x="a", y=["c", "c.1"])
    assert recording.y.tolist() == [3, 4, 5, 6]


def test_from_csv_without_pandas(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingDependencyError, match="pip install pandas"):
        Recording.from_csv(tmp_path / "any.csv", x=["a"], y=["b"])


# --- printing ---------------------------------------------------------------------------------------


def test_repr():
    recording = Recording(
        x={"T0": [800, 900, 1300], "phi": [1, 1, 1]},
        y={"tau": [1e-5, NAN, 0.3], "p": [1, 2, 3]},
        noise={"tau": [0.1, 0.2, 0.3], "p": 1},
        missing=True,
        units={"T0": "K", "tau": "s"},
    )
    assert repr(recording).splitlines() == [
        "Recording: 3 conditions, 1 of 6 values missing",
        "  condition T0 [K]: 800 to 1300",
        "  condition phi: 1",
        "  output    tau [s]: 1e-05 to 0.3, noise sd 0.1 to 0.3",
        "  output    p: 1 to 3, noise sd 1",
    ]
    assert repr(Recording(x=X, y=Y)).splitlines()[-1] == "  noise     unknown"
    assert repr(Recording(x=X, y=Y, noise="none")).splitlines()[-1] == "  noise     none"


def test_copies_of_rows():
    x, y = [1.0, 2.0, 3.0, 4.0, 5.0], [0.5, 0.7, 0.1, 0.3, 0.6]
    twice = Recording(x=x + x, y=y + y)
    assert twice.copies.tolist() == [False] * 5 + [True] * 5
    assert torch.equal(twice.observed_once, ~twice.copies)
    assert int(Recording(x=x * 3, y=y * 3).copies.sum()) == 10
    assert not Recording(x=x, y=y).copies.any()
    assert not Recording(x=x + x, y=[*y, *y[:4], 0.8]).copies.any()  # replicates
    assert not Recording(x=x + x, y=y + y, noise=0.1).copies.any()  # of which readings may agree
    assert not Recording(x=[1.0] * 10, y=[0.5] * 10).copies.any()  # one reading, ten times
    assert not Recording(x=x[:3] * 2, y=y[:3] * 2).copies.any()
    missing = {"a": y + y, "b": [1.0, np.nan, np.nan, 2.0, 3.0] * 2}
    both = Recording(x=x + x, y=missing, missing=True)
    assert both.copies.tolist() == [False] * 5 + [True] * 5
    assert int(both.observed_once.sum()) == 8


def test_copies_of_runs():
    t, h = [0.0, 1.0, 2.0, 3.0, 4.0], [0.5, 0.7, np.nan, 0.3, 0.6, 0.2]

    def run(**changes):
        return Run(**{"time": [*t, 5.0], "outputs": {"h": h}, "inputs": {"q": [*t, 1.0]}, **changes})

    twice = Recording(runs=[run(), run(initial={"h": 1.0}), run()], missing=True)
    assert twice.copies.tolist() == [False] * 12 + [True] * 6
    assert not Recording(runs=[run(), run()], missing=True, noise=0.1).copies.any()
    changed = {"time": [*t, 6.0], "outputs": {"h": [*h[:5], 0.3]}, "inputs": {"q": [*t, 2.0]}, "hold": "zero"}
    for other in ({name: value} for name, value in changed.items()):
        assert not Recording(runs=[run(), run(**other)], missing=True).copies.any()
    short = Run(time=t[:4], outputs={"h": h[2:]}, inputs={"q": t[:4]})
    assert not Recording(runs=[short, short], missing=True).copies.any()
