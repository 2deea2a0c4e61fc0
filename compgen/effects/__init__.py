"""The catalogue of effects beyond the 21 geometric errors: one file per family, one explicit registry."""

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
from compgen.effects.catalogue import FAMILIES, catalogue, listed
from compgen.effects.readings import Readings, readings_of_deviations, readings_of_lengths

__all__ = [
    "ANY_STATION",
    "FAMILIES",
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
    "along",
    "catalogue",
    "listed",
    "readings_of_deviations",
    "readings_of_lengths",
]
