"""What gives a mismatch away beside the residual's structure: bent values, and noise that is not as it should be."""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchcal.discovery.findings.called import joined
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.problem import SWEEP, Problem, breaks, remembered
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.blocks import jumps
from torchcal.discovery.misfit.noise import GRID, LEAST, decorrelated, estimate
from torchcal.discovery.misfit.places import Place
from torchcal.discovery.misfit.replicates import goes_on_along, in_common_at, replicates
from torchcal.discovery.verdicts.doubts import ALONG, along_rows, between_outputs, goes_on
from torchcal.discovery.verdicts.explain import estimates, stated_sd
from torchcal.display import up_to, with_unit

__all__ = [
    "along", "in_blocks", "in_rows", "in_times", "larger_than_given", "more_than_replicates", "shared", "symptoms",
    "together", "unlike",
]  # fmt: skip

#: A base parameter that moves by this many sd when a term is added was bent by it.
BENT = 3.0
#: Share of the noise sd that was given below which a white residual is told; its data, and the correlation of
#: neighbours up to which it is white.
SMALLER, ENOUGH, WHITE = 0.5, 20, 0.4
#: The same of its fastest part, where it is not white: noise with the largest coefficient that is tried, 0.95, has a
#: quarter of its sd there, give or take a chance.
FAR_SMALLER = 0.15
#: Data of a run or sweep from which on its noise is compared with that of others; the probability by chance below which
#: and the ratio of sd from which on they are told to be unlike.
COMPARED, UNLIKE, RATIO = 12, 0.01, 2.0
#: Times what replicates tell of the noise that means of conditions scatter by, from which on that is told where these
#: are in no order; levels of a condition that it takes; and how rarely chance may scatter them so.
SCATTER, MEANS, RARELY = 1.5, 8, 0.005
#: Share of the misfit that a change removes, from which on what it leaves is what is left.
NEARLY_ALL = 0.9
#: How rarely noise of each output may go together by chance as much as what is left of two.
SELDOM = 0.001


def symptoms(search: Search, best: Model | None, larger: str) -> list[str]:
    """Calibrated values, and sizes of the residual, that give the mismatch away, in words.

    ``larger`` is what `in_times` says of the noise.
    """
    base, then = search.base, {}
    if best is not None:
        then = {e.name: e for e in estimates(best.found, range(len(best.found.values)))}
    runs, bent = [], []
    for e, at, sd in zip(estimates(base, base.free), base.at_bound.tolist(), stated_sd(base)[base.free], strict=True):
        moved = 0.0 if best is None else abs(then[e.name].value - e.value)
        is_bent = moved > max(BENT * max(float(sd), 1e-300), 0.001 * abs(e.value))
        with_terms = f"{then[e.name].amount} with {' and '.join(best.names)}" if best is not None else ""
        if at:
            bound = with_unit(f"{e.value:.4g}", e.unit)
            text = f"{e.name} runs to its bound, {bound}, in the calibrated base"
            runs.append(f"{text}; it is {with_terms}" if is_bent else text)
        elif is_bent:
            bent.append(f"{e.name} was bent: {e.amount} in the calibrated base, {with_terms}")
    rows = runs + bent
    if count := int(search.problem.recording.copies.sum()):
        rows.append(
            f"{count} of {search.problem.recording.n} rows are others once more, numbers and all, as of a table or a "
            "run that was read twice: they count once"
        )
    if larger and search.noise.source == "given":
        rows.append(f"the fastest part of the residual{larger} the noise sd that was given")
    elif larger:
        rows.append(f"the noise{larger} the sd that was given")
    if search.coarser > 1:
        rows.append(
            f"the calibrated base misses the data by so many times the noise sd that was given that arithmetic cannot "
            f"weigh it: the noise was taken for {search.coarser:.2g} times as large (noise=\"none\" says that there is "
            "none)"
        )
    elif search.noise.source == "given":
        rows += _too_large(search, base if best is None else best.found)
    return rows


