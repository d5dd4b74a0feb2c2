"""Where the mismatch sits: the places that the search found, and what a name acts on before them."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchcal.discovery.fits.local import is_moment
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.places import Place
from torchcal.discovery.misfit.steps import SURER, in_one_run, stepwise
from torchcal.discovery.records import Location, MissingRate, NeededShift, Table
from torchcal.discovery.verdicts.explain import removed
from torchcal.errors import TorchcalError
from torchcal.simulators import is_value_of
from torchcal.terms import Term

__all__ = ["locate", "missing_rate", "needed_shifts", "sharpened"]

#: Shares of the evidence for an output, and for a parameter of several equations, that count beside an equation's.
OUTPUT_SHARE, SEVERAL_SHARE = 0.8, 0.9
#: Sd beyond a bound from which on a parameter is not within it.
SURELY = 2.0
#: A span begins where the estimated change exceeds this share of its largest magnitude.
SPAN_LEVEL = 0.3
#: Share of the points up to which a gap between spans is none, nor a span beside wider ones.
SLIVER = 0.02
#: Digits of log evidence to which two changes are as likely.
TIED = 4
#: Share of what a name removes below which an unknown change of the same place does not tell what it does.
PART = 0.5
#: Share of a place up to which a name hardly acts there.
MEETS = 0.25
#: Log evidence, and share of the misfit, by which a change along two conditions together must do better than any along
#: one, and than the sum of one along each, to be told.
LIKELIER, MORE = 5.0, 0.05
#: Log evidence from which on a place is listed, and how many are.
LEAST_EVIDENCE, LISTED = 2.0, 8


def _extent(values: Tensor) -> float:
    """How far the values of a driver extend."""
    return float(values.max() - values.min())


def _spans(place: Place) -> tuple[tuple[float, float], ...]:
    """Ranges of the driver where the change is large; of an oscillation all of it."""
    values = place.channel.drivers[place.driver]
    if place.period is not None:
        return ((float(values.min()), float(values.max())),)
    return _ranges(values, place.profile, place.sd)


def _ranges(values: Tensor, change: Tensor, sd: Tensor | None = None) -> tuple[tuple[float, float], ...]:
    """Ranges of some values where a change at them is large, and larger than its sd if some of it is; the one where it
    is surest is among them, however narrow."""
    order = values.argsort(stable=True)
    along, size = values[order], change[order].abs()
    high = size >= SPAN_LEVEL * float(size.max())
    surest = -1
    if sd is not None and bool((sure := high & (size > sd[order])).any()):
        high, surest = sure, int((size / sd[order]).where(sure, 0.0).argmax())
    least = SLIVER * len(along)
    found: list[list[int]] = []
    for k in high.nonzero()[:, 0].tolist():
        if found and k - found[-1][1] - 1 <= least:
            found[-1][1] = k
        else:
            found.append([k, k])
    wide = [span for span in found if span[1] - span[0] + 1 > least or span[0] <= surest <= span[1]]
    return tuple((float(along[low]), float(along[high])) for low, high in (wide or found)[:6])


def sharpened(search: Search) -> list[Place]:
    """The places that a search found, by falling evidence, with steps in the stead of smooth changes where these are
    likelier; they are where a constant change in a window has been found to be."""
    known = _place_of_unnamed(search)
    found = [
        stepwise(search.residual, place, surer=0.0 if _key(place) == known else SURER)
        if place.evidence >= LEAST_EVIDENCE else place
        for place in search.structure.places
    ]  # fmt: skip
    best = max((place.evidence for place in found), default=0.0)
    found += [p for p in in_one_run(search.residual, search.structure.channels) if p.evidence > best + SURER]
    # Steps along two drivers that rise together are one: then the smooth change tells which of the two.
    return sorted(found, key=lambda place: -round(place.evidence, TIED))


def _has_levels(search: Search, driver: str) -> bool:
    """Whether a driver has no values but those of the data: a condition, or an input that is held between samples."""
    runs = search.problem.recording.runs
    return runs is None or all(run.holds.get(driver) == "zero" for run in runs)


def _met(values: Tensor, low: float, high: float) -> tuple[float, float]:
    """A range where some values of a driver lie in it, else the nearest of these: edges of a window are smooth, so that
    it may act at a value beside it alone."""
    beyond = torch.maximum(low - values, values - high)
    nearest = int(beyond.argmin())
    return (low, high) if float(beyond[nearest]) <= 0 else (float(values[nearest]), float(values[nearest]))


def _key(place: Place) -> tuple[str, str, str]:
    """Kind, target and driver."""
    return place.channel.kind, place.channel.target, place.driver


def _place_of_unnamed(search: Search) -> tuple[str, str, str] | None:
    """Kind, target and driver of the likeliest change in a window that has no name, where there is one."""
    unnamed = search.unnamed
    return None if unnamed is None or unnamed.window is None else (*_acts_on(unnamed), unnamed.window.driver)


def locate(
    search: Search, found: Sequence[Place], best: Model | None, *, named: bool = False
) -> Table[Location]:
    """Where the mismatch sits; a local term says it best, and of a name what it acts on comes first.

    Args:
        search: The finished one.
        found: Its places.
        best: The accepted model, or the likeliest of those that are tied; None where there is none.
        named: Whether it is accepted.
    """
    rows = []
    local = best if best is not None and best.window is not None else None
    if not named and search.unnamed is not None:  # likelier than all that has a name, and says better where
        local = search.unnamed
    if local is not None and local.window is not None:
        w = local.window
        drivers = search.drivers()[w.driver]
        low = w.low if math.isfinite(w.low) else float(drivers.min())
        high = w.high if math.isfinite(w.high) else float(drivers.max())
        (kind, target), *also = _act_on(local)
        share, evidence, extent = removed(search, local), _evidence(search, local), _extent(drivers)
        span = (low, high)
        if local is search.unnamed:
            told: dict[str, Any]
            if any(is_moment(local.found.problem.parameters[i].name) for i in local.candidate.own):
                more = [("equation", name) for name in _equations(local.candidate.terms[0])[1:]]
                told = {"moment": 0.5 * (w.low + w.high), "also": tuple(more)}
            else:
                scale = search.spans()[w.driver]
                ends = (end for end in (w.low, w.high) if math.isfinite(end) and scale.holds(end))
                told = {"edges": tuple(ends), "at": w.at}
        else:
            told = {"terms": local.names, "also": tuple(also)}
            span = _met(drivers, low, high) if _has_levels(search, w.driver) else span
        rows.append(Location(kind, target, w.driver, (span,), share, evidence, extent=extent, **told))
    sensor = best is not None and _acts_on(best)[0] == "output"  # then it has been shown to be the output
    places = [
        place
        for place in (found if sensor else _by_plausibility(search, found))
        if place.evidence >= LEAST_EVIDENCE
    ]
    apart = None  # an unknown change that is told beside what a name does
    if named and best is not None and best.window is None:
        own, reads = _own_places(search, best), _reads(best)
        places.sort(key=lambda place: _rank(place, own, reads))
        mine = bool(places) and (places[0].channel.kind, places[0].channel.target) in own
        if not mine or places[0].share < PART * removed(search, best):  # as of what an instrument remembers
            likely = sorted(places, key=lambda place: -round(place.evidence, TIED))
            rows.append(_moved(search, best, search.base.y, [place.driver for place in likely]))
        elif (row := _elsewhere(search, best, places[0])) is not None:
            rows.append(row)
            apart = places[0]
    seen: set[tuple[str, str]] = set()
    known = {(row.kind, row.target, row.driver) for row in rows}
    for place in places:
        key = _key(place)
        if key[:2] in seen or (key in known and place is not apart):
            continue
        seen.add(key[:2])
        extent = _extent(place.channel.drivers[place.driver])
        rows.append(Location(*key, _spans(place), place.share, place.evidence, place.period, extent, place.edges,
                             run=place.run))  # fmt: skip
        if len(seen) >= LISTED:
            break
    rows = rows if named else [*_together(search, rows), *rows]
    run = ("run",) if any(row.run is not None for row in rows[:LISTED]) else ()
    return Table(rows[:LISTED], ("kind", "target", *run, "driver", "spans", "share", "evidence"))


def _together(search: Search, rows: Sequence[Location]) -> list[Location]:
    """A change along two conditions together, where no other place tells as much, nor one along each of the two, and no
    term says better where."""
    if search.structure.together is None or any(row.terms for row in rows):
        return []
    place, each = search.structure.together
    known = [(other.evidence, other.share) for other in rows] + [(each.evidence, each.share)]
    if all(place.evidence > evidence + LIKELIER and place.share > share + MORE for evidence, share in known):
        return [Location(*_key(place), (), place.share, place.evidence, together=place.together)]
    return []


def _own_places(search: Search, model: Model) -> set[tuple[str, str]]:
    """Kinds and targets of what a model's terms act on; of a parameter that is no place, the equations it acts in."""
    known = {(place.channel.kind, place.channel.target) for place in search.structure.places}
    outputs = search.problem.recording.outputs
    inside = [] if model.structure is None else [c for c in model.structure.channels if c.kind == "parameter"]
    own: set[tuple[str, str]] = set()
    for term in model.candidate.terms:
        if _is_rate(term):
            own |= {("equation", name) for name in _equations(term)}
        elif term.outputs:
            own |= {("output", name if name in outputs else outputs[0]) for name in term.outputs}  # no name is y
        else:
            for name in (*term.shifts, *term.frees):
                mine = {key for key in known if key[0] == "parameter" and is_value_of(key[1], name)}
                acted = {("equation", state) for c in inside if is_value_of(c.target, name) for state in c.rates}
                own |= mine or acted
    return own


