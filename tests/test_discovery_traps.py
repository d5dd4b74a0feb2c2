"""What looks like missing physics and is none, and names that stand in for what is in no list."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.hypotheses.judge import _away
from torchcal.discovery.verdicts import verdict
from torchcal.discovery.verdicts.doubts import between_outputs
from torchcal.display import NONE

F64 = torch.float64


def diagnose(simulator, recording, terms):
    return tc.diagnose(simulator, recording, terms, seed=0, progress=False)


def cleared(seed, store, lag=0.0, noise=0.02):
    """A concentration after a dose, with a store beside it or an instrument that lags, each absent at 0."""
    t = np.linspace(0.0, 12.0, 60)

    def rates(_, s):
        out = store * (s[0] - s[1])
        return [-0.5 * s[0] - out, 0.6 * out, (s[0] - s[2]) * np.log(10) / max(lag, 1e-6)]

    y = solve_ivp(rates, (0, 12), [2.0, 0.0, 2.0], t_eval=t, rtol=1e-9, atol=1e-12, method="LSODA").y[2 if lag else 0]
    model = tc.ODESimulator(
        rates=lambda t, s, p, u: {"C": -p["k"] * s["C"]},
        states={"C": "mg/l"},
        parameters=[tc.Parameter("k", low=0.0, initial=0.4)],
    )
    y = y + noise * np.random.default_rng(seed).standard_normal(60)
    return model, tc.Recording(runs=[tc.Run(time=t, outputs={"C": y}, initial={"C": 2.0})], noise=noise)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_store_that_is_in_no_list_is_no_lag_of_an_instrument(seed):
    # Half of the signal late, and the rest at once, is no instrument.
    terms = [term for term in tc.terms.sensor("C") if term.name.split(" of ")[0] in ("lag", "delay", "offset")]
    d = diagnose(*cleared(seed, store=0.5), terms)
    assert d.verdict in ("ambiguous", "unexplained")
    if d.verdict == "ambiguous":
        assert list(NONE) in d.tied
    d = diagnose(*cleared(seed, store=0.0, lag=1.5), terms)
    assert d.verdict == "named"
    assert d.terms == ["lag of C"]


def rate(seed, offset=0.0, saturates=None, noise=0.01, known=0.0):
    """Michaelis and Menten's law with replicates, as an instrument shows it, beside something known."""
    s = torch.tensor([0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0], dtype=F64).repeat(3)
    v = 2.0 * s / (1.0 + s)
    v = v if saturates is None else v - 0.7 * (v - saturates).clamp_min(0)
    y = known + v + offset + noise * torch.as_tensor(np.random.default_rng(seed).standard_normal(len(s)))
    base = tc.Simulator(
        lambda x, p: {"v": known + p["V"] * x["S"] / (p["K"] + x["S"])},
        [tc.Parameter("V", low=0.0, initial=1.0), tc.Parameter("K", low=0.0, initial=2.0)],
    )
    return base, tc.Recording(x={"S": s}, y={"v": y}, noise=noise)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_an_offset_that_is_in_no_list_is_no_saturation_below_all_data(seed):
    terms = [term for term in tc.terms.sensor("v", static=True) if "offset" not in term.name]
    for known in (0.0, 290.0):  # far from 0 it had been looked for bends elsewhere
        d = diagnose(*rate(seed, offset=0.15, known=known), terms)
        assert d.verdict != "named"
        assert d.verdict == "unexplained" or list(NONE) in d.tied
    d = diagnose(*rate(seed, saturates=1.3), terms)
    assert d.verdict == "named"
    assert d.terms == ["saturation of v"]


@pytest.mark.parametrize(
    ("change", "shape"),
    [
        (lambda y, p: p["c"] * torch.sigmoid((y - p["at"]) / 0.01), tc.Parameter("at", low=1.0, high=16.0)),
        (lambda y, p: p["c"] * y.clamp_min(1e-9) ** p["at"], tc.Parameter("at", low=0.2, high=0.8)),
    ],
)
def test_an_instrument_that_bends_at_the_data_keeps_its_name(change, shape):
    # A step is steep at one datum, and a root at the first: what others do was not seen beside these.
    x = torch.linspace(0.0005, 8, 60, dtype=F64)
    term = tc.Term(
        "own", outputs={"y": lambda x, p, y: y + change(y, p)}, parameters=[tc.Parameter("c", neutral=0.0), shape]
    )
    true = 0.001 + 2 * x
    y = true + change(true, {"c": 0.3, "at": 7.0 if shape.high == 16.0 else 0.5})
    y = y + 0.01 * torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=F64)
    base = tc.Simulator(lambda x, p: 0.001 + p["b"] * x, [tc.Parameter("b")])
    d = diagnose(base, tc.Recording(x=x, y=y, noise=0.01), [term])
    assert d.verdict == "named"


@pytest.mark.parametrize(("true", "verdict"), [(1.12, "named"), (1.5, "ambiguous")])
def test_an_estimate_may_be_somewhat_off_what_nature_has(true, verdict):
    term = tc.Term(
        "bend", outputs={"y": lambda x, p, y: y + p["c"] * x**2}, parameters=[tc.Parameter("c")],
        expected={"c": (1.0, 0.1)},
    )  # fmt: skip
    x = torch.linspace(0, 3, 60, dtype=F64)
    y = 1 + x + true * x**2 + 0.05 * torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=F64)
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    d = diagnose(base, tc.Recording(x=x, y=y, noise=0.05), [term])
    assert d.verdict == verdict
    if verdict == "ambiguous":
        assert "In nature bend.c is 1" in " ".join(str(d).split())


