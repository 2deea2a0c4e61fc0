"""``volcomp recal reprocess``: identify and export again from a stored measurement."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from compgen.cli.common import json_option, print_json, stdout
from compgen.cli.recal_commands import job_option, recal
from compgen.cli.recal_decision_commands import actor_of, who_option

if TYPE_CHECKING:
    from compgen.recal.job import Job


@recal.command("reprocess")
@click.argument("machine")
@click.option(
    "--measurement",
    default=None,
    metavar="ID",
    help="Its number in `history --json`, or the beginning of its SHA-256; default: the newest.",
)
@click.option(
    "--active-table",
    default=None,
    metavar="VERSION|none",
    help="The tables that were on while the machine was measured, for a measurement that is held back because that is "
    "not certain; default: what file, job and history say.",
)
@job_option
@who_option(reason=True)
@json_option
def reprocess_command(
    machine: str,
    measurement: str | None,
    active_table: str | None,
    job: Job,
    actor: str | None,
    reason: str,
    as_json: bool,
) -> int:
    """Identify and export again from a stored measurement of MACHINE, as job, machine and instrument files say now.

    What was there stays: a new version is proposed and judged as any other. Exit code 1 if it is held back or refused.

    \b
    Example:
      volcomp recal reprocess mill-1 --reason "pitch of X corrected in the machine file"
      volcomp recal reprocess mill-1 --active-table v2 --reason "v2 was on, says the log of the control"
    """
    from compgen.recal.reprocess import Wish, reprocess

    done = reprocess(job, machine, Wish(measurement, actor_of(actor), reason, active_table))
    table = done.table
    if as_json:
        facts = {"id": done.measurement.id, "name": done.measurement.name, "sha256": done.measurement.sha256}
        made = {"version": table.version, "state": table.state, "reasons": list(table.reasons)}
        accepted = done.exit_code == 0
        print_json({"accepted": accepted, "machine": machine, "measurement": facts, "revision": done.revision, **made})
        return done.exit_code
    stdout.print(f"{machine}: version {table.version} from {done.measurement.name} is {table.state}", soft_wrap=True)
    for text in table.reasons:
        stdout.print(f"  {text}", soft_wrap=True, markup=False)
    return done.exit_code


#: Its commands belong to the group ``recal``.
COMMANDS: tuple[click.Command, ...] = ()
