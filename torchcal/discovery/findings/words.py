"""A diagnosis in words: a paragraph that could go into a report."""

import math
import re
import textwrap
from collections.abc import Sequence
from typing import Any

from torchcal.discovery.findings.where_in_words import share_in_words, where_in_words
from torchcal.discovery.misfit.channels import RUN
from torchcal.discovery.verdicts.by_share import REMOVED
from torchcal.discovery.verdicts.verdict import PLAINLY_WHITE, WHITE
from torchcal.display import NONE, percent, up_to, with_unit

__all__ = ["paragraph"]

#: Correlation from sample to sample from which on noise is called slow.
SLOW = 0.3
#: Share of the misfit beyond noise below which there is hardly any to remove.
LITTLE = 0.005
#: Probability from which on the base, or something unknown, is told beside tied hypotheses; and how many times as
#: likely as the next one of these is plainly the best.
LISTED, PLAINLY = 0.05, 3.0
#: Hypotheses in the first line, pairs of them that an experiment leaves, and the share of the best one's probability
#: below which one explains less well.
HEADLINE, UNTOLD, AS_WELL = 5, 3, 0.2
#: Hypotheses that hold a named term and more, and detection limits, of which the paragraph lists so many.
MORE, LIMITS = 4, 6
#: Probability of what hypotheses that hold a name have beside it, from which on it is told.
BESIDE = 0.005
#: Share of the misfit that something can remove at most and be no name: all but what is less than that.
NEARLY_ALL = 0.999
#: Probability by noise alone below which what is taken for noise is told to be no common one.
SELDOM = 0.05


def _probability(p: float) -> str:
    return f"{p:.2g}" if p >= 0.001 else "< 0.001"


def _and(names: list[str]) -> str:
    """Names in a sentence."""
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def paragraph(d: Any) -> str:
    """The finding, with its numbers. ``d`` is a Diagnosis."""
    parts = {
        "consistent": _consistent,
        "named": _named,
        "ambiguous": _ambiguous,
        "unexplained": _unexplained,
    }[d.verdict](d)
    lines = [_headline(d), ""]
    said = [_detected(d), _lost(d), *parts, _set_aside(d), d.settings.get("interrupted")]
    text = " ".join(part for part in said if part)
    lines += textwrap.wrap(text, 100)
    for title, rows in (("Equation", d.equations), ("Symptoms", d.symptoms), ("Not identified", d.identifiability)):
        if rows:
            lines += ["", f"{title}:"]
            for row in rows:
                lines += textwrap.wrap(row, 100, initial_indent="  ", subsequent_indent="    ")
    columns = ("terms", "region", "log_evidence", "probability", "misfit_removed", "physical", "note")
    shown = type(d.ranking)(d.ranking[:8], columns)
    lines += ["", "Hypotheses, the best first:", textwrap.indent(str(shown), "  ")]
    return "\n".join(lines)


def _headline(d: Any) -> str:
    if d.settings.get("interrupted") and d.verdict != "ambiguous":
        return f"Verdict: {d.verdict}, as far as the search went before it was interrupted"
    if d.verdict == "consistent":
        sign = _yet(d) or d.settings.get("unlike") or d.p_detect < 1 - d.confidence
        told = "nothing is surely missing" if sign else "nothing is missing that these data could show"
        return f"Verdict: consistent ({told})"
    if d.verdict == "named":
        return f"Verdict: named: {_and([_with_region(d, name) for name in d.terms])}"
    if d.verdict == "ambiguous":
        known = [tied for tied in d.tied if tuple(tied) != NONE]
        if len(known) == 1 and _unknown(d) < LISTED:
            return f"Verdict: ambiguous: {_hypothesis(d, known[0])}, which is not sure enough for a name"
        first = known if len(known) <= HEADLINE + 1 else known[:HEADLINE]
        choices = [_hypothesis(d, tied) for tied in first]
        choices += [f"one of {len(known) - HEADLINE} others"] if len(first) < len(known) else []
        choices += [_hypothesis(d, NONE)] if len(known) < len(d.tied) else []
        return "Verdict: ambiguous: " + ", or ".join(choices)
    return "Verdict: unexplained (something is missing that is not in this library)"


