"""The notification command: it gets one JSON object on stdin for every decision and every failure, at least once.

What was told already stands in the store as events, noted after the command ended well: a command that fails is tried
again by the next run. So one whose process is killed in between, or two at the same time, tell it twice: the same object.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from datetime import timedelta
from typing import IO, Any

from compgen.recal import logs
from compgen.recal.records import MachineRecord
from compgen.recal.store import Store

#: How long a notification command may take, s.
TIMEOUT_S = 60.0
#: What is older than this is not told any more, for example when notifications are switched on.
OLDEST = timedelta(days=1)
KIND = "notified"
#: Bytes of its stderr that are kept.
MOST_SAID = 2000


def notify(store: Store, machine: MachineRecord, command: Sequence[str]) -> list[str]:
    """Tell what was not told yet, oldest first; return why it could not be told (empty: all was)."""
    if not command:
        return []
    told = {event.subject for event in store.events(machine) if event.kind == KIND}
    since = store.read(store.now) - OLDEST
    problems = []
    for subject, message in _news(store, machine):
        if subject in told or message["at"] < since.isoformat() or _told(store, machine, subject):
            continue
        problem = _send(command, message)
        if problem:
            logs.error("notification failed", machine=machine.name, subject=subject, problem=problem)
            problems.append(problem)
            break
        store.add_event(KIND, subject, str(message["event"]), machine)
    return problems


def _told(store: Store, machine: MachineRecord, subject: str) -> bool:
    """Whether another runner told it meanwhile."""
    return any(event.kind == KIND and event.subject == subject for event in store.events(machine))


def _news(store: Store, machine: MachineRecord) -> list[tuple[str, dict[str, Any]]]:
    """Return everything that may be told, in the order of time, by a name that stays."""
    known, decisions, attempts = store.together(
        lambda: (store.tables(machine, figures=False), store.decisions(machine), store.attempts(machine))
    )
    tables = {table.id: table for table in known}
    found: list[tuple[str, dict[str, Any]]] = []
    for decision in decisions:
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
    for attempt in attempts:
        if attempt.outcome == "failed":
            message = {"machine": machine.name, "event": "failed", "reason": attempt.message}
            found.append((f"attempt {attempt.id}", {**message, "at": attempt.at.isoformat()}))
    return sorted(found, key=lambda item: str(item[1]["at"]))


def _send(command: Sequence[str], message: dict[str, Any]) -> str:
    """Run the command with the message on stdin; return what went wrong, empty if nothing.

    However long it hangs, however much it prints and whatever it leaves running, this ends in time: its output is read
    and dropped but for the beginning of stderr, and a command that takes too long is ended with its children.
    """
    try:
        process = _started(command, (json.dumps(message) + "\n").encode())
    except (OSError, ValueError) as error:
        return f"{command[0]}: {error}"
    said = _Said(process.stderr)
    try:
        code = process.wait(TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return f"{command[0]} did not end within {TIMEOUT_S:g} s and was stopped"
    finally:
        _end(process)
        text = said.text()
    return "" if code == 0 else f"{command[0]} ended with {code}: {text}"


def _started(command: Sequence[str], given: bytes) -> subprocess.Popen[bytes]:
    """Start the command with ``given`` on stdin, from a file: it may read as slowly as it likes, or not at all."""
    with tempfile.TemporaryFile() as stream:
        stream.write(given)
        stream.seek(0)
        return subprocess.Popen(
            list(command), stdin=stream, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
        )


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a command that still runs, with its children."""
    if process.poll() is None:
        with contextlib.suppress(OSError):
            if os.name == "posix":
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
        process.wait()


class _Said:
    """Reads a stream to its end in a thread and keeps its beginning."""

    def __init__(self, stream: IO[bytes] | None) -> None:
        self._kept = bytearray()
        self._stream = stream
        self._thread = threading.Thread(target=self._read, name="stderr of a notification", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._stream is not None
        with self._stream:
            while part := self._stream.read1(65536):  # type: ignore[attr-defined]
                self._kept += part[: MOST_SAID - len(self._kept)]

    def text(self) -> str:
        """Return what came; a child that went on running may keep the stream open for ever."""
        self._thread.join(1.0)
        return " ".join(bytes(self._kept).decode("utf-8", "replace").split())[:200]
