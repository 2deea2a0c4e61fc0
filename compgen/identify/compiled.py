"""Compiled inner loops of the fast path (numba, ``pip install compgen[fast]``); import only through ``kernels``."""

from __future__ import annotations

import numpy as np
from numba import njit

from compgen.core.csvio import FloatArray
from compgen.identify.state import IntArray


@njit(cache=True, fastmath={"contract"})  # type: ignore[untyped-decorator,unused-ignore]
def moments(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    tip: FloatArray,
    stations: FloatArray,
    weight: FloatArray,
    q_out: FloatArray,
    q_mid: FloatArray,
    q_in: FloatArray,
    weighted: FloatArray,
    by_out: FloatArray,
    by_mid: FloatArray,
    by_in: FloatArray,
) -> None:
    """Add the moments of w u u^T (xx, yy, zz, xy, xz, yz), w u (x, y, z) and w that the normal matrix needs.

    ``weighted`` (6, n_out, n_mid, n_in) gets w u u^T of all groups; ``by_out`` (groups, n_out, 3, 10) and the like get,
    per level, the sums times 1 and times the coordinates of the other two axes (in the order inner, mid, out).
    """
    groups = len(stations)
    value = np.empty(10)
    for g in range(groups):
        for o in range(len(q_out)):
            for b in range(len(q_mid)):
                plain = np.zeros(10)
                times_in = np.zeros(10)
                for c in range(len(q_in)):
                    m = b * len(q_in) + c
                    w = weight[g, o, m]
                    x = tip[o, 0, m] - stations[g, 0]
                    y = tip[o, 1, m] - stations[g, 1]
                    z = tip[o, 2, m] - stations[g, 2]
                    inverse = 1.0 / np.sqrt(x * x + y * y + z * z)
                    x *= inverse
                    y *= inverse
                    z *= inverse
                    wx, wy, wz = w * x, w * y, w * z
                    value[0], value[1], value[2] = wx * x, wy * y, wz * z
                    value[3], value[4], value[5] = wx * y, wx * z, wy * z
                    value[6], value[7], value[8], value[9] = wx, wy, wz, w
                    for k in range(6):
                        weighted[k, o, b, c] += value[k]
                    for k in range(10):
                        plain[k] += value[k]
                        times_in[k] += value[k] * q_in[c]
                        by_in[g, c, 0, k] += value[k]
                        by_in[g, c, 1, k] += value[k] * q_mid[b]
                        by_in[g, c, 2, k] += value[k] * q_out[o]
                for k in range(10):
                    by_out[g, o, 0, k] += plain[k]
                    by_out[g, o, 1, k] += times_in[k]
                    by_out[g, o, 2, k] += plain[k] * q_mid[b]
                    by_mid[g, b, 0, k] += plain[k]
                    by_mid[g, b, 1, k] += times_in[k]
                    by_mid[g, b, 2, k] += plain[k] * q_out[o]


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def _rotation(eps: FloatArray, rotation: FloatArray, jacobian: FloatArray) -> None:
    """Rotation matrix and left Jacobian of SO(3), each (3, 3), of a rotation vector (3,) in rad."""
    x, y, z = eps
    square = x * x + y * y + z * z
    if square > 1e-4:
        angle = np.sqrt(square)
        first = np.sin(angle) / angle
        second = (1.0 - np.cos(angle)) / square
    else:
        first = 1.0 - square / 6.0 * (1.0 - square / 20.0)
        second = 0.5 - square / 24.0 * (1.0 - square / 30.0)
    third = 1.0 / 6.0 - square / 120.0
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    for i in range(3):
        for j in range(3):
            twice = eps[i] * eps[j] - (square if i == j else 0.0)
            same = 1.0 if i == j else 0.0
            rotation[i, j] = same + first * cross[i, j] + second * twice
            jacobian[i, j] = same + second * cross[i, j] + third * twice


@njit(cache=True, fastmath={"contract"})  # type: ignore[untyped-decorator,unused-ignore]
def _carry(rotation: FloatArray, shift: FloatArray, tool_side: bool, before: FloatArray, after: FloatArray) -> None:
    """Pass one body: shift + R x on the tool side, R (x + shift) on the workpiece side."""
    for i in range(3):
        total = shift[i] if tool_side else 0.0
        for j in range(3):
            total += rotation[i, j] * (before[j] if tool_side else before[j] + shift[j])
        after[i] = total


