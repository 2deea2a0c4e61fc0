"""Attacks on the workbench: other sites, other programs on the computer, crafted addresses, forms and files."""

import contextlib
import errno
import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.parse
import urllib.request
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the workbench is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the workbench is not tested")

import app_site as helper

from compgen.app import pages
from compgen.app.pages import OpenPages
from compgen.app.project import Step
from compgen.web import connections as server
from compgen.web.site import LocalSite

IMPORTS = Path(__file__).resolve().parents[2] / "tests" / "golden" / "imports"


def addresses(method):
    """Every address that answers a method, from the URL map: numbers are 1, a page of a step is its report."""
    filled = []
    for rule in pages.make_app(pages.Workbench(LocalSite(8765))).url_map.iter_rules():
        if method not in rule.methods or rule.endpoint in pages.OPEN:
            continue
        path = re.sub(r"<number[^>]*>", "1", rule.rule).replace("<path:name>", "report.html")
        choices = re.search(r"<any\(([^)]*)\):\w+>", path)
        names = re.findall(r"[\w.]+", choices[1]) if choices else [""]
        filled += [path.replace(choices[0], name) if choices else path for name in names]
    assert not any("<" in path for path in filled), filled
    return sorted(filled)


#: Every address that changes something, and every one that shows something.
CHANGES, SHOWN = addresses("POST"), [*addresses("GET"), "/chain?words=WXYFZT"]


