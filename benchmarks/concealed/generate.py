"""Write recordings with concealed effects and, apart, what was concealed. Shares no code with the tool under test.

A case is drawn in this order: what kind it is and the band its concealment must fall into (both by quota, so that
the mix is exact), a family, its parameters and conditions, an effect and its strength. The truth is integrated, the
base is calibrated to it free of noise (`recalibrate`), and the noise level is chosen between 1 and 10 % of the
signal such that κ falls into the band; where none does, the case is drawn again.
"""

import argparse
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks.concealed.families import FAMILIES
from benchmarks.concealed.families.base import (
    Array,
    Effect,
    Failure,
    Family,
    Gate,
    Planted,
    Setting,
    Trace,
    labels,
    simulate,
    stacked,
    truth_vector,
    unknowns,
)
from benchmarks.concealed.families.inputs import uniform

KINDS = {"library": 0.34, "local": 0.11, "null": 0.30, "outside": 0.15, "two": 0.10}
BANDS = {
    "library": (0.15, 0.425, 0.425),
    "local": (0.1, 0.4, 0.5),
    "outside": (0.0, 0.35, 0.65),
    "two": (0.1, 0.3, 0.6),
}
EDGES = ((0.08, 0.3), (0.3, 1.0), (1.0, 12.0))
LEVELS = (0.01, 0.10)
STRENGTHS = (0.05, 0.50)
NOISES = {"white, known": 0.40, "white, unknown": 0.25, "AR(1), unknown": 0.12, "AR(1), known": 0.06,
          "outliers, known": 0.06, "outliers, unknown": 0.06, "quantised, unknown": 0.05}  # fmt: skip
FIRST = 1e-3
"""Where the search for an amplitude begins, in units of the effect's guess: so weak that it is linear."""
PARTS = 4
"""Time steps a sample in searches and calibrations."""
HIDDEN_SECOND = 0.15
"""Of two terms, each must leave this κ when the other is known of: nobody could find it otherwise."""
FIRST_TEST_SEED = 1000
"""Seeds below are for development and never hold a late family."""

NEWEST_SEED = 2000
"""Seeds from here on hold the newest families alone."""

FRESH_SEED = 3000
"""Seeds from here on hold the fresh families alone."""

UNSEEN_SEED = 4000
"""Seeds from here on hold the unseen families alone."""

BLIND_SEED = 5000
"""Seeds from here on hold the blind families alone."""


@dataclass(frozen=True)
class Draft:
    """A case before its noise."""

    family: Family
    setting: Setting
    parameters: dict[str, float]
    planted: tuple[Planted, ...]
    traces: list[Trace]
    scales: dict[str, float]
    strengths: tuple[float, ...]
    refit: Array
    residual: Array
    rmse: float
    alone: tuple[float, ...] = ()


def quotas(shares: Mapping[str, float], total: int) -> list[str]:
    """Names in the given shares, by largest remainders."""
    exact = {name: share / sum(shares.values()) * total for name, share in shares.items()}
    counts = {name: int(value) for name, value in exact.items()}
    for name in sorted(exact, key=lambda name: counts[name] - exact[name])[: total - sum(counts.values())]:
        counts[name] += 1
    return [name for name, count in counts.items() for _ in range(count)]


def plan(cases: int, seed: int, families: Sequence[str]) -> list[tuple[str, int, str, str]]:
    """Kind, band, family and noise of every case, in a shuffled order."""
    rng = np.random.default_rng([seed, 1])
    rows: list[tuple[str, int]] = []
    kinds = quotas(KINDS, cases)
    for kind in KINDS:
        number = kinds.count(kind)
        if kind == "null":
            rows += [(kind, -1)] * number
        else:
            shares = {str(i): share for i, share in enumerate(BANDS[kind])}
            rows += [(kind, int(band)) for band in quotas(shares, number)]
    order = rng.permutation(cases)
    noises = rng.permutation(quotas(NOISES, cases))
    names = [families[i % len(families)] for i in range(cases)]
    rng.shuffle(names)
    return [(*rows[i], names[n], str(noises[n])) for n, i in enumerate(order)]


