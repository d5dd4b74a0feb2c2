"""What looks like an instrument and may be a change of the physics that has no name, and where that is located."""

import math
import re

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.discovery.misfit.channels import channels
from torchcal.discovery.misfit.replicates import in_common_at
from torchcal.display import NONE

F64 = torch.float64


def diagnose(model, recording, terms):
    return tc.diagnose(model, recording, terms, seed=0, progress=False)


# --- terms in a window -----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kicked", [True, False])
def test_a_kick_is_no_term_from_then_on(kicked):
    """A cart that is hit and rolls on is as much farther ahead as one whose wheels slip less from then on."""
    t, k = torch.linspace(0, 10, 81, dtype=F64), 0.3
    after = (t - 5).clamp_min(0)
    x = 2 / k * (1 - torch.exp(-k * t))
    x = x + 0.4 / k * (1 - torch.exp(-k * after)) if kicked else x + 0.6 * after.clamp_max(1.5)
    x = x + 0.02 * torch.randn(81, generator=torch.Generator().manual_seed(3), dtype=F64)
    base = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["v"]}, {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, high=3.0, initial=0.5)], observe=("x",),
    )  # fmt: skip
    slip = tc.Term("slip", rates={"x": lambda t, s, p, u: p["c"] * s["v"]}, parameters=[tc.Parameter("c")])
    belt = tc.Term("moving belt", rates={"x": lambda t, s, p, u: p["w"] + 0 * t}, parameters=[tc.Parameter("w")])
    recording = tc.Recording(runs=[tc.Run(t, {"x": x}, initial={"x": 0.0})], noise=0.02)
    d = diagnose(base, recording, [slip, belt])
    if kicked:
        assert d.verdict == "ambiguous"
        assert d.tied == [["slip"], [*NONE]]
    else:
        assert d.terms == ["moving belt"]


# --- instruments that err beyond a value -----------------------------------------------------------------------------


def rotor(seed, *, dragged=0.0, limit=math.inf, c=0.0, sd=0.28):
    """Two rotors that run down, whose bearings drag more below 35 rad/s, or which are seen by an instrument that shows
    but a part of what is above a limit."""
    t = np.linspace(0, 30, 76)
    rng = np.random.default_rng(seed)
    runs = []
    for begin in (80.0, 60.0):
        w = solve_ivp(
            lambda t, w: -0.06 * w * (1 + dragged * (w < 35)) - 3e-4 * w**2, (0, 30), [begin], t_eval=t, rtol=1e-9,
            atol=1e-9, max_step=0.05,
        ).y[0]  # fmt: skip
        shown = w - c * np.maximum(w - limit, 0)
        runs.append(tc.Run(t, {"w": shown + sd * rng.standard_normal(76)}))
    model = tc.ODESimulator(
        lambda t, s, p, u: {"w": -p["b"] * s["w"] - p["c"] * s["w"] ** 2},
        {"w": "rad/s"},
        [tc.Parameter("b", unit="1/s", low=0.0, initial=0.05), tc.Parameter("c", unit="1/rad", low=0.0, initial=2e-4)],
    )
    terms = [
        tc.Term("cubic drag", equation="w", rate=lambda t, s, p, u: -p["c"] * s["w"] ** 3,
                parameters=[tc.Parameter("c", low=0.0)]),
        *tc.terms.sensor(outputs=("w",), units={"w": "rad/s"}, dynamic=False),
    ]  # fmt: skip
    return model, tc.Recording(runs=runs, noise=sd, units={"time": "s"}), terms


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_an_instrument_that_errs_where_the_physics_may_change_is_no_name(seed):
    d = diagnose(*rotor(seed, dragged=0.25))
    assert d.verdict in ("ambiguous", "unexplained")
    assert d.verdict == "unexplained" or list(NONE) in d.tied
    (row,) = [row for row in d.ranking if row.terms == NONE]
    assert row.probability > 0.05
    assert "a change of " in row.note or "would do nearly as well" in d.settings["doubt"]


