"""The store: append-only, upgraded, leases, states, backup; the change test against brute force."""

import json
import shutil
import sqlite3
import subprocess
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from compgen.data.error_table import Curve
from compgen.data.files import sha256_of
from compgen.data.names import ERROR_INDEX
from compgen.errors import InputError
from compgen.fleet import change, claims, database, decisions
from compgen.fleet import claims as results
from compgen.fleet import decisions as exclude
from compgen.fleet import publish as notify
from compgen.fleet import status as overview
from compgen.fleet.dashboard import charts as serve_history
from compgen.fleet.database import StoreError
from compgen.fleet.records import NewMeasurement, NewResult, StoredTableFile
from compgen.fleet.store import Store, backup, open_store, restore
from compgen.identification.covariance import covariance_or_independent
from compgen.kinematics.gauge import gauge_directions

DAY = datetime(2026, 3, 1, 12, tzinfo=UTC)
#: A store whose schema four migrations made, before they became one.
EXISTING_STORE = (
    next(p for p in Path(__file__).resolve().parents if (p / "golden").is_dir()) / "golden/fleet/store-0004.sql"
)
ERRORS = b"error,position_mm,value\nEC0Y,,12.0\n"


@pytest.fixture
def store(tmp_path):
    return open_store(f"sqlite:///{tmp_path}/recal.sqlite")


def measured(store, machine, number):
    day = DAY + timedelta(days=number)
    new = NewMeasurement(f"{number:064x}", f"m{number}", day, "file", {"a.csv": b"content %d" % number})
    return store.add_measurement(machine, new)


def result(number, *, accepted=True, hold=(), approve=False):
    files = (StoredTableFile("isg-csv", "t.csv", b"table %d" % number), StoredTableFile("isg-csv", "sub/n.md", b"same"))
    return NewResult(
        machine_text=b"toml",
        errors_text=ERRORS,
        covariance=None,
        fitted_text=None,
        summary={"rms": float("nan")},
        program="1",
        active_table_id=None,
        files=files,
        accepted=accepted,
        hold=hold,
        judgement={},
        approve=approve,
        settings_sha256="0" * 64,
        seconds=1.0,
    )


def processed(store, machine, number, **options):
    claim = claims.take(store, measured(store, machine, number), claims.owner_name())
    active = decisions.active_table(store, machine)
    return results.keep_result(store, machine, claim, result(number, **options), active.id if active else None)


def states(store, machine):
    return [table.state for table in store.tables(machine)]


def test_what_goes_in_comes_out(store):
    machine = store.add_machine("mill")
    table = processed(store, machine, 1)
    (identification,) = store.identifications(machine)
    assert store.errors_of(identification).squareness["EC0Y"][0] == pytest.approx(12e-6)
    assert store.covariance_of(identification) is None
    assert identification.measured_at == DAY + timedelta(days=1)
    assert identification.summary == {"rms": None}
    assert [(file.name, file.content) for file in store.table_files(table)] == [
        ("t.csv", b"table 1"),
        ("sub/n.md", b"same"),
    ]
    assert store.contents_of(store.measurements()[0]) == {"a.csv": b"content 1"}
    assert store.measurements()[0].received_at.tzinfo is UTC


@pytest.mark.parametrize("table", [table.name for table in database.ALL])
@pytest.mark.parametrize("action", ["UPDATE {} SET {} = NULL", "DELETE FROM {}"])
def test_the_database_refuses_to_change_or_remove_a_row(store, table, action):
    machine = store.add_machine("mill")
    processed(store, machine, 1)
    store.add_event("clock", "clock", "text", machine)
    connection = sqlite3.connect(store.engine.url.database)
    columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
    with pytest.raises(sqlite3.IntegrityError, match="new rows only"):
        connection.execute(action.format(table, columns[-1]))
    connection.close()


def test_the_migrations_lead_to_the_schema_of_the_program(store):
    with store.engine.connect() as connection:
        found = compare_metadata(MigrationContext.configure(connection), database.metadata)
    assert found == []
    assert tuple(database.metadata.tables.values()) == database.ALL


