"""How the families write their parameters and candidates."""

from collections.abc import Callable, Mapping
from typing import Any

import torchcal as tc
from torchcal.terms import Term

#: A base model and its candidates, for the outputs that were recorded.
Builder = Callable[[tuple[str, ...]], tuple[tc.Simulator, list[Term]]]
ZERO = 273.15


def positive(name: str, unit: str, initial: float) -> tc.Parameter:
    return tc.Parameter(name, unit=unit, low=0.0, initial=initial)


def term(
    name: str,
    equation: str | Mapping[str, Callable[..., Any]],
    rate: Callable[..., Any] | None = None,
    *,
    low: float | None = 0.0,
    shapes: Mapping[str, str] | None = None,
    formula: str = "",
) -> Term:
    """A user's term with the amplitude ``a``, and shape parameters measured on the scale of a driver."""
    parameters = [tc.Parameter("a", low=low, neutral=0.0), *(tc.Parameter(shape) for shape in shapes or {})]
    where: dict[str, Any] = (
        {"rates": dict(equation)} if isinstance(equation, Mapping) else {"equation": equation, "rate": rate}
    )
    return Term(name, **where, parameters=parameters, scales=dict(shapes or {}), formula=formula)


def seen(name: str, output: str, function: Callable[..., Any], *, low: float | None = 0.0, formula: str = "",
         shapes: Mapping[str, tuple[float, float] | str] | None = None) -> Term:  # fmt: skip
    """A user's term of a static model, ``function(x, p, y)`` in place of its response y."""
    bounds = {name: ends for name, ends in (shapes or {}).items() if not isinstance(ends, str)}
    scales = {name: driver for name, driver in (shapes or {}).items() if isinstance(driver, str)}
    parameters = [
        tc.Parameter("a", low=low, neutral=0.0),
        *(tc.Parameter(shape, low=ends[0], high=ends[1]) for shape, ends in bounds.items()),
        *(tc.Parameter(shape) for shape in scales),
    ]
    return Term(name, outputs={output: function}, parameters=parameters, scales=scales, formula=formula)