def discharged(seed, tau=2.0, until=None, noise=0.01):
    """A capacitor with a loss that fades, or that ends."""
    t = np.linspace(0.0, 20.0, 100)

    def rates(t, v):
        more = 0.1 * (np.exp(-t / tau) if until is None else float(t < until))
        return [-(0.08 + more) * v[0]]

    v = solve_ivp(rates, (0, 20), [5.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.1).y[0]
    model = tc.ODESimulator(
        rates=lambda t, s, p, u: {"v": -p["a"] * s["v"]},
        states={"v": "V"},
        parameters=[tc.Parameter("a", low=0.0, initial=0.1)],
    )
    v = v + noise * np.random.default_rng(seed).standard_normal(100)
    shunt = tc.Term(
        "shunt", equation="v", rate=lambda t, s, p, u: -p["g"] * s["v"], parameters=[tc.Parameter("g", low=0.0)]
    )
    return model, tc.Recording(runs=[tc.Run(time=t, outputs={"v": v})], noise=noise), [shunt]


@pytest.mark.slow
def test_a_loss_that_fades_is_none_that_ends():
    # It was named where t < 3, from a window's better fit than that of no change.
    d = diagnose(*discharged(0, tau=4.0))
    assert d.verdict == "unexplained"
    assert any("fading shunt" in row.note for row in d.ranking)


@pytest.mark.slow
def test_a_loss_that_ends_is_named():
    d = diagnose(*discharged(0, until=6.0))
    assert d.verdict == "named"
    assert d.terms == ["shunt"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_an_initial_value_that_is_the_first_sample_is_told(seed):
    t = np.linspace(0.0, 5.0, 60)
    model = tc.ODESimulator(
        rates=lambda t, s, p, u: {"n": -p["k"] * s["n"]},
        states={"n": "1"},
        parameters=[tc.Parameter("k", low=0.0, initial=0.4)],
    )
    terms = list(tc.terms.sensor("n", dynamic=False))
    rng = np.random.default_rng(seed)
    y = 2.0 * np.exp(-0.3 * t) + 0.05 * rng.standard_normal(60)
    y[0] = 2.0 + 0.15  # three sd
    run = tc.Run(time=t, outputs={"n": y}, initial={"n": y[0]})
    d = diagnose(model, tc.Recording(runs=[run], noise=0.05), terms)
    assert d.verdict != "consistent"
    (told,) = [row for row in d.symptoms if row.startswith("n(0) was given as the first value recorded")]
    assert "no more than noise" in told
    d = diagnose(model, tc.Recording(runs=[tc.Run(time=t, outputs={"n": y})], noise=0.05), terms)
    assert d.verdict == "consistent"


@pytest.mark.slow
def test_an_initial_value_that_is_wrong_is_told():
    # An offset of the sensor does nearly what it does, and was named.
    t = np.linspace(0.0, 8.0, 80)
    model = tc.ODESimulator(
        rates=lambda t, s, p, u: {"h": u["q"] - p["k"] * s["h"]},
        states={"h": "m"},
        parameters=[tc.Parameter("k", low=0.0, initial=0.4)],
    )
    q = 0.3 + 0.2 * (np.sin(t) > 0)
    exact = [1.0]
    for k in range(79):
        fine = solve_ivp(
            lambda s, h, k=k: np.interp(s, t, q) - 0.5 * h, (t[k], t[k + 1]), [exact[-1]], rtol=1e-9, atol=1e-12
        )
        exact.append(fine.y[0, -1])
    h = np.array(exact) + 0.02 * np.random.default_rng(1).standard_normal(80)
    found = {}
    for given in (1.0, 1.15):
        run = tc.Run(time=t, outputs={"h": h}, inputs={"q": q}, initial={"h": given})
        found[given] = diagnose(model, tc.Recording(runs=[run]), list(tc.terms.sensor("h", dynamic=False)))
    assert found[1.0].verdict == "consistent"
    assert found[1.15].verdict != "consistent"
    rows = [row for row in found[1.15].symptoms if row.startswith("h(0) was given as 1.15 and is ")]
    assert abs(float(rows[0].split()[7]) - 1.0) < 0.06


def test_a_run_of_few_data_says_nothing_of_its_initial_value():
    # One free value for each datum leaves no more than noise, whatever is missing.
    rng = np.random.default_rng(0)
    runs = []
    for begin in np.linspace(0.3, 2, 12):
        t = rng.uniform(0.5, 3)
        left = np.exp(-0.6 * t)
        end = begin * left / (1 + 0.5 * begin * (1 - left) / 0.6)
        runs.append(tc.Run([0.0, t], {"c": [np.nan, end + 0.01 * rng.standard_normal()]}, initial={"c": begin}))
    model = tc.ODESimulator(
        lambda t, s, p, u: {"c": -p["k"] * s["c"]}, {"c": "M"}, [tc.Parameter("k", low=0.0, initial=0.5)]
    )
    term = tc.Term("second order", equation="c", rate=lambda t, s, p, u: -p["q"] * s["c"] ** 2,
                   parameters=[tc.Parameter("q", low=0.0)])  # fmt: skip
    d = diagnose(model, tc.Recording(runs=runs, noise=0.01, missing=True), [term])
    assert ["second order"] in [d.terms, *d.tied]
    assert not [row for row in d.symptoms if row.startswith("c(0)")]


def test_an_exact_initial_value_is_not_blamed_for_what_is_missing():
    t = np.linspace(0.0, 5.0, 60)
    n = solve_ivp(lambda _, n: -0.3 * n - 0.4 * n**2, (0, 5), [1.0], t_eval=t, rtol=1e-9, atol=1e-12).y[0]
    n += 0.01 * np.random.default_rng(0).standard_normal(60)
    n[0] = 1.0  # by which all others are divided
    model = tc.ODESimulator(
        rates=lambda t, s, p, u: {"n": -p["k"] * s["n"]},
        states={"n": "1"},
        parameters=[tc.Parameter("k", low=0.0, initial=0.4)],
    )
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"n": n}, initial={"n": 1.0})], noise=0.01)
    for terms in ([], [tc.terms.kinetics("n")[0]]):
        d = diagnose(model, recording, terms)
        assert d.verdict != "consistent"
        assert not any("first value recorded" in row for row in d.symptoms)


