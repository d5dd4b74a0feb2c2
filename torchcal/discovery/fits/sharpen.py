"""Time steps that are short enough for a fit: its solver's error is small against the noise."""

import dataclasses
import math
from collections.abc import Callable

from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted, fit
from torchcal.errors import DomainError
from torchcal.simulators import (
    Trajectories,
    fading,
    focused,
    magnified,
    may_change,
    outgrown,
    settled_implicitly,
    shortened,
    spared,
    step_errors,
)

__all__ = ["SOLVER_SHARE", "accurate", "halved", "sharpen"]

#: Solver error, in noise sd, up to which it is none.
SOLVER_SHARE = 0.05
#: How often implicit steps are chosen at most.
ROUNDS = 8
#: Factor by which the error must become smaller when steps are chosen anew.
CONVERGING = 4.0
#: Share of the error that is allowed up to which steps are made longer, lest those of a model with one more term err,
#: and of their number that must be enough.
ROOM, FEWER = 0.1, 0.6
#: Share of χ², and χ², by which a fit in longer steps may be worse: what is more is another minimum.
WORSE = (0.01, 1.0)


def accurate(found: Fitted, sd: Tensor) -> bool:
    """Whether the errors of a fit's steps, all together, are clearly too small to matter in noise of some sd ``(n,)``.

    Each is measured by itself, which takes no solution with shorter steps.
    """
    simulator = found.problem.simulator
    if not isinstance(simulator, Trajectories) or not may_change(simulator):
        return True
    states = simulator.solve(found.values[None], found.warm)
    errors = step_errors(simulator, found.values, states)
    if outgrown(simulator, found.values[None], states) or magnified(simulator, found.values[None], states):
        return False
    least = float((sd / found.problem.recording.spread[found.problem.index]).min())
    return float(errors.sum()) <= SOLVER_SHARE * least


def halved(found: Fitted) -> Tensor:
    """What a fit in time shows at the used data ``(n,)`` with time steps half as long.

    Raises:
        DomainError: Where that is more steps than anyone can take.
    """
    simulator = found.problem.simulator
    if not isinstance(simulator, Trajectories):
        return found.y
    finer = simulator.refined(2)
    return finer.outputs_of(found.values[None], finer.solve(found.values[None]))[0, found.problem.index]


def sharpen(
    found: Fitted,
    allowed: Callable[[Fitted], Tensor],
    *,
    rounds: int,
    patient: bool = True,
    half: Tensor | None = None,
) -> tuple[Fitted, float]:
    """Shorten a fit's time steps, where they err, until halving them moves no output by more than is allowed.

    Where that is of little avail, as in a stiff model, or steps would magnify what fades, they become implicit if that
    is.

    Args:
        found: The fit.
        allowed: The largest change of every datum, ``(n,)``, of a fit.
        rounds: How often steps are chosen anew at most.
        patient: Whether to go on where that is of little avail, as in a model that jumps.
        half: What the fit shows with steps half as long, where that is known.

    Returns:
        The fit with steps that do, and by what it still errs (0 where it does not).
    """
    error, share = found.y.new_zeros(()), math.inf
    for number in range(rounds + 1):
        simulator = found.problem.simulator
        if not isinstance(simulator, Trajectories) or not may_change(simulator):
            return found, 0.0
        try:
            y = halved(found) if number or half is None else half
        except DomainError:  # more steps than anyone can take
            break
        error, most = (y - found.y).abs(), allowed(found)
        states = simulator.solve(found.values[None], found.warm)
        branch = outgrown(simulator, found.values[None], states)  # of the solution may be another one
        if bool((error <= most).all()) and not branch:
            lean = _spared(found, y, most, states)
            return lean or _calm(found, most, states, ROUNDS if patient else 1), 0.0
        before, share = share, float((error / most).nan_to_num(nan=math.inf).max())
        slow = branch or (number > 0 and not share < before / CONVERGING)
        if slow and (simulator.implicit or fading(simulator, found.values[None], states)):
            again = _implicit(found, most, ROUNDS if patient else 1)
            if again is not None:
                return sharpen(again, allowed, rounds=rounds, patient=patient)
        if number == rounds or (slow and not patient):
            break
        try:
            finite = math.isfinite(share)
            finer = focused(simulator, found.values, states, 2.0 * share) if finite else simulator.refined(2)
        except DomainError:  # more steps than anyone can take
            break
        found = _in_steps_of(finer, found) or found
    return found, float(error.max())


def _spared(found: Fitted, half: Tensor, allowed: Tensor, states: Tensor) -> Fitted | None:
    """The fit in longer steps, where those at hand are much shorter than it needs: chosen for a solution that the fit
    has left, or as short everywhere as in one place. None where they are not.

    Args:
        found: The fit, whose steps do.
        half: What it shows with steps half as long, ``(n,)``.
        allowed: The largest error of every datum, ``(n,)``.
        states: Its trajectory.
    """
    problem, simulator = found.problem, found.problem.simulator
    error = float(((half - found.y).abs() / allowed).max())
    if not isinstance(simulator, Trajectories) or simulator.implicit or not 0 < error < ROOM:
        return None
    fewer = spared(simulator, found.values, states, error / ROOM)
    if fewer.num_steps > FEWER * simulator.num_steps:
        return None
    again = _in_steps_of(fewer, found)
    if again is None or again.chi2 > found.chi2 + WORSE[0] * found.chi2 + WORSE[1]:
        return None
    if magnified(fewer, again.values[None], fewer.solve(again.values[None], again.warm)):
        return None
    # Against the shorter steps at hand: where the fit has moved, these may err too.
    finer = simulator.outputs_of(again.values[None], simulator.solve(again.values[None]))[0, problem.index]
    return again if bool(((finer - again.y).abs() <= 2 * ROOM * allowed).all()) else None


def _in_steps_of(simulator: Trajectories, found: Fitted) -> Fitted | None:
    """The fit again in other steps; None where these give none."""
    again = fit(found.problem.with_simulator(simulator), found.whitening, found.values[None], found.free)
    return None if again is None else dataclasses.replace(again, agreeing=found.agreeing)


def _calm(found: Fitted, allowed: Tensor, states: Tensor, rounds: int) -> Fitted:
    """The fit with steps that do not magnify what fades, where there are any: what a term would do there is wrong."""
    simulator = found.problem.simulator
    if not isinstance(simulator, Trajectories) or not magnified(simulator, found.values[None], states):
        return found
    calm = shortened(simulator, found.values[None], states, few=True)
    again = _implicit(found, allowed, rounds, instead=calm)
    # Coarser steps than those at hand have to do where the fit ends, too.
    if again is not None and (calm is None or bool(((halved(again) - again.y).abs() <= allowed).all())):
        return again
    calm = calm or shortened(simulator, found.values[None], states)
    return found if calm is None else _in_steps_of(calm, found) or found


def _implicit(found: Fitted, allowed: Tensor, rounds: int, instead: Trajectories | None = None) -> Fitted | None:
    """The fit with implicit steps; None where these do not settle either, there or where the fit ends. Where there are
    explicit steps that do, in whose stead they would be taken, they must take less time than these."""
    problem, simulator = found.problem, found.problem.simulator
    if not isinstance(simulator, Trajectories):
        return None
    most = problem.recording.spread.clone()
    most[problem.index] = allowed
    other = settled_implicitly(simulator, found.values[None], most, rounds=rounds, instead=instead)
    if other is None:
        return None
    again = _in_steps_of(other, found)
    if again is None or not bool(again.problem.evaluate(again.values[None], [], again.warm)[0].isfinite().all()):
        return None
    return again
