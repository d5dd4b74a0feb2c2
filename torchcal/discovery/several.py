"""Several terms together: effects hide each other, so pairs are searched as well as second and third terms."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate, prepare, replaces
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.ranges import drivers_scale
from torchcal.discovery.hypotheses.aliases import copies, merge
from torchcal.discovery.hypotheses.beginnings import BENT, blind_rows, is_far, make_up
from torchcal.discovery.hypotheses.model import PRIOR, Hypothetical, Model
from torchcal.discovery.hypotheses.refitting import BETTER, improve, refit_together
from torchcal.discovery.hypotheses.screen import screen
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.verdicts.explain import removed
from torchcal.discovery.verdicts.instruments import which_instruments
from torchcal.discovery.verdicts.verdict import PLAINLY_WHITE
from torchcal.errors import DomainError, SimulatorError
from torchcal.terms import extend

__all__ = ["refit_several", "scores_beside"]

#: Pairs that are refitted at most; where one term leaves noise alone.
MOST, FEWER = 20, 10
#: Single terms beside which second ones are sought: of all, and of those that act everywhere; and how many more pairs
#: are refitted for each of these that is not among the three best of all.
LEADS, MORE = 3, 2
#: Second terms that are tried beside one of the best, third ones beside the best two, and how many more whose tangents
#: vanish.
NEXT, THIRD, UNSEEN = 7, 4, 3
#: Share of the misfit that one term removes of a recording without noise, and nothing need be sought beside it.
ALL = 0.99999
#: Of them from the linear search, and from that of a base that is far off, which linear estimates do not reach; and the
#: correlation of two tangents from which on they are one.
FROM_LINEAR, FROM_FAR, NEARLY_SAME = 8, 3, 0.999
#: Log weight behind the leading pair down to which that is tried, and for how many pairs.
CLOSE, AGAIN = 5.0, 3
#: Log weight behind a leading pair that leaves noise, down to which pairs are tried the other way round; how many at
#: most; and the change of χ² from which on that is another model.
FAR_BEHIND, TURNED, ANOTHER = 30.0, 6, 1.0
#: Correlation of two tangents from which on a candidate is tried in the other's place beside the leading pair's; and
#: what of a tangent may be its own where the base is off, for the candidate to be tried in any place.
ALIKE, HIDDEN = 0.9, 0.1
#: Difference of two scores up to which merged candidates are the same beside another term.
SAME_SCORE = 0.1


def refit_several(search: Search) -> None:
    """Pairs from the linear search at the base, and second terms after the best single ones; then thirds.

    Where one term leaves noise alone, two may do what it does: fewer of them are tried.
    """
    single = sorted((m for m in search.models if len(m.numbers) == 1), key=lambda m: -m.weight)
    count = len(search.candidates)
    if count < 2 or search.max_terms < 2:
        return
    enough = _enough(search)
    if enough and search.exact:
        return
    wanted = _pairs_to_try(search, single, enough)
    prior = math.log(PRIOR["several"] / (0.5 * count * (count - 1)))
    search.models += (fitted := _refit_sets(search, list(wanted.items()), prior))
    if not enough:
        fitted = _either_way(search, fitted)
    best = search.physical_leader
    if best is not None and len(best.numbers) == 2:
        fitted += _with_look_alikes(search, set(wanted), prior)
        for pair in _close(search):
            _alone_again(search, pair)
    if isinstance(search.problem.recording.noise, Tensor):  # else a smaller noise makes physics of any small misfit
        search.reweigh()
    if search.max_terms < 3 or not fitted:
        return
    best = max(fitted, key=lambda m: m.weight)
    if search.examine(best).p_value < 0.01 or search.exact:
        third = math.log(0.2 * PRIOR["several"] / (count * (count - 1) * max(count - 2, 1) / 6))
        more = _distinct(search, [(*best.numbers, j) for j in _next_terms(search, best, THIRD)])
        search.models += _refitted(search, [_with_third(search, best, j, third) for *_, j in more])
        leader = search.physical_leader
        if leader is not None and len(leader.numbers) == 3:
            _one_fewer(search, leader, prior)


def _pairs_to_try(
    search: Search, single: Sequence[Model], enough: bool
) -> dict[tuple[int, ...], tuple[int, int] | None]:
    """Pairs, each with the columns of the linear search that suggested it, if that did.

    Args:
        single: Models of one term, the likeliest first.
        enough: Whether one term that acts everywhere leaves noise alone.
    """
    wanted: dict[tuple[int, ...], tuple[int, int] | None] = {}
    for columns in _linear_pairs(search, FROM_FAR if is_far(search.base) else FROM_LINEAR):
        wanted[tuple(int(search.screening.owner[k]) for k in columns)] = columns
    leads: dict[int, Model] = {}
    for model in single:
        lead = model.numbers[0]  # in a window merged ones may differ, beside others not
        leads.setdefault(search.twins[lead] if lead in search.gone else lead, model)
    ahead = list(itertools.islice(leads.items(), 1 if enough else LEADS))
    beside = [_pairs_with(search, lead, model) for lead, model in ahead]
    for pair in itertools.chain(*itertools.zip_longest(*beside)):  # the best of each lead first
        if pair is not None:
            wanted.setdefault(pair, None)
    wanted = {pair: wanted[pair] for pair in _distinct(search, wanted)}
    wanted = dict(itertools.islice(wanted.items(), FEWER if enough else MOST))
    if not enough:  # a term in a window bends to what two do together, and these act everywhere
        everywhere = [(m.numbers[0], m) for m in single if m.window is None][:LEADS]
        for lead, model in everywhere:
            if (lead, model) not in ahead:
                more = _distinct(search, [*wanted, *_pairs_with(search, lead, model)])[len(wanted) :]
                wanted.update(dict.fromkeys(more[:MORE]))
    return wanted


def _distinct(search: Search, sets: Iterable[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """Of some sets of candidates those that add what no single one, no model and no set before them adds: two terms
    that free one parameter each are a third one that frees both."""
    seen = {candidate.content for i, candidate in enumerate(search.candidates) if i not in search.failed}
    seen |= {model.content for model in search.models if model.window is None}
    found = []
    for numbers in dict.fromkeys(sets):
        content = frozenset().union(*(search.candidates[i].content for i in numbers))
        if content not in seen:
            seen.add(content)
            found.append(numbers)
    return found


def _pairs_with(search: Search, lead: int, model: Model) -> list[tuple[int, ...]]:
    """Pairs of a single term and the best second ones at its fit."""
    return [tuple(sorted((lead, j))) for j in _next_terms(search, model, NEXT) if j != lead]


def _close(search: Search) -> list[Model]:
    """The leading pairs, the likeliest first."""
    pairs = [m for m in search.models if m.physical and len(m.numbers) == 2]
    best = max(m.weight for m in pairs)
    return sorted((m for m in pairs if m.weight > best - CLOSE), key=lambda m: -m.weight)[:AGAIN]


def _with_look_alikes(search: Search, tried: set[tuple[int, ...]], prior: float) -> list[Model]:
    """Pairs with another candidate in place of a leading one's that does nearly the same: first of the best, then of
    those that lead with it, until there are no more or `MOST` of them."""
    fitted: list[Model] = []
    done: set[tuple[int, ...]] = set()
    leading = _close(search)[:1]
    while leading and len(fitted) < MOST:
        done |= {m.numbers for m in leading}
        wanted = dict.fromkeys(pair for lead in leading for pair in _swapped(search, lead) if pair not in tried)
        pairs = _distinct(search, wanted)[: MOST - len(fitted)]
        tried.update(pairs)
        search.models += (twins := _refit_sets(search, [(pair, None) for pair in pairs], prior))
        fitted += _either_way(search, twins)
        leading = [m for m in _close(search) if m.numbers not in done]
    return fitted


def _either_way(search: Search, pairs: list[Model]) -> list[Model]:
    """Pairs, the leading ones with their terms the other way round where that is another model that does better.

    An instrument shows what the physics gives; which of two others on one output comes first, as of a shunt and what
    the leads drop, nobody says. Where the best leaves more than noise, pairs are tried however far they are behind, and
    instruments before the physics too.
    """
    every = [m for m in search.models if len(m.numbers) == 2 and m.window is None]
    if not every:
        return pairs
    best = max(every, key=lambda m: m.weight)
    whole = search.examine(best).p_value >= PLAINLY_WHITE
    least = best.weight - FAR_BEHIND if whole else -math.inf
    leading = sorted((m for m in pairs if m.weight > least and _share(m)), key=lambda m: -m.weight)
    wanted: list[tuple[Model, Hypothetical]] = []
    for pair in leading:
        if len(wanted) == TURNED:
            break
        if whole and which_instruments(pair) == [False, True]:
            continue
        try:
            known, y = _turned(search, pair)
        except (SimulatorError, DomainError):  # not every function bears what another one gives
            continue
        if float(pair.found.whitening.vector(y - pair.found.y).square().sum()) < ANOTHER:
            continue
        one = _hypothetical(search, pair.numbers, pair.log_prior, None, order=_order(search, pair)[::-1])
        if one is not None and one.candidate.terms[0].name != pair.names[0]:
            row = torch.tensor([[known[q.name] for q in one.candidate.problem.parameters]], dtype=torch.float64)
            wanted.append((pair, dataclasses.replace(one, begin=torch.cat([one.begin, row]))))
    better = {
        id(pair): other
        for (pair, _), other in zip(wanted, refit_together(search, [one for _, one in wanted]), strict=True)
        if other is not None and other.physical >= pair.physical and other.weight > pair.weight + BETTER
    }
    search.models = [better.get(id(m), m) for m in search.models]
    return [better.get(id(m), m) for m in pairs]


def _turned(search: Search, pair: Model) -> tuple[dict[str, float], Tensor]:
    """Parameters of a pair, and the outputs ``(n,)`` of its terms the other way round with them."""
    problem, known = search.base.problem, pair.found.by_name
    problem = problem.with_simulator(extend(problem.simulator, pair.candidate.terms[::-1]))
    row = torch.tensor([[known[q.name] for q in problem.parameters]], dtype=torch.float64)
    return known, problem.evaluate(row, [], problem.guess(search.base.warm, row))[0][0]


def _share(pair: Model) -> bool:
    """Whether both terms change the same output, or the same parameter."""
    first, second = pair.candidate.terms
    return bool(set(first.outputs) & set(second.outputs) or set(first.shifts) & set(second.shifts))


def _order(search: Search, model: Model) -> list[int]:
    """A model's candidates in the order in which they act."""
    names = list(model.names)
    return sorted(model.numbers, key=lambda i: names.index(search.candidates[i].terms[0].name))


