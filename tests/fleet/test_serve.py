"""The dashboard: what it shows, and that nobody changes anything without login, token and own page."""

import json
import re
import time
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("argon2", reason="the extra compgen[serve] is not installed: the dashboard is not tested")

import serve_site as helper
import sqlalchemy as sa
from markupsafe import escape
from prometheus_client.parser import text_string_to_metric_families

from compgen.errors import InputError
from compgen.fleet import decisions
from compgen.fleet.dashboard import app as reading
from compgen.fleet.dashboard import background
from compgen.fleet.dashboard.settings import DashboardSettings, check_settings, default_users
from compgen.fleet.dashboard.users import Users
from compgen.fleet.status import fleet
from compgen.fleet.store import open_store
from compgen.web import guard as limits
from compgen.web import guard as sessions

factory, Site, Clock = helper.factory, helper.Site, helper.Clock
OWN, PASSWORD, PAGES, DECISIONS = helper.OWN, helper.PASSWORD, helper.PAGES, helper.DECISIONS
STYLE = Path(__file__).resolve().parents[2] / "templates" / "_serve" / "style.css"


@pytest.fixture(autouse=True)
def _cheap_hashes(request):
    """All tests but those that say otherwise hash cheaply."""
    if "real_hashes" in request.fixturenames:
        yield
        return
    with helper.cheap_hashes():
        yield


@pytest.fixture(autouse=True)
def _patience(monkeypatch):
    """Figures that are worked out beside the requests are waited for."""
    monkeypatch.setattr(background, "PATIENCE_S", 60.0)
    monkeypatch.setattr(reading, "A_MOMENT_S", 60.0)


@pytest.fixture
def real_hashes():
    """Hash as outside of tests."""


@pytest.fixture
def site(tmp_path):
    made = Site(tmp_path)
    yield made
    made.store.close()


# --- reading ------------------------------------------------------------------------------------------------------------


def test_the_fleet_shows_every_machine_with_its_status(site):
    text = site.get("/").text
    for status in ("waits for approval", "held back", "not accepted", "failed"):
        assert f">{status}</span>" in text
    assert 'href="/machines/1/tables/3"' in text
    assert "5 machines" in re.sub(r"<[^>]+>", "", text)


def test_the_summary_of_the_database_is_that_of_the_decisions_one_by_one(site):
    """The overview sums up in the database; the states of the store follow each decision."""
    evil, mill = site.store.machine(factory.EVIL[:150]), site.store.machine("mill-1")
    decisions.rollback(site.store, evil, "meyer", "none", to=0)
    decisions.approve(site.store, mill, 3, "meyer")
    decisions.rollback(site.store, mill, "meyer", "back", to=1)
    found = fleet(site.store)
    tables = site.store.tables()
    assert {state: n for state, n in found.states.items() if n} == Counter(table.state for table in tables)
    for row in found.rows:
        own = [table for table in tables if table.machine_id == row.machine.id]
        assert row.active == next((table.version for table in own if table.state == "active"), None)
        assert row.waiting == [table.version for table in own[::-1] if table.state in ("pending", "held")]
        assert row.newest == (own[-1].state if own else None)
        times = [m.measured_at for m in site.store.measurements(row.machine)]
        assert (row.measured_at, row.measurements) == (max(times), len(times))
        made = [d for d in site.store.decisions(row.machine) if d.kind in ("approve", "rollback")]
        assert row.active_since == (made[-1].at if made and row.active else None)


def test_the_fleet_is_searched_by_name_and_by_status(site):
    assert "<caption>2 machines" in site.get("/?status=held").text
    assert "<caption>1 machines" in site.get("/?q=MILL-1").text
    assert "No machines found" in site.get("/?q=lathe").text
    assert "<caption>5 machines" in site.get("/?status=unknown&page=99999999").text


def test_the_drift_of_a_machine_is_that_of_its_errors(site):
    """EC0Y is 13, 16, 19 urad with u = 0.8: 3 since the last, 6 since the first, interval 1.6."""
    text = site.get("/machines/1").text
    row = re.search(r'<th scope="row">EC0Y</th>(.*?)</tr>', text)[1]
    assert re.findall(r">([^<]+)</td>", row) == ["value", "19.00", "1.60", "+3.00", "+6.00", "µrad"]
    row = re.search(r'<th scope="row">EXX</th>(.*?)</tr>', text)[1]
    assert re.findall(r">([^<]+)</td>", row) == ["largest minus smallest", "8.00", "–", "+1.00", "+2.00", "µm"]
    assert "Chart: EC0Y" in text
    assert "Chart: Temperatures" in text


