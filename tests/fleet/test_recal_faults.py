"""What must not hurt a recalibration: kill -9, full disks, unreadable files, wrong clocks, stores that are away, long work."""

import errno
import importlib.util
import json
import os
import re
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import sqlalchemy as sa

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data import files
from compgen.fleet import claims, database, publish, runner
from compgen.fleet import claims as results
from compgen.fleet import runner as fleet
from compgen.fleet.claims import Claim, renewal
from compgen.fleet.records import NewMeasurement, NewResult, StoredTableFile
from compgen.fleet.runner import MachineOutcome, run_jobs
from compgen.fleet.store import open_store
from compgen.fleet.watch import Watch

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "recal_faults.py"
NOBODY = 65534
REAL_PROCESS = runner.process
DAY = datetime(2026, 3, 1, 12, tzinfo=UTC)


def _loaded():
    spec = importlib.util.spec_from_file_location("compgen_recal_faults_sqlite", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


faults = _loaded()


@pytest.fixture
def site(tmp_path):
    """A machine with an inbox; its store is an SQLite file."""
    return faults.Site(tmp_path / "site")


@pytest.fixture
def impatient(monkeypatch):
    """Waits between attempts, and for locks, are short."""
    monkeypatch.setattr(database, "WAITS_S", (0.02, 0.05))
    monkeypatch.setattr(database, "BUSY_S", 0.3)


@pytest.fixture
def store(tmp_path):
    made = open_store(f"{tmp_path}/recal.sqlite")
    yield made
    made.close()


def measured(store, number=1):
    machine = store.add_machine("mill")
    new = NewMeasurement(f"{number:064x}", f"m{number}", DAY, "file", {"a.csv": b"content %d" % number})
    return machine, store.add_measurement(machine, new)


def a_result():
    files = (StoredTableFile("isg-csv", "t.csv", b"table"),)
    return NewResult(
        machine_text=b"toml",
        errors_text=b"error,position_mm,value\nEC0Y,,12.0\n",
        covariance=None,
        fitted_text=None,
        summary={},
        program="1",
        active_table_id=None,
        files=files,
        accepted=True,
        hold=(),
        judgement={},
        approve=False,
        settings_sha256="0" * 64,
        seconds=1.0,
    )


def set_store(site, address):
    path = site.folder / "recal.toml"
    text = path.read_text()
    path.write_text(f"store = {json.dumps(str(address))}\n{text[text.index('[machines') :]}")
    site.job = faults.read_job(path)


def command(site, *words):
    return run_command(cli, ["recal", *words, "--job", str(site.folder / "recal.toml")])


def outcome_of(site):
    return run_jobs(site.job).outcomes[0]


def check_all_is_well(site, count):
    """Every measurement was processed once, and the folders are what the store says."""
    found = faults.Findings()
    faults.look(site, found)
    assert found.troubles == []
    store = site.store()
    attempts = [item.measurement_id for item in store.attempts() if item.outcome == "done"]
    states = [table.state for table in store.tables()]
    store.close()
    assert sorted(Counter(attempts).values()) == [1] * count
    assert states == ["retired"] * (count - 1) + ["active"]
    assert os.readlink(site.out / "active") == f"v{count:04d}"


# --- killed --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_runners_killed_at_random_moments_lose_nothing_and_do_nothing_twice(tmp_path, seed):
    _, found = faults.kill(tmp_path, 8, seed)
    assert found.troubles == []
    assert found.killed.total() >= 8
    assert found.reads > 20


def test_the_look_after_a_kill_notices_what_it_should(site):
    site.measure()
    site.measure()
    site.run()
    found = faults.Findings()
    faults.look(site, found)
    assert found.troubles == []
    table = site.out / "v0001" / faults.TABLE
    content = table.read_bytes()
    table.write_bytes(content[:-20])
    (site.out / "active").unlink()
    (site.out / "active").symlink_to("v0007")
    assert faults.read_active(site) == ["the pointer leads to nothing"]
    (site.out / "active").unlink()
    (site.out / "active").symlink_to("v0001")
    found.rows["measurements"].add("(7,)")
    faults.look(site, found)
    assert {"v0001 is not whole", "the active table is cut off", "rows of measurements are gone or changed"} <= {
        *found.troubles
    }


def test_two_runners_on_one_store_process_everything_once_and_in_order(site):
    for _ in range(6):
        site.measure()
    children = [site.start(), site.start()]
    assert [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children] == [0, 0]
    check_all_is_well(site, 6)


# --- disks ---------------------------------------------------------------------------------------------------------


@contextmanager
def small_disk(folder, size_kb):
    """A disk of its own of so many kB."""
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(words, capture_output=True, check=False).returncode != 0:
        pytest.skip("no small disk can be mounted here (root is needed): full disks are only simulated")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(folder, free_kb):
    """Fill the disk up to so many kB."""
    path = folder / "filler"
    path.unlink(missing_ok=True)
    room = os.statvfs(folder)
    with path.open("wb") as stream:
        os.posix_fallocate(stream.fileno(), 0, max(1, room.f_bavail * room.f_frsize - free_kb * 1024))
    return path


def test_a_full_disk_for_the_tables_is_reported_and_made_good(site, tmp_path):
    with small_disk(site.out, 2048):
        site.measure()
        for free_kb in (0, 4, 12, 24):
            filler = fill(site.out, free_kb)
            outcome = outcome_of(site)
            assert (outcome.state, outcome.again) == ("failed", True)
            assert "No space left" in outcome.messages[-1]
            assert faults.read_active(site) == []
        filler.unlink()
        assert site.run() == 0
        check_all_is_well(site, 1)


def test_a_full_disk_for_the_store_ends_with_2_and_is_made_good(site, tmp_path, impatient, capsys):
    with small_disk(tmp_path / "disk", 4096) as disk:
        set_store(site, disk / "recal.sqlite")
        site.measure()
        assert site.run() == 0
        site.measure()
        for free_kb in (0, 4, 16, 40):
            filler = fill(disk, free_kb)
            assert command(site, "run") == 2
            said = capsys.readouterr()
            assert "disk is full" in said.out + said.err or "disk I/O" in said.out + said.err
        filler.unlink()
        assert site.run() == 0
        check_all_is_well(site, 2)


@pytest.mark.parametrize("limit_kb", [1, 8, 40, 130, 300])
def test_a_limit_on_the_size_of_files_loses_nothing(site, impatient, limit_kb):
    site.measure()
    site.store().close()
    child = os.fork()
    if child == 0:
        code = 99
        try:
            for stream in (1, 2):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit_kb * 1024, limit_kb * 1024))
            code = command(site, "run")
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (1, 2) if limit_kb < 100 else code in (0, 1, 2)
    assert site.run() == 0
    check_all_is_well(site, 1)


