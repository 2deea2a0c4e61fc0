"""The least-squares problems with the exact machine model, lengths and positions, and their normal equations."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.identification.adjust.unknowns import (
    ErrorParameters,
    IntArray,
    KnownPositions,
    State,
    dead_lengths_of,
    distinct_poses,
)
from compgen.kinematics.exact_chain import cross_matrices, exact_columns, level_rotations, tip_position
from compgen.kinematics.first_order import c_matrix, tool_of

# Normal equations point by point, for lengths, positions, and networks of distances alike.
#
# A reading depends on one point p, which moves by dx, and on the unknowns q of the instrument:
#
#     r = r0 + u . dx + a . dq        minimise sum of w r^2
#
# Five sums are enough, whatever the number of readings: U = sum w u u^T and K = sum w u a^T of each point, and N = sum
# w a a^T; f = sum w r0 u of each point, and g = sum w r0 a. If the points move with the errors P of the machine, dx = D
# dP, the normal equations are
#
#     | sum D^T U D   sum D^T K |          | sum D^T f |
#     | sum K^T D         N     |   and    |     g     |
#
# If every point is unknown (self-calibration), the points are eliminated: N - sum K^T U^-1 K.


@dataclass(frozen=True)
class PointEquations:
    """The five sums, of m points and q unknowns of the instrument.

    Parameters
    ----------
    information, coupling, force : U (m, 3, 3), K (m, 3, q) and f (m, 3).
    own, own_force : N (q, q) and g (q,).
    """

    information: FloatArray
    coupling: FloatArray
    force: FloatArray
    own: FloatArray
    own_force: FloatArray

    def add_to(self, design: FloatArray, matrix: FloatArray, gradient: FloatArray) -> None:
        """Add the normal matrix (k + q, k + q) and the gradient (k + q,) for points that move by ``design`` D (m, 3, k)."""
        count = design.shape[2]
        flat = design.reshape(-1, count)
        matrix[:count, :count] += flat.T @ (self.information @ design).reshape(flat.shape)
        cross = flat.T @ self.coupling.reshape(len(flat), -1)
        matrix[:count, count:] += cross
        matrix[count:, :count] += cross.T
        matrix[count:, count:] += self.own
        self.add_gradient(design, gradient)

    def add_gradient(self, design: FloatArray, gradient: FloatArray) -> None:
        """Add only the gradient."""
        count = design.shape[2]
        gradient[:count] += design.reshape(-1, count).T @ self.force.ravel()
        gradient[count:] += self.own_force

    def of(self, columns: IntArray) -> PointEquations:
        """Return the equations of some of the instrument's unknowns; the others are fixed."""
        own = self.own[np.ix_(columns, columns)]
        return PointEquations(self.information, self.coupling[:, :, columns], self.force, own, self.own_force[columns])


def summed(values: FloatArray, index: IntArray, count: int) -> FloatArray:
    """Sum values (n, ...) with the same index (n,) below ``count``: shape (count, ...)."""
    flat = values.reshape(len(values), -1)
    sums = [np.bincount(index, flat[:, k], count) for k in range(flat.shape[1])]
    return np.stack(sums, axis=1).astype(np.float64, copy=False).reshape(count, *values.shape[1:])