def _rank(place: Place, own: set[tuple[str, str]], reads: set[str]) -> int:
    """Where a name acts and by what it does so comes first, then where it acts."""
    return 2 if (place.channel.kind, place.channel.target) not in own else int(place.driver not in reads)


class _Noting(dict[str, Tensor]):
    """Drivers by name; those that were looked up are noted."""

    def __init__(self, drivers: dict[str, Tensor]) -> None:
        super().__init__(drivers)
        self.noted: set[str] = set()

    def __getitem__(self, name: str) -> Tensor:
        self.noted.add(name)
        return super().__getitem__(name)


def _reads(model: Model) -> set[str]:
    """The drivers that what a model adds is a function of, as far as its functions can be asked."""
    found = model.found
    problem = found.problem
    if not isinstance(problem.recording.x, dict):
        return set()
    drivers = problem.drivers_at_data(found.values[None], found.warm)
    p = problem.parameters_at_data(found.values)
    read: set[str] = set()
    for term in model.candidate.terms:
        noting = _Noting(drivers)
        given = problem.arguments(noting, term.own(p))
        noting.noted.clear()  # the time that every function is given is read by none yet
        try:
            for function in (*term.rates.values(), *term.shifts.values()):
                term.call(function, *given)
            for function in term.outputs.values():
                term.call(function, *given, found.y)
        except TorchcalError:  # not every function works on a row of data, and this is but for words
            pass
        read |= noting.noted
    return read


