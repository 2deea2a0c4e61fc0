"""The store: machines, measurements, identified errors, tables and decisions; rows are only added.

Open it with :func:`open_store`. Decisions are in :mod:`compgen.fleet.decisions`; leases, and what the processing of a
measurement adds, are in :mod:`compgen.fleet.claims`.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import sqlite3
import time
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from copy import copy
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import sqlalchemy as sa

from compgen.data.error_table import ErrorTable, parse_errors
from compgen.data.files import decoded, folder_beside, name_problem, sha256_of, working_folder
from compgen.data.machine import Machine, parse_machine
from compgen.errors import CompgenError, InputError
from compgen.fleet import database
from compgen.fleet.database import StoreError, engine_of, first_line, inserted, put_blobs, retried, shown, upgrade
from compgen.fleet.records import (
    EVIDENCE,
    RESTORED,
    AttemptRecord,
    DecisionRecord,
    EventRecord,
    EvidenceRecord,
    IdentificationRecord,
    MachineRecord,
    MeasurementRecord,
    NewMeasurement,
    StoredTableFile,
    TableRecord,
    state_of,
)
from compgen.identification.covariance import Covariance, parse_covariance

Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")
Clock = Callable[[], datetime]

# Queries that every pass over a machine makes, each built once: building one takes longer than running it. Their
# parameters are named after the arguments of ``Store._rows``.

_MACHINE = sa.select(database.machines).where(database.machines.c.name == sa.bindparam("name"))
_BLOB = sa.select(database.blobs.c.deflated).where(database.blobs.c.sha256 == sa.bindparam("sha256"))
_PRIORS: sa.Select[Any] = sa.select(database.identifications.c.id, database.PRIOR_CLASS)
_ATTEMPTS: sa.Select[Any] = sa.select(database.attempts).order_by(database.attempts.c.id)
_EVENTS: sa.Select[Any] = sa.select(database.events).order_by(database.events.c.id)
_DECISIONS: sa.Select[Any] = sa.select(database.decisions).order_by(
    database.decisions.c.machine_id, database.decisions.c.sequence
)
_MEASUREMENTS: sa.Select[Any] = sa.select(database.measurements).order_by(
    database.measurements.c.measured_at, database.measurements.c.id
)
#: Measurement, name and SHA-256 of its files, of all machines; the second can be restricted to some measurements.
_FILES: sa.Select[Any] = sa.select(
    *(database.measurement_files.c[name] for name in ("measurement_id", "name", "sha256"))
).order_by(database.measurement_files.c.id)
_FILES_OF = _FILES.join(
    database.measurements, database.measurements.c.id == database.measurement_files.c.measurement_id
)
#: Identifications, each with the time of its measurement.
_IDENTIFICATIONS: sa.Select[Any] = sa.select(database.identifications, database.measurements.c.measured_at).join(
    database.measurements, database.measurements.c.id == database.identifications.c.measurement_id
)
#: Number of each identification and of its measurement.
_MEASURED: sa.Select[Any] = sa.select(database.identifications.c.id, database.identifications.c.measurement_id)
#: Sets of tables with and without their figures.
_TABLES: dict[bool, sa.Select[Any]] = {
    figures: sa.select(*(column for column in database.tables.c if figures or column.name != "summary")).order_by(
        database.tables.c.machine_id, database.tables.c.version
    )
    for figures in (True, False)
}
_TABLE_FILES: sa.Select[Any] = sa.select(
    *(database.table_files.c[name] for name in ("table_id", "controller", "name", "sha256"))
).join(database.tables, database.tables.c.id == database.table_files.c.table_id)


@lru_cache(maxsize=64)
def _where(query: sa.Select[Any], table: sa.Table, *columns: str) -> sa.Select[Any]:
    """Restrict a query to given values of columns of ``table``, which are the parameters ``machine`` and so on."""
    return query.where(*(table.c[name] == sa.bindparam(name.removesuffix("_id")) for name in columns))


def at_one_moment(
    function: Callable[Concatenate[Store, Arguments], Result],
) -> Callable[Concatenate[Store, Arguments], Result]:
    """Let a function whose first argument is the store read from one snapshot (:meth:`Store.together`)."""

    @wraps(function)
    def wrapper(store: Store, /, *args: Arguments.args, **options: Arguments.kwargs) -> Result:
        return store.together(lambda moment: function(moment, *args, **options))

    return wrapper


def read_once(
    function: Callable[Concatenate[Store, Arguments], Result],
) -> Callable[Concatenate[Store, Arguments], Result]:
    """As :func:`at_one_moment`, for a method with plain arguments: repeated reads of a snapshot are fetched once."""

    @wraps(function)
    def wrapper(store: Store, /, *args: Arguments.args, **options: Arguments.kwargs) -> Result:
        def action(moment: Store) -> Result:
            assert moment._moment is not None
            key, known = (function, args, *sorted(options.items())), moment._moment.known
            if key not in known:
                known[key] = function(moment, *args, **options)
            return copy(cast(Result, known[key]))

        return store.together(action)

    return wrapper


@dataclass(frozen=True)
class _Moment:
    """The connection through which a store is read as it was at one moment, and what was read through it."""

    connection: sa.Connection
    known: dict[Any, Any] = field(default_factory=dict)


class Store:
    """An open store; every method is one transaction. ``clock`` is for tests.

    Methods raise StoreError once the file of an SQLite store has been moved, removed, replaced or overwritten: data
    written to an open file without a path are lost, and data written to another store corrupt both.
    """

    def __init__(self, engine: sa.Engine, url: str, clock: Clock | None = None, number: int = 0) -> None:
        self.engine, self.url, self._clock = engine, url, clock
        self._moment: _Moment | None = None
        self._file = _StoreFile(Path(str(engine.url.database)), number) if engine.dialect.name == "sqlite" else None

    def close(self) -> None:
        """Close the connections."""
        self.engine.dispose()

    def now(self, connection: sa.Connection | None = None) -> datetime:
        """Return the time used for leases: from the PostgreSQL server, or from this computer."""
        if self._clock is not None:
            return self._clock()
        if self.engine.dialect.name != "postgresql":
            return datetime.now(UTC)
        if connection is None:
            return self.read(self.now)
        found: datetime = connection.execute(sa.select(sa.func.clock_timestamp())).scalar_one()
        return found.astimezone(UTC)

    def read(self, action: Callable[[sa.Connection], Result]) -> Result:
        """Run ``action`` in a read-only transaction; retry while the store cannot be reached."""

        def once() -> Result:
            self._check_file()
            with self.engine.connect().execution_options(reading=True) as connection:
                return action(connection)

        try:
            return retried(once, self.url) if self._moment is None else action(self._moment.connection)
        except (CompgenError, UnicodeDecodeError):
            raise
        except ValueError as error:  # invalid time or JSON
            raise StoreError(f"the store {shown(self.url)} is damaged: {error}; restore a backup") from error

    def snapshot(self) -> sa.Connection:
        """Return a read-only connection that sees a snapshot of the store."""
        connection = self.engine.connect().execution_options(reading=True)
        if self.engine.dialect.name == "postgresql":
            return connection.execution_options(isolation_level="REPEATABLE READ")
        return connection

    def together(self, action: Callable[[Store], Result]) -> Result:
        """Run ``action`` with this store as it is at one moment: everything that it reads from that one is consistent."""
        if self._moment is not None:
            return action(self)

        def once() -> Result:
            self._check_file()
            with self.snapshot() as connection:
                moment = copy(self)
                moment._moment = _Moment(connection)
                return action(moment)

        return retried(once, self.url)

    def write(self, action: Callable[[sa.Connection], Result]) -> Result:
        """Run ``action`` in a transaction, all or nothing; retry while the store cannot be reached."""

        def once() -> Result:
            self._check_file()
            with self.engine.begin() as connection:
                found = action(connection)
                self._check_file()  # again, right before the commit
                return found

        return retried(once, self.url)

    def _check_file(self) -> None:
        """Raise StoreError unless the path still refers to the store that was opened."""
        if self._file is not None and not self._file.is_same():
            raise StoreError(
                f"the store {shown(self.url)} was moved, removed or replaced while it was open; nothing was written: "
                "put the file back, or start again with the right one"
            )

    def version(self) -> tuple[object, ...]:
        """Return a value that changes with every change of the store: earlier reads are valid while it is equal.

        Rows are only added. SQLite numbers them in the order in which they take effect; on PostgreSQL a lower number
        may come later, so the rows are counted as well.
        """
        counted = self.engine.dialect.name == "postgresql"
        tables = [table for table in database.ALL if "id" in table.c and table is not database.claims]
        columns = [sa.select(sa.func.max(table.c.id)).scalar_subquery() for table in tables]
        columns += [sa.select(sa.func.count()).select_from(table).scalar_subquery() for table in tables if counted]
        return tuple(self.read(lambda connection: connection.execute(sa.select(*columns)).one()))

    # --- machines ---------------------------------------------------------------------------------------------------

    def add_machine(self, name: str) -> MachineRecord:
        """Return the machine ``name``, added if not known."""
        found = self.read(lambda connection: _machine_named(connection, name))
        if found is not None:
            return found
        problem = name_problem(name, [item.name for item in self.machines()])
        if problem is not None:  # two job files may share a store
            raise InputError(f"the store cannot add a machine {name!r}: it {problem}")
        with suppress(sa.exc.IntegrityError):  # another process was faster
            self.write(lambda c: c.execute(sa.insert(database.machines), {"name": name, "at": self.now(c)}))
        return self.machine(name)

    def machine(self, name: str) -> MachineRecord:
        """Return the machine ``name``; InputError if the store does not know it."""
        found = self.read(lambda connection: _machine_named(connection, name))
        if found is None:
            raise InputError(f"the store has no machine {name!r}; it is added by its first `volcomp recal run`")
        return found

    def machines(self) -> list[MachineRecord]:
        """Return all machines by name."""
        query = sa.select(database.machines).order_by(database.machines.c.name)
        return [MachineRecord(*row) for row in self._rows(query)]

    def machine_of(self, identification: IdentificationRecord) -> Machine:
        """Return the machine as described by its file when the errors were identified."""
        table = database.machine_versions
        query = sa.select(table.c.sha256).where(table.c.id == identification.machine_version_id)
        content = self.blob(self.read(lambda c: c.execute(query).scalar_one()))
        return parse_machine(decoded(content, "machine.toml"), Path("machine.toml"))

    # --- measurements -----------------------------------------------------------------------------------------------

    def add_measurement(self, machine: MachineRecord, new: NewMeasurement) -> MeasurementRecord:
        """Store a measurement with its contents and return it; the same contents are stored once."""
        known = self.find_measurement(machine, new.sha256)
        if known is not None:
            return known
        with suppress(sa.exc.IntegrityError):  # another process was faster
            self.write(lambda c: _insert_measurement(c, machine.id, new, self.now(c)))
        found = self.find_measurement(machine, new.sha256)
        if found is None:
            raise StoreError(f"measurement {new.name} cannot be stored in {shown(self.url)}")
        return found

    def find_measurement(self, machine: MachineRecord, sha256: str) -> MeasurementRecord | None:
        """Return the machine's measurement with this hash, or None."""
        return next(iter(self.measurements(machine, sha256=sha256)), None)

    @read_once
    def measurements(
        self, machine: MachineRecord | None = None, *, sha256: str | None = None
    ) -> list[MeasurementRecord]:
        """Return the measurements of a machine (or of all) in the order of measurement."""
        table = database.measurements
        columns = [name for name, value in (("machine_id", machine), ("sha256", sha256)) if value is not None]
        values = {} if sha256 is None else {"sha256": sha256}
        files: dict[int, list[tuple[str, str]]] = {}
        inner = _where(_FILES_OF, table, *columns) if columns else _FILES
        for measurement_id, name, digest in self._rows(inner, machine, **values):
            files.setdefault(measurement_id, []).append((name, digest))
        rows = self._rows(_where(_MEASUREMENTS, table, *columns), machine, **values)
        return [MeasurementRecord(**row._mapping, files=tuple(files.get(row.id, ()))) for row in rows]

    def contents_of(self, measurement: MeasurementRecord) -> dict[str, bytes]:
        """Return the contents of a measurement's files by name."""
        return {name: self.blob(digest) for name, digest in measurement.files}

    @at_one_moment
    def measurement_behind(self, machine: MachineRecord, table: TableRecord) -> MeasurementRecord:
        """Return the measurement from which a machine's set of tables was made."""
        behind = self.measured(machine)[table.identification_id]
        return next(item for item in self.measurements(machine) if item.id == behind)

    def same_tables_of_others(self, machine: MachineRecord, digests: Collection[str]) -> list[tuple[str, int]]:
        """Return (machine, version) of tables of other machines with files of these SHA-256 that no tables of this one have."""
        files, tables = database.table_files, database.tables
        query = sa.select(files.c.sha256, tables.c.machine_id, database.machines.c.name, tables.c.version)
        query = query.join(tables, tables.c.id == files.c.table_id)
        query = query.join(database.machines, database.machines.c.id == tables.c.machine_id)
        rows = self._rows(query.where(files.c.sha256.in_(set(digests))).order_by(tables.c.id))
        own = {row.sha256 for row in rows if row.machine_id == machine.id}
        return [(row.name, row.version) for row in rows if row.sha256 not in own and row.machine_id != machine.id]

    def same_files_of_others(self, machine: MachineRecord, measurement: MeasurementRecord) -> list[tuple[str, str]]:
        """Return (machine, measurement in words) of other machines that also received one of the measurement's files.

        Measurements that a person rejected there do not count: this is how a file is withdrawn from the wrong machine.
        """
        files, measured, found = database.measurement_files, database.measurements, database.identifications
        own = {digest for _, digest in measurement.files}
        query = sa.select(
            measured.c.id, measured.c.machine_id, measured.c.name, database.machines.c.name.label("machine")
        )
        query = query.join(files, files.c.measurement_id == measured.c.id)
        query = query.join(database.machines, database.machines.c.id == measured.c.machine_id)
        query = query.where(files.c.sha256.in_(own), measured.c.machine_id != machine.id)
        others: list[tuple[str, str]] = []
        for row in self._rows(query.distinct().order_by(measured.c.id)):
            made = sa.select(database.tables.c.version, database.tables.c.id).join(
                found, found.c.id == database.tables.c.identification_id
            )
            versions = {key: version for version, key in self._rows(made.where(found.c.measurement_id == row.id))}
            decided = self.decisions(self.machine(row.machine)) if versions else []
            states = {version: state_of(key, decided) for key, version in versions.items()}
            if states and all(state in ("rejected", "refused") for state in states.values()):
                continue
            said = ", ".join(f"version {version} is {state}" for version, state in states.items())
            others.append((row.machine, said or f"measurement {row.id}, {row.name}"))
        return others

    @read_once
    def measured(self, machine: MachineRecord) -> dict[int, int]:
        """Return the id of the measurement behind each of the machine's identifications, by its id."""
        query = _where(_MEASURED, database.identifications, "machine_id")
        return {identification: measurement for identification, measurement in self._rows(query, machine)}

    @at_one_moment
    def newest_entry(self, machine: MachineRecord) -> datetime | None:
        """Return the time of the last measurement received or decision made for the machine, None if there is none."""
        times = [item.received_at for item in self.measurements(machine)]
        return max(times + [item.at for item in self.decisions(machine)], default=None)

    @read_once
    def attempts(self, machine: MachineRecord | None = None) -> list[AttemptRecord]:
        """Return all attempts to process measurements, oldest first."""
        return [AttemptRecord(*row) for row in self._of_machine(_ATTEMPTS, database.attempts, machine)]

    # --- identified errors and tables -------------------------------------------------------------------------------

    def identifications(self, machine: MachineRecord | None = None) -> list[IdentificationRecord]:
        """Return the identified errors of a machine (or of all) in the order of measurement."""
        rows = self._of_machine(_IDENTIFICATIONS, database.identifications, machine)
        found = [IdentificationRecord(**row._mapping) for row in rows]
        return sorted(found, key=lambda item: (item.measured_at, item.id))

    def without_prior(self, machine: MachineRecord | None = None) -> set[int]:
        """Return the ids of identifications without a prior (:func:`compgen.fleet.records.has_prior`)."""
        return {
            key
            for key, name in self._of_machine(_PRIORS, database.identifications, machine)
            if name in database.NO_PRIOR
        }

    def identification(self, identification_id: int) -> IdentificationRecord:
        """Return the identified errors with this id."""
        rows = self._rows(_where(_IDENTIFICATIONS, database.identifications, "id"), id=identification_id)
        if not rows:
            raise InputError(f"the store has no identification {identification_id}")
        return IdentificationRecord(**rows[0]._mapping)

    def errors_of(self, identification: IdentificationRecord, *, fitted: bool = False) -> ErrorTable:
        """Return the identified errors of the bare machine (or the fitted ones), mm and rad."""
        digest = identification.fitted_sha256 if fitted else identification.errors_sha256
        if digest is None:
            raise InputError("this identification contains no fitted errors")
        return parse_errors(decoded(self.blob(digest), "identified.errors.csv"), Path("identified.errors.csv"))

    def covariance_of(self, identification: IdentificationRecord) -> Covariance | None:
        """Return the joint covariance of the identified errors, None if there is none."""
        if identification.covariance_sha256 is None:
            return None
        return parse_covariance(self.blob(identification.covariance_sha256), Path("identified.covariance.npz"))

    @read_once
    def tables(self, machine: MachineRecord | None = None, *, figures: bool = True) -> list[TableRecord]:
        """Return the sets of tables of a machine (or of all) by version, with their states.

        Without ``figures`` their summaries stay empty, which saves much time for the whole fleet.
        """
        decided: dict[int, list[DecisionRecord]] = {}
        for decision in self.decisions(machine):
            decided.setdefault(decision.machine_id, []).append(decision)
        found = []
        for row in self._of_machine(_TABLES[figures], database.tables, machine):
            state = state_of(row.id, decided.get(row.machine_id, []))
            found.append(TableRecord(**{"summary": {}, **row._mapping}, state=state))
        return found

    def table_files(self, table: TableRecord) -> list[StoredTableFile]:
        """Return the files of a set of tables, byte for byte; StoreError if any is missing or damaged."""
        return self.read(lambda connection: files_of(connection, table.id))

    @read_once
    def file_hashes(self, machine: MachineRecord) -> dict[int, list[tuple[str, str, str]]]:
        """Return control, name and SHA-256 of the files of a machine's sets of tables, by id, in a fixed order."""
        found: dict[int, list[tuple[str, str, str]]] = {}
        for table_id, *file in self._of_machine(_TABLE_FILES, database.tables, machine):
            found.setdefault(table_id, []).append((file[0], file[1], file[2]))
        return {table_id: sorted(listed) for table_id, listed in found.items()}

    @read_once
    def decisions(self, machine: MachineRecord | None = None) -> list[DecisionRecord]:
        """Return all decisions in order: who, what, when, why."""
        return [DecisionRecord(*row) for row in self._of_machine(_DECISIONS, database.decisions, machine)]

    # --- events and contents ----------------------------------------------------------------------------------------

    def add_event(self, kind: str, subject: str, message: str, machine: MachineRecord | None = None) -> bool:
        """Store an event unless the last of this machine, kind and subject is the same; return whether it is new."""
        table, machine_id, message = database.events, None if machine is None else machine.id, database.plain(message)
        same = sa.and_(
            table.c.machine_id.is_not_distinct_from(machine_id), table.c.kind == kind, table.c.subject == subject
        )
        query = sa.select(table.c.message).where(same).order_by(table.c.id.desc()).limit(1)

        def insert(connection: sa.Connection) -> bool:
            if connection.execute(query).scalar() == message:
                return False
            row = {"machine_id": machine_id, "kind": kind, "subject": subject, "message": message}
            connection.execute(sa.insert(table).values(**row, at=self.now(connection)))
            return True

        return False if self.read(lambda c: c.execute(query).scalar()) == message else self.write(insert)

    def events(self, machine: MachineRecord | None = None) -> list[EventRecord]:
        """Return the events of a machine (or all), oldest first."""
        return [EventRecord(*row) for row in self._of_machine(_EVENTS, database.events, machine)]

    def add_evidence(
        self,
        machine: MachineRecord,
        measurement: MeasurementRecord,
        files: Mapping[str, tuple[bytes, datetime]],
        source: str,
    ) -> EvidenceRecord:
        """Store a backup of the control, contents and times of its files by name, as evidence for a measurement."""

        def action(connection: sa.Connection) -> EvidenceRecord:
            digests = put_blobs(connection, [content for content, _ in files.values()])
            listed = [
                [database.plain(name), digest, time.isoformat()]
                for (name, (_, time)), digest in zip(files.items(), digests, strict=True)
            ]
            row = {"machine_id": machine.id, "kind": EVIDENCE, "subject": f"measurement {measurement.id}"}
            text, now = json.dumps({"source": source, "files": listed}), self.now(connection)
            connection.execute(sa.insert(database.events).values(**row, message=text, at=now))
            return EvidenceRecord(measurement.id, source, tuple((a, b, c) for a, b, c in listed), now)

        return self.write(action)

    def evidence(self, machine: MachineRecord) -> list[EvidenceRecord]:
        """Return the backups that came with measurements of a machine, oldest first; the last of a measurement counts."""
        return [evidence_in(event) for event in self.events(machine) if event.kind == EVIDENCE]

    def blob(self, sha256: str) -> bytes:
        """Return contents by their SHA-256; StoreError if they are damaged."""
        return inflated(sha256, self.read(lambda connection: connection.execute(_BLOB, {"sha256": sha256}).scalar()))

    def _of_machine(self, query: sa.Select[Any], table: sa.Table, machine: MachineRecord | None) -> list[Any]:
        """Rows of a query that belong to a machine, by the column of ``table``, or to all."""
        return self._rows(query if machine is None else _where(query, table, "machine_id"), machine)

    def _rows(self, query: sa.Select[Any], machine: MachineRecord | None = None, **values: object) -> list[Any]:
        """Rows of a query with its parameters."""
        given = values if machine is None else {"machine": machine.id, **values}
        return self.read(lambda connection: list(connection.execute(query, given).all()))


