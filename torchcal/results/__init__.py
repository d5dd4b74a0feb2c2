"""Frozen results: predict, print, save and load, export."""

from torchcal.results.calibration import AdditiveCalibration, Calibration, MapEstimate
from torchcal.results.diagnostics import Diagnostics, Quality

__all__ = ["AdditiveCalibration", "Calibration", "Diagnostics", "MapEstimate", "Quality"]
