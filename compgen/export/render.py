"""Controller files through Jinja2: strict about missing values, sandboxed, nothing of a user's text is executed."""

from __future__ import annotations

import ctypes
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path, PurePath
from typing import Any

from jinja2 import ChoiceLoader, FileSystemLoader, StrictUndefined, TemplateError, TemplateSyntaxError
from jinja2.runtime import Context
from jinja2.sandbox import ImmutableSandboxedEnvironment

from compgen.controllers import CONTROLLERS
from compgen.core import tomlio
from compgen.core.csvio import fixed
from compgen.core.text import one_line
from compgen.errors import InputError
from compgen.resources import data_folder

#: Files that are written beside those of the control.
OWN_FILES = ("manifest.json", "preflight.md", "result.json", "explain.md")
#: Longest time that one template may take, s, and most characters that it may write or hold in one text.
LONGEST_S, MOST_CHARACTERS = 60.0, 400_000_000
#: Largest whole number that a template may calculate, bits.
MOST_BITS = 10_000


class EndlessTemplateError(Exception):
    """A template takes too long or becomes too large; those of users may hold any loop."""

    def __init__(self, message: str = "it takes too long: does a loop end?") -> None:
        super().__init__(message)


#: What a wrong template may raise: Jinja's own errors, and those of the expressions in it.
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

    A file with a ``variant`` is written only where the control's context says ``container = <variant>``.
    """

    template: str
    name: str
    line_end: str
    variant: str = ""


@dataclass(frozen=True)
class Format:
    """The card of a control's format as ``templates/<name>/format.toml`` has it.

    ``evidence`` is ``"documented"`` or ``"unverified"``; ``unverified`` lists what no public document settles.
    ``settings`` says what each key of ``[controllers.<name>]`` means; ``example_settings`` are some that the control
    takes, where keys have no default.
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
    example_settings: Mapping[str, Any] = field(default_factory=dict)


