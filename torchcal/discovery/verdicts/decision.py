"""Probabilities of hypotheses, and which of their names are certain."""

import math
from collections.abc import Sequence

from torchcal.discovery.hypotheses.aliases import duplicate
from torchcal.discovery.hypotheses.model import PRIOR, Model
from torchcal.discovery.hypotheses.search import Search

__all__ = ["Decision", "certain", "other_names", "shares_of", "tie_other_names", "weigh"]

#: A hypothesis is named when it has at least this probability among those of no more terms that the library offers.
NAMED = 0.97
#: The same among hypotheses of more terms too.
NAMED_AMONG_LARGER = 0.8


class Decision:
    """Verdict, accepted model and probabilities.

    Attributes:
        verdict: As in `Diagnosis`.
        best: The accepted model.
        tied: Sets of names that the data cannot tell apart; of a name that is not all, the sets that hold it.
        tied_models: Their models.
        probability: Of every model, by its ``id``.
        none: Probability of something that is not in the library.
        base: Probability of the base alone.
        none_evidence: Log weight of something that is not in the library.
        none_note: What that is, in words.
        beside: Terms beside which that is likeliest to act; none where it would act alone.
        withdrawn: Why a name was withdrawn, in words.
        doubt: Why the best explanation is no name, though probable, in words.
        pliant: Whether all that is tied bends to what is in no list: windows, instruments, several terms together.
        nearly: Whether what is left is not white, and the name rests on the share of the misfit that it removes.
    """

    def __init__(self) -> None:
        self.verdict = "consistent"
        self.best: Model | None = None
        self.tied: list[list[str]] = []
        self.tied_models: list[Model] = []
        self.probability: dict[int, float] = {}
        self.none = 0.0
        self.base = 1.0
        self.none_evidence = 0.0
        self.none_note = "something unknown"
        self.beside: tuple[str, ...] = ()
        self.withdrawn = ""
        self.doubt = ""
        self.pliant = False
        self.nearly = False


def weigh(search: Search, decision: Decision, models: Sequence[Model] | None = None) -> None:
    """Probabilities of all hypotheses (or of some of them alone), "none of these" among them."""
    models = search.models if models is None else models
    weights = [m.weight for m in models]
    base = math.log(PRIOR["base"])
    top = max([*weights, base, decision.none_evidence])
    total = sum(math.exp(w - top) for w in [*weights, base, decision.none_evidence])
    decision.probability = {id(m): math.exp(m.weight - top) / total for m in models}
    decision.base = math.exp(base - top) / total
    decision.none = math.exp(decision.none_evidence - top) / total


def shares_of(models: Sequence[Model]) -> list[float]:
    """Probability of each model among them."""
    top = max((m.weight for m in models), default=0.0)
    total = sum(math.exp(m.weight - top) for m in models)
    return [math.exp(m.weight - top) / total for m in models]


def certain(ranked: Sequence[Model], model: Model) -> bool:
    """Whether all of a model's terms are there, whatever else is, among the physical models.

    Several others together can copy almost anything, and are the rarer the more they are: against them less will do.
    So it will against a term under another name that frees what these do, and more: it holds them, but is not they.
    """
    holding = more = others = 0.0
    for other, share in zip(ranked, shares_of(ranked), strict=True):
        if set(other.names) >= set(model.names):
            holding += share
        elif other.content > model.content:
            more += share
        elif len(other.names) <= len(model.names):
            others += share
    return holding + more >= NAMED * (holding + more + others) and holding >= NAMED_AMONG_LARGER


def other_names(search: Search, model: Model) -> list[tuple[int, str, str]]:
    """Names that the model could as well have: for each the candidate's number, its name, and the one it replaces.

    A model of a window goes by another name only where that does the same everywhere; one of several terms where what
    it is called after has not been refitted beside the others.
    """
    found = []
    several = {frozenset(m.numbers) for m in search.models if len(m.numbers) > 1 and m.window is None}
    for i in model.numbers:
        own = search.candidates[i].name
        for j in search.aliases.get(i, []):
            if j in model.numbers or frozenset({*model.numbers, j} - {i}) in several:
                continue
            if model.window is None or duplicate(search, i, j):
                found.append((j, search.candidates[j].name, own))
    return found


def tie_other_names(search: Search, model: Model, decision: Decision) -> None:
    """Add what a model could as well be called to the tied hypotheses, with its own fit where there is one."""
    for number, name, own in other_names(search, model):
        names = [name if term == own else term for term in model.names]
        if any(set(names) == set(tied) for tied in decision.tied):
            continue  # it is tied where it acts in a range, too
        decision.tied.append(names)
        other = search.merged.get(number)
        if other is not None and len(model.numbers) == 1 and model.window is None:
            decision.tied_models.append(other)
