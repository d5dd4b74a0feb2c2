"""What has no name and acts where a term in a window does.

Something that is in no list may act in a part of a range too, and in a short window many terms do much the same. A term
is named for its own work there: a constant change in the same place, of a parameter of the base or of an output's gain,
with the same ends to choose, must do worse. An instrument that errs beyond a value of its output is such a term too.
A term whose window leaves something is tried in all others: from the base alone its best one is not seen.
"""

import dataclasses
import itertools
import math
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate, prepare
from torchcal.discovery.fits.changes import Places, constant_change, distance, fading_to, places_of
from torchcal.discovery.fits.local import (
    EDGE,
    ENDS,
    WIDTH_OF_EDGE,
    WIDTHS,
    Span,
    is_window,
    localised,
    multiplied,
)
from torchcal.discovery.fits.readings import threshold_of
from torchcal.discovery.hypotheses.model import PRIOR, Hypothetical, Model
from torchcal.discovery.hypotheses.own_noise import likeliest_alone
from torchcal.discovery.hypotheses.screen import Window, windows_of
from torchcal.discovery.hypotheses.search import BETTER, Search
from torchcal.discovery.misfit.channels import channels
from torchcal.discovery.verdicts.verdict import PLAINLY_WHITE
from torchcal.discovery.windows import long_enough, stepped
from torchcal.errors import DomainError, SimulatorError
from torchcal.simulators import Trajectories, is_value_of
from torchcal.terms import Term

__all__ = ["refit_nameless"]

#: Log weight behind the leader down to which a term in a window is held against nameless changes, or before the base
#: from which on one that acts everywhere is; of how many; and against how many changes elsewhere than where it acts.
CLOSE, MOST, ELSEWHERE = 3.0, 3, 2
#: Changes, each in a range of a driver, that a term without a window is held against; and log weight behind it from
#: which on the best of them is tried with other edges than a step's.
IN_RANGES, NEAR = 4, 20.0
#: How many changes are looked at that promise most where no instrument says in which ranges.
PROMISING = 2
#: Shares and χ² by which a change in a range may remove less than the leading term, and still be tried: its effect is
#: taken for linear, and its edges from a coarse grid.
LACKING, LESS = 0.35, 10.0
#: Terms that are tried in all windows of a driver, and places where these may begin or end.
TRIED, CUTS = 4, 14
#: Places within an open window where a nameless change may begin or end, and starts that are refitted with each width
#: of the edges.
INSIDE, STARTS = 10, 2
#: Shares of a window by which its ends are moved for other starts; not at all first.
MOVES = (0.0, -0.15, 0.15, -0.3, 0.3)
#: What the name of a term that fades begins with.
FADING = "a fading "
#: Share of an output's data from which on a range of a driver is where an instrument errs.
ALIKE = 0.9
#: Relative difference up to which two effects are one, and relative size from which on two are independent.
SAME, RANK = 1e-4, 1e-7


def refit_nameless(search: Search) -> None:
    """Constant changes in the windows of the leading terms, where a term in a window leads; and these terms in other
    windows, where their own leave something or do worse. Steps of the base's parameters where a term leads that acts
    everywhere, and is clearly likelier than the base: else it is no name."""
    lead = search.physical_leader
    if search.exact or search.stop.is_set() or lead is None:
        return
    if search.noise.open and lead.window is None:  # with the noise that each of them leaves, one in a window may lead
        lead = likeliest_alone(search) or lead
    if lead.window is None:
        if lead.weight >= math.log(PRIOR["base"]) + CLOSE:
            _Changes.of(search).hold_in_ranges(lead)
        return
    changes = _Changes.of(search)
    changes.hold_against(lead)
    outdone = any(one.weight > lead.weight for one in search.nameless)
    if outdone or search.examine(lead).p_value < PLAINLY_WHITE:  # its window may not be the best that the term has
        again = [(old, one) for old in _rivals(search, lead) if (one := _anywhere(search, old)) is not None]
        before = search.models
        moved = map(long_enough, _refitted(search, [one for _, one in again]))
        for (old, _), new in zip(again, moved, strict=True):
            if new is not None and new.weight > old.weight + BETTER:
                search.models = [m for m in search.models if m is not old] + [new]
        if search.models is not before:
            changes.hold_against(lead)


