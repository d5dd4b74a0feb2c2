"""Why several terms that explain a recording together are no names: they bend to what is in no list more than one does.
"""

from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.verdicts.explain import one_law, other_minima

__all__ = ["only_together"]

#: Share of the squared misfit that two terms leave at most, where few data show them together alone.
NEXT_TO_NOTHING = 1e-3


def only_together(search: Search, model: Model) -> str:
    """Why several terms may do what one that is in no list does, in a sentence; empty if nothing says so."""
    if search.paired and not _leaves_nothing(search, model):
        return (
            "So few data with noise of unknown size show it by two terms together alone, as two others may do: more "
            "data, replicates or a known noise sd would tell."
        )
    if search.exact or len(model.names) < 2:
        return ""
    screening = search.screening
    for i in model.numbers:
        candidate = search.candidates[i]
        if model.window is None and screening.best[i] < 0 and not candidate.blind:
            return (
                f"Alone, {candidate.name} does what the base's own parameters do; beside the rest that may only make "
                "up for a shape that no term has."
            )
    if alike := one_law(model):
        return f"Of its terms {alike[0]}."
    if other_minima(search, model):
        return "Other sizes of its terms fit about as well: only what they do together is told."
    return ""


def _leaves_nothing(search: Search, model: Model) -> bool:
    left, whole = (float(found.residual.square().sum()) for found in (model.found, search.base))
    return left <= NEXT_TO_NOTHING * whole
