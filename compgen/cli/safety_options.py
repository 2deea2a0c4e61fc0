"""Options about tables that were active while the machine was measured, and about steps of tables."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import NUMBER, Command
from compgen.core.machine import Machine
from compgen.errors import InputError
from compgen.verify.active import ActiveTables, keeping_others, read_active
from compgen.verify.safety import SafetyLimits

ACTIVE_HELP = (
    "Table file that was active while the machine was measured (may be given several times): its effect is taken out, "
    "and the new table takes its place."
)
STEP_HELP = (
    "No step of the correction between neighbouring table nodes may be larger than this, um; default: 500 um beyond "
    "what the slope of the errors explains."
)


def active_options(*names: str) -> Callable[[Command], Command]:
    """Add --active and --active-controller (and ``names`` for it); the command receives ``active``, tables or None."""

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def wrapper(
            *args: Any, machine: Machine, active: tuple[Path, ...], active_controller: str | None, **options: Any
        ) -> Any:
            target = options.get("controller")
            tables = _active(machine, active, active_controller, target)
            if tables is not None:
                machine = keeping_others(machine, _names(target), tables)
            return command(*args, machine=machine, active=tables, **options)

        kind = click.Path(path_type=Path)
        option = click.option("--active", multiple=True, metavar="FILE", type=kind, help=ACTIVE_HELP)(wrapper)
        text = "Name of the control that the active tables belong to; default: the one that --controller names."
        named = click.option("--active-controller", *names, "active_controller", metavar="NAME", help=text)
        return named(option)  # type: ignore[return-value]

    return decorate


def _names(target: Any) -> list[str]:
    """Names of the controls that are written."""
    return [target] if isinstance(target, str) else list(dict.fromkeys(target or ()))


def _active(machine: Machine, paths: tuple[Path, ...], name: str | None, target: Any) -> ActiveTables | None:
    if not paths:
        if name is not None:
            raise InputError("a control of active tables was named, but no --active FILE was given")
        return None
    targets = _names(target)
    if name is None and len(targets) != 1:
        raise InputError("--active needs the control that the tables belong to: add --active-controller NAME")
    return read_active(machine, paths, name or targets[0])


def limits_option(command: Command) -> Command:
    """Add --max-step-um; the command receives ``limits``."""

    @functools.wraps(command)
    def wrapper(*args: Any, max_step_um: float | None, **options: Any) -> Any:
        if max_step_um is not None and not max_step_um > 0.0:
            raise InputError(f"--max-step-um {max_step_um:g} is given; a number of um above zero is expected")
        return command(*args, limits=SafetyLimits(max_step_um), **options)

    return click.option("--max-step-um", type=NUMBER, help=STEP_HELP)(wrapper)  # type: ignore[return-value]