def test_a_new_store_and_one_that_four_migrations_made_have_the_same_schema(store, tmp_path):
    old = tmp_path / "old.sqlite"
    with closing(sqlite3.connect(old)) as connection:
        connection.executescript(EXISTING_STORE.read_text(encoding="utf-8"))

    def schema(path):
        """Lines of the statements by name, without their order and spaces."""
        with closing(sqlite3.connect(path)) as connection:
            rows = connection.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
        return {name: sorted(" ".join(line.split()).rstrip(", )") for line in sql.splitlines()) for name, sql in rows}

    assert schema(store.engine.url.database) == schema(old)
    before = schema(old)
    reopened = open_store(str(old))
    assert [machine.name for machine in reopened.machines()] == ["old"]
    with pytest.raises(sa.exc.IntegrityError, match="new rows only"):
        reopened.write(lambda connection: connection.execute(sa.text("DELETE FROM machines")))
    assert schema(old) == before


def test_a_store_of_an_unreleased_program_is_refused(store):
    with store.engine.begin() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '0002'"))
    with pytest.raises(InputError, match="0002.*unreleased"):
        open_store(store.url)


def test_a_store_of_a_newer_program_is_refused(store):
    with store.engine.begin() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(InputError, match="newer compgen"):
        open_store(store.url)


@pytest.mark.parametrize("url", ["mysql://host/name", "sqlite://", "nonsense://x/y"])
def test_other_databases_are_refused(url):
    with pytest.raises(InputError, match="store"):
        open_store(url)


def test_a_store_that_cannot_be_reached_is_tried_again_and_reported_without_its_password(monkeypatch):
    waits = []
    monkeypatch.setattr(database.retried, "__defaults__", (waits.append,))
    with pytest.raises(StoreError, match="cannot be used") as caught:
        open_store("postgresql://user:secret@127.0.0.1:1/name")
    assert waits == list(database.WAITS_S)
    assert "secret" not in str(caught.value)


def test_a_file_that_is_no_store_is_reported(tmp_path):
    (tmp_path / "x.sqlite").write_text("not a database, but long enough to be looked at " * 10)
    with pytest.raises(StoreError, match="not a database"):
        open_store(str(tmp_path / "x.sqlite"))


def test_damaged_contents_are_noticed(store):
    machine = store.add_machine("mill")
    table = processed(store, machine, 1)
    digest = store.read(lambda c: c.execute(sa.select(database.table_files.c.sha256)).scalar())
    store.write(lambda c: c.execute(sa.text("DROP TRIGGER append_only_blobs_update")))
    store.write(lambda c: c.execute(sa.text(f"UPDATE blobs SET deflated = x'00' WHERE sha256 = '{digest}'")))
    with pytest.raises(StoreError, match="damaged"):
        store.table_files(table)


# --- states --------------------------------------------------------------------------------------------------------


def test_each_decision_leads_to_its_state(store):
    m = store.add_machine("mill")
    processed(store, m, 1, approve=True)
    processed(store, m, 2)
    processed(store, m, 3, hold=["too hot"])
    processed(store, m, 4, accepted=False, hold=["grows"], approve=True)
    assert states(store, m) == ["active", "pending", "held", "refused"]
    decisions.approve(store, m, 2, "ada")
    assert states(store, m) == ["retired", "active", "held", "refused"]
    decisions.reject(store, m, 3, "ada", "sun on the table")
    decisions.reject(store, m, 4, "ada", "seen")
    assert states(store, m) == ["retired", "active", "rejected", "rejected"]
    for version in (1, 2, 3, 4):
        with pytest.raises(decisions.DecisionError, match="only pending or held"):
            decisions.approve(store, m, version, "ada", "again", override=True)


