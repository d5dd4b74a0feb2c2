"""Sudden changes: an instrument that was exchanged or switched its range, something that began, or acted for a while.

Few numbers say what a step or a bump does, and smooth functions need dozens. Slow noise may take it as well as physics,
and what is left beyond smooth curves is hardly larger for it.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.local import Span
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.misfit.channels import RUN, Channel
from torchcal.discovery.misfit.places import SIZES, Place, is_unseen
from torchcal.discovery.misfit.residual import Residual

__all__ = ["SURER", "Sudden", "in_one_run", "stepwise", "sudden_changes"]

#: Data, or points of a channel, that there are at least on either side of a step: fewer may be outliers.
LEAST = 5
#: Levels of one of several conditions up to which smooth curves follow whatever is along it.
FEW = 5
#: Rows of a grid along one condition up to which each is looked at by itself, and steps that are tried in one at least.
ROWS, EACH = 24, 16
#: Steps that are tried in all outputs together, evenly among their data, and about how many bumps.
MOST = 200
#: Sd of the narrowest bump, in usual gaps between data, and of the widest, as a share of a run.
NARROW, WIDE = 1.5, 0.125
#: Places of the two steps along a driver that are tried in all pairs, and around each of the best two.
COARSE, FINE = 40, 12
#: Log evidence by which steps must be likelier than a smooth change: they are the rarer.
SURER = 3.0
#: Share of its norm that the base's tangents leave of a step's effect at least, for it to be seen.
SEEN = 1e-6


def _logs(along: Tensor) -> Tensor:
    """Log evidence of effects of unit norm for each of `SIZES`, ``(sizes, …)``, by the residual along them."""
    shrink = _shrink().reshape(-1, *(1 for _ in along.shape))
    return 0.5 * (shrink * along.square() + torch.log1p(-shrink))


def _shrink() -> Tensor:
    """Share of what the residual has along an effect that is taken for the effect, for each of `SIZES`."""
    return SIZES.square() / (1 + SIZES.square())


@dataclass(frozen=True, eq=False)
class Sudden:
    """Steps of one output, changes between two of them, and bumps, each in one of its runs or along one of several
    conditions, at any of some places.

    Attributes:
        functions: Steps, 0 before and 1 from there on to the end of their run; then bumps, normal curves; ``(n, K)``.
        steps: How many of them are steps.
        between: Places of two steps of a run with enough data in between, ``(2, P)``.
    """

    functions: Tensor
    steps: int
    between: Tensor

    @classmethod
    def of(cls, problem: Problem, channel: Channel) -> "Sudden | None":
        """Of an output; None where its data are too few."""
        rows = _rows(problem, problem.recording.outputs.index(channel.target))
        fewest = 1 if problem.order is not None else EACH
        most = max(MOST // max(len(rows) * len(problem.recording.outputs), 1), fewest)
        steps, bumps, between, before = [], [], [torch.zeros(2, 0, dtype=torch.long)], 0
        for places, values in rows:
            levels, level = values.unique(return_inverse=True)
            below = level.bincount().cumsum(0)
            at = _steps(below, most)
            steps.append(_over_run(problem, places, (level[:, None] >= at).double()))
            log = Span.of(values, time=problem.in_time).log and _uneven(levels.log()) < _uneven(levels)
            scale = levels.log() if log else levels
            bumps.append(_over_run(problem, places, _filling(_bumps(scale, most)[level])))
            pairs = torch.combinations(torch.arange(len(at))).T
            between.append(pairs[:, below[at[pairs[1]] - 1] - below[at[pairs[0]] - 1] >= LEAST] + before)
            before += len(at)
        functions = torch.cat([torch.zeros(problem.n, 0, dtype=torch.float64), *steps, *bumps], dim=1)
        return cls(functions, before, torch.cat(between, 1)) if functions.shape[1] else None

    def evidence(self, residual: Residual) -> tuple[float, int, Tensor]:
        """Log evidence of one of them against none, with every kind, all of a kind and all `SIZES` as likely.

        The size is that of its whitened effect beyond what the base's parameters make up for. Also returns the number
        of the likeliest, and that one ``(n,)``.
        """
        along, norm = self._along(residual)
        logs = _logs(along) + self._prior
        size, number = divmod(int(logs.argmax()), logs.shape[1])
        height = float(_shrink()[size] * along[number] / norm[number])
        return float(logs.logsumexp((0, 1))), number, height * self._function(number)

    def evidence_of(self, residual: Residual, number: int) -> float:
        """Log evidence of one of them, out of all that are as likely."""
        columns, norm = _beyond_tangents(residual, self._function(number)[:, None])
        return float(_logs(columns.T @ residual.e / norm).logsumexp((0, 1))) + float(self._prior[number])

    @functools.cached_property
    def _prior(self) -> Tensor:
        """Log prior of one of them and of one of `SIZES`, ``(K + P,)``."""
        counts = torch.tensor([self.steps, self.functions.shape[1] - self.steps, self.between.shape[1]])
        each = -(counts.double() * (counts > 0).sum() * len(SIZES)).log()
        return each.repeat_interleave(counts)

    def _function(self, number: int) -> Tensor:
        """One of them, ``(n,)``."""
        alone = self.functions.shape[1]
        if number < alone:
            return self.functions[:, number]
        first, last = self.between[:, number - alone]
        return self.functions[:, first] - self.functions[:, last]

    def _along(self, residual: Residual) -> tuple[Tensor, Tensor]:
        """The residual along their effects, of unit norm, 0 where none is seen; and their norms."""
        first, last = self.between
        columns, norm = _beyond_tangents(residual, self.functions)
        along = columns.T @ residual.e
        inner = columns[:, : self.steps].T @ columns[:, : self.steps]
        own = inner.diagonal()
        square = own[first] + own[last] - 2 * inner[first, last]
        seen = square > SEEN * (own[first] + own[last])
        apart = square.where(seen, torch.inf).sqrt()
        return torch.cat([along / norm, (along[first] - along[last]) / apart]), torch.cat([norm, apart])


def _rows(problem: Problem, output: int) -> list[tuple[Tensor, Tensor]]:
    """Places of an output's data among which sudden changes are sought, and what these follow in: runs in time, or all
    along the only condition; of several along each one, everywhere and where none of the others changes."""
    own = [places for places in problem.sequences if int(problem.output_of[places[0]]) == output]
    if problem.order is not None:
        return [(p, problem.order[problem.condition_of[p]]) for p in own if len(p) >= 2 * LEAST]
    found = []
    for places in own:
        columns = problem.recording.columns[problem.condition_of[places]]
        for k, values in enumerate(columns.T):
            others = torch.cat([columns[:, :k], columns[:, k + 1 :]], dim=1)
            at = others.unique(dim=0, return_inverse=True)[1]
            long = (at.bincount() >= 2 * LEAST).nonzero()[:, 0].tolist()
            parts = [at == level for level in long if 1 < len(long) <= ROWS]
            for part in [torch.ones_like(at, dtype=torch.bool), *parts]:
                if int(part.sum()) >= 2 * LEAST and len(values[part].unique()) > FEW:
                    found.append((places[part], values[part]))
    return found


def _beyond_tangents(residual: Residual, functions: Tensor) -> tuple[Tensor, Tensor]:
    """Whitened effects ``(n, K)`` beyond what the base's parameters make up for, and their norms, infinite where none
    is seen."""
    whitened = residual.found.whitening(functions)
    columns = residual.project(whitened)
    norm = columns.norm(dim=0)
    return columns, norm.where(norm > SEEN * whitened.norm(dim=0), torch.inf)


def _over_run(problem: Problem, places: Tensor, functions: Tensor) -> Tensor:
    """Functions of a run ``(m, K)``, 0 elsewhere, ``(n, K)``."""
    return torch.zeros(problem.n, functions.shape[1], dtype=torch.float64).index_copy_(0, places, functions)


def sudden_changes(problem: Problem, available: Sequence[Channel]) -> list[Sudden]:
    """Steps, changes between two, and bumps of all outputs."""
    found = (Sudden.of(problem, channel) for channel in available if channel.kind == "output")
    return [sudden for sudden in found if sudden is not None]


def _steps(below: Tensor, most: int) -> Tensor:
    """Levels that steps begin at, with enough data on either side, ``(K,)``, by how many there are up to each level,
    ``(m,)``."""
    number = torch.arange(1, len(below))
    before = below[number - 1]
    return _evenly(number[(before >= LEAST) & (below[-1] - before >= LEAST)], most)


def _uneven(levels: Tensor) -> float:
    """How much the gaps between levels differ, in their mean: on the scale that they were chosen on least."""
    gaps = levels.diff()
    return float(gaps.std(correction=0) / gaps.mean())


def _bumps(along: Tensor, most: int) -> Tensor:
    """Normal curves over levels ``(m,)`` that rise, of widths that double, with centres a width apart, ``(m, K)``."""
    span, gap = float(along[-1] - along[0]), float(along.diff().median())
    width, found = NARROW * max(gap, span / most), []
    while gap > 0 and width <= WIDE * span:
        centres = torch.linspace(float(along[0]), float(along[-1]), round(span / width) + 1, dtype=torch.float64)
        found.append(torch.exp(-0.5 * ((along[:, None] - centres) / width).square()))
        width *= 2.0
    return torch.cat(found, dim=1) if found else torch.zeros(len(along), 0, dtype=torch.float64)


def _filling(bumps: Tensor) -> Tensor:
    """Those of bumps ``(n, K)`` that enough data are in."""
    size = bumps.sum(0).square() / bumps.square().sum(0).clamp_min(1e-300)  # of how many data that are alike
    return bumps[:, size >= 0.5 * LEAST]


@dataclass(frozen=True, eq=False)
class _Between:
    """Constant changes of a channel between any of some lower and any of some upper ends, the lower one included.

    Attributes:
        from_low: Which points are not below each lower end, bool ``(L, K)``.
        from_high: The same of the upper ends, ``(U, K)``.
        there: Which pairs of ends have enough points that act in between and outside, and are seen, bool ``(L, U)``.
        norm: Of their effects, ``(L, U)``.
        along: The residual along their effects, scaled to unit norm, ``(L, U)``.
    """

    from_low: Tensor
    from_high: Tensor
    there: Tensor
    norm: Tensor
    along: Tensor

    @classmethod
    def of(cls, residual: Residual, channel: Channel, values: Tensor, low: Tensor, high: Tensor) -> "_Between":
        """Between ends ``(L,)`` and ``(U,)`` of the values ``(K,)`` of a driver."""
        from_low, from_high = ((values >= ends[:, None]) for ends in (low, high))
        acts = _acts(channel)
        count = (from_low & acts).sum(-1)[:, None] - (from_high & acts).sum(-1)  # where the lower end is the lower
        lower, upper = (residual.tangent(channel.response(one.double().T)) for one in (from_low, from_high))
        square = lower.square().sum(0)[:, None] + upper.square().sum(0) - 2 * lower.T @ upper
        whole = residual.found.whitening(channel.response(torch.ones(len(values), 1, dtype=torch.float64)))
        seen = square > max(SEEN * float(whole.norm()), 1e-150) ** 2
        there = (low[:, None] < high) & (count >= LEAST) & (int(acts.sum()) - count >= LEAST) & seen
        norm = square.where(there, 1.0).sqrt()
        along = ((lower.T @ residual.e)[:, None] - upper.T @ residual.e) / norm
        return cls(from_low, from_high, there, norm, along.where(there, 0.0))

    @property
    def inside(self) -> Tensor:
        """Which points are in between, bool ``(L, U, K)``."""
        return self.from_low[:, None] & ~self.from_high

    def logs(self) -> Tensor:
        """Log evidence of each, ``(sizes, L, U)``; −∞ of such as there are none."""
        return _logs(self.along).where(self.there, -math.inf)


def _acts(channel: Channel) -> Tensor:
    """Which of a channel's points do anything to the data, bool ``(K,)``: of an output its own."""
    if channel.matrix.is_sparse:
        return torch.ones(channel.matrix.shape[1], dtype=torch.bool)
    return channel.matrix != 0 if channel.matrix.ndim == 1 else (channel.matrix != 0).any(0)


