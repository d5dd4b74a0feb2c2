"""The sampling benchmark in small: densities that agree, clocks that stand still, rows, table and figures."""

import importlib.util
import json
import math
import time
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path

import numpy as np
import pytest
import torch

import torchcal as tc
from benchmarks.sampling import density, judge, posteriors, report, run
from benchmarks.sampling.__main__ import jobs
from benchmarks.sampling.link import Enough, Link
from benchmarks.sampling.maximum import search
from benchmarks.sampling.posteriors import Posterior
from benchmarks.sampling.samplers import SAMPLERS

NAME = "cubic-linear-0.1"
# A truncated expansion is what some of the posteriors are about.
pytestmark = pytest.mark.filterwarnings("ignore::torchcal.errors.PropagationWarning")


def needs(module):
    found = importlib.util.find_spec(module) is not None
    return pytest.mark.skipif(not found, reason=f"{module} is not installed (pip install torchcal[bench])")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A small benchmark's folder with one posterior in it."""
    settings = run.Settings(tmp_path_factory.mktemp("sampling"), goals=(100, 200), limit=1.0)
    settings.folder.mkdir()
    arrays, _ = posteriors.export(posteriors.make(NAME, settings.folder))
    arrays.save(settings.folder / f"{NAME}.npz")
    facts = {
        "title": NAME, "differences": {}, "torchcal_seconds": 0.5, "search_seconds": 0.25, "search_found_it": True,
        "d": 2, "P": 5, "N": 11, "nodes": 4,
    }  # fmt: skip
    run.write(settings.folder / f"{NAME}.json", facts)
    return settings, density.Arrays.load(settings.folder / f"{NAME}.npz")


def bounded():
    """A polynomial of degree 2 with bounds and a truncated expansion, unlike the cubic study's models."""
    x = torch.linspace(0, 1, 7, dtype=torch.float64)
    simulator = tc.Simulator(
        lambda x, p: p["a"] * x + p["b"] ** 2 * (1 - x) + p["a"] * p["b"],
        parameters=[tc.Parameter("a", low=-2.0, high=2.0), tc.Parameter("b", low=0.0, high=2.0)],
        degree=2,
    )
    recording = tc.Recording(x=x, y=1 + torch.sin(3 * x))
    return Posterior("bounded", "bounded", simulator, recording, 0.05, {"order": 1, "num_starts": 8})


# --- densities ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [lambda: posteriors.make("cubic-quadratic-0.01", Path()), bounded])
def test_the_numpy_density_is_torchcals(make):
    arrays, _ = posteriors.export(make())
    assert posteriors.disagreement(arrays, np) < 1e-9
    # It can fail: another tolerance is another density.
    assert posteriors.disagreement(replace(arrays, epsilon=1.001 * arrays.epsilon), np) > 1e-4


@needs("jax")
def test_the_jax_density_is_torchcals():
    jax = pytest.importorskip("jax")
    arrays, _ = posteriors.export(bounded())
    with jax.enable_x64(True):
        assert posteriors.disagreement(arrays, jax.numpy) < 1e-9


def test_functions_that_are_no_polynomials_agree():
    arrays, _ = posteriors.export(posteriors.make("grow-order-2", Path()))
    assert posteriors.disagreement(arrays, np) < 1e-9


def test_unbounded_coordinates_carry_their_jacobian():
    arrays, _ = posteriors.export(bounded())
    bound, value = density.unbounded(arrays)
    transform = tc.priors.Bounds(torch.from_numpy(arrays.low), torch.from_numpy(arrays.high))
    u = np.random.default_rng(0).uniform(-3, 3, (9, len(arrays.map)))
    expected = transform.bound(torch.from_numpy(u)).numpy()
    np.testing.assert_allclose(bound(u), expected, rtol=1e-12)
    slope = transform.log_slope(torch.from_numpy(u)).numpy()
    np.testing.assert_allclose(value(u), density.log_density(arrays)(expected) + slope, rtol=1e-12)


def test_outside_the_bounds_there_is_nothing():
    arrays, _ = posteriors.export(bounded())
    inside = arrays.map.copy()
    outside = inside.copy()
    outside[0] = arrays.high[0] + 1e-9
    values = density.boxed(arrays)(np.stack([inside, outside]))
    assert np.isfinite(values[0])
    assert values[1] == -math.inf


def test_a_plain_search_finds_the_maximum(prepared):
    pytest.importorskip("scipy")
    _, arrays = prepared
    assert search(arrays) == pytest.approx(-arrays.check_values[0], rel=1e-4)


# --- judging -----------------------------------------------------------------------------------------------------


def test_folding_is_the_embeddings_own(prepared):
    _, arrays = prepared
    draws = np.random.default_rng(0).standard_normal((2, 50, 5))
    pattern = tc.embeddings.Gaussian().bind(["l0", "l1"])
    expected = pattern.flip(torch.from_numpy(draws), torch.from_numpy(arrays.map)).numpy()
    np.testing.assert_array_equal(judge.fold(arrays, draws), expected)
    assert (expected != draws).any()