def test_replicates_that_share_a_preparation_are_told():
    rng = np.random.default_rng(0)
    x = np.linspace(0.0, 1.0, 14).repeat(3)
    base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    terms = [tc.Term("cube", outputs={"y": lambda x, p, y: y + p["c"] * x**3}, parameters=[tc.Parameter("c")])]
    y = 1 + 2 * x + 0.05 * rng.standard_normal(14).repeat(3) + 0.01 * rng.standard_normal(42)
    d = diagnose(base, tc.Recording(x=x, y=y), terms)
    assert d.verdict != "consistent"
    assert any("preparation" in row for row in d.symptoms)
    y = 1 + 2 * x + 0.5 * x**3 + 0.01 * rng.standard_normal(42)
    d = diagnose(base, tc.Recording(x=x, y=y), terms)
    assert d.terms == ["cube"]
    assert not any("preparation" in row for row in d.symptoms)


@pytest.mark.parametrize("listed", [True, False])
def test_an_interaction_is_no_shared_preparation(listed):
    u, v = (g.flatten().repeat(3) for g in torch.meshgrid(*[torch.arange(4, dtype=F64)] * 2, indexing="ij"))
    base = tc.Simulator(
        lambda x, p: {"y": p["a"] + p["b"] * x["u"] + p["c"] * x["v"]}, [tc.Parameter(name) for name in "abc"]
    )
    term = tc.Term(
        "interaction", outputs={"y": lambda x, p, y: y + p["q"] * x["u"] * x["v"]}, parameters=[tc.Parameter("q")]
    )
    y = 1 + u + v + 0.3 * u * v + 0.1 * torch.randn(48, generator=torch.Generator().manual_seed(0), dtype=F64)
    d = diagnose(base, tc.Recording(x={"u": u, "v": v}, y={"y": y}), [term] if listed else [])
    assert d.verdict == ("named" if listed else "unexplained")
    assert not any("preparation" in row for row in d.symptoms)


@pytest.mark.slow
def test_a_wind_that_is_in_no_list_is_no_drift_of_a_camera():
    # Seen from the wind the ball flies as without it; launched backwards, and seen by a camera that moves.
    t, rng, runs = np.linspace(0, 3, 40), np.random.default_rng(0), []
    for launch in ([15.0, 12.0], [8.0, 14.0]):
        def rates(_, s):
            through = [s[2] - 15.0, s[3]]
            drag = 0.02 * np.hypot(*through)
            return [s[2], s[3], -drag * through[0], -9.81 - drag * through[1]]

        x, z = solve_ivp(rates, (0, 3), [0.0, 0.0, *launch], t_eval=t, rtol=1e-9).y[:2]
        outputs = {"x": x + 0.03 * rng.standard_normal(40), "z": z + 0.03 * rng.standard_normal(40)}
        runs.append(tc.Run(time=t, outputs=outputs, initial={"x": 0.0, "z": 0.0}))

    def model(t, s, p, u):
        drag = p["c"] * torch.sqrt(s["vx"] ** 2 + s["vz"] ** 2)
        return {"x": s["vx"], "z": s["vz"], "vx": -drag * s["vx"], "vz": -9.81 - drag * s["vz"]}

    c = tc.Parameter("c", low=0.0, initial=0.01)  # calibrated it is 0, where a drift is another launch
    base = tc.ODESimulator(model, ["x", "z", "vx", "vz"], [c], observe=("x", "z"))
    terms = [term for term in tc.terms.sensor(("x", "z"), dynamic=False) if term.name.startswith("drift")]
    d = diagnose(base, tc.Recording(runs=runs, noise=0.03), terms)
    assert d.verdict == "ambiguous"
    assert d.tied == [["drift of x"], list(NONE)]
    assert "varies more by the instrument's error than by the true value" in " ".join(str(d).split())


def test_what_swings_a_parameter_speaks_for_something_unknown():
    # In time a smooth change of a parameter is one of a rate, which has been counted; swings are looked for in both.
    def place(kind, evidence, period=None):
        channel = SimpleNamespace(kind=kind)
        return SimpleNamespace(channel=channel, evidence=evidence, period=period)

    places = [place("parameter", 204.0, 30.6), place("parameter", 190.0), place("equation", 181.0)]
    search = SimpleNamespace(problem=SimpleNamespace(kinds=("equation", "output")))
    found = verdict._unknown(search, SimpleNamespace(places=places, together=None), calibrated=False)
    assert found == pytest.approx(204.0 - np.log(2))


