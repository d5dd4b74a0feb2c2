"""Recordings: what was measured, under which conditions, and how noisy it is."""

from torchcal.data.recording import Recording

__all__ = ["Recording"]