def _one_fewer(search: Search, three: Model, prior: float) -> None:
    """The pairs of three terms, each refitted from where the three ended: from the base it may have got stuck."""
    known = three.found.by_name
    wanted = []
    for numbers in itertools.combinations(three.numbers, 2):
        pair = _hypothetical(search, numbers, prior, None)
        if pair is not None:
            names = [q.name for q in pair.candidate.problem.parameters]
            row = pair.candidate.begin.clone()
            for k in pair.candidate.free:  # what the third term frees stays neutral here
                row[k] = known[names[k]]
            wanted.append(dataclasses.replace(pair, begin=row[None]))
    for model in refit_together(search, wanted):
        if model is not None:
            old = [m for m in search.models if m.numbers == model.numbers and m.window is None]
            if all(model.weight > m.weight + BETTER for m in old):
                search.models = [m for m in search.models if m not in old] + [model]


def _alone_again(search: Search, pair: Model) -> None:
    """The terms of a pair, each refitted alone from where the pair ended: from the base it may have got stuck."""
    known = pair.found.by_name
    numbers = [i for i in pair.numbers if i not in search.gone]
    wanted = []
    for i in numbers:
        candidate = search.candidates[i]
        names = [q.name for q in candidate.problem.parameters]
        row = candidate.begin.clone()
        for k in candidate.free:  # what the other term frees stays neutral here
            row[k] = known[names[k]]
        wanted.append(Hypothetical((i,), candidate, row[None], search.prior))
    improve(search, wanted)
    merge(search)


