"""Reactions and rate laws that a kinetic model leaves out."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchcal.errors import DomainError
from torchcal.simulators import Parameter
from torchcal.terms.pieces import (
    amplitude,
    check_name,
    check_positive,
    factor,
    own_name,
    quantity,
    shape,
    start,
    timed,
    titled,
)
from torchcal.terms.term import Term

__all__ = ["kinetics"]

#: Molar gas constant, J/(mol K), CODATA 2018 (exact).
GAS_CONSTANT = 8.31446261815324
#: A changed reaction order is followed down to this fraction of the reference concentration.
DEPLETED = 1e-6


def kinetics(
    reactant: str = "A",
    product: str | None = None,
    *,
    rate: str | None = "k",
    log_rate: bool = False,
    temperature: str | None = None,
    reference: float | None = None,
    reference_temperature: float = 300.0,
    label: str | None = None,
    amount: str = "mol/L",
    time: str = "s",
) -> list[Term]:
    r"""Side reactions, as terms in the equations of reactant and product, and corrections of the rate constant.

    The corrections multiply the model's rate constant k: reaction order :math:`(c/c_{ref})^m`, saturation
    :math:`1/(1 + K c)` (Michaelis-Menten, Langmuir), product inhibition :math:`1/(1 + K c_P)`, deactivation
    :math:`e^{-r t}`, temperature exponent :math:`(T/T_{ref})^n` and activation energy
    :math:`\exp(-\frac{E}{R}(\frac{1}{T} - \frac{1}{T_{ref}}))`. m and n are what is added to the model's own.

    Args:
        reactant: State of the reactant's concentration.
        product: State of the product's concentration. Without one it is taken for what has become of the reactant
            since the beginning, where a term needs it, or the term is left out.
        rate: Parameter of the model that is the rate constant, or None: then there are no corrections of it.
        log_rate: Whether that parameter is the logarithm of the rate constant.
        temperature: Input, state or parameter that is the absolute temperature in K.
        reference: Concentration at which a changed order leaves the rate as it is, > 0; by default the largest in
            the base's fit, which `diagnose` finds (by hand give one). It is the same in all runs, as the rate constant
            is.
        reference_temperature: The same for the temperature, K.
        label: Added to the names of the terms, where several reactions need them.
        amount: Unit of the concentrations, for reports.
        time: Unit of time, for reports.

    Returns:
        The terms.

    Raises:
        DomainError: If a name is empty, or a reference is not positive.

    Source: O. Levenspiel, Chemical Reaction Engineering, ch. 2, 3, 21 (deactivation).

    >>> [term.name for term in kinetics("A", "B", rate=None)]
    ['reverse reaction', 'autocatalysis', 'second-order decay', 'second branch', 'consecutive reaction', ...]
    """
    a = check_name(reactant, "reactant")
    b = None if product is None else check_name(product, "product")
    if a == b:
        raise DomainError(f"Expected reactant and product of different names. Got {a!r} twice.")
    amount, time = check_name(amount, "amount"), check_name(time, "time")
    reference_temperature = check_positive(reference_temperature, "reference_temperature")
    if reference is not None:
        reference = check_positive(reference, "reference")
    if temperature is not None:
        check_name(temperature, "temperature")
    terms = [
        _onward("reverse reaction", a, b, amplitude("k", f"1/{time}", low=0.0), lambda s, made: -made,
                f"-k {b}" if b else "-k P", "The product turns back into the reactant.", amount, label),
        _onward("autocatalysis", a, b, amplitude("k", f"1/({time} {amount})", low=0.0), lambda s, made: s[a] * made,
                f"k {a} {b}" if b else f"k {a} P", "The product catalyses its own formation.", amount, label),
        Term(titled("second-order decay", label), equation=a, rate=lambda t, s, p, u: -p["k"] * s[a].square(),
             parameters=[amplitude("k", f"1/({time} {amount})", low=0.0)], formula=f"d{a}/dt ∋ -k {a}²",
             description="Two molecules of the reactant react with each other and are lost."),
        Term(titled("second branch", label), equation=a, rate=lambda t, s, p, u: -p["k"] * s[a],
             parameters=[amplitude("k", f"1/{time}", low=0.0)], formula=f"d{a}/dt ∋ -k {a}",
             description="A parallel first-order path to a product that is not looked at."),
    ]  # fmt: skip
    if b is not None:
        terms.append(
            Term(titled("consecutive reaction", label), equation=b, rate=lambda t, s, p, u: -p["k"] * s[b],
                 parameters=[amplitude("k", f"1/{time}", low=0.0)], formula=f"d{b}/dt ∋ -k {b}",
                 description="The product reacts on, to something that is not looked at.")
        )  # fmt: skip
    terms.append(_adsorption(a, amount, time, label))
    terms.append(
        Term(titled("constant source", label), equation=a, rate=lambda t, s, p, u: p["b"],
             parameters=[amplitude("b", f"{amount}/{time}")], formula=f"d{a}/dt ∋ b",
             description="The reactant is fed, or withdrawn where b < 0, at a constant rate.")
    )  # fmt: skip
    if rate is not None:
        law = _Law(check_name(rate, "rate"), log_rate, label)
        terms += law.corrections(a, b, reference, amount, time)
        if temperature is not None:
            terms += law.of_temperature(temperature, reference_temperature)
    return timed(terms, time)


def _onward(
    name: str,
    a: str,
    b: str | None,
    parameter: Parameter,
    flow: Callable[[Mapping[str, Any], Tensor], Tensor],
    formula: str,
    description: str,
    amount: str,
    label: str | None,
) -> Term:
    """A reaction that turns reactant into product at ``k flow(s, concentration of the product)``."""
    name = titled(name, label)
    if b is not None:

        def onward(t: Any, s: Any, p: Any, u: Any) -> Any:
            return p[parameter.name] * flow(s, s[b])

        return Term(
            name, rates={a: lambda t, s, p, u: -onward(t, s, p, u), b: onward}, parameters=[parameter],
            formula=f"d{a}/dt ∋ -{formula}, d{b}/dt ∋ {formula}".replace("--", ""), description=description,
        )  # fmt: skip
    first = f"{name}: {a}(0)"
    return Term(
        name,
        # A hidden state that never moves remembers how much reactant there was.
        rates={a: lambda t, s, p, u: -p[parameter.name] * flow(s, s[first] - s[a]),
               first: lambda t, s, p, u: torch.zeros_like(s[first])},
        states={first: amount}, initial={first: a}, parameters=[parameter],
        formula=f"d{a}/dt ∋ -{formula}, P = {a}(0) - {a}".replace("--", ""), description=description,
    )  # fmt: skip


def _adsorption(a: str, amount: str, time: str, label: str | None) -> Term:
    name = titled("reversible adsorption", label)
    hidden = f"{name}: {a}"
    return Term(
        name,
        rates={a: lambda t, s, p, u: -p["k"] * (s[a] - s[hidden]),
               hidden: lambda t, s, p, u: (s[a] - s[hidden]) / p["tau"]},
        states={hidden: amount}, initial={hidden: lambda s, p: p["start"] * s[a]},
        parameters=[amplitude("k", f"1/{time}", low=0.0), shape("tau", time), start(usual=0.0)], scales={"tau": "t"},
        formula=f"d{a}/dt ∋ -k ({a} - {a}_bound), d{a}_bound/dt = ({a} - {a}_bound)/tau, {a}_bound(0) = start {a}(0)",
        description="A wall or an unseen phase, usually empty at first, takes up the reactant and gives it back.",
    )  # fmt: skip


class _Law:
    """Factors on the model's rate constant, each 1 at a neutral coefficient."""

    def __init__(self, rate: str, log_rate: bool, label: str | None) -> None:
        self.rate, self.log_rate, self.label = rate, log_rate, label
        self.constant = quantity(rate, "the rate constant")

    def term(
        self, name: str, log_factor: Callable[..., Tensor], parameter: Parameter, factor: str, description: str,
        **more: Any,
    ) -> Term:  # fmt: skip
        def shift(t: Any, s: Any, p: Any, u: Any) -> Tensor:
            exponent = log_factor(t, s, p, u)
            return exponent if self.log_rate else self.constant(s, p, u) * torch.expm1(exponent.clamp_max(50.0))

        rate = self.rate
        return Term(
            titled(name, self.label), shifts={rate: shift}, parameters=[parameter], description=description,
            formula=f"{rate} → {rate} + ln({factor})" if self.log_rate else f"{rate} → {rate} {factor}", **more,
        )  # fmt: skip

    def corrections(self, a: str, b: str | None, reference: float | None, amount: str, time: str) -> list[Term]:
        m, big, r = (own_name(name, self.rate) for name in ("m", "K", "r"))
        ref = own_name(f"{a}_ref", self.rate)

        def order(t: Any, s: Any, p: Any, u: Any) -> Tensor:
            return p[m] * (s[a] / p[ref]).clamp_min(DEPLETED).log()

        found = [
            self.term("reaction order", order, amplitude(m, "1", low=-2.0, high=2.0),
                      f"({a}/{ref if reference is None else f'{reference:g}'})^{m}",
                      "The rate goes with another power of the concentration than the model's.",
                      constants={ref: a if reference is None else reference}),
            self.term("saturation", lambda t, s, p, u: -torch.log1p(p[big] * torch.relu(s[a])),
                      amplitude(big, f"1/{factor(amount)}", low=0.0), f"1/(1 + {big} {a})",
                      "Catalyst or enzyme is fully occupied at high concentration (Michaelis-Menten, Langmuir)."),
            self.term("deactivation", lambda t, s, p, u: -p[r] * t, amplitude(r, f"1/{time}", low=0.0),
                      f"exp(-{r} t)", "The catalyst loses its activity with time.", elapsed="run"),
        ]  # fmt: skip
        if b is not None:
            found.append(
                self.term("product inhibition", lambda t, s, p, u: -torch.log1p(p[big] * torch.relu(s[b])),
                          amplitude(big, f"1/{factor(amount)}", low=0.0), f"1/(1 + {big} {b})",
                          "The product occupies the catalyst and slows the reaction.")
            )  # fmt: skip
        return found

    def of_temperature(self, temperature: str, reference: float) -> list[Term]:
        kelvin = quantity(temperature, "the absolute temperature")
        n, energy = own_name("n", self.rate, temperature), own_name("E", self.rate, temperature)

        def warmth(s: Any, p: Any, u: Any) -> Tensor:
            return torch.as_tensor(kelvin(s, p, u)).clamp_min(1.0)

        return [
            self.term("temperature exponent", lambda t, s, p, u: p[n] * (warmth(s, p, u) / reference).log(),
                      amplitude(n, "1", low=-10.0, high=10.0), f"({temperature}/{reference:g} K)^{n}",
                      "The rate constant goes with a power of the temperature besides its exponential."),
            self.term("activation energy",
                      lambda t, s, p, u: p[energy] / GAS_CONSTANT * (1.0 / reference - 1.0 / warmth(s, p, u)),
                      amplitude(energy, "J/mol", low=0.0), f"exp({energy}/R (1/{reference:g} K - 1/{temperature}))",
                      "The reaction has to climb a barrier: Arrhenius's law, or a higher barrier than the model's."),
        ]  # fmt: skip
