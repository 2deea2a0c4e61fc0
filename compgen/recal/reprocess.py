"""Identify and export again from a stored measurement, after machine file, instrument, policy or program changed.

Nothing old is replaced: there is one more identification of the measurement and one more version of the tables, judged as
any other; who wanted it and why stand in the history.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, replace

from compgen.core.threads import one_thread
from compgen.errors import CompgenError, InputError
from compgen.recal import claims, logs
from compgen.recal.actions import NotPublishedError
from compgen.recal.decisions import check_person
from compgen.recal.job import Job, MachineJob
from compgen.recal.notify import notify
from compgen.recal.process import process, without_folder
from compgen.recal.publish import check_folder, publish
from compgen.recal.records import MachineRecord, MeasurementRecord, TableRecord
from compgen.recal.results import ChangedMeanwhileError, keep_result
from compgen.recal.store import Clock, Store, open_store

#: How often it is judged again because other tables became active meanwhile.
JUDGED_AT_MOST = 5
SHORTEST_HASH = 8
KIND = "reprocess"


@dataclass(frozen=True)
class Reprocessed:
    """The measurement, how often it was identified by now, and the new version of the tables."""

    measurement: MeasurementRecord
    revision: int
    table: TableRecord

    @property
    def exit_code(self) -> int:
        """0: proposed or active; 1: held back or refused."""
        return 1 if self.table.state in ("held", "refused") else 0


@dataclass(frozen=True)
class Wish:
    """Which measurement (None: the newest), who wants it and why.

    ``active_table`` states which tables were on while it was made, a version or "none"; None: what the file says.
    """

    measurement: str | None
    actor: str
    reason: str
    active_table: str | None = None


def reprocess(job: Job, name: str, wish: Wish, *, clock: Clock | None = None) -> Reprocessed:
    """Process a stored measurement of a machine again, as the job says now, and publish what comes of it.

    Raises
    ------
    InputError
        without a reason, for an unknown machine or measurement.
    CompgenError
        if the measurement cannot be used now, which is kept as an event, or another runner works on it.
    """
    machine_job = job.machine(name)
    if wish.active_table is not None and not re.fullmatch(r"(?i)none|v?[0-9]{1,9}", wish.active_table):
        raise InputError(f"{wish.active_table!r} names no tables; give a version (v3) or none", field="--active-table")
    if not wish.reason.strip() or not wish.actor.strip():
        raise InputError("to process a measurement again a reason and a name are due", field="--reason")
    check_person(wish.actor)
    store = open_store(job.store, clock=clock)
    try:
        machine = store.machine(name)
        check_folder(store, machine, machine_job.out)
        measurement = _chosen(store, machine, wish.measurement)
        with one_thread():  # the same bytes however many processors there are
            table, revision = _again(store, machine_job, machine, measurement, wish)
        logs.info("measurement processed again", machine=name, measurement=measurement.name, version=table.version)
        _follow(store, machine_job, machine)
        return Reprocessed(measurement, revision, table)
    finally:
        store.close()


def _chosen(store: Store, machine: MachineRecord, wanted: str | None) -> MeasurementRecord:
    """Return the measurement with this number, or SHA-256 that begins like this; without either the newest."""
    known = store.measurements(machine)
    if not known:
        raise InputError(f"the store holds no measurement of {machine.name}; `volcomp recal run` takes them in")
    if wanted is None:
        return known[-1]
    text = wanted.strip().lower()
    found = [item for item in known if re.fullmatch(r"[0-9]{1,7}", text) and item.id == int(text)]
    if len(text) >= SHORTEST_HASH:
        found += [item for item in known if item.sha256.startswith(text)]
    if len(found) != 1:
        listed = ", ".join(f"{item.id} ({item.name}, {item.sha256[:12]})" for item in known[-5:])
        what = "several begin like that" if found else "it has, the newest last: " + listed
        raise InputError(f"{machine.name} has no one measurement {wanted!r}; {what}", field="--measurement")
    return found[0]


def _again(
    store: Store, job: MachineJob, machine: MachineRecord, measurement: MeasurementRecord, wish: Wish
) -> tuple[TableRecord, int]:
    for _ in range(JUDGED_AT_MOST):
        claim = claims.take(store, measurement, claims.owner_name(), again=True)
        if claim is None:
            raise claims.ClaimLostError(f"{machine.name}: another runner works on {measurement.name}; try again later")
        done = [item for item in store.identifications(machine) if item.measurement_id == measurement.id]
        revision = 1 + max((item.revision for item in done), default=0)
        try:
            return _kept(store, job, machine, (measurement, claim), wish, revision), revision
        except ChangedMeanwhileError:
            claims.give_back(store, claim)
        except BaseException as error:
            claims.give_back(store, claim)
            if isinstance(error, CompgenError):
                told = f"{wish.actor} ({wish.reason}): {without_folder(str(error))}"
                store.add_event(KIND, measurement.name, told, machine)
            raise
    raise claims.ClaimLostError(f"{machine.name}: other tables become active again and again; try again later")


def _kept(
    store: Store,
    job: MachineJob,
    machine: MachineRecord,
    work: tuple[MeasurementRecord, claims.Claim],
    wish: Wish,
    revision: int,
) -> TableRecord:
    measurement, claim = work
    started = time.monotonic()
    with claims.Renewal(store, claim):
        done = process(store, job, machine, measurement, wish.active_table)
    stated = "" if wish.active_table is None else f" with active_table = {wish.active_table}"
    why = f"{measurement.name} processed again{stated}: {wish.reason}"
    who = {"revision": revision, "actor": wish.actor, "reason": why}
    result = replace(done.result, seconds=time.monotonic() - started, **who)  # type: ignore[arg-type]
    return keep_result(store, machine, claim, result, done.judged_against)


def _follow(store: Store, job: MachineJob, machine: MachineRecord) -> None:
    try:
        publish(store, machine, job.out)
        notify(store, machine, job.notify)
    except CompgenError as error:
        raise NotPublishedError(f"The new version stands, but the files could not follow yet: {error}") from error
