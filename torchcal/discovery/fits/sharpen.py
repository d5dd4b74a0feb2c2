"""Time steps that are short enough for a fit: its solver's error is small against the noise."""

import dataclasses
import math
from collections.abc import Callable

from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted, fit
from torchcal.errors import DomainError
from torchcal.simulators import (
    Trajectories,
    calmed,
    fading,
    focused,
    magnified,
    may_change,
    outgrown,
    settled_implicitly,
    step_errors,
)

__all__ = ["SOLVER_SHARE", "accurate", "halved", "sharpen"]

#: Solver error, in noise sd, up to which it is none.
SOLVER_SHARE = 0.05
#: How often implicit steps are chosen at most.
ROUNDS = 8
#: Factor by which the error must become smaller when steps are chosen anew.
CONVERGING = 4.0


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
            return _calm(found, most, states, ROUNDS if patient else 1), 0.0
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
        problem = dataclasses.replace(found.problem, simulator=finer)
        again = fit(problem, found.whitening, found.values[None], found.free)
        found = found if again is None else again
    return found, float(error.max())


def _calm(found: Fitted, allowed: Tensor, states: Tensor, rounds: int) -> Fitted:
    """The fit with steps that do not magnify what fades, where there are any: what a term would do there is wrong."""
    problem, simulator = found.problem, found.problem.simulator
    if not isinstance(simulator, Trajectories) or not magnified(simulator, found.values[None], states):
        return found
    if (again := _implicit(found, allowed, rounds)) is not None:
        return again
    calm = calmed(simulator, found.values[None], allowed, states, switch=False)
    if calm is simulator:
        return found
    again = fit(problem.with_simulator(calm), found.whitening, found.values[None], found.free)
    return found if again is None else again


def _implicit(found: Fitted, allowed: Tensor, rounds: int) -> Fitted | None:
    """The fit with implicit steps; None where these do not settle either, there or where the fit ends."""
    problem, simulator = found.problem, found.problem.simulator
    if not isinstance(simulator, Trajectories):
        return None
    most = problem.recording.spread.clone()
    most[problem.index] = allowed
    other = settled_implicitly(simulator, found.values[None], most, rounds=rounds)
    if other is None:
        return None
    again = fit(problem.with_simulator(other), found.whitening, found.values[None], found.free)
    if again is None or not bool(again.problem.evaluate(again.values[None], [], again.warm)[0].isfinite().all()):
        return None
    return again
