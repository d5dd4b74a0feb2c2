"""Data that the fit never saw: chosen before any candidate, outside the fitted range where the data allow one."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.discovery.fits.fitting import Fitted, fit
from torchcal.discovery.misfit.noise import Noise
from torchcal.discovery.records import Score
from torchcal.errors import DomainError

__all__ = ["HeldOut", "check_left", "choose", "compare", "held_out_fit", "score", "within"]

#: Share of the data that is held out.
SHARE = 0.25
#: Where the end cannot be predicted at all, blocks of a run of which every fourth is held out.
BLOCKS = 12
#: Fewer data than this a free parameter are too few to hold any out.
LEAST_PER_PARAMETER = 4


def choose(recording: Recording, holdout: Any, parameters: int) -> Tensor | None:
    """Which of the n_total outputs are held out, bool; None where there are too few data.

    Of a recording in time the last quarter of every run; of several runs with several conditions each run's end all the
    same, since every run may have initial states of its own. Of one condition its upper end, of several the data
    farthest from their centre; replicates stay together.

    Args:
        recording: The data.
        holdout: None for the above, False for none, a share between 0 and 1 (of a run in time one datum at least), or
            a bool array ``(n,)`` or ``(n_total,)``, True where held out.
        parameters: Number of free parameters.

    Raises:
        DomainError: If ``holdout`` is none of these, or leaves too little.
    """
    if holdout is False:
        return None
    share = SHARE
    if isinstance(holdout, np.floating):
        holdout = float(holdout)
    if holdout is not None and not isinstance(holdout, float):
        try:
            mask = holdout if isinstance(holdout, Tensor) else torch.as_tensor(np.array(holdout))
        except (TypeError, ValueError) as error:
            got = repr(holdout) if isinstance(holdout, str | int) else type(holdout).__name__
            raise DomainError(f"Expected holdout as None, False, a share or a bool array. Got {got}.") from error
        if mask.dtype != torch.bool or mask.shape not in ((recording.n,), recording.y.shape):
            got = f"{mask.dtype} of shape {tuple(mask.shape)}" if mask.ndim else repr(holdout)
            several = f" or, one output after another, ({len(recording.y)},)" if len(recording.outputs) > 1 else ""
            raise DomainError(
                f"Expected holdout as False, a share, or a bool array of shape ({recording.n},){several}, True where "
                f"held out. Got {got}."
            )
        mask = mask.repeat(len(recording.outputs)) if len(mask) == recording.n and len(recording.outputs) > 1 else mask
        kept = int((recording.observed_once & ~mask).sum())
        if kept <= parameters or not bool((recording.observed_once & mask).any()):
            raise DomainError(
                f"Expected holdout to leave more than {parameters} data and to hold out at least one. Got {kept} left "
                "(hold out less)."
            )
        return mask
    if isinstance(holdout, float):
        if not 0 < holdout < 1:
            raise DomainError(f"Expected holdout as a share between 0 and 1. Got {holdout}.")
        share = holdout
    left = int(recording.observed_once.sum()) * (1 - share)
    if left < LEAST_PER_PARAMETER * parameters:
        if holdout is not None:
            raise DomainError(
                f"Expected holdout to leave at least {LEAST_PER_PARAMETER} data for each of {parameters} parameters. "
                f"Got {left:.0f} left (hold out less, or give a bool array)."
            )
        return None
    x = recording.x
    seen = recording.observed_once.reshape(len(recording.outputs), recording.n).any(0)
    if recording.runs is not None and isinstance(x, dict):
        mask = torch.zeros(recording.n, dtype=torch.bool)
        for r in x["run"].unique():
            mine = ((x["run"] == r) & seen).nonzero()[:, 0]
            first = math.ceil((1 - share) * len(mine))
            if holdout is not None and len(mine) > 1:  # a small share of a short run is its last datum
                first = min(first, len(mine) - 1)
            mask[mine[first:]] = True
    else:
        columns = recording.columns
        if columns.shape[1] == 1:
            distance = columns[:, 0]
        else:
            middle = 0.5 * (columns.amax(0) + columns.amin(0))
            half = 0.5 * (columns.amax(0) - columns.amin(0)).clamp_min(1e-300)
            distance = ((columns - middle) / half).square().sum(-1)
        mask = _farthest(distance, _levels(recording), seen, max(1, int(share * int(seen.sum()))))
    return mask.repeat(len(recording.outputs))


def check_left(found: Fitted, mask: Tensor) -> None:
    """Raise DomainError where only data in ``mask`` tell a parameter of a fit: what then predicts them has seen them.

    Such are the initial states of a run that is held out whole, and its parameters with ``per_run=True``.
    """
    slope, kept = found.jacobian.abs(), ~mask[found.problem.index]
    alone = (slope[kept].amax(0) == 0) & (slope.amax(0) > 0)
    if bool(alone.any()):
        name = found.problem.parameters[found.free[int(alone.nonzero()[0, 0])]].name
        raise DomainError(
            f"Expected holdout to leave data for every parameter. Got only held-out data for {name!r}, which cannot "
            "predict themselves (hold out a part of them, or hold the parameter with fixed=; an initial state may be "
            "given with its run)."
        )


def within(recording: Recording) -> Tensor:
    """Blocks inside every run, or inside the range of the first condition, instead of its end; a quarter in all."""
    x = recording.x
    seen = recording.observed_once.reshape(len(recording.outputs), recording.n).any(0)
    mask = torch.zeros(recording.n, dtype=torch.bool)
    if recording.runs is not None and isinstance(x, dict):
        for r in x["run"].unique():
            mine = ((x["run"] == r) & seen).nonzero()[:, 0]
            mask[_blocks(mine[x["time"][mine].argsort(stable=True)])] = True
    else:
        level = _levels(recording)
        blocks = _blocks(level[seen].unique())
        mask = seen & torch.isin(level, blocks)
        if not len(blocks):  # at two conditions replicates are all that there is
            mask[_blocks(seen.nonzero()[:, 0])] = True
    return mask.repeat(len(recording.outputs))


def _blocks(row: Tensor) -> Tensor:
    """What is in every fourth of the blocks of a row, but for the ends."""
    return torch.cat([row[:0], *row.tensor_split(min(BLOCKS, max(len(row), 1)))[1:-1:4]])


def _levels(recording: Recording) -> Tensor:
    """Number of the conditions of every row ``(n,)``, in the order of the first of them."""
    return recording.columns.unique(dim=0, return_inverse=True)[1]  # type: ignore[no-any-return]


def _farthest(distance: Tensor, level: Tensor, seen: Tensor, count: int) -> Tensor:
    """The farthest of the rows that are seen, bool ``(n,)``: up to so many, all of a condition or none of them.

    A fit has seen what is held out where it has seen replicates of it; only where one condition alone has more than
    that, some of them go.
    """
    sizes = torch.bincount(level[seen], minlength=int(level.max()) + 1)
    farness = torch.zeros(len(sizes), dtype=distance.dtype).index_copy_(0, level, distance)
    order = torch.where(sizes > 0, farness, -math.inf).argsort(descending=True, stable=True)
    whole = order[sizes[order].cumsum(0) <= count]
    mask = torch.isin(level, whole) & seen
    if not bool(mask.any()):
        mask[((level == order[0]) & seen).nonzero()[:count, 0]] = True
    return mask


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A model fitted without the held-out data.

    Attributes:
        prediction: Of all outputs, ``(n_total,)``.
        sd: Predictive sd, noise and parameters, ``(n_total,)``.
    """

    prediction: Tensor
    sd: Tensor


