"""Candidates prepared for a recording: the extended simulator, which parameters are amplitudes, and their tangents."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.ranges import NOTHING, Anything, Scale, sized, with_room
from torchcal.discovery.fits.shapes import (
    combined,
    driver_values,
    lies_anywhere,
    looked_at,
    points_of_shapes,
    shape_points,
)
from torchcal.discovery.fits.trial import check_finite, check_repeats, place_of
from torchcal.errors import SimulatorError, TorchcalError
from torchcal.simulators import Trajectories, free_parameters, is_value_of
from torchcal.simulators.static import asks_for_numbers
from torchcal.terms import Term, extend
from torchcal.terms.term import neutral_of

__all__ = [
    "Candidate", "base_columns", "call_once", "prepare", "replaces", "spread_values", "usual_starts", "widened",
    "with_terms",
]  # fmt: skip

#: Share of the data's spread that a candidate adds when it is tried.
A_LITTLE = 0.03
#: Change of the outputs, relative to their size, that counts as none.
UNCHANGED = 1e-6
#: Share of an effect by which it may miss its tangent and be linear.
LINEAR = 1e-3
#: What a function raises that asks for what there is not, whatever its numbers are.
WRONG = (AttributeError, ImportError, NameError, TypeError)


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
        tangents: ∂y/∂amplitude at each shape, ``(G, n, len(amplitudes))``; none if it is not to be screened.
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

    @property
    def content(self) -> frozenset[str]:
        """Names of the parameters that it adds to the base: candidates with the same are one, by whatever name."""
        return frozenset(self.problem.parameters[i].name for i in self.own)

    @property
    def shape_places(self) -> list[int]:
        """Places of its own parameters that are no amplitudes: shapes."""
        return [i for i in self.own if i not in self.amplitudes]

    def neutral_at(self, place: int) -> float:
        """The neutral value of one of its own parameters, by its place among all."""
        return float(self.neutral[self.own.index(place)])

    def without(self, values: Tensor, places: Sequence[int]) -> Tensor:
        """Values of all parameters ``(P,)`` with some of its own, by their places, at neutral."""
        at = torch.tensor([self.own.index(place) for place in places], dtype=torch.long)
        return values.index_copy(0, torch.tensor([*places], dtype=torch.long), self.neutral[at])

    def one_sided(self, place: int) -> int:
        """+1 or −1 where physics lets the amplitude leave its neutral value to one side only, else 0."""
        parameter = self.problem.parameters[place]
        neutral = self.neutral_at(place)
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
            if i not in self.amplitudes and lies_anywhere(q := self.problem.parameters[i]):
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
    p |= {q.name: values.new_tensor(shape_points(q, 1)[0] if (at := neutral_of(q)) is None else at)
          for q in term.parameters}  # fmt: skip
    p |= term.numbers
    y = problem.recording.spread.new_ones(problem.recording.n)
    try:
        return any(torch.equal(f(x, p, y) + 0 * y, f(x, p, 2 * y) + 0 * y) for f in term.outputs.values())
    except Exception:  # a term that needs more than that is called by the simulator, which tells what is wrong
        return False


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
                q = with_room(q, own[name])
            parameters.append(q)
        terms.append(dataclasses.replace(term, parameters=tuple(parameters)))
    return with_terms(base, candidate, terms)


def with_terms(base: Problem, candidate: Candidate, terms: Sequence[Term]) -> Candidate:
    """A candidate with the same terms in other ranges."""
    problem = base.with_simulator(extend(base.simulator, terms))
    return dataclasses.replace(candidate, terms=tuple(terms), problem=problem)


def usual_starts(terms: Sequence[Term], problem: Problem, amplitudes: Sequence[int]) -> dict[int, float]:
    """Where hidden states of terms usually begin, by the places of the shapes that say where they do; not of a term
    whose amplitude is not among some, by their places."""
    place = {q.name: i for i, q in enumerate(problem.parameters)}
    found: dict[int, float] = {}
    for term in terms:
        own = {place[term.full(q.name)]: q.neutral for q in term.parameters}
        if term.states and any(i in amplitudes for i in own):
            found |= {i: at for i, at in own.items() if at is not None and i not in amplitudes}
    return found


def spread_values(target: Problem, names: Sequence[str], values: Tensor) -> Tensor:
    """Values by name in another simulator's order; nan for names it alone has."""
    place = {name: i for i, name in enumerate(names)}
    return torch.stack([
        values[place[q.name]] if q.name in place else values.new_tensor(math.nan) for q in target.parameters
    ])  # fmt: skip


