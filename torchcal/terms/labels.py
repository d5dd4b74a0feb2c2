"""Units of what terms estimate, in those of the states, inputs, conditions and outputs that they are made of."""

import dataclasses
import re
from collections.abc import Mapping

from torchcal.terms.term import Term

__all__ = ["labelled"]

#: The parts of a unit's text: ``[x]``, which stands for the unit of x, and names.
PARTS = re.compile(r"\[[^\]]*\]|[^\s/*^()\[\]]+")
#: Brackets around one name, or around brackets.
NEEDLESS = re.compile(r"\(([^\s/*^()]+|\([^()]*\))\)")


def labelled(term: Term, known: Mapping[str, str | None]) -> Term:
    """A term whose parameters' units are by those that are known of what it reads.

    Args:
        term: Of a library, or a user's own.
        known: Units by the names of states, inputs, conditions and outputs.

    >>> from torchcal.terms import sensor
    >>> bend = sensor(("y",), static=True)[2]
    >>> [q.unit for term in (bend, labelled(bend, {"y": "mm"})) for q in term.parameters]
    ['1/([y])', '1/mm']
    """
    units = {f"[{name}]": unit for name, unit in known.items() if unit}
    units |= {label: unit for name, label in term.labels.items() if (unit := known.get(name))}
    if not units:
        return term

    def told(text: str | None) -> str | None:
        if text is None or not any(part in units for part in PARTS.findall(text)):
            return text
        if text in units:
            return units[text]
        return NEEDLESS.sub(r"\1", PARTS.sub(lambda part: _factor(units.get(part[0], part[0])), text))

    return dataclasses.replace(
        term,
        parameters=tuple(dataclasses.replace(q, unit=told(q.unit)) for q in term.parameters),
        states={name: told(unit) for name, unit in term.states.items()},
    )


def _factor(unit: str) -> str:
    """A unit as a part of another one."""
    return f"({unit})" if re.search(r"[\s/*^]", unit) else unit
