"""What was given beside the outputs: initial values, and how inputs go on between samples."""

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from torchcal.data import Recording, Run
from torchcal.discovery.fitting import Fitted, fit
from torchcal.discovery.likeliest import settled
from torchcal.discovery.residual import Residual
from torchcal.discovery.search import Search
from torchcal.discovery.structure import analyse
from torchcal.errors import SimulatorError
from torchcal.simulators import Trajectories
from torchcal.simulators.layout import initial_name

__all__ = ["evidence", "from_samples", "held_otherwise", "other_hold"]

#: Probability by chance of what is left, from which on it is noise; and noise sd up to which an initial value that is
#: found free is the one that was given.
NOISE, CONFIRMED = 0.05, 0.2
#: Change of an input from sample to sample, in its sd, from which on it matters how it goes on between them.
FAR = 0.5
#: How inputs may go on that go on in a way that can be mistaken for it.
MISTAKEN = {"linear": "zero", "zero": "linear"}
#: Log evidence, and share of that of the best model, from which on another hold is told of.
TOLD, AS_MUCH = 10.0, 0.5


def from_samples(search: Search) -> list[str]:
    """Initial values that were given as the first sample recorded, in words, where noise alone is left without them."""
    base, recording = search.base, search.problem.recording
    bound = base.problem.simulator
    if search.exact or search.stop.is_set() or recording.runs is None or not isinstance(bound, Trajectories):
        return []
    shown = [
        [name for name, value in run.initial.items()
         if name in run.outputs and name not in bound.ode.initial and value == float(run.outputs[name][0])]
        for run in recording.runs
    ]  # fmt: skip
    taken = {
        initial_name(name, r, len(recording.runs)): (name, r, run.initial[name])
        for r, (run, names) in enumerate(zip(recording.runs, shown, strict=True)) for name in names
    }  # fmt: skip
    if not taken:
        return []
    found = _refitted(search, recording.without_initial(shown), {full: value for full, (_, _, value) in taken.items()})
    if found is None or not _noise_alone(search, found):
        return []
    sd = recording.split(search.noise.sd)
    moved = [
        full for full, (name, r, value) in taken.items()
        if abs(found.by_name[full] - value) > CONFIRMED * float(sd[name][recording.x["run"] == r].median())  # type: ignore[index]
    ]  # fmt: skip
    if not moved:
        return []
    it, was = ("it", "was") if len(moved) == 1 else ("them", "were")
    return [
        f"{', '.join(moved)} {was} given as the first value recorded, noise and all: with {it} unknown (left out of "
        "initial=) the base leaves no more than noise"
    ]


def other_hold(search: Search) -> Fitted | None:
    """The base with inputs that change far between samples held the other way there, refitted; None where none do.

    Its evidence is the base's own: it has no parameter more. Computed once for a base.
    """
    base, recording = search.base, search.problem.recording
    if id(base) not in search.otherwise:  # the base is kept beside it, so that its id stays its own
        changed = [MISTAKEN[run.hold] if _far(run) else run.hold for run in recording.runs or ()]
        known = search.stop.is_set() or changed == [run.hold for run in recording.runs or ()]
        found = None if known else _refitted(search, recording.with_hold(changed), {})
        search.otherwise[id(base)] = base, found
    return search.otherwise[id(base)][1]


def held_otherwise(search: Search) -> list[str]:
    """How much better the base is with inputs held the other way between samples, in words."""
    found = other_hold(search)
    if found is None:
        return []
    leader, begun = search.physical_leader, evidence(search, search.base)
    best = 0.0 if leader is None else evidence(search, leader.found) + leader.price - begun
    if evidence(search, found) - begun < max(TOLD, AS_MUCH * best):
        return []
    holds = {run.hold for run in found.problem.recording.runs or () if _far(run)}
    how = f"hold='{holds.pop()}'" if len(holds) == 1 else "the other hold= in each"
    left = f"the base's RMSE is {_rmse(found):.4g} in place of {_rmse(search.base):.4g}"
    if not search.exact and _noise_alone(search, found):
        left = "the base leaves no more than noise"
    return [f"inputs change far from sample to sample: with {how} between them {left}"]


def evidence(search: Search, found: Fitted) -> float:
    """Log evidence of a fit, up to a constant and without its price; with its own noise where that is unknown."""
    return settled(found, search.noise, search.tangents)[1] if search.noise.open else search.gain(found.chi2)


def _far(run: Run) -> bool:
    """Whether an input changes so far between samples that it matters how it goes on there."""
    return run.hold in MISTAKEN and any(
        float(values.diff().abs().max()) > FAR * float(values.std()) > 0 for values in run.inputs.values()
    )


def _refitted(search: Search, twin: Recording, freed: Mapping[str, float]) -> Fitted | None:
    """The base fitted to another recording of the same data, with values free that were given; None if it cannot be."""
    base, bound = search.base, search.base.problem.simulator
    if not isinstance(bound, Trajectories):
        return None
    known = base.by_name | dict(freed)
    names = {base.problem.parameters[i].name for i in base.free} | set(freed)
    try:
        again = Trajectories(
            bound.ode, twin, subdivide=bound.subdivide, denser=bound.denser, implicit=bound.implicit
        )  # fmt: skip
        problem = dataclasses.replace(base.problem, recording=twin, simulator=again)
        begin: Tensor = torch.tensor([[known[q.name] for q in problem.parameters]], dtype=torch.float64)
        free = [i for i, q in enumerate(problem.parameters) if q.name in names]
        return fit(problem, search.noise.whitening(problem), begin, free)
    except SimulatorError:
        return None


def _noise_alone(search: Search, found: Fitted) -> bool:
    return analyse(Residual(found, search.noise, seed=search.seed)).p_value >= NOISE


def _rmse(found: Fitted) -> float:
    return float(found.residual.square().mean().sqrt())
