"""`diagnose`: the code of the design, the four verdicts on small cases, and what is refused."""

import dataclasses
import math
import types
import warnings

import matplotlib.figure
import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.fits.candidates import prepare
from torchcal.discovery.fits.fitting import fit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.starts import starts
from torchcal.discovery.hypotheses.verify import within
from torchcal.discovery.records import (
    Estimate,
    Experiment,
    Fit,
    Hypothesis,
    Limit,
    Location,
    MissingRate,
    NeededShift,
    NoiseModel,
    Score,
    Scores,
    Table,
)
from torchcal.simulators import Trajectories
from torchcal.terms import extend

F64 = torch.float64


def draw(n, sd, seed, phi=0.0):
    e = torch.randn(n, generator=torch.Generator().manual_seed(seed), dtype=F64)
    for k in range(1, n):
        e[k] = phi * e[k - 1] + math.sqrt(1 - phi**2) * e[k]
    return sd * e


def simulate(simulator, runs, **values):
    """Outputs by name, with steps eight times shorter than the tool begins with. A dot in a name is written __."""
    values = {name.replace("__", "."): value for name, value in values.items()}
    recording = tc.Recording(runs=runs)
    bound = Trajectories(simulator, recording, subdivide=8)
    row = torch.tensor([[values[q.name] for q in bound.parameters]], dtype=F64)
    return recording.split(bound.linearise(recording.x, row, recording.outputs, []).y[0])


def quiet(*args, **options):
    return tc.diagnose(*args, **{"seed": 0, "progress": False, **options})


def named(terms, *names):
    return [next(term for term in terms if term.name == name) for name in names]


of_two_or_three = pytest.mark.parametrize(
    "among",
    [("quadratic drag", "bias force"),
     pytest.param(("quadratic drag", "cubic stiffness", "bias force"), marks=pytest.mark.slow)],
)  # fmt: skip


def estimate_of(d, name):
    return next(e for e in d.final.estimates if e.name == name)


# --- the code of the design, as written ---------------------------------------------------------------------


def oscillator():
    return tc.ODESimulator(
        rates=lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]},
        states={"x": "m", "v": "m/s"},
        parameters=[tc.Parameter("k", unit="1/s^2", low=0.0, initial=4.0),
                    tc.Parameter("c", unit="1/s", low=0.0, initial=0.1)],
        observe=("x",),
    )  # fmt: skip


GUST = tc.Term(
    "wind gust",
    equation="v",
    rate=lambda t, s, p, u: p["g"] * torch.exp(-(((t - p["t0"]) / 0.5) ** 2)),
    parameters=[tc.Parameter("g", unit="m/s^2"), tc.Parameter("t0", unit="s", low=0.0, high=10.0)],
)


@pytest.fixture(scope="module")
def windy():
    """An oscillator hit by a gust at t = 5, and all candidates of the design."""
    body = oscillator()
    t = torch.linspace(0, 10, 81, dtype=F64)
    f = 0.5 * torch.sin(1.3 * t)

    def run(x):
        return tc.Run(time=t, outputs={"x": x}, inputs={"f": f}, initial={"x": 0.0})

    x = simulate(tc.terms.extend(body, [GUST]), [run(torch.zeros(81))],
                 **{"k": 4.2, "c": 0.15, "wind gust.g": 1.0, "wind gust.t0": 5.0, "v(0)": 1.0})["x"]  # fmt: skip
    motion = tc.Recording(runs=[run(x + draw(81, 0.01, 2))])
    candidates = [GUST, *tc.terms.mechanics(position="x", velocity="v"), *tc.terms.sensor(outputs=("x",))]
    return body, motion, candidates, tc.diagnose(body, motion, candidates, seed=0)


def all_of(values, kind):
    return isinstance(values, list) and all(isinstance(value, kind) for value in values)


def check_types(d):
    """Every attribute that the design and the documentation name."""
    assert d.verdict in ("consistent", "named", "ambiguous", "unexplained")
    assert all_of(d.terms, str)
    assert all_of(d.tied, list)
    assert all(all_of(tied, str) for tied in d.tied)
    for table, kind in ((d.where, Location), (d.ranking, Hypothesis), (d.detection_limit, Limit)):
        assert isinstance(table, Table)
        assert all_of(table, kind)
        assert isinstance(str(table), str)
        assert set(table.columns) <= {f.name for f in dataclasses.fields(kind)}
    assert isinstance(d.remaining, float)
    assert 0.0 <= d.remaining <= 1.0
    for scores in (d.before, d.after):
        assert scores is None or isinstance(scores, Scores)
        if scores is not None:
            assert isinstance(scores.fitted, Score)
            assert scores.held_out is None or isinstance(scores.held_out, Score)
            assert scores.fitted.n > 0
            assert 0.0 <= scores.fitted.coverage <= 1.0
    assert isinstance(d.before, Scores)
    assert isinstance(d.improved, tc.Simulator)
    assert all_of(d.symptoms, str)
    assert isinstance(d.noise, NoiseModel)
    assert set(d.noise.sd) == set(d.recording.outputs)
    for fitted in (d.base, d.final):
        assert isinstance(fitted, Fit)
        assert all(isinstance(e, Estimate) for e in fitted.estimates)
        for values in (fitted.prediction, fitted.residual):
            assert values.dtype == F64
            assert values.shape == d.recording.y.shape
            assert not values.requires_grad
        both = d.recording.observed
        torch.testing.assert_close((fitted.prediction + fitted.residual)[both], d.recording.y[both])
    assert all_of(d.shifts, NeededShift)
    assert d.missing is None or isinstance(d.missing, MissingRate)
    assert d.experiment is None or isinstance(d.experiment, Experiment)
    assert all_of(d.equations, str)
    assert all_of(d.identifiability, str)
    assert d.held_out is None or (d.held_out.dtype == torch.bool and d.held_out.shape == d.recording.y.shape)
    assert 0.0 < d.p_detect <= 1.0
    assert d.confidence == 0.99
    assert all_of(d.library, str)
    assert isinstance(d.settings["seed"], int)
    assert d.seconds > 0
    assert math.isclose(sum(row.probability for row in d.ranking), 1.0, abs_tol=1e-6)
    assert [row.probability for row in d.ranking] == sorted((row.probability for row in d.ranking), reverse=True)


def test_the_design_in_time(windy, tmp_path):
    body, motion, candidates, d = windy
    check_types(d)
    assert d.verdict == "named"
    assert d.terms == ["wind gust"]
    assert d.library == [term.name for term in candidates]
    assert d.simulator is body
    assert d.recording is motion
    assert d.remaining < 0.05
    assert estimate_of(d, "wind gust.g").value == pytest.approx(1.0, abs=0.1)
    assert estimate_of(d, "wind gust.t0").value == pytest.approx(5.0, abs=0.1)
    assert d.after.held_out.rmse < 0.7 * d.before.held_out.rmse
    assert d.after.held_out.n == d.before.held_out.n == int(d.held_out.sum())
    assert d.after.model_error_sd < 0.1 * d.before.model_error_sd
    text = str(d)
    assert "wind gust" in text.splitlines()[0]
    assert "wind gust.g = " in text
    assert "wind gust" in d.equations[0]
    assert d.improved.names == ("k", "c", "wind gust.g", "wind gust.t0")
    # It begins at the final estimates of all its parameters: at others it may stay where the term does nothing.
    assert [q.initial for q in d.improved.parameters] == [estimate_of(d, name).value for name in d.improved.names]
    assert isinstance(d.plot(), matplotlib.figure.Figure)
    path = tmp_path / "report.html"
    d.report(path)
    page = path.read_text(encoding="utf-8")
    assert "wind gust" in page
    assert "<img" in page or "<svg" in page
    assert 'src="http' not in page


