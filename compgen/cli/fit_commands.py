"""``volcomp fit``: from errors to smooth curves."""

from __future__ import annotations

from pathlib import Path

import click

from compgen.cli.common import json_option, out_option
from compgen.cli.shared_options import (
    covariance_of,
    covariance_options,
    errors_argument,
    fitting_options,
    machine_argument,
)
from compgen.cli.terminal import answer
from compgen.data.files import OutputFolder
from compgen.data.machine import Machine
from compgen.fit import FitOptions, fit
from compgen.foreign.source import open_errors
from compgen.pipeline import fit_files, write_all
from compgen.report.terminal import fit_table


@click.command("fit")
@machine_argument
@errors_argument
@out_option
@fitting_options
@covariance_options
@json_option
def fit_command(
    machine: Machine,
    errors: Path,
    out: Path,
    fitting: FitOptions,
    covariance: Path | None,
    independent: bool,
    as_json: bool,
) -> int:
    """Fit smooth curves: straightness zero at both ends, positioning and angles zero at the reference point.

    ERRORS is an *.errors.csv file (um, urad), or the exchange file of a laser tracer's software (Etalon, variant
    Vendor; mm, rad). Writes fitted.errors.csv and fit.json to DIR. If the covariance that volcomp identify wrote is in
    the folder of ERRORS, its correlations are used; otherwise nodes are independent.

    \b
    Example:
      volcomp fit zha-gantry identified/identified.errors.csv --max-abs linear=20 --out fitted/
    """
    OutputFolder(out)
    table = open_errors(errors)
    known = covariance_of(errors, table, covariance, independent=independent)
    result = fit(machine, table, fitting, covariance=known)
    write_all(out, fit_files(result))
    answer(as_json, result.to_dict(), fit_table(result))
    return 0
