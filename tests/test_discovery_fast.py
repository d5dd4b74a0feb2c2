"""What is faster than the sampling: durations that a term may have, and time steps short enough for it."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal.discovery.fits import sharpen as sharpening
from torchcal.discovery.fits.candidates import prepare
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.ranges import drivers_scale
from torchcal.discovery.fits.sharpen import accurate, halved, sharpen
from torchcal.discovery.hypotheses import refitting
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.verdicts.decision import Decision
from torchcal.discovery.verdicts.verdict import _shares
from torchcal.simulators import focused
from torchcal.simulators.steps import Steps

F64 = torch.float64
END, COUNT, GAIN, LOSS = 60.0, 91, 0.5, 0.2


def heated(tau: float | None = None, *, gain: float = GAIN) -> tc.ODESimulator:
    """A body with a heater, whose heat comes late where a time is given."""
    body = [tc.Parameter("g", unit="K/s", low=0.0, initial=0.4), tc.Parameter("k", unit="1/s", low=0.0, initial=0.15)]
    if tau is None:
        return tc.ODESimulator(lambda t, s, p, u: {"T": p["g"] * u["P"] - p["k"] * s["T"]}, {"T": "K"}, body)
    late = [tc.Parameter("g2", low=0.0, initial=gain), tc.Parameter("tau", low=0.9 * tau, high=1.1 * tau)]
    return tc.ODESimulator(
        lambda t, s, p, u: {
            "T": p["g"] * u["P"] + p["g2"] * s["z"] - p["k"] * s["T"],
            "z": (u["P"] - s["z"]) / p["tau"],
        },
        {"T": "K", "z": ""}, [*body, *late], observe=("T",),
    )  # fmt: skip


def recorded(tau: float, *, sd: float = 0.02, seed: int = 0) -> tc.Recording:
    """Of such a heater, whose power is a square wave with the ramps of its samples."""
    t = np.linspace(0.0, END, COUNT)
    power = 1.0 + np.sign(np.sin(2 * np.pi * t / 9.0 + 0.1))

    def rates(now, s):
        now_power = np.interp(now, t, power)
        return [GAIN * s[1] - LOSS * s[0], (now_power - s[1]) / tau]

    y = solve_ivp(rates, (0, END), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=t[1] / 4, method="LSODA").y[0]
    noisy = torch.tensor(y) + sd * torch.randn(COUNT, generator=torch.Generator().manual_seed(seed), dtype=F64)
    run = tc.Run(time=torch.tensor(t), outputs={"T": noisy}, inputs={"P": torch.tensor(power)}, initial={"T": 0.0})
    return tc.Recording(runs=[run], noise=sd)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("share", "among"),
    [(0.25, None), (0.6, None), (0.6, ("heater lag", "heater gain error", "second heat capacity", "radiation"))],
)
def test_a_lag_shorter_than_the_gaps_between_samples_is_found_and_not_biased(share, among):
    """With the base's steps, one in a gap, its time would be off by several of its sd."""
    tau = share * END / (COUNT - 1)
    library = tc.terms.thermal(temperature="T", ambient=0.0, heater="P")
    candidates = [term for term in library if among is None or term.name in among]
    d = tc.diagnose(heated(), recorded(tau), candidates, progress=False)
    assert (d.verdict, d.terms) == ("named", ["heater lag"])
    row = next(r for r in d.ranking if r.terms == ("heater lag",))
    told = {e.name: e for e in row.estimates}["heater lag.tau"]
    assert abs(told.value - tau) < 3 * told.sd
    assert told.sd < tau
    assert not told.at_bound


def test_a_base_that_is_stiffer_than_its_samples_begins_with_steps_that_do():
    """At the user's own values its solution with one step in a gap is far off, and a gain of 0 would hide that."""
    tau = 0.3 * END / (COUNT - 1)
    base = heated(tau)
    fixed = {"g": 0.0}  # all heat comes late
    d = tc.diagnose(base, recorded(tau), [], fixed=fixed, progress=False)
    assert d.verdict == "consistent"
    found = {e.name: e.value for e in d.base.estimates}
    assert found["g2"] == pytest.approx(GAIN, rel=0.05)


