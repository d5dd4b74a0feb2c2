"""Samplers side by side: torchcal, Pyro, NumPyro, PyTUQ and emcee on the same posteriors."""
