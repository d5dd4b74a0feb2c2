"""The concealed-effects suite: its generator, its answers and its scorer. The tool itself does not run here."""

import ast
import hashlib
import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.concealed import generate, ideal, models, score
from benchmarks.concealed.check import tied_correlation
from benchmarks.concealed.experiment import planted as planted_of
from benchmarks.concealed.experiment import repeat
from benchmarks.concealed.families import FAMILIES
from benchmarks.concealed.families.base import (
    Base,
    Effect,
    Failure,
    Family,
    Gate,
    Planted,
    RunSetting,
    Setting,
    simulate,
    stacked,
    truth_vector,
)
from benchmarks.concealed.families.inputs import uniform
from torchcal.terms import extend

SUITE = Path(generate.__file__).parent
STILL = ("dose response", "solar cell", "spring")
FRESH = ("infusion", "rolling ship", "heat exchanger")
UNSEEN = ("battery cell", "car on a road", "soil moisture", "epidemic", "adsorption")
BLIND = ("quarter car", "enzyme reactor", "leaf", "power grid swing", "catchment")


def decay(**changes):
    """x' = −k x + a t, x(0) known: the fit can be done by hand."""
    settings = {
        "name": "decay",
        "field": "test",
        "parameters": (Base("k", "1/s", (0.5, 1.5)),),
        "draw": lambda rng: Setting((RunSetting(np.linspace(0, 2, 21), {}, {"x": 1.0}, ("x",)),), observed=("x",)),
        "outputs": {"x": lambda t, s, p, u: s["x"]},
        "effects": (Effect("ramp", {"x": lambda t, s, p, u, c: c["a"] * t}),),
        "tied": ("ramp", "ramp"),
        "states": {"x": "m"},
        "rates": lambda t, s, p, u: {"x": -p["k"] * s["x"]},
    }
    return Family(**{**settings, **changes})


def line():
    """y = m x + a x²; m is calibrated."""
    return Family(
        "line",
        "test",
        (Base("m", "", (1.0, 2.0), None, None),),
        lambda rng: Setting(x={"x": np.array([1.0, 2.0, 3.0])}, observed=("y",)),
        {"y": lambda t, s, p, u: p["m"] * u["x"]},
        (Effect("bend", outputs={"y": lambda t, s, p, u, y, c: y + c["a"] * u["x"] ** 2}),),
        ("bend", "bend"),
    )


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """Two sets from the same seed, of the quick families alone, and one from another."""
    chosen = {name: FAMILIES[name] for name in STILL}
    folders = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generate, "FAMILIES", chosen)
        for number, seed in enumerate((5, 5, 6)):
            folders.append(generate.generate(tmp_path_factory.mktemp(f"set{number}"), 24, seed, progress=False))
    return folders


