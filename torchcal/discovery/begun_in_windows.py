"""Where refits of changes in windows begin: with ends near those of a term's window, or anywhere along its driver."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate, prepare
from torchcal.discovery.fits.changes import Places, constant_change, distance, fading_to, places_of
from torchcal.discovery.fits.local import (
    EDGE,
    ENDS,
    WIDTH_OF_EDGE,
    WIDTHS,
    Span,
    driver_at,
    is_moment,
    is_window,
    localised,
    multiplied,
    sudden,
)
from torchcal.discovery.hypotheses.model import Hypothetical, Model
from torchcal.discovery.hypotheses.screen import Window
from torchcal.discovery.hypotheses.search import Search
from torchcal.errors import DomainError, SimulatorError

__all__ = ["in_any_window", "sudden_change", "wanted_changes"]

#: Places where a window may begin or end that is any one along a driver.
CUTS = 14
#: Places within an open window where a nameless change may begin or end, and starts that are refitted with each width
#: of the edges.
INSIDE, STARTS = 10, 2
#: Shares of a window by which its ends are moved for other starts; not at all first.
MOVES = (0.0, -0.15, 0.15, -0.3, 0.3)
#: What the name of a term that fades begins with.
FADING = "a fading "
#: Relative size from which on two effects are independent.
RANK = 1e-7
#: Levels up to which a condition has so few that a change on one side of it does what a function of it does.
FEW_LEVELS = 3


def wanted_changes(
    search: Search,
    model: Model,
    where: Places,
    prior: float,
    named: Mapping[Places | None, int],
    only: Collection[str] = ("step", "edge", "grown", "faded", "crossed"),
) -> tuple[list[Hypothetical], float]:
    """A constant in a model's window, with steep edges and with edges to fit; an open window closed as well, with a
    change that grows from its end, and with one that fades towards it; and, of a static recording, the best constant on
    one side of another condition of few levels; or ``only`` some of these. And the least χ² of all their beginnings,
    for linear."""
    w = model.window
    if w is None:
        return [], math.inf
    driver = search.drivers()[w.driver]
    inside = driver[(driver >= w.low) & (driver <= w.high)]
    span = w.span or search.spans()[w.driver]
    moves = [k * span.size * span.share(w.low, w.high) for k in MOVES]
    moved = [(span.moved(w.low, a), span.moved(w.high, b)) for a, b in itertools.product(moves, moves)]
    ends = [list(dict.fromkeys(moved))]
    if not (math.isfinite(w.low) and math.isfinite(w.high)) and len(inside):
        cuts = inside.double().quantile(torch.linspace(0, 1, INSIDE, dtype=torch.float64)).unique().tolist()
        last = w.low if math.isfinite(w.low) else w.high  # the end that it has, which need not be one of the data
        cuts = sorted({*cuts[1:], last}) if math.isfinite(w.low) else sorted({*cuts[:-1], last})
        ends += [list(itertools.combinations(cuts, 2))] if len(cuts) > 1 else []
    side = named.get(where)  # what has a name is no nameless one, but with the other sign
    still = constant_change(where, search.problem.in_time, side=-(side or 0))
    edges = {"step": False, "edge": True}
    shapes = [(kind, still, chosen, "") for chosen in ends for kind in edges] if side != 0 else []
    if len(ends) > 1:
        in_time, end = search.problem.in_time, ENDS["from" if math.isfinite(w.low) else "to"]
        grows = distance(w.driver, end, span, in_time)
        shapes.append(("grown", constant_change(where, in_time, grows), ends[0], ""))
        fading = fading_to(w.driver, end, span, in_time)
        shapes.append(("faded", constant_change(where, in_time, fading), ends[0], ""))
        term = search.candidates[model.numbers[0]].terms[0]
        if where == places_of(model.candidate) and not term.elapsed:  # whose t is not the window's
            shapes.append(("faded", multiplied(term, f"{FADING}{term.name}", fading), ends[0], ""))
    sides = _sides(search, w.driver) if side != 0 else []
    shapes += [("crossed", multiplied(still, still.name, share), ends[0], at) for at, share in sides]
    found, crossed, least = [], [], math.inf
    for kind, change, chosen, at in shapes:
        if kind not in only:
            continue
        low, high = chosen[0]
        near = span.edged(low, high)
        local = localised(
            change, w.driver, low, high, near,
            static=not search.problem.in_time, edge=edges.get(kind, False),
        )  # fmt: skip
        try:
            candidate = prepare(search.base.problem, search.base, [local], search.fixed, screened=False)
            begin, chi2 = _begin(search, model, candidate, chosen, span)
        except (SimulatorError, DomainError):
            continue
        window = dataclasses.replace(w, low=low, high=high, span=near, at=at)
        one = Hypothetical((), candidate, begin, prior - (math.log(len(sides)) if at else 0.0), window)
        if at:
            crossed.append((chi2, one))
        else:
            found.append(one)
        least = min(least, chi2)
    found += [one for _, one in sorted(crossed, key=lambda one: one[0])[:1]]
    return found, least


def _sides(search: Search, driver: str) -> list[tuple[str, Callable[..., Any]]]:
    """Every side of another condition of few levels, in words and as a share of a static term."""
    if search.problem.in_time:
        return []
    found = []
    for name, values in search.drivers().items():
        levels = values.unique().tolist()
        if name == driver or not 1 < len(levels) <= FEW_LEVELS:
            continue
        for low, high in itertools.pairwise(levels):
            for sign in (-1, 1):
                there = [level for level in levels if (level > low) is (sign > 0)]
                cut = 0.5 * (low + high)
                text = f"= {there[0]:.4g}" if len(there) == 1 else f"{'<>'[sign > 0]} {cut:.4g}"
                found.append((f"{name} {text}", _beyond(name, cut, sign)))
    return found


def _beyond(condition: str, cut: float, sign: int) -> Callable[..., Any]:
    """1 on one side of a value of a condition, else 0; of what a static term's functions are given."""
    at = driver_at(condition, static=True)
    return lambda *given: (sign * (at(*given) - cut) > 0).to(torch.float64)


