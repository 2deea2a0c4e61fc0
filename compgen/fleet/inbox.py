"""The inbox of a machine: each file that matches is one measurement, each sub-folder with such files another one."""

from __future__ import annotations

import contextlib
import csv
import io
import os
import re
import stat
import warnings
import zipfile
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compgen.data.csv_files import MOST_COLUMNS
from compgen.data.files import sha256_of
from compgen.errors import CompgenWarning, InputError, visible
from compgen.fleet.job import MachineJob, OtherInbox
from compgen.fleet.records import MachineRecord, NewMeasurement

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from compgen.fleet.store import Store

#: Name of a backup of the control beside a measurement: NAME.backup.EXT; EXT may have several parts.
BACKUP = re.compile(r"(.+?)\.backup(?:\.(.+))?", re.IGNORECASE | re.DOTALL)
_MEASUREMENT = re.compile(
    r"(.+)\.(lengths|deviations|sixdof|axis|circle|part|artefact|sphere|bar|errors)\.(csv|npz|parquet)"
)
#: Comments of a measurement file that give the time of measurement, and the tables that were on (a version, or "none").
TIME_KEYS = ("measured_at", "date")
ACTIVE_KEY = "active_table"
#: Comments that say whose readings they are: of which machine, its serial number, that of the instrument.
IDENTITY_KEYS = ("machine", "machine_name", "machine_serial", "machine_serial_number", "serial_number")
#: The same in the head of files of other programs, by the key above.
_HEAD = re.compile(rb"(machine|machine name|serial no|maschine)\s*[:;=\t]\s*([^\r\n;\t]+)", re.IGNORECASE)
_HEAD_KEYS = {b"serial no": "machine_serial"}
#: Lines of such a head, and bytes of an entry of an archive that may be a comment.
HEAD_LINES, MOST_ENTRY = 60, 4096
#: Largest number of files of one measurement, and of characters of a comment about it.
MOST_FILES, LONGEST_COMMENT = 1000, 200
#: No measurement takes longer, s: a year.
LONGEST_S = 366 * 86400.0


@dataclass(frozen=True)
class InboxProblem:
    """Something in the inbox that cannot be used now; it stays there and is tried again."""

    subject: str
    message: str


@dataclass(frozen=True)
class InboxContents:
    """What an inbox contains: measurements (the paths of their files) and problems.

    ``backups``: paths of backups of the control by the name of the measurement to which they belong.
    """

    groups: tuple[tuple[Path, ...], ...]
    problems: tuple[InboxProblem, ...]
    backups: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)


def scan(job: MachineJob, now: datetime) -> InboxContents:
    """List the measurements of an inbox in order of name without reading them. A missing folder is a problem."""
    try:
        entries = sorted(job.inbox.iterdir())
    except OSError as error:
        return InboxContents(
            (), (InboxProblem(str(job.inbox), f"the inbox cannot be read: {error.strerror or error}"),)
        )
    groups: list[tuple[Path, ...]] = []
    problems: list[InboxProblem] = []
    backups: dict[str, list[Path]] = {}
    for entry in entries:
        if entry.name.startswith("."):
            continue
        try:
            if entry.is_symlink() and entry.is_dir():
                problems.append(InboxProblem(str(entry), "is a link to a folder; put the folder itself into the inbox"))
                continue
            files = sorted(entry.iterdir()) if entry.is_dir() else [entry]
            files = [path for path in files if not path.name.startswith(".")]
            own = [path for path in files if is_backup(path.name)]
            named = [path for path in files if path not in own and _is_named(path, job.patterns)]
            # links, pipes and devices are reported when they are read
            group = tuple(path for path in named if path.is_symlink() or not path.is_dir())
            for name, path in _backups(entry, own or files, group):
                backups.setdefault(name, []).append(path)
            if group and not _is_new(job, group, now):
                groups.append(group)
        except OSError as error:
            problems.append(InboxProblem(str(entry), f"cannot be read: {error.strerror or error}"))
    whole = {name: tuple(sorted(paths)) for name, paths in backups.items() if not _is_new(job, paths, now)}
    return InboxContents(tuple(groups), tuple(problems), whole)


def _is_new(job: MachineJob, paths: Iterable[Path], now: datetime) -> bool:
    """Whether a file may still be being written; one from the future (a clock set back) is not."""
    with contextlib.suppress(FileNotFoundError):
        ages = [now.timestamp() - path.lstat().st_mtime for path in paths]
        return any(0.0 <= age < job.settle_s for age in ages)
    return True


