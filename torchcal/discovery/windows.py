"""Local terms: candidates that act in a range of one driver only, refitted where they promise more than everywhere."""

import dataclasses
import math

from torchcal.discovery.candidates import prepare
from torchcal.discovery.local import localised
from torchcal.discovery.screen import Window
from torchcal.discovery.search import PRIOR, Model, Search
from torchcal.errors import DomainError, SimulatorError

__all__ = ["refit_local", "refit_window"]

#: Refits at most.
MOST = 6
#: Data below which no window is sought; nor is any without noise, where a window bends to whatever is left.
LEAST = 30


def refit_local(search: Search) -> None:
    """Windows that promise more than the same term everywhere."""
    if search.exact or search.problem.n < LEAST:
        return
    gains = {model.numbers[0]: 2 * model.log_evidence + math.log(search.problem.n) for model in search.models}
    leading = 2 * max((model.log_evidence for model in search.models if model.physical), default=0.0)
    promising = []
    for w in search.local:
        plain = max(gains.get(w.candidate, 0.0), search.screening.score(w.candidate) ** 2)
        if w.candidate not in search.gone and w.z > 3.5 and w.z**2 > max(plain + 6.0, leading - 10.0):
            promising.append(w)
    promising.sort(key=lambda w: -w.z)
    prior = math.log(PRIOR["local"] / max(len(search.candidates), 1))
    for w in promising[:MOST]:
        search.tick(f"refit with local {search.candidates[w.candidate].name}")
        model = refit_window(search, w, prior)
        if model is not None:
            search.models.append(model)


def refit_window(search: Search, w: Window, prior: float) -> Model | None:
    """Base and one local term, begun at the window that the screening found."""
    plain = search.candidates[w.candidate]
    driver = search._drivers()[w.driver]
    span = (float(driver.min()), float(driver.max()))
    term = plain.terms[0]
    if term.frees:
        return None
    local = localised(term, w.driver, w.low, w.high, span, static=not search.problem.in_time)
    try:
        candidate = prepare(search.base.problem, search.base, [local], search.fixed, {})
    except (SimulatorError, DomainError):
        return None
    column = search.screening.best[w.candidate]
    values = dict(zip([plain.problem.parameters[i].name for i in plain.own],
                      plain.shapes[int(search.screening.shape[column])].tolist(), strict=True))  # fmt: skip
    amplitude = plain.problem.parameters[plain.amplitudes[int(search.screening.amplitude[column])]].name
    begin = candidate.begin.clone()
    values[amplitude] += 0.02 * w.amplitude
    for i in candidate.own:
        name = candidate.problem.parameters[i].name
        if name in values:
            begin[i] = values[name]
        else:
            begin[i] = w.low if name.endswith("from") else w.high
    # Windows were searched on a grid of about 12 edges: the best of so many costs its logarithm.
    model = search._refit(
        (w.candidate,), candidate, begin[None], prior - math.log(3.0 * len(search._drivers())), window=w
    )
    if model is None:
        return None
    low, high = w.low, w.high
    for i in candidate.own:
        name = candidate.problem.parameters[i].name
        if name.endswith("window from"):
            low = float(model.found.values[i])
        elif name.endswith("window to"):
            high = float(model.found.values[i])
    model.window = dataclasses.replace(w, low=low, high=high)
    return model