def test_steps_are_chosen_anew_until_halving_them_changes_nothing():
    tau = 0.3 * END / (COUNT - 1)
    search = Search(Problem.of(heated(), recorded(tau)), [], {}, 0, 4, 1, lambda text: None, None)
    search.calibrate_base()
    base, sd = search.base, search.noise.sd[search.base.problem.index]
    assert accurate(base, sd)
    same, left = sharpen(base, lambda now: 0.05 * sd, rounds=3)
    assert same is base
    assert left == 0.0
    strict = 1e-8 * sd
    finer, left = sharpen(base, lambda now: strict, rounds=6)
    assert left == 0.0
    assert finer.problem.simulator.num_steps > base.problem.simulator.num_steps
    assert not accurate(base, 1e-9 * sd)
    _, left = sharpen(base, lambda now: 1e-13 * sd, rounds=1)
    assert left > 0  # it says by how much


@pytest.fixture
def in_short_steps():
    """A calibrated base in steps eight times as short as it needs, of two starts that came to it of three, and what it
    may err by."""
    search = Search(Problem.of(heated(), recorded(0.3 * END / (COUNT - 1))), [], {}, 0, 4, 1, lambda text: None, None)
    search.calibrate_base()
    base = search.base
    problem = base.problem.with_simulator(base.problem.simulator.refined(8))
    found = dataclasses.replace(fit(problem, base.whitening, base.values[None], base.free), agreeing=2 / 3)
    return found, 0.05 * search.noise.sd[base.problem.index]


def test_steps_that_are_much_shorter_than_a_fit_needs_become_longer(in_short_steps):
    found, allowed = in_short_steps
    lean, left = sharpen(found, lambda now: allowed, rounds=3)
    assert left == 0.0
    assert lean.problem.simulator.num_steps <= 0.6 * found.problem.simulator.num_steps
    assert ((halved(lean) - lean.y).abs() <= allowed).all()
    assert ((lean.y - found.y).abs() <= allowed).all()
    assert lean.agreeing == found.agreeing
    assert sharpen(lean, lambda now: allowed, rounds=3)[0] is lean


def test_steps_that_were_chosen_for_another_orbit_are_not_kept_for_this_one():
    """The passages of the one are where the other is far away."""
    problem = Problem.of(orbit(), passages())
    grown = problem.with_simulator(problem.simulator)
    for speed in (0.45, 0.5, 0.55):  # as a search passes by others
        values = torch.tensor([1.0, speed], dtype=F64)
        simulator = grown.simulator
        grown = grown.with_simulator(focused(simulator, values, simulator.solve(values[None]), 1e5))
    allowed = torch.full((problem.n,), 1e-4, dtype=F64)
    whitening = problem.whitening(torch.full((problem.n,), 1e-3, dtype=F64), torch.zeros(1, dtype=F64))
    found = fit(grown, whitening, torch.tensor([[1.0, 0.8]], dtype=F64), [0, 1])
    lean, left = sharpen(found, lambda now: allowed, rounds=3)
    assert left == 0.0
    assert lean.problem.simulator.num_steps <= 0.6 * found.problem.simulator.num_steps
    assert ((lean.y - problem.y).abs() <= 2 * allowed).all()


@pytest.mark.parametrize("why", ["magnified", "wrong", "as many", "lost", "elsewhere"])
def test_steps_stay_short_where_longer_ones_would_not_do(in_short_steps, why, monkeypatch):
    found, allowed = in_short_steps
    simulator = found.problem.simulator
    if why == "magnified":
        monkeypatch.setattr(sharpening, "magnified", lambda other, *given: other is not simulator)
    if why == "wrong":
        right = sharpening._in_steps_of

        def wrong(*given):
            again = right(*given)
            return dataclasses.replace(again, y=again.y + 3 * allowed)

        monkeypatch.setattr(sharpening, "_in_steps_of", wrong)
    if why == "elsewhere":  # another minimum, to which a fit falls where longer steps do not solve what it begins with
        near = sharpening._in_steps_of
        monkeypatch.setattr(
            sharpening, "_in_steps_of", lambda *given: dataclasses.replace(near(*given), chi2=1.1 * found.chi2 + 1)
        )
    if why == "as many":
        monkeypatch.setattr(sharpening, "spared", lambda *given: simulator)
    if why == "lost":
        monkeypatch.setattr(sharpening, "fit", lambda *given: None)
    assert sharpen(found, lambda now: allowed, rounds=3)[0] is found


