"""Attacks on the dashboard that a hostile reader tried, each with what has to come of it."""

import json
import socket
import threading
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("argon2", reason="the extra compgen[serve] is not installed: the dashboard is not tested")

import serve_site as helper

from compgen.errors import InputError
from compgen.fleet import decisions
from compgen.fleet.dashboard import server
from compgen.fleet.dashboard.users import Users
from compgen.web import connections as patience
from compgen.web import guard as limits

factory, OWN, PASSWORD, DECISIONS = helper.factory, helper.OWN, helper.PASSWORD, helper.DECISIONS
#: How long a test waits for an answer of the server, s.
PATIENCE_S = 20.0


@pytest.fixture
def site(tmp_path):
    made = helper.Site(tmp_path)
    yield made
    made.store.close()


@pytest.fixture
def served(tmp_path):
    made = helper.Served(tmp_path)
    yield made
    made.close()


# --- requests ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["TRACE", "PUT", "PATCH", "DELETE", "CONNECT", "PROPFIND", "X" * 500])
def test_methods_that_no_page_knows_are_refused_even_with_session_and_token(site, method):
    site.login()
    data, before = {"csrf": site.token(), "seen": "2", "reason": "x"}, factory.everything(site.store)
    for path in ("/", "/machines/1/tables/3/approve", "/login", "/nowhere"):
        answer = site.client.open(
            path, method=method, base_url=OWN, data=data, headers={"Origin": OWN, "X-Secret": "echoed"}
        )
        assert answer.status_code == 405
        assert set(answer.headers["Allow"].split(", ")) == {"GET", "HEAD", "OPTIONS", "POST"}
        assert "echoed" not in answer.text
    assert factory.everything(site.store) == before


@pytest.mark.parametrize("number", ["\u0661", "01", "+1", "1.0", "0x1", "1e0", "\uff11", " 1", "1 ", "2147483648"])
def test_each_page_has_one_address(site, number):
    assert site.get(f"/machines/{number}").status_code == 404
    assert site.get(f"/machines/1/tables/{number}").status_code == 404


@pytest.mark.parametrize("path", ["/", "/machines/1", "/machines/1/tables/3", "/audit", "/login", "/healthz"])
def test_head_is_get_without_the_body(site, path):
    answer = site.client.head(path, base_url=OWN)
    assert answer.status_code == 200
    assert answer.data == b""
    assert site.client.head("/machines/1/tables/3/approve", base_url=OWN).status_code == 405


@pytest.mark.parametrize(
    "query",
    ["?q=%ff%fe%80", "?q=%00", "?page=%D9%A1", "?status[]=x&page=1&page=2", "?q=%0d%0aX-Evil:%201", "?" + "&" * 999],
)
def test_bytes_that_are_no_text_are_words_that_are_not_found(site, query):
    for path in ("/", "/audit", "/login"):
        answer = site.get(path + query)
        assert answer.status_code == 200
        assert "X-Evil" not in answer.headers


def test_forms_of_every_shape_are_refused_without_a_fault(site):
    site.login()
    before = factory.everything(site.store)
    bodies = (
        (b"\xff\xfe%ff=%80&csrf=%00", "application/x-www-form-urlencoded"),
        (b'{"csrf": 1}', "application/json"),
        (b"--x\r\nbroken", "multipart/form-data; boundary=x"),
        (b"x", "multipart/form-data"),
        (b"&".join(b"a%d=1" % k for k in range(1500)), "application/x-www-form-urlencoded"),
        (b"csrf=" + b"x" * 20_000, "application/x-www-form-urlencoded"),
    )
    for path in (DECISIONS[0][0], "/login", "/logout", "/machines/1/rollback"):
        for body, kind in bodies:
            answer = site.client.post(path, base_url=OWN, data=body, content_type=kind, headers={"Origin": OWN})
            assert answer.status_code in (400, 403, 413), (path, body[:20])
            assert "Traceback" not in answer.text
    assert factory.everything(site.store) == before


def test_what_a_proxy_is_said_to_have_seen_counts_for_nothing(site):
    """X-Forwarded-For does not evade the limit, X-Forwarded-Host and Forwarded make no foreign host a known one."""
    for k in range(limits.ADDRESS):
        site.client.environ_base["HTTP_X_FORWARDED_FOR"] = f"192.0.2.{k}"
        assert site.login(f"user{k}", "wrong password").status_code == 403
    site.client.environ_base["HTTP_X_FORWARDED_FOR"] = "198.51.100.1"
    assert site.login("another", "wrong password").status_code == 429
    said = {"X-Forwarded-Host": "localhost:8765", "Forwarded": "host=localhost:8765", "Host": "evil.example"}
    assert site.client.get("/", headers=said).status_code == 421
    said = {"X-Forwarded-Host": "evil.example", "X-Forwarded-Proto": "https", "X-Forwarded-Prefix": "//evil.example"}
    assert "evil.example" not in site.get("/", headers=said).text


