"""Compiled passes along the chain on a grid of levels (numba): cost and gradient, and distances.

Loops over a whole plane write one array each, and divide without checks, so that they run in vector registers.
"""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.kernels import FAST, loop
from compgen.identify.state import IntArray
from compgen.model.compiled import rotation_factors
from compgen.model.rotation import SERIES_BELOW


@loop(fastmath=False)
def _rotation(eps: FloatArray, rotation: FloatArray, jacobian: FloatArray) -> None:
    """Rotation matrix and left Jacobian of SO(3), each (3, 3), of a rotation vector (3,) in rad."""
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


@loop(fastmath=FAST)
def carriages(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    chain: IntArray,
    levels: FloatArray,
    directions: FloatArray,
    rows: IntArray,
    columns: IntArray,
    values: FloatArray,
    errors: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotation (levels, 3, 3), left Jacobian (levels, 3, 3) and shift (levels, 3) of the carriages at all levels.

    ``chain`` (4, 3): axes from the innermost body to the outermost, then by axis the row of its first level, the number
    of its levels, and 1 for the tool side. ``levels`` (levels,) in mm, those of X, Y, Z in a row. ``rows``, ``columns``,
    ``values`` are the entries of the map from errors to delta and eps of each level.
    """
    count = len(levels)
    motion = np.zeros(6 * count)
    for k in range(len(rows)):
        motion[rows[k]] += values[k] * errors[columns[k]]
    rotation, jacobian = np.empty((count, 3, 3)), np.empty((count, 3, 3))
    shift = np.empty((count, 3))
    for axis in range(3):
        for row in range(chain[1, axis], chain[1, axis] + chain[2, axis]):
            _rotation(motion[6 * row + 3 : 6 * row + 6], rotation[row], jacobian[row])
            for i in range(3):
                shift[row, i] = levels[row] * directions[axis, i] + motion[6 * row + i]
    return rotation, jacobian, shift


@loop(fastmath=FAST)
def _carry(rotation: FloatArray, shift: FloatArray, tool_side: bool, before: FloatArray, after: FloatArray) -> None:
    """Pass points (3, m) through one body: shift + R x on the tool side, R (x + shift) on the workpiece side."""
    for i in range(3):
        a, b, c = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        constant = shift[i] if tool_side else a * shift[0] + b * shift[1] + c * shift[2]
        x, y, z, out = before[0], before[1], before[2], after[i]
        for m in range(before.shape[1]):
            out[m] = constant + (a * x[m] + b * y[m] + c * z[m])


@loop(fastmath=FAST)
def inner_points(
    chain: IntArray, rotation: FloatArray, shift: FloatArray, tool: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Points after the innermost body (3, n_in) and after the middle one (3, n_mid * n_in)."""
    axis_in, axis_mid = chain[0, 0], chain[0, 1]
    n_in, n_mid = chain[2, axis_in], chain[2, axis_mid]
    inner, middle = np.empty((3, n_in)), np.empty((3, n_mid * n_in))
    start = np.empty((3, 1))
    for i in range(3):
        start[i, 0] = tool[i]
    for c in range(n_in):
        row = chain[1, axis_in] + c
        _carry(rotation[row], shift[row], chain[3, axis_in] == 1, start, inner[:, c : c + 1])
    for b in range(n_mid):
        row = chain[1, axis_mid] + b
        _carry(rotation[row], shift[row], chain[3, axis_mid] == 1, inner, middle[:, b * n_in : (b + 1) * n_in])
    return inner, middle


@loop(fastmath=FAST)
def plane_of_tips(
    chain: IntArray, rotation: FloatArray, shift: FloatArray, middle: FloatArray, level: int, tip: FloatArray
) -> None:
    """Tips (3, n_mid * n_in) at one level of the outermost body."""
    axis = chain[0, 2]
    row = chain[1, axis] + level
    _carry(rotation[row], shift[row], chain[3, axis] == 1, middle, tip)


@loop(fastmath=FAST)
def _pull(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    rotation: FloatArray,
    shift: FloatArray,
    tool_side: bool,
    before: FloatArray,
    force: FloatArray,
    back: FloatArray,
    motion: FloatArray,
) -> None:
    """Pull forces (3, m) back through one body: adds to ``back`` (3, m) and to delta and moment in ``motion`` (6,)."""
    fx, fy, fz = force[0], force[1], force[2]
    turned = np.empty(force.shape)
    for i in range(3):
        a, b, c = rotation[0, i], rotation[1, i], rotation[2, i]
        here, sum_back = turned[i], back[i]
        for m in range(force.shape[1]):
            here[m] = a * fx[m] + b * fy[m] + c * fz[m]
        for m in range(force.shape[1]):
            sum_back[m] += here[m]
    tx, ty, tz = turned[0], turned[1], turned[2]
    x, y, z = before[0], before[1], before[2]
    total_x = total_y = total_z = moment_x = moment_y = moment_z = 0.0
    for m in range(force.shape[1]):
        total_x += tx[m]
        total_y += ty[m]
        total_z += tz[m]
        moment_x += y[m] * tz[m] - z[m] * ty[m]
        moment_y += z[m] * tx[m] - x[m] * tz[m]
        moment_z += x[m] * ty[m] - y[m] * tx[m]
    if tool_side:
        for i in range(3):
            motion[i] += rotation[i, 0] * total_x + rotation[i, 1] * total_y + rotation[i, 2] * total_z
    else:
        motion[0] += total_x
        motion[1] += total_y
        motion[2] += total_z
        moment_x += shift[1] * total_z - shift[2] * total_y
        moment_y += shift[2] * total_x - shift[0] * total_z
        moment_z += shift[0] * total_y - shift[1] * total_x
    motion[3] += moment_x
    motion[4] += moment_y
    motion[5] += moment_z


@loop(fastmath=FAST)
def _forces(
    tip: FloatArray,
    station: FloatArray,
    dead: float,
    weight: FloatArray,
    length: FloatArray,
    share: FloatArray,
    force: FloatArray,
) -> tuple[float, float, float, float, float]:
    """Cost and gradient by station and dead length of one plane (m,) of readings; adds to ``force`` (3, m)."""
    tx, ty, tz = tip[0], tip[1], tip[2]
    sx, sy, sz = station[0], station[1], station[2]
    cost = by_dead = by_x = by_y = by_z = 0.0
    for m in range(len(weight)):
        x, y, z = tx[m] - sx, ty[m] - sy, tz[m] - sz
        distance = np.sqrt(x * x + y * y + z * z + 1e-200)  # never zero where a cell without reading meets the station
        residual = distance - length[m] - dead
        pull = weight[m] * residual
        cost += pull * residual
        by_dead += pull
        pull /= distance
        by_x += x * pull
        by_y += y * pull
        by_z += z * pull
        share[m] = pull
    for i in range(3):
        place, out = tip[i], force[i]
        own = station[i]
        for m in range(len(weight)):
            out[m] += share[m] * (place[m] - own)
    return cost, by_x, by_y, by_z, by_dead


@loop(fastmath=FAST)
def chain_gradient(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    chain: IntArray,
    levels: FloatArray,
    directions: FloatArray,
    derivatives: FloatArray,
    rows: IntArray,
    columns: IntArray,
    values: FloatArray,
    errors: FloatArray,
    squareness: IntArray,
    tool: FloatArray,
    stations: FloatArray,
    dead: FloatArray,
    station_of: IntArray,
    weight: FloatArray,
    length: FloatArray,
    gradient: FloatArray,
) -> float:
    """Cost of the readings of one tool (groups, n_out, n_mid * n_in); adds its ``gradient`` (size,).

    The first arguments as in :func:`carriages`; ``directions`` and ``derivatives`` as ``model.exact.travel_directions``
    returns them; ``squareness`` (3,) is the place of EC0Y, EB0Z, EA0Z among the unknowns, -1 where it is none.
    """
    rotation, jacobian, shift = carriages(chain, levels, directions, rows, columns, values, errors)
    inner, middle = inner_points(chain, rotation, shift, tool)
    axis_in, axis_mid, axis_out = chain[0, 0], chain[0, 1], chain[0, 2]
    n_in, n_mid = chain[2, axis_in], chain[2, axis_mid]
    by_motion = np.zeros((len(levels), 6))
    back_middle, back_inner, back_tool = np.zeros(middle.shape), np.zeros((3, n_in)), np.zeros((3, 1))
    tip, force, share = np.empty(middle.shape), np.empty(middle.shape), np.empty(middle.shape[1])
    first, second = len(errors), len(errors) + stations.size
    cost = 0.0
    for level in range(chain[2, axis_out]):
        plane_of_tips(chain, rotation, shift, middle, level, tip)
        for i in range(3):
            out = force[i]
            for m in range(len(out)):
                out[m] = 0.0
        for g in range(len(station_of)):
            s = station_of[g]
            part, by_x, by_y, by_z, by_dead = _forces(
                tip, stations[s], dead[g], weight[g, level], length[g, level], share, force
            )
            cost += part
            gradient[first + 3 * s] -= by_x
            gradient[first + 3 * s + 1] -= by_y
            gradient[first + 3 * s + 2] -= by_z
            gradient[second + g] -= by_dead
        row = chain[1, axis_out] + level
        _pull(rotation[row], shift[row], chain[3, axis_out] == 1, middle, force, back_middle, by_motion[row])
    for b in range(n_mid):
        row, own = chain[1, axis_mid] + b, slice(b * n_in, (b + 1) * n_in)
        side = chain[3, axis_mid] == 1
        _pull(rotation[row], shift[row], side, inner, back_middle[:, own], back_inner, by_motion[row])
    start = np.empty((3, 1))
    for i in range(3):
        start[i, 0] = tool[i]
    for c in range(n_in):
        row, side = chain[1, axis_in] + c, chain[3, axis_in] == 1
        _pull(rotation[row], shift[row], side, start, back_inner[:, c : c + 1], back_tool, by_motion[row])
    _by_unknowns(chain, levels, derivatives, rows, columns, values, squareness, rotation, jacobian, by_motion, gradient)
    return 0.5 * cost


@loop(fastmath=FAST)
def _by_unknowns(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    chain: IntArray,
    levels: FloatArray,
    derivatives: FloatArray,
    rows: IntArray,
    columns: IntArray,
    values: FloatArray,
    squareness: IntArray,
    rotation: FloatArray,
    jacobian: FloatArray,
    by_motion: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the gradient by the errors, from that by delta and by the moments at the levels (levels, 6)."""
    turned = np.empty(3)
    for row in range(len(levels)):
        motion = by_motion[row]
        for i in range(3):
            turned[i] = (
                rotation[row, i, 0] * motion[3] + rotation[row, i, 1] * motion[4] + rotation[row, i, 2] * motion[5]
            )
        for i in range(3):
            motion[3 + i] = (
                jacobian[row, 0, i] * turned[0] + jacobian[row, 1, i] * turned[1] + jacobian[row, 2, i] * turned[2]
            )
    flat = by_motion.ravel()
    for k in range(len(rows)):
        gradient[columns[k]] += values[k] * flat[rows[k]]
    for axis in range(3):
        for i in range(3):
            along = 0.0
            for row in range(chain[1, axis], chain[1, axis] + chain[2, axis]):
                along += levels[row] * by_motion[row, i]
            for k in range(3):
                if squareness[k] >= 0:
                    gradient[squareness[k]] += along * derivatives[axis, i, k]


@loop(fastmath=FAST)
def chain_distances(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    chain: IntArray,
    levels: FloatArray,
    directions: FloatArray,
    rows: IntArray,
    columns: IntArray,
    values: FloatArray,
    errors: FloatArray,
    tool: FloatArray,
    stations: FloatArray,
    station_of: IntArray,
    distance: FloatArray,
) -> None:
    """Fill in the distances (groups, n_out, n_mid * n_in) of stations and tips, mm; arguments as above."""
    rotation, _, shift = carriages(chain, levels, directions, rows, columns, values, errors)
    _, middle = inner_points(chain, rotation, shift, tool)
    tip = np.empty(middle.shape)
    tx, ty, tz = tip[0], tip[1], tip[2]
    for level in range(distance.shape[1]):
        plane_of_tips(chain, rotation, shift, middle, level, tip)
        for g in range(len(station_of)):
            s = station_of[g]
            sx, sy, sz = stations[s, 0], stations[s, 1], stations[s, 2]
            out = distance[g, level]
            for m in range(len(out)):
                x, y, z = tx[m] - sx, ty[m] - sy, tz[m] - sz
                out[m] = np.sqrt(x * x + y * y + z * z)