@pytest.mark.slow
def test_an_instrument_with_a_hard_limit_is_one():
    d = diagnose(*rotor(0, limit=50.0, c=1.0))
    assert d.verdict == "named"
    assert d.terms == ["saturation of w"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_gain_error_in_a_range_is_no_name_where_a_parameter_does_the_same(seed):
    rng = np.random.default_rng(seed)
    x, load = (values.ravel() for values in np.meshgrid(np.linspace(-6, 6, 31), [1.0, 2.0, 3.0], indexing="ij"))
    y = 1.3 * (1 - 0.06 * (abs(x) > 3.1)) * load * np.tanh(x / 2.2)
    model = tc.Simulator(
        lambda x, p: p["a"] * x["L"] * torch.tanh(x["x"] / p["b"]),
        [tc.Parameter("a", low=0.0, initial=1.0), tc.Parameter("b", low=0.3, high=20.0, initial=2.0)],
    )
    recording = tc.Recording(x={"x": x, "L": load}, y=y + 0.015 * rng.standard_normal(len(y)), noise=0.015)
    d = diagnose(model, recording, tc.terms.sensor(outputs=("y",), static=True))
    assert d.verdict in ("ambiguous", "unexplained")
    (row,) = [row for row in d.ranking if row.terms == NONE]
    assert row.probability > 0.3
    assert row.note.startswith("a change of a where")


def thermistor(seed, kind):
    """Whose logarithm falls below 273 K, or which is read by an instrument that shows less of what is above 10.2."""
    T = np.repeat(np.linspace(250, 330, 30), 2)
    y = 9 + 3500 * (1 / T - 1 / 298.15)
    y = y - (0.15 * np.maximum(273 - T, 0) / 20 if kind == "wet" else 0.2 * np.maximum(y - 10.2, 0))
    model = tc.Simulator(
        lambda x, p: p["a"] + 1000 * p["B"] * (1 / x - 1 / 298.15),
        [tc.Parameter("a", initial=9.0), tc.Parameter("B", low=0.1, initial=3.0)],
    )
    return model, tc.Recording(x=T, y=y + 0.01 * np.random.default_rng(seed).standard_normal(len(T)), noise=0.01)


@pytest.mark.parametrize("kind", ["wet", "bent reading"])
def test_what_bends_along_the_only_condition_may_be_the_instrument_or_not(kind):
    d = diagnose(*thermistor(0, kind), tc.terms.sensor(outputs=("y",), static=True))
    assert d.verdict == "ambiguous"
    assert ["saturation of y"] in d.tied
    assert list(NONE) in d.tied


def hot_rod(noise, *, painted=1.0, uneven=0.0):
    """A rod of 0.2 m at three temperatures of its end, which loses more heat beyond 0.12 m, or the more the farther."""
    x, hot = (v.ravel() for v in np.meshgrid(np.linspace(0, 0.2, 15), [60.0, 120.0, 200.0]))
    m, far, end, length = 12 * (1 + uneven * x / 0.2), 12 * math.sqrt(painted), 0.12, 0.2
    # Values and slopes of both parts meet at the edge of the paint; none flows out of the end.
    t = far * math.tanh(far * (length - end))
    c = -(12 * math.sinh(12 * end) + t * math.cosh(12 * end)) / (12 * math.cosh(12 * end) + t * math.sinh(12 * end))
    edge = (math.cosh(12 * end) + c * math.sinh(12 * end)) / math.cosh(far * (length - end))
    part = np.where(x < end, np.cosh(12 * x) + c * np.sinh(12 * x), edge * np.cosh(far * (length - x)))
    shape = np.cosh(m * (length - x)) / np.cosh(m * length) if uneven else part
    y = 25 + (hot - 25) * shape + noise * np.random.default_rng(1).standard_normal(45)
    model = tc.Simulator(
        lambda x, p: p["Ta"]
        + (x["hot"] - p["Ta"]) * torch.cosh(p["m"] * (0.2 - x["x"])) / torch.cosh(p["m"] * 0.2),
        [tc.Parameter("m", low=1.0, high=50.0, initial=10.0), tc.Parameter("Ta", low=0.0, high=50.0, initial=20.0)],
    )
    term = tc.Term("uneven film", shifts={"m": lambda x, p: p["m"] * p["w"] * x["x"] / 0.2},
                   parameters=[tc.Parameter("w", low=-0.9, high=5.0)])  # fmt: skip
    return model, tc.Recording(x={"x": x, "hot": hot}, y=y), [term]


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.5, 0.8])
def test_a_smooth_change_is_no_name_where_a_parameter_may_change_at_one_place(noise):
    d = diagnose(*hot_rod(noise, painted=1.5))
    assert d.verdict in ("ambiguous", "unexplained")
    assert d.verdict == "unexplained" or list(NONE) in d.tied
    (row,) = [row for row in d.ranking if row.terms == NONE]
    assert row.note.startswith("a change of m where x")
    d = diagnose(*hot_rod(noise, uneven=0.3))
    assert d.verdict == "named"
    assert d.terms == ["uneven film"]


