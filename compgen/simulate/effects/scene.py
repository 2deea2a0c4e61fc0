"""What simulated effects act on: the stops of the machine, and the lines of sight of the tracers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.errors import InputError
from compgen.simulate.trajectory import Stops

#: Moves the tip: displacement in the workpiece frame at the stops, shape (n, 3), mm.
Displacement = Callable[[Machine, Stops], FloatArray]


@dataclass(frozen=True)
class Sights:
    """Readings of tracers, n of them.

    Parameters
    ----------
    stops : all stops of the machine.
    stop : stop of each reading, (n,).
    stations : names of the stations.
    station : station of each reading, (n,).
    station_mm, tip_mm : true station and tip of each reading, (n, 3).
    """

    stops: Stops
    stop: NDArray[np.int64]
    stations: tuple[str, ...]
    station: NDArray[np.int64]
    station_mm: FloatArray
    tip_mm: FloatArray

    @property
    def range_mm(self) -> FloatArray:
        """Distance of station and tip, (n,)."""
        return np.asarray(np.linalg.norm(self.tip_mm - self.station_mm, axis=1))

    @property
    def time_s(self) -> FloatArray:
        """Time of each reading, (n,)."""
        return self.stops.time_s[self.stop]

    def channel(self, name: str) -> FloatArray:
        """Covariate of each reading, (n,)."""
        return channel(self.stops, name)[self.stop]


@dataclass(frozen=True)
class LengthEffect:
    """An effect that changes lengths without moving the tip: ``change`` returns what it adds, (n,), mm."""

    name: str
    change: Callable[[Sights], FloatArray]


@dataclass(frozen=True)
class RunEffect:
    """An effect on the readings of axis runs: ``change`` takes their times (n,) and returns what it adds, (n,), mm."""

    name: str
    change: Callable[[FloatArray], FloatArray]


def channel(stops: Stops, name: str) -> FloatArray:
    """Covariate of each stop (n,); InputError if the scenario has none of that name."""
    if name not in stops.covariates:
        what = "[temperatures]" if name.startswith("temp_") else "[session]"
        message = f"an effect needs {name}, which the scenario does not have; add it to {what}"
        raise InputError(message, field="[[effects]]")
    return stops.covariates[name]


def over_travel(machine: Machine, stops: Stops, axis: int) -> FloatArray:
    """Position of an axis over its travel, -1 ... +1, (n,)."""
    low, high = machine.axes[axis].range_mm
    return np.asarray((stops.position_mm[:, axis] - 0.5 * (low + high)) / (0.5 * (high - low)))


def from_reference(values: FloatArray, settings: Mapping[str, float], key: str) -> FloatArray:
    """Values less the setting ``key``, by default less their mean."""
    return values - settings.get(key, float(values.mean()))
