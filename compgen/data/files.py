"""Output files: written to a temporary name and renamed, all files of a step or none; locks between processes.

Temporary files and folders are locked by the process that made them, so that the next one can recognise and remove what
a killed process left behind. Nobody waits for ever for a lock: a process may be stopped while it has one.
"""

from __future__ import annotations

import contextlib
import errno
import filecmp
import hashlib
import itertools
import json
import math
import os
import re
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compgen.data.arguments import path_of
from compgen.errors import CompgenError, InputError, Message

TEMPORARY = ".tmp"
#: Put in front of the name of a table or program that was not accepted.
REJECTED_PREFIX = "NOT-ACCEPTED-"
#: Prefix of temporary folders, and the file whose lock shows that the process still runs.
FOLDERS, LOCK = "compgen-", ".lock"
#: Newer files may be about to be locked, s.
NEW_S = 2.0
#: An empty temporary folder without a lock that is older than this belongs to nobody, s.
EMPTY_S = 3600.0
#: One with contents but no lock (of a version that had none, or whose lock someone deleted) in which nothing has changed for
#: this long is removed, too, s. Its name and mode must be those that this program gives.
OLD_S, OLD_NAME, OWN_MODE = 7 * 86400.0, re.compile(rf"{FOLDERS}(recal|restore|lengths)-[a-z0-9_]{{8}}"), 0o700
#: Limits of a text that is read whole: its size in bytes, and the characters of one line (a table of 10 000 columns has fewer).
#: They are checked before anything is split: a line of megabytes would become millions of fields.
MOST_TEXT, LONGEST_LINE, _PIECE = 256_000_000, 200_000, 1 << 20
#: Temporary files and folders of this process, each with the open file that keeps its lock.
_locks: dict[Path, int] = {}


#: Names that Windows reserves for devices, with any extension and in any case.
_DEVICES = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9\u00b9\u00b2\u00b3])", re.IGNORECASE)


def name_problem(name: str, others: Iterable[str] = ()) -> str | None:
    """Say why a name cannot be that of a file or folder beside ``others`` on every system; None if it can.

    >>> name_problem("nul.v2")
    'is a name that Windows reserves for a device; choose another one'
    >>> name_problem("Mill", ["mill"])
    "differs from 'mill' by upper and lower case only; choose another one"
    """
    if _DEVICES.fullmatch(name.partition(".")[0].rstrip()):
        return "is a name that Windows reserves for a device; choose another one"
    if name != name.rstrip(". "):
        return "ends with a dot or a blank, which Windows drops; choose another one"
    same = [other for other in others if other != name and other.casefold() == name.casefold()]
    return f"differs from {same[0]!r} by upper and lower case only; choose another one" if same else None


def sha256_of(content: bytes) -> str:
    """Return the SHA-256 of ``content`` as hexadecimal text."""
    return hashlib.sha256(content).hexdigest()


@dataclass(frozen=True)
class Provenance:
    """Return the source of the errors: (name, SHA-256) of every input file, for manifest and file headers."""

    inputs: Sequence[tuple[str, str]] = ()


def sha256_of_file(path: str | Path) -> str:
    """Return the SHA-256 of a file of any size; InputError for one that cannot be read."""
    try:
        with Path(path).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(
            Message("file-unreadable", "cannot be read: {strerror}", strerror=error.strerror or error), file=path
        ) from error


