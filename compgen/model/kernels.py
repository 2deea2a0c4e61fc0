"""Calls of the compiled kernels of :mod:`compgen.model.compiled`; :mod:`compgen.core.kernels` says when they serve.

Importing this does not import numba: that alone takes a third of a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.model.tables import COORDINATES, AxisTable, AxisTables

_ROW = 8  # numbers per group and interval


def _axis(table: AxisTable, groups: tuple[int, ...]) -> tuple[Any, ...]:
    """One axis as the kernels take it."""
    index = table.index
    ends = float(index.nodes_mm[0]), float(index.nodes_mm[-1]), index.buckets_per_mm
    nodes = np.array(index.nodes_mm), index.upper_mm, index.per_gap
    return (*ends, np.uint64(index.last), index.start, *nodes, table.packed(groups))


def _even(tables: AxisTables) -> tuple[bool, bool, bool]:
    x, y, z = (table.index.even for table in tables)
    return x, y, z


def field_at(tables: AxisTables, position_mm: FloatArray, tool_mm: FloatArray | None, out: FloatArray) -> None:
    """Write E = C P at points (n, 3), with a tool offset each (n, 3) or folded into the tables, to ``out`` (n, 3)."""
    from compgen.model.compiled import field_kernel

    used = [
        tuple(group for group in table.groups if tool_mm is not None or group <= max(COORDINATES)) for table in tables
    ]
    offsets = tuple(
        (*(_ROW * groups.index(group) if group in groups else -1 for group in range(7)), _ROW * len(groups))
        for groups in used
    )
    axes = tuple(_axis(table, groups) for table, groups in zip(tables, used, strict=True))
    tool = np.zeros((1, 3)) if tool_mm is None else np.ascontiguousarray(tool_mm)
    field_kernel(offsets, _even(tables), tool_mm is not None)(axes, _apart(position_mm, out), _apart(tool, out), out)


def field_on_grid(at_levels: Sequence[FloatArray], levels_mm: Sequence[FloatArray], out: FloatArray) -> None:
    """Write E = C P on a grid to ``out`` (nx, ny, nz, 3), from the tables at the levels, each (n, 4, 3)."""
    from compgen.model.compiled import grid_kernel

    levels, values = map(np.ascontiguousarray, levels_mm), map(np.ascontiguousarray, at_levels)
    grid_kernel(bool(np.any(at_levels[2][:, 2])))(*levels, *values, out)


def exact_at(
    tables: AxisTables,
    order: Sequence[tuple[int, bool]],
    tilt: FloatArray,
    position_mm: FloatArray,
    tool_mm: FloatArray,
    out: FloatArray,
) -> None:
    """Write the exact error at points (n, 3) with tool offsets (1, 3) or (n, 3) to ``out`` (n, 3)."""
    from compgen.model.compiled import exact_kernel

    axes = tuple(_axis(table, (0, 1)) for table in tables)
    passed = np.array([axis for axis, _ in order]), np.array([side for _, side in order])
    exact_kernel()(
        axes,
        np.array(_even(tables)),
        *passed,
        tilt,
        _apart(position_mm, out),
        _apart(np.ascontiguousarray(tool_mm), out),
        out,
    )


def _apart(values: FloatArray, out: FloatArray) -> FloatArray:
    """Return C-ordered values that do not share memory with ``out``: kernels write ahead of what they read."""
    return values.copy() if np.may_share_memory(values, out) else np.ascontiguousarray(values)
