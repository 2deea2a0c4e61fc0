"""One pass over the machines of a job: take what is new in the inboxes, process it, keep it, publish it.

Machines do not disturb each other: whatever goes wrong with one becomes part of its outcome.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import sqlalchemy as sa

from compgen.core.parallel import limited
from compgen.core.text import visible
from compgen.core.threads import one_thread
from compgen.errors import CompgenError
from compgen.recal import claims, inbox, logs
from compgen.recal.claims import Claim, ClaimLostError
from compgen.recal.database import StoreError
from compgen.recal.job import Job, MachineJob
from compgen.recal.notify import notify
from compgen.recal.passing import passes
from compgen.recal.process import process, without_folder
from compgen.recal.publish import check_folder, publish
from compgen.recal.records import MachineRecord, MeasurementRecord, TableRecord
from compgen.recal.results import ChangedMeanwhileError, keep_failure, keep_result
from compgen.recal.schema import plain
from compgen.recal.store import Clock, Store, open_store

#: How often a measurement is judged again because other tables became active meanwhile.
JUDGED_AT_MOST = 5

Stop = Callable[[], bool]
Mapper = Callable[[Callable[[MachineJob], "MachineOutcome"], Iterable[MachineJob]], Iterable["MachineOutcome"]]


@dataclass(frozen=True)
class MachineOutcome:
    """What one pass did for one machine; it can be sent between processes.

    ``state`` is "ok", "held" (the newest tables are held back or refused), "failed" (something could not be taken or
    processed) or "stopped" (the pass ended before its turn: nothing is known of it); ``messages`` say why. ``processed``
    names the measurements of this pass, ``active`` is the active version, ``waiting`` are the versions that wait for a
    person. With ``again`` something may pass by itself (a full disk, an unreadable file, another runner, a store that is
    away), with ``unreachable`` it is the store.
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
        """0: all is well; 1: something is held back or failed; 2: the store went away; 3: an internal error."""
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
    stop: Stop = lambda: False,
    clock: Clock | None = None,
) -> RunOutcome:
    """Make one pass over the machines ``names`` (default all); ``mapper`` may spread them over processes.

    ``clock`` tells the time of a simulated factory; None: that of the computer or the database.

    Raises
    ------
    StoreError
        if the store cannot be reached at all.
    """
    chosen = [job.machine(name) for name in names] if names else list(job.machines.values())
    chosen = inbox.with_twins(chosen, job.machines.values())
    open_store(job.store).close()
    work = partial(run_machine, url=job.store, clock=clock)
    if mapper is map:
        work = partial(work, stop=stop)
    return RunOutcome(tuple(mapper(work, chosen)))


