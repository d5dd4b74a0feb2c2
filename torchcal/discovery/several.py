"""Several terms together: effects hide each other, so pairs are searched as well as second and third terms."""

import itertools
import math
from collections.abc import Sequence

from torch import Tensor

from torchcal.discovery.hypotheses.aliases import merge_sets
from torchcal.discovery.hypotheses.beginnings import STRONG, is_far
from torchcal.discovery.hypotheses.beside import Beside, next_terms
from torchcal.discovery.hypotheses.linear_pairs import linear_pairs
from torchcal.discovery.hypotheses.model import PRIOR, Hypothetical, Model
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.hypotheses.sets import acting_order, distinct, hypothetical, refit_sets, refitted
from torchcal.discovery.rivals import (
    alone_again,
    either_way,
    leading_pairs,
    one_fewer,
    with_look_alikes,
    with_stand_ins,
)
from torchcal.discovery.verdicts.explain import removed
from torchcal.discovery.verdicts.verdict import PLAINLY_WHITE

__all__ = ["refit_several"]

#: Pairs that are refitted at most; where one term leaves noise alone, and the base is not bent.
MOST, FEWER = 30, 10
#: Single terms beside which second ones are sought: of all, and of those that act everywhere; and how many more pairs
#: are refitted for each of these that is not among the three best of all.
LEADS, MORE = 3, 2
#: Second terms that are tried beside one of the best, and third ones beside the best two.
NEXT, THIRD = 7, 4
#: Share of the misfit that one term removes of a recording without noise, and nothing need be sought beside it.
ALL = 0.99999
#: Pairs from the linear search, and from that of a base that is far off, which linear estimates do not reach.
FROM_LINEAR, FROM_FAR = 8, 3


def refit_several(search: Search) -> None:
    """Pairs from the linear search at the base, and second terms after the best single ones; then thirds.

    Where one term leaves noise alone, two may do what it does: fewer of them are tried, unless the base is bent, where
    two that act together are seen badly and one with several shapes may copy them.
    """
    single = sorted((m for m in search.models if len(m.numbers) == 1), key=lambda m: -m.weight)
    count = len(search.candidates)
    if count < 2 or search.max_terms < 2:
        return
    enough = _enough(search)
    if enough and search.exact:
        return
    wanted, seen = _pairs_to_try(search, single, enough and search.base.chi2 <= STRONG * search.problem.n)
    prior = math.log(PRIOR["several"] / (0.5 * count * (count - 1)))
    search.models += (fitted := refit_sets(search, list(wanted.items()), prior, seen))
    if not enough:
        either_way(search, fitted)
    merge_sets(search)
    best = search.physical_leader
    if best is not None and len(best.numbers) == 2:
        with_look_alikes(search, set(wanted), prior)
        with_stand_ins(search, prior)
    for pair in leading_pairs(search):  # whatever leads: it must not do so for a rival that got stuck
        alone_again(search, pair)
    if isinstance(search.problem.recording.noise, Tensor):  # else a smaller noise makes physics of any small misfit
        search.reweigh()
    pairs = [m for m in search.models if len(m.numbers) == 2 and m.window is None]
    if search.max_terms < 3 or not pairs:
        return
    best = max(pairs, key=lambda m: m.weight)
    if search.examine(best).p_value < 0.01 or search.exact:
        third = math.log(0.2 * PRIOR["several"] / (count * (count - 1) * max(count - 2, 1) / 6))
        thirds = next_terms(search, best, THIRD)
        more = distinct(search, [(*best.numbers, j) for j in thirds])
        search.models += refitted(search, [_with_third(search, best, j, third, thirds[j]) for *_, j in more])
        leader = search.physical_leader
        if leader is not None and len(leader.numbers) == 3:
            one_fewer(search, leader, prior)
        merge_sets(search)


def _pairs_to_try(
    search: Search, single: Sequence[Model], few: bool
) -> tuple[dict[tuple[int, ...], tuple[int, int] | None], dict[tuple[int, ...], list[Beside]]]:
    """Pairs, each with the columns of the linear search that suggested it, if that did; and what was seen of one beside
    the other.

    Args:
        single: Models of one term, the likeliest first.
        few: Whether few will do.
    """
    wanted: dict[tuple[int, ...], tuple[int, int] | None] = {}
    for columns in linear_pairs(search, FROM_FAR if is_far(search.base) else FROM_LINEAR):
        wanted[tuple(int(search.screening.owner[k]) for k in columns)] = columns
    leads: dict[int, Model] = {}
    for model in single:
        lead = model.numbers[0]  # in a window merged ones may differ
        leads.setdefault(search.twins[lead] if lead in search.gone else lead, model)
    ahead = list(itertools.islice(leads.items(), 1 if few else LEADS))
    with_each = [_pairs_with(search, lead, model) for lead, model in ahead]
    for pair in itertools.chain(*itertools.zip_longest(*with_each)):  # the best of each lead first
        if pair is not None:
            wanted.setdefault(pair, None)
    wanted = {pair: wanted[pair] for pair in distinct(search, wanted)}
    wanted = dict(itertools.islice(wanted.items(), FEWER if few else MOST))
    if not few:  # a term in a window bends to what two do together, and these act everywhere
        everywhere = [(m.numbers[0], m) for m in single if m.window is None][:LEADS]
        for lead, model in everywhere:
            if (lead, model) not in ahead:
                with_each.append(_pairs_with(search, lead, model))
                more = distinct(search, [*wanted, *with_each[-1]])[len(wanted) :]
                wanted.update(dict.fromkeys(more[:MORE]))
    seen: dict[tuple[int, ...], list[Beside]] = {}
    for pair, one in itertools.chain.from_iterable(found.items() for found in with_each):
        if one is not None:
            seen.setdefault(pair, []).append(one)
    return wanted, seen


def _pairs_with(search: Search, lead: int, model: Model) -> dict[tuple[int, ...], Beside | None]:
    """Pairs of a single term and the best second ones at its fit; each as seen there, if that acts everywhere."""
    return {
        tuple(sorted((lead, j))): one if model.window is None else None
        for j, one in next_terms(search, model, NEXT).items() if j != lead
    }  # fmt: skip


def _enough(search: Search) -> bool:
    """Whether one term that acts everywhere leaves noise alone; a window may stand in for a second one."""
    physical = [m for m in search.models if m.physical and m.window is None]
    if not physical:
        return False
    best = max(physical, key=lambda m: m.weight)
    return removed(search, best) >= ALL if search.exact else search.examine(best).p_value >= PLAINLY_WHITE


def _with_third(
    search: Search, pair: Model, third: int, prior: float, seen: Beside | None
) -> Hypothetical | None:
    """A third term beside two, which act in the order in which they do alone."""
    numbers, two = tuple(sorted((*pair.numbers, third))), iter(acting_order(search, pair))
    order = [i if i == third else next(two) for i in numbers]
    return hypothetical(search, numbers, prior, None, order=order, beside=() if seen is None else (seen,))