class _StoreFile:
    """The file of an SQLite store as it was opened, to detect whether another file has replaced it.

    A copy may also be written over it (``cp``), which keeps its inode. Every file, also a backup, has a unique number;
    and rows are only added to a store, so earlier rows must still be there unchanged, unlike in an older raw copy. The
    file is inspected when its time stamp or size changes.
    """

    #: Tables whose newest rows are compared.
    TABLES = ("measurements", "decisions", "events")

    def __init__(self, path: Path, number: int) -> None:
        self._path, self._number = path, number
        self._place, self._written = self._look()
        self._rows: dict[str, Any] = {}
        self._has_rows()

    def is_same(self) -> bool:
        """Whether the path refers to the file that was opened, and this still contains its earlier rows."""
        place, written = self._look()
        if place != self._place:
            return False
        if written == self._written:
            return True
        same = self._has_rows()
        if same:
            self._written = written
        return same is not False

    def _look(self) -> tuple[Any, Any]:
        try:
            found = os.stat(self._path)
        except OSError:
            return None, None
        return (found.st_dev, found.st_ino), (found.st_mtime_ns, found.st_size)

    def _has_rows(self) -> bool | None:
        """Whether the known rows are in the file itself; None if this cannot be determined while it is being written.

        The file is read without its write-ahead log, and through SQLite: opening and closing it in another way would
        release the locks of this process.
        """
        if self._written is None:
            return None
        newest = {}
        try:
            address = f"{self._path.absolute().as_uri()}?mode=ro&immutable=1"
            with closing(sqlite3.connect(address, uri=True)) as connection:
                number = connection.execute("PRAGMA user_version").fetchone()[0]
                if number not in (0, self._number):  # 0: still in the log
                    return False
                if connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0:
                    return not self._rows  # a new store whose tables are still in the log
                for table in self.TABLES:
                    known = self._rows.get(table)
                    query = f"SELECT * FROM {table} WHERE id = ?"
                    if known is not None:
                        found = connection.execute(query, known[:1]).fetchone()
                        if found is None or found[: len(known)] != known:  # a newer program may have added columns
                            return False
                    newest[table] = connection.execute(f"SELECT * FROM {table} ORDER BY id DESC LIMIT 1").fetchone()
        except sqlite3.DatabaseError as error:
            return False if error.sqlite_errorcode == sqlite3.SQLITE_NOTADB else None
        self._rows = {table: row for table, row in newest.items() if row is not None}
        return True


