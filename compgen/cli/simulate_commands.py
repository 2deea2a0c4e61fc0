"""``volcomp simulate`` and ``volcomp predict``."""

from __future__ import annotations

import warnings
from pathlib import Path

import click

from compgen.cli.common import json_option, machine_argument, out_option, print_json, progress, stdout
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.files import write_file
from compgen.core.machine import Machine
from compgen.core.points import Points, format_points, read_points
from compgen.effects import active_effects, displacement_of, readings_of_points
from compgen.errors import CompgenWarning, InputError
from compgen.identify import Covariance, predict_uncertainty, read_covariance
from compgen.imports import open_errors
from compgen.model import predict
from compgen.simulate import (
    AxisLaser,
    AxisSimulation,
    DiagonalLaser,
    SimulatedSixDof,
    Simulation,
    SixDofSimulation,
    read_scenario,
    simulate,
    simulate_axis_runs,
    simulate_sixdof,
    write_simulation,
)
from compgen.verify import residuals


@click.command("simulate")
@machine_argument
@click.option("--scenario", required=True, type=click.Path(path_type=Path), help="Scenario TOML; see docs/files.md.")
@out_option
@click.option("--seed", type=click.IntRange(min=0), help="Seed in place of the scenario's own.")
@json_option
def simulate_command(machine: Machine, scenario: Path, out: Path, seed: int | None, as_json: bool) -> int:
    """Simulate a machine and its measurement: writes *.lengths.csv (mm) and truth.errors.csv (um, urad) to DIR.

    A scenario whose instrument has type = "sixdof" writes *.sixdof.csv in place of lengths, one with "axis-laser"
    *.axis.csv, with "diagonal-laser" *.diagonals.csv (um).

    \b
    Example:
      volcomp simulate zha-gantry --scenario examples/zha-gantry.scenario.toml --out simulated/
    """
    with progress(quiet=as_json) as show:
        show("simulating")
        planned = read_scenario(scenario)
        simulation: Simulation | SixDofSimulation | AxisSimulation
        if isinstance(planned.instrument, AxisLaser | DiagonalLaser):
            simulation = simulate_axis_runs(machine, planned, seed)
        elif isinstance(planned.instrument, SimulatedSixDof):
            simulation = simulate_sixdof(machine, planned, seed)
        else:
            simulation = simulate(machine, planned, seed)
    paths = write_simulation(simulation, out)
    if as_json:
        if isinstance(simulation, SixDofSimulation | AxisSimulation):
            summary = {"readings": len(simulation.readings), "stations": []}
        else:
            summary = {"readings": len(simulation.lengths), "stations": list(simulation.lengths.stations)}
        print_json({**summary, "files": {name: str(path) for name, path in paths.items()}})
    else:
        for path in paths.values():
            stdout.print(f"  {path}", markup=False, soft_wrap=True)
    return 0


@click.command("predict")
@machine_argument
@click.argument("errors", type=click.Path(path_type=Path))
@click.option("--points", required=True, type=click.Path(path_type=Path), help="*.points.csv (mm).")
@click.option("--out", required=True, metavar="FILE", type=click.Path(path_type=Path), help="CSV file for the result.")
@click.option("--exact", is_flag=True, help="Finite rotations along the chain in place of E = C P.")
@click.option(
    "--uncertainty",
    is_flag=False,
    flag_value="",
    metavar="[FILE]",
    help="Add standard uncertainties; FILE is the covariance (default: the file that ERRORS names).",
)
@json_option
def predict_command(
    machine: Machine, errors: Path, points: Path, out: Path, exact: bool, uncertainty: str | None, as_json: bool
) -> int:
    """Predict the error of the tool tip at given points: E = C P, or the exact model.

    ERRORS is an *.errors.csv file (um, urad). With --exact the effects of the machine file that move the tip are added
    where the points hold their columns (approach_x ..., temp_..., time_s, feed_mm_min, load_kg). FILE gets the points plus
    ex_um, ey_um, ez_um, and with --uncertainty
    u_x_um, u_y_um, u_z_um: standard uncertainties from the covariance that volcomp identify wrote.

    \b
    Example:
      volcomp predict zha-gantry fitted/fitted.errors.csv --points p.points.csv --out predicted.csv
    """
    where = read_points(points)
    table = open_errors(errors)
    covariance = None if uncertainty is None else _covariance(errors, table, uncertainty)
    error_mm = predict(machine, table, where, exact=exact)
    if exact:
        error_mm = error_mm + _effects_mm(machine, where)
    columns = {f"e{axis}_um": error_mm[:, k] * 1e3 for k, axis in enumerate("xyz")}
    extra: dict[str, float] = {}
    if covariance is not None:
        u_um = predict_uncertainty(machine, covariance, where) * 1e3
        columns |= {f"u_{axis}_um": u_um[:, k] for k, axis in enumerate("xyz")}
        extra = {f"u_{axis}_max_um": float(u_um[:, k].max()) for k, axis in enumerate("xyz")}
    model = "exact" if exact else "E = C P"
    write_file(out, format_points(where, columns, {"machine": machine.name, "model": model}))
    figures = residuals(error_mm)
    if as_json:
        print_json({"points": len(where), "model": model, **figures.as_dict(), **extra, "file": str(out)})
    else:
        text = f"{len(where)} points, {model}: max {figures.max_um:.2f} um, rms {figures.rms_um:.2f} um -> {out}"
        stdout.print(text, markup=False, soft_wrap=True)
        if extra:
            stdout.print(f"largest standard uncertainty: x, y, z {', '.join(f'{u:.3f}' for u in extra.values())} um")
    return 0


def _effects_mm(machine: Machine, points: Points) -> FloatArray:
    """How the effects of the machine file move the tip at the points, (n, 3), mm; warns of columns that are missing."""
    moved_mm, missing = displacement_of(active_effects(machine), readings_of_points(machine, points))
    if missing:
        message = f"the points lack the columns of {', '.join(missing)}: left out (volcomp effects NAME lists them)"
        warnings.warn(message, CompgenWarning, stacklevel=2)
    return moved_mm


def _covariance(errors: Path, table: ErrorTable, file: str) -> Covariance:
    """Return the covariance of an errors file: the one given, else the one that the errors file names."""
    if file:
        return read_covariance(file, errors)
    name = table.metadata.get("covariance")
    if name is None:
        raise InputError(
            "names no covariance file (# covariance = ...), so --uncertainty knows none; only the files of compgen "
            "identify and run have one: give it by --uncertainty FILE",
            file=errors,
        )
    return read_covariance(errors.parent / name, errors)


COMMANDS = (simulate_command, predict_command)