def call_once(base: Problem, term: Term, rows: Tensor) -> None:
    """Call all that a term changes once, where runs begin, before any long work; nothing that is dear to call.

    Args:
        base: With the base simulator, which works.
        term: The term.
        rows: Parameter values of the base, ``(m, P)``: what is wrong is wrong at all of them.

    Raises:
        DomainError: If a function asks for what there is not.
        SimulatorError: The same; or if it changes what it is given, or gives no real numbers.
    """
    first = None
    for values in rows:
        error = _refused(base, term, values)
        if error is None:
            return
        first = first or error
    if first is not None:
        raise first


def _refused(base: Problem, term: Term, values: Tensor) -> TorchcalError | None:
    """What is raised at parameter values of the base ``(P,)`` that may be raised at any."""
    if base.dear:
        return None
    term = sized(term, Anything(), base.recording)
    bound = extend(base.simulator, [term])
    own = {term.full(q.name): q for q in term.parameters}
    row = spread_values(base.with_simulator(bound), [q.name for q in base.parameters], values)
    for i, q in enumerate(bound.parameters):
        if q.name in own:
            neutral = neutral_of(own[q.name])
            row[i] = shape_points(q, 1)[0] if neutral is None else neutral
    try:
        with torch.no_grad():
            if not isinstance(bound, Trajectories):
                bound.at(base.recording.x, base.recording.outputs)(row[None])
                return None
            start = bound.layout.start(row[None])
            grid = bound.grid
            u = {name: table[0, :, 0] for name, table in grid.u.items()}
            bound.steps.rates(grid.t[:, 0], start, bound.layout.by_name(row[None]), u)
            bound.readings(row[None], start)
    except TorchcalError as error:
        cause = error.__cause__
        misspelt = isinstance(cause, KeyError) and bool(cause.args) and isinstance(cause.args[0], str)
        wrong = misspelt or isinstance(cause, WRONG) or (isinstance(cause, Exception) and asks_for_numbers(cause))
        return error if cause is None or wrong else None  # another one may be one of these values alone
    return None


