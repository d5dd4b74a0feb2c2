"""What an instrument shows of true values, and whether a term is one."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.simulators import Values
from torchcal.terms import Term

__all__ = ["Reading", "are_instruments", "threshold_of"]


def threshold_of(terms: Sequence[Term], values: Mapping[str, float]) -> tuple[str, float] | None:
    """The output beyond a value of which an instrument among some terms errs, and that value, as of one that saturates;
    None where there is no such instrument.

    Args:
        terms: The terms.
        values: Of all parameters, by name.
    """
    for term in terms:
        for own, output in term.scales.items() if term.is_sensor and not term.states else ():
            if output in term.outputs:
                return output, values[term.full(own)]
    return None


@dataclass(frozen=True, eq=False)
class Reading:
    """What an instrument shows of true values ``(m,)``.

    Attributes:
        problem: Says how functions are called.
        term: The instrument.
        function: Of one of its outputs.
        drivers: At the data, ``(m,)`` each.
        p: Parameters there.
    """

    problem: Problem
    term: Term
    function: Callable[..., Tensor]
    drivers: dict[str, Tensor]
    p: Values

    def __call__(self, y: Tensor) -> Tensor:
        """Of these true values."""
        return self.moved(y, 0)

    def moved(self, y: Tensor, by: int, *, timely: bool = False) -> Tensor:
        """The same, so many places further on in the data; at the same time even so, where that is to be timely."""
        order = torch.arange(len(y)).roll(by)
        at, p = {name: each[order] for name, each in self.drivers.items()}, self.p.at(order)
        if timely:
            at["t"], p.start = self.drivers["t"], self.p.start
        shown: Tensor = self.term.call(self.function, *self.problem.arguments(at, self.term.own(p), y)) + 0 * y
        return shown

    @cached_property
    def _values(self) -> Tensor:
        """Some true values."""
        return torch.linspace(1.0, 2.0, len(next(iter(self.drivers.values()))), dtype=torch.float64)

    @property
    def works(self) -> bool:
        """Whether the function can be asked like this."""
        try:
            self(self._values)
        except Exception:  # the simulator calls it otherwise, and tells what is wrong
            return False
        return True

    def is_of_value(self, *, and_time: bool = False) -> bool:
        """Whether what is shown follows from the true value alone, or with the time, wherever in the data that is."""
        y = self._values
        shown = self(y)
        moved = [self.moved(y, by, timely=and_time) for by in (1, len(y) // 2)]
        return all(torch.allclose(shown, one, rtol=0, atol=0, equal_nan=True) for one in moved)


def are_instruments(
    problem: Problem, terms: Sequence[Term], values: Tensor, drivers: dict[str, Tensor]
) -> list[bool]:
    """Which terms of a problem show a true value otherwise, and read nothing else but what has a memory of its own, or
    counts from the first sample: at ``values`` ``(P,)``, with drivers at the data ``(n,)``."""
    p = problem.parameters_at_data(values)

    def is_one(term: Term) -> bool:
        if not term.outputs or term.shifts or term.frees or not set(term.rates) <= set(term.states):
            return False
        if term.states or term.elapsed:
            return True
        readings = (Reading(problem, term, function, drivers, p) for function in term.outputs.values())
        return all(reading.works and reading.is_of_value() for reading in readings)

    return [is_one(term) for term in terms]
