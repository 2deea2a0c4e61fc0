"""The inbox of a machine: each file that fits is one measurement, each sub-folder with such files another one."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path

from compgen.core.files import sha256_of
from compgen.errors import InputError
from compgen.recal.job import MachineJob
from compgen.recal.records import NewMeasurement

#: Comments of a measurement file that say when it was made, and with which tables (a version, or "none").
TIME_KEYS = ("measured_at", "date")
ACTIVE_KEY = "active_table"
_COMMENT = re.compile(rb"^[ \t]*#[ \t]*([A-Za-z_]\w*)[ \t]*=[ \t]*(.*?)[ \t\r]*$", re.MULTILINE)


@dataclass(frozen=True)
class Problem:
    """Something in the inbox that cannot be taken now; it stays where it is and is looked at again."""

    subject: str
    message: str


@dataclass(frozen=True)
class Found:
    """What stands in an inbox: measurements by the paths of their files, and problems."""

    groups: tuple[tuple[Path, ...], ...]
    problems: tuple[Problem, ...]


def scan(job: MachineJob, now: datetime) -> Found:
    """List the measurements of an inbox by name; nothing is read yet. A folder that is missing is a problem."""
    try:
        entries = sorted(job.inbox.iterdir())
    except OSError as error:
        return Found((), (Problem(str(job.inbox), f"the inbox cannot be read: {error.strerror or error}"),))
    groups: list[tuple[Path, ...]] = []
    problems: list[Problem] = []
    for entry in entries:
        if entry.name.startswith("."):
            continue
        try:
            files = tuple(sorted(entry.iterdir())) if entry.is_dir() else (entry,)
            group = tuple(path for path in files if _fits(job, path))
            if group and not _settling(job, group, now):
                groups.append(group)
        except OSError as error:
            problems.append(Problem(str(entry), f"cannot be read: {error.strerror or error}"))
    return Found(tuple(groups), tuple(problems))


def _fits(job: MachineJob, path: Path) -> bool:
    named = not path.name.startswith(".") and any(fnmatchcase(path.name, pattern) for pattern in job.patterns)
    return named and (path.is_file() or path.is_symlink())  # a link that leads nowhere is reported when it is read


def _settling(job: MachineJob, group: tuple[Path, ...], now: datetime) -> bool:
    """Whether a file is so new that it may still be written; one from the future (a clock that went back) is not."""
    ages = [now.timestamp() - path.lstat().st_mtime for path in group]
    return any(0.0 <= age < job.settle_s for age in ages)


def load(group: tuple[Path, ...]) -> NewMeasurement:
    """Read the files of one measurement; InputError if one cannot be read or changes at this moment."""
    contents: dict[str, bytes] = {}
    times = []
    for path in group:
        try:
            before = path.stat()
            contents[path.name] = path.read_bytes()
            after = path.stat()
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror or error}", file=path) from error
        if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
            raise InputError("is being written at this moment; it is taken by the next run", file=path)
        times.append(after.st_mtime)
    name = group[0].name if len(group) == 1 else group[0].parent.name
    return measurement_of(name, contents, datetime.fromtimestamp(max(times), UTC))


def measurement_of(name: str, contents: Mapping[str, bytes], file_time: datetime) -> NewMeasurement:
    """Return a measurement from the contents of its files; names of files do not count for its hash."""
    digests = sorted(sha256_of(content) for content in contents.values())
    digest = digests[0] if len(digests) == 1 else sha256_of("\n".join(digests).encode())
    comments: dict[str, str] = {}
    for content in contents.values():
        found = {key.decode(): value.decode("utf-8", "replace") for key, value in _COMMENT.findall(content)}
        comments = {**found, **comments}
    times = [time for key in TIME_KEYS if (time := _time(comments.get(key, ""))) is not None]
    temperatures: dict[str, dict[str, float]] = {}
    for content in contents.values():
        temperatures |= _temperatures(content)
    return NewMeasurement(
        sha256=digest,
        name=name,
        measured_at=times[0] if times else file_time,
        measured_at_source="file" if times else "file time",
        contents=contents,
        active_table=comments.get(ACTIVE_KEY) or None,
        temperatures_c=temperatures,
    )


def _time(text: str) -> datetime | None:
    """Read an ISO time; without a zone it is local time."""
    try:
        return datetime.fromisoformat(text.strip()).astimezone(UTC)
    except (ValueError, OverflowError, OSError):
        return None


def _temperatures(content: bytes) -> dict[str, dict[str, float]]:
    """Return lowest, mean and highest value of each ``temp_..._c`` column; cells that are no numbers are left out."""
    if b"temp_" not in content:
        return {}
    lines = [line for line in content.decode("utf-8-sig", "replace").splitlines() if line.strip() and line[0] != "#"]
    rows = list(csv.reader(io.StringIO("\n".join(lines))))
    found = {}
    for column, name in enumerate(cell.strip() for cell in rows[0]):
        if fnmatchcase(name, "temp_*_c"):
            values = [value for row in rows[1:] if len(row) > column and (value := _number(row[column])) is not None]
            if values:
                found[name] = {"low": min(values), "mean": sum(values) / len(values), "high": max(values)}
    return found


def _number(cell: str) -> float | None:
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if abs(value) < 1e6 else None
