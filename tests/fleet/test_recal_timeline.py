"""What the store does not know: what came after a backup, whose clock went back, readings from before and after a change.

The new tables wait for a person, or for what shows which tables were on. Everything goes through the commands.
"""

import json
import shutil
import sqlite3
from contextlib import closing
from datetime import timedelta

import pytest
from test_recal import NOW, deviations_text
from test_recal_active import drifted, site, site_in, site_with_tables  # noqa: F401  (fixtures)

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.fleet import actions
from compgen.fleet.records import ReprocessRequest
from compgen.fleet.store import open_store
from compgen.fleet.store import restore as copy_back


@pytest.fixture
def running(site_with_tables, tmp_path, small_machine, small_machine_file, small_errors):  # noqa: F811
    """Version 1 has been active for ten days; ``command`` is that of the terminal."""
    shutil.copytree(site_with_tables, tmp_path, symlinks=True, dirs_exist_ok=True)
    made = site_in(tmp_path, small_machine, small_machine_file, small_errors)
    made.now = NOW + timedelta(minutes=10)  # commands see the true time
    made.command = lambda *words: run_command(cli, ["recal", *words, "--job", str(tmp_path / "recal.toml")])
    return made


def lost(site, *, folder=True):  # noqa: F811
    """The store is lost, and with ``folder`` the output folder."""
    for path in site.folder.glob("recal.sqlite*"):
        path.unlink()
    if folder:
        shutil.rmtree(site.out)
    for path in site.inbox.iterdir():
        path.unlink()


def ran(site, state="held"):  # noqa: F811
    """State of one pass, and the reasons of the newest version."""
    outcome = site.run()
    assert outcome.state == state, outcome.messages
    return " | ".join(site.tables()[-1].reasons)


# --- restored histories ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by_command", [True, False])
@pytest.mark.parametrize("urad", [25.0, -60.0])
def test_a_store_restored_to_an_empty_folder_does_not_know_which_tables_are_on(running, small_errors, urad, by_command):
    """Version 2 of the lost history is on; taken for version 1, its effect would be counted as an error."""
    assert running.command("backup", str(running.folder / "old.sqlite")) == 0
    old = running.on()
    running.write(approval="manual")
    running.measure("drift", drifted(small_errors, urad), on=old, seed=2)
    running.run()
    actions.approve(running.job, "mill", 2, "ada", "seen", override=True, clock=lambda: running.now)
    lost_tables = running.on()
    lost(running)
    if by_command:
        assert running.command("restore", str(running.folder / "old.sqlite")) == 0
    else:  # or by the means of the database
        copy_back(running.folder / "old.sqlite", running.job.store)
    running.write(approval="auto", policy="clock_minutes = 0")
    running.now += timedelta(days=3)
    running.measure("third", drifted(small_errors, urad), on=lost_tables, seed=3)
    reasons = ran(running)
    assert "does not know which tables were on" in reasons
    assert ("comes from a backup that ends at" if by_command else "only since") in reasons
    running.now += timedelta(days=1)
    running.measure(
        "told", drifted(small_errors, urad), on=old, seed=4, active_table="v1"
    )  # version 1 was loaded again
    assert "does not know" not in ran(running, state=running.run().state)


def test_what_was_measured_before_the_end_of_the_backup_is_known(running, small_errors):
    running.now -= timedelta(days=4)
    path = running.measure("before", drifted(small_errors, 8.0), on=running.on(), seed=2)
    text = path.read_text()
    path.unlink()
    running.now += timedelta(days=2)
    running.measure("later", drifted(small_errors, 8.0), on=running.on(), seed=3)
    running.run()
    assert running.command("backup", str(running.folder / "old.sqlite")) == 0
    lost(running, folder=False)
    assert running.command("restore", str(running.folder / "old.sqlite")) == 0
    path.write_text(text)
    running.run()
    assert "does not know" not in " | ".join(running.tables()[-1].reasons)
    running.now += timedelta(days=4)
    running.measure("after", drifted(small_errors, 8.0), on=running.on(), seed=4)
    assert "does not know which tables were on" in ran(running)


