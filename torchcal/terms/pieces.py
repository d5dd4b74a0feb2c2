"""What the library's terms are made of: parameters, names, and functions that are smooth enough to differentiate."""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchcal.errors import DomainError
from torchcal.simulators import Parameter
from torchcal.terms.term import Term, outer

__all__ = [
    "Named",
    "Quantity",
    "Units",
    "adder",
    "amplitude",
    "check_name",
    "check_names",
    "check_positive",
    "excess",
    "factor",
    "lagging",
    "magnitude",
    "own_name",
    "quantity",
    "shape",
    "signed_power",
    "square_root",
    "start",
    "timed",
    "titled",
]

Named = Mapping[str, Any]
Quantity = float | str | Callable[[Named], Any]

#: Head, in the unit of the level, below which the square root of Torricelli's law is rounded off: its slope at an
#: empty tank is then 1000 rather than infinite, and its relative error at a head of 0.01 is 5e-5.
ROUNDED = 1e-6


def amplitude(
    name: str, unit: str, *, low: float | None = None, high: float | None = None, initial: float | None = None
) -> Parameter:
    """A coefficient that is 0 where the effect is absent."""
    return Parameter(name, unit=unit, low=low, high=high, initial=initial, neutral=0.0)


def shape(name: str, unit: str, low: float | None = None, high: float | None = None) -> Parameter:
    """A threshold, width, time or exponent: without effect while the amplitude is 0."""
    return Parameter(name, unit=unit, low=low, high=high)


def start(usual: float, low: float = -0.25, high: float = 1.25, name: str = "start") -> Parameter:
    """Where a hidden state begins, as a share of what its term says: usually there, or at nothing, as what is switched
    on when the recording begins; elsewhere only where data tell.

    There is room beyond what physics allows, so that noise does not push an estimate against a bound.
    """
    return Parameter(name, unit="1", low=low, high=high, neutral=usual)


def adder(terms: list[Term], equation: str, label: str | None) -> Callable[..., None]:
    """A function that appends terms of one equation: ``add(name, rate, parameters, formula, description, scales)``."""

    def add(
        name: str,
        rate: Callable[..., Any],
        parameters: list[Parameter],
        formula: str,
        description: str,
        scales: Mapping[str, str] | None = None,
    ) -> None:
        terms.append(
            Term(titled(name, label), equation=equation, rate=rate, parameters=parameters, scales=scales,
                 formula=f"d{equation}/dt ∋ {formula}", description=description)
        )  # fmt: skip

    return add


def lagging(name: str, equation: str, drive: str, unit: str, time: str, description: str) -> Term:
    """What an input drives follows it only after a time.

    Args:
        name: Of the term.
        equation: State whose rate the input drives.
        drive: The input.
        unit: Of the rate that an input of 1 drives.
        time: Unit of time.
        description: Of the term.
    """
    hidden = f"{name}: {drive}"
    return Term(
        name,
        rates={
            equation: lambda t, s, p, u: p["g"] * (s[hidden] - u[drive]),
            hidden: lambda t, s, p, u: (u[drive] - s[hidden]) / p["tau"],
        },
        states={hidden: f"[{drive}]"},
        initial={hidden: lambda s, p, u: p["start"] * u[drive]},
        parameters=[amplitude("g", unit, low=0.0), shape("tau", time), start(usual=1.0)],
        scales={"tau": "t"},
        takes=drive,
        formula=f"d{equation}/dt ∋ g ({drive}_late - {drive}), "
        f"d{drive}_late/dt = ({drive} - {drive}_late)/tau, {drive}_late(0) = start {drive}(0)",
        description=description,
    )


def check_name(value: Any, what: str) -> str:
    """The name, or a `DomainError` that says what it is for."""
    if not isinstance(value, str) or not value:
        raise DomainError(f"Expected {what} as a name (a non-empty string). Got {value!r}.")
    return value


def check_names(values: Any, what: str, counts: Sequence[int] = ()) -> tuple[str, ...]:
    """A sequence of different names, or a `DomainError`."""
    if isinstance(values, str) or not isinstance(values, Sequence) or not values:
        raise DomainError(f"Expected {what} as a sequence of names. Got {values!r}.")
    names = tuple(check_name(value, what) for value in values)
    if len(set(names)) < len(names):
        raise DomainError(f"Expected {what} each named once. Got {list(names)}.")
    if counts and len(names) not in counts:
        raise DomainError(f"Expected {' or '.join(map(str, counts))} {what}. Got {len(names)}: {list(names)}.")
    return names


