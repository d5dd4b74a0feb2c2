"""Which quadrature rule a propagation uses, and the next finer one to hold it against."""

import math
from dataclasses import dataclass, replace

from torchcal import polychaos
from torchcal.errors import DomainError

__all__ = ["RuleChoice", "gauss_counts", "sparse_or_random"]

_COUNTS = (2, 3, 4, 5, 6, 7, 8, 10, 12, 16, 20, 26, 34, 44, 58, 76, 100, 128)


@dataclass(frozen=True)
class RuleChoice:
    """A family of quadrature rules and a size.

    Attributes:
        kind: ``"tensor"`` (size: Gauss nodes per germ), ``"smolyak"`` (size: level), ``"qmc"`` (size: number of
            points) or ``"given"`` (a user's own rule).
        size: The size.
        seed: Of the scrambling of quasi-Monte Carlo points.
        given: The user's own rule.
        asked: Whether a user asked for this size, so that a calibration keeps to it.
        stalled: Whether more nodes did not lessen the change of the moments.
    """

    kind: str
    size: int
    seed: int = 0
    given: polychaos.Rule | None = None
    asked: bool = False
    stalled: bool = False

    def build(self, basis: polychaos.Basis, germs: int) -> polychaos.Rule:
        """Nodes and weights."""
        if self.given is not None:
            return self.given
        if self.kind == "smolyak":
            return polychaos.smolyak_rule(basis, germs, self.size)
        if self.kind == "qmc":
            return polychaos.qmc_rule(basis, germs, self.size, seed=self.seed)
        return polychaos.tensor_rule(basis, germs, self.size)

    def finer(self, germs: int, basis: polychaos.Basis) -> "RuleChoice | None":
        """The next finer rule to hold this one against; None where Gauss rules have no more nodes."""
        most = math.inf if basis.most_points is None else basis.most_points
        if self.given is not None:
            count = len(self.given.nodes)
            return RuleChoice("tensor", int(min(max(2, math.ceil((2 * count) ** (1 / max(1, germs)))), most)))
        if self.kind == "smolyak":
            return replace(self, size=self.size + 1)
        if self.kind == "qmc":
            return replace(self, size=2 * self.size, seed=self.seed + 1)
        size = int(min(max(self.size + 2, math.ceil(1.3 * self.size)), most))
        return replace(self, size=size, stalled=False) if size > self.size else None

    def coarser(self) -> "RuleChoice":
        """A rule of fewer nodes, to hold a tensor rule against that is the finest."""
        return replace(self, size=max(1, int(self.size / 1.3)))

    def expansion_order(self, germs: int) -> int:
        """The highest total degree of an expansion that the rule projects on without much aliasing."""
        if self.kind == "smolyak":
            return self.size
        if self.kind == "tensor":
            return max(1, self.size - 1)
        # A user's own or random points: as a tensor grid of as many, and no more than they resolve by far.
        return max(1, min(10, math.floor(self.size ** (1 / max(1, germs)) + 1e-9) - 1))

    @property
    def carried_order(self) -> int | None:
        """The total degree of the expansion that a sparse grid can carry; None where weights are positive."""
        return self.size if self.kind == "smolyak" else None


def gauss_counts(germs: int, max_nodes: int) -> list[int]:
    """Numbers of Gauss nodes per germ to try, whose tensor grid stays within ``max_nodes``."""
    if max_nodes < 2:
        raise DomainError(f"Expected max_nodes of at least 2. Got {max_nodes!r}.")
    return [count for count in _COUNTS if count**germs <= max_nodes]


def sparse_or_random(germs: int, max_nodes: int) -> RuleChoice:
    """A sparse grid of the highest level that fits, or quasi-Monte Carlo points where only level 1 would."""
    best = 0
    for level in range(1, 6):
        # A cheap lower bound on the grid's size, so that a grid far too large is never built.
        if math.comb(germs + level, level) > max_nodes:
            break
        if len(polychaos.smolyak_rule(polychaos.HERMITE, germs, level).nodes) > max_nodes:
            break
        best = level
    return RuleChoice("smolyak", best) if best >= 2 else RuleChoice("qmc", max_nodes)
