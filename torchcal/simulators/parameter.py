"""What a simulator's parameter is, and the coordinates in which it is inferred."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.checks import real_number
from torchcal.errors import DomainError, EmbeddingError, ShapeError

__all__ = ["Parameter", "Scaling", "free_parameters", "in_run", "is_value_of", "spans"]

QUANTITY = "Give its magnitude in the parameter's unit, value.to(unit).magnitude."
"""What to do with a number that has a unit."""


def in_run(parameter: str, run: int) -> str:
    """The name of a parameter's value in one run.

    >>> in_run("k", 0)
    'k[0]'
    """
    return f"{parameter}[{run}]"


def is_value_of(name: str, parameter: str) -> bool:
    """Whether a name is that of a parameter, or of its value in one run.

    >>> [is_value_of(name, "k") for name in ("k", "k[2]", "kappa", "k[hot]")]
    [True, True, False, False]
    """
    return name == parameter or re.fullmatch(rf"{re.escape(parameter)}\[\d+\]", name) is not None


def spans(values: Mapping[str, Tensor]) -> str:
    """Named batches in words, for a message about them: each value, or the smallest and the largest.

    >>> spans({"k": torch.tensor([2.0]), "E": torch.tensor([0.5, 3.0])})
    'k = 2, E from 0.5 to 3'
    """
    told = []
    for name, batch in values.items():
        try:
            low, high = float(batch.detach().min()), float(batch.detach().max())
        except RuntimeError:  # no values, or those of a transform of torch.func, which has none to tell
            told.append(name)
            continue
        told.append(f"{name} = {low:.6g}" if low == high else f"{name} from {low:.6g} to {high:.6g}")
    return ", ".join(told)


@dataclass(frozen=True)
class Parameter:
    """A named number inside a simulator.

    Args:
        name: How the simulator's function finds it, ``p[name]``.
        unit: Its physical unit, for reports only.
        low: Smallest physical value. It limits E[λ], not the quadrature nodes; with ``transform="log"`` it limits
            exp(E[ln λ]), the median of a lognormal λ, and E[λ] may lie above `high`.
        high: Largest physical value, likewise.
        initial: A first guess.
        neutral: The value at which the parameter has no effect. A parameter with a neutral value is held
            there until something frees it.
        transform: ``"log"`` for a positive scale: λ is inferred, and embedded, as ln λ.
        per_run: Whether each run of a recording has a value of its own.

    Raises:
        DomainError: If a number is not finite, the bounds are reversed, a guess lies outside them, or the unit is no
            text.

    >>> Parameter("E", unit="cal/mol", low=36315.5, high=56954.0).name
    'E'
    """

    name: str
    unit: str | None = None
    low: float | None = None
    high: float | None = None
    initial: float | None = None
    neutral: float | None = None
    transform: str | None = None
    per_run: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise DomainError(f"Expected a parameter name (a non-empty string). Got {self.name!r}.")
        if self.unit is not None and not isinstance(self.unit, str):
            raise DomainError(
                f"Expected unit of parameter {self.name!r} as a string or None. Got {type(self.unit).__name__} "
                f"{str(self.unit)!r} (give its text, say unit=str(unit))."
            )
        for field in ("low", "high", "initial", "neutral"):
            value = getattr(self, field)
            if value is None:
                continue
            number = real_number(value)
            if not math.isfinite(number):
                advice = QUANTITY if hasattr(value, "magnitude") else "Leave it out where there is none."
                raise DomainError(
                    f"Expected a finite number for {field} of parameter {self.name!r}. Got {value!r}. {advice}"
                )
            object.__setattr__(self, field, number)
        if not isinstance(self.per_run, bool):
            raise DomainError(f"Expected per_run of parameter {self.name!r} as True or False. Got {self.per_run!r}.")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise DomainError(
                f"Expected low < high for parameter {self.name!r}. Got low={self.low}, high={self.high}. "
                "Swap the bounds, or hold the parameter fixed if it has one value only."
            )
        if self.transform not in (None, "log"):
            raise DomainError(
                f"Expected transform None or 'log' for parameter {self.name!r}. Got {self.transform!r}."
            )
        if self.transform == "log":
            for field in ("low", "high", "initial", "neutral"):
                value = getattr(self, field)
                if value is not None and value <= 0:
                    raise DomainError(
                        f"Expected a positive {field} for parameter {self.name!r}, which is inferred on a "
                        f"logarithmic scale. Got {value}. Use a small positive bound or drop transform='log'."
                    )
        for field in ("initial", "neutral"):
            value = getattr(self, field)
            if value is not None and not self.contains(value):
                raise DomainError(
                    f"Expected {field} of parameter {self.name!r} between its bounds [{self.low}, {self.high}]. "
                    f"Got {value}. Move the bounds or the value."
                )

    @property
    def lowest(self) -> float:
        """What no value lies below: ``low``; without it 0 on a logarithmic scale, else −∞."""
        return self.low if self.low is not None else 0.0 if self.transform == "log" else -math.inf

    def contains(self, value: float) -> bool:
        """Whether a value lies within the physical bounds, the bounds included; 0 is none on a logarithmic scale."""
        below = value < self.lowest or (self.transform == "log" and value <= 0)
        return not below and (self.high is None or value <= self.high)


def limits(parameters: Sequence[Parameter]) -> tuple[Tensor, Tensor]:
    """Physical bounds, infinite where there is none, ``(P,)`` twice."""
    low = [q.lowest for q in parameters]
    high = [math.inf if q.high is None else q.high for q in parameters]
    return torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)


def _is_called(parameter: Parameter, name: str) -> bool:
    """Whether it has the name, or is one run's value of a parameter that has; another's name may only look so."""
    return parameter.name == name or (parameter.per_run and is_value_of(parameter.name, name))


def free_parameters(
    parameters: Sequence[Parameter], fixed: Mapping[str, float] | None = None, *, least: int = 1
) -> tuple[tuple[Parameter, ...], dict[str, float]]:
    """Split parameters into those to be inferred and those held, dormant ones at their neutral value.

    Args:
        parameters: All parameters of a simulator.
        fixed: Values of parameters that the user holds; of one that every run has for itself, its name alone is that of
            all its values but those that are named themselves.
        least: How many must be left free, 1 or 0.

    Returns:
        The free parameters, in order, and ``{name: value}`` of the held ones.

    Raises:
        EmbeddingError: If ``fixed`` names a parameter that does not exist, or nothing is left free.
        DomainError: If a fixed value is no finite number, or lies outside its parameter's bounds.
    """
    if fixed is not None and not isinstance(fixed, Mapping):
        raise DomainError(f"Expected fixed as a dict from parameter names to values. Got {fixed!r}.")
    fixed = dict(fixed or {})
    names = [parameter.name for parameter in parameters]
    called = {name: [q.name for q in parameters if _is_called(q, name)] for name in fixed}
    unknown = sorted(name for name, found in called.items() if not found)
    if unknown:
        raise EmbeddingError(f"Expected fixed parameters among {names}. Got {unknown}. Check the spelling.")
    held: dict[str, float] = {}
    named_last = sorted(fixed.items(), key=lambda item: item[0] in names)
    each = {one: value for name, value in named_last for one in called[name]}
    for name, value in each.items():
        number = real_number(value)
        if not math.isfinite(number):
            advice = QUANTITY if hasattr(value, "magnitude") else f"Give one, as in fixed={{{name!r}: 1.0}}."
            raise DomainError(
                f"Expected a finite number for the fixed parameter {name!r}. Got {value!r} "
                f"({type(value).__name__}). {advice}"
            )
        parameter = parameters[names.index(name)]
        if not parameter.contains(number):
            bounds = "positive values" if parameter.transform == "log" else f"[{parameter.low}, {parameter.high}]"
            raise DomainError(f"Expected the fixed parameter {name!r} within {bounds}. Got {number}.")
        held[name] = number
    for parameter in parameters:
        if parameter.neutral is not None and parameter.name not in held:
            held[parameter.name] = parameter.neutral
    free = tuple(parameter for parameter in parameters if parameter.name not in held)
    if len(free) < least:
        raise EmbeddingError(
            f"Expected at least one free parameter. Got all of {names} fixed or dormant. "
            "Free one of them, or call the simulator directly."
        )
    return free, held


@dataclass(frozen=True)
class Scaling:
    r"""The map between a parameter's physical value λ and the coordinate λ̃ in which it is inferred.

    .. math:: \lambda = c + s \tilde\lambda \quad\text{or}\quad \lambda = \exp(c + s \tilde\lambda)

    A parameter with two bounds is scaled so that they become −1 and 1 (Eq. 40 of the paper).

    Args:
        center: c, shape ``(d,)``, in physical units (their logarithm where ``log``).
        scale: s > 0, shape ``(d,)``, likewise.
        log: Which parameters are on a logarithmic scale, shape ``(d,)``, bool.
    """

    center: Tensor
    scale: Tensor
    log: Tensor

    def __post_init__(self) -> None:
        if not (self.center.shape == self.scale.shape == self.log.shape):
            raise ShapeError(
                "Expected center, scale and log of one shape. "
                f"Got {tuple(self.center.shape)}, {tuple(self.scale.shape)}, {tuple(self.log.shape)}."
            )

    @classmethod
    def from_parameters(
        cls, parameters: Sequence[Parameter], center: Tensor | None = None, scale: Tensor | None = None
    ) -> "Scaling":
        """Scale by bounds where both are given, else by ``center`` and ``scale``, else by ``initial``.

        Args:
            parameters: The free parameters.
            center: Centres (from a least-squares fit), shape ``(d,)``, logarithms where the parameter is logarithmic;
                by default ``initial``, or 0.
            scale: Fallback scales, shape ``(d,)``; default 1.
        """
        centers, scales = [], []
        for i, parameter in enumerate(parameters):
            forward = math.log if parameter.transform == "log" else float
            if parameter.low is not None and parameter.high is not None:
                low, high = forward(parameter.low), forward(parameter.high)
                c, s = 0.5 * (low + high), 0.5 * (high - low)
            else:
                c = 0.0 if center is None else float(center[i])
                s = 1.0 if scale is None else float(scale[i])
                if parameter.initial is not None and center is None:
                    c = forward(parameter.initial)
                    s = 1.0 if parameter.transform == "log" or c == 0 else abs(c)
            centers.append(c)
            scales.append(s)
        log = torch.tensor([parameter.transform == "log" for parameter in parameters])
        return cls(
            torch.tensor(centers, dtype=torch.float64), torch.tensor(scales, dtype=torch.float64), log
        )

    def physical(self, scaled: Tensor) -> Tensor:
        """λ of λ̃, last dimension d."""
        value = self.center.to(scaled) + self.scale.to(scaled) * scaled
        if bool(self.log.any()):
            log = self.log.to(scaled.device)  # where it is not, a large value's exponential has no derivative
            value = torch.where(log, torch.where(log, value, torch.zeros_like(value)).exp(), value)
        return value

    def scaled(self, physical: Tensor) -> Tensor:
        """λ̃ of λ, last dimension d."""
        log = self.log.to(physical.device)
        value = torch.where(log, torch.where(log, physical, torch.ones_like(physical)).log(), physical)
        return (value - self.center.to(physical)) / self.scale.to(physical)

    def bounds(self, parameters: Sequence[Parameter]) -> tuple[Tensor, Tensor]:
        """The physical bounds in scaled coordinates, shape ``(d,)`` twice, ±inf where there is none."""
        ends = []
        for field, missing in (("low", -math.inf), ("high", math.inf)):
            values = []
            for i, parameter in enumerate(parameters):
                value = getattr(parameter, field)
                if value is None:
                    values.append(missing)
                    continue
                value = math.log(value) if parameter.transform == "log" else value
                values.append((value - float(self.center[i])) / float(self.scale[i]))
            ends.append(torch.tensor(values, dtype=torch.float64))
        return ends[0], ends[1]
