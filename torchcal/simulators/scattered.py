"""Polynomials fitted to scattered points, where a grid over many dimensions would take too many.

Source: A. Cohen & G. Migliorati (2017), Optimal weighted least-squares methods, SMAI J. Comput. Math. 3, 181-203.
"""

import numpy as np
import torch
from torch import Tensor

from torchcal import polychaos
from torchcal.checks import whole
from torchcal.errors import DomainError

__all__ = ["check_points", "fit_scattered", "scatter"]

#: Points for each term at least: fewer than so many may lie where terms cannot be told apart.
LEAST = 2
#: Numbers in the least-squares problem at most, of which there are three of such a size: 3 GiB.
MOST = 2**27
#: Points that are drawn at once, and how often each is tried, of which half are taken.
PIECE, TRIES = 256, 40


def check_points(points: int, terms: int) -> int:
    """The number of points, or a `DomainError` where a polynomial of so many terms cannot be fitted to them."""
    points = whole("points", points, 1)
    if points < LEAST * terms:
        raise DomainError(
            f"Expected at least {LEAST} points for each of {terms} terms. Got points={points}. Give {LEAST * terms} or "
            "more, or a lower order."
        )
    if points * terms > MOST:
        raise DomainError(
            f"Expected points times terms up to {MOST}, which is what memory holds. Got {points} times {terms}. Give "
            "fewer points, or a lower order."
        )
    return points


def scatter(indices: Tensor, num: int, seed: int) -> Tensor:
    r"""Random points ``(num, D)`` in [-1, 1]^D, dense where the terms ``(K, D)`` together are large.

    .. math:: \eta \sim \frac{1}{K} \sum_k \tilde L_k(\eta)^2 \frac{d\eta}{2^D}

    with orthonormal :math:`\tilde L`, every term in turn, by rejection: in each dimension
    :math:`\tfrac12 \tilde L_n^2 \le 2 / (\pi \sqrt{1 - \eta^2})`, twice the density of the cosine of a uniform angle.
    """
    generator = np.random.default_rng([seed, 1])  # others than where the error is measured
    table = torch.arange(int(indices.max()) + 1)[:, None]
    parts = []
    for first in range(0, num, PIECE):  # row by row, so that fewer points are the first of more
        degree = indices[torch.arange(first, min(first + PIECE, num)) % len(indices)]
        even, at = torch.from_numpy(generator.random((*degree.shape, TRIES, 2))).unbind(-1)
        tried = torch.cos(np.pi * at)
        values = polychaos.evaluate(polychaos.LEGENDRE, table, tried.reshape(-1, 1)).reshape(*tried.shape, -1)
        value = values.gather(-1, degree[..., None, None].expand(*tried.shape, 1))[..., 0]
        density = 0.5 * (2 * degree[..., None] + 1) * value.square()
        good = even * 2.0 < density * np.pi * (1 - tried.square()).sqrt()
        place = good.int().argmax(-1, keepdim=True)  # the first; with a probability of 2^-TRIES there is none
        parts.append(tried.gather(-1, place)[..., 0])
    return torch.cat(parts)


def fit_scattered(values: Tensor, indices: Tensor, points: Tensor) -> Tensor:
    r"""Coefficients ``(outputs, K)`` by least squares with weights :math:`K / \sum_k \tilde L_k(\eta)^2`.

    Args:
        values: ``(outputs, num)``.
        indices: Multi-indices ``(K, D)``.
        points: As `scatter` gave them, ``(num, D)``.
    """
    norm = polychaos.norms(polychaos.LEGENDRE, indices).sqrt()
    psi = polychaos.evaluate(polychaos.LEGENDRE, indices, points) / norm
    weight = (len(indices) / psi.square().sum(1, keepdim=True)).sqrt()
    q, r = torch.linalg.qr(weight * psi)
    found = torch.linalg.solve_triangular(r, q.T @ (weight * values.T), upper=True)
    return found.T / norm
