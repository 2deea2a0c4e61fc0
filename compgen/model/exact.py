"""The exact model: finite rotations multiplied along the chain (Zha & Zhang 2024, eq. 1-6, without linearising).

Position of the tool tip in the workpiece frame. Starting from the tool offset t, each body is passed once:

* tool side, from the tool to the foundation:   x -> q a + delta + R(eps) x
* workpiece side, from the foundation outwards: x -> R(eps) (x + q a + delta)

with q the commanded travel, a the axis direction turned by its squareness, delta and eps the small motion of the
carriage. A workpiece-side carriage stands at -q with small motion (-delta, -eps), hence the inverse above.
"""

from __future__ import annotations

import math

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_INDEX, ERRORS
from compgen.model.rotation import rotate, rotation_derivative
from compgen.model.volumetric import tool_of


def _squareness_vectors(machine: Machine, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotation vectors, each (n, 3), that turn the axis directions X, Y, Z away from the ideal ones."""
    turns = np.zeros((3, len(values), 3))
    c0y = values[:, ERROR_INDEX["EC0Y"]]
    if machine.squareness_reference == "Y":
        turns[0, :, 2] = -c0y
    else:
        turns[1, :, 2] = c0y
    turns[2, :, 0] = values[:, ERROR_INDEX["EA0Z"]]
    turns[2, :, 1] = values[:, ERROR_INDEX["EB0Z"]]
    return turns[0], turns[1], turns[2]


def _bodies(machine: Machine) -> list[tuple[int, bool]]:
    """Axes in the order in which a point passes them from tool to workpiece, with True for the tool side."""
    chain = machine.chain
    return [(axis, True) for axis in reversed(chain.tool_side)] + [(axis, False) for axis in chain.workpiece_side]


def _travel(machine: Machine, values: FloatArray, position_mm: FloatArray) -> list[FloatArray]:
    """Travel vectors q a of the three axes, each (n, 3)."""
    units = np.eye(3)
    turns = _squareness_vectors(machine, values)
    return [
        position_mm[:, [axis]] * rotate(turns[axis], np.broadcast_to(units[axis], position_mm.shape))
        for axis in range(3)
    ]


def tip_position(
    machine: Machine, values: FloatArray, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> FloatArray:
    """Actual tool tip in the workpiece frame for errors ``values`` (n, 21) at positions (n, 3): shape (n, 3), mm."""
    travel = _travel(machine, values, position_mm)
    tip = np.broadcast_to(tool_of(machine, tool_mm), position_mm.shape)
    for axis, tool_side in _bodies(machine):
        delta, eps = values[:, 6 * axis : 6 * axis + 3], values[:, 6 * axis + 3 : 6 * axis + 6]
        tip = travel[axis] + delta + rotate(eps, tip) if tool_side else rotate(eps, tip + travel[axis] + delta)
    return tip


def exact_error(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> FloatArray:
    """Exact error of the tool tip at commanded positions (n, 3): tip minus (position + tool offset), (n, 3), mm."""
    from compgen.model.exact_points import exact_error_at  # imported here: it builds on the chain below

    return exact_error_at(machine, errors, position_mm, tool_mm)


def exact_columns(
    machine: Machine, values: FloatArray, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Tool tip (n, 3) and its derivative by the 21 errors (n, 3, 21), at errors ``values`` (n, 21).

    At zero errors the derivative is C of :func:`compgen.model.volumetric.c_matrix`.
    """
    travel = _travel(machine, values, position_mm)
    turns = _squareness_vectors(machine, values)
    tip = np.array(np.broadcast_to(tool_of(machine, tool_mm), position_mm.shape))
    columns = np.zeros((len(position_mm), 3, len(ERRORS)))
    for axis, tool_side in _bodies(machine):
        delta, eps = values[:, 6 * axis : 6 * axis + 3], values[:, 6 * axis + 3 : 6 * axis + 6]
        linear, angular = slice(6 * axis, 6 * axis + 3), slice(6 * axis + 3, 6 * axis + 6)
        if tool_side:
            turned = rotate(eps, tip)
            columns = rotate(eps, columns)
            tip = travel[axis] + delta + turned
        else:
            tip = tip + travel[axis] + delta
        columns[:, :, linear] += np.eye(3)
        _add_squareness(machine, columns, turns[axis], travel[axis], axis)
        if not tool_side:
            tip = turned = rotate(eps, tip)
            columns = rotate(eps, columns)
        columns[:, :, angular] += rotation_derivative(eps, turned)
    return tip, columns


def _add_squareness(machine: Machine, columns: FloatArray, turn: FloatArray, travel: FloatArray, axis: int) -> None:
    """Add the derivative of the travel vector of ``axis`` by the squareness errors that turn it."""
    if axis == 0 and machine.squareness_reference == "Y":
        columns[:, :, ERROR_INDEX["EC0Y"]] -= rotation_derivative(turn, travel)[:, :, 2]
    elif axis == 1 and machine.squareness_reference == "X":
        columns[:, :, ERROR_INDEX["EC0Y"]] += rotation_derivative(turn, travel)[:, :, 2]
    elif axis == 2:
        derivative = rotation_derivative(turn, travel)
        columns[:, :, ERROR_INDEX["EA0Z"]] += derivative[:, :, 0]
        columns[:, :, ERROR_INDEX["EB0Z"]] += derivative[:, :, 1]


def travel_directions(machine: Machine, squareness_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions of travel of X, Y, Z for EC0Y, EB0Z, EA0Z (3,) in rad, and their derivatives by the three.

    The directions are the unit vectors turned by the squareness, written out: a turn about Z of X or Y, and the turn
    (EA0Z, EB0Z, 0) of Z.

    Returns
    -------
    directions : shape (3, 3), one row per axis.
    derivatives : shape (3, 3, 3), [axis, component, squareness].
    """
    c0y, b0z, a0z = (float(value) for value in squareness_rad)
    directions, derivatives = np.eye(3), np.zeros((3, 3, 3))
    sine, cosine = math.sin(c0y), math.cos(c0y)
    if machine.squareness_reference == "Y":
        directions[0] = (cosine, -sine, 0.0)
        derivatives[0, :, 0] = (-sine, -cosine, 0.0)
    else:
        directions[1] = (-sine, cosine, 0.0)
        derivatives[1, :, 0] = (-cosine, -sine, 0.0)
    angle = math.hypot(a0z, b0z)
    ratio = math.sin(angle) / angle if angle > 1e-9 else 1.0
    slope = -1.0 / 3.0 if angle < 1e-3 else (math.cos(angle) - ratio) / angle**2  # (d ratio/d angle)/angle
    directions[2] = (b0z * ratio, -a0z * ratio, math.cos(angle))
    derivatives[2, :, 1] = (ratio + b0z * b0z * slope, -a0z * b0z * slope, -b0z * ratio)
    derivatives[2, :, 2] = (b0z * a0z * slope, -ratio - a0z * a0z * slope, -a0z * ratio)
    return directions, derivatives


def passing_order(machine: Machine) -> list[tuple[int, bool]]:
    """Axes in the order in which a point passes them from tool to workpiece, with True for the tool side."""
    return _bodies(machine)
