"""Ways in which heat is lost, stored and gained that a thermal model leaves out."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchcal.errors import DomainError
from torchcal.simulators import Parameter
from torchcal.terms.pieces import (
    amplitude,
    check_name,
    check_positive,
    lagging,
    own_name,
    quantity,
    shape,
    signed_power,
    timed,
    titled,
)
from torchcal.terms.term import Term

__all__ = ["saturation_pressure", "thermal"]

#: 0 °C in K.
FREEZING = 273.15
#: Temperature (K) about which radiation is scaled: its coefficient is the rate of loss linearised at 20 °C.
ROOM = 293.15


def saturation_pressure(celsius: Tensor) -> Tensor:
    r"""Vapour pressure of water, in kPa.

    .. math:: \log_{10}(p/\mathrm{mmHg}) = 8.07131 - \frac{1730.63}{233.426 + T/^\circ\mathrm{C}}

    Args:
        celsius: Temperature in °C, any shape; the constants hold from 1 to 100 °C.

    Source: Antoine constants of J. Gmehling, U. Onken & W. Arlt, Vapor-Liquid Equilibrium Data Collection, DECHEMA.

    >>> saturation_pressure(torch.tensor([20.0, 100.0], dtype=torch.float64))
    tensor([  2.33, 101.3], dtype=torch.float64)
    """
    # Far below 0 °C there is no pressure to speak of; the floor keeps clear of the pole at -233 °C.
    return 0.1333224 * 10.0 ** (8.07131 - 1730.63 / (233.426 + celsius.clamp_min(-100.0)))


def thermal(
    temperature: str = "T",
    *,
    ambient: float | str = "Ta",
    loss: str | None = None,
    heater: str | None = None,
    unit: str = "degC",
    humidity: float = 0.5,
    label: str | None = None,
    time: str = "s",
) -> list[Term]:
    r"""Heat losses, sources and stores, as terms in the temperature's equation.

    Coefficients are heat flows divided by the heat capacity, so that every term is a rate of temperature. With the
    excess :math:`d = T - T_a`: Newton cooling :math:`-k d`, natural convection
    :math:`-c\,\mathrm{sign}(d)|d|^{5/4}`, radiation :math:`-c (T^4 - T_a^4)/(4 T_0^3)` in kelvin with
    :math:`T_0` = 293.15 K, evaporation of water :math:`-c (p_s(T) - \varphi p_s(T_a))`.

    Args:
        temperature: State of the temperature.
        ambient: Temperature of the surroundings: a number, or the name of an input, state or parameter.
        loss: Parameter of the model that multiplies the excess: the ambient drift is then in units of temperature.
        heater: Input that heats: adds errors of its gain and its lag.
        unit: ``"degC"`` or ``"K"``, of all temperatures.
        humidity: Relative humidity φ of the surroundings, 0 to 1, for evaporation.
        label: Added to the names of the terms, where several bodies need them.
        time: Unit of time, for reports.

    Returns:
        The terms.

    Raises:
        DomainError: If the unit is neither of the two, a name is empty, or the humidity is outside [0, 1].

    Source: F. P. Incropera et al., Fundamentals of Heat and Mass Transfer, ch. 1, 9 (laminar natural convection: the
    Nusselt number goes with the fourth root of the excess).

    >>> [term.name for term in thermal(ambient=20.0)][:4]
    ['Newton cooling', 'natural convection', 'radiation', 'evaporation']
    """
    T = check_name(temperature, "temperature")
    time = check_name(time, "time")
    if unit not in ("degC", "K"):
        raise DomainError(f"Expected unit 'degC' or 'K'. Got {unit!r}.")
    if not isinstance(humidity, float | int) or not 0 <= humidity <= 1:
        raise DomainError(f"Expected humidity between 0 and 1. Got {humidity!r}.")
    if unit == "K" and isinstance(ambient, float | int):
        check_positive(ambient, "ambient in K")
    surroundings = quantity(ambient, "the ambient temperature")
    to_kelvin = FREEZING if unit == "degC" else 0.0
    terms: list[Term] = []
    k, c = own_name("k", ambient), own_name("c", ambient)

    def around(s: Any, p: Any, u: Any) -> Tensor:
        return torch.as_tensor(surroundings(s, p, u), dtype=s[T].dtype, device=s[T].device)

    def add(
        name: str, rate: Callable[[Tensor, Tensor], Tensor], parameter: Parameter, formula: str, description: str
    ) -> None:
        terms.append(
            Term(titled(name, label), equation=T,
                 rate=lambda t, s, p, u: p[parameter.name] * rate(s[T], around(s, p, u)),
                 parameters=[parameter], formula=f"d{T}/dt ∋ {formula}", description=description)
        )  # fmt: skip

    d = f"({T} - {ambient})"
    add("Newton cooling", lambda inside, outside: outside - inside, amplitude(k, f"1/{time}", low=0.0),
        f"-{k} {d}", "Heat loss in proportion to the excess temperature.")  # fmt: skip
    add("natural convection", lambda inside, outside: -signed_power(inside - outside, 1.25),
        amplitude(c, f"1/({time} K^0.25)", low=0.0), f"-{c} sign{d} |{T} - {ambient}|^1.25",
        "Loss to air that rises by its own warmth, with the 5/4 power of the excess.")  # fmt: skip
    add("radiation",
        lambda inside, outside: ((outside + to_kelvin) ** 4 - (inside + to_kelvin) ** 4) / (4.0 * ROOM**3),
        amplitude(c, f"1/{time}", low=0.0),
        f"-{c} ({T}⁴ - {ambient}⁴)/(4 (293.15 K)³), absolute temperatures",
        "Thermal radiation to the surroundings; the coefficient is that of the linear loss at 20 °C.")  # fmt: skip
    add("evaporation",
        lambda inside, outside: humidity * saturation_pressure(outside + (to_kelvin - FREEZING))
        - saturation_pressure(inside + (to_kelvin - FREEZING)),
        amplitude(c, f"K/({time} kPa)", low=0.0),
        f"-{c} (ps({T}) - {humidity:g} ps({ambient})), ps the vapour pressure of water",
        "Latent heat carried off by evaporating water, with its vapour pressure.")  # fmt: skip
    add("temperature-dependent loss", lambda inside, outside: -(inside - outside).abs() * (inside - outside),
        amplitude(c, f"1/({time} K)"), f"-{c} |{T} - {ambient}| {d}",
        "A loss coefficient that rises (c > 0) or falls (c < 0) with the excess, as conductivities do.")  # fmt: skip
    terms.append(
        Term(titled("internal heat source", label), equation=T, rate=lambda t, s, p, u: p["q"],
             parameters=[amplitude("q", f"K/{time}")], formula=f"d{T}/dt ∋ q",
             description="Constant heating, or cooling where q < 0, that nothing in the model accounts for.")
    )  # fmt: skip
    terms.append(_drift(T, loss, label, time))
    terms.append(_second(T, ambient, surroundings, label, time, unit))
    if heater is not None:
        terms += _heater(check_name(heater, "heater"), T, label, time)
    return timed(terms, time)


def _drift(T: str, loss: str | None, label: str | None, time: str) -> Term:
    description = "Surroundings that warm or cool steadily while the model holds them constant."
    if loss is None:
        return Term(
            titled("ambient drift", label), equation=T, rate=lambda t, s, p, u: p["b"] * t,
            parameters=[amplitude("b", f"K/{time}^2")], formula=f"d{T}/dt ∋ b t", description=description,
            elapsed="recording",
        )  # fmt: skip
    coefficient = quantity(check_name(loss, "loss"), "the coefficient of the heat loss")
    b = own_name("b", loss)
    return Term(
        titled("ambient drift", label), equation=T, rate=lambda t, s, p, u: coefficient(s, p, u) * p[b] * t,
        parameters=[amplitude(b, f"K/{time}")], formula=f"d{T}/dt ∋ {loss} {b} t", description=description,
        elapsed="recording",
    )  # fmt: skip


def _second(
    T: str, ambient: float | str, surroundings: Callable[..., Any], label: str | None, time: str, unit: str
) -> Term:
    name = titled("second heat capacity", label)
    inner = f"{name}: {T}"
    k, tau, start = (own_name(own, ambient) for own in ("k", "tau", "start"))

    def begin(s: Any, p: Any, u: Any) -> Any:
        outside = surroundings(s, p, u)
        return outside + p[start] * (s[T] - outside)

    return Term(
        name,
        rates={T: lambda t, s, p, u: -p[k] * (s[T] - s[inner]),
               inner: lambda t, s, p, u: (s[T] - s[inner]) / p[tau]},
        states={inner: unit}, initial={inner: begin},
        parameters=[amplitude(k, f"1/{time}", low=0.0), shape(tau, time), shape(start, "1", 0.0, 1.0)],
        scales={tau: "t"},
        formula=f"d{T}/dt ∋ -{k} ({T} - T2), dT2/dt = ({T} - T2)/{tau}, "
        f"T2(0) = {ambient} + {start} ({T}(0) - {ambient})",
        description="An unseen body in thermal contact, such as a wall or a cup, that stores heat and gives it back.",
    )  # fmt: skip


def _heater(heater: str, T: str, label: str | None, time: str) -> list[Term]:
    unit = f"K/({time} [{heater}])"
    return [
        Term(titled("heater gain error", label), equation=T, rate=lambda t, s, p, u: p["g"] * u[heater],
             parameters=[amplitude("g", unit)], formula=f"d{T}/dt ∋ g {heater}",
             description="The heater delivers more or less than the model says."),
        lagging(titled("heater lag", label), T, heater, unit, time,
                "The heater's own heat capacity delays its effect by a time tau."),
    ]  # fmt: skip
