"""Pages that only read. Places in the address are numbers, never names of files."""

from __future__ import annotations

import re
from typing import Any
from urllib.parse import urlencode

from flask import Blueprint, Response, abort, current_app, render_template, request
from werkzeug.routing import IntegerConverter

from compgen.errors import CompgenError, InputError
from compgen.recal.records import MachineRecord
from compgen.resources import data_folder
from compgen.serve.drift_view import change_rows
from compgen.serve.fleet import STATUSES, audit_page, fleet, fleet_page, machine_by_id
from compgen.serve.history import history
from compgen.serve.metrics import CONTENT_TYPE
from compgen.serve.proposal import find_table, proposal
from compgen.serve.service import Service
from compgen.serve.sessions import same

pages = Blueprint("reading", __name__)
NUMBER = "number(max=2147483647)"


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


def page_url(**arguments: Any) -> str:
    """Return the address of the fleet page with these choices."""
    return "/?" + urlencode({key: value for key, value in arguments.items() if value})


def _page_number() -> int:
    text = request.args.get("page", "1")
    return int(text) if re.fullmatch(r"[0-9]{1,6}", text) else 1


@pages.get("/")
def overview() -> str:
    """Show the fleet."""
    words, status = request.args.get("q", "")[:100], request.args.get("status", "")
    status = status if status in STATUSES else ""
    page = fleet_page(fleet(own().store).rows, words, status, _page_number())
    return render_template("fleet.html", page=page, words=words, status=status)


@pages.get(f"/machines/<{NUMBER}:machine_id>")
def machine(machine_id: int) -> str:
    """Show one machine's history."""
    service = own()
    return render_template("machine.html", h=history(service.store, service.errors_of, the_machine(machine_id)))


@pages.get(f"/machines/<{NUMBER}:machine_id>/drift")
def drift(machine_id: int) -> str:
    """Show which errors changed, which drift, and when they leave their tolerance."""
    found = the_machine(machine_id)
    try:
        known = own().drift_of(found)
    except InputError as error:
        return render_template("drift.html", machine=found, problem=str(error))
    return render_template("drift.html", machine=found, problem="", drift=known, rows=change_rows(known))


@pages.get(f"/machines/<{NUMBER}:machine_id>/tables/<{NUMBER}:version>")
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
    name = re.sub(r"[^A-Za-z0-9._-]", "_", file.name.rpartition("/")[2]).lstrip(".") or "file"
    response = Response(file.content, mimetype="application/octet-stream")
    response.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return response


@pages.get("/audit")
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
    """Say whether the store can be read."""
    try:
        own().store.read(own().store.now)
    except CompgenError:
        return Response("store not available\n", mimetype="text/plain"), 503
    return Response("ok\n", mimetype="text/plain"), 200


@pages.get("/style.css")
def style() -> Response:
    """Send the style sheet."""
    text = (data_folder("templates") / "_serve" / "style.css").read_text(encoding="utf-8")
    return Response(text, mimetype="text/css")
