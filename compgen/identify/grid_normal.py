"""The normal matrix of a grid from the moments of its readings.

It uses C in place of the exact derivative: the matrix steers the iteration, the optimum is where the exact gradient
vanishes. First the derivatives are those by delta and eps of every level (delta: u, eps: r x u with the lever arm r), then
the map of the curves brings them to the unknowns.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from compgen.core.csvio import FloatArray
from compgen.identify.grid import Grid
from compgen.identify.grid_moments import Moments
from compgen.identify.motion import MotionMap
from compgen.identify.state import IntArray, State
from compgen.model.rotation import cross_matrices

#: Place of the entries of w u u^T and w u in the ten moments, one row for each component of u.
_ENTRIES = np.array([[0, 3, 4, 6], [3, 1, 5, 7], [4, 5, 2, 8]])


def add_normal(grid: Grid, moments: Moments, tool_mm: FloatArray, state: State, matrix: FloatArray) -> None:
    """Add the part of one tool to the upper blocks of the normal matrix (size, size).

    Parameters
    ----------
    grid : the unknowns and the levels.
    moments, tool_mm : of the readings with this tool, and its offset (3,).
    state : gives the directions of travel.
    """
    directions, derivatives = grid.travel(state)
    levers = _levers(grid, directions)
    motion = grid.motion.with_squareness(grid.parameters, grid.levels_mm, derivatives)
    first, second = grid.parameters.size, grid.parameters.size + 3 * grid.stations
    by_levels = np.zeros((motion.shape[0], motion.shape[0]))
    by_group = np.zeros((first, grid.groups, 4))
    if grid.compiled:
        _compiled_pairs(grid, moments, levers, tool_mm, by_levels)
        _compiled_stations(grid, moments, levers, tool_mm, motion, by_group)
        _project(motion, by_levels, matrix)
    else:
        to_unknowns = csr_array((motion.value, (motion.column, motion.row)), shape=motion.shape[::-1])
        _pairs(grid, moments, levers, tool_mm, by_levels)
        matrix[:first, :first] += np.asarray(to_unknowns @ np.asarray(to_unknowns @ by_levels).T)
        by_group += np.asarray(to_unknowns @ _stations(grid, moments, levers, tool_mm)).reshape(by_group.shape)
    sums = moments.levels[0][:, :, 0].sum(axis=1)
    for group, station in enumerate(grid.station_of.tolist()):
        columns = slice(first + 3 * station, first + 3 * station + 3)
        matrix[:first, columns] -= by_group[:, group, :3]
        matrix[:first, second + group] -= by_group[:, group, 3]
        matrix[columns, columns] += sums[group, _ENTRIES[:, :3]]
        matrix[columns, second + group] += sums[group, 6:9]
        matrix[second + group, second + group] += sums[group, 9]


def _levers(grid: Grid, directions: FloatArray) -> FloatArray:
    """Directions of the axes that are part of the lever arm of each axis, others zero: [axis, lever, component]."""
    levers = np.zeros((3, 3, 3))
    for axis in range(3):
        for lever in grid.parameters.machine.chain.lever_axes(axis):
            levers[axis, lever] = directions[lever]
    return levers


def _ordered(grid: Grid, moments: Moments) -> list[tuple[IntArray, FloatArray, bool, bool]]:
    """Pairs of axes with the third, their table, and whether the own block of the first and second is made of it."""
    out, mid, inner = grid.order
    first, second, third = moments.pairs
    return [
        (np.array([out, mid, inner]), first, True, True),
        (np.array([out, inner, mid]), second, False, True),
        (np.array([mid, inner, out]), third, False, False),
    ]


def _project(motion: MotionMap, by_levels: FloatArray, matrix: FloatArray) -> None:
    from compgen.identify.compiled import project

    project(motion.row, motion.column, motion.value, by_levels, matrix)


def _compiled_pairs(grid: Grid, moments: Moments, levers: FloatArray, tool_mm: FloatArray, matrix: FloatArray) -> None:
    from compgen.identify.compiled import add_pair

    rows = np.array(grid.first_rows)
    for axes, table, own_a, own_b in _ordered(grid, moments):
        levels_a, levels_b = grid.levels_mm[axes[0]], grid.levels_mm[axes[1]]
        add_pair(table, axes, levels_a, levels_b, levers, tool_mm, rows, own_a, own_b, matrix)


def _compiled_stations(  # noqa: PLR0913 - what a compiled loop asks for
    grid: Grid,
    moments: Moments,
    levers: FloatArray,
    tool_mm: FloatArray,
    motion: MotionMap,
    by_group: FloatArray,
) -> None:
    from compgen.identify.compiled import add_stations

    rows = np.array(grid.first_rows)
    for axes, table in zip(_with_levers(grid), moments.levels, strict=True):
        levels = grid.levels_mm[axes[0]]
        entries = (motion.row, motion.column, motion.value)
        add_stations(table, np.array(axes), levels, levers, tool_mm, rows, *entries, by_group)


def _with_levers(grid: Grid) -> list[tuple[int, int, int]]:
    """Each axis in the order of ``Grid.order`` with the two whose coordinates its table of moments has as factors."""
    out, mid, inner = grid.order
    return [(out, inner, mid), (mid, inner, out), (inner, mid, out)]


def _pairs(grid: Grid, moments: Moments, levers: FloatArray, tool_mm: FloatArray, matrix: FloatArray) -> None:
    """Fill in the normal matrix of delta and eps of all levels (levels * 6, levels * 6)."""
    starts = [6 * row for row in grid.first_rows]
    for axes, table, own_a, own_b in _ordered(grid, moments):
        a, b, third = axes.tolist()
        count_a, count_b = table.shape[2:]
        sums = _extended(table)
        maps = []
        for axis in (a, b):
            arm = tool_mm + grid.levels_mm[a][:, None, None] * levers[axis, a]
            arm = arm + grid.levels_mm[b][:, None] * levers[axis, b]
            maps.append(_derivatives(arm, levers[axis, third]))
        rows, columns = slice(starts[a], starts[a + 1]), slice(starts[b], starts[b + 1])
        half = maps[0] @ sums
        block = (half @ maps[1].swapaxes(2, 3)).transpose(0, 2, 1, 3).reshape(6 * count_a, 6 * count_b)
        matrix[rows, columns] = block
        matrix[columns, rows] = block.T
        if own_a:
            _set_own(matrix, starts[a], np.einsum("ijpk,ijqk->ipq", half, maps[0], optimize=True))
        if own_b:
            _set_own(matrix, starts[b], np.einsum("ijpk,ijqk->jpq", maps[1] @ sums, maps[1], optimize=True))


def _extended(table: FloatArray) -> FloatArray:
    """Moments of (u, q u) with the coordinate q of the third axis: (first, second, 6, 6)."""
    moments = table[:, _ENTRIES[:, :3]].transpose(3, 4, 0, 1, 2)  # [first, second, power, 3, 3]
    sums = np.empty((*moments.shape[:2], 6, 6))
    sums[:, :, :3, :3] = moments[:, :, 0]
    sums[:, :, :3, 3:] = sums[:, :, 3:, :3] = moments[:, :, 1]
    sums[:, :, 3:, 3:] = moments[:, :, 2]
    return sums


def _derivatives(arm: FloatArray, step: FloatArray) -> FloatArray:
    """From (u, q u) to the derivatives by delta and eps, with lever arms ``arm`` + q ``step``: (first, second, 6, 6)."""
    maps = np.zeros((*arm.shape[:2], 6, 6))
    maps[:, :, :3, :3] = np.eye(3)
    maps[:, :, 3:, :3] = cross_matrices(arm.reshape(-1, 3)).reshape(*arm.shape, 3)
    maps[:, :, 3:, 3:] = cross_matrices(step[None])
    return maps


def _set_own(matrix: FloatArray, start: int, blocks: FloatArray) -> None:
    """Set the blocks (levels, 6, 6) on the diagonal of the matrix, from row ``start`` on."""
    for k, block in enumerate(blocks):
        rows = slice(start + 6 * k, start + 6 * k + 6)
        matrix[rows, rows] = block


def _stations(grid: Grid, moments: Moments, levers: FloatArray, tool_mm: FloatArray) -> FloatArray:
    """Sums of derivatives by delta and eps times w u (x, y, z) and w: shape (levels * 6, groups * 4)."""
    parts: dict[int, FloatArray] = {}
    for (axis, *others), table in zip(_with_levers(grid), moments.levels, strict=True):
        groups, count = table.shape[:2]
        sums = table[..., _ENTRIES].reshape(groups, count, 9, 4)
        arm = tool_mm + grid.levels_mm[axis][:, None] * levers[axis, axis]
        maps = np.zeros((count, 6, 9))
        maps[:, :3, :3] = np.eye(3)
        maps[:, 3:, :3] = cross_matrices(arm)
        for k, other in enumerate(others):
            maps[:, 3:, 3 * k + 3 : 3 * k + 6] = cross_matrices(levers[axis, other][None])
        parts[axis] = (maps @ sums).transpose(1, 2, 0, 3).reshape(6 * count, 4 * groups)
    return np.concatenate([parts[axis] for axis in range(3)])
