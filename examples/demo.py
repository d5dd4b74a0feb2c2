"""The main job: a one-step methane mechanism against GRI-Mech 3.0, calibrated, and told what it lacks.

Runs as ``python -m examples.demo``. GRI-Mech 3.0 and the one-step mechanism run in Cantera. A surrogate of the latter
is calibrated over temperature and composition (the paper's case 2) under embedded model error (ABC, ε = 0.001) and
under the conventional additive normal error. `torchcal.diagnose` then locates the mismatch, names what is missing and
proves it on data that the fit never saw, and the improved mechanism is calibrated as the base was. Results (netCDF),
figures (PNG) and the report (HTML) go to a folder, beside a cache of the runs.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

import torchcal as tc
from examples.ignition import figures, missing, study
from examples.ignition.study import Study
from torchcal.discovery import Diagnosis
from torchcal.results import Calibration, Diagnostics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EPSILON = figures.EPSILON
#: The picture that the README shows.
README_IMAGE = Path(__file__).resolve().parents[1] / "docs" / "images" / "ignition.png"
README_PHYSICS = README_IMAGE.with_name("missing.png")
#: Nominal coverage of the bands that are compared with the data.
LEVEL = 0.95
#: What case 1 must not name: at Φ = 1 the order of the fuel is an alias of A.
FUEL = ("fuel reaction order",)


def say(text: str = "") -> None:
    """Write a line, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


# --- the job -------------------------------------------------------------------------------------------


def solve(out: Path, keys: Sequence[str] = ("2",), *, seed: int, progress: bool) -> dict[str, Study]:
    """Data, surrogates and calibrations of some studies, with a line for each step."""
    found = {}
    for key in keys:
        start = time.perf_counter()
        prepared = study.prepare(key, out / "cache", progress=progress)
        say(f"{prepared.title}: data and surrogate in {time.perf_counter() - start:.1f} s")
        with warnings.catch_warnings():
            # The report says it all, in its own words.
            warnings.simplefilter("ignore", tc.errors.ConvergenceWarning)
            start = time.perf_counter()
            embedded = {EPSILON: study.calibrate(prepared, EPSILON, seed=seed, progress=progress)}
            say(f"{prepared.title}: embedded calibration in {time.perf_counter() - start:.1f} s")
            start = time.perf_counter()
            additive = study.calibrate_conventional(prepared, seed=seed, progress=progress)
            say(f"{prepared.title}: conventional calibration in {time.perf_counter() - start:.1f} s")
        found[key] = Study(key, prepared.recording, prepared.surrogate, embedded, additive)
    return found


@dataclass(frozen=True)
class Story:
    """What the diagnosis found.

    Attributes:
        diagnosis: Of case 2.
        base: Calibration of the base with embedded model error.
        improved: The same of the mechanism with the accepted terms, at the MAP.
        alone: The diagnosis of case 1, where only the temperature varies.
    """

    diagnosis: Diagnosis
    base: Calibration
    improved: Calibration
    alone: Diagnosis


def explain(two: Study, out: Path, *, seed: int, progress: bool) -> Story:
    """Diagnose both cases, and embed model error in the improved mechanism as in the base."""
    start = time.perf_counter()
    diagnosis = tc.diagnose(missing.simulator(), two.recording, missing.CANDIDATES, seed=seed, progress=progress)
    say(f"{two.title}: diagnosis in {time.perf_counter() - start:.1f} s: {diagnosis.verdict}")
    start = time.perf_counter()
    improved = tc.calibrate(
        diagnosis.improved,
        two.recording,
        embedding=tc.embeddings.Gaussian(parameters=("lnA", "E")),
        likelihood=tc.likelihoods.ABC(epsilon=EPSILON, gamma=1.0),
        order=study.OUTPUT_ORDER,
        num_samples=0,
        seed=seed,
        progress=progress,
    )
    say(f"{two.title}: embedded calibration of the improved mechanism in {time.perf_counter() - start:.1f} s")
    start = time.perf_counter()
    one = study.record(1, 51, cache=out / "cache" / "gri30_delays.csv", progress=progress)
    alone = tc.diagnose(missing.simulator(), one, missing.CANDIDATES, seed=seed, progress=progress)
    say(f"case 1, N = 51: data and diagnosis in {time.perf_counter() - start:.1f} s: {alone.verdict}")
    return Story(diagnosis, two.embedded[EPSILON], improved, alone)


