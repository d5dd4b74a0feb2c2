"""How many threads torch computes with."""

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from typing import ParamSpec, TypeVar

import torch

from torchcal.checks import by_default_on_cpu

__all__ = ["SHARED", "few_threads", "with_torch_settings"]

#: Numbers of which each thread has so many or more: with fewer it waits longer for the others than it computes.
SHARED = 2**18

_GIVEN = threading.local()
_P = ParamSpec("_P")
_R = TypeVar("_R")


@contextlib.contextmanager
def few_threads(numbers: int = 0) -> Iterator[None]:
    """One thread for torch, and one more for every `SHARED` numbers computed at once, up to as many as there were.

    On two cores, one of them busy with something else, a singular value decomposition of 200 x 4 numbers takes two
    threads a hundred times as long as one, and a diagnosis thirty times. Gradients of 2**20 outputs at once take 16
    idle cores a fifth of the time of one, and two, of which one is busy, a quarter longer than one. One within another
    may have more to do. A Python thread that first uses torch meanwhile begins with the number it finds, as torch has
    it.
    """
    now = torch.get_num_threads()
    outermost = not hasattr(_GIVEN, "count")
    try:
        if outermost:
            _GIVEN.count = now
        torch.set_num_threads(max(1, min(_GIVEN.count, numbers // SHARED)))
        yield
    finally:
        torch.set_num_threads(now)
        if outermost:
            _GIVEN.__dict__.pop("count", None)


def with_torch_settings(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function that has one thread, but where it asks for more, and derivatives, also within ``torch.no_grad()``.

    Another default device than the CPU is refused. Warnings are told of the user's line, through it.
    """

    @functools.wraps(function)
    def inner(*args: _P.args, **options: _P.kwargs) -> _R:
        by_default_on_cpu()
        with few_threads(), torch.enable_grad():
            return function(*args, **options)

    return inner
