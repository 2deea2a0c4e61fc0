"""``volcomp report``."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import click

from compgen.cli.common import json_option, print_json, progress, stdout
from compgen.core.files import OutputFolder
from compgen.errors import CompgenWarning, InputError

if TYPE_CHECKING:
    from compgen.report.html.write import Further


@click.command("report")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--out", metavar="DIR", type=click.Path(path_type=Path), help="Folder for the report; default: DIR itself."
)
@click.option(
    "--dcc",
    "certificate",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Laboratory, customer, persons, dates (TOML): write dcc.xml too; default: DIR/certificate.toml if there.",
)
@click.option(
    "--dcc-schema",
    "schema",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="dcc.xsd of PTB on this disk: write dcc.xml only if it is valid by it.",
)
@json_option
def report_command(folder: Path, out: Path | None, certificate: Path | None, schema: Path | None, as_json: bool) -> int:
    """Make the report of a folder that run, identify, verify or compare wrote, from its files alone.

    Writes report.html (one file, no network; print it to PDF from a browser), report.json (its numbers), dossier.md and
    dossier.json (documentation), calibration.json (results in the order of a calibration certificate), and with --dcc
    dcc.xml (Digital Calibration Certificate). Lengths in mm, errors in um and urad.

    \b
    Example:
      volcomp report tables/ --dcc certificate.toml --dcc-schema dcc.xsd
    """
    from compgen.report.html import write_report
    from compgen.report.html.terminal import short_text

    OutputFolder(out or folder)
    also, said = _certificate(folder, certificate, schema)
    with progress(quiet=as_json) as show:
        show("drawing the report")
        report, paths = write_report(folder, out, also)
    if as_json:
        print_json({**report.data, "paths": [str(path) for path in paths.values()]})
        return 0
    stdout.print(short_text(report.data))
    for path in paths.values():
        stdout.print(f"  {path}", markup=False, soft_wrap=True)
    if said:
        stdout.print(said, markup=False, soft_wrap=True)
    return 0


def _certificate(folder: Path, certificate: Path | None, schema: Path | None) -> tuple[Further | None, str]:
    """What makes dcc.xml, and a word about it; None where no certificate is wanted."""
    beside = folder / "certificate.toml"
    source = certificate or (beside if beside.is_file() else None)
    if source is None:
        if schema is not None:
            raise InputError("--dcc-schema checks a certificate; name its data with --dcc certificate.toml")
        return None, ""
    from compgen.report.dcc import NEWEST, certificate_files, read_certificate, read_schema

    options = read_certificate(source)
    rules = None if schema is None else read_schema(schema)
    said = f"dcc.xml: DCC {NEWEST}, not checked against the schema; --dcc-schema dcc.xsd does that"
    if rules is not None:
        said = f"dcc.xml: DCC {rules.version}, valid by {rules.path}"
    return (lambda data: certificate_files(data, options, rules)), said


def report_beside(folder: Path) -> Path | None:
    """Write the report of a finished command into its folder; a report that fails does not undo the result."""
    from compgen.report.html import write_report

    try:
        return write_report(folder)[1]["report.html"]
    except InputError as error:
        warnings.warn(f"the report could not be made: {error}", CompgenWarning, stacklevel=2)
        return None


COMMANDS = (report_command,)
