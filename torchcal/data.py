"""Recordings: what was measured, under which conditions, and how noisy it is."""

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from torchcal.errors import DomainError, MissingDependencyError, RecordingError, ShapeError

__all__ = ["Recording"]


@dataclass(frozen=True, init=False, repr=False, eq=False)
class Recording:
    """Conditions and measured outputs as float64 tensors. Everything is checked once, here, and copied.

    Arrays may be torch tensors, numpy arrays, lists, pandas Series, xarray DataArrays or pint Quantities
    of any real dtype. They are matched by position; an index or a coordinate is not looked at. Arrays on
    the CPU follow those on an accelerator.

    Args:
        x: Conditions: one array ``(n,)``, or a dict from names to arrays ``(n,)``. Never NaN.
        y: Outputs: one array ``(n,)``, then called ``"y"``, or a dict from names to arrays ``(n,)``.
        noise: ``None`` if unknown, ``"none"`` if there is none (a detailed simulation), else the sd in the
            outputs' units, > 0: a number, an array ``(n,)`` that holds for every output, an array
            ``(n_total,)``, or a dict from output names to numbers or arrays ``(n,)``.
        missing: Whether NaN in an output (or a masked entry of a numpy masked array) is a missing sample.
            Otherwise it is an error.
        units: Dict from condition and output names to units (``"x"`` and ``"y"`` where arrays were given
            without names). A Quantity is converted to its declared unit, or declares its own; a DataArray's
            ``attrs["units"]`` declares a unit too, and must be spelled as the one given here.
        runs: Recordings in time. Not available yet.

    Attributes:
        x: Tensor ``(n,)`` or dict of tensors ``(n,)``, as given.
        y: Tensor ``(n_total,)``, the outputs one after another; NaN where missing.
        noise: ``None``, ``"none"``, or the sd, tensor ``(n_total,)``.
        missing: As given.
        units: Dict from names to units, for the names whose unit is known.
        outputs: Names of the outputs.
        n: Number of conditions; ``n_total = n * len(outputs)``.
        observed: Bool tensor ``(n_total,)``, False where a sample is missing.
        spread: Tensor ``(n_total,)``, > 0: the sample sd (``n - 1``) of the observed data of each output, in
            its unit; the absolute value where the data are constant, and 1 where they are all zero.

    Raises:
        RecordingError: If data are NaN, infinite, not real numbers, too few, of unequal lengths, or misnamed.
        ShapeError: If an array has no or several dimensions, or the noise does not fit the outputs.
        DomainError: If a noise sd is not a positive finite number.

    >>> recording = Recording(x=[0.0, 1.0, 2.0], y={"a": [1, 2, 3], "b": [4, 5, 9]}, noise=0.1)
    >>> recording.y.tolist()
    [1.0, 2.0, 3.0, 4.0, 5.0, 9.0]
    >>> recording.spread[0].item()
    1.0
    """

    x: Tensor | dict[str, Tensor]
    y: Tensor
    noise: Tensor | str | None
    missing: bool
    units: dict[str, str]
    outputs: tuple[str, ...]
    n: int
    observed: Tensor
    spread: Tensor

    def __init__(
        self,
        *,
        x: Any = None,
        y: Any = None,
        noise: Any = None,
        missing: bool = False,
        units: Mapping[str, str] | None = None,
        runs: Any = None,
    ) -> None:
        if runs is not None:
            raise RecordingError(
                "Expected a static recording, x= and y=. Got runs= (recordings in time come later)."
            )
        if not isinstance(missing, bool | np.bool_):
            raise RecordingError(
                f"Expected missing=True or missing=False. Got {type(missing).__name__} "
                "(mark missing samples by NaN in y and give missing=True)."
            )
        given_x, given_y = _named(x, "x"), _named(y, "y")
        if both := [name for name in given_y if name in given_x]:
            raise RecordingError(
                f"Expected outputs and conditions with different names. Got {both[0]!r} in both (rename one; "
                "an array without a name is called 'x' as condition, 'y' as output: give a dict to name it)."
            )
        declared = _declared_units(units, [*given_x, *given_y])

        known: dict[str, str] = {}
        arrays: dict[str, Tensor] = {}
        for letter, given, original in (("x", given_x, x), ("y", given_y, y)):
            for name, values in given.items():
                label = f"{letter}[{name!r}]" if isinstance(original, Mapping) else letter
                array, unit = _tensor(values, label, declared.get(name))
                if array.ndim != 1:
                    what = "a scalar" if array.ndim == 0 else f"shape {tuple(array.shape)}"
                    raise ShapeError(
                        f"Expected {label} of shape (n,). Got {what} (give one value per condition; several "
                        "conditions or outputs go into a dict from names to arrays)."
                    )
                _check_finite(array, label, is_output=letter == "y", missing=bool(missing))
                arrays[name] = array
                if unit is not None:
                    known[name] = unit
        _check_lengths(arrays)
        n = len(next(iter(arrays.values())))
        device = _common_device(arrays)
        arrays = {name: array.to(device) for name, array in arrays.items()}

        observed = {name: ~torch.isnan(arrays[name]) for name in given_y}
        for name, mask in observed.items():
            if not mask.any():
                raise RecordingError(
                    f"Expected observed values of output {name!r}. Got {n} missing samples of {n} "
                    "(leave the output out, or check where the NaN come from)."
                )
        if sum(int(mask.sum()) for mask in observed.values()) < 2:
            raise RecordingError(
                "Expected at least 2 data points. Got 1, the others are missing "
                "(one data point cannot calibrate anything)."
            )

        put = object.__setattr__
        put(self, "x", {name: arrays[name] for name in given_x} if isinstance(x, Mapping) else arrays["x"])
        put(self, "y", torch.cat([arrays[name] for name in given_y]))
        put(self, "missing", bool(missing))
        put(self, "units", known)
        put(self, "outputs", tuple(given_y))
        put(self, "n", n)
        put(self, "observed", torch.cat(list(observed.values())))
        put(self, "spread", torch.cat([_spread(arrays[name][observed[name]]).expand(n) for name in given_y]))
        put(self, "noise", _noise(noise, tuple(given_y), n, known, device))

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions; ``("x",)`` where they are one array without a name."""
        return tuple(self.x) if isinstance(self.x, dict) else ("x",)

    @property
    def noise_sd(self) -> Tensor | None:
        """Noise sd, shape ``(n_total,)``, in the outputs' units; None if unknown or if there is none."""
        return self.noise if isinstance(self.noise, Tensor) else None

    def split(self, values: Tensor) -> dict[str, Tensor]:
        """Take values of all outputs apart.

        Args:
            values: Shape ``(*batch, n_total)``, in the order of ``y``.

        Returns:
            Dict from output names to views of shape ``(*batch, n)``.

        Raises:
            ShapeError: If the last dimension is not ``n_total``.
        """
        total = self.n * len(self.outputs)
        if not isinstance(values, Tensor) or values.ndim == 0 or values.shape[-1] != total:
            got = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
            raise ShapeError(
                f"Expected values: a tensor of shape (..., {total}). Got {got} "
                f"(the outputs {', '.join(self.outputs)}, {self.n} values each, one after another)."
            )
        return dict(zip(self.outputs, values.split(self.n, dim=-1), strict=True))

    def subset(self, mask: Any) -> "Recording":
        """Keep the conditions where the mask is True, with all their outputs.

        Args:
            mask: Bool array of shape ``(n,)``.

        Returns:
            A recording of the kept conditions; its spread is that of the kept data.

        Raises:
            ShapeError: If the mask is not of dtype bool and shape ``(n,)``.
            RecordingError: If too few conditions, or no observed value of some output, are kept.
        """
        keep = mask if isinstance(mask, Tensor) else torch.as_tensor(np.array(mask))
        if keep.dtype != torch.bool or keep.shape != (self.n,):
            raise ShapeError(
                f"Expected mask of dtype bool and shape ({self.n},). Got {keep.dtype}, {tuple(keep.shape)} "
                "(True for each condition to keep; indices do not work)."
            )
        keep = keep.to(self.y.device)
        return Recording(
            x={k: v[keep] for k, v in self.x.items()} if isinstance(self.x, dict) else self.x[keep],
            y={name: values[keep] for name, values in self.split(self.y).items()},
            noise=(
                {name: sd[keep] for name, sd in self.split(self.noise).items()}
                if isinstance(self.noise, Tensor)
                else self.noise
            ),
            missing=self.missing,
            units=self.units,
        )

    @classmethod
    def from_frame(
        cls, frame: Any, x: str | Sequence[str], y: str | Sequence[str], **options: Any
    ) -> "Recording":
        """Make a recording from columns of a data frame.

        Args:
            frame: A pandas DataFrame, or anything with ``columns`` and ``frame[column]``.
            x: A column name, which gives ``x`` as one array, or a list of names, which gives a dict.
            y: A column name or a list of names. Outputs keep their columns' names.
            **options: ``noise``, ``missing`` and ``units`` as for `Recording`, units by column names.

        Raises:
            RecordingError: If a column does not exist or is named twice, or as `Recording`.
        """
        if not hasattr(frame, "columns"):
            raise RecordingError(
                f"Expected a data frame. Got {type(frame).__name__} (use Recording(x=..., y=...) for arrays)."
            )
        names_x, names_y = ([c] if isinstance(c, str) else list(c) for c in (x, y))
        available = list(frame.columns)
        for position, name in enumerate(names := [*names_x, *names_y]):
            if name not in available:
                raise RecordingError(
                    f"Expected columns among {available}. Got {name!r} (check the spelling and the spaces)."
                )
            if name in names[:position]:
                raise RecordingError(f"Expected each column once. Got {name!r} twice (leave one out).")
        if isinstance(x, str) and isinstance(options.get("units"), Mapping):
            options["units"] = {("x" if key == x else key): unit for key, unit in options["units"].items()}
        return cls(
            x=frame[x] if isinstance(x, str) else {name: frame[name] for name in names_x},
            y={name: frame[name] for name in names_y},
            **options,
        )

    @classmethod
    def from_csv(
        cls, path: str | os.PathLike[str], x: str | Sequence[str], y: str | Sequence[str], **options: Any
    ) -> "Recording":
        """Make a recording from columns of a CSV file with a header line; empty cells are NaN. Needs pandas.

        Args:
            path: The file.
            x: As for `from_frame`.
            y: As for `from_frame`.
            **options: As for `from_frame`.

        Raises:
            MissingDependencyError: If pandas is not installed.
            RecordingError: If the file is not a table, or as `from_frame`.
        """
        try:
            import pandas
        except ImportError as error:
            raise MissingDependencyError(
                "Expected pandas for Recording.from_csv. Got no such package "
                "(pip install pandas, or give arrays)."
            ) from error
        try:
            with warnings.catch_warnings():
                # Lines longer than the header: by default pandas shifts every column by one, without a word.
                warnings.simplefilter("error", pandas.errors.ParserWarning)
                frame = pandas.read_csv(path, skipinitialspace=True, index_col=False)
        except (ValueError, pandas.errors.ParserWarning) as error:
            raise RecordingError(
                f"Expected a CSV file with a header line in {os.fspath(path)}. Got: {error} "
                "(read it with pandas.read_csv and its options, then use Recording.from_frame)."
            ) from error
        return cls.from_frame(frame, x, y, **options)

    def __repr__(self) -> str:
        lost = int((~self.observed).sum())
        lines = [f"Recording: {self.n} conditions"]
        if lost:
            lines[0] += f", {lost} of {len(self.y)} values missing"
        columns = self.x if isinstance(self.x, dict) else {"x": self.x}
        noises = self.split(self.noise) if isinstance(self.noise, Tensor) else {}
        for name, values in columns.items():
            lines.append(f"  condition {self._title(name)}: {_range(values)}")
        for name, values in self.split(self.y).items():
            line = f"  output    {self._title(name)}: {_range(values[~torch.isnan(values)])}"
            lines.append(line + (f", noise sd {_range(noises[name])}" if noises else ""))
        if not noises:
            lines.append("  noise     " + ("unknown" if self.noise is None else "none"))
        return "\n".join(lines)

    def _title(self, name: str) -> str:
        return f"{name} [{self.units[name]}]" if name in self.units else name


