"""Time steps that do for a solution: short enough, and implicit where explicit ones would have to be too short."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchcal.errors import DomainError, SimulatorError
from torchcal.simulators.steps import inputs_between
from torchcal.simulators.trajectories import Trajectories

__all__ = [
    "fading",
    "focused",
    "magnified",
    "may_change",
    "outgrown",
    "settled",
    "settled_implicitly",
    "shortened",
    "spared",
    "step_errors",
    "workable",
]

#: How often steps are halved at most; how often implicit ones are chosen that are tried in place of others, and how
#: many they may become.
HALVINGS, ROUNDS, MANY = 7, 8, 20_000
#: Factor by which halving steps must lessen the error, lest the model be stiff (16, where they are short enough).
CONVERGING = 4.0
#: How much shorter steps become at once where they err, and where no solution is finite.
MOST_DENSER, SHORTER = 16, (4, 16, 64)
#: The same between two samples, where no implicit step gets through; up to how much; and how often at most.
DENSER, DENSEST, JUMPS = 4, 4096, 48
#: Factor in log by which something may grow within an implicit step: these damp what grows faster, and stay on a branch
#: of the solution that is none.
GROWTH = 2.0
#: Size of h λ from which on explicit steps may magnify what fades; steps on end that do, by which factor in log all
#: together, until it matters; how many parameter values are looked at; and how often they are halved for that alone.
UNSTABLE, ON_END, MAGNIFIED, LOOKED_AT, CALMING = 2.5, 3, 7.0, 4, 4
#: Halvings for that up to which explicit steps take less time than implicit ones as long as those before; and how many
#: explicit steps take the time of an implicit one, with derivatives (two states in four runs: 8, and 5 in a batch of
#: eight; the more states, the more).
FEW_HALVINGS, DEARER = 2, 6
#: How many times as fast as at those values a fit may want what fades to be: where steps magnified it there, χ² would
#: rise as at a bound that is none.
FASTER = 1.5
#: Size of h λ of what fades from which on explicit steps may be held back by it, and not by what they follow; and how
#: many times that of what grows in the same step it is, where implicit steps may be longer.
FADING, FADES_FASTER = 1.0, 3.0
#: Implicit steps that are solved at most while their lengths are chosen: a model that jumps needs ever more of them.
WORK = 200_000
#: Choices of their lengths in which the error must fall by `CONVERGING`.
STALLED = 3


def may_change(simulator: object) -> bool:
    """Whether a simulator has time steps and leaves their choice to others."""
    return isinstance(simulator, Trajectories) and simulator.ode.max_step is None


def _implicitly(simulator: Trajectories) -> Trajectories | None:
    """The same with implicit steps, the coarsest if they were explicit; None where they must not be."""
    if not may_change(simulator) or simulator.ode.stiff is False:
        return None
    return simulator if simulator.implicit else Trajectories(simulator.ode, simulator.recording, implicit=True)


def settled(
    simulator: Trajectories, values: Tensor, allowed: Tensor, *, halvings: int = HALVINGS, switch: bool = True
) -> Trajectories:
    """The same with steps so short that halving them changes no output by more than is allowed.

    Where halving them hardly lessens that, as of a stiff model, or where they would magnify what fades, implicit steps
    are tried; where they are implicit, these are shortened in places first. A solution that is infinite with both steps
    counts as settled. Where the simulator has a ``max_step``, the steps stay as they are.

    Args:
        simulator: In time.
        values: Parameter values to look at, ``(H, d)``, physical units.
        allowed: Largest change of each output, ``(n_total,)``.
        halvings: How often steps are halved at most.
        switch: Whether implicit steps are tried in place of explicit ones. It takes long where neither get through.

    Raises:
        SimulatorError: If it still changes after as many halvings.
    """
    if not may_change(simulator):
        return simulator
    if simulator.implicit and (other := settled_implicitly(simulator, values, allowed)) is not None:
        return other
    here, share = _Solved(simulator, simulator.solve(values)), math.inf
    y = here.outputs(values)
    for number in range(halvings):
        halved = here.simulator.refined(2)
        finer = _Solved(halved, halved.solve(values))
        z = finer.outputs(values)
        change = torch.where(torch.isfinite(y) | torch.isfinite(z), (z - y).abs(), torch.zeros_like(y))
        if bool((change <= allowed).all()) and not outgrown(here.simulator, values, here.states):
            if switch:
                return calmed(here.simulator, values, allowed, here.states)
            return shortened(here.simulator, values, here.states) or here.simulator
        before, share = share, float((change / allowed).nan_to_num(nan=math.inf).max())
        slow = number == 1 and not share < before / CONVERGING
        if switch and slow and not simulator.implicit and fading(here.simulator, values, here.states):
            other = settled_implicitly(simulator, values, allowed)
            if other is not None:
                return other
        here, y = finer, z
    raise SimulatorError(
        f"Expected the solution to settle when time steps are halved. Got a change {share:.2g} times as large as "
        f"allowed after {halvings} times (a discontinuous model, or one that grows without bounds: smooth it, rescale "
        "it, or give max_step=)."
    )


def settled_implicitly(
    simulator: Trajectories,
    values: Tensor,
    allowed: Tensor,
    *,
    rounds: int = ROUNDS,
    instead: Trajectories | None = None,
) -> Trajectories | None:
    """The same with implicit steps, where these settle on a finite solution, else None.

    Args:
        simulator: In time.
        values: As of `settled`.
        allowed: As of `settled`.
        rounds: How often steps are chosen at most.
        instead: Explicit steps that do, if there are any: implicit ones must take less time than these.
    """
    implicit, work = _implicitly(simulator), _Work()
    many = MANY if instead is None else instead.num_steps // DEARER
    here = None if implicit is None or implicit.num_steps > many else _through(implicit, values, work)
    excess: list[float] = []
    for _ in range(rounds):
        if here is None or here.simulator.num_steps > many:
            return None
        halved = here.simulator.refined(2)
        finer = _through(halved, values, work)
        if finer is None:
            return None
        change = (finer.outputs(values) - here.outputs(values)).abs() / allowed
        if bool((change <= 1).all()):
            return here.simulator
        excess.append(float(change.max()))
        if len(excess) > STALLED and not excess[-1] < excess[-1 - STALLED] / CONVERGING:
            return None
        worst = int(change.amax(-1).argmax())
        other = focused(here.simulator, values[worst], here.states[worst : worst + 1], 2.0 * excess[-1])
        same = other.subdivide == halved.subdivide and other.denser is halved.denser
        here = finer if same else _through(other, values, work)
    return None


class _Solved(NamedTuple):
    """A simulator and its states at some values."""

    simulator: Trajectories
    states: Tensor

    def outputs(self, values: Tensor) -> Tensor:
        return self.simulator.outputs_of(values, self.states)


class _Work:
    """How many steps have been solved."""

    def __init__(self) -> None:
        self.steps = 0

    def solve(self, simulator: Trajectories, values: Tensor) -> Tensor | None:
        """States; None where that would be too much."""
        self.steps += simulator.grid.h.numel() * len(values)
        return simulator.solve(values) if self.steps <= WORK else None


def _through(simulator: Trajectories, values: Tensor, work: _Work) -> _Solved | None:
    """The same with shorter steps where no finite solution gets through, as where a stiff one jumps, and where what
    grows would be damped; None if none."""
    for _ in range(JUMPS):
        states = work.solve(simulator, values)
        if states is None:
            return None
        bad = ~torch.isfinite(states).all(-1).all(0)  # (R, K + 1)
        if bool(bad[:, 0].any()):
            return None
        bad[:, 1:] |= _outgrown(simulator, values, states).any(0)
        if not bool(bad.any()):
            found = _Solved(simulator, states)
            return found if bool(torch.isfinite(found.outputs(values)).all()) else None
        denser = []
        for r, node in enumerate(bad.long().argmax(1).tolist()):
            counts = simulator.grid.steps_between(r)
            factor = torch.ones_like(counts)
            if node:
                factor[int((counts.cumsum(0) < node).sum())] = DENSER
            denser.append(factor if simulator.denser is None else factor * simulator.denser[r])
        if max(int(factor.max()) for factor in denser) > DENSEST:
            return None
        simulator = simulator.with_steps(simulator.subdivide, tuple(denser))
    return None


def fading(simulator: Trajectories, values: Tensor, states: Tensor) -> bool:
    """Whether anything fades within an explicit step, at some values and their solved states, that grows by far less:
    else implicit steps would have to be as short. Where the solution is not finite anything may."""
    if not bool(torch.isfinite(states).all()):
        return True
    slopes, h = _slopes_begun(simulator, values, states)
    if not bool(slopes.isfinite().all()):
        return True
    possible = slopes.abs().sum(-1).amax(-1) * h > FADING
    if not bool(possible.any()):
        return False
    z = torch.linalg.eigvals(slopes[possible]) * h.expand(possible.shape)[possible][:, None]
    fastest = torch.where(z.real < 0, z.abs(), torch.zeros_like(z.real)).amax(-1)
    return bool(((fastest > FADING) & (fastest > FADES_FASTER * z.real.amax(-1))).any())


def _slopes_begun(simulator: Trajectories, values: Tensor, states: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes of the rates where steps begin, ``(H, M, S, S)``, and the lengths of the steps, ``(M,)``."""
    t, h, u = simulator.grid.flat
    return simulator.steps.slopes_at(values, states[:, :, :-1], t, {name: table[0] for name, table in u.items()}), h


