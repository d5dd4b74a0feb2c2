"""Static simulators: outputs as a function of conditions and parameters."""

import re
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchcal.checks import whole
from torchcal.data import Recording
from torchcal.display import raised, raised_there
from torchcal.errors import DomainError, ShapeError, SimulatorError, TorchcalError
from torchcal.simulators.careful import careful
from torchcal.simulators.dual import Still, still
from torchcal.simulators.parameter import Parameter, spans
from torchcal.simulators.solution import Solution

__all__ = ["Conditions", "Linearisation", "Simulator", "asks_for_numbers", "check_parameters", "check_static",
           "nameless_advice"]  # fmt: skip

_DUAL = threading.RLock()
"""torch keeps one level of forward derivatives for the whole process, and refuses a second thread its own."""

#: Share of the largest output that rounding may leave of another one, of a difference or of a system that is solved.
CANCELLED = 1e-12

Conditions = Tensor | Mapping[str, Tensor]


@dataclass(frozen=True)
class Linearisation:
    """Outputs and their derivatives at some parameter values.

    Attributes:
        y: Outputs, ``(H, n)``.
        jacobian: ∂y/∂λ in physical units, ``(H, n, columns)``.
        warm: Of simulators in time, what makes a call at nearby values cheaper; hand it back to `Simulator.linearise`.
    """

    y: Tensor
    jacobian: Tensor
    warm: Solution | None = None


def check_values(values: Tensor, names: Sequence[str]) -> None:
    """Raise unless values are real numbers ``(*batch, d)``, one for each parameter."""
    if not isinstance(values, Tensor) or not values.is_floating_point():
        got = values.dtype if isinstance(values, Tensor) else type(values).__name__
        raise ShapeError(f"Expected parameter values as a tensor of floating-point numbers. Got {got} (use .double()).")
    if values.ndim == 0 or values.shape[-1] != len(names):
        raise ShapeError(
            f"Expected parameter values of shape (*batch, {len(names)}): {', '.join(names)}. Got {tuple(values.shape)}."
        )