def test_implicit_steps_that_cannot_be_repeated_are_none(monkeypatch):
    search = Search(Problem.of(heated(), recorded(0.3)), [], {}, 0, 4, 1, lambda text: None, None)
    search.calibrate_base()
    base = search.base
    monkeypatch.setattr(sharpening, "settled_implicitly", lambda simulator, *given, **more: simulator)
    assert sharpening._implicit(base, base.y.abs(), 1) is not None
    lost = dataclasses.replace(base, values=torch.full_like(base.values, math.nan))
    monkeypatch.setattr(sharpening, "fit", lambda *given: lost)  # it met a solution that no other start comes to
    assert sharpening._implicit(base, base.y.abs(), 1) is None


def orbit() -> tc.ODESimulator:
    """A planet of which one coordinate is seen."""

    def rates(t, s, p, u):
        pull = p["mu"] / (s["x"] ** 2 + s["y"] ** 2) ** 1.5
        return {"x": s["vx"], "y": s["vy"], "vx": -pull * s["x"], "vy": -pull * s["y"]}

    body = [tc.Parameter("mu", low=0.5, high=2.0, initial=1.0)]
    return tc.ODESimulator(rates, {"x": "1", "y": "1", "vx": "1", "vy": "1"}, body, observe=("x",))


def passages() -> tc.Recording:
    """Of that, with mu = 1 and a first speed of 0.8, without noise."""

    def rates(t, s):
        pull = 1 / np.hypot(s[0], s[1]) ** 3
        return [s[2], s[3], -pull * s[0], -pull * s[1]]

    t = np.linspace(0, 12, 61)
    x = solve_ivp(rates, (0, 12), [1.0, 0.0, 0.0, 0.8], t_eval=t, rtol=1e-10, atol=1e-12).y[0]
    at = {"x": 1.0, "y": 0.0, "vx": 0.0}
    run = tc.Run(time=torch.tensor(t), outputs={"x": torch.tensor(x)}, initial=at)
    return tc.Recording(runs=[run], noise=0.001)


def shares(**given: float) -> tuple[Decision, list]:
    decision, models = Decision(), []
    for names, share in given.items():
        model = SimpleNamespace(names=tuple(names.split("_")[0].split("+")))
        decision.probability[id(model)] = share
        models.append(model)
    decision.tied = [list(names) for names in dict.fromkeys(model.names for model in models)]
    return decision, models


def test_tied_hypotheses_count_wherever_they_act():
    decision, models = shares(a=0.5, b_here=0.1, b_there=0.15, c=0.2)
    assert _shares(decision, models) == pytest.approx([0.5, 0.25, 0.2])
    decision, models = shares(a_here=0.5, a_there=0.3)
    assert _shares(decision, models) == pytest.approx([0.8])
    decision.tied.append(["another name of a"])
    assert _shares(decision, models) == pytest.approx([0.8, 0.8])


@pytest.mark.slow
def test_something_unknown_that_is_likelier_than_the_second_is_tied_with_them():
    """A stiffness that follows the drive, in no list: all that is listed acts for it in some window."""
    g = torch.Generator().manual_seed(0)
    x = torch.linspace(0, 1, 60, dtype=F64)
    y = 1 + x + 0.05 * torch.sin(9 * x) * x + 0.02 * torch.randn(60, generator=g, dtype=F64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, parameters=[tc.Parameter("a"), tc.Parameter("b")])
    powers = [
        tc.Term(f"power {k}", outputs={"y": lambda x, p, y, k=k: y + p["c"] * x**k}, parameters=[tc.Parameter("c")])
        for k in (2, 3, 6)
    ]
    d = tc.diagnose(line, tc.Recording(x=x, y=y, noise=0.02), powers, progress=False)
    unknown = sum(row.probability for row in d.ranking if row.terms == ("none of these",))
    if d.verdict == "ambiguous":
        known = sorted(sum(r.probability for r in d.ranking if list(r.terms) == t) for t in d.tied if t[0][0] == "p")
        assert (["none of these"] in d.tied) is (len(known) < 2 or unknown > min(0.3, known[-2]))
        told = str(d).replace("\n", " ")
        assert "not in the library" in told
    assert d.verdict in ("ambiguous", "unexplained")


