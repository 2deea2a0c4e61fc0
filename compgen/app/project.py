"""A project: a folder with the files of the contract, the list of its steps, and the command that runs.

Every step is a command of ``volcomp``, run as a process of its own on the files of the project, so what the pages show can
be repeated from a shell. ``project.json`` lists the steps with a revision that grows with every change: who changes the
project states the revision that was seen, and is refused if it is not the present one. A step has the folder
``NN-kind``; undoing the last one moves it to ``undone/``.

A project may come from somebody else, so its folder is data: no command looks there for modules, settings or plug-ins, because
it runs in a folder of its own with links to the steps that it names, and what is listed or linked there cannot name files
elsewhere.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
import tomllib
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import IO, Any

from compgen.app.steps import FORM, Command, Step, command_line, read_steps
from compgen.data.files import exclusive, json_text, read_bytes, read_text, working_folder, write_file
from compgen.data.toml_files import WITHIN
from compgen.errors import InputError, visible_line
from compgen.resources import LANGUAGES

PROJECT, UNDONE, LOCK = "project.json", "undone", ".project.lock"
#: The job file of the hand-over to ``recal``, and what ``recal`` itself writes beside it.
JOB, OF_RECAL = "recal.toml", ("inbox", "recalibration", "recal.sqlite")
#: Longest list of steps, and longest file with the facts of a step, bytes.
LARGEST_PROJECT, LARGEST_FACTS = 20_000_000, 100_000_000
#: How long a change of the list of steps waits for that of another process, s.
LOCK_S = 10.0
#: Only the user who began a project may see what is in it.
PRIVATE_FOLDER, PRIVATE_FILE, PRIVATE_MASK = 0o700, 0o600, 0o077
#: A stopped command is ended by force after this time, s.
STOP_S = 5.0
#: Lines of a command's messages that are kept.
MOST_LINES = 500
#: Sub-folder of a step for the files that a user gave it, and steps whose command writes pages.
GIVEN, WITH_PAGES = "given", ("plan", "identify", "diagnose", "run", "part", "compare", "accuracy")
#: Steps that a result depends on.
INPUTS = ("machine", "instrument", "numbers", "removed", "measurement")
#: Steps that take the errors that were identified before them.
OF_ERRORS = ("part", "correct")
MAIN_PAGES = ("report.html", "index.html", "sheet.html", "part.html", "plan.html")
#: Messages of a command that refuse, and those that are kept with a step, in the languages of the program.
REFUSED, TOLD = re.compile("(?:error|Fehler|Abweichung): (.*)"), re.compile("(?:warning|question|Warnung|offen): (.*)")
#: Names that are devices in Windows, also with anything behind a dot.
DEVICES = r"(?i)con|prn|aux|nul|conin\$|conout\$|clock\$|com[\d\u00b9\u00b2\u00b3]|lpt[\d\u00b9\u00b2\u00b3]"
#: Exit codes of a command that has written its result: accepted or not.
DONE = (0, 1)


class StaleError(InputError):
    """The project was changed by another window after the page had been made."""


@dataclass(frozen=True)
class Measurement:
    """A measurement file of the project: ``step`` that shows it, files that commands take, and open questions."""

    number: int
    name: str
    file: str
    used: Sequence[str]
    step: Step
    after: bool

    @property
    def questions(self) -> Sequence[str]:
        """What the file leaves open."""
        found: Sequence[str] = self.step.data["summary"]["doubts"]
        return found


@dataclass(frozen=True)
class ProjectState:
    """All steps of a project, and what follows from them."""

    revision: int
    steps: tuple[Step, ...]

    def last(self, kind: str) -> Step | None:
        """Return the latest step of a kind, None without one."""
        return next((step for step in reversed(self.steps) if step.kind == kind), None)

    @property
    def machine(self) -> str | None:
        """Name or file of the machine as commands take it."""
        step = self.last("machine")
        return None if step is None else str(step.data["machine"])

    @property
    def numbers(self) -> Mapping[str, Sequence[str]]:
        """Numbers known without a file, by option."""
        step = self.last("numbers")
        return {} if step is None else step.data["numbers"]

    @property
    def instrument(self) -> str | None:
        """File with the constants of a six-DOF instrument, for measurements of that kind."""
        step = self.last("instrument")
        kinds = [item.step.data["summary"]["kind"] for item in self.measurements]
        return str(step.data["file"]) if step is not None and "sixdof" in kinds else None

    @property
    def measurements(self) -> list[Measurement]:
        """Measurement files that were not removed, each as its latest step has it."""
        found: dict[int, Measurement] = {}
        for step in self.steps:
            if step.kind == "measurement" and step.data:
                number = int(step.data.get("answers_to", step.number))
                known = found.get(number)
                name = known.name if known else step.title
                file, after = str(step.data["file"]), bool(step.data.get("after"))
                found[number] = Measurement(number, name, file, tuple(step.data["used"]), step, after)
            elif step.kind == "removed":
                found.pop(int(step.data["measurement"]), None)
        return list(found.values())

    def used_files(self, *, after: bool = False) -> list[str]:
        """Files that a calculation takes, of before or after the correction."""
        return [file for item in self.measurements if item.after == after for file in item.used]

    def current(self, kind: str) -> Step | None:
        """Return the latest step of a kind if nothing that it depends on has changed since, otherwise None."""
        step = self.last(kind)
        return step if step is not None and self.is_current(step) else None

    def is_current(self, step: Step) -> bool:
        """Whether nothing that a step depends on has changed since; what is made of errors depends on them, too."""
        inputs = (*INPUTS, "identify") if step.kind in OF_ERRORS else ("machine",) if step.kind == "plan" else INPUTS
        return not any(
            other.number > step.number and other.kind in inputs
            and (step.kind == "compare" or not other.data.get("after")) for other in self.steps
        )  # fmt: skip


def not_written(error: OSError) -> InputError:
    """Return what a folder that cannot be written to means for the user."""
    reason = error.strerror or str(error)
    return InputError(
        f"the folder of the project cannot be written to: {reason}; nothing was changed", file=error.filename
    )


def file_name(given: str) -> str:
    r"""Return a safe name for an uploaded file: one part, letters, digits, dot, underscore and hyphen.

    >>> file_name("../../etc/pass wd"), file_name(".rtl"), file_name("C:\\x\\Z Achse.rtl")
    ('pass_wd', 'rtl', 'Z_Achse.rtl')
    """
    last = re.split(r"[/\\]", unicodedata.normalize("NFC", given))[-1]
    name = re.sub(r"[^\w.-]", "_", last).lstrip(".-")
    stem, dot, suffix = name.partition(".")
    if re.fullmatch(DEVICES, stem):
        stem = f"_{stem}"
    while len((stem + dot + suffix).encode()) > 120 and len(stem) + len(suffix) > 2:
        stem, suffix = (stem[:-1], suffix) if len(stem) >= len(suffix) else (stem, suffix[1:])
    return stem + dot + suffix or "file"


class Project:
    """The folder of a project; several processes may have it open."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.RLock()

    @classmethod
    def open(cls, folder: str | Path) -> Project:
        """Open a project, or make one in a folder that is empty or does not exist.

        Raises
        ------
        InputError
            for a folder with other files, or one that cannot be written to.
        """
        path = Path(folder).expanduser()
        try:
            path = path.resolve()
            path.mkdir(PRIVATE_FOLDER, parents=True, exist_ok=True)
            listed = [item.name for item in path.iterdir() if item.name != LOCK]
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"cannot be used as the folder of a project: {reason}", file=path) from error
        project = cls(path)
        if PROJECT in listed:
            project.state()
        elif listed:
            raise InputError(
                f"has {len(listed)} other files; choose an empty folder, a new name, or a folder with {PROJECT}",
                file=path,
            )
        else:
            with contextlib.suppress(OSError):  # an empty folder of a group, or of a system without such rights
                path.chmod(PRIVATE_FOLDER)
            project._write(ProjectState(0, ()))
        return project

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.name

    def state(self) -> ProjectState:
        """Read the steps; InputError for a file that is damaged, of another form, or not what the pages write."""
        path = self.folder / PROJECT
        if path.is_symlink() or not path.is_file():
            raise InputError("is not a file with the steps of a project", file=path)
        return ProjectState(*read_steps(read_bytes(path, LARGEST_PROJECT), path))

    def _write(self, state: ProjectState) -> None:
        path = self.folder / PROJECT
        content = {"form": FORM, "revision": state.revision, "steps": [asdict(step) for step in state.steps]}
        text = json_text(content)
        read_steps(text.encode(), path)  # what could not be read again is not written
        write_file(path, text, private=True)

    @contextlib.contextmanager
    def _alone(self) -> Iterator[ProjectState]:
        """Keep other threads and processes out while the list of steps changes."""
        with self._lock, exclusive(self.folder / LOCK, LOCK_S, PRIVATE_FILE):
            yield self.state()

    def check(self, revision: int) -> ProjectState:
        """Return the steps; StaleError if ``revision`` is not the present one."""
        state = self.state()
        if state.revision != revision:
            raise StaleError("the project was changed in another window; reload this page, then do it again")
        return state

    def new_folder(self, kind: str) -> str:
        """Make the folder of the next step and return its name."""
        with self._alone() as state:
            number = self._next(state)
            name = f"{number:02d}-{kind}"
            (self.folder / name).mkdir(PRIVATE_FOLDER)
            return name

    def _next(self, state: ProjectState) -> int:
        """Return a number that no step has, and no folder of one that runs."""
        taken = [int(found[1]) for item in self.folder.iterdir() if (found := re.match(r"(\d+)-", item.name))]
        return max([0, *taken, *(step.number for step in state.steps)]) + 1

    def add(self, step: Step, revision: int | None = None) -> ProjectState:
        """Append a step: its number is that of its folder, or the next one."""
        with self._alone() as state:
            if revision is not None and revision != state.revision:
                raise StaleError("the project was changed in another window; reload this page, then do it again")
            number = int(step.folder.partition("-")[0]) if step.folder else self._next(state)
            now = datetime.now(UTC).isoformat(timespec="seconds")
            step = replace(step, number=number, time=now)
            state = ProjectState(state.revision + 1, tuple(sorted((*state.steps, step), key=lambda item: item.number)))
            self._write(state)
            return state

    def undo(self, revision: int) -> tuple[Step, list[str]]:
        """Remove the last step from the list and move its folder to ``undone/``; return it, and in words what of it stays.

        Of a hand-over to ``recal`` the entry in the job file is removed; the file itself with its last entry.
        """
        with self._alone() as state:
            if revision != state.revision:
                raise StaleError("the project was changed in another window; reload this page, then do it again")
            if not state.steps:
                raise InputError("there is no step to undo")
            step = state.steps[-1]
            self._write(ProjectState(state.revision + 1, state.steps[:-1]))
            if step.folder:
                self.set_aside(step.folder)
            return step, self._take_back_job(step) if step.kind == "recal" else []

    def _take_back_job(self, step: Step) -> list[str]:
        """Remove the entry of a hand-over from the job file; return in words what stays."""
        path, added, name = self.path(JOB), str(step.data.get("added", "")), step.data.get("machine_there", "")
        stays = []
        if path.is_file():
            text = read_text(path)
            if not added or text.count(added) != 1:
                stays.append(f"{JOB} was edited after the hand-over: its entry of {name} stays; delete it there")
            elif rest := text.replace(added, "").strip("\n"):
                write_file(path, f"{rest}\n")
            else:
                self.set_aside(JOB)
        written = [item for item in OF_RECAL if (self.folder / item).exists()]
        if written:
            stays.append(f"{', '.join(written)} in the folder of the project stay: measurements and tables of recal")
        return stays

    def set_aside(self, name: str) -> None:
        """Move a file, or the folder of a step, to ``undone/``, under a name that is free; an empty folder is removed."""
        folder, count = self.folder / name, 1
        if not folder.exists():
            return
        with contextlib.suppress(OSError):
            folder.rmdir()
            return
        undone = self.folder / UNDONE
        undone.mkdir(PRIVATE_FOLDER, exist_ok=True)
        if undone.is_symlink():
            raise InputError("is a link; nothing is moved through it, so remove it", file=undone)
        while (target := self.folder / UNDONE / (name if count == 1 else f"{name}-{count}")).exists():
            count += 1
        folder.rename(target)

    def path(self, name: str) -> Path:
        """Return a path within the project; InputError for one that leads out of it."""
        path = (self.folder / name).resolve()
        if not path.is_relative_to(self.folder):
            raise InputError("is not in the folder of the project", file=name)
        return path

    def job_text(self) -> str:
        """Return the text of the job file, "" without one; InputError if it names commands, templates or other places.

        Whoever runs ``volcomp recal`` with it trusts it; nothing is added to one that came with a project and does more.
        """
        if not os.path.lexists(self.folder / JOB):
            return ""
        path = self.given(JOB)
        text = read_text(path)
        try:
            found = tomllib.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"is not valid TOML: {error}", file=path) from error
        if strange := _beyond(found):
            raise InputError(
                f"has {strange}, which this workbench does not write: read the file, and if it is yours, add the machine with "
                "`volcomp recal add`; otherwise move the file away",
                file=path,
            )
        return text

    def given(self, name: str) -> Path:
        """Return the path of a file in the project that is to be read; InputError for a pipe, a device or no file."""
        path = self.path(name)
        if not path.is_file():
            raise InputError("no such file in the folder of the project", file=name)
        return path

    def keep(self, stream: IO[bytes], name: str) -> None:
        """Write what a user gave into a new file of the project; only this user may read it."""
        path = self.path(name)
        for folder in reversed(path.relative_to(self.folder).parents[:-1]):
            (self.folder / folder).mkdir(PRIVATE_FOLDER, exist_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), PRIVATE_FILE)
        with os.fdopen(handle, "wb") as target:
            stream.seek(0)  # several steps may take the same file
            shutil.copyfileobj(stream, target)

    def link(self, command: Command, place: Path) -> Path:
        """Return the folder in which a command runs: ``place``, with links to the folders of the steps that it names.

        Raises
        ------
        InputError
            if anything in them leads out of the project, or is neither file nor folder.
        """
        for first in sorted({name.partition("/")[0] for name in command.paths}):
            source = self.folder / first
            if not os.path.lexists(source):
                continue
            self._check_contents(source)
            try:
                (place / first).symlink_to(source, target_is_directory=source.is_dir())
            except OSError:  # a system where an ordinary user makes no links
                return self.folder
        return place

    def _check_contents(self, source: Path) -> None:
        inner = (Path(top) / name for top, folders, files in os.walk(source) for name in (*folders, *files))
        for path in (source, *inner):
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode) and not path.resolve().is_relative_to(self.folder):
                raise InputError("is a link that leads out of the folder of the project; remove it", file=path)
            if not (stat.S_ISLNK(mode) or stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise InputError("is neither a file nor a folder; remove it", file=path)

    def files_of(self, step: Step) -> dict[str, Path]:
        """Return the files of a step by their path within its folder; links that lead out of it are left out."""
        root = self.path(step.folder) if step.folder else None
        if root is None or not root.is_dir():
            return {}
        return {
            path.relative_to(root).as_posix(): path
            for path in sorted(root.rglob("*"))
            if path.is_file() and not path.name.startswith(".") and path.resolve().is_relative_to(root)
        }

    def pages_of(self, step: Step | None) -> dict[str, Path]:
        """Return the pages that the command of a step wrote, the main one first; never a file that a user gave."""
        if step is None or step.kind not in WITH_PAGES:
            return {}
        found = self.files_of(step)
        names = [name for name in found if name.endswith(".html") and not name.startswith(f"{GIVEN}/")]
        return {name: found[name] for name in sorted(names, key=lambda name: (name not in MAIN_PAGES, name))}

    def facts(self, step: Step | None, name: str) -> dict[str, Any]:
        """Return the JSON object in a file of a step, {} if there is none."""
        path = None if step is None else self.files_of(step).get(name)
        if path is None:
            return {}
        with contextlib.suppress(ValueError, RecursionError):
            found = json.loads(read_bytes(path, LARGEST_FACTS))
            return found if isinstance(found, dict) else {}
        return {}

    def script(self) -> str:
        """Return what was done as a script for a shell."""
        lines = ["#!/bin/sh", "# What was done in this project, by the commands that did it.", "set -e"]
        lines += [f"cd {shlex.quote(str(self.folder))}"]
        for step in self.state().steps:
            lines += ["", f"# {step.number}. {visible_line(step.title)}"]
            lines += [f"# {visible_line(text.lstrip('# '))}" for text in step.data.get("by_hand", ())]
            for words in step.commands:
                ends = f" || [ $? -eq {step.exit_code} ]" if step.exit_code else ""
                lines.append(command_line(words) + ends)
        return "\n".join(lines) + "\n"


def _beyond(found: Mapping[str, Any]) -> str:
    """Return what of a job file runs a command, is a template, or leads out of its folder, "" without any."""
    for key, value in found.items():
        if key in ("notify", "templates"):
            return f"the key {key}"
        if isinstance(value, Mapping) and (inner := _beyond(value)):
            return inner
        if key in ("store", "machine", "inbox", "out", "instrument") and isinstance(value, str):
            parts = PurePath(value.replace("\\", "/")).parts
            if "://" in value or value.startswith(("/", "\\", "~")) or ".." in parts or re.match("[A-Za-z]:", value):
                return f"{key} = {visible_line(value)[:60]!r}"
    return ""


# Commands that run.


@dataclass(frozen=True)
class StepTask:
    """A step to run, without its result; ``finish`` completes it from what its last command printed.

    ``codes`` are the exit codes of its commands with which it is kept.
    """

    step: Step
    finish: Callable[[Step, str], Step] | None = None
    codes: Sequence[int] = DONE


@dataclass
class Progress:
    """What runs, or ran last: its tasks, the line that it printed last, and how it ended."""

    title: str
    page: str
    began: float = field(default_factory=time.monotonic)
    ended: float | None = None
    stopped: bool = False
    line: str = ""
    problems: list[str] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Time since it began, or that it took."""
        return (time.monotonic() if self.ended is None else self.ended) - self.began


def arguments_for(command: Command, project: Path) -> list[str]:
    """Return the words that start a command as a process of this Python; ``-v`` prints each of its steps.

    Modules are not looked for in the working folder (``-P``), and a job file is written where it belongs.
    """
    words = [f"--job={project / JOB}" if word == f"--job={JOB}" else word for word in command.started]
    return [sys.executable, "-P", "-m", "compgen", "-v", *words]


def environment(project: Path) -> dict[str, str]:
    """Return the environment of a command: one thread, UTF-8, no plain-text colours, messages that are kept in English.

    What the environment of this program names relative to its working folder means the same in that of the command, and
    no module comes from the folder of the project.
    """
    found = {key: value for key, value in os.environ.items() if key not in ("PYTHONSTARTUP", "PYTHONINSPECT")}
    modules = [os.path.abspath(part) for part in found.pop("PYTHONPATH", "").split(os.pathsep) if part]
    if outside := [part for part in modules if not Path(part).resolve().is_relative_to(project)]:
        found["PYTHONPATH"] = os.pathsep.join(outside)
    for key in ("COMPGEN_PLUGINS", "COMPGEN_CONFIG"):
        if found.get(key):
            found[key] = os.pathsep.join(os.path.abspath(part) for part in found[key].split(os.pathsep) if part)
    return found | {
        "COMPGEN_MESSAGES": LANGUAGES[0], WITHIN: str(project), "PYTHONSAFEPATH": "1", "PYTHONUTF8": "1",
        "PYTHONUNBUFFERED": "1", "NO_COLOR": "1", "COLUMNS": "400",
    }  # fmt: skip


class Runner:
    """Runs the commands of one project, one job at a time."""

    def __init__(self, project: Project) -> None:
        self.project = project
        self.job: Progress | None = None
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None

    @property
    def busy(self) -> bool:
        """Whether a job runs."""
        return self.job is not None and self.job.ended is None

    def start(self, title: str, page: str, tasks: Sequence[StepTask]) -> None:
        """Begin a job; InputError while another one runs."""
        with self._lock:
            if self.busy:
                raise InputError("another calculation is running; wait for it or stop it")
            self.job = Progress(title, page)
            self._thread = threading.Thread(target=self._work, args=(self.job, tasks), daemon=True)
            self._thread.start()

    def wait(self, seconds: float) -> None:
        """Wait for the end of the job, at most this long."""
        if self._thread is not None:
            self._thread.join(seconds)

    def stop(self) -> None:
        """End the job; nothing of the command that runs is kept."""
        job = self.job
        if job is not None and job.ended is None:
            job.stopped = True
            self._end()

    def _end(self) -> None:
        process = self._process
        if process is None or process.poll() is not None:
            return
        _signal(process, signal.SIGTERM)
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            _signal(process, getattr(signal, "SIGKILL", signal.SIGTERM))

    def _work(self, job: Progress, tasks: Sequence[StepTask]) -> None:
        try:
            for task in tasks:
                try:
                    if not job.stopped:
                        self._run(job, task)
                except InputError as error:
                    job.problems.append(str(error))
                except OSError as error:
                    job.problems.append(str(not_written(error)))
            recorded = {step.folder for step in self.project.state().steps}
            for task in tasks:
                if task.step.folder and task.step.folder not in recorded:
                    self.project.set_aside(task.step.folder)
        except Exception as error:  # a job must end, whatever happens in it
            job.problems.append(f"internal error: {type(error).__name__}: {error}")
        finally:
            job.ended = time.monotonic()

    def _run(self, job: Progress, task: StepTask) -> None:
        """Run the commands of a task and record its step, unless it was stopped or failed."""
        began, output, messages, worst = time.monotonic(), "", [], 0
        for words in task.step.commands:
            output, said, code = self._command(job, words)
            messages += said
            if job.stopped:
                return
            worst = max(worst, code)
            if code not in task.codes:
                errors = [match[1] for line in said if (match := REFUSED.match(line))]
                job.problems.append("\n".join(errors) or f"volcomp {words[0]} ended with exit code {code}")
                return
        told = [match[1] for line in messages if (match := TOLD.match(line))]
        seconds = round(time.monotonic() - began, 2)
        step = replace(task.step, exit_code=worst, seconds=seconds, warnings=tuple(told))
        self.project.add(step if task.finish is None else task.finish(step, output))

    def _command(self, job: Progress, words: Sequence[str]) -> tuple[str, list[str], int]:
        """Run one command; return what it printed, its messages, and its exit code."""
        job.line = f"volcomp {words[0]}"
        try:
            command = Command.of(list(words))
        except ValueError as error:
            raise InputError(str(error)) from error
        with working_folder("app-") as place:
            return self._listened(job, arguments_for(command, self.project.folder), self.project.link(command, place))

    def _listened(self, job: Progress, arguments: Sequence[str], place: Path) -> tuple[str, list[str], int]:
        with self._lock:
            if job.stopped:
                return "", [], 130
            self._process = process = subprocess.Popen(
                arguments, cwd=place, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                encoding="utf-8", errors="replace", env=environment(self.project.folder), start_new_session=True,
                umask=PRIVATE_MASK if os.name == "posix" else -1,
            )  # fmt: skip
        messages: list[str] = []

        def listen() -> None:
            assert process.stderr is not None
            with contextlib.suppress(ValueError):  # closed: a process of the command has kept it open after its end
                for line in process.stderr:
                    text = line.rstrip()
                    if found := re.match(r"\s*[\d.]+ s  (.+)", text):
                        job.line = found[1]
                    elif text and len(messages) < MOST_LINES:
                        messages.append(text)

        listener = threading.Thread(target=listen, daemon=True)
        listener.start()
        with process:
            assert process.stdout is not None
            output = process.stdout.read()
            code = process.wait()
            listener.join(STOP_S)  # before the streams are closed, or its last messages would be lost
        return output, messages, code


def _signal(process: subprocess.Popen[str], number: int) -> None:
    """Send a signal to a command and to the processes that it started."""
    with contextlib.suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, number)
        else:
            process.terminate()