def test_a_time_between_backup_and_the_next_approval_stays_unknown(running, small_errors):
    assert running.command("backup", str(running.folder / "old.sqlite")) == 0
    on = running.on()
    lost(running)
    assert running.command("restore", str(running.folder / "old.sqlite")) == 0
    between = running.now + timedelta(days=1)
    running.now += timedelta(days=4)
    actions.rollback(running.job, "mill", "ada", "loaded by hand", to=0, clock=lambda: running.now)
    running.now += timedelta(days=2)
    running.measure("late", drifted(small_errors, 8.0), on=on, seed=4, at=between)
    assert "does not know which tables were on" in ran(running)
    running.measure("bare", drifted(small_errors, 8.0), seed=5)  # after the rollback, by the history
    assert "does not know" not in ran(running, state=running.run().state)


def test_a_number_of_the_lost_history_is_not_taken_for_the_version_made_since(running, small_errors):
    """The file names version 2 of the lost history; the restored store made another version 2 meanwhile."""
    assert running.command("backup", str(running.folder / "old.sqlite")) == 0
    on = running.on()
    lost(running)
    assert running.command("restore", str(running.folder / "old.sqlite")) == 0
    measured = running.now - timedelta(hours=2)
    running.now += timedelta(days=1)
    running.write(approval="manual")
    running.measure("new", drifted(small_errors, 8.0), on=on, seed=3, active_table="v1")
    running.run()
    assert running.tables()[-1].version == 2
    running.now += timedelta(days=1)
    running.measure("lost", drifted(small_errors, 8.0), on=on, seed=4, at=measured, active_table="v2")
    assert "it states that version 2 was on, but this store made it on" in ran(running)


def test_a_restore_is_part_of_the_history_of_every_machine(running, capsys):
    assert running.command("backup", str(running.folder / "old.sqlite")) == 0
    lost(running)
    assert running.command("restore", str(running.folder / "old.sqlite")) == 0
    capsys.readouterr()
    assert running.command("history", "mill", "--json") == 0
    entries = json.loads(capsys.readouterr().out)["entries"]
    assert "the history comes from the backup old.sqlite" in entries[-1]["text"]


def test_an_emptied_folder_is_said_once_and_filled(running, capsys):
    shutil.rmtree(running.out)
    assert "the folder was empty at" in " ".join(running.run().messages)
    assert (running.out / "active" / "NC_CEC.INI").is_file()
    assert running.run().messages == ()


def test_a_new_machine_begins_with_a_ledger_and_without_a_word(site):  # noqa: F811
    outcome = site.run()
    assert (outcome.state, outcome.messages) == ("ok", ())
    assert (site.out / ".store.json").is_file()


# --- clocks ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["approve", "rollback", "reject"])
def test_a_decision_after_the_clock_went_back_says_that_its_time_is_not_true(running, small_errors, capsys, kind):
    """The store has a decision of tomorrow; the clock of this computer is right."""
    running.write(approval="manual")
    running.measure("drift", drifted(small_errors, 12.0), on=running.on(), seed=2, active_table="v1")
    running.run()
    with closing(sqlite3.connect(running.folder / "recal.sqlite")) as connection:
        machine, last = connection.execute("SELECT machine_id, max(sequence) FROM decisions").fetchone()
        row = (machine, last + 1, None, "supersede", "automatic", "", "2099-01-01 00:00:00.000000")
        connection.execute(
            "INSERT INTO decisions (machine_id, sequence, table_id, kind, actor, reason, at) VALUES (?, ?, ?, ?, ?, ?, ?)",
            row,
        )
        connection.commit()
    words = {"approve": ["2", "--override"], "rollback": [], "reject": ["2"]}[kind]
    capsys.readouterr()
    assert running.command(kind, "mill", *words, "--actor", "ada", "--reason", "a test", "--json") == 0
    out, err = capsys.readouterr()
    assert "the clock went back: it is" in err and "2099-01-01T00:00:00+00:00" in err
    assert "recorded with that time" in json.loads(out)["warnings"][0]
    store = open_store(running.job.store)
    event = [item for item in store.events() if item.kind == "clock"][-1]
    store.close()
    assert "a decision got the time of the one before, 2099-01-01T00:00:00+00:00" in event.message


