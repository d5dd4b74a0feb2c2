"""Simulators in time: ordinary differential equations with inputs, several runs and unknown initial states."""

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchcal.checks import real_number
from torchcal.data import Recording, same_unit
from torchcal.errors import DomainError, SimulatorError, UnitWarning, warn
from torchcal.simulators.parameter import Parameter
from torchcal.simulators.static import Conditions, Simulator, check_parameters
from torchcal.simulators.trajectories import Trajectories

__all__ = ["ODESimulator"]

Rates = Callable[[Any, dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]], Mapping[str, Any]]


class ODESimulator(Simulator):
    r"""A model ds/dt = rates(t, s; p, u) written with torch operations, observed through functions of its states.

    Write the rates elementwise: ``s[name]`` has shape ``(*batch, R)`` for R runs, ``u[name]`` ``(R,)``, ``t`` is a
    scalar or ``(R,)``, and ``p[name]`` has shape ``(*batch, 1)`` (``(*batch, R)`` for per-run parameters). A returned
    rate is expanded to its state's shape. Solved by the classical fourth-order Runge–Kutta method with steps that
    end at every sample (`Trajectories` says how), or, where the model is stiff, by Radau IIA of order 5.

    Args:
        rates: ``rates(t, s, p, u)`` returns the rate of every state by name.
        states: Units by state name, in order; a sequence of names where units do not matter.
        parameters: In the order in which results list them.
        observe: States that are observed, or a dict from output names to functions ``f(t, s, p, u)``. By default
            every state.
        initial: Initial values that the model itself knows, by state: a number, the name of another state whose
            initial value it takes, or a function ``f(s, p)`` of the other states' initial values, or ``f(s, p, u)``
            of these and a run's first inputs. What a run gives comes first; what neither gives is calibrated, begun at
            the first recorded value of an output that is that state as it is.
        max_step: Longest time step. By default steps are halved until the solution stops changing.
        stiff: Whether steps are implicit, as some states follow others far faster than anything else happens. By
            default they are where explicit ones would have to be too short; with ``max_step`` only where this is True.

    Raises:
        DomainError: If something is not as described.

    >>> decay = ODESimulator(lambda t, s, p, u: {"c": -p["k"] * s["c"]}, {"c": "mol/L"}, [Parameter("k")])
    >>> decay.outputs
    ('c',)
    """

    def __init__(
        self,
        rates: Rates,
        states: Mapping[str, str | None] | Sequence[str],
        parameters: Sequence[Parameter],
        *,
        observe: Sequence[str] | Mapping[str, Callable[..., Any]] | None = None,
        initial: Mapping[str, float | str | Callable[..., Any]] | None = None,
        max_step: float | None = None,
        stiff: bool | None = None,
    ) -> None:
        if not callable(rates):
            raise DomainError(f"Expected rates as a function f(t, s, p, u). Got {type(rates).__name__}.")
        if not isinstance(states, str | Mapping):
            states = tuple(states) if isinstance(states, Iterable) else ()
        if isinstance(states, str) or not states or any(not isinstance(name, str) or not name for name in states):
            raise DomainError(f"Expected states as a dict from names to units. Got {states!r}.")
        if len(set(states)) < len(states):
            raise DomainError(f"Expected states of different names. Got {list(states)}.")
        if max_step is not None and not real_number(max_step) > 0:
            raise DomainError(f"Expected max_step as a number > 0 or None. Got {max_step!r}.")
        if stiff is not None and not isinstance(stiff, bool):
            raise DomainError(f"Expected stiff=True, False or None. Got {stiff!r}.")
        self.rates = rates
        self.states: dict[str, str | None] = dict(states) if isinstance(states, Mapping) else dict.fromkeys(states)
        self.parameters = check_parameters(parameters)
        self.degree = None
        self.seen = set()
        if initial is not None and not isinstance(initial, Mapping):
            raise DomainError(f"Expected initial as a dict from states to values, or None. Got {initial!r}.")
        self.initial = dict(initial or {})
        self.max_step = None if max_step is None else real_number(max_step)
        self.stiff = stiff
        if unknown := [name for name in self.initial if name not in self.states]:
            raise DomainError(f"Expected initial values of states {list(self.states)}. Got {unknown}.")
        for name, value in self.initial.items():
            if isinstance(value, str) and (value not in self.states or value == name):
                raise DomainError(
                    f"Expected the initial value of {name!r} as a number, another state's name or a function f(s, p). "
                    f"Got {value!r} with states {list(self.states)}."
                )
            if callable(value) or isinstance(value, str):
                continue
            self.initial[name] = number = real_number(value)
            if not math.isfinite(number):
                raise DomainError(
                    f"Expected the initial value of {name!r} as a finite number, another state's name or a function "
                    f"f(s, p). Got {value!r} ({type(value).__name__})."
                )
        self.observe = self._observed(observe)

    def _observed(self, observe: Any) -> dict[str, Callable[..., Any]]:
        if observe is None:
            observe = tuple(self.states)
        if isinstance(observe, str):
            observe = (observe,)
        if isinstance(observe, Mapping):
            if not observe or not all(callable(function) for function in observe.values()):
                raise DomainError("Expected observe as {output: function(t, s, p, u)}. Got something else in it.")
            return dict(observe)
        observe = tuple(observe) if isinstance(observe, Iterable) else (observe,)
        if unknown := [name for name in observe if name not in self.states]:
            raise DomainError(f"Expected observed states among {list(self.states)}. Got {unknown}.")
        if not observe:
            raise DomainError("Expected at least one observed state. Got none.")
        return {name: _state(name) for name in observe}

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of what can be observed."""
        return tuple(self.observe)

    @functools.cached_property
    def reads(self) -> dict[str, str]:
        """Outputs that are a state as it is, neither converted nor mixed with another, and which one."""
        s = {name: torch.full((1, 1), 1.0 + i, dtype=torch.float64) for i, name in enumerate(self.states)}
        found = {}
        for output, function in self.observe.items():
            try:
                value = function(None, dict(s), {}, {})  # what only reads a state asks for nothing else
            except Exception:
                continue
            state = next((name for name, own in s.items() if value is own), None)
            if state is not None:
                found[output] = state
        return found

    def bind(self, recording: Recording) -> "Trajectories":
        """The simulator of this recording's outputs: its runs, inputs, times and unknown initial states.

        Its parameters are this simulator's (one for each run where ``per_run``) and behind them the initial states
        that nobody knows, as ``"x(0)"``, or ``"x(0)[run]"`` where there are several runs.
        """
        bound = Trajectories(self, recording)
        self._compare_units(recording)
        return bound

    def _compare_units(self, recording: Recording) -> None:
        for name, unit in recording.units.items():
            state = self.reads.get(name)
            own = self.states[state] if state else None
            if own and unit and not same_unit(own, unit):
                warn(
                    f"The state {state!r} is in {own} and was recorded in {unit}. Numbers are not converted: correct "
                    "one of them, or give observe={output: function(t, s, p, u)} that converts.",
                    UnitWarning,
                )

    def at(self, x: Conditions, outputs: Sequence[str] | None = None) -> Callable[[Tensor], Tensor]:
        """Not possible without runs: bind a recording first."""
        raise SimulatorError(
            "Expected a recording in time for an ODESimulator. Got conditions alone. Use simulator.bind(recording), "
            "with a Recording(runs=[Run(...)])."
        )


def _state(name: str) -> Callable[..., Tensor]:
    return functools.partial(_read, name)  # and no lambda, which no other process can be sent


def _read(name: str, t: Tensor, s: Mapping[str, Tensor], p: Mapping[str, Tensor], u: Mapping[str, Tensor]) -> Tensor:
    return s[name]
