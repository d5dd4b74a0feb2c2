"""Every built-in term is planted once in a base model of its field, hidden by calibration and noise, and looked for.

It must come back named, or among the tied, or as an alias of one that is, or be called part of the base model where
that is the truth. A twelfth of them runs always, among a third of its library; all run with the slow tests.
"""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

import torchcal as tc
from torchcal.simulators import Trajectories

F64 = torch.float64
N = 81


@dataclass(frozen=True, eq=False)
class Field:
    """A base model, an experiment with it, and the library.

    `runs` makes the runs from recorded outputs by name, one run after another.
    """

    base: tc.ODESimulator
    runs: Callable[[dict[str, Tensor]], list[tc.Run]]
    values: dict[str, float]
    library: list[tc.Term]
    level: float
    effects: dict[str, dict[str, float]]
    quick: tuple[str, ...]
    absorbed: tuple[str, ...] = ()


def one_run(time, outputs, inputs=None, initial=None):
    """A function that makes the run from its outputs."""
    blank = torch.zeros(len(time), dtype=F64)
    return lambda y: [
        tc.Run(time, outputs={name: y.get(name, blank) for name in outputs}, inputs=inputs, initial=initial)
    ]


def mechanics() -> Field:
    t = torch.linspace(0, 15, 101, dtype=F64)
    f = 0.8 * torch.sin(0.9 * t) + 0.6 * torch.sign(torch.sin(0.37 * t + 1))
    base = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]},
        {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, initial=2.0), tc.Parameter("c", low=0.0, initial=0.2)],
        observe=("x",),
    )
    return Field(
        base,
        one_run(t, ("x",), {"f": f}, {"x": 1.0, "v": 0.0}),
        {"k": 2.0, "c": 0.2},
        [*tc.terms.mechanics(force="f", stiffness="k"), *tc.terms.sensor(("x",))],
        0.015,
        {
            "linear drag": {"c": 0.1},
            "quadratic drag": {"c": 0.8},
            "cubic drag": {"c": 0.8},
            "Coulomb friction": {"c": 0.2, "w": 0.1},
            "Stribeck friction": {"c": 0.3, "vs": 0.3},
            "linear spring": {"k": 0.3},
            "quadratic stiffness": {"k": 0.2},
            "cubic stiffness": {"k": 0.4},
            "large-angle sine": {"fraction": 1.0},
            "end stop": {"k": 1.5, "x0": 0.8},
            "position-dependent damping": {"c": 0.4},
            "bias force": {"b": 0.08},
            "viscoelastic branch": {"k": 0.5, "tau": 1.5},
            "actuator gain error": {"g": 0.12},
            "actuator lag": {"g": 1.0, "tau": 0.4, "start": 0.3},
            "offset of x": {"b": 0.05},
            "gain error of x": {"g": 0.12},
            "non-linearity of x": {"q": 0.1},
            "saturation of x": {"c": 0.8, "y0": 0.8},
            "drift of x": {"b": 0.006},
            "lag of x": {"a": 1.0, "t90": 0.5},
            "delay of x": {"a": 1.0, "D": 0.3},
        },
        ("linear spring", "offset of x"),
        ("linear drag", "linear spring"),
    )


def plane() -> Field:
    """A ball in flight: the terms of a body in a plane."""
    t = torch.linspace(0, 4, N, dtype=F64)
    base = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["vx"], "y": s["vy"], "vx": 0.0 * s["vx"], "vy": -p["g"] + 0.0 * s["vy"]},
        {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"},
        [tc.Parameter("g", low=0.0, initial=9.0)],
        observe=("x", "y"),
    )
    return Field(
        base,
        one_run(t, ("x", "y"), None, {"x": 0.0, "y": 0.0}),
        {"g": 9.81, "vx(0)": 15.0, "vy(0)": 20.0},
        tc.terms.mechanics(("x", "y"), ("vx", "vy")),
        0.01,
        {
            "linear drag": {"c": 0.04},
            "quadratic drag": {"c": 0.003},
            "cubic drag": {"c": 0.0002},
            "Coulomb friction": {"c": 0.6, "w": 2.0},
            "linear spring": {"k": 0.02},
            "cubic stiffness": {"k": 2e-5},
            "Magnus force": {"m": 0.04},
            "bias force along vx": {"b": 0.4},
            "bias force along vy": {"b": 0.4},
        },
        ("bias force along vy",),
        ("bias force along vy",),
    )


