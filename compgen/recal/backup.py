"""Backup and restore: all rows of a store into a new SQLite file and back, whatever the database; also to move a store."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import sqlalchemy as sa

from compgen.core.files import working_folder
from compgen.errors import InputError
from compgen.recal import schema
from compgen.recal.database import StoreError, first_line, retried, shown
from compgen.recal.store import Store, inflated, open_store

#: Rows that are held in memory at once.
ROWS = 200
MAGIC = b"SQLite format 3\0"
#: How a file system says that it knows no links.
NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS)


def backup(url: str, path: Path) -> dict[str, int]:
    """Write a copy of the store to a new file as it is at one moment; return the number of rows by table.

    Raises
    ------
    InputError
        if the file exists or cannot be written.
    StoreError
        if contents are damaged: a copy of them would be found out when it is needed.
    """
    if path.exists():
        raise InputError("exists already; a backup is never written over another one", file=path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        source = open_store(url)
        target = open_store(f"sqlite:///{temporary}")
        try:
            counts = _copy(source, target)
            retried(lambda: _make_one_file(target), target.url)
        finally:
            source.close()
            target.close()
        _publish(temporary, path)
        return counts
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", file=path) from error
    finally:
        for left in (temporary, *(temporary.with_name(temporary.name + end) for end in ("-wal", "-shm", "-journal"))):
            left.unlink(missing_ok=True)


def _make_one_file(store: Store) -> None:
    """Leave nothing in the write-ahead log."""
    with store.engine.connect() as connection:
        connection.exec_driver_sql("COMMIT")
        connection.exec_driver_sql("PRAGMA journal_mode = DELETE")


def _publish(temporary: Path, path: Path) -> None:
    """Give the file its name; never over another one that came meanwhile, where the file system can promise that."""
    try:
        os.link(temporary, path)
    except OSError as error:
        if error.errno not in NO_LINKS or path.exists():
            raise
        temporary.rename(path)


def restore(path: Path, url: str) -> dict[str, int]:
    """Fill an empty store from a backup, which stays as it is; return the number of rows by table.

    Raises
    ------
    InputError
        if there is no such backup, or the store holds something already.
    StoreError
        if contents of the backup are damaged.
    """
    if not path.is_file():
        raise InputError("no such backup", file=path)
    with working_folder("restore-") as folder:
        # a backup of an older program is upgraded, and may be on a read-only medium
        copy = folder / "copy.sqlite"
        try:
            with path.open("rb") as stream:
                if stream.read(len(MAGIC)) != MAGIC:
                    raise InputError("is not a backup (written by `volcomp recal backup`)", file=path)
            shutil.copyfile(path, copy)
        except OSError as error:
            raise InputError(f"cannot be copied: {error.strerror or error}", file=path) from error
        return _filled(url, copy)


def _filled(url: str, copy: Path) -> dict[str, int]:
    target = open_store(url)
    try:
        source = open_store(f"sqlite:///{copy}")
        try:
            if target.machines():
                raise InputError(f"the store {shown(url)} holds machines already; restore into a new one")
            return _copy(source, target)
        finally:
            source.close()
    finally:
        target.close()


def _copy(source: Store, target: Store) -> dict[str, int]:
    """Copy all rows as they were at one moment, in one transaction."""
    try:
        reading = source.engine.connect().execution_options(reading=True)
        if source.engine.dialect.name == "postgresql":
            reading = reading.execution_options(isolation_level="REPEATABLE READ")
        with reading, target.engine.begin() as writing:
            return {table.name: _copy_table(reading, writing, table) for table in schema.ALL}
    except sa.exc.DBAPIError as error:
        place = f"{shown(source.url)} to {shown(target.url)}"
        raise StoreError(f"nothing was copied from {place}: {first_line(error)}") from error


def _copy_table(reading: sa.Connection, writing: sa.Connection, table: sa.Table) -> int:
    count = 0
    keys = [table.c.id] if "id" in table.c else list(table.primary_key)
    rows = reading.execution_options(yield_per=ROWS).execute(sa.select(table).order_by(*keys))
    for part in rows.partitions(ROWS):
        if table is schema.blobs:
            for row in part:
                inflated(row.sha256, row.deflated)
        writing.execute(sa.insert(table), [dict(row._mapping) for row in part])
        count += len(part)
    if writing.dialect.name == "postgresql" and "id" in table.c and count:
        sequence = sa.func.pg_get_serial_sequence(table.name, "id")
        writing.execute(sa.select(sa.func.setval(sequence, sa.select(sa.func.max(table.c.id)).scalar_subquery())))
    return count
