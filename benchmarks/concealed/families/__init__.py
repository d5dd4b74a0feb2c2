"""The families of cases, by name."""

from benchmarks.concealed.families import (
    blind,
    chemical,
    electrical,
    fresh,
    hydraulic,
    late,
    mechanical,
    newest,
    orbital,
    still,
    thermal,
    unseen,
)
from benchmarks.concealed.families.base import Family

FAMILIES: dict[str, Family] = {
    family.name: family
    for module in (
        mechanical, thermal, hydraulic, chemical, electrical, orbital, still, late, newest, fresh, unseen, blind
    )
    for family in module.FAMILIES
}

__all__ = ["FAMILIES", "Family"]