def _named(given: Any, letter: str) -> dict[str, Any]:
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


def _declared_units(units: Any, names: Sequence[str]) -> dict[str, str]:
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


def _is_quantity(value: Any) -> bool:
    return hasattr(value, "magnitude") and hasattr(value, "units")


def _tensor(
    value: Any, label: str, unit: str | None, *, difference: bool = False
) -> tuple[Tensor, str | None]:
    """Copy to a float64 tensor in ``unit``; also return the unit, where one is known.

    With ``difference`` the value is a difference (an sd): an offset between units (K, degC) is left out.
    """
    if not isinstance(value, Tensor) and not _is_quantity(value):
        attributes = getattr(value, "attrs", None)
        spelled = attributes.get("units") if isinstance(attributes, Mapping) else None
        if attributes is not None and _is_quantity(getattr(value, "data", None)):
            value = value.data
        elif isinstance(spelled, str):
            if unit is not None and spelled != unit:
                raise RecordingError(
                    f"Expected {label} in {unit!r}. Got attrs['units'] = {spelled!r} "
                    "(convert it, or spell them alike)."
                )
            unit = spelled
    if not _is_quantity(value):
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
    zero = type(value)(0.0, source).to(target).magnitude
    return type(value)(value.magnitude, source).to(target).magnitude, float(zero)


