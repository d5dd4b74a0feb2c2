"""torchcal: calibrate a simulation that is wrong, and find the physics that it leaves out."""

from torchcal import embeddings, errors, likelihoods, models, polychaos, priors, results
from torchcal.data import Recording
from torchcal.errors import TorchcalError, TorchcalWarning
from torchcal.inference import calibrate, calibrate_additive
from torchcal.prediction import scores
from torchcal.propagation import NISP
from torchcal.simulators import Parameter, Simulator

__all__ = [
    "NISP",
    "Parameter",
    "Recording",
    "Simulator",
    "TorchcalError",
    "TorchcalWarning",
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
