"""torchcal: calibrate a simulation that is wrong, and find the physics that it leaves out."""

from torchcal import embeddings, errors, likelihoods, models, polychaos, priors, results
from torchcal.data import Recording
from torchcal.errors import TorchcalError, TorchcalWarning
from torchcal.inference import calibrate, calibrate_additive
from torchcal.prediction import scores
from torchcal.propagation import NISP
from torchcal.simulators import (
    ExternalSimulator,
    Parameter,
    PolynomialSurrogate,
    Simulator,
    build_surrogate,
)

__all__ = [
    "NISP",
    "ExternalSimulator",
    "Parameter",
    "PolynomialSurrogate",
    "Recording",
    "Simulator",
    "TorchcalError",
    "TorchcalWarning",
    "build_surrogate",
    "calibrate",
    "calibrate_additive",
    "embeddings",
    "errors",
    "likelihoods",
    "models",
    "polychaos",
    "priors",
    "results",
    "scores",
]
