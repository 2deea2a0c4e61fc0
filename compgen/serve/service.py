"""What the pages share: store, users, sessions, limits, metrics; and the decisions that they may make."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from compgen.errors import InputError
from compgen.recal import actions, decisions
from compgen.recal.job import Job, read_job
from compgen.recal.records import DecisionRecord, MachineRecord
from compgen.recal.store import Store
from compgen.serve.background import Background, Pages
from compgen.serve.drift_view import DriftCache, JobFile
from compgen.serve.history import ErrorCache
from compgen.serve.limits import LoginLimit
from compgen.serve.metrics import ServeMetrics
from compgen.serve.recheck_view import RecheckCache
from compgen.serve.sessions import LoginTokens, Sessions
from compgen.serve.settings import Settings
from compgen.serve.users import Users

#: Longest reason, characters.
LONGEST_REASON = 1000


@dataclass(frozen=True)
class Service:
    """Everything that lives as long as the server."""

    settings: Settings
    store: Store
    users: Users | None
    sessions: Sessions
    tokens: LoginTokens
    limit: LoginLimit
    metrics: ServeMetrics
    errors_of: ErrorCache
    drift_of: DriftCache
    recheck_of: RecheckCache
    job: JobFile
    background: Background
    pages: Pages

    def may_decide(self, user: str) -> bool:
        """Whether this user may approve, reject and roll back here."""
        return self.settings.decide and self.users is not None and self.users.may_decide(user)


def make_service(settings: Settings, store: Store, clock: Callable[[], float] = time.monotonic) -> Service:
    """Return a service; ``clock`` (s) is for tests."""
    sessions = Sessions(clock)
    users = Users(settings.users) if settings.login and settings.users is not None else None
    metrics = ServeMetrics(store, lambda: len(sessions))
    background, job = Background(), JobFile(settings.job)
    return Service(
        settings,
        store,
        users,
        sessions,
        LoginTokens(),
        LoginLimit(clock),
        metrics,
        ErrorCache(store),
        DriftCache(store, background, job),
        RecheckCache(store, background),
        job,
        background,
        Pages(lambda: (store.version(), job.state())),
    )


@dataclass(frozen=True)
class Wish:
    """What a person wants and why; ``seen`` is the version that was active on the page, 0 for none."""

    actor: str
    reason: str
    seen: int


def _job(service: Service, path: Path) -> Job:
    """Read the job file; StoreError if its store is no longer what the pages show, before a new one is opened by name."""
    service.store.version()
    return read_job(path)


def approve(service: Service, machine: MachineRecord, version: int, wish: Wish, *, override: bool) -> DecisionRecord:
    """Approve as ``volcomp recal approve`` does; the files follow where there is a job file."""
    if service.settings.job is not None:
        job, seen = _job(service, service.settings.job), wish.seen
        return actions.approve(job, machine.name, version, wish.actor, wish.reason, override=override, seen=seen)
    store = service.store
    return decisions.approve(store, machine, version, wish.actor, wish.reason, override=override, seen=wish.seen)


def reject(service: Service, machine: MachineRecord, version: int, wish: Wish) -> DecisionRecord:
    """Reject as ``volcomp recal reject`` does."""
    if service.settings.job is not None:
        job = _job(service, service.settings.job)
        return actions.reject(job, machine.name, version, wish.actor, wish.reason, seen=wish.seen)
    return decisions.reject(service.store, machine, version, wish.actor, wish.reason, seen=wish.seen)


def rollback(service: Service, machine: MachineRecord, to: int, wish: Wish) -> DecisionRecord:
    """Roll back as ``volcomp recal rollback`` does."""
    if service.settings.job is not None:
        job = _job(service, service.settings.job)
        return actions.rollback(job, machine.name, wish.actor, wish.reason, to=to, seen=wish.seen)
    return decisions.rollback(service.store, machine, wish.actor, wish.reason, to=to, seen=wish.seen)


def clean_reason(text: str) -> str:
    """Return a reason without control characters; InputError if it is too long."""
    clean = " ".join("".join(char if char.isprintable() else " " for char in text).split())
    if len(clean) > LONGEST_REASON:
        raise InputError(f"a reason has at most {LONGEST_REASON} characters; this one has {len(clean)}")
    return clean
