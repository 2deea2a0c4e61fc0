"""The web application: what every request goes through, the pages for errors, and the logs."""

from __future__ import annotations

import re
import time
import traceback
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from flask import Flask, Response, current_app, g, redirect, render_template, request
from jinja2 import StrictUndefined
from werkzeug.exceptions import Forbidden, HTTPException
from werkzeug.wrappers import Response as BaseResponse

from compgen.errors import CompgenError
from compgen.recal import logs
from compgen.recal.database import StoreError
from compgen.recal.store import Store, open_store
from compgen.resources import data_folder
from compgen.serve import reading, signing
from compgen.serve.chart import UNITS, number
from compgen.serve.fleet import STATUSES
from compgen.serve.guard import add_headers, check_host, check_method, check_origin, cookie_name
from compgen.serve.service import Service, make_service
from compgen.serve.sessions import Session, same
from compgen.serve.settings import Settings, check_settings

#: Largest body of a request, bytes, and parts of a form.
LARGEST_BODY, MOST_PARTS = 16_384, 20
#: Methods that change nothing.
SAFE = ("GET", "HEAD", "OPTIONS")
#: Pages that show nothing of the store, so that they need no login.
OPEN_PAGES = ("signing.login", "signing.log_in", "reading.style", "reading.health", "reading.metrics")


def make_app(settings: Settings, store: Store | None = None, clock: Callable[[], float] = time.monotonic) -> Flask:
    """Return the application.

    Parameters
    ----------
    settings : see :class:`Settings`; checked here.
    store : an open store; without one that of the settings is opened.
    clock : seconds; for tests of sessions and limits.

    Raises
    ------
    InputError, StoreError
        for settings that are not safe, and a store that cannot be opened.
    """
    check_settings(settings)
    folder = data_folder("templates") / "_serve"
    app = Flask("compgen.serve", static_folder=None, template_folder=str(folder))
    app.config.update(MAX_CONTENT_LENGTH=LARGEST_BODY, MAX_FORM_MEMORY_SIZE=LARGEST_BODY, MAX_FORM_PARTS=MOST_PARTS)
    app.jinja_env.autoescape = True
    app.jinja_env.undefined = StrictUndefined
    app.jinja_env.trim_blocks = app.jinja_env.lstrip_blocks = True
    app.jinja_env.filters.update(
        unit=UNITS.__getitem__, micro=_micro, when=_when, figure=_figure, signed=_signed, ago=_ago
    )
    app.jinja_env.globals.update(STATUSES=STATUSES, page_url=reading.page_url)
    app.extensions["compgen"] = make_service(settings, store or open_store(settings.store_url), clock)
    app.url_map.converters["number"] = reading.Number
    app.before_request(_begin)
    app.after_request(_finish)
    app.context_processor(_context)
    app.register_error_handler(HTTPException, _http_error)
    app.register_error_handler(CompgenError, _own_error)
    app.register_error_handler(Exception, _unexpected)
    app.register_blueprint(reading.pages)
    app.register_blueprint(signing.pages)
    return app


def service() -> Service:
    """Return what the application of this request shares."""
    found: Service = current_app.extensions["compgen"]
    return found


def _begin() -> BaseResponse | None:
    """Check host, method, login and, for what may change something, origin and token; in this order, before any page."""
    g.began, g.session = time.perf_counter(), None
    own = service()
    own.background.began()
    check_host(request, own.settings)
    check_method(request)
    g.session = _session(own)
    if request.method not in SAFE:
        check_origin(request, own.settings)
        if request.endpoint != "signing.log_in":
            _check_session(own)
    if own.settings.private and g.session is None and request.endpoint not in OPEN_PAGES:
        return redirect("/login", code=303)
    return None


def _session(own: Service) -> Session | None:
    """Return the session of the request; none if the user is gone or has another password now."""
    token = request.cookies.get(cookie_name(own.settings, "session"))
    session = own.sessions.find(token) if own.users is not None else None
    if session is not None and own.users is not None and own.users.stamp(session.user) != session.stamp:
        own.sessions.end(token)
        return None
    return session


