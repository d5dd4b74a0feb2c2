"""Checks of arguments that every room makes."""

import math
import operator
from typing import Any

import torch
from torch import Tensor

from torchcal.errors import DomainError

__all__ = ["as_seed", "by_default_on_cpu", "outside_inference_mode", "positive", "real_number", "whole"]

#: The largest seed: generators take 32 bits, and chains add to it.
LARGEST = 2**31 - 1


def by_default_on_cpu() -> None:
    """Raise where new tensors are made on another device than the CPU, where recordings and rules are made.

    Raises:
        DomainError: If ``torch.set_default_device`` or ``with torch.device(...)`` says so.
    """
    device = torch.get_default_device()
    if device.type != "cpu":
        raise DomainError(
            f"Expected the CPU as torch's default device. Got {device} (set it back, torch.set_default_device(None), "
            "and say where to compute: calibrate(..., device='cuda'), or NISP(...).to('cuda') in a model of your own)."
        )


def outside_inference_mode() -> None:
    """Raise within ``torch.inference_mode()``, which takes no derivatives.

    Raises:
        DomainError: If it is on.
    """
    if torch.is_inference_mode_enabled():
        raise DomainError(
            "Expected a call outside torch.inference_mode(), which takes no derivatives. Got one within "
            "(torch.no_grad() is allowed)."
        )


def real_number(value: Any) -> float:
    """One real number, Python's, NumPy's or torch's, as a float; NaN of a string, a flag or anything else.

    >>> [real_number(value) for value in (2, torch.tensor(0.5), "1", True, [1.0])]
    [2.0, 0.5, nan, nan, nan]
    """
    dtype = getattr(value, "dtype", None)
    if dtype is not None:
        count = value.numel() if isinstance(value, Tensor) else getattr(value, "size", 0)
        if count != 1 or getattr(dtype, "kind", "f") not in "iuf":
            return math.nan
        value = value.item()
    if isinstance(value, str | bytes | bytearray | bool):
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def positive(name: str, value: Any) -> float:
    """Return ``value`` as a ``float``.

    Raises:
        DomainError: If it is not a number above zero, or infinite.
    """
    number = real_number(value)
    if not 0 < number < math.inf:
        raise DomainError(f"Expected {name} > 0 and finite. Got {value!r}.")
    return number


def whole(name: str, value: Any, minimum: int, *, also: str = "", advice: str = "") -> int:
    """Return ``value`` as an ``int``; an integer of NumPy's or torch's is one too.

    ``also`` says what else may be given, which the caller has seen to; ``advice`` what to do.

    Raises:
        DomainError: If ``value`` is not a whole number or is below ``minimum``. A float such as ``2.0`` and
            a bool are refused, because they are more often a slip than an intention.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool) or number < minimum:
        wanted = f"a whole number >= {minimum}" + (f", {also}" if also else "")
        tail = f" ({advice})" if advice else ""
        raise DomainError(f"Expected {name} to be {wanted}. Got {name}={value!r}{tail}.")
    return number


def as_seed(value: Any) -> int:
    """Return a seed as an ``int``: one that every generator takes, with what is added to it for each chain.

    Raises:
        DomainError: If ``value`` is not a whole number from 0 to 2**31 - 1.
    """
    seed = whole("seed", value, 0)
    if seed > LARGEST:
        raise DomainError(f"Expected seed from 0 to {LARGEST}. Got seed={seed} (choose a smaller one).")
    return seed
