"""Inference: the maximum a posteriori, No-U-Turn sampling, and the functions a user calls."""

from torchcal.inference.additive import calibrate_additive
from torchcal.inference.calibrate import calibrate

__all__ = ["calibrate", "calibrate_additive"]
