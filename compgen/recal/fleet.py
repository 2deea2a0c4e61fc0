"""Passes over many machines: in processes of this machine or on a cluster, with the same results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

import sqlalchemy as sa

from compgen.core.parallel import Packed, Stop, StoppedError, Workers, opened_workers, spread, stopping
from compgen.errors import CompgenError
from compgen.plugins import WithPlugins, with_plugins
from compgen.recal import logs
from compgen.recal.job import Job, MachineJob
from compgen.recal.runner import MachineOutcome, RunOutcome, run_jobs, run_machine

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


def open_fleet(url: str, workers: int, cluster: str | None) -> Workers | None:
    """Return what works on the machines of the store ``url``; None: this process does.

    Raises
    ------
    ClusterError
        if the cluster cannot be used, for example not with this store.
    """
    return opened_workers(workers, cluster, same_host=LOCAL_STORE if _is_file(url) else "")


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
    fleet = open_fleet(job.store, workers, cluster)
    if fleet is None:
        return run_jobs(job, names, stop=stop)
    with closing(fleet):
        return run_with(fleet, job, names, stop=stop)


def run_with(fleet: Workers, job: Job, names: Sequence[str] = (), *, stop: Stop = lambda: False) -> RunOutcome:
    """Make one pass over the machines ``names`` (default all) with workers that are there; see :func:`run_fleet`."""

    def mapper(_: Callable[[MachineJob], MachineOutcome], chosen: Iterable[MachineJob]) -> Iterator[MachineOutcome]:
        return spread(fleet, pass_of(job.store), chosen, lost=_lost, stop=stop)

    return run_jobs(job, names, mapper=mapper)


def _lost(job: MachineJob, error: CompgenError) -> MachineOutcome:
    """Return the outcome of a machine whose pass did not come to an end."""
    if isinstance(error, StoppedError):
        return MachineOutcome(job.name, "stopped", (f"not looked at: {error}",))
    outcome = MachineOutcome(job.name, "failed", (str(error),))
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
