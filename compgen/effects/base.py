"""Definition of an effect of the catalogue: equation, covariates, parameters, and effects it may be confused with.

An effect is linear in its parameters once its settings (the time of a step, a pitch) are chosen. It knows only how much
each reading changes per unit of each parameter.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES, MM_PER_UM
from compgen.effects.readings import Readings

#: Placeholder for a station name when the catalogue is listed without a measurement.
ANY_STATION = "<station>"


@dataclass(frozen=True)
class Parameter:
    """One parameter: ``name`` ends in its unit (``c_um``); ``si_per_unit`` converts to mm, rad, K, s.

    ``plausible`` is the largest magnitude on real machines, in the unit of the name.
    """

    name: str
    si_per_unit: float
    meaning: str
    plausible: float


@dataclass(frozen=True)
class Setting:
    """A number in which an effect is not linear: the time of a step, a pitch, the reference temperature.

    ``needed``: there is no default. ``mean_of``: the default is the mean of this covariate.
    """

    name: str
    meaning: str
    needed: bool = False
    mean_of: str = ""


def reference_of(covariate: str) -> Setting:
    """Return the setting for the temperature at which an effect is zero."""
    return Setting(
        "reference_c", "temperature at which the effect is zero; default: mean of the readings", mean_of=covariate
    )


@dataclass(frozen=True)
class Card:
    """What the catalogue says about an effect.

    Parameters
    ----------
    name : e.g. ``"backlash_X"``.
    title : name in words.
    equation : the equation, as text.
    source : where it comes from.
    covariates : required columns.
    parameters : its free parameters.
    aliases : effects that data may confuse with it.
    breaker : the smallest additional measurement that separates them.
    kinds : the kinds of readings in which it can show; ``noise`` if it shows only in the residuals.
    settings : numbers in which it is not linear; a machine file may give them.
    scan : the setting that is searched for in the data, empty if there is none.
    slow : whether it changes only slowly with time or temperature, so drifting noise resembles it.
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
    settings: tuple[Setting, ...] = ()
    scan: str = ""
    slow: bool = False

    def named(self, **words: str) -> Card:
        """Return the card with names in braces replaced by ``words`` in all its texts."""

        def said(value: Any) -> Any:
            if isinstance(value, str):
                return value.format(**words)
            if isinstance(value, tuple):
                return tuple(said(item) for item in value)
            if isinstance(value, Parameter | Setting):
                return replace(value, **{key: said(text) for key, text in vars(value).items()})
            return value

        return replace(self, **{key: said(value) for key, value in vars(self).items()})


class Effect(ABC):
    """One effect of the catalogue; ``settings`` contains the chosen ones."""

    card: Card
    settings: Mapping[str, float] = MappingProxyType({})

    @abstractmethod
    def columns(self, readings: Readings) -> FloatArray | None:
        """Change of every reading in mm per SI unit of every parameter, (n, k); None if a covariate is missing."""

    def shown(self, readings: Readings) -> Self | None:
        """Return the effect with only what the positions of the readings can show; None if they show nothing of it."""
        return self

    def positions(self, readings: Readings) -> Sequence[float]:
        """Scan positions (e.g. times of a step) to be tried; empty if there is nothing to scan."""
        return () if self.card.scan in self.settings else self.candidates(readings)

    def candidates(self, readings: Readings) -> Sequence[float]:
        """Scan positions if the setting is not chosen."""
        return ()

    def at(self, position: float) -> Self:
        """Return the effect with its scan position fixed; only for effects with ``positions``."""
        if not self.card.scan:
            raise TypeError(f"{self.card.name} has no scan position")
        return self.with_settings({self.card.scan: position})

    def with_settings(self, settings: Mapping[str, float]) -> Self:
        """Return the effect with some of its settings chosen."""
        chosen = copy.copy(self)
        chosen.settings = MappingProxyType({**self.settings, **settings})
        return chosen

    def used(self, readings: Readings) -> dict[str, float]:
        """Settings for these readings, chosen or derived from them: what a machine file has to contain."""
        return {**self.defaults(readings), **self.settings}

    def defaults(self, readings: Readings) -> dict[str, float]:
        """Settings derived from the readings: the mean of a covariate as its zero."""
        means = (
            (setting.name, readings.covariate(setting.mean_of)) for setting in self.card.settings if setting.mean_of
        )
        return {name: float(logged.mean()) for name, logged in means if logged is not None}


