"""Many evaluations of a function through any executor, in the order in which they end."""

import os
import pickle
import time
import traceback
import uuid
import weakref
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from typing import Any

from torchcal.errors import DomainError, SimulatorError, WorkerWarning, warn
from torchcal.simulators.cluster import submit

__all__ = ["TaskError", "check_executor", "portable", "run_tasks", "worker_died"]

_CHUNK_SECONDS = 0.2
"""Work sent at once: long against the 1 ms that sending costs, short against what a user waits for."""

_GRACE_SECONDS = 5.0
"""How long an interrupted run waits for the evaluations under way, so that they are not lost."""

_MISSING_WORKERS = 16
"""Workers assumed where the executor does not say how many it has, or has fewer for now (a cluster)."""

_COUNT_SECONDS = 5.0
"""Time between two questions to a cluster how many workers it has, which take milliseconds."""

_ALONE = 2
"""Deaths after which a task is run with nothing else under way, so that the next one is its own."""

_SPARES: weakref.WeakKeyDictionary[Executor, ProcessPoolExecutor] = weakref.WeakKeyDictionary()
"""Pools that stand in for broken ones, as long as their owner keeps those."""


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
    keep_pool: bool = False,
) -> None:
    """Call ``function(task)`` for every task, and ``on_result(index, value)`` here as the values come in.

    Tasks are sent in chunks that take about 0.2 s each, found by measuring, so that neither quick nor slow
    functions keep a process pool waiting. When a task fails, or Ctrl-C is pressed, nothing more is sent, and
    what is under way is given 5 s to end: its values are still handed over.

    When a worker dies, the work that it took along is repeated, and none that was handed over. A process pool
    breaks as a whole then: a fresh one of the same kind stands in for it. A task that was under way at a death is
    sent by itself from then on, after a second one with nothing beside it, and is named if a worker dies of it then.

    Args:
        function: Must be picklable where the executor is a process pool.
        tasks: What to call it with.
        executor: Any executor; None runs the tasks here, one after another.
        on_result: Gets each value, once.
        keep_pool: Whether a fresh pool is kept for later calls with the same broken one, until that is garbage;
            otherwise it is closed at the end.

    Raises:
        TaskError: With the number of the task that failed and its exception.
        KeyboardInterrupt: After the values that were there have been handed over.

    Warns:
        WorkerWarning: At the end, if workers died.
    """
    if executor is None:
        for index, task in enumerate(tasks):
            try:
                value = function(task)
            except (Exception, SystemExit) as error:
                raise TaskError(index, error) from error
            on_result(index, value)
        return
    workers = _Workers(executor, keep_pool)
    done = False
    try:
        _Run(function, tasks, workers, on_result).finish()
        done = True
    finally:
        workers.close(wait=done)
    if workers.died:
        warn(
            f"{workers.died} worker process{'es' if workers.died > 1 else ''} died. What they had not handed over was "
            "repeated, and nothing is lost. Too little memory is the usual reason: use fewer workers.",
            WorkerWarning,
        )


def worker_died(error: BaseException) -> bool:
    """Whether an exception of a future means that its worker is gone, and not that the function raised."""
    # Dask's is known by its name: Dask need not be installed.
    return isinstance(error, BrokenExecutor | CancelledError) or type(error).__name__ == "KilledWorker"