def _plain(value: Any, label: str) -> Tensor:
    """Copy real numbers without a unit to a float64 tensor; refuse every other dtype."""
    if isinstance(value, Tensor):
        if value.dtype == torch.bool or value.is_complex() or value.layout != torch.strided:
            _refuse(label, f"a {value.layout} tensor of {value.dtype}")
        return value.detach().to(torch.float64, copy=True)
    if isinstance(value, list | tuple):
        for index, entry in enumerate(value):
            if _is_quantity(entry):
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
        _refuse(label, f"dtype {array.dtype}{_first_text(array)}")
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


def _check_finite(array: Tensor, label: str, *, is_output: bool, missing: bool) -> None:
    infinite, nan = torch.isinf(array), torch.isnan(array)
    if infinite.any():
        bad, advice = infinite, "remove the condition, or correct the value"
    elif nan.any() and not is_output:
        bad, advice = nan, "a condition must be known: remove it, or fill in its value"
    elif nan.any() and not missing:
        bad, advice = nan, "if it marks a missing sample, give missing=True; otherwise correct it"
    else:
        return
    index = int(bad.nonzero()[0])
    raise RecordingError(
        f"Expected finite numbers in {label}. Got {array[index].item()} at index {index}, "
        f"{int(bad.sum())} of {len(array)} entries ({advice})."
    )


