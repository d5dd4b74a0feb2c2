"""Local terms: candidates that act in a range of one driver only, refitted where they promise more than everywhere."""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import prepare, spread_values
from torchcal.discovery.fits.local import EDGE, ENDS, SHORT, WIDTH_OF_EDGE, WIDTHS, Span, beyond, is_window, localised
from torchcal.discovery.hypotheses.aliases import copies
from torchcal.discovery.hypotheses.model import PRIOR, Hypothetical, Model
from torchcal.discovery.hypotheses.refitting import improve, refit_together
from torchcal.discovery.hypotheses.screen import Window, windows_of
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.channels import responses
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.verdicts.instruments import only_instruments
from torchcal.discovery.verdicts.verdict import PLAINLY_WHITE
from torchcal.errors import DomainError, SimulatorError
from torchcal.simulators import Trajectories

__all__ = ["long_enough", "refit_local", "stepped"]

#: Refits at most, in windows that promise much and in the leader's; of one candidate; around one refitted term; how
#: many of those, and how many more of terms that the base has everywhere.
MOST, MOST_EACH, MOST_AROUND, LEADING, HELD = 12, 2, 2, 3, 1
#: Candidates that are tried on the other side of the leader's edge.
MOST_BEYOND = 6
#: χ² by which the best window along one more driver may promise less than the best of all.
NEARLY = 6.0
#: Score below which a window promises nothing, and the share that it may lack of what the best term removes: its edges
#: are taken from a coarse grid, and its effect for linear.
LEAST_SCORE, LACKING = 3.5, 0.1
#: How often windows are sought anew around the leading terms.
ROUNDS = 2
#: Log evidence below the best up to which a local model's edges are made sharp; log odds up to which a candidate counts
#: as tried along the driver of the leader's window.
CLOSE = 10.0
#: Share of a window within another one along the same driver from which on they are one start.
ALIKE = 0.7
#: Share of the largest log evidence from which on a term whose shape stays at an end of its range is begun at others,
#: and how many at most.
STUCK, MOST_STUCK = 0.7, 4
#: Log odds up to which the two sides of an edge are as good, and by which a window that holds no datum must be better.
AS_GOOD, AS_WELL = 0.5, 3.0
#: Relative difference of χ² up to which two windows of one term and driver are one.
SAME = 1e-4
#: How far ends are moved for other starts, as a share of the driver's range: where they are sought, and sharpened.
SHIFT, FINE = 0.1, 0.03
#: The same as a share of the window itself, which ends moved towards each other would close.
WITHIN = 0.4
#: Data below which no window is sought; nor is any without noise, where a window bends to whatever is left.
LEAST = 30
#: Gaps between data, around an edge that was found, where it is tried as a step; and fits from there.
NEIGHBOURS, STEPPED = 12, 6
#: Factors by which a size may change then.
RESIZED = (0.02, 50.0)


def refit_local(search: Search) -> None:
    """Windows that promise more than the same term everywhere."""
    if search.exact or search.problem.n < LEAST:
        return
    gains = {model.numbers[0]: 2 * model.log_evidence + math.log(search.problem.n) for model in search.models}
    highest = 2 * max((model.log_evidence for model in search.models if model.physical), default=0.0)
    same = copies(search)
    promising: dict[int, list[Window]] = {}
    for w in sorted(search.local, key=lambda w: -w.z):
        plain = max(gains.get(w.candidate, 0.0), search.screening.score(w.candidate) ** 2)
        enough = max(plain + 6.0, highest - max(10.0, LACKING * highest))
        if w.candidate not in same and w.z > LEAST_SCORE and w.z**2 > enough:
            promising.setdefault(w.candidate, []).append(w)
    prior = math.log(PRIOR["local"] / max(len(search.candidates), 1))
    spans = search.spans() if promising else {}
    chosen = sorted((w for each in promising.values() for w in _different(each, spans)), key=lambda w: -w.z)
    _keep_all(search, [_begun(search, w, prior) for w in chosen[:MOST]])
    search.reweigh()
    seen: set[int] = set()
    for _ in range(ROUNDS):
        singles = sorted((m for m in search.models if len(m.numbers) == 1), key=lambda m: m.log_evidence)
        ranked = sorted({m.numbers: m for m in singles}.values(), key=lambda m: -m.log_evidence)
        # What the base has everywhere has no fit of its own that its windows could be sought around.
        held = [m for m in ranked if search.screening.best[m.numbers[0]] < 0]
        leading = [*ranked[:LEADING], *(m for m in held[:HELD] if m not in ranked[:LEADING])]
        fresh = [m for m in leading if id(m) not in seen and search.examine(m).p_value < PLAINLY_WHITE]
        seen |= {id(m) for m in fresh}
        near = [(model, w) for model in fresh for w in _around(search, model)[:MOST_AROUND]]
        _keep_all(search, [_begun(search, w, prior, model) for model, w in near])
    search.reweigh()
    if _rivals(search, prior):
        search.reweigh()
    if _reshape(search):
        search.reweigh()
    before = _drivers_of_leads(search)
    _refine_edges(search, prior)
    if not _drivers_of_leads(search) <= before and _rivals(search, prior, edge=True):  # sharp edges put another first
        search.reweigh()
    _turn(search, prior)
    _hand_back(search)


