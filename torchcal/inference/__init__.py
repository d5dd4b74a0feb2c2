"""Inference: the maximum a posteriori, No-U-Turn sampling, and the functions a user calls."""

from torchcal.inference.calibrate import calibrate, calibrate_additive

__all__ = ["calibrate", "calibrate_additive"]
