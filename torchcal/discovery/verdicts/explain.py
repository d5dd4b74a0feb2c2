"""From the search to the records of a result: how much, and what cannot be told."""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted, fit
from torchcal.discovery.fits.local import ENDS, WIDTH_OF_EDGE, is_window
from torchcal.discovery.fits.starts import starts
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.screen import Window
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.structure import Structure
from torchcal.discovery.records import Estimate, Fit
from torchcal.display import unit_of, units_of
from torchcal.simulators import Trajectories

__all__ = [
    "deeper",
    "depends",
    "estimates",
    "fit_record",
    "identifiability",
    "is_open",
    "misfit_size",
    "one_law",
    "other_minima",
    "removed",
    "stated_sd",
    "surpassed",
]

#: Gaps between data that an end of a window may lie in, where its edge is a step.
GAPS = 200
#: Share of the largest part of a direction that the data do not see from which on a parameter belongs to it.
MIXED = 0.02
#: Smallest squared effect of a direction of unit size, each parameter's effect being 1, that is one.
UNSEEN = 1e-6
#: The same of one that only rounding, of the data's derivatives too, lets have an effect.
ROUNDED = 1e-12
#: Share of an estimate from which on its sd is so large that it may be told in a combination only.
LOOSE = 0.1
#: How many times the size of a parameter an sd must be to say that the data do not determine it; and the share of the
#: data's spread up to which what an estimate does to them is rounding.
BEYOND, NOTHING = 1e5, 1e-6
#: Correlation of what two candidates do from which on they are nearly the same, and log evidence by which refits tell
#: them apart all the same.
NEARLY = 0.99
APART = 5.0
#: Starts from which what is named is fitted again, and steps; a minimum that is higher by less than `RIVAL` in χ² and
#: more than `ELSEWHERE` sd away is another one.
STARTS, AGAIN, RIVAL, ELSEWHERE = 4, 60, 4.0, 4.0
#: By how much lower in χ² a fit from there is the one that is told.
DEEPER = 0.1
#: Correlation of what two accepted terms do to the data, beside what the base may do, from which on one law between
#: them may look like their sum.
ONE_LAW = 0.9
#: Share of its estimate that an sd must be, and correlation of two estimates from which on they are hardly known apart.
HARDLY, TOGETHER = 0.05, 0.98
#: A parameter depends on what acts beside it when that moves it by more than this many of its sd.
MOVED = 2.0


def estimates(
    found: Fitted,
    places: Sequence[int],
    window: Window | None = None,
    intervals: Mapping[int, tuple[float, float]] | None = None,
) -> tuple[Estimate, ...]:
    """Estimates of some parameters, with their intervals where there are any. Without noise the misfit takes its place.

    An sd beyond what the bounds allow, or far beyond the parameter's size, says that the data do not determine it, as
    does no effect at all, or a combination with others that moves no datum, whose sd is rounding. Where the edge of a
    static window is a step, its end is known by the gaps between data that it may lie in.
    """
    sd = stated_sd(found)
    loose = _loose(found)
    unseen, groups = _untold(found, ROUNDED)
    combined = {name for group in groups for name in group}
    bound = {i for i, at in zip(found.free, found.at_bound.tolist(), strict=True) if at}
    result = []
    for i in places:
        q = found.problem.parameters[i]
        value, unit = float(found.values[i]), q.unit
        spread = float(sd[i])
        if window is not None and q.name.endswith(tuple(ENDS.values())):
            simulator = found.problem.simulator
            model = simulator.ode if isinstance(simulator, Trajectories) else simulator
            units = units_of(found.problem.recording, model)
            unit = unit_of(window.driver, units) or None
        if window is not None and not found.problem.in_time and q.name.endswith(tuple(ENDS.values())):
            spread = _stepped_sd(found, i, window, spread)
        allowed = math.inf if q.low is None or q.high is None else q.high - q.low
        if spread > allowed or is_open(found, i, spread) or q.name in unseen or (q.name in combined and bool(loose[i])):
            spread = math.inf
        at_bound = i in bound or (i in found.free and value in (q.low, q.high) and not is_window(q.name))
        result.append(Estimate(q.name, value, spread, unit, at_bound, (intervals or {}).get(i)))
    return tuple(result)


