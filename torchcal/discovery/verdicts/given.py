"""What was given beside the outputs: noise, bounds, initial values, and how inputs go on between samples."""

import copy
import dataclasses
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchcal.data import Recording, Run
from torchcal.discovery.fits.fitting import Fitted, fit
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.noise import Noise
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.misfit.structure import analyse
from torchcal.display import placed, with_unit
from torchcal.errors import DomainError, SimulatorError
from torchcal.simulators import Trajectories
from torchcal.simulators.layout import initial_name

__all__ = ["as_good", "begun_elsewhere", "held_otherwise", "resolved", "told_apart", "unbounded"]

#: χ² of the base up to which double precision still tells log evidences apart by a hundredth.
DIGITS = 1e14
#: Smallest noise sd that is gone by at first, in the output's spread.
SMALLEST = 1e-12
#: Probability by chance of what is left, from which on it is noise, and where a bound forbade what leaves so much less
#: than that; and noise sd up to which an initial value that is
#: found free is the one that was given: of one given as the first value recorded, and of any other.
NOISE, HARDLY, CONFIRMED, ELSEWHERE = 0.05, 0.01, 0.2, 1.0
#: Samples of a run below which its initial values explain whatever it shows; initial values that are told one by one.
FEWEST, MOST_TOLD = 5, 3
#: Change of an input from sample to sample, in its sd, from which on it matters how it goes on between them.
FAR = 0.5
#: How inputs may go on that go on in a way that can be mistaken for it.
MISTAKEN = {"linear": "zero", "zero": "linear"}
#: Share of its samples that repeat the one before, above which an input that is held stays at its values by nature.
STAYS = 0.5
#: Log evidence, and share of that of the best model, from which on another hold is told of; and log odds below which a
#: model is not clearly better than it.
TOLD, AS_MUCH, CLEARLY = 10.0, 0.5, 3.0


def resolved(recording: Recording) -> Recording:
    """The recording with a given noise that is not so small that squares of residuals overflow."""
    least = SMALLEST * recording.spread
    if not isinstance(recording.noise, Tensor) or bool((recording.noise >= least).all()):
        return recording
    return recording.with_noise(torch.maximum(recording.noise, least))


def told_apart(base: Fitted) -> Tensor | None:
    """The sd ``(n_total,)`` that a given noise must be taken for where evidences cannot be told apart with it."""
    noise = base.problem.recording.noise
    if not isinstance(noise, Tensor):
        return None
    chi2 = max(base.chi2, float((base.residual / noise[base.problem.index]).square().sum()))  # a memory may change
    return math.sqrt(chi2 / DIGITS) * noise if chi2 > DIGITS else None


def unbounded(search: Search) -> list[str]:
    """Bounds that the calibrated base runs to, in words, where noise alone is left without them."""
    base = search.base
    stuck = [i for i, at in zip(base.free, base.at_bound.tolist(), strict=True) if at]
    if search.exact or search.stop.is_set() or not stuck:
        return []
    twin = copy.copy(base.problem.simulator)
    twin.parameters = tuple(
        dataclasses.replace(q, low=None, high=None) if i in stuck else q for i, q in enumerate(twin.parameters)
    )
    noise = search.noise
    try:
        found = fit(base.problem.with_simulator(twin), base.whitening, base.values[None], base.free)
        if found is not None and noise.open:
            noise = search.settled(found)[0]
    except (SimulatorError, DomainError):
        return []
    if found is None or not _noise_alone(search, found, noise, HARDLY):
        return []
    names = [twin.parameters[i].name for i in stuck]
    values = [
        with_unit(placed(float(found.values[i]), abs(float(found.values[i] - base.values[i]))), twin.parameters[i].unit)
        for i in stuck
    ]
    its, are = ("its bound", "is") if len(names) == 1 else ("their bounds", "are")
    return [
        f"without {its} {' and '.join(names)} {are} {' and '.join(values)}, and the base leaves no more than noise: a "
        "bound that is wrong looks like this"
    ]


