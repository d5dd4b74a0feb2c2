"""Candidates prepared for a recording: the extended simulator, which parameters are amplitudes, and their tangents."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.trial import check_repeats, place_of
from torchcal.errors import DomainError, SimulatorError
from torchcal.simulators import Parameter, free_parameters, is_value_of
from torchcal.terms import Term, extend
from torchcal.terms.term import neutral_of

__all__ = ["Candidate", "base_columns", "drivers_scale", "prepare", "spread_values", "widened"]

#: Points of a grid of shape parameters: along one, two, three and more of them.
GRID_POINTS = (1, 9, 5, 4)
#: Of a shape measured on a driver's scale, how many more lie at the driver's own values: thresholds do.
DRIVER_POINTS = (0, 7, 3, 2)
#: Of a shape that may lie anywhere, as nobody said where, how many more lie at the values of all drivers.
ANYWHERE_POINTS = (0, 6, 4, 2)
#: Points of the grid at most, and the fraction whose multiples spread them over all.
MOST_POINTS, GOLDEN = 256, 0.5 * (math.sqrt(5.0) - 1.0)
#: Range of a shape parameter measured on a driver's scale; on that of time it begins at a share of the usual gap
#: between samples where that is less: lags and delays may be as fast as these show, however long the recording.
SCALE_RANGE, OF_A_GAP = (0.02, 1.0), 0.1
#: How many times as far a fit may go that an end of such a range holds back: nobody gave that end.
WIDER = 4.0
#: Share of the data's spread that a candidate adds when it is tried.
A_LITTLE = 0.03
#: Change of the outputs, relative to their size, that counts as none.
UNCHANGED = 1e-6


@dataclass(frozen=True, eq=False)
class Candidate:
    """A term, or several, added to the base and looked at from the base's fit.

    Attributes:
        terms: The terms.
        problem: With the extended simulator.
        free: Places of all parameters that a refit frees.
        own: Places of the terms' parameters.
        amplitudes: Places among them whose neutral values switch the terms off.
        neutral: Neutral values of ``own`` (the middle of the bounds for a shape without one).
        shapes: Values of ``own`` on a grid of shapes, ``(G, len(own))``, amplitudes neutral.
        tangents: ∂y/∂amplitude at each shape, ``(G, n, len(amplitudes))``.
        begin: Base estimate with the terms at neutral, ``(P,)``.
        bent: Starting values ``(S, P)`` of one whose tangents are the base's, but whose larger effects are not.
    """

    terms: tuple[Term, ...]
    problem: Problem
    free: list[int]
    own: list[int]
    amplitudes: list[int]
    neutral: Tensor
    shapes: Tensor
    tangents: Tensor
    begin: Tensor
    bent: Tensor | None = None

    @property
    def name(self) -> str:
        """Names of its terms."""
        return " + ".join(term.name for term in self.terms)

    def one_sided(self, place: int) -> int:
        """+1 or −1 where physics lets the amplitude leave its neutral value to one side only, else 0."""
        parameter = self.problem.parameters[place]
        neutral = float(self.neutral[self.own.index(place)])
        if parameter.low is not None and parameter.low >= neutral - 1e-12 * abs(neutral):
            return 1
        if parameter.high is not None and parameter.high <= neutral + 1e-12 * abs(neutral):
            return -1
        return 0

    @property
    def acting(self) -> Tensor:
        """Values ``(P,)`` at which it acts a little, to first order, in the middle of its shapes."""
        values, middle = self.begin.clone(), len(self.shapes) // 2
        values[self.own] = self.shapes[middle]
        spread = float(self.problem.recording.spread[self.problem.index].norm())
        for a, place in enumerate(self.amplitudes):
            size = float(self.tangents[middle, :, a].norm())
            values[place] += A_LITTLE * (spread / size if size > 0 else 1.0) * (self.one_sided(place) or 1)
        low, high = self.problem.limits()
        for i in self.own:
            if self.problem.parameters[i].transform == "log" and values[i] <= 0:
                values[i] = A_LITTLE * self.begin[i]
        inside = torch.where((high - low).isfinite(), A_LITTLE * (high - low), torch.zeros_like(low))
        values[self.own] = values[self.own].clamp(low[self.own] + inside[self.own], high[self.own] - inside[self.own])
        return values

    @property
    def anywhere(self) -> dict[str, tuple[float, float]]:
        """Names of its shapes of which nobody says where they lie, and from where to where they are tried."""
        found = {}
        for i, tried in zip(self.own, self.shapes.T, strict=True):
            if i not in self.amplitudes and _anywhere(q := self.problem.parameters[i]):
                found[q.name] = float(tried.min()), float(tried.max())
        return found

    @property
    def blind(self) -> bool:
        """Whether the tangent at the neutral value vanishes or says nothing new, so that only a refit can tell."""
        return self.bent is not None or not bool((self.tangents.abs() > 0).any())


def base_columns(problem: Problem, fixed: Mapping[str, float] | None) -> tuple[list[int], dict[int, float]]:
    """Places of the free parameters, of which there may be none, and values of those held.

    Raises:
        EmbeddingError, DomainError: As `torchcal.simulators.free_parameters`.
    """
    free, held = free_parameters(problem.parameters, fixed, least=0)
    place = {q.name: i for i, q in enumerate(problem.parameters)}
    return [place[q.name] for q in free], {place[name]: value for name, value in held.items()}


def replaces(problem: Problem, values: Tensor, term: Term) -> bool:
    """Whether a term of a static simulator gives an output anew, whatever that was, by the base's values ``(P,)``.

    What other terms did to the output before is lost.
    """
    if problem.in_time or not term.outputs:
        return False
    x = problem.recording.x
    p = {q.name: value for q, value in zip(problem.parameters, values, strict=True)}
    p |= {q.name: values.new_tensor(_shape_points(q, 1)[0] if (at := neutral_of(q)) is None else at)
          for q in term.parameters}  # fmt: skip
    y = problem.recording.spread.new_ones(problem.recording.n)
    try:
        return any(torch.equal(f(x, p, y) + 0 * y, f(x, p, 2 * y) + 0 * y) for f in term.outputs.values())
    except Exception:  # a term that needs more than that is called by the simulator, which tells what is wrong
        return False


def drivers_scale(problem: Problem, found: Fitted) -> dict[str, float]:
    """Largest magnitude of every driver and output on the calibrated trajectory; of time the longest run's length."""
    scale = {
        name: float(values.abs().max())
        for name, values in problem.drivers(found.values[None], found.warm).items()
        if bool(torch.isfinite(values).all())
    }
    if "t" in scale and problem.recording.runs:
        scale["t"] = max(float(run.time[-1] - run.time[0]) for run in problem.recording.runs)
    for number, name in enumerate(problem.recording.outputs):
        scale.setdefault(name, float(found.y[problem.output_of == number].abs().max()))
    return scale


