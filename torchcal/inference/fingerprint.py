"""What settings are, as a text that is the same in every process and changes with what they do."""

import dataclasses
import dis
import functools
import hashlib
import inspect
from collections.abc import Callable, Mapping
from types import CodeType
from typing import Any

import numpy as np
import torch
from torch import Tensor

__all__ = ["fingerprint"]

PLAIN = str | bytes | int | float | complex | np.generic | None
"""What says in a text all that it is."""

_Memo = dict[Any, tuple[Any, str]]
"""What has been told, by what it is asked for; while it is being told, a dot stands for it: values may hold themselves.
The value is kept beside it, so that its id stays its own."""


def fingerprint(value: Any, memo: _Memo | None = None) -> str:
    """What a value is, the same in every process: arrays and functions by their contents, classes by their names."""
    if isinstance(value, Tensor | np.ndarray):
        return _numbers(value)
    if isinstance(value, PLAIN):
        return repr(value)
    memo = {} if memo is None else memo
    return _once(id(value), value, memo, lambda: _parts(value, memo))


def _once(key: Any, value: Any, memo: _Memo, tell: Callable[[], str]) -> str:
    if key not in memo:
        memo[key] = value, "."
        memo[key] = value, tell()
    return memo[key][1]


def _numbers(value: Tensor | np.ndarray) -> str:
    if isinstance(value, Tensor):
        known = value.detach().cpu().to_dense()  # a sparse one; and NumPy has no bfloat16
        value = (known.float() if known.dtype == torch.bfloat16 else known).numpy()
    return f"{value.dtype}{value.shape}{hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}"


def _parts(value: Any, memo: _Memo) -> str:
    tell = functools.partial(fingerprint, memo=memo)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{tell(key)}: {tell(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(tell, value)) + "]"
    if isinstance(value, set | frozenset):  # which has another order in every process
        return "{" + ", ".join(sorted(map(tell, value))) + "}"
    if isinstance(value, functools.partial):
        return f"partial{tell([value.func, value.args, value.keywords])}"
    if inspect.ismethod(value):
        return f"method{tell([value.__func__, value.__self__])}"
    if hasattr(value, "__qualname__"):
        return f"{value.__module__}.{value.__qualname__}" + _does(value, memo)
    if dataclasses.is_dataclass(value):
        return type(value).__qualname__ + tell({f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    if repr(value) == object.__repr__(value):
        return type(value).__qualname__ + tell(getattr(value, "__dict__", {}))
    return repr(value)


def _does(function: Any, memo: _Memo) -> str:
    """What a function does that is not torchcal's: its code, and the values that this takes from elsewhere."""
    code = getattr(function, "__code__", None)
    if code is None or str(function.__module__).split(".")[0] == "torchcal":
        return ""
    inside, names = _code(code)
    cells = [_cell(cell) for cell in function.__closure__ or ()]
    known = [function.__globals__[name] for name in names if name in function.__globals__]
    taken = [function.__defaults__, function.__kwdefaults__, *cells, *known]
    return hashlib.sha256(repr([inside, [_taken(value, memo) for value in taken]]).encode()).hexdigest()


def _taken(value: Any, memo: _Memo) -> str:
    """A value that a function takes from elsewhere; of an object, which may change as it is used, its type alone."""
    inner = functools.partial(_taken, memo=memo)
    if isinstance(value, Mapping):
        pairs = value.items()
        return _once(("taken", id(value)), value, memo, lambda: repr([(str(key), inner(item)) for key, item in pairs]))
    if isinstance(value, list | tuple):
        return _once(("taken", id(value)), value, memo, lambda: repr([inner(item) for item in value]))
    if isinstance(value, PLAIN | Tensor | np.ndarray | functools.partial) or hasattr(value, "__qualname__"):
        return fingerprint(value, memo)
    return type(value).__qualname__


def _code(code: CodeType) -> tuple[list[str], list[str]]:
    """Instructions and constants of a function and those within it, and the names that they look up elsewhere, but do
    not change themselves."""
    changed = {one.argval for one in dis.get_instructions(code) if one.opname == "STORE_GLOBAL"}
    inside, names = [code.co_code.hex(), *code.co_names], [name for name in code.co_names if name not in changed]
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            more = _code(constant)
            inside, names = inside + more[0], names + more[1]
        else:  # a set has another order in every process
            inside.append(repr(sorted(map(repr, constant)) if isinstance(constant, frozenset) else constant))
    return inside, names


def _cell(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not filled yet
        return None
