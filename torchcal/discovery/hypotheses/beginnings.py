"""Where the refits of candidates begin: linear estimates, first guesses, and larger effects than tangents show."""

import itertools
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate, base_columns
from torchcal.discovery.fits.fitting import Fitted, fit
from torchcal.discovery.fits.problem import Problem, Whitening
from torchcal.discovery.fits.starts import follow_slopes, starts
from torchcal.discovery.hypotheses.screen import Screening
from torchcal.discovery.misfit.residual import Residual
from torchcal.errors import DomainError, SimulatorError
from torchcal.simulators import Solution

__all__ = [
    "BENT",
    "STRONG",
    "beginnings",
    "blind_rows",
    "farther",
    "first_guess",
    "is_far",
    "larger_effects",
    "learned",
    "make_up",
    "valleys",
    "within_bounds",
]

#: Shapes that a refit begins at, by their tangents; the same where the base is far off.
SHAPES, SHAPES_FAR = 3, 8
#: χ² a datum from which on a base is far off, whatever the data vary by; from which on it is bent; the share of the
#: data's spread that it then misses where it is far off too; and from which on what its tangents tell may not be all.
FAR, BENT, LOST, STRONG = 30.0, 5.0, 0.5, 2.0
#: Amplitudes tried from first guesses, as shares of the range or of the largest linear estimate; the last of them are
#: also how far on the way to a bound larger effects are tried.
GUESSED = (0.1, 0.4, 0.9)
#: Amplitudes tried where the tangent says nothing: shares of the way from neutral to either bound, or powers of ten.
BLIND, MAGNITUDES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.9), range(-4, 3)
#: Sizes, in those of the misfit, at which an effect whose tangent is the base's is looked at; steps in which the base
#: makes up for it; and the χ² a datum that it must leave to be something else.
LARGER, MADE_UP, SEEN = (1.0, 4.0), 12, 0.01
#: Share of a tangent that the base's leave of it, from which on it is none of theirs.
NEW = 1e-3
#: Shares of the linear estimate from which refits begin; of it at the base of another fit, those that are tried.
STEPS, LADDER = (0.05, 1.0), tuple(4.0**k for k in range(-2, 6))
#: Multiples of the linear estimate, or of its sd where that is more, at which a candidate begins farther away: from the
#: base, against its linear estimate from as much, and where the base may be elsewhere.
FARTHER, ELSEWHERE = (6.0, 48.0), (2.0, 32.0)
#: Steps in which the base follows such an effect, and how many of them go on for so many more, all free but shapes.
FOLLOWED, BEST, GONE_ON = 5, 2, 8
#: Starts from anywhere, and from exchanged parameters at most, by which other valleys of the base are sought, and their
#: steps; difference of a parameter, in its sd and in its size, from which on fits are in two; how many more are looked
#: at, and up to how many times the base's χ².
SPREAD, EXCHANGED, SETTLED = 8, 6, 15
APART, VALLEYS, DEEP = (5.0, 0.2), 2, 3.0


def is_far(base: Fitted) -> bool:
    """Whether the base misses the data by so much that its estimates say little of the truth's: by many noise sd, or by
    more than noise and most of what the data vary by."""
    problem = base.problem
    if problem.recording.noise == "none":
        return False
    missed = base.residual / problem.recording.spread[problem.index]
    return base.chi2 > FAR * problem.n or (base.chi2 > BENT * problem.n and float(missed.square().mean()) > LOST**2)


def beginnings(
    residual: Residual, screening: Screening, number: int, candidate: Candidate, guess: Tensor | None
) -> Tensor:
    """Starting values ``(B, P)`` of a candidate's refit.

    Args:
        residual: The base's.
        screening: In which the candidate has this number.
        number: The candidate's.
        candidate: What is refitted.
        guess: First guesses of the base's parameters, to begin at too where the base is far off.
    """
    begin = _linear(residual, screening, number, candidate)
    return begin if guess is None else torch.cat([begin, _from_guess(residual.found, candidate, begin, guess)])


def first_guess(base: Fitted, fixed: Mapping[str, float], seed: int) -> Tensor:
    """First guesses of the base's parameters ``(P,)``, its initial states those recorded."""
    held = base_columns(base.problem, fixed)[1]
    return follow_slopes(base.problem, starts(base.problem, 1, seed, held))[0]


def within_bounds(base: Fitted, fixed: Mapping[str, float], seed: int) -> Tensor | None:
    """The base's parameters ``(P,)`` with first guesses of those that ran to a bound; None where there are none."""
    if not bool(base.at_bound.any()):
        return None
    held = base_columns(base.problem, fixed)[1]
    stuck = [i for i, at in zip(base.free, base.at_bound.tolist(), strict=True) if at]
    found = base.values.clone()
    found[stuck] = starts(base.problem, 1, seed, held)[0, stuck]
    return found


