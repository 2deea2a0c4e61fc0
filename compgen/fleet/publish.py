"""Publication: a machine's output folder follows the store; a command is notified of every decision and failure."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import IO, Any, TypeVar

from compgen.data.files import OutputFolder, exclusive, sha256_of, write_file
from compgen.errors import InputError
from compgen.fleet import logs
from compgen.fleet.records import ADOPTED, AFTER, HELD_BACK, RESTORED, MachineRecord, TableRecord, TableState, active_of
from compgen.fleet.store import Store

# The output folder of a machine follows the store: one folder per version, and the pointer ``active``.
#
#     OUT/v0001/ ...                 versions that are or were active
#     OUT/active -> v0001            symbolic link, swapped atomically; absent while no tables are active
#     OUT/proposed/v0002/            waits for approval
#     OUT/proposed/HELD-v0003/       held back by the policy
#     OUT/proposed/NOT-ACCEPTED-v0004/   refused by the round trip
#     OUT/.store.json                owner of this folder: machine, number of decisions, and their hash
#
# Everything is written under a temporary name and renamed; doing it again changes nothing. It is done under a lock on
# the folder, after the decision is in the store, so the last process always leaves the folder as the store says.
#
# Folder and store recognise each other by the machine's history: the hash of all decisions with the contents of their
# tables. A store with a shorter history (an older backup) or a different one never writes here. Files that this program
# did not write are never deleted, and nothing is written through a link.


Value = TypeVar("Value")

POINTER = "active"
PROPOSED = "proposed"
LEDGER = ".store.json"
#: Prefix of the folder below ``proposed`` by state; tables in other states do not appear there.
PREFIX: dict[TableState, str] = {"pending": "", "held": "HELD-", "refused": "NOT-ACCEPTED-"}
#: Prefixes for the rest of a folder that contains foreign files, and for a folder that belonged to another store.
LEFT, SET_ASIDE = "LEFT-", "SET-ASIDE-"
#: The folder keeps this many of the newest refused and held tables; the store keeps all of them.
KEPT = 3
_VERSION = re.compile(r"v([0-9]{4,})")
_PROPOSED = re.compile(r"(?:HELD-|NOT-ACCEPTED-)?v([0-9]{4,})")
_TEMPORARY = re.compile(r"\.((?:HELD-|NOT-ACCEPTED-)?v([0-9]{4,}))\.tmp")


def check_folder(store: Store, machine: MachineRecord, folder: Path) -> None:
    """Raise InputError unless the folder belongs to this machine and this store; nothing is changed.

    Called before a measurement is processed and before a decision, to keep a wrong store from continuing a history that
    is not the machine's.
    """
    try:
        seen = _look(folder)  # before the store: another process adds to the store first
        _compare(store, machine, store.tables(machine, figures=False), folder, seen)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=folder) from error


def begin_folder(store: Store, machine: MachineRecord, folder: Path) -> list[str]:
    """Publish into a folder that has nothing of any store, before anything is judged; return what to say."""
    if not _is_empty(folder):
        return []
    said = note_empty_folder(store, machine, folder)
    publish(store, machine, folder)
    return said


def note_empty_folder(store: Store, machine: MachineRecord, folder: Path) -> list[str]:
    """Record that a folder has nothing of any store although this one has made tables active; return what to say.

    The store may be an older one (a copy, or a restored database): no ledger shows otherwise. From then on it does not know
    which tables are on, as after `recal adopt`.
    """
    if not _is_empty(folder):
        return []
    known = [item.at for item in store.events(machine) if item.kind in (ADOPTED, RESTORED)]
    swaps = [item.at for item in store.decisions(machine) if AFTER[item.kind] == "active"]
    if not swaps or (known and max(known) >= swaps[-1]):  # the latter is known, and until when the history counts
        return []
    at = store.now().isoformat(timespec="seconds")
    said = f"the folder was empty at {at}, although this store has made tables active; it may be an older store"
    store.add_event(ADOPTED, "folder", said, machine)
    logs.warning("empty folder", machine=machine.name, folder=str(folder))
    return [said]


def _is_empty(folder: Path) -> bool:
    seen = _look(folder)
    return seen.pointer is None and seen.ledger_text is None and not seen.versions


def publish(store: Store, machine: MachineRecord, folder: Path) -> TableRecord | None:
    """Bring the folder in line with the store and return the active tables.

    Missing or altered files of the active and the proposed versions are restored; those of a retired version when it
    becomes active again.

    Raises
    ------
    InputError
        if it cannot be written, or does not belong to this machine and store (:func:`check_folder`).
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder):
            seen = _look(folder)
            tables = store.tables(machine, figures=False)
            _compare(store, machine, tables, folder, seen)
            ledger = _ledger_text(store, machine)
            # left behind by a process that was killed; no other process works here now
            (folder / f".{POINTER}.tmp").unlink(missing_ok=True)
            by_version = {table.version: table for table in tables}
            for path in [*folder.glob(".*.tmp"), *(folder / PROPOSED).glob(".*.tmp")]:
                found = _TEMPORARY.fullmatch(path.name)
                left = None if found is None else by_version.get(int(found[2]))
                if found is not None and left is not None and path.is_dir() and not path.is_symlink():
                    _clear(path, _contents(store, machine, left), found[1])
            for table in tables:
                required = folder / version_name(table)
                if table.state == "active" or (table.state == "retired" and not required.exists()):
                    _complete(store, machine, table, required)
            active = active_of(tables)
            pointer = folder / POINTER  # swapped in one step
            if active is None:
                pointer.unlink(missing_ok=True)
            elif not pointer.is_symlink() or os.readlink(pointer) != version_name(active):
                temporary = folder / f".{POINTER}.tmp"
                temporary.unlink(missing_ok=True)
                temporary.symlink_to(version_name(active), target_is_directory=True)
                temporary.replace(pointer)
            _sync(folder)
            _propose(store, machine, tables, folder / PROPOSED)
            if ledger != seen.ledger_text:
                write_file(folder / LEDGER, ledger)
        return active
    except OSError as error:
        raise InputError(f"the tables cannot be written: {error.strerror or error}", file=folder) from error


