"""A calibrated base that explains nothing: there is no mismatch to speak of where nothing matches."""

import torch

from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.verdicts.decision import Decision

__all__ = ["is_lost", "misfit_in_spreads"]

#: RMSE of a calibrated base, in the data's spread, from which on it explains nothing.
NO_BETTER = 0.95
#: Share of χ² by which a fit must be worse than a constant's to be so.
WORSE = 1e-3


def is_lost(search: Search, decision: Decision) -> bool:
    """Whether the calibrated base explains no more than a constant would, and no name tells why.

    Where noise may be all there is, it must be worse than a constant, since data of noise alone leave any base as good.
    """
    if decision.best is None and _worse_than_constant(search):
        return True
    return decision.verdict == "unexplained" and misfit_in_spreads(search) > NO_BETTER and not _is_constant(search)


def misfit_in_spreads(search: Search) -> float:
    """RMSE of the calibrated base, in the spread of the data."""
    found = search.base
    return float((found.residual / search.problem.recording.spread[found.problem.index]).square().mean().sqrt())


def _worse_than_constant(search: Search) -> bool:
    """Whether a constant of each output fits better than the calibrated base: never where the base holds constants."""
    found = search.base
    outputs = found.problem.output_of
    columns = found.whitening(torch.stack([(outputs == k).double() for k in outputs.unique()], dim=-1))
    y = found.whitening.vector(found.problem.y)
    left = y - columns @ torch.linalg.lstsq(columns, y[:, None]).solution[:, 0]
    return found.chi2 > (1 + WORSE) * float(left.square().sum())


def _is_constant(search: Search) -> bool:
    """Whether the calibrated base is the mean of each output, as one is that has no more to say."""
    found, recording = search.base, search.problem.recording
    weight = found.whitening.sd.square().reciprocal()
    for k in found.problem.output_of.unique():
        mine = found.problem.output_of == k
        mean = float((weight[mine] * found.problem.y[mine]).sum() / weight[mine].sum())
        spread = recording.spread[found.problem.index[mine]]
        if bool(((found.y[mine] - mean).abs() > (1 - NO_BETTER) * spread).any()):
            return False
    return True
