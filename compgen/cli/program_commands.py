"""``volcomp correct`` and ``volcomp part``: the NC program itself, and what a machine makes of it."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import PATH, Command, for_readers, json_option, language_option, options_of, out_option
from compgen.cli.shared_options import covariance_of, machine_argument, open_machine, path_option, tool_offset
from compgen.cli.terminal import answer, complain, progress, table_of
from compgen.data.error_table import read_reversal
from compgen.data.files import OutputFolder, json_text, sha256_of_file
from compgen.data.machine import Machine, Vector3
from compgen.effects import effects_reversal
from compgen.errors import InputError, number_text
from compgen.foreign import open_errors
from compgen.identify.covariance import covariance_or_independent
from compgen.programs import CorrectOptions, Setup, correct_program, model_of, read_tools

WCS_HELP = (
    "Work offset: machine position of its zero in mm, e.g. G54=-400,150,-220 (several times for several offsets)."
)
TOOLS_HELP = "Tool lengths: CSV with tool, length_mm and optionally x_mm, y_mm; or a tool table of LinuxCNC in mm."


def _wcs(given: tuple[str, ...]) -> dict[str, Vector3]:
    found: dict[str, Vector3] = {}
    for text in given:
        name, _, numbers = text.partition("=")
        try:
            x, y, z = (float(part) for part in numbers.split(","))
        except ValueError:
            x = y = z = float("nan")
        if not name or not all(abs(part) < 1e6 for part in (x, y, z)):
            raise InputError(f"{text[:60]!r} is no work offset; expected e.g. G54=-400,150,-220 (mm)", field="--wcs")
        if name.upper() in found:
            raise InputError(f"{name} is given twice; give it once", field="--wcs")
        found[name.strip().upper()] = (x, y, z)
    return found


def program_options(command: Command) -> Command:
    """Add what a program needs to be read on a machine; the command receives ``setup`` and ``model``."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        machine: Machine,
        errors: Path,
        reversal: Path | None,
        wcs: tuple[str, ...],
        tools: Path | None,
        block_delete: bool,
        keep_unknown: tuple[str, ...],
        gauge: str,
        only: str | None = None,
        **options: Any,
    ) -> Any:
        codes = frozenset(code.strip().upper() for text in keep_unknown for code in text.split(",") if code.strip())
        setup = Setup(_wcs(wcs), read_tools(tools) if tools else {}, block_delete, codes, tool_offset("--gauge", gauge))
        both = read_reversal(reversal) if reversal else effects_reversal(machine)
        model = model_of(machine, open_errors(errors), both, only)
        return command(*args, model=model, setup=setup, errors=errors, **options)

    decorated: Any = wrapper
    text = "Code that moves nothing and stays as it is, e.g. M100 or G5.1 (may be given several times)."
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
        required=True,
        metavar="ERRORS",
        type=PATH,
        help="*.errors.csv of the machine (um, urad), or an Etalon exchange file (mm, rad).",
    )(decorated)


