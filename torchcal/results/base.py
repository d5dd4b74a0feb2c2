"""What all results can do: print themselves, be saved and be exported."""

import dataclasses
import html
import os
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchcal.checks import whole
from torchcal.data import Recording
from torchcal.data.conditions import checked
from torchcal.files import check_target
from torchcal.results import storage
from torchcal.results.estimate import MapEstimate
from torchcal.simulators import Conditions, Simulator

__all__ = ["Result", "another_output", "conditions", "indent", "thin"]


class Result:
    """Base class of frozen results."""

    map: MapEstimate
    samples: Tensor | None

    @property
    def alpha_names(self) -> tuple[str, ...]:
        """The names of the columns of ``samples``."""
        return self.map.alpha_names

    @property
    def draws(self) -> Tensor | None:
        """All chains' draws, one below the other, ``(S, columns)``."""
        return None if self.samples is None else self.samples.flatten(0, 1)

    def to_datatree(self) -> Any:
        """The result as an ``xarray.DataTree``."""
        raise TypeError(f"{type(self).__name__} has no tree.")

    def to_arviz(self) -> Any:
        """The result as ``arviz.InferenceData`` (a ``DataTree`` from ArviZ 1.0 on)."""
        return storage.to_arviz(self.to_datatree())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a netCDF file, whole or not at all. The simulator's code is not stored.

        Raises:
            DomainError: If the folder does not exist.
        """
        check_target(path)  # before all draws are predicted
        storage.write(self.to_datatree(), path)

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


def thin(draws: Tensor | None, most: int) -> Tensor | None:
    """At most ``most`` draws, evenly spaced."""
    most = whole("max_draws", most, 1)
    if draws is None or len(draws) <= most:
        return draws
    return draws[torch.linspace(0, len(draws) - 1, most).round().long()]


def conditions(x: Any, recording: Recording | None) -> Conditions:
    """New conditions as float64 tensors, with the names of the recording's where there is one."""
    if recording is None:
        return checked(x, tuple(x) if isinstance(x, Mapping) else None)
    return checked(x, tuple(recording.x) if isinstance(recording.x, Mapping) else None, recording.units)


def another_output(function: Callable[[Any, dict[str, Tensor]], Any], simulator: Simulator) -> Simulator:
    """Another function of a simulator's parameters, ``function(x, p)``; of one in time those of each run too."""
    made = Simulator(function, [dataclasses.replace(q, per_run=False) for q in simulator.parameters])
    made.parameters = simulator.parameters
    return made


def indent(text: str) -> str:
    """Every line two characters further right."""
    return "\n".join("  " + line for line in text.splitlines())
