"""What people do: approve, reject, roll back; the decision, the files that follow it, and the notification.

``clock`` tells the time of a simulated factory; None: that of the computer or the database.
"""

from __future__ import annotations

from collections.abc import Callable

from compgen.recal import decisions
from compgen.recal.decisions import DecisionError
from compgen.recal.job import Job, MachineJob
from compgen.recal.notify import notify
from compgen.recal.publish import publish
from compgen.recal.records import DecisionRecord, MachineRecord
from compgen.recal.store import Clock, Store, open_store


def approve(
    job: Job,
    name: str,
    version: int | None,
    actor: str,
    reason: str = "",
    *,
    override: bool = False,
    clock: Clock | None = None,
) -> DecisionRecord:
    """Approve a version (None: the only one that is pending) and make its files the active ones.

    Errors as :func:`compgen.recal.decisions.approve` has them, and InputError if the folder cannot be written: the
    decision stands then, and the next run publishes it.
    """

    def decide(store: Store, machine: MachineRecord) -> DecisionRecord:
        chosen = _chosen(store, machine, version)
        return decisions.approve(store, machine, chosen, actor, reason, override=override)

    return _done(job.machine(name), job.store, decide, clock)


def reject(
    job: Job, name: str, version: int | None, actor: str, reason: str, *, clock: Clock | None = None
) -> DecisionRecord:
    """Reject a version (None: the only one that is open)."""

    def decide(store: Store, machine: MachineRecord) -> DecisionRecord:
        return decisions.reject(store, machine, _chosen(store, machine, version), actor, reason)

    return _done(job.machine(name), job.store, decide, clock)


def rollback(
    job: Job, name: str, actor: str, reason: str, *, to: int | None = None, clock: Clock | None = None
) -> DecisionRecord:
    """Make an earlier version active again, byte for byte; ``to`` = 0 leaves none active."""
    return _done(
        job.machine(name), job.store, lambda store, m: decisions.rollback(store, m, actor, reason, to=to), clock
    )


def _chosen(store: Store, machine: MachineRecord, version: int | None) -> int:
    if version is not None:
        return version
    waiting = decisions.pending(store, machine)
    if len(waiting) != 1:
        listed = ", ".join(f"{table.version} ({table.state})" for table in waiting)
        raise DecisionError(
            f"{machine.name}: {f'versions {listed} wait; name one' if waiting else 'nothing waits for a decision'}"
        )
    return waiting[0].version


def _done(
    machine_job: MachineJob,
    url: str,
    decide: Callable[[Store, MachineRecord], DecisionRecord],
    clock: Clock | None = None,
) -> DecisionRecord:
    store = open_store(url, clock=clock)
    try:
        machine = store.machine(machine_job.name)
        decision = decide(store, machine)
        publish(store, machine, machine_job.out)
        notify(store, machine, machine_job.notify)
        return decision
    finally:
        store.close()