class _Workers:
    """The executor, or the pool that stands in for it since it broke."""

    def __init__(self, executor: Executor, keep: bool) -> None:
        self.given, self.keep = executor, keep
        self.now: Executor = executor
        if isinstance(executor, ProcessPoolExecutor):
            self.now = _SPARES.get(executor, executor)
        self.opened: ProcessPoolExecutor | None = None
        self.died = 0
        self._count, self._counted = 0, -_COUNT_SECONDS

    @property
    def count(self) -> int:
        """How many there are."""
        fixed = getattr(self.now, "_max_workers", None)
        if fixed:
            return int(fixed)
        if time.monotonic() - self._counted >= _COUNT_SECONDS:
            try:
                self._count = sum(self.now._client.nthreads().values())  # type: ignore[attr-defined]
            except Exception:
                self._count = 0
            self._counted = time.monotonic()
        return max(self._count, _MISSING_WORKERS)

    def replace(self) -> bool:
        """Open a pool of the same kind in the place of a broken one, where that is known how."""
        broken = self.now
        if not isinstance(broken, ProcessPoolExecutor):
            return False
        self.opened = self.now = ProcessPoolExecutor(
            broken._max_workers,  # type: ignore[attr-defined]
            mp_context=broken._mp_context,  # type: ignore[attr-defined]
            initializer=broken._initializer,  # type: ignore[attr-defined]
            initargs=broken._initargs,  # type: ignore[attr-defined]
            max_tasks_per_child=broken._max_tasks_per_child,  # type: ignore[attr-defined]
        )
        if self.keep:
            _SPARES[self.given] = self.opened
            weakref.finalize(self.given, self.opened.shutdown, wait=False)
        return True

    def close(self, *, wait: bool) -> None:
        """Close the pool that was opened here, unless it is kept."""
        if self.opened is not None and not self.keep:
            self.opened.shutdown(wait=wait, cancel_futures=True)


