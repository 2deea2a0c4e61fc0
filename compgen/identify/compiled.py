"""Compiled inner loops of the fast path (numba, ``pip install compgen[fast]``); import only through ``kernels``."""

from __future__ import annotations

import numpy as np
from numba import njit

from compgen.core.csvio import FloatArray


@njit(cache=True, fastmath={"contract"})  # type: ignore[untyped-decorator,unused-ignore]
def forces(
    tip: FloatArray,
    stations: FloatArray,
    dead: FloatArray,
    weight: FloatArray,
    length: FloatArray,
    force: FloatArray,
    by_group: FloatArray,
) -> float:
    """Cost of the readings; adds the forces on the tips (n, 3, m) and, per group, of station (3) and dead length (1).

    ``stations`` (groups, 3) and ``dead`` (groups,) are the values of each group; ``weight``, ``length`` (groups, n, m).
    """
    groups, outer, inner = weight.shape
    cost = 0.0
    for o in range(outer):
        for g in range(groups):
            sx = sy = sz = total = 0.0
            for m in range(inner):
                x = tip[o, 0, m] - stations[g, 0]
                y = tip[o, 1, m] - stations[g, 1]
                z = tip[o, 2, m] - stations[g, 2]
                distance = np.sqrt(x * x + y * y + z * z)
                residual = distance - length[g, o, m] - dead[g]
                pull = weight[g, o, m] * residual
                cost += 0.5 * pull * residual
                total += pull
                pull /= distance
                x *= pull
                y *= pull
                z *= pull
                force[o, 0, m] += x
                force[o, 1, m] += y
                force[o, 2, m] += z
                sx += x
                sy += y
                sz += z
            by_group[g, 0] -= sx
            by_group[g, 1] -= sy
            by_group[g, 2] -= sz
            by_group[g, 3] -= total
    return cost


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


__all__ = ["forces", "moments"]
