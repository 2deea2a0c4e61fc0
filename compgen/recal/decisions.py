"""Approve, reject, roll back: each adds one decision with who, when and why; nothing else makes tables active.

The files follow the store (:func:`compgen.recal.publish.publish`), so a decision counts once it stands in the store.
"""

from __future__ import annotations

import unicodedata

import sqlalchemy as sa

from compgen.errors import InputError
from compgen.recal import schema
from compgen.recal.records import DecisionKind, DecisionRecord, MachineRecord, TableRecord
from compgen.recal.states import AUTOMATIC, OPEN, WAS_ACTIVE, active_id, before_active, state_of
from compgen.recal.store import Store, files_of


class DecisionError(InputError):
    """The tables are in no state in which this can be decided."""


def pending(store: Store, machine: MachineRecord | None = None) -> list[TableRecord]:
    """Return the sets of tables that wait for a person: proposed ones, and those that the policy holds back."""
    return [table for table in store.tables(machine) if table.state in OPEN]


def only_pending(store: Store, machine: MachineRecord) -> TableRecord:
    """Return the only set of tables of a machine that waits for a person; DecisionError if none or several do."""
    waiting = pending(store, machine)
    if len(waiting) != 1:
        listed = ", ".join(f"{table.version} ({table.state})" for table in waiting)
        raise DecisionError(
            f"{machine.name}: {f'versions {listed} wait; name one' if waiting else 'nothing waits for a decision'}"
        )
    return waiting[0]


def active_table(store: Store, machine: MachineRecord) -> TableRecord | None:
    """Return the set of tables that is active, None if none is."""
    return next((table for table in store.tables(machine) if table.state == "active"), None)


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
    actor, reason : who, and why; both are kept.
    override : also for tables that the policy holds back; then a reason is due. Files that the round trip did not
        accept can never be approved.
    seen : version that was active (0: none) when the person looked; DecisionError if another one is by now.

    Raises
    ------
    DecisionError
        for an unknown version, one that is not open, one that is held back without ``override``.
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
                _place(machine, version) + " was not accepted by the round trip; it can not be approved"
            )
        if state == "held" and not override:
            raise DecisionError(
                _place(machine, version) + " is held back by the policy; override it with a reason, or reject it"
            )
        if state == "held" and not reason.strip():
            raise DecisionError(
                _place(machine, version) + " is held back by the policy; say the reason why it is right"
            )
        files_of(connection, table_id)  # nobody decides for files that nobody can write any more
        return add_decision(store, connection, machine, "approve", table_id, actor, reason)

    return store.write(action)


def reject(
    store: Store, machine: MachineRecord, version: int, actor: str, reason: str, *, seen: int | None = None
) -> DecisionRecord:
    """Refuse a proposed version or one that is held back; DecisionError where it is not open or no reason is given.

    ``seen`` as for :func:`approve`.
    """
    check_person(actor)

    def action(connection: sa.Connection) -> DecisionRecord:
        decisions, table_id, _ = _open(connection, machine, version)
        _check_seen(connection, machine, decisions, seen)
        if not reason.strip():
            raise DecisionError("to reject tables a reason is due")
        return add_decision(store, connection, machine, "reject", table_id, actor, reason)

    return store.write(action)


def rollback(
    store: Store, machine: MachineRecord, actor: str, reason: str, *, to: int | None = None, seen: int | None = None
) -> DecisionRecord:
    """Make an earlier version active again.

    Parameters
    ----------
    to : version that was active before; 0 for no tables at all; None for the one that was active before this one.
    seen : as for :func:`approve`.

    Raises
    ------
    DecisionError
        where nothing is active, the version was never active, or no reason is given.
    StoreError
        if the contents of its files are missing or damaged in the store.
    """
    check_person(actor)

    def action(connection: sa.Connection) -> DecisionRecord:
        decisions = locked_decisions(connection, machine)
        _check_seen(connection, machine, decisions, seen)
        if not reason.strip():
            raise DecisionError("to roll back a reason is due")
        if active_id(decisions) is None and not to:
            raise DecisionError(f"{machine.name}: no tables are active, so there is nothing to undo")
        table_id = before_active(decisions) if to is None else _earlier(connection, machine, decisions, to)
        if table_id is not None:
            files_of(connection, table_id)
        return add_decision(store, connection, machine, "rollback", table_id, actor, reason)

    return store.write(action)