def is_open(found: Fitted, i: int, sd: float) -> bool:
    """Whether the data do not determine a free parameter, by the sd of its estimate.

    That is held against the estimate, and where this is 0 but for rounding against the first guess, or 1.
    """
    value, first, problem = abs(float(found.values[i])), found.problem.parameters[i].initial, found.problem
    if not sd > BEYOND * value:
        return False
    if value:
        moved = value * found.jacobian[:, found.free.index(i)].abs()
        if bool((moved > NOTHING * problem.recording.spread[problem.index]).any()):
            return True
    return sd > BEYOND * abs(first or 1.0)


def stated_sd(found: Fitted) -> Tensor:
    """Standard deviations of all parameters ``(P,)``. Without noise the misfit takes its place."""
    return found.sd() * (misfit_size(found) if isinstance(found.problem.recording.noise, str) else 1.0)


def _stepped_sd(found: Fitted, i: int, window: Window, spread: float) -> float:
    """Sd of a window's end whose edge is a step beside the gaps around, over those that the misfit allows; else as the
    curvature says."""
    pairs = zip(found.problem.parameters, found.values.tolist(), strict=True)
    along = found.problem.drivers_at_data(found.values[None], None)[window.driver].unique()
    if window.span is None or len(along) < 2:
        return spread
    own = next((value for q, value in pairs if q.name.endswith(WIDTH_OF_EDGE)), None)
    at = int(torch.searchsorted(along, found.values[i]).clamp(1, len(along) - 1))
    width = window.span.edge * window.span.size if own is None else own
    if width > float(window.span.distance(along[at], along[at - 1])):
        return spread
    middle, gap = 0.5 * (along[1:] + along[:-1]), along.diff()
    near = (middle - found.values[i]).abs().argsort()[:GAPS]
    middle, gap = middle[near], gap[near]
    rows = found.values.repeat(len(middle), 1)
    rows[:, i] = middle
    chi2 = found.chi2_at(rows)
    weight = gap * (0.5 * (chi2.min() - chi2)).exp()
    weight = weight / weight.sum()
    mean = float(weight @ middle)
    return math.sqrt(float(weight @ ((middle - mean).square() + gap.square() / 12)))


def misfit_size(found: Fitted) -> float:
    """Root of χ² per degree of freedom."""
    return math.sqrt(found.chi2 / max(found.problem.n - len(found.free), 1))


def fit_record(
    found: Fitted,
    structure: Structure | None,
    terms: tuple[str, ...],
    window: Window | None = None,
    intervals: Mapping[int, tuple[float, float]] | None = None,
) -> Fit:
    """A fit as a record."""
    recording = found.problem.recording
    whole = found.problem.simulator.linearise(recording.x, found.values[None], recording.outputs, [], found.warm)
    residual = torch.where(recording.observed, recording.y - whole.y[0], torch.full_like(recording.y, math.nan))
    return Fit(
        terms,
        estimates(found, found.free, window, intervals),
        whole.y[0],
        residual,
        found.chi2,
        structure.p_value if structure else 1.0,
    )


def removed(search: Search, model: Model) -> float:
    """Share of the squared misfit beyond noise that a model removes."""
    freedom = search.problem.n - len(search.base.free)
    excess = search.base.chi2 - (0 if search.exact else freedom)
    left = model.found.chi2 - (0 if search.exact else search.problem.n - len(model.found.free))
    if excess <= 0:
        return 0.0
    return min(max(1.0 - max(left, 0.0) / excess, 0.0), 1.0)


def surpassed(search: Search, model: Model, larger: Model) -> float:
    """Share of the squared misfit that a larger model removes and this one leaves."""
    whole = search.base.chi2 - larger.found.chi2
    return min(max((model.found.chi2 - larger.found.chi2) / whole, 0.0), 1.0) if whole > 0 else 0.0


