"""E = C P at many points: sums of tables per axis, in blocks of constant memory.

Every entry of C is 1, a coordinate or a tool offset, so with f = (1, x, y, z, tool offset)

    E(x, y, z) = sum over g of f_g * (X_g(x) + Y_g(y) + Z_g(z)),

each table a vector of three, squareness and signs in it (:mod:`compgen.model.tables`). A list of points costs one
look-up per axis. On a full grid no points are formed: as a matrix of rows (x, y) against columns (z, component) E has
a rank of at most nine. The kernels of :mod:`compgen.model.kernels` do the same in one pass
(:mod:`compgen.core.kernels` says when).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.kernels import switch_to_compiled, use_compiled
from compgen.core.machine import Machine
from compgen.core.threads import one_thread
from compgen.errors import InputError
from compgen.model import kernels
from compgen.model.tables import ONE, AxisTables, field_tables, grid_tables
from compgen.model.volumetric import tool_of

#: Points that are worked on together: their intermediate arrays stay in the cache of one core.
BLOCK = 16_384
_GRID_BLOCK = 32_768
#: From so many points on, loading the kernels (half a second, some seconds for the first time) pays for a single call.
_POINTS_FOR_KERNELS, _GRID_FOR_KERNELS = 20_000_000, 500_000_000


def checked_points(position_mm: FloatArray) -> FloatArray:
    """Return positions as numbers, or raise if they are not of shape (n, 3)."""
    position = np.asarray(position_mm, dtype=np.float64)
    if position.ndim != 2 or position.shape[1] != 3:
        raise InputError(f"positions have the shape {position.shape}; (n, 3) is due: x, y, z in mm for each point")
    return position


def checked_out(out: FloatArray | None, shape: tuple[int, ...]) -> FloatArray:
    """Return ``out``, or a new array if it is None; raise if the result does not fit into it."""
    if out is None:
        return np.empty(shape)
    if out.shape != shape or out.dtype != np.float64 or not out.flags.c_contiguous or not out.flags.writeable:
        raise InputError(
            f"out has the shape {out.shape} and type {out.dtype}; a writeable C-ordered float64 {shape} is due"
        )
    return out


def blocks(count: int, size: int = BLOCK) -> Iterator[slice]:
    """Slices that cover ``count`` items, ``size`` at a time."""
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def volumetric_error_at(
    machine: Machine,
    errors: ErrorTable,
    position_mm: FloatArray,
    tool_mm: FloatArray | None = None,
    out: FloatArray | None = None,
) -> FloatArray:
    """Error E = C P of the tool tip at commanded positions.

    Parameters
    ----------
    machine, errors : what moves, and how wrong.
    position_mm : shape (n, 3).
    tool_mm : tool offset, shape (3,) or (n, 3), default the machine's.
    out : array (n, 3) for the result; new if not given.

    Returns
    -------
    array of shape (n, 3), mm.
    """
    position = checked_points(position_mm)
    result = checked_out(out, position.shape)
    tool = tool_of(machine, tool_mm)
    each = None if tool.ndim == 1 else np.broadcast_to(tool, position.shape)
    tables = field_tables(machine, errors, tool if each is None else None)
    if use_compiled(len(position), _POINTS_FOR_KERNELS):
        kernels.field_at(tables, position, each, result)
        return result
    for part in blocks(len(position)):
        _field_block(tables, position[part], None if each is None else each[part], result[part])
    return result


def _field_block(tables: AxisTables, position_mm: FloatArray, tool_mm: FloatArray | None, out: FloatArray) -> None:
    """Write the field at a few points (m, 3) to ``out`` (m, 3)."""
    factors = list(np.ascontiguousarray(position_mm.T))
    if tool_mm is not None:
        factors.extend(np.ascontiguousarray(tool_mm.T))
    sums = _group_sums(tables, factors)
    for output in range(3):
        total = sums.pop((ONE, output), None)
        for group, factor in enumerate(factors, start=1):
            term = sums.pop((group, output), None)
            if term is not None:
                term *= factor
                total = term if total is None else np.add(total, term, out=total)
        out[:, output] = 0.0 if total is None else total


def _group_sums(tables: AxisTables, coordinates: Sequence[FloatArray]) -> dict[tuple[int, int], FloatArray]:
    """X_g(x) + Y_g(y) + Z_g(z) by group and component, as far as they are not zero."""
    sums: dict[tuple[int, int], FloatArray] = {}
    value, left = np.empty((2, len(coordinates[0])))
    for table, coordinate in zip(tables, coordinates, strict=False):
        if not table.channels:
            continue
        cell, share = table.index.locate(coordinate)
        for channel in table.channels:
            key = channel.group, channel.output
            channel.step.take(cell, mode="clip", out=value)
            np.multiply(value, share, out=value)
            channel.left.take(cell, mode="clip", out=left)
            if key in sums:
                sums[key] += left
                sums[key] += value
            else:
                sums[key] = left + value
    return sums


def volumetric_error_on_grid(
    machine: Machine,
    errors: ErrorTable,
    levels_mm: Sequence[FloatArray],
    tool_mm: FloatArray | None = None,
    out: FloatArray | None = None,
) -> FloatArray:
    """Error E = C P of the tool tip on a full grid, in a single pass over the result.

    Parameters
    ----------
    machine, errors : what moves, and how wrong.
    levels_mm : positions of X, Y and Z, shapes (nx,), (ny,), (nz,), in any order.
    tool_mm : tool offset, shape (3,), default the machine's.
    out : array (nx, ny, nz, 3) for the result; new if not given.

    Returns
    -------
    array of shape (nx, ny, nz, 3), mm.
    """
    levels = [np.asarray(level, dtype=np.float64) for level in levels_mm]
    if len(levels) != 3 or any(level.ndim != 1 for level in levels):
        raise InputError("a grid needs three lists of levels in mm: those of X, of Y and of Z")
    tool = tool_of(machine, tool_mm)
    if tool.shape != (3,):
        raise InputError(f"tool offsets have the shape {tool.shape}; a grid has one tool, (3,) in mm")
    shape = (len(levels[0]), len(levels[1]), len(levels[2]), 3)
    result = checked_out(out, shape)
    if result.size == 0:
        return result
    at_levels = grid_tables(machine, errors, tool, levels)
    if use_compiled(result.size // 3, _GRID_FOR_KERNELS):
        kernels.field_on_grid(at_levels, levels, result)
    else:
        _grid_by_rank(at_levels, levels, result)
    return result


def _grid_by_rank(at_levels: Sequence[FloatArray], levels: Sequence[FloatArray], out: FloatArray) -> None:
    """Write the field on a grid as a product: functions of (x, y) times functions of (z, component).

    E_o = 1 * [P_o(x, y)] + z * [Q_o(x, y)] + Z_1,o(z) * [1] + Z_x,o(z) * [x] + Z_y,o(z) * [y], where Z_1 takes z Z_z.
    """
    count_x, count_y, count_z, _ = out.shape
    columns = _functions_of_z(at_levels[2], levels[2])
    needed = np.any(columns != 0.0, axis=1)
    needed[3:6] &= np.any(at_levels[0][:, 3], axis=0) | np.any(at_levels[1][:, 3], axis=0)
    rows = out.reshape(count_x * count_y, 3 * count_z)
    plane = max(1, BLOCK // count_y)
    for part in blocks(count_x, plane):
        for inner in blocks(count_y, BLOCK):
            left = _functions_of_xy(at_levels, levels, part, inner)[:, needed]
            first = part.start * count_y + inner.start
            _product(left, columns[needed], rows[first : first + len(left)])


def _product(left: FloatArray, right: FloatArray, out: FloatArray) -> None:
    with one_thread():
        for part in blocks(len(left), max(1, 3 * _GRID_BLOCK // right.shape[1])):
            np.matmul(left[part], right, out=out[part])


def _functions_of_z(values: FloatArray, z_mm: FloatArray) -> FloatArray:
    """Nine functions of (z, component), shape (9, 3 nz)."""
    components = np.tile(np.eye(3), len(z_mm))
    own = values[:, 0] + z_mm[:, None] * values[:, 3]
    functions = np.vstack([components, components * np.repeat(z_mm, 3), own.reshape(1, -1)])
    return np.vstack([functions, values[:, 1].reshape(1, -1), values[:, 2].reshape(1, -1)])


def _functions_of_xy(
    at_levels: Sequence[FloatArray], levels: Sequence[FloatArray], part_x: slice, part_y: slice
) -> FloatArray:
    """The nine factors (P, Q, 1, x, y) of those functions at levels (x, y), shape (nx * ny, 9)."""
    x, y = levels[0][part_x, None, None], levels[1][None, part_y, None]
    along_x, along_y = at_levels[0][part_x, None], at_levels[1][None, part_y]
    factors = np.empty((x.shape[0], y.shape[1], 9))
    factors[:, :, 0:3] = along_x[:, :, 0] + x * along_x[:, :, 1] + along_y[:, :, 0] + y * along_y[:, :, 2]
    factors[:, :, 0:3] += y * along_x[:, :, 2] + x * along_y[:, :, 1]
    factors[:, :, 3:6] = along_x[:, :, 3] + along_y[:, :, 3]
    factors[:, :, 6], factors[:, :, 7], factors[:, :, 8] = 1.0, x[:, :, 0], y[:, :, 0]
    return factors.reshape(-1, 9)


def load_kernels() -> bool:
    """Use the compiled kernels for every size from now on, as the environment's ``COMPGEN_KERNELS=compiled`` does.

    This process and those that it starts are switched. False, and nothing is changed, where numba (``compgen[fast]``)
    is not installed or ``COMPGEN_KERNELS`` is plain.
    """
    return switch_to_compiled()


__all__ = [
    "BLOCK",
    "blocks",
    "checked_out",
    "checked_points",
    "load_kernels",
    "volumetric_error_at",
    "volumetric_error_on_grid",
]
