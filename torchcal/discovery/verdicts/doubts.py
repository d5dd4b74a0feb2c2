"""Why the best explanation of a recording may be no name, however probable it is."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted, weighed
from torchcal.discovery.fits.local import force, is_window
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.readings import threshold_of
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.own_noise import beside
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.noise import GRID, LEAST, Noise, log_prior
from torchcal.discovery.verdicts.explain import misfit_size, stated_sd
from torchcal.discovery.verdicts.given import as_good
from torchcal.discovery.verdicts.instruments import bends_to_physics, no_instrument, unnatural
from torchcal.discovery.verdicts.together import only_together
from torchcal.errors import TorchcalError
from torchcal.simulators import Trajectories
from torchcal.terms import Term

__all__ = ["ALONG", "along_rows", "between_outputs", "by_hold", "distinct", "doubt", "goes_on", "in_common", "in_order",
           "left_open", "unfit"]  # fmt: skip

#: Correlation from sample to sample from which on noise of unknown size may be physics that a term has left.
SLOWEST = 0.85
#: Robust over plain sd of the innovations below which they are of several sizes (1 if normal, 0.73 if Laplace's), and
#: data of an output from which on that can be told.
EVEN, MANY = 0.55, 30
#: Correlation along the rows of a grid, in sd, from which on what is left may be noise in the order of the recording.
ALONG = 3.3
#: Probability by chance of the correlation of what is left of two outputs, of all pairs of them, below which it may be
#: physics that acts on both, though noise of unknown size was taken to be as large; and data to spare of each, from
#: which on that can be told.
IN_COMMON, FEW = 0.01, 8
#: Odds that the noise of two outputs has one correlation rather than two, below which it may be physics in one of them.
ALIKE = 0.05
#: Distance of a term's amplitudes from neutral, in their joint sd, up to which the data leave them open.
OPEN = 0.1
#: The same of a term that acts in a window, where most terms can do what a few data want, of one of several, which may
#: make up for each other, or of data without noise, where nothing else weighs it.
CLEARLY_OPEN = 2.0
#: Distinct values of its driver at which a window must be open, and at which closed: its height, end and slope can be
#: drawn through fewer, whatever they are. And the share of a term that may be missing, or left.
LEVELS, NEARLY = 3, 0.2
#: Distinct values of its driver below a threshold up to which nothing shows that the effect begins there.
FREE = 2
#: Sd of a slow drive's gain, and share of it, by which it must be more than the base's own: a pure dead time takes
#: twice as much, a lag with half a gap between samples beside it a fifth more.
WRONG_WAY, MORE = 2.0, 1 / 3
#: Log odds against a nameless change from which on a term in a window is there for its own shape.
CLEARLY = 3.0
#: Share of the largest effect of the base's parameters below which a direction of them moves no datum.
UNSEEN = 1e-7


def doubt(search: Search, model: Model) -> str:
    """Why a model is no name, however probable, in a sentence; empty if it may be one."""
    found = unfit(search, model) or _no_better(search, model) or by_hold(search, model) or only_together(search, model)
    if found or search.exact:
        return found
    found = _noise_or_physics(search, model) or in_common(search, model) or _of_two_colours(search, model)
    return found or bends_to_physics(search, model)


def unfit(search: Search, model: Model) -> str:
    """Why what a model adds is open, or nothing that its terms stand for, in a sentence; empty if it is neither."""
    return (
        left_open(search, model)
        or unnatural(model)
        or no_instrument(search, model)
        or _only_there(model)
        or _no_threshold(model)
        or _no_drive(model)
    )


def left_open(search: Search, model: Model) -> str:
    """Why the data do not determine what a model adds; empty if they do."""
    names = [q.name for q in model.found.problem.parameters]
    more = "another run" if search.problem.in_time else "more conditions"
    if (noise := beside(search, model)) is not search.noise:
        model = dataclasses.replace(model, found=weighed(model.found, noise.whitening(model.found.problem)))
    for term in model.candidate.terms:
        shapes = [i for i in model.candidate.own if term.brings(names[i]) and not is_window(names[i])]
        places = [i for i in model.candidate.amplitudes if term.brings(names[i])]
        sure = model.window is None and len(model.candidate.terms) == 1 and not search.exact
        least = OPEN if sure else CLEARLY_OPEN
        # Without noise the misfit is what an amplitude is uncertain by.
        size = misfit_size(model.found) if search.exact else 1.0
        ends = [i for i in shapes if i not in places and _at_given_end(search, model, i)]
        if places and ends and _distance(model, places, (), size) <= CLEARLY_OPEN:
            listed = " and ".join(names[i] for i in ends)
            return (
                f"The fit ends at a bound of {listed}, along with which the data leave the size of what it adds open: "
                f"{more} would tell, or a bound that is surer."
            )
        if places and _distance(model, places, shapes, size) <= least:
            bound = search.base.stuck
            looks = f" {', '.join(bound)} ran to a bound in the base: a bound that is wrong looks like this too."
            told = f"The data leave the size of what it adds open: {more} would tell."
            return told + looks if bound else told
    if model.window is not None and _levels(model) < LEVELS:
        return (
            f"It acts in full, or not at all, at hardly more than one value of {model.window.driver}, at which "
            f"something else may be missing as well: more values of {model.window.driver} would tell."
        )
    # As many to spare as are added: else there is a curve through the data, whatever they are.
    if distinct(search.problem) - len(model.found.free) <= len(model.candidate.own):
        return "There are hardly more distinct conditions than parameters: more conditions would tell."
    return ""


def _at_given_end(search: Search, model: Model, i: int) -> bool:
    """Whether a term's parameter is at a bound that the user gave, whether or not it wants to cross it."""
    name, value = model.found.problem.parameters[i].name, float(model.found.values[i])
    terms = [search.terms[number] for number in model.numbers]
    return any(term.full(q.name) == name and value in (q.low, q.high) for term in terms for q in term.parameters)


