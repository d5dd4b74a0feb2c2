"""Noise or physics: the noise model, false alarms, screening and detection limits, over many seeds.

Every tolerance follows from the number of seeds: five standard errors, or the binomial tail at 1e-4.
"""

import dataclasses
import itertools
import math
import re
import types

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.findings.limits import _distance
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.hypotheses.singles import refit_singles
from torchcal.discovery.judged import _explained_by_place
from torchcal.discovery.misfit.curves import orthonormal, smooth_columns
from torchcal.discovery.misfit.noise import Noise, estimate
from torchcal.discovery.misfit.outliers import lone, spikes
from torchcal.discovery.misfit.replicates import goes_on_along

F64 = torch.float64


def draw(n, sd, seed, phi=0.0):
    """Stationary AR(1) noise of one sd; white for phi = 0."""
    e = torch.randn(n, generator=torch.Generator().manual_seed(seed), dtype=F64)
    for k in range(1, n):
        e[k] = phi * e[k - 1] + math.sqrt(1 - phi**2) * e[k]
    return sd * e


def most(trials, probability, tail=1e-4):
    """The most successes that chance gives, but for the tail."""
    stats = pytest.importorskip("scipy.stats")
    return int(stats.binom.ppf(1 - tail, trials, probability))


def fewest(trials, probability, tail=1e-4):
    stats = pytest.importorskip("scipy.stats")
    return int(stats.binom.ppf(tail, trials, probability))


# --- size and correlation -----------------------------------------------------------------------------------

LINE = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])


def noise_of(x, y, given=None, simulator=LINE) -> Noise:
    recording = tc.Recording(x=x, y=y, noise=given)
    problem = Problem.of(simulator, recording)
    begin = torch.zeros(1, len(problem.parameters), dtype=F64)
    whitening = problem.whitening(0.1 * recording.spread, torch.zeros(len(recording.outputs), dtype=F64))
    found = fit(problem, whitening, begin, list(range(begin.shape[1])))
    return estimate(problem, found.residual, found.jacobian, recording.noise)


@pytest.mark.parametrize("misfit", [0.0, 0.5])
@pytest.mark.parametrize(("phi", "tolerance"), [(0.0, 0.03), (0.3, 0.07), (0.6, 0.13)])
def test_size_and_correlation_of_the_noise(phi, tolerance, misfit):
    # A smooth misfit of five noise sd must not pass for noise.
    n, seeds = 200, 15
    x = torch.linspace(0, 1, n, dtype=F64)
    found = [noise_of(x, 1 + 2 * x + misfit * torch.sin(7 * x) + draw(n, 0.1, seed, phi)) for seed in range(seeds)]
    size = np.array([float(noise.sd[0]) for noise in found]) / 0.1
    coefficient = np.array([float(noise.correlation[0]) for noise in found])
    # The size's bias comes with the prior against correlation and the caution on its other side.
    assert abs(size.mean() - 1) < tolerance + 5 * size.std() / math.sqrt(seeds)
    assert abs(coefficient.mean() - phi) < 0.05 + 5 * coefficient.std() / math.sqrt(seeds)
    assert found[0].source == "estimated"
    assert bool(found[0].freedom.isfinite().all())


@pytest.mark.parametrize("n", [40, 44])
def test_a_smooth_misfit_of_few_data_in_white_noise_is_no_slow_noise(n):
    # Just enough data for noise of unknown size to be correlated: a parabola is still likelier than that.
    x = np.linspace(1.0, 10.0, n)
    hidden = 0
    for seed in range(6):
        y = 2 + 3 * x + 0.25 * (x - 5.5) ** 2 + np.asarray(draw(n, 0.5, seed))
        d = tc.diagnose(LINE, tc.Recording(x=x, y=y), [], progress=False)
        hidden += d.verdict == "consistent"
    assert hidden <= most(6, 0.05)


def test_the_noise_that_hides_a_misfit_is_the_one_that_is_told():
    x = np.linspace(1.0, 10.0, 60)
    y = 2 + 3 * x + np.asarray(draw(60, 1.0, 5, phi=0.9))
    d = tc.diagnose(LINE, tc.Recording(x=x, y=y), [], progress=False)
    assert d.verdict == "consistent"
    assert d.noise.correlation["y"] > 0.6
    if d.p_detect < 0.01:
        assert "Slow noise" in str(d)


def test_a_smooth_misfit_changes_the_noise_little():
    x = torch.linspace(0, 1, 100, dtype=F64)
    for seed in range(5):
        e = draw(100, 0.1, seed)
        plain, bent = (noise_of(x, 2 * x + size * torch.cos(9 * x) + e) for size in (0.0, 1.0))
        assert float(bent.sd[0]) == pytest.approx(float(plain.sd[0]), rel=0.05)


def test_given_noise_is_taken():
    x = torch.linspace(0, 1, 60, dtype=F64)
    noise = noise_of(x, x + draw(60, 0.1, 1), 0.1)
    assert noise.source == "given"
    assert noise.freedom.tolist() == [math.inf]
    assert noise.excess == {}
    torch.testing.assert_close(noise.sd, torch.full((60,), 0.1, dtype=F64))


@pytest.mark.parametrize("phi", [0.0, 0.6])
def test_noise_smaller_than_given_is_as_correlated_as_noise_of_unknown_size(phi):
    x = torch.linspace(0, 1, 60, dtype=F64)
    for seed in range(8):
        y = x + draw(60, 0.1, seed, phi)
        given, unknown = (float(noise_of(x, y, sd).correlation) for sd in (0.2, None))
        assert given == pytest.approx(unknown, abs=0.1)  # up to 0.7 more where a correlation made up for the size


def test_an_estimate_is_as_wide_as_the_noise_that_was_given():
    x = torch.rand(60, generator=torch.Generator().manual_seed(4), dtype=F64) * 12
    y = 0.9 - 0.01 * x - 0.03 * torch.relu(x - 7) + draw(60, 0.012, 5)
    straight = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["x"], [tc.Parameter("a"), tc.Parameter("b")])
    bend = tc.Term(
        "bend", outputs={"y": lambda x, p, y: y - p["q"] * torch.relu(x["x"] - p["at"])},
        parameters=[tc.Parameter("q", low=0.0), tc.Parameter("at", low=0.5, high=12.0)],
    )  # fmt: skip
    known, doubled = (
        tc.diagnose(straight, tc.Recording(x={"x": x, "T": x.flip(0)}, y=y, noise=sd), [bend], progress=False)
        for sd in (0.012, 0.024)
    )
    assert known.terms == doubled.terms == ["bend"]
    assert doubled.noise.correlation["y"] < 0.2
    sizes = [next(row for row in d.ranking if list(row.terms) == ["bend"]).estimates[1].sd for d in (known, doubled)]
    assert sizes[1] == pytest.approx(2 * sizes[0], rel=0.2)


def test_given_noise_that_the_data_contradict_is_doubted():
    x = torch.linspace(0, 1, 60, dtype=F64)
    noise = noise_of(x, x + draw(60, 0.1, 1), 0.02)
    assert noise.excess["y"] == pytest.approx(5.0, rel=0.3)


def test_a_detailed_simulation_has_none():
    x = torch.linspace(0, 1, 20, dtype=F64)
    noise = noise_of(x, x.square(), "none")
    assert noise.source == "none"
    torch.testing.assert_close(noise.sd, 1e-3 * x.square().std().expand(20))


def test_replicates_measure_the_noise_whatever_the_misfit():
    # 30 conditions three times each: 60 degrees of freedom, an sd of the sd of 9 %.
    x = torch.linspace(0, 1, 30, dtype=F64).repeat_interleave(3)
    noise = noise_of(x, torch.sin(12 * x) + draw(90, 0.1, 3))
    assert noise.source == "replicates"
    assert noise.freedom.tolist() == [60]
    assert float(noise.sd[0]) == pytest.approx(0.1, rel=5 * 0.0913)


def in_sweeps(how, count, sweeps):
    x = torch.linspace(0, 1, count, dtype=F64)
    return x.repeat_interleave(sweeps) if how == "side by side" else x.repeat(sweeps)


@pytest.mark.parametrize(("how", "sweeps"), [("side by side", 5), ("sweep by sweep", 2)])
@pytest.mark.parametrize("phi", [0.0, 0.6])
def test_replicates_tell_noise_with_memory(how, sweeps, phi):
    # The misfit differs from condition to condition as no smooth curve does.
    x, found, size = in_sweeps(how, 40, sweeps), [], []
    for seed in range(20):
        rough = draw(40, 3.0, 1000 + seed)
        misfit = rough.repeat_interleave(sweeps) if how == "side by side" else rough.repeat(sweeps)
        noise = noise_of(x, misfit + draw(len(x), 0.1, seed, phi))
        assert noise.source == "replicates"
        found.append(float(noise.correlation[0]))
        size.append(float(noise.sd[0]) / 0.1)
    # Least favourable are two sweeps: half of 80 data tell, so that an estimate is off by √((1 − φ²)/40), 0.13 at 0.6,
    # of which it is taken at a quantile of 0.6; and a white one is taken for correlated in 5 %.
    if phi:
        assert sum(value > 0 for value in found) >= 15
        assert np.mean(found) == pytest.approx(phi, abs=0.15)
    else:
        assert sum(value > 0 for value in found) <= most(20, 0.06)
    assert np.mean(size) == pytest.approx(1.0, abs=0.12)


