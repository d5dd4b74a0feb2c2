"""Rules for expectations over several independent germs."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from torchcal.checks import as_seed, whole
from torchcal.errors import DomainError, ShapeError
from torchcal.polychaos._checks import limit_rows
from torchcal.polychaos.basis import Basis

__all__ = ["Rule", "qmc_rule", "smolyak_rule", "tensor_rule"]

# A merged weight this small against the terms it is the sum of is their rounding error (about 50 epsilon).
_CANCELLED = 1e-14


@dataclass(frozen=True, eq=False)
class Rule:
    r"""Nodes and weights: :math:`\langle h(\xi) \rangle \approx \sum_{q=1}^{Q} w_q\, h(\xi_q)`.

    Attributes:
        nodes: Germ values, float64, shape ``(Q, d)``.
        weights: float64, shape ``(Q,)``; they sum to 1.
        positive: Whether no weight is negative. Where one is, a variance computed with the rule can come out
            below zero.

    Raises:
        ShapeError: If the shapes are not ``(Q, d)`` and ``(Q,)``.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eq. 27.
    """

    nodes: Tensor
    weights: Tensor
    positive: bool

    def __post_init__(self) -> None:
        if self.nodes.ndim != 2 or self.weights.shape != self.nodes.shape[:1]:
            raise ShapeError(
                "Expected nodes of shape (Q, d) and weights of shape (Q,). "
                f"Got {self.nodes.shape=}, {self.weights.shape=}."
            )

    @property
    def dim(self) -> int:
        """Number of germs d."""
        return self.nodes.shape[1]

    @property
    def num(self) -> int:
        """Number of nodes Q."""
        return self.nodes.shape[0]


def _empty_rule() -> Rule:
    """The rule over no germ: the expectation of a constant is the constant."""
    return Rule(torch.from_numpy(np.zeros((1, 0))), torch.from_numpy(np.ones(1)), True)


def _grid(columns: list[np.ndarray]) -> np.ndarray:
    """All combinations, shape ``(product of lengths, d)``, the last column fastest; any number of columns."""
    total = math.prod(len(column) for column in columns)
    grid = np.empty((total, len(columns)), dtype=columns[0].dtype)
    inner = total
    for j, column in enumerate(columns):
        inner //= len(column)
        grid[:, j] = np.tile(np.repeat(column, inner), total // (inner * len(column)))
    return grid


def tensor_rule(basis: Basis, dim: int, n: int | Sequence[int]) -> Rule:
    """Full tensor grid of Gauss rules: exact up to degree 2n - 1 in each germ separately.

    Projecting a model of order p on a basis of order p needs ``n = p + 1``.

    Args:
        basis: The same univariate basis for every germ.
        dim: Number of germs d, >= 0.
        n: Points per germ, >= 1: one number, or one for each germ.

    Returns:
        A rule of ``n**dim`` (or the product of ``n``) nodes, the last germ varying fastest.

    Raises:
        DomainError: If ``dim`` is negative, ``n`` below 1, either is not a whole number, or the grid is too
            large.
        ShapeError: If ``n`` is a sequence whose length is not ``dim``.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eq. 27 and the text below it.
    """
    dim = whole("dim", dim, 0)
    if isinstance(n, Sequence) and not isinstance(n, str):
        counts = [whole(f"n[{j}]", value, 1) for j, value in enumerate(n)]
        if len(counts) != dim:
            raise ShapeError(f"Expected n to hold {dim} numbers, one for each germ. Got {len(counts)}.")
    else:
        counts = [whole("n", n, 1)] * dim
    limit_rows("the tensor grid", math.prod(counts), advice="use fewer points, smolyak_rule or qmc_rule")
    if dim == 0:
        return _empty_rule()
    nodes, weights = zip(*(basis.gauss(count) for count in counts), strict=True)
    grid = _grid([column.numpy() for column in nodes])
    product = _grid([column.numpy() for column in weights]).prod(axis=-1)
    return Rule(torch.from_numpy(grid), torch.from_numpy(product), True)


def _compositions(total: int, dim: int) -> Iterator[list[int]]:
    """All lists of ``dim`` whole numbers >= 0 that sum to ``total`` (stars and bars)."""
    for bars in itertools.combinations(range(total + dim - 1), dim - 1):
        edges = (-1, *bars, total + dim - 1)
        yield [right - left - 1 for left, right in itertools.pairwise(edges)]


def _rows_by_degree(lengths: list[int], dim: int) -> list[int]:
    """Nodes in all tensor grids of each total degree: coefficients of ``(sum_l lengths[l] z^l)^dim``."""
    rows = [1] + [0] * (len(lengths) - 1)
    for _ in range(dim):
        rows = [
            sum(rows[degree - step] * lengths[step] for step in range(degree + 1))
            for degree in range(len(lengths))
        ]
    return rows


def smolyak_rule(basis: Basis, dim: int, level: int) -> Rule:
    r"""Smolyak sparse grid by the combination technique: exact up to total degree 2 ``level`` + 1.

    .. math:: A_L = \sum_{\max(0, L - d + 1) \le |l| \le L} (-1)^{L - |l|} \binom{d - 1}{L - |l|}
              \; U_{l_1} \otimes \dots \otimes U_{l_d}

    :math:`U_l` is the shortest Gauss rule with an odd number of points that is exact up to degree 2l + 1 (1,
    3, 3, 5, 5, ... points). Odd rules share the node 0, which leaves fewer nodes and less cancellation than
    rules of l + 1 points. Nodes that occur more than once are merged.

    Args:
        basis: The same univariate basis for every germ.
        dim: Number of germs d, >= 0.
        level: Level L, >= 0. Level 0 is the single node 0.

    Returns:
        A rule whose weights may be negative; see ``positive``.

    Raises:
        DomainError: If ``dim`` or ``level`` is negative or not a whole number, or the grid is too large.

    Source: Smolyak (1963); combination formula and exactness: Novak & Ritter (1999), Constr. Approx. 15,
    499-522.
    """
    dim = whole("dim", dim, 0)
    level = whole("level", level, 0)
    if dim == 0:
        return _empty_rule()
    lengths = [step + 1 + step % 2 for step in range(level + 1)]
    lowest = max(0, level - dim + 1)
    rows = sum(_rows_by_degree(lengths, dim)[lowest:])
    limit_rows("the sparse grid before merging", rows, advice="lower the level, or use qmc_rule")
    # Nodes are compared by number, not by value: equal values of different rules get the same number.
    rules = {count: basis.gauss(count) for count in sorted(set(lengths))}
    pool = np.unique(np.concatenate([nodes.numpy() for nodes, _ in rules.values()]))
    numbers = {count: np.searchsorted(pool, nodes.numpy()) for count, (nodes, _) in rules.items()}
    weights_of = {count: weights.numpy() for count, (_, weights) in rules.items()}

    keys, terms = [], []
    for degree in range(lowest, level + 1):
        factor = (-1) ** (level - degree) * math.comb(dim - 1, level - degree)
        for levels in _compositions(degree, dim):
            counts = [lengths[step] for step in levels]
            keys.append(_grid([numbers[count] for count in counts]))
            terms.append(factor * _grid([weights_of[count] for count in counts]).prod(axis=-1))
    unique, inverse = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
    inverse, every = inverse.reshape(-1), np.concatenate(terms)
    weights = np.bincount(inverse, weights=every, minlength=len(unique))
    size = np.bincount(inverse, weights=np.abs(every), minlength=len(unique))
    keep = np.abs(weights) > _CANCELLED * size
    weights = weights[keep] / weights[keep].sum()
    return Rule(torch.from_numpy(pool[unique[keep]]), torch.from_numpy(weights), bool((weights >= 0).all()))


def qmc_rule(basis: Basis, dim: int, num: int, seed: int) -> Rule:
    r"""Quasi-Monte Carlo: scrambled Sobol points through the germ's inverse distribution function.

    For :math:`\exp(\sum_j \xi_j / 2)` with three germs the rms error falls as num^-0.8 (Hermite) and num^-1.4
    (Legendre) from 16 to 4096 nodes, against num^-0.5 for random draws. Powers of two are best.

    Args:
        basis: The same univariate basis for every germ.
        dim: Number of germs d, >= 0, at most 21201.
        num: Number of nodes, >= 1. With ``dim = 0`` one node is enough, and one is given.
        seed: Seed of the scrambling, >= 0; the global random state is not touched.

    Returns:
        A rule of equal weights.

    Raises:
        DomainError: If ``dim`` or ``seed`` is negative, ``num`` below 1, any is not a whole number, or
            ``dim`` or ``num`` is too large.

    Source: Sobol (1967); Owen (1998), J. Complexity 14, 466-489 (scrambling).
    """
    dim = whole("dim", dim, 0)
    num = whole("num", num, 1)
    seed = as_seed(seed)
    if dim > SobolEngine.MAXDIM:
        raise DomainError(f"Expected dim <= {SobolEngine.MAXDIM} for Sobol points. Got {dim=} (embed fewer).")
    limit_rows("the quasi-Monte Carlo rule", num, advice="use fewer nodes")
    if dim == 0:
        return _empty_rule()
    engine = SobolEngine(dim, scramble=True, seed=seed)
    # The engine rounds its first point to the global default dtype; the shift is that point exactly.
    first = engine.shift.to(torch.float64) / 2**engine.MAXBIT
    u = engine.draw(num, dtype=torch.float64)
    u[0] = first
    # Points are corners of cells of width 2^-30: the cells' centres are never 0, whose Hermite image is -inf.
    u = u + 0.5 / 2**engine.MAXBIT
    return Rule(basis.icdf(u), torch.full_like(u[:, 0], 1 / num), True)
