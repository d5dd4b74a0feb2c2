"""Which noise suits the hypotheses of a search, and what sticks out once the best of them explains the rest."""

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted, refit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.base import growing
from torchcal.discovery.hypotheses.model import PRIOR, Model
from torchcal.discovery.misfit.likeliest import alone, density, log_likelihood
from torchcal.discovery.misfit.noise import Noise, mine
from torchcal.discovery.misfit.outliers import lone, spikes

if TYPE_CHECKING:
    from torchcal.discovery.hypotheses.search import Search

__all__ = [
    "EXPLAINED",
    "beside",
    "explains",
    "fits_by_chance",
    "isolated",
    "known_density",
    "likeliest_alone",
    "likeliest_outliers",
    "odds_alone",
    "other_growth",
    "outdone",
    "outliers",
    "outliers_alone",
    "pairs_by_chance",
    "suited",
    "weigh_alone",
]

#: Log evidence of a model from which on what sticks out of it alone are outliers, and how many these may be.
CLEAR, MOST_OUTLIERS = 10.0, 0.1
#: Models that are fitted again with their own noise at the end, those that are less far behind in log evidence.
SETTLED, BEHIND = 10, 20.0
#: How often what sticks out is judged anew without it.
TRIMS = 3
#: Share of outliers among data, and log odds from which on physics explains better what had been taken for some.
RARE, EXPLAINED = 0.05, 5.0
#: Models beside the best that are judged with their own outliers, those at most so far behind in log weight; the sd by
#: which they must miss a datum; and how many outliers more they may have.
CONTENDERS, NOT_FAR, STICKS_OUT, FURTHER = 4, 40.0, 4.0, 2
#: Share of its variance that a fit leaves of any datum at least, where residuals are scaled by it.
LEAST_FREE = 0.05
#: Log odds from which on something unknown is clearly likelier than the best model.
LIKELIER = 3.0
#: χ² a datum below which the noise estimated is its least, not the misfit's size: a residual so far below is rounding.
ROUNDING = 0.01
#: Correlation of two tangents from which on they are one.
SAME = 0.999
#: Share of the search's noise sd below which a model's own takes its place.
OUTDATED = 0.8
#: Mean relative difference of the noise's sd in its unit, in logarithms, from which on it grows otherwise.
OTHERWISE = 0.5


def suited(search: "Search", models: Sequence[Model]) -> Noise:
    """The noise of the likeliest hypothesis, each with its own: of these models, or of something unknown where that is
    clearly likelier."""
    own = {id(m): alone(m.found, search.noise, search.tangents) for m in models}
    best = max(models, key=lambda m: own[id(m)][1] + m.prior)
    noise, value = search.settled(best.found)
    value += best.prior + LIKELIER
    for found, prior in ((search.base, 0.0), (best.found, best.prior)):
        other, evidence = search.with_unknown(found)
        if evidence + prior + math.log(PRIOR["none"]) > value:
            noise, value = other, evidence + prior + math.log(PRIOR["none"])
    return noise


def beside(search: "Search", model: Model) -> Noise:
    """The noise beside a model: its own where the search has one of a worse model, much larger, from before."""
    if not search.noise.open:
        return search.noise
    own = search.settled(model.found)[0]
    return own if float((own.sd / search.noise.sd).median()) < OUTDATED else search.noise


def weigh_alone(search: "Search") -> tuple[float, Model | None, float]:
    """Weigh every model against the base, each of them with its own noise.

    Returns:
        Log evidence of something unknown, the model beside which that is (None for the base), and that of the base as
        it stands here, against the base with its own.
    """
    base = search.settled(search.base)[1]
    here = log_likelihood(search.base, search.noise, search.tangents) - base
    every = [*search.models, *search.nameless]
    own = {id(m): alone(m.found, search.noise, search.tangents)[1] - base for m in every}
    near = max((own[id(m)] + m.prior for m in every), default=0.0) - BEHIND
    leading = sorted(search.models, key=lambda m: -m.weight)[:SETTLED]
    leading += sorted(search.nameless, key=lambda m: -m.weight)[:1]
    for model in every:
        found = own[id(model)]
        if model in leading and found + model.prior > near:  # fitted again with its noise, as the base is
            found = search.settled(model.found)[1] - base
        model.in_use = search.gain(model.found.chi2) + here + model.price
        model.log_evidence = max(found + model.price, model.in_use)
    best = search.leader
    unknown = [search.with_unknown(search.base)[1]]
    if best is not None:
        unknown.append(search.with_unknown(best.found)[1] + best.prior)
    return max(unknown) - base, best if max(unknown) > unknown[0] else None, min(here, 0.0)


