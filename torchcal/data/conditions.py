"""Conditions that a model is asked for: checked float64 tensors, one or by name."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchcal.data.arrays import to_tensor
from torchcal.errors import DomainError, RecordingError, ShapeError

__all__ = ["checked"]


def checked(
    x: Any, names: tuple[str, ...] | None, units: Mapping[str, str] | None = None
) -> Tensor | dict[str, Tensor]:
    """Conditions as float64 tensors, one where there are no ``names``, else a dict of tensors of one length.

    Raises:
        DomainError: If they are not, or a number is not finite.
    """
    units = units or {}
    if names is None:
        if isinstance(x, Mapping):
            raise DomainError(f"Expected conditions as one array, as in the recording. Got a dict {list(x)}.")
        return _vector(x, "x", units)
    if not isinstance(x, Mapping) or set(x) != set(names):
        got = list(x) if isinstance(x, Mapping) else type(x).__name__
        raise DomainError(f"Expected conditions as a dict with {list(names)}. Got {got}.")
    if not x:
        raise DomainError("Expected at least one condition. Got an empty dict.")
    values = {name: _vector(x[name], name, units) for name in names}
    if len({len(value) for value in values.values()}) > 1:
        raise DomainError(
            f"Expected conditions of one length. Got { {name: len(v) for name, v in values.items()} }."
        )
    return values


def _vector(value: Any, name: str, units: Mapping[str, str]) -> Tensor:
    try:
        array = to_tensor(value, name, units.get(name))[0]
    except (RecordingError, ShapeError) as error:
        raise DomainError(str(error)) from error
    if array.ndim == 0:
        array = array[None]
    if array.ndim != 1 or not len(array) or not bool(torch.isfinite(array).all()):
        what = f"shape {tuple(array.shape)}" if array.ndim != 1 or not len(array) else "values that are not finite"
        raise DomainError(f"Expected condition {name!r} as finite numbers of shape (n,). Got {what}.")
    return array