def begun_elsewhere(search: Search) -> list[str]:
    """Initial values of recorded states that were given, in words, where noise alone is left without them.

    Those given as the first sample, noise and all, are doubted before the others.
    """
    bound, runs = search.base.problem.simulator, search.problem.recording.runs
    if search.exact or search.stop.is_set() or runs is None or not isinstance(bound, Trajectories):
        return []
    shown = [
        {state: output for output, state in bound.ode.reads.items()
         if state in run.initial and state not in bound.ode.initial and output in run.outputs
         and int(run.outputs[output].isfinite().sum()) >= FEWEST}
        for run in runs
    ]  # fmt: skip
    first = [
        {state: output for state, output in mine.items() if run.initial[state] == float(run.outputs[output][0])}
        for run, mine in zip(runs, shown, strict=True)
    ]
    if moved := _moved(search, first, CONFIRMED):
        it, was = ("it", "was") if len(moved) == 1 else ("them", "were")
        names = list(moved)
        if len(names) > MOST_TOLD + 1:
            names = [*names[:MOST_TOLD], f"{len(names) - MOST_TOLD} others"]
        return [
            f"{', '.join(names)} {was} given as the first value recorded, noise and all: with {it} unknown (left out "
            "of initial=) the base leaves no more than noise"
        ]
    moved = {} if first == shown else _moved(search, shown, ELSEWHERE)
    told = [
        f"{full} was given as {placed(given, abs(found - given))} and is {placed(found, abs(found - given))} where it "
        "is unknown (left out of initial=)" for full, (given, found) in moved.items()
    ]  # fmt: skip
    if len(told) > MOST_TOLD:
        told = [f"{told[0]}; so are {len(told) - 1} other initial values elsewhere than given"]
    return [f"{one}: the base leaves no more than noise then" for one in told]


def _moved(search: Search, shown: Sequence[Mapping[str, str]], least: float) -> dict[str, tuple[float, float]]:
    """Of the states of each run, with the outputs that show them, the initial values that move by more than so many
    noise sd where they are free, by name: as given, and as found. None where more than noise is left then."""
    recording = search.problem.recording
    runs = recording.runs or ()
    taken = {
        initial_name(state, r, len(runs)): (output, r, run.initial[state])
        for r, (run, mine) in enumerate(zip(runs, shown, strict=True)) for state, output in mine.items()
    }  # fmt: skip
    if not taken:
        return {}
    found = _refitted(
        search, search.base, recording.without_initial([list(mine) for mine in shown]),
        {full: value for full, (_, _, value) in taken.items()},
    )  # fmt: skip
    if found is None or not _noise_alone(search, found):
        return {}
    sd = recording.split(search.noise.sd)
    return {
        full: (value, found.by_name[full]) for full, (name, r, value) in taken.items()
        if abs(found.by_name[full] - value) > least * float(sd[name][recording.x["run"] == r].median())  # type: ignore[index]
    }  # fmt: skip


def other_hold(search: Search, part: Fitted) -> Fitted | None:
    """A fit with inputs that change far between samples held the other way; None where none do.

    In all of such runs, or in those alone that it suits. It has no parameter more. Computed once for a fit.
    """
    if id(part) not in search.otherwise:  # the fit is kept beside it, so that its id stays its own
        far = _far_runs(search)
        found = _held(search, part, far) if any(far) and not search.stop.is_set() else None
        if found is not None and sum(far) > 1:
            worse = _by_run(found) > _by_run(part)
            suited = [wrong and not bool(worse[r]) for r, wrong in enumerate(far)]
            some = _held(search, part, suited) if any(suited) and suited != far else None
            found = min((one for one in (found, some) if one is not None), key=lambda one: one.chi2)
        search.otherwise[id(part)] = part, found
    return search.otherwise[id(part)][1]


def as_good(search: Search, model: Model) -> bool:
    """Whether the base, or one with fewer of a model's terms, does nearly as well with inputs held the other way."""
    if not any(_far_runs(search)):
        return False
    best = evidence(search, model.found) + model.price - CLEARLY
    fewer = [m for m in search.models if m.window is None and set(m.numbers) < set(model.numbers)]
    for part, price in ((search.base, 0.0), *((m.found, m.price) for m in fewer)):
        other = other_hold(search, part)
        if other is None:
            continue
        value = evidence(search, other)
        if value + price > best and value > evidence(search, part) + CLEARLY:
            return True
    return False