@dataclass(eq=False)
class _Changes:
    """Changes without a name that leading terms in windows are held against: constant ones, and such as grow from the
    end of an open window, or fade towards it.

    Attributes:
        search: Whose terms these are.
        prior: Log prior probability of each change.
        named: Places where a constant of the list has a name.
        elsewhere: Parameters of the base and gains of outputs, which change whatever acts there, with their effects.
        tried: Places and windows from which one has been refitted.
    """

    search: Search
    prior: float
    named: set[Places | None]
    elsewhere: dict[Places, Tensor]
    tried: set[tuple[Places, str, float, float]] = field(default_factory=set)

    @classmethod
    def of(cls, search: Search) -> "_Changes":
        """Those of a search, whose constants are told to it."""
        problem = search.base.problem
        count = len({(c.kind, c.target) for c in channels(problem, search.base) if c.kind in problem.kinds})
        prior = math.log(PRIOR["none"] / max(count, 1)) - math.log(3.0 * len(search.drivers()))
        alone = {i: c for i, c in enumerate(search.candidates) if c.tangents.shape[::2] == (1, 1)}
        listed = {i: own for i, c in alone.items() if (own := _effect(search, c.terms[0])) is not None}
        search.constants = {i for i, own in listed.items() if _is_constant(search, alone[i], own)}
        # That of an instrument in a part of its range has no name.
        named = {places_of(alone[i]) for i in search.constants if not alone[i].terms[0].outputs}
        physics = [own for i, own in listed.items() if not alone[i].terms[0].outputs]
        return cls(search, prior, named, _elsewhere(search, list(listed.values()), physics))

    def hold_against(self, lead: Model) -> None:
        """Refit changes beside the leading terms in windows: where these act, but no constants that the list names; and
        those elsewhere that come nearest."""
        search = self.search
        near = [m for m in search.models if m.physical and m.window is not None and m.weight > lead.weight - CLOSE]
        wanted: dict[tuple[Places, str], list[Hypothetical]] = {}
        for model in sorted(near, key=lambda m: -m.weight)[:MOST]:
            where, window = places_of(model.candidate), model.window
            if where is None or window is None:
                continue
            others = []
            mine = _effect(search, constant_change(where, search.problem.in_time))
            fresh = [k for k, own in self.elsewhere.items() if mine is None or not _within(own, mine)]
            for place in dict.fromkeys([where, *fresh]):
                key = (place, window.driver, window.low, window.high)
                if (place, window.driver) in wanted or key in self.tried:
                    continue
                self.tried.add(key)
                begun, chi2 = _wanted(search, model, place, self.prior, self.named)
                if place == where:
                    wanted[place, window.driver] = begun
                elif chi2 < search.base.chi2:
                    others.append((chi2, place, begun))
            for _, place, begun in sorted(others, key=lambda one: one[0])[:ELSEWHERE]:
                wanted[place, window.driver] = begun
        self._refit([one for each in wanted.values() for one in each])

    def hold_in_ranges(self, lead: Model) -> None:
        """Refit changes of the base in ranges of drivers beside a leader that acts everywhere: a step of a parameter
        each, where that promises nearly as much, and the best of them with edges to fit where it comes near.

        An instrument that errs beyond a value is held against what happens there; where nothing depends on time,
        against what grows from there, too, as its error does.
        """
        search = self.search
        in_time, removed = search.problem.in_time, 2.0 * (lead.log_evidence - lead.price)
        physics = [place for place in self.elsewhere if place[0][0] == "shifts"]
        if errs := _beyond(search, lead):
            # Of what is not in time the physics may be any function of the conditions, as the output is.
            still = [] if in_time else [(("outputs", name),) for name in search.problem.recording.outputs]
            there = [(model, place) for model in errs for place in (*physics, *still)]
        else:
            there = _promising(search, lead, physics, removed - max(LESS, LACKING * removed))
        begun = []
        for kind in ("step", "grown") if errs and not in_time else ("step",):
            for model, place in there:
                if search.stop.is_set():
                    return
                each, chi2 = self._begun(model, place, kind)
                begun += [(chi2, model, place, each[0])] if each and math.isfinite(chi2) else []
        begun = sorted(begun, key=lambda one: one[0])[:IN_RANGES]
        weights = [-math.inf if one is None else one.weight for one in self._refit([one for *_, one in begun])]
        if weights and max(weights) > lead.weight - max(NEAR, 0.5 * LACKING * removed):
            _, model, place, _ = begun[weights.index(max(weights))]
            self._refit(self._begun(model, place, "edge")[0][:1])

    def _begun(self, model: Model, place: Places, kind: str) -> tuple[list[Hypothetical], float]:
        return _wanted(self.search, model, place, self.prior, self.named, (kind,))

    def _refit(self, wanted: Sequence[Hypothetical]) -> list[Model | None]:
        found = [long_enough(one) for one in _refitted(self.search, wanted)]
        self.search.nameless += [one for one in found if one is not None and one.physical]
        return found