def depends(known: Sequence[Estimate], other: Sequence[Estimate], beside: Sequence[str]) -> str:
    """Which of the estimates moves most with terms beside those that are named, in a sentence; empty where none does.
    """
    there = {e.name: e for e in other}
    away = {e.name: abs(there[e.name].value - e.value) / max(e.sd, 1e-300) for e in known if e.name in there}
    name = max(away, key=lambda one: away[one], default=None)
    if name is None or away[name] <= MOVED:
        return ""
    return f"{name} depends on what acts beside it: {there[name].amount} with {' and '.join(beside)}."


def identifiability(search: Search, best: Model | None) -> list[str]:
    """Parameters and candidates that these data cannot tell."""
    unseen, mixed = _untold(search.base)
    if best is not None:
        more = _untold(best.found)
        scanned = {best.found.problem.parameters[i].name for i in best.intervals or {}}
        unseen += [name for name in more[0] if name not in scanned]
        mixed += [names for names in more[1] if not scanned & set(names)]
    rows = [f"{name} has no effect on these data" for name in dict.fromkeys(unseen)]
    rows += [
        f"a common change of {', '.join(group)} moves no datum: only combinations can be told"
        for group in _merged(mixed)
    ]
    rows += _hardly_apart(search.base if best is None else best.found, {name for group in mixed for name in group})
    rows += _as_well_elsewhere(search) if best is None else []
    screening = search.screening
    for i, candidate in enumerate(search.candidates):
        if screening.best[i] < 0 and not candidate.blind:
            own = best is not None and best.window is not None and i in best.numbers
            everywhere = ", where it acts everywhere," if own else ""
            rows.append(f"{candidate.name}{everywhere} cannot be told from the parameters of the base")
        for name, (low, high) in () if best is not None and i in best.numbers else candidate.anywhere.items():
            rows.append(f"{name} has no bounds, and was sought from {low:.4g} to {high:.4g}")
    return [*([] if best is None else one_law(best)), *rows, *_nearly_the_same(search)][:12]


def _as_well_elsewhere(search: Search) -> list[str]:
    """Other parameters of the base with which it fits about as well."""
    base, rows, sd = search.base, [], search.base.sd()
    every = search.elsewhere
    for values, chi2 in zip(every, base.chi2_at(every).tolist() if len(every) else (), strict=True):
        more = chi2 - base.chi2
        if more < RIVAL:
            moved = [i for i in base.free if float((values[i] - base.values[i]).abs()) > ELSEWHERE * float(sd[i])]
            told = ", ".join(f"{base.problem.parameters[i].name} = {float(values[i]):.3g}" for i in moved)
            rows.append(f"the base fits about as well (χ² {max(more, 0.0):+.1f}) with {told}")
    return rows


def _nearly_the_same(search: Search) -> list[str]:
    """Groups of candidates of which every two do nearly the same to the data; every such pair is in one of them."""
    pairs: dict[tuple[int, int], float] = {}
    for j, i in itertools.combinations(range(len(search.candidates)), 2):
        c = _alike(search, i, j)
        if c > NEARLY and not _told_apart(search, i, j):
            pairs[j, i] = c
    open_, rows = dict(pairs), []
    while open_:
        group = list(next(iter(open_)))
        for k in range(len(search.candidates)):
            if k not in group and all((min(k, m), max(k, m)) in pairs for m in group):
                group.append(k)
        within = list(itertools.combinations(sorted(group), 2))
        names = [search.candidates[k].name for k in sorted(group)]
        low, high = (f"{end(pairs[pair] for pair in within):.3f}" for end in (min, max))
        least = f"correlation {'' if low == high else 'from '}{low}"
        rows.append(f"{', '.join(names[:-1])} and {names[-1]} are nearly the same here ({least})")
        open_ = {pair: c for pair, c in open_.items() if pair not in within}
    return rows


def _alike(search: Search, i: int, j: int) -> float:
    """Correlation of what two candidates do, of the signs that both may have."""
    screening = search.screening
    c = screening.correlation(i, j)
    if min(screening.best[i], screening.best[j]) < 0:
        return 0.0
    sides = [search.candidates[k].one_sided(search.amplitude(screening.best[k])) for k in (i, j)]
    return c * math.prod(sides) if all(sides) else abs(c)