def valleys(base: Fitted, fixed: Mapping[str, float], seed: int) -> Tensor:
    """Other places ``(V, P)`` where fits of the base end, the best first, from anywhere and with two parameters of one
    unit exchanged: two rates may fit as well in each other's place."""
    problem, free, held = base.problem, base.free, base_columns(base.problem, fixed)[1]
    low, high = problem.limits()
    rows = [*starts(problem, SPREAD, seed + 1, held)]
    for i, j in itertools.combinations(free, 2):
        if problem.parameters[i].unit == problem.parameters[j].unit and len(rows) < SPREAD + EXCHANGED:
            row = base.values.clone()
            row[[i, j]] = row[[j, i]]
            rows.append(row.clamp(low, high))
    ends, chi2 = _each_fitted(problem, base.whitening, torch.stack(rows), free, SETTLED)
    found, sd = [base.values], base.sd()[free]
    for k in chi2.argsort().tolist():
        if len(found) > VALLEYS or not float(chi2[k]) <= DEEP * base.chi2:
            break
        far = []
        for other in found:
            here, there = other[free], ends[k, free]
            away, size = (here - there).abs(), torch.maximum(here.abs(), there.abs())
            far.append(bool(((away > APART[0] * sd) & (away > APART[1] * size)).any()))
        if all(far):
            found.append(ends[k])
    return torch.stack(found)[1:]


def _each_fitted(
    problem: Problem, w: Whitening, begin: Tensor, free: list[int], steps: int, warm: Solution | None = None
) -> tuple[Tensor, Tensor]:
    """Where fits come to in a few steps from every start ``(H, P)``, and with which χ²; without those that the model
    raises at, as it may far from where it is meant for."""
    try:
        found = fit(problem, w, begin, free, warm=warm, max_steps=steps, finish=0)
    except (SimulatorError, DomainError):
        if len(begin) > 1:
            each = [_each_fitted(problem, w, row[None], free, steps) for row in begin]
            return torch.cat([ends for ends, _ in each]), torch.cat([chi2 for _, chi2 in each])
        found = None
    if found is None or found.ends is None or found.ends_chi2 is None:
        return begin[:0], torch.zeros(0, dtype=torch.float64)
    return found.ends, found.ends_chi2


def farther(
    residual: Residual, screening: Screening, number: int, candidate: Candidate, elsewhere: Tensor
) -> tuple[Tensor, Tensor]:
    """Where a candidate comes to in a few steps from larger effects, ``(H, P)``, and with which χ².

    A tangent at a base that is bent may show the wrong sign, or next to nothing. From there, and with the base's
    parameters at others ``(V, P)``, effects of all sizes are held while the base follows them; the best go on.
    """
    base, problem, columns = residual.found, candidate.problem, _columns(residual.found, candidate)
    nothing = candidate.begin[None][:0], torch.zeros(0, dtype=torch.float64)
    usable = screening.usable(number)
    if len(usable) == 0:
        return nothing
    scores = screening.columns[:, usable].T @ residual.e
    best = int(scores.abs().argmax())
    column, score = int(usable[best]), float(scores[best])
    size = max(abs(score), 1.0) / float(screening.norm[column])
    place = candidate.amplitudes[int(screening.amplitude[column])]
    row = candidate.begin.clone()
    row[candidate.own] = candidate.shapes[int(screening.shape[column])]
    others = row.repeat(len(elsewhere), 1)
    others[:, columns] = elsewhere[:, base.free]
    side, rows = candidate.one_sided(place), []
    low, high = problem.limits()
    for sign in (1.0, -1.0):
        if side and sign != side:
            continue
        at = float(row[place])
        room = abs(float((high if sign > 0 else low)[place]) - at)
        here = FARTHER if sign * score > 0 else (1.0, *FARTHER)
        for begun, multiples in ((row, here), *((moved, ELSEWHERE) for moved in others)):
            most = [share * room for share in GUESSED[-len(multiples) :]]
            sizes = [min(k * size, end) for k, end in zip(multiples, most, strict=True)]
            rows += _each(begun, place, [at + sign * one for one in sizes])
    w = residual.noise.whitening(problem)
    begin = torch.stack(rows).clamp(low, high).unique(dim=0)
    ends, chi2 = _each_fitted(problem, w, begin, columns, FOLLOWED, problem.guess(base.warm, begin))
    by_size: dict[float, int] = {}  # the best of every size, which is held
    for k in chi2.argsort().tolist():
        by_size.setdefault(float(ends[k, place]), k)
    if not by_size:
        return nothing
    free = [i for i in candidate.free if i not in candidate.shape_places]
    begin = ends[[*by_size.values()][:BEST]]
    return _each_fitted(problem, w, begin, free, GONE_ON, problem.guess(base.warm, begin))


