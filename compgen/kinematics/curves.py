"""Bases of curves over one axis, and reference lines through straightness readings."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray

# Bases of curves over one axis: hat functions between nodes, and null spaces of a few linear constraints.


def hat_entries(nodes_mm: FloatArray, position_mm: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Left node (m,) of the interval of each position, and the share (m,) of the right node in the value there.

    Linear between ``nodes_mm`` (n,), n > 1, constant outside.
    """
    left = np.clip(np.searchsorted(nodes_mm, position_mm, side="right") - 1, 0, len(nodes_mm) - 2)
    share = np.clip((position_mm - nodes_mm[left]) / (nodes_mm[left + 1] - nodes_mm[left]), 0.0, 1.0)
    return left, share


def hat_matrix(nodes_mm: FloatArray, position_mm: FloatArray) -> FloatArray:
    """Matrix (m, n) that interpolates values at ``nodes_mm`` (n,) linearly at ``position_mm`` (m,), constant outside.

    >>> hat_matrix(np.array([0.0, 10.0, 30.0]), np.array([5.0, 30.0, 99.0]))
    array([[0.5, 0.5, 0. ],
           [0. , 0. , 1. ],
           [0. , 0. , 1. ]])
    """
    nodes, position = np.asarray(nodes_mm), np.asarray(position_mm)
    matrix = np.zeros((len(position), len(nodes)))
    if len(nodes) == 1:
        matrix[:, 0] = 1.0
        return matrix
    left, share = hat_entries(nodes, position)
    rows = np.arange(len(position))
    matrix[rows, left] = 1.0 - share
    matrix[rows, left + 1] += share
    return matrix


def spline_matrix(nodes_mm: FloatArray, position_mm: FloatArray) -> FloatArray:
    """Matrix (m, n) of the clamped cubic B-splines with n coefficients over the range of ``nodes_mm`` (n,).

    The knots are spread like the nodes (averages of three neighbouring nodes), first and last fourfold, so that the
    first and the last coefficient are the end values. Positions (m,) outside the range get the end value.
    """
    from scipy.interpolate import BSpline  # imported here: slow to load, and linear curves do without

    nodes = np.asarray(nodes_mm, dtype=np.float64)
    inner = (nodes[1:-3] + nodes[2:-2] + nodes[3:-1]) / 3.0
    knots = np.concatenate([np.repeat(nodes[0], 4), inner, np.repeat(nodes[-1], 4)])
    inside = np.clip(position_mm, nodes[0], nodes[-1])
    return np.asarray(BSpline.design_matrix(inside, knots, 3).toarray(), dtype=np.float64)


def free_basis(constraints: FloatArray, size: int) -> FloatArray:
    """Basis (size, free) of all x with ``constraints`` (k, size) x = 0, by elimination.

    Each row drops the unknown with its largest factor, expressed by the others, which keep their meaning: a row with
    a single entry gives an exact zero, and the basis stays sparse.
    """
    rows = np.atleast_2d(constraints).astype(np.float64) if np.size(constraints) else np.zeros((0, size))
    pivots: list[int] = []
    for k in range(len(rows)):
        pivot = int(np.argmax(np.abs(rows[k])))
        if abs(rows[k, pivot]) < 1e-12:
            continue  # says nothing beyond the rows before it
        rows[k] /= rows[k, pivot]
        others = np.arange(len(rows)) != k
        rows[others] -= rows[others, pivot][:, None] * rows[k]
        pivots.append(pivot)
    keep = np.ones(size, dtype=bool)
    keep[pivots] = False
    basis = np.eye(size)[:, keep]
    used = np.flatnonzero(np.abs(rows).max(axis=1, initial=0.0) > 1e-12).tolist()
    basis[pivots] = -rows[used][:, keep]
    return basis


# Reference lines through straightness readings (ISO 230-1): least squares, minimum zone, or through the end points.


def fitted_line(position_mm: FloatArray, value: FloatArray, kind: str = "ls") -> tuple[float, float]:
    """Return (constant, slope) of the line a + b q through values (n,) at positions (n,).

    ``kind`` is ``"ls"`` for least squares, ``"minzone"`` for the line whose largest vertical distance is smallest
    (Jia et al. 2022 call it "least inclusion"), ``"end-point"`` for the line through the values at the two ends.
    """
    if kind == "end-point":
        first, last = int(np.argmin(position_mm)), int(np.argmax(position_mm))
        slope = float((value[last] - value[first]) / (position_mm[last] - position_mm[first]))
        return float(value[first]) - slope * float(position_mm[first]), slope
    if kind == "ls":
        slope, constant = np.polyfit(position_mm, value, 1)
        return float(constant), float(slope)
    # the minimum-zone line is parallel to an edge of the convex hull: the narrowest strip over all of its edges
    points = np.column_stack([position_mm, value])[np.lexsort((value, position_mm))]
    best = (np.inf, 0.0, 0.0)
    for sign in (1.0, -1.0):
        for (q1, y1), (q2, y2) in pairwise(_lower_hull(points * [1.0, sign])):
            if q2 <= q1:
                continue
            edge = float(sign * (y2 - y1) / (q2 - q1))
            rest = value - edge * position_mm
            if (width := float(np.ptp(rest))) < best[0]:
                best = (width, 0.5 * float(rest.max() + rest.min()), edge)
    return best[1], best[2]


def _lower_hull(points: FloatArray) -> list[FloatArray]:
    """Lower convex hull of points (n, 2) that ascend in their first coordinate (Andrew's monotone chain)."""
    hull: list[FloatArray] = []
    for point in points:
        while len(hull) > 1:
            (x1, y1), (x2, y2) = hull[-2], hull[-1]
            if (x2 - x1) * (point[1] - y1) - (y2 - y1) * (point[0] - x1) > 0.0:  # a left turn
                break
            hull.pop()
        hull.append(point)
    return hull
