"""``volcomp correct``: the NC program itself."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import PATH, Command, json_option, options_of, out_option
from compgen.cli.shared_options import machine_argument, path_option
from compgen.cli.terminal import answer, complain, progress, table_of
from compgen.data.error_table import read_reversal
from compgen.data.files import sha256_of_file
from compgen.data.machine import Machine, Vector3
from compgen.effects import effects_reversal
from compgen.errors import InputError
from compgen.foreign import open_errors
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
        only: str | None = None,
        **options: Any,
    ) -> Any:
        codes = frozenset(code.strip().upper() for text in keep_unknown for code in text.split(",") if code.strip())
        setup = Setup(_wcs(wcs), read_tools(tools) if tools else {}, block_delete, codes)
        both = read_reversal(reversal) if reversal else effects_reversal(machine)
        model = model_of(machine, open_errors(errors), both, only)
        return command(*args, model=model, setup=setup, errors=errors, **options)

    decorated: Any = wrapper
    text = "Code that moves nothing and stays as it is, e.g. M100 or G5.1 (may be given several times)."
    decorated = click.option("--keep-unknown", multiple=True, metavar="CODE", help=text)(decorated)
    text = "Blocks with / are skipped at the control; they stay as they are. Default: they are executed."
    decorated = click.option("--block-delete", is_flag=True, help=text)(decorated)
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
@out_option
@json_option
def correct_command(
    model: Any, setup: Setup, errors: Path, program: Path, options: CorrectOptions, out: Path, as_json: bool
) -> int:
    """Correct an NC program for the errors of one machine: the tool then follows the programmed path.

    For controls without tables. Every coordinate is replaced by the command at which the exact model of the machine brings
    the tool where the program wants it. Moves are divided where the correction bends by more than the tolerance. The
    corrected program is read again and compared with the path of the original; if that is not closer to it, the file is
    named NOT-ACCEPTED-... (exit code 1). Variables, subprograms, cutter radius compensation, turned coordinates and rotary
    axes are refused with their line. DIR gets the program, correction.json and preflight.md.

    \b
    Example:
      volcomp correct zha-gantry part.nc --errors fitted.errors.csv --dialect fanuc --wcs G54=-400,-300,-350 --out corrected/
    """
    with progress(quiet=as_json) as show:
        result = correct_program(
            model, program, out, options, setup, errors_file=(errors.name, sha256_of_file(errors)), show=show
        )
    for reason in result.reasons:
        complain(f"not acceptable: {reason}", "red")
    found = result.as_dict()
    rows = [
        (name, f"{found['before'][key]:.2f}", f"{found['after'][key]:.2f}")
        for name, key in (
            ("largest", "max_um"),
            ("rms", "rms_um"),
            ("largest, normal to the path", "normal_max_um"),
            ("rms, normal to the path", "normal_rms_um"),
            ("largest at ends of moves", "ends_max_um"),
        )
    ]
    table = table_of(("tool from the path, moves at feed (um)", "before", "after"), rows)
    counts = f"{found['blocks']} blocks, {found['changed_blocks']} changed, {found['added_blocks']} added"
    says = [f"assumed: {text}" for text in result.assumed]
    answer(as_json, {**found, "file": str(out / result.file)}, table, counts, *says, f"-> {out / result.file}")
    return 0 if result.accepted else 1
