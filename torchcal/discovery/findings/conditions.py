"""The experiments that are tried in thought: first what is close to the recording, then what is bolder."""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchcal.data import Recording, Run
from torchcal.discovery.findings.feasible import Feasible
from torchcal.discovery.fits.fitting import Fitted
from torchcal.display import between, placed, unit_of, units_of, with_unit
from torchcal.simulators import Trajectories

__all__ = ["Option", "bolder", "denser", "simple"]

#: Below which no temperature goes, by unit.
ABSOLUTE_ZERO = {
    "K": 0.0, "kelvin": 0.0,
    "degC": -273.15, "°C": -273.15, "celsius": -273.15, "degree_Celsius": -273.15,
    "degF": -459.67, "°F": -459.67, "fahrenheit": -459.67, "degree_Fahrenheit": -459.67,
}  # fmt: skip
#: Multiples of initial states and inputs, those that are bolder, and that of one state alone.
MULTIPLES, BOLD, ALONE = (1.5, 2.0, 0.5, 3.0), (5.0,), 3.0
#: How far beyond its range a condition goes, in the width of that, and how far in a bolder experiment.
BEYOND, FAR_BEYOND = 0.5, 1.5
#: Bolder experiments on a static recording at most, those that move one condition first.
MOST = 60
#: Samples of a run at least that is cut where time is not feasible any more.
SHORTEST = 5
#: Share of its largest value up to which a state begins at nothing, of which a multiple is nothing too.
NOTHING = 0.01

#: Where every experiment can be made.
ANYWHERE = Feasible()

Option = tuple[str, Recording, dict[str, Any]]
"""An experiment in words, a recording of it without data, and its conditions as `Experiment` holds them."""


@dataclass(frozen=True)
class _Begin:
    """Where the first run begins.

    Attributes:
        values: Of every state that an experiment may choose.
        zero: What multiples of it are counted from: 0, of a temperature the lowest in any run.
        largest: Its value farthest from there in any run.
        mirrored: Whether all of them may be mirrored.
        known: What has to be known of it that the first run did not tell, in words.
        elsewhere: Where that is not, as it is not feasible, in words.
    """

    values: dict[str, float]
    zero: dict[str, float]
    largest: dict[str, float]
    mirrored: bool
    known: str
    elsewhere: str

    @property
    def ask(self) -> str:
        """What is to be said of a run that begins where the first did."""
        return self.known + self.elsewhere

    @property
    def moves(self) -> bool:
        """Whether a multiple of them is another beginning."""
        return any(value != self.zero[name] for name, value in self.values.items())

    @property
    def counted(self) -> str:
        """What multiples are counted from where that is not 0, in words."""
        return _counted({name: zero for name, zero in self.zero.items() if self.values[name] != zero})

    def times(self, factor: float, names: Iterable[str] | None = None) -> dict[str, float]:
        """Some multiple of all of them, or of some."""
        chosen = set(self.values if names is None else names)
        return {
            name: self.zero[name] + factor * (value - self.zero[name]) if name in chosen else value
            for name, value in self.values.items()
        }


def _counted(zero: Mapping[str, float]) -> str:
    told = [f"{name} counted from {value:.4g}" for name, value in zero.items() if value]
    return f" ({', '.join(told)})" if told else ""


def simple(model: Fitted, feasible: Feasible = ANYWHERE) -> list[Option]:
    """Experiments close to the recording.

    Runs are repeated with other initial states, stronger or weaker inputs, both, or for longer, or with one of them at
    an end of what is feasible; static conditions are gathered in a third of their range, or moved just beyond it.
    """
    recording = model.problem.recording
    if not model.problem.in_time:
        return _allowed(recording, _static(recording, feasible), feasible)
    begin = _states(model, feasible)
    options = [_run(recording, "the first run again" + begin.ask, begin.values)]
    options += _elsewhere(recording, begin, (*MULTIPLES, -1.0) if begin.mirrored else MULTIPLES)
    options += _stronger(recording, begin, MULTIPLES)
    options.append(_run(recording, f"a run three times as long as the first{begin.ask}", begin.values, copies=3))
    if begin.moves:
        text = f"a run that starts from 2 times the initial states{begin.counted} and is twice as long{begin.known}"
        options.append(_run(recording, text, begin.times(2.0), copies=2))
    return _allowed(recording, [*options, *_at_ends(recording, begin, feasible)], feasible)


