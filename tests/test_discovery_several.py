"""A search with several candidates: terms that their own refit missed, terms that are one, and rivals in a window."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal.discovery import several
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.ranges import Scale, sized, sized_again
from torchcal.discovery.hypotheses.aliases import merge
from torchcal.discovery.hypotheses.beginnings import beginnings
from torchcal.discovery.hypotheses.beside import next_terms
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.hypotheses.sets import distinct, hypothetical, refit_sets
from torchcal.discovery.rivals import _swapped, one_fewer, with_stand_ins
from torchcal.discovery.rounds import settle
from torchcal.discovery.several import refit_several
from torchcal.discovery.verdicts.decision import other_names
from torchcal.discovery.windows import _rivals

F64 = torch.float64
X = torch.linspace(0, 3, 60, dtype=F64)
SHAPES = {
    "square": lambda x: x**2,
    "twice the square": lambda x: 2 * x**2,
    "cube": lambda x: x**3,
    "root": lambda x: x.sqrt(),
    "wave": lambda x: (2 * x).sin(),
}


def term(name):
    return tc.Term(
        name,
        outputs={"y": lambda x, p, y: y + p["a"] * SHAPES[name](x["x"])},
        parameters=[tc.Parameter("a", neutral=0.0)],
    )


def noisy(y):
    return y + 0.02 * torch.randn(60, generator=torch.Generator().manual_seed(3), dtype=F64)


def searched(names, y=None, *, noise=None, max_terms=2):
    y = noisy(2 * X + 0.03 * X**2) if y is None else y
    base = tc.Simulator(lambda x, p: {"y": p["m"] * x["x"]}, [tc.Parameter("m")])
    problem = Problem.of(base, tc.Recording(x={"x": X}, y={"y": y}, noise=noise))
    search = Search(problem, [term(name) for name in names], {}, 0, 3, max_terms, lambda text: None)
    search.calibrate_base()
    search, detected = settle(search, problem, 0.99)
    assert detected
    return search


def test_terms_of_the_best_pairs_are_refitted_alone_where_they_got_stuck():
    search = searched(["square", "cube", "root", "wave"])
    right = {i: model.weight for i, model in search.plain.items()}
    assert len(right) == 4
    search.models = [dataclasses.replace(model, log_evidence=model.log_evidence - 100) for model in search.models]
    refit_several(search)
    pairs = sorted((m for m in search.models if len(m.numbers) == 2 and m.physical), key=lambda m: -m.weight)
    found = {i: model.weight for i, model in search.plain.items()}
    assert len({i for pair in pairs[:3] for i in pair.numbers}) > 2
    for i in {i for pair in pairs[:3] if pair.weight > pairs[0].weight - 5 for i in pair.numbers}:
        assert abs(found[i] - right[i]) < 0.1


def test_second_terms_are_sought_beside_what_acts_everywhere_too(monkeypatch):
    # Three that lead in windows bend to what two others do together, of which neither does well in any window.
    search = searched(["square", "cube", "root", "wave"])
    plain = sorted(search.plain.values(), key=lambda m: -m.weight)
    assert len(plain) == 4
    windows = [
        dataclasses.replace(model, window=object(), log_evidence=model.log_evidence + 1000 - k)
        for k, model in enumerate(plain[1:])
    ]
    search.models = [*windows, *plain]
    order = [model.numbers[0] for model in plain]
    asked, wanted = [], []

    def next_terms(search, model, most):
        asked.append((model.numbers[0], model.window is None))
        others = [i for i in order if i != model.numbers[0]]
        return dict.fromkeys(others if model.window is None else others[:1])

    def refit_sets(search, sets, prior, beside):
        wanted.extend(pair for pair, _ in sets)
        return []

    monkeypatch.setattr(several, "_enough", lambda search: False)
    monkeypatch.setattr(several, "linear_pairs", lambda search, most: [])
    monkeypatch.setattr(several, "next_terms", next_terms)
    monkeypatch.setattr(several, "refit_sets", refit_sets)
    refit_several(search)
    assert asked == [(i, False) for i in order[1:]] + [(i, True) for i in order[:3]]
    assert len(wanted) == 6  # the first of all with the others, and then what is left
    assert {frozenset(pair) for pair in wanted} == {frozenset((i, j)) for i in range(4) for j in range(i)}


def test_candidates_that_are_one_stay_so_where_only_the_first_is_refitted():
    search = searched(["square", "twice the square", "wave"])
    assert search.aliases == {0: [1]}
    stuck = {i: dataclasses.replace(m, found=dataclasses.replace(m.found, chi2=m.found.chi2 + 200))
             for i, m in search.merged.items()}  # fmt: skip
    search.merged = stuck
    merge(search)
    merge(search)
    assert search.aliases == {0: [1]}
    assert search.merged == stuck


def test_everything_is_weighed_by_the_noise_that_is_found_later(monkeypatch):
    search = searched(["square", "twice the square", "wave"])
    before = {(w.candidate, w.driver, w.low, w.high): w.z for w in search.local}
    louder = dataclasses.replace(search.noise, sd=1.2 * search.noise.sd)
    monkeypatch.setattr("torchcal.discovery.hypotheses.search.suited", lambda *given: louder)
    search.reweigh()
    merge(search)
    assert search.aliases == {0: [1]}
    assert abs(search.merged[1].found.chi2 - search.plain[0].found.chi2) < 0.1
    same = [before[key] / w.z for w in search.local if (key := (w.candidate, w.driver, w.low, w.high)) in before]
    assert same
    assert all(abs(ratio - 1.2) < 0.01 for ratio in same)


def test_what_leads_in_a_window_is_held_against_others_there_though_it_is_no_physics():
    x = torch.linspace(0, 3, 60, dtype=F64)
    y = 2 * x + 0.4 * (x - 1.8).relu().sign() * x**2
    y = y + 0.02 * torch.randn(60, generator=torch.Generator().manual_seed(3), dtype=F64)
    base = tc.Simulator(lambda x, p: {"y": p["m"] * x["x"]}, [tc.Parameter("m")])
    problem = Problem.of(base, tc.Recording(x={"x": x}, y={"y": y}, noise=0.02))
    search = Search(problem, [term(name) for name in ("square", "cube", "wave")], {}, 0, 3, 2, lambda text: None)
    search.calibrate_base()
    search, _ = settle(search, problem, 0.99)
    wrong = max((m for m in search.models if m.names == ("cube",) and m.window is not None), key=lambda m: m.weight)
    wrong.physical = False
    search.models = [wrong, *search.plain.values()]
    _rivals(search, wrong.log_prior)
    best = max(search.models, key=lambda m: m.weight)
    assert (best.names, best.physical) == (("square",), True)
    assert abs(best.window.low - 1.8) < 0.05


def test_a_term_that_raises_at_sizes_far_off_keeps_its_first_fit():
    def wave(x, p, y):
        if bool((p["a"].abs() > 50).any()):
            raise ValueError("too large")
        return y + p["a"] * (5 * x["x"]).sin()

    noise = 0.02 * torch.randn(60, generator=torch.Generator().manual_seed(3), dtype=F64)
    y = 2 * X + 3 * X**2 + 2 * (5 * X).sin() + noise
    base = tc.Simulator(lambda x, p: {"y": p["m"] * x["x"]}, [tc.Parameter("m")])
    picky = tc.Term("picky wave", outputs={"y": wave}, parameters=[tc.Parameter("a")])
    d = tc.diagnose(base, tc.Recording(x={"x": X}, y={"y": y}), [picky, term("square"), term("cube")], progress=False)
    assert sorted(d.terms) == ["picky wave", "square"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Only .* of the base's starting values")
def test_a_term_that_a_far_bent_base_hides_is_found_from_the_base_of_another():
    """A spring on what is modelled as a mass without one: its tangent there has the wrong sign."""
    t = np.linspace(0, 60, 181)
    torque = 0.004 * np.sin(0.35 * t) + 0.003 * np.sin(0.13 * t)

    def rate(s, z):
        return [z[1], (np.interp(s, t, torque) - 0.01 * z[1] - 0.02 * z[0]) / 0.02]

    true = solve_ivp(rate, (0, 60), [0.3, 0.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.05).y[0]
    q = true + 0.08 * np.random.default_rng(0).standard_normal(181)
    body = tc.ODESimulator(
        lambda t, s, p, u: {"q": s["w"], "w": (u["M"] - p["d"] * s["w"]) / p["J"]},
        {"q": "rad", "w": "rad/s"},
        [tc.Parameter("J", low=1e-4, initial=0.02), tc.Parameter("d", low=0.0, initial=0.01)],
        observe=("q",),
    )
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"q": q}, inputs={"M": torque})], noise=0.08)
    names = ("linear spring", "cubic stiffness", "quadratic drag")
    terms = [term for term in tc.terms.mechanics(position="q", velocity="w") if term.name in names]
    d = tc.diagnose(body, recording, terms, seed=0, progress=False)
    assert list(d.ranking[0].terms) == ["linear spring"]
    stiffness = d.ranking[0].estimates[0]  # by the moment of inertia
    assert abs(stiffness.value - 1.0) < 4 * stiffness.sd < 0.4


@pytest.mark.slow
def test_a_pair_is_tried_where_one_term_of_three_shapes_does_as_well():
    """A rocket that burns its propellant, with drag: a branch that begins stretched had been named, the pair not tried.

    It leaves 0.15 m of what is missing, a tenth of the noise."""
    t = np.linspace(0, 20, 81)
    z = solve_ivp(
        lambda t, s: [s[1], 20 / (1 - 0.02 * t) - 9.81 - 5e-4 * abs(s[1]) * s[1]], (0, 20), [0, 0], t_eval=t,
        rtol=1e-9, atol=1e-11,
    ).y[0]  # fmt: skip
    z = z + 1.7 * np.random.default_rng(0).standard_normal(81)
    base = tc.ODESimulator(
        lambda t, s, p, u: {"z": s["v"], "v": p["F"] - 9.81 + 0 * s["v"]}, {"z": "m", "v": "m/s"},
        [tc.Parameter("F", unit="m/s^2", low=0.0, initial=20.0)], observe=("z",),
    )  # fmt: skip
    burnt = tc.Term(
        "propellant burnt", shifts={"F": lambda t, s, p, u: p["F"] * (1 / (1 - p["m"] * t) - 1)},
        parameters=[tc.Parameter("m", unit="1/s", low=0.0, high=0.045)], elapsed="run",
    )  # fmt: skip
    build_up = tc.Term(
        "thrust build-up", shifts={"F": lambda t, s, p, u: -p["F"] * p["a"] * torch.exp(-t / p["tau"])},
        parameters=[tc.Parameter("a", low=0.0, high=1.0), tc.Parameter("tau", low=0.2, high=10.0)], elapsed="run",
    )  # fmt: skip
    terms = [
        burnt, build_up, *tc.terms.mechanics(position="z", velocity="v", angle=False),
        *tc.terms.sensor(outputs=("z",), units={"z": "m"}),
    ]  # fmt: skip
    run = tc.Run(time=t, outputs={"z": z}, initial={"z": 0.0, "v": 0.0})
    recording = tc.Recording(runs=[run], units={"time": "s", "z": "m"})
    d = tc.diagnose(base, recording, terms, seed=0, progress=False)
    assert d.verdict == "ambiguous"
    assert {"propellant burnt", "quadratic drag"} in [{*tied} for tied in d.tied]
    evidence = {frozenset(row.terms): row.log_evidence for row in reversed(d.ranking)}
    assert evidence[frozenset({"propellant burnt", "quadratic drag"})] > evidence[frozenset({"viscoelastic branch"})]
    assert str(d).split("\n")[0].count(", or ") <= 6  # five of them and how many others, and none of them


def test_a_third_term_that_does_nothing_gives_way_to_the_pair():
    """Three terms, of which two do it all, and whose pair had got stuck."""
    y = noisy(2 * X + 0.3 * X**2 + 0.4 * (2 * X).sin())
    search = searched(["square", "wave", "root"], y, noise=0.02, max_terms=3)
    right, three = (refit_sets(search, [(numbers, None)], -4.0)[0] for numbers in ((0, 1), (0, 1, 2)))
    search.models = [dataclasses.replace(right, log_evidence=right.log_evidence - 100), three]
    one_fewer(search, three, -4.0)
    (again,) = [model for model in search.models if model.numbers == (0, 1)]
    assert abs(again.weight - right.weight) < 0.01
    assert again.weight > three.weight
    one_fewer(search, three, -4.0)  # once is enough
    assert [model for model in search.models if model.numbers == (0, 1)] == [again]


def test_pairs_begin_again_where_the_leading_one_stands():
    """The right pair had got stuck; a wrong one leads that shares a term with it, and then it does."""
    y = noisy(2 * X + 0.3 * X**2 + 0.4 * (2 * X).sin())
    search = searched(["square", "wave", "cube"], y, noise=0.02)
    right, wrong = refit_sets(search, [((0, 1), None), ((1, 2), None)], -4.0)
    assert right.weight > wrong.weight + 2
    begun = right.candidate.begin
    far = dataclasses.replace(right.found, values=begun, y=right.candidate.problem.evaluate(begun[None], [])[0][0])
    singles = [model for model in search.models if model.window is None]
    stuck = dataclasses.replace(right, found=far, log_evidence=wrong.log_evidence - 1000)
    search.models = [*singles, stuck, wrong]
    with_stand_ins(search, -4.0)
    (again,) = [model for model in search.models if model.numbers == (0, 1)]
    assert abs(again.weight - right.weight) < 0.01
    search.models = [model for model in search.models if model is not again]  # where it had not been tried at all
    with_stand_ins(search, -4.0)
    assert any(abs(model.weight - right.weight) < 0.01 for model in search.models)
    search.base = dataclasses.replace(search.base, chi2=1.9 * search.problem.n)  # from one that is hardly bent none is
    search.models = [*singles, stuck, wrong]
    with_stand_ins(search, -4.0)
    assert search.models == [*singles, stuck, wrong]


def test_what_the_base_makes_one_of_two_is_told_apart_beside_a_third():
    """A bend of what is shown, and one of what the base alone gives and a share of it: at the base they are one."""
    x = torch.linspace(0, 3, 80, dtype=F64)
    base = tc.Simulator(
        lambda x, p: {"y": p["a"] * (-p["k"] * x["x"]).exp()},
        [tc.Parameter("a", initial=1.0, low=0.1, high=10.0), tc.Parameter("k", initial=1.0, low=0.1, high=5.0)],
    )

    def seen(name, function):
        return tc.Term(name, outputs={"y": function}, parameters=[tc.Parameter("q", neutral=0.0)])

    terms = [
        seen("bend of the base", lambda x, p, y: y + p["q"] * (
            p["a"] ** 2 * (-2 * p["k"] * x["x"]).exp() + 0.5 * p["a"] * (-p["k"] * x["x"]).exp())),
        seen("wave", lambda x, p, y: y + p["q"] * (2 * x["x"]).sin()),
        seen("bend of what is shown", lambda x, p, y: y + p["q"] * y**2),
    ]  # fmt: skip
    true = 2 * (-0.8 * x).exp() + 0.5 * (2 * x).sin()
    y = true + 0.15 * true**2 + 0.01 * torch.randn(80, generator=torch.Generator().manual_seed(1), dtype=F64)
    d = tc.diagnose(base, tc.Recording(x={"x": x}, y={"y": y}, noise=0.01), terms, progress=False)
    assert d.verdict == "named", d.tied
    assert set(d.terms) == {"wave", "bend of what is shown"}


def test_what_nothing_tells_apart_is_one_beside_another_term_too():
    """Bends that differ by a straight line, which the base has: beside a wave they are one with many names."""
    x = torch.linspace(0, 3, 100, dtype=F64)
    noise = 0.02 * torch.randn(100, generator=torch.Generator().manual_seed(5), dtype=F64)
    y = 2 * x + 0.3 * x**2 + 0.4 * (4 * x).sin() + noise
    base = tc.Simulator(lambda x, p: {"y": p["m"] * x["x"] + p["n"]}, [tc.Parameter("m"), tc.Parameter("n")])
    bends = {f"bend {k}": lambda x, k=k: x**2 + k * x for k in (0, 1, 2, 3)}
    shapes = {"wave": lambda x: (4 * x).sin(), **bends, "exp": lambda x: (-2 * x).exp()}
    found = []
    for count in (1, 4):
        terms = [
            tc.Term(name, outputs={"y": lambda x, p, y, f=f: y + p["q"] * f(x["x"])},
                    parameters=[tc.Parameter("q", neutral=0.0)])
            for name, f in shapes.items() if not name.startswith("bend") or int(name[5:]) < count
        ]  # fmt: skip
        found.append(tc.diagnose(base, tc.Recording(x={"x": x}, y={"y": y}, noise=0.02), terms, progress=False))
    none = [next(row.probability for row in d.ranking if row.terms == ("none of these",)) for d in found]
    assert none[1] == pytest.approx(none[0], rel=0.1)  # one of many names is no likelier to be there
    assert {tuple(sorted(tied)) for tied in found[1].tied} >= {(f"bend {k}", "wave") for k in range(4)}


def test_pairs_that_free_the_same_take_a_place_of_the_leading_one_once():
    x = torch.linspace(0.1, 3, 120, dtype=F64)
    waves = {"a": (2 * x).sin(), "b": (5 * x).cos(), "c": (9 * x).sin(), "d": (14 * x).cos()}
    base = tc.Simulator(
        lambda x, p: {"y": p["m"] * x["x"] + sum(p[name] * wave for name, wave in waves.items())},
        [tc.Parameter("m"), *(tc.Parameter(name, neutral=0.0) for name in waves)],
    )
    noise = 0.02 * torch.randn(120, generator=torch.Generator().manual_seed(3), dtype=F64)
    y = 2 * x + 0.5 * (waves["a"] + waves["b"] + waves["c"]) + 0.05 * waves["d"] + noise
    freed = {"first": "ab", "second": "d", "bc": "bc", "ac": "ac", "c": "c"}
    terms = [tc.Term(name, frees=[*them]) for name, them in freed.items()]
    problem = Problem.of(base, tc.Recording(x={"x": x}, y={"y": y}, noise=0.02))
    search = Search(problem, terms, {}, 0, 3, 2, lambda text: None)
    search.calibrate_base()
    search, _ = settle(search, problem, 0.99)
    search.models = [m for m in search.models if m.window is None] + refit_sets(search, [((0, 1), None)], -4.0)
    with_stand_ins(search, -4.0)
    contents = [model.content for model in search.models]
    assert frozenset("abc") in contents
    assert len(contents) == len(set(contents))


def test_a_term_is_not_tied_with_itself_beside_what_it_is_merged_with():
    both = [SimpleNamespace(numbers=(0, 1), window=None)]
    candidates = [SimpleNamespace(name=name) for name in ("bend of the base", "bend of what is shown", "wave")]
    search = SimpleNamespace(candidates=candidates, aliases={0: [1]}, models=both)
    assert other_names(search, both[0]) == []
    search.models.append(SimpleNamespace(numbers=(0, 2), window=None))
    assert other_names(search, search.models[1]) == [(1, "bend of what is shown", "bend of the base")]
    search.models.append(SimpleNamespace(numbers=(1, 2), window=None))  # which has a fit of its own
    assert other_names(search, search.models[1]) == []


def test_an_instrument_shows_the_physics_in_whatever_order_the_two_are_listed():
    x = torch.linspace(0.1, 3, 80, dtype=F64)
    true = 2 * x + 1.5 * (4 * x).sin()
    y = true / (1 + 0.15 * true) + 0.01 * torch.randn(80, generator=torch.Generator().manual_seed(5), dtype=F64)
    base = tc.Simulator(lambda x, p: {"y": p["m"] * x["x"]}, [tc.Parameter("m", low=0.0)])
    dull = tc.Term(
        "dead time", outputs={"y": lambda x, p, y: y / (1 + p["q"] * y)}, parameters=[tc.Parameter("q", low=0.0)]
    )
    wave = tc.Term(
        "wave", outputs={"y": lambda x, p, y: y + p["a"] * (4 * x["x"]).sin()}, parameters=[tc.Parameter("a")]
    )
    recording = tc.Recording(x={"x": x}, y={"y": y}, noise=0.01)
    found = [tc.diagnose(base, recording, terms, progress=False) for terms in ([dull, wave], [wave, dull])]
    for d in found:
        assert d.verdict == "named"
        assert set(d.terms) == {"wave", "dead time"}
        estimates = {e.name: e for e in d.final.estimates}
        assert abs(estimates["dead time.q"].value - 0.15) < 4 * estimates["dead time.q"].sd
        assert abs(estimates["wave.a"].value - 1.5) < 4 * estimates["wave.a"].sd
    assert abs(found[0].final.chi2 - found[1].final.chi2) < 0.01


@pytest.mark.parametrize("noise", [0.02, None])
def test_two_terms_of_which_no_tangent_shows_anything_are_tried_together(noise):
    x = torch.linspace(0, 4, 60, dtype=F64)
    terms = [
        tc.Term(
            f"wave {k}", outputs={"y": lambda x, p, y, k=k: y + p["a"] ** 2 * torch.sin(k * x)},
            parameters=[tc.Parameter("a", low=0.0)],
        )
        for k in (3, 5, 8)
    ]  # fmt: skip
    y = 1 + 0.5 * x + 0.05 * torch.sin(3 * x) + 0.05 * torch.sin(8 * x)
    y = y + 0.02 * torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=F64)
    base = tc.Simulator(lambda x, p: p["c"] + p["b"] * x, [tc.Parameter("c"), tc.Parameter("b")])
    d = tc.diagnose(base, tc.Recording(x=x, y=y, noise=noise), terms, seed=0, progress=False)
    assert d.verdict == "named"
    assert set(d.terms) == {"wave 3", "wave 8"}
    known = {e.name: e for e in d.final.estimates}
    for name in ("wave 3.a", "wave 8.a"):
        assert abs(known[name].value - 0.05**0.5) < 4 * known[name].sd


@pytest.mark.slow
def test_a_pair_listed_in_the_wrong_order_does_not_lose_to_one_that_looks_like_it():
    # A resistance thermometer: the current's effect comes before the shunt, which is listed first; what saturates, as a
    # shunt nearly makes it do, is listed last.
    generator = torch.Generator().manual_seed(3)
    cold = 1.5 * torch.rand(120, generator=generator, dtype=F64) - 0.5
    power = 3 * torch.rand(120, generator=generator, dtype=F64)
    inner = 1.8 + 3.6 * cold - 0.14 * (power - 1.5)
    y = inner - torch.log1p(0.08 * inner.exp()) + 0.07 * torch.randn(120, generator=generator, dtype=F64)
    base = tc.Simulator(lambda x, p: {"y": p["r"] + p["b"] * x["cold"]}, [tc.Parameter("r"), tc.Parameter("b")])

    def seen(name: str, function: object) -> tc.Term:
        return tc.Term(name, outputs={"y": function}, parameters=[tc.Parameter("a", low=0.0)])

    shunt = seen("shunt", lambda x, p, y: y - torch.log1p(p["a"] * y.exp()))
    current = seen("current", lambda x, p, y: y - p["a"] * (x["power"] - 1.5))
    dull = seen("dull", lambda x, p, y: y - p["a"] * torch.relu(y + 2) ** 2)
    recording = tc.Recording(x={"cold": cold, "power": power}, y={"y": y}, noise=0.07)
    chi2 = []
    for terms in ([shunt, current, dull], [dull, current, shunt]):
        d = tc.diagnose(base, recording, terms, progress=False)
        assert {"shunt", "current"} in [set(tied) for tied in (d.tied or [d.terms])]
        row = next(row for row in d.ranking if set(row.terms) == {"shunt", "current"})
        assert row.terms == ("current", "shunt")
        chi2.append(row.log_evidence)
    assert abs(chi2[0] - chi2[1]) < 0.1


@pytest.mark.slow
def test_the_order_of_the_list_does_not_decide_where_nothing_else_fits():
    # By the first order the pair is far behind; and what clips comes before what is not read from the output.
    x = torch.linspace(0.1, 4, 80, dtype=F64)
    y = 1.3 * x / (1 + 0.3 * 1.3 * x) + 2.4 * (-x).exp()
    y = y + 0.01 * torch.randn(80, generator=torch.Generator().manual_seed(0), dtype=F64)
    base = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a", initial=1.0, low=0.1, high=5.0)])

    def seen(name: str, function: object, **limits: float) -> tc.Term:
        return tc.Term(name, outputs={"y": function}, parameters=[tc.Parameter("q", **limits)])

    clip = seen("clip", lambda x, p, y: y / (1 + p["q"] * y), low=0.0, high=2.0)
    leak = seen("leak", lambda x, p, y: y + p["q"] * torch.exp(-x) * 3)
    wave = seen("wave", lambda x, p, y: y + p["q"] * x.sqrt() * torch.cos(2 * x))
    for terms in ([clip, leak, wave], [leak, clip, wave]):
        d = tc.diagnose(base, tc.Recording(x=x, y=y, noise=0.01), terms, progress=False)
        assert set(d.terms) == {"clip", "leak"}, d.verdict


@pytest.mark.parametrize("off", [True, False])
def test_what_a_base_that_is_off_nearly_makes_up_for_is_tried_in_place_of_the_others(off):
    """A bend of which a line leaves little is no look-alike of a wave, but the linear search may have missed it."""
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    bends = [("slight", lambda x: x + 0.01 * x**2), ("wave", lambda x: (4 * x).sin()), ("root", lambda x: x.sqrt()),
             ("square", lambda x: x**2)]  # fmt: skip
    terms = [
        tc.Term(name, outputs={"y": lambda x, p, y, f=f: y + p["m"] * f(x)}, parameters=[tc.Parameter("m")])
        for name, f in bends
    ]
    noise = 0.1 * torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=F64)
    y = 1 + X + (1.0 if off else 0.05) * (4 * X).sin() + noise
    search = Search(Problem.of(base, tc.Recording(x=X, y=y, noise=0.1)), terms, {}, 0, 4, 2, lambda text: None)
    search.calibrate_base()
    search.screen_all()
    assert (search.base.chi2 > 5 * 60) == off
    swapped = _swapped(search, SimpleNamespace(numbers=(1, 2)))
    assert {(0, 1), (0, 2)} <= set(swapped) if off else not {(0, 1), (0, 2)} & set(swapped)


# --- terms that free the same ------------------------------------------------------------------------------


INHIBITED = [
    tc.Term("competitive inhibition", frees=("Ic",)),
    tc.Term("uncompetitive inhibition", frees=("Iu",)),
    tc.Term("mixed inhibition", frees=("Ic", "Iu")),
]


def inhibited(competitive: float, uncompetitive: float, seed: int) -> tuple[tc.Simulator, tc.Recording]:
    """Rates of an enzyme whose inhibitor binds it, or what it makes of the substrate, of which the base knows nothing.
    """
    def rate(x, p):
        free, bound = 1 + p["Ic"] * x["I"], 1 + p["Iu"] * x["I"]
        return {"v": p["Vm"] * x["S"] / (p["Km"] * free + x["S"] * bound)}

    s, i = (each.ravel() for each in np.meshgrid([0.2, 0.4, 0.8, 1.5, 3, 6], [0, 0.2, 0.5, 1, 2], indexing="ij"))
    x = {"S": np.tile(s, 2), "I": np.tile(i, 2)}
    truth = {"Vm": 100.0, "Km": 1.2, "Ic": competitive, "Iu": uncompetitive}
    y = rate(x, truth)["v"] + np.random.default_rng(seed).standard_normal(60)
    parameters = [
        tc.Parameter("Vm", low=0.1, high=1000.0, initial=80.0),
        tc.Parameter("Km", low=1e-3, high=50.0, initial=1.0),
        *(tc.Parameter(name, low=0.0, high=50.0, neutral=0.0) for name in ("Ic", "Iu")),
    ]
    return tc.Simulator(rate, parameters), tc.Recording(x=x, y={"v": y}, noise=1.0)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_terms_that_free_what_a_third_one_frees_are_no_more_models(seed):
    d = tc.diagnose(*inhibited(1.0, 0.15, seed), INHIBITED, progress=False)
    assert (d.verdict, d.terms) == ("named", ["mixed inhibition"])
    assert all(len(row.terms) < 2 for row in d.ranking)
    both = tc.diagnose(*inhibited(1.0, 0.15, seed), INHIBITED[:2], progress=False)
    assert set(both.terms) == {"competitive inhibition", "uncompetitive inhibition"}


@pytest.mark.parametrize(("seed", "verdict"), [(0, "ambiguous"), (1, "named")])
def test_a_term_that_frees_more_is_the_same_and_more(seed, verdict):
    d = tc.diagnose(*inhibited(0.8, 0.0, seed), INHIBITED, progress=False)
    assert d.verdict == verdict
    if verdict == "named":
        assert d.terms == ["competitive inhibition"]
        assert "The next best without it, mixed inhibition, has a probability" in " ".join(str(d).split())
    else:
        assert d.tied == [["competitive inhibition"], ["mixed inhibition"]]
        assert d.experiment is None  # what one has beside the other is at its neutral value


def test_sets_that_add_the_same_are_one():
    contents = ({"a"}, {"b"}, {"a", "b"}, {"x"}, {"b", "c"})
    search = SimpleNamespace(
        candidates=[SimpleNamespace(content=frozenset(content)) for content in contents],
        models=[SimpleNamespace(content=frozenset(c), window=window) for c, window in (("ax", None), ("bx", 1))],
        failed=set(),
    )
    sets = [(0, 1), (0, 3), (1, 3), (0, 4), (2, 4), (2, 3)]
    assert distinct(search, sets) == [(1, 3), (0, 4), (2, 3)]
    search.failed = {2}
    assert distinct(search, sets)[0] == (0, 1)  # of what could not be fitted another set is tried


@pytest.mark.parametrize(("own", "size", "wanted"), [
    ({}, 40.0, (0.04, 40.0)), ({}, 3.0, (0.04, 2.0)), ({}, 0.1, (0.04, 2.0)), ({"high": 1.5}, 40.0, (0.04, 1.5)),
    ({"low": 0.5}, 40.0, (0.5, 40.0)),
])  # fmt: skip
def test_a_threshold_may_lie_as_far_as_its_driver_goes_with_what_was_missing(own, size, wanted):
    given = tc.Term(
        "overflow", equation="S", rate=lambda t, s, p, u: -p["a"] * torch.relu(s["S"] - p["rim"]) / p["S0"],
        parameters=[tc.Parameter("a", low=0.0), tc.Parameter("rim", **own)], scales={"rim": "S"}, constants={"S0": "S"},
        formula="dS/dt ∋ -a max(S - rim, 0)/S0",
    )  # fmt: skip
    recording = tc.Recording(x=X, y=X)
    at_base = sized(given, Scale({"S": 2.0}, {}), recording)
    again = sized_again(at_base, given, Scale({"S": size}, {}), recording)
    rim = again.parameters[1]
    assert (rim.low, rim.high) == wanted
    assert again.constants == {"S0": 2.0}  # what its amplitude is measured in stays
    assert again.formula == at_base.formula


def test_pairs_begin_where_the_second_term_was_seen_beside_the_first(monkeypatch):
    # With the root alone the cube's best threshold is another one than beside the square, and of another sign.
    y = noisy(2 * X + 0.3 * X**2 - 0.5 * (X - 2.4).relu())
    kink = tc.Term(
        "kink", outputs={"y": lambda x, p, y: y + p["a"] * (x["x"] - p["x0"]).relu()},
        parameters=[tc.Parameter("a", neutral=0.0), tc.Parameter("x0")], scales={"x0": "x"},
    )  # fmt: skip
    base = tc.Simulator(lambda x, p: {"y": p["m"] * x["x"]}, [tc.Parameter("m")])
    problem = Problem.of(base, tc.Recording(x={"x": X}, y={"y": y}, noise=0.02))
    search = Search(problem, [term("square"), kink], {}, 0, 3, 2, lambda text: None)
    search.calibrate_base()
    search, _ = settle(search, problem, 0.99)
    seen = next_terms(search, search.plain[0], 3)
    assert [*seen] == [1]
    without, there = (hypothetical(search, (0, 1), -4.0, None, beside=beside) for beside in ((), [seen[1]]))
    names = [q.name for q in there.candidate.problem.parameters]
    more = dict(zip(names, there.begin[len(without.begin) :].T.tolist(), strict=True))
    assert torch.equal(there.begin[: len(without.begin)], without.begin)
    assert max(abs(x0 - 2.4) for x0 in more["kink.x0"][:2]) < 0.3
    assert -0.7 < min(more["kink.a"]) < -0.3
    assert max(abs(a - search.plain[0].found.by_name["square.a"]) for a in more["square.a"]) < 0.3
    (pair,) = refit_sets(search, [((0, 1), None)], -4.0, {(0, 1): [seen[1]]})
    assert abs(pair.found.by_name["kink.x0"] - 2.4) < 0.1
    as_it_was = search.candidates[1]
    larger = Scale({"x": 30.0, "y": 30.0}, {})
    monkeypatch.setattr("torchcal.discovery.hypotheses.beside.drivers_scale", lambda problem, found: larger)
    next_terms(search, search.plain[0], 3)
    wide = search.candidates[1]  # for what is refitted alone, too
    assert wide.terms[0].parameters[1].high == 30.0
    assert wide.problem.limits()[1][-1] == 30.0 > float(as_it_was.problem.limits()[1][-1])
    assert torch.equal(wide.tangents, as_it_was.tangents)
    search.base = dataclasses.replace(search.base, chi2=search.problem.n)  # where the base is not bent it tells enough
    assert next_terms(search, search.plain[0], 3) == {1: None}


def test_a_parameter_stays_where_making_up_for_an_effect_would_take_it_beyond_its_bounds():
    base = tc.Simulator(lambda x, p: {"y": p["m"] * (1 - torch.exp(-p["c"] * x["x"]))}, [
        tc.Parameter("m"), tc.Parameter("c", low=0.1, high=9.0),
    ])  # fmt: skip
    y = noisy(2 - 2 * torch.exp(-12.0 * X) + 0.3 * X.sqrt())
    problem = Problem.of(base, tc.Recording(x={"x": X}, y={"y": y}, noise=0.02))
    search = Search(problem, [term("root")], {}, 0, 3, 1, lambda text: None)
    search.calibrate_base()
    search.screen_all()
    c = float(search.base.values[1])
    assert c < 9.0
    rows = beginnings(search.residual, search.screening, 0, search.candidates[0], None)
    little, whole, stays = rows  # a small share of the linear estimate, and all of it
    assert c < float(little[1]) < 9.0 < float(whole[1])
    assert float(stays[1]) == c
    assert float(stays[2]) == float(whole[2]) != 0
    assert float(stays[0]) != float(search.base.values[0])  # that makes up for it alone
