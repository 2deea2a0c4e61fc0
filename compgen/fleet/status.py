"""Status of the fleet and history of a machine, for tables, JSON and pages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, TypeVar

import sqlalchemy as sa

from compgen.fleet import database
from compgen.fleet.decisions import EXCLUSION, said_of
from compgen.fleet.job import Cron, Job, Schedule
from compgen.fleet.records import (
    AFTER,
    AUTOMATIC,
    EVIDENCE,
    HELD_BACK,
    OPEN,
    AttemptRecord,
    DecisionRecord,
    MachineRecord,
    TableRecord,
    TableState,
    active_of,
    reservations_of,
)
from compgen.fleet.store import Store, at_one_moment, evidence_in

Record = TypeVar("Record")


@dataclass(frozen=True)
class MachineStatus:
    """Status of one machine; times are ISO texts in UTC.

    ``state``: "new" (not measured yet), "ok", "waiting" (for a person's decision), "held" (the newest tables are held
    back or refused) or "failed" (the last attempt failed). ``without_prior``: so were the active tables made.
    """

    machine: str
    state: str
    active: int | None
    active_since: str | None
    waiting: tuple[int, ...]
    measurements: int
    last_measured: str | None
    message: str
    schedule: str
    without_prior: bool = False

    def summary(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)


@dataclass(frozen=True)
class HistoryEntry:
    """One line of a machine's history; ``number`` is the id of its row in the store."""

    at: str
    machine: str
    kind: str
    version: int | None
    actor: str
    text: str
    number: int

    def summary(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)


@at_one_moment
def status(store: Store, job: Job, names: Sequence[str] = ()) -> list[MachineStatus]:
    """Return the status of the machines ``names`` (default all of the job), in the order of the job file."""
    chosen = [job.machine(name) for name in names] if names else list(job.machines.values())
    known = {machine.name: machine for machine in store.machines()}
    one = known.get(chosen[0].name) if len(chosen) == 1 else None
    tables = _grouped(store.tables(one, figures=False))
    measured = _grouped(store.measurements(one))
    attempts = _grouped(store.attempts(one))
    decided, unknown = _grouped(store.decisions(one)), store.without_prior(one)
    found = []
    for item in chosen:
        machine = known.get(item.name)
        if machine is None:
            found.append(MachineStatus(item.name, "new", None, None, (), 0, None, "", schedule_text(item.schedule)))
            continue
        own = tables.get(machine.id, [])
        active = active_of(own)
        since = [d.at for d in decided.get(machine.id, []) if active is not None and d.table_id == active.id]
        state, message = _state(own, attempts.get(machine.id, []))
        times = [measurement.measured_at for measurement in measured.get(machine.id, [])]
        found.append(
            MachineStatus(
                machine=item.name,
                state=state if times else "new",
                active=None if active is None else active.version,
                active_since=_iso(max(since)) if since else None,
                waiting=tuple(table.version for table in own if table.state in OPEN),
                measurements=len(times),
                last_measured=_iso(max(times)) if times else None,
                message=message,
                schedule=schedule_text(item.schedule),
                without_prior=active is not None and active.identification_id in unknown,
            )
        )
    return found


def _state(tables: Sequence[TableRecord], attempts: Sequence[AttemptRecord]) -> tuple[str, str]:
    if attempts and attempts[-1].outcome == "failed":
        return "failed", attempts[-1].message
    last = tables[-1] if tables else None
    if last is not None and last.state in HELD_BACK:
        return "held", "; ".join(last.reasons)
    waiting = [str(table.version) for table in tables if table.state == "pending"]
    shown = "; ".join(
        reason for table in tables if table.state == "active" for reason in reservations_of(table.reasons)
    )
    return ("waiting", f"version {', '.join(waiting)} waits for approval") if waiting else ("ok", shown)


def schedule_text(schedule: Schedule | None) -> str:
    """Say in a few words when a machine is checked."""
    if schedule is None:
        return ""
    return schedule.expression if isinstance(schedule, Cron) else f"every {schedule.minutes} min"


def _grouped(records: Iterable[Record]) -> dict[int, list[Record]]:
    found: dict[int, list[Record]] = {}
    for record in records:
        found.setdefault(record.machine_id, []).append(record)  # type: ignore[attr-defined]
    return found


@at_one_moment
def history(store: Store, machine: MachineRecord | None = None) -> list[HistoryEntry]:
    """Return everything that happened to a machine (or to all), oldest first."""
    names = {item.id: item.name for item in store.machines()}
    versions: Mapping[int, int] = {table.id: table.version for table in store.tables(machine, figures=False)}
    entries: list[tuple[datetime, int, HistoryEntry]] = []

    def add(at: datetime, order: int, record: Any, kind: str, version: int | None, actor: str, text: str) -> None:
        name = names.get(record.machine_id, "")
        entries.append((at, order, HistoryEntry(_iso(at), name, kind, version, actor, text, record.id)))

    named = {}
    for item in store.measurements(machine):
        named[item.id] = item.name
        text = f"{item.name}, measured {_iso(item.measured_at)} ({item.measured_at_source})"
        add(item.received_at, 0, item, "measurement", None, "", text)
    for attempt in store.attempts(machine):
        if attempt.outcome == "failed":
            name = f"{named.get(attempt.measurement_id, '')}: "
            text = attempt.message if attempt.message.startswith(name[:-1]) else name + attempt.message
            add(attempt.at, 1, attempt, "failed", None, "", text)
    for decision in store.decisions(machine):
        version = None if decision.table_id is None else versions[decision.table_id]
        add(decision.at, 2, decision, decision.kind, version, decision.actor, decision.reason)
    for event in store.events(machine):
        if event.kind == EXCLUSION:
            what, actor, reason = said_of(event)
            version = int(event.subject.removeprefix("version "))
            add(event.at, 3, event, event.kind, version, actor, f"measurement {what}: {reason}")
        elif event.kind == EVIDENCE:
            shown = evidence_in(event)
            text = f"{shown.names} with {named.get(shown.measurement_id, event.subject)} ({shown.source})"
            add(event.at, 3, event, event.kind, None, "", text)
        elif event.kind != "notified":
            add(event.at, 3, event, event.kind, None, "", f"{event.subject}: {event.message}")
    return [entry for _, _, entry in sorted(entries, key=lambda item: (item[0], item[1], item[2].number))]


