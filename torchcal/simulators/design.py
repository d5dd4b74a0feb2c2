"""Evaluations of a function at many points, kept whatever happens."""

import json
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from torchcal.errors import DomainError, SimulatorError, TorchcalWarning, warn
from torchcal.files import check_target, replacing
from torchcal.simulators.executor import TaskError, run_tasks
from torchcal.simulators.points import PointCall, Value, failed_evaluation

__all__ = ["Evaluations", "evaluate_points", "read_npz", "write_npz"]

Array = NDArray[np.float64]

_SAVE_SECONDS = 10.0
"""Time between two writings of the cache, which take about a millisecond."""

_SAME = 1e-6
"""Relative difference that is still taken for the same function: solvers repeat themselves far better."""


@dataclass(frozen=True, eq=False)
class Evaluations:
    """What has been evaluated so far.

    Attributes:
        variables: Names of the columns of `points`: conditions, then parameters.
        outputs: Names of the outputs; None for a function of one unnamed output.
        points: float64 ``(m, variables)``.
        values: float64 ``(m, outputs)``.
    """

    variables: tuple[str, ...]
    outputs: tuple[str, ...] | None
    points: Array
    values: Array

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"Evaluations({len(self)} points of {', '.join(self.variables)})"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz file, whole or not at all."""
        header = {"variables": self.variables, "outputs": self.outputs}
        write_npz(path, "torchcal evaluations", header, points=self.points, values=self.values)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Evaluations":
        """Read what `save` wrote.

        Raises:
            DomainError: If the file holds something else.
        """
        header, arrays = read_npz(path, "torchcal evaluations", ("points", "values"))
        names = header["outputs"]
        return cls(tuple(header["variables"]), None if names is None else tuple(names), **arrays)


def evaluate_points(
    call: PointCall,
    points: Array,
    variables: Sequence[str],
    *,
    executor: Executor | None = None,
    cache: str | os.PathLike[str] | Evaluations | None = None,
    progress: bool = True,
) -> Evaluations:
    """Evaluate a function at every point that is not in the cache yet.

    Args:
        call: The function.
        points: ``(m, variables)``.
        variables: Names of the columns.
        executor: See `run_tasks`.
        cache: A file, which is read if it exists and written every ten seconds and at the end; or evaluations to
            begin with. One that is in it is repeated, also where none is missing.
        progress: Whether to show a bar.

    Returns:
        The evaluations at `points`, in their order.

    Raises:
        SimulatorError: If an evaluation fails, named with its point, or the cache holds another function's
            values. ``.partial`` holds the evaluations so far. So does that of a KeyboardInterrupt.
        DomainError: If the cache is of other variables.

    Warns:
        TorchcalWarning: If the cache could not be written: a disk that is full ends no work.
    """
    variables = tuple(variables)
    store = _Store(variables, _open_cache(cache, variables), None if isinstance(cache, Evaluations) else cache)
    keys = [row.tobytes() for row in np.ascontiguousarray(points)]
    missing = list(dict.fromkeys(key for key in keys if key not in store.values))
    known = next((key for key in keys if key in store.values), next(iter(store.values), None))
    tasks = [np.frombuffer(key).tolist() for key in missing]
    bar = tqdm(total=len(set(keys)), initial=len(set(keys)) - len(missing), desc="evaluations", disable=not progress)

    def take(index: int, value: Value) -> None:
        store.add(missing[index], value, call.describe(tasks[index]))
        bar.update()

    try:
        if known is not None:
            _check_same(call, known, store, executor)
        run_tasks(call, tasks, executor=executor, on_result=take)
    except TaskError as failure:
        error = failed_evaluation(failure, call.describe(tasks[failure.index]), everywhere=True)
        _attach_partial(error, store)
        raise error from failure.error
    except (SimulatorError, KeyboardInterrupt) as interruption:
        _attach_partial(interruption, store)
        raise
    finally:
        bar.close()
        store.write()
    if store.unwritten is not None:
        text = (
            f"The evaluations could not be kept in {os.fspath(store.path or '')}: {store.unwritten}. What is made of "
            "them is whole (save it elsewhere), but a rerun will have to evaluate them again."
        )
        try:
            warn(text, TorchcalWarning)
        except TorchcalWarning as warning:  # where warnings are errors
            _attach_partial(warning, store)
            raise
    values = np.stack([store.values[key] for key in keys])
    return Evaluations(variables, store.outputs, np.array(points), values)


class _Store:
    """Values by point, and the file that they are kept in."""

    def __init__(
        self, variables: tuple[str, ...], start: Evaluations | None, path: str | os.PathLike[str] | None
    ) -> None:
        self.variables, self.path = variables, path
        self.outputs: tuple[str, ...] | None = None
        self.values: dict[bytes, Array] = {}
        self.changed, self.written = False, time.monotonic()
        self.unwritten: Exception | None = None
        if start is not None and len(start):
            self.outputs = start.outputs
            points = np.ascontiguousarray(start.points)
            self.values = {row.tobytes(): value for row, value in zip(points, start.values, strict=True)}

    def add(self, key: bytes, value: Value, point: str) -> None:
        names, row = value
        if self.values and names != self.outputs:
            raise SimulatorError(f"Expected outputs {self.outputs}, as elsewhere. Got {names} at {point}.")
        if not np.isfinite(row).all():
            shown = dict(zip(names, row.tolist(), strict=True)) if names else float(row[0])
            raise SimulatorError(
                f"Expected finite values all over the box. Got {shown} at {point}. Narrow the bounds so that "
                "the function has an answer everywhere between them."
            )
        self.outputs, self.values[key], self.changed = names, row, True
        if time.monotonic() - self.written > _SAVE_SECONDS:
            self.write()

    def evaluations(self) -> Evaluations:
        width = len(self.outputs) if self.outputs else 1
        points = np.array([np.frombuffer(key) for key in self.values]).reshape(-1, len(self.variables))
        values = np.array(list(self.values.values())).reshape(-1, width)
        return Evaluations(self.variables, self.outputs, points, values)

    def write(self) -> None:
        """Write what is new; where that fails it is tried again later, and nothing is lost."""
        if self.path is None or not self.changed:
            return
        self.written = time.monotonic()
        try:
            self.evaluations().save(self.path)
        except (OSError, DomainError) as error:  # the folder may have gone, too
            self.unwritten = error
        else:
            self.changed, self.unwritten = False, None


def _open_cache(cache: str | os.PathLike[str] | Evaluations | None, variables: tuple[str, ...]) -> Evaluations | None:
    if cache is None:
        return None
    if not isinstance(cache, Evaluations):
        if not (isinstance(cache, str | os.PathLike) and Path(cache).is_file()):  # a whole one is but read
            check_target(cache)
            return None
        cache = Evaluations.load(cache)
    if cache.variables != variables:
        raise DomainError(
            f"Expected a cache of evaluations over {list(variables)}. Got one over {list(cache.variables)}. Use "
            "another file."
        )
    return cache


def _check_same(call: PointCall, key: bytes, store: _Store, executor: Executor | None) -> None:
    """Repeat one cached evaluation, where the others would run: the function may have changed since."""
    row = np.frombuffer(key).tolist()
    point = call.describe(row)
    found: dict[int, Value] = {}
    try:
        run_tasks(call, [row], executor=executor, on_result=found.__setitem__)
    except TaskError as failure:
        raise failed_evaluation(failure, point, everywhere=True) from failure.error
    names, value = found[0]
    known = store.values[key]
    if names != store.outputs or not np.all(np.abs(value - known) <= _SAME * np.abs(known) + 1e-300):
        raise SimulatorError(
            f"Expected a cache of this function's values. Got {known.tolist()} in it and {value.tolist()} from the "
            f"function, at {point}. Remove the cache, or give another file."
        )


def _attach_partial(error: BaseException, store: _Store) -> None:
    partial = store.evaluations()
    error.partial = partial  # type: ignore[attr-defined]
    store.write()
    if store.unwritten is not None:
        where = f"as .partial of this error, as {os.fspath(store.path or '')} could not be written ({store.unwritten})"
    else:
        where = f"in {os.fspath(store.path)}" if store.path is not None else "as .partial of this error"
    error.add_note(f"{len(partial)} evaluations are kept {where}; pass it as cache= to go on from there.")


def write_npz(path: str | os.PathLike[str], kind: str, header: Mapping[str, Any], **arrays: Array) -> None:
    """Write arrays and a header of plain values, whole or not at all.

    Raises:
        DomainError: If the folder does not exist.
    """
    text = json.dumps({"kind": kind, "version": 1, **header})
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, header=np.array(text), **arrays)  # type: ignore[arg-type]


def read_npz(path: str | os.PathLike[str], kind: str, names: Sequence[str]) -> tuple[dict[str, Any], dict[str, Array]]:
    """Read what `write_npz` wrote, without pickle.

    Raises:
        DomainError: If the file is not of this kind.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
            header = json.loads(str(data["header"]))
            if header["kind"] != kind or header["version"] != 1:
                raise ValueError(f"it holds {header['kind']}, version {header['version']}")
            return header, {name: data[name] for name in names}
    except FileNotFoundError:
        raise
    except Exception as error:
        raise DomainError(f"Expected a file of {kind}. Got {os.fspath(path)!r}: {error}.") from error