def likeliest_alone(search: "Search") -> Model | None:
    """The likeliest physical model, each with its own noise."""
    physical = [m for m in search.models if m.physical and not m.note]
    own = {id(m): alone(m.found, search.noise, search.tangents)[1] + m.prior for m in physical}
    return max(physical, key=lambda m: own[id(m)], default=None)


def odds_alone(search: "Search") -> float:
    """Log odds of the likeliest physical model against the base, each with its own noise; −∞ where the noise is known.

    The noise that a search begins with is that of the base, which may have taken what a term explains for slow noise.
    """
    best = likeliest_alone(search) if search.noise.open else None
    if best is None:
        return -math.inf
    base = search.settled(search.base)[1] + math.log(PRIOR["base"])
    return search.settled(best.found)[1] + best.prior - base


def fits_by_chance(search: "Search") -> float:
    """Probability that white noise alone lets one of the candidates improve the base's fit as much as one does.

    The F-test of nested least squares, times the number of candidates. Of few data the sd of the noise alone is known
    too badly for the simulated residuals to show even what is plain to see. A base that fits exactly, up to rounding,
    leaves nothing to improve.
    """
    if search.base.chi2 <= ROUNDING * search.problem.n:
        return 1.0
    least = 1.0
    for model in search.models:
        added = len(model.candidate.own)
        freedom = search.problem.n - len(model.found.free)
        left = model.found.chi2 / search.base.chi2
        if freedom > 0 and model.physical and 0.0 <= left < 1.0:
            least = min(least, _beta(left, 0.5 * freedom, 0.5 * added))
    return min(1.0, least * len(search.candidates))


def pairs_by_chance(search: "Search") -> float:
    """Probability that white noise alone lets two candidates together, to first order, do as much as two of them do.

    As `fits_by_chance`, times the number of pairs of tangents: two that each do little may do all together.
    """
    residual, screening = search.residual, search.screening
    there = screening.norm > 0
    columns, owner = screening.columns[:, there], screening.owner[there]
    freedom = residual.freedom - 2
    total = float(residual.e.square().sum())
    if search.max_terms < 2 or freedom <= 0 or total <= ROUNDING * search.problem.n:
        return 1.0
    along, shared = columns.T @ residual.e, columns.T @ columns
    apart = owner[:, None] < owner
    apart &= shared.abs() < SAME
    if not bool(apart.any()):
        return 1.0
    taken = along[:, None].square() + along.square() - 2 * shared * along[:, None] * along
    most = float((taken / (1 - shared.square()))[apart].max())
    return min(1.0, _beta(max(1.0 - most / total, 0.0), 0.5 * freedom, 1.0) * int(apart.sum()))


def _beta(x: float, a: float, b: float) -> float:
    """Regularised incomplete beta function for 0 ≤ x < 1, by the substitution t = x s^(1/a)."""
    s = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000
    inner = float((1.0 - x * s.pow(1.0 / a)).pow(b - 1.0).mean())
    return math.exp(a * math.log(max(x, 1e-300)) - math.log(a) + _log_beta(a, b)) * inner


def _log_beta(a: float, b: float) -> float:
    """−ln B(a, b)."""
    return math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)


