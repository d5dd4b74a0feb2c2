"""Runge–Kutta steps on a grid of times, and the trajectories that they make up.

All steps of a span are taken at once from a guessed trajectory (`close_gaps`). What that does not reach is solved step
by step.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchcal.display import raised
from torchcal.errors import SimulatorError, TorchcalError
from torchcal.simulators.careful import careful, real, unknown_name
from torchcal.simulators.grid import Grid
from torchcal.simulators.layout import Layout, Values, spread, stacked
from torchcal.simulators.parameter import spans
from torchcal.simulators.recurrence import recur
from torchcal.simulators.shooting import Pass, begun, close_gaps
from torchcal.simulators.static import asks_for_numbers

if TYPE_CHECKING:
    from torchcal.simulators.ode import ODESimulator

__all__ = ["POINTS", "SPAN", "Steps", "inputs_between"]

#: Points whose derivatives are computed at once: about what a processor's cache holds.
POINTS = 2**15
#: Where the stages of a step lie, as shares of it, each by the rates at the one before; which of the inputs at its
#: beginning, middle and end act there; and what their rates weigh.
SHARES, INPUTS, WEIGHTS = (0.0, 0.5, 0.5, 1.0), (0, 1, 1, 2), (1 / 6, 1 / 3, 1 / 3, 1 / 6)
#: Steps of the first span that is tried where there is no guess.
SPAN = 64
#: Trajectories times the derivatives that a pass needs of each, above which a step costs less than its share of passes.
CROWD = 100


@dataclass(frozen=True, eq=False)
class Steps:
    """The steps of a grid.

    Attributes:
        ode: Has the rates.
        layout: What each parameter value is.
        grid: Where steps begin and how long they are.
        order: The error of a step falls with its length to this power.
    """

    order = 5
    solved_for = False  # whether there is more to solve for than the states

    ode: "ODESimulator"
    layout: Layout
    grid: Grid

    def rates(self, t: Tensor, s: Tensor, p: dict[str, Tensor], u: dict[str, Tensor]) -> Tensor:
        """Rates ``(H, M, states)`` at states ``(H, M, states)``."""
        return torch.stack(self.rates_of(t, s.unbind(-1), p, u), dim=-1)

    def rates_of(
        self, t: Tensor, s: Sequence[Tensor], p: dict[str, Tensor], u: dict[str, Tensor]
    ) -> list[Tensor]:
        """The same of each state by itself, ``(H, M)``."""
        names = tuple(self.ode.states)
        named = dict(zip(names, s, strict=True))
        shape = s[0].shape  # (batch, runs)
        try:
            rates = careful(self.ode.seen, "rates(t, s, p, u)", self.ode.rates, t=t, s=named, p=p.copy(), u=u)
        except TorchcalError:  # a term's, which says what to do
            raise
        except Exception as error:
            raise SimulatorError(
                f"Expected rates(t, s, p, u) to return the rates by state. It raised {raised(error)}. "
                f"It was called with states of shape {tuple(shape)} ({spans(named)}) and parameters "
                f"of shape {tuple(next(iter(p.values())).shape)} ({spans(p)}).{_advice(error, named, p, u)}"
            ) from error
        if not isinstance(rates, Mapping) or set(rates) != set(names):
            got = list(rates) if isinstance(rates, Mapping) else type(rates).__name__
            raise SimulatorError(f"Expected the rates of {list(names)} as a dict. Got {got}.")
        return [real(rates[name], s[0], shape, f"the rate of {name!r}") for name in names]

    def step(self, s: Tensor, t: Tensor, h: Tensor, p: Values, u: dict[str, Tensor]) -> Tensor:
        """One Runge–Kutta step of every point ``(H, M, states)``; t, h ``(M,)``, u ``(3, M)``."""
        first, middle, last = ({name: table[i] for name, table in u.items()} for i in range(3))
        half, full = (0.5 * h)[:, None], h[:, None]
        k1 = self.rates(t, s, p, first)
        k2 = self.rates(t + 0.5 * h, s + half * k1, p, middle)
        k3 = self.rates(t + 0.5 * h, s + half * k2, p, middle)
        k4 = self.rates(t + h, s + full * k3, p, last)
        return s + (full / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)

    def stages(self, states: Tensor) -> Tensor:
        """What else there is to solve for along guessed states ``(H, R, K + 1, S)``, as of `Pass`."""
        hyper, runs, nodes, size = states.shape
        return states.new_zeros(hyper, 0, runs * (nodes - 1), size)

    def solved(self, values: Tensor, states: Tensor, stages: Tensor) -> Tensor:
        """The stages at some states, where they can be found; as they are elsewhere."""
        return stages

    def linearised(self, values: Tensor, states: Tensor, columns: Sequence[int], stages: Tensor) -> Pass:
        """All steps begun at ``states``, their derivatives by these and by some parameters, and corrected stages."""
        ends, flow, forcing = self.derivatives(values, states, columns)
        carried = stages.unsqueeze(-1).expand(*stages.shape, stages.shape[-1])
        return Pass(ends, flow, forcing, stages, carried, values.new_zeros(len(values)))

    def corrected(self, values: Tensor, states: Tensor, stages: Tensor, here: Pass) -> tuple[Tensor, Tensor, Tensor]:
        """Ends ``(H, R, K, S)`` of all steps begun at ``states``, corrected stages, and by how much, relative to these.

        The derivatives are those of an earlier pass.
        """
        hyper, runs, _, size = states.shape
        t, h, u = self.grid.flat
        begin = states[:, :, :-1].reshape(hyper, -1, size)
        found = self.step(begin, t, h, self.layout.by_name(values, self.grid.step_run), u)
        return found.reshape(hyper, runs, -1, size), stages, values.new_zeros(hyper)

    def astray(self, values: Tensor, states: Tensor, stages: Tensor) -> Tensor:
        """Where a step solves its equations but does not go on from where it begins, ``(H,)``."""
        return torch.zeros(len(values), dtype=torch.bool)

    def derivatives(self, values: Tensor, states: Tensor, columns: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Ends of all steps begun at ``states``, and their derivatives by the states and by some parameters.

        Returns ends ``(H, R, K, S)``, flow ``(H, R, K, S, S)`` and forcing ``(H, R, K, S, len(columns))``.
        """
        hyper, runs, _, size = states.shape
        h = self.grid.flat[1]
        stages = self._staged(values, states)
        rates, slopes = self.at_stages(values, stages, columns)
        weights = h * torch.tensor(WEIGHTS, dtype=h.dtype)[:, None]
        ends = stages[:, :, 0] + (torch.stack(rates) * weights).sum(2)
        # What a change of each state or parameter makes of a stage, by way of the one before.
        before = h.new_zeros(size, size + len(columns), hyper, len(h))
        moved = torch.zeros_like(before)
        for k, (share, weight) in enumerate(zip(SHARES, WEIGHTS, strict=True)):
            now = torch.zeros_like(moved)
            for i, row in enumerate(slopes):
                for j, slope in enumerate(row):
                    if slope is None:
                        continue
                    own = h * slope[:, k]
                    now[i, j] += own
                    if share and j < size:
                        now[i].addcmul_(own, before[j], value=share)
            moved.add_(now, alpha=weight)
            before = now
        moved.diagonal().add_(1.0)
        shape = (hyper, runs, self.grid.num_steps, size)
        moved = moved.permute(2, 3, 0, 1).reshape(*shape, -1)
        return ends.permute(1, 2, 0).reshape(shape), moved[..., :size], moved[..., size:]

    def _staged(self, values: Tensor, states: Tensor) -> Tensor:
        """Where a step from each state looks at its rates, ``(S, H, 4, M)``."""
        t, h, u = self.grid.flat
        p = self.layout.by_name(values, self.grid.step_run)
        begin = states[:, :, :-1].flatten(1, 2).movedim(-1, 0).contiguous()
        stages = [begin]
        for k, share in enumerate(SHARES[1:]):
            now = {name: table[INPUTS[k]] for name, table in u.items()}
            rates = self.rates_of(t + SHARES[k] * h, stages[-1].unbind(0), p, now)
            stages.append(begin + share * h * torch.stack(rates))
        return torch.stack(stages, dim=2)

    def at_stages(
        self, values: Tensor, stages: Tensor, columns: Sequence[int]
    ) -> tuple[list[Tensor], list[list[Tensor | None]]]:
        """Rates at the stages ``(S, H, N, M)`` of all steps, each ``(H, N, M)``, and their derivatives by every state
        and by some parameters, as of `Layout.derivatives`."""
        shape = stages.shape[2:]
        every = self.grid.step_run.repeat(shape[0])
        t, u = self.stage_inputs
        with torch.enable_grad():
            begin = [one.flatten(1).requires_grad_(True) for one in stages.detach().unbind(0)]
            leaves = self.layout.leaves(values, every, columns)
            rates = self.rates_of(t, begin, leaves, u)
            slopes = self.layout.derivatives(rates, begin, leaves, every, columns)
        found = [[None if one is None else one.unflatten(1, shape) for one in row] for row in slopes]
        return [one.detach().unflatten(1, shape) for one in rates], found

    @cached_property
    def stage_inputs(self) -> tuple[Tensor, dict[str, Tensor]]:
        """Times ``(N M,)`` of all stages of all steps, and inputs there."""
        t, h, u = self.grid.flat
        times = torch.cat([t + share * h for share in SHARES])
        return times, {name: torch.cat([table[place] for place in INPUTS]) for name, table in u.items()}

    def kicks(self, values: Tensor, states: Tensor) -> Tensor:
        """What a force of 1 in each equation, throughout a step, does to the end of the step, ``(H, R, K, S, S)``."""
        size = states.shape[-1]
        return torch.diag_embed(self.grid.h[..., None].expand(len(states), *self.grid.h.shape, size))

    def slopes_at(self, values: Tensor, states: Tensor, t: Tensor, u: dict[str, Tensor]) -> Tensor:
        """∂ rates / ∂ states ``(H, M, S, S)`` at one state for each step, ``(H, R, K, S)``; t, u ``(M,)``."""
        return self.sloped(t, states.flatten(1, 2), self.layout.by_name(values, self.grid.step_run), u)[1]

    def sloped(self, t: Tensor, s: Tensor, p: dict[str, Tensor], u: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Rates ``(H, M, S)`` at states ``(H, M, S)`` and their derivatives by these, ``(H, M, S, S)``."""
        with torch.enable_grad():
            begin = spread(s)
            rates = self.rates_of(t, begin, p, u)
            slopes = self.layout.derivatives(rates, begin, {}, t, ())
        return torch.stack(rates, dim=-1).detach(), stacked(slopes, begin[0])

    def difference(self, values: Tensor) -> float:
        """Largest difference between the first steps taken one after another and all at once, relative to the states'.

        Anything but rounding means that rates are not computed elementwise.
        """
        part = replace(self, grid=self.grid.part(0, SPAN))
        states = part._one_by_one(values, self.layout.start(values))
        ends = part.derivatives(values, states, ())[0]
        size = states.abs().amax(dim=(0, 1, 2)).clamp_min(1e-300)
        return float(((ends - states[:, :, 1:]).abs() / size).max())

    def solve(
        self,
        values: Tensor,
        guess: Tensor | None = None,
        columns: Sequence[int] = (),
        *,
        other: Tensor | None = None,
        march: bool = True,
    ) -> tuple[Tensor, Tensor]:
        """States at the ends of all steps and their derivatives by some parameters.

        Where Newton's method does not settle from the guess, the trajectory is solved from its beginning; without
        ``march`` it is infinite instead. Where it settles, its last pass gives the derivatives too, at states that are
        nearly the solved ones.

        Args:
            values: Parameter values, ``(H, P)``.
            guess: Of the states.
            columns: Places of the parameters to derive by.
            other: Another guess, for where that leads nowhere.
            march: Whether to solve from the beginning at all.

        Returns:
            States ``(H, R, K + 1, S)``, infinite from where one of a run's blows up, and derivatives
            ``(H, R, K + 1, S, len(columns))``.
        """
        size = max(1, POINTS // self.grid.nodes.numel())
        if guess is None or guess.shape[0] != values.shape[0]:
            states = self._march(values)
            pieces = zip(values.split(size), states.split(size), strict=True)
            return states, torch.cat([self.sensitivities(v, s, columns) for v, s in pieces])
        begin = torch.cat([self.layout.start(values).unsqueeze(2), guess[:, :, 1:]], dim=2)
        pieces = zip(values.split(size), begin.split(size), strict=True)
        found = [close_gaps(self, v, s, columns, patient=other is None) for v, s in pieces]
        states, settled, tangents, _ = (torch.cat(parts) for parts in zip(*found, strict=True))
        if other is not None and not bool(settled.all()):
            left = ~settled
            states[left], tangents[left] = self.solve(values[left], other[left], columns, march=march)
        elif not march:
            states[~settled] = math.inf
        elif not bool(settled.all()):
            states[~settled], tangents[~settled] = self.solve(values[~settled], None, columns)
        return states, tangents

    def sensitivities(self, values: Tensor, states: Tensor, columns: Sequence[int]) -> Tensor:
        """∂ states / ∂ parameters of solved states, ``(H, R, K + 1, S, len(columns))``."""
        if not columns:
            return states.new_zeros(*states.shape, 0)
        _, flow, forcing = self.derivatives(values, states, columns)
        begin = self.first_slopes(values, columns)
        return torch.cat([begin.unsqueeze(2), recur(flow, begun(flow, forcing, begin))], dim=2)

    def first_slopes(self, values: Tensor, columns: Sequence[int]) -> Tensor:
        """Derivatives of the first states by some parameters, ``(H, R, S, len(columns))``."""
        if not columns:
            return values.new_zeros(len(values), self.grid.h.shape[0], len(self.ode.states), 0)
        return self.layout.start_slopes(values)[..., list(columns)]

    def _march(self, values: Tensor) -> Tensor:
        """From the beginning, span by span, in spans as long as Newton's method allows from states that stand still."""
        start = self.layout.start(values)
        hyper, runs, size = start.shape
        if hyper * runs * (1 + size) > CROWD:
            return _ended(self._one_by_one(values, start))
        dead = ~torch.isfinite(start).all(-1, keepdim=True)
        parts, begin, largest = [start.unsqueeze(2)], start, start.abs().amax(dim=1)[:, None, None]
        longest = most = max(SPAN, POINTS // max(1, hyper * runs))
        first, span, on_foot = 0, SPAN, SPAN // 2
        while first < self.grid.num_steps:
            part = replace(self, grid=self.grid.part(first, first + span))
            still = begin.unsqueeze(2).expand(-1, -1, part.grid.num_steps + 1, -1)
            states, settled, *_ = close_gaps(part, values, still, largest=largest)
            if bool(settled.all()):
                longest = min(longest + longest // 8, most)  # what has failed is tried again after a while
                span, on_foot = min(2 * span, longest), SPAN // 2
            elif span > SPAN:
                span = longest = span // 2
                continue
            else:
                on_foot = min(2 * on_foot, most)  # the longer Newton's method fails, the more rarely it is tried
                part = replace(self, grid=self.grid.part(first, first + on_foot))
                states = part._one_by_one(values, begin)
            first += part.grid.num_steps
            states = _ended(states.masked_fill(dead.unsqueeze(2), math.inf))
            parts.append(states[:, :, 1:])
            dead = torch.isinf(states[:, :, -1, :1])
            begin = torch.where(dead, start, states[:, :, -1])  # what has blown up goes on, unseen
            seen = states.masked_fill(torch.isinf(states), 0.0)
            largest = torch.maximum(largest, seen.abs().amax(dim=(1, 2), keepdim=True))
        return torch.cat(parts, dim=2)

    def _one_by_one(self, values: Tensor, begin: Tensor) -> Tensor:
        """Step after step, from states ``(H, R, S)``."""
        p = self.layout.by_name(values)
        found = [begin]
        for k in range(self.grid.num_steps):
            u = {name: table[:, :, k] for name, table in self.grid.u.items()}
            found.append(self.step(found[-1], self.grid.t[:, k], self.grid.h[:, k], p, u))
        return torch.stack(found, dim=-2)


def inputs_between(first: dict[str, Tensor], last: dict[str, Tensor]) -> dict[str, Tensor]:
    """Inputs at the beginning, middle and end of a step ``(3, M)``, on lines between two of these."""
    return {name: torch.stack([a, 0.5 * (a + last[name]), last[name]]) for name, a in first.items()}


def _advice(error: Exception, s: Mapping[str, Any], p: Mapping[str, Any], u: Mapping[str, Any]) -> str:
    """What a name that a model asks for in vain is none of, or what to use on tensors, in a sentence; empty for other
    errors."""
    if asks_for_numbers(error):
        return (
            " Use torch functions on t, s, p and u, and torch.where for if: values of many points come at once, with "
            "gradients."
        )
    return unknown_name(error, s, p, u)


def _ended(states: Tensor) -> Tensor:
    """Trajectories ``(H, R, K + 1, S)``, in which a run is infinite from its first state on that is not finite."""
    alive = torch.isfinite(states).all(-1).cumprod(-1).bool()
    return states.masked_fill(~alive.unsqueeze(-1), math.inf)
