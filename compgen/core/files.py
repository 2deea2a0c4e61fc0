"""Output files: written to a temporary name and renamed, all of a step or none."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path

from compgen.errors import InputError


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
    only then renames them, so that an error leaves neither half a file nor half a set of new ones.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._contents: dict[str, bytes] = {}
        existing = self.folder
        while not existing.exists() and existing != existing.parent:
            existing = existing.parent
        _check_folder(existing)

    def add(self, name: str, content: str | bytes) -> None:
        """Remember ``content`` (text is encoded as UTF-8, line ends kept) for the file ``name``."""
        self._contents[name] = content.encode("utf-8") if isinstance(content, str) else content

    def commit(self) -> dict[str, Path]:
        """Write everything and return the path of each file by name."""
        temporary: dict[str, Path] = {}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for name, content in self._contents.items():
                temporary[name] = _write_temporary(self.folder / name, content)
            paths = {name: self.folder / name for name in self._contents}
            for name, path in temporary.items():
                os.replace(path, paths[name])
        except OSError as error:
            raise InputError(
                f"cannot write: {error.strerror or error}; nothing was written", file=self.folder
            ) from error
        finally:
            for path in temporary.values():
                with contextlib.suppress(OSError):
                    path.unlink(missing_ok=True)
        return paths


def _write_temporary(target: Path, content: bytes) -> Path:
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent)
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


def read_bytes(path: str | Path) -> bytes:
    """Return the contents of ``path`` or raise an InputError that says why not."""
    source = Path(path)
    if source.is_dir():
        raise InputError("is a folder; a file is needed", file=source)
    try:
        return source.read_bytes()
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
