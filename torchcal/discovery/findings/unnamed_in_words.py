"""Verdicts that name nothing, in words: consistent, ambiguous and unexplained."""

import math
import re
from collections.abc import Sequence
from typing import Any

from torchcal.discovery.findings.called import (
    LISTED,
    LITTLE,
    called,
    chance,
    experiment_told,
    joined,
    log_odds_behind,
    unknown_share,
)
from torchcal.discovery.findings.where_in_words import share_in_words, where_in_words
from torchcal.discovery.hypotheses.search import CHECKED
from torchcal.discovery.misfit.channels import RUN
from torchcal.discovery.verdicts.by_share import REMOVED
from torchcal.discovery.verdicts.verdict import PLAINLY_WHITE, WHITE
from torchcal.display import IN_BASE, NONE, percent, up_to, with_unit

__all__ = ["ambiguous", "consistent", "likelier", "unexplained"]

#: Correlation from sample to sample from which on noise is called slow.
SLOW = 0.3
#: How many times as likely as the next one of tied hypotheses is plainly the best, and the share of the best one's
#: probability below which one explains less well.
PLAINLY, AS_WELL = 3.0, 0.2
#: Detection limits, of which so many are listed.
LIMITS = 6
#: Share of the misfit that something can remove at most and be no name: all but what is less than that.
NEARLY_ALL = 0.999
#: Probability by noise alone below which what is taken for noise is told to be no common one.
SELDOM = 0.05
#: Probability of the base alone from which on it is likelier than all else.
EVEN = 0.5


def consistent(d: Any) -> list[str]:
    """What is said of a verdict `consistent`."""
    # Of what is seen with one sign alone the table tells.
    limits = [one for one in d.detection_limit if math.isfinite(one.smallest) and not one.sign]
    yet = likelier(d)
    nothing = f"There is no {'sure ' if yet else ''}sign of missing physics.{yet}"
    if d.settings.get("unlike"):
        nothing = "There is no sign of missing physics, if the symptoms below are noise." + yet
    elif d.p_detect < SELDOM:
        nothing = "There is no sure sign of missing physics: by chance noise does as much now and then." + yet
    if d.p_detect < 1 - d.confidence:
        nothing = "Yet the base alone remains likelier than all that was tried beside it."
        nothing += " What the symptoms below tell may be physics." if d.settings.get("unlike") else ""
        if d.noise.source == "estimated" and max(d.noise.correlation.values(), default=0.0) >= SLOW:
            nothing = (
                "Slow noise explains that structure at least as well as anything in the library, so that no physics is "
                "called missing; a known noise sd, replicates or a repeated run would tell."
            )
        base = sum(row.probability for row in d.ranking if not row.terms)
        if d.noise.source == "estimated" and base < EVEN:
            nothing = (
                f"Yet the base alone keeps a probability of {chance(base)}, as noise of unknown size and memory may "
                "have done that: a known noise sd, replicates or a repeated run would tell."
            )
    if d.settings.get("larger_noise"):
        nothing += " But data beside each other differ by more than the noise that was given: it is larger, or "
        nothing += "something acts that changes from the one to the other."
    # What the base has is none of it.
    hidden = [one.term for one in d.detection_limit if math.isinf(one.smallest) and one.note != IN_BASE]
    if hidden:
        nothing += f" No effect of any size that was tried would have shown of {', '.join(dict.fromkeys(hidden))}."
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


def likelier(d: Any) -> str:
    """What is likelier than the base, though chance may have done as much."""
    base = sum(row.probability for row in d.ranking if not row.terms)
    sound = [row for row in d.ranking if row.terms and row.refitted and row.physical and not row.note]
    best = max(sound, key=lambda row: row.probability, default=None)
    every = sum(row.probability for row in sound)
    if best is None or every <= base:
        return ""
    known = ", or a known noise sd," if d.noise.source == "estimated" else ""
    alone = best.probability > base
    which = f"{called(d, best.terms)} is" if alone else "the terms that were tried are, taken together,"
    return (
        f" Yet {which} likelier than the base alone (probability {best.probability if alone else every:.2f} and "
        f"{chance(base)}), which chance may have done; more data{known} would tell."
    )


