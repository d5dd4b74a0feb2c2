"""Ranges in which shape parameters are sought that are measured on the scale of a driver."""

import dataclasses
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.problem import Problem
from torchcal.errors import DomainError
from torchcal.simulators import Parameter, Trajectories
from torchcal.terms import Term

__all__ = [
    "NOTHING", "Anything", "Scale", "check_measured", "drivers_scale", "sized", "sized_again", "with_room",
]  # fmt: skip

#: Range of a shape parameter measured on a driver's scale; on that of time it begins at a share of the usual gap
#: between samples where that is less: lags and delays may be as fast as these show, however long the recording.
SCALE_RANGE, OF_A_GAP = (0.02, 1.0), 0.1
#: How many times as far a fit may go that an end of such a range holds back: nobody gave that end.
WIDER = 4.0
#: How many times as large a driver must be beside a model as at the base for a shape to be sought there too.
LARGER = 2.0


class Scale(dict[str, float]):
    """Largest magnitudes by name, and what they are the largest of.

    Args:
        sizes: By name.
        drivers: Values on the calibrated trajectory, all of one shape but what does not vary in it.
    """

    def __init__(self, sizes: Mapping[str, float], drivers: Mapping[str, Tensor]) -> None:
        super().__init__(sizes)
        self.drivers = drivers

    def together(self, names: Sequence[str]) -> float:
        """The largest length of the vector of several."""
        if len(names) == 1:
            return self[names[0]]
        values = torch.broadcast_tensors(*(self.drivers[name] for name in names))
        return float(torch.stack(values).square().sum(0).sqrt().max())


class Anything(Scale):
    """A scale of 1 for everything, before anything is calibrated."""

    def __init__(self) -> None:
        super().__init__({}, {})

    def __missing__(self, name: str) -> float:
        return 1.0

    def together(self, names: Sequence[str]) -> float:
        """1."""
        return 1.0


#: For terms that measure nothing, or have been measured.
NOTHING = Scale({}, {})


def drivers_scale(problem: Problem, found: Fitted) -> Scale:
    """Largest magnitude of every driver and output on the calibrated trajectory; of time the longest run's length."""
    drivers = {
        name: values
        for name, values in problem.drivers(found.values[None], found.warm).items()
        if bool(torch.isfinite(values).all())
    }
    scale = Scale({name: float(values.abs().max()) for name, values in drivers.items()}, drivers)
    if "t" in scale and problem.recording.runs:
        scale["t"] = max(float(run.time[-1] - run.time[0]) for run in problem.recording.runs)
    for number, name in enumerate(problem.recording.outputs):
        scale.setdefault(name, float(found.y[problem.output_of == number].abs().max()))
    return scale


def check_measured(problem: Problem, term: Term) -> None:
    """Raise if a term names a driver, an output or an input that there is not.

    Raises:
        DomainError: If it does.
    """
    recording, bound = problem.recording, problem.simulator
    inputs = list(recording.runs[0].inputs) if recording.runs else []
    if term.takes is not None and term.takes not in inputs:
        raise DomainError(
            f"Expected the term {term.name!r} to take the effect of one of the inputs {inputs}. Got {term.takes!r}."
        )
    if isinstance(bound, Trajectories):
        conditions = ["t", *bound.ode.states, *inputs]
    elif problem.in_time:
        conditions = ["t"]
    else:
        conditions = list(recording.x) if isinstance(recording.x, dict) else ["x"]
    known = list(dict.fromkeys([*conditions, *recording.outputs]))
    drivers: dict[str, tuple[str, ...]] = {name: (driver,) for name, driver in term.scales.items()}
    for name, given in term.constants.items():
        drivers[name] = (given,) if isinstance(given, str) else given if isinstance(given, tuple) else ()
    for name, several in drivers.items():
        among = known if len(several) == 1 else conditions  # vectors are made of what varies along the data
        if unknown := [driver for driver in several if driver not in among]:
            raise DomainError(
                f"Expected the term {term.name!r} to measure {name!r} on the scale of some of {among}. Got "
                f"{unknown[0]!r}."
            )