def make_up(
    base: Fitted, candidate: Candidate, row: Tensor, effect: Tensor, stay: Tensor | None = None
) -> Tensor:
    """A candidate's starting values, moved to first order so that the base makes up for an effect ``(n,)``: all of the
    base's free parameters, or those that are not to ``stay`` where they are, bool ``(P,)``."""
    w, columns = base.whitening, _columns(base, candidate)
    moves = [k for k, i in enumerate(columns) if stay is None or not bool(stay[i])]
    slope = w(base.jacobian)[:, moves]
    unit = slope.norm(dim=0).clamp_min(1e-300)
    # Along directions that move no datum the parameters stay where they are.
    change = torch.linalg.lstsq(slope / unit, w(effect[:, None]), rcond=1e-7, driver="gelsd").solution[:, 0] / unit
    moved = row.clone()
    moved[[columns[k] for k in moves]] -= change
    return moved


def larger_effects(residual: Residual, candidate: Candidate, within: Tensor | None) -> Tensor | None:
    """Larger effects of a candidate whose tangents are the base's, as starts of a refit; None where these are too.

    At each size the base's parameters make up for the effect as far as they can. Where some of these ran to bounds, and
    with them ``within`` the tangents are not the base's, it begins there.
    """
    base = residual.found
    columns = _columns(base, candidate)
    low, high = candidate.problem.limits()
    w = residual.noise.whitening(candidate.problem)
    n = base.problem.n
    least = max(float(residual.e.norm()), math.sqrt(n))
    rows = []
    for g, a in itertools.product(range(len(candidate.shapes)), range(len(candidate.amplitudes))):
        effect = float(w.vector(candidate.tangents[g, :, a]).norm())
        side = candidate.one_sided(candidate.amplitudes[a])
        for share, sign in itertools.product(LARGER if effect > 0 else (), (side,) if side else (1, -1)):
            rows.append(_step_along(base, candidate, g, a, sign * share * least / effect).clamp(low, high))
    if not rows:
        return None
    same = base.y.expand(len(rows), -1)
    found = fit(candidate.problem, w, torch.stack(rows), columns, data=same, max_steps=MADE_UP, finish=0)
    if found is None or found.ends is None or found.ends_chi2 is None:
        return None
    free = [i for i, at in zip(columns, base.at_bound.tolist(), strict=True) if not at]
    bound = (found.ends[:, free] <= low[free]) | (found.ends[:, free] >= high[free])
    seen = (found.ends_chi2 > 1.0 + SEEN * n) & ~bound.any(-1)  # where the base is not held back
    if bool(seen.any()):
        return found.ends[seen]
    return None if within is None else _off_bounds(base, candidate, torch.stack(rows), within)


def _off_bounds(base: Fitted, candidate: Candidate, rows: Tensor, within: Tensor) -> Tensor | None:
    """Starts from where the base's parameters are within their bounds, if a candidate's tangents there are not theirs.
    """
    begin = _from_guess(base, candidate, rows, within)
    if not len(begin):
        return None
    row = candidate.without(begin[0], candidate.own)
    columns = _columns(base, candidate)
    try:
        slopes = base.whitening(candidate.problem.evaluate(row[None], [*columns, *candidate.amplitudes])[1][0])
    except SimulatorError:  # a function may raise there
        return None
    if not bool(slopes.isfinite().all()):
        return None
    theirs, own = slopes.split([len(columns), len(candidate.amplitudes)], dim=1)
    unit = theirs / theirs.norm(dim=0).clamp_min(1e-300)
    left = own - unit @ torch.linalg.lstsq(unit, own, rcond=1e-7, driver="gelsd").solution
    return begin if bool((left.norm(dim=0) > NEW * own.norm(dim=0)).any()) else None


def learned(other: Fitted, base: Fitted, candidate: Candidate) -> Tensor:
    """A candidate's starting values ``(B, P)`` at what another fit has found of the base's parameters.

    Its amplitudes are tried one at a time, at sizes from far below what is best there to first order to far above; the
    best of each stays.
    """
    known, problem, w = other.by_name, candidate.problem, base.whitening
    low, high = problem.limits()
    row = candidate.begin.clone()
    row[_columns(base, candidate)] = row.new_tensor([known[base.problem.parameters[i].name] for i in base.free])
    shapes = candidate.shapes[:SHAPES] if problem.dear else candidate.shapes
    begin = row.repeat(len(shapes), 1)
    begin[:, candidate.own] = shapes
    y, slope = problem.evaluate(begin, candidate.amplitudes)[:2]
    left, effects = w.vector(problem.y - y), torch.stack([w(one) for one in slope])
    along, square = (effects * left[..., None]).sum(1), effects.square().sum(1)
    best = (along.square() / square).nan_to_num(nan=0.0).amax(1).argsort(descending=True, stable=True)[:SHAPES]
    begin, sizes = begin[best], (along.abs() / square)[best]
    rows = []
    for a, place in enumerate(candidate.amplitudes):
        size = float(sizes[:, a].nan_to_num(posinf=0.0).max())
        for start in begin if size > 0 else ():
            tried = _each(start, place, [float(start[place]) + sign * size * k for k in LADDER for sign in (1.0, -1.0)])
            each = torch.stack(tried).clamp(low, high)
            chi2 = w.vector(problem.y - problem.evaluate(each, [])[0]).square().sum(-1)
            rows.append(each[int(chi2.nan_to_num(nan=torch.inf).argmin())])
    return torch.stack(rows) if rows else begin[:0]


