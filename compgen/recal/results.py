"""What processing a measurement adds to the store, in one transaction together with the release of its claim."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa

from compgen.recal import claims, schema
from compgen.recal.blobs import put_blobs
from compgen.recal.claims import Claim
from compgen.recal.decisions import add_decision, locked_decisions
from compgen.recal.records import MachineRecord, NewResult, TableRecord
from compgen.recal.states import AUTOMATIC, OPEN, active_id, state_of
from compgen.recal.store import Store


class ChangedMeanwhileError(claims.ClaimLostError):
    """Other tables became active while the measurement was judged; it has to be judged again."""


def keep_result(
    store: Store, machine: MachineRecord, claim: Claim, new: NewResult, judged_against: int | None
) -> TableRecord:
    """Keep errors, tables and the automatic decisions about them.

    Parameters
    ----------
    claim : it is released; whoever lost it keeps nothing.
    new : what processing gave.
    judged_against : id of the tables that were active when it was judged; ChangedMeanwhileError if others are now.
    """

    def action(connection: sa.Connection) -> int:
        decisions = locked_decisions(connection, machine)
        claims.release(store, connection, claim)
        if active_id(decisions) != judged_against:
            raise ChangedMeanwhileError(f"{machine.name}: other tables became active; the measurement is judged again")
        table_id = _insert(store, connection, machine, claim, new)
        if new.accepted and not new.hold:
            for old in dict.fromkeys(item.table_id for item in decisions):
                if old is not None and state_of(old, decisions) in OPEN:
                    add_decision(store, connection, machine, "supersede", old, AUTOMATIC, "a newer proposal came")
        _decide(store, connection, machine, table_id, new)
        return table_id

    try:
        table_id = store.write(action)
    except claims.ClaimLostError:
        found = _own_result(store, claim, new.revision)
        if found is None:
            raise
        table_id = found
    claims.forget(store, claim)
    return next(table for table in store.tables(machine) if table.id == table_id)


def _own_result(store: Store, claim: Claim, revision: int) -> int | None:
    """Return the tables that this claim led to: the store may have kept a result and gone away before it said so."""
    kept, tried = schema.identifications, schema.attempts
    query = (
        sa.select(schema.tables.c.id)
        .join(kept, kept.c.id == schema.tables.c.identification_id)
        .join(tried, tried.c.measurement_id == kept.c.measurement_id)
        .where(kept.c.measurement_id == claim.measurement_id, kept.c.revision == revision)
        .where(tried.c.outcome == "done", tried.c.owner == claim.owner)
    )
    return store.read(lambda connection: connection.execute(query).scalar())


def _decide(store: Store, connection: sa.Connection, machine: MachineRecord, table_id: int, new: NewResult) -> None:
    reason, actor = "; ".join(filter(None, [new.reason, *new.hold])), new.actor or AUTOMATIC
    if not new.accepted:
        add_decision(store, connection, machine, "refuse", table_id, actor, reason or "not accepted")
    elif new.hold:
        add_decision(store, connection, machine, "hold", table_id, actor, reason)
    else:
        shown = "; ".join(filter(None, [reason, *new.reservations]))
        add_decision(store, connection, machine, "propose", table_id, actor, shown)
        if new.approve:
            add_decision(store, connection, machine, "approve", table_id, AUTOMATIC, "approval = auto")


def _insert(store: Store, connection: sa.Connection, machine: MachineRecord, claim: Claim, new: NewResult) -> int:
    now = store.now(connection)
    parts = [new.machine_text, new.errors_text, new.covariance, new.fitted_text]
    digests = iter(put_blobs(connection, [part for part in parts if part is not None]))
    machine_sha, errors_sha, covariance_sha, fitted_sha = (
        next(digests) if part is not None else None for part in parts
    )
    identification = {
        "machine_id": machine.id,
        "measurement_id": claim.measurement_id,
        "machine_version_id": _machine_version(store, connection, machine, str(machine_sha)),
        "active_table_id": new.active_table_id,
        "errors_sha256": errors_sha,
        "covariance_sha256": covariance_sha,
        "fitted_sha256": fitted_sha,
        "summary": clean(new.summary),
        "program": new.program,
        "at": now,
        "revision": new.revision,
    }
    identification_id = _added(connection, schema.identifications, identification)
    own = schema.tables.c.machine_id == machine.id
    last = connection.execute(sa.select(sa.func.max(schema.tables.c.version)).where(own)).scalar()
    table = {
        "machine_id": machine.id,
        "version": (last or 0) + 1,
        "identification_id": identification_id,
        "accepted": new.accepted,
        "controllers": list(dict.fromkeys(file.controller for file in new.files)),
        "reasons": [*new.hold, *new.reservations],
        "summary": clean(new.judgement),
        "at": now,
    }
    table_id = _added(connection, schema.tables, table)
    for file, digest in zip(new.files, put_blobs(connection, [file.content for file in new.files]), strict=True):
        row = {"table_id": table_id, "controller": file.controller, "name": file.name, "sha256": digest}
        connection.execute(sa.insert(schema.table_files).values(**row))
    add_attempt(store, connection, machine, claim, "done", "", new.settings_sha256, new.seconds)
    return table_id


def _machine_version(store: Store, connection: sa.Connection, machine: MachineRecord, sha256: str) -> int:
    table = schema.machine_versions
    query = sa.select(table.c.id).where(table.c.machine_id == machine.id, table.c.sha256 == sha256)
    known = connection.execute(query).scalar()
    if known is not None:
        return int(known)
    return _added(connection, table, {"machine_id": machine.id, "sha256": sha256, "at": store.now(connection)})


def keep_failure(
    store: Store, machine: MachineRecord, claim: Claim, message: str, settings_sha256: str, seconds: float
) -> None:
    """Keep that a measurement could not be processed, and why; it is tried again when settings or machine change."""

    def action(connection: sa.Connection) -> None:
        claims.release(store, connection, claim)
        add_attempt(store, connection, machine, claim, "failed", message, settings_sha256, seconds)

    store.write(action)
    claims.forget(store, claim)


def add_attempt(
    store: Store,
    connection: sa.Connection,
    machine: MachineRecord,
    claim: Claim,
    outcome: str,
    message: str,
    settings_sha256: str,
    seconds: float,
) -> None:
    """Add one attempt to process a measurement."""
    row = {
        "machine_id": machine.id,
        "measurement_id": claim.measurement_id,
        "outcome": outcome,
        "message": message,
        "settings_sha256": settings_sha256,
        "owner": claim.owner,
        "seconds": seconds,
        "at": store.now(connection),
    }
    connection.execute(sa.insert(schema.attempts).values(**row))


def _added(connection: sa.Connection, table: sa.Table, values: Mapping[str, Any]) -> int:
    key = connection.execute(sa.insert(table).values(**values)).inserted_primary_key
    assert key is not None
    return int(key[0])


def clean(value: Any) -> Any:
    """Return what JSON can hold: a number that is not finite becomes null."""
    return json.loads(json.dumps(_finite(value), default=str))


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    return [_finite(item) for item in value] if isinstance(value, list | tuple) else value