def test_replicates_sorted_by_what_was_read_have_no_memory():
    x = in_sweeps("side by side", 30, 3)
    y = x + draw(90, 0.1, 2).reshape(30, 3).sort(dim=1).values.flatten()
    noise = noise_of(x, y)
    assert float(noise.correlation[0]) == 0
    assert float(noise.sd[0]) == pytest.approx(0.1, rel=5 * 0.0913)


def test_unequal_numbers_of_replicates_count_by_what_they_tell():
    # Pairs and tens: what is pooled has the variance of the noise and as many degrees of freedom as are stated.
    x = torch.cat([torch.arange(10.0, dtype=F64).repeat_interleave(2), torch.tensor([20.0] * 10, dtype=F64)])
    squares = [float(noise_of(x, x + draw(30, 0.1, seed)).sd[0]) ** 2 / 0.01 for seed in range(200)]
    assert noise_of(x, x + draw(30, 0.1, 0)).freedom.tolist() == [19]
    assert np.mean(squares) == pytest.approx(1.0, abs=5 * math.sqrt(2 / 19 / 200))
    # The variance of a sample variance of 200 has a relative sd of √(2/199) and more by its skewness.
    assert np.var(squares) == pytest.approx(2 / 19, rel=0.6)


def test_outputs_have_noise_of_their_own():
    x = torch.linspace(0, 1, 300, dtype=F64)
    y = {"u": x + draw(300, 0.1, 1), "w": 5 * x + draw(300, 2.0, 2, 0.7)}
    simulator = tc.Simulator(lambda x, p: {"u": p["a"] * x, "w": p["b"] * x}, [tc.Parameter("a"), tc.Parameter("b")])
    noise = noise_of(x, y, simulator=simulator)
    assert float(noise.sd[0]) == pytest.approx(0.1, rel=0.25)
    assert float(noise.sd[300]) == pytest.approx(2.0, rel=0.5)
    assert float(noise.correlation[0]) < 0.2
    assert float(noise.correlation[1]) == pytest.approx(0.7, abs=0.15)


@pytest.mark.parametrize("phi", [0.4, 0.7])
def test_gaps_do_not_upset_the_correlation(phi):
    n = 300
    x = torch.arange(n, dtype=F64)
    e = draw(n, 0.1, 5, phi)
    keep = torch.rand(n, generator=torch.Generator().manual_seed(0)) > 0.1
    full, gaps = noise_of(x, e), noise_of(x[keep], e[keep])
    assert float(full.correlation[0]) == pytest.approx(phi, abs=0.2)
    assert float(gaps.correlation[0]) == pytest.approx(phi, abs=0.25)


def test_too_few_data_to_tell():
    with pytest.raises(tc.errors.DomainError, match="noise="):
        noise_of(torch.tensor([0.0, 1.0], dtype=F64), torch.tensor([0.0, 1.0], dtype=F64))


def test_a_recording_in_steps():
    x = torch.linspace(0, 1, 50, dtype=F64)
    noise = noise_of(x, ((3 * x + draw(50, 0.001, 1)) / 0.1).round() * 0.1)
    assert noise.step == {"y": pytest.approx(0.1)}
    # Uniform in a step; at least that much.
    assert 0.1 / math.sqrt(12) <= float(noise.sd[0]) * (1 + 1e-9)
    assert not noise_of(x, 3 * x + draw(50, 0.1, 1)).step


# --- outliers -----------------------------------------------------------------------------------------------


def spikes_in(y, sd=None):
    x = torch.linspace(0, 1, len(y), dtype=F64)
    problem = Problem.of(LINE, tc.Recording(x=x, y=y))
    return spikes(problem, y, None if sd is None else torch.full((len(y),), sd, dtype=F64)).nonzero()[:, 0].tolist()


@pytest.mark.parametrize("sd", [None, 0.1])
def test_lonely_spikes_are_found(sd):
    x = torch.linspace(0, 1, 80, dtype=F64)
    y = torch.sin(6 * x) + draw(80, 0.1, 2)
    y[20] += 2.0
    y[51] -= 1.5
    assert spikes_in(y, sd) == [20, 51]


@pytest.mark.parametrize("places", [[0], [79], [20, 21], [1], [40, 42]])
def test_spikes_at_the_ends_and_side_by_side(places):
    x = torch.linspace(0, 1, 80, dtype=F64)
    y = torch.sin(6 * x) + draw(80, 0.1, 2)
    for sizes in ([2.0, -1.4], [1.5, 1.5], [20.0, 20.0], [-20.0, 3.0]):
        spiked = y.clone()
        spiked[places] += torch.tensor(sizes, dtype=F64)[: len(places)]
        assert spikes_in(spiked, 0.1) == places
        if 0 < places[0] and places[-1] < 79:  # at the ends less is known of what is usual
            assert spikes_in(spiked) == places


@pytest.mark.parametrize("apart", [False, True])
def test_neighbours_on_one_curve_of_a_grid_that_are_set_aside_are_told(apart):
    a, b = (v.ravel() for v in np.meshgrid(np.geomspace(0.01, 300, 14), [0.0, 3.0, 20.0], indexing="ij"))
    y = 100 * a / (a + 0.8 * (1 + b / 4)) + 0.2 * np.random.default_rng(1).standard_normal(42)
    places = [21, 30 if apart else 24]
    y[places] -= [9.0, 8.0]
    base = tc.Simulator(
        lambda x, p: p["top"] * x["a"] / (x["a"] + p["half"] * (1 + x["b"] / p["k"])),
        [tc.Parameter(name, low=0.05, high=200.0) for name in ("top", "half", "k")],
    )
    d = tc.diagnose(base, tc.Recording(x={"a": a, "b": b}, y=y, noise=0.2), [], seed=0, progress=False)
    assert {*places} <= {*d.set_aside.nonzero()[:, 0].tolist()}
    told = [line for line in d.symptoms if "are neighbours, output 'y' at a = 2.57" in line]
    assert len(told) == (not apart)
    if told:  # 13 on each of 3 curves, and 2 on each of 14, of 42 * 41 / 2 pairs
        assert "probability of 0.078" in told[0]


def test_both_data_at_one_level_of_a_grid_that_are_set_aside_are_told():
    """Where the other condition has two levels, these two have no other neighbours than each other."""
    a, b = (v.ravel() for v in np.meshgrid(np.linspace(1, 2, 20), [40.0, 60.0], indexing="ij"))
    y = 0.1 * b * a**2 + 0.05 * np.random.default_rng(1).standard_normal(40)
    y[[22, 23]] += 0.5
    base = tc.Simulator(lambda x, p: p["k"] * x["b"] * x["a"] ** 2, [tc.Parameter("k", low=0.0, initial=0.2)])
    d = tc.diagnose(base, tc.Recording(x={"a": a, "b": b}, y=y, noise=0.05), [], seed=0, progress=False)
    assert d.set_aside.nonzero()[:, 0].tolist() == [22, 23]
    (told,) = [line for line in d.symptoms if "are neighbours" in line]
    assert "b = 40 and output 'y' at a = 1.579, b = 60" in told


@pytest.mark.parametrize("noise", [pytest.param(0.05, marks=pytest.mark.slow), None])
def test_two_neighbours_alone_that_are_set_aside_are_told(noise):
    x = torch.linspace(0, 10, 50, dtype=F64)
    y = 2 * torch.exp(-0.3 * x) + draw(50, 0.05, 3)
    y[[26, 27]] += torch.tensor([0.8, 0.6], dtype=F64)
    d = tc.diagnose(DECAY, tc.Recording(x=x, y=y, noise=noise), LIBRARY, seed=0, progress=False)
    assert d.set_aside.nonzero()[:, 0].tolist() == [26, 27]
    assert str(d).startswith("Verdict: consistent (nothing is surely missing)")
    (told,) = [line for line in d.symptoms if "neighbours" in line]
    where = "output 'y' at x = 5.306 and output 'y' at x = 5.51, off by +"
    assert told.startswith(f"two that were set aside as outliers are neighbours, {where}")
    assert "probability of 0.04" in told  # 2 / 50
    y[[5, 40]] += 0.9  # of four on that side two are neighbours with a probability of 0.2
    d = tc.diagnose(DECAY, tc.Recording(x=x, y=y, noise=noise), LIBRARY, seed=0, progress=False)
    assert d.set_aside.nonzero()[:, 0].tolist() == [5, 26, 27, 40]
    assert not [line for line in d.symptoms if "neighbours" in line]