def evidence_in(event: EventRecord) -> EvidenceRecord:
    """Return the evidence that an event of kind ``EVIDENCE`` records."""
    said = json.loads(event.message)
    files = tuple((str(name), str(digest), str(time)) for name, digest, time in said["files"])
    return EvidenceRecord(int(event.subject.split()[1]), str(said["source"]), files, event.at)


def files_of(connection: sa.Connection, table_id: int) -> list[StoredTableFile]:
    """Return the files of a set of tables, byte for byte; StoreError if any is missing or damaged."""
    files, blobs = database.table_files, database.blobs
    query = sa.select(files.c.controller, files.c.name, files.c.sha256, blobs.c.deflated)
    query = query.join(blobs, blobs.c.sha256 == files.c.sha256, isouter=True).where(files.c.table_id == table_id)
    rows = connection.execute(query.order_by(files.c.id)).all()
    return [StoredTableFile(controller, name, inflated(digest, packed)) for controller, name, digest, packed in rows]


def inflated(sha256: str, packed: bytes | None) -> bytes:
    """Return contents as they were stored; StoreError unless they match this SHA-256."""
    try:
        content = zlib.decompress(packed or b"")
    except zlib.error:
        content = b""
    if sha256_of(content) != sha256:
        raise StoreError(f"the contents {sha256[:12]}... are missing or damaged in the store; restore a backup")
    return content


