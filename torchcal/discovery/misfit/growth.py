"""How the sd of unknown noise differs from datum to datum: with what was read, and from run to run."""

import itertools
import math

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.misfit.curves import beyond
from torchcal.discovery.misfit.noise import mine
from torchcal.discovery.misfit.outliers import gross
from torchcal.discovery.misfit.replicates import Replicates, replicates

__all__ = ["growth"]

#: Fewest data of an output whose noise may grow with it; the log-likelihood that this must gain; the ratio of the
#: largest sd to the smallest that is too little; and the powers and offsets, of the largest output, that are tried.
FEWEST, GROWS, LITTLE, POWERS = 20, 3.0, 4.0, (1.0, 0.5)
OFFSETS = (*(10.0**k for k in range(-12, -5)), 1e-5, 3e-5, 1e-4, 3e-4, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
#: How often data are held against the line between their neighbours: once, and so often that a wave of six of them is
#: lost too, where noise must grow as well (one that fades with the output is as large beside its neighbours as noise
#: that grows); and as how many independent data differences count.
FASTER = 3
INDEPENDENT = {1: 0.6, FASTER: 0.32}
#: How much larger the fastest part of one run's residual must be than that of another's, and may be at most (more is
#: rounding); how much longer the usual time between its samples may be; and by how much their ratio may differ beside
#: neighbours that are so many samples away, for runs to have noise of unlike size.
UNLIKE, MOST_UNLIKE, AS_FAST, AGREE, FAR = 1.5, 1000.0, 1.5, 1.4, (4, 6, 8)
#: Share of the differences, the largest, that count for nothing then: outliers and jumps.
TRIMMED = 0.05
#: Log-likelihood by which noise that grows, and differs from run to run beside that, must be better than the latter.
BOTH = 10.0
#: So many data with outputs that small say how noise is there; below them it is no smaller.
SAY = 3
#: How often data that are gross beside noise that grows as they make it are left out of what tells that.
CLEARED = 3
#: Least share of a datum's own noise that smooth curves leave of it.
LEVERAGE = 0.1


def growth(problem: Problem, residual: Tensor, design: Tensor, f: Tensor, before: Tensor) -> Tensor:
    """Noise sd in units of its median, ``(n_total,)``: 1, or growing with the model's output where the scatter does, or
    unlike in runs that scatter otherwise. It is for noise of unknown size.

    Where there are replicates, how far they are off their means takes the place of the residual. Outputs ``f`` are
    those of all data, used or not, ``(n_total,)``; ``before`` is what was found before, by which data are weighed.
    """
    unit, replicated = torch.ones_like(problem.recording.y), replicates(problem)
    for output in range(len(problem.recording.outputs)):
        parts = problem.recorded_of(output)
        if not parts:
            continue
        here = mine(problem, output)
        own = None if replicated is None else replicated[output]
        grown, gain = _growing(problem, residual, design, f.abs(), before, own, parts)
        if problem.in_time:
            alone, without = _in_runs(problem, residual, torch.ones_like(unit), parts)
            beside, more = _in_runs(problem, residual, grown, parts) if gain > 0 else (alone, without)
            grown = alone if without > 0 and without > gain + more - BOTH else grown * beside
        unit[here] = grown[here]
    return torch.where(torch.isfinite(unit), unit, 1.0)


def _growing(
    problem: Problem,
    residual: Tensor,
    design: Tensor,
    f: Tensor,
    before: Tensor,
    replicated: Replicates | None,
    parts: list[Tensor],
) -> tuple[Tensor, float]:
    """An output's noise as it grows with what was read, ``(n_total,)``, and by how much that is likelier; 1 and 0 where
    it is not.

    An sd of a + |f| / max |f|, or its root, as that of counts, is taken for the best of a few a where it makes the
    fastest part of the residual much likelier (by `GROWS`; Laplace's distribution, whose scale a few outliers move
    little), and no smaller than where `SAY` data were looked at: of a blank nothing is known but by them.
    """
    unit = torch.ones_like(problem.recording.y)
    used = f[problem.index[torch.cat(parts)]]
    most = float(used.max())
    if not most > 0:
        return unit, 0.0
    places = torch.cat(parts) if replicated is None else replicated.places
    scatter = residual[places] if replicated is None else replicated.even
    at, kept = problem.index[places], torch.ones(problem.n, dtype=torch.bool)
    for _ in range(CLEARED):
        held = kept[places]
        if replicated is None:
            found = _as_fast(problem, residual, design, f / most, before, [part[kept[part]] for part in parts])
        else:
            found = _grows(scatter[held], f[at][held] / most, float(replicated.freedom - int((~held).sum())))
        if found is None:
            return unit, 0.0
        power, offset, smallest, gain = found
        shape = (offset + (f / most).clamp_min(smallest)) ** power
        out = gross(scatter / shape[at]) & held
        if not bool(out.any()):  # whatever the noise is
            break
        kept[places[out]] = False
    return shape / (offset + float(used.median()) / most) ** power, gain


def _as_fast(
    problem: Problem, residual: Tensor, design: Tensor, f: Tensor, before: Tensor, parts: list[Tensor]
) -> tuple[float, float, float, float] | None:
    """As `_grows` of the fastest part of an output's residual, with outputs in the largest one.

    Smooth curves of several conditions leave what bends along one of them. Noise grows from row to row of a sweep too.
    """
    found = None
    if problem.order is None and problem.sweeps is not None:
        rows = [_off_rows(problem, places, residual) for places in parts]
        left, size = torch.cat([off for off, _ in rows]), f[problem.index[torch.cat([at for _, at in rows])]]
        if len(left) >= FEWEST and _grows(left, size, INDEPENDENT[1] * len(left), 0.0) is None:
            return None
    for times in (FASTER, 1) if problem.order is not None else (1,):
        each = [_fastest(problem, places, residual, design, before, times) for places in parts]
        size = torch.cat([f[problem.index[p]][inside] for p, (_, inside) in zip(parts, each, strict=True)])
        left = torch.cat([fast for fast, _ in each])
        if times > 1 and len(left) < FEWEST:  # of short runs
            continue
        independent = INDEPENDENT[times] if problem.order is not None else 1.0
        found = _grows(left, size, independent * len(left), GROWS if times == 1 else 0.0)
        if found is None:
            break
    return found


def _grows(left: Tensor, size: Tensor, told: float, least: float = GROWS) -> tuple[float, float, float, float] | None:
    """The likeliest power and offset of noise ``(m,)`` that grows with sizes of data, up to 1; the least size that says
    how noise is there; and by how much more than needed it is likelier than noise that does not grow. None where it is
    not.

    Args:
        left: The noise.
        size: How large data are.
        told: As how many independent data it counts.
        least: By how much it must be likelier.
    """
    seen = left != 0  # what is exact, a blank set to zero, is no measure of noise
    e, size, told = left[seen].abs(), size[seen], told * float(seen.double().mean())
    if len(e) < FEWEST:
        return None
    best, found = least - told * math.log(float(e.sum())), None
    none = best
    for power, offset in itertools.product(POWERS, OFFSETS):
        shape = (offset + size) ** power
        if float(shape.max()) < LITTLE * float(shape.min()):
            continue
        like = -told * (math.log(float((e / shape).sum())) + float(shape.log().mean()))
        if like > best:
            best, found = like, (power, offset)
    return None if found is None else (*found, float(size.sort().values[SAY - 1]), best - none)


def _in_runs(problem: Problem, residual: Tensor, unit: Tensor, parts: list[Tensor]) -> tuple[Tensor, float]:
    """An output's noise, in a unit ``(n_total,)``, as it differs from run to run, ``(n_total,)``, and by how much that
    is likelier; 1 and 0 where all runs may be alike.

    Runs are held against those that are sampled as fast; those of one rate together are taken to be as noisy as those
    of another, as differences of neighbours depend on the rate too where noise goes on.
    """
    factor, run_of = torch.ones_like(unit), problem.recording.x["run"].repeat(len(problem.recording.outputs))  # type: ignore[index]
    long = sorted((p for p in parts if len(p) >= FEWEST), key=lambda p: float(problem.steps(p).median()))
    groups: list[list[Tensor]] = []
    for places in long:
        step = float(problem.steps(places).median())
        if not groups or step > AS_FAST * float(problem.steps(groups[-1][0]).median()):
            groups.append([])
        groups[-1].append(places)
    total = 0.0
    for group in groups:
        sizes, gain = _unlike([residual[places] / unit[problem.index[places]] for places in group])
        total += gain
        for places, size in zip(group, sizes, strict=True):
            factor[run_of == run_of[problem.index[places[0]]]] = size
    return factor / factor[problem.index[torch.cat(parts)]].median(), total


def _unlike(residuals: list[Tensor]) -> tuple[list[float], float]:
    """Noise of runs sampled as fast, in that of all, and by how much that is likelier; 1 and 0 where they may be alike.

    They must be unlike in the same way beside near and beside far neighbours: noise that goes on from sample to sample
    otherwise in one run, or physics that one run alone shows, is no noise of another size.
    """
    alike = [1.0] * len(residuals), 0.0
    sizes = [_off_neighbours(r, 1) for r in residuals]
    if len(sizes) < 2 or not UNLIKE * min(sizes) < max(sizes) < MOST_UNLIKE * min(sizes):
        return alike
    ratios = [sum(_off_neighbours(r, apart) for apart in FAR) / size for r, size in zip(residuals, sizes, strict=True)]
    if max(ratios) > AGREE * min(ratios):
        return alike
    told = [INDEPENDENT[1] * len(r) for r in residuals]
    pooled = sum(n * size for n, size in zip(told, sizes, strict=True)) / sum(told)
    gain = sum(n * math.log(pooled / size) for n, size in zip(told, sizes, strict=True)) - GROWS * len(sizes)
    return ([size / pooled for size in sizes], gain) if gain > 0 else alike


def _off_neighbours(r: Tensor, apart: int) -> float:
    """How far data ``(n,)`` are off the middle between those some places before and behind, on average of most."""
    off = (r[apart:-apart] - 0.5 * (r[: -2 * apart] + r[2 * apart :])).abs().sort().values
    return float(off[: math.ceil((1 - TRIMMED) * len(off))].mean())


def _off_rows(problem: Problem, places: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """How far data are off the middle between the rows before and behind them in a sweep, and which these are."""
    r, follows = residual[places], problem.gaps(places).isfinite()
    inside = follows[1:] & follows[:-1]
    return (r[1:-1] - 0.5 * (r[:-2] + r[2:]))[inside] / math.sqrt(1.5), places[1:-1][inside]


def _fastest(
    problem: Problem, places: Tensor, residual: Tensor, design: Tensor, unit: Tensor, times: int = 1
) -> tuple[Tensor, slice]:
    """What a sequence has that no smooth curve has, and at which of its data.

    In an order by how much data are off the line between their neighbours, which hardly any misfit moves, and that
    again so many ``times``; elsewhere what is left beyond smooth curves, weighed by a unit of the noise ``(n_total,)``.
    """
    r = residual[places]
    if len(r) < 2 * times + 1:
        return r[:0], slice(0, 0)
    if problem.order is None:
        basis, size = beyond(problem, places, design, unit), unit[problem.index[places]]
        left = (1 - basis.square().sum(1)).clamp_min(LEVERAGE).sqrt()  # what the curves leave of the noise of a datum
        return (r - size * (basis @ (basis.T @ (r / size)))) / left, slice(None)
    at = problem.order[problem.condition_of[places]]
    at = at if bool((at.diff() > 0).all()) else torch.arange(len(r), dtype=torch.float64)
    weights = torch.ones(1, len(r), dtype=torch.float64)  # of every datum, from so many before it to so many behind it
    for _ in range(times):
        share = (at[1:-1] - at[:-2]) / (at[2:] - at[:-2])
        before, behind = (1 - share) * weights[:, :-2], share * weights[:, 2:]
        weights = _beside(weights[:, 1:-1], 1) - _beside(before, 0) - _beside(behind, 2)
        r, at = r[1:-1] - (1 - share) * r[:-2] - share * r[2:], at[1:-1]
    return r / weights.norm(dim=0), slice(times, -times)


def _beside(weights: Tensor, rows: int) -> Tensor:
    """Weights ``(m, n)`` as those of so many rows farther of ``m + 2``."""
    return torch.nn.functional.pad(weights, (0, 0, rows, 2 - rows))