def is_published(store: Store, machine: MachineRecord, folder: Path) -> bool:
    """Whether :func:`publish` would change nothing: the files match byte for byte, and this program wrote no others."""
    try:
        seen = _look(folder)
        tables = store.tables(machine, figures=False)
        _compare(store, machine, tables, folder, seen)
        required, active, proposed = _proposed(tables), active_of(tables), folder / PROPOSED
        kept = {version_name(table) for table in tables if table.state == "retired"}
        left = [name for name in os.listdir(folder) if name.endswith(".tmp")]
        for name in os.listdir(proposed) if proposed.exists() else ():
            if name.endswith(".tmp") or (_PROPOSED.fullmatch(name) and name not in required):
                left.append(name)
        pointer = None if active is None else version_name(active)
        if (
            left
            or kept - {*seen.versions}
            or (seen.pointer, seen.ledger_text) != (pointer, _ledger_text(store, machine))
        ):
            return False
        whole = {proposed / name: table for name, table in required.items()}
        if active is not None:
            whole[folder / version_name(active)] = active
        files = store.file_hashes(machine)
        return all(
            _is_complete(path, files.get(table.id, []), _note(store, machine, table)) for path, table in whole.items()
        )
    except (InputError, OSError):  # publish says what is wrong
        return False


def _is_complete(folder: Path, files: Sequence[tuple[str, str, str]], note: bytes) -> bool:
    """Whether the folder of a version contains its files (control, name, SHA-256) and the note ``version.json``."""
    required = {**_by_place(files), "version.json": sha256_of(note)}
    paths = {folder / name: digest for name, digest in required.items()}
    return not folder.is_symlink() and all(
        path.is_file() and not path.is_symlink() and sha256_of(path.read_bytes()) == digest
        for path, digest in paths.items()
    )


def set_aside(folder: Path) -> Path | None:
    """Move everything that an earlier store published into a separate folder and return it; None if nothing."""
    if not folder.is_dir():
        return None
    with _locked(folder):
        names = [path for path in sorted(folder.iterdir()) if _VERSION.fullmatch(path.name)]
        names += [folder / name for name in (PROPOSED, LEDGER) if (folder / name).exists()]
        pointer = folder / POINTER
        if not names and not pointer.is_symlink():
            return None
        number = next(k for k in range(1, 10**6) if not (folder / f"{SET_ASIDE}{k}").exists())
        target = folder / f"{SET_ASIDE}{number}"
        target.mkdir()
        for path in [*([pointer] if pointer.is_symlink() else []), *names]:  # the pointer first: controls read it
            path.rename(target / path.name)
        _sync(folder)
        return target


# --- ownership of the folder ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Seen:
    """Contents of a folder: target of the pointer (None: nowhere), text of the ledger, names of version folders."""

    pointer: str | None
    ledger_text: str | None
    versions: tuple[str, ...]

    @property
    def ledger(self) -> dict[str, Any] | None:
        """Contents of the ledger; None if it is missing, damaged, or from an older program."""
        try:
            found = json.loads(self.ledger_text or "")
        except ValueError:
            return None
        kinds = {"machine": str, "decisions": int, "sha256": str}
        whole = isinstance(found, dict) and all(isinstance(found.get(key), kind) for key, kind in kinds.items())
        return found if whole else None


