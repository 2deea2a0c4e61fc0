"""Rate limit of logins: how many tries a name, an address and everybody together have in a window of time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

WINDOW_S = 300.0
#: Tries that fail in one window: for one name from one address, for one address, for one name, for all together.
PAIR, ADDRESS, NAME, ALL = 5, 20, 20, 200


class LoginLimit:
    """Counts tries; a try counts before its password is looked at, so that tries at the same time count too."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._tries: dict[tuple[str, ...], deque[float]] = {}

    def wait_s(self, address: str, name: str) -> float:
        """Count a try and return 0, or return how long to wait, s, and count nothing."""
        now = self._clock()
        with self._lock:
            self._forget(now)
            keys = _keys(address, name)
            waits = [self._wait(key, limit, now) for key, limit in keys.items()]
            if max(waits) <= 0.0:
                for key in keys:
                    self._tries.setdefault(key, deque()).append(now)
            return max(waits)

    def succeeded(self, address: str, name: str) -> None:
        """Take back the try that was right, and forget the earlier ones of this name from this address."""
        pair, *others = _keys(address, name)
        with self._lock:
            self._tries.pop(pair, None)
            for key in others:
                if self._tries.get(key):
                    self._tries[key].pop()

    def _wait(self, key: tuple[str, ...], limit: int, now: float) -> float:
        tries = self._tries.get(key, ())
        return tries[-limit] + WINDOW_S - now if len(tries) >= limit else 0.0

    def _forget(self, now: float) -> None:
        for key, tries in list(self._tries.items()):
            while tries and now - tries[0] >= WINDOW_S:
                tries.popleft()
            if not tries:
                del self._tries[key]


def _keys(address: str, name: str) -> dict[tuple[str, ...], int]:
    name = name.lower()
    return {("pair", address, name): PAIR, ("address", address): ADDRESS, ("name", name): NAME, ("all",): ALL}