def test_rollbacks_go_back_one_by_one(store):
    m = store.add_machine("mill")
    for number in (1, 2, 3):
        processed(store, m, number, approve=True)
    found = []
    for _ in range(3):
        decisions.rollback(store, m, "ada", "bad parts")
        active = decisions.active_table(store, m)
        found.append(active.version if active else None)
    assert found == [2, 1, None]
    with pytest.raises(decisions.DecisionError, match="nothing to undo"):
        decisions.rollback(store, m, "ada", "bad parts")
    decisions.rollback(store, m, "ada", "it was the fixture", to=3)
    processed(store, m, 4, approve=True)
    decisions.rollback(store, m, "ada", "bad parts")
    assert decisions.active_table(store, m).version == 3


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (lambda s, m: decisions.reject(s, m, 1, "ada", " "), "rejecting tables needs a reason"),
        (lambda s, m: decisions.rollback(s, m, "ada", ""), "a rollback needs a reason"),
        (lambda s, m: decisions.approve(s, m, 1, " "), "name of the person"),
        (lambda s, m: decisions.approve(s, m, 7, "ada"), "no tables of version 7; it has 1 to 1"),
        (lambda s, m: decisions.rollback(s, m, "ada", "why", to=1), "only a version that was active"),
    ],
)
def test_a_decision_that_is_not_allowed_changes_nothing(store, action, said):
    m = store.add_machine("mill")
    processed(store, m, 1)
    before = store.decisions()
    with pytest.raises(decisions.DecisionError, match=said):
        action(store, m)
    assert store.decisions() == before


# --- leases --------------------------------------------------------------------------------------------------------


def test_of_many_runners_one_gets_the_measurement(store):
    machine = store.add_machine("mill")
    measurement = measured(store, machine, 1)
    with ThreadPoolExecutor(8) as pool:
        claimed = list(pool.map(lambda k: claims.take(open_store(store.url), measurement, f"host{k}/s/1/2"), range(8)))
    assert sum(claim is not None for claim in claimed) == 1


def test_a_lease_of_another_host_ends_with_its_time_and_the_late_one_keeps_nothing(tmp_path):
    now = [DAY]
    store = open_store(f"{tmp_path}/recal.sqlite", clock=lambda: now[0])
    machine = store.add_machine("mill")
    measurement = measured(store, machine, 1)
    slow = claims.take(store, measurement, "elsewhere/s/1/2", lease_s=60)
    now[0] += timedelta(seconds=59)
    assert claims.take(store, measurement, claims.owner_name()) is None
    now[0] += timedelta(seconds=2)
    other = claims.take(store, measurement, claims.owner_name())
    with pytest.raises(claims.ClaimLostError):
        results.keep_result(store, machine, slow, result(1), None)
    with pytest.raises(claims.ClaimLostError):
        claims.renew(store, slow)
    assert store.identifications() == []
    results.keep_result(store, machine, claims.renew(store, other), result(1), None)
    assert claims.take(store, measurement, "elsewhere/s/1/2") is None  # done
    assert len(store.identifications()) == 1


