"""Polynomial chaos: multi-indices, orthogonal bases and quadrature rules."""

from torchcal.polychaos.basis import HERMITE, LEGENDRE, Basis, evaluate, get_basis, norms
from torchcal.polychaos.multi_index import multi_indices
from torchcal.polychaos.quadrature import Rule, qmc_rule, smolyak_rule, tensor_rule

__all__ = [
    "HERMITE",
    "LEGENDRE",
    "Basis",
    "Rule",
    "evaluate",
    "get_basis",
    "multi_indices",
    "norms",
    "qmc_rule",
    "smolyak_rule",
    "tensor_rule",
]
