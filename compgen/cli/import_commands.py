"""``volcomp import``: what a foreign file holds, before anything is computed, and its contract file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from compgen.cli.common import json_option, open_machine, print_json, stdout
from compgen.core.axis_runs import AxisRuns
from compgen.core.deviations import Deviations
from compgen.core.error_table import ErrorTable
from compgen.core.files import OutputFolder, read_text
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import AXES, error_named
from compgen.errors import InputError
from compgen.imports import ImportOptions, describe_own, import_file, own_kind
from compgen.imports.result import KINDS

_HELP = {
    "kind": "What the file holds; default: told by its columns.",
    "map": "FIELD=COLUMN: position, actual, deviation, correction, direction, run, axis; x, y, z, length, station, point; "
    "dx, dy, dz, xa, ya, za; error, value; temperature, temp_NAME, time, date, feed, load, tool_x, approach_x, repeat, line, "
    "block, setup, pose, u_value; run1+, run1-, run2 (a column of one run). May be given several times.",
    "unit": "FIELD=UNIT, e.g. deviation=um, position=mm, or UNIT alone for the values; linear=, angle= of "
    "errors. um, mm, nm, m, in; urad, mrad, arcsec, "
    "rad, deg; temp_NAME=degC, K, degF; time=s, ms, min, h; feed=mm/min; load=kg.",
    "axis": "The axis that moved.",
    "error": "The error that the values are (EYX, ECX, ...), for straightness and angles.",
    "sign": "error: measured minus commanded (default where the format says so); correction: to be turned round.",
    "directions": "labels: as the file names them; motion: from the order of the rows; alternate: odd runs up, even down.",
    "sheet": "Sheet of a workbook.",
    "dates": "Order of dates such as 03/04/2025 (never guessed): day, month, year.",
    "decimal": "Decimal mark of a table; the other one parts thousands (asked for where 1,000 may be either).",
    "zero_runs": "Laser runs that are zero at every target: not made (drop) or measured (keep).",
    "ignore": "Column, or sheet of a workbook, that is left out though it holds numbers (may be given several times).",
    "machine": "Machine whose travel the positions are held against.",
    "machines": "Further folder with machine files (may be given several times).",
    "out": "Folder for the contract file; without it nothing is written.",
}


def _pairs(given: Sequence[str], option: str, alone: str | None = None) -> dict[str, str]:
    found: dict[str, str] = {}
    for text in given:
        key, equals, value = (part.strip() for part in text.partition("="))
        if alone and not equals:
            key, value = alone, key
        if not key or not value:
            raise InputError(f"{text!r} is not of the form FIELD=NAME", field=option)
        if key in found:
            raise InputError(f"{key} is given twice; give it once", field=option)
        found[key] = value
    return found


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--kind", type=click.Choice(KINDS), help=_HELP["kind"])
@click.option("--map", "mapping", metavar="FIELD=COLUMN", multiple=True, help=_HELP["map"])
@click.option("--unit", "units", metavar="[FIELD=]UNIT", multiple=True, help=_HELP["unit"])
@click.option("--axis", type=click.Choice(AXES, case_sensitive=False), help=_HELP["axis"])
@click.option("--error", metavar="NAME", help=_HELP["error"])
@click.option("--sign", type=click.Choice(("error", "correction")), help=_HELP["sign"])
@click.option("--directions", type=click.Choice(("labels", "motion", "alternate")), help=_HELP["directions"])
@click.option("--sheet", metavar="NAME", help=_HELP["sheet"])
@click.option("--dates", type=click.Choice(("dmy", "mdy", "ymd")), help=_HELP["dates"])
@click.option("--decimal", type=click.Choice(("comma", "point")), help=_HELP["decimal"])
@click.option("--zero-runs", type=click.Choice(("drop", "keep")), help=_HELP["zero_runs"])
@click.option("--ignore", metavar="NAME", multiple=True, help=_HELP["ignore"])
@click.option("--machine", metavar="MACHINE", help=_HELP["machine"])
@click.option("--machines", multiple=True, type=click.Path(path_type=Path), help=_HELP["machines"])
@click.option("--out", metavar="DIR", type=click.Path(path_type=Path), help=_HELP["out"])
@json_option
def import_command(
    file: Path,
    mapping: tuple[str, ...],
    units: tuple[str, ...],
    machine: str | None,
    machines: tuple[Path, ...],
    out: Path | None,
    as_json: bool,
    **said: Any,
) -> int:
    """Show what a measurement or error file of another program holds, and write it as a contract file.

    Renishaw .rtl, .rta, .rts (text) and .rtx (captures), Etalon exchange files, ISO 230-2 .dat files of ecmc, tables as
    text (any separator, decimal comma or point) and Excel workbooks (.xlsx). Shown are axis, targets, runs,
    directions, unit, sign, instrument, and what the file leaves open. Deviations are measured minus commanded; units in
    the written file are mm, um and urad. A file of compgen's own format is shown as well, and copied with --out. Nothing is
    written while something is open: say it by an option. Exit code 2 then, if --out was given.

    \b
    Example:
      volcomp import x-axis.rtl --machine zha-gantry --out imported/
    """
    target = OutputFolder(out) if out is not None else None
    kind = own_kind(file)
    known = None if machine is None else open_machine(machine, machines)
    data: object
    if kind is not None:
        given = [key for key, value in {"map": mapping, "unit": units, **said}.items() if value]
        if given:
            message = f"is a file of compgen's own format ({kind}): it says what it holds, and nothing is converted"
            raise InputError(message, file=file, field=f"--{given[0].replace('_', '-')}")
        understood, data = describe_own(file, kind)
        note = "is a file of compgen's own format: the other commands take it as it is"
        summary: dict[str, Any] = {"file": str(file), "format": "compgen", "kind": kind, "understood": understood, "doubts": [],
                   "notes": [note]}  # fmt: skip
    else:
        options = ImportOptions(columns=_pairs(mapping, "--map"), units=_pairs(units, "--unit", "value"), **said)
        item = import_file(file, options)
        summary, data = item.summary(), item.data
    against = [] if known is None else outside_travel(known, data)
    summary = {**summary, "machine": _machine_summary(known, against), "files": []}
    if target is not None and not summary["doubts"] and not against:
        for name, text in {file.name: read_text(file)}.items() if kind is not None else item.files().items():
            target.add(name, text)
        summary["files"] = [str(path) for path in target.commit().values()]
    if as_json:
        print_json(summary)
    else:
        _show(summary)
    return 2 if against or (target is not None and summary["doubts"]) else 0


def _machine_summary(machine: Machine | None, against: Sequence[str]) -> dict[str, Any] | None:
    return None if machine is None else {"name": machine.name, "outside": list(against)}


def outside_travel(machine: Machine, data: object) -> list[str]:
    """Say which positions of an imported file lie outside the travel of a machine, one line for each axis."""
    found = []
    for axis, values in _positions(data).items():
        low, high = machine.axes[axis].range_mm
        if len(values) and (values.min() < low - 1e-3 or values.max() > high + 1e-3):
            found.append(
                f"positions of {AXES[axis]} go from {values.min():g} to {values.max():g} mm, the travel of {machine.name} from "
                f"{low:g} to {high:g} mm: another unit, zero or axis?"
            )
    return found


def _positions(data: object) -> dict[int, np.ndarray]:
    if isinstance(data, AxisRuns):
        return {axis: data.position_mm[data.axis == axis] for axis in data.axes}
    if isinstance(data, Lengths | Deviations):
        return {axis: data.position_mm[:, axis] for axis in range(3)}
    if isinstance(data, ErrorTable):
        ends = [(error_named(name).axis, curve.position_mm) for name, curve in data.curves.items()]
        return {axis: np.concatenate([values for k, values in ends if k == axis]) for axis in {k for k, _ in ends}}
    return {}


def _show(summary: Mapping[str, Any]) -> None:
    stdout.print(f"{summary['file']}: {summary['format']}, {summary['kind']}", soft_wrap=True)
    for line in _lines(summary["understood"]):
        stdout.print(f"  {line}", soft_wrap=True)
    for text in summary["notes"]:
        stdout.print(f"note: {_printable(text)}", soft_wrap=True)
    for text in (summary["machine"] or {}).get("outside", []):
        stdout.print(f"outside: {text}", style="red", soft_wrap=True)
    for text in summary["doubts"]:
        stdout.print(f"open: {_printable(text)}", style="yellow", soft_wrap=True)
    for path in summary["files"]:
        stdout.print(f"  {path}", soft_wrap=True)
    if summary["doubts"]:
        stdout.print("nothing is written until what is open has been said", soft_wrap=True)


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
    """Return text of a user's file on one line, in its own script, without what steers a terminal."""
    return "".join(char if char.isprintable() else "?" for char in " ".join(str(value).split()))


COMMANDS = (import_command,)
