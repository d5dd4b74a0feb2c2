"""Why the best explanation of a recording may be no name, however probable it is."""

import math

import torch
from torch import Tensor

from torchcal.discovery.model import Model
from torchcal.discovery.problem import Problem
from torchcal.discovery.search import Search

__all__ = ["distinct", "doubt"]

#: Correlation from sample to sample from which on noise of unknown size may be physics that a term has left.
SLOWEST = 0.85
#: Robust over plain sd of the innovations below which they are of several sizes (1 if normal, 0.73 if Laplace's), and
#: data of an output from which on that can be told.
EVEN, MANY = 0.55, 30
#: Correlation along the rows of a grid, in sd, from which on what is left may be noise in the order of the recording.
ALONG = 3.3
#: Times an amplitude's magnitude from which on its sd leaves it open.
OPEN = 10.0


def doubt(search: Search, model: Model) -> str:
    """Why a model is no name, however probable, in words; empty if it may be one."""
    sd = model.found.sd()
    for i in model.candidate.amplitudes:
        size = abs(float(model.found.values[i] - model.candidate.neutral[model.candidate.own.index(i)]))
        if float(sd[i]) > OPEN * size:
            return "but these data leave its size open: more conditions would tell."
    if distinct(search.problem) <= len(model.found.free) + len(model.candidate.own):
        return "but there are hardly more distinct conditions than parameters: more conditions would tell."
    if _noise_is_physics(search, model):
        return (
            "but what it leaves is so slow, or of such uneven size, that it may as well be physics as noise: a known "
            "noise sd, replicates or a repeated run would tell."
        )
    return ""


def _noise_is_physics(search: Search, model: Model) -> bool:
    """Whether what is taken for noise of unknown size may be physics that a model leaves.

    Noise so slow is what a wrong shape leaves, too; and where most of it is small, and some of it large, it is no noise
    of one size.
    """
    noise, problem = search.noise, model.found.problem
    e = noise.whitening(problem).vector(model.found.residual)
    if not problem.in_time and not problem.follows and _along_rows(problem, e) > ALONG:
        return True
    if not noise.open:
        return False
    for k, rho in enumerate(noise.correlation.tolist()):
        mine = e[problem.output_of == k]
        if len(mine) and rho >= SLOWEST:
            return True
        if len(mine) >= MANY and 1.4826 * float(mine.abs().median()) < EVEN * float(mine.square().mean().sqrt()):
            return True
    return False


def _along_rows(problem: Problem, e: Tensor) -> float:
    """Correlation of what is left with the next datum of the recording, in its sd by chance; of the worst output.

    Of a grid of conditions no correlated noise is estimated: the next row of the recording may follow the last in time.
    """
    worst = 0.0
    for k in problem.output_of.unique().tolist():
        mine = e[problem.output_of == k]
        worst = max(worst, float(mine[1:] @ mine[:-1]) / max(float(mine @ mine), 1e-300) * math.sqrt(len(mine)))
    return worst


def distinct(problem: Problem) -> int:
    """Data in use at distinct conditions: replicates do not tell one curve from another."""
    x = problem.recording.x
    columns = torch.stack([c.double() for c in (x.values() if isinstance(x, dict) else [x])], dim=-1)
    which = columns.unique(dim=0, return_inverse=True)[1][problem.condition_of]
    return len(torch.stack([which, problem.output_of], dim=-1).unique(dim=0))