def _no_better(search: Search, model: Model) -> str:
    """Why a term is hardly likelier than a change in a range that has no name; empty if it is clearly so.

    Where nothing depends on time an instrument that errs beyond a value is a function of the conditions as any other:
    it has to fit better.
    """
    alone = model.window is None and not model.found.problem.in_time
    errs = alone and threshold_of(model.candidate.terms, model.found.by_name) is not None
    lead = {id(one): (one.log_evidence - model.log_evidence) if errs else (one.weight - model.weight)
            for one in search.nameless}  # fmt: skip
    rival = max(search.nameless, key=lambda one: lead[id(one)], default=None)
    if rival is None or rival.window is None or lead[id(rival)] < -CLEARLY:
        return ""
    if search.constants.intersection(model.numbers):  # which has no other shape to show
        return ""
    what = f"{rival.candidate.name[0].upper()}{rival.candidate.name[1:]} in a range of {rival.window.driver}"
    return f"{what} would do nearly as well: the term's own shape is not seen yet."


def _only_there(model: Model) -> str:
    """Why an instrument that errs beyond a value of its reading does not in a part of a condition's range alone."""
    found = None if model.window is None else threshold_of(model.candidate.terms, model.found.by_name)
    if found is None:
        return ""
    return (
        f"An instrument that errs beyond a value of {found[0]} does so wherever that is reached, and not only where "
        f"{model.where}: something that depends on both looks the same."
    )


def by_hold(search: Search, model: Model) -> str:
    """Why a model may stand for a wrong guess of what inputs do between samples; empty if that is clearly less."""
    if not as_good(search, model):
        return ""
    less = "without it" if len(model.names) == 1 else "without all or a part of it"
    return f"Inputs that go on otherwise between samples (hold=) would do nearly as well {less}."


def _no_threshold(model: Model) -> str:
    """Why a threshold of what a model adds is none: it would end the effect below all data but a few."""
    found, problem = model.found, model.found.problem
    drivers = problem.drivers_at_data(found.values[None], found.warm)
    values = found.by_name
    for term in model.candidate.terms:
        for own, driver in term.scales.items():
            value = values[term.full(own)]
            if driver not in drivers or problem.is_time(driver) or value <= 0:
                continue
            below = drivers[driver].abs() <= value
            if len(drivers[driver][below].unique()) <= FREE and _ends(model, term, drivers, driver, value):
                return (
                    f"By it {driver} is beyond {own} = {value:.3g} at all data but a few: nothing shows that "
                    f"{term.name} begins there, and what has no such threshold does as well."
                )
    return ""


