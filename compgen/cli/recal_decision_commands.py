"""``volcomp recal approve``, ``reject``, ``rollback`` and ``adopt``."""

from __future__ import annotations

import getpass
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from compgen.cli.common import Command, json_option, print_json, stderr, stdout
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

    Without VERSION the only one that waits is shown and asked about, on a terminal; elsewhere name the VERSION that you
    looked at, as another one may wait by now. Tables that the round trip did not accept can never be approved.

    \b
    Example:
      volcomp recal approve mill-1 3 --reason "checked with the ball bar"
    """
    from compgen.recal.actions import approve

    seen = None
    if version is None:
        version, seen = opened(job, lambda store: _asked(store, job.machine(machine).name, may_ask=not as_json))
    done = approve(job, machine, version, actor_of(actor), reason, override=override, seen=seen)
    return _decided(job, machine, done, as_json)


def _asked(store: Store, name: str, *, may_ask: bool) -> tuple[int, int]:
    """Return the version that waits and the active one (0: none), after a person has seen both and said yes.

    Raises
    ------
    InputError
        where nobody can be asked: what waits now need not be what somebody looked at before.
    """
    from compgen.core.text import visible
    from compgen.recal import decisions

    machine = store.machine(name)
    table = decisions.only_pending(store, machine)
    measured = store.measurement_behind(table)
    what = f"{name}: version {table.version} ({table.state}) from {visible(measured.name, flat=True)}, measured "
    what += measured.measured_at.isoformat(timespec="minutes")
    if not (may_ask and sys.stdin.isatty() and sys.stderr.isatty()):
        raise InputError(
            f"{what}, waits; without a terminal say which version you mean: volcomp recal approve {name} {table.version}",
            field="VERSION",
        )
    active = decisions.active_table(store, machine)
    stderr.print(what, soft_wrap=True)
    stderr.print("active now: " + ("no tables" if active is None else f"version {active.version}"), soft_wrap=True)
    for reason in table.reasons:
        stderr.print(f"  {visible(reason, flat=True)}", soft_wrap=True)
    click.confirm("Make it active?", abort=True, err=True)
    return table.version, 0 if active is None else active.version


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
      volcomp recal reject mill-1 3 --reason "a fixture was loose"
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
      volcomp recal rollback mill-1 --reason "parts out of tolerance since Monday"
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
      volcomp recal adopt mill-1 --reason "store restored from the backup of Sunday"
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
