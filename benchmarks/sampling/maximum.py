"""A plain search for the maximum, for what it would cost a peer to find it without torchcal."""

import numpy as np

from benchmarks.sampling.density import SMOOTHING, Arrays, _moments

STARTS = 8


def search(arrays: Arrays, seed: int = 0) -> float:
    """The smallest negative log-density that SciPy's least squares finds from a few starts.

    The ABC posterior under a flat prior is a sum of squares. Starts are normal means and spreads over two decades.
    """
    from scipy.optimize import least_squares

    moments = _moments(arrays, np)
    size, step = len(arrays.map), 1e-7

    def residuals(alpha: np.ndarray) -> np.ndarray:
        mean, variance = moments(alpha)
        off = mean - arrays.y
        wanted = arrays.gamma * np.sqrt(off**2 + (SMOOTHING * arrays.epsilon) ** 2)
        both = np.concatenate([off, np.sqrt(variance + arrays.floor**2) - wanted], -1)
        return both / arrays.epsilon

    def jacobian(alpha: np.ndarray) -> np.ndarray:
        moved = residuals(alpha + step * np.concatenate([np.eye(size), -np.eye(size)]))
        return ((moved[:size] - moved[size:]) / (2 * step)).T

    rng = np.random.default_rng(seed)
    leading = arrays.columns == 0
    best = np.inf
    for _ in range(STARTS):
        spread = np.where(leading, 0.3, 10 ** rng.uniform(-2, 0))
        start = np.clip(spread * rng.standard_normal(size), arrays.low + 0.01, arrays.high - 0.01)
        with np.errstate(all="ignore"):
            found = least_squares(residuals, start, jacobian, bounds=(arrays.low, arrays.high), max_nfev=300)
        best = min(best, float(found.cost))
    return best