def _moved(search: Search, model: Model, other: Tensor, drivers: Sequence[str]) -> Location:
    """Where a model moves what another one gives at the data ``(n,)``, along the first of some drivers.

    From the base, where no place stands for its term: that is what the base could not do.
    """
    found = model.found
    size = ((found.y - other) / search.noise.sd[found.problem.index]).abs().nan_to_num(nan=0.0, posinf=0.0)
    at_data = found.problem.drivers_at_data(found.values[None], found.warm)
    driver = next((name for name in drivers if name in at_data), next(iter(at_data)))
    values, which = at_data[driver].unique(return_inverse=True)
    largest = torch.zeros_like(values).scatter_reduce(0, which, size.to(values), "amax")
    (kind, target), *also = _act_on(model)
    spans, share, evidence = _ranges(values, largest), removed(search, model), _evidence(search, model)
    told: dict[str, Any] = {"extent": _extent(values), "terms": model.names, "also": tuple(also)}
    return Location(kind, target, driver, spans, share, evidence, **told)


def _elsewhere(search: Search, model: Model, place: Place) -> Location | None:
    """Where a model's terms act, if hardly in its place.

    An unknown change is known but for what the base makes up for: it may as well be told at the other end.
    """
    found, candidate = model.found, model.candidate
    problem = found.problem
    if place.driver not in problem.drivers_at_data(found.values[None], found.warm):
        return None
    bare = candidate.without(found.values, candidate.amplitudes)
    row = _moved(search, model, problem.evaluate(bare[None], [], found.warm)[0][0], [place.driver])
    values = place.channel.drivers[place.driver].unique()
    acts, told = (_within(values, spans) for spans in (row.spans, _spans(place)))
    return row if bool(acts.any()) and int((acts & told).sum()) <= MEETS * int(told.sum()) else None


def _within(values: Tensor, spans: Sequence[tuple[float, float]]) -> Tensor:
    """Which values lie in one of some ranges, bool."""
    return torch.stack([(values >= low) & (values <= high) for low, high in spans]).any(0)


def _evidence(search: Search, model: Model) -> float:
    """Log evidence of a model under the noise in use, as that of a place is."""
    return search.gain(model.found.chi2) + model.price


def _acts_on(model: Model) -> tuple[str, str]:
    """Kind and target of what the first of a model's terms acts on."""
    return _act_on(model)[0]


def _act_on(model: Model) -> list[tuple[str, str]]:
    """Kinds and targets of what a model's terms act on, in the order of these."""
    return list(dict.fromkeys(_one_acts_on(term) for term in model.candidate.terms))


def _one_acts_on(term: Term) -> tuple[str, str]:
    if _is_rate(term):
        return "equation", _equations(term)[0]
    if term.outputs:
        return "output", next(iter(term.outputs))
    return "parameter", next(iter([*term.shifts, *term.frees]))


def _is_rate(term: Term) -> bool:
    """Whether a term acts by rates: those of its own hidden states alone are how its shifts or outputs come about."""
    return any(name not in term.states for name in term.rates) or not (term.outputs or term.shifts or term.frees)


def _equations(term: Term) -> list[str]:
    """Those that a term acts on, of the base's own states where there are any."""
    return [name for name in term.rates if name not in term.states] or list(term.rates)