def emptied(seed, begins, noise=0.01):
    """A tank that empties and is filled again, over a weir from a level on."""
    t = np.linspace(0.0, 60.0, 120)

    def rates(t, h):
        return [0.5 * (1 + np.sin(0.3 * t)) - 0.4 * np.sqrt(max(h[0], 0)) - 0.05 * max(h[0] - begins, 0.0) ** 1.5]

    h = solve_ivp(rates, (0, 60), [4.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.5).y[0]
    base = tc.ODESimulator(
        lambda t, s, p, u: {"h": p["b"] * u["q"] - p["a"] * torch.sqrt(torch.relu(s["h"]) + 1e-12)},
        {"h": "m"},
        [tc.Parameter("a", low=0.0, initial=0.3), tc.Parameter("b", low=0.0, initial=0.4)],
    )
    h = h + noise * np.random.default_rng(seed).standard_normal(120)
    run = tc.Run(time=t, outputs={"h": h}, inputs={"q": 1 + np.sin(0.3 * t)}, initial={"h": 4.0})
    return base, tc.Recording(runs=[run], noise=noise)


@pytest.mark.slow
@pytest.mark.parametrize("begins", [0.0, 2.2])
def test_a_threshold_below_all_data_is_none(begins):
    terms = [term for term in tc.terms.hydraulics("h", inflow="q") if term.name in ("overflow", "evaporation")]
    d = diagnose(*emptied(0, begins), terms)
    if begins:
        assert d.terms == ["overflow"]
        return
    assert d.verdict == "ambiguous"
    assert d.tied == [["overflow"], list(NONE)]
    assert "nothing shows that overflow begins there" in " ".join(str(d).split())


@pytest.mark.parametrize("begins", [0.0, 2.5])
@pytest.mark.parametrize("named", [False, True])
def test_a_threshold_below_all_conditions_is_none(begins, named):
    x = torch.linspace(1, 5, 40, dtype=F64)
    noise = 0.02 * torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=F64)
    strain = (lambda x: x["x"]) if named else (lambda x: x)
    base = tc.Simulator(lambda x, p: p["a"] * strain(x), [tc.Parameter("a", low=0.0, initial=1.0)])
    term = tc.Term(
        "stiffening",
        shifts={"a": lambda x, p: p["g"] * (strain(x) - p["x0"]).clamp_min(0)},
        parameters=[tc.Parameter("g", low=0.0), tc.Parameter("x0", low=0.0, high=5.0, initial=2.0)],
        scales={"x0": "x"},
    )
    y = 2 * x + 0.3 * x * (x - begins).clamp_min(0) + noise
    d = diagnose(base, tc.Recording(x={"x": x} if named else x, y=y, noise=0.02), [term])
    if begins:
        assert d.terms == ["stiffening"]
    else:
        assert d.tied == [["stiffening"], list(NONE)]


def pumped(seed, dead=0.0, lag=1e-3):
    """The level of a tank, and its pump's command, which it follows late."""
    t = np.linspace(0.0, 30.0, 240)
    rng = np.random.default_rng(seed)
    waves = [(rng.uniform(0.2, 0.6), rng.uniform(0.3, 2.0), rng.uniform(0.0, 6.3)) for _ in range(4)]

    def command(time):
        return np.where(time < 0, 0.0, 1.5 + sum(size * np.sin(f * time + phase) for size, f, phase in waves))

    def rates(time, s):
        return [0.5 * s[1] - 0.4 * s[0], (command(time - dead) - s[1]) / lag]

    y = solve_ivp(rates, (0, 30), [1.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.05, method="LSODA").y[0]
    model = tc.ODESimulator(
        rates=lambda t, s, p, u: {"h": p["b"] * u["q"] - p["k"] * s["h"]},
        states={"h": "m"},
        parameters=[tc.Parameter("b", low=0.0, initial=0.4), tc.Parameter("k", low=0.0, initial=0.3)],
    )
    run = tc.Run(time=t, outputs={"h": y + 0.01 * rng.standard_normal(len(t))}, inputs={"q": command(t)})
    return model, tc.Recording(runs=[run], noise=0.01)


@pytest.mark.slow
def test_a_pump_takes_no_more_of_its_effect_away_than_there_is():
    terms = [term for term in tc.terms.hydraulics("h", inflow="q") if term.name in ("leak", "pump lag")]
    d = diagnose(*pumped(0, dead=0.4), terms)  # a dead time is in no list
    assert d.verdict == "ambiguous"
    assert d.tied == [["pump lag"], list(NONE)]
    assert "wrong way" in str(d)
    d = diagnose(*pumped(1, lag=0.5, dead=0.0625), terms)  # half a gap between samples late, beside
    assert d.verdict == "named"
    assert d.terms == ["pump lag"]


def test_what_a_term_takes_is_an_input():
    lag = tc.Term("lag", rates={"h": lambda t, s, p, u: p["g"] * s["h"]}, parameters=[tc.Parameter("g")], takes="Q")
    with pytest.raises(tc.errors.DomainError, match=r"one of the inputs \['q'\]. Got 'Q'"):
        diagnose(*pumped(0), [lag])


def test_a_term_that_is_no_drive_may_act_the_wrong_way_at_first():
    swell = tc.Term(
        "shrink and swell",
        rates={"h": lambda t, s, p, u: p["g"] * (s["z"] - u["q"]), "z": lambda t, s, p, u: (u["q"] - s["z"]) / p["T"]},
        states={"z": None},
        parameters=[tc.Parameter("g", low=0.0), tc.Parameter("T", low=0.05, high=10.0, initial=0.5)],
    )
    d = diagnose(*pumped(0, dead=0.4), [swell])
    assert d.ranking[0].terms == ("shrink and swell",)
    assert "wrong way" not in str(d)


def test_steps_are_short_enough_for_the_smaller_of_two_outputs():
    t, scale = np.arange(0, 60, 0.8), 1e4
    z = solve_ivp(
        lambda t, z: [z[1], -4 * z[0] - 0.05 * z[1], 0.3 - 0.1 * z[2]], (0, t[-1]), [1.0, 0.0, 1.0], t_eval=t,
        rtol=1e-11, atol=1e-13,
    ).y  # fmt: skip
    rng = np.random.default_rng(1)
    outputs = {"x": z[0] + 0.002 * rng.standard_normal(75), "T": scale * (z[2] + 0.05 * rng.standard_normal(75))}
    model = tc.ODESimulator(
        lambda t, s, p, u: {
            "x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"], "T": p["h"] * scale - p["g"] * s["T"],
        },
        {"x": "m", "v": "m/s", "T": "Pa"},
        [tc.Parameter(name, low=0.0, initial=at) for name, at in (("k", 4.1), ("c", 0.1), ("h", 0.2), ("g", 0.2))],
        observe=("x", "T"),
    )  # fmt: skip
    d = diagnose(model, tc.Recording(runs=[tc.Run(time=t, outputs=outputs)]), [])
    assert d.verdict == "consistent"
    k, c = d.base.estimates[:2]
    assert abs(k.value - 4.0) < 4 * k.sd < 0.01
    assert abs(c.value - 0.05) < 4 * c.sd < 0.01


