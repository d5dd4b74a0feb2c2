"""Screening and refitting again, where the best model tells other outliers, or other noise, than the base did."""

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import spread_values
from torchcal.discovery.fits.fitting import refit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.base import MOST
from torchcal.discovery.hypotheses.beside import screened_beside
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.own_noise import (
    EXPLAINED,
    explains,
    fits_by_chance,
    isolated,
    known_density,
    likeliest_outliers,
    odds_alone,
    other_growth,
    outdone,
    outliers,
    outliers_alone,
    pairs_by_chance,
)
from torchcal.discovery.hypotheses.refitting import take_over
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.hypotheses.singles import refit_singles
from torchcal.discovery.misfit.likeliest import density
from torchcal.discovery.misfit.noise import Noise
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.several import refit_several
from torchcal.discovery.verdicts.verdict import WHITE, base_alone
from torchcal.discovery.windows import refit_local
from torchcal.errors import ConvergenceError, SimulatorError

__all__ = ["settle", "with_all", "with_explained", "without_others"]

#: How often everything is fitted again because other data turned out to be outliers.
ROUNDS = 3
#: Share of the level at which a fit to few data counts as more than noise by itself.
FEW_DATA = 0.1
#: Times the level up to which a misfit that noise alone gives counts as more than that where the base, beside the
#: refitted candidates, is as improbable as the level: a statistic for all kinds of misfit sees each kind less well.
OFTEN = 5.0
#: Degrees of freedom of replicates below which neither counts: such odds take the noise for known.
WELL_TOLD = 20.0
#: Models at whose parameters the base is looked at alone, and by how much its χ² must be lower there.
LOOKED_AT, DEEPER = 4, 6.0
#: Log odds by which outliers may fall short of models, with those of all data, for a search without them to begin.
SHORT = 20.0
#: Probability of the base beside the refitted candidates below which there is more than noise, whatever is left looks
#: like: noise that grows with the value can take up what a term explains far better.
HOPELESS = 1e-6


def settle(search: Search, observed: Problem, confidence: float) -> tuple[Search, bool]:
    """Screen and refit, and without data that the base misses alone, where outliers are the likelier reason.

    Returns:
        The search, and whether there is more than noise.
    """
    search, detected = _without_isolated(search, observed, _refit(search, confidence), confidence)
    search, detected = _again(search, observed, detected, confidence)
    return _without_isolated(search, observed, detected, confidence, of_best=True)


def _without_isolated(
    search: Search, observed: Problem, detected: bool, confidence: float, *, of_best: bool = False
) -> tuple[Search, bool]:
    """The search without data that its base or best model misses alone, where outliers are the likelier reason."""
    if not detected or search.stop.is_set() or (of_best and not explains(search)):
        return search, detected
    best = search.leader if of_best else None
    apart = isolated(search, search.base if best is None else best.found)
    kept = search.problem.keep if apart is None else search.problem.keep & ~apart
    if apart is None or float(kept.sum()) < (1 - MOST) * observed.n:
        return search, detected
    fewer = _of(search, observed.keeping(kept))
    if fewer is None or not _may_be_alone(fewer, search, confidence):
        return search, detected
    still = _refit(fewer, confidence)
    if not search.stop.is_set() and outliers_alone(fewer, search, still):
        return fewer, still
    return search, detected


def _may_be_alone(fewer: Search, search: Search, confidence: float) -> bool:
    """Whether outliers are nearly as likely a reason, as far as the models of one search, fitted to the other, tell."""
    known = dataclasses.replace(fewer)
    known.base, known.noise, known.tangents, known.models = fewer.base, fewer.noise, fewer.tangents, []
    known.screen_all()
    take_over(known, search.models)
    return search.stop.is_set() or outliers_alone(known, search, known.p_detect < 1.0 - confidence, short=SHORT)


