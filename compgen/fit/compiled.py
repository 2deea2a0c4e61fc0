"""Compiled solution of the banded systems of smooth curves. Needs numba."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

from numba import types

from compgen.core.kernels import compile_for

_BAND = types.Array(types.float64, 2, "F")
_VECTOR = types.float64[::1]


def _solve(band: Any, pull: Any, out: Any) -> Any:
    """Solve A c = pull with A = L D L^T of half-bandwidth 2, ``band`` (3, N) lower; True if A is positive definite.

    One pass down (factor and forward substitution) and one back; ``band`` receives 1/D and the two columns of L.
    """
    beside, beyond_it, earlier = 0.0, 0.0, 0.0  # of L: below the last column twice, below the one before it
    before, last = 0.0, 0.0
    for j in range(len(pull)):
        pivot = band[0, j]
        if not pivot > 0.0:
            return False
        inverse, below, beyond = 1.0 / pivot, band[1, j], band[2, j]
        first, second = below * inverse, beyond * inverse
        if j + 1 < len(pull):
            band[0, j + 1] -= first * below
            band[1, j + 1] -= first * beyond
        if j + 2 < len(pull):
            band[0, j + 2] -= second * beyond
        band[0, j], band[1, j], band[2, j] = inverse, first, second
        value = pull[j] - beside * before - earlier * last
        out[j] = value
        last, before = before, value
        earlier, beside, beyond_it = beyond_it, first, second
    after, next_after = 0.0, 0.0
    for j in range(len(pull) - 1, -1, -1):
        value = out[j] * band[0, j] - band[1, j] * after - band[2, j] * next_after
        out[j] = value
        next_after, after = after, value
    return True


@lru_cache(maxsize=1)
def band_solver() -> Callable[..., bool]:
    """Kernel ``(band, pull, out)``: solves in place, False if the band is not positive definite."""
    return compile_for(_solve, types.boolean(_BAND, _VECTOR, _VECTOR))
