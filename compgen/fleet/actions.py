"""What a person does: approve, reject, roll back, adopt tables, process a stored measurement again.

Each action is stored first; then the machine's files are updated and the notification is sent. ``clock`` gives the time
of a simulated factory; None: the time of the computer or the database.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from compgen.data.machine import load_machine
from compgen.errors import CompgenError, InputError
from compgen.fleet import claims, decisions, inbox, logs
from compgen.fleet.claims import keep_result
from compgen.fleet.decisions import check_person
from compgen.fleet.evidence import Held, held_by
from compgen.fleet.job import Job, MachineJob
from compgen.fleet.process import process
from compgen.fleet.publish import begin_folder, check_folder, note_empty_folder, notify, publish, set_aside
from compgen.fleet.records import (
    ADOPTED,
    HELD_BACK,
    DecisionRecord,
    MachineRecord,
    MeasurementRecord,
    ReprocessRequest,
    TableRecord,
)
from compgen.fleet.store import Clock, Store, open_store
from compgen.fleet.tables_on import LOOKED_BACK
from compgen.kinematics.kernel_switch import one_thread


class NotPublishedError(CompgenError):
    """The decision is in the store, but the files could not be updated; the next run publishes them."""

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

    Errors as for :func:`compgen.fleet.decisions.approve`, and NotPublishedError if the folder cannot be written.
    ``seen`` is the version that the person saw as the active one.
    """

    def decide(store: Store, machine: MachineRecord) -> DecisionRecord:
        return decisions.approve(store, machine, version, actor, reason, override=override, seen=seen)

    return carried_out(job, name, decide, clock)


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
    """Reject a version (None: the only open one)."""

    def decide(store: Store, machine: MachineRecord) -> DecisionRecord:
        chosen = decisions.only_pending(store, machine).version if version is None else version
        return decisions.reject(store, machine, chosen, actor, reason, seen=seen)

    return carried_out(job, name, decide, clock)


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
    """Make an earlier version active again, byte for byte; with ``to`` = 0 none is active."""

    def decide(store: Store, machine: MachineRecord) -> DecisionRecord:
        return decisions.rollback(store, machine, actor, reason, to=to, seen=seen)

    return carried_out(job, name, decide, clock)


def adopt(job: Job, name: str, actor: str, reason: str, *, clock: Clock | None = None) -> Path | None:
    """Give a machine's folder to this store: its contents are set aside, and the store publishes its own files.

    From then on the store does not know which tables are on until one is approved or a measurement states it.

    Returns
    -------
    The folder that the old contents were moved to, None if there were none.

    Raises
    ------
    InputError
        without a name or a reason, or if the folder cannot be written.
    """
    if not actor.strip() or not reason.strip():
        raise InputError("assigning the folder to this store requires a name and a reason", field="--reason")
    machine_job = job.machine(name)
    with closing(open_store(job.store, clock=clock)) as store:
        machine = store.add_machine(name)
        try:
            moved = set_aside(machine_job.out)
        except OSError as error:
            raise InputError(f"cannot be set aside: {error.strerror or error}", file=machine_job.out) from error
        said = "the folder was empty" if moved is None else f"the earlier contents are in {moved.name}"
        store.add_event(ADOPTED, "folder", f"assigned to this store by {actor}, {said}: {reason}", machine)
        publish(store, machine, machine_job.out)
        return moved


