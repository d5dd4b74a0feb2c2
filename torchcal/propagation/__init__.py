"""NISP: from α to the moments and samples of the outputs."""

from torchcal.propagation.closed import MomentSlopes, moment_slopes
from torchcal.propagation.convergence import PropagationCheck
from torchcal.propagation.nisp import NISP
from torchcal.propagation.rules import RuleChoice

__all__ = ["NISP", "MomentSlopes", "PropagationCheck", "RuleChoice", "moment_slopes"]