def test_an_end_that_nothing_before_it_foretells_is_not_held_out():
    """A diode's knee: three quarters of the characteristic say nothing about the last."""
    optimize = pytest.importorskip("scipy.optimize")
    x = torch.linspace(0, 1, 100, dtype=torch.float64)
    diode = tc.Simulator(
        lambda x, p: p["a"] - 1e-7 * p["b"] * torch.exp(x / p["c"]),
        [tc.Parameter("a", initial=1.0), tc.Parameter("b", low=0.0, initial=1.0),
         tc.Parameter("c", low=0.04, high=0.1, initial=0.06)],
    )  # fmt: skip
    noise = 0.02 * torch.randn(100, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    y = 1 - 1e-7 * torch.exp(x / 0.06) - 0.4 * x.square() + noise
    shunt = tc.Term("shunt", outputs={"y": lambda x, p, y: y - p["g"] * x.square()}, parameters=[tc.Parameter("g")])
    recording = tc.Recording(x=x, y=y, noise=0.02)
    d = quiet(diode, recording, [shunt])
    assert d.terms == ["shunt"]
    blocks = torch.arange(100).tensor_split(12)
    assert d.held_out.nonzero()[:, 0].tolist() == [i for k in (1, 5, 9) for i in blocks[k].tolist()]
    apart = optimize.least_squares(
        lambda p: (p[0] - 1e-7 * p[1] * torch.exp(x / p[2]) - y)[~d.held_out].numpy(),
        [1.0, 1.0, 0.06], x_scale=[1.0, 1.0, 0.01], bounds=([-10, 0, 0.04], [10, 1e6, 0.1]),
    ).x  # fmt: skip
    left = (apart[0] - 1e-7 * apart[1] * torch.exp(x / apart[2]) - y)[d.held_out]
    assert d.before.held_out.rmse == pytest.approx(float(left.square().mean().sqrt()), rel=0.05)
    assert d.after.held_out.rmse < 0.03 < d.before.held_out.rmse
    # Asked for, it is held out all the same.
    assert bool(quiet(diode, recording, [shunt], holdout=0.25).held_out[-1])


def test_blocks_within_short_and_gappy_runs():
    t = torch.arange(48, dtype=torch.float64)
    y = torch.full((48,), math.nan, dtype=torch.float64)
    y[::4] = 1.0
    short = tc.Run(time=t[:6], outputs={"z": t[:6]})
    gappy = tc.Run(time=t, outputs={"z": y})
    mask = within(tc.Recording(runs=[short, gappy], missing=True))
    assert mask[:6].nonzero()[:, 0].tolist() == [1]
    assert (mask[6:].nonzero()[:, 0] // 4).tolist() == [1, 5, 9]


def test_a_parameter_that_changes_in_time_is_a_missing_rate_of_its_equation():
    """A spring whose stiffness swings faster than a dozen curves in time could follow."""
    t = torch.linspace(0, 20, 300, dtype=torch.float64)
    body = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"]},
        {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, initial=4.0), tc.Parameter("c", low=0.0, initial=0.1)],
        observe=("x",),
    )
    swing = tc.Term("swing", shifts={"k": lambda t, s, p, u: p["a"] * torch.sin(1.3 * t)},
                    parameters=[tc.Parameter("a")])  # fmt: skip
    start = {"x": 1.0, "v": 0.0}
    blank = [tc.Run(time=t, outputs={"x": 0 * t}, initial=start)]
    x = simulate(extend(body, [swing]), blank, k=4.0, c=0.05, swing__a=0.3)["x"]
    motion = tc.Recording(runs=[tc.Run(time=t, outputs={"x": x + draw(300, 0.01, 0)}, initial=start)], noise=0.01)
    d = quiet(body, motion, [])
    assert d.verdict == "unexplained"
    assert (d.missing.kind, d.missing.target, d.missing.unit) == ("equation", "v", "m/s/[time]")
    there = np.interp(d.missing.time, t, x)
    wanted = torch.as_tensor(-0.3 * np.sin(1.3 * d.missing.time.numpy()) * there)
    assert float((d.missing.along - wanted).norm() / wanted.norm()) < 0.5


def test_improved_is_a_simulator_like_any_other(windy):
    _, motion, candidates, d = windy
    fit = tc.calibrate(
        d.improved, motion, embedding=tc.embeddings.PolynomialChaos(parameters=("k",)),
        likelihood=tc.likelihoods.ABC(epsilon=0.1), num_samples=0, num_starts=4, seed=0,
    )  # fmt: skip
    assert fit.predict(motion.x).mean.shape == motion.y.shape
    again = quiet(d.improved, motion, [GUST, *named(candidates, "bias force", "offset of x")])
    assert again.verdict == "consistent"
    assert again.terms == []
    row = next(row for row in again.detection_limit if row.term == "wind gust")
    assert row.note == "already in the base model"
    assert math.isinf(row.smallest)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_diagnosis():
    body, motion, candidates = pushed(0.05)
    candidates = candidates[-2:]
    first, second = (quiet(body, motion, candidates, seed=3) for _ in range(2))
    assert str(first.ranking) == str(second.ranking)
    assert torch.equal(first.final.prediction, second.final.prediction)
    state = torch.random.get_rng_state()
    quiet(body, motion, candidates)
    assert torch.equal(state, torch.random.get_rng_state())


def ignition(shift=None):
    """ln τ of a one-step mechanism: dormant reaction orders and temperature exponent."""

    def f(x, p):
        heat = p["E"] / (1.987 * x["T0"]) - p["n"] * torch.log(x["T0"] / 1150.0)
        return heat - p["lnA"] - (p["fuel_order"] - 1.0) * torch.log(x["phi"]) - 0.2 * (p["air_order"] - 1.0)

    simulator = tc.Simulator(f, parameters=[
        tc.Parameter("lnA", low=10.0, high=36.0), tc.Parameter("E", unit="cal/mol", low=26315.5, high=56954.0),
        tc.Parameter("fuel_order", neutral=1.0, low=-2.0, high=3.0),
        tc.Parameter("air_order", neutral=1.0, low=-2.0, high=3.0),
        tc.Parameter("n", neutral=0.0, low=-12.0, high=12.0),
    ])  # fmt: skip
    T0, phi = torch.meshgrid(
        torch.linspace(1000, 1300, 8, dtype=F64), torch.linspace(0.5, 2, 6, dtype=F64), indexing="ij"
    )
    x = {"T0": T0.flatten(), "phi": phi.flatten()}
    p = {"lnA": 20.0, "E": 43000.0, "fuel_order": -0.3, "air_order": 1.0, "n": 0.0}
    y = f(x, {name: torch.tensor(value, dtype=F64) for name, value in p.items()})
    return simulator, x, y if shift is None else y + shift(x)


ORDERS = [tc.Term("fuel reaction order", frees=("fuel_order",)), tc.Term("air reaction order", frees=("air_order",)),
          tc.Term("temperature exponent", frees=("n",))]  # fmt: skip


def test_the_design_without_time(tmp_path):
    simulator, x, y = ignition(lambda x: 0.003 * torch.sin(x["T0"] / 20))
    delays = tc.Recording(x=x, y=y, noise="none")
    d = quiet(simulator, delays, ORDERS)
    check_types(d)
    assert d.verdict == "named"
    assert d.terms == ["fuel reaction order"]
    assert d.noise.source == "none"
    assert estimate_of(d, "fuel_order").value == pytest.approx(-0.3, abs=0.02)
    assert d.where[0].driver == "phi"
    assert d.remaining < 0.01
    assert next(r for r in d.detection_limit if r.term == "air reaction order").note == "already in the base model"
    d.report(tmp_path / "ignition.html")
    assert isinstance(d.plot(), matplotlib.figure.Figure)
    fit = tc.calibrate(
        d.improved, delays, embedding=tc.embeddings.IndependentGaussian(),
        likelihood=tc.likelihoods.ABC(epsilon=0.1), num_samples=0, num_starts=4, seed=0,
    )  # fmt: skip
    assert fit.map.mean.shape == (3,)


def test_a_parameter_that_depends_on_a_condition():
    simulator, x, y = ignition()
    term = tc.Term("composition-dependent rate", shifts={"lnA": lambda x, p: p["m"] * torch.log(x["phi"])},
                   parameters=[tc.Parameter("m")])  # fmt: skip
    rival = tc.Term("temperature-dependent rate", shifts={"lnA": lambda x, p: p["m"] * (x["T0"] / 1150.0) ** 2},
                    parameters=[tc.Parameter("m")])  # fmt: skip
    d = quiet(simulator, tc.Recording(x=x, y=y + draw(48, 0.02, 1), noise=0.02), [rival, term])
    assert d.verdict == "named"
    assert d.terms == ["composition-dependent rate"]
    assert estimate_of(d, "composition-dependent rate.m").value == pytest.approx(-1.3, abs=0.05)


