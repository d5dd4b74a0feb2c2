"""The built-in terms of every field: neutral, differentiable, batched, of the right sign and size."""

import math

import pytest
import torch

from torchcal import Parameter
from torchcal.errors import DomainError
from torchcal.simulators import ODESimulator, Values
from torchcal.simulators.careful import takes_inputs
from torchcal.terms import (
    electrical,
    extend,
    hydraulics,
    kinetics,
    mechanics,
    orbital,
    saturation_pressure,
    sensor,
    thermal,
)

# Formulas of a few float64 terms, evaluated twice in different orders.
EXACT = {"rtol": 1e-12, "atol": 1e-12}

SPACE = ("x", "y", "z"), ("vx", "vy", "vz")
PLANE = ("x", "y"), ("vx", "vy")
MECHANICS = ("x", "v"), ("f",), ("k",)
#: By case: the terms, and the states, inputs and parameters of the base model that they may read.
CASES = {
    "mechanics": (mechanics(force="f"), *MECHANICS),
    "mechanics, own stiffness": (mechanics(stiffness="k"), *MECHANICS),
    "mechanics, in a plane": (mechanics(*PLANE), (*PLANE[0], *PLANE[1]), (), ("k",)),
    "mechanics, in space": (mechanics(*SPACE), (*SPACE[0], *SPACE[1]), (), ("k",)),
    "thermal": (thermal(heater="w", loss="k", ambient="Ta"), ("T",), ("w",), ("k", "Ta")),
    "thermal, input": (thermal(ambient="out"), ("T",), ("out",), ("k",)),
    "thermal, number in K": (thermal(ambient=1.5, unit="K"), ("T",), (), ("k",)),
    "hydraulics": (hydraulics(inflow="q", outlet="c"), ("h",), ("q",), ("c",)),
    "hydraulics, downstream": (hydraulics("h", inflow="q", downstream="h2"), ("h", "h2"), ("q",), ("c",)),
    "kinetics": (kinetics("A", "B", temperature="T"), ("A", "B"), ("T",), ("k",)),
    "kinetics, logarithmic": (kinetics(rate="lnk", log_rate=True, temperature="T"), ("A",), (), ("lnk", "T")),
    "electrical": (
        electrical(current="i", capacitance="C", resistance="R", inductance="L"), ("v",), ("i",), ("C", "R", "L")
    ),
    "electrical, current a state": (electrical(current="i", resistance="R"), ("v", "i"), (), ("R",)),
    "electrical, no current": (electrical(resistance="R"), ("v",), (), ("R",)),
    "orbital": (orbital(light=10.0, body=("bx", "by", "bz")), (*SPACE[0], *SPACE[1]), ("bx", "by", "bz"), ("mu",)),
    "orbital, in a plane": (orbital(*PLANE, mu=1.0, light=10.0), (*PLANE[0], *PLANE[1]), (), ("mu",)),
    "sensor": (sensor(("x", "v")), ("x", "v"), (), ("k",)),
    "sensor, of a function": (sensor({"x": lambda t, s, p, u: p["k"] * s["w"]}), ("w",), (), ("k",)),
}  # fmt: skip
TERMS = [pytest.param(case, term, id=f"{case}: {term.name}") for case in CASES for term in CASES[case][0]]


def is_amplitude(parameter):
    return parameter.neutral is not None and parameter.name != "start"


def draw(generator, *size):
    """Between 0.4 and 1.6."""
    return 0.4 + 1.2 * torch.rand(*size, generator=generator, dtype=torch.float64)


def setting(case, term, *, batch=(), runs=2, seed=0, neutral=False):
    """Random t, s, p, u for a term; amplitudes at neutral on request."""
    _, states, inputs, parameters = CASES[case]
    generator = torch.Generator().manual_seed(seed)
    s = {name: draw(generator, *batch, runs) for name in (*states, *term.states)}
    u = {name: draw(generator, runs) for name in inputs}
    p = {name: draw(generator, *batch, 1) for name in parameters}
    for parameter in term.parameters:
        value = draw(generator, *batch, 1)
        if is_amplitude(parameter):
            value = torch.zeros_like(value) if neutral else 0.2 * value
        elif parameter.name not in term.scales:
            value = parameter.low + (parameter.high - parameter.low) * value / 2.0
        else:
            value = 0.7 * value
        p[parameter.name] = value
    return draw(generator, runs), s, p, u


def contributions(term, t, s, p, u):
    """Everything that a term adds or replaces, hidden states' own rates included, each of the states' shape."""
    y = 1.1 * next(iter(s.values())) + 0.3
    p = dict.fromkeys(term.constants, 1.5) | p
    found = {f"d{name}": function(t, s, p, u) for name, function in term.rates.items()}
    found |= {f"-> {name}": function(t, s, p, u) for name, function in term.shifts.items()}
    found |= {f"y {name}": function(t, s, p, u, y) - y for name, function in term.outputs.items()}
    return {name: torch.broadcast_to(value, y.shape) for name, value in found.items()}