def predict(found: Fitted, noise: Noise) -> tuple[Tensor, Tensor]:
    """Prediction of all outputs and its sd, ``(n_total,)`` each."""
    whole = found.problem.recording
    result = found.problem.simulator.linearise(whole.x, found.values[None], whole.outputs, found.free, found.warm)
    spread = ((result.jacobian[0] @ found.covariance()) * result.jacobian[0]).sum(-1).clamp_min(0)
    return result.y[0], (spread + noise.sd.square()).sqrt()


def held_out_fit(found: Fitted, noise: Noise, mask: Tensor) -> HeldOut | None:
    """The same model from the same start, fitted without the data in ``mask``."""
    problem = found.problem.keeping(~mask)
    again = fit(problem, noise.whitening(problem), found.values[None], found.free, warm=found.warm)
    if again is None:
        return None
    prediction, sd = predict(again, noise)
    return HeldOut(prediction, sd)


def score(recording: Recording, prediction: Tensor, sd: Tensor, mask: Tensor) -> Score:
    """RMSE, mean log density and coverage of 95 % intervals over the data in ``mask``."""
    y = recording.y[mask]
    error = y - prediction[mask]
    unit = recording.spread[mask] if len(recording.outputs) > 1 else torch.ones_like(error)
    standard = error / sd[mask]
    density = -0.5 * standard.square() - sd[mask].log() - 0.5 * math.log(2 * math.pi)
    return Score(
        rmse=float((error / unit).square().mean().sqrt()),
        log_score=float(density.mean()),
        coverage=float((standard.abs() <= 1.959964).double().mean()),
        n=int(mask.sum()),
    )


def compare(recording: Recording, before: HeldOut, after: HeldOut, noise: Noise, mask: Tensor) -> tuple[float, float]:
    """Mean gain in squared error over the held-out data, in noise variances, and its standard error.

    Neighbours err together: the standard error comes from block means, and of few blocks it is Student's. Three data
    and fewer say nothing of it: there it is twice that of independent noise around the second model. What the fitted
    data leave open of either model's parameters adds to it, with the root mean square of the squared error that it
    makes: along one direction of them all predictions err together, and that of a χ² with one degree of freedom is √3.
    """
    sd, y = noise.sd[mask], recording.y[mask]
    gain = ((y - before.prediction[mask]) / sd).square() - ((y - after.prediction[mask]) / sd).square()
    blocks = min(len(gain), max(4, int(math.sqrt(len(gain)))))
    if blocks > 3:
        means = torch.stack([part.mean() for part in gain.tensor_split(blocks)])
        error = float(means.std()) * math.sqrt((blocks - 1) / (blocks - 3) / blocks)  # variance of Student's t
    else:
        error = 2 * 2.0 * float(((after.prediction - before.prediction)[mask] / sd).norm()) / len(gain)
    open_ = [math.sqrt(3) * float(((part.sd[mask] / sd).square() - 1).mean()) for part in (before, after)]
    return float(gain.mean()), math.hypot(error, *open_)
