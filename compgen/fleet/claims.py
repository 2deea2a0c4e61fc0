"""Leases on measurements, and the results that are stored when a lease ends.

A lease (claim) says who works on a measurement. The claims of a measurement are a chain of rows, and only one runner can
add the next row. A lease ends at once if its process on this host no longer runs; otherwise it expires, unless
:func:`renewal` renews it during the work. The results are stored and the claim is released in the same transaction.
"""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa

from compgen.data.files import json_values
from compgen.errors import CompgenError
from compgen.fleet import database, logs
from compgen.fleet.database import inserted, put_blobs
from compgen.fleet.decisions import add_decision, locked_decisions
from compgen.fleet.records import (
    AUTOMATIC,
    OPEN,
    MachineRecord,
    MeasurementRecord,
    NewResult,
    TableRecord,
    active_id,
    state_of,
)
from compgen.fleet.store import Store

Result = TypeVar("Result")

#: How long a claim is valid without renewal, s.
LEASE_S = 900.0
#: A claim is renewed after this share of its time.
RENEWED_AT = 1.0 / 3.0
#: How often a measurement is judged again because other tables became active meanwhile.
JUDGED_AT_MOST = 5


class ClaimLostError(CompgenError):
    """Another runner took over; the results must not be stored."""

    exit_code = 1


@dataclass(frozen=True)
class Claim:
    """The right to process one measurement; ``sequence`` is the number of its row in the chain."""

    measurement_id: int
    sequence: int
    owner: str


class _InHand:
    """What a process works on, by store, owner and measurement: its threads share one owner.

    A claim of the process that is not listed here was left behind, and the process may take it again. Both methods are one
    operation on a dict, so that a process which is started as a copy of this one never finds a lock that nobody releases.
    """

    def __init__(self) -> None:
        self._threads: dict[tuple[str, str, int], object] = {}

    def begin(self, store: Store, owner: str, measurement_id: int) -> bool:
        """Note that the work begins; False if another thread is at it."""
        work = object()
        return self._threads.setdefault((store.url, owner, measurement_id), work) is work

    def end(self, store: Store, owner: str, measurement_id: int) -> None:
        """Note that the work has ended."""
        self._threads.pop((store.url, owner, measurement_id), None)


#: As the owner, which has the number and the start of the process in its name, it belongs to the process, not to a store
#: that happens to be open: several threads open the same store.
_HERE = _InHand()


def owner_name() -> str:
    """Return the name of this process: host, process space, number, start."""
    pid = os.getpid()
    return f"{socket.gethostname()}/{_process_space()}/{pid}/{_start_of(pid)}"


def take(
    store: Store, measurement: MeasurementRecord, owner: str, lease_s: float | None = None, *, again: bool = False
) -> Claim | None:
    """Claim a measurement for ``lease_s`` (None: :data:`LEASE_S`); None if somebody works on it or it is done.

    With ``again`` a measurement that is done may also be claimed.
    """

    def action(connection: sa.Connection) -> Claim | None:
        now = store.now(connection)
        last = _last(connection, measurement.id)
        done = not again and connection.execute(_IDENTIFIED, {"measurement": measurement.id}).first() is not None
        counts = last is not None and last.owner != owner and last.kind != "release"
        if last is not None and counts and _alive(str(last.owner)) is not False:
            # until its time is over; a clock that was set back extends it by at most its length
            done = done or bool(now < last.until and last.at - now < last.until - last.at)
        if done:
            return None
        return _add(connection, measurement.id, 1 if last is None else last.sequence + 1, "take", owner, now, lease_s)

    if not _HERE.begin(store, owner, measurement.id):
        return None
    claim = None
    try:
        claim = store.write(action)
    except sa.exc.IntegrityError:  # another runner added this row first
        pass
    finally:
        if claim is None:
            _HERE.end(store, owner, measurement.id)
    return claim


