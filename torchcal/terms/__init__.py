"""Candidate physics: `Term`, and the built-in terms of each field."""

from torchcal.terms.electrical import electrical
from torchcal.terms.extend import extend
from torchcal.terms.hydraulics import hydraulics
from torchcal.terms.kinetics import kinetics
from torchcal.terms.mechanics import mechanics
from torchcal.terms.orbital import orbital
from torchcal.terms.sensor import sensor
from torchcal.terms.term import Term
from torchcal.terms.thermal import saturation_pressure, thermal

__all__ = [
    "Term",
    "electrical",
    "extend",
    "hydraulics",
    "kinetics",
    "mechanics",
    "orbital",
    "saturation_pressure",
    "sensor",
    "thermal",
]