def test_the_judged_drift_of_a_machine_is_shown_or_why_there_is_none(site):
    """EC0Y is the one squareness error, so nothing but the gauge could hide its change: 3 and 6 urad, 2 * 0.8 * sqrt(2)."""
    text = site.get("/machines/1/drift").text
    row = re.search(r'Changes</h2>.*?<th scope="row">EC0Y</th>(.*?)</tr>', text, re.S)[1]
    cells = re.findall(r">([^<]+)</td>", row)
    assert (cells[0], cells[1], cells[3], cells[4], cells[6]) == ("+3.00", "2.26", "+6.00", "2.26", "µrad")
    assert 0.0 < float(cells[2]) < 0.05
    assert cells[5] == "&lt; 0.001"
    assert site.get("/machines/1/drift").text == text
    assert "measure it first" in site.get("/machines/5/drift").text


def test_before_and_after_of_a_table_are_the_figures_of_the_store(site):
    text = site.get("/machines/1/tables/3").text
    row = re.search(r'<th scope="row">rms of the error vector</th>(.*?)<td><svg', text, re.S)[1]
    assert re.findall(r">([^<]+)</td>", row) == ["24.00", "6.00", "1.50"]
    row = re.search(r'<th scope="row">EC0Y</th>(.*?)</tr>', text)[1]
    assert re.findall(r">([^<]+)</td>", row) == ["16.00", "19.00", "+3.00", "2.26", "yes"]  # 2 * 0.8 * sqrt(2)
    assert "X −0.50, Y +0.25, Z +0.00 µm" in text
    assert '<span class="del">-; table 2</span>' in text
    assert '<span class="add">+; table 3</span>' in text
    assert "the same bytes as the active file" in text


def test_downloads_are_the_bytes_of_the_store(site):
    answer = site.get("/machines/1/tables/2/files/1")
    assert answer.data == b"; table 2\n0 1.0\n100 2.0\n"
    assert answer.headers["Content-Disposition"] == 'attachment; filename="table.csv"'
    assert answer.mimetype == "application/octet-stream"


def test_a_read_only_dashboard_has_no_forms_and_no_login(tmp_path):
    site = Site(tmp_path, decide=False, users=None)
    before = factory.everything(site.store)
    assert "<form" not in site.get("/machines/1/tables/3").text
    assert site.get("/login").status_code == 404
    assert site.post("/login", {"name": "meyer", "password": PASSWORD}).status_code == 404
    for path, data in DECISIONS:
        assert site.post(path, data).status_code == 403
    assert factory.everything(site.store) == before


def test_every_page_is_marked_up_for_everybody(site):
    """Language, one heading of level 1, labels for every field, header cells with scope, names for every chart."""
    site.login()
    for path in PAGES:
        text = site.get(path).text
        assert '<html lang="en">' in text
        assert text.count("<h1") == 1, path
        assert text.count('<main id="content"') == 1
        assert all("scope=" in tag for tag in re.findall(r"<th\b[^>]*>", text)), path
        labels = set(re.findall(r'<label for="([^"]+)"', text))
        fields = re.findall(r"<(?:input|select|textarea)\b[^>]*>", text)
        shown = [field for field in fields if 'type="hidden"' not in field]
        assert all(re.search(r'id="([^"]+)"', field)[1] in labels for field in shown), path
        assert all("aria-label=" in tag or "aria-hidden=" in tag for tag in re.findall(r"<svg\b[^>]*>", text)), path
        ids = re.findall(r'\bid="([^"]+)"', text)
        assert len(ids) == len(set(ids)), path


def luminance(colour):
    """Relative luminance of WCAG 2.2."""
    parts = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(first, second):
    low, high = sorted((luminance(first), luminance(second)))
    return (high + 0.05) / (low + 0.05)