def larger_than_given(search: Search, best: Model | None) -> dict[str, float]:
    """How many times the noise that was given the fastest part of what is left is, of the outputs where it is larger
    than chance would make it."""
    if not search.noise.excess:
        return {}
    # A misfit that is smooth on coarse spacing passes for fast: what leaves less tells more of the noise.
    base, leader = search.base, best or search.physical_leader
    left = base if leader is None or leader.found.chi2 > base.chi2 else leader.found
    noise = estimate(left.problem, left.residual, left.jacobian, search.problem.recording.noise)
    return {name: times * search.coarser for name, times in noise.excess.items()}


def in_times(larger: Mapping[str, float], outputs: Sequence[str]) -> str:
    """Factors in a sentence, behind a space, with the outputs where there are several; empty without any.

    >>> in_times({"a": 2.84}, ["a"]), in_times({"a": 2.84, "b": 1.4}, ["a", "b"])
    (' is 2.8 times', ' of a is 2.8 times and that of b 1.4 times')
    """
    if not larger:
        return ""
    if len(outputs) == 1:
        return f" is {up_to(next(iter(larger.values())))} times"
    (first, times), *others = larger.items()
    text = f" of {first} is {up_to(times)} times"
    return text + "".join(f" and that of {name} {up_to(more)} times" for name, more in others)


def _too_large(search: Search, found: Fitted) -> list[str]:
    """Outputs whose noise was given much larger than what is left, if that is white, or else than its fastest part."""
    rows = []
    problem, outputs = found.problem, search.problem.recording.outputs
    standard = found.residual / search.noise.sd[problem.index]
    spare = problem.n - len(found.free)
    for number, name in enumerate(outputs):
        mine = standard[problem.output_of == number]
        size = math.sqrt(float(mine.square().mean()) * problem.n / max(spare, 1)) if len(mine) >= ENOUGH else 1.0
        slow = max(  # along the rows, and along the condition or time: rows may be in random order
            sum(float(standard[at[1:]] @ standard[at[:-1]]) for at in along if int(problem.output_of[at[0]]) == number)
            for along in (problem.sequences, problem.recorded)
        )
        of = f" of {name}" if len(outputs) > 1 else ""
        if size < SMALLER and slow < WHITE * float(mine @ mine):
            rows.append(
                f"the residual{of} is white and {size:.2g} times the noise sd that was given: with a smaller one, "
                "these data would show smaller effects"
            )
        elif len(mine) >= ENOUGH and float(search.noise.sizes[number, 0]) < FAR_SMALLER:
            rows.append(
                f"the fastest part of the residual{of} is {float(search.noise.sizes[number, 0]):.2g} times the noise "
                "sd that was given: either the noise is as slow as what may be missing, and hides it, or the sd that "
                "was given is too large"
            )
    return rows


def unlike(search: Search, found: Fitted) -> list[str]:
    """Outputs whose unknown noise would have to be another one in some runs or sweeps than in others, in words.

    What acts in one of several sweeps alone looks like noise that is slow in all of them.
    """
    rows: list[str] = []
    problem = found.problem
    if not search.noise.open:
        return rows
    for number, name in enumerate(problem.recording.outputs):
        recorded = problem.recorded_of(number)
        parts = [part for places in recorded for part in _sweeps(problem, places)]
        told = [part for part in parts if len(part) >= COMPARED]
        if len(told) < 2:
            continue
        residual = found.residual / search.noise.unit[problem.index]
        logs, squares = zip(*(_by_memory(problem, part, residual[part]) for part in told), strict=True)
        counts = torch.tensor([len(part) for part in told], dtype=torch.float64)
        square, log_det = torch.stack(squares), torch.stack(logs)
        own = -log_det - 0.5 * counts[:, None] * (square / counts[:, None]).clamp_min(1e-300).log()
        common = -log_det.sum(0) - 0.5 * counts.sum() * (square.sum(0) / counts.sum()).clamp_min(1e-300).log()
        ratio = float(own.amax(1).sum() - common.max())
        chance = float(torch.special.gammaincc(torch.tensor(len(told) - 1.0), torch.tensor(max(ratio, 0.0))))
        chance *= len(problem.recording.outputs)
        size = (square[:, 0] / counts).sqrt()
        if chance < UNLIKE and float(size.max()) > RATIO * float(size.min()):
            kind = "runs" if problem.in_time else "sweeps"
            of = f" of {name}" if len(problem.recording.outputs) > 1 else ""
            worst = told[int(size.argmax())]
            which, count = next(k for k, part in enumerate(parts) if part is worst), len(parts)
            if problem.recording.runs is not None:  # not all of which need have this output
                which = int(problem.recording.x["run"][problem.condition_of[worst[0]]])  # type: ignore[index]
                count = len(problem.recording.runs)
            rows.append(
                f"the residual{of} is not alike in all {kind}: its sd is {float(size.min()):.3g} to "
                f"{float(size.max()):.3g}, largest in the {kind[:-1]} that is number {which + 1} of {count}. "
                "Either the noise differs, or something acts in some of them alone and was taken for slow noise"
            )
    return rows


