"""The catalogue of effects beyond the 21 geometric errors: one file per family, one explicit registry."""

from __future__ import annotations

from collections.abc import Sequence

from compgen.effects.backlash import BacklashFamily
from compgen.effects.base import Card, DisplacementEffect, Effect, Family, Parameter
from compgen.effects.readings import Readings, readings_of_deviations, readings_of_lengths

#: Every family by its name.
FAMILIES: dict[str, Family] = {family.name: family for family in (BacklashFamily(),)}


def catalogue(stations: Sequence[str] = ()) -> dict[str, Effect]:
    """Return every effect by its name; those of single stations for ``stations``."""
    members = [effect for family in FAMILIES.values() for effect in family.members(stations)]
    return {effect.card.name: effect for effect in members}


__all__ = [
    "FAMILIES",
    "Card",
    "DisplacementEffect",
    "Effect",
    "Family",
    "Parameter",
    "Readings",
    "catalogue",
    "readings_of_deviations",
    "readings_of_lengths",
]