@pytest.mark.parametrize(("count", "apart", "chance"), [(12, [], "0.17"), (16, [], "0.12"), (16, [3], None)])
def test_two_neighbours_of_few_data_that_are_set_aside_are_told_unless_there_are_other_outliers(count, apart, chance):
    x = torch.linspace(0, 1, count, dtype=F64)
    y = 1 + 2 * x + draw(count, 0.1, 1)
    y[[count // 2, count // 2 + 1, *apart]] -= 2.0  # 20 sd
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    d = tc.diagnose(line, tc.Recording(x=x, y=y, noise=0.1), [], seed=0, progress=False)
    assert d.set_aside.nonzero()[:, 0].tolist() == sorted([count // 2, count // 2 + 1, *apart])
    told = [line for line in d.symptoms if "two that were set aside as outliers are neighbours" in line]
    assert len(told) == (not apart)
    if told:
        assert f"probability of {chance}, and there are no others. Something short may act there" in told[0]
        assert str(d).startswith("Verdict: consistent (nothing is surely missing)")


def test_what_begins_or_ends_steeply_is_no_outlier():
    x = torch.linspace(0, 1, 80, dtype=F64)
    for tau in (0.03, 0.05, 0.1):
        assert spikes_in(3.0 * torch.exp(-x / tau) + draw(80, 0.1, 2), 0.1) == []
        assert spikes_in(3.0 * torch.exp(-x / tau) + draw(80, 0.01, 2)) == []
    assert spikes_in(5.0 * x + draw(80, 0.1, 2), 0.1) == []
    assert spikes_in(3.0 * torch.cos(9 * x) + draw(80, 0.1, 2), 0.1) == []


def test_steps_and_pulses_are_no_outliers():
    x = torch.linspace(0, 1, 80, dtype=F64)
    step = torch.where(x > 0.5, 3.0, 0.0).to(F64) + draw(80, 0.1, 2)
    pulse = 3.0 * torch.exp(-(((x - 0.5) / 0.05) ** 2)) + draw(80, 0.1, 2)
    assert spikes_in(step) == []
    assert spikes_in(pulse) == []


def test_good_data_are_rarely_set_aside():
    # White noise is 4.5 robust sd off its neighbours with a probability of 7e-6 a sample.
    count = sum(len(spikes_in(draw(100, 1.0, seed))) for seed in range(60))
    assert count <= most(6000, 1e-4)


# --- false alarms -------------------------------------------------------------------------------------------

DECAY = tc.Simulator(
    lambda x, p: p["a"] * torch.exp(-p["k"] * x),
    [tc.Parameter("a", initial=1.0), tc.Parameter("k", low=0.0, initial=1.0)],
)
LIBRARY = [
    tc.Term("offset", outputs={"y": lambda x, p, y: y + p["b"]}, parameters=[tc.Parameter("b")]),
    tc.Term("rate change", shifts={"k": lambda x, p: p["m"] * x}, parameters=[tc.Parameter("m")]),
    tc.Term("bump", outputs={"y": lambda x, p, y: y + p["h"] * torch.exp(-(((x - p["c"]) / 0.2) ** 2))},
            parameters=[tc.Parameter("h", low=0.0), tc.Parameter("c", low=0.0, high=3.0)]),
]  # fmt: skip


def decay(n, seed, phi=0.0, *, known, offset=0.0):
    x = torch.linspace(0, 3, n, dtype=F64)
    y = 1.1 * torch.exp(-0.9 * x) + offset + draw(n, 0.02, seed, phi)
    return tc.Recording(x=x, y=y, noise=0.02 if known else None)


def diagnosed(recording, seed=0, **options):
    return tc.diagnose(DECAY, recording, LIBRARY, seed=seed, progress=False, **options)


#: Samples, correlation, whether the noise is known, and the false alarms allowed: 2 % is what a diagnosis promises.
NULLS = {"white, known": (60, 0.0, True), "white, unknown": (60, 0.0, False), "AR(1), unknown": (200, 0.5, False)}


def nulls(name, seeds):
    n, phi, known = NULLS[name]
    return [diagnosed(decay(n, seed, phi, known=known), seed) for seed in seeds]


@pytest.mark.parametrize("name", NULLS)
def test_false_alarms_are_rare(name):
    found = nulls(name, range(8))
    assert sum(d.verdict != "consistent" for d in found) <= most(8, 0.02)
    for d in found:
        if d.verdict == "consistent":
            assert (d.terms, d.tied, d.remaining, d.after) == ([], [], 0.0, None)


@pytest.mark.slow
@pytest.mark.parametrize("name", NULLS)
def test_false_alarms_are_rare_over_many_seeds(name):
    seeds = 150
    found = nulls(name, range(1000, 1000 + seeds))
    assert sum(d.verdict != "consistent" for d in found) <= most(seeds, 0.02, 1e-2)
    stats = pytest.importorskip("scipy.stats")
    p = np.array([d.p_detect for d in found])
    # Small values must not be too frequent; they may be too rare, where the correlation is uncertain.
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 1e-3
    assert (p < 0.05).sum() <= most(seeds, 0.05)


@pytest.mark.parametrize("known", [pytest.param(True, marks=pytest.mark.slow), False])
def test_the_probability_of_a_misfit_is_uniform_without_one(known):
    # Below 40 samples no correlation is sought, and nothing makes the test cautious.
    stats = pytest.importorskip("scipy.stats")
    p = [search_of(decay(38, 500 + seed, known=known), seed).p_detect for seed in range(50)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


# --- screening and detection limits -------------------------------------------------------------------------


def search_of(recording, seed=0):
    search = Search(Problem.of(DECAY, recording), LIBRARY, {}, seed, 3, 1, lambda text: None)
    search.calibrate_base()
    search.screen_all()
    return search


def test_screening_scores_are_normal_without_a_misfit():
    stats = pytest.importorskip("scipy.stats")
    seeds = 40
    z = []
    for seed in range(seeds):
        search = search_of(decay(38, 2000 + seed, known=True), seed)
        unit = search.screening.columns
        torch.testing.assert_close(unit.norm(dim=0), torch.ones(unit.shape[1], dtype=F64))
        z.append((unit.T @ search.residual.e)[:2])
        # One-sided where physics is: nothing below zero, and the same as |z| on the other candidates.
        assert float(search.screening.z.min()) >= 0.0
    for column in torch.stack(z).T.numpy():
        assert abs(column.mean()) < 5 / math.sqrt(seeds)
        assert abs(column.std() - 1) < 5 / math.sqrt(2 * seeds)
        assert stats.kstest(column, "norm").pvalue > 1e-3


def test_a_planted_effect_moves_its_score_by_its_size():
    # E z = b ‖s⊥‖ for an offset b, to first order exactly for a linear output.
    seeds = 15
    z = []
    for seed in range(seeds):
        search = search_of(decay(38, 3000 + seed, known=True, offset=0.05), seed)
        i = search.screening.best[0]
        z.append(float(search.screening.columns[:, i] @ search.residual.e) - 0.05 * float(search.screening.norm[i]))
    assert abs(np.mean(z)) < 5 / math.sqrt(seeds) + 0.2


@pytest.mark.parametrize("freedom", [10, 57, 400])
def test_an_effect_at_a_limit_from_wavering_noise_is_seen_as_often_as_is_said(freedom):
    """A limit is told by one recording, and a fresh one with an effect of that size has an estimate of its own."""
    rng, wanted = np.random.default_rng(0), 2.8
    there, here = np.sqrt(rng.chisquare(freedom, (2, 200_000)) / freedom)
    size = _distance(wanted, 1.645, 1 / (2 * freedom)) * there
    seen = (size + rng.standard_normal(200_000) > wanted * here).mean()
    assert seen == pytest.approx(0.95, abs=0.012)
    assert _distance(wanted, 1.645, 0.0) == pytest.approx(wanted + 1.645)


@pytest.mark.parametrize("seeds", [3, pytest.param(12, marks=pytest.mark.slow)])
def test_the_stated_limit_is_where_detection_begins(seeds):
    # Twice the limit lies three and a half sd beyond the critical value, a quarter of it two and a half before.
    limit = diagnosed(decay(60, 1, known=True)).detection_limit[0]
    assert limit.term == "offset"
    assert limit.power == 0.95
    seen = {
        factor: sum(
            diagnosed(decay(60, 4000 + s, known=True, offset=factor * limit.smallest), max_terms=1).verdict
            != "consistent"
            for s in range(seeds)
        )
        for factor in (0.25, 2.0)
    }
    assert seen[2.0] == seeds
    assert seen[0.25] <= most(seeds, 0.05)


def test_limits_fall_with_the_noise_and_with_the_data():
    x = torch.linspace(0, 3, 60, dtype=F64)
    recordings = [tc.Recording(x=x, y=1.1 * torch.exp(-0.9 * x) + draw(60, sd, 1), noise=sd) for sd in (0.02, 0.04)]
    small, large = (diagnosed(recording).detection_limit[0].smallest for recording in recordings)
    assert 1.8 <= large / small <= 3.0  # more than in proportion: calibration hides more of a large offset
    many = diagnosed(decay(240, 1, known=True)).detection_limit[0].smallest
    assert 1.6 <= small / many <= 3.0


@pytest.mark.parametrize("sd", [0.02, 0.05])
def test_calibration_cannot_hide_an_effect_at_the_limit(sd):
    """Linear or not: fitted to it without noise, the base stays as far from it as a 99 % test with power 0.95 needs."""
    optimize = pytest.importorskip("scipy.optimize")
    x = torch.linspace(0, 3, 60, dtype=F64)
    recording = tc.Recording(x=x, y=1.1 * torch.exp(-0.9 * x) + draw(60, sd, 1), noise=sd)
    d = diagnosed(recording)
    limit = d.detection_limit[0]
    a, k = (d.base.estimates[i].value for i in range(2))
    distances = []
    for sign in (1, -1):
        y = a * np.exp(-k * x.numpy()) + sign * limit.smallest
        found = optimize.least_squares(lambda p, y=y: (p[0] * np.exp(-p[1] * x.numpy()) - y) / sd, [a, k])
        distances.append(math.sqrt(2 * found.cost))
    assert 4.0 < min(distances) < 7.0


def test_a_stricter_confidence_raises_the_limit():
    loose, strict = (diagnosed(decay(60, 1, known=True), confidence=c).detection_limit[0].smallest for c in (0.9, 0.99))
    assert strict > loose


def test_a_lone_outlier_is_one_beside_a_residual_of_the_other_sign_and_a_bump_or_an_end_is_none():
    t = torch.linspace(0, 10, 60, dtype=F64)
    base = tc.ODESimulator(lambda t, s, p, u: {"y": -p["k"] * s["y"]}, {"y": None}, [tc.Parameter("k", initial=0.1)])
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"y": torch.exp(-0.1 * t)})], noise=0.1)
    problem = Problem.of(base, recording)
    residual = 0.1 * torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=F64).clamp(-2, 2)
    residual[20] = -0.8  # eight sd, beside nothing
    residual[50:53] = torch.tensor([-0.38, 0.74, -0.35], dtype=F64)  # a model that bends to it
    residual[59] = -0.8  # the end of what may be physics
    residual[40:43] = torch.tensor([0.5, 0.6, 0.5], dtype=F64)  # something that lasts
    assert lone(problem, residual, recording.noise).nonzero()[:, 0].tolist() == [20, 51]
    assert lone(problem, residual, None).nonzero()[:, 0].tolist() == [20, 51]
    residual[29:33] = torch.tensor([0.1, -0.82, -0.7, -0.1], dtype=F64)  # two side by side, of different size
    assert lone(problem, residual, recording.noise).nonzero()[:, 0].tolist() == [20, 30, 31, 51]
    residual[32] = -0.4  # what fades is no pair of them
    assert lone(problem, residual, recording.noise).nonzero()[:, 0].tolist() == [20, 51]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_blank_at_the_start_is_no_surer_than_what_is_known(seed):
    """An assay: 5 % of the reading and a floor. Of the first sample, an exact 0 by the model, no neighbours tell."""
    t = np.array([0, 0.1, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24, 30.0])
    base = tc.ODESimulator(
        lambda t, s, p, u: {"A": -p["ka"] * s["A"], "C": p["ka"] * s["A"] - p["ke"] * s["C"]}, ["A", "C"],
        [tc.Parameter("ka", low=0.0, initial=1.0), tc.Parameter("ke", low=0.0, initial=0.1)], observe=("C",),
    )  # fmt: skip
    runs, sd = [], []
    for number, dose in enumerate((5.0, 15.0)):
        clean = dose * 1.2 / (1.2 - 0.18) * (np.exp(-0.18 * t) - np.exp(-1.2 * t))
        sd.append(0.05 * clean + 0.01)
        noisy = clean + sd[-1] * np.random.default_rng(2 * seed + number).standard_normal(len(t))
        runs.append(tc.Run(time=t, outputs={"C": noisy}, initial={"A": dose, "C": 0.0}))
    _, noise = calibrate_base(Problem.of(base, tc.Recording(runs=runs)), {}, 4, 0)
    ratio = (noise.sd / torch.tensor(np.concatenate(sd))).numpy()
    assert 0.3 < ratio.min() < ratio.max() < 4.0


