"""Figures: functions that draw on matplotlib axes and return them.

They take plain tensors and predictions. None of them shows a figure or changes ``rcParams``. Colours are told
apart by colour-blind readers and, with line styles and lightness, in grey.
"""

from torchcal.plots.bands import additive_fit, fit
from torchcal.plots.corners import corner
from torchcal.plots.distributions import marginals
from torchcal.plots.errors import sd_against_error
from torchcal.plots.outputs import output_density
from torchcal.plots.parameters import parameter_density
from torchcal.plots.surfaces import surface

__all__ = [
    "additive_fit",
    "corner",
    "fit",
    "marginals",
    "output_density",
    "parameter_density",
    "sd_against_error",
    "surface",
]
