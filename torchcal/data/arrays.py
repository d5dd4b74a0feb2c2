"""Arrays of any kind as checked float64 tensors."""

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from torchcal.errors import RecordingError, ShapeError

__all__ = [
    "ROUNDING",
    "check_finite",
    "check_lengths",
    "declared_units",
    "is_quantity",
    "named",
    "same_unit",
    "sample_spread",
    "to_tensor",
    "unit_of",
    "value_range",
]

ROUNDING = 16 * torch.finfo(torch.float64).eps
"""Relative sd and difference up to which numbers are one but for rounding: a sum that some hundred steps conserve is
off by a few epsilon."""


#: Bend of a conversion between units, relative to its numbers, up to which it is linear but for rounding.
LINEAR = 1e-9


def named(given: Any, letter: str) -> dict[str, Any]:
    """Give an array without a name the name ``letter``; check the names of a dict."""
    if given is None:
        raise RecordingError(f"Expected {letter}: an array or a dict of arrays. Got None (give {letter}=).")
    if not isinstance(given, Mapping):
        return {letter: given}
    if not given:
        raise RecordingError(f"Expected {letter} with an array. Got an empty dict (give {{name: array}}).")
    for name in given:
        if not isinstance(name, str) or not name:
            raise RecordingError(f"Expected names in {letter}: non-empty strings. Got {name!r} (rename it).")
    return dict(given)


def declared_units(units: Any, names: Sequence[str]) -> dict[str, str]:
    """Units by name, or an error for a name that is not there or a unit that is no text."""
    if units is None:
        return {}
    if not isinstance(units, Mapping):
        raise RecordingError(f"Expected units: a dict. Got {units!r} (give units={{name: unit}}).")
    for name, unit in units.items():
        if name not in names:
            raise RecordingError(
                f"Expected units for names among {list(names)}. Got {name!r} (check the spelling)."
            )
        if not isinstance(unit, str):
            raise RecordingError(f"Expected a string as unit of {name!r}. Got {unit!r} (give, say, 'm/s').")
    return dict(units)


def is_quantity(value: Any) -> bool:
    """Whether a value has a magnitude and a unit, as pint's have."""
    return hasattr(value, "magnitude") and hasattr(value, "units")


def unit_of(value: Any) -> str | None:
    """The unit of a Quantity, of a DataArray, or of the first of a list of them; None without one."""
    if isinstance(value, list | tuple) and value:
        value = value[0]
    elif not isinstance(value, Tensor) and not is_quantity(value) and hasattr(value, "attrs"):
        if not is_quantity(getattr(value, "data", None)):
            return _spelled(value)
        value = value.data
    return str(value.units) if is_quantity(value) else None


def _spelled(value: Any) -> str | None:
    """The unit that a DataArray or a Series names among its attributes."""
    attributes = getattr(value, "attrs", None)
    spelled = attributes.get("units") if isinstance(attributes, Mapping) else None
    return spelled if isinstance(spelled, str) else None


def to_tensor(
    value: Any, label: str, unit: str | None, *, difference: bool = False
) -> tuple[Tensor, str | None]:
    """Copy to a float64 tensor in ``unit``; also return the unit, where one is known.

    With ``difference`` the value is a difference (an sd): an offset between units (K, degC) is left out.
    """
    if not isinstance(value, Tensor) and not is_quantity(value):
        if hasattr(value, "attrs") and is_quantity(getattr(value, "data", None)):
            value = value.data
        elif (spelled := _spelled(value)) is not None:
            if unit is not None and spelled != unit:
                raise RecordingError(
                    f"Expected {label} in {unit!r}. Got attrs['units'] = {spelled!r} "
                    "(convert it, or spell them alike)."
                )
            unit = spelled
    if not is_quantity(value):
        return _plain(value, label), unit
    if unit is None or unit == str(value.units):
        return _plain(value.magnitude, label), str(value.units)
    try:
        magnitude, zero = _convert(value, unit, difference=difference)
    except Exception as error:  # the unit package is not imported here, so its exceptions have no name
        raise RecordingError(
            f"Expected {label} in a unit that converts to {unit!r}. Got {str(value.units)!r}: {error} "
            "(correct units=, or convert the data)."
        ) from error
    return _plain(magnitude, label) - zero, unit


def _convert(value: Any, unit: str, *, difference: bool) -> tuple[Any, float]:
    """Magnitude in ``unit``, and what to take off it: where zero goes, if the value is a difference."""
    if not difference:
        return value.to(unit).magnitude, 0.0
    # pint keeps differences apart as "delta_degC", and does not convert them to "degC"
    source, target = str(value.units).removeprefix("delta_"), unit.removeprefix("delta_")
    one, two, three = (float(type(value)(number, source).to(target).magnitude) for number in (1.0, 2.0, 3.0))
    if abs(three - 2 * two + one) > LINEAR * max(abs(one), abs(two), abs(three)):
        raise ValueError("one of the two is logarithmic, and a difference in one has no size of its own in the other")
    zero = type(value)(0.0, source).to(target).magnitude
    return type(value)(value.magnitude, source).to(target).magnitude, float(zero)


