"""The output folder of a machine follows the store: one folder for each version, and the pointer ``active``.

    OUT/v0001/ ...                 versions that are or were active
    OUT/active -> v0001            symbolic link, swapped atomically; absent while no tables are active
    OUT/proposed/v0002/            waits for approval
    OUT/proposed/HELD-v0003/       held back by the policy
    OUT/proposed/NOT-ACCEPTED-v0004/   refused by the round trip

Everything is made under another name and renamed; doing it again changes nothing. It is done under a lock of the folder,
after the decision stands in the store, so the last one to come always leaves the folder as the store says.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from compgen.core.files import OutputFolder, write_file
from compgen.errors import InputError
from compgen.recal import logs
from compgen.recal.records import MachineRecord, TableRecord, TableState
from compgen.recal.store import Store

POINTER = "active"
PROPOSED = "proposed"
#: Prefix of the folder below ``proposed`` by state; tables in other states do not stand there.
PREFIX: dict[TableState, str] = {"pending": "", "held": "HELD-", "refused": "NOT-ACCEPTED-"}
#: Refused and held tables of which the folder keeps the newest; all of them are in the store.
KEPT = 3


def publish(store: Store, machine: MachineRecord, folder: Path) -> TableRecord | None:
    """Make the folder what the store says and return the active tables; InputError if it cannot be written.

    InputError as well if the pointer leads to a version of which this store does not know that it was ever active: then
    the store is not the one that the folder belongs to, and nothing is changed.

    Files of the active and the proposed versions that are missing or altered are put back; those of a retired version
    when it becomes active again.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder):
            tables = store.tables(machine, figures=False)
            _check_pointer(folder, tables)
            _remove_leftovers(folder)
            for table in tables:
                wanted = folder / version_name(table)
                if table.state == "active" or (table.state == "retired" and not wanted.exists()):
                    _complete(store, machine, table, wanted)
            active = next((table for table in tables if table.state == "active"), None)
            _point(folder, active)
            _propose(store, machine, tables, folder / PROPOSED)
        return active
    except OSError as error:
        raise InputError(f"the tables cannot be written: {error.strerror or error}", file=folder) from error


def version_name(table: TableRecord) -> str:
    """Return the name of the folder of a version."""
    return f"v{table.version:04d}"


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes out; the system gives the lock back whatever happens to this one."""
    with (folder / ".lock").open("a") as stream:
        try:
            import fcntl
        except ImportError:  # a system without such locks
            yield
            return
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            logs.warning("waiting for another process that works in this folder", folder=str(folder))
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield


def _remove_leftovers(folder: Path) -> None:
    """Remove what a process that was killed left behind; nobody else works here now."""
    for path in [*folder.glob(".*.tmp"), *(folder / PROPOSED).glob(".*.tmp")]:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _contents(store: Store, machine: MachineRecord, table: TableRecord) -> dict[str, bytes]:
    """Return the files of a version by name; with several controls each has its own sub-folder."""
    several = len(table.controllers) > 1
    files = {f"{f.controller}/{f.name}" if several else f.name: f.content for f in store.table_files(table)}
    measurement = store.measurement_behind(table)
    about = {
        "machine": machine.name,
        "version": table.version,
        "made_at": table.at.isoformat(),
        "measurement": {"name": measurement.name, "sha256": measurement.sha256},
        "measured_at": measurement.measured_at.isoformat(),
        "reasons": list(table.reasons),
    }
    files["version.json"] = (json.dumps(about, indent=2) + "\n").encode()
    return files


def _complete(store: Store, machine: MachineRecord, table: TableRecord, target: Path) -> None:
    """Make the folder of one version, or put back what is missing or altered in it."""
    contents = _contents(store, machine, table)
    if not target.exists():
        _make(target, contents)
        return
    for name, content in contents.items():
        path = target / name
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


def _check_pointer(folder: Path, tables: Sequence[TableRecord]) -> None:
    """Leave tables that are active on the machine alone where the store is empty, older, or that of something else."""
    pointer = folder / POINTER
    known = {version_name(table) for table in tables if table.state in ("active", "retired")}
    if pointer.is_symlink() and os.readlink(pointer) not in known:
        raise InputError(
            f"leads to {os.readlink(pointer)}, which was never active by this store, so it is not the store of this "
            "folder; give the right store, restore its backup, or remove the pointer",
            file=pointer,
        )


def _point(folder: Path, active: TableRecord | None) -> None:
    """Swap the pointer in one step."""
    pointer = folder / POINTER
    if active is None:
        pointer.unlink(missing_ok=True)
    elif not pointer.is_symlink() or os.readlink(pointer) != version_name(active):
        temporary = folder / f".{POINTER}.tmp"
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(version_name(active), target_is_directory=True)
        temporary.replace(pointer)
    _sync(folder)


def _propose(store: Store, machine: MachineRecord, tables: Sequence[TableRecord], folder: Path) -> None:
    closed = [table for table in tables if table.state in ("held", "refused")][:-KEPT]
    wanted = {
        f"{PREFIX[table.state]}{version_name(table)}": table
        for table in tables
        if table.state in PREFIX and table not in closed
    }
    if not wanted and not folder.exists():
        return
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        if path.name not in wanted and path.is_dir():
            gone = path.with_name(f".{path.name}.tmp")  # renamed first: nobody sees half of it
            path.rename(gone)
            shutil.rmtree(gone, ignore_errors=True)
    for name, table in wanted.items():
        _complete(store, machine, table, folder / name)


def _sync(folder: Path) -> None:
    """Make the names in a folder last through a power failure, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
