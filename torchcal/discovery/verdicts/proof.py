"""Held-out data for or against a name."""

from torch import Tensor

from torchcal.discovery.hypotheses import verify
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.verdicts.decision import Decision
from torchcal.discovery.verdicts.doubts import distinct
from torchcal.display import NONE

__all__ = ["gain", "prove"]

#: Noise variances a datum by which held-out predictions may be worse whatever the standard error: 1 % of the RMSE of a
#: model that leaves noise alone.
NOTHING = 0.02
#: Data a free parameter below which a fit without held-out data names nothing.
LEAST_FITTED = 4


def gain(search: Search, model: Model, mask: Tensor | None, against: Model | None = None) -> float:
    """Share of the squared misfit of the base, or of another model, that a model removes on held-out data."""
    before = search.base if against is None else against.found
    if mask is None:  # what was fitted proves nothing where there are few data a parameter
        enough = distinct(search.problem) >= LEAST_FITTED * len(model.found.free)
        return 1.0 - model.found.chi2 / before.chi2 if enough else 0.0
    seen = mask & search.problem.keep
    if not bool(seen.any()):
        return 0.0
    old, new = (search.held_out(found, mask) for found in (before, model.found))
    if old is None or new is None:
        return 0.0
    y, sd = search.problem.recording.y[seen], search.noise.sd[seen]
    floor = 0.0 if search.exact else float(len(y))
    left = [max(float(((y - part.prediction[seen]) / sd).square().sum()) - floor, 0.0) for part in (old, new)]
    return 1.0 - left[1] / max(left[0], 1e-300)


def prove(search: Search, decision: Decision, mask: Tensor | None) -> None:
    """Withdraw a name that predicts held-out data worse than the base does."""
    if decision.best is None or mask is None:
        return
    before = search.held_out(search.base, mask)
    after = search.held_out(decision.best.found, mask)
    if before is None or after is None:
        return
    seen = mask & search.problem.keep
    if not bool(seen.any()):
        return
    better, error = verify.compare(search.problem.recording, before, after, search.noise, seen)
    if better < -max(error, NOTHING):
        decision.withdrawn = (
            f"{' and '.join(decision.best.names)} explained the fitted data but predicted held-out data worse than the "
            f"base (by {-better:.2g} ± {error:.1g} noise variances a datum), so the name is withdrawn."
        )
        decision.tied, decision.tied_models = [list(decision.best.names), list(NONE)], [decision.best]
        decision.verdict, decision.best = "ambiguous", None