@pytest.mark.slow
def test_replicates_tell_noise_that_grows():
    """As many false alarms at 1 % as a binomial allows, where small values looked too well fitted before."""
    x = np.tile(np.geomspace(0.2, 20, 20), 2)
    parameters = [tc.Parameter("a", low=0.0), tc.Parameter("b", low=0.0)]
    base = tc.Simulator(lambda x, p: p["a"] * x / (p["b"] + x), parameters)
    terms = [tc.Term("leak", outputs={"y": lambda x, p, y: y + p["g"] * x}, parameters=[tc.Parameter("g")]),
             *tc.terms.sensor(("y",), static=True)]  # fmt: skip
    seeds, alarms = 20, 0
    for seed in range(seeds):
        y = 12 * x / (1.5 + x) * (1 + 0.05 * np.random.default_rng(seed).standard_normal(40))
        d = tc.diagnose(base, tc.Recording(x=x, y=y), terms, seed=0, progress=False)
        alarms += d.verdict != "consistent"
        assert d.noise.source == "replicates"
    assert alarms <= most(seeds, 0.01, tail=3e-3)


@pytest.mark.parametrize(("size", "verdict"), [(0.2, "named"), (4.0, "ambiguous")])
def test_an_instrument_that_adds_more_than_it_measures_is_no_name(size, verdict):
    x = np.linspace(0, 3, 80)
    y = 3 * x + size * x**2 + 0.02 * np.random.default_rng(0).standard_normal(80)
    base = tc.Simulator(lambda x, p: p["m"] * x, [tc.Parameter("m")])
    terms = [term for term in tc.terms.sensor(("y",), static=True) if term.name == "non-linearity of y"]
    d = tc.diagnose(base, tc.Recording(x=x, y=y), terms, seed=0, progress=False)
    assert d.verdict == verdict
    told = "varies more by the instrument's error than by the true value" in " ".join(str(d).split())
    assert told == (verdict != "named")


@pytest.mark.filterwarnings("ignore:The calibrated base explains no more than a constant")
@pytest.mark.parametrize(
    ("offset", "gain", "told"),
    [
        pytest.param(2.0, -0.3, None, marks=pytest.mark.slow),
        (0.0, -0.8, None),
        (10.0, -0.8, "shows less than 40% of what the true value varies by"),
    ],
)
def test_an_instrument_that_hardly_shows_what_it_measures_is_no_name(offset, gain, told):
    x = np.linspace(0, 3, 80)
    y = (1 + gain) * np.exp(x) + offset + 0.05 * np.random.default_rng(0).standard_normal(80)
    base = tc.Simulator(lambda x, p: torch.exp(p["m"] * x), [tc.Parameter("m", initial=1.0)])
    terms = [t for t in tc.terms.sensor(("y",), static=True) if t.name in ("offset of y", "gain error of y")]
    d = tc.diagnose(base, tc.Recording(x=x, y=y), terms, seed=0, progress=False)
    assert d.verdict == ("named" if told is None else "ambiguous")
    assert told is None or told in " ".join(str(d).split())


def test_an_instrument_that_saturates_below_most_data_is_no_name_beside_another_term():
    """Heat pumps lose in one corner, cold and hot, which is in no list: a saturation by 72 % below 85 % of the data
    and a loss with the lift follow that as well."""
    rng, n = np.random.default_rng(1012), 120
    cold, hot, load = rng.uniform(-15, 15, n), rng.uniform(30, 60, n), rng.uniform(0.2, 1, n)
    clean = 0.45 * (hot + 273.15) / (hot - cold) * (1 - 0.004 * np.maximum(hot - 45, 0) * np.maximum(-cold, 0))
    base = tc.Simulator(
        lambda x, p: {"COP": p["eta"] * (x["hot"] + 273.15) / (x["hot"] - x["cold"])},
        [tc.Parameter("eta", low=0.0, high=1.0, initial=0.4)],
    )
    c = [tc.Parameter("c", low=0.0)]
    terms = [
        tc.Term("cycling", outputs={"COP": lambda x, p, y: y * (1 - p["c"] * (1 - x["load"]))}, parameters=c),
        tc.Term("lift", outputs={"COP": lambda x, p, y: y * (1 - p["c"] * (x["hot"] - x["cold"] - 30))}, parameters=c),
        *tc.terms.sensor(("COP",), static=True),
    ]
    x, y = {"cold": cold, "hot": hot, "load": load}, clean + 0.158 * rng.normal(size=n)
    d = tc.diagnose(base, tc.Recording(x=x, y={"COP": y}, noise=0.158), terms, seed=0, progress=False)
    assert d.verdict == "ambiguous"
    assert d.tied == [["lift", "saturation of COP"], ["none of these"]]
    assert "COP shows less than 40% of what the true value varies by" in " ".join(str(d).split())


