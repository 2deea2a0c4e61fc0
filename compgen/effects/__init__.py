"""The catalogue of effects beyond the 21 geometric errors: one file per family, one explicit registry."""

from typing import TYPE_CHECKING

from compgen.resources import on_first_use

if TYPE_CHECKING:
    from compgen.effects.active import (
        ActiveEffect,
        active_effects,
        advice_of_effects,
        displacement_of,
        effects_reversal,
        section_text,
        with_effects_reversal,
    )
    from compgen.effects.all_effects import FAMILIES, catalogue, listed
    from compgen.effects.base import (
        ANY_STATION,
        AllStations,
        Card,
        DisplacementEffect,
        Effect,
        Family,
        Parameter,
        PerAxis,
        PerName,
        PerStation,
        Setting,
        Single,
        along,
    )
    from compgen.effects.readings import Readings, readings_of_deviations, readings_of_lengths, readings_of_points

__all__ = [
    "ANY_STATION",
    "FAMILIES",
    "ActiveEffect",
    "AllStations",
    "Card",
    "DisplacementEffect",
    "Effect",
    "Family",
    "Parameter",
    "PerAxis",
    "PerName",
    "PerStation",
    "Readings",
    "Setting",
    "Single",
    "active_effects",
    "advice_of_effects",
    "along",
    "catalogue",
    "displacement_of",
    "effects_reversal",
    "listed",
    "readings_of_deviations",
    "readings_of_lengths",
    "readings_of_points",
    "section_text",
    "with_effects_reversal",
]

if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__)