def _ends(model: Model, term: Term, drivers: Mapping[str, Tensor], driver: str, value: float) -> bool:
    """Whether a term does nothing where a driver is below a value."""
    problem = model.found.problem
    below = {**drivers, driver: 0.5 * value * drivers[driver].sign()}
    given = problem.arguments(below, term.own(problem.parameters_at_data(model.found.values)))
    functions = [*(rate for state, rate in term.rates.items() if state not in term.states), *term.shifts.values()]
    try:
        return bool(functions) and all(not bool(torch.as_tensor(term.call(f, *given)).any()) for f in functions)
    except TorchcalError:  # not every function works on a row of data
        return False


def _no_drive(model: Model) -> str:
    """Why a slow drive is none: an equation would at first follow its input the wrong way.

    A drive that lags takes its input's effect away, and gives it back later. It has no more to take than there is.
    """
    bound, sd = model.found.problem.simulator, stated_sd(model.found)
    for term in model.candidate.terms:
        if term.takes is None or not term.states or not isinstance(bound, Trajectories):
            continue
        unsure = [float(sd[i] / model.found.values[i].abs()) for i in model.candidate.amplitudes
                  if term.brings(model.found.problem.parameters[i].name)]  # fmt: skip
        least = max([MORE, *(WRONG_WAY * one for one in unsure)])
        for state in term.rates:
            if state in term.states:
                continue
            try:
                total, own = _response(model, bound, term, state, term.takes)
            except TorchcalError:  # not every function works on a row of data
                continue
            if bool(((own * (total - own) < 0) & (total * own > least * own.square())).all()):
                return (
                    f"By it the rate of {state} would at first follow {term.takes} the wrong way: it takes more of "
                    "its effect away than there is."
                )
    return ""


def _response(model: Model, bound: Trajectories, term: Term, state: str, name: str) -> tuple[Tensor, Tensor]:
    """How a state's whole rate, and a term's share of it, change at the data with an input, by its range."""
    problem = model.found.problem
    drivers = problem.drivers_at_data(model.found.values[None], model.found.warm)
    p = bound.layout.by_name(model.found.values[None], bound.grid.run_of[problem.condition_of])
    states = list(bound.ode.states)
    s = torch.stack([drivers[one] for one in states], dim=-1)[None]
    named = dict(zip(states, s.unbind(-1), strict=True))
    t, inputs = drivers["t"], {one: drivers[one] for one in bound.runs[0].inputs}
    given = torch.cat([run.inputs[name] for run in bound.runs])
    found = []
    for u in ({**inputs, name: inputs[name] + given.max() - given.min()}, inputs):
        total = bound.steps.rates(t, s, p, u)[..., states.index(state)]
        found.append((total, torch.as_tensor(term.call(term.rates[state], t, named, term.own(p), u))))
    (total, own), (total_before, own_before) = found
    return total - total_before, own - own_before


def _levels(model: Model) -> int:
    """Distinct values of a window's driver, at data in use, at which it is nearly open, or nearly closed if these are
    fewer."""
    found, w = model.found, model.window
    if w is None or w.span is None:
        return 0
    driver = found.problem.drivers_at_data(found.values[None], found.warm)[w.driver]
    p = {q.name.rsplit(".", 1)[-1]: value
         for q, value in zip(found.problem.parameters, found.values, strict=True) if is_window(q.name)}  # fmt: skip
    share = force(w.span, driver, p)
    return min(len(driver[there].unique()) for there in (share >= 1 - NEARLY, share <= NEARLY))