def test_an_instrument_that_saturates_above_most_data_is_a_name_beside_another_term():
    """It shows less than 40 % of the variation as well, and all of it below a fifth of the range."""
    x = np.linspace(0, 4.5, 90)
    y = np.exp(x) + 6.0 * np.sin(x)
    y = np.where(y > 20, 20 + 0.05 * (y - 20), y) + 0.1 * np.random.default_rng(0).standard_normal(90)
    base = tc.Simulator(lambda x, p: torch.exp(p["m"] * x), [tc.Parameter("m", initial=1.0)])
    terms = [
        tc.Term("swing", outputs={"y": lambda x, p, y: y + p["b"] * x.sin()}, parameters=[tc.Parameter("b")]),
        *tc.terms.sensor(("y",), static=True),
    ]
    d = tc.diagnose(base, tc.Recording(x=x, y=y, noise=0.1), terms, seed=0, progress=False)
    assert d.verdict == "named"
    assert set(d.terms) == {"swing", "saturation of y"}


LOSS = tc.ODESimulator(
    rates=lambda t, s, p, u: {"n": -p["k"] * s["n"]},
    states={"n": "1"},
    parameters=[tc.Parameter("k", low=0.0, initial=0.4)],
)


def uneven(seed, by_sample, phi=0.75, sd=0.02):
    """Two unevenly sampled runs of `LOSS` with noise that forgets with every sample, or with time."""
    rng, runs = np.random.default_rng(seed), []
    for start in (1.0, 2.0):
        t = np.concatenate([[0.0], np.sort(rng.uniform(0, 8, 59))])
        gaps = np.diff(t) / np.median(np.diff(t))
        noise = rng.standard_normal(60)
        for k in range(1, 60):
            rho = phi if by_sample else phi ** gaps[k - 1]
            noise[k] = rho * noise[k - 1] + math.sqrt(1 - rho**2) * noise[k]
        runs.append(tc.Run(time=t, outputs={"n": start * np.exp(-0.3 * t) + sd * noise}))
    return tc.Recording(runs=runs)