def json_values(value: Any) -> Any:
    """Return ``value`` as JSON data: keys are texts, and a number that is unknown (nan) or not finite is None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): json_values(item) for key, item in value.items()}
    return [json_values(item) for item in value] if isinstance(value, list | tuple) else value


def json_text(value: Any) -> str:
    """Return the text of a JSON file, see :func:`json_values`; other objects are written as text."""
    return json.dumps(json_values(value), indent=2, default=str, allow_nan=False) + "\n"


class OutputFolder:
    """A folder that receives a set of files together.

    ``add`` keeps the contents in memory; ``commit`` writes each to a temporary name next to its target and only then
    renames them, so that an error leaves neither half a file nor half a set. ``commit`` renames a file passed to
    ``set_aside`` to ``PREVIOUS-...`` before the new ones get their names: a process killed in between leaves no old
    file that looks like one of the new set. ``private``: only this user may read the files; otherwise the umask says
    who may, but nobody who may not read the file that is replaced.
    """

    def __init__(self, folder: str | Path, *, private: bool = False) -> None:
        self.folder, self._mode = path_of("folder", folder), 0o600 if private else 0o666
        self._contents: dict[str, bytes] = {}
        self._copies: dict[str, Path] = {}
        self._aside: list[str] = []
        try:
            existing = self.folder
            while not existing.exists() and existing != existing.parent:
                existing = existing.parent
            if existing.exists() and not existing.is_dir():
                raise InputError(Message("out-is-file", "is a file; --out needs a folder"), file=existing)
            if existing.is_dir() and (
                not existing.stat().st_mode & 0o222 or not os.access(existing, os.W_OK | os.X_OK)
            ):
                raise InputError(
                    Message(
                        "out-read-only", "the output folder is read-only; choose another --out or make it writable"
                    ),
                    file=existing,
                )
        except OSError as error:
            raise InputError(
                Message("out-unusable", "cannot be used: {strerror}", strerror=error.strerror or error),
                file=self.folder,
            ) from error

    @property
    def contents(self) -> Mapping[str, bytes]:
        """What has been added, by name."""
        return self._contents

    def add(self, name: str, content: str | bytes) -> None:
        """Add ``content`` (text is encoded as UTF-8, line ends kept) for the file ``name``."""
        self._contents[name] = content.encode("utf-8") if isinstance(content, str) else content

    def add_file(self, name: str, source: Path) -> None:
        """Add a copy of the file ``source``, which may be large, as the file ``name``; it is read by ``commit``."""
        self._copies[name] = source

    def set_aside(self, name: str) -> Path:
        """Keep the existing file ``name`` under the returned name, which overwrites no other file."""
        self._aside.append(name)
        return _previous(self.folder / name)

    def commit(self) -> dict[str, Path]:
        """Write everything and return the path of each file by name."""
        contents: dict[str, bytes | Path] = {**self._contents, **self._copies}
        paths = {name: self.folder / name for name in contents}
        aside = [(self.folder / name, _previous(self.folder / name)) for name in dict.fromkeys(self._aside)]
        temporary: dict[str, Path] = {}
        # folders to create for the targets, the innermost first
        missing = {folder for target in paths.values() for folder in target.parents if not folder.exists()}
        made = sorted(missing, key=lambda folder: len(folder.parts), reverse=True)
        try:
            names: dict[Path, set[str]] = {}  # leftovers of killed processes, to be removed
            for target in paths.values():
                names.setdefault(target.parent, set()).add(target.name)
            for folder, own in names.items():
                with contextlib.suppress(OSError):
                    for path in list(folder.iterdir()):
                        found = re.fullmatch(r"\.(.+)\.[a-z0-9_]{8}" + re.escape(TEMPORARY), path.name, re.DOTALL)
                        if found and found[1] in own and _abandoned(path):
                            path.unlink(missing_ok=True)
            for path in paths.values():
                path.parent.mkdir(parents=True, exist_ok=True)
                if path.is_dir():
                    raise IsADirectoryError(21, f"{path.name} is a folder")
            for name, content in contents.items():
                temporary[name] = _write_temporary(paths[name], content, self._mode)
            _replace_all([*aside, *((temporary[name], paths[name]) for name in paths)])
        except OSError as error:
            _remove([*temporary.values()], made)
            raise InputError(
                Message(
                    "out-not-written", "cannot write: {strerror}; nothing was written", strerror=error.strerror or error
                ),
                file=self.folder,
            ) from error
        except BaseException:
            _remove([*temporary.values()], made)
            raise
        finally:
            for path in temporary.values():
                _unlock(path)
        return paths


def _previous(path: Path) -> Path:
    """Return a name with ``PREVIOUS-`` that is free, or belongs to a file with the same contents."""
    for count in itertools.count(1):
        free = path.with_name(f"PREVIOUS-{'' if count == 1 else f'{count}-'}{path.name}")
        if not free.exists() or (free.is_file() and path.is_file() and filecmp.cmp(free, path, shallow=False)):
            return free
    raise AssertionError("itertools.count never ends")


def _remove(files: Iterable[Path], folders: Iterable[Path]) -> None:
    """Remove temporary files, then the folders made for them if empty."""
    for path in files:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def _replace_all(moves: Sequence[tuple[Path, Path]]) -> None:
    """Rename each first path to the second; if one fails, put back all files as they were, the last first."""
    done: list[tuple[Path, Path, bytes | None]] = []
    try:
        for source, target in moves:
            before = target.read_bytes() if target.exists() else None
            os.replace(source, target)
            done.append((source, target, before))
    except BaseException:
        for source, target, before in reversed(done):
            with contextlib.suppress(OSError):
                if not source.name.endswith(TEMPORARY):  # a file set aside: its contents are not written again
                    os.replace(target, source)
                elif before is None:
                    target.unlink()
                else:
                    again = _write_temporary(target, before)
                    os.replace(again, target)
                    _unlock(again)
        raise


def _write_temporary(target: Path, content: bytes | Path, mode: int = 0o666) -> Path:
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=TEMPORARY, dir=target.parent)
    path = Path(name)
    try:
        kept = os.dup(handle)
        _locks[path] = kept
        _locked(kept)
        with os.fdopen(handle, "wb") as stream:
            if isinstance(content, Path):
                with content.open("rb") as source:
                    shutil.copyfileobj(source, stream)
            else:
                stream.write(content)
            stream.flush()
            if _locks.keys().isdisjoint(target.parents):  # what is in a working folder is not meant to last
                os.fsync(stream.fileno())
        mask = os.umask(0)
        os.umask(mask)
        with contextlib.suppress(OSError):  # a new file
            mode &= 0o600 | target.lstat().st_mode
        path.chmod(mode & ~mask)
    except BaseException:
        path.unlink(missing_ok=True)
        _unlock(path)
        raise
    return path


def _locked(handle: int) -> bool:
    """Lock an open file; the system releases it when this process ends. False if another process has the lock."""
    try:
        return _lock(handle)
    except (ImportError, OSError):  # a system or a file system without such locks: nothing counts as abandoned
        return False


def _lock(handle: int) -> bool:
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _unlock(path: Path) -> None:
    handle = _locks.pop(path, None)
    if handle is not None:
        os.close(handle)


def _abandoned(path: Path, new_s: float = NEW_S) -> bool:
    """Whether the process that made a temporary file, or the lock of a folder, was killed: no process has the lock."""
    try:
        if time.time() - path.lstat().st_mtime < new_s:
            return False
        handle = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    except OSError:
        return False
    try:
        return _locked(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def working_folder(name: str = "", parent: Path | None = None) -> Iterator[Path]:
    """Yield a temporary folder that is removed at the end, and by the next process if this one is killed.

    Only this user may look into it. It is in the folder for temporary files unless ``parent`` names another. Its files
    need not survive a power failure, so they are not forced to the disk.
    """
    remove_abandoned_folders(parent)
    with _own_folder(Path(tempfile.mkdtemp(prefix=f"{FOLDERS}{name}", dir=parent))) as folder:
        yield folder


def named_below(text: str, *folders: Path) -> str:
    """Return a text with the files below ``folders`` named from there: a temporary folder means nothing to a reader."""
    for place in (place for folder in folders for place in (folder.resolve(), folder)):
        text = text.replace(f"{place}{os.sep}", "")
    return text


@contextlib.contextmanager
def naming_below(*folders: Path) -> Iterator[None]:
    """Let the errors of a block name the files below ``folders`` as :func:`named_below` does."""
    try:
        yield
    except CompgenError as error:
        error.args = (named_below(str(error), *folders), *error.args[1:])
        raise


@contextlib.contextmanager
def folder_beside(target: Path) -> Iterator[Path]:
    """Yield a temporary folder next to ``target``, for a file that is made there and then linked to its name.

    It is removed at the end, and by whoever makes the next one in that folder if this process is killed.
    """
    with contextlib.suppress(OSError):
        for path in target.parent.glob(f".*{TEMPORARY}"):
            named = re.fullmatch(r"\..+\.[a-z0-9_]{8}" + re.escape(TEMPORARY), path.name, re.DOTALL)
            if named and path.is_dir() and not path.is_symlink() and _left(path):
                _remove_folder(path)
    made = tempfile.mkdtemp(prefix=f".{target.name[:100]}.", suffix=TEMPORARY, dir=target.parent)
    with _own_folder(Path(made)) as folder:
        yield folder


def _left(folder: Path) -> bool:
    """Whether the process that made a temporary folder beside a file was killed, maybe before it had a lock there."""
    if os.path.lexists(folder / LOCK):
        return _abandoned(folder / LOCK, 0.0)
    own = {path.name for path in folder.iterdir()} <= {f"{LOCK}{TEMPORARY}"}
    return own and time.time() - folder.stat().st_mtime > NEW_S


@contextlib.contextmanager
def _own_folder(folder: Path) -> Iterator[Path]:
    """Keep the lock of a temporary folder while it is in use, then remove both; nobody sees the lock before it is kept."""
    first = folder / (f"{LOCK}{TEMPORARY}" if os.name == "posix" else LOCK)  # elsewhere an open file keeps its name
    _locks[folder] = os.open(first, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        _locked(_locks[folder])
        first.rename(folder / LOCK)
        yield folder
    finally:
        _remove_folder(folder)
        _unlock(folder)


#: How long a process waits for the lock of a folder, and between attempts, s.
LOCK_WAIT_S, LOCK_POLL_S = 30.0, 0.05


@contextlib.contextmanager
def exclusive(
    path: Path, wait_s: float | None = None, mode: int = 0o666, waiting: Callable[[], object] = lambda: None
) -> Iterator[None]:
    """Keep other processes out by the lock file ``path``; the system releases it whatever happens to this one.

    The file says which process has the lock; ``mode`` is for a new one. ``waiting`` is called before it waits.

    Raises
    ------
    InputError
        if another process keeps the lock for longer than ``wait_s`` (default :data:`LOCK_WAIT_S`); it is named.
    """
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    handle = os.open(path, flags, mode)
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise InputError(Message("lock-not-a-file", "is not a file; a lock is kept here, so remove it"), file=path)
        with contextlib.suppress(ImportError):  # a system without such locks
            if not _lock(handle):
                waiting()
                _wait_for_lock(handle, path, LOCK_WAIT_S if wait_s is None else wait_s)
        with contextlib.suppress(OSError):  # a full disk: the lock holds without the note
            os.ftruncate(handle, 0)
            os.write(handle, f"{os.getpid()} {socket.gethostname()}\n".encode())
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                os.ftruncate(handle, 0)
    finally:
        os.close(handle)


def _wait_for_lock(handle: int, path: Path, wait_s: float) -> None:
    until = time.monotonic() + wait_s
    while not _lock(handle):
        if time.monotonic() >= until:
            raise InputError(
                Message(
                    "lock-held",
                    "is kept by {handle}, also after {wait_s:g} s; nothing was changed here: let that "
                    "process go on, or end it, then try again",
                    handle=_holder(os.pread(handle, 300, 0)),
                    wait_s=wait_s,
                ),
                file=path.parent,
            ) from BlockingIOError(errno.EAGAIN, "locked by another process")
        time.sleep(LOCK_POLL_S)


def _holder(noted: bytes) -> str:
    """Return the process that a lock file names, in words: its number, its command, and whether it is stopped."""
    found = re.fullmatch(r"([0-9]{1,10}) (\S+)\n", noted.decode("utf-8", "replace"))
    if found is None:
        return "another process"
    if found[2] != socket.gethostname():
        return f"process {found[1]} of the computer {found[2]}"
    folder = Path("/proc") / found[1]
    try:
        words = (folder / "cmdline").read_bytes().decode("utf-8", "replace").split("\0")
        state = (folder / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[0]
    except (OSError, IndexError):  # it has ended, or the system does not show it
        return f"process {found[1]}"
    called = "".join(char if char.isprintable() else "?" for char in " ".join(words).strip()[:80])
    return f"process {found[1]} ({called}{', which is stopped' if state in 'Tt' else ''})"


def _remove_folder(folder: Path) -> None:
    """Remove a working folder, its lock last: what a process killed here leaves is still recognised as abandoned."""
    with contextlib.suppress(OSError):
        for entry in list(os.scandir(folder)):
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            elif entry.name != LOCK:
                os.unlink(entry.path)
        (folder / LOCK).unlink(missing_ok=True)
        folder.rmdir()


def remove_abandoned_folders(parent: Path | None = None) -> None:
    """Remove this user's temporary folders whose processes were killed, from ``parent`` or the usual place."""
    with contextlib.suppress(OSError):
        for entry in list(os.scandir(parent or tempfile.gettempdir())):
            if not entry.name.startswith(FOLDERS):
                continue
            with contextlib.suppress(OSError):
                found = entry.stat(follow_symlinks=False)
                mine = not hasattr(os, "geteuid") or found.st_uid == os.geteuid()
                if mine and entry.is_dir(follow_symlinks=False):
                    if _abandoned(Path(entry.path) / LOCK) or _long_left(entry.path, found):
                        _remove_folder(Path(entry.path))
                    elif time.time() - found.st_mtime > EMPTY_S:
                        os.rmdir(entry.path)  # refused unless it is empty: killed before or after there was a lock


