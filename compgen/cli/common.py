"""What all commands share: options, messages, exit codes."""

from __future__ import annotations

import functools
import json
import math
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click
from rich.console import Console
from rich.text import Text

from compgen.controllers import CONTROLLERS
from compgen.core import tomlio
from compgen.core.machine import Machine, load_machine
from compgen.core.plugins import restored, why_missing
from compgen.core.text import nearest, visible
from compgen.effects import active_effects
from compgen.errors import CompgenError, CompgenWarning, InputError
from compgen.plugins import KINDS

Command = TypeVar("Command", bound=Callable[..., Any])

#: Names of the contract; a machine file may hold settings for any of them.
CONTRACT_CONTROLLERS = (
    "isg-csv",
    "etalon-exchange",
    "siemens-eec",
    "siemens-cec",
    "siemens-cec-eec",
    "fanuc-pitch",
    "fanuc-straightness",
    "fanuc-3d",
    "heidenhain-com",
    "heidenhain-kinematics",
    "twincat-lists",
    "pmac",
    "mitsubishi",
    "linuxcnc-comp",
    "linuxcnc-volumetric",
    "neutral",
)
#: In bash the bare word compgen is a builtin that does nothing; the program has a second name for that reason.
PROGRAM_NAMES = ("compgen", "volcomp")
#: Exit codes beyond the contract's, as shells use them: nothing is said about the result.
STOPPED, READER_GONE = 130, 141
#: Tables into a pipe or a file get the width that they need, not that of an unknown terminal.
PIPE_WIDTH = None if sys.stdout.isatty() else 130


class Number(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.4 on
    """A finite number; zero, or of a size that a number in a file may have."""

    name = "float"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number; wrong usage for anything else."""
        try:
            return tomlio.number(float(value))
        except ValueError as error:
            self.fail(
                f"{value!r}: {error if str(error).startswith('a finite') else 'a number is expected'}", param, ctx
            )


NUMBER = Number()


class Terminal(Console):
    """A console that shows the control characters of names, reasons and files as escapes: no text commands a terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Turn text into what is shown; printing and the cells of tables come through here."""
        return super().render_str(visible(text), **options)


# emoji=False: rich would turn the place file.csv:100: into a picture
stdout = Terminal(highlight=False, emoji=False, markup=False, width=PIPE_WIDTH)
stderr = Terminal(stderr=True, highlight=False, emoji=False, markup=False)


def open_machine(name: str, machines: Sequence[Path] = ()) -> Machine:
    """Load a machine and check the settings of every control and the effects that its file names."""
    machine = load_machine(name, tuple(machines))
    for controller in machine.controllers:
        if controller in CONTROLLERS:
            CONTROLLERS[controller].read_settings(machine)
        elif controller not in CONTRACT_CONTROLLERS:
            message = f"is not a controller; {nearest(controller, {*CONTROLLERS, *CONTRACT_CONTROLLERS})}"
            message += why_missing("control", controller) or "; if it comes from a plug-in, add --plugin PATH"
            raise InputError(message, file=machine.source, field=f"[controllers.{controller}]")
    active_effects(machine)
    return machine


def machine_argument(command: Command) -> Command:
    """Add MACHINE and --machines; the command receives ``machine`` as a loaded machine."""

    @functools.wraps(command)
    def wrapper(*args: Any, machine: str, machines: tuple[Path, ...], **options: Any) -> Any:
        return command(*args, machine=open_machine(machine, machines), **options)

    help_text = "Further folder with machine files (may be given several times)."
    option = click.option("--machines", multiple=True, type=click.Path(path_type=Path), help=help_text)
    return click.argument("machine", metavar="MACHINE")(option(wrapper))  # type: ignore[return-value]


def json_option(command: Command) -> Command:
    """Add --json: one JSON object on stdout and nothing else there."""
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object to stdout, nothing else.")(
        command
    )


def out_option(command: Command) -> Command:
    """Add --out DIR."""
    kind = click.Path(path_type=Path)
    return click.option("--out", required=True, metavar="DIR", type=kind, help="Folder for the results.")(command)


def controller_option(*, multiple: bool = False) -> Callable[[Command], Command]:
    """Add --controller NAME."""
    text = "Name of the control; `volcomp controllers` lists them." + (
        " May be given several times." if multiple else ""
    )
    return click.option("--controller", "controller", required=True, metavar="NAME", multiple=multiple, help=text)


def print_json(data: Any) -> None:
    """Print one JSON object to stdout; a number that is not known (NaN) or not finite becomes null."""
    click.echo(json.dumps(_strict(data), indent=2, default=str, allow_nan=False))


def _strict(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    return value


@contextmanager
def progress(*, quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Show the current stage on a terminal; say nothing into a pipe."""
    if quiet or not stderr.is_terminal:
        yield lambda _: None
        return
    with stderr.status("starting") as status:
        yield lambda text: status.update(text)


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if issubclass(category, CompgenWarning):
        stderr.print(f"warning: {message}", style="yellow", markup=False, soft_wrap=True)


def run_command(group: click.Group, arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code of the contract; never show a traceback for bad input."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    with warnings.catch_warnings(), restored(KINDS):  # plug-ins given to one command are not there for the next
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", CompgenWarning)
        warnings.showwarning = _show_warning
        try:
            called = Path(sys.argv[0]).name
            name = called if called in PROGRAM_NAMES else PROGRAM_NAMES[0]
            code = group.main(words, prog_name=name, standalone_mode=False)
            return code if isinstance(code, int) else 0
        except click.exceptions.Exit as error:
            return error.exit_code
        except click.ClickException as error:
            return _usage(error, words)
        except (click.Abort, KeyboardInterrupt):
            stderr.print("stopped", markup=False)
            return STOPPED
        except SystemExit:  # click and rich leave so when the reader of a pipe has gone
            return READER_GONE
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


def _usage(error: click.ClickException, words: Sequence[str]) -> int:
    """Report wrong usage as click does, with the place where help is to be had."""
    context = getattr(error, "ctx", None)
    if isinstance(error, getattr(click.exceptions, "NoArgsIsHelpError", ())):  # click 8.2 and later
        error.show()
        return 2
    hint = f"; see '{context.command_path} --help'" if context is not None else ""
    return _fail(error.format_message().rstrip(".") + hint, 2, words)


def _fail(message: str, code: int, words: Sequence[str]) -> int:
    stderr.print(f"error: {message}", style="red", markup=False, soft_wrap=True)
    if "--json" in words:
        print_json({"error": message, "exit_code": code})
    return code