# --- verdicts: mechanics ------------------------------------------------------------------------------------

NAMES = ("linear drag", "quadratic drag", "quadratic stiffness", "cubic stiffness", "position-dependent damping",
         "bias force")  # fmt: skip
T = torch.linspace(0, 15, 101, dtype=F64)
FORCE = 0.8 * torch.sin(0.9 * T)


def run_of(x, t=T, f=FORCE, **more):
    return tc.Run(time=t, outputs={"x": x}, inputs={"f": f}, initial=more.pop("initial", {"x": 1.0, "v": 0.0}), **more)


def spring(terms, *, noise=0.02, seed=11, phi=0.0, **values):
    """A driven spring with some terms, recorded with noise; base, clean outputs and noisy ones."""
    body = oscillator()
    whole = tc.terms.extend(body, terms)
    clean = simulate(whole, [run_of(torch.zeros_like(T))], k=2.0, c=0.2, **values)["x"]
    return body, clean, clean + draw(len(T), noise, seed, phi)


def pushed(b, **options):
    """With a bias force."""
    library = named(tc.terms.mechanics(), *NAMES)
    body, _, x = spring(named(library, "bias force"), **{"bias force__b": b}, **options)
    return body, tc.Recording(runs=[run_of(x)], noise=0.02), library


@pytest.mark.slow
@pytest.mark.parametrize("among", [("quadratic drag", "bias force"), NAMES])
def test_a_large_effect_is_named(among):
    body, motion, library = pushed(0.08)
    d = quiet(body, motion, named(library, *among))
    check_types(d)
    assert d.verdict == "named"
    assert d.terms == ["bias force"]
    b = estimate_of(d, "bias force.b")
    assert abs(b.value - 0.08) < 5 * b.sd
    assert b.sd < 0.01
    assert b.unit == "m/s^2"
    assert d.remaining < 0.05
    assert d.p_detect < 0.01
    assert d.after.fitted.rmse == pytest.approx(0.02, rel=0.25)
    assert d.before.fitted.rmse > 1.5 * d.after.fitted.rmse
    # Coverage of a 95 % interval: within five binomial standard errors.
    assert d.after.fitted.coverage == pytest.approx(0.95, abs=5 * math.sqrt(0.95 * 0.05 / 101))
    assert "dv/dt ∋ b" in d.equations[0]
    top = d.ranking[0]
    assert top.terms == ("bias force",)
    assert top.refitted
    assert top.physical
    assert top.misfit_removed > 0.95
    assert top.held_out_rmse == pytest.approx(d.after.held_out.rmse)
    assert {row.terms for row in d.ranking} >= {(), ("none of these",)}


def test_nothing_is_named_where_nothing_is_missing():
    d = quiet(*pushed(0.0))
    check_types(d)
    assert d.verdict == "consistent"
    assert d.terms == d.tied == d.equations == d.shifts == []
    assert d.missing is None
    assert d.experiment is None
    assert d.improved is d.simulator
    assert d.final.terms == ()
    limits = {row.term: row for row in d.detection_limit}
    assert set(limits) == set(NAMES)
    assert math.isinf(limits["linear drag"].smallest)
    assert limits["linear drag"].note == "already in the base model"
    for name in set(NAMES) - {"linear drag"}:
        assert 0 < limits[name].smallest < math.inf
        assert limits[name].power == 0.95
    assert "smallest effects" in " ".join(str(d).split())
    assert "linear drag cannot be told from the parameters of the base" in d.identifiability


@pytest.mark.slow
def test_a_planted_effect_above_its_limit_is_found():
    limit = next(r for r in quiet(*pushed(0.0)).detection_limit if r.term == "bias force").smallest
    d = quiet(*pushed(2.0 * limit, seed=12))
    assert d.verdict == "named"
    assert d.terms == ["bias force"]


@pytest.mark.parametrize("noise", [pytest.param(None, marks=pytest.mark.slow), "none"])
def test_named_whatever_is_known_of_the_noise(noise):
    body, motion, library = pushed(0.08, noise=0.0001 if noise == "none" else 0.02)
    d = quiet(body, tc.Recording(runs=motion.runs, noise=noise), library[-2:])
    assert d.verdict == "named"
    assert d.terms == ["bias force"]
    assert d.noise.source == ("estimated" if noise is None else "none")


def test_a_recording_without_noise_of_the_base_is_consistent():
    body, clean, _ = spring([])
    d = quiet(body, tc.Recording(runs=[run_of(clean)], noise="none"), named(tc.terms.mechanics(), *NAMES))
    assert d.verdict == "consistent"


@pytest.fixture(scope="module")
def softening():
    """A spring that softens, and its diagnosis. At |x| < 1 a large-angle sine does: x - sin x ≈ x³/6."""
    library = named(tc.terms.mechanics(), "quadratic drag", "cubic stiffness", "large-angle sine", "bias force")
    body, _, x = spring(named(library, "large-angle sine"), noise=0.01, **{"large-angle sine__k": 1.0})
    return body, x, library, quiet(body, tc.Recording(runs=[run_of(x)], noise=0.01), library)


def test_two_that_cannot_be_told_apart_are_both_listed(softening):
    body, _, _, d = softening
    check_types(d)
    assert d.verdict == "ambiguous"
    assert d.terms == []
    assert ["large-angle sine"] in d.tied
    assert ["cubic stiffness"] in d.tied
    assert d.improved is body
    assert isinstance(d.experiment, Experiment)
    assert d.experiment.separation > 0
    assert d.experiment.description
    assert set(d.experiment.conditions) == {"time", "initial", "inputs"}
    assert " or " in str(d).splitlines()[0]
    assert d.experiment.description in " ".join(str(d).split())


def test_the_proposed_experiment_tells_the_tied_apart(softening):
    body, x, library, tied = softening
    truth = tc.terms.extend(oscillator(), named(library, "large-angle sine"))
    values = {"k": 2.0, "c": 0.2, "large-angle sine.k": 1.0}
    first, c = run_of(x), tied.experiment.conditions
    t = c["time"]
    values |= {f"{name}(0)": 0.0 for name in ("x", "v") if name not in c["initial"]}

    def run(x):
        return tc.Run(t, outputs={"x": x}, inputs=c["inputs"], initial=c["initial"])

    y = simulate(truth, [run(torch.zeros_like(t))], **values)["x"] + draw(len(t), 0.01, 77)
    told = named(library, "cubic stiffness", "large-angle sine")
    d = quiet(body, tc.Recording(runs=[first, run(y)], noise=0.01), told)
    assert d.verdict == "named"
    assert d.terms == ["large-angle sine"]


@of_two_or_three
def test_an_effect_outside_the_library_is_unexplained(among):
    library = named(tc.terms.mechanics(), *among)
    outside = tc.Term(
        "pulses",
        equation="v",
        rate=lambda t, s, p, u: p["a"] * torch.sin(2.3 * t) * torch.exp(-(((t - 7.0) / 2.5) ** 2)),
        parameters=[tc.Parameter("a")],
    )
    body, _, x = spring([outside], pulses__a=0.8)
    d = quiet(body, tc.Recording(runs=[run_of(x)], noise=0.02), library)
    check_types(d)
    assert d.verdict == "unexplained"
    assert d.terms == []
    assert d.improved is body
    assert d.remaining > 0.2
    assert isinstance(d.missing, MissingRate)
    assert bool((d.missing.values.diff() >= 0).all())
    assert 0 < d.missing.share <= 1
    assert d.missing.rate.shape == d.missing.sd.shape == d.missing.values.shape
    assert d.where[0].share > 0.3
    assert "not in this library" in str(d).splitlines()[0]
    assert d.ranking[0].terms == ("none of these",)
    assert d.p_detect < 0.01


@pytest.mark.parametrize(
    "among",
    [("quadratic drag", "position-dependent damping", "bias force"), pytest.param(NAMES, marks=pytest.mark.slow)],
)
def test_two_missing_terms_are_both_named(among):
    library = named(tc.terms.mechanics(), *among)
    body, _, x = spring(named(library, "bias force", "position-dependent damping"), noise=0.01,
                        **{"bias force__b": 0.15, "position-dependent damping__c": 0.5})  # fmt: skip
    d = quiet(body, tc.Recording(runs=[run_of(x)], noise=0.01), library)
    assert d.verdict == "named"
    assert sorted(d.terms) == ["bias force", "position-dependent damping"]
    assert len(d.equations) == 2
    assert estimate_of(d, "bias force.b").value == pytest.approx(0.15, abs=0.03)
    assert estimate_of(d, "position-dependent damping.c").value == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow
