"""Hypotheses refitted in batches, here or on workers: each to its end, and in time steps that do for what it brings."""

import dataclasses
import math
from collections.abc import Sequence

from torchcal.discovery.fits.candidates import widened
from torchcal.discovery.fits.fitting import Fitted, refit, weighed
from torchcal.discovery.fits.refits import Refit, refit_all
from torchcal.discovery.fits.sharpen import SOLVER_SHARE, accurate, halved, sharpen
from torchcal.discovery.hypotheses.aliases import merge
from torchcal.discovery.hypotheses.judge import held_back
from torchcal.discovery.hypotheses.model import Hypothetical, Model
from torchcal.discovery.hypotheses.search import HOPELESS, NEAR, Search
from torchcal.errors import DomainError, SimulatorError

__all__ = ["BETTER", "improve", "refit_together", "take_over"]

#: Log evidence that a refit must gain for its time steps to be looked at, and how often they are chosen anew at most.
WORTH, ROUNDS = 3.0, 3
#: χ² above the base's from which on a refit, which holds the base, has gone astray.
ASTRAY = 1.0
#: How many times the error of its steps a fit is away from what is wanted of it where shorter ones do not lead there.
SURELY = 3.0
#: Log weight that a term's refit from another start must gain to take the place of the first.
BETTER = 1.0


def refit_together(search: Search, wanted: Sequence[Hypothetical]) -> list[Model | None]:
    """Refit several hypotheses, on the executor where there is one; None where no start gives a fit.

    Each holds the base: what has ended in a worse fit begins there again.
    """
    found = _fits(search, wanted)
    astray = [k for k, one in enumerate(found) if one is not None and one.chi2 > search.base.chi2 + ASTRAY]
    again = [dataclasses.replace(wanted[k], begin=wanted[k].candidate.begin[None]) for k in astray]
    for k, fitted in zip(astray, _fits(search, again), strict=True):
        old = found[k]
        if fitted is not None and old is not None and fitted.chi2 < old.chi2:
            found[k] = fitted
    every = [*(model.found for model in search.models), *(fitted for fitted in found if fitted is not None)]
    best = max((search.gain(fitted.chi2) for fitted in every), default=0.0)
    models = [
        None if fitted is None else search.model(one, _sharp_enough(search, one, fitted, best))
        for one, fitted in zip(wanted, found, strict=True)
    ]
    return _with_room(search, models, best)


def improve(search: Search, wanted: Sequence[Hypothetical]) -> None:
    """Refit single terms from other starts, and keep what is better than what was found before."""
    for one, model in zip(wanted, refit_together(search, wanted), strict=True):
        old = search.plain.get(one.numbers[0])
        if model is not None and (old is None or model.weight > old.weight + BETTER):
            search.models = [m for m in search.models if m is not old] + [model]
            search.failed -= {*one.numbers}


def take_over(search: Search, models: Sequence[Model]) -> None:
    """Models of another search of the same candidates, fitted to the data of this one from where they stood."""
    best = max((model.log_evidence for model in models), default=0.0)
    for old in models:
        problem = dataclasses.replace(old.found.problem, keep=search.problem.keep)
        whitening = search.noise.whitening(problem)
        found = refit(old.found, whitening, problem) if old.log_evidence > HOPELESS * best else None
        if found is None:
            y, jacobian, _ = problem.evaluate(old.found.values[None], old.found.free, old.found.warm)
            found = dataclasses.replace(old.found, problem=problem, y=y[0], jacobian=jacobian[0])
            found = weighed(found, whitening)
        model = dataclasses.replace(old, found=found, structure=None, residual=None)
        search.models.append(search.judge(model))
    search.reweigh()
    merge(search)


def _with_room(search: Search, models: list[Model | None], best: float) -> list[Model | None]:
    """The models, those anew that only the range in which a shape was sought holds back; where more room is enough,
    that is the model. ``best`` is the log evidence of the best fit, without its price."""
    models, jobs = list(models), {}
    for k, model in enumerate(models):
        if model is None or model.physical or search.gain(model.found.chi2) < WORTH:
            continue
        stays, given = held_back(model, search.base), [search.terms[i] for i in model.numbers]
        roomy = widened(search.base.problem, model.candidate, stays, given) if stays else None
        if roomy is not None:
            jobs[k] = Hypothetical(model.numbers, roomy, model.found.values[None], model.log_prior, model.window)
    for (k, one), fitted in zip(jobs.items(), _fits(search, list(jobs.values())), strict=True):
        if fitted is not None:
            free = search.model(one, _sharp_enough(search, one, fitted, best))
            models[k] = free if free.physical else models[k]
    return models


def _fits(search: Search, wanted: Sequence[Hypothetical]) -> list[Fitted | None]:
    """The fits of hypotheses; None where no start gives one, and where the search has been stopped."""
    found: list[Fitted | None] = [None] * len(wanted)
    if search.stop.is_set() or not wanted:
        return found
    aim, jobs = search.aim(search.models), []
    for one in wanted:
        candidate, begin = one.candidate, one.begin
        warm = candidate.problem.guess(search.base.warm, begin)
        whitening = search.noise.whitening(candidate.problem)
        jobs.append(Refit(candidate.problem, whitening, begin, candidate.free, candidate.shape_places, warm, aim))
    names = [" + ".join(term.name for term in one.candidate.terms) for one in wanted]

    def take(index: int, fitted: Fitted | None) -> None:
        found[index] = fitted
        search.tick(f"refit with {names[index]}")

    with search.stop.refitting():
        refit_all(jobs, take, search.executor)
    if search.stop.is_set():
        return found
    # A long way is gone to its end only where that may matter beside what the others have come to.
    ended = [search.model(one, fitted) for one, fitted in zip(wanted, found, strict=True) if fitted is not None]
    aim = search.aim([*search.models, *ended])
    slow = {k: fitted for k, fitted in enumerate(found) if fitted is not None and fitted.leads_to(aim)}
    longer = [dataclasses.replace(jobs[k], begun=fitted, aim=aim) for k, fitted in slow.items()]
    if longer:
        with search.stop.refitting():
            refit_all(longer, lambda index, fitted: take([*slow][index], fitted), search.executor)
    return found


def _sharp_enough(search: Search, one: Hypothetical, fitted: Fitted, best: float) -> Fitted:
    """A fit in short steps, where it may matter beside the best one, of a log evidence without its price."""
    least = max(WORTH, HOPELESS * best - NEAR if len(one.numbers) == 1 else best - NEAR)
    if one.window is not None or search.gain(fitted.chi2) < least:  # an edge within a step would only move
        return fitted
    return _in_short_steps(search, fitted, search.base.chi2 - 2 * (best - NEAR))


def _in_short_steps(search: Search, found: Fitted, wanted: float) -> Fitted:
    """A fit with time steps that are short enough for it: what a term brings may be faster than the base.

    One whose steps err by much less than it is away from a χ² that is ``wanted`` stays as it is.
    """
    sd = search.noise.sd[found.problem.index]
    if search.exact or accurate(found, sd):
        return found
    away = math.sqrt(found.chi2) - math.sqrt(max(wanted, 0.0))
    try:
        finer = halved(found)
        if away > 0 and away > SURELY * float(found.whitening.vector(finer - found.y).norm()):
            return found
        return sharpen(found, lambda now: SOLVER_SHARE * sd, rounds=ROUNDS, patient=False, half=finer)[0]
    except (SimulatorError, DomainError):  # with steps so short, or with too many of them
        return found
