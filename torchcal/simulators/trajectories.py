"""An ODE simulator bound to the runs of a recording: outputs and exact sensitivities, parallel in time.

Runge–Kutta steps are all taken at once from a guessed trajectory; Newton's method on the whole trajectory removes the
gaps between them. Each pass costs one batched step, whatever the length of the recording, and its derivatives are the
exact derivatives of the discrete solution.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.errors import DomainError, RecordingError, SimulatorError
from torchcal.simulators.parameter import Parameter
from torchcal.simulators.static import Conditions, Linearisation, Simulator

if TYPE_CHECKING:
    from torchcal.simulators.ode import ODESimulator

__all__ = ["Trajectories"]

#: A run is first solved with at least this many steps.
MIN_STEPS = 48
#: Gaps in a trajectory, relative to the state's size, below which Newton's method stops.
GAP = 1e-9
#: Gaps whose square is below `GAP`: after one more correction nothing is left to check.
QUADRATIC = 1e-5
#: Gaps, relative to the state's size, from which Newton's method is not tried.
WILD = 1e3
#: Newton passes before the trajectory is solved step by step instead.
MAX_PASSES = 8
#: Points whose derivatives are computed at once: about what a processor's cache holds.
POINTS = 2**15
#: Numbers of trajectories kept at once, 64 MiB.
NUMBERS = 2**23
#: How often steps are halved at most, and how much shorter they become at once where they err.
HALVINGS, MOST_DENSER = 7, 16


class Trajectories(Simulator):
    """`ODESimulator` for the runs of one recording. Its conditions are the recording's, and no others.

    Args:
        ode: The simulator.
        recording: Made from runs.
        subdivide: Steps are this many times shorter than the coarsest that the samples allow.
    """

    def __init__(
        self,
        ode: "ODESimulator",
        recording: Recording,
        *,
        subdivide: int = 1,
        denser: tuple[Tensor, ...] | None = None,
    ) -> None:
        if not isinstance(recording, Recording) or recording.runs is None:
            raise RecordingError(
                "Expected a recording in time, Recording(runs=[Run(...)]). Got "
                f"{'a static recording' if isinstance(recording, Recording) else type(recording).__name__}."
            )
        if unknown := [name for name in recording.outputs if name not in ode.observe]:
            raise SimulatorError(
                f"Expected recorded outputs among {list(ode.observe)}. Got {unknown} "
                "(give observe={output: function(t, s, p, u)})."
            )
        self.ode = ode
        self.recording = recording
        self.subdivide = subdivide
        self.denser = denser
        self.degree = None
        self.runs = recording.runs
        self._states = tuple(ode.states)
        self._lay_grid()
        self._lay_parameters()

    # --- layout ------------------------------------------------------------------------------------------

    def _lay_grid(self) -> None:
        """Steps of every run, padded to one number with steps of length zero."""
        grids, picks = [], []
        for r, run in enumerate(self.runs):
            gaps = run.time.diff()
            longest = float(run.time[-1] - run.time[0]) / MIN_STEPS
            if self.ode.max_step is not None:
                longest = min(longest, self.ode.max_step)
            counts = (gaps / (longest * (1 + 1e-9))).ceil().clamp_min(1).long() * self.subdivide
            if self.denser is not None:
                counts = counts * self.denser[r]
            if int(counts.sum()) > 2_000_000:
                raise DomainError(
                    f"Expected at most 2 000 000 steps a run. Got {int(counts.sum())} (give a longer max_step)."
                )
            start = torch.repeat_interleave(run.time[:-1], counts)
            h = torch.repeat_interleave(gaps / counts, counts)
            offset = torch.arange(len(start)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
            start = start + offset * h
            grids.append((start, h, run))
            picks.append(torch.cat([counts.new_zeros(1), counts.cumsum(0)]))
        most = max(len(h) for _, h, _ in grids)
        self.num_steps = most
        steps, starts, nodes = [], [], []
        inputs: dict[str, list[Tensor]] = {name: [] for name in self.runs[0].inputs}
        for start, h, run in grids:
            pad = most - len(h)
            steps.append(torch.cat([h, h.new_zeros(pad)]))
            starts.append(torch.cat([start, run.time[-1].expand(pad)]))
            nodes.append(torch.cat([starts[-1], (starts[-1][-1] + steps[-1][-1])[None]]))
            ends = torch.cat([start[1:], run.time[-1:]])
            stages = [run.inputs_at(start), run.inputs_at(0.5 * (start + ends)), run.inputs_at(ends, side="left")]
            for name, table in inputs.items():
                rows = torch.stack([stage[name] for stage in stages])
                table.append(torch.cat([rows, rows[:, -1:].expand(3, pad)], dim=1))
        self._h = torch.stack(steps)  # (R, K)
        self._t = torch.stack(starts)
        self.node_times = torch.stack(nodes)  # (R, K + 1)
        self._u = {name: torch.stack(table, dim=1) for name, table in inputs.items()}  # (3, R, K)
        self._run_of = torch.cat([torch.full((len(run.time),), r) for r, run in enumerate(self.runs)])
        self._node_of = torch.cat(picks)
        self._data_t = torch.cat([run.time for run in self.runs])
        self._data_u = {name: torch.cat([run.inputs[name] for run in self.runs]) for name in inputs}
        self.x = self.recording.x

    def _lay_parameters(self) -> None:
        """Free numbers: the simulator's parameters, each run's own, and unknown initial states."""
        count = len(self.runs)
        parameters: list[Parameter] = []
        self._columns: dict[str, list[int]] = {}
        for parameter in self.ode.parameters:
            first = len(parameters)
            if parameter.per_run and count > 1:
                self._columns[parameter.name] = [first + r for r in range(count)]
                parameters += [_renamed(parameter, f"{parameter.name}[{r}]") for r in range(count)]
            else:
                self._columns[parameter.name] = [first]
                parameters.append(parameter)
        # Which parameter, and which run's, each column is; initial states act on no rate.
        self._owner: dict[int, tuple[str, int | None]] = {
            place: (name, None if len(places) == 1 else r)
            for name, places in self._columns.items() for r, place in enumerate(places)
        }  # fmt: skip
        self._initial: list[dict[str, Any]] = []
        self.initial_names: list[str] = []
        for r, run in enumerate(self.runs):
            if unknown := [name for name in run.initial if name not in self._states]:
                raise RecordingError(f"Expected initial values of states {list(self._states)}. Got {unknown}.")
            known: dict[str, Any] = {}
            for state, unit in self.ode.states.items():
                if state in run.initial:
                    known[state] = float(run.initial[state])
                elif state in self.ode.initial:
                    known[state] = self.ode.initial[state]
                else:
                    name = f"{state}(0)" if count == 1 else f"{state}(0)[{r}]"
                    known[state] = ("free", len(parameters))
                    self.initial_names.append(name)
                    parameters.append(Parameter(name, unit=unit, initial=self._first_guess(state, r)))
            self._initial.append(known)
        self.parameters = tuple(parameters)

    @property
    def nuisance(self) -> tuple[str, ...]:
        """What each run has for itself: unknown initial states and per-run parameters; not embedded by default."""
        own = {name for name, run in self._owner.values() if run is not None}
        columns = [i for name in own for i in self._columns[name]]
        return (*(self.names[i] for i in sorted(columns)), *self.initial_names)

    def _first_guess(self, state: str, r: int) -> float | None:
        """The first recorded value of a state that is itself an output."""
        if state not in self.recording.outputs or state not in self.ode.outputs:
            return None
        values = self.runs[r].outputs.get(state)
        if values is None:
            return None
        seen = values[~torch.isnan(values)]
        return float(seen[0]) if len(seen) else None

    def bind(self, recording: Recording) -> "Trajectories":
        """These trajectories, if the recording is theirs; else those of the other recording."""
        if recording is self.recording:
            return self
        if self.denser is not None:  # where steps must be short is another place there
            return self.elsewhere(recording)
        return Trajectories(self.ode, recording, subdivide=self.subdivide)

    def elsewhere(self, recording: Recording) -> "Trajectories":
        """The same simulator for other runs, with steps no longer than these.

        Where these differ, no longer than the shortest of them, but at most `MOST_DENSER` times shorter than usual.
        """
        other = Trajectories(self.ode, recording)
        shortest = self._h.max() if self.denser is None else self._h[self._h > 0].min()
        share = math.ceil(float(other._h.max() / shortest) * (1 - 1e-9))
        if self.denser is not None:
            share = min(share, MOST_DENSER * self.subdivide)
        return other.refined(share) if share > 1 else other

    def refined(self, factor: int = 2) -> "Trajectories":
        """The same with shorter steps."""
        return Trajectories(self.ode, self.recording, subdivide=self.subdivide * factor, denser=self.denser)

    def focused(self, values: Tensor, states: Tensor, excess: float) -> "Trajectories":
        """The same with shorter steps where they err, for an error that is smaller by some factor.

        The error of a step of order 5, from two of half its length, is spread such that the fewest steps have the
        wanted sum of errors.

        Args:
            values: Parameter values, ``(d,)``.
            states: Their trajectory, ``(1, R, nodes, S)``.
            excess: By what the error must fall.
        """
        runs, size = len(self.runs), states.shape[-1]
        run_of = torch.arange(runs).repeat_interleave(self.num_steps)
        t, h = self._t.reshape(-1), self._h.reshape(-1)
        first, middle, last = ({name: table[i].reshape(-1) for name, table in self._u.items()} for i in range(3))

        def inputs(a: dict[str, Tensor], b: dict[str, Tensor]) -> dict[str, Tensor]:
            return {name: torch.stack([a[name], 0.5 * (a[name] + b[name]), b[name]]) for name in a}

        p = self._p(values[None], run_of)
        begin = states[:, :, :-1].reshape(1, -1, size)
        half = self._step(begin, t, 0.5 * h, p, inputs(first, middle))
        twice = self._step(half, t + 0.5 * h, 0.5 * h, p, inputs(middle, last))
        once = self._step(begin, t, h, p, {name: table.reshape(3, -1) for name, table in self._u.items()})
        scale = states[0].abs().amax(dim=(0, 1)).clamp_min(1e-300)
        error = ((twice - once)[0].abs() / scale).amax(-1).reshape(runs, -1)
        number = [self._node_of[self._run_of == r].diff() for r in range(runs)]  # steps in each gap between samples
        gaps = []
        for r, counts in enumerate(number):
            place = torch.arange(len(counts)).repeat_interleave(counts)
            gaps.append(torch.zeros(len(counts), dtype=error.dtype).index_add_(0, place, error[r, : len(place)]))
        every = torch.cat(gaps)
        if not bool(torch.isfinite(every).all()) or not float(every.sum()) > 0:
            return self.refined(2)
        level = (every.sum() / excess / (every.pow(0.2) * torch.cat(number).double().pow(0.8)).sum()).pow(1.25)
        factors = [
            (gap / (count * level)).pow(0.2).ceil().clamp(1, MOST_DENSER).long()
            for gap, count in zip(gaps, number, strict=True)
        ]
        if all(bool((factor == 1).all()) for factor in factors):
            return self.refined(2)
        old = self.denser or tuple(torch.ones_like(factor) for factor in factors)
        denser = tuple(a * b for a, b in zip(old, factors, strict=True))
        return Trajectories(self.ode, self.recording, subdivide=self.subdivide, denser=denser)

    def settled(self, values: Tensor, allowed: Tensor) -> "Trajectories":
        """These trajectories, with steps so short that halving them changes no output by more than ``allowed``.

        A solution that is infinite with both steps counts as settled. Where the simulator has a ``max_step``, the
        steps stay as they are.

        Args:
            values: Parameter values to look at, ``(H, d)``, physical units.
            allowed: Largest change of each output, ``(n_total,)``.

        Raises:
            SimulatorError: If it still changes after `HALVINGS` halvings.
        """
        if self.ode.max_step is not None:
            return self
        here = self
        y = here.outputs_of(values, here.solve(values))
        for _ in range(HALVINGS):
            finer = here.refined(2)
            z = finer.outputs_of(values, finer.solve(values))
            change = torch.where(torch.isfinite(y) | torch.isfinite(z), (z - y).abs(), torch.zeros_like(y))
            if bool((change <= allowed).all()):
                return here
            here, y = finer, z
        share = float((change / allowed).nan_to_num(nan=math.inf).max())
        raise SimulatorError(
            f"Expected the solution to settle when time steps are halved. Got a change {share:.2g} times as large as "
            f"allowed after {HALVINGS} times (a stiff or discontinuous model: smooth it, rescale it, replace a fast "
            "state by its equilibrium, or give max_step=)."
        )

    def check(self, x: Conditions, values: Tensor, outputs: Sequence[str] | None = None) -> int:
        """As for any simulator; rates must also be written elementwise, and with torch operations alone.

        Raises:
            SimulatorError: As `Simulator.check`; if the rates at many times at once differ from those at one time
                after another, or if the outputs change with a parameter by which they have no derivative.
        """
        total = super().check(x, values, outputs)
        wanted = tuple(outputs) if outputs is not None else self.recording.outputs
        good = torch.isfinite(self.outputs_of(values, self.solve(values), wanted)).all(-1)
        point = values[good.nonzero()[:1, 0]].detach()
        states = self.solve(point)
        with torch.no_grad():
            ends = self._step_derivatives(point, states, ())[0]
        size = states.abs().amax(dim=(0, 1, 2)).clamp_min(1e-300)
        gap = float(((ends - states[:, :, 1:]).abs() / size).max())
        if not gap <= 1e-9:
            raise SimulatorError(
                f"Expected the same rates at many times at once as at one time. Got a difference of {gap:.3g}. Write "
                "the rates elementwise: s[name] has shape (*batch, R), p[name] (*batch, 1), u[name] (R,), t is a "
                "scalar or (R,); leave sums over them, random numbers and branches on t out of it."
            )
        found = self.linearise(x, point, wanted)
        step = 1e-6 * point.abs().clamp_min(1e-3)
        with torch.no_grad():
            moved = torch.cat([point + torch.diag_embed(step[0]), point - torch.diag_embed(step[0])])
            up, down = self.outputs_of(moved, self.solve(moved), wanted).chunk(2)
        change = (up - down).abs().amax(-1)
        dead = (found.jacobian[0] == 0).all(0) & (change > 1e-8 * found.y.abs().max()) & torch.isfinite(change)
        if bool(dead.any()):
            name = self.names[int(dead.nonzero()[0])]
            raise SimulatorError(
                f"Expected outputs that depend on {name!r} through torch operations. Got outputs that change with it "
                "and have no derivative. Avoid .item(), .detach() and numpy in the rates."
            )
        return total

    # --- evaluation --------------------------------------------------------------------------------------

    def at(self, x: Conditions, outputs: Sequence[str] | None = None) -> Callable[[Tensor], Tensor]:
        """Outputs as a function of parameter values, differentiable by autograd; x must be the recording's."""
        self._check_conditions(x)
        wanted = tuple(outputs) if outputs is not None else self.recording.outputs

        size = max(1, NUMBERS // self.node_times.numel() // len(self._states))

        def evaluate(values: Tensor) -> Tensor:
            batch = values.shape[:-1]
            flat = values.reshape(-1, values.shape[-1]).to(device="cpu", dtype=torch.float64)
            result = torch.cat([self._differentiable(piece, wanted) for piece in flat.split(size)])
            return result.to(values).reshape(*batch, result.shape[-1])

        return evaluate

    def _differentiable(self, values: Tensor, outputs: Sequence[str]) -> Tensor:
        if not (torch.is_grad_enabled() and values.requires_grad):
            return self.outputs_of(values, self.solve(values), outputs)
        found = self.linearise(self.x, values, outputs)
        result: Tensor = _WithJacobian.apply(values, found.y, found.jacobian)
        return result

    def _check_conditions(self, x: Conditions) -> None:
        time = x["time"] if isinstance(x, Mapping) and "time" in x and "run" in x else None
        if time is None or not torch.equal(time.cpu().to(torch.float64), self._data_t):
            raise DomainError(
                "Expected the conditions of the recording that the simulator was bound to. Got others "
                "(bind another recording: simulator.bind(recording))."
            )

    def linearise(
        self,
        x: Conditions,
        values: Tensor,
        outputs: Sequence[str] | None = None,
        columns: Sequence[int] | None = None,
        warm: Any = None,
        *,
        march: bool = True,
    ) -> Linearisation:
        """Outputs and their derivatives; ``warm`` is the trajectory of an earlier, nearby call.

        Where Newton's method does not settle from there, the trajectory is solved step by step; without ``march`` it is
        infinite instead.
        """
        wanted = tuple(outputs) if outputs is not None else self.recording.outputs
        values = values.detach()
        columns = list(range(values.shape[-1])) if columns is None else list(columns)
        found = []
        with torch.no_grad():
            states = self._solve(values, warm, march=march)
            size = max(1, POINTS // self.node_times.numel())
            for v, s in zip(values.split(size), states.split(size), strict=True):
                tangents = self._sensitivities(v, s, columns) if columns else None
                found.append(self._observe(v, s, wanted, columns, tangents))
        return Linearisation(torch.cat([y for y, _ in found]), torch.cat([j for _, j in found]), states)

    def solve(self, values: Tensor, warm: Any = None) -> Tensor:
        """States at the ends of all steps, ``(H, R, K + 1, states)``; infinite where the solution blows up."""
        with torch.no_grad():
            return self._solve(values.detach(), warm)

    def outputs_of(self, values: Tensor, states: Tensor, outputs: Sequence[str] | None = None) -> Tensor:
        """Outputs ``(H, n_total)`` of solved states."""
        wanted = tuple(outputs) if outputs is not None else self.recording.outputs
        with torch.no_grad():
            return self._observe(values.detach(), states, wanted)[0]

    def along(self, values: Tensor, states: Tensor) -> dict[str, Tensor]:
        """Time, states and inputs at the ends of all steps, each ``(R, K + 1)``; one row of values."""
        found = {"t": self.node_times}
        found |= {name: states[0, ..., i] for i, name in enumerate(self._states)}
        found |= {name: torch.cat([table[0], table[2][:, -1:]], dim=1) for name, table in self._u.items()}
        return found

    def _p(self, values: Tensor, run_of: Tensor | None = None) -> dict[str, Tensor]:
        """Parameters by name, ``(H, 1)``, or spread over runs and picked by ``run_of``."""
        found = {}
        for name, places in self._columns.items():
            block = values[..., places]
            found[name] = block if len(places) == 1 or run_of is None else block[..., run_of]
        return found

    def _start(self, values: Tensor) -> Tensor:
        """Initial states ``(H, R, states)``."""
        rows = []
        for r, known in enumerate(self._initial):
            entries: dict[str, Tensor] = {}
            own = {name: values[..., places[0 if len(places) == 1 else r], None]
                   for name, places in self._columns.items()}  # fmt: skip
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
                        entries[state] = value(entries, own) + torch.zeros_like(values[..., :1])
                except Exception as error:
                    raise SimulatorError(
                        f"Expected the initial value of {state!r} from those of {list(entries)}, which are known by "
                        f"then, and parameters {list(own)}. It raised {type(error).__name__}: {error}."
                    ) from error
            rows.append(torch.cat([entries[state] for state in self._states], dim=-1))
        return torch.stack(rows, dim=-2)

    def _slope(self, t: Tensor, s: Tensor, p: dict[str, Tensor], u: dict[str, Tensor]) -> Tensor:
        """Rates ``(H, M, states)`` at states ``(H, M, states)``."""
        named = {name: s[..., i] for i, name in enumerate(self._states)}
        try:
            rates = self.ode.rates(t, named, p, u)
        except SimulatorError:
            raise
        except Exception as error:
            raise SimulatorError(
                f"Expected rates(t, s, p, u) to return the rates by state. It raised {type(error).__name__}: {error}. "
                f"It was called with states of shape {tuple(s.shape[:-1])} and parameters "
                f"{', '.join(p)} of shape {tuple(next(iter(p.values())).shape)}."
            ) from error
        if not isinstance(rates, Mapping) or set(rates) != set(self._states):
            got = list(rates) if isinstance(rates, Mapping) else type(rates).__name__
            raise SimulatorError(f"Expected the rates of {list(self._states)} as a dict. Got {got}.")
        columns = []
        for name in self._states:
            rate = rates[name]
            if not isinstance(rate, Tensor):
                rate = torch.as_tensor(float(rate), dtype=s.dtype)
            try:
                columns.append(rate.expand(s.shape[:-1]) if rate.shape != s.shape[:-1] else rate)
            except RuntimeError as error:
                raise SimulatorError(
                    f"Expected the rate of {name!r} of shape {tuple(s.shape[:-1])} (batch, runs). "
                    f"Got {tuple(rate.shape)}. Write the rates elementwise."
                ) from error
        return torch.stack(columns, dim=-1)

    def _step(self, s: Tensor, t: Tensor, h: Tensor, p: dict[str, Tensor], u: dict[str, Tensor]) -> Tensor:
        """One Runge–Kutta step of every point ``(H, M, states)``; t, h ``(M,)``, u ``(3, M)``."""
        first, middle, last = ({name: table[i] for name, table in u.items()} for i in range(3))
        half, full = (0.5 * h)[:, None], h[:, None]
        k1 = self._slope(t, s, p, first)
        k2 = self._slope(t + 0.5 * h, s + half * k1, p, middle)
        k3 = self._slope(t + 0.5 * h, s + half * k2, p, middle)
        k4 = self._slope(t + h, s + full * k3, p, last)
        return s + (full / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)

    def _solve(self, values: Tensor, warm: Any = None, *, march: bool = True) -> Tensor:
        if warm is None or warm.shape[0] != values.shape[0]:
            if len(values) * self._h.numel() > POINTS:  # of many trajectories, a step costs less than a pass over all
                return self._march(values)
            # Trajectories that stand still are a poor guess, but cost little to try.
            warm = self._start(values).unsqueeze(2).expand(-1, -1, self.num_steps + 1, -1)
            march = True
        states, settled = self._newton(values, warm)
        if march and not bool(settled.all()):
            states[~settled] = self._march(values[~settled])
        elif not march:
            states[~settled] = math.inf
        return states

    def _march(self, values: Tensor) -> Tensor:
        """Step by step."""
        state = self._start(values)
        p = self._p(values)
        found = [state]
        for k in range(self.num_steps):
            u = {name: table[:, :, k] for name, table in self._u.items()}
            state = self._step(state, self._t[:, k], self._h[:, k], p, u)
            found.append(state)
        states = torch.stack(found, dim=-2)
        return torch.where(torch.isfinite(states), states, torch.full_like(states, math.inf))

    def _newton(self, values: Tensor, guess: Tensor) -> tuple[Tensor, Tensor]:
        """Newton's method on whole trajectories, and which rows ``(H,)`` settled."""
        states = guess.clone()
        states[:, :, 0] = self._start(values)
        size = states.abs().amax(dim=(1, 2), keepdim=True).clamp_min(1e-300)
        settled = torch.zeros(len(values), dtype=torch.bool)
        active = torch.isfinite(states).flatten(1).all(-1)
        last = torch.full((len(values),), math.inf, dtype=torch.float64)
        for _ in range(MAX_PASSES):
            rows = active.nonzero()[:, 0]
            if len(rows) == 0:
                break
            now = states[rows]
            ends, flow, _ = self._step_derivatives(values[rows], now, ())
            gap = ends - now[:, :, 1:]
            worst = (gap.abs() / size[rows]).flatten(1).amax(-1)
            good = torch.isfinite(worst) & (worst < 4.0 * last[rows]) & (worst < WILD)
            last[rows] = worst
            change = _recur(flow, torch.nan_to_num(gap).unsqueeze(-1))[..., 0]
            moved = torch.cat([now[:, :, :1], now[:, :, 1:] + change], dim=2)
            good &= torch.isfinite(moved).flatten(1).all(-1)
            states[rows] = torch.where((good & (worst >= GAP))[:, None, None, None], moved, now)
            settled[rows] = good & (worst < QUADRATIC)
            active[rows] = good & (worst >= QUADRATIC)
        return states, settled

    def _step_derivatives(
        self, values: Tensor, states: Tensor, columns: Sequence[int]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Ends of all steps begun at ``states``, and their derivatives by the states and by some parameters.

        Returns ends ``(H, R, K, S)``, flow ``(H, R, K, S, S)`` and forcing ``(H, R, K, S, len(columns))``.
        """
        hyper, runs, _, size = states.shape
        steps = self.num_steps
        run_of = torch.arange(runs).repeat_interleave(steps)
        t, h = self._t.reshape(-1), self._h.reshape(-1)
        u = {name: table.reshape(3, -1) for name, table in self._u.items()}
        with torch.enable_grad():
            begin = states[:, :, :-1].reshape(hyper, runs * steps, size).detach().requires_grad_(True)
            leaves = self._leaves(values, run_of, columns)
            ends = self._step(begin, t, h, leaves, u)
            flow, forcing = self._backward(ends, begin, leaves, run_of, columns)
        shape = (hyper, runs, steps, size)
        return ends.detach().reshape(shape), flow.reshape(*shape, size), forcing.reshape(*shape, len(columns))

    def rates_by(self, values: Tensor, states: Tensor, columns: Sequence[int]) -> Tensor:
        """Derivatives of the rates by some parameters where steps begin, ``(H, R, K, S, len(columns))``."""
        hyper, runs, _, size = states.shape
        run_of = torch.arange(runs).repeat_interleave(self.num_steps)
        u = {name: table[0].reshape(-1) for name, table in self._u.items()}
        with torch.enable_grad():
            begin = states[:, :, :-1].reshape(hyper, -1, size).detach().requires_grad_(True)
            leaves = self._leaves(values, run_of, columns)
            rates = self._slope(self._t.reshape(-1), begin, leaves, u)
            _, found = self._backward(rates, begin, leaves, run_of, columns)
        return found.reshape(hyper, runs, self.num_steps, size, len(columns))

    def _leaves(self, values: Tensor, run_of: Tensor, columns: Sequence[int]) -> dict[str, Tensor]:
        """Parameters spread over points ``(H, M)``; those that are derived by are leaves of a graph."""
        wanted = set(columns)
        found = {}
        for name, places in self._columns.items():
            block = values[..., places]
            spread = block.expand(-1, len(run_of)) if len(places) == 1 else block[..., run_of]
            if wanted & set(places):
                found[name] = spread.clone().requires_grad_(True)
            else:
                found[name] = block if len(places) == 1 else spread
        return found

    def _backward(
        self, result: Tensor, begin: Tensor, leaves: dict[str, Tensor], run_of: Tensor, columns: Sequence[int]
    ) -> tuple[Tensor, Tensor]:
        """Derivatives of pointwise results ``(H, M, O)`` by states ``(H, M, O, S)`` and columns ``(H, M, O, C)``.

        Every point depends on its own state and parameters alone, so that one backward pass for each component of the
        result gives the derivatives at all points.
        """
        names = [name for name, leaf in leaves.items() if leaf.requires_grad]
        inputs = [begin, *(leaves[name] for name in names)]
        by_state, by_column = [], []
        for k in range(result.shape[-1]):
            part = result[..., k]
            grads: Sequence[Tensor | None] = [None] * len(inputs)
            if part.requires_grad:
                keep = k + 1 < result.shape[-1]
                grads = torch.autograd.grad(part.sum(), inputs, retain_graph=keep, allow_unused=True)
            by_state.append(torch.zeros_like(begin) if grads[0] is None else grads[0])
            own = dict(zip(names, grads[1:], strict=True))
            rows = []
            for column in columns:
                name, run = self._owner.get(column, ("", None))
                grad = own.get(name)
                if grad is None:
                    rows.append(torch.zeros_like(part))
                else:
                    rows.append(grad if run is None else grad * (run_of == run))
            by_column.append(torch.stack(rows, dim=-1) if rows else part.new_zeros(*part.shape, 0))
        return torch.stack(by_state, dim=-2), torch.stack(by_column, dim=-2)

    def _sensitivities(self, values: Tensor, states: Tensor, columns: Sequence[int]) -> Tensor:
        """∂ states / ∂ parameters at the ends of all steps, ``(H, R, K + 1, S, len(columns))``."""
        _, flow, forcing = self._step_derivatives(values, states, columns)
        begin = self._start_slopes(values)[..., list(columns)]
        forcing = forcing.clone()
        forcing[:, :, 0] += flow[:, :, 0] @ begin
        return torch.cat([begin.unsqueeze(2), _recur(flow, forcing)], dim=2)

    def _start_slopes(self, values: Tensor) -> Tensor:
        """∂ initial states / ∂ parameters, ``(H, R, S, P)``."""
        with torch.enable_grad():
            leaf = values.detach().requires_grad_(True)
            start = self._start(leaf)
            rows = []
            for part in start.flatten(1).unbind(-1):
                grad = torch.autograd.grad(part.sum(), leaf, retain_graph=True)[0] if part.requires_grad else None
                rows.append(torch.zeros_like(leaf) if grad is None else grad)
        return torch.stack(rows, dim=1).unflatten(1, start.shape[1:])

    def flow(self, values: Tensor, states: Tensor) -> Tensor:
        """Derivative of the end of every step by its beginning, ``(H, R, K, S, S)``."""
        with torch.no_grad():
            return self._step_derivatives(values, states, ())[1]

    def _observe(
        self,
        values: Tensor,
        states: Tensor,
        outputs: Sequence[str],
        columns: Sequence[int] = (),
        tangents: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Outputs ``(H, n_total)`` and their derivatives ``(H, n_total, len(columns))``."""
        seen = states[:, self._run_of, self._node_of]  # (H, n, S)
        if tangents is None:
            found = self._measure(self._p(values, self._run_of), seen, outputs)
            return found, found.new_zeros(*found.shape, 0)
        moved = tangents[:, self._run_of, self._node_of]  # (H, n, S, C)
        with torch.enable_grad():
            begin = seen.detach().requires_grad_(True)
            leaves = self._leaves(values, self._run_of, columns)
            y = self._measure(leaves, begin, outputs)  # (H, outputs * n)
            parts = torch.stack(y.split(seen.shape[1], dim=-1), dim=-1)
            by_state, by_column = self._backward(parts, begin, leaves, self._run_of, columns)
        jacobian = by_state @ moved + by_column  # (H, n, outputs, C)
        return y.detach(), jacobian.transpose(1, 2).flatten(1, 2)

    def observation_slopes(self, values: Tensor, states: Tensor, outputs: Sequence[str]) -> Tensor:
        """∂ output / ∂ state at every datum, ``(n_total, S)``; one row of values."""
        seen = states[:, self._run_of, self._node_of]
        with torch.enable_grad():
            begin = seen.detach().requires_grad_(True)
            y = self._measure(self._p(values, self._run_of), begin, outputs)
            parts = torch.stack(y.split(seen.shape[1], dim=-1), dim=-1)
            by_state, _ = self._backward(parts, begin, {}, self._run_of, ())
        return by_state[0].transpose(0, 1).flatten(0, 1)

    def slopes(self, values: Tensor, start: Tensor) -> Tensor:
        """Rates of all states at the beginning of every run, ``(H, R, states)``, at states ``(H, R, states)``."""
        u = {name: table[0, :, 0] for name, table in self._u.items()}
        return self._slope(self._t[:, 0], start, self._p(values), u)

    def _measure(self, p: dict[str, Tensor], seen: Tensor, outputs: Sequence[str]) -> Tensor:
        s = {name: seen[..., i] for i, name in enumerate(self._states)}
        parts = []
        for name in outputs:
            try:
                value = self.ode.observe[name](self._data_t, s, p, self._data_u)
            except Exception as error:
                raise SimulatorError(
                    f"Expected the output {name!r} as a tensor. Its function raised {type(error).__name__}: {error}."
                ) from error
            parts.append(torch.as_tensor(value, dtype=seen.dtype).expand(seen.shape[:-1]))
        return torch.cat(parts, dim=-1)


class _WithJacobian(torch.autograd.Function):
    """Outputs that are known already, tied to the parameters by their Jacobian."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, y: Tensor, jacobian: Tensor) -> Tensor:
        ctx.save_for_backward(jacobian)
        return y.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:
        (jacobian,) = ctx.saved_tensors
        return (grads[0].unsqueeze(-2) @ jacobian)[..., 0, :], None, None


def _recur(flow: Tensor, forcing: Tensor) -> Tensor:
    """x₁ … x_K of x_{k+1} = flow_k x_k + forcing_k with x₀ = 0, in blocks that run side by side.

    Args:
        flow: ``(H, R, K, S, S)``.
        forcing: ``(H, R, K, S, C)``.
    """
    steps = flow.shape[2]
    block = max(1, math.ceil(math.sqrt(steps)))
    count = math.ceil(steps / block)
    pad = count * block - steps
    if pad:
        eye = torch.eye(flow.shape[-1], dtype=flow.dtype).expand(*flow.shape[:2], pad, -1, -1)
        flow = torch.cat([flow, eye], dim=2)
        forcing = torch.cat([forcing, forcing.new_zeros(*forcing.shape[:2], pad, *forcing.shape[3:])], dim=2)
    # Columns of the identity ride along: they carry what enters a block to every step of it.
    flow = flow.unflatten(2, (count, block))
    forcing = forcing.unflatten(2, (count, block))
    size = flow.shape[-1]
    carried = torch.cat([torch.zeros_like(flow[:, :, :, 0]), forcing.new_zeros(*forcing[:, :, :, 0].shape)], dim=-1)
    carried[..., :size] += torch.eye(size, dtype=flow.dtype)
    inside = []
    zeros = torch.zeros_like(carried[..., :size])
    for k in range(block):
        carried = flow[:, :, :, k] @ carried + torch.cat([zeros, forcing[:, :, :, k]], dim=-1)
        inside.append(carried)
    within = torch.stack(inside, dim=3)  # (H, R, count, block, S, S + C)
    entering = [forcing.new_zeros(*forcing.shape[:2], size, forcing.shape[-1])]
    for j in range(count - 1):
        end = within[:, :, j, -1]
        entering.append(end[..., :size] @ entering[-1] + end[..., size:])
    enters = torch.stack(entering, dim=2).unsqueeze(3)
    found = within[..., :size] @ enters + within[..., size:]
    return found.flatten(2, 3)[:, :, :steps]


def _renamed(parameter: Parameter, name: str) -> Parameter:
    import dataclasses

    return dataclasses.replace(parameter, name=name)
