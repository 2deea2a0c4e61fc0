"""``volcomp recal history MACHINE --drift``, ``volcomp recal recheck`` and ``volcomp recal exclude``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from compgen.cli.common import NUMBER, json_option, print_json, stdout
from compgen.cli.recal_commands import job_option, opened, recal
from compgen.cli.recal_decision_commands import actor_of, who_option
from compgen.errors import InputError

if TYPE_CHECKING:
    from compgen.recal.drift import Drift
    from compgen.recal.job import Job
    from compgen.recal.store import Store


def show_drift(store: Store, job: Job, machine: str | None, report: Path | None, *, as_json: bool) -> int:
    """Print the drift of one machine and write its page; the exit code is 0."""
    from compgen.recal.drift import DriftSettings, drift_of_store
    from compgen.recal.drift_words import moment_of

    if machine is None:
        raise InputError("--drift and --report are for one machine; name it")
    found = drift_of_store(store, store.machine(machine), DriftSettings(job.machine(machine).tolerances))
    paths = [] if report is None else [str(_write(report, found))]
    if as_json:
        print_json({"accepted": True, "paths": paths, "drift": found.summary()})
        return 0
    stdout.print(
        f"{machine}: {len(found.times)} calibrations, {moment_of(found.times[0])} to {moment_of(found.times[-1])}",
        soft_wrap=True,
    )
    for title, change, errors in (
        ("last", found.volume_since_last, found.since_last),
        ("first", found.volume_since_first, found.since_first),
    ):
        if change is not None:
            level = 1.0 - found.settings.confidence
            named = ", ".join(item.error for item in errors if item.adjusted < level) or "no single error"
            stdout.print(
                f"since the {title}: {change.rms_um:.2f} um rms over the volume ({change.expected_rms_um:.2f} um by "
                f"uncertainty alone), p = {change.p_value:.2g}; changed: {named}",
                soft_wrap=True,
            )
    for text in found.sentences():
        stdout.print(f"  {text}", soft_wrap=True, markup=False)
    for path in paths:
        stdout.print(path, soft_wrap=True, markup=False)
    return 0


def _write(path: Path, drift: Drift) -> Path:
    from compgen.recal.history_report import write_history_report

    return write_history_report(path, drift)


@recal.command("recheck")
@click.argument("machine")
@click.option("--stations", required=True, metavar="FILE", help="Stations file of volcomp plan or identify.")
@click.option("--error", required=True, metavar="NAME", help="Error whose change is to be seen, e.g. EC0Y.")
@click.option("--change", required=True, type=NUMBER, metavar="SIZE", help="Its size, um or urad.")
@click.option("--power", default=0.9, show_default=True, type=NUMBER, help="Probability of seeing it.")
@click.option("--confidence", default=0.95, show_default=True, type=NUMBER, help="1 - probability of a false alarm.")
@click.option("--points", default=None, metavar="FILE", type=click.Path(path_type=Path), help="Write a points file.")
@job_option
@json_option
def recheck_command(
    machine: str,
    stations: str,
    error: str,
    change: float,
    power: float,
    confidence: float,
    points: Path | None,
    job: Job,
    as_json: bool,
) -> int:
    """Find the fewest points at which tracers would see a change of one error of MACHINE since its last calibration.

    \b
    Example:
      volcomp recal recheck mill-1 --stations stations.csv --error EC0Y --change 10 --points recheck.points.csv
    """
    from compgen.core.names import ERROR_NAMES, error_named
    from compgen.core.text import nearest
    from compgen.plan import read_stations
    from compgen.recal.drift_data import calibrations_of
    from compgen.recal.recheck import Wanted, shortest_recheck, write_recheck_points

    if error not in ERROR_NAMES:
        raise InputError(f"{error!r} is not an error; {nearest(error, ERROR_NAMES)}", field="--error")
    name = error_named(error)
    wanted = Wanted(error, change * name.si_per_unit, power, confidence)
    job.machine(machine)
    history, _, model = opened(job, lambda store: calibrations_of(store, store.machine(machine)))
    found = shortest_recheck(model, read_stations(stations), wanted, history[-1].covariance)
    paths = [] if points is None else [str(write_recheck_points(points, found))]
    if as_json:
        print_json({"accepted": True, "paths": paths, **found.summary()})
        return 0
    u, smallest = found.u / name.si_per_unit, found.smallest / name.si_per_unit
    stdout.print(
        f"{len(found.position_mm)} points, {found.readings} readings: {error} to {u:.2f} {name.unit} (standard "
        f"uncertainty); {change:g} {name.unit} is seen with power {found.power:.2f}, {smallest:.2f} {name.unit} with "
        f"{power:g}",
        soft_wrap=True,
    )
    for place in found.position_mm.tolist():
        stdout.print("  " + ", ".join(f"{letter} {value:g} mm" for letter, value in zip("XYZ", place, strict=True)))
    for path in paths:
        stdout.print(path, soft_wrap=True, markup=False)
    return 0


@recal.command("exclude")
@click.argument("machine")
@click.argument("version", type=click.IntRange(1))
@job_option
@click.option("--undo", is_flag=True, help="Take an exclusion back.")
@who_option(reason=True)
@json_option
def exclude_command(
    machine: str, version: int, job: Job, undo: bool, actor: str | None, reason: str, as_json: bool
) -> int:
    """Leave the measurement behind VERSION of MACHINE's tables, which was wrong, out of the drift.

    Nothing is deleted; who, when and why stand in the history. An active version has to be rolled back first.

    \b
    Example:
      volcomp recal exclude mill-1 5 --reason "the sign of the deviations was wrong"
    """
    from compgen.recal.exclude import exclude

    who = actor_of(actor)
    exclude(job, machine, version, who, reason, undo=undo)
    what = "counts again" if undo else "is left out of the drift"
    if as_json:
        print_json({"accepted": True, "machine": machine, "version": version, "excluded": not undo, "actor": who})
    else:
        stdout.print(f"{machine}: the measurement behind version {version} {what}", soft_wrap=True)
    return 0


#: Its commands belong to the group ``recal``.
COMMANDS: tuple[click.Command, ...] = ()