def test_errors_are_in_posterior_sd():
    ess = np.array([400.0, 400.0])
    reference = judge.Quality(np.array([1e12, 1e12]), np.ones(2), np.array([0.0, 1.0]), np.array([1.0, 2.0]))
    found = judge.Quality(ess, np.ones(2), np.array([0.1, 0.6]), np.array([1.0, 2.2]))
    errors = judge.errors(found, reference)
    assert errors["error_mean"] == pytest.approx(0.2)
    assert errors["error_sd"] == pytest.approx(0.1)
    assert errors["expected_error"] == pytest.approx(0.05)
    assert errors["z"] == pytest.approx(4.0)


def test_the_clock_stands_still_while_one_judges():
    mine, other = Pipe()
    link = Link(other)
    mine.send(7)
    link.start()
    link.warmed()
    assert link.give(np.zeros((1, 4, 2))) == 7
    first = mine.recv()
    assert first["warm"] <= first["seconds"]
    mine.send(0)
    time.sleep(0.05)
    with pytest.raises(Enough):
        link.give(np.zeros((1, 4, 2)))
    stopped = link.seconds
    assert stopped >= 0.05  # it ran again after the first block
    time.sleep(0.02)
    assert link.seconds == stopped


def test_the_cheaper_search_is_charged_if_it_finds_the_maximum():
    facts = {"torchcal_seconds": 2.0, "search_seconds": 0.5, "search_found_it": True}
    assert run.charge(facts) == 0.5
    assert run.charge({**facts, "search_found_it": False}) == 2.0


def test_densities_that_differ_stop_everything(prepared, tmp_path):
    settings, _ = prepared
    other = run.Settings(tmp_path)
    facts = json.loads((settings.folder / f"{NAME}.json").read_text())
    run.write(other.folder / f"{NAME}.json", {**facts, "differences": {"jax": 1e-6}})
    (other.folder / f"{NAME}.npz").write_bytes((settings.folder / f"{NAME}.npz").read_bytes())
    with pytest.raises(RuntimeError, match="in jax within"):
        run.prepare(other, NAME)


# --- in processes of their own -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sampler",
    [
        "torchcal-hmc",
        pytest.param("pytuq-tuned", marks=needs("pytuq")),
        pytest.param("emcee", marks=(needs("emcee"), pytest.mark.slow)),
    ],
)
def test_rows(prepared, sampler):
    settings, _ = prepared
    if sampler == "torchcal-hmc":  # a process for each goal, and one is enough here
        settings = replace(settings, goals=(100,), limit=200.0)  # a busy machine is no failure
    row = run.once(settings, f"{NAME}__{sampler}", NAME, sampler)
    assert "failed" not in row, row
    assert set(row["times"]) == {str(goal) for goal in settings.goals}
    assert all(found["seconds"] > 0 for found in row["times"].values())
    assert row["ess"] >= 100 or any(found["extrapolated"] for found in row["times"].values())
    assert row["rate"] > 0
    assert row["memory"] > 0
    assert row["charged"] == (0.0 if sampler == "torchcal-hmc" else 0.25)
    # What is written is not run again.
    assert run.once(settings, f"{NAME}__{sampler}", "nonsense", "nonsense") == row


def test_a_sampler_that_fails_says_why(prepared):
    settings, _ = prepared
    row = run.race(settings, NAME, "emcee", walkers=3)
    assert row["failed"]


def test_a_row_says_what_is_missing(prepared, monkeypatch):
    settings, _ = prepared
    monkeypatch.setitem(SAMPLERS, "other", (None, {}, "no_such_module", True))
    assert run.race(settings, NAME, "other")["failed"] == "no_such_module is not installed"


# --- the table -----------------------------------------------------------------------------------------------------


def rows():
    times = {"100": {"seconds": 0.5, "extrapolated": False}, "200": {"seconds": 2.0, "extrapolated": False}}
    slow = {"100": {"seconds": 50.0, "extrapolated": False}, "200": {"seconds": 400.0, "extrapolated": True}}
    figures = {"posterior": NAME, "memory": 2**20, "chains": 4, "draws": 10, "error_sd": 0.1, "expected_error": 0.01}
    return [
        {**figures, "sampler": "torchcal", "times": times, "rate": 1e4, "r_hat": 1.001, "error_mean": 0.01, "z": 1.0},
        {**figures, "sampler": "pyro", "times": slow, "rate": 1.0, "r_hat": 1.2, "error_mean": 0.5, "z": 50.0},
        {"posterior": NAME, "sampler": "emcee", "failed": "emcee is not installed"},
    ]


def test_the_table_marks_what_is_extrapolated_and_what_is_wrong(prepared):
    settings, _ = prepared
    text = report.markdown(settings, rows(), [], {NAME: run.prepare(settings, NAME)}, {NAME: None})
    row = next(line for line in text.splitlines() if line.startswith("| pyro"))
    assert "~400" in row
    assert "| 100 |" in row  # 50 s against 0.5 s
    assert "**1.2000**" in row
    assert "**0.500 (0.010)**" in row
    assert "| emcee | emcee is not installed |" in text


def test_the_figures_are_drawn(prepared, tmp_path):
    settings, _ = prepared
    grown = [{**row, "key": f"grow-N-{n}__torchcal"} for row in rows()[:1] for n in (11, 31)]
    report.draw(settings, rows(), grown, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"times.png", "growth.png"}


def test_every_job_has_a_key_of_its_own():
    every = list(jobs(list(posteriors.MAIN), list(SAMPLERS), growth=True, small=False))
    assert len({job.key for job in every}) == len(every)
    assert {job.sampler for job in every if job.growth} <= set(SAMPLERS)
