"""What the program and all commands share: exit codes, messages, JSON. Light: ``volcomp --help`` loads this module."""

from __future__ import annotations

import functools
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import click

from compgen.data.files import json_text
from compgen.errors import CompgenError, CompgenWarning, InputError

Command = TypeVar("Command", bound=Callable[..., Any])

#: In bash the bare word compgen is a builtin that does nothing; the program has a second name for that reason.
PROGRAM_NAMES = ("compgen", "volcomp")
#: Exit codes beyond the contract's, as shells use them; they state no result.
STOPPED, READER_GONE = 130, 141


class FiniteNumber(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.4 on
    """A finite number; zero, or of a size that a number in a file may have."""

    name = "float"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number; wrong usage for anything else."""
        from compgen.data import toml_files

        try:
            return toml_files.number(float(value))
        except ValueError as error:
            what = error if str(error).startswith("a finite") else "a number is expected"
            self.fail(f"{value!r}: {what}", param, ctx)


NUMBER = FiniteNumber()
PATH = click.Path(path_type=Path)


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object to stdout, nothing else.")
out_option = click.option("--out", required=True, metavar="DIR", type=PATH, help="Folder for the results.")


def print_json(data: Any) -> None:
    """Print one JSON object to stdout."""
    click.echo(json_text(data), nl=False)


def _complain(text: str, style: str) -> None:
    from compgen.cli.terminal import complain

    complain(text, style)


def run_command(group: click.Group, arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code of the contract; never show a traceback for bad input."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", CompgenWarning)
        warnings.showwarning = lambda message, category, *_, **__: (
            _complain(f"warning: {message}", "yellow") if issubclass(category, CompgenWarning) else None
        )
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
            # as click does, with the place where help is to be had
            hint = f"; see '{context.command_path} --help'" if context is not None else ""
            return _fail(error.format_message().rstrip(".") + hint, 2, words)
        except (click.Abort, KeyboardInterrupt):
            click.echo("stopped", err=True)
            return STOPPED
        except SystemExit as error:  # click and rich leave with 1 when the reader of a pipe has gone; completion with 0
            return READER_GONE if error.code else 0
        except CompgenError as error:
            return _fail(str(error), error.exit_code, words)
        except MemoryError:
            return _fail("not enough memory for this input", 3, words)
        except Exception as error:  # the last line of defence: exit code 3 of the contract
            if os.environ.get("COMPGEN_TRACEBACK"):
                traceback.print_exc()
            place = traceback.extract_tb(error.__traceback__)[-1]
            text = f"internal error: {type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
            return _fail(f"{text}; COMPGEN_TRACEBACK=1 shows more", 3, words)


def _fail(message: str, code: int, words: Sequence[str]) -> int:
    _complain(f"error: {message}", "red")
    if "--json" in words:
        print_json({"error": message, "exit_code": code})
    return code


def load_for(context: click.Context, paths: Sequence[Path] = (), *, installed: bool = False) -> None:
    """Load plug-ins for one command; they are gone when it is done."""
    from compgen.data.registry import restored
    from compgen.plugins import KINDS, load_plugins

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


def fleet_options(command: Command) -> Command:
    """Add --workers and --cluster; the command receives ``workers`` and ``cluster``."""

    @functools.wraps(command)
    def wrapper(*args: Any, workers: int | None, cluster: str | None, **options: Any) -> Any:
        if workers is not None and cluster is not None:
            raise InputError("--workers cannot be combined with --cluster: --workers is for processes of this machine")
        return command(*args, workers=workers or 1, cluster=cluster, **options)

    text = "Processes on this machine that share the work; the results stay the same, byte for byte. Default: 1."
    decorated: Any = wrapper
    decorated = click.option("--workers", type=click.IntRange(1, 256), metavar="N", help=text)(decorated)
    text = "Scheduler of an existing Dask cluster that does the work, e.g. tcp://10.0.0.5:8786; needs compgen[cluster]."
    return click.option("--cluster", metavar="ADDRESS", help=text)(decorated)  # type: ignore[no-any-return]


@contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """Yield what is set by the first SIGTERM or Ctrl-C; a second one is KeyboardInterrupt."""
    stop = threading.Event()

    def ask(*_: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before: dict[int, Any] = {}
    with suppress(ValueError):  # outside the main thread signals are somebody else's
        for number in (signal.SIGTERM, signal.SIGINT):
            before[number] = signal.signal(number, ask)
    try:
        yield stop
    finally:
        for known, handler in before.items():
            signal.signal(known, handler)
