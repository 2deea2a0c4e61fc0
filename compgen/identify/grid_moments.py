"""Moments of w u u^T per level and per pair of levels (u the line of sight): all that the normal matrix needs.

Every entry of C is linear in the coordinate of each axis, so small tables of moments hold what the readings say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.identify.grid import Grid, ToolData
from compgen.identify.grid_chain import lengths_of
from compgen.identify.state import State

#: Numbers that a batch of stations may hold: small ones save calls, larger ones leave the cache.
BATCH = 60_000


@dataclass(frozen=True)
class Moments:
    """Sums over the readings of one tool; the axes out, mid, inner are those of ``Grid.order``.

    Parameters
    ----------
    pairs : sums of w u u^T (xx, yy, zz, xy, xz, yz) of all groups at the levels of (out, mid), (out, inner) and
        (mid, inner), times the coordinate of the third axis to the power 0, 1, 2: each (3, 6, first, second).
    levels : for out, mid and inner the sums of w u u^T, w u (x, y, z) and w per group and level, times 1 and times the
        coordinates of the other two axes in the order inner, mid, out: each (groups, levels, 3, 10).
    """

    pairs: tuple[FloatArray, FloatArray, FloatArray]
    levels: tuple[FloatArray, FloatArray, FloatArray]


def compiled_moments(grid: Grid, data: ToolData, state: State) -> Moments:
    """Moments by the compiled loops."""
    from compgen.identify.compiled import moment_tables

    chain, levels, _ = grid.plan
    motion = grid.motion
    directions, _ = grid.travel(state)
    pairs, by_level = moment_tables(
        chain,
        levels,
        directions,
        motion.row,
        motion.column,
        motion.value,
        state.errors,
        data.tool_mm,
        state.stations_mm,
        grid.station_of,
        data.weight,
    )
    return Moments(pairs, by_level)


def moments(grid: Grid, data: ToolData, tip: FloatArray, state: State) -> Moments:
    """Moments by numpy; ``tip`` (n_out, 3, n_mid * n_in) are the tips of this tool."""
    shape = tuple(len(grid.levels_mm[axis]) for axis in grid.order)
    step = max(1, BATCH // tip.size)
    weighted = np.zeros((6, *shape))
    parts = []
    for start in range(0, grid.groups, step):
        batch = slice(start, min(start + step, grid.groups))
        sight = tip - state.stations_mm[grid.station_of[batch]][:, None, :, None]
        sight /= lengths_of(sight)[:, :, None, :]
        products = _outer_products(sight, data.weight[batch], shape)
        weighted += products[:, :6].sum(axis=0) if len(products) > 1 else products[0, :6]
        parts.append(_tables_by_level(grid, products))
    by_level = [np.concatenate(tables) for tables in zip(*parts, strict=True)]
    return Moments(_tables_of_pairs(grid, weighted), (by_level[0], by_level[1], by_level[2]))


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


def _tables_by_level(grid: Grid, products: FloatArray) -> list[FloatArray]:
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


def _tables_of_pairs(grid: Grid, weighted: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sum w u u^T (6, n_out, n_mid, n_in) over one axis, times the powers of its coordinate."""
    out, mid, inner = (_powers(grid.levels_mm[axis], 3) for axis in grid.order)
    return (
        (weighted @ inner).transpose(3, 0, 1, 2),
        (mid.T @ weighted).transpose(2, 0, 1, 3),
        _contract_first(weighted, out).transpose(1, 0, 2, 3),
    )


def _contract_first(table: FloatArray, powers: FloatArray) -> FloatArray:
    """Sum over the second axis of (k, a, b, c) with powers (a, q): (k, q, b, c) by matrix products."""
    count, first = table.shape[:2]
    return (powers.T @ table.reshape(count, first, -1)).reshape(count, powers.shape[1], *table.shape[2:])
