"""Stiff models: implicit steps against SciPy, their exact derivatives, and when they are taken."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
import torchcal.discovery.fits.sharpen as sharpening
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.sharpen import sharpen
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.errors import DomainError, SimulatorError
from torchcal.inference.summary import settings_of
from torchcal.results.reading import _with_steps
from torchcal.simulators import (
    Trajectories,
    fading,
    magnified,
    outgrown,
    settled,
    settled_implicitly,
    stepping,
    workable,
)
from torchcal.terms import extend

F64 = torch.float64


def tensor(*values):
    return torch.tensor(values, dtype=F64)


def run_of(t, initial, outputs=("a",), **more):
    return tc.Run(t, {name: np.zeros(len(t)) for name in outputs}, initial=initial, **more)


def robertson(stiff=True):
    """H. H. Robertson's autocatalysis: rate constants of 0.04, 1e4 and 3e7."""

    def rates(t, s, p, u):
        made, back, on = p["k1"] * s["a"], p["k2"] * s["b"] * s["c"], p["k3"] * s["b"] ** 2
        return {"a": back - made, "b": made - back - on, "c": on}

    parameters = [tc.Parameter("k1"), tc.Parameter("k2"), tc.Parameter("k3")]
    return tc.ODESimulator(rates, ["a", "b", "c"], parameters, stiff=stiff)


K = tensor(0.04, 1e4, 3e7)


@pytest.fixture(scope="module")
def burnt():
    t = np.concatenate([[0.0], np.logspace(-4, 4, 40)])
    return tc.Recording(runs=[run_of(t, {"a": 1.0, "b": 0.0, "c": 0.0}, ("a", "b", "c"))])


def test_robertsons_problem_agrees_with_scipy(burnt):
    def rates(t, s):
        made, back, on = 0.04 * s[0], 1e4 * s[1] * s[2], 3e7 * s[1] ** 2
        return [back - made, made - back - on, on]

    t = burnt.runs[0].time.numpy()
    exact = solve_ivp(rates, (0, t[-1]), [1.0, 0.0, 0.0], "Radau", t, rtol=1e-10, atol=1e-14).y
    bound = robertson().bind(burnt)
    assert bound.implicit
    errors = []
    for factor in (1, 2, 4):
        finer = bound.refined(factor)
        y = finer.at(finer.x)(K).reshape(3, -1).numpy()
        errors.append(max(np.abs(y - exact).max(1) / np.abs(exact).max(1)))
    assert errors[0] < 1e-4
    assert errors[2] < 1e-7
    assert errors[2] < errors[1] / 8 < errors[0] / 64


