"""Texts of tables through Jinja2: the format of a control, templates of the user, checks of plug-ins."""

from __future__ import annotations

import ctypes
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any

from jinja2 import (
    ChoiceLoader,
    FileSystemBytecodeCache,
    FileSystemLoader,
    StrictUndefined,
    TemplateError,
    TemplateSyntaxError,
)
from jinja2.bccache import Bucket
from jinja2.runtime import Context
from jinja2.sandbox import ImmutableSandboxedEnvironment

from compgen.controls import CONTROLLERS
from compgen.data import toml_files
from compgen.data.csv_files import fixed
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERRORS
from compgen.errors import InputError, one_line
from compgen.resources import LANGUAGES, cache_folder, data_folder

# Controller files through Jinja2: strict about missing values, sandboxed; text of a user is never executed.


#: Files that are written together with those of the control.
OWN_FILES = ("manifest.json", "preflight.md", "result.json", "explain.md")
#: Longest time that one template may take, s, and most characters that it may write or keep in one text.
LONGEST_S, MOST_CHARACTERS = 60.0, 400_000_000
#: Largest whole number that a template may calculate, bits.
MOST_BITS = 10_000


class EndlessTemplateError(Exception):
    """A template takes too long or becomes too large; templates of users may contain any loop."""

    def __init__(self, message: str = "it takes too long: does a loop end?") -> None:
        super().__init__(message)


#: What a wrong template may raise: Jinja's errors, and those of its expressions.
_TEMPLATE_FAULTS = (
    TemplateError,
    TypeError,
    ValueError,
    ArithmeticError,
    LookupError,
    AttributeError,
    RecursionError,
    UnicodeError,
    EndlessTemplateError,
)


@dataclass(frozen=True)
class FileSpec:
    """One file of a format: its template, its name, and its line end.

    A file with a ``variant`` is written only if the control's context has ``container = <variant>``.
    """

    template: str
    name: str
    line_end: str
    variant: str = ""


@dataclass(frozen=True)
class Format:
    """The card of a control's format, from ``templates/<name>/format.toml``.

    ``evidence`` is ``"documented"`` or ``"unverified"``; ``unverified`` lists what no public document settles.
    ``settings`` describes the keys of ``[controllers.<name>]`` that the control does not declare.
    """

    name: str
    title: str
    summary: str
    expresses: str
    evidence: str
    files: tuple[FileSpec, ...]
    limits: tuple[str, ...]
    unverified: tuple[str, ...]
    sources: tuple[str, ...]
    settings: Mapping[str, str] = field(default_factory=dict)