def test_texts_have_the_contrast_of_wcag_aa_in_light_and_dark():
    css = STYLE.read_text(encoding="utf-8")
    themes = re.findall(r":root \{(.*?)\}", css, re.S)
    assert len(themes) == 2
    for theme in themes:
        colour = dict(re.findall(r"--([a-z0-9]+): (#[0-9a-f]{6})", theme))
        for name in ("text", "soft", "link", "good", "bad", "warn"):
            for ground in ("page", "panel"):
                assert contrast(colour[name], colour[ground]) >= 4.5, (name, ground)
        for ground in ("good", "bad"):
            assert contrast(colour["on"], colour[ground]) >= 4.5
        for name in ("s0", "s1", "s2", "s3", "none"):
            assert contrast(colour[name], colour["page"]) >= 3.0, name


# --- texts stay texts ---------------------------------------------------------------------------------------------------


class Tags(HTMLParser):
    """Names of the elements, and the attributes that could run something."""

    def __init__(self):
        super().__init__()
        self.tags, self.dangerous = set(), []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.dangerous += [(tag, name) for name, value in attrs if name.startswith("on") or name == "style"]
        self.dangerous += [(tag, value) for _, value in attrs if (value or "").lower().startswith("javascript:")]


@pytest.mark.parametrize("path", [*PAGES, f"/?q={factory.EVIL}", f"/login?back={factory.EVIL}", f"/{factory.EVIL}"])
def test_no_text_becomes_markup(site, path):
    site.login()
    answer = site.get(path)
    tags = Tags()
    tags.feed(answer.text)
    assert not tags.tags & {"script", "img", "iframe", "object", "embed", "base"}
    assert tags.dangerous == []
    assert ("{{7*7}}" in answer.text) == (path.startswith(("/machines/4", "/?q=")) or path in ("/", "/audit"))


def test_hostile_names_of_files_reach_no_header_and_no_path(site):
    answer = site.get("/machines/4/tables/2/files/1")
    assert answer.data == factory.EVIL.encode()
    assert answer.headers["Content-Disposition"] == 'attachment; filename="pass__X-Evil__1__wd"'
    assert "X-Evil" not in answer.headers


@pytest.mark.parametrize(
    "path",
    [
        "/machines/1/tables/2/files/0",
        "/machines/1/tables/2/files/3",
        "/machines/1/tables/2/files/-1",
        "/machines/1/tables/2/files/99999999999999999999999",
        "/machines/99999999999999999999999",
        "/machines/1/tables/2/files/../../../../etc/passwd",
        "/machines/1/tables/2/files/..%2f..%2f..%2fetc%2fpasswd",
        "/machines/1/tables/2/files/%2e%2e/%2e%2e/etc/passwd",
        "/../users.json",
        "/style.css/../base.html",
        "/static/../base.html",
        "/base.html",
        "/machines/1;drop table machines",
        "/machines/1' OR '1'='1",
        "/machines/1%00",
    ],
)
def test_no_path_leads_to_anything_but_pages(site, path):
    answer = site.get(path)
    assert answer.status_code == 404
    assert "root:" not in answer.text
    assert "argon2" not in answer.text


def test_headers_of_every_answer_forbid_scripts_frames_guesses_and_caches(site):
    answers = [
        site.get(path) for path in (*PAGES, "/style.css", "/metrics", "/healthz", "/machines/1/tables/1/files/1")
    ]
    answers += [site.post("/logout", headers={}), site.client.get("/", headers={"Host": "evil.example"})]
    for answer in answers:
        policy = dict(part.strip().split(" ", 1) for part in answer.headers["Content-Security-Policy"].split(";"))
        assert policy["default-src"] == policy["base-uri"] == policy["frame-ancestors"] == "'none'"
        assert policy["style-src"] == policy["form-action"] == "'self'"
        assert "script-src" not in policy
        assert answer.headers["X-Frame-Options"] == "DENY"
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Cache-Control"] == "no-store"
        assert "Access-Control-Allow-Origin" not in answer.headers
        assert "Strict-Transport-Security" not in answer.headers


# --- who may change something -------------------------------------------------------------------------------------------


def test_without_login_nothing_changes(site):
    before = factory.everything(site.store)
    for path, data in DECISIONS:
        for method in ("post", "put", "patch", "delete"):
            answer = getattr(site.client, method)(path, base_url=OWN, data=data, headers={"Origin": OWN})
            assert answer.status_code in (403, 405)
        assert site.get(path, query_string=data).status_code == 405
    assert factory.everything(site.store) == before


