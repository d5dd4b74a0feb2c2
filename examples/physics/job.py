"""What the examples have in common: diagnose, print, and write figures and a report."""

import argparse
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib

import torchcal as tc

__all__ = ["run"]


def run(
    name: str,
    simulator: Callable[[], tc.Simulator],
    recording: Callable[[], tc.Recording],
    candidates: Callable[[], list[tc.Term]],
    argv: Sequence[str] | None = None,
    *,
    holdout: Callable[[], Any] | None = None,
) -> Any:
    """Diagnose one example and write what was found to ``outputs/<name>``.

    Args:
        name: Of the example, and of its folder.
        simulator: The base model.
        recording: The recording.
        candidates: The candidates.
        argv: Arguments of the command line; by default those of the process.
        holdout: What to keep for the proof; by default `torchcal.diagnose` chooses.

    Returns:
        The diagnosis.
    """
    parser = argparse.ArgumentParser(prog=f"python -m examples.physics.{name}", description=f"Diagnose {name}.")
    parser.add_argument("--out", type=Path, default=Path("outputs") / name, help="folder for figures and report")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random numbers")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    options = parser.parse_args(argv)

    try:
        data = recording()
        kept = {} if holdout is None else {"holdout": holdout()}
    except tc.errors.MissingDependencyError as error:
        sys.exit(str(error))
    diagnosis = tc.diagnose(simulator(), data, candidates(), seed=options.seed, progress=not options.quiet, **kept)
    options.out.mkdir(parents=True, exist_ok=True)
    sys.stdout.write(f"{diagnosis}\n\n{diagnosis.ranking}\n\n")
    with warnings.catch_warnings():
        # A figure for a file needs no window.
        warnings.simplefilter("ignore", UserWarning)
        matplotlib.use("Agg")
    figure = diagnosis.plot()
    figure.savefig(options.out / "diagnosis.png", dpi=150, bbox_inches="tight")
    diagnosis.report(options.out / "report.html")
    sys.stdout.write(f"Figures and report: {options.out}\n")
    return diagnosis
