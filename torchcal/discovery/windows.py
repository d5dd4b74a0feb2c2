"""Local terms: candidates that act in a range of one driver only, refitted where they promise more than everywhere."""

import dataclasses
import math

import torch

from torchcal.discovery.candidates import prepare
from torchcal.discovery.channels import responses
from torchcal.discovery.local import EDGE, SHARP, localised
from torchcal.discovery.screen import Window, windows_of
from torchcal.discovery.search import PRIOR, Model, Search
from torchcal.discovery.structure import Residual
from torchcal.discovery.verdict import PLAINLY_WHITE
from torchcal.errors import DomainError, SimulatorError
from torchcal.simulators import Trajectories

__all__ = ["refit_local", "refit_window"]

#: Refits at most; around one refitted term; and how many of those.
MOST, MOST_AROUND, LEADING = 6, 2, 2
#: Relative difference of χ² up to which two windows of one term and driver are one.
SAME = 1e-4
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
        _keep(search, refit_window(search, w, prior))
    for single in sorted((m for m in search.models if m.window is None), key=lambda m: -m.log_evidence)[:LEADING]:
        if search.examine(single).p_value >= PLAINLY_WHITE:
            continue
        for w in _around(search, single)[:MOST_AROUND]:
            _keep(search, refit_window(search, w, prior, single))
    _sharpen(search, prior)


def _sharpen(search: Search, prior: float) -> None:
    """The best local models again with edges that are nearly steps, where smooth ones leave something behind."""
    ranked = sorted((m for m in search.models if m.physical), key=lambda m: -m.weight)[:LEADING]
    for model in ranked:
        if model.window is None or search.examine(model).p_value >= PLAINLY_WHITE:
            continue
        w = dataclasses.replace(model.window, amplitude=0.0)
        sharp = refit_window(search, w, prior, model, SHARP)
        if sharp is not None and sharp.found.chi2 < model.found.chi2:
            search.models[search.models.index(model)] = sharp


def _keep(search: Search, model: Model | None) -> None:
    """Add a model, unless the same one was found before from another start."""
    if model is None or model.window is None:
        return
    for other in search.models:
        if other.window is not None and other.numbers == model.numbers and other.window.driver == model.window.driver:
            if abs(other.found.chi2 - model.found.chi2) < SAME * max(1.0, model.found.chi2):
                return
    search.models.append(model)


def _around(search: Search, model: Model) -> list[Window]:
    """Where a refitted term acts more than elsewhere, or where it does not act at all: the best window a driver.

    At the base a strong effect is far from linear; here only its range is still wrong.
    """
    found, term = model.found, model.candidate.terms[0]
    if term.states or term.frees or term.outputs:
        return []
    residual = model.residual or Residual(found, search.noise, seed=search.seed, draws=10)
    number = model.numbers[0]
    column = search.screening.best[number]
    if column < 0:
        return []
    place = model.candidate.amplitudes[int(search.screening.amplitude[column])]
    bound = found.problem.simulator
    if isinstance(bound, Trajectories):
        with torch.no_grad():
            forcing = bound._step_derivatives(found.values[None], found.warm, [place])[2][0]
        response, drivers, _ = responses(found.problem, found, forcing)
        response = response[:, :, 0]
    elif place in found.free:
        response = torch.diag(found.jacobian[:, found.free.index(place)])
        drivers = found.problem.drivers_at_data(found.values[None], None)
    else:
        return []
    value = float(found.values[place] - model.candidate.neutral[model.candidate.own.index(place)])
    kept: dict[str, Window] = {}
    for w in sorted(windows_of(number, residual, response, drivers, 0)[0], key=lambda w: -w.z):
        if w.driver not in search._drivers() or w.driver in kept or w.z < 3.5:
            continue
        if w.amplitude * value < 0:  # too much of it there: it acts on the other side
            if math.isfinite(w.low) and math.isfinite(w.high):
                continue
            low = w.high if math.isfinite(w.high) else -math.inf
            w = dataclasses.replace(w, low=low, high=w.low if math.isfinite(w.low) else math.inf, amplitude=0.0)
        kept[w.driver] = w
    return list(kept.values())


def refit_window(
    search: Search, w: Window, prior: float, near: Model | None = None, edge: float = EDGE
) -> Model | None:
    """Base and one local term, begun at the window that the screening found, from the base or near a model of it."""
    plain = search.candidates[w.candidate]
    driver = search._drivers()[w.driver]
    span = (float(driver.min()), float(driver.max()))
    term = plain.terms[0]
    if term.frees or not span[1] > span[0]:
        return None
    local = localised(term, w.driver, w.low, w.high, span, static=not search.problem.in_time, edge=edge)
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
    if near is not None:
        values = dict(zip([q.name for q in near.found.problem.parameters], near.found.values.tolist(), strict=True))
        values[amplitude] += w.amplitude
    ends = {f"{term.name}.window from": w.low, f"{term.name}.window to": w.high}
    for i, q in enumerate(candidate.problem.parameters):
        begin[i] = ends.get(q.name, values.get(q.name, float(begin[i])))
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
