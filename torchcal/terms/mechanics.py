"""Forces that a model of a moving body leaves out."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from torchcal.errors import DomainError
from torchcal.simulators import Parameter
from torchcal.terms.pieces import (
    Quantity,
    Units,
    adder,
    amplitude,
    check_name,
    check_names,
    excess,
    lagging,
    magnitude,
    own_name,
    quantity,
    shape,
    start,
    timed,
    titled,
)
from torchcal.terms.term import Term

__all__ = ["mechanics"]

#: Dry friction is written tanh(3 v / w), 99.5 % of its full value at the speed w.
FULL = 3.0
#: Friction of the Stribeck kind changes sign within an eighth of the Stribeck velocity.
STICKING = 8.0


def mechanics(
    position: str | Sequence[str] = "x",
    velocity: str | Sequence[str] = "v",
    *,
    force: str | None = None,
    stiffness: Quantity | None = None,
    angle: bool = True,
    label: str | None = None,
    length: str = "m",
    time: str = "s",
) -> list[Term]:
    r"""Drag, friction, springs and forces, as terms in the velocity's equation. Coefficients are per unit mass.

    One degree of freedom, or a body in a plane or in space (drag, friction, springs, Magnus force, bias forces)
    where positions and velocities are given as two or three names each.

    Dry friction is smoothed, :math:`-c \tanh(3 v/w)`, so that fixed time steps and derivatives work; w is the speed
    at which it has its full value. The Stribeck term is the part that sliding takes away,
    :math:`-c \exp(-(v/v_s)^2)`, with the same smoothing.

    Args:
        position: State of the position, or names of its components.
        velocity: State of the velocity, or names of its components.
        force: Input that drives the body: adds errors of its gain and its lag. One degree of freedom alone.
        stiffness: What multiplies −position in a model made for small angles, name of a parameter or function
            ``f(p)``: the large-angle term is then its exact completion, with a fraction that is 1 in nature. One
            degree of freedom alone.
        angle: Whether the position may be an angle in rad; otherwise there is no large-angle term.
        label: Added to the names of the terms, where several bodies need them.
        length: Unit of the position, for reports, where the simulator gives it none.
        time: Unit of time, for reports.

    Returns:
        The terms, with SI units unless ``length`` and ``time`` say otherwise.

    Raises:
        DomainError: If a name is empty, positions and velocities do not match, or ``force`` or ``stiffness`` is given
            with several.

    Source: B. Armstrong-Hélouvry, P. Dupont & C. Canudas de Wit (1994), Automatica 30, 1083-1138 (friction).

    >>> [term.name for term in mechanics()][:3]
    ['linear drag', 'quadratic drag', 'cubic drag']
    """
    units = Units(length, time)
    if not (isinstance(position, str) and isinstance(velocity, str)):
        positions = check_names(position, "positions", (2, 3))
        for name, value in (("force", force), ("stiffness", stiffness)):
            if value is not None:
                raise DomainError(
                    f"Expected {name}= with one position alone. Got {value!r} with {list(positions)} (leave it out; "
                    "errors of a drive in a plane or in space are terms of your own)."
                )
        return _in_space(positions, check_names(velocity, "velocities", (len(positions),)), units, label)
    x, v = check_name(position, "position"), check_name(velocity, "velocity")
    terms: list[Term] = []
    add = adder(terms, v, label)

    add("linear drag", lambda t, s, p, u: -p["c"] * s[v], [amplitude("c", units(0, 1), low=0.0)],
        f"-c {v}", "Viscous drag, proportional to the speed.")  # fmt: skip
    add("quadratic drag", lambda t, s, p, u: -p["c"] * s[v].abs() * s[v], [amplitude("c", units(1, 0), low=0.0)],
        f"-c |{v}| {v}", "Drag of a wake at high Reynolds number, with the square of the speed.")  # fmt: skip
    add("cubic drag", lambda t, s, p, u: -p["c"] * s[v] ** 3, [amplitude("c", units(2, -1), low=0.0)],
        f"-c {v}³", "Damping that grows with the cube of the speed.")  # fmt: skip
    w = own_name("w", v)  # the usual name of an angular velocity too
    add("Coulomb friction", lambda t, s, p, u: -p["c"] * torch.tanh(FULL * s[v] / p[w]),
        [amplitude("c", units(-1, 2), low=0.0), shape(w, units(-1, 1))],
        f"-c sign({v}), smoothed as -c tanh(3 {v}/{w})", "Dry friction, independent of the speed while sliding.",
        {w: v})  # fmt: skip
    add("Stribeck friction",
        lambda t, s, p, u: -p["c"] * torch.exp(-((s[v] / p["vs"]) ** 2)) * torch.tanh(STICKING * s[v] / p["vs"]),
        [amplitude("c", units(-1, 2), low=0.0), shape("vs", units(-1, 1))],
        f"-c exp(-({v}/vs)²) sign({v}), smoothed as tanh(8 {v}/vs)",
        "Extra dry friction at low speed, which sliding faster than the Stribeck velocity removes.",
        {"vs": v})  # fmt: skip
    add("linear spring", lambda t, s, p, u: -p["k"] * s[x], [amplitude("k", units(0, 2), low=0.0)],
        f"-k {x}", "Restoring force in proportion to the displacement.")  # fmt: skip
    add("quadratic stiffness", lambda t, s, p, u: -p["k"] * s[x].square(), [amplitude("k", units(1, 2))],
        f"-k {x}²", "Spring that is stiffer on one side than on the other.")  # fmt: skip
    add("cubic stiffness", lambda t, s, p, u: -p["k"] * s[x] ** 3, [amplitude("k", units(2, 2))],
        f"-k {x}³", "Spring that hardens (k > 0) or softens (k < 0) with the displacement.")  # fmt: skip
    if angle:
        terms.append(_large_angle(x, v, stiffness, label, units(0, 2)))
    add("end stop", lambda t, s, p, u: -p["k"] * s[x].sign() * excess(s[x].abs(), p["x0"]),
        [amplitude("k", units(0, 2), low=0.0), shape("x0", units(-1, 0))],
        f"-k sign({x}) max(|{x}| - x0, 0)", "Elastic contact with stops on both sides beyond a clearance x0.",
        {"x0": x})  # fmt: skip
    add("position-dependent damping", lambda t, s, p, u: -p["c"] * s[x].square() * s[v], [amplitude("c", units(2, 1))],
        f"-c {x}² {v}", "Damping that grows (c > 0) or fades (c < 0) away from the centre.")  # fmt: skip
    add("bias force", lambda t, s, p, u: p["b"], [amplitude("b", units(-1, 2))],
        "b", "Constant force: a tilt, a preload, an offset of the drive.")  # fmt: skip
    terms.append(_viscoelastic(v, label, units))
    if force is not None:
        terms += _actuator(check_name(force, "force"), v, label, units)
    return timed(terms, time, {x: length})


def _large_angle(x: str, v: str, stiffness: Quantity | None, label: str | None, unit: str) -> Term:
    description = "Exact gravity of a pendulum, for a model that puts the angle itself in place of its sine."
    if stiffness is None:
        return Term(
            titled("large-angle sine", label), equation=v,
            rate=lambda t, s, p, u: p["k"] * (s[x] - torch.sin(s[x])), parameters=[amplitude("k", unit, low=0.0)],
            formula=f"d{v}/dt ∋ k ({x} - sin {x})", description=description,
        )  # fmt: skip
    small = quantity(stiffness, "the stiffness")
    fraction = own_name("fraction", stiffness)
    return Term(
        titled("large-angle sine", label), equation=v,
        rate=lambda t, s, p, u: p[fraction] * small(s, p, u) * (s[x] - torch.sin(s[x])),
        # 1 in nature; room above, so that noise does not push the estimate against a bound.
        parameters=[amplitude(fraction, "1", low=0.0, high=2.0)],
        formula=f"d{v}/dt ∋ {fraction} k ({x} - sin {x}), k the model's own"
        + (f" ({stiffness})" if isinstance(stiffness, str) else ""),
        description=description,
    )  # fmt: skip


def _viscoelastic(v: str, label: str | None, units: Units) -> Term:
    name = titled("viscoelastic branch", label)
    hidden, size = f"{name}: stretch", f"{v}_max"
    return Term(
        name,
        rates={v: lambda t, s, p, u: -p["k"] * s[hidden], hidden: lambda t, s, p, u: s[v] - s[hidden] / p["tau"]},
        states={hidden: units.length}, initial={hidden: lambda s, p: p["start"] * p[size] * p["tau"]},
        parameters=[amplitude("k", units(0, 2), low=0.0), shape("tau", units(0, -1)), start(0.0, -2.0, 2.0)],
        scales={"tau": "t"}, constants={size: v},
        formula=f"d{v}/dt ∋ -k stretch, d stretch/dt = {v} - stretch/tau, stretch(0) = start {size} tau",
        description="Spring in series with a damper (a Maxwell element): stiff when moved fast, relaxing in tau.",
    )  # fmt: skip


def _actuator(force: str, v: str, label: str | None, units: Units) -> list[Term]:
    unit = f"{units.length}/({units.time}^2 [{force}])"
    return [
        Term(titled("actuator gain error", label), equation=v, rate=lambda t, s, p, u: p["g"] * u[force],
             parameters=[amplitude("g", unit)], formula=f"d{v}/dt ∋ g {force}",
             description="The drive acts more or less strongly than the model says."),
        lagging(titled("actuator lag", label), v, force, unit, units.time,
                "The drive's force follows its command only after a time tau."),
    ]  # fmt: skip


def _in_space(x: tuple[str, ...], v: tuple[str, ...], units: Units, label: str | None) -> list[Term]:
    """The terms of a body in a plane or in space."""

    def add(name: str, factor: Callable[..., Any], along: tuple[str, ...], parameters: list[Parameter], formula: str,
            description: str, scales: Mapping[str, str] | None = None) -> Term:  # fmt: skip
        def part(component: str) -> Callable[..., Any]:
            return lambda t, s, p, u: factor(s, p) * s[component]

        return Term(
            titled(name, label), rates={v[i]: part(along[i]) for i in range(len(v))}, parameters=parameters,
            formula=f"dv/dt ∋ {formula}", description=description, scales=scales,
        )  # fmt: skip

    def speed(s: Mapping[str, Any]) -> Any:
        return magnitude(*(s[name] for name in v))

    def distance2(s: Mapping[str, Any]) -> Any:
        return magnitude(*(s[name] for name in x)).square()

    first, second = v[0], v[1]
    terms = [
        add("linear drag", lambda s, p: -p["c"], v, [amplitude("c", units(0, 1), low=0.0)],
            "-c v", "Viscous drag, proportional to the speed."),
        add("quadratic drag", lambda s, p: -p["c"] * speed(s), v, [amplitude("c", units(1, 0), low=0.0)],
            "-c |v| v", "Drag of a wake at high Reynolds number, with the square of the speed."),
        add("cubic drag", lambda s, p: -p["c"] * speed(s).square(), v, [amplitude("c", units(2, -1), low=0.0)],
            "-c |v|² v", "Damping that grows with the cube of the speed."),
        add("Coulomb friction", lambda s, p: -p["c"] / (speed(s).square() + (p["w"] / FULL).square()).sqrt(), v,
            [amplitude("c", units(-1, 2), low=0.0), shape("w", units(-1, 1))], "-c v/|v|, smoothed as v/√(v² + (w/3)²)",
            "Dry friction against the direction of motion, independent of the speed.", {"w": first}),
        add("linear spring", lambda s, p: -p["k"], x, [amplitude("k", units(0, 2), low=0.0)],
            "-k r", "Restoring force to the origin in proportion to the distance."),
        add("cubic stiffness", lambda s, p: -p["k"] * distance2(s), x, [amplitude("k", units(2, 2))],
            "-k |r|² r", "Spring to the origin that hardens (k > 0) or softens (k < 0) with the distance."),
        Term(titled("Magnus force", label),
             rates={first: lambda t, s, p, u: -p["m"] * s[second], second: lambda t, s, p, u: p["m"] * s[first]},
             parameters=[amplitude("m", units(0, 1))], formula=f"d{first}/dt ∋ -m {second}, d{second}/dt ∋ m {first}",
             description="Force across the motion in the plane of the first two axes: spin, a magnetic field, or a "
             "rotating frame."),
    ]  # fmt: skip
    for axis in v:
        terms.append(
            Term(titled(f"bias force along {axis}", label), equation=axis, rate=lambda t, s, p, u: p["b"],
                 parameters=[amplitude("b", units(-1, 2))], formula=f"d{axis}/dt ∋ b",
                 description=f"Constant force along {axis}.")
        )  # fmt: skip
    return timed(terms, units.time, dict.fromkeys(x, units.length))
