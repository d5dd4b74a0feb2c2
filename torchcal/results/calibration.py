"""The results of calibrations."""

import dataclasses
import html
import os
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.embeddings import Embedding
from torchcal.errors import DomainError
from torchcal.likelihoods import Likelihood
from torchcal.prediction import (
    AdditivePrediction,
    Prediction,
    additive_prediction,
    embedded_prediction,
    parameter_density,
)
from torchcal.propagation import NISP
from torchcal.results import storage
from torchcal.results.diagnostics import Diagnostics, table
from torchcal.results.estimate import MapEstimate
from torchcal.simulators import Conditions, Simulator

__all__ = ["AdditiveCalibration", "Calibration"]


class _Printing:
    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Calibration(_Printing):
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

    @property
    def alpha_names(self) -> tuple[str, ...]:
        """The names of the columns of ``samples``."""
        return self.map.alpha_names

    @property
    def draws(self) -> Tensor | None:
        """All chains' draws of α, ``(S, P)``."""
        return None if self.samples is None else self.samples.flatten(0, 1)

    def predict(
        self,
        x: Any = None,
        *,
        function: Callable[[Any, dict[str, Tensor]], Any] | None = None,
        max_draws: int = 4000,
    ) -> Prediction:
        """Predictive moments of the outputs, or of another function of the parameters.

        Args:
            x: Conditions, ``(n,)`` or a dict of them, arrays of any kind; the data's by default.
            function: ``function(x, p)`` of the same parameters, for another quantity of interest; its conditions
                may have other names than the data's.
            max_draws: At most this many draws, evenly spaced, are averaged over.
        """
        if self.propagate is None:
            if x is None and function is None and self.stored is not None:
                return self.stored
            raise DomainError(
                "Expected a simulator to predict with. Got a calibration that was loaded without one. Use "
                "Calibration.load(path, simulator=...)."
            )
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
        where = self.propagate.x if x is None else conditions(x, None if function else self.recording)
        if function is None:
            return self.propagate.at(where)
        other = self.propagate.at(where, simulator=Simulator(function, self.propagate.simulator.parameters))
        other.refine(self.map.alpha.to(other.nodes))
        return other

    def sample_outputs(self, num: int, x: Any = None, *, kind: str = "posterior", seed: int = 0) -> Tensor:
        """Draws from the output's predictive distribution, ``(num, n)``.

        Args:
            num: How many.
            x: Conditions; the data's by default.
            kind: ``"posterior"`` (Eq. 31) or ``"map"`` (Eq. 30).
            seed: Of the draws.
        """
        propagate = self.propagation_at(x)
        alpha, xi = self._joint_draws(propagate, num, kind, seed)
        with torch.no_grad():
            return propagate.outputs_at(alpha, xi, paired=True).to(device="cpu", dtype=torch.float64)

    def sample_parameters(self, num: int, *, kind: str = "posterior", seed: int = 0) -> Tensor:
        """Draws of λ in physical units, ``(num, d)``, from the posterior or MAP predictive density (Eq. 44)."""
        propagate = self.propagation_at()
        alpha, xi = self._joint_draws(propagate, num, kind, seed)
        with torch.no_grad():
            return propagate.parameters_at(alpha, xi, paired=True).to(device="cpu", dtype=torch.float64)

    def parameter_density(self, points: Any, *, kind: str = "posterior", max_draws: int = 1000) -> Tensor:
        """Density of λ at physical points ``(M, d)``, of the posterior or MAP predictive (Eq. 44)."""
        propagate = self.propagation_at()
        alpha = self.map.alpha[None] if self._kind(kind) == "map" else thin(self.draws, max_draws)
        if alpha is None:
            raise DomainError("Expected draws. Got a calibration with none.")
        return parameter_density(propagate, alpha, torch.as_tensor(points, dtype=torch.float64))

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
        if isinstance(num, bool) or not isinstance(num, int) or num < 0:
            raise DomainError(f"Expected num as a non-negative integer. Got {num!r}.")
        like = propagate.nodes
        xi = propagate.draw_germ(num, seed=seed)
        draws = self.draws
        if self._kind(kind) == "map" or draws is None:
            return self.map.alpha.to(like).expand(num, -1), xi
        generator = torch.Generator().manual_seed(seed + 1)
        chosen = torch.randint(len(draws), (num,), generator=generator)
        return draws[chosen].to(like), xi

    def to_datatree(self) -> Any:
        """The result as an ``xarray.DataTree``: groups posterior, map, prediction, observed_data."""
        return storage.calibration_tree(self)

    def to_arviz(self) -> Any:
        """The result as ``arviz.InferenceData`` (a ``DataTree`` from ArviZ 1.0 on)."""
        return storage.to_arviz(self.to_datatree())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a netCDF file, whole or not at all. The simulator's code is not stored."""
        storage.write(self.to_datatree(), path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, simulator: Simulator | None = None) -> "Calibration":
        """Read a result that `save` wrote.

        Args:
            path: The file.
            simulator: The simulator it was calibrated with, for predictions elsewhere than at the data.
        """
        return storage.read_calibration(cls, path, simulator)

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        lines = [f"Calibration with embedded model error ({self.likelihood.name}, {self.settings['embedding']})"]
        lines.append(f"  data: {self.recording.n} conditions, outputs {', '.join(self.recording.outputs)}")
        lines.append(f"  objective at the MAP: {self.map.objective:.6g}")
        rows = []
        for i, name in enumerate(self.map.parameters):
            unit = self.settings["units"].get(name) or ""
            rows.append((f"{name} [{unit}]" if unit else name, f"{self.map.mean[i]:.6g}", f"{self.map.sd[i]:.3g}"))
        lines.append(_indent(table(("parameter at the MAP", "E[λ]", "sd[λ]"), rows)))
        lines.append(_indent(str(self.diagnostics)))
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class AdditiveCalibration(_Printing):
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
    def alpha_names(self) -> tuple[str, ...]:
        """The names of the columns of ``samples``."""
        return self.map.alpha_names

    @property
    def draws(self) -> Tensor | None:
        """All chains' draws, ``(S, d + 1)``."""
        return None if self.samples is None else self.samples.flatten(0, 1)

    @property
    def parameters(self) -> Tensor:
        """Draws of λ in physical units, ``(S, d)``."""
        return self._propagation().scaling.physical(self._needed_draws()[:, :-1])

    @property
    def sigma(self) -> Tensor:
        """Draws of σ in the output's unit, ``(S,)``."""
        return self._needed_draws()[:, -1].exp()

    def predict(
        self,
        x: Any = None,
        *,
        function: Callable[[Any, dict[str, Tensor]], Any] | None = None,
        max_draws: int = 4000,
    ) -> AdditivePrediction:
        """Push-forward and posterior predictive, kept apart.

        Args:
            x: Conditions, the data's by default.
            function: Another function of the parameters; its posterior predictive adds nothing to the
                push-forward but σ², which has no meaning there: read ``push_forward``.
            max_draws: At most this many draws, evenly spaced, are averaged over.
        """
        if self.propagate is None and x is None and function is None and self.stored is not None:
            return self.stored
        propagate = self._propagation()
        if x is not None or function is not None:
            where = propagate.x if x is None else conditions(x, None if function else self.recording)
            other = None if function is None else Simulator(function, propagate.simulator.parameters)
            propagate = propagate.at(where, simulator=other)
        return additive_prediction(
            propagate,
            self.map.alpha[:-1],
            thin(self.draws, max_draws),
            log_sigma_map=float(self.map.alpha[-1]),
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
        """The result as an ``xarray.DataTree``."""
        return storage.additive_tree(self)

    def to_arviz(self) -> Any:
        """The result as ``arviz.InferenceData`` (a ``DataTree`` from ArviZ 1.0 on)."""
        return storage.to_arviz(self.to_datatree())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a netCDF file, whole or not at all."""
        storage.write(self.to_datatree(), path)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, simulator: Simulator | None = None
    ) -> "AdditiveCalibration":
        """Read a result that `save` wrote."""
        return storage.read_additive(cls, path, simulator)

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        lines = ["Calibration with an additive Gaussian discrepancy"]
        lines.append(f"  data: {self.recording.n} conditions, outputs {', '.join(self.recording.outputs)}")
        rows = []
        draws = None if self.draws is None or self.propagate is None else self.parameters
        for i, name in enumerate(self.map.parameters):
            unit = self.settings["units"].get(name) or ""
            sd = "" if draws is None else f"{float(draws[:, i].std()):.3g}"
            rows.append((f"{name} [{unit}]" if unit else name, f"{self.map.mean[i]:.6g}", sd))
        sd = "" if self.draws is None else f"{float(self.sigma.std()):.3g}"
        rows.append(("sigma", f"{float(self.map.alpha[-1].exp()):.6g}", sd))
        lines.append(_indent(table(("parameter", "MAP", "posterior sd"), rows)))
        lines.append(_indent(str(self.diagnostics)))
        return "\n".join(lines)


def thin(draws: Tensor | None, most: int) -> Tensor | None:
    """At most ``most`` draws, evenly spaced."""
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise DomainError(f"Expected max_draws as a positive integer. Got {most!r}.")
    if draws is None or len(draws) <= most:
        return draws
    return draws[torch.linspace(0, len(draws) - 1, most).round().long()]


def conditions(x: Any, recording: Recording | None) -> Conditions:
    """New conditions as float64 tensors, with the names of the recording's where there is one."""
    if recording is None:
        wanted = tuple(x) if isinstance(x, Mapping) else None
    else:
        wanted = tuple(recording.x) if isinstance(recording.x, Mapping) else None
    if wanted is None:
        if isinstance(x, Mapping):
            raise DomainError(f"Expected conditions as one array, as in the recording. Got a dict {list(x)}.")
        return _vector(x, "x")
    if not isinstance(x, Mapping) or set(x) != set(wanted):
        got = list(x) if isinstance(x, Mapping) else type(x).__name__
        raise DomainError(f"Expected conditions as a dict with {list(wanted)}. Got {got}.")
    values = {name: _vector(x[name], name) for name in wanted}
    if len({len(value) for value in values.values()}) > 1:
        raise DomainError(
            f"Expected conditions of one length. Got { {name: len(v) for name, v in values.items()} }."
        )
    return values


def _vector(value: Any, name: str) -> Tensor:
    try:
        array = torch.as_tensor(value, dtype=torch.float64).detach()
    except (TypeError, ValueError, RuntimeError) as error:
        raise DomainError(f"Expected condition {name!r} as numbers of shape (n,). Got {value!r}.") from error
    if array.ndim == 0:
        array = array[None]
    if array.ndim != 1 or not len(array) or not bool(torch.isfinite(array).all()):
        what = f"shape {tuple(array.shape)}" if array.ndim != 1 or not len(array) else "values that are not finite"
        raise DomainError(f"Expected condition {name!r} as finite numbers of shape (n,). Got {what}.")
    return array


def _indent(text: str) -> str:
    return "\n".join("  " + line for line in text.splitlines())
