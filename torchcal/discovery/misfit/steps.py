"""Steps of an output from one datum to the next: an instrument that was exchanged, or switched its range.

Slow noise may take a step as well as physics, and what is left beyond smooth curves is hardly larger for it. One number
says what a step does, and smooth functions need dozens.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.misfit.channels import Channel
from torchcal.discovery.misfit.places import SIZES
from torchcal.discovery.misfit.residual import Residual

__all__ = ["Steps", "steps_of"]

#: Data that there are at least on either side of a step: fewer may be outliers.
LEAST = 5
#: Places of a step that are tried in an output, evenly among its data.
MOST = 200
#: Share of its norm that the base's tangents leave of a step at least, for it to be seen.
SEEN = 1e-6


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps of one output, each in one of its runs, at any of some places.

    Attributes:
        functions: 0 before a step, 1 from there on to the end of its run, ``(n, K)``.
    """

    functions: Tensor

    @classmethod
    def of(cls, problem: Problem, channel: Channel) -> "Steps | None":
        """Of an output; None where its data follow in nothing, or are too few."""
        if problem.order is None:
            return None
        number, along = problem.recording.outputs.index(channel.target), problem.order[problem.condition_of]
        found = []
        for places in problem.sequences:
            if int(problem.output_of[places[0]]) != number:
                continue
            apart = along[places].diff() > 0
            found += [places[k:] for k in range(LEAST, len(places) - LEAST + 1) if bool(apart[k - 1])]
        if not found:
            return None
        chosen = found[:: math.ceil(len(found) / MOST)]
        functions = torch.zeros(problem.n, len(chosen), dtype=torch.float64)
        for column, after in enumerate(chosen):
            functions[after, column] = 1.0
        return cls(functions)

    def evidence(self, residual: Residual) -> tuple[float, Tensor]:
        """Log evidence of a step against none, with all places and `SIZES` as likely, and the likeliest step ``(n,)``.

        The size is that of the step's whitened effect beyond what the base's parameters make up for.
        """
        whitened = residual.found.whitening(self.functions)
        columns = residual.project(whitened)
        norm = columns.norm(dim=0)
        seen = norm > SEEN * whitened.norm(dim=0)
        along = (columns.T @ residual.e / norm).where(seen, 0.0)
        shrink = (SIZES.square() / (1 + SIZES.square()))[:, None]
        logs = 0.5 * (shrink * along.square() + torch.log1p(-shrink))  # (sizes, K)
        size, place = divmod(int(logs.argmax()), logs.shape[1])
        step = float(shrink[size, 0] * along[place] / norm[place]) if bool(seen[place]) else 0.0
        return float(logs.logsumexp((0, 1))) - math.log(logs.numel()), step * self.functions[:, place]


def steps_of(problem: Problem, available: Sequence[Channel]) -> list[Steps]:
    """Of all outputs."""
    found = (Steps.of(problem, channel) for channel in available if channel.kind == "output")
    return [steps for steps in found if steps is not None]