def check_parameters(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Return the parameters as a tuple, or raise if one is not a `Parameter` or is named twice."""
    if isinstance(parameters, Parameter) or not isinstance(parameters, Iterable):
        raise DomainError(
            f"Expected a list of torchcal.Parameter objects. Got {parameters!r:.100}. Put it in brackets: "
            "parameters=[Parameter(...)]."
        )
    parameters = tuple(parameters)
    if not parameters:
        raise DomainError("Expected at least one parameter. Got none. Pass parameters=[Parameter(...), ...].")
    for parameter in parameters:
        if not isinstance(parameter, Parameter):
            raise DomainError(
                f"Expected torchcal.Parameter objects. Got {type(parameter).__name__}: {parameter!r}."
            )
    names = [parameter.name for parameter in parameters]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DomainError(f"Expected every parameter named once. Got {twice} more than once in {names}.")
    return parameters


def check_static(parameters: Sequence[Parameter]) -> None:
    """Refuse parameters with a value for each run, where there are no runs."""
    if each := [parameter.name for parameter in parameters if parameter.per_run]:
        raise DomainError(
            f"Expected parameters with one value for all conditions. Got per_run=True for {each}: a static "
            "recording has no runs (drop it and give each table a parameter of its own, or use an ODESimulator)."
        )


class Simulator:
    r"""A model y = f(x; λ) written with torch operations.

    The function is called as ``function(x, p)``. ``x`` is a tensor ``(n,)``, or a dict of them where there are
    several conditions; ``p[name]`` has shape ``(*batch, 1)``. Elementwise code is therefore batched code. It
    returns a tensor ``(*batch, n)``, or a dict of them where there are several outputs, and leaves the tensors that it
    is given as they are.

    Args:
        function: ``function(x, p)``.
        parameters: In the order in which results list them.
        degree: Total degree in the parameters, where the function is a polynomial in them. Propagation is then
            exact with the fewest nodes; without it the number of nodes is found by trial.

    Raises:
        DomainError: If there is no parameter, one is named twice, or one has ``per_run=True``: there are no runs.

    >>> line = Simulator(lambda x, p: p["a"] + p["b"] * x, [Parameter("a"), Parameter("b")])
    >>> line.at(torch.tensor([0.0, 1.0]))(torch.tensor([2.0, 3.0]))
    tensor([2., 5.])
    """

    dear: bool = False
    """Whether there is much to do for each call, whatever it is given: then all is asked for at once."""

    unlike = (
        "Write the simulator elementwise: p[name] has shape (*batch, 1), x has shape (n,), the result (*batch, n); and "
        "leave random numbers out of it."
    )
    """What to do where outputs differ from call to call."""

    extended: tuple[Any, tuple[Any, ...]] | None = None
    """Of a simulator that terms were added to: the one without them, and the terms (`torchcal.terms.extend`)."""

    def __init__(
        self,
        function: Callable[[Any, dict[str, Tensor]], Any],
        parameters: Sequence[Parameter],
        *,
        degree: int | None = None,
    ) -> None:
        if not callable(function):
            raise DomainError(f"Expected a callable f(x, p). Got {type(function).__name__}.")
        self.function = function
        self.parameters = check_parameters(parameters)
        check_static(self.parameters)
        self.degree = None if degree is None else whole("degree", degree, 0, also="or None")
        self.seen: set[int] = set()

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters' names, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(parameters={list(self.names)})"

    def at(self, x: Conditions, outputs: Sequence[str] | None = None) -> Callable[[Tensor], Tensor]:
        """The simulator at fixed conditions, as a function of parameter values alone.

        Args:
            x: Conditions, ``(n,)`` or a dict of them.
            outputs: Names and order of the outputs wanted, where the function returns a dict.

        Returns:
            A function from values ``(*batch, d)``, physical units, to outputs ``(*batch, n)``, or
            ``(*batch, n_outputs * n)`` with one output after another.
        """
        n = _length(x)
        outputs = None if outputs is None else tuple(outputs)
        # A copy: whatever the function does, the recording stays as it is.
        x = {name: _copied(value) for name, value in x.items()} if isinstance(x, Mapping) else _copied(x)

        def evaluate(values: Tensor) -> Tensor:
            check_values(values, self.names)
            p = {name: values[..., i : i + 1] for i, name in enumerate(self.names)}
            try:
                result = careful(self.seen, "the simulator", self.function, x=x, p=p)
            except TorchcalError:  # a term's, which says what to do
                raise
            except Exception as error:
                raise SimulatorError(
                    f"Expected the simulator to return a tensor. It raised {raised(error)}. "
                    f"It was called with conditions {_describe(x)} and parameters of shape "
                    f"{(*values.shape[:-1], 1)} ({spans(p)}).{_advice(error, x, self.names)}"
                ) from error
            return self._flatten(result, values, n, outputs)

        return evaluate

    def bind(self, recording: Recording) -> "Simulator":
        """The simulator of this recording's outputs; a static one is that already."""
        return self

    def linearise(
        self,
        x: Conditions,
        values: Tensor,
        outputs: Sequence[str] | None = None,
        columns: Sequence[int] | None = None,
        warm: Solution | None = None,
        *,
        march: bool = True,
    ) -> Linearisation:
        """Outputs and their exact derivatives by the parameters: in forward mode, in reverse where some part has none.

        Args:
            x: Conditions.
            values: Parameter values, ``(H, d)``, physical units.
            outputs: Names of the outputs wanted.
            columns: Places of the parameters to derive by; all by default.
            warm: ``warm`` of an earlier result at nearby values.
            march: For simulators in time: whether to solve step by step where the warm start does not help.
        """
        values = values.detach()
        columns = list(range(values.shape[-1])) if columns is None else list(columns)
        if not columns:
            with torch.no_grad():
                y = self.at(x, outputs)(values)
            return Linearisation(y, y.new_zeros(*y.shape, 0))
        try:
            return self._forward(x, values, outputs, columns)
        except (RuntimeError, SimulatorError) as error:
            # A user's own autograd.Function may have a backward() and no jvp(), as some operations of torch have, and
            # a simulator may differentiate forwards by itself, which torch does not nest.
            if self.dear or not isinstance(error.__cause__ or error, RuntimeError):
                raise
            try:
                return self._reverse(x, values, outputs, columns)
            except Exception:
                raise error from error.__cause__

    def _forward(
        self, x: Conditions, values: Tensor, outputs: Sequence[str] | None, columns: Sequence[int]
    ) -> Linearisation:
        """One call for all columns at once."""
        tangent = values.new_zeros(len(columns), *values.shape)
        for j, column in enumerate(columns):
            tangent[j, ..., column] = 1.0
        with _DUAL, torch.no_grad(), forward_ad.dual_level(), Still():
            dual = forward_ad.make_dual(values.expand(len(columns), *values.shape).contiguous(), tangent)
            fixed = {k: still(v) for k, v in x.items()} if isinstance(x, Mapping) else still(x)
            y, derivative = _unpacked(self.at(fixed, outputs)(dual))
            if bool((torch.isfinite(y) & ~torch.isfinite(derivative)).any()):
                # The root of a condition that is 0: it does not move, but 0 times an infinite slope is no number.
                y, derivative = _unpacked(self.at(x, outputs)(dual))
        return Linearisation(y[0], derivative.permute(1, 2, 0))

    def _reverse(
        self, x: Conditions, values: Tensor, outputs: Sequence[str] | None, columns: Sequence[int]
    ) -> Linearisation:
        """A backward pass for every column, through another one; or where that has none, one for every output."""
        leaf = values.clone().requires_grad_(True)
        with torch.enable_grad():
            y = self.at(x, outputs)(leaf)
            weights = torch.ones_like(y, requires_grad=True)  # what is pulled back is linear in them
            try:
                (pulled,) = torch.autograd.grad(y, leaf, weights, create_graph=True)
                ones = [pulled[..., column].sum() for column in columns]
                slopes = [torch.autograd.grad(one, weights, retain_graph=True)[0] for one in ones]
                found = torch.stack(slopes, dim=-1)
                if _complete(found, y, leaf, columns, _length(x)):
                    return Linearisation(y.detach(), found)
            except RuntimeError:
                pass
            rows = [torch.autograd.grad(each.sum(), leaf, retain_graph=True)[0] for each in y.unbind(-1)]
        return Linearisation(y.detach(), torch.stack(rows, dim=-2)[..., columns])

    def _flatten(self, result: Any, values: Tensor, n: int, outputs: Sequence[str] | None) -> Tensor:
        if not isinstance(result, Mapping):
            return _output(result, values, n, "the simulator's result")
        if not result:
            raise SimulatorError("Expected at least one output. Got an empty dict from the simulator.")
        wanted = tuple(outputs) if outputs is not None else tuple(result)
        missing = [name for name in wanted if name not in result]
        if missing:
            raise SimulatorError(
                f"Expected outputs {list(wanted)} from the simulator. Got {list(result)}: {missing} missing. "
                "Use the same names in the recording and in the simulator's result."
            )
        return torch.cat([_output(result[name], values, n, f"output {name!r}") for name in wanted], dim=-1)

    def check(self, x: Conditions, values: Tensor, outputs: Sequence[str] | None = None) -> int:
        """Call the simulator once, before any long work, and look hard at what it returns.

        Args:
            x: Conditions.
            values: Parameter values to try, ``(m, d)``, physical units; one of them must work.
            outputs: Names of the outputs wanted.

        Returns:
            The number of output values, n times the number of outputs.

        Raises:
            SimulatorError: If it raises, returns complex or non-finite numbers or the wrong shape, or if a
                batch of parameter values gives something else than the values one by one.
        """
        evaluate = self.at(x, outputs)
        leaf = values.detach().requires_grad_(True)
        tracked = evaluate(leaf)
        if not tracked.requires_grad:
            raise SimulatorError(
                "Expected outputs that depend on the parameters through torch operations. Got a result without "
                "a gradient. Avoid .item(), .detach() and numpy inside the simulator, or wrap other code in "
                "torchcal.ExternalSimulator."
            )
        together = tracked.detach()
        finite = torch.isfinite(together).all(-1)
        if not bool(finite.any()):
            row, column = (int(i) for i in (~torch.isfinite(together)).nonzero()[0])
            point = {name: float(v) for name, v in zip(self.names, values[row], strict=True)}
            cause = self.raised(x, values[row], column)
            raise SimulatorError(
                f"Expected finite outputs. Got {float(together[row, column])} at output number {column} "
                f"for parameters {point}, and none of {len(values)} parameter values gave finite outputs "
                f"everywhere.{raised_there(cause)} Check the simulator there, or narrow the parameters' bounds or "
                "give initial=."
            ) from cause
        good = finite.nonzero()[:2, 0].repeat(2)[:2]
        with torch.no_grad():
            alone = evaluate(values[good[0]])
            nested = evaluate(values[good].reshape(2, 1, -1))[:, 0]
        difference = torch.maximum((together[good[0]] - alone).abs(), (together[good] - nested).abs().amax(0))
        size = together[good].abs().amax(0)  # and the largest of each output:
        own = size.unflatten(0, (-1, _length(x))).amax(1, keepdim=True).expand(-1, _length(x)).flatten()
        if not bool((difference <= (1e-6 * own).clamp_min(CANCELLED * float(size.max()))).all()):
            raise SimulatorError(
                "Expected the same outputs for parameter values in a batch as one at a time. Got a difference "
                f"of {float(difference.max()):.3g}. {self.unlike}"
            )
        return together.shape[-1]

    def raised(self, x: Conditions, values: Tensor, column: int) -> Exception | None:
        """What a simulator raised where NaN stands for it, at parameters ``(d,)`` and an output; None where nothing."""
        return None


def _complete(found: Tensor, y: Tensor, leaf: Tensor, columns: Sequence[int], rows: int) -> bool:
    """Whether derivatives ``(H, n, columns)`` that went through two backward passes are those of one, for each output.

    A part whose backward pass is not differentiated is lost without a word.
    """
    generator = torch.Generator().manual_seed(0)
    tolerance = torch.finfo(y.dtype).eps ** 0.5
    for part in torch.arange(y.shape[-1]).split(rows):
        signs = torch.zeros(y.shape[-1]).to(y)
        signs[part] = (2 * torch.randint(2, (len(part),), generator=generator) - 1).to(y)
        wanted = torch.autograd.grad((signs * y).sum(), leaf, retain_graph=True)[0][..., columns]
        weighed = signs[:, None] * found
        off, size = (weighed.sum(-2) - wanted).abs(), weighed.norm(dim=-2) + wanted.abs()
        if bool((torch.isfinite(wanted) & ~(off <= tolerance * size)).any()):
            return False
    return True


def _unpacked(dual: Tensor) -> tuple[Tensor, Tensor]:
    """A dual tensor's value and derivative, which is 0 where it has none."""
    found = forward_ad.unpack_dual(dual)
    return found.primal, torch.zeros_like(found.primal) if found.tangent is None else found.tangent


def _length(x: Conditions) -> int:
    first = next(iter(x.values())) if isinstance(x, Mapping) else x
    if first.ndim != 1:
        raise ShapeError(f"Expected conditions of shape (n,). Got {tuple(first.shape)}.")
    return first.shape[0]


def _copied(x: Any) -> Tensor:
    """Of a tensor, where it is: within ``torch.device("cpu")`` ``as_tensor`` would fetch it."""
    return x.clone() if isinstance(x, Tensor) else torch.as_tensor(x).clone()


def _describe(x: Conditions) -> str:
    if isinstance(x, Mapping):
        return "{" + ", ".join(f"{name}: {tuple(value.shape)}" for name, value in x.items()) + "}"
    return str(tuple(x.shape))


def asks_for_numbers(error: Exception) -> bool:
    """Whether torch has refused to make plain numbers of tensors, as NumPy, float() and ``if`` want them."""
    asked = ("numpy()", "__array_wrap__", "converted to Python scalars", "Boolean value of Tensor")
    return any(part in str(error) for part in asked)


def nameless_advice(error: Exception, x: Any) -> str:
    """What to do where a function looked up a name in the one tensor of conditions; "" where it did not."""
    looked_up = isinstance(error, TypeError | IndexError) and re.search(r"\bstr\b|too many indices", str(error))
    if isinstance(x, Mapping) or not looked_up:
        return ""
    return " Here x is a tensor, as in the recording: name its condition there, x={name: values}, or use x itself."


def _advice(error: Exception, x: Conditions, parameters: Sequence[str]) -> str:
    """What to do where a function took x, or what x or p hold, for something else than they are."""
    named = isinstance(x, Mapping)
    if named and set(x) == {"time", "run"} and not isinstance(error, KeyError):
        return (
            " The recording is one in time and the simulator static: it is called with x['time'] and x['run']. Use "
            "torchcal.ODESimulator for a model of rates."
        )
    if isinstance(error, KeyError) and error.args and isinstance(error.args[0], str):
        if not isinstance(x, Mapping):
            return f" Here p holds {list(parameters)} (check the spelling)."
        return (
            f" Here x holds {list(x)}, the recording's conditions, and p holds {list(parameters)}: names in "
            "the recording and in the simulator must agree."
        )
    if asks_for_numbers(error):
        return (
            " Use torch functions on p and x, and torch.where for if: values of many parameters come at once, with "
            "gradients. A function that cannot be written so goes into torchcal.ExternalSimulator."
        )
    if "same device" in str(error) or "expected device" in str(error):
        return " Tensors that the function holds or makes must be on the device of x and p: tensor.to(x.device)."
    if named and "dict" in str(error):
        return f" Here x is a dict, as in the recording: use {', '.join(f'x[{name!r}]' for name in x)}."
    return nameless_advice(error, x)


def _output(result: Any, values: Tensor, n: int, what: str) -> Tensor:
    batch = values.shape[:-1]
    if not isinstance(result, Tensor):
        raise SimulatorError(
            f"Expected {what} as a torch tensor. Got {type(result).__name__}. Use torch functions, or wrap "
            "other code in torchcal.ExternalSimulator."
        )
    if result.is_complex() or not result.is_floating_point():
        raise SimulatorError(f"Expected {what} to be real floating-point numbers. Got {result.dtype}.")
    if result.dtype != values.dtype:
        raise SimulatorError(
            f"Expected {what} in the dtype of the parameters, {values.dtype}. Got {result.dtype}, which loses "
            "precision or mixes dtypes. Make constants with dtype=p[name].dtype."
        )
    shape = (*batch, n)
    if result.shape == shape:
        return result
    try:
        fits = torch.broadcast_shapes(result.shape, shape) == torch.Size(shape)
    except RuntimeError:
        fits = False
    # A result that lacks the condition axis by mistake must not be spread over it in silence.
    if not fits or result.ndim == 0 or (n > 1 and result.shape[-1] != n and result.shape != (*batch, 1)):
        raise SimulatorError(
            f"Expected {what} of shape {shape} (batch, then conditions). Got {tuple(result.shape)}. "
            "p[name] has shape (*batch, 1) and x has shape (n,)."
        )
    return result.expand(shape)
