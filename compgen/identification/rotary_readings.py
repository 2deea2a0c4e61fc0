"""Readings at poses as equations for the adjustment of rotary axes: spheres, bars, positions, tracer lengths.

Each kind says what a reading leaves when the tip is somewhere in the workpiece frame, and how that changes with the tip and
with its own further unknowns: the place of a sphere, the pose of a frame, the length of a bar, a station.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.pose_readings import Bars, PosedDeviations, PosedLengths
from compgen.data.rotary import TIP, RotaryErrors, SphereCentres
from compgen.errors import InputError, Message
from compgen.kinematics.exact_chain import cross_matrices
from compgen.kinematics.rotary_chain import joints_of_tip, tip_pose

#: A ball on a table is set up no worse than this, a bar of unknown length no farther from its nominal one, mm.
_BALL_MM, _LENGTH_MM = 5.0, 5.0
#: A commanded distance of two balls that differs more from the nominal length is another pose, sign or tool, mm.
_OTHER_MM = 10.0
#: Readings that the further unknowns of a set-up need at least.
_FEWEST = 4


@dataclass(frozen=True)
class PoseReadings(ABC):
    """Readings of one kind at n poses, m of them.

    Parameters
    ----------
    joint_mm, angle_deg, tool_mm : positions of the axes (n, 3), angles (n,) by letter, offsets of the tip (n, 3).
    of_pose : pose of each reading, (m,).
    u_mm : standard uncertainty of each reading (m,); nan where it is not stated.
    """

    joint_mm: FloatArray
    angle_deg: Mapping[str, FloatArray]
    tool_mm: FloatArray
    of_pose: NDArray[np.int64]
    u_mm: FloatArray

    #: What the readings are, in words.
    what = "readings"

    @property
    @abstractmethod
    def sizes(self) -> FloatArray:
        """Standard deviations of the further unknowns (q,) before the measurement; inf for what is free."""

    @abstractmethod
    def start(self, tip_mm: FloatArray) -> FloatArray:
        """The further unknowns (q,) for the nominal tips (n, 3)."""

    @abstractmethod
    def residual(self, tip_mm: FloatArray, others: FloatArray) -> FloatArray:
        """Model minus reading (m,), mm, for tips (n, 3) in the workpiece frame."""

    @abstractmethod
    def slopes(self, tip_mm: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the residuals by the tip of their pose (m, 3), and by the further unknowns (m, q)."""

    def nominal_tips(self, machine: Machine) -> FloatArray:
        """Tips (n, 3) of the machine without errors."""
        return tip_pose(machine, ErrorTable(), RotaryErrors(), self.joint_mm, self.angle_deg, self.tool_mm)[0]


def _joints(machine: Machine, readings: SphereCentres | Bars | PosedDeviations | PosedLengths) -> FloatArray:
    """Positions of the axes at the poses, (n, 3)."""
    if readings.coordinates == TIP:
        return joints_of_tip(machine, readings.found_mm, readings.angle_deg, readings.tool_mm)
    return readings.found_mm


