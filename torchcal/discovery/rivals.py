"""Rivals of the leading pair of terms: others in the place of one of its terms, its terms the other way round, and each
of them alone. From the base, which a large effect bends, a fit may have got stuck: some begin where the pair stands."""

import dataclasses
import itertools
import math

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.hypotheses.aliases import merge, merge_sets
from torchcal.discovery.hypotheses.beginnings import BENT, STRONG
from torchcal.discovery.hypotheses.beside import Beside, screened_beside
from torchcal.discovery.hypotheses.model import Hypothetical, Model
from torchcal.discovery.hypotheses.refitting import BETTER, improve, refit_together
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.hypotheses.sets import acting_order, distinct, hypothetical, refit_sets, refitted
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.verdicts.instruments import which_instruments
from torchcal.discovery.verdicts.verdict import PLAINLY_WHITE
from torchcal.errors import DomainError, SimulatorError
from torchcal.terms import extend

__all__ = ["alone_again", "either_way", "leading_pairs", "one_fewer", "with_look_alikes", "with_stand_ins"]

#: Log weight behind the leading pair down to which that is tried, and for how many pairs; and how many look-alikes are
#: tried at most in place of one's terms, and in all.
CLOSE, AGAIN, MOST = 5.0, 3, 20
#: Log weight behind a leading pair that leaves noise, down to which pairs are tried the other way round; how many at
#: most; and the change of χ² from which on that is another model.
FAR_BEHIND, TURNED, ANOTHER = 30.0, 6, 1.0
#: Correlation of two tangents from which on a candidate is tried in the other's place beside the leading pair's; and
#: what of a tangent may be its own where the base is off, for the candidate to be tried in any place.
ALIKE, HIDDEN = 0.9, 0.1
#: Share of the score of one of a pair's terms, beside the other, from which on another candidate may stand in for it;
#: how many are tried for each; and for how many pairs that lead in turn.
STANDS_IN, STAND_INS, IN_TURN = 0.7, 5, 3


def leading_pairs(search: Search) -> list[Model]:
    """The leading pairs, the likeliest first."""
    pairs = [m for m in search.models if m.physical and len(m.numbers) == 2]
    best = max((m.weight for m in pairs), default=0.0)
    return sorted((m for m in pairs if m.weight > best - CLOSE), key=lambda m: -m.weight)[:AGAIN]


def with_look_alikes(search: Search, tried: set[tuple[int, ...]], prior: float) -> None:
    """Pairs with another candidate in place of a leading one's that does nearly the same: first of the best, then of
    those that lead with it, until there are no more or `MOST` of them."""
    count = 0
    done: set[tuple[int, ...]] = set()
    leading = leading_pairs(search)[:1]
    while leading and count < MOST:
        done |= {m.numbers for m in leading}
        wanted = dict.fromkeys(pair for lead in leading for pair in _swapped(search, lead) if pair not in tried)
        pairs = distinct(search, wanted)[: MOST - count]
        tried.update(pairs)
        search.models += (twins := refit_sets(search, [(pair, None) for pair in pairs], prior))
        count += len(twins)
        either_way(search, twins)
        leading = [m for m in leading_pairs(search) if m.numbers not in done]


def _swapped(search: Search, lead: Model) -> list[tuple[int, ...]]:
    """Pairs with another candidate in place of one of a pair's terms: what does nearly the same, at some shapes, then
    what the base's parameters nearly make up for, of which a linear search from a base that is off sees little."""
    found: dict[tuple[int, ...], float] = {}
    hidden = _hidden(search) if search.base.chi2 > BENT * search.base.problem.n else set()
    columns, owner = search.screening.columns, search.screening.owner
    for i in lead.numbers:
        (kept,) = set(lead.numbers) - {i}
        for j in set(range(len(search.candidates))) - {*lead.numbers, *search.gone}:
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


def with_stand_ins(search: Search, prior: float) -> None:
    """Pairs with other candidates in place of one of the leading pair's terms, begun where that stands; then of the
    pair that leads with it."""
    done: set[tuple[int, ...]] = set()
    while search.base.chi2 > STRONG * search.problem.n and len(done) < IN_TURN and not search.stop.is_set():
        lead = leading_pairs(search)[0]
        if lead.numbers in done:
            break
        done.add(lead.numbers)
        _in_its_place(search, lead, prior)


