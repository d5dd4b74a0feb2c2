"""Whether a simulator differentiates: its derivatives beside differences of its outputs."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from torchcal.errors import SimulatorError
from torchcal.simulators.parameter import limits
from torchcal.simulators.static import Conditions, Simulator
from torchcal.simulators.trajectories import Trajectories

__all__ = ["check_slopes"]

#: Steps of differences, in the size of a parameter; how nearly those of the first two agree, and steps forth and back,
#: where there is no kink and no rounding; and by how much a derivative is off from all that is none, more than a kink
#: makes of that.
STEPS, AGREE, OFF = (1e-2, 1e-3, 1e-5), 0.05, 0.1
#: Combinations of the outputs that are derived.
DRAWS = 8


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

    Raises:
        SimulatorError: If they do.
    """
    if simulator.dear and not isinstance(simulator, Trajectories):
        return
    evaluate = simulator.at(x, outputs)
    with torch.no_grad():
        good = evaluate(values).detach()
    used = torch.ones(good.shape[-1], dtype=torch.bool) if kept is None else kept
    rows = len(next(iter(x.values())) if isinstance(x, Mapping) else x)
    parts = [k * rows + part.nonzero()[:, 0] for k, part in enumerate(used.split(rows)) if bool(part.any())]
    generator = torch.Generator().manual_seed(0)
    looks = [(part, torch.randint(2, (DRAWS, len(part)), generator=generator).double() * 2 - 1) for part in parts]

    def derive(values: Tensor, columns: list[int]) -> list[Tensor]:
        found = None if whole else _pulled_back(evaluate, values, looks)
        if found is not None:
            return [each[:, columns] for each in found]
        jacobian = simulator.linearise(x, values, outputs, columns).jacobian[0]
        return [signs @ jacobian[part] for part, signs in looks]

    asked = list(columns)
    for here in values[torch.isfinite(good[:, used]).all(-1)]:
        reach = _reach(simulator, here)
        judged = set()
        inside = [column for column in asked if reach[column] > 0]
        for column, off in _errors(evaluate, derive, here, reach, inside, looks):
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


def _reach(simulator: Simulator, values: Tensor) -> Tensor:
    """The size of every parameter, and no more than what is left to its bounds, ``(P,)``."""
    low, high = limits(simulator.parameters)
    width = high - low
    size = torch.where(values != 0, values.abs(), torch.where(width.isfinite(), width, torch.ones_like(width)))
    return torch.minimum(size, torch.minimum(values - low, high - values).clamp_min(0.0))


def _errors(
    evaluate: Callable[[Tensor], Tensor],
    derive: Callable[[Tensor, list[int]], list[Tensor]],
    values: Tensor,
    reach: Tensor,
    columns: list[int],
    looks: list[tuple[Tensor, Tensor]],
) -> Iterator[tuple[int, float]]:
    """By which part of the change derivatives at values ``(P,)`` are off, for each parameter that tells it.

    They may move from there by their ``reach`` times `STEPS`. Of each output, ``looks`` holds the places and the signs
    ``(DRAWS, m)`` with which its values are summed.
    """
    if not columns:
        return
    moves = []
    for factor in STEPS:
        moved = torch.zeros(len(columns), len(values), dtype=torch.float64)
        moved[range(len(columns)), columns] = factor * reach[columns]
        moves += [moved, -moved]
    with torch.no_grad():
        y, *tried = evaluate(torch.cat([values[None], values + torch.cat(moves)])).detach().split(
            [1, *[len(columns)] * len(moves)]
        )
    told = derive(values[None], columns)
    for k, column in enumerate(columns):
        steps = [(factor, tried[2 * i][k], tried[2 * i + 1][k]) for i, factor in enumerate(STEPS)]
        for (part, signs), slopes in zip(looks, told, strict=True):
            far, seen, close = ((forth[part] - back[part]) / (2 * factor) for factor, forth, back in steps)
            _, forth, back = steps[1]
            bent = max(float((far - seen).norm()), float((forth + back - 2 * y[0])[part].norm()) / STEPS[1])
            change = float(seen.norm())
            if change > 0 and bent < AGREE * change:  # neither a kink, nor where a slope is infinite
                slope = reach[column] * slopes[:, k]
                size = float((signs @ seen).norm())
                yield column, min(float((signs @ one - slope).norm()) for one in (seen, close)) / size


def _pulled_back(
    evaluate: Callable[[Tensor], Tensor], values: Tensor, looks: list[tuple[Tensor, Tensor]]
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
