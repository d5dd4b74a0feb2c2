"""Oscillations that smooth functions do not follow, and terms whose tangents are the base's: neither goes unseen."""

import itertools
import math

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.fits.local import Span
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.screen import _cuts
from torchcal.discovery.misfit.channels import Channel
from torchcal.discovery.misfit.lines import Lines

F64 = torch.float64


def decay() -> tc.ODESimulator:
    return tc.ODESimulator(
        lambda t, s, p, u: {"x": -p["k"] * s["x"]}, {"x": "K"}, [tc.Parameter("k", low=0.0, initial=0.2)]
    )


def source() -> tc.Term:
    return tc.Term("source", equation="x", rate=lambda t, s, p, u: p["b"], parameters=[tc.Parameter("b")])


def rippled(samples: float, kappa: float, *, seed: int = 0, n: int = 240, uneven: bool = False) -> tuple:
    g = torch.Generator().manual_seed(seed)
    t = torch.linspace(0, 10, n, dtype=F64)
    if uneven:
        t = t + 0.3 * (t[1] - t[0]) * torch.rand(n, generator=g, dtype=F64)
    wave = torch.sin(2 * math.pi * t / (t[1] - t[0] if not uneven else 10 / (n - 1)) / samples)
    y = 5 * torch.exp(-0.2 * t) + 0.02 * (kappa * math.sqrt(2) * wave + torch.randn(n, generator=g, dtype=F64))
    return t, y


def diagnosed(t: torch.Tensor, y: torch.Tensor, noise: float | None):
    run = tc.Run(time=t, outputs={"x": y})
    return tc.diagnose(decay(), tc.Recording(runs=[run], noise=noise), [source()], progress=False)


@pytest.mark.parametrize(
    ("samples", "noise", "uneven"),
    [
        (4, 0.02, False),
        pytest.param(4, None, True, marks=pytest.mark.slow),
        pytest.param(8, None, False, marks=pytest.mark.slow),
        pytest.param(11, 0.02, True, marks=pytest.mark.slow),
        (11, None, False),
    ],
)
def test_a_ripple_is_no_noise_however_fast(samples, noise, uneven):
    d = diagnosed(*rippled(samples, 2.0, uneven=uneven), noise)
    assert d.verdict == "unexplained"
    assert d.p_detect < 0.01
    period = samples * 10 / 239
    assert d.where[0].kind == "output"
    assert d.where[0].period == pytest.approx(period, rel=0.02)
    assert f"oscillates with t (period {d.where[0].period:.3g})" in str(d).replace("\n", " ")
    assert d.missing is not None
    assert d.missing.kind == "output"
    crossings = int((d.missing.rate[1:] * d.missing.rate[:-1] < 0).sum())
    assert crossings == pytest.approx(2 * 10 / period, rel=0.05)
    if noise is None:  # the ripple is not taken for noise
        assert d.noise.sd["x"] < 0.03  # of 0.02, and 0.045 with the ripple


@pytest.mark.parametrize("uneven", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_white_noise_has_no_line(uneven):
    assert [diagnosed(*rippled(8, 0.0, seed=s, uneven=uneven), None).verdict for s in range(2)] == ["consistent"] * 2


def test_a_ripple_of_another_phase_in_every_run_is_seen():
    """Functions that all runs share follow none of them, however slow."""
    g = torch.Generator().manual_seed(0)
    t = torch.linspace(0, 10, 60, dtype=F64)
    runs = []
    for r in range(5):
        wave = 0.2 * torch.sin(2 * math.pi * (t / 1.2 + 0.37 * r))
        y = 5 * torch.exp(-0.2 * t) + wave + 0.05 * torch.randn(60, generator=g, dtype=F64)
        runs.append(tc.Run(time=t, outputs={"x": y}, initial={"x": 5.0}))
    d = tc.diagnose(decay(), tc.Recording(runs=runs), [source()], progress=False)
    assert d.verdict == "unexplained"
    assert d.where[0].period == pytest.approx(1.2, rel=0.05)
    assert d.noise.sd["x"] < 0.07


def test_a_hum_with_harmonics_is_not_taken_for_noise():
    g = torch.Generator().manual_seed(2)
    t = torch.linspace(0, 10, 240, dtype=F64)
    hum = sum(torch.sin(2 * math.pi * k * t / 0.4 + k) for k in (1, 2, 3))
    y = 5 * torch.exp(-0.2 * t) + 0.1 * hum + 0.02 * torch.randn(240, generator=g, dtype=F64)
    d = diagnosed(t, y, None)
    assert d.verdict == "unexplained"
    assert 0.015 < d.noise.sd["x"] < 0.025


@pytest.mark.parametrize("noise", [0.1 / math.sqrt(12), None])
def test_rounding_makes_lines_that_are_none(noise):
    x = torch.linspace(0, 1, 400, dtype=F64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, parameters=[tc.Parameter("a"), tc.Parameter("b")])
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["c"] * x**2}, parameters=[tc.Parameter("c")])
    y = (12.3 * x / 0.1).round() * 0.1
    assert tc.diagnose(line, tc.Recording(x=x, y=y, noise=noise), [bend], progress=False).verdict == "consistent"


