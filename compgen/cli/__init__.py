"""The command line: ``volcomp --help``.

This module has only the names of the commands and a line of help for each. The module that holds a command is imported
when the command runs, and with it what the command needs; ``volcomp --help`` and the completion of a shell load
neither.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import sys
import zlib
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import load_for, output_options, plugin_option, run_command, with_language
from compgen.resources import LANGUAGES, cache_folder
from compgen.units import UNITS

#: Every command by the module that holds it as ``<name>_command``, with its line in ``volcomp --help``.
_COMMANDS = {
    "run_commands": {
        "run": "Identify, fit, export, read back, verify: tracer lengths in, checked controller tables out.",
        "report": "Make the report of a folder that run, identify, verify or compare wrote.",
    },
    "identify_commands": {
        "identify": "Identify error curves, squareness and stations from a measurement.",
        "fit": "Fit smooth curves to identified errors, within bounds.",
    },
    "diagnose_commands": {
        "diagnose": "Find where model and measurement disagree, and name the missing effect.",
    },
    "table_commands": {
        "options": "Show what each option of a control would gain, by level and by control.",
        "export": "Export errors to the files of a control, with manifest.json and preflight.md.",
        "read": "Read controller files, emulate the control, and write the correction at each point.",
        "verify": "Verify controller files against the errors of the machine.",
        "diff": "Compare two sets of tables by what they do: A minus B at the tool, in um.",
        "merge": "Merge old tables and new errors into one set of tables.",
        "crash-test": "Feed wrong tables to the verification and check that each is rejected.",
    },
    "program_commands": {
        "correct": "Correct an NC program for the errors of one machine, read it back and judge it.",
        "part": "Predict what the errors of a machine leave on the part of an NC program.",
    },
    "plan_commands": {
        "plan": "Plan a measurement: what it will determine, and how well.",
        "simulate": "Simulate a machine and its measurement.",
        "predict": "Predict the error of the tool tip at given points: E = C P, or the exact model.",
    },
    "accuracy_commands": {
        "accuracy": "Evaluate one measurement or error file by the standards (ISO 230, VDI/DGQ 3441).",
        "compare": "Compare before and after: improvement factors with uncertainty.",
    },
    "file_commands": {
        "init": "Write a commented machine file from a few answers.",
        "check": "List every problem of machine, job, scenario and instrument files.",
        "schema": "Print the JSON schema of a kind of file, for editors.",
    },
    "listing_commands": {
        "controllers": "List the controls that compgen writes, and what they can express.",
        "machines": "List the machines with their travel (mm).",
        "effects": "List the effects other than the geometric errors.",
        "instruments": "List the instruments that compgen simulates.",
        "import": "Show what a file of another program contains, and convert it to the native format.",
    },
    "heat_commands": {
        "heat": "Learn how heat moves the tool, from days of drift; judged on days left out.",
    },
    "log_commands": {
        "log": "Write temperatures to a file while one measures: OPC UA, MTConnect, LinuxCNC, loggers.",
    },
    "app_commands": {
        "app": "Open the workbench in the browser: from files to checked tables without a command line.",
    },
    "fleet_commands": {
        "recal": "Scheduled recalibration: new measurements become proposed tables.",
        "serve": "Show the fleet in a browser: history, drift, before and after of proposed tables.",
    },
}


class Unloaded(click.Command):
    """Name and help line of a command whose module has not been imported yet."""

    def __init__(self, name: str, module: str, line: str) -> None:
        super().__init__(name, short_help=line)
        self.module = module

    @cached_property
    def loaded(self) -> click.Command:
        """Import the module of the command and return the command."""
        module = import_module(f"compgen.cli.{self.module}")
        command = getattr(module, f"{str(self.name).replace('-', '_')}_command")
        assert isinstance(command, click.Command)
        return with_language(output_options(plugin_option(command)))


class Sketch(click.Command):
    """Options of a command as noted when a shell asked for them last: enough to name them without loading the command.

    The note has the size and time of every file of the program that was read for it. If one of them has changed, the note
    is not used. Values are completed by the command itself.
    """

    #: What a note has of each parameter.
    KEYS = ("nargs", "multiple", "is_flag", "count", "hidden", "help")

    def __init__(self, command: Unloaded, noted: list[dict[str, Any]]) -> None:
        def values(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[Any]:
            known = next(item for item in command.loaded.params if item.name == parameter.name)
            return known.shell_complete(ctx, incomplete)

        super().__init__(command.name)
        for item in noted:
            words = item.pop("words")
            kind = click.Option if words[-1].startswith("-") else click.Argument
            self.params.append(kind(words, shell_complete=values, **item))

    @classmethod
    def of(cls, command: Unloaded) -> Sketch | None:
        """Return the sketch of a command, None if there is no note of it, or an old one."""
        try:
            note = json.loads(cls.file(command).read_bytes())
            if all([(stat := os.stat(path)).st_mtime_ns, stat.st_size] == known for path, *known in note["files"]):
                return cls(command, note["parameters"])
        except (OSError, ValueError, LookupError, TypeError):
            pass
        return None

    @classmethod
    def note(cls, command: Unloaded) -> None:
        """Note the options of a command that has been loaded."""
        noted = []
        for item in command.loaded.params:
            if item.secondary_opts or isinstance(command.loaded, click.Group):
                return
            keys = cls.KEYS if isinstance(item, click.Option) else ("nargs",)
            words = [item.name, *item.opts] if isinstance(item, click.Option) else [item.name]
            noted.append({"words": words, **{key: getattr(item, key) for key in keys}})
        own = [module for name, module in sys.modules.items() if name.partition(".")[0] == "compgen"]  # no plug-ins
        sources = [click.__file__, *(getattr(module, "__file__", None) for module in own)]
        target = cls.file(command)
        try:
            files = [(path, (stat := os.stat(path)).st_mtime_ns, stat.st_size) for path in sources if path]
            target.parent.mkdir(parents=True, exist_ok=True)
            part = target.with_suffix(f".{os.getpid()}")
            part.write_text(json.dumps({"files": files, "parameters": noted}), encoding="utf-8")
            os.replace(part, target)
        except OSError:  # a folder that nobody may write to
            pass

    @staticmethod
    def file(command: Unloaded) -> Path:
        """Return where the note of a command is kept, for each installation of the program."""
        place = f"{sys.implementation.cache_tag}{Path(__file__).resolve()}".encode()
        return cache_folder("completion") / f"{command.name}-{zlib.crc32(place):08x}.json"


class CommandTable(click.Group):
    """A group that imports each command when it is called; help and completion need only the names."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that ``args`` begin with, and import it, unless a shell asks only for its options."""
        name, command, rest = super().resolve_command(ctx, args)
        if not isinstance(command, Unloaded):
            return name, command, rest
        # plug-ins may add values, so whoever loads some gets the command itself
        asked = (
            ctx.resilient_parsing
            and "COMPGEN_PLUGINS" not in os.environ
            and not any("--plugin" in word for word in rest)
        )
        sketch = Sketch.of(command) if asked else None
        if asked and sketch is None:
            Sketch.note(command)
        return name, sketch or command.loaded, rest