def save(found: dict[str, Study], out: Path) -> None:
    """Write every calibration."""
    for one in found.values():
        name = f"case_{one.case}" if one.case == 2 else f"case_1_n{one.recording.n}"
        one.embedded[EPSILON].save(out / f"{name}_embedded.nc")
        one.conventional.save(out / f"{name}_conventional.nc")


def draw(two: Study, story: Story, out: Path, *, readme: bool) -> list[Path]:
    """Write the figures of case 2 and the report."""
    drawings: dict[str, Callable[[], Figure]] = {
        "embedded_vs_conventional": lambda: figures.embedded_vs_conventional(two),
        "diagnosis": story.diagnosis.plot,
        "before_and_after": lambda: figures.before_and_after(
            two, story.base, story.improved, story.diagnosis.terms or ["same terms"]
        ),
        "case_2_fit": lambda: figures.figure_16(two),
        "case_2_sd_and_error": lambda: figures.figure_17(two),
        "case_2_corner": lambda: figures.figure_corner(two),
        "conventional_prediction": lambda: figures.figure_21([two]),
        "conventional_posterior": lambda: figures.figure_20([two]),
        "case_1_diagnosis": story.alone.plot,
    }
    import matplotlib.pyplot as plt

    shown = {"embedded_vs_conventional": README_IMAGE, "before_and_after": README_PHYSICS} if readme else {}
    paths = []
    for name, make in drawings.items():
        figure = make()
        paths.append(out / f"{name}.png")
        figure.savefig(paths[-1], dpi=150)
        if name in shown:
            shown[name].parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(shown[name], dpi=110)
            paths.append(shown[name])
        plt.close(figure)
    story.diagnosis.report(out / "report.html")
    return paths


# --- the report ----------------------------------------------------------------------------------------


def report(found: dict[str, Study]) -> str:
    """What was measured, in a screenful."""
    every = list(found.values())
    lines = ["", "One-step methane ignition calibrated against GRI-Mech 3.0", ""]
    lines.append("Surrogate of the one-step mechanism, order 6 (error in ln τ at held-out points)")
    for one in {one.case: one for one in every}.values():
        error = one.surrogate.error
        lines.append(
            f"  case {one.case}: rms {float(error.rms[0]):.1e}, largest {float(error.max_abs[0]):.1e} "
            f"({error.num} points; sd of ln τ {float(error.sd[0]):.2f})"
        )
    rows: list[tuple[str, list[str]]] = [("", [one.title for one in every])]
    rows.append((f"embedded, ABC ε = {EPSILON:g}", []))
    rows += _rows(every, _embedded)
    rows.append(("conventional, additive σ", []))
    rows += _rows(every, _conventional)
    lines += ["", *_table(rows), ""]
    two = found["2"]
    pushed = study.coverage(two, two.conventional.predict().push_forward, LEVEL)
    own = study.coverage(two, two.embedded[EPSILON].predict().posterior, LEVEL)
    lines += [
        f"Case 2: the {LEVEL:.0%} band of what the calibrated model itself predicts (push-forward) holds",
        f"  {pushed:5.0%} of the data after the conventional calibration,",
        f"  {own:5.0%} after the one with embedded model error.",
    ]
    for one in every:
        for name, result in (("embedded", one.embedded[EPSILON]), ("conventional", one.conventional)):
            lines += [f"NOT CONVERGED, {one.title}, {name}: {problem}" for problem in result.diagnostics.problems]
    return "\n".join(lines)


def physics(two: Study, story: Story) -> str:
    """What was missing, and what the error bars say before and after."""
    lines = ["", "What the one-step mechanism leaves out (case 2)", "", str(story.diagnosis), ""]
    rows: list[tuple[str, list[str]]] = [("embedded model error at the MAP", ["before", "after"])]
    columns = []
    for result in (story.base, story.improved):
        moments, mean, sd = result.predict().map, result.map.mean, result.map.sd
        columns.append(
            {
                "rms model-error sd of ln τ": _rms(moments.sd),
                "rms residual of the mean": f"{study.rms_residual(two, moments.mean):.3g}",
                "E[ln A] ± sd": f"{float(mean[0]):.2f} ± {float(sd[0]):.2g}",
                "E[E] ± sd, cal/mol": f"{float(mean[1]):.0f} ± {float(sd[1]):.2g}",
            }
        )
    rows += [(f"  {label}", [column[label] for column in columns]) for label in columns[0]]
    row = next(row for row in story.alone.ranking if row.terms == FUEL)
    lines += _table(rows)
    lines += [
        "",
        f"Case 1 (Φ = 1 alone, {story.alone.recording.n} data): {story.alone.verdict}.",
        "  There the fuel reaction order is an alias of A: "
        f"freeing it removes {row.misfit_removed:.0%} of the misfit, and it is "
        f"{'NAMED' if story.alone.terms == list(FUEL) else 'not named'}.",
    ]
    return "\n".join(lines)