@pytest.mark.parametrize("by_sample", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_noise_of_uneven_runs_forgets_with_time_or_with_every_sample(by_sample):
    # What forgets with every sample was something missing: close samples do not agree as they would have to.
    seeds, seen = 12, []
    for seed in range(seeds):
        problem = Problem.of(LOSS, uneven(seed, by_sample))
        base, noise = calibrate_base(problem, {}, 4, seed)
        seen.append((base.problem.by_sample, float(noise.correlation[0]), float(noise.sd[0])))
        fewer = base.problem.keeping(torch.arange(120) % 60 != 30)  # it was recorded all the same
        usual = fewer.gaps(fewer.recorded[0])
        assert float(usual[29]) == 2.0 or not base.problem.by_sample
    assert sum(one[0] == by_sample for one in seen) >= seeds - 1
    assert 0.55 < sum(one[1] for one in seen) / seeds < 0.85
    assert 0.013 < sum(one[2] for one in seen) / seeds < 0.022


def test_two_samples_at_nearly_one_time_are_no_sign_of_a_memory():
    # Smooth curves of ranks told the two apart, and what is left of them counted for nothing where noise remembers.
    rng = np.random.default_rng(0)
    model = tc.ODESimulator(lambda t, s, p, u: {"A": -p["k"] * s["A"]}, {"A": "M"}, [tc.Parameter("k", low=0.0)])
    runs = []
    for _ in range(2):
        t = np.cumsum(rng.exponential(0.4, 40))
        t[20] = t[19] + 4e-4
        runs.append(tc.Run(t - t[0], {"A": 2 * np.exp(-0.5 * (t - t[0])) + 0.02 * rng.standard_normal(40)}))
    base, noise = calibrate_base(Problem.of(model, tc.Recording(runs=runs, noise=0.02)), {}, 4, 0)
    assert noise.correlation.tolist() == [0.0]
    assert noise.posterior[0, 0] > 0.99
    assert base.chi2 < 80 + 4 * math.sqrt(160)


@pytest.mark.parametrize("place", [0.1, 0.3, 0.8])
def test_curves_bend_where_there_are_data_of_a_geometric_row(place):
    t = torch.logspace(-3, 3, 60, dtype=F64)
    model = tc.ODESimulator(lambda t, s, p, u: {"A": -p["k"] * s["A"]}, {"A": "M"}, [tc.Parameter("k", low=0.0)])
    problem = Problem.of(model, tc.Recording(runs=[tc.Run(t, {"A": torch.ones(60, dtype=F64)})], noise=0.02))
    along = torch.linspace(0, 1, 60, dtype=F64)
    bump = torch.exp(-0.5 * ((along - place) / 0.08) ** 2)
    basis = orthonormal(smooth_columns(problem, problem.sequences[0]))
    assert float((bump - basis @ (basis.T @ bump)).norm() / bump.norm()) < 0.15


@pytest.mark.parametrize("by_sample", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_correlated_noise_of_uneven_runs_is_nothing_missing(by_sample):
    term = tc.Term(
        "second order", equation="n", rate=lambda t, s, p, u: -p["a"] * s["n"] ** 2,
        parameters=[tc.Parameter("a", low=0.0)],
    )  # fmt: skip
    found = [tc.diagnose(LOSS, uneven(seed, by_sample), [term], seed=0, progress=False) for seed in range(4, 7)]
    assert sum(d.verdict != "consistent" for d in found) <= 1


def swept(seed, depth, sweeps=3, phi=0.0):
    """Sweeps of 28 data with noise of unknown size, and a bump in the last of them."""
    x, s = torch.linspace(0, 1, 28, dtype=F64).repeat(sweeps), torch.arange(28 * sweeps) // 28
    noise = torch.cat([draw(28, 0.02, 100 * seed + k, phi) for k in range(sweeps)])
    y = 1 + 2 * x + 0.5 * s - 0.02 * depth * torch.exp(-(((x - 0.52) / 0.15) ** 2)) * (s == sweeps - 1) + noise
    base = tc.Simulator(
        lambda x, p: {"y": p["a"] + p["b"] * x["x"] + p["c"] * x["s"]}, [tc.Parameter(name) for name in "abc"]
    )
    term = tc.Term(
        "quadratic", outputs={"y": lambda x, p, y: y + p["q"] * x["x"] ** 2}, parameters=[tc.Parameter("q")]
    )
    recording = tc.Recording(x={"x": x, "s": s.double()}, y={"y": y})
    return tc.diagnose(base, recording, [term], seed=0, progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_what_acts_in_one_of_several_sweeps_is_no_slow_noise(seed):
    d = swept(seed, 12.0)
    assert d.verdict == "unexplained"
    assert d.noise.sd["y"] == pytest.approx(0.02, rel=0.4)


def test_what_acts_in_one_of_several_sweeps_is_told_where_it_may_be_slow_noise():
    d = swept(3, 6.0)
    (told,) = [row for row in d.symptoms if "not alike in all sweeps" in row]
    assert d.verdict == "consistent"
    assert "number 3 of 3" in told
    assert "if the symptoms below are noise" in str(d)


@pytest.mark.parametrize("phi", [pytest.param(0.0, marks=pytest.mark.slow), 0.7])
def test_noise_that_is_alike_in_all_sweeps_is_not_told_to_differ(phi):
    found = [swept(seed, 0.0, phi=phi) for seed in range(5)]
    assert sum(any("not alike" in row for row in d.symptoms) for d in found) <= most(5, 0.01)


@pytest.mark.parametrize("counts", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_noise_that_is_given_as_a_share_of_what_was_read_is_no_misfit(counts):
    """An error bar of 5 % of each reading, or of the root of each count: what is left beyond smooth curves in units of
    the noise had been nothing, as a constant and a tangent of the output are that noise."""
    x = np.geomspace(0.5, 50, 60)
    base = tc.Simulator(
        lambda x, p: p["a"] * x["x"] ** p["n"],
        [tc.Parameter("a", low=0.0, initial=1.0), tc.Parameter("n", low=0.0, high=2.0, initial=0.5)],
    )
    bent = tc.Term("bent", shifts={"n": lambda x, p: p["q"] * torch.log(x["x"])}, parameters=[tc.Parameter("q")])
    terms = [bent, *tc.terms.sensor(outputs=("y",), static=True)]
    p, correlations = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        mean = 400 * x**0.3 if counts else 4 * x**0.7
        y = rng.poisson(mean).astype(float) if counts else mean * (1 + 0.05 * rng.standard_normal(60))
        sd = np.sqrt(y) if counts else 0.05 * y
        recording = tc.Recording(x={"x": torch.tensor(x)}, y=torch.tensor(y), noise=torch.tensor(sd))
        d = tc.diagnose(base, recording, terms, seed=0, progress=False)
        assert not any("fastest part" in one for one in d.symptoms)
        p.append(d.p_detect)
        correlations.append(float(d.noise.correlation["y"]))
    assert min(p) > 0.01 / 6 / 2
    assert np.median(p) > 0.1
    assert sum(c > 0.2 for c in correlations) <= 2  # of white noise


def test_data_that_scatter_by_more_than_the_noise_that_was_given_are_told_to():
    c = torch.linspace(1, 8, 15, dtype=F64).repeat(2)
    y = 2 * c / (1.5 + c) + draw(30, 0.03, 0)
    y[15:] *= 0.9  # the second time
    law = tc.Simulator(lambda x, p: p["V"] * x / (p["K"] + x), [tc.Parameter("V", low=0.0), tc.Parameter("K", low=0.0)])
    for noise, larger in ((0.03, True), (0.1, False)):
        d = tc.diagnose(law, tc.Recording(x=c, y=y, noise=noise), [], seed=0, progress=False)
        told = " ".join(str(d).split())
        assert d.verdict == "consistent", told
        assert bool(re.search(r"surely missing, if the noise is [23]\.\d times as large as given\)", told)) is larger
        assert "correlated from row to row, in the order of the recording" in told  # the second time
        assert ("data beside each other differ by more than the noise that was given" in told) is larger
        assert (d.settings["larger_noise"] != "") is larger


CURVE = tc.Simulator(
    lambda x, p: p["a"] + p["b"] * x + p["c"] * x**2,
    [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("c", neutral=0.0)],
)


def given_half(y, sd=0.05):
    """A diagnosis of a curve with white noise of 0.1, of which another sd was given."""
    x = torch.linspace(0, 2, len(y), dtype=F64)
    return tc.diagnose(CURVE, tc.Recording(x=x, y=y, noise=sd), [tc.Term("bend", frees=["c"])], progress=False)


@pytest.mark.slow
def test_noise_of_twice_the_sd_that_was_given_is_no_physics():
    x = torch.linspace(0, 2, 60, dtype=F64)
    trials, source = 12, []
    for seed in range(trials):
        d = given_half(1 + x + draw(60, 0.1, 300 + seed))
        assert d.verdict == "consistent"
        source.append(d.noise.source)
        if d.noise.source == "estimated":
            assert "if the noise is " in str(d).splitlines()[0]
            assert "Noise sd (estimated, larger than given)" in str(d)
            assert float(d.noise.sd["y"]) == pytest.approx(0.1, rel=5 / math.sqrt(2 * 50))
            assert d.settings["larger_noise"].startswith(" is ")
    assert source.count("estimated") > trials / 2


@pytest.mark.slow
def test_what_is_missing_is_named_beside_noise_of_twice_the_sd_that_was_given():
    x = torch.linspace(0, 2, 60, dtype=F64)
    for seed in range(4):
        d = given_half(1 + x + 0.6 * x**2 + draw(60, 0.1, 300 + seed))
        assert (d.verdict, d.terms, d.noise.source) == ("named", ["bend"], "estimated"), str(d)
        told = " ".join(str(d).split())
        assert re.match(r"Verdict: named: bend, if the noise is [12]\.\d times as large as given", told)
        assert "With the noise that was given nothing explains these data, as neighbours differ by more" in told
        (estimate,) = [e for e in d.ranking[0].estimates if e.name == "c"]
        assert abs(estimate.value - 0.6) < 4 * estimate.sd


def test_what_nothing_explains_with_larger_noise_either_is_told_with_the_noise_that_was_given(monkeypatch):
    asked = []
    with_noise = tc.Recording.with_noise
    monkeypatch.setattr(tc.Recording, "with_noise", lambda self, noise: asked.append(noise) or with_noise(self, noise))
    x = torch.linspace(0, 2, 60, dtype=F64)
    for sd, size, searches in ((0.1, 0.5, 1), (0.03, 0.5, 1), (0.03, 0.15, 2)):  # where it is far larger, no second one
        asked.clear()
        d = given_half(1 + x + size * torch.sin(6 * x) + draw(60, 0.1, 300), sd)
        assert (d.verdict, d.noise.source) == ("unexplained", "given")
        assert any("fastest part" in row for row in d.symptoms) is (sd < 0.1)
        assert 1 + len(asked) == searches


@pytest.mark.parametrize("seed", range(3))
def test_what_goes_with_a_condition_is_no_larger_noise(seed):
    """A ripple along one of two conditions, by which the rows are not sorted: smooth curves leave it, or follow it."""
    rng = np.random.default_rng(seed)
    dose, age = np.exp(rng.uniform(np.log(0.05), np.log(50), 60)), rng.uniform(20, 70, 60)
    y = dose / (1 + dose) + 0.05 * np.sin(6 * np.log(dose)) + 0.018 * rng.standard_normal(60)
    bind = tc.Simulator(
        lambda x, p: p["top"] * x["dose"] / (p["half"] + x["dose"]),
        [tc.Parameter("top", low=0.0, initial=1.0), tc.Parameter("half", low=0.0, initial=0.8)],
    )
    for noise in (0.018, None):
        recording = tc.Recording(x={"dose": dose, "age": age}, y=y, noise=noise)
        d = tc.diagnose(bind, recording, [], seed=0, progress=False)
        assert d.noise.source == ("given" if noise else "estimated")
        if noise:
            assert d.verdict == "unexplained"
        elif seed < 2:  # where noise alone may be enough, it is told what it looks like; of the third it does not show
            assert d.verdict == "consistent"
            assert any("what is left goes on along dose" in row for row in d.symptoms)


def test_white_noise_goes_on_along_no_condition():
    told = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        x = {name: rng.uniform(0, 1, 50) for name in "ab"}
        problem = Problem.of(LINE, tc.Recording(x=x, y=rng.standard_normal(50), noise=1.0))
        told += bool(goes_on_along(problem, problem.y))
    assert told <= most(300, 2 * 5e-4)


def test_white_noise_goes_on_along_no_condition_at_one_value_of_another():
    told = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        x = {"a": rng.uniform(0, 1, 60), "level": rng.choice([1.0, 2.0, 4.0, 8.0], 60)}
        problem = Problem.of(LINE, tc.Recording(x=x, y=rng.standard_normal(60), noise=1.0))
        told += bool(goes_on_along(problem, problem.y))
    assert told <= most(300, 2 * 5e-4)


@pytest.mark.parametrize("seed", range(2))
def test_what_goes_on_at_each_level_of_another_condition_is_no_larger_noise(seed):
    """A ripple along one condition whose phase differs from level to level of another: over all levels it is none."""
    rng = np.random.default_rng(seed)
    a, level = rng.uniform(0, 10, 80), rng.choice([0.1, 0.3, 0.6, 1.0, 1.5, 2.0], 80)
    ripple = 0.3 * np.sin(0.9 * a + 7.0 * level)
    problem = Problem.of(LINE, tc.Recording(x={"a": a, "level": level}, y=ripple, noise=0.05))
    assert goes_on_along(problem, problem.y) == [("y", "a at each level")]
    y = 2 * np.exp(-0.2 * a) + ripple + 0.05 * rng.standard_normal(80)
    fade = tc.Simulator(
        lambda x, p: p["top"] * torch.exp(-p["k"] * x["a"]),
        [tc.Parameter("top", low=0.0, initial=1.0), tc.Parameter("k", low=0.0, initial=0.1)],
    )
    d = tc.diagnose(fade, tc.Recording(x={"a": a, "level": level}, y=y, noise=0.05), [], progress=False)
    assert (d.verdict, d.noise.source) == ("unexplained", "given")


def test_a_given_noise_is_kept_where_an_output_has_too_few_data_to_tell_another():
    x = torch.linspace(0, 2, 60, dtype=F64)
    w = torch.full_like(x, math.nan)
    w[::30] = torch.tensor([1.0, 2.0], dtype=F64)
    base = tc.Simulator(
        lambda x, p: {"u": p["a"] + p["b"] * x, "w": p["c"] + p["d"] * x}, [tc.Parameter(name) for name in "abcd"]
    )
    y = {"u": 1 + x + draw(60, 0.1, 302), "w": w}
    recording = tc.Recording(x=x, y=y, noise={"u": 0.03, "w": 0.1}, missing=True)
    d = tc.diagnose(base, recording, [], progress=False)
    assert d.noise.source == "given"
    assert d.settings["larger_noise"].startswith(" of u is ")


@pytest.mark.parametrize("seed", range(3))
def test_a_misfit_of_one_output_is_not_hidden_by_the_noise_of_another(seed):
    x = torch.linspace(0, 2, 60, dtype=F64)
    w = torch.full_like(x, math.nan)
    few = torch.arange(8) * 8
    w[few] = (1 + x + 0.06 * x**2)[few] + draw(8, 0.01, 400 + seed)
    base = tc.Simulator(
        lambda x, p: {"u": p["a"] + p["b"] * x, "w": p["c"] + p["d"] * x}, [tc.Parameter(name) for name in "abcd"]
    )
    y = {"u": 1 + x + draw(60, 0.1, 410 + seed), "w": w}
    recording = tc.Recording(x=x, y=y, noise={"u": 0.05, "w": 0.01}, missing=True)
    d = tc.diagnose(base, recording, [], progress=False)
    assert (d.verdict, d.noise.source) == ("unexplained", "given")


def test_every_output_is_told_whose_noise_is_larger():
    x = torch.linspace(0, 2, 60, dtype=F64)
    base = tc.Simulator(
        lambda x, p: {"u": p["a"] + p["b"] * x, "w": p["c"] + p["d"] * x}, [tc.Parameter(name) for name in "abcd"]
    )
    y = {"u": 1 + x + draw(60, 0.1, 302), "w": 2 - x + draw(60, 0.03, 303)}
    d = tc.diagnose(base, tc.Recording(x=x, y=y, noise={"u": 0.04, "w": 0.01}), [], progress=False)
    told = " ".join(str(d).split())
    found = re.search(r"if the noise of u is (\d\.\d) times and that of w (\d\.\d) times as large as given", told)
    assert found is not None, told
    for times, (name, given) in zip(found.groups(), (("u", 0.04), ("w", 0.01)), strict=True):
        assert float(times) == pytest.approx(d.noise.sd[name] / given, rel=0.05)


def test_the_order_of_rows_is_no_order_of_a_condition():
    rng = np.random.default_rng(5)
    e = draw(36, 1.0, 5, phi=0.9)
    x = {"dose": rng.uniform(0, 1, 36), "T": np.full(36, 300.0), "sex": np.arange(36) % 2.0}
    problem = Problem.of(LINE, tc.Recording(x=x, y=e, noise=1.0))
    assert {condition for _, condition in goes_on_along(problem, problem.y)} <= {"dose"}  # by chance
    age, dose = (v.ravel() for v in np.meshgrid(np.linspace(0, 6, 24), np.linspace(0, 1, 12), indexing="ij"))
    problem = Problem.of(LINE, tc.Recording(x={"dose": dose, "age": age}, y=np.sin(age), noise=1.0))
    assert [condition for _, condition in goes_on_along(problem, problem.y)] == ["age"]


def test_a_given_noise_that_varies_keeps_its_pattern_where_it_is_larger():
    x = torch.linspace(0, 2, 60, dtype=F64)
    sizes = torch.linspace(0.02, 0.2, 60, dtype=F64)
    d = given_half(1 + x + sizes * draw(60, 1.0, 301), sizes / 3)
    assert (d.verdict, d.noise.source) == ("consistent", "estimated")
    low, high = d.noise.range["y"]
    assert high / low == pytest.approx(10, rel=1e-6)
    assert float(d.noise.sd["y"]) == pytest.approx(float(sizes.median()), rel=5 / math.sqrt(2 * 50))


@pytest.mark.slow
def test_a_given_noise_that_is_right_is_kept(monkeypatch):
    asked = []
    with_noise = tc.Recording.with_noise
    monkeypatch.setattr(tc.Recording, "with_noise", lambda self, noise: asked.append(noise) or with_noise(self, noise))
    x = torch.linspace(0, 2, 60, dtype=F64)
    for seed in range(8):
        for effect in (0.0, 0.6):
            d = given_half(1 + x + effect * x**2 + draw(60, 0.1, 300 + seed), 0.1)
            assert d.noise.source == "given"
    assert len(asked) <= most(16, 0.03)


def killed(seed: int, lost: float, *, memory: float = 0.0, runs: int = 6, together: bool = True) -> tuple:
    """Logarithms of what is left of as many cultures by as many doses, all sampled at the same times; something takes
    the same from each of them between 3 and 4 h."""
    g = torch.Generator().manual_seed(seed)
    t = torch.tensor([0.0, 0.3, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0], dtype=F64)
    each = []
    for i in range(runs):
        noise = torch.randn(len(t), generator=g, dtype=F64)
        for k in range(1, len(t)):
            noise[k] = memory * noise[k - 1] + math.sqrt(1 - memory**2) * noise[k]
        taken = lost * (t - (3.0 if together else 1.0 + i)).clamp(0.0, 1.0)
        y = 6.0 - 0.1 * (i + 1) * t - taken + 0.12 * noise
        each.append(tc.Run(t, {"L": y}, inputs={"C": torch.full_like(t, float(i + 1))}))
    base = tc.ODESimulator(
        lambda t, s, p, u: {"L": p["m"] - p["k"] * u["C"]}, {"L": "1"},
        [tc.Parameter("m", unit="1/h"), tc.Parameter("k", unit="1/h", low=0.0, initial=0.1)],
    )  # fmt: skip
    return base, tc.Recording(runs=each, units={"time": "h"})


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_what_all_runs_do_at_one_time_is_no_noise(seed):
    """Slow noise of unknown size would explain each run, and not all of them alike."""
    base, recording = killed(seed, 0.8)
    d = tc.diagnose(base, recording, [], progress=False)
    assert d.verdict == "unexplained"
    assert d.where[0].driver == "t"
    assert d.noise.sd["L"] == pytest.approx(0.12, rel=0.35)


@pytest.mark.parametrize("memory", [pytest.param(0.0, marks=pytest.mark.slow), 0.7])
def test_noise_of_runs_that_share_their_times_is_consistent(memory):
    for seed in range(3):
        base, recording = killed(seed, 0.0, memory=memory)
        assert tc.diagnose(base, recording, [], progress=False).verdict == "consistent"


@pytest.mark.parametrize(
    ("n", "chi2", "evidence", "share", "explained"),
    [
        (18, 91.5, 17.6, 0.97, False),  # measured on noise of twice the sd that was given
        (18, 91.5, 30.0, 0.97, True),
        (18, 91.5, 30.0, 0.5, False),
        (60, 230.0, 18.2, 0.94, True),  # measured on a ripple
    ],
)
def test_a_change_of_few_data_is_no_explanation_where_a_larger_noise_is_likelier(n, chi2, evidence, share, explained):
    places = [types.SimpleNamespace(evidence=one, share=share) for one in (evidence, 3.0, 1.0)]
    base = types.SimpleNamespace(chi2=chi2, free=[0, 1])
    search = types.SimpleNamespace(
        structure=types.SimpleNamespace(places=places, together=None), base=base, problem=types.SimpleNamespace(n=n)
    )
    assert _explained_by_place(search) is explained


def two_outputs_in_slow_noise(seed, rho):
    x = torch.linspace(0, 1, 60, dtype=torch.float64)
    base = tc.Simulator(
        lambda x, p: {"i": p["a"] * x, "w": p["b"] + p["c"] * x}, [tc.Parameter(name) for name in "abc"]
    )
    generator = np.random.default_rng(seed)

    def noise():
        e = generator.standard_normal(60)
        for k in range(1, 60):
            e[k] = rho * e[k - 1] + math.sqrt(1 - rho**2) * e[k]
        return torch.as_tensor(e)

    y = {"i": 2 * x + 0.05 * noise(), "w": 5 - 3 * x + 0.15 * noise()}
    return tc.diagnose(base, tc.Recording(x=x, y=y), seed=0, progress=False)


def test_nothing_is_called_missing_where_the_base_keeps_much_of_the_probability():
    d = two_outputs_in_slow_noise(1022, 0.6)
    assert d.verdict == "consistent"
    assert d.p_detect < 0.01
    base = sum(row.probability for row in d.ranking if not row.terms)
    assert 0.2 < base < 0.5
    assert f"the base alone keeps a probability of {base:.2f}" in " ".join(str(d).split())


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.6, 0.85])
def test_few_data_in_slow_noise_of_unknown_size_raise_few_alarms(rho):
    seeds = 60
    alarms = sum(two_outputs_in_slow_noise(seed, rho).verdict != "consistent" for seed in range(seeds))
    assert alarms <= most(seeds, 0.02, tail=3e-3)


def test_noise_does_not_grow_because_one_of_two_terms_was_missing_when_it_was_estimated():
    v, d, length = (a.ravel() for a in np.meshgrid(np.geomspace(0.02, 1.5, 9), [1, 3, 6.0], [0.2, 0.6], indexing="ij"))
    truth = 9 * v * length / d**2 + v**2 * length / d + 0.4 * v**2
    y = truth + 0.05 * np.random.default_rng(10).standard_normal(54)
    bed = tc.Simulator(
        lambda x, p: {"dp": p["A"] * x["v"] * x["L"] / x["d"] ** 2 + p["B"] * x["v"] ** 2 * x["L"] / x["d"]},
        [tc.Parameter("A", low=0, initial=10.0), tc.Parameter("B", low=0, high=100, neutral=0.0)],
    )
    ends = tc.Term("ends", outputs={"dp": lambda x, p, y: y + p["z"] * x["v"] ** 2}, parameters=[tc.Parameter("z")])
    x = {name: torch.tensor(column) for name, column in {"v": v, "d": d, "L": length}.items()}
    terms = [tc.Term("inertia", frees=("B",)), ends]
    found = tc.diagnose(bed, tc.Recording(x=x, y={"dp": torch.tensor(y)}), terms, progress=False)
    assert (found.verdict, set(found.terms)) == ("named", {"inertia", "ends"}), str(found)
    assert "growing" not in str(found)
    (size,) = [e for e in found.final.estimates if e.name == "ends.z"]
    assert abs(size.value - 0.4) < 3 * size.sd < 0.04


def test_a_sudden_change_taken_out_under_one_noise_is_credited_no_more_than_it_removes_under_another():
    """A friction and a spring, of which smooth curves follow neither: they leave noise of unknown size alone."""
    phase, amplitude = torch.linspace(0, 6 * math.pi, 110, dtype=F64), torch.tensor([0.3, 0.8], dtype=F64)
    amplitude = amplitude.repeat_interleave(55)
    v, x, warmth = 2 * amplitude * phase.cos(), amplitude * phase.sin(), torch.linspace(20, 70, 110, dtype=F64)
    y = 4 * v + x + 0.8 * torch.tanh(v / 0.05) + draw(110, 0.2, 900)
    damper = tc.Simulator(lambda x, p: p["c"] * x["v"], [tc.Parameter("c", low=0.0, initial=3.0)])
    terms = [
        tc.Term("spring", outputs={"y": lambda x, p, y: y + p["k"] * x["x"]}, parameters=[tc.Parameter("k", low=0.0)]),
        tc.Term("friction", outputs={"y": lambda x, p, y: y + p["f"] * torch.tanh(x["v"] / 0.05)},
                parameters=[tc.Parameter("f", low=0.0)]),
    ]  # fmt: skip
    d = tc.diagnose(damper, tc.Recording(x={"v": v, "x": x, "T": warmth}, y=y), terms, progress=False)
    assert d.verdict == "named"
    assert set(d.terms) == {"spring", "friction"}
    assert float(d.noise.sd["y"]) == pytest.approx(0.2, rel=0.25)


def test_a_weak_memory_that_a_misfit_feigned_is_given_up_where_samples_are_close_together():
    """From each sample to the next it is strong where these are far closer than most."""
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0.0, 20.0, 160))
    t[0] = 0.0
    level = 6.0 * np.exp(-0.3 * t) + 2.0 * (1 - np.exp(-0.3 * t))
    run = tc.Run(time=t, outputs={"T": level + 0.1 * rng.standard_normal(160)}, initial={"T": 6.0})
    base = tc.ODESimulator(lambda t, s, p, u: {"T": -p["k"] * s["T"]}, {"T": "K"}, [tc.Parameter("k", low=0.0)])
    heating = tc.Term("heating", equation="T", rate=lambda t, s, p, u: p["q"], parameters=[tc.Parameter("q")])
    problem = Problem.of(base, tc.Recording(runs=[run], noise=0.1))
    search = Search(problem, [heating], {}, 0, 4, 1, lambda text: None, None)
    search.calibrate_base()
    search.screen_all()
    refit_singles(search)
    assert search.leader.names == ("heating",)
    feigned = dataclasses.replace(search.noise, correlation=torch.tensor([0.049], dtype=torch.float64))
    search.take(feigned, search.models)
    assert search.leader.found.chi2 > 200  # of 160 data
    search.reweigh()
    assert float(search.noise.correlation) == 0.0
    assert search.leader.found.chi2 < 200