def _check_session(own: Service) -> None:
    if g.session is None:
        raise Forbidden("Log in first; a session ends after half an hour without a request.")
    if not same(g.session.csrf, request.form.get("csrf", "")):
        raise Forbidden("The form does not belong to this session; open the page again.")


def _context() -> dict[str, Any]:
    own, session = service(), g.get("session")
    if g.get("for_all") and session is not None:
        may_decide = own.may_decide(session.user)
        return {"settings": own.settings, "messages": [], "may_decide": may_decide, **reading.PLACES}
    messages = list(session.messages) if session is not None else []
    if session is not None:
        session.messages.clear()
    return {
        "settings": own.settings,
        "user": session.user if session is not None else None,
        "csrf": session.csrf if session is not None else "",
        "messages": messages,
        "may_decide": session is not None and own.may_decide(session.user),
    }


def _finish(response: Response) -> Response:
    """Headers, counters, one line of log; nothing of a form or a cookie goes there."""
    own = service()
    own.background.ended()
    seconds = time.perf_counter() - g.get("began", time.perf_counter())
    endpoint = (request.endpoint or "none").rpartition(".")[2]
    method = request.method if request.method in (*SAFE, "POST") else "other"
    own.metrics.requests.labels(endpoint, method, str(response.status_code)).inc()
    own.metrics.seconds.labels(endpoint).observe(seconds)
    if endpoint not in ("metrics", "health", "style"):
        session = g.get("session")
        logs.info(
            "request",
            method=method,
            path=request.path[:200],
            status=response.status_code,
            ms=round(seconds * 1e3, 1),
            address=request.remote_addr,
            user=session.user if session is not None else None,
        )
    return add_headers(response, own.settings)


def _http_error(error: HTTPException) -> Response | tuple[str, int] | HTTPException:
    code = error.code or 500
    if code < 400:
        return error
    if code in (403, 421, 413, 429):
        service().metrics.refused.labels({403: "forbidden", 421: "host", 413: "size", 429: "rate"}[code]).inc()
    text = error.description or ""
    page = render_template("error.html", code=code, title=error.name, text=text)
    response = Response(page, code)
    for name, value in error.get_headers():
        if name.lower() in ("allow", "retry-after"):
            response.headers[name] = value
    return response


def _own_error(error: CompgenError) -> tuple[str, int]:
    """Show what the program itself says: a decision that cannot be made, a store that cannot be reached."""
    if isinstance(error, StoreError):
        logs.error("store", problem=str(error))
        text = "The store cannot be used at the moment; the log says why."
        return render_template("error.html", code=503, title="Store not available", text=text), 503
    return render_template("error.html", code=409, title="Not done", text=str(error)), 409


def _unexpected(error: Exception) -> tuple[str, int]:
    place = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(place.filename).name}:{place.lineno}"
    logs.error("internal error", problem=f"{type(error).__name__}: {error}", where=where, path=request.path[:200])
    text = "This is a fault of the program; its log says more."
    return render_template("error.html", code=500, title="Internal error", text=text), 500


def _when(time: datetime | None) -> str:
    return "" if time is None else time.astimezone(UTC).strftime("%Y-%m-%d %H:%M")


def _ago(time: datetime | None) -> str:
    """Say in days how long ago a time is."""
    if time is None:
        return ""
    days = (datetime.now(UTC) - time).days
    return "in the future" if days < 0 else "today" if days == 0 else f"{days} d ago"


def _figure(value: float | None, digits: int = 2) -> str:
    """Return a number with fixed digits, a dash for one that is not known; no minus before a zero."""
    if value is None or value != value:
        return "\N{EN DASH}"
    if abs(value) >= 1e5:
        return number(value)
    return f"{value:z.{digits}f}".replace("-", "\N{MINUS SIGN}")


def _signed(value: float | None, digits: int = 2) -> str:
    if value is None or value != value:
        return "\N{EN DASH}"
    return f"{value:+z.{digits}f}".replace("-", "\N{MINUS SIGN}")


def _micro(text: str) -> str:
    """Write units as pages do."""
    return re.sub(r"\b(um|urad)\b", lambda found: UNITS[found[0]], text)