def _backups(entry: Path, files: Iterable[Path], group: tuple[Path, ...]) -> Iterator[tuple[str, Path]]:
    """Backups of the control, each with the name of its measurement.

    They are files NAME.backup.EXT, the files in a folder NAME.backup, and backups in the folder of a measurement.
    """
    folder = BACKUP.fullmatch(entry.name)
    for path in files:
        named = BACKUP.fullmatch(path.name)
        if entry.is_dir() and folder is not None and not folder[2]:
            if not path.is_dir():
                yield folder[1], path
        elif named is not None and is_backup(path.name):
            yield _name_of(group) if entry.is_dir() and group else named[1], path


def _name_of(group: tuple[Path, ...]) -> str:
    """Name of a measurement: that of its file, or of the folder of its files."""
    return group[0].name if len(group) == 1 else group[0].parent.name


def _is_named(path: Path, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(path.name, pattern) for pattern in patterns)


def names_of(measurement: str) -> set[str]:
    """Return the names by which a backup may refer to a measurement: that of its file, also without its ends.

    >>> sorted(names_of("2026-01-05.lengths.csv"))
    ['2026-01-05', '2026-01-05.lengths', '2026-01-05.lengths.csv']
    """
    found, kind = {measurement}, _MEASUREMENT.fullmatch(measurement)
    if kind is not None:
        found |= {kind[1], f"{kind[1]}.{kind[2]}"}
    return found | ({Path(measurement).stem} if Path(measurement).suffix else set())


def is_backup(name: str) -> bool:
    """Whether a file is a backup of a control by its name; a copy of a measurement is not.

    >>> is_backup("a.backup.ini"), is_backup("a.backup.lengths.csv"), is_backup("a.ini")
    (True, False, False)
    """
    found = BACKUP.fullmatch(name)
    return found is not None and bool(found[2]) and _MEASUREMENT.fullmatch(name) is None


def backup_part(name: str) -> str:
    """Return the name of a file of a backup without that of the measurement.

    >>> backup_part("a.backup.joint0-x.comp"), backup_part("a.backup.ini"), backup_part("NC_CEC.INI")
    ('joint0-x.comp', 'backup.ini', 'NC_CEC.INI')
    """
    found = BACKUP.fullmatch(name)
    if found is None or not found[2]:
        return name
    return found[2] if "." in found[2] else f"backup.{found[2]}"


def read_files(job: MachineJob, group: tuple[Path, ...]) -> tuple[str, dict[str, bytes], datetime]:
    """Read the files of one measurement: its name, their contents, and the time of the newest.

    Raises
    ------
    InputError
        if a file cannot be read, is changing, is a link or not a file, or together they are larger than the job allows.
    """
    if len(group) > MOST_FILES:
        raise InputError(f"contains {len(group)} files; one measurement has at most {MOST_FILES}", file=group[0].parent)
    contents: dict[str, bytes] = {}
    times = []
    left = round(job.max_size_mb * 1e6)
    for path in group:
        content, state = _read_regular(path, left, folder_is_real=path.parent != job.inbox)
        contents[path.name], left = content, left - len(content)
        times.append(state.st_mtime)
    return visible(_name_of(group), flat=True), contents, datetime.fromtimestamp(max(times), UTC)


def receive(store: Store, machine: MachineRecord, job: MachineJob) -> None:
    """Store the measurements that are in the inbox; what cannot be read is reported by the next pass over the machine."""
    for group in scan(job, store.now()).groups:
        with contextlib.suppress(InputError):
            store.add_measurement(machine, measurement_of(*read_files(job, group), job.temperatures))


def read_backup(job: MachineJob, paths: Iterable[Path]) -> dict[str, tuple[bytes, datetime]]:
    """Read the files of a backup: contents and time of change by name; InputError as for :func:`read_files`."""
    found: dict[str, tuple[bytes, datetime]] = {}
    left = round(job.max_size_mb * 1e6)
    for path in paths:
        content, state = _read_regular(path, left, folder_is_real=path.parent != job.inbox)
        found[path.name], left = (content, datetime.fromtimestamp(state.st_mtime, UTC)), left - len(content)
    if len(found) > MOST_FILES:
        raise InputError(f"contains {len(found)} files; a backup has at most {MOST_FILES}")
    return found


def digest_of(contents: Mapping[str, bytes]) -> str:
    """Return the hash that identifies a measurement; file names do not count."""
    digests = sorted(sha256_of(content) for content in contents.values())
    return digests[0] if len(digests) == 1 else sha256_of("\n".join(digests).encode())