TEMPERATURE, RATE = (a.ravel() for a in np.meshgrid(np.linspace(280, 360, 9), np.geomspace(1, 1e3, 8), indexing="ij"))


def test_what_bends_along_the_sweeps_of_a_grid_is_no_noise_that_grows():
    # Above 330 K something depends on the logarithm of the shear rate, which no low polynomial of it follows.
    base = tc.Simulator(lambda x, p: p["lnA"] + p["E"] * (1 / x["T"] - 1 / 320), [
        tc.Parameter("lnA"), tc.Parameter("E", initial=2000.0),
    ])  # fmt: skip
    clean = 2500.0 * (1 / TEMPERATURE - 1 / 320) - 1.0 + 0.1 * np.log(RATE / 30) * (TEMPERATURE > 330)
    sensors = tc.terms.sensor(outputs=("y",), static=True, drift={"T": 320.0})
    for seed, terms in ((0, []), (1, sensors)):
        y = clean + 0.02 * np.random.default_rng(seed).standard_normal(72)
        d = tc.diagnose(base, tc.Recording(x={"T": TEMPERATURE, "rate": RATE}, y=y), terms, progress=False)
        assert d.verdict == "unexplained"
        assert "growing" not in str(d)
        first, *others = d.where
        assert (first.target, first.driver, first.spans, first.together) == ("y", "T and rate", (), ("T", "rate"))
        assert first.share > 0.9
        assert all(row.share < 0.8 and not row.together for row in others)
        assert "varies with T and rate together: a smooth" in " ".join(str(d).split())
        alone = next(row for row in others if row.target == "y")
        assert f"and one along {alone.driver} alone {100 * alone.share:.0f} %" in " ".join(str(d).split())


