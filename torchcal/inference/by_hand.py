r"""The log-posterior of the moment-matching likelihood with its gradient, written out in NumPy.

The density is that of `Problem.log_prob`, to which PyTorch finds a gradient by itself. For the few dozen numbers of a
typical problem recording small operations and going back over them takes most of the time; here the likelihood, the
prior's coordinates and, where outputs are polynomials, their moments have their gradients by hand. Anything else is
left to PyTorch.
"""

import numpy as np
import torch
from torch import Tensor

from torchcal import priors
from torchcal.inference.coordinates import Slopes
from torchcal.likelihoods import ABC, rounding
from torchcal.models import Problem
from torchcal.priors import Bounds
from torchcal.propagation.closed import QUIET, moment_slopes

__all__ = ["MOST_BY_HAND", "ByHand", "by_hand"]

MOST_BY_HAND = 2**19
"""Numbers in one array from which on PyTorch, whose operations use all cores, is as fast."""

_CONSTANT = (priors.Flat, priors.Uniform)
"""Priors that are a constant within bounds, which no sampler's coordinates leave."""


def by_hand(problem: Problem, otherwise: Slopes) -> Slopes:
    """The density of a problem with its gradient by hand where it has one for so many chains; else ``otherwise``."""
    if type(problem.likelihood) is not ABC or type(problem.prior) not in _CONSTANT:
        return otherwise
    if problem.y.device.type != "cpu" or problem.propagate.sd_floor is None or problem.likelihood.epsilon is None:
        return otherwise
    found = ByHand(problem, problem.likelihood.epsilon, problem.likelihood.gamma, problem.propagate.sd_floor)
    most = min(MOST_BY_HAND, problem.propagate.max_elements or MOST_BY_HAND)
    return lambda u: (found if len(u) * found.elements <= most else otherwise)(u)


class ByHand:
    """Log-density of unbounded coordinates u and its gradient.

    Args:
        problem: On the CPU, with the `ABC` likelihood and a prior that is constant within its bounds.
        epsilon: The likelihood's tolerance.
        gamma: The likelihood's ratio.
        floor: Of the sd, δ.
    """

    def __init__(
        self, problem: Problem, epsilon: float | Tensor, gamma: float | Tensor, floor: float
    ) -> None:
        observed, bounds = problem.observed, problem.prior.transform

        def pick(values: Tensor) -> np.ndarray:
            return (values if observed is None else values[observed]).numpy()

        self._moments = moment_slopes(problem.propagate, observed)
        self.elements = self._moments.elements
        self._y = pick(problem.y)
        self._noise = None if problem.noise is None else pick(problem.noise) ** 2
        tolerance, self._gamma = (
            torch.as_tensor(value, dtype=problem.y.dtype).detach().expand(self._y.shape).numpy()
            for value in (epsilon, gamma)
        )
        self._smallest, self._precision, self._floor = rounding(tolerance, gamma) ** 2, tolerance**-2.0, floor**2
        self._coordinates = None if bounds.free else _Coordinates(bounds)
        self._prior = float(problem.prior.log_prob(bounds.bound(torch.zeros_like(bounds.low))))

    def __call__(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Log-density ``(C,)`` and its gradient ``(C, P)`` at u ``(C, P)``."""
        value, slope = self._both(u.detach().numpy())
        return torch.from_numpy(value), torch.from_numpy(slope)

    def _both(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self._coordinates is None:
            value, *slopes = self._matched(*self._moments(u))
            return value + self._prior, self._moments.pulled_back(*slopes)
        alpha, scale, jacobian, steeper = self._coordinates(u)
        value, *slopes = self._matched(*self._moments(alpha))
        return value + jacobian + self._prior, self._moments.pulled_back(*slopes) * scale + steeper

    @QUIET
    def _matched(self, mean: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`likelihoods.abc_log_prob` ``(C,)`` and its slopes along mean and variance ``(C, n)``."""
        offset = mean - self._y
        squared = offset * offset
        left, unexplained = offset, squared
        if self._noise is not None:
            unexplained = squared - self._noise
            explained = unexplained < 0
            left, unexplained = np.where(explained, 0, offset), np.where(explained, 0, unexplained)
        residual = np.sqrt(unexplained + self._smallest)
        sd = np.sqrt(variance + self._floor)
        excess = sd - self._gamma * residual
        value = -0.5 * ((squared + excess * excess) @ self._precision)
        weighed = self._precision * excess
        return value, self._gamma * weighed * left / residual - self._precision * offset, -0.5 * weighed / sd


class _Coordinates:
    """`Bounds` without a whitening, in NumPy."""

    def __init__(self, bounds: Bounds) -> None:
        low, high = bounds.low.numpy(), bounds.high.numpy()
        self._low, self._high = np.isfinite(low), np.isfinite(high)
        self._both = self._low & self._high
        self._from, self._to = np.where(self._low, low, 0), np.where(self._high, high, 0)
        self._width = np.where(self._both, self._to - self._from, 1)
        self._log_width = np.log(self._width).sum()
        self._sides = self._low.astype(low.dtype) + self._high

    @QUIET
    def __call__(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of u ``(C, P)``: α and its slope ``(C, P)``, the summed log of that ``(C,)``, and its slope ``(C, P)``."""
        share = 1 / (1 + np.exp(-u))
        softened = np.logaddexp(0, u)  # softplus
        alpha = np.where(self._high, self._to - np.logaddexp(0, -u), u)
        alpha = np.where(self._low, self._from + softened, alpha)
        alpha = np.where(self._both, self._from + self._width * share, alpha)
        scale = np.where(self._high, 1 / (1 + np.exp(u)), 1)
        scale = np.where(self._low, share, scale)
        scale = np.where(self._both, self._width * share * (1 - share), scale)
        jacobian = self._log_width + (self._low * u - self._sides * softened).sum(-1)
        return alpha, scale, jacobian, self._low - self._sides * share
