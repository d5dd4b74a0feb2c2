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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.concealed.experiment import planted, setting_of
from benchmarks.concealed.families import FAMILIES
from benchmarks.concealed.families.base import (
    Array,
    Effect,
    Failure,
    Planted,
    Setting,
    labels,
    simulate,
    stacked,
    truth_vector,
)
from benchmarks.concealed.generate import largest, recalibrate
from benchmarks.concealed.peers import Case, read_case, shape_grid, visible
from benchmarks.concealed.score import names_of
from benchmarks.concealed.workers import read, run_all

DRAWS = 20_000
PARTS = 2
"""Time steps a sample."""
SAME = 0.01
"""Distance in noise sd below which a rival's curve is the planted effect's own, and the judge guesses."""


def white(residual: Array, setting: Setting, rho: float) -> Array:
    """What is left of a residual (in units of the noise) that has an autocorrelation, in units of white noise."""
    lengths = [len(run.time) for run in setting.runs] * len(setting.observed) or [len(residual)]
    parts = []
    for block in np.split(residual, np.cumsum(lengths)[:-1]):
        parts += [block[:1], (block[1:] - rho * block[:-1]) / np.sqrt(1 - rho**2)]
    return np.concatenate(parts)


@dataclass(frozen=True)
class Truth:
    """A case without its noise.

    Args:
        seen: The case as the peers see it.
        setting: Its conditions, and where every state begins.
        theta: The unknowns.
        refit: Those of the base alone, calibrated to the truth.
        target: The outputs in units of the noise, with the time steps of the fits.
        answer: The rest.
    """

    seen: Case
    setting: Setting
    theta: Array
    refit: Array
    target: Array
    answer: Mapping[str, Any]

    @classmethod
    def of(cls, case: Mapping[str, Any], answer: Mapping[str, Any]) -> "Truth":
        """From a recording and its answer."""
        family, setting = FAMILIES[answer["family"]], setting_of(case, answer)
        theta = truth_vector(family, setting, answer["parameters"])
        traces = simulate(family, setting, theta, planted(answer), quick=PARTS)
        target = stacked(family, setting, traces, answer["noise"]["sd"])[0]
        refit = np.array([answer["refit"][label] for label in labels(family, setting)])
        return cls(read_case(case), setting, theta, refit, target, answer)


def nearest(truth: Truth, effect: Effect) -> Array | None:
    """The truth less a candidate's best fit to it, white and in units of the noise; None where none is possible."""
    family, setting, noise = truth.seen.family, truth.setting, truth.answer["noise"]
    first = effect.guess if effect.stiff else 0.05 * effect.guess

    def fitted(start: Array, item: Planted) -> tuple[Array, Planted] | None:
        try:
            z, residual = recalibrate(
                family, setting, truth.target, noise["sd"], start, np.random.default_rng(0), starts=1, planted=[item],
                parts=PARTS,
            )  # fmt: skip
            item = replace(item, amplitude=float(z[-1]))
            if effect.within is not None:
                low, high, driver = effect.within
                unit = 1.0 if driver is None else largest(setting, simulate(family, setting, z[:-1], [item]), driver)
                if not low * unit <= abs(item.amplitude) <= high * unit:
                    return None
        except Failure:
            return None
        return white(residual, setting, noise.get("rho", 0.0)), item

    def best(found: Iterable[tuple[Array, Planted] | None]) -> tuple[Array, Planted] | None:
        return min(filter(None, found), key=lambda one: float(one[0] @ one[0]), default=None)

    gates = {None, planted(truth.answer)[0].gate}
    kinds = [(shape, gate) for shape in shape_grid(truth.seen, effect) for gate in gates]
    near = best(fitted(truth.refit, Planted(effect, (effect.sign or 1) * first, *kind)) for kind in kinds)
    if near is not None:  # once more from the truth
        near = best([near, fitted(truth.theta, near[1])])
    return None if near is None else near[0]


def judged(case: Mapping[str, Any], answer: Mapping[str, Any]) -> dict[str, Any]:
    """The judge's share of one case, and each rival's distance in units of the noise."""
    truth, same = Truth.of(case, answer), names_of(answer["effects"][0]["name"], answer)
    left = {}
    for effect in visible(truth.seen):
        if effect.name not in same:
            found = nearest(truth, effect)
            if found is not None:
                left[effect.name] = found
    sizes = {name: float(np.sqrt(gap @ gap)) for name, gap in left.items()}
    gaps = [gap for name, gap in left.items() if sizes[name] > SAME]
    guess = 1 / (1 + len(left) - len(gaps))
    ahead = 1.0
    if gaps:
        # The recording is the truth and noise; a rival is the truth less its gap.
        rivals = np.array(gaps)
        noise = np.random.default_rng(0).standard_normal((DRAWS, rivals.shape[1]))
        ahead = float(np.mean((noise @ rivals.T + 0.5 * np.sum(rivals**2, axis=1) > 0).all(1)))
    return {"first": guess * ahead, "distances": dict(sorted(sizes.items(), key=lambda row: row[1]))}


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
