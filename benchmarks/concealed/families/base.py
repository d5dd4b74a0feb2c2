"""What a family of cases is, and the truth's own integrator (SciPy). Nothing here knows the tool under test."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]
Function = Callable[..., Any]


BUDGET = 60_000
"""Largest number of evaluations of the rates a run."""


class Failure(RuntimeError):
    """A system that cannot be integrated: it blew up, or needs more steps than a sane one."""


@dataclass(frozen=True)
class Base:
    """A base parameter: drawn uniformly in its range (log-uniformly where positive); bounds of what is physical."""

    name: str
    unit: str
    draw: tuple[float, float]
    low: float | None = 0.0
    high: float | None = None


@dataclass(frozen=True)
class Effect:
    """Physics that the base leaves out.

    Args:
        name: As the candidate list spells it; out-of-library effects have names that no list holds.
        rates: What it adds to the rate of each equation, ``f(t, s, p, u, c)``; ``c["a"]`` is the amplitude.
        outputs: What it makes of an output, ``f(t, s, p, u, y, c)``.
        factors: Where its rates are those of a base parameter times a factor ``f(t, s, p, u, c)``, that factor: other
            effects see the parameter so.
        hidden: States of its own and where they start: a number or the name of a visible state.
        shapes: Shape parameters: ``(low, high, driver)``, drawn log-uniformly, in units of the driver's largest
            absolute value on the base's trajectory (``None``: as they are).
        sign: Of the amplitude; 0 is either.
        drivers: What a local version may depend on: ``"t"``, a state, an input or a condition.
        library: Whether it is in the candidate list.
        guess: An amplitude of the right order, where the effect is not linear in it.
        most: Largest strength that makes sense.
        within: What the amplitude may be: ``(low, high, driver)``, as shapes are measured.
        stiff: Whether a small amplitude makes a fast system (a lag).
    """

    name: str
    rates: Mapping[str, Function] = field(default_factory=dict)
    outputs: Mapping[str, Function] = field(default_factory=dict)
    factors: Mapping[str, Function] = field(default_factory=dict)
    hidden: Mapping[str, float | str] = field(default_factory=dict)
    shapes: Mapping[str, tuple[float, float, str | None]] = field(default_factory=dict)
    sign: int = 1
    drivers: tuple[str, ...] = ()
    library: bool = True
    guess: float = 1.0
    most: float = 0.5
    within: tuple[float, float, str | None] | None = None
    stiff: bool = False


@dataclass(frozen=True)
class Gate:
    """Where a local effect acts: ``low < driver < high``, with edges of the given width (0: sharp)."""

    driver: str
    low: float
    high: float
    width: float

    def __call__(self, t: Any, s: Mapping[str, Any], u: Mapping[str, Any]) -> Any:
        z = t if self.driver == "t" else s[self.driver] if self.driver in s else u[self.driver]
        if self.width == 0:
            return ((z > self.low) & (z < self.high)) * 1.0
        return _edge((z - self.low) / self.width) * _edge((self.high - z) / self.width)


def _edge(z: Any) -> Any:
    return 0.5 * (1 + np.tanh(0.5 * np.asarray(z)))


@dataclass(frozen=True)
class Planted:
    """An effect with its numbers."""

    effect: Effect
    amplitude: float
    shapes: Mapping[str, float] = field(default_factory=dict)
    gate: Gate | None = None

    def numbers(self, amplitude: Any) -> dict[str, Any]:
        return {"a": amplitude, **self.shapes}


@dataclass(frozen=True)
class RunSetting:
    """One run: when it was sampled, its inputs there (linear between the samples), where every state starts."""

    time: Array
    inputs: Mapping[str, Array] = field(default_factory=dict)
    initial: Mapping[str, float] = field(default_factory=dict)
    known: tuple[str, ...] = ()


@dataclass(frozen=True)
class Setting:
    """The conditions of a case: runs in time, or for a static family the conditions ``x``."""

    runs: tuple[RunSetting, ...] = ()
    x: Mapping[str, Array] = field(default_factory=dict)
    observed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Family:
    """A family of cases.

    Args:
        name: Name.
        field: The branch of physics.
        parameters: Base parameters.
        states: Names and units; empty for a static family.
        rates: ``f(t, s, p, u) -> {state: rate}``.
        outputs: ``{output: f(t, s, p, u)}``; for a static family the response, with ``s`` the conditions.
        units: Units of outputs, inputs and conditions.
        draw: ``f(rng) -> Setting``.
        effects: Every effect, in the library and not.
        tied: A pair of candidates that such data can hardly tell apart.
        late: 0: in every set; 1: in test sets alone; 2: alone in sets from the newest seed on; 3: from the
            fresh seed on; 4: from the unseen one on; 5: from the blind one on.
        positive: States that must stay positive on the truth's trajectory.
        scales: Typical sizes of the states, for the integrator's absolute tolerance.
    """

    name: str
    field: str
    parameters: tuple[Base, ...]
    draw: Callable[[np.random.Generator], Setting]
    outputs: Mapping[str, Function]
    effects: tuple[Effect, ...]
    tied: tuple[str, str]
    states: Mapping[str, str] = field(default_factory=dict)
    rates: Function | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    late: int = 0
    positive: tuple[str, ...] = ()
    scales: Mapping[str, float] = field(default_factory=dict)

    @property
    def static(self) -> bool:
        return self.rates is None

    @property
    def library(self) -> tuple[Effect, ...]:
        return tuple(effect for effect in self.effects if effect.library)

    @property
    def outside(self) -> tuple[Effect, ...]:
        return tuple(effect for effect in self.effects if not effect.library)

    def effect(self, name: str) -> Effect:
        return next(effect for effect in self.effects if effect.name == name)


def unknowns(family: Family, setting: Setting) -> list[tuple[str, int | None]]:
    """Names of what calibration adjusts: base parameters, then the unknown initial states, run by run."""
    free: list[tuple[str, int | None]] = [(base.name, None) for base in family.parameters]
    for number, run in enumerate(setting.runs):
        free += [(state, number) for state in family.states if state not in run.known]
    return free


def labels(family: Family, setting: Setting) -> list[str]:
    """The unknowns as answers spell them: ``k``, ``x(0)[1]``."""
    return [name if number is None else f"{name}(0)[{number}]" for name, number in unknowns(family, setting)]


def truth_vector(family: Family, setting: Setting, parameters: Mapping[str, float]) -> Array:
    """The unknowns' true values."""
    return np.array([
        parameters[name] if number is None else setting.runs[number].initial[name]
        for name, number in unknowns(family, setting)
    ])


