"""``volcomp controllers``, ``machines``, ``effects`` and ``instruments``: what is there."""

from __future__ import annotations

import inspect
import warnings
from pathlib import Path

import click
from rich import box
from rich.table import Table
from rich.text import Text

from compgen.cli.common import json_option, open_machine, print_json, stdout
from compgen.controllers import CONTROLLERS
from compgen.core.machine import machine_files
from compgen.core.names import AXES
from compgen.core.plugins import Kind
from compgen.core.text import nearest
from compgen.effects import ANY_STATION, FAMILIES, catalogue, listed
from compgen.effects.of_machine import STATION_NAME
from compgen.errors import CompgenWarning, InputError
from compgen.export import Format, load_format
from compgen.export.card import control_card
from compgen.model import modelled_errors
from compgen.plugins import CONTROLS, EFFECT_FAMILIES, SIMULATED_EFFECTS, SIMULATED_INSTRUMENTS
from compgen.report.card_text import card_text
from compgen.report.effects_text import card_summary, effect_card_text


@click.command("controllers")
@click.argument("name", required=False, metavar="[NAME]")
@json_option
def controllers_command(name: str | None, as_json: bool) -> int:
    """List the controls that compgen writes, what they can express, and how well their format is documented.

    With NAME: the card of one control: what it can express, the settings of the machine file (units in their names:
    mm, um) with defaults, limits, sources, and what no public document settles. Nothing is computed; the units of each
    control's numbers (mm, rad, counts) stand in its preflight.md.

    \b
    Example:
      volcomp controllers siemens-cec
    """
    if name is not None:
        _show_card(name, as_json)
        return 0
    cards = [load_format(known) for known in sorted(CONTROLLERS)]
    if as_json:
        print_json({card.name: _listed(card) for card in cards})
        return 0
    table = Table("name", "control", "what it can express", "format", box=box.SIMPLE)
    for card in cards:
        origin = CONTROLS.origins.get(card.name)
        table.add_row(card.name, card.title, card.expresses, f"{card.evidence}{', plug-in' if origin else ''}")
    stdout.print(table)
    return 0


def _show_card(name: str, as_json: bool) -> None:
    card, origin = control_card(name), CONTROLS.origins.get(name)
    if as_json:
        print_json({**card.summary(), "plugin": origin})
    else:
        stdout.print(card_text(card, origin))


def _listed(card: Format) -> dict[str, object]:
    return {
        "title": card.title,
        "expresses": card.expresses,
        "evidence": card.evidence,
        "unverified": list(card.unverified),
        "limits": list(card.limits),
        "plugin": CONTROLS.origins.get(card.name),
    }


@click.command("effects")
@click.argument("name", required=False, metavar="[NAME]")
@json_option
def effects_command(name: str | None, as_json: bool) -> int:
    """List the effects beside the geometric errors: what diagnose looks for, simulate makes, and a machine file may name.

    With NAME: the card of one effect: equation, source, columns that it needs, parameters (units in their names: um, urad,
    ppm), what data may confuse it with, and the measurement that separates them. Effects of plug-ins are listed too.

    \b
    Example:
      volcomp effects backlash_X
    """
    if name is not None:
        _show_effect(name, as_json)
        return 0
    origins = _effect_origins()
    readers = _readers(SIMULATED_EFFECTS)
    if as_json:
        cards = {
            known: {**card_summary(effect.card), "plugin": origins.get(known)} for known, effect in listed().items()
        }
        print_json({**cards, **readers})
        return 0
    table = Table("name", "equation", "columns", "resembles", box=box.SIMPLE)
    for known, effect in listed().items():
        card = effect.card
        cells = (known, card.equation, ", ".join(card.covariates), ", ".join(card.aliases))
        table.add_row(*(Text(cell, overflow="fold") for cell in cells))
    for reader, row in readers.items():
        table.add_row(reader, Text(row["title"] or ""), "", f"simulated only; {row['plugin'] or 'built in'}")
    stdout.print(table)
    return 0


def _effect_origins() -> dict[str, str]:
    """Plug-in of each effect that comes from one."""
    found: dict[str, str] = {}
    for family, origin in EFFECT_FAMILIES.origins.items():
        found |= {effect.card.name: origin for effect in FAMILIES[family].members((ANY_STATION,))}
    return found


def _show_effect(name: str, as_json: bool) -> None:
    stations = [match.group(1)] if (match := STATION_NAME.fullmatch(name)) else [ANY_STATION]
    known, origin = catalogue(stations), _effect_origins().get(name)
    if name not in known:
        raise InputError(f"{name!r} is no effect; {nearest(name, [*listed(), *SIMULATED_EFFECTS.registry])}")
    if as_json:
        print_json({"name": name, **card_summary(known[name].card), "plugin": origin})
    else:
        stdout.print(effect_card_text(known[name].card, origin), markup=False, highlight=False, soft_wrap=True)


@click.command("instruments")
@json_option
def instruments_command(as_json: bool) -> int:
    """List the instruments that compgen simulates ([instrument] of a scenario, readings in mm).

    \b
    Example:
      volcomp instruments
    """
    return _list_readers(SIMULATED_INSTRUMENTS, as_json)


def _list_readers(kind: Kind, as_json: bool) -> int:
    """Print what a registry of readers holds: the first line of each docstring, and the plug-in that it came from."""
    rows = _readers(kind)
    if as_json:
        print_json(rows)
        return 0
    table = Table("name", "what it is", "from", box=box.SIMPLE)
    for name, row in rows.items():
        table.add_row(name, Text(row["title"] or ""), Text(row["plugin"] or "built in", overflow="fold"))
    stdout.print(table if rows else f"no {kind.word} is built in; --plugin PATH adds some")
    return 0


def _readers(kind: Kind) -> dict[str, dict[str, str | None]]:
    """First line of the docstring of every reader of a registry, and the plug-in that it came from."""
    return {
        name: {"title": (inspect.getdoc(reader) or "").partition("\n")[0], "plugin": kind.origins.get(name)}
        for name, reader in sorted(kind.registry.items())
    }


@click.command("machines")
@click.option("--machines", multiple=True, type=click.Path(path_type=Path), help="Further folder with machine files.")
@json_option
def machines_command(machines: tuple[Path, ...], as_json: bool) -> int:
    """List the machines with their travel (mm): the shipped ones, those in ./machines, and those in --machines folders.

    \b
    Example:
      volcomp machines
    """
    local = Path("machines")
    files = machine_files((*((local,) if local.is_dir() else ()), *machines))
    table = Table("name", "chain", "travel X, Y, Z (mm)", "errors", box=box.SIMPLE)
    table.add_column("file", overflow="fold")
    listing = {}
    for name, path in sorted(files.items()):
        try:
            machine = open_machine(str(path))
        except InputError as error:  # the others are listed all the same
            warnings.warn(f"left out of the machines: {error}", CompgenWarning, stacklevel=1)
            continue
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


COMMANDS = (controllers_command, machines_command, effects_command, instruments_command)