def open_store(url: str, *, clock: Clock | None = None) -> Store:
    """Open a store; create it if it does not exist, upgrade it if it is old.

    Parameters
    ----------
    url : ``sqlite:///FILE``, a bare path, or ``postgresql://USER:PASSWORD@HOST/NAME``.
    clock : for tests: the time, with its time zone.

    Raises
    ------
    InputError
        for an invalid URL, or a store of a newer program.
    StoreError
        if it cannot be reached after several attempts.
    """
    engine = engine_of(url)
    if engine.dialect.name == "sqlite":
        _make_file(Path(str(engine.url.database)), url)
    number = retried(lambda: upgrade(engine), url)
    return Store(engine, url, clock, number)


def _make_file(path: Path, url: str) -> None:
    """Make the file of a new SQLite store whole or not at all: a kill or a full disk leaves no empty file behind."""
    if os.path.lexists(path):
        return
    try:
        with _whole_file(path):
            pass
    except FileExistsError:  # another process was faster
        return
    except OSError as error:
        raise StoreError(f"the store {shown(url)} cannot be made: {error.strerror or error}") from error


def _machine_named(connection: sa.Connection, name: str) -> MachineRecord | None:
    row = connection.execute(_MACHINE, {"name": name}).first()
    return None if row is None else MachineRecord(*row)