def other_growth(search: "Search") -> Tensor | None:
    """How unknown noise grows by the residual of the best model, ``(n_total,)``; None where that is as it was taken to
    be, or nothing explains enough to tell. The misfit of the base may look like noise that grows."""
    best = search.leader
    if search.unit is not None or not search.noise.open or best is None or not explains(search):
        return None
    unit = growing(best.found, search.noise.unit)
    before = search.noise.unit
    same = all(
        bool((unit[here] == 1).all()) == bool((before[here] == 1).all())
        and float((unit[here] / before[here]).log().abs().mean()) <= OTHERWISE
        for here in (mine(search.problem, output) for output in range(len(search.problem.recording.outputs)))
    )
    return None if same else unit


def outliers(search: "Search", observed: Tensor) -> Tensor | None:
    """Data that stick out alone once the best model explains the rest, bool ``(n_total,)``; None where nothing explains
    enough to tell. All ``observed`` data are judged, those that are set aside too."""
    best = search.leader
    return None if search.exact or best is None or not explains(search) else _outliers_of(search, best, observed)[0]


def likeliest_outliers(search: "Search", observed: Tensor) -> Tensor | None:
    """The same of that one of the leading models which is likeliest with its own outliers, few more than the best has:
    what draws a wrong one to itself is what keeps the right one from leading."""
    lead = search.leader
    if search.exact or lead is None or not explains(search):
        return None
    best, value = _outliers_of(search, lead, observed)
    if best is None:
        return None
    most = int(best.sum()) + FURTHER
    others = [m for m in search.models if m.physical and m.numbers != lead.numbers]
    close = [m for m in others if m.weight > lead.weight - NOT_FAR]
    for model in sorted(close, key=lambda m: -m.weight)[:CONTENDERS]:
        left = model.found.residual / search.noise.sd[model.found.problem.index]
        if float(left.abs().max()) < STICKS_OUT:
            continue
        own, other = _outliers_of(search, model, observed)
        if own is not None and int(own.sum()) <= most and other > value + CLEAR:
            best, value = own, other
    return best


def _outliers_of(search: "Search", model: Model, observed: Tensor) -> tuple[Tensor | None, float]:
    """Data that stick out alone of a model, and the log of its prior times the density of all data with these as
    outliers; None where they are too many."""
    found, keep = model.found, observed
    for _ in range(TRIMS):  # what sticks out most draws the fit to itself, and off what sticks out less
        fitted = dataclasses.replace(model.found.problem, keep=keep)
        found = refit(found, search.noise.whitening(fitted), fitted)
        before, keep = keep, observed  # what was set aside may be the effect itself
        for _ in range(2):  # beside what sticks out most an end of a recording is not judged
            problem = dataclasses.replace(model.found.problem, keep=keep)
            left = problem.y - problem.evaluate(found.values[None], [], found.warm)[0][0]
            off = _sticking(search, problem, left)
            if bool((observed & ~search.problem.keep).any()):  # an end that has been weighed before stays aside
                off |= _sticking(search, problem, left, ends=True) & ~search.problem.keep
            keep = keep & ~off
        if torch.equal(keep, before):
            break
    sticking = observed & ~keep
    if float(sticking.sum()) > MOST_OUTLIERS * float(observed.sum()):
        return None, -math.inf
    problem = found.problem
    return sticking, model.prior + _of_outliers(problem) + density(found, search.noise.whitening(problem))


def isolated(search: "Search", fit: Fitted) -> Tensor | None:
    """Samples in time that a fit misses by far and alone, bool ``(n_total,)``; None for none, or too many.

    With the ends of recordings: whether such data are outliers or all that is seen of some physics is to be weighed.
    Residuals are scaled to one variance by their leverage: an unknown initial state follows the first sample. Among
    conditions, what a model lacks may well be seen in one datum first, the one at the edge.
    """
    if search.exact or not search.problem.in_time:
        return None
    slope = fit.jacobian[:, ~fit.at_bound]
    curve = (slope @ torch.linalg.pinv(fit.whitening(slope), rtol=1e-7)).square().sum(1)  # the variance of the fit
    free = (1 - curve / fit.whitening.sd.square()).clamp_min(LEAST_FREE).sqrt()
    found = _sticking(search, fit.problem, fit.residual / free, ends=True)
    return found if 0 < float(found.sum()) <= MOST_OUTLIERS * float(search.problem.n) else None