def signal_scales(setting: Setting, traces: Sequence[Trace]) -> dict[str, float]:
    """Standard deviation of each noise-free output over all runs."""
    found = {
        name: float(np.std(np.concatenate([trace.outputs[name][:, 0] for trace in traces])))
        for name in setting.observed
    }
    if min(found.values()) < 1e-9:
        raise Failure("an output that does not move")
    return found


def bounds(family: Family, setting: Setting) -> tuple[Array, Array]:
    """Physical bounds of the unknowns."""
    limits = {base.name: (base.low, base.high) for base in family.parameters}
    low, high = [], []
    for name, number in unknowns(family, setting):
        a, b = limits[name] if number is None else (None, None)
        low.append(-np.inf if a is None else a)
        high.append(np.inf if b is None else b)
    return np.array(low), np.array(high)


def recalibrate(
    family: Family,
    setting: Setting,
    target: Array,
    scales: Mapping[str, float],
    start: Array,
    rng: np.random.Generator,
    *,
    starts: int = 3,
    planted: Sequence[Planted] = (),
    weights: Array | None = None,
    parts: int = PARTS,
) -> tuple[Array, Array]:
    """Fit the base parameters and unknown initial states (and the amplitudes of ``planted``) by least squares.

    Args:
        family: The family.
        setting: Its runs.
        target: What to fit, ``(n,)``, outputs divided by their scales.
        scales: By output.
        start: First guess of the unknowns.
        rng: For the other starts, which scatter by 20 % and by 5 % in turn.
        starts: Number of starts; the best end is returned.
        planted: Effects whose amplitudes are fitted too, from their values.
        weights: ``(n,)``, 0 leaves a datum out.
        parts: Time steps a sample.

    Returns:
        The unknowns ``(d,)`` and the residual ``target − fit``, ``(n,)``.
    """
    low, high = bounds(family, setting)
    extra = np.array([item.amplitude for item in planted])
    signs = [item.effect.sign for item in planted]
    low = np.append(low, [0.0 if sign else -np.inf for sign in signs])
    high = np.append(high, np.full(len(extra), np.inf))
    first = np.append(start, extra)
    size = np.maximum(abs(first), 0.05 * np.array([1.0] * len(start) + [abs(a) + 1e-12 for a in extra]))
    weight = np.ones_like(target) if weights is None else weights
    kept: dict[str, Any] = {}

    def both(z: Array) -> tuple[Array, Array]:
        if "z" in kept and np.array_equal(kept["z"], z):
            return kept["f"], kept["j"]
        step = 1e-5 * size
        # Differences towards the inside, and all copies on the integrator's same steps.
        step = np.where(z + step > high, -step, step)
        batch = z + np.vstack([np.zeros_like(z), np.diag(step)])
        try:
            cut = len(start)
            rows = stacked(
                family,
                setting,
                simulate(family, setting, batch[:, :cut], planted, batch[:, cut:], quick=parts),
                scales,
            )
            f, j = (rows[0] - target) * weight, ((rows[1:] - rows[0]) / step[:, None] * weight).T
        except (Failure, FloatingPointError, ValueError):
            f, j = np.full_like(target, 1e3), np.zeros((len(target), len(z)))
        kept.update(z=z.copy(), f=f, j=j)
        return f, j

    best: Any = None
    for number in range(starts):
        scatter = (0.05, 0.2)[number % 2] if number else 0.0
        z0 = first + scatter * size * rng.standard_normal(len(first))
        inside = 1e-6 * size
        z0 = np.clip(z0, low + inside, high - inside)
        found = least_squares(
            lambda z: both(z)[0], z0, jac=lambda z: both(z)[1], bounds=(low, high), x_scale=size,
            ftol=1e-9, xtol=1e-9, gtol=1e-12, max_nfev=40,
        )  # fmt: skip
        if best is None or found.cost < best.cost:
            best = found
    if best.cost > 1e5:
        raise Failure("the base cannot be fitted")
    return best.x, -best.fun


