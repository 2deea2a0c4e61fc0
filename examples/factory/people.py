"""What the people of the factory decide about tables, by rules that a foreman could write down."""

from dataclasses import dataclass

from compgen.fleet import actions, decisions
from compgen.fleet.job import Job
from compgen.fleet.records import RESERVATION, TableRecord
from compgen.fleet.store import Clock, open_store


@dataclass(frozen=True)
class Decision:
    """Kind (approve, override, reject), who and why."""

    kind: str
    actor: str
    reason: str


def opinion(table: TableRecord, *, crashed: bool, has_tables: bool) -> Decision:
    """What Ada, who is in charge, decides about one proposed or held version."""
    if table.state == "pending":
        return Decision("approve", "ada", "")
    held = [reason for reason in table.reasons if not reason.startswith(RESERVATION)]
    reasons = " ".join(held)
    limit_only = all("the correction changes by up to" in reason for reason in held)
    if crashed and limit_only:
        return Decision("override", "ada", "the crash of 20 June moved axis Y; a gauge block shows the same")
    if not has_tables and "degC are allowed" in reasons and len(held) == 1:
        return Decision("override", "ada", "first tables; the hall is cold, and none would be worse")
    if "days old" in reasons:
        return Decision("reject", "ada", "an old file")
    if "degC are allowed" in reasons:
        return Decision("reject", "ada", "too warm or too cold")
    if "within its uncertainty" in reasons:
        return Decision("reject", "ada", "nothing changed")
    return Decision("reject", "ada", "looks wrong; measure again")


def decide(job: Job, name: str, clock: Clock, *, crashed: bool = False) -> dict[int, Decision]:
    """Decide about everything that waits at a machine; return the decisions by version."""
    store = open_store(job.store)
    try:
        machine = store.machine(name)
        waiting, active = decisions.pending(store, machine), decisions.active_table(store, machine)
    finally:
        store.close()
    made = {}
    for table in waiting:
        chosen = opinion(table, crashed=crashed, has_tables=active is not None)
        carry_out(job, name, table.version, chosen, clock)
        made[table.version] = chosen
    return made


def carry_out(job: Job, name: str, version: int, chosen: Decision, clock: Clock) -> None:
    """Do what was decided."""
    if chosen.kind == "reject":
        actions.reject(job, name, version, chosen.actor, chosen.reason, clock=clock)
    else:
        override = chosen.kind == "override"
        actions.approve(job, name, version, chosen.actor, chosen.reason, override=override, clock=clock)
