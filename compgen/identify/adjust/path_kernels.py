"""Compiled pass over readings at any positions (numba, ``pip install compgen[fast]``): cost, gradient, normal matrix."""

from __future__ import annotations

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.identify.adjust.unknowns import IntArray
from compgen.kinematics.compiled_kernels import rotation_factors
from compgen.kinematics.exact_chain import SERIES_BELOW
from compgen.kinematics.kernel_switch import FAST, loop

#: Powers of the three local coordinates in each monomial of degree 4 and less; those of degree 2 and less come first.
POWERS = np.array(
    sorted(((a, b, c) for a in range(5) for b in range(5 - a) for c in range(5 - a - b)), key=lambda p: (sum(p), p)),
    dtype=np.int64,
)
_PLACE = {tuple(power): k for k, power in enumerate(POWERS.tolist())}
#: Monomials of degree 2 and less.
LOW = 10
#: Place of the product of two of them, (10, 10).
PRODUCT = np.array([[_PLACE[tuple((a + b).tolist())] for b in POWERS[:LOW]] for a in POWERS[:LOW]], dtype=np.int64)
#: Two monomials of degree 2 and less whose product each one is.
HIGH = len(POWERS)
_FIRST, _SECOND = np.array([np.argwhere(k == PRODUCT)[0] for k in range(HIGH)], dtype=np.int64).T.copy()
#: Room for the monomials of degree 4, and of degree 2: whole vector registers.
_HIGH_ROOM, _LOW_ROOM = 36, 12


@loop(fastmath=FAST, nogil=True)
def _add_products(table: FloatArray, factors: FloatArray, values: FloatArray) -> None:
    """Add the products of factors (k,) and values (m,) to a table (k, m); a loop of its own runs in vector registers."""
    for j in range(len(factors)):
        line, factor = table[j], factors[j]
        for m in range(len(values)):
            line[m] += factor * values[m]


