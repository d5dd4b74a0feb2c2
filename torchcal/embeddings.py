r"""Embeddings λ(ξ; α): which parameters are uncertain, and how α spells their density.

Every embedding is a polynomial chaos expansion of the free parameters in scaled coordinates,

.. math:: \tilde\lambda_j(\xi; \alpha) = \sum_k C_{jk}(\alpha)\, \Psi_k(\xi),

with a pattern of which coefficients C may differ from zero. α lists those, parameter after parameter, each with
its mean (the leading coefficient) first.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 6-10.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal import polychaos
from torchcal.checks import whole
from torchcal.errors import EmbeddingError

__all__ = ["Embedding", "Gaussian", "IndependentGaussian", "Pattern", "PolynomialChaos", "Uniform"]

#: Germs of which all combinations of reversals are tried, 256; and how often more of them are gone through at most.
EXHAUSTED, SWEEPS = 8, 100


@dataclass(frozen=True)
class Pattern:
    """An embedding bound to the free parameters of a simulator.

    Attributes:
        names: The free parameters, in order.
        embedded: Those of them that are uncertain; germ number i belongs to ``embedded[i]``.
        basis: The one-dimensional polynomials and their germ.
        indices: Multi-indices of Ψ, ``(K, germs)``, the zero index first.
        rows: For each α, the number of the parameter it belongs to, ``(P,)``.
        columns: For each α, the number of its Ψ, ``(P,)``.
    """

    names: tuple[str, ...]
    embedded: tuple[str, ...]
    basis: polychaos.Basis
    indices: Tensor
    rows: Tensor
    columns: Tensor

    @property
    def num_alpha(self) -> int:
        """P, the number of coefficients α."""
        return len(self.rows)

    @property
    def num_germs(self) -> int:
        """The dimension of ξ."""
        return self.indices.shape[1]

    @property
    def order(self) -> int:
        """The total degree of the expansion."""
        return int(self.indices.sum(-1).max()) if self.num_germs else 0

    @property
    def leading(self) -> Tensor:
        """Which α are means, ``(P,)`` bool. They come in the order of the parameters."""
        return self.columns == 0

    @property
    def alpha_names(self) -> tuple[str, ...]:
        """``slope[0]`` for a mean, ``slope[xi1]`` for the germ of the first parameter, ``slope[xi1^2*xi2]``."""
        labels = []
        for row, column in zip(self.rows.tolist(), self.columns.tolist(), strict=True):
            powers = self.indices[column].tolist()
            factors = [f"xi{i + 1}" + (f"^{k}" if k > 1 else "") for i, k in enumerate(powers) if k]
            labels.append(f"{self.names[row]}[{'*'.join(factors) or '0'}]")
        return tuple(labels)

    def matrix(self, alpha: Tensor) -> Tensor:
        """C(α), shape ``(*batch, d, K)``, of α, shape ``(*batch, P)``."""
        shape = (*alpha.shape[:-1], len(self.names), len(self.indices))
        flat = alpha.new_zeros(*shape[:-2], shape[-2] * shape[-1])
        position = (self.rows * shape[-1] + self.columns).to(alpha.device)
        return flat.index_copy(-1, position, alpha).reshape(shape)

    def flip(self, alpha: Tensor, reference: Tensor) -> Tensor:
        r"""Reverse germs, draw by draw, so that each draw agrees best with a reference.

        Reversing a germ ξ_k changes the sign of every coefficient of odd degree in ξ_k and leaves the density of
        λ as it was. Of all combinations of reversals the one with the largest inner product with ``reference``
        is taken. Of more than `EXHAUSTED` germs it is the nearest such that no reversal of one germ makes it larger,
        from where coefficients of the first order agree: the same one of all draws of a density.

        Args:
            alpha: Draws, ``(*batch, P)``.
            reference: Usually the MAP, ``(P,)``.

        Returns:
            Draws of the same densities, ``(*batch, P)``.
        """
        if self.num_germs == 0:
            return alpha
        odd = (self.indices[self.columns] % 2).to(alpha)
        if self.num_germs <= EXHAUSTED:
            return _best_signs(alpha, reference, odd)
        first = (self.indices[self.columns].sum(-1) == 1).to(alpha)
        alpha = _germ_by_germ(alpha, reference * first, odd)
        for _ in range(SWEEPS):
            before, alpha = alpha, _germ_by_germ(alpha, reference, odd)
            if torch.equal(alpha, before):
                break
        return alpha

    def positive_last_row(self, alpha: Tensor) -> Tensor:
        """The paper's relabelling: the last embedded parameter's first-order coefficients are positive.

        Source: Sargsyan, Najm & Ghanem (2015), text under Eq. 12.
        """
        row = self.names.index(self.embedded[-1]) if self.embedded else -1
        first_order = self.indices[self.columns].sum(-1) == 1
        target = ((self.rows == row) & first_order).to(alpha)
        # A reference that is one on the last row and zero elsewhere asks for positive signs there alone.
        return self.flip(alpha, target)


def _germ_by_germ(alpha: Tensor, reference: Tensor, odd: Tensor) -> Tensor:
    for germ in range(odd.shape[1]):
        alpha = _best_signs(alpha, reference, odd[:, germ : germ + 1])
    return alpha


def _best_signs(alpha: Tensor, reference: Tensor, odd: Tensor) -> Tensor:
    combinations = torch.tensor(
        list(itertools.product((1.0, -1.0), repeat=odd.shape[1])), dtype=alpha.dtype, device=alpha.device
    )
    reversals = (combinations < 0).to(odd) @ odd.T  # how many reversed germs each alpha is odd in
    signs = 1 - 2 * (reversals % 2)
    score = (alpha * reference) @ signs.T
    return alpha * signs[score.argmax(-1)]


@dataclass(frozen=True)
class Embedding:
    """Base class of the embeddings: the parameters that carry model error, and an expansion order.

    Args:
        parameters: Names of the uncertain parameters; None for all free ones (in time: but initial states, and
            parameters that each run has one of). The other free parameters are inferred as plain unknowns.

    Raises:
        EmbeddingError: If ``parameters`` is no sequence of names.
    """

    parameters: Sequence[str] | None = None

    order = 1
    germ = "hermite"
    triangular = True

    def __post_init__(self) -> None:
        if self.parameters is None:
            return
        if isinstance(self.parameters, str):
            raise EmbeddingError(
                f"Expected a sequence of parameter names. Got the string {self.parameters!r}. "
                f"Write parameters=({self.parameters!r},)."
            )
        try:
            object.__setattr__(self, "parameters", tuple(self.parameters))
        except TypeError:
            raise EmbeddingError(
                f"Expected a sequence of parameter names. Got {self.parameters!r}. Write parameters=('k',), for a "
                "parameter that is called k."
            ) from None

    def sparing(self, names: Sequence[str], nuisance: Sequence[str]) -> "Embedding":
        """The same embedding; where it names no parameters, of ``names`` without those of ``nuisance``.

        Raises:
            EmbeddingError: If nothing would be left to embed.
        """
        if self.parameters is not None or self.order == 0 or not any(name in nuisance for name in names):
            return self
        left = tuple(name for name in names if name not in nuisance)
        if not left:
            raise EmbeddingError(
                "Expected a free parameter besides initial states and those of single runs to embed. Got "
                f"{list(names)} alone. Name those that are to carry model error: parameters=(...)."
            )
        return dataclasses.replace(self, parameters=left)

    def bind(self, names: Sequence[str]) -> Pattern:
        """Lay α out for the free parameters ``names``.

        Raises:
            EmbeddingError: If an embedded parameter does not exist, is not free, or is named twice.
        """
        names = tuple(names)
        embedded = names if self.parameters is None else tuple(self.parameters)
        unknown = [name for name in embedded if name not in names]
        if unknown:
            raise EmbeddingError(
                f"Expected embedded parameters among the free ones {list(names)}. Got {unknown}. "
                "Check the spelling, or free the parameter."
            )
        twice = sorted({name for name in embedded if embedded.count(name) > 1})
        if twice:
            raise EmbeddingError(f"Expected every embedded parameter once. Got {twice} more than once.")
        embedded = tuple(name for name in names if name in embedded)
        if self.order == 0:
            embedded = ()
        elif not embedded:
            raise EmbeddingError(
                "Expected at least one embedded parameter. Got none. Use PolynomialChaos(order=0) for "
                "parameters without model error."
            )
        indices = polychaos.multi_indices(len(embedded), self.order if embedded else 0)
        rows, columns = [], []
        for j, name in enumerate(names):
            for k, index in enumerate(indices.tolist()):
                if k == 0 or (name in embedded and self._carries(embedded.index(name), index)):
                    rows.append(j)
                    columns.append(k)
        return Pattern(
            names, embedded, polychaos.get_basis(self.germ), indices, torch.tensor(rows), torch.tensor(columns)
        )

    def _carries(self, germ: int, index: list[int]) -> bool:
        """Whether the parameter of germ number ``germ`` has a coefficient for this multi-index."""
        last = max(i for i, k in enumerate(index) if k)
        if self.triangular:
            return last <= germ
        return last == germ and sum(1 for k in index if k) == 1


class Gaussian(Embedding):
    r"""Multivariate normal λ, in the triangular form that removes rotations (Eq. 10).

    .. math:: \tilde\lambda_j = a_{j0} + \sum_{k \le j} a_{jk} \xi_k, \qquad \xi_k \sim N(0, 1)

    >>> Gaussian().bind(["lnA", "E"]).alpha_names
    ('lnA[0]', 'lnA[xi1]', 'E[0]', 'E[xi1]', 'E[xi2]')
    """


class IndependentGaussian(Embedding):
    r"""Independent normal parameters, :math:`\tilde\lambda_j = a_{j0} + a_{jj} \xi_j`.

    >>> IndependentGaussian().bind(["lnA", "E"]).alpha_names
    ('lnA[0]', 'lnA[xi1]', 'E[0]', 'E[xi2]')
    """

    triangular = False


class Uniform(Embedding):
    r"""Independent uniform parameters, :math:`\tilde\lambda_j = a_{j0} + a_{jj} \xi_j` with ξ_j on (−1, 1)."""

    germ = "legendre"
    triangular = False


@dataclass(frozen=True)
class PolynomialChaos(Embedding):
    """Polynomial chaos of any order, λ_j depending on ξ_1 … ξ_j (Eqs. 6-8).

    Order 0 is a parameter without model error: the limit in which the mean-only ABC likelihood is the
    additive one.

    Args:
        parameters: Names of the uncertain parameters; None for all free ones.
        order: Total degree.
        germ: ``"hermite"`` (normal) or ``"legendre"`` (uniform).
        triangular: Whether λ_j may depend on the germs of the parameters before it. If not, the parameters
            are independent.
    """

    order: int = 2
    germ: str = "hermite"
    triangular: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "order", whole("order", self.order, 0))
        if not isinstance(self.triangular, bool):
            raise EmbeddingError(f"Expected triangular as True or False. Got {self.triangular!r}.")
        polychaos.get_basis(self.germ)