def sized(term: Term, scale: Mapping[str, float], recording: Recording) -> Term:
    """The term with bounds for the shape parameters that it measures on a driver's scale.

    Raises:
        DomainError: If it names a driver or an input that there is not.
    """
    inputs = list(recording.runs[0].inputs) if recording.runs else []
    if term.takes is not None and term.takes not in inputs:
        raise DomainError(
            f"Expected the term {term.name!r} to take the effect of one of the inputs {inputs}. Got {term.takes!r}."
        )
    if not term.scales:
        return term
    if "t" in scale and term.elapsed == "recording":
        times = [run.time for run in recording.runs or ()]
        scale = {**scale, "t": float(max(time[-1] for time in times) - min(time[0] for time in times))}
    steps = [run.time.diff() for run in recording.runs or () if len(run.time) > 1]
    gaps = [float(torch.cat(steps).median())] if steps else []
    parameters = []
    for parameter in term.parameters:
        driver = term.scales.get(parameter.name)
        if driver is None or (parameter.low is not None and parameter.high is not None):
            parameters.append(parameter)
            continue
        if driver not in scale:
            raise DomainError(
                f"Expected the term {term.name!r} to measure {parameter.name!r} on the scale of one of "
                f"{list(scale)}. Got {driver!r}."
            )
        size = scale[driver] or 1.0
        low, high = (part * size for part in SCALE_RANGE)
        if driver == "t":
            low = min([low, *(OF_A_GAP * gap for gap in gaps)])
        low, high = _narrowed(low, high, parameter)
        initial = parameter.initial if parameter.initial is not None and low <= parameter.initial <= high else None
        parameters.append(dataclasses.replace(parameter, low=low, high=high, initial=initial, neutral=None))
    return dataclasses.replace(term, parameters=tuple(parameters))


