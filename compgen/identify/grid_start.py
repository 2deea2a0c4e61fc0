"""What the closed-form start of the stations needs of the readings on a grid."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.identify.grid import Grid, nominal_targets


def start_moments(grid: Grid) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return what the closed-form start needs of the readings, in centred and scaled coordinates.

    With p = (target - centre)/scale and L = reading/scale - offset of the group: sums over the readings of each group
    of products of (2 p, 2 L, 1, |p|^2 - L^2).

    Returns
    -------
    moments (groups, 6, 6), offset (groups,), centre in mm (3,), scale in mm.
    """
    targets = nominal_targets(grid)
    centre = targets[0].mean(axis=1)
    scale = max(float(np.ptp(targets[0], axis=1).max()), 1.0)
    readings = np.sum([np.sum(data.length_mm * (data.weight > 0), axis=(1, 2)) for data in grid.tools], axis=0)
    counts = np.sum([np.count_nonzero(data.weight, axis=(1, 2)) for data in grid.tools], axis=0)
    offset = readings / np.maximum(counts, 1) / scale
    moments = np.zeros((grid.groups, 6, 6))
    for data, target in zip(grid.tools, targets, strict=True):
        p = (target - centre[:, None]) / scale
        columns = np.ones((6, p.shape[1]))
        columns[:3] = 2.0 * p
        square = np.einsum("km,km->m", p, p)
        for group in range(grid.groups):
            reading = data.length_mm[group].ravel() / scale - offset[group]
            columns[3] = 2.0 * reading
            columns[5] = square - reading**2
            present = (data.weight[group] > 0).ravel()
            moments[group] += (columns * present) @ columns.T
    return moments, offset, centre, scale