def held_otherwise(search: Search) -> list[str]:
    """How much better the base is with inputs held the other way between samples, in words."""
    found = other_hold(search, search.base)
    if found is None:
        return []
    leader, begun = search.physical_leader, evidence(search, search.base)
    best = 0.0 if leader is None else evidence(search, leader.found) + leader.price - begun
    if evidence(search, found) - begun < max(TOLD, AS_MUCH * best):
        return []
    pairs = list(zip(search.problem.recording.runs or (), found.problem.recording.runs or (), strict=True))
    changed = [(r, repr(new.hold)) for r, (old, new) in enumerate(pairs) if new.hold != old.hold]
    holds = {hold for _, hold in changed}
    how = f"hold={holds.pop()}" if len(holds) == 1 else "the other hold="
    if len(changed) < len(pairs):
        how += f" in run{'s' if len(changed) > 1 else ''} {', '.join(str(r) for r, _ in changed)}"
    left = f"the base's RMSE is {_rmse(found):.4g} in place of {_rmse(search.base):.4g}"
    if not search.exact and _noise_alone(search, found):
        left = "the base leaves no more than noise"
    return [f"inputs change far between some of their samples: with {how} {left}"]


def evidence(search: Search, found: Fitted) -> float:
    """Log evidence of a fit, up to a constant and without its price; with its own noise where that is unknown."""
    return search.settled(found)[1] if search.noise.open else search.gain(found.chi2)


def _far_runs(search: Search) -> list[bool]:
    """In which runs an input changes far between samples."""
    return [bool(_far(run)) for run in search.problem.recording.runs or ()]


def _far(run: Run) -> list[str]:
    """Inputs that change so far between samples that it matters how they go on there; not what is held and mostly stays
    at its values."""
    return [
        name for name, u in run.inputs.items()
        if run.holds[name] in MISTAKEN and float(u.diff().abs().max()) > FAR * float(u.std()) > 0
        and not (run.holds[name] == "zero" and float((u.diff() == 0).double().mean()) > STAYS)
    ]  # fmt: skip


def _by_run(found: Fitted) -> Tensor:
    """What every run adds to χ²."""
    return found.problem.by_run(found.whitening.vector(found.residual).square())


def _held(search: Search, part: Fitted, which: Sequence[bool]) -> Fitted | None:
    """A fit with the inputs of some runs that change far held the other way."""
    runs = search.problem.recording.runs or ()
    holds = [
        run.holds | {name: MISTAKEN[run.holds[name]] for name in _far(run)} if other else run.hold
        for run, other in zip(runs, which, strict=True)
    ]
    return _refitted(search, part, search.problem.recording.with_hold(holds), {})


def _refitted(search: Search, part: Fitted, twin: Recording, freed: Mapping[str, float]) -> Fitted | None:
    """A fit to another recording of the same data, with values free that were given; None if there is none."""
    bound = part.problem.simulator
    if not isinstance(bound, Trajectories):
        return None
    known = part.by_name | dict(freed)
    names = {part.problem.parameters[i].name for i in part.free} | set(freed)
    try:
        again = Trajectories(bound.ode, twin, subdivide=bound.subdivide, denser=bound.denser, implicit=bound.implicit)
        problem = dataclasses.replace(part.problem, recording=twin, simulator=again)
        begin: Tensor = torch.tensor([[known[q.name] for q in problem.parameters]], dtype=torch.float64)
        free = [i for i, q in enumerate(problem.parameters) if q.name in names]
        return fit(problem, search.noise.whitening(problem), begin, free)
    except (SimulatorError, DomainError):
        return None


def _noise_alone(search: Search, found: Fitted, noise: Noise | None = None, least: float = NOISE) -> bool:
    return analyse(Residual(found, noise or search.noise, seed=search.seed)).p_value >= least


def _rmse(found: Fitted) -> float:
    return float(found.residual.square().mean().sqrt())
