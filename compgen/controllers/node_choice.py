"""The fewest nodes of a polyline that stays within a tolerance of curves: a shortest path over candidate nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray


def fewest_nodes(
    position_mm: FloatArray, values: FloatArray, tolerances: FloatArray, required: Sequence[int] = ()
) -> list[int]:
    """Return the indices of the fewest candidates whose polylines hold every curve, ends included.

    Parameters
    ----------
    position_mm : candidates (n,), ascending.
    values : curves at the candidates, shape (k, n); between them they are straight.
    tolerances : largest deviation of each curve at the candidates, shape (k,).
    required : indices that must be nodes.

    Among the smallest sets that with the least sum of squared deviations (in tolerances) is taken. Exact: dynamic
    programming over all pairs; a pair is allowed if the line between the two passes all candidates in between.
    """
    count = len(position_mm)
    scaled = np.asarray(values, dtype=np.float64) / np.asarray(tolerances, dtype=np.float64)[:, None]
    best = np.full((count, 2), np.inf)  # number of pieces, sum of squares; of the part up to the node
    best[0], before = 0.0, np.zeros(count, dtype=np.int64)
    stops = sorted({*required, count - 1})
    for first in range(count - 1):
        stop = next(index for index in stops if index > first)
        fits, squares = _pieces(position_mm[first : stop + 1], scaled[:, first : stop + 1])
        for last in (first + 1 + np.flatnonzero(fits)).tolist():
            pieces, square = best[first, 0] + 1.0, best[first, 1] + squares[last - first - 1]
            if pieces < best[last, 0] or (pieces == best[last, 0] and square < best[last, 1]):
                best[last], before[last] = (pieces, square), first
    path = [count - 1]
    while path[-1]:
        path.append(int(before[path[-1]]))
    return path[::-1]


def _pieces(position_mm: FloatArray, values: FloatArray) -> tuple[np.ndarray, FloatArray]:
    """For the lines from the first candidate to every later one: whether all between lie within 1, sum of squares.

    ``values`` (k, n); both results have shape (n-1,).
    """
    along = position_mm[1:] - position_mm[0]
    rise = values[:, 1:] - values[:, :1]
    slope = rise / along
    nothing = np.full((len(values), 1), np.inf)
    lowest = np.hstack([-nothing, np.maximum.accumulate((rise - 1.0) / along, axis=1)[:, :-1]])
    highest = np.hstack([nothing, np.minimum.accumulate((rise + 1.0) / along, axis=1)[:, :-1]])
    margin = 1e-9 * (1.0 + np.abs(slope))
    fits = np.all((slope >= lowest - margin) & (slope <= highest + margin), axis=0)
    xx, xy, yy = np.cumsum(along**2), np.cumsum(along * rise, axis=1), np.cumsum(rise**2, axis=1)
    squares = np.sum(yy - 2.0 * slope * xy + slope**2 * xx, axis=0)  # the end itself adds nothing
    return fits, np.maximum(squares, 0.0)
