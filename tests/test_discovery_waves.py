"""Oscillations of rates and parameters in time: found through their response, where they act and how large."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal import plots
from torchcal.discovery.findings.where import _larger_than_all
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.channels import channels
from torchcal.discovery.misfit.places import Change, evidence_of
from torchcal.discovery.misfit.waves import MOST_RUNS, Waves, _frequencies, _waves

F64 = torch.float64


def reaction() -> tc.ODESimulator:
    return tc.ODESimulator(
        lambda t, s, p, u: {"A": -p["k1"] * s["A"], "B": p["k1"] * s["A"] - p["k2"] * s["B"]},
        {"A": "mol/l", "B": "mol/l"},
        [tc.Parameter("k1", unit="1/h", low=0.0, initial=0.5), tc.Parameter("k2", unit="1/h", low=0.0, initial=0.2)],
    )


def recorded(k1, k2, *, seed: int = 0, sd: float = 0.004, n: int = 60, runs: int = 2) -> tc.Recording:
    """Runs from different amounts, with rate constants that are functions of time."""
    g = torch.Generator().manual_seed(seed)
    made = []
    for number in range(runs):
        t = np.linspace(0, 12 - 2 * (number % 3), n)
        start = [1.0 + 0.3 * (number % 4), 0.2]
        rates = lambda t, s: [-k1(t) * s[0], k1(t) * s[0] - k2(t) * s[1]]  # noqa: E731
        y = solve_ivp(rates, (0, t[-1]), start, t_eval=t, rtol=1e-9, atol=1e-12).y
        outputs = {"A": torch.tensor(y[0]), "B": torch.tensor(y[1])}
        noisy = {name: value + sd * torch.randn(n, generator=g, dtype=F64) for name, value in outputs.items()}
        made.append(tc.Run(time=torch.tensor(t), outputs=noisy, initial={"A": start[0], "B": start[1]}))
    return tc.Recording(runs=made, noise=sd)


def calibrated(recording: tc.Recording) -> Search:
    search = Search(Problem.of(reaction(), recording), [], {}, 0, 6, 1, lambda text: None, None)
    search.calibrate_base()
    search.screen_all()
    return search


def relative(found: torch.Tensor, wanted: torch.Tensor) -> float:
    """Up to a constant, which the base's own parameter makes up for."""
    found, wanted = found - found.mean(), wanted - wanted.mean()
    return float((found - wanted).norm() / wanted.norm())


@pytest.mark.slow
def test_a_rate_constant_that_cycles_in_several_runs_is_a_wave_of_that_parameter():
    d = tc.diagnose(
        reaction(),
        recorded(lambda t: 0.5, lambda t: 0.2 * (1 + 0.4 * math.sin(2.4 * t))),
        tc.terms.kinetics("A", product="B")[:3],
        progress=False,
    )
    assert d.verdict == "unexplained"
    assert (d.where[0].kind, d.where[0].target, d.where[0].driver) == ("parameter", "k2", "t")
    assert d.where[0].period == pytest.approx(2 * math.pi / 2.4, rel=0.05)
    assert "oscillates with t" in str(d).replace("\n", " ")
    assert d.missing is not None
    assert (d.missing.kind, d.missing.target, d.missing.unit) == ("parameter", "k2", "1/h")
    assert relative(d.missing.along, 0.08 * torch.sin(2.4 * d.missing.time)) < 0.2
    ax = plots.missing_rate(d.missing)
    assert ax.get_ylabel() == "missing shift of k2 [1/h]"
    assert [line.get_label() for line in ax.lines if line.get_label().startswith("run")] == ["run 0", "run 1"]
    ends = [float(line.get_xdata()[-1]) for line in ax.lines[1:]]
    assert ends == pytest.approx([12, 10], abs=0.3)  # each as long as its run


def test_a_source_that_cycles_is_a_missing_rate_and_no_ripple_of_the_output():
    """Slow beside the samples, and seen through a lag."""
    g = torch.Generator().manual_seed(3)
    t = torch.linspace(0, 40, 160, dtype=F64)
    wanted = 0.15 * torch.sin(2 * math.pi * t / 6)
    rates = lambda t, s: [1 - 0.5 * s[0] + 0.15 * math.sin(2 * math.pi * t / 6)]  # noqa: E731
    y = solve_ivp(rates, (0, 40), [0.5], t_eval=t.numpy(), rtol=1e-9).y[0]
    room = tc.ODESimulator(
        lambda t, s, p, u: {"T": p["q"] - p["k"] * s["T"]},
        {"T": "K"},
        [tc.Parameter("q", low=0.0, initial=1.0), tc.Parameter("k", low=0.0, initial=0.3)],
    )
    run = tc.Run(time=t, outputs={"T": torch.tensor(y) + 0.05 * torch.randn(160, generator=g, dtype=F64)})
    d = tc.diagnose(room, tc.Recording(runs=[run], noise=0.05), progress=False)
    assert d.verdict == "unexplained"
    assert d.where[0].period == pytest.approx(6, rel=0.05)
    assert d.missing is not None
    assert (d.missing.kind, d.missing.target) == ("equation", "T")
    there = torch.as_tensor(np.interp(d.missing.time.numpy(), t.numpy(), wanted.numpy()))
    assert relative(d.missing.along, there) < 0.3


