"""Oscillations of rates and parameters in time.

What drives a system in cycles, or what cycles in it, is seen through its response: not a wave of an output alone, and
two numbers where smooth functions take dozens.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.misfit.channels import RUN, Channel
from torchcal.discovery.misfit.places import SIZES, SMALL, Change, Place
from torchcal.discovery.misfit.residual import Residual

__all__ = ["wave_places"]

#: Waves of a rate: the fewest in the longest run, points of the trajectory that the fastest has at least, and
#: frequencies for each wave more.
FEWEST, POINTS, DENSE = 1.5, 4, 4
#: Frequencies within a step of the grid around the likeliest one: large waves tell their frequency better than that.
FINER = 8
#: Runs beyond which none are sought: each has a phase of its own.
MOST_RUNS = 20


@dataclass(frozen=True, eq=False)
class Waves:
    """Waves of a rate or a parameter in time, of any phase in every run, at the frequencies of a grid.

    Attributes:
        channel: Where they act.
        frequencies: Of the grid, ``(F,)``.
        s: Singular values of the responses, ``(F, m)``; of such as are none 0.
        along: The residuals along the left singular vectors, ``(F, m, B)``.
    """

    channel: Channel
    frequencies: Tensor
    s: Tensor
    along: Tensor

    @classmethod
    def of(
        cls, channel: Channel, residual: Residual, residuals: Tensor, frequencies: Tensor
    ) -> "Waves | None":
        """Of a channel, at some frequencies; None where there are none, or nothing that they do is seen."""
        if not len(frequencies):
            return None
        features = _waves(channel, frequencies)  # (K, F, m)
        responses = residual.found.whitening(channel.response(features.flatten(1)))
        columns = residual.project(responses).reshape(-1, *features.shape[1:]).movedim(1, 0)  # (F, n, m)
        size = columns.square().sum((1, 2)).sqrt()
        seen = size > 1e-9 * float(responses.norm())  # the others are rounding
        if not bool(size.isfinite().all()) or not bool(seen.any()):
            return None
        scale = (size / math.sqrt(columns.shape[2])).where(seen, torch.inf)
        columns = columns / scale[:, None, None]
        values, v = torch.linalg.eigh(columns.mT @ columns)
        s = values.clamp_min(0.0).sqrt()
        there = (s > SMALL * s.amax(1, keepdim=True)) & seen[:, None]
        along = (v.mT @ (columns.mT @ residuals)) / s.where(there, torch.inf)[..., None]
        return cls(channel, frequencies, s.masked_fill(~there, 0.0), along)

    def evidences(self) -> Tensor:
        """Log evidence of a wave of each frequency against none, with all sizes as likely, ``(F, B)``."""
        logs = torch.full((len(self.s), self.along.shape[2]), -math.inf, dtype=torch.float64)
        for size in SIZES.tolist():
            gain = (size * self.s).square()
            shrink = (gain / (1 + gain))[..., None]
            logs = torch.logaddexp(logs, (0.5 * shrink * self.along.square()).sum(1)
                                   - 0.5 * torch.log1p(gain).sum(1, keepdim=True))  # fmt: skip
        return logs - math.log(len(SIZES))


def _frequencies(channel: Channel) -> Tensor:
    """Of the waves of a channel that are tried: from few in the longest run to few points each."""
    run = _run_of(channel)
    gaps, same, runs = channel.time.diff(), run.diff() == 0, run.unique()
    usual = float(gaps[same].median()) if bool(same.any()) else 0.0
    if usual <= 0 or len(runs) > MOST_RUNS:
        return torch.zeros(0, dtype=torch.float64)
    span = max(float(channel.time[run == r].max() - channel.time[run == r].min()) for r in runs)
    count = max(math.floor((span / (POINTS * usual) - FEWEST) * DENSE) + 1, 0)
    return (FEWEST + torch.arange(count, dtype=torch.float64) / DENSE) / span


def _run_of(channel: Channel) -> Tensor:
    """Number of the run of every point, ``(K,)``."""
    return channel.drivers[RUN].round() if RUN in channel.drivers else torch.zeros_like(channel.time)


def _waves(channel: Channel, frequencies: Tensor) -> Tensor:
    """Cosine and sine in every run, ``(K, F, 2 runs)``."""
    angle, run = 2 * math.pi * channel.time[:, None] * frequencies, _run_of(channel)
    each = [(run == r)[:, None] for r in run.unique()]
    return torch.stack([mine * wave for mine in each for wave in (angle.cos(), angle.sin())], dim=-1)


def wave_places(
    residual: Residual, chosen: Sequence[Channel], residuals: Tensor
) -> Iterator[tuple[Place, Tensor]]:
    """The likeliest wave of every equation and parameter in time, with its evidence in the simulated residuals.

    All frequencies of the grid are as likely.
    """
    if not residual.found.problem.in_time:
        return
    for channel in chosen:
        frequencies = torch.zeros(0, dtype=torch.float64) if channel.kind == "output" else _frequencies(channel)
        waves = Waves.of(channel, residual, residuals, frequencies)
        if waves is None:
            continue
        logs = waves.evidences()
        evidence = logs.logsumexp(0) - math.log(len(frequencies))
        step = float(frequencies.diff().median()) if len(frequencies) > 1 else 0.0
        near = frequencies[logs[:, 0].argmax()] + step * torch.linspace(-1, 1, 2 * FINER + 1, dtype=torch.float64)
        finer = Waves.of(channel, residual, residuals[:, :1], near)
        if finer is None:
            continue
        seen = finer.evidences()[:, 0]
        around = float(seen.logsumexp(0)) - math.log(FINER * len(frequencies))
        features = _waves(channel, near[seen.argmax()][None])[:, 0]
        change = Change.of(features, residual.tangent(channel.response(features)), 0.0, residuals[:, :1])
        if change is not None:
            found, period = max(float(evidence[0]), around), 1.0 / float(near[seen.argmax()])
            place = change.place(channel, "t", residual)
            yield dataclasses.replace(place, evidence=found, period=period), evidence[1:]
