"""``compgen identify`` and ``compgen fit``."""

from __future__ import annotations

from pathlib import Path

import click

from compgen.cli.common import Command, json_option, machine_argument, out_option, print_json, progress, stdout
from compgen.core.error_table import read_errors
from compgen.core.files import OutputFolder
from compgen.core.lengths import read_lengths
from compgen.core.machine import Machine
from compgen.errors import InputError
from compgen.fit import FitOptions, fit
from compgen.identify import IdentifyOptions, identify
from compgen.pipeline import fit_files, identification_files, provenance_of, write_all
from compgen.report.text import fit_table, identification_table


def instrument_options(command: Command) -> Command:
    """Add what the user may say about the readings."""
    constant = click.option(
        "--u-length-um", type=float, help="Constant part of the standard uncertainty of a length, um."
    )
    proportional = click.option(
        "--u-length-um-per-m", type=float, help="Part of the standard uncertainty that grows with the length, um/m."
    )
    keep = click.option("--keep-all", is_flag=True, help="Reject no reading, however far it is from the model.")
    return constant(proportional(keep(command)))


def smoothness_option(command: Command) -> Command:
    """Add --smoothness."""
    text = "Dimensionless weight of the second differences (0 keeps the data); default: chosen from the data."
    return click.option("--smoothness", type=float, help=text)(command)


def identify_options(u_length_um: float | None, u_length_um_per_m: float | None, keep_all: bool) -> IdentifyOptions:
    """Return the options of the stage."""
    return IdentifyOptions(u_length_um, u_length_um_per_m, reject=not keep_all)


def fit_options(smoothness: float | None) -> FitOptions:
    """Return the options of the stage."""
    return FitOptions(smoothness=smoothness)


@click.command("identify")
@machine_argument
@click.argument("measurements", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--instrument", type=click.Path(path_type=Path), help="Constants of a six-DOF instrument (TOML).")
@out_option
@instrument_options
@json_option
def identify_command(
    machine: Machine,
    measurements: tuple[Path, ...],
    instrument: Path | None,
    out: Path,
    u_length_um: float | None,
    u_length_um_per_m: float | None,
    keep_all: bool,
    as_json: bool,
) -> int:
    """Identify error curves, squareness and stations from tracer lengths.

    Writes identified.errors.csv (um, urad, standard uncertainties), stations.csv and identify.json to DIR. Without
    --u-length-um the comments u_length_um and u_length_um_per_m of the file count, else 0.1 um + 0.15 um/m.

    \b
    Example:
      compgen identify zha-gantry examples/zha-gantry.lengths.csv --out identified/
    """
    if instrument is not None:
        raise InputError(
            "--instrument belongs to six-DOF readings (*.sixdof.csv), which this version does not read yet"
        )
    OutputFolder(out)
    with progress(quiet=as_json) as show:
        show("reading the measurement")
        lengths = read_lengths(measurements)
        show(f"identifying: {len(lengths)} lengths of {len(lengths.stations)} stations")
        result = identify(machine, lengths, identify_options(u_length_um, u_length_um_per_m, keep_all))
    write_all(out, identification_files(result, provenance_of(machine.source, *measurements)))
    if as_json:
        print_json(result.summary())
    else:
        stdout.print(identification_table(result))
    return 0


@click.command("fit")
@machine_argument
@click.argument("errors", type=click.Path(path_type=Path))
@out_option
@smoothness_option
@json_option
def fit_command(machine: Machine, errors: Path, out: Path, smoothness: float | None, as_json: bool) -> int:
    """Fit smooth curves: straightness zero at both ends, positioning and angles zero at the reference point.

    ERRORS is an *.errors.csv file (um, urad). Writes fitted.errors.csv and fit.json to DIR.

    \b
    Example:
      compgen fit zha-gantry identified/identified.errors.csv --out fitted/
    """
    OutputFolder(out)
    result = fit(machine, read_errors(errors), fit_options(smoothness))
    write_all(out, fit_files(result))
    if as_json:
        print_json(result.to_dict())
    else:
        stdout.print(fit_table(result))
    return 0


COMMANDS = (identify_command, fit_command)