def test_derivatives_are_those_of_the_discrete_solution(burnt):
    bound = robertson().bind(burnt)
    found = bound.linearise(bound.x, K[None])
    for k in range(3):
        step = torch.zeros(3, dtype=F64)
        step[k] = 1e-4 * K[k]
        up, down = (bound.linearise(bound.x, (K + sign * step)[None]).y[0] for sign in (1, -1))
        numeric = (up - down) / (2 * step[k])
        torch.testing.assert_close(found.jacobian[0, :, k], numeric, rtol=1e-5, atol=1e-7 * float(numeric.abs().max()))
    # From there other values take a pass or two, and come to what is solved anew.
    near = bound.linearise(bound.x, 1.02 * K[None], warm=found.warm)
    anew = bound.linearise(bound.x, 1.02 * K[None])
    torch.testing.assert_close(near.y, anew.y, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(near.jacobian * K, anew.jacobian * K, rtol=1e-3, atol=1e-7)


def test_stages_are_solved_along_with_the_states(burnt):
    calls = []
    plain = robertson()
    rates = plain.rates
    counted = tc.ODESimulator(
        lambda t, s, p, u: calls.append(t) or rates(t, s, p, u), plain.states, plain.parameters, stiff=True
    )
    bound = counted.bind(burnt)
    warm = bound.linearise(bound.x, K[None]).warm
    calls.clear()
    near = bound.linearise(bound.x, 1.2 * K[None], warm=warm)
    assert len(calls) <= 8  # every pass of the states would take several for the stages
    torch.testing.assert_close(near.y, bound.linearise(bound.x, 1.2 * K[None]).y, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("factor", [1.0001, 0.97])
def test_stages_that_do_not_settle_along_with_the_states_are_solved_in_every_pass(factor):
    """Two substances that meet fast, with a feed that is switched on and off."""

    def rates(t, s, p, u):
        met, apart = p["k1"] * s["a"] * s["b"], p["k2"] * s["c"]
        bound, freed = p["k3"] * s["c"] * s["b"], p["k4"] * s["d"]
        feed = p["f"] * torch.where(torch.sin(3 * torch.as_tensor(t)) > 0, 1.0, 0.0)
        return {
            "a": feed - met + apart - 0.3 * s["a"],
            "b": 0.2 - met + apart - bound + freed - 0.1 * s["b"],
            "c": met - apart - bound,
            "d": bound - freed,
        }

    initial = {"a": 1.0, "b": 0.7, "c": 0.0, "d": 0.0}
    names = [tc.Parameter(name) for name in ("k1", "k2", "k3", "k4", "f")]
    model = tc.ODESimulator(rates, [*initial], names, stiff=True)
    bound = model.bind(tc.Recording(runs=[run_of(np.linspace(0, 6, 60), initial, ("a", "b", "c", "d"))]))
    values = tensor(14154.0, 4.2705, 34519.0, 12646.0, 1.0)
    warm = bound.linearise(bound.x, values[None]).warm
    near = bound.linearise(bound.x, factor * values[None], warm=warm, march=False)
    torch.testing.assert_close(near.y, bound.linearise(bound.x, factor * values[None]).y, rtol=1e-7, atol=1e-10)


def driven(stiff=True, **more):
    """A fast state that follows an input, whose rate constant may differ from run to run, and a slow one behind it."""
    return tc.ODESimulator(
        lambda t, s, p, u: {"a": p["k"] * (u["f"] + torch.sin(t) - s["a"]), "b": p["r"] * (s["a"] - s["b"])},
        ["a", "b"],
        [tc.Parameter("k", per_run=True, low=0.0), tc.Parameter("r", low=0.0)],
        stiff=stiff,
        **more,
    )


@pytest.mark.parametrize("hold", ["linear", "zero", "cubic"])
def test_inputs_and_runs_agree_with_short_explicit_steps(hold):
    t1, t2 = np.linspace(0, 4, 30), np.array([1.0, 1.3, 2.0, 2.1, 3.5])
    runs = [
        run_of(t, {"a": 0.5, "b": b}, ("a", "b"), inputs={"f": np.cos(3 * t)}, hold=hold)
        for t, b in ((t1, 0.0), (t2, 1.0))
    ]
    recording = tc.Recording(runs=runs)
    values = tensor(40.0, 25.0, 0.7)
    implicit = driven().bind(recording).refined(4)
    explicit = driven(stiff=False).bind(recording).refined(64)
    torch.testing.assert_close(implicit.at(implicit.x)(values), explicit.at(explicit.x)(values), rtol=1e-6, atol=1e-6)
    mine, others = (b.linearise(b.x, values[None]).jacobian[0] for b in (implicit, explicit))
    torch.testing.assert_close(mine, others, rtol=1e-4, atol=1e-7)
    states = explicit.solve(values[None])[:, :, ::16]
    torch.testing.assert_close(implicit.solve(values[None]), states, rtol=1e-5, atol=1e-5)


def test_a_batch_is_every_one_of_it(burnt):
    bound = robertson().bind(burnt)
    values = K * torch.linspace(0.8, 1.2, 5, dtype=F64)[:, None]
    together = bound.at(bound.x)(values)
    for k in range(5):
        torch.testing.assert_close(together[k], bound.at(bound.x)(values[k]), rtol=1e-9, atol=1e-13)


def test_a_force_throughout_a_step_moves_its_end_by_what_is_left_of_it():
    recording = tc.Recording(runs=[run_of(np.linspace(0, 4, 21), {"a": 0.5, "b": 0.0}, inputs={"f": np.zeros(21)})])
    pushed = tc.Term("push", equation="a", rate=lambda t, s, p, u: p["F"], parameters=[tc.Parameter("F")])
    bound = extend(driven().bind(recording), [pushed])
    values = tensor(1e4, 0.7, 0.0)
    states = bound.solve(values[None])
    kicks = bound.steps.kicks(values[None], states)
    forcing = bound.steps.derivatives(values[None], states, [2])[2][..., 0]
    torch.testing.assert_close(kicks[..., 0], forcing, rtol=1e-10, atol=1e-16)
    assert float((kicks[0, 0, :, 0, 0] - 1e-4).abs().max()) < 1e-6  # F / k and not F h


def test_a_stage_that_is_not_found_blows_up():
    t = np.linspace(0, 2, 20)
    model = tc.ODESimulator(
        lambda t, s, p, u: {"a": p["k"] * s["a"] ** 2 + 1.0}, ["a"], [tc.Parameter("k")], stiff=True
    )
    bound = model.bind(tc.Recording(runs=[run_of(t, {"a": 1.0})]))
    y = bound.at(bound.x)(tensor(4.0))  # infinite at t = 0.22
    before = torch.as_tensor(t) < 0.2
    assert bool(torch.isfinite(y[before]).all())
    assert not bool(torch.isfinite(y).all())


# --- when they are taken ---------------------------------------------------------------------------------------


def fast(**more):
    return tc.ODESimulator(
        lambda t, s, p, u: {"a": -p["k"] * (s["a"] - torch.cos(t))}, ["a"], [tc.Parameter("k", low=0.0)], **more
    )


T = np.linspace(0, 3, 31)
FOLLOWED = tc.Recording(runs=[run_of(T, {"a": 1.0})])
ALLOWED = torch.full((31,), 1e-4, dtype=F64)


@pytest.mark.parametrize("k", [300.0, 3e4, 3e7])
def test_a_stiff_solution_settles_with_few_implicit_steps(k):
    bound = fast().bind(FOLLOWED)
    assert not bound.implicit
    for found in (workable(bound, tensor(k)[None], ALLOWED), settled_implicitly(bound, tensor(k)[None], ALLOWED)):
        assert found.implicit
        assert found.num_steps <= 2 * bound.num_steps
        y = found.at(found.x)(tensor(k))
        exact = (k * k * np.cos(T) + k * np.sin(T)) / (k * k + 1)  # but for what decays at once
        assert np.abs(y.numpy() - exact)[1:].max() < 1e-4


def test_a_solution_that_is_not_stiff_has_explicit_steps():
    for k in (0.3, 3.0, 30.0):
        bound = fast().bind(FOLLOWED)
        assert not settled(bound, tensor(k)[None], ALLOWED).implicit
        assert not workable(bound, tensor(k)[None], ALLOWED).implicit


def test_implicit_steps_are_not_tried_where_they_are_not_wanted():
    bound, point = fast().bind(FOLLOWED), tensor(3e4)[None]
    assert settled(bound, point, ALLOWED).implicit
    with pytest.raises(SimulatorError, match="after 3 times"):
        settled(bound, point, ALLOWED, halvings=3, switch=False)
    # Steps that are implicit already stay so.
    implicit = fast(stiff=True).bind(FOLLOWED)
    assert settled(implicit, point, ALLOWED, halvings=3, switch=False).implicit


def test_what_the_user_says_of_stiffness_holds():
    point = tensor(3e4)[None]
    assert fast(stiff=True).bind(FOLLOWED).implicit
    never = fast(stiff=False).bind(FOLLOWED)
    assert settled_implicitly(never, point, ALLOWED) is None
    assert not workable(never, point, ALLOWED).implicit
    with pytest.raises(DomainError, match=r"Expected stiff=True, False or None\. Got 'yes'"):
        fast(stiff="yes")


def test_a_kink_is_passed():
    model = tc.ODESimulator(
        lambda t, s, p, u: {"a": -p["k"] * torch.tanh(s["a"] / 1e-9)}, ["a"], [tc.Parameter("k", low=0.0)]
    )
    t = np.linspace(0, 3, 31)
    bound = model.bind(tc.Recording(runs=[run_of(t, {"a": 1.0})]))
    found = workable(bound, tensor(1.0)[None], ALLOWED)
    y = found.at(found.x)(tensor(1.0)).numpy()
    assert np.abs(y - np.maximum(1.0 - t, 0.0)).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("stiff", [None, True])
def test_steps_become_short_where_a_stiff_solution_jumps(stiff):
    """Van der Pol's relaxation oscillation: jumps, each in a fraction of the time between them."""
    mu = 20.0
    t = np.linspace(0, 2 * mu, 150)
    y = solve_ivp(
        lambda t, s: [s[1], mu * (1 - s[0] ** 2) * s[1] - s[0]], (0, t[-1]), [2.0, 0.0], "Radau", t,
        rtol=1e-10, atol=1e-12,
    ).y[0]  # fmt: skip
    model = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": p["mu"] * (1 - s["x"] ** 2) * s["v"] - s["x"]},
        ["x", "v"], [tc.Parameter("mu", low=0.0)], observe=("x",), stiff=stiff,
    )  # fmt: skip
    bound = model.bind(tc.Recording(runs=[run_of(t, {"x": 2.0, "v": 0.0}, ("x",))]))
    assert bound.implicit == bool(stiff)
    found = workable(bound, tensor(mu)[None], torch.full((150,), 1e-3, dtype=F64))
    assert found.num_steps < 400
    assert found.implicit
    assert np.abs(found.at(found.x)(tensor(mu)).numpy() - y).max() < 1e-3
    lengths = found.grid.h[found.grid.h > 0]
    assert float(lengths.max() / lengths.min()) > 10


@pytest.mark.parametrize(
    ("k", "stiff"),
    [
        pytest.param(300.0, True, marks=pytest.mark.slow),
        (1e4, None),
        pytest.param(300.0, None, marks=pytest.mark.slow),
        pytest.param(1e4, True, marks=pytest.mark.slow),
    ],
)
def test_what_grows_fast_is_not_damped(k, stiff):
    """From near an equilibrium that is unstable: longer implicit steps than it grows in stay there, at any length."""
    model = tc.ODESimulator(
        lambda t, s, p, u: {"a": p["k"] * s["a"] * (1 - s["a"])}, ["a"], [tc.Parameter("k", low=0.0)], stiff=stiff
    )
    bound = model.bind(tc.Recording(runs=[run_of(T, {"a": 1e-3})]))
    exact = 1 / (1 + (1 / 1e-3 - 1) * np.exp(-k * T))
    wrong = Trajectories(model, bound.recording, implicit=True)
    assert outgrown(wrong, tensor(k)[None], wrong.solve(tensor(k)[None]))
    assert float(wrong.at(wrong.x)(tensor(1e6))[-1]) < 0.5  # and not 1
    for found in (workable(bound, tensor(k)[None], ALLOWED), settled_implicitly(bound, tensor(k)[None], ALLOWED)):
        assert found.implicit
        assert not outgrown(found, tensor(k)[None], found.solve(tensor(k)[None]))
        assert np.abs(found.at(found.x)(tensor(k)).numpy() - exact).max() < 1e-4


@pytest.mark.parametrize("stiff", [None, pytest.param(True, marks=pytest.mark.slow)])
def test_an_enzyme_by_its_full_mechanism_uses_up_its_substrate(stiff):
    def rates(t, s, p, u):
        bind, back, on = p["kf"] * s["E"] * s["S"], 1e3 * s["C"], 1e2 * s["C"]
        return {"S": back - bind, "E": back + on - bind, "C": bind - back - on, "P": on}

    model = tc.ODESimulator(rates, ["S", "E", "C", "P"], [tc.Parameter("kf", low=0.0)], observe=("S", "P"), stiff=stiff)
    t = np.linspace(0, 20, 31)
    first = {"S": 10.0, "E": 0.01, "C": 0.0, "P": 0.0}
    bound = model.bind(tc.Recording(runs=[run_of(t, first, ("S", "P"))]))
    values = tensor(1e6)

    def mass_action(t, s):
        bind, back, on = 1e6 * s[1] * s[0], 1e3 * s[2], 1e2 * s[2]
        return [back - bind, back + on - bind, bind - back - on, on]

    def jac(t, s):
        bind = np.array([1e6 * s[1], 1e6 * s[0], 0.0, 0.0])
        back, on = np.array([0.0, 0.0, 1e3, 0.0]), np.array([0.0, 0.0, 1e2, 0.0])
        return np.stack([back - bind, back + on - bind, bind - back - on, on])

    start = list(first.values())
    exact = solve_ivp(mass_action, (0, 20), start, "Radau", t, rtol=1e-9, atol=1e-13, jac=jac).y[[0, 3]]
    found = workable(bound, values[None], torch.full((62,), 1e-3, dtype=F64))
    assert found.implicit
    assert np.abs(found.at(found.x)(values).reshape(2, -1).numpy() - exact).max() < 1e-3


@pytest.mark.parametrize("subdivide", [2, 3])
def test_no_step_goes_past_a_pole(subdivide):
    """A substrate that is used up: its rate has a pole at S = -K, and steps that end behind it solve their equations
    too. Exact is S = K w, w + log w = log(S0 / K) + (S0 - V t) / K (Schnell & Mendoza 1997, J. Theor. Biol. 187, 207).
    """
    t, begin = np.linspace(0.0, 20.0, 22), [1.0, 3.0, 8.0, 20.0]
    simulator = tc.ODESimulator(
        lambda t, s, p, u: {"S": -p["V"] * s["S"] / (p["K"] + s["S"])},
        ["S"],
        [tc.Parameter("V"), tc.Parameter("K")],
        observe=("S",),
    )
    recording = tc.Recording(runs=[run_of(t, {"S": s}, ("S",)) for s in begin], noise=0.05)
    bound = Trajectories(simulator, recording, subdivide=subdivide, implicit=True)
    values = tensor([0.4, 0.01], [0.41, 0.02], [0.5, 0.01], [0.6, 0.05])
    for row in (values[:1], values):
        y = bound.outputs_of(row, bound.solve(row))
        for (v, k), found in zip(row.tolist(), y, strict=True):
            z = np.concatenate([np.log(s / k) + (s - v * t) / k for s in begin])
            log = np.where(z > 1, np.log(np.maximum(z, 1)), z)  # of w, by Newton's method for w + log w = z
            for _ in range(30):
                log -= (np.exp(log) + log - z) / (np.exp(log) + 1)
            assert (found - torch.from_numpy(k * np.exp(log))).abs().max() < 1e-3


@pytest.mark.parametrize("k", [100.0, 1e3, 1e5])
def test_a_state_that_comes_to_rest_stays_finite(k):
    """There the velocity is rounding, as is every correction of it."""
    model = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - 0.1 * p["k"] * s["v"] - 9.81},
        ["x", "v"], [tc.Parameter("k")], observe=("x",), stiff=True,
    )  # fmt: skip
    t = np.linspace(0, 10, 51)
    bound = model.bind(tc.Recording(runs=[run_of(t, {"x": 1.0, "v": 0.0}, ("x",))]))
    exact = solve_ivp(
        lambda t, s: [s[1], -k * s[0] - 0.1 * k * s[1] - 9.81], (0, 10), [1.0, 0.0], "Radau", t, rtol=1e-9, atol=1e-12
    ).y[0]
    found = settled(bound, tensor(k)[None], torch.full((51,), 1e-4, dtype=F64))
    assert found.num_steps < 200
    assert np.abs(found.at(found.x)(tensor(k)).numpy() - exact).max() < 2e-4


