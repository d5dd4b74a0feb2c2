"""A few worker processes with a time limit a case; a worker that exceeds it is ended and replaced."""

import json
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

Job = Callable[[str], dict[str, Any]]


@dataclass
class _Worker:
    process: Any
    pipe: Connection
    item: str | None = None
    begun: float = 0.0


def _serve(pipe: Connection, job: Job) -> None:
    while True:
        item = pipe.recv()
        if item is None:
            return
        begun = time.perf_counter()
        try:
            found = job(item)
        except Exception as error:
            found = {"failure": f"{type(error).__name__}: {error}"}
        found.setdefault("seconds", time.perf_counter() - begun)
        pipe.send(found)


def _hire(job: Job) -> _Worker:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there, job), daemon=True)
    process.start()
    return _Worker(process, here)


def run_all(job: Job, items: Sequence[str], results: Path, *, workers: int = 2, limit: float = 180.0) -> None:
    """Run ``job(item)`` for every item that ``results`` does not hold yet, and append what it returns as JSON lines.

    Args:
        job: A function of a module, which returns what JSON can hold.
        items: Names; they are written as ``"id"``.
        results: File of JSON lines; an interrupted run goes on where it stopped.
        workers: Number of processes, each with one thread for linear algebra.
        limit: Seconds a case; more is a failure.
    """
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    results.parent.mkdir(parents=True, exist_ok=True)
    done = {row["id"] for row in read(results)}
    waiting = [item for item in items if item not in done]
    staff = [_hire(job) for _ in range(min(workers, len(waiting)))]
    with results.open("a") as file:

        def keep(worker: _Worker, found: dict[str, Any]) -> None:
            file.write(json.dumps({"id": worker.item, **found}) + "\n")
            file.flush()
            worker.item = None

        try:
            while waiting or any(worker.item for worker in staff):
                for worker in staff:
                    if worker.item is None and waiting:
                        worker.item, worker.begun = waiting.pop(0), time.perf_counter()
                        worker.pipe.send(worker.item)
                ready = wait([worker.pipe for worker in staff if worker.item], timeout=1.0)
                for place, worker in enumerate(staff):
                    if worker.item is None:
                        continue
                    if worker.pipe in ready:
                        try:
                            keep(worker, worker.pipe.recv())
                        except EOFError:
                            keep(worker, {"failure": "the process died", "seconds": limit})
                            staff[place] = _hire(job)
                    elif time.perf_counter() - worker.begun > limit:
                        worker.process.terminate()
                        worker.process.join()
                        keep(worker, {"failure": f"no answer after {limit:g} s", "seconds": limit})
                        staff[place] = _hire(job)
        finally:
            for worker in staff:
                if worker.item is None and worker.process.is_alive():
                    worker.pipe.send(None)
                else:
                    worker.process.terminate()
            for worker in staff:
                worker.process.join(5)


def read(results: Path) -> list[dict[str, Any]]:
    """Rows of a JSON-lines file, one a case, the last where there are several; a broken last line is left out."""
    rows: dict[str, dict[str, Any]] = {}
    if results.exists():
        for line in results.read_text().splitlines():
            try:
                row = json.loads(line)
            except json.JSONDecodeError:
                continue
            rows[row["id"]] = row
    return list(rows.values())
