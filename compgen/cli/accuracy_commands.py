"""``volcomp accuracy`` and ``volcomp compare``."""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource
from rich.console import Console, RenderableType

from compgen.accuracy.circularity import accuracy_of_circles
from compgen.accuracy.compare import CompareOptions
from compgen.accuracy.evaluate import accuracy_of_errors
from compgen.accuracy.positioning import SetupBudget, accuracy_of_diagonals, accuracy_of_runs
from compgen.accuracy.sides import Reader, compare_prediction, compare_sides, read_side, with_prediction
from compgen.cli.common import NUMBER, PATH, Command, json_option, language_option, options_of, out_option, page_shown
from compgen.cli.identify_commands import of_rotary_axes
from compgen.cli.shared_options import instrument_option, machine_argument, prior_option
from compgen.cli.terminal import answer, progress
from compgen.data.files import OutputFolder, json_text
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.errors import InputError
from compgen.foreign import native_format, open_measurement
from compgen.pipeline import provenance_of, write_all
from compgen.report.dcc.laboratory import read_certificate
from compgen.report.sheets import rows_with_tolerance, sheet_page
from compgen.report.terminal import accuracy_table, comparison_table
from compgen.tables import read_tables


def evaluation_options(*without: str) -> Callable[[Command], Command]:
    """Add the options of the evaluation; the command receives ``options``, ``budget`` and a reader of files."""

    def decorate(command: Command) -> Command:
        decorated: Any = options_of(SetupBudget, "budget", build=_budget)(command)
        text = "Axis of an instrument's file that does not state it."
        decorated = click.option("--axis", type=click.Choice(AXES, case_sensitive=False), help=text)(decorated)
        text = "Standard uncertainty of measured deviations, um."
        decorated = click.option("--u-deviation-um", type=NUMBER, help=text)(decorated)
        decorated = instrument_option(decorated)
        text = "Remove the best-fit rigid motion from the volume (default: keep it)."
        decorated = click.option("--remove-rigid-motion", is_flag=True, help=text)(decorated)
        return options_of(CompareOptions, "options", without=without, read={"edition": int})(decorated)  # type: ignore[no-any-return]

    return decorate


class Tolerance(click.ParamType[Any]):
    """``FIGURE=UM`` or ``GROUP.FIGURE=UM``, as the key of :func:`rows_with_tolerance` and um."""

    name = "tolerance"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        """Return figure and um; fails for anything else."""
        key, _, number = str(value).partition("=")
        try:
            tolerance = float(number.removesuffix("um"))
        except ValueError:
            tolerance = math.nan
        if not key or not (math.isfinite(tolerance) and tolerance > 0.0):
            self.fail(f"{value!r} is not a tolerance; expected FIGURE=UM above zero, for example A=8", param, ctx)
        return key.replace(".", " ", 1), tolerance


def _budget(**values: float) -> SetupBudget:
    for name, value in values.items():
        if name != "from_20_k" and not (math.isfinite(value) and value >= 0.0):
            option = f"--u-{name.removeprefix('u_').replace('_', '-')}"
            raise InputError(f"{value:g} is not a standard uncertainty; expected 0 or above", field=option)
    return SetupBudget(**values)


def _completed(options: CompareOptions, machine: Machine, budget: SetupBudget, *, rigid: bool) -> CompareOptions:
    """Return the options with the budget of each axis (its own expansion) and the alignment of --remove-rigid-motion."""
    if rigid and options.alignment is not None:
        given = f"--alignment {options.alignment} and --remove-rigid-motion"
        raise InputError(f"{given} cannot be combined; give only one")
    budgets = {}
    for axis, item in zip(AXES, machine.axes, strict=True):
        known = item.expansion_um_per_m_k
        budgets[axis] = budget if known is None else replace(budget, expansion_um_per_m_k=known)
    return replace(options, budgets=budgets, alignment="best-fit" if rigid else options.alignment)


