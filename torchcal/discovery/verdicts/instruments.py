"""Why what a model takes for an instrument is none."""

import dataclasses
import math

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import spread_values
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.fits.local import is_window
from torchcal.discovery.fits.readings import Reading, are_instruments
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.own_noise import beside
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.channels import RUN
from torchcal.discovery.verdicts.explain import stated_sd
from torchcal.terms import extend

__all__ = [
    "bends_to_physics", "no_instrument", "only_instruments", "reads_otherwise", "unnatural", "which_instruments",
]  # fmt: skip

#: Noise sd by which an instrument's reading must fall while the true value rises to be no instrument's: a hard limit is
#: one. And the least sd, in the data's spread.
FALL, ROUNDING = 2.0, 1e-3
#: Variation that an instrument may add, in that of what it measures: with more it is another model of the thing.
ADDED = 1.0
#: Share of what the true value varies by that an instrument shows at least, beside other terms, at so many of the data:
#: alone it may be set to another range, and what saturates shows less beyond some value.
SHOWN, AT_MOST = 0.4, 2 / 3
#: Share of the range of the true values by which it is looked at beyond them.
BEYOND = 0.2
#: Noise sd, together, by which a reading must leave a straight line at the recorded values, but for so many of them.
SEEN, FEW = 2.0, 2
#: Times the recorded range in which it is looked for bends, and the share of that up to which what a straight line
#: leaves is rounding.
FAR, STRAIGHT = 3.0, 1e-9
#: Share of the smallest value read at which a reading is looked at near zero.
NEAR = 0.01
#: Joint sd of an estimate and of what it is in nature, from which on it is not that.
APART = 2.0
#: Log odds by which a change of the output must be likelier than one of anything else for several errors of one
#: instrument: those that were planted had -0.4 to 640 (small ones the least; less where another output shares the
#: base's parameters), and what stood for physics that no list had -15 to 0.4.
OUTPUT = 1.0
#: Sd by which an instrument's size beside other terms is off that alone from which on it is no property of its own.
OFF = 3.0


def unnatural(model: Model) -> str:
    """Which estimate of a model's terms is not what these have in nature, in a sentence; empty if all are."""
    values, sd = model.found.by_name, dict(zip(model.found.by_name, stated_sd(model.found).tolist(), strict=True))
    for term in model.candidate.terms:
        for name, (expected, spread) in term.expected.items():
            full = term.full(name)
            off, nature = abs(values[full] - expected), f"In nature {full} is {expected:g} within {spread:g}, and"
            if off > APART * math.hypot(spread, sd[full]):
                return f"{nature} not {values[full]:.2g} ± {sd[full]:.1g}: something else may have left as much."
            undetermined = not sd[full] < off  # at a fold its sd says nothing
            if undetermined and off > APART * spread and _worse_at(model, full, expected) > APART**2:
                return f"{nature} with that the fit is worse: something else may have left as much."
    return ""


def _worse_at(model: Model, name: str, value: float) -> float:
    """How much larger χ² is with one parameter of a model's terms held at a value."""
    found, candidate = model.found, model.candidate
    place = [q.name for q in found.problem.parameters].index(name)
    begin = found.values.expand(1 + len(candidate.shapes), -1).clone()
    shapes = candidate.shape_places
    begin[1:, shapes] = candidate.shapes[:, [candidate.own.index(i) for i in shapes]]
    begin[:, place] = value
    held = fit(found.problem, found.whitening, begin, [i for i in found.free if i != place])
    return math.inf if held is None else held.chi2 - found.chi2


def only_instruments(model: Model) -> bool:
    """Whether all that a model adds is instruments."""
    return all(which_instruments(model))


def reads_otherwise(model: Model, larger: Model) -> str:
    """Whether instruments alone are of another size than in a likelier model that adds more, in a sentence; empty if
    not.

    Its error is no smaller than that of the difference (Hausman 1978, Econometrica 46, 1251-1271).
    """
    if not only_instruments(model):
        return ""
    sd = dict(zip(larger.found.by_name, stated_sd(larger.found).tolist(), strict=True))
    names = [q.name for q in model.candidate.problem.parameters]
    for name in (names[i] for i in model.candidate.amplitudes):
        alone, beside_others = model.found.by_name[name], larger.found.by_name[name]
        if sd[name] > 0 and abs(alone - beside_others) > OFF * sd[name]:
            others = " and ".join(other for other in larger.names if other not in model.names)
            return (
                f"Alone {name} is {alone:.3g}, and beside {others}, which is likelier, {beside_others:.3g}: no error "
                "of one instrument, but what none of the terms does."
            )
    return ""


