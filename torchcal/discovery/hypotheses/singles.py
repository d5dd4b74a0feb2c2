"""Single terms that act everywhere: those that the screening leaves a chance, refitted."""

import torch

from torchcal.discovery.hypotheses.aliases import merge
from torchcal.discovery.hypotheses.beginnings import (
    BENT,
    STRONG,
    beginnings,
    farther,
    first_guess,
    is_far,
    learned,
    valleys,
    within_bounds,
)
from torchcal.discovery.hypotheses.model import Hypothetical
from torchcal.discovery.hypotheses.refitting import improve, refit_together
from torchcal.discovery.hypotheses.search import Search
from torchcal.errors import SimulatorError

__all__ = ["refit_singles"]

#: Single terms that are refitted at most.
MOST = 40
#: Refitted in any case: this many, and those with at least this share of the largest score.
FEW, CHANCE = 6, 0.2
#: Share of the misfit of a bent base that the best term leaves at most, and the probability of as much structure in
#: noise below which it leaves something, for others to be tried from its base.
MOSTLY, PLAINLY = 0.5, 0.01
#: By how much χ² must fall below that of a term's fit for it to begin farther away; and how far from where it plays a
#: part it may still be then, as a share of the way from the base.
LOWER, NEARLY = 2.0, 0.1


def refit_singles(search: Search, *, detected: bool = True) -> None:
    """Every candidate that the screening leaves a chance; where nothing was detected only the leading few."""
    count = len(search.candidates)
    prior = search.prior
    order = sorted((i for i in range(count) if search.screening.best[i] >= 0), key=lambda i: -search.screening.score(i))
    top = search.screening.score(order[0]) if order else 0.0
    promising = [i for k, i in enumerate(order) if k < FEW or search.screening.score(i) >= CHANCE * top]
    chosen = promising[:MOST] if detected else order[:FEW]
    guess = first_guess(search.base, search.fixed, search.seed) if is_far(search.base) else None
    chances = [*chosen, *search.blind]
    begin = (beginnings(search.residual, search.screening, i, search.candidates[i], guess) for i in chances)
    wanted = [Hypothetical((i,), search.candidates[i], rows, prior) for i, rows in zip(chances, begin, strict=True)]
    found = refit_together(search, wanted)
    none = {one.numbers[0] for one, model in zip(wanted, found, strict=True) if model is None}
    search.left = none if search.stop.is_set() else set()
    search.failed = none - search.left
    search.models += [model for model in found if model is not None]
    search.reweigh()
    _learn(search)
    if detected:
        _go_farther(search)
    merge(search)


def _learn(search: Search) -> None:
    """Where the best term explains most of a large misfit, but not all, the others begin again at its base.

    A base that is bent far may show the right term with the wrong sign.
    """
    lead = search.leader
    if search.exact or search.stop.is_set() or lead is None or search.base.chi2 < BENT * search.problem.n:
        return
    if lead.found.chi2 > MOSTLY * search.base.chi2 or search.examine(lead).p_value >= PLAINLY:
        return
    others = [i for i, c in enumerate(search.candidates) if search.screening.best[i] >= 0 and i not in lead.numbers]
    wanted = []
    for i in others:
        try:
            rows = learned(lead.found, search.base, search.candidates[i])
        except SimulatorError:  # a function may raise at sizes that are far off: its first fit stays
            continue
        if len(rows):
            wanted.append(Hypothetical((i,), search.candidates[i], rows, search.prior))
    improve(search, wanted)
    search.reweigh()


def _go_farther(search: Search) -> None:
    """Where much is missing, or the base fits elsewhere too or ran to a bound, every term begins at larger effects too.
    """
    if search.exact or search.stop.is_set():
        return
    within = within_bounds(search.base, search.fixed, search.seed)
    search.elsewhere = valleys(search.base, search.fixed, search.seed)
    places = [*search.elsewhere, *(() if within is None else (within,))]
    if not (places or search.base.chi2 > STRONG * search.problem.n):
        return
    elsewhere = torch.stack([*places, first_guess(search.base, search.fixed, search.seed)])
    wanted, aim = [], search.aim(search.models)
    aim += NEARLY * max(search.base.chi2 - aim, 0.0)
    for i, candidate in enumerate(search.candidates):
        if search.stop.is_set():
            return
        own = search.plain.get(i)
        if search.screening.best[i] < 0 or (own is not None and own.found.chi2 < search.problem.n):
            continue
        least = min(search.base.chi2 if own is None else min(own.found.chi2, search.base.chi2), aim)
        search.tick(f"larger effects of {candidate.name}")
        rows, chi2 = farther(search.residual, search.screening, i, candidate, elsewhere)
        if bool((chi2 < least - LOWER).any()):
            wanted.append(Hypothetical((i,), candidate, rows[chi2 < least - LOWER], search.prior))
    improve(search, wanted)
    search.reweigh()
