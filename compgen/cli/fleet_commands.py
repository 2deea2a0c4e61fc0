"""``volcomp recal`` and ``serve``; each command imports what it needs when it runs."""

from __future__ import annotations

import contextlib
import functools
import getpass
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich import box
from rich.table import Table

from compgen.cli.common import (
    PATH,
    STOPPED,
    Command,
    fleet_options,
    json_option,
    options_of,
    stopped_by_signals,
)
from compgen.cli.output import print_json
from compgen.cli.terminal import answer, complain, say, stdout
from compgen.errors import InputError
from compgen.fleet.dashboard.settings import DashboardSettings, default_users, read_token
from compgen.fleet.job import WATCH_POLL_S, Job, MachineJob, add_machine, command_words, read_job, units
from compgen.fleet.records import ReprocessRequest, RequestedChange

if TYPE_CHECKING:
    from compgen.fleet.dashboard.users import Users
    from compgen.fleet.drift import Drift
    from compgen.fleet.store import Store


# ``volcomp recal``: run, watch, status and history.


JOB = "recal.toml"
#: Modules that only this command group needs, by the name of their distribution.
NEEDED = {"sqlalchemy": "SQLAlchemy", "alembic": "alembic", "apscheduler": "APScheduler", "structlog": "structlog"}


@click.group("recal")
def recal_command() -> None:
    """Scheduled recalibration: new measurements become proposed tables, a person approves them, and each step can be undone.

    The job file (--job, default recal.toml) lists the machines, their inboxes, schedules and rules. Limits are in um,
    temperatures in degC, ages in days. Exit codes: 0 no problem (tables may wait for approval), 1 something is held
    back or failed, 2 wrong usage, job file or store, 3 internal error.

    \b
    Example:
      volcomp recal add mill-1 --machine mill-1.toml --inbox inbox/mill-1 --controller siemens-cec \\
                    --out tables/mill-1 --measured-with active
      volcomp recal run
      volcomp recal approve mill-1 1
    """


def needed() -> None:
    """Raise InputError that lists the distributions that are not installed, if any."""
    import importlib.util

    missing = [name for module, name in NEEDED.items() if importlib.util.find_spec(module) is None]
    if missing:
        raise InputError(f"volcomp recal needs {', '.join(missing)}; install compgen[recal]")


job_file_option = click.option(
    "--job", "job_file", default=JOB, show_default=True, type=PATH, metavar="FILE", help="Job file."
)
log_option = click.option(
    "--log",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "json", "text"]),
    help="Format of the logs on stderr; auto: text on a terminal, otherwise one JSON object per line.",
)


def job_option(command: Command) -> Command:
    """Add --job and --log; the command receives ``job``, read."""

    @functools.wraps(command)
    def wrapper(*args: Any, job_file: Path, log: str, **options: Any) -> Any:
        needed()
        from compgen.fleet import logs

        logs.configure(log)  # type: ignore[arg-type]
        job = read_job(job_file)
        warn_of_password(job.store, job_file)
        return command(*args, job=job, **options)

    return job_file_option(log_option(wrapper))  # type: ignore[return-value]


def warn_of_password(url: str, file: Path | None) -> None:
    """Log that other users of this computer can read the password of a store, from its job file or the command line."""
    from compgen.fleet import logs

    if re.match(r"[\w+]+://[^/@:]*:[^/@]+@", url) is None:
        return
    if file is None:
        advice = "write the URL into a job file that only you can read, or the password into ~/.pgpass"
        logs.warning("a password on the command line, which every user can read", advice=advice)
    elif os.name == "posix" and file.stat().st_mode & 0o077:
        logs.warning("a job file with a password that other users can read", file=str(file), advice=f"chmod 600 {file}")


notify_option = click.option(
    "--notify",
    "command",
    default=None,
    metavar="COMMAND",
    help="Command that receives one JSON object on stdin for every decision and failure; default: that of the job file.",
)


