"""One function for many items, in processes of this machine or on a Dask cluster: the same results in the same order.

Function and items are pickled, everything that affects a result is part of the item (including a seed), and every item
is computed on one thread; so it does not matter where. The processes come from :mod:`concurrent.futures`, each in a
separate pool: a killed process breaks its pool, which must not affect the items of the others.
"""

from __future__ import annotations

import ctypes
import importlib.util
import logging
import os
import pickle
import queue
import signal
import sys
import threading
import time
import uuid
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.metadata import distributions
from multiprocessing import get_context, parent_process
from multiprocessing.context import BaseContext
from pathlib import Path
from socket import gethostname
from typing import Any, Protocol, TypeVar

from compgen.errors import CompgenError, CompgenWarning, InputError, Message
from compgen.kinematics.kernel_switch import one_thread

Item = TypeVar("Item")
Result = TypeVar("Result")
Stop = Callable[[], bool]
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
#: Interval at which a waiting caller checks whether to stop, s.
POLL_S = 0.2
#: Freed memory that a worker process keeps, and largest block allocated from it, bytes; see ``mallopt(3)``.
KEPT_BYTES, BLOCK_BYTES = 64 << 20, 32 << 20
#: Items submitted ahead of the first unfinished one, for each concurrent call.
AHEAD = 256


class LostError(CompgenError):
    """The processes that worked on an item ended before they had a result."""

    exit_code = 1


class StoppedError(CompgenError):
    """An item was not begun, because a stop was requested."""

    exit_code = 1


class RemoteError(CompgenError):
    """An error of another process that cannot be sent unchanged."""


class Packed:
    """An object pickled once; its text shows only the type, because the contents may include a password."""

    def __init__(self, value: object) -> None:
        self.kind = type(value).__name__
        self.content = pickle.dumps(value)

    def __repr__(self) -> str:
        return f"<packed {self.kind}>"

    def value(self) -> Any:
        """Return what was packed."""
        return pickle.loads(self.content)


@dataclass(frozen=True)
class Answer:
    """The outcome of one item: a result or an error, pickled, and the warnings of compgen."""

    content: bytes
    failed: bool
    warnings: tuple[str, ...] = ()

    def value(self) -> Any:
        """Repeat the warnings of the work, and return its result or raise its error."""
        for text in self.warnings:
            warnings.warn(text, CompgenWarning, stacklevel=2)
        found = pickle.loads(self.content)
        if self.failed:
            raise found
        return found


class Workers(Protocol):
    """Works on ``size`` items at a time; :meth:`call` may be called by as many threads.

    ``same_files`` says whether it sees the files of this process by the same paths.
    """

    size: int
    same_files: bool

    def call(self, function: Packed, item: Packed, stop: Stop) -> Any:
        """Return ``function(item)``; LostError if the processes that worked on it ended, StoppedError if none did."""
        ...

    def close(self) -> None:
        """Start nothing more, wait for running work in processes of this machine, and disconnect."""
        ...


# --- in the process that works -------------------------------------------------------------------------------------

_BUSY = threading.Lock()
_STOP: list[Any] = []
#: What this process reports to its parent: its process id, and until when it may work (0: no limit), s.
_TOLD: list[Any] = []


#: Unpack a function: the same few are needed repeatedly.
_unpacked = lru_cache(maxsize=4)(pickle.loads)


def perform(function: Packed, item: Packed) -> Answer:
    """Compute one item in this process, one at a time, and return the outcome."""
    with _BUSY, one_thread(), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", CompgenWarning)
        try:
            content, failed = pickle.dumps(_unpacked(function.content)(item.value())), False
        except Exception as error:
            failed = True
            try:
                content = pickle.dumps(error)
                pickle.loads(content)
            except Exception:  # it cannot be sent; its text and exit code can
                known = isinstance(error, CompgenError)
                other = RemoteError(str(error) if known else f"{type(error).__name__}: {error}")
                other.exit_code = error.exit_code if isinstance(error, CompgenError) else 3
                content = pickle.dumps(other)
    return Answer(content, failed, tuple(str(w.message) for w in caught if issubclass(w.category, CompgenWarning)))