def _beyond(search: Search, model: Model) -> list[Model]:
    """An instrument of a model that errs beyond a value of its output, as one in each range of a driver in which that
    is so on the calibrated base, where it begins: with the instrument true outputs are others than the recorded ones.
    """
    each = {i: threshold_of(search.candidates[i].terms, model.found.by_name) for i in model.numbers}
    number, found = next(((i, one) for i, one in each.items() if one is not None), (0, None))
    if found is None:
        return []
    output, value = found
    problem = search.base.problem
    outputs = problem.recording.outputs
    here = problem.output_of == (outputs.index(output) if output in outputs else 0)  # what has no name is y
    errs = search.base.y[here].abs() > value
    models = []
    for name, driver in search.drivers().items():
        along, order = driver[problem.condition_of[here]].sort(stable=True)
        right = 2 * errs[order].long() - 1
        gain = right.flip(0).cumsum(0).flip(0)[1:] - right.cumsum(0)[:-1]  # of all above a cut, and not below
        gain = gain.masked_fill(along[1:] <= along[:-1], 0).double()
        if len(gain) and float(gain.abs().max()) >= (2 * ALIKE - 1) * len(errs):
            k = int(gain.abs().argmax())
            cut = 0.5 * float(along[k] + along[k + 1])
            low, high = (cut, math.inf) if float(gain[k]) > 0 else (-math.inf, cut)
            window = Window(number, name, low, high, math.nan, math.nan)
            models.append(dataclasses.replace(
                model, numbers=(number,), candidate=search.candidates[number], found=search.base, window=window
            ))  # fmt: skip
    return models


def _promising(
    search: Search, lead: Model, physics: Sequence[Places], least: float
) -> list[tuple[Model, Places]]:
    """The leader as one in a window, and what of the base changes there instead: of the best windows of each parameter
    in every driver the few that remove most of the misfit, and at least so much, for linear."""
    drivers, found = search.drivers(), []
    places = {place[0][1]: place for place in physics}
    there = dataclasses.replace(
        lead, numbers=lead.numbers[:1], candidate=search.candidates[lead.numbers[0]], found=search.base
    )
    for channel in channels(search.base.problem, search.base):
        name = next((one for one in places if is_value_of(channel.target, one)), None)
        if channel.kind != "parameter" or name is None:
            continue
        for w in windows_of(lead.numbers[0], search.residual, channel.matrix, channel.drivers, 0)[0]:
            if w.driver in drivers and w.z**2 > least:
                found.append((w, places[name]))
    best = sorted(found, key=lambda one: -one[0].z)[:PROMISING]
    return [(dataclasses.replace(there, window=w), place) for w, place in best]


def _elsewhere(search: Search, listed: list[Tensor], physics: list[Tensor]) -> dict[Places, Tensor]:
    """Every calibrated parameter of the base that is no window's, and the gain of every output, with its effect
    ``(n, 1)``; but what is the same as another or as an effect of the list.

    An instrument of the list that does what a parameter does everywhere has no better claim to a part of the range: of
    a parameter what counts is the list's ``physics`` alone.
    """
    problem = search.base.problem
    simulator = problem.simulator
    declared = simulator.ode.parameters if isinstance(simulator, Trajectories) else problem.parameters
    free = [problem.parameters[i].name for i in search.base.free]
    names = [q.name for q in declared if not is_window(q.name) and any(is_value_of(one, q.name) for one in free)]
    found: dict[Places, Tensor] = {}
    for place in [("shifts", name) for name in names] + [("gains", name) for name in search.problem.recording.outputs]:
        own = _effect(search, constant_change((place,), search.problem.in_time))
        same = (*(physics if place[0] == "shifts" else listed), *found.values())
        if own is not None and own.norm() > 0 and not any(_within(own, other) for other in same):
            found[(place,)] = own
    return found


