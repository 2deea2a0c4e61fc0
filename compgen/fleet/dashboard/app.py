"""The web application: what the pages share, read-only pages, login and decisions, and checks of every request.

Parts of the address are numbers, never file names. A request that may change something is checked before any page sees
it: host, method, origin, session, token (:func:`_begin_request`).
"""

from __future__ import annotations

import functools
import math
import re
import secrets
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from flask import Blueprint, Flask, Response, abort, current_app, g, make_response, redirect, render_template, request
from jinja2 import StrictUndefined
from markupsafe import escape
from werkzeug.exceptions import Forbidden, HTTPException
from werkzeug.routing import IntegerConverter
from werkzeug.wrappers import Response as BaseResponse

from compgen.drawing.charts import LABEL
from compgen.errors import CompgenError, InputError
from compgen.fleet import actions, decisions, logs
from compgen.fleet.actions import NotPublishedError
from compgen.fleet.dashboard.background import (
    Background,
    DriftCache,
    JobFile,
    NotReadyError,
    Pages,
    RecheckCache,
    basis,
    change_rows,
    drift_charts,
    requested_change,
    trend_rows,
)
from compgen.fleet.dashboard.charts import ErrorCache, find_table, history, proposal
from compgen.fleet.dashboard.metrics import CONTENT_TYPE, ServeMetrics
from compgen.fleet.dashboard.settings import DashboardSettings, check_settings
from compgen.fleet.dashboard.users import Users
from compgen.fleet.database import StoreError
from compgen.fleet.job import read_job
from compgen.fleet.recheck import format_recheck_points
from compgen.fleet.records import DecisionRecord, MachineRecord
from compgen.fleet.status import STATUSES, audit_page, fleet, fleet_page, machine_by_id
from compgen.fleet.store import Store, open_store
from compgen.resources import data_folder
from compgen.web.guard import (
    LONGEST_S,
    LoginLimit,
    LoginTokens,
    Sessions,
    add_headers,
    check_host,
    check_method,
    check_origin,
    cookie_name,
    error_response,
    same,
    set_cookie,
)

#: Maximum length of a reason, characters.
LONGEST_REASON = 1000


@dataclass(frozen=True)
class Service:
    """Everything that exists as long as the server runs."""

    settings: DashboardSettings
    store: Store
    users: Users | None
    sessions: Sessions
    tokens: LoginTokens
    limit: LoginLimit
    metrics: ServeMetrics
    errors_of: ErrorCache
    drift_of: DriftCache
    recheck_of: RecheckCache
    job: JobFile
    background: Background
    pages: Pages

    def may_decide(self, user: str) -> bool:
        """Whether this user may approve, reject and roll back here."""
        return self.settings.decide and self.users is not None and self.users.may_decide(user)


def make_service(settings: DashboardSettings, store: Store, clock: Callable[[], float] = time.monotonic) -> Service:
    """Return a service; ``clock`` (s) is for tests."""
    sessions, background, job = Sessions(clock), Background(), JobFile(settings.job)
    return Service(
        settings=settings,
        store=store,
        users=Users(settings.users) if settings.login and settings.users is not None else None,
        sessions=sessions,
        tokens=LoginTokens(),
        limit=LoginLimit(clock),
        metrics=ServeMetrics(store, lambda: len(sessions)),
        errors_of=ErrorCache(store),
        drift_of=DriftCache(store, background, job),
        recheck_of=RecheckCache(store, background),
        job=job,
        background=background,
        pages=Pages(lambda: (store.version(), job.state())),
    )


# --- read-only pages -----------------------------------------------------------------------------------------------

reading_pages = Blueprint("reading", __name__)
#: How long the page of a machine waits for the drift, s.
A_MOMENT_S = 0.2
NUMBER = "number(max=2147483647)"
#: Placeholders in a cached page for the reader's name and token; nobody can guess them.
PLACES = {name: f"{name}-{secrets.token_hex(16)}" for name in ("user", "csrf")}


