"""From the search to the records of a result: where, how much, what would tell, and what cannot be told."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcal.discovery.channels import Channel
from torchcal.discovery.fitting import Fitted, fit, starts
from torchcal.discovery.local import ENDS, WIDTH_OF_EDGE, is_window, region_text
from torchcal.discovery.model import Model
from torchcal.discovery.noise import estimate
from torchcal.discovery.records import Estimate, Fit, Location, MissingRate, NeededShift, Table
from torchcal.discovery.screen import Window
from torchcal.discovery.search import Search
from torchcal.discovery.structure import Place, Structure

__all__ = [
    "estimates",
    "fit_record",
    "identifiability",
    "locate",
    "missing_rate",
    "needed_shifts",
    "other_minima",
    "symptoms",
]

#: Share of an output's evidence that counts beside an equation's.
OUTPUT_SHARE = 0.9

#: Gaps between data that an end of a window may lie in, where its edge is a step.
GAPS = 200
#: Share of the largest part of a direction that the data do not see from which on a parameter belongs to it.
MIXED = 0.02
#: Smallest squared effect of a direction of unit size, each parameter's effect being 1, that is one.
UNSEEN = 1e-6
#: Log evidence between two candidates that are told apart.
APART = 5.0

#: A span begins where the estimated change exceeds this share of its largest magnitude.
SPAN_LEVEL = 0.3
#: Starts from which what is named is fitted again, and steps; a minimum that is higher by less than `RIVAL` in χ² and
#: more than `ELSEWHERE` sd away is another one.
STARTS, AGAIN, RIVAL, ELSEWHERE = 4, 60, 4.0, 4.0
#: A base parameter that moves by this many sd when a term is added was bent by it.
BENT = 3.0


def estimates(found: Fitted, places: Sequence[int], window: Window | None = None) -> tuple[Estimate, ...]:
    """Estimates of some parameters. Without noise the misfit takes its place.

    An sd beyond what the bounds allow, or far beyond the estimate, says that the data do not determine it. Where the
    edge of a static window is a step, its end is known by the gaps between data that it may lie in.
    """
    sd = found.sd()
    if isinstance(found.problem.recording.noise, str):
        sd = sd * misfit_size(found)
    bound = {i for i, at in zip(found.free, found.at_bound.tolist(), strict=True) if at}
    result = []
    for i in places:
        q = found.problem.parameters[i]
        value = float(found.values[i])
        spread = float(sd[i])
        if window is not None and not found.problem.in_time and q.name.endswith(tuple(ENDS.values())):
            spread = _stepped_sd(found, i, window.driver, spread)
        allowed = math.inf if q.low is None or q.high is None else q.high - q.low
        if spread > min(1e5 * max(abs(value), 1e-300), allowed):
            spread = math.inf
        result.append(Estimate(q.name, value, spread, q.unit, i in bound))
    return tuple(result)


def _stepped_sd(found: Fitted, i: int, driver: str, spread: float) -> float:
    """Sd of a window's end whose edge is a step, over the gaps that the misfit allows; else as the curvature says."""
    pairs = zip(found.problem.parameters, found.values.tolist(), strict=True)
    width = next((value for q, value in pairs if q.name.endswith(WIDTH_OF_EDGE)), math.inf)
    along = found.problem.drivers_at_data(found.values[None], None)[driver].unique()
    if width > float(along.diff().median()):
        return spread
    middle, gap = 0.5 * (along[1:] + along[:-1]), along.diff()
    near = (middle - found.values[i]).abs().argsort()[:GAPS]
    middle, gap = middle[near], gap[near]
    rows = found.values.repeat(len(middle), 1)
    rows[:, i] = middle
    problem = found.problem
    chi2 = found.whitening.vector(problem.y - problem.evaluate(rows, [])[0]).square().sum(-1).nan_to_num(nan=math.inf)
    weight = gap * (0.5 * (chi2.min() - chi2)).exp()
    weight = weight / weight.sum()
    mean = float(weight @ middle)
    return math.sqrt(float(weight @ ((middle - mean).square() + gap.square() / 12)))


def misfit_size(found: Fitted) -> float:
    """Root of χ² per degree of freedom."""
    return math.sqrt(found.chi2 / max(found.problem.n - len(found.free), 1))


def fit_record(
    found: Fitted, structure: Structure | None, terms: tuple[str, ...], window: Window | None = None
) -> Fit:
    """A fit as a record."""
    recording = found.problem.recording
    whole = found.problem.simulator.linearise(recording.x, found.values[None], recording.outputs, [], found.warm)
    residual = torch.where(recording.observed, recording.y - whole.y[0], torch.full_like(recording.y, math.nan))
    return Fit(
        terms,
        estimates(found, found.free, window),
        whole.y[0],
        residual,
        found.chi2,
        structure.p_value if structure else 1.0,
    )