def tangents(
    family: Family, setting: Setting, theta: Array, scales: Mapping[str, float], planted: Sequence[Planted]
) -> tuple[Array, Array]:
    """Sensitivities of the outputs to the unknowns and to the amplitudes at zero, ``(n, d)`` and ``(n, m)``."""
    step = 1e-5 * np.maximum(abs(theta), 0.05)
    small = np.array([1e-4 * abs(item.amplitude) for item in planted])
    d, m = len(theta), len(planted)
    batch = np.tile(theta, (1 + d, 1))
    batch[1:] += np.diag(step)
    plain = stacked(family, setting, simulate(family, setting, batch, quick=PARTS), scales)
    base = ((plain[1:] - plain[0]) / step[:, None]).T
    columns = np.full((m, base.shape[0]), np.nan)
    for i in range(m):
        # Off zero, where a lag is singular, and for a lag too fast to integrate the whole effect.
        for size in (small[i], 5e3 * small[i]):
            try:
                amplitudes = np.array([[size], [2 * size]])
                traces = simulate(family, setting, np.tile(theta, (2, 1)), [planted[i]], amplitudes, quick=PARTS)
            except Failure:
                continue
            rows = stacked(family, setting, traces, scales)
            columns[i] = (rows[1] - rows[0]) / size
            break
    return base, columns.T


def projected(base: Array, columns: Array) -> Array:
    """Columns with the tangent space of the base taken out, each of length 1 (0 where nothing is left)."""
    q, _ = np.linalg.qr(base)
    rest = columns - q @ (q.T @ columns)
    size = np.linalg.norm(rest, axis=0)
    whole = np.linalg.norm(columns, axis=0)
    return np.where(size > 1e-4 * whole, rest / np.where(size > 0, size, 1.0), 0.0)


def largest(setting: Setting, traces: Sequence[Trace], driver: str) -> float:
    """Largest absolute value of time, a state, an input or a condition."""
    return float(np.max(abs(np.concatenate(driver_values(setting, traces, driver)))))


def driver_values(setting: Setting, traces: Sequence[Trace], driver: str) -> list[Array]:
    """Its values at the samples, run by run."""
    if setting.x:
        return [setting.x[driver]]
    if driver == "t":
        return [run.time for run in setting.runs]
    if driver in traces[0].states:
        return [trace.states[driver][:, 0] for trace in traces]
    return [run.inputs[driver] for run in setting.runs]


def draw_shapes(
    effect: Effect, setting: Setting, traces: Sequence[Trace], rng: np.random.Generator
) -> dict[str, float]:
    """Shape parameters in physical units."""
    return {
        name: uniform(rng, low, high) * (1.0 if driver is None else largest(setting, traces, driver))
        for name, (low, high, driver) in effect.shapes.items()
    }


def draw_gate(effect: Effect, setting: Setting, traces: Sequence[Trace], rng: np.random.Generator) -> Gate:
    """A window of the driver that holds between a fifth and a half of the samples, open on one side or closed."""
    driver = str(rng.choice(list(effect.drivers)))
    values = np.concatenate(driver_values(setting, traces, driver))
    share, span = rng.uniform(0.2, 0.5), np.ptp(values)
    side = rng.choice(["above", "below", "window"])
    if side == "above":
        low, high = float(np.quantile(values, 1 - share)), np.inf
    elif side == "below":
        low, high = -np.inf, float(np.quantile(values, share))
    else:
        left = rng.uniform(0.05, 0.95 - share)
        low, high = (float(q) for q in np.quantile(values, [left, left + share]))
    width = float(span * rng.uniform(0.01, 0.03)) if rng.random() < 0.6 else 0.0
    return Gate(driver, low, high, width)


