"""How often the right name can come first: the share of a judge who knows everything but the name.

Two effects that leave the same curve, once the base's parameters and initial states have been fitted, cannot be told
apart by anyone, and in noise nearly the same curves cannot either. For every case with one effect of the library, each
other candidate of the family is fitted to the noise-free truth, together with the base. That leaves one curve for each
name, and of these the judge knows every number: amplitudes, shapes, gates, parameters, initial states, the noise with
its sd and autocorrelation (outliers, rounding and missing samples do not trouble him). Names are equally likely to him.
He says the name whose curve is nearest to the recording in the metric of the noise, which no rule can better. The share
of noisy recordings in which that is the planted name is the case's *top-1 of a judge*. A tool, which must find those
numbers from the recording, has less to go by.

Left out are candidates with an amplitude that nature does not have; how strong the suite's effects are is told to
nobody. Shapes are tried on a grid; where the planted effect acts in a range alone, so may its rivals, in that same
range. So a rival may be a little nearer yet.
"""

import argparse
import functools
import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.concealed.experiment import planted
from benchmarks.concealed.families import FAMILIES
from benchmarks.concealed.families.base import (
    Array,
    Effect,
    Failure,
    Planted,
    Setting,
    simulate,
    stacked,
    truth_vector,
    unknowns,
)
from benchmarks.concealed.followup import setting_of
from benchmarks.concealed.generate import largest, recalibrate
from benchmarks.concealed.peers import read_case, shape_grid
from benchmarks.concealed.score import names_of
from benchmarks.concealed.workers import read, run_all

DRAWS = 20_000
PARTS = 2
"""Time steps a sample."""
SAME = 0.01
"""Distance in noise sd below which a rival's curve is the planted effect's own, and the judge guesses."""


def white(residual: Array, setting: Setting, rho: float) -> Array:
    """What is left of a residual (in units of the noise) that has an autocorrelation, in units of white noise."""
    size = len(setting.runs) * len(setting.observed) or 1
    lengths = [len(run.time) for run in setting.runs] * len(setting.observed) or [len(residual) // size]
    parts = []
    for block in np.split(residual, np.cumsum(lengths)[:-1]):
        parts += [block[:1], (block[1:] - rho * block[:-1]) / np.sqrt(1 - rho**2)]
    return np.concatenate(parts)


def nearest(case: Mapping[str, Any], answer: Mapping[str, Any], effect: Effect) -> Array | None:
    """The truth less a candidate's best fit to it, white and in units of the noise; None where none is possible."""
    family, setting, sd = FAMILIES[answer["family"]], setting_of(case, answer), answer["noise"]["sd"]
    theta = truth_vector(family, setting, answer["parameters"])
    truth = simulate(family, setting, theta, planted(answer), quick=PARTS)  # with the steps of the fits
    target = stacked(family, setting, truth, sd)[0]
    first = effect.guess if effect.stiff else 0.05 * effect.guess

    def fitted(start: Array, item: Planted) -> tuple[Array, Planted] | None:
        try:
            z, residual = recalibrate(
                family, setting, target, sd, start, np.random.default_rng(0), starts=1, planted=[item], parts=PARTS
            )
            item = replace(item, amplitude=float(z[-1]))
            if effect.within is not None:
                low, high, driver = effect.within
                unit = 1.0 if driver is None else largest(setting, simulate(family, setting, z[:-1], [item]), driver)
                if not low * unit <= abs(item.amplitude) <= high * unit:
                    return None
        except Failure:
            return None
        return white(residual, setting, answer["noise"].get("rho", 0.0)), item

    def best(found: Iterable[tuple[Array, Planted] | None]) -> tuple[Array, Planted] | None:
        return min(filter(None, found), key=lambda one: float(one[0] @ one[0]), default=None)

    gates = {None, planted(answer)[0].gate}
    kinds = [(shape, gate) for shape in shape_grid(read_case(case), effect) for gate in gates]
    places = [name if number is None else f"{name}(0)[{number}]" for name, number in unknowns(family, setting)]
    refit = np.array([answer["refit"][place] for place in places])
    near = best(fitted(refit, Planted(effect, (effect.sign or 1) * first, *kind)) for kind in kinds)
    if near is not None:  # once more from the truth
        near = best([near, fitted(theta, near[1])])
    return None if near is None else near[0]


def judged(case: Mapping[str, Any], answer: Mapping[str, Any]) -> dict[str, Any]:
    """The judge's share of one case, and each rival's distance in units of the noise."""
    family, setting = FAMILIES[answer["family"]], setting_of(case, answer)
    same = names_of(answer["effects"][0]["name"], answer)
    left = {}
    for effect in family.library:
        if effect.name not in same and all(name in setting.observed for name in effect.outputs):
            found = nearest(case, answer, effect)
            if found is not None:
                left[effect.name] = found
    sizes = {name: float(np.sqrt(gap @ gap)) for name, gap in left.items()}
    gaps = [gap for name, gap in left.items() if sizes[name] > SAME]
    guess = 1 / (1 + len(left) - len(gaps))
    rng, ahead = np.random.default_rng(0), np.ones(DRAWS, dtype=bool)
    if gaps:
        # The recording is the truth and noise; a rival is the truth less its gap.
        rivals = np.array(gaps)
        ahead = rng.standard_normal((DRAWS, rivals.shape[1])) @ rivals.T + 0.5 * np.sum(rivals**2, axis=1) > 0
        ahead = ahead.all(1)
    return {"first": guess * float(np.mean(ahead)), "distances": dict(sorted(sizes.items(), key=lambda row: row[1]))}


def _judged(folder: str, name: str) -> dict[str, Any]:
    out = Path(folder)
    case = json.loads((out / "cases" / f"{name}.json").read_text())
    return judged(case, json.loads((out / "answers.json").read_text())[name])


def run(out: Path, *, workers: int = 2, limit: float = 600.0) -> None:
    """The judge's shares of all cases with one effect of the library, into ``out/ideal.jsonl``."""
    answers = json.loads((out / "answers.json").read_text())
    names = [name for name, answer in answers.items() if answer["kind"] in ("library", "local")]
    run_all(functools.partial(_judged, str(out)), names, out / "ideal.jsonl", workers=workers, limit=limit)
    print(f"{len(read(out / 'ideal.jsonl'))} cases judged", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="What nobody could better.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    run(given.out, workers=given.workers)


if __name__ == "__main__":
    main()
