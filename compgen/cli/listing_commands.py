"""``compgen controllers`` and ``compgen machines``."""

from __future__ import annotations

from pathlib import Path

import click
from rich import box
from rich.table import Table

from compgen.cli.common import json_option, open_machine, print_json, stdout
from compgen.controllers import CONTROLLERS
from compgen.core.machine import machine_files
from compgen.core.names import AXES
from compgen.export import load_format
from compgen.model import modelled_errors


@click.command("controllers")
@json_option
def controllers_command(as_json: bool) -> int:
    """List the controls that compgen writes, what they can express, and how well their format is documented.

    Nothing is computed; the units of each control's numbers (mm, rad, counts) stand in its preflight.md.

    \b
    Example:
      compgen controllers
    """
    cards = [load_format(name) for name in sorted(CONTROLLERS)]
    if as_json:
        print_json(
            {
                card.name: {
                    "title": card.title,
                    "expresses": card.expresses,
                    "evidence": card.evidence,
                    "unverified": list(card.unverified),
                    "limits": list(card.limits),
                }
                for card in cards
            }
        )
        return 0
    table = Table("name", "control", "what it can express", "format", box=box.SIMPLE)
    for card in cards:
        table.add_row(card.name, card.title, card.expresses, card.evidence)
    stdout.print(table)
    return 0


@click.command("machines")
@click.option("--machines", multiple=True, type=click.Path(path_type=Path), help="Further folder with machine files.")
@json_option
def machines_command(machines: tuple[Path, ...], as_json: bool) -> int:
    """List the machines with their travel (mm): the shipped ones, those in ./machines, and those in --machines folders.

    \b
    Example:
      compgen machines
    """
    local = Path("machines")
    files = machine_files((*((local,) if local.is_dir() else ()), *machines))
    table = Table("name", "chain", "travel X, Y, Z (mm)", "errors", box=box.SIMPLE)
    table.add_column("file", overflow="fold")
    listing = {}
    for name, path in sorted(files.items()):
        machine = open_machine(str(path))
        travel = ", ".join(f"{axis.range_mm[0]:g} ... {axis.range_mm[1]:g}" for axis in machine.axes)
        names = modelled_errors(machine)
        table.add_row(name, machine.chain.name, travel, str(len(names)), str(path))
        ranges = {letter: list(axis.range_mm) for letter, axis in zip(AXES, machine.axes, strict=True)}
        listing[name] = {"chain": machine.chain.name, "range_mm": ranges, "errors": list(names), "file": str(path)}
    if as_json:
        print_json(listing)
    else:
        stdout.print(table)
    return 0


COMMANDS = (controllers_command, machines_command)
