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
    centre = np.array([levels.mean() for levels in grid.levels_mm]) + grid.tools[0].tool_mm
    scale = max(max(float(np.ptp(levels)) for levels in grid.levels_mm), 1.0)
    if grid.compiled:
        return *_compiled_moments(grid, centre, scale), centre, scale
    readings = np.sum([np.sum(data.length_mm * (data.weight > 0), axis=(1, 2)) for data in grid.tools], axis=0)
    counts = np.sum([np.count_nonzero(data.weight, axis=(1, 2)) for data in grid.tools], axis=0)
    offset = readings / np.maximum(counts, 1) / scale
    moments = np.zeros((grid.groups, 6, 6))
    for data, target in zip(grid.tools, nominal_targets(grid), strict=True):
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


def _compiled_moments(grid: Grid, centre: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Moments (groups, 6, 6) and offsets (groups,) by the compiled loops."""
    from compgen.identify.compiled import add_sums, start_sums

    counts, readings = np.zeros(grid.groups), np.zeros(grid.groups)
    for data in grid.tools:
        add_sums(data.weight, data.length_mm, counts, readings)
    offset = readings / np.maximum(counts, 1.0) / scale
    moments = np.zeros((grid.groups, 6, 6))
    out, mid, inner = grid.order
    axes = np.array(grid.order)
    for data in grid.tools:
        along = [(levels + data.tool_mm[k] - centre[k]) / scale for k, levels in enumerate(grid.levels_mm)]
        plane = np.stack([np.repeat(along[mid], len(along[inner])), np.tile(along[inner], len(along[mid]))])
        for k in range(grid.groups):
            start_sums(along[out], plane, axes, data.weight[k], data.length_mm[k], scale, float(offset[k]), moments[k])
    moments += moments.swapaxes(1, 2).copy()  # each product was entered once, on one side of the diagonal or on it
    moments[:, np.arange(6), np.arange(6)] *= 0.5
    return moments, offset
