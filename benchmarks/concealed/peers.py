"""Other ways to name what is missing, on the same recordings: sparse regression (pysindy), regressions, refits.

They know as much as torchcal: the base, its parameters' bounds, and the family's candidates with the truth's own
formulas. That is generous: shape parameters are offered on a grid around the truth's ranges, base parameters are
always kept beside the candidates (they are projected out, which is the same as keeping them in the regression), and
thresholds and the smoothing are chosen case by case, by BIC. A peer that cannot treat a case gives no answer: sparse
regression needs every state (a velocity may come from its position), all regressions of rates are blind to
instruments and hidden states.
"""

import argparse
import functools
import itertools
import json
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.concealed.families import FAMILIES
from benchmarks.concealed.families.base import (
    Array,
    Effect,
    Failure,
    Family,
    Planted,
    RunSetting,
    Setting,
    simulate,
    stacked,
    unknowns,
)
from benchmarks.concealed.generate import recalibrate
from benchmarks.concealed.workers import run_all

#: Velocities that a practitioner would get by differentiating a measured position.
DERIVED = {
    "oscillator": {"v": "x"},
    "pendulum": {"w": "q"},
    "falling body": {"v": "z"},
    "two masses": {"v1": "x1", "v2": "x2"},
    "orbit": {"vx": "x", "vy": "y"},
    "rolling ship": {"w": "q"},
}
THRESHOLDS = (0.02, 0.05, 0.1, 0.2, 0.4)
RIDGES = (0.05, 5.0)
WINDOWS = (5, 7, 11, 15, 21, 31)
#: Share of the bootstrap models that must hold a term of ensemble SINDy.
INCLUDED = 0.6
#: BIC difference that counts as very strong evidence (Raftery 1995).
STRONG = 10.0


@dataclass(frozen=True)
class Case:
    """A recording as the peers see it."""

    family: Family
    setting: Setting
    data: list[dict[str, Array]]
    scales: dict[str, float]
    target: Array
    weights: Array


def read_case(case: Mapping[str, Any]) -> Case:
    """Arrays of a case; unknown initial states get a first guess."""
    family = FAMILIES[case["family"]]
    if family.static:
        x = {name: np.asarray(values, dtype=float) for name, values in case["x"].items()}
        data = [{name: np.asarray(values, dtype=float) for name, values in case["y"].items()}]
        setting = Setting(x=x, observed=tuple(case["y"]))
    else:
        runs, data = [], []
        for run in case["runs"]:
            outputs = {name: np.asarray(values, dtype=float) for name, values in run["outputs"].items()}
            initial = {}
            for state in family.states:
                if state in run["initial"]:
                    initial[state] = float(run["initial"][state])
                elif state in outputs:
                    initial[state] = float(outputs[state][np.isfinite(outputs[state])][0])
                else:
                    initial[state] = _guess(family, state, np.asarray(run["time"]), outputs)
            inputs = {name: np.asarray(values, dtype=float) for name, values in run["inputs"].items()}
            runs.append(RunSetting(np.asarray(run["time"]), inputs, initial, tuple(run["initial"])))
            data.append(outputs)
        setting = Setting(tuple(runs), observed=tuple(case["runs"][0]["outputs"]))
    scales = {name: float(np.nanstd(np.concatenate([d[name] for d in data]))) for name in setting.observed}
    target = np.concatenate([d[name] / scales[name] for name in setting.observed for d in data])
    weights = np.isfinite(target).astype(float)
    return Case(family, setting, data, scales, np.where(weights > 0, target, 0.0), weights)


def _guess(family: Family, state: str, t: Array, outputs: Mapping[str, Array]) -> float:
    source = DERIVED.get(family.name, {}).get(state)
    if source in outputs:
        y = outputs[source]
        k = np.flatnonzero(np.isfinite(y))[:6]
        return float(np.polyfit(t[k] - t[0], y[k], 1)[0])
    same = [name for name in outputs if family.states[state] == family.states.get(name)]
    return float(outputs[same[0]][np.isfinite(outputs[same[0]])][0]) if same else 0.0


def shape_grid(case: Case, effect: Effect) -> list[dict[str, float]]:
    """Three values of each shape parameter across the range that it may have."""
    axes = []
    for name, (low, high, driver) in effect.shapes.items():
        size = 1.0 if driver is None else _size(case, driver)
        axes.append([(name, size * low * (high / low) ** share) for share in (0.15, 0.5, 0.85)])
    return [dict(point) for point in itertools.product(*axes)]


