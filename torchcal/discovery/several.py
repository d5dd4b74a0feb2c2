"""Several terms together: effects hide each other, so pairs are searched as well as second and third terms."""

import math

import torch

from torchcal.discovery.candidates import drivers_scale, prepare
from torchcal.discovery.screen import screen
from torchcal.discovery.search import PRIOR, Model, Search
from torchcal.discovery.structure import Residual
from torchcal.errors import DomainError, SimulatorError

__all__ = ["refit_several"]

#: Pairs that are refitted at most.
MOST = 12


def refit_several(search: Search) -> None:
    """Pairs from the linear search at the base, and second terms after the best single ones; then thirds."""
    single = sorted((m for m in search.models if len(m.numbers) == 1), key=lambda m: -m.weight)
    count = len(search.candidates)
    if count < 2 or search.max_terms < 2:
        return
    wanted: dict[tuple[int, ...], None] = {}
    for pair in _linear_pairs(search):
        wanted[pair] = None
    for model in single[:3]:
        for j in _next_terms(search, model)[:5]:
            wanted[tuple(sorted((model.numbers[0], j)))] = None
    pairs = [pair for pair in wanted if len(set(pair)) == 2][:MOST]
    prior = math.log(PRIOR["several"] / (0.5 * count * (count - 1)))
    tried = [_refit_terms(search, pair, prior) for pair in pairs]
    fitted = [m for m in tried if m is not None]
    search.models += fitted
    if search.max_terms < 3 or not fitted:
        return
    best = max(fitted, key=lambda m: m.weight)
    if search.examine(best).p_value < 0.01 or search.exact:
        third = math.log(0.2 * PRIOR["several"] / (count * (count - 1) * max(count - 2, 1) / 6))
        for j in _next_terms(search, best)[:4]:
            if j in best.numbers:
                continue
            again = _refit_terms(search, tuple(sorted((*best.numbers, j))), third)
            if again is not None:
                search.models.append(again)


def _linear_pairs(search: Search) -> list[tuple[int, int]]:
    usable = [i for i in range(len(search.candidates)) if search.screening.best[i] >= 0 and i not in search.gone]
    if len(usable) < 2:
        return []
    columns = search.screening.columns[:, [search.screening.best[i] for i in usable]]
    z = columns.T @ search.residual.e
    c = columns.T @ columns
    gain = (z[:, None].square() + z.square() - 2 * c * z[:, None] * z) / (1 - c.square()).clamp_min(1e-6)
    gain = torch.where(c.abs() > 0.9995, torch.zeros_like(gain), gain).triu(1)
    order = gain.flatten().argsort(descending=True)[:8]
    return [(usable[int(k) // len(usable)], usable[int(k) % len(usable)]) for k in order]


def _next_terms(search: Search, model: Model) -> list[int]:
    """Other candidates by their score at a model's fit."""
    residual = model.residual or Residual(model.found, search.noise, seed=search.seed, draws=10)
    scale = drivers_scale(model.found.problem, model.found)
    scores = []
    for j, other in enumerate(search.candidates):
        if j in model.numbers or j in search.gone:
            continue
        search.tick(f"screen {other.name} after {', '.join(model.names)}")
        try:
            prepared = prepare(model.found.problem, model.found, other.terms, search.fixed, scale)
        except (SimulatorError, DomainError):
            continue
        found = screen(residual, [prepared])
        if found.best[0] >= 0:
            scores.append((-found.score(0), j))
    return [j for _, j in sorted(scores)]


def _refit_terms(search: Search, numbers: tuple[int, ...], prior: float) -> Model | None:
    terms = [term for i in numbers for term in search.candidates[i].terms]
    search.tick("refit with " + ", ".join(term.name for term in terms))
    try:
        candidate = prepare(
            search.base.problem, search.base, terms, search.fixed, drivers_scale(search.base.problem, search.base)
        )
    except (SimulatorError, DomainError):
        return None
    names = [q.name for q in candidate.problem.parameters]
    rows = []
    for lead in numbers:
        single = next((m for m in search.models if m.numbers == (lead,) and m.window is None), None)
        row = candidate.begin.clone()
        if single is not None:
            known = dict(
                zip([q.name for q in single.candidate.problem.parameters], single.found.values.tolist(), strict=True)
            )
            for k, name in enumerate(names):
                if name in known:
                    row[k] = known[name]
        for other in numbers:
            if other == lead:
                continue
            fitted = next((m for m in search.models if m.numbers == (other,) and m.window is None), None)
            source = search.candidates[other]
            for place in source.own:
                name = source.problem.parameters[place].name
                k = names.index(name)
                neutral = float(source.neutral[source.own.index(place)])
                value = float(fitted.found.values[place]) if fitted is not None else neutral
                row[k] = neutral + 0.02 * (value - neutral) if place in source.amplitudes else value
        rows.append(row)
    return search._refit(numbers, candidate, torch.stack(rows), prior)
