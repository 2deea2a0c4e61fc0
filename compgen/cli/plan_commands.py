"""``volcomp plan``, ``simulate`` and ``predict``: before anything is measured."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import click

from compgen.cli.common import (
    NUMBER,
    PATH,
    for_readers,
    json_option,
    language_option,
    options_of,
    out_option,
)
from compgen.cli.output import print_json
from compgen.cli.shared_options import covariance_of, machine_argument, prior_option
from compgen.cli.terminal import answer, progress, say, say_paths, stdout
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, format_errors
from compgen.data.files import OutputFolder, write_file
from compgen.data.lengths import Points, format_points, read_points
from compgen.data.machine import Machine
from compgen.effects import active_effects, displacement_of, readings_of_points
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import open_errors
from compgen.identification import IdentifyOptions, predict_uncertainty, read_covariance
from compgen.identification.covariance import covariance_or_independent, posterior_with
from compgen.identification.posterior import assumed_text
from compgen.kinematics import predict
from compgen.kinematics.many_points import full_grid
from compgen.planning import (
    Plan,
    PlanVisibility,
    Suggestion,
    TrajectoryCandidate,
    box_from_text,
    format_stations,
    judge_trajectories,
    plan_of,
    plan_visibility,
    planned,
    planned_noise,
    read_boxes,
    read_stations,
    regions_of,
    suggest,
)
from compgen.planning.gauges import plan_gauges, plan_page
from compgen.planning.suggestions import DEFAULT_EVALUATIONS, Criterion
from compgen.report.terminal import (
    gauge_plan_table,
    next_table,
    plan_table,
    suggestion_table,
    trajectory_table,
    visibility_table,
)
from compgen.simulation import (
    LaserTracer,
    MovingSimulation,
    SimulatedReadings,
    SimulatedSixDof,
    Simulation,
    TouchProbe,
    read_scenario,
    simulate,
    simulate_axis_runs,
    simulate_moving,
    simulate_sixdof,
    write_simulation,
)
from compgen.simulation.gauges import circle_from_text, pose_from_text, read_gauge
from compgen.simulation.run import OwnPath
from compgen.tables import residuals
from compgen.tables.probe_program import PROGRAM_NAME, probe_program, read_probing

# ``volcomp plan``.


Progress = Callable[[str], None]


@click.command("plan")
@machine_argument
@prior_option
@click.option("--stations", type=PATH, help="Laser tracer: CSV with station, x_mm, y_mm, z_mm.")
@click.option("--points", type=PATH, help="*.points.csv (mm); a point listed twice is measured twice.")
@click.option("--grid", is_flag=True, help="Use all nodes of the machine as points, instead of --points.")
@click.option(
    "--artefact",
    multiple=True,
    type=PATH,
    help="Plate or other artefact under the machine's probe: TOML; docs/files.md.",
)
@click.option(
    "--pose",
    "--poses",
    multiple=True,
    metavar="X,Y,Z[,ANGLE]",
    help="Set-up of the artefact: its middle in machine coordinates, mm, and degrees about Z; several with ; between them.",
)
@click.option(
    "--circle",
    multiple=True,
    metavar="PLANE:RADIUS[:X,Y,Z]",
    help="Circular test: plane, radius and centre in mm (XY:150; the middle of the travel), or a TOML file.",
)
@click.option("--program", metavar="CONTROLLER", help="Write the program that probes artefact or spheres.")
@click.option(
    "--sphere",
    multiple=True,
    metavar="X,Y,Z",
    help="Rotary axes: a sphere on the table, workpiece frame with all axes at zero, mm (may be given several times).",
)
@click.option(
    "--probe-length",
    "probe_lengths",
    multiple=True,
    type=NUMBER,
    help="Length of the probe for --sphere along -Z, mm (may be given several times; default: 100).",
)
@click.option("--count", type=click.IntRange(min=4, max=1000), help="Number of poses for --sphere (default: 40).")
@click.option(
    "--u-sphere-um", type=NUMBER, help="Standard uncertainty of a coordinate of a sphere's centre, um (default: 2)."
)
@click.option(
    "--probing", type=PATH, help="TOML with the section [probing] of spheres, for --sphere; docs/five-axis.md."
)
@click.option(
    "--errors",
    type=PATH,
    help="Known errors (um, urad). With --artefact or --circle plan.html shows their effect; alone: what to measure next.",
)
@options_of(IdentifyOptions, "readings", only=("u_length_um", "u_length_um_per_m"))
@click.option("--suggest", "search", is_flag=True, help="Search for better station positions.")
@click.option(
    "--box", multiple=True, metavar="LABEL:XMIN,XMAX,YMIN,YMAX,ZMIN,ZMAX", help="Where a station may be placed, mm."
)
@click.option("--boxes", type=PATH, help="CSV: station, x_min_mm, x_max_mm, ... z_max_mm.")
@click.option(
    "--criterion",
    type=click.Choice(["worst", "rms"]),
    default="worst",
    help="What the search minimises: the worst or the rms standard uncertainty of E over the volume (default: worst).",
)
@click.option(
    "--evaluations",
    type=click.IntRange(min=2),
    default=DEFAULT_EVALUATIONS,
    help=f"Arrangements that the search evaluates (default: {DEFAULT_EVALUATIONS}).",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, help="Seed of the search (default: 1).")
@click.option("--target-um", type=NUMBER, help="Propose the smallest trajectory whose worst u of E is below this, um.")
@out_option
@language_option
@json_option
def plan_command(
    machine: Machine,
    stations: Path | None,
    points: Path | None,
    grid: bool,
    artefact: tuple[Path, ...],
    pose: tuple[str, ...],
    circle: tuple[str, ...],
    program: str | None,
    sphere: tuple[str, ...],
    probe_lengths: tuple[float, ...],
    count: int | None,
    u_sphere_um: float | None,
    probing: Path | None,
    errors: Path | None,
    readings: IdentifyOptions,
    search: bool,
    box: tuple[str, ...],
    boxes: Path | None,
    criterion: str,
    evaluations: int,
    seed: int,
    target_um: float | None,
    out: Path,
    language: str,
    as_json: bool,
) -> int:
    """Plan a measurement: what it will determine, and how well, before anything is measured.

    With --stations: a laser tracer. With --artefact, --circle or both: gauges of the workshop, alone or with a tracer in
    one adjustment; plan.html then shows deviation arrows and the polar diagram for --errors, with a slider for each error.
    With --program also the NC program that probes the artefact (mm); volcomp import reads its log. With none of these: what to
    measure next, of what a workshop has, where --errors are known (*.errors.csv of volcomp identify or run), or nothing is.
    With --sphere: the poses of a machine with rotary axes at which its probe finds the sphere, chosen for what they say of the
    rotary axes; --program writes sphere-program.nc (mm, degrees), whose log volcomp import reads.

    Writes plan.json and plan.errors.csv (um, urad; values zero, u_value predicted) to DIR, with --suggest also
    suggested.stations.csv, with --target-um proposed.points.csv (mm); what to measure next with order.html, a sheet to print
    and fill in for each measurement. Lists the effects other than the geometric errors
    that the plan cannot show (volcomp effects), and what to measure in addition. Without --u-length-um 0.1 um + 0.15
    um/m is assumed. Exit code 1 if an unknown is undetermined, or no trajectory reaches the target; with gauges only if no
    error at all is determined.

    For gauges: volcomp plan zha-gantry --artefact plate.toml --pose -400,-500,-200 --circle XY:150 --out plan/
    What to measure next: volcomp plan zha-gantry --errors identified/identified.errors.csv --out plan/

    \b
    Example:
      volcomp plan zha-gantry --stations identified/stations.csv --grid --out plan/
    """
    OutputFolder(out)
    if sphere:
        if artefact or circle or pose or stations or points or grid or search or errors or target_um is not None:
            raise InputError("--sphere plans poses of rotary axes alone; leave out what belongs to other measurements")
        return _plan_spheres(
            machine, sphere, probe_lengths or (100.0,), count, u_sphere_um, probing, program, out, as_json
        )
    if probe_lengths or count is not None or u_sphere_um is not None or probing:
        raise InputError("--probe-length, --count, --u-sphere-um and --probing belong to --sphere, which is not given")
    if artefact or circle:
        if search or target_um is not None:
            raise InputError(
                "--suggest and --target-um are for a laser tracer alone; leave out --artefact and --circle"
            )
        return _plan_gauges(
            machine,
            artefact,
            pose,
            circle,
            program,
            errors,
            stations,
            points,
            readings,
            out,
            language,
            grid=grid,
            as_json=as_json,
        )
    if pose or program or (errors and stations):
        option = "--pose" if pose else "--program" if program else "--errors"
        raise InputError(f"{option} belongs to --artefact or --circle, and neither is given")
    if stations is None:
        if points or grid or search or box or boxes or target_um is not None:
            raise InputError("give --stations FILE (laser tracer), --artefact FILE or --circle PLANE:RADIUS")
        return _plan_next(machine, errors, out, language, as_json=as_json)
    noise = planned_noise(readings)
    given, where = read_stations(stations), _points(machine, points, grid=grid)
    if (box or boxes) and not search:
        raise InputError("--box and --boxes need --suggest: they limit where it places a station")
    allowed = read_boxes(boxes) if boxes else {}
    for text in box:
        label, place = box_from_text(text)
        if label in allowed:
            raise InputError(f"the box of station {label!r} is given twice", field="--box")
        allowed[label] = place
    regions = regions_of(machine, given, allowed)
    with progress(quiet=as_json) as show:
        show("predicting")
        setup = planned(machine, given, where, noise)
        result = plan_of(setup)
        visible = plan_visibility(setup, where)
        suggestion = None
        if search:
            kind = cast(Criterion, criterion)
            suggestion = suggest(setup, regions, criterion=kind, evaluations=evaluations, seed=seed, progress=show)
        best = suggestion.plan.planned.stations if suggestion else given
        judged = (
            None if target_um is None else judge_trajectories(machine, best, noise, target_um=target_um, progress=show)
        )
    summary = _write(out, result, visible, suggestion, judged, target_um)
    shown = [plan_table(result), *([suggestion_table(suggestion)] if suggestion else [])]
    if judged is not None and target_um is not None:
        shown.append(trajectory_table(*judged, target_um))
    answer(as_json, summary, *shown, visibility_table(visible))
    reached = judged is None or judged[1] is not None
    return 0 if result.determined and reached else 1


def _plan_spheres(
    machine: Machine,
    sphere: tuple[str, ...],
    lengths_mm: tuple[float, ...],
    count: int | None,
    u_um: float | None,
    probing: Path | None,
    program: str | None,
    out: Path,
    as_json: bool,
) -> int:
    """Choose the poses at which spheres are probed, and write the program that probes them."""
    from compgen.planning.sphere_poses import plan_spheres
    from compgen.report.terminal import sphere_plan_table
    from compgen.tables.sphere_program import PROGRAM_NAME as SPHERE_PROGRAM
    from compgen.tables.sphere_program import height_of, reach_of, sphere_program

    if program and probing is None:
        raise InputError("--program needs the section [probing] of a file: give --probing FILE", field="--program")
    for value, name in ((u_um, "--u-sphere-um"), *((length, "--probe-length") for length in lengths_mm)):
        if value is not None and not 0.0 < value < 2000.0:
            raise InputError(f"{value:g} is not possible; expected more than 0, less than 2000", field=name)
    touched = None if probing is None else read_probing(probing)
    with progress(quiet=as_json) as show:
        show("choosing poses")
        found = plan_spheres(
            machine,
            [_place(text) for text in sphere],
            sorted(set(lengths_mm)),
            count=40 if count is None else count,
            u_um=2.0 if u_um is None else u_um,
            reach=None if touched is None else reach_of(touched),
            height_mm=None if touched is None else height_of(machine, touched),
        )
    folder = OutputFolder(out)
    for name, text in found.files().items():
        folder.add(name, text)
    if program and touched is not None:
        folder.add(SPHERE_PROGRAM, sphere_program(found, touched, program))
    folder.add("plan.json", json.dumps(found.summary(), indent=2) + "\n")
    folder.commit()
    answer(as_json, found.summary(), sphere_plan_table(found))
    return 0


def _place(text: str) -> tuple[float, float, float]:
    """The place of a sphere, ``X,Y,Z`` in mm."""
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not max(abs(x), abs(y), abs(z)) < 1e5:
        raise InputError(f"{text!r} is not a place; expected X,Y,Z in mm, for example 60,30,40", field="--sphere")
    return x, y, z


def _plan_gauges(
    machine: Machine,
    artefact: tuple[Path, ...],
    pose: tuple[str, ...],
    circle: tuple[str, ...],
    program: str | None,
    errors: Path | None,
    stations: Path | None,
    points: Path | None,
    readings: IdentifyOptions,
    out: Path,
    language: str,
    *,
    grid: bool,
    as_json: bool,
) -> int:
    """Plan artefacts and circles, with planned tracer lengths if there are stations."""
    if pose and not artefact:
        raise InputError("--pose is the set-up of an artefact; give --artefact FILE as well")
    if stations is None and (points or grid):
        raise InputError("--points and --grid are where a laser tracer reads; give --stations FILE as well")
    if program and len(artefact) != 1:
        raise InputError("--program probes one artefact; give one --artefact FILE")
    poses = tuple(pose_from_text(text) for item in pose for text in item.split(";"))
    gauges = [read_gauge(path, "touch-probe", poses) for path in artefact]
    gauges += [read_gauge(item, "ballbar") if item.endswith(".toml") else circle_from_text(item) for item in circle]
    known = None if errors is None else open_errors(errors)
    lengths = None
    if stations is not None:
        tracer = read_stations(stations)
        lengths = planned(machine, tracer, _points(machine, points, grid=grid), planned_noise(readings)).lengths
    with progress(quiet=as_json) as show:
        show("predicting")
        found = plan_gauges(machine, gauges, lengths, readings)
        page = plan_page(found, known)
    folder = OutputFolder(out)
    if program and isinstance(gauges[0], TouchProbe):
        folder.add(PROGRAM_NAME, probe_program(machine, gauges[0], read_probing(artefact[0]), program))
    folder.add("plan.errors.csv", format_errors(found.errors))
    folder.add("plan.html", for_readers({"plan.html": page}, language)["plan.html"])
    folder.add("plan.json", json.dumps(found.summary(), indent=2) + "\n")
    folder.commit()
    answer(as_json, found.summary(), gauge_plan_table(found))
    return 0 if found.errors.names else 1


def _plan_next(machine: Machine, errors: Path | None, out: Path, language: str, *, as_json: bool) -> int:
    """Say what to measure next, from the errors that are known, or from nothing but the prior."""
    from compgen.identification.posterior import not_measured
    from compgen.planning.next_measurement import next_best, next_page, unmeasured
    from compgen.report.measurement_order import ORDER_NAME, order_page

    if machine.prior.is_none:
        raise InputError(
            "what to measure next follows from how large errors are assumed that were not measured, and class 'none' assumes "
            "nothing; give another class",
            field="--prior",
        )
    table = ErrorTable({}, {}) if errors is None else open_errors(errors)
    known = None if errors is None else covariance_of(errors, table, None, independent=False)
    posterior = posterior_with(machine, table, known) if table.names else unmeasured(machine)
    if posterior is None:
        raise InputError("states no uncertainty (u_value) for some values, so what is known is unknown", file=errors)
    found = next_best(posterior)
    summary = {
        "machine": machine.name,
        "prior": posterior.prior.as_dict(),
        "assumed": assumed_text(posterior),
        "determined": [name for name in posterior.determined if name in table.names],
        "not_measured": not_measured(posterior, table.names),
        "u_rms_um": found.u_um,
        **found.summary(),
    }
    folder = OutputFolder(out)
    pages = {"plan.html": next_page(found, str(summary["assumed"]))}
    if found.measurements:
        pages[ORDER_NAME] = order_page(found, language)
    for name, text in for_readers(pages, language).items():
        folder.add(name, text)
    folder.add("plan.json", json.dumps(summary, indent=2) + "\n")
    folder.commit()
    answer(as_json, summary, next_table(found, str(summary["assumed"])))
    return 0


Judged = tuple[list[TrajectoryCandidate], TrajectoryCandidate | None]


def _points(machine: Machine, points: Path | None, *, grid: bool) -> Points:
    if (points is not None) == grid:
        raise InputError("give either --points FILE or --grid")
    if points is not None:
        return read_points(points)
    return Points(full_grid([axis.nodes_mm for axis in machine.axes]).reshape(-1, 3))


def _write(
    out: Path,
    result: Plan,
    visible: PlanVisibility,
    suggestion: Suggestion | None,
    judged: Judged | None,
    target_um: float | None,
) -> dict[str, Any]:
    """Write the files together and return the contents of plan.json."""
    folder = OutputFolder(out)
    machine = result.planned.machine
    summary = {**result.summary(), "visibility": visible.summary()}
    if suggestion is not None:
        summary["suggestion"] = suggestion.summary()
        folder.add("suggested.stations.csv", format_stations(suggestion.plan.planned.stations, machine))
    if judged is not None:
        candidates, chosen = judged
        summary["target_um"] = target_um
        summary["trajectories"] = [item.summary() for item in candidates]
        summary["proposed"] = chosen.name if chosen else None
        if chosen is not None:
            text = format_points(Points(chosen.position_mm), {}, {"machine": machine.name, "trajectory": chosen.name})
            folder.add("proposed.points.csv", text)
    folder.add("plan.errors.csv", format_errors(result.errors))
    folder.add("plan.json", json.dumps(summary, indent=2) + "\n")
    folder.commit()
    return summary


# ``volcomp simulate`` and ``volcomp predict``.


@click.command("simulate")
@machine_argument
@click.option("--scenario", required=True, type=PATH, help="Scenario TOML; see docs/files.md.")
@out_option
@click.option("--seed", type=click.IntRange(min=0), help="Seed; default: the seed in the scenario.")
@json_option
def simulate_command(machine: Machine, scenario: Path, out: Path, seed: int | None, as_json: bool) -> int:
    """Simulate a machine and its measurement: writes *.lengths.csv (mm) and truth.errors.csv (um, urad) to DIR.

    A scenario whose instrument has type = "sixdof" writes *.sixdof.csv instead of lengths, one with "axis-laser"
    *.axis.csv, with "diagonal-laser" *.diagonals.csv, with "ballbar" *.circle.csv (um), with "touch-probe"
    *.artefact.csv (mm). A laser-tracer with rate_hz reads while the machine moves and writes *.lengths.npz, the binary
    form of lengths.

    \b
    Example:
      volcomp simulate zha-gantry --scenario examples/zha-gantry.scenario.toml --out simulated/
    """
    with progress(quiet=as_json) as show:
        show("simulating")
        planned = read_scenario(scenario)
        simulation: Simulation | SimulatedReadings | MovingSimulation
        if isinstance(planned.instrument, LaserTracer) and planned.instrument.rate_hz is not None:
            simulation = simulate_moving(machine, planned, seed)
        elif isinstance(planned.instrument, OwnPath):
            simulation = simulate_axis_runs(machine, planned, seed)
        elif isinstance(planned.instrument, SimulatedSixDof):
            simulation = simulate_sixdof(machine, planned, seed)
        else:
            simulation = simulate(machine, planned, seed)
        paths = write_simulation(simulation, out)
    if as_json:
        if isinstance(simulation, SimulatedReadings):
            summary = {"readings": len(simulation.readings), "stations": []}
        elif isinstance(simulation, MovingSimulation):
            summary = {"readings": simulation.readings, "stations": [item.name for item in simulation.stations]}
        else:
            summary = {"readings": len(simulation.lengths), "stations": list(simulation.lengths.stations)}
        print_json({**summary, "files": {name: str(path) for name, path in paths.items()}})
    else:
        say_paths(paths.values())
    return 0


@click.command("predict")
@machine_argument
@prior_option
@click.argument("errors", type=PATH)
@click.option("--points", required=True, type=PATH, help="*.points.csv (mm).")
@click.option("--out", required=True, metavar="FILE", type=PATH, help="CSV file for the result.")
@click.option("--exact", is_flag=True, help="Use finite rotations along the chain instead of E = C P.")
@click.option(
    "--uncertainty",
    is_flag=False,
    flag_value="",
    metavar="[FILE]",
    help="Add standard uncertainties, with what is assumed of errors that were not measured; FILE is the covariance "
    "(default: the file that ERRORS names, or else u_value of ERRORS).",
)
@json_option
def predict_command(
    machine: Machine, errors: Path, points: Path, out: Path, exact: bool, uncertainty: str | None, as_json: bool
) -> int:
    """Predict the error of the tool tip at given points: E = C P, or the exact model.

    ERRORS is an *.errors.csv file (um, urad). With --exact the effects of the machine file that move the tip are added
    if the points have their columns (approach_x ..., temp_..., time_s, feed_mm_min, load_kg). FILE gets the points plus
    ex_um, ey_um, ez_um, and with --uncertainty u_x_um, u_y_um, u_z_um: standard uncertainties from the covariance that
    volcomp identify wrote, or from u_value of ERRORS, and from the prior of the machine.

    Of a machine with rotary axes the points may have a_deg, b_deg, c_deg, and FILE also gets ea_urad, eb_urad, ec_urad:
    position of the tip and orientation of the tool in the workpiece frame, which turns with the table; always exact.

    \b
    Example:
      volcomp predict zha-gantry fitted/fitted.errors.csv --points p.points.csv --out predicted.csv
    """
    if machine.rotary:
        return _predict_poses(machine, errors, points, out, uncertainty is not None, as_json)
    where = read_points(points)
    table = open_errors(errors)
    covariance, assumed = None, ""
    if uncertainty is not None:  # empty: the file that the errors file names
        name = table.metadata.get("covariance")
        if uncertainty or name is not None:
            covariance = read_covariance(uncertainty or errors.parent / str(name), errors)
        covariance = covariance_or_independent(table, covariance, machine.name)
        if covariance is None:
            raise InputError(
                "refers to no covariance file (# covariance = ...), and not every value has a u_value: --uncertainty needs one "
                "of both; give the covariance with --uncertainty FILE",
                file=errors,
            )
        known = posterior_with(machine, table, covariance)
        covariance = replace(covariance, posterior=None if known is None else known.stored())
        assumed = "" if known is None else assumed_text(known)
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
        print_json(
            {"points": len(where), "model": model, **figures.as_dict(), **extra, "prior": assumed, "file": str(out)}
        )
    else:
        text = f"{len(where)} points, {model}: max {figures.max_um:.2f} um, rms {figures.rms_um:.2f} um -> {out}"
        say(text)
        if extra:
            stdout.print(f"largest standard uncertainty: x, y, z {', '.join(f'{u:.3f}' for u in extra.values())} um")
            stdout.print(assumed or "no prior: what was not measured is not in this uncertainty")
    return 0


def _predict_poses(machine: Machine, errors: Path, points: Path, out: Path, with_u: bool, as_json: bool) -> int:
    """Predict position and orientation at poses of a machine with rotary axes."""
    import numpy as np

    from compgen.data.rotary import format_poses, read_machine_errors, read_poses
    from compgen.identification.rotary_covariance import joint_beside, known_covariance, pose_uncertainty
    from compgen.kinematics.rotary_chain import pose_error

    poses = read_poses(machine, points)
    table, rotary = read_machine_errors(errors)
    error_mm, error_rad = pose_error(machine, table, rotary, poses.position_mm, poses.angle_deg, poses.tool_mm)
    columns = {f"e{axis}_um": error_mm[:, k] * 1e3 for k, axis in enumerate("xyz")}
    columns |= {f"e{axis}_urad": error_rad[:, k] * 1e6 for k, axis in enumerate("abc")}
    extra: dict[str, float] = {}
    joint = None
    if with_u:
        joint = joint_beside(errors, table, rotary)
        known = known_covariance(errors, rotary) if joint is None else joint
        u_mm, u_rad = pose_uncertainty(machine, table, rotary, poses, known)
        columns |= {f"u_{axis}_um": u_mm[:, k] * 1e3 for k, axis in enumerate("xyz")}
        columns |= {f"u_{axis}_urad": u_rad[:, k] * 1e6 for k, axis in enumerate("abc")}
        extra = {"u_max_um": float(u_mm.max() * 1e3), "u_max_urad": float(u_rad.max() * 1e6)}
    write_file(out, format_poses(poses, columns, {"machine": machine.name, "model": "exact"}))
    figures, turned = residuals(error_mm), float(np.linalg.norm(error_rad, axis=1).max() * 1e6)
    if as_json:
        angular = {"max_urad": turned, **extra}
        print_json({"points": len(error_mm), "model": "exact", **figures.as_dict(), **angular, "file": str(out)})
    else:
        say(
            f"{len(error_mm)} points, exact: max {figures.max_um:.2f} um, rms {figures.rms_um:.2f} um, orientation max "
            f"{turned:.1f} urad -> {out}"
        )
        if extra:
            largest = f"{extra['u_max_um']:.2f} um", f"{extra['u_max_urad']:.1f} urad"
            if joint is None:
                say(
                    f"largest standard uncertainty of a coordinate {largest[0]}, of an angle {largest[1]}; errors of linear axes "
                    "that ERRORS does not list are not in it"
                )
            else:
                say(
                    f"largest standard uncertainty of a coordinate {largest[0]}, of an angle {largest[1]}; what was not measured "
                    "of the linear axes is in it with the sizes of the prior"
                )
    return 0


def _effects_mm(machine: Machine, points: Points) -> FloatArray:
    """Return how the effects of the machine file move the tip at the points, (n, 3), mm; warn of missing columns."""
    moved_mm, missing = displacement_of(active_effects(machine), readings_of_points(machine, points))
    if missing:
        message = f"the points lack the columns of {', '.join(missing)}: not included (volcomp effects NAME lists the columns)"
        warnings.warn(message, CompgenWarning, stacklevel=2)
    return moved_mm
