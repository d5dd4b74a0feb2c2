"""What of a refitted hypothesis speaks against it: its number of parameters, its bounds, what nature is known to be."""

import dataclasses
import math

from torchcal.discovery.fits.candidates import usual_starts
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.local import ENDS, is_moment, is_window
from torchcal.discovery.hypotheses.model import Model

__all__ = ["UNPHYSICAL", "held_back", "judge"]

#: Prior odds against an estimate on a physical bound that it wants to cross.
UNPHYSICAL = math.log(1e-3)


def held_back(model: Model, base: Fitted) -> list[str]:
    """Names of the parameters that stay at a bound, and did not in the base's fit; ends of windows apart."""
    before = base.stuck
    return [name for name in model.found.stuck if name not in before and not is_window(name)]


def judge(model: Model, base: Fitted) -> None:
    """Fill in its price, its bounds, where it acts and what speaks against it, beside the base's fit."""
    found, candidate = model.found, model.candidate
    names = [q.name for q in candidate.problem.parameters]
    if model.window is not None:
        low, high = model.window.low, model.window.high
        for i in candidate.own:
            low = float(found.values[i]) if names[i].endswith(ENDS["from"]) else low
            high = float(found.values[i]) if names[i].endswith(ENDS["to"]) else high
            if is_moment(names[i]):
                by = float(found.values[i]) - 0.5 * (low + high)
                low, high = low + by, high + by
        model.window = dataclasses.replace(model.window, low=low, high=high)
    new = held_back(model, base)
    amplitude = {names[i] for i in candidate.amplitudes}
    off = set()
    for i, at in zip(found.free, found.at_bound.tolist(), strict=True):
        if at and names[i] in amplitude:
            value, q = float(found.values[i]), candidate.problem.parameters[i]
            end = min((one for one in (q.low, q.high) if one is not None), key=lambda one: abs(one - value))
            if end == candidate.neutral_at(i):
                off.add(names[i])
    closed = model.window is not None and model.window.low >= model.window.high
    model.physical = not new and not closed
    if closed:
        model.note = "its window has closed"
    elif off:
        model.note = f"wants the wrong sign: {', '.join(sorted(off))} stays at its neutral value"
    elif new:
        model.note = f"at its bound: {', '.join(new)}"
    else:
        model.note = ""
    each = 0.5 * math.log(base.problem.n)
    usual = _away(model)
    costs = [min(each, usual.get(names[i], each)) for i in candidate.own if names[i] not in off]
    model.price = -sum(costs) + (UNPHYSICAL if new else 0.0) + _expected(model)


def _away(model: Model) -> dict[str, float]:
    """What it would cost in log density to have hidden states begin where they usually do, or at nothing, by the names
    of the shapes that say where: as much as these cost at most, since the term without them is a hypothesis too.
    Nothing where no datum depends on it, as of a lag that follows nothing yet.

    An effect has to be there, and to be seen.
    """
    candidate, found = model.candidate, model.found
    if not usual_starts(candidate.terms, candidate.problem, candidate.amplitudes):
        return {}
    column, sd = {i: k for k, i in enumerate(found.free)}, found.sd()
    costs: dict[str, float] = {}
    for term in candidate.terms:
        usual = usual_starts([term], candidate.problem, candidate.amplitudes)
        own = {term.full(q.name) for q in term.parameters}
        acting = [
            i for i in candidate.amplitudes
            if candidate.problem.parameters[i].name in own and float(found.values[i]) != candidate.neutral_at(i)
        ]  # fmt: skip
        if not any(bool(found.jacobian[:, column[i]].any()) for i in acting):
            continue
        for i, at in usual.items():
            seen = bool(found.jacobian[:, column[i]].any())
            away = min((float(found.values[i]) - one for one in (at, 0.0)), key=abs) / max(float(sd[i]), 1e-300)
            costs[candidate.problem.parameters[i].name] = 0.5 * away**2 if seen else 0.0
    return costs


def _expected(model: Model) -> float:
    """Log density of a model's estimates where its terms say what these are in nature, relative to its largest."""
    known = {term.full(name): told for term in model.candidate.terms for name, told in term.expected.items()}
    if not known:
        return 0.0
    found = model.found
    values, spread = found.by_name, dict(zip(found.by_name, found.sd().tolist(), strict=True))
    total = 0.0
    for name, (value, sd) in known.items():
        own = spread[name] if math.isfinite(spread[name]) else math.inf
        total -= 0.5 * (values[name] - value) ** 2 / (sd**2 + own**2)
    return total
