"""Effects that the machine file switches on, taken out of the readings before errors are identified."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.deviations import Deviations
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.effects import (
    ActiveEffect,
    DisplacementEffect,
    Readings,
    active_effects,
    displacement_of,
    readings_of_deviations,
    readings_of_lengths,
)
from compgen.errors import CompgenWarning
from compgen.model.volumetric import tool_of

#: Where a station is taken to be while only the columns of the file are looked at, mm.
FAR_MM = (0.0, 0.0, 1e5)


def effects_of_lengths(machine: Machine, lengths: Lengths) -> tuple[ActiveEffect, ...]:
    """Return the effects of the machine file that act on these lengths; warns of columns that they lack."""
    effects = active_effects(machine)
    if not effects:
        return ()
    tip_mm = lengths.position_mm + tool_of(machine, lengths.tool_mm)
    return _usable(effects, readings_of_lengths(machine, lengths, tip_mm - np.array(FAR_MM), tip_mm))


def _usable(effects: Sequence[ActiveEffect], readings: Readings) -> tuple[ActiveEffect, ...]:
    usable = []
    for active in effects:
        card = active.effect.card
        if readings.kind not in card.kinds:
            continue
        if active.change_mm(readings) is not None:
            usable.append(_settled(active, readings))
        else:
            message = f"{active.name} of the machine file stays in the readings: they lack {', '.join(card.covariates)}"
            warnings.warn(message, CompgenWarning, stacklevel=6)
    return tuple(usable)


def _settled(active: ActiveEffect, readings: Readings) -> ActiveEffect:
    """The effect with what its settings are for these readings, so that a part of them means the same."""
    return replace(active, effect=active.effect.with_settings(active.effect.used(readings)))


def moved_by(effects: Sequence[ActiveEffect], readings: Readings) -> tuple[FloatArray, FloatArray]:
    """Return how effects move the tip (n, 3), and what the others add to the readings (n,), mm."""
    moved, _ = displacement_of(effects, readings)
    lengthened = np.zeros(len(readings))
    for active in effects:
        if not isinstance(active.effect, DisplacementEffect):
            change = active.change_mm(readings)
            lengthened += 0.0 if change is None else change
    return moved, lengthened


def notes_of(effects: Sequence[ActiveEffect]) -> dict[str, Any]:
    """Return the object ``effects`` of ``identify.json``: parameters and settings by the name of the effect."""
    return {active.name: active.summary() for active in effects}


def without_effects(machine: Machine, deviations: Deviations) -> tuple[Deviations, dict[str, Any]]:
    """Return deviations without what the machine file's effects add, and what was taken out."""
    readings = readings_of_deviations(machine, deviations)
    effects = _usable(active_effects(machine), readings)
    moved, lengthened = moved_by(effects, readings)
    moved_mm = np.zeros((3, len(deviations)))  # readings are all dX, then all dY, then all dZ
    moved_mm[~np.isnan(deviations.deviation_mm.T)] = np.sum(readings.direction * moved, axis=1) + lengthened
    return replace(deviations, deviation_mm=deviations.deviation_mm - moved_mm.T), notes_of(effects)
