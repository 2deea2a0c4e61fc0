"""``volcomp identify`` and ``volcomp fit``."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import NUMBER, Command, json_option, machine_argument, out_option, print_json, progress, stdout
from compgen.cli.fit_options import covariance_of, covariance_options, fitting_options
from compgen.cli.parallel_options import fleet_options, mapper
from compgen.cli.safety_options import active_options
from compgen.core.files import OutputFolder
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.errors import InputError
from compgen.fit import FitOptions, fit
from compgen.identify import (
    IdentifyOptions,
    SystematicInputs,
    describe,
    read_stations,
)
from compgen.identify.evidence import evidence_files
from compgen.identify.monte_carlo import self_check
from compgen.identify.noise import METHODS
from compgen.imports import open_errors, open_measurement
from compgen.pipeline import (
    add_identification,
    failure_reported,
    fit_files,
    identification_files,
    identify_bare,
    provenance_of,
    write_all,
)
from compgen.report.text import fit_table, identification_table
from compgen.verify.active import ActiveTables

#: Options --u-... and the fields of SystematicInputs that they fill.
SYSTEMATIC_OPTIONS = (
    ("wavelength_ppm", "wavelength_ppm"),
    ("temperature_k", "temperature_k"),
    ("target_um", "target_um"),
    ("target_station_um", "target_station_um"),
    ("drift_um", "drift_um"),
)
SYSTEMATIC_HELP = {
    "wavelength_ppm": "Standard uncertainty of the length scale of all stations together, 1e-6 (default 0).",
    "temperature_k": "Standard uncertainty of each axis' temperature, K; acts with expansion_um_per_m_k (default 0).",
    "target_um": "Standard uncertainty of the target's position on the tool, um, for every tool and set-up (default 0).",
    "target_station_um": "The same, for every tool, set-up and station by itself, um (default 0).",
    "drift_um": "Standard uncertainty of each station's drift from its first to its last reading, um (default 0).",
}
METHOD_HELP = {
    "method": "joint (default): errors and stations in one adjustment; two-step: the tracers first locate themselves and "
    "all points, which needs four stations at common points.",
    "stations": "CSV with known stations (station, x_mm, y_mm, z_mm; optional u_mm, exact without), or the word nominal: "
    "located with the machine taken as perfect.",
    "no_temperature": "Leave the scales at the temperature that they had; by default they are corrected to 20 degC where the "
    "file has temp_x_c, temp_y_c, temp_z_c and the machine file expansion_um_per_m_k.",
    "part_scale": "Scale of a measured part (*.part.csv): known (default: 1, or by the temperatures in the file), or free: one "
    "unknown scale for each set-up, which takes the mean of the scale errors of the axes with it.",
    "travel": "machine (default): curves over the whole travel, nodes that no reading reaches tied by smoothness; from-data: "
    "over the range that the readings cover. For parts, and deviations at one height or without a component.",
    "u_deviation_um": "Standard uncertainty of a measured deviation (*.deviations.csv), um; default: the file's, else 1 um "
    "scaled by the residuals.",
    "small_deviations": "Take deviations that are all zero, or all below 0.1 um, as they are; without it they are refused, "
    "because nothing was measured then, or the values are in mm.",
}


def sixdof_option(command: Command) -> Command:
    """Add --instrument FILE."""
    text = "Constants and set-up of a six-DOF laser instrument (TOML), for *.sixdof.csv files."
    return click.option("--instrument", metavar="FILE", type=click.Path(path_type=Path), help=text)(command)


def instrument_options(command: Command) -> Command:
    """Add what the user may say about the readings."""
    constant = click.option(
        "--u-length-um", type=NUMBER, help="Constant part of the standard uncertainty of a length, um."
    )
    proportional = click.option(
        "--u-length-um-per-m", type=NUMBER, help="Part of the standard uncertainty that grows with the length, um/m."
    )
    keep = click.option("--keep-all", is_flag=True, help="Reject no reading, however far it is from the model.")
    return constant(proportional(keep(command)))


def systematic_options(command: Command) -> Command:
    """Add the uncertainties of inputs that all readings share; the command receives ``systematic``."""

    @functools.wraps(command)
    def wrapper(*args: Any, **options: Any) -> Any:
        values = {key: options.pop(f"u_{name}") for name, key in SYSTEMATIC_OPTIONS}
        return command(*args, systematic=SystematicInputs(**values), **options)

    decorated: Any = wrapper
    for name, key in reversed(SYSTEMATIC_OPTIONS):
        option = f"--u-{name.replace('_', '-')}"
        decorated = click.option(option, type=NUMBER, default=0.0, help=SYSTEMATIC_HELP[key])(decorated)
    return decorated  # type: ignore[no-any-return]


def method_options(command: Command) -> Command:
    """Add how to identify; the command receives ``choices``, fields of IdentifyOptions."""

    @functools.wraps(command)
    def wrapper(*args: Any, method: str, stations: str | None, no_temperature: bool, **options: Any) -> Any:
        known = read_stations(stations) if stations not in (None, "nominal") else stations
        choices: dict[str, Any] = {"method": method, "stations": known, "temperature": not no_temperature}
        names = ("u_deviation_um", "small_deviations", "part_scale", "travel")
        return command(*args, choices={**choices, **{name: options.pop(name) for name in names}}, **options)

    decorated: Any = click.option("--small-deviations", is_flag=True, help=METHOD_HELP["small_deviations"])(wrapper)
    decorated = click.option("--u-deviation-um", type=NUMBER, help=METHOD_HELP["u_deviation_um"])(decorated)
    for option, name, values in (
        ("--part-scale", "part_scale", ("known", "free")),
        ("--range", "travel", ("machine", "from-data")),
    ):
        kind = click.Choice(values)
        decorated = click.option(option, name, type=kind, default=values[0], help=METHOD_HELP[name])(decorated)
    decorated = click.option("--no-temperature", is_flag=True, help=METHOD_HELP["no_temperature"])(decorated)
    decorated = click.option("--stations", metavar="FILE", help=METHOD_HELP["stations"])(decorated)
    chosen = click.option("--method", type=click.Choice(METHODS), default="joint", help=METHOD_HELP["method"])
    return chosen(decorated)  # type: ignore[no-any-return]


def identify_options(
    u_length_um: float | None,
    u_length_um_per_m: float | None,
    keep_all: bool,
    systematic: SystematicInputs,
    choices: Mapping[str, Any],
) -> IdentifyOptions:
    """Return the options of the stage; ``choices`` as :func:`method_options` gives them."""
    return IdentifyOptions(u_length_um, u_length_um_per_m, reject=not keep_all, systematic=systematic, **choices)


@click.command("identify")
@machine_argument
@click.argument("measurements", nargs=-1, required=True, type=click.Path(path_type=Path))
@sixdof_option
@out_option
@instrument_options
@systematic_options
@method_options
@active_options("--controller")
@click.option(
    "--self-check",
    "replicates",
    type=click.IntRange(min=10),
    metavar="N",
    help="Identify N simulated sets of readings as well and compare their scatter with the stated uncertainties.",
)
@fleet_options
@json_option
def identify_command(
    machine: Machine,
    measurements: tuple[Path, ...],
    instrument: Path | None,
    out: Path,
    u_length_um: float | None,
    u_length_um_per_m: float | None,
    keep_all: bool,
    systematic: SystematicInputs,
    choices: Mapping[str, Any],
    active: ActiveTables | None,
    replicates: int | None,
    workers: int,
    cluster: str | None,
    as_json: bool,
) -> int:
    """Identify error curves, squareness and stations from tracer lengths, or errors from measured positions.

    Writes identified.errors.csv (um, urad, standard uncertainties) with identified.covariance.npz, stations.csv and
    identify.json to DIR. The uncertainties hold the readings' noise and the inputs given by --u-.... Without
    --u-length-um the comments u_length_um and u_length_um_per_m of the file count, else 0.1 um + 0.15 um/m.

    MEASUREMENTS are *.lengths.csv (mm) or *.deviations.csv files (dx_um, dy_um, dz_um: measured minus commanded; the
    placement of their frame is found as well). --method two-step also writes measured.deviations.csv. With --stations
    one or two stations are enough if they determine the errors of the machine file; if not, the combinations that stay
    open are named in identify.json and no error is written.

    *.sixdof.csv files hold raw readings of a six-DOF laser instrument (mm); --instrument describes it. All 21 errors come
    from them, without stations.csv. Beside lengths or deviations of the same machine both are compared and averaged; exit
    code 1 and a warning name the errors that disagree. --workers and --cluster share out the replicates of --self-check.

    \b
    Example:
      volcomp identify zha-gantry examples/zha-gantry.lengths.csv --out identified/
    """
    if replicates is None and (workers > 1 or cluster is not None):
        raise InputError("--workers and --cluster share out the replicates of --self-check, which is not given")
    OutputFolder(out)
    with progress(quiet=as_json) as show:
        show("reading the measurement")
        measurement = open_measurement(measurements, instrument)
        show(f"identifying: {describe(measurement)}")
        options = identify_options(u_length_um, u_length_um_per_m, keep_all, systematic, choices)
        with failure_reported(out):
            result = identify_bare(machine, measurement, options, active)
        checked = None
        if replicates is not None:
            if active is not None or not isinstance(measurement, Lengths):
                raise InputError("--self-check belongs to tracer lengths that were taken without active tables")
            with mapper(workers, cluster) as spread:
                checked = self_check(
                    machine,
                    measurement,
                    result,
                    replicates,
                    progress=lambda k: show(f"self-check: {k} of {replicates} replicates"),
                    mapper=spread,
                )
    files = identification_files(result, provenance_of(machine.source, *measurements, instrument), checked)
    output = OutputFolder(out)
    add_identification(output, {**files, **evidence_files(machine, measurement, result)})
    output.commit()
    if as_json:
        print_json({**result.summary(), **({"monte_carlo": checked.summary()} if checked else {})})
    else:
        stdout.print(identification_table(result))
        if checked:
            text = f"self-check, {checked.replicates} replicates: standard deviation over stated uncertainty "
            text += f"{checked.ratio_median:.2f} ({checked.ratio_min:.2f} ... {checked.ratio_max:.2f}): "
            stdout.print(text + ("agrees" if checked.agrees else "DOES NOT AGREE"))
    return 1 if result.details.get("disagree") else 0


@click.command("fit")
@machine_argument
@click.argument("errors", type=click.Path(path_type=Path))
@out_option
@fitting_options
@covariance_options
@json_option
def fit_command(
    machine: Machine,
    errors: Path,
    out: Path,
    fitting: FitOptions,
    covariance: Path | None,
    independent: bool,
    as_json: bool,
) -> int:
    """Fit smooth curves: straightness zero at both ends, positioning and angles zero at the reference point.

    ERRORS is an *.errors.csv file (um, urad), or the exchange file of a laser tracer's software (Etalon, variant Vendor;
    mm, rad). Writes fitted.errors.csv and fit.json to DIR. If the covariance that
    volcomp identify wrote lies beside ERRORS, its correlations count, else nodes are taken as independent.

    \b
    Example:
      volcomp fit zha-gantry identified/identified.errors.csv --max-abs linear=20 --out fitted/
    """
    OutputFolder(out)
    table = open_errors(errors)
    known = covariance_of(errors, table, covariance, independent=independent)
    result = fit(machine, table, fitting, covariance=known)
    write_all(out, fit_files(result))
    if as_json:
        print_json(result.to_dict())
    else:
        stdout.print(fit_table(result))
    return 0


COMMANDS = (identify_command, fit_command)
