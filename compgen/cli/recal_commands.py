"""``compgen recal``: scheduled recalibration; what a command needs is imported when it runs."""

from __future__ import annotations

import functools
import getpass
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich import box
from rich.table import Table

from compgen.cli.common import Command, json_option, print_json, stdout
from compgen.errors import InputError

if TYPE_CHECKING:
    from compgen.recal.job import Job
    from compgen.recal.store import Store

JOB = "recal.toml"
_PATH = click.Path(path_type=Path)
#: Modules that only this command group needs, by the name of their distribution.
NEEDED = {"sqlalchemy": "SQLAlchemy", "alembic": "alembic", "apscheduler": "APScheduler", "structlog": "structlog"}


@click.group("recal")
def recal() -> None:
    """Scheduled recalibration: new measurements become proposed tables, a person approves, everything can be undone.

    The job file (--job, default recal.toml) says which machines, from which inbox, when, by which rules. Limits are in
    um, temperatures in degC, ages in days. Exit codes: 0 all is well (tables may wait for approval), 1 something is held
    back or failed, 2 wrong usage, job file or store, 3 internal error.

    \b
    Example:
      compgen recal add mill-1 --machine mill-1.toml --inbox inbox/mill-1 --controller siemens-cec \\
                    --out tables/mill-1 --measured-with active
      compgen recal run
      compgen recal approve mill-1
    """


def _needed() -> None:
    """Say what is not installed, if anything is not."""
    import importlib.util

    missing = [name for module, name in NEEDED.items() if importlib.util.find_spec(module) is None]
    if missing:
        raise InputError(f"compgen recal needs {', '.join(missing)}; install compgen[recal]")


def job_option(command: Command) -> Command:
    """Add --job and --log; the command receives ``job``, read."""

    @functools.wraps(command)
    def wrapper(*args: Any, job_file: Path, log: str, **options: Any) -> Any:
        _needed()
        from compgen.recal import logs
        from compgen.recal.job import read_job

        logs.configure(log)  # type: ignore[arg-type]
        return command(*args, job=read_job(job_file), **options)

    return _job_options(wrapper)  # type: ignore[no-any-return]


def _job_options(command: Any) -> Any:
    form = click.Choice(["auto", "json", "text"])
    text = "Form of the logs on stderr; auto: words on a terminal, else one JSON object per line."
    logged = click.option("--log", default="auto", show_default=True, type=form, help=text)(command)
    file = click.option(
        "--job", "job_file", default=JOB, show_default=True, type=_PATH, metavar="FILE", help="Job file."
    )
    return file(logged)


notify_option = click.option(
    "--notify",
    "command",
    default=None,
    metavar="COMMAND",
    help="Command that gets one JSON object on stdin for every decision and failure; default: that of the job file.",
)


def opened(job: Job, use: Callable[[Store], Any]) -> Any:
    """Do something with the store of a job and close it."""
    from compgen.recal.store import open_store

    store = open_store(job.store)
    try:
        return use(store)
    finally:
        store.close()


def who_option(*, reason: bool) -> Callable[[Command], Command]:
    """Add --actor and --reason."""

    def decorate(command: Command) -> Command:
        text = "Why; kept in the history." if reason else "Why; kept in the history, due with --override."
        why = click.option("--reason", required=reason, default=None if reason else "", metavar="TEXT", help=text)
        who = click.option("--actor", default=None, metavar="NAME", help="Who decides; default: your login name.")
        return who(why(command))

    return decorate


def _actor(name: str | None) -> str:
    try:
        return name or getpass.getuser()
    except (KeyError, OSError) as error:
        raise InputError("this account has no name; say who decides with --actor NAME") from error


@recal.command("run")
@click.argument("machines", nargs=-1)
@job_option
@notify_option
@json_option
def run_command(machines: tuple[str, ...], job: Job, command: str | None, as_json: bool) -> int:
    """Look once into the inboxes of MACHINES (default all), process what is new, publish the tables.

    The same inbox gives the same state, however often it is run. A machine that fails does not stop the others.

    \b
    Example:
      compgen recal run --job /etc/compgen/recal.toml --json
    """
    from compgen.recal.runner import run_jobs

    result = run_jobs(job.with_notify(_words(command)), machines)
    if as_json:
        print_json(result.summary())
        return result.exit_code
    for item in result.outcomes:
        active = "no tables active" if item.active is None else f"version {item.active} active"
        done = f", processed {', '.join(item.processed)}" if item.processed else ""
        waiting = f", waiting: {', '.join(map(str, item.waiting))}" if item.waiting else ""
        stdout.print(f"{item.machine}: {item.state}, {active}{waiting}{done}", soft_wrap=True)
        for message in item.messages:
            stdout.print(f"  {message}", soft_wrap=True)
    return result.exit_code


def _words(command: str | None) -> tuple[str, ...]:
    from compgen.recal.job import command_words

    try:
        return () if command is None else command_words(command)
    except ValueError as error:
        raise InputError(str(error), field="--notify") from error


