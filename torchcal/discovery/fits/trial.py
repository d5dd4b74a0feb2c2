"""What is asked of a simulator or a term before long work: that it repeats itself."""

from collections.abc import Mapping

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.errors import SimulatorError

__all__ = ["check_repeats", "place_of"]

#: Difference of two evaluations, relative to the largest output, up to which a simulator repeats itself.
JITTER = 1e-4


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


def place_of(problem: Problem, k: int) -> str:
    """Which output a used datum is, and at which condition or time, in words."""
    x, row = problem.recording.x, int(problem.condition_of[k])
    at = ", ".join(f"{n} = {float(v[row]):.4g}" for n, v in (x if isinstance(x, Mapping) else {"x": x}).items())
    return f"output {problem.recording.outputs[int(problem.output_of[k])]!r} at {at}"