def bolder(model: Fitted, feasible: Feasible = ANYWHERE) -> list[Option]:
    """Experiments farther from the recording, or less simple to do, for where the simple ones tell too little.

    Runs begin with one state alone elsewhere, or with all far off; inputs are much stronger, steady, faster or slower.
    Static conditions are moved far beyond their range, or two of them together.
    """
    recording = model.problem.recording
    if not model.problem.in_time:
        return _allowed(recording, _static_bolder(recording, feasible), feasible)
    begin = _states(model, feasible)
    values, ask = begin.values, begin.ask
    options = _elsewhere(recording, begin, BOLD)
    for name, value in values.items():
        others = _ask(recording, [one for one in values if one != name])
        zero, largest = begin.zero[name], begin.largest[name]
        at_rest = abs(value - zero) <= NOTHING * abs(largest - zero)
        if at_rest and largest != zero:
            text = f"a run that starts from {name} = {largest:.3g}, all else as in the first{others}"
            options.append(_run(recording, text, {**values, name: float(f"{largest:.3g}")}))
        elif not at_rest and len(values) > 1:  # of one state alone this is a multiple of all initial states
            initial = f"the initial {name} of the first{_counted({name: zero})}"
            text = f"a run that starts from {ALONE:g} times {initial}, all else as there{begin.known}"
            options.append(_run(recording, text, begin.times(ALONE, [name])))
    options += _stronger(recording, begin, BOLD)
    if _runs(recording)[0].inputs:
        lowest = _zeros(recording)

        def steady(name: str, given: Tensor) -> Tensor:
            return torch.full_like(given, float(given[int((given - lowest[name]).abs().argmax())]))

        options.append(_run(recording, f"a run with the inputs held at their largest{ask}", values, change=steady))
        for factor, text in ((2.0, "twice as slowly"), (0.5, "twice as fast")):
            options.append(_run(recording, f"a run with the inputs of the first {text}{ask}", values, slower=factor))
    return _allowed(recording, options, feasible)


def denser(option: Option, recording: Recording, times: int) -> Option:
    """The same with more samples: in time between the others, else of the same conditions."""
    description, _, conditions = option
    if "x" in conditions:
        x = {name: values.repeat_interleave(times) for name, values in conditions["x"].items()}
        return f"{description}, each {times} times", _blank(recording, x), {"x": x}
    run = _blank_run(recording, conditions)
    place = torch.arange((len(run.time) - 1) * times + 1, dtype=torch.float64) / times
    left = place.long().clamp(max=len(run.time) - 2)
    time = run.time[left] + (place - left) * run.time.diff()[left]
    dense = {"time": time, "initial": conditions["initial"], "inputs": run.inputs_at(time)}
    text = f"{description}, sampled {times} times as densely"
    return text, Recording(runs=[_blank_run(recording, dense)]), dense


def _allowed(recording: Recording, options: Sequence[Option], feasible: Feasible) -> list[Option]:
    """Those that are feasible, runs for as long as that is."""
    return [option for option in (_cut(recording, one, feasible) for one in options) if feasible.allows(option[1])]


def _cut(recording: Recording, option: Option, feasible: Feasible) -> Option:
    """A run until the last time that is feasible; as it is where no more than the first would be left of a longer one.
    """
    text, _, chosen = option
    last = feasible.get("t", (math.inf,))[-1]
    if recording.runs is None or float(chosen["time"][-1]) <= last:
        return option
    first = float(recording.runs[0].time[-1])
    if last <= first < float(chosen["time"][-1]):
        return option
    kept = chosen["time"] <= last
    if int(kept.sum()) < SHORTEST:
        return option
    inputs = {name: values[kept] for name, values in chosen["inputs"].items()}
    chosen = {**chosen, "time": chosen["time"][kept], "inputs": inputs}
    until = with_unit(f"{last:.4g}", unit_of("t", units_of(recording, None)))
    return f"{text}, until t = {until}", Recording(runs=[_blank_run(recording, chosen)]), chosen


def _at_ends(recording: Recording, begin: _Begin, feasible: Feasible) -> list[Option]:
    """Runs that begin with one state, or have one input held, at an end of what is feasible."""
    options = []
    for name, value in begin.values.items():
        others = _ask(recording, [one for one in begin.values if one != name])
        for end in feasible.ends(name):
            if end != value:
                text = f"a run that starts from {name} = {end:.4g}, all else as in the first{others}"
                options.append(_run(recording, text, {**begin.values, name: end}))
    for name in _runs(recording)[0].inputs:
        for end in feasible.ends(name):
            def held(one: str, values: Tensor, name: str = name, end: float = end) -> Tensor:
                return torch.full_like(values, end) if one == name else values

            text = f"a run with {name} held at {end:.4g}{begin.ask}"
            options.append(_run(recording, text, begin.values, change=held))
    return options


