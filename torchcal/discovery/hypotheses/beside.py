"""Candidates screened beside a model: what would be added to it, by the tangents at its fit."""

from collections.abc import Sequence

from torchcal.discovery.fits.candidates import Candidate, prepare
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.ranges import drivers_scale
from torchcal.discovery.hypotheses.aliases import copies
from torchcal.discovery.hypotheses.beginnings import STRONG
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.screen import Screening, screen
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.residual import Residual
from torchcal.errors import DomainError, SimulatorError

__all__ = ["next_terms", "scores_beside", "screened_beside", "told_apart"]

#: How many more candidates are tried beside a model whose tangents vanish.
UNSEEN = 3
#: Difference of two scores up to which merged candidates are the same beside another term.
SAME_SCORE = 0.1


def next_terms(search: Search, model: Model, most: int) -> list[int]:
    """The best other candidates by their score at a model's fit, and some that only large effects show."""
    residual = model.residual or Residual(model.found, search.noise, seed=search.seed, draws=10)
    scores = scores_beside(search, model.found, residual, model.numbers)
    scored = [j for _, j in sorted(scores, key=lambda one: (-one[0], one[1]))]
    # What no tangent shows may be seen beside another that none shows, or that has taken its part.
    unseen = [j for j in search.blind if j not in {*scored, *model.numbers, *search.gone}][:UNSEEN]
    return [*scored[:most], *unseen]


def scores_beside(
    search: Search, found: Fitted, residual: Residual, numbers: Sequence[int]
) -> list[tuple[float, int]]:
    """Scores and numbers of the candidates that are not in a model, at a fit of it."""
    every = screened_beside(search, found, residual, numbers)
    known = {j: seen.score(0) for j, (_, seen) in every.items() if seen.best[0] >= 0}
    alike = {j for j in known if j in search.gone and abs(known[j] - known.get(search.twins[j], 0.0)) <= SAME_SCORE}
    return [(z, j) for j, z in known.items() if j not in alike]


def screened_beside(
    search: Search, found: Fitted, residual: Residual, numbers: Sequence[int]
) -> dict[int, tuple[Candidate, Screening]]:
    """The candidates that are not in a model, by their numbers, as prepared and screened at a fit of it."""
    scale = drivers_scale(found.problem, found)
    every, gone = {}, search.gone - told_apart(search)
    for j, other in enumerate(search.candidates):
        if j in numbers or j in gone:
            continue
        search.tick(f"screen {other.name} after {', '.join(search.candidates[i].name for i in numbers)}")
        try:
            prepared = prepare(found.problem, found, other.terms, search.fixed, scale)
        except (SimulatorError, DomainError):
            continue
        every[j] = prepared, screen(residual, [prepared])
    return every


def told_apart(search: Search) -> set[int]:
    """Merged candidates that may be told apart beside another term: where the base is bent, its tangents tell less."""
    return search.gone - copies(search) if search.base.chi2 > STRONG * search.problem.n else set()