def _read_regular(path: Path, most: int, *, folder_is_real: bool) -> tuple[bytes, os.stat_result]:
    """Return contents and state of an untrusted file, which must be regular, at most ``most`` bytes and not a link.

    It neither waits (for a pipe that nobody writes to) nor reads without end (from a device). With ``folder_is_real``
    the file's folder must not be a link either.

    Raises
    ------
    InputError
        for anything else, a file that is too large, and one that changes while it is read.
    """
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    try:
        kind = path.lstat().st_mode
        if stat.S_ISLNK(kind) or (folder_is_real and path.parent.is_symlink()):
            raise InputError("cannot be read: it is a link; put the file itself there", file=path)
        if not stat.S_ISREG(kind):  # not even opened: opening a device may trigger an action
            raise InputError("cannot be read: it is a pipe or a device, not a file", file=path)
        with _opened_folder(path.parent, real=folder_is_real) as folder:
            handle = os.open(path if folder is None else path.name, flags, dir_fd=folder)
        with os.fdopen(handle, "rb") as stream:
            before = os.fstat(handle)
            if not stat.S_ISREG(before.st_mode):
                raise InputError("cannot be read: it was replaced while it was opened", file=path)
            if before.st_size > most:
                size, allowed = before.st_size / 1e6, most / 1e6
                message = f"is too large: {size:.3g} MB, but only {allowed:.3g} MB are left for this measurement"
                raise InputError(f"{message}; max_size_mb of the job file is the limit", file=path)
            content = stream.read(most + 1)
            after = os.fstat(handle)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=path) from error
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns) or len(content) != after.st_size:
        raise InputError("is still being written; the next run reads it", file=path)
    return content, after


def with_twins(chosen: Iterable[MachineJob], every: Iterable[MachineJob]) -> list[MachineJob]:
    """Return the jobs, each with the machines whose inboxes contain one of its files added to ``others``.

    Only files of the same size are read. What cannot be read is reported by the pass over its machine.
    """
    boxes = {job.name: OtherInbox(job.name, job.inbox, job.patterns) for job in every}
    by_size: dict[int, list[tuple[str, Path]]] = {}
    for box in boxes.values():
        for path, size in _listed(box):
            by_size.setdefault(size, []).append((box.name, path))
    sharing: dict[str, set[str]] = {}
    for size, files in by_size.items():
        if len({name for name, _ in files}) < 2:
            continue
        same: dict[str, set[str]] = {}
        for name, path in files:
            with contextlib.suppress(InputError):
                content, _ = _read_regular(path, size, folder_is_real=path.parent != boxes[name].inbox)
                same.setdefault(sha256_of(content), set()).add(name)
        for names in same.values():
            for name in names:
                sharing.setdefault(name, set()).update(names - {name})
    found = []
    for job in chosen:
        known = {item.name for item in job.others}
        more = tuple(boxes[name] for name in sorted(sharing.get(job.name, set()) - known))
        found.append(replace(job, others=(*job.others, *more)))
    return found


def holds_one_of(other: OtherInbox, contents: Iterable[bytes]) -> bool:
    """Whether a matching file in another machine's inbox or a sub-folder has one of these non-empty contents."""
    searched = {(len(content), sha256_of(content)) for content in contents if content}
    found = found_in(other, {size for size, _ in searched}) if other.found is None else other.found
    return not searched.isdisjoint(found)


def found_in(other: OtherInbox, sizes: Container[int]) -> frozenset[tuple[int, str]]:
    """Return size and SHA-256 of matching files of these sizes in another machine's inbox or a sub-folder."""
    found = set()
    for path, size in _listed(other):
        if size in sizes:
            with contextlib.suppress(InputError):
                content, _ = _read_regular(path, size, folder_is_real=path.parent != other.inbox)
                found.add((len(content), sha256_of(content)))
    return frozenset(found)


def _listed(box: OtherInbox) -> list[tuple[Path, int]]:
    """Return path and size of matching regular files in an inbox and its sub-folders, as far as they can be read."""
    found = []
    with contextlib.suppress(OSError):
        entries = sorted(box.inbox.iterdir())
        folders = [entry for entry in entries if entry.is_dir() and not entry.is_symlink()]
        for path in [*entries, *(path for folder in folders for path in sorted(folder.iterdir()))]:
            state = path.lstat()
            if (
                _is_named(path, box.patterns)
                and not is_backup(path.name)
                and stat.S_ISREG(state.st_mode)
                and state.st_size > 0
            ):
                found.append((path, state.st_size))
    return found


@contextlib.contextmanager
def _opened_folder(folder: Path, *, real: bool) -> Iterator[int | None]:
    """Open a folder by a handle, which nobody can redirect to another one; None on a system without this feature."""
    if os.open not in os.supports_dir_fd:
        yield None
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | (os.O_NOFOLLOW if real else 0))
    try:
        yield handle
    finally:
        os.close(handle)