def _narrowed(low: float, high: float, parameter: Parameter) -> tuple[float, float]:
    """A range of a driver's scale within the one bound that a parameter has, or else beside it."""
    ratio = high / low
    if parameter.low is not None and parameter.low > low:
        return parameter.low, high if high > parameter.low else ratio * parameter.low
    if parameter.high is not None and parameter.high < high:
        below = parameter.high / ratio if parameter.high > 0 else parameter.high - high
        return low if low < parameter.high else below, parameter.high
    return low, high


def widened(base: Problem, candidate: Candidate, held_back: Sequence[str], given: Sequence[Term]) -> Candidate | None:
    """A candidate with room for parameters that stay at ends which nobody gave: those of a driver's scale (`sized`).

    Args:
        base: Problem that the candidate extends.
        candidate: With the ranges that a fit wants to leave.
        held_back: Names of the parameters that a bound holds back.
        given: Its terms with the bounds that the user gave.

    Returns:
        It with wider ranges, or None where one of those parameters has no such range.
    """
    own = {
        term.full(q.name): q for term in given for q in term.parameters
        if q.name in term.scales and (q.low is None or q.high is None)
    }  # fmt: skip
    if not all(any(is_value_of(name, one) for one in own) for name in held_back):
        return None
    terms = []
    for term in candidate.terms:
        parameters = []
        for q in term.parameters:
            name = term.full(q.name)
            if any(is_value_of(one, name) for one in held_back):
                q = _with_room(q, own[name])
            parameters.append(q)
        terms.append(dataclasses.replace(term, parameters=tuple(parameters)))
    problem = base.with_simulator(extend(base.simulator, terms))
    return dataclasses.replace(candidate, terms=tuple(terms), problem=problem)


def _with_room(sought: Parameter, given: Parameter) -> Parameter:
    """A parameter with more room than it was sought in, but for an end that was given."""
    low, high = sought.low or 0.0, sought.high or 0.0
    more = (WIDER - 1) * (high - low)
    low, high = low / WIDER if low > 0 else low - more, WIDER * high if high > 0 else high + more
    low = low if given.low is None else max(low, given.low)
    high = high if given.high is None else min(high, given.high)
    return dataclasses.replace(sought, low=low, high=high)


def spread_values(target: Problem, names: Sequence[str], values: Tensor) -> Tensor:
    """Values by name in another simulator's order; nan for names it alone has."""
    place = {name: i for i, name in enumerate(names)}
    return torch.stack([
        values[place[q.name]] if q.name in place else values.new_tensor(math.nan) for q in target.parameters
    ])  # fmt: skip


def _shape_points(parameter: Parameter, count: int) -> list[float]:
    low, high = parameter.low, parameter.high
    if low is None or high is None:
        if low is None and high is None and parameter.initial == 0 and count > 1:
            return torch.linspace(-2, 2, count).tolist()
        middle = parameter.initial or parameter.neutral or 1.0
        end = low if low is not None else high if high is not None else 0.0
        away = middle - end
        on_it = away == 0 and count == 1  # as the user may have it
        if not on_it and ((low is not None and away <= 0) or (high is not None and away >= 0)):
            away = math.copysign(abs(end) or 1.0, 1.0 if low is not None else -1.0)
        factors = torch.linspace(-2, 2, count).tolist() if count > 1 else [0.0]
        return [end + away * 2.0**k for k in factors]
    at = torch.linspace(0, 1, count + 2, dtype=torch.float64)[1:-1]
    if parameter.transform == "log" or (low > 0 and high / low > 20):
        return [float(low * (high / low) ** a) for a in at]
    return [float(low + (high - low) * a) for a in at]


