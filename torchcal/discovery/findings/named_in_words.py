"""What is named, in words: where it acts, what it removes, its rivals, and the proof."""

from typing import Any

from torchcal.discovery.findings.called import (
    LISTED,
    LITTLE,
    accepted,
    called,
    chance,
    experiment_told,
    holds_named,
    joined,
    log_odds_behind,
    rmse_unit,
    unknown_share,
    with_region,
)
from torchcal.discovery.findings.where_in_words import share_in_words, where_in_words
from torchcal.display import NONE, up_to

__all__ = ["named"]

#: Hypotheses that hold a named term and more, of which so many are listed; probability from which on they are.
MORE, BESIDE = 4, 0.005


def named(d: Any) -> list[str]:
    """What is said of a verdict `named`."""
    top = accepted(d)
    estimates = "; ".join(str(estimate) for estimate in top.estimates)
    probability = sum(row.probability for row in d.ranking if holds_named(d, row))
    alone = sum(row.probability for row in d.ranking if holds_named(d, row) and set(row.terms) == set(d.terms))
    with_others = " alone or with others" if d.tied or probability - alone >= BESIDE else ""
    likely = "" if d.settings.get("nearly") else f"probability{with_others} {probability:.3f}; "
    does = f"removes {share_in_words(min(top.misfit_removed, 1.0 - d.remaining))} of the misfit beyond noise"
    if top.misfit_removed < LITTLE:  # the base's misfit is as large as noise, and has a shape
        does = f"lowers χ² from {d.base.chi2:.4g} to {d.final.chi2:.4g}"
    parts = [
        where_in_words(d),
        f"Adding {joined([with_region(d, name) for name in d.terms])} and refitting everything {does} "
        f"({likely}{estimates}).",
    ]
    if d.settings.get("nearly"):
        apart = "" if d.held_out is None else "on held-out data too, "
        parts.append(
            "What is left is more than noise, as on most real recordings; the name rests on the share that is removed, "
            f"{apart}and on every rival of as many terms leaving at least three times as much."
        )
        parts += _beside(d)
    else:
        parts += _rival(d, probability)
    parts.append(_proof(d))
    if d.tied:
        parts += _larger(d)
    if d.remaining > LITTLE:
        parts.append(f"{share_in_words(d.remaining)} of the misfit remains unexplained.")
    return parts


def _rival(d: Any, probability: float) -> list[str]:
    """The likeliest of what has not all that is named, which has a probability."""
    shares: dict[tuple[str, ...], float] = {}
    for row in d.ranking:
        names = tuple(sorted(row.terms))
        if not set(names) >= set(d.terms) and (row.refitted or row.terms == NONE):
            shares[names] = shares.get(names, 0.0) + row.probability
    if not shares:
        return []
    rival, share = max(shares.items(), key=lambda item: item[1])
    behind = log_odds_behind(share, probability)
    if rival == NONE and set(d.settings.get("unknown_beside", ())) >= set(d.terms):
        where, place = ("it", "its") if len(d.terms) == 1 else ("them", "their")
        return [
            f"That something which is not in this library acts beside {where}, or in {place} place, has a probability "
            f"of {chance(share)}."
        ]
    without = "without it" if len(d.terms) == 1 else "without all of them"
    return [
        f"The next best {without}, {called(d, rival)}, has a probability of {chance(share)} "
        f"({up_to(behind)} behind the name in log odds)."
    ]


def _beside(d: Any) -> list[str]:
    """What would be likelier together with what is named, though it is no name."""
    best = max((row for row in d.ranking if holds_named(d, row)), key=lambda row: row.probability, default=None)
    more = [] if best is None else [name for name in best.terms if name not in d.terms]
    parts = []
    if best is not None and more:
        act = "acts" if len(more) == 1 else "act"
        share = share_in_words(best.misfit_removed)
        parts.append(f"Likelier still is that {joined(more)} {act} beside it ({share} removed).")
    if (unknown := unknown_share(d)) >= LISTED:
        parts.append(f"That something which is not in this library acts too has a probability of {unknown:.2f}.")
    return parts


def _larger(d: Any) -> list[str]:
    """What is likely beside the named terms."""
    more = [row for row in d.ranking if holds_named(d, row) and set(row.terms) != set(d.terms)]
    shown = [row for row in more[:MORE] if row.probability >= BESIDE]
    listed = [f"{joined([name for name in row.terms if name not in d.terms])} ({row.probability:.2f})" for row in shown]
    if len(more) > len(shown):
        listed.append("others")
    together = sum(row.probability for row in more)
    parts = [f"Something else acts beside it with a probability of {together:.2f}: {', or '.join(listed)}."]
    depends = d.settings.get("depends")
    return parts + ([depends] if depends else []) + experiment_told(d)


def _proof(d: Any) -> str:
    if d.after is None:
        return ""
    text = f"RMSE falls from {d.before.fitted.rmse:.4g} to {d.after.fitted.rmse:.4g}{rmse_unit(d)}"
    if d.before.held_out is not None and d.after.held_out is not None:
        b, a = d.before.held_out, d.after.held_out
        text += (
            f"; on {b.n} data kept from both fits from {b.rmse:.4g} to {a.rmse:.4g} (log score {b.log_score:.3g} to "
            f"{a.log_score:.3g}, 95 % intervals hold {share_in_words(b.coverage)}, then {share_in_words(a.coverage)})"
        )
        if a.rmse > b.rmse:
            text += ", where the effect does not show beyond chance"
    if d.before.model_error_sd and d.after.model_error_sd is not None:
        text += (
            f". The embedded model-error sd shrinks from {d.before.model_error_sd:.3g} to {d.after.model_error_sd:.3g}"
            f"{rmse_unit(d)}"
        )
    return text + "."