def spans(channel: Channel, driver: str, profile: Tensor) -> tuple[tuple[float, float], ...]:
    """Ranges of the driver where the change is large."""
    values = channel.drivers[driver]
    order = values.argsort(stable=True)
    along, size = values[order], profile[order].abs()
    high = size >= SPAN_LEVEL * float(size.max())
    found: list[tuple[float, float]] = []
    start: float | None = None
    last = 0.0
    for value, inside in zip(along.tolist(), high.tolist(), strict=True):
        if inside and start is None:
            start = value
        if not inside and start is not None:
            found.append((start, last))
            start = None
        last = value
    if start is not None:
        found.append((start, last))
    return tuple(found[:6])


def locate(search: Search, best: Model | None) -> Table[Location]:
    """Where the mismatch sits; a named local term says it best."""
    rows = []
    if best is not None and best.window is not None:
        w = best.window
        drivers = search.drivers()[w.driver]
        low = w.low if math.isfinite(w.low) else float(drivers.min())
        high = w.high if math.isfinite(w.high) else float(drivers.max())
        kind, target = _acts_on(best)
        rows.append(Location(kind, target, w.driver, ((low, high),), removed(search, best), best.log_evidence))
    seen = set()
    sensor = best is not None and _acts_on(best)[0] == "output"  # then it has been shown to be the output
    for place in search.structure.places if sensor else by_plausibility(search):
        key = (place.channel.kind, place.channel.target)
        if place.evidence < 2.0 or key in seen:
            continue
        seen.add(key)
        rows.append(
            Location(place.channel.kind, place.channel.target, place.driver,
                     spans(place.channel, place.driver, place.profile), place.share, place.evidence)
        )  # fmt: skip
        if len(rows) >= 8:
            break
    return Table(rows, ("kind", "target", "driver", "spans", "share", "evidence"))


def _acts_on(model: Model) -> tuple[str, str]:
    term = model.candidate.terms[0]
    if term.rates:
        return "equation", next(iter(term.rates))
    if term.outputs:
        return "output", next(iter(term.outputs))
    return "parameter", next(iter([*term.shifts, *term.frees]))


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


def needed_shifts(search: Search) -> list[NeededShift]:
    """The shift of each parameter against the driver that it varies with most."""
    rows: dict[str, Place] = {}
    for place in search.structure.places:
        if place.channel.kind == "parameter" and place.channel.target not in rows and place.evidence > 0:
            rows[place.channel.target] = place
    result = []
    for name, place in rows.items():
        values = place.channel.drivers[place.driver]
        order = values.argsort(stable=True)
        pick = order[torch.linspace(0, len(order) - 1, min(60, len(order))).round().long().unique()]
        a, b = values[pick], place.profile[pick]
        ranks = [v.argsort().argsort().double() for v in (a, b)]
        correlation = float(torch.corrcoef(torch.stack(ranks))[0, 1]) if len(pick) > 2 else 0.0
        result.append(NeededShift(name, place.channel.unit, place.driver, a, b, place.sd[pick], correlation))
    return result[:6]


def by_plausibility(search: Search) -> list[Place]:
    """Places by falling evidence; in time an output's must be clearly larger than an equation's.

    A change of an output can copy whatever any equation does to that output, and instruments err in simple ways.
    """
    def weight(place: Place) -> float:
        return place.evidence * (OUTPUT_SHARE if place.channel.kind == "output" and search.problem.in_time else 1.0)

    return sorted(search.structure.places, key=lambda place: -weight(place))


def missing_rate(search: Search) -> MissingRate | None:
    """The best smooth unknown change of one equation or output, or of one parameter of a static simulator.

    A parameter that changes in time and acts in one equation is a missing rate of that equation, in one run: what it
    does to the rate depends on the states too, which differ between runs at the same time.
    """
    kinds = search.problem.kinds
    for place in by_plausibility(search):
        channel = place.channel
        if place.evidence <= 0:
            return None
        kind, target, unit, size = channel.kind, channel.target, channel.unit, torch.ones_like(place.profile)
        if kind not in kinds:
            if place.driver != "t" or len(channel.rates) != 1 or len(search.problem.recording.runs or ()) > 1:
                continue
            kind = "equation"
            target, size = next(iter(channel.rates.items()))
            unit = next((c.unit for c in search.structure.channels if (c.kind, c.target) == (kind, target)), None)
        values, rate, sd = channel.drivers[place.driver], place.profile * size, place.sd * size.abs()
        order = values.argsort(stable=True)
        return MissingRate(
            kind, target, place.driver, values[order], rate[order], sd[order], unit, channel.time, rate
        )
    return None


def symptoms(search: Search, best: Model | None) -> list[str]:
    """Calibrated values that give the mismatch away."""
    rows = []
    sd = search.base.sd() * (misfit_size(search.base) if search.exact else 1.0)
    for i, at in zip(search.base.free, search.base.at_bound.tolist(), strict=True):
        q = search.base.problem.parameters[i]
        if at:
            rows.append(
                f"{q.name} runs to its bound, {float(search.base.values[i]):.4g}{_unit(q.unit)}, in the calibrated base"
            )
    if best is not None:
        places = {q.name: k for k, q in enumerate(best.found.problem.parameters)}
        then = {e.name: e for e in estimates(best.found, list(places.values()))}
        for i in search.base.free:
            q = search.base.problem.parameters[i]
            a, b = float(search.base.values[i]), then[q.name].value
            moved = abs(b - a) / max(float(sd[i]), 1e-300)
            if moved > BENT and abs(b - a) > 0.001 * abs(a):
                rows.append(
                    f"{q.name} was bent: {a:.4g} ± {float(sd[i]):.2g}{_unit(q.unit)} in the calibrated base, "
                    f"{then[q.name].amount} with {' and '.join(best.names)}"
                )
    if search.noise.doubted > 1:
        left = search.base if best is None else best.found
        doubted = estimate(left.problem, left.residual, left.jacobian, search.problem.recording.noise).doubted
        if doubted > 1:
            rows.append(f"the residual's fastest part is {doubted:.1f} times the noise sd that was given")
    return rows


