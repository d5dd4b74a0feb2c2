"""Join results and answers: the table by κ band, peers beside it, and a reliability diagram.

What the numbers mean:

- *named right*: verdict ``named`` and exactly the planted terms. Another name counts as right only where the planted
  effect's projected tangent has a correlation of at least 0.9999 with it (sign included), or where the tool itself
  merged both and says so.
- *top-1*: the best hypothesis with a term is the planted one, and the verdict is ``named`` or ``ambiguous``; for a peer
  its first term.
- *top-1 as stated*: the same as far as the tool's own probabilities go, the mean over the cases of the first
  hypothesis' share of all that have terms (0 with another verdict). Beyond it top-1 can only be luck, if the
  probabilities are right; if they are, the two agree.
- *top-1 of a judge*: what it would be for a judge who knows everything but the name (`ideal.py`): nobody can be
  expected to reach more.
- *tied-set hit*: named right, or ``ambiguous`` with the planted term among the tied hypotheses.
- *false alarm*: any verdict but ``consistent`` on a null; for a peer any term.
- *wrong name*: verdict ``named`` where the effect is not in the library.
- *precision*: share of right names among all names given, nulls and effects outside the library included.
- *no wrong name*: share of the recordings with names in which every name given was planted, whether or not all that was
  planted was named.
- Of two terms, one named and the other reported as remaining (`REMAINS` of the misfit or more, or both
  among what is listed beside the name) counts as half.
- *right equation*: the first place of ``where``, or the named term, acts on an equation or output of the effect.
- *region F1*: overlap of the samples in the reported and in the planted region; 0 where nothing was found.
- *held-out ratio*: RMSE against the noise-free truth on held-out samples, with the named term over without.
- *missing rate*: relative L2 error of the estimated missing rate, after what the base's own parameters can make up
  for is taken out of both; of a parameter in time, of what its shift does to every rate.

Intervals are Wilson's, 95 %.
"""

import argparse
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.concealed.families import FAMILIES
from benchmarks.concealed.families.base import Array
from benchmarks.concealed.workers import read

BANDS = {"κ < 0.3": (0.0, 0.3), "0.3 ≤ κ < 1": (0.3, 1.0), "κ ≥ 1": (1.0, math.inf)}
SAME = 0.9999
NEARLY = 0.995
REMAINS = 0.02
NONE = ["none of these"]
PEERS = ("joint SINDy", "ensemble SINDy", "weak SINDy", "residual regression", "refit + BIC")
GOALS = {
    "top-1": "≥ 0.85 / ≥ 0.95",
    "tied-set hit": "≥ 0.95",
    "false alarms": "≤ 0.02",
    "wrong names out of library": "≤ 0.10",
    "precision when named": "≥ 0.97",
    "region F1": "≥ 0.85",
    "held-out ratio": "≤ 0.2",
    "missing rate, relative L2": "≤ 0.3",
    "seconds a case, median": "≤ 15",
}
FOLLOW_UPS = {
    "limits": "Effects planted at the stated detection limit that were detected",
    "experiments": "Ambiguous cases that the proposed experiment turned into the right name",
}