def measurement_of(
    name: str, contents: Mapping[str, bytes], file_time: datetime, log: Path | None = None
) -> NewMeasurement:
    """Return a measurement from the contents of its files; ``log`` has temperatures of its scales, if its files have none."""
    comments: dict[str, str] = {}
    for content in contents.values():  # the first file wins
        comments = {**comments_in(content), **comments}
    stated = _time_of(comments)
    temperatures: dict[str, dict[str, float]] = {}
    for content in contents.values():
        temperatures |= _temperatures(content)
    if log is not None:
        temperatures = {**_logged(log, contents), **temperatures}
    return NewMeasurement(
        sha256=digest_of(contents),
        name=name,
        measured_at=file_time if stated is None else stated[0],
        measured_at_source="file time" if stated is None else stated[1],
        contents=contents,
        active_table=comments.get(ACTIVE_KEY) or None,
        temperatures_c=temperatures,
    )


def comments_in(content: bytes) -> dict[str, str]:
    """Return the known comments `# key = value` of a file, or of an archive, cut at a sensible length."""
    if content[:4] == b"PK\x03\x04":
        said = _entries_of_zip(content)
    elif content[:4] == b"PAR1":
        said = _entries_of_parquet(content)
    else:
        said = {}
        for line in content.splitlines():  # the last of a key wins
            key, equals, value = line.strip().partition(b"=")
            if equals and key.startswith(b"#"):
                said[key[1:].strip().decode("utf-8", "replace")] = value.decode("utf-8", "replace")
    known = (*TIME_KEYS, ACTIVE_KEY, *IDENTITY_KEYS)
    return {key: value.strip()[:LONGEST_COMMENT] for key, value in said.items() if key in known}


def _entries_of_zip(content: bytes) -> dict[str, str]:
    """The single values of an archive of lengths (``*.lengths.npz``) as texts; nothing of any other archive."""
    entries = _arrays(content, lambda item: item.file_size <= MOST_ENTRY)
    return {name: str(value) for name, value in entries.items() if value.ndim == 0}


def _arrays(content: bytes, wanted: Callable[[zipfile.ZipInfo], bool]) -> dict[str, NDArray[Any]]:
    """Arrays of a zip archive by name, of those entries that are wanted, and stored as they are; none if it is another one."""
    import numpy as np  # imported here: few inboxes have archives

    broken = (zipfile.BadZipFile, ValueError, EOFError, OSError, KeyError, NotImplementedError)
    with contextlib.suppress(*broken), zipfile.ZipFile(io.BytesIO(content)) as archive:
        items = [item for item in archive.infolist()[:MOST_FILES] if item.compress_type == 0 and wanted(item)]
        read = (np.lib.format.read_array(io.BytesIO(archive.read(item)), allow_pickle=False) for item in items)
        return {item.filename.removesuffix(".npy"): value for item, value in zip(items, read, strict=True)}
    return {}


def _entries_of_parquet(content: bytes) -> dict[str, str]:
    try:
        from pyarrow import ArrowException, parquet
    except ImportError:  # such a file cannot be read anyway
        return {}
    with contextlib.suppress(ArrowException, OSError, ValueError):
        known = parquet.read_schema(io.BytesIO(content)).metadata or {}
        return {key.decode("utf-8", "replace"): value.decode("utf-8", "replace") for key, value in known.items()}
    return {}


def whose(contents: Mapping[str, bytes]) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    r"""Return what the files of a measurement say of machine and instrument, by key: in comments, in foreign heads.

    >>> whose({"a.csv": b"# machine = m1\nx_mm\n", "b.rtl": b"MACHINE: Hermle 12\nSERIAL NO: 4711\n"})
    ({'machine': ['m1']}, {'machine': ['Hermle 12'], 'machine_serial': ['4711']})
    """
    comments: dict[str, list[str]] = {}
    heads: dict[str, list[str]] = {}
    for content in contents.values():
        for key, value in comments_in(content).items():
            if key in IDENTITY_KEYS:
                _add(comments, key, value)
        for line in content[: HEAD_LINES * 400].splitlines()[:HEAD_LINES]:
            found = _HEAD.match(line.strip())
            if line.startswith(b"MACHINE "):  # of a probing program of ours
                _add(comments, "machine", line[8:].decode("utf-8", "replace"))
            elif found is not None:
                _add(heads, _HEAD_KEYS.get(found[1].lower(), "machine"), found[2].decode("utf-8", "replace"))
    return comments, heads