def strength(family: Family, item: Planted, traces: Sequence[Trace], number: int = 0) -> float:
    """Root mean square of what the effect adds over that of the base's rate, where the effect acts.

    The base's rate for equations; the signal's standard deviation for outputs.
    """
    added, base = 0.0, 0.0
    active = np.concatenate(active_samples(family, item, traces))
    places = [s for s in item.effect.rates if s in family.states] or ["output " + o for o in item.effect.outputs]
    for place in places:
        if place not in traces[0].added[number]:
            raise Failure("acts on an output that is not observed")
        a = np.concatenate([trace.added[number][place][:, 0] for trace in traces])
        b = np.concatenate([trace.base[place][:, 0] for trace in traces])
        if place.startswith("output "):
            b = np.full_like(b, np.std(b))
        added += float(np.sum(a[active] ** 2))
        base += float(np.sum(b[active] ** 2))
    if not base > 0:
        raise Failure("acts nowhere, or where the base does nothing")
    return float(np.sqrt(added / base))


def active_samples(family: Family, item: Planted, traces: Sequence[Trace]) -> list[Array]:
    """Where the effect acts at more than half of its strength, run by run."""
    found = []
    for trace in traces:
        n = len(next(iter(trace.outputs.values())))
        if item.gate is None:
            found.append(np.ones(n, dtype=bool))
            continue
        s = {name: values[:, 0] for name, values in trace.states.items()}
        u = {name: values[:, 0] for name, values in trace.inputs.items()}
        found.append(np.asarray(item.gate(trace.time, s, u)) > 0.5)
    return found


def draft(
    family: Family,
    setting: Setting,
    parameters: dict[str, float],
    effects: Sequence[tuple[Effect, bool]],
    rng: np.random.Generator,
) -> Draft:
    """Plant effects of random strength (and gates where asked for), integrate the truth, calibrate the base to it.

    Raises:
        Failure: If the truth or its fit is not sane, or no amplitude gives the wanted strength.
    """
    theta = truth_vector(family, setting, parameters)
    plain = simulate(family, setting, theta, quick=PARTS)
    planted = []
    for effect, local in effects:
        gate = draw_gate(effect, setting, plain, rng) if local else None
        sign = effect.sign or int(rng.choice([-1, 1]))
        first = sign * effect.guess * (1.0 if effect.stiff else FIRST)
        item = Planted(effect, first, draw_shapes(effect, setting, plain, rng), gate)
        planted.append(item)
    goals = [uniform(rng, STRENGTHS[0] * 1.05, min(STRENGTHS[1], item.effect.most) * 0.95) for item in planted]
    for attempt in range(7):
        # An effect that nothing resists grows with its amplitude, others saturate: a damped search in logarithms.
        traces = simulate(family, setting, theta, planted, quick=PARTS)
        found = [strength(family, item, traces, i) for i, item in enumerate(planted)]
        if not np.all(np.isfinite(found)) or (planted and min(found) < 1e-12):
            raise Failure("an effect that does nothing")
        ratios = [goal / value for goal, value in zip(goals, found, strict=True)]
        if all(abs(np.log(ratio)) < 0.1 for ratio in ratios):
            break
        planted = [
            replace(item, amplitude=item.amplitude * float(np.clip(ratio, 1e-7, 1e7) ** (1.0 if attempt < 2 else 0.7)))
            for item, ratio in zip(planted, ratios, strict=True)
        ]
    traces = simulate(family, setting, theta, planted)
    strengths = tuple(strength(family, item, traces, i) for i, item in enumerate(planted))
    if any(not STRENGTHS[0] <= value <= STRENGTHS[1] for value in strengths):
        raise Failure("no amplitude of the wanted strength")
    for item in planted:
        if item.effect.within is not None:
            low, high, driver = item.effect.within
            size = 1.0 if driver is None else largest(setting, traces, driver)
            if not low * size <= abs(item.amplitude) <= high * size:
                raise Failure("an amplitude that nature does not have")
        if item.gate is not None:
            share = np.mean(np.concatenate(active_samples(family, item, traces)))
            if not 0.1 <= share <= 0.7:
                raise Failure("a gate that is open or shut nearly always")
    for state in family.positive:
        if min(float(trace.states[state].min()) for trace in traces) < 1e-3:
            raise Failure("a state below zero")
    scales = signal_scales(setting, traces)
    target = stacked(family, setting, traces, scales)[0]
    if planted:
        refit, residual = recalibrate(family, setting, target, scales, theta, rng, starts=1)
    else:
        refit, residual = theta, np.zeros_like(target)
    rmse = float(np.sqrt(np.mean(residual**2)))
    return Draft(family, setting, parameters, tuple(planted), traces, scales, strengths, refit, residual, rmse)


