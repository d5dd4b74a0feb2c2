"""NISP: from α to the moments and samples of the outputs."""

from torchcal.propagation.nisp import NISP, PropagationCheck

__all__ = ["NISP", "PropagationCheck"]
