"""Implicit Runge–Kutta steps, for states that follow others far faster than anything else happens."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from torchcal.simulators.layout import Values, stacked
from torchcal.simulators.shooting import Pass
from torchcal.simulators.steps import SPAN, Steps, inputs_between

__all__ = ["ImplicitSteps"]

_ROOT = math.sqrt(6.0)
#: Radau IIA of three stages (Hairer & Wanner, Solving Ordinary Differential Equations II, table IV.5.6): of order 5,
#: and what decays within a fraction of a step is gone after it.
NODES = ((4 - _ROOT) / 10, (4 + _ROOT) / 10, 1.0)
WEIGHTS = (
    ((88 - 7 * _ROOT) / 360, (296 - 169 * _ROOT) / 1800, (-2 + 3 * _ROOT) / 225),
    ((296 + 169 * _ROOT) / 1800, (88 + 7 * _ROOT) / 360, (-2 - 3 * _ROOT) / 225),
    ((16 - _ROOT) / 36, (16 + _ROOT) / 36, 1 / 9),
)
STAGES = len(NODES)
#: Newton passes for the stages; corrections, relative to the state, after which the next would be rounding, and up to
#: which a state is one where rounding keeps them from becoming smaller.
PASSES, SMALL, ROUNDED = 12, 1e-7, 1e-5
#: Slopes, at the beginning of a step of length 1, of the polynomials that are 1 at one stage and 0 there and at the
#: others.
BEGUN = ((13 + 7 * _ROOT) / 3, (13 - 7 * _ROOT) / 3, 1 / 3)
#: Share of a step's way by which its beginning and its stages may disagree until it is solved again, with how many
#: halvings at most; by which it then ends elsewhere; and the share of all steps up to which such are looked at.
ASTRAY, HALVINGS, ELSEWHERE, FEW = 0.5, 3, 0.1, 1 / 8
#: Share of a state's largest value below which it counts as that large; and of the terms that a gap is the difference
#: of up to which it is rounding, whatever the states at rest are that it would correct.
SMALLEST, ROUNDING = 1e-9, 1e-13
#: What a state does to another one's equation within a step, above which that may be its pivot.
PIVOT = 0.1


class ImplicitSteps(Steps):
    r"""Steps of the Radau IIA method of order 5.

    The stages :math:`Y_i = s + h \sum_j a_{ij} f(t + c_j h, Y_j)` of all points are solved together by Newton's method;
    a point where it does not settle ends at NaN. Derivatives are those of the solved stages, by the implicit function
    theorem: :math:`(1 - h A \otimes J)\, dY = ds + h A\, f_p\, dp`. Where the states are guessed, these and the stages
    take the same passes (a lifted Newton method: Albersmeyer & Diehl 2010, SIAM J. Optim. 20, 1655).
    """

    order = 6
    solved_for = True

    def step(
        self, s: Tensor, t: Tensor, h: Tensor, p: Values, u: dict[str, Tensor], halvings: int = HALVINGS
    ) -> Tensor:
        """As `Steps.step`. One that may not go on from where it begins is solved again, towards where two of half its
        length end, and these the same so often at most."""
        stages = self._stages(s, t, h, p, u)
        if halvings and len(at := self._doubtful(s, stages, t, h, p, u, most=len(t))[0]):
            s, t, half, p = s[:, at], t[at], 0.5 * h[at], _tiled(p, at, 1)
            first, middle, last = ({name: table[i, at] for name, table in u.items()} for i in range(3))
            between = self.step(s, t, half, p, inputs_between(first, middle), halvings - 1)
            end = self.step(between, t + half, half, p, inputs_between(middle, last), halvings - 1)
            found = self._stages(s, t, 2 * half, p, {name: table[:, at] for name, table in u.items()}, end)
            stages[:, :, at] = torch.where(found.isfinite().all(1, keepdim=True), found, stages[:, :, at])
        return stages[:, -1]

    def difference(self, values: Tensor) -> float:
        """As `Steps.difference`, of the rates: equations of stages may have several solutions."""
        part = replace(self, grid=self.grid.part(0, SPAN))
        states = part._one_by_one(values, self.layout.start(values))[:, :, :-1]
        grid, p = part.grid, self.layout.by_name(values)
        once = []
        for k in range(grid.num_steps):
            u = {name: table[0, :, k] for name, table in grid.u.items()}
            once.append(self.rates(grid.t[:, k], states[:, :, k], p, u))
        t, _, u = grid.flat
        spread = self.layout.by_name(values, grid.step_run)
        rates = self.rates(t, _points(states), spread, {name: table[0] for name, table in u.items()})
        gap = (torch.stack(once, dim=2) - rates.reshape(states.shape)).abs()
        size = rates.abs().amax(dim=(0, 1)).clamp_min(1e-300)
        return float((gap / size).max())

    def stages(self, states: Tensor) -> Tensor:
        """As `Steps.stages`: the stages, on lines from state to state."""
        begin, guess = _points(states[:, :, :-1]), _points(states[:, :, 1:])
        return _towards(begin, guess)

    def solved(self, values: Tensor, states: Tensor, stages: Tensor) -> Tensor:
        """As `Steps.solved`."""
        t, h, u = self.grid.flat
        begin, guess = _points(states[:, :, :-1]), _points(states[:, :, 1:])
        found = self._stages(begin, t, h, self.layout.by_name(values, self.grid.step_run), u, guess)
        return torch.where(found.isfinite().all(1, keepdim=True).all(-1, keepdim=True), found, stages)

    def linearised(self, values: Tensor, states: Tensor, columns: Sequence[int], stages: Tensor) -> Pass:
        """As `Steps.linearised`: a Newton pass for the stages, with what changes of states and parameters add to it."""
        hyper, runs, _, size = states.shape
        begin = _points(states[:, :, :-1])
        f, slopes, pushes = self._at_stages(values, stages, columns)
        h = self.grid.flat[1]
        lu, pivots, _ = torch.linalg.lu_factor_ex(_matrix(slopes, h))
        gap = _gap(begin, stages, f, h)
        still = torch.eye(size, dtype=begin.dtype).expand(hyper, STAGES, begin.shape[1], size, size)
        right = torch.cat([gap.unsqueeze(-1), still, _pushed(pushes, h)], dim=-1).transpose(1, 2).flatten(2, 3)
        found = torch.linalg.lu_solve(lu, pivots, right).unflatten(2, (STAGES, size)).transpose(1, 2)
        change, carried = found[..., 0], found[..., 1 : 1 + size]
        stages, off = _moved(_largest(begin), stages, change, gap, slopes, h)
        shape = (hyper, runs, self.grid.num_steps, size)
        by_begin, by_column = found[:, -1, ..., 1 : 1 + size], found[:, -1, ..., 1 + size :]
        return Pass(
            stages[:, -1].reshape(shape),
            by_begin.reshape(*shape, size),
            by_column.reshape(*shape, len(columns)),
            stages,
            carried,
            off.amax(-1),
            (lu, pivots, slopes),
        )

    def corrected(self, values: Tensor, states: Tensor, stages: Tensor, here: Pass) -> tuple[Tensor, Tensor, Tensor]:
        """As `Steps.corrected`."""
        begin = _points(states[:, :, :-1])
        (t, u), h = self.stage_inputs, self.grid.flat[1]
        lu, pivots, slopes = here.factors
        p = _tiled(self.layout.by_name(values, self.grid.step_run), torch.arange(len(h)))
        f = self.rates(t, stages.flatten(1, 2), p, u).unflatten(1, (STAGES, -1))
        gap = _gap(begin, stages, f, h)
        right = gap.transpose(1, 2).flatten(2, 3).unsqueeze(-1)
        change = torch.linalg.lu_solve(lu, pivots, right).squeeze(-1).unflatten(2, (STAGES, -1)).transpose(1, 2)
        stages, off = _moved(_largest(begin), stages, change, gap, slopes, h)
        return stages[:, -1].reshape(states[:, :, 1:].shape), stages, off.amax(-1)

    def astray(self, values: Tensor, states: Tensor, stages: Tensor) -> Tensor:
        """As `Steps.astray`: equations of stages may have another solution, as past a pole of the rates."""
        begin = _points(states[:, :, :-1])
        t, h, u = self.grid.flat
        p = self.layout.by_name(values, self.grid.step_run)
        at, way = self._doubtful(begin, stages, t, h, p, u, most=int(FEW * len(t)))
        if not len(at):
            return torch.zeros(len(values), dtype=torch.bool)
        some = {name: table[:, at] for name, table in u.items()}
        again = self.step(begin[:, at], t[at], h[at], _tiled(p, at, 1), some, 1)
        return ((again - stages[:, -1, at]).abs() > ELSEWHERE * way[:, at]).any(-1).any(-1)  # not where it is NaN

    def _doubtful(
        self, s: Tensor, stages: Tensor, t: Tensor, h: Tensor, p: Values, u: dict[str, Tensor], *, most: int
    ) -> tuple[Tensor, Tensor]:
        """Which steps may not go on from where they begin, and how far all of them come at most, ``(H, M, S)``.

        The rate where such a step begins, which has no part in its equations, is not the slope that its stages begin
        with, and that is not for what fades at once, by the slopes of the rates there. Where it is so for more than
        ``most`` of them none is: all is fast there.
        """
        moved = stages - s.unsqueeze(1)
        way = torch.maximum(moved.abs().amax(1), SMALL * _largest(s))
        first = {name: table[0] for name, table in u.items()}
        weights = torch.tensor(BEGUN, dtype=s.dtype)
        off = torch.einsum("i,hims->hms", weights, moved) - h[:, None] * self.rates(t, s, p, first)
        at = (off.abs() > ASTRAY * way).any(-1).any(0).nonzero()[:, 0]
        if len(at) > most:
            at = at[:0]
        elif len(at):
            rates, slopes = self.sloped(t[at], s[:, at], _tiled(p, at, 1), {n: v[at] for n, v in first.items()})
            push = torch.tensor(NODES, dtype=s.dtype)[:, None] * (h[at, None] * rates).unsqueeze(2)
            matrix = _matrix(slopes.unsqueeze(1).expand(-1, STAGES, -1, -1, -1), h[at])
            line = torch.linalg.solve_ex(matrix, push.flatten(2).unsqueeze(-1))[0].squeeze(-1)
            bent = moved[:, :, at] - line.unflatten(2, (STAGES, -1)).transpose(1, 2)
            off = torch.einsum("i,hims->hms", weights, bent)
            at = at[(off.abs() > ASTRAY * way[:, at]).any(-1).any(0)]
        return at, way

    def derivatives(self, values: Tensor, states: Tensor, columns: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """As `Steps.derivatives`."""
        hyper, runs, _, size = states.shape
        ends, flow, forcing = self._slopes(values, states, columns)
        shape = (hyper, runs, self.grid.num_steps, size)
        return ends.reshape(shape), flow.reshape(*shape, size), forcing.reshape(*shape, len(columns))

    def kicks(self, values: Tensor, states: Tensor) -> Tensor:
        """As `Steps.kicks`."""
        hyper, runs, _, size = states.shape
        by_force = self._slopes(values, states, (), forced=True)[2]
        return by_force.reshape(hyper, runs, self.grid.num_steps, size, size)

    def _slopes(
        self, values: Tensor, states: Tensor, columns: Sequence[int], *, forced: bool = False
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Ends ``(H, M, S)`` of all steps and their derivatives by the states and by parameters, or by forces."""
        size = states.shape[-1]
        t, h, u = self.grid.flat
        begin, guess = _points(states[:, :, :-1]), _points(states[:, :, 1:])
        stages = self._stages(begin, t, h, self.layout.by_name(values, self.grid.step_run), u, guess)  # (H, 3, M, S)
        _, slopes, pushes = self._at_stages(values, stages, columns)
        still = torch.eye(size, dtype=begin.dtype).expand(*begin.shape, size)
        if forced:
            push = torch.stack([c * h[:, None, None] * still for c in NODES], dim=1)
        else:
            push = _pushed(pushes, h)
        right = torch.cat([still.unsqueeze(1).expand(-1, STAGES, -1, -1, -1), push], dim=-1)
        found = torch.linalg.solve_ex(_matrix(slopes, h), right.transpose(1, 2).flatten(2, 3))[0][:, :, -size:]
        return stages[:, -1], found[..., :size], found[..., size:]

    def _at_stages(self, values: Tensor, stages: Tensor, columns: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Rates ``(H, 3, M, S)`` at stages of all steps, and their derivatives by state and by some parameters."""
        size = stages.shape[-1]
        rates, slopes = self.at_stages(values, stages.permute(3, 0, 1, 2).contiguous(), columns)
        found = stacked(slopes, rates[0])
        return torch.stack(rates, dim=-1), found[..., :size], found[..., size:]

    @cached_property
    def stage_inputs(self) -> tuple[Tensor, dict[str, Tensor]]:
        """As `Steps.stage_inputs`."""
        t, h, u = self.grid.flat
        return _times(t, h), _inputs(u)

    def _stages(
        self, s: Tensor, t: Tensor, h: Tensor, p: Values, u: dict[str, Tensor], guess: Tensor | None = None
    ) -> Tensor:
        """States ``(H, 3, M, S)`` at the stages of steps from ``s`` (H, M, S), begun towards guessed ends."""
        size = s.shape[-1]
        largest = _largest(s)
        stages = _towards(s, s if guess is None else guess)
        share = s.new_full(s.shape[:2], math.inf)
        at = torch.arange(s.shape[1])  # the points that are not settled, in one row at least
        for _ in range(PASSES):
            now, step = stages[:, :, at], h[at]
            inputs = _inputs({name: table[:, at] for name, table in u.items()})
            found = self.sloped(_times(t[at], step), now.flatten(1, 2), _tiled(p, at), inputs)
            f, slopes = (part.unflatten(1, (STAGES, -1)) for part in found)
            gap = _gap(s[:, at], now, f, step)
            right = gap.transpose(1, 2).flatten(2, 3).unsqueeze(-1)
            change = torch.linalg.solve_ex(_matrix(slopes, step), right)[0]
            change = change.squeeze(-1).unflatten(2, (STAGES, size)).transpose(1, 2)
            stages[:, :, at], now_share = _moved(largest, now, change, gap, slopes, step)
            settled = (now_share < SMALL) | ((now_share < ROUNDED) & (now_share > 0.5 * share[:, at]))
            share[:, at] = now_share
            at = at[(~settled & now_share.isfinite()).any(0)]
            if not len(at):
                break
        return stages.masked_fill(~(share < ROUNDED)[:, None, :, None], math.nan)


def _largest(s: Tensor) -> Tensor:
    """Largest values of states ``(H, M, S)`` at any point, ``(H, 1, S)``."""
    return s.abs().nan_to_num(nan=0.0, posinf=0.0).amax(1, keepdim=True)


def _towards(s: Tensor, ends: Tensor) -> Tensor:
    """Stages ``(H, 3, M, S)`` on lines from states ``(H, M, S)`` to others."""
    c = torch.tensor(NODES, dtype=s.dtype)[:, None, None]
    return s.unsqueeze(1) + c * (ends - s).unsqueeze(1)


def _gap(s: Tensor, stages: Tensor, rates: Tensor, h: Tensor) -> Tensor:
    """By how much stages ``(H, 3, M, S)`` of steps from ``s`` differ from what their rates make of them."""
    a = torch.tensor(WEIGHTS, dtype=s.dtype)
    return h[:, None] * torch.einsum("ij,hjms->hims", a, rates) - (stages - s.unsqueeze(1))


def _pushed(pushes: Tensor, h: Tensor) -> Tensor:
    """What derivatives of the rates at the stages ``(H, 3, M, S, C)`` come to in the equations of these."""
    a = torch.tensor(WEIGHTS, dtype=pushes.dtype)
    return torch.einsum("ij,hjmsc->himsc", a, pushes) * h[:, None, None]


def _moved(
    largest: Tensor, stages: Tensor, change: Tensor, gap: Tensor, slopes: Tensor, h: Tensor
) -> tuple[Tensor, Tensor]:
    """Corrected stages, and the largest correction of those of a step relative to these, ``(H, M)``; 0 where the gap is
    rounding.

    Where another state's equation is a state's pivot, what is rounding of that equation's terms becomes a correction of
    this state, however small it is: it may be 0 at all times, as what a term adds that is switched off. That is none.
    """
    after = stages + change
    near, moved = after.abs(), change.abs().amax(1)
    reach = h[:, None, None] * slopes.abs()
    terms = near + torch.einsum("himab,himb->hima", reach, near)
    by_pivot = torch.where(reach > PIVOT, terms.unsqueeze(-1) / reach, torch.zeros_like(reach))
    by_pivot.diagonal(dim1=-2, dim2=-1).zero_()
    none = moved <= ROUNDING * by_pivot.amax((1, 3))
    size = torch.maximum(near.amax(1), SMALLEST * largest).clamp_min(1e-300)
    share = (moved / size).masked_fill(none, 0.0).amax(-1)
    share[(gap.abs() <= ROUNDING * terms).all(-1).all(1)] = 0.0
    return torch.where(none.unsqueeze(1), stages, after), share


def _matrix(slopes: Tensor, h: Tensor) -> Tensor:
    """1 − h A ⊗ J of every step, ``(H, M, 3 S, 3 S)``, of slopes ``(H, 3, M, S, S)``."""
    a = torch.tensor(WEIGHTS, dtype=slopes.dtype)
    size = slopes.shape[-1]
    coupled = torch.einsum("ij,hjmab->hmiajb", a, slopes * h[:, None, None])
    return torch.eye(STAGES * size, dtype=slopes.dtype) - coupled.flatten(4, 5).flatten(2, 3)


def _points(states: Tensor) -> Tensor:
    """States ``(H, R, K, S)`` as points ``(H, R K, S)``."""
    return states.flatten(1, 2)


def _times(t: Tensor, h: Tensor) -> Tensor:
    """Of all stages, ``(3 M,)``."""
    return torch.cat([t + c * h for c in NODES])


def _inputs(u: dict[str, Tensor]) -> dict[str, Tensor]:
    """Inputs at all stages ``(3 M,)`` of those at begin, middle and end ``(3, M)``, by the parabola through them."""
    return {
        name: torch.cat(
            [(1 - c) * (1 - 2 * c) * first + 4 * c * (1 - c) * middle + c * (2 * c - 1) * last for c in NODES]
        )
        for name, (first, middle, last) in u.items()
    }


def _tiled(p: Values, at: Tensor, stages: int = STAGES) -> Values:
    """Parameters of points as those of the stages of some of them."""
    start = p.start[at].repeat(stages) if isinstance(p.start, Tensor) else p.start
    tiled = {name: v[..., at].repeat(1, stages) if v.shape[-1] > 1 else v for name, v in p.items()}
    return Values(tiled, p.first, start)