def test_a_decision_at_the_right_time_says_nothing_of_clocks(running, capsys):
    assert running.command("rollback", "mill", "--actor", "ada", "--reason", "a test", "--json") == 0
    out, err = capsys.readouterr()
    assert "clock" not in err and "warnings" not in json.loads(out)


def test_tables_measured_after_a_clamped_approval_wait(running, small_errors):
    """The clock was a day ahead when version 1 was approved again, then right: the times do not tell what was on when."""
    running.write(approval="manual", policy="clock_minutes = 0")
    true = running.now
    actions.rollback(running.job, "mill", "ada", "a test", to=0, clock=lambda: true + timedelta(days=1))
    actions.rollback(running.job, "mill", "ada", "again", to=1, clock=lambda: true)
    running.now = true + timedelta(days=2)
    running.measure("check", drifted(small_errors, 8.0), on=running.on(), seed=2, at=true + timedelta(hours=12))
    assert "the clock went back, so the time of the decision" in ran(running)


# --- readings of before and after ------------------------------------------------------------------------------------


def lasting(path, hours, begin_s=0.0):
    """Add a column ``time_s`` to a measurement: its readings took so many hours."""
    lines = path.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    rows = len(lines) - first - 1
    times = [begin_s + 3600.0 * hours * k / (rows - 1) for k in range(rows)]
    lines[first] += ",time_s"
    lines[first + 1 :] = [f"{line},{time:.1f}" for line, time in zip(lines[first + 1 :], times, strict=True)]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("hours", "before", "begin_s"), [(3.0, 1.5, 0.0), (5.0, 4.0, 1.7e9), (2.5, -1.5, 86400.0)])
def test_readings_from_before_and_after_an_approval_wait(running, small_errors, hours, before, begin_s):
    """``before``: hours from the time that the file states, its first or its last reading, to the decision."""
    on = running.on()
    at = running.now
    running.now = at + timedelta(hours=before)
    actions.rollback(running.job, "mill", "ada", "a test", to=0, clock=lambda: running.now)
    running.now = at + timedelta(days=1)
    lasting(running.measure("long", drifted(small_errors, 8.0), on=on, seed=2, at=at), hours, begin_s)
    assert "readings may have been taken from" in ran(running)


def test_readings_that_ended_long_before_a_decision_do_not_wait(running, small_errors):
    at = running.now
    running.now = at + timedelta(hours=4)
    actions.rollback(running.job, "mill", "ada", "a test", to=0, clock=lambda: running.now)
    running.now = at + timedelta(days=1)
    lasting(running.measure("short", drifted(small_errors, 8.0), seed=2, at=at + timedelta(hours=12)), 3.0)
    assert "readings may have been taken from" not in ran(running, state=running.run().state)


def test_one_statement_is_not_true_of_readings_with_two_sets_of_tables(running, small_errors):
    on, at = running.on(), running.now
    running.now = at + timedelta(hours=1)
    actions.rollback(running.job, "mill", "ada", "a test", to=0, clock=lambda: running.now)
    running.now = at + timedelta(days=1)
    path = running.measure("long", drifted(small_errors, 8.0), on=on, seed=2, at=at, active_table="v1")
    lasting(path, 2.0)
    assert "it states one set of tables, but readings may have been taken from" in ran(running)
    wish = ReprocessRequest(None, "ada", "the control was loaded in the evening only", "v1")
    done = actions.reprocess(running.job, "mill", wish, clock=lambda: running.now)
    assert "it states one set" not in " ".join(done.table.reasons)


def test_the_files_of_one_measurement_may_have_been_taken_at_different_times(running, small_errors, small_machine):
    """Two files of a sub-folder, before and after the decision."""
    on, at = running.on(), running.now
    (running.inbox / "both").mkdir()
    for name, hours, seed in (("a", 0.0, 2), ("b", 5.0, 3)):
        said = (at + timedelta(hours=hours)).isoformat()
        text = deviations_text(small_machine, drifted(small_errors, 8.0), seed=seed, correction=on, measured_at=said)
        (running.inbox / "both" / f"{name}.deviations.csv").write_text(text)
    running.now = at + timedelta(hours=3)
    actions.rollback(running.job, "mill", "ada", "a test", to=0, clock=lambda: running.now)
    running.now = at + timedelta(days=1)
    assert "readings may have been taken from" in ran(running)