def _sweeps(problem: Problem, places: Tensor) -> list[Tensor]:
    """One of the `recorded` sequences, split where other conditions change than the one that is swept."""
    x = problem.recording.x
    if problem.in_time or not isinstance(x, dict) or len(x) < 2:
        return [places]
    columns = problem.recording.columns[problem.condition_of[places]]
    return list(places.tensor_split(breaks(columns).nonzero()[:, 0] + 1))


def _by_memory(problem: Problem, places: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Half the log determinant of the correlation of a sweep's noise, and the sum of squares of what is new in each
    datum, for each coefficient in `GRID`, ``(grid,)`` each."""
    rho = remembered(GRID, problem.gaps(places))
    return 0.5 * torch.log1p(-rho.square()).sum(0), decorrelated(residual[:, None], rho).square().sum(0)


def in_rows(search: Search, found: Fitted) -> list[str]:
    """That a fit leaves what is correlated from row to row, where no memory of the noise is sought in that order, in
    words: along the rows of a grid, or of few data that are not in the order of their condition."""
    if search.exact:
        return []
    if not goes_on(found, search.noise):
        problem = found.problem
        rows = None if problem.in_time or problem.order is None else problem.order.diff()
        count = int(torch.bincount(problem.output_of).max())
        if rows is None or count >= LEAST or bool((rows >= 0).all() | (rows <= 0).all()):
            return []
        if along_rows(problem, search.noise.whitening(problem).vector(found.residual)) <= ALONG:
            return []
        return [
            "what is left is correlated from row to row, in the order of the recording: a drift, a hysteresis or noise "
            f"with a memory looks like this, and none is sought in fewer than {LEAST} data"
        ]
    return [
        "what is left is correlated from row to row: noise with a memory looks like this, and is not sought where the "
        f"rows of a grid are in such an order (but along one condition, or in sweeps of {SWEEP} rows and more): all sd "
        "here are those of independent noise"
    ]


def shared(search: Search, found: Fitted, places: Sequence[Place] = ()) -> list[str]:
    """Outputs of which data at one value of a condition share what a fit leaves, in words; but for those of which a
    smooth change along that condition, which is told as the place of the misfit, would leave nothing shared."""
    if search.exact:
        return []
    several = len(search.problem.recording.outputs) > 1
    common = in_common_at(found.problem, search.noise.whitening(found.problem).vector(found.residual))
    located = _located(search, places) if common else ()
    return [
        f"data at one {condition} share what is left{f' of {name}' if several else ''}, {size:.1f} times what they "
        f"differ by, in no order along {condition}: that is no noise of each datum, but something faster than the "
        f"values of {condition} are apart, or an error that data at one {condition} have in common, as of a setting"
        for name, condition, size in common
        if (name, condition) not in located
    ]


def _located(search: Search, places: Sequence[Place]) -> set[tuple[str, str]]:
    """Outputs, and conditions along which a smooth change removes nearly all of the misfit, and leaves nothing of these
    outputs that data at one value share."""
    residual, found = search.residual, set[tuple[str, str]]()
    for place in places:
        if place.share >= NEARLY_ALL:
            left = residual.e - residual.tangent(place.channel.response(place.profile[:, None]))[:, 0]
            still = {(name, condition) for name, condition, _ in in_common_at(search.base.problem, left)}
            found |= {(name, place.driver) for name in search.problem.recording.outputs} - still
    return found


def along(search: Search, found: Fitted) -> list[str]:
    """Outputs of which what a fit leaves goes on along a condition of several, in words."""
    if search.exact:
        return []
    problem = found.problem
    several = len(problem.recording.outputs) > 1
    return [
        f"what is left{f' of {name}' if several else ''} goes on along {condition}, from one value to the next: that "
        "is no noise of each datum, but something that changes faster than what was looked for"
        for name, condition in goes_on_along(problem, search.noise.whitening(problem).vector(found.residual))
    ]


def together(search: Search, found: Fitted) -> list[str]:
    """Two outputs of which what a fit leaves goes together, in words."""
    if search.exact:
        return []
    white = search.noise.whitening(found.problem)
    by_chance, pair = between_outputs(found.problem, white.vector(found.residual), white(found.jacobian))
    if by_chance >= SELDOM:
        return []
    return [
        f"what is left of {pair[0]} goes with what is left of {pair[1]}: that is no noise of each, but something that "
        "acts on both, or noise that they share"
    ]


def in_blocks(search: Search) -> list[str]:
    """Outputs whose replicates differ by blocks of rows, in words: that is no noise of each datum, and nothing that
    the conditions do."""
    rows: list[str] = []
    problem = search.problem
    for name, own in zip(problem.recording.outputs, replicates(problem) or (), strict=False):
        found = jumps(problem, own, search.noise.unit)
        if found:
            of = f" of {name}" if len(problem.recording.outputs) > 1 else ""
            told = joined([str(one) for one in found])
            counted = "% of the mean of all" if found[0].gain else "sd of what they differ by otherwise"
            also = "" if search.noise.source == "given" else ", and the noise was estimated with that in it"
            rows.append(
                f"replicates{of} differ by blocks of rows and hardly within these: {told} ({counted}). Sweeps, days or "
                f"samples differ, or the instrument was set anew{also}. Give a condition that says which block a row "
                "belongs to, and let a parameter or an offset differ with it"
            )
    return rows


def more_than_replicates(search: Search, found: Fitted) -> list[str]:
    """Outputs whose means at the conditions a fit misses by more than replicates tell, but in no order, in words: a
    preparation that replicates share is noise that they do not show."""
    rows: list[str] = []
    problem = found.problem
    if search.noise.source != "replicates":
        return rows
    levels, group = problem.levels
    if max(len(c.unique()) for c in levels.T) < MEANS:
        return rows
    standard = found.residual / search.noise.sd[problem.index]
    # What was fitted took its share of freedom from the means of all outputs, whichever it acts on.
    pairs = torch.stack([group[problem.condition_of], problem.output_of])
    kept = pairs.unique(dim=1).shape[1]
    freedom = max(kept - len(found.free), 1) / kept
    for number, name in enumerate(problem.recording.outputs):
        mine = problem.output_of == number
        which = group[problem.condition_of[mine]]
        count = torch.bincount(which, minlength=len(levels)).double()
        seen = count > 0
        mean = torch.zeros(len(levels), dtype=torch.float64).index_add_(0, which, standard[mine])[seen]
        mean = mean / count[seen].sqrt()
        if len(mean) < MEANS:
            continue
        size = math.sqrt(float(mean.square().mean()) / freedom)
        ordered = [mean[levels[seen][:, k].argsort(stable=True)] for k in range(levels.shape[1])]
        slow = max(float(m[1:] @ m[:-1]) for m in ordered)
        half = 0.5 * len(mean) * torch.tensor(freedom, dtype=torch.float64)
        rare = float(torch.special.gammaincc(half, half * size**2)) < RARELY
        if rare and size > SCATTER and slow < WHITE * float(mean @ mean):
            of = f" of {name}" if len(problem.recording.outputs) > 1 else ""
            rows.append(
                f"the means of replicates{of} are {size:.1f} times as far off as these tell, in no order: something "
                "faster than the conditions are apart, or noise that replicates do not show, as they share a "
                "preparation or a calibration"
            )
    return rows
