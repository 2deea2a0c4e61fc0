"""Which identification speaks for a measurement that was identified several times (:mod:`compgen.recal.reprocess`)."""

from __future__ import annotations

from compgen.recal.records import IdentificationRecord, MachineRecord, TableRecord
from compgen.recal.store import Store


def counting(store: Store, machine: MachineRecord) -> list[IdentificationRecord]:
    """Return for each measurement the identification that speaks for it, in the order in which they were measured.

    It is the one behind the active tables; else the newest whose tables nobody rejected and the round trip accepted; else
    the newest.
    """

    def read() -> tuple[list[TableRecord], list[IdentificationRecord]]:
        return store.tables(machine, figures=False), store.identifications(machine)

    tables, identifications = store.together(read)
    states = {table.identification_id: table.state for table in tables}
    every: dict[int, list[IdentificationRecord]] = {}
    for item in identifications:
        every.setdefault(item.measurement_id, []).append(item)

    def rank(item: IdentificationRecord) -> tuple[int, int]:
        state = states.get(item.id)
        return {"active": 2, "rejected": 0, "refused": 0}.get(state or "", 1), item.revision

    return [max(group, key=rank) for group in every.values()]