def test_one_term_at_most_where_asked():
    library = named(tc.terms.mechanics(), "bias force", "position-dependent damping")
    body, _, x = spring(named(library, "bias force", "position-dependent damping"), noise=0.01,
                        **{"bias force__b": 0.15, "position-dependent damping__c": 0.5})  # fmt: skip
    d = quiet(body, tc.Recording(runs=[run_of(x)], noise=0.01), library, max_terms=1)
    assert all(len(row.terms) <= 1 for row in d.ranking)
    assert len(d.terms) <= 1


@of_two_or_three
def test_an_effect_in_a_region_is_found_there(among):
    library = named(tc.terms.mechanics(), *among)
    gate = tc.Term(
        "gated",
        equation="v",
        parameters=[tc.Parameter("b")],
        rate=lambda t, s, p, u: p["b"] * torch.sigmoid((t - 6.0) / 0.1) * torch.sigmoid((10.0 - t) / 0.1),
    )
    body, _, x = spring([gate], seed=34, gated__b=0.3)
    d = quiet(body, tc.Recording(runs=[run_of(x)], noise=0.02), library)
    assert d.verdict == "named"
    assert d.terms == ["bias force"]
    assert d.where[0].driver == "t"
    assert d.where[0].kind == "equation"
    assert d.where[0].target == "v"
    ((low, high),) = d.where[0].spans
    assert low == pytest.approx(6.0, abs=0.4)
    assert high == pytest.approx(10.0, abs=0.4)
    assert d.ranking[0].region is not None
    assert "where" in str(d).splitlines()[0]
    # The improved simulator carries the region and begins at the estimates.
    assert [q.name for q in d.improved.parameters] == [
        "k", "c", "bias force.b", "bias force.window from", "bias force.window to", "bias force.window edge"
    ]  # fmt: skip
    assert d.improved.parameters[3].initial == pytest.approx(low)


@pytest.mark.slow
def test_a_faulty_sensor_is_named():
    library = [*named(tc.terms.mechanics(), "quadratic drag", "bias force", "cubic stiffness"),
               *named(tc.terms.sensor(("x",)), "offset of x", "drift of x", "saturation of x")]  # fmt: skip
    body, _, x = spring(named(library, "drift of x"), **{"drift of x__b": 0.01})
    d = quiet(body, tc.Recording(runs=[run_of(x)], noise=0.02), library)
    assert d.verdict == "named"
    assert d.terms == ["drift of x"]
    assert d.where[0].kind == "output"


@pytest.mark.slow
def test_a_hidden_state_is_named():
    library = named(tc.terms.mechanics(), "quadratic drag", "cubic stiffness", "bias force", "viscoelastic branch")
    planted = {"viscoelastic branch__k": 0.8, "viscoelastic branch__tau": 1.5, "viscoelastic branch__start": 0.0}
    body, _, x = spring(named(library, "viscoelastic branch"), **planted)
    d = quiet(body, tc.Recording(runs=[run_of(x)], noise=0.02), library)
    assert d.verdict == "named"
    assert d.terms == ["viscoelastic branch"]
    assert len(d.improved.states) == 3


@pytest.mark.slow
def test_two_causes_with_one_formula_are_tied():
    first, *rest = named(tc.terms.mechanics(), "bias force", "quadratic drag", "cubic stiffness")
    tilt = tc.Term("tilt", equation="v", rate=lambda t, s, p, u: -9.81 * p["slope"], parameters=[tc.Parameter("slope")])
    body, motion, _ = pushed(0.1)
    for candidates in ([first, *rest, tilt], [tilt, first, *rest]):
        d = quiet(body, motion, candidates)
        one, other = (term.name for term in candidates if term in (first, tilt))
        assert (d.verdict, d.terms, d.tied) == ("ambiguous", [], [[one], [other]])
        rows = {row.terms: row for row in d.ranking}
        assert rows[one,].aliases == (other,)
        assert rows[other,].note == f"the same as {one} here"
        assert rows[one,].probability == rows[other,].probability > 0.3
        assert next(r for r in d.detection_limit if r.term == one).note == f"also: {other}"
        assert d.experiment is None  # nothing would tell them apart


@pytest.mark.slow
def test_equal_tangents_are_not_equal_models():
    # Stern and Volmer's quenching and Perrin's sphere of action agree to first order, wherever they are measured.
    q = torch.linspace(0, 2, 40, dtype=F64)
    laws = {
        "dynamic quenching": lambda x, p, y: y / (1 + p["k"] * x),
        "sphere of action": lambda x, p, y: y * torch.exp(-p["k"] * x),
        "dimer loss": lambda x, p, y: y * (1 - p["k"] * x),
    }
    lamp = tc.Simulator(lambda x, p: p["F"] + 0 * x, [tc.Parameter("F", low=0.1, high=10.0, initial=1.0)])
    noise = 0.005 * torch.randn(40, generator=torch.Generator().manual_seed(4), dtype=F64)
    for size, verdict in ((0.05, "ambiguous"), (0.5, "named")):
        light = tc.Recording(x=q, y=torch.exp(-size * q) + noise, noise=0.005)
        for order in (laws, dict(reversed(laws.items()))):
            terms = [tc.Term(name, outputs={"y": law}, parameters=[tc.Parameter("k", low=0.0)])
                     for name, law in order.items()]  # fmt: skip
            d = quiet(lamp, light, terms)
            assert d.verdict == verdict
            assert ["sphere of action"] in [*d.tied, d.terms]


def test_other_physics_with_the_same_tangent_is_told_as_ambiguous():
    # Where a straight line is calibrated, parabolas about any centre are the same.
    simulator, x, y, terms = parabola(0.3)
    about = tc.Term("curvature about -3", outputs={"y": lambda x, p, y: y + p["q"] * (x + 3.0) ** 2},
                    parameters=[tc.Parameter("q")])  # fmt: skip
    d = quiet(simulator, tc.Recording(x=x, y=y, noise=0.1), [terms[0], about])
    assert d.verdict == "ambiguous"
    assert d.tied == [["curvature"], ["curvature about -3"]]
    assert d.terms == []
    assert d.ranking[0].aliases == ("curvature about -3",)
    assert d.experiment is None  # beside a line parabolas about any centre are the same


def test_what_the_base_holds_already_is_never_named():
    library = named(tc.terms.mechanics(), "linear drag", "linear spring", "bias force")
    both = named(library, "linear drag", "linear spring")
    body, _, x = spring(both, **{"linear drag__c": 0.3, "linear spring__k": 0.5})
    d = quiet(body, tc.Recording(runs=[run_of(x)], noise=0.02), library)
    assert d.verdict == "consistent"
    for name in ("linear drag", "linear spring"):
        assert next(r for r in d.detection_limit if r.term == name).note == "already in the base model"
        assert next(r for r in d.ranking if r.terms == (name,)).note == "already in the base model"


@pytest.mark.slow
@pytest.mark.parametrize(("truth", "bounds"), [(-0.2, {"low": 0.0}), (0.2, {"high": 0.0})])
def test_an_estimate_that_wants_to_cross_its_bound_is_not_named(truth, bounds):
    # Only hardening, or only softening, is allowed, and it is what the spring does not do.
    def term(**bounds):
        return tc.Term("cubic", equation="v", rate=lambda t, s, p, u: -p["k"] * s["x"] ** 3,
                       parameters=[tc.Parameter("k", **bounds)])  # fmt: skip

    body, _, x = spring([term()], noise=0.01, seed=12, cubic__k=truth)
    motion = tc.Recording(runs=[run_of(x)], noise=0.01)
    assert quiet(body, motion, [term()]).terms == ["cubic"]
    d = quiet(body, motion, [term(**bounds)])
    assert d.verdict == "unexplained"
    assert d.terms == []
    row = next(r for r in d.ranking if r.terms == ("cubic",) and r.region is None)
    assert not row.physical
    assert row.note
    assert row.estimates[0].at_bound