def stopping() -> bool:
    """Whether this process was asked to stop after its current work."""
    return bool(_STOP and _STOP[0].value)


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Have this process killed if the block takes longer; only for processes started by :class:`Processes`."""
    for told in _TOLD:
        told[1] = time.monotonic() + seconds
    try:
        yield
    finally:
        for told in _TOLD:
            told[1] = 0.0


def _begin(stop: Any, told: Any) -> None:
    """Make this process leave signals to its parent, and end with it."""
    _STOP[:], _TOLD[:] = [stop], [told]
    told[0] = os.getpid()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)  # no SIG_IGN, which commands started here would inherit
    parent = parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    # keep freed memory: returning every array to the system and fetching it again takes 10 to 30 % of the time
    with suppress(OSError, AttributeError, TypeError):  # not available on other systems
        library = ctypes.CDLL(None)
        library.mallopt(-1, KEPT_BYTES)  # M_TRIM_THRESHOLD
        library.mallopt(-3, BLOCK_BYTES)  # M_MMAP_THRESHOLD


# --- processes of this machine -------------------------------------------------------------------------------------


_starting = threading.Lock()


@contextmanager
def _modules_of_the_program() -> Iterator[None]:
    """Let a Python process that starts now take no modules from the working folder, where anybody's files may be."""
    name = "PYTHONSAFEPATH"
    with _starting:
        before = os.environ.get(name)
        os.environ[name] = "1"
        try:
            yield
        finally:
            if before is None:
                del os.environ[name]
            else:
                os.environ[name] = before


class _Lane:
    """One process, replaced when it is killed."""

    def __init__(self, context: BaseContext, stop: Any, told: Any) -> None:
        self._context, self._stop, self._told = context, stop, told
        self._pool: ProcessPoolExecutor | None = None

    def perform(self, function: Packed, item: Packed) -> Future[Answer]:
        if self._pool is not None:
            return self._pool.submit(perform, function, item)
        self._told[:] = (0.0, 0.0)
        options: Any = {"initializer": _begin, "initargs": (self._stop, self._told)}
        with _modules_of_the_program():  # the process starts here
            self._pool = ProcessPoolExecutor(1, self._context, **options)
            return self._pool.submit(perform, function, item)

    @property
    def pid(self) -> int:
        """Process id, 0 if the process has not reported it yet."""
        return int(self._told[0])

    def overdue(self) -> bool:
        """Whether the process has exceeded its time limit."""
        return bool(0.0 < self._told[1] < time.monotonic())

    def kill(self) -> None:
        """Kill the process."""
        with suppress(OSError):
            os.kill(self.pid, getattr(signal, "SIGKILL", signal.SIGTERM))

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
        self._pool = None


class Processes:
    """Processes of this machine; a killed one is replaced, and its item tried once more.

    Parameters
    ----------
    count : processes at a time.
    copied : if the system can, start a process as a copy (fork) of this one, which saves seconds; only for a program
        without running threads.
    died : called for each process that ended during an item: the item, the process id, and whether :func:`limited`
        ended it.
    """

    same_files = True

    def __init__(
        self, count: int, *, copied: bool = False, died: Callable[[Any, int, bool], None] = lambda *_: None
    ) -> None:
        context = get_context("fork" if copied and sys.platform.startswith("linux") else "spawn")
        self.size, self._died = count, died
        try:
            self._stop = context.RawValue("b", 0)  # without a lock, which a killed process might keep
            self._lanes = [_Lane(context, self._stop, context.RawArray("d", 2)) for _ in range(count)]
        except OSError as error:  # shared memory is a file to the system
            raise CompgenError(
                Message(
                    "processes-not-possible",
                    "processes cannot be started here: {strerror}",
                    strerror=error.strerror or error,
                )
            ) from error
        self._idle: queue.LifoQueue[_Lane] = queue.LifoQueue()
        for lane in self._lanes:
            self._idle.put(lane)

    def call(self, function: Packed, item: Packed, stop: Stop) -> Any:
        """Return ``function(item)``; see :class:`Workers`."""
        lane = self._idle.get()
        try:
            for _ in range(2):
                if stop() or self._stop.value:
                    raise StoppedError(Message("not-started", "not started: stopped"))
                try:
                    future = lane.perform(function, item)
                    while True:
                        try:
                            return future.result(POLL_S).value()
                        except NotYet:
                            if stop():
                                self._stop.value = 1
                            if lane.overdue():
                                lane.kill()
                except BrokenExecutor:
                    late = lane.overdue()
                    lane.close()
                    self._died(item.value(), lane.pid, late)
                if late:
                    raise LostError(
                        Message("worker-too-long", "the process that worked on it took too long and was ended")
                    )
        finally:
            self._idle.put(lane)
        raise LostError(Message("worker-killed", "the process that worked on it was killed, twice (out of memory?)"))

    def close(self) -> None:
        """Start nothing more, wait for running work, end the processes."""
        self._stop.value = 1
        for lane in self._lanes:
            lane.close()


