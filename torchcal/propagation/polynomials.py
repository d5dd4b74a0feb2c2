r"""Simulators that are polynomials in their parameters: coefficients in place of outputs at every node.

Where :math:`f_i(\lambda) = \sum_m B_{im} L_m(\tilde\lambda)`, sums over nodes are taken of the few :math:`L_m` and not
of the many outputs:

.. math:: \sum_q W_{qk} f_i(\lambda_q) = \sum_m B_{im} \Bigl(\sum_q W_{qk} L_m(\tilde\lambda_q)\Bigr)
"""

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcal import polychaos
from torchcal.simulators import ExternalSimulator, PolynomialSurrogate

if TYPE_CHECKING:
    from torchcal.propagation.nisp import NISP

__all__ = ["expansion"]

MOST_TERMS = 500
"""Terms beyond which nothing is gained."""

TOLERANCE = 1e-9
"""How well the polynomial must hold at points that it was not made from, relative to the largest value of an output."""

_DEAR = (ExternalSimulator, PolynomialSurrogate)
"""Simulators that are not called again once their coefficients are known, or that take them anyway."""

_SPARE = 8
"""Points to test it at."""


def expansion(propagate: "NISP") -> tuple[Tensor, Tensor] | None:
    """Multi-indices ``(M, d)`` and coefficients ``(M, n)`` of the outputs in Legendre products of scaled parameters.

    None where the simulator says nothing of a degree, a parameter is on a logarithmic scale, what it says does not
    hold, or there are fewer outputs than coefficients: then nodes are evaluated as of any other simulator.
    """
    degree, d = propagate.simulator.degree, len(propagate.free)
    if degree is None or d == 0 or bool(propagate.scaling.log.any()):
        return None
    count = math.comb(degree + d, d)
    if count > MOST_TERMS or (count > propagate._n and not isinstance(propagate.simulator, _DEAR)):
        return None
    terms = polychaos.multi_indices(d, degree)
    generator = torch.Generator().manual_seed(0)
    points = 2 * torch.rand(2 * count + _SPARE, d, dtype=torch.float64, generator=generator) - 1
    where = propagate._template
    with torch.no_grad():
        values = propagate._simulate(propagate.scaling.physical(points.to(where)))
    values = values.to(device="cpu", dtype=torch.float64)
    psi = polychaos.evaluate(polychaos.LEGENDRE, terms, points)
    if not bool(torch.isfinite(values).all()):
        return None
    table = torch.linalg.lstsq(psi[_SPARE:], values[_SPARE:], driver="gelsd").solution
    error = (psi[:_SPARE] @ table - values[:_SPARE]).abs().amax(0)
    tolerance = max(TOLERANCE, 1e3 * torch.finfo(where.dtype).eps)
    if not bool((error <= tolerance * propagate.largest(values.abs().amax(0))).all()):
        return None
    return terms, table
