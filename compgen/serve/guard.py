"""What every request passes and every answer carries: host names, origin, headers."""

from __future__ import annotations

import re

from flask import Request, Response
from werkzeug.exceptions import Forbidden, HTTPException, MethodNotAllowed

from compgen.serve.settings import Settings

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


def check_host(request: Request, settings: Settings) -> None:
    """Refuse names that are not ours: a foreign page that points its name at this computer (DNS rebinding)."""
    found = HOST.fullmatch(request.headers.get("Host", ""))
    if found is None or found["name"].lower() not in settings.host_names:
        raise Misdirected


def check_method(request: Request) -> None:
    """Refuse methods that no page knows, before anything else of the request is looked at."""
    if request.method not in METHODS:
        raise MethodNotAllowed(METHODS)


def check_origin(request: Request, settings: Settings) -> None:
    """Refuse a request that would change something unless it comes from our own pages."""
    own = f"{settings.scheme}://{request.headers.get('Host', '')}"
    origin = request.headers.get("Origin")
    if origin is None:
        referrer = request.headers.get("Referer", "")
        origin = own if referrer.startswith(f"{own}/") else None
    if origin != own or request.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
        raise Forbidden("This request does not come from a page of this dashboard.")


def add_headers(response: Response, settings: Settings) -> Response:
    """Put the security headers on an answer."""
    for name, value in HEADERS.items():
        response.headers[name] = value
    if settings.tls:
        response.headers["Strict-Transport-Security"] = "max-age=31536000"
    return response


def cookie_name(settings: Settings, name: str) -> str:
    """Return the name of a cookie; over HTTPS one that browsers tie to this host."""
    return f"__Host-compgen-{name}" if settings.tls else f"compgen-{settings.port}-{name}"


def set_cookie(response: Response, settings: Settings, name: str, value: str, seconds: int | None = None) -> None:
    """Set a cookie that scripts cannot read and other sites cannot send; an empty value removes it."""
    age = seconds if value else 0
    full = cookie_name(settings, name)
    response.set_cookie(full, value, max_age=age, secure=settings.tls, httponly=True, samesite="Strict", path="/")
