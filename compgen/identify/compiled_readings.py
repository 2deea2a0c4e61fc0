"""Compiled sorting of readings into the cells of a grid (numba), their means, and the moments of the start values."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.kernels import FAST, loop
from compgen.identify.state import IntArray


@loop(fastmath=False, error_model="python")
def find_levels(position: FloatArray, most: int) -> tuple[FloatArray, IntArray]:
    """Distinct values (k,) of (n,) and the index of each position; no values where there are more than ``most``."""
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

    Each product is entered once: at one of its two places, above or below the diagonal.

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