def _again(search: Search, observed: Problem, detected: bool, confidence: float) -> tuple[Search, bool]:
    """Refit once more where others of the observed data turn out to be outliers of the best model, or noise to grow."""
    seen = [search.problem.keep]
    for number in range(ROUNDS):
        if search.stop.is_set():
            break
        # What a model misses that leaves more than noise may be that: such ones tell once, or each tells others.
        best = search.leader
        clear = number == 0 or best is None or search.examine(best).p_value >= WHITE
        sticking = likeliest_outliers(search, observed.keep) if detected and clear else None
        unit = other_growth(search) if detected else None
        if sticking is not None and any(torch.equal(keep, observed.keep & ~sticking) for keep in seen):
            sticking = None
        if sticking is None and unit is None:
            break
        # Others than at the base, whose misfit hides them and looks like some; and noise that grows, or does not.
        kept = search.problem if sticking is None else observed.keeping(~sticking)
        seen.append(kept.keep)
        other = _of(search, kept, unit=search.unit if unit is None else unit)
        if other is None:
            break
        still = _refit(other, confidence)
        if not search.stop.is_set():
            search, detected = other, still
    return search, detected


def with_all(
    search: Search, observed: Problem, detected: bool, confidence: float
) -> tuple[Search | None, tuple[str, ...]]:
    """The search of all observed data, where its best model is clearly likelier than outliers; or something unknown is,
    where nothing was ``detected`` without them: of neighbouring conditions several may well be off together.

    Where they are too few to prove it, the names of what may explain them are returned instead.
    """
    every = _of(search, observed, unit=None)
    if every is None:
        return None, ()
    every.screen_all()
    refit_singles(every)
    if search.stop.is_set():
        return None, ()
    odds, spare = outdone(search, every, detected)
    if odds <= EXPLAINED or spare <= 0:
        if not detected and not observed.in_time and not outliers_alone(search, every, detected, short=EXPLAINED):
            if _refit(every, confidence) and not search.stop.is_set():
                return every, ()
        sticking = outliers(every, observed.keep)
        if sticking is None or not 0 < int(sticking.sum()) < observed.n - search.problem.n:
            best = every.physical_leader
            return None, best.names if best is not None and odds > 0 else ()
    every, _ = _again(every, observed, _refit(every, confidence), confidence)
    if search.stop.is_set():
        return None, ()
    odds, spare = outdone(search, every, detected)
    return (every if odds > EXPLAINED and spare > 0 else None), ()


def with_explained(search: Search, observed: Problem, confidence: float) -> Search | None:
    """The search of what was set aside too, where a term beside the best one explains it better than outliers do.

    What sticks out of the best single term may be what a second one is seen by. None where nothing does.
    """
    best = search.physical_leader
    if search.exact or search.stop.is_set() or best is None or search.problem.n == observed.n:
        return None
    if not _may_explain(search, best, observed):
        return None
    every = _of(search, observed)
    if every is None:
        return None
    if not _refit(every, confidence) or search.stop.is_set():
        return None
    refit_several(every)
    every = without_others(every, observed)
    other = every.physical_leader
    if search.stop.is_set() or other is None or len(other.numbers) < 2:  # single terms were judged before
        return None
    odds, spare = outdone(search, every, True)
    same = set(other.names) == set(best.names)  # they are seen by the other data too
    return every if odds > EXPLAINED and (same or spare > 0) else None


def without_others(search: Search, observed: Problem) -> Search:
    """The search with the outliers of several terms, or noise that grows as it does beside these, where that is not as
    beside the best single one.

    Its models are fitted again, and no others.
    """
    best = search.physical_leader
    if best is None or len(best.numbers) < 2 or search.stop.is_set():
        return search
    sticking, unit = outliers(search, observed.keep), other_growth(search)
    if sticking is None or torch.equal(observed.keep & ~sticking, search.problem.keep):
        sticking = None
    if sticking is None and unit is None:
        return search
    kept = search.problem if sticking is None else observed.keeping(~sticking)
    other = _of(search, kept, unit=search.unit if unit is None else unit)
    if other is None:
        return search
    other.screen_all()
    take_over(other, search.models)
    return other if not search.stop.is_set() and other.physical_leader is not None else search


