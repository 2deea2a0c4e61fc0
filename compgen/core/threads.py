"""One BLAS thread: for matrices of a few hundred columns a second thread only waits, and another number rounds otherwise."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _controller(with_scipy: bool) -> ThreadpoolController:
    """Libraries found so far: scipy brings one of its own, which is not there before ``scipy.linalg`` is imported."""
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Limit the numerical libraries to one thread for the duration of a ``with`` block."""
    limiter: AbstractContextManager[object] = _controller("scipy.linalg" in sys.modules).limit(limits=1)
    return limiter