backup_option = click.option(
    "--backup",
    multiple=True,
    type=PATH,
    metavar="FILE",
    help="Backup of the control that was made with the measurement, which shows which tables were on: a file (may be several) "
    "or a folder. In the inbox: NAME.backup.EXT beside the measurement.",
)


def opened(job: Job, use: Callable[[Store], Any]) -> Any:
    """Do something with the store of a job and close it."""
    from compgen.fleet.store import open_store

    store = open_store(job.store)
    try:
        return use(store)
    finally:
        store.close()


@recal_command.command("run")
@click.argument("machines", nargs=-1)
@job_option
@backup_option
@fleet_options
@notify_option
@json_option
def run_command(
    machines: tuple[str, ...],
    job: Job,
    backup: tuple[Path, ...],
    workers: int,
    cluster: str | None,
    command: str | None,
    as_json: bool,
) -> int:
    """Read the inboxes of MACHINES (default: all) once, process new measurements, publish the tables.

    The same inbox gives the same state, however often it is run. If one machine fails, the others continue. On SIGTERM
    or Ctrl-C the measurements in progress are finished; exit code 130.

    \b
    Example:
      volcomp recal run --job /etc/compgen/recal.toml --json
      volcomp recal run mill-1 --backup NC_CEC.INI
      volcomp recal run --workers 8
    """
    from compgen.fleet.runner import run_fleet

    if backup:
        from compgen.fleet.actions import attach_backup

        if len(machines) != 1:
            raise InputError(
                "a backup is that of one machine; name it: volcomp recal run MACHINE --backup FILE", field="--backup"
            )
        attach_backup(job, machines[0], backup)
    with stopped_by_signals() as stop:
        chosen = job.with_notify(_words(command))
        result = run_fleet(chosen, machines, workers=workers, cluster=cluster, stop=stop.is_set)
        code = STOPPED if stop.is_set() else result.exit_code
    if as_json:
        print_json(result.summary())
        return code
    for item in result.outcomes:
        if item.state == "stopped":
            say(f"{item.machine}: {'; '.join(item.messages)}")
            continue
        active = "no tables active" if item.active is None else f"version {item.active} active"
        done = f", processed {', '.join(item.processed)}" if item.processed else ""
        waiting = f", waiting: {', '.join(map(str, item.waiting))}" if item.waiting else ""
        say(f"{item.machine}: {item.state}, {active}{waiting}{done}")
        for message in item.messages:
            say(f"  {message}")
    return code


def _words(command: str | None) -> tuple[str, ...]:
    try:
        return () if command is None else command_words(command)
    except ValueError as error:
        raise InputError(str(error), field="--notify") from error


@recal_command.command("watch")
@job_option
@click.option(
    "--poll-s",
    default=WATCH_POLL_S,
    show_default=True,
    type=click.FloatRange(0.05, 3600),
    help="Interval between checks of the job file, s.",
)
@click.option(
    "--metrics-port", type=click.IntRange(0, 65535), help="Show Prometheus metrics on 127.0.0.1 at this port."
)
@fleet_options
@notify_option
def watch_command(
    job: Job, poll_s: float, metrics_port: int | None, workers: int, cluster: str | None, command: str | None
) -> int:
    """Keep running: every machine by its schedule (without one every 5 minutes), until SIGTERM or Ctrl-C.

    Changes of the job file take effect; a faulty job file is reported, and the previous one remains in use. On a signal
    the measurements in progress are finished.

    \b
    Example:
      volcomp recal watch --job /etc/compgen/recal.toml
    """
    from compgen.fleet.runner import open_fleet, work_of
    from compgen.fleet.watch import Watch

    with contextlib.ExitStack() as left:
        fleet = open_fleet(job.store, workers, cluster)
        left.callback(fleet.close)
        options: dict[str, Any] = {"work": work_of(fleet), "threads": fleet.size}
        if metrics_port is not None:
            from compgen.fleet.dashboard.metrics import WatchMetrics, start_metrics
            from compgen.fleet.store import open_store

            metrics = WatchMetrics(left.enter_context(contextlib.closing(open_store(job.store))))
            left.callback(start_metrics(metrics.text, metrics_port)[1])
            options["on_outcome"] = metrics.count
        Watch(job.path, poll_s=poll_s, notify=_words(command), **options).run()
    return 0


