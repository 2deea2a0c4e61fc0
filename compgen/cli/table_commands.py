"""``volcomp options``, ``export``, ``read``, ``verify``, ``diff``, ``merge`` and ``crash-test``: compensation tables."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from compgen.cli.common import NUMBER, PATH, for_readers, json_option, language_option, out_option
from compgen.cli.output import print_json
from compgen.cli.shared_options import (
    active_options,
    controller_option,
    covariance_of,
    emphasis_options,
    errors_argument,
    explain_option,
    limits_option,
    machine_argument,
    points_option,
    prior_option,
    reversal_option,
    sample_options,
    templates_option,
    tool_offset,
    unverified_option,
)
from compgen.cli.terminal import answer, complain, progress, say, say_paths, stdout
from compgen.controls import CONTROLLERS, HEAT_OUTPUTS, ROTARY_PITCH, ROTARY_TARGETS
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import format_errors, read_reversal
from compgen.data.files import OutputFolder, write_file
from compgen.data.lengths import Points, format_points, read_points
from compgen.data.machine import Machine, zone_of
from compgen.effects import effects_reversal
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import open_errors
from compgen.identification.covariance import joint_covariance
from compgen.pipeline import (
    RunResult,
    export_and_verify,
    identified_reversal,
    provenance_of,
    verified_export,
    write_all,
)
from compgen.report.options_text import explanation_markdown, options_markdown, options_tables
from compgen.report.terminal import crash_table, difference_table, merge_text, verification_table
from compgen.tables import REJECTED_PREFIX, Provenance, export, read_tables, residuals, verify, with_known
from compgen.tables.active import (
    ActiveTables,
    bare_covariance,
    bare_errors,
    difference,
    keeping_others,
    merge_report,
    merged_errors,
    read_active,
)
from compgen.tables.judge import SafetyLimits
from compgen.tables.options import capability
from compgen.tables.options import explain as explained
from compgen.tables.signs import ENTRIES, CrashTest, check_files, crash_test
from compgen.tables.verification import verification_files

# ``volcomp options``, and what ``--explain`` of export and run writes.


TOOL_HELP = (
    "Tool offset X,Y,Z in mm in addition to that of the machine file; may be given several times. Default: 0, "
    "-100 and -200 mm along Z."
)
ZONE_HELP = "Part of the travel to evaluate, mm, e.g. X=-400:0,Y=100:300; default: all."
OPTIONS_REVERSAL_HELP = "*.reversal.csv (um): the reversal value of each axis along its travel."


def explain_run(machine: Machine, result: RunResult, out: Path, templates: Path | None, language: str) -> None:
    """Write explain.md next to the tables of every control of a run."""
    reversal, known = identified_reversal(result.identification), None
    if result.identification.has_covariance:
        known = joint_covariance(result.identification)
    several = len(result.results) > 1
    files: dict[str, str | bytes] = {}
    for item in result.results:
        found = explained(
            machine, result.fitted.errors, item.export, reversal=reversal, templates=templates, covariance=known
        )
        folder = f"{item.export.controller}/" if several else ""
        files[f"{folder}explain.md"] = explanation_markdown(found)
    write_all(out, for_readers(files, language))


@click.command("options")
@machine_argument
@prior_option
@errors_argument
@click.option("--tool", "tools", multiple=True, metavar="X,Y,Z", help=TOOL_HELP)
@click.option("--zone", metavar="RANGES", help=ZONE_HELP)
@click.option("--reversal", metavar="FILE", type=PATH, help=OPTIONS_REVERSAL_HELP)
@templates_option
@click.option("--out", metavar="DIR", type=PATH, help="Folder for options.json and options.md.")
@language_option
@json_option
def options_command(
    machine: Machine,
    errors: Path,
    tools: tuple[str, ...],
    zone: str | None,
    reversal: Path | None,
    templates: Path | None,
    out: Path | None,
    language: str,
    as_json: bool,
) -> int:
    """Show what each option of a control would gain: the error that remains, by level and by control.

    ERRORS is an *.errors.csv file (um, urad). Levels: no table; positioning; + straightness; + squareness; + products
    of tables; full volumetric; + direction-dependent (with --reversal). Also the file of every control, exported and
    read back, and the errors that remain with tools of other lengths. Figures in um; DIR gets options.json and
    options.md.

    \b
    Example:
      volcomp options zha-gantry identified/identified.errors.csv --tool 0,0,-150
    """
    if out is not None:
        OutputFolder(out)
    with progress(quiet=as_json) as show:
        show("fitting every level, exporting for every control and reading back")
        table = open_errors(errors)
        result = capability(
            machine,
            table,
            tools_mm=[tool_offset("--tool", text) for text in tools],
            zone_mm=zone_of(zone, [axis.range_mm for axis in machine.axes]) if zone else None,
            reversal=read_reversal(reversal) if reversal else effects_reversal(machine),
            templates=templates,
            covariance=covariance_of(errors, table, None, independent=False),
        )
    if out is not None:
        text = json.dumps(result.as_dict(), indent=2) + "\n"
        write_all(out, for_readers({"options.json": text, "options.md": options_markdown(result)}, language))
    answer(as_json, result.as_dict(), options_tables(result))
    return 0


# ``volcomp export``, ``volcomp read`` and ``volcomp verify``.


@click.command("export")
@machine_argument
@prior_option
@emphasis_options
@errors_argument
@controller_option()
@sample_options
@out_option
@templates_option
@unverified_option
@reversal_option
@active_options()
@explain_option
@click.option("--no-verify", is_flag=True, help="Do not read the files back and verify them.")
@language_option
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
    language: str,
    as_json: bool,
) -> int:
    """Export errors to the files of a control, with manifest.json and preflight.md.

    ERRORS is an *.errors.csv file (um, urad), usually the fitted one, or the exchange file of a laser tracer's software
    (Etalon, variant Vendor; mm, rad). The files are read back and verified against ERRORS as by `verify`, which adds
    result.json and volume.csv. Files that are not acceptable, or exceed a limit of the control, are written as
    NOT-ACCEPTED-... (exit code 1). check/check-program.md says what the machine should read at five positions. With
    --active, ERRORS belong to the machine with its old tables; bare.errors.csv gets those without.

    Of a machine with rotary axes the controls linuxcnc-trt, linuxcnc-tdr, linuxcnc-5axis, siemens-toolcarrier and fanuc-5axis
    get the parameters that say where its rotary axes are (mm); linuxcnc-rotary-comp, siemens-rotary-eec, siemens-rotary-cec,
    fanuc-rotary-pitch, heidenhain-rotary-com, twincat-rotary-list and aerotech-rotary get tables over the angle (degrees).

    With a model of heat (NAME.heat.toml of `volcomp heat`) in place of ERRORS the controls linuxcnc-heat, siemens-heat,
    twincat-heat and klipper-heat get what takes the growth (um) away over temperatures (degC).

    \b
    Example:
      volcomp export zha-gantry fitted/fitted.errors.csv --controller siemens-cec --out tables/
    """
    OutputFolder(out)
    if controller in ROTARY_TARGETS:
        from compgen.cli.rotary_commands import export_parameters

        return export_parameters(machine, errors, controller, out, as_json)
    if controller in ROTARY_PITCH:
        from compgen.cli.rotary_commands import export_tables

        return export_tables(machine, errors, controller, out, as_json, allow_unverified)
    if controller in HEAT_OUTPUTS:
        from compgen.cli.heat_outputs import export_output

        return export_output(machine, errors, controller, out, as_json)
    if errors.name.endswith(".heat.toml"):
        outputs = ", ".join(HEAT_OUTPUTS)
        raise InputError(
            f"is a model of heat, which {controller} does not take; --controller is one of {outputs}", file=errors
        )
    table, extra_files = open_errors(errors), {}
    both = read_reversal(reversal) if reversal else effects_reversal(machine)
    known = covariance_of(errors, table, None, independent=False)
    if active is not None:
        measured = table
        table, lost_um = bare_errors(machine, measured, active)
        known = bare_covariance(machine, measured, known, table)
        extra_files["bare.errors.csv"] = format_errors(
            table, {"active_tables_removed": active.names, "lost_um": lost_um}
        )
    exported = export(
        machine,
        table,
        controller,
        templates=templates,
        allow_unverified=allow_unverified,
        provenance=provenance_of(machine.source, errors, reversal, *(active.paths if active else ())),
        reversal=both,
        language=language,
    )
    extra_files |= check_files(machine, exported, table, templates, both, language, covariance=known)
    explanation = None
    if explain:
        explanation = explained(machine, table, exported, reversal=both, templates=templates, covariance=known)
    if explanation is not None:
        extra_files |= for_readers({"explain.md": explanation_markdown(explanation)}, language)
    reasons: tuple[str, ...] = tuple(exported.violations)
    if not no_verify:
        _, verification = verified_export(machine, exported, table, both, known=known)
        reasons = verification.reasons
        prefix = REJECTED_PREFIX if reasons else ""
        named = tuple((prefix + name, digest) for name, digest in verification.files)
        extra_files |= verification_files(replace(verification, files=named))
        exported = with_known(exported, verification.known_lines, language)
    paths = exported.write(out, accepted=not reasons, beside=extra_files)
    for text in exported.warnings:
        complain(f"warning: {text}")
    for text in reasons:
        complain(f"not acceptable: {text}", "red")
    if as_json:
        verdict = {
            "accepted": not reasons,
            "verified": not no_verify,
            "reasons": list(reasons),
            "paths": [str(path) for path in paths],
        }
        print_json({**exported.manifest, **verdict, **({"explain": explanation.as_dict()} if explanation else {})})
    else:
        if explanation is not None:
            say(extra_files["explain.md"])
        say_paths(paths)
    return 1 if reasons else 0


@click.command("read")
@machine_argument
@click.argument("tables", nargs=-1, required=True, type=PATH)
@controller_option()
@sample_options
@click.option("--points", required=True, type=PATH, help="*.points.csv (mm).")
@click.option("--out", required=True, metavar="FILE", type=PATH, help="CSV file for the result.")
@json_option
def read_command(
    machine: Machine, tables: tuple[Path, ...], controller: str, points: Path, out: Path, as_json: bool
) -> int:
    """Read controller files, emulate the control, and write the correction at each point.

    FILE gets the points plus cx_um, cy_um, cz_um: what the control adds to the command. Of a table over the angle of rotary
    axes it gets ca_arcsec, cb_arcsec, cc_arcsec at a_deg, b_deg, c_deg, and where tables act by direction of travel also
    ca_negative_arcsec ... for negative travel. Of an output for heat --points is a *.temperatures.csv (degC), and FILE says
    what is added at each reading.

    \b
    Example:
      volcomp read zha-gantry tables/volcomp0.csv --controller isg-csv --points p.points.csv --out correction.csv
    """
    if controller in ROTARY_TARGETS:
        from compgen.cli.rotary_commands import read_parameters

        return read_parameters(machine, tables, controller, points, out, as_json)
    if controller in ROTARY_PITCH:
        from compgen.cli.rotary_commands import read_pitch

        return read_pitch(machine, tables, controller, points, out, as_json)
    if controller in HEAT_OUTPUTS:
        from compgen.cli.heat_outputs import read_output

        return read_output(machine, tables, controller, points, out, as_json)
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
            say(remark)
        text = f"{len(where)} points: correction max {figures.max_um:.2f} um, rms {figures.rms_um:.2f} um -> {out}"
        say(text)
    return 0


@click.command("verify")
@machine_argument
@prior_option
@emphasis_options
@click.argument("tables", nargs=-1, required=True, type=PATH)
@controller_option()
@sample_options
@click.option(
    "--errors",
    required=True,
    type=PATH,
    help="*.errors.csv of the machine (um, urad), or an Etalon exchange file (mm, rad).",
)
@points_option
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
    if controller in ROTARY_TARGETS:
        from compgen.cli.rotary_commands import verify_parameters

        return verify_parameters(machine, tables, controller, errors, out, as_json)
    if controller in ROTARY_PITCH:
        from compgen.cli.rotary_commands import verify_tables

        return verify_tables(machine, tables, controller, errors, out, as_json)
    if controller in HEAT_OUTPUTS:
        from compgen.cli.heat_outputs import verify_output

        return verify_output(machine, tables, controller, errors, out, as_json)
    where = read_points(points) if points else None
    both = read_reversal(reversal) if reversal else effects_reversal(machine)
    parsed, table = read_tables(machine, tables, controller), open_errors(errors)
    known = covariance_of(errors, table, None, independent=False)
    result = verify(machine, parsed, table, where, reversal=both, limits=limits, covariance=known)
    write_all(out, verification_files(result))
    answer(as_json, result.summary(), verification_table([result]))
    return 0 if result.accepted else 1


# ``volcomp diff``, ``volcomp merge`` and ``volcomp crash-test``.


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
@click.argument("tables", nargs=-1, required=True, metavar="A...", type=PATH)
@click.option("--against", multiple=True, required=True, metavar="B...", type=PATH, help="Set B.")
@controller_option()
@sample_options
@click.option("--controller-b", metavar="NAME", help="Control of set B; default: the control of A.")
@points_option
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

    Writes diff.json and difference.csv (both corrections and their difference at each point) to DIR. Text differences
    that do not change a correction are ignored. Exit code 0 even if they differ, unless --fail-above is exceeded.

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
    columns: dict[str, FloatArray] = {}
    for prefix, values in (("a", result.first_mm), ("b", result.second_mm), ("d", result.difference_mm)):
        columns |= {f"{prefix}{axis}_um": values[:, k] * 1e3 for k, axis in enumerate("xyz")}
    text = format_points(Points(result.position_mm), columns, {"machine": machine.name})
    files = {"diff.json": json.dumps(data, indent=2) + "\n", "difference.csv": text}
    write_all(out, files)
    answer(as_json, data, difference_table(result))
    return 1 if fail_above is not None and result.max_um > fail_above else 0


@click.command("merge")
@machine_argument
@prior_option
@click.argument("old", nargs=-1, required=True, metavar="OLD...", type=PATH)
@controller_option()
@sample_options
@click.option(
    "--controller-old", metavar="NAME", help="Control of the old tables; default: the control of the new ones."
)
@click.option(
    "--errors",
    required=True,
    type=PATH,
    help="*.errors.csv (um, urad) measured while the old tables were active, without --active.",
)
@out_option
@templates_option
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
    """Merge old tables and new errors into one set of tables: what the old ones correct plus what is left.

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
    known = bare_covariance(machine, measured, covariance_of(errors, measured, None, independent=False), bare)
    provenance: Provenance = provenance_of(machine.source, errors, *active.paths)
    done = export_and_verify(
        machine, bare, bare, controller, out, limits=limits, templates=templates, provenance=provenance, known=known
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
        say_paths(done.paths)
    return 0 if done.verification.accepted else 1


@click.command("crash-test")
@machine_argument
@errors_argument
@click.option(
    "--controller",
    "controllers",
    multiple=True,
    metavar="NAME",
    help="Name of a control, may be given several times; default: all that have settings in the machine file.",
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
    """Feed wrong tables to the verification (signs, axes, units) and check that each is rejected.

    ERRORS is an *.errors.csv file (um, urad). The wrong tables are: the 47 wrong signed permutations of the axes, of
    the correction and of the whole frame; um for mm; degrees for radians; errors for corrections; and single numbers of
    the tables, each changed until the tip moves by more than 1 um and 3 % of the largest correction without its linear
    part. Nothing is written. Exit code 1 if a wrong table is accepted, or the right one rejected.

    \b
    Example:
      volcomp crash-test zha-gantry fitted.errors.csv --controller siemens-cec
    """
    table = open_errors(errors)
    results: list[CrashTest] = []
    with progress(quiet=as_json) as show:
        for name in _usable(machine, controllers):
            show(f"trying wrong tables: {name}")
            try:
                results.append(crash_test(machine, table, name, entries))
            except InputError as error:  # settings that only the tables themselves show to be missing
                if controllers:
                    raise
                complain(f"{name} is skipped: {error}")
    if not results:
        raise InputError(f"no tables can be made for any control of {machine.name}; add a section [controllers.NAME]")
    passed = all(item.passed for item in results)
    if as_json:
        data: dict[str, Any] = {item.controller: item.summary() for item in results}
        print_json({"passed": passed, "controllers": data})
    else:
        stdout.print(crash_table(results))
    return 0 if passed else 1


def _usable(machine: Machine, chosen: tuple[str, ...]) -> list[str]:
    """Return the chosen controls, or all whose settings are complete; the others are listed on stderr."""
    if chosen:
        return list(dict.fromkeys(chosen))
    usable = []
    for name, control in CONTROLLERS.items():
        try:
            control.read_settings(machine)
        except InputError as error:
            complain(f"{name} is skipped: {error}")
        else:
            usable.append(name)
    if not usable:
        raise InputError(
            "the machine file has complete settings for none of the controls; add a section [controllers.NAME]"
        )
    return usable
