"""The pages of the workbench: what each shows, what each button starts, and the checks of every request.

A request is checked before any page sees it: host name, method, session, and for whatever changes something origin, token of
the form and revision of the project. Projects and steps are numbers in the address; a file of a step is looked up in its
list, so no part of an address is used as a path.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import math
import os
import re
import secrets
import signal
import sys
import threading
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from flask import (
    Blueprint,
    Flask,
    Response,
    abort,
    current_app,
    g,
    jsonify,
    redirect,
    render_template,
    request,
    send_file,
)
from jinja2 import StrictUndefined
from markupsafe import Markup, escape
from werkzeug.exceptions import Forbidden, HTTPException
from werkzeug.routing import IntegerConverter
from werkzeug.wrappers import Response as BaseResponse

from compgen.app import asked, contents
from compgen.app.machine_text import with_section, with_value
from compgen.app.project import (
    DEVICES,
    GIVEN,
    JOB,
    PROJECT,
    Measurement,
    Progress,
    Project,
    ProjectState,
    Runner,
    StepTask,
    file_name,
    not_written,
)
from compgen.app.steps import (
    CERTIFICATE_FIELDS,
    CERTIFICATE_LISTS,
    CORRECT_FIELDS,
    FIT_FIELDS,
    PROGRAM_FIELDS,
    Step,
    answer,
    command_line,
)
from compgen.controls import CONTROLLERS
from compgen.data.files import json_text, read_text, working_folder, write_file
from compgen.data.machine import INTEGERS, load_machine, machine_files
from compgen.data.names import AXES, SQUARENESS_NAMES, describe_error
from compgen.data.prior import class_named
from compgen.drawing.charts import LABEL
from compgen.drawing.page_units import page_in_inch
from compgen.errors import CompgenError, InputError, number_text, um_text, visible
from compgen.foreign import native_format
from compgen.identification.options import StatedNumbers
from compgen.language import texts_of
from compgen.new_machine import chains_of, in_words
from compgen.programs.dialects import DIALECTS
from compgen.report.html.pictures import thousands
from compgen.report.html.write import markdown, micro
from compgen.report.pdf import pdf_of
from compgen.resources import LANGUAGES, cache_folder, data_folder
from compgen.units import UNITS, typed_mm
from compgen.web.connections import LARGEST_BODY, bounded, small_for
from compgen.web.guard import (
    HEADERS,
    check_host,
    check_method,
    check_origin,
    cookie_name,
    error_response,
    same,
    set_cookie,
)
from compgen.web.site import LocalSite, Site

#: Largest request (files that are dropped together), largest part of a form that is not a file, bytes; parts of a form.
LARGEST_UPLOAD, LARGEST_FORM, MOST_PARTS = 200_000_000, 2_000_000, 400
#: Characters of a field of several lines.
LONGEST_LIST = 4_000
#: A page that has not been heard of for this long is closed; background windows are slowed to one call a minute, s.
SILENT_S = 200.0
#: The program ends this long after the last page was closed, s.
GRACE_S = 6.0
#: A button answers with the result if it is ready within this time, otherwise with the progress, s.
A_MOMENT_S = 0.8
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; style-src-attr 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
#: Pages of a project, in the order of the work.
PAGES = {
    "machine": "Machine", "plan": "Plan", "measurement": "Measurement", "result": "Result", "tables": "Tables",
    "program": "NC program", "after": "Before and after", "project": "Project",
}  # fmt: skip
_NUMBER = "number(max=99999)"
pages = Blueprint("pages", __name__)


class StepNumber(IntegerConverter):
    """A whole number in ASCII digits without leading zeros."""

    regex = "0|[1-9][0-9]{0,4}"


@dataclass
class OpenPages:
    """Which pages are open in browsers: the program ends when the last one is closed."""

    seen: dict[str, float] = field(default_factory=dict)
    gone: dict[str, float] = field(default_factory=dict)
    last: float | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)

    def alive(self, page: str) -> None:
        """Note that a page is open; not if it has said that it was left, because messages overtake each other."""
        with self.lock:
            if page not in self.gone and (len(self.seen) < 1000 or page in self.seen):
                self.seen[page] = self.last = time.monotonic()

    def left(self, page: str) -> None:
        """Note that a page was closed or follows a link."""
        now = time.monotonic()
        with self.lock:
            self.gone = {name: at for name, at in self.gone.items() if now - at < SILENT_S}
            if self.seen.pop(page, None) is not None or len(self.gone) < 1000:
                self.gone[page] = self.last = now

    def over(self) -> bool:
        """Whether the last page was closed a while ago; False if there never was one."""
        now = time.monotonic()
        with self.lock:
            for page in [page for page, at in self.seen.items() if now - at > SILENT_S]:
                del self.seen[page]
            return self.last is not None and not self.seen and now - self.last > GRACE_S


@dataclass
class Workbench:
    """Everything that exists as long as the program runs.

    ``ticket`` is the token of the first address, used once; ``first_page`` a private file that leads the browser there.
    """

    site: Site
    language: str = LANGUAGES[0]
    units: str = UNITS[0]
    projects: list[Runner] = field(default_factory=list)
    ticket: str | None = field(default_factory=lambda: secrets.token_urlsafe(32))
    first_page: Path | None = None
    session: str = field(default_factory=lambda: secrets.token_urlsafe(32))
    csrf: str = field(default_factory=lambda: secrets.token_urlsafe(32))
    open_pages: OpenPages = field(default_factory=OpenPages)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def open(self, folder: str | Path) -> int:
        """Open a project and return its number; one that is open keeps its number."""
        project = Project.open(folder)
        _check_modules(project.folder)
        with self.lock:
            for number, runner in enumerate(self.projects, start=1):
                if runner.project.folder == project.folder:
                    return number
            self.projects.append(Runner(project))
            _remember(project.folder)
            return len(self.projects)

    def close(self) -> None:
        """Stop what runs."""
        for runner in self.projects:
            runner.stop()


def _check_modules(folder: Path) -> None:
    """Refuse the folder of a project in which this process looks for Python modules: a file in it would be run."""
    for part in sys.path:
        place = Path(part or ".").resolve()
        if place.is_relative_to(folder) and not place.is_relative_to(Path(sys.prefix).resolve()):
            raise InputError(
                f"Python looks for modules in {place} (PYTHONPATH names it, or the program was started there by `python -m`), so "
                "a file in this project would be run; start `volcomp app` in another folder, without it in PYTHONPATH",
                file=folder,
            )


def _recent_file() -> Path:
    return cache_folder("app") / "recent.json"


def recent_projects() -> list[Path]:
    """Return the folders of projects that were opened last and still exist."""
    try:
        found = json.loads(_recent_file().read_text(encoding="utf-8"))
        return [Path(item) for item in found if (Path(item) / PROJECT).is_file()][:10]
    except (OSError, ValueError, TypeError):
        return []


def _remember(folder: Path) -> None:
    known = [folder, *(item for item in recent_projects() if item != folder)]
    try:
        write_file(_recent_file(), json_text([str(item) for item in known[:10]]), private=True)
    except InputError:  # a folder that nobody may write to
        return


def the_workbench() -> Workbench:
    """Return what the pages share."""
    found: Workbench = current_app.extensions["compgen"]
    return found


def the_runner(number: int) -> Runner:
    """Return the commands of an open project or answer 404."""
    known = the_workbench().projects
    return known[number - 1] if 1 <= number <= len(known) else abort(404, "No such project is open.")


# What each page shows.


def _page(number: int, name: str, code: int = 200, **more: Any) -> tuple[str, int]:
    """Render a page of a project; ``more`` overrides what it shows, e.g. ``problem``."""
    runner = the_runner(number)
    state = runner.project.state()
    shown: dict[str, Any] = {
        "problem": "", "number": number, "project": runner.project, "state": state, "page": name, "job": runner.job,
        "done": {"machine": state.machine is not None, "plan": state.current("plan") is not None,
                 "measurement": bool(state.used_files()),
                 "result": state.current("identify") is not None, "tables": state.current("run") is not None,
                 "program": any(state.is_current(step) for step in state.steps if step.kind == "correct"),
                 "after": state.last("compare") is not None, "project": False},
    }  # fmt: skip
    try:
        shown |= contents.SHOWN[name](runner.project, state)
        return render_template(f"{name}.html", **(shown | more)), code
    except (CompgenError, HTTPException, OSError):
        raise
    except Exception as error:
        _report_fault(error)
        raise InputError(
            f"page {PAGES[name]} cannot show the files of this project ({type(error).__name__}). If a file of a step is not what "
            "its command wrote, take that step back on page Project, or calculate again; otherwise this is a bug, and the "
            "terminal shows where"
        ) from error


# Pages without a project, and what all of them need.


@pages.get("/start")
def start() -> BaseResponse:
    """Exchange the token of the first address for a session; it is valid once.

    A browser that comes from the private file (``from=file``) would not send its new cookie to where it is redirected,
    because it comes from elsewhere: it gets a page that goes there by itself.
    """
    workbench = the_workbench()
    with workbench.lock:
        given, known = request.args.get("token", ""), workbench.ticket
        if known is None or not same(given, known):
            abort(403, "This address is valid once. Close this page and start `volcomp app` again.")
        workbench.ticket = None
    if workbench.first_page is not None:
        workbench.first_page.unlink(missing_ok=True)
    target = "/projects/1/" if workbench.projects else "/"
    response: BaseResponse = redirect(target, code=303)
    if request.args.get("from") == "file":
        response = Response(leading_to(target), mimetype="text/html")
    set_cookie(response, workbench.site, "app", workbench.session)
    return response


def leading_to(address: str) -> str:
    """Return a page that leads the browser to another one at once, without telling it where it comes from."""
    link = escape(address)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>volcomp</title>'
        f'<meta name="referrer" content="no-referrer"><meta http-equiv="refresh" content="0; url={link}"></head>'
        f'<body><p><a href="{link}">The workbench</a></p></body></html>\n'
    )


@pages.get("/")
def home() -> str:
    """Show the projects that were opened last, and where a new one would be."""
    return _home("")


def _home(problem: str, folder: str = "") -> str:
    proposed = Path.home() / "volcomp" / time.strftime("%Y-%m-%d")
    return render_template(
        "start.html", problem=problem, recent=recent_projects(), folder=folder or str(proposed), number=0
    )


@pages.post("/open")
def open_project() -> BaseResponse | tuple[str, int]:
    """Open the folder of a project, or begin one."""
    folder = request.form.get("folder", "").strip()
    try:
        if not folder or len(folder) > 1000 or any(ord(char) < 32 for char in folder):
            raise InputError("give the folder of the project: a path of at most 1000 characters on one line")
        number = the_workbench().open(folder)
        state = the_runner(number).project.state()
    except InputError as error:
        return _home(str(error), folder), 409
    return redirect(f"/projects/{number}/{'result' if state.used_files() else 'machine'}", code=303)


@pages.get(f"/projects/<{_NUMBER}:number>/")
def first_page(number: int) -> BaseResponse:
    """Go to the first page with something to do."""
    state = the_runner(number).project.state()
    name = "machine" if state.machine is None else "result" if state.used_files() else "measurement"
    return redirect(f"/projects/{number}/{name}", code=303)


@pages.get(f"/projects/<{_NUMBER}:number>/<any({', '.join(PAGES)}):name>")
def project_page(number: int, name: str) -> tuple[str, int]:
    """Show one page of a project."""
    return _page(number, name)


@pages.get(f"/projects/<{_NUMBER}:number>/status")
def status(number: int) -> dict[str, Any]:
    """Report what runs and the revision; the pages ask for it about twice a second while something runs."""
    runner = the_runner(number)
    job, said = runner.job or Progress("", ""), current_app.jinja_env.filters["lines"]
    return {
        "revision": runner.project.state().revision, "busy": runner.busy, "title": said(job.title), "line": said(job.line),
        "seconds": round(job.seconds, 1),
    }  # fmt: skip


@pages.post("/alive")
def alive() -> tuple[str, int]:
    """Note that a page is open, or that it was left."""
    page, here = request.form.get("page", "")[:40], the_workbench().open_pages
    (here.left if request.form.get("left") else here.alive)(page)
    return "", 204


_ASSETS = {
    "app.css": ("_app", "text/css"), "app.js": ("_app", "text/javascript"), "charts.js": ("_report", "text/javascript")
}  # fmt: skip


@pages.get("/<any('app.css', 'app.js', 'charts.js'):name>")
def asset(name: str) -> Response:
    """Send the style sheet or a script."""
    folder, kind = _ASSETS[name]
    return Response((data_folder("templates") / folder / name).read_text(encoding="utf-8"), mimetype=kind)


@pages.get("/chain")
def chain_meaning() -> Response | tuple[str, int]:
    """Return what the words for a chain can mean, with the drawing of the likeliest, while they are typed; 204 without any."""
    try:
        fits = chains_of(request.args.get("words", "")[:200])
    except InputError:
        return "", 204
    if not fits:
        return "", 204
    said = current_app.jinja_env.filters["lines"]
    words = [[chain.name, said(in_words(chain))] for chain in fits[:6]]
    return jsonify(fits=words, drawing=current_app.jinja_env.filters["drawn"](contents.chain_picture(fits[0])))


# What the buttons do.


def action(name: str, path: str) -> Callable[[Callable[..., str | None]], Callable[..., Any]]:
    """Make a view of a function that changes a project: it checks the revision, and shows the page again with a problem."""

    def decorate(change: Callable[..., str | None]) -> Callable[..., Any]:
        @pages.post(f"/projects/<{_NUMBER}:number>/{path}")
        @functools.wraps(change)
        def view(number: int, **arguments: int) -> BaseResponse | tuple[str, int]:
            runner = the_runner(number)
            try:
                text = request.form.get("revision", "")
                state = runner.project.check(int(text) if re.fullmatch(r"[0-9]{1,9}", text) else -1)
                if runner.busy:
                    raise InputError("a calculation is running; wait for it or stop it")
                target = change(runner, state, **arguments)
            except CompgenError as error:
                return _page(number, name, 409, problem=str(error))
            except OSError as error:  # the disk is full, or the folder must not be written to
                return _page(number, name, 409, problem=str(not_written(error)))
            runner.wait(A_MOMENT_S)
            return redirect(f"/projects/{number}/{target or name}", code=303)

        return view

    return decorate


def _field(name: str, most: int = 300) -> str:
    text = request.form.get(name, "").strip()
    if len(text) > most or any(ord(char) < 32 for char in text):
        raise InputError(f"expected one line of at most {most} characters", field=name)
    return text


def _language() -> list[str]:
    """Options of a command that writes pages: its language and units are those of the workbench."""
    language, units = the_workbench().language, the_workbench().units
    words = [] if language == LANGUAGES[0] else ["--language", language]
    return words if units == UNITS[0] else [*words, "--units", units]


def _machine_of(state: ProjectState) -> str:
    if state.machine is None:
        raise InputError("choose or describe the machine first")
    return state.machine


@action("machine", "machine/choose")
def choose_machine(runner: Runner, state: ProjectState) -> None:
    """Take a shipped machine; its file is copied into the project, where its settings can be changed."""
    name = _field("machine")
    path = machine_files(()).get(name)
    if path is None:
        raise InputError(f"{name!r} is not one of the machines in the list")
    _store_machine(runner, read_text(path), f"{name}.toml", f"Machine {name}", by_hand="a copy of the shipped file")


@action("machine", "machine/upload")
def upload_machine(runner: Runner, state: ProjectState) -> None:
    """Take a machine file."""
    file = next((item for item in request.files.getlist("files") if item.filename), None)
    if file is None:
        raise InputError("choose a machine file (*.toml)")
    name, content = file_name(file.filename or ""), file.stream.read(LARGEST_FORM)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text; expected a machine file (*.toml)", file=name) from error
    _store_machine(
        runner, text, name if name.endswith(".toml") else f"{name}.toml", f"Machine file {name}", by_hand="uploaded"
    )


@action("machine", "machine/describe")
def describe_machine(runner: Runner, state: ProjectState) -> None:
    """Write a machine file from the form, as ``volcomp init`` does."""
    name, chain = _field("name", 60), _field("chain", 200)
    if not re.fullmatch(r"\w[\w. -]*", name):
        raise InputError(
            "a name has letters, digits, blanks, dots and hyphens, and begins with a letter or a digit", field="name"
        )
    if not chain:
        raise InputError("say which body carries which axis", field="chain")
    fit = _field("fit")
    if fit in (found.name for found in chains_of(chain)):  # which of several meanings of the words
        chain = fit
    words = ["init", name, f"--chain={chain}"]
    for letter in AXES:
        low, high = _number(f"{letter}-low"), _number(f"{letter}-high")
        words.append(f"--travel={letter}={low:g}..{high:g}")
    words += [f"--control={control}" for control in request.form.getlist("control") if control in CONTROLLERS]
    words += [f"--class={class_named(_field('class'))}"] if _field("class") else []
    values = {}
    for key in ("reference_point_mm", "tool_offset_mm"):
        given = [_field(f"{key}-{letter}") for letter in AXES]
        if any(given):
            numbers = [_number(f"{key}-{letter}") if part else 0.0 for letter, part in zip(AXES, given, strict=True)]
            values[key] = contents.toml_value(numbers)
    folder = runner.project.new_folder("machine")
    words += [f"--out={folder}", "--json"]

    def finish(step: Step, output: str) -> Step:
        summary = json.loads(output)
        path = runner.project.path(summary["file"])
        text = read_text(path)
        for key, value in values.items():
            text = with_value(text, "", key, value)
        write_file(path, text, private=True)
        load_machine(str(path))
        by_hand = [f"# in {summary['file']}: {key} = {value}" for key, value in values.items()]
        data = {"machine": summary["file"], "meaning": summary["meaning"], "by_hand": by_hand}
        return replace(step, data=data)

    runner.start(
        "writing the machine file",
        "machine",
        [StepTask(Step(0, "machine", f"Machine {name}", [words], folder), finish)],
    )


def _number(name: str) -> float:
    """A length of a form, mm; ``24in`` says its unit itself."""
    text = _field(name, 30)
    try:
        value = typed_mm(text)
    except ValueError:
        value = math.nan
    if not abs(value) < 1e7:
        raise InputError(f"{text!r} is not a length in mm; one in another unit is written 24in", field=name)
    return value


@action("machine", "machine/text")
def edit_machine(runner: Runner, state: ProjectState) -> None:
    """Take the edited text of the machine file."""
    text = request.form.get("text", "").replace("\r\n", "\n")
    name = Path(_machine_of(state)).name
    _store_machine(
        runner, text, name if name.endswith(".toml") else f"{name}.toml", "Machine file edited", by_hand="edited"
    )


@action("machine", "machine/settings")
def change_settings(runner: Runner, state: ProjectState) -> None:
    """Change settings of a control in the machine file; its comments stay."""
    path, control = contents.machine_file(runner.project, state), _field("control")
    if path is None or control not in CONTROLLERS:
        raise InputError("choose a machine and a control first")
    text, name = contents.machine_text(path), Path(_machine_of(state)).name
    text = with_section(text, f"controllers.{control}")
    changed = []
    for setting in contents.settings_of(text, control):
        given = _field(setting.key, 1000)
        if given == setting.value:
            continue
        value = json.dumps(given, ensure_ascii=False) if given and setting.kind == "text" else given
        text = with_value(text, f"controllers.{control}", setting.key, value)
        changed.append(f"{setting.key} = {value or 'default'}")
    target = name if name.endswith(".toml") else f"{name}.toml"
    _store_machine(
        runner, text, target, f"Settings of {control}", by_hand=f"[controllers.{control}] {'; '.join(changed)}"
    )


def _store_machine(runner: Runner, text: str, name: str, title: str, by_hand: str) -> None:
    """Keep a machine file if ``volcomp check`` finds no problem; otherwise it is refused with all of them."""
    folder = runner.project.new_folder("machine")
    path = f"{folder}/{name}"
    write_file(runner.project.path(path), text, private=True)

    words = ["check", path, "--kind", "machine", "--json"]
    step = Step(0, "machine", title, [words], folder, data={"machine": path, "by_hand": [f"# {path}: {by_hand}"]})
    runner.start("checking the machine file", "machine", [StepTask(step, _without_problems, (0, 2))])


def _without_problems(step: Step, output: str) -> Step:
    """Keep a step whose file ``volcomp check`` accepts; InputError with all problems of another one."""
    listed = json.loads(output)["files"][0]
    if listed["problems"]:
        raise InputError("\n".join(problem["text"] for problem in listed["problems"]))
    return replace(step, data={**step.data, "remarks": listed["warnings"]})


@action("plan", "plan/make")
def make_plan(runner: Runner, state: ProjectState) -> None:
    """Predict what circles, an artefact or a laser tracer will determine, before anything is measured."""
    machine, project = _machine_of(state), runner.project
    typed = {name: _field(name) for name in ("circles", "poses")}
    words = [f"--circle={text.strip()}" for text in typed["circles"].split(";") if text.strip()]
    folder = project.new_folder("plan")
    given = {name: _uploaded(project, folder, name)[:1] for name in ("artefact", "stations", "points")}
    words += [f"--{name}={path}" for name, paths in given.items() for path in paths]
    words += [f"--poses={typed['poses']}"] * bool(given["artefact"] and typed["poses"])
    words += ["--grid"] * bool(given["stations"] and not given["points"])
    if not words:
        project.set_aside(folder)
        raise InputError("give circles, an artefact or the stations of a tracer")
    words = ["plan", machine, *words, *_language(), "--out", folder]
    step = Step(0, "plan", "Plan of a measurement", [words], folder, data={"typed": typed})
    runner.start("planning the measurement", "plan", [StepTask(step)])


@action("measurement", "measurement/add")
def add_measurements(runner: Runner, state: ProjectState) -> str | None:
    """Store the dropped files and show what they contain."""
    after = bool(request.form.get("after"))
    files = [item for item in request.files.getlist("files") if item.filename]
    if not files:
        raise InputError("choose one or more files")
    tasks = []
    for file in files[:30]:
        folder = runner.project.new_folder("measurement")
        path = f"{folder}/{file_name(file.filename or '')}"
        runner.project.keep(file.stream, path)
        if path.endswith(".toml") and not after:
            words = ["check", path, "--kind", "instrument", "--json"]
            step = Step(0, "instrument", f"Instrument {Path(path).name}", [words], folder, data={"file": path})
            tasks.append(StepTask(step, _without_problems, (0, 2)))
            continue
        tasks.append(_import_task(runner.project, state, path, folder, (), {"after": after}))
    runner.start("reading the files", "after" if after else "measurement", tasks)
    return "after" if after else None


def _import_task(
    project: Project, state: ProjectState, path: str, folder: str, answers: Sequence[str], data: dict[str, Any]
) -> StepTask:
    """Return the task that shows a file and converts it if nothing is open; a file in the native form is used as it is."""
    words = ["import", path, *answers, "--json"]
    try:
        foreign = native_format(project.given(path)) is None
    except InputError:
        foreign = False  # the command says what is wrong
    if foreign:
        words += ["--out", f"{folder}/read"]
    if state.machine is not None:
        words += ["--machine", state.machine]

    def finish(step: Step, output: str) -> Step:
        summary = json.loads(output or "{}")
        if "understood" not in summary:
            raise InputError(str(summary.get("error") or "the file could not be read"))
        written = [Path(name).as_posix() for name in summary["files"]]
        used = written or ([] if foreign else [path])
        facts = {"file": path, "used": used, "summary": summary, "answers": list(answers), **data}
        return replace(step, data=facts)

    title = Path(path).name if not answers else f"{Path(path).name}: {' '.join(answers)}"
    return StepTask(Step(0, "measurement", title, [words], folder), finish, (0, 2))


@action("measurement", f"measurement/<{_NUMBER}:item>/answer")
def answer_questions(runner: Runner, state: ProjectState, item: int) -> str | None:
    """Read a file again with the answers to what it leaves open."""
    found = _measurement(state, item)
    given = [_field(name) for name in request.form if name.startswith("answer-")]
    typed = [
        f"--{name.removeprefix('typed-')}={_field(name)}"
        for name in request.form
        if name.startswith("typed-") and _field(name)
    ]
    places = [f"{name[5:]}={_number(name):g}" for name in request.form if name.startswith("line-") and _field(name)]
    typed += [f"--line={','.join(places)}"] * bool(places)
    answers = [*found.step.data["answers"], *(word for word in given if word), *typed]
    for word in answers:
        _checked_answer(word)
    folder = runner.project.new_folder("measurement")
    data = {"after": found.after, "answers_to": found.number}
    task = _import_task(runner.project, state, found.file, folder, list(dict.fromkeys(answers)), data)
    runner.start("reading the file again", "after" if found.after else "measurement", [task])
    return "after" if found.after else None


@action("measurement", f"measurement/<{_NUMBER}:item>/columns")
def choose_columns(runner: Runner, state: ProjectState, item: int) -> str | None:
    """Read a file again with what its columns are, as the chooser says it."""
    found = _measurement(state, item)
    answers = list(found.step.data["answers"])
    chooser = asked.columns_shown(runner.project.path(found.file), answers, found.step.data["summary"])
    if chooser is None:
        raise InputError("this file has no columns to choose")
    chosen = []
    for k, column in enumerate(chooser.columns):
        field_, unit = _field(f"field-{k}", 40), _field(f"unit-{k}", 20)
        if field_ not in (*dict(chooser.fields), "ignore", "") or unit not in ("", *asked.COLUMN_UNITS):
            raise InputError("choose one of the answers")
        chosen.append((column, field_, unit))
    answers = asked.with_columns(answers, chosen)
    for word in answers:
        _checked_answer(word)
    folder = runner.project.new_folder("measurement")
    data = {"after": found.after, "answers_to": found.number}
    task = _import_task(runner.project, state, found.file, folder, list(dict.fromkeys(answers)), data)
    runner.start("reading the file again", "after" if found.after else "measurement", [task])
    return "after" if found.after else None


def _checked_answer(word: str) -> None:
    try:
        answer(word)
    except ValueError as error:
        raise InputError("choose one of the answers") from error


def _measurement(state: ProjectState, number: int) -> Any:
    found = next((item for item in state.measurements if item.number == number), None)
    if found is None:
        raise InputError("this measurement is not in the project any more")
    return found


@action("measurement", f"measurement/<{_NUMBER}:item>/remove")
def remove_measurement(runner: Runner, state: ProjectState, item: int) -> str | None:
    """Leave a measurement out; its file stays in the folder."""
    found = _measurement(state, item)
    step = Step(0, "removed", f"Without {found.name}", data={"measurement": item, "after": found.after})
    runner.project.add(step, state.revision)
    return "after" if found.after else None


@action("measurement", f"measurement/<{_NUMBER}:item>/sheet")
def make_sheet(runner: Runner, state: ProjectState, item: int) -> str | None:
    """Evaluate axis runs or circles by their standard, and write the sheet to print."""
    found = _measurement(state, item)
    if not found.used:
        raise InputError("answer the open questions first")
    folder = runner.project.new_folder("accuracy")
    words = ["accuracy", _machine_of(state), found.used[0], *_language(), "--out", folder]
    step = Step(0, "accuracy", f"Figures of {found.name}", [words], folder, data={"sheet_of": found.step.number})
    page = "after" if found.after else "measurement"
    runner.start("evaluating by the standard", page, [StepTask(step)])
    return page


@action("measurement", "numbers")
def state_numbers(runner: Runner, state: ProjectState) -> None:
    """Take numbers that are known without a file, with unit and uncertainty as one types them."""
    from compgen.identification.stated import check_signs

    numbers: dict[str, list[str]] = {}
    for option, names in (("squareness", SQUARENESS_NAMES), ("backlash", AXES), ("scale", AXES)):
        for name in names:
            value = _field(f"{option}-{name}", 60)
            if value:
                numbers.setdefault(option, []).append(f"{name}={value}")
    stated = StatedNumbers(**{key: dict(word.split("=", 1) for word in words) for key, words in numbers.items()})
    check_signs(stated, {})
    path = contents.machine_file(runner.project, state)
    if path is None:
        raise InputError("choose or describe the machine first")
    contents.machine_text(path)
    stated.errors(load_machine(str(path)))
    runner.project.add(Step(0, "numbers", "Numbers known without a file", data={"numbers": numbers}), state.revision)


def _inputs(state: ProjectState) -> list[str]:
    """Return machine, measurements and numbers as a command takes them."""
    machine = _machine_of(state)
    open_files = [item.name for item in state.measurements if not item.after and not item.used]
    if open_files:
        raise InputError(
            f"{', '.join(open_files)}: not usable yet; page Measurement says what is open. Answer it, or remove the file"
        )
    files = state.used_files()
    numbers = [f"--{option}={word}" for option, words in state.numbers.items() for word in words]
    if not files and not numbers:
        raise InputError("add a measurement first")
    return [machine, *files, *numbers, *_instrument(state)]


def _instrument(state: ProjectState) -> list[str]:
    return [] if state.instrument is None else [f"--instrument={state.instrument}"]


@action("result", "identify")
def identify(runner: Runner, state: ProjectState) -> None:
    """Identify the errors, and write the report."""
    words = _inputs(state)
    runner.start("identifying the errors", "result", [_identify_task(runner.project, state, words)])


def _identify_task(project: Project, state: ProjectState, words: Sequence[str]) -> StepTask:
    folder = project.new_folder("identify")
    commands = [["identify", *words, "--out", folder], ["report", folder, *_certificate(state), *_language()]]
    return StepTask(Step(0, "identify", "Errors identified", commands, folder))


def _certificate(state: ProjectState) -> list[str]:
    """Return the option for the report with what was typed about customer, machine and instruments."""
    last = state.last("certificate")
    return [] if last is None else [f"--certificate={last.data['certificate']}"]


@action("result", "certificate")
def hand_over_report(runner: Runner, state: ProjectState) -> None:
    """Keep what only the laboratory knows, and make the reports of the last result and its tables again with it."""
    stated = {name: text for name in CERTIFICATE_FIELDS if (text := _field(name))}
    for name in CERTIFICATE_LISTS:
        text = request.form.get(name, "").replace("\r\n", "\n").strip()
        if len(text) > LONGEST_LIST or any(ord(char) < 32 and char != "\n" for char in text):
            raise InputError(f"expected lines of at most {LONGEST_LIST} characters together", field=name)
        stated |= {name: text} if text else {}
    steps = [step for step in (state.last("identify"), state.current("run")) if step is not None]
    if not steps:
        raise InputError("calculate a result first: there is no report yet")
    folder = runner.project.new_folder("certificate")
    path = f"{folder}/certificate.toml"
    write_file(runner.project.path(path), contents.certificate_text(stated), private=True)
    commands = [["report", step.folder, f"--certificate={path}", *_language()] for step in steps]
    title = "Customer, machine and instruments for the report"
    step = Step(0, "certificate", title, commands, folder, data={"certificate": path, "stated": stated})
    runner.start("making the report again", "result", [StepTask(step)])


@action("result", "diagnose")
def diagnose(runner: Runner, state: ProjectState) -> None:
    """Look for the effect that explains where model and measurement disagree."""
    machine, files = _machine_of(state), state.used_files()
    if not files:
        raise InputError("add a measurement first: numbers alone have no residuals")
    folder = runner.project.new_folder("diagnose")
    words = ["diagnose", machine, *files, *_instrument(state), *_language(), "--out", folder]
    runner.start("looking for missing effects", "result", [StepTask(Step(0, "diagnose", "Diagnosis", [words], folder))])


@action("result", "apply")
def apply_diagnosis(runner: Runner, state: ProjectState) -> None:
    """Take the machine with the effects that were found, and identify again."""
    found = state.current("diagnose")
    if found is None or "extended.toml" not in runner.project.files_of(found):
        raise InputError("there is no diagnosis of the present measurement that named an effect")
    machine = f"{found.folder}/extended.toml"
    state = runner.project.add(
        Step(0, "machine", "Machine with the effects that were found", data={"machine": machine}), state.revision
    )
    runner.start("identifying with the effect", "result", [_identify_task(runner.project, state, _inputs(state))])


@action("tables", "options")
def options(runner: Runner, state: ProjectState) -> None:
    """Show side by side what each control would gain."""
    step = _identified(state)
    folder = runner.project.new_folder("options")
    words = ["options", _machine_of(state), f"{step.folder}/identified.errors.csv", *_language(), "--out", folder]
    runner.start(
        "exporting for every control",
        "tables",
        [StepTask(Step(0, "options", "Controls side by side", [words], folder))],
    )


def _identified(state: ProjectState) -> Step:
    step = state.current("identify")
    if step is None:
        raise InputError("calculate the result of the present measurement first (page Result)")
    return step


@action("tables", "run")
def make_tables(runner: Runner, state: ProjectState) -> None:
    """Make, read back and verify the tables of a control."""
    words, control = _inputs(state), _control()
    folder = runner.project.new_folder("tables")
    typed, fit = _fit_words()
    words = ["run", *words, "--controller", control, *fit, *_certificate(state), *_language(), "--out", folder]
    words += [f"--{name}" for name in ("allow-unverified", "allow-misfit") if request.form.get(name)]
    kind = (CONTROLLERS[control].sample_setting or "style_from").replace("_", "-")
    words += [f"--active={path}" for path in _uploaded(runner.project, folder, "active")]
    words += [f"--{kind}={path}" for path in _uploaded(runner.project, folder, "sample")]
    again = next((step for step in state.steps if str(step.number) == _field("again") and step.kind == "run"), None)
    if again is not None:  # with the files and the bounds that were given then
        bounds = tuple(f"--{name}" for name in FIT_FIELDS)
        words += [word for word in again.commands[0] if word.startswith(("--active=", f"--{kind}=", *bounds))]
        typed = dict(again.data.get("fit", {}))
    step = Step(0, "run", f"Tables for {control}", [words], folder, data={"control": control, "fit": typed})
    runner.start(f"tables for {control}", "tables", [StepTask(step)])


def _fit_words() -> tuple[dict[str, str], list[str]]:
    """Return what was typed about smoothing and bounds, and as options of a command."""
    typed = {name: _field(name) for name in FIT_FIELDS if name in request.form}
    words = [f"--{name}={part.strip()}" for name, text in typed.items() for part in text.split(";") if part.strip()]
    return typed, ["--robust" if word == "--robust=on" else word for word in words]


def _uploaded(project: Project, folder: str, name: str) -> list[str]:
    """Save the files of a field below the folder of a step and return their paths in the project."""
    files = [item for item in request.files.getlist(name) if item.filename][:50]
    paths = [f"{folder}/{GIVEN}/{name}-{k}-{file_name(item.filename or '')}" for k, item in enumerate(files, start=1)]
    for item, path in zip(files, paths, strict=True):
        project.keep(item.stream, path)
    return paths


def _control() -> str:
    control = _field("control")
    if control not in CONTROLLERS:
        raise InputError("choose a control")
    return control


@action("tables", "verify")
def verify_backup(runner: Runner, state: ProjectState) -> None:
    """Verify what the control holds: a backup of it against the identified errors."""
    step, control = _identified(state), _control()
    folder = runner.project.new_folder("verify")
    paths = _uploaded(runner.project, folder, "files")
    if not paths:
        runner.project.set_aside(folder)
        raise InputError("choose the backup of the control")
    errors = f"{step.folder}/identified.errors.csv"
    words = ["verify", _machine_of(state), *paths, "--controller", control, "--errors", errors, "--out", folder]
    verified = Step(0, "verify", f"Backup of {control} verified", [words], folder, data={"control": control})
    runner.start("verifying the backup", "tables", [StepTask(verified)])


@action("program", "program/use")
def use_program(runner: Runner, state: ProjectState) -> None:
    """Predict the part of an NC program, or correct the program, with the errors that were identified."""
    step, project, machine = _identified(state), runner.project, _machine_of(state)
    setup = _program_setup(project, state)
    typed, name = setup["typed"], Path(setup["program"]).name
    taken = ("dialect", "gauge", "keep-unknown", "integers", "increment-mm")
    words = [f"--{option}={typed[option]}" for option in taken if typed[option]]
    words += [f"--wcs={text.strip()}" for text in typed["wcs"].split(";") if text.strip()]
    words += [f"--tools={setup['tools']}"] * bool(setup["tools"]) + ["--block-delete"] * setup["block-delete"]
    reversal, errors = f"{step.folder}/identified.reversal.csv", f"{step.folder}/identified.errors.csv"
    words += [f"--reversal={reversal}"] * project.path(reversal).is_file()
    corrects = _field("what") == "correct"
    if typed["tables"]:
        tables = next(item for item in state.steps if str(item.number) == typed["tables"])
        file, control = ("--active", "--active-controller") if corrects else ("--tables", "--controller")
        words += [f"{file}={path}" for path in contents.control_files(project, tables)]
        words.append(f"{control}={tables.data['control']}")
    folder = project.new_folder("correct" if corrects else "part")
    commands = [["part", machine, setup["program"], f"--errors={errors}", *words, *_language(), "--out", folder]]
    if corrects:
        words += [f"--{option}={typed[option]}" for option in CORRECT_FIELDS if typed[option]]
        fit = ["fit", machine, errors, *_fit_words()[1], "--out", f"{folder}/fit"]
        errors = f"{folder}/fit/fitted.errors.csv"
        commands = [
            fit,
            ["correct", machine, setup["program"], f"--errors={errors}", *words, *_language(), "--out", folder],
        ]
    title = f"{name} corrected" if corrects else f"Part of {name}"
    done = Step(0, "correct" if corrects else "part", title, commands, folder)
    runner.start("correcting the program" if corrects else "predicting the part", "program", [StepTask(done)])


def _program_setup(project: Project, state: ProjectState) -> dict[str, Any]:
    """Return NC program, tool table and what was typed; a step keeps them if they are new."""
    known = {} if (last := state.last("program")) is None else dict(last.data)
    typed = {name: _field(name) for name in PROGRAM_FIELDS}
    if typed["dialect"] not in DIALECTS:
        raise InputError("choose the dialect of the program")
    if typed["integers"] not in ("", *INTEGERS):
        raise InputError("choose what a number without a decimal point is")
    if typed["tables"] and typed["tables"] not in [str(step.number) for step in state.steps if step.kind == "run"]:
        raise InputError("these tables are not in the project any more")
    setup = {"program": known.get("program", ""), "tools": known.get("tools", ""), "typed": typed}
    setup["block-delete"] = bool(request.form.get("block-delete"))
    if request.form.get("no-tools"):
        setup["tools"] = ""
    given = {name: file for name in ("program", "tools") for file in request.files.getlist(name)[:1] if file.filename}
    if not setup["program"] and "program" not in given:
        raise InputError("choose the NC program")
    folder = project.new_folder("program") if given else ""
    for name, file in given.items():
        path = f"{folder}/{GIVEN}/{name}/{file_name(file.filename or '')}"
        project.keep(file.stream, path)
        setup[name] = path
    if setup != {key: value for key, value in known.items() if key != "by_hand"}:
        data = {**setup, "by_hand": [f"# {setup[name]}: uploaded" for name in given]}
        title = f"NC program {Path(setup['program']).name}"
        project.add(Step(0, "program", title, folder=folder, data=data), state.revision)
    return setup


@action("after", "compare")
def compare(runner: Runner, state: ProjectState) -> None:
    """Compare measurements after the correction with those before it.

    One file on each side is compared as it is. Several are identified together, then their errors are compared; axis runs
    and diagonals that both sides have once are compared by themselves, too, with the figures of their standard.
    """
    sides: list[list[Measurement]] = []
    align = _field("align")
    if align not in contents.ALIGN:
        raise InputError("choose what to do where the points differ")
    for name, what in (("before", "a measurement before"), ("after", "a measurement after")):
        chosen = request.form.getlist(name)
        items = [item for item in state.measurements if str(item.number) in chosen]
        if not items or not all(item.used for item in items):
            raise InputError(f"choose {what} the correction")
        sides.append(items)
    machine, instrument, language = _machine_of(state), _instrument(state), _language()
    aligned = [f"--align={align}"] * bool(align)

    def task(*sides: Sequence[Measurement]) -> StepTask:
        folder = runner.project.new_folder("compare")
        certificate = [f"--dcc={path}" for path in _uploaded(runner.project, folder, "certificate")[:1]]
        files = [[file for item in side for file in item.used] for side in sides]
        kinds = [{contents.kind_of(item) for item in side} for side in sides]
        own, commands = instrument if {"sixdof"} in kinds else [], []
        if max(map(len, files)) > 1 or kinds[0] != kinds[1]:
            for side, name in zip(files, ("before", "after"), strict=True):
                words = instrument if "sixdof" in kinds[name == "after"] else []
                commands.append(["identify", machine, *side, *words, "--out", f"{folder}/{name}"])
            files, own = [[f"{folder}/before"], [f"{folder}/after"]], []
        words = ["compare", machine, files[0][0], files[1][0], *own, *aligned, "--out", folder]
        first, second = (", ".join(item.name for item in side) for side in sides)
        title = f"{first} against {second}"
        commands += [words, ["report", folder, *certificate, *language]]
        return StepTask(Step(0, "compare", title, commands, folder))

    joint = [[item for item in side if contents.kind_of(item) != "diagonals"] for side in sides]
    pairs = [([first], [second]) for first, second in contents.pairs_of(*sides)]
    if all(joint) and tuple(sides) not in pairs:
        pairs.append((joint[0], joint[1]))
    if not pairs:
        raise InputError("diagonals are compared with the same diagonals only; choose those of the other side, too")
    runner.start("comparing before and after", "after", [task(*pair) for pair in pairs])


@action("project", "recal")
def hand_over(runner: Runner, state: ProjectState) -> None:
    """Write the job file of scheduled recalibration."""
    name, control, measured = _field("name", 60), _control(), _field("measured")
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise InputError(
            "a name has letters, digits, dots and hyphens, and begins with a letter or a digit", field="name"
        )
    if measured not in ("bare", "active"):
        raise InputError("say whether the compensation is on while the machine is measured", field="measured")
    words = ["recal", "add", name, "--machine", _machine_of(state), "--inbox", "inbox", "--controller", control]
    words += ["--out", "recalibration", "--measured-with", measured, "--job", JOB]
    path, before = runner.project.path(JOB), runner.project.job_text()

    def finish(step: Step, output: str) -> Step:
        """Keep what was appended to the job file, so that it can be taken back."""
        text = read_text(path)
        added = text.removeprefix(before) if text.startswith(before) else ""
        return replace(step, data={"added": added, "machine_there": name})

    task = StepTask(Step(0, "recal", f"Recalibration of {name}", [words]), finish)
    runner.start("writing the job file", "project", [task])


@action("project", "undo")
def undo(runner: Runner, state: ProjectState) -> None:
    """Take back the last step, and say what of it stays."""
    step, stays = runner.project.undo(state.revision)
    if stays:
        runner.job = Progress(f"taken back: {step.title}", "project", ended=time.monotonic(), problems=stays)


@pages.post(f"/projects/<{_NUMBER}:number>/stop")
def stop(number: int) -> BaseResponse:
    """Stop what runs; nothing of it is kept."""
    runner = the_runner(number)
    page = runner.job.page if runner.job is not None else "project"
    runner.stop()
    runner.wait(10.0)
    return redirect(f"/projects/{number}/{page}", code=303)


# Files.


def _step(number: int, step: int) -> tuple[Project, Step]:
    project = the_runner(number).project
    found = next((item for item in project.state().steps if item.number == step), None)
    return project, found if found is not None else abort(404, "The project has no such step.")


@pages.get(f"/projects/<{_NUMBER}:number>/steps/<{_NUMBER}:step>/files/<{_NUMBER}:position>")
def download(number: int, step: int, position: int) -> Response:
    """Send one file of a step as a download."""
    project, found = _step(number, step)
    files = project.files_of(found)
    if not 1 <= position <= len(files):
        abort(404, "There is no such file.")
    name, path = list(files.items())[position - 1]
    return send_file(path, "application/octet-stream", as_attachment=True, download_name=file_name(name))


@pages.get(f"/projects/<{_NUMBER}:number>/steps/<{_NUMBER}:step>/view/<path:name>")
def view_page(number: int, step: int, name: str) -> Response:
    """Send a page that a command wrote: a file in itself, with the script that its own policy names, away from ours."""
    project, found = _step(number, step)
    path = project.pages_of(found).get(name)
    if path is None:
        abort(404, "There is no such page.")
    text = path.read_text(encoding="utf-8")
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    # of no origin: a page in a project of somebody else reaches none of ours
    policy += "; sandbox allow-scripts"
    hashes = re.findall(r"'sha256-[A-Za-z0-9+/=]{44}'", Markup(text[:3000]).unescape().partition("</head>")[0])
    response = Response(text, mimetype="text/html")
    scripts = f"; script-src {' '.join(hashes)}" if hashes else ""
    response.headers["Content-Security-Policy"] = f"{policy}; frame-ancestors 'none'{scripts}"
    return response


@pages.get(f"/projects/<{_NUMBER}:number>/steps/<{_NUMBER}:step>/print/<path:name>")
def printed_page(number: int, step: int, name: str) -> Response:
    """Send a page that a command wrote as PDF."""
    project, found = _step(number, step)
    path = project.pages_of(found).get(name)
    if path is None:
        abort(404, "There is no such page.")
    response = Response(pdf_of(path), mimetype="application/pdf")
    response.headers["Content-Disposition"] = f'attachment; filename="{path.stem}.pdf"'
    return response


@pages.get(f"/projects/<{_NUMBER}:number>/steps/<{_NUMBER}:step>/preflight.html")
def preflight(number: int, step: int) -> Response:
    """Send the preflight list with boxes to tick: one file, to print or to keep on a phone."""
    project, found = _step(number, step)
    path = project.files_of(found).get("preflight.md")
    if path is None:
        abort(404, "This step has no preflight list.")
    response = Response(preflight_page(path), mimetype="text/html")
    response.headers["Content-Security-Policy"] = (
        "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"
    )
    if request.args.get("save"):
        response.headers["Content-Disposition"] = 'attachment; filename="preflight.html"'
    return response


def preflight_page(path: Path) -> str:
    """Return the preflight list of an export as a page in one file, with a box at each thing to do."""
    box = '<input type="checkbox" aria-label="done"> '
    parts = re.split(r"(<ol[^>]*>.*?</ol>)", str(markdown(read_text(path))), flags=re.DOTALL)
    ticked = [part.replace("<li>", f'<li class="tick">{box}') if part.startswith("<ol") else part for part in parts]
    html = re.sub(r"<(/?)h([4-6])>", lambda tag: f"<{tag[1]}h{int(tag[2]) - 3}>", "".join(ticked))
    html = html.replace("<li class='check'>", f'<li class="tick">{box}')
    html = re.sub(r"<h2>(?=\d)", f'<h2 class="tick">{box}', html)
    html = html.replace("<table>", '<div class="scroll" tabindex="0"><table>').replace("</table>", "</table></div>")
    return render_template("preflight.html", body=Markup(html))


@pages.get(f"/projects/<{_NUMBER}:number>/steps/<{_NUMBER}:step>/files.zip")
def archive(number: int, step: int) -> Response:
    """Send all files of a step in one archive, with the preflight list to tick."""
    project, found = _step(number, step)
    files, content = project.files_of(found), io.BytesIO()
    if not files:
        abort(404, "This step has no files.")
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, path in files.items():
            packed.write(path, f"{found.folder}/{in_archive(name)}")
        if "preflight.md" in files:
            packed.writestr(f"{found.folder}/preflight.html", preflight_page(files["preflight.md"]))
    content.seek(0)
    return send_file(content, "application/zip", as_attachment=True, download_name=f"{found.folder}.zip")


def in_archive(name: str) -> str:
    r"""Return the path of a file in an archive, with no part that another system takes for a drive, a device or a way up.

    >>> in_archive("check/..\\..\\x.bat"), in_archive("a/NUL.txt"), in_archive("b/report.html")
    ('check/.._.._x.bat', 'a/_NUL.txt', 'b/report.html')
    """
    parts = [re.sub(r'[\\:*?"<>|\x00-\x1f\x7f]', "_", part) for part in name.split("/")]
    return "/".join(f"_{part}" if re.fullmatch(DEVICES, part.partition(".")[0]) else part for part in parts)


@pages.get(f"/projects/<{_NUMBER}:number>/commands.sh")
def commands(number: int) -> Response:
    """Send the commands of all steps as a script."""
    response = Response(the_runner(number).project.script(), mimetype="text/plain")
    response.headers["Content-Disposition"] = 'attachment; filename="commands.sh"'
    return response


# Checks of every request, error pages, the server.

SAFE = ("GET", "HEAD", "OPTIONS")
#: Pages that need no session.
OPEN = ("pages.start", "pages.asset")


def make_app(workbench: Workbench) -> Flask:
    """Return the application."""
    folder = data_folder("templates") / "_app"
    app = Flask("compgen.app", static_folder=None, template_folder=str(folder))
    app.config.update(MAX_CONTENT_LENGTH=LARGEST_UPLOAD, MAX_FORM_MEMORY_SIZE=LARGEST_FORM, MAX_FORM_PARTS=MOST_PARTS)
    app.jinja_env.autoescape = True
    app.jinja_env.undefined = StrictUndefined
    app.jinja_env.trim_blocks = app.jinja_env.lstrip_blocks = True
    app.jinja_env.filters.update(
        word=str,
        lines=str,
        drawn=lambda svg: svg,
        figure=_figure,
        unit=lambda text: LABEL.get(text, text),
        readable=_readable,
        thousands=thousands,
        um=_um,
        micro=micro if workbench.language == LANGUAGES[0] else str,
        described=describe_error,
    )
    app.jinja_env.globals.update(
        PAGES=PAGES, most=LARGEST_UPLOAD, command_line=command_line, language=workbench.language
    )
    if workbench.language != LANGUAGES[0]:
        texts = texts_of(workbench.language)
        texts.translate(app.jinja_env, html=True).filters.update(
            drawn=lambda svg: Markup(texts.drawn(svg)), lines=texts.lines
        )
    app.url_map.converters["number"] = StepNumber
    app.extensions["compgen"] = workbench
    app.before_request(_begin_request)
    app.after_request(_finish)
    app.teardown_request(lambda _: request.close())  # the temporary files of an upload
    app.context_processor(lambda: {"csrf": the_workbench().csrf})
    app.register_error_handler(HTTPException, _http_error)
    app.register_error_handler(CompgenError, _program_error)
    app.register_error_handler(Exception, _unexpected)
    app.register_blueprint(pages)
    return app


def _begin_request() -> None:
    workbench = the_workbench()
    g.session = False
    check_host(request, workbench.site)
    check_method(request)
    g.session = same(request.cookies.get(cookie_name(workbench.site, "app"), ""), workbench.session)
    if request.method not in SAFE:
        check_origin(request, workbench.site)
    if request.endpoint in OPEN:
        return
    if not g.session:
        raise Forbidden("Open the address that `volcomp app` printed; it is valid once, for one browser.")
    if request.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
        raise Forbidden("This request comes from a page of another program.")
    if request.method not in SAFE and not same(request.form.get("csrf", ""), workbench.csrf):
        raise Forbidden("The form does not belong to this session; reload the page.")


def _finish(response: Response) -> Response:
    if the_workbench().units != UNITS[0] and response.mimetype == "text/html" and not response.direct_passthrough:
        response.set_data(page_in_inch(response.get_data(as_text=True)))
    policy = response.headers.get("Content-Security-Policy", POLICY)
    for name, value in {**HEADERS, "Content-Security-Policy": policy}.items():
        response.headers[name] = value
    return response


def _http_error(error: HTTPException) -> Response | HTTPException:
    code = error.code or 500
    if code < 400:
        return error
    text = error.description or ""
    if code == 413:
        text = f"These files are too large: at most {LARGEST_UPLOAD // 1_000_000} MB at once."
    page = render_template("error.html", title=error.name, text=text, number=0)
    return error_response(page, error)


def _program_error(error: CompgenError) -> tuple[str, int]:
    return render_template("error.html", title="Not done", text=str(error), number=0), 409


def _report_fault(error: Exception) -> None:
    place = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(place.filename).name}:{place.lineno}"
    print(visible(f"error: internal error: {type(error).__name__}: {error} ({where})", flat=True), file=sys.stderr)


def _unexpected(error: Exception) -> tuple[str, int]:
    _report_fault(error)
    text = "This is a bug in the program; the terminal shows where. What was shown as saved is saved."
    return render_template("error.html", title="Internal error", text=text, number=0), 500


def _um(value: Any, u_um: Any = None) -> str:
    """A figure in um with the digits that its expanded uncertainty leaves; as in the report."""
    text = number_text(value, 2) if not isinstance(u_um, int | float) else um_text(value, u_um=u_um)
    return text.replace("-", "\N{MINUS SIGN}")


def _figure(value: Any, digits: int = 3) -> str:
    """Return a number with significant digits, a dash if it is unknown."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return "\N{EN DASH}"
    if 0.0 < abs(value) < 1e-3:
        return "< 0.001"
    text = f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    return text.replace("-", "\N{MINUS SIGN}")


