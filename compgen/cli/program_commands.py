"""``volcomp correct`` and ``volcomp part``: the NC program itself, and what a machine makes of it."""

from __future__ import annotations

import functools
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from compgen.cli.common import PATH, Command, json_option, language_option, options_of, page_shown, stopped_by_signals
from compgen.cli.shared_options import (
    covariance_of,
    machine_argument,
    open_machine,
    path_option,
    prior_option,
    prior_value,
    tool_offset,
    with_prior_class,
)
from compgen.cli.terminal import answer, complain, progress, say, table_of
from compgen.data.error_table import read_reversal
from compgen.data.files import OutputFolder, exclusive, json_text, sha256_of, sha256_of_file
from compgen.data.machine import INTEGERS, MM_PER_UNIT, Machine, ProgramNumbers, Vector3
from compgen.effects import effects_reversal
from compgen.errors import InputError, number_text, visible
from compgen.foreign import open_errors
from compgen.identification.covariance import covariance_or_independent, posterior_with
from compgen.identification.posterior import assumed_text, worse_text
from compgen.programs import CorrectOptions, FolderWatch, Setup, correct_program, model_of, read_radii, read_tools
from compgen.resources import program_version

if TYPE_CHECKING:
    from compgen.heat import Growth
    from compgen.programs import Feature, PartMachine, PartPrediction, ProgramCorrection, WatchedProgram
    from compgen.programs.path import ExactModel

WCS_HELP = (
    "Work offset: machine position of its zero in mm, e.g. G54=-400,150,-220 (several times for several offsets)."
)
TOOLS_HELP = (
    "Tool lengths: CSV with tool, length_mm and optionally x_mm, y_mm, radius_mm, diameter_mm; or a tool table of "
    "LinuxCNC, in machine_units of "
    "the machine file (mm)."
)
#: A watched program is taken when it has not changed for this long, s; the folder is looked at at least so often, s.
SETTLE_S, LOOK_S = 2.0, 1.0


def _wcs(given: tuple[str, ...]) -> dict[str, Vector3]:
    found: dict[str, Vector3] = {}
    for text in given:
        name, _, numbers = text.partition("=")
        name = "".join(name.split()).upper()  # G54.1 P3 is G54.1P3
        try:
            x, y, z = (float(part) for part in numbers.split(","))
        except ValueError:
            x = y = z = float("nan")
        if not name or not all(abs(part) < 1e6 for part in (x, y, z)):
            raise InputError(f"{text[:60]!r} is no work offset; expected e.g. G54=-400,150,-220 (mm)", field="--wcs")
        if name in found:
            raise InputError(f"{name} is given twice; give it once", field="--wcs")
        found[name] = (x, y, z)
    return found


def _integers(
    stated: ProgramNumbers, integers: str | None, increment_mm: float | None
) -> tuple[str | None, float | None]:
    """What numbers without a decimal point are: as the command line says, else the machine file."""
    integers, increment_mm = integers or stated.integers, increment_mm or stated.increment_mm
    if integers == "increments" and increment_mm is None:
        raise InputError(
            "increments of what? add --increment-mm 0.001, or increment_mm of [programs] in the machine file",
            field="--integers",
        )
    return integers, increment_mm


def _tool_radii(given: tuple[str, ...]) -> dict[str, float]:
    """Radii by D or tool: ``5`` is that of all, ``D3=5`` and ``3=5`` that of one."""
    found: dict[str, float] = {}
    for text in given:
        name, _, number = text.rpartition("=")
        try:
            radius = float(number)
        except ValueError:
            radius = math.nan
        if not 0.0 <= radius < 1e3:
            raise InputError(
                f"{text[:60]!r} is no radius; expected mm, e.g. 5, or D3=5 for one D (tool), 0 if the control has the wear alone",
                field="--tool-radius",
            )
        key = name.strip().upper()
        key = key[1:] if re.fullmatch(r"[DT]\d+", key) else key
        key = f"{int(key)}" if key.isdigit() else key
        if key in found:
            raise InputError(f"the radius of {name or 'all tools'} is given twice; give it once", field="--tool-radius")
        found[key] = radius
    return found


