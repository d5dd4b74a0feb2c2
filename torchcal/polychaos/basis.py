"""Univariate orthogonal bases with their germs, and their products over several germs."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.polynomial.hermite_e import hermegauss
from numpy.polynomial.legendre import leggauss
from torch import Tensor

from torchcal.checks import whole
from torchcal.errors import DomainError, ShapeError

__all__ = ["HERMITE", "LEGENDRE", "Basis", "evaluate", "get_basis", "norms"]

# 170! is the largest factorial, and 369 points the longest Gauss-Hermite rule, that normal float64 can hold.
_MAX_HERMITE_NORM = 170
_MAX_HERMITE_POINTS = 369
#: Rules kept. A search asks for the same few again and again, and NumPy's eigenvalues of 369 nodes take 1 ms alone, but
#: 140 ms where its linear algebra has more threads than idle cores.
_KEPT = 128


@dataclass(frozen=True)
class Basis:
    r"""Polynomials :math:`\psi_k` that are orthogonal under the density of their germ :math:`\xi`.

    .. math:: \langle \psi_i \psi_j \rangle = \int \psi_i(\xi)\,\psi_j(\xi)\,\pi(\xi)\,d\xi
              = \delta_{ij} \langle \psi_i^2 \rangle

    Use the two instances: ``HERMITE`` (probabilists' :math:`He_k`, :math:`\xi \sim N(0, 1)`) and
    ``LEGENDRE`` (:math:`P_k`, :math:`\xi \sim U(-1, 1)`), or :func:`get_basis`. The germ is dimensionless.

    Attributes:
        name: ``"hermite"`` or ``"legendre"``.
        most_points: Most nodes of a Gauss rule; None for no limit.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 6-7.
    """

    name: str
    _recurrence: Callable[[int], tuple[float, float]] = field(repr=False)
    _norm: Callable[[int], float] = field(repr=False)
    _rule: Callable[[int], tuple[np.ndarray, np.ndarray]] = field(repr=False)
    _inverse_cdf: Callable[[Tensor], Tensor] = field(repr=False)
    _draw: Callable[..., Tensor] = field(repr=False)
    most_points: int | None = None

    def evaluate(self, xi: Tensor, order: int) -> Tensor:
        r"""Evaluate :math:`\psi_0, \dots, \psi_p` by their three-term recurrence.

        Args:
            xi: Germ values, shape ``(...)``, floating; differentiable, any device.
            order: Highest degree p, >= 0.

        Returns:
            Shape ``(..., order + 1)``, dtype and device of ``xi``.

        Raises:
            DomainError: If ``order`` is negative or not a whole number, or ``xi`` is not floating.

        >>> HERMITE.evaluate(torch.tensor(2.0), 3).tolist()      # 1, x, x^2 - 1, x^3 - 3 x
        [1.0, 2.0, 3.0, 2.0]
        """
        order = whole("order", order, 0)
        if not xi.is_floating_point():
            raise DomainError(f"Expected floating germ values. Got {xi.dtype=} (convert with xi.double()).")
        columns = [torch.ones_like(xi)]
        if order > 0:
            columns.append(xi)
        for k in range(1, order):
            slope, back = self._recurrence(k)
            columns.append(slope * xi * columns[-1] - back * columns[-2])
        return torch.stack(columns, dim=-1)

    def norms(self, order: int) -> Tensor:
        r"""Squared norms :math:`\langle \psi_k^2 \rangle`: k! for Hermite, 1/(2k + 1) for Legendre.

        Args:
            order: Highest degree p, >= 0.

        Returns:
            float64, shape ``(order + 1,)``.

        Raises:
            DomainError: If ``order`` is negative, not a whole number, or above 170 with Hermite, where k!
                leaves the range of float64.

        >>> HERMITE.norms(4).tolist()
        [1.0, 1.0, 2.0, 6.0, 24.0]
        """
        order = whole("order", order, 0)
        return torch.tensor([self._norm(k) for k in range(order + 1)], dtype=torch.float64)

    def gauss(self, n: int) -> tuple[Tensor, Tensor]:
        r"""Gauss rule under the germ's density: exact for polynomials of degree up to 2n - 1.

        .. math:: \langle h \rangle \approx \sum_{q=1}^{n} w_q\, h(\xi_q), \qquad \sum_q w_q = 1

        Args:
            n: Number of points, >= 1.

        Returns:
            Nodes (ascending) and weights (positive), float64, shape ``(n,)`` each.

        Raises:
            DomainError: If ``n`` is below 1, not a whole number, or above 369 with Hermite, where the outer
                weights leave the range of float64.

        Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eq. 27.

        >>> [column.tolist() for column in HERMITE.gauss(2)]
        [[-1.0, 1.0], [0.5, 0.5]]
        """
        nodes, weights = self._rule(whole("n", n, 1))  # which are kept for the next call
        return torch.from_numpy(nodes.copy()), torch.from_numpy(weights / weights.sum())

    def sample(
        self, shape: Sequence[int], generator: torch.Generator, dtype: torch.dtype = torch.float64
    ) -> Tensor:
        """Draw independent germ values.

        Args:
            shape: Shape of the result.
            generator: Source of randomness; its device is the result's device.
            dtype: Floating dtype of the result.

        Returns:
            Tensor of shape ``shape``.
        """
        return self._draw(tuple(shape), generator=generator, dtype=dtype, device=generator.device)

    def icdf(self, u: Tensor) -> Tensor:
        """Map probabilities to germ values with the germ's inverse distribution function.

        Args:
            u: Probabilities in [0, 1], shape ``(...)``, floating. With Hermite 0 and 1 give -inf and inf.

        Returns:
            Shape ``(...)``, dtype and device of ``u``.

        Raises:
            DomainError: If a value of ``u`` is outside [0, 1] or NaN, or ``u`` is not floating.
        """
        if not u.is_floating_point():
            raise DomainError(f"Expected floating probabilities. Got {u.dtype=} (convert with u.double()).")
        if not bool(((u >= 0) & (u <= 1)).all()):
            raise DomainError("Expected probabilities in [0, 1]. Got values outside or NaN (check u).")
        return self._inverse_cdf(u)


def _hermite_recurrence(k: int) -> tuple[float, float]:
    return 1.0, float(k)


def _hermite_norm(k: int) -> float:
    if k > _MAX_HERMITE_NORM:
        raise DomainError(
            f"Expected a Hermite order <= {_MAX_HERMITE_NORM}. Got {k}, whose norm k! overflows (lower it)."
        )
    return float(math.factorial(k))


@functools.lru_cache(_KEPT)
def _hermite_rule(n: int) -> tuple[np.ndarray, np.ndarray]:
    if n > _MAX_HERMITE_POINTS:
        raise DomainError(
            f"Expected n <= {_MAX_HERMITE_POINTS} Gauss-Hermite points. Got n={n}, whose outer weights "
            "underflow (use fewer points, or quasi-Monte Carlo)."
        )
    # numpy scales a column of zeros by numbers that underflow from n = 302: harmless.
    with np.errstate(under="ignore"):
        return hermegauss(n)


@functools.lru_cache(_KEPT)
def _legendre_rule(n: int) -> tuple[np.ndarray, np.ndarray]:
    return leggauss(n)


def _legendre_recurrence(k: int) -> tuple[float, float]:
    return (2 * k + 1) / (k + 1), k / (k + 1)


def _legendre_norm(k: int) -> float:
    return 1.0 / (2 * k + 1)


def _uniform_icdf(u: Tensor) -> Tensor:
    return 2 * u - 1


def _uniform_draw(
    shape: tuple[int, ...], *, generator: torch.Generator, dtype: torch.dtype, device: torch.device
) -> Tensor:
    return 2 * torch.rand(shape, generator=generator, dtype=dtype, device=device) - 1


# Named functions, not lambdas, so that a basis can be pickled with a result.
HERMITE = Basis(
    "hermite",
    _hermite_recurrence,
    _hermite_norm,
    _hermite_rule,
    torch.special.ndtri,
    torch.randn,
    most_points=_MAX_HERMITE_POINTS,
)
LEGENDRE = Basis("legendre", _legendre_recurrence, _legendre_norm, _legendre_rule, _uniform_icdf, _uniform_draw)

_BY_NAME = {"hermite": HERMITE, "hg": HERMITE, "legendre": LEGENDRE, "lu": LEGENDRE}


def get_basis(name: str | Basis) -> Basis:
    """Find a basis by its name; a ``Basis`` is handed back as it is.

    Args:
        name: ``"hermite"`` or ``"legendre"``, or the paper's short names ``"HG"`` and ``"LU"``; case does not
            matter.

    Raises:
        DomainError: If there is no such basis.
    """
    if isinstance(name, Basis):
        return name
    basis = _BY_NAME.get(name.lower()) if isinstance(name, str) else None
    if basis is None:
        raise DomainError(f"Expected a basis out of {sorted(_BY_NAME)}. Got {name!r} (use one of them).")
    return basis


def _check_indices(indices: Tensor) -> int:
    """Return the highest degree of any single germ in ``indices``."""
    if indices.ndim != 2:
        raise ShapeError(f"Expected indices of shape (K, d). Got {indices.shape=} (see multi_indices).")
    if indices.is_floating_point() or indices.is_complex() or indices.dtype == torch.bool:
        raise DomainError(f"Expected whole-number indices. Got {indices.dtype=} (convert with .long()).")
    if indices.numel() == 0:
        return 0
    if int(indices.min()) < 0:
        raise DomainError(f"Expected degrees >= 0. Got {int(indices.min())} in indices (see multi_indices).")
    return int(indices.max())


_MANY = 20_000
"""Values from which on the arithmetic costs more than the calls."""


def evaluate(basis: Basis, indices: Tensor, xi: Tensor) -> Tensor:
    r"""Evaluate the multivariate polynomials :math:`\Psi_k(\xi) = \prod_j \psi_{k_j}(\xi_j)`.

    Args:
        basis: The same univariate basis for every germ.
        indices: Multi-indices, shape ``(K, d)``, whole numbers; moved to the device of ``xi``.
        xi: Germ values, shape ``(..., d)``, floating; differentiable, any device.

    Returns:
        Shape ``(..., K)``, dtype and device of ``xi``.

    Raises:
        ShapeError: If ``indices`` is not ``(K, d)`` or ``xi`` does not end in ``d``.
        DomainError: If ``indices`` holds a negative degree or is not of whole numbers, or ``xi`` is not
            floating.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eq. 8 and the line below it.

    >>> indices = torch.tensor([[0, 0], [1, 1], [2, 0]])
    >>> evaluate(HERMITE, indices, torch.tensor([2.0, 3.0])).tolist()    # 1, x y, x^2 - 1
    [1.0, 6.0, 3.0]
    """
    order = _check_indices(indices)
    count, dim = indices.shape
    if xi.ndim == 0 or xi.shape[-1] != dim:
        raise ShapeError(f"Expected xi of shape (..., {dim}), as indices have. Got {xi.shape=}.")
    if dim and xi.numel() // dim * count > _MANY:
        return _by_prefixes(basis, indices, xi, order)
    table = basis.evaluate(xi, order)
    columns = indices.to(device=xi.device, dtype=torch.int64)
    result = xi.new_ones((*xi.shape[:-1], count))
    for j in range(dim):
        result = result * table[..., j, :].index_select(-1, columns[:, j])
    return result


def _by_prefixes(basis: Basis, indices: Tensor, xi: Tensor, order: int) -> Tensor:
    """The same, one product a polynomial: most are another one of the set times one factor more."""
    one = torch.ones_like(xi[..., 0])
    factors = [basis.evaluate(x, order).unbind(-1) for x in xi.unbind(-1)]
    known: dict[tuple[tuple[int, int], ...], Tensor] = {(): one}
    columns = []
    for row in indices.tolist():
        prefix: tuple[tuple[int, int], ...] = ()
        for j, degree in enumerate(row):
            if degree == 0:
                continue
            longer = (*prefix, (j, degree))
            if longer not in known:
                known[longer] = known[prefix] * factors[j][degree] if prefix else factors[j][degree]
            prefix = longer
        columns.append(known[prefix])
    return torch.stack(columns, dim=-1)


def norms(basis: Basis, indices: Tensor) -> Tensor:
    r"""Squared norms :math:`\langle \Psi_k^2 \rangle = \prod_j \langle \psi_{k_j}^2 \rangle`.

    Args:
        basis: The same univariate basis for every germ.
        indices: Multi-indices, shape ``(K, d)``, whole numbers.

    Returns:
        float64, shape ``(K,)``, on the device of ``indices``.

    Raises:
        ShapeError: If ``indices`` is not ``(K, d)``.
        DomainError: If ``indices`` holds a negative degree or is not of whole numbers, or a norm overflows.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eq. 26 (denominator).

    >>> norms(HERMITE, torch.tensor([[0, 0], [3, 2]])).tolist()
    [1.0, 12.0]
    """
    table = basis.norms(_check_indices(indices)).to(indices.device)
    result = table[indices.long()].prod(dim=-1)
    if not bool(torch.isfinite(result).all()):
        raise DomainError("Expected norms within float64. Got an infinite product (lower the degrees).")
    return result