def test_the_evidence_of_a_wave_is_that_of_its_two_functions():
    search = calibrated(recorded(lambda t: 0.5, lambda t: 0.2 * (1 + 0.3 * math.sin(2.4 * t))))
    residual = search.residual
    both = torch.cat([residual.e[:, None], residual.null[:, :5]], dim=1)
    for channel in channels(search.base.problem, search.base):
        if channel.kind == "output":
            continue
        waves = Waves.of(channel, residual, both, _frequencies(channel))
        assert waves is not None
        features = _waves(channel, waves.frequencies)
        assert features.shape == (len(channel.time), len(waves.frequencies), 4)  # cosine and sine in two runs
        each = []
        for number in range(len(waves.frequencies)):
            columns = residual.tangent(channel.response(features[:, number]))
            change = Change.of(features[:, number], columns, 0.0, both)
            assert change is not None
            along = torch.cat([change.along[:, None], change.null], dim=1)
            each.append(evidence_of(along, change.s)[0])
        torch.testing.assert_close(waves.evidences(), torch.stack(each))


def test_noise_alone_has_no_more_evidence_than_it_should():
    """A ratio of likelihoods has the mean 1 under noise, so that at most a share 1/c of it is larger than c."""
    search = calibrated(recorded(lambda t: 0.5, lambda t: 0.2, seed=5))
    for channel in channels(search.base.problem, search.base):
        if channel.kind != "output":
            waves = Waves.of(channel, search.residual, search.residual.null, _frequencies(channel))
            assert waves is not None
            ratio = waves.evidences().exp().mean(0)
            assert 0.05 < float(ratio.median()) < 1
            for c in (3.0, 10.0, 30.0):
                assert float((ratio > c).double().mean()) < 1 / c + 4 * math.sqrt(1 / c / len(ratio))


def test_frequencies_reach_from_few_waves_to_few_points_each_and_not_over_many_runs():
    search = calibrated(recorded(lambda t: 0.5, lambda t: 0.2))
    channel = next(c for c in channels(search.base.problem, search.base) if c.kind == "equation")
    found = _frequencies(channel)
    run = channel.drivers["run"].round()
    longest = channel.time[run == 0]
    span, step = float(longest[-1] - longest[0]), float(channel.time.diff()[run.diff() == 0].median())
    assert float(found[0]) == pytest.approx(1.5 / span)
    assert 0.9 / (4 * step) < float(found[-1]) <= 1.01 / (4 * step)
    many = recorded(lambda t: 0.5, lambda t: 0.2, runs=MOST_RUNS + 1, n=8)
    search = calibrated(many)
    channel = next(c for c in channels(search.base.problem, search.base) if c.kind == "equation")
    assert len(_frequencies(channel)) == 0


def test_a_wave_larger_than_the_base_s_own_rate_is_none_of_that_rate():
    search = calibrated(recorded(lambda t: 0.5, lambda t: 0.2))
    place = next(p for p in search.structure.places if p.channel.target == "B" and p.channel.kind == "equation")
    usual = place.channel.usual
    assert 0.01 < usual < 1  # mol/l/h
    for share, larger in ((0.5, False), (1.5, True)):
        moved = dataclasses.replace(place, profile=torch.full_like(place.profile, share * usual))
        assert _larger_than_all(search, moved) is larger


@pytest.mark.parametrize(
    ("effect", "largest"),
    [
        (lambda p: 1.0 * (p > 3), (3.6, 10.0)),
        pytest.param(lambda p: 1.0 * (p < 0.3), (0.1, 0.3), marks=pytest.mark.slow),
        pytest.param(lambda p: p / 10, (4.6, 10.0), marks=pytest.mark.slow),
    ],
    ids=["above", "below", "growing"],
)
def test_what_is_missing_is_told_beside_what_the_base_makes_up_for(effect, largest):
    """The base has a constant of its own: only how the change differs from its median can be told."""
    x, p = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 12), np.geomspace(0.1, 10, 9), indexing="ij"))
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(x))
    recording = tc.Recording(
        x={"x": torch.tensor(x), "p": torch.tensor(p)}, y=torch.tensor(2 - 3 * x + effect(p) + noise), noise=0.05
    )
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["x"], [tc.Parameter("a"), tc.Parameter("b")])
    idle = tc.Term(
        "idle", outputs={"y": lambda x, p, y: y + p["c"] * (7 * x["x"]).sin()}, parameters=[tc.Parameter("c")]
    )
    d = tc.diagnose(base, recording, [idle], progress=False)
    assert d.missing is not None
    assert d.missing.driver == "p"
    values, rate = d.missing.values.numpy(), d.missing.rate.numpy()
    truth = effect(values)
    assert np.abs(rate - (truth - np.median(truth))).max() < 0.25 * np.ptp(truth)
    assert float(d.missing.sd.max()) < 0.25 * np.ptp(truth)
    low, high = d.where[0].spans[0][0], d.where[0].spans[-1][1]
    assert low == pytest.approx(largest[0], rel=0.5)
    assert high == pytest.approx(largest[1], rel=0.5)
