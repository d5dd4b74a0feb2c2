"""Many evaluations of a function through any executor, in the order in which they end."""

import os
import pickle
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from typing import Any

from torchcal.errors import DomainError, SimulatorError

__all__ = ["TaskError", "check_executor", "run_tasks"]

_CHUNK_SECONDS = 0.2
"""Work sent at once: long against the 1 ms that sending costs, short against what a user waits for."""

_GRACE_SECONDS = 5.0
"""How long an interrupted run waits for the evaluations under way, so that they are not lost."""

_MISSING_WORKERS = 16
"""Workers assumed where the executor does not say how many it has (a cluster)."""


class TaskError(Exception):
    """A task failed: its number, and what it raised. Never shown: the caller turns it into a named error."""

    def __init__(self, index: int, error: BaseException, suspects: int = 1) -> None:
        super().__init__(index, error)
        self.index = index
        self.error = error
        self.suspects = suspects


def check_executor(executor: Executor | None, function: object) -> None:
    """Check, before anything is evaluated, that a function can go through an executor.

    Raises:
        DomainError: If `executor` is not an executor.
        SimulatorError: If the function cannot be sent to another process.
    """
    if executor is not None and not isinstance(executor, Executor):
        raise DomainError(
            f"Expected executor as a concurrent.futures.Executor or None. Got {type(executor).__name__}. "
            "Use ProcessPoolExecutor(), or get_executor() of a Dask client."
        )
    # Other executors may have a pickler that can do more.
    if isinstance(executor, ProcessPoolExecutor):
        try:
            pickle.dumps(function)
        except Exception as error:
            raise SimulatorError(
                "Expected a function that can be sent to another process: defined with def at the top level of "
                f"a module. Got {function!r}, which cannot be pickled: {error}. Move it out of the function, "
                "class or notebook cell it is defined in and bind fixed arguments with functools.partial, or "
                "use a ThreadPoolExecutor or no executor."
            ) from error


def run_tasks(
    function: Callable[[Any], Any],
    tasks: Sequence[Any],
    *,
    executor: Executor | None = None,
    on_result: Callable[[int, Any], None],
) -> None:
    """Call ``function(task)`` for every task, and ``on_result(index, value)`` here as the values come in.

    Tasks are sent in chunks that take about 0.2 s each, found by measuring, so that neither quick nor slow
    functions keep a process pool waiting. When a task fails, or Ctrl-C is pressed, nothing more is sent, and
    what is under way is given 5 s to end: its values are still handed over.

    Args:
        function: Must be picklable where the executor is a process pool.
        tasks: What to call it with.
        executor: Any executor; None runs the tasks here, one after another.
        on_result: Gets each value.

    Raises:
        TaskError: With the number of the task that failed and its exception.
        KeyboardInterrupt: After the values that were there have been handed over.
    """
    if executor is None:
        for index, task in enumerate(tasks):
            try:
                value = function(task)
            except (Exception, SystemExit) as error:
                raise TaskError(index, error) from error
            on_result(index, value)
        return
    _run_pool(function, tasks, executor, on_result)


def _run_pool(
    function: Callable[[Any], Any],
    tasks: Sequence[Any],
    executor: Executor,
    on_result: Callable[[int, Any], None],
) -> None:
    workers = int(getattr(executor, "_max_workers", None) or _MISSING_WORKERS)
    pending: dict[Future[Any], int] = {}
    position, size = 0, 1
    seconds, done = 0.0, 0
    failure: TaskError | None = None

    def collect(futures: Sequence[Future[Any]]) -> TaskError | None:
        nonlocal seconds, done
        first: TaskError | None = None
        for future in sorted(futures, key=lambda item: pending[item]):
            suspects = sum(1 for item in pending if not item.cancelled())
            start = pending.pop(future)
            if future.cancelled():
                continue
            error = future.exception()
            if error is None:
                values, took, error = future.result()
                for offset, value in enumerate(values):
                    on_result(start + offset, value)
                seconds, done = seconds + took, done + len(values)
                start, suspects = start + len(values), 1
            if error is not None and first is None:
                if isinstance(error, KeyboardInterrupt):
                    raise KeyboardInterrupt
                first = TaskError(start, error, suspects if isinstance(error, BrokenExecutor) else 1)
        return first

    try:
        while failure is None and (position < len(tasks) or pending):
            # Two chunks per worker: one under way and one to go on with.
            while position < len(tasks) and len(pending) < 2 * workers:
                stop = min(position + size, len(tasks))
                try:
                    future = executor.submit(_run_chunk, function, list(tasks[position:stop]))
                except BrokenExecutor as error:
                    raise TaskError(position, error) from error
                except RuntimeError as error:
                    raise DomainError(f"Expected an executor that is running. It said: {error}.") from error
                pending[future] = position
                position = stop
            failure = collect(list(wait(pending, return_when=FIRST_COMPLETED).done))
            if done:
                fair = -(-(len(tasks) - position) // (2 * workers))
                size = max(1, min(fair, int(_CHUNK_SECONDS * done / max(seconds, 1e-9))))
    except KeyboardInterrupt:
        _finish(pending, collect)
        raise
    if failure is not None:
        _finish(pending, collect)
        raise failure from failure.error


def _finish(pending: dict[Future[Any], int], collect: Callable[[Sequence[Future[Any]]], TaskError | None]) -> None:
    """Cancel what has not begun, and collect what ends soon."""
    for future in reversed(pending):
        future.cancel()
    ended = wait(pending, timeout=_GRACE_SECONDS).done
    for future in ended:
        try:
            collect([future])
        except KeyboardInterrupt:  # a worker's own: the values that came before it have been taken
            continue


def _run_chunk(function: Callable[[Any], Any], tasks: Sequence[Any]) -> tuple[list[Any], float, BaseException | None]:
    """Values of the tasks before the first that fails, the seconds they took, and that failure."""
    values: list[Any] = []
    begin = time.perf_counter()
    failure: BaseException | None = None
    try:
        for task in tasks:
            values.append(function(task))
    except (Exception, SystemExit, KeyboardInterrupt) as error:
        failure = _portable(error)
    return values, time.perf_counter() - begin, failure


def _portable(error: BaseException) -> BaseException:
    """The exception with its traceback as a note, or a plain copy where it does not survive pickling."""
    note = "".join(traceback.format_exception(error))
    # An exception that cannot be unpickled would break the whole pool.
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.add_note(f"In worker process {os.getpid()}:\n{note}")
    return error