def _hand_back(search: Search) -> None:
    """Begin the leader's term everywhere from what it has come to in a window, which may be a better minimum."""
    lead = search.physical_leader
    if lead is None or lead.window is None or lead.numbers[0] not in search.plain:  # what the base has everywhere
        return
    candidate, names = search.candidates[lead.numbers[0]], [q.name for q in lead.found.problem.parameters]
    begin = spread_values(candidate.problem, names, lead.found.values)
    improve(search, [Hypothetical(lead.numbers, candidate, begin[None], search.prior)])
    search.reweigh()


def _turn(search: Search, prior: float) -> None:
    """What the base has everywhere does the same on one side of an edge as on the other with the other sign.

    Of the two the leader gets the one with fewer data.
    """
    lead = search.physical_leader
    if lead is None or lead.window is None or search.screening.best[lead.numbers[0]] >= 0:
        return
    w, driver = lead.window, search.drivers()[lead.window.driver]
    inside = ((driver >= w.low) & (driver <= w.high)).double().mean()
    if math.isfinite(w.low) == math.isfinite(w.high) or float(inside) <= 0.5:
        return
    low, high = (-math.inf, w.low) if math.isfinite(w.low) else (w.high, math.inf)
    # Of the amplitude the sign counts, and the order of magnitude: the fit begins near the base.
    other = dataclasses.replace(w, low=low, high=high, amplitude=-_amplitude(search, lead)[2])
    (turned,) = _refit(search, [_begun(search, other, prior, edge=True, span=w.span)])
    if turned is not None:
        turned = stepped(search, turned, w.driver)
    if turned is not None and turned.physical and turned.weight > lead.weight - AS_GOOD:
        search.models.remove(lead)
        _keep(search, turned)


def _reshape(search: Search) -> bool:
    """Begin what does nearly as much as the best, in a window and with a shape at an end of its range, at its other
    shapes: ends of the window and that shape make up for each other, so that there may be a better minimum.

    Returns whether there was any.
    """
    highest = max((m.log_evidence for m in search.models), default=0.0)
    wanted: list[Hypothetical | None] = []
    seen: set[tuple[int, ...]] = set()
    for model in sorted(search.models, key=lambda m: -m.log_evidence):
        if model.window is None or model.numbers in seen or model.log_evidence < STUCK * highest:
            continue
        seen.add(model.numbers)
        parameters, plain = model.found.problem.parameters, search.candidates[model.numbers[0]]
        own = {plain.problem.parameters[i].name: k for k, i in enumerate(plain.own) if i not in plain.amplitudes}
        held = set(own) & set(model.found.stuck)
        stuck = [i for i in model.candidate.own if parameters[i].name in held]
        if stuck and len(wanted) < MOST_STUCK:
            begin = model.found.values.repeat(len(plain.shapes), 1)
            begin[:, stuck] = plain.shapes[:, [own[parameters[i].name] for i in stuck]]
            begin = begin.unique(dim=0)
            wanted.append(Hypothetical(model.numbers, model.candidate, begin, model.log_prior, model.window))
    _keep_all(search, wanted)
    return bool(wanted)


def _leads(search: Search) -> list[Model]:
    """The leader, and the physical one if that is another."""
    return list({id(model): model for model in (search.leader, search.physical_leader) if model is not None}.values())


