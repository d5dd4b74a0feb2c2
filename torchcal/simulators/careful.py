"""Calls of functions that users write, which are to leave what they are given as it is."""

import copy
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcal.errors import SimulatorError
from torchcal.simulators.dual import transformed

__all__ = ["careful", "real", "takes_inputs", "unknown_name"]


def careful(seen: set[int], what: str, function: Callable[..., Any], **given: Any) -> Any:
    """``function(*given)``; the first time on copies, to see that it changes none of them in place.

    Plain dicts are always copies: what a function puts into one is its own.

    Args:
        seen: Of a simulator or term, those of its functions that have been called before.
        what: Whose function it is, in words.
        function: It.
        given: Its arguments, by their usual letters.

    Raises:
        SimulatorError: If it changed one in place.
    """
    if id(function) in seen:
        return function(*(dict(value) if type(value) is dict else value for value in given.values()))
    copies = {letter: _copied(value) for letter, value in given.items()}
    # What it puts into a dict is not to hide what it has changed there.
    result = function(*(copy.copy(value) if isinstance(value, dict) else value for value in copies.values()))
    changed = [
        name
        for letter, value in given.items()
        for (name, before), after in zip(_named(letter, value), _named(letter, copies[letter]), strict=True)
        if _is_changed(before, after[1])
    ]
    if changed:
        raise SimulatorError(
            f"Expected {what} to leave what it is given as it is. Got {', '.join(changed)} changed in place, as by += "
            f"or clamp_(). Work on a copy, {changed[0]}.clone(), or write x = x + 1 for x += 1 and x.clamp() for "
            "x.clamp_()."
        )
    if not any(transformed(value) for one in given.values() for _, value in _named("", one)):  # there it cannot be seen
        seen.add(id(function))
    return result


def real(value: Any, like: Tensor, shape: torch.Size, what: str) -> Tensor:
    """What a user's function gave, as real numbers of some shape.

    Args:
        value: A tensor or a number.
        like: Tensor of the dtype that numbers get.
        shape: Wanted, which it is spread over.
        what: It, in words.

    Raises:
        SimulatorError: If it is no real number, or has another shape.
    """
    if not isinstance(value, Tensor):
        try:
            numbers = np.asarray(value)
            numbers = np.asarray(float(value)) if numbers.dtype == object and not numbers.ndim else numbers
        except Exception:  # what does not become numbers is told below
            numbers = np.asarray("")
        value = torch.as_tensor(numbers, dtype=like.dtype) if numbers.dtype.kind in "biuf" else value
    if not isinstance(value, Tensor) or value.is_complex():
        got = f"{value.dtype}" if isinstance(value, Tensor) else type(value).__name__
        raise SimulatorError(
            f"Expected {what} as a tensor of real numbers. Got {got} (compute it with torch from what is given)."
        )
    value = value if value.dtype == like.dtype else value.to(like)
    try:
        return value if value.shape == shape else value.expand(shape)
    except RuntimeError as error:
        raise SimulatorError(
            f"Expected {what} of shape {tuple(shape)}. Got {tuple(value.shape)} (write it elementwise)."
        ) from error


def takes_inputs(function: Callable[..., Any]) -> bool:
    """Whether a function of an initial value is ``f(s, p, u)`` rather than ``f(s, p)``."""
    try:
        wanted = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of some that are not written in Python
        return False
    places = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(one.kind in places and one.default is one.empty for one in wanted) > 2


def unknown_name(error: Exception, s: Mapping[str, Any], p: Mapping[str, Any], u: Mapping[str, Any]) -> str:
    """What there is beside a name that a function in time asked for in vain, in a sentence; empty for other errors."""
    name = error.args[0] if isinstance(error, KeyError) and error.args else None
    if not isinstance(name, str) or any(name in given for given in (s, p, u)):
        return ""
    return (
        f" There is no {name!r} among states {list(s)}, parameters {list(p)} and inputs {list(u)} (inputs come with "
        "the runs, Run(inputs=...))."
    )


def _copied(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.clone()
    if not isinstance(value, dict):
        return value
    twin = copy.copy(value)
    for name, one in value.items():
        twin[name] = _copied(one)
    return twin


def _named(letter: str, value: Any) -> list[tuple[str, Any]]:
    if isinstance(value, Mapping):
        return [(f"{letter}[{name!r}]", one) for name, one in value.items()]
    return [(letter, value)]


def _is_changed(before: Any, after: Any) -> bool:
    if not isinstance(before, Tensor):
        return False
    if not after.is_inference() and after._version > 0:
        return True
    if transformed(before) or before.shape != after.shape:
        return before.shape != after.shape
    with torch.no_grad():  # arrays of NumPy's on the same memory leave no trace but their numbers
        return not bool(((before == after) | (before != before)).all())