def outgrown(simulator: Trajectories, values: Tensor, states: Tensor) -> bool:
    """Whether implicit steps, at some values and their solved states, damp what grows."""
    return simulator.implicit and bool(_outgrown(simulator, values, states).any())


def _outgrown(simulator: Trajectories, values: Tensor, states: Tensor) -> Tensor:
    """Which steps something grows in by more than `GROWTH`, ``(H, R, K)``: h Re λ of the rates' slopes at their ends.
    """
    t, h, u = simulator.grid.flat
    slopes = simulator.steps.slopes_at(values, states[:, :, 1:], t + h, {name: table[2] for name, table in u.items()})
    fastest = torch.zeros(slopes.shape[:2], dtype=slopes.dtype)
    possible = (slopes.abs().sum(-1).amax(-1) * h > GROWTH) & slopes.isfinite().flatten(2).all(-1)
    if bool(possible.any()):
        fastest[possible] = torch.linalg.eigvals(slopes[possible]).real.amax(-1)
    return (fastest * h > GROWTH).reshape(*states.shape[:2], -1)


def workable(simulator: Trajectories, values: Tensor, allowed: Tensor, *, halvings: int = HALVINGS) -> Trajectories:
    """The same with steps with which the solution at some values is finite and settled, if there are any.

    Where it settles with none it is the first with a finite solution, calmed, else the simulator itself. Arguments are
    those of `settled`.
    """
    if not may_change(simulator) or not bool(simulator.begins(values).all()):
        return simulator
    if simulator.implicit or not _finite(simulator, values):
        other = settled_implicitly(simulator, values, allowed)
        if other is not None:
            return other
    for finer in _shorter(simulator):
        if _finite(finer, values):
            try:
                return settled(finer, values, allowed, halvings=halvings)
            except (SimulatorError, DomainError):  # what steps that magnify it make of what fades leads any fit astray
                return calmed(finer, values, allowed, finer.solve(values))
    return simulator


