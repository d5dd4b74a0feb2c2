"""Every figure of the studies: the cubic one, and ignition at all tolerances.

Runs as ``python -m examples.make_figures``. There is no time limit.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch

import torchcal as tc

STUDIES = ("cubic", "ignition")
#: Draws of each chain in the ignition studies.
DRAWS = 800


def ignition(out: Path, *, seed: int, progress: bool) -> None:
    """Both ignition cases at every ε."""
    from examples.ignition import figures, study

    found = {}
    for key in study.STUDIES:
        # More draws than the demo's: at ε = 0.01 the posteriors are far from normal.
        one = study.run(key, folder=out / "cache", seed=seed, progress=progress, num_samples=DRAWS)
        found[key] = one
        for epsilon, result in one.embedded.items():
            result.save(out / f"{key}_embedded_{epsilon:g}.nc")
            for problem in result.diagnostics.problems:
                sys.stdout.write(f"NOT CONVERGED, {one.title}, ε = {epsilon:g}: {problem}\n")
        one.conventional.save(out / f"{key}_conventional.nc")
    _write(figures.figures(found), out)


def cubic(out: Path, *, seed: int) -> None:
    """The cubic study."""
    from examples import cubic

    _write(cubic.figures(seed=seed), out)


def _write(drawn: dict, out: Path) -> None:
    import matplotlib.pyplot as plt

    for name, figure in drawn.items():
        path = out / f"{name}.png"
        figure.savefig(path, dpi=150)
        plt.close(figure)
        sys.stdout.write(f"wrote {path}\n")
        sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw all figures of the studies."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, default=Path("outputs/figures"), help="folder, with one for each study")
    parser.add_argument("--study", choices=STUDIES, help="this one alone")
    parser.add_argument("--seed", type=int, default=0, help="of every random number")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    options = parser.parse_args(arguments)
    import matplotlib

    matplotlib.use("Agg")
    torch.set_num_threads(1)  # the tensors are small: more threads only wait for each other
    for name in STUDIES if options.study is None else (options.study,):
        start = time.perf_counter()
        out = options.out / name
        out.mkdir(parents=True, exist_ok=True)
        with warnings.catch_warnings():
            # Runs that have not converged are named on their own line; a large ε is what some figures are about.
            warnings.simplefilter("ignore", tc.errors.ConvergenceWarning)
            warnings.simplefilter("ignore", tc.errors.ToleranceWarning)
            if name == "cubic":
                cubic(out, seed=options.seed)
            else:
                ignition(out, seed=options.seed, progress=not options.quiet)
        sys.stdout.write(f"{name}: {time.perf_counter() - start:.0f} s, figures in {out}\n")


if __name__ == "__main__":
    main()
