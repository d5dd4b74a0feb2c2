"""How large the sets of the polynomial-chaos files may be."""

from torchcal.errors import DomainError

# Index and node sets above this size are almost always a mistake: 1e7 rows of 4 columns fill 320 MB.
MAX_ROWS = 10_000_000


def limit_rows(what: str, rows: int, *, advice: str) -> None:
    """Refuse a set that would not fit in memory, before it is built.

    Raises:
        DomainError: If ``rows`` exceeds ``MAX_ROWS``.
    """
    if rows > MAX_ROWS:
        told = rows if rows < 1e15 else "far more"  # which may have more digits than Python prints
        raise DomainError(f"Expected at most {MAX_ROWS} rows in {what}. Got {told} ({advice}).")