def _readable(value: Any) -> str:
    """Return a fact of a file on one line."""
    if isinstance(value, float):
        return _figure(value, 6)
    if isinstance(value, list | tuple):
        return ", ".join(_readable(item) for item in value)
    if isinstance(value, dict):
        return "; ".join(f"{key}: {_readable(item)}" for key, item in value.items())
    return "\N{EN DASH}" if value is None else str(value)


def make_server(workbench: Workbench) -> Any:
    """Return a server on 127.0.0.1; connections that send their request slowly do not keep others out."""
    import waitress  # type: ignore[import-untyped]  # shipped without type information

    def stranger(cookies: str) -> bool:
        given = (part.strip() for part in cookies.split(";"))
        own = f"{cookie_name(workbench.site, 'app')}={workbench.session}"
        return not any(same(part, own) for part in given)

    port = workbench.site.port
    try:
        server = waitress.create_server(
            make_app(workbench), host="127.0.0.1", port=port, threads=8, ident=None, connection_limit=300,
            max_request_body_size=LARGEST_UPLOAD, asyncore_use_poll=True, channel_timeout=60,
        )  # fmt: skip
    except OSError as error:
        raise InputError(f"port {port} cannot be used: {error.strerror or error}", field="--port") from error
    return bounded(server, small_for(stranger, LARGEST_BODY))


