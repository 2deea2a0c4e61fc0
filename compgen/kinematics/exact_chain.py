"""Finite rotations multiplied along the chain: the exact error, at one point or many."""

from __future__ import annotations

import math

import numpy as np

from compgen.data.arguments import of_kind
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import ERROR_INDEX, ERRORS
from compgen.kinematics.first_order import tool_of
from compgen.kinematics.kernel_switch import SERIES_BELOW, use_compiled
from compgen.kinematics.many_points import (
    AxisTable,
    blocks,
    checked_out,
    checked_points,
    exact_at,
    motion_tables,
    volumetric_error,
)

# The small rotation: R(eps) of a rotation vector eps in rad, and its derivative. These formulas are only here.
#
# With a = |eps| and [eps]x the matrix of the cross product (Rodrigues; Chirikjian 2011, Stochastic Models 2, section 10.6)
#
#     R   = 1 + f1 [eps]x + f2 [eps]x^2,   f1 = sin(a)/a,         f2 = (1 - cos(a))/a^2
#     J_l = 1 + f2 [eps]x + f3 [eps]x^2,   f3 = (a - sin(a))/a^3, R(eps + d) = R(J_l d) R(eps) to first order in d
#
# Kernels take f1 and f2 from the same series (``rotation_factors`` of :mod:`compgen.kinematics.compiled_kernels`).


#: A vector at n points, by component.
Vector = list[FloatArray]