def _show_version(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    """Print the version and stop; works for a package that was never installed, too."""
    if value and not context.resilient_parsing:
        from compgen.resources import program_version

        click.echo(f"compgen, version {program_version()}")
        context.exit()


def _may_have_plugins() -> bool:
    """Whether an installed distribution may have plug-ins: a group of entry points whose name begins with compgen.

    Which, ``importlib.metadata`` says; to load it for the answer "none" takes a quarter of the time of loading numpy.
    Where distributions lie elsewhere than in folders, it is asked.
    """
    for finder in sys.meta_path:
        if hasattr(finder, "find_distributions") and getattr(finder, "__name__", "") != "PathFinder":
            return True
    for folder in map(Path, dict.fromkeys(sys.path)):
        if os.path.isfile(folder):
            return True
        if not os.path.isdir(folder):  # also where this user may not look
            continue
        for file in (*folder.glob("*-info/entry_points.txt"), *folder.glob("EGG-INFO/entry_points.txt")):
            try:
                if b"[compgen." in file.read_bytes():
                    return True
            except OSError:
                return True
    return False


def _configured() -> dict[str, Any]:
    """Return the defaults of options that the configuration file states; paths are relative to it.

    It is ``config.toml`` in the user's folder for settings, or the file that ``COMPGEN_CONFIG`` names (empty: none). It may only
    state where files are, and the language and the units of pages: nothing in it changes a number of a file.
    """
    named = os.environ.get("COMPGEN_CONFIG")
    path = Path(click.get_app_dir("compgen")) / "config.toml" if named is None else Path(named)
    if named == "" or (named is None and not path.is_file()):
        return {}
    from compgen.data import toml_files

    root = toml_files.read_toml(path)
    machines = root.take("machines", toml_files.texts_of_paths, ())
    certificate = root.take("certificate", toml_files.text_of_path, "")
    language = root.take("language", toml_files.choice(*LANGUAGES), "")
    units = root.take("units", toml_files.choice(*UNITS), "")
    root.finish()
    found: dict[str, Any] = {}
    if machines:
        found["machines"] = [str(path.parent / Path(folder).expanduser()) for folder in machines]
    if certificate:
        found["certificate"] = str(path.parent / Path(certificate).expanduser())
    if language:
        found["language"] = language
    if units:
        found["units"] = units
    return found


@click.group(
    cls=CommandTable,
    commands=[Unloaded(name, module, line) for module, lines in _COMMANDS.items() for name, line in lines.items()],
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_show_version,
    help="Show the version and exit.",
)
@plugin_option
@output_options
@click.pass_context
def cli(context: click.Context) -> None:
    """From a machine-tool measurement to checked compensation tables.

    Lengths are in mm, errors in files in um and urad. Exit codes: 0 done and accepted, 1 done but not acceptable,
    2 wrong usage or bad input, 3 internal error.

    \b
    Example:
      volcomp run zha-gantry lengths.csv --controller isg-csv --out tables/
    """
    if _may_have_plugins():
        load_for(context, installed=True)
    configured = _configured()
    if configured:
        context.default_map = {name: configured for lines in _COMMANDS.values() for name in lines}
        # --certificate of `report` is called "handed" within the program: its "certificate" is that of --dcc
        context.default_map["report"] = {"handed" if key == "certificate" else key: v for key, v in configured.items()}


def main() -> None:
    """Entry point of the console script.

    A command computes with one thread of the numerical libraries unless the environment says otherwise: its matrices are
    too small for a second one, which would only wait, at the cost of a processor. Modules and their functions live as
    long as the process: to search them for garbage while they are loaded, and all objects once more when the process
    ends, would take a tenth of the time of a short command.
    """
    gc.set_threshold(200_000, 20, 20)
    atexit.register(gc.freeze)
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        os.environ.setdefault("MKL_NUM_THREADS", "1")
    sys.exit(run_command(cli))