def test_rates_are_checked_whatever_solutions_the_stages_have():
    bound = fast(stiff=True).bind(FOLLOWED)
    assert bound.steps.difference(tensor(300.0)[None]) < 1e-12
    mixed = tc.ODESimulator(
        lambda t, s, p, u: {"a": -p["k"] * s["a"] * torch.as_tensor(t).mean()}, ["a"], [tc.Parameter("k")], stiff=True
    ).bind(FOLLOWED)
    assert mixed.steps.difference(tensor(3.0)[None]) > 1e-3


def test_where_steps_are_shorter_is_kept():
    denser = (torch.ones(30, dtype=torch.long),)
    denser[0][7] = 5
    bound = Trajectories(fast(), FOLLOWED, subdivide=2, denser=denser, implicit=True)
    propagate = SimpleNamespace(
        simulator=bound, rule_choice=SimpleNamespace(kind="sparse"), order=None, sd_floor=0.0, fixed={}, free=[]
    )
    scaling = SimpleNamespace(center=T, scale=T, log=T)
    problem = SimpleNamespace(propagate=propagate, prior=None)
    settings = settings_of(problem, SimpleNamespace(scaling=scaling), "Uniform", 0, 0)
    settings = json.loads(json.dumps(settings))
    again = _with_steps(fast().bind(FOLLOWED), settings)
    assert torch.equal(again.grid.nodes, bound.grid.nodes)
    assert again.implicit
    # What the user says of stiffness now comes first.
    assert not _with_steps(fast(stiff=False).bind(FOLLOWED), settings).implicit