def prepare(
    base: Problem, found: Fitted, terms: Sequence[Term], fixed: Mapping[str, float], scale: Mapping[str, float]
) -> Candidate:
    """Extend the simulator by terms and take the tangents of their amplitudes at the base's fit.

    Raises:
        SimulatorError: If the terms change the simulator at their neutral values, or give no finite outputs there.
    """
    terms = tuple(sized(term, scale, base.recording) for term in terms)
    extended = base.with_simulator(extend(base.simulator, terms))
    problem = dataclasses.replace(extended, keep=base.keep)
    begin = spread_values(problem, [q.name for q in base.parameters], found.values)
    own, neutral, certain = [], [], []
    terms_names = {term.full(q.name): (term, q) for term in terms for q in term.parameters}
    base_parameters = {q.name: q for q in base.parameters}
    # What the base calibrates is free already, and no effect of a term's own; of such alone it is the base's.
    brought = {q.name for q in problem.parameters if any(term.brings(q.name) for term in terms)}
    brought = brought - {base.parameters[i].name for i in found.free} or brought
    for i, q in enumerate(problem.parameters):
        if q.name in terms_names:
            at = neutral_of(terms_names[q.name][1])
        elif q.name in brought:
            at = base_parameters[q.name].neutral
            at = float(begin[i]) if at is None else at
        else:
            continue
        own.append(i)
        certain.append(at is not None)
        neutral.append(_shape_points(q, 1)[0] if at is None else at)
        begin[i] = neutral[-1]
    held, _ = base_columns(problem, fixed)
    free = sorted(set(held) | set(own))

    def linear(rows: Tensor, columns: list[int]) -> tuple[Tensor, Tensor]:
        y, jacobian, _ = problem.evaluate(rows, columns, problem.guess(found.warm, rows))
        return y, jacobian

    y, jacobian = linear(begin[None], own)
    name = " + ".join(term.name for term in terms)
    values = dict(zip([problem.parameters[i].name for i in own], neutral, strict=True))
    if not bool(torch.isfinite(y).all()):
        bad = (~torch.isfinite(y[0])).nonzero()[:, 0]
        raise SimulatorError(
            f"Expected finite outputs with the term {name!r} at its neutral values {values}. Got {float(y[0, bad[0]])} "
            f"for {len(bad)} of {problem.n} data, first {place_of(problem, int(bad[0]))} (no coefficient switches off "
            "what is infinite: keep logarithms, roots and quotients finite at every datum)."
        )
    size = torch.maximum(found.whitening.sd, base.recording.spread[base.index])
    moved = (y[0] - found.y).abs()
    change = float((moved / torch.maximum(size, found.y.abs())).max())
    # Far below the noise a long trajectory may differ by what its solver leaves.
    if not (change <= UNCHANGED or (change <= 1e-4 and bool((moved <= 0.01 * found.whitening.sd).all()))):
        check_repeats(base, found.values)
        check_repeats(problem, begin, f"the simulator with the term {name!r}")
        raise SimulatorError(
            f"Expected the term {name!r} to leave the simulator unchanged at its neutral values {values}. Got a "
            f"relative change of {change:.3g} (give neutral= the value at which it has no effect)."
        )
    moves = torch.nan_to_num(jacobian[0], nan=1.0, posinf=1.0, neginf=1.0).abs().amax(0) > 0
    amplitudes = [place for place, sure, m in zip(own, certain, moves.tolist(), strict=True) if sure and m]
    if not amplitudes:  # a product of parameters, or a threshold: try each with the others away from neutral
        amplitudes = _hidden_amplitudes(problem, own, certain, begin, linear)
    shape = [place for place in own if place not in amplitudes]
    grid = _grid(problem, shape, _driver_values(base, found, terms, [problem.parameters[i] for i in shape]))
    rows = begin.expand(len(grid), -1).clone()
    if shape:
        rows[:, shape] = grid
    tangents = _in_pieces(linear, rows, amplitudes)
    return Candidate(
        terms=terms,
        problem=problem,
        free=free,
        own=own,
        amplitudes=amplitudes,
        neutral=torch.tensor(neutral, dtype=torch.float64),
        shapes=rows[:, own],
        tangents=torch.nan_to_num(tangents, nan=0.0, posinf=0.0, neginf=0.0),
        begin=begin,
    )


