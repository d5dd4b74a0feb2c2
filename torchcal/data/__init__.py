"""Recordings: what was measured, under which conditions or in which runs, and how noisy it is."""

from torchcal.data.arrays import same_unit
from torchcal.data.recording import Recording
from torchcal.data.run import Run

__all__ = ["Recording", "Run", "same_unit"]
