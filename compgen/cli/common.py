"""What the program and all commands share: exit codes, messages, JSON. Light: ``volcomp --help`` loads this module."""

from __future__ import annotations

import functools
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import click

from compgen.cli.output import VERBOSE, print_json
from compgen.data.names import AXES
from compgen.errors import CompgenError, CompgenWarning, InputError, Message, message_of, messages_of
from compgen.resources import LANGUAGES
from compgen.units import UNITS

Command = TypeVar("Command", bound=Callable[..., Any])
File = TypeVar("File", str, str | bytes)

#: In bash, compgen is a builtin that prints nothing; hence the second name of the program.
PROGRAM_NAMES = ("compgen", "volcomp")
#: Exit codes outside the contract, as shells use them; they say nothing about a result.
STOPPED, READER_GONE = 130, 141


class FiniteNumber(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.4 on
    """A finite number: zero, or within the range of numbers in files."""

    name = "float"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number; anything else is wrong usage."""
        from compgen.data import toml_files

        try:
            return toml_files.number(float(value))
        except ValueError as error:
            what = error if str(error).startswith("expected a finite") else "expected a number"
            self.fail(f"{value!r}: {what}", param, ctx)


NUMBER = FiniteNumber()
PATH = click.Path(path_type=Path)


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object to stdout, nothing else.")
out_option = click.option("--out", required=True, metavar="DIR", type=PATH, help="Folder for the results.")


def _complain(text: str, style: str) -> None:
    from compgen.cli.terminal import complain

    complain(text, style)


def run_command(group: click.Group, arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code of the contract; never show a traceback for bad input."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", CompgenWarning)
        said = set[str]()  # a step that is made twice, to fit and to judge, warns once

        def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
            if issubclass(category, CompgenWarning) and str(message) not in said:
                said.add(str(message))
                _complain(
                    Message("warning", "warning: {message}", message=message_of(message) or str(message)), "yellow"
                )

        warnings.showwarning = show
        try:
            called = Path(sys.argv[0]).name
            name = called if called in PROGRAM_NAMES else PROGRAM_NAMES[0]
            code = group.main(words, prog_name=name, standalone_mode=False)
            return code if isinstance(code, int) else 0
        except click.exceptions.Exit as error:
            return error.exit_code
        except click.ClickException as error:
            context = getattr(error, "ctx", None)
            if isinstance(error, getattr(click.exceptions, "NoArgsIsHelpError", ())):  # click 8.2 and later
                error.show()
                return 2
            # like click, with the command that shows help
            hint = f"; see '{context.command_path} --help'" if context is not None else ""
            return _fail(error.format_message().rstrip(".") + hint, 2, words)
        except (click.Abort, KeyboardInterrupt):
            click.echo("stopped", err=True)
            return STOPPED
        except SystemExit as error:  # click and rich leave with 1 when the reader of a pipe has gone; completion with 0
            return READER_GONE if error.code else 0
        except CompgenError as error:
            return _fail(message_of(error) or str(error), error.exit_code, words)
        except MemoryError:
            return _fail("not enough memory for this input", 3, words)
        except Exception as error:  # last resort: exit code 3 of the contract
            if os.environ.get("COMPGEN_TRACEBACK") or {"-v", "--verbose"} & set(words):
                traceback.print_exc()
            place = traceback.extract_tb(error.__traceback__)[-1]
            text = f"internal error: {type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
            return _fail(f"{text}; -v shows more", 3, words)
        finally:
            if terminal := sys.modules.get("compgen.cli.terminal"):
                terminal.speak(LANGUAGES[0])
                terminal.measure_in(UNITS[0])


def _fail(message: str, code: int, words: Sequence[str]) -> int:
    _complain(Message("error", "error: {message}", message=message), "red")
    if "--json" in words:
        print_json({"error": message, "exit_code": code, **messages_of([message])})
    return code


def load_for(context: click.Context, paths: Sequence[Path] = (), *, installed: bool = False) -> None:
    """Load plug-ins for one command and unload them when it ends."""
    from compgen.plugins import KINDS, load_plugins
    from compgen.registry import restored

    with restored(KINDS, only_after_errors=True):
        context.find_root().with_resource(restored(KINDS))
        load_plugins(paths, installed=installed)


def _load(context: click.Context, parameter: click.Parameter, paths: tuple[Path, ...]) -> None:
    if paths:
        load_for(context, paths)


#: ``--plugin PATH`` before the command or among its options; the plug-ins are loaded before anything else is read.
plugin_option: Callable[[Any], Any] = click.option(
    "--plugin",
    multiple=True,
    metavar="PATH",
    type=click.Path(path_type=Path),
    envvar="COMPGEN_PLUGINS",
    show_envvar=True,
    is_eager=True,
    expose_value=False,
    callback=_load,
    help="Plug-in to load: a .py file or a package folder with controls, effects, instruments "
    "(may be given several times).",
)


def _set_output(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    """Take -q and -v at once, for all that follows."""
    if not value or context.resilient_parsing:
        return
    if parameter.name == "verbose":
        context.meta[VERBOSE] = True
    else:
        from compgen.cli.terminal import stdout

        stdout.quiet = True
        context.find_root().call_on_close(functools.partial(setattr, stdout, "quiet", False))


def output_options(command: Any) -> Any:
    """Add -q and -v, before the command or among its options; they are in force before anything else is read."""
    how: dict[str, Any] = {"is_flag": True, "expose_value": False, "is_eager": True, "callback": _set_output}
    text = "Print no result, only warnings and errors; files and the exit code are the same."
    command = click.option("-q", "--quiet", help=text, **how)(command)
    text = "Print each step with the time since the start to stderr, and where an internal error occurred."
    return click.option("-v", "--verbose", help=text, **how)(command)


def _set_language(context: click.Context, parameter: click.Parameter, value: str) -> str:
    """Print in the language of the command at once, also what is wrong with its other words."""
    if value != LANGUAGES[0] and not context.resilient_parsing:
        from compgen.cli.terminal import speak

        speak(value)
    return value


_LANGUAGE: dict[str, Any] = {"type": click.Choice(LANGUAGES), "default": LANGUAGES[0], "callback": _set_language}
_PAGES = (
    "Language of messages, pages and lists for the reader (default en); files for a control and JSON stay in English."
)
language_option = click.option("--language", is_eager=True, help=_PAGES, **_LANGUAGE)


#: Key in the context of a command for the units of what it shows.
SHOWN_UNITS = "compgen.units"


def _set_units(context: click.Context, parameter: click.Parameter, value: str) -> None:
    """Show tables and messages in these units at once; pages ask :func:`shown_units`."""
    if context.resilient_parsing:
        return
    context.meta[SHOWN_UNITS] = value
    if value != UNITS[0]:
        from compgen.cli.terminal import measure_in

        measure_in(value)


units_option = click.option(
    "--units", is_eager=True, expose_value=False, type=click.Choice(UNITS), default=UNITS[0], callback=_set_units,
    help="Units of messages, tables and pages (default mm); inch: inch, 0.0001 inch, arcsec. Files and JSON keep mm, um, urad.",
)  # fmt: skip


def shown_units() -> str:
    """Return the units of what the running command shows; those of the program outside of a command."""
    context = click.get_current_context(silent=True)
    return UNITS[0] if context is None else str(context.meta.get(SHOWN_UNITS, UNITS[0]))


def page_shown(html: str) -> str:
    """Return a finished page in the units of the running command."""
    if shown_units() == UNITS[0]:
        return html
    from compgen.drawing.page_units import page_in_inch

    return page_in_inch(html)


class GroupedCommand(click.Command):
    """A command with many options: its help lists them under headings.

    ``groups`` gives, by heading, what the names of the parameters begin with; the first that fits counts, others come last.
    """

    groups: ClassVar[Mapping[str, Sequence[str]]] = {}

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, each group under its heading."""
        found: dict[str, list[tuple[str, str]]] = {heading: [] for heading in [*self.groups, "Other options"]}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            name = str(parameter.name)
            heading = next(
                (key for key, begin in self.groups.items() if name.startswith(tuple(begin))), "Other options"
            )
            found[heading].append(record)
        for heading, records in found.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)