def program_options(command: Command) -> Command:
    """Add what a program needs to be read; the command receives ``setup`` (of a machine), ``errors`` and ``reversal``."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        wcs: tuple[str, ...],
        tools: Path | None,
        block_delete: bool,
        keep_unknown: tuple[str, ...],
        gauge: str,
        integers: str | None,
        increment_mm: float | None,
        subprograms: tuple[Path, ...],
        tool_radius: tuple[str, ...],
        **options: Any,
    ) -> Any:
        codes = frozenset(code.strip().upper() for text in keep_unknown for code in text.split(",") if code.strip())

        def setup(machine: Machine) -> Setup:
            lengths = read_tools(tools, MM_PER_UNIT[machine.units]) if tools else {}
            numbers = _integers(machine.programs, integers, increment_mm)
            missing = next((folder for folder in subprograms if not folder.is_dir()), None)
            if missing is not None:
                raise InputError(
                    "is no folder; --subprograms needs one that exists", file=missing, field="--subprograms"
                )
            gauge_mm = tool_offset("--gauge", gauge)
            radii = read_radii(tools, MM_PER_UNIT[machine.units]) if tools else {}
            stated = _tool_radii(tool_radius)
            return Setup(_wcs(wcs), lengths, block_delete, codes, gauge_mm, *numbers, subprograms, radii, stated)

        return command(*args, setup=setup, **options)

    decorated: Any = wrapper
    text = (
        "Radius of the tool for G41/G42, RL/RR (mm): 5 for all, D3=5 for one D or tool (several times); 0 where the contour is "
        "the path of the tool centre and the control has the wear alone. Default: radius_mm or diameter_mm of --tools."
    )
    decorated = click.option("--tool-radius", multiple=True, metavar="[D=]MM", help=text)(decorated)
    text = (
        "Folder with files that the program calls; each call is written out and corrected (may be given several times; the "
        "first that has the file counts)."
    )
    decorated = path_option("--subprograms", text, metavar="DIR", multiple=True)(decorated)
    text = "Least input increment of the control, mm, e.g. 0.001 (0.0001 inch): for --integers increments."
    decorated = click.option("--increment-mm", type=click.FloatRange(1e-6, 1.0), help=text)(decorated)
    text = (
        "What a number without a decimal point is, FANUC: X500 is 500 mm, or 500 increments (default: integers of [programs] "
        "of the machine file; without either it is asked)."
    )
    decorated = click.option("--integers", type=click.Choice(INTEGERS), help=text)(decorated)
    text = "M code that moves and calls nothing and stays as it is, e.g. M100 or M88 (may be given several times)."
    decorated = click.option("--keep-unknown", multiple=True, metavar="CODE", help=text)(decorated)
    text = "Blocks with / are skipped at the control; they stay as they are. Default: they are executed."
    decorated = click.option("--block-delete", is_flag=True, help=text)(decorated)
    text = (
        "Tool offset of the model for a tool of length 0: from the origin of the tool carriage to the gauge point, mm."
    )
    decorated = click.option("--gauge", metavar="X,Y,Z", default="0,0,0", show_default=True, help=text)(decorated)
    decorated = path_option("--tools", TOOLS_HELP)(decorated)
    decorated = click.option("--wcs", multiple=True, metavar="NAME=X,Y,Z", help=WCS_HELP)(decorated)
    text = (
        "*.reversal.csv (um): the reversal value of each axis (default: backlash and lost motion of the machine file)."
    )
    decorated = path_option("--reversal", text)(decorated)
    return click.option(  # type: ignore[no-any-return]
        "--errors",
        metavar="ERRORS",
        type=PATH,
        help="*.errors.csv of the machine (um, urad), or an Etalon exchange file (mm, rad).",
    )(decorated)


@dataclass(frozen=True)
class _Heat:
    """What the options say of the temperatures at which a program runs."""

    model: Path | None
    temperatures: str | None
    at: str | None
    zero: str | None

    def growth(self, machine: Machine) -> Growth | None:
        """Return the growth of a machine, None if no temperatures were stated."""
        if self.temperatures is None:
            if self.model or self.at or self.zero:
                raise InputError(
                    "--heat, --heat-at and --heat-zero say how --temperatures act; add --temperatures with a file or with values"
                )
            return None
        from compgen.heat import growth_at, read_heat

        file = self._file(machine)
        model = read_heat(file)
        if model.machine != machine.name:
            raise InputError(f"is the model of heat of {visible(model.machine)}, not of {machine.name}", file=file)
        return growth_at(model, self.temperatures, self.at, self.zero)

    def files(self, machine: Machine) -> list[Path]:
        """Return the files that decide the growth."""
        if self.temperatures is None:
            return []
        stated = Path(self.temperatures)
        return [self._file(machine), *([stated] if stated.exists() else [])]

    def _file(self, machine: Machine) -> Path:
        if self.model is not None:
            return self.model
        beside = None if machine.source is None else Path(machine.source).with_name(f"{machine.name}.heat.toml")
        if beside is None or not beside.exists():
            raise InputError(
                f"--temperatures need the model of heat that `volcomp heat` writes: {machine.name}.heat.toml; it is not "
                "beside the machine file, name it with --heat"
            )
        return beside


def heat_options(command: Command) -> Command:
    """Add the temperatures at which a program runs; the command receives ``heat``."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        heat: Path | None,
        temperatures: str | None,
        heat_at: str | None,
        heat_zero: str | None,
        **options: Any,
    ) -> Any:
        return command(*args, heat=_Heat(heat, temperatures, heat_at, heat_zero), **options)

    decorated: Any = wrapper
    text = (
        "Moment or temperatures from which growth counts, when the work offset was probed: time_s or ISO time of the file "
        "(default: its first reading), or values, e.g. spindle=20,bed=20."
    )
    decorated = click.option("--heat-zero", metavar="TIME|VALUES", help=text)(decorated)
    text = (
        "Moment of the file of temperatures at which the program runs: time_s or ISO time (default: its last reading)."
    )
    decorated = click.option("--heat-at", metavar="TIME", help=text)(decorated)
    text = (
        "Temperatures while the program runs, degC: a *.temperatures.csv, or values of a machine that has settled, e.g. "
        "spindle=28.5,bed=22. What heat has moved is then part of the error."
    )
    decorated = click.option("--temperatures", metavar="FILE|VALUES", help=text)(decorated)
    text = "Model of heat of `volcomp heat` (default: NAME.heat.toml beside the machine file): for --temperatures."
    return path_option("--heat", text)(decorated)  # type: ignore[no-any-return]


