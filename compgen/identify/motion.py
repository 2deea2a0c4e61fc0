"""The sparse map from the unknown errors to the motion of the carriages at the levels of a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import SQUARENESS_NAMES
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray


@dataclass(frozen=True)
class MotionMap:
    """Entries of the matrix from the unknown errors to delta and eps of every level, the levels of X, Y, Z in a row.

    Parameters
    ----------
    row, column, value : of each entry; row 6 l + k is component k of (delta, eps) at level l.
    shape : (levels * 6, unknown errors).
    """

    row: IntArray
    column: IntArray
    value: FloatArray
    shape: tuple[int, int]

    @cached_property
    def dense(self) -> FloatArray:
        """The whole matrix."""
        matrix = np.zeros(self.shape)
        np.add.at(matrix, (self.row, self.column), self.value)
        return matrix

    def with_squareness(
        self, parameters: ErrorParameters, levels_mm: Sequence[FloatArray], derivatives: FloatArray
    ) -> MotionMap:
        """Add the columns of the squareness errors, which move each carriage in proportion to its travel.

        ``derivatives`` [axis, component, squareness] of the directions of travel, see ``model.exact.travel_directions``.
        """
        axis = np.repeat(np.arange(3), [len(levels) for levels in levels_mm])
        places = [SQUARENESS_NAMES.index(name) for name in parameters.squareness]
        slopes = derivatives[axis][:, :, places] * np.concatenate(levels_mm)[:, None, None]
        level, component, place = np.nonzero(slopes)
        return MotionMap(
            np.concatenate([self.row, 6 * level + component]),
            np.concatenate([self.column, place + (parameters.size - len(places))]),
            np.concatenate([self.value, slopes[level, component, place]]),
            self.shape,
        )


def motion_map(parameters: ErrorParameters, bases: Sequence[FloatArray]) -> MotionMap:
    """Build the map of the curves; ``bases`` (levels, coefficients) are those of X, Y, Z at their levels."""
    starts = np.cumsum([0, *(len(basis) for basis in bases)]).tolist()
    known: dict[tuple[int, int], tuple[IntArray, IntArray, FloatArray]] = {}
    rows, columns, values = [], [], []
    for curve in parameters.curves:
        axis = curve.error.axis
        key = (axis, id(curve.free))
        if key not in known:
            reduced = bases[axis] @ curve.free
            level, column = np.nonzero(reduced)
            known[key] = (6 * (starts[axis] + level), column, reduced[level, column])
        level, column, value = known[key]
        rows.append(level + (curve.error.direction + (3 if curve.error.kind == "angular" else 0)))
        columns.append(column + curve.columns.start)
        values.append(value)
    nothing = np.zeros(0, dtype=np.int64)  # a model may hold squareness errors only
    return MotionMap(
        np.concatenate([nothing, *rows]),
        np.concatenate([nothing, *columns]),
        np.concatenate([np.zeros(0), *values]),
        (6 * starts[3], parameters.size),
    )
