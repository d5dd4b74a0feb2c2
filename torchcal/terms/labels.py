"""Units of what terms estimate, in those of the states, inputs, conditions and outputs that they are made of."""

import copy
import dataclasses
import re
from collections.abc import Mapping

from torchcal.display import rate_unit
from torchcal.terms.pieces import factor
from torchcal.terms.term import Term

__all__ = ["labelled"]

#: The parts of a unit's text: ``[x]``, which stands for the unit of x, in brackets of its own or not, and names.
PARTS = re.compile(r"\(\[[^\[\]]*\]\)|\[[^\[\]]*\]|[^\s/*^()\[\]·]+")


def labelled(term: Term, known: Mapping[str, str | None], states: Mapping[str, str | None]) -> Term:
    """A term whose parameters' units are by those that are known of what it reads; itself where that changes nothing.

    Args:
        term: Of a library, or a user's own.
        known: Units by the names of outputs, inputs, conditions and states, for ``[x]``.
        states: Units of the states, for what the term calls them (its ``labels``).

    >>> from torchcal.terms import sensor
    >>> bend = sensor(("y",), static=True)[2]
    >>> [q.unit for term in (bend, labelled(bend, {"y": "mm"}, {})) for q in term.parameters]
    ['1/([y])', '1/mm']
    >>> drift = next(term for term in sensor(("w",)) if term.name == "drift of w")
    >>> [q.unit for q in labelled(drift, {"w": "rad/s"}, {}).parameters]
    ['rad/s^2']
    """
    units = {f"[{name}]": unit for name, unit in known.items() if unit and unit != "1"}
    for label in {*term.labels.values()} - {"1", term.time}:
        found = {name: states.get(name) for name, called in term.labels.items() if called == label}
        if len({*found.values()}) == 1 and all(found.values()):  # not of axes in different units
            name, unit = next(iter(found.items()))
            units[label] = f"[{name}]" if unit == "1" else str(unit)

    def told(text: str | None) -> str | None:
        return None if text is None else units.get(text) or _settled(PARTS.sub(lambda p: _put(p[0], units), text))

    changes = {
        "parameters": tuple(
            q if told(q.unit) == q.unit else dataclasses.replace(q, unit=told(q.unit)) for q in term.parameters
        ),
        "states": {name: told(unit) for name, unit in term.states.items()},
    }
    if all(getattr(term, name) == value for name, value in changes.items()):
        return term
    other = copy.copy(term)  # of its own class, however that is made
    for name, value in (changes | {"labels": {x: units.get(label, label) for x, label in term.labels.items()}}).items():
        object.__setattr__(other, name, value)
    return other


def _settled(unit: str) -> str:
    """A unit, where it is that of a rate once more by the same time with a power of it: (rad/s)/s is rad/s^2."""
    whole, _, time = unit.rpartition("/")
    if whole.startswith("(") and whole.endswith(")"):
        whole = whole[1:-1]
    told = rate_unit(whole, time) if whole and time.isalpha() else None
    return unit if told is None or told == f"{whole}/{time}" else told


def _put(part: str, units: Mapping[str, str]) -> str:
    """What stands for a part of a unit's text, as a factor."""
    unit = units.get(part.removeprefix("(").removesuffix(")"))
    if unit is None:
        return part
    return unit if unit.startswith("[") else factor(unit)