# --- decisions --------------------------------------------------------------------------------------------------------


def test_a_reader_sees_what_is_private_and_decides_nothing(tmp_path):
    site = helper.Site(tmp_path, private=True)
    assert site.login("reader").status_code == 303
    text = site.get("/machines/1/tables/3").text
    assert "Logged in as" in text
    assert "Approve version" not in text
    assert "Roll back" not in site.get("/machines/1").text
    before = factory.everything(site.store)
    for path, data in DECISIONS:
        answer = site.post(path, {**data, "csrf": site.token()})
        assert answer.status_code == 403
        assert "not decide" in answer.text
    assert factory.everything(site.store) == before
    site.store.close()


def test_a_user_who_becomes_a_reader_decides_nothing_any_more(tmp_path):
    with helper.cheap_hashes():
        users = Users(tmp_path / "users.json")
        users.add("meyer", PASSWORD)
        assert users.may_decide("meyer")
        users.add("meyer", PASSWORD, reader=True)
        assert not users.may_decide("meyer")
        users.add("meyer", PASSWORD)
        assert users.may_decide("meyer")
    assert not users.may_decide("nobody")
    users.path.write_text(json.dumps({"users": {"meyer": "x"}, "readers": {"meyer": 1}}))
    with pytest.raises(InputError, match="malformed list of readers"):
        users.may_decide("meyer")


def test_tables_in_no_state_to_be_decided_on_stay_as_they_are(site):
    """Crafted forms for tables that are retired, active, superseded, rejected or refused."""
    site.login()
    mill = site.store.machine("mill-1")
    factory.add(site.store, mill, 4)
    decisions.reject(site.store, mill, 4, "schmidt", "no")
    states = [table.state for table in site.store.tables(mill)]
    assert states == ["retired", "active", "superseded", "rejected"]
    token, before = site.token(), factory.everything(site.store)
    for version in (1, 2, 3, 4):
        for kind in ("approve", "reject"):
            fields = {"reason": "please", "override": "yes", "seen": "2", "csrf": token}
            assert site.post(f"/machines/1/tables/{version}/{kind}", fields).status_code == 409
    for to in ("2", "3", "4", "-1", "1.0", "\u0661", "999999999999"):
        fields = {"reason": "please", "to": to, "seen": "2", "csrf": token}
        assert site.post("/machines/1/rollback", fields).status_code == 409, to
    for seen in ("", "x", "\u0662", "-2", "2 "):
        assert (
            site.post("/machines/1/rollback", {"reason": "x", "to": "1", "seen": seen, "csrf": token}).status_code
            == 409
        )
    assert factory.everything(site.store) == before


def test_what_was_seen_is_checked_in_the_same_transaction_as_the_decision(site):
    """Two pages show version 2 as active; only the first decision stands, whichever kinds they are."""
    mill = site.store.machine("mill-1")
    factory.add(site.store, mill, 4, hold=["why"])
    decisions.approve(site.store, mill, 3, "meyer", seen=2)
    with pytest.raises(decisions.DecisionError, match="the active tables have changed"):
        decisions.approve(site.store, mill, 4, "schmidt", "checked", override=True, seen=2)
    with pytest.raises(decisions.DecisionError, match="the active tables have changed"):
        decisions.reject(site.store, mill, 4, "schmidt", "no", seen=2)
    with pytest.raises(decisions.DecisionError, match="the active tables have changed"):
        decisions.rollback(site.store, mill, "schmidt", "back", to=1, seen=2)
    decisions.rollback(site.store, mill, "schmidt", "none", to=0, seen=3)
    with pytest.raises(decisions.DecisionError, match="the active tables have changed"):
        decisions.rollback(site.store, mill, "schmidt", "back", to=1, seen=3)
    decisions.rollback(site.store, mill, "schmidt", "back", to=1, seen=0)


