"""One form for all kinds of measurement: scalar readings, the unknowns that place them, and their derivative."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np

from compgen.data.axis_runs import AxisRuns, read_axis_runs
from compgen.data.circles import Circles, read_circles
from compgen.data.comparison import rigid_fields
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact, Deviations, read_artefacts, read_deviations, read_parts
from compgen.data.lengths import Lengths, read_lengths
from compgen.data.machine import Machine
from compgen.data.records import detect_format
from compgen.diagnose.layout import IntArray, MeasurementLayout, layout_of
from compgen.effects import Readings, readings_of_deviations, readings_of_lengths
from compgen.errors import InputError
from compgen.identification.adjust.starts import StationStart, station_start
from compgen.identification.adjust.unknowns import DistinctPoses, dead_lengths_of, distinct_poses
from compgen.kinematics.first_order import tool_of

# Start values of a station in closed form, refined on the distances; no search, so gross errors show immediately.


REFINEMENTS = 4
LEAST_SHARE = 1e-9


def located(
    target_mm: FloatArray, length_mm: FloatArray, group: IntArray, groups: int
) -> tuple[StationStart, FloatArray]:
    """Position and dead lengths of a station, and the residuals of its readings, (n,).

    |P|^2 - L^2 = 2 P.s + 2 l L - (|s|^2 - l^2), linear in s, l and a constant for each set-up.
    """
    centre = target_mm.mean(axis=0)
    scale = max(float(np.abs(target_mm - centre).max()), 1.0)
    p, offset = (target_mm - centre) / scale, float(length_mm.mean())
    reading = (length_mm - offset) / scale
    member = (group[:, None] == np.arange(groups)).astype(np.float64)
    design = np.hstack([2 * p, 2 * reading[:, None] * member, member])
    target = np.einsum("ij,ij->i", p, p) - reading**2
    solution, _, rank, _ = np.linalg.lstsq(design, target, rcond=LEAST_SHARE)
    if rank < design.shape[1]:
        found = station_start(target_mm, length_mm, group, groups)
    else:
        found = StationStart(solution[:3] * scale + centre, solution[3 : 3 + groups] * scale - offset)
    return _refined(target_mm, length_mm, group, member, found)


def _refined(
    target_mm: FloatArray, length_mm: FloatArray, group: IntArray, member: FloatArray, start: StationStart
) -> tuple[StationStart, FloatArray]:
    best, residual = start, _residual(target_mm, length_mm, group, start)
    for _ in range(REFINEMENTS):
        line = target_mm - best.position_mm
        unit = line / np.maximum(np.linalg.norm(line, axis=1), 1e-9)[:, None]
        step = np.linalg.lstsq(np.hstack([-unit, -member]), residual, rcond=1e-9)[0]
        moved = StationStart(best.position_mm + step[:3], best.dead_length_mm + step[3:])
        new = _residual(target_mm, length_mm, group, moved)
        if not np.sum(new**2) < np.sum(residual**2):
            break
        best, residual = moved, new
    return best, residual


def _residual(target_mm: FloatArray, length_mm: FloatArray, group: IntArray, start: StationStart) -> FloatArray:
    distance = np.linalg.norm(target_mm - start.position_mm, axis=1)
    return np.asarray(length_mm - distance + start.dead_length_mm[group])


# One form for all kinds of measurement: scalar readings, the unknowns that place them, and their derivative.
#
# Reading = model(errors, placement) + effects + noise. Lengths are placed by stations and dead lengths, deviations by a
# rigid motion of their frame.


#: Positions in mm that agree to this many decimals are equal.
SAME_DIGITS = 7


class Observed(ABC):
    """A measurement as scalar readings ``value_mm`` (n,) with poses and layout."""

    machine: Machine
    value_mm: FloatArray
    poses: DistinctPoses
    layout: MeasurementLayout
    placement_names: tuple[str, ...]

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.value_mm)

    @abstractmethod
    def start(self) -> FloatArray:
        """Start values of the placement, (k,), mm and rad."""

    @abstractmethod
    def placed(self, tip_mm: FloatArray, placement: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predicted readings (n,), their directions (n, 3), derivative by the placement (n, k); tips (m, 3)."""

    @abstractmethod
    def readings(self, tip_mm: FloatArray, placement: FloatArray) -> Readings:
        """The readings in the form that effects use."""

    def minus(self, change_mm: FloatArray) -> Self:
        """Return the same measurement with ``change_mm`` (n,) subtracted from its readings."""
        changed = copy.copy(self)
        changed.value_mm = self.value_mm - change_mm
        return changed

    @abstractmethod
    def part(self, rows: IntArray) -> Observed:
        """Return some of the readings."""