def test_a_hold_out_is_chosen_before_the_fit():
    simulator, x, y, terms = parabola(0.3)
    case = (simulator, tc.Recording(x=x, y=y, noise=0.1), terms[:1])
    d = quiet(*case)
    assert d.held_out.tolist() == [False] * 45 + [True] * 15
    none = quiet(*case, holdout=False)
    assert none.held_out is None
    assert none.before.held_out is None
    assert none.after.held_out is None
    assert none.terms == ["curvature"]
    share = quiet(*case, holdout=0.5)
    assert int(share.held_out.sum()) == 30
    mask = torch.zeros(60, dtype=torch.bool)
    mask[::5] = True
    own = quiet(*case, holdout=mask)
    assert torch.equal(own.held_out, mask)
    assert own.after.held_out.n == int(mask.sum())
    assert own.after.held_out.rmse == pytest.approx(0.1, rel=0.6)
    # The final estimates use all data.
    assert estimate_of(none, "curvature.q").value == pytest.approx(estimate_of(own, "curvature.q").value, rel=1e-6)


@pytest.mark.parametrize(("bounds", "most"), [({}, math.inf), ({"low": 1.0, "high": 4.0}, 1.5)])
def test_model_error_in_a_parameter_is_no_wider_than_its_bounds_allow(bounds, most):
    """Between two bounds no density has an sd above half their distance; the likeliest one is about 2.1 here."""
    x = torch.linspace(0, 20, 60, dtype=F64)
    base = tc.Simulator(lambda x, p: p["c"] + p["m"] * x, [tc.Parameter("c", **bounds), tc.Parameter("m")])
    d = quiet(base, tc.Recording(x=x, y=2.5 + x + 3 * torch.sin(2 * x), noise=0.1), [])
    (width,) = [row.sd for row in d.embedded if row.parameter == "c"]
    assert width == pytest.approx(min(most, 3 / math.sqrt(2)), rel=0.08)


def test_a_hold_out_of_numpy_and_lists():
    simulator, x, y, terms = parabola(0.3)
    case = (simulator, tc.Recording(x=x, y=y, noise=0.1), terms[:1])
    mask = [k >= 50 for k in range(60)]
    assert quiet(*case, holdout=mask).held_out.tolist() == mask
    assert quiet(*case, holdout=torch.tensor(mask).numpy()).held_out.tolist() == mask


def several_falls(given: bool) -> tuple[tc.ODESimulator, tc.Recording]:
    t = torch.linspace(0, 2, 21, dtype=F64)
    body = tc.ODESimulator(
        lambda t, s, p, u: {"v": p["g"] - p["k"] * s["v"]},
        {"v": None},
        [tc.Parameter("g", initial=9.0), tc.Parameter("k", low=0.0, initial=0.3)],
    )
    runs = [tc.Run(time=t, outputs={"v": 25 + (v - 25) * torch.exp(-0.4 * t)}, initial={"v": v} if given else {})
            for v in (0.0, 3.0, 6.0)]  # fmt: skip
    return body, tc.Recording(runs=runs, noise={"v": 0.1})


def test_a_run_that_alone_tells_its_initial_state_is_not_held_out():
    body, recording = several_falls(given=False)
    last = recording.x["run"] == 2
    with pytest.raises(tc.errors.DomainError, match=r"^Expected holdout .*only held-out data for 'v.*2"):
        quiet(body, recording, [], holdout=last)
    assert quiet(body, recording, [], holdout=last & (recording.x["time"] > 1)).before.held_out.n == 10
    body, recording = several_falls(given=True)
    assert quiet(body, recording, [], holdout=last).before.held_out.n == 21


def test_an_output_that_alone_tells_a_parameter_is_not_held_out():
    base = tc.Simulator(lambda x, p: {"q": p["a"] * x, "r": p["b"] * x}, [tc.Parameter("a"), tc.Parameter("b")])
    x = torch.linspace(1, 2, 20, dtype=F64)
    recording = tc.Recording(x=x, y={"q": x, "r": 2 * x}, noise={"q": 0.1, "r": 0.1})
    with pytest.raises(tc.errors.DomainError, match="only held-out data for 'b'"):
        quiet(base, recording, [], holdout=torch.arange(40) >= 20)
    with pytest.raises(tc.errors.DomainError, match=r"shape \(20,\) or, one output after another, \(40,\)"):
        quiet(base, recording, [], holdout=torch.ones(20, 2, dtype=torch.bool))


@pytest.mark.parametrize("seed", range(5))
def test_a_threshold_that_the_rest_of_the_data_tells_is_no_reason_to_refuse_a_hold_out(seed):
    """At a wild starting value it lies beyond them; where it is calibrated it does not."""
    x = torch.linspace(0, 10, 60, dtype=F64)
    base = tc.Simulator(
        lambda x, p: p["a"] * x + p["b"] * torch.relu(x - p["x0"]),
        [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("x0", initial=5.0)],
    )
    noise = 0.05 * torch.randn(60, generator=torch.Generator().manual_seed(seed), dtype=F64)
    d = quiet(base, tc.Recording(x=x, y=x + 2 * torch.relu(x - 4) + noise, noise=0.05), [], holdout=x > 7.5, seed=seed)
    assert d.before.held_out.rmse < 0.2


def test_a_name_that_predicts_worse_is_withdrawn(monkeypatch):
    from torchcal.discovery.hypotheses import verify

    monkeypatch.setattr(verify, "compare", lambda *args: (-2.0, 0.5))
    simulator, x, y, terms = parabola(0.3)
    case = (simulator, tc.Recording(x=x, y=y, noise=0.1), terms[:1])
    d = quiet(*case)
    assert d.verdict == "ambiguous"
    assert d.tied == [["curvature"], ["none of these"]]
    assert d.terms == []
    assert "withdrawn" in d.settings["withdrawn"]
    assert "curvature" in d.settings["withdrawn"]
    assert "withdrawn" in str(d)
    monkeypatch.setattr(verify, "compare", lambda *args: (-0.4, 0.5))
    assert quiet(*case).terms == ["curvature"]


@pytest.mark.slow
def test_a_best_explanation_that_is_not_probable_enough_is_no_name(monkeypatch, tmp_path):
    monkeypatch.setattr("torchcal.discovery.verdicts.verdict.SURE", 0.999)
    body, _, x = spring(named(tc.terms.mechanics(), "bias force"), seed=21, **{"bias force__b": 0.3})
    d = quiet(body, tc.Recording(runs=[run_of(x)], noise=0.02), named(tc.terms.mechanics(), "bias force"))
    assert d.verdict == "ambiguous"
    assert d.terms == []
    assert d.tied == [["bias force"], ["none of these"]]
    assert d.experiment is None
    assert "something that is not in this library" in str(d).splitlines()[0]
    assert "too little for a name" in " ".join(str(d).split())
    d.report(tmp_path / "report.html")


@pytest.mark.slow
def test_a_later_term_of_the_same_name_replaces_an_earlier_one():
    body, motion, library = pushed(0.1)
    mine = tc.Term("bias force", equation="v", rate=lambda t, s, p, u: p["mine"], parameters=[tc.Parameter("mine")])
    d = quiet(body, motion, [*library, mine])
    assert d.library.count("bias force") == 1
    assert estimate_of(d, "bias force.mine").value == pytest.approx(0.1, abs=0.03)


def test_held_parameters_are_not_calibrated():
    body, motion, library = pushed(0.1)
    d = quiet(body, motion, library[-1:], fixed={"k": 2.0})
    assert [e.name for e in d.base.estimates] == ["c"]
    assert d.terms == ["bias force"]


def test_no_candidates_at_all():
    body, motion, _ = pushed(0.1)
    d = quiet(body, motion)
    assert d.verdict == "unexplained"
    assert d.library == []
    check_types(d)
    body, motion, _ = pushed(0.0)
    assert quiet(body, motion, []).verdict == "consistent"


def test_one_term_need_not_be_in_a_list():
    simulator, x, y, terms = parabola(0.3)
    assert quiet(simulator, tc.Recording(x=x, y=y, noise=0.1), terms[0]).library == ["curvature"]


# --- recordings as they come --------------------------------------------------------------------------------


