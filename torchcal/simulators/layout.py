"""What each number is that the trajectories of a recording depend on: parameters, each run's own, initial states."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchcal.data import Recording, Run
from torchcal.display import raised
from torchcal.errors import RecordingError, SimulatorError, TorchcalError
from torchcal.simulators.careful import careful, real, takes_inputs
from torchcal.simulators.parameter import Parameter, in_run

if TYPE_CHECKING:
    from torchcal.simulators.ode import ODESimulator

__all__ = ["Layout", "Values", "initial_name", "spread", "stacked"]


class Values(dict[str, Any]):
    """Parameters by name, as the functions of a simulator in time get them, and when what they act on began.

    Attributes:
        first: Time of the recording's first sample; None where nobody knows any more.
        start: Time of the first sample of the run: a number where it is the same for all, ``(R,)``, or that of each
            point's run.
    """

    def __init__(self, values: Mapping[str, Any], first: float | None, start: Any) -> None:
        super().__init__(values)
        self.first, self.start = first, start

    def copy(self) -> "Values":
        """The same, to be changed."""
        return Values(self, self.first, self.start)

    def at(self, places: Tensor) -> "Values":
        """Those at some of the points ``(n,)`` that values are for, where they differ from point to point."""

        def cut(value: Any) -> Any:
            return value[places] if isinstance(value, Tensor) and value.ndim else value

        return Values({name: cut(value) for name, value in self.items()}, self.first, cut(self.start))

    def __or__(self, other: Mapping[str, Any]) -> "Values":  # type: ignore[override]
        """The same with others beside or in place of them."""
        return Values({**self, **other}, self.first, self.start)


class Layout:
    """The columns of parameter values ``(H, P)`` for R runs.

    Args:
        ode: The simulator.
        recording: What is recorded.
        runs: Its runs.
        first: When the recording began whose clock this is; by default with the first sample of these runs.

    Attributes:
        parameters: Of the columns: the simulator's own, each run's copy of a per-run parameter, unknown initial states.
        initial_names: Of the unknown initial states.
        origins: What each column is a value of, and of which run where each has its own.
        first: When the recording began.
    """

    def __init__(
        self, ode: "ODESimulator", recording: Recording, runs: Sequence[Run], first: float | None = None
    ) -> None:
        self._states = tuple(ode.states)
        self._seen = ode.seen
        start = [float(run.time[0]) for run in runs]
        self.first = min(start) if first is None else first
        alike = all(one == self.first for one in start)
        self._start = None if alike else torch.tensor(start, dtype=torch.float64)
        parameters: list[Parameter] = []
        self.origins: list[tuple[str, int | None]] = []
        self._places: dict[str, list[int]] = {}
        for parameter in ode.parameters:
            place = len(parameters)
            self.origins += [(parameter.name, r) for r in (range(len(runs)) if parameter.per_run else [None])]
            if parameter.per_run and len(runs) > 1:
                self._places[parameter.name] = [place + r for r in range(len(runs))]
                parameters += [
                    dataclasses.replace(parameter, name=in_run(parameter.name, r)) for r in range(len(runs))
                ]
            else:
                self._places[parameter.name] = [place]
                parameters.append(parameter)
        self._own = len(parameters)  # the columns after these are initial states
        self._initial: list[dict[str, Any]] = []
        self._first_inputs = [{name: float(values[0]) for name, values in run.inputs.items()} for run in runs]
        self._asking = {state for state, value in ode.initial.items() if callable(value) and takes_inputs(value)}
        self.initial_names: list[str] = []
        for r, run in enumerate(runs):
            if unknown := [name for name in run.initial if name not in self._states]:
                raise RecordingError(f"Expected initial values of states {list(self._states)}. Got {unknown}.")
            known: dict[str, Any] = {}
            for state, unit in ode.states.items():
                if state in run.initial:
                    known[state] = float(run.initial[state])
                elif state in ode.initial:
                    known[state] = ode.initial[state]
                else:
                    name = initial_name(state, r, len(runs))
                    known[state] = ("free", len(parameters))
                    self.initial_names.append(name)
                    self.origins.append((initial_name(state, 0, 1), r))
                    seen = [one for one in recording.outputs if ode.reads.get(one) == state]
                    guess = _first_seen(run, seen)
                    parameters.append(Parameter(name, unit=unit, initial=guess, per_run=len(runs) > 1))
            self._initial.append(known)
        self.parameters = tuple(parameters)

    @property
    def nuisance(self) -> tuple[str, ...]:
        """What each run has for itself: unknown initial states and per-run parameters."""
        own = [i for places in self._places.values() if len(places) > 1 for i in places]
        return (*(self.parameters[i].name for i in own), *self.initial_names)

    def _values(self, run_of: Tensor | None) -> Values:
        if self._start is None:
            return Values({}, self.first, self.first)
        return Values({}, self.first, self._start if run_of is None else self._start[run_of])

    def by_name(self, values: Tensor, run_of: Tensor | None = None) -> Values:
        """Parameters by name, ``(H, 1)`` or ``(H, R)``; those of runs picked by ``run_of`` ``(M,)`` where given."""
        found = self._values(run_of)
        for name, places in self._places.items():
            block = values[..., places]
            found[name] = block if len(places) == 1 or run_of is None else block[..., run_of]
        return found

    def leaves(self, values: Tensor, run_of: Tensor, columns: Sequence[int]) -> Values:
        """The same, where those of some columns are spread over points ``(H, M)`` as leaves of a graph."""
        wanted = set(columns)
        found = self._values(run_of)
        for name, places in self._places.items():
            block = values[..., places]
            every = block.expand(-1, len(run_of)) if len(places) == 1 else block[..., run_of]
            if wanted & set(places):
                found[name] = every.clone().requires_grad_(True)
            else:
                found[name] = block if len(places) == 1 else every
        return found

    def derivatives(
        self,
        results: Sequence[Tensor],
        begin: Sequence[Tensor],
        leaves: Mapping[str, Tensor],
        run_of: Tensor,
        columns: Sequence[int],
    ) -> list[list[Tensor | None]]:
        """Derivatives of pointwise results ``(H, M)``: of each those by the states, one after another, and by columns,
        every one ``(H, M)``, or None where the result does not depend on it.

        Every point depends on its own state and parameters alone, so that one backward pass for each result gives the
        derivatives at all points.
        """
        names = [name for name, leaf in leaves.items() if leaf.requires_grad]
        inputs, found = [*begin, *(leaves[name] for name in names)], []
        for k, part in enumerate(results):
            grads: Sequence[Tensor | None] = [None] * len(inputs)
            if part.requires_grad:
                grads = torch.autograd.grad(part.sum(), inputs, retain_graph=k + 1 < len(results), allow_unused=True)
            own = dict(zip(names, grads[len(begin) :], strict=True))
            row = list(grads[: len(begin)])
            for column in columns:
                name, run = self.origins[column]
                grad = own.get(name) if column < self._own else None  # initial states act on no rate
                row.append(grad if grad is None or run is None else grad * (run_of == run))
            found.append(row)
        return found

    def start(self, values: Tensor) -> Tensor:
        """Initial states ``(H, R, S)``."""
        rows, one = [], values[..., :1].shape
        for r, known in enumerate(self._initial):
            entries: dict[str, Tensor] = {}
            own = {name: values[..., places[0 if len(places) == 1 else r], None]
                   for name, places in self._places.items()}  # fmt: skip
            inputs = {name: values.new_full((1,), first) for name, first in self._first_inputs[r].items()}
            for state, value in known.items():
                if isinstance(value, tuple):
                    entries[state] = values[..., value[1], None]
                elif isinstance(value, float | int):
                    entries[state] = values.new_full((*values.shape[:-1], 1), float(value))
            for state, value in known.items():
                try:
                    if isinstance(value, str):
                        entries[state] = entries[value]
                    elif callable(value):
                        given = {"s": entries, "p": own} | ({"u": inputs} if state in self._asking else {})
                        found = careful(self._seen, f"the initial value of {state!r}", value, **given)
                        entries[state] = real(found, values, one, f"the initial value of {state!r}")
                except TorchcalError:  # which says what to do
                    raise
                except Exception as error:
                    raise SimulatorError(
                        f"Expected the initial value of {state!r} from those of {list(entries)}, which are known by "
                        f"then, parameters {list(own)} and, as f(s, p, u), inputs {list(inputs)}. It raised "
                        f"{raised(error)}."
                    ) from error
            rows.append(torch.cat([entries[state] for state in self._states], dim=-1))
        return torch.stack(rows, dim=-2)

    def start_slopes(self, values: Tensor) -> Tensor:
        """∂ initial states / ∂ columns, ``(H, R, S, P)``."""
        if self._fixed_slopes is None:
            return self._start_slopes(values)
        return self._fixed_slopes.to(values).expand(len(values), -1, -1, -1)

    @functools.cached_property
    def _fixed_slopes(self) -> Tensor | None:
        """Of numbers, columns and other states, the same at all values; None where an initial state is a function."""
        if any(callable(value) for known in self._initial for value in known.values()):
            return None
        return self._start_slopes(torch.zeros(1, len(self.parameters), dtype=torch.float64))

    def _start_slopes(self, values: Tensor) -> Tensor:
        with torch.enable_grad():
            leaf = values.detach().requires_grad_(True)
            start = self.start(leaf)
            rows = []
            for part in start.flatten(1).unbind(-1):
                grad = torch.autograd.grad(part.sum(), leaf, retain_graph=True)[0] if part.requires_grad else None
                rows.append(torch.zeros_like(leaf) if grad is None else grad)
        return torch.stack(rows, dim=1).unflatten(1, start.shape[1:])


def stacked(rows: Sequence[Sequence[Tensor | None]], like: Tensor) -> Tensor:
    """Derivatives as of `Layout.derivatives`, each of the shape of one, ``like``, in one tensor ``(..., results, states
    and columns)``."""
    if not rows[0]:
        return like.new_zeros(*like.shape, len(rows), 0)
    zero = torch.zeros_like(like)
    every = torch.stack([zero if one is None else one for row in rows for one in row])
    return every.unflatten(0, (len(rows), -1)).movedim((0, 1), (-2, -1)).contiguous()


def spread(states: Tensor) -> list[Tensor]:
    """Each of some states ``(..., S)`` by itself, as a leaf of a graph."""
    own = states.detach().movedim(-1, 0).clone(memory_format=torch.contiguous_format)
    return [one.requires_grad_(True) for one in own.unbind(0)]


def initial_name(state: str, run: int, runs: int) -> str:
    """Of the unknown initial value of a state in one of some runs."""
    return f"{state}(0)" if runs == 1 else f"{state}(0)[{run}]"


def _first_seen(run: Run, outputs: Sequence[str]) -> float | None:
    """The first recorded value of the first of some outputs that the run has any of."""
    for output in outputs:
        values = run.outputs.get(output)
        seen = None if values is None else values[~torch.isnan(values)]
        if seen is not None and len(seen):
            return float(seen[0])
    return None
