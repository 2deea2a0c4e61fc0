"""The normal matrix of a grid from moments of w u u^T per level and per pair of levels (u the line of sight).

Every entry of C is a monomial in the axis coordinates, so small tables of moments hold all that the matrix needs. It uses
C in place of the exact derivative: the matrix steers the iteration, the optimum is where the exact gradient vanishes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.identify.grid import Grid, ToolData
from compgen.identify.grid_chain import lengths_of, squareness_of
from compgen.identify.kernels import compiled_loops
from compgen.identify.level_map import Kind, LevelMap, level_map
from compgen.identify.state import State

#: Numbers that a batch of stations may hold: small ones save calls, larger ones leave the cache.
BATCH = 60_000
#: Index into the six different entries of a symmetric 3 x 3 matrix.
_SYMMETRIC = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


def add_normal(grid: Grid, data: ToolData, tip: FloatArray, state: State, matrix: FloatArray) -> None:
    """Add the part of one tool to the upper blocks of the normal matrix."""
    shape = tuple(len(grid.levels_mm[axis]) for axis in grid.order)
    level = level_map(
        grid.parameters, grid.levels_mm, grid.reduced, data.tool_mm, squareness_of(grid.parameters, state)
    )
    first, second = grid.parameters.size, grid.parameters.size + 3 * grid.stations
    loops = compiled_loops()
    step = grid.groups if loops else max(1, BATCH // tip.size)
    weighted = np.zeros((6, *shape))
    for start in range(0, grid.groups, step):
        batch = slice(start, min(start + step, grid.groups))
        stations = grid.station_of[batch]
        if loops is None:
            sight = tip - state.stations_mm[stations][:, None, :, None]
            sight /= lengths_of(sight)[:, :, None, :]
            products = _outer_products(sight, data.weight[batch], shape)  # 6 of w u u^T, 3 of w u, 1 of w
            weighted += products[:, :6].sum(axis=0) if len(stations) > 1 else products[0, :6]
            tables = _moment_tables(grid, products)
        else:
            coordinates = [grid.levels_mm[axis] for axis in grid.order]
            tables = [np.zeros((len(stations), count, 3, 10)) for count in shape]
            loops.moments(
                np.ascontiguousarray(tip),
                state.stations_mm[stations],
                data.weight[batch],
                *coordinates,
                weighted,
                *tables,
            )
        by_station, by_group = _station_moments(grid, level, tables)
        by_station = level.transposed @ by_station  # (size, batch * 3)
        sums = tables[0][:, :, 0].sum(axis=1)
        for k, station in enumerate(stations.tolist()):
            columns = slice(first + 3 * station, first + 3 * station + 3)
            matrix[:first, columns] -= by_station[:, 3 * k : 3 * k + 3]
            matrix[columns, columns] += sums[k, _SYMMETRIC]
            matrix[columns, second + start + k] += sums[k, 6:9]
            matrix[second + start + k, second + start + k] += sums[k, 9]
        matrix[:first, second + batch.start : second + batch.stop] -= level.transposed @ by_group
    levels = _level_matrix(grid, level, weighted)
    matrix[:first, :first] += level.transposed @ (level.transposed @ levels).T


def _outer_products(unit: FloatArray, weight: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Moments w u u^T (xx, yy, zz, xy, xz, yz), w u (x, y, z) and w on the grid: shape (groups, 10, n_out, n_mid, n_in)."""
    moments = np.empty((len(weight), 10, *weight.shape[1:]))
    moments[:, 9] = weight
    for k in range(3):
        np.multiply(weight, unit[:, :, k], out=moments[:, 6 + k])
        np.multiply(moments[:, 6 + k], unit[:, :, k], out=moments[:, k])
    np.multiply(moments[:, 6], unit[:, :, 1], out=moments[:, 3])
    np.multiply(moments[:, 6], unit[:, :, 2], out=moments[:, 4])
    np.multiply(moments[:, 7], unit[:, :, 2], out=moments[:, 5])
    return moments.reshape(len(weight), 10, *shape)


def _powers(levels_mm: FloatArray, count: int) -> FloatArray:
    powers = np.ones((len(levels_mm), count))
    powers[:, 1] = levels_mm
    if count > 2:
        powers[:, 2] = levels_mm * levels_mm
    return powers


def _moment_tables(grid: Grid, products: FloatArray) -> list[FloatArray]:
    """Sum the products (groups, 10, n_out, n_mid, n_in) per level of the outer, middle and inner axis.

    Each table is (groups, levels, 3, 10): the sums times 1 and times the coordinates of the other two axes, in the
    order inner, mid, out.
    """
    out, mid, inner = (_powers(grid.levels_mm[axis], 2) for axis in grid.order)
    groups = len(products)
    over_inner = products @ inner  # [group, 10, out, mid, q_in]
    by_out = over_inner.swapaxes(3, 4) @ mid  # [group, 10, out, q_in, q_mid]
    by_mid = over_inner.transpose(0, 1, 3, 4, 2) @ out  # [group, 10, mid, q_in, q_out]
    flat = products.reshape(groups * 10, *products.shape[2:])
    over_out = _contract_first(flat, out)  # [group * 10, q_out, mid, in]
    by_inner = (over_out.swapaxes(2, 3) @ mid).transpose(0, 2, 3, 1)  # [group * 10, in, q_mid, q_out]
    tables = (by_out, by_mid, by_inner.reshape(groups, 10, *by_inner.shape[1:]))
    return [np.stack([t[..., 0, 0], t[..., 1, 0], t[..., 0, 1]]).transpose(1, 3, 0, 2) for t in tables]


