"""Time steps that are short enough for a fit: its solver's error is small against the noise."""

import dataclasses
import math
from collections.abc import Callable

from torch import Tensor

from torchcal.discovery.fitting import Fitted, fit
from torchcal.errors import DomainError
from torchcal.simulators import Trajectories

__all__ = ["SOLVER_SHARE", "accurate", "sharpen"]

#: Solver error, in noise sd, up to which it is none.
SOLVER_SHARE = 0.05


def accurate(found: Fitted, sd: Tensor) -> bool:
    """Whether the errors of a fit's steps, all together, are clearly too small to matter in noise of some sd ``(n,)``.

    Each is measured by itself, which takes no solution with shorter steps.
    """
    simulator = found.problem.simulator
    if not isinstance(simulator, Trajectories) or simulator.ode.max_step is not None:
        return True
    errors = simulator.step_errors(found.values, simulator.solve(found.values[None], found.warm))
    least = float((sd / found.problem.recording.spread[found.problem.index]).min())
    return float(errors.sum()) <= SOLVER_SHARE * least


def sharpen(found: Fitted, allowed: Callable[[Fitted], Tensor], *, rounds: int) -> tuple[Fitted, float]:
    """Shorten a fit's time steps, where they err, until halving them moves no output by more than is allowed.

    Args:
        found: The fit.
        allowed: The largest change of every datum, ``(n,)``, of a fit.
        rounds: How often steps are chosen anew at most.

    Returns:
        The fit with steps that do, and by what it still errs (0 where it does not).
    """
    error = found.y.new_zeros(())
    for number in range(rounds + 1):
        simulator = found.problem.simulator
        if not isinstance(simulator, Trajectories) or simulator.ode.max_step is not None:
            return found, 0.0
        finer = simulator.refined(2)
        y = finer.outputs_of(found.values[None], finer.solve(found.values[None]))[0, found.problem.index]
        error, most = (y - found.y).abs(), allowed(found)
        if bool((error <= most).all()):
            return found, 0.0
        if number == rounds:
            break
        excess = 2.0 * float((error / most).max())
        try:
            if math.isfinite(excess):
                finer = simulator.focused(found.values, simulator.solve(found.values[None], found.warm), excess)
        except DomainError:  # more steps than anyone can take
            break
        problem = dataclasses.replace(found.problem, simulator=finer)
        again = fit(problem, found.whitening, found.values[None], found.free)
        found = found if again is None else again
    return found, float(error.max())
