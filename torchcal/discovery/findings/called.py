"""How hypotheses, probabilities and experiments are called in a sentence."""

import math
from collections.abc import Sequence
from typing import Any

from torchcal.display import NONE, error_unit, up_to, with_unit

__all__ = [
    "LISTED",
    "LITTLE",
    "accepted",
    "called",
    "chance",
    "experiment_told",
    "holds_named",
    "joined",
    "log_odds_behind",
    "rmse_unit",
    "unknown_share",
    "with_region",
]

#: Share of the misfit beyond noise below which there is hardly any to remove.
LITTLE = 0.005
#: Probability from which on the base, or something unknown, is told beside what is named or tied.
LISTED = 0.05
#: Probability of another range of what is named, in that of the named one, from which on it is told too.
NEARLY = 1 / 3
#: Pairs of hypotheses that an experiment leaves, of which the paragraph lists so many.
UNTOLD = 3


def chance(p: float, draws: int = 1000) -> str:
    """A probability in a sentence, by so many simulations: none is smaller than one in these.

    >>> chance(0.0213), chance(0.0004), chance(1 / 501, 500)
    ('0.021', '< 0.001', '< 0.002')
    """
    return f"{p:.2g}" if p > 1.0 / draws else f"< {1.0 / draws:.1g}"


def joined(names: list[str]) -> str:
    """Names in a sentence."""
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def rmse_unit(d: Any) -> str:
    """Behind an error in a sentence."""
    unit = error_unit(d.recording, d.simulator)
    return " of each output's spread" if unit == "spread" else with_unit("", unit)


def log_odds_behind(p: float, first: float) -> float:
    """Log odds of a probability behind another one."""
    return math.log(first / p) if p > 0 and first > 0 else math.inf


def unknown_share(d: Any) -> float:
    """Probability of something that is not in the library."""
    return float(sum(row.probability for row in d.ranking if row.terms == NONE))


def called(d: Any, terms: Sequence[str]) -> str:
    """A hypothesis in a sentence, with the range that it acts in."""
    if tuple(terms) == NONE:
        return "something that is not in this library"
    if not terms:
        return "the base alone"
    region = _region(d, terms)
    return " with ".join(terms) + (f" where {region}" if region else "")


def _region(d: Any, terms: Sequence[str]) -> str | None:
    """Where a hypothesis acts likeliest; None where that is everywhere."""
    rows = [row for row in d.ranking if (row.refitted or row.region) and set(row.terms) == set(terms)]
    best = max(rows, key=lambda row: row.probability, default=None)
    return None if best is None else best.region


def accepted(d: Any) -> Any:
    """The row of the ranking that is named."""
    mine = [row for row in d.ranking if row.refitted and set(row.terms) == set(d.terms)]
    return next((row for row in mine if row.region == d.settings.get("region")), mine[0] if mine else d.ranking[0])


def with_region(d: Any, name: str) -> str:
    """A named term in a sentence, with the range that it acts in, and others that are nearly as likely."""
    row = accepted(d)
    if not row.region:
        return name
    same = [one for one in d.ranking if one.refitted and one.physical and set(one.terms) == set(row.terms)]
    likely = [one for one in same if one is not row and one.probability > NEARLY * row.probability]
    others = list(dict.fromkeys(one.region or "everywhere" for one in likely if one.region != row.region))
    return f"{name}, where {row.region}" + (f" (or, nearly as likely, {', or '.join(others)})" if others else "")


def holds_named(d: Any, row: Any) -> bool:
    """Whether a row of the ranking has the named terms, alone or with others."""
    return bool(row.refitted and row.physical and not row.note and set(row.terms) >= set(d.terms))


def experiment_told(d: Any) -> list[str]:
    """What would tell tied hypotheses apart, if anything."""
    if d.experiment is None:
        return []
    distance = f"predicted distance {up_to(d.experiment.separation)} noise sd"
    text = f"What would tell them apart: {d.experiment.description} ({distance})"
    untold = [f"{a} from {b}" for a, b in d.experiment.untold]
    if len(untold) > UNTOLD + 1:
        untold = [*untold[:UNTOLD], f"{len(untold) - UNTOLD} other pairs apart"]
    text += f"; none that was tried in thought tells {', or '.join(untold)}." if untold else "."
    if d.recording.runs and any("t" in (_region(d, tied) or "").split() for tied in d.tied):
        text += " It takes for granted that what acts in a span of time does so again."
    return [text]