# --- all items -----------------------------------------------------------------------------------------------------


def spread(
    workers: Workers,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    lost: Callable[[Item, CompgenError], Result] | None = None,
    stop: Stop = lambda: False,
) -> Iterator[Result]:
    """Yield ``function(item)`` for each item, in order; only some of them are in progress at a time.

    Parameters
    ----------
    workers : do the work.
    function : can be pickled; if it raises an error, everything ends.
    items : can be pickled.
    lost : gives the result of an item whose processes ended, or that was not begun; without it the error is raised.
    stop : called now and then; once true, nothing more is started.
    """
    packed = Packed(function)

    def work(item: Item) -> Result:
        try:
            found: Result = workers.call(packed, Packed(item), stop)
            return found
        except (LostError, StoppedError) as error:
            if lost is None:
                raise
            return lost(item, error)

    pool = ThreadPoolExecutor(workers.size, thread_name_prefix="compgen")
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) >= AHEAD * workers.size:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except CancelledError as error:
        raise StoppedError("stopped") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def opened_workers(workers: int, cluster: str | None) -> Workers | None:
    """Return the workers; None (this process) for one worker without a cluster."""
    if cluster is not None:
        return Cluster(cluster)
    return Processes(workers) if workers > 1 else None


# --- tasks on an existing Dask cluster; needs the optional extra ``cluster`` -----------------------------------------

#: How long to try to reach the scheduler, s.
CONNECT_S = 5.0
#: Interval at which a caller waiting for a task checks the cluster, s.
CLUSTER_POLL_S = 1.0
#: How long a cluster may be without a worker before its tasks count as lost, s.
NO_WORKER_S = 60.0
#: How often Dask retries a task that a worker could not start.
RETRIES = 2
#: Fewest and most tasks at the scheduler at a time; within these limits two per thread of the workers.
LEAST, MOST = 8, 256
#: Packages that need the same version everywhere for the same bytes.
PACKAGES = ("compgen", "numpy", "scipy")


class ClusterError(CompgenError):
    """The cluster cannot be used: not reached, different versions, workers on other machines."""


class _BlamedError(Exception):
    """Several workers were lost while this task ran or waited on them."""


@dataclass(frozen=True)
class WorkerFacts:
    """Requirements on a worker: versions of packages, and the machine (empty: any)."""

    versions: tuple[tuple[str, str], ...]
    host: str = ""


@cache
def facts(*, host: bool) -> WorkerFacts:
    """Return the facts of this process; ``host`` identifies this boot of this computer."""
    versions = tuple((name, next((item.version for item in distributions(name=name)), "none")) for name in PACKAGES)
    if not host:
        return WorkerFacts(versions)
    try:
        start = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return WorkerFacts(versions, gethostname())
    return WorkerFacts(versions, f"{gethostname()} {start}")


def objection(required: WorkerFacts, found: WorkerFacts, who: str) -> str:
    """Reason why a scheduler or worker cannot be used, empty if it can."""
    here, there = dict(required.versions), dict(found.versions)
    other = [f"{name} {there.get(name, 'none')} instead of {here[name]}" for name in here if here[name] != there[name]]
    if other:
        return f"{who} has {', '.join(other)}; install the same versions everywhere, so that the results are the same"
    if required.host and required.host != found.host:
        return f"{who} runs on {found.host.split(' ')[0]}, this is {required.host.split(' ')[0]}"
    return ""


def perform_there(required: WorkerFacts, function: Packed, item: Packed) -> Answer | str:
    """Compute one item on a worker, or return the reason why that worker must not."""
    return objection(required, facts(host=bool(required.host)), "a worker") or perform(function, item)