def _texts(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ValueError("a list of texts is expected")
    return tuple(" ".join(item.split()) for item in value)


def _prose(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("a text is expected")
    return " ".join(value.split())


def template_folders(name: str, folder: Path | None = None) -> list[Path]:
    """Return where the templates of control ``name`` are looked for: the user's, a plug-in's own, the shipped ones."""
    own = CONTROLLERS[name].templates if name in CONTROLLERS else None
    return [*([folder] if folder else []), *([own] if own else []), data_folder("templates")]


def check_templates(name: str, folder: Path) -> None:
    """Check what a plug-in's control brings below ``folder``: the card, every template that it names, their syntax."""
    card = _read_format(folder / name / "format.toml", name)
    environment = _environment([folder, data_folder("templates")])
    for template in (*(spec.template for spec in card.files), "preflight.md.j2"):
        path = folder / name / template
        if not path.is_file():
            raise InputError("is missing", file=path)
        try:
            environment.get_template(f"{name}/{template}")
        except TemplateSyntaxError as error:
            raise InputError(f"is no template: {one_line(error)}", file=path, line=error.lineno) from error


def load_format(name: str, folder: Path | None = None) -> Format:
    """Load the card of format ``name`` from ``folder`` (the user's templates), else from the shipped ones."""
    if folder is not None and not folder.is_dir():
        raise InputError("no such folder; --templates needs a folder with a sub-folder per control", file=folder)
    for base in template_folders(name, folder):
        path = base / name / "format.toml"
        if path.is_file():
            return _read_format(path, name)
    raise InputError(f"no format.toml for {name!r} in {folder or data_folder('templates')}")


def _meanings(section: tomlio.Section) -> dict[str, str]:
    return {key: section.take(key, _prose) for key in section.data}


def _named(expected: str) -> Callable[[Any], str]:
    def check(value: Any) -> str:
        if value != expected:
            raise ValueError(f"the name of the control, {expected!r}, is expected")
        return expected

    return check


def _file_name(value: Any) -> str:
    """A plain name of an output file: no folder, none of the names that compgen writes itself."""
    name = tomlio.text(value)
    if PurePath(name).name != name or "\\" in name or name.startswith(".") or name.lower() in OWN_FILES:
        raise ValueError(f"a plain file name without folder, other than {', '.join(OWN_FILES)}, is expected")
    return name


def _read_format(path: Path, name: str) -> Format:
    root = tomlio.read_toml(path)
    files = []
    for section in root.sections("files"):
        spec = FileSpec(
            template=section.take("template", tomlio.text),
            name=section.take("name", _file_name),
            line_end={"lf": "\n", "crlf": "\r\n"}[section.take("line_end", tomlio.choice("lf", "crlf"), "lf")],
            variant=section.take("variant", tomlio.text, ""),
        )
        section.finish()
        files.append(spec)
    card = Format(
        name=root.take("name", _named(name)),
        title=root.take("title", tomlio.text),
        summary=root.take("summary", _prose),
        expresses=root.take("expresses", _prose),
        evidence=root.take("evidence", tomlio.choice("documented", "unverified")),
        files=tuple(files),
        limits=root.take("limits", _texts),
        unverified=root.take("unverified", _texts, ()),
        sources=root.take("sources", _texts),
        settings=_meanings(root.section("settings", required=False)),
        example_settings=root.take("example_settings", tomlio.table, {}),
    )
    root.finish()
    if not files or len({spec.name.lower() for spec in files}) != len(files):
        raise root.fail("files", "at least one [[files]] is due, each with a name of its own")
    return card


class _Bounded(ImmutableSandboxedEnvironment):
    """A sandbox in which no product or power is larger than a text or a number can sensibly be."""

    intercepted_binops = frozenset({"*", "**"})

    def call_binop(self, context: Context, operator: str, left: Any, right: Any) -> Any:
        """Calculate, unless the result would not end or fit into the memory."""
        sizes = [len(item) for item in (left, right) if isinstance(item, str | bytes | list | tuple)]
        factors = [item for item in (left, right) if isinstance(item, int)]
        if operator == "*" and sizes and factors and sizes[0] * abs(factors[0]) > MOST_CHARACTERS:
            raise EndlessTemplateError(f"a text of more than {MOST_CHARACTERS} characters")
        if len(factors) == 2:
            bits = [abs(item).bit_length() for item in factors]
            if (sum(bits) if operator == "*" else bits[0] * abs(factors[1])) > MOST_BITS:
                raise EndlessTemplateError(f"a number of more than {MOST_BITS} bits")
        return super().call_binop(context, operator, left, right)


def _environment(folders: Sequence[Path]) -> ImmutableSandboxedEnvironment:
    environment = _Bounded(
        loader=ChoiceLoader([FileSystemLoader(folder) for folder in folders]),
        undefined=StrictUndefined,
        autoescape=False,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["fixed"] = _fixed_filter
    environment.filters["plain"] = lambda value: one_line(value)
    return environment


def _fixed_filter(value: float | Decimal, digits: int) -> str:
    return fixed(float(value), digits)


def _inert(value: Any) -> Any:
    """Text of a user becomes one line of printable ASCII; containers are passed through item by item."""
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, Mapping):
        return {key: _inert(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_inert(item) for item in value]
    return value


def render(card: Format, template: str, context: Mapping[str, Any], folder: Path | None = None) -> str:
    """Render one template of a format.

    Parameters
    ----------
    card : the format.
    template : file name below the format's folder.
    context : values; texts are flattened to one line of printable ASCII before they reach the template.
    folder : a user's templates folder, searched before the shipped one.
    """
    folders = template_folders(card.name, folder)
    try:
        page = _environment(folders).get_template(f"{card.name}/{template}")
        with _ended_after(LONGEST_S):
            return _joined(page.generate({**{key: _inert(value) for key, value in context.items()}, "format": card}))
    except _TEMPLATE_FAULTS as error:
        file, line = _place(error, folders)
        message = f"the template cannot be rendered: {one_line(error)}"
        raise InputError(message, file=file or f"templates/{card.name}/{template}", line=line) from error


def _joined(parts: Iterable[str]) -> str:
    """Return the text of a page; EndlessTemplateError as soon as it is too long."""
    kept, size = [], 0
    for part in parts:
        kept.append(part)
        size += len(part)
        if size > MOST_CHARACTERS:
            raise EndlessTemplateError(f"it writes more than {MOST_CHARACTERS} characters: does a loop end?")
    return "".join(kept)


@contextmanager
def _ended_after(seconds: float) -> Iterator[None]:
    """Raise EndlessTemplateError in this thread, wherever it is, if the block takes longer.

    A loop that writes nothing cannot be asked to stop; the interpreter can be, from another thread.
    """
    thread, lock, over = ctypes.c_ulong(threading.get_ident()), threading.Lock(), False

    def strike() -> None:
        with lock:
            if not over:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, ctypes.py_object(EndlessTemplateError))

    timer = threading.Timer(seconds, strike)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        with lock:
            over = True
            ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, None)
        timer.cancel()


def _place(error: Exception, folders: Sequence[Path]) -> tuple[str | None, int | None]:
    """Template file and line of an error: Jinja gives both in syntax errors, and rewrites tracebacks for the rest."""
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