def explains(search: "Search") -> bool:
    """Whether one model explains enough to tell what it leaves from outliers."""
    return search.leader is not None and search.leader.log_evidence >= CLEAR


def outdone(search: "Search", every: "Search", detected: bool) -> tuple[float, int]:
    """How much likelier one search's best model is than another's, with the outliers of each.

    Args:
        search: With more data set aside; its best hypothesis is the base, where it has not ``detected`` anything.
        every: With fewer set aside, or none.
        detected: Whether ``search`` has more than noise.

    Returns:
        Log odds, and how many more data the model of ``every`` explains than it has parameters: one datum that shows
        one parameter alone is always explained by it. An outlier is drawn evenly from the range of its output's data.
    """
    best = every.physical_leader
    if best is None:
        return -math.inf, 0
    odds = _density(every, best.found) + best.prior - _likeliest(search, detected)
    return odds, every.problem.n - search.problem.n - len(best.candidate.own)


def _likeliest(search: "Search", detected: bool) -> float:
    """Log weight of the base, or of the best physical model where more than noise is ``detected``, if that is more."""
    best = search.physical_leader if detected else None
    value = _density(search, search.base) + math.log(PRIOR["base"])
    return value if best is None else max(value, _density(search, best.found) + best.prior)


def outliers_alone(fewer: "Search", search: "Search", detected: bool, *, short: float = 0.0) -> bool:
    """Whether outliers are a likelier reason for what a search has detected than its models or something unknown.

    Args:
        fewer: The search without the supposed outliers.
        search: That with them.
        detected: Whether ``fewer`` has more than noise.
        short: Log odds by which they may fall short of that.
    """
    known, best = _likeliest(fewer, detected), search.physical_leader
    unknown = [_density(search, search.base) + _unknown(search, search.base)]
    if best is not None:
        unknown.append(_density(search, best.found) + best.prior + _unknown(search, best.found))
    return max(max(unknown) + math.log(PRIOR["none"]) - known, outdone(fewer, search, detected)[0]) < short


def _unknown(search: "Search", found: Fitted) -> float:
    """Log odds of something unknown beside a fit."""
    return search.with_unknown(found)[1] - search.settled(found)[1]


def _density(search: "Search", found: Fitted) -> float:
    """Log density of all data, without constants: normal with the noise that suits a fit, and what is set aside.

    Not integrated over the base's parameters: which of them there are to integrate over, and how far away the data lie
    that they are told by, is not the same for other data.
    """
    noise = alone(found, search.noise, search.tangents)[0]
    return _of_outliers(search.problem) + density(found, noise.whitening(found.problem))


def known_density(search: "Search", found: Fitted) -> float:
    """The same of a model with the noise of the search."""
    return _of_outliers(search.problem) + density(found, search.noise.whitening(found.problem))


def _of_outliers(problem: Problem) -> float:
    """Log density of what is set aside, with that of normal data without its constant for all others."""
    recording, value = problem.recording, 0.0
    for output in range(len(recording.outputs)):
        here = mine(problem, output) & recording.observed_once
        y, aside = recording.y[here], int((here & ~problem.keep).sum())
        if aside:
            density = RARE / (1 - RARE) * math.sqrt(2 * math.pi) / max(float(y.max() - y.min()), 1e-300)
            value += aside * math.log(density)
    return value


def _sticking(search: "Search", problem: Problem, residual: Tensor, ends: bool = False) -> Tensor:
    """Data that stick out alone of what a model leaves, bool ``(n_total,)``; `lone` ones at ``ends`` too if wanted."""
    given = problem.recording.noise
    sd = given if isinstance(given, Tensor) else None
    if search.noise.open:
        residual = residual / search.noise.unit[problem.index]
    found = torch.zeros_like(problem.keep)
    found[problem.index] = spikes(problem, residual, sd) | lone(problem, residual, sd, ends)
    return found
