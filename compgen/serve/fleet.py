"""The fleet at one glance: for each machine what is active, what waits, what failed; without loading any contents."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from compgen.recal import schema
from compgen.recal.records import DecisionRecord, MachineRecord, TableState
from compgen.recal.states import OPEN, active_id, state_of
from compgen.recal.store import Store

#: Machines on one page.
PAGE = 100
#: What is wrong with a machine or waits, the most urgent first, and how it is called.
STATUSES = {
    "failed": "failed",
    "held": "held back",
    "refused": "not accepted",
    "pending": "waits for approval",
    "new": "no tables yet",
    "ok": "up to date",
}


@dataclass(frozen=True)
class FleetRow:
    """One machine: its active version and since when, open versions by state, newest measurement, last failure."""

    machine: MachineRecord
    active: int | None
    active_since: datetime | None
    states: Mapping[int, TableState]
    measured_at: datetime | None
    measurements: int
    failure: str

    @property
    def waiting(self) -> list[int]:
        """Versions that wait for a person, the newest first."""
        return sorted((version for version, state in self.states.items() if state in OPEN), reverse=True)

    @property
    def status(self) -> str:
        """The most urgent of :data:`STATUSES`."""
        if self.failure:
            return "failed"
        newest = self.states.get(max(self.states)) if self.states else "new"
        if newest in ("held", "refused"):
            return newest
        if "pending" in self.states.values():
            return "pending"
        return "ok" if self.active is not None else "new"


def fleet(store: Store) -> list[FleetRow]:
    """Return all machines by name, in one transaction."""
    found = store.read(_everything)
    decided: dict[int, list[DecisionRecord]] = {}
    for row in found["decisions"]:
        decided.setdefault(row.machine_id, []).append(DecisionRecord(*row))
    tables: dict[int, dict[int, int]] = {}
    for row in found["tables"]:
        tables.setdefault(row.machine_id, {})[row.id] = row.version
    measured = {row.machine_id: (row.last, row.count) for row in found["measurements"]}
    failures = {row.machine_id: row.message for row in found["attempts"] if row.outcome == "failed"}
    rows = []
    for row in found["machines"]:
        machine = MachineRecord(*row)
        last, count = measured.get(machine.id, (None, 0))
        own, versions = decided.get(machine.id, []), tables.get(machine.id, {})
        rows.append(_row(machine, own, versions, (last, count), failures.get(machine.id, "")))
    return rows


def _row(
    machine: MachineRecord,
    decisions: Sequence[DecisionRecord],
    versions: Mapping[int, int],
    measured: tuple[datetime | None, int],
    failure: str,
) -> FleetRow:
    by_table: dict[int | None, list[DecisionRecord]] = {}
    for decision in decisions:
        by_table.setdefault(decision.table_id, []).append(decision)
    active = active_id(decisions)
    states: dict[int, TableState] = {}
    for table_id, version in versions.items():
        state = state_of(table_id, by_table.get(table_id, []))
        states[version] = "retired" if state == "active" and table_id != active else state
    since = next((d.at for d in reversed(decisions) if d.kind in ("approve", "rollback")), None)
    current = None if active is None else versions.get(active)
    return FleetRow(machine, current, since if current is not None else None, states, *measured, failure)


def _everything(connection: sa.Connection) -> dict[str, Sequence[Any]]:
    machines, tables, decisions = schema.machines, schema.tables, schema.decisions
    measured, attempts = schema.measurements, schema.attempts
    last = sa.select(sa.func.max(attempts.c.id)).group_by(attempts.c.machine_id)
    queries: dict[str, sa.Select[Any]] = {
        "machines": sa.select(machines).order_by(machines.c.name),
        "tables": sa.select(tables.c.id, tables.c.machine_id, tables.c.version),
        "decisions": sa.select(decisions).order_by(decisions.c.machine_id, decisions.c.sequence),
        "measurements": sa.select(
            measured.c.machine_id,
            sa.func.max(measured.c.measured_at, type_=schema.UtcTime()).label("last"),
            sa.func.count().label("count"),
        ).group_by(measured.c.machine_id),
        "attempts": sa.select(attempts.c.machine_id, attempts.c.outcome, attempts.c.message).where(
            attempts.c.id.in_(last)
        ),
    }
    return {name: connection.execute(query).all() for name, query in queries.items()}


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