def test_steps_are_short_enough_for_the_least_noise():
    """Of noise in proportion to the value, small values are known far better than large ones."""
    t = np.arange(0, 60.0)
    y = solve_ivp(lambda t, y: -0.2 * y * (1 + np.sin(0.7 * t)), (0, 59), [50.0], t_eval=t, rtol=1e-11, atol=1e-14).y[0]
    y *= 1 + 0.012 * np.random.default_rng(1).standard_normal(60)
    model = tc.ODESimulator(
        lambda t, s, p, u: {"W": -p["k"] * s["W"] * (1 + torch.sin(0.7 * t))}, {"W": "mm"},
        [tc.Parameter("k", low=0.0, initial=0.1)],
    )  # fmt: skip
    loss = tc.Term(
        "loss", equation="W", rate=lambda t, s, p, u: -p["b"] * s["W"] ** 2, parameters=[tc.Parameter("b")]
    )  # fmt: skip
    d = diagnose(model, tc.Recording(runs=[tc.Run(time=t, outputs={"W": y})]), [loss, *tc.terms.sensor(("W",))[:1]])
    assert d.verdict == "consistent"
    assert d.base.estimates[0].value == pytest.approx(0.2, rel=0.01)


@pytest.mark.slow
def test_two_outputs_share_what_was_fitted_to_their_replicates():
    """Were every parameter counted against the means of every output, white noise would be a shared preparation."""
    x = torch.linspace(0, 10, 9, dtype=F64).repeat_interleave(4)

    def wave(x, k):
        return torch.cos(k * torch.pi * x / 10)

    def model(x, p):
        return {o: sum(p[f"{o}{k}"] * wave(x, k) for k in range(4)) for o in "uw"}

    base = tc.Simulator(model, [tc.Parameter(f"{o}{k}") for o in "uw" for k in range(4)])
    term = tc.Term("fourth", outputs={"u": lambda x, p, y: y + p["m"] * wave(x, 4)}, parameters=[tc.Parameter("m")])
    for seed in (0, 2, 3):
        noise = 0.3 * torch.randn(2, 36, generator=torch.Generator().manual_seed(seed), dtype=F64)
        y = {o: 1 + wave(x, 1) + e for o, e in zip("uw", noise, strict=True)}
        d = diagnose(base, tc.Recording(x=x, y={**y, "u": y["u"] + 2 * wave(x, 4)}), [term])
        assert d.terms == ["fourth"]
        assert not any("preparation" in row for row in d.symptoms)


def exchanger(seed, truth):
    """Heat and effectiveness of a counter-flow exchanger on a grid of two flows, with noise of unknown size."""
    hot, cold = (v.ravel() for v in np.meshgrid(np.linspace(0.2, 1.2, 6), np.linspace(0.2, 1.2, 5), indexing="ij"))

    def outputs(x, UA, exp):
        first, second = 4.18 * x["hot"], 4.17 * x["cold"]
        e = exp(-UA * (1 / first - 1 / second))
        effectiveness = (1 - e) / (1 - first / second * e)
        return {"Q": effectiveness * first * 60e3, "eff": effectiveness}

    base = tc.Simulator(lambda x, p: outputs(x, p["UA"], torch.exp), [tc.Parameter("UA", low=0.0, initial=1.0)])

    def grows(flow):
        return tc.Term(
            f"grows with {flow}", shifts={"UA": lambda x, p: p["UA"] * ((x[flow] / 0.6) ** p["n"] - 1)},
            parameters=[tc.Parameter("n")],
        )  # fmt: skip

    rng, x = np.random.default_rng(seed), {"hot": hot, "cold": cold}
    y = outputs(x, truth(hot, cold), np.exp)
    y = {name: y[name] + sd * rng.standard_normal(30) for name, sd in (("Q", 710.0), ("eff", 0.0142))}
    return base, tc.Recording(x=x, y=y), [grows("hot"), grows("cold")]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_what_is_left_of_two_outputs_alike_is_no_noise_of_theirs(seed):
    # A switch that is in no list was two smooth dependences, and the rest noise three times as large as it was.
    d = diagnose(*exchanger(seed, lambda hot, cold: 1.8 - 0.3 / (1 + np.exp((hot * cold - 0.5) / 0.02))))
    assert d.verdict in ("ambiguous", "unexplained")
    assert d.verdict == "unexplained" or ["none of these"] in d.tied
    assert "goes with what it leaves of another" in " ".join(str(d).split())


