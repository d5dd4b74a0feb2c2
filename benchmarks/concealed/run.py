"""Let torchcal diagnose the cases, frozen: one call with the same settings for all of them."""

import argparse
import functools
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.concealed.workers import run_all
from torchcal.discovery.findings.as_json import plain

NUMBER = r"[-+0-9.einfa]+"
REGION = re.compile(rf"^\s*(?:(?P<low>{NUMBER}) < )?(?P<driver>.+?)(?: (?P<sign>[<>]) (?P<end>{NUMBER}))?\s*$")


def parse_region(text: str) -> tuple[str, float, float] | None:
    """Driver and ends of a range such as ``"1.5 < t < 3"``, ``"x > 0.2"`` or ``"h < 1"``.

    >>> parse_region("1.5 < t < 3"), parse_region("x > 0.2")
    (('t', 1.5, 3.0), ('x', 0.2, inf))
    """
    found = REGION.match(text)
    if found is None or found["end"] is None:
        return None
    try:
        end = float(found["end"])
        low = float(found["low"]) if found["low"] else -math.inf
    except ValueError:
        return None
    return (found["driver"], end, math.inf) if found["sign"] == ">" else (found["driver"], low, end)


def _short(values: Any) -> Any:
    return None if values is None else [float(f"{value:.7g}") for value in values.tolist()]


def _region(diagnosis: Any) -> dict[str, Any] | None:
    """Where the mismatch acts, and which samples that holds: the accepted term's own window, or the first place."""
    spans, driver, source = None, None, ""
    for row in diagnosis.ranking:
        if list(row.terms) == list(diagnosis.terms) and getattr(row, "region", None):
            parsed = parse_region(row.region)
            if parsed is not None:
                driver, spans, source = parsed[0], [parsed[1:]], "window"
                break
    if spans is None and not diagnosis.terms:
        for row in diagnosis.ranking:
            if row.terms and row.refitted and getattr(row, "region", None):
                parsed = parse_region(row.region)
                if parsed is not None:
                    driver, spans, source = parsed[0], [parsed[1:]], "window"
                break
    if spans is None and diagnosis.where:
        best = diagnosis.where[0]
        driver, spans, source = best.driver, list(best.spans), "where"
    if spans is None or driver not in diagnosis.drivers:
        return None
    values = diagnosis.drivers[driver].reshape(-1)
    inside = values < -math.inf
    for low, high in spans:
        inside = inside | ((values >= low) & (values <= high))
    return {"driver": driver, "spans": spans, "source": source, "mask": inside.int()}


def summary(diagnosis: Any) -> dict[str, Any]:
    """What the scorer needs of a diagnosis."""
    rows = [
        {
            "terms": row.terms,
            "probability": row.probability,
            "log_evidence": row.log_evidence,
            "physical": row.physical,
            "refitted": row.refitted,
            "region": row.region,
            "aliases": row.aliases,
            "held_out_rmse": row.held_out_rmse,
            "misfit_removed": row.misfit_removed,
            "score": row.score,
            "estimates": [(e.name, e.value, e.sd, e.at_bound) for e in row.estimates],
        }
        for row in diagnosis.ranking
    ]
    missing, experiment = diagnosis.missing, diagnosis.experiment
    after = diagnosis.after
    return plain({
        "verdict": diagnosis.verdict,
        "terms": diagnosis.terms,
        "tied": diagnosis.tied,
        "ranking": rows[:30],
        "region": _region(diagnosis),
        "where": [
            {name: getattr(place, name) for name in ("kind", "target", "driver", "spans", "share", "evidence")}
            for place in diagnosis.where
        ],
        "limits": [(row.term, row.parameter, row.smallest, row.power, row.note) for row in diagnosis.detection_limit],
        "remaining": diagnosis.remaining,
        "p_detect": diagnosis.p_detect,
        "confidence": diagnosis.confidence,
        "before": None if diagnosis.before.held_out is None else diagnosis.before.held_out.rmse,
        "after": None if after is None or after.held_out is None else after.held_out.rmse,
        "held_out": diagnosis.held_out,
        "predicted_before": None if diagnosis.before is None else _short(diagnosis.before.prediction),
        "predicted_after": None if after is None else _short(after.prediction),
        "missing": None if missing is None else {
            "kind": missing.kind, "target": missing.target, "driver": missing.driver, "time": missing.time,
            "along": missing.along,
        },
        "experiment": None if experiment is None else {
            "description": experiment.description, "separation": experiment.separation,
            "conditions": experiment.conditions,
        },
        "noise": {"sd": diagnosis.noise.sd, "correlation": diagnosis.noise.correlation,
                  "outliers": diagnosis.noise.outliers},
        "library": diagnosis.library,
        "seconds": diagnosis.seconds,
    })  # fmt: skip


def diagnose_case(case: Mapping[str, Any], seed: int = 0) -> dict[str, Any]:
    """One case as JSON holds it."""
    import warnings

    import torch

    import torchcal as tc
    from benchmarks.concealed import models

    torch.set_num_threads(1)
    given = models.problem(case)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        diagnosis = tc.diagnose(given.simulator, given.recording, given.candidates, seed=seed, progress=False)
    return {"family": given.family, **summary(diagnosis)}


def diagnose_file(folder: str, seed: int, name: str) -> dict[str, Any]:
    """One case by its name."""
    return diagnose_case(json.loads((Path(folder) / f"{name}.json").read_text()), seed)


def run(out: Path, *, seed: int = 0, workers: int = 2, limit: float = 180.0, only: tuple[str, ...] = ()) -> Path:
    """Diagnose ``out/cases/*.json`` into ``out/results.jsonl``."""
    names = sorted(path.stem for path in (out / "cases").glob("*.json"))
    names = [name for name in names if not only or name in only]
    job = functools.partial(diagnose_file, str(out / "cases"), seed)
    run_all(job, names, out / "results.jsonl", workers=workers, limit=limit)
    return out / "results.jsonl"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder that holds cases/")
    parser.add_argument("--seed", type=int, default=0, help="of the diagnosis")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--limit", type=float, default=180.0, help="seconds a case")
    parser.add_argument("cases", nargs="*", help="names of cases; all by default")
    given = parser.parse_args()
    run(given.out, seed=given.seed, workers=given.workers, limit=given.limit, only=tuple(given.cases))


if __name__ == "__main__":
    main()
