"""The exact model at many points, in blocks of constant memory.

The same chain as :func:`compgen.model.exact.tip_position`, but of the error alone: with x = nominal + error, each body
adds its own motion to the error, and nothing is lost to the difference of two large coordinates:

* tool side:       error <- error + delta + q (a - axis) + (R - 1)(nominal + error),  then nominal <- nominal + q axis
* workpiece side:  nominal <- nominal + q axis,  error <- error + delta + q (a - axis),
                   then error <- error + (R - 1)(nominal + error)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.kernels import use_compiled
from compgen.core.machine import Machine
from compgen.model import kernels
from compgen.model.evaluate import blocks, checked_out, checked_points
from compgen.model.exact import passing_order, travel_directions
from compgen.model.rotation import rotation_factors
from compgen.model.tables import AxisTable, AxisTables, motion_tables
from compgen.model.volumetric import tool_of

#: From so many points on, loading the kernels pays for a single call.
_POINTS_FOR_KERNELS = 5_000_000
_SQUARENESS = ("EC0Y", "EB0Z", "EA0Z")

Vector = list[FloatArray]


def exact_error_at(
    machine: Machine,
    errors: ErrorTable,
    position_mm: FloatArray,
    tool_mm: FloatArray | None = None,
    out: FloatArray | None = None,
) -> FloatArray:
    """Exact error of the tool tip at commanded positions; arguments and result as ``volumetric_error_at``."""
    position = checked_points(position_mm)
    result = checked_out(out, position.shape)
    tool = np.atleast_2d(tool_of(machine, tool_mm))
    tables, order = motion_tables(errors), passing_order(machine)
    squareness = np.array([errors.squareness.get(name, (0.0, 0.0))[0] for name in _SQUARENESS])
    tilt = travel_directions(machine, squareness)[0] - np.eye(3)
    if use_compiled(len(position), _POINTS_FOR_KERNELS):
        kernels.exact_at(tables, order, tilt, position, tool, result)
        return result
    for part in blocks(len(position)):
        _exact_block(tables, order, tilt, position[part], tool if len(tool) == 1 else tool[part], result[part])
    return result


def _exact_block(
    tables: AxisTables,
    order: Sequence[tuple[int, bool]],
    tilt: FloatArray,
    position_mm: FloatArray,
    tool_mm: FloatArray,
    out: FloatArray,
) -> None:
    """Write the exact error at a few points (m, 3) with tool offsets (1, 3) or (m, 3) to ``out`` (m, 3)."""
    coordinates = np.ascontiguousarray(position_mm.T)
    nominal = list(np.array(np.broadcast_to(tool_mm, position_mm.shape).T))
    error = list(np.zeros_like(coordinates))
    for axis, tool_side in order:
        q, (delta, eps) = coordinates[axis], _motion(tables[axis], coordinates[axis])
        moved = [own + q * turned if turned else own for own, turned in zip(delta, tilt[axis], strict=True)]
        if not tool_side:
            nominal[axis] += q
            _add(error, moved)
        _add(error, _turned(eps, nominal, error))
        if tool_side:
            nominal[axis] += q
            _add(error, moved)
    for k in range(3):
        out[:, k] = error[k]


def _add(total: Vector, part: Vector) -> None:
    for k in range(3):
        total[k] += part[k]


def _motion(table: AxisTable, coordinate: FloatArray) -> tuple[Vector, Vector]:
    """Translation and rotation vector of one axis, component by component, each (m,)."""
    motion = list(np.zeros((6, len(coordinate))))
    cell, share = table.index.locate(coordinate)
    left = np.empty_like(coordinate)
    for channel in table.channels:
        value = motion[3 * channel.group + channel.output]
        channel.step.take(cell, mode="clip", out=value)
        value *= share
        channel.left.take(cell, mode="clip", out=left)
        value += left
    return motion[:3], motion[3:]


def _turned(eps: Vector, nominal: Vector, error: Vector) -> Vector:
    """R(eps) x - x for x = nominal + error, by Rodrigues' formula; components (m,)."""
    first, second = rotation_factors(eps[0] * eps[0] + eps[1] * eps[1] + eps[2] * eps[2])
    once = _cross(eps, [n + e for n, e in zip(nominal, error, strict=True)])
    return [first * a + second * b for a, b in zip(once, _cross(eps, once), strict=True)]


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
