"""Decisions in the store: approve, reject, roll back a set of tables; exclude a measurement from the drift.

Each decision adds one row with who, when and why; nothing else makes tables active. The files are updated from the
store (:func:`compgen.fleet.publish.publish`): a decision counts as soon as it is in the store.
"""

from __future__ import annotations

import re
import unicodedata
from contextlib import closing
from datetime import datetime, timedelta

import sqlalchemy as sa

from compgen.errors import InputError
from compgen.fleet import database
from compgen.fleet.job import Job
from compgen.fleet.records import (
    AUTOMATIC,
    CLOCK,
    OPEN,
    WAS_ACTIVE,
    DecisionKind,
    DecisionRecord,
    EventRecord,
    MachineRecord,
    TableRecord,
    active_id,
    active_of,
    before_active,
    state_of,
)
from compgen.fleet.store import Clock, Store, at_one_moment, files_of, open_store

#: A clock that is behind the last decision by less was not set back: two computers decided one after another.
CLOCKS_DIFFER = timedelta(seconds=2)


class DecisionError(InputError):
    """The state of the tables does not allow this decision."""


def pending(store: Store, machine: MachineRecord | None = None) -> list[TableRecord]:
    """Return the sets of tables that wait for a person: proposed or held back by the policy."""
    return [table for table in store.tables(machine) if table.state in OPEN]


def only_pending(store: Store, machine: MachineRecord) -> TableRecord:
    """Return the only set of a machine's tables that waits for a person; DecisionError if none or several wait."""
    waiting = pending(store, machine)
    if len(waiting) != 1:
        listed = ", ".join(f"{table.version} ({table.state})" for table in waiting)
        raise DecisionError(
            f"{machine.name}: {f'versions {listed} wait for a decision; name one' if waiting else 'nothing waits for a decision'}"
        )
    return waiting[0]


def active_table(store: Store, machine: MachineRecord) -> TableRecord | None:
    """Return the active set of tables, None if none is active."""
    return active_of(store.tables(machine))


def approve(
    store: Store,
    machine: MachineRecord,
    version: int,
    actor: str,
    reason: str = "",
    *,
    override: bool = False,
    seen: int | None = None,
) -> DecisionRecord:
    """Make a proposed version active.

    Parameters
    ----------
    version : version of the machine's tables.
    actor, reason : who, and why; both are stored.
    override : also approve tables that the policy holds back; then a reason is required. Files that the round trip did
        not accept can never be approved.
    seen : version that was active (0: none) when the person looked; DecisionError if another one is active now.

    Raises
    ------
    DecisionError
        for an unknown version, one that is not open, or one that is held back if ``override`` is not given.
    StoreError
        if the contents of its files are missing or damaged in the store.
    """
    check_person(actor)

    def action(connection: sa.Connection) -> DecisionRecord:
        decisions, table_id, accepted = _open(connection, machine, version)
        _check_seen(connection, machine, decisions, seen)
        state = state_of(table_id, decisions)
        if not accepted:
            raise DecisionError(
                _place(machine, version) + " was not accepted by the verification; it cannot be approved"
            )
        if state == "held" and not override:
            raise DecisionError(
                _place(machine, version) + " is held back by the policy; override it with a reason, or reject it"
            )
        if state == "held" and not reason.strip():
            raise DecisionError(
                _place(machine, version) + " is held back by the policy; give the reason for overriding it"
            )
        files_of(connection, table_id)  # StoreError if the files can no longer be written
        return add_decision(store, connection, machine, "approve", table_id, actor, reason)

    return store.write(action)


def reject(
    store: Store, machine: MachineRecord, version: int, actor: str, reason: str, *, seen: int | None = None
) -> DecisionRecord:
    """Refuse a proposed version or one that is held back; DecisionError if it is not open or no reason is given.

    ``seen`` as for :func:`approve`.
    """
    check_person(actor)

    def action(connection: sa.Connection) -> DecisionRecord:
        decisions, table_id, _ = _open(connection, machine, version)
        _check_seen(connection, machine, decisions, seen)
        if not reason.strip():
            raise DecisionError("rejecting tables needs a reason")
        return add_decision(store, connection, machine, "reject", table_id, actor, reason)

    return store.write(action)