def bends_to_physics(search: Search, model: Model) -> str:
    """Whether several errors of one instrument may stand for a change of something else, in a sentence; empty if not.

    Together they are nearly any curve of what is read. So is an unknown smooth change, of the output or of the physics
    behind it: the data have to tell that it is the output.
    """
    terms, places, recorded = model.candidate.terms, search.structure.places, search.problem.recording.outputs
    outputs = {name if name in recorded else recorded[0] for term in terms for name in term.outputs}
    if len(terms) < 2 or len(outputs) != 1 or any(term.states for term in terms) or not only_instruments(model):
        return ""
    output = outputs.pop()
    inside = [p.evidence for p in places if p.channel.kind == "output" and p.channel.target == output]
    others = [p for p in places if p.channel.kind != "output" or p.channel.target != output]
    rival = max(others, key=lambda p: p.evidence, default=None)
    lead = max(inside, default=0.0)
    if rival is None or rival.evidence <= 0 or lead > rival.evidence + OUTPUT:
        return ""
    along = "from run to run" if rival.driver == RUN else f"along {rival.driver}"
    well = "nearly as well" if lead > rival.evidence else "as well"
    return (
        f"Several errors of one instrument follow nearly any curve, and an unknown change of the {rival.channel.kind} "
        f"{rival.channel.target} {along} would do {well} as one of what {output} reads: a check of that instrument "
        "would tell. Physics is written by shifts= of parameters or by rates=: what outputs= makes of a reading alone "
        "counts as an instrument."
    )


def which_instruments(model: Model) -> list[bool]:
    """Which terms of a model are instruments, see `are_instruments`."""
    found = model.found
    drivers = found.problem.drivers_at_data(found.values[None], found.warm)
    return are_instruments(found.problem, model.candidate.terms, found.values, drivers)


def no_instrument(search: Search, model: Model) -> str:
    """Why a model's instruments are none: the reading of one falls where the true value rises, shows more of the
    instrument than of what it measures, or little of that."""
    problem = model.found.problem
    instruments = [term for term in model.candidate.terms if term.is_sensor and not term.states]
    if not instruments:
        return ""
    others = [term for term in model.candidate.terms if term not in instruments]
    bare = search.problem.with_simulator(extend(search.problem.simulator, others))
    bare = dataclasses.replace(bare, keep=problem.keep)
    values = spread_values(bare, [q.name for q in problem.parameters], model.found.values)
    true = bare.evaluate(values[None], [], bare.guess(model.found.warm, values[None]))[0][0]
    drivers = problem.drivers_at_data(model.found.values[None], model.found.warm)
    p = problem.parameters_at_data(model.found.values)
    sd = _noise_at_data(search, model)
    names = [q.name for q in problem.parameters]
    shapes = set(model.candidate.own) - set(model.candidate.amplitudes)
    for term in instruments:
        for name, function in term.outputs.items():
            number = problem.recording.outputs.index(name) if name in problem.recording.outputs else 0
            here = (problem.output_of == number).nonzero()[:, 0]
            along = {d: each[here] for d, each in drivers.items()}
            reading = Reading(problem, term, function, along, p.at(here))
            if not (len(here) and reading.works):
                continue
            curve = reading.is_of_value()
            if curve and _falls(reading, true[here]) > FALL * float(sd[here].median()):
                return (
                    f"By it the reading of {name} falls where the true value rises, at the recorded values or just "
                    "beyond them, as that of no instrument does."
                )
            shown = reading(true[here])
            drifts = curve or (problem.in_time and reading.is_of_value(and_time=True))
            if drifts and float((shown - true[here]).std()) > ADDED * float(true[here].std()):
                return f"By it the reading of {name} varies more by the instrument's error than by the true value."
            beside_others = curve and len(model.candidate.terms) > 1
            if beside_others and float(_slope(reading, true[here]).quantile(AT_MOST)) < SHOWN:
                return (
                    f"By it the reading of {name} shows less than {SHOWN:.0%} of what the true value varies by, as "
                    "that of hardly any instrument does."
                )
            shaped = curve and any(term.brings(names[i]) and not is_window(names[i]) for i in shapes)
            if shaped and _bends(reading, true[here]) and _straight(reading, true[here], sd[here]):
                return (
                    f"By it the reading of {name} is a straight line at the recorded values, or one on either side of "
                    "zero, as with an offset, a gain error or a jump: where it bends there are hardly any data."
                )
            true[here] = shown
    return ""