def _long_left(folder: str, found: os.stat_result) -> bool:
    """Whether a folder made by this program has no lock, and neither it nor anything in it has changed for long."""
    made_here = OLD_NAME.fullmatch(os.path.basename(folder)) and stat.S_IMODE(found.st_mode) == OWN_MODE
    if not made_here or os.path.lexists(os.path.join(folder, LOCK)):
        return False
    paths = (os.path.join(top, name) for top, folders, files in os.walk(folder) for name in ("", *folders, *files))
    return all(time.time() - os.lstat(path).st_mtime > OLD_S for path in paths)


def write_file(path: str | Path, content: str | bytes, *, private: bool = False) -> Path:
    """Write one file atomically and return its path; only this user may read one that is ``private``."""
    target = Path(path)
    folder = OutputFolder(target.parent, private=private)
    folder.add(target.name, content)
    return folder.commit()[target.name]


def read_bytes(path: str | Path, most: int = -1) -> bytes:
    """Return the contents of ``path``, at most ``most`` bytes of it, or raise an InputError that says why not."""
    source = path_of("path", path)
    try:
        if source.is_dir():
            raise InputError(Message("file-is-folder", "is a folder; expected a file"), file=source)
        with source.open("rb") as stream:
            if most < 0:
                return stream.read()
            parts, left = [], most  # in pieces: Python reserves all of what is asked for at once
            while left > 0 and (part := stream.read(min(left, _PIECE))):
                parts.append(part)
                left -= len(part)
            return b"".join(parts)
    except FileNotFoundError as error:
        raise InputError(Message("file-missing", "no such file"), file=source) from error
    except OSError as error:
        raise InputError(
            Message("file-unreadable", "cannot be read: {strerror}", strerror=error.strerror or error), file=source
        ) from error


