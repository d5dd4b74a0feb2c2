"""Jobs in fresh processes, one after another: what they drew, how long it took, written down as it comes."""

import importlib.util
import json
import math
import subprocess
import sys
import time
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.sampling.density import Arrays
from benchmarks.sampling.judge import Quality, errors, judge
from benchmarks.sampling.link import threads
from benchmarks.sampling.samplers import SAMPLERS

ROOT = Path(__file__).parents[2]
REFERENCES = (("numpyro-whitened-16", {"seed": 77}), ("pyro-whitened", {}))
"""Samplers for the reference run; the first whose package is there."""


@dataclass(frozen=True)
class Settings:
    """Of a whole benchmark.

    Attributes:
        out: Folder of all files.
        goals: Effective samples whose time is taken.
        limit: Seconds of a sampler's own time after which its figures are extrapolated.
        reference: Effective samples of the reference run.
        reference_limit: Its limit, seconds.
        threads: That each process may use.
    """

    out: Path
    goals: tuple[int, ...] = (1000, 50_000)
    limit: float = 120.0
    reference: int = 50_000
    reference_limit: float = 300.0
    threads: int = 2

    @property
    def folder(self) -> Path:
        """Posteriors."""
        return self.out / "posteriors"


class Process:
    """A job in a fresh process, its output in a log."""

    def __init__(self, settings: Settings, job: dict[str, Any]) -> None:
        log = settings.out / "logs" / f"{job['posterior']}__{job['sampler']}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        settings.folder.mkdir(parents=True, exist_ok=True)
        self.connection, other = Pipe()
        text = json.dumps({"options": {}, **job, "folder": str(settings.folder.resolve())})
        with log.open("w") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.sampling.child", str(other.fileno()), text],
                cwd=ROOT,
                env=dict(threads(settings.threads)),
                pass_fds=[other.fileno()],
                stdout=file,
                stderr=subprocess.STDOUT,
            )
        other.close()

    def __enter__(self) -> Connection:
        return self.connection

    def __exit__(self, *_: object) -> None:
        self.connection.close()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


# --- posteriors ------------------------------------------------------------------------------------------------


def prepare(settings: Settings, name: str, *, tolerance: float = 1e-9, patience: float = 1800.0) -> dict[str, Any]:
    """Arrays of a posterior and facts about it, once. Raises where the densities of the peers do not agree."""
    facts = settings.folder / f"{name}.json"
    if not (facts.exists() and (settings.folder / f"{name}.npz").exists()):
        with Process(settings, {"posterior": name, "sampler": "prepare"}) as connection:
            message = _receive(connection, patience)
        if "error" in message:
            raise RuntimeError(f"Expected the posterior {name!r} to be prepared. Got {message['error']}.")
        write(facts, message)
    found = json.loads(facts.read_text())
    for library, difference in found["differences"].items():
        if not difference <= tolerance:
            raise RuntimeError(
                f"Expected the log-density of {name} in {library} within {tolerance:g} of torchcal's. Got "
                f"{difference:.2g}."
            )
    return found


def charge(facts: dict[str, Any]) -> float:
    """Seconds that finding the maximum costs a sampler that is handed it: the cheaper way that finds it."""
    own = facts["torchcal_seconds"]
    return min(own, facts["search_seconds"]) if facts["search_found_it"] else own


# --- rows ------------------------------------------------------------------------------------------------------


def race(settings: Settings, posterior: str, sampler: str, **options: Any) -> dict[str, Any]:
    """One row: a sampler on a posterior."""
    facts = prepare(settings, posterior)
    arrays = Arrays.load(settings.folder / f"{posterior}.npz")
    row: dict[str, Any] = {"posterior": posterior, "sampler": sampler, **options}
    _, _, module, handed = SAMPLERS[sampler]
    if importlib.util.find_spec(module) is None:
        return {**row, "failed": f"{module} is not installed"}
    row["charged"] = charge(facts) if handed else 0.0
    reference = read_reference(settings, posterior)
    if module == "torchcal":
        return {**row, **_whole(settings, arrays, row, options, reference)}
    return {**row, **_blocks(settings, arrays, row, options, reference)}


def _whole(
    settings: Settings, arrays: Arrays, row: dict[str, Any], options: dict[str, Any], reference: Quality | None
) -> dict[str, Any]:
    """torchcal runs once for each goal, since `calibrate` is one call; each from cold."""
    times: dict[str, Any] = {}
    points = []
    found: dict[str, Any] = {}
    for goal in settings.goals:
        job = {"posterior": row["posterior"], "sampler": row["sampler"], "options": {**options, "goal": goal}}
        with Process(settings, job) as connection:
            message = _receive(connection, 3 * settings.limit + 60)
            if "draws" in message:
                connection.send(0)
        if "draws" not in message:
            if not points:
                return {"failed": message["error"]}
            times[str(goal)] = {"seconds": math.nan, "failed": message["error"]}
            continue
        quality = judge(arrays, message["draws"])
        seconds, ess = message["seconds"], quality.worst
        points.append((seconds, ess))
        reached = ess >= 0.95 * goal  # judged after folding on the exported maximum, which moves the last digits
        times[str(goal)] = {"seconds": seconds if reached else seconds * goal / ess, "extrapolated": not reached}
        if reached and quality.converged:
            times[str(goal)]["converged"] = seconds
        found = _figures(message, quality, reference, message["draws"].shape)
    (t0, e0), (t1, e1) = points[0], points[-1]
    # Between two runs that are far apart; goals near one another end in nearly the same run.
    rate = (e1 - e0) / (t1 - t0) if e1 > 4 * e0 and t1 > t0 else e1 / t1
    return {"times": times, "rate": rate, **found}


