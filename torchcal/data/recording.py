"""Recordings: what was measured, under which conditions, and how noisy it is."""

import copy
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcal.checks import by_default_on_cpu
from torchcal.data.arrays import sample_spread, value_range
from torchcal.data.frames import check_columns, column_names, read_csv
from torchcal.data.noise import noise_sd
from torchcal.data.parts import run_parts, static_parts
from torchcal.data.run import SEVERAL, Run, change, fingerprint, together
from torchcal.errors import RecordingError, ShapeError

__all__ = ["Recording"]


@dataclass(frozen=True, init=False, repr=False, eq=False)
class Recording:
    """Conditions and measured outputs as float64 tensors. Everything is checked once, here, and copied.

    A recording is static, from ``x`` and ``y``, or in time, from ``runs``. One in time is like any other whose
    conditions are ``{"time": (n,), "run": (n,)}``: its runs stand one after another, ``run`` counts them from 0,
    and ``n`` is the number of their samples.

    Arrays may be torch tensors, numpy arrays, lists, pandas Series, xarray DataArrays or pint Quantities
    of any real dtype. They are matched by position; an index or a coordinate is not looked at. What
    is on an accelerator is copied from there: ``device=`` of a calibration says where the work is done.

    Args:
        x: Conditions: one array ``(n,)``, or a dict from names to arrays ``(n,)``. Never NaN.
        y: Outputs: one array ``(n,)``, then called ``"y"``, or a dict from names to arrays ``(n,)``.
        noise: ``None`` if unknown, ``"none"`` if there is none (a detailed simulation), else the sd in the
            outputs' units, > 0: a number, an array ``(n,)`` that holds for every output, an array
            ``(n_total,)``, or a dict from output names to numbers or arrays ``(n,)``.
        missing: Whether NaN in an output (or a masked entry of a numpy masked array) is a missing sample.
            Otherwise it is an error.
        units: Dict from condition and output names to units (``"x"`` and ``"y"`` where arrays were given
            without names), in time also of inputs and ``"time"``. A Quantity is converted to its declared unit,
            or declares its own; a DataArray's ``attrs["units"]`` declares a unit too, and must be spelled as the
            one given here.
        runs: List of `Run`, instead of ``x`` and ``y``. All have the same inputs; where one lacks an output of
            another, its samples of it are missing, whatever ``missing`` says.

    Attributes:
        x: Tensor ``(n,)`` or dict of tensors ``(n,)``, as given.
        y: Tensor ``(n_total,)``, the outputs one after another; NaN where missing.
        noise: ``None``, ``"none"``, or the sd, tensor ``(n_total,)``.
        missing: As given, or True where a run lacks an output.
        units: Dict from names of conditions and outputs to units, where they are known; those of inputs are in
            the runs' ``units``.
        outputs: Names of the outputs.
        n: Number of conditions; ``n_total = n * len(outputs)``.
        observed: Bool tensor ``(n_total,)``, False where a sample is missing.
        spread: Tensor ``(n_total,)``, > 0: the sample sd (``n - 1``) of the observed data of each output, in
            its unit; the absolute value where the data are constant, and 1 where they are all zero.
        runs: Tuple of runs, in the recording's units; None for a static recording.

    Raises:
        RecordingError: If data are NaN, infinite, not real numbers, too few, of unequal lengths, or misnamed, or
            if runs do not go together.
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
    runs: tuple[Run, ...] | None

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
        by_default_on_cpu()
        if runs is not None and (x is not None or y is not None):
            raise RecordingError(
                f"Expected x= and y=, or runs=. Got runs= and {'x=' if x is not None else 'y='} (runs hold their own "
                "times and outputs)."
            )
        if not isinstance(missing, bool | np.bool_):
            raise RecordingError(
                f"Expected missing=True or missing=False. Got {type(missing).__name__} "
                "(mark missing samples by NaN in y and give missing=True)."
            )
        if runs is not None:
            parts = run_parts(runs, units, bool(missing))
        else:
            parts = static_parts(x, y, units, bool(missing))
        outputs = tuple(parts.y)
        n = len(parts.y[outputs[0]])
        observed = {name: ~torch.isnan(values) for name, values in parts.y.items()}
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
        put(self, "x", parts.x)
        put(self, "y", torch.cat(list(parts.y.values())))
        put(self, "missing", parts.missing)
        put(self, "units", parts.units)
        put(self, "outputs", outputs)
        put(self, "n", n)
        put(self, "observed", torch.cat(list(observed.values())))
        put(
            self,
            "spread",
            torch.cat([sample_spread(parts.y[name][mask]).expand(n) for name, mask in observed.items()]),
        )
        put(self, "noise", noise_sd(noise, outputs, n, parts.units))
        put(self, "runs", parts.runs)

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions; ``("x",)`` where they are one array without a name."""
        return tuple(self.x) if isinstance(self.x, dict) else ("x",)

    @property
    def columns(self) -> Tensor:
        """Conditions side by side, in the order of their names, shape ``(n, C)``."""
        return torch.stack(list(self.x.values()) if isinstance(self.x, dict) else [self.x], dim=-1)

    @property
    def time(self) -> Tensor:
        """Times of all samples, run after run, shape ``(n,)``; an error in a static recording."""
        return self._in_time()["time"]

    @property
    def run_index(self) -> Tensor:
        """Which run each sample belongs to, from 0, int64, shape ``(n,)``; an error in a static recording."""
        return self._in_time()["run"].to(torch.int64)

    def _in_time(self) -> dict[str, Tensor]:
        if self.runs is None or not isinstance(self.x, dict):
            raise RecordingError("Expected a recording in time. Got a static one (make it with runs=[Run(...)]).")
        return self.x

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

    @property
    def copies(self) -> Tensor:
        """Rows of a recording without noise= that are earlier ones once more, bool of shape ``(n,)``.

        All rows, numbers and order, of a table that was read twice or more; in time, all samples of a run. None are
        where noise is given, whose repeated readings may agree.
        """
        none = torch.zeros(self.n, dtype=torch.bool)
        if self.noise is not None:
            return none
        if self.runs is not None:
            known, told = set(), []
            for mark, run in ((fingerprint(run), run) for run in self.runs):
                told.append(torch.full((len(run.time),), mark is not None and mark in known))
                known.add(mark)
            return torch.cat(told)
        y = torch.nan_to_num(self.y.reshape(len(self.outputs), self.n).T, nan=torch.inf)
        rows = torch.cat([self.columns, y], dim=-1)
        for times in range(2, self.n // SEVERAL + 1):
            once = self.n // times
            again = self.n % times == 0 and torch.equal(rows, rows[:once].repeat(times, 1))
            if again and len(rows.unique(dim=0)) == once:
                return torch.arange(self.n) >= once
        return none

    @property
    def observed_once(self) -> Tensor:
        """Which outputs were observed, those of `copies` aside, bool of shape ``(n_total,)``."""
        return self.observed & ~self.copies.repeat(len(self.outputs))

    def subset(self, mask: Any) -> "Recording":
        """Keep the conditions where the mask is True, with all their outputs.

        Args:
            mask: Bool array of shape ``(n,)``.

        Returns:
            A recording of the kept conditions; its spread is that of the kept data.

        Raises:
            ShapeError: If the mask is not of dtype bool and shape ``(n,)``.
            RecordingError: If too few conditions, or no observed value of some output, are kept, or if the
                recording is one in time.
        """
        if self.runs is not None:
            raise RecordingError(
                "Expected a static recording. Got one in time, whose trajectories stay whole (use masked)."
            )
        keep = mask if isinstance(mask, Tensor) else torch.as_tensor(np.array(mask))
        if keep.dtype != torch.bool or keep.shape != (self.n,):
            raise ShapeError(
                f"Expected mask of dtype bool and shape ({self.n},). Got {keep.dtype}, {tuple(keep.shape)} "
                "(True for each condition to keep; indices do not work)."
            )
        keep = keep.cpu()
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

    def masked(self, keep: Any) -> "Recording":
        """Mark outputs as missing where the mask is False; conditions, times and inputs stay.

        This is how data are held out: a simulator still sees every condition and whole trajectories.

        Args:
            keep: Bool array, ``(n,)`` for all outputs alike, or ``(n_total,)`` in the order of ``y``.

        Returns:
            The same recording with ``missing=True``. Its spread is that of the kept data of each output; an output
            of which nothing is kept has the spread it had before.

        Raises:
            ShapeError: If the mask is not of dtype bool and one of these shapes.
            RecordingError: If fewer than 2 observed values are kept.

        >>> Recording(x=[0, 1, 2], y=[5, 6, 7]).masked([True, False, True]).y.tolist()
        [5.0, nan, 7.0]
        """
        mask = keep if isinstance(keep, Tensor) else torch.as_tensor(np.array(keep))
        total = len(self.y)
        if mask.dtype != torch.bool or mask.shape not in ((self.n,), (total,)):
            wanted = f"({self.n},)" + (f" or ({total},)" if total != self.n else "")
            raise ShapeError(
                f"Expected keep of dtype bool and shape {wanted}. Got {mask.dtype}, {tuple(mask.shape)} "
                "(True for each datum to keep; indices do not work)."
            )
        mask = mask.cpu()
        mask = mask if len(mask) == total else mask.repeat(len(self.outputs))
        observed = self.observed & mask
        if (left := int(observed.sum())) < 2:
            raise RecordingError(
                f"Expected at least 2 observed values to keep. Got {left} (one data point cannot calibrate anything)."
            )
        y = self.y.masked_fill(~mask, torch.nan)
        parts = zip(*(self.split(v).values() for v in (y, observed, self.spread)), strict=True)
        spread = [sample_spread(part[seen]).expand(self.n) if seen.any() else old for part, seen, old in parts]
        twin = copy.copy(self)
        put = object.__setattr__
        put(twin, "y", y)
        put(twin, "missing", True)
        put(twin, "observed", observed)
        put(twin, "spread", torch.cat(spread))
        if self.runs is not None:
            lengths = [len(run.time) for run in self.runs]
            kept = {name: part.split(lengths) for name, part in self.split(y).items()}
            runs = enumerate(self.runs)
            put(twin, "runs", tuple(change(r, outputs={k: kept[k][i].clone() for k in r.outputs}) for i, r in runs))
        return twin

    def with_noise(self, noise: Any) -> "Recording":
        """The same recording with noise of another sd, given as in the constructor.

        Raises:
            DomainError: If an sd is not finite and positive.
            RecordingError: If it names other outputs.
            ShapeError: If it has another shape.
        """
        twin = copy.copy(self)
        object.__setattr__(twin, "noise", noise_sd(noise, self.outputs, self.n, self.units))
        return twin

    def without_initial(self, states: Sequence[Sequence[str]]) -> "Recording":
        """The same recording with the initial values of some states, of each run in turn, unknown.

        Raises:
            RecordingError: If it is no recording of as many runs.
        """
        if self.runs is None or len(states) != len(self.runs):
            have = "none" if self.runs is None else len(self.runs)
            raise RecordingError(f"Expected states for each run. Got {len(states)} for {have} (give one list a run).")
        pairs = zip(self.runs, states, strict=True)
        known = [{state: v for state, v in run.initial.items() if state not in mine} for run, mine in pairs]
        return self._with_runs(change(run, initial=left) for run, left in zip(self.runs, known, strict=True))

    def with_hold(self, holds: Sequence[str | Mapping[str, str]]) -> "Recording":
        """The same recording with inputs that go on otherwise between samples, in each run in turn: see `Run`.

        Raises:
            RecordingError: If it is no recording of as many runs.
        """
        if self.runs is None or len(holds) != len(self.runs):
            have = "none" if self.runs is None else len(self.runs)
            raise RecordingError(f"Expected a hold for each run. Got {len(holds)} for {have}.")
        return self._with_runs(
            change(run, hold=together(hold) if isinstance(hold, Mapping) else hold)
            for run, hold in zip(self.runs, holds, strict=True)
        )

    def _with_runs(self, runs: Iterable[Run]) -> "Recording":
        twin = copy.copy(self)
        object.__setattr__(twin, "runs", tuple(runs))
        return twin

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
        names_x, names_y = column_names(x), column_names(y)
        check_columns(frame, [*names_x, *names_y], "Recording(x=..., y=...)")
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
            RecordingError: If the file is not a table or names one of the columns twice, or as `from_frame`.
        """
        return cls.from_frame(read_csv(path, [*column_names(x), *column_names(y)]), x, y, **options)

    def __repr__(self) -> str:
        lost = int((~self.observed).sum())
        if self.runs is None:
            lines = [f"Recording: {self.n} conditions"]
        else:
            count = "1 run" if len(self.runs) == 1 else f"{len(self.runs)} runs"
            lines = [f"Recording in time: {count}, {self.n} samples"]
        if lost:
            lines[0] += f", {lost} of {len(self.y)} values missing"
        columns = self.x if isinstance(self.x, dict) else {"x": self.x}
        noises = self.split(self.noise) if isinstance(self.noise, Tensor) else {}
        for name, values in columns.items():
            if self.runs is None:
                lines.append(f"  condition {self._title(name)}: {value_range(values)}")
            elif name == "time":
                lines.append(f"  {self._title(name)}: {value_range(values)}")
        for name, values in self.split(self.y).items():
            line = f"  output    {self._title(name)}: {value_range(values[~torch.isnan(values)])}"
            lines.append(line + (f", noise sd {value_range(noises[name])}" if noises else ""))
        for name in self.runs[0].inputs if self.runs else ():
            driven = torch.cat([run.inputs[name] for run in self.runs or ()])
            lines.append(f"  input     {self._title(name)}: {value_range(driven)}")
        if not noises:
            lines.append("  noise     " + ("unknown" if self.noise is None else "none"))
        return "\n".join(lines)

    def _title(self, name: str) -> str:
        units = self.units | (self.runs[0].units if self.runs else {})
        return f"{name} [{units[name]}]" if name in units else name
