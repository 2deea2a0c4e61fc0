"""Trilinear interpolation in a regular grid of boxes, as three-dimensional error compensation does it.

FANUC, additional manual A-79351E, sheet 3/13: inside a box each component is the sum over its eight corners of the
corner's value times (1 - x) or x, (1 - y) or y, (1 - z) or z, with the ratios x, y, z = 0 ... 1 within the box.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from compgen.core.csvio import FloatArray

#: Corner (x, y, z) of C1 ... C8 in FANUC's formula: round the lower face, then round the upper one.
FANUC_CORNERS: tuple[tuple[int, int, int], ...] = (
    (0, 0, 0),
    (1, 0, 0),
    (1, 1, 0),
    (0, 1, 0),
    (0, 0, 1),
    (1, 0, 1),
    (1, 1, 1),
    (0, 1, 1),
)


def box_of_corners(corners: FloatArray) -> FloatArray:
    """Return a grid of one box (2, 2, 2, k) from values (8, k) in FANUC's order C1 ... C8.

    >>> box_of_corners(np.arange(8.0)[:, None])[1, 0, 0, 0], box_of_corners(np.arange(8.0)[:, None])[0, 1, 1, 0]
    (np.float64(1.0), np.float64(7.0))
    """
    values = np.asarray(corners, dtype=np.float64)
    box = np.empty((2, 2, 2, values.shape[1]))
    for corner, value in zip(FANUC_CORNERS, values, strict=True):
        box[corner] = value
    return box


def _cells(ratio: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Cell number and share within it for ratios (n,) that count in cells from the first vertex; clamped."""
    inside = np.clip(ratio, 0.0, count - 1)
    cell = np.minimum(np.floor(inside), max(count - 2, 0))
    return cell, inside - cell


def trilinear(vertices: FloatArray, start_mm: FloatArray, step_mm: FloatArray, position_mm: FloatArray) -> FloatArray:
    """Interpolate a regular grid of vertex values.

    Parameters
    ----------
    vertices : values (nx, ny, nz, k) in any unit; index [i, j, l] stands at ``start_mm + (i, j, l) step_mm``. An
        axis with a single vertex is constant along itself.
    start_mm, step_mm : position of vertex [0, 0, 0] and the (positive) distances, shape (3,), mm.
    position_mm : shape (n, 3), mm; outside the grid the value of its surface holds (clamped).

    Returns
    -------
    values at the positions, shape (n, k).
    """
    grid = np.asarray(vertices, dtype=np.float64)
    ratio = (np.asarray(position_mm, dtype=np.float64) - start_mm) / step_mm
    cells, shares = zip(*(_cells(ratio[:, axis], grid.shape[axis]) for axis in range(3)), strict=True)
    result = np.zeros((len(ratio), grid.shape[3]))
    for corner in product((0, 1), repeat=3):
        weight = np.ones(len(ratio))
        index = []
        for axis, upper in enumerate(corner):
            weight = weight * (shares[axis] if upper else 1.0 - shares[axis])
            index.append(np.minimum(cells[axis] + upper, grid.shape[axis] - 1).astype(np.intp))
        result += weight[:, None] * grid[index[0], index[1], index[2]]
    return result