def test_a_notification_that_finds_a_full_disk_is_told_later_and_once(site):
    path, told = site.folder / "recal.toml", site.folder / "told"
    path.write_text(path.read_text() + 'notify = ["sh", "-c", "cat > /dev/full"]\n')
    site.job = faults.read_job(path)
    site.measure()
    outcome = outcome_of(site)
    assert (outcome.state, outcome.again) == ("ok", True)
    assert "ended with" in outcome.messages[-1]
    path.write_text(path.read_text().replace("> /dev/full", f">> {told}"))
    site.job = faults.read_job(path)
    for _ in range(2):
        assert not outcome_of(site).again
    assert [json.loads(line)["event"] for line in told.read_text().splitlines()] == ["propose", "approve"]


# --- files that cannot be read -------------------------------------------------------------------------------------


@contextmanager
def ordinary_user(folder):
    """Mode bits count for nobody, but not for root: give the folder to nobody, and be nobody."""
    if os.geteuid() != 0:
        yield
        return
    for path in [folder, *folder.rglob("*")]:
        os.chown(path, NOBODY, NOBODY, follow_symlinks=False)
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def open_site():
    """A site in a folder that every user may enter."""
    folder = Path(tempfile.mkdtemp(prefix="compgen-site-", dir="/tmp"))
    folder.chmod(0o755)
    command(faults.Site(folder / "warm"), "run")  # imports everything, which nobody may not be allowed to read
    yield faults.Site(folder / "site")
    shutil.rmtree(folder)


