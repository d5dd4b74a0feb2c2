"""A surrogate's error at points that were not used to build it."""

import dataclasses

import torch
from torch import Tensor

from torchcal.data import ROUNDING

__all__ = ["NUMBERS", "HeldOutError", "mean_and_sd", "root_mean_square"]

NUMBERS = ("max_abs", "rms", "mean", "sd")
"""The tensors of a `HeldOutError`."""


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOutError:
    """How far a surrogate is from its simulator at random points that were not used to build it.

    Attributes:
        num: Number of points, uniform in the box.
        outputs: Names of the outputs; ``("y",)`` where there is one without a name.
        max_abs: Largest absolute error of each output, ``(outputs,)``, in the output's unit.
        rms: Root mean square error, likewise.
        mean: Mean of the output itself over the points, likewise.
        sd: Standard deviation of the output itself over the points, likewise.
        worst: The point of the largest error of each output, ``{name: value}``.
    """

    num: int
    outputs: tuple[str, ...]
    max_abs: Tensor
    rms: Tensor
    mean: Tensor
    sd: Tensor
    worst: tuple[dict[str, float], ...]

    @property
    def relative(self) -> Tensor:
        """rms over sd, ``(outputs,)``; 0 where the rms is rounding of the sd, or of the mean of a constant output."""
        size = ROUNDING * self.mean.abs()
        rounding = (self.rms <= 1e-13 * self.sd) | ((self.sd <= size) & (self.rms <= size))
        return torch.where(rounding, 0.0, self.rms / self.sd)

    def __str__(self) -> str:
        lines = [f"error at {self.num} held-out points"]
        for i, name in enumerate(self.outputs):
            point = ", ".join(f"{key} = {value:.6g}" for key, value in self.worst[i].items())
            lines.append(
                f"  {name}: rms {self.rms[i]:.3g} ({self.relative[i]:.2g} of the output's sd {self.sd[i]:.3g}), "
                f"largest {self.max_abs[i]:.3g} at {point}"
            )
        return "\n".join(lines)


def root_mean_square(values: Tensor) -> Tensor:
    """Of every row of ``(outputs, m)``, whose squares may be past the range of numbers: ``(outputs,)``."""
    scale = _scale(values)
    return (values / scale).square().mean(1).sqrt() * scale[:, 0]


def mean_and_sd(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and sample sd of every row of ``(outputs, m)``, likewise."""
    scale = _scale(values)
    scaled = values / scale
    sd = (scaled - scaled[:, :1]).std(1)  # zero where all are equal, whatever their mean is rounded to
    return scaled.mean(1) * scale[:, 0], sd * scale[:, 0]


def _scale(values: Tensor) -> Tensor:
    """The power of two below each row's largest size, by which numbers are divided without rounding."""
    size = values.abs().amax(1, keepdim=True)
    exponent = (torch.frexp(size).exponent.to(torch.float64) - 1).clamp_min(-1022)
    return torch.where(size > 0, torch.exp2(exponent), 1.0)