def one_law(model: Model) -> list[str]:
    """Pairs of accepted terms that do nearly the same to the data, beside what the base's parameters do: a law between
    them looks like their sum."""
    found, candidate = model.found, model.candidate
    names = [q.name for q in found.problem.parameters]
    if len(candidate.terms) < 2:
        return []
    own = [[i for i in candidate.amplitudes if term.brings(names[i])] for term in candidate.terms]
    without = torch.stack([candidate.without(found.values, places) for places in own])
    change = found.whitening((found.y - found.problem.evaluate(without, [])[0]).T)
    slopes = found.whitening(found.jacobian[:, [k for k, i in enumerate(found.free) if i not in candidate.own]])
    slopes = slopes / slopes.norm(dim=0).clamp_min(1e-300)
    left = change - slopes @ torch.linalg.lstsq(slopes, change, rcond=1e-10, driver="gelsd").solution
    unit = left / left.norm(dim=0).clamp_min(1e-8 * float(change.norm()) + 1e-300)  # rounding is like nothing
    rows = []
    for i, j in itertools.combinations(range(len(candidate.terms)), 2):
        alike = float(unit[:, i] @ unit[:, j])
        if alike > ONE_LAW:
            a, b = candidate.terms[i].name, candidate.terms[j].name
            rows.append(f"{a} and {b} do much the same here (correlation {alike:.2f}): one law may look like both")
    return rows


def _untold(found: Fitted, unseen_up_to: float = UNSEEN) -> tuple[list[str], list[list[str]]]:
    """Parameters of a fit that move no datum, and combinations of others that do not, or hardly, and leave two of them
    open."""
    names = [found.problem.parameters[i].name for i in found.free]
    jacobian = found.whitening(found.jacobian)
    size = jacobian.norm(dim=0)
    # Between two data an end of a window moves none.
    mine = [k for k, name in enumerate(names) if not is_window(name)]
    unseen = [names[k] for k in mine if float(size[k]) == 0]
    kept = [k for k in mine if float(size[k]) > 0]
    if len(kept) < 2:
        return unseen, []
    loose = _loose(found)[found.free]
    unit = jacobian[:, kept] / size[kept]
    values, vectors = torch.linalg.eigh(unit.T @ unit)
    groups = []
    for k in (values < unseen_up_to).nonzero()[:, 0].tolist():
        parts = vectors[:, k].abs()
        members = [kept[j] for j in range(len(kept)) if float(parts[j]) > MIXED * float(parts.max())]
        if sum(bool(loose[j]) for j in members) > 1:
            groups.append([names[j] for j in members])
    return unseen, groups


def _loose(found: Fitted) -> Tensor:
    """Which parameters are not known well, bool ``(P,)``: an sd of infinity, or none, is loose too."""
    return ~(stated_sd(found) <= LOOSE * found.values.abs())


def _hardly_apart(found: Fitted, told: Collection[str]) -> list[str]:
    """Parameters of a fit that are not known well, each alone, and go with each other; but those told before."""
    names, sd = [found.problem.parameters[i].name for i in found.free], stated_sd(found)[found.free]
    values, covariance = found.values[found.free], found.covariance()
    size = covariance.diagonal().clamp_min(1e-300).sqrt()
    correlation = (covariance / (size[:, None] * size)).abs()
    open_ = [
        k
        for k, name in enumerate(names)
        if name not in told and not is_window(name) and HARDLY * abs(float(values[k])) < float(sd[k]) < math.inf
    ]
    pairs = [
        [names[j], names[k]] for j, k in itertools.combinations(open_, 2) if float(correlation[j, k]) > TOGETHER
    ]
    rows = []
    for group in _merged(pairs):
        mine = [names.index(name) for name in group]
        least = float(correlation[mine][:, mine].min())
        shares = [100 * float(sd[k] / values[k].abs()) for k in mine]
        each = ", ".join(f"{share:.0f} %" if share < 1000 else "more than 1000 %" for share in shares)
        text = f"{', '.join(group[:-1])} and {group[-1]} are hardly known apart"
        rows.append(f"{text} (correlation of their estimates {least:.3f}; sd of {each})")
    return rows


