"""Compiled kernels: E = C P at points and on grids, and the exact model, each in one pass. Needs numba.

Import through :mod:`compgen.kinematics.many_points`. A row of a table contains four numbers left of an interval and
four steps (three components and a zero): one vector instruction works on a row.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from numba import types

from compgen.kinematics.kernel_switch import SERIES_BELOW, Function, compile_for, loop

Row = tuple[float, float, float, float]

_FLOATS = types.float64[::1]
_POINTS = types.Array(types.float64, 2, "C", readonly=True)
_RESULT = types.float64[:, ::1]
#: low, high, buckets per mm, last interval, first intervals, nodes, upper ends, 1/gaps, rows
_AXIS = types.Tuple(
    (types.float64, types.float64, types.float64, types.uint64) + (types.int64[::1], _FLOATS, _FLOATS, _FLOATS, _FLOATS)
)
_AXES = types.UniTuple(_AXIS, 3)


def _inline(function: Function) -> Function:
    part: Function = numba.njit(error_model="numpy", fastmath={"contract"})(function)
    return part


@_inline
def _locate(position: Any, axis: Any, even: bool) -> Any:
    """Interval and share of its upper node, as in ``NodeIndex.locate``. Unsigned numbers need no sign test."""
    low, high, per_mm, last, start, nodes, upper, per_gap, _ = axis
    inside = low if position < low else position
    inside = high if inside > high else inside
    scaled = (inside - low) * per_mm
    bucket = np.uint64(np.int64(scaled))
    if even:
        bucket = last if bucket > last else bucket
        return bucket, scaled - np.int64(bucket)
    final = np.uint64(len(start) - 1)
    cell = np.uint64(start[final if bucket > final else bucket])
    while inside >= upper[cell]:
        cell += np.uint64(1)
    return cell, (inside - nodes[cell]) * per_gap[cell]


@_inline
def _row(rows: Any, at: Any, share: Any) -> Row:
    return (
        rows[at] + share * rows[at + np.uint64(4)],
        rows[at + np.uint64(1)] + share * rows[at + np.uint64(5)],
        rows[at + np.uint64(2)] + share * rows[at + np.uint64(6)],
        rows[at + np.uint64(3)] + share * rows[at + np.uint64(7)],
    )


@_inline
def _store(flat: Any, at: Any, row: Row) -> None:
    flat[at] = row[0]
    flat[at + np.uint64(1)] = row[1]
    flat[at + np.uint64(2)] = row[2]
    flat[at + np.uint64(3)] = row[3]


@_inline
def _plus(a: Row, b: Row) -> Row:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


@_inline
def _plus_times(a: Row, factor: Any, b: Row) -> Row:
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2], a[3] + factor * b[3]


@_inline
def _axis_terms(total: Row, axis: Any, located: Any, factors: Any, offsets: Any) -> Row:
    """Add the rows of one axis; ``offsets`` are known at compile time, so absent groups cost nothing."""
    rows, (cell, share) = axis[8], located
    at = cell * np.uint64(offsets[7])
    if offsets[0] >= 0:
        total = _plus(total, _row(rows, at + np.uint64(offsets[0]), share))
    if offsets[1] >= 0:
        total = _plus_times(total, factors[0], _row(rows, at + np.uint64(offsets[1]), share))
    if offsets[2] >= 0:
        total = _plus_times(total, factors[1], _row(rows, at + np.uint64(offsets[2]), share))
    if offsets[3] >= 0:
        total = _plus_times(total, factors[2], _row(rows, at + np.uint64(offsets[3]), share))
    if offsets[4] >= 0:
        total = _plus_times(total, factors[3], _row(rows, at + np.uint64(offsets[4]), share))
    if offsets[5] >= 0:
        total = _plus_times(total, factors[4], _row(rows, at + np.uint64(offsets[5]), share))
    if offsets[6] >= 0:
        total = _plus_times(total, factors[5], _row(rows, at + np.uint64(offsets[6]), share))
    return total


@lru_cache(maxsize=64)
def field_kernel(
    offsets: tuple[tuple[int, ...], ...], even: tuple[bool, bool, bool], tools: bool
) -> Callable[..., None]:
    """Kernel ``(axes, position, tool, out)`` of E = C P at points.

    Parameters
    ----------
    offsets : per axis the position of each of seven groups in a row (-1: absent), and the length of a row.
    even : whether the nodes of X, Y and Z are equidistant.
    tools : whether ``tool`` contains an offset for each point.
    """
    of_x, of_y, of_z = offsets
    even_x, even_y, even_z = even

    @_inline
    def at_point(axes: Any, position: Any, tool: Any, i: Any) -> Row:
        axis_x, axis_y, axis_z = axes
        x, y, z = position[i, 0], position[i, 1], position[i, 2]
        t = i if tools else 0
        factors = x, y, z, tool[t, 0], tool[t, 1], tool[t, 2]
        total = _axis_terms((0.0, 0.0, 0.0, 0.0), axis_x, _locate(x, axis_x, even_x), factors, of_x)
        total = _axis_terms(total, axis_y, _locate(y, axis_y, even_y), factors, of_y)
        return _axis_terms(total, axis_z, _locate(z, axis_z, even_z), factors, of_z)

    def kernel(axes: Any, position: Any, tool: Any, out: Any) -> None:
        flat, end = out.reshape(out.size), len(position) - 1
        for i in range(end):  # four numbers at once; the next point overwrites the fourth
            at, total = np.uint64(3 * i), at_point(axes, position, tool, i)
            _store(flat, at, total)
        if end >= 0:
            total = at_point(axes, position, tool, end)
            out[end, 0], out[end, 1], out[end, 2] = total[0], total[1], total[2]

    return compile_for(kernel, types.void(_AXES, _POINTS, _POINTS, _RESULT))


@_inline
def _four(values: Any, at: Any) -> Row:
    return values[at], values[at + np.uint64(1)], values[at + np.uint64(2)], values[at + np.uint64(3)]


@_inline
def _times(a: Row, b: Row) -> Row:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2], a[3] * b[3]


@lru_cache(maxsize=2)
def grid_kernel(tilted: bool) -> Callable[..., None]:
    """Kernel ``(x, y, z, along_x, along_y, along_z, out)`` of E = C P on a grid.

    A row along z is written as 3 nz numbers, twelve (four points) at a time: constant and slope repeat every three.
    ``tilted``: the Z axis has errors whose lever is y, so the dependence of such a row on y is not just linear.
    """

    @_inline
    def four_of_row(constant: Any, slope: Any, height: Any, own: Any, y: Any, side: Any, lane: Any, at: Any) -> Row:
        total = _plus(_four(constant, lane), _times(_four(slope, lane), _four(height, at)))
        total = _plus(total, _four(own, at))
        return _plus_times(total, y, _four(side, at)) if tilted else total

    def kernel(x: Any, y: Any, z: Any, along_x: Any, along_y: Any, along_z: Any, out: Any) -> None:
        constant, slope, flat, start = np.empty(12), np.empty(12), out.reshape(out.size), np.uint64(0)
        length, eight = np.uint64(3 * len(z)), np.uint64(8)
        own, side, height = np.empty(3 * len(z)), np.empty(3 * len(z)), np.empty(3 * len(z))
        zero, three, four, twelve = np.uint64(0), np.uint64(3), np.uint64(4), np.uint64(12)
        for k in range(len(z)):
            for o in range(3):
                side[3 * k + o] = along_z[k, 2, o]
                height[3 * k + o] = z[k]
        for i in range(len(x)):
            for k in range(len(z)):
                for o in range(3):
                    own[3 * k + o] = along_z[k, 0, o] + z[k] * along_z[k, 3, o] + x[i] * along_z[k, 1, o]
            for j in range(len(y)):
                for o in range(3):  # constant and slope along z, from the tables (4, 3) at x and y
                    of_x = along_x[i, 0, o] + x[i] * along_x[i, 1, o] + y[j] * along_x[i, 2, o]
                    p = of_x + along_y[j, 0, o] + x[i] * along_y[j, 1, o] + y[j] * along_y[j, 2, o]
                    q = along_x[i, 3, o] + along_y[j, 3, o]
                    for k in range(o, 12, 3):
                        constant[k], slope[k] = p, q
                at = zero
                while at + twelve <= length:
                    for lane in (zero, four, eight):
                        _store(flat, start + at, four_of_row(constant, slope, height, own, y[j], side, lane, at))
                        at += four
                while at < length:
                    for o in range(three):
                        value = constant[o] + slope[o] * height[at] + own[at + o]
                        flat[start + at + o] = value + y[j] * side[at + o] if tilted else value
                    at += three
                start += length

    levels = types.Array(types.float64, 1, "C", readonly=True)
    values = types.Array(types.float64, 3, "C", readonly=True)
    return compile_for(kernel, types.void(levels, levels, levels, values, values, values, types.float64[:, :, :, ::1]))


@_inline
def rotation_factors(square: Any) -> Any:
    """f1 and f2 of :mod:`compgen.kinematics.exact_chain` for the square of one angle."""
    if square < SERIES_BELOW:
        first = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        second = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    else:
        angle = np.sqrt(square)
        first = np.sin(angle) / angle
        second = 2.0 * (np.sin(0.5 * angle) / angle) ** 2
    return first, second


@loop(fastmath=False)
def level_rotation(eps: Any, rotation: Any, jacobian: Any) -> None:
    """Fill in rotation matrix and left Jacobian, each (3, 3), of one rotation vector (3,), as ``level_rotations``."""
    x, y, z = eps[0], eps[1], eps[2]
    square = x * x + y * y + z * z
    first, second = rotation_factors(square)
    third = (1.0 - first) / square if square >= SERIES_BELOW else 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0)
    rotation[0, 0], rotation[1, 1], rotation[2, 2] = 0.0, 0.0, 0.0
    rotation[2, 1], rotation[0, 2], rotation[1, 0] = x, y, z
    rotation[1, 2], rotation[2, 0], rotation[0, 1] = -x, -y, -z
    for i in range(3):
        for j in range(3):
            cross = rotation[i, j]
            twice = eps[i] * eps[j] - (square if i == j else 0.0)
            same = 1.0 if i == j else 0.0
            rotation[i, j] = same + first * cross + second * twice
            jacobian[i, j] = same + second * cross + third * twice


@_inline
def _turned(eps: Row, v: Row) -> Row:
    """R(eps) v - v."""
    a, b, c, _ = eps
    first, second = rotation_factors(a * a + b * b + c * c)
    once = b * v[2] - c * v[1], c * v[0] - a * v[2], a * v[1] - b * v[0]
    twice = b * once[2] - c * once[1], c * once[0] - a * once[2], a * once[1] - b * once[0]
    return (
        first * once[0] + second * twice[0],
        first * once[1] + second * twice[1],
        first * once[2] + second * twice[2],
        0.0,
    )


def _exact(axes: Any, even: Any, order: Any, tool_side: Any, tilt: Any, position: Any, tool: Any, out: Any) -> None:
    """Exact error at points; ``order`` (3,) and ``tool_side`` (3,) as ``passing_order``, ``tilt`` = directions - I.

    ``tool`` has one row, or one per point.
    """
    single = len(tool) == 1
    for i in range(len(position)):
        t = 0 if single else i
        nominal = tool[t, 0], tool[t, 1], tool[t, 2], 0.0
        error = 0.0, 0.0, 0.0, 0.0
        for body in range(3):
            axis = order[body]
            q = position[i, axis]
            cell, share = _locate(q, axes[axis], even[axis])
            at = cell * np.uint64(16)
            delta = _row(axes[axis][8], at, share)
            eps = _row(axes[axis][8], at + np.uint64(8), share)
            moved = _plus_times(delta, q, (tilt[axis, 0], tilt[axis, 1], tilt[axis, 2], 0.0))
            travel = q if axis == 0 else 0.0, q if axis == 1 else 0.0, q if axis == 2 else 0.0, 0.0
            if tool_side[body]:
                error = _plus(error, _plus(moved, _turned(eps, _plus(nominal, error))))
                nominal = _plus(nominal, travel)
            else:
                nominal, error = _plus(nominal, travel), _plus(error, moved)
                error = _plus(error, _turned(eps, _plus(nominal, error)))
        out[i, 0], out[i, 1], out[i, 2] = error[0], error[1], error[2]


@lru_cache(maxsize=1)
def exact_kernel() -> Callable[..., None]:
    """Kernel ``(axes, even, order, tool_side, tilt, position, tool, out)`` of the exact model."""
    arguments = (_AXES, types.boolean[::1], types.int64[::1], types.boolean[::1], _RESULT, _POINTS, _POINTS, _RESULT)
    return compile_for(_exact, types.void(*arguments))
