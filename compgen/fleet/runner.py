"""One pass over the machines of a job: take new files from the inboxes, process, store and publish them.

Machines do not affect each other: whatever goes wrong with one becomes part of its outcome. The passes run in this
process (:func:`run_jobs`), or in processes of this computer or on a cluster (:func:`run_fleet`), with the same results.
"""

from __future__ import annotations

import errno
import sys
import time
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from compgen.data.files import FOLDERS, naming_below, read_bytes, remove_abandoned_folders, sha256_of, working_folder
from compgen.data.machine import load_machine
from compgen.errors import CompgenError, InputError, visible
from compgen.fleet import claims, inbox, logs
from compgen.fleet.claims import Claim, ClaimLostError, keep_failure, keep_result
from compgen.fleet.database import StoreError, plain, sqlite_path
from compgen.fleet.job import Job, MachineJob
from compgen.fleet.process import FOLDER, again_of, confirmation, process, write_files
from compgen.fleet.publish import begin_folder, check_folder, is_published, notify, publish, untold
from compgen.fleet.records import (
    HELD_BACK,
    OPEN,
    AttemptRecord,
    MachineRecord,
    MeasurementRecord,
    TableRecord,
    active_of,
)
from compgen.fleet.store import Clock, Store, open_store
from compgen.kinematics.kernel_switch import one_thread
from compgen.parallel import (
    ClusterError,
    LostError,
    Packed,
    Processes,
    Stop,
    StoppedError,
    Workers,
    limited,
    spread,
    stopping,
)
from compgen.plugins import WithPlugins, with_plugins

#: Causes that may go away by themselves, so a measurement is retried instead of given up: a full disk or quota, a file
#: that cannot be read now, too many open files, another process that keeps a folder.
PASSING = (
    errno.EAGAIN,
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.EACCES,
    errno.EPERM,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
    errno.EROFS,
    errno.ESTALE,
    errno.EBUSY,
)