def test_windows_end_between_values_and_not_inside_ties():
    levels = torch.tensor([1.0] * 8 + [2.0] * 8 + [3.0] * 8, dtype=F64)
    assert _cuts(levels, Span.of(levels, time=False)) == [0, 8, 16, 24]
    rests = torch.cat([torch.linspace(0, 1, 20, dtype=F64), 1 + 1e-6 * torch.arange(200, dtype=F64)])
    cuts = _cuts(rests, Span.of(rests, time=False))
    assert sum(cut < 20 for cut in cuts) >= 6  # half of them where it moves


def test_fringes_along_the_only_condition_are_seen():
    g = torch.Generator().manual_seed(1)
    x = torch.linspace(0.4, 0.8, 200, dtype=F64)
    y = 2.0 - x + 0.01 * (3 * torch.sin(2 * math.pi * x / 0.013) + torch.randn(200, generator=g, dtype=F64))
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, parameters=[tc.Parameter("a"), tc.Parameter("b")])
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["c"] * x**2}, parameters=[tc.Parameter("c")])
    d = tc.diagnose(line, tc.Recording(x=x, y=y), [bend], progress=False)
    assert d.verdict == "unexplained"
    assert d.where[0].period == pytest.approx(0.013, rel=0.02)


def chromatogram() -> tuple[tc.Simulator, torch.Tensor, tc.Term]:
    """A decay, and spreading: at neutral its tangent is that of the rate, but not further on."""
    base = tc.Simulator(
        lambda x, p: {"y": p["A"] * torch.exp(-p["k"] * x["d"])},
        parameters=[tc.Parameter("A", low=0.0), tc.Parameter("k", low=0.0)],
    )
    spreading = tc.Term(
        "spreading",
        outputs={"y": lambda x, p, y: y / (1 + p["s"] * x["d"])},
        parameters=[tc.Parameter("s", low=0.0)],
    )
    return base, torch.linspace(0.2, 6, 120, dtype=F64), spreading


def test_a_term_whose_tangent_is_the_base_s_is_refitted_where_its_larger_effects_are_not():
    base, x, spreading = chromatogram()
    noise = 0.3 * torch.randn(120, generator=torch.Generator().manual_seed(0), dtype=F64)
    y = 80 * torch.exp(-0.2 * x) / (1 + 0.8 * x) + noise
    d = tc.diagnose(base, tc.Recording(x={"d": x}, y={"y": y}, noise=0.3), [spreading], progress=False)
    assert d.verdict == "named"
    assert d.terms == ["spreading"]
    s = next(e for row in d.ranking for e in row.estimates if e.name == "spreading.s")
    assert abs(s.value - 0.8) < 4 * s.sd < 0.2


def test_it_is_refitted_beside_a_parameter_that_rests_on_its_bound():
    base, x, spreading = chromatogram()
    wavy = tc.Simulator(
        lambda x, p: {"y": base.function(x, p)["y"] - p["c"] * torch.cos(20 * x["d"])},
        parameters=[*base.parameters, tc.Parameter("c", low=0.0)],
    )
    noise = 0.3 * torch.randn(120, generator=torch.Generator().manual_seed(0), dtype=F64)
    y = 80 * torch.exp(-0.2 * x) / (1 + 0.8 * x) + 0.3 * torch.cos(20 * x) + noise
    d = tc.diagnose(wavy, tc.Recording(x={"d": x}, y={"y": y}, noise=0.36), [spreading], progress=False)
    assert d.base.estimates[2].at_bound
    row = next(row for row in d.ranking if row.terms == ("spreading",))
    assert row.refitted
    assert row.misfit_removed > 0.9


