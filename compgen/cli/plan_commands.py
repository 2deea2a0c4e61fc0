"""``volcomp plan``."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import click
import numpy as np

from compgen.cli.common import NUMBER, json_option, machine_argument, out_option, print_json, progress, stdout
from compgen.core.error_table import format_errors
from compgen.core.files import OutputFolder
from compgen.core.machine import Machine
from compgen.core.points import Points, format_points, read_points
from compgen.errors import InputError
from compgen.identify import IdentifyOptions
from compgen.identify.noise import ReadingNoise
from compgen.plan import (
    Box,
    Candidate,
    Plan,
    PlannedStations,
    PlanVisibility,
    Suggestion,
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
from compgen.plan.suggest import DEFAULT_EVALUATIONS, Criterion
from compgen.report.plan_text import plan_table, suggestion_table, trajectory_table, visibility_table

Progress = Callable[[str], None]


@click.command("plan")
@machine_argument
@click.option("--stations", required=True, type=click.Path(path_type=Path), help="CSV: station, x_mm, y_mm, z_mm.")
@click.option(
    "--points", type=click.Path(path_type=Path), help="*.points.csv (mm); a point that stands twice is read twice."
)
@click.option("--grid", is_flag=True, help="All nodes of the machine as points, in place of --points.")
@click.option("--u-length-um", type=NUMBER, help="Constant part of the standard uncertainty of a length, um.")
@click.option("--u-length-um-per-m", type=NUMBER, help="Part of it that grows with the length, um/m.")
@click.option("--suggest", "search", is_flag=True, help="Search better places for the stations.")
@click.option(
    "--box", multiple=True, metavar="LABEL:XMIN,XMAX,YMIN,YMAX,ZMIN,ZMAX", help="Where a station may stand, mm."
)
@click.option("--boxes", type=click.Path(path_type=Path), help="CSV: station, x_min_mm, x_max_mm, ... z_max_mm.")
@click.option(
    "--criterion",
    type=click.Choice(["worst", "rms"]),
    default="worst",
    help="What the search lowers: the worst or the rms standard uncertainty of E over the volume (default: worst).",
)
@click.option(
    "--evaluations",
    type=click.IntRange(min=2),
    default=DEFAULT_EVALUATIONS,
    help=f"Arrangements that the search looks at (default: {DEFAULT_EVALUATIONS}).",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, help="Seed of the search (default: 1).")
@click.option("--target-um", type=NUMBER, help="Propose the smallest trajectory whose worst u of E is below this, um.")
@out_option
@json_option
def plan_command(
    machine: Machine,
    stations: Path,
    points: Path | None,
    grid: bool,
    u_length_um: float | None,
    u_length_um_per_m: float | None,
    search: bool,
    box: tuple[str, ...],
    boxes: Path | None,
    criterion: str,
    evaluations: int,
    seed: int,
    target_um: float | None,
    out: Path,
    as_json: bool,
) -> int:
    """Plan a measurement: what it will determine, and how well, before anything is measured.

    Writes plan.json and plan.errors.csv (um, urad; values zero, u_value predicted) to DIR, with --suggest also
    suggested.stations.csv, with --target-um proposed.points.csv (mm). Says which effects beside the geometric errors the plan
    can never see (volcomp effects), and what to measure in addition. Without --u-length-um 0.1 um + 0.15 um/m is
    assumed. Exit code 1 if an unknown is not determined, or no trajectory reaches the target.

    \b
    Example:
      volcomp plan zha-gantry --stations identified/stations.csv --grid --out plan/
    """
    OutputFolder(out)
    noise = planned_noise(IdentifyOptions(u_length_um, u_length_um_per_m))
    given, where = read_stations(stations), _points(machine, points, grid=grid)
    allowed = _boxes(box, boxes, search=search)
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
        judged = None if target_um is None else _judged(machine, best, noise, target_um, show)
    summary = _write(out, result, visible, suggestion, judged, target_um)
    if as_json:
        print_json(summary)
    else:
        _show(result, suggestion, judged, target_um)
        stdout.print(visibility_table(visible))
    reached = judged is None or judged[1] is not None
    return 0 if result.determined and reached else 1


Judged = tuple[list[Candidate], Candidate | None]


def _judged(
    machine: Machine, stations: PlannedStations, noise: ReadingNoise, target_um: float, show: Progress
) -> Judged:
    return judge_trajectories(machine, stations, noise, target_um=target_um, progress=show)


def _points(machine: Machine, points: Path | None, *, grid: bool) -> Points:
    if (points is not None) == grid:
        raise InputError("give either --points FILE or --grid")
    if points is not None:
        return read_points(points)
    nodes = np.meshgrid(*[axis.nodes_mm for axis in machine.axes], indexing="ij")
    return Points(np.stack(nodes, axis=-1).reshape(-1, 3))


def _boxes(box: tuple[str, ...], boxes: Path | None, *, search: bool) -> dict[str, Box]:
    if (box or boxes) and not search:
        raise InputError("--box and --boxes say where --suggest may place a station; give --suggest as well")
    found = read_boxes(boxes) if boxes else {}
    for text in box:
        label, where = box_from_text(text)
        if label in found:
            raise InputError(f"the box of station {label!r} is given twice", field="--box")
        found[label] = where
    return found


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


def _show(result: Plan, suggestion: Suggestion | None, judged: Judged | None, target_um: float | None) -> None:
    stdout.print(plan_table(result))
    if suggestion is not None:
        stdout.print(suggestion_table(suggestion))
    if judged is not None and target_um is not None:
        stdout.print(trajectory_table(*judged, target_um))


COMMANDS = (plan_command,)
