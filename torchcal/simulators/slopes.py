"""Whether a simulator differentiates: its derivatives beside differences of its outputs."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from torchcal.errors import SimulatorError
from torchcal.simulators.parameter import limits
from torchcal.simulators.solution import Solution
from torchcal.simulators.static import Conditions, Simulator
from torchcal.simulators.trajectories import Trajectories

__all__ = ["check_slopes"]

#: Steps of differences, in the size of a parameter; how nearly those of the first two agree, and steps forth and back,
#: where there is no kink and no rounding; and by how much a derivative is off from all that is none, more than a kink
#: makes of that.
STEPS, AGREE, OFF = (1e-2, 1e-3, 1e-5), 0.05, 0.1
#: Combinations of the outputs that are derived.
DRAWS = 8
#: Parameters from which on so many trajectories are found sooner together from their beginnings than each from a near
#: one.
MANY = 16

Look = tuple[Tensor, Tensor]


def check_slopes(
    simulator: Simulator,
    x: Conditions,
    values: Tensor,
    columns: Sequence[int],
    outputs: Sequence[str] | None = None,
    *,
    kept: Tensor | None = None,
    whole: bool = False,
    what: str = "the simulator",
    near: Solution | None = None,
) -> None:
    """Raise if outputs change otherwise with some parameters than their derivatives say.

    Python numbers, NumPy and ``.detach()`` lose a derivative, or a part of it, without a word: what is then fitted is
    nonsense. Each output is judged for itself. Where it has a kink or a jump, or is rounded, differences of steps
    disagree and tell nothing. No step leaves the bounds. Other code, which is differentiated by differences, is not
    asked.

    Args:
        simulator: Bound to the conditions.
        x: Conditions.
        values: Parameter values, ``(m, P)``, physical units. All parameters are asked at the first with finite outputs,
            and those that tell nothing there at the next.
        columns: Places of the parameters to ask.
        outputs: Names of the outputs wanted.
        kept: Which output values count, bool ``(n_total,)``; all by default.
        whole: Whether to ask the Jacobian of `Simulator.linearise`, by which a diagnosis goes, in place of backward
            passes, by which a sampler does.
        what: How to call the simulator in the error.
        near: Of a simulator in time, a trajectory near that at the first of the values.

    Raises:
        SimulatorError: If they do.
    """
    if simulator.dear and not isinstance(simulator, Trajectories):
        return
    used = kept
    looks: list[Look] = []
    asked = list(columns)
    for number, here in enumerate(values):
        reach = _reach(simulator, here)
        inside = [column for column in asked if reach[column] > 0]
        guess = None if number else near
        first = simulator.linearise(x, here[None], outputs, inside if whole else [], guess)
        if used is None:
            used = torch.ones(first.y.shape[-1], dtype=torch.bool)
        if not bool(torch.isfinite(first.y[0, used]).all()):
            continue
        looks = looks or _looks(used, len(next(iter(x.values())) if isinstance(x, Mapping) else x))
        told = None if whole else _pulled_back(simulator.at(x, outputs), here[None], looks)
        if told is None:
            jacobian = (first if whole else simulator.linearise(x, here[None], outputs, inside)).jacobian[0]
            told = [signs @ jacobian[part] for part, signs in looks]
        else:
            told = [each[:, inside] for each in told]

        def moved(rows: Tensor, warm: Solution | None = first.warm, many: bool = len(inside) > MANY) -> Tensor:
            if many:
                with torch.no_grad():
                    return simulator.at(x, outputs)(rows)
            return simulator.linearise(x, rows, outputs, [], warm and warm.repeated(len(rows))).y

        judged = set()
        for column, off in _errors(moved, first.y[0], told, here, reach, inside, looks):
            if off > OFF:
                raise SimulatorError(
                    f"Expected {what} to depend on {simulator.names[column]!r} through torch operations alone. Got "
                    f"outputs that change otherwise with it than their derivative says, by {off:.0%}. Avoid NumPy, "
                    "float(), .item() and .detach(), or wrap other code in torchcal.ExternalSimulator."
                )
            judged.add(column)
        asked = [column for column in asked if column not in judged]
        if not asked:
            break


def _looks(used: Tensor, rows: int) -> list[Look]:
    """Of each output of which values count, ``rows`` of every one, their places, and signs to sum them with."""
    generator = torch.Generator().manual_seed(0)
    parts = [k * rows + part.nonzero()[:, 0] for k, part in enumerate(used.split(rows)) if bool(part.any())]
    return [(part, torch.randint(2, (DRAWS, len(part)), generator=generator).double() * 2 - 1) for part in parts]


def _reach(simulator: Simulator, values: Tensor) -> Tensor:
    """The size of every parameter, and no more than what is left to its bounds, ``(P,)``."""
    low, high = limits(simulator.parameters)
    width = high - low
    size = torch.where(values != 0, values.abs(), torch.where(width.isfinite(), width, torch.ones_like(width)))
    return torch.minimum(size, torch.minimum(values - low, high - values).clamp_min(0.0))


def _errors(
    moved: Callable[[Tensor], Tensor],
    y: Tensor,
    told: list[Tensor],
    values: Tensor,
    reach: Tensor,
    columns: list[int],
    looks: list[Look],
) -> Iterator[tuple[int, float]]:
    """By which part of the change derivatives at values ``(P,)`` are off, for each parameter that tells it.

    Args:
        moved: Outputs at nearby values.
        y: Those at the values.
        told: What derivatives say of the sums that each of ``looks`` takes, ``(DRAWS, len(columns))``.
        values: Parameter values.
        reach: They may move by this times `STEPS`.
        columns: Places of the parameters to ask.
        looks: Of each output, the places and the signs ``(DRAWS, m)`` with which its values are summed.
    """
    if not columns:
        return
    moves = []
    for factor in STEPS:
        move = torch.zeros(len(columns), len(values), dtype=torch.float64)
        move[range(len(columns)), columns] = factor * reach[columns]
        moves += [move, -move]
    tried = moved(values + torch.cat(moves)).split(len(columns))
    for k, column in enumerate(columns):
        steps = [(factor, tried[2 * i][k], tried[2 * i + 1][k]) for i, factor in enumerate(STEPS)]
        for (part, signs), slopes in zip(looks, told, strict=True):
            far, seen, close = ((forth[part] - back[part]) / (2 * factor) for factor, forth, back in steps)
            _, forth, back = steps[1]
            bent = max(float((far - seen).norm()), float((forth + back - 2 * y)[part].norm()) / STEPS[1])
            change = float(seen.norm())
            if change > 0 and bent < AGREE * change:  # neither a kink, nor where a slope is infinite
                slope = reach[column] * slopes[:, k]
                size = float((signs @ seen).norm())
                yield column, min(float((signs @ one - slope).norm()) for one in (seen, close)) / size


def _pulled_back(
    evaluate: Callable[[Tensor], Tensor], values: Tensor, looks: list[Look]
) -> list[Tensor] | None:
    """Derivatives of the sums of each output's values with signs, ``(DRAWS, P)``, at values ``(1, P)``.

    Some backward passes do, where the whole Jacobian may be a matter of as many as there are outputs. None where there
    is no gradient at all, or writing in place has spoilt it.
    """
    leaf = values.clone().requires_grad_(True)
    found = []
    try:
        with torch.enable_grad():
            y = evaluate(leaf)[0]
        for part, signs in looks:
            sums = (signs @ y[part]).unbind()
            each = [torch.autograd.grad(one, leaf, retain_graph=True, allow_unused=True)[0] for one in sums]
            found.append(torch.cat([torch.zeros_like(values) if one is None else one for one in each]))
    except RuntimeError:
        return None
    return found