def _enough(search: Search) -> bool:
    """Whether one term that acts everywhere leaves noise alone; a window may stand in for a second one."""
    physical = [m for m in search.models if m.physical and m.window is None]
    if not physical:
        return False
    best = max(physical, key=lambda m: m.weight)
    return removed(search, best) >= ALL if search.exact else search.examine(best).p_value >= PLAINLY_WHITE


def _swapped(search: Search, lead: Model) -> list[tuple[int, ...]]:
    """Pairs with another candidate in place of one of a pair's terms: what does nearly the same, at some shapes, then
    what the base's parameters nearly make up for, of which a linear search from a base that is off sees little."""
    found: dict[tuple[int, ...], float] = {}
    hidden = _hidden(search) if search.base.chi2 > BENT * search.base.problem.n else set()
    columns, owner, gone = search.screening.columns, search.screening.owner, search.gone - _apart(search)
    for i in lead.numbers:
        (kept,) = set(lead.numbers) - {i}
        for j in set(range(len(search.candidates))) - {*lead.numbers, *gone}:
            alike = (columns[:, owner == i].T @ columns[:, owner == j]).abs()
            if alike.numel() and (float(alike.max()) >= ALIKE or j in hidden):
                found[tuple(sorted((kept, j)))] = float(alike.max())
    return sorted(found, key=lambda pair: -found[pair])[:MOST]