def rollback(
    store: Store, machine: MachineRecord, actor: str, reason: str, *, to: int | None = None, seen: int | None = None
) -> DecisionRecord:
    """Make an earlier version active again.

    Parameters
    ----------
    to : version that was active before; 0 for no tables at all; None for the version active before the present one.
    seen : as for :func:`approve`.

    Raises
    ------
    DecisionError
        if nothing is active, the version was never active, or no reason is given.
    StoreError
        if the contents of its files are missing or damaged in the store.
    """
    check_person(actor)

    def action(connection: sa.Connection) -> DecisionRecord:
        decisions = locked_decisions(connection, machine)
        _check_seen(connection, machine, decisions, seen)
        if not reason.strip():
            raise DecisionError("a rollback needs a reason")
        if active_id(decisions) is None and not to:
            raise DecisionError(f"{machine.name}: no tables are active, so there is nothing to undo")
        table_id = before_active(decisions) if to is None else None
        if to:
            table_id, _ = _table_of(connection, machine, to)
            state = state_of(table_id, decisions)
            if state not in WAS_ACTIVE:
                raise DecisionError(f"{_place(machine, to)} is {state}; only a version that was active can come back")
        if table_id is not None:
            files_of(connection, table_id)
        return add_decision(store, connection, machine, "rollback", table_id, actor, reason)

    return store.write(action)


def check_person(actor: str) -> None:
    """Raise DecisionError unless this can be a person's name: one line, all characters visible, not "automatic"."""
    if not actor.strip():
        raise DecisionError("a decision requires the name of the person who makes it")
    plain = unicodedata.normalize("NFKC", actor)  # wide letters, ligatures and hard spaces become plain ones
    if not plain.isprintable():
        shown = actor.encode("unicode_escape").decode("ascii")
        raise DecisionError(f"the name of the person contains control or invisible characters: {shown}")
    if plain.strip().casefold() == AUTOMATIC:
        raise DecisionError(f"{AUTOMATIC!r} is reserved for automatic decisions; give your own name")


def _check_seen(
    connection: sa.Connection, machine: MachineRecord, decisions: list[DecisionRecord], seen: int | None
) -> None:
    """Raise DecisionError unless the version seen as active is still active; under the machine's lock."""
    if seen is None:
        return
    active = active_id(decisions)
    query = sa.select(database.tables.c.version).where(database.tables.c.id == active)
    if seen != (0 if active is None else connection.execute(query).scalar()):
        raise DecisionError(
            f"{machine.name}: the active tables have changed since you looked; look again before you decide"
        )


_LOCK = sa.select(database.machines.c.id).where(database.machines.c.id == sa.bindparam("machine")).with_for_update()
_DECIDED = (
    sa.select(database.decisions)
    .where(database.decisions.c.machine_id == sa.bindparam("machine"))
    .order_by(database.decisions.c.sequence)
)


def locked_decisions(connection: sa.Connection, machine: MachineRecord) -> list[DecisionRecord]:
    """Return the decisions of a machine; nobody else can decide until this transaction ends."""
    connection.execute(_LOCK, {"machine": machine.id})
    return [DecisionRecord(*row) for row in connection.execute(_DECIDED, {"machine": machine.id})]


def add_decision(
    store: Store,
    connection: sa.Connection,
    machine: MachineRecord,
    kind: DecisionKind,
    table_id: int | None,
    actor: str,
    reason: str,
) -> DecisionRecord:
    """Add one decision; its time is never earlier than the previous decision's, whatever the clock says.

    Times tell which tables were on, so an event records that the clock went back: a measurement between such decisions
    has to say which they were.
    """
    last = next(iter(connection.execute(_DECIDED, {"machine": machine.id}).all()[-1:]), None)
    now = store.now(connection)
    if last is not None and last.at > now + CLOCKS_DIFFER:
        text = f"the clock went backwards: at {_seconds(now)} a decision got the time of the one before, {_seconds(last.at)}"
        event = {"machine_id": machine.id, "kind": CLOCK, "subject": CLOCK, "message": text, "at": now}
        connection.execute(sa.insert(database.events), event)
    row = {
        "machine_id": machine.id,
        "sequence": 1 if last is None else last.sequence + 1,
        "table_id": table_id,
        "kind": kind,
        "actor": actor,
        "reason": reason,
        "at": now if last is None else max(now, last.at),
    }
    connection.execute(sa.insert(database.decisions), row)
    return DecisionRecord(*connection.execute(_DECIDED, {"machine": machine.id}).all()[-1])  # as it is stored