def _bends(reading: Reading, true: Tensor) -> bool:
    """Whether a reading is no straight line of the true value near the recorded ones, as with an offset or a gain
    error."""
    middle = true.mean()
    wide = middle + FAR * (_range(true) - middle)
    for y in (true, wide):
        shown = reading(y)
        if not bool(shown.isfinite().all()):
            return True
        if float(_off_line(y, shown).abs().max()) > STRAIGHT * float(wide.max() - wide.min()):
            return True
    return False


def _straight(reading: Reading, true: Tensor, sd: Tensor) -> bool:
    """Whether a reading follows a straight line at the recorded values, but for a few, as far as noise shows: one as
    steep on either side of zero where these are of both signs, as what saturates is beyond all of them."""
    kept, shown = torch.ones_like(true, dtype=torch.bool), reading(true)
    if not bool(shown.isfinite().all()):
        return False
    sides = _steepest_at_zero(reading, true)
    for _ in range(FEW):
        off = torch.zeros_like(true)
        off[kept] = (_off_line(true[kept], shown[kept], sides=sides) / sd[kept]).abs()
        kept &= true != true[off.argmax()]
    return float((_off_line(true[kept], shown[kept], sides=sides) / sd[kept]).norm()) < SEEN


def _steepest_at_zero(reading: Reading, true: Tensor) -> bool:
    """Whether values of both signs are read, and a reading rises faster near zero than from one to the other end of
    those of a sign, as that of what saturates does."""
    if not (bool((true > 0).any()) and bool((true < 0).any())):
        return False
    near, far = (NEAR * true.abs()[true != 0].min()).expand_as(true), true.max().expand_as(true)
    rise = ((reading(near) - reading(-near)) / (2 * near)).median()
    return bool(rise > ((reading(far) - reading(near)) / (far - near)).median())


def _off_line(y: Tensor, shown: Tensor, *, sides: bool = False) -> Tensor:
    """What a straight line through readings of true values leaves, ``(m,)``; or one on either side of zero, both as
    steep."""
    line = torch.stack([torch.ones_like(y), y] + ([y.sign()] if sides else []), dim=-1)
    return shown - line @ torch.linalg.lstsq(line, shown[:, None], driver="gelsd").solution[:, 0]


def _noise_at_data(search: Search, model: Model) -> Tensor:
    """Sd of the noise, or of what a model leaves where there is none, ``(n,)``."""
    problem = model.found.problem
    if not search.exact:
        return beside(search, model).sd[problem.index]
    left = torch.zeros(problem.n, dtype=torch.float64)
    for output in problem.output_of.unique():
        mine = problem.output_of == output
        left[mine] = model.found.residual[mine].square().mean().sqrt()
    return torch.maximum(left, ROUNDING * problem.recording.spread[problem.index])


def _range(true: Tensor) -> Tensor:
    """As many values from somewhat below the true ones ``(m,)`` to somewhat above, but not beyond 0 if all are on one
    side of it: a fit likes the turning point of a response, where it bends most, and stops just short of it."""
    low, high = true.min(), true.max()
    beyond = BEYOND * (high - low)
    return torch.linspace(
        float((low - beyond).clamp_min(0) if low >= 0 else low - beyond),
        float((high + beyond).clamp_max(0) if high <= 0 else high + beyond),
        len(true),
        dtype=true.dtype,
    )


def _falls(reading: Reading, true: Tensor) -> float:
    """By how much a reading falls while the true value rises, at the recorded values or just beyond them."""
    y = _range(true)
    slope = _slope(reading, y)
    return -float((y.diff() * 0.5 * (slope[:-1] + slope[1:]).clamp_max(0)).nansum())


def _slope(reading: Reading, y: Tensor) -> Tensor:
    """Of what is shown by what is true, ``(m,)``; 0 where the one does not follow from the other."""
    with torch.enable_grad():
        leaf = y.detach().clone().requires_grad_(True)
        return torch.autograd.grad(reading(leaf).sum(), leaf)[0].detach()
