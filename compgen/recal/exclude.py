"""Measurements that a person found to be wrong: they are kept, but the drift of the machine leaves them out.

An exclusion and its withdrawal are events of the store: with who, when and why, and never changed afterwards.
"""

from __future__ import annotations

import re

from compgen.errors import InputError
from compgen.recal.decisions import check_person
from compgen.recal.job import Job
from compgen.recal.records import EventRecord, MachineRecord, TableRecord
from compgen.recal.store import Clock, Store, open_store

KIND = "exclusion"
_SAID = re.compile(r"(excluded|taken back) by (.*?): (.*)", re.DOTALL)


def exclude(
    job: Job, name: str, version: int, actor: str, reason: str, *, undo: bool = False, clock: Clock | None = None
) -> None:
    """Leave the measurement behind a version of tables out of the drift, or with ``undo`` take that back.

    Raises
    ------
    InputError
        for an unknown version, the active one (roll it back first), or without name or reason.
    """
    check_person(actor)
    if ": " in actor or not reason.strip():
        raise InputError("an exclusion needs who says it (a name without ': ') and a reason")
    job.machine(name)
    store = open_store(job.store, clock=clock)
    try:
        machine = store.machine(name)
        table = _table(store, machine, version)
        if table.state == "active" and not undo:
            raise InputError(f"{name}: version {version} is active; if its measurement is wrong, roll it back first")
        said = "taken back" if undo else "excluded"
        store.add_event(KIND, f"version {version}", f"{said} by {actor}: {reason}", machine)
    finally:
        store.close()


def _table(store: Store, machine: MachineRecord, version: int) -> TableRecord:
    tables = store.tables(machine, figures=False)
    found = next((table for table in tables if table.version == version), None)
    if found is None:
        raise InputError(f"{machine.name} has no tables of version {version}; it has 1 to {len(tables)}")
    return found


def said_of(event: EventRecord) -> tuple[str, str, str]:
    """Return what ("excluded", "taken back"), who and why of an event of this kind."""
    found = _SAID.fullmatch(event.message)
    return (found[1], found[2], found[3]) if found else ("excluded", "", event.message)


def excluded(store: Store, machine: MachineRecord) -> dict[int, str]:
    """Return who excluded what and why, in words, by the id of the measurement, whichever version was named."""
    return store.together(lambda: _excluded(store, machine))


def _excluded(store: Store, machine: MachineRecord) -> dict[int, str]:
    measured = {item.id: item.measurement_id for item in store.identifications(machine)}
    tables = store.tables(machine, figures=False)
    behind = {f"version {table.version}": measured[table.identification_id] for table in tables}
    found: dict[int, str] = {}
    for event in store.events(machine):
        if event.kind == KIND:
            what, actor, reason = said_of(event)
            measurement_id = behind[event.subject]
            found.pop(measurement_id, None)
            if what == "excluded":
                found[measurement_id] = f"{event.subject} is left out ({actor}: {reason})"
    return found