def _size(case: Case, driver: str) -> float:
    if case.setting.x:
        return float(np.max(abs(case.setting.x[driver])))
    if driver == "t":
        return max(float(run.time[-1]) for run in case.setting.runs)
    if driver in case.data[0]:
        return max(float(np.nanmax(abs(d[driver]))) for d in case.data)
    if driver in case.setting.runs[0].inputs:
        return max(float(np.max(abs(run.inputs[driver]))) for run in case.setting.runs)
    source = DERIVED.get(case.family.name, {}).get(driver)
    if source in case.data[0]:
        return max(
            float(np.nanmax(abs(np.gradient(d[source], run.time))))
            for d, run in zip(case.data, case.setting.runs, strict=True)
        )
    return 1.0


def visible(case: Case) -> list[Effect]:
    return [e for e in case.family.library if all(name in case.setting.observed for name in e.outputs)]


def first_guess(case: Case) -> Array:
    """Middle of the base parameters' ranges, and the guessed initial states."""
    middle = {
        base.name: float(np.sqrt(base.draw[0] * base.draw[1])) if base.draw[0] > 0 else 0.5 * sum(base.draw)
        for base in case.family.parameters
    }
    return np.array([
        middle[name] if number is None else case.setting.runs[number].initial[name]
        for name, number in unknowns(case.family, case.setting)
    ])


def calibrated(case: Case) -> tuple[Array, Array]:
    """The base fitted to the data, from five starts."""
    return recalibrate(
        case.family, case.setting, case.target, case.scales, first_guess(case), np.random.default_rng(0),
        starts=5, weights=case.weights, parts=2,
    )  # fmt: skip


# --- refit and BIC --------------------------------------------------------------------------------------


def bic(squares: float, n: float, k: int) -> float:
    return n * float(np.log(max(squares, 1e-300) / n)) + k * float(np.log(n))


def refit_bic(case: Case, base: tuple[Array, Array]) -> dict[str, Any]:
    """Each candidate added in turn and refitted with the base; a second one behind the best; the lowest BIC wins."""
    theta, residual = base
    n, d = float(case.weights.sum()), len(theta)
    scores: dict[tuple[str, ...], float] = {(): bic(float(residual @ residual), n, d)}
    fitted: dict[tuple[str, ...], tuple[Array, list[Planted]]] = {(): (theta, [])}

    def attempt(effect: Effect, behind: tuple[str, ...]) -> None:
        start, others = fitted[behind]
        names = (*behind, effect.name)
        for shapes in shape_grid(case, effect):
            signs = (1,) if effect.sign else (1, -1)
            for sign in signs:
                small = 0.05 * effect.guess if not (effect.hidden and not effect.shapes) else effect.guess
                items = [*others, Planted(effect, sign * small, shapes)]
                try:
                    z, rest = recalibrate(
                        case.family, case.setting, case.target, case.scales, start[:d], np.random.default_rng(0),
                        starts=1, planted=items, weights=case.weights, parts=2,
                    )  # fmt: skip
                except Failure:
                    continue
                extra = sum(1 + len(item.shapes) for item in items)
                value = bic(float(rest @ rest), n, d + extra)
                if value < scores.get(names, np.inf):
                    scores[names] = value
                    grown = [Planted(item.effect, float(z[d + i]), item.shapes) for i, item in enumerate(items)]
                    fitted[names] = (z[:d], grown)

    effects = visible(case)
    for effect in effects:
        attempt(effect, ())
    singles = sorted((name for name in scores if len(name) == 1), key=scores.__getitem__)
    if singles and scores[singles[0]] < scores[()] - STRONG:
        promising = [name[0] for name in singles[1:6]]
        for effect in effects:
            if effect.name in promising:
                attempt(effect, singles[0])
    best = min(scores, key=scores.__getitem__)
    if scores[best] > scores[()] - STRONG:
        best = ()
    elif len(best) == 2 and scores[best] > scores[best[:1]] - STRONG:
        best = best[:1]
    return {"terms": list(best)}


# --- rates from data ------------------------------------------------------------------------------------