def _shorter(simulator: Trajectories) -> Iterator[Trajectories]:
    """The same, and with ever shorter steps."""
    yield simulator
    for factor in SHORTER:
        try:
            yield simulator.refined(factor)
        except DomainError:  # more steps than anyone can take
            return


def _finite(simulator: Trajectories, values: Tensor) -> bool:
    return bool(torch.isfinite(_Solved(simulator, simulator.solve(values)).outputs(values)).all())


def calmed(simulator: Trajectories, values: Tensor, allowed: Tensor, states: Tensor) -> Trajectories:
    """The same, or where its explicit steps magnify what fades, with a few times as many that do not, or fewer implicit
    ones that take less time; else with any implicit ones; else with many more; itself where there are none. Arguments
    are those of `settled`, and its solved states."""
    few = shortened(simulator, values, states, few=True)
    if few is simulator:
        return few
    return (
        settled_implicitly(simulator, values, allowed, instead=few)
        or few
        or shortened(simulator, values, states)
        or simulator
    )


def shortened(simulator: Trajectories, values: Tensor, states: Tensor, *, few: bool = False) -> Trajectories | None:
    """The same, with explicit steps that magnify what fades halved until they do not; None where they do however often,
    or, with ``few``, where implicit ones take less time. Arguments are those of `magnified`."""
    excess = _magnifying(simulator, values, states)
    if not excess:
        return simulator
    halvings = FEW_HALVINGS if few else CALMING
    finer = simulator
    for _ in range(halvings if excess < 2**halvings else 0):
        try:
            finer = finer.refined(2)
        except DomainError:  # more steps than anyone can take
            break
        if finer.num_steps > MANY:
            break
        if not _magnifying(finer, values, finer.solve(values)):
            return finer
    return None


