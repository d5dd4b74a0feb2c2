"""Flows and stores that a model of a tank leaves out."""

from collections.abc import Callable
from typing import Any

import torch

from torchcal.terms.pieces import (
    Units,
    adder,
    amplitude,
    check_name,
    check_positive,
    excess,
    lagging,
    own_name,
    quantity,
    shape,
    square_root,
    start,
    timed,
    titled,
)
from torchcal.terms.term import Term

__all__ = ["hydraulics"]

#: Level, relative to its reference, below which a changed discharge exponent is no longer followed.
SHALLOW = 1e-6


def hydraulics(
    level: str = "h",
    *,
    inflow: str | None = None,
    outlet: str | None = None,
    downstream: str | None = None,
    reference: float | None = None,
    label: str | None = None,
    length: str = "m",
    time: str = "s",
) -> list[Term]:
    r"""Leaks, overflows and faults of pump and outlet, as terms in the level's equation.

    Coefficients are flows divided by the tank's area, so that every term is a rate of the level. A leak follows
    Torricelli's law, :math:`-c\sqrt{h}`, seepage Darcy's, :math:`-c h`, an overflow the weir formula,
    :math:`-c \max(h - h_0, 0)^{3/2}`.

    Args:
        level: State of the level, measured from the bottom.
        inflow: Input of the flow into the tank, or of the pump: adds bypass, pump saturation and pump lag.
        outlet: Parameter of the model that multiplies the discharge: adds its exponent and its clogging.
        downstream: State of the level of a tank of equal area below: what bypasses this tank arrives there.
        reference: Level at which a changed discharge exponent leaves the discharge as it is, > 0; by default the
            highest in the base's fit, which `diagnose` finds (by hand give one). It is the same in all runs, as the
            coefficient is.
        label: Added to the names of the terms, where several tanks need them.
        length: Unit of the level, for reports, where the simulator gives it none.
        time: Unit of time, for reports.

    Returns:
        The terms, with SI units unless ``length`` and ``time`` say otherwise.

    Raises:
        DomainError: If a name is empty, or the reference is not positive.

    Source: F. M. White, Fluid Mechanics, ch. 3 (Torricelli), 10 (weirs).

    >>> [term.name for term in hydraulics()]
    ['leak', 'seepage', 'overflow', 'evaporation', 'second tank']
    """
    h = check_name(level, "level")
    if reference is not None:
        reference = check_positive(reference, "reference")
    units = Units(length, time)
    terms: list[Term] = []
    add = adder(terms, h, label)

    add("leak", lambda t, s, p, u: -p["c"] * square_root(s[h]), [amplitude("c", f"{length}^0.5/{time}", low=0.0)],
        f"-c √{h}", "Hole in the bottom, discharging by Torricelli's law.")  # fmt: skip
    add("seepage", lambda t, s, p, u: -p["c"] * s[h], [amplitude("c", units(0, 1), low=0.0)],
        f"-c {h}", "Laminar loss through a porous or narrow path, in proportion to the head.")  # fmt: skip
    add("overflow", lambda t, s, p, u: -p["c"] * excess(s[h], p["h0"]) ** 1.5,
        [amplitude("c", f"1/({length}^0.5 {time})", low=0.0), shape("h0", length)],
        f"-c max({h} - h0, 0)^1.5", "Spill over a weir or rim at the level h0.", {"h0": h})  # fmt: skip
    add("evaporation", lambda t, s, p, u: -p["e"], [amplitude("e", units(-1, 1), low=0.0)],
        "-e", "Constant loss, whatever the level.")  # fmt: skip
    terms.append(_second(h, label, units))
    if inflow is not None:
        terms += _inflow(check_name(inflow, "inflow"), h, downstream, label, units)
    if outlet is not None:
        terms += _outlet(check_name(outlet, "outlet"), h, reference, label, units)
    return timed(terms, time, {h: length})


def _second(h: str, label: str | None, units: Units) -> Term:
    name = titled("second tank", label)
    inner = f"{name}: {h}"
    return Term(
        name,
        rates={h: lambda t, s, p, u: -p["k"] * (s[h] - s[inner]),
               inner: lambda t, s, p, u: (s[h] - s[inner]) / p["tau"]},
        states={inner: units.length}, initial={inner: lambda s, p: p["start"] * s[h]},
        parameters=[amplitude("k", units(0, 1), low=0.0), shape("tau", units.time), start(1.0, 0.0, 2.0)],
        scales={"tau": "t"},
        formula=f"d{h}/dt ∋ -k ({h} - h2), dh2/dt = ({h} - h2)/tau, h2(0) = start {h}(0)",
        description="An unseen volume in connection with the tank, which fills and empties with it in a time tau.",
    )  # fmt: skip


def _inflow(inflow: str, h: str, downstream: str | None, label: str | None, units: Units) -> list[Term]:
    unit = f"{units.length}/({units.time} [{inflow}])"
    rates: dict[str, Callable[..., Any]] = {h: lambda t, s, p, u: -p["b"] * u[inflow]}
    formula = f"d{h}/dt ∋ -b {inflow}"
    if downstream is not None:
        rates[check_name(downstream, "downstream")] = lambda t, s, p, u: p["b"] * u[inflow]
        formula += f", d{downstream}/dt ∋ b {inflow}"
    return [
        Term(titled("bypass", label), rates=rates, parameters=[amplitude("b", unit, low=0.0)], formula=formula,
             description="A part of the inflow goes past the tank."),
        Term(titled("pump saturation", label), equation=h,
             rate=lambda t, s, p, u: -p["g"] * excess(u[inflow], p["u0"]),
             parameters=[amplitude("g", unit, low=0.0), shape("u0", f"[{inflow}]")], scales={"u0": inflow},
             formula=f"d{h}/dt ∋ -g max({inflow} - u0, 0)",
             description="Beyond u0 the pump delivers less than it is asked for."),
        lagging(titled("pump lag", label), h, inflow, unit, units.time,
                "The pump follows its command only after a time tau."),
    ]  # fmt: skip


def _outlet(outlet: str, h: str, reference: float | None, label: str | None, units: Units) -> list[Term]:
    coefficient = quantity(outlet, "the coefficient of the outlet")
    m, r = own_name("m", outlet), own_name("r", outlet)
    ref = own_name(f"{h}_ref", outlet)

    def bend(t: Any, s: Any, p: Any, u: Any) -> Any:
        ratio = torch.relu(s[h]) / p[ref]
        return coefficient(s, p, u) * torch.expm1(p[m] * ratio.clamp_min(SHALLOW).log())

    return [
        Term(titled("discharge exponent", label), shifts={outlet: bend},
             parameters=[amplitude(m, "1", low=-0.5, high=1.0)], constants={ref: h if reference is None else reference},
             formula=f"{outlet} → {outlet} ({h}/{ref if reference is None else f'{reference:g}'})^{m}",
             description="The discharge follows another power of the head than the model's: a long pipe or a "
             "shaped outlet rather than a hole."),
        Term(titled("clogging", label),
             shifts={outlet: lambda t, s, p, u: coefficient(s, p, u) * torch.expm1(-p[r] * t)},
             parameters=[amplitude(r, units(0, 1), low=0.0)], formula=f"{outlet} → {outlet} exp(-{r} t)",
             description="The outlet narrows with time.", elapsed="recording"),
    ]  # fmt: skip