def smoothed(case: Case) -> list[tuple[Array, dict[str, Array], dict[str, Array], dict[str, Array]]] | None:
    """By run: an even time grid, all states and their rates, inputs. None where a state is out of reach."""
    from pysindy import SmoothedFiniteDifference

    derived = DERIVED.get(case.family.name, {})
    if any(s not in case.setting.observed and derived.get(s) not in case.setting.observed for s in case.family.states):
        return None
    found = []
    for run, data in zip(case.setting.runs, case.data, strict=True):
        grid = np.linspace(run.time[0], run.time[-1], len(run.time))
        states, rates = {}, {}
        for name in case.setting.observed:
            good = np.isfinite(data[name])
            y = np.interp(grid, run.time[good], data[name][good])
            y = _without_outliers(y)
            window = _window(y)

            def differentiate(values: Array, width: int = window, grid: Array = grid) -> tuple[Array, Array]:
                method = SmoothedFiniteDifference(smoother_kws={"window_length": width, "polyorder": 3})
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    slope = np.asarray(method(values[:, None], grid))[:, 0]
                    return np.asarray(method.smoothed_x_)[:, 0], slope

            states[name], rates[name] = differentiate(y)
            for velocity, source in derived.items():
                if source == name and velocity not in case.setting.observed:
                    states[velocity], rates[velocity] = differentiate(rates[name])
        inputs = {name: np.interp(grid, run.time, values) for name, values in run.inputs.items()}
        found.append((grid, states, rates, inputs))
    return found


def _without_outliers(y: Array) -> Array:
    wide = np.pad(y, 3, mode="edge")
    middle = np.median(np.lib.stride_tricks.sliding_window_view(wide, 7), axis=1)
    off = abs(y - middle)
    spread = 1.4826 * np.median(off) + 1e-12
    return np.where(off > 6 * spread, middle, y)


def _window(y: Array) -> int:
    """The widest smoothing that leaves no more than the noise, whose size the third differences tell."""
    from scipy.signal import savgol_filter

    noise = float(np.sqrt(np.mean(np.diff(y, 3) ** 2) / 20))
    fitting = [w for w in WINDOWS if w < len(y) and np.std(y - savgol_filter(y, w, 3)) <= 1.15 * noise]
    return max(fitting, default=WINDOWS[0])


def regression(case: Case, theta: Array) -> tuple[Array, Array, Array, list[str], list[Any]] | None:
    """``rate − base``, base features, candidate features, their names, and the runs' own pieces for the weak form."""
    runs = smoothed(case)
    if runs is None:
        return None
    family = case.family
    assert family.rates is not None
    names = [base.name for base in family.parameters]
    p = {name: np.array([theta[i]]) for i, name in enumerate(names)}
    derived = DERIVED.get(family.name, {})
    equations = [s for s in family.states if s not in derived.values()] if derived else list(family.states)
    scale = {s: float(np.std(np.concatenate([rates[s] for _, _, rates, _ in runs]))) or 1.0 for s in equations}
    labels: list[str] = []
    pieces = []
    for t, s, rates, u in runs:
        plain = _rows(family.rates(t, s, p, u), equations, scale, len(t))
        gaps = np.concatenate([rates[e] / scale[e] for e in equations]) - plain
        base_columns = []
        for i, name in enumerate(names):
            step = 1e-5 * max(abs(theta[i]), 1e-3)
            moved = _rows(family.rates(t, s, {**p, name: p[name] + step}, u), equations, scale, len(t))
            base_columns.append((moved - plain) / step)
        columns, labels = [], []
        for effect in case.family.library:
            if effect.hidden or effect.outputs:
                continue
            for shapes in shape_grid(case, effect):
                small = 1e-3 * effect.guess
                c = {"a": np.array([small]), **shapes}
                rate = {e: f(t, s, p, u, c) / small for e, f in effect.rates.items()}
                columns.append(_rows(rate, equations, scale, len(t)))
                labels.append(effect.name)
        pieces.append((t, s, rates, gaps, np.array(base_columns).T, np.array(columns).T, equations, scale, plain))
    return (
        np.concatenate([piece[3] for piece in pieces]),
        np.concatenate([piece[4] for piece in pieces]),
        np.concatenate([piece[5] for piece in pieces]),
        labels,
        pieces,
    )


def _rows(rates: Mapping[str, Any], equations: Sequence[str], scale: Mapping[str, float], n: int) -> Array:
    return np.concatenate([np.broadcast_to(rates.get(e, 0.0), (n,)) / scale[e] for e in equations])


