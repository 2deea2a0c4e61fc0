"""The command line: ``volcomp --help``."""

from __future__ import annotations

import sys

import click

from compgen.cli import (
    compare_commands,
    diagnose_commands,
    export_commands,
    identify_commands,
    import_commands,
    listing_commands,
    options_commands,
    plan_commands,
    recal_commands,
    recal_decision_commands,
    recal_drift_commands,
    recal_reprocess_commands,
    recal_store_commands,
    report_commands,
    run_commands,
    safety_commands,
    serve_commands,
    simulate_commands,
)
from compgen.cli.common import run_command
from compgen.cli.plugin_options import plugin_option
from compgen.export import program_version
from compgen.plugins import load_plugins


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(program_version(), prog_name="compgen")
@plugin_option
def cli() -> None:
    """From a machine-tool measurement to checked compensation tables.

    Lengths are in mm, errors in files in um and urad. Exit codes: 0 done and accepted, 1 done but not acceptable,
    2 wrong usage or bad input, 3 internal error.

    \b
    Example:
      volcomp run zha-gantry lengths.csv --controller isg-csv --out tables/
    """
    load_plugins()


MODULES = (
    run_commands,
    import_commands,
    simulate_commands,
    identify_commands,
    diagnose_commands,
    plan_commands,
    export_commands,
    compare_commands,
    report_commands,
    options_commands,
    safety_commands,
    recal_commands,
    recal_decision_commands,
    recal_drift_commands,
    recal_reprocess_commands,
    recal_store_commands,
    serve_commands,
    listing_commands,
)
for module in MODULES:
    for command in module.COMMANDS:
        cli.add_command(plugin_option(command))


def main() -> None:
    """Entry point of the console script."""
    sys.exit(run_command(cli))