def _drivers_of_leads(search: Search) -> set[str]:
    """Along which the leading models have a window."""
    return {model.window.driver for model in _leads(search) if model.window is not None}


def _rivals(search: Search, prior: float, *, edge: bool = False) -> bool:
    """Hold what leads in a window against the other candidates in that window, where many do the same if it is short,
    and beyond its edge, if it has one.

    A term that is no physics may lead too, where the range is right and the term is not.

    Returns whether there was any.
    """
    return any([_rivals_of(search, prior, lead, edge=edge) for lead in _leads(search)])


def _rivals_of(search: Search, prior: float, lead: Model, *, edge: bool = False) -> bool:
    """The other candidates in the window of one; with edges to fit where its own have been."""
    if lead.window is None:
        return False
    w = lead.window
    tried = {
        m.numbers[0] for m in search.models
        if m.window is not None and m.window.driver == w.driver and m.weight > lead.weight - CLOSE
    }  # fmt: skip
    others: dict[int, Window] = {}
    for other in sorted(search.local, key=lambda other: -other.z):
        if other.driver == w.driver and other.z > LEAST_SCORE and other.candidate not in search.gone:
            others.setdefault(other.candidate, other)
    wanted = [dataclasses.replace(one, low=w.low, high=w.high) for i, one in others.items() if i not in tried][:MOST]
    if math.isfinite(w.low) != math.isfinite(w.high):
        wanted += [_beyond_the_edge(search, other, w) for other in list(others.values())[:MOST_BEYOND]]
    _keep_all(search, [_begun(search, one, prior, edge=edge) for one in wanted])
    return bool(wanted)


def _beyond_the_edge(search: Search, other: Window, w: Window) -> Window:
    """A candidate on the other side of the edge of a window with one: nearly what the base has does nearly the same
    there, with the other sign."""
    low, high = (-math.inf, w.low) if math.isfinite(w.low) else (w.high, math.inf)
    candidate = search.candidates[other.candidate]
    side = candidate.one_sided(search.amplitude(search.screening.acting[other.candidate]))
    return dataclasses.replace(other, low=low, high=high, amplitude=abs(other.amplitude) * side or -other.amplitude)


def _different(ranked: list[Window], spans: dict[str, Span]) -> list[Window]:
    """The best windows of a candidate, no two of them along one driver with most of the one within the other; and those
    along yet other drivers that promise nearly as much."""
    kept: list[Window] = []
    for w in ranked:
        span = spans[w.driver]
        own = span.share(w.low, w.high)
        within = [span.share(max(w.low, o.low), min(w.high, o.high)) for o in kept if o.driver == w.driver]
        if len(kept) >= MOST_EACH and (within or w.z**2 < kept[0].z ** 2 - NEARLY):
            continue
        if max(within, default=0.0) < ALIKE * own:
            kept.append(w)
    return kept


def _refine_edges(search: Search, prior: float) -> None:
    """The best local models again with edges as steep as the data want."""
    ranked = sorted((m for m in search.models if m.physical), key=lambda m: -m.weight)
    if not ranked:
        return
    least = ranked[0].log_evidence - max(CLOSE, 0.02 * ranked[0].log_evidence)
    drivers, spans = search.drivers(), search.spans()
    for model in ranked[:MOST]:
        if model.window is None or model.log_evidence < least:
            continue
        w = dataclasses.replace(model.window, amplitude=_amplitude(search, model)[2])
        span = spans[w.driver]
        scales = [span, dataclasses.replace(span, log=False)] if span.log else [span]
        found = _refit(search, [_begun(search, w, prior, model, edge=True, span=scale) for scale in scales])
        other = max((one for one in found if one is not None), key=lambda one: one.weight, default=None)
        if other is not None:
            other = stepped(search, other, w.driver)
        if other is not None and _better(other, model, drivers[w.driver]):
            search.models.remove(model)
            _keep(search, other)