def test_terms_other_runs_and_shorter_steps_keep_implicit_ones():
    bound = fast(stiff=True).bind(FOLLOWED)
    push = tc.Term("push", equation="a", rate=lambda t, s, p, u: p["F"], parameters=[tc.Parameter("F")])
    other = tc.Recording(runs=[run_of(np.linspace(0, 5, 11), {"a": 0.0})])
    found = workable(fast().bind(FOLLOWED), tensor(3e4)[None], ALLOWED)
    for one in (bound, found):
        for again in (extend(one, [push]), one.refined(2), one.elsewhere(other)):
            assert isinstance(again, Trajectories)
            assert again.implicit
    assert extend(fast(stiff=True), [push]).bind(FOLLOWED).implicit


def test_a_fit_that_comes_to_a_stiff_place_goes_on_there():
    """Explicit steps are unstable beyond k h = 2.8; the data want more."""
    t = np.linspace(0, 3, 31)
    rng = np.random.default_rng(0)
    y = np.cos(t) + 1e-3 * rng.standard_normal(31)
    recording = tc.Recording(runs=[tc.Run(t, {"a": y}, initial={"a": 1.0})], noise=1e-3)
    bound = fast().bind(recording)
    problem = Problem.of(bound, recording)
    whitening = problem.whitening(recording.noise, torch.zeros(1, dtype=F64))
    found = fit(problem, whitening, tensor(20.0)[None], [0])
    again, error = sharpen(found, lambda now: ALLOWED[now.problem.index] / 10, rounds=7)
    assert error == 0.0
    assert again.problem.simulator.implicit
    assert float(again.values[0]) > 80.0
    assert again.chi2 < 31 + 4 * math.sqrt(62)


