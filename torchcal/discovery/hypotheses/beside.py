"""Candidates screened beside a model: what would be added to it, by the tangents at its fit."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate, prepare, with_terms
from torchcal.discovery.fits.ranges import drivers_scale, sized_again
from torchcal.discovery.hypotheses.aliases import copies
from torchcal.discovery.hypotheses.beginnings import STRONG, beginnings
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.screen import Screening, screen
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.residual import Residual
from torchcal.errors import DomainError, SimulatorError

__all__ = ["Beside", "next_terms", "screened_beside"]

#: How many more candidates are tried beside a model whose tangents vanish.
UNSEEN = 3
#: Difference of two scores up to which merged candidates are the same beside another term.
SAME_SCORE = 0.1


@dataclass(frozen=True, eq=False)
class Beside:
    """A candidate as prepared and screened at the fit of a model that lacks it.

    Attributes:
        residual: The fit's.
        candidate: With the model's terms in its base.
        screening: Of it alone.
    """

    residual: Residual
    candidate: Candidate
    screening: Screening

    @property
    def score(self) -> float:
        """Of its best shape."""
        return self.screening.score(0)

    def begin(self, both: Candidate, most: int | None = None) -> Tensor:
        """Starting values ``(B, P)`` of the model and it together, the ``most`` promising ones: at the fit, with linear
        estimates of what is new."""
        names = [q.name for q in self.candidate.problem.parameters]
        rows = beginnings(self.residual, self.screening, 0, self.candidate, None)[:most]
        return rows[:, [names.index(q.name) for q in both.problem.parameters]]


def next_terms(search: Search, model: Model, most: int) -> dict[int, Beside | None]:
    """The best other candidates by their score at a model's fit, and some that only large effects show; each as seen
    there where the base is bent, and what was seen at it tells less."""
    residual = model.residual
    if residual is None or residual.found is not model.found:
        residual = Residual(model.found, search.noise, seed=search.seed, draws=10)
    every = screened_beside(search, residual, model.numbers)
    scored = sorted(every, key=lambda j: (-every[j].score, j))
    # What no tangent shows may be seen beside another that none shows, or that has taken its part.
    unseen = [j for j in search.blind if j not in {*scored, *model.numbers, *search.gone}][:UNSEEN]
    bent = search.base.chi2 > STRONG * search.problem.n
    return {j: every[j] if bent else None for j in scored[:most]} | dict.fromkeys(unseen)


def screened_beside(search: Search, residual: Residual, numbers: Sequence[int]) -> dict[int, Beside]:
    """The candidates that are not in a model and say something new at a fit of it, by their numbers. Their ranges grow
    to where their drivers are there.

    Merged ones are among them where the base is bent, whose tangents tell less, and their score is another one there.
    """
    found = residual.found
    scale = drivers_scale(found.problem, found)
    gone = copies(search) if search.base.chi2 > STRONG * search.problem.n else search.gone
    every: dict[int, Beside] = {}
    for j, other in enumerate(search.candidates):
        if j in numbers or j in gone:
            continue
        search.tick(f"screen {other.name} after {', '.join(search.candidates[i].name for i in numbers)}")
        try:
            term = sized_again(other.terms[0], search.terms[j], scale, search.problem.recording)
            if term is not other.terms[0]:  # and so it may wherever it is refitted from now on, alone or with others
                search.candidates[j] = with_terms(search.base.problem, other, [term])
            prepared = prepare(found.problem, found, [term], search.fixed, scale)
        except (SimulatorError, DomainError):
            continue
        seen = screen(residual, [prepared])
        if seen.best[0] >= 0:
            every[j] = Beside(residual, prepared, seen)
    known = {j: one.score for j, one in every.items()}
    same = {j for j in known if j in search.gone and abs(known[j] - known.get(search.twins[j], 0.0)) <= SAME_SCORE}
    return {j: one for j, one in every.items() if j not in same}
