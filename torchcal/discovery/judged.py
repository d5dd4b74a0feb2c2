"""A search and its verdict, with the noise that was given, or with its own where that explains nothing."""

import dataclasses
import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcal.discovery.findings.symptoms import larger_than_given
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses import verify
from torchcal.discovery.hypotheses.base import runs_away
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.own_noise import explains
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.noise import EXCESS, estimate, mine
from torchcal.discovery.misfit.replicates import goes_on_along, in_common_at
from torchcal.discovery.nameless import refit_nameless
from torchcal.discovery.rounds import settle, with_all, with_explained, without_others
from torchcal.discovery.several import refit_several
from torchcal.discovery.verdicts.decision import Decision
from torchcal.discovery.verdicts.verdict import decide
from torchcal.errors import TorchcalError

__all__ = ["Judged", "judged"]

#: Models that come nearest, by what they leave; and how many times as large as its fastest part that may be, to be
#: noise.
NEAREST, SLOWER = 12, 1.5
#: Sd by which χ² may exceed its expectation by chance.
CHANCE = 2.0
#: Data of which some change in one place leaves hardly anything.
FEW = 40


@dataclass(frozen=True, eq=False)
class Judged:
    """A search that has ended, and the verdict.

    Attributes:
        search: With its models.
        decision: The verdict on them.
        mask: Which data are held out, or None.
        suspect: Terms that may explain what was set aside as outliers.
        larger_noise: How many times as large as given the noise was taken to be, by output; empty where it was not.
        cut: Whether a second search, with a larger noise, was interrupted.
    """

    search: Search
    decision: Decision
    mask: Tensor | None
    suspect: tuple[str, ...] = ()
    larger_noise: dict[str, float] = field(default_factory=dict)
    cut: bool = False

    @property
    def best(self) -> Model | None:
        """What is named, or else the best of what is tied."""
        tied = self.search.physical_leader if self.decision.verdict == "ambiguous" else None
        return self.decision.best or tied


def judged(search: Search, problem: Problem, mask: Tensor | None, confidence: float, *, movable: bool) -> Judged:
    """The verdict of a search whose base is calibrated.

    A noise sd is often that of an instrument's data sheet. Where what changes from datum to datum contradicts the one
    that was given, it is estimated instead, unless the data are explained with the one and not with the other.

    Args:
        search: With its base calibrated.
        problem: All the data.
        mask: Which data are held out, or None.
        confidence: As for `diagnose`.
        movable: Whether other data may be held out, where the rest leaves a model too open to predict these.
    """
    found = _judge(search, problem, mask, confidence, movable)
    before = found.decision.verdict
    larger = {} if before == "named" or search.stop.is_set() else larger_than_given(found.search, found.best)
    if not larger or not _may_be_noise(found.search) or _explained_by_place(found.search):
        return found
    problem = dataclasses.replace(problem, recording=problem.recording.with_noise(None))
    search = dataclasses.replace(search, problem=problem, unit=_pattern(problem, found.search.noise.sd), coarser=1.0)
    try:
        search.calibrate_base()
        other = _judge(search, problem, mask, confidence, movable)
    except TorchcalError:  # there may be too few data of one output to tell its noise
        return found
    if search.stop.is_set():
        return dataclasses.replace(found, cut=True)
    if bool(runs_away(other.search.base, found.search.base).any()):
        return found
    after = other.decision.verdict
    if after == "unexplained" or (before == "consistent" and after != before):
        return found
    if after == "consistent" and (_no_noise_of_each(other.search) or not _is_fast(found.search, other.search.base)):
        return found
    times = _times(found.search.noise.sd, other.search)
    if not times or any(_grown(other.search, name, size) for name, size in times.items() if name not in larger):
        return found
    return dataclasses.replace(other, larger_noise=times)


def _times(given: Tensor, search: Search) -> dict[str, float]:
    """How many times as large as given the noise of a search is, of the outputs where it is larger."""
    ratio = search.noise.sd / given
    each = {name: ratio[mine(search.problem, k)] for k, name in enumerate(search.problem.recording.outputs)}
    return {name: float(own.median()) for name, own in each.items() if float(own.median()) > EXCESS}


