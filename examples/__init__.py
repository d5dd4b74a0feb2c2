"""The studies of torchcal, as programs."""
