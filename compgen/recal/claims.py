"""Leases: who works on a measurement. The chain of claims grows by one row, which only one runner can add.

A lease of a process of this host that no longer runs is free at once; every other one when its time is over, unless it
is renewed, which :class:`Renewal` does while somebody works.
"""

from __future__ import annotations

import os
import socket
import threading
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Any

import sqlalchemy as sa

from compgen.errors import CompgenError
from compgen.recal import logs, schema
from compgen.recal.records import MachineRecord, MeasurementRecord
from compgen.recal.store import Store

#: How long a claim counts without being renewed, s.
LEASE_S = 900.0
#: A claim is renewed when this share of its time is over.
RENEWED_AT = 1.0 / 3.0

#: What this process works on: owner, store, measurement. A claim of this process that is not here was left behind.
_working: set[tuple[str, str, int]] = set()
_lock = threading.Lock()


class ClaimLostError(CompgenError):
    """Another runner took over; whatever was worked out must not be kept."""

    exit_code = 1


@dataclass(frozen=True)
class Claim:
    """The right to process one measurement; ``sequence`` is the number of its row in the chain."""

    measurement_id: int
    sequence: int
    owner: str


def owner_name() -> str:
    """Return the name of this process: host, process space, number, start."""
    pid = os.getpid()
    return f"{socket.gethostname()}/{_process_space()}/{pid}/{_start_of(pid)}"


def take(
    store: Store, measurement: MeasurementRecord, owner: str, lease_s: float | None = None, *, again: bool = False
) -> Claim | None:
    """Claim a measurement for ``lease_s`` (None: :data:`LEASE_S`); None if somebody works on it or it is done.

    With ``again`` one that is done may be claimed too.
    """
    key = (owner, store.url, measurement.id)

    def action(connection: sa.Connection) -> Claim | None:
        now = store.now(connection)
        last = _last(connection, measurement.id)
        done = not again and _done(connection, measurement.id)
        if done or (last is not None and last.owner != owner and _held(last, now)):
            return None
        return _add(connection, measurement.id, 1 if last is None else last.sequence + 1, "take", owner, now, lease_s)

    with _lock:
        if key in _working:  # another thread of this process
            return None
        _working.add(key)
    claim = None
    try:
        claim = store.write(action)
    except sa.exc.IntegrityError:  # another runner added this row first
        pass
    finally:
        if claim is None:
            _working.discard(key)
    return claim


def renew(store: Store, claim: Claim, lease_s: float | None = None) -> Claim:
    """Prolong a claim; ClaimLostError if somebody else has taken over. The claim as it was stays valid too."""

    def action(connection: sa.Connection) -> Claim:
        last = check(connection, claim)
        now = store.now(connection)
        return _add(connection, claim.measurement_id, last + 1, "renew", claim.owner, now, lease_s)

    try:
        return store.write(action)
    except sa.exc.IntegrityError as error:
        raise ClaimLostError("another runner took this measurement over") from error


class Renewal:
    """Prolongs a claim from a thread of its own for as long as the ``with`` block takes.

    A store that is away is tried again; if somebody else took over meanwhile, whoever keeps the result notices it.
    """

    def __init__(self, store: Store, claim: Claim, lease_s: float | None = None) -> None:
        self._store, self._claim, self._lease_s = store, claim, LEASE_S if lease_s is None else lease_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._prolong, name="renewal of a claim", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def _prolong(self) -> None:
        while not self._over.wait(self._lease_s * RENEWED_AT):
            try:
                renew(self._store, self._claim, self._lease_s)
            except ClaimLostError:
                return
            except (CompgenError, sa.exc.SQLAlchemyError) as error:
                logs.warning("claim not renewed", measurement=self._claim.measurement_id, problem=str(error))