def read_text(path: str | Path, most: int = MOST_TEXT) -> str:
    """Return the UTF-8 text of ``path`` (a byte-order mark is dropped) or raise an InputError that says why not.

    A file of more than ``most`` bytes, or with a line longer than :data:`LONGEST_LINE`, is refused.
    """
    path = path_of("path", path)
    too_large = os.path.isfile(path) and os.path.getsize(path) > most
    content = b"" if too_large else read_bytes(path, most + 1)
    if too_large or len(content) > most:
        size = f"has {os.path.getsize(path) / 1e6:.0f} MB" if too_large else "is too large"
        raise InputError(
            Message(
                "file-too-large",
                "{size}; at most {most:g} MB are read of such a file: is it the right one?",
                size=size,
                most=most / 1000000.0,
            ),
            file=path,
        )
    text = decoded(content, path)
    check_lines(text, path)
    return text


def check_lines(text: str, path: str | Path) -> None:
    """Raise InputError for a line longer than :data:`LONGEST_LINE`; the cost is that of a search, not of a split."""
    start = 0
    while len(text) - start > LONGEST_LINE:
        window = start + LONGEST_LINE + 1
        end = max(text.rfind("\n", start, window), text.rfind("\r", start, window))
        if end < 0:
            line = 1 + text.count("\n", 0, start)
            message = f"has a line of more than {LONGEST_LINE} characters; is it a text file, with line ends?"
            raise InputError(message, file=path, line=line)
        start = end + 1


def decoded(content: bytes, path: str | Path, encoding: str = "utf-8-sig", before: int = 0) -> str:
    """Return the UTF-8 text of the contents of ``path``, or of a part after ``before`` lines, like :func:`read_text`."""
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        line = before + content[: error.start].count(b"\n") + 1
        raise InputError(
            Message("file-not-utf8", "is not UTF-8 text; save it as UTF-8"), file=path, line=line
        ) from error
