"""Login, logout, and what only users who are logged in may do: approve, reject, roll back."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from flask import Blueprint, Response, abort, g, make_response, redirect, render_template, request
from werkzeug.wrappers import Response as BaseResponse

from compgen.errors import InputError
from compgen.recal import logs
from compgen.recal.actions import NotPublishedError
from compgen.recal.records import DecisionRecord, MachineRecord
from compgen.serve import service as deciding
from compgen.serve.guard import cookie_name, set_cookie
from compgen.serve.reading import NUMBER, own, the_machine
from compgen.serve.service import Wish
from compgen.serve.sessions import LONGEST_S

pages = Blueprint("signing", __name__)
#: Pages to which a login may lead back.
BACK = re.compile(r"/(audit|machines/[0-9]{1,10}(/tables/[0-9]{1,10})?)?")


@pages.get("/login")
def login() -> BaseResponse:
    """Show the login form."""
    return _form("", 200)


def _form(problem: str, code: int, name: str = "") -> Response:
    service = own()
    if service.users is None:
        abort(404, "This dashboard only reads; there is nothing to log in for.")
    cookie, field = service.tokens.issue()
    back = request.values.get("back", "/")
    back = back if BACK.fullmatch(back) else "/"
    page = render_template("login.html", problem=problem, field=field, back=back, name=name)
    response = make_response(page, code)
    set_cookie(response, service.settings, "login", cookie)
    return response


@pages.post("/login")
def log_in() -> BaseResponse:
    """Check name and password; a new session begins whatever the browser brought along."""
    service = own()
    if service.users is None:
        abort(404, "This dashboard only reads; there is nothing to log in for.")
    name, password = request.form.get("name", "")[:100].strip(), request.form.get("password", "")
    cookie = request.cookies.get(cookie_name(service.settings, "login"))
    if not service.tokens.right(cookie, request.form.get("csrf", "")):
        return _form("The form was too old; try again.", 403, name)
    address = request.remote_addr or ""
    wait_s = service.limit.wait_s(address, name)
    if wait_s > 0.0:
        return _refused(name, address, wait_s)
    stamp = service.users.stamp(name)  # before the check: a password that changes meanwhile ends the session
    if not service.users.verify(name, password) or stamp is None:
        service.metrics.logins.labels("wrong").inc()
        logs.warning("login refused", user=name, address=address)
        return _form("Name or password is wrong.", 403, name)
    service.limit.succeeded(address, name)
    return _begin(name, stamp, address)


def _refused(name: str, address: str, wait_s: float) -> Response:
    own().metrics.logins.labels("limited").inc()
    logs.warning("too many logins", user=name, address=address)
    seconds = math.ceil(wait_s)
    response = _form(f"Too many tries; wait {seconds} s.", 429, name)
    response.headers["Retry-After"] = str(seconds)
    return response


def _begin(name: str, stamp: str, address: str) -> BaseResponse:
    service = own()
    service.sessions.end(request.cookies.get(cookie_name(service.settings, "session")))
    token = service.sessions.begin(name, stamp)
    service.metrics.logins.labels("right").inc()
    logs.info("login", user=name, address=address)
    back = request.form.get("back", "/")
    response = redirect(back if BACK.fullmatch(back) else "/", code=303)
    set_cookie(response, service.settings, "session", token, int(LONGEST_S))  # type: ignore[arg-type]
    set_cookie(response, service.settings, "login", "")  # type: ignore[arg-type]
    return response


@pages.post("/logout")
def log_out() -> BaseResponse:
    """End the session."""
    service = own()
    service.sessions.end(request.cookies.get(cookie_name(service.settings, "session")))
    response = redirect("/", code=303)
    set_cookie(response, service.settings, "session", "")  # type: ignore[arg-type]
    return response


@pages.post(f"/machines/<{NUMBER}:machine_id>/tables/<{NUMBER}:version>/<any(approve,reject):kind>")
def decide(machine_id: int, version: int, kind: str) -> BaseResponse:
    """Approve or reject a set of tables."""
    machine, service, wish = _allowed(machine_id), own(), _wish()
    if kind == "approve":
        override = request.form.get("override") == "yes"
        return _done(machine, kind, lambda: deciding.approve(service, machine, version, wish, override=override))
    return _done(machine, kind, lambda: deciding.reject(service, machine, version, wish))


@pages.post(f"/machines/<{NUMBER}:machine_id>/rollback")
def roll_back(machine_id: int) -> BaseResponse:
    """Make earlier tables active again, or none."""
    machine, service, wish = _allowed(machine_id), own(), _wish()
    to = _whole("to", "choose the version that becomes active again")
    return _done(machine, "rollback", lambda: deciding.rollback(service, machine, to, wish))


def _wish() -> Wish:
    reason = deciding.clean_reason(request.form.get("reason", ""))
    return Wish(g.session.user, reason, _whole("seen", "open the page again: the form does not say what was active"))


def _whole(field: str, problem: str) -> int:
    """Return a whole number of the form; InputError with the problem if it is none."""
    text = request.form.get(field, "")
    if not re.fullmatch(r"[0-9]{1,9}", text):
        raise InputError(problem)
    return int(text)


def _allowed(machine_id: int) -> MachineRecord:
    """Return the machine if decisions are allowed here; session, origin and token were checked before."""
    if not own().settings.decide:
        abort(403, "This dashboard only reads.")
    if not own().may_decide(g.session.user):
        abort(403, "You may read, but not decide; `volcomp serve add-user` without --reader changes that.")
    return the_machine(machine_id)


def _done(machine: MachineRecord, kind: str, action: Callable[[], DecisionRecord]) -> BaseResponse:
    """Decide; where the decision stands but the files could not follow, say so."""
    service, user = own(), g.session.user
    try:
        action()
    except NotPublishedError as error:
        logs.error("files do not follow", machine=machine.name, problem=str(error))
        g.session.messages.append(str(error))
    service.metrics.decisions.labels(kind).inc()
    logs.info("decision", machine=machine.name, kind=kind, user=user, address=request.remote_addr)
    g.session.messages.append(f"{machine.name}: {kind} is done and kept in the audit trail.")
    return redirect(f"/machines/{machine.id}", code=303)
