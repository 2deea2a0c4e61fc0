"""What is kept between requests: figures that take more than a moment, and pages as long as nothing changes.

Figures are worked out one at a time in a thread beside the requests: nobody can keep all processors busy by asking.
Whoever asks waits a little and is told to come again.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from dataclasses import dataclass, field
from typing import Any

from compgen.errors import InputError

#: Results that stay in memory, and questions that may wait for their turn.
MOST, WAITING = 300, 20
#: How long a request waits for a result, s.
PATIENCE_S = 0.7
#: Pages that are kept; how long one is shown that says how long ago something was, and one that waits for figures, s.
PAGES, SHOWN_S, WAITING_SHOWN_S = 200, 60.0, 1.0


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


@dataclass
class _Page:
    """One page, what it was made from, and until when it is shown; made by one request while the others wait."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    made_from: Hashable = None
    until: float = 0.0
    text: str = ""


class Pages:
    """Pages by address, each made once for every state of what it shows.

    ``state`` tells it; every request asks, so that a page is never older than what could be read then.
    """

    def __init__(self, state: Callable[[], Hashable]) -> None:
        self._state, self._lock = state, threading.Lock()
        self._pages: OrderedDict[Hashable, _Page] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], tuple[str, bool]]) -> str:
        """Return the page; ``make`` gives its text, and whether it is complete: if not, it is made again soon."""
        state = self._state()
        with self._lock:
            page = self._pages.setdefault(key, _Page())
            self._pages.move_to_end(key)
            while len(self._pages) > PAGES:
                self._pages.popitem(last=False)
        with page.lock:
            if page.made_from != state or time.monotonic() >= page.until:
                page.text, complete = make()
                page.made_from, page.until = state, time.monotonic() + (SHOWN_S if complete else WAITING_SHOWN_S)
            return page.text