def _hidden(search: Search) -> set[int]:
    """Candidates of whose every tangent but a small part is one of the base's."""
    screening, shares = search.screening, dict[int, float]()
    for k, i in enumerate(screening.owner.tolist()):
        tangent = search.candidates[i].tangents[int(screening.shape[k]), :, int(screening.amplitude[k])]
        size = float(search.base.whitening.vector(tangent).norm())
        shares[i] = max(shares.get(i, 0.0), float(screening.norm[k]) / max(size, 1e-300))
    return {i for i, share in shares.items() if share < HIDDEN}


def _linear_pairs(search: Search, most: int) -> list[tuple[int, int]]:
    """Columns of two candidates, each at any of its shapes, that explain most together; the best of each two."""
    screening = search.screening
    sided = []  # columns of every candidate, and the sides to which they may act
    for i, candidate in enumerate(search.candidates):
        columns = screening.usable(i)
        if len(columns) and i not in search.gone:
            sided.append((columns, torch.tensor([candidate.one_sided(search.amplitude(int(k))) for k in columns])))
    found = [_best_pair(search, *first, *second) for first, second in itertools.combinations(sided, 2)]
    return [pair for gain, pair in sorted(found, key=lambda one: -one[0])[:most] if gain > 0]


def _best_pair(
    search: Search, first: Tensor, side: Tensor, second: Tensor, other_side: Tensor
) -> tuple[float, tuple[int, int]]:
    """What the best pair of two sets of columns explains together, with signs that physics allows, and the pair."""
    screening = search.screening
    a, b = screening.columns[:, first], screening.columns[:, second]
    za, zb, c = (a.T @ search.residual.e)[:, None], b.T @ search.residual.e, a.T @ b
    rest = (1 - c.square()).clamp_min(1e-6)
    gain = (za.square() + zb.square() - 2 * c * za * zb) / rest
    allowed = (side[:, None] * (za - c * zb) >= 0) & (other_side * (zb - c * za) >= 0) & (c.abs() < NEARLY_SAME)
    gain = torch.where(allowed, gain, torch.zeros_like(gain))
    best = int(gain.argmax())
    one, other = divmod(best, len(second))
    return float(gain[one, other]), (int(first[one]), int(second[other]))


def _linear_row(search: Search, candidate: Candidate, columns: tuple[int, int]) -> Tensor:
    """Starting values of a pair: the linear estimate at the shapes of two columns, the base moved to make up for it."""
    screening = search.screening
    pair = screening.columns[:, list(columns)]
    sizes = torch.linalg.lstsq(pair, search.residual.e[:, None], driver="gelsd").solution[:, 0]
    sizes = sizes / screening.norm[list(columns)]
    names = [q.name for q in candidate.problem.parameters]
    row = candidate.begin.clone()
    effect = torch.zeros(search.base.problem.n, dtype=torch.float64)
    for column, size in zip(columns, sizes, strict=True):
        single = search.candidates[int(screening.owner[column])]
        g, place = int(screening.shape[column]), search.amplitude(column)
        for i, value in zip(single.own, single.shapes[g].tolist(), strict=True):
            row[names.index(single.problem.parameters[i].name)] = value
        row[names.index(single.problem.parameters[place].name)] += float(size)
        effect += size * single.tangents[g, :, int(screening.amplitude[column])]
    return make_up(search.base, candidate, row, effect)


def _next_terms(search: Search, model: Model, most: int) -> list[int]:
    """The best other candidates by their score at a model's fit, and some that only large effects show."""
    residual = model.residual or Residual(model.found, search.noise, seed=search.seed, draws=10)
    scores = scores_beside(search, model.found, residual, model.numbers)
    scored = [j for _, j in sorted(scores, key=lambda one: (-one[0], one[1]))]
    # What no tangent shows may be seen beside another that none shows, or that has taken its part.
    unseen = [j for j in search.blind if j not in {*scored, *model.numbers, *search.gone}][:UNSEEN]
    return [*scored[:most], *unseen]


