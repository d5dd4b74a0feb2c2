"""One evaluation of a user's function on plain numbers: calling it, reading its result, naming its point."""

import numbers
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcal.display import raised
from torchcal.errors import SimulatorError
from torchcal.simulators.executor import TaskError, worker_died

__all__ = ["ArrayCall", "Forgiving", "PointCall", "Value", "describe_point", "failed_evaluation", "raised_at"]

Array = NDArray[np.float64]

_DOMAIN = re.compile(
    r"math domain error|expected (a (positive|nonnegative|finite) input|a noninteger or positive integer|"
    r"a number between -1 and 1|argument value (>|not less than) )"
)
"""What the functions of ``math`` say outside their domain: up to Python 3.13, and since."""

Value = tuple[tuple[str, ...] | None, Array]
"""Output names (None for a function of one unnamed output) and their values, outputs first."""


@dataclass(frozen=True)
class PointCall:
    """Calls ``function(x, p)`` at a row of numbers: the conditions', then the parameters'.

    Args:
        function: Gets ``x``, a dict of floats or one float, and ``p``, a dict of floats.
        conditions: Names of the conditions; None where x is one plain float.
        parameters: Names of the parameters.
        vectorized: Whether the function wants arrays of conditions all the same; they get length 1.
        held: Further parameters and their values.
    """

    function: Callable[[Any, dict[str, float]], Any]
    conditions: tuple[str, ...] | None
    parameters: tuple[str, ...]
    vectorized: bool = False
    held: tuple[tuple[str, float], ...] = ()

    def __call__(self, row: Sequence[float]) -> Value:
        """Returns the output names and values ``(outputs,)``."""
        x, p = split_point(row, self.conditions, self.parameters)
        p.update(self.held)
        if not self.vectorized:
            return _read(self.function(x, p), ())
        arrays = np.array([x]) if self.conditions is None else {k: np.array([v]) for k, v in x.items()}
        names, values = _read(self.function(arrays, p), (1,))
        return names, values[:, 0]

    def describe(self, row: Sequence[float]) -> str:
        """The point in words."""
        return describe_point(row, self.conditions, self.parameters)


@dataclass(frozen=True)
class ArrayCall:
    """Calls ``function(x, p)`` with arrays of conditions, at a row of parameters."""

    function: Callable[[Any, dict[str, float]], Any]
    conditions: tuple[str, ...] | None
    parameters: tuple[str, ...]
    x: Array

    def __call__(self, row: Sequence[float]) -> Value:
        """Returns the output names and values ``(outputs, n)``."""
        # Copies, so that a function that works in place does not change what the next call gets.
        if self.conditions is None:
            x: Any = self.x[:, 0].copy()
        else:
            x = {name: self.x[:, i].copy() for i, name in enumerate(self.conditions)}
        p = dict(zip(self.parameters, map(float, row), strict=True))
        return _read(self.function(x, p), (len(self.x),))

    def describe(self, row: Sequence[float]) -> str:
        """The point in words."""
        p = dict(zip(self.parameters, map(float, row), strict=True))
        names = "" if self.conditions is None else f" of {', '.join(self.conditions)}"
        return f"{len(self.x)} conditions{names}, p = {p!r}"


@dataclass(frozen=True)
class Forgiving:
    """A call that gives None where the arithmetic has no answer: searches try points far from anything physical.

    Plain floats raise there (`math.exp(800)`, `1 / 0.0`, `math.log(-1)`), where arrays would give inf or NaN. Where no
    point at all has an answer, `Simulator.check` says what was raised (`raised_at`).
    """

    call: ArrayCall | PointCall

    def __call__(self, row: Sequence[float]) -> Value | None:
        """The call's value, or None."""
        try:
            return self.call(row)
        except ArithmeticError:
            return None
        except ValueError as error:
            if type(error) is ValueError and _DOMAIN.match(str(error)):
                return None
            raise


def raised_at(call: ArrayCall | PointCall, row: Sequence[float]) -> Exception | None:
    """What a call raises at a row, of the kinds that `Forgiving` takes for no answer; else None."""
    try:
        call(row)
    except (Exception, SystemExit) as error:
        return error if isinstance(error, ArithmeticError | ValueError) else None
    return None


def split_point(
    row: Sequence[float], conditions: tuple[str, ...] | None, parameters: tuple[str, ...]
) -> tuple[Any, dict[str, float]]:
    """A row of numbers as ``x`` and ``p``."""
    values = [float(value) for value in row]
    count = 1 if conditions is None else len(conditions)
    x = values[0] if conditions is None else dict(zip(conditions, values[:count], strict=True))
    return x, dict(zip(parameters, values[count:], strict=True))


def describe_point(row: Sequence[float], conditions: tuple[str, ...] | None, parameters: tuple[str, ...]) -> str:
    """A point in words that can be pasted back into Python."""
    x, p = split_point(row, conditions, parameters)
    return f"x = {x!r}, p = {p!r}"


def failed_evaluation(failure: TaskError, point: str, *, everywhere: bool = False) -> SimulatorError:
    """The error of an evaluation that failed, named with its point; ``everywhere`` where NaN would be no answer."""
    error = failure.error
    if worker_died(error):
        others = f" or one of the {failure.suspects - 1} pieces of work sent after it" if failure.suspects > 1 else ""
        return SimulatorError(
            f"A worker process died at {point}{others} ({error}). Call the function there without an executor to "
            "see why; a function that workers cannot import, or too little memory, does this too."
        )
    if isinstance(error, SimulatorError):
        return SimulatorError(f"{error} This happened at {point}.")
    otherwise = "let it return float('nan') where it has no answer"
    if everywhere:
        otherwise = "narrow the bounds so that it has an answer everywhere between them"
    return SimulatorError(
        f"Expected the function to return a number. It raised {raised(error)}. It was called "
        f"with {point}. Mend it there, or {otherwise}."
    )


def _read(result: Any, shape: tuple[int, ...]) -> Value:
    """Output names and float64 values ``(outputs, *shape)`` of what a function returned."""
    if isinstance(result, Mapping):
        if not result:
            raise SimulatorError("Expected at least one output. Got an empty dict.")
        columns = [_numbers(value, shape, f"output {name!r}") for name, value in result.items()]
        return tuple(str(name) for name in result), np.stack(columns)
    return None, _numbers(result, shape, "the function's result")[None]


def _numbers(value: Any, shape: tuple[int, ...], what: str) -> Array:
    if type(value) is float and shape == ():  # nearly always, and then there is nothing to look at
        return np.asarray(value)
    wanted = f"an array of shape {shape}" if shape else "one real number"
    plain = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if isinstance(value, np.ma.MaskedArray) and value.dtype.kind in "fiu":
        value = np.ma.filled(value.astype(np.float64), np.nan)  # what is masked is missing, whatever number lies below
    try:
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
    except Exception as error:
        raise SimulatorError(f"Expected {wanted} as {what}. Got {type(value).__name__}.") from error
    if not plain and array.dtype.kind not in "fiu":
        got = f"complex {value!r}" if array.dtype.kind == "c" else f"{type(value).__name__} {value!r}"
        raise SimulatorError(f"Expected {wanted} as {what}. Got {got:.100}.")
    if shape == () and array.size == 1:
        array = array.reshape(())
    if array.shape != shape:
        raise SimulatorError(f"Expected {wanted} as {what}. Got an array of shape {array.shape}.")
    return array.astype(np.float64)