# --- what they are for -----------------------------------------------------------------------------------------


def chain(k2, planted=0.0, *, noise=0.02):
    """A to C over B, which is used up as soon as it is made; and what else C does, if anything."""
    t = np.linspace(0, 10, 60)
    rng = np.random.default_rng(1)
    runs = []
    for first in (1.0, 2.0):
        def rates(t, s):
            made = 0.3 * s[0] + planted * s[0] * s[2]
            return [-made, made - k2 * s[1], k2 * s[1]]

        y = solve_ivp(rates, (0, 10), [first, 0.0, 0.0], "Radau", t, rtol=1e-9, atol=1e-12).y
        outputs = {"A": y[0] + noise * rng.standard_normal(60), "C": y[2] + noise * rng.standard_normal(60)}
        runs.append(tc.Run(t, outputs, initial={"A": first, "B": 0.0, "C": 0.0}))
    base = tc.ODESimulator(
        lambda t, s, p, u: {
            "A": -p["k1"] * s["A"], "B": p["k1"] * s["A"] - p["k2"] * s["B"], "C": p["k2"] * s["B"]
        },
        {"A": "mol/L", "B": "mol/L", "C": "mol/L"},
        [tc.Parameter("k1", low=0.0, initial=0.5, unit="1/s"),
         tc.Parameter("k2", low=0.0, initial=k2, unit="1/s")],
        observe=("A", "C"),
    )  # fmt: skip
    return base, tc.Recording(runs=runs, noise=noise)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("planted", "among", "verdict", "terms"),
    [
        (0.18, ("autocatalysis", "constant source"), "named", ["autocatalysis"]),
        (0.18, None, "named", ["autocatalysis"]),
        (0.0, None, "consistent", []),
    ],
)
def test_a_stiff_mechanism_is_diagnosed(planted, among, verdict, terms):
    base, recording = chain(1e4, planted)
    library = tc.terms.kinetics("A", "C", rate="k1")
    candidates = [term for term in library if among is None or term.name in among]
    d = tc.diagnose(base, recording, candidates, seed=0, progress=False)
    assert (d.verdict, d.terms) == (verdict, terms)
    assert "implicit" in d.settings["solver"]
    if planted:
        assert d.ranking[0].estimates[0].value == pytest.approx(planted, abs=4 * d.ranking[0].estimates[0].sd)


