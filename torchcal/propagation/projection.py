"""A quadrature rule made ready for moments: its nodes, and how outputs there make an expansion."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcal import polychaos
from torchcal.propagation import choice, polynomials
from torchcal.propagation.rules import RuleChoice

if TYPE_CHECKING:
    from torchcal.propagation.nisp import NISP

__all__ = ["Prepared", "prepare"]


@dataclass(frozen=True)
class Prepared:
    """A rule, and what is computed from it once.

    Attributes:
        nodes: Germs, ``(Q, germs)``.
        weights: Of the nodes, ``(Q,)``.
        psi: The embedding's basis at the nodes, ``(Q, K)``.
        carriers: The same at the nodes that moments take, ``(C, K)``.
        projection: From outputs at those to an orthonormal expansion, ``(C, k)``; None where the variance is a weighted
            sum of squares.
        affine: Projected Legendre products of degree 1 from (1, α), ``(1 + P, k M)``; None where there are higher ones.
    """

    nodes: Tensor
    weights: Tensor
    psi: Tensor
    carriers: Tensor
    projection: Tensor | None
    affine: Tensor | None


def prepare(propagate: "NISP", rule_choice: RuleChoice) -> Prepared:
    """A rule for a propagation, in float64."""
    pattern = propagate.pattern
    basis, germs = pattern.basis, pattern.num_germs
    rule = rule_choice.build(basis, germs)
    projection = None
    whole = _whole_order(propagate, rule_choice)
    order = propagate.order if propagate.order is not None else rule_choice.carried_order or whole
    psi = carriers = polychaos.evaluate(basis, pattern.indices, rule.nodes)
    few = _interpolated(propagate, whole, order, rule)
    if few is not None:
        carriers, projection = psi[few[0]], few[1]
    elif order is not None and germs:
        terms = polychaos.multi_indices(germs, order)
        values = polychaos.evaluate(basis, terms, rule.nodes)
        projection = values * rule.weights[:, None] / polychaos.norms(basis, terms).sqrt()
    affine = None if projection is None else _affine_map(propagate, carriers, projection)
    return Prepared(rule.nodes, rule.weights, psi, carriers, projection, affine)


def _whole_order(propagate: "NISP", rule_choice: RuleChoice) -> int | None:
    """Degree of a polynomial's whole expansion in the germs, where the rule has nodes enough for it."""
    exact, degree = choice.exact_count(propagate), propagate.degree
    if not propagate._is_polynomial or exact is None or not degree:
        return None
    if rule_choice.kind != "tensor" or rule_choice.size < exact:
        return None
    return degree * max(1, propagate.pattern.order)


def _interpolated(
    propagate: "NISP", whole: int | None, order: int | None, rule: polychaos.Rule
) -> tuple[Tensor, Tensor] | None:
    """Few of the nodes ``(K,)`` and the projection ``(K, K)`` from them onto a polynomial's whole expansion.

    None where that is not wanted, or would not be fewer than all of them.
    """
    germs = propagate.pattern.num_germs
    if whole is None or order is None or order < whole or math.comb(germs + whole, whole) >= rule.num:
        return None
    terms = polychaos.multi_indices(germs, whole)
    values = polychaos.evaluate(propagate.pattern.basis, terms, rule.nodes)
    values = values / polychaos.norms(propagate.pattern.basis, terms).sqrt()
    chosen = polynomials.interpolating(values, rule.weights)
    return chosen, torch.linalg.inv(values[chosen]).T


def _affine_map(propagate: "NISP", psi: Tensor, projection: Tensor) -> Tensor | None:
    """Projected Legendre products of degree 1 from (1, α), ``(1 + P, k M)``; None where there are higher ones."""
    terms, pattern = propagate._polynomial, propagate.pattern
    if terms is None or int(terms.sum(-1).max()) > 1:
        return None
    along = projection.T @ psi  # (k, K)
    found = psi.new_zeros(1 + pattern.num_alpha, len(along), len(terms))
    for m, powers in enumerate(terms.tolist()):
        if not any(powers):
            found[0, :, m] = projection.sum(0)
            continue
        own = (pattern.rows == powers.index(1)).nonzero()[:, 0]
        found[1 + own, :, m] = along[:, pattern.columns[own]].T
    return found.flatten(1)