def _effect(search: Search, term: Term) -> Tensor | None:
    """What the amplitudes of a term without shapes do to the data, ``(n, amplitudes)``, at the base as it stands: that
    has moved with the noise since the candidates' own tangents. None where it cannot be taken."""
    try:
        tangents = prepare(search.base.problem, search.base, [term], search.fixed).tangents
    except (SimulatorError, DomainError):
        return None
    return tangents[0] if len(tangents) == 1 else None


def _within(own: Tensor, plane: Tensor) -> bool:
    """Whether an effect ``(n, 1)`` is a combination of others ``(n, m)``."""
    left = own - plane @ torch.linalg.lstsq(plane, own, driver="gelsd").solution
    return 0 < float(own.norm()) and float(left.norm()) <= SAME * float(own.norm())


def _refitted(search: Search, wanted: Sequence[Hypothetical]) -> list[Model | None]:
    """Refits with steps for edges where these are better."""
    found = []
    for model in _where_possible(search, wanted):
        if model is not None and model.window is not None:
            with suppress(SimulatorError):
                model = stepped(search, model, model.window.driver)
        found.append(model)
    return found


def _where_possible(search: Search, wanted: Sequence[Hypothetical]) -> list[Model | None]:
    """Refits: none of the user's terms, they may take a simulator where it raises."""
    try:
        return search.refit_together(wanted)
    except SimulatorError:
        return [None] if len(wanted) == 1 else [m for one in wanted for m in _where_possible(search, [one])]


def _rivals(search: Search, lead: Model) -> list[Model]:
    """The best model of each term in a window of the leader's driver, of the leading terms."""
    best: dict[int, Model] = {}
    for model in sorted(search.models, key=lambda m: -m.weight):
        if model.window is not None and lead.window is not None and model.window.driver == lead.window.driver:
            best.setdefault(model.numbers[0], model)
    return list(best.values())[:TRIED]


def _is_constant(search: Search, candidate: Candidate, own: Tensor) -> bool:
    """Whether a candidate with an effect ``(n, 1)`` is a constant change."""
    where = places_of(candidate)
    still = None if where is None else _effect(search, constant_change(where, search.problem.in_time))
    return still is not None and own.shape[1] == 1 and _within(own, still)


def _wanted(
    search: Search,
    model: Model,
    where: Places,
    prior: float,
    named: set[Places | None],
    only: Collection[str] = ("step", "edge", "grown", "faded"),
) -> tuple[list[Hypothetical], float]:
    """A constant in a model's window, with steep edges and with edges to fit; an open window closed as well, with a
    change that grows from its end, and with one that fades towards it; or ``only`` some of these. And the least χ² of
    all their beginnings, for linear."""
    w = model.window
    if w is None:
        return [], math.inf
    driver = search.drivers()[w.driver]
    inside = driver[(driver >= w.low) & (driver <= w.high)]
    span = w.span or search.spans()[w.driver]
    moves = [k * span.size * span.share(w.low, w.high) for k in MOVES]
    moved = [(span.moved(w.low, a), span.moved(w.high, b)) for a, b in itertools.product(moves, moves)]
    ends = [list(dict.fromkeys(moved))]
    if not (math.isfinite(w.low) and math.isfinite(w.high)) and len(inside):
        cuts = inside.double().quantile(torch.linspace(0, 1, INSIDE, dtype=torch.float64)).unique().tolist()
        last = w.low if math.isfinite(w.low) else w.high  # the end that it has, which need not be one of the data
        cuts = sorted({*cuts[1:], last}) if math.isfinite(w.low) else sorted({*cuts[:-1], last})
        ends += [list(itertools.combinations(cuts, 2))] if len(cuts) > 1 else []
    still = constant_change(where, search.problem.in_time)
    edges = {"step": False, "edge": True}
    shapes = [(kind, still, chosen) for chosen in ends for kind in edges] if where not in named else []
    if len(ends) > 1:
        in_time, end = search.problem.in_time, ENDS["from" if math.isfinite(w.low) else "to"]
        grows = distance(w.driver, end, span, in_time)
        shapes.append(("grown", constant_change(where, in_time, grows), ends[0]))
        fading = fading_to(w.driver, end, span, in_time)
        shapes.append(("faded", constant_change(where, in_time, fading), ends[0]))
        term = search.candidates[model.numbers[0]].terms[0]
        if where == places_of(model.candidate) and not term.elapsed:  # whose t is not the window's
            shapes.append(("faded", multiplied(term, f"{FADING}{term.name}", fading), ends[0]))
    found, least = [], math.inf
    for kind, change, chosen in shapes:
        if kind not in only:
            continue
        low, high = chosen[0]
        near = span.edged(low, high)
        local = localised(
            change, w.driver, low, high, near,
            static=not search.problem.in_time, edge=edges.get(kind, False),
        )  # fmt: skip
        try:
            candidate = prepare(search.base.problem, search.base, [local], search.fixed)
            begin, chi2 = _begin(search, model, candidate, chosen, span)
        except (SimulatorError, DomainError):
            continue
        window = dataclasses.replace(w, low=low, high=high, span=near)
        found.append(Hypothetical((), candidate, begin, prior, window))
        least = min(least, chi2)
    return found, least


