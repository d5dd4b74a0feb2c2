"""Steps and bumps, which slow noise may take as well as physics."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from scipy.linalg import toeplitz

import torchcal as tc
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.discovery.misfit.channels import channels
from torchcal.discovery.misfit.likeliest import Tangents, settled, with_unknown
from torchcal.discovery.misfit.lines import Lines
from torchcal.discovery.misfit.places import SIZES
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.misfit.steps import LEAST, MOST, SURER, in_one_run, stepwise, sudden_changes
from torchcal.discovery.misfit.structure import analyse, evidences
from torchcal.errors import ConvergenceWarning
from torchcal.plots.discovery.overview import figure_parts
from torchcal.report.diagnosis_page import page

X = np.linspace(0, 10, 60)


def line(x, p):
    return p["a"] + p["b"] * x


def parameters():
    return [tc.Parameter("a", initial=0.5), tc.Parameter("b", initial=0.5)]


def calibrated(y, x=X, **options):
    """A straight line fitted to data, and the noise."""
    simulator = tc.Simulator(line, parameters())
    recording = tc.Recording(x=torch.as_tensor(x), y=torch.as_tensor(y), **options)
    return calibrate_base(Problem.of(simulator, recording), {}, 2, 0)


def stepped(seed, size=1.0, at=6.0, sd=0.1, x=X):
    return 1 + 0.3 * x + size * (x > at) + sd * np.random.default_rng(seed).standard_normal(len(x))


def only(found):
    (sudden,) = sudden_changes(found.problem, channels(found.problem, found))
    return sudden


def test_the_evidence_of_a_sudden_change_is_the_ratio_of_two_normal_densities():
    found, noise = calibrated(stepped(0, size=0.3), noise=0.1)
    sudden, residual = only(found), Residual(found, noise, draws=0)
    evidence, _, step = sudden.evidence(residual)
    # Within what the line does not make up for, of white noise: the residual with and without one of a normal size.
    rho = float(noise.correlation[0])
    white = np.linalg.inv(np.linalg.cholesky(0.01 * toeplitz(rho ** np.arange(60))))
    q = np.linalg.qr(white @ np.stack([np.ones(60), X], axis=1), mode="complete")[0][:, 2:]
    e, each = q.T @ white @ found.residual.numpy(), []
    kinds = functions_of(sudden)
    for function, count in ((one, kind.shape[1]) for kind in kinds for one in kind.T.numpy()):
        h = q.T @ white @ function
        h = h / np.linalg.norm(h)
        for size in SIZES.tolist():
            larger = np.eye(58) + size**2 * np.outer(h, h)
            log = -0.5 * np.linalg.slogdet(larger)[1] - 0.5 * e @ np.linalg.solve(larger, e) + 0.5 * e @ e
            each.append(log - math.log(len(kinds) * count * len(SIZES)))
    assert evidence == pytest.approx(np.logaddexp.reduce(each), abs=1e-6)
    assert int((step != 0).sum()) == 24
    assert float(step.max()) == pytest.approx(0.3, abs=0.1)


def test_what_was_taken_out_counts_for_itself_and_for_no_other():
    """The best of all others may be what comes next, and would count twice."""
    found, noise = calibrated(stepped(0, size=0.3), noise=0.1)
    sudden, residual = only(found), Residual(found, noise, draws=0)
    evidence, number, _ = sudden.evidence(residual)
    each = [sudden.evidence_of(residual, k) for k in range(sum(kind.shape[1] for kind in functions_of(sudden)))]
    assert np.logaddexp.reduce(each) == pytest.approx(evidence, abs=1e-9)
    assert int(np.argmax(each)) == number
    lines = Lines.of(found.problem, next(c for c in channels(found.problem, found) if c.kind == "output"), 12)
    every, number = lines.evidence(residual.e[:, None], SIZES)
    each = [lines.evidence_of(residual, torch.tensor(k), SIZES) for k in range(len(lines.frequencies))]
    assert np.logaddexp.reduce(each) == pytest.approx(float(every[0]), abs=0.05)  # between those of the grid, too
    # Each is the mean over the frequencies around it, and the sizes, of the marginal likelihood against none.
    ((places, _),) = lines.parts
    for k in range(0, len(each), 5):
        odds = []
        for frequency, size in itertools.product(lines._around(torch.tensor(k)).tolist(), SIZES.tolist()):
            angle = 2 * np.pi * frequency * lines.along[places]
            wave = torch.stack([angle.cos(), angle.sin()], dim=-1)
            cov = torch.eye(len(places), dtype=torch.float64) + 2 * size**2 / len(places) * wave @ wave.T
            e = residual.e[places]
            odds.append(0.5 * float(e @ e - e @ torch.linalg.solve(cov, e) - torch.logdet(cov)))
        expected = np.logaddexp.reduce(odds) - np.log(len(odds) * len(each))
        assert each[k] == pytest.approx(expected, abs=1e-9)
    # Two that are alike cannot both have been there.
    wave = calibrated(1 + 0.3 * X + 0.3 * np.sin(9 * X) + 0.1 * np.random.default_rng(0).standard_normal(60), noise=0.1)
    _, rough = evidences(Residual(*wave, draws=0), (), channels(wave[0].problem, wave[0]), ())
    assert rough.evidence(Residual(*wave, draws=0)) > 10
    left = dataclasses.replace(wave[0], y=wave[0].y + rough.curve)
    assert rough.evidence(Residual(left, wave[1], draws=0)) < 0


def test_what_acted_for_a_while_is_no_noise_with_a_memory():
    """Seven readings of seventy that are off by eight noise sd: neither one step nor a bump with soft ends is that, and
    correlated noise would come nearer."""
    x = np.linspace(0, 10, 70)
    off = 0.8 * ((x > 4) & (x < 5))
    found, noise = calibrated(stepped(3, size=0.0, x=x) + off, x)
    tangents = Tangents.of(found, noise)
    fresh, evidence = with_unknown(found, None, tangents, noise.unit)
    assert evidence > settled(found, noise, tangents)[1] + 10
    assert float(fresh.correlation[0]) == 0
    assert float(fresh.sd.median()) == pytest.approx(0.1, rel=0.3)


def test_noise_alone_has_no_more_evidence_than_it_should():
    """A ratio of likelihoods has the mean 1 under noise, so that at most a share 1/c of it is larger than c."""
    found, noise = calibrated(stepped(1, size=0.0), noise=0.1)
    sudden, residual = only(found), Residual(found, noise, draws=2000)
    ratio = []
    for e in residual.null.T:
        residual.e = e
        ratio.append(math.exp(sudden.evidence(residual)[0]))
    for c in (2.0, 5.0, 20.0):
        assert np.mean(np.array(ratio) > c) < 1 / c + 4 * math.sqrt(1 / c / 2000)
    assert np.median(ratio) > 0.05


def functions_of(sudden):
    """Steps, bumps and changes between two steps."""
    first, last = sudden.between
    steps, bumps = sudden.functions.split([sudden.steps, sudden.functions.shape[1] - sudden.steps], dim=1)
    return steps, bumps, steps[:, first] - steps[:, last]


def counts(sudden):
    return sudden.steps, sudden.functions.shape[1] - sudden.steps


def test_sudden_changes_are_of_one_output_in_one_run_between_different_conditions():
    found, _ = calibrated(stepped(2), noise=0.1)
    sudden = only(found)
    assert counts(sudden) == (51, 72)
    for functions in functions_of(sudden):
        assert int((functions != 0).sum(0).min()) >= LEAST
    assert sudden.between.shape[1] == (51 - LEAST) * (51 - LEAST + 1) / 2  # all pairs that are five data apart at least
    _, bumps, _ = functions_of(sudden)
    widths = sorted({round(float(w), 2) for w in bumps.sum(0) / math.sqrt(2 * math.pi) * X[1]}, reverse=True)
    assert widths[0] == pytest.approx(8 * 1.5 * X[1] / 2, rel=0.05)  # of whole bumps: 1.5, 3 and 6 gaps
    x = X.copy()
    x[20:24] = x[20]  # replicates are on one side
    found, _ = calibrated(stepped(2, x=x), x, noise=0.1)
    assert counts(only(found))[0] == 51 - 3
    long = np.linspace(0, 10, 1000)
    found, _ = calibrated(stepped(2, x=long), long, noise=0.1)
    assert counts(only(found))[0] == MOST
    assert counts(only(found))[1] < 1.5 * MOST
    few, _ = calibrated(stepped(2)[:9], X[:9], noise=0.1)
    assert sudden_changes(few.problem, channels(few.problem, few)) == []
    two = tc.ODESimulator(
        rates=lambda t, s, p, u: {"T": -p["k"] * s["T"], "S": -p["k"] * s["S"]},
        states={"T": "K", "S": "K"}, parameters=[tc.Parameter("k", low=0, initial=0.3)],
    )  # fmt: skip
    t = torch.linspace(0, 8, 20, dtype=torch.float64)
    runs = [tc.Run(time=t, outputs={"T": size * torch.exp(-0.3 * t), "S": torch.exp(-0.3 * t)},
                   initial={"T": size, "S": 1.0}) for size in (5.0, 3.0)]  # fmt: skip
    found, _ = calibrate_base(Problem.of(two, tc.Recording(runs=runs, noise=0.1)), {}, 2, 0)
    each = sudden_changes(found.problem, channels(found.problem, found))
    assert [counts(one)[0] for one in each] == [22, 22]
    for k, sudden in enumerate(each):
        output, run = found.problem.output_of, found.problem.recording.x["run"][found.problem.condition_of]
        for column in torch.cat(functions_of(sudden), dim=1).T:
            assert set(output[column != 0].tolist()) == {k}
            assert len(run[column != 0].unique()) == 1
    many, _ = calibrated(stepped(2), np.repeat([1.0, 2.0], 30), noise=0.1)
    assert counts(only(many)) == (1, 0)  # between the two
    same, _ = calibrated(stepped(2), np.repeat([1.0], 60), noise=0.1)
    assert sudden_changes(same.problem, channels(same.problem, same)) == []
    x = {"x": torch.as_tensor(X), "z": torch.as_tensor(np.random.default_rng(0).uniform(0, 1, 60))}
    simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["x"] + 0 * x["z"], parameters())
    several = Problem.of(simulator, tc.Recording(x=x, y=torch.as_tensor(stepped(3)), noise=0.1))
    found, _ = calibrate_base(several, {}, 2, 0)
    assert counts(only(found))[0] == 2 * 51  # along either condition


def gridded(sd, seed, *, in_one=0.0, everywhere=0.0):
    """31 fields at each of three temperatures, with a bump at 1.6 in one of the sweeps, or in all."""
    T, B = (g.ravel() for g in np.meshgrid([60.0, 150.0, 250.0], np.linspace(-4, 4, 31), indexing="ij"))
    bump = np.exp(-(((B - 1.6) / 0.35) ** 2))
    y = 0.8 * B + (in_one * (T < 100) + everywhere) * bump + sd * np.random.default_rng(seed).standard_normal(93)
    simulator = tc.Simulator(lambda x, p: p["S"] * x["B"], [tc.Parameter("S", low=-5.0, high=5.0)])
    x = {"T": torch.as_tensor(T), "B": torch.as_tensor(B)}
    return simulator, tc.Recording(x=x, y=torch.as_tensor(y))


def test_in_a_grid_sudden_changes_are_sought_in_every_row():
    simulator, recording = gridded(0.05, 0)
    found, _ = calibrate_base(Problem.of(simulator, recording), {}, 2, 0)
    sudden = only(found)
    assert counts(sudden)[0] == 28 + 3 * (31 + 1 - 2 * LEAST)  # along B everywhere, and at each T; three T are too few
    rows = {tuple(found.problem.recording.columns[column != 0, 0].unique().tolist())
            for column in functions_of(sudden)[0].T}  # fmt: skip
    assert rows == {(60.0, 150.0, 250.0), (60.0,), (150.0,), (250.0,)}


def test_in_a_large_grid_bumps_are_sought_all_the_same():
    for count, rows in ((20, 2 + 40), (40, 2)):  # of many rows none is looked at by itself
        a, b = (torch.as_tensor(g.ravel()) for g in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
        simulator = tc.Simulator(lambda x, p: p["a"] + 0 * x["a"], [tc.Parameter("a")])
        y = 1 + 0.1 * torch.as_tensor(np.random.default_rng(0).standard_normal(count**2))
        conditions = {"a": a.double(), "b": b.double()}
        found, _ = calibrate_base(Problem.of(simulator, tc.Recording(x=conditions, y=y, noise=0.1)), {}, 2, 0)
        steps, bumps = counts(only(found))
        assert steps >= rows * 3
        assert bumps >= 2 * 8


@pytest.mark.slow
@pytest.mark.parametrize("size", [{"in_one": 0.6}, {"everywhere": 0.3}, {}])
def test_what_is_off_in_a_part_of_a_grid_is_no_noise(size):
    simulator, recording = gridded(0.05, 1, **size)
    terms = [tc.Term("cubic", outputs={"y": lambda x, p, y: y + p["c"] * x["B"] ** 3}, parameters=[tc.Parameter("c")])]
    d = tc.diagnose(simulator, recording, terms, seed=0, progress=False)
    assert d.noise.sd["y"] == pytest.approx(0.05, rel=0.4)
    assert d.verdict == "consistent" if not size else d.verdict == "unexplained" or ["none of these"] in d.tied


def test_bumps_along_a_condition_that_spans_decades_are_as_wide_in_decades():
    f = np.geomspace(20, 50000, 96)
    y = 1e-4 * f + 0.1 * np.random.default_rng(0).standard_normal(96)
    found, _ = calibrated(y, f, noise=0.1)
    _, bumps, _ = functions_of(only(found))
    half = [f[(column > 0.5 * column.max()).numpy()] for column in bumps.T]
    assert max(part[-1] / part[0] for part in half) < 20
    assert min(part[-1] for part in half) < 60


@pytest.mark.parametrize("seed", range(3))
def test_a_step_in_white_noise_is_no_slow_noise(seed):
    found, noise = calibrated(stepped(seed, size=0.8))
    tangents = Tangents.of(found, noise)
    unknown, evidence = with_unknown(found, None, tangents, noise.unit)
    assert evidence > settled(found, noise, tangents)[1] + 10
    assert float(unknown.correlation[0]) <= 0.2
    assert float(unknown.sd[0]) == pytest.approx(0.1, rel=0.35)


def test_a_bump_in_white_noise_is_no_slow_noise():
    clear = []
    for seed in range(6):
        bump = 0.9 * np.exp(-0.5 * ((X - 6) / 0.3) ** 2)
        found, noise = calibrated(stepped(seed, size=0.0) + bump)
        unknown, evidence = with_unknown(found, None, Tangents.of(found, noise), noise.unit)
        clear.append(evidence > settled(found, noise, Tangents.of(found, noise))[1] + 5)
        if clear[-1]:
            assert float(unknown.correlation[0]) <= 0.5  # alone 0.65 to 0.8, of an sd of 0.2
            assert float(unknown.sd[0]) == pytest.approx(0.1, rel=0.35)
    assert sum(clear) >= 4


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_step_that_is_in_no_list_is_something_missing_where_the_noise_is_unknown(seed):
    simulator = tc.Simulator(line, parameters())
    recording = tc.Recording(x=torch.as_tensor(X), y=torch.as_tensor(stepped(seed, size=0.8)))
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["c"] * x**2}, parameters=[tc.Parameter("c")])
    d = tc.diagnose(simulator, recording, [bend], seed=0, progress=False)
    assert d.verdict == "unexplained"
    assert float(d.noise.sd["y"]) < 0.2


def place_of(y, driver="x", target="y", function=line, free=parameters, **options):
    """The smooth change of an output along a condition, and the residual it was found in."""
    recording = tc.Recording(x=torch.as_tensor(X), y=torch.as_tensor(y), **{"noise": 0.1, **options})
    found, noise = calibrate_base(Problem.of(tc.Simulator(function, free()), recording), {}, 2, 0)
    residual = Residual(found, noise)
    places = analyse(residual, every=True).places
    return residual, next(p for p in places if (p.channel.target, p.driver) == (target, driver) and p.period is None)


def test_a_change_between_two_steps_is_found_with_its_edges_and_its_size():
    inside = (X > 3) & (X < 7)
    residual, smooth = place_of(1 + 0.3 * X + 0.8 * inside + 0.1 * np.random.default_rng(0).standard_normal(60))
    found = stepwise(residual, smooth)
    assert found.evidence > smooth.evidence + SURER
    assert found.edges == pytest.approx((3.0, 7.0), abs=0.2)
    wanted = 0.8 * inside
    for k in (10, 30, 50):
        assert float(found.profile[k]) == pytest.approx(wanted[k], abs=0.1 + 2 * float(found.sd[k]))
    assert float(found.sd.max()) < 0.3
    assert found.share > 0.9


def test_one_edge_is_told_where_there_is_one():
    """All pairs of ends alike would let a second one in where nothing is seen: there are ten times as many."""
    single = []
    for seed in range(8):
        noise = 0.1 * np.random.default_rng(seed).standard_normal(60)
        residual, smooth = place_of(1 + 0.3 * X + 0.6 * (X > 5.1) + noise)
        found = stepwise(residual, smooth, surer=0.0)
        if found is smooth:
            continue
        single.append(len(found.edges) == 1)
        # Half of the points are on either side: whatever ends are averaged over, it is 0 on one of them.
        assert min(float(found.profile[:25].abs().max()), float(found.profile[36:].abs().max())) < 0.05
        assert float(found.sd[5:25].max()) < 0.12
    assert len(single) >= 5
    assert np.mean(single) > 0.8


def test_points_that_do_nothing_to_an_output_are_none_of_its_own():
    t = torch.linspace(0, 10, 40, dtype=torch.float64)
    three = tc.Simulator(
        lambda x, p: {name: p[name] + 0.3 * x["x"] for name in "abc"},
        [tc.Parameter(name, initial=0.5) for name in "abc"],
    )
    y = {name: 1 + 0.3 * t + 0.1 * torch.as_tensor(np.random.default_rng(k).standard_normal(40))
         for k, name in enumerate("abc")}  # fmt: skip
    y["a"][20:22] += 0.45  # two data alone may be outliers
    found, noise = calibrate_base(Problem.of(three, tc.Recording(x={"x": t}, y=y, noise=0.1)), {}, 2, 0)
    residual = Residual(found, noise)
    place = next(p for p in analyse(residual, every=True).places if p.channel.kind == "output"
                 and (p.channel.target, p.driver, p.period) == ("a", "x", None))  # fmt: skip
    edges = stepwise(residual, place, surer=-math.inf).edges
    low, high = edges if len(edges) > 1 else (edges[0], math.inf)
    assert int(((t > low) & (t < high)).sum()) >= LEAST


def test_what_is_smooth_stays_smooth_and_so_does_what_few_points_show():
    noise = 0.1 * np.random.default_rng(1).standard_normal(60)
    for change in (np.sin(2 * X), 0.05 * (X - 5) ** 2):
        residual, smooth = place_of(1 + 0.3 * X + change + noise)
        assert smooth.evidence > 10
        assert stepwise(residual, smooth) is smooth
    residual, smooth = place_of(1 + 0.3 * X + 1.5 * (X > 9.6) + noise)
    found = stepwise(residual, smooth, surer=-math.inf)
    low, high = found.edges if len(found.edges) > 1 else (found.edges[0], math.inf)
    assert 5 <= int(((X > low) & (X < high)).sum()) <= 55


def test_a_step_is_of_the_fewer_points_where_a_constant_tells_nothing():
    noise = 0.1 * np.random.default_rng(2).standard_normal(60)
    for at, side in ((6.0, X > 6), (2.0, X > 2)):
        residual, smooth = place_of(1 + 0.3 * X + 0.8 * side + noise)
        found = stepwise(residual, smooth)
        assert found.edges == pytest.approx((at,), abs=0.2)
        wanted = 0.8 * side if side.mean() < 0.5 else 0.8 * side - 0.8
        assert float((found.profile - torch.as_tensor(wanted)).abs().median()) < 0.15
    # Through the origin a constant tells.
    residual, smooth = place_of(
        0.3 * X + 0.8 * (X > 2) + noise, function=lambda x, p: p["b"] * x, free=lambda: [tc.Parameter("b", initial=0.5)]
    )
    found = stepwise(residual, smooth)
    assert found.edges == pytest.approx((2.0,), abs=0.2)
    assert float((found.profile - torch.as_tensor(0.8 * (X > 2))).abs().median()) < 0.15


def test_a_source_that_begins_at_some_time_is_told_with_the_time_and_its_rate():
    rng = np.random.default_rng(0)
    t = torch.linspace(0, 40, 120, dtype=torch.float64)
    k, source, begins = 0.8, 0.6, 22.0
    on = (t - begins).clamp_min(0)
    after = source / k * (1 - torch.exp(-k * on))
    truth = 20 + 30 * torch.exp(-k * t) + after
    body = tc.ODESimulator(
        rates=lambda t, s, p, u: {"T": -p["k"] * (s["T"] - 20)}, states={"T": "degC"},
        parameters=[tc.Parameter("k", unit="1/s", low=0.0, initial=0.2)],
    )  # fmt: skip
    data = truth + 0.3 * torch.as_tensor(rng.standard_normal(120))
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"T": data})], noise=0.3, units={"time": "s", "T": "degC"})
    d = tc.diagnose(body, recording, [], seed=0, progress=False)
    assert d.verdict == "unexplained"
    place = d.where[0]
    assert (place.kind, place.target, place.driver) == ("equation", "T", "t")
    assert place.edges == pytest.approx((begins,), abs=1.0)
    text = str(d).replace("\n", " ")
    assert "jumps with t (at 2" in text
    assert "one constant change on one side removes" in text
    wanted = source * (d.missing.time > begins).double()
    assert float((d.missing.along - wanted).norm() / wanted.norm()) < 0.25


def cooling(off, place, seed=0):
    """Three bodies that cool, with readings that are off by something at some times of some runs."""
    simulator = tc.ODESimulator(
        rates=lambda t, s, p, u: {"T": -p["k"] * s["T"]}, states={"T": "K"},
        parameters=[tc.Parameter("k", unit="1/h", low=0.0, initial=0.3)],
    )  # fmt: skip
    t, rng = np.linspace(0, 8, 60), np.random.default_rng(seed)
    runs = [tc.Run(time=t, outputs={"T": first * np.exp(-0.3 * t) + off * place(t, r) + 0.05 * rng.standard_normal(60)},
                   initial={"T": first}) for r, first in enumerate((5.0, 10.0, 15.0))]  # fmt: skip
    return simulator, tc.Recording(runs=runs, noise=0.05, units={"time": "h", "T": "K"})


@pytest.mark.slow
def test_what_happens_in_one_run_alone_is_placed_there():
    """No function of time, of the state or of the run is that."""
    given = cooling(0.4, lambda t, r: (r == 1) & (t > 3) & (t < 5))
    d = tc.diagnose(*given, tc.terms.sensor(("T",), dynamic=False, time="h"), seed=0, progress=False)
    assert d.verdict == "unexplained"
    place = d.where[0]
    assert (place.kind, place.target, place.driver, place.run) == ("output", "T", "t", 1)
    assert place.edges == pytest.approx((3.0, 5.0), abs=0.1)
    assert place.share > 0.95
    text = " ".join(str(d).split())
    assert "sits in the output T of run 1 (counted from 0) and jumps with t (at 3.051 and 4.949 h)" in text
    assert "change of T against t in run 1 spans 0.4" in text
    assert d.missing.run == 1
    assert len(d.missing.values) == 60
    assert "run" in str(d.where).splitlines()[0].split()
    assert any("in run 1" in part.caption for part in figure_parts(d))
    assert "output T of run 1" in page(d)


def test_what_all_runs_have_is_placed_in_none_of_them():
    simulator, recording = cooling(0.4, lambda t, r: t > 3)
    found, noise = calibrate_base(Problem.of(simulator, recording), {}, 2, 0)
    residual = Residual(found, noise, draws=10)
    every = analyse(residual, every=True)
    best = max(place.evidence for place in every.places)
    alone = in_one_run(residual, every.channels)
    output = next(c for c in every.channels if c.kind == "output")
    part = output.where(output.drivers["run"] == 2)
    change = torch.randn(60, 2, dtype=torch.float64)
    assert torch.equal(part.response(change), torch.cat([torch.zeros(120, 2, dtype=torch.float64), change]))
    assert {place.run for place in alone if place.channel.kind == "output"} == {0, 1, 2}
    assert all(place.evidence < best for place in alone)


def test_a_bump_along_the_clock_of_several_conditions_is_seen_on_the_scale_that_it_was_recorded_on():
    # Times from 0.05 to 8 h span decades, and the cloud is short beside the gaps of their logarithms.
    rng = np.random.default_rng(7)
    airmass, colour, time = rng.uniform(1, 2.5, 80), rng.uniform(-0.3, 1.8, 80), np.sort(rng.uniform(0.02, 8, 80))
    base = tc.Simulator(lambda x, p: p["m"] + p["k"] * x["X"], [tc.Parameter("m"), tc.Parameter("k", low=0.0)])
    clean = 0.22 * airmass - 0.1 + 0.1 * np.exp(-(((time - 5.3) / 0.3) ** 2))
    verdicts = []
    for seed in range(3):
        y = clean + 0.01 * np.random.default_rng(seed).standard_normal(80)
        recording = tc.Recording(x={"X": airmass, "colour": colour, "ut": time}, y=y)
        d = tc.diagnose(base, recording, [], progress=False)
        places = [row for row in d.where if row.driver == "ut"]
        verdicts.append((d.verdict, any(low < 5.3 < high for row in places for low, high in row.spans)))
    assert verdicts == [("unexplained", True)] * 3


def test_two_levels_that_are_decades_apart_have_no_scale_of_their_own():
    # Their one gap has no spread.
    base = tc.Simulator(lambda x, p: p["k"] * x["a"], [tc.Parameter("k")])
    x = {"a": torch.tensor([1.0, 100.0]).repeat_interleave(30)}
    y = 1.0 + 0.1 * torch.randn(60, generator=torch.Generator().manual_seed(0))
    with pytest.warns(ConvergenceWarning, match="no more than a constant"):
        assert tc.diagnose(base, tc.Recording(x=x, y=y), [], progress=False).verdict == "unexplained"