def test_a_file_without_permission_is_reported_and_taken_when_it_may_be_read(open_site):
    site = open_site
    site.measure()
    path = site.inbox / "0001.deviations.csv"
    path.chmod(0)
    site.store().close()  # made before: what makes one may lie where nobody may not read
    with ordinary_user(site.folder):
        outcome = outcome_of(site)
        assert (outcome.state, outcome.again, site.run()) == ("failed", True, 1)
        assert "0001.deviations.csv: cannot be read: Permission denied" in outcome.messages[0]
    path.chmod(0o644)
    assert site.run() == 0
    check_all_is_well(site, 1)


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE])
@pytest.mark.parametrize("broken", ["open", "lstat", "iterdir"])
def test_a_drive_that_fails_is_reported_and_taken_when_it_works(site, monkeypatch, broken, number):
    site.measure()
    where = os if broken == "open" else Path
    real = getattr(where, broken)

    def failing(path, *parts, **options):
        if Path(path).name == (site.inbox.name if broken == "iterdir" else "0001.deviations.csv"):
            raise OSError(number, os.strerror(number))
        return real(path, *parts, **options)

    with monkeypatch.context() as patch:
        patch.setattr(where, broken, failing)
        outcome = outcome_of(site)
    assert (outcome.state, outcome.again) == ("failed", True)
    assert os.strerror(number) in outcome.messages[0]
    assert site.run() == 0
    check_all_is_well(site, 1)


def test_an_inbox_that_is_missing_is_reported_and_what_is_known_is_still_processed(site, monkeypatch):
    site.measure()
    with monkeypatch.context() as patch:
        patch.setattr(runner, "process", lambda *_: (_ for _ in ()).throw(OSError(errno.EIO, "Input/output error")))
        assert site.run() == 1
    away = site.inbox.rename(site.folder / "away")
    outcome = outcome_of(site)
    assert (outcome.state, outcome.again, outcome.processed) == ("failed", True, ("0001.deviations.csv",))
    assert "the inbox cannot be read: No such file" in outcome.messages[0]
    away.rename(site.inbox)
    assert site.run() == 0
    check_all_is_well(site, 1)


def test_a_name_that_is_no_text_and_a_nul_are_kept_and_stop_nobody(site, capsys):
    site.measure()
    good = (site.inbox / "0001.deviations.csv").read_bytes()
    with open(os.fsencode(site.inbox) + b"/\xff.deviations.csv", "wb") as stream:
        stream.write(b"# active_table = v\x001\n" + good)
    os.symlink("nowhere", os.fsencode(site.inbox) + b"/\xfe.deviations.csv")
    for _ in range(2):
        assert command(site, "run") == 1
    assert "\\udcff.deviations.csv" in capsys.readouterr().out
    store = site.store()
    assert sorted(item.name for item in store.measurements()) == ["0001.deviations.csv", "\\udcff.deviations.csv"]
    assert sorted(item.outcome for item in store.attempts()) == ["done", "failed"]
    assert len(store.events()) == 1
    store.close()


# --- the clock -----------------------------------------------------------------------------------------------------


def test_a_clock_that_goes_backwards_is_reported_and_changes_no_order(site):
    now = datetime.now(UTC)
    site.measure()
    assert run_jobs(site.job, clock=lambda: now).exit_code == 0
    site.measure()
    outcome = run_jobs(site.job, clock=lambda: now - timedelta(hours=30)).outcomes[0]
    assert outcome.state == "ok"
    assert "the clock went backwards" in outcome.messages[0]
    store = site.store()
    times = [item.at for item in store.decisions()]
    store.close()
    assert times == sorted(times)
    check_all_is_well(site, 2)


def test_a_clock_that_went_back_does_not_prolong_a_lease(tmp_path):
    now = [DAY]
    store = open_store(f"{tmp_path}/recal.sqlite", clock=lambda: now[0])
    _, measurement = measured(store)
    assert claims.take(store, measurement, "elsewhere/s/1/2", lease_s=600) is not None
    for minutes, free in ((-9, False), (-11, True)):
        now[0] = DAY + timedelta(minutes=minutes)
        assert (claims.take(store, measurement, claims.owner_name()) is not None) == free
    store.close()


# --- the store -----------------------------------------------------------------------------------------------------


def test_no_store_begins_in_a_folder_that_is_not_there(site, capsys):
    set_store(site, site.folder / "unmounted" / "recal.sqlite")
    site.measure()
    for words in (["run"], ["status"], ["history"]):
        assert command(site, *words) == 2
        assert "mount or create it first" in capsys.readouterr().err
    assert not (site.folder / "unmounted").exists()


