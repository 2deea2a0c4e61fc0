"""Options that name a file of the user's own control, whose style or empty tables the export follows."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import Command
from compgen.controllers import CONTROLLERS, controller_named
from compgen.core.machine import Machine
from compgen.errors import InputError

HELP = {
    "style_from": "A file punched from your own control; the export follows its style (digits, words, line ends).",
    "template_from": "An empty table saved on your own control; the export fills in its values.",
}


def sample_options(command: Command) -> Command:
    """Add --style-from and --template-from, which stand before what the machine file says. Below machine_argument."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        machine: Machine,
        controller: str | tuple[str, ...],
        style_from: Path | None,
        template_from: Path | None,
        **options: Any,
    ) -> Any:
        names = (controller,) if isinstance(controller, str) else controller
        changed = with_samples(machine, names, {"style_from": style_from, "template_from": template_from})
        return command(*args, machine=changed, controller=controller, **options)

    result: Any = wrapper
    for key, text in HELP.items():
        flag = "--" + key.replace("_", "-")
        result = click.option(flag, key, metavar="FILE", type=click.Path(path_type=Path), help=text)(result)
    return result  # type: ignore[no-any-return]


def with_samples(machine: Machine, controllers: Sequence[str], samples: Mapping[str, Path | None]) -> Machine:
    """Return the machine with each sample file in the settings of the chosen controls that take it.

    Raises InputError for a file that does not exist, and for one that none of the controls takes.
    """
    for key, path in samples.items():
        if path is None:
            continue
        flag = "--" + key.replace("_", "-")
        if not path.is_file():
            raise InputError(f"{flag}: no such file", file=path)
        taking = [name for name in controllers if controller_named(name).sample_setting == key]
        if not taking:
            known = sorted(name for name, control in CONTROLLERS.items() if control.sample_setting == key)
            raise InputError(f"{flag} is for {', '.join(known) or 'no control'}, not for {', '.join(controllers)}")
        for name in taking:
            machine = machine.with_setting(name, key, str(path.resolve()))
    return machine
