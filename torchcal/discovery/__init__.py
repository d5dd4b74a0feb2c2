"""Discovery: detect a mismatch, locate it, name it, model it, prove it."""

from torchcal.discovery.diagnose import diagnose
from torchcal.discovery.findings.result import Diagnosis
from torchcal.discovery.misfit.embedded import Embedded
from torchcal.discovery.records import (
    Estimate,
    Experiment,
    Fit,
    Hypothesis,
    Limit,
    Location,
    MissingRate,
    NeededShift,
    NoiseModel,
    Score,
    Scores,
    Table,
)

__all__ = [
    "Diagnosis",
    "Embedded",
    "Estimate",
    "Experiment",
    "Fit",
    "Hypothesis",
    "Limit",
    "Location",
    "MissingRate",
    "NeededShift",
    "NoiseModel",
    "Score",
    "Scores",
    "Table",
    "diagnose",
]