def test_a_store_that_is_locked_for_long_ends_with_2_and_one_that_is_free_again_soon_is_waited_for(
    site, impatient, capsys
):
    site.measure()
    site.store().close()
    with sqlite3.connect(site.folder / "recal.sqlite", isolation_level=None, check_same_thread=False) as other:
        other.execute("BEGIN EXCLUSIVE")
        started = time.monotonic()
        assert command(site, "run") == 2
        assert time.monotonic() - started < 10.0
        assert "locked" in "".join(capsys.readouterr())
        threading.Timer(0.15, lambda: other.execute("COMMIT")).start()
        assert site.run() == 0
    other.close()
    check_all_is_well(site, 1)


def test_a_store_that_may_not_be_written_ends_with_2(open_site, impatient, capsys):
    site = open_site
    site.measure()
    site.store().close()
    parts = [site.folder, *site.folder.glob("recal.sqlite*")]
    with ordinary_user(site.folder):
        for path in parts:
            path.chmod(0o555 if path.is_dir() else 0o444)
        assert command(site, "run") == 2
        said = "".join(capsys.readouterr())
        assert "readonly" in said or "unable to open" in said
        site.folder.chmod(0o755)
    for path in parts:
        path.chmod(0o755 if path.is_dir() else 0o644)
    assert site.run() == 0
    check_all_is_well(site, 1)


