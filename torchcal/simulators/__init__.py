"""Simulators: parameters, models written in torch, external codes, polynomial surrogates."""

from torchcal.simulators.parameter import Parameter, Scaling, free_parameters
from torchcal.simulators.static import Conditions, Simulator, check_parameters

__all__ = ["Conditions", "Parameter", "Scaling", "Simulator", "check_parameters", "free_parameters"]
