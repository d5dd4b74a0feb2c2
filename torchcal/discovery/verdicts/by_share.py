"""Names by the share of the misfit that they remove, where what is left is not white."""

import math
from collections.abc import Sequence

from torch import Tensor

from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.verdicts import explain
from torchcal.discovery.verdicts.decision import Decision, other_names, tie_other_names, weigh
from torchcal.discovery.verdicts.doubts import distinct, doubt, left_open
from torchcal.discovery.verdicts.proof import gain, prove
from torchcal.display import NONE

__all__ = ["decide_exact", "nearly"]

#: Of a recording without noise, the share of the held-out misfit that a named term must remove.
REMOVED = 0.9
#: The same of a recording whose noise is unknown, how much more of the misfit every rival must leave, how many times
#: its noise may be left, and data a free parameter that tell what is noise.
NEARLY, BEATEN, LEFT, PLENTY = 0.97, 3.0, 3.0, 20
#: The share that a term must remove to be named although others beside it are clearly likelier.
SURELY = 0.99
#: Log odds by which a hypothesis of other terms, or more, is clearly likelier.
OUTDONE = 5.0


def decide_exact(search: Search, ranked: list[Model], mask: Tensor | None, decision: Decision) -> Decision:
    """Without noise nothing is white: a term must remove nearly all of the held-out misfit that is left, far more than
    any rival; then another may remove nearly all of what that leaves."""
    decision.none_evidence = -math.inf
    if bool(search.base.met.all()):
        decision.verdict = "consistent"
        return decision
    clean = [m for m in ranked if not m.note]
    accepted: Model | None = None
    decision.verdict = "unexplained"
    for size in range(1, search.max_terms + 1):
        have = set() if accepted is None else set(accepted.numbers)
        left = search.base.chi2 if accepted is None else accepted.found.chi2
        group = sorted(
            (m for m in clean if len(m.numbers) == size and have <= set(m.numbers)), key=lambda m: m.found.chi2
        )
        good = [m for m in group if m.found.chi2 <= (1 - REMOVED) * min(left, _least_part(clean, m))
                and gain(search, m, mask, accepted) >= REMOVED]  # fmt: skip
        if not good:
            continue
        rivals = [
            m
            for m in group
            if frozenset(m.names) != frozenset(good[0].names) and m.found.chi2 < BEATEN * good[0].found.chi2
        ]
        if rivals or other_names(search, good[0]):
            if accepted is None:
                decision.verdict = "ambiguous"
                decision.tied_models = [good[0], *rivals]
                decision.tied = [list(m.names) for m in decision.tied_models]
                for model in (good[0], *rivals):
                    tie_other_names(search, model, decision)
            break
        if accepted is not None and doubt(search, good[0]):
            break  # what is there already may be a name all the same
        accepted = good[0]
    if accepted is not None and (why := doubt(search, accepted)):
        decision.verdict, decision.doubt = "ambiguous", why
        decision.tied, decision.tied_models = [list(accepted.names), list(NONE)], [accepted]
    elif accepted is not None:
        decision.verdict, decision.best = "named", accepted
    if decision.verdict == "unexplained":  # whatever is likelier than the rest removes too little, or is no physics
        decision.none, decision.base = 1.0, 0.0
        return decision
    most = len(accepted.numbers) if accepted else len(decision.tied_models[0].numbers)
    weigh(search, decision, [m for m in clean if len(m.numbers) <= most])
    return decision


def _least_part(models: Sequence[Model], model: Model) -> float:
    """Smallest χ² of a model with fewer of the same terms."""
    return min((m.found.chi2 for m in models if set(m.numbers) < set(model.numbers)), default=math.inf)


def nearly(search: Search, ranked: list[Model], mask: Tensor | None, decision: Decision) -> None:
    """Real recordings are never quite white: name what removes nearly all, on held-out data too, far before rivals."""
    clean = [m for m in ranked if not m.note and m.window is None]  # a window bends to whatever is left
    if search.problem.recording.noise is not None:
        return
    shared: Model | None = None
    for size in (1, 2):  # three bend to almost anything
        mine = sorted((m for m in clean if len(m.numbers) == size), key=lambda m: m.found.chi2)
        if not mine or not _leaves_little(search, mine[0], mask):
            continue
        best = mine[0]
        likelier = [m for m in ranked if m.weight > best.weight + OUTDONE]
        if not set(best.names) <= set(decision.beside):
            continue  # what is left is likelier without it
        if not likelier:
            if _far_before(search, mine):
                shared = best
            break
        if _holds_whatever_else(search, best, likelier) and _far_before(search, mine):
            shared = best
    if shared is not None:
        decision.verdict, decision.best, decision.nearly = "named", shared, True
        prove(search, decision, mask)


def _holds_whatever_else(search: Search, model: Model, likelier: Sequence[Model]) -> bool:
    """Whether physics that removes nearly all is there, whatever else may be, by all likelier hypotheses.

    They add terms to it that act everywhere: to one term one or another, to two a third, as three bend to almost
    anything. A window of its own speaks against it, and what changes the output alone bends to much.
    """
    more = all(m.window is None and set(model.names) < set(m.names) for m in likelier)
    return (
        more
        and (len(model.numbers) > 1 or sum(len(m.numbers) == 2 for m in likelier) > 1)
        and not any(term.is_sensor for term in model.candidate.terms)
        and explain.removed(search, model) >= SURELY
    )


def _leaves_little(search: Search, model: Model, mask: Tensor | None) -> bool:
    """Whether a model leaves a small share of the misfit, not much more than noise, and nothing of itself open."""
    if explain.removed(search, model) < NEARLY or gain(search, model, mask) < REMOVED:
        return False
    most = min((1 - REMOVED) * search.base.chi2, LEFT**2 * search.problem.n)
    few = distinct(search.problem) < PLENTY * len(model.found.free)
    return model.found.chi2 <= most and not few and not left_open(search, model)


def _far_before(search: Search, models: Sequence[Model]) -> bool:
    """Whether the first of models leaves far less of the misfit than those of other terms, and has one name alone."""
    best = models[0]
    left = 1.0 - explain.removed(search, best)
    rivals = [m for m in models[1:] if frozenset(m.names) != frozenset(best.names)]
    alone = all(1.0 - explain.removed(search, m) > BEATEN * left for m in rivals)
    return alone and not other_names(search, best)
