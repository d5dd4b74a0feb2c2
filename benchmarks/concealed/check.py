"""Checks of the suite itself: near-ties in every family, and the mix of a generated set."""

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np

from benchmarks.concealed.families import FAMILIES
from benchmarks.concealed.families.base import Failure, Family, Planted, simulate, truth_vector
from benchmarks.concealed.families.inputs import uniform
from benchmarks.concealed.generate import draw_shapes, projected, signal_scales, tangents


def tied_correlation(family: Family, seed: int) -> float:
    """Correlation of the projected tangents of the family's tied pair, on conditions drawn from the seed.

    Amplitude tangents by finite differences at the base's true parameters, with the tangents of base parameters and
    unknown initial states taken out. Conditions that cannot be integrated are drawn again.
    """
    rng = np.random.default_rng([seed, 4])
    while True:
        setting = family.draw(rng)
        parameters = {base.name: uniform(rng, *base.draw) for base in family.parameters}
        theta = truth_vector(family, setting, parameters)
        try:
            traces = simulate(family, setting, theta, quick=4)
            scales = signal_scales(setting, traces)
            pair = [family.effect(name) for name in family.tied]
            items = [Planted(e, e.guess, draw_shapes(e, setting, traces, rng)) for e in pair]
            base, columns = tangents(family, setting, theta, scales, items)
        except Failure:
            continue
        unit = projected(base, columns)
        return float(abs(unit[:, 0] @ unit[:, 1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="a generated set, to count its mix")
    given = parser.parse_args()
    for name, family in FAMILIES.items():
        found = [tied_correlation(family, seed) for seed in range(5)]
        pair = " / ".join(family.tied)
        print(f"{name:20s} {pair:50s} {np.median(found):.3f}  (largest {max(found):.3f})", flush=True)
    if given.out:
        answers = json.loads((given.out / "answers.json").read_text())
        print(Counter(answer["kind"] for answer in answers.values()))
        inside = [a["kappa"] for a in answers.values() if a["kind"] in ("library", "local")]
        for low, high in ((0, 0.3), (0.3, 1), (1, np.inf)):
            part = np.mean([low <= kappa < high for kappa in inside])
            print(f"{low} <= kappa < {high}: {part:.2f} of the in-library cases")


if __name__ == "__main__":
    main()