@loop(fastmath=FAST, nogil=True)
def pass_over(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    chain: IntArray,
    nodes: FloatArray,
    directions: FloatArray,
    motion: FloatArray,
    tool: FloatArray,
    stations: FloatArray,
    dead: FloatArray,
    position: tuple[FloatArray, FloatArray, FloatArray],
    station: IntArray,
    group: IntArray,
    length: FloatArray,
    weight: FloatArray,
    noise: tuple[float, float, float, float],
    by_motion: FloatArray,
    by_travel: FloatArray,
    by_station: FloatArray,
    by_group: FloatArray,
    residual: FloatArray,
    moments: bool,
    of_cells: FloatArray,
    of_groups: FloatArray,
) -> float:
    """Add what n readings say, and return their weighted sum of squares.

    Parameters
    ----------
    chain : (4, 3) axes from the innermost body to the outermost; by axis the first node, the number of nodes, 1 for the
        tool side.
    nodes, motion : nodes of X, Y, Z in a row (k,), and delta and eps there (k, 6), linear in between.
    directions : of travel, (3, 3).
    tool, stations, dead : (3,), (S, 3), (G,).
    position, station, group, length, weight : of the readings, each (n,).
    noise : a, b, s and limit: the weight of a reading over the distance d is multiplied by (s / (a + b d))^2, and is 0
        where the residual exceeds limit (a + b d).
    by_motion, by_travel, by_station : gradient by motion (k, 6), by travel of each axis (3, 3), by stations (S, 3).
    by_group : of each dead length its gradient, the readings used, the square sum of their residuals, weights (G, 4).
    residual : takes model minus reading (n,), nan for a rejected reading.
    moments : whether sums for the normal matrix are wanted: of w u u^T times the 35 monomials of the local coordinates by
        cell, ``of_cells`` (cells, 6, 36), and of w u u^T and w u times 10 monomials by dead length and cell,
        ``of_groups`` (G, cells, 9, 12); what is left over stays zero.
    """
    constant, slope, scale, limit = noise
    left, share, travel = np.zeros(3, dtype=np.int64), np.empty(3), np.full(3, np.nan)
    points, eps, factors = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    back, value, total, low, high = np.empty(6), np.empty(9), np.zeros(6), np.zeros(_LOW_ROOM), np.zeros(_HIGH_ROOM)
    inverse = np.empty(len(nodes))
    for k in range(len(nodes) - 1):
        inverse[k] = 1.0 / (nodes[k + 1] - nodes[k])
    cost = x = y = z = fx = fy = fz = 0.0
    cell, count = 0, len(length)
    for i in range(count + 1):
        # stations that read at the same stop follow each other: chain and gradient are passed once for all of them
        if i == count or (position[0][i] != travel[0] or position[1][i] != travel[1] or position[2][i] != travel[2]):
            if i > 0:  # forces on the tip, back along the chain
                for step in range(3):
                    body = 2 - step
                    axis = chain[0, body]
                    a, b, c = eps[body, 0], eps[body, 1], eps[body, 2]
                    f1, f2, f3 = factors[body, 0], factors[body, 1], factors[body, 2]
                    px, py, pz = points[body, 0], points[body, 1], points[body, 2]
                    mx, my, mz = py * fz - pz * fy, pz * fx - px * fz, px * fy - py * fx
                    ox, oy, oz = b * mz - c * my, c * mx - a * mz, a * my - b * mx
                    back[3] = mx - f2 * ox + f3 * (b * oz - c * oy)
                    back[4] = my - f2 * oy + f3 * (c * ox - a * oz)
                    back[5] = mz - f2 * oz + f3 * (a * oy - b * ox)
                    ox, oy, oz = b * fz - c * fy, c * fx - a * fz, a * fy - b * fx
                    tx = fx - f1 * ox + f2 * (b * oz - c * oy)
                    ty = fy - f1 * oy + f2 * (c * ox - a * oz)
                    tz = fz - f1 * oz + f2 * (a * oy - b * ox)
                    if chain[3, axis] == 1:
                        back[0], back[1], back[2] = fx, fy, fz
                    else:
                        back[0], back[1], back[2] = tx, ty, tz
                    fx, fy, fz = tx, ty, tz
                    k, s = chain[1, axis] + left[axis], share[axis]
                    before, behind = by_motion[k], by_motion[k + 1]
                    for j in range(6):
                        part = s * back[j]
                        behind[j] += part
                        before[j] += back[j] - part
                    for j in range(3):
                        by_travel[axis, j] += travel[axis] * back[j]
                if moments:
                    _add_products(of_cells[cell], total, high)
                    total[:] = 0.0
                fx = fy = fz = 0.0
            if i == count:
                break
            # the interval between nodes, most often that of the stop before, and the share of its right end
            for axis in range(3):
                q = position[axis][i]
                travel[axis] = q
                first = chain[1, axis]
                k = first + left[axis]
                if q < nodes[k] or q > nodes[k + 1]:
                    below, above = first, first + chain[2, axis] - 2
                    while below < above:
                        middle = (below + above + 1) // 2
                        if nodes[middle] <= q:
                            below = middle
                        else:
                            above = middle - 1
                    k = below
                    left[axis] = k - first
                share[axis] = min(max((q - nodes[k]) * inverse[k], 0.0), 1.0)
            # the tip: each body passed once, x -> q a + delta + R x on the tool side, R (x + q a + delta) on the other
            x, y, z = tool[0], tool[1], tool[2]
            for body in range(3):
                axis = chain[0, body]
                k, s, q = chain[1, axis] + left[axis], share[axis], travel[axis]
                before, behind = motion[k], motion[k + 1]
                dx = before[0] + s * (behind[0] - before[0]) + q * directions[axis, 0]
                dy = before[1] + s * (behind[1] - before[1]) + q * directions[axis, 1]
                dz = before[2] + s * (behind[2] - before[2]) + q * directions[axis, 2]
                a = before[3] + s * (behind[3] - before[3])
                b = before[4] + s * (behind[4] - before[4])
                c = before[5] + s * (behind[5] - before[5])
                square = a * a + b * b + c * c
                f1, f2 = rotation_factors(square)
                f3 = (1.0 - f1) / square if square >= SERIES_BELOW else 1.0 / 6.0 - square / 120.0
                eps[body, 0], eps[body, 1], eps[body, 2] = a, b, c
                factors[body, 0], factors[body, 1], factors[body, 2] = f1, f2, f3
                if chain[3, axis] == 0:
                    x, y, z = x + dx, y + dy, z + dz
                ox, oy, oz = b * z - c * y, c * x - a * z, a * y - b * x
                x, y, z = (
                    x + f1 * ox + f2 * (b * oz - c * oy),
                    y + f1 * oy + f2 * (c * ox - a * oz),
                    z + f1 * oz + f2 * (a * oy - b * ox),
                )
                points[body, 0], points[body, 1], points[body, 2] = x, y, z  # turned
                if chain[3, axis] == 1:
                    x, y, z = x + dx, y + dy, z + dz
            if moments:
                cell = (left[0] * (chain[2, 1] - 1) + left[1]) * (chain[2, 2] - 1) + left[2]
                p, q, r = share[0], share[1], share[2]
                low[0], low[1], low[2], low[3] = 1.0, r, q, p
                low[4], low[5], low[6], low[7], low[8], low[9] = r * r, q * r, q * q, p * r, p * q, p * p
                for m in range(HIGH):
                    high[m] = low[_FIRST[m]] * low[_SECOND[m]]
        here, g = station[i], group[i]
        ux, uy, uz = x - stations[here, 0], y - stations[here, 1], z - stations[here, 2]
        distance = np.sqrt(ux * ux + uy * uy + uz * uz)
        rest = distance - dead[g] - length[i]
        sigma = constant + slope * distance
        if abs(rest) > limit * sigma:
            residual[i] = np.nan
            continue
        residual[i] = rest
        ratio = scale / sigma
        w, one = weight[i] * ratio * ratio, 1.0 / distance
        ux, uy, uz = ux * one, uy * one, uz * one
        pull = w * rest
        cost += pull * rest
        gx, gy, gz = pull * ux, pull * uy, pull * uz
        fx, fy, fz = fx + gx, fy + gy, fz + gz
        by_station[here, 0] -= gx
        by_station[here, 1] -= gy
        by_station[here, 2] -= gz
        by_group[g, 0] -= pull
        by_group[g, 1] += 1.0
        by_group[g, 2] += rest * rest
        by_group[g, 3] += w
        if moments:
            value[6], value[7], value[8] = w * ux, w * uy, w * uz
            value[0], value[1], value[2] = value[6] * ux, value[7] * uy, value[8] * uz
            value[3], value[4], value[5] = value[6] * uy, value[6] * uz, value[7] * uz
            for j in range(6):
                total[j] += value[j]
            _add_products(of_groups[g, cell], value, low)
    return cost