@pytest.mark.slow
def test_correlated_noise():
    # A correlation of 0.6 takes much of the power: the effect is large.
    body, motion, library = pushed(0.25, phi=0.6)
    d = quiet(body, tc.Recording(runs=motion.runs), library)
    assert d.terms == ["bias force"]
    b = estimate_of(d, "bias force.b")
    assert abs(b.value - 0.25) < 5 * b.sd


@pytest.mark.slow
def test_outliers_are_set_aside():
    body, motion, library = pushed(0.08)
    library = library[-3:]
    x = motion.y.clone()
    x[[15, 40, 77]] += torch.tensor([0.6, -0.5, 0.8], dtype=F64)
    for noise in (None, 0.02):
        d = quiet(body, tc.Recording(runs=[run_of(x)], noise=noise), library)
        assert d.set_aside.nonzero()[:, 0].tolist() == [15, 40, 77]
        assert d.noise.outliers == 3
        assert d.terms == ["bias force"]
    null = pushed(0.0)[1].y.clone()
    null[[15, 40, 77]] += torch.tensor([0.6, -0.5, 0.8], dtype=F64)
    assert quiet(body, tc.Recording(runs=[run_of(null)], noise=0.02), library).verdict == "consistent"


@pytest.mark.slow
def test_quantised_samples():
    body, motion, library = pushed(0.08)
    library = library[-3:]
    step = 0.05
    d = quiet(body, tc.Recording(runs=[run_of((motion.y / step).round() * step)]), library)
    assert d.noise.quantisation == {"x": pytest.approx(step)}
    assert d.terms == ["bias force"]
    null = (pushed(0.0)[1].y / step).round() * step
    assert quiet(body, tc.Recording(runs=[run_of(null)]), library).verdict == "consistent"


@pytest.mark.slow
def test_missing_samples():
    body, motion, library = pushed(0.08)
    x = motion.y.clone()
    x[20:35] = math.nan
    x[60] = math.nan
    recording = tc.Recording(runs=[run_of(x)], noise=0.02, missing=True)
    d = quiet(body, recording, library)
    check_types(d)
    assert d.terms == ["bias force"]
    assert torch.equal(torch.isnan(d.final.residual), ~recording.observed)
    assert bool(torch.isfinite(d.final.prediction).all())


@pytest.mark.slow
def test_uneven_times():
    body = oscillator()
    library = named(tc.terms.mechanics(), *NAMES)
    gaps = 0.02 + torch.rand(90, generator=torch.Generator().manual_seed(3), dtype=F64) ** 2 * 0.5
    t = torch.cat([torch.zeros(1, dtype=F64), gaps.cumsum(0)])
    f = 0.8 * torch.sin(0.9 * t)
    whole = tc.terms.extend(body, named(library, "bias force"))
    x = simulate(whole, [run_of(torch.zeros(91), t, f)], k=2.0, c=0.2, **{"bias force.b": 0.1})["x"]
    d = quiet(body, tc.Recording(runs=[run_of(x + draw(91, 0.02, 4), t, f)], noise=0.02), library)
    assert d.terms == ["bias force"]


@pytest.mark.parametrize(
    "among",
    [("quadratic stiffness", "bias force"),
     pytest.param(("quadratic drag", "quadratic stiffness", "cubic stiffness", "bias force"), marks=pytest.mark.slow)],
)  # fmt: skip
def test_several_runs_with_unknown_initial_states_and_parameters_of_their_own(among):
    # Two bodies of different mass on the same kind of spring: k is each run's own, and so is the velocity at first.
    body = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"]}, {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, initial=2.0, per_run=True), tc.Parameter("c", low=0.0, initial=0.1)],
        observe=("x",),
    )  # fmt: skip
    library = named(tc.terms.mechanics(), *among)
    whole = tc.terms.extend(body, named(library, "quadratic stiffness"))
    times = [torch.linspace(0, 10, 70, dtype=F64), torch.linspace(0, 8, 50, dtype=F64)]

    def runs(x):
        return [tc.Run(times[0], outputs={"x": x[:70]}), tc.Run(times[1], outputs={"x": x[70:]}, initial={"x": -0.8})]

    x = simulate(whole, runs(torch.zeros(120)), **{"k[0]": 2.0, "k[1]": 3.0, "c": 0.15, "x(0)[0]": 1.0, "v(0)[0]": 0.3,
                 "v(0)[1]": -0.2, "quadratic stiffness.k": 0.4})["x"]  # fmt: skip
    d = quiet(body, tc.Recording(runs=runs(x + draw(120, 0.015, 2)), noise=0.015), library)
    check_types(d)
    assert d.terms == ["quadratic stiffness"]
    assert estimate_of(d, "k[0]").value == pytest.approx(2.0, abs=0.1)
    assert estimate_of(d, "k[1]").value == pytest.approx(3.0, abs=0.1)
    assert {e.name for e in d.final.estimates} == {
        "k[0]", "k[1]", "c", "x(0)[0]", "v(0)[0]", "v(0)[1]", "quadratic stiffness.k"
    }  # fmt: skip
    # The last quarter of each run.
    assert d.held_out.nonzero()[:, 0].tolist() == [*range(53, 70), *range(108, 120)]


@pytest.mark.slow
def test_outputs_of_different_size_that_are_functions_of_the_states():
    body = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]}, {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, initial=2.0), tc.Parameter("c", low=0.0, initial=0.2)],
        observe={"x": lambda t, s, p, u: s["x"],
                 "energy": lambda t, s, p, u: 500.0 * (s["v"] ** 2 + p["k"] * s["x"] ** 2)},
    )  # fmt: skip
    library = named(tc.terms.mechanics(), *NAMES)
    whole = tc.terms.extend(body, named(library, "quadratic stiffness"))

    def run(x, e):
        return tc.Run(T, outputs={"x": x, "energy": e}, inputs={"f": FORCE}, initial={"x": 1.0, "v": 0.0})

    zero = torch.zeros(101)
    y = simulate(whole, [run(zero, zero)], k=2.0, c=0.2, **{"quadratic stiffness.k": 0.3})
    noise = {"x": 0.02, "energy": 20.0}
    noisy = [y[name] + draw(101, noise[name], i) for i, name in enumerate(noise)]
    recording = tc.Recording(runs=[run(*noisy)], noise=noise)
    d = quiet(body, recording, library)
    check_types(d)
    assert d.terms == ["quadratic stiffness"]
    assert d.noise.sd == {"x": pytest.approx(0.02), "energy": pytest.approx(20.0)}


# --- other fields -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_thermal():
    t = torch.linspace(0, 60, 61, dtype=F64)
    body = tc.ODESimulator(lambda t, s, p, u: {"T": -p["k"] * (s["T"] - 20.0)}, {"T": "degC"},
                           [tc.Parameter("k", low=0.0, initial=0.05, unit="1/min")])  # fmt: skip
    library = tc.terms.thermal(ambient=20.0, time="min")
    whole = tc.terms.extend(body, named(library, "evaporation"))

    def run(x):
        return tc.Run(t, outputs={"T": x})

    x = simulate(whole, [run(torch.zeros(61))], k=0.03, **{"T(0)": 90.0, "evaporation.c": 0.02})["T"]
    d = quiet(body, tc.Recording(runs=[run(x + draw(61, 0.1, 1))]), library)
    assert d.verdict == "named"
    assert d.terms == ["evaporation"]
    null = simulate(body, [run(torch.zeros(61))], k=0.05, **{"T(0)": 90.0})["T"]
    d = quiet(body, tc.Recording(runs=[run(null + draw(61, 0.1, 1))]), library)
    assert d.verdict == "consistent"


@pytest.mark.slow
def test_kinetics():
    t = torch.linspace(0, 40, 41, dtype=F64)
    body = tc.ODESimulator(lambda t, s, p, u: {"A": -p["k"] * s["A"], "B": p["k"] * s["A"]},
                           {"A": "mol/L", "B": "mol/L"}, [tc.Parameter("k", low=0.0, initial=0.1)])  # fmt: skip
    library = tc.terms.kinetics("A", "B")
    whole = tc.terms.extend(body, named(library, "reverse reaction"))

    def runs(a, b):
        return [tc.Run(t, outputs={"A": a[i * 41 : i * 41 + 41], "B": b[i * 41 : i * 41 + 41]},
                       initial={"A": 1.0 + i, "B": 0.1}) for i in range(2)]  # fmt: skip

    zero = torch.zeros(82)
    y = simulate(whole, runs(zero, zero), k=0.1, **{"reverse reaction.k": 0.02})
    y = {name: values + draw(82, 0.02, i) for i, (name, values) in enumerate(y.items())}
    d = quiet(body, tc.Recording(runs=runs(y["A"], y["B"]), noise=0.02), library)
    assert d.verdict == "named"
    assert d.terms == ["reverse reaction"]


