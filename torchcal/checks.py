"""Checks of arguments that every room makes."""

import operator
from typing import Any

from torchcal.errors import DomainError

__all__ = ["whole"]


def whole(name: str, value: Any, minimum: int, *, advice: str = "") -> int:
    """Return ``value`` as an ``int``; an integer of NumPy's or torch's is one too.

    Raises:
        DomainError: If ``value`` is not a whole number or is below ``minimum``. A float such as ``2.0`` and
            a bool are refused, because they are more often a slip than an intention.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool) or number < minimum:
        tail = f" ({advice})" if advice else ""
        raise DomainError(f"Expected {name} to be a whole number >= {minimum}. Got {name}={value!r}{tail}.")
    return number
