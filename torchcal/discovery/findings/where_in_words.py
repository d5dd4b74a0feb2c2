"""Where the mismatch sits, in words."""

import math
from typing import Any

from torchcal.discovery.fits.local import Span
from torchcal.discovery.misfit.channels import RUN
from torchcal.display import ITSELF, between, percent, placed, unit_of, units_of, up_to, with_unit

__all__ = ["share_in_words", "where_in_words"]

#: Log evidence below the best place's down to which another one is told beside it.
CLOSE = 3.0
#: Difference in log-likelihood up to which model error is as likely in one parameter as in another.
AS_LIKELY = 0.5
#: Share of a driver's range from which on spans say nothing.
EVERYWHERE = 0.9
#: Share of the misfit by which another one removes more.
MORE = 0.05
#: Sd up to which the changes of all runs are one, and from which on that is none of 0.
SAME = 2.0


def share_in_words(share: float) -> str:
    """A share in a sentence."""
    return percent(share) if math.isfinite(share) else "an unknown share"


def where_in_words(d: Any) -> str:
    """Where the mismatch sits, what it varies with, and which parameter would have to move."""
    if not d.where:
        return ""
    place = d.where[0]
    unit = unit_of(place.driver, units_of(d.recording, d.simulator))
    spans = with_unit(", ".join(between(place.spans[:3], "to", place.extent)), unit)
    everywhere = _everywhere(d, place)
    if place.driver == RUN:
        if _alike(d, place):
            return (
                f"The mismatch sits in the {place.called} and is the same in every run: one constant "
                f"change there {_does(place)}.{_embedded(d)}"
            )
        largest = "" if everywhere else f" (largest in {spans}, counted from 0)"
        advice = "" if d.terms or d.tied else " What differs between the runs and was not recorded looks like this."
        if advice and place.kind == "parameter":
            advice = " With per_run=True that parameter would take it up."
        return (
            f"The mismatch sits in the {place.called} and differs from run to run{largest}: one change "
            f"for each run {_does(place)}.{advice}{_embedded(d)}"
        )
    largest = "" if everywhere else f" (largest at {spans})"
    if place.period is not None:
        return (
            f"The mismatch sits in the {place.called} and oscillates with {place.driver} (period "
            f"{with_unit(f'{place.period:.3g}', unit)}): a wave there {_does(place)}{_elsewhere(d)}.{_embedded(d)}"
        )
    if place.terms:
        what = f"{' and '.join(place.terms)}{' together' if len(place.terms) > 1 else ''}"
        return (
            f"The mismatch sits in the {place.called} and varies with {place.driver}{largest}: "
            f"adding {what} there{'' if d.terms else ', say,'} {_does(place)}{_elsewhere(d)}.{_embedded(d)}"
        )
    if place.together:
        alone = next((row for row in d.where[1:] if (row.kind, row.target) == (place.kind, place.target)), None)
        less = "" if alone is None else f", and one along {alone.driver} alone {share_in_words(max(alone.share, 0.0))}"
        return (
            f"The mismatch sits in the {place.called} and varies with {place.driver} together: a smooth change there "
            f"{_does(place)}{less}.{_embedded(d)}"
        )
    if place.moment is not None:
        at = with_unit(placed(place.moment, place.extent or 0.0), unit)
        return (
            f"The mismatch sits in the {place.called} and is sudden, at {place.driver} = {at}: one change in that "
            f"moment {_does(place)}{_elsewhere(d)}.{_embedded(d)}"
        )
    if place.edges:
        side = "on one side"
        if len(place.edges) > 1:
            low, high = place.edges
            side = "in between" if any(low < 0.5 * sum(span) < high for span in place.spans) else "outside of these"
        at = with_unit(" and ".join(between([(edge, edge) for edge in place.edges], "to", place.extent)), unit)
        alone = f" where {place.at}" if place.at else ""
        return (
            f"The mismatch sits in the {place.called} and jumps with {place.driver} (at {at}){alone}: one "
            f"constant change {side} {_does(place)}{_elsewhere(d)}.{_embedded(d)}"
        )
    return (
        f"The mismatch sits in the {place.called} and varies with {place.driver}{largest}: a smooth "
        f"change there {_does(place)}{_elsewhere(d)}.{_embedded(d)}"
    )


def _alike(d: Any, place: Any) -> bool:
    """Whether a change for each run is one for all of them, within its sd, as far as it was estimated."""
    m = d.missing
    if m is None or (m.kind, m.target, m.driver) != (place.kind, place.target, RUN):
        return False
    _, which = m.values.unique(return_inverse=True)
    first = [int((which == k).nonzero()[0]) for k in range(int(which.max()) + 1)]
    rate, weight = m.rate[first], m.sd[first].clamp_min(1e-300).square().reciprocal()
    mean = (weight * rate).sum() / weight.sum()
    return bool(((rate - mean).abs() <= SAME * m.sd[first]).all() and (mean.abs() > SAME * m.sd[first]).all())


def _does(place: Any) -> str:
    """What a change does."""
    if place.share <= 0:
        return "takes up what has structure in it, though it is no larger than noise"
    return f"removes {share_in_words(place.share)} of the misfit beyond noise"


def _everywhere(d: Any, place: Any) -> bool:
    """Whether a place's spans are all of its driver's range, or nearly: they say nothing then."""
    if place.driver == RUN:
        runs = range(len(d.recording.runs or ()))
        return all(any(round(low) <= run <= round(high) for low, high in place.spans) for run in runs)
    span = _span(d, place)
    if span is None:
        return False
    return span.high <= span.low or sum(max(span.share(*ends), 0.0) for ends in place.spans) >= EVERYWHERE


def _span(d: Any, place: Any) -> Span | None:
    """The range of a place's driver; None where it is not known."""
    values = d.drivers.get(place.driver)
    own = place.driver.removesuffix(ITSELF)
    if values is None and own in d.recording.outputs:
        values = d.recording.split(d.base.prediction)[own]
    if values is None or not bool(values.isfinite().all()):
        return None
    return Span.of(values, time=d.recording.runs is not None and place.driver == "t")


def _elsewhere(d: Any) -> str:
    """Where else a change would remove about as much; a name says where it is."""
    if d.terms:
        return ""
    first = d.where[0]
    close = [place for place in d.where[1:] if place.evidence > first.evidence - CLOSE and place.driver != RUN]
    other = next((place for place in close if (place.kind, place.target) != (first.kind, first.target)), None)
    if other is None:
        return ""
    text = f", and one of the {other.called} with {other.driver}"
    if other.kind == "output" and first.kind != "output" and other.share > first.share + MORE:
        return f"{text} {share_in_words(other.share)}, though a change of an output can copy that of any equation"
    return f"{text} about as much"


def _embedded(d: Any) -> str:
    if len(d.embedded) < 2 or d.embedded[0].sd <= 0:
        return ""
    first, second = d.embedded[:2]
    if first.log_likelihood - second.log_likelihood < AS_LIKELY:
        return (
            f" Model error embedded in one parameter at a time is about as likely in {first.parameter} (sd "
            f"{first.sd:.3g}) as in {second.parameter} (sd {second.sd:.3g})."
        )
    return (
        f" Model error embedded in one parameter at a time is likeliest in {first.parameter} (sd {first.sd:.3g}; "
        f"{up_to(first.log_likelihood - second.log_likelihood)} in log-likelihood before {second.parameter})."
    )
