"""Multiple shooting: Newton's method closes the gaps between steps that were all taken at once from guessed states."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchcal.simulators.recurrence import recur

if TYPE_CHECKING:
    from torchcal.simulators.steps import Steps

__all__ = ["Closed", "Pass", "begun", "close_gaps"]

#: Corrections, relative to the state where they are made, after which nothing is left to check: the next would be
#: their square. A larger one may cross a kink, such as a clamp at zero.
SMALL = 1e-5
#: Share of a state's largest value below which it counts as that large, by rounding; and the same where a trajectory
#: is found from its beginning, in which what has decayed may grow again.
SMALLEST, SMALLEST_ANEW = 1e-8, 1e-12
#: Newton passes before the trajectory is solved step by step instead.
MAX_PASSES = 8
#: Corrections with the derivatives of an earlier pass (chords) do not square, but each is at most this share of the one
#: before; so small a one is the last; of so many.
CONTRACTION, SMALL_CHORD, CHORDS = 0.2, 1e-7, 4
#: Newton corrections, relative to the largest states, up to which chords follow; and relative to the largest of the
#: state around where they are made, up to which the derivatives before count as those of the trajectory found. Around
#: is this share of the trajectory to either side: a state may pass zero, or stay small.
CLOSE, NEAR, AROUND = 0.1, 1e-3, 1 / 16


class Pass(NamedTuple):
    """All steps and their derivatives, from states at hand.

    Attributes:
        ends: Where they end, ``(H, R, K, S)``.
        flow: ∂ ends / ∂ states, ``(H, R, K, S, S)``.
        forcing: ∂ ends / ∂ some parameters, ``(H, R, K, S, C)``.
        stages: What else they are solved for, corrected, ``(H, N, R K, S)``: the stages of implicit steps, which are
            corrected once a pass, like the states; nothing of explicit ones.
        carried: ∂ stages / ∂ states, ``(H, N, R K, S, S)``.
        off: Largest correction of the stages, relative to these, ``(H,)``.
        factors: What further corrections with the same derivatives need, each ``(H, ...)``.
    """

    ends: Tensor
    flow: Tensor
    forcing: Tensor
    stages: Tensor
    carried: Tensor
    off: Tensor
    factors: tuple[Tensor, ...] = ()

    def of(self, rows: Tensor) -> "Pass":
        """The same of some rows."""
        factors = tuple(part[rows] for part in self.factors)
        ends, flow, forcing, stages, carried, off, _ = self
        return Pass(ends[rows], flow[rows], forcing[rows], stages[rows], carried[rows], off[rows], factors)

    def moved(self, change: Tensor) -> Tensor:
        """The stages, where the states at the ends of the steps change by ``(H, R, K, S)``."""
        by_begin = torch.cat([torch.zeros_like(change[:, :, :1]), change[:, :, :-1]], dim=2).flatten(1, 2)
        return self.stages + (self.carried @ by_begin[:, None, ..., None]).squeeze(-1)


class Closed(NamedTuple):
    """What Newton's method came to.

    Attributes:
        states: ``(H, R, K + 1, S)``.
        settled: Whether that is a trajectory, ``(H,)``.
        tangents: ∂ states / ∂ some parameters where it is, ``(H, R, K + 1, S, C)``.
        astray: Whether it is none though Newton's method settled, ``(H,)``: see `Steps.astray`.
    """

    states: Tensor
    settled: Tensor
    tangents: Tensor
    astray: Tensor


def close_gaps(
    steps: "Steps",
    values: Tensor,
    guess: Tensor,
    columns: Sequence[int] = (),
    largest: Tensor | None = None,
    *,
    patient: bool = True,
) -> Closed:
    """Trajectories from their first states on, and their derivatives by some parameters.

    A pass takes all steps and their derivatives from the states at hand; the linear recurrence of the gaps gives the
    correction. Where it was small, more of them with the same derivatives follow, which take no derivatives.

    Args:
        steps: The steps.
        values: Parameter values, ``(H, P)``.
        guess: States, ``(H, R, K + 1, S)``, of which the first are right.
        columns: Places of the parameters to derive by.
        largest: Where the trajectory goes on from an earlier one, its largest states, ``(H, 1, 1, S)``.
        patient: Whether to solve the stages anew in every pass where all together does not settle.
    """
    found = _closed(steps, values, guess, columns, largest, nested=False)
    left = ~(found.settled | found.astray)
    if not (steps.solved_for and patient and bool(left.any())):
        return found
    most = None if largest is None else largest[left]
    for whole, part in zip(found, _closed(steps, values[left], guess[left], columns, most, nested=True), strict=True):
        whole[left] = part
    return found


def _closed(
    steps: "Steps", values: Tensor, guess: Tensor, columns: Sequence[int], largest: Tensor | None, *, nested: bool
) -> Closed:
    """The same in one way: stages in the passes of the states, or ``nested`` in each of these."""
    states = guess.clone()
    tangents = states.new_full((*states.shape, len(columns)), math.inf)
    begin = steps.first_slopes(values, columns)
    settled, astray = (torch.zeros(len(values), dtype=torch.bool) for _ in range(2))
    active = torch.isfinite(states).flatten(1).all(-1)
    last = torch.full((len(values),), math.inf, dtype=torch.float64)
    before = states.new_full((len(values), 1, 1, 1), 1e-300) if largest is None else largest.clamp_min(1e-300)
    stages = steps.stages(states)
    for number in range(MAX_PASSES):
        rows = active.nonzero()[:, 0]
        if len(rows) == 0:
            break
        now = states[rows]
        if nested:
            stages[rows] = steps.solved(values[rows], now, stages[rows])
        here = steps.linearised(values[rows], now, columns, stages[rows])
        gap = here.ends - now[:, :, 1:]
        size = torch.maximum(now.abs().amax(dim=(1, 2), keepdim=True), before[rows])
        if number == 0:  # a guess may be zero where the trajectory is not
            size = torch.maximum(size, here.ends.abs().amax(dim=(1, 2), keepdim=True))
        worst = (gap.abs() / size).flatten(1).amax(-1)
        good = torch.isfinite(worst) & (worst < 4.0 * last[rows])
        last[rows] = worst
        push = torch.cat([torch.nan_to_num(gap).unsqueeze(-1), begun(here.flow, here.forcing, begin[rows])], dim=-1)
        solved = recur(here.flow, push)
        change, tangent = solved[..., 0], solved[..., 1:]
        moved = torch.cat([now[:, :, :1], now[:, :, 1:] + change], dim=2)
        good &= torch.isfinite(moved).flatten(1).all(-1)
        floor = size * (SMALLEST if largest is None else SMALLEST_ANEW)
        share = torch.maximum(_share(change, moved, floor), here.off)
        ended = share < SMALL
        stages[rows] = here.moved(change)
        if largest is None:  # what goes on from here would carry on what chords leave
            far = (change.abs() / size).flatten(1).amax(-1)
            at = (good & ~ended & (far < CLOSE)).nonzero()[:, 0]
            if len(at):
                found = _chords(steps, values[rows[at]], moved[at], stages[rows[at]], here.of(at), floor[at], share[at])
                moved[at], stages[rows[at]], small = found
                near = (_share_around(change[at], moved[at]) < NEAR) & (here.off[at] < NEAR)
                ended[at] = small & near if columns else small
        states[rows] = torch.where(good[:, None, None, None], moved, now)
        active[rows] = good & ~ended
        done = (good & ended).nonzero()[:, 0]
        tangents[rows[done]] = torch.cat([begin[rows[done]].unsqueeze(2), tangent[done]], dim=2)
        settled[rows[done]] = True
    done = settled.nonzero()[:, 0]
    if len(done):
        astray[done] = steps.astray(values[done], states[done], stages[done])
    return Closed(states, settled & ~astray, tangents, astray)


def begun(flow: Tensor, forcing: Tensor, begin: Tensor) -> Tensor:
    """The forcing of derivatives by parameters, with what those of the first states ``(H, R, S, C)`` add to it."""
    first = forcing[:, :, :1] + (flow[:, :, 0] @ begin).unsqueeze(2)
    return torch.cat([first, forcing[:, :, 1:]], dim=2)


def _chords(
    steps: "Steps", values: Tensor, states: Tensor, stages: Tensor, here: Pass, floor: Tensor, share: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """States and stages corrected with the derivatives of an earlier pass, and in which rows that became small."""
    for _ in range(CHORDS):
        ends, corrected, off = steps.corrected(values, states, stages, here)
        gap = ends - states[:, :, 1:]
        change = recur(here.flow, torch.nan_to_num(gap).unsqueeze(-1))[..., 0]
        moved = torch.cat([states[:, :, :1], states[:, :, 1:] + change], dim=2)
        now = torch.maximum(_share(change, moved, floor), off)
        better = now < CONTRACTION * share
        states = torch.where(better[:, None, None, None], moved, states)
        followed = here._replace(stages=corrected).moved(change)
        stages = torch.where(better[:, None, None, None], followed, stages)
        share = torch.where(better, now, share)
        if bool(((share < SMALL_CHORD) | ~better).all()):
            break
    return states, stages, share < SMALL_CHORD


def _share(change: Tensor, moved: Tensor, floor: Tensor) -> Tensor:
    """Largest correction ``(H,)`` of states, relative to these where it is made."""
    near = torch.maximum(moved[:, :, :-1].abs(), moved[:, :, 1:].abs())
    return (change.abs() / torch.maximum(near, floor)).flatten(1).amax(-1)


def _share_around(change: Tensor, moved: Tensor) -> Tensor:
    """Largest correction ``(H,)``, relative to the largest of the state around it."""
    hyper, runs, nodes, size = moved.shape
    reach = max(1, int(nodes * AROUND))
    rows = moved.abs().movedim(2, -1).reshape(1, -1, nodes)
    around = torch.nn.functional.max_pool1d(rows, 2 * reach + 1, stride=1, padding=reach)
    near = around.reshape(hyper, runs, size, nodes).movedim(-1, 2)[:, :, 1:]
    return (change.abs() / near.clamp_min(1e-300)).flatten(1).amax(-1)
