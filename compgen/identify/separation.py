"""Errors from measured positions (Zha & Zhang 2024, eq. 21-28, with positions in place of lengths) and the exact model.

Measured position of pose j, already close to the machine frame, against the tip of the model:

    r_j = R(-w) (tip(q_j; P) - c - t) + c - m_j - L_j b

Unknown are the errors P, the rigid placement (t, w) of the measured frame about the centre c, and, for positions that
tracers have located, the errors b of their stations and dead lengths, which move every point by L_j b. Minimised is

    sum of r_j^T U_j r_j + b^T B b

U_j is the information of the point with the stations held, B that of the stations from their self-calibration. So the
correlation between the points counts in full, and nothing larger than the unknowns is ever inverted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import ERROR_INDEX
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import State
from compgen.model.exact import exact_columns, tip_position
from compgen.model.rotation import cross_matrices, level_rotations

CHUNK_POINTS = 2048
#: The unknown rotation of the frame is counted in mm at this lever, as the solver counts angles.
LEVER_MM = 1000.0


@dataclass(frozen=True)
class SeparationProblem:
    """Positions measured at m poses; it has the interface of :class:`compgen.identify.state.Problem`.

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
