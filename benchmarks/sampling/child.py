"""One job in a fresh process: ``python -m benchmarks.sampling.child FD JOB``, with the job as JSON."""

import json
import os
import sys
import time
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks.sampling.link import Link


def prepare(connection: Connection, folder: Path, name: str) -> None:
    """Write a posterior's arrays; tell how long its maximum took, and how well the other densities agree."""
    import numpy as np
    import scipy.optimize  # noqa: F401 - here, so that the search is timed without it

    from benchmarks.sampling import posteriors
    from benchmarks.sampling.maximum import search

    posterior = posteriors.make(name, folder)
    arrays, seconds = posteriors.export(posterior)
    libraries: dict[str, Any] = {"numpy": np}
    try:
        import jax
        import jax.numpy as jnp
    except ImportError:
        pass
    else:
        jax.config.update("jax_enable_x64", True)
        libraries["jax"] = jnp
    differences = {key: posteriors.disagreement(arrays, xp) for key, xp in libraries.items()}
    began = time.perf_counter()
    found = search(arrays)
    other = time.perf_counter() - began
    best = -float(arrays.check_values[0])
    arrays.save(folder / f"{name}.npz")
    size = {"d": int(arrays.rows.max()) + 1, "P": len(arrays.map), "N": len(arrays.y), "nodes": len(arrays.psi)}
    connection.send(
        {
            "title": posterior.title,
            "differences": differences,
            "torchcal_seconds": seconds,
            "search_seconds": other,
            "search_found_it": found <= best + 1e-3 * abs(best) + 1e-3,
            **size,
        }
    )


def main() -> None:
    connection, job = Connection(int(sys.argv[1])), json.loads(sys.argv[2])
    threads = int(os.environ["BENCHMARK_THREADS"])
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[-threads:])
    folder = Path(job["folder"])
    try:
        if job["sampler"] == "prepare":
            prepare(connection, folder, job["posterior"])
            return
        from benchmarks.sampling import samplers

        link = Link(connection)
        samplers.run(link, folder, job["sampler"], job["posterior"], **job["options"])
    except Exception as error:
        traceback.print_exc()
        connection.send({"error": f"{type(error).__name__}: {error}"})


if __name__ == "__main__":
    main()
