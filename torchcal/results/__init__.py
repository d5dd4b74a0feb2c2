"""Frozen results: predict, print, save and load, export."""

from torchcal.results.additive import AdditiveCalibration, sigma_unit
from torchcal.results.calibration import Calibration
from torchcal.results.diagnostics import Diagnostics, Mode, Quality
from torchcal.results.estimate import MapEstimate

__all__ = ["AdditiveCalibration", "Calibration", "Diagnostics", "MapEstimate", "Mode", "Quality", "sigma_unit"]
