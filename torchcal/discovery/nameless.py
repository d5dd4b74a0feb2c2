"""What has no name and acts where a term in a window does.

Something that is in no list may act in a part of a range too, and in a short window many terms do much the same. A term
is named for its own work there: a constant change in the same place, of a parameter of the base or of an output's gain,
with the same ends to choose, must do worse. An instrument that errs beyond a value of its output is such a term too.
A term whose window leaves something is tried in all others: from the base alone its best one is not seen.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcal.discovery.begun_in_windows import in_any_window, sudden_change, wanted_changes
from torchcal.discovery.fits.candidates import Candidate, prepare
from torchcal.discovery.fits.changes import Places, constant_change, places_of
from torchcal.discovery.fits.local import is_window
from torchcal.discovery.fits.readings import threshold_of
from torchcal.discovery.hypotheses.model import PRIOR, Hypothetical, Model
from torchcal.discovery.hypotheses.own_noise import likeliest_alone
from torchcal.discovery.hypotheses.refitting import BETTER, refit_together
from torchcal.discovery.hypotheses.screen import Window, windows_of
from torchcal.discovery.hypotheses.search import Search
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
#: Terms that are tried in all windows of a driver.
TRIED = 4
#: Share of an output's data from which on a range of a driver is where an instrument errs.
ALIKE = 0.9
#: Standard deviation of a sudden change, as a share of the range of time and of the usual distance of two samples; by
#: how many of these it is sought off the end of a window; and how many are tried.
MOMENTARY, BETWEEN, BESIDE, SUDDEN = 0.01, 0.5, (-3.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 3.0), 2
#: States up to which each is tried alone; of more only those that the term acts on.
STATES = 8
#: Share of the range of time within which something happens at once in all runs.
AT_ONCE = 0.02
#: Relative difference up to which two effects are one.
SAME = 1e-4


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
        again = [(old, one) for old in _rivals(search, lead) if (one := in_any_window(search, old)) is not None]
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
        named: Places where a constant of the list has a name, and the only sign with which it does; 0 where it has any.
        elsewhere: Parameters of the base and gains of outputs, which change whatever acts there, with their effects.
        tried: Places and windows from which one has been refitted.
    """

    search: Search
    prior: float
    named: dict[Places | None, int]
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
        sides = {i: side for i, own in listed.items() if (side := _constant(search, alone[i], own)) is not None}
        search.constants = {*sides}
        named: dict[Places | None, int] = {}
        for i, side in sides.items():
            if not alone[i].terms[0].outputs:  # that of an instrument in a part of its range has no name
                place = places_of(alone[i])
                named[place] = side if named.get(place, side) == side else 0
        physics = [own for i, own in listed.items() if not alone[i].terms[0].outputs]
        return cls(search, prior, named, _elsewhere(search, list(listed.values()), physics))

    def hold_against(self, lead: Model) -> None:
        """Refit changes beside the leading terms in windows: where these act, but no constants that the list names; and
        those elsewhere that come nearest."""
        search = self.search
        near = [m for m in search.models if m.physical and m.window is not None and m.weight > lead.weight - CLOSE]
        near.sort(key=lambda m: -m.weight)
        wanted: dict[tuple[Places, str], list[Hypothetical]] = {}
        for model in near[:MOST]:
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
                begun, chi2 = wanted_changes(search, model, place, self.prior, self.named)
                if place == where:
                    wanted[place, window.driver] = begun
                elif chi2 < search.base.chi2:
                    others.append((chi2, place, begun))
            for _, place, begun in sorted(others, key=lambda one: one[0])[:ELSEWHERE]:
                wanted[place, window.driver] = begun
        self._refit([one for each in wanted.values() for one in each])
        self._hold_against_sudden(near)

    def _hold_against_sudden(self, near: Sequence[Model]) -> None:
        """Refit what changes a state in a moment when a window begins or ends, where no constant of the list leads:
        what a kick leaves behind looks like what a term does from then on, or until then; the likeliest are first."""
        search, simulator = self.search, self.search.problem.simulator
        if not isinstance(simulator, Trajectories):
            return
        base, found = search.base, list[tuple[float, Hypothetical]]()
        t = base.problem.drivers_at_data(base.values[None], base.warm)["t"]
        between = torch.cat([t[places].diff() for places in base.problem.sequences])
        width = max(MOMENTARY * search.spans()["t"].size, BETWEEN * float(between[between > 0].median()))
        first, last = float(t.min()), float(t.max())
        constant = [places_of(m.candidate) or () for m in near if search.constants.intersection(m.numbers)]
        named = set(itertools.chain.from_iterable(constant))
        for model in near[:MOST]:
            own = places_of(model.candidate) or ()
            moved = tuple(place for place in own if place[0] == "rates" and place[1] in simulator.ode.states)
            alone = simulator.ode.states if len(simulator.ode.states) <= STATES else [name for _, name in moved]
            wanted = [where for where in {*((("rates", state),) for state in alone), moved} if where]
            there = dataclasses.replace(model, found=base)
            for at, where in itertools.product(_turns(model), sorted(wanted)):
                if search.stop.is_set():
                    return
                if named.intersection(where) or (where, "t", at, at) in self.tried:
                    continue
                self.tried.add((where, "t", at, at))
                times = [at + k * width for k in BESIDE if first < at + k * width < last]
                if (one := sudden_change(search, there, where, self.prior, times, width)) is not None:
                    found.append((one[1] + len(where) * math.log(search.problem.n), one[0]))
        best = [one for _, one in sorted(found, key=lambda one: one[0])[:SUDDEN]]
        search.nameless += [one for one in _refitted(search, best) if one is not None and one.physical]

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
        return wanted_changes(self.search, model, place, self.prior, self.named, (kind,))

    def _refit(self, wanted: Sequence[Hypothetical]) -> list[Model | None]:
        found = [long_enough(one) for one in _refitted(self.search, wanted)]
        self.search.nameless += [one for one in found if one is not None and one.physical]
        return found


