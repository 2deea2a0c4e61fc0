"""Backup and restore: all rows of a store into a new SQLite file and back, whatever the database; also to move a store."""

from __future__ import annotations

import os
from pathlib import Path

import sqlalchemy as sa

from compgen.errors import InputError
from compgen.recal import schema
from compgen.recal.database import StoreError, retried, shown
from compgen.recal.store import Store, open_store

#: Rows that are held in memory at once.
ROWS = 200


def backup(url: str, path: Path) -> dict[str, int]:
    """Write a copy of the store to a new file as it is at one moment; return the number of rows by table.

    Raises
    ------
    InputError
        if the file exists or cannot be written.
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
            with target.engine.connect() as connection:  # one file: nothing stays in the write-ahead log
                connection.exec_driver_sql("COMMIT")
                connection.exec_driver_sql("PRAGMA journal_mode = DELETE")
        finally:
            source.close()
            target.close()
        os.link(temporary, path)  # unlike a rename it never replaces a file that came meanwhile
        return counts
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", file=path) from error
    finally:
        for left in (temporary, *(temporary.with_name(temporary.name + end) for end in ("-wal", "-shm", "-journal"))):
            left.unlink(missing_ok=True)


def restore(path: Path, url: str) -> dict[str, int]:
    """Fill an empty store from a backup; return the number of rows by table.

    Raises
    ------
    InputError
        if there is no such backup, or the store holds something already.
    """
    if not path.is_file():
        raise InputError("no such backup", file=path)
    if path.read_bytes()[:16] != b"SQLite format 3\0":
        raise InputError("is not a backup (written by `compgen recal backup`)", file=path)
    target = open_store(url)
    source = open_store(f"sqlite:///{path}")
    try:
        if target.machines():
            raise InputError(f"the store {shown(url)} holds machines already; restore into a new one")
        return _copy(source, target)
    finally:
        source.close()
        target.close()


def _copy(source: Store, target: Store) -> dict[str, int]:
    """Copy all rows as they were at one moment, in one transaction."""

    def action() -> dict[str, int]:
        reading = source.engine.connect().execution_options(reading=True)
        if source.engine.dialect.name == "postgresql":
            reading = reading.execution_options(isolation_level="REPEATABLE READ")
        with reading, target.engine.begin() as writing:
            return {table.name: _copy_table(reading, writing, table) for table in schema.ALL}

    try:
        return retried(action, source.url)
    except sa.exc.IntegrityError as error:
        raise StoreError(f"the store {shown(target.url)} does not take the rows: {error.orig}") from error


def _copy_table(reading: sa.Connection, writing: sa.Connection, table: sa.Table) -> int:
    count = 0
    keys = [table.c.id] if "id" in table.c else list(table.primary_key)
    rows = reading.execution_options(yield_per=ROWS).execute(sa.select(table).order_by(*keys))
    for part in rows.partitions(ROWS):
        writing.execute(sa.insert(table), [dict(row._mapping) for row in part])
        count += len(part)
    if writing.dialect.name == "postgresql" and "id" in table.c and count:
        sequence = sa.func.pg_get_serial_sequence(table.name, "id")
        writing.execute(sa.select(sa.func.setval(sequence, sa.select(sa.func.max(table.c.id)).scalar_subquery())))
    return count