def lineage(store: Store, machine: MachineRecord) -> list[str]:
    """Return the hash of the machine's history after each decision: what was decided about which contents.

    Times, persons and reasons do not count: two stores with the same lineage publish the same bytes.
    """
    files = store.file_hashes(machine)
    numbers: dict[int, int] = {}
    found, last = [], ""
    for decision in store.decisions(machine):
        about = None
        if decision.table_id is not None:
            number = numbers.setdefault(decision.table_id, len(numbers) + 1)
            about = [number, *files.get(decision.table_id, [])]
        last = sha256_of(json.dumps([last, decision.kind, about]).encode())
        found.append(last)
    return found


def _ledger_text(store: Store, machine: MachineRecord) -> str:
    past = lineage(store, machine)
    about = {"machine": machine.name, "decisions": len(past), "sha256": past[-1] if past else ""}
    return json.dumps(about, indent=2) + "\n"


def _look(folder: Path) -> _Seen:
    pointer = folder / POINTER
    if not pointer.is_symlink() and pointer.exists():
        raise InputError("is not a link to a version, so this program did not make it; move it away", file=pointer)
    if (folder / PROPOSED).is_symlink():
        raise InputError("is a link; nothing is written through it, so put a folder there", file=folder / PROPOSED)
    ledger = folder / LEDGER
    names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    versions = tuple(name for name in names if _VERSION.fullmatch(name))
    for name in versions:
        if (folder / name).is_symlink():
            raise InputError(
                "is a link; nothing is written through it, so put the folder itself there", file=folder / name
            )
    text = ledger.read_text(encoding="utf-8", errors="replace") if ledger.is_file() else None
    return _Seen(os.readlink(pointer) if pointer.is_symlink() else None, text, versions)


def _compare(store: Store, machine: MachineRecord, tables: Sequence[TableRecord], folder: Path, seen: _Seen) -> None:
    """Refuse a folder that belongs to another store or machine, or whose store was newer than this one."""
    known = {version_name(table): table for table in tables if table.state in ("active", "retired")}
    then = (
        f"give the right store (`store` in the job file) or a newer backup; if this store is right, `volcomp recal adopt "
        f"{machine.name} --reason TEXT` sets aside the contents of the folder"
    )
    if seen.pointer is not None and seen.pointer not in known:
        raise InputError(
            f"points to {seen.pointer}, which this store never made active, so this is not the store of this folder; {then}",
            file=folder / POINTER,
        )
    unknown = [name for name in seen.versions if name not in known]
    if unknown:
        raise InputError(f"contains {', '.join(unknown)}, which this store never made active; {then}", file=folder)
    ledger = seen.ledger
    if ledger is None:  # then compare the contents
        for name in seen.versions:
            if _is_of_others(folder / name, _about(store, machine, known[name])):
                raise InputError(
                    f"{name} was published from another measurement than the one in this store; {then}", file=folder
                )
        return
    if ledger["machine"] != machine.name:
        raise InputError(
            f"is the folder of machine {ledger['machine']}, not of {machine.name}; give {machine.name} a folder of its own, "
            f"or, if the machine was renamed, `volcomp recal adopt {machine.name} --reason TEXT`",
            file=folder,
        )
    history, count = lineage(store, machine), ledger["decisions"]
    if count > len(history):
        raise InputError(
            f"records {count} decisions about {machine.name}, but this store has {len(history)}: it is another store, was "
            f"emptied, or is an older backup; {then}",
            file=folder,
        )
    if count and history[count - 1] != ledger["sha256"]:
        raise InputError(f"records other decisions or tables than this store; {then}", file=folder)


def _is_of_others(folder: Path, about: Mapping[str, Any]) -> bool:
    """Whether the note in a version's folder shows that another store made it; a missing or unreadable one does not."""
    path = folder / "version.json"
    if not path.is_file():  # not a pipe either: reading it would block
        return False
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    keys = ("machine", "version", "made_at", "measurement")
    return not isinstance(found, dict) or any(found.get(key) != about[key] for key in keys)


