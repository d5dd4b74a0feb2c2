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

__all__ = ["next_terms", "scores_beside", "screened_beside"]

#: How many more candidates are tried beside a model whose tangents vanish.
UNSEEN = 3
#: Difference of two scores up to which merged candidates are the same beside another term.
SAME_SCORE = 0.1


def next_terms(search: Search, model: Model, most: int) -> list[int]:
    """The best other candidates by their score at a model's fit, and some that only large effects show."""
    residual = model.residual
    if residual is None or residual.found is not model.found:
        residual = Residual(model.found, search.noise, seed=search.seed, draws=10)
    scores = scores_beside(search, model.found, residual, model.numbers)
    scored = [j for _, j in sorted(scores, key=lambda one: (-one[0], one[1]))]
    # What no tangent shows may be seen beside another that none shows, or that has taken its part.
    unseen = [j for j in search.blind if j not in {*scored, *model.numbers, *search.gone}][:UNSEEN]
    return [*scored[:most], *unseen]


def scores_beside(
    search: Search, found: Fitted, residual: Residual, numbers: Sequence[int]
) -> list[tuple[float, int]]:
    """Scores and numbers of the candidates that are not in a model, at a fit of it."""
    return [(seen.score(0), j) for j, (_, seen) in screened_beside(search, found, residual, numbers).items()]


def screened_beside(
    search: Search, found: Fitted, residual: Residual, numbers: Sequence[int]
) -> dict[int, tuple[Candidate, Screening]]:
    """The candidates that are not in a model and say something new at a fit of it, by their numbers, as prepared and
    screened there.

    Merged ones are among them where the base is bent, whose tangents tell less, and their score is another one there.
    """
    scale = drivers_scale(found.problem, found)
    gone = copies(search) if search.base.chi2 > STRONG * search.problem.n else search.gone
    every: dict[int, tuple[Candidate, Screening]] = {}
    for j, other in enumerate(search.candidates):
        if j in numbers or j in gone:
            continue
        search.tick(f"screen {other.name} after {', '.join(search.candidates[i].name for i in numbers)}")
        try:
            prepared = prepare(found.problem, found, other.terms, search.fixed, scale)
        except (SimulatorError, DomainError):
            continue
        seen = screen(residual, [prepared])
        if seen.best[0] >= 0:
            every[j] = prepared, seen
    known = {j: seen.score(0) for j, (_, seen) in every.items()}
    same = {j for j in known if j in search.gone and abs(known[j] - known.get(search.twins[j], 0.0)) <= SAME_SCORE}
    return {j: one for j, one in every.items() if j not in same}
