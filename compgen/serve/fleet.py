"""The fleet at one glance: for each machine what is active, what waits, what failed; without loading any contents."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from compgen.recal import schema
from compgen.recal.records import DecisionRecord, MachineRecord, TableState, reservations_of
from compgen.recal.states import AFTER, AUTOMATIC, OPEN
from compgen.recal.store import Store

#: Machines on one page.
PAGE = 100
#: Decisions on one page of the audit trail.
AUDIT = 200
#: What is wrong with a machine or waits, the most urgent first, and how it is called.
STATUSES = {
    "failed": "failed",
    "held": "held back",
    "refused": "not accepted",
    "pending": "waits for approval",
    "new": "no tables yet",
    "reserved": "active with reservations",
    "ok": "up to date",
}


@dataclass(frozen=True)
class FleetRow:
    """One machine, as far as the overview shows it.

    ``waiting`` are the versions that wait for a person, newest first, ``pending`` whether one of them is not held back;
    ``newest`` is the state of the newest version; ``failure`` says why the last attempt failed, if it did;
    ``reserved`` whether the verdict on the active tables has reservations.
    """

    machine: MachineRecord
    active: int | None
    active_since: datetime | None
    waiting: Sequence[int]
    pending: bool
    newest: TableState | None
    measured_at: datetime | None
    measurements: int
    failure: str
    reserved: bool = False

    @property
    def status(self) -> str:
        """The most urgent of :data:`STATUSES`."""
        if self.failure:
            return "failed"
        if self.newest in ("held", "refused"):
            return str(self.newest)
        if self.pending:
            return "pending"
        if self.active is None:
            return "new"
        return "reserved" if self.reserved else "ok"


@dataclass(frozen=True)
class Fleet:
    """All machines by name, and how many sets of tables are in each state."""

    rows: Sequence[FleetRow]
    states: Mapping[TableState, int]


def fleet(store: Store) -> Fleet:
    """Return the fleet, in one transaction; the database sums up, so that few rows come per machine."""
    found = store.read(lambda connection: {name: connection.execute(q).all() for name, q in _queries().items()})
    active = {row.machine_id: row for row in found["active"]}
    newest = {row.machine_id: AFTER[row.kind] for row in found["newest"]}
    measured = {row.machine_id: (row.last, row.number) for row in found["measurements"]}
    failures = {row.machine_id: row.message for row in found["failures"]}
    waiting: dict[int, list[Any]] = {}
    for row in found["open"]:
        waiting.setdefault(row.machine_id, []).append(row)
    rows = [
        _row(MachineRecord(*row), active.get(row.id), waiting.get(row.id, []), newest.get(row.id),
             measured.get(row.id, (None, 0)), failures.get(row.id, ""))
        for row in found["machines"]
    ]  # fmt: skip
    states: Counter[TableState] = Counter()
    for row in found["kinds"]:
        states[AFTER[row.kind]] += row.number
    now = sum(row.active is not None for row in rows)
    states["retired"], states["active"] = states["active"] - now, now
    return Fleet(rows, states)


def _row(
    machine: MachineRecord,
    active: Any,
    waiting: Sequence[Any],
    newest: TableState | None,
    measured: tuple[datetime | None, int],
    failure: str,
) -> FleetRow:
    version = None if active is None else active.version
    since = None if version is None else active.at
    if newest == "active" and (active is None or active.newest != version):
        newest = "retired"
    versions = sorted((row.version for row in waiting), reverse=True)
    pending = any(AFTER[row.kind] == "pending" for row in waiting)
    reserved = version is not None and bool(reservations_of(active.reasons))
    return FleetRow(machine, version, since, versions, pending, newest, *measured, failure, reserved)


def _queries() -> dict[str, sa.Select[Any]]:
    machines, measured, attempts = schema.machines, schema.measurements, schema.attempts
    last = sa.select(sa.func.max(attempts.c.id)).group_by(attempts.c.machine_id)
    time = sa.func.max(measured.c.measured_at, type_=schema.UtcTime()).label("last")
    state = _last_decisions().subquery()
    top = sa.select(schema.tables.c.machine_id, sa.func.max(schema.tables.c.version).label("version"))
    newest = top.group_by(schema.tables.c.machine_id).subquery()
    is_newest = sa.and_(newest.c.machine_id == state.c.machine_id, newest.c.version == state.c.version)
    return {
        "machines": sa.select(machines).order_by(machines.c.name),
        "active": _active(newest),
        "open": sa.select(state).where(state.c.kind.in_([kind for kind, after in AFTER.items() if after in OPEN])),
        "newest": sa.select(state).join(newest, is_newest),
        "kinds": sa.select(state.c.kind, sa.func.count().label("number")).group_by(state.c.kind),
        "measurements": sa.select(measured.c.machine_id, time, sa.func.count().label("number")).group_by(
            measured.c.machine_id
        ),
        "failures": sa.select(attempts.c.machine_id, attempts.c.message).where(
            attempts.c.id.in_(last), attempts.c.outcome == "failed"
        ),
    }


def _last_decisions() -> sa.Select[Any]:
    """Machine, version and kind of the last decision about each set of tables."""
    tables, decisions = schema.tables, schema.decisions
    last = (
        sa.select(decisions.c.machine_id, sa.func.max(decisions.c.sequence).label("sequence"))
        .where(decisions.c.table_id.is_not(None))
        .group_by(decisions.c.machine_id, decisions.c.table_id)
        .subquery()
    )
    same = sa.and_(decisions.c.machine_id == last.c.machine_id, decisions.c.sequence == last.c.sequence)
    query = sa.select(tables.c.machine_id, tables.c.version, decisions.c.kind)
    return query.select_from(last).join(decisions, same).join(tables, tables.c.id == decisions.c.table_id)


def _active(newest: sa.Subquery) -> sa.Select[Any]:
    """Machine, active version (null if a rollback left none), since when, and the newest version."""
    tables, decisions = schema.tables, schema.decisions
    kinds = [kind for kind, after in AFTER.items() if after == "active"]
    last = (
        sa.select(decisions.c.machine_id, sa.func.max(decisions.c.sequence).label("sequence"))
        .where(decisions.c.kind.in_(kinds))
        .group_by(decisions.c.machine_id)
        .subquery()
    )
    same = sa.and_(decisions.c.machine_id == last.c.machine_id, decisions.c.sequence == last.c.sequence)
    top = newest.c.version.label("newest")
    query = sa.select(decisions.c.machine_id, tables.c.version, decisions.c.at, tables.c.reasons, top)
    query = query.select_from(last).join(decisions, same).outerjoin(tables, tables.c.id == decisions.c.table_id)
    return query.outerjoin(newest, newest.c.machine_id == decisions.c.machine_id)


@dataclass(frozen=True)
class FleetPage:
    """The machines of one page, how many there are by status in all, and which page of how many it is."""

    rows: Sequence[FleetRow]
    counts: Mapping[str, int]
    found: int
    page: int
    pages: int


def fleet_page(rows: Sequence[FleetRow], words: str, status: str, page: int) -> FleetPage:
    """Choose by part of the name and by status; pages count from 1, one beyond the last is the last."""
    chosen = [r for r in rows if words.lower() in r.machine.name.lower() and status in ("", r.status)]
    pages = max(1, -(-len(chosen) // PAGE))
    page = min(max(page, 1), pages)
    counts = Counter(row.status for row in rows)
    return FleetPage(chosen[(page - 1) * PAGE : page * PAGE], counts, len(chosen), page, pages)


def machine_by_id(store: Store, machine_id: int) -> MachineRecord | None:
    """Return one machine, None if the store does not have it."""
    query = sa.select(schema.machines).where(schema.machines.c.id == machine_id)
    row = store.read(lambda connection: connection.execute(query).first())
    return None if row is None else MachineRecord(*row)


@dataclass(frozen=True)
class AuditPage:
    """Decisions of one page, the newest first, each with machine and version; which page of how many it is."""

    rows: Sequence[tuple[DecisionRecord, str, int | None]]
    page: int
    pages: int


def audit_page(store: Store, page: int, *, people: bool) -> AuditPage:
    """Return one page of the audit trail, with ``people`` only what persons decided."""
    return store.together(lambda: _audit_page(store, page, people=people))


def _audit_page(store: Store, page: int, *, people: bool) -> AuditPage:
    decisions, tables, machines = schema.decisions, schema.tables, schema.machines
    who = decisions.c.actor != AUTOMATIC if people else sa.true()
    count = store.read(lambda c: c.execute(sa.select(sa.func.count()).select_from(decisions).where(who)).scalar_one())
    pages = max(1, -(-count // AUDIT))
    page = min(max(page, 1), pages)
    query = sa.select(decisions, machines.c.name.label("machine"), tables.c.version)
    query = query.join(machines, machines.c.id == decisions.c.machine_id)
    query = query.outerjoin(tables, tables.c.id == decisions.c.table_id).where(who)
    query = query.order_by(decisions.c.at.desc(), decisions.c.id.desc()).limit(AUDIT).offset((page - 1) * AUDIT)
    rows = store.read(lambda connection: connection.execute(query).all())
    return AuditPage([(DecisionRecord(*row[:-2]), row.machine, row.version) for row in rows], page, pages)