def work_on(
    store: Store, measurement: MeasurementRecord, work: Callable[[Claim], Result], *, again: bool = False
) -> Result:
    """Do ``work`` on a measurement with a claim, which ends when the work stores its result.

    If other tables became active meanwhile (ChangedMeanwhileError), the work is repeated. Any other error ends it and
    releases the claim. With ``again`` a measurement that is done may also be worked on.

    Raises
    ------
    ClaimLostError
        if nothing was stored, because of another runner or of tables that keep changing; the message says which.
    """
    for _ in range(JUDGED_AT_MOST):
        claim = take(store, measurement, owner_name(), again=again)
        if claim is None:
            raise ClaimLostError("another runner works on it")
        try:
            return work(claim)
        except ChangedMeanwhileError:
            give_back(store, claim)
        except (ClaimLostError, sa.exc.IntegrityError) as error:
            forget(store, claim)
            raise ClaimLostError("another runner took it over") from error
        except BaseException:
            try:
                give_back(store, claim)
            except (CompgenError, sa.exc.SQLAlchemyError) as error:  # must not hide the original error
                logs.error("claim not released", problem=str(error))
            raise
    raise ClaimLostError("the active tables kept changing")


def renew(store: Store, claim: Claim, lease_s: float | None = None) -> Claim:
    """Extend a claim; ClaimLostError if somebody else has taken over. The old claim object stays valid too."""

    def action(connection: sa.Connection) -> Claim:
        last = check(connection, claim)
        now = store.now(connection)
        return _add(connection, claim.measurement_id, last + 1, "renew", claim.owner, now, lease_s)

    try:
        return store.write(action)
    except sa.exc.IntegrityError as error:
        raise ClaimLostError("another runner took this measurement over") from error


