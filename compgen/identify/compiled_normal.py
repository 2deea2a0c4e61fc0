"""Compiled normal matrix of a grid (numba): moments of w u u^T, and what they give in delta and eps of the levels."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.kernels import FAST, loop
from compgen.identify.compiled_chain import carriages, inner_points, plane_of_tips
from compgen.identify.state import IntArray


@loop(fastmath=FAST)
def _products(tip: FloatArray, station: FloatArray, weight: FloatArray, value: FloatArray) -> None:
    """Fill in w u u^T (xx, yy, zz, xy, xz, yz), w u (x, y, z) and w of one plane: ``value`` (10, m)."""
    tx, ty, tz = tip[0], tip[1], tip[2]
    sx, sy, sz = station[0], station[1], station[2]
    inverse = np.empty(len(weight))
    for m in range(len(weight)):
        x, y, z = tx[m] - sx, ty[m] - sy, tz[m] - sz
        inverse[m] = 1.0 / np.sqrt(x * x + y * y + z * z + 1e-200)
    for i in range(3):
        place, own, out = tip[i], station[i], value[6 + i]
        for m in range(len(weight)):
            out[m] = weight[m] * (place[m] - own) * inverse[m]
    for i in range(3):
        place, own, share, out = tip[i], station[i], value[6 + i], value[i]
        for m in range(len(weight)):
            out[m] = share[m] * (place[m] - own) * inverse[m]
    for k in range(3):
        place, own = tip[1 if k == 0 else 2], station[1 if k == 0 else 2]
        share, out = value[7 if k == 2 else 6], value[3 + k]
        for m in range(len(weight)):
            out[m] = share[m] * (place[m] - own) * inverse[m]
    out = value[9]
    for m in range(len(weight)):
        out[m] = weight[m]


@loop(fastmath=FAST)
def _add_to_pairs(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    total: FloatArray,
    level: int,
    q_out: float,
    q_mid: FloatArray,
    q_in: FloatArray,
    out_mid: FloatArray,
    out_in: FloatArray,
    mid_in: FloatArray,
) -> None:
    """Add w u u^T of one plane (6, m) at a level to the tables of pairs: [power of the third axis, 6, first, second]."""
    n_mid, n_in = len(q_mid), len(q_in)
    for k in range(6):
        plane = total[k]
        for power in range(3):
            factor, sums = q_out**power, mid_in[power, k].ravel()
            for m in range(n_mid * n_in):
                sums[m] += factor * plane[m]
        sums_0, sums_1, sums_2 = out_in[0, k, level], out_in[1, k, level], out_in[2, k, level]
        for b in range(n_mid):
            line = plane[b * n_in : (b + 1) * n_in]
            plain = once = twice = 0.0
            for c in range(n_in):
                plain += line[c]
                once += line[c] * q_in[c]
                twice += line[c] * q_in[c] * q_in[c]
            out_mid[0, k, level, b], out_mid[1, k, level, b], out_mid[2, k, level, b] = plain, once, twice
            factor = q_mid[b]
            for c in range(n_in):
                sums_0[c] += line[c]
            for c in range(n_in):
                sums_1[c] += factor * line[c]
            for c in range(n_in):
                sums_2[c] += factor * factor * line[c]


@loop(fastmath=FAST)
def moment_tables(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
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
    weight: FloatArray,
) -> tuple[tuple[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]:
    """Moments of the readings of one tool, as ``grid_moments.Moments`` holds them; arguments as in ``chain_gradient``."""
    rotation, _, shift = carriages(chain, levels, directions, rows, columns, values, errors)
    _, middle = inner_points(chain, rotation, shift, tool)
    axis_in, axis_mid, axis_out = chain[0, 0], chain[0, 1], chain[0, 2]
    n_in, n_mid, n_out = chain[2, axis_in], chain[2, axis_mid], chain[2, axis_out]
    q_in = levels[chain[1, axis_in] : chain[1, axis_in] + n_in]
    q_mid = levels[chain[1, axis_mid] : chain[1, axis_mid] + n_mid]
    q_out = levels[chain[1, axis_out] : chain[1, axis_out] + n_out]
    groups, cells = len(station_of), n_mid * n_in
    out_mid, out_in = np.zeros((3, 6, n_out, n_mid)), np.zeros((3, 6, n_out, n_in))
    mid_in = np.zeros((3, 6, n_mid, n_in))
    by_out = np.zeros((groups, n_out, 3, 10))
    summed = np.zeros((groups, 2, 10, cells))  # over the outermost levels, times 1 and times their coordinate
    tip, value, total = np.empty(middle.shape), np.empty((10, cells)), np.empty((6, cells))
    q_in_of, q_mid_of = np.empty(cells), np.empty(cells)
    for m in range(cells):
        q_in_of[m], q_mid_of[m] = q_in[m % n_in], q_mid[m // n_in]
    for a in range(n_out):
        plane_of_tips(chain, rotation, shift, middle, a, tip)
        for k in range(6):
            both = total[k]
            for m in range(cells):
                both[m] = 0.0
        for g in range(groups):
            _products(tip, stations[station_of[g]], weight[g, a], value)
            for k in range(10):
                line, plain, times = value[k], summed[g, 0, k], summed[g, 1, k]
                alone = with_in = with_mid = 0.0
                for m in range(cells):
                    alone += line[m]
                    with_in += line[m] * q_in_of[m]
                    with_mid += line[m] * q_mid_of[m]
                by_out[g, a, 0, k], by_out[g, a, 1, k], by_out[g, a, 2, k] = alone, with_in, with_mid
                for m in range(cells):
                    plain[m] += line[m]
                factor = q_out[a]
                for m in range(cells):
                    times[m] += factor * line[m]
                if k < 6:
                    both = total[k]
                    for m in range(cells):
                        both[m] += line[m]
        _add_to_pairs(total, a, q_out[a], q_mid, q_in, out_mid, out_in, mid_in)
    by_mid, by_in = np.zeros((groups, n_mid, 3, 10)), np.zeros((groups, n_in, 3, 10))
    for g in range(groups):
        for k in range(10):
            for b in range(n_mid):
                for c in range(n_in):
                    plain_value, times_value = summed[g, 0, k, b * n_in + c], summed[g, 1, k, b * n_in + c]
                    by_mid[g, b, 0, k] += plain_value
                    by_mid[g, b, 1, k] += plain_value * q_in[c]
                    by_mid[g, b, 2, k] += times_value
                    by_in[g, c, 0, k] += plain_value
                    by_in[g, c, 1, k] += plain_value * q_mid[b]
                    by_in[g, c, 2, k] += times_value
    return (out_mid, out_in, mid_in), (by_out, by_mid, by_in)


@loop(fastmath=FAST)
def _block(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    tables: FloatArray,
    i: int,
    j: int,
    arm_a: FloatArray,
    step_a: FloatArray,
    arm_b: FloatArray,
    step_b: FloatArray,
    work: FloatArray,
    block: FloatArray,
) -> None:
    """Add the normal matrix of delta and eps at two levels to ``block`` (6, 6).

    Lever arms are ``arm`` plus the coordinate of the third axis times ``step``, ``tables`` (3, 6, ., .) the moments of
    w u u^T at the two levels times that coordinate to the power 0, 1, 2. The derivative by eps is arm x u. ``work``
    (5, 3, 3) is room for parts.
    """
    moment, first, second = work[:3], work[3], work[4]  # the last two: u (arm_b x u)^T, times 1 and the coordinate
    for power in range(3):
        xx, yy, zz = tables[power, 0, i, j], tables[power, 1, i, j], tables[power, 2, i, j]
        xy, xz, yz = tables[power, 3, i, j], tables[power, 4, i, j], tables[power, 5, i, j]
        moment[power, 0, 0], moment[power, 0, 1], moment[power, 0, 2] = xx, xy, xz
        moment[power, 1, 0], moment[power, 1, 1], moment[power, 1, 2] = xy, yy, yz
        moment[power, 2, 0], moment[power, 2, 1], moment[power, 2, 2] = xz, yz, zz
    for p in range(3):
        for q in range(3):
            n, o = (q + 1) % 3, (q + 2) % 3
            first[p, q] = (
                arm_b[n] * moment[0, p, o]
                - arm_b[o] * moment[0, p, n]
                + step_b[n] * moment[1, p, o]
                - step_b[o] * moment[1, p, n]
            )
            second[p, q] = (
                arm_b[n] * moment[1, p, o]
                - arm_b[o] * moment[1, p, n]
                + step_b[n] * moment[2, p, o]
                - step_b[o] * moment[2, p, n]
            )
    for p in range(3):
        n, o = (p + 1) % 3, (p + 2) % 3
        for q in range(3):
            block[p, q] += moment[0, p, q]
            block[p, 3 + q] += first[p, q]
            block[3 + p, q] += (
                arm_a[n] * moment[0, o, q]
                - arm_a[o] * moment[0, n, q]
                + step_a[n] * moment[1, o, q]
                - step_a[o] * moment[1, n, q]
            )
            block[3 + p, 3 + q] += (
                arm_a[n] * first[o, q] - arm_a[o] * first[n, q] + step_a[n] * second[o, q] - step_a[o] * second[n, q]
            )


@loop(fastmath=FAST)
def add_pair(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    tables: FloatArray,
    axes: IntArray,
    levels_a: FloatArray,
    levels_b: FloatArray,
    levers: FloatArray,
    tool: FloatArray,
    first_row: IntArray,
    own_a: bool,
    own_b: bool,
    matrix: FloatArray,
) -> None:
    """Add what a pair of axes gives to ``matrix`` (levels * 6, levels * 6): its block, and the own blocks asked for.

    ``axes`` (3,) are the pair and the third axis; ``levers`` [axis, lever, component] the direction of each axis that
    is part of another's lever arm, zero where it is none.
    """
    a, b, t = axes[0], axes[1], axes[2]
    arm_a, arm_b, across, work = np.empty(3), np.empty(3), np.empty((6, 6)), np.empty((5, 3, 3))
    for i in range(len(levels_a)):
        at_a = 6 * (first_row[a] + i)
        for j in range(len(levels_b)):
            at_b = 6 * (first_row[b] + j)
            for k in range(3):
                arm_a[k] = tool[k] + levels_a[i] * levers[a, a, k] + levels_b[j] * levers[a, b, k]
                arm_b[k] = tool[k] + levels_a[i] * levers[b, a, k] + levels_b[j] * levers[b, b, k]
            for p in range(6):
                for q in range(6):
                    across[p, q] = 0.0
            _block(tables, i, j, arm_a, levers[a, t], arm_b, levers[b, t], work, across)
            for p in range(6):
                for q in range(6):
                    matrix[at_a + p, at_b + q] = across[p, q]
                    matrix[at_b + q, at_a + p] = across[p, q]
            if own_a:
                same = matrix[at_a : at_a + 6, at_a : at_a + 6]
                _block(tables, i, j, arm_a, levers[a, t], arm_a, levers[a, t], work, same)
            if own_b:
                same = matrix[at_b : at_b + 6, at_b : at_b + 6]
                _block(tables, i, j, arm_b, levers[b, t], arm_b, levers[b, t], work, same)


@loop(fastmath=FAST)
def project(rows: IntArray, columns: IntArray, values: FloatArray, matrix: FloatArray, result: FloatArray) -> None:
    """Add T^T M T to ``result``, T (levels * 6, n) given by its entries, M (levels * 6, levels * 6) symmetric."""
    size = len(matrix)
    half = np.zeros((len(result), size))
    for k in range(len(rows)):
        line, out, value = matrix[rows[k]], half[columns[k]], values[k]
        for m in range(size):
            out[m] += value * line[m]
    for r in range(len(result)):
        line, out = half[r], result[r]
        for k in range(len(rows)):
            out[columns[k]] += line[rows[k]] * values[k]


@loop(fastmath=FAST)
def add_stations(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    table: FloatArray,
    axes: IntArray,
    levels: FloatArray,
    levers: FloatArray,
    tool: FloatArray,
    first_row: IntArray,
    rows: IntArray,
    columns: IntArray,
    values: FloatArray,
    by_group: FloatArray,
) -> None:
    """Add what the levels of one axis give to ``by_group`` (n, groups, 4): sums of derivative times w u (x, y, z) and w.

    ``table`` (groups, levels, 3, 10) as in ``grid_moments.Moments``; ``axes`` (3,) are the axis and the two others in the
    order of the table; the map of the curves is given by its entries.
    """
    axis = axes[0]
    groups, count = table.shape[:2]
    sums, block = np.empty((3, 3, 4)), np.empty((6, 4))
    motion = np.empty((6 * count, groups, 4))
    arms = np.empty((3, 3))
    for k in range(3):
        arms[1, k], arms[2, k] = levers[axis, axes[1], k], levers[axis, axes[2], k]
    for i in range(count):
        for k in range(3):
            arms[0, k] = tool[k] + levels[i] * levers[axis, axis, k]
        for g in range(groups):
            for power in range(3):
                line = table[g, i, power]
                sums[power, 0, 0], sums[power, 1, 1], sums[power, 2, 2] = line[0], line[1], line[2]
                sums[power, 0, 1] = sums[power, 1, 0] = line[3]
                sums[power, 0, 2] = sums[power, 2, 0] = line[4]
                sums[power, 1, 2] = sums[power, 2, 1] = line[5]
                sums[power, 0, 3], sums[power, 1, 3], sums[power, 2, 3] = line[6], line[7], line[8]
            for q in range(4):
                for p in range(3):
                    n, o = (p + 1) % 3, (p + 2) % 3
                    block[p, q] = sums[0, p, q]
                    total = 0.0
                    for power in range(3):
                        total += arms[power, n] * sums[power, o, q] - arms[power, o] * sums[power, n, q]
                    block[3 + p, q] = total
            for p in range(6):
                for q in range(4):
                    motion[6 * i + p, g, q] = block[p, q]
    start, end = 6 * first_row[axis], 6 * first_row[axis + 1]
    for k in range(len(rows)):
        if start <= rows[k] < end:
            for g in range(groups):
                for q in range(4):
                    by_group[columns[k], g, q] += values[k] * motion[rows[k] - start, g, q]