def stepped(search: Search, model: Model, driver: str) -> Model:
    """A static local model with steps for edges, each between two of the data near the edge that was found, if better.

    The misfit of a step jumps from datum to datum, and slopes lead to none of its minima.
    """
    if search.problem.in_time:  # time steps are not chosen to meet a step
        return model
    problem, values = model.candidate.problem, model.found.values
    along = search.drivers()[driver].unique()
    between = 0.5 * (along[1:] + along[:-1])
    choices = []
    for q, value in zip(problem.parameters, values.tolist(), strict=True):
        if q.name.endswith(WIDTH_OF_EDGE):
            choices.append(torch.tensor([q.low], dtype=torch.float64))
        elif is_window(q.name):
            choices.append(between[(between - value).abs().argsort()[:NEIGHBOURS]])
        else:
            choices.append(torch.tensor([value], dtype=torch.float64))
    begin = torch.cartesian_prod(*choices)
    # Each with the size that suits it, to first order: that of soft edges beside a datum may be any.
    w, sizes = search.noise.whitening(problem), model.candidate.amplitudes
    neutral = model.candidate.without(values, sizes)
    without = problem.evaluate(neutral[None], [])[0]
    left, effect = w.vector(problem.y - without), w.vector(problem.evaluate(begin, [])[0] - without)
    factor = (effect @ left[0]) / effect.square().sum(-1)
    factor = factor.nan_to_num(nan=1.0).clamp(*RESIZED)  # a step may hold no datum
    misfit = (left - factor[:, None] * effect).square().sum(-1)
    begin[:, sizes] = neutral[sizes] + factor[:, None] * (begin[:, sizes] - neutral[sizes])
    begin = begin[misfit.nan_to_num(nan=torch.inf).argsort()[:STEPPED]]
    again = Hypothetical(model.numbers, model.candidate, begin, model.log_prior, model.window)
    (other,) = _refit(search, [again])
    return other if other is not None and _better(other, model, along) else model


def _better(other: Model, model: Model, along: Tensor) -> bool:
    """Whether another local model is better, by the values of their windows' driver at the data ``(m,)``. By its soft
    edges a window acts on data beside it as well as a step that holds them does."""
    lead = other.weight - model.weight
    holds = [w is None or bool(((along >= w.low) & (along <= w.high)).any()) for w in (other.window, model.window)]
    return lead + AS_WELL * (holds[0] - holds[1]) > 0


def _keep(search: Search, model: Model | None) -> None:
    """Add a model, unless the same one was found before from another start."""
    if model is None or model.window is None:
        return
    for other in search.models:
        if other.window is not None and other.numbers == model.numbers and other.window.driver == model.window.driver:
            if abs(other.found.chi2 - model.found.chi2) < SAME * max(1.0, model.found.chi2):
                return
    search.models.append(model)


def _around(search: Search, model: Model) -> list[Window]:
    """Where a refitted term had better act, by what it does at its own fit: the best window of every driver.

    At the base a strong effect is far from linear; here only its range is still wrong.
    """
    found, term = model.found, model.candidate.terms[0]
    bound = found.problem.simulator
    moves = bool(term.rates or term.shifts)
    if term.states or term.frees:
        return []
    if term.outputs and isinstance(bound, Trajectories) and (moves or only_instruments(model)):
        return []
    column = search.screening.acting[model.numbers[0]]
    if column < 0:
        return []
    names = [q.name for q in found.problem.parameters]
    plain = search.candidates[model.numbers[0]]
    place, amplitude, value = _amplitude(search, model)
    own = [i for i, name in enumerate(names) if name == amplitude or is_window(name)]
    everywhere = found.values.clone()
    for i, name in enumerate(names):
        if is_window(name):
            everywhere[i] = beyond(found.problem.parameters[i])
    residual = Residual(found, search.noise, seed=search.seed, draws=10, without=own)
    if moves and isinstance(bound, Trajectories):
        states = bound.solve(found.values[None], found.warm)
        with torch.no_grad():
            forcing, present = (
                bound.steps.derivatives(values[None], states, [place])[2][0]
                for values in (everywhere, found.values)
            )
        response, drivers, _ = responses(found.problem, found, torch.cat([forcing, present], dim=-1))
        response, acting = response[:, :, 0], response[:, :, 1].sum(1)
    elif place in found.free:
        acting = found.jacobian[:, found.free.index(place)]
        response = found.problem.evaluate(everywhere[None], [place])[1][0, :, 0]
        drivers = found.problem.drivers_at_data(found.values[None], found.warm)
    else:
        return []
    residual.e = residual.e + residual.tangent(value * acting[:, None])[:, 0]
    sign = plain.one_sided(search.amplitude(column))
    named = search.drivers()
    kept: dict[str, Window] = {}
    for w in sorted(windows_of(model.numbers[0], residual, response, drivers, sign)[0], key=lambda w: -w.z):
        if w.driver in named and w.driver not in kept and w.z > LEAST_SCORE:
            kept[w.driver] = w
    return list(kept.values())