def test_an_estimate_apart_from_what_nature_has_costs_by_a_normal_density():
    g = torch.Generator().manual_seed(1)
    x = torch.linspace(0, 1, 50, dtype=F64)
    y = 1 + x + 0.4 * x**2 + 0.01 * torch.randn(50, generator=g, dtype=F64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, parameters=[tc.Parameter("a"), tc.Parameter("b")])

    def evidence(**more) -> tuple[float, float, float]:
        bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["c"] * x**2}, parameters=[tc.Parameter("c")], **more)
        d = tc.diagnose(line, tc.Recording(x=x, y=y, noise=0.01), [bend], progress=False)
        row = next(r for r in d.ranking if r.terms == ("bend",))
        return row.log_evidence, row.estimates[0].value, row.estimates[0].sd

    plain, value, sd = evidence()
    told, same, _ = evidence(expected={"c": (1.0, 0.2)})
    assert same == pytest.approx(value)  # it weighs, and does not move
    assert told - plain == pytest.approx(-0.5 * (value - 1.0) ** 2 / (0.2**2 + sd**2), rel=1e-6)


def test_a_partial_delay_is_less_likely_than_a_whole_one():
    for name in ("lag of x", "delay of x"):
        (term,) = (t for t in tc.terms.sensor(outputs=("x",)) if t.name == name)
        assert term.expected == {"a": (1.0, 0.15)}
        assert dataclasses.replace(term, description="").expected == term.expected


def test_a_candidate_begins_at_the_trajectory_of_the_base(monkeypatch: pytest.MonkeyPatch) -> None:
    """States that it adds begin as they do; nothing is solved from the beginning."""
    recording = recorded(3.0)
    problem = Problem.of(heated().bind(recording), recording)
    base, _ = calibrate_base(problem, {}, 4, 0)
    scale = drivers_scale(base.problem, base)
    terms = [one for one in tc.terms.sensor("T") if one.name in ("lag of T", "gain error of T")]
    assert len(terms) == 2
    marched = []
    monkeypatch.setattr(Steps, "_march", lambda steps, values: marched.append(len(values)) or values)
    for term in terms:
        prepare(base.problem, base, [term], {}, scale)
    assert not marched
    other = base.problem.with_simulator(base.problem.simulator.refined(2))
    assert other.guess(base.warm, base.values[None]) is None


def test_a_refit_that_goes_astray_begins_at_the_base(monkeypatch: pytest.MonkeyPatch) -> None:
    x = torch.linspace(0, 1, 20, dtype=F64)
    wobble = 0.02 * torch.randn(20, generator=torch.Generator().manual_seed(1), dtype=F64)
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"] * x**2}, parameters=[tc.Parameter("q")])
    fits = refitting.refit_all
    seen = []

    def astray(jobs, on_result, executor=None):
        seen.append([job.begin for job in jobs])

        def take(index, fitted):
            on_result(index, dataclasses.replace(fitted, chi2=1e6) if len(seen) == 1 else fitted)

        fits(jobs, take, executor)

    monkeypatch.setattr(refitting, "refit_all", astray)
    d = tc.diagnose(base, tc.Recording(x=x, y=1 + x + wobble, noise=0.02), [bend], progress=False)
    (first,), (second,) = seen[:2]
    assert float(second[0, -1]) == 0.0  # neutral
    torch.testing.assert_close(second[0, :2], torch.tensor([e.value for e in d.base.estimates], dtype=F64))
    assert len(first) >= 1
    row = next(row for row in d.ranking if row.terms == ("bend",))
    assert -5.0 < row.log_evidence < 5.0


def test_a_small_value_of_what_no_tangent_shows_is_found():
    """A noise floor that adds its square to a power, and may be eighty times as large."""
    f = torch.logspace(1.3, 4.7, 96, dtype=F64)

    def level(x, p):
        power = 1 / (1 + (x / 3000.0) ** 4) + p["n"] ** 2
        return p["K"] + 10 * torch.log10(power)

    base = tc.Simulator(
        level, [tc.Parameter("K", low=-20.0, high=30.0), tc.Parameter("n", low=0.0, high=0.2, neutral=0.0)]
    )
    terms = [
        tc.Term("noise floor", frees=("n",)),
        tc.Term("feedthrough", outputs={"y": lambda x, p, y: y + p["c"] * x / 1e3}, parameters=[tc.Parameter("c")]),
    ]
    noise = 0.1 * torch.randn(96, generator=torch.Generator().manual_seed(0), dtype=F64)
    y = level(f, {"K": 6.0, "n": 0.0024}) + noise
    d = tc.diagnose(base, tc.Recording(x=f, y=y, noise=0.1), terms, seed=0, progress=False)
    assert d.terms == ["noise floor"]
    assert d.final.estimates[-1].value == pytest.approx(0.0024, rel=0.1)
