"""Where a new experiment can be made, as far as the user says."""

import math
from collections.abc import Mapping
from typing import Any

from torchcal.data import Recording
from torchcal.errors import DomainError
from torchcal.simulators import ODESimulator, Simulator

__all__ = ["Feasible"]


class Feasible(dict[str, tuple[float, float]]):
    """Ranges of conditions, or of initial states, inputs and the clock; infinite where an end is open.

    What is not named may be anything.
    """

    @classmethod
    def of(cls, given: Any, simulator: Simulator, recording: Recording) -> "Feasible":
        """Of what a user gave, or of nothing.

        Raises:
            DomainError: If it names what no experiment chooses, or has no ranges.
        """
        if given is None:
            return cls()
        if isinstance(simulator, ODESimulator):
            inputs = recording.runs[0].inputs if recording.runs else {}
            known = ["t", *(name for name in simulator.states if name not in simulator.initial), *inputs]
        else:
            known = list(recording.x) if isinstance(recording.x, dict) else ["x"]
        if not isinstance(given, Mapping):
            raise DomainError(f"Expected feasible={{name: (low, high)}} for some of {known}. Got {given!r}.")
        found = cls()
        for name, ends in given.items():
            if name not in known:
                raise DomainError(
                    f"Expected feasible= for some of {known}, which an experiment may choose. Got {name!r}."
                )
            try:
                if isinstance(ends, Mapping | str):
                    raise TypeError(ends)
                low, high = ends
                low, high = _end(low, -math.inf), _end(high, math.inf)
            except (TypeError, ValueError, OverflowError):
                low = high = math.nan
            if not low <= high:
                raise DomainError(
                    f"Expected feasible={{{name!r}: (low, high)}}, two numbers with low <= high, None for an open end. "
                    f"Got {ends!r}."
                )
            found[name] = low, high
        return found

    def within(self, name: str, low: float, high: float) -> tuple[float, float] | None:
        """The part of a range that is feasible; None where that is none."""
        low, high = max(low, self.get(name, (-math.inf,))[0]), min(high, self.get(name, (math.inf,))[-1])
        return (low, high) if low < high else None

    def clipped(self, name: str, value: float) -> float:
        """The nearest value that is feasible."""
        low, high = self.get(name, (-math.inf, math.inf))
        return min(max(value, low), high)

    def ends(self, name: str) -> list[float]:
        """Finite ends of the range of a name."""
        return [end for end in dict.fromkeys(self.get(name, ())) if math.isfinite(end)]

    def allows(self, recording: Recording) -> bool:
        """Whether an experiment keeps to the ranges: its conditions, or where its runs begin, what drives them and
        their time."""
        if recording.runs is None:
            conditions = recording.x if isinstance(recording.x, dict) else {"x": recording.x}
            return all(self._holds(name, values.tolist()) for name, values in conditions.items())
        return all(
            self._holds(name, [value]) for run in recording.runs for name, value in run.initial.items()
        ) and all(
            self._holds(name, values.tolist())
            for run in recording.runs for name, values in {"t": run.time, **run.inputs}.items()
        )  # fmt: skip

    def _holds(self, name: str, values: list[float]) -> bool:
        low, high = self.get(name, (-math.inf, math.inf))
        room = 1e-9 * max([abs(end) for end in self.ends(name)], default=0.0)
        return all(low - room <= value <= high + room for value in values)


def _end(given: Any, infinite: float) -> float:
    if given is None:
        return infinite
    if isinstance(given, bool | str):
        raise ValueError(given)
    return float(given)
