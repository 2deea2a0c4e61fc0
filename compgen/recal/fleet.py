"""Passes over many machines: in processes of this machine or on a cluster, with the same results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial

import sqlalchemy as sa

from compgen.core.parallel import Packed, Processes, Stop, StoppedError, Workers, spread, stopping
from compgen.errors import CompgenError
from compgen.plugins import WithPlugins, with_plugins
from compgen.recal import claims, logs
from compgen.recal.job import Job, MachineJob
from compgen.recal.records import MachineRecord, MeasurementRecord
from compgen.recal.results import keep_failure
from compgen.recal.runner import MachineOutcome, RunOutcome, run_jobs, run_machine
from compgen.recal.store import Store, open_store

#: Events about processes that ended over a measurement, and after how many of them it is set aside.
DIED, TRIES = "process ended", 3
#: Why a cluster has to be on this machine.
LOCAL_STORE = "the store is an SQLite file, which only processes of one machine may share; use postgresql://HOST/NAME"


@dataclass(frozen=True)
class Pass:
    """One pass over a machine as another process makes it; it brings the form of the logs along."""

    url: str
    log: logs.Format

    def __repr__(self) -> str:
        return "Pass()"  # the URL may hold a password

    def __call__(self, job: MachineJob) -> MachineOutcome:
        """Make the pass."""
        logs.configure(self.log)
        return run_machine(job, self.url, stopping)


def pass_of(url: str) -> WithPlugins:
    """Return the pass on the store ``url`` with this process's logs and plug-ins."""
    return with_plugins(Pass(url, logs.form()))


def open_fleet(url: str, workers: int, cluster: str | None, *, copied: bool = False) -> Workers:
    """Return what works on the machines of the store ``url``: a cluster, or processes of this computer.

    Even one worker is a process of its own: a measurement that brings it down, or takes too long, takes nothing with it
    but its own pass. ``copied`` as for :class:`compgen.core.parallel.Processes`.

    Raises
    ------
    ClusterError
        if the cluster cannot be used, for example not with this store.
    """
    if cluster is not None:
        from compgen.core.cluster import Cluster  # the library is an optional one

        return Cluster(cluster, same_host=LOCAL_STORE if _is_file(url) else "")
    return Processes(workers, copied=copied and workers == 1, died=partial(note_death, url))


def note_death(url: str, job: MachineJob, pid: int, late: bool) -> None:
    """Keep that the process ``pid`` ended while it worked on a measurement; after three times it is set aside.

    With ``late`` it was ended because it took too long, and the measurement is set aside at once.
    """
    try:
        store = open_store(url)
        try:
            machine = store.machine(job.name)
            for measurement in claims.left_by(store, machine, pid):
                _note(store, job, machine, measurement, late)
        finally:
            store.close()
    except CompgenError as error:  # the next run tries the measurement again
        logs.error("end of a process not noted", machine=job.name, problem=str(error))


def _note(store: Store, job: MachineJob, machine: MachineRecord, measurement: MeasurementRecord, late: bool) -> None:
    since = [item.at for item in store.attempts(machine) if item.measurement_id == measurement.id]
    subject = f"measurement {measurement.id}"
    before = [
        event
        for event in store.events(machine)
        if event.kind == DIED and event.subject == subject and (not since or event.at >= since[-1])
    ]
    if late:
        message = f"{measurement.name}: took longer than {job.max_minutes:g} minutes and was ended"
    else:
        number = len(before) + 1
        message = f"{measurement.name}: the process that worked on it was killed or crashed, {number} of {TRIES} times"
    store.add_event(DIED, subject, message, machine)
    logs.error("process ended", machine=machine.name, measurement=measurement.name, problem=message)
    claim = claims.take(store, measurement, claims.owner_name()) if late or len(before) + 1 >= TRIES else None
    if claim is not None:
        text = f"{message}; it is set aside until job, machine file or instrument file change"
        keep_failure(store, machine, claim, text, job.settings_sha256(), 0.0)


def _is_file(url: str) -> bool:
    try:
        return "://" not in url or sa.make_url(url).get_backend_name() == "sqlite"
    except sa.exc.ArgumentError:
        return False  # the store says so itself


def run_fleet(
    job: Job,
    names: Sequence[str] = (),
    *,
    workers: int = 1,
    cluster: str | None = None,
    stop: Stop = lambda: False,
) -> RunOutcome:
    """Make one pass over the machines ``names`` (default all) with so many processes, or on a Dask cluster.

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
    """Make one pass over the machines ``names`` (default all) with workers that are there; see :func:`run_fleet`."""

    def mapper(_: Callable[[MachineJob], MachineOutcome], chosen: Iterable[MachineJob]) -> list[MachineOutcome]:
        asked = list(chosen)
        left = _left_unfinished(job.store) if len(asked) > 1 else set()
        ordered = sorted(asked, key=lambda item: item.name in left)
        found = {item.machine: item for item in spread(fleet, pass_of(job.store), ordered, lost=_lost, stop=stop)}
        return [found[item.name] for item in asked]

    return run_jobs(job, names, mapper=mapper)


def _left_unfinished(url: str) -> set[str]:
    """Return the machines whose last measurement was left by a runner that was killed: the others have their turn first.

    So a measurement that brings down all that runs here (the system's answer to too little memory) does not keep the
    machines behind it waiting for ever.
    """
    store = open_store(url)
    try:
        left = claims.unfinished(store)
        return {machine.name for machine in store.machines() if machine.id in left}
    finally:
        store.close()


def _lost(job: MachineJob, error: CompgenError) -> MachineOutcome:
    """Return the outcome of a machine whose pass did not come to an end."""
    if isinstance(error, StoppedError):
        return MachineOutcome(job.name, "stopped", (f"not looked at: {error}",))
    outcome = MachineOutcome(job.name, "failed", (str(error),), again=True)
    logs.error("machine lost", machine=job.name, problem=str(error))
    return outcome


def work_of(fleet: Workers) -> Callable[[MachineJob, str, Stop], MachineOutcome]:
    """Return the work of a :class:`compgen.recal.watch.Watch` whose passes are made by ``fleet``."""

    def work(job: MachineJob, url: str, stop: Stop) -> MachineOutcome:
        try:
            found: MachineOutcome = fleet.call(Packed(pass_of(url)), Packed(job), stop)
            return found
        except CompgenError as error:  # lost, stopped, or a worker that cannot be used
            return _lost(job, error)

    return work