def choose_effects(
    family: Family, setting: Setting, kind: str, rng: np.random.Generator
) -> list[tuple[Effect, bool]] | None:
    """Effects of a kind that the setting can show, each with whether it is local; None where there is none."""

    def seen(effect: Effect) -> bool:
        return all(name in setting.observed for name in effect.outputs)

    inside = [effect for effect in family.library if seen(effect)]
    if kind == "null":
        return []
    if kind == "library":
        return [(inside[rng.integers(len(inside))], False)]
    if kind == "local":
        able = [effect for effect in inside if effect.drivers]
        return [(able[rng.integers(len(able))], True)] if able else None
    if kind == "outside":
        able = [effect for effect in family.outside if seen(effect)]
        return [(able[rng.integers(len(able))], False)] if able else None
    pair = rng.choice(len(inside), 2, replace=False)
    return [(inside[i], False) for i in pair]


def make(index: int, seed: int, row: tuple[str, int, str, str], families: Sequence[str]) -> tuple[Draft, float, float]:
    """Draw until the concealment falls into the band: the draft, its noise level and κ."""
    kind, band, name, _ = row
    rng = np.random.default_rng([seed, 2, index])
    for attempt in range(400):
        # A family that cannot fill the band gives way to the next one.
        family = FAMILIES[name if attempt < 40 else families[int(rng.integers(len(families)))]]
        setting = family.draw(rng)
        parameters = {base.name: uniform(rng, *base.draw) for base in family.parameters}
        effects = choose_effects(family, setting, kind, rng)
        if effects is None:
            continue
        try:
            found = draft(family, setting, parameters, effects, rng)
            if kind == "null":
                return found, uniform(rng, *LEVELS), 0.0
            wanted = uniform(rng, *EDGES[band])
            level = found.rmse / wanted
            if not LEVELS[0] <= level <= LEVELS[1]:
                level = float(np.clip(level, *LEVELS))
                if not EDGES[band][0] <= found.rmse / level < EDGES[band][1]:
                    continue
            # Other starts only for what will be kept.
            theta = truth_vector(family, setting, parameters)
            target = stacked(family, setting, found.traces, found.scales)[0]
            refit, residual = recalibrate(family, setting, target, found.scales, theta, rng, starts=6)
            rmse = float(np.sqrt(np.mean(residual**2)))
            if rmse < found.rmse * 0.999:
                found = replace(found, refit=refit, residual=residual, rmse=rmse)
            if not EDGES[band][0] <= found.rmse / level < EDGES[band][1]:
                continue
            found = replace(found, alone=tuple(_alone(found, target, i, rng) for i in range(len(found.planted))))
            if kind == "two" and band > 0 and min(found.alone) / level < HIDDEN_SECOND:
                continue
            return found, level, found.rmse / level
        except Failure:
            continue
    raise RuntimeError(f"No case of kind {kind!r} in band {band} after 400 draws.")


def _alone(found: Draft, target: Array, number: int, rng: np.random.Generator) -> float:
    """RMSE that is left when every effect but one is known of, its amplitude fitted with the base."""
    others = [item for i, item in enumerate(found.planted) if i != number]
    if not others:
        return found.rmse
    theta = truth_vector(found.family, found.setting, found.parameters)
    _, residual = recalibrate(
        found.family, found.setting, target, found.scales, theta, rng, starts=1, planted=others
    )
    return float(np.sqrt(np.mean(residual**2)))