def thermal() -> Field:
    t = torch.linspace(0, 60, N, dtype=F64)
    q = ((t > 20) & (t < 35)).to(F64)
    base = tc.ODESimulator(
        lambda t, s, p, u: {"T": -p["k"] * (s["T"] - 20.0) + p["h"] * u["q"]},
        {"T": "degC"},
        [tc.Parameter("k", low=0.0, initial=0.05), tc.Parameter("h", low=0.0, initial=2.0)],
    )
    return Field(
        base,
        one_run(t, ("T",), {"q": q}, {"T": 80.0}),
        {"k": 0.05, "h": 2.5},
        [*tc.terms.thermal(ambient=20.0, loss="k", heater="q", time="min"), *tc.terms.sensor(("T",))],
        0.01,
        {
            "Newton cooling": {"k": 0.02},
            "natural convection": {"c": 0.012},
            "radiation": {"c": 0.05},
            "evaporation": {"c": 0.04},
            "temperature-dependent loss": {"c": 0.0003},
            "internal heat source": {"q": 0.15},
            "ambient drift": {"b": 0.05},
            "second heat capacity": {"k": 0.015, "tau": 15.0, "start": 0.2},
            "heater gain error": {"g": 0.5},
            "heater lag": {"g": 0.6, "tau": 4.0, "start": 0.3},
            "offset of T": {"b": 1.5},
            "gain error of T": {"g": 0.02},
            "non-linearity of T": {"q": 0.0003},
            "saturation of T": {"c": 0.3, "y0": 65.0},
            "drift of T": {"b": 0.04},
            "lag of T": {"a": 1.0, "t90": 1.5},
            "delay of T": {"a": 1.0, "D": 1.0},
        },
        ("heater gain error",),
        ("Newton cooling", "heater gain error"),
    )


def hydraulics() -> Field:
    t = torch.linspace(0, 100, N, dtype=F64)
    q = 0.02 + 0.02 * torch.sin(0.15 * t) + 0.01 * torch.sin(0.4 * t)

    def rates(t, s, p, u):
        out, on = (torch.sqrt(s[name].clamp_min(1e-6)) for name in ("h", "h2"))
        return {"h": p["a"] * u["q"] - p["c"] * out, "h2": p["c"] * out - p["d"] * on}

    base = tc.ODESimulator(
        rates,
        {"h": "m", "h2": "m"},
        [tc.Parameter(name, low=0.0, initial=value) for name, value in (("a", 1.0), ("c", 0.02), ("d", 0.02))],
    )
    return Field(
        base,
        one_run(t, ("h", "h2"), {"q": q}, {"h": 0.8, "h2": 0.5}),
        {"a": 1.0, "c": 0.024, "d": 0.026},
        tc.terms.hydraulics("h", inflow="q", outlet="c", downstream="h2"),
        0.02,
        {
            "leak": {"c": 0.004},
            "seepage": {"c": 0.005},
            "overflow": {"c": 0.03, "h0": 0.7},
            "evaporation": {"e": 0.003},
            "second tank": {"k": 0.02, "tau": 10.0},
            "bypass": {"b": 0.08},
            "pump saturation": {"g": 0.8, "u0": 0.03},
            "pump lag": {"g": 0.3, "tau": 4.0, "start": 0.3},
            "discharge exponent": {"m": 0.15},
            "clogging": {"r": 0.0006},
        },
        ("pump saturation",),
    )