@dataclass(frozen=True)
class Trace:
    """What one run, or one set of conditions, does: ``(T, B)`` arrays for B parameter vectors.

    ``added`` is what each effect adds to each rate, and as ``"output y"`` to the output y; ``base`` the base's rate
    there, or the output without any effect.
    """

    time: Array | None
    states: dict[str, Array]
    inputs: dict[str, Array]
    outputs: dict[str, Array]
    added: tuple[dict[str, Array], ...]
    base: dict[str, Array]


def simulate(
    family: Family,
    setting: Setting,
    theta: Array,
    planted: Sequence[Planted] = (),
    amplitudes: Array | None = None,
    *,
    rtol: float = 1e-9,
    quick: int = 0,
) -> list[Trace]:
    """Integrate the system for several parameter vectors at once.

    Args:
        family: The family.
        setting: Its runs or conditions.
        theta: ``(B, d)``, in the order of `unknowns`.
        planted: The effects at work.
        amplitudes: ``(B, m)``, in place of the effects' own amplitudes.
        rtol: Relative tolerance.
        quick: For searches and calibrations: so many fixed steps a sample of the classical Runge-Kutta method.

    Returns:
        One trace a run (one in all for a static family).

    Raises:
        Failure: If the integration failed.
    """
    theta = np.atleast_2d(theta)
    free = unknowns(family, setting)
    size = len(theta)
    if amplitudes is None:
        amplitudes = np.tile([item.amplitude for item in planted], (size, 1)).reshape(size, len(planted))
    numbers = [item.numbers(amplitudes[:, i]) for i, item in enumerate(planted)]
    p = {name: theta[:, i] for i, (name, number) in enumerate(free) if number is None}
    if family.static:
        x = {name: values[:, None] for name, values in setting.x.items()}
        with np.errstate(all="ignore"):
            return [_observe(family, setting, planted, numbers, None, x, p, x, len(next(iter(setting.x.values()))))]
    traces = []
    for number, run in enumerate(setting.runs):
        start = {
            state: theta[:, free.index((state, number))]
            if (state, number) in free
            else np.full(size, run.initial[state])
            for state in family.states
        }
        traces.append(_integrate(family, setting, run, start, p, planted, numbers, rtol, quick))
    return traces


