"""Figures: functions that draw on matplotlib axes and return them.

They take plain tensors and predictions. None of them shows a figure or changes ``rcParams``. Colours are told
apart by colour-blind readers and, with line styles and lightness, in grey.
"""

from torchcal.plots.bands import additive_fit, fit
from torchcal.plots.corners import corner
from torchcal.plots.discovery import (
    both_fits,
    detection_limits,
    discovery_overview,
    driver_values,
    held_out,
    held_out_scores,
    joint_map,
    missing_rate,
    needed_shift,
    ranking,
    residual_map,
)
from torchcal.plots.distributions import marginals
from torchcal.plots.errors import sd_against_error
from torchcal.plots.outputs import output_density
from torchcal.plots.parameters import parameter_density
from torchcal.plots.surfaces import surface

__all__ = [
    "additive_fit",
    "both_fits",
    "corner",
    "detection_limits",
    "discovery_overview",
    "driver_values",
    "fit",
    "held_out",
    "held_out_scores",
    "joint_map",
    "marginals",
    "missing_rate",
    "needed_shift",
    "output_density",
    "parameter_density",
    "ranking",
    "residual_map",
    "sd_against_error",
    "surface",
]
