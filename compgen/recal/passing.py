"""Troubles that may pass by themselves, so that a measurement is tried again instead of being given up."""

from __future__ import annotations

import errno

from compgen.recal.database import StoreError

#: A full disk or one with a limit, a file that cannot be read now, too many open files.
PASSING = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.EACCES,
    errno.EPERM,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
    errno.EROFS,
    errno.ESTALE,
    errno.EBUSY,
)


def passes(error: BaseException) -> bool:
    """Whether the cause may pass by itself: one of :data:`PASSING`, too little memory, a store that is away."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError | StoreError) or (isinstance(cause, OSError) and cause.errno in PASSING):
            return True
        cause = cause.__cause__
    return False