def scores_beside(
    search: Search, found: Fitted, residual: Residual, numbers: Sequence[int]
) -> list[tuple[float, int]]:
    """Scores and numbers of the candidates that are not in a model, at a fit of it."""
    scale = drivers_scale(found.problem, found)
    scores, gone = [], search.gone - _apart(search)
    for j, other in enumerate(search.candidates):
        if j in numbers or j in gone:
            continue
        search.tick(f"screen {other.name} after {', '.join(search.candidates[i].name for i in numbers)}")
        try:
            prepared = prepare(found.problem, found, other.terms, search.fixed, scale)
        except (SimulatorError, DomainError):
            continue
        seen = screen(residual, [prepared])
        if seen.best[0] >= 0:
            scores.append((seen.score(0), j))
    return _told(search, scores)


def _apart(search: Search) -> set[int]:
    """Merged candidates that may be told apart beside another term: where the base is bent, its tangents tell less."""
    return search.gone - copies(search) if search.base.chi2 > BENT * search.problem.n else set()


def _told(search: Search, scores: list[tuple[float, int]]) -> list[tuple[float, int]]:
    """The scores without those of merged candidates that are those of what they are merged with."""
    known = {j: z for z, j in scores}
    return [(z, j) for z, j in scores
            if j not in search.gone or abs(z - known.get(search.twins[j], 0.0)) > SAME_SCORE]  # fmt: skip


def _refit_sets(
    search: Search, sets: Sequence[tuple[tuple[int, ...], tuple[int, int] | None]], prior: float
) -> list[Model]:
    """Refit sets of candidates, each with the columns of the linear search that suggested it."""
    return _refitted(search, [_hypothetical(search, numbers, prior, columns) for numbers, columns in sets])


def _refitted(search: Search, wanted: Sequence[Hypothetical | None]) -> list[Model]:
    found = refit_together(search, [one for one in wanted if one is not None])
    return [model for model in found if model is not None]


def _with_third(search: Search, pair: Model, third: int, prior: float) -> Hypothetical | None:
    """A third term beside two, which act in the order in which they do alone."""
    numbers, two = tuple(sorted((*pair.numbers, third))), iter(_order(search, pair))
    return _hypothetical(search, numbers, prior, None, order=[i if i == third else next(two) for i in numbers])


def _hypothetical(
    search: Search,
    numbers: tuple[int, ...],
    prior: float,
    columns: tuple[int, int] | None,
    *,
    order: Sequence[int] = (),
) -> Hypothetical | None:
    """Some candidates together, each begun at its fit alone and, if not as they are listed, acting in an order."""
    terms = [term for i in order or numbers for term in search.candidates[i].terms]
    terms.sort(key=lambda term: not replaces(search.base.problem, search.base.values, term))  # else others are lost
    try:
        candidate = prepare(
            search.base.problem, search.base, terms, search.fixed, drivers_scale(search.base.problem, search.base),
            screened=False,
        )  # fmt: skip
    except (SimulatorError, DomainError):
        return None
    names = [q.name for q in candidate.problem.parameters]
    rows, plain = [], search.plain
    for lead in numbers:
        single = plain.get(lead)
        row = candidate.begin.clone()
        if single is not None:
            known = single.found.by_name
            for k, name in enumerate(names):
                if name in known:
                    row[k] = known[name]
        for other in numbers:
            if other == lead:
                continue
            fitted = plain.get(other)
            source = search.candidates[other]
            for place in source.own:
                name = source.problem.parameters[place].name
                k = names.index(name)
                neutral = source.neutral_at(place)
                value = float(fitted.found.values[place]) if fitted is not None else neutral
                row[k] = neutral + 0.02 * (value - neutral) if place in source.amplitudes else value
        rows.append(row)
        if single is not None:
            for other in numbers:
                if other != lead and other in search.blind:
                    rows += _unseen(search.candidates[other], row, names)
    if columns is not None:
        rows.append(_linear_row(search, candidate, columns))
    return Hypothetical(numbers, candidate, torch.stack(rows), prior)


def _unseen(candidate: Candidate, row: Tensor, names: Sequence[str]) -> list[Tensor]:
    """Starting values of several terms with larger effects of one of them that none of its tangents shows.

    Where the base's parameters make up for an effect, they are moved from where they are in ``row`` as from the base.
    """
    places = [names.index(q.name) for q in candidate.problem.parameters]
    rows = []
    for start in blind_rows(candidate):
        moved = row.clone()
        moved[places] += start - candidate.begin
        moved[[places[i] for i in candidate.own]] = start[candidate.own]
        rows.append(moved)
    return rows
