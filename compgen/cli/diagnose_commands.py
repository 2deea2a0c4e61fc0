"""``volcomp diagnose``."""

from __future__ import annotations

from pathlib import Path

import click

from compgen.cli.common import NUMBER, json_option, machine_argument, out_option, print_json, progress, stdout
from compgen.cli.diagnose_batch import Asked, diagnose_each, diagnosed
from compgen.cli.identify_commands import sixdof_option
from compgen.cli.parallel_options import fleet_options
from compgen.controllers.isg.error_files import read_error_file
from compgen.core.files import OutputFolder
from compgen.core.machine import Machine
from compgen.diagnose import DiagnoseOptions
from compgen.diagnose.axis_session import ORDERS, Order
from compgen.diagnose.files import next_steps, summary
from compgen.errors import InputError


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
@click.option("--u-um", type=NUMBER, help="Standard uncertainty of a reading, um; used where no line was repeated.")
@click.option(
    "--against",
    type=click.Path(path_type=Path),
    metavar="ERRORS",
    help="Errors (*.errors.csv) that the measurement is compared with: which have changed?",
)
@click.option(
    "--order",
    type=click.Choice(ORDERS),
    default="auto",
    show_default=True,
    help="Order of axis runs in time: time_s or the column order, else run by run, up then down (auto); or as named. "
    "The order of rows counts with 'rows' only.",
)
@click.option(
    "--leave-out-disturbed", is_flag=True, help="Leave out short bursts of disturbed readings once they are found."
)
@click.option("--each", is_flag=True, help="Every measurement by itself, into a folder of --out by its name.")
@fleet_options
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
    order: Order,
    leave_out_disturbed: bool,
    each: bool,
    workers: int,
    cluster: str | None,
    as_json: bool,
) -> int:
    """Find where model and measurement disagree, name the missing effect, add it, and see the gap shrink.

    MEASUREMENTS are *.lengths.csv (mm), *.deviations.csv or *.axis.csv files (um), or *.sixdof.csv files (mm) with
    --instrument, whose readings are asked about their instrument. Writes diagnosis.json,
    diagnosis.md, pages with pictures (index.html), and extended.toml: the machine with the effects that were found, to be
    given to the next command in place of MACHINE. Axis runs (ISO 230-2): also removed.csv, what was taken off each reading.

    --each asks every file by itself; --workers and --cluster share those out.

    Exit code 1: it cannot be decided, or the gap does not shrink on lines that were left out.

    \b
    Example:
      volcomp diagnose zha-gantry lengths.csv --out diagnosis/
    """
    OutputFolder(out)
    names = tuple(name.strip() for name in effects.split(",") if name.strip()) if effects else ()
    predicted = None if against is None else read_error_file(against)
    options = DiagnoseOptions(max_effects, names, added, u_um, predicted, order, leave_out_disturbed)
    asked = Asked(machine, options, instrument)
    if each:
        return diagnose_each(asked, measurements, out, (workers, cluster), as_json=as_json)
    if workers > 1 or cluster is not None:
        raise InputError("--workers and --cluster share out the measurements of --each, which is not given")
    with progress(quiet=as_json) as show:
        show("reading the measurement")
        found, contents = diagnosed(asked, measurements, show)
    files = OutputFolder(out)
    for name, content in contents.items():
        files.add(name, content)
    files.commit()
    if as_json:
        print_json(found.to_dict())
    else:
        data = found.to_dict()
        stdout.print(
            contents["diagnosis.md"] if instrument is not None else summary(machine.name, data, markdown=False),
            soft_wrap=True,
        )
        steps = next_steps(contents, str(machine.source or machine.name), " ".join(map(str, measurements)), str(out))
        if steps:
            stdout.print(steps, soft_wrap=True)
    return 0 if found.acceptable else 1


COMMANDS = (diagnose_command,)