def wilson(hits: float, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's interval of a proportion.

    >>> low, high = wilson(8, 10)
    >>> round(low, 3), round(high, 3)
    (0.49, 0.943)
    """
    if trials == 0:
        return 0.0, 1.0
    p = hits / trials
    middle = (p + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(p * (1 - p) / trials + z * z / (4 * trials**2))
    return max(0.0, middle - half), min(1.0, middle + half)


def share(values: Iterable[float]) -> dict[str, Any]:
    """Mean of hits (0, 0.5 or 1) with its interval."""
    hits = list(values)
    if not hits:
        return {"n": 0, "value": None, "low": None, "high": None}
    low, high = wilson(sum(hits), len(hits))
    return {"n": len(hits), "value": sum(hits) / len(hits), "low": low, "high": high}


def middle(values: Iterable[float | None]) -> dict[str, Any]:
    """Median with quartiles."""
    found = sorted(v for v in values if v is not None and math.isfinite(v))
    if not found:
        return {"n": 0, "value": None, "low": None, "high": None}
    low, value, high = (float(q) for q in np.quantile(found, [0.25, 0.5, 0.75]))
    return {"n": len(found), "value": value, "low": low, "high": high}


def average(values: Iterable[float]) -> dict[str, Any]:
    """Mean with two standard errors."""
    found = list(values)
    if not found:
        return {"n": 0, "value": None, "low": None, "high": None}
    mean, half = float(np.mean(found)), 1.959964 * float(np.std(found)) / math.sqrt(len(found))
    return {"n": len(found), "value": mean, "low": max(0.0, mean - half), "high": min(1.0, mean + half)}


def band(kappa: float) -> str:
    return next(name for name, (low, high) in BANDS.items() if low <= kappa < high)


def planted(answer: Mapping[str, Any]) -> list[str]:
    return [effect["name"] for effect in answer["effects"]]


def names_of(name: str, answer: Mapping[str, Any], result: Mapping[str, Any] | None = None) -> set[str]:
    """What a planted effect may be called."""
    alike = {r["rival"]: r["correlation"] for r in answer["rivals"] if r["effect"] == name}
    found = {name} | {rival for rival, correlation in alike.items() if correlation >= SAME}
    own = {effect.name for effect in FAMILIES[answer["family"]].library}
    for row in (result or {}).get("ranking", ()):
        if len(row["terms"]) == 1 and name in (row.get("aliases") or ()):
            first = row["terms"][0]
            # Merged by the tool: believed where the generator's own tangents, sign included, do not deny it.
            if first not in own or alike.get(first, 0.0) >= NEARLY:
                found.add(first)
    return found


def matches(terms: Sequence[str], answer: Mapping[str, Any], result: Mapping[str, Any] | None = None) -> int:
    """How many of the planted effects the terms name, each term used once."""
    left, count = list(terms), 0
    for name in planted(answer):
        hit = next((term for term in left if term in names_of(name, answer, result)), None)
        if hit is not None:
            left.remove(hit)
            count += 1
    return count


def exact(terms: Sequence[str], answer: Mapping[str, Any], result: Mapping[str, Any] | None = None) -> bool:
    """Whether the terms are the planted ones and no others."""
    return len(terms) == len(answer["effects"]) and matches(terms, answer, result) == len(terms)


def credit(result: Mapping[str, Any], answer: Mapping[str, Any]) -> float:
    """1 for the right name or names, ½ for one of two with the rest reported as remaining, else 0."""
    if result.get("verdict") != "named" or answer["kind"] in ("null", "outside"):
        return 0.0
    terms = result["terms"]
    if exact(terms, answer, result):
        return 1.0
    one_of_two = answer["kind"] == "two" and len(terms) == 1 and matches(terms, answer, result) == 1
    reported = (result["remaining"] or 0.0) >= REMAINS or any(exact(t, answer, result) for t in result["tied"])
    return 0.5 if one_of_two and reported else 0.0


def best_terms(result: Mapping[str, Any]) -> list[str]:
    """Terms of the best hypothesis that has any."""
    if result.get("verdict") == "named":
        return list(result["terms"])
    rows = (row["terms"] for row in result.get("ranking", ()) if row["terms"] and row["terms"] != NONE)
    return list(next(rows, []))


def top(result: Mapping[str, Any], answer: Mapping[str, Any]) -> float:
    """Whether the best hypothesis with a term is the planted one."""
    if result.get("verdict") not in ("named", "ambiguous"):
        return 0.0
    terms = best_terms(result)
    if answer["kind"] == "two":
        return max(credit(result, answer), 1.0 if exact(terms, answer, result) else 0.0)
    return float(exact(terms, answer, result))


def first_share(result: Mapping[str, Any]) -> float:
    """Probability of the best hypothesis among those with terms, wherever they act."""
    if result.get("verdict") not in ("named", "ambiguous"):
        return 0.0
    best, every = frozenset(best_terms(result)), [row for row in result["ranking"] if row["terms"] not in ([], NONE)]
    total = sum(row["probability"] for row in every)
    return sum(row["probability"] for row in every if frozenset(row["terms"]) == best) / total if total else 0.0


def tied_hit(result: Mapping[str, Any], answer: Mapping[str, Any]) -> float:
    """Named right, or among the tied."""
    if result.get("verdict") == "ambiguous":
        return float(any(exact(terms, answer, result) for terms in result["tied"]))
    return credit(result, answer)


def right_equation(result: Mapping[str, Any], answer: Mapping[str, Any]) -> float:
    """Whether the first place, or the named term, acts where the effect does."""
    if result.get("verdict") in (None, "consistent"):
        return 0.0
    places = {place for effect in answer["effects"] for place in effect["places"]}
    if result["verdict"] == "named" and matches(result["terms"], answer, result):
        return 1.0
    first = next((row for row in result["where"] if row["kind"] in ("equation", "output")), None)
    return float(first is not None and first["target"] in places)


def region_f1(result: Mapping[str, Any], answer: Mapping[str, Any]) -> float:
    """F1 of the reported region's samples; 0 where nothing was found."""
    active = np.concatenate([np.asarray(mask, dtype=bool) for mask in answer["effects"][0]["active"]])
    region = result.get("region")
    if result.get("verdict") in (None, "consistent") or region is None or len(region["mask"]) != len(active):
        return 0.0
    said = np.asarray(region["mask"], dtype=bool)
    both = int(np.sum(said & active))
    return 2 * both / max(int(said.sum()) + int(active.sum()), 1)


def held_out_ratio(result: Mapping[str, Any], answer: Mapping[str, Any]) -> float | None:
    """RMSE against the truth on the held-out samples, after over before, each output in units of its noise."""
    held, before, after = (result.get(key) for key in ("held_out", "predicted_before", "predicted_after"))
    if not (held and before and after):
        return None
    truth, sizes = [], []
    for name in result["noise"]["sd"]:  # in the recording's order, which the answers do not keep
        for run in answer["truth"]:
            truth += run[name]
            sizes += [answer["noise"]["sd"][name]] * len(run[name])
    if len(truth) != len(held):
        return None
    mask = np.asarray(held, dtype=bool)
    errors = [(np.asarray(values, dtype=float) - truth) / sizes for values in (before, after)]
    old, new = (float(np.sqrt(np.mean(error[mask] ** 2))) for error in errors)
    return new / old if old > 0 else None


def stated(result: Mapping[str, Any], answer: Mapping[str, Any]) -> tuple[float, bool] | None:
    """The probability of the most probable hypothesis, and whether it is the truth."""
    rows = [row for row in result.get("ranking", ()) if row["probability"] is not None]
    if not rows:
        return None
    best = max(rows, key=lambda row: row["probability"])
    terms = list(best["terms"])
    if answer["kind"] == "null":
        return best["probability"], terms == []
    if answer["kind"] == "outside":
        return best["probability"], terms == NONE
    return best["probability"], exact(terms, answer, result)


# --- the missing rate ----------------------------------------------------------------------------------


def missing_error(result: Mapping[str, Any], answer: Mapping[str, Any], case: Mapping[str, Any]) -> float | None:
    """Relative L2 error of the estimated missing rate; 1 where it was sought in the wrong place or not at all."""
    if result.get("verdict") in (None, "consistent"):
        return None
    estimate = result.get("missing")
    if estimate is None:
        return 1.0
    family = FAMILIES[answer["family"]]
    place = estimate["target"] if estimate["kind"] != "output" else "output " + estimate["target"]
    p = {name: np.array([value]) for name, value in answer["parameters"].items()}
    if family.static:
        return _static_error(estimate, answer, case, p)
    assert family.rates is not None
    time, along = np.asarray(estimate["time"], dtype=float), np.asarray(estimate["along"], dtype=float)
    runs = np.concatenate([[0], np.cumsum(np.diff(time) < 0)])
    wanted, found, base = [], [], []
    for number, run in enumerate(case["runs"]):
        here = runs == number
        t = np.asarray(run["time"])
        if not here.any():
            continue
        s = {name: np.asarray(values) for name, values in answer["states"][number].items()}
        u = {name: np.asarray(values) for name, values in run["inputs"].items()}
        shift = np.interp(t, time[here], along[here])
        places = list(family.states) if estimate["kind"] == "parameter" else [place]
        for name in places:
            parts = [part[name] for part in answer["added"][number] if name in part]
            wanted.append(np.sum(parts, axis=0) if parts else np.zeros_like(t))
            if estimate["kind"] == "parameter":  # what it does to the rate
                moved = {**p, estimate["target"]: p[estimate["target"]] + shift}
                found.append(_at(family, name, t, s, moved, u) - _at(family, name, t, s, p, u))
            else:
                found.append(shift)
            base.append(_slopes(lambda q, name=name, s=s, u=u, t=t: _at(family, name, t, s, q, u), p, len(t)))
    return _relative(np.concatenate(found), np.concatenate(wanted), np.concatenate(base))


def _static_error(
    estimate: Mapping[str, Any], answer: Mapping[str, Any], case: Mapping[str, Any], p: dict[str, Array]
) -> float:
    family = FAMILIES[answer["family"]]
    name = next(iter(family.outputs))
    x = {key: np.asarray(values, dtype=float) for key, values in case["x"].items()}
    along, row = np.asarray(estimate["along"], dtype=float), np.asarray(estimate["time"], dtype=int)
    x = {key: values[row] for key, values in x.items()}  # some data are missing, or were set aside
    if estimate["kind"] == "parameter":
        q = {key: np.array([value]) for key, value in answer["refit"].items()}
        moved = {**q, estimate["target"]: q[estimate["target"]] + along}
        found = family.outputs[name](None, x, moved, x) - family.outputs[name](None, x, q, x)
    else:
        found = along
    true = np.sum([part["output " + name] for part in answer["added"][0]], axis=0)[row]
    return _relative(found, true, _slopes(lambda q: family.outputs[name](None, x, q, x), p, len(true)))


def _at(family: Any, place: str, t: Array, s: Any, p: Any, u: Any) -> Array:
    if place.startswith("output "):
        return np.zeros_like(t)
    return np.broadcast_to(family.rates(t, s, p, u).get(place, 0.0), t.shape)


def _slopes(function: Callable[[dict[str, Array]], Array], p: dict[str, Array], n: int) -> Array:
    plain, columns = np.broadcast_to(function(p), (n,)), []
    for name, value in p.items():
        step = 1e-6 * max(abs(float(value[0])), 1e-3)
        columns.append((np.broadcast_to(function({**p, name: value + step}), (n,)) - plain) / step)
    return np.array(columns).T


def _relative(found: Array, wanted: Array, base: Array) -> float:
    if not np.any(wanted):
        return 1.0
    u, s, _ = np.linalg.svd(base, full_matrices=False)
    q = u[:, s > 1e-9 * max(float(s[0]), 1e-300)]
    left = [values - q @ (q.T @ values) for values in (found - wanted, wanted)]
    return float(np.linalg.norm(left[0]) / max(float(np.linalg.norm(left[1])), 1e-300))


# --- tables ----------------------------------------------------------------------------------------------


def table(
    results: Mapping[str, Mapping[str, Any]],
    answers: Mapping[str, Mapping[str, Any]],
    cases: Mapping[str, Mapping[str, Any]] | None = None,
    ideal: Mapping[str, float] | None = None,
) -> dict[str, dict[str, Any]]:
    """Every measure for torchcal, by band and over all. A case that failed counts as no answer."""
    rows: dict[str, dict[str, Any]] = {}

    def pick(kinds: Sequence[str], within: str | None = None) -> list[str]:
        return [
            key for key, answer in answers.items()
            if key in results and answer["kind"] in kinds and (within is None or band(answer["kappa"]) == within)
        ]  # fmt: skip

    single, every = ("library", "local"), ("library", "local", "two")
    for name in (*BANDS, None):
        label = name or "all"
        column: dict[str, Any] = {}
        keys = pick(single, name)
        column["top-1"] = share(top(results[k], answers[k]) for k in keys)
        column["top-1 as stated"] = average(first_share(results[k]) for k in keys)
        if ideal:
            column["top-1 of a judge"] = average(ideal[k] for k in keys if k in ideal)
        column["named right"] = share(credit(results[k], answers[k]) for k in keys)
        column["tied-set hit"] = share(tied_hit(results[k], answers[k]) for k in keys)
        column["two terms, credit"] = share(credit(results[k], answers[k]) for k in pick(("two",), name))
        column["right equation"] = share(
            right_equation(results[k], answers[k]) for k in pick((*every, "outside"), name)
        )
        column["detected"] = share(
            float(results[k].get("verdict") in ("named", "ambiguous", "unexplained"))
            for k in pick((*every, "outside"), name)
        )
        outside = pick(("outside",), name)
        column["wrong names out of library"] = share(float(results[k].get("verdict") == "named") for k in outside)
        named = [k for k in pick((*every, "outside"), name) if results[k].get("verdict") == "named"]
        if name is None:
            named = [k for k in pick((*every, "outside", "null")) if results[k].get("verdict") == "named"]
        column["precision when named"] = share(credit(results[k], answers[k]) for k in named)
        column["no wrong name among those given"] = share(
            float(matches(results[k]["terms"], answers[k], results[k]) == len(results[k]["terms"])) for k in named
        )
        local = pick(("local",), name)
        column["region F1"] = _mean([region_f1(results[k], answers[k]) for k in local])
        column["held-out ratio"] = middle(
            held_out_ratio(results[k], answers[k]) for k in pick(every, name) if results[k].get("verdict") == "named"
        )
        if cases is not None:
            column["missing rate, relative L2"] = middle(
                missing_error(results[k], answers[k], cases[k]) for k in outside if "verdict" in results[k]
            )
        rows[label] = column
    nulls = pick(("null",))
    rows["all"]["false alarms"] = share(float(results[k].get("verdict") not in ("consistent", None)) for k in nulls)
    rows["all"]["named on nulls"] = share(float(results[k].get("verdict") == "named") for k in nulls)
    rows["all"]["failures"] = share(float("failure" in results[k]) for k in results if k in answers)
    rows["all"]["seconds a case, median"] = middle(results[k].get("seconds") for k in results)
    return rows


def _mean(values: Sequence[float]) -> dict[str, Any]:
    if not values:
        return {"n": 0, "value": None, "low": None, "high": None}
    centre = float(np.mean(values))
    half = 1.96 * float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else float("nan")
    return {"n": len(values), "value": centre, "low": max(0.0, centre - half), "high": min(1.0, centre + half)}


def peer_table(
    results: Mapping[str, Mapping[str, Any]], answers: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """The same measures, as far as they apply, for each peer. No answer names nothing: never right, never an alarm."""
    found = {}
    for peer in PEERS:
        said = {k: (row.get(peer) or {"no answer": "failure"}) for k, row in results.items() if k in answers}
        terms = {k: row.get("terms", []) for k, row in said.items()}
        column: dict[str, Any] = {"answered": share(float("terms" in row) for row in said.values())}
        for name in BANDS:
            keys = [k for k in said if answers[k]["kind"] in ("library", "local") and band(answers[k]["kappa"]) == name]
            column[f"top-1, {name}"] = share(float(bool(terms[k]) and exact(terms[k][:1], answers[k])) for k in keys)
            column[f"exactly right, {name}"] = share(float(exact(terms[k], answers[k])) for k in keys)
        answered = [k for k in said if "terms" in said[k]]
        null = [k for k in answered if answers[k]["kind"] == "null"]
        outside = [k for k in answered if answers[k]["kind"] == "outside"]
        named = [k for k in answered if terms[k]]
        column["false alarms (of those answered)"] = share(float(bool(terms[k])) for k in null)
        column["wrong names out of library (of those answered)"] = share(float(bool(terms[k])) for k in outside)
        column["precision when named"] = share(
            float(answers[k]["kind"] not in ("null", "outside") and exact(terms[k], answers[k])) for k in named
        )
        column["seconds a case, median"] = middle(said[k].get("seconds") for k in answered)
        found[peer] = column
    return found


def _cell(value: Mapping[str, Any] | None) -> str:
    if value is None or value["value"] is None:
        return "–"
    ends = "" if value["low"] is None else f" [{value['low']:.2f}, {value['high']:.2f}]"
    return f"{value['value']:.2f}{ends} (n = {value['n']})"


def markdown(rows: Mapping[str, Mapping[str, Any]], *, goals: bool = False) -> str:
    """Columns of measures as a Markdown table."""
    measures = list(dict.fromkeys(measure for column in rows.values() for measure in column))
    head = ["", *rows, *(["goal"] if goals else [])]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for measure in measures:
        cells = [_cell(column.get(measure)) for column in rows.values()]
        lines.append("| " + " | ".join([measure, *cells, *([GOALS.get(measure, "")] if goals else [])]) + " |")
    return "\n".join(lines)


def reliability(results: Mapping[str, Any], answers: Mapping[str, Any], bins: int = 8) -> list[dict[str, float]]:
    """Stated probability of the most probable hypothesis against how often it was right, in equal-count bins."""
    pairs = sorted(
        pair for pair in (stated(results[k], answers[k]) for k in results if k in answers) if pair is not None
    )
    found = []
    for group in np.array_split(np.array(pairs, dtype=float).reshape(-1, 2), min(bins, max(len(pairs), 1))):
        if len(group):
            low, high = wilson(float(group[:, 1].sum()), len(group))
            found.append({"stated": float(group[:, 0].mean()), "right": float(group[:, 1].mean()), "low": low,
                          "high": high, "n": len(group)})  # fmt: skip
    return found


def reliability_figure(points: Sequence[Mapping[str, float]], path: Path) -> None:
    """The reliability diagram."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, ax = plt.subplots(figsize=(4.5, 4.5))
    ax.plot([0, 1], [0, 1], color="0.6", lw=1)
    for point in points:
        ax.plot([point["stated"]] * 2, [point["low"], point["high"]], color="C0", lw=1)
    ax.plot([p["stated"] for p in points], [p["right"] for p in points], "o-", color="C0")
    ax.set(xlabel="stated probability of the best hypothesis", ylabel="share that was right", xlim=(0, 1.02),
           ylim=(0, 1.02), aspect="equal")  # fmt: skip
    fig.tight_layout()
    fig.savefig(path, dpi=150)
    plt.close(fig)


def failures(results: Mapping[str, Any], answers: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Cases that are not as they should be, with what was said and what was true."""
    rows = []
    for key in sorted(answers):
        answer, result = answers[key], results.get(key)
        if result is None:
            continue
        verdict = result.get("verdict", result.get("failure", "no answer"))
        kind = answer["kind"]
        if kind == "null":
            good = verdict == "consistent"
        elif kind == "outside":
            good = verdict != "named"
        else:
            good = tied_hit(result, answer) > 0 or (verdict == "consistent" and answer["kappa"] < 0.3)
        if not good:
            rows.append({
                "case": key, "family": answer["family"], "kind": kind, "kappa": round(answer["kappa"], 2),
                "noise": answer["noise"]["model"], "planted": planted(answer), "verdict": verdict,
                "said": result.get("terms") or result.get("tied", []),
            })  # fmt: skip
    return rows


def load_answers(out: Path) -> dict[str, Any]:
    """The answers, if they are those whose hash was published.

    Raises:
        ValueError: If they are not.
    """
    text = (out / "answers.json").read_bytes()
    published = (out / "answers.sha256").read_text().strip()
    if hashlib.sha256(text).hexdigest() != published:
        raise ValueError(f"Expected answers with the SHA-256 {published}. Got others (they were changed).")
    return dict(json.loads(text))


def score(out: Path) -> str:
    """Everything about ``out`` as Markdown; also ``out/score.md``, ``out/score.json`` and ``out/reliability.png``."""
    answers = load_answers(out)
    results = {row["id"]: row for row in read(out / "results.jsonl")}
    peers = {row["id"]: row for row in read(out / "peers.jsonl")}
    cases = {key: json.loads((out / "cases" / f"{key}.json").read_text()) for key in answers if key in results}
    ideal = {row["id"]: row["first"] for row in read(out / "ideal.jsonl") if "first" in row}
    rows = table(results, answers, cases, ideal)
    points = reliability(results, answers)
    parts = [f"{len(results)} of {len(answers)} cases. Intervals: Wilson 95 % (medians: quartiles).", "",
             markdown(rows, goals=True)]  # fmt: skip
    found: dict[str, Any] = {"torchcal": rows, "reliability": points, "failures": failures(results, answers)}
    if peers:
        found["peers"] = peer_table(peers, answers)
        parts += ["", markdown(found["peers"])]
    for name in ("limits", "experiments"):
        extra = [row for row in read(out / f"{name}.jsonl") if "hit" in row]
        if extra:
            found[name] = share(float(row["hit"]) for row in extra)
            parts += ["", f"{FOLLOW_UPS[name]}: {_cell(found[name])}"]
            if name == "limits":
                parts[-1] += f" (stated: {np.mean([row['power'] for row in extra]):.2f})"
    parts += ["", "Not as they should be:", ""]
    parts += [
        f"- {row['case']} {row['family']}, {row['kind']}, κ = {row['kappa']}, {row['noise']}: "
        f"planted {', '.join(row['planted']) or 'nothing'}; {row['verdict']} {row['said'] or ''}"
        for row in found["failures"]
    ]
    text = "\n".join(parts) + "\n"
    (out / "score.md").write_text(text)
    (out / "score.json").write_text(json.dumps(found, indent=1, ensure_ascii=False))
    if points:
        reliability_figure(points, out / "reliability.png")
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description="Score a run of the suite.")
    parser.add_argument("--out", type=Path, required=True)
    print(score(parser.parse_args().out))


if __name__ == "__main__":
    main()
