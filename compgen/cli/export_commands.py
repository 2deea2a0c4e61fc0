"""``volcomp export``, ``volcomp read`` and ``volcomp verify``."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import click

from compgen.cli.common import (
    Command,
    controller_option,
    json_option,
    machine_argument,
    out_option,
    print_json,
    stderr,
    stdout,
)
from compgen.cli.emphasis_options import emphasis_options
from compgen.cli.fit_options import covariance_of
from compgen.cli.options_commands import explain_option
from compgen.cli.safety_options import active_options, limits_option
from compgen.cli.sample_options import sample_options
from compgen.core.error_table import format_errors
from compgen.core.files import OutputFolder, write_file
from compgen.core.machine import Machine
from compgen.core.points import format_points, read_points
from compgen.core.reversal import read_reversal
from compgen.effects import effects_reversal
from compgen.errors import CompgenWarning
from compgen.export import REJECTED_PREFIX, export
from compgen.imports import open_errors
from compgen.pipeline import provenance_of, verified_export, write_all
from compgen.report.explain_text import explanation_markdown
from compgen.report.text import verification_table
from compgen.verify import read_tables, residuals, verify
from compgen.verify.active import ActiveTables, bare_errors
from compgen.verify.check_program import check_files
from compgen.verify.evidence import verification_files
from compgen.verify.explain import explain as explained
from compgen.verify.safety import SafetyLimits

REVERSAL_HELP = (
    "*.reversal.csv (um): what each axis does differently in its two directions; becomes tables of one direction "
    "(default: backlash and lost motion of the machine file)."
)


def reversal_option(command: Command) -> Command:
    """Add --reversal FILE."""
    kind = click.Path(path_type=Path)
    return click.option("--reversal", metavar="FILE", type=kind, help=REVERSAL_HELP)(command)


@click.command("export")
@machine_argument
@emphasis_options
@click.argument("errors", type=click.Path(path_type=Path))
@controller_option()
@sample_options
@out_option
@click.option("--templates", type=click.Path(path_type=Path), help="Folder of your own templates, searched first.")
@click.option("--allow-unverified", is_flag=True, help="Export formats that no public document fully describes.")
@reversal_option
@active_options()
@explain_option
@click.option("--no-verify", is_flag=True, help="Do not read the files back and verify them.")
@json_option
def export_command(
    machine: Machine,
    errors: Path,
    controller: str,
    out: Path,
    templates: Path | None,
    allow_unverified: bool,
    reversal: Path | None,
    active: ActiveTables | None,
    explain: bool,
    no_verify: bool,
    as_json: bool,
) -> int:
    """Export errors to the files of a control, with manifest.json and preflight.md.

    ERRORS is an *.errors.csv file (um, urad), usually the fitted one, or the exchange file of a laser tracer's software
    (Etalon, variant Vendor; mm, rad). The files are read back and verified against ERRORS as `verify` does it, with
    result.json and volume.csv beside them. Files that are not acceptable, or break a limit of the control, are
    written as NOT-ACCEPTED-... (exit code 1). check/check-program.md says what to read at five positions of the machine.
    With --active ERRORS are those of the machine with its old tables; bare.errors.csv gets those without.

    \b
    Example:
      volcomp export zha-gantry fitted/fitted.errors.csv --controller siemens-cec --out tables/
    """
    OutputFolder(out)
    table, beside = open_errors(errors), {}
    both = read_reversal(reversal) if reversal else effects_reversal(machine)
    if active is not None:
        table, lost_um = bare_errors(machine, table, active)
        beside["bare.errors.csv"] = format_errors(table, {"active_tables_removed": active.names, "lost_um": lost_um})
    exported = export(
        machine,
        table,
        controller,
        templates=templates,
        allow_unverified=allow_unverified,
        provenance=provenance_of(machine.source, errors, reversal, *(active.paths if active else ())),
        reversal=both,
    )
    beside |= check_files(machine, exported, table, templates, both)
    explanation = explained(machine, table, exported, reversal=both, templates=templates) if explain else None
    if explanation is not None:
        beside["explain.md"] = explanation_markdown(explanation)
    reasons: tuple[str, ...] = tuple(exported.violations)
    if not no_verify:
        verification = verified_export(machine, exported, table, both)
        reasons = verification.reasons
        prefix = REJECTED_PREFIX if reasons else ""
        named = tuple((prefix + name, digest) for name, digest in verification.files)
        beside |= verification_files(replace(verification, files=named))
    paths = exported.write(out, accepted=not reasons, beside=beside)
    for text in exported.warnings:
        stderr.print(f"warning: {text}", style="yellow", markup=False, soft_wrap=True)
    for text in reasons:
        stderr.print(f"not acceptable: {text}", style="red", markup=False, soft_wrap=True)
    if as_json:
        own = {
            "accepted": not reasons,
            "verified": not no_verify,
            "reasons": list(reasons),
            "paths": [str(path) for path in paths],
        }
        print_json({**exported.manifest, **own, **({"explain": explanation.as_dict()} if explanation else {})})
    else:
        if explanation is not None:
            stdout.print(beside["explain.md"], markup=False, soft_wrap=True)
        for path in paths:
            stdout.print(f"  {path}", markup=False, soft_wrap=True)
    return 1 if reasons else 0


@click.command("read")
@machine_argument
@click.argument("tables", nargs=-1, required=True, type=click.Path(path_type=Path))
@controller_option()
@sample_options
@click.option("--points", required=True, type=click.Path(path_type=Path), help="*.points.csv (mm).")
@click.option("--out", required=True, metavar="FILE", type=click.Path(path_type=Path), help="CSV file for the result.")
@json_option
def read_command(
    machine: Machine, tables: tuple[Path, ...], controller: str, points: Path, out: Path, as_json: bool
) -> int:
    """Read controller files, emulate the control, and write the correction at each point.

    FILE gets the points plus cx_um, cy_um, cz_um: what the control adds to the command.

    \b
    Example:
      volcomp read zha-gantry tables/volcomp0.csv --controller isg-csv --points p.points.csv --out correction.csv
    """
    where = read_points(points)
    parsed = read_tables(machine, tables, controller, foreign=True)
    for text in parsed.contradictions:
        warnings.warn(text, CompgenWarning, stacklevel=1)
    correction_mm = parsed.correction(machine, where)
    columns = {f"c{axis}_um": correction_mm[:, k] * 1e3 for k, axis in enumerate("xyz")}
    write_file(out, format_points(where, columns, {"machine": machine.name, "controller": controller}))
    figures = residuals(correction_mm)
    if as_json:
        said = {"controller": controller, "remarks": list(parsed.remarks)}
        print_json({"points": len(where), **said, **figures.as_dict(), "file": str(out)})
    else:
        for remark in parsed.remarks:
            stdout.print(remark, markup=False, soft_wrap=True)
        text = f"{len(where)} points: correction max {figures.max_um:.2f} um, rms {figures.rms_um:.2f} um -> {out}"
        stdout.print(text, markup=False, soft_wrap=True)
    return 0


@click.command("verify")
@machine_argument
@emphasis_options
@click.argument("tables", nargs=-1, required=True, type=click.Path(path_type=Path))
@controller_option()
@sample_options
@click.option(
    "--errors",
    required=True,
    type=click.Path(path_type=Path),
    help="*.errors.csv of the machine (um, urad), or an Etalon exchange file (mm, rad).",
)
@click.option("--points", type=click.Path(path_type=Path), help="*.points.csv (mm); default: a grid over the volume.")
@out_option
@reversal_option
@limits_option
@json_option
def verify_command(
    machine: Machine,
    tables: tuple[Path, ...],
    controller: str,
    errors: Path,
    points: Path | None,
    out: Path,
    reversal: Path | None,
    limits: SafetyLimits,
    as_json: bool,
) -> int:
    """Verify controller files against the errors of the machine: the exact model before, and after the tables act.

    Writes result.json and volume.csv to DIR. Exit code 1 if the tables are not acceptable, with the reasons.

    \b
    Example:
      volcomp verify zha-gantry tables/volcomp0.csv --controller isg-csv --errors identified.errors.csv --out check/
    """
    OutputFolder(out)
    where = read_points(points) if points else None
    both = read_reversal(reversal) if reversal else effects_reversal(machine)
    parsed, table = read_tables(machine, tables, controller), open_errors(errors)
    known = covariance_of(errors, table, None, independent=False)
    result = verify(machine, parsed, table, where, reversal=both, limits=limits, covariance=known)
    write_all(out, verification_files(result))
    if as_json:
        print_json(result.summary())
    else:
        stdout.print(verification_table([result]))
    return 0 if result.accepted else 1


COMMANDS = (export_command, read_command, verify_command)