@pytest.fixture
def site(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    made = helper.Site(tmp_path / "project")
    folder = made.project.new_folder("identify")
    for name in ("report.html", "a.csv"):
        (made.project.folder / folder / name).write_text(f"<p>{name}</p>")
    (made.project.folder / folder / "preflight.md").write_text("# List\n\n1. <script>alert(1)</script> do it\n")
    made.project.add(Step(0, "identify", "<script>alert(1)</script>", folder=folder))
    yield made
    made.workbench.close()


def everything(site):
    """All files of the project and their contents."""
    return {path: path.read_bytes() for path in sorted(site.project.folder.rglob("*")) if path.is_file()}


def test_the_walk_over_all_addresses_finds_those_that_are_known():
    """The lists come from the URL map, so that a new address is attacked without being named here."""
    assert {"/open", "/projects/1/run", "/projects/1/undo", "/projects/1/measurement/1/remove", "/alive"} <= set(
        CHANGES
    )
    assert {"/", "/projects/1/tables", "/projects/1/steps/1/view/report.html", "/projects/1/status"} <= set(SHOWN)
    assert len(CHANGES) > 20


def test_the_first_address_is_valid_once_and_for_one_browser(tmp_path):
    site = helper.Site(tmp_path / "project", start=False)
    ticket = site.workbench.ticket
    assert site.get("/projects/1/machine").status_code == 403
    for wrong in ("", "x", ticket[:-1], ticket + "x", "\u00e9"):
        assert site.get("/start", query_string={"token": wrong}).status_code == 403
    answer = site.get(f"/start?token={ticket}")
    assert answer.status_code == 303
    cookie = answer.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert ticket not in cookie
    assert site.get("/projects/1/machine").status_code == 200
    other = site.client.application.test_client()
    assert other.get(f"/start?token={ticket}", base_url=site.url).status_code == 403
    assert other.get("/projects/1/machine", base_url=site.url).status_code == 403


@pytest.mark.parametrize("path", SHOWN)
def test_nothing_is_shown_without_the_session_to_another_name_or_to_another_site(site, path):
    stranger = site.client.application.test_client()
    assert stranger.get(path, base_url=site.url).status_code == 403
    stranger.set_cookie("compgen-8765-app", site.workbench.session[:-1] + "?", domain="127.0.0.1")
    assert stranger.get(path, base_url=site.url).status_code == 403
    assert site.get(path).status_code in (200, 204, 303)
    for name in (
        "evil.example:8765",
        "127.0.0.1.evil.example",
        "0.0.0.0:8765",
        "[::ffff:7f00:1]:8765",
        "127.1:8765",
        "",
        "a b",
    ):
        assert site.client.get(path, base_url=site.url, headers={"Host": name}).status_code in (400, 421), name
    said = {"X-Forwarded-Host": "localhost:8765", "Forwarded": "host=localhost:8765", "Host": "evil.example"}
    assert site.client.get(path, headers=said).status_code == 421
    head = site.client.head(path, base_url=site.url, buffered=True)
    assert head.status_code in (200, 204, 303)
    assert head.data == b""
    for kind in ("cross-site", "same-site"):
        assert site.get(path, headers={"Sec-Fetch-Site": kind}).status_code == 403


@pytest.mark.parametrize("path", CHANGES)
def test_nothing_is_changed_without_session_token_and_origin(site, path):
    before, data = (
        everything(site),
        {"csrf": site.workbench.csrf, "revision": "1", "folder": "/tmp", "machine": "zha-gantry"},
    )
    origin = {"Origin": site.url}
    stranger = site.client.application.test_client()
    assert stranger.post(path, base_url=site.url, data=data, headers=origin).status_code == 403
    for headers in ({}, {"Origin": "null"}, {"Origin": "http://evil.example"}, {"Origin": "http://127.0.0.1:8766"},
                    {"Origin": site.url, "Sec-Fetch-Site": "cross-site"}, {"Origin": "http://localhost:8765"}):  # fmt: skip
        assert site.post(path, data, headers=headers, fields=False).status_code == 403
    for token in ("", "x", site.workbench.csrf[:-1], site.workbench.session):
        assert site.post(path, {**data, "csrf": token}, fields=False).status_code == 403
    assert site.client.get(path, base_url=site.url).status_code in (404, 405)
    for method in ("PUT", "DELETE", "PATCH", "TRACE", "PROPFIND"):
        assert site.client.open(path, method=method, base_url=site.url, headers=origin, data=data).status_code == 405
    assert everything(site) == before


@pytest.mark.parametrize(
    "number", ["\u0661", "01", "+1", "1.0", "0x1", "\uff11", " 1", "1 ", "2147483648", "99999", "-1", "%00"]
)
def test_each_page_has_one_address(site, number):
    for path in {*CHANGES, *SHOWN}:
        if "/1" in path:
            other = path.replace("/1", f"/{number}")
            if "/projects/1/" in path:
                assert site.get(other).status_code in (404, 405), other
            assert site.post(other).status_code in (404, 405), other


def test_bytes_that_are_no_text_are_words_that_are_not_found(site):
    for query in (
        "?words=%ff%fe%80",
        "?token=%00",
        "?save=%D9%A1",
        "?a[]=x&a=1&a=2",
        "?q=%0d%0aX-Evil:%201",
        "?" + "&" * 999,
    ):
        for path in SHOWN:
            answer = site.get(path.partition("?")[0] + query)
            assert answer.status_code in (200, 204, 303), (path, query)
            assert "X-Evil" not in answer.headers


@pytest.mark.parametrize(
    "path",
    ["/projects/1/steps/1/files/0", "/projects/1/steps/1/files/9", "/projects/1/steps/1/files/01", "/projects/0/machine",
     "/projects/2/machine", "/projects/1/steps/2/files.zip", "/projects/1/steps/1/view/../../project.json",
     "/projects/1/steps/1/view/..%2f..%2fproject.json", "/projects/1/steps/1/view/%2fetc%2fpasswd",
     "/projects/1/steps/1/view/a.csv", "/projects/1/steps/1/view/preflight.md", "/app.js/../project.json", "/_parts.html",
     "/projects/\u0661/machine", "/projects/1/steps/1/files/-1", "/projects/1/evil", "/projects/1/steps/99999999/files/1"],
)  # fmt: skip
def test_no_address_leads_to_another_file(site, path):
    answer = site.get(path, follow_redirects=True)  # a doubled slash leads to the address without
    assert answer.status_code == 404
    assert '"steps"' not in answer.text
    assert "root:" not in answer.text


def test_every_answer_has_the_headers_and_no_page_has_a_script_in_itself(site):
    for path in (*SHOWN, "/nowhere", "/app.js", "/app.css", "/charts.js", "/start?token=x"):
        answer = site.get(path)
        policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "script-src 'unsafe-inline'" not in policy
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Cache-Control"] == "no-store"
        if path.endswith((".sh", ".zip", "/files/1")) or (answer.status_code == 200 and "/print/" in path):
            assert answer.mimetype in ("text/plain", "application/zip", "application/octet-stream", "application/pdf")
            assert "attachment" in answer.headers["Content-Disposition"]
            continue
        kinds = re.findall(r"<script[^>]*>", answer.text)
        assert all('src="/' in kind or "application/json" in kind for kind in kinds), path
        assert not re.search(r"\son[a-z]+=", answer.text), path
        assert not re.search(r"(src|href)=[\"']?(https?:)?//", answer.text), path


def test_names_and_contents_of_files_are_shown_as_text(site):
    site.do("machine/choose", {"machine": "zha-gantry"})
    evil = b"axis,position_mm,direction,run,deviation_um,<img src=x onerror=alert(1)>\nX,-800,1,1,1,2\nX,0,1,1,2,2\n"
    files = [(io.BytesIO(evil), '"><script>alert(1)</script>.axis.csv')]
    site.post("/projects/1/measurement/add", {"files": files})
    site.post("/projects/1/numbers", {"squareness-EC0Y": "<script>alert(1)</script>"})
    for name in pages.PAGES:
        text = site.get(f"/projects/1/{name}").text
        assert "<script>alert" not in text
        assert "<img" not in text
    for path in (site.project.folder).rglob("*"):
        assert path.resolve().is_relative_to(site.project.folder)


@pytest.mark.parametrize(
    "name",
    ["../../x.axis.csv", "CON.csv", "x" * 300 + ".csv", "<b onclick=alert(1)>.csv", "-o.csv", "project.json"],
)  # fmt: skip
def test_a_measurement_of_any_name_is_read_and_its_name_is_text(site, name):
    """The file arrives in the folder of its step, and its content is used, whatever its name says."""
    site.do("machine/choose", {"machine": "zha-gantry"})
    content = b"axis,position_mm,direction,run,deviation_um\nX,-800,1,1,1\nX,0,1,1,2\n"
    state = site.do("measurement/add", {"files": [(io.BytesIO(content), name)]})
    (item,) = state.measurements
    assert item.used == (item.file,)
    path = site.project.folder / item.file
    assert path.read_bytes() == content
    assert path.parent.parent == site.project.folder
    text = site.get("/projects/1/measurement").text
    assert "<b onclick" not in text
    assert "2 readings along X" in text


def test_a_disk_that_is_full_or_must_not_be_written_to_is_said_in_words(site, monkeypatch):
    """Nothing is recorded, the pages answer, and after the cause is gone the same button works."""
    site.do("machine/choose", {"machine": "zha-gantry"})
    before = site.project.state()
    content = b"axis,position_mm,direction,run,deviation_um\nX,-800,1,1,1\nX,0,1,1,2\n"

    def full(*args, **options):
        raise OSError(errno.ENOSPC, "No space left on device", str(site.project.folder))

    for place in ("new_folder", "add", "_write"):
        with monkeypatch.context() as patch:
            patch.setattr(type(site.project), place, full)
            files = {"files": [(io.BytesIO(content), "x.axis.csv")]}
            answer = site.post("/projects/1/measurement/add", files)
            page = answer.text if answer.status_code == 409 else site.get("/projects/1/measurement").text
            assert "cannot be written to: No space left on device" in page, place
            assert "internal error" not in page
        assert site.project.state() == before
        assert site.get("/projects/1/machine").status_code == 200
    assert len(site.do("measurement/add", {"files": [(io.BytesIO(content), "x.axis.csv")]}).measurements) == 1


def test_links_in_the_folder_of_a_project_lead_nowhere(site, tmp_path):
    """A link in place of a step's folder, and links in it: nothing outside is shown, packed or written."""
    (tmp_path / "secrets").mkdir()
    (tmp_path / "secrets" / "report.html").write_text("secret")
    folder = site.project.folder / site.project.state().steps[0].folder
    (folder / "link.html").symlink_to(tmp_path / "secrets" / "report.html")
    (folder / "all").symlink_to(tmp_path / "secrets")
    packed = zipfile.ZipFile(io.BytesIO(site.get("/projects/1/steps/1/files.zip").data))
    assert not any(b"secret" in packed.read(name) for name in packed.namelist())
    assert site.get("/projects/1/steps/1/view/link.html").status_code == 404
    assert site.get("/projects/1/steps/1/view/all/report.html").status_code == 404
    shutil.rmtree(folder)
    folder.symlink_to(tmp_path / "secrets")
    for path in SHOWN:
        assert "secret" not in site.get(path).text.replace(str(tmp_path), "")
    assert [path.name for path in (tmp_path / "secrets").iterdir()] == ["report.html"]


@pytest.mark.parametrize("field", ["squareness-EC0Y", "backlash-X", "scale-Y"])
@pytest.mark.parametrize("value", ["ten", "--out=/tmp", "1;2", "nan", "\x1b[2J", "1" * 400, "25\n--keep-all"])
def test_numbers_that_are_none_are_refused_before_any_command(site, field, value):
    site.do("machine/choose", {"machine": "zha-gantry"})
    before = site.project.state()
    answer = site.post("/projects/1/numbers", {field: value})
    assert answer.status_code == 409
    assert site.project.state() == before


@pytest.mark.parametrize(
    "answer",
    ["--out=/tmp/x", "--machine=/etc/passwd", "--plugin=/tmp/evil.py", "-v", "X", "--axis", "--axis=X\n--out=y"],
)
def test_answers_are_options_of_questions_only(site, answer):
    site.do("machine/choose", {"machine": "zha-gantry"})
    file = (io.BytesIO((IMPORTS / "angular.rta").read_bytes()), "a.rta")
    site.do("measurement/add", {"files": [file]})
    number = site.project.state().measurements[0].number
    before = site.project.state()
    assert site.post(f"/projects/1/measurement/{number}/answer", {"answer-1": answer}).status_code == 409
    assert site.project.state() == before


@pytest.mark.parametrize("name", ["../evil", "-x", "a/b", "a\nb", "", "x" * 70, "$(id)", "a;b"])
def test_names_of_machines_are_names(site, name):
    form = {
        "name": name,
        "chain": "WXYFZT",
        "X-low": "0",
        "X-high": "1",
        "Y-low": "0",
        "Y-high": "1",
        "Z-low": "0",
        "Z-high": "1",
    }
    assert site.post("/projects/1/machine/describe", form).status_code == 409
    assert site.post("/projects/1/recal", {"name": name, "control": "isg-csv", "measured": "bare"}).status_code == 409
    assert site.project.state().machine is None


def test_too_large_requests_and_forms_of_every_shape_are_refused_without_a_fault(site, monkeypatch):
    before = everything(site)
    monkeypatch.setitem(site.client.application.config, "MAX_CONTENT_LENGTH", 100_000)
    big = {"files": [(io.BytesIO(b"x" * 200_000), "big.csv")]}
    assert site.post("/projects/1/measurement/add", big).status_code == 413
    for body, kind in (
        (b"\xff\xfe%ff=%80&csrf=%00", "application/x-www-form-urlencoded"),
        (b'{"csrf": 1}', "application/json"),
        (b"--x\r\nbroken", "multipart/form-data; boundary=x"),
        (b"x", "multipart/form-data"),
        (b"&".join(b"a%d=1" % k for k in range(1500)), "application/x-www-form-urlencoded"),
    ):
        for path in CHANGES:
            answer = site.client.post(
                path, base_url=site.url, data=body, content_type=kind, headers={"Origin": site.url}
            )
            assert answer.status_code in (400, 403, 413), (path, body[:20])
    assert everything(site) == before


def test_a_page_that_a_user_was_given_is_never_shown_as_one_of_ours(site):
    """Its own policy would allow its script, with the rights of the pages."""
    evil = (
        b"<html><head><meta http-equiv=Content-Security-Policy content=\"script-src 'sha256-"
        + b"A" * 44
        + b"'\"></head>"
    )
    for kind, name in (
        ("verify", "given/files-1-evil.html"),
        ("measurement", "evil.html"),
        ("run", "given/sample-1-x.html"),
    ):
        folder = site.project.new_folder(kind)
        path = site.project.folder / folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(evil)
        data = {"control": "isg-csv"} if kind != "measurement" else {"file": name, "used": [], "answers": [], "summary": {
            "doubts": [], "understood": {}, "notes": [], "kind": "axis", "machine": None}}  # fmt: skip
        step = site.project.add(Step(0, kind, "evil", folder=folder, data=data)).steps[-1]
        assert site.get(f"/projects/1/steps/{step.number}/view/{name}").status_code == 404
        for page in pages.PAGES:
            assert f"/view/{name}" not in site.get(f"/projects/1/{page}").text
        sent = site.get(f"/projects/1/steps/{step.number}/files/1")
        assert sent.mimetype == "application/octet-stream"
        assert "attachment" in sent.headers["Content-Disposition"]


def test_a_revision_that_is_old_or_no_number_changes_nothing(site):
    before = everything(site)
    for revision in ("0", "", "-1", "x", "1.0", "\u0661", "99", "1 "):
        answer = site.post("/projects/1/machine/choose", {"revision": revision, "machine": "zha-gantry"})
        assert answer.status_code == 409
        assert "another window" in answer.text
    assert everything(site) == before


def test_a_job_that_runs_is_alone_and_can_be_stopped(site):
    site.do("machine/choose", {"machine": "zha-gantry"})
    name, content = helper.few_lengths()
    site.do("measurement/add", {"files": [(io.BytesIO(content), name)]})
    before = site.project.state()
    form = {"csrf": site.workbench.csrf, "revision": str(before.revision)}
    sent = {"base_url": site.url, "headers": {"Origin": site.url}}
    assert site.client.post("/projects/1/diagnose", data=form, **sent).status_code == 303
    until = time.monotonic() + helper.PATIENCE_S
    while not site.get("/projects/1/status").json["line"].startswith(("fitting", "building")):
        assert time.monotonic() < until
        time.sleep(0.02)
    assert site.client.post("/projects/1/identify", data=form, **sent).status_code == 409
    assert site.client.post("/projects/1/undo", data=form, **sent).status_code == 409
    process = site.runner._process
    assert site.client.post("/projects/1/stop", data=form, **sent).status_code == 303
    assert process.poll() is not None
    assert site.project.state() == before
    assert "Stopped: looking for missing effects" in site.get("/projects/1/result").text
    assert not any("diagnose" in path.name for path in site.project.folder.iterdir())


def test_who_sends_byte_by_byte_does_not_keep_others_out(tmp_path, monkeypatch):
    """Slow loris: more connections than the server takes, each with the beginning of a request."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(server, "CROWDED_S", 0.5)
    served, slow = helper.Served(tmp_path / "project"), []
    try:
        for _ in range(330):
            slow.append(socket.create_connection(served.address, timeout=helper.PATIENCE_S))
            slow[-1].sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-A: ")
        with socket.create_connection(served.address, timeout=helper.PATIENCE_S) as connection:
            connection.sendall(b"GET /app.css HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
            assert connection.recv(20).startswith(b"HTTP/1.1 200")
    finally:
        for connection in slow:
            connection.close()
        served.close()


@pytest.mark.parametrize("how", ["length", "chunks"])
def test_what_a_stranger_sends_is_not_kept_on_the_disk(tmp_path, monkeypatch, how):
    """A body is complete before the application sees the request: strangers are refused with its beginning."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    served = helper.Served(tmp_path / "project")
    head = (
        "POST /projects/1/measurement/add HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/plain\r\n{}\r\n{}\r\n\r\n"
    )
    cookie = f"Cookie: a=b; compgen-{served.address[1]}-app={{}}"
    try:
        for session, refused in (("wrong", True), (served.workbench.session, False)):
            with socket.create_connection(served.address, timeout=helper.PATIENCE_S) as connection:
                size = "Content-Length: 100000" if how == "length" else "Transfer-Encoding: chunked"
                connection.sendall(head.format(cookie.format(session), size).encode())
                body = b"x" * 100_000 if how == "length" else b"186a0\r\n" + b"x" * 100_000 + b"\r\n0\r\n\r\n"
                with contextlib.suppress(OSError):
                    connection.sendall(body)
                code = connection.recv(12)
                assert (b"413" in code) == refused, code
    finally:
        served.close()


@pytest.mark.parametrize("folder", ["a\nb", "a\x00b", "\x1b[2J", "x" * 1001, ""])
def test_the_name_of_a_project_is_one_line(site, tmp_path, folder):
    named = f"{tmp_path}/{folder}" if folder else ""
    data = {"csrf": site.workbench.csrf, "folder": named}
    answer = site.client.post("/open", base_url=site.url, headers={"Origin": site.url}, data=data)
    assert answer.status_code == 409
    assert sorted(path.name for path in tmp_path.iterdir()) in (["project"], ["cache", "project"])


def test_the_program_ends_after_the_last_page_was_closed(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(pages.time, "monotonic", lambda: now[0])
    open_pages = OpenPages()
    now[0] += 1e6
    assert not open_pages.over()  # nobody has opened a page yet
    open_pages.alive("a")
    open_pages.alive("b")
    open_pages.left("a")
    now[0] += 60.0
    assert not open_pages.over()
    open_pages.left("b")
    assert not open_pages.over()  # it may follow a link
    now[0] += pages.GRACE_S + 0.1
    assert open_pages.over()
    open_pages.left("quick")
    open_pages.alive("quick")  # sent first, came second: the page is closed
    now[0] += pages.GRACE_S + 0.1
    assert open_pages.over()
    open_pages.alive("c")
    now[0] += pages.SILENT_S - 1.0
    assert not open_pages.over()
    now[0] += 2.0
    assert open_pages.over()  # a browser that was killed says nothing


class Program:
    """The command itself on a folder, as a browser without a screen talks to it."""

    def __init__(self, folder, cache):
        command = [sys.executable, "-m", "compgen", "app", str(folder), "--no-browser", "--keep-open"]
        variables = {**os.environ, "XDG_CACHE_HOME": str(cache), "PYTHONUNBUFFERED": "1"}
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=variables
        )
        address = re.search(r"http://127\.0\.0\.1:\d+/start\?token=\S+", self.process.stdout.readline())[0]
        self.url = address.partition("/start")[0]
        self.browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        self.page = self.browser.open(address, timeout=helper.PATIENCE_S).read().decode()

    def get(self, path):
        return self.browser.open(self.url + path, timeout=helper.PATIENCE_S).read().decode()

    def post(self, path, **fields):
        """Send a form with the token and the revision of the page that is shown."""
        self.page = self.get("/projects/1/project")
        seen = {name: re.search(rf'data-{name}="([^"]*)"', self.page)[1] for name in ("csrf", "revision")}
        data = urllib.parse.urlencode({**seen, **fields}).encode()
        sent = urllib.request.Request(self.url + path, data, {"Origin": self.url})
        self.page = self.browser.open(sent, timeout=helper.PATIENCE_S).read().decode()

    def busy(self):
        return json.loads(self.get("/projects/1/status"))["busy"]

    def wait(self, what):
        until = time.monotonic() + helper.PATIENCE_S
        while not what():
            assert time.monotonic() < until
            time.sleep(0.05)


def commands_in(folder):
    """Process ids of the commands that run on the files of a project."""
    found, project = [], b"COMPGEN_FILES_WITHIN=%s\0" % os.fsencode(folder)
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if project in (path / "environ").read_bytes() and b"compgen" in (path / "cmdline").read_bytes():
                found.append(int(path.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/cwd").exists(), reason="the system does not show where a process runs")
@pytest.mark.parametrize("how", ["SIGKILL", "SIGINT"])
def test_a_program_that_ends_in_the_middle_of_a_run_loses_no_step_and_leaves_nothing_running(tmp_path, how):
    """Killed without warning, or Ctrl-C: what was shown as saved is there, and the next program goes on."""
    folder = tmp_path / "project"
    name, content = helper.few_lengths()
    site = helper.Site(folder)
    site.do("machine/choose", {"machine": "zha-gantry"})
    before = site.do("measurement/add", {"files": [(io.BytesIO(content), name)]})
    site.workbench.close()
    program = Program(folder, tmp_path / "cache")
    try:
        program.post("/projects/1/diagnose")
        program.wait(lambda: commands_in(folder))
        program.process.send_signal(getattr(signal, how))
        program.process.communicate(timeout=helper.PATIENCE_S)
        assert program.process.returncode == (0 if how == "SIGINT" else -signal.SIGKILL)
        program.wait(lambda: not commands_in(folder))
        assert site.project.state() == before
    finally:
        if program.process.poll() is None:
            program.process.kill()
            program.process.communicate()
    again = helper.Site(folder)
    assert again.project.state() == before
    assert again.get("/projects/1/result").status_code == 200
    state = again.do("identify")
    assert state.last("identify").exit_code == 0
    assert [step.kind for step in state.steps] == ["machine", "measurement", "identify"]
    again.workbench.close()
