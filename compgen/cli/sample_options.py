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
    "style_from": "A file of your own control (may be given several times, e.g. parameters and pitch data): the export follows "
    "its style, and keeps the points and parameters that it shows, those of other axes above all.",
    "template_from": "An empty table saved on your own control; the export fills in its values.",
}


def sample_options(command: Command) -> Command:
    """Add --style-from and --template-from, which stand before what the machine file says. Below machine_argument."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        machine: Machine,
        controller: str | tuple[str, ...],
        style_from: tuple[Path, ...],
        template_from: Path | None,
        **options: Any,
    ) -> Any:
        names = (controller,) if isinstance(controller, str) else controller
        changed = with_samples(machine, names, {"style_from": style_from, "template_from": template_from})
        return command(*args, machine=changed, controller=controller, **options)

    result: Any = wrapper
    for key, text in HELP.items():
        flag, several = "--" + key.replace("_", "-"), key == "style_from"
        kind = click.Path(path_type=Path)
        result = click.option(flag, key, metavar="FILE", type=kind, multiple=several, help=text)(result)
    return result  # type: ignore[no-any-return]


def with_samples(
    machine: Machine, controllers: Sequence[str], samples: Mapping[str, Path | Sequence[Path] | None]
) -> Machine:
    """Return the machine with the sample files in the settings of the chosen controls that take them.

    Raises InputError for a file that does not exist, and for one that none of the controls takes.
    """
    for key, given in samples.items():
        paths = [given] if isinstance(given, Path) else list(given or ())
        if not paths:
            continue
        flag = "--" + key.replace("_", "-")
        for path in paths:
            if not path.is_file():
                raise InputError(f"{flag}: no such file", file=path)
        taking = [name for name in controllers if controller_named(name).sample_setting == key]
        if not taking:
            known = sorted(name for name, control in CONTROLLERS.items() if control.sample_setting == key)
            raise InputError(f"{flag} is for {', '.join(known) or 'no control'}, not for {', '.join(controllers)}")
        for name in taking:
            names = [str(path.resolve()) for path in paths]
            machine = machine.with_setting(name, key, names if len(names) > 1 else names[0])
    return machine
