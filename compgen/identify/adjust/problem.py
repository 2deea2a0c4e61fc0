"""The least-squares problems with the exact machine model: tracer lengths (Zha & Zhang 2024, eq. 22) and measured positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import ERROR_INDEX
from compgen.identify.adjust.unknowns import ErrorParameters, IntArray, KnownPositions, State
from compgen.kinematics.exact_chain import cross_matrices, exact_columns, level_rotations, tip_position
from compgen.kinematics.first_order import tool_of

# The least-squares problem of the tracer lengths (Zha & Zhang 2024, eq. 22) with the exact machine model.
#
# Reading = |tip - station| - dead length. A row of the Jacobian is [u^T D B, -u^T, -1] with u the unit line of sight,
# D the derivative of the tip by the 21 errors and B the curve basis. The block of the errors depends on the stations
# only through G = sum over readings of w u u^T at a pose, so it is assembled per pose, whatever the number of readings.


CHUNK_POSES = 2048


@dataclass(frozen=True)
class LengthProblem:
    """Readings by pose and station; n readings, m poses (distinct positions with distinct tools).

    Parameters
    ----------
    parameters : the unknown errors.
    position_mm, tool_mm : poses, each (m, 3).
    pose, station, group : index of pose, station and dead length of each reading, each (n,).
    length_mm : readings, (n,).
    weight : 1/variance of each reading in 1/mm^2, zero for a rejected one, (n,).
    known : stations whose coordinates were observed as well.
    """

    parameters: ErrorParameters
    position_mm: FloatArray
    tool_mm: FloatArray
    pose: IntArray
    station: IntArray
    group: IntArray
    length_mm: FloatArray
    weight: FloatArray
    bases: tuple[FloatArray, FloatArray, FloatArray]
    known: KnownPositions | None = None

    @property
    def stations(self) -> int:
        """Number of stations."""
        return int(self.station.max()) + 1

    @property
    def groups(self) -> int:
        """Number of dead lengths: one for every station and set-up."""
        return int(self.group.max()) + 1

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.parameters.size + 3 * self.stations + self.groups

    def weighted(self, weight: FloatArray) -> LengthProblem:
        """Return the same problem with other weights."""
        return replace(self, weight=weight)

    def residuals(self, state: State) -> FloatArray:
        """Model minus reading, shape (n,), mm."""
        values = self.parameters.values(state.errors, self.bases)
        tip = tip_position(self.parameters.machine, values, self.position_mm, self.tool_mm)
        distance = np.linalg.norm(tip[self.pose] - state.stations_mm[self.station], axis=1)
        return np.asarray(distance - state.dead_length_mm[self.group] - self.length_mm)

    def distances(self, state: State) -> FloatArray:
        """Distance from the station of every reading, shape (n,), mm."""
        still = State(state.errors, state.stations_mm, np.zeros_like(state.dead_length_mm))
        return self.residuals(still) + self.length_mm

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares, and its gradient (size,)."""
        cost, gradient = 0.5 * float(np.dot(self.weight, self.residuals(state) ** 2)), self.normal_equations(state)[1]
        return cost + (self.known.add_gradient(state, gradient) if self.known else 0.0), gradient

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size) with the exact derivative at ``state``."""
        matrix, _ = self.normal_equations(state)
        if self.known:
            self.known.add_weight(state, matrix)
        return matrix

    def normal_equations(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Normal matrix J^T W J (size, size) and gradient J^T W r (size,) of the readings, derivative at ``state``."""
        matrix = np.zeros((self.size, self.size))
        gradient = np.zeros(self.size)
        order = np.argsort(self.pose, kind="stable")
        bounds = np.searchsorted(self.pose[order], np.arange(0, len(self.position_mm) + CHUNK_POSES, CHUNK_POSES))
        for chunk, (first, last) in enumerate(zip(bounds[:-1], bounds[1:], strict=True)):
            poses = slice(chunk * CHUNK_POSES, (chunk + 1) * CHUNK_POSES)
            self._add_chunk(matrix, gradient, state, poses, order[first:last])
        lower = np.tril_indices(self.size, -1)
        matrix[lower] = matrix.T[lower]
        return matrix, gradient

    def _add_chunk(self, matrix: FloatArray, gradient: FloatArray, state: State, poses: slice, rows: IntArray) -> None:
        bases = [basis[poses] for basis in self.bases]
        values = self.parameters.values(state.errors, bases)
        tip, columns = exact_columns(self.parameters.machine, values, self.position_mm[poses], self.tool_mm[poses])
        design = self.parameters.design(columns, bases)
        count, errors = len(tip), self.parameters.size
        local, station, group = self.pose[rows] - poses.start, self.station[rows], self.group[rows]
        sight = tip[local] - state.stations_mm[station]
        distance = np.linalg.norm(sight, axis=1)
        unit = sight / distance[:, None]
        residual = distance - state.dead_length_mm[group] - self.length_mm[rows]
        weight = self.weight[rows]
        outer = weight[:, None, None] * unit[:, :, None] * unit[:, None, :]

        by_station = np.zeros((count, self.stations, 3, 3))
        np.add.at(by_station, (local, station), outer)
        by_group = np.zeros((count, self.groups, 3))
        np.add.at(by_group, (local, group), weight[:, None] * unit)
        pulled = np.zeros((count, 3))
        np.add.at(pulled, local, (weight * residual)[:, None] * unit)

        flat = design.reshape(3 * count, errors)
        seen = np.einsum("pab,pbk->pak", by_station.sum(axis=1), design).reshape(3 * count, errors)
        s0, g0 = errors, errors + 3 * self.stations
        matrix[:s0, :s0] += flat.T @ seen
        matrix[:s0, s0:g0] -= flat.T @ by_station.transpose(0, 2, 1, 3).reshape(3 * count, -1)
        matrix[:s0, g0:] -= flat.T @ by_group.transpose(0, 2, 1).reshape(3 * count, -1)
        gradient[:s0] += flat.T @ pulled.ravel()
        self._add_stations(matrix, gradient, rows, unit, residual)

    def _add_stations(
        self, matrix: FloatArray, gradient: FloatArray, rows: IntArray, unit: FloatArray, residual: FloatArray
    ) -> None:
        s0, g0 = self.parameters.size, self.parameters.size + 3 * self.stations
        weight, station, group = self.weight[rows], self.station[rows], self.group[rows]
        outer = np.zeros((self.stations, 3, 3))
        np.add.at(outer, station, weight[:, None, None] * unit[:, :, None] * unit[:, None, :])
        for k in range(self.stations):
            block = slice(s0 + 3 * k, s0 + 3 * k + 3)
            matrix[block, block] += outer[k]
        cross = np.zeros((self.stations, self.groups, 3))
        np.add.at(cross, (station, group), weight[:, None] * unit)
        matrix[s0:g0, g0:] += cross.transpose(0, 2, 1).reshape(-1, self.groups)
        matrix[range(g0, self.size), range(g0, self.size)] += np.bincount(group, weight, self.groups)
        pulled = np.zeros((self.stations, 3))
        np.add.at(pulled, station, (weight * residual)[:, None] * unit)
        gradient[s0:g0] -= pulled.ravel()
        gradient[g0:] -= np.bincount(group, weight * residual, self.groups)