def _unknown(d: Any) -> float:
    """Probability of something that is not in the library."""
    return float(sum(row.probability for row in d.ranking if row.terms == NONE))


def _hypothesis(d: Any, terms: Sequence[str]) -> str:
    if tuple(terms) == NONE:
        return "something that is not in this library"
    if not terms:
        return "the base alone"
    rows = [row for row in d.ranking if (row.refitted or row.region) and set(row.terms) == set(terms)]
    best = max(rows, key=lambda row: row.probability, default=None)
    return " with ".join(terms) + (f" where {best.region}" if best is not None and best.region else "")


def _accepted(d: Any) -> Any:
    """The row of the ranking that is named."""
    mine = [row for row in d.ranking if row.refitted and set(row.terms) == set(d.terms)]
    return next((row for row in mine if row.region == d.settings.get("region")), mine[0] if mine else d.ranking[0])


def _with_region(d: Any, name: str) -> str:
    region = _accepted(d).region
    return f"{name}, where {region}" if region else name


def _detected(d: Any) -> str:
    noise = d.noise
    sd = ", ".join(f"{name} {value:.3g}{_varying(noise, name)}" for name, value in noise.sd.items())
    if noise.source == "none":
        rmse = d.before.fitted.rmse
        unit = _rmse_unit(d)
        return f"The recording is declared free of noise; the calibrated base leaves an RMSE of {rmse:.4g}{unit}."
    times = getattr(noise, "enlarged", 1.0)
    text = f"Noise sd ({noise.source}{f', and taken for {times:.2g} times as large' if times > 1 else ''}): {sd}"
    correlated = [f"{name} {c:.2f}" for name, c in noise.correlation.items() if c >= 0.05]
    over = {"time": "over the usual gap", "sample": "from sample to sample, however far apart"}
    how = over.get(noise.memory, "from sample to sample")
    text += f", correlated {how} ({', '.join(correlated)})" if correlated else ""
    text += f", {noise.outliers} outlier{'s' if noise.outliers > 1 else ''} set aside" if noise.outliers else ""
    text += f". The calibrated base leaves an RMSE of {d.before.fitted.rmse:.4g}{_rmse_unit(d)}; "
    return text + f"noise alone would leave so much structure with probability {_probability(d.p_detect)}."


def _lost(d: Any) -> str:
    """Whether the base is one at all."""
    if not d.settings.get("lost"):
        return ""
    return (
        "The calibrated base explains no more than a constant would: before anything is called missing, or nothing, "
        "look at its units, and give initial= or bounds to its parameters, as its best fit may not have been found."
    )


def _set_aside(d: Any) -> str:
    """What outliers may be of."""
    if not d.settings.get("set_aside"):
        return ""
    return (
        f"What was set aside as outliers may also be explained by {_and(list(d.settings['set_aside']))}; so few data "
        "cannot tell. Repeat them."
    )


def _varying(noise: Any, name: str) -> str:
    """The range of an sd that is not the same for all data."""
    if name not in noise.range:
        return ""
    low, high = noise.range[name]
    told = "growing with it" if noise.source == "estimated" else "this being the median"
    return f" ({low:.3g} to {high:.3g}, {told})"


def _rmse_unit(d: Any) -> str:
    """What errors of several outputs are divided by."""
    return " of each output's spread" if len(d.recording.outputs) > 1 else ""


