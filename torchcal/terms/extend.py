"""A simulator with terms added."""

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from torchcal.errors import DomainError, SimulatorError
from torchcal.simulators import (
    ODESimulator,
    Parameter,
    Simulator,
    Trajectories,
)
from torchcal.simulators.careful import takes_inputs
from torchcal.terms.term import Function, Term

__all__ = ["extend"]


def extend(simulator: Simulator, terms: Sequence[Term]) -> Simulator:
    """The simulator with terms added, their parameters free behind its own; a new object.

    Shifts come one after another, each on what those before have made of the parameters: two factors on a rate
    constant are their product. Rates and outputs see the shifted parameters. Terms that it has been extended with
    before are as if given together with these.

    Raises:
        DomainError: If a term names an equation, output or parameter that the simulator does not have.
    """
    terms = tuple(terms)
    if isinstance(simulator, Trajectories):
        ode = _extend_ode(simulator.ode, terms)
        return Trajectories(ode, simulator.recording, subdivide=simulator.subdivide, denser=simulator.denser,
                            implicit=simulator.implicit)
    if not terms:
        return simulator
    if isinstance(simulator, ODESimulator):
        return _extend_ode(simulator, terms)
    return _extend_static(simulator, terms)


def _parameters(simulator: Simulator, terms: Sequence[Term]) -> tuple[Parameter, ...]:
    freed = {name for term in terms for name in term.frees}
    names = [parameter.name for parameter in simulator.parameters]
    for term in terms:
        for name in (*term.frees, *term.shifts):
            if name not in names:
                raise DomainError(f"Expected the term {term.name!r} to name a parameter of {names}. Got {name!r}.")
    found = [
        dataclasses.replace(
            parameter, neutral=None, initial=parameter.neutral if parameter.initial is None else parameter.initial
        )
        if parameter.name in freed
        else parameter
        for parameter in simulator.parameters
    ]
    for term in terms:
        for parameter in term.parameters:
            found.append(dataclasses.replace(parameter, name=term.full(parameter.name), neutral=None))
    return tuple(found)


def _plain(simulator: Simulator, terms: Sequence[Term]) -> tuple[Any, list[Term]]:
    """The simulator without any terms, and all of them: those that it has been extended with come first."""
    plain, before = simulator.extended or (simulator, ())
    return plain, [*before, *terms]


def _shifted(
    terms: Sequence[Term], p: dict[str, Tensor], given: Callable[[dict[str, Any]], tuple[Any, ...]]
) -> dict[str, Tensor]:
    """Parameters as the terms shift them, one after another; ``given`` makes of ``p`` what their functions get."""
    moved = p.copy()
    for term in terms:
        own = given(term.own(moved.copy()))
        for name, function in term.shifts.items():
            moved[name] = moved[name] + term.call(function, *own)
    return moved


def _extend_ode(simulator: ODESimulator, terms: Sequence[Term]) -> ODESimulator:
    if not terms:
        return simulator
    plain, every = _plain(simulator, terms)
    states = dict(simulator.states)
    initial = dict(simulator.initial)
    for term in terms:
        for state, unit in term.states.items():
            if state in states:
                raise DomainError(f"Expected a new name for the hidden state of {term.name!r}. Got {state!r}.")
            states[state] = unit
            initial[state] = _initial_of(term, term.initial[state])
    for term in terms:
        for place in term.rates:
            if place not in states:
                raise DomainError(f"Expected the term {term.name!r} in an equation of {list(states)}. Got {place!r}.")
        for place in term.outputs:
            if place not in simulator.observe:
                raise DomainError(
                    f"Expected the term {term.name!r} on an output of {list(simulator.observe)}. Got {place!r}."
                )
    shifting = [term for term in every if term.shifts]

    def shifted(t: Any, s: dict[str, Tensor], p: dict[str, Tensor], u: dict[str, Tensor]) -> dict[str, Tensor]:
        return _shifted(shifting, p, lambda own: (t, s, own, u)) if shifting else p

    def rates(t: Any, s: dict[str, Tensor], p: dict[str, Tensor], u: dict[str, Tensor]) -> dict[str, Any]:
        p = shifted(t, s, p, u)
        found = dict(plain.rates(t, dict(s), p.copy(), dict(u)))
        for term in every:
            for state, function in term.rates.items():
                value = term.call(function, t, s, term.own(p), u)
                found[state] = value if state in term.states else found[state] + value
        return found

    observe: dict[str, Function] = {}
    for name, function in plain.observe.items():
        observe[name] = _sensed(name, function, [term for term in every if name in term.outputs], shifted)
    extended = ODESimulator(
        rates,
        states,
        _parameters(simulator, terms),
        observe=observe,
        initial=initial,
        max_step=simulator.max_step,
        stiff=simulator.stiff,
    )
    extended.extended = plain, tuple(every)
    extended.reads = plain.reads  # what instruments add is small
    return extended


def _initial_of(term: Term, value: Any) -> Any:
    if not callable(value):
        return value
    if takes_inputs(value):
        return lambda s, p, u: value(s, term.own(p), u)
    return lambda s, p: value(s, term.own(p))


def _sensed(name: str, function: Function, sensors: Sequence[Term], shifted: Function) -> Function:
    def observe(t: Any, s: dict[str, Tensor], p: dict[str, Tensor], u: dict[str, Tensor]) -> Any:
        p = shifted(t, s, p, u)
        y = function(t, dict(s), p.copy(), dict(u))
        for term in sensors:
            y = term.call(term.outputs[name], t, s, term.own(p), u, y)
        return y

    return observe


def _extend_static(simulator: Simulator, terms: Sequence[Term]) -> Simulator:
    plain, every = _plain(simulator, terms)
    for term in terms:
        if term.elapsed:
            raise DomainError(
                f"Expected a term without elapsed= for a static simulator, which has no time. Got {term.name!r} (give "
                "shifts=, outputs= or frees= that depend on a condition; of the library's sensors "
                "terms.sensor(static=True, drift=condition))."
            )
        if term.rates or term.states:
            raise DomainError(
                f"Expected a term without rates for a static simulator. Got {term.name!r} (give shifts=, outputs= or "
                "frees=, or write the model as an ODESimulator)."
            )
    parameters = _parameters(simulator, terms)
    if not any(term.shifts or term.outputs for term in terms):
        freed = copy.copy(simulator)
        freed.parameters = parameters
        return freed

    def function(x: Any, p: dict[str, Tensor]) -> Any:
        moved = _shifted(every, p, lambda own: (x, own))
        result = plain.function(x, {name: moved[name] for name in plain.names})
        if not any(term.outputs for term in every):
            return result
        found = dict(result) if isinstance(result, Mapping) else {"y": result}
        for term in every:
            for name, sensor in term.outputs.items():
                place = name if name in found else "y" if not isinstance(result, Mapping) else name
                if place not in found:
                    raise SimulatorError(
                        f"Expected the term {term.name!r} on an output of {list(found)}. Got {name!r}."
                    )
                found[place] = term.call(sensor, x, term.own(moved), found[place])
        return found if isinstance(result, Mapping) else found["y"]

    extended = Simulator(function, parameters)
    extended.dear = plain.dear
    extended.extended = plain, tuple(every)
    return extended
