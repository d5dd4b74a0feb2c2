"""Replicates that differ by blocks of rows: sweeps, days or samples with a level, or a gain, of their own.

In the order of the recording that looks like noise with a long memory, which hides whatever acts; but its values would
wander within a block too.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.misfit.noise import GRID
from torchcal.discovery.misfit.replicates import Replicates

__all__ = ["Jump", "jumps"]

#: Rows of a block at least, and for each jump; jumps at most, and rows with replicates up to which they are sought.
LEAST, EACH, MOST, LONG = 5, 10, 12, 2000
#: Log-likelihood that one jump costs, in the logarithm of the number of rows: its size and where it is.
COST = 1.5
#: Log odds against noise with a memory, from which on there are jumps. Of AR(1) noise, whatever its coefficient, one
#: recording in a hundred has as much.
SURER = 5.0
#: Powers of the row number, and times in which something fades as shares of the rows, that smooth drifts are made of.
POWERS, FADING = 3, (0.02, 0.05, 0.1, 0.2, 0.4)
#: Share of the largest jump below which another one is none: steps follow what wanders too.
SMALL = 0.2
#: Share of its norm that the means of the conditions leave of a jump's effect at least, for it to be seen.
SEEN = 1e-6
#: Variation of the data, in their size, from which on a gain does something else than an offset.
VARIED = 0.2
#: Share of the squares that is rounding.
ROUNDED = 1e-12


@dataclass(frozen=True)
class Jump:
    """A row from which on replicates have another level, or gain, up to the next jump.

    Attributes:
        row: Of the recording, from 1 on.
        height: How much higher the level is than before, in sd of what replicates differ by otherwise; of a gain in
            what all replicates are on average.
        gain: Whether it is one.
    """

    row: int
    height: float
    gain: bool

    def __str__(self) -> str:
        size = f"{100 * abs(self.height):.3g} %" if self.gain else f"{abs(self.height):.3g} sd"
        return f"{'up' if self.height > 0 else 'down'} by {size} from row {self.row} on"


def jumps(problem: Problem, own: Replicates, unit: Tensor) -> list[Jump]:
    """Rows at which replicates of one output jump; none where noise with or without a memory, or
    a smooth drift along the rows, explains them as well.

    Args:
        problem: Its rows are in the order of the recording.
        own: The replicates.
        unit: Of the noise, ``(n_total,)``, the same at identical conditions.
    """
    n, mean, units = len(own.places), problem.y[own.places] - own.off, [torch.ones_like(unit)]
    forms = [torch.ones_like(mean)]
    if n < 2 * LEAST or n > LONG:
        return []
    if bool((unit != unit[0]).any()):  # what a gain does looks like noise that grows
        units.append(unit)
    if float(mean.std()) > VARIED * float(mean.square().mean().sqrt()):
        forms.append(mean)
    fits, noise = [], -math.inf
    for each in units:
        if (told := own.memory(problem, each, GRID)) is None:
            return []
        scale = each[problem.index[own.places]]
        jacobian = float(own.share @ scale.log())
        drift = _drift(own, scale, problem.condition_of[own.places].double())
        noise = max(noise, float(told[0].max()) - jacobian, float(told[0][0]) - jacobian + drift)
        steps = [_Steps(own, scale, form) for form in forms]
        fits += [(float(told[0][0]) - jacobian + one.gained, k > 0, one) for k, one in enumerate(steps)]
    likely, gain, best = max(fits, key=lambda one: one[0])
    if likely - math.log(len(fits)) - noise <= SURER:
        return []
    heights = best.heights if gain else best.heights / best.sd
    rows = problem.condition_of[own.places[best.starts]] + 1
    large = heights.abs() >= SMALL * heights.abs().max()
    return [Jump(row, height, gain) for row, height in zip(rows[large].tolist(), heights[large].tolist(), strict=True)]


def _drift(own: Replicates, scale: Tensor, row: Tensor) -> float:
    """Log-likelihood that a smooth drift along the rows ``(n,)`` adds, less what it costs."""
    n, off = len(row), own.off / scale
    at, best = (row - row[0]) / float(row[-1] - row[0] or 1.0), 0.0
    powers = torch.stack([at**k for k in range(1, POWERS + 1)], dim=1)
    forms = [powers[:, :k] for k in range(1, POWERS + 1)]
    forms += [torch.exp(-at / share)[:, None] for share in FADING]
    for form in forms:
        design = own.beyond_means(form / scale[:, None])
        left = off - design @ torch.linalg.lstsq(design, off[:, None], driver="gelsd").solution[:, 0]
        share = max(float(left.square().sum() / off.square().sum().clamp_min(1e-300)), ROUNDED)
        best = max(best, -0.5 * own.freedom * math.log(share) - 0.5 * COST * form.shape[1] * math.log(n))
    return best


class _Steps:
    """Jumps of one form, added one by one, by least squares beside the means of all conditions.

    Attributes:
        gained: Log-likelihood that they add, less what they cost: of so many that it is largest.
        starts: Numbers of the replicates that they begin at, in order.
        heights: Of each, in the form.
        sd: Of what they leave, where replicates usually are.
    """

    def __init__(self, own: Replicates, scale: Tensor, form: Tensor) -> None:
        off, form = own.off / scale, form / scale
        n, whole = len(off), float(off.square().sum())
        start = torch.arange(LEAST, n - LEAST + 1)
        steps = own.beyond_means((torch.arange(n)[:, None] >= start) * form[:, None])
        beyond, left, chosen, best = steps, off, list[int](), (0.0, 0)
        for count in range(1, min(MOST, max(n // EACH, 2)) + 1):
            norm = beyond.square().sum(0)
            seen = norm > SEEN * float(form.square().sum())
            for place in chosen:
                seen &= (start - start[place]).abs() >= LEAST
            if not bool(seen.any()):
                break
            place = int(((beyond.T @ left).square() / norm).where(seen, -torch.inf).argmax())
            along = beyond[:, place] / norm[place].sqrt()
            left, beyond = left - along * (along @ left), beyond - along[:, None] * (along @ beyond)
            chosen.append(place)
            share = max(float(left.square().sum()) / max(whole, 1e-300), ROUNDED)
            best = max(best, (-0.5 * own.freedom * math.log(share) - COST * count * math.log(n), count))
        self.gained = best[0]
        places = sorted(chosen[: best[1]])
        self.starts = start[places]
        self.heights = torch.linalg.lstsq(steps[:, places], off[:, None]).solution[:, 0]
        left = off - steps[:, places] @ self.heights
        size = float((left.square().sum() / max(own.freedom - len(places), 1)).sqrt())
        self.sd = max(size * float(scale.median()), 1e-300)