class PlaceNumber(IntegerConverter):
    """A whole number in ASCII digits without leading zeros: each page has one address."""

    regex = "0|[1-9][0-9]{0,9}"


def the_service() -> Service:
    """Return what is shared by the pages of this application."""
    found: Service = current_app.extensions["compgen"]
    return found


def the_machine(machine_id: int) -> MachineRecord:
    """Return a machine or answer 404."""
    found = machine_by_id(the_service().store, machine_id)
    return found if found is not None else abort(404, "The store has no such machine.")


def kept(view: Callable[..., str]) -> Callable[..., str]:
    """Make a page once for all readers with the same rights, until something that it shows changes."""

    @functools.wraps(view)
    def wrapper(**arguments: int) -> str:
        service, session = the_service(), g.session
        if session is not None and session.messages:
            return view(**arguments)

        def make() -> tuple[str, bool]:
            g.for_all, g.complete = True, True
            try:
                return view(**arguments), g.complete
            finally:
                g.for_all = False

        rights = None if session is None else service.may_decide(session.user)
        page = service.pages.get((request.full_path, rights), make)
        if session is None:
            return page
        return page.replace(PLACES["user"], str(escape(session.user))).replace(PLACES["csrf"], session.csrf)

    return wrapper


def page_url(**arguments: Any) -> str:
    """Return the address of the fleet page with these selections."""
    return "/?" + urlencode({key: value for key, value in arguments.items() if value})


def _page_number() -> int:
    text = request.args.get("page", "1")
    return int(text) if re.fullmatch(r"[0-9]{1,6}", text) else 1


@reading_pages.get("/")
@kept
def overview() -> str:
    """Show the fleet."""
    words, status = request.args.get("q", "")[:100], request.args.get("status", "")
    status = status if status in STATUSES else ""
    page = fleet_page(fleet(the_service().store).rows, words, status, _page_number())
    measured = [row.machine for row in page.rows if row.measurements]
    outlooks = the_service().drift_of.outlooks(measured)
    g.complete = len(outlooks) == len(measured)
    return render_template("fleet.html", page=page, words=words, status=status, outlooks=outlooks)


@reading_pages.get(f"/machines/<{NUMBER}:machine_id>")
@kept
def machine(machine_id: int) -> str:
    """Show one machine's history, and its drift if already known."""
    service, found = the_service(), the_machine(machine_id)
    sentences, problem = None, ""
    try:
        sentences = service.drift_of(found, A_MOMENT_S).sentences()
    except NotReadyError:
        g.complete, problem = False, "The drift is being calculated."
    except InputError as error:
        problem = str(error)
    told = history(service.store, service.errors_of, found)
    return render_template("machine.html", h=told, sentences=sentences, problem=problem)


@reading_pages.get(f"/machines/<{NUMBER}:machine_id>/drift")
@kept
def drift(machine_id: int) -> str:
    """Show which errors changed, which drift, and when they exceed their tolerance."""
    found = the_machine(machine_id)
    try:
        known = the_service().drift_of(found)
    except NotReadyError:
        g.complete = False
        return render_template("drift.html", machine=found, waiting=True, problem="")
    except InputError as error:
        return render_template("drift.html", machine=found, waiting=False, problem=str(error))
    shown = {"rows": change_rows(known), "trends": trend_rows(known), "charts": drift_charts(known)}
    return render_template("drift.html", machine=found, waiting=False, problem="", drift=known, **shown)


@reading_pages.get(f"/machines/<{NUMBER}:machine_id>/recheck")
def recheck(machine_id: int) -> str:
    """Show the smallest set of points that would reveal a requested change of one error."""
    found, service = the_machine(machine_id), the_service()
    page: dict[str, Any] = {"machine": found, "waiting": False, "problem": "", "start": None, "plan": None}
    try:
        page["start"] = start = basis(service.store, found)
        page["requested"], page["change"] = requested_change(request.args, start, service.job.tolerances(found.name))
        page["plan"] = service.recheck_of(start, page["requested"])
    except NotReadyError:
        page["waiting"] = True
    except InputError as error:
        page["problem"] = str(error)
    return render_template("recheck.html", **page)