def sized(term: Term, scale: Scale, recording: Recording) -> Term:
    """The term with bounds for the shape parameters, and numbers for the constants, that it measures on a scale."""
    if "t" in scale and term.elapsed == "recording":
        times = [run.time for run in recording.runs or ()]
        length = float(max(time[-1] for time in times) - min(time[0] for time in times))
        scale = Scale({**scale, "t": length}, scale.drivers)
    term = _with_numbers(term, scale)
    if not term.scales:
        return term
    steps = [run.time.diff() for run in recording.runs or () if len(run.time) > 1]
    gaps = [float(torch.cat(steps).median())] if steps else []
    parameters = []
    for parameter in term.parameters:
        driver = term.scales.get(parameter.name)
        if driver is None or (parameter.low is not None and parameter.high is not None):
            parameters.append(parameter)
            continue
        size = scale[driver] or 1.0
        low, high = (part * size for part in SCALE_RANGE)
        if driver == "t":
            low = min([low, *(OF_A_GAP * gap for gap in gaps)])
        low, high = _narrowed(low, high, parameter)
        initial = parameter.initial if parameter.initial is not None and low <= parameter.initial <= high else None
        parameters.append(dataclasses.replace(parameter, low=low, high=high, initial=initial, neutral=None))
    return dataclasses.replace(term, parameters=tuple(parameters))


def sized_again(term: Term, given: Term, scale: Scale, recording: Recording) -> Term:
    """A sized term with shapes that may lie as far as another scale goes, where that goes much farther, else itself: on
    a base that is bent a driver may be far smaller than with the term that was missing.

    Args:
        term: As `sized` by the base.
        given: As the user gave it.
        scale: The other scale.
        recording: The recording.
    """
    if not given.scales:
        return term
    again = sized(dataclasses.replace(given, constants=term.constants, formula=term.formula), scale, recording)
    parameters = [
        dataclasses.replace(q, high=other.high)
        if own.high is None and q.high is not None and other.high is not None and other.high > LARGER * q.high > 0
        else q
        for q, own, other in zip(term.parameters, given.parameters, again.parameters, strict=True)
    ]
    same = all(one is other for one, other in zip(parameters, term.parameters, strict=True))
    return term if same else dataclasses.replace(term, parameters=tuple(parameters))


def _with_numbers(term: Term, scale: Scale) -> Term:
    """The term with numbers for its constants, which its formula tells."""
    numbers = {}
    for name, drivers in term.constants.items():
        if isinstance(drivers, float):
            continue
        drivers = (drivers,) if isinstance(drivers, str) else drivers
        numbers[name] = float(f"{scale.together(drivers) or 1.0:.3g}")
    if not numbers:
        return term
    told = "".join(f", {name} = {value:g}" for name, value in numbers.items())
    return dataclasses.replace(term, constants=term.constants | numbers, formula=term.formula and term.formula + told)


def _narrowed(low: float, high: float, parameter: Parameter) -> tuple[float, float]:
    """A range of a driver's scale within the one bound that a parameter has, or else beside it."""
    ratio = high / low
    if parameter.low is not None and parameter.low > low:
        return parameter.low, high if high > parameter.low else ratio * parameter.low
    if parameter.high is not None and parameter.high < high:
        below = parameter.high / ratio if parameter.high > 0 else parameter.high - high
        return low if low < parameter.high else below, parameter.high
    return low, high


def with_room(sought: Parameter, given: Parameter) -> Parameter:
    """A parameter with more room than it was sought in, but for an end that was given."""
    low, high = sought.low or 0.0, sought.high or 0.0
    more = (WIDER - 1) * (high - low)
    low, high = low / WIDER if low > 0 else low - more, WIDER * high if high > 0 else high + more
    low = low if given.low is None else max(low, given.low)
    high = high if given.high is None else min(high, given.high)
    return dataclasses.replace(sought, low=low, high=high)
