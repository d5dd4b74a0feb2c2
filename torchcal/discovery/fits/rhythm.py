"""Periods of what a fit leaves, for shapes of which a grid has too few values: frequencies over several decades."""

import math

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem

__all__ = ["rhythms"]

#: Fewest different values of what data lie along; frequencies to each wave more; how many peaks are told, and how far
#: they are apart at least, in waves; and sines of all data that are taken at most, in all and at a time.
LEAST, DENSE, PEAKS, APART, MOST, AT_ONCE = 24, 4, 3, 2.0, 2**27, 2**21
#: The slowest wave, in the longest run.
FEWEST = 1.5


def rhythms(problem: Problem, residual: Tensor) -> list[float]:
    """Periods of the strongest waves, of any phase in every output of every run, along time or what else data lie
    along: the conditions, where they are several and nothing rises from row to row.

    The spectrum is the least-squares one of uneven data (Lomb 1976, Astrophysics and Space Science 39, 447-462).

    Args:
        problem: The data.
        residual: What a fit leaves of them, whitened, ``(n,)``.
    """
    if not bool(residual.isfinite().all()):
        return []
    if problem.clock is not None:
        axes = [problem.clock[1]]
    else:
        axes = list(problem.recording.columns.T)
    return list(dict.fromkeys(period for axis in axes for period in _along(problem, residual, axis)))


def _along(problem: Problem, residual: Tensor, axis: Tensor) -> list[float]:
    along = [axis[problem.condition_of[places]] for places in problem.sequences]
    gaps = torch.cat([each.unique().diff() for each in along])
    span = max(float(each.max() - each.min()) for each in along)
    if len(gaps) < LEAST - 1:
        return []
    step = 1.0 / (DENSE * span)
    count = math.floor((0.5 / float(gaps.median()) - FEWEST / span) / step) + 1
    if count < 1 or count * problem.n > MOST:
        return []
    frequencies = FEWEST / span + step * torch.arange(count, dtype=torch.float64)
    power = torch.zeros(count, dtype=torch.float64)
    for places, at in zip(problem.sequences, along, strict=True):
        left, rows = residual[places] - residual[places].mean(), max(AT_ONCE // len(places), 1)
        power += torch.cat([_power(each, at, left) for each in frequencies.split(rows)])
    found: list[float] = []
    for _ in range(PEAKS):
        best = int(power.argmax())
        if not float(power[best]) > 0:
            break
        found.append(1.0 / float(frequencies[best]))
        power[(frequencies - frequencies[best]).abs() < APART / span] = 0.0
    return found


def _power(frequencies: Tensor, at: Tensor, left: Tensor) -> Tensor:
    """χ² that a wave of each frequency removes, ``(F,)``."""
    angle = 2 * math.pi * frequencies[:, None] * at
    phase = 0.5 * torch.atan2((2 * angle).sin().sum(1), (2 * angle).cos().sum(1))
    angle = angle - phase[:, None]
    waves = torch.stack([angle.cos(), angle.sin()])
    size = waves.square().sum(-1)
    return ((waves @ left).square() / size.where(size > 1e-9 * len(at), torch.inf)).sum(0)
