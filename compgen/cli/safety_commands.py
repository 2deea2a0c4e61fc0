"""``volcomp diff``, ``volcomp merge`` and ``volcomp crash-test``."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import (
    NUMBER,
    controller_option,
    json_option,
    machine_argument,
    out_option,
    print_json,
    progress,
    stderr,
    stdout,
)
from compgen.cli.safety_options import limits_option
from compgen.cli.sample_options import sample_options
from compgen.controllers import CONTROLLERS
from compgen.core.csvio import FloatArray
from compgen.core.error_table import format_errors
from compgen.core.files import OutputFolder
from compgen.core.machine import Machine
from compgen.core.points import Points, format_points, read_points
from compgen.errors import CompgenWarning, InputError
from compgen.export import Provenance
from compgen.imports import open_errors
from compgen.pipeline import export_and_verify, provenance_of, write_all
from compgen.report.safety_text import crash_table, difference_table, merge_text
from compgen.report.text import verification_table
from compgen.verify import read_tables
from compgen.verify.active import keeping_others, read_active
from compgen.verify.crash_test import ENTRIES, CrashTest, crash_test
from compgen.verify.diff import TableDifference, difference
from compgen.verify.merge import merge_report, merged_errors
from compgen.verify.safety import SafetyLimits


class ManyAgainst(click.Command):
    """A command whose option --against takes all words up to the next option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Write ``--against B1 B2`` as ``--against B1 --against B2``."""
        words: list[str] = []
        inside = False
        for word in args:
            if word.startswith("-"):
                inside = word == "--against"
            elif inside and words[-1] != "--against":
                words.append("--against")
            words.append(word)
        return super().parse_args(ctx, words)


@click.command("diff", cls=ManyAgainst)
@machine_argument
@click.argument("tables", nargs=-1, required=True, metavar="A...", type=click.Path(path_type=Path))
@click.option("--against", multiple=True, required=True, metavar="B...", type=click.Path(path_type=Path), help="Set B.")
@controller_option()
@sample_options
@click.option("--controller-b", metavar="NAME", help="Control of set B; default: that of A.")
@click.option("--points", type=click.Path(path_type=Path), help="*.points.csv (mm); default: a grid over the volume.")
@click.option("--fail-above", type=NUMBER, metavar="UM", help="Exit code 1 if the largest difference exceeds UM um.")
@out_option
@json_option
def diff_command(
    machine: Machine,
    tables: tuple[Path, ...],
    against: tuple[Path, ...],
    controller: str,
    controller_b: str | None,
    points: Path | None,
    fail_above: float | None,
    out: Path,
    as_json: bool,
) -> int:
    """Compare two sets of tables by what they do: A minus B at the tool, in um, over the volume.

    Writes diff.json and difference.csv (both corrections and their difference at each point) to DIR. Text that differs
    without changing a correction is no difference. Exit code 0, also if they differ, unless --fail-above says otherwise.

    \b
    Example:
      volcomp diff zha-gantry new/NC_CEC.INI --against old/NC_CEC.INI --controller siemens-cec --out diff/
    """
    OutputFolder(out)
    first = read_tables(machine, tables, controller, foreign=True)
    second = read_tables(machine, against, controller_b or controller, foreign=True)
    for remark in (*first.remarks, *second.remarks):
        warnings.warn(remark, CompgenWarning, stacklevel=1)
    result = difference(machine, first, second, read_points(points) if points else None)
    data = {**result.summary(), "remarks_a": list(first.remarks), "remarks_b": list(second.remarks)}
    files = {"diff.json": json.dumps(data, indent=2) + "\n", "difference.csv": _difference_csv(machine, result)}
    write_all(out, files)
    if as_json:
        print_json(data)
    else:
        stdout.print(difference_table(result))
    return 1 if fail_above is not None and result.max_um > fail_above else 0


def _difference_csv(machine: Machine, result: TableDifference) -> str:
    columns: dict[str, FloatArray] = {}
    for prefix, values in (("a", result.first_mm), ("b", result.second_mm), ("d", result.difference_mm)):
        columns |= {f"{prefix}{axis}_um": values[:, k] * 1e3 for k, axis in enumerate("xyz")}
    return format_points(Points(result.position_mm), columns, {"machine": machine.name})


@click.command("merge")
@machine_argument
@click.argument("old", nargs=-1, required=True, metavar="OLD...", type=click.Path(path_type=Path))
@controller_option()
@sample_options
@click.option("--controller-old", metavar="NAME", help="Control of the old tables; default: that of the new.")
@click.option(
    "--errors",
    required=True,
    type=click.Path(path_type=Path),
    help="*.errors.csv (um, urad) measured while the old tables were active, without --active.",
)
@out_option
@click.option("--templates", type=click.Path(path_type=Path), help="Folder of your own templates, searched first.")
@limits_option
@json_option
def merge_command(
    machine: Machine,
    old: tuple[Path, ...],
    controller: str,
    controller_old: str | None,
    errors: Path,
    out: Path,
    templates: Path | None,
    limits: SafetyLimits,
    as_json: bool,
) -> int:
    """Merge old tables and new errors to one set of tables: what was active and what is left, together.

    Writes the controller files, manifest.json, preflight.md, result.json, the check program, merge.json and
    merged.errors.csv (the errors of the machine without tables) to DIR. Exit code 1 if the tables are not acceptable.

    \b
    Example:
      volcomp merge zha-gantry old/NC_CEC.INI --controller siemens-cec --errors fitted.errors.csv --out merged/
    """
    OutputFolder(out)
    active = read_active(machine, old, controller_old or controller)
    machine = keeping_others(machine, [controller], active)
    measured = open_errors(errors)
    bare, lost_um = merged_errors(machine, measured, active)
    provenance: Provenance = provenance_of(machine.source, errors, *active.paths)
    done = export_and_verify(
        machine, bare, bare, controller, out, limits=limits, templates=templates, provenance=provenance
    )
    merged = read_tables(machine, done.paths, controller)
    report = merge_report(machine, measured, active, merged, lost_um)
    metadata = {"old_tables": active.names, "lost_um": lost_um}
    write_all(
        out,
        {
            "merge.json": json.dumps(report.summary(), indent=2) + "\n",
            "merged.errors.csv": format_errors(bare, metadata),
        },
    )
    if as_json:
        print_json({**done.verification.summary(), "merge": report.summary(), "paths": [str(p) for p in done.paths]})
    else:
        stdout.print(merge_text(report))
        stdout.print(verification_table([done.verification]))
        for path in done.paths:
            stdout.print(f"  {path}", markup=False, soft_wrap=True)
    return 0 if done.verification.accepted else 1


@click.command("crash-test")
@machine_argument
@click.argument("errors", type=click.Path(path_type=Path))
@click.option(
    "--controller",
    "controllers",
    multiple=True,
    metavar="NAME",
    help="Name of a control, may be given several times; default: all that the machine file has the settings for.",
)
@click.option(
    "--entries",
    type=click.IntRange(0, 1_000_000),
    default=ENTRIES,
    show_default=True,
    metavar="N",
    help="How many numbers of each control's tables are changed, one at a time, spread evenly over all of them.",
)
@json_option
def crash_test_command(
    machine: Machine, errors: Path, controllers: tuple[str, ...], entries: int, as_json: bool
) -> int:
    """Feed wrong tables to the verification: signs, axes and units, and see that each is rejected.

    ERRORS is an *.errors.csv file (um, urad). Tried are the 47 wrong signed permutations of the axes, of the
    correction and of the whole frame, um for mm, degrees for radians, errors for corrections, and single numbers of the
    tables, each changed so that the tip moves by more than 1 um and 3 % of the largest correction without its linear
    part. Nothing is written. Exit code 1 if any wrong table is accepted, or the right one is not.

    \b
    Example:
      volcomp crash-test zha-gantry fitted.errors.csv --controller siemens-cec
    """
    table = open_errors(errors)
    results: list[CrashTest] = []
    with progress(quiet=as_json) as show:
        for name in _usable(machine, controllers):
            show(f"trying wrong tables: {name}")
            results.append(crash_test(machine, table, name, entries))
    passed = all(item.passed for item in results)
    if as_json:
        data: dict[str, Any] = {item.controller: item.summary() for item in results}
        print_json({"passed": passed, "controllers": data})
    else:
        stdout.print(crash_table(results))
    return 0 if passed else 1


def _usable(machine: Machine, chosen: tuple[str, ...]) -> list[str]:
    """Return the chosen controls, or all whose settings are complete; the others are named on stderr."""
    if chosen:
        return list(dict.fromkeys(chosen))
    usable = []
    for name, control in CONTROLLERS.items():
        try:
            control.read_settings(machine)
        except InputError as error:
            stderr.print(f"{name} is left out: {error}", style="yellow", markup=False, soft_wrap=True)
        else:
            usable.append(name)
    if not usable:
        raise InputError("the machine file has complete settings for no control; add a section [controllers.NAME]")
    return usable


COMMANDS = (diff_command, merge_command, crash_test_command)
