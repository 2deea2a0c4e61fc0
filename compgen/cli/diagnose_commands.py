"""``compgen diagnose``."""

from __future__ import annotations

from pathlib import Path

import click

from compgen.cli.common import json_option, machine_argument, out_option, print_json, progress, stdout
from compgen.cli.identify_commands import sixdof_option
from compgen.controllers.isg.error_files import read_error_file
from compgen.core.files import OutputFolder
from compgen.core.machine import Machine
from compgen.diagnose import DiagnoseOptions, Diagnosis, diagnose
from compgen.diagnose.files import diagnosis_files, json_text
from compgen.diagnose.measurement import read_diagnosed
from compgen.diagnose.sixdof import SixDofDiagnosis, diagnose_sixdof, sixdof_text
from compgen.errors import InputError
from compgen.sixdof.instrument import read_instrument
from compgen.sixdof.readings import read_sixdof


@click.command("diagnose")
@machine_argument
@click.argument("measurements", nargs=-1, required=True, type=click.Path(path_type=Path))
@out_option
@click.option(
    "--max-effects", type=click.IntRange(0, 6), default=4, show_default=True, help="Most named effects at once."
)
@click.option("--effects", metavar="NAME,...", help="Look for these effects only; default: the whole catalogue.")
@click.option("--add", "added", multiple=True, metavar="NAME", help="Add this effect whether it was found or not.")
@sixdof_option
@click.option("--u-um", type=float, help="Standard uncertainty of a reading, um; used where no line was repeated.")
@click.option(
    "--against",
    type=click.Path(path_type=Path),
    metavar="ERRORS",
    help="Errors (*.errors.csv) that the measurement is compared with: which have changed?",
)
@json_option
def diagnose_command(
    machine: Machine,
    measurements: tuple[Path, ...],
    out: Path,
    max_effects: int,
    effects: str | None,
    added: tuple[str, ...],
    instrument: Path | None,
    u_um: float | None,
    against: Path | None,
    as_json: bool,
) -> int:
    """Find where model and measurement disagree, name the missing effect, add it, and see the gap shrink.

    MEASUREMENTS are *.lengths.csv (mm), *.deviations.csv or *.axis.csv files (um), or *.sixdof.csv files (mm) with
    --instrument, whose readings are asked about their instrument. Writes diagnosis.json,
    diagnosis.md, pages with pictures (index.html), and extended.toml: the machine with the effects that were found.

    Exit code 1: it cannot be decided, or the gap does not shrink on lines that were left out.

    \b
    Example:
      compgen diagnose zha-gantry lengths.csv --out diagnosis/
    """
    OutputFolder(out)
    names = tuple(name.strip() for name in effects.split(",") if name.strip()) if effects else ()
    predicted = None if against is None else read_error_file(against)
    options = DiagnoseOptions(max_effects, names, added, u_um, predicted)
    with progress(quiet=as_json) as show:
        show("reading the measurement")
        found: Diagnosis | SixDofDiagnosis
        if instrument is not None:
            if predicted is not None or names or added:
                raise InputError("--against, --effects and --add do not belong to six-DOF readings")
            found = diagnose_sixdof(machine, read_sixdof(measurements), read_instrument(instrument))
            contents = {"diagnosis.json": json_text(found.to_dict()), "diagnosis.md": sixdof_text(found)}
        else:
            found = diagnose(machine, read_diagnosed(measurements), options, show=show)
            show("drawing")
            contents = diagnosis_files(found)
    files = OutputFolder(out)
    for name, content in contents.items():
        files.add(name, content)
    files.commit()
    if as_json:
        print_json(found.to_dict())
    else:
        stdout.print(contents["diagnosis.md"])
    return 0 if found.acceptable else 1


COMMANDS = (diagnose_command,)
