"""``volcomp options``, and what ``--explain`` of export and run writes."""

from __future__ import annotations

import json
from pathlib import Path

import click

from compgen.cli.common import Command, json_option, machine_argument, print_json, progress, stdout
from compgen.core.emphasis import zone_of
from compgen.core.files import OutputFolder
from compgen.core.machine import Machine
from compgen.core.reversal import read_reversal
from compgen.effects import effects_reversal
from compgen.errors import InputError
from compgen.imports import open_errors
from compgen.pipeline import RunResult, identified_reversal, write_all
from compgen.report.explain_text import explanation_markdown
from compgen.report.options_text import options_markdown, options_tables
from compgen.verify.capability import capability
from compgen.verify.explain import explain

TOOL_HELP = (
    "Tool offset X,Y,Z in mm to look at beside the machine's own; may be given several times. Default: 0, -100 and -200 mm "
    "along Z."
)
ZONE_HELP = "The part of the travel that matters, mm, e.g. X=-400:0,Y=100:300; default: all."
REVERSAL_HELP = "*.reversal.csv (um): what each axis does differently in its two directions."
EXPLAIN_HELP = (
    "Write explain.md: what the table corrects, what stays and why, what the next option would buy, limits used."
)


def explain_option(command: Command) -> Command:
    """Add --explain."""
    return click.option("--explain", is_flag=True, help=EXPLAIN_HELP)(command)


def explain_run(machine: Machine, result: RunResult, out: Path, templates: Path | None) -> None:
    """Write explain.md beside the tables of every control of a run."""
    reversal = identified_reversal(result.identification)
    several = len(result.results) > 1
    files: dict[str, str | bytes] = {}
    for item in result.results:
        found = explain(machine, result.fitted.errors, item.export, reversal=reversal, templates=templates)
        folder = f"{item.export.controller}/" if several else ""
        files[f"{folder}explain.md"] = explanation_markdown(found)
    write_all(out, files)


def _tool(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--tool: {text!r} is not a tool offset; three numbers X,Y,Z in mm are expected") from None
    if not all(abs(part) < 1e5 for part in (x, y, z)):
        raise InputError(f"--tool: {text!r} is no tool offset in mm")
    return x, y, z


@click.command("options")
@machine_argument
@click.argument("errors", type=click.Path(path_type=Path))
@click.option("--tool", "tools", multiple=True, metavar="X,Y,Z", help=TOOL_HELP)
@click.option("--zone", metavar="RANGES", help=ZONE_HELP)
@click.option("--reversal", metavar="FILE", type=click.Path(path_type=Path), help=REVERSAL_HELP)
@click.option("--templates", type=click.Path(path_type=Path), help="Folder of your own templates, searched first.")
@click.option("--out", metavar="DIR", type=click.Path(path_type=Path), help="Folder for options.json and options.md.")
@json_option
def options_command(
    machine: Machine,
    errors: Path,
    tools: tuple[str, ...],
    zone: str | None,
    reversal: Path | None,
    templates: Path | None,
    out: Path | None,
    as_json: bool,
) -> int:
    """Show what each option of a control would buy: the error that remains by level, and by control.

    ERRORS is an *.errors.csv file (um, urad). Levels: no table; positioning; + straightness; + squareness; + products of
    tables; full volumetric; + direction-dependent (with --reversal). Beside them the file of every control, exported and
    read back, and which errors stay with tools of other lengths. Figures in um; DIR gets options.json and options.md.

    \b
    Example:
      volcomp options zha-gantry identified/identified.errors.csv --tool 0,0,-150
    """
    if out is not None:
        OutputFolder(out)
    with progress(quiet=as_json) as show:
        show("fitting every level, exporting for every control and reading back")
        result = capability(
            machine,
            open_errors(errors),
            tools_mm=[_tool(text) for text in tools],
            zone_mm=zone_of(zone, [axis.range_mm for axis in machine.axes]) if zone else None,
            reversal=read_reversal(reversal) if reversal else effects_reversal(machine),
            templates=templates,
        )
    if out is not None:
        text = json.dumps(result.as_dict(), indent=2) + "\n"
        write_all(out, {"options.json": text, "options.md": options_markdown(result)})
    if as_json:
        print_json(result.as_dict())
    else:
        stdout.print(options_tables(result))
    return 0


COMMANDS = (options_command,)
