"""Columns of data frames and of CSV files."""

import os
import warnings
from collections.abc import Sequence
from typing import Any

from torchcal.errors import MissingDependencyError, RecordingError

__all__ = ["check_columns", "column_names", "read_csv"]


def column_names(columns: str | Sequence[str] | None) -> list[str]:
    """One name, several or none as a list."""
    return [columns] if isinstance(columns, str) else list(columns or ())


def check_columns(frame: Any, names: Sequence[str], instead: str) -> None:
    """Raise if this is no data frame, or if a column does not exist or is named twice."""
    if not hasattr(frame, "columns"):
        raise RecordingError(f"Expected a data frame. Got {type(frame).__name__} (use {instead} for arrays).")
    available = list(frame.columns)
    for position, name in enumerate(names):
        if name not in available:
            raise RecordingError(
                f"Expected columns among {available}. Got {name!r} (check the spelling and the spaces)."
            )
        if name in names[:position]:
            raise RecordingError(f"Expected each column once. Got {name!r} twice (leave one out).")


def read_csv(path: str | os.PathLike[str], names: Sequence[str]) -> Any:
    """A CSV file with a header line as a pandas DataFrame; one that is no table, or has a name twice, is an error."""
    try:
        import pandas
    except ImportError as error:
        raise MissingDependencyError(
            "Expected pandas for Recording.from_csv. Got no such package (pip install pandas, or give arrays)."
        ) from error
    try:
        with warnings.catch_warnings():
            # Lines longer than the header: by default pandas shifts every column by one, without a word.
            warnings.simplefilter("error", pandas.errors.ParserWarning)
            frame = pandas.read_csv(path, skipinitialspace=True, index_col=False)
            suspects = [name for name in names if f"{name}.1" in frame.columns]  # what pandas makes of a second one
            if not suspects:
                return frame
            options = {"header": None, "nrows": 1, "dtype": str, "keep_default_na": False}
            header = list(pandas.read_csv(path, skipinitialspace=True, index_col=False, **options).iloc[0])
    except (ValueError, pandas.errors.ParserWarning) as error:
        raise RecordingError(
            f"Expected a CSV file with a header line in {os.fspath(path)}. Got: {error} "
            "(read it with pandas.read_csv and its options, then use Recording.from_frame)."
        ) from error
    for name in suspects:
        if header.count(name) > 1:
            raise RecordingError(
                f"Expected one column {name!r} in {os.fspath(path)}. Got {header.count(name)} of that name (rename "
                "them in the file)."
            )
    return frame