def run_machine(job: MachineJob, url: str, stop: Stop = lambda: False, clock: Clock | None = None) -> MachineOutcome:
    """Make one pass over one machine; whatever goes wrong is part of the outcome, nothing is raised."""
    started = time.monotonic()
    if stop():
        return MachineOutcome(job.name, "stopped", ("not looked at: stopped",))
    try:
        store = open_store(url, clock=clock)
        try:
            with one_thread():
                outcome = _Pass(store, job, store.add_machine(job.name), stop).run()
        finally:
            store.close()
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
    """One pass over one machine; collects messages as it goes."""

    def __init__(self, store: Store, job: MachineJob, machine: MachineRecord, stop: Stop) -> None:
        self.store, self.job, self.machine, self.stop = store, job, machine, stop
        self.messages: list[str] = []
        self.processed: list[str] = []
        self.present: set[str] = set()
        self.failed = False
        self.internal = False
        self.again = False

    def run(self) -> MachineOutcome:
        """Take, process, publish, notify."""
        check_folder(self.store, self.machine, self.job.out)
        self._check_clock()
        self._take()
        settings = self.job.settings_sha256()  # a machine file that is missing ends here; what came in is kept
        self._process_all(settings)
        active = publish(self.store, self.machine, self.job.out)
        problems = notify(self.store, self.machine, self.job.notify)
        self.messages += problems
        self.again = self.again or bool(problems)
        return self._outcome(active, settings)

    def _check_clock(self) -> None:
        """Report a clock that stands before what the store holds already."""
        known = self.store.newest_entry(self.machine)
        if known is not None and known > self.store.read(self.store.now):
            behind = known.isoformat(timespec="seconds")
            self._problem(
                "clock", "clock", f"the clock went backwards: the store holds an entry of {behind}", fail=False
            )

    def _problem(self, kind: str, subject: str, message: str, *, fail: bool = True) -> None:
        """Report something; it is kept in the store if it is news there."""
        self.failed = self.failed or fail
        self.again = self.again or fail
        subject, message = visible(plain(subject), flat=True), plain(message)
        self.messages.append(f"{subject}: {message}" if kind == "inbox" else message)
        if self.store.add_event(kind, subject, message, self.machine):
            logs.warning(kind, machine=self.job.name, subject=subject, message=message)

    def _take(self) -> None:
        """Keep everything that is new in the inbox."""
        found = inbox.scan(self.job, self.store.read(self.store.now))
        for problem in found.problems:
            self._problem("inbox", problem.subject, problem.message)
        for group in found.groups:
            try:
                new = inbox.load(self.job, group)
            except CompgenError as error:
                place = str(getattr(error, "file", None) or group[0])
                self._problem("inbox", place, str(getattr(error, "message", error)))
                continue
            self.store.add_measurement(self.machine, new)
            self.present.add(new.sha256)

    def _waiting(self, settings: str) -> list[MeasurementRecord]:
        """Return what has no result yet, oldest first; what failed comes again only with other settings."""
        done = self.store.identified(self.machine)
        failed = {
            item.measurement_id
            for item in self.store.attempts(self.machine)
            if item.outcome == "failed" and item.settings_sha256 == settings
        }
        return [item for item in self.store.measurements(self.machine) if item.id not in done | failed]

    def _process_all(self, settings: str) -> None:
        """Process in the order of measurement; where another runner has one, the later ones are left to it as well."""
        seen: set[int] = set()
        while waiting := [item for item in self._waiting(settings) if item.id not in seen]:
            for measurement in waiting:
                if self.stop():
                    self.messages.append("stopped; the rest is processed by the next run")
                    return
                seen.add(measurement.id)
                if not self._process(measurement, settings):
                    return

    def _process(self, measurement: MeasurementRecord, settings: str) -> bool:
        """Process one measurement; return whether the next one may follow."""
        for _ in range(JUDGED_AT_MOST):
            claim = claims.take(self.store, measurement, claims.owner_name())
            if claim is None:
                return self._leave(measurement, "another runner has it")
            try:
                self._keep(measurement, claim, settings)
                return True
            except ChangedMeanwhileError:
                claims.give_back(self.store, claim)
            except (ClaimLostError, sa.exc.IntegrityError):
                claims.forget(self.store, claim)
                return self._leave(measurement, "another runner took it over")
            except BaseException:
                _give_back_quietly(self.store, claim)
                raise
        return self._leave(measurement, "other tables became active again and again; it is judged by the next run")

    def _leave(self, measurement: MeasurementRecord, why: str) -> bool:
        """Say why a measurement is not processed now."""
        self.messages.append(f"{measurement.name}: {why}")
        self.again = True
        return False

    def _keep(self, measurement: MeasurementRecord, claim: Claim, settings: str) -> None:
        started = time.monotonic()
        try:
            with claims.Renewal(self.store, claim), limited(60.0 * self.job.max_minutes):
                done = process(self.store, self.job, self.machine, measurement)
        except ClaimLostError:
            raise
        except (CompgenError, OSError, MemoryError) as error:
            if passes(error):
                claims.give_back(self.store, claim)
                self._problem("passing", measurement.name, f"{measurement.name}: {error}; it is tried again")
                return
            message = without_folder(str(error))
            keep_failure(self.store, self.machine, claim, message, settings, time.monotonic() - started)
            return
        except Exception as error:
            self.internal = True
            message = f"internal error: {type(error).__name__}: {error}"
            keep_failure(self.store, self.machine, claim, message, settings, time.monotonic() - started)
            return
        table = keep_result(self.store, self.machine, claim, done.result, done.judged_against)
        self.processed.append(measurement.name)
        fields = {"version": table.version, "state": table.state, "reasons": list(table.reasons)}
        logs.info("measurement processed", machine=self.job.name, measurement=measurement.name, **fields)

    def _outcome(self, active: TableRecord | None, settings: str) -> MachineOutcome:
        """Judge by what the store holds, so that the same inbox gives the same outcome however often it is run."""
        tables = self.store.tables(self.machine, figures=False)
        self._report_failures(settings)
        last = tables[-1] if tables else None
        held = last is not None and last.state in ("held", "refused")
        if last is not None and held:
            self.messages.append(f"version {last.version} is {last.state}: {'; '.join(last.reasons)}")
        return MachineOutcome(
            machine=self.job.name,
            state="failed" if self.failed else "held" if held else "ok",
            messages=tuple(dict.fromkeys(self.messages)),
            processed=tuple(self.processed),
            active=None if active is None else active.version,
            waiting=tuple(table.version for table in tables if table.state in ("pending", "held")),
            internal=self.internal,
            again=self.again,
        )

    def _report_failures(self, settings: str) -> None:
        """Measurements that failed, as long as they stand in the inbox: who removed or mended one knows of it."""
        names = {item.id: item.name for item in self.store.measurements(self.machine) if item.sha256 in self.present}
        for attempt in self.store.attempts(self.machine):
            name = names.get(attempt.measurement_id)
            if name is not None and attempt.outcome == "failed" and attempt.settings_sha256 == settings:
                self.failed = True
                text = attempt.message
                self.messages.append(text if text.startswith(f"{name}:") else f"{name}: {text}")


def _give_back_quietly(store: Store, claim: Claim) -> None:
    """Give a claim back while another error is on its way, which must not be lost."""
    try:
        claims.give_back(store, claim)
    except (CompgenError, sa.exc.SQLAlchemyError) as error:
        logs.error("claim not given back", problem=str(error))
