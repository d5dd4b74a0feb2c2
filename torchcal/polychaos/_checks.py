"""Argument checks shared by the polynomial-chaos files."""

import operator
from typing import Any

from torchcal.errors import DomainError

# Index and node sets above this size are almost always a mistake: 1e7 rows of 4 columns fill 320 MB.
MAX_ROWS = 10_000_000


def whole(name: str, value: Any, minimum: int, *, advice: str = "") -> int:
    """Return ``value`` as an ``int``.

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


def limit_rows(what: str, rows: int, *, advice: str) -> None:
    """Refuse a set that would not fit in memory, before it is built.

    Raises:
        DomainError: If ``rows`` exceeds ``MAX_ROWS``.
    """
    if rows > MAX_ROWS:
        raise DomainError(f"Expected at most {MAX_ROWS} rows in {what}. Got {rows} ({advice}).")