def parabola(b, noise=0.1, n=60):
    x = torch.linspace(-1, 3, n, dtype=F64)
    simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    terms = [
        tc.Term("curvature", outputs={"y": lambda x, p, y: y + p["q"] * x**2}, parameters=[tc.Parameter("q")]),
        tc.Term("kink", outputs={"y": lambda x, p, y: y + p["c"] * torch.relu(x - p["x0"])},
                parameters=[tc.Parameter("c"), tc.Parameter("x0", low=-1.0, high=3.0)]),
    ]  # fmt: skip
    return simulator, x, 1.0 + 2.0 * x + b * x**2 + draw(n, noise, 5), terms


def test_static():
    simulator, x, y, terms = parabola(0.3)
    d = quiet(simulator, tc.Recording(x=x, y=y, noise=0.1), terms)
    check_types(d)
    assert d.verdict == "named"
    assert d.terms == ["curvature"]
    assert estimate_of(d, "curvature.q").value == pytest.approx(0.3, abs=0.06)
    assert float(x[d.held_out].min()) > float(x[~d.held_out].max())
    simulator, x, y, terms = parabola(0.0)
    assert quiet(simulator, tc.Recording(x=x, y=y, noise=0.1), terms).verdict == "consistent"
    assert quiet(simulator, tc.Recording(x=x, y=y), terms).verdict == "consistent"


def test_a_threshold_whose_tangent_vanishes_at_neutral():
    # The term's amplitude multiplies another of its parameters: at neutral both tangents are zero.
    simulator, x, y, _ = parabola(0.3)
    term = tc.Term("product", outputs={"y": lambda x, p, y: y + p["a"] * p["b"] * x**2},
                   parameters=[tc.Parameter("a"), tc.Parameter("b")])  # fmt: skip
    d = quiet(simulator, tc.Recording(x=x, y=y, noise=0.1), [term])
    assert d.verdict == "named"
    assert d.terms == ["product"]


def test_a_term_that_raises_where_all_of_it_is_large_is_no_error():
    simulator, x, y, _ = parabola(0.3)

    def product(x, p, y):
        if bool(((p["a"] > 0.9) & (p["b"] > 0.9)).any()):
            raise ValueError("both large")
        return y + p["a"] * p["b"] * x**2

    term = tc.Term("product", outputs={"y": product}, parameters=[tc.Parameter("a"), tc.Parameter("b")])
    assert quiet(simulator, tc.Recording(x=x, y=y, noise=0.1), [term]).terms == ["product"]


@pytest.mark.parametrize("swapped", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_amount_that_is_absorbed_begins_at_every_rate(swapped):
    """Neither a rate nor an amount does anything alone, and at hardly any rate the effect has the wrong sign: what is
    linear is the amount."""
    time = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 24.0])
    time = time.double()
    ka, ke, dose = 1.4, 0.1, 10.0
    c = dose * ka / (ka - ke) * (torch.exp(-ke * time) - torch.exp(-ka * time))
    c = c + 0.15 * torch.randn(len(time), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    base = tc.ODESimulator(lambda t, s, p, u: {"c": -p["k"] * s["c"]}, {"c": "mg/L"},
                           [tc.Parameter("k", unit="1/h", low=0.0, high=20.0, initial=0.1)])  # fmt: skip
    own = [tc.Parameter("ka", unit="1/h", low=0.0, high=10.0, initial=1.0),
           tc.Parameter("g0", unit="mg/L", low=0.0, high=50.0, initial=8.0)]  # fmt: skip
    gut = tc.Term(
        "gut",
        rates={"c": lambda t, s, p, u: p["ka"] * s["gut"], "gut": lambda t, s, p, u: -p["ka"] * s["gut"]},
        states={"gut": "mg/L"},
        initial={"gut": lambda s, p: p["g0"]},
        parameters=own[::-1] if swapped else own,
    )
    recording = tc.Recording(runs=[tc.Run(time, {"c": c})], noise=0.15)
    problem = Problem.of(base, recording)
    found = fit(problem, problem.whitening(torch.full_like(recording.y, 0.15), torch.zeros(1).double()),
                starts(problem, 4, 0), list(range(len(problem.parameters))))  # fmt: skip
    candidate = prepare(problem, found, [gut], {})
    assert [candidate.problem.parameters[i].name for i in candidate.amplitudes] == ["gut.g0"]
    d = quiet(base, recording, [gut])
    assert d.terms == ["gut"]
    assert estimate_of(d, "gut.ka").value == pytest.approx(ka, abs=0.3)
    assert estimate_of(d, "gut.g0").value == pytest.approx(dose, abs=1.0)


def test_replicates_of_a_static_recording():
    simulator, x, _, terms = parabola(0.0)
    x = x[::3].repeat_interleave(3)
    y = 1.0 + 2.0 * x + 0.3 * x**2 + draw(len(x), 0.1, 8)
    d = quiet(simulator, tc.Recording(x=x, y=y), terms)
    assert d.noise.source == "replicates"
    assert d.terms == ["curvature"]


def test_two_conditions_and_a_parameter_that_varies_with_one():
    simulator, x, y = ignition()
    d = quiet(simulator, tc.Recording(x=x, y=y + draw(48, 0.02, 1), noise=0.02), ORDERS)
    assert d.terms == ["fuel reaction order"]
    shift = next(s for s in d.shifts if s.parameter == "lnA")
    assert shift.driver == "phi"
    assert abs(shift.correlation) > 0.9
    assert bool((shift.sd > 0).all())
    assert any("bound" in text or "bent" in text for text in d.symptoms)


# --- what is refused, before any long work ------------------------------------------------------------------


class Costly:
    """A static model that may be evaluated a few times, and no more."""

    def __init__(self, allowed):
        self.calls, self.allowed = 0, allowed

    def __call__(self, x, p):
        self.calls += 1
        if self.calls > self.allowed:
            raise AssertionError("long work began before the arguments were checked")
        return p["a"] + p["b"] * x


X = torch.linspace(0, 1, 20, dtype=F64)
DATA = tc.Recording(x=X, y=X + draw(20, 0.1, 0))
BEND = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"] * x**2}, parameters=[tc.Parameter("q")])


def costly(allowed=0, **parameters):
    return tc.Simulator(Costly(allowed), [tc.Parameter("a"), tc.Parameter("b", **parameters)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"confidence": 0.4}, "confidence"),
        ({"confidence": 1.0}, "confidence"),
        ({"confidence": math.nan}, "confidence"),
        ({"max_terms": 0}, "max_terms"),
        ({"max_terms": 1.5}, "max_terms"),
        ({"max_terms": True}, "max_terms"),
        ({"num_starts": 0}, "num_starts"),
        ({"num_starts": "many"}, "num_starts"),
        ({"holdout": 0.0}, "share"),
        ({"holdout": 1.0}, "share"),
        ({"holdout": math.nan}, "share"),
        ({"holdout": 3}, "bool array"),
        ({"holdout": {"y": [True, False]}}, r"a bool array\. Got dict\.$"),
        ({"holdout": "last"}, r"a bool array\. Got 'last'\.$"),
        ({"holdout": True}, "bool array"),
        ({"holdout": [0, 1]}, "bool array"),
        ({"holdout": torch.ones(5, dtype=torch.bool)}, r"shape \(20,\), True"),
        ({"holdout": torch.ones(20)}, "bool array"),
        ({"holdout": torch.ones(20, dtype=torch.bool)}, "hold out less"),
        ({"holdout": torch.zeros(20, dtype=torch.bool)}, "hold out at least one"),
        ({"holdout": 0.9}, "at least 4 data for each of 2 parameters"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(tc.errors.DomainError, match=message):
        quiet(costly(), DATA, [BEND], **options)


def test_a_candidate_that_frees_what_is_held_is_refused():
    base = tc.Simulator(lambda x, p: p["a"] * x + p["c"], [tc.Parameter("a"), tc.Parameter("c", neutral=0.0)])
    with pytest.raises(tc.errors.DomainError, match="leave one of the two out"):
        quiet(base, DATA, [tc.Term("offset", frees="c")], fixed={"c": 0.3})


@pytest.mark.parametrize(
    ("candidates", "message"),
    [
        (["drag"], "torchcal.Term"),
        ([BEND, None], "torchcal.Term"),
        ([lambda t, s, p, u: 0.0], "torchcal.Term"),
        ([tc.Term("x", frees=("c",))], "name a parameter"),
        ([tc.Term("x", shifts={"c": lambda x, p: p["m"]}, parameters=[tc.Parameter("m")])], "name a parameter"),
        ([tc.Term("x", equation="v", rate=lambda t, s, p, u: p["m"], parameters=[tc.Parameter("m")])], "without rates"),
    ],
)
def test_bad_candidates(candidates, message):
    with pytest.raises(tc.errors.DomainError, match=message):
        quiet(costly(), DATA, candidates)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"rates": {"w": lambda t, s, p, u: p["m"]}}, "equation of"),
        ({"outputs": {"v": lambda t, s, p, u, y: y + p["m"]}}, "output of"),
        ({"shifts": {"m": lambda t, s, p, u: p["m"]}}, "name a parameter"),
        ({"rates": {"v": lambda t, s, p, u: p["m"]}, "states": {"v": "m"}}, "new name"),
    ],
)
def test_bad_candidates_in_time(parts, message):
    term = tc.Term("x", parameters=[tc.Parameter("m")], **parts)
    with pytest.raises(tc.errors.DomainError, match=message):
        quiet(oscillator(), tc.Recording(runs=[run_of(FORCE)]), [term])


