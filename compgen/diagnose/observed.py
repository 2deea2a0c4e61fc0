"""One form for every kind of measurement: scalar readings, the unknowns that place them, and their derivative.

Reading = model(errors, placement) + effects + noise. Lengths are placed by stations and dead lengths, deviations by a
rigid motion of their frame.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.deviations import Deviations
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.diagnose.layout import IntArray, Layout, layout_of
from compgen.diagnose.station_start import located
from compgen.effects import Readings, readings_of_deviations, readings_of_lengths
from compgen.identify.task import dead_lengths_of
from compgen.model.volumetric import tool_of


@dataclass(frozen=True)
class Poses:
    """Distinct positions with their tools (m, 3), and the pose of each reading (n,)."""

    position_mm: FloatArray
    tool_mm: FloatArray
    of: IntArray


def poses_of(position_mm: FloatArray, tool_mm: FloatArray) -> Poses:
    """Number the distinct poses of readings; positions and tools (n, 3)."""
    keys: FloatArray = np.column_stack([position_mm, np.broadcast_to(tool_mm, position_mm.shape)])
    unique, inverse = np.unique(np.round(keys, 7), axis=0, return_inverse=True)
    unique = np.asarray(unique, dtype=np.float64)
    return Poses(unique[:, :3], unique[:, 3:], inverse.ravel().astype(np.int64))


class Observed(ABC):
    """A measurement as scalar readings ``value_mm`` (n,) with poses and layout."""

    machine: Machine
    value_mm: FloatArray
    poses: Poses
    layout: Layout
    placement_names: tuple[str, ...]

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.value_mm)

    @abstractmethod
    def start(self) -> FloatArray:
        """Start values of the placement, (k,), mm and rad."""

    @abstractmethod
    def placed(self, tip_mm: FloatArray, placement: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predicted readings (n,), direction of each (n, 3), derivative by the placement (n, k); tips (m, 3)."""

    @abstractmethod
    def readings(self, tip_mm: FloatArray, placement: FloatArray) -> Readings:
        """The readings as effects see them."""

    @abstractmethod
    def part(self, rows: IntArray) -> Observed:
        """Return some of the readings."""


