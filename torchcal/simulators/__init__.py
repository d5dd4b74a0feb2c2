"""Simulators: parameters, models written in torch, external codes, polynomial surrogates."""

from torchcal.simulators.build import build_surrogate
from torchcal.simulators.careful import careful, unknown_name
from torchcal.simulators.design import Evaluations
from torchcal.simulators.external import ExternalSimulator
from torchcal.simulators.held_out import HeldOutError
from torchcal.simulators.layout import Values
from torchcal.simulators.ode import ODESimulator
from torchcal.simulators.parameter import Parameter, Scaling, free_parameters, is_value_of, limits
from torchcal.simulators.slopes import check_slopes
from torchcal.simulators.solution import Solution
from torchcal.simulators.static import (
    Conditions,
    Linearisation,
    Simulator,
    asks_for_numbers,
    check_parameters,
    nameless_advice,
)
from torchcal.simulators.stepping import (
    fading,
    focused,
    magnified,
    may_change,
    outgrown,
    settled,
    settled_implicitly,
    shortened,
    spared,
    step_errors,
    workable,
)
from torchcal.simulators.surrogate import PolynomialSurrogate
from torchcal.simulators.trajectories import Trajectories

__all__ = [
    "Conditions",
    "Evaluations",
    "ExternalSimulator",
    "HeldOutError",
    "Linearisation",
    "ODESimulator",
    "Parameter",
    "PolynomialSurrogate",
    "Scaling",
    "Simulator",
    "Solution",
    "Trajectories",
    "Values",
    "asks_for_numbers",
    "build_surrogate",
    "careful",
    "check_parameters",
    "check_slopes",
    "fading",
    "focused",
    "free_parameters",
    "is_value_of",
    "limits",
    "magnified",
    "may_change",
    "nameless_advice",
    "outgrown",
    "settled",
    "settled_implicitly",
    "shortened",
    "spared",
    "step_errors",
    "unknown_name",
    "workable",
]