@dataclass(frozen=True)
class LinesOfSight:
    """n readings along lines of sight: point, station and dead length of each, with their numbers in all.

    ``point``, ``station``, ``group`` (n,) are indices below ``counts``.
    """

    point: IntArray
    station: IntArray
    group: IntArray
    counts: tuple[int, int, int]

    def equations(self, unit: FloatArray, weight: FloatArray, residual: FloatArray) -> PointEquations:
        """Return the sums for unit vectors (n, 3) from station to point, weights (n,) and model minus reading (n,).

        A point adds u to the derivative of a reading, its station -u, its dead length -1.
        """
        points, stations, groups = self.counts
        along = weight[:, None] * unit
        outer = along[:, :, None] * unit[:, None, :]
        pulled = residual[:, None] * along
        by_station = summed(outer, self.point * stations + self.station, points * stations)
        by_station = by_station.reshape(points, stations, 3, 3)
        by_group = summed(along, self.point * groups + self.group, points * groups).reshape(points, groups, 3)
        own = np.zeros((3 * stations + groups, 3 * stations + groups))
        for k, block in enumerate(by_station.sum(axis=0)):
            own[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
        cross = summed(along, self.station * groups + self.group, stations * groups).reshape(stations, groups, 3)
        own[: 3 * stations, 3 * stations :] = cross.transpose(0, 2, 1).reshape(-1, groups)
        own[3 * stations :, : 3 * stations] = own[: 3 * stations, 3 * stations :].T
        dead = np.arange(3 * stations, len(own))
        own[dead, dead] = np.bincount(self.group, weight, groups)
        by_places = by_station.transpose(0, 2, 1, 3).reshape(points, 3, -1)
        return PointEquations(
            information=by_station.sum(axis=1),
            coupling=-np.concatenate([by_places, by_group.transpose(0, 2, 1)], axis=2),
            force=summed(pulled, self.point, points),
            own=own,
            own_force=-np.concatenate(
                [summed(pulled, self.station, stations).ravel(), np.bincount(self.group, weight * residual, groups)]
            ),
        )


# Common part of problems at poses of the machine: tips and their derivatives, in chunks of constant memory.


CHUNK_POSES = 2048


@dataclass(frozen=True)
class MachinePoses:
    """The unknown errors and m poses of the machine: positions, tools (m, 3), and the curve bases there."""

    parameters: ErrorParameters
    bases: tuple[FloatArray, FloatArray, FloatArray]
    position_mm: FloatArray
    tool_mm: FloatArray

    def tip_mm(self, state: State) -> FloatArray:
        """Tips of the model in the machine frame, (m, 3)."""
        values = self.parameters.values(state.errors, self.bases)
        return tip_position(self.parameters.machine, values, self.position_mm, self.tool_mm)

    def chunks(self, state: State) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """MachinePoses, tips (p, 3) and derivatives of the tips by the unknown errors (p, 3, size)."""
        for rows, tip, columns, bases in self.columns(state):
            yield rows, tip, self.parameters.design(columns, bases)

    def columns(self, state: State) -> Iterator[tuple[slice, FloatArray, FloatArray, list[FloatArray]]]:
        """MachinePoses, tips (p, 3), derivatives of the tips by the 21 errors (p, 3, 21), and the curve bases there."""
        machine = self.parameters.machine
        for first in range(0, len(self.position_mm), CHUNK_POSES):
            rows = slice(first, first + CHUNK_POSES)
            bases = [basis[rows] for basis in self.bases]
            poses = self.position_mm[rows], self.tool_mm[rows]
            if state.errors.any():
                tip, columns = exact_columns(machine, self.parameters.values(state.errors, bases), *poses)
            else:  # the start of most adjustments: the tip is where it should be, and the derivatives are C
                tip, columns = poses[0] + poses[1], c_matrix(machine, *poses)
            yield rows, tip, columns, bases


# The least-squares problem of the tracer lengths (Zha & Zhang 2024, eq. 22) with the exact machine model:
#
#     reading = |tip - station| - dead length


@dataclass(frozen=True)
class LengthProblem(MachinePoses):
    """Readings by pose and station; n readings, m poses (distinct positions with distinct tools).

    Parameters
    ----------
    parameters, position_mm, tool_mm, bases : as for :class:`MachinePoses`.
    pose, station, group : index of pose, station and dead length of each reading, each (n,).
    length_mm : readings, (n,).
    weight : 1/variance of each reading in 1/mm^2, zero for a rejected one, (n,).
    known : stations whose coordinates were also observed.
    numbers : of stations and dead lengths, if these readings are only a part.
    """

    pose: IntArray
    station: IntArray
    group: IntArray
    length_mm: FloatArray
    weight: FloatArray
    known: KnownPositions | None = None
    numbers: tuple[int, int] | None = None

    @property
    def stations(self) -> int:
        """Number of stations."""
        return self.numbers[0] if self.numbers else int(self.station.max()) + 1

    @property
    def groups(self) -> int:
        """Number of dead lengths: one for every station and set-up."""
        return self.numbers[1] if self.numbers else int(self.group.max()) + 1

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.parameters.size + 3 * self.stations + self.groups

    def weighted(self, weight: FloatArray) -> LengthProblem:
        """Return the same problem with other weights."""
        return replace(self, weight=weight)

    def residuals(self, state: State) -> FloatArray:
        """Model minus reading, shape (n,), mm."""
        return np.asarray(self.distances(state) - state.dead_length_mm[self.group] - self.length_mm)

    def distances(self, state: State) -> FloatArray:
        """Distance from the station of every reading, shape (n,), mm."""
        sight = self.tip_mm(state)[self.pose] - state.stations_mm[self.station]
        return np.asarray(np.linalg.norm(sight, axis=1))

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares, and its gradient (size,)."""
        cost, gradient = 0.5 * float(np.dot(self.weight, self.residuals(state) ** 2)), np.zeros(self.size)
        for equations, design in self._equations(state):
            equations.add_gradient(design, gradient)
        return cost + (self.known.add_gradient(state, gradient) if self.known else 0.0), gradient

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size) with the exact derivative at ``state``."""
        matrix, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        for equations, design in self._equations(state):
            equations.add_to(design, matrix, gradient)
        if self.known:
            self.known.add_weight(state, matrix)
        return matrix

    def _equations(self, state: State) -> Iterator[tuple[PointEquations, FloatArray]]:
        order = np.argsort(self.pose, kind="stable")
        sorted_pose = self.pose[order]
        for poses, tip, design in self.chunks(state):
            rows = order[slice(*np.searchsorted(sorted_pose, [poses.start, poses.stop]).tolist())]
            local, station, group = self.pose[rows] - poses.start, self.station[rows], self.group[rows]
            sight = tip[local] - state.stations_mm[station]
            distance = np.linalg.norm(sight, axis=1)
            residual = distance - state.dead_length_mm[group] - self.length_mm[rows]
            sights = LinesOfSight(local, station, group, (len(tip), self.stations, self.groups))
            yield sights.equations(sight / distance[:, None], self.weight[rows], residual), design


def length_problem(
    machine: Machine, lengths: Lengths, parameters: ErrorParameters, group: IntArray | None = None
) -> LengthProblem:
    """Sort the readings by pose, station and dead length; all weights 1.

    ``group`` is the index of the dead length of each reading (n,), by default one for every station and set-up.
    """
    poses = distinct_poses(lengths.position_mm, tool_of(machine, lengths.tool_mm))
    return LengthProblem(
        parameters=parameters,
        position_mm=poses.position_mm,
        tool_mm=poses.tool_mm,
        bases=parameters.bases(poses.position_mm),
        pose=poses.of,
        station=lengths.station,
        group=dead_lengths_of(lengths) if group is None else group,
        length_mm=lengths.length_mm,
        weight=np.ones(len(lengths)),
    )


# Errors from measured positions (Zha & Zhang 2024, eq. 21-28, with positions instead of lengths) and the exact model.
#
# Residual of pose j: measured position, already close to the machine frame, and tip of the model:
#
#     r_j = R(-w) (tip(q_j; P) - c - t) + c - m_j - L_j b
#
# Unknown are the errors P, the rigid placement (t, w) of the measured frame about the centre c, and, for positions
# located by tracers, the errors b of their stations and dead lengths, which move every point by L_j b. The minimum is
# of
#
#     sum of r_j^T U_j r_j + b^T B b
#
# U_j is the information of the point with the stations fixed, B that of the stations from their self-calibration. So
# the correlation between the points is fully taken into account, and nothing larger than the unknowns is inverted.


#: The unknown rotation of the frame is expressed in mm at this lever, like angles in the solver.
LEVER_MM = 1000.0


@dataclass(frozen=True)
class SeparationProblem(MachinePoses):
    """Positions measured at m poses; it has the interface of :class:`compgen.identification.adjust.unknowns.LeastSquaresProblem`.

    In the state, ``stations_mm`` (2, 3) holds translation and rotation vector (times 1000 mm) of the frame, and
    ``dead_length_mm`` (q,) the errors b of the stations; q may be 0.

    Parameters
    ----------
    parameters, position_mm, tool_mm, bases : as for :class:`MachinePoses`.
    measured_mm : measured tip positions (m, 3), roughly placed.
    information : U_j, (m, 3, 3), 1/mm^2; zero in the directions that were not measured.
    lever, station_information : L_j (m, 3, q) and B (q, q).
    """

    measured_mm: FloatArray
    information: FloatArray
    lever: FloatArray
    station_information: FloatArray

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.parameters.size + 6 + len(self.station_information)

    @property
    def start(self) -> State:
        """All unknowns zero."""
        return State(np.zeros(self.parameters.size), np.zeros((2, 3)), np.zeros(len(self.station_information)))

    @property
    def centre_mm(self) -> FloatArray:
        """Centre of the rotation of the frame, (3,)."""
        return np.asarray(self.measured_mm.mean(axis=0))

    def weighted(self, weight: FloatArray) -> SeparationProblem:
        """Return the same problem with the information of each component (3 m,) multiplied by a weight."""
        root = np.sqrt(weight).reshape(-1, 3)
        return replace(self, information=root[:, :, None] * self.information * root[:, None, :])

    def residuals(self, state: State) -> FloatArray:
        """Model minus measured, components of each point one after another, (3 m,), mm."""
        everything = slice(None)
        return self._rest(state, everything, self._seen(state, self.tip_mm(state))).ravel()

    def _seen(self, state: State, tip_mm: FloatArray) -> FloatArray:
        """Tips as vectors from the centre in the measured frame, (m, 3)."""
        return np.asarray((tip_mm - self.centre_mm - state.stations_mm[0]) @ frame_rotation(-state.stations_mm[1])[0].T)

    def _rest(self, state: State, rows: slice, seen: FloatArray) -> FloatArray:
        return seen + self.centre_mm - self.measured_mm[rows] - self.lever[rows] @ state.dead_length_mm

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares, and its exact gradient (size,)."""
        own = self.station_information @ state.dead_length_mm
        squares, gradient, size = state.dead_length_mm @ own, np.zeros(self.size), self.parameters.size
        back, _ = frame_rotation(-state.stations_mm[1])
        for rows, tip, columns, bases in self.columns(state):
            by_own, rest, pull = self._pulled(state, rows, tip)
            squares += np.vdot(rest, pull)
            gradient[:size] += self.parameters.pulled(columns, bases, pull @ back)
            gradient[size:] += np.einsum("miq,mi->q", by_own, pull)
        gradient[size + 6 :] += own
        return 0.5 * float(squares), gradient

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size) with the exact derivative at ``state``."""
        matrix, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        for equations, design in self._equations(state):
            equations.add_to(design, matrix, gradient)
        own = slice(self.parameters.size + 6, None)
        matrix[own, own] += self.station_information
        return matrix

    def _equations(self, state: State) -> Iterator[tuple[PointEquations, FloatArray]]:
        """Return the five sums: derivatives of r_j by its tip R(-w), by shift and rotation of the placement, by stations -L_j."""
        back, _ = frame_rotation(-state.stations_mm[1])
        for rows, tip, design in self.chunks(state):
            by_own, _, pull = self._pulled(state, rows, tip)
            weighted = self.information[rows] @ by_own
            size = by_own.shape[2]
            yield (
                PointEquations(
                    information=back.T @ self.information[rows] @ back,
                    coupling=back.T @ weighted,
                    force=pull @ back,
                    own=by_own.reshape(-1, size).T @ weighted.reshape(-1, size),
                    own_force=np.einsum("miq,mi->q", by_own, pull),
                ),
                design,
            )

    def _pulled(self, state: State, rows: slice, tip_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives of r_j by placement and stations (p, 3, 6 + q), r_j and U_j r_j (p, 3) of some points."""
        back, jacobian = frame_rotation(-state.stations_mm[1])
        seen = self._seen(state, tip_mm)
        turn = cross_matrices(seen) @ jacobian / LEVER_MM
        by_own = np.concatenate([np.broadcast_to(-back, turn.shape), turn, -self.lever[rows]], axis=2)
        rest = self._rest(state, rows, seen)
        return by_own, rest, np.einsum("mij,mj->mi", self.information[rows], rest)

    def unknown_names(self, station_unknowns: tuple[str, ...] = ()) -> list[str]:
        """Names of all unknowns for messages; ``station_unknowns`` (q,) names b."""
        names = []
        for curve in self.parameters.curves:
            strongest = [int(np.argmax(np.abs(column))) for column in curve.free.T]
            names += [f"{curve.error.name} at {curve.nodes_mm[k]:g} mm" for k in strongest]
        placement = [f"{what}-{axis} of the frame" for what in ("shift", "rotation") for axis in "xyz"]
        return [*names, *self.parameters.squareness, *placement, *station_unknowns]


def frame_rotation(vector_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation matrix and left Jacobian of SO(3), each (3, 3), of a rotation vector (3,) in mm at 1000 mm."""
    rotation, jacobian = level_rotations(vector_mm[None] / LEVER_MM)
    return rotation[0], jacobian[0]