def add_noise(
    found: Draft, level: float, model: str, rng: np.random.Generator
) -> tuple[list[dict[str, Any]], Any, dict[str, Any]]:
    """Noisy outputs run by run, the noise that is declared, and what it really is."""
    facts: dict[str, Any] = {"model": model, "level": level}
    if model.startswith("AR(1)"):
        facts["rho"] = uniform(rng, 0.3, 0.8)
    if model.startswith("outliers"):
        facts["share"], facts["size"] = uniform(rng, 0.02, 0.05), [5, 15]
    facts["sd"] = {name: level * scale for name, scale in found.scales.items()}
    if model.startswith("quantised"):
        factor = uniform(rng, 1.0, 2.5)
        facts["step"] = {name: factor * sd for name, sd in facts["sd"].items()}
    missing = rng.random() < 0.1
    runs = []
    for trace in found.traces:
        noisy: dict[str, Any] = {}
        for name in found.setting.observed:
            clean, sd = trace.outputs[name][:, 0], facts["sd"][name]
            e = rng.standard_normal(len(clean))
            if "rho" in facts:
                for k in range(1, len(e)):
                    e[k] = facts["rho"] * e[k - 1] + np.sqrt(1 - facts["rho"] ** 2) * e[k]
            if "share" in facts:
                hit = rng.random(len(e)) < facts["share"]
                e = np.where(hit, rng.uniform(5, 15, len(e)) * rng.choice([-1, 1], len(e)), e)
            y = clean + sd * e
            if "step" in facts:
                y = facts["step"][name] * np.round(y / facts["step"][name])
            y = y.astype(object)
            if missing:
                y[rng.random(len(y)) < 0.05] = None
            noisy[name] = y.tolist()
        runs.append(noisy)
    declared = None
    if model.endswith(", known"):
        declared = facts["sd"] if len(facts["sd"]) > 1 else next(iter(facts["sd"].values()))
    return runs, declared, facts