@dataclass(frozen=True)
class SpheresAt(PoseReadings):
    """The tip, less what an R-test read, is where its sphere is; each sphere and set-up has a place of its own."""

    deviation_mm: FloatArray
    place: NDArray[np.int64]

    what = "spheres"

    @classmethod
    def of(cls, machine: Machine, spheres: SphereCentres) -> SpheresAt:
        """The equations of sphere centres."""
        n = len(spheres)
        return cls(
            _joints(machine, spheres),
            spheres.angle_deg,
            spheres.tool_mm,
            np.repeat(np.arange(n), 3),
            np.repeat(spheres.u_mm, 3),
            np.nan_to_num(spheres.deviation_mm),
            spheres.places[0],
        )

    @property
    def sizes(self) -> FloatArray:
        """Places are free."""
        return np.full(3 * (int(self.place.max()) + 1), np.inf)

    def start(self, tip_mm: FloatArray) -> FloatArray:
        """The mean of the tips of each place."""
        at = tip_mm - self.deviation_mm
        return np.concatenate([at[self.place == k].mean(axis=0) for k in range(len(self.sizes) // 3)])

    def residual(self, tip_mm: FloatArray, others: FloatArray) -> FloatArray:
        """Tip minus sphere."""
        return np.asarray((tip_mm - self.deviation_mm - others.reshape(-1, 3)[self.place]).ravel())

    def slopes(self, tip_mm: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Unit vectors."""
        return np.tile(np.eye(3), (len(tip_mm), 1)), -self._pick

    @cached_property
    def _pick(self) -> FloatArray:
        pick = np.eye(len(self.sizes) // 3)[self.place]
        return np.asarray(np.einsum("nm,ij->nimj", pick, np.eye(3)).reshape(3 * len(self.place), len(self.sizes)))


@dataclass(frozen=True)
class BarsAt(PoseReadings):
    """The distance of tip and ball is the length of the bar; ball and length are not where and what they are said to be."""

    ball_mm: FloatArray
    length_mm: FloatArray
    setup: NDArray[np.int64]
    u_nominal_mm: float | None

    what = "bars"

    @classmethod
    def of(cls, machine: Machine, bars: Bars) -> BarsAt:
        """The equations of bars; InputError for a commanded distance that is not that of the bar."""
        found = cls(
            _joints(machine, bars),
            bars.angle_deg,
            bars.tool_mm,
            np.arange(len(bars)),
            bars.u_mm,
            bars.ball_mm,
            bars.nominal_mm + bars.deviation_mm,
            np.unique(bars.setup, return_inverse=True)[1],
            bars.u_nominal_mm,
        )
        commanded = np.linalg.norm(found.nominal_tips(machine) - bars.ball_mm, axis=1)
        for row in np.flatnonzero(np.abs(commanded - bars.nominal_mm) > _OTHER_MM)[:1].tolist():
            file, line = bars.origin[row] if bars.origin else (None, None)
            raise InputError(
                Message(
                    "bar-length-at-pose",
                    "the commanded pose puts the balls {commanded:.3f} mm apart, and the bar is "
                    "{nominal_mm:g} mm long; check the ball (workpiece frame, all axes at zero), the "
                    "tool offset, '# coordinates' and the signs of the angles",
                    commanded=commanded[row],
                    nominal_mm=bars.nominal_mm[row],
                ),
                file=file,
                line=line,
                field="nominal_mm",
            )
        for k in range(int(found.setup.max()) + 1):
            if (found.setup == k).sum() < _FEWEST:
                raise InputError(
                    Message(
                        "setup-few-readings",
                        "a set-up has {setup} readings; at least {value} are needed",
                        setup=(found.setup == k).sum(),
                        value=_FEWEST,
                    ),
                    file=bars.where,
                )
        return found

    @property
    def sizes(self) -> FloatArray:
        """Of each set-up the place of the ball, and the length of the bar."""
        length = _LENGTH_MM if self.u_nominal_mm is None else self.u_nominal_mm
        return np.tile([_BALL_MM, _BALL_MM, _BALL_MM, length], int(self.setup.max()) + 1)

    def start(self, tip_mm: FloatArray) -> FloatArray:
        """As nominal."""
        return np.zeros(len(self.sizes))

    def _away(self, tip_mm: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        off = others.reshape(-1, 4)[self.setup]
        away = tip_mm - self.ball_mm - off[:, :3]
        return away, off[:, 3]

    def residual(self, tip_mm: FloatArray, others: FloatArray) -> FloatArray:
        """Distance of the balls minus length."""
        away, longer = self._away(tip_mm, others)
        return np.asarray(np.linalg.norm(away, axis=1) - self.length_mm - longer)

    def slopes(self, tip_mm: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The direction of the bar."""
        away, _ = self._away(tip_mm, others)
        along = away / np.linalg.norm(away, axis=1)[:, None]
        own = np.zeros((len(along), len(self.sizes) // 4, 4))
        own[np.arange(len(along)), self.setup] = np.hstack([-along, -np.ones((len(along), 1))])
        return along, own.reshape(len(along), -1)


@dataclass(frozen=True)
class DeviationsAt(PoseReadings):
    """Actual minus commanded tip, in a frame that each set-up places (three shifts and three turns of its own)."""

    nominal_mm: FloatArray
    deviation_mm: FloatArray
    setup: NDArray[np.int64]
    component: NDArray[np.int64]

    what = "positions"

    @classmethod
    def of(cls, machine: Machine, read: PosedDeviations) -> DeviationsAt:
        """The equations of positions that were measured with turned axes."""
        known = np.flatnonzero(~np.isnan(read.deviation_mm).ravel())
        joints = _joints(machine, read)
        nominal = tip_pose(machine, ErrorTable(), RotaryErrors(), joints, read.angle_deg, read.tool_mm)[0]
        setup = np.unique(read.setup, return_inverse=True)[1]
        u = read.u_mm[known // 3]
        return cls(
            joints,
            read.angle_deg,
            read.tool_mm,
            known // 3,
            u,
            nominal,
            np.nan_to_num(read.deviation_mm),
            setup,
            known % 3,
        )

    @property
    def sizes(self) -> FloatArray:
        """Frames are free; a turn is stated in mm at a metre."""
        return np.full(6 * (int(self.setup.max()) + 1), np.inf)

    def start(self, tip_mm: FloatArray) -> FloatArray:
        """Frames as commanded."""
        return np.zeros(len(self.sizes))

    def residual(self, tip_mm: FloatArray, others: FloatArray) -> FloatArray:
        """Tip minus commanded and measured one, of the components that were measured."""
        moved = self._frames @ others
        return np.asarray((tip_mm - self.nominal_mm - self.deviation_mm)[self.of_pose, self.component] - moved)

    @cached_property
    def _frames(self) -> FloatArray:
        n, count = len(self.nominal_mm), len(self.sizes) // 6
        rigid = np.concatenate([np.tile(np.eye(3), (n, 1, 1)), -cross_matrices(self.nominal_mm) * 1e-3], axis=2)
        found = np.zeros((n, 3, count, 6))
        found[np.arange(n), :, self.setup] = rigid
        return np.asarray(found.reshape(n, 3, -1)[self.of_pose, self.component])

    def slopes(self, tip_mm: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Unit vectors."""
        return np.eye(3)[self.component], -self._frames


@dataclass(frozen=True)
class LengthsAt(PoseReadings):
    """The distance of tip and station is the displacement and a constant of station and set-up."""

    length_mm: FloatArray
    station: NDArray[np.int64]
    group: NDArray[np.int64]
    names: tuple[str, ...]

    what = "lengths"

    @classmethod
    def of(cls, machine: Machine, read: PosedLengths) -> LengthsAt:
        """The equations of tracer lengths; InputError for a station with too few of them."""
        names, station = np.unique(np.array(read.station), return_inverse=True)
        pairs = [f"{one} {setup}" for one, setup in zip(read.station, read.setup.tolist(), strict=True)]
        group = np.unique(np.array(pairs), return_inverse=True)[1]
        for k, name in enumerate(names):
            if (station == k).sum() < 2 * _FEWEST:
                raise InputError(
                    Message(
                        "station-few-lengths",
                        "station {name} has {station} lengths; at least {value} are needed",
                        name=name,
                        station=(station == k).sum(),
                        value=2 * _FEWEST,
                    ),
                    file=read.where,
                )
        return cls(
            _joints(machine, read), read.angle_deg, read.tool_mm, np.arange(len(read)), read.u_mm, read.length_mm,
            station, group, tuple(names.tolist()),
        )  # fmt: skip

    @property
    def _stations(self) -> int:
        return int(self.station.max()) + 1

    @property
    def sizes(self) -> FloatArray:
        """Stations and constants are free."""
        return np.full(3 * self._stations + int(self.group.max()) + 1, np.inf)

    def start(self, tip_mm: FloatArray) -> FloatArray:
        """Each station by its equations of spheres, linear in it, its constants, and a further number."""
        places, dead = [], np.zeros(int(self.group.max()) + 1)
        for k in range(self._stations):
            own = self.station == k
            groups, of = np.unique(self.group[own], return_inverse=True)
            p, length = tip_mm[own], self.length_mm[own]
            # |p|^2 - length^2 = 2 p s + 2 length d - (|s|^2 - d^2)
            centre = p.mean(axis=0)
            q = p - centre
            columns = np.column_stack(
                [2.0 * q, 2.0 * length[:, None] * np.eye(len(groups))[of], -np.eye(len(groups))[of]]
            )
            solved = np.linalg.lstsq(columns, np.sum(q**2, axis=1) - length**2, rcond=1e-12)[0]
            places.append(solved[:3] + centre)
            dead[groups] = solved[3 : 3 + len(groups)]
        return np.concatenate([*places, dead])

    def _away(self, tip_mm: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        first = 3 * self._stations
        return tip_mm - others[:first].reshape(-1, 3)[self.station], others[first:][self.group]

    def residual(self, tip_mm: FloatArray, others: FloatArray) -> FloatArray:
        """Distance minus displacement and constant."""
        away, dead = self._away(tip_mm, others)
        return np.asarray(np.linalg.norm(away, axis=1) - self.length_mm - dead)

    def slopes(self, tip_mm: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The direction of the beam."""
        away, _ = self._away(tip_mm, others)
        along, count = away / np.linalg.norm(away, axis=1)[:, None], len(away)
        own = np.zeros((count, self._stations, 3))
        own[np.arange(count), self.station] = -along
        dead = np.zeros((count, len(others) - 3 * self._stations))
        dead[np.arange(count), self.group] = -1.0
        return along, np.hstack([own.reshape(count, -1), dead])


def readings_at(machine: Machine, read: SphereCentres | Bars | PosedDeviations | PosedLengths) -> PoseReadings:
    """The equations of readings of any kind."""
    if isinstance(read, SphereCentres):
        return SpheresAt.of(machine, read)
    if isinstance(read, Bars):
        return BarsAt.of(machine, read)
    if isinstance(read, PosedDeviations):
        return DeviationsAt.of(machine, read)
    return LengthsAt.of(machine, read)