def length_problem(
    machine: Machine, lengths: Lengths, parameters: ErrorParameters, group: IntArray | None = None
) -> LengthProblem:
    """Sort the readings by pose, station and dead length; all weights 1.

    ``group`` is the index of the dead length of each reading (n,), by default one for every station and set-up.
    """
    tool = np.broadcast_to(tool_of(machine, lengths.tool_mm), lengths.position_mm.shape)
    keys = np.column_stack([lengths.position_mm, tool])
    unique, pose = np.unique(keys, axis=0, return_inverse=True)
    if group is None:
        setup = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
        _, group = np.unique(np.column_stack([lengths.station, setup]), axis=0, return_inverse=True)
    position_mm = unique[:, :3]
    bases = tuple(parameters.basis(axis, position_mm[:, axis]) for axis in range(3))
    return LengthProblem(
        parameters=parameters,
        position_mm=position_mm,
        tool_mm=unique[:, 3:],
        pose=pose.ravel().astype(np.int64),
        station=lengths.station,
        group=group.ravel().astype(np.int64),
        length_mm=lengths.length_mm,
        weight=np.ones(len(lengths)),
        bases=bases,  # type: ignore[arg-type]
    )


# Errors from measured positions (Zha & Zhang 2024, eq. 21-28, with positions in place of lengths) and the exact model.
#
# Measured position of pose j, already close to the machine frame, against the tip of the model:
#
#     r_j = R(-w) (tip(q_j; P) - c - t) + c - m_j - L_j b
#
# Unknown are the errors P, the rigid placement (t, w) of the measured frame about the centre c, and, for positions that
# tracers have located, the errors b of their stations and dead lengths, which move every point by L_j b. Minimised is
#
#     sum of r_j^T U_j r_j + b^T B b
#
# U_j is the information of the point with the stations fixed, B that of the stations from their self-calibration. So the
# correlation between the points counts in full, and nothing larger than the unknowns is ever inverted.


CHUNK_POINTS = 2048
#: The unknown rotation of the frame is counted in mm at this lever, as the solver counts angles.
LEVER_MM = 1000.0