def _distance(model: Model, places: Sequence[int], shapes: Sequence[int], size: float) -> float:
    """Of a term's amplitudes from neutral, in their joint sd with its shapes held, but not the ends of its window; that
    of the noise is ``size`` times what the fit was weighed with.

    A product may be determined where neither of its factors is; and what the base leaves open of its own parameters,
    the scale of a state that is not seen, say, is no matter of the term.
    """
    found, candidate = model.found, model.candidate
    away = (found.values - candidate.without(found.values, places))[list(places)]
    columns = found.whitening(found.jacobian) / max(size, 1e-300)
    mine = [found.free.index(i) for i in places]
    kept = [k for k, i in enumerate(found.free) if i not in {*places, *shapes}]
    moved = columns[:, mine] @ away
    left = _beside(columns[:, kept], moved)
    if left > OPEN:
        return left
    base = [k for k, i in enumerate(found.free) if i not in candidate.own]
    if not base:
        return left
    values = candidate.without(found.values, candidate.own)
    jacobian = found.problem.evaluate(values[None], [found.free[k] for k in base])[1][0]
    slope = found.whitening(jacobian) / max(size, 1e-300)
    if not bool(slope.isfinite().all()):
        return left
    unit = slope.norm(dim=0)
    unit = torch.where(unit > 0, unit, unit.max().clamp_min(1e-300))
    _, sizes, directions = torch.linalg.svd(slope / unit, full_matrices=False)
    seen = directions[sizes > UNSEEN * sizes.max()] / unit  # in the parameters' own units, (directions, base)
    others = [k for k in kept if k not in base]
    return _beside(torch.cat([columns[:, base] @ seen.T, columns[:, others]], dim=1), moved)


def _beside(columns: Tensor, moved: Tensor) -> float:
    """What is left of an effect beside others, in noise sd."""
    unit = columns / columns.norm(dim=0).clamp_min(1e-300)
    left = moved - unit @ torch.linalg.lstsq(unit, moved[:, None], rcond=1e-10, driver="gelsd").solution[:, 0]
    return float(left.norm())


def _noise_or_physics(search: Search, model: Model) -> str:
    """What may be physics that a model leaves, though it is taken for noise.

    Noise of unknown size that is slow is what a wrong shape leaves, too; where most of it is small, and some of it
    large, it is no noise of one size. Where rows do not follow one another no correlated noise is estimated.
    """
    if told := in_order(search, model):
        return told
    noise, problem = beside(search, model), model.found.problem
    e = noise.whitening(problem).vector(model.found.residual)
    for k, rho in enumerate(noise.correlation.tolist() if noise.open else ()):
        mine = e[problem.output_of == k]
        if bool(model.found.met[problem.output_of == k].all()):
            continue  # what is left is rounding
        if rho >= SLOWEST or (len(mine) >= MANY and _evenness(mine) < EVEN):
            return (
                "What it leaves is so slow, or of such uneven size, that it may as well be physics as noise: a known "
                "noise sd, replicates or a repeated run would tell."
            )
    return ""


def in_order(search: Search, model: Model) -> str:
    """Whether what a model leaves goes on from row to row though rows are in no order, in a sentence; empty if not."""
    if not goes_on(model.found, beside(search, model)):
        return ""
    return (
        "What it leaves is correlated in the order of the recording, as noise or as physics: the same conditions in "
        "another order would tell."
    )


def goes_on(found: Fitted, noise: Noise) -> bool:
    """Whether what a fit leaves goes on from row to row of a grid, in whose order no memory of the noise is sought."""
    problem = found.problem
    if problem.sweeps is not None or bool(found.met.all()):
        return False
    return along_rows(problem, noise.whitening(problem).vector(found.residual)) > ALONG


def _evenness(e: Tensor) -> float:
    """Robust over plain sd."""
    return 1.4826 * float(e.abs().median()) / max(float(e.square().mean().sqrt()), 1e-300)


def in_common(search: Search, model: Model) -> str:
    """Whether what a model leaves of one output goes with what it leaves of another, in a sentence; empty if not."""
    noise, problem = beside(search, model), model.found.problem
    white = noise.whitening(problem)
    if not noise.open:
        return ""
    if between_outputs(problem, white.vector(model.found.residual), white(model.found.jacobian))[0] >= IN_COMMON:
        return ""
    return (
        "What it leaves of one output goes with what it leaves of another, as physics that acts on both would, or "
        "noise that they share: a known noise sd or replicates would tell."
    )


