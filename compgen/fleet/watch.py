"""The long-running mode: each machine on its schedule until stopped; changes to the job file are picked up."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from apscheduler.executors.pool import ThreadPoolExecutor
from apscheduler.jobstores.base import JobLookupError
from apscheduler.schedulers.background import BackgroundScheduler
from apscheduler.triggers.combining import OrTrigger
from apscheduler.triggers.cron import CronTrigger
from apscheduler.triggers.interval import IntervalTrigger

from compgen.data.files import read_bytes, remove_abandoned_folders
from compgen.errors import CompgenError
from compgen.fleet import logs
from compgen.fleet.job import DAYS, WATCH_POLL_S, Cron, Every, Job, MachineJob, Schedule, job_of_text
from compgen.fleet.runner import MachineOutcome, run_machine

#: Schedule of a machine that has none.
UNSCHEDULED = Every(5)
#: After a problem that may go away by itself: delay before the next pass, doubled each time, and its maximum, s.
AGAIN_S, AGAIN_AT_MOST_S = 10.0, 900.0

Work = Callable[[MachineJob, str, Callable[[], bool]], MachineOutcome]


def trigger_of(schedule: Schedule) -> Any:
    """Return the trigger for the schedule, in local time."""
    if isinstance(schedule, Every):
        return IntervalTrigger(minutes=schedule.minutes)
    days = {"day": _listed(schedule.days)}
    weekdays = {"day_of_week": ",".join(DAYS[day] for day in schedule.weekdays)}
    clock = {"minute": _listed(schedule.minutes), "hour": _listed(schedule.hours), "month": _listed(schedule.months)}
    if isinstance(schedule, Cron) and not (schedule.any_day or schedule.any_weekday):
        return OrTrigger([CronTrigger(**clock, **days), CronTrigger(**clock, **weekdays)])
    return CronTrigger(**clock, **days, **weekdays)


def _listed(numbers: tuple[int, ...]) -> str:
    return ",".join(map(str, numbers))


class Watch:
    """Keeps a job running; ``on_outcome`` is called after every pass over a machine, ``threads`` passes run at once.

    ``notify`` is a command that replaces those of the job file.
    """

    def __init__(
        self,
        path: Path,
        *,
        work: Work = run_machine,
        threads: int = 1,
        on_outcome: Callable[[MachineOutcome], None] = lambda _: None,
        poll_s: float = WATCH_POLL_S,
        notify: tuple[str, ...] = (),
    ) -> None:
        self.path, self.work, self.on_outcome, self.poll_s = path, work, on_outcome, poll_s
        self.notify = notify
        self.stopped = threading.Event()
        self.job: Job | None = None
        self._content = b""
        self._troubles: dict[str, int] = {}
        self._scheduler = BackgroundScheduler(
            executors={"default": ThreadPoolExecutor(threads)},
            job_defaults={"coalesce": True, "max_instances": 1, "misfire_grace_time": None},
        )

    def stop(self, *_: object) -> None:
        """Request a stop; the measurement being processed is finished first."""
        self.stopped.set()

    def run(self, *, signals: bool = True) -> None:
        """Run until :meth:`stop`, SIGTERM or SIGINT; InputError if the job file is invalid at the start."""
        self._load()
        remove_abandoned_folders()
        if signals:
            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, self.stop)
        self._scheduler.start()
        logs.info("watching", job=str(self.path), machines=len(self.job.machines) if self.job else 0)
        try:
            while not self.stopped.wait(self.poll_s):
                # take an edited job file; an invalid one is reported once, and the previous one stays in use
                try:
                    content = read_bytes(self.path)
                    if content == self._content:
                        continue
                    self._content = content
                    self._load()
                    logs.info("job file read again", job=str(self.path))
                except CompgenError as error:
                    if self._content != b"":
                        logs.error("job file not used", job=str(self.path), problem=str(error))
                    if not self.path.is_file():
                        self._content = b""
        finally:
            self.stopped.set()
            self._scheduler.shutdown(wait=True)
            logs.info("stopped", job=str(self.path))

    def _load(self) -> None:
        content = read_bytes(self.path)
        job = job_of_text(content.decode("utf-8-sig", "replace"), self.path).with_notify(self.notify)
        self._schedule(job)
        self.job, self._content = job, content

    def _schedule(self, job: Job) -> None:
        """Add, replace and remove what changed since the previous job; new and changed machines run at once."""
        before = {} if self.job is None else self.job.machines
        same_store = self.job is not None and self.job.store == job.store
        for name in before.keys() - job.machines.keys():
            self._scheduler.remove_job(name)
        for name, machine in job.machines.items():
            if same_store and before.get(name) == machine:
                continue
            self._scheduler.add_job(
                self._pass,
                trigger_of(machine.schedule or UNSCHEDULED),
                args=(machine, job.store),
                id=name,
                name=name,
                replace_existing=True,
                next_run_time=datetime.now().astimezone(),
            )

    def _pass(self, machine: MachineJob, url: str) -> None:
        if self.stopped.is_set():
            return
        outcome = self.work(machine, url, self.stopped.is_set)
        if outcome.again:
            # if the cause may go away by itself, do not wait for the schedule, which may be a week
            name = machine.name
            count = self._troubles[name] = self._troubles.get(name, 0) + 1
            wait_s = min(AGAIN_S * 2.0 ** min(count - 1, 60), AGAIN_AT_MOST_S)
            when = datetime.now().astimezone() + timedelta(seconds=wait_s)
            with suppress(JobLookupError):  # the machine was meanwhile removed from the job file
                planned = self._scheduler.get_job(name)
                if planned is not None and planned.next_run_time is not None and when < planned.next_run_time:
                    self._scheduler.modify_job(name, next_run_time=when)
                    logs.info("checked again soon", machine=name, at=when.isoformat(timespec="seconds"))
        else:
            self._troubles.pop(machine.name, None)
        self.on_outcome(outcome)
