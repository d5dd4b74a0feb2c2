"""`calibrate_many`: one simulator and many recordings, on any executor, kept as they end."""

import dataclasses
import functools
import hashlib
import inspect
import json
import os
import pickle
import threading
import warnings
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path
from typing import Any, overload
from urllib.parse import quote

import torch
from tqdm.auto import tqdm

from torchcal import embeddings, likelihoods
from torchcal.data import Recording
from torchcal.display import PATIENCE
from torchcal.errors import DomainError, InterruptionWarning, RecordingError, TorchcalError, TorchcalWarning, warn
from torchcal.inference.calibrate import calibrate
from torchcal.inference.fingerprint import fingerprint
from torchcal.results import Calibration, reading, storage
from torchcal.simulators import Simulator
from torchcal.simulators.executor import TaskError, check_executor, portable, run_tasks, worker_died

__all__ = ["calibrate_many"]

_ONE_AT_A_TIME = threading.Lock()
"""Random state and warning filters belong to the whole process: threads of one take turns."""


@overload
def calibrate_many(
    simulator: Simulator,
    recordings: Mapping[str, Recording],
    *,
    executor: Executor | None = None,
    folder: str | os.PathLike[str] | None = None,
    progress: bool = True,
    **settings: Any,
) -> dict[str, Calibration]: ...


@overload
def calibrate_many(
    simulator: Simulator,
    recordings: Sequence[Recording],
    *,
    executor: Executor | None = None,
    folder: str | os.PathLike[str] | None = None,
    progress: bool = True,
    **settings: Any,
) -> list[Calibration]: ...


def calibrate_many(
    simulator: Simulator,
    recordings: Sequence[Recording] | Mapping[str, Recording],
    *,
    executor: Executor | None = None,
    folder: str | os.PathLike[str] | None = None,
    progress: bool = True,
    **settings: Any,
) -> list[Calibration] | dict[str, Calibration]:
    """Calibrate one simulator to many recordings, each as `calibrate` does by itself.

    A worker process does one calibration at a time, on one thread, so that as many workers as there are cores do not
    get into each other's way. Threads of one process take turns: use processes.

    Args:
        simulator: The model.
        recordings: A sequence of recordings, or ``{name: recording}``.
        executor: Any ``concurrent.futures.Executor``; None calibrates here, one after another. For a process pool
            the simulator's functions must be defined at the top level of a module.
        folder: Where each result is written as it ends, as ``name.nc`` (``0.nc``, ``1.nc``, ... of a sequence), which
            `torchcal.results.Calibration.load` reads. Results that are there already are not computed again: with the
            same recording and settings, and a simulator that still predicts what the first of them predicts. Made if
            it does not exist. Needs xarray.
        progress: Whether to show a bar over the recordings where they take more than two seconds.
        **settings: Of `calibrate`, the same for all.

    Returns:
        The results in the order of the recordings, or by their names.

    Raises:
        DomainError: Before any work, if something cannot be sent to the workers, or the folder holds results of
            other inputs.
        TorchcalError: At the end, with the names of the recordings whose calibration failed. The others are in
            the folder, and in ``.partial``, a dict by name or number; as they are after Ctrl-C.

    Warns:
        TorchcalWarning: At the end, what each calibration warned of, with the recording's name.

    >>> from torchcal import Parameter
    >>> line = Simulator(lambda x, p: p["a"] * x, [Parameter("a")], degree=1)
    >>> days = {day: Recording(x=[1.0, 2.0, 3.0], y=[1.0 * day, 2.1 * day, 2.9 * day]) for day in (1, 2)}
    >>> fits = calibrate_many(line, days, num_samples=0)
    >>> list(fits)
    [1, 2]
    """
    items = _labelled(recordings)
    _check(simulator, executor, settings)
    store = None if folder is None else _Folder(folder, simulator, settings)
    results: dict[Any, Calibration] = {} if store is None else store.read(items)
    failures: dict[Any, BaseException] = {}
    cut_short: list[Any] = []
    warned: dict[tuple[type[Warning], str], None] = {}
    work = _Work(simulator, settings, os.getpid())
    bar = tqdm(total=len(items), initial=len(results), desc="calibrations", disable=not progress, delay=PATIENCE)

    def take(names: Sequence[Any], index: int, outcome: _Outcome) -> None:
        name = names[index]
        if outcome.interrupted:  # some of the draws are no result of these settings
            cut_short.append(name)
            if executor is None:
                raise KeyboardInterrupt
            return
        for category, text in outcome.warned:
            named = issubclass(category, TorchcalWarning)
            warned[(category, f"{_title(name)}: {text}" if named else text)] = None
        if outcome.result is None:
            failures[name] = outcome.error or RuntimeError("no result")
        else:
            results[name] = outcome.result
            if store is not None:
                store.write(name, items[name], outcome.result)
        bar.update()

    try:
        while todo := [name for name in items if name not in results and name not in failures]:
            tasks = [items[name] for name in todo]
            try:
                run_tasks(work, tasks, executor=executor, on_result=functools.partial(take, todo))
                if cut_short:
                    raise KeyboardInterrupt
            except TorchcalWarning as warning:  # where warnings are errors; all results are there
                warned[(type(warning), str(warning))] = None
            except TaskError as failure:
                failures[todo[failure.index]] = failure.error
                if not worker_died(failure.error):  # not of a recording but of how work is sent
                    break
    except BaseException as interruption:
        _attach(interruption, {name: results[name] for name in items if name in results}, folder)
        raise
    finally:
        bar.close()
    if failures:
        told = "; ".join(f"{_title(name)}: {_told(error)}" for name, error in failures.items())
        error = TorchcalError(
            f"Expected a calibration of each of {len(items)} recordings. Got {len(failures)} that failed: {told} "
            "Mend or leave out what is named, and call again."
        )
        _attach(error, {name: results[name] for name in items if name in results}, folder)
        raise error from next(iter(failures.values()))
    for category, text in warned:
        warn(text, category)
    if isinstance(recordings, Mapping):
        return {name: results[name] for name in items}
    return [results[name] for name in items]