def _consistent(d: Any) -> list[str]:
    # Of what is seen with one sign alone the table tells.
    limits = [one for one in d.detection_limit if math.isfinite(one.smallest) and not one.sign]
    yet = _yet(d)
    nothing = f"There is no {'sure ' if yet else ''}sign of missing physics.{yet}"
    if d.settings.get("unlike"):
        nothing = "There is no sign of missing physics, if the symptoms below are noise." + yet
    elif d.p_detect < SELDOM:
        nothing = "There is no sure sign of missing physics: by chance noise does as much now and then." + yet
    if d.p_detect < 1 - d.confidence:
        nothing = "Yet the base alone remains likelier than all that was tried beside it."
        if d.noise.source == "estimated" and max(d.noise.correlation.values(), default=0.0) >= SLOW:
            nothing = (
                "Slow noise explains that structure at least as well as anything in the library, so that no physics is "
                "called missing; a known noise sd, replicates or a repeated run would tell."
            )
    if not limits:
        return [nothing]
    shown = ", ".join(with_unit(f"{_told(limit)} {limit.smallest:.3g}", limit.unit) for limit in limits[:LIMITS])
    more = len(limits) - LIMITS
    others = f", and {more} other{'s' if more > 1 else ''}" if more > 0 else ""
    return [
        f"{nothing} The smallest effects that these data could have shown "
        f"(with probability {percent(limits[0].power)}): {shown}{others}."
    ]


def _told(limit: Any) -> str:
    """What has a detection limit: a term, in one run where each has a value of its own."""
    run = re.search(r"\[(\d+)\]$", limit.parameter)
    return limit.term if run is None else f"{limit.term} in run {run[1]}"


def _yet(d: Any) -> str:
    """What is likelier than the base, though chance may have done as much."""
    base = sum(row.probability for row in d.ranking if not row.terms)
    sound = [row for row in d.ranking if row.terms and row.refitted and row.physical and not row.note]
    best = max(sound, key=lambda row: row.probability, default=None)
    if best is None or best.probability <= base:
        return ""
    known = ", or a known noise sd," if d.noise.source == "estimated" else ""
    return (
        f" Yet {_hypothesis(d, best.terms)} is likelier than the base alone (probability {best.probability:.2f} and "
        f"{_probability(base)}), which chance may have done; more data{known} would tell."
    )


def _proof(d: Any) -> str:
    if d.after is None:
        return ""
    text = f"RMSE falls from {d.before.fitted.rmse:.4g} to {d.after.fitted.rmse:.4g}{_rmse_unit(d)}"
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
        )
    return text + "."