def _rows(every: Sequence[Study], read: Callable[[Study], dict[str, str]]) -> list[tuple[str, list[str]]]:
    columns = [read(one) for one in every]
    return [(f"  {label}", [column[label] for column in columns]) for label in columns[0]]


def _embedded(one: Study) -> dict[str, str]:
    result = one.embedded[EPSILON]
    prediction = result.predict()
    mean, sd = result.map.mean, result.map.sd
    return {
        "E[ln A], MAP": f"{float(mean[0]):.4f}",
        "sd[ln A]": f"{float(sd[0]):.4f}",
        "E[E], cal/mol": f"{float(mean[1]):.1f}",
        "sd[E], cal/mol": f"{float(sd[1]):.1f}",
        "correlation": f"{float(result.map.covariance[0, 1] / (sd[0] * sd[1])):.4f}",
        "rms residual of the mean": f"{study.rms_residual(one, prediction.mean):.4f}",
        "rms model-error sd √E[σ²]": _rms(prediction.sd_model_error),
        "rms posterior sd √V[μ]": _rms(prediction.sd_posterior),
        "objective": f"{result.map.objective:.8g}",
        **_quality(result.diagnostics),
    }


def _conventional(one: Study) -> dict[str, str]:
    result = one.conventional
    prediction = result.predict()
    mean, sd = result.map.mean, result.parameters.std(0)
    return {
        "ln A, MAP": f"{float(mean[0]):.4f}",
        "posterior sd of ln A": f"{float(sd[0]):.4f}",
        "E, cal/mol, MAP": f"{float(mean[1]):.1f}",
        "posterior sd of E": f"{float(sd[1]):.1f}",
        "rms residual of the mean": f"{study.rms_residual(one, prediction.push_forward.mean):.4f}",
        "rms push-forward sd": _rms(prediction.push_forward.sd),
        "σ, MAP": f"{float(result.map.alpha[-1].exp()):.4f}",
        **_quality(result.diagnostics),
    }


def _quality(found: Diagnostics) -> dict[str, str]:
    return {
        "worst R-hat": f"{found.r_hat:.4f}",
        "least ESS": f"{found.ess:.0f}",
        "divergent transitions": f"{found.divergences}",
        "converged": "yes" if found.converged else "NO, see below",
    }


def _rms(sd: Any) -> str:
    return f"{float(sd.square().mean().sqrt()):.2g}"


def _table(rows: Sequence[tuple[str, list[str]]]) -> list[str]:
    width = max(len(label) for label, _ in rows)
    cells = max(len(cell) for _, values in rows for cell in values)
    return [label.ljust(width) + "".join("  " + cell.rjust(cells) for cell in values) for label, values in rows]


def main(arguments: Sequence[str] | None = None) -> None:
    """Calibrate one-step methane ignition against GRI-Mech 3.0, and find what the mechanism leaves out."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, default=Path("outputs/demo"), help="folder of figures and results")
    parser.add_argument("--seed", type=int, default=0, help="of every random number")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    parser.add_argument("--readme", action="store_true", help="write the README's pictures too")
    options = parser.parse_args(arguments)
    import matplotlib

    matplotlib.use("Agg")
    torch.set_num_threads(1)  # the tensors are small: more threads only wait for each other
    options.out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    found = solve(options.out, seed=options.seed, progress=not options.quiet)
    save(found, options.out)
    story = explain(found["2"], options.out, seed=options.seed, progress=not options.quiet)
    paths = draw(found["2"], story, options.out, readme=options.readme)
    text = report(found) + "\n" + physics(found["2"], story)
    (options.out / "report.txt").write_text(text.lstrip("\n") + "\n", encoding="utf-8")
    say(text)
    say(f"\n{time.perf_counter() - start:.0f} s. {len(paths)} figures and all results are in {options.out}; look first")
    say(f"at {paths[0]}, then at {options.out / 'report.html'}")


if __name__ == "__main__":
    main()
