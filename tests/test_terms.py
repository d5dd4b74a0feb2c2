"""Every way to write a term, in time and for static simulators, and what `extend` makes of it."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchcal as tc
from torchcal.discovery.fits.ranges import Scale, sized
from torchcal.errors import DomainError, SimulatorError
from torchcal.simulators import Trajectories
from torchcal.terms import extend

F64 = torch.float64


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def body() -> tc.ODESimulator:
    return tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] - p["b"] * s["x"] ** 2 + u["f"]},
        {"x": "m", "v": "m/s"},
        [
            tc.Parameter("k", low=0.0, initial=4.0),
            tc.Parameter("c", low=0.0, initial=0.1),
            tc.Parameter("b", neutral=0.0),
        ],
        observe=("x", "v"),
    )


def recording() -> tc.Recording:
    t = np.linspace(0, 4, 30)
    r = t[:9]
    return tc.Recording(
        runs=[
            tc.Run(time=t, outputs={"x": t, "v": t}, inputs={"f": np.sin(t)}, initial={"x": 1.0, "v": 0.5}),
            tc.Run(time=r, outputs={"x": r, "v": r}, inputs={"f": np.cos(r)}, initial={"x": 0.2, "v": 0.0}),
        ]
    )


def outputs(simulator: tc.ODESimulator, **values: float) -> Tensor:
    """Outputs at k = 4, c = 0.1, b = 0, and what else is given by name."""
    bound = simulator.bind(recording())
    values = {"k": 4.0, "c": 0.1, "b": 0.0, **values}
    return bound.at(bound.x)(tensor(*[values[name] for name in bound.names]))


def close(a: Tensor, b: Tensor) -> None:
    torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def line() -> tc.Simulator:
    return tc.Simulator(
        lambda x, p: {"a": p["m"] * x["t"] + p["d"], "q": p["m"] * x["t"] ** 2},
        [tc.Parameter("m"), tc.Parameter("d", neutral=1.5)],
    )


X = {"t": tensor(0.0, 1.0, 2.0), "h": tensor(3.0, 1.0, 4.0)}


# --- the ways to write one, in time ----------------------------------------------------------------------

#: Each with values of its parameters, and the same physics written into the rates by hand.
BY_HAND = {
    "rate": (
        tc.Term("drag", equation="v", rate=lambda t, s, p, u: -p["d"] * s["v"].abs() * s["v"],
                parameters=[tc.Parameter("d", low=0.0)]),
        {"drag.d": 0.3},
        lambda t, s, p, u: {"x": s["v"], "v": -4 * s["x"] - 0.1 * s["v"] - 0.3 * s["v"].abs() * s["v"] + u["f"]},
        {},
    ),
    "rates": (
        tc.Term("leak", rates={"x": lambda t, s, p, u: -p["a"] * s["x"], "v": lambda t, s, p, u: p["a"] * t},
                parameters=[tc.Parameter("a")]),
        {"leak.a": 0.2},
        lambda t, s, p, u: {"x": s["v"] - 0.2 * s["x"], "v": -4 * s["x"] - 0.1 * s["v"] + u["f"] + 0.2 * t},
        {},
    ),
    "shift": (
        tc.Term("softening", shifts={"k": lambda t, s, p, u: -p["e"] * s["x"] ** 2 * p["k"] + p["g"] * u["f"]},
                parameters=[tc.Parameter("e"), tc.Parameter("g")]),
        {"softening.e": 0.15, "softening.g": 0.3},
        lambda t, s, p, u: {
            "x": s["v"],
            "v": -(4 - 0.15 * s["x"] ** 2 * 4 + 0.3 * u["f"]) * s["x"] - 0.1 * s["v"] + u["f"],
        },
        {},
    ),
    "hidden state": (
        tc.Term("relaxation", equation="v", rate=lambda t, s, p, u: -p["g"] * s["y"],
                rates={"y": lambda t, s, p, u: (s["x"] - s["y"]) / p["tau"]}, states={"y": "m"}, initial={"y": "x"},
                parameters=[tc.Parameter("g"), tc.Parameter("tau", low=0.1, high=9.0)]),
        {"relaxation.g": 0.5, "relaxation.tau": 2.0},
        lambda t, s, p, u: {
            "x": s["v"],
            "v": -4 * s["x"] - 0.1 * s["v"] + u["f"] - 0.5 * s["y"],
            "y": (s["x"] - s["y"]) / 2.0,
        },
        {"y": "x"},
    ),
    "frees": (
        tc.Term("quadratic spring", frees=("b",)),
        {"b": 0.4},
        lambda t, s, p, u: {"x": s["v"], "v": -4 * s["x"] - 0.1 * s["v"] - 0.4 * s["x"] ** 2 + u["f"]},
        {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", list(BY_HAND))
def test_a_term_is_the_physics_written_by_hand(kind: str) -> None:
    term, values, rates, initial = BY_HAND[kind]
    states = {"x": "m", "v": "m/s", **dict.fromkeys(initial)}
    by_hand = tc.ODESimulator(rates, states, [tc.Parameter("k"), tc.Parameter("c"), tc.Parameter("b")],
                              observe=("x", "v"), initial=initial)  # fmt: skip
    found = outputs(extend(body(), [term]), **values)
    close(found, outputs(by_hand))
    assert float((found - outputs(body())).abs().max()) > 1e-3


@pytest.mark.parametrize("kind", list(BY_HAND))
def test_at_neutral_nothing_changes_at_all(kind: str) -> None:
    term, values, _, _ = BY_HAND[kind]
    shape = {"relaxation.tau": 2.0}
    neutral = {name: shape.get(name, 0.0) for name in values}
    assert torch.equal(outputs(extend(body(), [term]), **neutral), outputs(body()))


def test_a_sensor_changes_what_is_seen_of_one_output() -> None:
    seen: dict[str, Any] = {}

    def sensor(t: Any, s: Any, p: Any, u: Any, y: Tensor) -> Tensor:
        seen.update(t=t, s=s, u=u, p=list(p))
        return y + p["gain"] * y + p["k"] * p["drift"] * t

    term = tc.Term("sensor", outputs={"v": sensor}, parameters=[tc.Parameter("gain"), tc.Parameter("drift")])
    assert term.is_sensor
    base = outputs(body())
    found = outputs(extend(body(), [term]), **{"sensor.gain": 0.1, "sensor.drift": 0.02})
    close(found[:39], base[:39])
    close(found[39:], 1.1 * base[39:] + 4.0 * 0.02 * recording().time)
    assert seen["p"][:2] != ["gain", "drift"]
    assert {"gain", "drift", "k", "sensor.gain"} <= set(seen["p"])
    assert set(seen["s"]) == {"x", "v"}
    assert set(seen["u"]) == {"f"}
    assert len(seen["t"]) == 39
    assert torch.equal(outputs(extend(body(), [term]), **{"sensor.gain": 0.0, "sensor.drift": 0.0}), base)


@pytest.mark.parametrize("start", [0.7, "v", lambda s, p: p["y0"] + 2 * s["x"]])
def test_hidden_states_start_where_they_are_told(start: Any) -> None:
    term = tc.Term(
        "hidden", rates={"y": lambda t, s, p, u: 0.0 * s["y"]}, states={"y": None}, initial={"y": start},
        outputs={"x": lambda t, s, p, u, y: s["y"]}, parameters=[tc.Parameter("y0")],
    )  # fmt: skip
    found = outputs(extend(body(), [term]), **{"hidden.y0": 0.25})[:39]
    expected = {0.7: (0.7, 0.7), "v": (0.5, 0.0)}.get(start, (2.25, 0.65)) if not callable(start) else (2.25, 0.65)
    close(found, torch.cat([torch.full((30,), expected[0], dtype=F64), torch.full((9,), expected[1], dtype=F64)]))


def test_a_hidden_state_starts_at_zero_by_default_and_is_no_free_parameter() -> None:
    term = tc.Term("hidden", rates={"y": lambda t, s, p, u: p["a"] * s["x"]}, states={"y": None},
                   parameters=[tc.Parameter("a")])  # fmt: skip
    extended = extend(body(), [term])
    assert extended.initial == {"y": 0.0}
    assert extended.bind(recording()).initial_names == []
    assert extended.outputs == ("x", "v")


def test_the_terms_parameters_hide_the_simulators_of_the_same_name() -> None:
    mine = tc.Term("mine", equation="v", rate=lambda t, s, p, u: -p["c"] * s["v"], parameters=[tc.Parameter("c")])
    close(outputs(extend(body(), [mine]), **{"mine.c": 0.2}), outputs(body(), c=0.1 + 0.2))


def test_two_terms_with_the_same_parameter_name_keep_their_own() -> None:
    first = tc.Term("one", equation="v", rate=lambda t, s, p, u: -p["c"] * s["v"], parameters=[tc.Parameter("c")])
    other = tc.Term("two", equation="v", rate=lambda t, s, p, u: -p["c"] * s["x"], parameters=[tc.Parameter("c")])
    both = extend(body(), [first, other])
    assert both.names == ("k", "c", "b", "one.c", "two.c")
    close(outputs(both, **{"one.c": 0.2, "two.c": 0.5}), outputs(body(), k=4.5, c=0.1 + 0.2))


def test_terms_add_up_in_any_order_and_one_after_another() -> None:
    drag, softening = BY_HAND["rate"][0], BY_HAND["shift"][0]
    values = {"drag.d": 0.3, "softening.e": 0.1, "softening.g": 0.0}
    one = outputs(extend(body(), [drag, softening]), **values)
    close(one, outputs(extend(body(), [softening, drag]), **values))
    close(one, outputs(extend(extend(body(), [drag]), [softening]), **values))


def test_factors_on_one_parameter_multiply_and_rates_see_them() -> None:
    fading = tc.Term("fading", shifts={"k": lambda t, s, p, u: p["k"] * torch.expm1(-p["r"] * t)},
                     parameters=[tc.Parameter("r")])  # fmt: skip
    crowded = tc.Term("crowded", shifts={"k": lambda t, s, p, u: p["k"] * (1 / (1 + p["K"] * s["x"]) - 1)},
                      parameters=[tc.Parameter("K")])  # fmt: skip
    fed = tc.Term("fed", equation="x", rate=lambda t, s, p, u: p["k"] * p["b"], parameters=[tc.Parameter("b")])
    plain = tc.ODESimulator(lambda t, s, p, u: {"x": -p["k"] * s["x"]}, ["x"], [tc.Parameter("k")])

    def by_hand(t, s, p, u):
        k = p["k"] * torch.exp(-p["r"] * t) / (1 + p["K"] * s["x"])
        return {"x": k * (p["b"] - s["x"])}

    whole = tc.ODESimulator(by_hand, ["x"], [tc.Parameter(name) for name in ("k", "r", "K", "b")])
    t = np.linspace(0, 3, 7)
    data = tc.Recording(runs=[tc.Run(time=t, outputs={"x": t}, initial={"x": 2.0})])
    right = whole.bind(data).at(data.x)(tensor(0.8, 0.4, 0.5, 0.3))
    values = {"k": 0.8, "fading.r": 0.4, "crowded.K": 0.5, "fed.b": 0.3}
    wholes = [extend(plain, terms) for terms in ([fading, crowded, fed], [fed, crowded, fading])]
    wholes.append(extend(extend(plain, [fading]), [fed, crowded]))
    wholes.append(extend(extend(extend(plain, [crowded]), [fed]), [fading]))
    for simulator in wholes:
        bound = simulator.bind(data)
        close(bound.at(data.x)(tensor(*(values[name] for name in bound.names))), right)


def test_two_sensors_on_one_output_act_one_after_the_other() -> None:
    gain = tc.Term("gain", outputs={"x": lambda t, s, p, u, y: y * (1 + p["g"])}, parameters=[tc.Parameter("g")])
    offset = tc.Term("offset", outputs={"x": lambda t, s, p, u, y: y + p["o"]}, parameters=[tc.Parameter("o")])
    values = {"gain.g": 0.5, "offset.o": 0.2}
    close(outputs(extend(body(), [gain, offset]), **values)[:39], 1.5 * outputs(body())[:39] + 0.2)
    close(outputs(extend(body(), [offset, gain]), **values)[:39], 1.5 * (outputs(body())[:39] + 0.2))


def test_a_shift_reaches_a_sensors_simulator_too() -> None:
    seen = tc.ODESimulator(lambda t, s, p, u: {"x": -p["k"] * s["x"]}, ["x"], [tc.Parameter("k"), tc.Parameter("g")],
                           observe={"y": lambda t, s, p, u: p["g"] * s["x"]})  # fmt: skip
    t = np.linspace(0, 1, 5)
    shift = tc.Term("fading", shifts={"g": lambda t, s, p, u: p["m"] * t}, parameters=[tc.Parameter("m")])
    bound = extend(seen, [shift]).bind(tc.Recording(runs=[tc.Run(time=t, outputs={"y": t}, initial={"x": 1.0})]))
    still = bound.at(bound.x)(tensor(1.0, 1.0, 0.0))
    close(bound.at(bound.x)(tensor(1.0, 2.0, 0.5)), still * (2.0 + 0.5 * bound.x["time"]))


def test_extending_trajectories_keeps_recording_and_steps() -> None:
    bound = body().bind(recording()).refined(3)
    found = extend(bound, [BY_HAND["rate"][0]])
    assert isinstance(found, Trajectories)
    assert found.recording is bound.recording
    assert found.subdivide == 3
    assert found.names == (*bound.names, "drag.d")


def test_a_per_run_parameter_of_a_term() -> None:
    wind = tc.Term("wind", equation="v", rate=lambda t, s, p, u: p["w"], parameters=[tc.Parameter("w", per_run=True)])
    bound = extend(body(), [wind]).bind(recording())
    assert bound.names[-2:] == ("wind.w[0]", "wind.w[1]")
    base, moved = (bound.at(bound.x)(tensor(4.0, 0.1, 0.0, 0.0, w)).reshape(2, 39) for w in (0.0, 1.0))
    assert torch.equal(base[:, :30], moved[:, :30])
    assert float((base - moved)[:, 31:].abs().min()) > 0


def test_extending_leaves_the_simulator_as_it_was_and_frees_parameters() -> None:
    simulator = body()
    before = simulator.parameters
    term = tc.Term("spring", equation="v", rate=lambda t, s, p, u: -p["e"] * s["x"] ** 3, frees=("b",),
                   parameters=[tc.Parameter("e", neutral=0.0, unit="1/m^2")])  # fmt: skip
    extended = extend(simulator, [term])
    assert simulator.parameters is before
    assert simulator.names == ("k", "c", "b")
    by_name = {p.name: p for p in extended.parameters}
    assert by_name["b"].neutral is None
    assert by_name["b"].initial == 0.0
    assert by_name["spring.e"].neutral is None
    assert by_name["spring.e"].unit == "1/m^2"
    assert extend(simulator, []) is simulator


# --- static ----------------------------------------------------------------------------------------------


def test_a_static_shift_makes_a_parameter_depend_on_a_condition() -> None:
    term = tc.Term("composition", shifts={"m": lambda x, p: p["e"] * torch.log(x["h"]) * p["m"]},
                   parameters=[tc.Parameter("e")])  # fmt: skip
    found = extend(line(), [term])
    assert found.names == ("m", "d", "composition.e")
    slope = 2.0 * (1 + 0.3 * X["h"].log())
    close(found.at(X)(tensor(2.0, 1.5, 0.3)), torch.cat([slope * X["t"] + 1.5, slope * X["t"] ** 2]))
    close(found.at(X, ["q"])(tensor(2.0, 1.5, 0.3)), slope * X["t"] ** 2)
    assert torch.equal(found.at(X)(tensor(2.0, 1.5, 0.0)), line().at(X)(tensor(2.0, 1.5)))
    leaf = torch.rand(4, 5, 3, dtype=F64)
    assert found.at(X)(leaf).shape == (4, 5, 6)
    close(found.at(X)(leaf)[2, 3], found.at(X)(leaf[2, 3]))


def test_static_factors_on_one_parameter_multiply() -> None:
    first = tc.Term("first", shifts={"m": lambda x, p: p["m"] * (x["h"] ** p["e"] - 1)}, parameters=[tc.Parameter("e")])
    other = tc.Term("other", shifts={"m": lambda x, p: p["m"] * p["g"] * x["t"]}, parameters=[tc.Parameter("g")])
    slope = 2.0 * X["h"] ** 0.3 * (1 + 0.2 * X["t"])
    seen = tc.Term("seen", outputs={"q": lambda x, p, y: y + p["o"] * p["m"]}, parameters=[tc.Parameter("o")])
    for terms, values in (([first, other], (0.3, 0.2)), ([other, first], (0.2, 0.3))):
        found = extend(line(), terms).at(X, ["q"])(tensor(2.0, 1.5, *values))
        close(found, slope * X["t"] ** 2)
        one_by_one = extend(extend(extend(line(), terms[:1]), [seen]), terms[1:])
        found = one_by_one.at(X, ["q"])(tensor(2.0, 1.5, values[0], 0.1, values[1]))
        close(found, slope * X["t"] ** 2 + 0.1 * slope)


def test_a_static_sensor_and_a_static_freed_parameter() -> None:
    sensor = tc.Term("saturation", outputs={"q": lambda x, p, y: y / (1 + p["s"] * y)}, parameters=[tc.Parameter("s")])
    freed = tc.Term("intercept", frees="d")
    found = extend(line(), [sensor, freed])
    assert found.names == ("m", "d", "saturation.s")
    assert found.parameters[1].neutral is None
    assert found.parameters[1].initial == 1.5
    q = 2.0 * X["t"] ** 2
    close(found.at(X)(tensor(2.0, 0.7, 0.1)), torch.cat([2.0 * X["t"] + 0.7, q / (1 + 0.1 * q)]))
    alone = extend(line(), [freed])
    assert alone.names == ("m", "d")
    assert line().parameters[1].neutral == 1.5
    close(alone.at(X)(tensor(2.0, 0.7)), line().at(X)(tensor(2.0, 0.7)))


def test_a_static_sensor_on_an_output_without_a_name() -> None:
    plain = tc.Simulator(lambda x, p: p["m"] * x, [tc.Parameter("m")])
    sensor = tc.Term("offset", outputs={"y": lambda x, p, y: y + p["o"] * x}, parameters=[tc.Parameter("o")])
    close(extend(plain, [sensor]).at(X["t"])(tensor(2.0, 0.5)), 2.5 * X["t"])


@pytest.mark.parametrize(
    ("static", "where"),
    [(True, {"outputs": "q"}), (True, {"shifts": "m"}), (False, {"rates": "v"}), (False, {"outputs": "x"}),
     (False, {"shifts": "k"})],
)  # fmt: skip
@pytest.mark.parametrize("returned", [None, "text", [1.0]])
def test_a_term_that_returns_no_tensor_is_blamed_by_name(static: bool, where: dict[str, str], returned: object) -> None:
    kinds: dict[str, Any] = {kind: {place: lambda *given: returned} for kind, place in where.items()}
    term = tc.Term("mute", parameters=[tc.Parameter("e")], **kinds)
    run = (
        (lambda: extend(line(), [term]).at(X)(tensor(2.0, 1.5, 0.3)))
        if static
        else (lambda: outputs(extend(body(), [term]), **{"mute.e": 0.0}))
    )
    message = rf"^Expected a tensor from every function of the term 'mute'.* returned {type(returned).__name__}"
    with pytest.raises(SimulatorError, match=message):
        run()


@pytest.mark.parametrize("where", [{"rates": "v"}, {"outputs": "x"}, {"shifts": "k"}])
def test_a_name_that_a_term_in_time_asks_for_in_vain_is_told_with_what_there_is(where: dict[str, str]) -> None:
    kinds: dict[str, Any] = {kind: {place: lambda t, s, p, u, *y: u["w"]} for kind, place in where.items()}
    term = tc.Term("blown", parameters=[tc.Parameter("e")], **kinds)
    there = r"no 'w' among states \['x', 'v'\], parameters \['k'.*'e'\] and inputs \['f'\].*Run\(inputs=\.\.\.\)"
    with pytest.raises(SimulatorError, match=f"'blown'. One of them raised KeyError: 'w'.*{there}"):
        outputs(extend(body(), [term]), **{"blown.e": 0.0})


def test_a_term_may_return_a_table_or_a_number_of_numpy() -> None:
    for returned in (np.full(3, 0.5), np.float32(0.5), np.int64(2)):
        term = tc.Term("table", shifts={"m": lambda x, p, r=returned: r}, parameters=[tc.Parameter("e")])
        found = extend(line(), [term]).at(X, ["q"])(tensor(2.0, 1.5, 0.0))
        close(found, (2.0 + torch.as_tensor(returned)) * X["t"] ** 2)


def test_an_extended_static_simulator_is_calibrated() -> None:
    t = tensor(0.5, 1.0, 2.0)
    recorded = tc.Recording(x={"t": t, "h": X["h"]}, y={"q": 2.0 * (1 + 0.3 * X["h"].log()) * t**2})
    term = tc.Term("composition", shifts={"m": lambda x, p: p["e"] * torch.log(x["h"])}, parameters=[tc.Parameter("e")])
    found = tc.calibrate(extend(line(), [term]), recorded, num_samples=0, seed=0)
    assert found.map.parameters == ("m", "composition.e")  # d is dormant
    assert found.map.mean.tolist() == pytest.approx([2.0, 0.6], abs=1e-3)


# --- errors ----------------------------------------------------------------------------------------------

RATE = lambda t, s, p, u: -p["a"] * s["v"]  # noqa: E731
A = [tc.Parameter("a")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": ""}, "a term's name"),
        ({"name": 3}, "a term's name"),
        *[({"name": f"b{letter}c"}, "in one line, without control") for letter in "\n\t\r\0\x1b\x85\u2028"],
        ({"name": "n", "equation": "v"}, "equation= and rate= together"),
        ({"name": "n", "rate": RATE}, "equation= and rate= together"),
        ({"name": "n", "equation": "v", "rate": RATE, "rates": {"v": RATE}}, "one rate for 'v'"),
        ({"name": "n"}, "to do something"),
        ({"name": "n", "parameters": A}, "to do something"),
        ({"name": "n", "rates": {"v": 3.0}, "parameters": A}, "Expected functions"),
        ({"name": "n", "outputs": {"x": None}, "parameters": A}, "Expected functions"),
        ({"name": "n", "equation": "v", "rate": RATE}, r"Expected parameters=\[Parameter"),
        ({"name": "n", "equation": "v", "rate": RATE, "parameters": A[0]}, "list of parameters"),
        ({"name": "n", "equation": "v", "rate": RATE, "parameters": A + A}, "named once"),
        ({"name": "n", "equation": "v", "rate": RATE, "parameters": A, "states": {"y": None}}, "hidden state 'y'"),
        ({"name": "n", "equation": "v", "rate": RATE, "parameters": A, "scales": {"w": "v"}}, "scales of parameters"),
    ],
)
def test_terms_that_make_no_sense(options: dict[str, Any], message: str) -> None:
    with pytest.raises(DomainError, match=message):
        tc.Term(**options)


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (tc.Term("n", equation="z", rate=RATE, parameters=A), r"equation of \['x', 'v'\]. Got 'z'"),
        (tc.Term("n", outputs={"z": lambda t, s, p, u, y: y}, parameters=A), r"output of \['x', 'v'\]. Got 'z'"),
        (tc.Term("n", shifts={"z": RATE}, parameters=A), r"a parameter of \['k', 'c', 'b'\]. Got 'z'"),
        (tc.Term("n", frees=("z",)), r"a parameter of \['k', 'c', 'b'\]. Got 'z'"),
        (tc.Term("n", rates={"x": RATE}, states={"x": None}, parameters=A), "new name for the hidden state"),
        (tc.Term("n", rates={"y": RATE}, states={"y": None}, initial={"y": "z"}, parameters=A), "another state's name"),
    ],
)
def test_terms_that_do_not_fit_the_simulator(term: tc.Term, message: str) -> None:
    with pytest.raises(DomainError, match=message):
        extend(body(), [term])


def test_terms_that_do_not_fit_a_static_simulator() -> None:
    with pytest.raises(DomainError, match="without rates for a static simulator"):
        extend(line(), [BY_HAND["rate"][0]])
    with pytest.raises(DomainError, match=r"a parameter of \['m', 'd'\]"):
        extend(line(), [tc.Term("n", shifts={"z": lambda x, p: p["a"]}, parameters=A)])
    wrong = extend(line(), [tc.Term("n", outputs={"z": lambda x, p, y: y}, parameters=A)])
    with pytest.raises(Exception, match=r"output of \['a', 'q'\]. Got 'z'"):
        wrong.at(X)(tensor(1.0, 1.0, 0.0))


def test_what_can_be_gone_through_but_once_is_kept() -> None:
    drag = tc.Term("n", equation="v", rate=RATE, parameters=iter(A))
    assert [q.name for q in drag.parameters] == ["a"]
    with pytest.raises(DomainError, match=r"Expected parameters=\[Parameter"):
        tc.Term("n", equation="v", rate=RATE, parameters=iter([]))
    with pytest.raises(DomainError, match="to do something"):
        tc.Term("n", frees=iter(()))
    for simulator in (body(), body().bind(recording())):
        assert "n.a" in extend(simulator, iter([drag])).names


def test_the_same_term_twice_is_refused() -> None:
    term = BY_HAND["rate"][0]
    with pytest.raises(DomainError, match=r"drag.d.*more than once"):
        extend(body(), [term, term])


def test_any_letters_make_a_name() -> None:
    name = "évaporation: τ₂·x² → ∞ 水 (π/2)"
    assert tc.Term(name, frees=("k",)).name == name


def test_how_a_term_prints_and_what_it_calls_its_parameters() -> None:
    term = tc.Term("drag", equation="v", rate=RATE, parameters=A, frees=("b",), formula="dv/dt ∋ -a v")
    assert repr(term) == "Term('drag': a, b)"
    assert term.full("a") == "drag.a"
    assert not term.is_sensor
    assert term.own({"k": 1.0, "a": 2.0, "drag.a": 3.0}) == {"k": 1.0, "a": 3.0, "drag.a": 3.0}


def grows(t: Any, s: Any, p: Any, u: Any) -> Any:
    return p["q"] * t + 0 * s["x"]


@pytest.mark.parametrize(
    ("elapsed", "ends"), [(None, (210.0, 310.0)), ("recording", (10.0, 110.0)), ("run", (10.0, 10.0))]
)
def test_elapsed_time_counts_from_the_first_sample(elapsed: str | None, ends: tuple[float, float]) -> None:
    # x = t, and x' = t over ten units of time, by clocks that begin at 200 and 300
    term = tc.Term("grows", outputs={"x": lambda t, s, p, u, y: grows(t, s, p, u)}, parameters=[tc.Parameter("q")],
                   elapsed=elapsed)  # fmt: skip
    rate = tc.Term("rate", equation="x", rate=grows, parameters=[tc.Parameter("q")], elapsed=elapsed)
    base = tc.ODESimulator(lambda t, s, p, u: {"x": 0 * s["x"]}, ["x"], [tc.Parameter("k")])
    time = np.linspace(0.0, 10.0, 11)
    runs = [tc.Run(time=clock + time, outputs={"x": 0 * time}, initial={"x": 0.0}) for clock in (200.0, 300.0)]
    bound = extend(base, [term]).bind(tc.Recording(runs=runs))
    seen = bound.at(bound.x)(tensor(0.0, 1.0))
    assert (float(seen[10]), float(seen[-1])) == pytest.approx(ends)
    bound = extend(base, [rate]).bind(tc.Recording(runs=runs))
    seen = bound.linearise(bound.x, tensor(0.0, 1.0)[None]).jacobian[0, :, 1]
    wanted = [0.5 * (end**2 - (end - 10) ** 2) for end in ends]
    assert (float(seen[10]), float(seen[-1])) == pytest.approx(tuple(wanted))


@pytest.mark.parametrize(("elapsed", "length"), [(None, 10.0), ("run", 10.0), ("recording", 1010.0)])
@pytest.mark.parametrize("samples", [3, 11, 1001])
def test_durations_are_measured_on_what_they_count_in(elapsed: str | None, length: float, samples: int) -> None:
    time = np.linspace(0.0, 10.0, samples)
    runs = [tc.Run(time=clock + time, outputs={"x": 0 * time}) for clock in (200.0, 1200.0)]
    term = tc.Term("rise", equation="x", rate=grows, parameters=[tc.Parameter("q"), tc.Parameter("tau")],
                   scales={"tau": "t"}, elapsed=elapsed)  # fmt: skip
    tau = sized(term, Scale({"t": 10.0}, {}), tc.Recording(runs=runs)).parameters[1]
    shortest = min(0.02 * length, 0.1 * 10.0 / (samples - 1))  # of a gap between samples, if that is less
    assert (tau.low, tau.high) == pytest.approx((shortest, length))


def test_what_parameters_are_in_nature_is_checked() -> None:
    def made(**more: Any) -> tc.Term:
        return tc.Term("rise", equation="x", rate=grows, parameters=[tc.Parameter("q"), tc.Parameter("tau")], **more)

    assert made().expected == {}
    assert made(expected={"q": (1, 0.25)}).expected == {"q": (1.0, 0.25)}
    with pytest.raises(DomainError, match=r"parameters \['q', 'tau'\] of the term 'rise'. Got 'gain'"):
        made(expected={"gain": (1.0, 0.2)})
    for bad in (1.0, (1.0,), (1.0, 0.0), (1.0, -1.0), (math.nan, 1.0), ("1", 1.0), (True, 1.0)):
        with pytest.raises(DomainError, match=r"\(value, sd\)\} of the term 'rise', finite, with sd > 0"):
            made(expected={"q": bad})


def test_what_a_copy_of_p_knows_of_elapsed_time() -> None:
    term = tc.Term("grows", equation="x", rate=grows, parameters=[tc.Parameter("q")], elapsed="run")
    base = tc.ODESimulator(lambda t, s, p, u: {"x": 0 * s["x"]}, ["x"], [tc.Parameter("k")])
    again = extend(base, [dataclasses.replace(term, description="once more")])
    run = tc.Run(time=np.linspace(200.0, 210.0, 11), outputs={"x": np.zeros(11)}, initial={"x": 0.0})

    def end(rates: Any) -> float:
        bound = tc.ODESimulator(rates, ["x"], again.parameters).bind(tc.Recording(runs=[run]))
        return float(bound.at(bound.x)(tensor(0.0, 1.0))[-1])

    assert end(again.rates) == pytest.approx(50.0)
    assert end(lambda t, s, p, u: again.rates(t, s, p | {"k": p["k"]}, u)) == pytest.approx(50.0)
    with pytest.raises(SimulatorError, match="'grows', whose time counts from the start of the run"):
        end(lambda t, s, p, u: again.rates(t, s, dict(p), u))


def test_elapsed_time_is_refused_where_there_is_none() -> None:
    with pytest.raises(DomainError, match='elapsed="recording", "run" or None'):
        tc.Term("grows", equation="x", rate=grows, parameters=[tc.Parameter("q")], elapsed=True)  # type: ignore[arg-type]
    static = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"]}, parameters=[tc.Parameter("q")], elapsed="run")
    with pytest.raises(DomainError, match="static simulator, which has no time"):
        extend(tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")]), [static])


@pytest.mark.parametrize("name", ["d", "dose"])
def test_a_name_looked_up_in_the_only_condition_is_told(name):
    x = torch.linspace(0, 1, 12, dtype=torch.float64)
    told = "x is a tensor, as in the recording: name its condition there"
    base = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")])
    term = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"] * x[name] ** 2}, parameters=[tc.Parameter("q")])
    with pytest.raises(SimulatorError, match=told):
        tc.diagnose(base, tc.Recording(x=x, y=x), [term], progress=False)
    with pytest.raises(SimulatorError, match=told):
        tc.Simulator(lambda x, p: p["a"] * x[name], [tc.Parameter("a")]).at(x)(torch.ones(1, dtype=torch.float64))


def test_nothing_is_no_list_of_parameters_or_states():
    with pytest.raises(DomainError, match="so that nothing could be"):
        tc.Term("drag", equation="v", rate=lambda t, s, p, u: -s["v"], parameters=None)
    with pytest.raises(DomainError, match="to do something"):
        tc.Term("drag", frees=None)
    with pytest.raises(DomainError, match="states as a dict"):
        tc.ODESimulator(lambda t, s, p, u: {}, None, [tc.Parameter("k")])


def test_a_lag_of_an_output_that_is_no_state_says_what_to_give():
    t = torch.linspace(0, 5, 30, dtype=torch.float64)
    model = tc.ODESimulator(
        lambda t, s, p, u: {"x": -p["k"] * s["x"]}, {"x": "m"}, [tc.Parameter("k", initial=1.0)],
        observe={"L": lambda t, s, p, u: 2 * s["x"]},
    )  # fmt: skip
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"L": 2 * torch.exp(-t)}, initial={"x": 1.0})], noise=0.1)
    with pytest.raises(DomainError, match=r"^Expected 'L' to be a state, for the lag.*Give outputs=\{'L'"):
        tc.diagnose(model, recording, tc.terms.sensor("L"), seed=0, progress=False)
