"""The result of a conventional calibration."""

import dataclasses
import os
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from torchcal.data import Recording
from torchcal.errors import DomainError
from torchcal.prediction import (
    AdditivePrediction,
    additive_prediction,
)
from torchcal.propagation import NISP
from torchcal.results import reading, storage
from torchcal.results.base import Result, another_output, conditions, indent, thin
from torchcal.results.diagnostics import Diagnostics, table
from torchcal.results.estimate import MapEstimate
from torchcal.results.in_time import propagation_in_time
from torchcal.simulators import Simulator, Trajectories

__all__ = ["AdditiveCalibration", "sigma_unit"]

NEGLIGIBLE = 0.05
"""Share of the noise sd up to which σ adds nothing that could be seen: 0.1 % to its size."""


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class AdditiveCalibration(Result):
    """Result of `torchcal.calibrate_additive`, the conventional calibration.

    Attributes:
        map: The maximum a posteriori; ``alpha`` is λ̃ and ln σ, the covariance is zero.
        samples: Draws of (λ̃, ln σ), ``(chains, draws, d + 1)``, or None.
        diagnostics: How far to trust them.
        recording: The data.
        propagate: Zero-order propagation; `None` on a result loaded without a simulator.
        settings: Numbers that the calibration was run with.
    """

    map: MapEstimate
    samples: Tensor | None
    diagnostics: Diagnostics
    recording: Recording
    propagate: NISP | None
    settings: Mapping[str, Any]
    stored: AdditivePrediction | None = None

    @property
    def parameters(self) -> Tensor:
        """Draws of λ in physical units, ``(S, d)``."""
        return reading.scaling_of(self.settings).physical(self._needed_draws()[:, :-1])

    @property
    def sigma(self) -> Tensor:
        """Draws of σ in the output's unit, ``(S,)``."""
        return self._needed_draws()[:, -1].exp()

    @property
    def noise_suffices(self) -> bool:
        """Whether σ at the maximum is at most `NEGLIGIBLE` times the known noise sd of every datum."""
        noise = self.recording.noise_sd
        if noise is None:
            return False
        size = self.map.alpha[-1].exp() * sigma_unit(self.recording)
        return bool((size <= NEGLIGIBLE * noise)[self.recording.observed].all())

    def predict(
        self,
        x: Any = None,
        *,
        function: Callable[[Any, dict[str, Tensor]], Any] | None = None,
        max_draws: int = 4000,
    ) -> AdditivePrediction:
        """Push-forward and posterior predictive, kept apart.

        Args:
            x: Conditions, the data's by default; in time as for `Calibration.predict`.
            function: Another function of the parameters; its posterior predictive adds nothing to the
                push-forward but σ², which has no meaning there: read ``push_forward``.
            max_draws: At most this many draws, evenly spaced, are averaged over.
        """
        if self.propagate is None and x is None and function is None and self.stored is not None:
            return self.stored
        propagate = self._propagation()
        if x is not None and function is None and isinstance(propagate.simulator, Trajectories):
            propagate = propagation_in_time(propagate, self.recording, x, self.map.alpha[:-1])
        elif x is not None or function is not None:
            where = propagate.x if x is None else conditions(x, None if function else self.recording)
            other = None if function is None else another_output(function, propagate.simulator)
            propagate = propagate.at(where, simulator=other)
        return additive_prediction(
            propagate,
            self.map.alpha[:-1],
            thin(self.draws, max_draws),
            log_sigma_map=float(self.map.alpha[-1]),
            unit=None if function is not None else sigma_unit(self.recording, len(first(propagate.x))),
        )

    def _propagation(self) -> NISP:
        if self.propagate is None:
            raise DomainError(
                "Expected a simulator. Got a calibration that was loaded without one. Use "
                "AdditiveCalibration.load(path, simulator=...)."
            )
        return self.propagate

    def _needed_draws(self) -> Tensor:
        draws = self.draws
        if draws is None:
            raise DomainError("Expected posterior draws. Got a calibration with num_samples=0.")
        return draws

    def to_datatree(self) -> Any:
        """The result as an ``xarray.DataTree``: groups posterior, map, prediction, observed_data, constant_data."""
        return storage.additive_tree(self)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, simulator: Simulator | None = None
    ) -> "AdditiveCalibration":
        """Read a result that `save` wrote, as `Calibration.load` does."""
        return reading.read_additive(cls, path, simulator)

    def __str__(self) -> str:
        lines = ["Calibration with an additive Gaussian discrepancy"]
        lines.append(f"  data: {self.recording.n} conditions, outputs {', '.join(self.recording.outputs)}")
        rows = []
        draws = None if self.draws is None else self.parameters
        for i, name in enumerate(self.map.parameters):
            unit = self.settings["units"].get(name) or ""
            sd = "" if draws is None else f"{float(draws[:, i].std()):.3g}"
            rows.append((f"{name} [{unit}]" if unit else name, f"{self.map.mean[i]:.6g}", sd))
        sd = "" if self.draws is None else f"{float(self.sigma.std()):.3g}"
        rows.append(("sigma", f"{float(self.map.alpha[-1].exp()):.6g}", sd))
        lines.append(indent(table(("parameter", "MAP", "posterior sd"), rows)))
        if self.noise_suffices:
            lines.append("  sigma is at zero: the noise that was given suffices for what the model leaves of the data")
        lines.append(indent(str(self.diagnostics)))
        return "\n".join(lines)


def sigma_unit(recording: Recording, num_conditions: int | None = None) -> Tensor:
    """What σ is measured in at each output value: the spread of its output's data, the first output's being one.

    Args:
        recording: The data.
        num_conditions: Number of conditions; the recording's by default.
    """
    spread = recording.spread[:: recording.n]
    return (spread / spread[0]).repeat_interleave(recording.n if num_conditions is None else num_conditions)


def first(x: Any) -> Tensor:
    """The first of the conditions."""
    return next(iter(x.values())) if isinstance(x, Mapping) else x