def visible(term, found):
    return {name: value for name, value in found.items() if name[1:] not in term.states}


@pytest.mark.parametrize(("case", "term"), TERMS)
def test_neutral_amplitudes_leave_everything_exactly_as_it_is(case, term):
    for seed in range(5):
        found = visible(term, contributions(term, *setting(case, term, batch=(3,), seed=seed, neutral=True)))
        assert found
        for value in found.values():
            assert torch.equal(value, torch.zeros_like(value))


@pytest.mark.parametrize(("case", "term"), TERMS)
def test_something_happens_away_from_neutral(case, term):
    found = [visible(term, contributions(term, *setting(case, term, seed=seed))) for seed in range(5)]
    for name in found[0]:
        assert any(bool((each[name] != 0).any()) for each in found), name


def as_function(case, term, t, s, p, u):
    """A term's contributions as a function of its states and parameters, for autograd."""
    names = [*s, *p]

    def function(*values):
        given = dict(zip(names, values, strict=True))
        at = ({name: given[name] for name in s}, {name: given[name] for name in p})
        found = contributions(term, t, *at, u)
        # A state that only remembers its first value has no derivatives to look at.
        return tuple(value for name, value in found.items() if not name.endswith("(0)"))

    return function, [*s.values(), *p.values()]


@pytest.mark.parametrize(("case", "term"), TERMS)
def test_forward_and_reverse_derivatives_are_right(case, term):
    function, values = as_function(case, term, *setting(case, term, seed=1))
    leaves = tuple(value.clone().requires_grad_(True) for value in values)
    assert torch.autograd.gradcheck(function, leaves, check_forward_ad=True, raise_exception=True)


@pytest.mark.parametrize("neutral", [True, False])
@pytest.mark.parametrize(("case", "term"), TERMS)
def test_values_and_derivatives_are_finite_at_rest_and_when_empty(case, term, neutral):
    t, s, p, u = setting(case, term, neutral=neutral)
    for name in s:
        # A body at the very centre of gravity has no orbit.
        if case.startswith("orbital") and name in ("x", *term.states):
            continue
        # A temperature at rest is that of its surroundings.
        rest = p.get("Ta", u.get("out", torch.full((1,), 1.5))) if case.startswith("thermal") else torch.zeros(1)
        s[name] = rest.to(torch.float64).expand(s[name].shape).clone()
    t = torch.zeros_like(t)
    u = {name: value if name in ("T", "out", "bx") else torch.zeros_like(value) for name, value in u.items()}
    function, values = as_function(case, term, t, s, p, u)
    assert all(bool(torch.isfinite(value).all()) for value in function(*values))
    for i in range(len(values)):
        tangents = tuple(torch.ones_like(v) if i == j else torch.zeros_like(v) for j, v in enumerate(values))
        _, pushed = torch.func.jvp(function, tuple(values), tangents)
        assert all(bool(torch.isfinite(value).all()) for value in pushed)
    leaves = [value.clone().requires_grad_(True) for value in values]
    total = sum(value.sum() for value in function(*leaves))
    grads = torch.autograd.grad(total, leaves, allow_unused=True)
    assert all(grad is None or bool(torch.isfinite(grad).all()) for grad in grads)


@pytest.mark.parametrize("case", [case for case in CASES if case.split(",")[0] in ("hydraulics", "kinetics")])
def test_negative_levels_and_concentrations_give_numbers(case):
    for term in CASES[case][0]:
        t, s, p, u = setting(case, term)
        found = contributions(term, t, {name: -0.1 * value for name, value in s.items()}, p, u)
        assert all(bool(torch.isfinite(value).all()) for value in found.values()), term.name


@pytest.mark.parametrize(("case", "term"), TERMS)
def test_a_batch_gives_what_its_members_give_alone(case, term):
    t, s, p, u = setting(case, term, batch=(4, 3))
    together = contributions(term, t, s, p, u)
    for i, j in ((0, 0), (3, 1)):
        row = {name: value[i, j] for name, value in s.items()}
        alone = contributions(term, t, row, {name: value[i, j] for name, value in p.items()}, u)
        for name, value in together.items():
            torch.testing.assert_close(value[i, j], alone[name], **EXACT)
            assert value.dtype == torch.float64


@pytest.mark.parametrize(("case", "term"), TERMS)
def test_initial_values_of_hidden_states(case, term):
    _, s, p, u = setting(case, term, batch=(4,), runs=1)
    known = {name: value for name, value in s.items() if name not in term.states}
    assert set(term.initial) == set(term.states) <= set(term.rates)
    for value in term.initial.values():
        if callable(value):
            given = p | term.numbers
            found = value(known, given, u) if takes_inputs(value) else value(known, given)
            assert found.shape == (4, 1)
            assert bool(torch.isfinite(found).all())
        else:
            assert value in known or value == 0.0