@recal.command("watch")
@job_option
@click.option(
    "--poll-s", default=2.0, show_default=True, type=click.FloatRange(0.05, 3600), help="Look at the job file, s."
)
@click.option(
    "--metrics-port", type=click.IntRange(0, 65535), help="Show Prometheus metrics on 127.0.0.1 at this port."
)
@notify_option
def watch_command(job: Job, poll_s: float, metrics_port: int | None, command: str | None) -> int:
    """Keep running: every machine by its schedule (without one every 5 minutes), until SIGTERM or Ctrl-C.

    Edits of the job file are picked up; a wrong one is reported and the one before stays. On a signal the measurement
    that is being processed is finished.

    \b
    Example:
      compgen recal watch --job /etc/compgen/recal.toml
    """
    from compgen.recal.watch import Watch

    words = _words(command)
    if metrics_port is None:
        Watch(job.path, poll_s=poll_s, notify=words).run()
        return 0
    from compgen.recal.store import open_store
    from compgen.serve.metrics import WatchMetrics, start_metrics

    store = open_store(job.store)
    metrics = WatchMetrics(store)
    _, stop = start_metrics(metrics.text, metrics_port)
    try:
        Watch(job.path, poll_s=poll_s, notify=words, on_outcome=metrics.count).run()
    finally:
        stop()
        store.close()
    return 0


@recal.command("status")
@click.argument("machines", nargs=-1)
@job_option
@json_option
def status_command(machines: tuple[str, ...], job: Job, as_json: bool) -> int:
    """Show where each of MACHINES (default all) stands: active version, what waits, last measurement, what is wrong.

    Exit code 1 if the newest tables of any are held back, or its last measurement failed.

    \b
    Example:
      compgen recal status --json
    """
    from compgen.recal.overview import status

    found = opened(job, lambda store: status(store, job, machines))
    bad = any(item.state in ("held", "failed") for item in found)
    if as_json:
        print_json({"accepted": not bad, "machines": [item.summary() for item in found]})
        return int(bad)
    rows = [
        (
            item.machine,
            item.state,
            "-" if item.active is None else str(item.active),
            ", ".join(map(str, item.waiting)) or "-",
            item.last_measured or "-",
            item.schedule or "-",
            item.message,
        )
        for item in found
    ]
    _print_table(("machine", "state", "active", "waiting", "last measured", "schedule", ""), rows)
    return int(bad)


def _print_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    table = Table(box=box.SIMPLE, pad_edge=False, collapse_padding=True)
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for row in rows:
        table.add_row(*row)
    stdout.print(table)


@recal.command("history")
@click.argument("machine", required=False)
@job_option
@click.option("--drift", is_flag=True, help="Show how MACHINE drifts instead: changes, trends, forecasts, steps.")
@click.option("--report", default=None, metavar="FILE", type=_PATH, help="Write the drift as a page, with pictures.")
@json_option
def history_command(machine: str | None, job: Job, drift: bool, report: Path | None, as_json: bool) -> int:
    """Show everything that happened to MACHINE (default all): measurements, failures, decisions with who and why.

    \b
    Example:
      compgen recal history mill-1 --json
      compgen recal history mill-1 --drift --report mill-1.html
    """
    from compgen.recal.overview import history

    if drift or report is not None:
        from compgen.cli.recal_drift_commands import show_drift

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
    _print_table(("at", "machine", "what", "version", "who", "why"), rows)
    return 0


@recal.command("approve")
@click.argument("machine")
@click.argument("version", type=click.IntRange(1), required=False)
@job_option
@click.option("--override", is_flag=True, help="Also a version that the policy holds back; --reason is due.")
@who_option(reason=False)
@json_option
def approve_command(
    machine: str, version: int | None, job: Job, override: bool, actor: str | None, reason: str, as_json: bool
) -> int:
    """Make VERSION of MACHINE's tables active (default: the only one that waits).

    Tables that the round trip did not accept can never be approved.

    \b
    Example:
      compgen recal approve mill-1 3 --reason "checked with the ball bar"
    """
    from compgen.recal.actions import approve

    return _decided(job, machine, approve(job, machine, version, _actor(actor), reason, override=override), as_json)


@recal.command("reject")
@click.argument("machine")
@click.argument("version", type=click.IntRange(1), required=False)
@job_option
@who_option(reason=True)
@json_option
def reject_command(machine: str, version: int | None, job: Job, actor: str | None, reason: str, as_json: bool) -> int:
    """Refuse VERSION of MACHINE's tables (default: the only one that waits).

    \b
    Example:
      compgen recal reject mill-1 3 --reason "a fixture was loose"
    """
    from compgen.recal.actions import reject

    return _decided(job, machine, reject(job, machine, version, _actor(actor), reason), as_json)


