"""The best polyline of four knots for a curve: all pairs of inner knots are tried, the ends are given.

With knots p < q of a segment and the hat functions h0, h1 on it, weighted sums over the samples of h0^2, h0 h1, h1^2, h0 y
and h1 y follow from running sums of w, w x, w x^2, w y and w x y. For each pair of inner knots the normal matrix of the
four knot values is tridiagonal; its elimination gives by how much the squared deviation falls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.model.basis import hat_matrix

#: Keeps a pivot from zero where a segment holds a single sample.
TINY = 1e-12


@dataclass(frozen=True)
class Polyline:
    """Indices of the four knots among the candidates, the knot values (4,), and the weighted squared deviation."""

    knots: tuple[int, int, int, int]
    values: FloatArray
    square: float


@dataclass(frozen=True)
class _Segments:
    """Sums over the samples of each segment from candidate p to q, shape (m, m), only p < q."""

    g00: FloatArray
    g01: FloatArray
    g11: FloatArray
    r0: FloatArray
    r1: FloatArray


def best_polyline(
    candidates_mm: FloatArray, position_mm: FloatArray, wanted: FloatArray, weight: FloatArray
) -> Polyline:
    """Return the polyline with knots at the first, the last and two further candidates that fits samples best.

    Parameters
    ----------
    candidates_mm : allowed knots (m,), ascending, at least four.
    position_mm, wanted, weight : samples (n,) within the candidates, ascending, the candidates among them.
    """
    if len(candidates_mm) < 4:
        raise ValueError("at least four candidates are needed")
    parts = _segments(candidates_mm, position_mm, wanted, weight)
    gain = _gain(parts)
    b, c = (int(k) for k in np.unravel_index(int(np.argmax(gain)), gain.shape))
    knots = (0, b, c, len(candidates_mm) - 1)
    matrix = hat_matrix(candidates_mm[list(knots)], position_mm)
    root = np.sqrt(weight)
    values = np.linalg.lstsq(matrix * root[:, None], wanted * root, rcond=None)[0]
    return Polyline(knots, np.asarray(values), float(np.sum(weight * (matrix @ values - wanted) ** 2)))


def _segments(candidates: FloatArray, position: FloatArray, wanted: FloatArray, weight: FloatArray) -> _Segments:
    middle = 0.5 * (candidates[0] + candidates[-1])
    x, y = position - middle, wanted
    at = candidates - middle
    sums = np.array([weight, weight * x, weight * x**2, weight * y, weight * x * y])
    running = np.hstack([np.zeros((5, 1)), np.cumsum(sums, axis=1)])
    cut = np.searchsorted(position, candidates - 1e-9)
    cut[-1] = len(position)  # the last segment holds its end, the others do not
    s0, s1, s2, t0, t1 = running[:, cut][:, None, :] - running[:, cut][:, :, None]
    length = np.where(at[None, :] > at[:, None], at[None, :] - at[:, None], 1.0)
    first = at[:, None]
    h1 = (s1 - first * s0) / length
    g11 = (s2 - 2.0 * first * s1 + first**2 * s0) / length**2
    r1 = (t1 - first * t0) / length
    return _Segments(s0 - 2.0 * h1 + g11, h1 - g11, g11, t0 - r1, r1)


def _gain(parts: _Segments) -> FloatArray:
    """How much the squared deviation falls with inner knots b (row) and c (column), shape (m, m); -inf where b >= c."""
    count = len(parts.g00)
    b, c = np.arange(count)[:, None], np.arange(count)[None, :]
    start, middle, last = (np.zeros_like(c), b), (b, c), (c, np.full_like(c, count - 1))

    def at(table: FloatArray, where: tuple[np.ndarray, np.ndarray]) -> FloatArray:
        return np.asarray(table[where])

    diagonal = [
        at(parts.g00, start),
        at(parts.g11, start) + at(parts.g00, middle),
        at(parts.g11, middle) + at(parts.g00, last),
        at(parts.g11, last),
    ]
    beside = [at(parts.g01, where) for where in (start, middle, last)]
    right = [
        at(parts.r0, start),
        at(parts.r1, start) + at(parts.r0, middle),
        at(parts.r1, middle) + at(parts.r0, last),
        at(parts.r1, last),
    ]
    scale = float(np.max(np.abs(parts.g00)))
    pivot, rest = np.maximum(diagonal[0], TINY * scale), right[0]
    gain = rest**2 / pivot
    for k in range(1, 4):
        factor = beside[k - 1] / pivot
        pivot, rest = np.maximum(diagonal[k] - factor * beside[k - 1], TINY * scale), right[k] - factor * rest
        gain = gain + rest**2 / pivot
    allowed = (b > 0) & (b < c) & (c < count - 1)
    return np.where(allowed, gain, -np.inf)