def rotation_factors(square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """f1 and f2 for the squares of angles (n,) in rad^2, without loss of digits for small angles."""
    first = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
    second = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    large = square >= SERIES_BELOW
    if large.any():
        angle = np.sqrt(square[large])
        first[large] = np.sin(angle) / angle
        second[large] = 2.0 * (np.sin(0.5 * angle) / angle) ** 2
    return first, second


def rotate(eps_rad: FloatArray, vectors: FloatArray) -> FloatArray:
    """Turn vectors (n, 3), or every column of (n, 3, k), by rotation vectors (n, 3)."""
    return np.stack([one.T for one in _rotated(list(eps_rad.T), [vectors[:, k].T for k in range(3)])], axis=1)


def _rotated(eps: Vector, vectors: Vector) -> Vector:
    """R(eps) v by components: of a rotation vector (n,), of one or more vectors (..., n)."""
    first, second = rotation_factors(np.einsum("in,in->n", eps, eps))
    once = _cross(eps, vectors)
    return [v + first * a + second * b for v, a, b in zip(vectors, once, _cross(eps, once), strict=True)]


def level_rotations(eps_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation matrices R and left Jacobians J_l, each (n, 3, 3), of rotation vectors (n, 3)."""
    square = np.einsum("ij,ij->i", eps_rad, eps_rad)
    first, second = rotation_factors(square)
    third = 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0)
    large = square >= SERIES_BELOW
    third[large] = (1.0 - first[large]) / square[large]
    cross = cross_matrices(eps_rad)
    twice = cross @ cross
    identity = np.eye(3)
    rotation = identity + first[:, None, None] * cross + second[:, None, None] * twice
    return rotation, identity + second[:, None, None] * cross + third[:, None, None] * twice


def rotation_derivative(eps_rad: FloatArray, turned: FloatArray) -> FloatArray:
    """d(R(eps) v)/d eps = -[R v]x J_l(eps), shape (n, 3, 3); ``turned`` (n, 3) is R v."""
    jacobian = level_rotations(eps_rad)[1]
    return -np.stack(_cross(list(turned.T[:, :, None]), [jacobian[:, k] for k in range(3)]), axis=1)


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) of the cross product with vectors (n, 3) from the left."""
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, 2, 1], matrices[:, 0, 2], matrices[:, 1, 0] = vectors.T
    matrices[:, 1, 2], matrices[:, 2, 0], matrices[:, 0, 1] = -vectors.T
    return matrices


# The exact model: finite rotations multiplied along the chain (Zha & Zhang 2024, eq. 1-6, without linearising).
#
# Position of the tool tip in the workpiece frame. Starting from the tool offset t, each body is passed once:
#
# * tool side, from the tool to the foundation:   x -> q a + delta + R(eps) x
# * workpiece side, from the foundation outwards: x -> R(eps) (x + q a + delta)
#
# with q the commanded travel, a the axis direction turned by its squareness, delta and eps the small motion of the
# carriage. A workpiece-side carriage is at -q with small motion (-delta, -eps), hence the inverse above.


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


def passing_order(machine: Machine) -> list[tuple[int, bool]]:
    """Axes in the order in which a point passes them from tool to workpiece, with True for the tool side."""
    chain = machine.chain
    return [(axis, True) for axis in reversed(chain.tool_side)] + [(axis, False) for axis in chain.workpiece_side]


def travel_vectors(machine: Machine, values: FloatArray, position_mm: FloatArray) -> list[FloatArray]:
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
    travel = travel_vectors(machine, values, position_mm)
    tip = np.broadcast_to(tool_of(machine, tool_mm), position_mm.shape)
    for axis, tool_side in passing_order(machine):
        delta, eps = values[:, 6 * axis : 6 * axis + 3], values[:, 6 * axis + 3 : 6 * axis + 6]
        tip = travel[axis] + delta + rotate(eps, tip) if tool_side else rotate(eps, tip + travel[axis] + delta)
    return tip


#: The squareness errors that turn the direction of an axis: name, component and sign of the rotation vector.
_TURNED_BY = ((("EC0Y", 2, -1.0),), (("EC0Y", 2, 1.0),), (("EA0Z", 0, 1.0), ("EB0Z", 1, 1.0)))


def exact_columns(
    machine: Machine, values: FloatArray, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Tool tip (n, 3) and its derivative by the 21 errors (n, 3, 21), at errors ``values`` (n, 21).

    At zero errors the derivative is C of :func:`compgen.kinematics.first_order.c_matrix`.
    """
    travel = travel_vectors(machine, values, position_mm)
    turns = _squareness_vectors(machine, values)
    tip = np.array(np.broadcast_to(tool_of(machine, tool_mm), position_mm.shape))
    # derivatives by component and error, in the order in which the bodies are passed: the others are still zero
    parts, order = np.zeros((3, len(ERRORS), len(position_mm))), list[int]()

    def turn(eps: FloatArray) -> None:
        parts[:, : len(order)] = _rotated(list(eps.T), list(parts[:, : len(order)]))

    for axis, tool_side in passing_order(machine):
        delta, eps = values[:, 6 * axis : 6 * axis + 3], values[:, 6 * axis + 3 : 6 * axis + 6]
        if tool_side:
            turned = rotate(eps, tip)
            turn(eps)
            tip = travel[axis] + delta + turned
        else:
            tip = tip + travel[axis] + delta
        angular = len(order) + 3
        parts[:, len(order) : angular] = np.eye(3)[:, :, None]
        order += range(6 * axis, 6 * axis + 6)
        # the travel vector turns with the squareness errors of its axis
        if axis == 2 or machine.squareness_reference == "YX"[axis]:
            by_turn = rotation_derivative(turns[axis], travel[axis])
            for name, component, sign in _TURNED_BY[axis]:
                parts[:, len(order)] = sign * by_turn[:, :, component].T
                order.append(ERROR_INDEX[name])
        if not tool_side:
            tip = turned = rotate(eps, tip)
            turn(eps)
        parts[:, angular : angular + 3] += rotation_derivative(eps, turned).transpose(1, 2, 0)
    columns = np.zeros((len(position_mm), 3, len(ERRORS)))
    columns[:, :, order] = parts[:, : len(order)].transpose(2, 0, 1)
    return tip, columns


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


# The exact model at many points, in blocks of constant memory.
#
# The same chain as :func:`tip_position`, but only for the error: with x = nominal + error, each body adds its motion to
# the error, and no digits are lost in the difference of two large coordinates:
#
# * tool side:       error <- error + delta + q (a - axis) + (R - 1)(nominal + error),  then nominal <- nominal + q axis
# * workpiece side:  nominal <- nominal + q axis,  error <- error + delta + q (a - axis),
#                    then error <- error + (R - 1)(nominal + error)


#: From this number of points on, loading the kernels pays off for a single call.
_POINTS_FOR_KERNELS = 5_000_000
_SQUARENESS = ("EC0Y", "EB0Z", "EA0Z")


def exact_error(
    machine: Machine,
    errors: ErrorTable,
    position_mm: FloatArray,
    tool_mm: FloatArray | None = None,
    out: FloatArray | None = None,
) -> FloatArray:
    """Exact error of the tool tip at commanded positions (n, 3): tip minus (position + tool offset), (n, 3), mm.

    Parameters and result are those of :func:`volumetric_error`.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> leaning = compgen.ErrorTable(squareness={"EC0Y": (2903e-6, 0.0)})
    >>> position_mm = np.array([[0.0, -1000.0, 0.0]])
    >>> compgen.exact_error(machine, leaning, position_mm).round(4).tolist()
    [[2.903, 0.0042, 0.0]]
    """
    position = checked_points(machine, errors, position_mm)
    result = checked_out(out, position.shape)
    tool = np.atleast_2d(tool_of(machine, tool_mm, len(position)))
    tables, order = motion_tables(errors), passing_order(machine)
    squareness = np.array([errors.squareness.get(name, (0.0, 0.0))[0] for name in _SQUARENESS])
    tilt = travel_directions(machine, squareness)[0] - np.eye(3)
    if use_compiled(len(position), _POINTS_FOR_KERNELS):
        exact_at(tables, order, tilt, position, tool, result)
        return result
    for part in blocks(len(position)):
        coordinates = np.ascontiguousarray(position[part].T)
        nominal = list(np.array(np.broadcast_to(tool if len(tool) == 1 else tool[part], position[part].shape).T))
        error = list(np.zeros_like(coordinates))
        for axis, tool_side in order:
            q, motion = coordinates[axis], _motion(tables[axis], coordinates[axis])
            moved = [own + q * turned if turned else own for own, turned in zip(motion[:3], tilt[axis], strict=True)]
            if not tool_side:
                nominal[axis] += q
                error = _sum(error, moved)
            error = _sum(error, _turned(motion[3:], nominal, error))
            if tool_side:
                nominal[axis] += q
                error = _sum(error, moved)
        for k in range(3):
            result[part, k] = error[k]
    return result


def _motion(table: AxisTable, coordinate: FloatArray) -> Vector:
    """Translation and rotation vector of one axis: six components, each (m,)."""
    motion = list(np.zeros((6, len(coordinate))))
    cell, share = table.index.locate(coordinate)
    left = np.empty_like(coordinate)
    for channel in table.channels:
        value = motion[3 * channel.group + channel.output]
        channel.step.take(cell, mode="clip", out=value)
        value *= share
        channel.left.take(cell, mode="clip", out=left)
        value += left
    return motion


def _sum(first: Vector, second: Vector) -> Vector:
    return [a + b for a, b in zip(first, second, strict=True)]


def _turned(eps: Vector, nominal: Vector, error: Vector) -> Vector:
    """R(eps) x - x for x = nominal + error, by Rodrigues' formula; components (m,)."""
    first, second = rotation_factors(eps[0] * eps[0] + eps[1] * eps[1] + eps[2] * eps[2])
    once = _cross(eps, _sum(nominal, error))
    return [first * a + second * b for a, b in zip(once, _cross(eps, once), strict=True)]


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


# Predicted errors at given points: what ``volcomp predict`` computes.


def predict(machine: Machine, errors: ErrorTable, points: Points, *, exact: bool = False) -> FloatArray:
    """Return the error of the tool tip at commanded points, shape (n, 3), mm; warns outside the range of the curves.

    Parameters
    ----------
    machine, errors, points : the machine, its errors, and the commanded points.
    exact : finite rotations along the chain instead of E = C P.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> leaning = compgen.ErrorTable(squareness={"EC0Y": (2903e-6, 0.0)})
    >>> points = compgen.Points(np.array([[0.0, -1000.0, 0.0]]))
    >>> compgen.predict(machine, leaning, points, exact=True).round(4).tolist()
    [[2.903, 0.0042, 0.0]]
    """
    of_kind("errors", errors, ErrorTable)
    of_kind("points", points, Points)
    errors.warn_outside(points.position_mm)
    model = exact_error if exact else volumetric_error
    return model(machine, errors, points.position_mm, points.tool_mm)