def test_a_lease_of_a_process_of_this_host_that_died_is_free_at_once(store):
    machine = store.add_machine("mill")
    measurement = measured(store, machine, 1)
    code = (
        "import sys, os, signal; from compgen.fleet import claims; from compgen.fleet.store import open_store\n"
        "s = open_store(sys.argv[1]); c = claims.take(s, s.measurements()[0], claims.owner_name())\n"
        "print(c is not None, flush=True); sys.stdin.read(1) or os.kill(os.getpid(), signal.SIGKILL)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, store.url], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as runner:
        assert runner.stdout.readline().strip() == "True"
        assert claims.take(store, measurement, claims.owner_name()) is None
        runner.stdin.close()
        runner.wait()
    assert runner.returncode == -9
    assert claims.take(store, measurement, claims.owner_name()) is not None


def test_a_result_is_kept_whole_or_not_at_all(store, monkeypatch):
    machine = store.add_machine("mill")
    claim = claims.take(store, measured(store, machine, 1), claims.owner_name())
    monkeypatch.setattr(results, "_add_attempt", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        results.keep_result(store, machine, claim, result(1), None)
    assert store.identifications() == [] == store.tables() == store.decisions()
    monkeypatch.undo()
    assert results.keep_result(store, machine, claim, result(1), None).state == "pending"


# --- backup --------------------------------------------------------------------------------------------------------


def everything(store):
    with store.engine.connect() as connection:
        return {table.name: sorted(connection.execute(sa.select(table)).all(), key=repr) for table in database.ALL}


def test_a_backup_restores_every_row_and_the_store_goes_on(store, tmp_path):
    machine = store.add_machine("mill")
    for number in range(1, 6):
        processed(store, machine, number, approve=True)
    counts = backup(store.url, tmp_path / "b" / "copy.sqlite")
    assert [path.name for path in (tmp_path / "b").iterdir()] == ["copy.sqlite"]
    assert counts["tables"] == 5
    with pytest.raises(InputError, match="never overwrites another one"):
        backup(store.url, tmp_path / "b" / "copy.sqlite")
    url = f"sqlite:///{tmp_path}/new.sqlite"
    assert restore(tmp_path / "b" / "copy.sqlite", url) == counts
    again = open_store(url)
    assert everything(again) == everything(store)
    assert processed(again, again.machine("mill"), 6).version == 6
    with pytest.raises(InputError, match="is not empty; restore into a new one"):
        restore(tmp_path / "b" / "copy.sqlite", url)


def test_what_is_no_backup_is_refused(tmp_path):
    (tmp_path / "x").write_text("no")
    for path, said in ((tmp_path / "x", "is not a backup"), (tmp_path / "y", "no such backup")):
        with pytest.raises(InputError, match=said):
            restore(path, f"sqlite:///{tmp_path}/new.sqlite")


# --- the change against its uncertainty ----------------------------------------------------------------------------


def test_a_change_of_the_gauge_is_no_change_and_a_shear_is(small_machine, small_errors):
    known = covariance_or_independent(small_errors, None)
    direction = gauge_directions(small_machine, small_errors.names)[3] * 1e-2
    curves = {}
    for name, curve in small_errors.curves.items():
        constant, slope = direction[ERROR_INDEX[name]]
        curves[name] = Curve(curve.position_mm, curve.value + constant + slope * curve.position_mm, curve.u)
    squareness = {name: (v + direction[ERROR_INDEX[name]][0], u) for name, (v, u) in small_errors.squareness.items()}
    same = small_errors.replace(curves=curves, squareness=squareness)
    moved = max(float(np.max(np.abs(curves[name].value - small_errors.curves[name].value))) for name in curves)
    assert moved > 1e-6
    found = change.change_between(small_machine, (same, known), (small_errors, known), 0.95)
    assert found.max_um < 1e-6
    assert not found.significant
    value, u = small_errors.squareness["EB0Z"]
    sheared = small_errors.replace(squareness={**small_errors.squareness, "EB0Z": (value + 50e-6, u)})
    found = change.change_between(small_machine, (sheared, known), (small_errors, known), 0.95)
    # X moves by 50 urad z; the rotation w that takes out most has (50 - w) z^2 against w x^2, summed over the box
    w = 50e-3 * 240.0**2 / (240.0**2 + 500.0**2)
    assert found.max_um == pytest.approx(np.hypot((50e-3 - w) * 120.0, w * 250.0), rel=1e-6)
    assert found.significant


def test_records_hold_numbers_that_json_can_hold():
    assert json.loads(json.dumps(results.clean({"a": [float("inf"), 1.5], "b": (np.float64(2.0),)}))) == {
        "a": [None, 1.5],
        "b": [2.0],
    }


# --- reads that belong together, a file that is moved, damaged contents -----------------------------------------------


def damage(store, content):
    """Overwrite kept contents with others, as a failing disk does, past the triggers."""
    digest = sha256_of(content)
    with store.engine.begin() as connection:
        connection.exec_driver_sql("DROP TRIGGER append_only_blobs_update")
        kept = zlib.compress(b"something else")
        connection.execute(sa.update(database.blobs).where(database.blobs.c.sha256 == digest).values(deflated=kept))


@pytest.mark.parametrize("read", ["history", "status", "news", "page", "excluded"])
def test_a_result_that_comes_between_two_reads_is_in_both_or_in_none(store, monkeypatch, read):
    machine = store.add_machine("mill")
    processed(store, machine, 1)
    other = open_store(store.url)
    real, numbers = Store._rows, iter(range(2, 1000))

    def rows(self, query, *given, **values):
        """Every read is followed by a new result with its decisions of somebody else."""
        found = real(self, query, *given, **values)
        if self is store:
            processed(other, machine, next(numbers), approve=True)
        return found

    monkeypatch.setattr(Store, "_rows", rows)
    job = SimpleNamespace(machines={"mill": SimpleNamespace(name="mill", schedule=None)})
    if read == "history":
        entries = overview.history(store, machine)
        assert {entry.version for entry in entries} == {None, 1}
    elif read == "status":
        (found,) = overview.status(store, job)
        assert (found.measurements, found.waiting, found.active) == (1, (1,), None)
    elif read == "news":
        assert [message["version"] for _, message in notify.untold(store, machine)] == [1]
    elif read == "page":
        found = serve_history.history(store, serve_history.ErrorCache(store), machine)
        assert [table.version for table in found.tables] == [1]
        assert len(found.measurements) == len(found.decisions) == 1
        assert found.measurements[0].files
    else:
        assert exclude.excluded(store, machine) == {}
    other.close()


def test_a_store_file_that_is_moved_or_replaced_is_noticed_and_no_decision_is_lost(store, tmp_path):
    machine = store.add_machine("mill")
    processed(store, machine, 1)
    path = tmp_path / "recal.sqlite"
    path.rename(tmp_path / "away.sqlite")
    for action in (
        lambda: decisions.approve(store, machine, 1, "ada"),
        store.machines,
        store.version,
        lambda: overview.history(store),
    ):
        with pytest.raises(StoreError, match="was moved, removed or replaced"):
            action()
    assert not path.exists()
    path.write_bytes((tmp_path / "away.sqlite").read_bytes())
    with pytest.raises(StoreError, match="was moved, removed or replaced"):
        decisions.approve(store, machine, 1, "ada")
    path.unlink()
    (tmp_path / "away.sqlite").rename(path)
    assert decisions.approve(store, machine, 1, "ada").kind == "approve"
    assert [item.kind for item in store.decisions(machine)] == ["propose", "approve"]


def test_a_file_that_is_moved_while_it_is_written_to_takes_nothing_along(store, tmp_path):
    machine = store.add_machine("mill")
    processed(store, machine, 1)

    def move(connection):
        decisions.add_decision(store, connection, machine, "reject", 1, "ada", "late")
        (tmp_path / "recal.sqlite").rename(tmp_path / "away.sqlite")

    with pytest.raises(StoreError, match="nothing was written"):
        store.write(move)
    (tmp_path / "away.sqlite").rename(tmp_path / "recal.sqlite")
    assert [item.kind for item in store.decisions(machine)] == ["propose"]


def test_a_backup_of_damaged_contents_is_refused_and_no_file_is_left(store, tmp_path):
    machine = store.add_machine("mill")
    processed(store, machine, 1)
    backup(store.url, tmp_path / "good.sqlite")
    damage(store, b"table 1")
    with pytest.raises(StoreError, match="missing or damaged"):
        backup(store.url, tmp_path / "copy.sqlite")
    assert sorted(path.name for path in tmp_path.iterdir() if "copy" in path.name) == []
    damaged = open_store(f"sqlite:///{tmp_path}/good.sqlite")
    damage(damaged, b"table 1")
    damaged.close()
    with pytest.raises(StoreError, match="missing or damaged"):
        restore(tmp_path / "good.sqlite", f"sqlite:///{tmp_path}/new.sqlite")
    assert open_store(f"sqlite:///{tmp_path}/new.sqlite").machines() == []


@pytest.mark.parametrize("kind", ["approve", "rollback"])
def test_nothing_is_decided_for_tables_whose_contents_are_damaged(store, kind):
    machine = store.add_machine("mill")
    for number in (1, 2, 3):
        processed(store, machine, number, approve=number < 3)
    damage(store, b"table 3" if kind == "approve" else b"table 1")
    before = store.decisions(machine)
    with pytest.raises(StoreError, match="missing or damaged"):
        if kind == "approve":
            decisions.approve(store, machine, 3, "ada")
        else:
            decisions.rollback(store, machine, "ada", "worse")
    assert store.decisions(machine) == before
    assert decisions.active_table(store, machine).version == 2


def test_the_version_of_a_store_changes_with_everything_that_is_added(store):
    machine = store.add_machine("mill")
    seen = {store.version()}
    measured(store, machine, 1)
    seen.add(store.version())
    processed(store, machine, 2)
    seen.add(store.version())
    decisions.approve(store, machine, 1, "ada")
    seen.add(store.version())
    store.add_event("clock", "clock", "text", machine)
    seen.add(store.version())
    assert len(seen) == 5
    assert store.version() in seen


def checkpointed(path):
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()


def test_an_older_copy_that_is_written_over_the_open_file_is_noticed(tmp_path):
    path = tmp_path / "recal.sqlite"
    store = open_store(str(path))
    machine = store.add_machine("mill")
    processed(store, machine, 1)
    checkpointed(path)
    shutil.copyfile(path, tmp_path / "old.sqlite")
    processed(store, machine, 2)
    checkpointed(path)
    assert len(store.tables(machine)) == 2  # a checkpoint is no other store
    decisions.approve(store, machine, 2, "ada")
    checkpointed(path)
    good = path.read_bytes()
    number = path.stat().st_ino
    path.write_bytes((tmp_path / "old.sqlite").read_bytes())
    assert path.stat().st_ino == number
    with pytest.raises(StoreError, match="was moved, removed or replaced"):
        store.version()
    with pytest.raises(StoreError, match="was moved, removed or replaced"):
        decisions.reject(store, machine, 1, "ada", "why")
    path.write_bytes(b"no store " * 1000)
    with pytest.raises(StoreError, match="was moved, removed or replaced"):
        store.version()
    path.write_bytes(good)
    assert [item.kind for item in store.decisions(machine)][-1] == "approve"
    store.close()


def test_a_backup_of_the_same_rows_that_is_written_over_the_open_file_is_noticed(tmp_path):
    """Its pages lie in another order, and the write-ahead log of the store would be laid over them."""
    path = tmp_path / "recal.sqlite"
    store = open_store(str(path))
    machine = store.add_machine("mill")
    processed(store, machine, 1)
    checkpointed(path)
    with sqlite3.connect(path) as connection:  # as an older program made it
        connection.execute("PRAGMA user_version = 0")
    connection.close()
    checkpointed(path)
    store.close()
    store = open_store(str(path))
    store.version()
    backup(str(path), tmp_path / "copy.sqlite")
    decisions.approve(store, machine, 1, "ada")  # in the write-ahead log only
    shutil.copyfile(tmp_path / "copy.sqlite", path)
    with pytest.raises(StoreError, match="was moved, removed or replaced"):
        store.version()


def test_another_store_that_is_written_over_the_open_file_is_noticed(tmp_path):
    stores = []
    for number, seed in enumerate((1, 5)):
        store = open_store(str(tmp_path / f"{number}.sqlite"))
        for each in range(number + 1):  # the other one is longer
            processed(store, store.add_machine("mill"), seed + each)
        checkpointed(tmp_path / f"{number}.sqlite")
        store.version()
        stores.append(store)
    (tmp_path / "0.sqlite").write_bytes((tmp_path / "1.sqlite").read_bytes())
    with pytest.raises(StoreError, match="was moved, removed or replaced"):
        stores[0].version()
    assert stores[1].version()


# --- who decides, and what is shown --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "actor",
    [
        "automatic",
        " Automatic ",
        "AUTOMATIC",
        "ada\x1b[2J",
        "ada\nrollback by ben",
        "a\u202eb",
        "auto\u200bmatic",
        "\uff41utomatic\xa0",
    ],
)
@pytest.mark.parametrize("kind", ["approve", "reject", "rollback"])
def test_nobody_signs_as_the_program_or_with_what_a_terminal_obeys(store, actor, kind):
    machine = store.add_machine("mill")
    for number in (1, 2):
        processed(store, machine, number, approve=number == 1)
    before = store.decisions(machine)
    with pytest.raises(decisions.DecisionError, match="automatic|control or invisible characters"):
        if kind == "rollback":
            decisions.rollback(store, machine, actor, "why")
        else:
            getattr(decisions, kind)(store, machine, 2, actor, "why")
    assert store.decisions(machine) == before


def test_without_a_version_the_only_one_that_waits_is_meant(store):
    machine = store.add_machine("mill")
    with pytest.raises(decisions.DecisionError, match="nothing waits"):
        decisions.only_pending(store, machine)
    processed(store, machine, 1)
    assert decisions.only_pending(store, machine).version == 1
    processed(store, machine, 2)  # takes the place of version 1
    assert decisions.only_pending(store, machine).version == 2
    processed(store, machine, 3, hold=("late",))
    with pytest.raises(decisions.DecisionError, match="versions 2 .pending., 3 .held. wait"):
        decisions.only_pending(store, machine)
