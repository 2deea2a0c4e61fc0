"""A folder of NC programs that is watched: what a post processor writes into it is corrected, into a folder of its own."""

from __future__ import annotations

import json
import os
import shutil
import stat
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from compgen.data.files import REJECTED_PREFIX, OutputFolder, json_text, sha256_of, sha256_of_file, working_folder
from compgen.errors import CompgenError, CompgenWarning, InputError, visible
from compgen.programs.correct import CORRECTION_FILE, PREFLIGHT_FILE, ProgramCorrection

#: File that says why a program was refused; it takes the place of the corrected program.
REFUSED_FILE = "REFUSED.txt"
#: What a later watch needs to know that nothing has changed since.
NOTED_FILE = ".watched.json"
#: Ends of names under which programs write what is not complete, and what editors keep beside a file.
UNFINISHED = (".tmp", ".part", ".partial", ".crdownload", ".download", ".swp", ".bak", "~")

#: Corrects one program (the path of a copy under its own name) into a folder.
Correct = Callable[[Path, Path], ProgramCorrection]
#: What changes when a file is written, replaced or renamed: its inode, size, and both times.
Stamp = tuple[int, int, int, int]


@dataclass(frozen=True)
class WatchedProgram:
    """What became of a program in the folder, and why: ``accepted``, ``not accepted``, ``refused`` or ``deleted``.

    ``folder`` is the state of a folder that is passed over. ``before``: an earlier watch has found this, and nothing has changed.
    """

    name: str
    state: str
    reasons: tuple[str, ...] = ()
    file: Path | None = None
    result: ProgramCorrection | None = None
    warnings: tuple[str, ...] = ()
    before: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Return the object of ``--json``."""
        figures: dict[str, Any] = {} if self.result is None else self.result.as_dict()
        more: dict[str, Any] = {key: figures[key] for key in ("before", "after", "assumed", "notes") if key in figures}
        said: dict[str, Any] = {"state": self.state, "reasons": list(self.reasons), "warnings": list(self.warnings)}
        said["unchanged"] = self.before
        return {"program": self.name, **said, "file": None if self.file is None else str(self.file), **more}


@dataclass
class FolderWatch:
    """Corrects each program of a folder once it no longer changes, and again when it or ``conditions`` have changed.

    Its files are only read. The program ``part.nc`` gets the folder ``out/part.nc``, whose earlier files are replaced
    together, so that no corrected program of an earlier version stays beside the refusal of the present one. A file there
    notes what was corrected, so that a watch that is started again does not do it again.

    Parameters
    ----------
    folder, out : the watched folder, and where the folders of the corrected programs are made; never read as programs.
    correct : corrects one program.
    match : patterns of names, one of which a program has to fit.
    settle_s : a program is taken after it has not changed for this long; 0: as it is found.
    conditions : all that decides a correction beside the program (errors, machine, options), as a text.
    subfolders : programs in folders within ``folder`` are corrected, too; other folders are passed over, which is said.
    """

    folder: Path
    out: Path
    correct: Correct
    match: Sequence[str] = ("*",)
    settle_s: float = 2.0
    conditions: Callable[[], str] = lambda: ""
    subfolders: bool = False
    _seen: dict[str, tuple[Stamp | str, float]] = field(default_factory=dict)
    _done: dict[str, tuple[Stamp, str]] = field(default_factory=dict)
    _passed: list[str] = field(default_factory=list)
    _said: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise InputError("is no folder; --watch needs one that exists", file=self.folder)
        if self.folder.resolve().is_relative_to(self.out.resolve()):
            raise InputError(
                f"the watched folder {visible(str(self.folder), flat=True)} is in it, and would receive what is written; "
                "choose another folder, e.g. one within the watched one",
                file=self.out,
                field="--out",
            )
        OutputFolder(self.out)  # one that nobody may write to is refused before anything is corrected
        self._stamps()

    def look(self, now_s: float) -> Iterator[WatchedProgram]:
        """Correct what is complete at the time ``now_s`` of any clock; InputError if the folder cannot be read."""
        stamps, conditions = self._stamps(), self.conditions()
        for name in sorted(self._done.keys() - stamps.keys()):
            del self._done[name]
            yield WatchedProgram(name, "deleted")
        self._seen = {name: seen for name, seen in self._seen.items() if name in stamps or not name}
        why = (
            "a link to a folder is not followed"
            if self.subfolders
            else "folders are not looked into; --subfolders does"
        )
        for name in sorted(set(self._passed) - self._said):
            yield WatchedProgram(name, "folder", (why,))
        self._said = set(self._passed)
        resting = [name for name, stamp in stamps.items() if self._rests(name, stamp, now_s)]
        if not self._rests("", conditions, now_s):  # the errors are being written
            return
        for name in resting:
            stamp = stamps[name]
            if self._done.get(name) == (stamp, conditions):
                continue
            conditions = self.conditions()
            found = self._as_noted(name, stamp, conditions) or self._corrected(name, stamp, conditions)
            if found is not None:
                self._done[name] = (stamp, conditions)
                yield found
            elif not self.settle_s:
                yield WatchedProgram(name, "refused", ("it changed or was removed while it was read; try again",))

    def _rests(self, name: str, found: Stamp | str, now_s: float) -> bool:
        """Whether what was found under this name has not changed for long enough."""
        if name not in self._seen or self._seen[name][0] != found:
            self._seen[name] = (found, now_s)
        return now_s - self._seen[name][1] >= self.settle_s

    def _stamps(self) -> dict[str, Stamp]:
        """Return the stamp of every program by its path within the folder, in order; notes the folders that are passed over."""
        found, self._passed = {}, []
        folders = [self.folder]
        while folders:
            folder = folders.pop(0)
            try:
                entries = sorted(folder.iterdir())
            except OSError as error:
                if folder != self.folder:  # it was removed just now
                    continue
                raise InputError(f"cannot be read: {error.strerror or error}", file=self.folder) from error
            for path in entries:
                name = path.relative_to(self.folder).as_posix()
                if path.name.startswith(".") or path.name.lower().endswith(UNFINISHED):
                    continue
                if path.is_dir():
                    if path.resolve() == self.out.resolve():
                        continue
                    if self.subfolders and not path.is_symlink():  # a link may lead back
                        folders.append(path)
                    else:
                        self._passed.append(name)
                elif any(fnmatchcase(path.name, pattern) for pattern in self.match):
                    stamp = _stamp(path)
                    if stamp is not None:
                        found[name] = stamp
        return found

    def _as_noted(self, name: str, stamp: Stamp, conditions: str) -> WatchedProgram | None:
        """Return what an earlier watch has found, if program, conditions and result are still the same."""
        place = self.out / name
        try:
            noted = json.loads((place / NOTED_FILE).read_text(encoding="utf-8"))
            known = noted["program_sha256"], noted["conditions"], noted["file_sha256"]
            file = place / noted["file"]
            same = file.parent == place and known == (
                sha256_of_file(self.folder / name),
                conditions,
                sha256_of_file(file),
            )
            item = WatchedProgram(name, noted["state"], tuple(noted["reasons"]), file, before=True)
        except (OSError, ValueError, TypeError, KeyError, InputError):  # none, or not written by a watch
            return None
        return item if same and _stamp(self.folder / name) == stamp else None

    def _corrected(self, name: str, stamp: Stamp, conditions: str) -> WatchedProgram | None:
        """Correct a copy of the program; None if it is not the one that was found, since someone writes to it."""
        path = self.folder / name
        if path.resolve().is_relative_to(self.out.resolve()):
            return WatchedProgram(name, "refused", ("it is a link to a file that this command writes",))
        with working_folder("watch-") as work, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", CompgenWarning)
            copy, made = work / path.name, work / "made.folder"
            made.mkdir()
            try:
                shutil.copyfile(path, copy)
            except OSError as error:
                if _stamp(path) != stamp:
                    return None
                return self._refused(name, f"cannot be read: {error.strerror or error}", {})
            if _stamp(path) != stamp:
                return None
            noted = {"program_sha256": sha256_of_file(copy), "conditions": conditions}
            try:
                result = self.correct(copy, made)
            except Exception as error:  # no program ends the watch
                expected = isinstance(error, CompgenError)
                reason = str(error) if expected else f"internal error: {type(error).__name__}: {error}"
                reason = reason.replace(visible(str(copy), flat=True), visible(name, flat=True))
                return self._refused(name, reason, noted if expected else {})
            return self._accepted(name, result, made, noted, tuple(dict.fromkeys(str(item.message) for item in caught)))

    def _accepted(
        self, name: str, result: ProgramCorrection, made: Path, noted: dict[str, str], said: tuple[str, ...]
    ) -> WatchedProgram:
        item = WatchedProgram(
            name, "accepted" if result.accepted else "not accepted", result.reasons, None, result, said
        )
        return self._published(item, {path.name: path for path in made.iterdir()}, result.file, noted)

    def _refused(self, name: str, reason: str, noted: dict[str, str]) -> WatchedProgram:
        text = f"{visible(name, flat=True)} was not corrected.\n\n{reason}\n"
        return self._published(WatchedProgram(name, "refused", (reason,)), {REFUSED_FILE: text}, REFUSED_FILE, noted)

    def _published(
        self, item: WatchedProgram, files: dict[str, Path | str], file: str, noted: dict[str, str]
    ) -> WatchedProgram:
        """Put the files into the folder of the program, in place of those of its earlier version."""
        try:
            folder = OutputFolder(self.out / item.name)
            for key, content in files.items():
                if isinstance(content, Path):
                    folder.add_file(key, content)
                else:
                    folder.add(key, content)
            name = Path(item.name).name
            own = {name, f"{REJECTED_PREFIX}{name}", CORRECTION_FILE, PREFLIGHT_FILE, REFUSED_FILE, NOTED_FILE}
            self._remove(own - files.keys(), folder.folder)
            if noted:  # what is no fault of the program is tried again by the next watch
                content = files[file]
                digest = sha256_of_file(content) if isinstance(content, Path) else sha256_of(content.encode())
                found = {
                    **noted,
                    "state": item.state,
                    "reasons": list(item.reasons),
                    "file": file,
                    "file_sha256": digest,
                }
                folder.add(NOTED_FILE, json_text(found))
            return replace(item, file=folder.commit()[file])
        except InputError as error:
            return WatchedProgram(item.name, "refused", (*item.reasons, str(error)))

    @staticmethod
    def _remove(names: set[str], folder: Path) -> None:
        for name in names:
            try:
                (folder / name).unlink(missing_ok=True)
            except OSError as error:
                what = f"an earlier result cannot be removed: {error.strerror or error}; nothing was written"
                raise InputError(what, file=folder / name) from error


def _stamp(path: Path) -> Stamp | None:
    """Return the stamp of a file; None if it is none (any more): a folder, pipe or device."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    known = (found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)
    return known if stat.S_ISREG(found.st_mode) else None