def kinetics() -> Field:
    n = 51
    t = torch.linspace(0, 40, n, dtype=F64)
    base = tc.ODESimulator(
        lambda t, s, p, u: {"A": -p["k"] * s["A"], "B": p["k"] * s["A"]},
        {"A": "mol/L", "B": "mol/L"},
        [tc.Parameter("k", low=0.0, initial=0.1)],
    )
    blank = torch.zeros(2 * n, dtype=F64)

    def runs(y):
        return [
            tc.Run(
                t,
                outputs={name: y.get(name, blank)[i * n : (i + 1) * n] for name in ("A", "B")},
                inputs={"T": 300 + 30 * i + 10 * torch.sin(0.2 * t)},
                initial={"A": 1.0 + i, "B": 0.1},
            )
            for i in range(2)
        ]

    return Field(
        base,
        runs,
        {"k": 0.1},
        [*tc.terms.kinetics("A", "B", temperature="T", reference_temperature=315.0), *tc.terms.sensor(("A", "B"))],
        0.02,
        {
            "reverse reaction": {"k": 0.01},
            "autocatalysis": {"k": 0.04},
            "second-order decay": {"k": 0.008},
            "second branch": {"k": 0.005},
            "consecutive reaction": {"k": 0.003},
            "reversible adsorption": {"k": 0.03, "tau": 5.0},
            "constant source": {"b": 0.005},
            "reaction order": {"m": 0.3},
            "saturation": {"K": 0.3},
            "deactivation": {"r": 0.02},
            "product inhibition": {"K": 0.4},
            "temperature exponent": {"n": 3.0},
            "activation energy": {"E": 7000.0},
            "offset of A": {"b": 0.05},
            "gain error of A": {"g": 0.08},
            "non-linearity of A": {"q": 0.05},
            "saturation of A": {"c": 0.5, "y0": 1.5},
            "drift of A": {"b": 0.003},
            "lag of A": {"a": 1.0, "t90": 3.0},
            "delay of A": {"a": 1.0, "D": 1.0},
            "offset of B": {"b": 0.05},
            "gain error of B": {"g": 0.06},
            "non-linearity of B": {"q": 0.03},
            "saturation of B": {"c": 0.4, "y0": 1.5},
            "drift of B": {"b": 0.003},
            "lag of B": {"a": 1.0, "t90": 3.0},
            "delay of B": {"a": 1.0, "D": 1.0},
        },
        ("offset of B",),
    )


def electrical() -> Field:
    t = torch.linspace(0, 10, N, dtype=F64)
    i = torch.sin(1.1 * t) + 0.6 * torch.sin(2.9 * t + 0.5) + 0.5
    base = tc.ODESimulator(
        lambda t, s, p, u: {"v": (u["i"] - s["v"] / p["R"]) / p["C"]},
        {"v": "V"},
        [tc.Parameter("C", low=1e-3, initial=1.0), tc.Parameter("R", low=1e-3, initial=2.0)],
    )
    return Field(
        base,
        one_run(t, ("v",), {"i": i}, {"v": 0.5}),
        {"C": 1.0, "R": 2.0},
        tc.terms.electrical("v", "i", capacitance="C", resistance="R"),
        0.02,
        {
            "shunt": {"g": 0.1},
            "leakage current": {"i": 0.08},
            "diode conduction": {"i": 0.02, "vt": 0.4},
            "non-linear conductance": {"g": 0.1},
            "dielectric absorption": {"k": 0.2, "tau": 2.0},
            "Warburg element": {"k": 0.2, "tau": 0.3},
            "series resistance": {"R": 0.06},
            "non-linear capacitance": {"a": 0.25},
            "self-heating": {"a": 0.4, "tau": 2.0},
        },
        ("shunt", "series resistance"),
        ("shunt",),
    )


def coil() -> Field:
    t = torch.linspace(0, 10, N, dtype=F64)
    e = 1.5 * torch.sin(1.1 * t) + torch.sin(2.9 * t + 0.5)
    base = tc.ODESimulator(
        lambda t, s, p, u: {"i": (u["e"] - p["R"] * s["i"]) / p["L"]},
        {"i": "A"},
        [tc.Parameter("L", low=1e-3, initial=1.0), tc.Parameter("R", low=1e-3, initial=1.0)],
    )
    library = [
        term
        for term in tc.terms.electrical("i", "i", inductance="L", resistance="R")
        if term.name in ("saturation of the inductance", "self-heating", "leakage current")
    ]
    return Field(
        base,
        one_run(t, ("i",), {"e": e}, {"i": 0.0}),
        {"L": 1.0, "R": 1.0},
        library,
        0.015,
        {"saturation of the inductance": {"a": 0.4}, "self-heating": {"a": 0.8, "tau": 1.0}},
        ("saturation of the inductance",),
    )