@reading_pages.get(f"/machines/<{NUMBER}:machine_id>/recheck.points.csv")
def recheck_points(machine_id: int) -> Response:
    """Send the points of a re-check as a points file; 409 if it is not possible, 503 while it is being calculated."""
    found, service = the_machine(machine_id), the_service()
    start = basis(service.store, found)
    change, _ = requested_change(request.args, start, service.job.tolerances(found.name))
    try:
        plan = service.recheck_of(start, change)
    except NotReadyError:
        abort(503, "The points are being calculated; try again in a moment.")
    return _download(format_recheck_points(plan).encode(), "recheck.points.csv")


@reading_pages.get(f"/machines/<{NUMBER}:machine_id>/tables/<{NUMBER}:version>")
@kept
def table(machine_id: int, version: int) -> str:
    """Show one set of tables, before and after."""
    service, found = the_service(), the_machine(machine_id)
    record = find_table(service.store, found, version)
    if record is None:
        abort(404, "The machine has no tables of this version.")
    return render_template("table.html", p=proposal(service.store, service.errors_of, found, record))


@reading_pages.get(f"/machines/<{NUMBER}:machine_id>/tables/<{NUMBER}:version>/files/<{NUMBER}:position>")
def download(machine_id: int, version: int, position: int) -> Response:
    """Send one file of a set of tables, byte for byte, as a download."""
    service = the_service()
    record = find_table(service.store, the_machine(machine_id), version)
    files = [] if record is None else service.store.table_files(record)
    if not 1 <= position <= len(files):
        abort(404, "There is no such file.")
    file = files[position - 1]
    return _download(file.content, re.sub(r"[^A-Za-z0-9._-]", "_", file.name.rpartition("/")[2]).lstrip(".") or "file")


def _download(content: bytes, name: str) -> Response:
    response = Response(content, mimetype="application/octet-stream")
    response.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return response


@reading_pages.get("/audit")
@kept
def audit() -> str:
    """Show who decided what, when and why, newest first."""
    people = request.args.get("who") == "people"
    page = audit_page(the_service().store, _page_number(), people=people)
    return render_template("audit.html", page=page, people=people)


@reading_pages.get("/metrics")
def metrics() -> Response:
    """Show the metrics; if reading needs a login, only with the token."""
    settings = the_service().settings
    if settings.private or settings.metrics_token:
        shown = request.headers.get("Authorization", "")
        if not settings.metrics_token or not same(shown, f"Bearer {settings.metrics_token}"):
            abort(403, "The metrics require a token.")
    return Response(the_service().metrics.text(), content_type=CONTENT_TYPE)


@reading_pages.get("/healthz")
def health() -> tuple[Response, int]:
    """Report whether the store can be read and is still the file that was opened."""
    store = the_service().store
    try:
        store.version()
    except CompgenError as error:
        logs.error("store", problem=str(error))
        return Response("store not available; see the log\n", mimetype="text/plain"), 503
    return Response("ok\n", mimetype="text/plain"), 200


@reading_pages.get("/style.css")
def style() -> Response:
    """Send the style sheet."""
    text = (data_folder("templates") / "_serve" / "style.css").read_text(encoding="utf-8")
    return Response(text, mimetype="text/css")


# --- login, logout, decisions --------------------------------------------------------------------------------------

signing_pages = Blueprint("signing", __name__)
#: Pages that a login may return to.
BACK = re.compile(r"/(audit|machines/[0-9]{1,10}(/tables/[0-9]{1,10})?)?")


@signing_pages.get("/login")
def login() -> BaseResponse:
    """Show the login form."""
    return _form("", 200)


def _form(problem: str, code: int, name: str = "") -> Response:
    service = the_service()
    if service.users is None:
        abort(404, "This dashboard is read-only; there is no login.")
    cookie, field = service.tokens.issue()
    back = request.values.get("back", "/")
    back = back if BACK.fullmatch(back) else "/"
    page = render_template("login.html", problem=problem, field=field, back=back, name=name)
    response = make_response(page, code)
    set_cookie(response, service.settings, "login", cookie)
    return response


