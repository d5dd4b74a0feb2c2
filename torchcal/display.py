"""What text, tables and figures share: how a share is written, what no term is called, when an axis is logarithmic."""

import math

__all__ = ["DECADES", "FAR", "NONE", "percent", "up_to"]

NONE = ("none of these",)
"""In place of terms: something that is not among the candidates."""

DECADES = 30.0
"""Ratio of the ends of a positive range from which on it is laid out in its logarithm."""


FAR = 100.0
"""Difference in log evidence, or distance in noise sd, beyond which a number tells nothing more."""


def up_to(value: float) -> str:
    """A difference in log evidence, or a distance in noise sd.

    >>> up_to(3.14159), up_to(7e73)
    ('3.1', 'more than 100')
    """
    return f"more than {FAR:.0f}" if value > FAR else f"{value:.1f}"


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