# --- parameters that are seen in outputs alone -----------------------------------------------------------------------


def charged(loose=0.0):
    """A capacitor behind a resistance, which its voltage shows beside the charge, and which may grow at t = 60."""
    t = np.linspace(0, 120, 121)
    current = np.where((t // 15) % 2 == 0, 1.0, -0.8)
    held = np.repeat(current[:-1], 1)
    v = 1.0 + np.concatenate([[0.0], np.cumsum(held * np.diff(t)) / 40])
    noise = 0.005 * np.random.default_rng(0).standard_normal(len(t))
    seen = v + 0.1 * (1 + loose * (t >= 60)) * current + noise
    model = tc.ODESimulator(
        lambda t, s, p, u: {"v": u["i"] / p["C"]},
        {"v": "V"},
        [tc.Parameter("C", unit="F", low=1.0, initial=30.0), tc.Parameter("R", unit="ohm", low=0.0, initial=0.2)],
        observe={"V": lambda t, s, p, u: s["v"] + p["R"] * u["i"]},
    )
    return model, tc.Recording(runs=[tc.Run(t, {"V": seen}, inputs={"i": current}, hold="zero")], noise=0.005)


def test_a_parameter_that_is_seen_in_an_output_alone_is_where_a_mismatch_sits():
    d = diagnose(*charged(loose=0.5), [])
    assert d.verdict == "unexplained"
    assert (d.where[0].kind, d.where[0].target, d.where[0].driver) == ("parameter", "R", "t")
    assert d.where[0].share > 0.9


def test_changes_at_all_moments_together_are_one_of_the_parameter():
    model, recording = charged()
    base, _ = calibrate_base(Problem.of(model, recording), {}, 4, 0)
    names = [q.name for q in base.problem.parameters]
    found = {c.target: c for c in channels(base.problem, base) if c.kind == "parameter"}
    assert set(found) == {"C", "R"}
    for name, channel in found.items():
        every = channel.response(torch.ones(channel.matrix.shape[1], 1, dtype=F64))[:, 0]
        column = base.jacobian[:, base.free.index(names.index(name))]
        torch.testing.assert_close(every, column, rtol=1e-6, atol=1e-9)


# --- memory of noise where it is not sought --------------------------------------------------------------------------


def test_what_is_correlated_along_the_rows_of_a_grid_is_told():
    rng = np.random.default_rng(0)
    x, load = (values.ravel() for values in np.meshgrid(np.linspace(-1, 1, 25), [1.0, 2.0, 3.0], indexing="ij"))
    e = rng.standard_normal(len(x))
    for k in range(1, len(e)):
        e[k] = 0.8 * e[k - 1] + 0.6 * e[k]
    model = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["x"] * x["L"], [tc.Parameter("a"), tc.Parameter("b")])
    d = diagnose(model, tc.Recording(x={"x": x, "L": load}, y=1 + x * load + 0.05 * e, noise=0.05), [])
    assert d.verdict == "unexplained"
    assert any("correlated from row to row" in row for row in d.symptoms)
    shuffled = rng.permutation(len(x))  # the same in another order, which tells nothing
    again = tc.Recording(x={"x": x[shuffled], "L": load[shuffled]}, y=(1 + x * load + 0.05 * e)[shuffled], noise=0.05)
    assert not any("correlated from row to row" in row for row in diagnose(model, again, []).symptoms)


def up_and_down(seed, gap=0.0, sd=0.02, sorted_rows=False):
    """A curve that is read on the way up and on the way down, at other values."""
    up, down = np.linspace(0.02, 0.98, 13), np.linspace(0.94, 0.06, 13)
    x = np.concatenate([up, down])
    y = 40 * x - 3 * x**2 + sd * np.random.default_rng(seed).standard_normal(26)
    y[13:] += gap * (x * (1 - x))[13:]
    order = np.argsort(x) if sorted_rows else np.arange(26)
    line = tc.Simulator(lambda x, p: p["a"] * x + p["b"] * x**2, [tc.Parameter("a"), tc.Parameter("b")])
    return line, tc.Recording(x=x[order], y=y[order])


@pytest.mark.slow
def test_few_data_that_go_on_in_the_order_of_the_recording_are_told():
    told = "in the order of the recording: a drift, a hysteresis or noise with a memory"
    for seed in range(3):
        d = diagnose(*up_and_down(seed, gap=0.8), tc.terms.sensor(outputs=("y",), static=True))
        assert d.verdict == "consistent"
        assert str(d).startswith("Verdict: consistent (nothing is surely missing)")
        assert told in " ".join(str(d).split())
    seen = sum(told in " ".join(str(diagnose(*up_and_down(seed), [])).split()) for seed in range(20))
    assert seen <= 1
    lost = diagnose(*up_and_down(0, gap=0.8, sorted_rows=True), [])  # in whose rows there is no order of the recording
    assert told not in " ".join(str(lost).split())


# --- what data at one value of a condition share ---------------------------------------------------------------------


def grid(levels, loads, *, shared=0.0, sd=1.0, seed=0, noise=1.0):
    """A plane over a grid, with errors that data at one value of x have in common."""
    rng = np.random.default_rng(seed)
    x, load = (v.ravel() for v in np.meshgrid(np.linspace(0, 1, levels), np.arange(float(loads)), indexing="ij"))
    y = 1 + 20 * x + 2 * load + sd * rng.standard_normal(len(x))
    y += shared * np.repeat(rng.standard_normal(levels), loads)
    plane = tc.Simulator(
        lambda x, p: p["a"] + p["b"] * x["x"] + p["c"] * x["L"], [tc.Parameter(name) for name in "abc"]
    )
    return plane, tc.Recording(x={"x": x, "L": load}, y=y, noise=noise)


@pytest.mark.parametrize(("levels", "loads"), [(12, 2), (20, 3)])
def test_white_noise_shares_nothing_at_the_values_of_a_condition(levels, loads):
    trials, told, meant = 200, 0, 0
    for seed in range(trials):
        for error in (0.0, 3.0):
            problem = Problem.of(*grid(levels, loads, shared=error, seed=seed))
            columns = torch.stack([torch.ones(problem.n, dtype=F64), *problem.recording.x.values()], dim=1)
            left = problem.y - columns @ torch.linalg.lstsq(columns, problem.y[:, None]).solution[:, 0]
            found = in_common_at(problem, left)
            told, meant = told + bool(found and not error), meant + bool(found and error)
    stats = pytest.importorskip("scipy.stats")
    assert told <= stats.binom.ppf(1 - 1e-4, trials, 0.005)
    assert meant >= stats.binom.ppf(1e-4, trials, 0.8)


def test_what_data_at_one_value_share_is_no_larger_noise():
    for noise, verdict in ((1.0, "unexplained"), (None, "consistent")):
        d = diagnose(*grid(20, 3, shared=3.0, noise=noise), [])
        assert d.verdict == verdict
        assert d.noise.source == ("estimated" if noise is None else "given")
        assert any("data at one x share what is left" in row for row in d.symptoms)
    assert "if the symptoms below are noise" in " ".join(str(d).split())
    larger = diagnose(*grid(20, 3, sd=3.0), [])
    assert (larger.verdict, larger.noise.source) == ("consistent", "estimated")
    assert not any("share what is left" in row for row in larger.symptoms)


@pytest.mark.parametrize(("period", "told"), [(120.0, True), (600.0, False)])
def test_what_is_located_along_a_condition_is_not_told_once_more_as_shared(period, told):
    """Beside 17 values of T: a wave of 12 of them is a smooth change along T, one of two and a half is none."""
    at, pressure = (c.ravel() for c in np.meshgrid(np.linspace(200, 1000, 17), [0.2, 1, 5, 20], indexing="ij"))
    wave = 1 + 0.03 * np.sin(2 * np.pi * at / period)
    y = 18 * (at / 300) ** 0.7 * wave + 0.1 * np.random.default_rng(7).standard_normal(len(at))
    base = tc.Simulator(
        lambda x, p: {"mu": p["mu"] * (x["T"] / 300) ** p["n"] + 0 * x["P"]},
        [tc.Parameter("mu", low=1, high=100), tc.Parameter("n", low=0.3, high=1.5)],
    )
    offset = [term for term in tc.terms.sensor(outputs=("mu",), static=True) if term.name == "offset of mu"]
    d = diagnose(base, tc.Recording(x={"T": at, "P": pressure}, y={"mu": y}, noise=0.1), offset)
    assert d.verdict == "unexplained"
    assert d.where[0].driver == "T"
    assert any("data at one T share what is left" in row for row in d.symptoms) is told


def test_what_another_output_shares_is_told_beside_a_misfit_along_the_same_condition():
    at, pressure = (c.ravel() for c in np.meshgrid(np.linspace(200, 1000, 17), [0.2, 1, 5, 20], indexing="ij"))
    batches = np.repeat(np.random.default_rng(7).standard_normal(17), 4)
    noise = 0.1 * np.random.default_rng(1).standard_normal((2, 68))
    y = {"mu": 18 + 1.5 * np.sin((at - 200) / 800 * 2 * np.pi) + noise[0], "k": 5 + 0.15 * batches + noise[1]}
    base = tc.Simulator(
        lambda x, p: {"mu": p["mu"] + 0 * x["P"] + 0 * x["T"], "k": p["c"] + 0 * x["P"]},
        [tc.Parameter("mu"), tc.Parameter("c")],
    )
    d = diagnose(base, tc.Recording(x={"T": at, "P": pressure}, y=y, noise=0.1), [])
    told = [row for row in d.symptoms if "share what is left" in row]
    assert d.where[0].driver == "T"
    assert len(told) == 1
    assert "data at one T share what is left of k" in told[0]


# --- terms in a range that another condition of few levels takes the shape from --------------------------------------


def flights(seed, currents, *, strong=0.0, walk=0.0, sd=0.003):
    """Flight times of ions at a few currents: late for strong peaks around one mass, or with a walk of the
    discriminator in a range of masses."""
    mass, current = (v.ravel() for v in np.meshgrid(np.linspace(25, 1000, 40), currents, indexing="ij"))
    t = 0.3 + 2.6 * np.sqrt(mass)
    t += strong * (current == max(currents)) * np.exp(-0.5 * ((mass - 350) / 90) ** 2)
    t += walk * np.log(current) * ((mass > 200) & (mass < 500))
    t += sd * np.random.default_rng(seed).standard_normal(len(t))
    base = tc.Simulator(
        lambda x, p: p["t0"] + p["a"] * torch.sqrt(x["m"]),
        [tc.Parameter("t0", initial=0.2), tc.Parameter("a", initial=2.5)],
    )
    terms = [
        tc.Term("walk", outputs={"y": lambda x, p, y: y + p["w"] * torch.log(x["I"])}, parameters=[tc.Parameter("w")]),
        tc.Term("space charge", shifts={"a": lambda x, p: p["a"] * p["c"] * x["I"]}, parameters=[tc.Parameter("c")]),
    ]
    return base, tc.Recording(x={"m": mass, "I": current}, y=t, noise=sd), terms


@pytest.mark.slow
def test_a_term_in_a_range_is_no_name_where_two_levels_alone_show_its_shape():
    d = diagnose(*flights(1, [1.0, 4.0], strong=0.02))
    assert d.verdict == "ambiguous"
    assert list(NONE) in d.tied
    (row,) = [row for row in d.ranking if row.terms == NONE]
    assert re.match(r"a change of a where I = 4 and \d+.* < m < \d+", row.note)
    assert re.search(r"jumps with m \(at [^)]*\) where I = 4: one constant change in between", " ".join(str(d).split()))
    true = diagnose(*flights(1, [1.0, 4.0], walk=0.01))
    assert true.verdict == "ambiguous"
    assert true.tied[0] == ["walk"]
    assert "in a range of m would do nearly as well" in true.settings["doubt"]


@pytest.mark.slow
def test_a_term_in_a_range_is_named_where_more_levels_show_its_shape():
    for seed in range(2):
        d = diagnose(*flights(seed, [1.0, 2.0, 4.0, 8.0], walk=0.01))
        assert (d.verdict, d.terms) == ("named", ["walk"])
        assert diagnose(*flights(seed, [1.0, 2.0, 4.0, 8.0], strong=0.02)).verdict == "unexplained"


@pytest.mark.slow
def test_a_missing_rate_is_not_told_as_large_as_what_the_parameters_of_the_base_make_up_for():
    """Of a capacitor that leaks into a second one: a rate in proportion to the voltage is the base's own."""
    t = np.concatenate([[0.0], np.geomspace(20, 2e5, 50)])
    base = tc.ODESimulator(
        lambda t, s, p, u: {"v": -s["v"] / p["tau"]},
        {"v": "V"},
        [tc.Parameter("tau", unit="s", low=1.0, high=1e11, initial=5e5, transform="log")],
    )

    def rates(_, y):
        return [-y[0] / 250000 - 2e-6 - 2.5e-5 * (y[0] - y[1]), (y[0] - y[1]) / 8000]

    generator, runs = np.random.default_rng(262), []
    for begin in (2.7, 1.8, 1.0):
        v = solve_ivp(rates, (0, 2e5), [begin, 0.0], t_eval=t, method="LSODA", rtol=1e-9, atol=1e-12, max_step=2000).y
        runs.append(tc.Run(time=t, outputs={"v": v[0] + 0.006 * generator.normal(size=51)}))
    constant = tc.Term("leak", equation="v", rate=lambda t, s, p, u: -p["i"], parameters=[tc.Parameter("i", low=0.0)])
    found = tc.diagnose(base, tc.Recording(runs=runs), [constant], seed=0, progress=False)
    assert found.verdict == "unexplained"
    assert (found.missing.kind, found.missing.driver) == ("equation", "v")
    assert float(found.missing.rate.max() - found.missing.rate.min()) < 3e-4  # it is 7e-5, and was told as 1.3e-3


def test_a_change_that_the_base_makes_up_for_nearly_all_of_is_not_told_as_rounding():
    """At two values of a condition a line makes up for any change, but for what differs at equal values."""
    z = torch.tensor([0.0, 1.0] * 30, dtype=torch.float64)
    generator = np.random.default_rng(0)
    ripple = torch.as_tensor(generator.uniform(size=60))
    y = 5 + 2 * z + 0.005 * torch.as_tensor(generator.standard_normal(60))
    base = tc.Simulator(
        lambda x, p: (p["a"] + p["b"] * x["z"]) * (1 + 0.02 * ripple.to(x["z"])), [tc.Parameter("a"), tc.Parameter("b")]
    )
    found = tc.diagnose(
        base, tc.Recording(x={"z": z}, y=y, noise=0.005), [], seed=0, progress=False, holdout=False
    )  # fmt: skip
    assert found.verdict == "unexplained"
    assert found.missing is None or float(found.missing.rate.max() - found.missing.rate.min()) > 1e-3
