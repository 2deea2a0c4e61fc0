"""Straightness against a stated reference line, and squareness of two reference lines (ISO 230-1).

Straightness error: largest positive plus size of the largest negative distance from the reference line. The line is
through the end points, of least squares, or the one of the minimum zone. What the line takes out of straightness belongs
to squareness: squareness is the deviation of the angle between two reference lines from 90 degrees, and both together
leave the volumetric error as it is.
"""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.lines import fitted_line
from compgen.errors import InputError

#: Reference lines by the names of the command line.
LINES = {"end-point": "end points", "ls": "least squares", "minzone": "minimum zone"}


def straightness(position_mm: FloatArray, value_mm: FloatArray, line: str) -> tuple[float, FloatArray]:
    """Return the straightness error (mm), and its derivative (n,) by the values.

    Parameters
    ----------
    position_mm, value_mm : deviations across the axis (n,) at positions (n,), n > 1.
    line : ``"end-point"``, ``"ls"`` or ``"minzone"``.
    """
    _check(position_mm, line)
    constant, slope = fitted_line(position_mm, value_mm, line)
    rest = value_mm - constant - slope * position_mm
    high, low = int(np.argmax(rest)), int(np.argmin(rest))
    if line == "minzone":
        return float(np.ptp(rest)), _zone_derivative(position_mm, rest)
    derivative = np.zeros(len(rest))
    derivative[high] += 1.0
    derivative[low] -= 1.0
    return float(np.ptp(rest)), derivative - (position_mm[high] - position_mm[low]) * slope_weights(position_mm, line)


def slope_weights(position_mm: FloatArray, line: str, value: FloatArray | None = None) -> FloatArray:
    """Derivative (n,) of the slope of a reference line by the values; the minimum zone depends on the values (n,)."""
    _check(position_mm, line)
    weights = np.zeros(len(position_mm))
    if line == "ls":
        centred = position_mm - position_mm.mean()
        return np.asarray(centred / (centred @ centred))
    first, last = int(np.argmin(position_mm)), int(np.argmax(position_mm))
    if line == "minzone":
        if value is None:
            raise ValueError("the line of the minimum zone depends on the values")
        constant, slope = fitted_line(position_mm, value, line)
        first, last, _, _ = _contacts(position_mm, value - constant - slope * position_mm)
    length = position_mm[last] - position_mm[first]
    weights[first], weights[last] = -1.0 / length, 1.0 / length
    return weights


def _check(position_mm: FloatArray, line: str) -> None:
    if line not in LINES:
        raise InputError(f"{line!r} is no reference line; {', '.join(LINES)} are known")
    if len(position_mm) < 2:
        raise InputError("a straightness needs values at two positions at least")


def _contacts(position_mm: FloatArray, rest: FloatArray) -> tuple[int, int, int, float]:
    """Two points on one side of the zone, the one between them on the other, and the sign of the other side."""
    half = 0.5 * float(np.ptp(rest))
    tolerance = 1e-9 * max(half, 1e-12) + 1e-15
    for side in (1.0, -1.0):
        touching = np.flatnonzero(side * rest >= float(np.max(side * rest)) - tolerance)
        against = int(np.argmin(side * rest))
        first, last = int(touching[0]), int(touching[-1])
        if first != last and position_mm[first] <= position_mm[against] <= position_mm[last]:
            return first, last, against, -side
    first, last = int(np.argmin(position_mm)), int(np.argmax(position_mm))
    return first, last, int(np.argmin(rest)), -1.0


def _zone_derivative(position_mm: FloatArray, rest: FloatArray) -> FloatArray:
    """Width = distance of the single contact from the line through the two others."""
    first, last, against, side = _contacts(position_mm, rest)
    share = (position_mm[against] - position_mm[first]) / (position_mm[last] - position_mm[first])
    derivative = np.zeros(len(rest))
    derivative[against] += side
    derivative[first] -= side * (1.0 - share)
    derivative[last] -= side * share
    return derivative
