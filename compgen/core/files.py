"""Output files: written to a temporary name and renamed, all of a step or none."""

from __future__ import annotations

import contextlib
import filecmp
import hashlib
import itertools
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from compgen.errors import InputError

TEMPORARY = ".tmp"


def sha256_of(content: bytes) -> str:
    """Return the SHA-256 of ``content`` as hexadecimal text."""
    return hashlib.sha256(content).hexdigest()


def _check_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError("is a file; --out needs a folder", file=folder)
    if folder.is_dir() and (not folder.stat().st_mode & 0o222 or not os.access(folder, os.W_OK | os.X_OK)):
        raise InputError("the output folder is read-only; choose another --out or make it writable", file=folder)


class OutputFolder:
    """A folder that receives a set of files together.

    ``add`` keeps the contents in memory; ``commit`` writes every one to a temporary name beside its target and
    only then renames them, so that an error leaves neither half a file nor half a set of new ones. ``set_aside`` names a
    file of the folder that ``commit`` renames to ``PREVIOUS-...`` before the new ones take their names: a process that is
    killed in between leaves no old file that looks like one of the new set.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._contents: dict[str, bytes] = {}
        self._aside: list[str] = []
        try:
            existing = self.folder
            while not existing.exists() and existing != existing.parent:
                existing = existing.parent
            _check_folder(existing)
        except OSError as error:
            raise InputError(f"cannot be used: {error.strerror or error}", file=self.folder) from error

    @property
    def contents(self) -> Mapping[str, bytes]:
        """What has been added, by name."""
        return self._contents

    def add(self, name: str, content: str | bytes) -> None:
        """Remember ``content`` (text is encoded as UTF-8, line ends kept) for the file ``name``."""
        self._contents[name] = content.encode("utf-8") if isinstance(content, str) else content

    def set_aside(self, name: str) -> Path:
        """Keep the existing file ``name`` under the name that is returned, one that loses no other file."""
        self._aside.append(name)
        return _previous(self.folder / name)

    def commit(self) -> dict[str, Path]:
        """Write everything and return the path of each file by name."""
        paths = {name: self.folder / name for name in self._contents}
        aside = [(self.folder / name, _previous(self.folder / name)) for name in dict.fromkeys(self._aside)]
        temporary: dict[str, Path] = {}
        made = _missing_folders(paths.values())
        try:
            for path in paths.values():
                path.parent.mkdir(parents=True, exist_ok=True)
                if path.is_dir():
                    raise IsADirectoryError(21, f"{path.name} is a folder")
            for name, content in self._contents.items():
                temporary[name] = _write_temporary(paths[name], content)
            _replace_all([*aside, *((temporary[name], paths[name]) for name in paths)])
        except OSError as error:
            _remove([*temporary.values()], made)
            raise InputError(
                f"cannot write: {error.strerror or error}; nothing was written", file=self.folder
            ) from error
        except BaseException:
            _remove([*temporary.values()], made)
            raise
        return paths


def _previous(path: Path) -> Path:
    """A name with ``PREVIOUS-`` that is free, or that a file with the same contents has."""
    for count in itertools.count(1):
        free = path.with_name(f"PREVIOUS-{'' if count == 1 else f'{count}-'}{path.name}")
        if not free.exists() or (free.is_file() and path.is_file() and filecmp.cmp(free, path, shallow=False)):
            return free
    raise AssertionError("itertools.count never ends")


def _missing_folders(targets: Iterable[Path]) -> list[Path]:
    """Folders that have to be made for the targets, the innermost first."""
    missing = {folder for target in targets for folder in target.parents if not folder.exists()}
    return sorted(missing, key=lambda folder: len(folder.parts), reverse=True)


def _remove(files: Iterable[Path], folders: Iterable[Path]) -> None:
    """Remove temporary files, then the folders made for them as far as they are empty."""
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
                if not source.name.endswith(TEMPORARY):  # a file that was set aside: no byte of it is written again
                    os.replace(target, source)
                elif before is None:
                    target.unlink()
                else:
                    os.replace(_write_temporary(target, before), target)
        raise


def _write_temporary(target: Path, content: bytes) -> Path:
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=TEMPORARY, dir=target.parent)
    path = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        path.chmod(0o666 & ~_umask())
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return path


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current


def write_file(path: str | Path, content: str | bytes) -> Path:
    """Write one file atomically and return its path."""
    target = Path(path)
    folder = OutputFolder(target.parent)
    folder.add(target.name, content)
    return folder.commit()[target.name]


def read_bytes(path: str | Path, most: int = -1) -> bytes:
    """Return the contents of ``path``, at most ``most`` bytes of it, or raise an InputError that says why not."""
    source = Path(path)
    try:
        if source.is_dir():
            raise InputError("is a folder; a file is needed", file=source)
        with source.open("rb") as stream:
            return stream.read(most)
    except FileNotFoundError as error:
        raise InputError("no such file", file=source) from error
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=source) from error


def read_text(path: str | Path) -> str:
    """Return the UTF-8 text of ``path`` (a byte-order mark is dropped) or raise an InputError that says why not."""
    content = read_bytes(path)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError("is not UTF-8 text; save it as UTF-8", file=path, line=line) from error