def orbital() -> Field:
    t = torch.linspace(0, 20, 61, dtype=F64)

    def rates(t, s, p, u):
        pull = -p["mu"] / (s["x"] ** 2 + s["y"] ** 2) ** 1.5
        return {"x": s["vx"], "y": s["vy"], "vx": pull * s["x"], "vy": pull * s["y"]}

    base = tc.ODESimulator(
        rates,
        {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"},
        [tc.Parameter("mu", low=0.1, initial=1.0)],
        observe=("x", "y"),
    )
    return Field(
        base,
        one_run(t, ("x", "y"), None, {"x": 1.0, "y": 0.0, "vx": 0.0, "vy": 1.15}),
        {"mu": 1.0},
        tc.terms.orbital(("x", "y"), ("vx", "vy"), light=10.0),
        0.01,
        {
            "relativity": {"fraction": 0.7},
            "oblateness": {"q": 0.02},
            "third body": {"k": 0.004, "angle": 0.7},
            "drag": {"c": 0.001},
            "radiation pressure": {"c": 0.05},
            "exponent of gravity": {"e": 0.03},
            "uniform acceleration along vx": {"b": 0.002},
            "uniform acceleration along vy": {"b": 0.002},
        },
        ("radiation pressure",),
        ("radiation pressure",),
    )


MAKERS = (mechanics, plane, thermal, hydraulics, kinetics, electrical, coil, orbital)
FIELDS = {make.__name__: make() for make in MAKERS}
CASES = [
    pytest.param(name, effect, share, id=f"{name}: {effect}, 1/{share}", marks=() if share > 1 else pytest.mark.slow)
    for name, field in FIELDS.items()
    for effect in field.effects
    for share in ((1, 3) if effect in field.quick else (1,))
]


def record(field: Field, effect: str, seed: int) -> tuple[tc.Recording, Tensor]:
    """A noisy recording with the effect in it, and its outputs without noise."""
    term = next(term for term in field.library if term.name == effect)
    recording = tc.Recording(runs=field.runs({}))
    bound = Trajectories(tc.terms.extend(field.base, [term]), recording, subdivide=8)
    usual = {term.full(q.name): q.neutral for q in term.parameters if q.name == "start"}
    values = field.values | usual | {f"{effect}.{name}": value for name, value in field.effects[effect].items()}
    row = torch.tensor([[values[q.name] for q in bound.parameters]], dtype=F64)
    clean = bound.linearise(recording.x, row, recording.outputs, []).y[0]
    generator = torch.Generator().manual_seed(seed)
    noise = {name: field.level * float(y.std()) for name, y in recording.split(clean).items()}
    noisy = {
        name: y + noise[name] * torch.randn(len(y), generator=generator, dtype=F64)
        for name, y in recording.split(clean).items()
    }
    return tc.Recording(runs=field.runs(noisy), noise=noise), clean


def test_every_term_of_every_field_is_planted():
    for name, field in FIELDS.items():
        if name != "coil":
            assert set(field.effects) == {term.name for term in field.library}, name
        assert set(field.quick) <= set(field.effects)
        assert field.quick
    quick = sum(len(field.quick) for field in FIELDS.values())
    assert quick >= (len(CASES) - quick) / 12


@pytest.mark.parametrize(("name", "effect", "share"), CASES)
def test_a_planted_term_comes_back(name, effect, share):
    field = FIELDS[name]
    recording, clean = record(field, effect, seed=41)
    library = [term for i, term in enumerate(field.library) if term.name == effect or i % share == 0]
    d = tc.diagnose(field.base, recording, library, seed=0, progress=False)
    limit = next(row for row in d.detection_limit if row.term == effect)
    if effect in field.absorbed:
        assert limit.note == "already in the base model"
        assert d.verdict == "consistent"
        return
    # What is planted is an effect: calibration of the base cannot hide it.
    kappa = float(((d.base.prediction - clean) / recording.noise).square().mean().sqrt())
    assert kappa > 0.5, "planted too weakly to be found"
    assert d.verdict in ("named", "ambiguous"), str(d)
    found = [d.terms] if d.verdict == "named" else d.tied
    aliases = {row.terms: row.aliases for row in d.ranking}
    single = {term for terms in found if len(terms) == 1 for term in (*terms, *aliases.get(tuple(terms), ()))}
    assert effect in single, (found, str(d))
    if d.verdict == "named" and d.terms == [effect]:
        amplitude = next(iter(field.effects[effect]))
        estimate = next(e for e in d.final.estimates if e.name == f"{effect}.{amplitude}")
        wanted = field.effects[effect][amplitude]
        # Five sd, and the sign.
        assert abs(estimate.value - wanted) < 5 * estimate.sd + 0.1 * abs(wanted)
        assert estimate.value * wanted > 0
        assert d.remaining < 0.2