def _in_pieces(linear: object, rows: Tensor, amplitudes: list[int]) -> Tensor:
    return torch.cat([linear(rows[k : k + 16], amplitudes)[1] for k in range(0, len(rows), 16)])  # type: ignore[operator]


def _hidden_amplitudes(
    problem: Problem, own: list[int], certain: list[bool], begin: Tensor, linear: object
) -> list[int]:
    for place, sure in zip(own, certain, strict=True):
        if not sure:
            continue
        row = begin.clone()
        for other in own:
            if other != place:
                row[other] = _shape_points(problem.parameters[other], 1)[0]
        jacobian = linear(row[None], [place])[1]  # type: ignore[operator]
        if bool((torch.nan_to_num(jacobian).abs() > 0).any()):
            return [place]
    return [own[0]]


def _anywhere(q: Parameter) -> bool:
    """Whether nobody says where a shape lies."""
    return q.transform is None and all(value is None for value in (q.low, q.high, q.initial, q.neutral))


def _driver_values(
    base: Problem, found: Fitted, terms: Sequence[Term], shape: Sequence[Parameter]
) -> dict[str, list[Tensor]]:
    """Sorted magnitudes on the calibrated trajectory of the driver that each shape is measured on, by its name; of one
    that may lie anywhere the values of all drivers."""
    anywhere = [q.name for q in shape if _anywhere(q)]
    if not anywhere and not any(term.scales for term in terms):
        return {}
    drivers = base.drivers(found.values[None], found.warm)
    every = [each.flatten().sort().values for each in drivers.values() if bool(each.isfinite().all())]
    for number, name in enumerate(base.recording.outputs):
        drivers.setdefault(name, found.y[base.output_of == number])
    return dict.fromkeys(anywhere, every) | {
        term.full(own): [drivers[driver].abs().flatten().sort().values]
        for term in terms for own, driver in term.scales.items()
        if driver in drivers and not base.is_time(driver)
    }  # fmt: skip


def _grid(problem: Problem, shape: list[int], drivers: Mapping[str, Sequence[Tensor]]) -> Tensor:
    level = min(len(shape), len(GRID_POINTS) - 1)
    count, more = GRID_POINTS[level], DRIVER_POINTS[level]
    points = []
    for place in shape:
        q = problem.parameters[place]
        values = [each for each in drivers.get(q.name, ()) if len(each)]
        if not values:
            points.append(_shape_points(q, count))
        elif _anywhere(q):
            each = max(ANYWHERE_POINTS[level] // len(values), 2)
            there = list(dict.fromkeys(v for one in values for v in _spaced(one, each)))
            points.append(there[::2] + _shape_points(q, count) + there[1::2])  # what is tried first is in the middle
        else:
            low, high = q.low or 0.0, q.high if q.high is not None else math.inf
            there = [min(max(v, low), high) for v in _spaced(values[0], more)]
            points.append(_shape_points(q, count - more // 2) + there)
    number = math.prod(len(each) for each in points)
    if number <= MOST_POINTS:
        rows = list(itertools.product(*points))
    else:  # some of all, none of them alike in most
        numbers = dict.fromkeys(int(number * (k * GOLDEN % 1.0)) for k in range(2 * MOST_POINTS))
        rows = [_combination(points, k) for k in list(numbers)[:MOST_POINTS]]
    return torch.tensor(rows, dtype=torch.float64).reshape(len(rows), len(shape))


def _spaced(values: Tensor, count: int) -> list[float]:
    """So many of sorted values ``(n,)``, evenly spaced in rank."""
    at = ((torch.arange(count) + 0.5) / count * (len(values) - 1)).round().long()
    return [float(v) for v in values[at]]


def _combination(points: Sequence[Sequence[float]], number: int) -> tuple[float, ...]:
    """One of the combinations of a point of each, by its number."""
    found = []
    for each in points:
        number, place = divmod(number, len(each))
        found.append(each[place])
    return tuple(found)