def stepwise(residual: Residual, place: Place, *, surer: float = SURER) -> Place:
    """A smooth change of a place, or in its stead a constant one that begins, ends, or both, where that is likelier.

    Its profile is the mean over all ends around the likeliest, by how likely they are, so that its edges are as sharp
    as the data tell. Where the base's parameters make up for a constant, it is 0 at the more points.

    Args:
        residual: The fit's.
        place: Of a smooth change.
        surer: Log evidence by which the other must be likelier.
    """
    channel, values = place.channel, place.channel.drivers[place.driver]
    levels = values[_acts(channel)].unique()
    cuts = 0.5 * (levels[1:] + levels[:-1])
    if place.period is not None or place.driver == RUN or len(cuts) < 2 * LEAST:
        return place
    coarse, open_end = _evenly(cuts, COARSE), torch.full((1,), math.inf, dtype=torch.float64)
    low, high = torch.cat([-open_end, coarse]), torch.cat([coarse, open_end])
    every = _Between.of(residual, channel, values, low, high)
    if not bool(every.there.any()) or not bool(torch.isfinite(every.along).all()):
        return place
    prior = _prior(every.there)
    logs = every.logs() + prior
    one = _one_end(every.there)
    likelier = one if float(logs[:, one].logsumexp((0, 1))) >= float(logs[:, ~one].logsumexp((0, 1))) else ~one
    i, j = divmod(int(logs.where(likelier, -math.inf).amax(0).argmax()), len(high))
    low, high, share = _around(cuts, low, i), _around(cuts, high, j), float(prior[i, j])
    near = _Between.of(residual, channel, values, low, high)
    closer = near.logs()
    nearly = float(closer.logsumexp((0, 1, 2))) + share - math.log(int(near.there.sum()))
    evidence = max(float(logs.logsumexp((0, 1, 2))), nearly) - math.log(len(SIZES))
    if evidence < place.evidence + surer:
        return place
    weight, shrink = (closer - closer.logsumexp((0, 1, 2))).exp(), _shrink()[:, None, None]
    mean, inside = shrink * near.along / near.norm, near.inside
    size, i, j = (int(at) for at in torch.unravel_index(closer.argmax(), closer.shape))
    if is_unseen(channel, residual):
        best = inside[i, j]
        more = best if float(best[_acts(channel)].double().mean()) > 0.5 else ~best
        agree = torch.einsum("lu,luk->k", weight.sum(0), (inside == best).double())
        most = inside[..., int((agree + more).argmax())]  # it is 0 there, whichever ends it has
        mean, inside = torch.where(most, -mean, mean), inside ^ most[..., None]
    inside = inside.double()
    profile = torch.einsum("slu,luk->k", weight * mean, inside)
    square = torch.einsum("slu,luk->k", weight * (mean.square() + shrink / near.norm.square()), inside)
    sd = (square - profile.square()).clamp_min(0.0).sqrt()
    removed = float((1 - (1 - _shrink()[size]).square()) * near.along[i, j].square())
    edges = tuple(end for end in (float(low[i]), float(high[j])) if math.isfinite(end))
    taken = residual.share(removed, 1.0 + len(edges))
    return dataclasses.replace(place, evidence=evidence, share=taken, profile=profile, sd=sd, edges=edges)