def with_language(command: click.Command) -> click.Command:
    """Add ``--units``, and ``--language`` for the messages of a command that does not take it for its pages."""
    if isinstance(command, click.Group):
        return command
    command = units_option(command)
    if any(item.name == "language" for item in command.params):
        return command
    text = "Language of messages (default en); files and JSON stay in English."
    return click.option("--language", is_eager=True, expose_value=False, help=text, **_LANGUAGE)(command)


def for_readers(files: Mapping[str, File], language: str) -> dict[str, File]:
    """Return files with the pages and lists for people (``*.html``, ``*.md``) in a language, pages in the units of the command.

    The others are not changed.
    """
    made = dict(files)
    if language != LANGUAGES[0]:
        from compgen.language import texts_of, wrapped

        texts = texts_of(language)
        for name, content in files.items():
            if isinstance(content, str) and name.endswith(".html"):
                made[name] = texts.page(content)
            elif isinstance(content, str) and name.endswith(".md"):
                made[name] = wrapped(texts.lines(content))
    pages = {name: page_shown(text) for name, text in made.items() if isinstance(text, str) and name.endswith(".html")}
    return {**made, **pages}


def fleet_options(command: Command) -> Command:
    """Add --workers and --cluster; the command receives ``workers`` and ``cluster``."""

    @functools.wraps(command)
    def wrapper(*args: Any, workers: int | None, cluster: str | None, **options: Any) -> Any:
        if workers is not None and cluster is not None:
            raise InputError("--workers cannot be combined with --cluster: --workers starts processes on this computer")
        return command(*args, workers=workers or 1, cluster=cluster, **options)

    text = "Processes on this computer that share the work; the results are identical, byte for byte. Default: 1."
    decorated: Any = wrapper
    decorated = click.option("--workers", type=click.IntRange(1, 256), metavar="N", help=text)(decorated)
    text = "Scheduler of an existing Dask cluster that does the work, e.g. tcp://10.0.0.5:8786; needs compgen[cluster]."
    return click.option("--cluster", metavar="ADDRESS", help=text)(decorated)  # type: ignore[no-any-return]


@contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """Yield an event that the first SIGTERM or Ctrl-C sets; a second one raises KeyboardInterrupt."""
    stop = threading.Event()

    def ask(*_: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before: dict[int, Any] = {}
    with suppress(ValueError):  # only the main thread may handle signals
        for number in (signal.SIGTERM, signal.SIGINT):
            before[number] = signal.signal(number, ask)
    try:
        yield stop
    finally:
        for known, handler in before.items():
            signal.signal(known, handler)


# Options that are declared on the fields of a dataclass (compgen/data/toml_files.py).


def options_of(
    kind: type[Any],
    argument: str,
    *,
    only: Sequence[str] = (),
    without: Sequence[str] = (),
    read: Mapping[str, Callable[[Any], Any]] | None = None,
    build: Callable[..., Any] | None = None,
) -> Callable[[Command], Command]:
    """Add an option for each declared field of the dataclass ``kind``; the command receives ``argument``, one of it.

    Parameters
    ----------
    only, without : the fields that become options (default: all), and those that do not.
    read : by field, what makes the value from the text on the command line, where one is given.
    build : makes the object from the values by field, instead of ``kind``.
    """
    hints = get_type_hints(kind)
    chosen = [item for item in fields(kind) if item.name not in without and (not only or item.name in only)]
    nested = [item.name for item in chosen if is_dataclass(hints[item.name])]
    plain = {item.name: item for item in chosen if item.metadata and item.name not in nested}

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def wrapper(*args: Any, **options: Any) -> Any:
            values = {name: options.pop(f"{argument}__{name}") for name in (*plain, *nested)}
            values |= {name: not values[name] for name, item in plain.items() if item.default is True}
            values |= {name: reader(values[name]) for name, reader in (read or {}).items() if values[name] is not None}
            # an option that was not given leaves its field as it is by default, whatever that is; a file its key out
            unset = [name for name, item in plain.items() if values[name] is None and "check" not in item.metadata]
            left = [name for name in unset if plain[name].default is not MISSING]
            values |= {name: plain[name].default for name in left}
            return command(*args, **{argument: (build or kind)(**values)}, **options)

        decorated: Any = wrapper
        for name in nested:
            decorated = options_of(hints[name], f"{argument}__{name}")(decorated)
        for name, item in reversed(plain.items()):
            decorated = click.option(option_name(item), f"{argument}__{name}", **_how(item, hints[name]))(decorated)
        return decorated  # type: ignore[no-any-return]

    return decorate


def option_name(item: Field[Any]) -> str:
    """Return the name of the option that a field of an options dataclass becomes."""
    return item.metadata["name"] or f"--{item.name.replace('_', '-')}"


def _how(item: Field[Any], hint: Any) -> dict[str, Any]:
    """How click reads an option: the type of the field, its default and what was declared say it."""
    declared, text = item.metadata, item.metadata["text"]
    kind = (
        next(part for part in get_args(hint) if part is not NoneType)
        if get_origin(hint) in (Union, UnionType)
        else hint
    )
    if kind is bool:  # a field that is True by default has an option that denies it
        return {"is_flag": True, "help": text}
    required = item.default is MISSING and item.default_factory is MISSING
    how: dict[str, Any] = {"metavar": declared["metavar"], "help": text, "required": required}
    if get_origin(kind) is Mapping:
        number = get_args(kind)[1] is float
        return {**how, "multiple": True, "callback": functools.partial(_pairs, number=number)}
    choices = declared["choices"] or (get_args(kind) if get_origin(kind) is Literal else ())
    if get_origin(kind) in (tuple, Sequence):
        how["multiple"] = declared["metavar"] != "NAME,..."
    elif choices:
        how["type"] = click.Choice(choices, case_sensitive=choices != AXES)
    elif "check" in declared:  # a setting of a file: whatever reads the file reads this text as well
        how["type"] = kind if kind in (float, int) else str
    elif kind in (float, int):
        how["type"] = NUMBER if declared["within"] is None else click.IntRange(*declared["within"])
    elif kind is Path:
        how["type"] = PATH
    if item.default not in (None, (), MISSING):
        shown = f"{item.default:g}" if isinstance(item.default, float) else str(item.default)
        how["help"] = f"{text} Default: {shown}."
        if "check" not in declared:
            how["default"] = shown
    return how


def _pairs(
    context: click.Context, parameter: click.Parameter, given: Sequence[str], *, number: bool
) -> dict[str, str] | dict[str, float]:
    """Read NAME=VALUE, given any number of times; a VALUE alone, where the help allows one, belongs to "value"."""
    option, form = parameter.opts[0], str(parameter.metavar)
    found: dict[str, str] = {}
    for text in given:
        name, equals, value = (part.strip() for part in text.partition("="))
        if form.startswith("[") and not equals:
            name, value = "value", name
        if not (name and value):
            example = ", for example EXX=20" if number else ""
            raise InputError(f"{text!r} is not of the form {form}{example}", field=option)
        if name in found:
            raise InputError(f"{name} is given twice; give it once", field=option)
        found[name] = value
    return {name: _number(option, name, value) for name, value in found.items()} if number else found


def _number(option: str, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{text!r} for {name} is not a number; give one above 0", field=option) from None