def needed_shifts(found: Sequence[Place]) -> list[NeededShift]:
    """The shift of each parameter against the driver that it varies with most, of the places that were found."""
    rows: dict[str, Place] = {}
    for place in found:
        if place.channel.kind == "parameter" and place.channel.target not in rows and place.evidence > 0:
            rows[place.channel.target] = place
    result = []
    for name, place in rows.items():
        values = place.channel.drivers[place.driver]
        order = values.argsort(stable=True)
        pick = order[torch.linspace(0, len(order) - 1, min(60, len(order))).round().long().unique()]
        a, b = values[pick], place.profile[pick]
        ranks = torch.stack([_ranks(a), _ranks(b)])
        correlation = float(torch.corrcoef(ranks)[0, 1].nan_to_num()) if len(pick) > 2 else 0.0
        unit, sd = place.channel.unit, place.sd[pick]
        result.append(NeededShift(name, unit, place.driver, a, b, sd, correlation, place.share))
    return result[:6]


def _ranks(values: Tensor) -> Tensor:
    """Ranks, equal values at the mean of theirs."""
    _, number, counts = values.unique(return_inverse=True, return_counts=True)
    return (counts.cumsum(0) - 0.5 * (counts - 1).double())[number]


def _by_plausibility(search: Search, found: Sequence[Place]) -> list[Place]:
    """Places by falling evidence, where it counts in full in time only for one equation.

    A change of an output can copy whatever any equation does to that output, and instruments err in simple ways: but a
    fast ripple is no wave of a rate that would be larger than all else there. A parameter that acts in several
    equations moves them together.
    """
    def weight(place: Place) -> float:
        return place.evidence * (_plausible(search, place) if search.problem.in_time else 1.0)

    return sorted(found, key=lambda place: -round(weight(place), TIED))


def _plausible(search: Search, place: Place) -> float:
    """Share of the evidence for a place in time that counts."""
    if place.channel.kind == "output":
        return OUTPUT_SHARE
    if place.period is not None and _larger_than_all(search, place):
        return OUTPUT_SHARE**2
    return SEVERAL_SHARE if len(place.channel.rates) > 1 else 1.0


def _larger_than_all(search: Search, place: Place) -> bool:
    """Whether a change is larger than the base's own rate in an equation that it acts in."""
    usual = {c.target: c.usual for c in search.structure.channels if c.kind == "equation"}
    ones = torch.ones_like(place.profile)
    acts = place.channel.rates if place.channel.kind == "parameter" else {place.channel.target: ones}
    return any(float((place.profile * by).abs().max()) > usual.get(name, math.inf) for name, by in acts.items())


def _possible(search: Search, place: Place) -> bool:
    """Whether a parameter stays within its bounds, wherever its shift is told."""
    parameters = {q.name: (q, value) for q, value in
                  zip(search.base.problem.parameters, search.base.values.tolist(), strict=True)}  # fmt: skip
    parameter, value = parameters[place.channel.target]
    low = -math.inf if parameter.low is None else parameter.low
    high = math.inf if parameter.high is None else parameter.high
    moved, open_by = value + place.profile, SURELY * place.sd
    return not bool(((moved + open_by < low) | (moved - open_by > high)).any())


def _first_unnamed(search: Search, places: list[Place]) -> list[Place]:
    """Places with that of the likeliest change that has no name first, where there is one."""
    there = _place_of_unnamed(search)
    return sorted(places, key=lambda place: _key(place) != there)


def missing_rate(search: Search, found: Sequence[Place]) -> MissingRate | None:
    """The best unknown change of one equation, output or parameter, of the places that were found.

    A parameter that changes in time and acts in one equation is a missing rate of that equation, in one run: what it
    does to the rate depends on the states too, which differ between runs at the same time.
    """
    for place in _first_unnamed(search, _by_plausibility(search, found)):
        channel = place.channel
        if place.evidence <= 0:
            continue
        kind, target, unit, size = channel.kind, channel.target, channel.unit, torch.ones_like(place.profile)
        if kind == "parameter" and search.problem.in_time:
            if not channel.rates or not _possible(search, place):
                continue
            if place.driver == "t" and len(channel.rates) == 1 and len(search.problem.recording.runs or ()) == 1:
                kind = "equation"
                target, size = next(iter(channel.rates.items()))
                unit = next((c.unit for c in search.structure.channels if (c.kind, c.target) == (kind, target)), None)
        values, rate, sd = channel.drivers[place.driver], place.profile * size, place.sd * size.abs()
        order = values.argsort(stable=True)
        return MissingRate(
            kind, target, place.driver, values[order], rate[order], sd[order], unit, channel.time, rate,
            run=place.run, share=place.share,
        )  # fmt: skip
    return None