@dataclass(frozen=True)
class SeparationProblem:
    """Positions measured at m poses; it has the interface of :class:`compgen.identify.adjust.unknowns.LeastSquaresProblem`.

    In the state, ``stations_mm`` (2, 3) holds translation and rotation vector (times 1000 mm) of the frame, and
    ``dead_length_mm`` (q,) the errors b of the stations; q may be 0.

    Parameters
    ----------
    parameters, bases : the unknown errors and the curve bases at the poses.
    position_mm, tool_mm : poses, each (m, 3).
    measured_mm : measured tip positions (m, 3), the placement known roughly.
    information : U_j, (m, 3, 3), 1/mm^2; zero in the directions that were not measured.
    lever, station_information : L_j (m, 3, q) and B (q, q).
    """

    parameters: ErrorParameters
    bases: tuple[FloatArray, FloatArray, FloatArray]
    position_mm: FloatArray
    tool_mm: FloatArray
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

    def tip_mm(self, state: State) -> FloatArray:
        """Tips of the model in the machine frame, (m, 3)."""
        values = self.parameters.values(state.errors, self.bases)
        return tip_position(self.parameters.machine, values, self.position_mm, self.tool_mm)

    def residuals(self, state: State) -> FloatArray:
        """Model minus measured, components of each point one after another, (3 m,), mm."""
        return self._rest(state, self._seen(state, self.tip_mm(state))).ravel()

    def _seen(self, state: State, tip_mm: FloatArray) -> FloatArray:
        """Tips as vectors from the centre in the measured frame, (m, 3)."""
        return np.asarray((tip_mm - self.centre_mm - state.stations_mm[0]) @ frame_rotation(-state.stations_mm[1])[0].T)

    def _rest(self, state: State, seen: FloatArray) -> FloatArray:
        return seen + self.centre_mm - self.measured_mm - self.lever @ state.dead_length_mm

    def evaluate(self, state: State) -> tuple[float, FloatArray]:
        """Half the weighted sum of squares, and its exact gradient (size,)."""
        values = self.parameters.values(state.errors, self.bases)
        tip, columns = exact_columns(self.parameters.machine, values, self.position_mm, self.tool_mm)
        seen = self._seen(state, tip)
        rest = self._rest(state, seen)
        force = np.einsum("mij,mj->mi", self.information, rest)
        back, jacobian = frame_rotation(-state.stations_mm[1])
        held = self.station_information @ state.dead_length_mm
        cost = 0.5 * (float(np.vdot(force, rest)) + float(state.dead_length_mm @ held))
        pull = force @ back  # forces on the tips, in the machine frame
        gradient = np.zeros(self.size)
        first = self.parameters.size
        gradient[:first] = self._by_errors(np.einsum("mi,mie->me", pull, columns))
        gradient[first : first + 3] = -pull.sum(axis=0)
        gradient[first + 3 : first + 6] = jacobian.T @ -np.cross(seen, force).sum(axis=0) / LEVER_MM
        gradient[first + 6 :] = held - np.einsum("miq,mi->q", self.lever, force)
        return cost, gradient

    def _by_errors(self, by_value: FloatArray) -> FloatArray:
        """Gradient by the unknown errors from that by the 21 values at each pose (m, 21)."""
        gradient = np.zeros(self.parameters.size)
        for curve in self.parameters.curves:
            nodal = self.bases[curve.error.axis].T @ by_value[:, ERROR_INDEX[curve.error.name]]
            gradient[curve.columns] = curve.free.T @ nodal
        for k, name in enumerate(
            self.parameters.squareness, start=self.parameters.size - len(self.parameters.squareness)
        ):
            gradient[k] = by_value[:, ERROR_INDEX[name]].sum()
        return gradient

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size) with the exact derivative at ``state``."""
        matrix = np.zeros((self.size, self.size))
        values = self.parameters.values(state.errors, self.bases)
        for first in range(0, len(self.position_mm), CHUNK_POINTS):
            rows = slice(first, first + CHUNK_POINTS)
            jacobian = self._jacobian(state, values[rows], rows)
            seen = self.information[rows] @ jacobian
            matrix += jacobian.reshape(-1, self.size).T @ seen.reshape(-1, self.size)
        own = slice(self.parameters.size + 6, None)
        matrix[own, own] += self.station_information
        return matrix

    def _jacobian(self, state: State, values: FloatArray, rows: slice) -> FloatArray:
        """Derivative of r_j by all unknowns, (poses, 3, size)."""
        machine, bases = self.parameters.machine, [basis[rows] for basis in self.bases]
        tip, columns = exact_columns(machine, values, self.position_mm[rows], self.tool_mm[rows])
        back, jacobian = frame_rotation(-state.stations_mm[1])
        turn = cross_matrices(self._seen(state, tip)) @ jacobian / LEVER_MM
        shift = np.broadcast_to(-back, turn.shape)
        return np.concatenate([back @ self.parameters.design(columns, bases), shift, turn, -self.lever[rows]], axis=2)

    def unknown_names(self, station_unknowns: tuple[str, ...] = ()) -> list[str]:
        """Names of all unknowns for messages; ``station_unknowns`` (q,) names b."""
        names = []
        for curve in self.parameters.curves:
            strongest = [int(np.argmax(np.abs(column))) for column in curve.free.T]
            names += [f"{curve.error.name} at {curve.nodes_mm[k]:g} mm" for k in strongest]
        placement = [f"{what}-{axis} of the frame" for what in ("shift", "turn") for axis in "xyz"]
        return [*names, *self.parameters.squareness, *placement, *station_unknowns]


def frame_rotation(vector_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation matrix and left Jacobian of SO(3), each (3, 3), of a rotation vector (3,) in mm at 1000 mm."""
    rotation, jacobian = level_rotations(vector_mm[None] / LEVER_MM)
    return rotation[0], jacobian[0]
