"""Total-degree multi-indices."""

import itertools
import math

import torch
from torch import Tensor

from torchcal.checks import whole
from torchcal.polychaos._checks import limit_rows

__all__ = ["multi_indices"]


def multi_indices(dim: int, order: int) -> Tensor:
    r"""List the multi-indices of total degree up to ``order``.

    .. math:: \{ k \in \mathbb{N}_0^d : k_1 + \dots + k_d \le p \}, \qquad K = \frac{(d + p)!}{d!\,p!}

    They come by degree, and within a degree in descending lexicographic order: the zero index first, then
    the unit vectors :math:`e_1, \dots, e_d`, then :math:`2 e_1, e_1 + e_2, \dots`. A higher order therefore
    only appends rows.

    Args:
        dim: Number of germs d, >= 0. With none there is one index, of shape ``(1, 0)``.
        order: Highest total degree p, >= 0.

    Returns:
        ``int64`` tensor of shape ``(K, dim)``.

    Raises:
        DomainError: If ``dim`` or ``order`` is negative or not a whole number, or the set is too large.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eq. 8; K below Eq. 27.

    >>> multi_indices(2, 2).tolist()
    [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]]
    """
    dim = whole("dim", dim, 0)
    order = whole("order", order, 0)
    limit_rows("the multi-index set", math.comb(dim + order, dim), advice="lower the order")
    rows = []
    for degree in range(order + 1):
        for factors in itertools.combinations_with_replacement(range(dim), degree):
            row = [0] * dim
            for j in factors:
                row[j] += 1
            rows.append(row)
    return torch.tensor(rows, dtype=torch.int64).reshape(len(rows), dim)
