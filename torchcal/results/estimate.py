"""The maximum a posteriori of a calibration."""

import dataclasses

from torch import Tensor

__all__ = ["MapEstimate"]


@dataclasses.dataclass(frozen=True)
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

    @property
    def sd(self) -> Tensor:
        """Sd[λ], ``(d,)``, physical units."""
        return self.covariance.diagonal().clamp_min(0).sqrt()