def _insert_measurement(connection: sa.Connection, machine_id: int, new: NewMeasurement, now: datetime) -> None:
    values: Mapping[str, Any] = {
        "machine_id": machine_id,
        "sha256": new.sha256,
        "name": new.name,
        "measured_at": new.measured_at,
        "measured_at_source": new.measured_at_source,
        "received_at": now,
        "active_table": new.active_table,
        "temperatures_c": {name: dict(figures) for name, figures in new.temperatures_c.items()},
    }
    number = inserted(connection, database.measurements, values)
    digests = put_blobs(connection, new.contents.values())
    rows = [
        {"measurement_id": number, "name": name, "sha256": digest}
        for name, digest in zip(new.contents, digests, strict=True)
    ]
    connection.execute(sa.insert(database.measurement_files), rows)


@at_one_moment
def counting(store: Store, machine: MachineRecord) -> list[IdentificationRecord]:
    """Return the representative identification of each measurement, in the order of measurement.

    It is the one behind the active tables; else the newest whose tables nobody rejected and the round trip accepted;
    else the newest.
    """
    states = {table.identification_id: table.state for table in store.tables(machine, figures=False)}
    every: dict[int, list[IdentificationRecord]] = {}
    for item in store.identifications(machine):
        every.setdefault(item.measurement_id, []).append(item)

    def rank(item: IdentificationRecord) -> tuple[int, int]:
        state = states.get(item.id)
        return {"active": 2, "rejected": 0, "refused": 0}.get(state or "", 1), item.revision

    return [max(group, key=rank) for group in every.values()]


