"""Legendre polynomials over the travel of an axis: the shapes of effects that vary with position."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray


def legendre(s: FloatArray, degrees: range) -> FloatArray:
    """Legendre polynomials P_k(s) of normalised positions (n,) for the given degrees, (n, k).

    >>> legendre(np.array([0.5]), range(1, 3))
    array([[ 0.5  , -0.125]])
    """
    every = np.polynomial.legendre.legvander(s, max(degrees))
    return np.asarray(every[:, list(degrees)])