def magnified(simulator: Trajectories, values: Tensor, states: Tensor) -> bool:
    """Whether explicit steps, at some values and their solved states, magnify what fades, or would if that were faster.

    A fast state at rest may be solved well with such steps, and what a small change makes of it be wrong without limit:
    several steps on end lie outside the region in which the method is stable. Where it is `FASTER` alone they lie near
    its edge, which no fit could cross.
    """
    return _magnifying(simulator, values, states) > 0


def _magnifying(simulator: Trajectories, values: Tensor, states: Tensor) -> float:
    """The largest size of h λ, `FASTER`, in `UNSTABLE` where steps magnify what fades so; 0 where they do not. It is
    looked at for a few of the values."""
    if simulator.implicit:
        return 0.0
    few = torch.linspace(0, len(values) - 1, min(LOOKED_AT, len(values))).long()
    values, states = values[few], states[few]
    slopes, h = _slopes_begun(simulator, values, states)
    growth, size = (torch.zeros(slopes.shape[:2], dtype=slopes.dtype) for _ in range(2))
    slopes = FASTER * slopes
    possible = (slopes.abs().sum(-1).amax(-1) * h > UNSTABLE) & slopes.isfinite().flatten(2).all(-1)
    if not bool(possible.any()):
        return 0.0
    z = torch.linalg.eigvals(slopes[possible]) * h.expand(possible.shape)[possible][:, None]
    z = torch.where(z.real < 0, z, torch.zeros_like(z))
    gain = (1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4)))).abs().log()
    growth[possible], size[possible] = gain.amax(-1).clamp_min(0), z.abs().amax(-1)
    growth = growth.reshape(*states.shape[:2], -1)
    calm = growth <= 0
    loud = (_on_end(growth, calm) > MAGNIFIED) & (_on_end((~calm).double(), calm) >= ON_END)
    return float(size.max()) / UNSTABLE if bool(loud.any()) else 0.0


def _on_end(values: Tensor, calm: Tensor) -> Tensor:
    """Sums of values ``(..., K)``, 0 where it is calm, up to each one since it was calm last."""
    total = values.cumsum(-1)
    return total - torch.where(calm, total, torch.zeros_like(total)).cummax(-1).values


