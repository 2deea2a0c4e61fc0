"""``volcomp recal``: run, watch, status, history; what a command needs is imported when it runs."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich import box
from rich.table import Table

from compgen.cli.common import STOPPED, Command, json_option, print_json, stdout
from compgen.cli.parallel_options import fleet_options, stopped_by_signals
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
      volcomp recal add mill-1 --machine mill-1.toml --inbox inbox/mill-1 --controller siemens-cec \\
                    --out tables/mill-1 --measured-with active
      volcomp recal run
      volcomp recal approve mill-1 1
    """


def needed() -> None:
    """Say what is not installed, if anything is not."""
    import importlib.util

    missing = [name for module, name in NEEDED.items() if importlib.util.find_spec(module) is None]
    if missing:
        raise InputError(f"volcomp recal needs {', '.join(missing)}; install compgen[recal]")


def job_option(command: Command) -> Command:
    """Add --job and --log; the command receives ``job``, read."""

    @functools.wraps(command)
    def wrapper(*args: Any, job_file: Path, log: str, **options: Any) -> Any:
        needed()
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


@recal.command("run")
@click.argument("machines", nargs=-1)
@job_option
@fleet_options
@notify_option
@json_option
def run_command(
    machines: tuple[str, ...], job: Job, workers: int, cluster: str | None, command: str | None, as_json: bool
) -> int:
    """Look once into the inboxes of MACHINES (default all), process what is new, publish the tables.

    The same inbox gives the same state, however often it is run. A machine that fails does not stop the others. On
    SIGTERM or Ctrl-C the measurements that are being processed are finished; exit code 130.

    \b
    Example:
      volcomp recal run --job /etc/compgen/recal.toml --json
      volcomp recal run --workers 8
    """
    from compgen.recal.fleet import run_fleet

    with stopped_by_signals() as stop:
        chosen = job.with_notify(_words(command))
        result = run_fleet(chosen, machines, workers=workers, cluster=cluster, stop=stop.is_set)
        code = STOPPED if stop.is_set() else result.exit_code
    if as_json:
        print_json(result.summary())
        return code
    for item in result.outcomes:
        if item.state == "stopped":
            stdout.print(f"{item.machine}: {'; '.join(item.messages)}", soft_wrap=True)
            continue
        active = "no tables active" if item.active is None else f"version {item.active} active"
        done = f", processed {', '.join(item.processed)}" if item.processed else ""
        waiting = f", waiting: {', '.join(map(str, item.waiting))}" if item.waiting else ""
        stdout.print(f"{item.machine}: {item.state}, {active}{waiting}{done}", soft_wrap=True)
        for message in item.messages:
            stdout.print(f"  {message}", soft_wrap=True)
    return code


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
@fleet_options
@notify_option
def watch_command(
    job: Job, poll_s: float, metrics_port: int | None, workers: int, cluster: str | None, command: str | None
) -> int:
    """Keep running: every machine by its schedule (without one every 5 minutes), until SIGTERM or Ctrl-C.

    Edits of the job file are picked up; a wrong one is reported and the one before stays. On a signal the measurements
    that are being processed are finished.

    \b
    Example:
      volcomp recal watch --job /etc/compgen/recal.toml
    """
    from compgen.recal.fleet import open_fleet, work_of
    from compgen.recal.watch import Watch

    with contextlib.ExitStack() as left:
        fleet = open_fleet(job.store, workers, cluster)
        left.callback(fleet.close)
        options: dict[str, Any] = {"work": work_of(fleet), "threads": fleet.size}
        if metrics_port is not None:
            options["on_outcome"] = _counted(job, metrics_port, left)
        Watch(job.path, poll_s=poll_s, notify=_words(command), **options).run()
    return 0


def _counted(job: Job, port: int, left: contextlib.ExitStack) -> Callable[[Any], None]:
    """Show metrics until ``left`` is; return what counts an outcome."""
    from compgen.recal.store import open_store
    from compgen.serve.metrics import WatchMetrics, start_metrics

    store = open_store(job.store)
    left.callback(store.close)
    metrics = WatchMetrics(store)
    left.callback(start_metrics(metrics.text, port)[1])
    return metrics.count


@recal.command("status")
@click.argument("machines", nargs=-1)
@job_option
@json_option
def status_command(machines: tuple[str, ...], job: Job, as_json: bool) -> int:
    """Show where each of MACHINES (default all) stands: active version, what waits, last measurement, what is wrong.

    Exit code 1 if the newest tables of any are held back, or its last measurement failed.

    \b
    Example:
      volcomp recal status --json
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
      volcomp recal history mill-1 --json
      volcomp recal history mill-1 --drift --report mill-1.html
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
    print_table(("at", "machine", "what", "version", "who", "why"), rows)
    return 0


COMMANDS = (recal,)
