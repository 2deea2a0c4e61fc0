"""Arithmetic that does not depend on the processors, or on what the process did before: the same bits everywhere.

Compiled loops are otherwise loaded when a process comes to need them, and round differently from numpy's.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from compgen.core.threads import one_thread

_steady: ContextVar[bool] = ContextVar("compgen_steady", default=False)


@contextmanager
def steady() -> Iterator[None]:
    """Use one thread, and compiled loops only where the size of the data alone asks for them, for this block."""
    before = _steady.set(True)
    try:
        with one_thread():
            yield
    finally:
        _steady.reset(before)


def is_steady() -> bool:
    """Whether the current block is to give the same bits in every process."""
    return _steady.get()