@pytest.mark.parametrize("case", CASES)
def test_names_units_and_words(case):
    terms, states, _, parameters = CASES[case]
    names = [term.name for term in terms]
    assert len(set(names)) == len(names)
    hidden = [state for term in terms for state in term.states]
    assert len(set(hidden)) == len(hidden)
    assert not set(hidden) & set(states)
    assert len({term.formula for term in terms}) == len(terms)
    for term in terms:
        assert term.formula
        assert term.description.endswith(".")
        assert any(is_amplitude(parameter) for parameter in term.parameters)
        assert all(term.states.values())
        for parameter in term.parameters:
            assert parameter.unit
            assert parameter.name not in parameters or parameter.name not in term.shifts
            assert parameter.name in term.formula
            if is_amplitude(parameter):
                assert parameter.neutral == 0.0
                assert parameter.name not in term.scales
            else:
                bounded = parameter.low is not None and parameter.high is not None
                assert bounded != (parameter.name in term.scales)


def test_friction_of_an_angular_velocity_w_has_a_formula_that_can_be_read():
    term = term_of(mechanics("angle", "w"), "Coulomb friction")
    assert term.formula == "dw/dt ∋ -c sign(w), smoothed as -c tanh(3 w/w_)"
    assert [parameter.name for parameter in term.parameters] == ["c", "w_"]
    assert term.scales == {"w_": "w"}


@pytest.mark.parametrize("case", CASES)
def test_the_whole_library_extends_a_base_model_and_changes_nothing(case):
    terms, states, inputs, parameters = CASES[case]

    def rates(t, s, p, u):
        return {name: p[parameters[0]] * s[name] + 0.1 for name in states}

    observe = {name: lambda t, s, p, u, name=name: s[name] for name in states}
    if case == "sensor, of a function":
        observe["x"] = lambda t, s, p, u: p["k"] * s["w"]
    base = ODESimulator(rates, dict.fromkeys(states, "1"), [Parameter(name) for name in parameters], observe=observe)
    wide = extend(base, terms)
    generator = torch.Generator().manual_seed(0)
    s = {name: draw(generator, 3, 2) for name in wide.states}
    u = {name: draw(generator, 2) for name in inputs}
    p = Values({parameter.name: draw(generator, 3, 1) for parameter in wide.parameters}, 0.0, 0.0)
    for term in terms:
        for parameter in term.parameters:
            if is_amplitude(parameter):
                p[term.full(parameter.name)] *= 0.0
    t = draw(generator, 2)
    before, after = base.rates(t, s, p, u), wide.rates(t, s, p, u)
    for name in states:
        assert torch.equal(after[name], before[name].expand_as(after[name]))
    for name in base.outputs:
        assert torch.equal(wide.observe[name](t, s, p, u), base.observe[name](t, s, p, u))


# --- signs ----------------------------------------------------------------------------------------------------


def term_of(terms, name):
    return next(term for term in terms if term.name == name)


