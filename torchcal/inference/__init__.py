"""Inference: the maximum a posteriori, No-U-Turn sampling, and the functions a user calls."""

from torchcal.inference.additive import calibrate_additive
from torchcal.inference.calibrate import calibrate
from torchcal.inference.many import calibrate_many

__all__ = ["calibrate", "calibrate_additive", "calibrate_many"]