def _blocks(
    settings: Settings, arrays: Arrays, row: dict[str, Any], options: dict[str, Any], reference: Quality | None
) -> dict[str, Any]:
    """Other samplers draw in blocks until the last goal or the limit is reached; the clock stands while one judges."""
    times: dict[str, Any] = {}
    parts: list[np.ndarray] = []
    found: dict[str, Any] = {}
    first_wait, rate, ended = 3 * settings.limit + 60, math.nan, ""
    charged = row["charged"]
    job = {"posterior": row["posterior"], "sampler": row["sampler"], "options": options}
    with Process(settings, job) as connection:
        while True:
            message = _receive(connection, first_wait)
            if "draws" not in message:
                ended = message["error"]
                break
            parts.append(message["draws"])
            draws = np.concatenate(parts, 1)
            quality = judge(arrays, draws)
            seconds, ess = message["seconds"] + charged, quality.worst
            rate = ess / max(1e-9, message["seconds"] - message["warm"])
            found = _figures(message, quality, reference, draws.shape)
            for goal in settings.goals:
                if ess >= goal:
                    time_of = times.setdefault(str(goal), {"seconds": seconds, "extrapolated": False})
                    if quality.converged:
                        time_of.setdefault("converged", seconds)
            open_goals = [goal for goal in settings.goals if "converged" not in times.get(str(goal), {})]
            sampled = message["seconds"] - message["warm"]
            # A rate needs some time to be known, however long the warm-up took.
            left = max(settings.limit - seconds, 0.05 * settings.limit - sampled)
            if not open_goals or left <= 0:
                connection.send(0)
                break
            each = sampled / draws.shape[1]
            # Where only R-hat is still too high, a third more.
            wanted = draws.shape[1] * max(1.05 * min(open_goals) / ess - 1, 0.33)
            left = left / max(each, 1e-12)
            connection.send(max(4, math.ceil(min(wanted, 2 * draws.shape[1], left))))
    if not found:
        return {"failed": ended}
    for goal in settings.goals:
        if str(goal) not in times:
            times[str(goal)] = {"seconds": found["warm"] + charged + goal / rate, "extrapolated": True}
    return {"times": times, "rate": rate, "ended": ended, **found}


def _figures(
    message: dict[str, Any], quality: Quality, reference: Quality | None, shape: tuple[int, ...]
) -> dict[str, Any]:
    return {
        "seconds": message["seconds"],
        "warm": message["warm"],
        "chains": shape[0],
        "draws": shape[1],
        "ess": quality.worst,
        "r_hat": float(quality.r_hat.max()),
        "memory": message["memory"],
        "divergences": message.get("divergences"),
        **({} if reference is None else errors(quality, reference)),
    }


def _receive(connection: Connection, patience: float) -> dict[str, Any]:
    began = time.monotonic()
    while time.monotonic() - began < patience:
        if connection.poll(min(1.0, patience)):
            try:
                return connection.recv()
            except EOFError:
                return {"error": "its process ended without a word"}
    return {"error": f"no draws after {patience:.0f} s"}


# --- reference -------------------------------------------------------------------------------------------------


def reference(settings: Settings, posterior: str) -> None:
    """A long run of another package, once: what means and sds are held against."""
    path = settings.folder / f"{posterior}__reference.npz"
    if path.exists():
        return
    prepare(settings, posterior)
    arrays = Arrays.load(settings.folder / f"{posterior}.npz")
    sampler, options = next(
        found for found in REFERENCES if importlib.util.find_spec(SAMPLERS[found[0]][2]) is not None
    )
    parts: list[np.ndarray] = []
    with Process(settings, {"posterior": posterior, "sampler": sampler, "options": options}) as connection:
        while True:
            message = _receive(connection, 3 * settings.reference_limit + 60)
            if "draws" not in message:
                break
            parts.append(message["draws"])
            draws = np.concatenate(parts, 1)
            quality = judge(arrays, draws)
            if quality.worst >= settings.reference or message["seconds"] >= settings.reference_limit:
                connection.send(0)
                break
            connection.send(draws.shape[1])
    if not parts:
        raise RuntimeError(f"Expected a reference run of {posterior}. Got {message['error']}.")
    np.savez(
        path, ess=quality.ess, r_hat=quality.r_hat, mean=quality.mean, sd=quality.sd, sampler=np.array(sampler)
    )


def read_reference(settings: Settings, posterior: str) -> Quality | None:
    """The reference run's figures, if there is one."""
    path = settings.folder / f"{posterior}__reference.npz"
    if not path.exists():
        return None
    with np.load(path) as file:
        return Quality(file["ess"], file["r_hat"], file["mean"], file["sd"])


# --- files -----------------------------------------------------------------------------------------------------


def once(settings: Settings, key: str, posterior: str, sampler: str, **options: Any) -> dict[str, Any]:
    """A row from its file, or a race and then the file."""
    path = settings.out / "rows" / f"{key}.json"
    if path.exists():
        return json.loads(path.read_text())
    row = race(settings, posterior, sampler, **options)
    write(path, row)
    return row


def write(path: Path, content: Any) -> None:
    """JSON, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(content, indent=1))
    part.replace(path)