def test_a_term_that_is_the_base_s_own_at_any_size_is_not():
    base, x, _ = chromatogram()
    faster = tc.Term("faster", shifts={"k": lambda x, p: p["k"] * p["q"]}, parameters=[tc.Parameter("q")])
    noise = 0.3 * torch.randn(120, generator=torch.Generator().manual_seed(0), dtype=F64)
    y = 80 * torch.exp(-0.2 * x) / (1 + 0.8 * x) + noise
    d = tc.diagnose(base, tc.Recording(x={"d": x}, y={"y": y}, noise=0.3), [faster], progress=False)
    assert d.verdict == "unexplained"
    assert d.detection_limit[0].note == "already in the base model"


def bursts(m: int = 10) -> torch.Tensor:
    starts = torch.tensor([0.0, 7.0, 15.0, 22.0, 29.5], dtype=F64)
    return (starts[:, None] + torch.linspace(0, 0.5, m, dtype=F64)).flatten()


@pytest.mark.parametrize("size", [0.5, 8.0])
def test_the_evidence_of_a_wave_is_that_of_the_linear_model(size):
    """Two amplitudes with a normal prior: the marginal likelihood of the whitened residual, at any sampling."""
    t = bursts()
    y = torch.randn(len(t), generator=torch.Generator().manual_seed(0), dtype=F64)
    model = tc.Simulator(lambda x, p: p["a"] + 0 * x, [tc.Parameter("a")])
    problem = Problem.of(model, tc.Recording(x=t, y=y, noise=1.0))
    channel = Channel("output", "y", None, {"x": t}, t, torch.ones(len(t), dtype=F64))
    lines = Lines.of(problem, channel, 4)
    assert lines is not None
    assert len(lines.frequencies) > 50
    found = lines._log(size, lines._seen(y[:, None]))[:, 0]
    prior = 2 * size**2 / len(t)
    for frequency, log in zip(lines.frequencies[::7].tolist(), found[::7].tolist(), strict=True):
        angle = 2 * math.pi * frequency * t
        waves = torch.stack([angle.cos(), angle.sin()], dim=-1)
        cov = torch.eye(len(t), dtype=F64) + prior * waves @ waves.T
        expected = 0.5 * float(y @ y - y @ torch.linalg.solve(cov, y) - torch.logdet(cov))
        assert log == pytest.approx(expected, abs=1e-8)
    profile, removed, _ = lines.wave(y, y, found.argmax(), torch.tensor([size]))
    assert removed == pytest.approx(float(y.square().sum() - (y - profile).square().sum()), rel=1e-8)


@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), 6])
def test_no_wave_stands_in_for_a_term_where_samples_come_in_bursts(seed):
    g = torch.Generator().manual_seed(seed)
    t = bursts()
    inflow = 1 + torch.sin(t / 2 + 1e-9).sign()
    fine = torch.linspace(0, 30, 30001, dtype=F64)
    given = torch.as_tensor(np.interp(fine, t, inflow)).tolist()
    y, h = [4.0], 0.001
    for u, u_next in itertools.pairwise(given):  # midpoint rule
        half = y[-1] + h / 2 * (u - 0.2 * y[-1] - 0.01 * y[-1] ** 2)
        y.append(y[-1] + h * ((u + u_next) / 2 - 0.2 * half - 0.01 * half**2))
    y = torch.as_tensor(np.interp(t, fine, y)) + 0.05 * torch.randn(len(t), generator=g, dtype=F64)
    basin = tc.ODESimulator(
        lambda t, s, p, u: {"x": u["L"] - p["k"] * s["x"]}, {"x": "m"}, [tc.Parameter("k", low=0.0, initial=0.3)]
    )
    second = tc.Term(
        "second order",
        equation="x",
        rate=lambda t, s, p, u: -p["q"] * s["x"] ** 2,
        parameters=[tc.Parameter("q", low=0.0)],
    )
    run = tc.Run(time=t, outputs={"x": y}, inputs={"L": inflow}, initial={"x": 4.0})
    d = tc.diagnose(basin, tc.Recording(runs=[run], noise=0.05), [second], seed=0, progress=False)
    assert d.terms == ["second order"]


