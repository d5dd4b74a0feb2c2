r"""Moments of outputs and their gradient, written out in NumPy.

PyTorch takes most of its time for a few thousand numbers to record operations and to go back over them. Sums over nodes
are written out here, and where outputs are polynomials
:math:`f_i = \sum_m B_{im} \prod_j L_{m_j}(\tilde\lambda_j)`, with :math:`\tilde\lambda` at a node linear in α,
everything is.
"""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchcal.propagation.nisp import NISP

__all__ = ["QUIET", "MomentSlopes", "moment_slopes"]

QUIET = np.errstate(all="ignore")
"""What is not finite is told by the result. Simulators keep their own warnings."""


def moment_slopes(propagate: "NISP", observed: Tensor | None) -> "MomentSlopes":
    """Moments of the wanted outputs, ``observed (n,)`` bool or None for all, in the way that suits the simulator."""
    return (_Traced if propagate._table is None else _Polynomial)(propagate, observed)


class MomentSlopes(ABC):
    """Mean and variance as of `NISP.moments`, and the way back from slopes along them to slopes along α.

    Attributes:
        elements: Numbers that the largest array holds for each α.
    """

    def __init__(self, propagate: "NISP") -> None:
        projection = propagate._projection
        self._projection = None if projection is None else projection.T.contiguous().numpy()  # (k, S)
        self._weights = propagate.weights.numpy()
        self._psi = propagate._psi if projection is None else propagate._carriers
        self.elements = len(self._psi) * propagate._width

    def __call__(self, alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance ``(C, n)`` at α ``(C, P)``, which `pulled_back` refers to from then on."""
        return self._summed(self._outputs(alpha))

    @QUIET
    def _summed(self, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self._projection is not None:
            mean, self._offset = outputs[:, 0], outputs[:, 1:]
            return self._turned(mean), self._turned((self._offset * self._offset).sum(1))
        mean = self._weights @ outputs
        self._offset = outputs - mean[:, None]
        return self._turned(mean), self._turned(self._weights @ (self._offset * self._offset))

    @QUIET
    def pulled_back(self, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Slopes along α ``(C, P)`` from those along mean and variance ``(C, n)``."""
        first, second = self._turned(mean)[:, None], 2 * self._turned(variance)[:, None] * self._offset
        if self._projection is not None:
            return self._back(np.concatenate([first, second], 1))
        return self._back(self._weights[:, None] * (first + second))

    @abstractmethod
    def _outputs(self, alpha: np.ndarray) -> np.ndarray:
        """Outputs at nodes, or their projection, second axis; the others are what `_turned` makes of ``(C, n)``."""

    @abstractmethod
    def _back(self, slope: np.ndarray) -> np.ndarray:
        """Slopes along α ``(C, P)`` from those along `_outputs`."""

    @staticmethod
    @abstractmethod
    def _turned(values: np.ndarray) -> np.ndarray:
        """Between ``(C, n)`` and the order of axes of the outputs."""

    def _projected(self, values: np.ndarray) -> np.ndarray:
        return values if self._projection is None else self._projection @ values

    def _projected_back(self, slope: np.ndarray) -> np.ndarray:
        return slope if self._projection is None else self._projection.T @ slope


class _Traced(MomentSlopes):
    """Of any simulator, whose own gradient is PyTorch's."""

    def __init__(self, propagate: "NISP", observed: Tensor | None) -> None:
        super().__init__(propagate)
        self._propagate = propagate
        self._observed = None if observed is None else observed.numpy()

    def _outputs(self, alpha: np.ndarray) -> np.ndarray:
        with torch.enable_grad():
            self._leaf = torch.from_numpy(alpha).requires_grad_(True)
            self._traced = self._propagate._outputs(self._leaf, self._psi)
        outputs = self._traced.detach().numpy()
        return self._projected(outputs if self._observed is None else outputs[..., self._observed])

    def _back(self, slope: np.ndarray) -> np.ndarray:
        slope = self._projected_back(slope)
        if self._observed is not None:
            whole = np.zeros(self._traced.shape, slope.dtype)
            whole[..., self._observed] = slope
            slope = whole
        target = (self._traced * torch.from_numpy(slope)).sum()  # with grad_outputs=, PyTorch would import SymPy first
        return torch.autograd.grad(target, self._leaf)[0].numpy()

    @staticmethod
    def _turned(values: np.ndarray) -> np.ndarray:
        return values


class _Polynomial(MomentSlopes):
    """Of outputs with known coefficients. Chains are the last axis, so that degrees are picked as whole blocks."""

    def __init__(self, propagate: "NISP", observed: Tensor | None) -> None:
        super().__init__(propagate)
        terms, table, pattern = propagate._polynomial, propagate._table, propagate.pattern
        if terms is None or table is None:
            raise ValueError("Expected outputs that are polynomials of known coefficients. Got others.")
        self._degrees = terms.T.cpu().numpy()  # (d, M)
        self._table = (table if observed is None else table[:, observed]).T.contiguous().numpy()  # (n, M)
        matrix = pattern.matrix(torch.eye(propagate.num_alpha, dtype=table.dtype))
        place = torch.einsum("pdk,sk->dsp", matrix, self._psi)
        self._shape = (place.shape[0], place.shape[1])  # (d, S)
        self._place = place.flatten(0, 1).contiguous().numpy()  # (d S, P)
        self._room: _Room | None = None

    @QUIET
    def _outputs(self, alpha: np.ndarray) -> np.ndarray:
        if self._room is None or self._room.chains != len(alpha):
            self._room = _Room(self._shape, self._degrees, len(alpha), alpha.dtype)
        room = self._room
        np.matmul(self._place, alpha.T, out=room.at_nodes.reshape(len(self._place), -1))
        _legendre(room)
        for j, degree in enumerate(self._degrees):
            np.take(room.values[j], degree, axis=0, out=room.factors[j], mode="clip")  # any other mode copies
        features = room.features
        np.copyto(features, room.factors[0])
        for factor in room.factors[1:]:
            features *= factor
        projected = self._projected(features.reshape(len(features), -1, len(alpha)))
        return (self._table @ projected.reshape(len(projected), -1)).reshape(-1, *projected.shape[1:])

    def _back(self, slope: np.ndarray) -> np.ndarray:
        room = self._room
        if room is None:
            raise ValueError("Expected the moments before their slopes. Got slopes first.")
        slope = (self._table.T @ slope.reshape(len(slope), -1)).reshape(-1, *slope.shape[1:])
        slope = self._projected_back(slope).reshape(room.features.shape)
        for j, degree in enumerate(self._degrees):
            part = np.take(room.slopes[j], degree, axis=0, out=room.features, mode="clip")
            part *= slope
            for i, factor in enumerate(room.factors):
                if i != j:
                    part *= factor
            np.sum(part, axis=0, out=room.along[j])
        return room.along.reshape(len(self._place), -1).T @ self._place

    @staticmethod
    def _turned(values: np.ndarray) -> np.ndarray:
        return values.T


class _Room:
    """Arrays for one number of chains, used again and again: to ask the system for them takes longer than to fill them.

    Attributes:
        at_nodes: Scaled parameters ``(d, S C)``.
        values: Legendre polynomials of them ``(d, order + 1, S C)``.
        slopes: Their derivatives.
        factors: Those of every term, ``(d, M, S C)``.
        features: Products of these ``(M, S C)``.
        along: Slopes along the scaled parameters ``(d, S C)``.
    """

    def __init__(self, shape: tuple[int, int], degrees: np.ndarray, chains: int, dtype: np.dtype) -> None:
        (size, nodes), terms, orders = shape, degrees.shape[1], int(degrees.max()) + 1
        self.chains = chains
        self.at_nodes, self.along = np.empty((2, size, nodes * chains), dtype)
        self.values, self.slopes = np.zeros((2, size, orders, nodes * chains), dtype)
        self.values[:, 0] = 1
        self.slopes[:, 1:2] = 1
        self.factors = np.empty((size, terms, nodes * chains), dtype)
        self.features = np.empty((terms, nodes * chains), dtype)


def _legendre(room: _Room) -> None:
    """Legendre polynomials and their slopes by their recurrences, degree by degree."""
    x, values, slopes, rest = room.at_nodes, room.values, room.slopes, room.along
    values[:, 1:2] = x[:, None]
    for k in range(1, values.shape[1] - 1):
        np.multiply(x, values[:, k], out=values[:, k + 1])
        values[:, k + 1] *= (2 * k + 1) / (k + 1)
        np.multiply(values[:, k - 1], k / (k + 1), out=rest)
        values[:, k + 1] -= rest
        np.multiply(values[:, k], 2 * k + 1, out=slopes[:, k + 1])
        slopes[:, k + 1] += slopes[:, k - 1]