#: Units of time, in seconds.
TIMES = {
    name: size
    for size, names in {
        1e-6: "us µs microsecond microseconds",
        1e-3: "ms millisecond milliseconds",
        1.0: "s sec second seconds",
        60.0: "min minute minutes",
        3600.0: "h hr hrs hour hours",
        86400.0: "d day days",
        31557600.0: "a yr yrs year years",
    }.items()
    for name in names.split()
}


def same_unit(one: str, other: str) -> bool:
    """Whether two texts may be one unit: pint tells, where it is installed and knows both; of times a table."""
    one, other = (text.replace(" ", "") for text in (one, other))
    if one == other:
        return True
    if one in TIMES and other in TIMES:
        return TIMES[one] == TIMES[other]
    try:
        import pint

        registry = pint.get_application_registry()
        a, b = (registry.Quantity(1.0, text).to_base_units() for text in (one, other))
    except Exception:  # not installed, or a text that it does not know
        return True
    return bool(a.units == b.units and abs(a.magnitude - b.magnitude) <= 1e-9 * abs(a.magnitude))


def _plain(value: Any, label: str) -> Tensor:
    """Copy real numbers without a unit to a float64 tensor; refuse every other dtype."""
    if isinstance(value, Tensor):
        if value.dtype == torch.bool or value.is_complex() or value.layout != torch.strided:
            _refuse(label, f"a {value.layout} tensor of {value.dtype}")
        return value.detach().to("cpu", torch.float64, copy=True)
    if isinstance(value, list | tuple):
        for index, entry in enumerate(value):
            if is_quantity(entry):
                _refuse(label, f"a Quantity at index {index}", "give one Quantity that holds an array")
    try:
        array: Any = value.to_numpy() if hasattr(value, "to_numpy") else value
        array = array if isinstance(array, np.ma.MaskedArray) else np.asarray(array)
    except (ValueError, TypeError, RuntimeError) as error:
        raise ShapeError(
            f"Expected {label}: an array of real numbers of shape (n,). Got {type(value).__name__}: {error} "
            "(give rows of equal length, or a tensor)."
        ) from error
    if array.dtype.kind not in "fiu":
        got = f"dtype {array.dtype}{_first_text(array)}"
        if array.dtype.kind in "mM":
            _refuse(label, got, "as seconds they are (t - t[0]) / np.timedelta64(1, 's'); or choose another unit")
        _refuse(label, got)
    if isinstance(array, np.ma.MaskedArray):
        array = np.ma.filled(array.astype(np.float64), np.nan)
    return torch.from_numpy(np.array(array, dtype=np.float64))


def _refuse(label: str, got: str, advice: str = "convert to float; a missing sample is NaN") -> NoReturn:
    raise RecordingError(f"Expected {label} as real numbers, float or integer. Got {got} ({advice}).")


def _first_text(array: np.ndarray) -> str:
    """Where an array of text or objects stops being numbers."""
    if array.dtype.kind in "OSUT":
        for index, entry in enumerate(array.reshape(-1).tolist()):
            try:
                float(entry)
            except (ValueError, TypeError, OverflowError):
                return f", {entry!r} at index {index}"
    return ""


def check_finite(
    array: Tensor, label: str, *, is_output: bool, missing: bool, kind: str = "a condition"
) -> None:
    """Raise for infinite numbers, and for NaN that is not declared missing, naming the first."""
    infinite, nan = torch.isinf(array), torch.isnan(array)
    if infinite.any():
        bad, advice = infinite, "remove the condition, or correct the value"
        if kind != "a condition":
            advice = "remove the sample, or correct the value"
    elif nan.any() and not is_output:
        bad, advice = nan, f"{kind} must be known: remove it, or fill in its value"
    elif nan.any() and not missing:
        bad, advice = nan, "if it marks a missing sample, give missing=True; otherwise correct it"
    else:
        return
    index = int(bad.nonzero()[0])
    raise RecordingError(
        f"Expected finite numbers in {label}. Got {array[index].item()} at index {index}, "
        f"{int(bad.sum())} of {len(array)} entries ({advice})."
    )


def check_lengths(arrays: Mapping[str, Tensor]) -> None:
    """Raise for arrays of unequal lengths, or for fewer than two data."""
    lengths = {name: len(array) for name, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise RecordingError(
            "Expected arrays of one length. Got " + ", ".join(f"{name}: {n}" for name, n in lengths.items())
            + " (one value per condition in each; mark missing outputs by NaN and give missing=True)."
        )  # fmt: skip
    if (n := min(lengths.values())) < 2:
        raise RecordingError(f"Expected at least 2 data points. Got {n} (one data point cannot calibrate).")


def sample_spread(values: Tensor) -> Tensor:
    """Sample sd, scaled first so that its squares neither vanish nor overflow; of a constant its size."""
    scale = values.abs().max()
    if bool(values.min() < values.max()):
        relative = (values / scale).std()
        sd = relative * scale
        if bool(relative > ROUNDING) and bool(sd > 0) and bool(torch.isfinite(sd)):
            return sd
    return scale if bool(scale > 0) else torch.ones_like(scale)


def value_range(values: Tensor) -> str:
    """Smallest and largest value as text."""
    if not len(values):
        return "nothing observed"
    low, high = f"{values.min().item():.4g}", f"{values.max().item():.4g}"
    return low if low == high else f"{low} to {high}"
