"""The ranking of a diagnosis: every hypothesis with its probability, what it explains and what it leaves."""

import dataclasses
import math

from torch import Tensor

from torchcal.discovery.hypotheses import verify
from torchcal.discovery.hypotheses.model import PRIOR, Model
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.records import Hypothesis, Table
from torchcal.discovery.verdicts import explain
from torchcal.discovery.verdicts.decision import Decision, other_names
from torchcal.display import IN_BASE, NONE

__all__ = ["ranking"]

#: Models that get a row, those of them that are scored on held-out data, and how probable they must be.
LISTED, SCORED, PROBABLE = 60, 3, 1e-3

COLUMNS = (
    "terms", "region", "log_evidence", "probability", "misfit_removed", "p_white", "physical", "estimates",
    "held_out_rmse", "score", "refitted", "aliases", "note",
)  # fmt: skip


def ranking(search: Search, decision: Decision, mask: Tensor | None) -> Table[Hypothesis]:
    """Every hypothesis, the likeliest first: refitted or only screened, the base alone and something unknown.

    Args:
        search: The finished one.
        decision: With the probabilities.
        mask: Held-out data, bool ``(n_total,)``, that the first probable models are scored on; None for none.
    """
    ordered = sorted(search.models, key=lambda m: -decision.probability.get(id(m), 0.0))
    listed = ordered[:LISTED]
    if decision.best is not None and decision.best not in listed:
        listed.append(decision.best)
    rows: list[Hypothesis] = []
    alike: dict[int, tuple[Model, float]] = {}
    for place, model in enumerate(listed):
        others = _others(search, decision, model)
        share = decision.probability.get(id(model), 0.0) / (1 + len(others))  # nothing tells which of them it is
        if model.window is None:
            alike |= {j: (model, share) for j in others}
        scored = model is decision.best or (place < SCORED and share > PROBABLE)
        rows.append(_refitted(search, model, share, others, _held_out(search, model, mask) if scored else None))
        if model.window is not None:
            rows += [dataclasses.replace(_alias(search, j, model, share), estimates=(), refitted=False,
                                         region=model.where) for j in others]  # fmt: skip
    fitted = {m.numbers for m in search.models}
    for i in range(len(search.candidates)):
        if i in alike:
            rows.append(_alias(search, i, *alike[i]))
        elif (i,) not in fitted:
            rows.append(_screened(search, i))
    rows.append(
        Hypothesis((), 0.0, decision.base, misfit_removed=0.0, p_white=search.structure.p_value, refitted=True,
                   note="the base alone")
    )
    if not search.exact or decision.none:
        evidence = -math.inf if search.exact else decision.none_evidence - math.log(PRIOR["none"])
        rows.append(Hypothesis(NONE, evidence, decision.none, note=decision.none_note))
    rows.sort(key=lambda row: (-row.probability, -row.log_evidence))
    return Table(rows, COLUMNS)


def _others(search: Search, decision: Decision, model: Model) -> list[int]:
    """Numbers of the candidates that a model could as well be called after, in its windows too where one is tied."""
    if model in search.plain.values():
        return search.aliases.get(model.numbers[0], [])
    tied = {one.numbers for one in decision.tied_models if one.window is not None and len(one.numbers) == 1}
    local = model.window is not None and model.numbers in tied
    return [number for number, _, _ in other_names(search, model)] if local else []


def _held_out(search: Search, model: Model, mask: Tensor | None) -> float | None:
    """RMSE of a model's predictions of held-out data."""
    if mask is None or not bool((seen := mask & search.problem.keep).any()):
        return None
    apart = search.held_out(model.found, mask)
    return None if apart is None else verify.score(search.problem.recording, apart.prediction, apart.sd, seen).rmse


def _refitted(search: Search, model: Model, share: float, others: list[int], held: float | None) -> Hypothesis:
    return Hypothesis(
        terms=model.names,
        log_evidence=model.log_evidence,
        probability=share,
        estimates=explain.estimates(model.found, model.candidate.own, model.window, model.intervals),
        physical=model.physical,
        misfit_removed=explain.removed(search, model),
        p_white=model.structure.p_value if model.structure else None,
        held_out_rmse=held,
        score=search.screening.score(model.numbers[0]) if len(model.numbers) == 1 else None,
        refitted=True,
        region=model.where,
        aliases=tuple(search.candidates[j].name for j in others),
        note=model.note,
    )


def _alias(search: Search, i: int, model: Model, share: float) -> Hypothesis:
    """A candidate that these data cannot tell from the one of another model."""
    own_fit = search.merged.get(i)
    beside = any(i in m.numbers for m in search.models if len(m.numbers) > 1)  # others may tell them apart
    return Hypothesis(
        (search.candidates[i].name,),
        model.log_evidence,
        share,
        estimates=() if own_fit is None else explain.estimates(own_fit.found, own_fit.candidate.own),
        physical=model.physical,
        misfit_removed=explain.removed(search, model),
        score=search.screening.score(i),
        refitted=own_fit is not None,
        note=f"the same as {model.names[0]} {'alone' if beside else 'here'}",
    )


def _screened(search: Search, i: int) -> Hypothesis:
    """A candidate that was not refitted, or could not be."""
    candidate = search.candidates[i]
    nothing = not candidate.blind and search.screening.best[i] < 0
    note = IN_BASE if nothing else ""
    note = "no fit from any starting value" if i in search.failed else note
    removed = 0.0 if nothing else None
    score = search.screening.score(i)
    return Hypothesis((candidate.name,), -math.inf, 0.0, misfit_removed=removed, score=score, note=note)