def _seconds(time: datetime) -> str:
    return time.isoformat(timespec="seconds")


def _open(connection: sa.Connection, machine: MachineRecord, version: int) -> tuple[list[DecisionRecord], int, bool]:
    """Return decisions, id and acceptance of an open version; under the machine's lock."""
    decisions = locked_decisions(connection, machine)
    table_id, accepted = _table_of(connection, machine, version)
    state = state_of(table_id, decisions)
    if state not in (*OPEN, "refused"):
        raise DecisionError(f"{_place(machine, version)} is {state}; only pending or held tables can be decided on")
    return decisions, table_id, accepted


def _table_of(connection: sa.Connection, machine: MachineRecord, version: int) -> tuple[int, bool]:
    table = database.tables
    own = table.c.machine_id == machine.id
    row = connection.execute(sa.select(table.c.id, table.c.accepted).where(own, table.c.version == version)).first()
    if row is None:
        known = connection.execute(sa.select(sa.func.max(table.c.version)).where(own)).scalar()
        having = f"it has 1 to {known}" if known else "it has none"
        raise DecisionError(f"{machine.name} has no tables of version {version}; {having}")
    return int(row.id), bool(row.accepted)


def _place(machine: MachineRecord, version: int) -> str:
    return f"{machine.name}: version {version}"


# --- measurements that a person found to be wrong ------------------------------------------------------------------
#
# They are kept, but left out of the machine's drift. An exclusion and its withdrawal are events in the store.

#: Kind of the events that exclude a measurement, or take the exclusion back.
EXCLUSION = "exclusion"
_SAID = re.compile(r"(excluded|taken back) by (.*?): (.*)", re.DOTALL)


def exclude(
    job: Job, name: str, version: int, actor: str, reason: str, *, undo: bool = False, clock: Clock | None = None
) -> None:
    """Exclude the measurement behind a version of tables from the drift; with ``undo`` take the exclusion back.

    Raises
    ------
    InputError
        for an unknown version, the active version (roll it back first), or without name or reason.
    """
    check_person(actor)
    if ": " in actor or not reason.strip():
        raise InputError("an exclusion needs a name (without ': ') and a reason")
    job.machine(name)
    with closing(open_store(job.store, clock=clock)) as store:
        machine = store.machine(name)
        states = {table.version: table.state for table in store.tables(machine, figures=False)}
        if version not in states:
            raise InputError(f"{machine.name} has no tables of version {version}; it has 1 to {len(states)}")
        if states[version] == "active" and not undo:
            raise InputError(f"{name}: version {version} is active; if its measurement is wrong, roll it back first")
        said = "taken back" if undo else "excluded"
        store.add_event(EXCLUSION, f"version {version}", f"{said} by {actor}: {reason}", machine)


def said_of(event: EventRecord) -> tuple[str, str, str]:
    """Return what ("excluded", "taken back"), who and why from an event of this kind."""
    found = _SAID.fullmatch(event.message)
    return (found[1], found[2], found[3]) if found else ("excluded", "", event.message)


@at_one_moment
def excluded(store: Store, machine: MachineRecord) -> dict[int, str]:
    """Return in words who excluded what and why, by measurement id, whichever version was named."""
    measured = {item.id: item.measurement_id for item in store.identifications(machine)}
    tables = store.tables(machine, figures=False)
    behind = {f"version {table.version}": measured[table.identification_id] for table in tables}
    found: dict[int, str] = {}
    for event in store.events(machine):
        if event.kind == EXCLUSION:
            what, actor, reason = said_of(event)
            measurement_id = behind[event.subject]
            found.pop(measurement_id, None)
            if what == "excluded":
                found[measurement_id] = f"{event.subject} is left out ({actor}: {reason})"
    return found