def _reader(axis: str | None, *paths: Path) -> Reader:
    """Reader of measurements; InputError if --axis is given for a file that states its axis."""
    for path in paths if axis is not None else ():
        if path.is_dir() or native_format(path) is not None:
            raise InputError(
                "already states its axis; --axis is only for files of instruments", file=path, field="--axis"
            )
    return functools.partial(open_measurement, axis=axis)


@click.command("accuracy")
@machine_argument
@prior_option
@click.argument("file", type=PATH)
@evaluation_options("align")
@click.option(
    "--tolerance",
    "tolerances",
    multiple=True,
    metavar="FIGURE=UM",
    type=Tolerance(),
    help="Tolerance of a figure in um, for the sheet: A=8, or of one axis or circle: X.A=8 (may be given several times).",
)
@click.option(
    "--certificate",
    type=PATH,
    help="Laboratory, customer, persons, instruments and conditions for the sheet (TOML; see docs/report.md).",
)
@out_option
@language_option
@json_option
def accuracy_command(
    machine: Machine,
    file: Path,
    tolerances: tuple[tuple[str, float], ...],
    certificate: Path | None,
    options: CompareOptions,
    remove_rigid_motion: bool,
    instrument: Path | None,
    u_deviation_um: float | None,
    axis: str | None,
    budget: SetupBudget,
    out: Path,
    language: str,
    as_json: bool,
) -> int:
    """Evaluate one measurement or error file by the standards, each figure with its uncertainty.

    FILE: *.axis.csv gives ISO 230-2 and VDI/DGQ 3441, *.diagonals.csv ISO 230-6, *.circle.csv ISO 230-4; errors
    (reversal from NAME.reversal.csv in the same folder, or a folder that identify or run wrote), tracer lengths,
    measured positions and six-DOF readings (identified first) give ISO 230-1 volumetric ranges, ISO 230-6
    diagonals, straightness, squareness. Values in um and urad. Writes accuracy.json and accuracy.txt to DIR, and for
    axis runs and circles sheet.html, to print: a page for each axis or circle.

    \b
    Example:
      volcomp accuracy zha-gantry identified/identified.errors.csv --out accuracy/
    """
    OutputFolder(out)
    laboratory = read_certificate(certificate) if certificate else None
    options = _completed(options, machine, budget, rigid=remove_rigid_motion)
    with progress(quiet=as_json) as show:
        show("reading and evaluating")
        if of_rotary_axes(file):
            raise InputError(
                "is of rotary axes; volcomp identify gives its figures: of runs those of ISO 230-2 (arcsec), of spheres and bars "
                "the position errors of the axes",
                file=file,
            )
        side = read_side(machine, file, instrument, u_deviation_um, _reader(axis, file))
        if side.runs is not None:
            found = accuracy_of_runs(side.runs, options.edition, options.budgets)
        elif side.diagonals is not None:
            found = accuracy_of_diagonals(machine, side.diagonals, options.edition, options.budgets)
        elif side.circles is not None:
            found = accuracy_of_circles(side.circles)
        else:
            known = side.errors()
            assert known.whole is not None
            found = accuracy_of_errors(known.whole(), options.alignment or "axes", options.line, known.reversal)
    data = {**found.summary(), "inputs": _inputs(machine, side.path)}
    files = {"accuracy.txt": _plain(accuracy_table(found))}
    rows = rows_with_tolerance(found, dict(tolerances))
    if side.readings is not None or side.circles is not None:
        files["sheet.html"] = page_shown(sheet_page(machine, side, found, rows, options.edition, laboratory, language))
    elif click.get_current_context().get_parameter_source("certificate") is ParameterSource.COMMANDLINE:
        raise InputError(
            "applies to the sheet of axis runs or circles, which this file does not contain", field="--certificate"
        )
    if tolerances:
        data["tolerances"] = {
            name: {row.key: {"tolerance_um": row.tolerance, "verdict": row.verdict} for row in group if row.verdict}
            for name, group in rows.items()
        }
    files["accuracy.json"] = json_text(data)
    write_all(out, files)
    answer(as_json, data, accuracy_table(found))
    return 0


