"""The maximum a posteriori of a calibration."""

import dataclasses

from torch import Tensor

from torchcal.results.diagnostics import table

__all__ = ["MapEstimate"]


@dataclasses.dataclass(frozen=True, repr=False)
class MapEstimate:
    """The maximum a posteriori.

    Attributes:
        alpha: MAP α in scaled coordinates, ``(P,)``.
        mean: E[λ] at it, ``(d,)``, physical units, the free parameters in order.
        covariance: Cov[λ] at it, ``(d, d)``, physical units.
        objective: Negative log-likelihood at it.
        alpha_names: The names of α.
        parameters: The names of the free parameters.
    """

    alpha: Tensor
    mean: Tensor
    covariance: Tensor
    objective: float
    alpha_names: tuple[str, ...]
    parameters: tuple[str, ...]

    def __repr__(self) -> str:
        numbers = zip(self.parameters, self.mean.tolist(), self.sd.tolist(), strict=True)
        rows = [(name, f"{mean:.4g}", f"{sd:.2g}") for name, mean, sd in numbers]
        return f"maximum a posteriori, -log likelihood {self.objective:.6g}\n" + table(("", "E[λ]", "Sd[λ]"), rows)

    @property
    def sd(self) -> Tensor:
        """Sd[λ], ``(d,)``, physical units."""
        return self.covariance.diagonal().clamp_min(0).sqrt()
