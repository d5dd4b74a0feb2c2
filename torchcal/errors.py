"""Exceptions and warning categories.

Every exception says what was expected, what came, and what to do. Every warning about convergence or
trust is a category of its own, so that a caller can filter it or turn it into an error.
"""

import sys
import warnings

__all__ = [
    "ConvergenceError",
    "ConvergenceWarning",
    "DegenerateLikelihoodError",
    "DomainError",
    "EmbeddingError",
    "ExtrapolationWarning",
    "IdentifiabilityWarning",
    "ImproperPosteriorError",
    "InterruptionWarning",
    "MissingDependencyError",
    "PropagationWarning",
    "RecordingError",
    "ShapeError",
    "SimulatorError",
    "SurrogateWarning",
    "ToleranceWarning",
    "TorchcalError",
    "TorchcalWarning",
    "UnitWarning",
    "WorkerWarning",
]

#: Packages in which nobody can do anything about a warning; torch's and Pyro's call torchcal back.
_INNER = ("torchcal", "torch", "pyro")


def warn(message: str, category: type[Warning]) -> None:
    """Warn at the user's line that led here, outside `_INNER`, which is where something can be done about it."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).partition(".")[0] in _INNER:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


class TorchcalError(Exception):
    """Base class of every error that torchcal raises on purpose."""


class DomainError(TorchcalError, ValueError):
    """A number is outside the set in which the formula has a meaning (a negative tolerance, say)."""


class ShapeError(TorchcalError, ValueError):
    """Two arrays that must agree in shape or dtype do not."""


class RecordingError(TorchcalError, ValueError):
    """A recording cannot be used as given: not a number, infinite, too short, or of unequal lengths."""


class SimulatorError(TorchcalError, RuntimeError):
    """A simulator raised, or returned something that is not a finite real array of the right shape."""


class EmbeddingError(TorchcalError, ValueError):
    """An embedding names a parameter that does not exist, names one twice, or embeds nothing."""


class ImproperPosteriorError(TorchcalError, ValueError):
    """Likelihood and prior together leave some coefficient without any constraint, or without a maximum."""


class DegenerateLikelihoodError(TorchcalError, ValueError):
    """The likelihood vanishes for every coefficient vector (the full likelihood with N > d, Eqs. 14-15)."""


class ConvergenceError(TorchcalError, RuntimeError):
    """A search could not produce an estimate at all."""


class MissingDependencyError(TorchcalError, ImportError):
    """An optional package is needed for what was asked."""


class TorchcalWarning(UserWarning):
    """Base class of every warning that torchcal gives."""


class ConvergenceWarning(TorchcalWarning):
    """Optimiser starts disagree, or R-hat, effective sample size or divergences are past their thresholds."""


class InterruptionWarning(TorchcalWarning):
    """Ctrl-C ended a calculation early; what there was is kept."""


class PropagationWarning(TorchcalWarning):
    """Output moments still change when quadrature nodes or expansion terms are added."""


class IdentifiabilityWarning(TorchcalWarning):
    """The data say nothing about the value of a parameter, or a bound decides it."""


class ToleranceWarning(TorchcalWarning):
    """The ABC tolerance rather than the model error sets the width of the prediction."""


class SurrogateWarning(TorchcalWarning):
    """A surrogate's error on held-out points is not small against what it is used for."""


class ExtrapolationWarning(TorchcalWarning):
    """A model or surrogate is used outside the region that it was built for."""


class UnitWarning(TorchcalWarning):
    """A recording is in another unit than the simulator."""


class WorkerWarning(TorchcalWarning):
    """Workers of an executor died; their work was done again."""