@pytest.mark.slow
def test_a_stiff_mechanism_is_calibrated_and_kept(tmp_path):
    base, recording = chain(1e4)
    found = tc.calibrate(base, recording, fixed={"k2": 1e4}, num_samples=0, seed=0)
    assert found.settings["implicit"]
    assert float(found.map.mean[0]) == pytest.approx(0.3, abs=0.01)
    found.save(tmp_path / "stiff.nc")
    again = tc.results.Calibration.load(tmp_path / "stiff.nc", simulator=base)
    assert again.propagate.simulator.implicit
    torch.testing.assert_close(again.predict().mean, found.predict().mean)


def test_steps_that_would_magnify_what_fades_are_not_kept():
    """What has faded long ago is solved well by any steps; what feeds it later was magnified without limit."""
    t = np.concatenate([np.linspace(0, 5, 41), np.linspace(6, 60, 50)])
    fading = {"rates": lambda t, s, p, u: {"N": p["f"] - p["k"] * s["N"]}, "states": ["N"]}
    parameters = [tc.Parameter("k", low=0.0), tc.Parameter("f", low=0.0, initial=0.0)]
    values, allowed = tensor(5.6, 0.0)[None], torch.full((len(t),), 1e-3, dtype=F64)
    for stiff in (None, False):
        model = tc.ODESimulator(parameters=parameters, stiff=stiff, **fading)
        bound = model.bind(tc.Recording(runs=[run_of(t, {"N": 1.0}, ("N",))]))
        assert magnified(bound, values, bound.solve(values))
        found = settled(bound, values, allowed)
        assert not magnified(found, values, found.solve(values))
        more = found.at(found.x)(values + tensor(0.0, 1e-3)) - found.at(found.x)(values)
        assert float(more[0, -1]) == pytest.approx(1e-3 / 5.6, rel=1e-3)


def test_steps_that_magnify_whatever_is_done_stay_as_they_are():
    """Halving them a few times is of no avail: then not at all, and never again and again."""
    t = np.concatenate([np.linspace(0, 0.1, 40), np.linspace(1, 40, 40)])
    model = tc.ODESimulator(
        lambda t, s, p, u: {"N": -p["k"] * s["N"]}, ["N"], [tc.Parameter("k", low=0.0)], stiff=False
    )
    bound = model.bind(tc.Recording(runs=[run_of(t, {"N": 0.0}, ("N",))]))
    values, allowed = tensor(1e4)[None], torch.full((len(t),), 1e-3, dtype=F64)
    assert magnified(bound, values, bound.solve(values))
    assert settled(bound, values, allowed).num_steps == bound.num_steps
    assert settled(bound, values, allowed, halvings=1, switch=False).num_steps == bound.num_steps


@pytest.mark.parametrize("k", [3.6, 4.5, 5.5])
def test_steps_leave_room_for_what_a_fit_may_find(k):
    """Near the edge of what explicit steps bear χ² rises as at a bound, at which a fit would stop."""
    t = np.linspace(0, 60, 121)
    model = tc.ODESimulator(lambda t, s, p, u: {"N": p["k"] * (1.0 - s["N"])}, ["N"], [tc.Parameter("k", low=0.0)])
    bound = model.bind(tc.Recording(runs=[run_of(t, {"N": 1.0}, ("N",))]))
    values, allowed = tensor(k)[None], torch.full((len(t),), 1e-3, dtype=F64)
    assert magnified(bound, values, bound.solve(values)) == (k > 3.8)  # 1.5 k h beyond 2.785
    found = settled(bound, values, allowed)
    faster = 1.5 * values
    assert float((found.at(found.x)(faster) - 1.0).abs().max()) < 1e-6


@pytest.mark.parametrize(("k", "implicit"), [(5.5, False), (9.0, False), (60.0, True)])
def test_a_few_times_as_many_explicit_steps_are_taken_rather_than_implicit_ones(k, implicit):
    t = np.linspace(0, 60, 121)
    model = tc.ODESimulator(lambda t, s, p, u: {"N": p["k"] * (1.0 - s["N"])}, ["N"], [tc.Parameter("k", low=0.0)])
    recording = tc.Recording(runs=[run_of(t, {"N": 1.0}, ("N",))], noise=0.02)
    bound = model.bind(recording)
    values, allowed = tensor(k)[None], torch.full((len(t),), 1e-3, dtype=F64)
    found = settled(bound, values, allowed)
    problem = Problem.of(model, recording)
    whitening = problem.whitening(allowed, torch.zeros(1, dtype=F64))
    sharp, error = sharpen(fit(problem, whitening, values, [0]), lambda now: allowed, rounds=3)
    assert error == 0.0
    for simulator in (found, sharp.problem.simulator):
        assert simulator.implicit == implicit
        assert simulator.num_steps <= 4 * bound.num_steps
        assert not magnified(simulator, values, simulator.solve(values))