@dataclasses.dataclass(frozen=True)
class _Outcome:
    """What one calibration came to."""

    result: Calibration | None
    error: BaseException | None
    warned: tuple[tuple[type[Warning], str], ...]

    @property
    def interrupted(self) -> bool:
        """Whether it has but a part of the draws that were asked for."""
        return any(issubclass(category, InterruptionWarning) for category, _ in self.warned)


@dataclasses.dataclass(frozen=True)
class _Work:
    """One calibration, in whatever process."""

    simulator: Simulator
    settings: dict[str, Any]
    home: int

    def __call__(self, recording: Recording) -> _Outcome:
        result, failure = None, None
        away = os.getpid() != self.home
        with _ONE_AT_A_TIME, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            threads = torch.get_num_threads()
            if away:
                torch.set_num_threads(1)
            try:
                result = calibrate(self.simulator, recording, progress=False, **self.settings)
                if away and result.propagate is not None:
                    # Makes it forget the closure that it has made of the simulator, which cannot be pickled.
                    result.propagate.to(device=result.propagate.nodes.device)
            except (Exception, SystemExit) as error:
                failure = portable(error) if away else error
            finally:
                if away:
                    torch.set_num_threads(threads)
        return _Outcome(result, failure, tuple((item.category, str(item.message)) for item in caught))


def _title(name: Any) -> str:
    return f"recording {name!r}"


def _told(error: BaseException) -> str:
    if worker_died(error):
        return (
            f"a worker process died of it ({error}); too little memory, or a simulator that workers cannot import, "
            "does this."
        )
    return f"{type(error).__name__}: {error}"


def _attach(error: BaseException, results: dict[Any, Calibration], folder: str | os.PathLike[str] | None) -> None:
    error.partial = results  # type: ignore[attr-defined]
    where = "as .partial of this error" if folder is None else f"in {os.fspath(folder)}, from which a rerun goes on"
    error.add_note(f"{len(results)} calibrations are kept {where}.")


def _labelled(recordings: Any) -> dict[Any, Recording]:
    if isinstance(recordings, Recording) or not isinstance(recordings, Mapping | Iterable):
        raise DomainError(
            f"Expected a sequence or a dict of recordings. Got {type(recordings).__name__}. Use calibrate() for one."
        )
    items = dict(recordings) if isinstance(recordings, Mapping) else dict(enumerate(recordings))
    for name, item in items.items():
        if not isinstance(item, Recording):
            raise RecordingError(
                f"Expected a torchcal.Recording as {_title(name)}. Got {type(item).__name__}. Wrap the data: "
                "torchcal.Recording(x=x, y=y)."
            )
    return items


