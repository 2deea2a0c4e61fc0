"""What an effect of the catalogue is: an equation, what it depends on, its parameters, and what it may be confused with.

An effect is linear in its parameters once its scan position (a time, a pitch) is chosen. It knows one thing: how much
each reading changes per unit of each parameter.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.effects.readings import Readings


@dataclass(frozen=True)
class Parameter:
    """One parameter: ``name`` ends in its unit (``c_um``); ``si_per_unit`` leads to mm, rad, K, s.

    ``plausible`` is the largest size, in the unit of the name, that the effect has on real machines.
    """

    name: str
    si_per_unit: float
    meaning: str
    plausible: float


@dataclass(frozen=True)
class Card:
    """What the catalogue says about an effect.

    Parameters
    ----------
    name : e.g. ``"backlash_X"``.
    title : in words.
    equation : the equation, as text.
    source : where it comes from.
    covariates : columns that it needs.
    parameters : its free parameters.
    aliases : effects that data may confuse with it.
    breaker : the smallest further measurement that separates them.
    kinds : the kinds of readings in which it can show.
    """

    name: str
    title: str
    equation: str
    source: str
    covariates: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    aliases: tuple[str, ...] = ()
    breaker: str = ""
    kinds: tuple[str, ...] = ("lengths", "deviations", "axis")


class Effect(ABC):
    """One effect of the catalogue."""

    card: Card

    @abstractmethod
    def columns(self, readings: Readings) -> FloatArray | None:
        """Change of every reading in mm per SI unit of every parameter, (n, k); None where a covariate is missing."""

    def positions(self, readings: Readings) -> Sequence[float]:
        """Scan positions (e.g. times of a step) that the data leave open; empty if there is nothing to scan."""
        return ()

    def at(self, position: float) -> Effect:
        """Return the effect with its scan position fixed; only for effects with ``positions``."""
        raise TypeError(f"{self.card.name} has no scan position")


class DisplacementEffect(Effect):
    """An effect that moves the tool tip in the workpiece frame."""

    @abstractmethod
    def displacement(self, readings: Readings) -> FloatArray | None:
        """Displacement of the tip in mm per SI unit of every parameter, (n, 3, k); None where a covariate is missing."""

    def columns(self, readings: Readings) -> FloatArray | None:
        """Contract the displacement with the direction of each reading."""
        moved = self.displacement(readings)
        return None if moved is None else np.asarray(np.einsum("nd,ndk->nk", readings.direction, moved))


class Family(ABC):
    """Effects of one equation: one for each axis, station or channel."""

    name: str

    @abstractmethod
    def members(self, stations: Sequence[str]) -> Sequence[Effect]:
        """Return the effects of this family; ``stations`` are the names of the stations of the measurement."""