FOREIGN = [
    {},
    {"Origin": "null"},
    {"Origin": "https://evil.example"},
    {"Origin": "http://localhost:9999"},
    {"Origin": "https://localhost:8765"},
    {"Origin": "http://localhost:8765.evil.example"},
    {"Referer": "http://evil.example/http://localhost:8765/"},
    {"Referer": "http://localhost:8765.evil.example/"},
    {"Origin": OWN, "Sec-Fetch-Site": "cross-site"},
    {"Origin": OWN, "Sec-Fetch-Site": "same-site"},
]


@pytest.mark.parametrize("headers", FOREIGN)
def test_requests_from_other_sites_change_nothing_even_with_session_and_token(site, headers):
    site.login()
    token, before = site.token(), factory.everything(site.store)
    for path, data in DECISIONS:
        assert site.post(path, {**data, "csrf": token}, headers=headers).status_code == 403
    assert site.post("/logout", {"csrf": token}, headers=headers).status_code == 403
    assert site.cookie() is not None
    assert factory.everything(site.store) == before


def test_a_wrong_missing_or_foreign_token_changes_nothing(site):
    site.login()
    other = site.app.test_client()
    field = re.search(r'name="csrf" value="([^"]+)"', other.get("/login", base_url=OWN).text)[1]
    data = {"name": "meyer", "password": PASSWORD, "csrf": field}
    other.post("/login", base_url=OWN, data=data, headers={"Origin": OWN})
    foreign = re.search(r'name="csrf" value="([^"]+)"', other.get("/", base_url=OWN).text)[1]
    before = factory.everything(site.store)
    for token in ({}, {"csrf": ""}, {"csrf": "x" * 43}, {"csrf": foreign}, {"csrf": "\u00e4"}):
        for path, fields in DECISIONS:
            assert site.post(path, fields | token).status_code == 403
    assert factory.everything(site.store) == before


@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example", "", "localhost@evil", "127.0.0.1.nip.io", "a b"]
)
def test_foreign_host_names_are_refused(site, host):
    answer = site.client.get("/", headers={"Host": host})
    assert answer.status_code == 421
    assert "mill-1" not in answer.text


def test_host_names_that_were_given_are_served(tmp_path):
    site = Site(tmp_path, names=("Factory.example",))
    for host in ("factory.example", "127.0.0.1:8765", "[::1]:8765", "LOCALHOST"):
        assert site.client.get("/", headers={"Host": host}).status_code == 200


def test_a_user_approves_rejects_and_rolls_back_with_name_and_reason(site):
    mill = site.store.machine("mill-1")
    assert site.login().headers["Location"] == "/"
    answer = site.post(*_with_token(site, 0))
    assert answer.headers["Location"] == "/machines/1"
    assert "approve is done" in site.get("/machines/1").text
    assert "approve is done" not in site.get("/machines/1").text
    assert decisions.active_table(site.store, mill).version == 3
    data = {"reason": "worse\r\nthan  before\x00", "to": "1", "seen": "3", "csrf": site.token()}
    assert site.post("/machines/1/rollback", data).status_code == 303
    assert decisions.active_table(site.store, mill).version == 1
    data = {"reason": "too old", "seen": "1", "csrf": site.token()}
    assert site.post("/machines/2/tables/2/reject", data).status_code == 303
    made = [d for d in site.store.decisions() if d.actor == "meyer"][-3:]
    assert {(d.kind, d.reason) for d in made} == {
        ("approve", "fine"),
        ("rollback", "worse than before"),
        ("reject", "too old"),
    }
    assert "worse than before" in site.get("/audit?who=people").text


def _with_token(site, k):
    path, data = DECISIONS[k]
    return path, {**data, "csrf": site.token()}


