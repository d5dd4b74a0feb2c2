"""Losses, stores and non-linearities that a circuit model leaves out."""

from typing import Any

import torch
from torch import Tensor

from torchcal.errors import DomainError
from torchcal.terms.pieces import amplitude, check_name, own_name, quantity, shape, start, timed, titled
from torchcal.terms.term import Term

__all__ = ["electrical"]

#: Branches of the ladder for a diffusion element: time constants in units of the shortest, and conductances, fitted so
#: that the current after a voltage step falls as 1/√t, within 8 % (3 % r.m.s.) from 0.4 to 38 of the shortest.
LADDER = ((1.0, 1.0), (8.0, 0.257), (64.0, 0.209))
#: Largest exponent of a diode, far above any that a circuit lives through.
STEEPEST = 60.0
#: A capacitance does not fall below this fraction of the model's.
EMPTIEST = 0.05


def electrical(
    voltage: str = "v",
    current: str | None = None,
    *,
    output: str | None = None,
    capacitance: str | None = None,
    resistance: str | None = None,
    inductance: str | None = None,
    label: str | None = None,
    volt: str = "V",
    ampere: str = "A",
    time: str = "s",
) -> list[Term]:
    r"""Terms in the equation of a capacitor's voltage, of the measured voltage, and of the circuit's parameters.

    Coefficients are currents divided by the capacitance, so that every term is a rate of the voltage: shunt
    :math:`-g v`, diode :math:`-i (e^{v/v_t} - 1)`, dielectric absorption :math:`-k (v - z)` with a hidden voltage z
    that follows in a time τ, and a diffusion (Warburg) element as three such branches with time constants τ, 8τ, 64τ.

    Args:
        voltage: State of the capacitor's voltage.
        current: Input or state of the current, positive where it charges: adds the series resistance.
        output: Output that is the terminal voltage; ``voltage`` by default.
        capacitance: Parameter that is the capacitance, or a time constant in proportion to it: adds its change with
            the voltage.
        resistance: Parameter that is the resistance, or a time constant in proportion to it: adds its self-heating by
            the current (by the voltage where no current is given).
        inductance: Parameter that is the inductance: adds its saturation by the current.
        label: Added to the names of the terms, where several nodes need them.
        volt: Unit of the voltage, for reports.
        ampere: Unit of the current, for reports.
        time: Unit of time, for reports.

    Returns:
        The terms.

    Raises:
        DomainError: If a name is empty, or the inductance is given without the current.

    Source: A. J. Bard & L. R. Faulkner, Electrochemical Methods, ch. 10 (Warburg element); P. C. Dow (1958), IRE
    Trans. Electron. Comput. EC-7, 17-22 (dielectric absorption).

    >>> [term.name for term in electrical()][:4]
    ['shunt', 'leakage current', 'diode conduction', 'non-linear conductance']
    """
    v, time = check_name(voltage, "voltage"), check_name(time, "time")
    volt, ampere = check_name(volt, "volt"), check_name(ampere, "ampere")
    terms = [
        Term(titled("shunt", label), equation=v, rate=lambda t, s, p, u: -p["g"] * s[v],
             parameters=[amplitude("g", f"1/{time}", low=0.0)], formula=f"d{v}/dt ∋ -g {v}",
             description="Ohmic path in parallel, which discharges in proportion to the voltage."),
        Term(titled("leakage current", label), equation=v, rate=lambda t, s, p, u: -p["i"],
             parameters=[amplitude("i", f"{volt}/{time}")], formula=f"d{v}/dt ∋ -i",
             description="Constant leakage or bias current, whatever the voltage."),
        Term(titled("diode conduction", label), equation=v,
             rate=lambda t, s, p, u: -p["i"] * torch.expm1((s[v] / p["vt"]).clamp_max(STEEPEST)),
             parameters=[amplitude("i", f"{volt}/{time}", low=0.0), shape("vt", volt)], scales={"vt": v},
             formula=f"d{v}/dt ∋ -i (exp({v}/vt) - 1)",
             description="A junction in parallel, conducting exponentially in the forward direction."),
        Term(titled("non-linear conductance", label), equation=v, rate=lambda t, s, p, u: -p["g"] * s[v] ** 3,
             parameters=[amplitude("g", f"1/({time} {volt}^2)")], formula=f"d{v}/dt ∋ -g {v}³",
             description="A path in parallel that conducts better (g > 0) or worse (g < 0) at high voltage."),
        _absorption(v, label, volt, time),
        _warburg(v, label, volt, time),
    ]  # fmt: skip
    if current is not None:
        amperes = quantity(check_name(current, "current"), "the current")
        r = own_name("R", current)
        place = v if output is None else check_name(output, "output")
        terms.append(
            Term(titled("series resistance", label),
                 outputs={place: lambda t, s, p, u, y: y + p[r] * amperes(s, p, u)},
                 parameters=[amplitude(r, f"{volt}/{ampere}", low=0.0)], formula=f"{place} → {place} + {r} {current}",
                 description="Leads and contacts in series with what the model describes.")
        )  # fmt: skip
    if capacitance is not None:
        terms.append(_capacitance(check_name(capacitance, "capacitance"), v, label, volt))
    if resistance is not None:
        driver = (v, volt) if current is None else (current, ampere)
        terms.append(_self_heating(check_name(resistance, "resistance"), driver, label, time))
    if inductance is not None:
        if current is None:
            raise DomainError("Expected current= beside inductance=. Got none, and saturation depends on it.")
        terms.append(_saturation(check_name(inductance, "inductance"), current, label, ampere))
    return timed(terms, time)