@contextmanager
def renewal(store: Store, claim: Claim, lease_s: float | None = None) -> Iterator[None]:
    """Extend a claim from a separate thread until the ``with`` block ends.

    If the store cannot be reached, it is tried again; a claim lost meanwhile is noticed when the result is stored.
    """
    lease_s, over = LEASE_S if lease_s is None else lease_s, threading.Event()

    def prolong() -> None:
        while not over.wait(lease_s * RENEWED_AT):
            try:
                renew(store, claim, lease_s)
            except ClaimLostError:
                return
            except (CompgenError, sa.exc.SQLAlchemyError) as error:
                logs.warning("claim not renewed", measurement=claim.measurement_id, problem=str(error))

    thread = threading.Thread(target=prolong, name="renewal of a claim", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def check(connection: sa.Connection, claim: Claim) -> int:
    """Return the number of the last row of the chain; ClaimLostError unless it is the owner's and not released."""
    last = _last(connection, claim.measurement_id)
    if last is None or last.owner != claim.owner or last.kind == "release" or last.sequence < claim.sequence:
        raise ClaimLostError("another runner took this measurement over")
    return int(last.sequence)


def release(store: Store, connection: sa.Connection, claim: Claim) -> None:
    """Release a claim in the transaction that stores its result; ClaimLostError if it belongs to somebody else."""
    last = check(connection, claim)
    _add(connection, claim.measurement_id, last + 1, "release", claim.owner, store.now(connection), 0.0)


def give_back(store: Store, claim: Claim) -> None:
    """Release a claim without a result; a lost claim needs no release."""
    try:
        with suppress(ClaimLostError, sa.exc.IntegrityError):
            store.write(lambda connection: release(store, connection, claim))
    finally:
        forget(store, claim)


def forget(store: Store, claim: Claim) -> None:
    """Note that this process no longer works on a measurement, whatever the store says."""
    _HERE.end(store, claim.owner, claim.measurement_id)


def left_by(store: Store, machine: MachineRecord, pid: int) -> list[MeasurementRecord]:
    """Return the machine's measurements that were still claimed by a process of this computer when it ended."""
    mark = f"{socket.gethostname()}/{_process_space()}/{pid}/"
    measured = {item.id: item for item in store.measurements(machine)}
    found = [
        last.measurement_id
        for last in _last_claims(store)
        if last.kind != "release" and str(last.owner).startswith(mark) and _alive(str(last.owner)) is False
    ]
    return [measured[key] for key in found if key in measured]


def unfinished(store: Store) -> set[int]:
    """Return the ids of the machines with a measurement claimed by a process that no longer runs."""
    left = [last for last in _last_claims(store) if last.kind != "release" and _alive(str(last.owner)) is False]
    machines = {item.id: item.machine_id for item in store.measurements()} if left else {}
    return {machines[last.measurement_id] for last in left}


def _last_claims(store: Store) -> list[Any]:
    """Return the last row of each measurement's chain."""
    table = database.claims
    last = sa.select(sa.func.max(table.c.id)).group_by(table.c.measurement_id)
    return store.read(lambda connection: list(connection.execute(sa.select(table).where(table.c.id.in_(last)))))


#: A measurement's results.
_IDENTIFIED = sa.select(database.identifications.c.id).where(
    database.identifications.c.measurement_id == sa.bindparam("measurement")
)
#: The last row of a measurement's chain.
_LAST = (
    sa.select(database.claims)
    .where(database.claims.c.measurement_id == sa.bindparam("measurement"))
    .order_by(database.claims.c.sequence.desc())
    .limit(1)
)


def _last(connection: sa.Connection, measurement_id: int) -> sa.Row[Any] | None:
    return connection.execute(_LAST, {"measurement": measurement_id}).first()


def _alive(owner: str) -> bool | None:
    """Whether the process is running; None if it is on another host or this system cannot tell."""
    host, space, pid, start = owner.rsplit("/", 3)
    if host != socket.gethostname() or space != _process_space() or space == "-" or not pid.isdigit():
        return None
    return _start_of(int(pid)) == start


def _process_space() -> str:
    """Identify the numbering that this process's id belongs to: boot and namespace; "-" if the system cannot tell."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot}:{os.readlink('/proc/self/ns/pid')}".replace("/", "_")
    except OSError:
        return "-"


def _start_of(pid: int) -> str:
    """Start time of a process in clock ticks, "-" if it does not exist."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return "-"
    fields = text[text.rfind(")") + 2 :].split()
    return "-" if fields[0] in "ZX" else fields[19]


def _add(
    connection: sa.Connection,
    measurement_id: int,
    sequence: int,
    kind: str,
    owner: str,
    now: datetime,
    lease_s: float | None,
) -> Claim:
    row = {"measurement_id": measurement_id, "sequence": sequence, "kind": kind, "owner": owner, "at": now}
    until = now + timedelta(seconds=LEASE_S if lease_s is None else lease_s)
    connection.execute(sa.insert(database.claims), {**row, "until": until})
    return Claim(measurement_id, sequence, owner)


# --- what processing a measurement adds to the store ---------------------------------------------------------------


class ChangedMeanwhileError(ClaimLostError):
    """Other tables became active while the measurement was judged; it has to be judged again."""


def keep_result(
    store: Store, machine: MachineRecord, claim: Claim, new: NewResult, judged_against: int | None
) -> TableRecord:
    """Store errors, tables and the automatic decisions about them.

    Parameters
    ----------
    claim : it is released; nothing is stored if it was lost.
    new : the results of processing.
    judged_against : id of the tables that were active at the judgement; ChangedMeanwhileError if others are active now.
    """

    def action(connection: sa.Connection) -> int:
        decisions = locked_decisions(connection, machine)
        release(store, connection, claim)
        if active_id(decisions) != judged_against:
            raise ChangedMeanwhileError(
                f"{machine.name}: the active tables have changed; the measurement is judged again"
            )
        table_id = _insert(store, connection, machine, claim, new)
        reason, actor = "; ".join(filter(None, [new.reason, *new.hold])), new.actor or AUTOMATIC
        if not new.accepted:
            add_decision(store, connection, machine, "refuse", table_id, actor, reason or "not accepted")
            return table_id
        if new.hold:
            add_decision(store, connection, machine, "hold", table_id, actor, reason)
            return table_id
        for old in dict.fromkeys(item.table_id for item in decisions):
            if old is not None and state_of(old, decisions) in OPEN:
                add_decision(store, connection, machine, "supersede", old, AUTOMATIC, "superseded by a newer proposal")
        shown = "; ".join(filter(None, [reason, *new.reservations]))
        add_decision(store, connection, machine, "propose", table_id, actor, shown)
        if new.approve:
            add_decision(store, connection, machine, "approve", table_id, AUTOMATIC, "approval = auto")
        return table_id

    try:
        table_id = store.write(action)
    except ClaimLostError:
        # the connection may have failed after the result was stored
        kept, tried = database.identifications, database.attempts
        query = (
            sa.select(database.tables.c.id)
            .join(kept, kept.c.id == database.tables.c.identification_id)
            .join(tried, tried.c.measurement_id == kept.c.measurement_id)
            .where(kept.c.measurement_id == claim.measurement_id, kept.c.revision == new.revision)
            .where(tried.c.outcome == "done", tried.c.owner == claim.owner)
        )
        stored = store.read(lambda connection: connection.execute(query).scalar())
        if stored is None:
            raise
        table_id = stored
    forget(store, claim)
    return next(table for table in store.tables(machine) if table.id == table_id)


def _insert(store: Store, connection: sa.Connection, machine: MachineRecord, claim: Claim, new: NewResult) -> int:
    now = store.now(connection)
    versions = sa.select(sa.func.max(database.tables.c.version)).where(database.tables.c.machine_id == machine.id)
    last = connection.execute(versions).scalar()
    table = {
        "machine_id": machine.id,
        "version": (last or 0) + 1,
        "identification_id": _insert_errors(connection, machine, claim, new, now),
        "accepted": new.accepted,
        "controllers": list(dict.fromkeys(file.controller for file in new.files)),
        "reasons": [*new.hold, *new.reservations],
        "summary": clean(new.judgement),
        "at": now,
    }
    table_id = inserted(connection, database.tables, table)
    digests = put_blobs(connection, [file.content for file in new.files])
    rows = [
        {"table_id": table_id, "controller": file.controller, "name": file.name, "sha256": digest}
        for file, digest in zip(new.files, digests, strict=True)
    ]
    if rows:
        connection.execute(sa.insert(database.table_files), rows)
    attempt = {
        "outcome": "done",
        "message": new.evidence,
        "settings_sha256": new.settings_sha256,
        "seconds": new.seconds,
    }
    _add_attempt(store, connection, machine, claim, attempt)
    return table_id


def _insert_errors(
    connection: sa.Connection, machine: MachineRecord, claim: Claim, new: NewResult, now: datetime
) -> int:
    parts = [new.machine_text, new.errors_text, new.covariance, new.fitted_text]
    digests = iter(put_blobs(connection, [part for part in parts if part is not None]))
    machine_sha, errors_sha, covariance_sha, fitted_sha = (
        next(digests) if part is not None else None for part in parts
    )
    files = database.machine_versions
    same = sa.select(files.c.id).where(files.c.machine_id == machine.id, files.c.sha256 == machine_sha)
    machine_version_id = connection.execute(same).scalar()
    if machine_version_id is None:
        machine_version_id = inserted(connection, files, {"machine_id": machine.id, "sha256": machine_sha, "at": now})
    identification = {
        "machine_id": machine.id,
        "measurement_id": claim.measurement_id,
        "machine_version_id": machine_version_id,
        "active_table_id": new.active_table_id,
        "errors_sha256": errors_sha,
        "covariance_sha256": covariance_sha,
        "fitted_sha256": fitted_sha,
        "summary": clean(new.summary),
        "program": new.program,
        "at": now,
        "revision": new.revision,
    }
    return inserted(connection, database.identifications, identification)


def keep_failure(
    store: Store, machine: MachineRecord, claim: Claim, message: str, settings_sha256: str, seconds: float
) -> None:
    """Record that a measurement could not be processed, and why; it is retried when settings or machine change."""

    def action(connection: sa.Connection) -> None:
        release(store, connection, claim)
        attempt = {"outcome": "failed", "message": message, "settings_sha256": settings_sha256, "seconds": seconds}
        _add_attempt(store, connection, machine, claim, attempt)

    store.write(action)
    forget(store, claim)


def keep_confirmation(store: Store, machine: MachineRecord, claim: Claim, evidence: str, settings_sha256: str) -> None:
    """Record that evidence was looked at, and that it confirms what the measurement was judged with."""

    def action(connection: sa.Connection) -> None:
        release(store, connection, claim)
        attempt = {"outcome": "done", "message": evidence, "settings_sha256": settings_sha256, "seconds": 0.0}
        _add_attempt(store, connection, machine, claim, attempt)

    store.write(action)
    forget(store, claim)


def _add_attempt(
    store: Store, connection: sa.Connection, machine: MachineRecord, claim: Claim, attempt: Mapping[str, object]
) -> None:
    about = {"machine_id": machine.id, "measurement_id": claim.measurement_id, "owner": claim.owner}
    connection.execute(sa.insert(database.attempts), {**about, **attempt, "at": store.now(connection)})


def clean(value: Any) -> Any:
    """Return the value in a form that JSON accepts: a number that is not finite becomes null."""
    return json.loads(json.dumps(json_values(value), default=str))