def _total(
    family: Family, planted: Sequence[Planted], numbers: Sequence[dict[str, Any]],
    t: Any, s: dict[str, Any], p: dict[str, Any], u: dict[str, Any],
) -> tuple[dict[str, Any], list[dict[str, Any]]]:  # fmt: skip
    assert family.rates is not None
    base = family.rates(t, s, p, u)
    added: list[dict[str, Any]] = [{} for _ in planted]
    for i in sorted(range(len(planted)), key=lambda i: not planted[i].effect.factors):
        item, c = planted[i], numbers[i]
        gate = 1.0 if item.gate is None else item.gate(t, s, u)
        if item.gate is not None and item.effect.factors:
            raise ValueError(f"Expected no gate of a factor. Got one of {item.effect.name}.")
        added[i] = {
            state: rate(t, s, p, u, c) * (gate if state in family.states else 1.0)
            for state, rate in item.effect.rates.items()
        }
        moved = {name: p[name] * factor(t, s, p, u, c) for name, factor in item.effect.factors.items()}
        p = {**p, **moved}
    return base, added


def _integrate(
    family: Family, setting: Setting, run: RunSetting, start: dict[str, Array], p: dict[str, Array],
    planted: Sequence[Planted], numbers: Sequence[dict[str, Any]], rtol: float, quick: int,
) -> Trace:  # fmt: skip
    names = list(family.states)
    for item in planted:
        for state, value in item.effect.hidden.items():
            names.append(state)
            start[state] = start[value] if isinstance(value, str) else np.full_like(start[names[0]], value)
    size = len(start[names[0]])

    def rates(t: float, rows: Array, u: dict[str, Any]) -> Array:
        s = dict(zip(names, rows, strict=True))
        base, added = _total(family, planted, numbers, t, s, p, u)
        out = np.zeros_like(rows)
        for i, name in enumerate(names):
            out[i] = base.get(name, 0.0) + sum(part.get(name, 0.0) for part in added)
        return out

    first = np.array([start[name] for name in names])
    with np.errstate(all="ignore"):
        if quick:
            values = _fixed_steps(rates, run, first, quick)
        else:
            values = _tight_steps(rates, run, first, np.array([family.scales.get(name, 1.0) for name in names]), rtol)
    s = {name: values[:, i] for i, name in enumerate(names)}
    t = run.time[:, None]
    u = {name: np.asarray(array)[:, None] for name, array in run.inputs.items()}
    with np.errstate(all="ignore"):
        base, added = _total(family, planted, numbers, t, s, p, u)
        trace = _observe(family, setting, planted, numbers, run.time, s, p, u, len(run.time))
    shape = (len(run.time), size)
    return Trace(
        run.time,
        s,
        u,
        trace.outputs,
        tuple(
            {k: np.broadcast_to(v, shape) for k, v in part.items()} | seen
            for part, seen in zip(added, trace.added, strict=True)
        ),
        {k: np.broadcast_to(v, shape) for k, v in base.items()} | trace.base,
    )


