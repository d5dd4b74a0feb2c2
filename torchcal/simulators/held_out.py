"""A surrogate's error at points that were not used to build it."""

import dataclasses

import torch
from torch import Tensor

__all__ = ["NUMBERS", "HeldOutError"]

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
        """rms over sd, ``(outputs,)``; 0 where the rms is no more than rounding."""
        # Sums over some thousand points of one size leave about a hundred epsilon.
        rounding = self.rms <= 1e-13 * (self.mean.abs() + self.sd)
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
