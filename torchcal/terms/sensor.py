"""What instruments do to a signal before it is recorded."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchcal.errors import DomainError
from torchcal.simulators import Parameter
from torchcal.terms.pieces import amplitude, check_name, check_names, excess, factor, shape, start, timed
from torchcal.terms.term import Term, outer

__all__ = ["sensor"]

#: A first-order instrument shows 90 % of a step after ln 10 time constants.
RESPONSE = math.log(10.0)
#: An instrument shows the signal late, and all of it: the share of it, and how far its estimate may be off.
NATURE = (1.0, 0.15)

Signal = Callable[..., Any]


def sensor(
    outputs: str | Sequence[str] | Mapping[str, Signal] = ("x",),
    *,
    static: bool = False,
    drift: str | Mapping[str, float] | None = None,
    dynamic: bool = True,
    units: Mapping[str, str] | None = None,
    time: str = "s",
) -> list[Term]:
    r"""Errors of the instrument behind every output: offset, gain, non-linearity, saturation, drift, lag and delay.

    A lag is an instrument of first order, :math:`y + a (z - y)` with :math:`\dot z = (y - z) \ln 10 / t_{90}`: a = 1 in
    nature, with an sd of 0.15 as its prior, and t90 is the time to 90 % of a step. A delay by D, with the same a, is
    the Padé approximant

    .. math:: e^{-D s} \approx \frac{1 - 2 D s/5 + (D s)^2/20}{1 + 3 D s/5 + 3 (D s)^2/20 + (D s)^3/60},

    within 3 % for signals of angular frequencies up to 2.5/D, that is periods from 2.5 D on. Its poles are of magnitude
    4.1/D and less.

    Args:
        outputs: Names of the outputs. Lag and delay follow the state of the same name; for an output that is a
            function of the states, give ``{output: f(t, s, p, u)}``. They begin at its first value, which must follow
            from states, parameters and inputs; where it depends on t, say ``dynamic=False``.
        static: Whether they are outputs of a static simulator: then there is neither lag nor delay, and a drift only
            against a condition.
        drift: Condition against which the instrument of a static simulator drifts, and the value at which it reads
            right, ``{"T": 293.15}``. With the name alone that is 0; far from there a drift is an offset, nearly.
        dynamic: Whether to offer lag and delay, each of which brings hidden states.
        units: Units of the outputs, for reports; ``[x]`` stands for that of x otherwise, which `diagnose` puts in its
            place where the recording tells it.
        time: Unit of time, for reports.

    Returns:
        The terms; each is named after its output, as ``"offset of x"``.

    Raises:
        DomainError: If no output is named, or a drift is named for a simulator in time.

    >>> [term.name for term in sensor(("x",))][:3]
    ['offset of x', 'gain error of x', 'non-linearity of x']
    """
    if isinstance(outputs, str):
        outputs = (outputs,)
    given: Mapping[str, Signal | None] = (
        outputs if isinstance(outputs, Mapping) else dict.fromkeys(check_names(outputs, "outputs"))
    )
    check_names(tuple(given), "outputs")
    if bad := [name for name, signal in given.items() if signal is not None and not callable(signal)]:
        raise DomainError(f"Expected functions f(t, s, p, u) of the outputs {bad}. Got {given[bad[0]]!r}.")
    if units is not None and not isinstance(units, Mapping):
        raise DomainError(f"Expected units as a dict from outputs to units. Got {units!r}.")
    if drift is not None and not static:
        raise DomainError("Expected drift= only with static=True. In time the drift is one in time.")
    terms = []
    for output, signal in given.items():
        unit = (units or {}).get(output, f"[{output}]")
        terms += _instant(output, unit, static)
        if static and drift is not None:
            ((condition, origin),) = _origin(drift).items()
            terms.append(_drift(output, f"{unit}/[{condition}]", condition, origin))
        if not static:
            terms.append(_drift(output, f"{unit}/{check_name(time, 'time')}", None))
            if dynamic:
                terms += _dynamic(output, unit, time, _signal(output) if signal is None else signal)
    return terms if static else timed(terms, time)


def _instant(output: str, unit: str, static: bool) -> list[Term]:
    """What depends on nothing but the signal itself."""

    def add(
        name: str,
        function: Callable[[Any, Tensor], Tensor],
        parameters: list[Parameter],
        formula: str,
        description: str,
        scales: Mapping[str, str] | None = None,
    ) -> Term:
        seen: Signal = (lambda x, p, y: function(p, y)) if static else (lambda t, s, p, u, y: function(p, y))
        return Term(
            f"{name} of {output}", outputs={output: seen}, parameters=parameters, scales=scales,
            formula=f"{output} → {output} {formula}", description=description,
        )  # fmt: skip

    return [
        add("offset", lambda p, y: y + p["b"], [amplitude("b", unit)],
            "+ b", "The instrument's zero is off."),
        add("gain error", lambda p, y: y + p["g"] * y, [amplitude("g", "1")],
            f"+ g {output}", "The instrument's scale is off by the fraction g."),
        add("non-linearity", lambda p, y: y + p["q"] * y.square(), [amplitude("q", f"1/{factor(unit)}")],
            f"+ q {output}²", "The instrument's response bends."),
        add("saturation", lambda p, y: y - p["c"] * y.sign() * excess(y.abs(), p["y0"]),
            # 1 is a hard limit; room above, so that noise does not push the estimate against a bound.
            [amplitude("c", "1", low=0.0, high=1.5), shape("y0", unit)],
            f"- c sign({output}) max(|{output}| - y0, 0)",
            "Beyond y0 the instrument shows only the fraction 1 - c of a change; c = 1 is a hard limit.",
            {"y0": output}),
    ]  # fmt: skip


def _origin(drift: str | Mapping[str, float]) -> dict[str, float]:
    """The condition of a drift, and where it is nothing."""
    found = {drift: 0.0} if isinstance(drift, str) else drift
    try:
        ((name, value),) = found.items()
        origin = float(value)
    except (AttributeError, TypeError, ValueError):
        name, origin = "", math.nan
    if not math.isfinite(origin):
        raise DomainError(
            'Expected drift= as a condition, or as one with the number at which it is nothing, {"T": 293.15}. '
            f"Got {drift!r}."
        )
    return {check_name(name, "drift"): origin}


def _drift(output: str, unit: str, condition: str | None, origin: float = 0.0) -> Term:
    if condition is None:
        seen: Signal = lambda t, s, p, u, y: y + p["b"] * t  # noqa: E731
    else:
        seen = lambda x, p, y: y + p["b"] * ((x[condition] if isinstance(x, Mapping) else x) - origin)  # noqa: E731
    against = (condition or "t") if not origin else f"({condition} {'-' if origin > 0 else '+'} {abs(origin):g})"
    return Term(
        f"drift of {output}", outputs={output: seen}, parameters=[amplitude("b", unit)],
        formula=f"{output} → {output} + b {against}", description="The instrument's zero moves steadily.",
        elapsed="recording" if condition is None else None,
    )  # fmt: skip


def _signal(output: str) -> Signal:
    """The output as the state of the same name."""

    def signal(t: Any, s: Mapping[str, Any], p: Any, u: Any) -> Any:
        if output not in s:
            raise DomainError(
                f"Expected {output!r} to be a state, for the lag of its instrument. Got states {list(s)}. Give "
                f"outputs={{{output!r}: f(t, s, p, u)}}, or dynamic=False to leave lag and delay out."
            )
        return s[output]

    return signal


def _dynamic(output: str, unit: str, time: str, given: Signal) -> list[Term]:
    """Instruments with a memory of their own."""

    def signal(t: Any, s: Any, p: Any, u: Any) -> Any:
        return given(t, s, outer(p), u)

    def first(s: Any, p: Any, u: Any) -> Any:
        like = next(iter(s.values()))
        found, later = (torch.as_tensor(signal(torch.full_like(like, t), s, p, u)) for t in (0.0, 1.0))
        if not torch.equal(found.nan_to_num(), later.nan_to_num()):  # a run need not begin at t = 0
            raise DomainError(
                f"Expected the output {output!r} from states, parameters and inputs, to begin its lag with. It depends "
                "on t. Use dynamic=False to leave lag and delay out."
            )
        return found

    lag, delay = f"lag of {output}", f"delay of {output}"
    shown, size = f"{lag}: shown", f"{output}_max"
    smooth, slope, bend = (f"{delay}: {part}" for part in ("smooth", "slope", "bend"))

    def jerk(t: Any, s: Any, p: Any, u: Any) -> Any:
        D = p["D"]
        wanted = signal(t, s, p, u) - s[smooth] - D * (0.6 * s[slope] + 0.15 * D * s[bend])
        return 60.0 * wanted / D**3

    def late(s: Any, p: Any) -> Any:
        return s[smooth] - p["D"] * (0.4 * s[slope] - 0.05 * p["D"] * s[bend])

    return [
        Term(lag,
             rates={shown: lambda t, s, p, u: RESPONSE * (signal(t, s, p, u) - s[shown]) / p["t90"]},
             states={shown: unit}, initial={shown: lambda s, p, u: first(s, p, u) + p["start"] * p[size]},
             outputs={output: lambda t, s, p, u, y: y + p["a"] * (s[shown] - y)},
             parameters=[amplitude("a", "1", low=0.0, high=1.5), shape("t90", time), start(0.0, -2.0, 2.0)],
             scales={"t90": "t"}, constants={size: output}, expected={"a": NATURE},
             formula=f"{output} → {output} + a ({output}_shown - {output}), "
             f"d{output}_shown/dt = 2.303 ({output} - {output}_shown)/t90, "
             f"{output}_shown(0) = {output}(0) + start {size}",
             description="The instrument follows with a response time t90 (to 90 % of a step); a = 1 in nature."),
        Term(delay,
             rates={smooth: lambda t, s, p, u: s[slope], slope: lambda t, s, p, u: s[bend], bend: jerk},
             states={smooth: unit, slope: f"{unit}/{time}", bend: f"{unit}/{time}^2"},
             initial={smooth: first, slope: 0.0, bend: 0.0},
             outputs={output: lambda t, s, p, u, y: y + p["a"] * (late(s, p) - y)},
             parameters=[amplitude("a", "1", low=0.0, high=1.5), shape("D", time)], scales={"D": "t"},
             expected={"a": NATURE},
             formula=f"{output}(t) → {output}(t) + a ({output}(t - D) - {output}(t)), exp(-Ds) by its Padé approximant",
             description="The signal arrives after a dead time D; a = 1 in nature."),
    ]  # fmt: skip
