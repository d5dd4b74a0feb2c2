"""Two follow-ups of a run: effects planted at the stated detection limits, and the proposed experiments carried out."""

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.concealed.experiment import setting_of
from benchmarks.concealed.families import FAMILIES
from benchmarks.concealed.families.base import Failure, Planted, simulate, truth_vector
from benchmarks.concealed.score import credit
from benchmarks.concealed.workers import read, run_all

#: Terms whose amplitude the tool counts in other units than the generator.
OTHER_UNITS = ("radiation", "evaporation", "lag of")


def plant_at_limit(
    case: Mapping[str, Any], answer: Mapping[str, Any], result: Mapping[str, Any], *, seed: int = 0
) -> tuple[dict[str, Any], str, float] | None:
    """A null's conditions again, with one candidate planted at its stated limit and fresh white noise.

    Returns:
        The case, the term and the stated power; None where no candidate is fit for it.
    """
    family, setting = FAMILIES[answer["family"]], setting_of(case, answer)
    able = {
        e.name: e for e in family.library
        if not e.shapes and not e.name.startswith(OTHER_UNITS) and all(o in setting.observed for o in e.outputs)
    }  # fmt: skip
    rows = [row for row in result["limits"] if row[0] in able and row[2] is not None]
    rng = np.random.default_rng([seed, 5, len(rows)])
    theta = truth_vector(family, setting, answer["parameters"])
    for place in rng.permutation(len(rows)):
        term, _, size, power, _ = rows[place]
        effect = able[term]
        sign = effect.sign or int(rng.choice([-1, 1]))
        try:
            traces = simulate(family, setting, theta, [Planted(effect, sign * size)])
        except Failure:
            continue
        noisy = []
        for trace in traces:
            clean = {name: trace.outputs[name][:, 0] for name in setting.observed}
            sd = answer["noise"]["sd"]
            noisy.append({k: (y + sd[k] * rng.standard_normal(len(y))).tolist() for k, y in clean.items()})
        if family.static:
            return {**case, "y": noisy[0]}, term, power
        runs = [{**run, "outputs": outputs} for run, outputs in zip(case["runs"], noisy, strict=True)]
        return {**case, "runs": runs}, term, power
    return None


def _limit(folder: str, name: str) -> dict[str, Any]:
    from benchmarks.concealed.run import diagnose_case

    out = Path(folder)
    case = json.loads((out / "cases" / f"{name}.json").read_text())
    answer = json.loads((out / "answers.json").read_text())[name]
    result = next(row for row in read(out / "results.jsonl") if row["id"] == name)
    found = plant_at_limit(case, answer, result)
    if found is None:
        return {"skipped": "no candidate with a limit"}
    fresh, term, power = found
    again = diagnose_case(fresh)
    return {"term": term, "power": power, "hit": again["verdict"] != "consistent", "verdict": again["verdict"]}


def _experiment(folder: str, name: str) -> dict[str, Any]:
    from benchmarks.concealed.experiment import repeat
    from benchmarks.concealed.run import diagnose_case

    out = Path(folder)
    case = json.loads((out / "cases" / f"{name}.json").read_text())
    answer = json.loads((out / "answers.json").read_text())[name]
    result = next(row for row in read(out / "results.jsonl") if row["id"] == name)
    again = diagnose_case(repeat(case, answer, result["experiment"]["conditions"]))
    return {"hit": credit(again, answer) == 1.0, "verdict": again["verdict"], "terms": again["terms"],
            "experiment": result["experiment"]["description"]}  # fmt: skip


def limits(out: Path, *, workers: int = 2, limit: float = 180.0) -> None:
    """Plant one effect at its limit in every null with white noise of known size."""
    answers = json.loads((out / "answers.json").read_text())
    names = [row["id"] for row in read(out / "results.jsonl")
             if answers[row["id"]]["kind"] == "null" and answers[row["id"]]["noise"]["model"] == "white, known"
             and "limits" in row]  # fmt: skip
    run_all(functools.partial(_limit, str(out)), names, out / "limits.jsonl", workers=workers, limit=limit)


def experiments(out: Path, *, workers: int = 2, limit: float = 180.0) -> None:
    """Carry out the experiment that was proposed for every ambiguous case whose effect is in the library."""
    answers = json.loads((out / "answers.json").read_text())
    names = [row["id"] for row in read(out / "results.jsonl")
             if row.get("verdict") == "ambiguous" and row.get("experiment")
             and answers[row["id"]]["kind"] in ("library", "local", "two")]  # fmt: skip
    run_all(functools.partial(_experiment, str(out)), names, out / "experiments.jsonl", workers=workers, limit=limit)
