"""``compgen recal approve``, ``reject``, ``rollback`` and ``adopt``."""

from __future__ import annotations

import getpass
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from compgen.cli.common import Command, json_option, print_json, stdout
from compgen.cli.recal_commands import job_option, opened, recal
from compgen.errors import InputError

if TYPE_CHECKING:
    from compgen.recal.job import Job
    from compgen.recal.store import Store


def who_option(*, reason: bool) -> Callable[[Command], Command]:
    """Add --actor and --reason."""

    def decorate(command: Command) -> Command:
        text = "Why; kept in the history." if reason else "Why; kept in the history, due with --override."
        given = {"required": True} if reason else {"default": ""}  # a default of None would count as given
        why = click.option("--reason", metavar="TEXT", help=text, **given)
        who = click.option("--actor", default=None, metavar="NAME", help="Who decides; default: your login name.")
        return who(why(command))

    return decorate


def actor_of(name: str | None) -> str:
    """Return the name of who decides: the one given, else the login name."""
    try:
        return name or getpass.getuser()
    except (KeyError, OSError) as error:
        raise InputError("this account has no name; say who decides with --actor NAME") from error


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
    """Make VERSION of MACHINE's tables active.

    Without VERSION the only one that waits is meant: on a terminal it is shown first and asked about; elsewhere it is
    refused if it took the place of another one that somebody may have looked at. Tables that the round trip did not
    accept can never be approved.

    \b
    Example:
      compgen recal approve mill-1 3 --reason "checked with the ball bar"
    """
    from compgen.recal.actions import approve

    if version is None:
        version = opened(job, lambda store: _shown(store, job.machine(machine).name, ask=not as_json))
    return _decided(job, machine, approve(job, machine, version, actor_of(actor), reason, override=override), as_json)


def _shown(store: Store, name: str, *, ask: bool) -> int:
    """Return the version that waits; on a terminal after a person has seen which one it is."""
    from compgen.recal import actions, decisions

    machine = store.machine(name)
    if not (ask and sys.stdin.isatty()):
        return actions.waiting_version(store, machine)
    waiting = decisions.pending(store, machine)
    if len(waiting) != 1:
        return actions.waiting_version(store, machine)
    (table,) = waiting
    measured = store.measurement_behind(table)
    at = measured.measured_at.isoformat(timespec="minutes")
    stdout.print(f"{name}: version {table.version} ({table.state}) from {measured.name}, measured {at}", soft_wrap=True)
    click.confirm("Make it active?", abort=True, err=True)
    return table.version


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

    return _decided(job, machine, reject(job, machine, version, actor_of(actor), reason), as_json)


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

    return _decided(job, machine, rollback(job, machine, actor_of(actor), reason, to=to), as_json)


@recal.command("adopt")
@click.argument("machine")
@job_option
@who_option(reason=True)
@json_option
def adopt_command(machine: str, job: Job, actor: str | None, reason: str, as_json: bool) -> int:
    """Give the output folder of MACHINE to this store, after the store was lost, emptied or replaced by an older backup.

    What the folder holds is moved to SET-ASIDE-1 (2, ...) inside it, and the store publishes its own versions. From then
    on it does not know which tables are on: the next measurement has to say it, or a version has to be approved.

    \b
    Example:
      compgen recal adopt mill-1 --reason "store restored from the backup of Sunday"
    """
    from compgen.recal.actions import adopt

    moved = adopt(job, machine, actor_of(actor), reason)
    if as_json:
        print_json({"accepted": True, "machine": machine, "set_aside": None if moved is None else str(moved)})
    else:
        what = "there was nothing to set aside" if moved is None else f"what it held is in {moved}"
        stdout.print(f"{machine}: the folder belongs to this store now; {what}", soft_wrap=True, markup=False)
    return 0


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


#: Its commands belong to the group ``recal``.
COMMANDS: tuple[click.Command, ...] = ()