def _named(d: Any) -> list[str]:
    top = _accepted(d)
    estimates = "; ".join(str(estimate) for estimate in top.estimates)
    probability = sum(row.probability for row in d.ranking if _holds(d, row))
    alone = sum(row.probability for row in d.ranking if _holds(d, row) and set(row.terms) == set(d.terms))
    with_others = " alone or with others" if d.tied or probability - alone >= BESIDE else ""
    likely = "" if d.settings.get("nearly") else f"probability{with_others} {probability:.3f}; "
    does = f"removes {share_in_words(min(top.misfit_removed, 1.0 - d.remaining))} of the misfit beyond noise"
    if top.misfit_removed < LITTLE:  # the base's misfit is as large as noise, and has a shape
        does = f"lowers χ² from {d.base.chi2:.4g} to {d.final.chi2:.4g}"
    parts = [
        where_in_words(d),
        f"Adding {_and([_with_region(d, name) for name in d.terms])} and refitting everything {does} "
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
    behind = _behind(share, probability)
    if rival == NONE and set(d.settings.get("unknown_beside", ())) >= set(d.terms):
        where = "it" if len(d.terms) == 1 else "them"
        return [
            f"That something which is not in this library acts beside {where} has a probability of "
            f"{_probability(share)}."
        ]
    without = "without it" if len(d.terms) == 1 else "without all of them"
    return [
        f"The next best {without}, {_hypothesis(d, rival)}, has a probability of {_probability(share)} "
        f"({up_to(behind)} behind the name in log odds)."
    ]


def _behind(p: float, first: float) -> float:
    """Log odds of a probability behind another one."""
    return math.log(first / p) if p > 0 and first > 0 else math.inf


def _holds(d: Any, row: Any) -> bool:
    """Whether a row of the ranking has the named terms, alone or with others."""
    return bool(row.refitted and row.physical and not row.note and set(row.terms) >= set(d.terms))


def _beside(d: Any) -> list[str]:
    """What would be likelier together with what is named, though it is no name."""
    best = max((row for row in d.ranking if _holds(d, row)), key=lambda row: row.probability, default=None)
    more = [] if best is None else [name for name in best.terms if name not in d.terms]
    parts = []
    if best is not None and more:
        act = "acts" if len(more) == 1 else "act"
        share = share_in_words(best.misfit_removed)
        parts.append(f"Likelier still is that {_and(more)} {act} beside it ({share} removed).")
    if (unknown := _unknown(d)) >= LISTED:
        parts.append(f"That something which is not in this library acts too has a probability of {unknown:.2f}.")
    return parts


def _larger(d: Any) -> list[str]:
    """What is likely beside the named terms."""
    more = [row for row in d.ranking if _holds(d, row) and set(row.terms) != set(d.terms)]
    shown = [row for row in more[:MORE] if row.probability >= BESIDE]
    listed = [f"{_and([name for name in row.terms if name not in d.terms])} ({row.probability:.2f})" for row in shown]
    if len(more) > len(shown):
        listed.append("others")
    together = sum(row.probability for row in more)
    parts = [f"Something else acts beside it with a probability of {together:.2f}: {', or '.join(listed)}."]
    depends = d.settings.get("depends")
    return parts + ([depends] if depends else []) + _experiment(d)


def _experiment(d: Any) -> list[str]:
    if d.experiment is None:
        return []
    distance = f"predicted distance {up_to(d.experiment.separation)} noise sd"
    text = f"What would tell them apart: {d.experiment.description} ({distance})"
    untold = [f"{a} from {b}" for a, b in d.experiment.untold]
    if len(untold) > UNTOLD + 1:
        untold = [*untold[:UNTOLD], f"{len(untold) - UNTOLD} other pairs apart"]
    return [text + (f"; none that was tried in thought tells {', or '.join(untold)}." if untold else ".")]


def _ambiguous(d: Any) -> list[str]:
    unknown = _unknown(d)
    known = [tied for tied in d.tied if tuple(tied) != NONE]
    if len(known) == 1:
        if d.settings.get("withdrawn"):
            return [where_in_words(d), d.settings["withdrawn"]]
        sure = sum(row.probability for row in d.ranking if set(known[0]) <= set(row.terms))
        if d.settings.get("doubt"):
            return [
                where_in_words(d),
                f"The best explanation in the library is {_hypothesis(d, known[0])} (probability {sure:.2f}).",
                d.settings["doubt"],
                *_unknown_too(unknown),
            ]
        told = math.floor(100 * sure) / 100  # and never what would be enough
        return [
            where_in_words(d),
            f"The best explanation in the library, {' with '.join(known[0])}, has a probability of {told:.2f}, which "
            f"is too little for a name: something that is not in the library has {unknown:.2f}, other terms and the "
            f"base alone have {max(1 - sure - unknown, 0.0):.2f} together. {_would_tell(d, known[0])}",
        ]
    shares = [sum(row.probability for row in d.ranking if set(row.terms) == set(tied)) for tied in known]
    best = max(range(len(known)), key=lambda k: shares[k])
    if all(shares) and shares[best] > PLAINLY * sorted(shares)[-2]:  # another name of the same model has no share
        others = "the other" if len(known) == 2 else f"the {len(known) - 1} others"
        told = f"{_hypothesis(d, known[best])} explains it best (probability {shares[best]:.2f}); these data cannot "
        told += f"exclude {others}."
    else:
        which = "either" if len(known) == 2 else "any"
        least = min(filter(None, shares), default=1.0)
        unequal = f"with probabilities from {shares[best]:.2f} to {_probability(least)}"
        well = "about as well" if least > AS_WELL * shares[best] else unequal
        told = f"{len(known)} hypotheses explain it {well}, and these data cannot exclude {which} of them."
    parts = [where_in_words(d), told]
    sets = [set(tied) for tied in known]
    beside = sum(
        row.probability for row in d.ranking
        if row.refitted and row.physical and not row.note and set(row.terms) not in sets
        and any(tied < set(row.terms) for tied in sets)
    )  # fmt: skip
    if beside >= LISTED and not d.settings.get("doubt"):
        parts.append(f"That another term acts beside one of them has a probability of {beside:.2f}.")
    base = sum(row.probability for row in d.ranking if not row.terms)
    if base >= LISTED:
        parts.append(f"The base alone has a probability of {base:.2f}.")
    shared = [name for name in known[0] if all(name in tied for tied in known)]
    if shared:
        parts.append(f"{'Both' if len(known) == 2 else 'All of them'} have {_and(shared)}.")
    if d.settings.get("doubt"):
        best_of = {"It ": "The best of them ", "it ": "the best of them "}
        parts.append(re.sub(r"^It |\bit ", lambda found: best_of[found[0]], d.settings["doubt"], count=1))
    if unknown > sum(shares):
        parts.append(f"Something that is not in the library is likelier (probability {unknown:.2f}).")
    elif len(known) < len(d.tied):
        share = f"probability {unknown:.2f}"
        if unknown < LISTED:
            share = f"though its probability is {_probability(unknown)}"
        parts.append(f"Nor can these data exclude something that is not in the library ({share}).")
    else:
        parts += _unknown_too(unknown)
    if d.experiment is not None:
        parts += _experiment(d)
    elif sum(any(row.refitted and set(row.terms) == set(tied) for row in d.ranking) for tied in known) > 1:
        parts.append("None of the experiments that were tried in thought would tell them apart.")
    return parts


def _unknown_too(unknown: float) -> list[str]:
    """That something unknown is likely enough to be told."""
    return [f"Something that is not in the library has a probability of {unknown:.2f}."] if unknown >= LISTED else []


def _would_tell(d: Any, terms: Sequence[str]) -> str:
    """What would make a name of the best explanation, or unmake it."""
    row = next((row for row in d.ranking if row.refitted and set(row.terms) == set(terms)), None)
    if row is None or row.p_white is None or row.p_white >= PLAINLY_WHITE:
        return "More data, or less noise, would tell."
    return (
        f"What it leaves has a structure that noise gives with a probability of {_probability(row.p_white)}: whether "
        "that is chance a repeated recording would tell."
    )


def _unexplained(d: Any) -> list[str]:
    parts = [where_in_words(d)]
    best = next((row for row in d.ranking if row.terms and row.refitted), None)
    if best is not None and not best.misfit_removed < LITTLE:
        parts.append(
            f"The best of the library, {_hypothesis(d, best.terms)}, removes "
            f"{share_in_words(min(best.misfit_removed, NEARLY_ALL))} of the misfit beyond noise{_no_name(d, best)}."
        )
    if d.missing is not None:
        size = with_unit(f"{float(d.missing.rate.max() - d.missing.rate.min()):.3g}", d.missing.unit)
        along = "from run to run" if d.missing.driver == RUN else f"against {d.missing.driver}"
        what = "part of the rate of" if d.missing.kind == "equation" else "change of"
        parts.append(
            f"The missing {what} {d.missing.target} {along} spans {size} from its lowest to its highest value, beside "
            "what a change of the base's own parameters does."
        )
    return parts


def _no_name(d: Any, best: Any) -> str:
    """Why the best of the library is no name, as the end of a sentence."""
    if best.note:
        return f" ({best.note})"
    if d.noise.source == "none":
        apart = best.misfit_removed >= REMOVED and len(best.terms) == 1 and d.held_out is not None
        return ", but not of what was held out" if apart else ""
    unknown = _unknown(d)
    mine = sum(row.probability for row in d.ranking if set(row.terms) == set(best.terms))
    left = best.p_white is not None and best.p_white < WHITE
    reasons = []
    if unknown > mine:
        reasons.append(f"something unknown is likelier by {up_to(_behind(mine, unknown))} in log odds")
    if left:
        reasons.append(f"what it leaves is not noise (probability {_probability(best.p_white)})")
    elif not reasons and d.noise.source == "given":
        reasons.append("it leaves more than the noise that is given")
    return ", but " + _and(reasons) if reasons else ""