@pytest.mark.parametrize("name", ["linear drag", "quadratic drag", "cubic drag", "Coulomb friction"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("case", ["mechanics", "mechanics, in a plane", "mechanics, in space"])
def test_drag_and_friction_take_energy(case, name, sign):
    term = term_of(CASES[case][0], name)
    t, s, p, u = setting(case, term, batch=(20,))
    s = {state: sign * value for state, value in s.items()}
    power = sum(function(t, s, p, u) * s[state] for state, function in term.rates.items())
    assert bool((power < 0).all())
    assert term.parameters[0].low == 0.0


@pytest.mark.parametrize("name", ["linear spring", "end stop", "Stribeck friction", "viscoelastic branch"])
def test_springs_and_friction_push_back(name):
    term = term_of(CASES["mechanics"][0], name)
    t, s, p, u = setting("mechanics", term, batch=(20,))
    forward, back = (term.rates["v"](t, {state: sign * value for state, value in s.items()}, p, u) for sign in (1, -1))
    assert bool((forward <= 0).all())
    assert bool((forward < 0).any())
    torch.testing.assert_close(back, -forward, **EXACT)
    assert term.parameters[0].low == 0.0


@pytest.mark.parametrize(
    "name", ["Newton cooling", "natural convection", "radiation", "evaporation", "second heat capacity"]
)
@pytest.mark.parametrize("hot", [True, False])
def test_heat_flows_from_hot_to_cold(name, hot):
    term = term_of(thermal(ambient=20.0, humidity=1.0), name)
    p = {q.name: torch.tensor([0.5], dtype=torch.float64) for q in term.parameters}
    s = {state: torch.full((1,), 20.0, dtype=torch.float64) for state in ("T", *term.states)}
    s["T"] = torch.full((1,), 80.0 if hot else 5.0, dtype=torch.float64)
    rate = term.rates["T"](torch.zeros(1), s, p, {})
    assert bool((rate < 0 if hot else rate > 0).all())
    assert term.parameters[0].low == 0.0


@pytest.mark.parametrize(
    ("case", "name", "state"),
    [
        ("hydraulics", "leak", "h"),
        ("hydraulics", "seepage", "h"),
        ("hydraulics", "overflow", "h"),
        ("hydraulics", "evaporation", "h"),
        ("hydraulics", "bypass", "h"),
        ("hydraulics", "pump saturation", "h"),
        ("hydraulics", "clogging", "c"),
        ("kinetics", "second-order decay", "A"),
        ("kinetics", "second branch", "A"),
        ("kinetics", "consecutive reaction", "B"),
        ("kinetics", "autocatalysis", "A"),
        ("kinetics", "saturation", "k"),
        ("kinetics", "product inhibition", "k"),
        ("kinetics", "deactivation", "k"),
        ("electrical", "shunt", "v"),
        ("electrical", "diode conduction", "v"),
        ("electrical", "saturation of the inductance", "L"),
        ("orbital", "drag", "vx"),
        ("orbital, in a plane", "oblateness", "vx"),
    ],
)
def test_losses_are_losses(case, name, state):
    term = term_of(CASES[case][0], name)
    found = contributions(term, *setting(case, term, batch=(20,)))
    value = found.get(f"d{state}", found.get(f"-> {state}"))
    assert bool((value <= 0).all())
    assert bool((value < 0).any())
    assert term.parameters[0].low == 0.0


@pytest.mark.parametrize(
    ("case", "name", "state"),
    [
        ("kinetics", "reverse reaction", "dA"),
        ("electrical", "self-heating", "-> R"),
        ("electrical", "series resistance", "y v"),
        ("orbital", "radiation pressure", "dvx"),
    ],
)
def test_gains_are_gains(case, name, state):
    term = term_of(CASES[case][0], name)
    assert bool((contributions(term, *setting(case, term, batch=(20,)))[state] > 0).all())
    assert term.parameters[0].low == 0.0


@pytest.mark.parametrize("name", ["reverse reaction", "autocatalysis"])
def test_what_one_species_loses_the_other_gains(name):
    term = term_of(CASES["kinetics"][0], name)
    found = contributions(term, *setting("kinetics", term))
    torch.testing.assert_close(found["dA"], -found["dB"], **EXACT)
    # Without a visible product it is what has become of the reactant.
    alone = term_of(kinetics("A", rate=None), name)
    t, s, p, u = setting("kinetics", term)
    first = next(iter(alone.states))
    hidden = alone.rates["A"](t, {"A": s["A"], first: s["A"] + s["B"]}, p, u)
    torch.testing.assert_close(hidden, found["dA"], **EXACT)


def test_what_bypasses_a_tank_arrives_downstream():
    term = term_of(CASES["hydraulics, downstream"][0], "bypass")
    found = contributions(term, *setting("hydraulics, downstream", term))
    torch.testing.assert_close(found["dh"], -found["dh2"], **EXACT)


# --- sizes ----------------------------------------------------------------------------------------------------


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_dry_friction_is_fully_developed_at_its_speed():
    term = term_of(mechanics(), "Coulomb friction")
    rate = term.rates["v"](0.0, {"v": tensor(0.1, 1.0, 9.0)}, {"c": tensor(2.0), "w": tensor(0.1)}, {})
    torch.testing.assert_close(rate, tensor(-2.0, -2.0, -2.0), rtol=0.006, atol=0)


def test_large_angle_sine_completes_the_small_angle():
    x = torch.linspace(-3, 3, 7, dtype=torch.float64)
    for stiffness, p in (("k", {"k": tensor(4.0)}), (lambda p: p["g"] / p["L"], {"g": tensor(8.0), "L": tensor(2.0)})):
        term = term_of(mechanics(stiffness=stiffness), "large-angle sine")
        whole = -4.0 * x + term.rates["v"](0.0, {"x": x}, {"fraction": tensor(1.0), **p}, {})
        torch.testing.assert_close(whole, -4.0 * x.sin(), **EXACT)
    assert "large-angle sine" not in [term.name for term in mechanics(angle=False)]


def test_a_parameter_of_the_model_is_not_hidden_by_one_of_the_term():
    for name in ("fraction", "fraction_"):
        term = term_of(mechanics(stiffness=name), "large-angle sine")
        assert name not in [parameter.name for parameter in term.parameters]
    assert term_of(kinetics(rate="m"), "reaction order").parameters[0].name == "m_"
    assert term_of(thermal(ambient="c"), "radiation").parameters[0].name == "c_"


def test_vapour_pressure_of_water():
    # Steam tables: 1.2282, 3.1699, 12.352 and 101.42 kPa; Antoine's formula is within 0.6 %.
    found = saturation_pressure(tensor(10.0, 25.0, 50.0, 100.0))
    torch.testing.assert_close(found, tensor(1.2282, 3.1699, 12.352, 101.42), rtol=6e-3, atol=0)


def test_radiation_is_linear_loss_near_room_temperature_in_both_units():
    p = {"c": tensor(0.5)}
    celsius = term_of(thermal(ambient=19.9), "radiation").rates["T"](0.0, {"T": tensor(20.1)}, p, {})
    kelvin = term_of(thermal(ambient=293.05, unit="K"), "radiation").rates["T"](0.0, {"T": tensor(293.25)}, p, {})
    torch.testing.assert_close(celsius, tensor(-0.1), rtol=1e-5, atol=0)
    torch.testing.assert_close(kelvin, celsius, rtol=1e-9, atol=0)


def test_natural_convection_by_hand():
    term = term_of(thermal(ambient=20.0), "natural convection")
    rate = term.rates["T"](0.0, {"T": tensor(36.0, 4.0)}, {"c": tensor(0.1)}, {})
    torch.testing.assert_close(rate, tensor(-3.2, 3.2), **EXACT)  # 16^1.25 = 32


def test_second_heat_capacity_begins_between_ambient_and_the_first():
    for ambient, p, u in ((20.0, {}, {}), ("Ta", {"Ta": tensor(20.0)}, {}), ("out", {}, {"out": tensor(20.0)})):
        term = term_of(thermal(ambient=ambient), "second heat capacity")
        (begin,) = term.initial.values()
        found = begin({"T": tensor(60.0)}, {"start": tensor(0.25), **p}, u)
        torch.testing.assert_close(found, tensor(30.0), **EXACT)


def test_torricelli_and_weir_by_hand():
    leak = term_of(hydraulics(), "leak").rates["h"](0.0, {"h": tensor(0.25)}, {"c": tensor(2.0)}, {})
    torch.testing.assert_close(leak, tensor(-1.0), rtol=1e-5, atol=0)
    p = {"c": tensor(2.0), "h0": tensor(1.0)}
    weir = term_of(hydraulics(), "overflow").rates["h"](0.0, {"h": tensor(0.9, 1.25)}, p, {})
    torch.testing.assert_close(weir, tensor(0.0, -0.25), **EXACT)


@pytest.mark.parametrize(
    ("name", "p", "factor"),
    [
        ("reaction order", {"m": -0.5}, (3.0 / 12.0) ** -0.5),
        ("saturation", {"K": 2.0}, 1.0 / 7.0),
        ("product inhibition", {"K": 2.0}, 1.0 / 9.0),
        ("deactivation", {"r": 0.1}, math.exp(-0.5)),
        ("temperature exponent", {"n": 2.0}, 4.0),
        # exp(50000/8.314463 (1/300 - 1/600)) with the textbook's gas constant
        ("activation energy", {"E": 50000.0}, math.exp(50000.0 / 8.314463 / 600.0)),
    ],
)
@pytest.mark.parametrize("log_rate", [False, True])
def test_corrections_of_the_rate_constant(name, p, factor, log_rate):
    term = term_of(kinetics("A", "B", temperature="T", log_rate=log_rate), name)
    s = {"A": tensor(3.0), "B": tensor(4.0)}
    given = {"k": tensor(math.log(5.0) if log_rate else 5.0), **{key: tensor(value) for key, value in p.items()}}
    given |= dict.fromkeys(term.constants, 12.0)
    moved = given["k"] + term.shifts["k"](tensor(5.0), s, given, {"T": tensor(600.0)})
    torch.testing.assert_close(moved.exp() if log_rate else moved, tensor(5.0 * factor), rtol=1e-6, atol=0)


def test_order_about_a_given_reference():
    term = term_of(kinetics(reference=6.0), "reaction order")
    assert term.constants == {"A_ref": 6.0}
    assert "(A/6)^m" in term.formula
    p = term.own({"k": tensor(2.0), "reaction order.m": tensor(1.0)})
    found = term.shifts["k"](0.0, {"A": tensor(3.0)}, p, {})
    torch.testing.assert_close(found, tensor(-1.0), **EXACT)


def test_diffusion_element_falls_as_one_over_the_root_of_time():
    term = term_of(electrical(), "Warburg element")
    branches = sorted(term.states)
    p = {"k": tensor(1.0), "tau": tensor(1.0)}

    def current(t):
        # After a unit step every branch follows exponentially, with its rate from rest.
        rest = {"v": tensor(1.0), **{branch: tensor(0.0) for branch in branches}}
        speed = {branch: float(term.rates[branch](0.0, rest, p, {})) for branch in branches}
        s = {"v": tensor(1.0), **{b: tensor(1.0 - math.exp(-speed[b] * t)) for b in branches}}
        return -float(term.rates["v"](0.0, s, p, {}))

    times = [0.4, 0.8, 1.5, 3.0, 6.0, 12.0, 20.0, 38.0]
    level = [current(time) * math.sqrt(time) for time in times]
    assert max(level) / min(level) < 1.04 / 0.92 * 1.01


def test_a_hard_limit_clips_both_sides():
    term = term_of(sensor(("x",)), "saturation of x")
    y = term.outputs["x"](0.0, {}, {"c": tensor(1.0), "y0": tensor(2.0)}, {}, tensor(-5.0, -1.0, 1.5, 3.0))
    torch.testing.assert_close(y, tensor(-2.0, -1.0, 1.5, 2.0), **EXACT)


def response(term, p, signal, end, steps=2000):
    """What the instrument shows at the end, by Runge-Kutta; the signal is the state x."""
    p = {name: tensor(value) for name, value in ({"start": 0.0} | p | term.numbers).items()}
    hidden = list(term.states)
    z = [term.initial[name] for name in hidden]
    z = torch.stack([value({"x": signal(tensor(0.0))}, p, {}) if callable(value) else tensor(value) for value in z])

    def slope(t, z):
        s = {"x": signal(t), **dict(zip(hidden, z, strict=True))}
        return torch.stack([term.rates[name](t, s, p, {}) for name in hidden])

    h, t = end / steps, tensor(0.0)
    for _ in range(steps):
        k1 = slope(t, z)
        k2 = slope(t + h / 2, z + h / 2 * k1)
        k3 = slope(t + h / 2, z + h / 2 * k2)
        k4 = slope(t + h, z + h * k3)
        z, t = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), t + h
    s = {"x": signal(t), **dict(zip(hidden, z, strict=True))}
    return float(term.outputs["x"](t, s, p, {}, signal(t)))


@pytest.mark.parametrize(
    ("case", "term"), [one for one in TERMS if any(q.name == "start" for q in one.values[1].parameters)]
)
def test_hidden_states_begin_where_they_usually_do_unless_data_tell(case, term):
    _, s, p, u = setting(case, term, batch=(4,), runs=1)
    s = {name: value for name, value in s.items() if name not in term.states}
    (begins,) = {*term.initial.values()}  # branches of a ladder begin alike
    found = []
    for share in (0.0, 0.25, 1.0):
        given = p | term.numbers | {"start": tensor(share)}
        found.append(begins(s, given, u) if takes_inputs(begins) else begins(s, given))
    torch.testing.assert_close(found[1], found[0] + 0.25 * (found[2] - found[0]), **EXACT)
    assert bool((found[2] != found[0]).all())
    (start,) = (parameter for parameter in term.parameters if parameter.name == "start")
    if term.name == "second heat capacity":  # nothing is usual of it
        assert start.neutral is None
    else:
        assert start.neutral in (0.0, 1.0)
        assert start.low < start.neutral < start.high


def test_response_time_of_a_lag():
    term = term_of(sensor(("x",)), "lag of x")
    assert response(term, {"a": 1.0, "t90": 3.0}, lambda t: (t > 0).double(), 3.0) == pytest.approx(0.9, abs=2e-3)


@pytest.mark.parametrize(
    ("lateness", "error", "end"),
    [
        pytest.param(lateness, error, end, marks=() if lateness > 1 or end == 10 else pytest.mark.slow)
        for lateness, error in ((0.25, 1e-3), (0.6, 1e-3), (1.25, 0.03))
        for end in (9.0, 10.0, 11.3)
    ],
)
def test_delay_of_a_slow_signal(lateness, error, end):
    # At ω D = 1.2 the approximant of exp(-i ω D) is off by 0.0003, at 2.5 by 0.025.
    term = term_of(sensor(("x",)), "delay of x")
    shown = response(term, {"a": 1.0, "D": lateness}, lambda t: torch.sin(2.0 * t), end)
    assert shown == pytest.approx(math.sin(2.0 * (end - lateness)), abs=error)


def test_static_sensors():
    terms = sensor(("y",), static=True, drift="T0")
    x, y = {"T0": tensor(1.0, 2.0)}, tensor(3.0, -4.0)
    p = {name: tensor(0.5) for name in ("b", "g", "q", "c", "y0")}
    wanted = {
        "offset of y": tensor(3.5, -3.5),
        "gain error of y": tensor(4.5, -6.0),
        "non-linearity of y": tensor(7.5, 4.0),
        "saturation of y": tensor(1.75, -2.25),
        "drift of y": tensor(3.5, -3.0),
    }
    assert {term.name for term in terms} == set(wanted)
    for term in terms:
        assert not term.states
        torch.testing.assert_close(term.outputs["y"](x, p, y), wanted[term.name], **EXACT)
    drift = term_of(terms, "drift of y")
    torch.testing.assert_close(drift.outputs["y"](x["T0"], p, y), wanted["drift of y"], **EXACT)
    drift = term_of(sensor(("y",), static=True, drift={"T0": 2.0}), "drift of y")
    torch.testing.assert_close(drift.outputs["y"](x, p, y), tensor(2.5, -4.0), **EXACT)
    assert drift.formula == "y → y + b (T0 - 2)"


def precession(term, p, *, mu, a, e, positions=("x", "y"), velocities=("vx", "vy")):
    """Turn of the pericentre in one revolution, to first order: Gauss's equation along the unperturbed ellipse."""
    f = torch.linspace(0, 2 * math.pi, 2001, dtype=torch.float64)[:-1]
    size = a * (1 - e**2)
    r, h = size / (1 + e * f.cos()), math.sqrt(mu * size)
    s = {name: torch.zeros_like(f) for name in (*positions, *velocities)}
    s |= {"x": r * f.cos(), "y": r * f.sin(), "vx": -mu / h * f.sin(), "vy": mu / h * (e + f.cos())}
    s |= {state: torch.full_like(f, a) for state in term.states}
    ax, ay = (term.rates[name](0.0, s, {key: tensor(v) for key, v in p.items()}, {}) for name in velocities[:2])
    radial, across = ax * f.cos() + ay * f.sin(), -ax * f.sin() + ay * f.cos()
    turn = (-radial * f.cos() + across * (1 + r / size) * f.sin()) * h / (mu * e)
    return float((turn * r**2 / h).mean()) * 2 * math.pi


@pytest.mark.parametrize("space", [PLANE, SPACE])
def test_perihelion_of_mercury(space):
    mu, a, e = 1.32712440018e20, 5.790905e10, 0.205630
    term = term_of(orbital(*space, mu=mu), "relativity")
    turn = precession(term, {"fraction": 1.0}, mu=mu, a=a, e=e, positions=space[0], velocities=space[1])
    assert turn == pytest.approx(6 * math.pi * mu / (299792458.0**2 * a * (1 - e**2)), rel=1e-9)
    # 43 arc seconds in a century of 36525 days, with 87.969 days a revolution.
    assert math.degrees(turn) * 3600 * 36525 / 87.969 == pytest.approx(42.98, abs=0.01)


@pytest.mark.parametrize("space", [PLANE, SPACE])
def test_equatorial_orbit_about_an_oblate_body(space):
    term = term_of(orbital(*space, mu=2.0), "oblateness")
    turn = precession(term, {"q": 0.01}, mu=2.0, a=3.0, e=0.3, positions=space[0], velocities=space[1])
    assert turn == pytest.approx(3 * math.pi * 0.01 / (3.0 * (1 - 0.3**2)) ** 2, rel=1e-9)


def test_oblateness_is_the_gradient_of_its_potential():
    # U = -q mu/r³ (3 z²/r² - 1)/2, acceleration = grad U
    r = tensor(0.7, -0.4, 0.9).requires_grad_(True)
    d = r.square().sum().sqrt()
    (wanted,) = torch.autograd.grad(-0.1 * 2.0 / d**3 * 0.5 * (3 * (r[2] / d) ** 2 - 1), r)
    term = term_of(orbital(mu=2.0), "oblateness")
    s = {name: r.detach()[i : i + 1] for i, name in enumerate("xyz")}
    found = [term.rates[name](0.0, s, {"q": tensor(0.1)}, {}) for name in SPACE[1]]
    torch.testing.assert_close(torch.cat(found), wanted, **EXACT)


def test_pericentre_under_another_exponent_of_gravity():
    # Nearly circular orbits in a force r^-(2+e) turn by 2π (1/√(1-e) - 1) a revolution: π e to first order.
    term = term_of(orbital(*PLANE, mu=1.0, reference=2.0), "exponent of gravity")
    turn = precession(term, {"e": 1e-6, **term.constants}, mu=1.0, a=2.0, e=1e-3)
    assert turn == pytest.approx(math.pi * 1e-6, rel=1e-4)


def test_a_distant_third_body_is_a_tide():
    s = {name: tensor(value) for name, value in zip((*PLANE[0], *PLANE[1]), (0.3, -0.2, 0.0, 0.0), strict=True)}
    far, angle, mu3 = 1e4, 0.7, 5.0
    near = term_of(orbital(*PLANE, body=lambda t: (far * math.cos(angle), far * math.sin(angle))), "third body")
    tide = term_of(orbital(*PLANE), "third body")
    for name in PLANE[1]:
        exact = near.rates[name](0.0, s, {"mu3": tensor(mu3)}, {})
        linear = tide.rates[name](0.0, s, {"k": tensor(mu3 / far**3), "angle": tensor(angle)}, {})
        # The next term of the expansion is smaller by r/far = 4e-5.
        torch.testing.assert_close(linear, exact, rtol=5e-4, atol=0)


# --- what goes in ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: mechanics(position=""), "position"),
        (lambda: mechanics(velocity=3), "positions"),
        (lambda: mechanics(("x", "y"), velocity=3), "velocities"),
        (lambda: mechanics(("x", "y"), ("vx",)), "velocities"),
        (lambda: mechanics(("x", "x"), ("vx", "vy")), "once"),
        (lambda: mechanics(("x", "y", "z", "w"), ("a", "b", "c", "d")), "2 or 3"),
        (lambda: mechanics(force=""), "force"),
        (lambda: mechanics(*PLANE, force="F"), "force= with one position"),
        (lambda: mechanics(*SPACE, stiffness="k"), "stiffness= with one position"),
        (lambda: mechanics(stiffness=""), "stiffness"),
        (lambda: mechanics(label=""), "label"),
        (lambda: mechanics(length=""), "length"),
        (lambda: thermal(temperature=None), "temperature"),
        (lambda: thermal(ambient=math.nan), "ambient"),
        (lambda: thermal(ambient=""), "ambient"),
        (lambda: thermal(unit="F"), "degC"),
        (lambda: thermal(ambient=-5.0, unit="K"), "ambient"),
        (lambda: thermal(humidity=50), "humidity"),
        (lambda: thermal(heater=""), "heater"),
        (lambda: hydraulics(level=""), "level"),
        (lambda: hydraulics(inflow=1.0), "inflow"),
        (lambda: hydraulics(outlet="k", reference=-1.0), "reference"),
        (lambda: hydraulics(time=""), "time"),
        (lambda: hydraulics(inflow="q", downstream=""), "downstream"),
        (lambda: kinetics(reactant=""), "reactant"),
        (lambda: kinetics("A", "A"), "different"),
        (lambda: kinetics(reference=0.0), "reference"),
        (lambda: kinetics(reference_temperature=-1.0), "reference_temperature"),
        (lambda: kinetics(temperature=300.0), "temperature"),
        (lambda: electrical(voltage=""), "voltage"),
        (lambda: electrical(inductance="L"), "current"),
        (lambda: electrical(volt=""), "volt"),
        (lambda: electrical(ampere=1.0), "ampere"),
        (lambda: orbital(positions=()), "positions"),
        (lambda: orbital(positions=("x", "y")), "velocities"),
        (lambda: orbital(positions="xyz"), "positions"),
        (lambda: orbital(mu=None), "gravitational"),
        (lambda: orbital(light=0.0), "light"),
        (lambda: orbital(body=("a", "b")), "third body"),
        (lambda: sensor(outputs=()), "outputs"),
        (lambda: sensor(outputs=("x", "x")), "once"),
        (lambda: sensor(outputs={"x": 3.0}), "functions"),
        (lambda: sensor(drift="T0"), "static"),
        (lambda: sensor(static=True, drift={"T0": float("nan")}), "drift"),
        (lambda: sensor(static=True, drift=2.0), "drift"),
        (lambda: sensor(units="m"), "units"),
    ],
)
def test_bad_arguments(build, message):
    with pytest.raises(DomainError, match=message):
        build()