def version_name(table: TableRecord) -> str:
    """Return the folder name of a version."""
    return f"v{table.version:04d}"


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes out."""
    told = "waiting for another process that works in this folder"
    with exclusive(folder / ".lock", waiting=lambda: logs.warning(told, folder=str(folder))):
        yield


def _clear(folder: Path, contents: Mapping[str, bytes], name: str) -> None:
    """Delete the files that this program wrote into a folder, then the folder; other files stay as LEFT-NAME."""
    for path in sorted(folder.rglob("*"), reverse=True):  # the contents of a folder come before the folder
        if path.is_dir() and not path.is_symlink():
            with contextlib.suppress(OSError):  # not empty: contains other files
                path.rmdir()
            continue
        place = path.relative_to(folder).as_posix()
        half = re.fullmatch(r"(.*/)?\.(.+)\.[^.]+\.tmp", place)  # of an OutputFolder that was killed
        own = place in contents if half is None else f"{half[1] or ''}{half[2]}" in contents
        if own and not path.is_symlink() and (half is not None or path.read_bytes() == contents[place]):
            path.unlink()
    try:
        folder.rmdir()
    except OSError:
        number = next(k for k in range(1, 10**6) if not (folder.parent / f"{LEFT}{name}-{k}").exists())
        folder.rename(folder.parent / f"{LEFT}{name}-{number}")


def _contents(store: Store, machine: MachineRecord, table: TableRecord) -> dict[str, bytes]:
    """Return the files of a version by their place in its folder."""
    files = _by_place([(file.controller, file.name, file.content) for file in store.table_files(table)])
    return {**files, "version.json": _note(store, machine, table)}


def _by_place(files: Sequence[tuple[str, str, Value]]) -> dict[str, Value]:
    """Return the values of files (control, name, value) by place: with several controls each has a subfolder."""
    several = len({control for control, _, _ in files}) > 1
    return {f"{control}/{name}" if several else name: value for control, name, value in files}


def _note(store: Store, machine: MachineRecord, table: TableRecord) -> bytes:
    return (json.dumps(_about(store, machine, table), indent=2) + "\n").encode()


def _about(store: Store, machine: MachineRecord, table: TableRecord) -> dict[str, Any]:
    """Return the contents of ``version.json``."""
    measurement = store.measurement_behind(machine, table)
    return {
        "machine": machine.name,
        "version": table.version,
        "made_at": table.at.isoformat(),
        "measurement": {"name": measurement.name, "sha256": measurement.sha256},
        "measured_at": measurement.measured_at.isoformat(),
        "reasons": list(table.reasons),
    }


def _complete(store: Store, machine: MachineRecord, table: TableRecord, target: Path) -> None:
    """Make the folder of one version, or restore what is missing or altered in it."""
    contents = _contents(store, machine, table)
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise InputError("is not a folder that this program made; move it away", file=target)
    if not target.exists():
        _make(target, contents)
        return
    if _is_of_others(target, json.loads(contents["version.json"])):
        raise InputError("was made by another store; move it away", file=target)
    for name, content in contents.items():
        path = target / name
        if path.is_symlink():
            raise InputError("is a link; nothing is written through it, so remove it", file=path)
        if not path.is_file() or path.read_bytes() != content:
            write_file(path, content)


def _make(target: Path, contents: dict[str, bytes]) -> None:
    temporary = target.with_name(f".{target.name}.tmp")
    output = OutputFolder(temporary)
    for name, content in contents.items():
        output.add(name, content)
    output.commit()
    for inner in {temporary, *((temporary / name).parent for name in contents)}:
        _sync(inner)
    temporary.rename(target)
    _sync(target.parent)


def _proposed(tables: Sequence[TableRecord]) -> dict[str, TableRecord]:
    """Return the tables shown in the folder of proposals, by folder name."""
    closed = {table.id for table in [table for table in tables if table.state in HELD_BACK][:-KEPT]}
    shown = [table for table in tables if table.state in PREFIX and table.id not in closed]
    return {f"{PREFIX[table.state]}{version_name(table)}": table for table in shown}


def _propose(store: Store, machine: MachineRecord, tables: Sequence[TableRecord], folder: Path) -> None:
    required = _proposed(tables)
    if not required and not folder.exists():
        return
    folder.mkdir(exist_ok=True)
    by_version = {table.version: table for table in tables}
    for path in sorted(folder.iterdir()):
        found = _PROPOSED.fullmatch(path.name)
        table = None if found is None else by_version.get(int(found[1]))
        if path.name in required or table is None or path.is_symlink() or not path.is_dir():
            continue
        if not _is_of_others(path, _about(store, machine, table)):
            gone = path.with_name(f".{path.name}.tmp")  # renamed first: no reader sees it half deleted
            path.rename(gone)
            _clear(gone, _contents(store, machine, table), path.name)
    for name, table in required.items():
        _complete(store, machine, table, folder / name)


def _sync(folder: Path) -> None:
    """Make the names in a folder survive a power failure, if the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