@signing_pages.post("/login")
def log_in() -> BaseResponse:
    """Check name and password; a new session always begins, whatever the browser sent."""
    service = the_service()
    if service.users is None:
        abort(404, "This dashboard is read-only; there is no login.")
    name, password = request.form.get("name", "")[:100].strip(), request.form.get("password", "")
    cookie = request.cookies.get(cookie_name(service.settings, "login"))
    if not service.tokens.right(cookie, request.form.get("csrf", "")):
        return _form("The form has expired; try again.", 403, name)
    address = request.remote_addr or ""
    wait_s = service.limit.wait_s(address, name)
    if wait_s > 0.0:
        return _refused(name, address, wait_s)
    stamp = service.users.stamp(name)  # before the check: a password changed meanwhile ends the session
    if not service.users.verify(name, password) or stamp is None:
        service.metrics.logins.labels("wrong").inc()
        logs.warning("login refused", user=name, address=address)
        return _form("Name or password is wrong.", 403, name)
    service.limit.succeeded(address, name)
    service.sessions.end(request.cookies.get(cookie_name(service.settings, "session")))
    token = service.sessions.begin(name, stamp)
    service.metrics.logins.labels("right").inc()
    logs.info("login", user=name, address=address)
    back = request.form.get("back", "/")
    response = redirect(back if BACK.fullmatch(back) else "/", code=303)
    set_cookie(response, service.settings, "session", token, int(LONGEST_S))
    set_cookie(response, service.settings, "login", "")
    return response


def _refused(name: str, address: str, wait_s: float) -> Response:
    the_service().metrics.logins.labels("limited").inc()
    logs.warning("too many login attempts", user=name, address=address)
    seconds = math.ceil(wait_s)
    response = _form(f"Too many attempts; wait {seconds} s.", 429, name)
    response.headers["Retry-After"] = str(seconds)
    return response


@signing_pages.post("/logout")
def log_out() -> BaseResponse:
    """End the session."""
    service = the_service()
    service.sessions.end(request.cookies.get(cookie_name(service.settings, "session")))
    response = redirect("/", code=303)
    set_cookie(response, service.settings, "session", "")
    return response


@signing_pages.post(f"/machines/<{NUMBER}:machine_id>/tables/<{NUMBER}:version>/<any(approve,reject):kind>")
def decide(machine_id: int, version: int, kind: str) -> BaseResponse:
    """Approve or reject a set of tables."""
    machine, decision = _allowed(machine_id), _decision_request()
    if kind == "approve":
        override = request.form.get("override") == "yes"
        return _decided(machine, kind, lambda s, m: decisions.approve(s, m, version, override=override, **decision))
    return _decided(machine, kind, lambda s, m: decisions.reject(s, m, version, **decision))


@signing_pages.post(f"/machines/<{NUMBER}:machine_id>/rollback")
def roll_back(machine_id: int) -> BaseResponse:
    """Make earlier tables active again, or none."""
    machine, decision = _allowed(machine_id), _decision_request()
    to = _whole("to", "choose the version to make active again")
    return _decided(machine, "rollback", lambda s, m: decisions.rollback(s, m, to=to, **decision))


def _decision_request() -> dict[str, Any]:
    """Return who decides and why, and as ``seen`` the version shown as active on the page, 0 for none."""
    text = request.form.get("reason", "")
    reason = " ".join("".join(char if char.isprintable() else " " for char in text).split())
    if len(reason) > LONGEST_REASON:
        raise InputError(f"a reason has at most {LONGEST_REASON} characters; this one has {len(reason)}")
    seen = _whole("seen", "reload the page: the form does not state which version was active")
    return {"actor": g.session.user, "reason": reason, "seen": seen}


def _whole(field: str, problem: str) -> int:
    """Return a whole number from the form; InputError with the problem if it is not one."""
    text = request.form.get(field, "")
    if not re.fullmatch(r"[0-9]{1,9}", text):
        raise InputError(problem)
    return int(text)