def _iso(time: datetime) -> str:
    return time.isoformat(timespec="seconds")


# --- overview of the fleet: no contents are loaded -----------------------------------------------------------------

#: Machines on one page.
PAGE = 100
#: Decisions on one page of the audit trail.
AUDIT = 200
#: Statuses of a machine, the most urgent first, and their names.
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
    """One machine as shown in the overview.

    ``waiting``: versions that wait for a person, newest first; ``pending``: whether one of them is not held back;
    ``newest``: state of the newest version; ``failure``: why the last attempt failed, if it did; ``reserved``: whether
    the verdict on the active tables has reservations; ``without_prior``: whether they were made without a prior.
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
    without_prior: bool = False

    @property
    def status(self) -> str:
        """The most urgent of :data:`STATUSES`."""
        if self.failure:
            return "failed"
        if self.newest in HELD_BACK:
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
    """Return the fleet, in one transaction; the database aggregates, so few rows per machine are transferred."""
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
    unknown = version is not None and active.prior_class in database.NO_PRIOR
    return FleetRow(machine, version, since, versions, pending, newest, *measured, failure, reserved, unknown)


def _queries() -> dict[str, sa.Select[Any]]:
    machines, measured, attempts = database.machines, database.measurements, database.attempts
    last = sa.select(sa.func.max(attempts.c.id)).group_by(attempts.c.machine_id)
    time = sa.func.max(measured.c.measured_at, type_=database.UtcTime()).label("last")
    tables, decisions = database.tables, database.decisions
    # machine, version and kind of the last decision about each set of tables
    said = _newest_decisions(decisions.c.table_id.is_not(None), [decisions.c.machine_id, decisions.c.table_id])
    about = sa.select(tables.c.machine_id, tables.c.version, decisions.c.kind)
    state = about.select_from(said.join(tables, tables.c.id == decisions.c.table_id)).subquery()
    top = sa.select(database.tables.c.machine_id, sa.func.max(database.tables.c.version).label("version"))
    newest = top.group_by(database.tables.c.machine_id).subquery()
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


def _newest_decisions(which: sa.ColumnElement[bool], by: Sequence[sa.Column[int]]) -> sa.FromClause:
    """Selectable with the newest decision that meets a condition, for each value of ``by``."""
    decisions = database.decisions
    last = sa.select(decisions.c.machine_id, sa.func.max(decisions.c.sequence).label("sequence"))
    found = last.where(which).group_by(*by).subquery()
    same = sa.and_(decisions.c.machine_id == found.c.machine_id, decisions.c.sequence == found.c.sequence)
    return found.join(decisions, same)


def _active(newest: sa.Subquery) -> sa.Select[Any]:
    """Machine, active version (null if a rollback left none), since when, and the newest version."""
    tables, decisions = database.tables, database.decisions
    kinds = [kind for kind, after in AFTER.items() if after == "active"]
    last = _newest_decisions(decisions.c.kind.in_(kinds), [decisions.c.machine_id])
    top = newest.c.version.label("newest")
    columns = (decisions.c.machine_id, tables.c.version, decisions.c.at, tables.c.reasons, database.PRIOR_CLASS, top)
    of_table = last.outerjoin(tables, tables.c.id == decisions.c.table_id)
    found = database.identifications
    query = sa.select(*columns).select_from(of_table.outerjoin(found, found.c.id == tables.c.identification_id))
    return query.outerjoin(newest, newest.c.machine_id == decisions.c.machine_id)


@dataclass(frozen=True)
class FleetPage:
    """The machines of one page, their total number by status, the page number and the number of pages."""

    rows: Sequence[FleetRow]
    counts: Mapping[str, int]
    found: int
    page: int
    pages: int


def fleet_page(rows: Sequence[FleetRow], words: str, status: str, page: int) -> FleetPage:
    """Filter by part of the name and by status; pages count from 1, a number beyond the last gives the last."""
    chosen = [r for r in rows if words.lower() in r.machine.name.lower() and status in ("", r.status)]
    pages = max(1, -(-len(chosen) // PAGE))
    page = min(max(page, 1), pages)
    counts = Counter(row.status for row in rows)
    return FleetPage(chosen[(page - 1) * PAGE : page * PAGE], counts, len(chosen), page, pages)


def machine_by_id(store: Store, machine_id: int) -> MachineRecord | None:
    """Return one machine, None if the store does not have it."""
    query = sa.select(database.machines).where(database.machines.c.id == machine_id)
    row = store.read(lambda connection: connection.execute(query).first())
    return None if row is None else MachineRecord(*row)


@dataclass(frozen=True)
class AuditPage:
    """Decisions of one page, newest first, each with machine and version; page number and number of pages."""

    rows: Sequence[tuple[DecisionRecord, str, int | None]]
    page: int
    pages: int


@at_one_moment
def audit_page(store: Store, page: int, *, people: bool) -> AuditPage:
    """Return one page of the audit trail, with ``people`` only the decisions of persons."""
    decisions, tables, machines = database.decisions, database.tables, database.machines
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