@click.command("correct")
@machine_argument
@click.argument("program", type=PATH)
@program_options
@options_of(CorrectOptions, "options")
@click.option("--only", metavar="AXES", help="Correct only these axes, e.g. X,Y; the others stay as they are.")
@path_option(
    "--active",
    "Table that is active on the control while the program runs (several times): the program then corrects only what it leaves.",
    multiple=True,
)
@click.option("--active-controller", metavar="NAME", help="Name of the control that the active tables belong to.")
@out_option
@language_option
@json_option
def correct_command(
    model: Any,
    setup: Setup,
    errors: Path,
    program: Path,
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
    named NOT-ACCEPTED-... (exit code 1). Variables, subprograms, cutter radius compensation, turned coordinates and rotary
    axes are refused with their line. DIR gets the program, correction.json and preflight.md. Nothing may be corrected twice:
    tables that are active while the program runs are given with --active, unless ERRORS were measured with them on.

    \b
    Example:
      volcomp correct zha-gantry part.nc --errors fitted.errors.csv --dialect fanuc --wcs G54=-400,-300,-350 --out corrected/
    """
    if bool(active) != (active_controller is not None):
        raise InputError("--active and --active-controller belong together; give both")
    name = errors.name
    if active:
        from compgen.programs.part import CompensatedModel
        from compgen.tables import read_tables

        tables = read_tables(model.machine, active, str(active_controller), foreign=True)
        model = CompensatedModel(model.machine, model.errors, model.reversal, model.only, tables)
        name += f" with the active tables of {active_controller}"
    with progress(quiet=as_json) as show:
        result = correct_program(
            model,
            program,
            out,
            options,
            setup,
            errors_file=(name, sha256_of_file(errors)),
            show=show,
            language=language,
        )
    for reason in result.reasons:
        complain(f"not acceptable: {reason}", "red")
    found = result.as_dict()
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
    says = [f"assumed: {text}" for text in result.assumed]
    answer(as_json, {**found, "file": str(out / result.file)}, table, counts, *says, f"-> {out / result.file}")
    return 0 if result.accepted else 1


# ``volcomp part``.


ALSO_HELP = (
    "Another machine with its errors, e.g. mill2.toml=mill2.errors.csv (several times): the machines are ranked."
)
MOST_ROWS = 30


@click.command("part")
@machine_argument
@click.argument("program", type=PATH)
@program_options
@options_of(CorrectOptions, "options", only=("dialect",))
@click.option("--uncertainty", is_flag=True, help="Require the uncertainty: exit code 2 if the errors have none.")
@path_option("--tables", "Table of a control (several times): also evaluate the part with it active.", multiple=True)
@click.option("--controller", metavar="NAME", help="Name of the control that the tables belong to.")
@click.option("--also", multiple=True, metavar="MACHINE=ERRORS", help=ALSO_HELP)
@click.option("--out", metavar="DIR", type=PATH, help="Folder for part.json and part.html.")
@language_option
@json_option
def part_command(
    model: Any,
    setup: Setup,
    errors: Path,
    program: Path,
    options: CorrectOptions,
    uncertainty: bool,
    tables: tuple[Path, ...],
    controller: str | None,
    also: tuple[str, ...],
    out: Path | None,
    language: str,
    as_json: bool,
) -> int:
    """Predict what the errors of a machine leave on the part of an NC program.

    Figures: the deviation of the tool from the path at all moves at feed (um). Features: position of drilled holes and full
    circles, diameters, distances, angles of corners (urad) and distances of parallel sides in the plane XY, with the
    standard uncertainty that the measurement of the machine gives them. --tables evaluates the same with the tables of a
    control. --also ranks several machines by the largest deviation normal to the path. DIR gets part.json and part.html.

    \b
    Example:
      volcomp part zha-gantry part.nc --errors fitted.errors.csv --dialect fanuc --wcs G54=-400,-300,-350 --out part/
    """
    from compgen.programs import part_page, predict_part

    if bool(tables) != (controller is not None):
        raise InputError("--tables and --controller belong together; give both")
    folder = OutputFolder(out) if out is not None else None
    read = None
    if tables:
        from compgen.tables import read_tables

        read = read_tables(model.machine, tables, str(controller), foreign=True)
    covariance = covariance_or_independent(model.errors, covariance_of(errors, model.errors, None, independent=False))
    if uncertainty and covariance is None:
        raise InputError("has no uncertainties; identify the errors again, or leave out --uncertainty", file=errors)
    with progress(quiet=as_json) as show:
        found = predict_part(model, program, options.dialect, setup, covariance=covariance, tables=read, show=show)
        others = []
        for text in also:
            name, _, file = text.rpartition("=")
            if not name:
                raise InputError(f"{text!r} is not of the form MACHINE=ERRORS", field="--also")
            machine, table = open_machine(name), open_errors(Path(file))
            other = model_of(machine, table, effects_reversal(machine))
            others.append(predict_part(other, program, options.dialect, setup, show=show))
    ranked = sorted([found, *others], key=lambda item: item.figures.normal_mm)
    data = found.as_dict()
    if also:
        data["machines"] = [{"machine": item.machine, **item.figures.as_dict()} for item in ranked]
    if folder is not None:
        folder.add("part.json", json_text(data))
        folder.add("part.html", for_readers({"part.html": part_page(found)}, language)["part.html"])
        paths = list(folder.commit().values())
    titles = (
        "tool from the path, moves at feed (um)",
        "from the path",
        "rms",
        "at ends",
        "with along it",
        "rms",
        "line",
    )
    keys = ("normal_max_um", "normal_rms_um", "ends_max_um", "max_um", "rms_um")
    lines = [(item.machine, item.figures.as_dict()) for item in ranked]
    if found.after is not None:
        lines.append((f"{found.machine}, {controller}", found.after.as_dict()))
    rows = [(name, *(f"{one[key]:.2f}" for key in keys), str(one["worst_line"])) for name, one in lines]
    shown = [table_of(titles, rows)]
    features = [
        (
            item.name,
            item.quantity,
            str(item.line),
            f"{item.nominal:.3f}",
            f"{item.error:+.2f}",
            number_text(item.after, 2),
            number_text(item.u, 2),
            item.unit,
        )
        for item in found.features[:MOST_ROWS]
    ]
    if features:
        names = ("feature", "quantity", "line", "nominal (mm, deg)", "error", "with tables", "u (k = 1)", "unit")
        shown.append(table_of(names, features))
    says = [f"assumed: {text}" for text in found.assumed]
    more = len(found.features) + found.left_out - MOST_ROWS
    if more > 0:
        says.append(f"{more} more features{' in part.json' if folder is not None and not found.left_out else ''}")
    answer(as_json, data, *shown, *says, *([f"  {path}" for path in paths] if folder is not None else []))
    return 0
