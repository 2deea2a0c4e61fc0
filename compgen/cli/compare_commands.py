"""``volcomp accuracy`` and ``volcomp compare``."""

from __future__ import annotations

import functools
import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import click
from rich.console import Console, RenderableType

from compgen.accuracy.budget import Budget
from compgen.accuracy.compare import CompareOptions, Comparison
from compgen.accuracy.diagonals import accuracy_of_diagonals
from compgen.accuracy.evaluate import accuracy_of_errors, accuracy_of_runs
from compgen.accuracy.field import Alignment
from compgen.accuracy.iso230_2 import EDITIONS, LATEST
from compgen.accuracy.match import compare_prediction, compare_sides, with_prediction
from compgen.accuracy.pairing import ALIGN
from compgen.accuracy.sides import Reader, Side, read_side
from compgen.accuracy.straightness import LINES
from compgen.cli.common import NUMBER, Command, json_option, machine_argument, out_option, print_json, progress, stdout
from compgen.core.files import OutputFolder
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.errors import InputError
from compgen.imports import open_measurement, own_kind
from compgen.pipeline import provenance_of, write_all
from compgen.report.accuracy_text import accuracy_table, comparison_table
from compgen.verify import read_tables

ALIGN_HELP = (
    "How to bring different points together: common keeps those that both have, interpolate takes them linearly, model "
    "compares the errors identified from each. Default: different points are refused."
)
BUDGET_HELP = {
    "device_um": "of the device for each mean, um",
    "device_ppm": "of the device's length scale, 1e-6",
    "misalignment_mrad": "of the angle between beam and axis, mrad",
    "temperature_k": "of the axis' temperature, K (acts with expansion_um_per_m_k of the machine file, else 11.5)",
    "expansion_um_per_m_k": "of the coefficient of expansion, um/(m K) (acts with --from-20-k)",
    "drift_um": "of each mean by drift of the environment (EVE), um",
}
#: Options that fill a field of another name.
_FIELDS = {"expansion_um_per_m_k": "u_expansion_um_per_m_k"}


def budget_options(command: Command) -> Command:
    """Add the uncertainty of a positioning test; the command receives ``budgets`` by axis."""

    @functools.wraps(command)
    def wrapper(*args: Any, machine: Machine, from_20_k: float, **options: Any) -> Any:
        values = {_FIELDS.get(name, name): options.pop(f"u_{name}") for name in BUDGET_HELP}
        for name, value in values.items():
            if not (math.isfinite(value) and value >= 0.0):
                option = f"--u-{name.removeprefix('u_').replace('_', '-')}"
                raise InputError(f"{value:g} is given; a standard uncertainty is 0 or above", field=option)
        budgets = {}
        for axis, item in zip(AXES, machine.axes, strict=True):
            expansion = item.expansion_um_per_m_k if item.expansion_um_per_m_k is not None else 11.5
            budgets[axis] = Budget(**values, expansion_um_per_m_k=expansion, from_20_k=from_20_k)
        return command(*args, machine=machine, budgets=budgets, **options)

    decorated: Any = click.option(
        "--from-20-k", type=NUMBER, default=0.0, help="How far the axis was from 20 degC, K (default 0)."
    )(wrapper)
    for name, text in reversed(BUDGET_HELP.items()):
        option = f"--u-{name.replace('_', '-')}"
        help_text = f"Axis runs: standard uncertainty {text} (default 0)."
        decorated = click.option(option, f"u_{name}", type=NUMBER, default=0.0, help=help_text)(decorated)
    return decorated  # type: ignore[no-any-return]