def test_tables_that_are_held_back_need_override_and_reason_and_refused_ones_never_become_active(site):
    site.login()
    token, before = site.token(), factory.everything(site.store)
    for path, fields in (
        ("/machines/2/tables/2/approve", {"reason": "why not", "seen": "1"}),
        ("/machines/2/tables/2/approve", {"override": "yes", "seen": "1", "reason": " "}),
        ("/machines/3/tables/1/approve", {"override": "yes", "seen": "0", "reason": "please"}),
        ("/machines/1/tables/3/reject", {"reason": "", "seen": "2"}),
        ("/machines/1/tables/3/reject", {"reason": "x" * 1001, "seen": "2"}),
        ("/machines/1/tables/9/approve", {"seen": "2"}),
        ("/machines/1/rollback", {"reason": "x", "to": "3", "seen": "2"}),
        ("/machines/1/rollback", {"reason": "x", "to": "1; DROP TABLE decisions", "seen": "2"}),
        ("/machines/1/rollback", {"reason": "", "to": "1", "seen": "2"}),
    ):
        assert site.post(path, {**fields, "csrf": token}).status_code == 409, (path, fields)
    assert factory.everything(site.store) == before
    fields = {"override": "yes", "reason": "measured again by hand", "seen": "1", "csrf": token}
    assert site.post("/machines/2/tables/2/approve", fields).status_code == 303


def test_a_decision_on_a_page_that_is_out_of_date_is_refused(site):
    site.login()
    token = site.token()
    mill = site.store.machine("mill-1")
    decisions.rollback(site.store, mill, "schmidt", "meanwhile", to=1)
    before = factory.everything(site.store)
    answer = site.post("/machines/1/tables/3/approve", {"seen": "2", "csrf": token})
    assert answer.status_code == 409
    assert "the active tables have changed" in answer.text
    assert factory.everything(site.store) == before


def test_a_body_that_is_too_large_is_refused(site):
    site.login()
    before = factory.everything(site.store)
    assert site.post(DECISIONS[0][0], {"csrf": site.token(), "reason": "x" * 20_000}).status_code == 413
    assert factory.everything(site.store) == before


# --- login and sessions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "password"),
    [
        ("meyer", "wrong"),
        ("Meyer2", PASSWORD),
        ("", ""),
        ("meyer", PASSWORD + "\0"),
        ("meyer' --", "x"),
        ("meyer", "x" * 5000),
    ],
)
def test_wrong_names_and_passwords_get_the_same_answer_and_no_session(site, name, password):
    answer = site.login(name, password)
    assert answer.status_code == 403
    assert "Name or password is wrong." in answer.text
    assert site.cookie() is None
    assert "Logged in as" not in site.get("/").text


def test_the_cookie_of_a_session_is_for_this_site_and_not_for_scripts(site):
    header = next(value for value in site.login().headers.getlist("Set-Cookie") if "session" in value)
    assert "HttpOnly" in header
    assert "SameSite=Strict" in header
    assert "Path=/" in header
    assert "Domain" not in header


def test_over_https_cookies_are_tied_to_host_and_https(tmp_path):
    site = Site(tmp_path, tls=True, host="0.0.0.0", names=("factory.example",))
    answer = site.client.get("/login", headers={"Host": "factory.example"})
    (cookie,) = answer.headers.getlist("Set-Cookie")
    assert cookie.startswith("__Host-compgen-login=")
    assert "Secure" in cookie
    assert answer.headers["Strict-Transport-Security"].startswith("max-age=")
    http = {"Host": "factory.example", "Origin": "http://factory.example"}
    assert site.client.post("/login", headers=http).status_code == 403


def test_a_login_never_takes_over_a_session_that_the_browser_brought(site):
    """Session fixation: neither an invented token nor an earlier one lives on after a login."""
    site.client.set_cookie("compgen-8765-session", "chosen-by-somebody-else", domain="localhost")
    site.login()
    first = site.cookie()
    assert first != "chosen-by-somebody-else"
    site.login()
    assert site.cookie() != first
    thief = site.app.test_client()
    for token in (first, "chosen-by-somebody-else"):
        thief.set_cookie("compgen-8765-session", token, domain="localhost")
        assert "Logged in as" not in thief.get("/", base_url=OWN).text


def test_a_login_form_of_another_browser_is_refused(site):
    field = site.token("/login")
    other = site.app.test_client()
    data = {"name": "meyer", "password": PASSWORD, "csrf": field}
    assert other.post("/login", base_url=OWN, data=data, headers={"Origin": OWN}).status_code == 403
    other.get("/login", base_url=OWN)
    assert other.post("/login", base_url=OWN, data=data, headers={"Origin": OWN}).status_code == 403


