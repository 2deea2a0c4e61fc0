"""``volcomp serve`` as a program: users, unsafe options, a server that starts and stops; decisions reach the folders."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import urllib.request
from datetime import UTC, datetime
from pathlib import Path

import pytest
from click.testing import CliRunner

pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("waitress", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
pytest.importorskip("argon2", reason="the extra compgen[serve] is not installed: the dashboard is not tested")

import serve_site as helper
from prometheus_client.parser import text_string_to_metric_families

from compgen.cli import cli
from compgen.cli import fleet_commands as serve_commands
from compgen.cli.common import run_command
from compgen.errors import InputError
from compgen.fleet import logs
from compgen.fleet.dashboard.app import make_app
from compgen.fleet.dashboard.metrics import WatchMetrics, start_metrics
from compgen.fleet.dashboard.settings import DashboardSettings, read_token
from compgen.fleet.dashboard.users import Users
from compgen.fleet.runner import MachineOutcome
from compgen.fleet.store import open_store

factory, OWN, PASSWORD = helper.factory, helper.OWN, helper.PASSWORD
JOB = """\
store = "store.sqlite"
[machines.mill-1]
machine = "mill.toml"
inbox = "inbox"
controllers = ["isg-csv"]
out = "tables"
measured_with = "active"
notify = ["sh", "-c", "cat >> told.jsonl"]
"""


def add_user(path, name="meyer", password=PASSWORD):
    command = ["serve", "add-user", name, "--users", str(path), "--password-stdin"]
    return CliRunner().invoke(cli, command, input=f"{password}\n")


def test_users_are_added_listed_and_removed(tmp_path):
    path = tmp_path / "users.json"
    assert "meyer is added" in add_user(path).output
    assert "meyer has a new password" in add_user(path, password="another good password").output
    assert Users(path).verify("meyer", "another good password")
    listed = CliRunner().invoke(cli, ["serve", "users", "--users", str(path), "--json"])
    assert json.loads(listed.output) == {"users": ["meyer"]}
    CliRunner().invoke(cli, ["serve", "remove-user", "meyer", "--users", str(path)])
    assert Users(path).names() == []


def test_a_reader_is_added_and_may_not_decide(tmp_path):
    path = tmp_path / "users.json"
    command = ["serve", "add-user", "guest", "--users", str(path), "--password-stdin", "--reader"]
    assert "guest is added" in CliRunner().invoke(cli, command, input=f"{PASSWORD}\n").output
    assert not Users(path).may_decide("guest")
    assert "guest has a new password" in add_user(path, "guest").output
    assert Users(path).may_decide("guest")


def test_the_password_is_asked_for_twice_and_never_shown(tmp_path):
    path = tmp_path / "users.json"
    answer = CliRunner().invoke(
        cli, ["serve", "add-user", "meyer", "--users", str(path)], input=f"{PASSWORD}\n{PASSWORD}\n"
    )
    assert PASSWORD not in answer.output
    assert Users(path).verify("meyer", PASSWORD)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["serve"], "give --store URL or --job FILE"),
        (["serve", "--store", "x.sqlite", "--decide", "--host", "0.0.0.0"], "unencrypted"),
        (["serve", "--store", "postgresql://h/n", "--decide"], "needs a file of users"),
        (["serve", "--store", "x.sqlite", "--name", "http://a"], "is not a host name"),
        (["serve", "--store", "mysql://h/n"], "is not a store"),
        (["serve", "--job", "no.toml"], "no.toml"),
        (["serve", "--store", "x.sqlite", "--metrics-token-file", "no"], "no: no such file"),
        (["serve", "add-user", "automatic", "--users", "u.json"], "choose another name"),
        (["serve", "remove-user", "nobody", "--users", "u.json"], "has no user"),
        (["serve", "add-user", "meyer"], "give --users FILE"),
    ],
)
def test_what_is_not_safe_or_missing_is_exit_code_2_with_the_reason(tmp_path, monkeypatch, capfd, words, message):
    monkeypatch.chdir(tmp_path)
    assert run_command(cli, words) == 2
    assert message in capfd.readouterr().err
    assert not (tmp_path / "u.json").exists()


def test_the_page_lists_every_option_of_the_command():
    page = (Path(__file__).resolve().parents[2] / "docs" / "serve.md").read_text(encoding="utf-8")
    table = page.partition("| option | meaning |\n")[2].partition("\n\n")[0]
    listed = [
        name for row in table.splitlines() for name in re.findall(r"--[a-z-]+", row.split("|")[1]) if name != "---"
    ]
    of_every_command = ("--plugin", "-q", "-v")
    options = [item.opts[0] for item in serve_commands.serve_command.params if item.opts[0] not in of_every_command]
    assert sorted(listed) == sorted(options)


def test_a_token_that_could_be_guessed_is_refused(tmp_path):
    (tmp_path / "token").write_text("  15 characters!!\n")
    with pytest.raises(InputError, match="at least 16 ASCII characters"):
        read_token(tmp_path / "token")
    (tmp_path / "token").write_text("sixteen letters!\n")
    assert read_token(tmp_path / "token") == "sixteen letters!"


def test_the_server_starts_answers_and_stops_on_sigterm_with_exit_code_0(tmp_path):
    helper.put(tmp_path)
    (tmp_path / "users.json").rename(tmp_path / "store.sqlite.users.json")
    command = [sys.executable, "-m", "compgen", "serve", "--store", "store.sqlite", "--port", "0", "--decide"]
    process = subprocess.Popen([*command, "--log", "json"], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    killer = threading.Timer(120.0, process.kill)
    killer.start()
    try:
        line = json.loads(process.stderr.readline())
        assert line["event"] == "serving"
        assert re.fullmatch(r"http://127\.0\.0\.1:[1-9][0-9]*/", line["address"])
        with urllib.request.urlopen(line["address"], timeout=60) as answer:
            assert answer.headers["X-Frame-Options"] == "DENY"
            assert answer.headers["Server"] is None
            assert "mill-1" in answer.read().decode()
        os.kill(process.pid, signal.SIGTERM)
        rest = process.stderr.read()
        assert process.wait() == 0
    finally:
        killer.cancel()
        process.kill()
        process.stderr.close()
    assert json.loads(rest.splitlines()[-1])["event"] == "stopped serving"


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A dashboard with a job file, a client that is logged in, and its token."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "recal.toml").write_text(JOB)
    helper.put(tmp_path)
    store = open_store(str(tmp_path / "store.sqlite"))
    settings = DashboardSettings(
        str(tmp_path / "store.sqlite"), decide=True, users=tmp_path / "users.json", job=tmp_path / "recal.toml"
    )
    client = make_app(settings, store).test_client()

    def post(path, **fields):
        text = client.get("/" if path != "/login" else path, base_url=OWN).text
        token = re.findall(r'name="csrf" value="([^"]+)"', text)[-1]
        return client.post(path, base_url=OWN, data={**fields, "csrf": token}, headers={"Origin": OWN})

    post("/login", name="meyer", password=PASSWORD)
    yield store, client, post
    store.close()


def test_decisions_reach_the_folder_and_the_notification(site, tmp_path):
    _, _, post = site
    assert post("/machines/1/tables/3/approve", reason="fine", seen="2").status_code == 303
    assert (tmp_path / "tables" / "active" / "table.csv").read_bytes() == b"; table 3\n0 1.0\n100 3.0\n"
    assert post("/machines/1/rollback", reason="worse", seen="3", to="2").status_code == 303
    assert (tmp_path / "tables" / "active" / "table.csv").read_bytes() == b"; table 2\n0 1.0\n100 2.0\n"
    told = [json.loads(line) for line in (tmp_path / "told.jsonl").read_text().splitlines()]
    assert [(item["event"], item["actor"]) for item in told[-2:]] == [("approve", "meyer"), ("rollback", "meyer")]


def test_a_decision_whose_files_cannot_follow_stands_and_says_so(site, tmp_path):
    store, client, post = site
    (tmp_path / "tables").write_text("in the way")
    assert post("/machines/1/tables/3/reject", reason="no", seen="2").status_code == 303
    text = client.get("/machines/1", base_url=OWN).text
    assert "The decision is recorded, but the files could not be updated yet" in text
    assert [table.state for table in store.tables(store.machine("mill-1"))] == ["retired", "active", "rejected"]


def test_a_machine_that_the_job_file_does_not_name_is_not_decided_on(site):
    store, _, post = site
    before = factory.everything(store)
    assert post("/machines/2/tables/2/reject", reason="no", seen="1").status_code == 409
    assert factory.everything(store) == before


def test_watch_metrics_are_served_while_it_runs(tmp_path):
    helper.put(tmp_path)
    store = open_store(str(tmp_path / "store.sqlite"))
    metrics = WatchMetrics(store)
    before = datetime.now(UTC).timestamp()
    metrics.count(MachineOutcome("mill-1", "ok", processed=("a", "b"), seconds=2.0))
    metrics.count(MachineOutcome("mill-1", "failed", seconds=0.2))
    port, stop = start_metrics(metrics.text, 0)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as answer:
            text = answer.read().decode()
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=60)
    finally:
        stop()
        store.close()
    families = text_string_to_metric_families(text)
    found = {(s.name, *sorted(s.labels.values())): s.value for family in families for s in family.samples}
    assert found["compgen_recal_passes_total", "mill-1", "ok"] == 1.0
    assert found["compgen_recal_passes_total", "failed", "mill-1"] == 1.0
    assert found["compgen_recal_measurements_total", "mill-1"] == 2.0
    assert found["compgen_recal_pass_seconds_sum",] == 2.2
    assert found["compgen_recal_last_pass_timestamp_seconds", "mill-1"] >= before
    assert found["compgen_waiting_tables", "mill-1"] == 1.0


def test_the_store_of_the_job_file_may_be_given_by_its_path(tmp_path, monkeypatch):
    (tmp_path / "recal.toml").write_text("[machines]\n")
    monkeypatch.chdir(tmp_path)
    url = f"sqlite:///{tmp_path / 'recal.sqlite'}"
    for given in (None, "recal.sqlite", str(tmp_path / "recal.sqlite"), url):
        assert serve_commands._store_url(given, Path("recal.toml")) == url
    with pytest.raises(
        InputError, match=r"h/n is not the store of recal.toml, which is sqlite:.*recal.sqlite; omit --store"
    ) as found:
        serve_commands._store_url("postgresql://u:secret@h/n", Path("recal.toml"))
    assert "secret" not in str(found.value)


@pytest.mark.parametrize(
    ("url", "mode", "said"),
    [
        ("postgresql://meyer:s3cret@db/fleet", None, "on the command line"),
        ("postgresql+psycopg://meyer:s3cret@db/fleet", 0o644, "chmod 600"),
        ("postgresql://meyer:s3cret@db/fleet", 0o640, "chmod 600"),
        ("postgresql://meyer:s3cret@db/fleet", 0o600, ""),
        ("postgresql://meyer@db/fleet", 0o644, ""),
        ("postgresql://meyer@db/fleet?host=/a:b@c", None, ""),
        ("sqlite:///a:b@c.sqlite", None, ""),
    ],
)
def test_a_password_that_others_can_read_is_warned_of_and_never_shown(tmp_path, capfd, url, mode, said):
    logs.configure("json")
    file = None if mode is None else tmp_path / "recal.toml"
    if file is not None:
        file.write_text(f'store = "{url}"')
        file.chmod(mode)
    serve_commands.warn_of_password(url, file)
    shown = capfd.readouterr().err
    assert said in shown if said else shown == ""
    assert "s3cret" not in shown
