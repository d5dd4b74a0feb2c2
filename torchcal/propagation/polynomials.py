r"""Simulators that are polynomials in their parameters: coefficients in place of outputs at every node.

Where :math:`f_i(\lambda) = \sum_m B_{im} L_m(\tilde\lambda)`, sums over nodes are taken of the few :math:`L_m` and not
of the many outputs:

.. math:: \sum_q W_{qk} f_i(\lambda_q) = \sum_m B_{im} \Bigl(\sum_q W_{qk} L_m(\tilde\lambda_q)\Bigr)
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcal import polychaos
from torchcal.errors import PropagationWarning, warn
from torchcal.simulators import ExternalSimulator, PolynomialSurrogate

if TYPE_CHECKING:
    from torchcal.propagation.nisp import NISP

__all__ = ["expansion", "interpolating"]

MOST_TERMS = 500
"""Terms beyond which nothing is gained."""

TOLERANCE, REFUTED = 1e-9, 1e-5
"""How well the polynomial must hold at points that it was not made from, relative to the largest value of an output;
and what is more than the rounding of a simulator of single precision."""

_DEAR = (ExternalSimulator, PolynomialSurrogate)
"""Simulators that are not called again once their coefficients are known, or that take them anyway."""

_SPARE = 8
"""Points to test it at."""


@dataclass(frozen=True)
class Expansion:
    """Outputs in Legendre products of scaled parameters.

    Attributes:
        terms: Multi-indices ``(M, d)``.
        table: Coefficients ``(M, n)``.
        pays: Whether products cost less than outputs: they are fewer, or the simulator is dear.
    """

    terms: Tensor
    table: Tensor
    pays: bool


def expansion(propagate: "NISP") -> tuple[Expansion | None, int | None]:
    """The outputs as a polynomial, found at random points and held against others, and its degree in the parameters.

    None where the simulator says nothing of a degree, a parameter is on a logarithmic scale, or there are too many
    terms: then nodes are evaluated as of any other simulator. Where what it says does not hold, the degree is None too.

    Warns:
        PropagationWarning: Where it does not hold.
    """
    degree, d = propagate.simulator.degree, len(propagate.free)
    if degree is None or d == 0 or bool(propagate.scaling.log.any()):
        return None, degree
    count = math.comb(degree + d, d)
    if count > MOST_TERMS:
        return None, degree
    terms = polychaos.multi_indices(d, degree)
    generator = torch.Generator().manual_seed(0)
    points = 2 * torch.rand(2 * count + _SPARE, d, dtype=torch.float64, generator=generator) - 1
    where = propagate._template
    with torch.no_grad():
        values = propagate._simulate(propagate.scaling.physical(points.to(where)))
    values = values.to(device="cpu", dtype=torch.float64)
    psi = polychaos.evaluate(polychaos.LEGENDRE, terms, points)
    if not bool(torch.isfinite(values).all()):
        return None, degree
    table = torch.linalg.lstsq(psi[_SPARE:], values[_SPARE:], driver="gelsd").solution
    error = (psi[:_SPARE] @ table - values[:_SPARE]).abs().amax(0)
    tolerance = max(TOLERANCE, 1e3 * torch.finfo(where.dtype).eps)
    size = propagate.largest(values.abs().amax(0))
    if bool((error > REFUTED * size).any()):  # the same words every time, so that they are told once
        warn(
            f"Expected outputs that are polynomials of degree {degree} in the parameters, as degree= says. Got others, "
            "which are taken as those of any simulator: drop degree=.",
            PropagationWarning,
        )
        return None, None
    if not bool((error <= tolerance * size).all()):
        return None, degree
    return Expansion(terms, table, count <= propagate._n or isinstance(propagate.simulator, _DEAR)), degree


def interpolating(values: Tensor, weights: Tensor) -> Tensor:
    """Rows of a rule's nodes that determine an expansion by themselves, ``(K,)``, as many as it has terms.

    Approximate Fekete points: the rows of the weighted matrix that pivoted orthogonalisation takes first.

    Args:
        values: Orthonormal polynomials at the nodes, ``(Q, K)``.
        weights: Of the nodes, ``(Q,)``, positive.

    Source: Bos, De Marchi, Sommariva & Vianello (2010), SIAM J. Numer. Anal. 48, 1984-1999.
    """
    rest = values * weights.sqrt()[:, None]
    chosen = []
    for _ in range(values.shape[1]):
        chosen.append(int(rest.square().sum(1).argmax()))
        along = rest[chosen[-1]] / rest[chosen[-1]].norm()
        rest = rest - (rest @ along)[:, None] * along
    return torch.tensor(chosen)