def ambiguous(d: Any) -> list[str]:
    """What is said of a verdict `ambiguous`."""
    unknown = unknown_share(d)
    known = [tied for tied in d.tied if tuple(tied) != NONE]
    if len(known) == 1:
        if d.settings.get("withdrawn"):
            return [where_in_words(d), d.settings["withdrawn"]]
        sure = sum(row.probability for row in d.ranking if set(known[0]) <= set(row.terms))
        if d.settings.get("doubt"):
            return [
                where_in_words(d),
                f"The best explanation in the library is {called(d, known[0])} (probability {sure:.2f}).{_left(d)}",
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
        told = f"The best of them is {called(d, known[best])} (probability {shares[best]:.2f}); these data cannot "
        told += f"exclude {others}."
    else:
        which = "either" if len(known) == 2 else "any"
        least = min(filter(None, shares), default=1.0)
        unequal = f"with probabilities from {shares[best]:.2f} to {chance(least)}"
        well = "about as well" if least > AS_WELL * shares[best] else unequal
        told = f"{len(known)} hypotheses explain it {well}, and these data cannot exclude {which} of them."
    parts = [where_in_words(d), told + _left(d)]
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
        parts.append(f"{'Both' if len(known) == 2 else 'All of them'} have {joined(shared)}.")
    if d.settings.get("doubt"):
        best_of = {"It ": "The best of them ", "it ": "the best of them "}
        parts.append(re.sub(r"^It |\bit ", lambda found: best_of[found[0]], d.settings["doubt"], count=1))
    if unknown > sum(shares):
        parts.append(f"Something that is not in the library is likelier (probability {unknown:.2f}).")
    elif len(known) < len(d.tied):
        share = f"probability {unknown:.2f}"
        if unknown < LISTED:
            share = f"though its probability is {chance(unknown)}"
        parts.append(f"Nor can these data exclude something that is not in the library ({share}).")
        if d.settings.get("pliant") and unknown < LISTED:
            parts.append(
                "What is tied acts in ranges, changes nothing but outputs, or is several terms together with none in "
                "common: such may stand for what is in no list."
            )
    else:
        parts += _unknown_too(unknown)
    if d.experiment is not None:
        parts += experiment_told(d)
    elif sum(any(row.refitted and set(row.terms) == set(tied) for row in d.ranking) for tied in known) > 1:
        which = " that are feasible and" if d.settings.get("feasible") else " that"
        parts.append(f"None of the experiments{which} were tried in thought would tell them apart.")
    return parts


def _left(d: Any) -> str:
    """That what is tied explains the data beside noise that is larger than given."""
    if d.noise.source != "given" or not d.settings.get("larger_noise"):
        return ""
    return " What is left is larger than the noise that was given, and taken for noise."


def _unknown_too(unknown: float) -> list[str]:
    """That something unknown is likely enough to be told."""
    return [f"Something that is not in the library has a probability of {unknown:.2f}."] if unknown >= LISTED else []


def _would_tell(d: Any, terms: Sequence[str]) -> str:
    """What would make a name of the best explanation, or unmake it."""
    row = next((row for row in d.ranking if row.refitted and set(row.terms) == set(terms)), None)
    if row is None or row.p_white is None or row.p_white >= PLAINLY_WHITE:
        return "More data, or less noise, would tell."
    return (
        f"What it leaves has a structure that noise gives with a probability of {chance(row.p_white, CHECKED)}: "
        "whether that is chance a repeated recording would tell."
    )


def unexplained(d: Any) -> list[str]:
    """What is said of a verdict `unexplained`."""
    parts = [where_in_words(d)]
    best = next((row for row in d.ranking if row.terms and row.refitted), None)
    if best is not None and not best.misfit_removed < LITTLE:
        # Beside noise that another hypothesis tells, what it leaves is larger than a share near all of it sounds.
        much = best.misfit_removed >= REMOVED and best.p_white is not None and best.p_white < WHITE
        share = "most" if much else share_in_words(min(best.misfit_removed, NEARLY_ALL))
        parts.append(
            f"The best of the library, {called(d, best.terms)}, removes {share} of the misfit beyond noise"
            f"{_no_name(d, best)}."
        )
    if d.missing is not None:
        size = with_unit(f"{float(d.missing.rate.max() - d.missing.rate.min()):.3g}", d.missing.unit)
        along = "from run to run" if d.missing.driver == RUN else f"against {d.missing.driver}"
        along += "" if d.missing.run is None else f" in run {d.missing.run}"
        along += " alone" if d.where and d.where[0].together else ""
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
    unknown = unknown_share(d)
    mine = sum(row.probability for row in d.ranking if set(row.terms) == set(best.terms))
    left = best.p_white is not None and best.p_white < WHITE
    reasons = []
    if unknown > mine:
        reasons.append(f"something unknown is likelier by {up_to(log_odds_behind(mine, unknown))} in log odds")
    if left:
        reasons.append(f"what it leaves is not noise (probability {chance(best.p_white, CHECKED)})")
    elif not reasons and d.noise.source == "given":
        reasons.append("it leaves more than the noise that is given")
    return ", but " + joined(reasons) if reasons else ""