def step_errors(simulator: Trajectories, values: Tensor, states: Tensor) -> Tensor:
    """Error of every step by itself, from two of half its length, as a share of the largest value of its state.

    Args:
        simulator: In time.
        values: Parameter values, ``(d,)``.
        states: Their trajectory, ``(1, R, nodes, S)``.

    Returns:
        That of the worst state, ``(R, K)``.
    """
    runs, size = len(simulator.runs), states.shape[-1]
    steps = simulator.steps
    t, h, u = simulator.grid.flat
    first, middle, last = ({name: table[i] for name, table in u.items()} for i in range(3))

    p = simulator.layout.by_name(values[None], simulator.grid.step_run)
    begin = states[:, :, :-1].reshape(1, -1, size)
    half = steps.step(begin, t, 0.5 * h, p, inputs_between(first, middle))
    twice = steps.step(half, t + 0.5 * h, 0.5 * h, p, inputs_between(middle, last))
    once = steps.step(begin, t, h, p, u)
    scale = states[0].abs().amax(dim=(0, 1)).clamp_min(1e-300)
    return ((twice - once)[0].abs() / scale).amax(-1).reshape(runs, -1)


def focused(simulator: Trajectories, values: Tensor, states: Tensor, excess: float) -> Trajectories:
    """The same with shorter steps where they err, for an error that is smaller by some factor.

    The error of a step, from two of half its length, is spread such that the fewest steps have the wanted sum of
    errors.

    Args:
        simulator: In time.
        values: Parameter values, ``(d,)``.
        states: Their trajectory, ``(1, R, nodes, S)``.
        excess: By what the error must fall.
    """
    wanted = _wanted(simulator, values, states, excess)
    if wanted is None:
        return simulator.refined(2)
    factors = [factor.ceil().clamp(1, MOST_DENSER).long() for factor in wanted]
    if all(bool((factor == 1).all()) for factor in factors):
        return simulator.refined(2)
    old = _denser(simulator)
    return simulator.with_steps(simulator.subdivide, tuple(a * b for a, b in zip(old, factors, strict=True)))


def spared(simulator: Trajectories, values: Tensor, states: Tensor, excess: float) -> Trajectories:
    """The same with longer steps where they err less than others, for an error that is larger by some factor at most.

    Steps that were shortened for one solution may be too short for another. Arguments are those of `focused`; the error
    may grow to its ``1 / excess``.
    """
    wanted = _wanted(simulator, values, states, excess)
    if wanted is None:
        return simulator
    old = [simulator.subdivide * each for each in _denser(simulator)]
    fewer = tuple((a * b).ceil().long().clamp_min(1).minimum(a) for a, b in zip(old, wanted, strict=True))
    return simulator.with_steps(1, fewer)


def _denser(simulator: Trajectories) -> tuple[Tensor, ...]:
    """How many times more steps there are in each gap of each run than `Trajectories.subdivide` alone gives."""
    if simulator.denser is not None:
        return simulator.denser
    runs = range(len(simulator.runs))
    return tuple(torch.ones_like(simulator.grid.steps_between(r)) for r in runs)


def _wanted(simulator: Trajectories, values: Tensor, states: Tensor, excess: float) -> list[Tensor] | None:
    """Factors by which the number of steps in each gap of each run is best changed; None where that cannot be told.
    Arguments are those of `focused`."""
    runs, error = len(simulator.runs), step_errors(simulator, values, states)
    number = [simulator.grid.steps_between(r) for r in range(runs)]
    gaps = []
    for r, counts in enumerate(number):
        place = torch.arange(len(counts)).repeat_interleave(counts)
        gaps.append(torch.zeros(len(counts), dtype=error.dtype).index_add_(0, place, error[r, : len(place)]))
    every = torch.cat(gaps)
    if not bool(torch.isfinite(every).all()) or not float(every.sum()) > 0:
        return None
    share = 1.0 / simulator.steps.order
    spread = every.pow(share) * torch.cat(number).double().pow(1.0 - share)
    level = (every.sum() / excess / spread.sum()).pow(1.0 / (1.0 - share))
    return [(gap / (count * level)).pow(share) for gap, count in zip(gaps, number, strict=True)]
