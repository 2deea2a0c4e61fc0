"""Reference lines through straightness readings (ISO 230-1): least squares, minimum zone, or through the end points."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from compgen.core.csvio import FloatArray


def fitted_line(position_mm: FloatArray, value: FloatArray, kind: str = "ls") -> tuple[float, float]:
    """Return (constant, slope) of the line a + b q through values (n,) at positions (n,).

    ``kind`` is ``"ls"`` for least squares, ``"minzone"`` for the line whose largest vertical distance is smallest
    (Jia et al. 2022 call it "least inclusion"), ``"end-point"`` for the line through the values at the two ends.
    """
    if kind == "end-point":
        return _through_ends(position_mm, value)
    if kind == "ls":
        slope, constant = np.polyfit(position_mm, value, 1)
        return float(constant), float(slope)
    return _minimum_zone(position_mm, value)


def _through_ends(position_mm: FloatArray, value: FloatArray) -> tuple[float, float]:
    first, last = int(np.argmin(position_mm)), int(np.argmax(position_mm))
    slope = float((value[last] - value[first]) / (position_mm[last] - position_mm[first]))
    return float(value[first]) - slope * float(position_mm[first]), slope


def _minimum_zone(position_mm: FloatArray, value: FloatArray) -> tuple[float, float]:
    """The minimum-zone line is parallel to an edge of the convex hull: the narrowest strip over all of its edges."""
    order = np.lexsort((value, position_mm))
    points = np.column_stack([position_mm, value])[order]
    best = (np.inf, 0.0, 0.0)
    for sign in (1.0, -1.0):
        for (q1, y1), (q2, y2) in pairwise(_lower_hull(points * [1.0, sign])):
            if q2 <= q1:
                continue
            slope = sign * (y2 - y1) / (q2 - q1)
            rest = value - slope * position_mm
            width = float(np.ptp(rest))
            if width < best[0]:
                best = (width, 0.5 * float(rest.max() + rest.min()), float(slope))
    return best[1], best[2]


def _lower_hull(points: FloatArray) -> list[FloatArray]:
    """Lower convex hull of points (n, 2) that ascend in their first coordinate (Andrew's monotone chain)."""
    hull: list[FloatArray] = []
    for point in points:
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0.0:
            hull.pop()
        hull.append(point)
    return hull


def _turn(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