class _Run:
    """The state of one run through an executor: what is left, what is under way, what was lost with a worker."""

    def __init__(
        self,
        function: Callable[[Any], Any],
        tasks: Sequence[Any],
        workers: _Workers,
        on_result: Callable[[int, Any], None],
    ) -> None:
        self.function, self.tasks, self.workers, self.on_result = function, tasks, workers, on_result
        self.left = deque(range(len(tasks)))
        self.pending: dict[Future[Any], list[int]] = {}
        self.deaths: Counter[int] = Counter()
        self.size, self.seconds, self.done = 1, 0.0, 0
        self.packed: bytes | None = None

    def finish(self) -> None:
        """Run everything."""
        try:
            while self.left or self.pending:
                self._send()
                if self.pending:
                    self._take(wait(self.pending, return_when=FIRST_COMPLETED).done)
        except (TaskError, KeyboardInterrupt):
            self._wind_up()
            raise
        except BaseException:
            for future in self.pending:
                future.cancel()
            raise

    def _send(self) -> None:
        while indices := self._next():
            work = [self.tasks[index] for index in indices]
            try:
                future = self._submit(work)
            except BrokenExecutor as error:
                self.left.extendleft(reversed(indices))
                self._replace(error, [])
                continue
            except RuntimeError as error:
                raise DomainError(f"Expected an executor that is running. It said: {error}.") from error
            self.pending[future] = indices

    def _submit(self, work: list[Any]) -> Future[Any]:
        now = self.workers.now
        if not isinstance(now, ProcessPoolExecutor):
            # The label keeps Dask from answering a repeated task with the failure that it remembers.
            return submit(now, _run_chunk, self.function, work, uuid.uuid4().hex)
        # Bytes: tensors that a pool pickles by itself stay in memory that is lost with a worker.
        if self.packed is None:
            self.packed = pickle.dumps(self.function)
        return now.submit(_run_packed, self.packed, pickle.dumps(work))

    def _next(self) -> list[int]:
        """The tasks to send together, none if there is no place for any."""
        if not self.left or any(self.deaths[item[0]] >= _ALONE for item in self.pending.values()):
            return []
        deaths, count = self.deaths[self.left[0]], self.workers.count
        # Two chunks per worker, one under way and one to go on with; fewer where a worker may die.
        room = 1 if deaths >= _ALONE else count if deaths else 2 * count
        if len(self.pending) >= room:
            return []
        if self.done:
            fair = -(-len(self.left) // (2 * count))
            self.size = max(1, min(fair, int(_CHUNK_SECONDS * self.done / max(self.seconds, 1e-9))))
        indices = [self.left.popleft()]
        while not deaths and len(indices) < self.size and self.left and not self.deaths[self.left[0]]:
            indices.append(self.left.popleft())
        return indices

    def _take(self, futures: Iterable[Future[Any]]) -> None:
        failure: TaskError | None = None
        for future in sorted(futures, key=lambda item: self.pending[item][0]):
            if future not in self.pending:  # taken when the pool broke
                continue
            rest, error = self._read(future)
            if error is None:
                continue
            if isinstance(error, BrokenExecutor):
                self._replace(error, rest)
            elif worker_died(error):
                self.workers.died += 1
                self._lose(rest, error, _ALONE)  # a cluster has tried it several times by itself
            elif isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt
            elif failure is None:
                failure = TaskError(rest[0], error)
        if failure is not None:
            raise failure from failure.error

    def _read(self, future: Future[Any]) -> tuple[list[int], BaseException | None]:
        """Hand over the values of a future that is done; what it leaves undone, and why."""
        indices = self.pending.pop(future)
        error = CancelledError("the executor gave it up") if future.cancelled() else future.exception()
        if error is not None:
            return indices, error
        result = future.result()
        values, seconds, error = pickle.loads(result) if isinstance(result, bytes) else result
        for index, value in zip(indices, values, strict=False):
            self.on_result(index, value)
        self.seconds, self.done = self.seconds + seconds, self.done + len(values)
        return indices[len(values) :], error

    def _replace(self, error: BrokenExecutor, lost: list[int]) -> None:
        """Go on with a fresh pool: a broken one gives up all that was under way."""
        suspects = len(self.pending) + bool(lost)
        wait(self.pending, timeout=_GRACE_SECONDS)
        for future in list(self.pending):
            lost = lost + (self._read(future)[0] if future.done() else self.pending.pop(future))
        if not self.workers.replace():
            raise TaskError(min(lost, default=self.left[0] if self.left else 0), error, suspects) from error
        self.workers.died += 1
        self._lose(lost, error, 1)

    def _lose(self, lost: list[int], error: BaseException, deaths: int) -> None:
        """Put tasks back that were under way when a worker died; name one that was there alone, after others."""
        if len(lost) == 1 and self.deaths[lost[0]] >= _ALONE:
            raise TaskError(lost[0], error) from error
        for index in lost:
            self.deaths[index] += deaths
        self.left.extendleft(sorted(lost, reverse=True))

    def _wind_up(self) -> None:
        """Cancel what has not begun, and collect what ends soon."""
        for future in reversed(self.pending):
            future.cancel()
        for future in wait(self.pending, timeout=_GRACE_SECONDS).done:
            self._read(future)


def _run_chunk(
    function: Callable[[Any], Any], tasks: Sequence[Any], label: str
) -> tuple[list[Any], float, BaseException | None]:
    """Values of the tasks before the first that fails, the seconds they took, and that failure."""
    values: list[Any] = []
    begin = time.perf_counter()
    failure: BaseException | None = None
    try:
        for task in tasks:
            values.append(function(task))
    except (Exception, SystemExit, KeyboardInterrupt) as error:
        failure = portable(error)
    return values, time.perf_counter() - begin, failure


def _run_packed(function: bytes, tasks: bytes) -> bytes:
    """`_run_chunk` of pickles, with a pickle of what it returns."""
    try:
        result = _run_chunk(pickle.loads(function), pickle.loads(tasks), "")
    except Exception as error:  # a module that workers cannot import
        return pickle.dumps(([], 0.0, portable(error)))
    try:
        return pickle.dumps(result)
    except Exception as error:
        return pickle.dumps(([], 0.0, portable(error)))


def portable(error: BaseException) -> BaseException:
    """The exception with its traceback as a note, or a plain copy where it does not survive pickling."""
    note = "".join(traceback.format_exception(error))
    # An exception that cannot be unpickled would break the whole pool.
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.add_note(f"In worker process {os.getpid()}:\n{note}")
    return error