def sudden_change(
    search: Search, model: Model, where: Places, prior: float, times: Sequence[float], width: float
) -> tuple[Hypothetical, float] | None:
    """A constant for a moment of a given width at one of some times, and the least χ² of its beginnings, for linear and
    with all that the base fits; None where it cannot be taken."""
    span = search.spans()["t"]
    name = f"a sudden change of {' and '.join(name for _, name in where)}"
    change = sudden(constant_change(where, in_time=True), name, times[0], width, span)
    ends = [(at - width, at + width) for at in times]
    try:
        candidate = prepare(search.base.problem, search.base, [change], search.fixed, screened=False)
        begin, chi2 = _begin(search, model, candidate, ends, span, project=True)
    except (SimulatorError, DomainError):
        return None
    window = Window(model.numbers[0], "t", *ends[0], math.nan, math.nan, span)
    return Hypothetical((), candidate, begin, prior, window), chi2


def in_any_window(search: Search, model: Model) -> Hypothetical | None:
    """A model's term in all windows along the same driver, open ones too, from the best of them."""
    w, term = model.window, search.candidates[model.numbers[0]].terms[0]
    if w is None or len(model.candidate.amplitudes) != 1:
        return None
    span = search.spans()[w.driver]
    cuts = [span.moved(span.low, k / (CUTS - 1) * span.size) for k in range(CUTS)]
    local = localised(term, w.driver, cuts[0], cuts[-1], span, static=not search.problem.in_time, edge=True)
    try:
        candidate = prepare(search.base.problem, search.base, [local], search.fixed, screened=False)
        begin, _ = _begin(search, model, candidate, list(itertools.combinations(cuts, 2)), span)
    except (SimulatorError, DomainError):
        return None
    window = dataclasses.replace(w, low=cuts[0], high=cuts[-1], span=span)
    return Hypothetical(model.numbers, candidate, begin, model.log_prior, window)


def _begin(
    search: Search,
    model: Model,
    candidate: Candidate,
    ends: Sequence[tuple[float, float]],
    span: Span,
    project: bool = False,
) -> tuple[Tensor, float]:
    """Starting values at a model's base, of the best size each, those of the best few; and the least χ², for linear;
    ``project`` it off what the base fits."""
    known, problem = model.found.by_name, candidate.problem
    known |= {f"{FADING}{name}": value for name, value in known.items()}  # a term that fades begins at its shape
    names = [q.name for q in problem.parameters]
    places = candidate.amplitudes
    widths = [share * span.size for share in (EDGE, *WIDTHS)]
    if not any(name.endswith(WIDTH_OF_EDGE) for name in names):
        widths = widths[:1]
    rows = []
    for width, (low, high) in itertools.product(widths, ends):
        row = candidate.begin.clone()
        for i, name in enumerate(names):
            if is_moment(name):
                row[i] = 0.5 * (low + high)
            elif is_window(name):
                row[i] = width if name.endswith(WIDTH_OF_EDGE) else low if name.endswith("from") else high
            elif i not in places:
                row[i] = known.get(name, float(row[i]))
        rows.append(row)
    begin = torch.stack(rows)
    y, slope, _ = problem.evaluate(begin, places)
    w = search.noise.whitening(problem)
    left, effect = w.vector(problem.y - y), torch.stack([w(one) for one in slope])
    lost = ~(left.isfinite().all(-1) & effect.square().sum((1, 2)).isfinite())  # solutions that blow up
    left, effect = left.masked_fill(lost[:, None], 0.0), effect.masked_fill(lost[:, None, None], 0.0)
    if project:
        left, effect = search.residual.project(left.T).T, torch.stack([search.residual.project(one) for one in effect])
    # Of places where nothing happens the size stays as it is.
    scale = effect.norm(dim=1, keepdim=True).clamp_min(1e-300)
    size = torch.linalg.pinv(effect / scale, rtol=RANK) @ left[..., None]
    begin[:, places] += size[..., 0] / scale[:, 0]
    chi2 = (left - ((effect / scale) @ size)[..., 0]).square().sum(-1)
    chi2 = chi2.masked_fill(lost, torch.inf)
    chi2 = chi2.nan_to_num(nan=torch.inf)
    order = chi2.reshape(len(widths), -1).argsort(-1)[:, :STARTS]
    best = begin.reshape(len(widths), -1, begin.shape[-1])[torch.arange(len(widths))[:, None], order]
    return best.flatten(0, 1), float(chi2.min())
