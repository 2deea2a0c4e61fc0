"""``volcomp run`` and ``report``: the whole chain, and its report."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import click

from compgen.cli.common import PATH, GroupedCommand, json_option, language_option, out_option, page_shown
from compgen.cli.output import print_json
from compgen.cli.shared_options import (
    active_options,
    answer_options,
    controller_option,
    emphasis_options,
    explain_option,
    fitting_options,
    heat_of_readings_options,
    identify_options,
    instrument_option,
    limits_option,
    machine_argument,
    measurements_argument,
    prior_option,
    sample_options,
    stated_options,
    templates_option,
    unverified_option,
)
from compgen.cli.terminal import progress, say, say_paths, stdout
from compgen.controls import HEAT_OUTPUTS, ROTARY_PITCH, ROTARY_TARGETS
from compgen.data.files import OutputFolder
from compgen.data.machine import Machine
from compgen.data.pose_readings import rotary_kind
from compgen.errors import CompgenWarning, InputError
from compgen.fitting import FitOptions
from compgen.foreign.answers import ImportOptions
from compgen.identification import IdentifyOptions
from compgen.identification.options import StatedNumbers
from compgen.pipeline import run
from compgen.report.terminal import advice_text, identification_table, verification_table, what_matters
from compgen.tables.judge import SafetyLimits

if TYPE_CHECKING:
    from compgen.cli.identify_commands import RotaryRun
    from compgen.identification.heat_of_readings import HeatSource
    from compgen.report.html.folder import KnownTables
    from compgen.report.html.write import Further
    from compgen.tables.active import ActiveTables


# ``volcomp report``.


@click.command("report")
@click.argument("folder", metavar="DIR", type=PATH)
@click.option("--out", metavar="DIR", type=PATH, help="Folder for the report; default: DIR itself.")
@click.option(
    "--dcc",
    "certificate",
    metavar="FILE",
    type=PATH,
    help="Laboratory, customer, persons, dates (TOML): write dcc.xml, too; default: DIR/certificate.toml if it exists.",
)
@click.option(
    "--dcc-schema",
    "schema",
    metavar="FILE",
    type=PATH,
    help="Local copy of dcc.xsd (PTB): write dcc.xml only if it validates.",
)
@click.option(
    "--certificate",
    "handed",
    metavar="FILE",
    type=PATH,
    help="Customer, machine, instruments, conditions (TOML, may be incomplete) for report.html; a copy goes to the folder. "
    "Default: DIR/certificate.toml if it exists.",
)
@click.option(
    "--pdf", "as_pdf", is_flag=True, help="Print report.html to report.pdf, with the Chromium of this computer."
)
@language_option
@json_option
def report_command(  # noqa: PLR0913  (options of the command)
    folder: Path,
    out: Path | None,
    certificate: Path | None,
    schema: Path | None,
    handed: Path | None,
    as_pdf: bool,
    language: str,
    as_json: bool,
) -> int:
    """Make the report of a folder that run, identify, verify or compare wrote, from the files in it.

    Writes report.html (one file, no network; --pdf prints it to report.pdf), report.json (its numbers), dossier.md and
    dossier.json (documentation), calibration.json (results in the order of a calibration certificate), and with --dcc
    dcc.xml (Digital Calibration Certificate). Lengths in mm, errors in um and urad.

    \b
    Example:
      volcomp report tables/ --dcc certificate.toml --dcc-schema dcc.xsd
    """
    from compgen.report.html import write_report
    from compgen.report.html.write import short_text

    OutputFolder(out or folder)
    also, remark = _dcc(folder, certificate, schema, handed)
    with progress(quiet=as_json) as show:
        show("drawing the report")
        report, paths = write_report(folder, out, also, language, certificate=handed or certificate, shown=page_shown)
        if as_pdf:
            from compgen.report.pdf import pdf_of

            show("printing the report")
            printed = OutputFolder(out or folder)
            printed.add("report.pdf", pdf_of(paths["report.html"]))
            paths = {**paths, **printed.commit()}
    if as_json:
        print_json({**report.data, "paths": [str(path) for path in paths.values()]})
        return 0
    stdout.print(short_text(report.data))
    say_paths(paths.values())
    if remark:
        say(remark)
    return 0


def _dcc(
    folder: Path, certificate: Path | None, schema: Path | None, handed: Path | None
) -> tuple[Further | None, str]:
    """Return what writes ``dcc.xml``, and what to say of it.

    A ``certificate.toml`` that lies in the folder, or is there for the page alone, may be incomplete: then there is no DCC.
    """
    default = folder / "certificate.toml"
    source = certificate or (default if default.is_file() and handed is None else None)
    if source is None and schema is not None:
        raise InputError("--dcc-schema needs a certificate; give its data with --dcc certificate.toml")
    if source is None:
        return None, ""
    from compgen.report.dcc import NEWEST, certificate_files, read_certificate, read_schema

    try:
        stated = read_certificate(source)
    except InputError as error:
        if certificate is not None or schema is not None:
            raise
        read_certificate(source, complete=False)
        return None, f"no dcc.xml: {error}"
    rules = None if schema is None else read_schema(schema)
    remark = f"dcc.xml: DCC {NEWEST}, not checked against the schema; --dcc-schema dcc.xsd does that"
    if rules is not None:
        remark = f"dcc.xml: DCC {rules.version}, valid against {rules.path}"
    return partial(certificate_files, options=stated, schema=rules), remark


def report_written(
    folder: Path, language: str, known: KnownTables | None = None, certificate: Path | None = None
) -> Path | None:
    """Write the report of a finished command into its folder; if this fails, the result remains."""
    from compgen.report.html import write_report

    try:
        return write_report(folder, language=language, known=known, certificate=certificate, shown=page_shown)[1][
            "report.html"
        ]
    except InputError as error:
        warnings.warn(f"the report could not be made: {error}", CompgenWarning, stacklevel=2)
        return None


# ``volcomp run``: the whole chain.


class _Run(GroupedCommand):
    """``run`` with its options under headings."""

    groups: ClassVar[Mapping[str, Sequence[str]]] = {
        "Needed": ("controller", "out"),
        "Numbers known without a file": ("stated__",),
        "What files of other programs leave open (volcomp import shows it)": ("answers__", "instrument"),
        "Identification": ("options__", "prior", "heat_model", "temperatures", "u_clock_s"),
        "Smoothing and bounds of the tables": ("fitting__", "zone", "tools", "limits__"),
        "Tables on the control": ("active", "template_from", "style_from", "templates", "allow_unverified", "sample"),
        "Verdict and output": ("allow_misfit", "explain", "no_report", "certificate", "language", "units", "as_json"),
    }


@click.command("run", cls=_Run)
@machine_argument
@prior_option
@emphasis_options
@measurements_argument
@controller_option(multiple=True)
@sample_options
@instrument_option
@stated_options
@answer_options
@out_option
@identify_options
@fitting_options
@templates_option
@unverified_option
@active_options()
@heat_of_readings_options
@limits_option
@click.option(
    "--allow-misfit",
    is_flag=True,
    help="Accept tables, with reservations, although the residuals of the readings exceed a third of what the tables "
    "correct, or a step or a drift explains most of them. Without it the exit code is 1.",
)
@explain_option
@click.option("--no-report", is_flag=True, help="Write neither report.html nor the files that belong to it.")
@click.option(
    "--certificate",
    metavar="FILE",
    type=PATH,
    help="Customer, machine, instruments, conditions (TOML, may be incomplete) for report.html; a copy goes to DIR.",
)
@language_option
@json_option
def run_command(
    machine: Machine,
    measurements: tuple[Path, ...],
    controller: tuple[str, ...],
    instrument: Path | None,
    stated: StatedNumbers,
    answers: ImportOptions,
    out: Path,
    options: IdentifyOptions,
    fitting: FitOptions,
    templates: Path | None,
    allow_unverified: bool,
    active: ActiveTables | None,
    heat: HeatSource | None,
    limits: SafetyLimits,
    allow_misfit: bool,
    explain: bool,
    no_report: bool,
    certificate: Path | None,
    language: str,
    as_json: bool,
) -> int:
    """Identify, fit, export, read back, verify: tracer lengths in, checked controller tables out.

    MACHINE is a name in machines/ or the path of a machine TOML. MEASUREMENTS are files of any kinds, alone or together:

    \b
      tracer lengths            *.lengths.csv, a table of points and lengths
      positioning (ISO 230-2)   *.axis.csv, Renishaw .rtl, ecmc .dat, CSV, Excel
      straightness, angles      *.errors.csv, .rta, .rts, CSV, Excel, records of levels and straightedges
      squares, tramming         records with travel and plunger, lists of squareness; or --squareness
      ballbar (ISO 230-4)       *.circle.csv, text with angle and deviation
      artefact by the probe     *.artefact.csv, log of a probe program, nominal and measured coordinates
      part on a CMM             *.part.csv, prints of measuring machines, DMIS, QIF
      positions, six-DOF laser  *.deviations.csv; *.sixdof.csv with --instrument FILE
      errors of other programs  Etalon exchange, *.errors.csv

    With several --controller each gets its own sub-folder of DIR. report.html in DIR shows everything; --no-report
    omits it.

    \b
    Example:
      volcomp run zha-gantry examples/zha-gantry.lengths.csv --controller isg-csv --out tables/
    """
    if certificate is not None:  # what is wrong in it is found before the work begins
        from compgen.report.dcc.laboratory import read_certificate

        read_certificate(certificate, complete=False)
    if outputs := [name for name in controller if name in HEAT_OUTPUTS]:
        raise InputError(
            f"{outputs[0]} takes a model of heat: volcomp heat, then volcomp export MACHINE NAME.heat.toml --controller "
            f"{outputs[0]}",
            field="--controller",
        )
    turned = _rotary_run(machine, measurements, controller, out, options, allow_unverified)
    if turned is not None:
        turned.linear = replace(turned.linear, instrument=instrument, stated=stated, answers=answers, active=active)
        if as_json and (len(set(controller)) > 1):
            raise InputError("--json is one object: give one control at a time where rotary axes are among them")
        turned.check()
        measurements = turned.read.others
        controller = tuple(name for name in controller if name not in turned.controllers)
        if not controller:
            return turned.export(apart=len(turned.controllers) > 1, as_json=as_json)
        if not measurements:
            raise InputError(
                f"says nothing of the linear axes, whose tables {controller[0]} takes; give a measurement of them as well",
                file=turned.measurements[0],
            )
    with progress(quiet=as_json) as show:
        result = run(
            machine,
            measurements,
            tuple(dict.fromkeys(controller)),
            out,
            identify_options=options,
            fit_options=fitting,
            templates=templates,
            allow_unverified=allow_unverified,
            active=active,
            heat=heat,
            limits=limits,
            allow_misfit=allow_misfit,
            language=language,
            progress=show,
            instrument=instrument,
            stated=stated,
            answers=answers,
            beyond=None if turned is None else turned.added,
        )
        if not no_report:
            show("drawing the report")
        known = {item.export.controller: (item.read, item.verification) for item in result.results if item.read}
        report = None if no_report else report_written(out, language, known, certificate)
    if report is not None:  # a new report replaces it; otherwise the earlier one is kept as PREVIOUS-...
        for path in result.earlier_report:
            path.unlink(missing_ok=True)
    if explain:
        from compgen.cli.table_commands import explain_run

        explain_run(machine, result, out, templates, language)
    if as_json:
        print_json({**result.summary(), "report": None if report is None else str(report)})
    else:
        stdout.print(identification_table(result.identification, assumed=False))
        stdout.print(what_matters(machine, result.identification))
        stdout.print(verification_table([item.verification for item in result.results], result.failed))
        stdout.print(advice_text(result.identification, result.next_best))
        for item in result.results:
            say_paths(item.paths)
        if report is not None:
            say_paths([report])
    code = 0 if result.accepted else 1
    if turned is not None and turned.controllers:
        code = max(code, turned.export(apart=True, as_json=False))
    return code


def _rotary_run(
    machine: Machine,
    measurements: tuple[Path, ...],
    controller: tuple[str, ...],
    out: Path,
    options: IdentifyOptions,
    allow_unverified: bool,
) -> RotaryRun | None:
    """What is to be done about rotary axes; None if no file and no control is about them."""
    own = tuple(name for name in dict.fromkeys(controller) if name in (*ROTARY_TARGETS, *ROTARY_PITCH))
    if not own and not any(rotary_kind(path) for path in measurements):
        return None
    from compgen.cli.identify_commands import LinearAxes, RotaryRun  # another command: loaded only where it is needed

    return RotaryRun(machine, measurements, own, out, options, LinearAxes(), allow_unverified)