def test_outputs_with_noise_of_their_own_share_nothing():
    d = diagnose(*exchanger(0, lambda hot, cold: 1.6 * (hot / 0.6) ** 0.3))
    assert d.verdict == "named"
    assert d.terms == ["grows with hot"]
    p = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        base, recording, _ = exchanger(seed, lambda hot, cold: 1.6 + 0 * hot)
        problem = Problem.of(base, recording)
        e = torch.as_tensor(rng.standard_normal(60))
        slopes = torch.as_tensor(rng.standard_normal((60, 4)))
        slopes[30:] += slopes[:30]  # what is fitted acts on both
        left = e - slopes @ torch.linalg.lstsq(slopes, e[:, None]).solution[:, 0]
        p.append(between_outputs(problem, left * torch.tensor([3.0, 0.5]).repeat_interleave(30), slopes)[0])
    # Uniform: the number below a tenth is within four of its sd.
    assert abs(sum(one < 0.1 for one in p) - 20) < 4 * math.sqrt(18)
    common = left + 2 * torch.as_tensor(rng.standard_normal(30)).repeat(2)
    assert between_outputs(problem, common, slopes)[0] < 1e-4
    assert between_outputs(problem, common[:30].repeat(2), slopes[:, :0])[0] < 1e-4


def remembering(n, rho, seed):
    """Noise that follows from sample to sample, of unit sd."""
    fresh = np.random.default_rng(seed).standard_normal(n)
    found = fresh[:1].tolist()
    for e in fresh[1:]:
        found.append(rho * found[-1] + math.sqrt(1 - rho**2) * e)
    return torch.tensor(found, dtype=F64)


def test_what_is_left_in_the_order_of_rows_may_be_noise_or_physics():
    """Rows of a grid in an order of its own say nothing of slow noise: what a term leaves was called unexplained."""
    T = torch.linspace(-1, 1, 20, dtype=F64).repeat_interleave(4)
    c = torch.tensor([1.0, 2.0, 4.0, 8.0], dtype=F64).repeat(20)
    base = tc.Simulator(
        lambda x, p: p["a"] + p["b"] * x["T"] + p["d"] * x["c"].log(),
        [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("d")],
    )
    curved = tc.Term(
        "curvature", outputs={"y": lambda x, p, y: y + p["q"] * x["T"] ** 2 * x["c"].log()},
        parameters=[tc.Parameter("q")],
    )  # fmt: skip
    y = 1 + T + 0.3 * c.log() + 0.5 * T**2 * c.log()
    for noise, tied in ((remembering(80, 0.8, 3), [["curvature"], list(NONE)]), (remembering(80, 0.0, 3), [])):
        d = diagnose(base, tc.Recording(x={"T": T, "c": c}, y=y + 0.1 * noise), [curved])
        assert (d.verdict, d.tied) == ("ambiguous" if tied else "named", tied)
        assert ("the same conditions in another order would tell" in " ".join(str(d).split())) == bool(tied)


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "rho"), [(0.3, 0.75), (0.3, 0.0), (0.0, 0.75)])
def test_noise_of_two_colours_may_be_physics_where_the_evidence_comes_from_one_output(gain, rho):
    t, k, m, source = torch.linspace(0, 10, 80, dtype=F64), 0.5, 0.25, 0.0 if gain else 0.05
    decay, fade = torch.exp(-k * t), torch.exp(-m * t)
    a = 2 * decay + source / k * (1 - decay)
    b = 0.3 * fade + k * (2 - source / k) / (m - k) * (decay - fade) + source / m * (1 - fade)
    chain = tc.ODESimulator(
        lambda t, s, p, u: {"a": -p["k"] * s["a"], "b": p["k"] * s["a"] - p["m"] * s["b"]}, {"a": "1", "b": "1"},
        [tc.Parameter("k", low=0.0, initial=0.4), tc.Parameter("m", low=0.0, initial=0.2)],
    )  # fmt: skip
    terms = [
        tc.Term("source", equation="a", rate=lambda t, s, p, u: p["c"] + 0 * s["a"], parameters=[tc.Parameter("c")]),
        tc.Term(
            "gain of b", outputs={"b": lambda t, s, p, u, y: y * (1 + p["g"])}, parameters=[tc.Parameter("g")]
        ),
    ]
    noise = {"a": remembering(80, 0.0, 4), "b": remembering(80, rho, 2)}
    outputs = {"a": a + 0.02 * noise["a"], "b": (1 + gain) * b + 0.02 * noise["b"]}
    d = diagnose(chain, tc.Recording(runs=[tc.Run(time=t, outputs=outputs)]), terms)
    if gain and rho:
        assert d.tied == [["gain of b"], list(NONE)]
        assert "What it leaves of b is correlated from sample to sample" in " ".join(str(d).split())
    else:
        assert d.terms == ["gain of b" if gain else "source"]