@pytest.mark.parametrize("change", [
    lambda T, rate: 0.1 * np.log(rate) ** 2, lambda T, rate: (T - 320) ** 2 / 4000,
    lambda T, rate: (T - 320) ** 2 / 8000 + 0.03 * np.log(rate) ** 2,  # each by itself
])  # fmt: skip
def test_what_one_of_two_conditions_does_is_not_told_of_both(change):
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["T"] + p["c"] * x["rate"].log(), [
        tc.Parameter(name) for name in "abc"
    ])  # fmt: skip
    y = 0.1 + change(TEMPERATURE, RATE) + 0.02 * np.random.default_rng(0).standard_normal(72)
    d = tc.diagnose(base, tc.Recording(x={"T": TEMPERATURE, "rate": RATE}, y=y), [], progress=False)
    assert d.verdict == "unexplained"
    assert not any(row.together for row in d.where)


@pytest.mark.parametrize(("noise", "seen"), [(0.02, 8), (None, 6)])
def test_what_depends_on_two_conditions_together_is_seen_where_it_is_no_larger_than_noise(noise, seen):
    """Their product, at kappa = 1 where the sd is given and 1.5 where not: there is nothing along either alone."""
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["T"] + p["c"] * x["rate"].log(), [
        tc.Parameter(name) for name in "abc"
    ])  # fmt: skip
    clean = 0.5 + 0.02 * (TEMPERATURE - 320) + 0.1 * np.log(RATE)
    change = np.sin((TEMPERATURE - 320) / 30) * np.sin(np.log(RATE))
    size = 0.02 * (1.0 if noise else 1.5) / np.sqrt(np.mean(change**2))
    verdicts = {0.0: [], size: []}
    for (factor, found), seed in itertools.product(verdicts.items(), range(8)):
        y = clean + factor * change + 0.02 * np.random.default_rng(seed).standard_normal(72)
        recording = tc.Recording(x={"T": TEMPERATURE, "rate": RATE}, y=y, noise=noise)
        found.append(tc.diagnose(base, recording, [], progress=False).verdict)
    assert verdicts[size].count("unexplained") >= seen
    assert verdicts[0.0].count("consistent") == 8


def test_two_conditions_are_looked_at_together_among_few_data_and_at_two_levels_and_not_where_one_is_constant():
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["u"] + p["c"] * x["v"], [tc.Parameter(one) for one in "abc"])
    rng = np.random.default_rng(0)
    u, v, two, e = rng.uniform(0, 1, 40), rng.uniform(0, 1, 40), rng.integers(0, 2, 40), rng.standard_normal(40)
    y = 1 + u - v + 0.05 * e
    for x, change, told in (
        ({"u": u, "v": v}, 0.5 * np.sin(5 * u) * np.sin(5 * v), ("u", "v")),
        ({"u": u, "v": v, "k": two}, 0.3 * (two - 0.5) * np.sin(6 * u), ("u", "k")),
        ({"u": u, "v": v, "k": np.ones(40)}, 0.0, ()),
    ):
        d = tc.diagnose(base, tc.Recording(x=x, y=y + change, noise=0.05), [], progress=False)
        assert d.verdict == ("unexplained" if told else "consistent")
        assert (d.where[0].together if told else ()) == told


def test_a_change_along_two_conditions_is_told_of_these_and_not_of_what_is_read(tmp_path):
    """The output and one of them say as much as the two: but those are what an experiment sets."""
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["T"] + p["c"] * x["rate"].log(), [
        tc.Parameter(name) for name in "abc"
    ])  # fmt: skip
    y = 0.05 * (TEMPERATURE - 320) + 0.3 * np.log(RATE) + 0.2 * np.sin((TEMPERATURE - 320) / 12 + np.log(RATE))
    y = y + 0.02 * np.random.default_rng(0).standard_normal(72)
    d = tc.diagnose(base, tc.Recording(x={"T": TEMPERATURE, "rate": RATE}, y=y), [], progress=False)
    assert (d.where[0].driver, d.where[0].together) == ("T and rate", ("T", "rate"))
    assert "The missing change" not in str(d) or f"against {d.missing.driver} alone spans" in " ".join(str(d).split())
    d.report(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "both together" in page
    assert "Mismatch along T and rate together" in page


def test_noise_that_grows_along_the_sweeps_of_a_grid_is_told():
    base = tc.Simulator(lambda x, p: p["a"] * x["rate"] ** p["n"], [tc.Parameter("a"), tc.Parameter("n", initial=0.5)])
    found = []
    for seed in range(4):
        y = 2.0 * RATE**0.6 * (1 + 0.05 * np.random.default_rng(seed).standard_normal(72))
        d = tc.diagnose(base, tc.Recording(x={"T": TEMPERATURE, "rate": RATE}, y=y), [], progress=False)
        found.append((d.verdict, "growing" in str(d)))
    assert found == [("consistent", True)] * 4
