"""An ODE simulator bound to the runs of a recording: outputs and the exact derivatives of the discrete solution."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.display import raised
from torchcal.errors import DomainError, RecordingError, SimulatorError
from torchcal.simulators.careful import careful, real, unknown_name
from torchcal.simulators.grid import Grid
from torchcal.simulators.implicit import ImplicitSteps
from torchcal.simulators.layout import Layout, spread, stacked
from torchcal.simulators.solution import Solution
from torchcal.simulators.static import Conditions, Linearisation, Simulator, check_values
from torchcal.simulators.steps import POINTS, Steps

if TYPE_CHECKING:
    from torchcal.simulators.ode import ODESimulator

__all__ = ["Trajectories"]

#: Numbers of trajectories kept at once, 64 MiB.
NUMBERS = 2**23
#: How much shorter steps are elsewhere at most, where those here differ.
MOST_SHORTER = 16


class Trajectories(Simulator):
    """`ODESimulator` for the runs of one recording. Its conditions are the recording's, and no others.

    Args:
        ode: The simulator.
        recording: Made from runs.
        subdivide: Steps are this many times shorter than the coarsest that the samples allow.
        denser: The same for each gap between samples of each run, beside that.
        implicit: Whether steps are implicit; by default where the simulator says that it is stiff.
        first: When the recording began on whose clock the runs are; by default with their first sample.

    Attributes:
        grid: Its time steps.
        layout: What each parameter value is.
        steps: The steps, and how trajectories are found.
    """

    dear = True

    def __init__(
        self,
        ode: "ODESimulator",
        recording: Recording,
        *,
        subdivide: int = 1,
        denser: tuple[Tensor, ...] | None = None,
        implicit: bool | None = None,
        first: float | None = None,
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
        self.implicit = bool(ode.stiff) if implicit is None else implicit
        self.degree = None
        self.runs = recording.runs
        self._states = tuple(ode.states)
        self.grid = Grid.of(self.runs, max_step=ode.max_step, subdivide=subdivide, denser=denser)
        self.layout = Layout(ode, recording, self.runs, first)
        self.steps = (ImplicitSteps if self.implicit else Steps)(ode, self.layout, self.grid)
        self.parameters = self.layout.parameters
        self.x = recording.x

    @property
    def num_steps(self) -> int:
        """Steps of a run."""
        return self.grid.num_steps

    @property
    def initial_names(self) -> list[str]:
        """Of the unknown initial states."""
        return self.layout.initial_names

    @property
    def nuisance(self) -> tuple[str, ...]:
        """What each run has for itself, which is not embedded by default: see `Layout.nuisance`."""
        return self.layout.nuisance

    def bind(self, recording: Recording) -> "Trajectories":
        """These trajectories, if the recording is theirs; else those of the other recording."""
        if recording is self.recording:
            return self
        if self.denser is not None:  # where steps must be short is another place there
            return self.elsewhere(recording)
        return Trajectories(self.ode, recording, subdivide=self.subdivide, implicit=self.implicit)

    def elsewhere(self, recording: Recording, *, first: float | None = None) -> "Trajectories":
        """The same simulator for other runs, with steps no longer than these.

        Where these differ, no longer than the shortest of them, but at most `MOST_SHORTER` times shorter than usual.
        The recording began at ``first``; by default with the other runs.
        """
        other = Trajectories(self.ode, recording, implicit=self.implicit, first=first)
        shortest = self.grid.h.max() if self.denser is None else self.grid.h[self.grid.h > 0].min()
        share = math.ceil(float(other.grid.h.max() / shortest) * (1 - 1e-9))
        if self.denser is not None:
            share = min(share, MOST_SHORTER * self.subdivide)
        return other.refined(share) if share > 1 else other

    def refined(self, factor: int = 2) -> "Trajectories":
        """The same with shorter steps."""
        return self.with_steps(self.subdivide * factor, self.denser)

    def with_steps(self, subdivide: int, denser: tuple[Tensor, ...] | None) -> "Trajectories":
        """The same with steps of other lengths."""
        return Trajectories(
            self.ode,
            self.recording,
            subdivide=subdivide,
            denser=denser,
            implicit=self.implicit,
            first=self.layout.first,
        )

    def check(self, x: Conditions, values: Tensor, outputs: Sequence[str] | None = None) -> int:
        """As for any simulator; rates must also be written elementwise.

        Raises:
            SimulatorError: As `Simulator.check`; if no values give finite rates where runs begin; if the rates at many
                times at once differ from those at one time after another.
        """
        self._check_rates(values.detach())
        total = super().check(x, values, outputs)
        wanted = tuple(outputs) if outputs is not None else self.recording.outputs
        good = torch.isfinite(self.outputs_of(values, self.solve(values), wanted)).all(-1)
        point = values[good.nonzero()[:1, 0]].detach()
        with torch.no_grad():
            gap = self.steps.difference(point)
        if not gap <= 1e-9:
            raise SimulatorError(
                f"Expected the same rates at many times at once as at one time. Got a difference of {gap:.3g}. Write "
                "the rates elementwise: s[name] has shape (*batch, R), p[name] (*batch, 1), u[name] (R,), t is a "
                "scalar or (R,); leave sums over them, random numbers and branches on t out of it."
            )
        return total

    def at(self, x: Conditions, outputs: Sequence[str] | None = None) -> Callable[[Tensor], Tensor]:
        """Outputs as a function of parameter values, differentiable by autograd; x must be the recording's."""
        self._check_conditions(x)
        wanted = tuple(outputs) if outputs is not None else self.recording.outputs

        size = max(1, NUMBERS // self.grid.nodes.numel() // len(self._states))

        def evaluate(values: Tensor) -> Tensor:
            check_values(values, self.names)
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
        if time is None or not torch.equal(time.cpu().to(torch.float64), self.grid.sample_t):
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
        warm: Solution | None = None,
        *,
        march: bool = True,
    ) -> Linearisation:
        """Outputs and their derivatives; ``warm`` is the solution of an earlier, nearby call.

        Where Newton's method does not settle from there, the trajectory is solved step by step; without ``march`` it is
        infinite instead. The conditions must be the recording's.
        """
        self._check_conditions(x)
        wanted = tuple(outputs) if outputs is not None else self.recording.outputs
        values = values.detach()
        columns = list(range(values.shape[-1])) if columns is None else list(columns)
        found = []
        with torch.no_grad():
            if warm is not None and len(warm.states) != len(values):
                warm = None
            guess, other = (None, None) if warm is None else (warm.near(values), warm.spare)
            nodes = self.grid.nodes.numel()
            few = len(values) * nodes * len(self._states) * len(columns) <= NUMBERS
            states, tangents = self.steps.solve(values, guess, columns if few else (), other=other, march=march)
            size = max(1, POINTS // nodes)
            for k, (v, s) in enumerate(zip(values.split(size), states.split(size), strict=True)):
                slopes = tangents[k * size : (k + 1) * size] if few else self.steps.sensitivities(v, s, columns)
                found.append(self._observe(v, s, wanted, columns, slopes))
        warm = Solution(states, values, columns, tangents) if few else Solution(states)
        return Linearisation(torch.cat([y for y, _ in found]), torch.cat([j for _, j in found]), warm)

    def solve(self, values: Tensor, known: Solution | None = None) -> Tensor:
        """States at the ends of all steps, ``(H, R, K + 1, states)``; infinite where the solution blows up.

        Those that are ``known`` already, of the same values, are not solved again.
        """
        if known is not None:
            return known.states
        with torch.no_grad():
            return self.steps.solve(values.detach())[0]

    def outputs_of(self, values: Tensor, states: Tensor, outputs: Sequence[str] | None = None) -> Tensor:
        """Outputs ``(H, n_total)`` of solved states."""
        wanted = tuple(outputs) if outputs is not None else self.recording.outputs
        with torch.no_grad():
            return self._observe(values.detach(), states, wanted)[0]

    def readings(self, values: Tensor, start: Tensor) -> Tensor:
        """Recorded outputs ``(H, n_total)`` at all samples, of states ``(H, R, S)`` that stay as they begin."""
        p = self.layout.by_name(values, self.grid.run_of)
        return torch.cat(self._measure(p, start[:, self.grid.run_of].unbind(-1), self.recording.outputs), dim=-1)

    def along(self, states: Tensor) -> dict[str, Tensor]:
        """Time, states and inputs at the ends of all steps, each ``(R, K + 1)``; of one solution."""
        found = {"t": self.grid.nodes}
        found |= {name: states[0, ..., i] for i, name in enumerate(self._states)}
        found |= {name: torch.cat([table[0], table[2][:, -1:]], dim=1) for name, table in self.grid.u.items()}
        return found

    def rates_by(self, values: Tensor, states: Tensor, columns: Sequence[int]) -> Tensor:
        """Derivatives of the rates by some parameters where steps begin, ``(H, R, K, S, len(columns))``."""
        hyper, runs, _, size = states.shape
        run_of = self.grid.step_run
        t, _, u = self.grid.flat
        with torch.enable_grad():
            begin = spread(states[:, :, :-1].flatten(1, 2))
            leaves = self.layout.leaves(values, run_of, columns)
            rates = self.steps.rates_of(t, begin, leaves, {name: table[0] for name, table in u.items()})
            rows = self.layout.derivatives(rates, begin, leaves, run_of, columns)
        found = stacked([row[size:] for row in rows], begin[0])
        return found.reshape(hyper, runs, self.num_steps, size, len(columns))

    def flow(self, values: Tensor, states: Tensor) -> Tensor:
        """Derivative of the end of every step by its beginning, ``(H, R, K, S, S)``."""
        with torch.no_grad():
            return self.steps.derivatives(values, states, ())[1]

    def _observe(
        self,
        values: Tensor,
        states: Tensor,
        outputs: Sequence[str],
        columns: Sequence[int] = (),
        tangents: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Outputs ``(H, n_total)`` and their derivatives ``(H, n_total, len(columns))``."""
        seen = states[:, self.grid.run_of, self.grid.node_of]  # (H, n, S)
        if tangents is None:
            parts = self._measure(self.layout.by_name(values, self.grid.run_of), seen.unbind(-1), outputs)
            found = torch.cat(parts, dim=-1)
            return found, found.new_zeros(*found.shape, 0)
        moved = tangents[:, self.grid.run_of, self.grid.node_of]  # (H, n, S, C)
        y, by_each = self._measured_slopes(values, seen, outputs, columns)
        size = seen.shape[-1]
        jacobian = by_each[..., :size] @ moved + by_each[..., size:]  # (H, n, outputs, C)
        return y, jacobian.transpose(1, 2).flatten(1, 2)

    def observation_slopes(
        self, values: Tensor, states: Tensor, outputs: Sequence[str], columns: Sequence[int] = ()
    ) -> tuple[Tensor, Tensor]:
        """∂ output / ∂ state at every datum, ``(n_total, S)``, and by some parameters with the states as they are,
        ``(n_total, len(columns))``; one row of values."""
        seen = states[:, self.grid.run_of, self.grid.node_of]
        by_each = self._measured_slopes(values, seen, outputs, columns)[1][0].transpose(0, 1).flatten(0, 1)
        return by_each[:, : seen.shape[-1]], by_each[:, seen.shape[-1] :]

    def _measured_slopes(
        self, values: Tensor, seen: Tensor, outputs: Sequence[str], columns: Sequence[int]
    ) -> tuple[Tensor, Tensor]:
        """Outputs ``(H, n_total)`` of the states ``(H, n, S)`` at all samples, and their derivatives by states and
        columns, ``(H, n, outputs, S + C)``."""
        with torch.enable_grad():
            begin = spread(seen)
            leaves = self.layout.leaves(values, self.grid.run_of, columns)
            parts = self._measure(leaves, begin, outputs)
            rows = self.layout.derivatives(parts, begin, leaves, self.grid.run_of, columns)
        return torch.cat(parts, dim=-1).detach(), stacked(rows, begin[0])

    def slopes(self, values: Tensor, start: Tensor) -> Tensor:
        """Rates of all states at the beginning of every run, ``(H, R, states)``, at states ``(H, R, states)``."""
        u = {name: table[0, :, 0] for name, table in self.grid.u.items()}
        return self.steps.rates(self.grid.t[:, 0], start, self.layout.by_name(values), u)

    def begins(self, values: Tensor) -> Tensor:
        """Whether rates are finite where runs begin, ``(H, R, states)``: in the middle of the first step at least, for
        a ratio may have a limit at the beginning itself. Else no steps get through."""
        with torch.no_grad():
            start, p = self.layout.start(values), self.layout.by_name(values)
            found = torch.zeros_like(start, dtype=torch.bool)
            for place, share in ((0, 0.0), (1, 0.5)):
                u = {name: table[place, :, 0] for name, table in self.grid.u.items()}
                rates = self.steps.rates(self.grid.t[:, 0] + share * self.grid.h[:, 0], start, p, u)
                found |= torch.isfinite(rates)
        return found

    def _check_rates(self, values: Tensor) -> None:
        good = self.begins(values)
        if bool(good.flatten(1).all(-1).any()):
            return
        r, i = (~good[0]).nonzero()[0].tolist()
        with torch.no_grad():
            start = self.layout.start(values)
            rate = float(self.slopes(values, start)[0, r, i])
        states = {name: float(value) for name, value in zip(self._states, start[0, r], strict=True)}
        point = {name: float(value) for name, value in zip(self.names, values[0], strict=True)}
        where = f" of run {r}" if len(self.runs) > 1 else ""
        raise SimulatorError(
            f"Expected finite rates where runs begin. Got {rate} for the rate of {self._states[i]!r} at "
            f"t={float(self.grid.t[r, 0]):g}{where}, with states {states} and parameters {point}, and none of "
            f"{len(values)} parameter values gave finite ones. Check rates(t, s, p, u) there, and the runs' initial "
            "values, or narrow the parameters' bounds or give initial=."
        )

    def _measure(self, p: dict[str, Tensor], seen: Sequence[Tensor], outputs: Sequence[str]) -> list[Tensor]:
        """Each of some outputs ``(H, n)`` of the states ``(H, n)`` at all samples."""
        s = dict(zip(self._states, seen, strict=True))
        parts = []
        for name in outputs:
            try:
                value = careful(
                    self.ode.seen,
                    f"the function of the output {name!r}",
                    self.ode.observe[name],
                    t=self.grid.sample_t,
                    s=s,
                    p=p.copy(),
                    u=self.grid.sample_u,
                )
            except SimulatorError:
                raise
            except Exception as error:
                raise SimulatorError(
                    f"Expected the output {name!r} as a tensor. Its function raised {raised(error)}."
                    f"{unknown_name(error, s, p, self.grid.sample_u)}"
                ) from error
            parts.append(real(value, seen[0], seen[0].shape, f"the output {name!r}"))
        return parts


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