def test_the_generator_knows_nothing_of_the_tool():
    for path in [SUITE / "generate.py", SUITE / "experiment.py", *(SUITE / "families").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [name for name in names if name.split(".")[0] in ("torch", "torchcal", "pyro")], path


def test_same_seed_same_cases(generated):
    first, second, other = generated
    assert (first / "answers.sha256").read_text() == (second / "answers.sha256").read_text()
    for path in (first / "cases").iterdir():
        assert path.read_bytes() == (second / "cases" / path.name).read_bytes()
    assert (first / "answers.sha256").read_text() != (other / "answers.sha256").read_text()


def test_the_published_hash_is_that_of_the_answers(generated, tmp_path):
    folder = generated[0]
    text = (folder / "answers.json").read_bytes()
    assert (folder / "answers.sha256").read_text().strip() == hashlib.sha256(text).hexdigest()
    assert len(score.load_answers(folder)) == 24
    (tmp_path / "answers.json").write_bytes(text.replace(b"null", b"none", 1))
    (tmp_path / "answers.sha256").write_text((folder / "answers.sha256").read_text())
    with pytest.raises(ValueError, match="SHA-256"):
        score.load_answers(tmp_path)


def test_cases_give_nothing_away(generated):
    answers = json.loads((generated[0] / "answers.json").read_text())
    for name, answer in answers.items():
        text = (generated[0] / "cases" / f"{name}.json").read_text()
        assert set(json.loads(text)) == {"id", "family", "noise", "units", "x", "y"}
        for effect in answer["effects"]:
            assert effect["name"] not in text


def test_answers_are_as_the_mix_asks(generated):
    answers = json.loads((generated[0] / "answers.json").read_text())
    assert Counter(a["kind"] for a in answers.values()) == Counter(generate.quotas(generate.KINDS, 24))
    for answer in answers.values():
        assert generate.LEVELS[0] <= answer["noise"]["level"] <= generate.LEVELS[1]
        assert len(answer["effects"]) == {"null": 0, "two": 2}.get(answer["kind"], 1)
        for effect in answer["effects"]:
            assert generate.STRENGTHS[0] <= effect["strength"] <= generate.STRENGTHS[1]
            assert effect["library"] == (answer["kind"] != "outside")
            assert (effect["gate"] is not None) == (answer["kind"] == "local")


def test_plan_of_the_published_run():
    rows = generate.plan(300, 1000, list(FAMILIES))
    kinds = Counter(kind for kind, *_ in rows)
    assert kinds["library"] + kinds["local"] == 135
    assert kinds["null"] == 90
    assert kinds["outside"] == 45
    assert kinds["two"] == 30
    assert kinds["local"] >= 0.24 * 135
    bands = Counter(row[1] for row in rows if row[0] in ("library", "local"))
    assert min(bands[1], bands[2]) >= 0.3 * 135
    assert min(Counter(row[2] for row in rows).values()) >= 300 // len(FAMILIES)


def test_families_of_development_and_test():
    seeds = (999, 1000, 2000, 3000, 4000, 5000)
    development, test, newest, fresh, unseen, blind = (set(generate.families_of(seed)) for seed in seeds)
    assert test == set(generate.families_of(1999))
    assert newest == set(generate.families_of(2999))
    assert fresh == set(generate.families_of(3999)) == set(FRESH)
    assert unseen == set(generate.families_of(4999)) == set(UNSEEN)
    assert blind == set(BLIND)
    assert len(development) >= 10
    assert development < test
    assert len(test - development) >= 3
    assert len(newest) == len(fresh) == 3
    assert not newest & test
    assert not fresh & (newest | test)
    assert not unseen & (fresh | newest | test)
    assert not blind & (unseen | fresh | newest | test)
    assert blind | unseen | fresh | newest | test == set(FAMILIES)


@pytest.mark.parametrize("family", FAMILIES.values(), ids=list(FAMILIES))
def test_families_are_well_formed(family):
    names = [effect.name for effect in family.effects]
    assert len(set(names)) == len(names)
    assert family.tied[0] in [effect.name for effect in family.library]
    assert family.tied[1] in [effect.name for effect in family.library]
    assert len(family.outside) >= 2
    assert any(effect.drivers for effect in family.library)
    setting = family.draw(np.random.default_rng(0))
    assert set(setting.observed) <= set(family.outputs)
    for values in [run.time for run in setting.runs] or list(setting.x.values()):
        assert 60 <= len(values) <= 300
    assert len(setting.runs) <= 3


@pytest.mark.parametrize(
    "name",
    [
        "pendulum", "solar cell", "spring", "thermistor", "cooling body", *BLIND,
        *(pytest.param(name, marks=pytest.mark.slow) for name in (*FRESH, *UNSEEN)),
    ],
)
def test_every_family_has_a_near_tie(name):
    assert np.median([tied_correlation(FAMILIES[name], seed) for seed in range(3)]) > 0.9


@pytest.mark.parametrize("name", [*(pytest.param(name, marks=pytest.mark.slow) for name in (*FRESH, *UNSEEN)), *BLIND])
def test_the_tool_is_given_the_same_physics(name):
    """Base and candidates are written twice: both say the same, with everything known. The saturation has a shape."""
    family, rng = FAMILIES[name], np.random.default_rng(1)
    setting = family.draw(rng)
    runs = tuple(replace(run, known=tuple(family.states)) for run in setting.runs)
    setting = replace(setting, runs=runs, observed=tuple(family.outputs))
    parameters = {base.name: uniform(rng, *base.draw) for base in family.parameters}
    theta = truth_vector(family, setting, parameters)

    def truth(planted):
        return [trace.outputs for trace in simulate(family, setting, theta, planted)]

    def joined(outputs):
        return np.concatenate([run[output][:, 0] for run in outputs for output in setting.observed])

    plain = truth([])
    case = {"id": "", "family": name, "noise": None, "units": dict(family.units) | dict(family.states)}
    if family.static:
        case |= {"x": {key: list(values) for key, values in setting.x.items()},
                 "y": {key: list(values[:, 0]) for key, values in plain[0].items()}}  # fmt: skip
    else:
        case["runs"] = [
            {"time": list(run.time), "inputs": {key: list(values) for key, values in run.inputs.items()},
             "initial": dict(run.initial), "outputs": {key: list(values[:, 0]) for key, values in found.items()}}
            for run, found in zip(runs, plain, strict=True)
        ]  # fmt: skip
    given = models.problem(case)
    given.simulator.max_step = min([0.1, *(float(np.diff(run.time).min()) / 4 for run in runs)])
    candidates = {candidate.name: candidate for candidate in given.candidates}
    assert {effect.name for effect in family.library} <= set(candidates)
    assert not {effect.name for effect in family.outside} & set(candidates)
    seen = []
    for effect in (None, *family.library):
        if effect is not None and effect.shapes:
            continue
        simulator, values, planted = given.simulator, dict(parameters), []
        if effect is not None:
            (amplitude,) = candidates[effect.name].parameters
            a = 0.1 * effect.guess * (effect.sign or -1)
            simulator, planted = extend(simulator, [candidates[effect.name]]), [Planted(effect, a)]
            values[f"{effect.name}.{amplitude.name}"] = a
        bound = simulator.bind(given.recording)
        model = bound.at(given.recording.x, setting.observed) if family.static else bound.at(bound.x)
        found = model(torch.tensor([values[key] for key in bound.names], dtype=torch.float64))
        exact = truth(planted)
        np.testing.assert_allclose(found, joined(exact), atol=1e-5 * np.std(joined(plain)), rtol=0)
        seen.append(abs(joined(exact) - joined(plain)).max() > 1e-3 * np.std(joined(plain)))
    assert not seen[0]
    assert all(seen[1:])


def test_the_truth_is_integrated_tightly():
    """x' = −k x + a t has the solution (x0 + a/k²) e^(−kt) + a t/k − a/k²."""
    family, k, a = decay(), 0.8, 0.5
    setting = family.draw(np.random.default_rng(0))
    t = setting.runs[0].time
    exact = (1 + a / k**2) * np.exp(-k * t) + a * t / k - a / k**2
    item = Planted(family.effects[0], a)
    tight = simulate(family, setting, np.array([k]), [item])[0]
    assert abs(tight.outputs["x"][:, 0] - exact).max() < 1e-8
    np.testing.assert_allclose(tight.added[0]["x"][:, 0], a * t)
    errors = [
        abs(simulate(family, setting, np.array([k]), [item], quick=parts)[0].outputs["x"][:, 0] - exact).max()
        for parts in (1, 2)
    ]
    assert 12 < errors[0] / errors[1] < 20  # fourth order: 16


def test_inputs_are_linear_between_samples():
    """x' = u with u(t) a zigzag: x is its integral, by the trapezoidal rule exactly."""
    t = np.linspace(0, 3, 7)
    u = np.array([0.0, 1.0, -1.0, 2.0, 0.0, 1.0, 0.5])
    family = decay(rates=lambda t, s, p, u: {"x": u["u"]})
    setting = Setting((RunSetting(t, {"u": u}, {"x": 0.0}, ("x",)),), observed=("x",))
    x = simulate(family, setting, np.array([1.0]))[0].outputs["x"][:, 0]
    exact = np.concatenate([[0.0], np.cumsum(0.5 * (u[1:] + u[:-1]) * np.diff(t))])
    np.testing.assert_allclose(x, exact, atol=1e-9)


def test_gate_and_hidden_states():
    gate = Gate("t", 0.5, 1.5, 0.0)
    family = decay()
    setting = family.draw(np.random.default_rng(0))
    item = Planted(family.effects[0], 1.0, {}, gate)
    trace = simulate(family, setting, np.array([1.0]), [item])[0]
    active = generate.active_samples(family, item, [trace])[0]
    np.testing.assert_array_equal(active, (setting.runs[0].time > 0.5) & (setting.runs[0].time < 1.5))
    assert np.all(trace.added[0]["x"][~active] == 0)
    lag = Effect(
        "lag",
        {"shown": lambda t, s, p, u, c: (s["x"] - s["shown"]) / c["a"]},
        outputs={"x": lambda t, s, p, u, y, c: s["shown"]},
        hidden={"shown": "x"},
    )
    k, tau = 0.5, 0.4
    seen = simulate(family, setting, np.array([k]), [Planted(lag, tau)])[0].outputs["x"][:, 0]
    t = setting.runs[0].time
    exact = (np.exp(-k * t) - k * tau * np.exp(-t / tau)) / (1 - k * tau)
    np.testing.assert_allclose(seen, exact, atol=1e-8)


def test_two_factors_on_one_constant_are_their_product():
    batch = FAMILIES["batch reactor"]
    sizes = {"product inhibition": 0.5, "reverse reaction": 0.1, "deactivation": 0.2}
    for order in (list(sizes), list(sizes)[::-1]):
        planted = [Planted(batch.effect(name), sizes[name]) for name in order]
        setting = Setting((RunSetting(np.array([0.0, 2.0]), {}, {"A": 1.3, "B": 0.7}, ("A", "B")),), observed=("A",))
        (trace,) = simulate(batch, setting, np.array([0.5, 0.2]), planted)
        state = {name: values[-1] for name, values in trace.states.items()}
        rate = trace.base["A"][-1] + sum(part["A"][-1] for part in trace.added)
        k = 0.5 * np.exp(-0.2 * 2.0) / (1 + 0.5 * state["B"])
        np.testing.assert_allclose(rate, -k * state["A"] + 0.1 * state["B"], rtol=1e-12)
        first = trace.base["A"][0] + sum(part["A"][0] for part in trace.added)
        np.testing.assert_allclose(first, -0.5 / (1 + 0.5 * 0.7) * 1.3 + 0.1 * 0.7, rtol=1e-12)


def test_recalibration_by_hand():
    """For y = m x + a x² at x = 1, 2, 3 the best slope is m + a Σx³/Σx² = m + 18/7 a."""
    family = line()
    setting = family.draw(np.random.default_rng(0))
    item = Planted(family.effects[0], 0.7)
    trace = simulate(family, setting, np.array([1.5]), [item])
    target = stacked(family, setting, trace, {"y": 2.0})[0]
    refit, residual = generate.recalibrate(
        family, setting, target, {"y": 2.0}, np.array([1.0]), np.random.default_rng(0)
    )
    x = setting.x["x"]
    np.testing.assert_allclose(refit, 1.5 + 0.7 * 18 / 7, rtol=1e-6)
    np.testing.assert_allclose(2.0 * residual, 0.7 * (x**2 - 18 / 7 * x), atol=1e-6)


def test_kappa_of_an_answer(generated):
    """κ once more, from what the answer publishes: a linear fit of the spring to its noise-free truth."""
    answers = json.loads((generated[0] / "answers.json").read_text())
    found = 0
    for name, answer in answers.items():
        if answer["family"] != "spring" or not answer["effects"]:
            continue
        case = json.loads((generated[0] / "cases" / f"{name}.json").read_text())
        x, y = np.array(case["x"]["x"]), np.array(answer["truth"][0]["force"])
        design = np.stack([x, np.ones_like(x)], axis=1)
        z, *_ = np.linalg.lstsq(design, y, rcond=None)
        if z[0] < 0:
            continue
        rmse = float(np.sqrt(np.mean((y - design @ z) ** 2)))
        assert answer["kappa"] == pytest.approx(rmse / answer["noise"]["sd"]["force"], rel=1e-4)
        found += 1
    assert found > 0


def test_noise_models():
    rng = np.random.default_rng(0)
    family = FAMILIES["spring"]
    setting = Setting(x={"x": np.linspace(-1, 1, 4000), "T": np.full(4000, 35.0)}, observed=("force",))
    traces = simulate(family, setting, np.array([10.0, 0.0]))
    scales = generate.signal_scales(setting, traces)
    draft = generate.Draft(family, setting, {}, (), traces, scales, (), np.zeros(2), np.zeros(1), 0.0)
    truth = traces[0].outputs["force"][:, 0]

    def errors(model):
        runs, declared, facts = generate.add_noise(draft, 0.05, model, rng)
        y = np.array([np.nan if v is None else v for v in runs[0]["force"]])
        return y, (y - truth)[np.isfinite(y)] / facts["sd"]["force"], declared, facts

    _, white, declared, facts = errors("white, known")
    assert declared == facts["sd"]["force"] == pytest.approx(0.05 * scales["force"])
    # Standard errors: 1/√(2 n) for a standard deviation, 1/√n for a correlation; 5 of them.
    assert white.std() == pytest.approx(1.0, abs=5 / math.sqrt(2 * len(white)))
    _, red, declared, facts = errors("AR(1), unknown")
    assert declared is None
    assert np.corrcoef(red[1:], red[:-1])[0, 1] == pytest.approx(facts["rho"], abs=5 / math.sqrt(len(red)))
    _, spiky, _, facts = errors("outliers, unknown")
    assert np.mean(abs(spiky) > 4.5) == pytest.approx(facts["share"], abs=5 * math.sqrt(0.05 * 0.95 / len(spiky)))
    y, _, _, facts = errors("quantised, unknown")
    steps = y[np.isfinite(y)] / facts["step"]["force"]
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_an_experiment_repeats_the_truth(generated):
    answers = json.loads((generated[0] / "answers.json").read_text())
    name = next(name for name, answer in answers.items() if answer["effects"])
    case = json.loads((generated[0] / "cases" / f"{name}.json").read_text())
    quiet = {**answers[name], "noise": {"sd": dict.fromkeys(case["y"], 0.0)}}
    more = repeat(case, quiet, {"x": case["x"]})
    for output, truth in quiet["truth"][0].items():
        assert len(more["y"][output]) == 2 * len(truth)
        np.testing.assert_allclose(more["y"][output][len(truth) :], truth, rtol=1e-8, atol=1e-9)
    assert [item.effect.name for item in planted_of(quiet)] == score.planted(quiet)


def test_an_experiment_in_time_takes_what_it_is_given():
    family = FAMILIES["cooling body"]
    rng = np.random.default_rng(2)
    while len((setting := family.draw(rng)).runs) != 1:
        pass
    run = setting.runs[0]
    answer = {"family": family.name, "effects": [], "parameters": {"h": 0.02}, "initial": [dict(run.initial)],
              "noise": {"sd": {"T": 0.0}}}  # fmt: skip
    case = {"runs": [{"time": run.time.tolist(), "outputs": {"T": [0.0] * len(run.time)},
                      "inputs": {"Ta": run.inputs["Ta"].tolist()}, "initial": {}}]}  # fmt: skip
    more = repeat(case, answer, {"initial": {"T": 200.0}, "time": [0.0, 10.0], "inputs": {"Ta": [20.0, 20.0]}})
    assert more["runs"][1]["outputs"]["T"] == pytest.approx([200.0, 20 + 180 * math.exp(-0.2)])


# --- the judge who knows everything but the name --------------------------------------------------------


def judged_line(monkeypatch, sd, *more, gate=None):
    """`line` with a bend planted, other candidates beside it."""
    family = line()
    family = replace(family, effects=(*family.effects, *more))
    monkeypatch.setitem(FAMILIES, "line", family)
    case = {"family": "line", "x": {"x": [1.0, 2.0, 3.0]}, "y": {"y": [0.0, None, 1.0]}}
    answer = {
        "family": "line",
        "effects": [{"name": "bend", "amplitude": 0.1, "shapes": {}, "gate": gate}],
        "rivals": [],
        "noise": {"sd": {"y": sd}},
        "parameters": {"m": 1.5},
        "initial": [],
        "refit": {"m": 1.6},
    }
    return ideal.judged(case, answer)


def outputs(power):
    return {"y": lambda t, s, p, u, y, c: y + c["a"] * u["x"] ** power}


def test_the_judge_of_two_names_by_hand(monkeypatch):
    """For one rival he is right with probability Φ(D / 2), D being the distance of its best fit in noise sd."""
    sd, x = 0.015, np.array([1.0, 2.0, 3.0])
    design = np.stack([x, x**3], axis=1)
    truth = 0.1 * x**2
    gap = np.linalg.norm(truth - design @ np.linalg.lstsq(design, truth, rcond=None)[0]) / sd
    found = judged_line(monkeypatch, sd, Effect("cube", outputs=outputs(3)))
    assert found["distances"] == {"cube": pytest.approx(gap, rel=1e-5)}
    chance = 0.5 * (1 + math.erf(gap / 2 / math.sqrt(2)))
    assert 0.7 < chance < 0.95  # or the test would see nothing
    assert found["first"] == pytest.approx(chance, abs=5 * math.sqrt(chance * (1 - chance) / ideal.DRAWS))


def test_the_judge_of_names_that_mean_the_same(monkeypatch):
    """Of the planted effect under two other names he can say no more than that it is one of the three."""
    found = judged_line(monkeypatch, 0.01, Effect("two", outputs=outputs(2)), Effect("three", outputs=outputs(2)))
    assert list(found["distances"].values()) == pytest.approx([0, 0], abs=1e-4)
    assert found["first"] == pytest.approx(1 / 3)


def test_rivals_of_a_local_effect_may_act_in_its_range(monkeypatch):
    """At the only datum in the range a bend and a cube of the right sizes are one."""
    gate = {"driver": "x", "low": 2.5, "high": None, "width": 0.0}
    found = judged_line(monkeypatch, 0.01, Effect("cube", outputs=outputs(3)), gate=gate)
    assert found["distances"] == {"cube": pytest.approx(0, abs=1e-4)}
    assert found["first"] == pytest.approx(1 / 2)


def test_the_judge_knows_what_cannot_be(monkeypatch):
    """A rival with an amplitude that nature does not have is none."""
    weak = Effect("weak", outputs={"y": lambda t, s, p, u, y, c: y + c["a"] * (u["x"] - 1) * (u["x"] - 2)},
                  within=(1e-9, 1e-8, None))  # fmt: skip
    assert judged_line(monkeypatch, 0.01, weak) == {"first": 1.0, "distances": {}}


def test_the_judge_allows_for_autocorrelation():
    """Lengths are those of the exact covariance ρ^|i − j| within every output of every run, and none across."""
    rho, rng = 0.6, np.random.default_rng(0)
    runs = (RunSetting(np.arange(4.0)), RunSetting(np.arange(6.0)))
    residual = rng.standard_normal(20)
    covariance = np.zeros((20, 20))
    for first, length in ((0, 4), (4, 6), (10, 4), (14, 6)):
        i = np.arange(length)
        covariance[first : first + length, first : first + length] = rho ** abs(i[:, None] - i)
    left = ideal.white(residual, Setting(runs, observed=("a", "b")), rho)
    assert left @ left == pytest.approx(residual @ np.linalg.solve(covariance, residual))
    still = ideal.white(residual, Setting(x={"x": np.arange(10.0)}, observed=("a", "b")), 0.0)
    np.testing.assert_array_equal(still, residual)


def test_a_system_that_blows_up_is_a_failure():
    family = decay(rates=lambda t, s, p, u: {"x": s["x"] ** 2})
    setting = family.draw(np.random.default_rng(0))
    for quick in (0, 4):
        with pytest.raises(Failure):
            simulate(family, setting, np.array([1.0]), quick=quick)


def test_uniform_stays_in_its_range():
    rng = np.random.default_rng(0)
    draws = np.array([uniform(rng, 0.1, 10.0) for _ in range(2000)])
    assert draws.min() >= 0.1
    assert draws.max() <= 10
    # Log-uniform: the median is 1, with a standard error of 0.5/√2000 in rank.
    assert np.mean(draws < 1) == pytest.approx(0.5, abs=5 * 0.5 / math.sqrt(2000))


# --- the scorer, on answers made by hand ---------------------------------------------------------------


def answer_of(kind, names=(), kappa=2.0, rivals=(), **more):
    return {
        "family": "spring",
        "kind": kind,
        "kappa": kappa,
        "rivals": list(rivals),
        "noise": {"sd": {"force": 1.0}, "model": "white, known"},
        "effects": [{"name": name, "places": ["force"], "active": None} for name in names],
        **more,
    }


def result_of(verdict, terms=(), tied=(), ranking=None, **more):
    rows = ranking if ranking is not None else [(list(terms), 0.9)] if terms else [([], 0.9)]
    rows = [{"terms": names, "probability": p, "aliases": [], "region": None} for names, p in rows]
    return {"verdict": verdict, "terms": list(terms), "tied": [list(t) for t in tied], "ranking": rows, "where": [],
            "region": None, "remaining": 0.0, "seconds": 3.0, **more}  # fmt: skip


def test_scores_of_single_answers():
    truth = answer_of("library", ["cubic stiffness"])
    right = result_of("named", ["cubic stiffness"])
    wrong = result_of("named", ["end stop"])
    tied = result_of("ambiguous", tied=[["end stop"], ["cubic stiffness"]],
                     ranking=[([], 0.01), (["end stop"], 0.5), (["cubic stiffness"], 0.49)])  # fmt: skip
    both = result_of("named", ["cubic stiffness", "end stop"])
    assert [score.credit(r, truth) for r in (right, wrong, tied, both)] == [1, 0, 0, 0]
    assert [score.top(r, truth) for r in (right, wrong, tied, both)] == [1, 0, 0, 0]
    assert [score.tied_hit(r, truth) for r in (right, wrong, tied, both)] == [1, 0, 1, 0]
    assert score.top(result_of("consistent", ranking=[(["cubic stiffness"], 0.4)]), truth) == 0
    assert score.stated(right, truth) == (0.9, True)
    assert score.stated(tied, truth) == (0.5, False)
    assert score.stated(result_of("consistent"), answer_of("null")) == (0.9, True)


def test_names_that_mean_the_same():
    same = {"effect": "cubic stiffness", "rival": "end stop", "correlation": 0.99995}
    near = {"effect": "cubic stiffness", "rival": "thermal expansion", "correlation": 0.99}
    truth = answer_of("library", ["cubic stiffness"], rivals=[same, near])
    assert score.credit(result_of("named", ["end stop"]), truth) == 1
    assert score.credit(result_of("named", ["thermal expansion"]), truth) == 0
    merged = result_of("named", ["gain error of force"])
    merged["ranking"][0]["aliases"] = ["cubic stiffness"]
    assert score.credit(merged, truth) == 1
    denied = result_of("named", ["softening by heat"])
    denied["ranking"][0]["aliases"] = ["cubic stiffness"]
    assert score.credit(denied, truth) == 0


def test_two_terms_and_half_credit():
    truth = answer_of("two", ["cubic stiffness", "thermal expansion"])
    one = ["cubic stiffness"]
    assert score.credit(result_of("named", ["thermal expansion", "cubic stiffness"]), truth) == 1
    assert score.credit(result_of("named", one, remaining=0.3), truth) == 0.5
    assert score.credit(result_of("named", one, remaining=0.0), truth) == 0
    assert score.credit(result_of("named", ["end stop"], remaining=0.3), truth) == 0
    assert score.credit(result_of("named", ["cubic stiffness", "end stop"], remaining=0.3), truth) == 0


def test_top_1_as_stated_is_the_share_of_the_first_among_those_with_terms():
    one, other = ["cubic stiffness"], ["end stop"]
    ranking = [(["none of these"], 0.5), (one, 0.2), (other, 0.15), (one, 0.1), ([], 0.05)]
    found = result_of("ambiguous", ranking=ranking)
    assert score.first_share(found) == pytest.approx(0.3 / 0.45)  # wherever it acts
    assert score.first_share({**found, "verdict": "unexplained"}) == 0
    mean = score.average([0.5, 0.7, 0.9])
    assert mean["value"] == pytest.approx(0.7)
    assert mean["high"] - mean["value"] == pytest.approx(1.96 * 0.1633 / 3**0.5, rel=1e-3)


def test_region_and_held_out():
    truth = answer_of("local", ["cubic stiffness"], truth=[{"force": [0.0, 0.0, 0.0, 0.0]}])
    truth["effects"][0]["active"] = [[0, 1, 1, 0]]
    region = {"driver": "x", "spans": [], "mask": [0, 1, 1, 1]}
    found = result_of("named", ["cubic stiffness"], region=region, held_out=[0, 0, 1, 1],
                      predicted_before=[9.0, 9.0, 3.0, 4.0], predicted_after=[9.0, 9.0, 0.3, 0.4])  # fmt: skip
    assert score.region_f1(found, truth) == pytest.approx(2 * 2 / (3 + 2))
    assert score.region_f1(result_of("consistent", region=region), truth) == 0
    found["noise"] = {"sd": {"force": 0.1}}
    assert score.held_out_ratio(found, truth) == pytest.approx(0.1)
    assert score.held_out_ratio(result_of("consistent"), truth) is None
    # Outputs are in the order of the recording, which need not be the answers'.
    truth = answer_of("library", ["cubic stiffness"], truth=[{"a": [1.0, 1.0], "b": [5.0, 5.0]}])
    truth["noise"] = {**truth["noise"], "sd": {"a": 1.0, "b": 1.0}}
    found = {**found, "noise": {"sd": {"b": 1.0, "a": 1.0}}, "held_out": [0, 1, 0, 1],
             "predicted_before": [5.0, 7.0, 1.0, 3.0], "predicted_after": [5.0, 5.4, 1.0, 1.4]}  # fmt: skip
    assert score.held_out_ratio(found, truth) == pytest.approx(0.2)


def test_missing_rate_forgives_what_the_base_can_do():
    """The spring's base explains a constant and a slope: only the curvature counts."""
    x = np.linspace(-1, 1, 21)
    case = {"x": {"x": x.tolist(), "T": np.full(21, 35.0).tolist()}, "y": {"force": x.tolist()}}
    truth = answer_of("outside", ["wavy thread"], parameters={"k": 10.0, "F0": 0.0}, refit={"k": 11.0, "F0": 0.0},
                      added=[[{"output force": (x**3).tolist()}]])  # fmt: skip

    def said(along, kind="output", target="force"):
        missing = {"kind": kind, "target": target, "driver": "x", "time": list(range(21)), "along": list(along)}
        return score.missing_error(result_of("unexplained", missing=missing), truth, case)

    # The base's slopes are finite differences, good to about 1e-7.
    assert said(x**3 + 5 * x - 2) == pytest.approx(0, abs=1e-5)
    assert said(1.3 * x**3) == pytest.approx(0.3)
    assert said(0 * x) == pytest.approx(1)
    assert said(x**2, "parameter", "k") == pytest.approx(0, abs=1e-5)  # (k + x²) x
    assert score.missing_error(result_of("unexplained", missing=None), truth, case) == 1
    assert score.missing_error(result_of("consistent"), truth, case) is None


def test_missing_rate_of_a_parameter_in_time_is_what_it_does_to_every_rate():
    """A reaction whose rate constant falls: both species' rates are compared, up to a constant change of it."""
    t = np.linspace(0, 4, 41)
    a, b = np.exp(-0.5 * t), np.exp(-0.3 * t) - np.exp(-0.5 * t)
    lost = 0.2 * np.sin(t) * a
    case = {"runs": [{"time": t.tolist(), "inputs": {}}]}
    truth = answer_of("outside", ["poisoned catalyst"], family="batch reactor", parameters={"k1": 0.5, "k2": 0.3},
                      states=[{"A": a.tolist(), "B": b.tolist()}],
                      added=[[{"A": lost.tolist(), "B": (-lost).tolist()}]])  # fmt: skip

    def said(along, kind="parameter", target="k1"):
        missing = {"kind": kind, "target": target, "driver": "t", "time": t.tolist(), "along": list(along)}
        return score.missing_error(result_of("unexplained", missing=missing), truth, case)

    assert said(-0.2 * np.sin(t) + 0.1) == pytest.approx(0, abs=1e-5)
    assert said(-0.1 * np.sin(t)) == pytest.approx(0.5, abs=1e-5)
    assert said(0.1 * np.sin(t), target="k2") > 0.9
    assert said(lost, "equation", "A") == pytest.approx(0, abs=1e-5)


def test_table_and_peers(tmp_path):
    answers = {
        "a": answer_of("library", ["cubic stiffness"], 2.0),
        "b": answer_of("library", ["cubic stiffness"], 0.5),
        "c": answer_of("null", kappa=0.0),
        "d": answer_of("null", kappa=0.0),
        "e": answer_of("outside", ["wavy thread"], 3.0),
        "f": answer_of("library", ["end stop"], 0.5),
    }
    results = {
        "a": result_of("named", ["cubic stiffness"]),
        "b": result_of("named", ["end stop"]),
        "c": result_of("consistent"),
        "d": result_of("named", ["end stop"]),
        "e": result_of("unexplained"),
        "f": {"failure": "no answer after 180 s", "seconds": 180.0},
    }
    rows = score.table(results, answers)
    assert rows["κ ≥ 1"]["top-1"]["value"] == 1
    assert rows["0.3 ≤ κ < 1"]["top-1"] == pytest.approx({"n": 2, "value": 0, "low": 0, "high": 0.6576}, abs=1e-3)
    assert rows["all"]["false alarms"]["value"] == 0.5
    assert rows["all"]["wrong names out of library"]["value"] == 0
    assert rows["all"]["precision when named"] == pytest.approx({"n": 3, "value": 1 / 3, "low": 0.0615, "high": 0.7923},
                                                                abs=1e-3)  # fmt: skip
    assert rows["all"]["failures"]["value"] == pytest.approx(1 / 6)
    assert [row["case"] for row in score.failures(results, answers)] == ["b", "d", "f"]
    text = score.markdown(rows, goals=True)
    assert "0.33 [0.06, 0.79] (n = 3)" in text
    peers = {key: {"refit + BIC": {"terms": ["cubic stiffness"], "seconds": 1.0}} for key in answers}
    column = score.peer_table(peers, answers)["refit + BIC"]
    assert column["top-1, κ ≥ 1"]["value"] == 1
    assert column["top-1, 0.3 ≤ κ < 1"]["value"] == 0.5
    assert column["false alarms (of those answered)"]["value"] == 1
    assert score.peer_table(peers, answers)["weak SINDy"]["answered"]["value"] == 0
    points = score.reliability(results, answers, bins=1)
    # b and d are named wrongly; e calls the base itself most probable.
    assert points[0]["n"] == 5
    assert points[0]["right"] == pytest.approx(2 / 5)
    score.reliability_figure(points, tmp_path / "reliability.png")
    assert (tmp_path / "reliability.png").stat().st_size > 1000


def test_wilson_interval():
    """Newcombe (1998), Statistics in Medicine 17, 857-872, Table I: 81 of 263 and 0 of 20."""
    assert score.wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert score.wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