def _turns(model: Model) -> list[float]:
    """When a model's window begins and ends, where it does so once in a recording, and at that time in all runs."""
    window, problem = model.window, model.found.problem
    if window is None:
        return []
    drivers = problem.drivers_at_data(model.found.values[None], model.found.warm)
    along, t = drivers[window.driver], drivers["t"]
    inside = (along >= window.low) & (along <= window.high)
    begins, ends = list[Tensor](), list[Tensor]()  # between which samples, (2, k) each
    for places in problem.sequences:
        turned = inside[places].long().diff()
        between = torch.stack([t[places][:-1], t[places][1:]])
        if int((turned > 0).sum()) > 1 or int((turned < 0).sum()) > 1:
            return []
        begins.append(between[:, turned > 0])
        ends.append(between[:, turned < 0])
    apart, found = AT_ONCE * float(t.max() - t.min()), []
    for each in (torch.cat(begins, 1), torch.cat(ends, 1)):
        if each.numel() and float(each[0].max() - each[1].min()) <= apart:
            found.append(0.5 * float(each[0].max() + each[1].min()))
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
        return refit_together(search, wanted)
    except SimulatorError:
        return [None] if len(wanted) == 1 else [m for one in wanted for m in _where_possible(search, [one])]


def _rivals(search: Search, lead: Model) -> list[Model]:
    """The best model of each term in a window of the leader's driver, of the leading terms."""
    best: dict[int, Model] = {}
    for model in sorted(search.models, key=lambda m: -m.weight):
        if model.window is not None and lead.window is not None and model.window.driver == lead.window.driver:
            best.setdefault(model.numbers[0], model)
    return list(best.values())[:TRIED]


def _constant(search: Search, candidate: Candidate, own: Tensor) -> int | None:
    """Of a candidate with an effect ``(n, 1)`` that is a constant change, the only sign that it may have, or 0 (any, or
    one in each of several places); None of others."""
    where = places_of(candidate)
    still = None if where is None else _effect(search, constant_change(where, search.problem.in_time))
    if still is None or own.shape[1] != 1 or not _within(own, still):
        return None
    if still.shape[1] > 1:
        return 0
    return candidate.one_sided(candidate.amplitudes[0]) * (1 if float((own * still).sum()) > 0 else -1)
