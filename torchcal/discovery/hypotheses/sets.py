"""Several candidates as one hypothesis: what they are together, where their refit begins, and their refits."""

from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate, prepare, replaces
from torchcal.discovery.fits.ranges import drivers_scale
from torchcal.discovery.hypotheses.beginnings import blind_rows
from torchcal.discovery.hypotheses.beside import Beside
from torchcal.discovery.hypotheses.linear_pairs import linear_row
from torchcal.discovery.hypotheses.model import Hypothetical, Model
from torchcal.discovery.hypotheses.refitting import refit_together
from torchcal.discovery.hypotheses.search import Search
from torchcal.errors import DomainError, SimulatorError

__all__ = ["acting_order", "distinct", "hypothetical", "refit_sets", "refitted"]

#: Of the starts that a term has beside others, those that are tried with the starts from each alone.
BESIDE = 2


def hypothetical(
    search: Search,
    numbers: tuple[int, ...],
    prior: float,
    columns: tuple[int, int] | None,
    *,
    order: Sequence[int] = (),
    beside: Sequence[Beside] = (),
) -> Hypothetical | None:
    """Some candidates together, begun at the fit of each alone where it has one, and acting in an order, if not as they
    are listed; also where some were seen ``beside`` the others."""
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
    rows, plain = [], search.merged | search.plain
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
        rows.append(linear_row(search, candidate, columns))
    begin = torch.cat([torch.stack(rows), *(one.begin(candidate, BESIDE) for one in beside)])
    return Hypothetical(numbers, candidate, begin, prior)


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


def acting_order(search: Search, model: Model) -> list[int]:
    """A model's candidates in the order in which they act."""
    names = list(model.names)
    return sorted(model.numbers, key=lambda i: names.index(search.candidates[i].terms[0].name))


def distinct(search: Search, sets: Iterable[tuple[int, ...]]) -> list[tuple[int, ...]]:
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


def refit_sets(
    search: Search,
    sets: Sequence[tuple[tuple[int, ...], tuple[int, int] | None]],
    prior: float,
    beside: Mapping[tuple[int, ...], Sequence[Beside]] | None = None,
) -> list[Model]:
    """Refit sets of candidates, each with the columns of the linear search that suggested it, and with what was seen of
    some beside the others."""
    seen = beside or {}
    return refitted(search, [hypothetical(search, each, prior, cols, beside=seen.get(each, ())) for each, cols in sets])


def refitted(search: Search, wanted: Sequence[Hypothetical | None]) -> list[Model]:
    """The models of several hypotheses, of those that there are and that some start gives a fit of."""
    found = refit_together(search, [one for one in wanted if one is not None])
    return [model for model in found if model is not None]
