"""One BLAS thread: for matrices of a few hundred columns a second thread only waits."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Limit the numerical libraries to one thread for the duration of a ``with`` block."""
    limiter: AbstractContextManager[object] = _controller().limit(limits=1)
    return limiter
