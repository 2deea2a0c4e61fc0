"""A backup, a restore or a new store whose process is killed at any moment, or whose disk is full; a stopped process."""

import os
import random
import resource
import signal
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest
import sqlalchemy as sa

from compgen.data import files
from compgen.errors import CompgenError, InputError
from compgen.fleet import database
from compgen.fleet.publish import publish, set_aside
from compgen.fleet.records import NewMeasurement
from compgen.fleet.store import backup, open_store, restore

#: Moments at which a process may be killed: before it opens, makes, renames, links or removes a file, or sends a statement.
EVENTS = ("open", "os.mkdir", "os.rename", "os.link", "os.remove", "os.rmdir", "sqlite3.connect")


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A store with two machines and three measurements, and its backup."""
    folder = tmp_path_factory.mktemp("saved")
    store = open_store(f"{folder}/recal.sqlite")
    at = datetime(2026, 3, 1, tzinfo=UTC)
    for number, name in enumerate(("mill", "lathe", "mill")):
        content = {"a.csv": b"content %d" % number * 2000}
        new = NewMeasurement(f"{number:064x}", f"m{number}", at, "file", content)
        store.add_measurement(store.add_machine(name), new)
    store.close()
    backup(f"{folder}/recal.sqlite", folder / "copy.sqlite")
    return folder


def killed_at(moment, work):
    """Do the work in a process that is killed at its ``moment``; return how many moments it had, 0 if it was killed."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        count = 0

        def count_or_kill(*_):
            nonlocal count
            count += 1
            if count == moment:
                os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(lambda event, _: count_or_kill() if event in EVENTS else None)
        sa.event.listen(sa.engine.Engine, "before_cursor_execute", count_or_kill)
        try:
            work()
            os.write(writing, b"%d" % count)
        finally:
            os._exit(0)
    os.close(writing)
    os.waitpid(child, 0)
    with os.fdopen(reading) as stream:
        return int(stream.read() or 0)


def contents(path):
    """All machines and measurements of a store."""
    store = open_store(f"{path}")
    try:
        return [item.name for item in store.machines()], [store.contents_of(item) for item in store.measurements()]
    finally:
        store.close()


def whole_or_missing(path, wanted):
    assert not path.exists() or contents(path) == wanted
    assert not any(item.stat().st_size == 0 for item in path.parent.glob("*.sqlite"))


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("what", ["restore", "backup", "new"])
def test_a_store_or_copy_is_whole_or_missing_whenever_its_process_is_killed(saved, tmp_path, what, seed):
    """The next one succeeds without a person, and removes what the killed ones have left."""
    path = tmp_path / "other.sqlite"
    wanted = ([], []) if what == "new" else contents(saved / "copy.sqlite")
    work = {
        "restore": lambda: restore(saved / "copy.sqlite", f"sqlite:///{path}"),
        "backup": lambda: backup(f"{saved}/recal.sqlite", path),
        "new": lambda: open_store(str(path)).close(),
    }[what]
    last = killed_at(-1, work)
    whole_or_missing(path, wanted)
    path.unlink()
    for moment in random.Random(seed).sample(range(1, last + 1), 3):
        assert killed_at(moment, work) == 0
        whole_or_missing(path, wanted)
        path.unlink(missing_ok=True)
        for item in tmp_path.iterdir():  # one without a lock may belong to a process that is about to make it
            os.utime(item, (0, 0))
    work()
    assert contents(path) == wanted
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("what", ["restore", "backup", "new"])
def test_a_disk_that_fills_while_a_store_is_made_leaves_none(saved, tmp_path, what, monkeypatch):
    """No file of this process may have more than 8 kB."""
    monkeypatch.setattr(database, "WAITS_S", ())
    path = tmp_path / "other.sqlite"
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
            if what == "restore":
                restore(saved / "copy.sqlite", str(path))
            elif what == "backup":
                backup(f"{saved}/recal.sqlite", path)
            else:
                open_store(str(path))
        except CompgenError as error:
            os.write(writing, str(error).encode())
        finally:
            os._exit(0)
    os.close(writing)
    os.waitpid(child, 0)
    with os.fdopen(reading) as stream:
        assert stream.read()
    assert list(tmp_path.iterdir()) == []
    open_store(str(path)).close()
    assert path.stat().st_size > 0


def test_what_an_earlier_version_left_of_killed_backups_is_removed_and_what_others_made_stays(saved, tmp_path):
    left = [tmp_path / f".copy-{k}.sqlite.{1000 + k}.tmp{end}" for k in range(7) for end in ("", "-wal", "-shm")]
    others = [tmp_path / ".notes.tmp", tmp_path / ".copy.sqlite.77.tmp"]
    for path in (*left, *others):
        path.write_bytes(b"half")
    for path in (*left, others[0]):
        os.utime(path, (0, 0))
    backup(f"{saved}/recal.sqlite", tmp_path / "b.sqlite")
    assert sorted(tmp_path.iterdir()) == sorted([*others, tmp_path / "b.sqlite"])


def test_the_file_of_a_store_that_two_processes_make_at_once_is_that_of_the_first(tmp_path):
    """Both find no file; the second one's own is never put in place of the first one's, which may have rows by then."""
    path = tmp_path / "recal.sqlite"
    children = []
    for name in ("mill", "lathe", "saw"):
        children.append(os.fork())
        if children[-1] == 0:
            try:
                open_store(str(path)).add_machine(name)
            finally:
                os._exit(0)
    for child in children:
        os.waitpid(child, 0)
    assert contents(path)[0] == ["lathe", "mill", "saw"]


# --- a process that is stopped while it has the lock of a folder ------------------------------------------------------

KEEPER = """
import sys, time
from pathlib import Path
from compgen.data.files import exclusive
with exclusive(Path(sys.argv[1])):
    print("kept", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def stopped(tmp_path):
    """A process that has the lock of a folder and is stopped (SIGSTOP)."""
    words = [sys.executable, "-c", KEEPER, str(tmp_path / ".lock")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "kept\n"
        process.send_signal(signal.SIGSTOP)
        yield process
        process.kill()


@pytest.mark.parametrize("action", [publish, set_aside])
def test_a_stopped_process_that_keeps_a_folder_of_tables_is_named(stopped, saved, tmp_path, monkeypatch, action):
    monkeypatch.setattr(files, "LOCK_WAIT_S", 0.1)
    store = open_store(f"{saved}/recal.sqlite")
    with pytest.raises(InputError, match=rf"is kept by process {stopped.pid} \(.*, which is stopped\)") as caught:
        publish(store, store.machine("mill"), tmp_path) if action is publish else set_aside(tmp_path)
    assert caught.value.file == tmp_path
    store.close()
    stopped.kill()
    stopped.wait()
    assert set_aside(tmp_path) is None  # the lock of a killed process is free


def test_the_note_of_a_lock_names_no_process_once_it_is_free(tmp_path):
    path = tmp_path / ".lock"
    with files.exclusive(path):
        assert path.read_text().split()[0] == str(os.getpid())
    assert path.read_text() == ""


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_a_lock_that_is_no_file_is_refused(tmp_path, kind):
    path, other = tmp_path / ".lock", tmp_path / "other"
    {"link": lambda: path.symlink_to(other), "pipe": lambda: os.mkfifo(path), "folder": path.mkdir}[kind]()
    with pytest.raises((OSError, InputError)), files.exclusive(path):
        pass
    assert not other.exists()
    assert isinstance(path, Path)