def chain(adsorbed: float, seed: int) -> tc.Recording:
    """Activities of a nuclide and its daughter in two samples, the daughter of which is adsorbed and set free again."""
    generator, runs = torch.Generator().manual_seed(seed), []
    rates = torch.tensor([[-0.12, 0, 0], [0.12, -0.5 - adsorbed, 0.1], [0, adsorbed, -0.1]], dtype=torch.float64)
    samples = ((np.r_[np.linspace(0, 4, 12), np.linspace(5, 40, 14)], (100.0, 0.0)), (np.linspace(0, 25, 20), (40, 30)))
    for times, start in samples:
        begin = torch.tensor([*start, 0.0], dtype=torch.float64)
        nuclei = torch.stack([torch.linalg.matrix_exp(rates * time) @ begin for time in times.tolist()])
        noise = 0.15 * torch.randn(len(times), 2, generator=generator, dtype=torch.float64)
        seen = nuclei[:, :2] * torch.tensor([0.12, 0.5], dtype=torch.float64) + noise
        runs.append(tc.Run(time=times, outputs={"A1": seen[:, 0], "A2": seen[:, 1]}))
    return tc.Recording(runs=runs, noise=0.15)


@pytest.mark.slow
def test_two_errors_of_one_instrument_are_no_name_where_the_other_output_is_as_likely_off():
    # They bend to nearly any curve of A1, which the base's rate constant turns into one of A2.
    decay = tc.ODESimulator(
        rates=lambda t, s, p, u: {"N1": -p["k1"] * s["N1"], "N2": p["k1"] * s["N1"] - p["k2"] * s["N2"]},
        states={"N1": "1", "N2": "1"},
        parameters=[tc.Parameter("k1", low=0.0, high=2.0, initial=0.1), tc.Parameter("k2", low=0.0, high=5.0)],
        observe={"A1": lambda t, s, p, u: p["k1"] * s["N1"], "A2": lambda t, s, p, u: p["k2"] * s["N2"]},
    )
    wrong = [t for t in tc.terms.sensor(("A1",)) if t.name in ("offset of A1", "non-linearity of A1")]
    d = tc.diagnose(decay, chain(0.2, seed=2), wrong, seed=0, progress=False)
    assert d.verdict == "ambiguous", str(d)
    assert d.tied == [["offset of A1", "non-linearity of A1"], ["none of these"]]
    told = " ".join(str(d).split())
    assert "Several errors of one instrument follow nearly any curve, and an unknown change of the output" in told
    assert "output A2 along" in told


@pytest.mark.slow
@pytest.mark.parametrize(("offset", "bend"), [(0.1, 0.25), (0.05, 0.1)])
def test_two_errors_of_one_instrument_that_it_has_are_named(offset, bend):
    rng, times = np.random.default_rng(3), np.linspace(0, 12, 90)
    true = np.exp(-0.1 * times) * np.cos(2 * times)
    read = offset + true + bend * true**2 + 0.02 * rng.standard_normal(90)
    spring = tc.ODESimulator(
        rates=lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"]},
        states={"x": "m", "v": "m/s"},
        parameters=[tc.Parameter("k", low=0.0, initial=4.0), tc.Parameter("c", low=0.0, initial=0.1)],
        observe=("x",),
    )
    recording = tc.Recording(runs=[tc.Run(time=times, outputs={"x": read})], noise=0.02)
    wrong = [t for t in tc.terms.sensor(("x",)) if t.name in ("offset of x", "non-linearity of x", "gain error of x")]
    d = tc.diagnose(spring, recording, wrong, seed=0, progress=False)
    assert d.verdict == "named", str(d)
    assert sorted(d.terms) == ["non-linearity of x", "offset of x"]


@pytest.mark.parametrize("size", [0.0, 0.1])
def test_what_two_outputs_share_is_told_where_nothing_is_missing(size):
    """Too fast for anything that is looked for, and no noise of each output."""
    x = torch.linspace(0, 1, 60, dtype=torch.float64)
    rng = np.random.default_rng(0)
    common, *own = (torch.as_tensor(rng.standard_normal(60)) for _ in range(3))
    base = tc.Simulator(
        lambda x, p: {"i": p["a"] * x, "w": p["b"] + p["c"] * x}, [tc.Parameter(name) for name in "abc"]
    )
    y = {"i": 2 * x + size * common + 0.05 * own[0], "w": 5 - 3 * x - 3 * size * common + 0.15 * own[1]}
    d = diagnose(base, tc.Recording(x=x, y=y), [])
    assert d.verdict == "consistent"
    told = "what is left of i goes with what is left of w" in " ".join(str(d).split())
    assert told == (size > 0)