def _allowed(machine_id: int) -> MachineRecord:
    """Return the machine if decisions are allowed here; session, origin and token have been checked."""
    if not the_service().settings.decide:
        abort(403, "This dashboard is read-only.")
    if not the_service().may_decide(g.session.user):
        abort(403, "You may view, but not decide; `volcomp serve add-user` without --reader changes that.")
    return the_machine(machine_id)


def _decided(
    machine: MachineRecord, kind: str, decide: Callable[[Store, MachineRecord], DecisionRecord]
) -> BaseResponse:
    """Decide as ``volcomp recal`` does; with a job file the machine's files are updated, or the page says why not."""
    service, user = the_service(), g.session.user
    try:
        if service.settings.job is None:
            decide(service.store, machine)
        else:
            service.store.version()  # StoreError if the file was replaced, before a new one is opened
            actions.carried_out(read_job(service.settings.job), machine.name, decide)
    except NotPublishedError as error:
        logs.error("files not updated", machine=machine.name, problem=str(error))
        g.session.messages.append(str(error))
    service.metrics.decisions.labels(kind).inc()
    logs.info("decision", machine=machine.name, kind=kind, user=user, address=request.remote_addr)
    g.session.messages.append(f"{machine.name}: {kind} is done and recorded in the audit trail.")
    return redirect(f"/machines/{machine.id}", code=303)


# --- checks of every request, error pages --------------------------------------------------------------------------

#: Largest body of a request, bytes, and largest number of parts of a form.
LARGEST_BODY, MOST_PARTS = 16_384, 20
#: Methods that change nothing.
SAFE = ("GET", "HEAD", "OPTIONS")
#: Pages that need no login: they show nothing from the store (the metrics then need their token).
OPEN_PAGES = ("signing.login", "signing.log_in", "reading.style", "reading.health", "reading.metrics")


def make_app(
    settings: DashboardSettings, store: Store | None = None, clock: Callable[[], float] = time.monotonic
) -> Flask:
    """Return the application.

    Parameters
    ----------
    settings : see :class:`Settings`; checked here.
    store : an open store; default: the store of the settings is opened.
    clock : seconds; for tests of sessions and limits.

    Raises
    ------
    InputError, StoreError
        for unsafe settings, or a store that cannot be opened.
    """
    check_settings(settings)
    folder = data_folder("templates") / "_serve"
    app = Flask("compgen.fleet.dashboard", static_folder=None, template_folder=str(folder))
    app.config.update(MAX_CONTENT_LENGTH=LARGEST_BODY, MAX_FORM_MEMORY_SIZE=LARGEST_BODY, MAX_FORM_PARTS=MOST_PARTS)
    app.jinja_env.autoescape = True
    app.jinja_env.undefined = StrictUndefined
    app.jinja_env.trim_blocks = app.jinja_env.lstrip_blocks = True
    app.jinja_env.filters.update(
        unit=LABEL.__getitem__,
        micro=lambda text: re.sub(r"\b(um|urad)\b", lambda found: LABEL[found[0]], text),
        when=lambda time: "" if time is None else time.astimezone(UTC).strftime("%Y-%m-%d %H:%M"),
        figure=_figure,
        signed=partial(_figure, sign="+"),
        ago=_ago,
    )
    app.jinja_env.globals.update(STATUSES=STATUSES, page_url=page_url)
    app.extensions["compgen"] = make_service(settings, store or open_store(settings.store_url), clock)
    app.url_map.converters["number"] = PlaceNumber
    app.before_request(_begin_request)
    app.after_request(_finish)
    app.context_processor(_context)
    app.register_error_handler(HTTPException, _http_error)
    app.register_error_handler(CompgenError, _program_error)
    app.register_error_handler(Exception, _unexpected)
    app.register_blueprint(reading_pages)
    app.register_blueprint(signing_pages)
    return app