def prepare(
    base: Problem,
    found: Fitted,
    terms: Sequence[Term],
    fixed: Mapping[str, float],
    scale: Scale = NOTHING,
    *,
    screened: bool = True,
) -> Candidate:
    """Extend the simulator by terms and take the tangents of their amplitudes at the base's fit.

    Without these, and with fewer shapes, where it is to be refitted and not ``screened``.

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
        neutral.append(shape_points(q, 1)[0] if at is None else at)
        begin[i] = neutral[-1]
    held, _ = base_columns(problem, fixed)
    free = sorted(set(held) | set(own))

    def linear(rows: Tensor, columns: list[int]) -> tuple[Tensor, Tensor]:
        y, jacobian, _ = problem.evaluate(rows, columns, problem.guess(found.warm, rows))
        return y, jacobian

    y, jacobian = linear(begin[None], own)
    for k, i in enumerate(own):  # nobody says that it is 0: a time that something is divided by is a shape
        q = problem.parameters[i]
        if not bool(torch.isfinite(y).all()) and q.name in terms_names and q.neutral is None and certain[k]:
            row = begin.index_fill(0, torch.tensor(i), shape_points(q, 1)[0])
            other = linear(row[None], own)
            if bool(torch.isfinite(other[0]).all()):
                (y, jacobian), begin = other, row
                certain[k], neutral[k] = False, float(row[i])
    name = " + ".join(term.name for term in terms)
    values = dict(zip([problem.parameters[i].name for i in own], neutral, strict=True))
    if not bool(torch.isfinite(y).all()):
        for alone in (found, dataclasses.replace(found, warm=None)):  # with other steps a term begins without a guess
            check_finite(alone)
        bad = (~torch.isfinite(y[0])).nonzero()[:, 0]
        raise SimulatorError(
            f"Expected finite outputs with the term {name!r} at its neutral values {values}. Got {float(y[0, bad[0]])} "
            f"for {len(bad)} of {problem.n} data, first {place_of(problem, int(bad[0]))} (no coefficient switches off "
            "what is infinite: keep logarithms, roots and quotients finite at every datum, and give low= and high= to "
            "what may not be 0)."
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
    usual = usual_starts(terms, problem, amplitudes)
    if not amplitudes:  # a product of parameters, or a threshold: try each with the others away from neutral
        amplitudes = _hidden_amplitudes(problem, own, certain, begin, linear)
    shape = [place for place in own if place not in amplitudes]
    drivers = driver_values(base, found, terms, [problem.parameters[i] for i in shape])
    points = points_of_shapes(problem, shape, drivers, usual)

    def rows_of(grid: Tensor) -> Tensor:
        rows = begin.repeat(len(grid), 1)
        rows[:, shape] = grid
        return rows

    def look(grid: Tensor) -> Tensor:
        return torch.nan_to_num(_in_pieces(linear, rows_of(grid), amplitudes), nan=0.0, posinf=0.0, neginf=0.0)

    grid, tangents = combined(points), begin.new_zeros(0, problem.n, len(amplitudes))
    if screened:
        stay = [base.dear or i in usual or problem.parameters[i].name in drivers for i in shape]
        grid, tangents = looked_at(problem, shape, points, stay, look, found)
    return Candidate(
        terms=terms,
        problem=problem,
        free=free,
        own=own,
        amplitudes=amplitudes,
        neutral=torch.tensor(neutral, dtype=torch.float64),
        shapes=rows_of(grid)[:, own],
        tangents=tangents,
        begin=begin,
    )


def _in_pieces(linear: object, rows: Tensor, amplitudes: list[int]) -> Tensor:
    return torch.cat([linear(rows[k : k + 32], amplitudes)[1] for k in range(0, len(rows), 32)])  # type: ignore[operator]


def _hidden_amplitudes(
    problem: Problem, own: list[int], certain: list[bool], begin: Tensor, linear: object
) -> list[int]:
    """Of parameters that do nothing alone, the one whose effect beside the others, away from neutral, is most linear:
    what an initial amount of an unseen state does is in proportion to it, and what a rate from there does is not."""
    found, least = own[0], math.inf
    for place, sure in zip(own, certain, strict=True):
        if not sure:
            continue
        row = begin.clone()
        for other in own:
            if other != place:
                row[other] = shape_points(problem.parameters[other], 1)[0]
        y, jacobian = linear(row[None], [place])  # type: ignore[operator]
        tangent = torch.nan_to_num(jacobian[0, :, 0])
        if not bool((tangent.abs() > 0).any()):
            continue
        acting = row.clone()
        acting[place] = shape_points(problem.parameters[place], 1)[0]
        effect, bend = tangent * (acting[place] - row[place]), math.inf
        try:
            off = (linear(acting[None], [])[0] - y)[0] - effect  # type: ignore[operator]
            bend = float(off.norm() / effect.norm().clamp_min(1e-300))
        except SimulatorError:  # a function may raise where all of them are large
            pass
        bend = max(bend, LINEAR) if math.isfinite(bend) else 1 / LINEAR
        if bend < least:
            found, least = place, bend
    return [found]
