"""How many quadrature nodes a propagation takes."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcal import polychaos
from torchcal.checks import whole
from torchcal.errors import DomainError, ShapeError
from torchcal.propagation.convergence import first_as_good, has_stalled
from torchcal.propagation.rules import RuleChoice, gauss_counts, sparse_or_random

if TYPE_CHECKING:
    from torchcal.propagation.nisp import NISP

__all__ = ["choose", "exact_count"]

#: Nodes a germ to begin with where no number of them is enough.
ENOUGH = 16


def choose(propagate: "NISP", rule: polychaos.Rule | RuleChoice | int | None) -> RuleChoice:
    """The rule a user asked for, or enough nodes: exactly enough for polynomials, found by trial otherwise."""
    germs = propagate.pattern.num_germs
    if isinstance(rule, RuleChoice):
        return rule
    if isinstance(rule, polychaos.Rule):
        if rule.nodes.shape[1] != germs:
            raise ShapeError(f"Expected a rule with {germs} germs. Got one with {rule.nodes.shape[1]}.")
        if not rule.positive and propagate.order is None:
            raise DomainError(
                "Expected order= beside a rule with negative weights (a sparse grid): its variance comes "
                "from the expansion's coefficients. Got order=None. Pass order=, the grid's level at most."
            )
        return RuleChoice("given", len(rule.nodes), given=rule)
    if germs == 0:
        return RuleChoice("tensor", 1)
    if rule is not None:
        return RuleChoice("tensor", whole("rule", rule, 1, also="a torchcal.polychaos.Rule or None"), asked=True)
    exact = exact_count(propagate)
    if exact is not None and exact**germs <= propagate.max_nodes:
        return RuleChoice("tensor", exact)
    counts = gauss_counts(germs, propagate.max_nodes)
    if len(counts) < 3:
        return sparse_or_random(germs, propagate.max_nodes)
    return _by_trial(propagate, counts)


def exact_count(propagate: "NISP") -> int | None:
    """Gauss nodes per germ that integrate f² exactly: its degree is twice that of f in ξ."""
    if propagate.degree is None or bool(propagate.scaling.log.any()):
        return None
    degree = propagate.degree * max(1, propagate.pattern.order)
    # With a truncated expansion f Ψ_k is integrated, whose degree is lower.
    return degree + 1 if propagate.order is None else (degree + propagate.order) // 2 + 1


def _by_trial(propagate: "NISP", counts: list[int]) -> RuleChoice:
    """The smallest tensor rule whose moments at a few trial densities agree with the next one's.

    Where no two rules agree, as with a kink, or a pole that more nodes only come nearer to, it is one of `ENOUGH` nodes
    a germ; where finer rules cease to change the moments less, as of rounded outputs, the smallest of these; and where
    outputs cease to be finite as the nodes spread, the largest rule before. The maximum that is found with it is
    refined.
    """
    alpha = _trial_alpha(propagate)
    order, propagate.order = propagate.order, None
    previous: tuple[Tensor, Tensor] | None = None
    dead: Tensor | None = None
    changes: list[float] = []
    try:
        for count, smaller in zip(counts, [0, *counts], strict=False):
            propagate.set_rule(RuleChoice("tensor", count))
            with torch.no_grad():
                mean, variance = propagate.moments(alpha)
            sd = variance.sqrt()
            lost = ~torch.isfinite(mean + sd)
            dead = lost if dead is None else dead
            if bool(dead.all()) or bool((lost & ~dead).any()):
                return RuleChoice("tensor", max(smaller, 3))
            if previous is not None:
                scale = propagate.largest(torch.nan_to_num(torch.maximum(mean.abs(), sd), posinf=0.0))
                change = torch.maximum((mean - previous[0]).abs(), (sd - previous[1]).abs())
                if bool((change <= 1e-9 * scale)[~dead].all()):
                    return RuleChoice("tensor", smaller)
                changes.append(float((change / scale)[~dead].max()))
                if has_stalled(propagate, changes):
                    return RuleChoice("tensor", counts[first_as_good(changes)], stalled=True)
            previous = (mean, sd)
    finally:
        propagate.order = order
    return RuleChoice("tensor", max(count for count in counts if count <= ENOUGH))


def _trial_alpha(propagate: "NISP") -> Tensor:
    """Densities to try a rule on; for a trial spread of 1, 3 sd reach a bound, or 1 sd is one unit of scale."""
    low, high = propagate.scaling.bounds(propagate.free)
    spread = torch.where(torch.isfinite(low) & torch.isfinite(high), 1 / 3, 1.0).to(torch.float64)
    generator = torch.Generator().manual_seed(0)
    first_order = propagate.pattern.indices[propagate.pattern.columns].sum(-1) == 1
    size = torch.where(first_order, 1.0, 0.1).to(torch.float64) * spread[propagate.pattern.rows]
    size = propagate.trial_spread * size
    noise = torch.rand(3, propagate.num_alpha, generator=generator, dtype=torch.float64) * 0.5 + 0.5
    return noise * size
