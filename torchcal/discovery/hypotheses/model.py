"""A hypothesis: the base with terms that might have been left out."""

from dataclasses import dataclass, field

from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.local import region_text
from torchcal.discovery.hypotheses.screen import Window
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.misfit.structure import Structure

__all__ = ["PRIOR", "Hypothetical", "Model"]

#: Prior probabilities: of the base, of one library term, of a local one, of two, and of something else.
PRIOR = {"base": 0.30, "single": 0.35, "local": 0.13, "several": 0.11, "none": 0.11}


@dataclass(eq=False)
class Model:
    """A hypothesis that was refitted.

    Attributes:
        numbers: Numbers of its candidates in the library.
        candidate: Terms, simulator and places of parameters.
        found: Its fit.
        log_evidence: Against the base, penalties for parameters included.
        log_prior: Of the hypothesis.
        physical: Whether nothing lies on a bound that it wants to cross.
        price: Log penalty for its parameters.
        in_use: Log evidence with the search's noise, in the end, when ``log_evidence`` is with its own.
        note: What speaks against it.
        window: Where it acts, if locally.
        structure: What is left; filled in for the best.
        intervals: 95 % intervals of what its sd mislead about, by place; filled in for what is named.
    """

    numbers: tuple[int, ...]
    candidate: Candidate
    found: Fitted
    log_evidence: float
    log_prior: float
    physical: bool
    price: float = 0.0
    in_use: float = 0.0
    note: str = ""
    window: Window | None = None
    structure: Structure | None = None
    residual: Residual | None = None
    intervals: dict[int, tuple[float, float]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Of its terms."""
        return tuple(term.name for term in self.candidate.terms)

    @property
    def content(self) -> frozenset[str]:
        """Names of the parameters that it adds, by which one model holds another, however their terms are called."""
        return self.candidate.content

    @property
    def prior(self) -> float:
        """Log prior with the price of its parameters."""
        return self.log_prior + self.price

    @property
    def where(self) -> str | None:
        """Where it acts, if locally, in words."""
        w = self.window
        if w is None:
            return None
        region = region_text(w.driver, w.low, w.high, w.span)
        return f"{w.at} and {region}" if w.at else region

    @property
    def weight(self) -> float:
        """Log of prior times evidence."""
        return self.log_evidence + self.log_prior


@dataclass(frozen=True, eq=False)
class Hypothetical:
    """A hypothesis to refit: see `Model`; ``begin`` holds its starting values ``(H, P)``."""

    numbers: tuple[int, ...]
    candidate: Candidate
    begin: Tensor
    prior: float
    window: Window | None = None
