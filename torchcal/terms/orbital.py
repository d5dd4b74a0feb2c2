"""Accelerations that a Kepler orbit leaves out."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchcal.errors import DomainError
from torchcal.simulators import Parameter
from torchcal.terms.pieces import (
    Named,
    Quantity,
    Units,
    amplitude,
    check_name,
    check_names,
    check_positive,
    magnitude,
    own_name,
    quantity,
    shape,
    timed,
    titled,
)
from torchcal.terms.term import Term

__all__ = ["orbital"]

#: Speed of light, m/s (exact).
LIGHT = 299792458.0

Body = Sequence[str] | Callable[[Any], Sequence[Any]]
Vector = tuple[Any, ...]
Field = Callable[[Any, Any, Any, Any], Vector]


def orbital(
    positions: Sequence[str] = ("x", "y", "z"),
    velocities: Sequence[str] = ("vx", "vy", "vz"),
    *,
    mu: Quantity = "mu",
    light: float = LIGHT,
    body: Body | None = None,
    reference: float | None = None,
    label: str | None = None,
    length: str = "m",
    time: str = "s",
) -> list[Term]:
    r"""Perturbations of a body's motion about a centre of gravity at the origin, in a plane or in space.

    With :math:`\mathbf r` from the centre, :math:`r = |\mathbf r|`, and velocity :math:`\mathbf v`: relativity (first
    post-Newtonian order) is

    .. math:: \frac{\mu}{c^2 r^3} \left[ \left(\frac{4\mu}{r} - v^2\right) \mathbf r
              + 4 (\mathbf r \cdot \mathbf v) \mathbf v \right]

    with a fraction that is 1 in nature; oblateness is the J2 field of a body whose equator is the plane of the first
    two axes; a third body pulls the orbiting body and the centre differently.

    Args:
        positions: States of the position, two or three.
        velocities: States of the velocity, as many.
        mu: Gravitational parameter of the centre: a number, the name of a parameter, or a function ``f(p)``.
        light: Speed of light in the units of the velocities; m/s by default.
        body: Where the third body is, relative to the centre: names of inputs, or a function of t that returns the
            coordinates. Without it the tide of a distant body in a fixed direction of the x-y plane is taken.
        reference: Distance at which a changed exponent of gravity leaves the force as it is; by default the largest
            in the base's fit, which `diagnose` finds (by hand give one). It is the same in all runs, as the
            gravitational parameter is.
        label: Added to the names of the terms, where several bodies need them.
        length: Unit of the positions, for reports, where the simulator gives them none.
        time: Unit of time, for reports.

    Returns:
        The terms, with SI units unless ``length`` and ``time`` say otherwise.

    Raises:
        DomainError: If there are not two or three positions and as many velocities, or a name is empty.

    Source: O. Montenbruck & E. Gill, Satellite Orbits (2000), ch. 3; C. D. Murray & S. F. Dermott, Solar System
    Dynamics (1999), ch. 6.

    >>> [term.name for term in orbital(("x", "y"), ("vx", "vy"), mu=1.0)][:3]
    ['relativity', 'oblateness', 'third body']
    """
    x = check_names(positions, "positions", (2, 3))
    v = check_names(velocities, "velocities", (len(x),))
    units = Units(length, time)
    c = check_positive(light, "light")
    gravity = quantity(mu, "the gravitational parameter")
    if reference is not None:
        reference = check_positive(reference, "reference")

    def place(s: Named) -> tuple[Vector, Tensor]:
        r = tuple(s[name] for name in x)
        return r, magnitude(*r)

    def add(name: str, field: Field, parameters: list[Parameter], formula: str, description: str, **more: Any) -> Term:
        return Term(
            titled(name, label), rates={**_components(v, field), **more.pop("rates", {})}, parameters=parameters,
            formula=f"dv/dt ∋ {formula}", description=description, **more,
        )  # fmt: skip

    fraction, q, e = own_name("fraction", mu), own_name("q", mu), own_name("e", mu)

    def relativity(t: Any, s: Any, p: Any, u: Any) -> Vector:
        r, distance = place(s)
        w = tuple(s[name] for name in v)
        m = gravity(s, p, u)
        radial = 4.0 * m / distance - _dot(w, w)
        along = 4.0 * _dot(r, w)
        scale = p[fraction] * m / (c**2 * distance**3)
        return tuple(scale * (radial * a + along * b) for a, b in zip(r, w, strict=True))

    def oblateness(t: Any, s: Any, p: Any, u: Any) -> Vector:
        r, distance = place(s)
        scale = -1.5 * p[q] * gravity(s, p, u) / distance**5
        lift = 5.0 * (r[2] / distance).square() if len(r) == 3 else torch.zeros_like(distance)
        return tuple(scale * a * ((3.0 if i == 2 else 1.0) - lift) for i, a in enumerate(r))

    def drag(t: Any, s: Any, p: Any, u: Any) -> Vector:
        w = tuple(s[name] for name in v)
        return tuple(-p["c"] * magnitude(*w) * a for a in w)

    def pressure(t: Any, s: Any, p: Any, u: Any) -> Vector:
        r, distance = place(s)
        return tuple(p["c"] * a / distance**3 for a in r)

    ref = own_name("r_ref", mu)

    def exponent(t: Any, s: Any, p: Any, u: Any) -> Vector:
        r, distance = place(s)
        extra = -gravity(s, p, u) / distance**3 * torch.expm1(-p[e] * (distance / p[ref]).log())
        return tuple(extra * a for a in r)

    terms = [
        add("relativity", relativity,
            # 1 in nature; room above, so that noise does not push the estimate against a bound.
            [amplitude(fraction, "1", low=0.0, high=2.0)],
            f"{fraction} mu/(c² r³) [(4 mu/r - v²) r + 4 (r·v) v]",
            "General relativity to first post-Newtonian order, which turns the perihelion."),
        add("oblateness", oblateness, [amplitude(q, f"{length}^2", low=0.0)],
            f"-3/2 {q} mu/r⁵ (x (1 - 5 z²/r²), y (1 - 5 z²/r²), z (3 - 5 z²/r²)), {q} = J2 R²",
            "Equatorial bulge of the central body."),
        _third_body(x, v, body, label, units),
        add("drag", drag, [amplitude("c", units(1, 0), low=0.0)], "-c |v| v",
            "Drag in a thin medium at rest, with the square of the speed."),
        add("radiation pressure", pressure, [amplitude("c", f"{length}^3/{time}^2", low=0.0)], "c r/r³",
            "Light of the central body pushes outward with the inverse square of the distance."),
        add("exponent of gravity", exponent, [amplitude(e, "1", low=-0.5, high=0.5)],
            f"-mu r/r³ ((r/{ref if reference is None else f'{reference:g}'})^-{e} - 1)",
            "The central force falls with another power of the distance than the square.",
            constants={ref: x if reference is None else reference}),
    ]  # fmt: skip
    for axis in v:
        terms.append(
            Term(titled(f"uniform acceleration along {axis}", label), equation=axis, rate=lambda t, s, p, u: p["b"],
                 parameters=[amplitude("b", units(-1, 2))], formula=f"d{axis}/dt ∋ b",
                 description=f"Constant push along {axis}: a thruster, or the light of a distant source.")
        )  # fmt: skip
    return timed(terms, time, dict.fromkeys(x, length))


def _dot(a: Vector, b: Vector) -> Tensor:
    return torch.stack([i * j for i, j in zip(a, b, strict=True)]).sum(0)


def _components(v: tuple[str, ...], field: Field) -> dict[str, Callable[..., Any]]:
    """One rate function for each component of a vector field."""

    def part(i: int) -> Callable[..., Any]:
        return lambda t, s, p, u: field(t, s, p, u)[i]

    return {name: part(i) for i, name in enumerate(v)}


def _third_body(x: tuple[str, ...], v: tuple[str, ...], body: Body | None, label: str | None, units: Units) -> Term:
    name = titled("third body", label)
    description = "Gravity of another body, which pulls the orbiting body and the centre differently."
    if body is None:

        def tide(t: Any, s: Any, p: Any, u: Any) -> Vector:
            n = (torch.cos(p["angle"]), torch.sin(p["angle"]))
            toward = 3.0 * (n[0] * s[x[0]] + n[1] * s[x[1]])
            return tuple(p["k"] * ((toward * n[i] if i < 2 else 0.0) - s[a]) for i, a in enumerate(x))

        return Term(
            name, rates=_components(v, tide),
            parameters=[amplitude("k", units(0, 2), low=0.0), shape("angle", "rad", 0.0, math.pi)],
            formula="dv/dt ∋ k (3 (n·r) n - r), n = (cos angle, sin angle), k = mu3/d³",
            description=description + " This one is distant and does not move.",
        )  # fmt: skip
    if callable(body):
        where: Callable[[Any, Any], Sequence[Any]] = lambda t, u: body(t)  # noqa: E731
    else:
        inputs = check_names(body, "coordinates of the third body", (len(x),))
        where = lambda t, u: [u[check_name(name, "body")] for name in inputs]  # noqa: E731

    def pull(t: Any, s: Any, p: Any, u: Any) -> Vector:
        like = s[x[0]]
        there = tuple(torch.as_tensor(a, dtype=like.dtype, device=like.device) for a in where(t, u))
        if len(there) != len(x):
            raise DomainError(f"Expected {len(x)} coordinates of the third body. Got {len(there)}.")
        apart = tuple(b - s[a] for a, b in zip(x, there, strict=True))
        near, far = magnitude(*apart) ** -3, magnitude(*there) ** -3
        return tuple(p["mu3"] * (a * near - b * far) for a, b in zip(apart, there, strict=True))

    return Term(
        name, rates=_components(v, pull), parameters=[amplitude("mu3", f"{units.length}^3/{units.time}^2", low=0.0)],
        formula="dv/dt ∋ mu3 ((d - r)/|d - r|³ - d/|d|³), d the body's position", description=description,
    )  # fmt: skip