def _check(simulator: Any, executor: Executor | None, settings: Mapping[str, Any]) -> None:
    if not isinstance(simulator, Simulator):
        raise DomainError(f"Expected a torchcal.Simulator. Got {type(simulator).__name__}.")
    known = inspect.signature(calibrate).parameters
    unknown = [name for name in settings if name not in known]
    if unknown:
        raise DomainError(f"Expected settings of calibrate(). Got {unknown}. It has {list(known)[2:]}.")
    check_executor(executor, None)
    # Other executors may have a pickler that can do more.
    if isinstance(executor, ProcessPoolExecutor):
        for what, thing in {"the simulator": simulator, **settings}.items():
            try:
                pickle.dumps(thing)
            except Exception as error:
                raise DomainError(
                    f"Expected {what} as something that can be sent to another process. It cannot be pickled: {error}. "
                    "Define its functions with def at the top level of a module and bind fixed arguments with "
                    "functools.partial, or use no executor."
                ) from error


class _Folder:
    """Results in files, each with what it was computed from."""

    def __init__(
        self, folder: str | os.PathLike[str], simulator: Simulator, settings: Mapping[str, Any]
    ) -> None:
        for module, what in ((embeddings, "embedding"), (likelihoods, "likelihood")):
            item = settings.get(what)
            if item is not None and not isinstance(item, str):
                if getattr(module, type(item).__name__, None) is not type(item):
                    raise DomainError(
                        f"Expected one of torchcal.{what}s beside folder=. Got {type(item).__name__}, which cannot be "
                        "read back. Leave the folder out, and keep the results yourself."
                    )
        self.xarray = storage.netcdf_modules()[0]
        self.path, self.simulator = Path(folder), simulator
        self.path.mkdir(parents=True, exist_ok=True)
        bound = inspect.signature(calibrate).bind(simulator, None, **settings)
        bound.apply_defaults()
        self.inputs = {name: fingerprint(value) for name, value in bound.arguments.items() if name != "recording"}
        self.inputs["simulator"] = f"{type(simulator).__qualname__} {fingerprint(simulator.parameters)}"

    def file(self, name: Any) -> Path:
        """Where a result is."""
        return self.path / f"{quote(str(name), safe=' ')}.nc"

    def write(self, name: Any, recording: Recording, result: Calibration) -> None:
        """Write a result whole, or not at all."""
        tree = result.to_datatree()
        tree.attrs["torchcal_inputs"] = json.dumps(self._inputs_of(recording))
        storage.write(tree, self.file(name))

    def read(self, items: Mapping[Any, Recording]) -> dict[Any, Calibration]:
        """The results that are there, or an error if they are of other inputs."""
        names = [self.file(name) for name in items]
        if len(set(names)) < len(names):
            raise DomainError("Expected recordings whose names make different files. Got two of one name.")
        found: dict[Any, Calibration] = {}
        for name, recording in items.items():
            path = self.file(name)
            if not path.exists():
                continue
            self._check_inputs(path, recording)
            try:  # the simulator's code may have changed since
                found[name] = Calibration.load(path, simulator=self.simulator)
                if len(found) == 1:
                    reading.check_simulator(found[name])
            except DomainError as error:
                raise DomainError(f"{error} The result is in {path}: remove it, or give another folder.") from None
        return found

    def _inputs_of(self, recording: Recording) -> dict[str, str]:
        return {**self.inputs, "recording": hashlib.sha256(fingerprint(recording).encode()).hexdigest()}

    def _check_inputs(self, path: Path, recording: Recording) -> None:
        try:
            with self.xarray.open_datatree(path, engine="h5netcdf") as tree:
                kept = json.loads(tree.attrs["torchcal_inputs"])
        except Exception as error:  # damage shows in many ways
            raise DomainError(
                f"Expected a result that calibrate_many wrote in {path}. Got another file: {error}. Remove it, or "
                "give another folder."
            ) from error
        now = self._inputs_of(recording)
        other = [name for name in {**kept, **now} if kept.get(name) != now.get(name)]
        if other:
            raise DomainError(
                f"Expected a result of the same inputs in {path}. Got one with another {' and '.join(other)}. Remove "
                "it, or give another folder."
            )