def _add(said: dict[str, list[str]], key: str, value: str) -> None:
    text = visible(value.strip()[:LONGEST_COMMENT], flat=True)
    if text and text not in said.setdefault(key, []):
        said[key].append(text)


def time_in(content: bytes) -> tuple[datetime, str] | None:
    """Return the time that a file states, and how sure it is; None if it states none.

    >>> time_in(b"# measured_at = 2026-03-01T06:30:00+01:00")
    (datetime.datetime(2026, 3, 1, 5, 30, tzinfo=datetime.timezone.utc), 'file')
    """
    return _time_of(comments_in(content))


def _time_of(comments: Mapping[str, str]) -> tuple[datetime, str] | None:
    """The time in ISO form, and how sure it is: a time without a time zone is taken as local."""
    for word in TIME_KEYS:
        with contextlib.suppress(ValueError, OverflowError, OSError):
            said_at = datetime.fromisoformat(comments.get(word, "").strip())
            return said_at.astimezone(UTC), "file" if said_at.tzinfo is not None else "file, no zone"
    return None


def duration_s(content: bytes) -> float:
    r"""Return how long the readings of a file took, by its column ``time_s``; 0 without one.

    >>> duration_s(b"x_mm,time_s\n1.0,30.5\n2.0,90.5\n")
    60.0
    """
    if b"time_s" not in content:
        return 0.0
    if content[:4] == b"PK\x03\x04":
        times = _arrays(content, lambda item: item.filename == "time_s.npy" and item.file_size <= len(content))
        value = times.get("time_s")
        if value is None or value.dtype.kind not in "iuf" or not value.size:
            return 0.0
        lasted = float(value.max() - value.min())
        return min(lasted, LONGEST_S) if lasted > 0.0 else 0.0
    rows = (line.split(b",") for line in content.splitlines() if line.strip() and not line.startswith(b"#"))
    names = [cell.strip() for cell in next(rows, [])]
    if b"time_s" not in names:
        return 0.0
    column = names.index(b"time_s")
    values = [_number(row[column].decode("ascii", "replace"), 1e12) for row in rows if len(row) > column]
    known = [number for number in values if number is not None]
    return min(max(known) - min(known), LONGEST_S) if known else 0.0


def _temperatures(content: bytes) -> dict[str, dict[str, float]]:
    """Return lowest, mean and highest value of each ``temp_..._c`` column; cells that are not numbers are left out."""
    if b"temp_" not in content:
        return {}
    lines = [line for line in content.decode("utf-8-sig", "replace").splitlines() if line.strip() and line[0] != "#"]
    try:
        rows = list(csv.reader(lines))
    except csv.Error:  # the reader of the measurement reports what is wrong, and where
        return {}
    if not rows or len(rows[0]) > MOST_COLUMNS:
        return {}
    found = {}
    for column, name in enumerate(cell.strip() for cell in rows[0]):
        if fnmatchcase(name, "temp_*_c"):
            values = [value for row in rows[1:] if len(row) > column and (value := _number(row[column])) is not None]
            if values:
                found[name] = {"low": min(values), "mean": sum(values) / len(values), "high": max(values)}
    return found


def _logged(log: Path, contents: Mapping[str, bytes]) -> dict[str, dict[str, float]]:
    """Return lowest, mean and highest temperature of each scale in a log while the files were measured; none where it has none.

    What is wrong with the log is said when the measurement is processed.
    """
    import numpy as np  # imported here: few machines have a log

    from compgen.data.csv_files import comment_of
    from compgen.fleet.change import SCALE_CHANNELS
    from compgen.heat.joining import columns_at, moments_of, on_clock, read_stretches, stretch_of

    try:
        moments = []
        for content in contents.values():
            lines = content.decode("utf-8-sig", "replace").splitlines()
            comments = dict(found for line in lines if (found := comment_of(line.strip())))
            moments.append(moments_of(np.linspace(0.0, duration_s(content), 50), comments, None))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CompgenWarning)
            part, _ = stretch_of(read_stretches(log), moments, log)
    except InputError:
        return {}
    means: dict[str, dict[str, float]] = {}
    for column in SCALE_CHANNELS:
        values = part.celsius.get(column[len("temp_") : -len("_c")])
        if values is not None:
            at_s = [on_clock(part, item.at_s, epoch=item.epoch) for item in moments]
            read = np.concatenate([columns_at(part, values, at) for at in at_s])
            means[column] = {"low": float(read.min()), "mean": float(read.mean()), "high": float(read.max())}
    return means


def _number(cell: str, most: float = 1e6) -> float | None:
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if abs(value) < most else None