def _absorption(v: str, label: str | None, volt: str, time: str) -> Term:
    name = titled("dielectric absorption", label)
    hidden = f"{name}: {v}"
    return Term(
        name,
        rates={v: lambda t, s, p, u: -p["k"] * (s[v] - s[hidden]),
               hidden: lambda t, s, p, u: (s[v] - s[hidden]) / p["tau"]},
        states={hidden: volt}, initial={hidden: lambda s, p: p["start"] * s[v]},
        parameters=[amplitude("k", f"1/{time}", low=0.0), shape("tau", time), start(1.0, -1.0, 3.0)],
        scales={"tau": "t"},
        formula=f"d{v}/dt ∋ -k ({v} - {v}_slow), d{v}_slow/dt = ({v} - {v}_slow)/tau, {v}_slow(0) = start {v}(0)",
        description="Charge that creeps into the dielectric and back, as a resistor and capacitor in parallel do.",
    )  # fmt: skip


def _warburg(v: str, label: str | None, volt: str, time: str) -> Term:
    name = titled("Warburg element", label)
    hidden = [f"{name}: {v}{number}" for number in range(1, len(LADDER) + 1)]

    def current(t: Any, s: Any, p: Any, u: Any) -> Any:
        flow = 0.0
        for branch, (_, conductance) in zip(hidden, LADDER, strict=True):
            flow = flow + conductance * (s[v] - s[branch])
        return -p["k"] * flow

    def following(branch: str, stretch: float) -> Any:
        return lambda t, s, p, u: (s[v] - s[branch]) / (stretch * p["tau"])

    rates: dict[str, Any] = {v: current}
    rates |= {branch: following(branch, stretch) for branch, (stretch, _) in zip(hidden, LADDER, strict=True)}
    return Term(
        name, rates=rates, states=dict.fromkeys(hidden, volt),
        initial=dict.fromkeys(hidden, lambda s, p: p["start"] * s[v]),
        parameters=[amplitude("k", f"1/{time}", low=0.0), shape("tau", time), start(1.0, -1.0, 3.0)],
        scales={"tau": "t"},
        formula=f"d{v}/dt ∋ -k Σ wj ({v} - zj), dzj/dt = ({v} - zj)/(nj tau), zj(0) = start {v}(0), nj = 1, 8, 64",
        description="Diffusion of ions or carriers, whose current after a step falls as one over the root of time.",
    )  # fmt: skip


def _capacitance(capacitance: str, v: str, label: str | None, volt: str) -> Term:
    a = own_name("a", capacitance)
    return Term(
        titled("non-linear capacitance", label),
        shifts={capacitance: lambda t, s, p, u: p[capacitance] * (p[a] * s[v]).clamp_min(EMPTIEST - 1.0)},
        parameters=[amplitude(a, f"1/{volt}")], formula=f"{capacitance} → {capacitance} (1 + {a} {v})",
        description="The capacitance rises (a > 0) or falls (a < 0) with the voltage.",
    )  # fmt: skip


def _self_heating(resistance: str, heated_by: tuple[str, str], label: str | None, time: str) -> Term:
    name = titled("self-heating", label)
    warmth = f"{name}: warmth"
    driver, unit = heated_by
    heat = quantity(driver, "what heats the resistance")
    a, tau, begun = (own_name(own, resistance, driver) for own in ("a", "tau", "start"))

    def heating(s: Any, p: Any, u: Any) -> Tensor:
        return torch.as_tensor(heat(s, p, u)).square()

    return Term(
        name,
        rates={warmth: lambda t, s, p, u: (heating(s, p, u) - s[warmth]) / p[tau]},
        shifts={resistance: lambda t, s, p, u: p[resistance] * p[a] * s[warmth]},
        states={warmth: f"{unit}^2"}, initial={warmth: lambda s, p, u: p[begun] * heating(s, p, u)},
        parameters=[amplitude(a, f"1/{unit}^2", low=0.0), shape(tau, time), start(usual=0.0, name=begun)],
        scales={tau: "t"},
        formula=f"{resistance} → {resistance} (1 + {a} θ), dθ/dt = ({driver}² - θ)/{tau}, θ(0) = {begun} {driver}(0)²",
        description="The dissipated power warms the conductor, whose resistance rises with its temperature.",
    )  # fmt: skip


def _saturation(inductance: str, current: str, label: str | None, ampere: str) -> Term:
    a = own_name("a", inductance, current)
    amperes = quantity(current, "the current")

    def lost(t: Any, s: Any, p: Any, u: Any) -> Any:
        x = p[a] * torch.as_tensor(amperes(s, p, u)).square()
        return -p[inductance] * x / (1.0 + x)

    return Term(
        titled("saturation of the inductance", label), shifts={inductance: lost},
        parameters=[amplitude(a, f"1/{ampere}^2", low=0.0)],
        formula=f"{inductance} → {inductance}/(1 + {a} {current}²)",
        description="The core saturates, and the inductance falls at high current.",
    )  # fmt: skip