def _check_lengths(arrays: Mapping[str, Tensor]) -> None:
    lengths = {name: len(array) for name, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise RecordingError(
            "Expected arrays of one length. Got " + ", ".join(f"{name}: {n}" for name, n in lengths.items())
            + " (one value per condition in each; mark missing outputs by NaN and give missing=True)."
        )  # fmt: skip
    if (n := min(lengths.values())) < 2:
        raise RecordingError(f"Expected at least 2 data points. Got {n} (one data point cannot calibrate).")


def _common_device(arrays: Mapping[str, Tensor]) -> torch.device:
    devices = {array.device for array in arrays.values() if array.device.type != "cpu"}
    if len(devices) > 1:
        raise RecordingError(
            f"Expected arrays on one device. Got {sorted(map(str, devices))} (move them with .to)."
        )
    return devices.pop() if devices else torch.device("cpu")


def _noise(
    noise: Any, outputs: tuple[str, ...], n: int, units: Mapping[str, str], device: torch.device
) -> Tensor | str | None:
    if noise is None:
        return None
    if isinstance(noise, str):
        if noise != "none":
            raise RecordingError(
                f'Expected noise: None (unknown), "none" (there is none), or the sd. Got {noise!r} '
                '(noise="none" is how to say that there is none).'
            )
        return "none"
    total = n * len(outputs)
    if is_dict := isinstance(noise, Mapping):
        _check_noise_names(noise, outputs)
    parts = []
    for i, name in enumerate(outputs):
        label = f"noise[{name!r}]" if is_dict else "noise"
        value = noise[name] if is_dict else noise
        if _is_quantity(value) and name not in units:
            raise RecordingError(
                f"Expected a known unit of output {name!r}, because {label} has one. Got none (give units=)."
            )
        sd, _ = _tensor(value, label, units.get(name), difference=True)
        shapes = [(), (n,)] if is_dict else [(), (n,), (total,)]
        if tuple(sd.shape) not in shapes:
            wanted = f"a number or shape ({n},)" + ("" if is_dict or total == n else f" or ({total},)")
            raise ShapeError(
                f"Expected {label}: {wanted}. Got shape {tuple(sd.shape)} "
                "(one sd for all, one per condition, or a dict from output names to sd)."
            )
        bad = ~((sd > 0) & torch.isfinite(sd))
        if bad.any():
            index = int(bad.reshape(-1).nonzero()[0])
            where = f" at index {index}" if sd.ndim else ""
            raise DomainError(
                f"Expected {label} as finite sd > 0. Got {sd.reshape(-1)[index].item()}{where} "
                '(noise="none" is how to say that there is none; leave noise out if it is unknown).'
            )
        parts.append((sd[i * n : (i + 1) * n] if sd.shape == (total,) else sd.expand(n)).to(device))
    return torch.cat(parts)


def _check_noise_names(names: Iterable[Any], outputs: tuple[str, ...]) -> None:
    if set(names) != set(outputs):
        raise RecordingError(
            f"Expected noise for exactly the outputs {list(outputs)}. Got {list(names)} "
            "(give an sd for each; noise that is known for some outputs only is not supported)."
        )


def _spread(values: Tensor) -> Tensor:
    """Sample sd, scaled first so that its squares neither vanish nor overflow."""
    scale = values.abs().max()
    if bool(values.min() < values.max()):
        sd = (values / scale).std() * scale
        if bool(sd > 0) and bool(torch.isfinite(sd)):
            return sd
    return scale if bool(scale > 0) else torch.ones_like(scale)


def _range(values: Tensor) -> str:
    low, high = f"{values.min().item():.4g}", f"{values.max().item():.4g}"
    return low if low == high else f"{low} to {high}"
