"""Protection of the dashboard: host names, origin, headers, sessions, rate limit of logins.

The sessions are our own and not those of Flask-Login and Flask-WTF, which keep them in a signed cookie of the browser: a
copy of such a cookie is still good after the user logged out, logged in again or rested too long, and a key would have to be
kept. Here the browser holds a random token and the server its hash, so a restart logs everybody out. The limit counts a try
before its password is looked at and takes the right one back, which the windows of Flask-Limiter cannot.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from flask import Request
from werkzeug.exceptions import Forbidden, HTTPException, MethodNotAllowed
from werkzeug.wrappers import Response

from compgen.fleet.dashboard.settings import DashboardSettings

HOST = re.compile(r"(?P<name>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+)(:(?P<port>[0-9]{1,5}))?")
METHODS = ("GET", "HEAD", "OPTIONS", "POST")
#: No script at all, nothing from elsewhere, no frame around the pages.
POLICY = (
    "default-src 'none'; style-src 'self'; img-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # with no-referrer browsers would send forms with "Origin: null"
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    "Cache-Control": "no-store",
}


class Misdirected(HTTPException):
    """The request calls the server by a name that is not its own."""

    code = 421
    description = "This server is not known by that name; --name adds one."


def check_host(request: Request, settings: DashboardSettings) -> None:
    """Refuse names that are not ours: a foreign page that points its name at this computer (DNS rebinding)."""
    found = HOST.fullmatch(request.headers.get("Host", ""))
    if found is None or found["name"].lower() not in settings.host_names:
        raise Misdirected


def check_method(request: Request) -> None:
    """Refuse methods that no page knows, before anything else of the request is looked at."""
    if request.method not in METHODS:
        raise MethodNotAllowed(METHODS)


def check_origin(request: Request, settings: DashboardSettings) -> None:
    """Refuse a request that would change something unless it comes from our own pages."""
    own = f"{settings.scheme}://{request.headers.get('Host', '')}"
    origin = request.headers.get("Origin")
    if origin is None:
        referrer = request.headers.get("Referer", "")
        origin = own if referrer.startswith(f"{own}/") else None
    if origin != own or request.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
        raise Forbidden("This request does not come from a page of this dashboard.")


def add_headers(response: Response, settings: DashboardSettings) -> None:
    """Put the security headers on an answer."""
    for name, value in HEADERS.items():
        response.headers[name] = value
    if settings.tls:
        response.headers["Strict-Transport-Security"] = "max-age=31536000"


def cookie_name(settings: DashboardSettings, name: str) -> str:
    """Return the name of a cookie; over HTTPS one that browsers tie to this host."""
    return f"__Host-compgen-{name}" if settings.tls else f"compgen-{settings.port}-{name}"


def set_cookie(
    response: Response, settings: DashboardSettings, name: str, value: str, seconds: int | None = None
) -> None:
    """Set a cookie that scripts cannot read and other sites cannot send; an empty value removes it."""
    age = seconds if value else 0
    full = cookie_name(settings, name)
    response.set_cookie(full, value, max_age=age, secure=settings.tls, httponly=True, samesite="Strict", path="/")


# --- sessions ------------------------------------------------------------------------------------------------------

Clock = Callable[[], float]

#: A session ends after this time without a request, and after this time in any case, s.
IDLE_S, LONGEST_S = 1800.0, 12 * 3600.0
#: Sessions at the same time; the one that rested longest gives way.
MOST = 1000


@dataclass
class LoginSession:
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
        self._sessions: dict[str, LoginSession] = {}

    def begin(self, user: str, stamp: str) -> str:
        """Begin a session and return its token, which is always a new one."""
        token, now = secrets.token_urlsafe(32), self._clock()
        with self._lock:
            self._forget_old(now)
            if len(self._sessions) >= MOST:
                del self._sessions[min(self._sessions, key=lambda key: self._sessions[key].used)]
            self._sessions[_key(token)] = LoginSession(user, stamp, secrets.token_urlsafe(32), now, now)
        return token

    def find(self, token: str | None) -> LoginSession | None:
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


# --- rate limit of logins ------------------------------------------------------------------------------------------

#: Time in which tries are counted, s.
WINDOW_S = 300.0
#: Tries that fail in one window: for one name from one address, for one address, for one name, for all together.
PAIR, ADDRESS, NAME, ALL = 5, 20, 20, 200


class LoginLimit:
    """Counts tries; a try counts before its password is looked at, so that tries at the same time count too."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._tries: dict[tuple[str, ...], deque[float]] = {}

    def wait_s(self, address: str, name: str) -> float:
        """Count a try and return 0, or return how long to wait, s, and count nothing."""
        now = self._clock()
        with self._lock:
            self._forget(now)
            keys, wait_s = _keys(address, name), 0.0
            for key, limit in keys.items():
                tries = self._tries.get(key, ())
                if len(tries) >= limit:
                    wait_s = max(wait_s, tries[-limit] + WINDOW_S - now)
            if wait_s <= 0.0:
                for key in keys:
                    self._tries.setdefault(key, deque()).append(now)
            return wait_s

    def succeeded(self, address: str, name: str) -> None:
        """Take back the try that was right, and forget the earlier ones of this name from this address."""
        pair, *others = _keys(address, name)
        with self._lock:
            self._tries.pop(pair, None)
            for key in others:
                if self._tries.get(key):
                    self._tries[key].pop()

    def _forget(self, now: float) -> None:
        for key, tries in list(self._tries.items()):
            while tries and now - tries[0] >= WINDOW_S:
                tries.popleft()
            if not tries:
                del self._tries[key]


def _keys(address: str, name: str) -> dict[tuple[str, ...], int]:
    name = name.lower()
    return {("pair", address, name): PAIR, ("address", address): ADDRESS, ("name", name): NAME, ("all",): ALL}
