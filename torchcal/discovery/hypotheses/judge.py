"""What of a refitted hypothesis speaks against it: its number of parameters, its bounds, what nature is known to be."""

import dataclasses
import math

from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.local import ENDS, is_window
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
    unseen = _unseen(model)
    each = 0.5 * math.log(base.problem.n)
    usual = _away(model)
    costs = [min(each, usual.get(names[i], each)) for i in candidate.own if names[i] not in off and i not in unseen]
    model.price = -sum(costs) + (UNPHYSICAL if new else 0.0) + _expected(model)


def _unseen(model: Model) -> set[int]:
    """Places of the shapes of effects that act on which no datum depends, as where a lag begins that follows nothing
    yet: they fit nothing, and cost nothing."""
    found = model.found
    moves = dict(zip(found.free, (found.jacobian != 0).any(0).tolist(), strict=True))
    if not any(moves[i] for i in model.candidate.amplitudes):
        return set()
    return {i for i in model.candidate.own if not moves[i]} - set(model.candidate.amplitudes)


def _away(model: Model) -> dict[str, float]:
    """What it would cost in log density to have those shapes at their usual values that have one, by name: as much as
    they cost at most, since the term without them is a hypothesis too."""
    candidate, found = model.candidate, model.found
    amplitudes = {candidate.problem.parameters[i].name for i in candidate.amplitudes}
    usual = {
        term.full(q.name): q.neutral for term in candidate.terms for q in term.parameters if q.neutral is not None
    }  # fmt: skip
    usual = {name: value for name, value in usual.items() if name not in amplitudes}
    if not usual:
        return {}
    values, spread = found.by_name, dict(zip(found.by_name, found.sd().tolist(), strict=True))
    return {name: 0.5 * ((values[name] - at) / max(spread[name], 1e-300)) ** 2 for name, at in usual.items()}


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
