"""Refits of many hypotheses, here or on the workers of an executor."""

import dataclasses
import math
import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

from torch import Tensor

from torchcal.discovery.fits.fitting import FINISH, Fitted, finished, fit
from torchcal.discovery.fits.jumps import placed
from torchcal.discovery.fits.problem import Problem, Whitening
from torchcal.errors import DomainError, MissingDependencyError, SimulatorError, TorchcalError
from torchcal.simulators import Solution
from torchcal.simulators.executor import TaskError, check_executor, run_tasks
from torchcal.threads import few_threads

__all__ = ["Refit", "refit_all"]


@dataclass(frozen=True, eq=False)
class Refit:
    """One hypothesis to fit.

    Attributes:
        problem: With the extended simulator.
        whitening: Of its residuals.
        begin: Starting values ``(H, P)``.
        free: Places of what is fitted.
        shape: Those of the terms' shapes among them, held at first: while an amplitude is small they mean nothing.
        warm: Warm start, or None.
        aim: χ² above which its end does not matter.
        begun: Its fit so far, where that is all that is left to do.
    """

    problem: Problem
    whitening: Whitening
    begin: Tensor
    free: list[int]
    shape: list[int]
    warm: Solution | None
    aim: float = math.inf
    begun: Fitted | None = None

    def run(self) -> Fitted | None:
        """The fit, which a long way may not have brought to its end yet; None where no start gives one."""
        if self.begun is not None:
            return finished(self.begun, self.aim)
        begin, warm = self.begin, self.warm
        if self.shape:
            free = [i for i in self.free if i not in self.shape]
            first = fit(self.problem, self.whitening, begin, free, warm=warm, max_steps=12, finish=0)
            if first is None or first.ends is None or first.ends_chi2 is None:
                return None
            begin = first.ends[first.ends_chi2.argsort()[:2]]
            warm = None if first.warm is None else first.warm.repeated(len(begin))
        found = fit(self.problem, self.whitening, begin, self.free, warm=warm, aim=self.aim, finish=0, later=FINISH)
        return None if found is None else placed(found, self.shape)


def refit_all(
    jobs: Sequence[Refit], on_result: Callable[[int, Fitted | None], None], executor: Executor | None = None
) -> None:
    """Run all of them, in order here or spread over an executor; the results are the same.

    Args:
        jobs: What to fit.
        on_result: Called with the number of each that has ended, and its fit.
        executor: Any ``concurrent.futures.Executor``, or None.

    Raises:
        DomainError: If a term or the simulator cannot be sent to a worker.
        MissingDependencyError: If only cloudpickle could send it (a lambda), and it is not installed.
    """

    def take(index: int, packed: bytes) -> None:
        found = pickle.loads(packed)
        if found is not None:
            found = dataclasses.replace(found, problem=jobs[index].problem, whitening=jobs[index].whitening)
        on_result(index, found)

    if executor is None:
        for index, job in enumerate(jobs):
            on_result(index, job.run())
        return
    check_executor(executor, _run_packed)
    try:
        run_tasks(_run_packed, [_pack(job) for job in jobs], executor=executor, on_result=take)
    except TaskError as failure:
        if isinstance(failure.error, TorchcalError):
            raise failure.error from None
        names = ", ".join(q.name for q in jobs[failure.index].problem.parameters)
        raise SimulatorError(
            f"Expected a worker to refit the hypothesis with the parameters {names}. Got "
            f"{type(failure.error).__name__}: {failure.error}. Leave executor= away to refit here, or look at the "
            "worker's memory and installation."
        ) from failure.error


def _run_packed(packed: bytes) -> bytes:
    with few_threads():  # workers share the cores
        found = pickle.loads(packed).run()
    if found is not None:  # both are large, and known where the job came from
        found = dataclasses.replace(found, problem=None, whitening=None)
    return pickle.dumps(found)


def _pack(job: Refit) -> bytes:
    try:
        return pickle.dumps(job)
    except Exception:  # pickle names no common class of what it cannot do
        pass
    try:
        import cloudpickle
    except ImportError as error:
        raise MissingDependencyError(
            "Expected cloudpickle for diagnose(executor=) with terms of lambdas: it sends functions that have no name "
            "to other processes. It is not installed. Run: pip install cloudpickle (torchcal[dask] brings it)."
        ) from error
    try:
        packed: bytes = cloudpickle.dumps(job)
    except Exception as error:
        raise DomainError(
            f"Expected a simulator and terms that can be sent to another process. Got one that cannot: {error}. Leave "
            "executor= away, or keep open files, locks and pools out of their functions."
        ) from error
    return packed