class DisplacementEffect(Effect):
    """An effect that moves the tool tip in the workpiece frame."""

    @abstractmethod
    def displacement(self, readings: Readings) -> FloatArray | None:
        """Displacement of the tip in mm per SI unit of every parameter, (n, 3, k); None if a covariate is missing."""

    def columns(self, readings: Readings) -> FloatArray | None:
        """Project the displacement on the direction of each reading."""
        moved = self.displacement(readings)
        return None if moved is None else np.asarray(np.einsum("nd,ndk->nk", readings.direction, moved))


class SingleAxisEffect(DisplacementEffect):
    """An effect of one axis; its ``template`` is its card with ``{A}`` and ``{a}`` for the axis letter."""

    template: ClassVar[Card]

    def __init__(self, axis: int) -> None:
        self.axis = axis
        self.card = self.template.named(A=AXES[axis], a=AXES[axis].lower())


def vector_parameters(
    meaning: str, plausible: float, unit: str = "um", si_per_unit: float = MM_PER_UM
) -> tuple[Parameter, ...]:
    """Parameters ``cx_um``, ``cy_um``, ``cz_um`` of a displacement (or ``vx_...`` of a velocity); ``{}`` is the axis."""
    letter = "c" if unit == "um" else "v"
    return tuple(Parameter(f"{letter}{a.lower()}_{unit}", si_per_unit, meaning.format(a), plausible) for a in AXES)


def along(axis: int, columns: FloatArray) -> FloatArray:
    """Displacement (n, 3, k) along one axis of ``columns`` (n,) or (n, k)."""
    columns = columns.reshape(len(columns), -1)
    moved = np.zeros((len(columns), 3, columns.shape[1]))
    moved[:, axis] = columns
    return moved


class Family(ABC):
    """Effects with the same equation: one for each axis, station or channel."""

    name: str

    @abstractmethod
    def members(self, stations: Sequence[str]) -> Sequence[Effect]:
        """Return the effects of this family; ``stations`` are the station names of the measurement."""


class Single(Family):
    """A family with one effect; ``make`` returns it."""

    def __init__(self, name: str, make: Callable[[], Effect]) -> None:
        self.name, self._make = name, make

    def members(self, stations: Sequence[str]) -> Sequence[Effect]:
        """The only effect."""
        return [self._make()]


class PerName(Family):
    """One effect for each of several fixed names (of errors, of classes); ``make`` takes the name."""

    def __init__(self, name: str, names: Sequence[str], make: Callable[[str], Effect]) -> None:
        self.name, self._names, self._make = name, tuple(names), make

    def members(self, stations: Sequence[str]) -> Sequence[Effect]:
        """The effects of the names, in their order."""
        return [self._make(name) for name in self._names]


class PerAxis(PerName):
    """One effect for each axis; ``make`` takes its number 0, 1, 2."""

    def __init__(self, name: str, make: Callable[[int], Effect]) -> None:
        super().__init__(name, AXES, lambda letter: make(AXES.index(letter)))


class PerStation(Family):
    """One effect for each station; ``make`` takes its name."""

    def __init__(self, name: str, make: Callable[[str], Effect]) -> None:
        self.name, self._make = name, make

    def members(self, stations: Sequence[str]) -> Sequence[Effect]:
        """The effects of the stations."""
        return [self._make(station) for station in stations]


class AllStations(Family):
    """One effect with a parameter for each station; ``make`` takes their names."""

    def __init__(self, name: str, make: Callable[[tuple[str, ...]], Effect]) -> None:
        self.name, self._make = name, make

    def members(self, stations: Sequence[str]) -> Sequence[Effect]:
        """The only effect; none without stations."""
        return [self._make(tuple(stations))] if stations else []