def attach_backup(
    job: Job, name: str, paths: Sequence[Path], measurement: str | None = None, *, clock: Clock | None = None
) -> MeasurementRecord:
    """Store a backup of a machine's control as evidence of what it held during a measurement, and return that one.

    Parameters
    ----------
    paths : files of the backup, or folders that contain them.
    measurement : which one, as in a :class:`ReprocessRequest`; None: the one that waits to be processed, the inbox
        included, or the last one if none waits.

    Raises
    ------
    InputError
        if several measurements wait, there is none, or no control of the job can read the files.
    """
    machine_job = job.machine(name)
    files = inbox.read_backup(machine_job, [file for path in paths for file in _files_at(path)])
    with closing(open_store(job.store, clock=clock)) as store:
        machine = store.add_machine(name)
        check_folder(store, machine, machine_job.out)
        inbox.receive(store, machine, machine_job)
        chosen = _meant(store, machine, machine_job) if measurement is None else _chosen(store, machine, measurement)
        held = read_held(store, machine, machine_job, {file: content for file, (content, _) in files.items()})
        store.add_evidence(machine, chosen, files, "command")
        logs.info("backup received", machine=name, measurement=chosen.name, shows=held.words)
        return chosen


def _files_at(path: Path) -> list[Path]:
    """The files of a backup at a path, which may be a link such as ``active``."""
    try:
        real = path.resolve(strict=True)
        return sorted(file for file in real.iterdir() if file.is_file()) if real.is_dir() else [real]
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=path, field="--backup") from error


def _meant(store: Store, machine: MachineRecord, job: MachineJob) -> MeasurementRecord:
    """The measurement to which a backup without a name belongs."""
    measured = {*store.measured(machine).values()}
    known = store.measurements(machine)
    settings = job.settings_sha256()
    attempts = store.attempts(machine)
    failed = {item.measurement_id for item in attempts if item.outcome == "failed" and item.settings_sha256 == settings}
    waiting = [item for item in known if item.id not in measured and item.id not in failed]
    if len(waiting) > 1:
        listed = ", ".join(item.name for item in waiting[:10])
        raise InputError(
            f"{len(waiting)} measurements of {machine.name} wait ({listed}); put each backup beside its measurement, as "
            "NAME.backup.EXT",
            field="--backup",
        )
    if not known:
        raise InputError(
            f"there is no measurement of {machine.name} to which the backup could belong", field="--backup"
        )
    return waiting[0] if waiting else max(known, key=lambda item: item.id)


def carried_out(
    job: Job, name: str, decide: Callable[[Store, MachineRecord], DecisionRecord], clock: Clock | None = None
) -> DecisionRecord:
    """Make a decision about a machine with a function of :mod:`compgen.fleet.decisions`, then update its files."""
    machine_job = job.machine(name)
    with closing(open_store(job.store, clock=clock)) as store:
        machine = store.machine(name)
        check_folder(store, machine, machine_job.out)
        note_empty_folder(store, machine, machine_job.out)
        decision = decide(store, machine)
        _follow(store, machine_job, machine, "The decision is recorded")
        return decision


def _follow(store: Store, job: MachineJob, machine: MachineRecord, done: str) -> None:
    """Publish and notify; NotPublishedError says what was done nevertheless."""
    try:
        publish(store, machine, job.out)
        notify(store, machine, job.notify)
    except CompgenError as error:
        raise NotPublishedError(f"{done}, but the files could not be updated yet: {error}") from error


# --- process a stored measurement again ----------------------------------------------------------------------------
#
# For a changed machine file, instrument, policy or program. Nothing old is replaced: the measurement gets another
# identification and the tables another version, judged like any other. The history says who requested it and why.

SHORTEST_HASH = 8
#: Kind of the events that say why a measurement could not be processed again.
REPROCESS_FAILED = "reprocess"


@dataclass(frozen=True)
class Reprocessed:
    """The measurement, how often it has been identified, and the new version of the tables."""

    measurement: MeasurementRecord
    revision: int
    table: TableRecord

    @property
    def exit_code(self) -> int:
        """0: proposed or active; 1: held back or refused."""
        return 1 if self.table.state in HELD_BACK else 0


def read_held(store: Store, machine: MachineRecord, job: MachineJob, files: Mapping[str, bytes]) -> Held:
    """Read a backup of a machine's control; InputError if no control of the job can read it."""
    known = [table for table in store.tables(machine) if table.accepted]
    try:
        return held_by(store, load_machine(job.machine), job.controllers, known[-LOOKED_BACK:], files)
    except InputError as error:
        raise InputError(
            f"is no backup that {' or '.join(job.controllers)} can read: {error}", field="--backup"
        ) from error


