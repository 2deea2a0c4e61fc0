"""What people do: approve, reject, roll back; the decision, the files that follow it, and the notification.

``clock`` tells the time of a simulated factory; None: that of the computer or the database.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from compgen.errors import CompgenError, InputError
from compgen.recal import decisions
from compgen.recal.job import Job, MachineJob
from compgen.recal.judge import ADOPTED
from compgen.recal.notify import notify
from compgen.recal.publish import check_folder, publish, set_aside
from compgen.recal.records import DecisionRecord, MachineRecord
from compgen.recal.store import Clock, Store, open_store


class NotPublishedError(CompgenError):
    """The decision stands in the store, but the files could not follow; the next run publishes them."""

    exit_code = 1


def approve(
    job: Job,
    name: str,
    version: int,
    actor: str,
    reason: str = "",
    *,
    override: bool = False,
    seen: int | None = None,
    clock: Clock | None = None,
) -> DecisionRecord:
    """Approve a version and make its files the active ones.

    Errors as :func:`compgen.recal.decisions.approve` has them, and NotPublishedError if the folder cannot be written.
    ``seen`` is the version that the person saw as the active one.
    """

    def decide(store: Store, machine: MachineRecord) -> DecisionRecord:
        return decisions.approve(store, machine, version, actor, reason, override=override, seen=seen)

    return _done(job.machine(name), job.store, decide, clock)


def reject(
    job: Job,
    name: str,
    version: int | None,
    actor: str,
    reason: str,
    *,
    seen: int | None = None,
    clock: Clock | None = None,
) -> DecisionRecord:
    """Reject a version (None: the only one that is open)."""

    def decide(store: Store, machine: MachineRecord) -> DecisionRecord:
        chosen = decisions.only_pending(store, machine).version if version is None else version
        return decisions.reject(store, machine, chosen, actor, reason, seen=seen)

    return _done(job.machine(name), job.store, decide, clock)


def rollback(
    job: Job,
    name: str,
    actor: str,
    reason: str,
    *,
    to: int | None = None,
    seen: int | None = None,
    clock: Clock | None = None,
) -> DecisionRecord:
    """Make an earlier version active again, byte for byte; ``to`` = 0 leaves none active."""

    def decide(store: Store, machine: MachineRecord) -> DecisionRecord:
        return decisions.rollback(store, machine, actor, reason, to=to, seen=seen)

    return _done(job.machine(name), job.store, decide, clock)


def adopt(job: Job, name: str, actor: str, reason: str, *, clock: Clock | None = None) -> Path | None:
    """Give the folder of a machine to this store: what it holds is set aside, and the store publishes its own.

    From now on the store does not know which tables are on until one is approved or a measurement says it.

    Returns
    -------
    The folder into which what was there was moved, None if there was nothing.

    Raises
    ------
    InputError
        without a name or a reason, or if the folder cannot be written.
    """
    if not actor.strip() or not reason.strip():
        raise InputError("to give a folder to this store, a name and a reason are needed", field="--reason")
    machine_job = job.machine(name)
    store = open_store(job.store, clock=clock)
    try:
        machine = store.add_machine(name)
        try:
            moved = set_aside(machine_job.out)
        except OSError as error:
            raise InputError(f"cannot be set aside: {error.strerror or error}", file=machine_job.out) from error
        said = "nothing was there" if moved is None else f"what was there is in {moved.name}"
        store.add_event(ADOPTED, "folder", f"given to this store by {actor}, {said}: {reason}", machine)
        publish(store, machine, machine_job.out)
        return moved
    finally:
        store.close()


def _done(
    machine_job: MachineJob,
    url: str,
    decide: Callable[[Store, MachineRecord], DecisionRecord],
    clock: Clock | None = None,
) -> DecisionRecord:
    store = open_store(url, clock=clock)
    try:
        machine = store.machine(machine_job.name)
        check_folder(store, machine, machine_job.out)
        decision = decide(store, machine)
        try:
            publish(store, machine, machine_job.out)
            notify(store, machine, machine_job.notify)
        except CompgenError as error:
            raise NotPublishedError(f"The decision stands, but the files could not follow yet: {error}") from error
        return decision
    finally:
        store.close()