def test_logging_out_ends_the_session_on_the_server(site):
    site.login()
    token = site.cookie()
    site.post("/logout", {"csrf": site.token()})
    site.client.set_cookie("compgen-8765-session", token, domain="localhost")
    assert "Logged in as" not in site.get("/").text


def test_sessions_end_after_rest_after_a_day_and_with_the_password(site):
    site.login()
    site.clock.now += sessions.IDLE_S - 1
    assert "Logged in as" in site.get("/").text
    site.clock.now += sessions.IDLE_S + 1
    assert "Logged in as" not in site.get("/").text
    site.login()
    for _ in range(int(sessions.LONGEST_S / 1000.0)):
        site.clock.now += 1000.0
        site.get("/")
    assert "Logged in as" in site.get("/").text
    site.clock.now += 1000.0
    assert "Logged in as" not in site.get("/").text
    site.login()
    site.users.add("meyer", "another good password")
    before = factory.everything(site.store)
    assert "Logged in as" not in site.get("/").text
    assert site.post(*DECISIONS[0]).status_code == 403
    assert factory.everything(site.store) == before


def test_a_removed_user_is_out_at_once(site):
    site.login()
    site.users.remove("meyer")
    assert "Logged in as" not in site.get("/").text


def test_after_five_wrong_tries_even_the_right_password_has_to_wait(site):
    for _ in range(limits.PAIR):
        assert site.login(password="wrong password").status_code == 403
    answer = site.login()
    assert answer.status_code == 429
    assert 0 < int(answer.headers["Retry-After"]) <= limits.WINDOW_S
    assert site.cookie() is None
    site.clock.now += limits.WINDOW_S
    assert site.login().status_code == 303


def test_the_limits_count_per_address_per_name_and_in_all():
    clock = Clock()
    limit = limits.LoginLimit(clock)
    assert [limit.wait_s("a", f"user{k}") > 0.0 for k in range(limits.ADDRESS + 1)] == [False] * limits.ADDRESS + [True]
    limit = limits.LoginLimit(clock)
    assert [limit.wait_s(f"a{k}", "NAME" if k % 2 else "name") > 0.0 for k in range(limits.NAME + 1)][-2:] == [
        False,
        True,
    ]
    limit = limits.LoginLimit(clock)
    assert [limit.wait_s(f"a{k}", f"n{k}") > 0.0 for k in range(limits.ALL + 1)][-2:] == [False, True]
    clock.now += limits.WINDOW_S
    assert limit.wait_s("a", "n") == 0.0
    assert len(limit._tries) == 4  # what is over is forgotten


def test_logins_that_are_right_use_nothing_up():
    limit = limits.LoginLimit(Clock())
    for _ in range(10 * limits.ALL):
        assert limit.wait_s("a", "n") == 0.0
        limit.succeeded("a", "n")


@pytest.mark.parametrize(
    "back",
    ["//evil.example", "https://evil.example", "/\\evil.example", "/machines/1\r\nX: y", "javascript:alert(1)", "/x"],
)
def test_a_login_leads_to_own_pages_only(site, back):
    assert site.login(back=back).headers["Location"] == "/"


def test_a_login_leads_back_to_where_it_was_asked_for(site):
    assert site.login(back="/machines/1/tables/3").headers["Location"] == "/machines/1/tables/3"


def test_a_private_dashboard_shows_nothing_without_login(tmp_path):
    site = Site(tmp_path, private=True, metrics_token="0123456789abcdef")
    for path in (*PAGES[:7], "/machines/1/tables/1/files/1", "/nowhere"):
        answer = site.get(path)
        assert answer.headers["Location"] == "/login"
        assert "mill" not in answer.text
    assert site.get("/metrics").status_code == 403
    assert site.get("/metrics", headers={"Authorization": "Bearer 0123456789abcdeX"}).status_code == 403
    assert site.get("/metrics", headers={"Authorization": "Bearer 0123456789abcdef"}).status_code == 200
    site.login()
    assert "mill-1" in site.get("/").text


# --- users --------------------------------------------------------------------------------------------------------------


