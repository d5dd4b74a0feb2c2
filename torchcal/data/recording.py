"""Recordings: what was measured, under which conditions, and how noisy it is."""

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcal.data.arrays import (
    check_finite,
    check_lengths,
    common_device,
    declared_units,
    named,
    sample_spread,
    to_tensor,
    value_range,
)
from torchcal.data.noise import noise_sd
from torchcal.errors import MissingDependencyError, RecordingError, ShapeError

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
        given_x, given_y = named(x, "x"), named(y, "y")
        if both := [name for name in given_y if name in given_x]:
            raise RecordingError(
                f"Expected outputs and conditions with different names. Got {both[0]!r} in both (rename one; "
                "an array without a name is called 'x' as condition, 'y' as output: give a dict to name it)."
            )
        declared = declared_units(units, [*given_x, *given_y])

        known: dict[str, str] = {}
        arrays: dict[str, Tensor] = {}
        for letter, given, original in (("x", given_x, x), ("y", given_y, y)):
            for name, values in given.items():
                label = f"{letter}[{name!r}]" if isinstance(original, Mapping) else letter
                array, unit = to_tensor(values, label, declared.get(name))
                if array.ndim != 1:
                    what = "a scalar" if array.ndim == 0 else f"shape {tuple(array.shape)}"
                    raise ShapeError(
                        f"Expected {label} of shape (n,). Got {what} (give one value per condition; several "
                        "conditions or outputs go into a dict from names to arrays)."
                    )
                check_finite(array, label, is_output=letter == "y", missing=bool(missing))
                arrays[name] = array
                if unit is not None:
                    known[name] = unit
        check_lengths(arrays)
        n = len(next(iter(arrays.values())))
        device = common_device(arrays)
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
        put(self, "spread", torch.cat([sample_spread(arrays[name][observed[name]]).expand(n) for name in given_y]))
        put(self, "noise", noise_sd(noise, tuple(given_y), n, known, device))

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
            lines.append(f"  condition {self._title(name)}: {value_range(values)}")
        for name, values in self.split(self.y).items():
            line = f"  output    {self._title(name)}: {value_range(values[~torch.isnan(values)])}"
            lines.append(line + (f", noise sd {value_range(noises[name])}" if noises else ""))
        if not noises:
            lines.append("  noise     " + ("unknown" if self.noise is None else "none"))
        return "\n".join(lines)

    def _title(self, name: str) -> str:
        return f"{name} [{self.units[name]}]" if name in self.units else name