#: A browser that is a snap reads neither the folder for temporary files nor hidden ones in the user's own.
SNAPS = Path("/snap/bin")


@contextlib.contextmanager
def start_file(workbench: Workbench, address: str) -> Iterator[str]:
    """Yield the address of a private file that leads the browser to ``address``, whose token no other user may see.

    Everybody on a computer may read the command line of a browser. The file is removed when the token has been used.
    """
    visible = Path.home() if SNAPS.is_dir() and os.access(Path.home(), os.W_OK) else None
    with working_folder("start-", visible) as folder:
        workbench.first_page = write_file(folder / "volcomp.html", leading_to(f"{address}&from=file"), private=True)
        yield workbench.first_page.as_uri()


def serve(
    folder: Path | None,
    port: int,
    announce: Callable[[str], None],
    *,
    keep_open: bool = False,
    language: str = LANGUAGES[0],
    units: str = UNITS[0],
    browse: Callable[[str], object] | None = None,
) -> None:
    """Serve on this computer until the last page is closed, or Ctrl-C.

    ``announce`` receives the first address, which is a secret until it has been used; ``browse`` what a browser may be
    called with.

    Raises
    ------
    InputError
        for a folder that cannot be a project, and a port in use.
    """
    import _thread

    workbench = Workbench(LocalSite(port), language, units)
    if folder is not None:
        workbench.open(folder)
    server = make_server(workbench)
    workbench.site = LocalSite(int(server.effective_port))

    def watch() -> None:
        while True:
            time.sleep(0.5)
            if workbench.open_pages.over() and not any(runner.busy for runner in workbench.projects):
                _thread.interrupt_main()
                return

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if not keep_open:
        threading.Thread(target=watch, daemon=True).start()
    address = f"http://127.0.0.1:{server.effective_port}/start?token={workbench.ticket}"
    announce(address)
    try:
        with start_file(workbench, address) if browse else contextlib.nullcontext("") as page:
            if browse:
                browse(page)
            server.run()
    except KeyboardInterrupt:
        pass
    finally:
        server.close()
        workbench.close()