def test_what_a_term_does_not_find_it_asks_for():
    term = term_of(thermal(), "Newton cooling")
    with pytest.raises(DomainError, match="'Ta'"):
        term.rates["T"](0.0, {"T": tensor(1.0)}, {"k": tensor(1.0)}, {})
    lag = term_of(sensor(("q",)), "lag of q")
    with pytest.raises(DomainError, match="dynamic=False"):
        lag.rates["lag of q: shown"](0.0, {"x": tensor(1.0)}, {"t90": tensor(1.0)}, {})
    assert len(sensor(("q",), dynamic=False)) == len(sensor(("q",))) - 2


def test_a_circuit_in_millivolts_reports_millivolts():
    options = {"capacitance": "C", "resistance": "R", "inductance": "L", "time": "ms"}
    volts, others = (
        [q.unit for term in electrical("v", "i", **options, **units) for q in term.parameters]
        for units in ({}, {"volt": "mV", "ampere": "uA"})
    )
    assert others == [unit.replace("V", "mV").replace("A", "uA") for unit in volts]
    hidden = term_of(electrical("v", volt="mV"), "Warburg element").states
    assert set(hidden.values()) == {"mV"}
    assert term_of(electrical("v", "i", resistance="R", ampere="uA"), "self-heating").states == {
        "self-heating: warmth": "uA^2"
    }


def test_labels_tell_two_bodies_apart():
    both = [*hydraulics("h1", inflow="q", label="upper"), *hydraulics("h2", label="lower")]
    names = [term.name for term in both]
    assert len(set(names)) == len(names)
    assert "leak (upper)" in names
