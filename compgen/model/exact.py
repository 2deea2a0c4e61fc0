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
from compgen.model.volumetric import tool_of


def _sine_ratios(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """sin(a)/a and (1 - cos(a))/a^2, without loss of digits for small angles."""
    return np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2


def rotate(eps_rad: FloatArray, vector: FloatArray) -> FloatArray:
    """Turn vectors (n, 3) by rotation vectors (n, 3) in rad (Rodrigues' formula)."""
    first, second = _sine_ratios(np.linalg.norm(eps_rad, axis=1))
    once = np.cross(eps_rad, vector)
    return vector + first[:, None] * once + second[:, None] * np.cross(eps_rad, once)


def _turn_columns(eps_rad: FloatArray, columns: FloatArray) -> FloatArray:
    """Turn every column of (n, 3, k) by the rotation vectors (n, 3)."""
    first, second = _sine_ratios(np.linalg.norm(eps_rad, axis=1))
    eps = eps_rad[:, :, None]
    once = np.cross(eps, columns, axis=1)
    return columns + first[:, None, None] * once + second[:, None, None] * np.cross(eps, once, axis=1)


def _rotation_derivative(eps_rad: FloatArray, turned: FloatArray) -> FloatArray:
    """d(R(eps) v)/d eps = -[R v]x J_l(eps), shape (n, 3, 3); ``turned`` is R v. J_l: left Jacobian of SO(3)."""
    angle = np.linalg.norm(eps_rad, axis=1)
    _, second = _sine_ratios(angle)
    third = 1 / 6 - angle**2 / 120  # (a - sin a)/a^3, exact to 1e-9 for a < 0.03 rad
    identity = np.broadcast_to(np.eye(3), (len(eps_rad), 3, 3))
    eps = eps_rad[:, :, None]
    once = np.cross(eps, identity, axis=1)
    left = identity + second[:, None, None] * once + third[:, None, None] * np.cross(eps, once, axis=1)
    return -np.cross(turned[:, :, None], left, axis=1)


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
            columns = _turn_columns(eps, columns)
            tip = travel[axis] + delta + turned
        else:
            tip = tip + travel[axis] + delta
        columns[:, :, linear] += np.eye(3)
        _add_squareness(machine, columns, turns[axis], travel[axis], axis)
        if not tool_side:
            tip = turned = rotate(eps, tip)
            columns = _turn_columns(eps, columns)
        columns[:, :, angular] += _rotation_derivative(eps, turned)
    return tip, columns


def _add_squareness(machine: Machine, columns: FloatArray, turn: FloatArray, travel: FloatArray, axis: int) -> None:
    """Add the derivative of the travel vector of ``axis`` by the squareness errors that turn it."""
    if axis == 0 and machine.squareness_reference == "Y":
        columns[:, :, ERROR_INDEX["EC0Y"]] -= _rotation_derivative(turn, travel)[:, :, 2]
    elif axis == 1 and machine.squareness_reference == "X":
        columns[:, :, ERROR_INDEX["EC0Y"]] += _rotation_derivative(turn, travel)[:, :, 2]
    elif axis == 2:
        derivative = _rotation_derivative(turn, travel)
        columns[:, :, ERROR_INDEX["EA0Z"]] += derivative[:, :, 0]
        columns[:, :, ERROR_INDEX["EB0Z"]] += derivative[:, :, 1]


def rotation_matrices(eps_rad: FloatArray) -> FloatArray:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3) in rad."""
    return level_rotations(eps_rad)[0]


def level_rotations(eps_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation matrices and left Jacobians J_l of SO(3), each (n, 3, 3), of rotation vectors (n, 3) in rad.

    R(eps + d) = R(J_l d) R(eps) to first order in d.
    """
    square = np.einsum("ij,ij->i", eps_rad, eps_rad)
    if square.size and square.max() > 1e-4:
        first, second = _sine_ratios(np.sqrt(square))
    else:  # the series is exact to the last digit for angles below 0.01 rad
        first = 1 - square / 6 * (1 - square / 20)
        second = 0.5 - square / 24 * (1 - square / 30)
    cross = cross_matrices(eps_rad)
    twice = cross @ cross
    identity = np.eye(3)
    rotation = identity + first[:, None, None] * cross + second[:, None, None] * twice
    jacobian = identity + second[:, None, None] * cross + (1 / 6 - square / 120)[:, None, None] * twice
    return rotation, jacobian


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) of the cross product with vectors (n, 3) from the left."""
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, 2, 1], matrices[:, 0, 2], matrices[:, 1, 0] = vectors.T
    matrices[:, 1, 2], matrices[:, 2, 0], matrices[:, 0, 1] = -vectors.T
    return matrices


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
