"""Items as tasks on an existing Dask cluster; needs the optional extra ``cluster``."""

from __future__ import annotations

import importlib.util
import itertools
import logging
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from socket import gethostname
from typing import Any

from compgen.core.parallel import Answer, LostError, Packed, Stop, StoppedError, perform
from compgen.errors import CompgenError, InputError

#: How long to try to reach the scheduler, s.
CONNECT_S = 5.0
#: How often somebody who waits for a task looks at the cluster, s.
POLL_S = 1.0
#: How long a cluster may be without a worker before its tasks count as lost, s.
NO_WORKER_S = 60.0
#: How often Dask tries a task again that a worker could not even begin.
RETRIES = 2
#: Least and most tasks at the scheduler at a time; between them two for each thread of the workers.
LEAST, MOST = 8, 256
#: What must be the same everywhere for the same bytes.
PACKAGES = ("compgen", "numpy", "scipy")


class ClusterError(CompgenError):
    """The cluster cannot be used: not reached, other versions, workers on other machines."""


class _BlamedError(Exception):
    """Several workers were lost while this task ran or waited on them."""


@dataclass(frozen=True)
class Facts:
    """What a worker has to be like: versions of packages, and the machine (empty: any)."""

    versions: tuple[tuple[str, str], ...]
    host: str = ""


def facts(*, host: bool) -> Facts:
    """Return the facts of this process."""
    return Facts(_versions(), _host() if host else "")


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    return tuple((name, _version(name)) for name in PACKAGES)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


@cache
def _host() -> str:
    """Name this start of this computer."""
    try:
        return f"{gethostname()} {Path('/proc/sys/kernel/random/boot_id').read_text(encoding='ascii').strip()}"
    except OSError:
        return gethostname()


def objection(wanted: Facts, found: Facts, who: str) -> str:
    """Say why a scheduler or worker cannot be used, empty if it can."""
    here, there = dict(wanted.versions), dict(found.versions)
    other = [f"{name} {there.get(name, 'none')} in place of {here[name]}" for name in here if here[name] != there[name]]
    if other:
        return f"{who} has {', '.join(other)}; the same versions belong everywhere, so that results are the same"
    if wanted.host and wanted.host != found.host:
        return f"{who} runs on {found.host.split(' ')[0]}, this is {wanted.host.split(' ')[0]}"
    return ""


def perform_there(wanted: Facts, function: Packed, item: Packed) -> Answer | str:
    """Compute one item on a worker, or say why that worker must not."""
    return objection(wanted, facts(host=bool(wanted.host)), "a worker") or perform(function, item)


class Cluster:
    """An existing Dask cluster; a lost worker's items are tried elsewhere.

    Parameters
    ----------
    address : of the scheduler, e.g. ``tcp://10.0.0.5:8786``.
    same_host : why every worker has to run on this machine; empty if it need not.

    Raises
    ------
    InputError
        if Dask is not installed.
    ClusterError
        if the scheduler does not answer within a few seconds, or the cluster cannot be used.
    """

    def __init__(self, address: str, *, same_host: str = "") -> None:
        if importlib.util.find_spec("distributed") is None:
            raise InputError("--cluster needs Dask; install compgen[cluster]")
        self.address, self._same_host = address, same_host
        self._wanted = facts(host=bool(same_host))
        self._name, self._numbers = f"compgen-{uuid.uuid4().hex[:8]}", itertools.count(1)
        self._empty_since: float | None = None
        self._client = _connected(address)
        try:
            self._check()
            threads = sum(self._client.nthreads().values())
        except BaseException:
            self.close()
            raise
        self.size = min(max(2 * threads, LEAST), MOST)

    def _check(self) -> None:
        """Refuse a cluster of other versions, or, where that counts, of other machines."""
        found = self._client.get_versions(packages=list(PACKAGES))
        sides = {"the scheduler": found["scheduler"], **{f"worker {k}": v for k, v in found["workers"].items()}}
        for who, item in sides.items():
            self._refuse(objection(Facts(self._wanted.versions), _facts_of(item), who))
        if self._wanted.host:
            for who, item in self._client.run(facts, host=True).items():
                self._refuse(objection(self._wanted, item, f"worker {who}"))

    def _refuse(self, reason: str) -> None:
        if reason:
            why = f"; {self._same_host}" if " runs on " in reason else ""
            raise ClusterError(f"the cluster {self.address} cannot be used: {reason}{why}")

    def call(self, function: Packed, item: Packed, stop: Stop) -> Any:
        """Return ``function(item)``; see :class:`compgen.core.parallel.Workers`."""
        if stop():
            raise StoppedError("not begun: stopped")
        if self._empty_since is not None:
            self._look()
        try:
            answer = self._answer(function, item, stop)
        except _BlamedError:  # perhaps for another task, which took the worker with it: once more
            try:
                answer = self._answer(function, item, stop)
            except _BlamedError as error:
                raise LostError("every worker of the cluster that worked on it was lost") from error
        if isinstance(answer, str):
            self._refuse(answer)
        return answer.value()

    def _answer(self, function: Packed, item: Packed, stop: Stop) -> Any:
        key = f"{self._name}-{next(self._numbers)}"
        future = self._client.submit(perform_there, self._wanted, function, item, key=key, pure=False, retries=RETRIES)
        try:
            return self._waited(future, stop)
        finally:
            if not future.done():
                future.cancel()
            future.release()

    def _waited(self, future: Any, stop: Stop) -> Any:
        from distributed import CancelledError, KilledWorker

        while True:
            try:
                return future.result(timeout=POLL_S)
            except KilledWorker as error:
                raise _BlamedError from error
            except CancelledError as error:
                raise LostError(f"the scheduler {self.address} was lost") from error
            except TimeoutError:
                if stop():
                    raise StoppedError("stopped; what runs on the cluster is kept when it ends") from None
                self._look()
            except Exception as error:  # the worker could not begin it: what it raises has nothing to do with the item
                raise ClusterError(f"the cluster {self.address} cannot run compgen: {error}") from error

    def _look(self) -> None:
        """Raise LostError if the scheduler is gone, or no worker has been there for a while."""
        if self._client.status != "running":
            raise LostError(f"the scheduler {self.address} was lost")
        try:
            workers = self._client.nthreads()
        except (OSError, TimeoutError) as error:
            raise LostError(f"the scheduler {self.address} was lost") from error
        now = time.monotonic()
        since = self._empty_since = None if workers else self._empty_since or now
        if since is not None and now - since > NO_WORKER_S:
            raise LostError(f"the cluster {self.address} has had no worker for {NO_WORKER_S:.0f} s")

    def close(self) -> None:
        """Leave the cluster; tasks that were not begun are forgotten by it."""
        self._client.close()


def _facts_of(versions: Mapping[str, Any] | None) -> Facts:
    packages = {} if versions is None else versions["packages"]
    return Facts(tuple((name, str(packages.get(name) or "none")) for name in PACKAGES))


def _connected(address: str) -> Any:
    from distributed import Client

    make: Any = Client

    for name in ("distributed", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is raised
    try:
        return make(address, timeout=CONNECT_S, set_as_default=False, name="compgen")
    except (OSError, TimeoutError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ClusterError(
            f"no Dask scheduler answers at {address} within {CONNECT_S:.0f} s ({reason}); start one with "
            "`dask scheduler`, or give its address, for example tcp://10.0.0.5:8786"
        ) from error
