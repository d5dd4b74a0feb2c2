"""The result of a calibration with embedded model error."""

import dataclasses
import os
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchcal.checks import as_seed, whole
from torchcal.data import Recording
from torchcal.embeddings import Embedding
from torchcal.errors import DomainError, ShapeError
from torchcal.likelihoods import Likelihood
from torchcal.prediction import (
    Prediction,
    embedded_prediction,
    parameter_density,
)
from torchcal.propagation import NISP
from torchcal.propagation.convergence import SETTLED
from torchcal.results import reading, storage
from torchcal.results.base import Result, another_output, conditions, indent, thin
from torchcal.results.diagnostics import Diagnostics, table
from torchcal.results.estimate import MapEstimate
from torchcal.results.in_time import NODE_TOLERANCE, check_nodes_in_time, propagation_in_time
from torchcal.simulators import Simulator, Trajectories
from torchcal.simulators.surrogate import warned_once

__all__ = ["Calibration"]


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Calibration(Result):
    """Result of `torchcal.calibrate`.

    Attributes:
        map: The maximum a posteriori.
        samples: Draws of α, ``(chains, draws, P)``, scaled coordinates, germ signs folded to agree with the
            MAP's; None where none were asked for.
        diagnostics: How far to trust them.
        recording: The data.
        embedding: The embedding.
        likelihood: The likelihood, with its tolerance filled in.
        propagate: The propagation at the data's conditions; `None` on a result loaded without a simulator.
        settings: Numbers that the calibration was run with.
    """

    map: MapEstimate
    samples: Tensor | None
    diagnostics: Diagnostics
    recording: Recording
    embedding: Embedding
    likelihood: Likelihood
    propagate: NISP | None
    settings: Mapping[str, Any]
    stored: Prediction | None = None

    def predict(
        self,
        x: Any = None,
        *,
        function: Callable[[Any, dict[str, Tensor]], Any] | None = None,
        max_draws: int = 4000,
    ) -> Prediction:
        """Predictive moments of the outputs, or of another function of the parameters.

        Args:
            x: Conditions, ``(n,)`` or a dict of them, arrays of any kind; the data's by default. In time: other times
                ``{"time": (n,), "run": (n,)}`` of the recording's runs; or other runs, as a recording in time, a
                `Run` or a list of them, with every initial state given.
            function: ``function(x, p)`` of the same parameters, for another quantity of interest; its conditions
                may have other names than the data's.
            max_draws: At most this many draws, evenly spaced, are averaged over.

        Raises:
            DomainError: If there is no simulator, as none was given to `load`; or times or runs are none of the
                recording's.
            SimulatorError, RecordingError: If the conditions are not those that the simulator takes.
        """
        if self.propagate is None and x is None and function is None and self.stored is not None:
            return self.stored
        with warned_once():
            propagate = self.propagation_at(x, function=function)
            return embedded_prediction(propagate, self.map.alpha, thin(self.draws, max_draws))

    def propagation_at(
        self, x: Any = None, *, function: Callable[[Any, dict[str, Tensor]], Any] | None = None
    ) -> NISP:
        """The calibrated embedding's propagation at other conditions, or for another function of λ."""
        if self.propagate is None:
            raise DomainError(
                "Expected a simulator. Got a calibration that was loaded without one. Use "
                "Calibration.load(path, simulator=...)."
            )
        if x is None and function is None:
            return self.propagate
        in_time = function is None and isinstance(self.propagate.simulator, Trajectories)
        if in_time:
            other = propagation_in_time(self.propagate, self.recording, x, self.map.alpha)
        else:
            where = self.propagate.x if x is None else conditions(x, None if function else self.recording)
            simulator = None if function is None else another_output(function, self.propagate.simulator)
            other = self.propagate.at(where, simulator=simulator)
        if other.pattern.num_germs:  # nodes that were enough at the data may not be elsewhere
            alpha = self.map.alpha.to(other.nodes)
            with warned_once():
                if not other.rule_choice.asked:
                    other.refine(alpha, tolerance=NODE_TOLERANCE if in_time else SETTLED)
                if in_time:
                    check_nodes_in_time(other, alpha)
                else:
                    other.check(alpha)
        return other

    def sample_outputs(self, num: int, x: Any = None, *, kind: str = "posterior", seed: int = 0) -> Tensor:
        """Draws from the output's predictive distribution, ``(num, n)``.

        Args:
            num: How many.
            x: Conditions; the data's by default.
            kind: ``"posterior"`` (Eq. 31) or ``"map"`` (Eq. 30).
            seed: Of the draws.

        Raises:
            DomainError: As `predict`; or if there are no draws, and ``kind`` is ``"posterior"``.
        """
        with warned_once():
            propagate = self.propagation_at(x)
            alpha, xi = self._joint_draws(propagate, num, kind, seed)
            with torch.no_grad():
                return propagate.outputs_at(alpha, xi, paired=True).to(device="cpu", dtype=torch.float64)

    def sample_parameters(self, num: int, *, kind: str = "posterior", seed: int = 0) -> Tensor:
        """Draws of λ in physical units, ``(num, d)``, from the posterior or MAP predictive density (Eq. 44).

        Raises:
            DomainError: As `sample_outputs`.
        """
        propagate = self.propagation_at()
        alpha, xi = self._joint_draws(propagate, num, kind, seed)
        with torch.no_grad():
            return propagate.parameters_at(alpha, xi, paired=True).to(device="cpu", dtype=torch.float64)

    def parameter_density(self, points: Any, *, kind: str = "posterior", max_draws: int = 1000) -> Tensor:
        """Density of λ at physical points ``(M, d)``, of the posterior or MAP predictive (Eq. 44).

        Raises:
            DomainError: As `sample_outputs`.
            ShapeError: If the points are no numbers of that shape.
        """
        propagate = self.propagation_at()
        alpha = self.map.alpha[None] if self._kind(kind) == "map" else thin(self.draws, max_draws)
        if alpha is None:
            raise DomainError("Expected draws. Got a calibration with none.")
        try:
            points = torch.as_tensor(points, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ShapeError(f"Expected points (M, d) as numbers. Got {points!r}.") from error
        return parameter_density(propagate, alpha, points)

    def relabelled(self) -> "Calibration":
        """The same posterior with the paper's labels: positive coefficients of the last parameter.

        Source: Sargsyan, Najm & Ghanem (2015), text under Eq. 12.
        """
        pattern = self.propagation_at().pattern
        estimate = dataclasses.replace(self.map, alpha=pattern.positive_last_row(self.map.alpha))
        samples = None if self.samples is None else pattern.positive_last_row(self.samples)
        return dataclasses.replace(self, map=estimate, samples=samples)

    def _kind(self, kind: str) -> str:
        if kind not in ("posterior", "map"):
            raise DomainError(f"Expected kind 'posterior' or 'map'. Got {kind!r}.")
        if kind == "posterior" and self.samples is None:
            raise DomainError(
                "Expected posterior draws. Got a calibration with num_samples=0. Use kind='map', or calibrate "
                "with num_samples > 0."
            )
        return kind

    def _joint_draws(self, propagate: NISP, num: int, kind: str, seed: int) -> tuple[Tensor, Tensor]:
        num, seed = whole("num", num, 0), as_seed(seed)
        like = propagate.nodes
        xi = propagate.draw_germ(num, seed=seed)
        draws = self.draws
        if self._kind(kind) == "map" or draws is None:
            return self.map.alpha.to(like).expand(num, -1), xi
        generator = torch.Generator().manual_seed(seed + 1)
        chosen = torch.randint(len(draws), (num,), generator=generator)
        return draws[chosen].to(like), xi

    def to_datatree(self) -> Any:
        """The result as an ``xarray.DataTree``: groups posterior, map, prediction, observed_data,
        constant_data."""
        return storage.calibration_tree(self)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, simulator: Simulator | None = None) -> "Calibration":
        """Read a result that `save` wrote.

        Args:
            path: The file.
            simulator: The simulator it was calibrated with, for predictions elsewhere than at the data.

        Raises:
            TorchcalError: If there is no such file, or it is none of these, damaged, or of another version.
            SimulatorError, EmbeddingError, RecordingError: If the simulator is another one than that of the file.
        """
        return reading.read_calibration(cls, path, simulator)

    def __str__(self) -> str:
        lines = [f"Calibration with embedded model error ({self.likelihood.name}, {self.settings['embedding']})"]
        lines.append(f"  data: {self.recording.n} conditions, outputs {', '.join(self.recording.outputs)}")
        lines.append(f"  objective at the MAP: {self.map.objective:.6g}")
        rows = []
        for i, name in enumerate(self.map.parameters):
            unit = self.settings["units"].get(name) or ""
            rows.append((f"{name} [{unit}]" if unit else name, f"{self.map.mean[i]:.6g}", f"{self.map.sd[i]:.3g}"))
        lines.append(indent(table(("parameter at the MAP", "E[λ]", "sd[λ]"), rows)))
        lines.append(indent(str(self.diagnostics)))
        return "\n".join(lines)
