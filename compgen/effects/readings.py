"""Scalar readings of the tool tip along known directions: what every effect of the catalogue acts on.

Tracer lengths, measured deviations and axis runs differ in what a reading is, not in what moves the tip. A reading
changes by ``direction . displacement``; a length also has a station and a range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.deviations import Deviations
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.points import Points
from compgen.model.volumetric import tool_of

Kind = Literal["lengths", "deviations", "axis"]


@dataclass(frozen=True)
class Readings:
    """n scalar readings, with everything that an effect may depend on.

    Parameters
    ----------
    machine : the machine.
    kind : what a reading is: a tracer length, one component of a deviation, or a reading of an axis run.
    position_mm : commanded positions, (n, 3).
    direction : unit vectors (n, 3); a displacement d of the tip in the workpiece frame raises the reading by
        ``direction . d`` to first order.
    tool_mm : tool offset, (n, 3).
    stations : names of the stations; empty if there are none.
    station : index into ``stations``, (n,); zeros if there are none.
    range_mm : distance of the tip from the station, (n,); zeros if there is no station.
    approach : last direction of travel of each axis, +1, -1, 0 where it is not known, (n, 3); None if none is known.
    covariates : further numbers by column name (``time_s``, ``feed_mm_min``, ``load_kg``, ``temp_<name>_c``), each (n,).
    labels : whole numbers by column name (line, repeat, block, setup, run, pose), each (n,).
    """

    machine: Machine
    kind: Kind
    position_mm: FloatArray
    direction: FloatArray
    tool_mm: FloatArray
    stations: tuple[str, ...]
    station: NDArray[np.int64]
    range_mm: FloatArray
    approach: FloatArray | None = None
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.direction)

    def covariate(self, name: str) -> FloatArray | None:
        """Return a covariate (n,); None if it was not logged for every reading."""
        logged = self.covariates.get(name)
        return None if logged is None or not np.isfinite(logged).all() else logged

    def temperature_k(self, name: str, reference_c: float | None = None) -> FloatArray | None:
        """Temperature of channel ``temp_<name>_c`` less ``reference_c``, (n,); default: less its mean.

        None if it was not logged for every reading, or if it never changed and no reference is given.
        """
        logged = self.covariate(f"temp_{name}_c")
        if logged is None or (reference_c is None and np.ptp(logged) == 0.0):
            return None
        return np.asarray(logged - (logged.mean() if reference_c is None else reference_c))

    def is_from(self, name: str) -> NDArray[np.bool_]:
        """Whether each reading was taken from station ``name``, (n,)."""
        if name not in self.stations:
            return np.zeros(len(self), dtype=np.bool_)
        return np.asarray(self.station == self.stations.index(name))

    def normalised(self, axis: int) -> FloatArray:
        """Position of an axis over its travel, -1 ... +1, (n,)."""
        low, high = self.machine.axes[axis].range_mm
        return np.asarray((2.0 * self.position_mm[:, axis] - low - high) / (high - low))


def readings_of_lengths(machine: Machine, lengths: Lengths, station_mm: FloatArray, tip_mm: FloatArray) -> Readings:
    """Return tracer readings; ``station_mm`` and ``tip_mm`` (n, 3) are station and tip of each reading."""
    line_mm = tip_mm - station_mm
    range_mm = np.linalg.norm(line_mm, axis=1)
    return Readings(
        machine=machine,
        kind="lengths",
        position_mm=lengths.position_mm,
        direction=line_mm / range_mm[:, None],
        tool_mm=np.broadcast_to(tool_of(machine, lengths.tool_mm), lengths.position_mm.shape),
        stations=lengths.stations,
        station=lengths.station,
        range_mm=range_mm,
        approach=lengths.approach,
        covariates=lengths.covariates,
        labels=lengths.labels,
    )


def readings_of_deviations(machine: Machine, deviations: Deviations) -> Readings:
    """Return the measured components of deviations as readings: all dX, then all dY, then all dZ."""
    measured = ~np.isnan(deviations.deviation_mm)
    row = np.concatenate([np.flatnonzero(measured[:, k]) for k in range(len(AXES))])
    component = np.repeat(np.arange(len(AXES)), measured.sum(axis=0))
    tool_mm = np.broadcast_to(tool_of(machine, deviations.tool_mm), deviations.position_mm.shape)
    return Readings(
        machine=machine,
        kind="deviations",
        position_mm=deviations.position_mm[row],
        direction=np.eye(3)[component],
        tool_mm=tool_mm[row],
        stations=(),
        station=np.zeros(len(row), dtype=np.int64),
        range_mm=np.zeros(len(row)),
        approach=None if deviations.approach is None else deviations.approach[row],
        covariates={name: values[row] for name, values in deviations.covariates.items()},
        labels={name: values[row] for name, values in deviations.labels.items()},
    )


def readings_of_points(machine: Machine, points: Points) -> Readings:
    """Return commanded points as readings, one each, for effects that move the tip; their direction is Z."""
    count = len(points)
    setup = points.covariates.get("setup")
    return Readings(
        machine=machine,
        kind="deviations",
        position_mm=points.position_mm,
        direction=np.broadcast_to([0.0, 0.0, 1.0], (count, 3)),
        tool_mm=np.broadcast_to(tool_of(machine, points.tool_mm), (count, 3)),
        stations=(),
        station=np.zeros(count, dtype=np.int64),
        range_mm=np.zeros(count),
        approach=points.approach,
        covariates={name: values for name, values in points.covariates.items() if name != "setup"},
        labels={} if setup is None else {"setup": setup.astype(np.int64)},
    )