def _project(base: Array, *arrays: Array) -> list[Array]:
    u, s, _ = np.linalg.svd(base, full_matrices=False)
    q = u[:, s > 1e-9 * s[0]]
    return [array - q @ (q.T @ array) for array in arrays]


def _normal(columns: Array) -> tuple[Array, Array]:
    size = np.sqrt(np.mean(columns**2, axis=0))
    alive = size > 1e-8
    return np.where(alive, columns / np.where(alive, size, 1.0), 0.0), size


def _ranked(coefficients: Array, labels: Sequence[str]) -> list[str]:
    """Names of the terms that a sparse model holds, the largest contribution first."""
    order = np.argsort(-abs(coefficients))
    return list(dict.fromkeys(labels[i] for i in order if coefficients[i] != 0))


def _least(columns: Array, target: Array) -> float:
    if not columns.shape[1]:
        return float(target @ target)
    z = np.linalg.lstsq(columns, target, rcond=None)[0]
    return float(np.sum((target - columns @ z) ** 2))


def sparse(target: Array, base: Array, columns: Array, labels: Sequence[str], n: float, *, ensemble: bool) -> list[str]:
    """Sequentially thresholded least squares over a grid of thresholds; BIC chooses, the empty model among them."""
    from pysindy import STLSQ, EnsembleOptimizer

    y, x = _project(base, target, columns)
    x, _ = _normal(x)
    size = float(np.sqrt(np.mean(y**2))) or 1.0
    y = y / size
    share = n / len(y)
    best, value = np.zeros(len(labels)), bic(float(y @ y) * share, n, 0)
    for threshold, alpha in itertools.product(THRESHOLDS, RIDGES):
        optimizer: Any = STLSQ(threshold=threshold, alpha=alpha, max_iter=20)
        if ensemble:
            optimizer = EnsembleOptimizer(optimizer, bagging=True, n_models=30)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            np.random.seed(0)  # noqa: NPY002 - pysindy draws from the global state
            optimizer.fit(x, y[:, None])
        coefficients = np.asarray(optimizer.coef_)[0]
        if ensemble:
            held = np.mean([np.asarray(c).reshape(-1) != 0 for c in optimizer.coef_list], axis=0)
            coefficients = np.where(held >= INCLUDED, np.median(np.reshape(optimizer.coef_list, (30, -1)), axis=0), 0.0)
        chosen = coefficients != 0
        now = bic(_least(x[:, chosen], y) * share, n, int(chosen.sum()))
        if now < value - STRONG:
            best, value = coefficients, now
    return _ranked(best, labels)


def joint_sindy(case: Case, rows: Any) -> dict[str, Any]:
    target, base, columns, labels, pieces = rows
    n = _independent(case, pieces)
    return {"terms": sparse(target, base, columns, labels, n, ensemble=False)}


def ensemble_sindy(case: Case, rows: Any) -> dict[str, Any]:
    target, base, columns, labels, pieces = rows
    n = _independent(case, pieces)
    return {"terms": sparse(target, base, columns, labels, n, ensemble=True)}


def _independent(case: Case, pieces: Sequence[Any]) -> float:
    """Number of independent rates: smoothing ties neighbours together."""
    windows = [_window(_without_outliers(np.nan_to_num(d[o], nan=float(np.nanmean(d[o])))))
               for d in case.data for o in case.setting.observed]  # fmt: skip
    return max(10.0, sum(len(piece[3]) for piece in pieces) / (0.5 * float(np.mean(windows))))


def weak_sindy(case: Case, rows: Any) -> dict[str, Any]:
    """The same regression in integrals against test functions instead of rates."""
    from pysindy import IdentityLibrary, WeakPDELibrary

    _, _, _, labels, pieces = rows
    domains = 60
    parts: list[list[Array]] = [[], [], []]
    for t, s, _rates, _gaps, base, columns, equations, scale, plain in pieces:
        n = len(t)
        for k, equation in enumerate(equations):
            rows_here = slice(k * n, (k + 1) * n)
            block = np.column_stack([s[equation] / scale[equation], plain[rows_here], base[rows_here],
                                     columns[rows_here]])  # fmt: skip
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                np.random.seed(k)  # noqa: NPY002 - pysindy draws from the global state
                library = WeakPDELibrary(
                    function_library=IdentityLibrary(), spatiotemporal_grid=t, K=domains, include_bias=False, p=4,
                    H_xt=[(t[-1] - t[0]) / 12],
                )  # fmt: skip
                weak = np.asarray(library.fit_transform([block])[0])
                slope = np.asarray(library.convert_u_dot_integral(block[:, :1]))[:, 0]
            m = base.shape[1]
            parts[0].append(slope - weak[:, 1])
            parts[1].append(weak[:, 2 : 2 + m])
            parts[2].append(weak[:, 2 + m :])
    target, base, columns = (np.concatenate(part) for part in parts)
    return {"terms": sparse(target, base, columns, labels, float(len(target)) / 3, ensemble=False)}


