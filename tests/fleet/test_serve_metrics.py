"""The metrics of ``serve`` and ``watch``: names, labels and units as Prometheus wants them, and series that stay few."""

import re
import socket
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("argon2", reason="the extra compgen[serve] is not installed: the dashboard is not tested")

import serve_site as helper
from prometheus_client.parser import text_string_to_metric_families

from compgen.fleet.dashboard.metrics import WatchMetrics, start_metrics
from compgen.fleet.runner import MachineOutcome

DOCS = Path(__file__).resolve().parents[2] / "docs" / "serve.md"
NAME = re.compile(r"compgen_[a-z]+(_[a-z]+)*")
#: Units of the conventions that our names may end with, and words that say that it is a count or a state.
UNITS = ("seconds", "timestamp_seconds", "up", "machines", "tables", "version", "failed", "sessions")
HOSTILE = 'a"b\\c\nd{e="f"} 7 \u20ac'


@pytest.fixture
def site(tmp_path):
    made = helper.Site(tmp_path)
    yield made
    made.store.close()


@pytest.fixture
def watched(site):
    """Metrics of a long-running recalibration with a hostile name of a machine."""
    metrics = WatchMetrics(site.store)
    metrics.count(MachineOutcome("mill-1", "ok", processed=("a",), seconds=2.0))
    metrics.count(MachineOutcome(HOSTILE, "failed", seconds=0.5))
    return metrics


def families(text):
    return list(text_string_to_metric_families(text))


def series(text):
    return {(sample.name, *sorted(sample.labels.items())) for family in families(text) for sample in family.samples}


def test_names_types_and_help_are_as_the_conventions_want(site, watched):
    site.login(password="wrong password")
    site.login()
    site.post("/logout", {"csrf": site.token()})
    for text in (site.get("/metrics").text, watched.text().decode()):
        assert text.endswith("\n")
        found = families(text)
        names = [family.name for family in found]
        assert len(names) == len(set(names))
        for family in found:
            name = family.name.removesuffix("_created")
            assert NAME.fullmatch(name), name
            assert family.documentation.endswith((".", "s.")), name
            assert family.type in ("counter", "gauge", "histogram")
            if family.type == "counter":
                assert all(s.name.endswith(("_total", "_created")) for s in family.samples)
            elif not family.name.endswith("_created"):
                assert name.endswith(UNITS), name
            assert all(re.fullmatch(r"[a-z]+", label) or label == "le" for s in family.samples for label in s.labels)
        counted = [sample for family in found for sample in family.samples]
        assert len(counted) == len({(s.name, *sorted(s.labels.items())) for s in counted})


def test_every_metric_stands_in_the_documentation(site, watched):
    site.login()
    documented = set(re.findall(r"`(compgen_[a-z_]+)`", DOCS.read_text(encoding="utf-8")))
    for text in (site.get("/metrics").text, watched.text().decode()):
        for family in families(text):
            if not family.name.endswith("_created"):
                name = f"{family.name}_total" if family.type == "counter" else family.name
                assert name in documented, name


def test_names_of_machines_are_escaped_and_read_back_as_they_were(site, watched):
    site.store.add_machine(HOSTILE)
    for text, metric in (
        (watched.text().decode(), "compgen_recal_passes_total"),
        (site.get("/metrics").text, "compgen_active_version"),
    ):
        assert HOSTILE in {s.labels.get("machine") for f in families(text) for s in f.samples if s.name == metric}


def test_what_strangers_send_makes_no_series(site):
    """Addresses, methods, host names, user names, words: none of them becomes a label."""

    def strange(k):
        site.get(f"/nowhere-{k}")
        site.get(f"/machines/{k}?q=word-{k}&status=state-{k}")
        site.get(f"/machines/1/recheck?error=E{k}&change={k}")
        site.client.open("/", method=f"METHOD{k}", base_url=helper.OWN)
        site.client.get("/", headers={"Host": f"host-{k}.example"})
        site.post("/login", {"name": f"user-{k}", "password": "x", "csrf": "x"}, headers={})
        site.post(f"/machines/{k}/rollback", {"to": str(k)})

    for k in range(5):
        strange(k)
    site.get("/metrics")
    before = series(site.get("/metrics").text)
    for k in range(5, 40):
        strange(k)
    assert series(site.get("/metrics").text) - before == set()


# --- the port of ``watch`` ---------------------------------------------------------------------------------------------


@pytest.fixture
def port(watched):
    number, stop = start_metrics(watched.text, 0)
    yield number
    stop()


def fetched(port, path="/metrics", method="GET", host=None):
    headers = {} if host is None else {"Host": host}
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", method=method, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return answer.status, answer.read(), answer.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers


def test_the_port_shows_metrics_to_this_computer_and_nothing_else(port):
    status, body, headers = fetched(port)
    assert (status, headers["Content-Type"]) == (200, "text/plain; version=0.0.4; charset=utf-8")
    assert b"compgen_recal_passes_total" in body
    assert fetched(port, method="HEAD")[:2] == (200, b"")
    assert fetched(port, "/")[0] == fetched(port, "/metrics/../etc/passwd")[0] == 404
    assert fetched(port, method="POST")[0] == fetched(port, method="DELETE")[0] == 404
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", ""):
        assert fetched(port, host=host)[0] == 421
    assert fetched(port, host=f"localhost:{port}")[0] == 200


def test_a_client_that_sends_nothing_keeps_no_other_waiting(port):
    slow = [socket.create_connection(("127.0.0.1", port), timeout=30) for _ in range(10)]
    try:
        for connection in slow:
            connection.sendall(b"GET /metr")
        started = time.monotonic()
        assert fetched(port)[0] == 200
        assert time.monotonic() - started < 5.0
    finally:
        for connection in slow:
            connection.close()


def test_a_fault_while_metrics_are_read_is_logged_and_shows_no_inside(capsys):
    from compgen.fleet import logs

    logs.configure("json")

    def broken():
        raise RuntimeError("inside /secret/path")

    port, stop = start_metrics(broken, 0)
    try:
        status, body, _ = fetched(port)
    finally:
        stop()
    assert (status, body) == (500, b"the log says more\n")
    assert '"event": "metrics"' in capsys.readouterr().err