def _anywhere(search: Search, model: Model) -> Hypothetical | None:
    """A model's term in all windows along the same driver, open ones too, from the best of them."""
    w, term = model.window, search.candidates[model.numbers[0]].terms[0]
    if w is None or len(model.candidate.amplitudes) != 1:
        return None
    span = search.spans()[w.driver]
    cuts = [span.moved(span.low, k / (CUTS - 1) * span.size) for k in range(CUTS)]
    local = localised(term, w.driver, cuts[0], cuts[-1], span, static=not search.problem.in_time, edge=True)
    try:
        candidate = prepare(search.base.problem, search.base, [local], search.fixed)
        begin, _ = _begin(search, model, candidate, list(itertools.combinations(cuts, 2)), span)
    except (SimulatorError, DomainError):
        return None
    window = dataclasses.replace(w, low=cuts[0], high=cuts[-1], span=span)
    return Hypothetical(model.numbers, candidate, begin, model.log_prior, window)


def _begin(
    search: Search, model: Model, candidate: Candidate, ends: Sequence[tuple[float, float]], span: Span
) -> tuple[Tensor, float]:
    """Starting values at a model's base, of the best size each, those of the best few; and the least χ², for linear."""
    known, problem = model.found.by_name, candidate.problem
    known |= {f"{FADING}{name}": value for name, value in known.items()}  # a term that fades begins at its shape
    names = [q.name for q in problem.parameters]
    places = candidate.amplitudes
    widths = [share * span.size for share in (EDGE, *WIDTHS)]
    if not any(name.endswith(WIDTH_OF_EDGE) for name in names):
        widths = widths[:1]
    rows = []
    for width, (low, high) in itertools.product(widths, ends):
        row = candidate.begin.clone()
        for i, name in enumerate(names):
            if is_window(name):
                row[i] = width if name.endswith(WIDTH_OF_EDGE) else low if name.endswith("from") else high
            elif i not in places:
                row[i] = known.get(name, float(row[i]))
        rows.append(row)
    begin = torch.stack(rows)
    y, slope, _ = problem.evaluate(begin, places)
    w = search.noise.whitening(problem)
    left, effect = w.vector(problem.y - y), torch.stack([w(one) for one in slope])
    lost = ~(left.isfinite().all(-1) & effect.square().sum((1, 2)).isfinite())  # solutions that blow up
    left, effect = left.masked_fill(lost[:, None], 0.0), effect.masked_fill(lost[:, None, None], 0.0)
    # Of places where nothing happens the size stays as it is.
    scale = effect.norm(dim=1, keepdim=True).clamp_min(1e-300)
    size = torch.linalg.pinv(effect / scale, rtol=RANK) @ left[..., None]
    begin[:, places] += size[..., 0] / scale[:, 0]
    chi2 = (left - ((effect / scale) @ size)[..., 0]).square().sum(-1)
    chi2 = chi2.masked_fill(lost, torch.inf)
    chi2 = chi2.nan_to_num(nan=torch.inf)
    order = chi2.reshape(len(widths), -1).argsort(-1)[:, :STARTS]
    best = begin.reshape(len(widths), -1, begin.shape[-1])[torch.arange(len(widths))[:, None], order]
    return best.flatten(0, 1), float(chi2.min())