def residual_regression(case: Case, rows: Any, base_fit: tuple[Array, Array]) -> dict[str, Any]:
    """What is left of the calibrated base's rates (static: outputs) on the candidates, stepwise."""
    if case.family.static:
        theta, residual = base_fit
        columns, labels = [], []
        for effect in visible(case):
            for shapes in shape_grid(case, effect):
                a = np.array([[1e-3 * effect.guess], [0.0]])
                both = stacked(
                    case.family, case.setting,
                    simulate(case.family, case.setting, np.tile(theta, (2, 1)), [Planted(effect, 0.0, shapes)], a),
                    case.scales,
                )  # fmt: skip
                columns.append((both[0] - both[1]) / (1e-3 * effect.guess) * case.weights)
                labels.append(effect.name)
        target, x, n = residual, np.array(columns).T, float(case.weights.sum())
    else:
        target, _, x, labels, pieces = rows
        n = _independent(case, pieces)
    x, _ = _normal(x)
    chosen: list[int] = []
    share = n / len(target)
    value = bic(_least(x[:, []], target) * share, n, 0)
    while len(chosen) < 3:
        options = {
            i: bic(_least(x[:, [*chosen, i]], target) * share, n, len(chosen) + 1)
            for i in range(len(labels)) if labels[i] not in [labels[j] for j in chosen]
        }  # fmt: skip
        if not options:
            break
        best = min(options, key=options.__getitem__)
        if options[best] > value - STRONG:
            break
        chosen.append(best)
        value = options[best]
    return {"terms": [labels[i] for i in chosen]}


def compare(case: Mapping[str, Any]) -> dict[str, Any]:
    """Every peer's answer on one case: its terms in order, or why it has none."""
    given = read_case(case)
    found: dict[str, Any] = {"family": given.family.name}
    base, rows, reason = None, None, ""
    try:
        base = calibrated(given)
    except Failure as error:
        reason = f"the base cannot be calibrated: {error}"
    if base is not None and not given.family.static:
        rows = regression(given, base[0])
        reason = "" if rows is not None else "a state is not observed"
    elif given.family.static:
        reason = "a static model has no rates"
    jobs = {
        "joint SINDy": (rows is not None, lambda: joint_sindy(given, rows)),
        "ensemble SINDy": (rows is not None, lambda: ensemble_sindy(given, rows)),
        "weak SINDy": (rows is not None, lambda: weak_sindy(given, rows)),
        "residual regression": (
            base is not None and (rows is not None or given.family.static),
            lambda: residual_regression(given, rows, base),  # type: ignore[arg-type]
        ),
        "refit + BIC": (base is not None, lambda: refit_bic(given, base)),  # type: ignore[arg-type]
    }
    for name, (able, job) in jobs.items():
        begun = time.perf_counter()
        answer: dict[str, Any] = {"no answer": reason}
        if able:
            try:
                answer = job()
            except (Failure, np.linalg.LinAlgError, ValueError) as error:
                answer = {"no answer": f"{type(error).__name__}: {error}"}
        found[name] = {**answer, "seconds": time.perf_counter() - begun}
    return found


def compare_file(folder: str, name: str) -> dict[str, Any]:
    return compare(json.loads((Path(folder) / f"{name}.json").read_text()))


def run(out: Path, *, workers: int = 2, limit: float = 300.0) -> Path:
    """The peers' answers on ``out/cases/*.json`` into ``out/peers.jsonl``."""
    names = sorted(path.stem for path in (out / "cases").glob("*.json"))
    job = functools.partial(compare_file, str(out / "cases"))
    run_all(job, names, out / "peers.jsonl", workers=workers, limit=limit)
    return out / "peers.jsonl"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder that holds cases/")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    run(given.out, workers=given.workers)


if __name__ == "__main__":
    main()
