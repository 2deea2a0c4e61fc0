"""Compiled loops of the grid problem (numba, ``pip install compgen[fast]``)."""

from __future__ import annotations

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.identification.adjust.unknowns import IntArray
from compgen.kinematics.compiled_kernels import level_rotation
from compgen.kinematics.kernel_switch import FAST, loop

# Compiled passes along the chain on a grid of levels (numba): cost and gradient, and distances.
#
# Loops over a whole plane write one array each, and divide without checks, so that they are vectorised.


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
            level_rotation(motion[6 * row + 3 : 6 * row + 6], rotation[row], jacobian[row])
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
        distance = np.sqrt(
            x * x + y * y + z * z + 1e-200
        )  # never zero, even if a cell without reading coincides with the station
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
    rows: IntArray,
    columns: IntArray,
    values: FloatArray,
    errors: FloatArray,
    derivatives: FloatArray,
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

    The first arguments as in :func:`carriages`; ``directions`` and ``derivatives`` as ``travel_directions`` returns
    them; ``squareness`` (3,) is the place of EC0Y, EB0Z, EA0Z among the unknowns, -1 if not modelled.
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


# Compiled normal matrix of a grid (numba): moments of w u u^T, and what they give in delta and eps of the levels.


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
    """Moments of the readings of one tool, as in ``grid_problem.Moments``; arguments as in ``chain_gradient``."""
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
    """Add the contribution of a pair of axes to ``matrix`` (levels * 6, levels * 6): its block, and diagonal blocks.

    ``axes`` (3,) are the pair and the third axis; ``levers`` [axis, lever, component] the direction of each axis that
    is part of another's lever arm, otherwise zero.
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
    """Add the levels of one axis to ``by_group`` (n, groups, 4): sums of derivative times w u (x, y, z) and w.

    ``table`` (groups, levels, 3, 10) as in ``grid_problem.Moments``; ``axes`` (3,) are the axis and the two others in the
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


# Compiled sorting of readings into the cells of a grid (numba), their means, and the moments of the start values.


@loop(fastmath=False, error_model="python")
def find_levels(position: FloatArray, most: int) -> tuple[FloatArray, IntArray]:
    """Distinct values (k,) of (n,) and the index of each position; no values if there are more than ``most``."""
    levels, names = np.empty(most), np.empty(most, dtype=np.int64)  # ascending, and in the order in which they came
    index = np.empty(len(position), dtype=np.int64)
    count = last = 0
    for row in range(len(position)):
        value = position[row]
        if count == 0 or value != levels[last]:
            if last + 1 < count and value == levels[last + 1]:
                last += 1
            else:
                low, high = 0, count
                while low < high:
                    middle = (low + high) // 2
                    if levels[middle] < value:
                        low = middle + 1
                    else:
                        high = middle
                if low == count or value != levels[low]:
                    if count == most or not np.isfinite(value):
                        return np.empty(0), index
                    for k in range(count, low, -1):
                        levels[k], names[k] = levels[k - 1], names[k - 1]
                    levels[low], names[low] = value, count
                    count += 1
                last = low
        index[row] = names[last]
    rank = np.empty(count, dtype=np.int64)
    for k in range(count):
        rank[names[k]] = k
    for row in range(len(position)):
        index[row] = rank[index[row]]
    found = np.empty(count)
    for k in range(count):
        found[k] = levels[k]
    return found, index


@loop(fastmath=False)
def cell_means(cells: IntArray, weight: FloatArray, reading: FloatArray, total: FloatArray, mean: FloatArray) -> float:
    """Fill in weight and weighted mean (cells,) of the readings of each cell; return their weighted scatter about it."""
    for row in range(len(cells)):
        total[cells[row]] += weight[row]
        mean[cells[row]] += weight[row] * reading[row]
    for cell in range(len(total)):
        if total[cell] > 0.0:
            mean[cell] /= total[cell]
    scatter = 0.0
    for row in range(len(cells)):
        off = reading[row] - mean[cells[row]]
        scatter += weight[row] * off * off
    return scatter


@loop(fastmath=FAST)
def add_sums(weight: FloatArray, reading: FloatArray, count: FloatArray, total: FloatArray) -> None:
    """Add number and sum (groups,) of the readings of each group (groups, n_out, m) that have a weight."""
    for g in range(weight.shape[0]):
        for level in range(weight.shape[1]):
            w, length = weight[g, level], reading[g, level]
            here = number = 0.0
            for m in range(len(w)):
                present = 1.0 if w[m] > 0.0 else 0.0
                number += present
                here += present * length[m]
            count[g] += number
            total[g] += here


@loop(fastmath=FAST)
def start_sums(  # noqa: PLR0913 - a compiled loop takes its arrays one by one
    p_out: FloatArray,
    plane: FloatArray,
    axes: IntArray,
    weight: FloatArray,
    reading: FloatArray,
    scale: float,
    offset: float,
    sums: FloatArray,
) -> None:
    """Add the products of (2 p, 2 L, 1, |p|^2 - L^2) of the readings of one group (n_out, m): ``sums`` (6, 6).

    Each product is added at only one of its two places, above or below the diagonal.

    ``axes`` (3,) are the outermost, middle and innermost axis; ``p_out`` (n_out,) and ``plane`` (2, m) the coordinates
    along them; L is the reading over ``scale`` minus ``offset``.
    """
    first, second = plane[0], plane[1]
    o, b, c = axes[0], axes[1], axes[2]
    inverse = 1.0 / scale
    for level in range(len(p_out)):
        height = p_out[level]
        w, length = weight[level], reading[level]
        count = sum_b = sum_c = sum_l = bb = bc = cc = bl = cl = ll = t = tb = tc = tl = tt = 0.0
        for m in range(len(w)):
            present = 1.0 if w[m] > 0.0 else 0.0
            x, y, reach = present * first[m], present * second[m], present * (length[m] * inverse - offset)
            target = present * (height * height) + x * x + y * y - reach * reach
            count += present
            sum_b += x
            sum_c += y
            sum_l += reach
            bb += x * x
            bc += x * y
            cc += y * y
            bl += x * reach
            cl += y * reach
            ll += reach * reach
            t += target
            tb += target * x
            tc += target * y
            tl += target * reach
            tt += target * target
        sums[o, o] += 4.0 * count * height * height
        sums[o, b] += 4.0 * height * sum_b
        sums[o, c] += 4.0 * height * sum_c
        sums[b, b] += 4.0 * bb
        sums[b, c] += 4.0 * bc
        sums[c, c] += 4.0 * cc
        sums[o, 3] += 4.0 * height * sum_l
        sums[b, 3] += 4.0 * bl
        sums[c, 3] += 4.0 * cl
        sums[3, 3] += 4.0 * ll
        sums[o, 4] += 2.0 * height * count
        sums[b, 4] += 2.0 * sum_b
        sums[c, 4] += 2.0 * sum_c
        sums[3, 4] += 2.0 * sum_l
        sums[4, 4] += count
        sums[o, 5] += 2.0 * height * t
        sums[b, 5] += 2.0 * tb
        sums[c, 5] += 2.0 * tc
        sums[3, 5] += 2.0 * tl
        sums[4, 5] += t
        sums[5, 5] += tt


# Compiled loops of the fast path (numba, ``pip install compgen[fast]``); import only if
# ``compgen.kinematics.kernel_switch`` allows it.
