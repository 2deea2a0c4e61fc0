"""What is kept between requests: figures that take more than a moment, and pages as long as nothing changes.

Figures are worked out one at a time in a thread beside the requests: nobody can keep all processors busy by asking.
Whoever asks waits a little and is told to come again.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from dataclasses import dataclass, field
from typing import Any

from compgen.errors import InputError
from compgen.recal import logs

#: Results that stay in memory, and questions that may wait for their turn.
MOST, WAITING = 300, 20
#: Pieces of work that may wait for an idle moment.
MOST_LATER = 2000
#: After so long without a request they begin, and after so long in any case, s.
REST_S, AT_LATEST_S = 2.0, 30.0
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
        self._idle: OrderedDict[Hashable, Callable[[], None]] = OrderedDict()
        self._idling = False
        self._requests, self._last, self._since = 0, time.monotonic(), 0.0

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

    def later(self, key: Hashable, work: Callable[[], None]) -> None:
        """Do ``work``, which keeps its result itself, when nobody asks for anything; once while it is still to be done.

        It begins :data:`REST_S` after the last request, or after :data:`AT_LATEST_S` on a server that never rests.
        """
        with self._lock:
            if len(self._idle) < MOST_LATER:
                self._idle.setdefault(key, work)
            if not self._idling:
                self._idling, self._since = True, time.monotonic()
                self._wait()

    def began(self) -> None:
        """Say that a request came."""
        with self._lock:
            self._requests += 1

    def ended(self) -> None:
        """Say that a request was answered."""
        with self._lock:
            self._requests, self._last = max(0, self._requests - 1), time.monotonic()

    def _wait(self) -> None:
        timer = threading.Timer(REST_S, self._when_at_rest)
        timer.daemon = True
        timer.start()

    def _when_at_rest(self) -> None:
        with self._lock:
            now = time.monotonic()
            rests = self._requests == 0 and now - self._last >= REST_S and all(f.done() for f in self._known.values())
            if not rests and now - self._since < AT_LATEST_S:
                self._wait()
                return
            _, work = self._idle.popitem(last=False)
        with contextlib.suppress(RuntimeError):  # the server stops
            self._pool.submit(self._do, work)

    def _do(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # it is asked for again; the page of that machine says what is wrong
            logs.warning("figures not worked out", problem=f"{type(error).__name__}: {error}")
        with self._lock:
            self._since, self._idling = time.monotonic(), bool(self._idle)
            at_rest = self._requests == 0 and self._since - self._last >= REST_S
        if self._idling and at_rest:
            self._when_at_rest()
        elif self._idling:
            self._wait()

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