# Backup and restore: copy all rows of a store to a new SQLite file and back, for any database; also to move a store.


#: Rows in memory at once.
ROWS = 200
MAGIC = b"SQLite format 3\0"
#: A temporary file of an earlier version in which nothing has changed for this long belongs to no process, s.
LEFT_S = 86400.0
#: Error numbers of a file system that does not support links.
NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS)


def backup(url: str, path: Path) -> dict[str, int]:
    """Write a snapshot of the store to a new file; return the number of rows by table.

    Raises
    ------
    InputError
        if the file exists or cannot be written.
    StoreError
        if contents are damaged: otherwise the damage would only show when the copy is needed.
    """
    if path.exists():
        raise InputError("already exists; a backup never overwrites another one", file=path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_left(path.parent)
        with closing(open_store(url)) as source, _whole_file(path) as target:
            return _copy(source, target)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", file=path) from error


@contextmanager
def _whole_file(path: Path) -> Iterator[Store]:
    """Yield a new, empty SQLite store that gets its name when the block ends without an error; nothing is overwritten.

    If this process is killed, the next one that makes such a file in the folder removes what was made so far.

    Raises
    ------
    OSError
        if it cannot be written, or the file exists by then.
    """
    with folder_beside(path) as folder:
        made = folder / "store.sqlite"
        engine = engine_of(f"sqlite:///{made}")
        try:
            number = retried(lambda: upgrade(engine), str(path))
            yield Store(engine, str(path), None, number)
            retried(lambda: _end_log(engine), str(path))
        finally:
            engine.dispose()
        try:  # never overwrite a file created meanwhile, if the file system can guarantee that
            os.link(made, path)
        except OSError as error:
            if error.errno not in NO_LINKS or path.exists():
                raise
            made.rename(path)


def _end_log(engine: sa.Engine) -> None:
    """Leave nothing in the write-ahead log: the file alone is the store."""
    with engine.connect() as connection:
        connection.exec_driver_sql("COMMIT")
        connection.exec_driver_sql("PRAGMA journal_mode = DELETE")


def _remove_left(folder: Path) -> None:
    """Remove what earlier versions left of a backup when they were killed: old files named after their process."""
    with suppress(OSError):
        for path in folder.glob(".*.tmp*"):
            named = re.fullmatch(r"\..+\.[0-9]+\.tmp(-wal|-shm|-journal)?", path.name)
            if named and path.is_file() and not path.is_symlink() and time.time() - path.stat().st_mtime > LEFT_S:
                path.unlink()


def restore(path: Path, url: str, *, mark: bool = False) -> dict[str, int]:
    """Fill an empty store from a backup, which is not changed; return the number of rows by table.

    A new SQLite store gets its name when it is complete: a restore that is killed leaves none. With ``mark`` the history of
    every machine gets an event of kind ``RESTORED``, which is not counted: the store does not know what was decided, and
    loaded into the controls, after the backup.

    Raises
    ------
    InputError
        if there is no such backup, or the store is not empty.
    StoreError
        if contents of the backup are damaged.
    """
    if not path.is_file():
        raise InputError("no such backup", file=path)
    with working_folder("restore-") as folder:
        # a backup from an older program is upgraded, and may be on a read-only medium
        copy = folder / "copy.sqlite"
        try:
            with path.open("rb") as stream:
                if stream.read(len(MAGIC)) != MAGIC:
                    raise InputError("is not a backup (written by `volcomp recal backup`)", file=path)
            shutil.copyfile(path, copy)
        except OSError as error:
            raise InputError(f"cannot be copied: {error.strerror or error}", file=path) from error
        engine = engine_of(url)
        file = Path(str(engine.url.database)) if engine.dialect.name == "sqlite" else None
        with closing(open_store(f"sqlite:///{copy}")) as source:
            if file is None or os.path.lexists(file):
                with closing(open_store(url)) as target:
                    return _fill(source, target, path.name if mark else None)
            try:
                with _whole_file(file) as target:
                    return _fill(source, target, path.name if mark else None)
            except FileExistsError as error:
                raise InputError(f"the store {shown(url)} was made meanwhile; nothing was restored") from error
            except OSError as error:
                raise StoreError(f"the store {shown(url)} cannot be written: {error.strerror or error}") from error


def _fill(source: Store, target: Store, named: str | None) -> dict[str, int]:
    """Copy a store into an empty one; with the name of the backup every history says where it comes from."""
    if target.machines():
        raise InputError(f"the store {shown(target.url)} is not empty; restore into a new one")
    if named is None:
        return _copy(source, target)
    ends = [(machine.id, _last_entry(source, machine).isoformat()) for machine in source.machines()]
    text = f"the history comes from the backup {named}; what came later is not known"

    def note(writing: sa.Connection) -> None:
        common = {"kind": RESTORED, "message": text, "at": target.now(writing)}
        for machine_id, end in ends:
            writing.execute(sa.insert(database.events), {**common, "machine_id": machine_id, "subject": end})

    return _copy(source, target, note)


def _last_entry(store: Store, machine: MachineRecord) -> datetime:
    """Return the time of the last entry about a machine of any kind."""
    times = [machine.at, *(item.received_at for item in store.measurements(machine))]
    times += [item.at for item in store.decisions(machine)] + [item.at for item in store.events(machine)]
    return max(times + [item.at for item in store.attempts(machine)])


def _copy(source: Store, target: Store, then: Callable[[sa.Connection], None] = lambda _: None) -> dict[str, int]:
    """Copy all rows of a snapshot and do ``then``, in one transaction."""
    try:
        with source.snapshot() as reading, target.engine.begin() as writing:
            counts = dict.fromkeys((table.name for table in database.ALL), 0)
            for table in database.ALL:
                keys = [table.c.id] if "id" in table.c else list(table.primary_key)
                rows = reading.execution_options(yield_per=ROWS).execute(sa.select(table).order_by(*keys))
                for part in rows.partitions(ROWS):
                    if table is database.blobs:
                        for row in part:
                            inflated(row.sha256, row.deflated)
                    writing.execute(sa.insert(table), [dict(row._mapping) for row in part])
                    counts[table.name] += len(part)
                if writing.dialect.name == "postgresql" and "id" in table.c and counts[table.name]:
                    sequence = sa.func.pg_get_serial_sequence(table.name, "id")
                    newest = sa.select(sa.func.max(table.c.id)).scalar_subquery()
                    writing.execute(sa.select(sa.func.setval(sequence, newest)))
            then(writing)
            return counts
    except sa.exc.DBAPIError as error:
        place = f"{shown(source.url)} to {shown(target.url)}"
        raise StoreError(f"nothing was copied from {place}: {first_line(error)}") from error
