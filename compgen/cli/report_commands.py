"""``compgen report``."""

from __future__ import annotations

import warnings
from pathlib import Path

import click

from compgen.cli.common import json_option, print_json, progress, stdout
from compgen.core.files import OutputFolder
from compgen.errors import CompgenWarning, InputError


@click.command("report")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--out", metavar="DIR", type=click.Path(path_type=Path), help="Folder for the report; default: DIR itself."
)
@json_option
def report_command(folder: Path, out: Path | None, as_json: bool) -> int:
    """Make the report of a folder that run, identify, verify or compare wrote, from its files alone.

    Writes report.html (one file, no network; print it to PDF from a browser), report.json (its numbers), dossier.md and
    dossier.json (documentation), calibration.json (results in the order of a calibration certificate). Lengths in mm,
    errors in um and urad.

    \b
    Example:
      compgen report tables/
    """
    from compgen.report.html import write_report
    from compgen.report.html.terminal import short_text

    OutputFolder(out or folder)
    with progress(quiet=as_json) as show:
        show("drawing the report")
        report, paths = write_report(folder, out)
    if as_json:
        print_json({**report.data, "paths": [str(path) for path in paths.values()]})
    else:
        stdout.print(short_text(report.data))
        for path in paths.values():
            stdout.print(f"  {path}", markup=False, soft_wrap=True)
    return 0


def report_beside(folder: Path) -> Path | None:
    """Write the report of a finished command into its folder; a report that fails does not undo the result."""
    from compgen.report.html import write_report

    try:
        return write_report(folder)[1]["report.html"]
    except InputError as error:
        warnings.warn(f"the report could not be made: {error}", CompgenWarning, stacklevel=2)
        return None


COMMANDS = (report_command,)