@click.command("compare")
@machine_argument
@click.argument("before", type=PATH)
@click.argument("after", type=PATH)
@click.option(
    "--predicted", is_flag=True, help="BEFORE predicts what AFTER measures: errors, or the output of predict."
)
@click.option(
    "--tables",
    multiple=True,
    metavar="FILE",
    type=PATH,
    help="Controller files active during AFTER: the result they predict from the errors BEFORE is compared with AFTER, too.",
)
@click.option("--controller", metavar="NAME", help="Control that --tables belong to.")
@click.option(
    "--expect",
    type=click.Choice(["better", "not-worse"]),
    default="better",
    help="What exit code 0 requires (default better).",
)
@evaluation_options()
@out_option
@json_option
def compare_command(
    machine: Machine,
    before: Path,
    after: Path,
    predicted: bool,
    tables: tuple[Path, ...],
    controller: str | None,
    expect: str,
    options: CompareOptions,
    remove_rigid_motion: bool,
    instrument: Path | None,
    u_deviation_um: float | None,
    axis: str | None,
    budget: SetupBudget,
    out: Path,
    as_json: bool,
) -> int:
    """Compare before and after: improvement factors with uncertainty, per volume, axis and error.

    BEFORE and AFTER are two error files (*.errors.csv, um and urad), or two measurements of the same kind: *.axis.csv,
    *.diagonals.csv, *.deviations.csv, *.lengths.csv or *.sixdof.csv (the last two are identified first). Both need the
    same points. A figure is "better" only if the intervals value +/- U (k = 2) do not overlap (then En > 1).

    Exit code 0: better (or smaller, if no uncertainty is known), and a prediction agrees; otherwise 1. Writes
    compare.json and compare.txt to DIR.

    \b
    Example:
      volcomp compare zha-gantry before.errors.csv after.errors.csv --out compared/
    """
    OutputFolder(out)
    if bool(tables) != (controller is not None):
        raise InputError("--tables and --controller must be given together")
    if predicted and tables:
        raise InputError(
            "--predicted cannot be combined with --tables: with --tables the emulator makes the prediction"
        )
    options = _completed(options, machine, budget, rigid=remove_rigid_motion)
    with progress(quiet=as_json) as show:
        show("reading BEFORE and AFTER")
        reader = _reader(axis, before, after)
        first, second = (read_side(machine, path, instrument, u_deviation_um, reader) for path in (before, after))
        show("comparing")
        found = compare_prediction(first, second, options) if predicted else compare_sides(first, second, options)
        if controller is not None:
            found = with_prediction(found, first, second, read_tables(machine, tables, controller), options)
    verdict = None if found.prediction is None else found.prediction.verdict
    if found.kind == "prediction":
        accepted = verdict == "agrees"
    else:
        better = found.improved or (expect == "not-worse" and found.verdict not in ("worse", "larger"))
        accepted = better and verdict != "disagrees"
    inputs = _inputs(machine, first.path, second.path, *tables)
    data = {"accepted": accepted, **found.summary(), "machine": machine.name, "inputs": inputs}
    text = comparison_table(found)
    write_all(out, {"compare.json": json_text(data), "compare.txt": _plain(text)})
    answer(as_json, data, text)
    return 0 if accepted else 1


def _inputs(machine: Machine, *paths: Path) -> list[dict[str, str]]:
    known = provenance_of(machine.source, *paths)
    return [{"name": name, "sha256": digest} for name, digest in known.inputs]


def _plain(text: RenderableType) -> str:
    stream = io.StringIO()
    Console(file=stream, width=130, no_color=True, highlight=False, emoji=False, markup=False).print(text)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"
