"""Sessions live in the memory of the server: the browser holds a random token, the server its hash.

Nothing is signed, so there is no secret to keep; a restart logs everybody out.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

Clock = Callable[[], float]

#: A session ends after this time without a request, and after this time in any case, s.
IDLE_S, LONGEST_S = 1800.0, 12 * 3600.0
#: Sessions at the same time; the one that rested longest gives way.
MOST = 1000


@dataclass
class Session:
    """One user who is logged in; ``stamp`` changes with the password, ``messages`` wait for the next page."""

    user: str
    stamp: str
    csrf: str
    began: float
    used: float
    messages: list[str] = field(default_factory=list)


class Sessions:
    """All sessions of this server."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._sessions: dict[str, Session] = {}

    def begin(self, user: str, stamp: str) -> str:
        """Begin a session and return its token, which is always a new one."""
        token, now = secrets.token_urlsafe(32), self._clock()
        with self._lock:
            self._forget_old(now)
            if len(self._sessions) >= MOST:
                del self._sessions[min(self._sessions, key=lambda key: self._sessions[key].used)]
            self._sessions[_key(token)] = Session(user, stamp, secrets.token_urlsafe(32), now, now)
        return token

    def find(self, token: str | None) -> Session | None:
        """Return the session of a token and count it as used; None for one that is unknown or over."""
        if not token:
            return None
        now = self._clock()
        with self._lock:
            self._forget_old(now)
            session = self._sessions.get(_key(token))
            if session is not None:
                session.used = now
            return session

    def end(self, token: str | None) -> None:
        """End the session of a token, if there is one."""
        with self._lock:
            self._sessions.pop(_key(token or ""), None)

    def _forget_old(self, now: float) -> None:
        over = [k for k, s in self._sessions.items() if now - s.used > IDLE_S or now - s.began > LONGEST_S]
        for key in over:
            del self._sessions[key]

    def __len__(self) -> int:
        with self._lock:
            self._forget_old(self._clock())
            return len(self._sessions)


class LoginTokens:
    """Ties the login form to the browser that asked for it, before there is a session."""

    def __init__(self) -> None:
        self._secret = secrets.token_bytes(32)

    def issue(self) -> tuple[str, str]:
        """Return a new cookie and the field of the form that belongs to it."""
        cookie = secrets.token_urlsafe(24)
        return cookie, self._field(cookie)

    def right(self, cookie: str | None, field: str) -> bool:
        """Whether cookie and field belong together."""
        return bool(cookie) and same(self._field(cookie or ""), field)

    def _field(self, cookie: str) -> str:
        return hmac.new(self._secret, cookie.encode("utf-8", "replace"), hashlib.sha256).hexdigest()


def same(first: str, second: str) -> bool:
    """Compare two secrets in a time that says nothing about them."""
    return hmac.compare_digest(first.encode("utf-8", "replace"), second.encode("utf-8", "replace"))


def _key(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()