def test_not_a_simulator_or_not_a_recording():
    with pytest.raises(tc.errors.DomainError, match="Simulator"):
        quiet(lambda x, p: x, DATA, [BEND])
    with pytest.raises(tc.errors.RecordingError, match=r"torchcal\.Recording"):
        quiet(costly(), (X, X), [BEND])


def test_simulator_and_recording_of_different_kinds():
    with pytest.raises(tc.errors.TorchcalError, match="in time"):
        quiet(oscillator(), DATA, [])
    other = tc.Recording(runs=[tc.Run(T, outputs={"speed": T}, inputs={"f": FORCE})])
    with pytest.raises(tc.errors.SimulatorError, match="speed"):
        quiet(oscillator(), other, [])


def test_all_parameters_dormant():
    """There is nothing to calibrate, and one of them may still be what is missing."""
    simulator = tc.Simulator(
        lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a", neutral=0.0), tc.Parameter("b", neutral=1.0)]
    )
    noise = torch.randn(len(X), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    offset, steeper = tc.Term("offset", frees=("a",)), tc.Term("steeper", frees=("b",))
    found = quiet(simulator, tc.Recording(x=X, y=X + 0.3 + 0.05 * noise, noise=0.05), [offset, steeper])
    assert found.terms == ["offset"]
    assert quiet(simulator, tc.Recording(x=X, y=X + 0.05 * noise, noise=0.05), [offset]).verdict == "consistent"


def test_fewer_data_than_parameters():
    few = tc.Recording(x=X[:2], y=X[:2])
    with pytest.raises(tc.errors.RecordingError, match="2 data and 2 free"):
        quiet(costly(), few, [BEND])


def test_a_term_that_changes_the_simulator_at_neutral():
    term = tc.Term(
        "always on", outputs={"y": lambda x, p, y: y + torch.cos(p["q"] * x)}, parameters=[tc.Parameter("q")]
    )
    simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    with pytest.raises(tc.errors.SimulatorError, match="neutral"):
        quiet(simulator, DATA, [term])


def test_a_base_that_is_never_finite():
    simulator = tc.Simulator(lambda x, p: p["a"] * torch.log(-1.0 - x), [tc.Parameter("a")])
    with pytest.raises(tc.errors.ConvergenceError, match="finite"):
        quiet(simulator, DATA, [BEND])


def test_progress_can_be_silenced(capsys):
    body, motion, library = pushed(0.0)
    tc.diagnose(body, motion, library[-1:], progress=False)
    assert capsys.readouterr().err == ""
    tc.diagnose(body, motion, library[-1:])
    assert "diagnose" in capsys.readouterr().err


@pytest.mark.slow
def test_no_warning_where_all_goes_well():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        quiet(*pushed(0.08))


@pytest.mark.parametrize(
    "options",
    [{"confidence": "0.9"}, {"confidence": 0.9995}, {"seed": "a"}, {"holdout": "half"}, {"fixed": 3},
     {"fixed": {"zzz": 1.0}}],
)  # fmt: skip
def test_arguments_of_the_wrong_kind(options):
    with pytest.raises(tc.errors.DomainError):
        quiet(costly(10**9), DATA, [BEND], **options)


def test_candidates_that_are_no_sequence():
    with pytest.raises(tc.errors.DomainError):
        quiet(costly(10**9), DATA, 5)


# --- a base that is bent far away ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_term_that_acts_only_near_the_true_initial_states_is_found():
    """A drone that climbs out of the ground effect: the base moves its starts to where there is none."""
    base = tc.ODESimulator(
        lambda t, s, p, u: {"z": s["v"], "v": p["k"] * u["u"] - 9.81 - p["c"] * s["v"]},
        states={"z": "m", "v": "m/s"},
        parameters=[tc.Parameter("k", unit="m/s^2", low=0.0, initial=19.0),
                    tc.Parameter("c", unit="1/s", low=0.0, initial=0.2)],
        observe=("z",),
    )  # fmt: skip
    ground = tc.Term(
        "ground effect",
        equation="v",
        rate=lambda t, s, p, u: p["k"] * u["u"] * (1 / (1 - (p["R"] / (4 * s["z"].clamp_min(0.25))) ** 2) - 1),
        parameters=[tc.Parameter("R", unit="m", low=0.0, high=0.99)],
    )
    wind = tc.Term(
        "vertical wind",
        equation="v",
        rate=lambda t, s, p, u: p["c"] * p["w"],
        parameters=[tc.Parameter("w", unit="m/s")],
    )
    t = torch.linspace(0, 10, 80, dtype=F64)
    heights, thrusts = (0.30, 0.28, 2.5), (0.500, 0.497, 0.495)
    inputs = [{"u": level + 0.012 * torch.sin(1.1 * t) + 0.01 * (t > 4)} for level in thrusts]
    runs = [
        tc.Run(time=t, outputs={"z": torch.zeros_like(t)}, inputs=u, initial={"z": z, "v": 0.0})
        for z, u in zip(heights, inputs, strict=True)
    ]
    z = simulate(extend(base, [ground]), runs, k=19.6, c=0.35, **{"ground effect__R": 0.9})["z"].reshape(3, -1)
    recording = tc.Recording(
        runs=[
            tc.Run(time=t, outputs={"z": one + draw(80, 0.02, 5 + k)}, inputs=u, initial={"v": 0.0})
            for k, (one, u) in enumerate(zip(z, inputs, strict=True))
        ]
    )
    d = quiet(base, recording, [ground, wind])
    assert d.before.fitted.rmse > 10 * 0.02
    assert (d.verdict, d.terms) == ("named", ["ground effect"])
    found = estimate_of(d, "ground effect.R")
    assert abs(found.value - 0.9) < 4 * found.sd
    assert d.noise.sd["z"] == pytest.approx(0.02, rel=0.2)


@pytest.mark.parametrize(("after", "worse"), [(0.0, False), (0.5, False), (6.0, True)])
def test_three_data_that_were_held_out_may_withdraw_a_name(after, worse):
    from torchcal.discovery.hypotheses.verify import HeldOut, compare

    recording = tc.Recording(x=torch.arange(8.0, dtype=F64), y=torch.zeros(8, dtype=F64), noise=0.1)
    sd, mask = torch.full((8,), 0.1, dtype=F64), torch.arange(8) > 4
    before, other = (HeldOut(torch.full((8,), 0.1 * size, dtype=F64), sd) for size in (0.3, after))
    better, error = compare(recording, before, other, types.SimpleNamespace(sd=sd), mask)
    assert better == pytest.approx(0.3**2 - after**2)
    assert error == pytest.approx(4 * abs(after - 0.3) / math.sqrt(3))
    assert (better < -error) is worse