def _begin_request() -> BaseResponse | None:
    """Check host, method, login and, for requests that may change something, origin and token, before any page."""
    g.began, g.session = time.perf_counter(), None
    service = the_service()
    service.background.began()
    check_host(request, service.settings)
    check_method(request)
    token = request.cookies.get(cookie_name(service.settings, "session"))
    g.session = service.sessions.find(token) if service.users is not None else None
    if g.session is not None and service.users is not None and service.users.stamp(g.session.user) != g.session.stamp:
        service.sessions.end(token)  # the user was removed or has a new password
        g.session = None
    if request.method not in SAFE:
        check_origin(request, service.settings)
        if request.endpoint != "signing.log_in" and g.session is None:
            raise Forbidden("Log in first; a session ends after 30 minutes without activity.")
        if request.endpoint != "signing.log_in" and not same(g.session.csrf, request.form.get("csrf", "")):
            raise Forbidden("The form does not belong to this session; reload the page.")
    if service.settings.private and g.session is None and request.endpoint not in OPEN_PAGES:
        return redirect("/login", code=303)
    return None


def _context() -> dict[str, Any]:
    service, session = the_service(), g.get("session")
    if g.get("for_all") and session is not None:
        may_decide = service.may_decide(session.user)
        return {"settings": service.settings, "messages": [], "may_decide": may_decide, **PLACES}
    messages = list(session.messages) if session is not None else []
    if session is not None:
        session.messages.clear()
    return {
        "settings": service.settings,
        "user": session.user if session is not None else None,
        "csrf": session.csrf if session is not None else "",
        "messages": messages,
        "may_decide": session is not None and service.may_decide(session.user),
    }


def _finish(response: Response) -> Response:
    """Add headers, count, log one line; the log contains nothing from forms or cookies."""
    service = the_service()
    service.background.ended()
    seconds = time.perf_counter() - g.get("began", time.perf_counter())
    endpoint = (request.endpoint or "none").rpartition(".")[2]
    method = request.method if request.method in (*SAFE, "POST") else "other"
    service.metrics.requests.labels(endpoint, method, str(response.status_code)).inc()
    service.metrics.seconds.labels(endpoint).observe(seconds)
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
    add_headers(response, service.settings)
    return response


def _http_error(error: HTTPException) -> Response | tuple[str, int] | HTTPException:
    code = error.code or 500
    if code < 400:
        return error
    if code in (403, 421, 413, 429):
        the_service().metrics.refused.labels({403: "forbidden", 421: "host", 413: "size", 429: "rate"}[code]).inc()
    text = error.description or ""
    page = render_template("error.html", code=code, title=error.name, text=text)
    return error_response(page, error)


def _program_error(error: CompgenError) -> tuple[str, int]:
    """Show the program's message: a decision that cannot be made, a store that cannot be reached."""
    if isinstance(error, StoreError):
        logs.error("store", problem=str(error))
        text = "The store is not available at the moment; see the log."
        return render_template("error.html", code=503, title="Store not available", text=text), 503
    return render_template("error.html", code=409, title="Not done", text=str(error)), 409


def _unexpected(error: Exception) -> tuple[str, int]:
    place = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(place.filename).name}:{place.lineno}"
    logs.error("internal error", problem=f"{type(error).__name__}: {error}", where=where, path=request.path[:200])
    text = "This is a bug in the program; see its log."
    return render_template("error.html", code=500, title="Internal error", text=text), 500


def _ago(time: datetime | None) -> str:
    """Say in days how long ago a time was."""
    if time is None:
        return ""
    days = (datetime.now(UTC) - time).days
    return "in the future" if days < 0 else "today" if days == 0 else f"{days} d ago"


def _figure(value: float | None, digits: int = 2, sign: str = "") -> str:
    """Return a number with fixed digits, a dash if it is unknown; zero has no minus sign.

    With ``sign`` "+" every number has a sign.
    """
    if value is None or value != value:
        return "\N{EN DASH}"
    text = f"{value:.4g}" if abs(value) >= 1e5 and not sign else f"{value:{sign}z.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}")