def evaluation_options(command: Command) -> Command:
    """Add what the figures stand for: edition, reference line, alignment of the volume, instrument."""
    kind = click.Path(path_type=Path)
    edition = click.option(
        "--edition",
        type=click.Choice([str(year) for year in EDITIONS]),
        default=str(LATEST),
        help=f"Edition of ISO 230-2 (default {LATEST}); that of 1988 has 3 s in place of 2 s.",
    )
    line = click.option(
        "--line", type=click.Choice(list(LINES)), default="ls", help="Reference line of straightness (default ls)."
    )
    placed = click.option(
        "--alignment",
        type=click.Choice(["as-given", "axes"]),
        help="Volume: axes (default for errors): zero at the reference point, X and Y along their end points; as-given "
        "(default for measured positions).",
    )
    rigid = click.option(
        "--remove-rigid-motion", is_flag=True, help="Take the best-fit rigid motion out of the volume (default: stays)."
    )
    constants = click.option(
        "--instrument", metavar="FILE", type=kind, help="Constants of a six-DOF instrument (TOML)."
    )
    u_um = click.option("--u-deviation-um", type=NUMBER, help="Standard uncertainty of measured deviations, um.")
    axis = click.option(
        "--axis",
        type=click.Choice(AXES, case_sensitive=False),
        help="Axis of an instrument's file that does not say it.",
    )
    return edition(line(placed(rigid(constants(u_um(axis(command)))))))


def _reader(axis: str | None, *paths: Path) -> Reader:
    """Reader of measurements; InputError for an axis beside files that say themselves what they hold."""
    for path in paths if axis is not None else ():
        if path.is_dir() or own_kind(path) is not None:
            raise InputError("says itself what it holds; --axis is for files of instruments", file=path, field="--axis")
    return functools.partial(open_measurement, axis=axis)


def _alignment(given: str | None, *, rigid: bool) -> Alignment | None:
    if rigid and given is not None:
        raise InputError(f"--alignment {given} and --remove-rigid-motion exclude each other; give one of them")
    return "best-fit" if rigid else cast(Alignment | None, given)


@click.command("accuracy")
@machine_argument
@click.argument("file", type=click.Path(path_type=Path))
@evaluation_options
@budget_options
@out_option
@json_option
def accuracy_command(
    machine: Machine,
    file: Path,
    edition: str,
    line: str,
    alignment: str | None,
    remove_rigid_motion: bool,
    instrument: Path | None,
    u_deviation_um: float | None,
    axis: str | None,
    budgets: Mapping[str, Budget],
    out: Path,
    as_json: bool,
) -> int:
    """Evaluate one measurement or error file by the standards, each figure with its uncertainty.

    FILE: *.axis.csv gives ISO 230-2 and VDI/DGQ 3441, *.diagonals.csv ISO 230-6; errors (reversal from NAME.reversal.csv
    beside them, or a folder that identify or run wrote), tracer lengths, measured positions and six-DOF readings
    (identified first) give ISO 230-1 volumetric ranges, ISO 230-6 diagonals, straightness, squareness. Values in um and
    urad. Writes accuracy.json and accuracy.txt to DIR.

    \b
    Example:
      volcomp accuracy zha-gantry identified/identified.errors.csv --out accuracy/
    """
    OutputFolder(out)
    placed = _alignment(alignment, rigid=remove_rigid_motion)
    with progress(quiet=as_json) as show:
        show("reading and evaluating")
        side = read_side(machine, file, instrument, u_deviation_um, _reader(axis, file))
        if side.runs is not None:
            found = accuracy_of_runs(side.runs, int(edition), budgets)
        elif side.diagonals is not None:
            found = accuracy_of_diagonals(machine, side.diagonals, int(edition), budgets)
        else:
            known = side.errors()
            assert known.source is not None
            found = accuracy_of_errors(known.source, placed or "axes", line, known.reversal)
    data = {**found.summary(), "inputs": _inputs(machine, side.path)}
    files = {"accuracy.json": _json(data), "accuracy.txt": _plain(accuracy_table(found))}
    write_all(out, files)
    if as_json:
        print_json(data)
    else:
        stdout.print(accuracy_table(found))
    return 0


