"""Detection limits: the smallest effect of each candidate that these data could have shown."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate, usual_starts
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.hypotheses.model import PRIOR
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.records import Limit, Table
from torchcal.display import IN_BASE, with_unit
from torchcal.terms import Term

__all__ = ["limits"]

#: Times that a limit is corrected by what calibration makes of an effect of its size, and by how much at most each.
ROUNDS, MOST = 8, 4.0
#: Where it is close enough, as a logarithm.
CLOSE = 0.05
#: Score that is asked for where there are none of noise.
UNSCORED = 3.5
#: Orders of magnitude of sizes that are tried to either side of 1 where a tangent tells nothing, or twice as many below
#: a bound, and how close the size found there is, as a factor.
ORDERS, NEAR = 8, 1.2
#: Smallest share that is left of a distance by how much it wavers itself.
LEFT = 0.25
#: Data to spare below which the size of the noise is anyone's guess.
SPARE = 3


def limits(search: Search, alpha: float, power: float, contained: Sequence[Term] = ()) -> Table[Limit]:
    """Smallest detectable effects.

    The linear limit, from the norm of the projected tangent, is checked: an effect of its size is simulated without
    noise, the base is calibrated to that, and the size is changed until what calibration cannot hide is just large
    enough. Where the tangent tells nothing new it begins with what the base's tangents leave of a finite effect.
    Infinite where calibration hides ever larger effects, or all within the parameter's bounds; of an amplitude of
    either sign the larger of both, or that of the sign that is seen. An open shape is the one of median effect; an
    estimate of another shape is told with that.

    Args:
        search: With its screening.
        alpha: Probability of calling noise a mismatch.
        power: Probability of detection at the limit.
        contained: Terms that are part of the simulator already.
    """
    screening = search.screening
    from_power = math.sqrt(2) * float(torch.special.erfinv(torch.tensor(2 * power - 1, dtype=torch.float64)))
    # Several families of statistics share the level: each may use as much of it as leaves alpha in all.
    level = float(search.least.quantile(alpha))
    scored = bool((screening.null > 0).any())  # not where no tangent shows anything
    critical = float(screening.null.quantile(1 - level)) if scored else UNSCORED
    odds = math.log(PRIOR["base"] / (PRIOR["single"] / max(len(search.candidates), 1)))
    fitted = search.plain
    effects: dict[int, _Effect] = {}
    few = {i for i, c in enumerate(search.candidates) if search.noise.open and _spare(search, c) < SPARE}
    sizes: dict[int, float] = {}
    for i, candidate in enumerate(search.candidates):
        blind = screening.best[i] < 0
        if i in few or (blind and not candidate.blind):
            continue
        # Seen is not enough: the evidence for the term must outweigh that for the base too.
        paid = len(candidate.own) - len(usual_starts(candidate.terms, candidate.problem, candidate.amplitudes))
        wanted = max(critical, math.sqrt(max(2 * odds + paid * math.log(search.problem.n), 0.0)))
        if blind:
            first = _Effect(len(candidate.shapes) // 2, 0, wanted, order=2)
            direction = _left(search, i, first, _seen_from(search, i, first), _simulated(search, i, first, 0.0))
        else:
            column = _typical(search, i)
            first = _Effect(int(screening.shape[column]), int(screening.amplitude[column]), wanted)
            direction = screening.columns[:, column]
        noisy = 0.0 if direction is None else 0.5 * _wavers(search, direction)
        effects[i] = effect = dataclasses.replace(first, distance=_distance(wanted, from_power, noisy))
        sizes[i] = _seen_from(search, i, effect) if blind else effect.distance / float(screening.norm[column])
    hidden: dict[int, _Hidden] = {}
    if not search.exact and not search.stop.is_set():
        sizes, hidden = _corrected(search, effects, sizes)
    rows = []
    for i, candidate in enumerate(search.candidates):
        best = screening.best[i]
        number = effects[i].amplitude if i in effects else int(screening.amplitude[best]) if best >= 0 else 0
        place = candidate.amplitudes[number]
        q = candidate.problem.parameters[place]
        model = fitted.get(i)
        estimate = float(model.found.values[place]) - candidate.neutral_at(place) if model else None
        if i not in effects:
            note = "so few data show no effect beside noise of unknown size" if i in few else IN_BASE
            rows.append(Limit(candidate.name, q.name, math.inf, q.unit, power, estimate, note))
            continue
        others = [search.candidates[j].name for j in search.aliases.get(i, ())]
        at = _shape(candidate, candidate.shapes[effects[i].shape])
        fitted_at = at if model is None else _shape(candidate, model.found.values[candidate.own])
        notes = [at, "" if fitted_at == at else f"the estimate {fitted_at}"]
        notes += [f"also: {', '.join(others)}" if others else ""]
        notes += [hidden[i].note] if i in hidden else []
        note = "; ".join(filter(None, notes))
        sign = -hidden[i].sign if i in hidden else 0
        rows.append(Limit(candidate.name, q.name, sizes[i], q.unit, power, estimate, note, sign, fitted_at == at))
    for term in contained:
        name = term.full(term.parameters[0].name) if term.parameters else term.frees[0]
        rows.append(Limit(term.name, name, math.inf, None, power, None, IN_BASE))
    return Table(rows, ("term", "parameter", "smallest", "unit", "power", "estimate", "note"))


def _distance(wanted: float, from_power: float, wavers: float) -> float:
    """How far from the base an effect must be, in noise sd, to be seen as far as ``wanted`` with some power.

    The estimate of the noise's sd has a relative variance of ``wavers`` (v), and with it the score (s) and this
    distance (d) itself: d = s + z √(1 + v (s² + d²)).
    """
    left = max(1 - from_power**2 * wavers, LEFT)
    own = wavers * wanted**2
    return (wanted + from_power * math.sqrt(own + left * (1 + own))) / left


def _spare(search: Search, candidate: Candidate) -> int:
    """Data to spare for the noise, beside the parameters of the base and of a candidate."""
    return search.problem.n - len(search.base.free) - len(candidate.own)


def _wavers(search: Search, column: Tensor) -> float:
    """Variance of the noise's log variance, as a whitened effect ``(n,)`` sees it, halved: Σ share² / (degrees of
    freedom) over the outputs that it shows in."""
    share = torch.zeros_like(search.noise.freedom).index_add_(0, search.problem.output_of, column.square())
    return float(((share / share.sum().clamp_min(1e-300)).square() / search.noise.freedom).sum())


def _typical(search: Search, i: int) -> int:
    """The column of a candidate's best amplitude at the shape of median effect: the best shape is that of the noise."""
    screening = search.screening
    usable = screening.usable(i)
    places = usable[screening.amplitude[usable] == screening.amplitude[screening.best[i]]]
    order = screening.norm[places].argsort()
    return int(places[order[len(order) // 2]])


def _shape(candidate: Candidate, row: Tensor) -> str:
    """The shape that a limit or an estimate is of, by the candidate's own parameters, in words; empty of none."""
    parts = []
    for k, place in enumerate(candidate.own):
        q = candidate.problem.parameters[place]
        if place not in candidate.amplitudes:
            parts.append(f"{q.name.rsplit('.', 1)[-1]} = {with_unit(f'{float(row[k]):.3g}', q.unit)}")
    return f"at {', '.join(parts)}" if parts else ""


@dataclass(frozen=True)
class _Effect:
    """What a candidate must do to the data to be seen.

    Attributes:
        shape: Number of its shape.
        amplitude: Number of its amplitude.
        distance: How far the data must be, in noise sd, from what the base can be calibrated to.
        order: Power of its size that what it does to the data goes with at first.
    """

    shape: int
    amplitude: int
    distance: float
    order: int = 1


@dataclass(frozen=True)
class _Hidden:
    """What of a candidate is not seen whatever its size.

    Attributes:
        sign: Of the effects that are not seen, 1 or −1; 0 where none is seen.
        note: That in words.
    """

    sign: int
    note: str


def _corrected(
    search: Search, effects: dict[int, _Effect], sizes: dict[int, float]
) -> tuple[dict[int, float], dict[int, _Hidden]]:
    """Sizes whose effects remain just large enough when the base is calibrated to them, of two signs the larger one.

    With them what is not seen whatever its size.
    """
    base = search.base
    now: dict[tuple[int, int], float] = {}
    room: dict[tuple[int, int], float] = {}
    for i, effect in effects.items():
        candidate = search.candidates[i]
        place = candidate.amplitudes[effect.amplitude]
        sided = candidate.one_sided(place)
        for sign in (sided,) if sided else (1, -1):
            room[i, sign] = _room(candidate, place, sign)
            now[i, sign] = min(sizes[i], room[i, sign])
    unseen, seen = dict.fromkeys(now, 0.0), dict.fromkeys(now, math.inf)
    trials = list(now)
    ended: dict[tuple[int, int], tuple[float, Tensor]] = {}  # at the last size, by how much the base moved
    low, high = base.problem.limits()
    for _ in range(ROUNDS):
        if search.stop.is_set():
            seen |= {trial: min(seen[trial], sizes[trial[0]]) for trial in trials}
            break
        data, known = [], []
        for trial in trials:
            y = _simulated(search, trial[0], effects[trial[0]], trial[1] * now[trial])
            if y is None:  # what blows up is seen
                seen[trial] = now[trial]
                now[trial] = math.sqrt(unseen[trial] * now[trial]) if unseen[trial] else now[trial] / MOST
            else:
                data.append(y)
                known.append(trial)
        if known:
            warm = None if base.warm is None else base.warm.repeated(len(known))
            begin = base.values.repeat(len(known), 1)
            for row, trial in zip(begin, known, strict=True):
                if trial in ended:
                    size, moved = ended[trial]
                    row += now[trial] / size * moved
            found = fit(
                base.problem,
                base.whitening,
                begin.clamp(low, high),
                base.free,
                warm=warm,
                data=torch.stack(data),
                max_steps=30,
                finish=0,
            )
            if found is None or found.ends is None or found.ends_chi2 is None or len(found.ends) != len(known):
                for trial in trials:  # as far as tangents tell
                    seen[trial] = min(seen[trial], sizes[trial[0]])
                break
            ended = {trial: (now[trial], end - base.values) for trial, end in zip(known, found.ends, strict=True)}
            for trial, chi2 in zip(known, found.ends_chi2.tolist(), strict=True):
                short = effects[trial[0]].distance / max(math.sqrt(chi2), 1e-300)
                if abs(math.log(short)) <= CLOSE:
                    seen[trial] = now[trial]
                    trials.remove(trial)
                    continue
                (unseen if short > 1 else seen)[trial] = now[trial]
                if unseen[trial] >= room[trial]:
                    trials.remove(trial)
                    continue
                factor = min(max(short, 1 / MOST), MOST) ** (1 / effects[trial[0]].order)
                wanted = min(now[trial] * factor, room[trial])
                if not unseen[trial] < wanted < seen[trial]:
                    wanted = math.sqrt(unseen[trial] * seen[trial])
                now[trial] = wanted
        if not trials:
            break
    smallest: dict[int, float] = {}
    hidden: dict[int, _Hidden] = {}
    for i in effects:
        mine = {sign: seen[i, sign] for sign in (1, -1) if (i, sign) in seen}
        lost = [sign for sign, size in mine.items() if math.isinf(size)]
        smallest[i] = max((size for size in mine.values() if math.isfinite(size)), default=math.inf)
        if lost:
            largest = max(unseen[i, one] for one in lost)
            sign = 0 if len(lost) == len(mine) else lost[0]
            within = all(unseen[i, one] >= room[i, one] for one in lost)
            end = "the largest within its bounds" if within else "the largest that was tried"
            which = {0: "", 1: "positive ", -1: "negative "}[sign]
            hidden[i] = _Hidden(sign, f"calibration hides {which}effects of {largest:.3g}, {end}")
    return smallest, hidden


def _room(candidate: Candidate, place: int, sign: int) -> float:
    """How far an amplitude's bounds let it be from neutral, to one side."""
    q, neutral = candidate.problem.parameters[place], candidate.neutral_at(place)
    end = q.lowest if sign < 0 else math.inf if q.high is None else q.high
    return max(sign * (end - neutral), 0.0)


def _seen_from(search: Search, i: int, effect: _Effect) -> float:
    """The size from which on a candidate's effect is far enough from what the base's tangents can do, within a factor
    of `NEAR`, or the largest that is tried: for where its own tangent tells nothing."""
    candidate = search.candidates[i]
    place = candidate.amplitudes[effect.amplitude]
    room = _room(candidate, place, candidate.one_sided(place) or 1)
    high = room if math.isfinite(room) else 10.0**ORDERS
    low = high * 10.0 ** (-2 * ORDERS)
    none = _simulated(search, i, effect, 0.0)
    while high > NEAR * low:
        size = math.sqrt(low * high)
        left = _left(search, i, effect, size, none)
        if left is None or float(left.norm()) >= effect.distance:  # what blows up is seen
            high = size
        else:
            low = size
    return high


def _left(search: Search, i: int, effect: _Effect, size: float, none: Tensor | None) -> Tensor | None:
    """What the base's tangents cannot do of an effect of some size, by the data with ``none``, whitened, ``(n,)``; None
    where that blows up."""
    candidate = search.candidates[i]
    sign = candidate.one_sided(candidate.amplitudes[effect.amplitude]) or 1
    y = _simulated(search, i, effect, sign * size)
    if y is None or none is None:
        return None
    return search.residual.project(search.base.whitening((y - none)[:, None]))[:, 0]


def _simulated(search: Search, i: int, effect: _Effect, size: float) -> Tensor | None:
    """Noise-free data ``(n,)`` of the base with a candidate of some size; None where they are not finite."""
    candidate = search.candidates[i]
    row = candidate.begin.clone()
    row[candidate.own] = candidate.shapes[effect.shape]
    row[candidate.amplitudes[effect.amplitude]] += size
    warm = candidate.problem.guess(search.base.warm, row[None])
    y = candidate.problem.evaluate(row[None], [], warm)[0][0]
    return y if bool(torch.isfinite(y).all()) else None
