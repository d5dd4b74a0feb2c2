"""Simulators that are not written in torch: any function of plain numbers, run through an executor."""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcal.checks import real_number
from torchcal.errors import DomainError, ShapeError, SimulatorError
from torchcal.simulators.executor import TaskError, check_executor, run_tasks
from torchcal.simulators.parameter import Parameter
from torchcal.simulators.points import ArrayCall, Forgiving, PointCall, Value, failed_evaluation, raised_at
from torchcal.simulators.static import Conditions, Simulator, check_values

__all__ = ["ExternalSimulator"]

Array = NDArray[np.float64]

#: Numbers that a vectorized function returns, at most about, of which those that a shift asks for are taken.
AT_ONCE = 10_000_000


class ExternalSimulator(Simulator):
    r"""A model in any other code, called with plain numbers and differentiated by central differences.

    .. math:: \frac{\partial f}{\partial \lambda_j} \approx
        \frac{f(\lambda + h_j e_j) - f(\lambda - h_j e_j)}{2 h_j}, \qquad h_j = \mathtt{step} \cdot s_j

    with :math:`s_j` half the parameter's range where it has two bounds, :math:`|\lambda_j|` on a logarithmic scale,
    and otherwise the largest of :math:`|\lambda_j|` and ``|initial|``, or 1 where both are 0. A parameter that has
    neither a bound nor ``initial`` may cross 0, beside which :math:`|\lambda_j|` is no scale: :math:`s_j` is then at
    least 1. Give ``initial``, or bounds, where a parameter is far smaller than 1. The points lie up to a step outside
    the bounds; where one side has no answer, the other and the middle give the slope. A gradient costs 2d evaluations
    for each row of parameter values, and is computed only where it is asked for.

    Args:
        function: ``function(x, p)`` with ``p`` a dict of floats. ``x`` is a float, or a dict of them where the
            conditions are named; it returns a number, or a dict of them for several outputs. With ``vectorized``
            ``x`` holds numpy arrays ``(n,)``, and it returns arrays ``(n,)``; where a term's ``shifts`` give every
            condition a value of its own, it is called with all conditions once for each of these values. It must
            give the same numbers for the same arguments. Where it has no answer it may return nan or a masked value;
            arithmetic errors count as none.
        parameters: In the order in which results list them.
        executor: Any ``concurrent.futures.Executor``; None calls the function here. For a process pool the
            function must be defined at the top level of a module. All parameter values of a call go in one map
            (shifted ones of a vectorized function in as few as memory allows), identical ones once. When a worker
            dies, what it was doing is repeated; a process pool, which breaks then, is replaced by one of the same kind
            for as long as it is kept.
        vectorized: Whether one call does all conditions.
        step: Relative step of the differences. The default errs by 1e-8 of f''' (truncation) and 1e4 times
            the function's own noise: take a larger one for a code whose last digits are not reproducible.
        degree: Total degree in the parameters where the function is a polynomial in them.

    Raises:
        DomainError: If an argument has no meaning.
        SimulatorError: If the function cannot be sent to the executor's processes. Later, named with its point: if
            an evaluation raises, kills a worker again and again, or returns something that is not a real number.

    Warns:
        WorkerWarning: If workers died; nothing is lost then.

    A calibration calls a simulator thousands of times: for an expensive one build a surrogate first
    (`build_surrogate`).

    >>> square = ExternalSimulator(lambda x, p: p["a"] * x**2, [Parameter("a")])
    >>> square.at(torch.tensor([1.0, 3.0]))(torch.tensor([2.0]))
    tensor([ 2., 18.])
    """

    dear = True

    unlike = "Let the function give the same numbers for the same arguments: seed random numbers, or leave them out."

    def __init__(
        self,
        function: Callable[[Any, dict[str, float]], Any],
        parameters: Sequence[Parameter],
        *,
        executor: Executor | None = None,
        vectorized: bool = False,
        step: float = 1e-4,
        degree: int | None = None,
    ) -> None:
        if not callable(function):
            raise DomainError(f"Expected a callable f(x, p). Got {type(function).__name__}.")
        if not isinstance(vectorized, bool):
            raise DomainError(f"Expected vectorized as True or False. Got {vectorized!r}.")
        if not 0 < real_number(step) < 1:
            raise DomainError(f"Expected step between 0 and 1 (a relative step). Got {step!r}.")
        super().__init__(self._call, parameters, degree=degree)
        self.external = function
        self.executor = executor
        self.vectorized = vectorized
        self.step = real_number(step)
        check_executor(executor, function)

    def __getstate__(self) -> dict[str, Any]:
        # A pool cannot be sent to another process; there the function is called directly.
        return {**self.__dict__, "executor": None}

    def __copy__(self) -> "ExternalSimulator":
        return ExternalSimulator(
            self.external,
            self.parameters,
            executor=self.executor,
            vectorized=self.vectorized,
            step=self.step,
            degree=self.degree,
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> "ExternalSimulator":
        return self.__copy__()

    def at(self, x: Conditions, outputs: Sequence[str] | None = None) -> Callable[[Tensor], Tensor]:
        """The simulator at fixed conditions, as a function of parameter values alone.

        Args:
            x: Conditions, ``(n,)`` or a dict of them.
            outputs: Names and order of the outputs wanted, where the function returns a dict.

        Returns:
            A function from values ``(*batch, d)``, physical units, to outputs ``(*batch, n)``, or
            ``(*batch, n_outputs * n)`` with one output after another; in the dtype and on the device of the
            values, computed in float64. Rows that are not finite give nan without a call.

        Raises:
            ShapeError: If conditions or values have another shape.
        """
        job = _Job(self, x, outputs)

        def evaluate(values: Tensor) -> Tensor:
            check_values(values, self.names)
            batch = values.shape[:-1]
            rows = values.reshape(math.prod(batch), 1, len(self.names))
            return _unflatten(_Differenced.apply(rows, job), batch)

        return evaluate

    def raised(self, x: Conditions, values: Tensor, column: int) -> Exception | None:
        """What the function raises at parameters ``(d,)`` and an output, of what stands for no answer; or None."""
        names = tuple(x) if isinstance(x, Mapping) else None
        columns = list(x.values()) if isinstance(x, Mapping) else [x]
        points = torch.stack([torch.as_tensor(c).detach().to("cpu", torch.float64) for c in columns], dim=-1)
        if self.vectorized:
            return raised_at(ArrayCall(self.external, names, self.names, points.numpy()), values.tolist())
        call = PointCall(self.external, names, self.names)
        return raised_at(call, [*points[column % len(points)].tolist(), *values.tolist()])

    def _call(self, x: Conditions, p: dict[str, Tensor]) -> Tensor | dict[str, Tensor]:
        """``function(x, p)`` on tensors: ``p[name]`` is ``(*batch, 1)``, or ``(*batch, n)`` where it varies."""
        values = torch.stack(torch.broadcast_tensors(*(p[name] for name in self.names)), dim=-1)
        rows = values.reshape(-1, *values.shape[-2:])
        job = _Job(self, x, None)
        result = _unflatten(_Differenced.apply(rows, job), values.shape[:-2])
        return result if job.found is None else dict(zip(job.found, result.split(len(job.x), dim=-1), strict=True))


def _unflatten(result: Tensor, batch: torch.Size) -> Tensor:
    # Not -1, which has no meaning in an empty batch.
    return result.reshape(*batch, result.shape[-1])


class _Job:
    """The simulator at fixed conditions, on numpy arrays."""

    def __init__(self, simulator: ExternalSimulator, x: Conditions, outputs: Sequence[str] | None) -> None:
        self.simulator = simulator
        self.names = tuple(str(name) for name in x) if isinstance(x, Mapping) else None
        columns = list(x.values()) if isinstance(x, Mapping) else [x]
        arrays = [torch.as_tensor(column).detach().cpu().to(torch.float64).numpy() for column in columns]
        if not arrays or any(array.ndim != 1 or len(array) != len(arrays[0]) for array in arrays):
            shapes = [tuple(array.shape) for array in arrays]
            raise ShapeError(f"Expected conditions of shape (n,), all of one length. Got {shapes}.")
        self.x = np.stack(arrays, axis=-1)  # (n, c)
        self.outputs = None if outputs is None else tuple(outputs)
        self.width = len(self.x) * len(self.outputs or (None,))
        self.found: tuple[str, ...] | None = None

    def steps(self, values: Tensor) -> Tensor:
        """h, the shape of the values."""
        sizes = []
        for i, parameter in enumerate(self.simulator.parameters):
            size = values[..., i].abs()
            if parameter.transform == "log":
                size = size.clamp_min(torch.finfo(size.dtype).tiny)
            elif parameter.low is not None and parameter.high is not None:
                size = torch.full_like(size, 0.5 * (parameter.high - parameter.low))
            else:
                open_ = parameter.low is None and parameter.high is None  # it may cross 0, which is then no scale
                size = size.clamp_min(abs(parameter.initial or 0.0) or (1.0 if open_ else 0.0))
                size = torch.where(size > 0, size, torch.ones_like(size))
            sizes.append(size)
        return self.simulator.step * torch.stack(sizes, dim=-1)

    def __call__(self, values: Array) -> Array:
        """Outputs ``(R, outputs * n)`` at values ``(R, L, d)`` with L = 1 or n."""
        simulator, n = self.simulator, len(self.x)
        count = values.shape[-1]
        if simulator.vectorized and values.shape[1] > 1 and len(values):
            parts = [self._each(part) for part in np.array_split(values, -(-values.size * n // (AT_ONCE * count)))]
            width = max(part.shape[1] for part in parts)  # a part without any answer does not know how many outputs
            return np.concatenate([p if p.shape[1] == width else np.full((len(p), width), np.nan) for p in parts])
        call: ArrayCall | PointCall
        if simulator.vectorized:
            rows = values[:, 0]
            call = ArrayCall(simulator.external, self.names, simulator.names, self.x)
        else:
            points = np.broadcast_to(values, (len(values), n, count))
            x = np.broadcast_to(self.x, (len(values), *self.x.shape))
            rows = np.concatenate([x, points], axis=-1).reshape(-1, self.x.shape[1] + count)
            call = PointCall(simulator.external, self.names, simulator.names)
        good = np.asarray(np.isfinite(rows).all(axis=-1))
        unique, inverse = np.unique(rows[good], axis=0, return_inverse=True)
        found = self._run(call, unique)  # (m, U) or (m, U, n)
        if found is None:
            return np.full((len(values), self.width), np.nan)
        result = np.full((len(found), len(rows), *found.shape[2:]), np.nan)
        result[:, good] = found[:, inverse.reshape(-1)]
        self.width = len(found) * n
        result = result.reshape(len(found), len(values), n)
        return result.transpose(1, 0, 2).reshape(len(values), self.width)

    def _each(self, values: Array) -> Array:
        """Outputs ``(R, outputs * n)`` of a vectorized function at values of their own for all conditions, ``(R, n,
        d)``: of those of every value at all conditions the one where it holds."""
        length, n, count = values.shape
        unique, inverse = np.unique(values.reshape(-1, count), axis=0, return_inverse=True)
        found = self(unique[:, None]).reshape(len(unique), -1, n)
        own = found[inverse.reshape(length, n), :, np.arange(n)]  # (R, n, outputs)
        return np.asarray(own.transpose(0, 2, 1).reshape(length, -1))

    def _run(self, call: ArrayCall | PointCall, rows: Array) -> Array | None:
        values: list[Value | None] = [None] * len(rows)  # None where there is no number
        tasks = rows.tolist()
        try:
            # Thousands of calls share the executor: a pool that stands in for a broken one is not opened for each.
            run_tasks(
                Forgiving(call), tasks, executor=self.simulator.executor, on_result=values.__setitem__, keep_pool=True
            )
        except TaskError as failure:
            raise failed_evaluation(failure, call.describe(tasks[failure.index])) from failure.error
        done = [(task, *value) for task, value in zip(tasks, values, strict=True) if value is not None]
        if not done:
            return None
        names = self.found = done[0][1]
        for task, other, _ in done:
            if other != names:
                raise SimulatorError(
                    f"Expected the same outputs from every evaluation. Got {names} and {other}, the latter in row "
                    f"{task}."
                )
        nothing = (names, np.full_like(done[0][2], np.nan))
        stacked = np.stack([value for _, value in (one or nothing for one in values)], axis=1)
        if names is None or self.outputs is None:
            return stacked
        missing = [name for name in self.outputs if name not in names]
        if missing:
            raise SimulatorError(
                f"Expected outputs {list(self.outputs)} from the simulator. Got {list(names)}: {missing} missing. "
                "Use the same names in the recording and in the function's result."
            )
        return stacked[[names.index(name) for name in self.outputs]]


class _Differenced(torch.autograd.Function):
    """Values of a `_Job`, with central differences as their gradient, itself differentiable."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, job: _Job) -> Tensor:
        ctx.save_for_backward(values)
        ctx.save_for_forward(values)
        ctx.job = job
        found = job(values.detach().cpu().to(torch.float64).numpy())
        return torch.from_numpy(found).to(values)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        """Central difference along one direction for each row."""
        (values,) = ctx.saved_tensors
        direction = tangents[0].detach().to(torch.float64)
        centre = values.detach().to(torch.float64)
        size = (direction.abs() / ctx.job.steps(centre)).amax(dim=(1, 2), keepdim=True)
        moved = direction / torch.where(size > 0, size, torch.ones_like(size))
        up, down = torch.as_tensor(ctx.job(torch.cat([centre + moved, centre - moved]).cpu().numpy())).chunk(2)
        change = _over_two_steps(up, down, lambda: torch.as_tensor(ctx.job(centre.cpu().numpy())))
        return (0.5 * size[:, :, 0].cpu() * change).to(values)

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, None]:
        (slope,) = slopes
        (values,) = ctx.saved_tensors
        if not ctx.needs_input_grad[0]:
            return None, None
        # Rows that nothing depends on need no evaluations; a second derivative may depend on any.
        used = torch.ones(len(values), dtype=torch.bool, device=values.device)
        if not torch.is_grad_enabled():
            used = (slope != 0).any(-1)
        if not bool(used.any()):
            return torch.zeros_like(values), None
        # In float64 whatever the values are: a step of 1e-4 would drown in float32.
        picked = values[used].to(torch.float64)
        rows, length, count = picked.shape
        shift = ctx.job.steps(picked.detach()) * torch.eye(count).to(picked)[:, None, None]
        above, below = picked + shift, picked - shift  # (count, rows, length, count)
        points = torch.cat([above, below]).reshape(2 * count * rows, length, count)
        up, down = _Differenced.apply(points, ctx.job).reshape(2, count, rows, -1)
        n = len(ctx.job.x)
        # The distance that is left after rounding, against outputs that list n conditions once for each output.
        double = (above - below).detach().diagonal(dim1=0, dim2=3).permute(2, 0, 1)  # (count, rows, length)
        double = double.expand(count, rows, n).repeat(1, 1, up.shape[-1] // n)
        change = _over_two_steps(up, down, lambda: _Differenced.apply(picked, ctx.job))
        # Where there is no slope at all, none is asked for, or NaN would spread to the other conditions.
        asked = (slope[used].to(up) != 0) | change.isfinite()
        parts = torch.where(asked, change, torch.zeros_like(change)) / double * slope[used].to(up)
        if length == 1:
            grad = parts.sum(-1, keepdim=True)
        else:
            grad = parts.reshape(count, rows, -1, n).sum(2)
        grad = grad.permute(1, 2, 0).to(values.dtype)
        return torch.zeros_like(values).index_put((used.nonzero()[:, 0],), grad), None


def _over_two_steps(up: Tensor, down: Tensor, middle: Callable[[], Tensor]) -> Tensor:
    """Differences over two steps; where one side has no answer, twice that over the other step."""
    good = up.isfinite() & down.isfinite()
    if bool(good.all()):
        return up - down
    centre = middle()
    return torch.where(good, up - down, 2.0 * torch.where(up.isfinite(), up - centre, centre - down))
