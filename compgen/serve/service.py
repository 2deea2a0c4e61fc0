"""What the pages share: store, users, sessions, limits, metrics; and the decisions that they may make."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from compgen.errors import InputError
from compgen.recal import actions, decisions
from compgen.recal.job import read_job
from compgen.recal.records import DecisionRecord, MachineRecord
from compgen.recal.store import Store
from compgen.serve.drift_view import DriftCache
from compgen.serve.history import ErrorCache
from compgen.serve.limits import LoginLimit
from compgen.serve.metrics import ServeMetrics
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


def make_service(settings: Settings, store: Store, clock: Callable[[], float] = time.monotonic) -> Service:
    """Return a service; ``clock`` (s) is for tests."""
    sessions = Sessions(clock)
    users = Users(settings.users) if settings.login and settings.users is not None else None
    metrics = ServeMetrics(store, lambda: len(sessions))
    shared = (sessions, LoginTokens(), LoginLimit(clock), metrics, ErrorCache(store), DriftCache(store))
    return Service(settings, store, users, *shared)


def approve(
    service: Service, machine: MachineRecord, version: int, actor: str, reason: str, override: bool
) -> DecisionRecord:
    """Approve as ``compgen recal approve`` does; the files follow where there is a job file."""
    if service.settings.job is not None:
        job = read_job(service.settings.job)
        return actions.approve(job, machine.name, version, actor, reason, override=override)
    return decisions.approve(service.store, machine, version, actor, reason, override=override)


def reject(service: Service, machine: MachineRecord, version: int, actor: str, reason: str) -> DecisionRecord:
    """Reject as ``compgen recal reject`` does."""
    if service.settings.job is not None:
        return actions.reject(read_job(service.settings.job), machine.name, version, actor, reason)
    return decisions.reject(service.store, machine, version, actor, reason)


def rollback(service: Service, machine: MachineRecord, to: int, actor: str, reason: str) -> DecisionRecord:
    """Roll back as ``compgen recal rollback`` does."""
    if service.settings.job is not None:
        return actions.rollback(read_job(service.settings.job), machine.name, actor, reason, to=to)
    return decisions.rollback(service.store, machine, actor, reason, to=to)


def clean_reason(text: str) -> str:
    """Return a reason without control characters; InputError if it is too long."""
    clean = " ".join("".join(char if char.isprintable() else " " for char in text).split())
    if len(clean) > LONGEST_REASON:
        raise InputError(f"a reason has at most {LONGEST_REASON} characters; this one has {len(clean)}")
    return clean


def check_seen(service: Service, machine: MachineRecord, seen: str) -> None:
    """Raise InputError if other tables became active since the page of the decision was shown."""
    active = decisions.active_table(service.store, machine)
    if seen != str(active.version if active is not None else 0):
        raise InputError("other tables became active since you opened the page; look at it again before you decide")