def between_outputs(problem: Problem, e: Tensor, jacobian: Tensor) -> tuple[float, tuple[str, ...]]:
    """Probability by chance of the largest correlation of two outputs' residuals at the same conditions, and these
    outputs; 1 and none of one output.

    Args:
        problem: The data.
        e: Whitened residuals, ``(n,)``.
        jacobian: Whitened slopes of the fit that left them, ``(n, k)``.

    Residuals of a fit are e = (I − H) ε, whose products have the mean tr(M (I − H)) and the variance
    2 tr((M (I − H))²), M picking pairs of data (half of each twice).
    """
    outputs = problem.output_of.unique().tolist()
    q = torch.linalg.svd(jacobian / jacobian.norm(dim=0).clamp_min(1e-300), full_matrices=False)
    q = q.U[:, q.S > UNSEEN * q.S.max()] if len(q.S) else q.U
    place = torch.full((problem.recording.n, len(outputs)), -1)
    for k, output in enumerate(outputs):
        mine = (problem.output_of == output).nonzero()[:, 0]
        place[problem.condition_of[mine], k] = mine
    worst, pairs, which = 1.0, math.comb(len(outputs), 2), tuple[str, ...]()
    for a, b in itertools.combinations(range(len(outputs)), 2):
        both = place[(place[:, a] >= 0) & (place[:, b] >= 0)][:, [a, b]]
        one, other = both.unbind(1)
        left = [len(rows) - float(q[rows].square().sum()) for rows in (one, other)]
        if min(left) < FEW:
            continue
        sizes = [float(e[rows].square().sum()) / freedom for rows, freedom in zip((one, other), left, strict=True)]
        if min(sizes) <= 0.0:
            continue
        product = float(e[one] @ e[other]) / math.sqrt(sizes[0] * sizes[1])
        cross = q[one].T @ q[other]
        mean = -float(cross.trace())
        twice = 0.5 * (cross + cross.T)
        spread = len(both) - float(q[one].square().sum() + q[other].square().sum()) + 2.0 * float(twice.square().sum())
        z = abs(product - mean) / math.sqrt(max(spread, 1.0))
        by_chance = pairs * math.erfc(z / math.sqrt(2.0))
        if by_chance < worst:
            worst, which = by_chance, tuple(problem.recording.outputs[outputs[k]] for k in (a, b))
    return worst, which


def _of_two_colours(search: Search, model: Model) -> str:
    """Whether noise of unknown size would have to be correlated in an output, from which most of the evidence for a
    model comes, and not, or less, in another."""
    problem, names = model.found.problem, model.found.problem.recording.outputs
    counts = torch.bincount(problem.output_of, minlength=len(names))
    if not search.noise.open or problem.sweeps is None or int((counts >= LEAST).sum()) < 2:
        return ""
    noise = search.settled(model.found)[0]
    white = noise.whitening(problem)
    gain = white.vector(search.base.residual).square() - white.vector(model.found.residual).square()
    for a, b in itertools.permutations([k for k, n in enumerate(counts.tolist()) if n >= LEAST], 2):
        prior = log_prior(GRID, 0.5 * (counts[a] + counts[b]).double()).softmax(0)
        alike = float((noise.posterior[a] * noise.posterior[b] / prior).sum())
        most = float(gain[problem.output_of == a].sum()) > 0.5 * float(gain.sum())
        if most and noise.correlation[a] > noise.correlation[b] and alike < ALIKE:
            return (
                f"What it leaves of {names[a]} is correlated from sample to sample "
                f"({float(noise.correlation[a]):.2f}), that of {names[b]} less ({float(noise.correlation[b]):.2f}): "
                "noise may be so, or physics is left; a known noise sd, replicates or a repeated run would tell."
            )
    return ""


def along_rows(problem: Problem, e: Tensor) -> float:
    """Correlation of what is left with the next datum of the recording, in its sd by chance; of the worst output."""
    worst = 0.0
    for k in problem.output_of.unique().tolist():
        mine = e[problem.output_of == k]
        worst = max(worst, float(mine[1:] @ mine[:-1]) / max(float(mine @ mine), 1e-300) * math.sqrt(len(mine)))
    return worst


def distinct(problem: Problem) -> int:
    """Data in use at distinct conditions, of a static recording: replicates do not tell one curve from another."""
    if problem.in_time:
        return problem.n
    which = problem.levels[1][problem.condition_of]
    return len(torch.stack([which, problem.output_of], dim=-1).unique(dim=0))