def _model(
    machine: Machine, errors: Path | None, reversal: Path | None, only: str | None = None, heat: _Heat | None = None
) -> ExactModel:
    if errors is None:
        raise click.UsageError("Missing option '--errors'.")
    both = read_reversal(reversal) if reversal else effects_reversal(machine)
    found = model_of(machine, open_errors(errors), both, only)
    return found if heat is None else replace(found, growth=heat.growth(machine))


def _not_measured(model: ExactModel, errors: Path) -> list[str]:
    """Say what is assumed of errors that were not measured: a corrected program does not correct them."""
    covariance = covariance_of(errors, model.errors, None, independent=False)
    known = covariance_or_independent(model.errors, covariance)
    if known is None:
        return ["the errors have no uncertainties, so that of the part is not known"]
    found = posterior_with(model.machine, model.errors, known)
    if found is None:
        return ["no prior: nothing is said of errors that were not measured"]
    return [text for text in (assumed_text(found), worse_text(found)) if text]


@dataclass(frozen=True)
class _Watching:
    """What ``--watch`` and the options beside it say."""

    folder: Path
    once: bool
    match: tuple[str, ...]
    settle_s: float
    subfolders: bool


def watch_options(command: Command) -> Command:
    """Add --watch and what belongs to it; the command receives ``watching``, and ``out`` with its default."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        program: Path | None,
        watch: Path | None,
        once: bool,
        match: tuple[str, ...],
        settle_s: float | None,
        subfolders: bool,
        out: Path | None,
        **options: Any,
    ) -> Any:
        if watch is None and (once or match or subfolders or settle_s is not None):
            raise InputError(
                "--once, --match, --settle-s and --subfolders belong to --watch; give the folder with --watch DIR"
            )
        if watch is not None and program is not None:
            raise InputError("a PROGRAM and --watch exclude each other; give one of them", field="--watch")
        if watch is None and program is None:
            raise click.UsageError("Missing argument 'PROGRAM'.")
        if watch is None and out is None:
            raise click.UsageError("Missing option '--out'.")
        watching = None
        if watch is not None:
            out = out or watch / "corrected"
            settle_s = SETTLE_S if settle_s is None else settle_s
            watching = _Watching(watch, once, match or ("*",), settle_s, subfolders)
        return command(*args, program=program, watching=watching, out=out, **options)

    decorated: Any = wrapper
    text = (
        "Folder for the results; with --watch each program gets a folder within it (default then: corrected, within the "
        "watched folder)."
    )
    decorated = click.option("--out", metavar="DIR", type=PATH, help=text)(decorated)
    text = f"With --watch: a program is taken when it has not changed for this long, s (default {SETTLE_S:g})."
    decorated = click.option("--settle-s", type=click.FloatRange(0.1, 3600), help=text)(decorated)
    text = "With --watch: only files whose names fit, e.g. '*.nc' (may be given several times; default: all)."
    decorated = click.option("--match", multiple=True, metavar="PATTERN", help=text)(decorated)
    text = "With --watch: correct programs in its subfolders, too; each gets a folder of the same path."
    decorated = click.option("--subfolders", is_flag=True, help=text)(decorated)
    text = "With --watch: correct what is in the folder and end; exit code 1 if a program was not accepted or refused."
    decorated = click.option("--once", is_flag=True, help=text)(decorated)
    text = "Folder that is watched until Ctrl-C: every program that is put there is corrected; the originals are only read."
    decorated = path_option("--watch", text, metavar="DIR")(decorated)
    return click.argument("program", type=PATH, required=False)(decorated)  # type: ignore[no-any-return]


@click.command("correct")
@machine_argument
@prior_option
@watch_options
@program_options
@heat_options
@options_of(CorrectOptions, "options")
@click.option("--only", metavar="AXES", help="Correct only these axes, e.g. X,Y; the others stay as they are.")
@path_option(
    "--active",
    "Table that is active on the control while the program runs (several times): the program then corrects only what it leaves.",
    multiple=True,
)
@click.option("--active-controller", metavar="NAME", help="Name of the control that the active tables belong to.")
@language_option
@json_option
def correct_command(
    machine: Machine,
    setup: Callable[[Machine], Setup],
    errors: Path,
    reversal: Path | None,
    only: str | None,
    program: Path,
    watching: _Watching | None,
    heat: _Heat,
    options: CorrectOptions,
    active: tuple[Path, ...],
    active_controller: str | None,
    out: Path,
    language: str,
    as_json: bool,
) -> int:
    """Correct an NC program for the errors of one machine: the tool then follows the programmed path.

    For controls without tables. Every coordinate is replaced by the command at which the exact model of the machine brings
    the tool where the program wants it. Moves are divided where the correction bends by more than the tolerance. The
    corrected program is read again and compared with the path of the original; if that is not closer to it, the file is
    named NOT-ACCEPTED-... (exit code 1). Variables, turned coordinates
    and rotary axes that turn are refused with their line. DIR gets the program, correction.json and preflight.md. Nothing may
    be corrected twice: tables that are active while the program runs are given with --active, unless ERRORS were measured with
    them on. With --watch posted/, in place of PROGRAM, every program that is put into this
    folder is corrected.

    \b
    Example:
      volcomp correct zha-gantry part.nc --errors fitted.errors.csv --dialect fanuc --wcs G54=-400,-300,-350 --out corrected/
    """
    if bool(active) != (active_controller is not None):
        raise InputError("--active and --active-controller belong together; give both")
    options.check()

    def model() -> _Known:
        return _known(_model(machine, errors, reversal, only, heat), errors, active, active_controller)

    def correct(known: _Known, source: Path, folder: Path) -> ProgramCorrection:
        with progress(quiet=as_json) as show:
            return correct_program(
                known.model,
                source,
                folder,
                options,
                setup(machine),
                errors_file=known.file,
                show=show,
                language=language,
                remarks=known.remarks,
            )

    if watching is not None:
        setup(machine)
        given = click.get_current_context().params
        files = [path for path in (errors, reversal, *active, *heat.files(machine)) if path is not None]
        fixed = [repr((name, str(given[name]))) for name in sorted(given.keys() - _OF_THE_WATCH)]
        fixed += [program_version(), sha256_of_file(machine.source) if machine.source else repr(machine)]
        read = [path for path in (given["tools"],) if path is not None]
        return _watch(watching, out, _CurrentErrors(model, correct, files, read, given["subprograms"], fixed), as_json)
    known = model()
    return _say_correction(correct(known, program, out), known.model, out, as_json)


@dataclass(frozen=True)
class _Known:
    """The machine as it is known: its model, name and SHA-256 of the file of the errors, what was not measured."""

    model: ExactModel
    file: tuple[str, str]
    remarks: list[str]


def _known(model: ExactModel, errors: Path, active: tuple[Path, ...], active_controller: str | None) -> _Known:
    remarks = _not_measured(model, errors)
    name = errors.name
    if model.growth is not None:
        name += f" and heat of {model.growth.model[0]}"
    if active:
        from compgen.programs.part import CompensatedModel
        from compgen.tables import read_tables

        tables = read_tables(model.machine, active, str(active_controller), foreign=True)
        model = CompensatedModel(model.machine, model.errors, model.reversal, model.only, model.growth, tables)
        name += f" with the active tables of {active_controller}"
    return _Known(model, (name, sha256_of_file(errors)), remarks)


def _say_correction(result: ProgramCorrection, model: ExactModel, out: Path, as_json: bool) -> int:
    for reason in result.reasons:
        complain(f"not acceptable: {reason}", "red")
    found = {**result.as_dict(), "prior": model.machine.prior.as_dict()}
    rows = [
        (name, f"{found['before'][key]:.2f}", f"{found['after'][key]:.2f}")
        for name, key in (
            ("largest distance from the path", "normal_max_um"),
            ("rms", "normal_rms_um"),
            ("largest at ends of moves", "ends_max_um"),
            ("largest with what is along the path", "max_um"),
            ("rms", "rms_um"),
        )
    ]
    table = table_of(("tool from the path, moves at feed (um)", "before", "after"), rows)
    counts = f"{found['blocks']} blocks, {found['changed_blocks']} changed, {found['added_blocks']} added"
    says = [*result.notes, *(f"assumed: {text}" for text in result.assumed)]
    answer(as_json, {**found, "file": str(out / result.file)}, table, counts, *says, f"-> {out / result.file}")
    return 0 if result.accepted else 1


# ``volcomp correct --watch``.


#: Options that say how a folder is watched, not how a program is corrected.
_OF_THE_WATCH = {"watch", "once", "match", "settle_s", "subfolders", "out", "program", "as_json"}


class _CurrentErrors:
    """Corrects with the errors that the files state now: they are read again when one of them has changed.

    ``also`` (tools) and the files in ``folders`` are read for every program; ``fixed`` are conditions that do not change while
    this command runs.
    """

    def __init__(
        self,
        read: Callable[[], _Known],
        correct: Callable[[_Known, Path, Path], ProgramCorrection],
        files: list[Path],
        also: list[Path],
        folders: Sequence[Path],
        fixed: list[str],
    ) -> None:
        self.read, self.apply, self.files, self.fixed = read, correct, files, fixed
        self.also, self.folders = also, folders
        self.digests = self._digests()
        self.known: _Known | None = read()

    def _digests(self) -> list[str]:
        return [sha256_of_file(path) for path in self.files]

    def conditions(self) -> str:
        """Return a digest of all that decides a correction beside the program."""
        try:
            found = [*self._digests(), *map(sha256_of_file, self.also)]
            for folder in self.folders:
                found += [
                    f"{path} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in sorted(folder.iterdir())
                ]
        except (InputError, OSError) as error:  # each program is refused for it, and tried again when the file is back
            found = [str(error)]
        return sha256_of("\n".join([*self.fixed, *found]).encode())

    def __call__(self, source: Path, folder: Path) -> ProgramCorrection:
        digests = self._digests()
        if digests != self.digests or self.known is None:
            self.known = None  # never the old errors where the new ones cannot be read
            self.known, self.digests = self.read(), digests
            complain("the errors have changed and were read again; all programs in the folder are corrected again")
        return self.apply(self.known, source, folder)


def _watch(watching: _Watching, out: Path, correct: _CurrentErrors, as_json: bool) -> int:
    """Correct what comes into the folder until a signal, or once what is there."""
    settle_s = 0.0 if watching.once else watching.settle_s
    watch = FolderWatch(
        watching.folder, out, correct, watching.match, settle_s, correct.conditions, subfolders=watching.subfolders
    )
    found: dict[str, WatchedProgram] = {}
    trouble = ""
    out.mkdir(parents=True, exist_ok=True)
    # two watches of a folder would write the same files
    with exclusive(out / ".watch.lock", wait_s=0.0), stopped_by_signals() as stop:
        if not (as_json or watching.once):
            say(f"watching {watching.folder}; corrected programs go to {out}; Ctrl-C ends")
        while not stop.is_set():
            try:
                for item in watch.look(time.monotonic()):
                    found[item.name] = item
                    _say_program(item, as_json)
                    if stop.is_set():
                        break
                trouble = ""
            except InputError as error:  # a drive of the network that is away for a while
                if watching.once:
                    raise
                if str(error) != trouble:
                    complain(f"{error}; it is tried again", "red")
                trouble = str(error)
            if watching.once:
                break
            stop.wait(min(LOOK_S, watching.settle_s / 2.0))
    good = all(item.state in ("accepted", "deleted", "folder") for item in found.values())
    counts = Counter("not looked into" if item.state == "folder" else item.state for item in found.values())
    said = ", ".join(f"{count} {state}" for state, count in sorted(counts.items())) or "no program"
    answer(as_json, {"accepted": good, "programs": [item.as_dict() for item in found.values()]}, said)
    return 0 if good or not watching.once else 1


def _say_program(item: WatchedProgram, as_json: bool) -> None:
    """Say in a line what became of a program, and what was warned of."""
    name = visible(item.name, flat=True)
    for text in item.warnings:
        complain(f"warning: {name}: {text}")
    if item.state in ("refused", "not accepted"):
        written = f" -> {item.file}" if item.file else ""
        as_before = ", as before" if item.before else ""
        complain(f"{name}: {item.state}{as_before}: {'; '.join(item.reasons)}{written}", "red")
    elif item.state == "folder":
        complain(f"{name}: {'; '.join(item.reasons)}")
    elif as_json:
        return
    elif item.before:
        say(f"{name}: accepted before, unchanged -> {item.file}")
    elif item.result is None:
        say(f"{name}: deleted; what was made of it stays in its folder")
    else:
        before, after = (figures.as_dict()["normal_max_um"] for figures in (item.result.before, item.result.after))
        say(f"{name}: accepted, {before:.2f} um from the path before, {after:.2f} um after -> {item.file}")


# ``volcomp part``.


ALSO_HELP = (
    "Another machine with its errors, e.g. mill2.toml=mill2.errors.csv (several times): the machines are ranked."
)
FLEET_HELP = (
    "Job file of `volcomp recal`: all its machines are ranked, as they are now, with their active tables. MACHINE is the name of "
    "one of them, and --errors is not needed."
)
#: Rows of quantities of one kind on the terminal.
MOST_OF_A_KIND = 6


def _also(given: tuple[str, ...]) -> list[PartMachine]:
    from compgen.programs import PartMachine

    found = []
    for text in given:
        name, _, file = text.rpartition("=")
        if not name:
            raise InputError(f"{text!r} is not of the form MACHINE=ERRORS", field="--also")
        machine, errors = open_machine(name), open_errors(Path(file))
        covariance = covariance_or_independent(errors, covariance_of(Path(file), errors, None, independent=False))
        found.append(PartMachine(machine.name, model_of(machine, errors, effects_reversal(machine)), covariance))
    return found


def _of_fleet(file: Path, name: str) -> tuple[PartMachine, list[PartMachine], list[str]]:
    """Return machine ``name`` of a job file, the others, and the names of those without errors in the store."""
    from compgen.cli.fleet_commands import needed, opened
    from compgen.fleet.job import read_job
    from compgen.fleet.process import machine_now
    from compgen.programs import PartMachine

    needed()
    job = read_job(file)
    chosen = job.machine(name)
    found, missing = {}, []

    def read(store: Any) -> None:
        known = {record.name: record for record in store.machines()}
        for item in job.machines.values():
            now = machine_now(store, known[item.name], item) if item.name in known else None
            if now is None:
                missing.append(item.name)
                continue
            machine, errors, covariance, tables = now
            model = model_of(machine, errors, effects_reversal(machine))
            found[item.name] = PartMachine(item.name, model, covariance_or_independent(errors, covariance), tables)

    opened(job, read)
    if chosen.name not in found:
        raise InputError(f"{name} has no identified errors in the store; measure it first, or name another machine")
    return found.pop(chosen.name), list(found.values()), missing


@click.command("part")
@click.argument("machine", metavar="MACHINE")
@click.argument("program", type=PATH)
@program_options
@heat_options
@options_of(CorrectOptions, "options", only=("dialect",))
@click.option("--uncertainty", is_flag=True, help="Require the uncertainty: exit code 2 if the errors have none.")
@path_option("--tables", "Table of a control (several times): also evaluate the part with it active.", multiple=True)
@click.option("--controller", metavar="NAME", help="Name of the control that the tables belong to.")
@click.option(
    "--correct",
    is_flag=True,
    help="Also with the program as `volcomp correct` writes it; with --tables also with one that corrects what they leave.",
)
@prior_value
@click.option("--also", multiple=True, metavar="MACHINE=ERRORS", help=ALSO_HELP)
@path_option("--fleet", FLEET_HELP, metavar="JOB")
@click.option("--machines", multiple=True, type=PATH, help="Additional folder with machine files (several times).")
@click.option("--out", metavar="DIR", type=PATH, help="Folder for part.json and part.html.")
@language_option
@json_option
def part_command(
    machine: str,
    machines: tuple[Path, ...],
    setup: Callable[[Machine], Setup],
    errors: Path | None,
    reversal: Path | None,
    program: Path,
    heat: _Heat,
    options: CorrectOptions,
    uncertainty: bool,
    tables: tuple[Path, ...],
    controller: str | None,
    correct: bool,
    prior: str | None,
    also: tuple[str, ...],
    fleet: Path | None,
    out: Path | None,
    language: str,
    as_json: bool,
) -> int:
    """Predict what the errors of a machine leave on the part of an NC program.

    Figures: the deviation of the tool from the path at all moves at feed (um). Features: holes, full circles, sides of
    contours, faces: positions, diameters, roundness, distances, parallelism, flatness (um), angles of corners and walls
    (urad), with the standard uncertainty that the measurement of the machine gives them. --tables evaluates the same with
    the tables of a control, --correct with the corrected program, both together with a program that corrects what the
    tables leave. --also and --fleet rank several machines by the largest deviation, the best-fit rigid motion of the part
    removed. DIR gets part.json and part.html.

    \b
    Example:
      volcomp part zha-gantry part.nc --errors fitted.errors.csv --dialect fanuc --wcs G54=-400,-300,-350 --out part/
    """
    from compgen.programs.part import PartMachine, columns_of, predict_part, rank_machines

    if bool(tables) != (controller is not None):
        raise InputError("--tables and --controller belong together; give both")
    if fleet is not None and (errors or reversal or tables or also):
        raise InputError(
            "--fleet takes errors and active tables from the store; leave out --errors, --reversal, --tables and --also"
        )
    if heat.temperatures is not None and (fleet is not None or also):
        raise InputError("--temperatures are those of one machine; leave out --also and --fleet, or --temperatures")
    folder = OutputFolder(out) if out is not None else None
    notes: list[str] = []
    if fleet is not None:
        own, others, missing = _of_fleet(fleet, machine)
        notes += [f"no identified errors in the store: {', '.join(missing)}"] if missing else []
    else:
        own_machine = with_prior_class(open_machine(machine, machines, used=(controller,)), prior)
        model, others = _model(own_machine, errors, reversal, heat=heat), _also(also)
        covariance = covariance_of(Path(str(errors)), model.errors, None, independent=False)
        read = None
        if tables:
            from compgen.tables import read_tables

            read = read_tables(model.machine, tables, str(controller), foreign=True)
        own = PartMachine(model.machine.name, model, covariance_or_independent(model.errors, covariance), read)
    if uncertainty and own.covariance is None:
        raise InputError("has no uncertainties; identify the errors again, or leave out --uncertainty", file=errors)
    known = setup(own.model.machine)
    with progress(quiet=as_json) as show:
        how = CorrectOptions(dialect=options.dialect) if correct else None
        found = predict_part(
            own.model, program, options.dialect, known,
            covariance=own.covariance, tables=own.tables, correct=how, show=show,
        )  # fmt: skip
        found = replace(found, machine=own.name)
        # a table that is to be judged does not run yet; those of a fleet do
        now = own if fleet is not None else replace(own, tables=None)
        ranked = rank_machines([now, *others], program, options.dialect, known, show=show) if others else []
    data = found.as_dict()
    if ranked:
        data["machines"] = [item.ranked() for item in ranked]
    if folder is not None:
        folder.add("part.json", json_text(data))
        from compgen.report.part_page import part_page

        folder.add("part.html", page_shown(part_page(found, ranked, language)))
        paths = list(folder.commit().values())
    shown = [_figures_table(found, controller), *([_ranking_table(ranked)] if ranked else [])]
    columns = columns_of(found.features)
    kinds: dict[tuple[str, str], list[Feature]] = {}
    for item in found.features:
        kinds.setdefault((item.name.split()[0], item.quantity.split()[0]), []).append(item)
    few = [item for group in kinds.values() for item in group[:MOST_OF_A_KIND]]
    rows = [
        (
            item.name,
            item.quantity,
            str(item.line),
            f"{item.nominal:.3f}",
            *(f"{getattr(item, key):+.2f}" for key in columns),
            number_text(item.u, 2),
            item.unit,
        )
        for item in few
    ]
    if rows:
        names = ("feature", "quantity", "line", "nominal (mm, deg)", *columns.values(), "u (k = 1)", "unit")
        shown.append(table_of(names, rows))
    says = [*found.notes, *notes, *(f"assumed: {text}" for text in found.assumed)]
    more = len(found.features) - len(few)
    if more > 0:
        says.append(f"{more} more quantities{' in part.json' if folder is not None else ', with --out in part.json'}")
    if found.left_out:
        says.append(f"{found.left_out} more features were not evaluated")
    answer(as_json, data, *shown, *says, *([f"  {path}" for path in paths] if folder is not None else []))
    return 0


def _figures_table(found: PartPrediction, controller: str | None) -> Any:
    titles = (
        "tool from the path, moves at feed (um)",
        "from the path",
        "rms",
        "at ends",
        "with along it",
        "rms",
        "line",
        "after best fit",
        "rms",
    )
    keys = ("normal_max_um", "normal_rms_um", "ends_max_um", "max_um", "rms_um")
    tables = "tables" if controller is None else controller
    names = ("", f", {tables}", ", program corrected", f", {tables} and program")
    known = [
        (f"{found.machine}{name}", one) for name, one in zip(names, found.variants, strict=True) if one is not None
    ]
    figures = [(name, one.as_dict()) for name, one in known]
    fitted = [tuple(f"{one[key]:.2f}" for key in ("max_um", "rms_um")) for one in found.fitted.values()]
    both = [*fitted, *[("", "")] * (len(figures) - len(fitted))]
    rows = [
        (name, *(f"{one[key]:.2f}" for key in keys), str(one["normal_line"]), *fit)
        for (name, one), fit in zip(figures, both, strict=True)
    ]
    return table_of(titles, rows)


def _ranking_table(ranked: Sequence[PartPrediction]) -> Any:
    titles = ("machine", "best fit (um)", "rms", "from the path", "largest error of a feature", "um", "u (k = 1)")
    rows: list[tuple[str, ...]] = []
    for item in ranked:
        if item.refused:
            rows.append((item.machine, "-", "-", "-", item.refused, "-", "-"))
            continue
        figures, worst = item.rank_figures, item.worst("um")
        what = ("", "", "")
        if worst is not None:
            what = (f"{worst.name}, {worst.quantity}", f"{worst.best:+.2f}", number_text(worst.u, 2))
        numbers = (figures["max_um"], figures["rms_um"], item.best.as_dict()["normal_max_um"])
        rows.append((item.machine, *(f"{number:.2f}" for number in numbers), *what))
    return table_of(titles, rows)
