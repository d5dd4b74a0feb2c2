"""Terms that act only in a range of time, a state, an input or a condition."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchcal.simulators import Parameter
from torchcal.terms import Term

__all__ = ["EDGE", "WIDTHS", "beyond", "is_window", "localised", "region_text"]

#: Width of a window's edges, as a share of the driver's range: wide enough for a fit to move them; and the limits
#: between which it is fitted, from nearly a step.
EDGE, WIDTHS = 0.02, (0.004, 0.1)

_ENDS = {"from": "window from", "to": "window to"}
_EDGE = "window edge"


def localised(
    term: Term, driver: str, low: float, high: float, span: tuple[float, float], *, static: bool, edge: bool = False
) -> Term:
    """The term multiplied by a window of a driver with smooth edges that are fitted with it.

    Args:
        term: The term.
        driver: ``"t"``, a state, an input or a condition.
        low: Where the window begins; −inf where it is open.
        high: Where it ends.
        span: Range of the driver in the recording.
        static: Whether the term's functions are those of a static simulator.
        edge: Whether the width of the edges is fitted too.
    """
    ends = []
    for name, value in (("from", low), ("to", high)):
        if math.isfinite(value):
            ends.append(Parameter(_ENDS[name], low=span[0], high=span[1], initial=min(max(value, span[0]), span[1])))
    size = span[1] - span[0]
    if edge:
        least, most = (share * size for share in WIDTHS)
        ends.append(Parameter(_EDGE, low=least, high=most, initial=EDGE * size, transform="log"))

    def inside(d: Tensor, p: Mapping[str, Tensor]) -> Any:
        width = p[_EDGE] if edge else EDGE * size
        w: Any = 1.0
        if math.isfinite(low):
            w = w * torch.sigmoid((d - p[_ENDS["from"]]) / width)
        if math.isfinite(high):
            w = w * torch.sigmoid((p[_ENDS["to"]] - d) / width)
        return w

    def moving(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda t, s, p, u: (
            inside(t if driver == "t" else s[driver] if driver in s else u[driver], p) * function(t, s, p, u)
        )

    def sensing(function: Callable[..., Any]) -> Callable[..., Any]:
        def observe(t: Any, s: Any, p: Any, u: Any, y: Any) -> Any:
            w = inside(t if driver == "t" else s[driver] if driver in s else u[driver], p)
            return y + w * (function(t, s, p, u, y) - y)

        return observe

    def still(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda x, p: inside(x[driver] if isinstance(x, Mapping) else x, p) * function(x, p)

    def seeing(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda x, p, y: y + inside(x[driver] if isinstance(x, Mapping) else x, p) * (function(x, p, y) - y)

    around = still if static else moving
    return Term(
        term.name,
        rates={state: moving(function) for state, function in term.rates.items()},
        outputs={name: (seeing if static else sensing)(function) for name, function in term.outputs.items()},
        shifts={name: around(function) for name, function in term.shifts.items()},
        parameters=[*term.parameters, *ends],
        formula=f"{term.formula or term.name} where {region_text(driver, low, high)}",
        description=term.description,
        scales=term.scales,
    )


def is_window(name: str) -> bool:
    """Whether a parameter is an end or the edge of a window, by its qualified name."""
    return name.rsplit(".", 1)[-1] in (*_ENDS.values(), _EDGE)


def beyond(name: str, low: float, high: float) -> float:
    """A value of such a parameter, within these bounds, for a window that leaves nothing out."""
    if name.endswith(_EDGE):
        return low
    return low - (high - low) if name.endswith(_ENDS["from"]) else high + (high - low)


def region_text(driver: str, low: float, high: float) -> str:
    """A range in words."""
    if math.isfinite(low) and math.isfinite(high):
        return f"{low:.4g} < {driver} < {high:.4g}"
    return f"{driver} > {low:.4g}" if math.isfinite(low) else f"{driver} < {high:.4g}"
