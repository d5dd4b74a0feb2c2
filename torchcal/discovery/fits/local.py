"""Terms that act only in a range of time, a state, an input or a condition."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchcal.display import DECADES, placed
from torchcal.simulators import Parameter
from torchcal.terms import Term

__all__ = [
    "EDGE", "ENDS", "SHORT", "WIDTHS", "Span", "beyond", "driver_at", "force", "is_moment",
    "is_window", "localised", "multiplied", "region_text", "sudden",
]  # fmt: skip

#: Width of a window's edges, as a share of the driver's range: wide enough for a fit to move them; and the limits
#: between which it is fitted, from nearly a step.
EDGE, WIDTHS = 0.02, (0.004, 0.1)
#: The same as a share of a short window's own length: with wider ones it would never be open.
NARROW = 0.1
#: Share of the driver's range below which a window is none: a kick at one moment is another kind of physics.
SHORT = 0.02
#: The narrowest of a static recording, whose ends are sought between its data: no time step has to meet them.
STEP = 1e-4

#: Share of the driver's range up to which a window has closed.
CLOSED = 1e-3

#: Names of the parameters of a window's ends.
ENDS = {"from": "window from", "to": "window to"}
WIDTH_OF_EDGE = "window edge"
#: Name of the time at the middle of a window of a given length, the parameter of a sudden change.
MOMENT = "window at"


@dataclass(frozen=True)
class Span:
    """The range of a driver in a recording, on the scale that windows are laid out on.

    Attributes:
        low: Its lower end.
        high: Its upper end.
        log: Whether that scale is logarithmic.
        edge: Width of the edges of windows whose edges are not fitted, as a share of the range.
    """

    low: float
    high: float
    log: bool
    edge: float = EDGE

    @classmethod
    def of(cls, driver: Tensor, *, time: bool) -> "Span":
        """The range of values, on a logarithmic scale where they are positive and span decades; ``time`` has none, as a
        clock may begin anywhere."""
        low, high = float(driver.min()), float(driver.max())
        return cls(low, high, not time and low > 0 and high > DECADES * low)

    @property
    def size(self) -> float:
        """Of the range, on the scale."""
        return math.log(self.high / self.low) if self.log else self.high - self.low

    def share(self, low: float, high: float) -> float:
        """Of the range, that lies between two values of the driver; negative where nothing does."""
        low, high = max(low, self.low), min(high, self.high)
        return (math.log(high / low) if self.log else high - low) / self.size

    def holds(self, value: float) -> bool:
        """Whether a value lies in the range, clear of both ends."""
        return self.share(self.low, value) > CLOSED and self.share(value, self.high) > CLOSED

    def edged(self, low: float, high: float) -> "Span":
        """The same with edges that leave a short window between two values open in its middle."""
        return dataclasses.replace(self, edge=min(max(NARROW * self.share(low, high), WIDTHS[0]), EDGE))

    def distance(self, d: Any, end: Any) -> Any:
        """From an end of a window to a value of the driver, on the scale."""
        return torch.log(d / end) if self.log else d - end

    def moved(self, value: float, by: float) -> float:
        """A value of the driver some way off on the scale, within the range."""
        if not math.isfinite(value):
            return value
        value = min(max(value, self.low), self.high)
        found = value * math.exp(by) if self.log else value + by
        return min(max(found, self.low), self.high)


def localised(
    term: Term, driver: str, low: float, high: float, span: Span, *, static: bool, edge: bool = False
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
            begin, scale = span.moved(value, 0.0), "log" if span.log else None
            ends.append(Parameter(ENDS[name], low=span.low, high=span.high, initial=begin, transform=scale))
    size = span.size
    if edge:
        least, most = (STEP if static else WIDTHS[0]) * size, WIDTHS[1] * size
        ends.append(Parameter(WIDTH_OF_EDGE, low=least, high=most, initial=EDGE * size, transform="log"))

    at = driver_at(driver, static=static)

    def now(t: Any, s: Any, p: Any, u: Any) -> Any:
        return force(span, at(t + term.began(p), s, p, u), p)  # windows are on the clock

    share = (lambda x, p: force(span, at(x), p)) if static else now
    formula = f"{term.formula or term.name} where {region_text(driver, low, high, span)}"
    return multiplied(term, term.name, share, parameters=ends, formula=formula)


def sudden(term: Term, name: str, at: float, width: float, span: Span) -> Term:
    """The term for a moment, whose time is fitted with it: multiplied by exp(−(t − at)²/(2 width²)).

    Args:
        term: The term, of a simulator in time.
        name: What it is called.
        at: When it begins to be sought.
        width: Standard deviation of what it is multiplied by, in time.
        span: Range of time in the recording.
    """
    moment = Parameter(MOMENT, low=span.low, high=span.high, initial=at)
    share = lambda t, s, p, u: torch.exp(-0.5 * ((t - p[MOMENT]) / width) ** 2)  # noqa: E731
    return multiplied(term, name, share, parameters=[moment])


def multiplied(
    term: Term, name: str, share: Callable[..., Any], *, parameters: Sequence[Parameter] = (), formula: str = ""
) -> Term:
    """Another term that does a share of what a term does, by what its functions are given (but the output they see)."""

    def acting(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *given: share(*given) * function(*given)

    def seeing(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *given: given[-1] + share(*given[:-1]) * (function(*given) - given[-1])

    return Term(
        name,
        rates={state: acting(function) for state, function in term.rates.items()},
        outputs={output: seeing(function) for output, function in term.outputs.items()},
        shifts={parameter: acting(function) for parameter, function in term.shifts.items()},
        parameters=[*term.parameters, *parameters],
        formula=formula or term.formula,
        description=term.description,
        scales=term.scales,
        elapsed=term.elapsed,
        expected=term.expected,
        constants=term.constants,
        time=term.time,
    )


def driver_at(driver: str, *, static: bool) -> Callable[..., Any]:
    """A driver's value, of what a term's functions are given."""

    def value(*given: Any) -> Any:
        if static:
            x = given[0]
            return x[driver] if isinstance(x, Mapping) else x
        t, s, _, u = given[:4]
        return t if driver == "t" else s[driver] if driver in s else u[driver]

    return value


def force(span: Span, d: Tensor, p: Mapping[str, Any]) -> Any:
    """Share of a term that its window lets through, from 0 to 1, at values of the driver; p holds the window's own
    parameters."""
    width = p.get(WIDTH_OF_EDGE, span.edge * span.size)
    w: Any = 1.0
    if ENDS["from"] in p:
        w = w * torch.sigmoid(span.distance(d, p[ENDS["from"]]) / width)
    if ENDS["to"] in p:
        w = w * torch.sigmoid(-span.distance(d, p[ENDS["to"]]) / width)
    return w


def is_window(name: str) -> bool:
    """Whether a parameter is an end, the edge or the time of a window, by its qualified name."""
    return name.rsplit(".", 1)[-1] in (*ENDS.values(), WIDTH_OF_EDGE, MOMENT)


def is_moment(name: str) -> bool:
    """Whether a parameter is the time of a sudden change, by its qualified name."""
    return name.rsplit(".", 1)[-1] == MOMENT


def beyond(parameter: Parameter) -> float:
    """A value of a window's parameter for a window that leaves nothing out; it has bounds."""
    low, high = parameter.low or 0.0, parameter.high or 0.0
    if parameter.name.endswith(WIDTH_OF_EDGE):
        return low
    if parameter.transform == "log":
        low, high = low * low / high, high * high / low
    else:
        low, high = 2 * low - high, 2 * high - low
    return low if parameter.name.endswith(ENDS["from"]) else high


def region_text(driver: str, low: float, high: float, span: Span | None) -> str:
    """A range of a driver in words; its ends to a thousandth of the span in a recording, where that is known."""
    extent = 0.0 if span is None else span.high - span.low
    ends = [end for end in (low, high) if math.isfinite(end)]
    if low >= high or (span is not None and ends and span.share(low, high) <= CLOSED):  # at one end of all data, too
        return f"{driver} near {placed(sum(ends) / len(ends), extent)}"
    if len(ends) > 1:
        return f"{placed(low, extent)} < {driver} < {placed(high, extent)}"
    return f"{driver} > {placed(low, extent)}" if math.isfinite(low) else f"{driver} < {placed(high, extent)}"