def _tight_steps(rates: Function, run: RunSetting, first: Array, scales: Array, rtol: float) -> Array:
    """States at the samples, ``(T, S, B)``; inputs have kinks there, so that every interval is a problem of its own."""
    shape = first.shape
    atol = rtol * np.repeat(scales, shape[1])
    calls = 0

    def flat(t: float, vector: Array) -> Array:
        nonlocal calls
        calls += 1
        if calls > BUDGET:
            raise Failure("too many steps")
        u = {name: np.interp(t, run.time, values) for name, values in run.inputs.items()}
        out = rates(t, vector.reshape(shape), u)
        if not np.isfinite(out).all():
            raise Failure("not finite")
        return out.ravel()

    whole = [(run.time[0], run.time[-1])]
    spans = list(zip(run.time[:-1], run.time[1:], strict=True)) if run.inputs else whole
    found, vector = [first.ravel()], first.ravel()
    for begin, end in spans:
        solution = solve_ivp(
            flat, (begin, end), vector, t_eval=None if run.inputs else run.time, method="DOP853", rtol=rtol, atol=atol,
            max_step=(end - begin) / (1 if run.inputs else 40), first_step=end - begin if run.inputs else None,
        )  # fmt: skip
        if solution.status != 0 or not np.isfinite(solution.y).all():
            raise Failure(str(solution.message))
        vector = solution.y[:, -1]
        found += [vector] if run.inputs else list(solution.y.T[1:])
    return np.array(found).reshape(-1, *shape)


def _fixed_steps(rates: Function, run: RunSetting, first: Array, parts: int) -> Array:
    """The same by the classical Runge-Kutta method, ``parts`` steps a sample."""
    fine = np.linspace(0, 1, 2 * parts + 1)
    grid = run.time[:-1, None] + np.diff(run.time)[:, None] * fine
    inputs = {name: np.interp(grid, run.time, values) for name, values in run.inputs.items()}
    found = np.empty((len(run.time), *first.shape))
    found[0] = y = first
    for k in range(len(run.time) - 1):
        h = (run.time[k + 1] - run.time[k]) / parts
        for j in range(0, 2 * parts, 2):
            us = [{name: values[k, j + i] for name, values in inputs.items()} for i in range(3)]
            a = rates(grid[k, j], y, us[0])
            b = rates(grid[k, j + 1], y + 0.5 * h * a, us[1])
            c = rates(grid[k, j + 1], y + 0.5 * h * b, us[1])
            d = rates(grid[k, j + 2], y + h * c, us[2])
            y = y + h / 6 * (a + 2 * (b + c) + d)
        found[k + 1] = y
        if not abs(y).max() < 1e9:
            raise Failure("not finite")
    return found


def _observe(
    family: Family, setting: Setting, planted: Sequence[Planted], numbers: Sequence[dict[str, Any]],
    time: Array | None, s: dict[str, Array], p: dict[str, Array], u: dict[str, Array], n: int,
) -> Trace:  # fmt: skip
    t = None if time is None else time[:, None]
    size = len(next(iter(p.values())))
    outputs: dict[str, Array] = {}
    base: dict[str, Array] = {}
    added: tuple[dict[str, Array], ...] = tuple({} for _ in planted)
    for name in setting.observed:
        y = np.broadcast_to(family.outputs[name](t, s, p, u), (n, size))
        base["output " + name] = y
        for item, c, part in zip(planted, numbers, added, strict=True):
            if name in item.effect.outputs:
                gate = 1.0 if item.gate is None else item.gate(t, s, u)
                part["output " + name] = gate * (item.effect.outputs[name](t, s, p, u, y, c) - y)
                y = y + part["output " + name]
        outputs[name] = np.broadcast_to(y, (n, size))
    if not all(np.isfinite(y).all() for y in outputs.values()):
        raise Failure("not finite")
    return Trace(time, s, u, outputs, added, base)


def stacked(family: Family, setting: Setting, traces: Sequence[Trace], scales: Mapping[str, float]) -> Array:
    """All outputs of all runs, each divided by its scale, ``(B, n)``."""
    rows = [trace.outputs[name] / scales[name] for name in setting.observed for trace in traces]
    return np.concatenate(rows, axis=0).T