def _station_moments(grid: Grid, level: LevelMap, tables: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Per kind and level: sums of w q u_o u^T (levels, groups * 3) and of w q u_o (levels, groups), q the kind's lever."""
    out, mid, inner = grid.order
    place = {out: (tables[0], (inner, mid)), mid: (tables[1], (inner, out)), inner: (tables[2], (mid, out))}
    stations, dead = [], []
    for axis, kinds in enumerate(level.kinds):
        table, levers = place[axis]
        for kind in kinds:
            part = table[:, :, 0 if kind.lever is None else 1 + levers.index(kind.lever)]  # [group, level, 10]
            chosen = part[:, :, _SYMMETRIC[kind.output]]  # [group, level, 3]
            stations.append(chosen.transpose(1, 0, 2).reshape(part.shape[1], -1))
            dead.append(part[:, :, 6 + kind.output].T)
    return np.concatenate(stations), np.concatenate(dead)


def _contract_first(table: FloatArray, powers: FloatArray) -> FloatArray:
    """Sum over the second axis of (k, a, b, c) with powers (a, q): (k, q, b, c) by matrix products."""
    count, first = table.shape[:2]
    return (powers.T @ table.reshape(count, first, -1)).reshape(count, powers.shape[1], *table.shape[2:])


def _level_matrix(grid: Grid, level: LevelMap, weighted: FloatArray) -> FloatArray:
    """Normal matrix of the kinds at their levels, from moments of w u u^T (6, n_out, n_mid, n_in) over pairs."""
    out, mid, inner = grid.order
    powers = {axis: _powers(grid.levels_mm[axis], 3) for axis in range(3)}
    pair = {
        (out, mid): (weighted @ powers[inner]).transpose(3, 0, 1, 2),  # [power of the third, 6, first, second]
        (out, inner): (powers[mid].T @ weighted).transpose(2, 0, 1, 3),
        (mid, inner): _contract_first(weighted, powers[out]).transpose(1, 0, 2, 3),
    }
    sizes = [len(grid.levels_mm[axis]) for axis in range(3)]
    starts = np.cumsum([0, *(len(level.kinds[axis]) * sizes[axis] for axis in range(3))])
    result = np.zeros((int(starts[3]), int(starts[3])))
    for (a, b), table in pair.items():
        if not level.kinds[a] or not level.kinds[b]:  # the model may leave an axis without any error
            continue
        block = _pair_block(level.kinds[a], level.kinds[b], table, grid.levels_mm[a], grid.levels_mm[b])
        rows, columns = slice(starts[a], starts[a + 1]), slice(starts[b], starts[b + 1])
        result[rows, columns] = block
        result[columns, rows] = block.T
    for axis, (first, second) in {out: (out, mid), mid: (out, mid), inner: (out, inner)}.items():
        if not level.kinds[axis]:
            continue
        table = pair[(first, second)]
        other = second if axis == first else first
        turned = table if axis == first else table.transpose(0, 1, 3, 2)
        along = (turned @ powers[other]).transpose(3, 0, 1, 2)  # [power of other, of third, 6, level]
        third = 3 - first - second
        result[starts[axis] : starts[axis + 1], starts[axis] : starts[axis + 1]] = _own_block(
            level.kinds[axis], along, other, third
        )
    return result


def _pair_block(
    kinds_a: Sequence[Kind], kinds_b: Sequence[Kind], table: FloatArray, levels_a: FloatArray, levels_b: FloatArray
) -> FloatArray:
    """Block of two different axes: kinds and levels of the first by those of the second."""
    a, b = kinds_a[0].axis, kinds_b[0].axis
    third = 3 - a - b
    power = np.array([[int(p.lever == third) + int(q.lever == third) for q in kinds_b] for p in kinds_a])
    entry = _SYMMETRIC[np.ix_([p.output for p in kinds_a], [q.output for q in kinds_b])]
    block = table[power, entry]  # [kind a, kind b, level a, level b]
    scale_b = np.array([levels_b if p.lever == b else np.ones(len(levels_b)) for p in kinds_a])
    scale_a = np.array([levels_a if q.lever == a else np.ones(len(levels_a)) for q in kinds_b])
    block = block * scale_b[:, None, None, :] * scale_a[None, :, :, None]
    return np.ascontiguousarray(block.transpose(0, 2, 1, 3)).reshape(
        len(kinds_a) * len(levels_a), len(kinds_b) * len(levels_b)
    )


def _own_block(kinds: Sequence[Kind], along: FloatArray, other: int, third: int) -> FloatArray:
    """Block of one axis with itself: diagonal in the levels; ``along`` is [power of other, of third, 6, level]."""
    first = np.array([[int(p.lever == other) + int(q.lever == other) for q in kinds] for p in kinds])
    second = np.array([[int(p.lever == third) + int(q.lever == third) for q in kinds] for p in kinds])
    outputs = [kind.output for kind in kinds]
    diagonal = along[first, second, _SYMMETRIC[np.ix_(outputs, outputs)]]  # [kind, kind, level]
    count = along.shape[3]
    block = np.zeros((len(kinds), count, len(kinds), count))
    index = np.arange(count)
    block[:, index, :, index] = diagonal.transpose(2, 0, 1)
    return block.reshape(len(kinds) * count, -1)