@recal.command("rollback")
@click.argument("machine")
@job_option
@click.option(
    "--to", type=click.IntRange(0), default=None, help="Version that was active; 0: no tables. Default: the one before."
)
@who_option(reason=True)
@json_option
def rollback_command(machine: str, job: Job, to: int | None, actor: str | None, reason: str, as_json: bool) -> int:
    """Make an earlier version of MACHINE's tables active again, byte for byte.

    \b
    Example:
      compgen recal rollback mill-1 --reason "parts out of tolerance since Monday"
    """
    from compgen.recal.actions import rollback

    return _decided(job, machine, rollback(job, machine, _actor(actor), reason, to=to), as_json)


def _decided(job: Job, machine: str, decision: Any, as_json: bool) -> int:
    from compgen.recal.overview import status

    now = opened(job, lambda store: status(store, job, (machine,)))[0]
    if as_json:
        facts = {
            "kind": decision.kind,
            "actor": decision.actor,
            "reason": decision.reason,
            "at": decision.at.isoformat(),
        }
        print_json({"accepted": True, "machine": machine, "active": now.active, "decision": facts})
    else:
        active = "no tables are active" if now.active is None else f"version {now.active} is active"
        stdout.print(f"{machine}: {decision.kind} by {decision.actor}; {active}", soft_wrap=True)
    return 0


@recal.command("export-units")
@job_option
@click.option("--out", required=True, metavar="DIR", type=_PATH, help="Folder for the files.")
@click.option("--program", default=None, metavar="PATH", help="The compgen command; default: the one that runs now.")
@json_option
def export_units_command(job: Job, out: Path, program: str | None, as_json: bool) -> int:
    """Write systemd service and timer units and crontab lines that drive `compgen recal run` by the job's schedules.

    \b
    Example:
      compgen recal export-units --out units/
    """
    from compgen.pipeline import write_all
    from compgen.recal.units import units

    paths = write_all(out, units(job, program or str(Path(sys.argv[0]).absolute())))
    if as_json:
        print_json({"accepted": True, "paths": [str(path) for path in paths.values()]})
    else:
        for path in paths.values():
            stdout.print(str(path), soft_wrap=True)
    return 0


@recal.command("backup")
@click.argument("file", type=_PATH)
@job_option
@json_option
def backup_command(file: Path, job: Job, as_json: bool) -> int:
    """Write a copy of the whole store to FILE, as it is at one moment, while others may be working with it.

    \b
    Example:
      compgen recal backup backups/2026-06-01.sqlite
    """
    from compgen.recal.backup import backup

    return _copied(backup(job.store, file), as_json)


@recal.command("restore")
@click.argument("file", type=_PATH)
@job_option
@json_option
def restore_command(file: Path, job: Job, as_json: bool) -> int:
    """Fill the store of the job, which must be empty, from the backup FILE; the next run writes the tables again.

    \b
    Example:
      compgen recal restore backups/2026-06-01.sqlite --job recal.toml
    """
    from compgen.recal.backup import restore

    return _copied(restore(file, job.store), as_json)


def _copied(counts: dict[str, int], as_json: bool) -> int:
    if as_json:
        print_json({"accepted": True, "rows": counts})
    else:
        stdout.print(", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()), soft_wrap=True)
    return 0


@recal.command("add")
@click.argument("name")
@click.option("--machine", required=True, metavar="MACHINE", help="Machine TOML, or the name of a machine.")
@click.option("--inbox", required=True, metavar="DIR", help="Folder where measurements arrive.")
@click.option(
    "--controller", "controllers", required=True, multiple=True, metavar="NAME", help="May be given several times."
)
@click.option("--out", required=True, metavar="DIR", help="Folder for the tables of this machine.")
@click.option(
    "--measured-with",
    required=True,
    type=click.Choice(["active", "bare"]),
    help="Whether the compensation stays on (active) or is switched off (bare) while the machine is measured.",
)
@click.option("--schedule", default=None, metavar="CRON", help="Cron expression of five fields, local time.")
@click.option("--every-minutes", default=None, type=int, help="In place of --schedule: an interval in minutes.")
@click.option("--approval", default=None, type=click.Choice(["manual", "auto"]), help="Default: manual.")
@click.option("--instrument", default=None, metavar="FILE", help="Instrument TOML of six-DOF readings.")
@click.option("--job", "job_file", default=JOB, show_default=True, type=_PATH, metavar="FILE", help="Job file.")
@json_option
def add_command(name: str, job_file: Path, as_json: bool, controllers: tuple[str, ...], **keys: Any) -> int:
    """Add the machine NAME to the job file, which is made if it does not exist; paths are relative to it.

    \b
    Example:
      compgen recal add mill-1 --machine mill-1.toml --inbox inbox --controller siemens-cec --out tables \\
                    --measured-with bare --schedule "30 6 * * mon"
    """
    _needed()
    from compgen.recal.edit import add_machine

    added = add_machine(job_file, name, {**keys, "controllers": list(controllers)})
    if as_json:
        print_json({"accepted": True, "job": str(job_file), "machine": added.name})
    else:
        stdout.print(
            f"{added.name}: added to {job_file}; `compgen recal run --job {job_file}` looks into {added.inbox}"
        )
    return 0


COMMANDS = (recal,)