class ObservedLengths(Observed):
    """Tracer lengths: unknown stations, and a dead length for each station and set-up."""

    def __init__(self, machine: Machine, lengths: Lengths) -> None:
        self.machine, self.lengths = machine, lengths
        self.value_mm = lengths.length_mm
        self.poses = poses_of(lengths.position_mm, tool_of(machine, lengths.tool_mm))
        self.group = dead_lengths_of(lengths)
        names = [f"station {name} {axis}" for name in lengths.stations for axis in "xyz"]
        setup = lengths.labels.get("setup")
        for group in range(int(self.group.max()) + 1):
            row = int(np.argmax(self.group == group))
            where = "" if setup is None else f" in set-up {setup[row]}"
            names.append(f"dead length of {lengths.stations[lengths.station[row]]}{where}")
        self.placement_names = tuple(names)
        self.layout = layout_of(self._bare_readings(), lengths.station)

    def _bare_readings(self) -> Readings:
        """Readings with directions and ranges left open: all that the layout needs."""
        far = self.lengths.position_mm.mean(axis=0) + np.array([0.0, 0.0, 1e5])
        tips = self.lengths.position_mm
        return readings_of_lengths(self.machine, self.lengths, np.broadcast_to(far, tips.shape), tips)

    def start(self) -> FloatArray:
        """Stations and dead lengths in closed form from the nominal targets."""
        target = (self.poses.position_mm + self.poses.tool_mm)[self.poses.of]
        stations, dead = np.zeros((len(self.lengths.stations), 3)), np.zeros(int(self.group.max()) + 1)
        for k in range(len(stations)):
            rows = self.lengths.station == k
            own, member = np.unique(self.group[rows], return_inverse=True)
            member = member.ravel().astype(np.int64)
            found, _ = located(target[rows], self.value_mm[rows], member, len(own))
            stations[k], dead[own] = found.position_mm, found.dead_length_mm
        return np.concatenate([stations.ravel(), dead])

    def placed(self, tip_mm: FloatArray, placement: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """|tip - station| - dead length."""
        count = len(self.lengths.stations)
        station = self.lengths.station
        line = tip_mm[self.poses.of] - placement[: 3 * count].reshape(-1, 3)[station]
        distance = np.linalg.norm(line, axis=1)
        unit = line / distance[:, None]
        rows = np.arange(len(station))
        columns = np.zeros((len(station), len(placement)))
        for k in range(3):
            columns[rows, 3 * station + k] = -unit[:, k]
        columns[rows, 3 * count + self.group] = -1.0
        return distance - placement[3 * count + self.group], unit, columns

    def readings(self, tip_mm: FloatArray, placement: FloatArray) -> Readings:
        """Readings seen from the stations of the placement."""
        stations = placement[: 3 * len(self.lengths.stations)].reshape(-1, 3)
        return readings_of_lengths(self.machine, self.lengths, stations[self.lengths.station], tip_mm[self.poses.of])

    def part(self, rows: IntArray) -> ObservedLengths:
        """Return some of the lengths."""
        return ObservedLengths(self.machine, some_lengths(self.lengths, rows))


def some_lengths(lengths: Lengths, rows: IntArray) -> Lengths:
    """Return the readings ``rows`` of lengths; all stations keep their number."""
    return replace(
        lengths,
        station=lengths.station[rows],
        point=[lengths.point[k] for k in rows],
        position_mm=lengths.position_mm[rows],
        length_mm=lengths.length_mm[rows],
        tool_mm=None if lengths.tool_mm is None else lengths.tool_mm[rows],
        approach=None if lengths.approach is None else lengths.approach[rows],
        labels={name: values[rows] for name, values in lengths.labels.items()},
        covariates={name: values[rows] for name, values in lengths.covariates.items()},
        origin=[lengths.origin[k] for k in rows] if len(lengths.origin) else (),
    )


class ObservedDeviations(Observed):
    """Measured deviations: the placement of their frame, three shifts (mm) and three turns (rad), is unknown."""

    def __init__(self, machine: Machine, deviations: Deviations, rows: IntArray | None = None) -> None:
        self.machine, self.deviations = machine, deviations
        whole = readings_of_deviations(machine, deviations)
        measured = ~np.isnan(deviations.deviation_mm)
        position = np.concatenate([np.flatnonzero(measured[:, k]) for k in range(3)])
        component = np.repeat(np.arange(3), measured.sum(axis=0))
        self.rows = np.arange(len(whole)) if rows is None else rows
        self._whole = whole
        self.value_mm = deviations.deviation_mm[position, component][self.rows]
        self.component, self.place = component[self.rows], position[self.rows]
        reads = self._readings()
        self.poses = poses_of(reads.position_mm, reads.tool_mm)
        _, stop = np.unique(self.place, return_inverse=True)
        self.layout = layout_of(reads, self.component, stop.ravel().astype(np.int64))
        self.placement_names = tuple(f"placement {what}" for what in ("x", "y", "z", "a", "b", "c"))

    def _readings(self) -> Readings:
        whole, rows = self._whole, self.rows
        return replace(
            whole,
            position_mm=whole.position_mm[rows],
            direction=whole.direction[rows],
            tool_mm=whole.tool_mm[rows],
            station=whole.station[rows],
            range_mm=whole.range_mm[rows],
            approach=None if whole.approach is None else whole.approach[rows],
            covariates={name: values[rows] for name, values in whole.covariates.items()},
            labels={name: values[rows] for name, values in whole.labels.items()},
        )

    def start(self) -> FloatArray:
        """No shift and no turn."""
        return np.zeros(6)

    def placed(self, tip_mm: FloatArray, placement: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Component of tip - nominal, shifted and turned (to first order) with the frame."""
        nominal = self.poses.position_mm + self.poses.tool_mm
        moved = tip_mm - nominal + placement[:3] + np.cross(placement[3:], nominal)
        unit = np.eye(3)[self.component]
        columns = np.hstack([unit, np.cross(nominal[self.poses.of], unit)])
        return moved[self.poses.of, self.component], unit, columns

    def readings(self, tip_mm: FloatArray, placement: FloatArray) -> Readings:
        """The components as readings along the axes."""
        return self._readings()

    def part(self, rows: IntArray) -> ObservedDeviations:
        """Return some of the components."""
        return ObservedDeviations(self.machine, self.deviations, self.rows[rows])