class Cluster:
    """An existing Dask cluster; a lost worker's items are tried elsewhere.

    Parameters
    ----------
    address : of the scheduler, e.g. ``tcp://10.0.0.5:8786``.
    same_host : why every worker must run on this machine; empty if not required.

    Raises
    ------
    InputError
        if Dask is not installed.
    ClusterError
        if the scheduler does not answer within a few seconds, or the cluster cannot be used.
    """

    same_files = False

    def __init__(self, address: str, *, same_host: str = "") -> None:
        if importlib.util.find_spec("distributed") is None:
            raise InputError("--cluster needs Dask; install compgen[cluster]")
        from distributed import Client  # imported here: an optional extra

        self.address, self._same_host = address, same_host
        self._required = facts(host=bool(same_host))
        self._empty_since: float | None = None
        for name in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # relevant errors are raised
        make: Any = Client
        try:
            self._client = make(address, timeout=CONNECT_S, set_as_default=False, name="compgen")
        except (OSError, TimeoutError, ValueError, KeyError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ClusterError(
                Message(
                    "scheduler-no-answer",
                    "no Dask scheduler answers at {address} within {value:.0f} s ({reason}); start one "
                    "with `dask scheduler`, or give its address, for example tcp://10.0.0.5:8786",
                    address=address,
                    value=CONNECT_S,
                    reason=reason,
                )
            ) from error
        try:
            self._check()
            threads = sum(self._client.nthreads().values())
        except BaseException:
            self.close()
            raise
        self.size = min(max(2 * threads, LEAST), MOST)

    def _check(self) -> None:
        """Refuse a cluster with other versions or, if required, on other machines."""
        found = self._client.get_versions(packages=list(PACKAGES))
        sides = {"the scheduler": found["scheduler"], **{f"worker {k}": v for k, v in found["workers"].items()}}
        for who, item in sides.items():
            packages = {} if item is None else item["packages"]
            there = WorkerFacts(tuple((name, str(packages.get(name) or "none")) for name in PACKAGES))
            self._refuse(objection(WorkerFacts(self._required.versions), there, who))
        if self._required.host:
            for who, item in self._client.run(facts, host=True).items():
                self._refuse(objection(self._required, item, f"worker {who}"))

    def _refuse(self, reason: str) -> None:
        if reason:
            why = f"; {self._same_host}" if " runs on " in reason else ""
            raise ClusterError(
                Message(
                    "cluster-unfit",
                    "the cluster {address} cannot be used: {reason}{why}",
                    address=self.address,
                    reason=reason,
                    why=why,
                )
            )

    def call(self, function: Packed, item: Packed, stop: Stop) -> Any:
        """Return ``function(item)``; see :class:`compgen.parallel.Workers`."""
        if stop():
            raise StoppedError(Message("not-started", "not started: stopped"))
        if self._empty_since is not None:
            self._look()
        for _ in range(2):  # another task may have killed the worker: try once more
            try:
                answer = self._answer(function, item, stop)
            except _BlamedError:
                continue
            if isinstance(answer, str):
                self._refuse(answer)
            return answer.value()
        raise LostError(Message("cluster-workers-lost", "every worker of the cluster that worked on it was lost"))

    def _answer(self, function: Packed, item: Packed, stop: Stop) -> Any:
        """Submit the item and wait for it; polled, because the cluster may be lost and the user may request a stop."""
        from distributed import CancelledError, KilledWorker

        key = f"compgen-{uuid.uuid4().hex}"  # the default key could reveal arguments
        future = self._client.submit(
            perform_there, self._required, function, item, key=key, pure=False, retries=RETRIES
        )
        try:
            while True:
                try:
                    return future.result(timeout=CLUSTER_POLL_S)
                except KilledWorker as error:
                    raise _BlamedError from error
                except CancelledError as error:
                    raise LostError(
                        Message("scheduler-lost", "the scheduler {address} was lost", address=self.address)
                    ) from error
                except TimeoutError:
                    if stop():
                        raise StoppedError(
                            Message(
                                "cluster-stopped",
                                "stopped; results of what still runs on the cluster are kept when it ends",
                            )
                        ) from None
                    self._look()
                except Exception as error:  # the worker could not start it: the error is not from the item
                    raise ClusterError(
                        Message(
                            "cluster-cannot-run",
                            "the cluster {address} cannot run compgen: {error}",
                            address=self.address,
                            error=error,
                        )
                    ) from error
        finally:
            if not future.done():
                future.cancel()
            future.release()

    def _look(self) -> None:
        """Raise LostError if the scheduler is gone, or there has been no worker for a while."""
        if self._client.status != "running":
            raise LostError(Message("scheduler-lost", "the scheduler {address} was lost", address=self.address))
        try:
            workers = self._client.nthreads()
        except (OSError, TimeoutError) as error:
            raise LostError(
                Message("scheduler-lost", "the scheduler {address} was lost", address=self.address)
            ) from error
        now = time.monotonic()
        since = self._empty_since = None if workers else self._empty_since or now
        if since is not None and now - since > NO_WORKER_S:
            raise LostError(
                Message(
                    "cluster-without-worker",
                    "the cluster {address} has had no worker for {value:.0f} s",
                    address=self.address,
                    value=NO_WORKER_S,
                )
            )

    def close(self) -> None:
        """Disconnect from the cluster, which drops tasks that were not started."""
        self._client.close()
