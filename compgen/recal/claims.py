"""Leases: who works on a measurement. The chain of claims grows by one row, which only one runner can add.

A lease of a process of this host that no longer runs is free at once; one of another host when its time is over.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import sqlalchemy as sa

from compgen.errors import CompgenError
from compgen.recal import schema
from compgen.recal.records import MeasurementRecord
from compgen.recal.store import Store

#: How long a claim counts without being renewed, s.
LEASE_S = 900.0


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


def take(store: Store, measurement: MeasurementRecord, owner: str, lease_s: float = LEASE_S) -> Claim | None:
    """Claim a measurement; None if somebody works on it or it is done."""

    def action(connection: sa.Connection) -> Claim | None:
        now = store.now(connection)
        last = _last(connection, measurement.id)
        if _done(connection, measurement.id) or (last is not None and _held(last, now)):
            return None
        return _add(connection, measurement.id, 1 if last is None else last.sequence + 1, "take", owner, now, lease_s)

    try:
        return store.write(action)
    except sa.exc.IntegrityError:  # another runner added this row first
        return None


def renew(store: Store, claim: Claim, lease_s: float = LEASE_S) -> Claim:
    """Prolong a claim; ClaimLostError if somebody else has taken over."""

    def action(connection: sa.Connection) -> Claim:
        check(connection, claim)
        now = store.now(connection)
        return _add(connection, claim.measurement_id, claim.sequence + 1, "renew", claim.owner, now, lease_s)

    try:
        return store.write(action)
    except sa.exc.IntegrityError as error:
        raise ClaimLostError("another runner took this measurement over") from error


def check(connection: sa.Connection, claim: Claim) -> None:
    """Raise ClaimLostError unless the claim is the last of its chain."""
    last = _last(connection, claim.measurement_id)
    if last is None or last.sequence != claim.sequence or last.owner != claim.owner:
        raise ClaimLostError("another runner took this measurement over")


def release(store: Store, connection: sa.Connection, claim: Claim) -> None:
    """Give a claim back in the transaction that keeps its result; ClaimLostError if it is somebody else's."""
    check(connection, claim)
    _add(connection, claim.measurement_id, claim.sequence + 1, "release", claim.owner, store.now(connection), 0.0)


def give_back(store: Store, claim: Claim) -> None:
    """Give a claim back without a result; one that is lost needs none."""
    with suppress(ClaimLostError, sa.exc.IntegrityError):
        store.write(lambda connection: release(store, connection, claim))


def _last(connection: sa.Connection, measurement_id: int) -> sa.Row[tuple[object, ...]] | None:
    table = schema.claims
    query = sa.select(table).where(table.c.measurement_id == measurement_id)
    return connection.execute(query.order_by(table.c.sequence.desc()).limit(1)).first()


def _done(connection: sa.Connection, measurement_id: int) -> bool:
    table = schema.identifications
    return connection.execute(sa.select(table.c.id).where(table.c.measurement_id == measurement_id)).first() is not None


def _held(last: sa.Row[tuple[object, ...]], now: datetime) -> bool:
    """Whether the last claim of a chain still counts; a clock that went back does not prolong a dead process's one."""
    if last.kind == "release":
        return False
    alive = _alive(str(last.owner))
    return bool(last.until > now) if alive is None else alive


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
    connection: sa.Connection, measurement_id: int, sequence: int, kind: str, owner: str, now: datetime, lease_s: float
) -> Claim:
    row = {"measurement_id": measurement_id, "sequence": sequence, "kind": kind, "owner": owner, "at": now}
    connection.execute(sa.insert(schema.claims).values(**row, until=now + timedelta(seconds=lease_s)))
    return Claim(measurement_id, sequence, owner)
