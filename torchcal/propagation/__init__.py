"""NISP: from α to the moments and samples of the outputs."""

from torchcal.propagation.convergence import PropagationCheck
from torchcal.propagation.nisp import NISP
from torchcal.propagation.rules import RuleChoice

__all__ = ["NISP", "PropagationCheck", "RuleChoice"]
