"""Figures of a diagnosis: both fits, where the mismatch sits, the ranking, and the proof.

Everything is taken as plain tensors or as any object with the attributes that are named, so that a figure can be
drawn again from stored numbers. The base is orange, dashed or open; the accepted model blue, solid or filled.
"""

from torchcal.plots.discovery.fits import both_fits
from torchcal.plots.discovery.hypotheses import ranking
from torchcal.plots.discovery.limits import detection_limits
from torchcal.plots.discovery.overview import FigurePart, discovery_overview, figure_parts
from torchcal.plots.discovery.pieces import ACCEPTED, BASE, HELD_OUT, MOST_POINTS
from torchcal.plots.discovery.proof import held_out, held_out_scores
from torchcal.plots.discovery.residuals import driver_values, joint_map, residual_map
from torchcal.plots.discovery.shifts import missing_rate, needed_shift

__all__ = [
    "ACCEPTED",
    "BASE",
    "HELD_OUT",
    "MOST_POINTS",
    "FigurePart",
    "both_fits",
    "detection_limits",
    "discovery_overview",
    "driver_values",
    "figure_parts",
    "held_out",
    "held_out_scores",
    "joint_map",
    "missing_rate",
    "needed_shift",
    "ranking",
    "residual_map",
]