def test_passwords_are_kept_as_argon2id_and_only_for_the_owner(tmp_path, real_hashes):
    users = Users(tmp_path / "users.json")
    assert users.add("meyer", PASSWORD)
    text = users.path.read_text()
    assert json.loads(text)["users"]["meyer"].startswith("$argon2id$v=19$m=65536,t=3,p=4$")
    assert PASSWORD not in text
    assert users.path.stat().st_mode & 0o077 == 0
    assert users.verify("meyer", PASSWORD)
    assert not users.verify("meyer", PASSWORD + " ")
    assert not users.add("meyer", "another good password")
    assert not users.verify("meyer", PASSWORD)


@pytest.mark.parametrize("name", ["", "a b", "automatic", "AUTOMATIC", "-x", "<b>", "x" * 65, "a\nb", "../x", "MEYER"])
def test_names_that_cannot_be_told_apart_are_refused(tmp_path, name):
    users = Users(tmp_path / "users.json")
    users.add("meyer", PASSWORD)
    with pytest.raises(InputError):
        users.add(name, PASSWORD)
    assert users.names() == ["meyer"]


@pytest.mark.parametrize("password", ["", "elevenchars", "x" * 257, "aaaaaaaaaaaaaaaa", "Meyer-Meyer-1"])
def test_passwords_that_are_easy_are_refused(tmp_path, password):
    with pytest.raises(InputError):
        Users(tmp_path / "users.json").add("meyer", password)


def test_a_file_of_users_that_others_may_write_is_not_trusted(tmp_path):
    users = Users(tmp_path / "users.json")
    users.add("meyer", PASSWORD)
    users.path.chmod(0o666)
    with pytest.raises(InputError, match="chmod 600"):
        users.verify("meyer", PASSWORD)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"users": []}', '{"users": {"a": 1}}'])
def test_a_damaged_file_of_users_lets_nobody_in(tmp_path, text):
    path = tmp_path / "users.json"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(InputError, match="users.json"):
        Users(path).verify("meyer", PASSWORD)


@pytest.mark.parametrize(
    "options",
    [
        {"decide": True, "host": "0.0.0.0"},
        {"private": True, "host": "192.0.2.1"},
        {"decide": True, "users": None},
        {"names": ("http://x",)},
        {"names": ("a b",)},
    ],
)
def test_settings_that_are_not_safe_are_refused(options):
    with pytest.raises(InputError):
        check_settings(DashboardSettings("x.sqlite", **({"users": Path("u")} | options)))


def test_users_of_an_sqlite_store_lie_beside_it():
    assert default_users("a/b.sqlite") == Path("a/b.sqlite.users.json")
    assert default_users("sqlite:////a/b.sqlite") == Path("/a/b.sqlite.users.json")
    assert default_users("postgresql://host/name") is None


# --- observability ------------------------------------------------------------------------------------------------------


def samples(text):
    return {
        (s.name, *sorted(s.labels.values())): s.value for f in text_string_to_metric_families(text) for s in f.samples
    }


def test_metrics_count_the_fleet_and_what_happened(site):
    site.login(password="wrong password")
    site.login()
    site.post(*_with_token(site, 0))
    site.client.get("/", headers={"Host": "evil.example"})
    found = samples(site.get("/metrics").text)
    assert found["compgen_store_up",] == 1.0
    assert found["compgen_machines", "held"] == 2.0
    assert found["compgen_machines", "failed"] == 1.0
    assert found["compgen_tables", "active"] == 3.0
    assert found["compgen_active_version", "mill-1"] == 3.0
    assert found["compgen_logins_total", "wrong"] == found["compgen_logins_total", "right"] == 1.0
    assert found["compgen_dashboard_decisions_total", "approve"] == 1.0
    assert found["compgen_refused_requests_total", "host"] == 1.0
    assert found["compgen_sessions",] == 1.0
    measured = site.store.measurements(site.store.machine("mill-1"))[-1].measured_at
    assert found["compgen_last_measurement_timestamp_seconds", "mill-1"] == measured.timestamp()


def test_a_store_that_is_gone_is_told_without_details(site, monkeypatch):
    from compgen.fleet.database import StoreError

    def gone(action):
        raise StoreError("the store postgresql://secret-host/name cannot be used")

    monkeypatch.setattr(site.store, "read", gone)
    answer = site.get("/")
    assert answer.status_code == 503
    assert "secret-host" not in answer.text
    assert site.get("/healthz").status_code == 503
    assert samples(site.get("/metrics").text)["compgen_store_up",] == 0.0