def _runs(recording: Recording) -> tuple[Run, ...]:
    return tuple(recording.runs or ())


def _states(model: Fitted, feasible: Feasible) -> _Begin:
    """Of every state that an experiment may choose."""
    bound = model.problem.simulator
    if not isinstance(bound, Trajectories):
        return _Begin({}, {}, {}, False, "", "")
    states = bound.solve(model.values[None], model.warm)[0]
    places = {name: i for i, name in enumerate(bound.ode.states) if name not in bound.ode.initial}
    begin = {name: float(states[0, 0, i]) for name, i in places.items()}
    along = {name: states[..., i].flatten() for name, i in places.items()}
    zero = {name: _zero(values, bound.ode.states[name]) for name, values in along.items()}
    largest = {name: float(values[int((values - zero[name]).abs().argmax())]) for name, values in along.items()}
    # Only what has had either sign is mirrored: an absolute temperature or an amount cannot be.
    mirrored = bool(along) and all(bool((v < 0).any() and (v > 0).any()) for v in along.values())
    moved = {name: feasible.clipped(name, value) for name, value in begin.items()}
    told = [f"{name} = {moved[name]:.4g}" for name, value in begin.items() if moved[name] != value]
    elsewhere = f", but from {' and '.join(told)}" if told else ""
    known = _ask(model.problem.recording, begin)
    return _Begin(moved, zero, largest, mirrored and not any(zero.values()), known, elsewhere)


def _zero(values: Tensor, unit: str | None) -> float:
    """What multiples of a quantity are counted from: twice a temperature means nothing, twice a rise of it does."""
    lowest = float(values.min()) if unit in ABSOLUTE_ZERO else 0.0
    return 0.0 if abs(lowest) <= NOTHING * float(values.abs().max()) else lowest  # a difference that has faded


def _ask(recording: Recording, begin: Iterable[str]) -> str:
    """What has to be known that the first run did not tell."""
    unsaid = [name for name in begin if name not in _runs(recording)[0].initial]
    return f", with initial {', '.join(unsaid)} known from elsewhere" if unsaid else ""


def _elsewhere(recording: Recording, begin: _Begin, factors: tuple[float, ...]) -> list[Option]:
    """Runs from multiples of the initial states; none where these are no others."""
    text = f"a run that starts from {{:g}} times the initial states of the first{begin.counted}{begin.known}"
    able = factors if begin.moves else ()
    return [_run(recording, text.format(factor), begin.times(factor)) for factor in able]


def _stronger(recording: Recording, begin: _Begin, factors: tuple[float, ...]) -> list[Option]:
    """Runs with inputs of other sizes, and with inputs and initial states of other sizes."""
    inputs, zero = _runs(recording)[0].inputs, _zeros(recording)
    if all(bool((values == zero[name]).all()) for name, values in inputs.items()):
        return []

    def times(factor: float) -> Callable[[str, Tensor], Tensor]:
        return lambda name, values: zero[name] + factor * (values - zero[name])

    counted = _counted({name: zero[name] for name, values in inputs.items() if bool((values != zero[name]).any())})
    options = [
        _run(recording, f"a run with {factor:g} times the inputs of the first{counted}{begin.ask}", begin.values,
             change=times(factor))
        for factor in factors
    ]  # fmt: skip
    both = _counted({**zero, **begin.zero}) + begin.known
    for factor in factors if begin.moves else ():
        text = f"a run with {factor:g} times the inputs and initial states of the first{both}"
        options.append(_run(recording, text, begin.times(factor), change=times(factor)))
    return options


def _zeros(recording: Recording) -> dict[str, float]:
    """What multiples of every input are counted from."""
    runs = _runs(recording)
    return {
        name: _zero(torch.cat([run.inputs[name] for run in runs]), runs[0].units.get(name)) for name in runs[0].inputs
    }


def _run(
    recording: Recording,
    text: str,
    initial: Mapping[str, float],
    *,
    change: Callable[[str, Tensor], Tensor] | None = None,
    copies: int = 1,
    slower: float = 1.0,
) -> Option:
    """The first run with other initial states, changed inputs, several times in a row, or at another pace."""
    first = _runs(recording)[0]
    span = first.time[-1] - first.time[0]
    step = span / (len(first.time) - 1)
    time = torch.cat([first.time + k * (span + step) for k in range(copies)])
    time = time[0] + slower * (time - time[0])
    inputs = {k: (values if change is None else change(k, values)).repeat(copies) for k, values in first.inputs.items()}
    conditions = {"time": time, "initial": dict(initial), "inputs": inputs}
    return text, Recording(runs=[_blank_run(recording, conditions)]), conditions


