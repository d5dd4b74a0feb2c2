"""Recordings: what was measured, under which conditions or in which runs, and how noisy it is."""

from torchcal.data.arrays import ROUNDING, same_unit
from torchcal.data.recording import Recording
from torchcal.data.run import Run

__all__ = ["ROUNDING", "Recording", "Run", "same_unit"]