def passes(error: BaseException) -> bool:
    """Whether the cause may go away by itself: one of :data:`PASSING`, too little memory, an unreachable store."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError | StoreError) or (isinstance(cause, OSError) and cause.errno in PASSING):
            return True
        cause = cause.__cause__
    return False


StopCheck = Callable[[], bool]
Mapper = Callable[[Callable[[MachineJob], "MachineOutcome"], Iterable[MachineJob]], Iterable["MachineOutcome"]]


@dataclass(frozen=True)
class MachineOutcome:
    """Result of one pass over one machine; it can be sent between processes.

    ``state`` is "ok", "held" (the newest tables are held back or refused), "failed" (something could not be taken or
    processed) or "stopped" (the pass ended before its turn: nothing is known of it); ``messages`` say why. ``processed``
    names the measurements of this pass, ``active`` is the active version, ``waiting`` are the versions that wait for a
    person. ``again``: the cause may go away by itself (a full disk, an unreadable file, another runner, an unreachable
    store); ``unreachable``: it is the store.
    """

    machine: str
    state: str
    messages: tuple[str, ...] = ()
    processed: tuple[str, ...] = ()
    active: int | None = None
    waiting: tuple[int, ...] = ()
    internal: bool = False
    seconds: float = 0.0
    again: bool = False
    unreachable: bool = False


@dataclass(frozen=True)
class RunOutcome:
    """Outcome of a pass over all machines, in the order of the job file."""

    outcomes: tuple[MachineOutcome, ...]

    @property
    def accepted(self) -> bool:
        """Whether nothing failed and nothing is held back."""
        return all(item.state in ("ok", "stopped") for item in self.outcomes)

    @property
    def exit_code(self) -> int:
        """0: all is well; 1: something is held back or failed; 2: the store is unreachable; 3: an internal error."""
        if any(item.internal for item in self.outcomes):
            return 3
        return 2 if any(item.unreachable for item in self.outcomes) else 0 if self.accepted else 1

    def summary(self) -> dict[str, Any]:
        """Return the object that ``--json`` prints."""
        return {"accepted": self.accepted, "machines": [asdict(item) for item in self.outcomes]}


def run_jobs(
    job: Job,
    names: Sequence[str] = (),
    *,
    mapper: Mapper = map,
    stop: StopCheck = lambda: False,
    clock: Clock | None = None,
) -> RunOutcome:
    """Make one pass over the machines ``names`` (default all); ``mapper`` may distribute them over processes.

    ``clock`` gives the time of a simulated factory; None: the time of the computer or the database.

    Raises
    ------
    StoreError
        if the store cannot be reached at all.
    """
    chosen = [job.machine(name) for name in names] if names else list(job.machines.values())
    chosen = inbox.with_twins(chosen, job.machines.values())
    remove_abandoned_folders()
    with closing(open_store(job.store, clock=clock)) as store:
        if mapper is map:
            return RunOutcome(tuple(_passed(lambda: nullcontext(store), item, stop) for item in chosen))
    return RunOutcome(tuple(mapper(partial(run_machine, url=job.store, clock=clock), chosen)))


def run_machine(
    job: MachineJob, url: str, stop: StopCheck = lambda: False, clock: Clock | None = None
) -> MachineOutcome:
    """Make one pass over one machine; whatever goes wrong is part of the outcome, nothing is raised."""
    return _passed(lambda: closing(open_store(url, clock=clock)), job, stop)


def _passed(
    opened: Callable[[], AbstractContextManager[Store]],
    job: MachineJob,
    stop: StopCheck,
    elsewhere: Callable[[MachineJob], MachineOutcome] | None = None,
) -> MachineOutcome:
    started = time.monotonic()
    if stop():
        return MachineOutcome(job.name, "stopped", ("not checked: stopped",))
    try:
        with opened() as store:
            outcome = _Pass(store, job, store.add_machine(job.name), stop, elsewhere).run()
    except (LostError, StoppedError, ClusterError):  # from workers in other processes
        raise
    except CompgenError as error:
        lost = isinstance(error, StoreError)
        outcome = MachineOutcome(job.name, "failed", (plain(str(error)),), again=passes(error), unreachable=lost)
    except Exception as error:  # a bug here must not stop the other machines
        outcome = MachineOutcome(
            job.name, "failed", (f"internal error: {type(error).__name__}: {error}",), internal=True
        )
    outcome = replace(outcome, seconds=time.monotonic() - started)
    write = logs.info if outcome.state == "ok" else logs.warning
    write("machine done", **{key: value for key, value in asdict(outcome).items() if value not in (None, (), False)})
    return outcome


class _Pass:
    """One pass over one machine; collects messages on the way. ``elsewhere`` processes instead of this process."""

    def __init__(
        self,
        store: Store,
        job: MachineJob,
        machine: MachineRecord,
        stop: StopCheck,
        elsewhere: Callable[[MachineJob], MachineOutcome] | None = None,
    ) -> None:
        self.store, self.job, self.machine, self.stop, self.elsewhere = store, job, machine, stop, elsewhere
        self.messages: list[str] = []
        self.processed: list[str] = []
        self.present: set[str] = set()
        self.backups: dict[str, dict[str, tuple[bytes, datetime]]] = {}
        self.failed = False
        self.internal = False
        self.again = False

    def run(self) -> MachineOutcome:
        """Take, process, publish, notify; if nothing is new, one snapshot of the store is read, nothing is written."""
        found, received = inbox.scan(self.job, self.store.now()), []
        problems = [(problem.subject, problem.message) for problem in found.problems]
        for group in found.groups:
            try:
                received.append(inbox.read_files(self.job, group))
            except CompgenError as error:
                place = str(getattr(error, "file", None) or group[0])
                problems.append((place, str(getattr(error, "message", error))))
        self.present = {inbox.digest_of(contents) for _, contents, _ in received}
        for name, paths in found.backups.items():
            try:
                self.backups[name] = inbox.read_backup(self.job, paths)
            except CompgenError as error:
                problems.append((str(paths[0]), str(getattr(error, "message", error))))
        unchanged = None if problems else self.store.together(self._unchanged)
        if unchanged is not None:
            return unchanged
        check_folder(self.store, self.machine, self.job.out)
        self.messages += begin_folder(self.store, self.machine, self.job.out)
        known = self.store.newest_entry(self.machine)
        if known is not None and known > self.store.now():
            behind = known.isoformat(timespec="seconds")
            text = f"the clock went backwards: the store has an entry of {behind}"
            self._problem("clock", "clock", text, fail=False)
        for problem in problems:
            self._problem("inbox", *problem)
        for item in received:
            self.store.add_measurement(self.machine, inbox.measurement_of(*item, self.job.temperatures))
        for measurement, name in self._new_evidence(self.store):
            self.store.add_evidence(self.machine, measurement, self.backups[name], "inbox")
        settings = self.job.settings_sha256()  # a missing machine file ends the pass here; files taken so far are kept
        if self.elsewhere is None:
            self.process_all(settings)
        elif self._waiting(self.store, settings):
            done = self.elsewhere(replace(self.job, settings=settings))
            self.messages += done.messages
            self.processed += done.processed
            self.failed = self.failed or done.state == "failed"
            self.internal, self.again = self.internal or done.internal, self.again or done.again
        active = publish(self.store, self.machine, self.job.out)
        failures = notify(self.store, self.machine, self.job.notify)
        self.messages += failures
        self.again = self.again or bool(failures)
        return self._outcome(self.store, active, settings)

    def _unchanged(self, store: Store) -> MachineOutcome | None:
        """Return the outcome if there is nothing to do: all taken, processed, published and notified. Else None."""
        machine = self.machine
        newest = store.newest_entry(machine)
        if self.present - {item.sha256 for item in store.measurements(machine)} or (newest and newest > store.now()):
            return None
        try:
            settings = self.job.settings_sha256({item.settings_sha256 for item in store.attempts(machine)})
        except InputError:
            return None
        told = not self.job.notify or not untold(store, machine)
        if (
            self._new_evidence(store)
            or self._waiting(store, settings)
            or not told
            or not is_published(store, machine, self.job.out)
        ):
            return None
        return self._outcome(store, active_of(store.tables(machine, figures=False)), settings)

    def _new_evidence(self, store: Store) -> list[tuple[MeasurementRecord, str]]:
        """Backups in the inbox that are not yet evidence of the measurements whose names they have.

        A measurement that is in the inbox now comes first, else the last one of that name. The same file is not evidence
        twice: beside a new measurement it is a forgotten one, unless it was written again.
        """
        found, known = [], store.evidence(self.machine) if self.backups else []
        for name, files in self.backups.items():
            same = [item for item in store.measurements(self.machine) if name in inbox.names_of(item.name)]
            here = [item for item in same if item.sha256 in self.present] or sorted(same, key=lambda item: item.id)[-1:]
            listed = {(file, sha256_of(content), time.isoformat()) for file, (content, time) in files.items()}
            for measurement in here:
                own = [item for item in known if item.measurement_id == measurement.id]
                if own and {(file, digest) for file, digest, _ in own[-1].files} == {item[:2] for item in listed}:
                    continue
                other = next((item for item in known if {*item.files} == listed), None)
                if other is None:
                    found.append((measurement, name))
                    continue
                text = f"was evidence of measurement {other.measurement_id} already, so it does not show what was on during "
                text += f"measurement {measurement.id} ({measurement.name}); make another backup of the control"
                self._problem("backup", name, f"{other.names} {text}", fail=False)
        return found

    def _problem(self, kind: str, subject: str, message: str, *, fail: bool = True) -> None:
        """Report a problem; it is stored if the store does not know it yet."""
        self.failed = self.failed or fail
        self.again = self.again or fail
        subject, message = visible(plain(subject), flat=True), plain(message)
        self.messages.append(f"{subject}: {message}" if kind == "inbox" else message)
        if self.store.add_event(kind, subject, message, self.machine):
            logs.warning(kind, machine=self.job.name, subject=subject, message=message)

    def _waiting(self, store: Store, settings: str, seen: Container[int] = ()) -> list[MeasurementRecord]:
        """Return measurements without a result, in order of measurement; failed ones only if the settings changed.

        A measurement also waits if a backup of the control has come since it was judged.
        """
        attempts = store.attempts(self.machine)
        failed = {item.measurement_id: item.at for item in attempts if self._is_failure(item, settings)}
        measured = {*store.measured(self.machine).values()}
        judged = {(item.measurement_id, item.message) for item in attempts if item.outcome == "done"}
        shown = {item.measurement_id: item for item in store.evidence(self.machine)}  # the last of each
        fresh = {
            key
            for key, item in shown.items()
            if (key, item.key) not in judged and not (key in failed and failed[key] >= item.at)
        }
        done = ({*failed} | measured) - fresh
        return [item for item in store.measurements(self.machine) if item.id not in done and item.id not in seen]

    @staticmethod
    def _is_failure(attempt: AttemptRecord, settings: str) -> bool:
        return attempt.outcome == "failed" and attempt.settings_sha256 == settings

    def process_all(self, settings: str) -> None:
        """Process waiting measurements; if another runner has one, the later ones are left to it as well."""
        seen: set[int] = set()
        waiting = self._waiting(self.store, settings)
        while waiting:
            measurement = waiting[0]
            if self.stop():
                self.messages.append("stopped; the rest is processed by the next run")
                break
            seen.add(measurement.id)
            try:
                with one_thread():  # the same bytes whatever the number of processors
                    again = measurement.id in self.store.measured(self.machine).values()
                    claims.work_on(self.store, measurement, partial(self._keep, measurement, settings), again=again)
            except ClaimLostError as error:
                self.messages.append(f"{measurement.name}: {error}; the next run tries again")
                self.again = True
                break
            waiting = waiting[1:] or self._waiting(self.store, settings, seen)

    def _keep(self, measurement: MeasurementRecord, settings: str, claim: Claim) -> None:
        started = time.monotonic()
        try:
            minutes, copies = self.job.max_minutes, self.job.copies
            with claims.renewal(self.store, claim), limited(60.0 * minutes), naming_below(*copies):
                confirmed = confirmation(self.store, self.job, self.machine, measurement)
                done = None if confirmed else process(self.store, self.job, self.machine, measurement)
        except ClaimLostError:
            raise
        except Exception as error:
            if isinstance(error, CompgenError | OSError | MemoryError):
                if passes(error):
                    claims.give_back(self.store, claim)
                    self._problem("passing", measurement.name, f"{measurement.name}: {error}; it will be tried again")
                    return
                message = str(error)
            else:
                self.internal, message = True, f"internal error: {type(error).__name__}: {error}"
            keep_failure(self.store, self.machine, claim, message, settings, time.monotonic() - started)
            return
        if done is None:
            claims.keep_confirmation(self.store, self.machine, claim, confirmed, settings)
            self.messages.append(f"{measurement.name}: the backup of the control confirms which tables were on")
            return
        result = replace(done.result, **again_of(self.store, self.machine, measurement))
        table = keep_result(self.store, self.machine, claim, result, done.judged_against)
        self.processed.append(measurement.name)
        fields = {"version": table.version, "state": table.state, "reasons": list(table.reasons)}
        logs.info("measurement processed", machine=self.job.name, measurement=measurement.name, **fields)

    def _outcome(self, store: Store, active: TableRecord | None, settings: str) -> MachineOutcome:
        """Judge by the contents of the store: the same inbox gives the same outcome however often it is run."""
        tables = store.tables(self.machine, figures=False)
        # a failure is reported as long as its file is in the inbox: whoever removed or repaired the file knows of it
        names = {item.id: item.name for item in store.measurements(self.machine) if item.sha256 in self.present}
        for attempt in store.attempts(self.machine):
            name = names.get(attempt.measurement_id)
            if name is not None and attempt.outcome == "failed" and attempt.settings_sha256 == settings:
                self.failed, text = True, attempt.message
                self.messages.append(text if text.startswith(f"{name}:") else f"{name}: {text}")
        last = tables[-1] if tables else None
        held_back = last is not None and last.state in HELD_BACK
        if last is not None and held_back:
            self.messages.append(f"version {last.version} is {last.state}: {'; '.join(last.reasons)}")
        return MachineOutcome(
            machine=self.job.name,
            state="failed" if self.failed else "held" if held_back else "ok",
            messages=tuple(dict.fromkeys(self.messages)),
            processed=tuple(self.processed),
            active=None if active is None else active.version,
            waiting=tuple(table.version for table in tables if table.state in OPEN),
            internal=self.internal,
            again=self.again,
        )


# --- passes in other processes -------------------------------------------------------------------------------------

#: Kind of the events about processes that died on a measurement, and after how many of them it is set aside.
DIED, TRIES = "process ended", 3
#: Why a cluster has to run on this computer.
LOCAL_STORE = "the store is an SQLite file, which only processes of one machine may share; use postgresql://HOST/NAME"


@dataclass(frozen=True)
class Pass:
    """One pass over a machine, made by another process; it carries the log format along."""

    url: str
    log: logs.Format

    def __repr__(self) -> str:
        return "Pass()"  # the URL may contain a password

    def __call__(self, job: MachineJob) -> MachineOutcome:
        """Make the pass."""
        logs.configure(self.log)
        return run_machine(job, self.url, stopping)


def pass_of(url: str) -> WithPlugins:
    """Return the pass on the store ``url`` with the log format and plug-ins of this process."""
    return with_plugins(Pass(url, logs.form()))


class Elsewhere:
    """Workers that share only the store with this computer: they process, everything else is done here.

    This process reads inboxes, publishes tables and sends notifications. A worker gets the settings of a machine with
    the files that they name.
    """

    same_files = True

    def __init__(self, workers: Workers, url: str) -> None:
        self._workers, self._store, self.size = workers, open_store(url), workers.size
        self._function = Packed(with_plugins(StoredPass(url, logs.form())))

    def call(self, function: Packed, item: Packed, stop: Stop) -> MachineOutcome:
        """Make the pass over a machine; ``function`` is the one for workers with the same files."""

        def elsewhere(job: MachineJob) -> MachineOutcome:
            found: MachineOutcome = self._workers.call(self._function, Packed(Parcel.of(job)), stop)
            return found

        if stop():
            raise StoppedError("not started: stopped")
        return _passed(lambda: nullcontext(self._store), item.value(), stop, elsewhere)

    def close(self) -> None:
        """Close the store; the workers continue."""
        self._store.close()


@dataclass(frozen=True, repr=False)
class Parcel:
    """The settings of a machine for a computer without its files; ``files`` are the files they name, by purpose."""

    job: MachineJob
    files: Mapping[str, Mapping[str, bytes]]

    @classmethod
    def of(cls, job: MachineJob) -> Parcel:
        """Pack the files that the settings name, and the inboxes of the other machines."""
        source, folder = load_machine(job.machine).source, job.templates
        assert source is not None
        files = {"machine": {source.name: read_bytes(source)}}
        if job.instrument is not None:
            files["instrument"] = {job.instrument.name: read_bytes(job.instrument)}
        if job.heat is not None:
            files["heat"] = {job.heat.name: read_bytes(job.heat)}
        if job.temperatures is not None:
            logs_of = (
                sorted(job.temperatures.glob("*.temperatures.csv")) if job.temperatures.is_dir() else [job.temperatures]
            )
            files["temperatures"] = {path.name: read_bytes(path) for path in logs_of}
        if folder is not None:
            paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
            files["templates"] = {path.relative_to(folder).as_posix(): read_bytes(path) for path in paths}
        every = range(sys.maxsize)
        others = tuple(
            replace(item, inbox=item.inbox.resolve(), found=inbox.found_in(item, every)) for item in job.others
        )
        return cls(replace(job, inbox=job.inbox.resolve(), others=others, original=source), files)

    def unpacked(self, folder: Path) -> MachineJob:
        """Write the files to a folder and return the settings that name them there."""
        places: dict[str, Any] = {}
        for kind, contents in self.files.items():
            paths = write_files(folder / kind, contents)
            places[kind] = folder / kind if kind in ("templates", "temperatures") else paths[0]
        return replace(self.job, copies=(folder,), **{**places, "machine": str(places["machine"])})


@dataclass(frozen=True, repr=False)
class StoredPass(Pass):
    """Processes the stored measurements of a machine, and nothing else."""

    def __call__(self, parcel: Parcel) -> MachineOutcome:  # type: ignore[override]
        """Process waiting measurements; the outcome covers only these."""
        logs.configure(self.log)
        with working_folder(FOLDER.removeprefix(FOLDERS)) as folder, closing(open_store(self.url)) as store:
            job = parcel.unpacked(folder / "settings")
            made = _Pass(store, job, store.machine(job.name), stopping)
            made.process_all(job.settings)
        state, said, done = "failed" if made.failed else "ok", tuple(made.messages), tuple(made.processed)
        return MachineOutcome(job.name, state, said, done, internal=made.internal, again=made.again)


def open_fleet(url: str, workers: int, cluster: str | None, *, copied: bool = False) -> Workers:
    """Return the workers for the machines of the store ``url``: a cluster, or processes of this computer.

    Even a single worker is a separate process: a measurement that crashes it, or takes too long, ends only that pass.
    ``copied`` as for :class:`compgen.parallel.Processes`.

    Raises
    ------
    ClusterError
        if the cluster cannot be used, for example not with this store.
    """
    if cluster is not None:
        from compgen.parallel import Cluster  # an optional library

        return Cluster(cluster, same_host=LOCAL_STORE if sqlite_path(url) is not None else "")
    return Processes(workers, copied=copied and workers == 1, died=partial(note_death, url))


def note_death(url: str, job: MachineJob, pid: int, late: bool) -> None:
    """Record that process ``pid`` died while working on a measurement; after three times the measurement is set aside.

    With ``late`` it was killed because it took too long, and the measurement is set aside at once.
    """
    try:
        with closing(open_store(url)) as store:
            machine = store.machine(job.name)
            for measurement in claims.left_by(store, machine, pid):
                _note(store, job, machine, measurement, late)
    except CompgenError as error:  # the next run tries the measurement again
        logs.error("end of a process not noted", machine=job.name, problem=str(error))


def _note(store: Store, job: MachineJob, machine: MachineRecord, measurement: MeasurementRecord, late: bool) -> None:
    since = [item.at for item in store.attempts(machine) if item.measurement_id == measurement.id]
    subject = f"measurement {measurement.id}"
    deaths = [item.at for item in store.events(machine) if item.kind == DIED and item.subject == subject]
    number = 1 + sum(not since or at >= since[-1] for at in deaths)
    if late:
        message = f"{measurement.name}: took longer than {job.max_minutes:g} minutes and was ended"
    else:
        message = f"{measurement.name}: the process that worked on it was killed or crashed, {number} of {TRIES} times"
    store.add_event(DIED, subject, message, machine)
    logs.error("process ended", machine=machine.name, measurement=measurement.name, problem=message)
    claim = claims.take(store, measurement, claims.owner_name()) if late or number >= TRIES else None
    if claim is not None:
        text = f"{message}; it is set aside until job, machine file or instrument file change"
        keep_failure(store, machine, claim, text, job.settings_sha256(), 0.0)


def run_fleet(
    job: Job,
    names: Sequence[str] = (),
    *,
    workers: int = 1,
    cluster: str | None = None,
    stop: Stop = lambda: False,
) -> RunOutcome:
    """Make one pass over the machines ``names`` (default all) with ``workers`` processes, or on a Dask cluster.

    Raises
    ------
    StoreError
        if the store cannot be reached at all.
    ClusterError
        if the cluster cannot be used.
    """
    fleet = open_fleet(job.store, workers, cluster, copied=True)
    with closing(fleet):
        return run_with(fleet, job, names, stop=stop)


def run_with(fleet: Workers, job: Job, names: Sequence[str] = (), *, stop: Stop = lambda: False) -> RunOutcome:
    """Make one pass over the machines ``names`` (default all) with existing workers; see :func:`run_fleet`."""

    def mapper(_: Callable[[MachineJob], MachineOutcome], chosen: Iterable[MachineJob]) -> list[MachineOutcome]:
        jobs = ordered = list(chosen)
        if len(jobs) > 1:
            # A machine whose last measurement was left by a killed runner goes last: if it crashes everything that runs
            # here (too little memory), the other machines do not wait for ever.
            with closing(open_store(job.store)) as store:
                left = claims.unfinished(store)
                names = {machine.name for machine in store.machines() if machine.id in left}
            ordered = sorted(jobs, key=lambda item: item.name in names)
        with ExitStack() as opened:
            made = fleet if fleet.same_files else opened.enter_context(closing(Elsewhere(fleet, job.store)))
            found = {item.machine: item for item in spread(made, pass_of(job.store), ordered, lost=_lost, stop=stop)}
        return [found[item.name] for item in jobs]

    return run_jobs(job, names, mapper=mapper)


def _lost(job: MachineJob, error: CompgenError) -> MachineOutcome:
    """Return the outcome of a machine whose pass did not finish."""
    if isinstance(error, StoppedError):
        return MachineOutcome(job.name, "stopped", (f"not checked: {error}",))
    outcome = MachineOutcome(job.name, "failed", (str(error),), again=True)
    logs.error("machine lost", machine=job.name, problem=str(error))
    return outcome


def work_of(fleet: Workers) -> Callable[[MachineJob, str, Stop], MachineOutcome]:
    """Return the work function of a :class:`compgen.fleet.watch.Watch` whose passes are made by ``fleet``."""

    @lru_cache(maxsize=1)
    def workers(url: str) -> Workers:
        return fleet if fleet.same_files else Elsewhere(fleet, url)

    def work(job: MachineJob, url: str, stop: Stop) -> MachineOutcome:
        try:
            made = workers(url)
            found: MachineOutcome = made.call(Packed(pass_of(url)), Packed(job), stop)
            return found
        except CompgenError as error:  # lost, stopped, or an unusable worker
            return _lost(job, error)

    return work