def _grown(search: Search, output: str, times: float) -> bool:
    """Whether the noise of an output, which nothing contradicts, is taken for larger than chance makes it: that hides
    what it misses."""
    freedom = float(search.noise.freedom[search.problem.recording.outputs.index(output)])
    return times > EXCESS * (1 + CHANCE / math.sqrt(2 * max(freedom, 1.0)))


def _judge(search: Search, problem: Problem, mask: Tensor | None, confidence: float, movable: bool) -> Judged:
    if movable and mask is not None and _beyond_prediction(search, search.base, mask):
        mask = verify.within(problem.recording)
    search, detected = settle(search, problem, confidence)
    suspect: tuple[str, ...] = ()
    aside = search.problem.n < problem.n and not search.stop.is_set()
    if search.terms and aside and not (detected and explains(search)):
        # What the best model misses is no outlier of it; where there is none, all physics may have been set aside.
        every, suspect = with_all(search, problem, detected, confidence)
        if every is not None:
            search, detected = every, True
    if detected and search.terms and not search.stop.is_set():
        refit_several(search)
        search = with_explained(search, problem, confidence) or without_others(search, problem)
        refit_nameless(search)
    found = Judged(search, decide(search, detected, mask), mask, suspect)
    best = found.best
    if movable and mask is not None and best and _beyond_prediction(search, best.found, mask):
        mask = verify.within(problem.recording)
        found = dataclasses.replace(found, decision=decide(search, detected, mask), mask=mask)
    return found


def _may_be_noise(search: Search) -> bool:
    """Whether the base, or one of the models that come nearest, leaves hardly more than its fastest part, of any size:
    else a larger noise leaves as much unexplained."""
    nearest = sorted((model.found for model in search.models), key=lambda found: found.chi2)[:NEAREST]
    return any(_is_fast(search, found) for found in (search.base, *nearest))


def _no_noise_of_each(search: Search) -> bool:
    """Whether what the base leaves goes with a condition of several, which noise of each datum does not."""
    problem = search.base.problem
    left = search.noise.whitening(problem).vector(search.base.residual)
    return bool(in_common_at(problem, left) or goes_on_along(problem, left))


def _explained_by_place(search: Search) -> bool:
    """Whether an unknown change in one place, or along two conditions, leaves no more than the noise that was given;
    and of few data, of which some change leaves hardly anything, is likelier than a larger noise."""
    places, n, chi2 = [*search.structure.places, *(search.structure.together or ())], search.problem.n, search.base.chi2
    freedom = max(n - len(search.base.free), 1)
    share = max((place.share for place in places), default=0.0)
    left = 1 + (1 - share) * (chi2 / freedom - 1)
    if not places or left > 1 + CHANCE * math.sqrt(2 / freedom):
        return False
    if n >= FEW:
        return True
    change = max(place.evidence for place in places) - math.log(len(places)) - 0.5 * chi2
    larger = -0.5 * (n * math.log(chi2 / freedom) + freedom + math.log(n))  # a size that is estimated (BIC)
    return change > larger


def _is_fast(search: Search, found: Fitted) -> bool:
    """Whether a fit leaves hardly more than its fastest part, in units of a search's noise."""
    problem = found.problem
    fastest = estimate(problem, found.residual, found.jacobian, search.noise.sd).sizes[:, 0]
    size = found.residual / search.noise.sd[problem.index]
    each = (size[problem.output_of == number] for number in range(len(fastest)))
    pairs = zip(each, fastest.tolist(), strict=True)
    return all(float(left.square().mean()) <= (SLOWER * fast) ** 2 for left, fast in pairs if len(left))


def _pattern(problem: Problem, sd: Tensor) -> Tensor | None:
    """Sizes of a noise ``(n_total,)`` in units of their median by output; None where each output has one size."""
    unit = sd.clone()
    for output in range(len(problem.recording.outputs)):
        of = mine(problem, output)
        unit[of] /= unit[of].median()
    return None if torch.allclose(unit, torch.ones_like(unit)) else unit


def _beyond_prediction(search: Search, found: Fitted, mask: Tensor) -> bool:
    """Whether the rest of the data leaves a model so open that its predictions of the held-out ones mean nothing."""
    apart = search.held_out(found, mask)
    seen = mask & search.problem.keep
    if apart is None or not bool(seen.any()):
        return False
    own = (apart.sd.square() - search.noise.sd.square()).clamp_min(0).sqrt()[seen]
    return bool((own > search.problem.recording.spread[seen]).any())