def test_a_damaged_store_is_reported_never_an_internal_error_and_the_backup_brings_it_back(site, capsys):
    for _ in range(2):
        site.measure()
    site.run()
    assert command(site, "backup", str(site.folder / "copy.sqlite")) == 0
    path, generator = site.folder / "recal.sqlite", np.random.default_rng(4)
    whole, codes = path.read_bytes(), Counter()
    schema_text = whole.index(b"CREATE TABLE machines")
    for number in range(12):
        content = bytearray(whole)
        if number == 0:  # SQLite complains with the damaged words, which are no text any more
            content[schema_text : schema_text + 20] = b"\xc2" * 20
        for page in generator.integers(0, len(whole) // 4096, 12):
            start = int(page) * 4096 + int(generator.integers(0, 3000))
            content[start : start + 1000] = generator.bytes(1000)
        for rest in path.parent.glob("recal.sqlite*"):
            rest.unlink()
        path.write_bytes(content)
        for words in (["status"], ["history"], ["run"]):
            codes[command(site, *words)] += 1
        assert faults.read_active(site) == []
    capsys.readouterr()
    assert codes[2] > 10
    assert codes[3] == 0
    for rest in path.parent.glob("recal.sqlite*"):
        rest.unlink()
    assert command(site, "restore", str(site.folder / "copy.sqlite")) == 0
    assert site.run() == 0
    check_all_is_well(site, 2)


def test_the_pointer_is_left_alone_by_a_store_that_does_not_know_it(site, tmp_path):
    site.measure()
    site.run()
    set_store(site, tmp_path / "other.sqlite")
    path = site.folder / "recal.toml"
    path.write_text(path.read_text().replace('approval = "auto"', 'approval = "manual"'))
    site.job = faults.read_job(path)
    outcome = outcome_of(site)
    assert outcome.state == "failed"
    assert "this store never made active" in outcome.messages[-1]
    assert os.readlink(site.out / "active") == "v0001"
    assert faults.read_active(site) == []


@pytest.mark.parametrize("by", ["id", "key"])
@pytest.mark.parametrize("table", [table.name for table in database.ALL])
def test_a_row_cannot_be_replaced_by_another_one(store, table, by):
    machine, measurement = measured(store)
    results.keep_result(store, machine, claims.take(store, measurement, claims.owner_name()), a_result(), None)
    store.add_event("clock", "clock", "text", machine)
    columns = [column.name for column in database.metadata.tables[table].columns if by == "id" or column.name != "id"]
    connection = sqlite3.connect(store.engine.url.database)
    before = list(connection.execute(f"SELECT * FROM {table}"))
    copied = f"INSERT OR REPLACE INTO {table} ({', '.join(columns)}) SELECT {', '.join(columns)} FROM {table} LIMIT 1"
    unique = [c for c in database.metadata.tables[table].constraints if isinstance(c, sa.UniqueConstraint)]
    if by == "id" or unique:
        with pytest.raises(sqlite3.IntegrityError, match="takes new rows only"):
            connection.execute(copied)
    connection.rollback()
    assert list(connection.execute(f"SELECT * FROM {table}")) == before
    connection.close()


# --- watching ------------------------------------------------------------------------------------------------------


def until(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    assert condition()


@contextmanager
def watching(site, **options):
    watch = Watch(site.folder / "recal.toml", poll_s=0.05, **options)
    thread = threading.Thread(target=watch.run, kwargs={"signals": False})
    thread.start()
    try:
        yield watch
    finally:
        watch.stop()
        thread.join()


def test_watch_goes_on_by_itself_when_the_store_comes_back(site, impatient, monkeypatch):
    monkeypatch.setattr("compgen.fleet.watch.AGAIN_S", 0.05)
    disk = site.folder / "disk"
    set_store(site, disk / "recal.sqlite")
    site.measure()
    outcomes = []
    with watching(site, on_outcome=outcomes.append):
        until(lambda: len(outcomes) >= 3)
        assert all((item.state, item.unreachable, item.again) == ("failed", True, True) for item in outcomes)
        disk.mkdir()
        until(lambda: outcomes[-1].state == "ok")
    check_all_is_well(site, 1)


def test_watch_waits_longer_after_every_trouble_and_begins_anew_after_a_good_pass(site, monkeypatch):
    monkeypatch.setattr("compgen.fleet.watch.AGAIN_S", 0.1)
    monkeypatch.setattr("compgen.fleet.watch.AGAIN_AT_MOST_S", 0.4)
    times = []

    def work(job, _url, _stop):
        times.append(time.monotonic())
        return MachineOutcome(job.name, "failed", again=True)

    with watching(site, work=work) as watch:
        until(lambda: len(times) == 6)
        assert watch._troubles["mill"] >= 5
        watch.work = lambda job, _url, _stop: MachineOutcome(job.name, "ok")
        until(lambda: "mill" not in watch._troubles)
    gaps = np.diff(times)
    assert np.all(gaps >= [0.1, 0.2, 0.4, 0.4, 0.4])
    assert gaps[0] < 0.4


def test_a_claim_that_could_not_be_given_back_does_not_block_the_process_that_has_it(site, monkeypatch):
    """A watching process lives for months; what it left behind while the store was away is its own."""
    site.measure()

    def away(*_):
        raise database.StoreError("away")

    with monkeypatch.context() as patch:
        patch.setattr(runner, "process", away)
        patch.setattr(claims, "release", away)
        outcome = outcome_of(site)
    assert (outcome.unreachable, run_jobs(site.job).exit_code) == (True, 0)
    check_all_is_well(site, 1)


# --- leases --------------------------------------------------------------------------------------------------------


def test_work_that_takes_longer_than_its_lease_is_not_taken_over_while_it_goes_on(site, monkeypatch):
    """The runner says that it belongs to another computer, so that only the time of its lease counts here."""
    monkeypatch.setattr(claims, "LEASE_S", 0.6)
    real_owner, real_process, working = claims.owner_name(), runner.process, threading.Event()
    monkeypatch.setattr(claims, "owner_name", lambda: "elsewhere/s/1/2")

    def slow(*parts):
        done = real_process(*parts)
        working.set()
        time.sleep(2.5)
        return done

    monkeypatch.setattr(runner, "process", slow)
    site.measure()
    outcomes = []
    thread = threading.Thread(target=lambda: outcomes.append(outcome_of(site)))
    thread.start()
    assert working.wait(60.0)
    store = site.store()
    (measurement,) = store.measurements()
    stolen = []
    while thread.is_alive():
        stolen.append(claims.take(store, measurement, real_owner))
        time.sleep(0.05)
    thread.join()
    assert len(stolen) > 10
    assert not any(stolen)
    kinds = [row[0] for row in store.read(lambda c: list(c.execute(database.claims.select().with_only_columns(KIND))))]
    store.close()
    assert kinds[0] == "take"
    assert kinds[1:-1].count("renew") == len(kinds) - 2 >= 3
    assert kinds[-1] == "release"
    assert outcomes[0].processed == ("0001.deviations.csv",)
    check_all_is_well(site, 1)


KIND = database.claims.c.kind


def test_without_renewal_it_is_taken_over_and_the_late_one_keeps_nothing(store):
    machine, measurement = measured(store)
    late = claims.take(store, measurement, "elsewhere/s/1/2", lease_s=0.2)
    assert claims.take(store, measurement, claims.owner_name()) is None
    time.sleep(0.25)
    other = claims.take(store, measurement, claims.owner_name())
    assert isinstance(other, Claim)
    with renewal(store, late, lease_s=0.03):  # notices that it is lost, and does not take it back
        time.sleep(0.1)
    with pytest.raises(claims.ClaimLostError):
        results.keep_result(store, machine, late, a_result(), None)
    assert results.keep_result(store, machine, other, a_result(), None).version == 1


def test_a_renewal_outlives_a_store_that_is_away(store, impatient, monkeypatch):
    machine, measurement = measured(store)
    claim = claims.take(store, measurement, "elsewhere/s/1/2", lease_s=0.9)
    real, failed = claims.renew, []

    def renew(*parts):
        if len(failed) < 2:
            failed.append(1)
            raise database.StoreError("away")
        return real(*parts)

    monkeypatch.setattr(claims, "renew", renew)
    with renewal(store, claim, lease_s=0.3):
        time.sleep(1.0)
        assert claims.take(store, measurement, claims.owner_name()) is None
    assert len(failed) == 2
    assert results.keep_result(store, machine, claim, a_result(), None).version == 1


def test_threads_of_one_process_do_not_take_a_measurement_from_each_other(store):
    _, measurement = measured(store)
    found = []
    threads = [
        threading.Thread(target=lambda: found.append(claims.take(store, measurement, claims.owner_name())))
        for _ in range(6)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(claim is not None for claim in found) == 1


@contextmanager
def lost_answer(store, monkeypatch):
    """The next commit is done, but the connection breaks before the answer comes."""
    dialect, real, lost = store.engine.dialect, store.engine.dialect.do_commit, []

    def commit(connection):
        real(connection)
        if not lost:
            lost.append(1)
            raise sqlite3.OperationalError("server closed the connection unexpectedly")

    with monkeypatch.context() as patch:
        patch.setattr(dialect, "do_commit", commit)
        yield
    assert lost


def test_an_answer_that_was_lost_after_the_store_kept_something_does_not_lead_to_a_second_one(
    store, impatient, monkeypatch
):
    with lost_answer(store, monkeypatch):
        machine, measurement = measured(store)
    with lost_answer(store, monkeypatch):
        claim = claims.take(store, measurement, claims.owner_name())
    with lost_answer(store, monkeypatch):
        claims.renew(store, claim)
    with lost_answer(store, monkeypatch):
        table = results.keep_result(store, machine, claim, a_result(), None)
    with lost_answer(store, monkeypatch):
        store.add_event("clock", "clock", "text", machine)
    assert (table.version, table.state) == (1, "pending")
    assert len(store.machines()) == len(store.measurements()) == len(store.identifications()) == 1
    assert len(store.tables()) == len(store.decisions()) == len(store.attempts()) == len(store.events()) == 1


def test_publishing_needs_no_pointer_that_it_may_not_move(site):
    """A store that is restored with its decisions finds the pointer that it made."""
    site.measure()
    site.run()
    site.measure()
    site.run()
    store = site.store()
    machine = store.machine("mill")
    (site.out / "active").unlink()
    (site.out / "active").symlink_to("v0001")
    assert publish.publish(store, machine, site.out).version == 2
    store.close()
    assert os.readlink(site.out / "active") == "v0002"


# --- measurements that bring their process down ---------------------------------------------------------------------


def two_machines(site):
    """The job gains a machine after the first, with an inbox of its own; each has one measurement, not the same."""
    path = site.folder / "recal.toml"
    own = path.read_text()
    more = own[own.index("[machines.mill]") :].replace("[machines.mill]", "[machines.next]")
    path.write_text(own + more.replace('"inbox"', '"inbox2"').replace('"out"', '"out2"'))
    site.measure()
    (site.folder / "inbox2").mkdir()
    text = (site.inbox / "0001.deviations.csv").read_text()
    (site.folder / "inbox2" / "0001.deviations.csv").write_text(f"# of = next\n{text}")
    return site.inbox / "0001.deviations.csv"


def ends_its_process(store, job, *_):
    """Stands for a library that crashes, or the system's answer to too little memory, over the first machine."""
    if job.name == "mill":
        os.kill(os.getpid(), 9)
    return REAL_PROCESS(store, job, *_)


def never_ends(store, job, *_):
    """Stands for a loop inside a library: no other thread of the process gets its turn."""
    if job.name == "mill":
        re.match("(a+)+$", "a" * 60 + "b")
    return REAL_PROCESS(store, job, *_)


def results_of(site, capsys):
    """Make one pass by the command; exit code, and what it says about each machine."""
    capsys.readouterr()
    code = command(site, "run", "--json")
    return code, {item["machine"]: item for item in json.loads(capsys.readouterr().out)["machines"]}


def test_a_measurement_that_kills_its_process_keeps_nobody_waiting_and_is_set_aside_after_three_times(
    site, capsys, monkeypatch
):
    two_machines(site)
    monkeypatch.setattr(runner, "process", ends_its_process)
    code, found = results_of(site, capsys)
    assert code == 1
    assert found["next"]["processed"] == ["0001.deviations.csv"]
    assert found["mill"]["state"] == "failed" and "killed, twice" in found["mill"]["messages"][0]
    code, found = results_of(site, capsys)  # the third time, then the machine has its pass
    assert code == 1 and found["next"]["state"] == "ok"
    assert "killed or crashed, 3 of 3 times; it is set aside until" in found["mill"]["messages"][0]
    _, again = results_of(site, capsys)
    assert again["mill"]["messages"] == found["mill"]["messages"]
    store = site.store()
    assert [item.outcome for item in store.attempts(store.machine("mill"))] == ["failed"]
    assert sum(item.kind == "process ended" for item in store.events()) == 3
    store.close()
    monkeypatch.setattr(runner, "process", REAL_PROCESS)
    path = site.folder / "recal.toml"
    path.write_text(path.read_text().replace("[machines.next]", "policy = {confidence = 0.9}\n[machines.next]"))
    assert results_of(site, capsys)[1]["mill"]["processed"] == ["0001.deviations.csv"]


def test_a_measurement_that_takes_too_long_is_ended_and_set_aside(site, capsys, monkeypatch):
    two_machines(site)
    path = site.folder / "recal.toml"
    path.write_text(path.read_text().replace("[machines.mill]", "[machines.mill]\nmax_minutes = 0.03"))
    monkeypatch.setattr(runner, "process", never_ends)
    began = time.monotonic()
    code, found = results_of(site, capsys)
    assert time.monotonic() - began < 60.0
    assert code == 1
    assert found["next"]["processed"] == ["0001.deviations.csv"]
    assert "took too long" in found["mill"]["messages"][0]
    code, found = results_of(site, capsys)
    assert code == 1 and "took longer than 0.03 minutes and was ended; it is set aside" in found["mill"]["messages"][0]


def test_runners_that_are_killed_from_outside_do_not_count_and_the_others_have_their_turn_first(
    site, capsys, monkeypatch
):
    two_machines(site)
    monkeypatch.setattr(runner, "process", ends_its_process)
    for _ in range(5):  # as the system does that ends everything of a service: runner and process at once
        child = os.fork()
        if child == 0:
            run_jobs(site.job)
            os._exit(99)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -9
    order = []
    real = fleet.spread
    monkeypatch.setattr(
        fleet, "spread", lambda w, f, items, **o: real(w, f, [order.append(i.name) or i for i in items], **o)
    )
    _, found = results_of(site, capsys)
    assert order == ["next", "mill"]
    assert list(found) == ["mill", "next"]
    store = site.store()
    assert store.attempts(store.machine("mill")) == []
    store.close()


# --- what killed runs leave behind ------------------------------------------------------------------------------------


def test_temporary_files_and_folders_of_killed_runs_are_removed_by_the_next_and_those_of_others_stay(
    site, tmp_path, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    target = tmp_path / "tables" / "a.csv"
    child = os.fork()
    if child == 0:
        with files.working_folder("test-") as folder:
            (folder / "big").write_bytes(b"0" * 1000)
            target.parent.mkdir()
            files._write_temporary(target, b"half")
            os.kill(os.getpid(), 9)
    os.waitpid(child, 0)
    (left,) = tmp_path.glob("compgen-test-*")
    (half,) = target.parent.glob(".a.csv.*.tmp")
    for path in (left / ".lock", half):
        os.utime(path, (time.time() - 10,) * 2)
    other = target.with_name(".a.csv.notes.tmp")
    other.write_text("of somebody else")
    with files.working_folder() as mine:  # whoever works keeps its own, however old it looks
        alive = files._write_temporary(target, b"by this process")
        for path in (mine / ".lock", alive):
            os.utime(path, (time.time() - 10,) * 2)
        site.measure()
        assert site.run() == 0
        files.write_file(target, "whole")
        assert mine.is_dir() and alive.read_bytes() == b"by this process"
    files._unlock(alive)
    assert not left.exists() and not half.exists()
    assert other.read_text() == "of somebody else"
    assert target.read_text() == "whole"
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith("compgen-")) == []


@pytest.mark.parametrize("moment", ["before the lock", "while it is removed", "before it is removed"])
def test_a_run_with_nothing_to_do_removes_the_working_folder_of_a_killed_one(site, tmp_path, monkeypatch, moment):
    site.measure()
    assert site.run() == 0
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    killed = lambda *_, **__: os.kill(os.getpid(), 9)  # noqa: E731
    child = os.fork()
    if child == 0:
        if moment == "before the lock":
            files.os = SimpleNamespace(**{**vars(os), "open": killed})
        with files.working_folder("recal-") as folder:
            (folder / "out").mkdir()
            (folder / "a").write_bytes(b"half")
            if moment == "while it is removed":
                shutil.rmtree = killed
            else:
                killed()
    assert os.waitpid(child, 0)[1] == 9
    (left,) = tmp_path.glob("compgen-recal-*")
    foreign = tmp_path / "compgen-of-somebody-else"  # not made by this program: it has no lock
    foreign.mkdir()
    (foreign / "a").write_text("kept")
    for path in (left / ".lock", left, foreign):
        if path.exists():
            os.utime(path, (time.time() - 4000,) * 2)
    assert site.run() == 0
    assert not left.exists()
    assert (foreign / "a").read_text() == "kept"


#: Changes to a folder without a lock that has long been left: its name, what is touched in it, its mode, whether there is a lock.
LONG_LEFT = {
    "long left": ({}, True),
    "a file in it is new": ({"touched": "out/b"}, False),
    "a folder in it is new": ({"touched": "out"}, False),
    "made by a person": ({"mode": 0o755}, False),
    "another name": ({"name": "compgen-recal-of-my-mills"}, False),
    "another kind of name": ({"name": "compgen-projects"}, False),
}


@pytest.mark.parametrize("case", LONG_LEFT)
def test_a_folder_without_a_lock_is_removed_if_nothing_in_it_changed_for_a_week_and_this_program_made_it(
    tmp_path, monkeypatch, case
):
    changes, removed = LONG_LEFT[case]
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = tmp_path / changes.get("name", "compgen-recal-a_1b2c3d")
    (folder / "out").mkdir(parents=True)
    (folder / "a").write_text("half")
    (folder / "out" / "b").write_text("half")
    folder.chmod(changes.get("mode", 0o700))
    for path in (folder / "out" / "b", folder / "out", folder / "a", folder):
        age_s = 60.0 if str(path.relative_to(folder)) == changes.get("touched") else 8 * 86400.0
        os.utime(path, (time.time() - age_s,) * 2)
    files.remove_abandoned_folders()
    assert folder.exists() != removed
    assert removed or (folder / "out" / "b").read_text() == "half"


def test_a_folder_without_a_lock_of_another_user_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = tmp_path / "compgen-recal-a_1b2c3d"
    folder.mkdir(mode=0o700)
    (folder / "a").write_text("half")
    for path in (folder / "a", folder):
        os.utime(path, (time.time() - 8 * 86400.0,) * 2)
    user = os.geteuid()
    monkeypatch.setattr(files, "os", SimpleNamespace(**{**vars(os), "geteuid": lambda: user + 1}))
    files.remove_abandoned_folders()
    assert (folder / "a").read_text() == "half"
    monkeypatch.undo()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    files.remove_abandoned_folders()
    assert not folder.exists()