def check(connection: sa.Connection, claim: Claim) -> int:
    """Return the number of the last row of the chain; ClaimLostError unless it is the owner's and not released."""
    last = _last(connection, claim.measurement_id)
    if last is None or last.owner != claim.owner or last.kind == "release" or last.sequence < claim.sequence:
        raise ClaimLostError("another runner took this measurement over")
    return int(last.sequence)


def release(store: Store, connection: sa.Connection, claim: Claim) -> None:
    """Give a claim back in the transaction that keeps its result; ClaimLostError if it is somebody else's."""
    last = check(connection, claim)
    _add(connection, claim.measurement_id, last + 1, "release", claim.owner, store.now(connection), 0.0)


def give_back(store: Store, claim: Claim) -> None:
    """Give a claim back without a result; one that is lost needs none."""
    try:
        with suppress(ClaimLostError, sa.exc.IntegrityError):
            store.write(lambda connection: release(store, connection, claim))
    finally:
        forget(store, claim)


def forget(store: Store, claim: Claim) -> None:
    """Say that this process no longer works on a measurement, whatever the store says."""
    _working.discard((claim.owner, store.url, claim.measurement_id))


def left_by(store: Store, machine: MachineRecord, pid: int) -> list[MeasurementRecord]:
    """Return the machine's measurements that a process of this computer had claimed when it ended."""
    mark = f"{socket.gethostname()}/{_process_space()}/{pid}/"
    measured = {item.id: item for item in store.measurements(machine)}
    found = [
        last.measurement_id
        for last in _last_claims(store)
        if last.kind != "release" and str(last.owner).startswith(mark) and _alive(str(last.owner)) is False
    ]
    return [measured[key] for key in found if key in measured]


def unfinished(store: Store) -> set[int]:
    """Return the ids of the machines that have a measurement whose claim a process left that no longer runs."""
    left = [last for last in _last_claims(store) if last.kind != "release" and _alive(str(last.owner)) is False]
    machines = {item.id: item.machine_id for item in store.measurements()} if left else {}
    return {machines[last.measurement_id] for last in left}


def _last_claims(store: Store) -> list[Any]:
    """Return the last row of the chain of each measurement."""
    table = schema.claims
    last = sa.select(sa.func.max(table.c.id)).group_by(table.c.measurement_id)
    return store.read(lambda connection: list(connection.execute(sa.select(table).where(table.c.id.in_(last)))))


def _last(connection: sa.Connection, measurement_id: int) -> sa.Row[tuple[object, ...]] | None:
    table = schema.claims
    query = sa.select(table).where(table.c.measurement_id == measurement_id)
    return connection.execute(query.order_by(table.c.sequence.desc()).limit(1)).first()


def _done(connection: sa.Connection, measurement_id: int) -> bool:
    table = schema.identifications
    return connection.execute(sa.select(table.c.id).where(table.c.measurement_id == measurement_id)).first() is not None


def _held(last: sa.Row[tuple[object, ...]], now: datetime) -> bool:
    """Whether the last claim of a chain still counts; a clock that went back prolongs it at most by its own length."""
    if last.kind == "release" or _alive(str(last.owner)) is False:
        return False
    return bool(now < last.until and last.at - now < last.until - last.at)


def _alive(owner: str) -> bool | None:
    """Whether the process runs; None if it belongs to another host or this system cannot tell."""
    host, space, pid, start = owner.rsplit("/", 3)
    if host != socket.gethostname() or space != _process_space() or space == "-" or not pid.isdigit():
        return None
    return _start_of(int(pid)) == start


def _process_space() -> str:
    """Say which numbering of processes this one belongs to: boot and name space; "-" where the system does not tell."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot}:{os.readlink('/proc/self/ns/pid')}".replace("/", "_")
    except OSError:
        return "-"


def _start_of(pid: int) -> str:
    """Start time of a process in the system's ticks, "-" if there is none."""
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
    connection.execute(sa.insert(schema.claims).values(**row, until=until))
    return Claim(measurement_id, sequence, owner)