def _unit(unit: str | None) -> str:
    return f" {unit}" if unit else ""


def identifiability(search: Search, best: Model | None) -> list[str]:
    """Parameters and candidates that these data cannot tell."""
    rows = _untold(search.base)
    if best is not None:
        rows += [row for row in _untold(best.found) if row not in rows]
    screening = search.screening
    for i, candidate in enumerate(search.candidates):
        if screening.best[i] < 0 and not candidate.blind:
            rows.append(f"{candidate.name} cannot be told from the parameters of the base")
        for j in range(i):
            c = abs(screening.correlation(i, j))
            if c > 0.99 and not _told_apart(search, i, j):
                rows.append(
                    f"{search.candidates[j].name} and {candidate.name} are nearly the same here (correlation {c:.3f})"
                )
    return rows[:12]


def _untold(found: Fitted) -> list[str]:
    """Parameters of a fit, and combinations of them, that move no datum."""
    told = [found.problem.parameters[i].name for i in found.free]
    mine = [k for k, name in enumerate(told) if not is_window(name)]  # between two data an end of a window moves none
    jacobian = found.whitening(found.jacobian[:, mine])
    size = jacobian.norm(dim=0)
    names = [told[k] for k in mine]
    rows = [f"{name} has no effect on these data" for name, norm in zip(names, size.tolist(), strict=True) if norm == 0]
    unit = jacobian[:, size > 0] / size[size > 0]
    kept = [name for name, norm in zip(names, size.tolist(), strict=True) if norm > 0]
    if unit.shape[1] > 1:
        values, vectors = torch.linalg.eigh(unit.T @ unit)
        for k in (values < UNSEEN).nonzero()[:, 0].tolist():
            parts = vectors[:, k].abs()
            mixed = [kept[j] for j in range(len(kept)) if float(parts[j]) > MIXED * float(parts.max())]
            if len(mixed) > 1:
                rows.append(f"a common change of {', '.join(mixed)} moves no datum: only combinations can be told")
    return rows


def other_minima(search: Search, model: Model) -> list[str]:
    """Other estimates of a named term's size that fit about as well, from the base's first guesses.

    The sd that are given are those within one minimum.
    """
    found, candidate = model.found, model.candidate
    sd, neutral = found.sd(), dict(zip(candidate.own, candidate.neutral.tolist(), strict=True))
    # Where the size is open, as the scale of an unseen state leaves it, there is a valley and no other minimum.
    places = [i for i in candidate.amplitudes if 0 < float(sd[i]) < abs(float(found.values[i]) - neutral[i])]
    if search.exact or not places:
        return []
    held = [i for i in range(len(found.values)) if i not in found.free]
    begin = starts(found.problem, STARTS, search.seed, {i: float(found.values[i]) for i in (*held, *candidate.own)})
    again = fit(found.problem, found.whitening, begin, found.free, max_steps=AGAIN, finish=0)
    if again is None or again.ends is None or again.ends_chi2 is None:
        return []
    for k in again.ends_chi2.argsort().tolist():
        more = float(again.ends_chi2[k]) - found.chi2
        away = (again.ends[k] - found.values).abs()
        if more < RIVAL and any(float(away[i]) > ELSEWHERE * float(sd[i]) for i in places):
            values = [f"{found.problem.parameters[i].name} = {float(again.ends[k, i]):.3g}" for i in places]
            return [f"{', '.join(values)} fits about as well (χ² {more:+.2g}): the sd given holds around one minimum"]
    return []


def _told_apart(search: Search, i: int, j: int) -> bool:
    """Whether refits of two candidates differ by far, whatever their tangents say."""
    a, b = (search.plain.get(k) for k in (i, j))
    return a is not None and b is not None and abs(a.log_evidence - b.log_evidence) > APART


def formulas(model: Model) -> list[str]:
    """The accepted terms' formulas with their estimates."""
    rows = []
    for term in model.candidate.terms:
        own = [i for i in model.candidate.own
               if model.found.problem.parameters[i].name in
               {*(term.full(q.name) for q in term.parameters), *term.frees}]  # fmt: skip
        text = term.formula or term.name
        if model.window is not None:
            w = model.window
            text = f"{text.split(' where ')[0]} where {region_text(w.driver, w.low, w.high)}"
        rows.append(f"{text}, with " + "; ".join(str(e) for e in estimates(model.found, own, model.window)))
    return rows
