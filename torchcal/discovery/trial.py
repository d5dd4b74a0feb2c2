"""What is asked of a simulator or a term before long work: that it repeats itself, and differentiates."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchcal.discovery.problem import Problem
from torchcal.errors import SimulatorError
from torchcal.simulators import Trajectories

__all__ = ["check_repeats", "check_slopes", "place_of"]

#: Difference of two evaluations, relative to the largest output, up to which a simulator repeats itself.
JITTER = 1e-4
#: Step of a difference, in the size of a parameter; how nearly steps forth and back agree where there is no kink; by
#: how much a derivative is none, more than a kink makes of that; and changes that rounding may be, in the size of
#: the outputs.
STEP, AGREE, OFF, ROUNDED = 1e-4, 0.05, 0.1, 1e-10


def check_repeats(problem: Problem, values: Tensor, what: str = "the simulator") -> None:
    """Raise if the outputs at parameter values ``(P,)`` are others when they are computed again.

    Raises:
        SimulatorError: If they are.
    """
    once, again = (torch.nan_to_num(problem.evaluate(values[None], [])[0][0]) for _ in range(2))
    moved = (again - once).abs()
    # What jitters less than this is no random number, but an external solver or sums of single precision.
    if bool((moved > JITTER * torch.maximum(once.abs().max(), problem.recording.spread[problem.index])).any()):
        k = int(moved.argmax())
        raise SimulatorError(
            f"Expected the same outputs whenever {what} is called with the same parameters. Got {float(once[k]):.6g} "
            f"and then {float(again[k]):.6g}: {place_of(problem, k)}. Leave random numbers out of it, or draw them "
            "once, before."
        )


def check_slopes(problem: Problem, values: Tensor, columns: Sequence[int], what: str = "the simulator") -> None:
    """Raise if outputs change otherwise with some parameters, at values ``(P,)``, than their derivatives say.

    Python numbers, NumPy and ``.detach()`` lose a derivative, or a part of it, without a word: what is then fitted is
    nonsense. Where outputs have a kink, steps forth and back disagree and tell nothing.

    Raises:
        SimulatorError: If they do.
    """
    if problem.simulator.dear and not isinstance(problem.simulator, Trajectories):
        return  # other code, which is differentiated by differences
    y, jacobian, _ = problem.evaluate(values[None], list(columns))
    size = values[list(columns)].abs()
    steps = STEP * torch.where(size > 0, size, torch.ones_like(size))
    moved = torch.zeros(len(columns), len(values), dtype=torch.float64)
    moved[range(len(columns)), list(columns)] = steps
    forth, back = problem.evaluate(torch.cat([values + moved, values - moved]), [])[0].chunk(2)
    for k, place in enumerate(columns):
        seen, bent = (forth[k] - back[k]) / 2, forth[k] + back[k] - 2 * y[0]
        change = float(seen.norm())
        sure = change > ROUNDED * float(y.norm()) and float(bent.norm()) < AGREE * change
        off = float((seen - steps[k] * jacobian[0, :, k]).norm())
        if sure and off > OFF * change:  # and not where a slope is infinite
            raise SimulatorError(
                f"Expected {what} to depend on {problem.parameters[place].name!r} through torch operations alone. Got "
                f"outputs that change otherwise with it than their derivative says, by {off / change:.0%}. Avoid "
                "NumPy, float(), .item() and .detach(), or wrap other code in torchcal.ExternalSimulator."
            )


def place_of(problem: Problem, k: int) -> str:
    """Which output a used datum is, and at which condition or time, in words."""
    x, row = problem.recording.x, int(problem.condition_of[k])
    at = ", ".join(f"{n} = {float(v[row]):.4g}" for n, v in (x if isinstance(x, Mapping) else {"x": x}).items())
    return f"output {problem.recording.outputs[int(problem.output_of[k])]!r} at {at}"
