"""Status of the fleet and history of a machine, as plain objects for tables, JSON and pages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, TypeVar

from compgen.recal import exclude
from compgen.recal.job import Job, MachineJob
from compgen.recal.records import AttemptRecord, MachineRecord, TableRecord, reservations_of
from compgen.recal.schedule import Cron, Schedule
from compgen.recal.store import Store

Record = TypeVar("Record")


@dataclass(frozen=True)
class MachineStatus:
    """Where one machine stands; times are ISO texts in UTC.

    ``state``: "new" (nothing was measured), "ok", "waiting" (a person has to decide), "held" (the newest tables are held
    back or refused) or "failed" (the last attempt failed).
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

    def summary(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)


@dataclass(frozen=True)
class Entry:
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


def status(store: Store, job: Job, names: Sequence[str] = ()) -> list[MachineStatus]:
    """Return the status of the machines ``names`` (default all of the job), in the order of the job file."""
    chosen = [job.machine(name) for name in names] if names else list(job.machines.values())
    return store.together(lambda: _status(store, chosen))


def _status(store: Store, chosen: Sequence[MachineJob]) -> list[MachineStatus]:
    known = {machine.name: machine for machine in store.machines()}
    one = known.get(chosen[0].name) if len(chosen) == 1 else None
    tables = _grouped(store.tables(one, figures=False))
    measured = _grouped(store.measurements(one))
    attempts = _grouped(store.attempts(one))
    decided = _grouped(store.decisions(one))
    found = []
    for item in chosen:
        machine = known.get(item.name)
        if machine is None:
            found.append(MachineStatus(item.name, "new", None, None, (), 0, None, "", schedule_text(item.schedule)))
            continue
        own = tables.get(machine.id, [])
        active = next((table for table in own if table.state == "active"), None)
        since = [d.at for d in decided.get(machine.id, []) if active is not None and d.table_id == active.id]
        state, message = _state(own, attempts.get(machine.id, []))
        times = [measurement.measured_at for measurement in measured.get(machine.id, [])]
        found.append(
            MachineStatus(
                machine=item.name,
                state=state if times else "new",
                active=None if active is None else active.version,
                active_since=_iso(max(since)) if since else None,
                waiting=tuple(table.version for table in own if table.state in ("pending", "held")),
                measurements=len(times),
                last_measured=_iso(max(times)) if times else None,
                message=message,
                schedule=schedule_text(item.schedule),
            )
        )
    return found


def _state(tables: Sequence[TableRecord], attempts: Sequence[AttemptRecord]) -> tuple[str, str]:
    if attempts and attempts[-1].outcome == "failed":
        return "failed", attempts[-1].message
    last = tables[-1] if tables else None
    if last is not None and last.state in ("held", "refused"):
        return "held", "; ".join(last.reasons)
    waiting = [str(table.version) for table in tables if table.state == "pending"]
    shown = "; ".join(
        reason for table in tables if table.state == "active" for reason in reservations_of(table.reasons)
    )
    return ("waiting", f"version {', '.join(waiting)} waits for approval") if waiting else ("ok", shown)


def schedule_text(schedule: Schedule | None) -> str:
    """Say in a few words when a machine is looked at."""
    if schedule is None:
        return ""
    return schedule.expression if isinstance(schedule, Cron) else f"every {schedule.minutes} min"


def _grouped(records: Iterable[Record]) -> dict[int, list[Record]]:
    found: dict[int, list[Record]] = {}
    for record in records:
        found.setdefault(record.machine_id, []).append(record)  # type: ignore[attr-defined]
    return found


def history(store: Store, machine: MachineRecord | None = None) -> list[Entry]:
    """Return everything that happened to a machine (or to all), oldest first."""
    return store.together(lambda: _history(store, machine))


def _history(store: Store, machine: MachineRecord | None) -> list[Entry]:
    names = {item.id: item.name for item in store.machines()}
    versions: Mapping[int, int] = {table.id: table.version for table in store.tables(machine, figures=False)}
    entries: list[tuple[datetime, int, Entry]] = []

    def add(at: datetime, order: int, record: Any, kind: str, version: int | None, actor: str, text: str) -> None:
        name = names.get(record.machine_id, "")
        entries.append((at, order, Entry(_iso(at), name, kind, version, actor, text, record.id)))

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
        if event.kind == exclude.KIND:
            what, actor, reason = exclude.said_of(event)
            version = int(event.subject.removeprefix("version "))
            add(event.at, 3, event, event.kind, version, actor, f"measurement {what}: {reason}")
        elif event.kind != "notified":
            add(event.at, 3, event, event.kind, None, "", f"{event.subject}: {event.message}")
    return [entry for _, _, entry in sorted(entries, key=lambda item: (item[0], item[1], item[2].number))]


def _iso(time: datetime) -> str:
    return time.isoformat(timespec="seconds")
