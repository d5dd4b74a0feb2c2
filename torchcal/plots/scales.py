"""Ticks of very small, very large or nearly equal numbers, whose common factor and start stand in the axis label."""

import re
from typing import Any

from matplotlib.ticker import ScalarFormatter

from torchcal.plots.style import wrapped


class Scaled(ScalarFormatter):
    """Writes the factor of the ticks beside the unit, where matplotlib would write it in a corner, under a legend.

    It follows the limits and the label as they are when the figure is drawn. An axis without a label keeps
    matplotlib's corner.
    """

    def __init__(self) -> None:
        super().__init__()
        self._labels: dict[Any, tuple[str, str]] = {}

    def set_locs(self, locs: Any) -> None:
        """Choose factor and start for these ticks, and write them into the label."""
        super().set_locs(locs)
        for axis in self._axes():
            text = axis.label.get_text()
            own, written = self._labels.get(axis, ("", ""))
            if text != written:  # it was set anew, perhaps from what was written here
                own = _without_factor(text)
            new = self._scaled(own, axis.axis_name == "y") if own and len(locs) else own
            self._labels[axis] = own, new
            if new != text:
                axis.label.set_text(new)

    def get_offset(self) -> str:
        """What stands in the corner: nothing where labels tell it."""
        told = [own for axis, (own, _) in self._labels.items() if axis.get_visible()]
        return "" if told and all(told) else super().get_offset()

    def let_go(self, axes: Any) -> None:
        """Give labels back to axes that have another formatter by now, as a logarithmic scale brings one."""
        for axis in (axes.xaxis, axes.yaxis):
            own, written = self._labels.get(axis, ("", ""))
            if written and axis.get_major_formatter() is not self and axis.label.get_text() == written:
                axis.label.set_text(own)
                del self._labels[axis]

    def _axes(self) -> list[Any]:
        """The axis, and those that share its ticks."""
        axis: Any = self.axis
        if getattr(axis, "axes", None) is None:
            return []
        shared = getattr(axis.axes, f"get_shared_{axis.axis_name}_axes", None)
        every = [axis.axes] if shared is None else shared().get_siblings(axis.axes)
        found = [getattr(ax, f"{axis.axis_name}axis") for ax in every]
        return [other for other in found if other.get_major_formatter() is self]

    def _scaled(self, text: str, upright: bool) -> str:
        known = vars(self)
        power = known["_orderOfMagnitude" if "_orderOfMagnitude" in known else "orderOfMagnitude"]  # matplotlib < 3.11
        if not (self.offset or power):
            return text
        if self.offset:
            start = f" {'−' if self.offset > 0 else '+'} {abs(self.offset):.15g}"
            place = _bracket(text)
            end = len(text) if place is None else place.start()
            text = text[:end] + start + text[end:]
        if power:
            text = with_factor(text, power)
        return wrapped(text) if upright else text


def with_factor(text: str, power: int) -> str:
    """An axis label with a power of ten before its unit.

    >>> with_factor("y [m]", 9)
    'y [1e9 m]'
    """
    factor = f"1e{power}".replace("-", "−")
    place = _bracket(text)
    if place is None:
        return f"{text} [{factor}]"
    unit = place[1]
    per = re.match(r"1\s*/\s*", unit)
    inside = factor if unit == "1" else f"{factor}/{unit[per.end() :]}" if per else f"{factor} {unit}"
    return text[: place.start(1)] + inside + text[place.end(1) :]


def _without_factor(text: str) -> str:
    """A label without the factor that `with_factor` has written.

    >>> _without_factor(with_factor("k [1/s]", 9)), _without_factor(with_factor("y [m]", -9))
    ('k [1/s]', 'y [m]')
    """
    text = re.sub(r"(?<=\[)1e−?\d+/", "1/", text)
    return re.sub(r"(?<=\[)1e−?\d+ (?=\S)| \[1e−?\d+\]", "", text)


def _bracket(text: str) -> re.Match[str] | None:
    """Where a label has its unit."""
    found = list(re.finditer(r"\s\[([^\[\]]*)\]", text))
    return found[-1] if found else None
