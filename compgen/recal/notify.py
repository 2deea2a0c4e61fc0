"""The notification command: it gets one JSON object on stdin for every decision and every failure, each once.

What was told already stands in the store as events; a command that fails is tried again by the next run.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from datetime import timedelta
from typing import Any

from compgen.recal import logs
from compgen.recal.records import MachineRecord
from compgen.recal.store import Store

#: How long a notification command may take, s.
TIMEOUT_S = 60.0
#: What is older than this is not told any more, for example when notifications are switched on.
OLDEST = timedelta(days=1)
KIND = "notified"


def notify(store: Store, machine: MachineRecord, command: Sequence[str]) -> list[str]:
    """Tell what was not told yet, oldest first; return why it could not be told (empty: all was)."""
    if not command:
        return []
    told = {event.subject for event in store.events(machine) if event.kind == KIND}
    since = store.read(store.now) - OLDEST
    problems = []
    for subject, message in _news(store, machine):
        if subject in told or message["at"] < since.isoformat():
            continue
        problem = _send(command, message)
        if problem:
            logs.error("notification failed", machine=machine.name, subject=subject, problem=problem)
            problems.append(problem)
            break
        store.add_event(KIND, subject, str(message["event"]), machine)
    return problems


def _news(store: Store, machine: MachineRecord) -> list[tuple[str, dict[str, Any]]]:
    """Return everything that may be told, in the order of time, by a name that stays."""
    tables = {table.id: table for table in store.tables(machine)}
    found: list[tuple[str, dict[str, Any]]] = []
    for decision in store.decisions(machine):
        table = None if decision.table_id is None else tables[decision.table_id]
        message = {
            "machine": machine.name,
            "event": decision.kind,
            "version": None if table is None else table.version,
            "state": None if table is None else table.state,
            "actor": decision.actor,
            "reason": decision.reason,
            "at": decision.at.isoformat(),
        }
        found.append((f"decision {decision.sequence}", message))
    for attempt in store.attempts(machine):
        if attempt.outcome == "failed":
            message = {"machine": machine.name, "event": "failed", "reason": attempt.message}
            found.append((f"attempt {attempt.id}", {**message, "at": attempt.at.isoformat()}))
    return sorted(found, key=lambda item: str(item[1]["at"]))


def _send(command: Sequence[str], message: dict[str, Any]) -> str:
    """Run the command with the message on stdin; return what went wrong, empty if nothing."""
    text = json.dumps(message) + "\n"
    try:
        done = subprocess.run(list(command), input=text, text=True, capture_output=True, timeout=TIMEOUT_S, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        return f"{command[0]}: {error}"
    return "" if done.returncode == 0 else f"{command[0]} ended with {done.returncode}: {done.stderr.strip()[:200]}"
