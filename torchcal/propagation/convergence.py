"""Whether output moments have converged in quadrature nodes and in the order of the expansion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcal.errors import PropagationWarning, warn
from torchcal.simulators import Trajectories

if TYPE_CHECKING:
    from torchcal.propagation.nisp import NISP

__all__ = ["SETTLED", "PropagationCheck", "compare", "first_as_good", "has_stalled", "warn_unsettled"]

SETTLED = 1e-7
"""Change of the moments, relative to the output's scale, with which enough nodes are found."""

RULES, LESS = 2, 2 / 3
"""Rules of which the largest change must be less than this part of that of as many before."""

SMALL, SMALL_DEAR = 1e-6, 1e-2
"""Changes from which on that is asked for: below what a check lets pass, it is rounding; and of other code, whose every
node is a run, whatever it is. Changes of a kink look no other for a while, and fall in the end."""


@dataclass(frozen=True)
class PropagationCheck:
    """How much the moments at some α change with a finer rule and with a longer expansion.

    Attributes:
        nodes: Number of nodes of the rule in use.
        finer_nodes: Number of nodes of the rule that it was held against: a finer one, unless there is none.
        mean_change: Largest change of a mean, relative to the larger of ``|mean|`` and sd over the outputs.
        sd_change: Largest change of an sd, on the same scale.
        truncated: Largest share of a variance that lies in terms above ``order``; 0 for the full variance.
    """

    nodes: int
    finer_nodes: int
    mean_change: float
    sd_change: float
    truncated: float


def has_stalled(propagate: "NISP", changes: Sequence[float]) -> bool:
    """Whether finer rules have ceased to change the moments less, as where outputs are rounded.

    Args:
        propagate: Whose moments.
        changes: Of each rule against the one before.
    """
    simulator = propagate.simulator
    small = SMALL_DEAR if simulator.dear and not isinstance(simulator, Trajectories) else SMALL
    before, last = changes[-2 * RULES : -RULES], changes[-RULES:]
    return len(before) == RULES and max(before) <= small and max(last) > LESS * max(before)


def first_as_good(changes: Sequence[float]) -> int:
    """Place of the first change that is no larger than about the last ones, which have stalled."""
    return next(i for i, change in enumerate(changes) if change <= 2 * max(changes[-RULES:]))


def compare(propagate: "NISP", alpha: Tensor) -> PropagationCheck:
    """Moments at α against those of a finer rule, and the expansion against the full variance."""
    pattern = propagate.pattern
    rule = propagate.rule_choice
    finer = propagate.copy(rule=rule.finer(pattern.num_germs, pattern.basis) or rule.coarser())
    with torch.no_grad():
        mean, variance = propagate.moments(alpha)
        other_mean, other_variance = finer.moments(alpha)
        truncated = 0.0
        floor = propagate.floor(mean).square().expand(mean.shape)
        if propagate.order is not None and bool((propagate.weights > 0).all()):
            full = propagate.copy(order=None, rule=None)
            full.refine(alpha)
            whole = full.moments(alpha)[1]
            lost = 1 - variance / torch.maximum(whole, floor)
            truncated = float(torch.where(whole > floor, lost, 0 * lost).max())
    scale = torch.maximum(propagate.largest(torch.maximum(mean.abs(), variance.sqrt())), floor.sqrt())
    return PropagationCheck(
        nodes=propagate.num_nodes,
        finer_nodes=finer.num_nodes,
        mean_change=float(((mean - other_mean).abs() / scale).max()),
        sd_change=float(((variance.sqrt() - other_variance.sqrt()).abs() / scale).max()),
        truncated=truncated,
    )


def warn_unsettled(
    result: PropagationCheck, order: int | None, tolerance: float, order_tolerance: float, *, stalled: bool = False
) -> None:
    """Warn of what has not converged, with the numbers; ``stalled`` says that more nodes do not help."""
    if not max(result.mean_change, result.sd_change) <= tolerance:
        if math.isnan(result.mean_change + result.sd_change):
            told = (
                f"The simulator has no finite output at some of {result.nodes} or {result.finer_nodes} quadrature "
                "nodes, which lie where the parameters' density reaches. Give bounds or transform='log' that keep it "
                "where the simulator works, or embed another parameter."
            )
        else:
            advice = "Pass a larger rule= (or, to NISP, max_nodes=)."
            if stalled:
                advice = (
                    "Somewhat more nodes do not lessen that: the outputs look rounded, or noisy, or have a kink. Give "
                    "them with more digits, tighten the tolerance of what computes them, or pass rule=."
                )
            told = (
                f"With {result.nodes} quadrature nodes the output's mean is off by {result.mean_change:.2g} and "
                f"its sd by {result.sd_change:.2g} of the output's scale, against {result.finer_nodes} nodes "
                f"(tolerance {tolerance:.0e}). {advice}"
            )
        warn(told, PropagationWarning)
    if result.truncated > order_tolerance:
        warn(
            f"An expansion of order {order} leaves out {result.truncated:.1%} of the output's variance "
            f"(tolerance {order_tolerance:.0%}). Use order=None for the full variance.",
            PropagationWarning,
        )