# The notification command gets one JSON object on stdin for every decision and every failure, at least once.
#
# A notification is recorded in the store as an event after the command has succeeded; a failed command is tried again
# by the next run. If the process is killed in between, or two run at the same time, the same object is sent twice.


#: Time limit of a notification command, s.
TIMEOUT_S = 60.0
#: Nothing older than this is notified, for example when notifications are switched on.
OLDEST = timedelta(days=1)
#: Kind of the events that record notifications.
NOTIFIED = "notified"
#: Bytes of the command's stderr that are kept.
MOST_SAID = 2000


def notify(store: Store, machine: MachineRecord, command: Sequence[str]) -> list[str]:
    """Send the pending notifications, oldest first; return why any could not be sent (empty: all were)."""
    for subject, message in untold(store, machine) if command else ():
        if subject in _told(store, machine):  # meanwhile, by another runner
            continue
        problem = _send(command, message)
        if problem:
            logs.error("notification failed", machine=machine.name, subject=subject, problem=problem)
            return [problem]
        store.add_event(NOTIFIED, subject, str(message["event"]), machine)
    return []


def untold(store: Store, machine: MachineRecord) -> list[tuple[str, dict[str, Any]]]:
    """Return the pending notifications, oldest first, each with a permanent name."""
    every, decisions, attempts = store.together(
        lambda moment: (moment.tables(machine, figures=False), moment.decisions(machine), moment.attempts(machine))
    )
    tables = {table.id: table for table in every}
    found: list[tuple[str, dict[str, Any]]] = []
    for decision in decisions:
        table = None if decision.table_id is None else tables[decision.table_id]
        message = {
            "machine": machine.name,
            "event": decision.kind,
            "version": None if table is None else table.version,
            "state": None if table is None else table.state,
            "actor": decision.actor,
            "reason": decision.reason,
            "at": decision.at.isoformat(),
        }
        found.append((f"decision {decision.sequence}", message))
    for attempt in attempts:
        if attempt.outcome == "failed":
            message = {"machine": machine.name, "event": "failed", "reason": attempt.message}
            found.append((f"attempt {attempt.id}", {**message, "at": attempt.at.isoformat()}))
    known, since = _told(store, machine), (store.now() - OLDEST).isoformat()
    fresh = [item for item in found if item[0] not in known and item[1]["at"] >= since]
    return sorted(fresh, key=lambda item: str(item[1]["at"]))


def _told(store: Store, machine: MachineRecord) -> set[str]:
    return {event.subject for event in store.events(machine) if event.kind == NOTIFIED}


def _send(command: Sequence[str], message: dict[str, Any]) -> str:
    """Run the command with the message on stdin; return what went wrong, empty if nothing.

    Returns in time however long the command hangs, however much it prints and whatever it leaves running: its output
    is read and discarded except for the beginning of stderr; a command that takes too long is killed with its children.
    """
    try:
        with tempfile.TemporaryFile() as stream:  # the command may read slowly, or not at all
            stream.write((json.dumps(message) + "\n").encode())
            stream.seek(0)
            pipes: Any = {"stdin": stream, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
            process = subprocess.Popen(list(command), **pipes, start_new_session=True)
    except (OSError, ValueError) as error:
        return f"{command[0]}: {error}"
    said = _Said(process.stderr)
    try:
        code = process.wait(TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return f"{command[0]} did not end within {TIMEOUT_S:g} s and was stopped"
    finally:
        if process.poll() is None:  # with its children
            with contextlib.suppress(OSError):
                if os.name == "posix":
                    os.killpg(process.pid, signal.SIGKILL)
                else:
                    process.kill()
            process.wait()
        text = said.text()
    return "" if code == 0 else f"{command[0]} ended with {code}: {text}"


class _Said:
    """Reads a stream to its end in a thread and keeps its beginning."""

    def __init__(self, stream: IO[bytes] | None) -> None:
        self._kept = bytearray()
        self._stream = stream
        self._thread = threading.Thread(target=self._read, name="stderr of a notification", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._stream is not None
        with self._stream:
            while part := self._stream.read1(65536):  # type: ignore[attr-defined]
                self._kept += part[: MOST_SAID - len(self._kept)]

    def text(self) -> str:
        """Return what was read; a child that is still running may keep the stream open for ever."""
        self._thread.join(1.0)
        return " ".join(bytes(self._kept).decode("utf-8", "replace").split())[:200]