def in_one_run(residual: Residual, available: Sequence[Channel]) -> list[Place]:
    """Constant changes of outputs and equations that begin, end, or both, in one run of several alone.

    Any run is as likely. What is seen in one run and not in the others is no function of what all of them have.
    """
    found = []
    for channel in available:
        if channel.kind == "parameter" or not {"t", RUN} <= {*channel.drivers}:
            continue
        runs = channel.drivers[RUN]
        every = runs.unique()
        for run in every:
            own = channel.where((runs == run) & (_acts(channel) if channel.kind == "output" else True))
            none = torch.zeros_like(own.time)
            place = stepwise(residual, Place(own, "t", -math.inf, 0.0, none, none))
            if place.edges:
                evidence = place.evidence - math.log(len(every))
                found.append(dataclasses.replace(place, evidence=evidence, run=int(run)))
    return found


def _one_end(there: Tensor) -> Tensor:
    """Which pairs have an open end, bool ``(L, U)``: the first lower or the last upper one."""
    one = torch.zeros_like(there)
    one[0], one[:, -1] = True, True
    return one


def _prior(there: Tensor) -> Tensor:
    """Log prior ``(L, U)`` of pairs that are there: with one end and with two as likely, not by how many these are."""
    one = _one_end(there)
    count = torch.where(one, (there & one).sum(), (there & ~one).sum()).double()
    kinds = int(bool((there & one).any())) + int(bool((there & ~one).any()))
    return -(count * kinds).clamp_min(1.0).log()


def _evenly(cuts: Tensor, count: int) -> Tensor:
    """At most so many of some ascending values, evenly among them."""
    return cuts[torch.linspace(0, len(cuts) - 1, min(count, len(cuts))).round().long().unique()]


def _around(cuts: Tensor, ends: Tensor, number: int) -> Tensor:
    """Of all cuts such as lie between the neighbours of one end; an open end stays."""
    end = ends[number]
    if not math.isfinite(end):
        return end[None]
    near = cuts[(cuts >= ends[max(number - 1, 0)]) & (cuts <= ends[min(number + 1, len(ends) - 1)])]
    return torch.cat([end[None], _evenly(near[near != end], FINE)]).sort().values