def tide(seed: int, size: float, *, clock: str = "up") -> tuple:
    """Levels that follow the wind, which has a memory, every hour, and a wave of 2.7 h."""
    g = torch.Generator().manual_seed(seed)
    t, wind = torch.arange(200, dtype=F64), torch.zeros(200, dtype=F64)
    push, noise = torch.randn(2, 200, generator=g, dtype=F64)
    for i in range(1, 200):
        wind[i] = 0.95 * wind[i - 1] + 0.3 * push[i]
    y = 1 + 0.5 * wind + 0.1 * (size * torch.sin(2 * math.pi * t / 2.7) + noise)
    order = {"up": slice(None), "down": torch.arange(199, -1, -1), "none": torch.randperm(200, generator=g)}[clock]
    x = {"t": t[order], "wind": wind[order]}
    base = tc.Simulator(lambda x, p: p["a"] + p["c"] * x["wind"], [tc.Parameter("a"), tc.Parameter("c")])
    trend = tc.Term("trend", outputs={"y": lambda x, p, y: y + p["r"] * x["t"]}, parameters=[tc.Parameter("r")])
    return base, x, y[order], [trend]


@pytest.mark.parametrize(
    ("noise", "clock"), [pytest.param(None, "up", marks=pytest.mark.slow), (0.1, "up"), (None, "down")]
)
def test_an_oscillation_along_a_clock_is_seen_beside_another_condition(noise, clock):
    base, x, y, terms = tide(0, 2.0, clock=clock)
    d = tc.diagnose(base, tc.Recording(x=x, y=y, noise=noise), terms, progress=False)
    assert d.verdict == "unexplained"
    assert d.where[0].driver == "t"
    assert "oscillates with t (period 2.7)" in " ".join(str(d).split())


def test_noise_along_a_clock_is_no_oscillation():
    for seed in range(3):
        base, x, y, terms = tide(seed, 0.0)
        assert tc.diagnose(base, tc.Recording(x=x, y=y), terms, progress=False).verdict == "consistent"


def test_a_clock_is_what_every_row_follows_the_one_before_in():
    base, x, y, _ = tide(0, 0.0)
    assert Problem.of(base, tc.Recording(x=x, y=y)).clock[0] == "t"
    assert Problem.of(base, tc.Recording(x=x, y=y)).order is None  # the wind does what it likes
    base, x, y, _ = tide(0, 0.0, clock="none")
    assert Problem.of(base, tc.Recording(x=x, y=y)).clock is None
    both = {"t": x["t"].sort().values, "u": x["t"].sort().values ** 2}
    assert Problem.of(base, tc.Recording(x=both, y=y)).clock is None  # there are two, and nobody says which


@pytest.mark.parametrize("frequency", [3.13, 3.17, 3.21])
def test_many_waves_tell_their_period_better_than_a_grid(frequency):
    """38 waves: half a step of the grid is 0.7 % of the frequency, and leaves an eighth of the wave."""
    t = torch.linspace(0, 12, 240, dtype=F64)
    y = torch.sin(2 * math.pi * frequency * t + 1) + 0.1 * torch.randn(
        240, generator=torch.Generator().manual_seed(0), dtype=F64
    )
    model = tc.Simulator(lambda x, p: p["a"] + 0 * x, [tc.Parameter("a")])
    problem = Problem.of(model, tc.Recording(x=t, y=y, noise=0.1))
    lines = Lines.of(problem, Channel("output", "y", None, {"x": t}, t, torch.ones(240, dtype=F64)), 4)
    number = lines.evidence(10 * y[:, None], torch.tensor([100.0], dtype=F64))[1]
    profile, _, found = lines.wave(y, 10 * y, number, torch.tensor([100.0], dtype=F64))
    assert found == pytest.approx(frequency, abs=0.003)
    assert float((y - profile).square().mean()) < 0.013
