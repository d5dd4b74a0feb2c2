"""Detection limits: the smallest effect of each candidate that these data could have shown."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.hypotheses.model import PRIOR
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.records import Limit, Table
from torchcal.display import with_unit
from torchcal.terms import Term

__all__ = ["limits"]

#: Times that a limit is corrected by what calibration makes of an effect of its size, and by how much at most each.
ROUNDS, MOST = 8, 4.0
#: Where it is close enough, as a logarithm.
CLOSE = 0.05
#: Smallest share that is left of a distance by how much it wavers itself.
LEFT = 0.25
#: Data to spare below which the size of the noise is anyone's guess.
SPARE = 3


def limits(search: Search, alpha: float, power: float, contained: Sequence[Term] = ()) -> Table[Limit]:
    """Smallest detectable effects.

    The linear limit, from the norm of the projected tangent, is checked: an effect of its size is simulated without
    noise, the base is calibrated to that, and the size is changed until what calibration cannot hide is just large
    enough. Infinite where calibration hides ever larger effects, or all within the parameter's bounds; of an amplitude
    of either sign the larger of both, or that of the sign that is seen. An open shape is the one of median effect.

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
    critical = float(screening.null.quantile(1 - level)) if len(screening.null) else 3.5
    odds = math.log(PRIOR["base"] / (PRIOR["single"] / max(len(search.candidates), 1)))
    fitted = search.plain
    effects: dict[int, _Effect] = {}
    few = {i for i, c in enumerate(search.candidates) if search.noise.open and _spare(search, c) < SPARE}
    for i, candidate in enumerate(search.candidates):
        if screening.best[i] < 0 or i in few:
            continue
        column = _typical(search, i)
        # Seen is not enough: the evidence for the term must outweigh that for the base too.
        wanted = max(critical, math.sqrt(max(2 * odds + len(candidate.own) * math.log(search.problem.n), 0.0)))
        distance = _distance(wanted, from_power, 0.5 * _wavers(search, screening.columns[:, column]))
        effects[i] = _Effect(column, distance, float(screening.norm[column]))
    sizes = {i: effect.distance / effect.norm for i, effect in effects.items()}
    hidden: dict[int, _Hidden] = {}
    if not search.exact and not search.stop.is_set():
        sizes, hidden = _corrected(search, effects, sizes)
    rows = []
    for i, candidate in enumerate(search.candidates):
        column = effects[i].column if i in effects else screening.best[i]
        place = candidate.amplitudes[int(screening.amplitude[column]) if column >= 0 else 0]
        q = candidate.problem.parameters[place]
        model = fitted.get(i)
        estimate = float(model.found.values[place]) - candidate.neutral_at(place) if model else None
        if i not in effects:
            blind = "its tangent tells nothing new: only large effects can"
            note = blind if candidate.blind else "already in the base model"
            note = "so few data show no effect beside noise of unknown size" if i in few else note
            rows.append(Limit(candidate.name, q.name, math.inf, q.unit, power, estimate, note))
            continue
        others = [search.candidates[j].name for j in search.aliases.get(i, ())]
        notes = [_shape(candidate, effects[i], search), f"also: {', '.join(others)}" if others else ""]
        notes += [hidden[i].note] if i in hidden else []
        note = "; ".join(filter(None, notes))
        sign = -hidden[i].sign if i in hidden else 0
        rows.append(Limit(candidate.name, q.name, sizes[i], q.unit, power, estimate, note, sign))
    for term in contained:
        name = term.full(term.parameters[0].name) if term.parameters else term.frees[0]
        rows.append(Limit(term.name, name, math.inf, None, power, None, "already in the base model"))
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
    same = screening.amplitude == screening.amplitude[screening.best[i]]
    places = ((screening.owner == i) & same & (screening.norm > 0)).nonzero()[:, 0]
    order = screening.norm[places].argsort()
    return int(places[order[len(order) // 2]])


def _shape(candidate: Candidate, effect: "_Effect", search: Search) -> str:
    """The shape that a limit is of, in words; empty where there is none."""
    row = candidate.shapes[int(search.screening.shape[effect.column])]
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
        column: Of the screening: shapes and amplitude.
        distance: How far the data must be, in noise sd, from what the base can be calibrated to.
        norm: How far a unit of the amplitude takes them, to first order.
    """

    column: int
    distance: float
    norm: float


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
        place = candidate.amplitudes[int(search.screening.amplitude[effect.column])]
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
            y = _simulated(search, trial[0], effects[trial[0]].column, trial[1] * now[trial])
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
                wanted = min(now[trial] * min(max(short, 1 / MOST), MOST), room[trial])
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


def _simulated(search: Search, i: int, column: int, size: float) -> Tensor | None:
    """Noise-free data ``(n,)`` of the base with a candidate of some size; None where they are not finite."""
    candidate, screening = search.candidates[i], search.screening
    row = candidate.begin.clone()
    row[candidate.own] = candidate.shapes[int(screening.shape[column])]
    row[candidate.amplitudes[int(screening.amplitude[column])]] += size
    warm = candidate.problem.guess(search.base.warm, row[None])
    y = candidate.problem.evaluate(row[None], [], warm)[0][0]
    return y if bool(torch.isfinite(y).all()) else None
