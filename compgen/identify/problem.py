"""The least-squares problem of the tracer lengths (Zha & Zhang 2024, eq. 22) with the exact machine model.

Reading = |tip - station| - dead length. A row of the Jacobian is [u^T D B, -u^T, -1] with u the unit line of sight,
D the derivative of the tip by the 21 errors and B the curve basis. The block of the errors depends on the stations
only through G = sum over readings of w u u^T at a pose, so it is assembled per pose, whatever the number of readings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray, State
from compgen.model.exact import exact_columns, tip_position
from compgen.model.volumetric import tool_of

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
        residuals = self.residuals(state)
        return 0.5 * float(np.dot(self.weight, residuals**2)), self.normal_equations(state)[1]

    def normal_matrix(self, state: State) -> FloatArray:
        """J^T W J (size, size) with the exact derivative at ``state``."""
        return self.normal_equations(state)[0]

    def normal_equations(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Normal matrix J^T W J (size, size) and gradient J^T W r (size,) with the derivative at ``state``."""
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
