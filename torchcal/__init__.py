"""torchcal: calibrate a simulation that is wrong, and find the physics that it leaves out."""

import importlib
import typing

from torchcal import discovery, display, embeddings, errors, likelihoods, models, polychaos, priors, results, terms
from torchcal.data import Recording, Run
from torchcal.discovery import diagnose
from torchcal.errors import TorchcalError, TorchcalWarning
from torchcal.inference import calibrate, calibrate_additive, calibrate_many
from torchcal.prediction import scores
from torchcal.propagation import NISP
from torchcal.simulators import (
    ExternalSimulator,
    ODESimulator,
    Parameter,
    PolynomialSurrogate,
    Simulator,
    build_surrogate,
)
from torchcal.terms import Term

__all__ = [
    "NISP",
    "ExternalSimulator",
    "ODESimulator",
    "Parameter",
    "PolynomialSurrogate",
    "Recording",
    "Run",
    "Simulator",
    "Term",
    "TorchcalError",
    "TorchcalWarning",
    "build_surrogate",
    "calibrate",
    "calibrate_additive",
    "calibrate_many",
    "diagnose",
    "discovery",
    "embeddings",
    "errors",
    "likelihoods",
    "models",
    "plots",
    "polychaos",
    "priors",
    "results",
    "scores",
    "terms",
]


def __getattr__(name: str) -> typing.Any:
    """`torchcal.plots`, which brings matplotlib, and the version of the installed package, when they are asked for."""
    if name == "plots":
        return importlib.import_module("torchcal.plots")
    if name == "__version__":
        return display.version("torchcal")
    raise AttributeError(f"module 'torchcal' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__", *(name for name in globals() if name.startswith("__"))})