def _of(search: Search, problem: Problem, **changes: Any) -> Search | None:
    """The same search of other data, whose outliers are known, with their base calibrated and nothing else fitted; None
    where it cannot be: what is set aside may have been all that told of an initial state."""
    other = dataclasses.replace(search, problem=problem, clean=True, **changes)
    try:
        other.calibrate_base()
    except (ConvergenceError, SimulatorError):
        return None
    return other


def _may_explain(search: Search, best: Model, observed: Problem) -> bool:
    """Whether a model explains what is set aside, or with one more term would to first order, as well as outliers."""
    problem = dataclasses.replace(best.found.problem, keep=observed.keep)
    found = refit(best.found, search.noise.whitening(problem), problem)
    short = known_density(search, best.found) - density(found, found.whitening)
    if short < 0:
        return True
    if len(best.numbers) >= search.max_terms:
        return False
    every = screened_beside(search, Residual(found, search.noise, draws=10), best.numbers)
    return max((0.5 * seen.score**2 for seen in every.values()), default=0.0) > short


def _well_told(noise: Noise) -> bool:
    """Whether the size of noise is known well enough for odds that take it for known."""
    return noise.source != "replicates" or float(noise.freedom.min()) >= WELL_TOLD


def _refit(search: Search, confidence: float) -> bool:
    """Screen and refit single terms, and local ones where there is more than noise, which is returned.

    Where the base alone fits better at what has been found of its parameters, its calibration had ended in a higher
    minimum, which any term may lead out of: then all of it once more from there.
    """
    detected = _refit_once(search, confidence)
    begin = _lower(search) if detected and not search.exact and not search.stop.is_set() else None
    if begin is not None:
        search.restart(begin)
        detected = _refit_once(search, confidence)
    return detected


def _lower(search: Search) -> Tensor | None:
    """Parameters ``(1, P)`` at which the base fits better than where it was calibrated: in another of its valleys, or
    those of a model without its term; None where there are none."""
    base, rows = search.base, [*search.elsewhere]
    for model in sorted(search.models, key=lambda model: -model.weight)[:LOOKED_AT]:
        row, names = base.values.clone(), [q.name for q in model.found.problem.parameters]
        row[base.free] = spread_values(base.problem, names, model.found.values)[base.free]  # not what a term frees
        rows.append(row)
    if not rows:
        return None
    every = torch.stack(rows)
    try:
        chi2 = base.chi2_at(every)
    except SimulatorError:  # a term may have led where the base alone does not work
        return None
    best = int(chi2.argmin())
    return every[best : best + 1] if float(chi2[best]) < base.chi2 - DEEPER else None


def _refit_once(search: Search, confidence: float) -> bool:
    """The same with the base as it was calibrated."""
    search.models = []
    search.screen_all()
    detected = at_once = search.exact or search.p_detect < 1.0 - confidence
    if search.terms:
        refit_singles(search, detected=detected)
        level = 1.0 - confidence
        if not detected and search.few and (p := fits_by_chance(search)) < FEW_DATA * level:
            detected, search.p_detect = True, min(p, search.p_detect)
        elif not detected:
            alone = base_alone(search)
            detected = alone < HOPELESS or (search.p_detect < OFTEN * level and alone < level)
            detected = detected and _well_told(search.noise)
            detected = detected or (not search.few and odds_alone(search) > -math.log(level))
        if not detected and search.few and (p := pairs_by_chance(search)) < FEW_DATA * level:
            detected, search.paired, search.p_detect = True, True, min(p, search.p_detect)
        if detected and not at_once and not search.stop.is_set():
            before, search.models = search.models, []
            refit_singles(search)
            again = {model.numbers for model in search.models}
            search.models += [model for model in before if search.stop.is_set() and model.numbers not in again]
            search.left -= {i for model in before for i in model.numbers}
        if detected and not search.stop.is_set():
            refit_local(search)
    return detected