@njit(cache=True, fastmath={"contract"})  # type: ignore[untyped-decorator,unused-ignore]
def _pull(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    rotation: FloatArray,
    shift: FloatArray,
    tool_side: bool,
    before: FloatArray,
    fx: float,
    fy: float,
    fz: float,
    back: FloatArray,
    motion: FloatArray,
) -> None:
    """Pull a force back through one body: adds to ``back`` (3,) and to delta and moment in ``motion`` (6,)."""
    tx = rotation[0, 0] * fx + rotation[1, 0] * fy + rotation[2, 0] * fz
    ty = rotation[0, 1] * fx + rotation[1, 1] * fy + rotation[2, 1] * fz
    tz = rotation[0, 2] * fx + rotation[1, 2] * fy + rotation[2, 2] * fz
    back[0] += tx
    back[1] += ty
    back[2] += tz
    x, y, z = before[0], before[1], before[2]
    if tool_side:
        motion[0] += fx
        motion[1] += fy
        motion[2] += fz
    else:
        motion[0] += tx
        motion[1] += ty
        motion[2] += tz
        x += shift[0]
        y += shift[1]
        z += shift[2]
    motion[3] += y * tz - z * ty
    motion[4] += z * tx - x * tz
    motion[5] += x * ty - y * tx


@njit(cache=True, fastmath={"contract"})  # type: ignore[untyped-decorator,unused-ignore]
def chain_gradient(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    bodies: IntArray,
    first_row: IntArray,
    counts: IntArray,
    tool_side: IntArray,
    motion: FloatArray,
    travel: FloatArray,
    tool: FloatArray,
    stations: FloatArray,
    dead: FloatArray,
    weight: FloatArray,
    length: FloatArray,
    by_motion: FloatArray,
    by_group: FloatArray,
) -> float:
    """Cost of the readings; adds its derivatives by motion (levels, 6) and by station and dead length of each group.

    ``bodies`` are the axes from the innermost to the outermost body; ``first_row`` and ``counts`` place the levels of
    X, Y, Z in ``motion`` (delta and eps of each level) and ``travel`` (levels, 3); ``tool_side`` (3,) is by axis.
    """
    rows = len(motion)
    rotation, jacobian = np.empty((rows, 3, 3)), np.empty((rows, 3, 3))
    shift = np.empty((rows, 3))
    for row in range(rows):
        _rotation(motion[row, 3:], rotation[row], jacobian[row])
        for i in range(3):
            shift[row, i] = travel[row, i] + motion[row, i]
    axis_in, axis_mid, axis_out = bodies
    n_in, n_mid, n_out = counts[axis_in], counts[axis_mid], counts[axis_out]
    r_in, r_mid, r_out = first_row[axis_in], first_row[axis_mid], first_row[axis_out]
    side_in, side_mid, side_out = tool_side[axis_in] == 1, tool_side[axis_mid] == 1, tool_side[axis_out] == 1
    inner = np.empty((n_in, 3))
    middle = np.empty((n_mid * n_in, 3))
    for c in range(n_in):
        _carry(rotation[r_in + c], shift[r_in + c], side_in, tool, inner[c])
    for b in range(n_mid):
        for c in range(n_in):
            _carry(rotation[r_mid + b], shift[r_mid + b], side_mid, inner[c], middle[b * n_in + c])
    back_middle, back_inner, back_tool = np.zeros((n_mid * n_in, 3)), np.zeros((n_in, 3)), np.zeros(3)
    tip = np.empty(3)
    groups = len(stations)
    cost = 0.0
    for a in range(n_out):
        row = r_out + a
        for m in range(n_mid * n_in):
            _carry(rotation[row], shift[row], side_out, middle[m], tip)
            fx = fy = fz = 0.0
            for g in range(groups):
                w = weight[g, a, m]
                if w == 0.0:
                    continue
                x = tip[0] - stations[g, 0]
                y = tip[1] - stations[g, 1]
                z = tip[2] - stations[g, 2]
                distance = np.sqrt(x * x + y * y + z * z)
                residual = distance - length[g, a, m] - dead[g]
                pull = w * residual
                cost += 0.5 * pull * residual
                by_group[g, 3] -= pull
                pull /= distance
                x *= pull
                y *= pull
                z *= pull
                by_group[g, 0] -= x
                by_group[g, 1] -= y
                by_group[g, 2] -= z
                fx += x
                fy += y
                fz += z
            _pull(rotation[row], shift[row], side_out, middle[m], fx, fy, fz, back_middle[m], by_motion[row])
    for b in range(n_mid):
        row = r_mid + b
        for c in range(n_in):
            f = back_middle[b * n_in + c]
            _pull(rotation[row], shift[row], side_mid, inner[c], f[0], f[1], f[2], back_inner[c], by_motion[row])
    for c in range(n_in):
        row, f = r_in + c, back_inner[c]
        _pull(rotation[row], shift[row], side_in, tool, f[0], f[1], f[2], back_tool, by_motion[row])
    turned = np.empty(3)
    for row in range(rows):
        for i in range(3):
            turned[i] = 0.0
            for j in range(3):
                turned[i] += rotation[row, i, j] * by_motion[row, 3 + j]
        for i in range(3):
            total = 0.0
            for j in range(3):
                total += jacobian[row, j, i] * turned[j]
            by_motion[row, 3 + i] = total
    return cost