def check_person(actor: str) -> None:
    """Raise DecisionError unless this can be the name of a person: one line that shows all of itself, not "automatic"."""
    if not actor.strip():
        raise DecisionError("a decision needs the name of who makes it")
    plain = unicodedata.normalize("NFKC", actor)  # wide letters, ligatures and hard spaces as the usual ones
    if not plain.isprintable():
        shown = actor.encode("unicode_escape").decode("ascii")
        raise DecisionError(f"the name of who decides holds control characters or ones that do not show: {shown}")
    if plain.strip().casefold() == AUTOMATIC:
        raise DecisionError(f"{AUTOMATIC!r} is what decisions without a person are signed with; give your own name")


def _earlier(
    connection: sa.Connection, machine: MachineRecord, decisions: list[DecisionRecord], version: int
) -> int | None:
    if version == 0:
        return None
    table_id, _ = _table_of(connection, machine, version)
    state = state_of(table_id, decisions)
    if state not in WAS_ACTIVE:
        raise DecisionError(f"{_place(machine, version)} is {state}; only a version that was active can come back")
    return table_id


def _check_seen(
    connection: sa.Connection, machine: MachineRecord, decisions: list[DecisionRecord], seen: int | None
) -> None:
    """Raise DecisionError unless the version that was seen as the active one still is, under the machine's lock."""
    if seen is None:
        return
    active = active_id(decisions)
    query = sa.select(schema.tables.c.version).where(schema.tables.c.id == active)
    if seen != (0 if active is None else connection.execute(query).scalar()):
        raise DecisionError(
            f"{machine.name}: other tables became active since you looked; look again before you decide"
        )


def locked_decisions(connection: sa.Connection, machine: MachineRecord) -> list[DecisionRecord]:
    """Return the decisions of a machine and keep others from deciding until this transaction ends."""
    connection.execute(sa.select(schema.machines.c.id).where(schema.machines.c.id == machine.id).with_for_update())
    table = schema.decisions
    query = sa.select(table).where(table.c.machine_id == machine.id).order_by(table.c.sequence)
    return [DecisionRecord(*row) for row in connection.execute(query)]


def add_decision(
    store: Store,
    connection: sa.Connection,
    machine: MachineRecord,
    kind: DecisionKind,
    table_id: int | None,
    actor: str,
    reason: str,
) -> DecisionRecord:
    """Add one decision; its time is never before that of the one before it, whatever the clock says."""
    table = schema.decisions
    own = table.c.machine_id == machine.id
    last = connection.execute(sa.select(table).where(own).order_by(table.c.sequence.desc()).limit(1)).first()
    now = store.now(connection)
    row = {
        "machine_id": machine.id,
        "sequence": 1 if last is None else last.sequence + 1,
        "table_id": table_id,
        "kind": kind,
        "actor": actor,
        "reason": reason,
        "at": now if last is None else max(now, last.at),
    }
    connection.execute(sa.insert(table).values(**row))
    stored = sa.select(table).where(own, table.c.sequence == row["sequence"])
    return DecisionRecord(*connection.execute(stored).one())


def _open(connection: sa.Connection, machine: MachineRecord, version: int) -> tuple[list[DecisionRecord], int, bool]:
    """Return decisions, id and acceptance of a version that is open, under the machine's lock."""
    decisions = locked_decisions(connection, machine)
    table_id, accepted = _table_of(connection, machine, version)
    state = state_of(table_id, decisions)
    if state not in (*OPEN, "refused"):
        raise DecisionError(f"{_place(machine, version)} is {state}; only pending or held tables can be decided on")
    return decisions, table_id, accepted


def _table_of(connection: sa.Connection, machine: MachineRecord, version: int) -> tuple[int, bool]:
    table = schema.tables
    own = table.c.machine_id == machine.id
    row = connection.execute(sa.select(table.c.id, table.c.accepted).where(own, table.c.version == version)).first()
    if row is None:
        known = connection.execute(sa.select(sa.func.max(table.c.version)).where(own)).scalar()
        having = f"it has 1 to {known}" if known else "it has none"
        raise DecisionError(f"{machine.name} has no tables of version {version}; {having}")
    return int(row.id), bool(row.accepted)


def _place(machine: MachineRecord, version: int) -> str:
    return f"{machine.name}: version {version}"