@recal_command.command("status")
@click.argument("machines", nargs=-1)
@job_option
@json_option
def status_command(machines: tuple[str, ...], job: Job, as_json: bool) -> int:
    """Show the state of each of MACHINES (default: all): active version, waiting versions, last measurement, problems.

    Exit code 1 if the newest tables of a machine are held back, or its last measurement failed.

    \b
    Example:
      volcomp recal status --json
    """
    from compgen.fleet.records import WITHOUT_PRIOR
    from compgen.fleet.status import status

    found = opened(job, lambda store: status(store, job, machines))
    bad = any(item.state in ("held", "failed") for item in found)
    if as_json:
        print_json({"accepted": not bad, "machines": [item.summary() for item in found]})
        return int(bad)
    rows = [
        (
            item.machine,
            item.state,
            "-"
            if item.active is None
            else f"{item.active} ({WITHOUT_PRIOR})"
            if item.without_prior
            else str(item.active),
            ", ".join(map(str, item.waiting)) or "-",
            item.last_measured or "-",
            item.schedule or "-",
            item.message,
        )
        for item in found
    ]
    print_table(("machine", "state", "active", "waiting", "last measured", "schedule", ""), rows)
    return int(bad)


def print_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows of text below their headings."""
    table = Table(box=box.SIMPLE, pad_edge=False, collapse_padding=True)
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for row in rows:
        table.add_row(*row)
    stdout.print(table)


@recal_command.command("history")
@click.argument("machine", required=False)
@job_option
@click.option("--drift", is_flag=True, help="Show how MACHINE drifts instead: changes, trends, forecasts, steps.")
@click.option("--report", default=None, metavar="FILE", type=PATH, help="Write the drift as an HTML page with charts.")
@json_option
def history_command(machine: str | None, job: Job, drift: bool, report: Path | None, as_json: bool) -> int:
    """Show the history of MACHINE (default: all): measurements, failures, and decisions with the person and the reason.

    \b
    Example:
      volcomp recal history mill-1 --json
      volcomp recal history mill-1 --drift --report mill-1.html
    """
    from compgen.fleet.status import history

    if drift or report is not None:
        return int(opened(job, lambda store: show_drift(store, job, machine, report, as_json=as_json)))

    if machine is not None:
        job.machine(machine)
    entries = opened(job, lambda s: history(s, None if machine is None else s.machine(machine)))
    if as_json:
        print_json({"entries": [entry.summary() for entry in entries]})
        return 0
    rows = [
        (
            entry.at,
            entry.machine,
            entry.kind,
            "-" if entry.version is None else str(entry.version),
            entry.actor,
            entry.text,
        )
        for entry in entries
    ]
    print_table(("at", "machine", "what", "version", "who", "why"), rows)
    return 0


# ``volcomp recal approve``, ``reject``, ``rollback`` and ``adopt``.


def who_option(*, reason: bool) -> Callable[[Command], Command]:
    """Add --actor and --reason."""

    def decorate(command: Command) -> Command:
        text = "Reason, kept in the history." if reason else "Reason, kept in the history; required with --override."
        given = {"required": True} if reason else {"default": ""}  # a default of None would count as given
        why = click.option("--reason", metavar="TEXT", help=text, **given)
        who = click.option(
            "--actor", default=None, metavar="NAME", help="Person who decides; default: your login name."
        )
        return who(why(command))

    return decorate


def actor_of(name: str | None) -> str:
    """Return the name of the person who decides: the one given, otherwise the login name."""
    try:
        return name or getpass.getuser()
    except (KeyError, OSError) as error:
        raise InputError("this account has no name; give --actor NAME") from error


@recal_command.command("approve")
@click.argument("machine")
@click.argument("version", type=click.IntRange(1), required=False)
@job_option
@click.option("--override", is_flag=True, help="Approve a version even if the policy holds it back; needs --reason.")
@who_option(reason=False)
@json_option
def approve_command(
    machine: str, version: int | None, job: Job, override: bool, actor: str | None, reason: str, as_json: bool
) -> int:
    """Make VERSION of MACHINE's tables active.

    Without VERSION, on a terminal, the only waiting version is shown and must be confirmed; elsewhere give the
    VERSION that you checked, because another one may be waiting by now. Tables that the verification did not accept can
    never be approved.

    \b
    Example:
      volcomp recal approve mill-1 3 --reason "checked with the ball bar"
    """
    from compgen.fleet.actions import approve

    seen = None
    if version is None:
        version, seen = opened(job, lambda store: _asked(store, job.machine(machine).name, may_ask=not as_json))
    done = approve(job, machine, version, actor_of(actor), reason, override=override, seen=seen)
    return _decided(job, machine, done, as_json)


def _asked(store: Store, name: str, *, may_ask: bool) -> tuple[int, int]:
    """Return the version that waits and the active one (0: none), after a person has seen and confirmed both.

    Raises
    ------
    InputError
        without a terminal: the version that waits now may not be the one that somebody checked before.
    """
    from compgen.errors import visible
    from compgen.fleet import decisions

    machine = store.machine(name)
    table = decisions.only_pending(store, machine)
    measured = store.measurement_behind(machine, table)
    what = f"{name}: version {table.version} ({table.state}) from {visible(measured.name, flat=True)}, measured "
    what += measured.measured_at.isoformat(timespec="minutes")
    if not (may_ask and sys.stdin.isatty() and sys.stderr.isatty()):
        raise InputError(
            f"{what}, waits for a decision; without a terminal, give the version: volcomp recal approve {name} {table.version}",
            field="VERSION",
        )
    active = decisions.active_table(store, machine)
    complain(what, None)
    complain("active now: " + ("no tables" if active is None else f"version {active.version}"), None)
    for reason in table.reasons:
        complain(f"  {visible(reason, flat=True)}", None)
    click.confirm("Make it active?", abort=True, err=True)
    return table.version, 0 if active is None else active.version


@recal_command.command("reject")
@click.argument("machine")
@click.argument("version", type=click.IntRange(1), required=False)
@job_option
@who_option(reason=True)
@json_option
def reject_command(machine: str, version: int | None, job: Job, actor: str | None, reason: str, as_json: bool) -> int:
    """Refuse VERSION of MACHINE's tables (default: the only waiting one).

    \b
    Example:
      volcomp recal reject mill-1 3 --reason "a fixture was loose"
    """
    from compgen.fleet.actions import reject

    return _decided(job, machine, reject(job, machine, version, actor_of(actor), reason), as_json)


@recal_command.command("rollback")
@click.argument("machine")
@job_option
@click.option(
    "--to",
    type=click.IntRange(0),
    default=None,
    help="Version that was active; 0: no tables. Default: the previous one.",
)
@who_option(reason=True)
@json_option
def rollback_command(machine: str, job: Job, to: int | None, actor: str | None, reason: str, as_json: bool) -> int:
    """Make an earlier version of MACHINE's tables active again, byte for byte.

    \b
    Example:
      volcomp recal rollback mill-1 --reason "parts out of tolerance since Monday"
    """
    from compgen.fleet.actions import rollback

    return _decided(job, machine, rollback(job, machine, actor_of(actor), reason, to=to), as_json)


@recal_command.command("adopt")
@click.argument("machine")
@job_option
@who_option(reason=True)
@json_option
def adopt_command(machine: str, job: Job, actor: str | None, reason: str, as_json: bool) -> int:
    """Make this store the owner of MACHINE's output folder, after the store was lost, emptied or replaced by an older backup.

    The contents of the folder are moved to SET-ASIDE-1 (2, ...) inside it, and the store publishes its own versions.
    After that it does not know which tables are active: the next measurement must state it, or a version must be
    approved.

    \b
    Example:
      volcomp recal adopt mill-1 --reason "store restored from the backup of Sunday"
    """
    from compgen.fleet.actions import adopt

    moved = adopt(job, machine, actor_of(actor), reason)
    if as_json:
        print_json({"accepted": True, "machine": machine, "set_aside": None if moved is None else str(moved)})
    else:
        what = "there was nothing to set aside" if moved is None else f"its contents are now in {moved}"
        say(f"{machine}: the folder now belongs to this store; {what}")
    return 0


def _decided(job: Job, machine: str, decision: Any, as_json: bool) -> int:
    from compgen.fleet.decisions import CLOCKS_DIFFER
    from compgen.fleet.status import status

    now, clock = opened(job, lambda store: (status(store, job, (machine,))[0], store.now()))
    said = []
    if decision.at > clock + CLOCKS_DIFFER:
        said = [
            f"the clock went back: it is {clock.isoformat(timespec='seconds')}, but the last decision was made at "
            f"{decision.at.isoformat(timespec='seconds')}; this one is recorded with that time, so the times do not tell which "
            "tables were on: set the clock right, and state it in measurement files or add a backup of the control"
        ]
    for text in said:
        complain(f"warning: {text}", "yellow")
    if as_json:
        facts = {
            "kind": decision.kind,
            "actor": decision.actor,
            "reason": decision.reason,
            "at": decision.at.isoformat(),
        }
        made = {"accepted": True, "machine": machine, "active": now.active, "decision": facts}
        print_json({**made, "warnings": said} if said else made)
    else:
        active = "no tables are active" if now.active is None else f"version {now.active} is active"
        say(f"{machine}: {decision.kind} by {decision.actor}; {active}")
    return 0


# ``volcomp recal history MACHINE --drift``, ``volcomp recal recheck`` and ``volcomp recal exclude``.


def show_drift(store: Store, job: Job, machine: str | None, report: Path | None, *, as_json: bool) -> int:
    """Print the drift of one machine and write its page; the exit code is 0."""
    from compgen.fleet.drift import DriftSettings, drift_of_store, moment_of

    if machine is None:
        raise InputError("--drift and --report are for one machine; give its name")
    settings = job.machine(machine)
    found = drift_of_store(store, store.machine(machine), DriftSettings(settings.tolerances))
    paths = [] if report is None else [str(_write(report, found, settings.language))]
    if as_json:
        print_json({"accepted": True, "paths": paths, "drift": found.summary()})
        return 0
    say(f"{machine}: {len(found.times)} calibrations, {moment_of(found.times[0])} to {moment_of(found.times[-1])}")
    for title, change, errors in (
        ("last", found.volume_since_last, found.since_last),
        ("first", found.volume_since_first, found.since_first),
    ):
        if change is not None:
            level = 1.0 - found.settings.confidence
            named = ", ".join(item.error for item in errors if item.adjusted < level) or "no single error"
            say(
                f"since the {title}: {change.rms_um:.2f} um rms over the volume ({change.expected_rms_um:.2f} um "
                f"expected from the uncertainty alone), p = {change.p_value:.2g}; changed: {named}"
            )
    for text in found.sentences():
        say(f"  {text}")
    for path in paths:
        say(path)
    return 0


def _write(path: Path, drift: Drift, language: str) -> Path:
    from compgen.fleet.history_page import write_history_report

    return write_history_report(path, drift, language)


@recal_command.command("recheck")
@click.argument("machine")
@click.option("--stations", required=True, metavar="FILE", help="Stations file of volcomp plan or identify.")
@options_of(RequestedChange, "request", build=RequestedChange.from_file_units)
@click.option("--points", default=None, metavar="FILE", type=PATH, help="Write a points file.")
@job_option
@json_option
def recheck_command(
    machine: str, stations: str, request: RequestedChange, points: Path | None, job: Job, as_json: bool
) -> int:
    """Find the fewest points at which tracers detect a change of one error of MACHINE since its last calibration.

    \b
    Example:
      volcomp recal recheck mill-1 --stations stations.csv --error EC0Y --change 10 --points recheck.points.csv
    """
    from compgen.data.names import error_named
    from compgen.fleet.change import calibrations_of
    from compgen.fleet.recheck import shortest_recheck, write_recheck_points
    from compgen.planning import read_stations

    job.machine(machine)
    history, _, model = opened(job, lambda store: calibrations_of(store, store.machine(machine)))
    found = shortest_recheck(model, read_stations(stations), request, history[-1].covariance)
    paths = [] if points is None else [str(write_recheck_points(points, found))]
    if as_json:
        print_json({"accepted": True, "paths": paths, **found.summary()})
        return 0
    name = error_named(request.error)
    change, u, smallest = (size / name.si_per_unit for size in (request.size, found.u, found.smallest))
    say(
        f"{len(found.position_mm)} points, {found.readings} readings: {name.name} to {u:.2f} {name.unit} (standard "
        f"uncertainty); {change:g} {name.unit} is detected with power {found.power:.2f}, {smallest:.2f} {name.unit} with "
        f"{request.power:g}"
    )
    for place in found.position_mm.tolist():
        stdout.print("  " + ", ".join(f"{letter} {value:g} mm" for letter, value in zip("XYZ", place, strict=True)))
    for path in paths:
        say(path)
    return 0


@recal_command.command("exclude")
@click.argument("machine")
@click.argument("version", type=click.IntRange(1))
@job_option
@click.option("--undo", is_flag=True, help="Undo an exclusion.")
@who_option(reason=True)
@json_option
def exclude_command(
    machine: str, version: int, job: Job, undo: bool, actor: str | None, reason: str, as_json: bool
) -> int:
    """Exclude the wrong measurement behind VERSION of MACHINE's tables from the drift.

    Nothing is deleted; the history records who, when and why. Roll an active version back first.

    \b
    Example:
      volcomp recal exclude mill-1 5 --reason "the sign of the deviations was wrong"
    """
    from compgen.fleet.decisions import exclude

    who = actor_of(actor)
    exclude(job, machine, version, who, reason, undo=undo)
    what = "is included in the drift again" if undo else "is left out of the drift"
    answer(
        as_json,
        {"accepted": True, "machine": machine, "version": version, "excluded": not undo, "actor": who},
        f"{machine}: the measurement behind version {version} {what}",
    )
    return 0


# ``volcomp recal reprocess``: identify and export again from a stored measurement.


@recal_command.command("reprocess")
@click.argument("machine")
@options_of(ReprocessRequest, "given", build=dict)
@backup_option
@job_option
@who_option(reason=True)
@json_option
def reprocess_command(
    machine: str,
    given: dict[str, Any],
    backup: tuple[Path, ...],
    job: Job,
    actor: str | None,
    reason: str,
    as_json: bool,
) -> int:
    """Identify and export again from a stored measurement of MACHINE, with the present job, machine and instrument files.

    Earlier versions are kept: a new version is proposed and judged like any other. Exit code 1 if it is held back or
    refused.

    \b
    Example:
      volcomp recal reprocess mill-1 --reason "pitch of X corrected in the machine file"
      volcomp recal reprocess mill-1 --active-table v2 --reason "v2 was on, says the log of the control"
    """
    from compgen.fleet.actions import reprocess

    request = ReprocessRequest(actor=actor_of(actor), reason=reason, backup=backup, **given)
    done = reprocess(job, machine, request)
    table = done.table
    if as_json:
        facts = {"id": done.measurement.id, "name": done.measurement.name, "sha256": done.measurement.sha256}
        made = {"version": table.version, "state": table.state, "reasons": list(table.reasons)}
        accepted = done.exit_code == 0
        print_json({"accepted": accepted, "machine": machine, "measurement": facts, "revision": done.revision, **made})
        return done.exit_code
    say(f"{machine}: version {table.version} from {done.measurement.name} is {table.state}")
    for text in table.reasons:
        say(f"  {text}")
    return done.exit_code


# ``volcomp recal add``, ``export-units``, ``backup`` and ``restore``: the job file, its units, the whole store.


#: Keys of a machine that ``recal add`` takes; the others are written into the job file by hand.
ADDED_KEYS = (
    "machine", "inbox", "controllers", "out", "measured_with", "schedule", "every_minutes", "approval", "instrument"
)  # fmt: skip


@recal_command.command("export-units")
@job_option
@click.option("--out", required=True, metavar="DIR", type=PATH, help="Folder for the files.")
@click.option("--program", default=None, metavar="PATH", help="The compgen command; default: the one that is running.")
@json_option
def export_units_command(job: Job, out: Path, program: str | None, as_json: bool) -> int:
    """Write systemd service and timer units and crontab lines that start `volcomp recal run` by the job's schedules.

    \b
    Example:
      volcomp recal export-units --out units/
    """
    from compgen.pipeline import write_all

    paths = write_all(out, units(job, program or str(Path(sys.argv[0]).absolute())))
    if as_json:
        print_json({"accepted": True, "paths": [str(path) for path in paths.values()]})
    else:
        for path in paths.values():
            say(str(path))
    return 0


@recal_command.command("backup")
@click.argument("file", type=PATH)
@job_option
@json_option
def backup_command(file: Path, job: Job, as_json: bool) -> int:
    """Write a consistent copy of the whole store to FILE; others may use the store meanwhile.

    \b
    Example:
      volcomp recal backup backups/2026-06-01.sqlite
    """
    from compgen.fleet.store import backup

    return _copied(backup(job.store, file), as_json)


@recal_command.command("restore")
@click.argument("file", type=PATH)
@job_option
@json_option
def restore_command(file: Path, job: Job, as_json: bool) -> int:
    """Fill the store of the job, which must be empty, from the backup FILE; the next run writes the tables again.

    The store does not know what was loaded into the controls after the backup: a measurement of that time must state which
    tables were on, or come with a backup of the control.

    \b
    Example:
      volcomp recal restore backups/2026-06-01.sqlite --job recal.toml
    """
    from compgen.fleet.store import restore

    return _copied(restore(file, job.store, mark=True), as_json)


def _copied(counts: dict[str, int], as_json: bool) -> int:
    answer(
        as_json,
        {"accepted": True, "rows": counts},
        ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()),
    )
    return 0


@recal_command.command("add")
@click.argument("name")
@options_of(MachineJob, "keys", only=ADDED_KEYS, build=dict)
@job_file_option
@json_option
def add_command(name: str, job_file: Path, as_json: bool, keys: dict[str, Any]) -> int:
    """Add the machine NAME to the job file, which is created if it does not exist; paths are relative to it.

    \b
    Example:
      volcomp recal add mill-1 --machine mill-1.toml --inbox inbox --controller siemens-cec --out tables \\
                    --measured-with bare --schedule "30 6 * * mon"
    """
    needed()
    added = add_machine(job_file, name, keys)
    if as_json:
        print_json({"accepted": True, "job": str(job_file), "machine": added.name})
    else:
        stdout.print(f"{added.name}: added to {job_file}; `volcomp recal run --job {job_file}` reads {added.inbox}")
    return 0


# ``volcomp serve``: the dashboard, and who may log in.


def _missing(error: ImportError) -> InputError:
    return InputError(f"{error.name} is not installed; the dashboard needs: pip install 'compgen[serve]'")


@click.group("serve", invoke_without_command=True)
@click.option(
    "--store", metavar="URL", help="sqlite:///FILE, a path, or postgresql://HOST/NAME; default: that of --job."
)
@options_of(DashboardSettings, "given", without=("store_url",), read={"metrics_token": read_token}, build=dict)
@log_option
@click.pass_context
def serve_command(context: click.Context, store: str | None, given: dict[str, Any], log: str) -> int:
    """Show the fleet in a browser: history, drift, before and after of proposed tables.

    By default it is read-only and reachable from this computer only. Runs until SIGTERM or Ctrl-C.

    \b
    Example:
      volcomp serve add-user meyer --users users.json
      volcomp serve --job recal.toml --decide --users users.json
    """
    if context.invoked_subcommand is not None:
        return 0
    try:
        from compgen.fleet import logs
        from compgen.fleet.dashboard.server import run
    except ImportError as error:
        raise _missing(error) from error
    url = _store_url(store, given["job"])
    logs.configure(log)  # type: ignore[arg-type]  # one of the choices
    for file in (*([None] if store else []), *([given["job"]] if given["job"] else [])):
        warn_of_password(url, file)
    run(DashboardSettings(url, **{**given, "users": given["users"] or default_users(url)}))
    return 0


def _store_url(store: str | None, job: Path | None) -> str:
    """Return the store of --store or --job; decisions and pages must use the same one."""
    if job is None:
        if store is None:
            raise click.UsageError("give --store URL or --job FILE")
        return store
    from compgen.fleet.database import shown

    url = read_job(job).store
    given = url if store is None else store if "://" in store else f"sqlite:///{Path(store).absolute()}"
    if given != url:
        raise InputError(
            f"{shown(given)} is not the store of {job}, which is {shown(url)}; omit --store", field="--store"
        )
    return url


def users_option(command: Command) -> Command:
    """Add --users and --store; the command receives ``users``, the file of users that either names."""

    @functools.wraps(command)
    def wrapper(*args: Any, users: Path | None, store: str | None, **options: Any) -> Any:
        try:
            from compgen.fleet.dashboard.users import Users

            file = users if users is not None else default_users(store) if store else None
        except ImportError as error:
            raise _missing(error) from error
        if file is None:
            raise click.UsageError("give --users FILE, or --store FILE of an SQLite store")
        return command(*args, users=Users(file), **options)

    text = "SQLite store; the file of its users is next to it."
    decorated: Any = click.option("--store", metavar="URL", help=text)(wrapper)
    return options_of(DashboardSettings, "users", only=("users",), build=lambda users: users)(decorated)  # type: ignore[no-any-return]


@serve_command.command("add-user")
@click.argument("name")
@users_option
@click.option("--password-stdin", is_flag=True, help="Read the password from the first line of stdin.")
@click.option("--reader", is_flag=True, help="The user may read what --private shows, but not decide.")
def add_user(name: str, users: Users, password_stdin: bool, reader: bool) -> int:
    """Add a user, or change password and rights; a change ends the user's sessions.

    The password is prompted for twice and stored only as an Argon2id hash.

    \b
    Example:
      volcomp serve add-user meyer --users users.json
    """
    from compgen.fleet.dashboard.users import check_name

    check_name(name)
    if password_stdin:
        password = sys.stdin.readline().rstrip("\r\n")
    else:
        password = click.prompt("Password", hide_input=True, confirmation_prompt=True, err=True)
    new = users.add(name, password, reader=reader)
    say(f"{name} {'is added' if new else 'has a new password'}: {users.path}")
    return 0


@serve_command.command("remove-user")
@click.argument("name")
@users_option
def remove_user(name: str, users: Users) -> int:
    """Remove a user; the user's sessions end at once.

    \b
    Example:
      volcomp serve remove-user meyer --users users.json
    """
    users.remove(name)
    say(f"{name} is removed: {users.path}")
    return 0


@serve_command.command("users")
@users_option
@json_option
def list_users(users: Users, as_json: bool) -> int:
    """List who may log in.

    \b
    Example:
      volcomp serve users --users users.json
    """
    names = users.names()
    answer(as_json, {"users": names}, "\n".join(names) or "no users yet: nobody can log in")
    return 0
