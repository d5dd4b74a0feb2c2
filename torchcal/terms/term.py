"""A candidate piece of physics."""

import math
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcal.display import NONE, raised
from torchcal.errors import DomainError, SimulatorError, TorchcalError
from torchcal.simulators import (
    Parameter,
    Values,
    asks_for_numbers,
    careful,
    is_value_of,
    nameless_advice,
    unknown_name,
)

__all__ = ["Term", "neutral_of", "outer"]

Function = Callable[..., Any]

#: Unicode's categories of control characters and of line and paragraph separators: they would break a table's rows.
BREAKS = ("Cc", "Zl", "Zp")


class _Own(Values):
    """``p`` of a term's functions: its own parameters and constants before the simulator's of the same names."""

    def __init__(self, outer: Mapping[str, Any], own: Mapping[str, Any]) -> None:
        began = outer if isinstance(outer, Values) else Values({}, None, None)
        super().__init__({**outer, **own}, began.first, began.start)
        self.outer = outer


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def outer(p: Mapping[str, Any]) -> Mapping[str, Any]:
    """The simulator's ``p``, for what a user wrote for that, out of a term's."""
    return p.outer if isinstance(p, _Own) else p


@dataclass(frozen=True, init=False, repr=False, eq=False)
class Term:
    """A candidate: named parameters with a neutral value at which the simulator is unchanged, and what they do.

    A term's parameters are its own. In its functions ``p`` gives the term's first and the simulator's behind them;
    elsewhere they are called ``"term.parameter"``. A parameter is neutral at 0 unless given. Parameters that have no
    effect while the others are neutral (thresholds, widths, times) are its shape.

    Args:
        name: Of the physics, as the field calls it.
        equation: State whose rate it adds to.
        rate: ``rate(t, s, p, u)``, added to that equation.
        rates: The same for several equations, and for its own states, by state.
        states: Hidden states of its own, with their units.
        initial: Their initial values: a number, the name of another state, ``f(s, p)``, or ``f(s, p, u)`` with a run's
            first inputs; 0 by default.
        outputs: By output ``f(t, s, p, u, y)`` in place of the simulated output y; ``f(x, p, y)`` for a static
            simulator.
        shifts: By parameter of the simulator ``f(t, s, p, u)``, added to it; ``f(x, p)`` for a static simulator.
            Parameters in ``p`` are as the terms before have shifted them; in ``rates`` and ``outputs`` as all have.
        frees: Dormant parameters of the simulator that it frees.
        parameters: Its own parameters. A shape of a term with hidden states that is given a neutral value says
            where these usually begin: an estimate costs as much evidence as it is apart from that, or from 0, where
            nothing has begun yet, and no more than any other parameter.
        formula: One line, as a scientist writes it.
        description: One plain sentence.
        scales: For shape parameters without two bounds: the state, input, condition or output (``"t"`` for time) on
            whose scale they are measured; they are then sought between 0.02 and 1 of its largest magnitude,
            durations (``"t"``) of the longest run's length, of the whole recording's where ``elapsed`` is that, and
            from a tenth of the usual gap between samples where that is less. A moment on the recording's clock needs
            bounds of its own, or ``elapsed``. A bound that is given stays.
        expected: What parameters are in nature, ``{parameter: (value, sd)}``: a hypothesis whose estimate lies apart
            from that, for its own sd too, is the less likely, by a normal density.
        elapsed: For what begins at nothing and goes on, whatever the clock says: t in its functions counts from the
            first sample of the ``"recording"``, or of each ``"run"``. By default t is the recording's own.
        takes: The input whose effect it takes away at first, as a slow drive does: an estimate that takes half as
            much again as the equation has of it, or more, is no name.
        constants: Numbers that its functions find in ``p``, the same in all runs: say the concentration at which a
            changed order leaves a rate as it is. In place of a number the name of a state, input, condition or output,
            or several: the largest magnitude (of several the vector's) in the base's fit, to three digits, which
            `diagnose` fills in; elsewhere, as in `extend`, it is 1.
        time: Unit of time that the units of its parameters are in, to be held against the recording's.
        labels: What the units of states are called in those of its parameters, ``{state: "m"}``: `diagnose` puts the
            unit there that the simulator gives the state, as it does for ``[x]``, which stands for the unit of x.

    Raises:
        DomainError: If it does nothing, or its parts do not fit together.

    >>> Term("drag", equation="v", rate=lambda t, s, p, u: -p["c"] * s["v"], parameters=[Parameter("c")])
    Term('drag': c)
    """

    name: str
    rates: dict[str, Function]
    states: dict[str, str | None]
    initial: dict[str, Any]
    outputs: dict[str, Function]
    shifts: dict[str, Function]
    frees: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    formula: str
    description: str
    scales: dict[str, str] = field(default_factory=dict)
    elapsed: str | None = None
    takes: str | None = None
    expected: dict[str, tuple[float, float]] = field(default_factory=dict)
    constants: dict[str, float | str | tuple[str, ...]] = field(default_factory=dict)
    time: str | None = None
    labels: dict[str, str] = field(default_factory=dict)
    seen: set[int] = field(init=False, default_factory=set)

    def __init__(
        self,
        name: str,
        *,
        equation: str | None = None,
        rate: Function | None = None,
        rates: Mapping[str, Function] | None = None,
        states: Mapping[str, str | None] | None = None,
        initial: Mapping[str, Any] | None = None,
        outputs: Mapping[str, Function] | None = None,
        shifts: Mapping[str, Function] | None = None,
        frees: Sequence[str] = (),
        parameters: Sequence[Parameter] = (),
        formula: str = "",
        description: str = "",
        scales: Mapping[str, str] | None = None,
        elapsed: str | None = None,
        takes: str | None = None,
        expected: Mapping[str, tuple[float, float]] | None = None,
        constants: Mapping[str, float | str | Sequence[str]] | None = None,
        time: str | None = None,
        labels: Mapping[str, str] | None = None,
    ) -> None:
        if not isinstance(name, str) or not name:
            raise DomainError(f"Expected a term's name (a non-empty string). Got {name!r}.")
        if any(unicodedata.category(letter) in BREAKS for letter in name):
            raise DomainError(
                f"Expected a term's name in one line, without control characters. Got {name!r} (use spaces; "
                "description= takes a sentence)."
            )
        if (name,) == NONE:
            raise DomainError(f"Expected a term's name other than {name!r}, which stands for what is in no list.")
        if (equation is None) != (rate is None):
            raise DomainError(f"Expected equation= and rate= together for the term {name!r}. Got one of them.")
        every = dict(rates or {})
        if equation is not None and rate is not None:
            if equation in every:
                raise DomainError(f"Expected one rate for {equation!r} in the term {name!r}. Got two.")
            every[equation] = rate
        frees = (frees,) if isinstance(frees, str) else tuple(frees or ())
        parts = [*every.values(), *(outputs or {}).values(), *(shifts or {}).values()]
        if not parts and not frees:
            raise DomainError(
                f"Expected the term {name!r} to do something. Got none of rate=, rates=, outputs=, shifts=, frees=."
            )
        if not all(callable(part) for part in parts):
            raise DomainError(f"Expected functions in the term {name!r}. Got something that cannot be called.")
        if isinstance(parameters, Parameter):
            raise DomainError(
                f"Expected a list of parameters of the term {name!r}. Got one, {parameters!r} (write "
                "parameters=[Parameter(...)])."
            )
        parameters = () if parameters is None else tuple(parameters)  # what can be gone through but once is kept
        if parts and not parameters:
            raise DomainError(
                f"Expected parameters=[Parameter(...)] for the term {name!r}. Got none, so that nothing could be "
                "fitted; an effect needs a coefficient that is 0 where it is absent."
            )
        for parameter in parameters:
            if not isinstance(parameter, Parameter):
                raise DomainError(
                    f"Expected torchcal.Parameter objects as parameters of the term {name!r}. Got "
                    f"{type(parameter).__name__}: {parameter!r} (write parameters=[Parameter(...), ...])."
                )
        names = [parameter.name for parameter in parameters]
        if len(set(names)) < len(names):
            raise DomainError(f"Expected every parameter of the term {name!r} named once. Got {names}.")
        for state in states or {}:
            if state not in every:
                raise DomainError(f"Expected a rate for the hidden state {state!r} of the term {name!r}. Got none.")
        for state in initial or {}:
            if state not in (states or {}):
                raise DomainError(
                    f"Expected initial values of the hidden states {list(states or {})} of the term {name!r}. Got "
                    f"{state!r} (give states={{{state!r}: unit}} and its rate; a state of the simulator begins as its "
                    "run says)."
                )
        for measured in scales or {}:
            if measured not in names:
                raise DomainError(f"Expected scales of parameters {names} of the term {name!r}. Got {measured!r}.")
        if elapsed not in (None, "recording", "run"):
            raise DomainError(
                f'Expected elapsed="recording", "run" or None for the term {name!r}. Got {elapsed!r}.'
            )
        for own, known in (expected or {}).items():
            if own not in names:
                raise DomainError(f"Expected values of parameters {names} of the term {name!r}. Got {own!r}.")
            if not (isinstance(known, Sequence) and len(known) == 2 and all(map(_is_finite, known)) and known[1] > 0):
                raise DomainError(
                    f"Expected expected={{{own!r}: (value, sd)}} of the term {name!r}, finite, with sd > 0. Got "
                    f"{known!r}."
                )
        if time is not None and not (isinstance(time, str) and time):
            raise DomainError(f"Expected time as the name of a unit or None for the term {name!r}. Got {time!r}.")
        if bad := [own for own, label in (labels or {}).items() if not (isinstance(label, str) and label)]:
            raise DomainError(
                f"Expected labels= of the term {name!r} as names of units. Got {bad[0]!r}: {(labels or {})[bad[0]]!r}."
            )
        for own, given in (constants or {}).items():
            several = isinstance(given, Sequence) and given and all(isinstance(one, str) and one for one in given)
            if own in names or not (_is_finite(given) or several):
                raise DomainError(
                    f"Expected constants= of the term {name!r} as finite numbers or names of what they are measured "
                    f"on, under names that its parameters {names} do not have. Got {own!r}: {given!r}."
                )
        put = object.__setattr__
        put(self, "name", name)
        put(self, "rates", every)
        put(self, "states", dict(states or {}))
        put(self, "initial", {state: (initial or {}).get(state, 0.0) for state in states or {}})
        put(self, "outputs", dict(outputs or {}))
        put(self, "shifts", dict(shifts or {}))
        put(self, "frees", frees)
        put(self, "parameters", parameters)
        put(self, "formula", formula)
        put(self, "description", description)
        put(self, "scales", dict(scales or {}))
        put(self, "elapsed", elapsed)
        put(self, "takes", takes)
        put(self, "time", time)
        put(self, "labels", dict(labels or {}))
        put(self, "constants", {
            key: value if isinstance(value, str) else tuple(value) if isinstance(value, Sequence) else float(value)
            for key, value in (constants or {}).items()
        })  # fmt: skip
        put(self, "seen", set())
        put(self, "expected", {key: (float(value), float(sd)) for key, (value, sd) in (expected or {}).items()})

    def __repr__(self) -> str:
        return f"Term({self.name!r}: {', '.join([p.name for p in self.parameters] + list(self.frees))})"

    def full(self, parameter: str) -> str:
        """How results call one of its own parameters."""
        return f"{self.name}.{parameter}"

    def brings(self, name: str) -> bool:
        """Whether it adds or frees the parameter that results call so, or whose value in one run they do."""
        added = name in (self.full(q.name) for q in self.parameters)
        return added or any(is_value_of(name, freed) for freed in self.frees)

    @property
    def numbers(self) -> dict[str, float]:
        """Its constants; 1 for those that nobody has measured."""
        return {name: value if isinstance(value, float) else 1.0 for name, value in self.constants.items()}

    def own(self, p: Mapping[str, Any]) -> dict[str, Any]:
        """``p`` as the term's functions see it."""
        return _Own(p, self.numbers | {parameter.name: p[self.full(parameter.name)] for parameter in self.parameters})

    def began(self, p: Mapping[str, Any]) -> Any:
        """When t began from which its functions count, on the recording's clock: 0 unless ``elapsed`` says otherwise.

        Raises:
            SimulatorError: If ``p`` no longer knows.
        """
        if self.elapsed is None:
            return 0.0
        known = p if isinstance(p, Values) else Values({}, None, None)
        began = known.first if self.elapsed == "recording" else known.start
        if began is None:
            raise SimulatorError(
                f"Expected p as the simulator gives it for the term {self.name!r}, whose time counts from the start of "
                f"the {self.elapsed}. Got a plain dict, which does not know when that was (p.copy() and p | {{...}} "
                "do; by hand, torchcal.simulators.Values(p, first, start) with the first times of the recording and of "
                "the run)."
            )
        return began

    def call(self, function: Function, *given: Any) -> Any:
        """One of its functions on what it is given, t the recording's; an error in it is told as this term's."""
        if self.elapsed is not None:
            t, s, p, *more = given
            given = (t - self.began(p), s, p, *more)
        letters = (("t", "s", "p", "u", "y") if len(given) > 3 else ("x", "p", "y"))[: len(given)]
        try:
            result = careful(
                self.seen, f"the term {self.name!r}", function, **dict(zip(letters, given, strict=True))
            )
        except TorchcalError:
            raise
        except Exception as error:
            advice = nameless_advice(error, given[0]) if letters[0] == "x" else unknown_name(error, *given[1:4])
            if asks_for_numbers(error):
                advice = (
                    " Use torch functions on them, without .detach(), and torch.where for if: derivatives are needed."
                )
            if _takes_others(error):
                advice = (
                    " Functions of a term take (t, s, p, u) in time and (x, p) in a static simulator, those of "
                    "outputs= y behind them; the library's instruments are for a static one with static=True alone."
                )
            known = "; ".join(", ".join(part) for part in given if isinstance(part, Mapping) and part)
            raise SimulatorError(
                f"Expected a tensor from every function of the term {self.name!r}. One of them raised "
                f"{raised(error)}. It was given ({', '.join(letters)}), with {known}.{advice}"
            ) from error
        if isinstance(result, np.ndarray | np.generic):
            result = torch.as_tensor(result)
        if not isinstance(result, Tensor | int | float):
            raise SimulatorError(
                f"Expected a tensor from every function of the term {self.name!r}. One of them returned "
                f"{type(result).__name__}."
            )
        return result

    @property
    def is_sensor(self) -> bool:
        """Whether it changes what is seen and nothing else."""
        return bool(self.outputs) and not (self.rates or self.shifts or self.frees)


def _takes_others(error: Exception) -> bool:
    """Whether a function takes other arguments than it was called with, and none that it calls."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    at_call = last is not None and last.tb_frame.f_code is careful.__code__
    return at_call and isinstance(error, TypeError) and "argument" in str(error)


def neutral_of(parameter: Parameter) -> float | None:
    """The neutral value of a term's parameter: as given, else 0 where its bounds allow, else none."""
    if parameter.neutral is not None:
        return parameter.neutral
    return 0.0 if parameter.transform != "log" and parameter.contains(0.0) else None
