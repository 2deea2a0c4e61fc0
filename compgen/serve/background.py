"""Figures that take more than a moment: worked out one at a time beside the requests, and kept.

One thread: nobody can keep all processors busy by asking. Whoever asks waits a little and is told to come again.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from typing import Any

from compgen.errors import InputError

#: Results that stay in memory, and questions that may wait for their turn.
MOST, WAITING = 300, 20
#: How long a request waits for a result, s.
PATIENCE_S = 0.7


class NotReadyError(Exception):
    """The figures are being worked out; ask again in a moment."""


class Background:
    """Results by a key that says everything they depend on."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="figures")
        self._lock = threading.Lock()
        self._known: OrderedDict[Hashable, Future[Any]] = OrderedDict()

    def get(self, key: Hashable, work: Callable[[], Any], patience_s: float | None = None) -> Any:
        """Return what ``work`` gives, or raise what it raises.

        Raises
        ------
        NotReadyError
            if that takes longer than ``patience_s`` (None: :data:`PATIENCE_S`), or too many questions wait.
        """
        with self._lock:
            future = self._known.get(key)
            if future is None:
                if sum(not item.done() for item in self._known.values()) >= WAITING:
                    raise NotReadyError
                future = self._known[key] = self._pool.submit(work)
            self._known.move_to_end(key)
            self._forget()
        try:
            return future.result(PATIENCE_S if patience_s is None else patience_s)
        except NotYetError as error:
            raise NotReadyError from error
        except InputError:
            raise
        except Exception:
            with self._lock:  # what may pass by itself is tried again by the next question
                self._known.pop(key, None)
            raise

    def _forget(self) -> None:
        """Drop what was not asked for longest; what is being worked out stays."""
        for key in [key for key, item in self._known.items() if item.done()][: max(0, len(self._known) - MOST)]:
            del self._known[key]