class ObservedLengths(Observed):
    """Tracer lengths: unknown stations, and a dead length per station and set-up."""

    def __init__(self, machine: Machine, lengths: Lengths) -> None:
        self.machine, self.lengths = machine, lengths
        self.value_mm = lengths.length_mm
        tool_mm = tool_of(machine, lengths.tool_mm)
        self.poses = distinct_poses(lengths.position_mm.round(SAME_DIGITS), tool_mm.round(SAME_DIGITS))
        self.group = dead_lengths_of(lengths)
        names = [f"station {name} {axis}" for name in lengths.stations for axis in "xyz"]
        setup = lengths.labels.get("setup")
        for group in range(int(self.group.max()) + 1):
            row = int(np.argmax(self.group == group))
            where = "" if setup is None else f" in set-up {setup[row]}"
            names.append(f"dead length of {lengths.stations[lengths.station[row]]}{where}")
        self.placement_names = tuple(names)
        # Readings without meaningful directions and ranges: enough for the layout.
        far = self.lengths.position_mm.mean(axis=0) + np.array([0.0, 0.0, 1e5])
        tips = self.lengths.position_mm
        self.layout = layout_of(
            readings_of_lengths(self.machine, self.lengths, np.broadcast_to(far, tips.shape), tips), lengths.station
        )

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
        return ObservedLengths(self.machine, self.lengths.part(rows))


class ObservedDeviations(Observed):
    """Measured deviations: the placement of their frame, three shifts (mm) and three rotations (rad), is unknown."""

    def __init__(self, machine: Machine, deviations: Deviations, rows: IntArray | None = None) -> None:
        self.machine, self.deviations = machine, deviations
        whole = readings_of_deviations(machine, deviations)
        measured = ~np.isnan(deviations.deviation_mm)
        position = np.concatenate([np.flatnonzero(measured[:, k]) for k in range(3)])
        component = np.repeat(np.arange(3), measured.sum(axis=0))
        self.rows = np.arange(len(whole)) if rows is None else rows
        self.value_mm = deviations.deviation_mm[position, component][self.rows]
        self.component, self.place = component[self.rows], position[self.rows]
        self._reads = reads = whole.part(self.rows)
        self.poses = distinct_poses(reads.position_mm.round(SAME_DIGITS), reads.tool_mm.round(SAME_DIGITS))
        _, stop = np.unique(self.place, return_inverse=True)
        self.layout = layout_of(reads, self.component, stop.ravel().astype(np.int64))
        self.placement_names = tuple(f"placement {what}" for what in ("x", "y", "z", "a", "b", "c"))

    def start(self) -> FloatArray:
        """No shift and no rotation."""
        return np.zeros(6)

    def placed(self, tip_mm: FloatArray, placement: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Component of tip - nominal, shifted and rotated (to first order) with the frame."""
        nominal = self.poses.position_mm + self.poses.tool_mm
        fields = rigid_fields(nominal).reshape(-1, 3, 6)
        moved = tip_mm - nominal + fields @ placement
        read = self.poses.of, self.component
        return moved[read], np.eye(3)[self.component], fields[read]

    def readings(self, tip_mm: FloatArray, placement: FloatArray) -> Readings:
        """The components as readings along the axes."""
        return self._reads

    def part(self, rows: IntArray) -> ObservedDeviations:
        """Return some of the components."""
        return ObservedDeviations(self.machine, self.deviations, self.rows[rows])


# Measurements that can be diagnosed, distinguished by the columns of their files.


Measurement = Lengths | Deviations | AxisRuns | Circles | Artefact


def read_diagnosed(paths: Sequence[str | Path]) -> Measurement:
    """Read measurement files of one kind: tracer lengths, deviations, axis runs, circles, parts or artefacts."""
    kinds = {path: _kind(path) for path in paths}
    if len(set(kinds.values())) > 1:
        odd = next(path for path, kind in kinds.items() if kind != kinds[paths[0]])
        message = f"contains {kinds[odd]}, but another file contains {kinds[paths[0]]}; diagnose them separately"
        raise InputError(message, file=odd)
    kind, files = kinds[paths[0]], list(paths)
    if kind == "axis runs":
        return read_axis_runs(files)
    if kind == "circles":
        return read_circles(files)
    if kind == "features of a part":
        return read_parts(files)
    if kind == "an artefact":
        return read_artefacts(files)
    return read_deviations(files) if kind == "deviations" else read_lengths(files)


def _kind(path: str | Path) -> str:
    kind = detect_format(path)
    if kind == "sixdof":
        message = (
            "contains six-DOF readings, which need the constants of their instrument; give --instrument FILE (TOML)"
        )
        raise InputError(message, file=path)
    if kind == "errors":
        known = "lengths, deviations, axis runs, circles, parts and artefacts"
        raise InputError(f"contains errors, which only identify can read; diagnose reads {known}", file=path)
    words = {"axis": "axis runs", "circle": "circles", "part": "features of a part", "artefact": "an artefact"}
    return {**words, "deviations": "deviations"}.get(str(kind), "lengths")
