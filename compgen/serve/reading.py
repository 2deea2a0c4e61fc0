"""Pages that only read. Places in the address are numbers, never names of files."""

from __future__ import annotations

import functools
import re
import secrets
from collections.abc import Callable
from typing import Any
from urllib.parse import urlencode

from flask import Blueprint, Response, abort, current_app, g, render_template, request
from markupsafe import escape
from werkzeug.routing import IntegerConverter

from compgen.errors import CompgenError, InputError
from compgen.recal import logs
from compgen.recal.recheck import format_recheck_points
from compgen.recal.records import MachineRecord
from compgen.resources import data_folder
from compgen.serve.background import NotReadyError
from compgen.serve.drift_view import change_rows, drift_charts, trend_rows
from compgen.serve.fleet import STATUSES, audit_page, fleet, fleet_page, machine_by_id
from compgen.serve.history import history
from compgen.serve.metrics import CONTENT_TYPE
from compgen.serve.proposal import find_table, proposal
from compgen.serve.recheck_view import basis, wanted_of
from compgen.serve.service import Service
from compgen.serve.sessions import same

pages = Blueprint("reading", __name__)
#: How long the page of a machine waits for the drift, s.
A_MOMENT_S = 0.2
NUMBER = "number(max=2147483647)"
#: What stands in a page that is kept where the reader's own name and token belong; nobody can guess it.
PLACES = {name: f"{name}-{secrets.token_hex(16)}" for name in ("user", "csrf")}


class Number(IntegerConverter):
    """A whole number in ASCII digits without leading zeros: each page has one address."""

    regex = "0|[1-9][0-9]{0,9}"


def own() -> Service:
    """Return what the application of this request shares."""
    found: Service = current_app.extensions["compgen"]
    return found


def the_machine(machine_id: int) -> MachineRecord:
    """Return a machine or answer 404."""
    found = machine_by_id(own().store, machine_id)
    return found if found is not None else abort(404, "The store has no such machine.")


def kept(view: Callable[..., str]) -> Callable[..., str]:
    """Make a page once for all readers with the same rights, as long as nothing changes that it shows."""

    @functools.wraps(view)
    def wrapper(**arguments: int) -> str:
        service, session = own(), g.session
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
    """Return the address of the fleet page with these choices."""
    return "/?" + urlencode({key: value for key, value in arguments.items() if value})


def _page_number() -> int:
    text = request.args.get("page", "1")
    return int(text) if re.fullmatch(r"[0-9]{1,6}", text) else 1


@pages.get("/")
@kept
def overview() -> str:
    """Show the fleet."""
    words, status = request.args.get("q", "")[:100], request.args.get("status", "")
    status = status if status in STATUSES else ""
    page = fleet_page(fleet(own().store).rows, words, status, _page_number())
    measured = [row.machine for row in page.rows if row.measurements]
    outlooks = own().drift_of.outlooks(measured)
    g.complete = len(outlooks) == len(measured)
    return render_template("fleet.html", page=page, words=words, status=status, outlooks=outlooks)


@pages.get(f"/machines/<{NUMBER}:machine_id>")
@kept
def machine(machine_id: int) -> str:
    """Show one machine's history; what its drift says, if that is known by now."""
    service, found = own(), the_machine(machine_id)
    sentences, problem = None, ""
    try:
        sentences = service.drift_of(found, A_MOMENT_S).sentences()
    except NotReadyError:
        g.complete, problem = False, "The drift is being worked out."
    except InputError as error:
        problem = str(error)
    told = history(service.store, service.errors_of, found)
    return render_template("machine.html", h=told, sentences=sentences, problem=problem)


@pages.get(f"/machines/<{NUMBER}:machine_id>/drift")
@kept
def drift(machine_id: int) -> str:
    """Show which errors changed, which drift, and when they leave their tolerance."""
    found = the_machine(machine_id)
    try:
        known = own().drift_of(found)
    except NotReadyError:
        g.complete = False
        return render_template("drift.html", machine=found, waiting=True, problem="")
    except InputError as error:
        return render_template("drift.html", machine=found, waiting=False, problem=str(error))
    shown = {"rows": change_rows(known), "trends": trend_rows(known), "charts": drift_charts(known)}
    return render_template("drift.html", machine=found, waiting=False, problem="", drift=known, **shown)


@pages.get(f"/machines/<{NUMBER}:machine_id>/recheck")
def recheck(machine_id: int) -> str:
    """Show the fewest points at which a wanted change of one error would be seen."""
    found, service = the_machine(machine_id), own()
    page: dict[str, Any] = {"machine": found, "waiting": False, "problem": "", "start": None, "plan": None}
    try:
        page["start"] = start = basis(service.store, found)
        page["wanted"], page["change"] = wanted_of(request.args, start, service.job.tolerances(found.name))
        page["plan"] = service.recheck_of(start, page["wanted"])
    except NotReadyError:
        page["waiting"] = True
    except InputError as error:
        page["problem"] = str(error)
    return render_template("recheck.html", **page)


@pages.get(f"/machines/<{NUMBER}:machine_id>/recheck.points.csv")
def recheck_points(machine_id: int) -> Response:
    """Send the points of a re-check as a points file; 409 for one that cannot be, 503 while it is worked out."""
    found, service = the_machine(machine_id), own()
    start = basis(service.store, found)
    wanted, _ = wanted_of(request.args, start, service.job.tolerances(found.name))
    try:
        plan = service.recheck_of(start, wanted)
    except NotReadyError:
        abort(503, "The points are being worked out; ask again in a moment.")
    return _download(format_recheck_points(plan).encode(), "recheck.points.csv")


@pages.get(f"/machines/<{NUMBER}:machine_id>/tables/<{NUMBER}:version>")
@kept
def table(machine_id: int, version: int) -> str:
    """Show before and after of one set of tables."""
    service, found = own(), the_machine(machine_id)
    record = find_table(service.store, found, version)
    if record is None:
        abort(404, "The machine has no tables of this version.")
    return render_template("table.html", p=proposal(service.store, service.errors_of, found, record))


@pages.get(f"/machines/<{NUMBER}:machine_id>/tables/<{NUMBER}:version>/files/<{NUMBER}:position>")
def download(machine_id: int, version: int, position: int) -> Response:
    """Send one file of a set of tables, byte for byte, as a download."""
    service = own()
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


@pages.get("/audit")
@kept
def audit() -> str:
    """Show who decided what, when and why, the newest first."""
    people = request.args.get("who") == "people"
    page = audit_page(own().store, _page_number(), people=people)
    return render_template("audit.html", page=page, people=people)


@pages.get("/metrics")
def metrics() -> Response:
    """Show the metrics; where reading needs a login, to whoever shows the token."""
    settings = own().settings
    if settings.private or settings.metrics_token:
        shown = request.headers.get("Authorization", "")
        if not settings.metrics_token or not same(shown, f"Bearer {settings.metrics_token}"):
            abort(403, "The metrics need their token.")
    return Response(own().metrics.text(), content_type=CONTENT_TYPE)


@pages.get("/healthz")
def health() -> tuple[Response, int]:
    """Say whether the store can be read, and is still the file that was opened."""
    store = own().store
    try:
        store.version()
    except CompgenError as error:
        logs.error("store", problem=str(error))
        return Response("store not available; the log says why\n", mimetype="text/plain"), 503
    return Response("ok\n", mimetype="text/plain"), 200


@pages.get("/style.css")
def style() -> Response:
    """Send the style sheet."""
    text = (data_folder("templates") / "_serve" / "style.css").read_text(encoding="utf-8")
    return Response(text, mimetype="text/css")
