"""Whether a simulator differentiates: its derivatives beside differences of its outputs."""

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from torchcal.errors import SimulatorError
from torchcal.simulators.static import Conditions, Simulator
from torchcal.simulators.trajectories import Trajectories

__all__ = ["check_slopes"]

#: Steps of differences, in the size of a parameter; how nearly those of the first two agree, and steps forth and back,
#: where there is no kink; by how much a derivative is off from all that is none, more than a kink makes of that; and
#: changes that may be rounding, of single precision too, in the size of the outputs.
STEPS, AGREE, OFF, ROUNDED = (1e-2, 1e-3, 1e-5), 0.05, 0.1, 3e-7


def check_slopes(
    simulator: Simulator,
    x: Conditions,
    values: Tensor,
    columns: Sequence[int],
    outputs: Sequence[str] | None = None,
    *,
    kept: Tensor | None = None,
    what: str = "the simulator",
) -> None:
    """Raise if outputs change otherwise with some parameters than their derivatives say.

    Python numbers, NumPy and ``.detach()`` lose a derivative, or a part of it, without a word: what is then fitted is
    nonsense. Where outputs have a kink or a jump, differences of steps disagree and tell nothing. No step leaves the
    bounds. Other code, which is differentiated by differences, is not asked.

    Args:
        simulator: Bound to the conditions.
        x: Conditions.
        values: Parameter values, ``(m, P)``, physical units. All parameters are asked at the first with finite outputs,
            those that are on a bound there at the next.
        columns: Places of the parameters to ask.
        outputs: Names of the outputs wanted.
        kept: Places of the output values that count; all by default.
        what: How to call the simulator in the error.

    Raises:
        SimulatorError: If they do.
    """
    if simulator.dear and not isinstance(simulator, Trajectories):
        return
    places = slice(None) if kept is None else kept

    def evaluate(values: Tensor, columns: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        found = simulator.linearise(x, values, outputs, columns)
        return found.y[:, places], found.jacobian[:, places]

    good = torch.isfinite(evaluate(values)[0]).all(-1)
    asked = list(columns)
    for here in values[good]:
        reach = _reach(simulator, here)
        inside = [column for column in asked if reach[column] > 0]
        for column, off in _errors(evaluate, here, reach, inside):
            raise SimulatorError(
                f"Expected {what} to depend on {simulator.names[column]!r} through torch operations alone. Got "
                f"outputs that change otherwise with it than their derivative says, by {off:.0%}. Avoid NumPy, "
                "float(), .item() and .detach(), or wrap other code in torchcal.ExternalSimulator."
            )
        asked = [column for column in asked if column not in inside]
        if not asked:
            break


def _reach(simulator: Simulator, values: Tensor) -> Tensor:
    """The size of every parameter, and no more than what is left to its bounds, ``(P,)``."""
    low = torch.tensor([-math.inf if q.low is None else q.low for q in simulator.parameters], dtype=torch.float64)
    high = torch.tensor([math.inf if q.high is None else q.high for q in simulator.parameters], dtype=torch.float64)
    width = high - low
    size = torch.where(values != 0, values.abs(), torch.where(width.isfinite(), width, torch.ones_like(width)))
    return torch.minimum(size, torch.minimum(values - low, high - values).clamp_min(0.0))


def _errors(
    evaluate: Callable[..., tuple[Tensor, Tensor]], values: Tensor, reach: Tensor, columns: list[int]
) -> Iterator[tuple[int, float]]:
    """Parameters whose derivative is wrong at values ``(P,)``, and by which part of the change.

    They may move from there by their ``reach`` times `STEPS`.
    """
    if not columns:
        return
    moves = []
    for factor in STEPS:
        moved = torch.zeros(len(columns), len(values), dtype=torch.float64)
        moved[range(len(columns)), columns] = factor * reach[columns]
        moves += [moved, -moved]
    y, jacobian = (each[0] for each in evaluate(values[None], columns))
    tried = evaluate(values + torch.cat(moves))[0].chunk(2 * len(STEPS))
    pairs = list(zip(STEPS, tried[::2], tried[1::2], strict=True))
    for k, column in enumerate(columns):
        far, seen, close = ((forth[k] - back[k]) / (2 * factor) for factor, forth, back in pairs)
        told = reach[column] * jacobian[:, k]
        bent = max(float((far - seen).norm()), float((tried[2][k] + tried[3][k] - 2 * y).norm()) / STEPS[1])
        change = float(seen.norm())
        off = min(float((one - told).norm()) for one in (seen, close))
        # Neither rounding nor a kink, nor where a slope is infinite.
        if change * STEPS[1] > ROUNDED * float(y.norm()) and bent < AGREE * change and off > OFF * change:
            yield column, off / change
