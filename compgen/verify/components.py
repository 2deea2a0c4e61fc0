"""A field on a full grid split into what belongs to one axis, to a pair of axes, and to all three.

Every component is a place where a wrong sign, a swapped axis or a slip of unit shows, however small it is beside a
squareness of millimetres.
"""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.model.grid import VolumeGrid


def components(grid: VolumeGrid, field_mm: FloatArray) -> dict[str, FloatArray]:
    """Split a field (n, 3) on the grid's points; returns arrays of shape (nx, ny, nz) that broadcast, by name.

    Names: ``X constant``, ``X linear in y`` (slope), ``X(y)`` (the rest of the main effect), ``X(x,z)`` (interaction of
    a pair), ``X(x,y,z)``. The parts are orthogonal on the grid, so that none hides another.
    """
    parts: dict[str, FloatArray] = {}
    for output, letter in enumerate(AXES):
        rest = field_mm[:, output].reshape(grid.shape)
        constant = rest.mean(keepdims=True)
        parts[f"{letter} constant"] = constant
        rest = rest - constant
        for axis in range(3):
            others = tuple(k for k in range(3) if k != axis)
            main = rest.mean(axis=others, keepdims=True)
            rest = rest - main
            shape = [1, 1, 1]
            shape[axis] = -1
            level = grid.levels_mm[axis].reshape(shape)
            level = level - level.mean()
            slope = level * (np.sum(level * main) / np.sum(level**2))
            parts[f"{letter} linear in {AXES[axis].lower()}"] = slope
            parts[f"{letter}({AXES[axis].lower()})"] = main - slope
        for axis in (2, 1, 0):
            pair = rest.mean(axis=axis, keepdims=True)
            rest = rest - pair
            name = ",".join(AXES[k].lower() for k in range(3) if k != axis)
            parts[f"{letter}({name})"] = pair
        parts[f"{letter}(x,y,z)"] = rest
    return parts


def rms(part_mm: FloatArray) -> float:
    """Root mean square of a component over the grid (broadcasting does not change it)."""
    return float(np.sqrt(np.mean(part_mm**2)))