@pytest.mark.parametrize(("shorter", "implicit"), [(1, False), (8, True)])
def test_implicit_steps_replace_many_times_as_many_explicit_ones(shorter, implicit):
    """Steps that a fit's way had shortened, before what fades became faster still: the data ask for no such ones."""
    t = np.linspace(0, 60, 121)
    model = tc.ODESimulator(lambda t, s, p, u: {"N": p["k"] * (1.0 - s["N"])}, ["N"], [tc.Parameter("k", low=0.0)])
    recording = tc.Recording(runs=[run_of(t, {"N": 1.0}, ("N",))], noise=0.02)
    bound = model.bind(recording).refined(shorter)
    values, allowed = tensor(5.5 * shorter)[None], torch.full((len(t),), 1e-3, dtype=F64)
    problem = Problem.of(model, recording).with_simulator(bound)
    found = fit(problem, problem.whitening(allowed, torch.zeros(1, dtype=F64)), values, [0])
    sharp, error = sharpen(dataclasses.replace(found, values=values[0]), lambda now: allowed, rounds=3)
    assert error == 0.0
    for simulator in (settled(bound, values, allowed), sharp.problem.simulator):
        assert simulator.implicit == implicit
        assert simulator.num_steps == (120 if implicit else 2 * bound.num_steps)


@pytest.mark.slow
def test_a_fast_neighbour_is_no_bound_of_a_fit():
    """Point kinetics of a reactor with its Doppler feedback: prompt neutrons follow at once, and at the true value of
    what they follow with, explicit steps were unstable."""
    t, beta, a, sd, rng = np.arange(0, 60, 0.5), 0.0065, 4.8e-4, 0.0107, np.random.default_rng(21)
    rods = [1e-3 * np.where(t < 5, 0, np.where(t < 20, 1.5, np.where(t < 35, -1.0, 0.8))),
            1e-3 * np.clip((t - 5) * 0.1, 0, 2.0) * (t < 40)]  # fmt: skip
    runs = []
    for rod in rods:
        states = [np.ones(2)]
        for first, last, rho in zip(t[:-1], t[1:], rod[:-1], strict=True):
            def rates(_, s, rho=rho):
                return [((rho - beta) * s[0] + beta * s[1] - a * (s[0] - 1) * s[0]) / 1e-3, 0.08 * (s[0] - s[1])]

            states.append(solve_ivp(rates, (first, last), states[-1], method="LSODA", rtol=1e-9, atol=1e-11).y[:, -1])
        n = np.array(states)[:, 0] + sd * rng.standard_normal(len(t))
        runs.append(tc.Run(time=t, outputs={"n": n}, inputs={"rod": rod}, initial={"n": 1.0, "c": 1.0}, hold="zero"))
    base = tc.ODESimulator(
        lambda t, s, p, u: {
            "n": ((p["G"] * u["rod"] - p["be"]) * s["n"] + p["be"] * s["c"]) / 1e-3, "c": p["la"] * (s["n"] - s["c"]),
        },
        ["n", "c"],
        [tc.Parameter("be", low=0.002, high=0.02, initial=0.006), tc.Parameter("la", low=0.01, high=1.0, initial=0.1),
         tc.Parameter("G", low=0.2, high=3.0, initial=1.0)],
        observe=("n",),
    )  # fmt: skip
    doppler = tc.Term("Doppler feedback", equation="n", rate=lambda t, s, p, u: -p["a"] * (s["n"] - 1) * s["n"] / 1e-3,
                      parameters=[tc.Parameter("a", low=0.0)])  # fmt: skip
    d = tc.diagnose(base, tc.Recording(runs=runs, noise=sd), [doppler], seed=0, progress=False)
    assert d.terms == ["Doppler feedback"]
    told = {one.name: one for one in d.final.estimates}
    for name, truth in (("be", beta), ("G", 1.0), ("Doppler feedback.a", a)):  # nearly one scale of all three
        assert told[name].value == pytest.approx(truth, abs=3 * told[name].sd)
        assert told[name].sd > 0.05 * truth


# --- short steps that implicit ones would have to be as well --------------------------------------------------------


def passage(star, eccentricity, number):
    """A body that begins at its farthest from a star of μ = 1, with a period of 2π, and passes close by it."""
    t = np.linspace(0.0, 2 * math.pi, number)
    farthest = 1 + eccentricity
    begin = [farthest, 0.0, 0.0, math.sqrt(2 / farthest - 1)]
    truth = solve_ivp(
        lambda t, s: [s[2], s[3], *(-s[:2] * math.hypot(s[0], s[1]) ** -3)], (0, t[-1]), begin, t_eval=t,
        rtol=1e-11, atol=1e-13, method="DOP853",
    ).y  # fmt: skip
    rng = np.random.default_rng(0)
    outputs = {name: truth[i] + 0.003 * rng.standard_normal(number) for i, name in enumerate("xy")}
    return tc.Recording(runs=[tc.Run(t, outputs)], noise=0.003), tensor(1.0, *begin)[None]


def test_what_fades_no_faster_than_it_grows_is_no_reason_for_implicit_steps(star):
    recording, values = passage(star, 0.9, 61)
    bound = Trajectories(star, recording)
    names = [q.name for q in bound.parameters]
    assert names == ["mu", "x(0)", "y(0)", "vx(0)", "vy(0)"]
    states = bound.solve(values)
    h, r = float(bound.grid.h[0, 0]), float(states[0, 0, :, :2].norm(dim=-1).min())
    assert h * math.sqrt(2 / r**3) > 1  # something grows, and something fades, within a step
    assert not fading(bound, values, states)