def _amplitude(search: Search, model: Model) -> tuple[int, str, float]:
    """Of a model of one term: the place of its amplitude, its name, and how far it is from neutral."""
    plain = search.candidates[model.numbers[0]]
    column = search.screening.acting[model.numbers[0]]  # local models come of candidates that have one
    name = plain.problem.parameters[search.amplitude(column)].name
    place = [q.name for q in model.found.problem.parameters].index(name)
    return place, name, float(model.found.values[place]) - model.candidate.neutral_at(place)


def _begun(
    search: Search,
    w: Window,
    prior: float,
    near: Model | None = None,
    *,
    edge: bool = False,
    span: Span | None = None,
) -> Hypothetical | None:
    """Base and one local term, begun at the window that the screening found, from the base or near a model of it."""
    plain = search.candidates[w.candidate]
    span = span or search.spans()[w.driver]
    term = plain.terms[0]
    if term.frees or not span.high > span.low or (span.log and w.high <= 0):
        return None
    span = span.edged(w.low, w.high)
    local = localised(term, w.driver, w.low, w.high, span, static=not search.problem.in_time, edge=edge)
    try:
        candidate = prepare(search.base.problem, search.base, [local], search.fixed, screened=False)
    except (SimulatorError, DomainError):
        return None
    column = search.screening.acting[w.candidate]
    amplitude = search.amplitude(column)
    names = [q.name for q in plain.problem.parameters]
    values = dict(zip([names[i] for i in plain.own], plain.shapes[int(search.screening.shape[column])].tolist(),
                      strict=True))  # fmt: skip
    size = w.amplitude
    if near is None:
        size *= 0.02
    else:
        values = near.found.by_name
    values[names[amplitude]] = plain.neutral_at(amplitude) + size
    ends = {f"{term.name}.{ENDS['from']}": w.low, f"{term.name}.{ENDS['to']}": w.high}
    shift = span.size * min(FINE if edge else SHIFT, WITHIN * span.share(w.low, w.high))
    choices = []
    for q, start in zip(candidate.problem.parameters, candidate.begin.tolist(), strict=True):
        if q.name in ends:
            choices.append([span.moved(ends[q.name], k * shift) for k in (0.0, -1.0, 1.0)])
        elif is_window(q.name):
            choices.append([share * span.size for share in (EDGE, *WIDTHS)])
        else:
            choices.append([values.get(q.name, start)])
    begin = torch.tensor(list(itertools.product(*choices)), dtype=torch.float64)
    # Windows were searched on a grid of about 12 edges: the best of so many costs its logarithm.
    price = math.log(3.0 * len(search.drivers()))
    return Hypothetical((w.candidate,), candidate, begin, prior - price, dataclasses.replace(w, span=span))


def _refit(search: Search, wanted: Sequence[Hypothetical | None]) -> list[Model | None]:
    """Refit local terms, those that can be; no model where a window has closed."""
    found = iter(refit_together(search, [one for one in wanted if one is not None]))
    return [None if one is None else long_enough(next(found)) for one in wanted]


def _keep_all(search: Search, wanted: Sequence[Hypothetical | None]) -> None:
    """Refit local terms together and add what is new."""
    for model in _refit(search, wanted):
        _keep(search, model)


def long_enough(model: Model | None) -> Model | None:
    """The model, unless its window has closed or is too short for one: of several levels of a condition one is not."""
    if model is None or model.window is None or model.window.span is None:
        return None
    window, span, found = model.window, model.window.span, model.found
    share = span.share(window.low, window.high)
    if share < SHORT and not found.problem.in_time:
        along = found.problem.drivers_at_data(found.values[None], None)[window.driver]
        share = float(((along >= window.low) & (along <= window.high)).double().mean())
    return model if share >= SHORT else None
