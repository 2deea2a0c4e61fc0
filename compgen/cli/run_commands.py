"""``volcomp run``: the whole chain."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import (
    controller_option,
    json_option,
    machine_argument,
    out_option,
    print_json,
    progress,
    stdout,
)
from compgen.cli.emphasis_options import emphasis_options
from compgen.cli.fit_options import fitting_options
from compgen.cli.identify_commands import (
    identify_options,
    instrument_options,
    method_options,
    sixdof_option,
    systematic_options,
)
from compgen.cli.options_commands import explain_option, explain_run
from compgen.cli.report_commands import report_beside
from compgen.cli.safety_options import active_options, limits_option
from compgen.cli.sample_options import sample_options
from compgen.core.machine import Machine
from compgen.fit import FitOptions
from compgen.identify import SystematicInputs
from compgen.pipeline import run
from compgen.report.text import identification_table, run_json, verification_table
from compgen.verify.active import ActiveTables
from compgen.verify.safety import SafetyLimits


@click.command("run")
@machine_argument
@emphasis_options
@click.argument("measurements", nargs=-1, required=True, type=click.Path(path_type=Path))
@controller_option(multiple=True)
@sample_options
@sixdof_option
@out_option
@instrument_options
@systematic_options
@method_options
@fitting_options
@click.option("--templates", type=click.Path(path_type=Path), help="Folder of your own templates, searched first.")
@click.option("--allow-unverified", is_flag=True, help="Export formats that no public document fully describes.")
@active_options()
@limits_option
@click.option(
    "--allow-misfit",
    is_flag=True,
    help="Accept tables, with reservations, although the residuals of the readings are above a third of what the tables "
    "take away, or a step or a drift explains most of them. Without it the exit code is 1.",
)
@explain_option
@click.option("--no-report", is_flag=True, help="Write no report.html, and none of the files that belong to it.")
@json_option
def run_command(
    machine: Machine,
    measurements: tuple[Path, ...],
    controller: tuple[str, ...],
    instrument: Path | None,
    out: Path,
    u_length_um: float | None,
    u_length_um_per_m: float | None,
    keep_all: bool,
    systematic: SystematicInputs,
    choices: Mapping[str, Any],
    fitting: FitOptions,
    templates: Path | None,
    allow_unverified: bool,
    active: ActiveTables | None,
    limits: SafetyLimits,
    allow_misfit: bool,
    explain: bool,
    no_report: bool,
    as_json: bool,
) -> int:
    """Identify, fit, export, read back, verify: tracer lengths in, checked controller tables out.

    MACHINE is a name in machines/ or the path of a machine TOML; MEASUREMENTS are *.lengths.csv (mm)
    or *.deviations.csv files, or *.sixdof.csv with --instrument FILE. With several --controller each gets its own
    sub-folder of DIR. report.html in DIR shows everything; --no-report leaves it out.

    \b
    Example:
      volcomp run zha-gantry examples/zha-gantry.lengths.csv --controller isg-csv --out tables/
    """
    with progress(quiet=as_json) as show:
        result = run(
            machine,
            measurements,
            tuple(dict.fromkeys(controller)),
            out,
            identify_options=identify_options(u_length_um, u_length_um_per_m, keep_all, systematic, choices),
            fit_options=fitting,
            templates=templates,
            allow_unverified=allow_unverified,
            active=active,
            limits=limits,
            allow_misfit=allow_misfit,
            progress=show,
            instrument=instrument,
        )
        if not no_report:
            show("drawing the report")
        report = None if no_report else report_beside(out)
    if report is not None:  # the new one takes its place; without it the earlier one is kept as PREVIOUS-...
        for path in result.earlier_report:
            path.unlink(missing_ok=True)
    if explain:
        explain_run(machine, result, out, templates)
    if as_json:
        print_json({**run_json(result), "report": None if report is None else str(report)})
    else:
        stdout.print(identification_table(result.identification))
        stdout.print(verification_table([item.verification for item in result.results]))
        for item in result.results:
            for path in item.paths:
                stdout.print(f"  {path}", markup=False, soft_wrap=True)
        if report is not None:
            stdout.print(f"  {report}", markup=False, soft_wrap=True)
    return 0 if result.accepted else 1


COMMANDS = (run_command,)