def test_a_fault_of_the_program_shows_no_inside(site, monkeypatch):
    def broken(action):
        raise RuntimeError("inside /secret/path")

    monkeypatch.setattr(site.store, "read", broken)
    answer = site.get("/")
    assert answer.status_code == 500
    assert "secret" not in answer.text


def test_logs_are_json_lines_without_passwords_and_tokens(site, capsys):
    from compgen.fleet import logs

    logs.configure("json")
    site.login(password="a wrong password")
    site.login()
    path, data = _with_token(site, 0)
    site.post(path, data)
    site.get("/?q=looked-for%0d%0aforged")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert {"login refused", "login", "decision", "request"} <= {line["event"] for line in lines}
    decision = next(line for line in lines if line["event"] == "decision")
    assert (decision["user"], decision["machine"], decision["kind"]) == ("meyer", "mill-1", "approve")
    text = json.dumps(lines)
    for secret in (PASSWORD, "a wrong password", data["csrf"], site.cookie(), "forged"):
        assert secret not in text


def test_the_store_refuses_what_the_pages_never_do(site):
    """Even a fault of the dashboard could not rewrite the audit trail."""
    with pytest.raises(Exception, match="(?i)append|change|never"):
        site.store.write(lambda c: c.execute(sa.text("UPDATE decisions SET actor = 'nobody'")))


# --- pages that are kept, a store that is moved ---------------------------------------------------------------------


def test_a_page_is_made_once_for_all_and_each_reader_sees_the_own_name_and_token(site, monkeypatch):
    made = []
    real = reading.history
    monkeypatch.setattr(reading, "history", lambda *parts: made.append(1) or real(*parts))
    site.users.add("o.hara@x", helper.PASSWORD)
    for _ in range(3):
        assert "Logged in" not in site.get("/machines/1").text
    assert len(made) == 1
    tokens = set()
    for name in ("meyer", "o.hara@x"):
        site.client = site.app.test_client()
        site.login(name)
        pages = [site.get("/machines/1").text for _ in range(3)]
        assert len(set(pages)) == 1
        assert pages[0].count("Logged in as") == 1
        assert f"<strong>{escape(name)}</strong>" in pages[0]
        found = set(re.findall(r'name="csrf" value="([^"]+)"', pages[0]))
        assert len(found) == 1
        tokens |= found
        assert not any(place in pages[0] for place in reading.PLACES.values())
    assert len(tokens) == 2
    assert len(made) == 2  # once for readers, once for who may decide
    site.client = site.app.test_client()
    site.login("reader")
    assert "rollback" not in site.get("/machines/1").text


def test_a_page_is_made_anew_after_every_change_and_after_a_while(site, monkeypatch):
    monkeypatch.setattr(background, "SHOWN_S", 2.0)
    assert "a new name" not in site.get("/").text
    open_store(site.settings.store_url).add_machine("a new name")
    assert "a new name" in site.get("/").text
    made = []
    real = reading.fleet
    monkeypatch.setattr(reading, "fleet", lambda *parts: made.append(1) or real(*parts))
    site.get("/")
    assert made == []
    time.sleep(2.0)  # "today" has its day
    site.get("/")
    assert made == [1]


def test_no_more_pages_are_kept_than_a_server_can_hold(site):
    for k in range(500):
        site.get(f"/?q={k}")
    assert len(site.app.extensions["compgen"].pages._pages) <= 200


def test_a_store_that_was_moved_away_is_told_and_no_decision_goes_into_the_moved_file(site, tmp_path):
    site.login()
    csrf = site.token("/machines/1/tables/3")
    assert site.get("/healthz").status_code == 200
    path = Path(site.settings.store_url)
    away = path.rename(path.with_name("away.sqlite"))
    assert site.get("/healthz").status_code == 503
    answer = site.post("/machines/1/tables/3/approve", {"reason": "fine", "seen": "2", "csrf": csrf})
    assert answer.status_code == 503
    assert not path.exists()
    away.rename(path)
    assert site.get("/healthz").status_code == 200
    assert site.store.tables(site.store.machines()[0])[-1].state != "active"
    answer = site.post("/machines/1/tables/3/approve", {"reason": "fine", "seen": "2", "csrf": csrf})
    assert answer.status_code == 303