def test_of_two_who_approve_at_the_same_time_one_is_told_that_it_is_done(site):
    clients = [site.app.test_client() for _ in range(4)]
    tokens = []
    for client in clients:
        site.client = client
        site.login()
        tokens.append(site.token())
    start, codes = threading.Barrier(len(clients)), []

    def approve(client, token):
        start.wait()
        data = {"seen": "2", "reason": "same time", "csrf": token}
        codes.append(client.post(DECISIONS[0][0], base_url=OWN, data=data, headers={"Origin": OWN}).status_code)

    threads = [threading.Thread(target=approve, args=pair) for pair in zip(clients, tokens, strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(codes) == [303, 409, 409, 409]
    assert sum(d.reason == "same time" for d in site.store.decisions(site.store.machine("mill-1"))) == 1


# --- the server on a real port ----------------------------------------------------------------------------------------


def raw(address, data, *, seconds=PATIENCE_S):
    """Send bytes and return everything that comes back until the server closes."""
    found = b""
    with socket.create_connection(address, timeout=seconds) as connection:
        connection.sendall(data)
        try:
            while part := connection.recv(65536):
                found += part
        except TimeoutError:
            found += b" (no end)"
        except ConnectionResetError:  # closed while there was more to read: as good as a refusal
            found = found or b"HTTP/1.0 431 closed\r\n"
    return found


def head(address, method=b"GET", path=b"/healthz", *, headers=(), body=b""):
    host = b"Host: localhost:%d" % address[1]
    length = [b"Content-Length: %d" % len(body)] if body else []
    lines = [b"%s %s HTTP/1.1" % (method, path), host, b"Connection: close", *headers, *length]
    return raw(address, b"\r\n".join(lines) + b"\r\n\r\n" + body)


def test_requests_that_are_too_large_or_no_requests_are_refused(served):
    address = served.address
    assert b" 431 " in head(address, headers=[b"X-A: " + b"a" * 100_000]).split(b"\r\n")[0]
    assert b" 413 " in head(address, b"POST", b"/login", body=b"a=" + b"x" * 100_000).split(b"\r\n")[0]
    assert b" 400 " in raw(address, b"\x00\x01\xff\r\n\r\n").split(b"\r\n")[0]
    assert b" 400 " in head(address, headers=[b"X-A: a\x00b"]).split(b"\r\n")[0]
    assert b" 400 " in head(address, headers=[b"Content-Length: -1"]).split(b"\r\n")[0]
    assert b" 400 " in head(address, headers=[b"Content-Length: 5", b"Content-Length: 6"]).split(b"\r\n")[0]
    assert b" 200 " in head(address).split(b"\r\n")[0]


def test_a_request_inside_the_body_of_another_is_not_answered(served):
    """Request smuggling: two statements of the length."""
    start = b"POST /login HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n"
    found = raw(served.address, start + b"0\r\n\r\nGET /audit HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    assert b"Audit trail</h1>" not in found.partition(b"\r\n\r\n")[0]
    assert found.startswith(b"HTTP/1.1 40")


def test_who_sends_byte_by_byte_does_not_keep_others_out(tmp_path, monkeypatch):
    """Slow loris: more connections than the server takes, each sending a little of a header for ever."""
    monkeypatch.setattr(server, "CONNECTIONS", 20)
    monkeypatch.setattr(patience, "REQUEST_S", 3.0)
    monkeypatch.setattr(patience, "CROWDED_S", 0.5)
    served = helper.Served(tmp_path)
    slow = []
    try:
        for _ in range(40):
            connection = socket.create_connection(served.address, timeout=PATIENCE_S)
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX-A: ")
            slow.append(connection)
        assert head(served.address).startswith(b"HTTP/1.1 200")
        until = time.monotonic() + PATIENCE_S
        while (left := sum(_open(connection) for connection in slow)) and time.monotonic() < until:
            time.sleep(0.2)
        assert left == 0
    finally:
        for connection in slow:
            connection.close()
        served.close()


def _open(connection):
    """Whether the server still listens to a connection that sends one byte more."""
    try:
        connection.sendall(b"a")
        connection.setblocking(False)
        return connection.recv(10) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


def test_what_the_server_library_says_is_a_line_of_our_log(capsys, monkeypatch):
    import logging

    from compgen.fleet import logs

    class Busy:
        effective_listen = (("127.0.0.1", 8080),)

        def run(self):
            logging.getLogger("waitress.queue").warning("Task queue depth is %d", 7)

        def close(self):
            pass

    monkeypatch.setattr(server, "make_server", lambda settings: Busy())
    monkeypatch.setattr(server.signal, "signal", lambda number, action: None)
    logs.configure("json")
    server.run(SimpleNamespace(decide=False))
    serving, line, stopped = map(json.loads, capsys.readouterr().err.splitlines())
    assert (serving["event"], stopped["event"]) == ("serving", "stopped serving")
    assert (line["event"], line["problem"], line["level"]) == ("server", "Task queue depth is 7", "warning")