def _columns(base: Fitted, candidate: Candidate) -> list[int]:
    """Places of the base's free parameters among the candidate's."""
    places = {q.name: i for i, q in enumerate(candidate.problem.parameters)}
    return [places[base.problem.parameters[i].name] for i in base.free]


def _step_along(
    base: Fitted, candidate: Candidate, shape: int, amplitude: int, size: float, stay: Tensor | None = None
) -> Tensor:
    """The base's estimate with an amplitude of some size, and the rest, but what is to ``stay``, moved to make up for
    it."""
    row = candidate.begin.clone()
    row[candidate.own] = candidate.shapes[shape]
    row[candidate.amplitudes[amplitude]] += size
    return make_up(base, candidate, row, size * candidate.tangents[shape, :, amplitude], stay)


def _linear(residual: Residual, screening: Screening, number: int, candidate: Candidate) -> Tensor:
    """The linear estimate of a candidate at its best shapes.

    A parameter that is hardly known may be moved beyond its bounds: at the end there the model is another one. At the
    best shape it begins where that stays, too.
    """
    usable = screening.usable(number)
    if len(usable) == 0:
        return blind_rows(candidate)
    rows, used = [], set()
    # The tangents of an effect that is far from small say little of which shape it has.
    far = is_far(residual.found)
    (low, high), columns = candidate.problem.limits(), _columns(residual.found, candidate)
    for column in usable[screening.z[usable].argsort(descending=True)].tolist():
        g = int(screening.shape[column])
        if g in used:
            continue
        used.add(g)
        a = int(screening.amplitude[column])
        signed = float(screening.columns[:, column] @ residual.e) / float(screening.norm[column])
        for factor in STEPS if len(used) == 1 or far else STEPS[:1]:
            rows.append(_step_along(residual.found, candidate, g, a, factor * signed))
            outside = (rows[-1] < low) | (rows[-1] > high)
            if len(used) == 1 and bool(outside[columns].any()):
                rows.append(_step_along(residual.found, candidate, g, a, factor * signed, outside))
        if len(used) == (SHAPES_FAR if far else SHAPES):
            break
    return torch.stack(rows)


def blind_rows(candidate: Candidate) -> Tensor:
    """Starting values ``(B, P)`` with amplitudes of all magnitudes, where the tangent says nothing."""
    if candidate.bent is not None:
        return candidate.bent
    rows = []
    for place in candidate.amplitudes:
        q = candidate.problem.parameters[place]
        neutral = candidate.neutral_at(place)
        if q.low is not None and q.high is not None:
            values = [neutral + (end - neutral) * k for end in (q.low, q.high) if end != neutral for k in BLIND]
        else:
            values = [neutral + sign * 10.0**k for k in MAGNITUDES for sign in (1, -1)]
        rows += _each(candidate.begin, place, [value for value in values if q.contains(value)])
    return torch.stack(rows or [candidate.begin])


def _from_guess(base: Fitted, candidate: Candidate, begin: Tensor, guess: Tensor) -> Tensor:
    """The base before it was bent, with amplitudes of several sizes."""
    neutral = {place: candidate.neutral_at(place) for place in candidate.amplitudes}
    row = begin[0].clone()
    for place, value in neutral.items():
        row[place] = value
    row[_columns(base, candidate)] = guess[base.free]
    rows = []
    for place in candidate.amplitudes:
        q = candidate.problem.parameters[place]
        if q.low is not None and q.high is not None:
            values = [q.low + (q.high - q.low) * share for share in GUESSED]
        else:
            step = float((begin[:, place] - neutral[place]).abs().max())
            values = [neutral[place] + sign * factor * step for factor in GUESSED for sign in (1.0, -1.0)]
        rows += _each(row, place, [value for value in values if q.contains(value) and value != neutral[place]])
    return torch.stack(rows) if rows else begin[:0]


def _each(row: Tensor, place: int, values: Sequence[float]) -> list[Tensor]:
    """A row with each of several values at one place."""
    rows = [row.clone() for _ in values]
    for one, value in zip(rows, values, strict=True):
        one[place] = value
    return rows
