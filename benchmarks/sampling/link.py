"""Between a sampler's process and the judge: draws out, with the clock stopped, and an answer back.

Imports nothing heavy, as it is part of every sampler's process.
"""

import os
import time
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np


class Enough(Exception):
    """The judge wants no more draws."""


class Link:
    """A stopwatch that starts after the imports and stands still while the judge looks at draws.

    Args:
        connection: To the judge.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self._began: float | None = None
        self._seconds = 0.0
        self._warm: float | None = None
        self._base = 0

    @property
    def seconds(self) -> float:
        """Of work so far."""
        return self._seconds + (0.0 if self._began is None else time.perf_counter() - self._began)

    def start(self) -> None:
        """Everything from here on counts."""
        _reset_peak()
        self._base = _memory("VmRSS")
        self._began = time.perf_counter()

    def warmed(self) -> None:
        """The next draws are kept. Only the first call counts."""
        if self._warm is None:
            self._warm = self.seconds

    def give(self, draws: np.ndarray, **figures: Any) -> int:
        """Hand over new draws of α ``(chains, draws, P)``; returns how many more of each chain are wanted.

        Raises:
            Enough: If none are.
        """
        self._seconds, self._began = self.seconds, None
        self.connection.send(
            {
                "draws": np.asarray(draws, dtype=np.float64),
                "seconds": self._seconds,
                "warm": self._warm,
                "memory": max(0, _memory("VmHWM") - self._base),
                **figures,
            }
        )
        more = self.connection.recv()
        if not more:
            raise Enough
        self._began = time.perf_counter()
        return more


def _memory(field: str) -> int:
    """Bytes of resident memory, now (VmRSS) or at most (VmHWM).

    Not ``ru_maxrss``: a started process inherits that from its parent.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return 1024 * int(line.split()[1])
    return 0


def _reset_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:  # the peak of the imports then counts as a peak, if nothing later exceeds it
        pass


def threads(number: int) -> Mapping[str, str]:
    """Environment of a process that may use this many threads, and finds no compiled code of earlier ones."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
    eigen = "true" if number > 1 else "false"
    return {
        **os.environ,
        **{name: str(number) for name in names},
        "XLA_FLAGS": f"--xla_cpu_multi_thread_eigen={eigen} intra_op_parallelism_threads={number}",
        "JAX_PLATFORMS": "cpu",
        "JAX_ENABLE_COMPILATION_CACHE": "0",
        "BENCHMARK_THREADS": str(number),
    }
