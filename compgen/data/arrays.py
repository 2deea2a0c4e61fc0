"""Distinct values and medians of arrays.

As numpy's own, which load ``numpy.ma`` to ask whether an array is masked: a third of the time that numpy itself takes.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)


def distinct(values: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return finite values of any shape without repetition, ascending, (n,).

    >>> distinct(np.array([3.0, 1.0, 3.0])).tolist()
    [1.0, 3.0]
    """
    ordered = np.sort(values, axis=None)
    fresh = np.ones(len(ordered), dtype=np.bool_)
    np.not_equal(ordered[1:], ordered[:-1], out=fresh[1:])
    return ordered[fresh]


def median(values: NDArray[np.float64]) -> float:
    """Return the median of values (n,), nan if one of them is or there are none.

    >>> median(np.array([4.0, 1.0, 2.0]))
    2.0
    """
    count = len(values)
    if not count:
        return float("nan")
    ordered = np.partition(values, [(count - 1) // 2, count // 2, count - 1])
    middle = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
    return float(ordered[-1] if np.isnan(ordered[-1]) else middle)