def _in_its_place(search: Search, lead: Model, prior: float) -> None:
    """Pairs of one of a pair's terms with those that explain nearly as much beside it as the other; each as it is found
    from there, where it had not been as good."""
    known: dict[tuple[int, ...], Model] = {
        m.numbers: m for m in search.models if len(m.numbers) == 2 and m.window is None
    }
    begun: dict[tuple[int, ...], Beside] = {}
    for kept in lead.numbers:
        (other,) = set(lead.numbers) - {kept}
        try:
            there = _without(search, lead, kept)
        except (SimulatorError, DomainError):  # one without the other may lead where nothing works
            continue
        every = screened_beside(search, Residual(there, search.noise, draws=10), (kept,))
        scores = {j: seen.score for j, seen in every.items()}
        able = [j for j in scores if j != other and scores[j] > STANDS_IN * scores.get(other, math.inf)]
        for j in sorted(able, key=lambda j: -scores[j])[:STAND_INS]:
            pair = tuple(sorted((kept, j)))
            if pair not in known or known[pair].weight <= lead.weight - BETTER:
                begun[pair] = every[j]
    fresh = distinct(search, [pair for pair in begun if pair not in known])
    wanted = []
    for pair, seen in begun.items():
        one = hypothetical(search, pair, prior, None) if pair in known or pair in fresh else None
        if one is not None:
            wanted.append(dataclasses.replace(one, begin=seen.begin(one.candidate)))
    fitted = []
    for model in refitted(search, wanted):
        old = known.get(model.numbers)
        if old is None or (model.weight > old.weight + BETTER and model.physical >= old.physical):
            search.models = [m for m in search.models if m is not old] + [model]
            fitted.append(model)
    either_way(search, fitted)


def _without(search: Search, lead: Model, kept: int) -> Fitted:
    """One term of a pair as the pair has it, the base too, without the other term."""
    candidate = search.candidates[kept]
    row = _standing(candidate, lead)
    y, jacobian, warm = candidate.problem.evaluate(row[None], candidate.free)
    return dataclasses.replace(
        lead.found, problem=candidate.problem, values=row, free=candidate.free, y=y[0], jacobian=jacobian[0],
        at_bound=torch.zeros(len(candidate.free), dtype=torch.bool), warm=warm, ends=None, ends_chi2=None,
    )  # fmt: skip


def _standing(candidate: Candidate, model: Model) -> Tensor:
    """A candidate's values ``(P,)`` where a model that holds it stands; what only others of its terms free is neutral.
    """
    known, row = model.found.by_name, candidate.begin.clone()
    for k in candidate.free:
        row[k] = known[candidate.problem.parameters[k].name]
    return row


def either_way(search: Search, pairs: list[Model]) -> None:
    """The leading ones of some pairs with their terms the other way round, where that is a model that does better.

    An instrument shows what the physics gives; which of two others on one output comes first, as of a shunt and what
    the leads drop, nobody says. Where the best leaves more than noise, pairs are tried however far they are behind, and
    instruments before the physics too.
    """
    every = [m for m in search.models if len(m.numbers) == 2 and m.window is None]
    if not every:
        return
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
        one = hypothetical(search, pair.numbers, pair.log_prior, None, order=acting_order(search, pair)[::-1])
        if one is not None and one.candidate.terms[0].name != pair.names[0]:
            row = torch.tensor([[known[q.name] for q in one.candidate.problem.parameters]], dtype=torch.float64)
            wanted.append((pair, dataclasses.replace(one, begin=torch.cat([one.begin, row]))))
    better = {
        id(pair): other
        for (pair, _), other in zip(wanted, refit_together(search, [one for _, one in wanted]), strict=True)
        if other is not None and other.physical >= pair.physical and other.weight > pair.weight + BETTER
    }
    search.models = [better.get(id(m), m) for m in search.models]
    merge_sets(search)


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


def alone_again(search: Search, pair: Model) -> None:
    """The terms of a pair, each refitted alone from where the pair ended: from the base it may have got stuck."""
    alone = {i: search.candidates[i] for i in pair.numbers if i not in search.gone}
    improve(search, [Hypothetical((i,), one, _standing(one, pair)[None], search.prior) for i, one in alone.items()])
    merge(search)


def one_fewer(search: Search, three: Model, prior: float) -> None:
    """The pairs of three terms, each refitted from where the three ended: from the base it may have got stuck."""
    pairs = [hypothetical(search, numbers, prior, None) for numbers in itertools.combinations(three.numbers, 2)]
    wanted = [
        dataclasses.replace(one, begin=_standing(one.candidate, three)[None]) for one in pairs if one is not None
    ]
    for model in refitted(search, wanted):
        old = [m for m in search.models if m.numbers == model.numbers and m.window is None]
        if all(model.weight > m.weight + BETTER for m in old):
            search.models = [m for m in search.models if m not in old] + [model]
