"""What text, tables and figures share: how a share is written, what no term is called, when an axis is logarithmic."""

import math
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

__all__ = [
    "DECADES", "FAR", "IN_BASE", "ITSELF", "NONE", "PATIENCE", "between", "error_unit", "percent", "placed", "raised",
    "raised_there", "rate_unit", "unit_of", "units_of", "up_to", "version", "with_unit",
]  # fmt: skip

NONE = ("none of these",)
"""In place of terms: something that is not among the candidates."""

IN_BASE = "already in the base model"
"""What is noted of a term that the base can do all of."""

ITSELF = " itself"
"""What the driver of an output that varies with its own value ends with, after the output's name."""

PATIENCE = 2.0
"""Seconds before a calibration shows a bar."""

DECADES = 30.0
"""Ratio of the ends of a positive range from which on it is laid out in its logarithm."""


MOST_DIGITS = 15
"""Digits behind its first that a number is told with at most."""

ROUNDING = 1e-15
"""Share of what is looked at below which a place is where that begins to count."""

FAR = 100.0
"""Difference in log evidence, or distance in noise sd, beyond which a number tells nothing more."""


def up_to(value: float) -> str:
    """A difference in log evidence, or a distance in noise sd.

    >>> up_to(3.14159), up_to(7e73)
    ('3.1', 'more than 100')
    """
    return f"more than {FAR:.0f}" if value > FAR else f"{value:.1f}"


def with_unit(amount: str, unit: str | None) -> str:
    """An amount with its unit, where it has one.

    >>> with_unit("3.2", "m/s"), with_unit("0.06", "1"), with_unit("0.06", None)
    ('3.2 m/s', '0.06', '0.06')
    """
    return amount if unit in (None, "", "1") else f"{amount} {unit}"


def rate_unit(unit: str | None, time: str) -> str | None:
    """That of the rate of what has a unit; None where that is not known.

    >>> [rate_unit(unit, "s") for unit in ("m", "m/s", "m/s^2", "V s", "s", "1", "", "mol/L s", "counts per s")]
    ['m/s', 'm/s^2', 'm/s^3', 'V', '1', '1/s', '1/s', 'mol/L s/s', 'counts per s/s']
    """
    if not unit:
        return None if unit is None else f"1/{time}"
    if unit == time:
        return "1"
    rest = unit.removesuffix(f" {time}")
    if rest != unit and "/" not in rest and not rest.endswith("per"):
        return rest
    whole, _, power = unit.partition(f"/{time}^")
    if power.isascii() and power.isdecimal() and int(power) > 0:
        return f"{whole}/{time}^{int(power) + 1}"
    return f"{unit}^2" if unit.endswith(f"/{time}") else f"{unit}/{time}"


def units_of(recording: Any, simulator: Any) -> dict[str, str]:
    """Units of outputs, states, conditions, inputs and time, by name, of those that have any."""
    states: dict[str, str | None] = getattr(simulator, "states", {})
    units = {name: unit for name, unit in states.items() if isinstance(unit, str)}
    for run in recording.runs or ():
        units |= run.units
    return units | recording.units


def unit_of(driver: str, units: Mapping[str, str]) -> str:
    """That of what something varies with, where ``"t"`` is time; empty where it has none.

    >>> unit_of("t", {"time": "h"}), unit_of("t", {"t": "s", "time": "h"}), unit_of("T itself", {"T": "K"})
    ('h', 's', 'K')
    """
    driver = driver.removesuffix(ITSELF)
    return units.get(driver) or (units.get("time", "") if driver == "t" else "")


def error_unit(recording: Any, simulator: Any) -> str:
    """That of errors: ``"spread"``, each output's own, where there are several; empty where the only one has none.

    >>> from types import SimpleNamespace
    >>> speed = SimpleNamespace(outputs=("v",), units={}, runs=None)
    >>> error_unit(speed, SimpleNamespace(states={"v": "m/s", "n": None}))
    'm/s'
    """
    outputs = recording.outputs
    return "spread" if len(outputs) > 1 else units_of(recording, simulator).get(outputs[0], "")


def percent(share: float | None) -> str:
    """A share as text.

    >>> [percent(share) for share in (0.0, 0.0004, 0.031, 0.5, 0.9996, 1.0, -0.2, math.nan)]
    ['0 %', '<0.1 %', '3.1 %', '50 %', '>99.9 %', '100 %', '−20 %', '–']
    """
    if share is None or not math.isfinite(share):
        return "–"
    if share < 0:
        return "−" + percent(-share)
    if 0 < share < 0.001:
        return "<0.1 %"
    if 0.9995 <= share < 1:
        return ">99.9 %"
    whole = 0.095 <= share < 0.995 or share == 0 or share >= 1
    return f"{100 * share:.0f} %" if whole else f"{100 * share:.1f} %"


def placed(value: float, extent: float) -> str:
    """A place along something, to two thousandths of the extent or less that is looked at, wherever that begins.

    >>> placed(12.3456, 60.0), placed(1.7e9 + 612.34, 3600.0), placed(1.7e9 + 612.34, 20.0), placed(-4e-320, 1.0)
    ('12.35', '1700000612', '1700000612.34', '0')
    """
    if 0 < extent < math.inf and abs(value) < ROUNDING * extent:
        return "0"
    if not (0 < extent < math.inf and math.isfinite(value) and abs(value) >= 10 * extent):
        return f"{value:.4g}"
    decimals, before = math.ceil(-math.log10(extent / 500)), math.floor(math.log10(abs(value)))
    return f"{round(value, decimals):.{min(before + max(decimals, 0), MOST_DIGITS) + 1}g}"


def between(spans: Sequence[tuple[float, float]], word: str, extent: float | None = None) -> list[str]:
    """Ranges along something, in words; by default the extent that is looked at is theirs.

    >>> between([(0.0, 2.5), (7.0, 7.0)], "to"), between([(1.7e9, 1.7e9 + 600.0)], "to")
    (['0 to 2.5', '7'], ['1700000000 to 1700000600'])
    >>> between([(1.7e9 + 60.0, 1.7e9 + 60.0)], "to", 600.0)
    ['1700000060']
    """
    if extent is None:
        ends = [end for span in spans for end in span if math.isfinite(end)]
        extent = max(ends) - min(ends) if ends else 0.0
    return [
        placed(low, extent) if low == high else f"{placed(low, extent)} {word} {placed(high, extent)}"
        for low, high in spans
    ]


def raised(error: BaseException) -> str:
    """What was raised, as the end of a sentence that sets its own full stop.

    >>> raised(ValueError("Not so."))
    'ValueError: Not so'
    """
    return f"{type(error).__name__}: {error}".rstrip(":. ")


def raised_there(error: BaseException | None) -> str:
    """The sentence, with a space before it, that tells what was raised at a point named before; nothing for None."""
    return "" if error is None else f" There the function raised {raised(error)}."


def version(package: str) -> str:
    """Of an installed package; "unknown" where it runs from its sources."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
