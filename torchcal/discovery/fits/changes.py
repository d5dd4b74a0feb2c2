"""Changes without a name: a constant where a term acts, as it is, growing from an end of a window, or fading to it."""

import itertools
from collections.abc import Callable
from typing import Any

import torch

from torchcal.discovery.fits.candidates import Candidate
from torchcal.discovery.fits.local import ENDS, Span, driver_at
from torchcal.simulators import Parameter
from torchcal.terms import Term

__all__ = ["Places", "constant_change", "distance", "fading_to", "places_of"]

#: Share that is left of a fading change at the end of its window.
FADED = 0.05
#: Shortest window, in its driver's range, that a change fades in.
SHORTEST = 1e-4

#: Kinds and names of what a constant is added to, or of the outputs that are multiplied ("gains").
Places = tuple[tuple[str, str], ...]


def places_of(candidate: Candidate) -> Places | None:
    """The equations, outputs or parameters that a term acts on; None where it has states of its own or frees what is
    held."""
    (term,) = candidate.terms
    places = tuple((kind, name) for kind in ("rates", "outputs", "shifts") for name in getattr(term, kind))
    return places if places and not term.states and not term.frees else None


def distance(driver: str, end: str, span: Span, in_time: bool) -> Callable[..., Any]:
    """How far a driver is beyond an end of a window, in its range; of what a term's functions are given."""
    at = driver_at(driver, static=not in_time)
    return lambda *given: span.distance(at(*given), given[2 if in_time else 1][end]) / span.size


def fading_to(driver: str, end: str, span: Span, in_time: bool) -> Callable[..., Any]:
    """What decays from the open side of a window to `FADED` at its end; of what a term's functions are given."""
    at = driver_at(driver, static=not in_time)
    edge = span.low if end == ENDS["to"] else span.high

    def share(*given: Any) -> Any:
        last = given[2 if in_time else 1][end]
        length = span.distance(last, edge)
        length = torch.where(length.abs() > SHORTEST * span.size, length, SHORTEST * span.size)
        return FADED ** (span.distance(at(*given), edge) / length).clamp(0.0, 1.0)

    return share


def constant_change(where: Places, in_time: bool, grows: Callable[..., Any] | None = None, side: int = 0) -> Term:
    """A constant change of its own in every one of some places, or one that grows in proportion to something; of either
    sign, or all of one ``side`` alone."""
    number = itertools.count(1)

    def added() -> Callable[..., Any]:
        name = f"c{next(number)}"
        size = lambda *given: given[2 if in_time else 1][name]  # noqa: E731
        return size if grows is None else lambda *given: size(*given) * grows(*given)

    def shown() -> Callable[..., Any]:
        own = added()
        return lambda *given: given[-1] + own(*given)

    def scaled() -> Callable[..., Any]:
        own = added()
        return lambda *given: given[-1] * (1 + own(*given))

    how = {"rates": ("rates", added), "outputs": ("outputs", shown), "shifts": ("shifts", added),
           "gains": ("outputs", scaled)}  # fmt: skip
    kinds: dict[str, Any] = {}
    for kind, name in where:
        place, change = how[kind]
        kinds.setdefault(place, {})[name] = change()
    of = {"shifts": "a change of {}", "gains": "a change of the gain of {}"}
    what = " and ".join(of[kind].format(name) for kind, name in where if kind in of)
    low, high = (0.0 if side > 0 else None), (0.0 if side < 0 else None)
    own = [Parameter(f"c{i}", low=low, high=high) for i in range(1, next(number))]
    return Term(what or "something unknown", **kinds, parameters=own)
