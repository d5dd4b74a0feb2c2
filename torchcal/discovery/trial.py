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
#: Steps of differences, in the size of a parameter; how nearly those of the first two agree, and steps forth and back,
#: where there is no kink; by how much a derivative is off from all that is none, more than a kink makes of that; and
#: changes that may be rounding, of single precision too, in the size of the outputs.
STEPS, AGREE, OFF, ROUNDED = (1e-2, 1e-3, 1e-5), 0.05, 0.1, 3e-7


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
    nonsense. Where outputs have a kink or a jump, differences of steps disagree and tell nothing. No step leaves the
    bounds, so that a parameter on one of them is not asked.

    Raises:
        SimulatorError: If they do.
    """
    if problem.simulator.dear and not isinstance(problem.simulator, Trajectories):
        return  # other code, which is differentiated by differences
    columns = list(columns)
    y, jacobian, _ = problem.evaluate(values[None], columns)
    low, high = (end[columns] for end in problem.limits())
    at, width = values[columns], high - low
    size = torch.where(at != 0, at.abs(), torch.where(width.isfinite(), width, torch.ones_like(width)))
    reach = torch.minimum(size, torch.minimum(at - low, high - at).clamp_min(0.0))
    moves = []
    for factor in STEPS:
        moved = torch.zeros(len(columns), len(values), dtype=torch.float64)
        moved[range(len(columns)), columns] = factor * reach
        moves += [moved, -moved]
    found = problem.evaluate(values + torch.cat(moves), [])[0].chunk(2 * len(STEPS))
    pairs = list(zip(STEPS, found[::2], found[1::2], strict=True))
    for k, place in enumerate(columns):
        far, seen, close = ((forth[k] - back[k]) / (2 * factor) for factor, forth, back in pairs)
        told = reach[k] * jacobian[0, :, k]
        bent = max(float((far - seen).norm()), float((found[2][k] + found[3][k] - 2 * y[0]).norm()) / STEPS[1])
        change = float(seen.norm())
        off = min(float((one - told).norm()) for one in (seen, close))
        # Neither rounding nor a kink, nor where a slope is infinite.
        if change * STEPS[1] > ROUNDED * float(y.norm()) and bent < AGREE * change and off > OFF * change:
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