@pytest.mark.parametrize(("k", "wanted"), [(1000.0, True), (1.0, False)])
def test_what_fades_within_a_step_is_one(k, wanted):
    ode = tc.ODESimulator(lambda t, s, p, u: {"a": p["k"] * (torch.cos(t) - s["a"])}, {"a": None}, [tc.Parameter("k")])
    bound = Trajectories(ode, tc.Recording(runs=[run_of(np.linspace(0, 6, 31), {"a": 1.0})]))
    states = torch.cos(bound.grid.nodes)[None, ..., None]
    assert fading(bound, tensor(k)[None], states) is wanted
    assert fading(bound, tensor(k)[None], states.fill_(math.inf))


@pytest.mark.slow
def test_the_base_follows_a_close_passage_with_short_explicit_steps(star, monkeypatch):
    def tried(*arguments, **options):
        raise AssertionError("implicit steps were tried")

    monkeypatch.setattr(stepping, "settled_implicitly", tried)
    monkeypatch.setattr(sharpening, "settled_implicitly", tried)
    recording, values = passage(star, 0.85, 61)
    base, _ = calibrate_base(Problem.of(star, recording), {}, 12, 0)
    assert base.chi2 == pytest.approx(122 - 5, abs=5 * math.sqrt(2 * 117))
    assert base.values[0] == pytest.approx(1.0, abs=0.01)
    assert base.values[1:] == pytest.approx(values[0, 1:], abs=0.02)


@pytest.mark.parametrize("stiff", [None, False])
def test_a_first_guess_that_fades_within_a_step_is_solved_with_steps_that_do_not_magnify_it(stiff):
    # A rate of 1 per hour was meant, and time is in minutes: explicit steps would make 1e40 of what fades.
    t = np.array([0.0, 10, 15, 20, 30, 45, 60, 90, 120, 180, 240, 300, 360])
    model = tc.ODESimulator(
        lambda t, s, p, u: {"a": -p["k"] * s["a"]}, ["a"], [tc.Parameter("k", low=0.0, high=50.0)], stiff=stiff
    )
    bound = model.bind(tc.Recording(runs=[run_of(t, {"a": 100.0})]))
    allowed = torch.full((13,), 3.0, dtype=F64)
    assert float(bound.at(bound.x)(tensor(1.0)).abs().max()) > 1e6
    with pytest.raises(SimulatorError, match="after 2 times"):
        settled(bound, tensor(1.0)[None], allowed, halvings=2, switch=False)
    found = workable(bound, tensor(1.0)[None], allowed, halvings=2)
    assert found.implicit is (stiff is None)
    assert float((found.at(found.x)(tensor(1.0)) - 100 * torch.exp(-torch.as_tensor(t))).abs().max()) < 3.0


@pytest.mark.parametrize("rise", [0.0, 2e-3])
def test_a_state_that_stays_zero_is_no_obstacle_where_others_depend_on_it(rise):
    """A winding's warming changes a current that settles within a step, whose equation is the pivot of the warming."""

    def rates(t, s, p, u):
        drop = p["R"] * (1 + s["hot"]) * s["i"]
        return {
            "w": (0.06 * s["i"] - 1e-4 * s["w"]) / 3e-4,
            "i": (u["V"] - drop - 0.06 * s["w"]) / 1e-2,
            "hot": p["r"] * s["i"] ** 2 - s["hot"] / 8.0,
        }

    motor = tc.ODESimulator(
        rates, {"w": "rad/s", "i": "A", "hot": "1"}, [tc.Parameter("R"), tc.Parameter("r")], observe=("w",), stiff=True
    )
    t = torch.linspace(0, 2, 21, dtype=torch.float64)
    volts = 4.0 + 8.0 * (t % 1 < 0.5)
    zero = {"w": 0.0, "i": 0.0, "hot": 0.0}
    run = tc.Run(time=t, outputs={"w": torch.zeros_like(t)}, inputs={"V": volts}, initial=zero, hold="zero")
    bound = motor.bind(tc.Recording(runs=[run], noise=1.0)).refined(4)
    found = bound.solve(torch.tensor([[1.2, rise]], dtype=torch.float64))[0, 0]
    level = {"V": 0.0}

    def told(t, s):
        return [
            (0.06 * s[1] - 1e-4 * s[0]) / 3e-4, (level["V"] - 1.2 * (1 + s[2]) * s[1] - 0.06 * s[0]) / 1e-2,
            rise * s[1] ** 2 - s[2] / 8.0,
        ]  # fmt: skip

    wanted, state = [0.0], [0.0, 0.0, 0.0]
    for k in range(20):
        level["V"] = float(volts[k])
        state = solve_ivp(told, (float(t[k]), float(t[k + 1])), state, rtol=1e-9, atol=1e-12, method="LSODA").y[:, -1]
        wanted.append(state[0])
    there = found[bound.grid.node_of, 0]
    torch.testing.assert_close(there, torch.tensor(wanted, dtype=torch.float64), rtol=0, atol=0.02)
