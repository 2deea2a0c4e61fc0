"""``volcomp controllers``, ``machines``, ``effects``, ``instruments``: what is available; ``import``: foreign files."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from compgen.cli.common import PATH, json_option, option_name, options_of
from compgen.cli.output import print_json
from compgen.cli.shared_options import open_machine
from compgen.cli.terminal import answer, say, stdout
from compgen.controls import CONTROLLERS
from compgen.controls.heat_cards import ABOUT as ABOUT_HEAT
from compgen.controls.rotary_parameters import ABOUT as ABOUT_PARAMETERS
from compgen.controls.rotary_pitch import ABOUT as ABOUT_PITCH
from compgen.data.axis_runs import AxisRuns
from compgen.data.deviations import Artefact, Deviations, Part
from compgen.data.error_table import ErrorTable
from compgen.data.files import OutputFolder, read_text
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine, machine_files
from compgen.data.names import AXES, error_named
from compgen.effects import ANY_STATION, FAMILIES, catalogue, listed
from compgen.effects.active import STATION_NAME
from compgen.errors import CompgenWarning, InputError, nearest
from compgen.foreign import ImportOptions, describe_native, import_file, native_format
from compgen.foreign.heads import heads_of, with_head
from compgen.foreign.questions import OpenColumnsError, Question
from compgen.kinematics import modelled_errors
from compgen.plugins import CONTROLS, EFFECT_FAMILIES, SIMULATED_EFFECTS, SIMULATED_INSTRUMENTS
from compgen.registry import Kind
from compgen.report.cards import card_summary, card_text, control_card, effect_card_text
from compgen.tables import Format, load_format

# ``volcomp controllers``, ``machines``, ``effects`` and ``instruments``: what is available.


#: What takes errors of rotary axes, or a model of heat.
ABOUT = {**ABOUT_PARAMETERS, **ABOUT_PITCH, **ABOUT_HEAT}


@click.command("controllers")
@click.argument("name", required=False, metavar="[NAME]")
@json_option
def controllers_command(name: str | None, as_json: bool) -> int:
    """List the controls that compgen writes, what they can express, and how well their format is documented.

    With NAME: the card of one control: what it can express, its settings in the machine file (units in their names: mm,
    um) with defaults, limits, sources, and what no public document settles. Nothing is computed; the units of the
    numbers in its files (mm, rad, counts) are in its preflight.md.

    \b
    Example:
      volcomp controllers siemens-cec
    """
    if name is not None and name in ABOUT:
        about = ABOUT[name]
        answer(
            as_json,
            {"name": name, **about},
            f"{name}: {about['title']}",
            *(f"  {key}: {text}" for key, text in about.items()),
        )
        return 0
    if name is not None:
        shown, origin = control_card(name), CONTROLS.registry.origins.get(name)
        answer(as_json, {**shown.summary(), "plugin": origin}, card_text(shown, origin))
        return 0
    cards = [load_format(known) for known in sorted(CONTROLLERS)]
    if as_json:
        print_json({card.name: _listed(card) for card in cards} | {key: dict(about) for key, about in ABOUT.items()})
        return 0
    table = Table("name", "control", "what it can express", "format", box=box.SIMPLE)
    for card in cards:
        origin = CONTROLS.registry.origins.get(card.name)
        table.add_row(card.name, card.title, card.expresses, f"{card.evidence}{', plug-in' if origin else ''}")
    for key, about in ABOUT.items():
        table.add_row(key, about["title"], about["expresses"], about["evidence"])
    stdout.print(table)
    return 0


def _listed(card: Format) -> dict[str, object]:
    return {
        "title": card.title,
        "expresses": card.expresses,
        "evidence": card.evidence,
        "unverified": list(card.unverified),
        "limits": list(card.limits),
        "plugin": CONTROLS.registry.origins.get(card.name),
    }


@click.command("effects")
@click.argument("name", required=False, metavar="[NAME]")
@json_option
def effects_command(name: str | None, as_json: bool) -> int:
    """List the effects other than the geometric errors: what diagnose looks for, simulate makes, and a machine file may name.

    With NAME: the card of one effect: equation, source, columns that it needs, parameters (units in their names: um,
    urad, ppm), the effects that it can be confused with, and the measurement that separates them. Effects of plug-ins
    are listed too.

    \b
    Example:
      volcomp effects backlash_X
    """
    if name is not None:
        stations = [match.group(1)] if (match := STATION_NAME.fullmatch(name)) else [ANY_STATION]
        effects, origin = catalogue(stations), _effect_origins().get(name)
        if name not in effects:
            raise InputError(f"{name!r} is not an effect; {nearest(name, [*listed(), *SIMULATED_EFFECTS.registry])}")
        card = effects[name].card
        answer(as_json, {"name": name, **card_summary(card), "plugin": origin}, effect_card_text(card, origin))
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
    """Return the plug-in of each effect that comes from one."""
    found: dict[str, str] = {}
    for family, origin in EFFECT_FAMILIES.registry.origins.items():
        found |= {effect.card.name: origin for effect in FAMILIES[family].members((ANY_STATION,))}
    return found


@click.command("instruments")
@json_option
def instruments_command(as_json: bool) -> int:
    """List the instruments that compgen simulates ([instrument] of a scenario, readings in mm).

    \b
    Example:
      volcomp instruments
    """
    rows = _readers(SIMULATED_INSTRUMENTS)
    table = Table("name", "what it is", "from", box=box.SIMPLE)
    for name, row in rows.items():
        table.add_row(name, Text(row["title"] or ""), Text(row["plugin"] or "built in", overflow="fold"))
    answer(as_json, rows, table)
    return 0


def _readers(kind: Kind) -> dict[str, dict[str, str | None]]:
    """Return the first line of the docstring of every reader of a registry, and its plug-in."""
    return {
        name: {"title": (inspect.getdoc(reader) or "").partition("\n")[0], "plugin": kind.registry.origins.get(name)}
        for name, reader in sorted(kind.registry.items())
    }


@click.command("machines")
@click.option("--machines", multiple=True, type=PATH, help="Additional folder with machine files.")
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
            machine = open_machine(str(path), whole=True)
        except InputError as error:  # the others are still listed
            warnings.warn(f"machine file not listed: {error}", CompgenWarning, stacklevel=1)
            continue
        travel = ", ".join(f"{axis.range_mm[0]:g} ... {axis.range_mm[1]:g}" for axis in machine.axes)
        names = modelled_errors(machine)
        table.add_row(name, machine.chain.name, travel, str(len(names)), str(path))
        ranges = {letter: list(axis.range_mm) for letter, axis in zip(AXES, machine.axes, strict=True)}
        listing[name] = {"chain": machine.chain.name, "range_mm": ranges, "errors": list(names), "file": str(path)}
    answer(as_json, listing, table)
    return 0


# ``volcomp import``: what a foreign file contains, and its conversion to the native format.


@click.command("import")
@click.argument("file", type=PATH)
@options_of(ImportOptions, "given")
@click.option("--machine", metavar="MACHINE", help="Check the positions against the travel of this machine.")
@click.option(
    "--machines", multiple=True, type=PATH, help="Additional folder with machine files (may be given several times)."
)
@click.option("--out", metavar="DIR", type=PATH, help="Folder for the native file; without it nothing is written.")
@json_option
def import_command(
    file: Path,
    given: ImportOptions,
    machine: str | None,
    machines: tuple[Path, ...],
    out: Path | None,
    as_json: bool,
) -> int:
    """Show what a measurement or error file of another program contains, and convert it to the native format.

    Renishaw .rtl, .rta, .rts (text) and .rtx (captures), Etalon exchange files, ISO 230-2 .dat files of ecmc, logs of the
    probe programs of volcomp plan, tables as
    text (any separator, decimal comma or point) and Excel workbooks (.xlsx). It shows axis, targets, runs, directions,
    unit, sign, instrument, and what the file leaves open. Deviations are measured minus commanded; units in the written
    file are mm, um and urad. A native file is shown, too, and copied with --out. Nothing is written while a question is
    open: answer it with an option; the exit code is then 2, if --out was given.

    \b
    Example:
      volcomp import x-axis.rtl --machine zha-gantry --out imported/
    """
    target = OutputFolder(out) if out is not None else None
    kind = native_format(file)
    known = None if machine is None else open_machine(machine, machines)
    data: object
    if kind is not None:
        answered = [item for item in fields(given) if getattr(given, item.name)]
        if answered:
            message = f"is already in the native format ({kind}); nothing is converted, so this option has no effect"
            raise InputError(message, file=file, field=option_name(answered[0]))
        understood, data = describe_native(file, kind)
        note = "is already in the native format: the other commands read it directly"
        summary: dict[str, Any] = {"file": str(file), "format": "compgen", "kind": kind, "understood": understood, "doubts": [],
                   "questions": [], "notes": [note]}  # fmt: skip
    else:
        try:
            item = import_file(file, given)
        except OpenColumnsError as error:
            if as_json:
                print_json(open_columns(file, error))
                return 2
            raise
        summary, data = item.summary(), item.data
    against = [] if known is None else outside_travel(known, data)
    named = None if known is None else {"name": known.name, "outside": list(against)}
    summary = {**summary, "machine": named, "files": []}
    if target is not None and not summary["doubts"] and not against:
        if kind is None:
            (head,) = heads_of([file])
            files = {name: with_head(text, head) for name, text in item.files().items()}
        for name, text in {file.name: read_text(file)}.items() if kind is not None else files.items():
            target.add(name, text)
        summary["files"] = [str(path) for path in target.commit().values()]
    if as_json:
        print_json(summary)
    else:
        say(f"{summary['file']}: {summary['format']}, {summary['kind']}")
        for line in _lines(summary["understood"]):
            say(f"  {line}")
        for text in summary["notes"]:
            say(f"note: {_printable(text)}")
        for text in against:
            say(f"outside: {text}", style="red")
        for asked in summary["questions"]:
            say(f"{'open' if asked['required'] else 'not stated'}: {_printable(asked['text'])}", style="yellow")
            for choice in asked["choices"] if any(item["meaning"] for item in asked["choices"]) else ():
                say(f"  {_printable(choice['word'])}  {_printable(choice['meaning'])}")
        for path in summary["files"]:
            say(f"  {path}")
        if summary["doubts"]:
            say("nothing is written while questions are open; answer them with options")
    return 2 if against or (target is not None and summary["doubts"]) else 0


def open_columns(file: Path, error: OpenColumnsError) -> dict[str, Any]:
    """Return the contents of ``--json`` for a table of which the user has to say which column is what."""
    asked = Question(str(error), "columns", (), picture="columns")
    return {
        "file": str(file), "format": "table", "kind": "unknown", "understood": {}, "doubts": [asked.text],
        "questions": [asked.to_dict()], "notes": [], "machine": None, "files": [], "error": str(error), "exit_code": 2,
    }  # fmt: skip


def outside_travel(machine: Machine, data: object) -> list[str]:
    """Return the positions of an imported file that are outside the travel of a machine, one line for each axis."""
    found = []
    for axis, values in _positions(data).items():
        low, high = machine.axes[axis].range_mm
        if len(values) and (values.min() < low - 1e-3 or values.max() > high + 1e-3):
            found.append(
                f"positions of {AXES[axis]} range from {values.min():g} to {values.max():g} mm, but {machine.name} travels from "
                f"{low:g} to {high:g} mm: another unit, zero or axis?"
            )
    return found


def _positions(data: object) -> dict[int, np.ndarray]:
    if isinstance(data, AxisRuns):
        return {axis: data.position_mm[data.axis == axis] for axis in data.axes}
    if isinstance(data, Artefact):
        found = np.where(np.isnan(data.measured_mm), data.nominal_mm, data.measured_mm)
        return {axis: found[:, axis] for axis in range(3)}
    if isinstance(data, Lengths | Deviations | Part):
        return {axis: data.position_mm[:, axis] for axis in range(3)}
    if isinstance(data, ErrorTable):
        ends = [(error_named(name).axis, curve.position_mm) for name, curve in data.curves.items()]
        return {axis: np.concatenate([values for k, values in ends if k == axis]) for axis in {k for k, _ in ends}}
    return {}


def _lines(facts: Mapping[str, Any], depth: int = 0) -> list[str]:
    found = []
    for key, value in facts.items():
        if isinstance(value, Mapping):
            found.append(f"{'  ' * depth}{_printable(key)}:")
            found += _lines(value, depth + 1)
        elif value is not None:
            text = f"{value:.6g}" if isinstance(value, float) else _flat(value)
            found.append(f"{'  ' * depth}{_printable(key)}: {text}")
    return found


def _flat(value: Any) -> str:
    if isinstance(value, list | tuple):
        return _printable(", ".join(f"{item:g}" if isinstance(item, float) else str(item) for item in value))
    return _printable(value)


def _printable(value: Any) -> str:
    """Return text of a user's file on one line, in its own script, without control characters."""
    return "".join(char if char.isprintable() else "?" for char in " ".join(str(value).split()))
