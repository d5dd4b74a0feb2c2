"""A diagnosis in words: a paragraph that could go into a report."""

import textwrap
from typing import Any

from torchcal.discovery.findings.called import (
    LISTED,
    called,
    chance,
    holds_named,
    joined,
    rmse_unit,
    unknown_share,
    with_region,
)
from torchcal.discovery.findings.named_in_words import named
from torchcal.discovery.findings.unnamed_in_words import ambiguous, consistent, likelier, unexplained
from torchcal.display import NONE, units_of, with_unit

__all__ = ["paragraph"]

#: Hypotheses in the first line, and rows of the ranking that are printed.
HEADLINE, BEST = 5, 8


def paragraph(d: Any) -> str:
    """The finding, with its numbers. ``d`` is a Diagnosis."""
    parts = {
        "consistent": consistent,
        "named": named,
        "ambiguous": ambiguous,
        "unexplained": unexplained,
    }[d.verdict](d)
    lines = [_headline(d), ""]
    said = [_detected(d), _lost(d), *parts, _larger(d), _set_aside(d), d.settings.get("interrupted")]
    text = " ".join(part for part in said if part)
    lines += textwrap.wrap(text, 100)
    for title, rows in (("Equation", d.equations), ("Symptoms", d.symptoms), ("Not identified", d.identifiability)):
        if rows:
            lines += ["", f"{title}:"]
            for row in rows:
                lines += textwrap.wrap(row, 100, initial_indent="  ", subsequent_indent="    ")
    columns = ("terms", "region", "log_evidence", "probability", "misfit_removed", "physical", "note")
    shown = type(d.ranking)(listed(d), columns)
    lines += ["", "Hypotheses, the best first:", textwrap.indent(str(shown), "  ")]
    return "\n".join(lines)


def listed(d: Any) -> list[Any]:
    """The rows of the ranking that are printed: the best, and the best of everything that is tied."""
    tied = [tuple(names) for names in d.tied]
    best = {names: k for k, row in reversed(list(enumerate(d.ranking))) if (names := tuple(row.terms)) in tied}
    return [row for k, row in enumerate(d.ranking) if k < BEST or k in best.values()]


def _headline(d: Any) -> str:
    if d.settings.get("interrupted") and d.verdict != "ambiguous":
        return f"Verdict: {d.verdict}, as far as the search went before it was interrupted"
    if d.verdict == "consistent":
        sign = likelier(d) or d.settings.get("unlike") or d.p_detect < 1 - d.confidence
        told = "nothing is surely missing" if sign else "nothing is missing that these data could show"
        return f"Verdict: consistent ({told}{_if_larger(d)})"
    if d.verdict == "named":
        larger = _if_larger(d) if d.noise.source != "given" else ""
        return f"Verdict: named: {joined([with_region(d, name) for name in d.terms])}{_company(d)}{larger}"
    if d.verdict == "ambiguous":
        known = [tied for tied in d.tied if tuple(tied) != NONE]
        if len(known) == 1 and unknown_share(d) < LISTED:
            return f"Verdict: ambiguous: {called(d, known[0])}, which is not sure enough for a name"
        first = known if len(known) <= HEADLINE + 1 else known[:HEADLINE]
        choices = [called(d, tied) for tied in first]
        choices += [f"one of {len(known) - HEADLINE} others"] if len(first) < len(known) else []
        choices += [called(d, NONE)] if len(known) < len(d.tied) else []
        return "Verdict: ambiguous: " + ", or ".join(choices) + (_if_larger(d) if d.noise.source != "given" else "")
    return "Verdict: unexplained (something is missing that is not in this library)"


def _if_larger(d: Any) -> str:
    """On which noise the verdict rests."""
    larger = d.settings.get("larger_noise")
    return f", if the noise{larger} as large as given" if larger else ""


def _company(d: Any) -> str:
    """What is named is seldom alone, where the hypotheses that add more to it are likelier: with what."""
    shares: dict[frozenset[str], float] = {}
    for row in d.ranking:
        if holds_named(d, row):
            shares[frozenset(row.terms)] = shares.get(frozenset(row.terms), 0.0) + row.probability
    alone = shares.get(frozenset(d.terms), 0.0)
    total = sum(shares.values())
    if total - alone <= alone:
        return ""
    largest = max(shares, key=lambda names: shares[names])
    more = [name for row in d.ranking if frozenset(row.terms) == largest for name in row.terms if name not in d.terms]
    told = joined(list(dict.fromkeys(more))) if shares[largest] > 0.5 * total else "something else of this library"
    return f" (most likely with {told})"


def _detected(d: Any) -> str:
    noise = d.noise
    units = units_of(d.recording, d.simulator)
    sizes = {name: with_unit(f"{value:.3g}", units.get(name)) for name, value in noise.sd.items()}
    sd = ", ".join(f"{name} {size}{_varying(d, name)}" for name, size in sizes.items())
    if noise.source == "none":
        rmse = d.before.fitted.rmse
        unit = rmse_unit(d)
        return f"The recording is declared free of noise; the calibrated base leaves an RMSE of {rmse:.4g}{unit}."
    times = getattr(noise, "enlarged", 1.0)
    source = noise.source + (f", and taken for {times:.2g} times as large" if times > 1 else "")
    source += ", larger than given" if noise.source != "given" and d.settings.get("larger_noise") else ""
    text = f"Noise sd ({source}): {sd}"
    correlated = [f"{name} {c:.2f}" for name, c in noise.correlation.items() if c >= 0.05]
    over = {"time": "over the usual gap", "sample": "from sample to sample, however far apart"}
    how = over.get(noise.memory, "from sample to sample")
    text += f", correlated {how} ({', '.join(correlated)})" if correlated else ""
    text += f", {noise.outliers} outlier{'s' if noise.outliers > 1 else ''} set aside" if noise.outliers else ""
    text += f". The calibrated base leaves an RMSE of {d.before.fitted.rmse:.4g}{rmse_unit(d)}; "
    return text + f"noise alone would leave so much structure with probability {chance(d.p_detect)}."


def _lost(d: Any) -> str:
    """Whether the base is one at all."""
    if not d.settings.get("lost"):
        return ""
    return (
        "The calibrated base explains no more than a constant would: before anything is called missing, or nothing, "
        "look at its units, and give initial= or bounds to its parameters, as its best fit may not have been found."
    )


def _larger(d: Any) -> str:
    """What a name rests on that takes the noise for larger than it was given."""
    if d.verdict == "consistent" or d.noise.source == "given" or not d.settings.get("larger_noise"):
        return ""
    return (
        "With the noise that was given nothing explains these data, as neighbours differ by more: it is larger, or "
        "something else acts that changes from one datum to the next."
    )


def _set_aside(d: Any) -> str:
    """What outliers may be of."""
    if not d.settings.get("set_aside"):
        return ""
    return (
        f"What was set aside as outliers may also be explained by {joined(list(d.settings['set_aside']))}; so few data "
        "cannot tell. Repeat them."
    )


def _varying(d: Any, name: str) -> str:
    """The range of an sd that is not the same for all data."""
    if name not in d.noise.range:
        return ""
    low, high = d.noise.range[name]
    several = " or differing from run to run" if d.recording.runs is not None and len(d.recording.runs) > 1 else ""
    told = "this being the median" if d.noise.source == "given" else f"growing with it{several}"
    return f" ({low:.3g} to {high:.3g}, {told})"