def _texts(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ValueError("expected a list of texts")
    return tuple(" ".join(item.split()) for item in value)


def _prose(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("expected a text")
    return " ".join(value.split())


def template_folders(name: str, folder: Path | None = None) -> list[Path]:
    """Return where templates of control ``name`` are searched: the user's, those of its plug-in, the shipped ones."""
    own = CONTROLLERS.templates(name)
    return [*([folder] if folder else []), *([own] if own else []), data_folder("templates")]


def check_templates(name: str, folder: Path) -> None:
    """Check what a plug-in's control brings below ``folder``: the card, every template it lists, their syntax."""
    card = _read_format(folder / name / "format.toml", name)
    environment = _environment((folder, data_folder("templates")))
    for template in (*(spec.template for spec in card.files), "preflight.md.j2"):
        path = folder / name / template
        if not path.is_file():
            raise InputError("is missing", file=path)
        try:
            environment.get_template(f"{name}/{template}")
        except TemplateSyntaxError as error:
            raise InputError(f"is not a valid template: {one_line(error)}", file=path, line=error.lineno) from error


def load_format(name: str, folder: Path | None = None) -> Format:
    """Load the card of format ``name`` from ``folder`` (the user's templates), otherwise from the shipped ones."""
    if folder is not None and not folder.is_dir():
        raise InputError("no such folder; --templates needs a folder with a sub-folder per control", file=folder)
    for base in template_folders(name, folder):
        path = base / name / "format.toml"
        if path.is_file():
            state = path.stat()
            return _known_format(path, name, (state.st_mtime_ns, state.st_size))
    raise InputError(f"no format.toml for {name!r} in {folder or data_folder('templates')}")


def _named(expected: str) -> Callable[[Any], str]:
    def check(value: Any) -> str:
        if value != expected:
            raise ValueError(f"expected the name of the control, {expected!r}")
        return expected

    return check


def _file_name(value: Any) -> str:
    """Return a plain name of an output file: no folder, none of the names that compgen writes itself."""
    name = toml_files.text(value)
    if PurePath(name).name != name or "\\" in name or name.startswith(".") or name.lower() in OWN_FILES:
        raise ValueError(f"expected a plain file name without folder, other than {', '.join(OWN_FILES)}")
    return name


@lru_cache(maxsize=64)
def _known_format(path: Path, name: str, _state: tuple[int, int]) -> Format:
    """Read a card once, until time or size of its file change: every run needs the cards of all controls."""
    return _read_format(path, name)


def _read_format(path: Path, name: str) -> Format:
    root = toml_files.read_toml(path)
    files = []
    for section in root.sections("files"):
        spec = FileSpec(
            template=section.take("template", toml_files.text),
            name=section.take("name", _file_name),
            line_end={"lf": "\n", "crlf": "\r\n"}[section.take("line_end", toml_files.choice("lf", "crlf"), "lf")],
            variant=section.take("variant", toml_files.text, ""),
        )
        section.finish()
        files.append(spec)
    meanings = root.section("settings", required=False)
    card = Format(
        name=root.take("name", _named(name)),
        title=root.take("title", toml_files.text),
        summary=root.take("summary", _prose),
        expresses=root.take("expresses", _prose),
        evidence=root.take("evidence", toml_files.choice("documented", "unverified")),
        files=tuple(files),
        limits=root.take("limits", _texts),
        unverified=root.take("unverified", _texts, ()),
        sources=root.take("sources", _texts),
        settings={key: meanings.take(key, _prose) for key in meanings.data},
    )
    root.finish()
    if not files or len({spec.name.lower() for spec in files}) != len(files):
        raise root.fail("files", "expected at least one [[files]], each with its own name")
    return card


class _Bounded(ImmutableSandboxedEnvironment):
    """A sandbox that limits the size of products and powers, of texts and of numbers."""

    intercepted_binops = frozenset({"*", "**"})

    def call_binop(self, context: Context, operator: str, left: Any, right: Any) -> Any:
        """Calculate, unless the result would take too long or not fit into memory."""
        sizes = [len(item) for item in (left, right) if isinstance(item, str | bytes | list | tuple)]
        factors = [item for item in (left, right) if isinstance(item, int)]
        if operator == "*" and sizes and factors and sizes[0] * abs(factors[0]) > MOST_CHARACTERS:
            raise EndlessTemplateError(f"a text of more than {MOST_CHARACTERS} characters")
        if len(factors) == 2:
            bits = [abs(item).bit_length() for item in factors]
            if (sum(bits) if operator == "*" else bits[0] * abs(factors[1])) > MOST_BITS:
                raise EndlessTemplateError(f"a number of more than {MOST_BITS} bits")
        return super().call_binop(context, operator, left, right)


class KeptTemplates(FileSystemBytecodeCache):
    """Compiled templates of an environment in the user's cache folder; compiling them takes as long as a verification.

    Jinja compares the text of a template with that of the compiled one. Environments have a ``kind`` each, because options
    are part of what is compiled; constants are not evaluated before (``optimized = False``), because filters may change.
    Where nothing can be written, templates are compiled every time.
    """

    def __init__(self, kind: str) -> None:
        with suppress(OSError, RuntimeError):  # no permission; no home
            folder = cache_folder("templates")
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            super().__init__(str(folder), f"{kind}-%s.cache")

    def load_bytecode(self, bucket: Bucket) -> None:
        """Take what is kept."""
        with suppress(OSError, AttributeError):  # no folder: no attribute
            super().load_bytecode(bucket)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep what was compiled."""
        with suppress(OSError, AttributeError):
            super().dump_bytecode(bucket)


@lru_cache(maxsize=32)
def _environment(folders: tuple[Path, ...], language: str = LANGUAGES[0]) -> ImmutableSandboxedEnvironment:
    """Return the environment of some folders; it is cached with its compiled templates, and changed ones are read again."""
    environment = _Bounded(
        loader=ChoiceLoader([FileSystemLoader(folder) for folder in folders]),
        undefined=StrictUndefined,
        autoescape=False,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
        optimized=False,
        bytecode_cache=KeptTemplates("tables" if language == LANGUAGES[0] else f"tables-{language}")
        if folders == (data_folder("templates"),)
        else None,  # not those of users
    )
    environment.filters["fixed"] = lambda value, digits: fixed(float(value), digits)
    environment.filters["plain"] = lambda value: one_line(value)
    environment.filters |= {"word": str, "name": str}
    if language != LANGUAGES[0]:
        from compgen.language import texts_of

        texts_of(language).translate(environment, html=False)
    return environment


def _inert(value: Any) -> Any:
    """Make text of a user one line of printable ASCII; containers are converted item by item."""
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, Mapping):
        return {key: _inert(item) for key, item in value.items()}
    if isinstance(value, list | tuple):  # tables have thousands of numbers
        return [item if type(item) is float or type(item) is int else _inert(item) for item in value]
    return value


def render(
    card: Format,
    template: str,
    context: Mapping[str, Any],
    folder: Path | None = None,
    language: str = LANGUAGES[0],
) -> str:
    """Render one template of a format.

    Parameters
    ----------
    card : the format.
    template : file name below the format's folder.
    context : values; texts are flattened to one line of printable ASCII before they reach the template.
    folder : a user's templates folder, searched before the shipped one.
    language : of a list for the reader; files for a control are never translated.
    """
    folders = template_folders(card.name, folder)
    try:
        page = _environment(tuple(folders), language).get_template(f"{card.name}/{template}")
        with _ended_after(LONGEST_S):
            # An endless template is stopped as soon as its output is too long.
            parts = page.generate({**{key: _inert(value) for key, value in context.items()}, "format": card})
            kept, size = [], 0
            for part in parts:
                kept.append(part)
                size += len(part)
                if size > MOST_CHARACTERS:
                    raise EndlessTemplateError(f"it writes more than {MOST_CHARACTERS} characters: does a loop end?")
            text = "".join(kept)
    except _TEMPLATE_FAULTS as error:
        file, line = _place(error, folders)
        message = f"the template cannot be rendered: {one_line(error)}"
        raise InputError(message, file=file or f"templates/{card.name}/{template}", line=line) from error
    if language != LANGUAGES[0]:
        from compgen.language import wrapped

        text = wrapped(text)
    return text


@contextmanager
def _ended_after(seconds: float) -> Iterator[None]:
    """Raise EndlessTemplateError in this thread if the block takes longer.

    A loop that writes nothing cannot be stopped from within; another thread can interrupt the interpreter.
    """
    thread, lock, over, struck = ctypes.c_ulong(threading.get_ident()), threading.Lock(), False, False

    def strike() -> None:
        nonlocal struck
        with lock:
            if not over:
                struck = True
                ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, ctypes.py_object(EndlessTemplateError))

    timer = threading.Timer(seconds, strike)
    timer.daemon = True
    timer.start()
    try:
        yield
    except EndlessTemplateError:
        struck = False  # it has arrived
        raise
    finally:
        with lock:
            over = True
            if struck:  # it may still be pending: withdraw it
                # Only if needed: in CPython 3.11 a thread without a pending exception then checks for one at every
                # call, and hangs if its calls are traced (coverage, debuggers).
                ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, None)
        timer.cancel()


def _place(error: Exception, folders: Sequence[Path]) -> tuple[str | None, int | None]:
    """Return template file and line of an error: Jinja gives both in syntax errors, and rewrites tracebacks for the rest."""
    if isinstance(error, TemplateSyntaxError):
        return error.filename, error.lineno
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if any(Path(frame.filename).is_relative_to(folder) for folder in folders):
            return frame.filename, frame.lineno
    return None, None


def render_files(card: Format, context: Mapping[str, Any], folder: Path | None = None) -> dict[str, str]:
    """Render every file of a format and return the texts by file name, with the format's line ends."""
    texts = {}
    for spec in card.files:
        if spec.variant and spec.variant != context.get("container"):
            continue
        text = render(card, spec.template, context, folder)
        texts[spec.name] = text.replace("\n", spec.line_end) if spec.line_end != "\n" else text
    return texts


# Files that templates of the user add to those of a control: for controls whose format is not public.
#
# Some volumetric compensations (SINUMERIK VCS) have no public file format. A user who knows the format puts a template
# ``<templates>/<control>/companion/<file name>.j2`` into a folder of templates; it gets the 21 errors as ``errors21``
# in addition to everything that the templates of the control get. Such a file is written and listed with its SHA-256,
# but it cannot be read back: only the files of the control are verified.


FOLDER, SUFFIX, CRLF_SUFFIX = "companion", ".j2", ".crlf.j2"


def errors_context(machine: Machine, errors: ErrorTable) -> list[dict[str, Any]]:
    """Return all 21 errors in the order of ISO 230-1's names, in the conventions of the program.

    Each has ``name``, ``kind`` (linear, angular, squareness), ``axis`` (X, Y, Z, or "" for a squareness), ``unit`` (mm
    or rad), ``position_mm`` and ``value`` (lists of one length; a squareness has no position and one value) and
    ``known``: an error that the input does not contain is zero.
    """
    return [_error(machine, errors, item.name, item.kind, item.axis) for item in ERRORS]


def _error(machine: Machine, errors: ErrorTable, name: str, kind: str, axis: int) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": name, "kind": kind, "unit": "mm" if kind == "linear" else "rad"}
    if kind == "squareness":
        known = name in errors.squareness
        value = [errors.squareness[name][0] if known else 0.0]
        return {**entry, "axis": "", "position_mm": [], "value": value, "known": known}
    curve = errors.curves.get(name)
    position = machine.axes[axis].nodes_mm if curve is None else curve.position_mm
    values = [0.0] * len(position) if curve is None else [float(value) for value in curve.value]
    where = [float(value) for value in position]
    return {**entry, "axis": AXES[axis], "position_mm": where, "value": values, "known": curve is not None}


def companion_files(
    card: Format, context: Mapping[str, Any], taken: Mapping[str, str], folder: Path | None
) -> dict[str, str]:
    """Render the templates ``<folder>/<control>/companion/*.j2`` and return the texts by file name.

    Parameters
    ----------
    card : format of the control.
    context : the variables of the templates.
    taken : files of the control, whose names are reserved.
    folder : the user's templates, or None.

    Raises
    ------
    InputError
        for a template that cannot be rendered, and a file name that is taken.
    """
    found: dict[str, str] = {}
    if folder is None:
        return found
    for path in sorted((folder / card.name / FOLDER).glob(f"*{SUFFIX}")):
        crlf = path.name.endswith(CRLF_SUFFIX)
        name = path.name.removesuffix(CRLF_SUFFIX if crlf else SUFFIX)
        if not name or name.startswith(".") or name.lower() in {*OWN_FILES, *map(str.lower, (*taken, *found))}:
            raise InputError(f"{name!r} is a reserved file name; name the template <file name>{SUFFIX}", file=path)
        text = render(card, f"{FOLDER}/{path.name}", context, folder)
        found[name] = text.replace("\n", "\r\n") if crlf else text
    return found
