"""Axis lists of the TwinCAT CNC (TF5200): leadscrew, cross and plane tables as the control keeps them, and their lookup.

Numbers stay in the unit of the files, 0.1 um (``unit 1``). Source: Beckhoff TF5200 "Axis compensation" (308687883,
308709003, 15327290891) and its parameters P-COMP-00004 ... P-COMP-00033.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgen.controllers.base import Usage
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine

#: 0.1 um in mm.
MM_PER_UNIT = 1e-4


@dataclass(frozen=True)
class Screw:
    """``kw.ssfk``: values over the axis' own position, ``neg`` for negative travel (None: one table for both).

    ``setpoints`` (n,) ascend; ``interval`` is their distance, or 0 if each stands in the file. All in 0.1 um.
    """

    setpoints: FloatArray
    pos: FloatArray
    neg: FloatArray | None = None
    interval: float = 0.0

    def at(self, along: FloatArray, direction: FloatArray) -> FloatArray:
        """Value at positions (n,) reached in directions (n,) (+1, -1, 0: unknown, the mean), end values held outside."""
        pos = np.interp(along, self.setpoints, self.pos)
        if self.neg is None:
            return pos
        neg = np.interp(along, self.setpoints, self.neg)
        return np.asarray(0.5 * (pos + neg) + 0.5 * np.sign(direction) * (pos - neg))


@dataclass(frozen=True)
class Cross:
    """``kw.crosscomp`` of a slave axis: values over the command position of axis ``master`` (0..2), in 0.1 um."""

    master: int
    setpoints: FloatArray
    values: FloatArray

    def at(self, along: FloatArray) -> FloatArray:
        """Value at positions (n,), end values held outside."""
        return np.interp(along, self.setpoints, self.values)


@dataclass(frozen=True)
class Plane:
    """``kw.crosscomp2`` of a slave axis: values [j, i] with i along ``masters[0]`` and j along ``masters[1]``, 0.1 um.

    ``starts`` are the positions of i = 0 and j = 0; both axes have the distance ``interval``.
    """

    masters: tuple[int, int]
    starts: tuple[float, float]
    interval: float
    values: FloatArray

    def nodes(self, place: int) -> FloatArray:
        """Positions of the columns (``place`` 0: first master) or rows (1: second master), 0.1 um."""
        return np.asarray(
            self.starts[place] + self.interval * np.arange(self.values.shape[1 - place]), dtype=np.float64
        )

    def at(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Value at positions (n,) of both masters: bilinear between four corners, values of the margin held outside."""
        (i, u), (j, v) = (
            _cell(along, start, self.interval, count)
            for along, start, count in zip((first, second), self.starts, self.values.shape[::-1], strict=True)
        )
        i_next, j_next = np.minimum(i + 1, self.values.shape[1] - 1), np.minimum(j + 1, self.values.shape[0] - 1)
        low = (1.0 - u) * self.values[j, i] + u * self.values[j, i_next]
        high = (1.0 - u) * self.values[j_next, i] + u * self.values[j_next, i_next]
        return np.asarray((1.0 - v) * low + v * high)


def _cell(along: FloatArray, start: float, interval: float, count: int) -> tuple[np.ndarray, FloatArray]:
    ratio = np.clip((along - start) / interval, 0.0, count - 1)
    cell = np.minimum(ratio.astype(np.intp), max(count - 2, 0))
    return cell, ratio - cell


@dataclass(frozen=True)
class AxisList:
    """The tables in the list of one axis, which is the slave of ``cross`` and ``plane``."""

    screw: Screw | None = None
    cross: Cross | None = None
    plane: Plane | None = None


@dataclass(frozen=True)
class TwincatTables:
    """The lists of the axes 0..2."""

    lists: Mapping[int, AxisList]


@dataclass(frozen=True)
class Most:
    """Largest number of points of each kind of table."""

    ssfk: int
    crosscomp: int
    crosscomp2: int


def list_usage(name: str, item: AxisList, most: Most) -> list[Usage]:
    """Return the points of one list (``name``: the axis) against what the control takes."""
    counts = (
        ("ssfk", item.screw and len(item.screw.setpoints), most.ssfk),
        ("crosscomp", item.cross and len(item.cross.setpoints), most.crosscomp),
        ("crosscomp2", item.plane and item.plane.values.size, most.crosscomp2),
    )
    return [Usage(f"points of kw.{kind} of {name}", used, allowed, "points") for kind, used, allowed in counts if used]


def spans_mm(item: AxisList, axis: int) -> list[tuple[str, int, FloatArray]]:
    """Return (structure, axis of the argument, its positions in mm) of every table in the list of ``axis``."""
    found: list[tuple[str, int, FloatArray]] = []
    if item.screw is not None:
        found.append(("kw.ssfk", axis, item.screw.setpoints * MM_PER_UNIT))
    if item.cross is not None:
        found.append(("kw.crosscomp", item.cross.master, item.cross.setpoints * MM_PER_UNIT))
    if item.plane is not None:
        found += [
            ("kw.crosscomp2", master, item.plane.nodes(place) * MM_PER_UNIT)
            for place, master in enumerate(item.plane.masters)
        ]
    return found


def stored_sums(item: AxisList, axis: int, position_mm: FloatArray, approach: FloatArray) -> tuple[FloatArray, ...]:
    """Return what ``ssfk`` and what the cross and plane tables of an axis hold at positions (n, 3), each (n,), mm."""
    along = np.asarray(position_mm) / MM_PER_UNIT
    screw, cross = np.zeros(len(along)), np.zeros(len(along))
    if item.screw is not None:
        screw = item.screw.at(along[:, axis], approach[:, axis])
    if item.cross is not None:
        cross = cross + item.cross.at(along[:, item.cross.master])
    if item.plane is not None:
        first, second = item.plane.masters
        cross = cross + item.plane.at(along[:, first], along[:, second])
    return screw * MM_PER_UNIT, cross * MM_PER_UNIT


def units_outwards(machine: Machine, axis: int, positions_mm: FloatArray) -> FloatArray:
    """Return positions (n,) in whole units of 0.1 um that still cover the travel where they did."""
    low, high = (end / MM_PER_UNIT for end in machine.axes[axis].range_mm)
    units = np.rint(positions_mm / MM_PER_UNIT)
    units[0] = min(units[0], np.floor(low + 1e-3)) if positions_mm[0] <= machine.axes[axis].range_mm[0] else units[0]
    units[-1] = (
        max(units[-1], np.ceil(high - 1e-3)) if positions_mm[-1] >= machine.axes[axis].range_mm[1] else units[-1]
    )
    return np.unique(units)
