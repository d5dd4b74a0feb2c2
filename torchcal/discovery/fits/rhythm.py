"""Periods of what a fit leaves, for shapes of which a grid has too few values: frequencies over several decades."""

import math

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem

__all__ = ["rhythms"]

#: Fewest steps between the data of all runs, the slowest wave that is sought, in the longest run, and frequencies to
#: each wave more.
LEAST, SLOWEST, DENSE = 24, 1.5, 4
#: How many waves are told, and by how many in the longest run they differ at least.
PEAKS, APART = 3, 2.0
#: Angles of data that are taken at most, the slowest first, in all and at a time.
MOST, AT_ONCE = 2**25, 2**21


def rhythms(problem: Problem, residual: Tensor) -> list[float]:
    """Periods of the strongest waves, of any phase in every output of every run, along time or along a condition.

    The spectrum is the least-squares one of uneven data (Lomb 1976, Astrophysics and Space Science 39, 447-462).

    Args:
        problem: The data.
        residual: What a fit leaves of them, whitened, ``(n,)``.
    """
    recording = problem.recording
    if not bool(residual.isfinite().all()):
        return []
    axes = [recording.x["time"]] if problem.in_time else list(recording.columns.T)  # type: ignore[index]
    found = [wave for axis in axes for wave in _along(problem, residual, axis)]
    return [period for _, period in sorted(found, reverse=True)[:PEAKS]]


def _along(problem: Problem, residual: Tensor, axis: Tensor) -> list[tuple[float, float]]:
    """χ² that the strongest waves along values at every row remove, and their periods."""
    along = [axis[problem.condition_of[places]] for places in problem.sequences]
    gaps = torch.cat([each.unique().diff() for each in along])
    if len(gaps) < LEAST:
        return []
    span = max(float(each.max() - each.min()) for each in along)
    count = math.floor(DENSE * (0.5 * span / float(gaps.median()) - SLOWEST)) + 1
    count = min(count, MOST // problem.n)
    if count < 1:
        return []
    frequencies = (SLOWEST + torch.arange(count, dtype=torch.float64) / DENSE) / span
    power = torch.zeros_like(frequencies)
    for places, at in zip(problem.sequences, along, strict=True):
        left, rows = residual[places] - residual[places].mean(), max(AT_ONCE // len(places), 1)
        power += torch.cat([_power(each, at, left) for each in frequencies.split(rows)])
    found: list[tuple[float, float]] = []
    for _ in range(PEAKS):
        best = int(power.argmax())
        if not float(power[best]) > 0:
            break
        found.append((float(power[best]), 1.0 / float(frequencies[best])))
        power[(frequencies - frequencies[best]).abs() < APART / span] = 0.0
    return found


def _power(frequencies: Tensor, at: Tensor, left: Tensor) -> Tensor:
    """χ² that a wave of each frequency removes from what is left ``(m,)`` at some values, ``(F,)``."""
    angle = 2 * math.pi * frequencies[:, None] * at
    cos, sin = angle.cos(), angle.sin()
    even, odd = cos.square().sum(1) - 0.5 * len(at), (sin * cos).sum(1)  # half the sums of cos 2θ and sin 2θ
    turn, size = 0.5 * torch.atan2(odd, even), torch.hypot(even, odd)
    c, s = cos @ left, sin @ left
    along = torch.stack([c * turn.cos() + s * turn.sin(), s * turn.cos() - c * turn.sin()])
    norms = 0.5 * len(at) + torch.stack([size, -size])
    return (along.square() / norms.where(norms > 1e-9 * len(at), torch.inf)).sum(0)
