"""Protection of pages: host names, origin, headers, sessions, rate limit of logins.

Flask-Login and Flask-WTF are not used for sessions because they keep them in a signed browser cookie: a copy of the
cookie remains valid after the user logged out, logged in again or was idle too long, and a key would have to be stored.
Here the browser has a random token and the server its hash, so a restart logs everybody out. The limit counts an
attempt before its password is checked and takes a successful one back, which the windows of Flask-Limiter cannot do.
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
from flask import Response as FlaskResponse
from werkzeug.exceptions import Forbidden, HTTPException, MethodNotAllowed
from werkzeug.wrappers import Response

from compgen.web.site import Site

HOST = re.compile(r"(?P<name>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+)(:(?P<port>[0-9]{1,5}))?")
METHODS = ("GET", "HEAD", "OPTIONS", "POST")
#: No scripts, nothing from other sites, no frames around the pages.
POLICY = (
    "default-src 'none'; style-src 'self'; img-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # with no-referrer, browsers send forms with "Origin: null"
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    "Cache-Control": "no-store",
}


class Misdirected(HTTPException):
    """The request uses a host name that is not one of the server's."""

    code = 421
    description = "This server does not have that name; add it with --name."


def check_host(request: Request, site: Site) -> None:
    """Refuse other host names: a foreign page may point its name at this computer (DNS rebinding)."""
    found = HOST.fullmatch(request.headers.get("Host", ""))
    if found is None or found["name"].lower() not in site.host_names:
        raise Misdirected


def check_method(request: Request) -> None:
    """Refuse methods that no page supports, before anything else in the request is checked."""
    if request.method not in METHODS:
        raise MethodNotAllowed(METHODS)


def check_origin(request: Request, site: Site) -> None:
    """Refuse a request that would change something unless it comes from the dashboard's pages."""
    own = f"{site.scheme}://{request.headers.get('Host', '')}"
    origin = request.headers.get("Origin")
    if origin is None:
        referrer = request.headers.get("Referer", "")
        origin = own if referrer.startswith(f"{own}/") else None
    if origin != own or request.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
        raise Forbidden("This request does not come from a page of this dashboard.")


def add_headers(response: Response, site: Site) -> None:
    """Add the security headers to a response."""
    for name, value in HEADERS.items():
        response.headers[name] = value
    if site.tls:
        response.headers["Strict-Transport-Security"] = "max-age=31536000"


def cookie_name(site: Site, name: str) -> str:
    """Return the name of a cookie; over HTTPS a name that browsers bind to this host."""
    return f"__Host-compgen-{name}" if site.tls else f"compgen-{site.port}-{name}"


def set_cookie(response: Response, site: Site, name: str, value: str, seconds: int | None = None) -> None:
    """Set a cookie that scripts cannot read and other sites cannot send; an empty value removes it."""
    age = seconds if value else 0
    full = cookie_name(site, name)
    response.set_cookie(full, value, max_age=age, secure=site.tls, httponly=True, samesite="Strict", path="/")


# --- sessions ------------------------------------------------------------------------------------------------------

Clock = Callable[[], float]

#: A session ends after this time without a request, and after this time in any case, s.
IDLE_S, LONGEST_S = 1800.0, 12 * 3600.0
#: Largest number of sessions; the one idle for longest is ended for a new one.
MOST = 1000


@dataclass
class LoginSession:
    """One logged-in user; ``stamp`` changes with the password, ``messages`` wait for the next page."""

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
        """Begin a session and return its token, which is always new."""
        token, now = secrets.token_urlsafe(32), self._clock()
        with self._lock:
            self._forget_old(now)
            if len(self._sessions) >= MOST:
                del self._sessions[min(self._sessions, key=lambda key: self._sessions[key].used)]
            self._sessions[_key(token)] = LoginSession(user, stamp, secrets.token_urlsafe(32), now, now)
        return token

    def find(self, token: str | None) -> LoginSession | None:
        """Return the session of a token and mark it as used; None if it is unknown or has ended."""
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
        """End the session of a token, if it exists."""
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
    """Bind the login form to the browser that requested it, before there is a session."""

    def __init__(self) -> None:
        self._secret = secrets.token_bytes(32)

    def issue(self) -> tuple[str, str]:
        """Return a new cookie and the form field that belongs to it."""
        cookie = secrets.token_urlsafe(24)
        return cookie, self._field(cookie)

    def right(self, cookie: str | None, field: str) -> bool:
        """Whether cookie and field belong together."""
        return bool(cookie) and same(self._field(cookie or ""), field)

    def _field(self, cookie: str) -> str:
        return hmac.new(self._secret, cookie.encode("utf-8", "replace"), hashlib.sha256).hexdigest()


def same(first: str, second: str) -> bool:
    """Compare two secrets in a time that reveals nothing about them."""
    return hmac.compare_digest(first.encode("utf-8", "replace"), second.encode("utf-8", "replace"))


def _key(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()


# --- rate limit of logins ------------------------------------------------------------------------------------------

#: Time window in which attempts are counted, s.
WINDOW_S = 300.0
#: Failed attempts allowed in a window: for one name from one address, for one address, for one name, in total.
PAIR, ADDRESS, NAME, ALL = 5, 20, 20, 200


class LoginLimit:
    """Count attempts, each before its password is checked: simultaneous attempts count too."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._tries: dict[tuple[str, ...], deque[float]] = {}

    def wait_s(self, address: str, name: str) -> float:
        """Count an attempt and return 0, or return how long to wait, s, and count nothing."""
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
        """Take back the successful attempt, and forget earlier ones of this name from this address."""
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


def error_response(page: str, error: HTTPException) -> FlaskResponse:
    """Return the page of an HTTP error with its code, and what it tells the browser: allowed methods, when to come again."""
    response = FlaskResponse(page, error.code or 500)
    for name, value in error.get_headers():
        if name.lower() in ("allow", "retry-after"):
            response.headers[name] = value
    return response