def reprocess(job: Job, name: str, request: ReprocessRequest, *, clock: Clock | None = None) -> Reprocessed:
    """Process a stored measurement of a machine again by the present job, and publish the result.

    Raises
    ------
    InputError
        without a reason, for an unknown machine or measurement.
    CompgenError
        if the measurement cannot be used now (stored as an event), or another runner is working on it.
    """
    machine_job = job.machine(name)
    if request.active_table is not None and not re.fullmatch(r"(?i)none|v?[0-9]{1,9}", request.active_table):
        raise InputError(
            f"{request.active_table!r} is not a version of the tables; give one, e.g. v3, or none",
            field="--active-table",
        )
    if not request.reason.strip() or not request.actor.strip():
        raise InputError("processing a measurement again needs a reason and a name", field="--reason")
    check_person(request.actor)
    if request.backup:
        with closing(open_store(job.store, clock=clock)) as store:
            number = str(_chosen(store, store.machine(name), request.measurement).id)
        attach_backup(job, name, request.backup, number, clock=clock)
    with closing(open_store(job.store, clock=clock)) as store:
        machine = store.machine(name)
        check_folder(store, machine, machine_job.out)
        begin_folder(store, machine, machine_job.out)
        measurement = _chosen(store, machine, request.measurement)
        with one_thread():  # the same bytes however many processors there are
            table, revision = _again(store, machine_job, machine, measurement, request)
        logs.info("measurement processed again", machine=name, measurement=measurement.name, version=table.version)
        _follow(store, machine_job, machine, "The new version is stored")
        return Reprocessed(measurement, revision, table)


def _chosen(store: Store, machine: MachineRecord, requested: str | None) -> MeasurementRecord:
    """Return the measurement with this number, or whose SHA-256 begins with this text; None: the newest."""
    known = store.measurements(machine)
    if not known:
        raise InputError(
            f"the store has no measurement of {machine.name}; `volcomp recal run` reads them from the inbox"
        )
    if requested is None:
        return known[-1]
    text = requested.strip().lower()
    found = [item for item in known if re.fullmatch(r"[0-9]{1,7}", text) and item.id == int(text)]
    if len(text) >= SHORTEST_HASH:
        found += [item for item in known if item.sha256.startswith(text)]
    if len(found) != 1:
        listed = ", ".join(f"{item.id} ({item.name}, {item.sha256[:12]})" for item in known[-5:])
        what = "several begin with this text" if found else f"the newest are {listed}"
        raise InputError(
            f"{requested!r} does not name one measurement of {machine.name}; {what}", field="--measurement"
        )
    return found[0]


def _again(
    store: Store, job: MachineJob, machine: MachineRecord, measurement: MeasurementRecord, request: ReprocessRequest
) -> tuple[TableRecord, int]:
    stated = "" if request.active_table is None else f" with active_table = {request.active_table}"
    why = f"{measurement.name} processed again{stated}: {request.reason}"

    def work(claim: claims.Claim) -> tuple[TableRecord, int]:
        started = time.monotonic()
        done = [item for item in store.identifications(machine) if item.measurement_id == measurement.id]
        revision = 1 + max((item.revision for item in done), default=0)
        try:
            with claims.renewal(store, claim):
                found = process(store, job, machine, measurement, request.active_table)
        except CompgenError as error:
            told = f"{request.actor} ({request.reason}): {error}"
            store.add_event(REPROCESS_FAILED, measurement.name, told, machine)
            raise
        result = replace(
            found.result, seconds=time.monotonic() - started, revision=revision, actor=request.actor, reason=why
        )
        return keep_result(store, machine, claim, result, found.judged_against), revision

    try:
        return claims.work_on(store, measurement, work, again=True)
    except claims.ClaimLostError as error:
        raise claims.ClaimLostError(f"{machine.name}: {measurement.name}: {error}; try again later") from error
