"""A diagnosis as text that other programs read: everything but what is code."""

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchcal.data import Recording
from torchcal.files import replacing

if TYPE_CHECKING:
    from torchcal.discovery.findings.result import Diagnosis

__all__ = ["plain", "text_of", "write"]

FORMAT = 1

_CODE = ("simulator", "improved")


def write(diagnosis: "Diagnosis", path: str | os.PathLike[str]) -> None:
    """Write a diagnosis as JSON, whole or not at all.

    Raises:
        DomainError: If the folder does not exist.
    """
    fields = [field.name for field in dataclasses.fields(diagnosis) if field.name not in _CODE]
    content = {"format": FORMAT, "kind": "diagnosis", "text": str(diagnosis)}
    content |= {name: plain(getattr(diagnosis, name)) for name in fields}
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False), encoding="utf-8")


def text_of(path: str | os.PathLike[str]) -> str | None:
    """The diagnosis in words that a file holds which `write` wrote; None of any other file."""
    try:
        with open(path, encoding="utf-8") as file:
            content = json.load(file)
    except (OSError, ValueError, RecursionError):
        return None
    text = content.get("text") if isinstance(content, dict) and content.get("kind") == "diagnosis" else None
    return text if isinstance(text, str) else None


def plain(value: Any) -> Any:
    """Records, tables, tensors and recordings as dicts, lists and numbers; None for what is infinite or no number.

    >>> import torch
    >>> plain({"sd": torch.tensor([0.5, torch.inf]), "spans": ((0.0, 1.0),)})
    {'sd': [0.5, None], 'spans': [[0.0, 1.0]]}
    """
    if isinstance(value, Tensor | np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Recording):
        names = ("x", "y", "noise", "units", "outputs") if value.runs is None else ("runs", "noise", "units", "outputs")
        return {name: plain(getattr(value, name)) for name in names}
    if dataclasses.is_dataclass(value):
        public = [field.name for field in dataclasses.fields(value) if not field.name.startswith("_")]
        return {name: plain(getattr(value, name)) for name in public}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | bool | int) else str(value)