def _blank_run(recording: Recording, conditions: Mapping[str, Any]) -> Run:
    blank = {name: torch.zeros(len(conditions["time"]), dtype=torch.float64) for name in recording.outputs}
    return Run(outputs=blank, hold=_runs(recording)[0].hold, **{**conditions, "inputs": conditions["inputs"] or None})


def _conditions(recording: Recording) -> dict[str, Tensor]:
    return recording.x if isinstance(recording.x, dict) else {"x": recording.x}


def _static(recording: Recording, feasible: Feasible) -> list[Option]:
    x = _conditions(recording)
    again = _moved(recording, "the same conditions again", {}, feasible)
    found = [again] if all(torch.equal(again[2]["x"][name], values) for name, values in x.items()) else []
    for name, values in x.items():
        cuts = values.quantile(torch.tensor([0.0, 1 / 3, 2 / 3, 1.0], dtype=values.dtype)).tolist()
        ranges = [feasible.within(name, a, b) for a, b in itertools.pairwise(cuts) if b > a]
        if len(feasible.ends(name)) > 1:
            ranges.append(feasible.within(name, *feasible[name]))
        thirds = [ends for ends in dict.fromkeys(ranges) if ends is not None]
        for text, ends in zip(between(thirds, "and"), thirds, strict=True):
            text = with_unit(f"conditions with {name} between {text}", recording.units.get(name))
            found.append(_moved(recording, text, {name: ends}, feasible))
    for name in x:
        for text, ends in _outside(recording, name, BEYOND, feasible):
            found.append(_moved(recording, f"conditions with {name} {text}", {name: ends}, feasible))
    return found


def _static_bolder(recording: Recording, feasible: Feasible) -> list[Option]:
    found = []
    names = list(_conditions(recording))
    for name in names:
        for text, ends in _outside(recording, name, FAR_BEYOND, feasible):
            found.append(_moved(recording, f"conditions with {name} {text}", {name: ends}, feasible))
    for one, other in itertools.combinations(names, 2):
        corners = itertools.product(*(_outside(recording, name, BEYOND, feasible) for name in (one, other)))
        for (first, ends), (second, others) in corners:
            text = f"conditions with {one} {first}, and {other} {second}"
            found.append(_moved(recording, text, {one: ends, other: others}, feasible))
    return found[:MOST]


def _outside(
    recording: Recording, name: str, share: float, feasible: Feasible
) -> list[tuple[str, tuple[float, float]]]:
    """The ranges above and below that of a condition, where there is any."""
    values = _conditions(recording)[name]
    low, high = float(values.min()), float(values.max())
    width = high - low
    if not width:  # one value tells nothing of how far others may be
        return []
    unit = recording.units.get(name)

    def to(end: float) -> str:
        return f"to {with_unit(placed(end, width), unit)}"

    above = feasible.clipped(name, high + share * width)
    found = [(f"above the recorded range, {to(above)}", (high, above))] if above > high else []
    # Of what spans decades a share of the width is below nothing; a factor is as far on their scale.
    below = low / (1 + 4 * share) if 0 < low < share * width else low - share * width
    below = feasible.clipped(name, max(below, ABSOLUTE_ZERO.get(unit or "", -math.inf)))
    if (below >= 0 or low < 0) and below < low:
        found.append((f"below the recorded range, {to(below)}", (below, low)))
    return found


def _moved(
    recording: Recording, text: str, ranges: Mapping[str, tuple[float, float]], feasible: Feasible
) -> Option:
    """As many conditions, those named evenly over new ranges, the second of two in an order that crosses the first; the
    others as they are, or as near to that as is feasible."""
    x = {
        name: values.clamp(feasible.clipped(name, -math.inf), feasible.clipped(name, math.inf))
        for name, values in _conditions(recording).items()
    }
    for k, (name, (first, last)) in enumerate(ranges.items()):
        along = torch.linspace(first, last, recording.n, dtype=torch.float64)
        x[name] = along if k == 0 else along[_crossed(recording.n)]
    return text, _blank(recording, x), {"x": x}


def _crossed(n: int) -> Tensor:
    """An order of n places that runs through them many times, so that it goes with no other order."""
    return (torch.arange(n, dtype=torch.float64) * (math.sqrt(5) - 1) / 2).frac().argsort()


def _blank(recording: Recording, x: dict[str, Tensor]) -> Recording:
    n = len(next(iter(x.values())))
    zeros = {name: torch.zeros(n, dtype=torch.float64) for name in recording.outputs}
    return Recording(x=x if isinstance(recording.x, dict) else x["x"], y=zeros)