def _merged(groups: Sequence[list[str]]) -> list[list[str]]:
    """Groups of names, those that share one made one."""
    merged: list[list[str]] = []
    for group in groups:
        apart = [other for other in merged if not set(other) & set(group)]
        together = [name for other in merged if set(other) & set(group) for name in other]
        merged = [*apart, list(dict.fromkeys([*together, *group]))]
    return merged


def deeper(search: Search, model: Model) -> Fitted | None:
    """A better fit of a named model, from the base's first guesses; None where there is none."""
    found = model.found
    again = _from_guesses(search, model) if model.window is None and _sized(search, model) else None
    if again is None or not again.chi2 < found.chi2 - DEEPER:
        return None
    better = fit(found.problem, found.whitening, again.values[None], found.free)
    if better is None or bool((better.at_bound & ~found.at_bound).any()):
        return None
    return better if better.chi2 < found.chi2 - DEEPER else None


def _sized(search: Search, model: Model) -> list[int]:
    """Places of a model's amplitudes that the data determine.

    Where the size is open, as the scale of an unseen state leaves it, there is a valley and no other minimum.
    """
    found, candidate, sd = model.found, model.candidate, model.found.sd()
    if search.exact:
        return []
    away = (found.values - candidate.without(found.values, candidate.amplitudes)).abs()
    return [i for i in candidate.amplitudes if 0 < float(sd[i]) < float(away[i])]


def _from_guesses(search: Search, model: Model) -> Fitted | None:
    """A model fitted again from the base's first guesses, with what its terms bring as it was found."""
    found = model.found
    held = [i for i in range(len(found.values)) if i not in found.free]
    kept = {i: float(found.values[i]) for i in (*held, *model.candidate.own)}
    return search.from_guesses(found, starts(found.problem, STARTS, search.seed, kept), AGAIN)


def other_minima(search: Search, model: Model) -> list[str]:
    """Other estimates of a named term's size that fit about as well, from the base's first guesses.

    The sd that are given are those within one minimum.
    """
    found, sd, places = model.found, model.found.sd(), _sized(search, model)
    again = _from_guesses(search, model) if places else None
    if again is None or again.ends is None or again.ends_chi2 is None:
        return []
    for k in again.ends_chi2.argsort().tolist():
        more = float(again.ends_chi2[k]) - found.chi2
        away = (again.ends[k] - found.values).abs()
        if more < RIVAL and any(float(away[i]) > ELSEWHERE * float(sd[i]) for i in places):
            values = [f"{found.problem.parameters[i].name} = {float(again.ends[k, i]):.3g}" for i in places]
            told = f"{', '.join(values)} fits about as well (χ² {max(more, 0.0):+.1f})"
            return [f"{told}: the sd given holds around one minimum"]
    return []


def _told_apart(search: Search, i: int, j: int) -> bool:
    """Whether refits of two candidates differ by far, whatever their tangents say; or a merged one has stood apart from
    the other beside a third."""
    gone = {i, j} & search.gone
    if any(gone & set(m.numbers) for m in search.models if len(m.numbers) > 1 and m.window is None):
        return True
    a, b = (search.plain.get(k) for k in (i, j))
    return a is not None and b is not None and abs(a.log_evidence - b.log_evidence) > APART


def formulas(model: Model) -> list[str]:
    """The accepted terms' formulas with their estimates."""
    rows = []
    for term in model.candidate.terms:
        own = [i for i in model.candidate.own if term.brings(model.found.problem.parameters[i].name)]
        text = term.formula or f"{term.name} (of which no formula= was given)"
        if model.window is not None:
            text = text.split(" where ")[0]
        if term.elapsed and any(float(run.time[0]) != 0.0 for run in model.found.problem.recording.runs or ()):
            text += f" (its t counted from the first sample of the {term.elapsed})"
        if model.window is not None:
            text += f" where {model.where}"
        rows.append(f"{text}, with " + "; ".join(map(str, estimates(model.found, own, model.window, model.intervals))))
    return rows