@pytest.mark.parametrize("begun", [1.0, 0.0])
def test_a_pump_that_is_late_may_have_run_before_the_recording(begun):
    """The late flow begins anywhere between none and what is asked for. Begun at none, steady pumps were unexplained,
    and an actuator's lag was called one of the sensor."""
    t = np.arange(0.0, 200.0, 2.0)
    asked = np.where(t < 20, 2.0, 2 + 0.8 * np.sign(np.sin(2 * np.pi * (t - 20) / 70)))
    level = np.empty((2, len(t)))
    level[:, 0] = 1.0, 2.0 * begun
    for j in range(len(t) - 1):
        level[:, j + 1] = solve_ivp(
            lambda _, y, q: [0.01 * y[1] - 0.02 * math.sqrt(y[0]), (q - y[1]) / 8], (0, 2), level[:, j],
            args=(asked[j],), rtol=1e-9, atol=1e-11,
        ).y[:, -1]  # fmt: skip
    noisy = level[0] + 0.003 * np.random.default_rng(1).standard_normal(len(t))
    tank = tc.ODESimulator(
        lambda t, s, p, u: {"h": p["k"] * u["pump"] - p["c"] * s["h"].clamp_min(1e-9).sqrt()}, {"h": "m"},
        [tc.Parameter("k", low=0.0, initial=0.01), tc.Parameter("c", low=0.0, initial=0.02)],
    )  # fmt: skip
    run = tc.Run(time=t, outputs={"h": noisy}, inputs={"pump": asked}, hold="zero")
    library = [
        term for term in tc.terms.hydraulics(level="h", inflow="pump", outlet="c")
        if term.name in ("pump lag", "pump saturation", "seepage", "overflow")
    ]  # fmt: skip
    d = tc.diagnose(tank, tc.Recording(runs=[run]), [*library, *tc.terms.sensor(("h",))], seed=0, progress=False)
    # A sensor that lags, itself anywhere when that begins, does nearly the same to one run.
    assert sorted(d.tied) == [["lag of h"], ["pump lag"]]
    found = {e.name: e for row in d.ranking if row.terms == ("pump lag",) and not row.region for e in row.estimates}
    assert found["pump lag.tau"].value == pytest.approx(8.0, abs=4 * found["pump lag.tau"].sd)
    assert found["pump lag.start"].value == pytest.approx(begun, abs=max(4 * found["pump lag.start"].sd, 0.05))


def late(gain, start, sd, jacobian, states=("late",)):
    """What is away from usual of a lag, fitted with a gain of a base beside it."""
    q = [tc.Parameter(name, neutral=neutral) for name, neutral in (("g", 0.0), ("start", 1.0), ("tau", None))]
    term = SimpleNamespace(parameters=q, full=lambda name: f"lag.{name}", states=states)
    parameters = [tc.Parameter("k"), *(tc.Parameter(f"lag.{one.name}") for one in q)]
    candidate = SimpleNamespace(
        terms=(term,), amplitudes=[1], problem=SimpleNamespace(parameters=parameters), neutral_at=lambda i: 0.0
    )
    values = torch.tensor([1.0, gain, start, 3.0], dtype=F64)
    found = SimpleNamespace(
        values=values, free=[0, 1, 2, 3], sd=lambda: torch.tensor([0.1, 0.1, sd, 0.2], dtype=F64),
        jacobian=torch.tensor(jacobian, dtype=F64),
    )  # fmt: skip
    return _away(SimpleNamespace(candidate=candidate, found=found))


def test_a_shape_at_its_usual_value_costs_no_more_than_it_would_to_have_it_there():
    seen = [[1.0, 2.0, 0.5, 1.0], [1.0, 0.0, 0.1, 0.0]]
    assert late(2.0, 1.06, 0.03, seen) == {"lag.start": pytest.approx(2.0)}
    assert late(2.0, 0.06, 0.03, seen) == {"lag.start": pytest.approx(2.0)}  # where nothing has begun is as usual
    assert late(2.0, 0.5, 0.03, seen) == {"lag.start": pytest.approx(0.5 * (0.5 / 0.03) ** 2)}
    assert late(2.0, 1.06, 0.03, seen, states={}) == {}  # an exponent, say, is a parameter like any other
    unseen = [[1.0, 2.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]]
    assert late(2.0, 0.3, 0.03, unseen) == {"lag.start": 0.0}
    # What does nothing is paid for in full.
    assert late(0.0, 0.3, 0.03, unseen) == {}
    assert late(2.0, 0.3, 0.03, [[1.0, 0.0, 0.0, 0.0]]) == {}


@pytest.mark.slow
def test_a_branch_that_is_stretched_when_the_recording_begins_is_named_alone():
    """With a stretch of nothing then, the lag of a drive that has none was named beside it (0.998)."""
    t = np.linspace(0.0, 23.0, 231)
    force = np.sin(1.3 * t) + 0.7 * np.sign(np.sin(2 * np.pi * t / 7))

    def rates(now, s):
        return [s[1], -4 * s[0] - 0.5 * s[1] + np.interp(now, t, force) - 3 * s[2], s[1] - s[2] / 0.7]

    x = solve_ivp(rates, (0, 23), [0.5, 0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.05).y[0]
    x += 0.004 * np.random.default_rng(3).standard_normal(len(t))
    body = tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]}, {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, initial=3.0), tc.Parameter("c", low=0.0, initial=0.3)], observe=("x",),
    )  # fmt: skip
    run = tc.Run(time=t[30:], outputs={"x": x[30:]}, inputs={"f": force[30:]})
    terms = [*tc.terms.mechanics("x", "v", force="f", angle=False), *tc.terms.sensor(("x",))]
    d = diagnose(body, tc.Recording(runs=[run]), terms)
    assert (d.verdict, d.terms) == ("named", ["viscoelastic branch"])
    found = {e.name: e for e in d.final.estimates}
    for name, truth in (("k", 3.0), ("tau", 0.7)):
        estimate = found[f"viscoelastic branch.{name}"]
        assert estimate.value == pytest.approx(truth, abs=4 * estimate.sd)
