"""Sampling times and inputs that the families share."""

import numpy as np

from benchmarks.concealed.families.base import Array


def uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """One number; log-uniform where both ends are positive and far apart."""
    if low > 0 and high / low > 3:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return float(rng.uniform(low, high))


def times(rng: np.random.Generator, length: float, low: int = 80, high: int = 200) -> Array:
    """Sampling times from 0 to ``length``: evenly spaced in four cases of five, else uneven."""
    number = int(rng.integers(low, high + 1))
    grid = np.linspace(0.0, length, number)
    if rng.random() < 0.2:
        grid[1:-1] += rng.uniform(-0.35, 0.35, number - 2) * grid[1]
    return np.round(grid, 9)


def sines(rng: np.random.Generator, t: Array, size: float, slow: float, fast: float, number: int = 3) -> Array:
    """A sum of sines of angular frequencies between ``slow`` and ``fast`` (1/unit of t), largest value near size."""
    weights = rng.uniform(0.4, 1.0, number)
    rates = np.exp(rng.uniform(np.log(slow), np.log(fast), number))
    phases = rng.uniform(0, 2 * np.pi, number)
    return size * sum(w * np.sin(r * t + f) for w, r, f in zip(weights, rates, phases, strict=True)) / weights.sum()


def steps(rng: np.random.Generator, t: Array, low: float, high: float, number: int = 4) -> Array:
    """Levels held for a while, with ramps of a few samples between them."""
    edges = np.sort(rng.uniform(0.05, 0.95, number - 1)) * t[-1]
    levels = rng.uniform(low, high, number)
    # Neighbouring levels that are alike excite nothing.
    for i in range(1, number):
        if abs(levels[i] - levels[i - 1]) < 0.3 * (high - low):
            levels[i] = low + (levels[i] - low + 0.5 * (high - low)) % (high - low)
    ramp = t[-1] / 60
    total = np.full_like(t, levels[0])
    for edge, before, after in zip(edges, levels[:-1], levels[1:], strict=True):
        total += (after - before) * np.clip((t - edge) / ramp, 0.0, 1.0)
    return total
