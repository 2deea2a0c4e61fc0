"""The notification command: what it gets, and that no command, however bad, keeps the recalibration."""

import json
import os
import sys
import time
from datetime import UTC, datetime, timedelta

import pytest

from compgen.fleet import claims, decisions
from compgen.fleet import claims as results
from compgen.fleet import publish as notify
from compgen.fleet.records import NewMeasurement, NewResult, StoredTableFile
from compgen.fleet.store import open_store

#: A bad command may take this long, s, with the limit set to LIMIT_S.
AT_MOST_S, LIMIT_S = 15.0, 0.5
EVIL = 'a\n"quoted" $(touch /tmp/x) \u20ac \\ ; rm -rf /'


@pytest.fixture
def store(tmp_path):
    opened = open_store(f"sqlite:///{tmp_path}/recal.sqlite")
    yield opened
    opened.close()


@pytest.fixture
def machine(store):
    """A machine with one set of tables that waits for approval, held back for an evil reason."""
    made = store.add_machine("mill")
    at = datetime.now(UTC) - timedelta(hours=1)
    measurement = store.add_measurement(made, NewMeasurement("0" * 64, "m", at, "file", {"a.csv": b"1"}))
    new = NewResult(
        machine_text=b"toml",
        errors_text=b"error,position_mm,value\nEC0Y,,12.0\n",
        covariance=None,
        fitted_text=None,
        summary={},
        program="1",
        active_table_id=None,
        files=(StoredTableFile("isg-csv", "t.csv", b"table"),),
        accepted=True,
        hold=[EVIL],
        judgement={},
        approve=False,
        settings_sha256="0" * 64,
        seconds=1.0,
    )
    results.keep_result(store, made, claims.take(store, measurement, claims.owner_name()), new, None)
    return made


def python(code):
    return [sys.executable, "-c", code]


def told(store, machine):
    return [event.subject for event in store.events(machine) if event.kind == notify.NOTIFIED]


def test_the_message_is_one_json_object_with_the_keys_that_the_page_names(store, machine, tmp_path):
    decisions.approve(store, machine, 1, "ada", EVIL, override=True)
    assert notify.notify(store, machine, ["tee", "-a", str(tmp_path / "told")]) == []
    lines = (tmp_path / "told").read_text(encoding="utf-8").splitlines()
    messages = [json.loads(line) for line in lines]
    assert [message["event"] for message in messages] == ["hold", "approve"]
    for message in messages:
        assert list(message) == ["machine", "event", "version", "state", "actor", "reason", "at"]
        assert (message["machine"], message["version"], message["state"]) == ("mill", 1, "active")
        assert message["reason"] == EVIL
        assert datetime.fromisoformat(message["at"]).tzinfo is not None
    assert [message["actor"] for message in messages] == ["automatic", "ada"]
    assert notify.notify(store, machine, ["tee", "-a", str(tmp_path / "told")]) == []
    assert (tmp_path / "told").read_text(encoding="utf-8").splitlines() == lines


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        (["false"], "ended with 1"),
        (["no-such-program-here"], "No such file"),
        (python("import sys; sys.exit('the server said no')"), "ended with 1: the server said no"),
        (python("import os; os.kill(os.getpid(), 9)"), "ended with -9"),
    ],
)
def test_a_command_that_fails_is_told_and_tried_again_by_the_next_pass(store, machine, tmp_path, command, problem):
    assert problem in notify.notify(store, machine, command)[0]
    assert told(store, machine) == []
    assert notify.notify(store, machine, ["tee", str(tmp_path / "told")]) == []
    assert told(store, machine) == ["decision 1"]


BAD = {
    "hangs": "import time; time.sleep(600)",
    "does not let go": "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)",
    "prints for ever": "import sys\nwhile True: sys.stderr.write('x' * 65536); sys.stdout.write('y' * 65536)",
}


@pytest.mark.parametrize("code", BAD.values(), ids=BAD.keys())
def test_a_command_that_does_not_end_is_stopped(store, machine, monkeypatch, code):
    monkeypatch.setattr(notify, "TIMEOUT_S", LIMIT_S)
    started = time.monotonic()
    (problem,) = notify.notify(store, machine, python(code))
    assert "did not end within 0.5 s and was stopped" in problem
    assert time.monotonic() - started < AT_MOST_S
    assert told(store, machine) == []


def test_the_children_of_a_command_that_is_stopped_end_with_it(store, machine, monkeypatch, tmp_path):
    monkeypatch.setattr(notify, "TIMEOUT_S", 2.0)
    code = f"sleep 600 & echo $! > {tmp_path}/child; wait"
    started = time.monotonic()
    assert "did not end" in notify.notify(store, machine, ["sh", "-c", code])[0]
    assert time.monotonic() - started < AT_MOST_S
    child = int((tmp_path / "child").read_text())
    until = time.monotonic() + AT_MOST_S
    while _runs(child):
        assert time.monotonic() < until
        time.sleep(0.05)


def _runs(pid):
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as stream:
            return stream.read().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def test_a_child_that_a_command_leaves_running_keeps_nobody_waiting(store, machine, tmp_path):
    """It holds the command's stderr open; the command itself ended well."""
    started = time.monotonic()
    code = f"sleep 600 & echo $! > {tmp_path}/child; exit 0"
    try:
        assert notify.notify(store, machine, ["sh", "-c", code]) == []
        assert time.monotonic() - started < AT_MOST_S
        assert _runs(int((tmp_path / "child").read_text()))
    finally:
        os.kill(int((tmp_path / "child").read_text()), 9)


def test_much_output_is_read_to_its_end_and_only_its_beginning_is_kept(store, machine, tmp_path):
    """50 MB on both streams: a pipe that nobody empties would stop the command."""
    code = "import sys\nfor s in (sys.stdout, sys.stderr):\n for _ in range(800): s.write('x' * 65536)\nsys.exit({})"
    assert notify.notify(store, machine, python(code.format(0))) == []
    decisions.reject(store, machine, 1, "ada", "no")
    (problem,) = notify.notify(store, machine, python(code.format(3)))
    assert problem.startswith(f"{sys.executable} ended with 3: xxx")
    assert len(problem) < 400


def test_a_command_that_does_not_read_its_stdin_is_no_failure(store, machine):
    decisions.reject(store, machine, 1, "ada", "x" * 1_000_000)
    assert notify.notify(store, machine, ["true"]) == []
    assert told(store, machine) == ["decision 1", "decision 2"]