@click.command("compare")
@machine_argument
@click.argument("before", type=click.Path(path_type=Path))
@click.argument("after", type=click.Path(path_type=Path))
@click.option("--align", type=click.Choice(ALIGN), help=ALIGN_HELP)
@click.option(
    "--predicted", is_flag=True, help="BEFORE predicts what AFTER measures: errors, or the output of predict."
)
@click.option(
    "--tables",
    multiple=True,
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Controller files active during AFTER: what they predict on the errors BEFORE is compared with AFTER as well.",
)
@click.option("--controller", metavar="NAME", help="Control that --tables belong to.")
@click.option(
    "--expect",
    type=click.Choice(["better", "not-worse"]),
    default="better",
    help="What exit code 0 needs (default better).",
)
@evaluation_options
@budget_options
@out_option
@json_option
def compare_command(
    machine: Machine,
    before: Path,
    after: Path,
    align: str | None,
    predicted: bool,
    tables: tuple[Path, ...],
    controller: str | None,
    expect: str,
    edition: str,
    line: str,
    alignment: str | None,
    remove_rigid_motion: bool,
    instrument: Path | None,
    u_deviation_um: float | None,
    axis: str | None,
    budgets: Mapping[str, Budget],
    out: Path,
    as_json: bool,
) -> int:
    """Compare before and after: improvement factors with uncertainty, per volume, axis and error.

    BEFORE and AFTER are two error files (*.errors.csv, um and urad), or two measurements of a kind: *.axis.csv,
    *.diagonals.csv, *.deviations.csv, *.lengths.csv or *.sixdof.csv (the last two are identified first). Both need the
    same points. A figure is "better" only where the bands value +/- U (k = 2) separate (then En > 1).

    Exit code 0: better (or smaller, where no uncertainty is known), and a prediction agrees; else 1. Writes compare.json
    and compare.txt to DIR.

    \b
    Example:
      volcomp compare zha-gantry before.errors.csv after.errors.csv --out compared/
    """
    OutputFolder(out)
    if bool(tables) != (controller is not None):
        raise InputError("--tables and --controller belong together; give both or neither")
    if predicted and tables:
        raise InputError("--predicted and --tables exclude each other; with --tables the emulator makes the prediction")
    placed = _alignment(alignment, rigid=remove_rigid_motion)
    options = CompareOptions(align, placed, line, int(edition), budgets)
    with progress(quiet=as_json) as show:
        show("reading BEFORE and AFTER")
        reader = _reader(axis, before, after)
        sides = [read_side(machine, path, instrument, u_deviation_um, reader) for path in (before, after)]
        show("comparing")
        found = _compared(machine, sides[0], sides[1], options, predicted, tables, controller)
    accepted = _accepted(found, expect)
    inputs = _inputs(machine, *(side.path for side in sides), *tables)
    data = {"accepted": accepted, **found.summary(), "machine": machine.name, "inputs": inputs}
    text = comparison_table(found)
    write_all(out, {"compare.json": _json(data), "compare.txt": _plain(text)})
    if as_json:
        print_json(data)
    else:
        stdout.print(text)
    return 0 if accepted else 1


def _compared(
    machine: Machine,
    before: Side,
    after: Side,
    options: CompareOptions,
    predicted: bool,
    tables: tuple[Path, ...],
    controller: str | None,
) -> Comparison:
    if predicted:
        return compare_prediction(before, after, options)
    found = compare_sides(before, after, options)
    if controller is None:
        return found
    return with_prediction(found, before, after, read_tables(machine, tables, controller), options)


def _accepted(found: Comparison, expect: str) -> bool:
    if found.kind == "prediction":
        return found.prediction is not None and found.prediction.verdict == "agrees"
    if found.prediction is not None and found.prediction.verdict == "disagrees":
        return False
    return found.improved or (expect == "not-worse" and found.verdict not in ("worse", "larger"))


def _inputs(machine: Machine, *paths: Path) -> list[dict[str, str]]:
    known = provenance_of(machine.source, *paths)
    return [{"name": name, "sha256": digest} for name, digest in known.inputs]


def _json(data: Mapping[str, Any]) -> str:
    return json.dumps(_strict(data), indent=2, allow_nan=False) + "\n"


def _strict(value: Any) -> Any:
    """JSON knows no nan: what is not known or not finite becomes null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: _strict(item) for key, item in value.items()}
    return [_strict(item) for item in value] if isinstance(value, list | tuple) else value


def _plain(text: RenderableType) -> str:
    stream = io.StringIO()
    Console(file=stream, width=130, no_color=True, highlight=False, emoji=False, markup=False).print(text)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"


COMMANDS = (accuracy_command, compare_command)