def rivals(found: Draft, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Candidates by how well their projected tangent correlates with the planted effect's, at the calibrated base."""
    family, setting = found.family, found.setting
    seen = [e for e in family.library if all(name in setting.observed for name in e.outputs)]
    planted = list(found.planted)
    others = [e for e in seen if e.name not in [item.effect.name for item in planted]]
    items = planted + [Planted(e, e.guess, draw_shapes(e, setting, found.traces, rng)) for e in others]
    try:
        base, columns = tangents(family, setting, found.refit, found.scales, items)
    except Failure:
        return []
    keep = np.isfinite(columns).all(0)
    unit = projected(base, np.where(keep, columns, 0.0))
    table = []
    for i, item in enumerate(planted):
        for j in range(len(planted), len(items)):
            alike = float(unit[:, i] @ unit[:, j]) * np.sign(item.amplitude)
            # A rival that may only have the other sign is none.
            alike = abs(alike) if items[j].effect.sign == 0 else alike * items[j].effect.sign
            table.append({"effect": item.effect.name, "rival": items[j].effect.name, "correlation": round(alike, 6)})
    return sorted(table, key=lambda row: -row["correlation"])[:8]


def _gate(gate: Gate) -> dict[str, Any]:
    return {name: None if value in (np.inf, -np.inf) else value for name, value in asdict(gate).items()}


def numbers(values: Any) -> list[Any]:
    """An array as a list that JSON can hold."""
    return [float(f"{value:.10g}") for value in np.asarray(values, dtype=float)]


def write_case(
    index: int, seed: int, row: tuple[str, int, str, str], families: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The recording and the answer of one case, as JSON holds them."""
    found, level, kappa = make(index, seed, row, families)
    rng = np.random.default_rng([seed, 3, index])
    noisy, declared, facts = add_noise(found, level, row[3], rng)
    family, setting = found.family, found.setting
    case: dict[str, Any] = {"family": family.name, "noise": declared, "units": dict(family.units) | dict(family.states)}
    if family.static:
        case["x"] = {name: numbers(values) for name, values in setting.x.items()}
        case["y"] = noisy[0]
    else:
        case["runs"] = [
            {
                "time": numbers(run.time),
                "outputs": outputs,
                "inputs": {name: numbers(values) for name, values in run.inputs.items()},
                "initial": {name: run.initial[name] for name in run.known},
            }
            for run, outputs in zip(setting.runs, noisy, strict=True)
        ]
    effects = []
    for number, (item, value) in enumerate(zip(found.planted, found.strengths, strict=True)):
        masks = active_samples(family, item, found.traces)
        effects.append({
            "name": item.effect.name,
            "library": item.effect.library,
            "amplitude": item.amplitude,
            "shapes": dict(item.shapes),
            "gate": None if item.gate is None else _gate(item.gate),
            "places": [s for s in item.effect.rates if s in family.states] + list(item.effect.outputs),
            "strength": value,
            "kappa": found.alone[number] / level,
            "active": None if item.gate is None else [mask.astype(int).tolist() for mask in masks],
        })  # fmt: skip
    answer = {
        "family": family.name,
        "late": bool(family.late),
        "kind": row[0],
        "kappa": kappa,
        "noise": facts,
        "effects": effects,
        "rivals": rivals(found, rng) if found.planted else [],
        "parameters": found.parameters,
        "initial": [dict(run.initial) for run in setting.runs],
        "refit": dict(zip(labels(family, setting), found.refit.tolist(), strict=True)),
        "rmse_base": {name: found.rmse * scale for name, scale in found.scales.items()},
        "truth": [{name: numbers(v[:, 0]) for name, v in trace.outputs.items()} for trace in found.traces],
        "states": [{name: numbers(v[:, 0]) for name, v in trace.states.items() if name in family.states}
                   for trace in found.traces],
        "added": [[{name: numbers(v[:, 0]) for name, v in part.items()
                    if name in family.states or name.startswith("output ")} for part in trace.added]
                  for trace in found.traces],
    }  # fmt: skip
    return case, answer


def families_of(seed: int) -> list[str]:
    """Names of the families that a set of this seed holds."""
    if seed >= NEWEST_SEED:
        late = 2 + (seed >= FRESH_SEED) + (seed >= UNSEEN_SEED) + (seed >= BLIND_SEED)
        return [name for name, family in FAMILIES.items() if family.late == late]
    return [name for name, family in FAMILIES.items() if family.late <= int(seed >= FIRST_TEST_SEED)]


def generate(out: Path, cases: int, seed: int, *, progress: bool = True) -> Path:
    """Write ``out/cases/*.json``, ``out/answers.sha256`` and ``out/answers.json``.

    Args:
        out: Folder, made if need be.
        cases: Number of cases.
        seed: Below `FIRST_TEST_SEED` for development; from `NEWEST_SEED` on for the newest families alone, from
            `FRESH_SEED` on for the fresh ones, from `UNSEEN_SEED` on for the unseen ones, from `BLIND_SEED` on for the
            blind ones.
        progress: Whether to say how far it is.
    """
    families = families_of(seed)
    (out / "cases").mkdir(parents=True, exist_ok=True)
    answers = {}
    for index, row in enumerate(plan(cases, seed, families)):
        name = f"{seed:04d}-{index:03d}"
        case, answer = write_case(index, seed, row, families)
        answers[name] = answer
        (out / "cases" / f"{name}.json").write_text(json.dumps({"id": name, **case}))
        if progress:
            print(f"{name}  {answer['family']}", flush=True)
    text = json.dumps(answers, indent=None, sort_keys=True)
    (out / "answers.sha256").write_text(hashlib.sha256(text.encode()).hexdigest() + "\n")
    (out / "answers.json").write_text(text)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    generate(given.out, given.cases, given.seed)


if __name__ == "__main__":
    main()