def check_positive(value: Any, what: str) -> float:
    """A finite number > 0, or a `DomainError`."""
    number = math.nan
    if isinstance(value, float | int) and not isinstance(value, bool):
        number = float(value)
    if not (math.isfinite(number) and number > 0):
        raise DomainError(f"Expected {what} as a positive number. Got {value!r}.")
    return number


#: A unit that is one factor as it stands.
SIMPLE = re.compile(r"[^\W\d_]+|%|°[^\W\d_]*")


def factor(unit: str) -> str:
    """A unit as one factor of another one.

    >>> factor("mm"), factor("mol/L"), factor("[y]")
    ('mm', '(mol/L)', '([y])')
    """
    return unit if SIMPLE.fullmatch(unit) else f"({unit})"


class Units:
    """Units of coefficients, 1/(length^a time^b).

    >>> units = Units("m", "s")
    >>> units(1, 2), units(-1, 2), units(0, 1)
    ('1/(m s^2)', 'm/s^2', '1/s')
    """

    def __init__(self, length: str, time: str) -> None:
        self.length = check_name(length, "length")
        self.time = check_name(time, "time")

    def __call__(self, length: int, time: int) -> str:
        """The unit's text; negative powers stand above the line."""

        def product(sign: int) -> list[str]:
            powers = zip((self.length, self.time), (sign * length, sign * time), strict=True)
            return [name if power == 1 else f"{name}^{power}" for name, power in powers if power > 0]

        above, below = " ".join(product(-1)) or "1", product(1)
        if not below:
            return above
        return f"{above}/{below[0]}" if len(below) == 1 else f"{above}/({' '.join(below)})"


def titled(name: str, label: str | None) -> str:
    """The term's name, told apart from that of another body, tank or reaction."""
    return name if label is None else f"{name} ({check_name(label, 'label')})"


def timed(terms: Sequence[Term], time: str, labels: Mapping[str, str] | None = None) -> list[Term]:
    """The terms, of which those with time in the units of their parameters remember it, and all what others are in."""
    check_name(time, "time")

    def has_time(term: Term) -> bool:
        return any(time in re.split(r"[\s/*^()0-9.-]+", q.unit or "") for q in term.parameters)

    labels = dict(labels or {})
    return [dataclasses.replace(term, time=time if has_time(term) else None, labels=labels) for term in terms]


def own_name(name: str, *taken: Any) -> str:
    """A name for a term's parameter that hides none of the simulator's names that the term reads."""
    while name in taken:
        name += "_"
    return name


def quantity(value: Any, what: str) -> Callable[[Named, Named, Named], Any]:
    """What a term needs to know, as a function of ``(s, p, u)``.

    Args:
        value: A finite number, the name of an input, state or parameter (sought in this order), or a function
            ``f(p)``.
        what: What it is, for messages.
    """
    if callable(value):
        return lambda s, p, u: value(outer(p))
    if isinstance(value, str) and value:

        def find(s: Named, p: Named, u: Named) -> Any:
            for place in (u, s, p):
                if value in place:
                    return place[value]
            raise DomainError(
                f"Expected {what} among the inputs {list(u)}, states {list(s)} or parameters {list(p)}. "
                f"Got {value!r}. Give its name, or its value as a number."
            )

        return find
    if isinstance(value, float | int) and not isinstance(value, bool) and math.isfinite(value):
        number = float(value)
        return lambda s, p, u: number
    raise DomainError(f"Expected {what} as a number, a name or a function f(p). Got {value!r}.")


def signed_power(x: Tensor, exponent: float) -> Tensor:
    """sign(x) |x|^exponent, for exponents of at least 1, where its slope is finite everywhere."""
    return x.sign() * x.abs() ** exponent


def excess(x: Tensor, threshold: Any) -> Tensor:
    """How far x exceeds a threshold; 0 below."""
    return torch.relu(x - threshold)


def square_root(head: Tensor) -> Tensor:
    """√head, 0 for a negative one, rounded off near 0 so that its slope is finite."""
    positive = torch.relu(head)
    return positive / (positive + ROUNDED).sqrt()


def magnitude(*components: Tensor) -> Tensor:
    """Length of a vector, with slope 0 rather than NaN at the origin."""
    squared = components[0].square()
    for component in components[1:]:
        squared = squared + component.square()
    moving = squared > 0
    return torch.where(moving, squared, torch.ones_like(squared)).sqrt() * moving
