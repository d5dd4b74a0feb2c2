"""Every sampler on every posterior, and how times grow: ``python -m benchmarks.sampling``."""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.sampling import report
from benchmarks.sampling.posteriors import GROWTH, MAIN
from benchmarks.sampling.run import Settings, once, prepare, read_reference, reference
from benchmarks.sampling.samplers import SAMPLERS

GROWING = ("torchcal", "numpyro-whitened-16")
CHAINS = {"torchcal": (16, 64, 256, 1024), "numpyro-whitened-16": (1, 4, 16, 64)}
ON_CHAINS = "cubic-linear-0.01"
SMALL = ("cubic-linear-0.01", "cubic-quadratic-0.01")


@dataclass(frozen=True)
class Job:
    """A row to be: its key, and what runs."""

    key: str
    posterior: str
    sampler: str
    options: dict[str, Any]
    growth: bool = False


def jobs(posteriors: list[str], samplers: list[str], *, growth: bool, small: bool) -> Iterator[Job]:
    """Rows of the main table, then those of the growth."""
    for posterior in posteriors:
        for sampler in samplers:
            yield Job(f"{posterior}__{sampler}", posterior, sampler, {})
    if not growth:
        return
    for sampler in (name for name in GROWING if name in samplers):
        for axis, sizes in GROWTH.items():
            for size in list(sizes)[: 2 if small else None]:
                yield Job(f"grow-{axis}-{size}__{sampler}", f"grow-{axis}-{size}", sampler, {}, True)
        for chains in CHAINS[sampler][: 2 if small else None]:
            yield Job(f"grow-chains-{chains}__{sampler}", ON_CHAINS, sampler, {"chains": chains}, True)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sampling", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("outputs/sampling"), help="a rerun goes on from what is there")
    parser.add_argument("--small", action="store_true", help="two posteriors, lower goals, a shorter limit")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="posteriors and samplers, by name")
    parser.add_argument("--goals", nargs="+", type=int, help="effective samples whose time is taken")
    parser.add_argument("--limit", type=float, help="seconds a row; beyond it figures are extrapolated (~)")
    parser.add_argument("--threads", type=int, default=2, help="of every process")
    parser.add_argument("--no-growth", action="store_true")
    parser.add_argument("--no-reference", action="store_true", help="without errors of mean and sd")
    given = parser.parse_args(arguments)
    settings = Settings(given.out, threads=given.threads)
    if given.small:
        settings = replace(settings, goals=(1000, 5000), limit=60.0, reference=20_000, reference_limit=60.0)
    if given.goals:
        settings = replace(settings, goals=tuple(sorted(given.goals)))
    if given.limit:
        settings = replace(settings, limit=given.limit, reference_limit=min(settings.reference_limit, 3 * given.limit))
    only = given.only or []
    unknown = [name for name in only if name not in MAIN and name not in SAMPLERS]
    if unknown:
        parser.error(f"Expected names among {[*MAIN, *SAMPLERS]}. Got {unknown}.")
    posteriors = [name for name in only if name in MAIN] or list(SMALL if given.small else MAIN)
    samplers = [name for name in only if name in SAMPLERS] or list(SAMPLERS)
    given.out.mkdir(parents=True, exist_ok=True)
    first = settings.goals[0]
    growing = replace(settings, goals=(first, 10 * first), limit=min(60.0, settings.limit))
    rows, growth = [], []
    for job in jobs(posteriors, samplers, growth=not given.no_growth, small=given.small):
        prepare(settings, job.posterior)
        if not (given.no_reference or job.growth):
            reference(settings, job.posterior)
        wanted = growing if job.growth else settings
        row = {**once(wanted, job.key, job.posterior, job.sampler, **job.options), "key": job.key}
        print(report.line(row), flush=True)
        (growth if job.growth else rows).append(row)
    facts = {name: prepare(settings, name) for name in posteriors}
    found = {name: read_reference(settings, name) for name in posteriors}
    text = report.markdown(settings, rows, growth, facts, found)
    (given.out / "table.md").write_text(text)
    (given.out / "rows.json").write_text(json.dumps({"rows": rows, "growth": growth, "facts": facts}, indent=1))
    report.draw(settings, rows, growth, given.out)
    print(f"{given.out / 'table.md'} is written")


if __name__ == "__main__":
    main()
