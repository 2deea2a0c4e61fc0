"""``volcomp identify`` and ``fit``: from a measurement to errors, and from errors to smooth curves."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from compgen.cli.common import fleet_options, json_option, out_option
from compgen.cli.output import print_json
from compgen.cli.shared_options import (
    active_options,
    answer_options,
    heat_of_readings_options,
    identify_options,
    instrument_option,
    machine_argument,
    mapper,
    measurements_argument,
    prior_option,
    stated_options,
)
from compgen.cli.terminal import progress, stdout
from compgen.controls import ROTARY_TARGETS
from compgen.data.error_table import SQUARENESS_APART
from compgen.data.files import OutputFolder, read_bytes
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.errors import CompgenWarning, InputError
from compgen.foreign.answers import ImportOptions
from compgen.foreign.heads import heads_of
from compgen.foreign.opening import open_measurement
from compgen.identification import Identification, IdentifyOptions
from compgen.identification.any_measurement import describe, evidence_files
from compgen.identification.covariance import covariance_file_of
from compgen.identification.options import StatedNumbers
from compgen.pipeline import (
    add_identification,
    failure_reported,
    identification_files,
    identify_beside,
    identify_warm,
    next_measurements,
    proposed_keys,
    provenance_of,
)
from compgen.report.terminal import advice_text, identification_table, what_matters

if TYPE_CHECKING:
    from compgen.identification.heat_of_readings import HeatSource
    from compgen.identification.with_rotary import RotaryResult
    from compgen.tables.active import ActiveTables


from compgen.cli.shared_options import (
    covariance_of,
    covariance_options,
    errors_argument,
    fitting_options,
)
from compgen.cli.terminal import answer
from compgen.fitting import FitOptions, fit
from compgen.foreign.opening import open_errors
from compgen.pipeline import fit_files, write_all
from compgen.report.terminal import fit_table


@click.command("identify")
@machine_argument
@prior_option
@measurements_argument
@instrument_option
@stated_options
@answer_options
@out_option
@identify_options
@active_options("--controller")
@heat_of_readings_options
@click.option(
    "--self-check",
    "replicates",
    type=click.IntRange(min=10),
    metavar="N",
    help="Identify N simulated sets of readings as well and compare their scatter with the stated uncertainties.",
)
@fleet_options
@json_option
def identify_command(
    machine: Machine,
    measurements: tuple[Path, ...],
    instrument: Path | None,
    stated: StatedNumbers,
    answers: ImportOptions,
    out: Path,
    options: IdentifyOptions,
    active: ActiveTables | None,
    heat: HeatSource | None,
    replicates: int | None,
    workers: int,
    cluster: str | None,
    as_json: bool,
) -> int:
    """Identify error curves, squareness and stations from tracer lengths, or errors from measured positions.

    Writes identified.errors.csv (um, urad, standard uncertainties) with identified.covariance.npz, stations.csv and
    identify.json to DIR. The uncertainties include the noise of the readings and the inputs given by --u-.... Without
    --u-length-um the comments u_length_um and u_length_um_per_m of the file apply, otherwise 0.1 um + 0.15 um/m.

    MEASUREMENTS are *.lengths.csv (mm) or *.deviations.csv files (dx_um, dy_um, dz_um: measured minus commanded; the
    placement of their frame is identified, too). --method two-step also writes measured.deviations.csv. With --stations
    one or two stations are enough if they determine the errors of the machine file; if not, identify.json lists the
    undetermined combinations and no error is written.

    *.sixdof.csv files contain raw readings of a six-DOF laser instrument (mm); --instrument describes it. They give all
    21 errors, without stations.csv. Together with lengths or deviations of the same machine, both are compared and
    averaged; exit code 1 and a warning list the errors that disagree. --workers and --cluster distribute the replicates
    of --self-check.

    *.sphere.csv files contain centres of spheres at poses of a machine with rotary axes (chain such as WCAYFXZT): they give
    the position errors of the rotary axes, and which of them the poses cannot tell apart. *.axis.csv files with position_deg
    and deviation_arcsec give the positioning of rotary axes (ECC), alone or with spheres.

    \b
    Example:
      volcomp identify zha-gantry examples/zha-gantry.lengths.csv --out identified/
    """
    if replicates is None and (workers > 1 or cluster is not None):
        raise InputError("--workers and --cluster need --self-check: they distribute its replicates")
    OutputFolder(out)
    if any(of_rotary_axes(path) for path in measurements):
        linear = LinearAxes(instrument, stated, answers, active)
        return _identify_rotary(machine, measurements, out, options, linear, as_json)
    with progress(quiet=as_json) as show:
        show("reading the measurement")
        measurement = open_measurement(measurements, instrument, stated=stated.errors(machine), answers=answers)
        show(f"identifying: {describe(measurement)}")
        with failure_reported(out):
            result = identify_warm(machine, measurement, heat, stated, options, active)
        checked = None
        if replicates is not None:
            if active is not None or not isinstance(measurement, Lengths):
                raise InputError("--self-check needs tracer lengths that were measured without active tables")
            from compgen.identification.monte_carlo import self_check

            with mapper(workers, cluster) as spread:
                checked = self_check(
                    machine,
                    measurement,
                    result,
                    replicates,
                    progress=lambda k: show(f"self-check: {k} of {replicates} replicates"),
                    mapper=spread,
                )
    proposed = next_measurements(result)
    warm = () if heat is None else heat.inputs
    sources = provenance_of(machine.source, *measurements, instrument, *warm)
    files = identification_files(result, sources, checked, proposed, heads_of(measurements))
    output = OutputFolder(out)
    add_identification(output, {**files, **evidence_files(machine, measurement, result)})
    output.commit()
    if as_json:
        more = {"monte_carlo": checked.summary()} if checked else {}
        print_json({**result.summary(), **proposed_keys(proposed), **more})
    else:
        stdout.print(identification_table(result))
        stdout.print(what_matters(machine, result))
        stdout.print(advice_text(result, proposed))
        if checked:
            text = f"self-check, {checked.replicates} replicates: standard deviation over stated uncertainty "
            text += f"{checked.ratio_median:.2f} ({checked.ratio_min:.2f} ... {checked.ratio_max:.2f}): "
            stdout.print(text + ("agrees" if checked.agrees else "DOES NOT AGREE"))
    return 1 if result.details.get("disagree") else 0


def _identify_rotary(
    machine: Machine,
    measurements: tuple[Path, ...],
    out: Path,
    options: IdentifyOptions,
    linear: LinearAxes,
    as_json: bool,
) -> int:
    """Identify the errors of rotary axes, with those of linear ones in one adjustment, and write them."""
    result, summary, files = _rotary_files(machine, measurements, options, linear)
    write_all(out, files)
    if as_json:
        print_json(summary)
    else:
        _show_rotary(result)
        stdout.print(f"{out / 'identified.errors.csv'}, {out / 'identify.json'}")
    return 0 if result.placed is None or result.placed.rank else 1


def diagnose_rotary(machine: Machine, measurements: tuple[Path, ...], out: Path, as_json: bool) -> int:
    """What spheres and runs betray before any table: the probe, a reversed axis, misfit, what cannot be told apart."""
    import json

    result, summary, _ = _rotary_files(machine, measurements, IdentifyOptions(), LinearAxes())
    placed, turned = result.placed, result.turned
    findings = [*(() if placed is None else placed.notes[1:]), *(() if turned is None else turned.notes)]
    apart = [] if placed is None else [f"cannot be told apart: {words}; {cure}" for words, cure in placed.inseparable]
    data = {"kind": summary["kind"], "findings": findings, "not_told_apart": apart, "evidence": summary}
    rows = [f"# {machine.name}: what the rotary axes show", "", *(f"- {text}" for text in [*findings, *apart]), ""]
    write_all(out, {"diagnosis.json": json.dumps(data, indent=2) + "\n", "diagnosis.md": "\n".join(rows)})
    if as_json:
        print_json(data)
    else:
        _show_rotary(result)
        stdout.print(f"{out / 'diagnosis.json'}, {out / 'diagnosis.md'}")
    return 0


def _show_rotary(result: RotaryResult) -> None:
    """Print what was read of the rotary axes, and of the linear ones with them."""
    from compgen.report.terminal import sphere_table

    if result.linear is not None:
        stdout.print(identification_table(result.linear))
    if result.placed is not None:
        stdout.print(sphere_table(result.placed))
    if result.turned is not None:
        for letter, own in result.turned.figures.items():
            figures = ", ".join(f"{name.replace('_', ' ')} {value:.2f}" for name, value in own.items())
            stdout.print(f"{letter}: positioning after ISO 230-2, arcsec: {figures}")
        for note in result.turned.notes:
            stdout.print(f"note: {note}")


def of_rotary_axes(path: Path) -> bool:
    """Whether a file says something of rotary axes: spheres, bars, runs, readings with turned axes."""
    from compgen.data.pose_readings import rotary_kind

    return rotary_kind(path) is not None


@dataclass(frozen=True)
class LinearAxes:
    """What is said of the linear axes beside the files of the rotary ones."""

    instrument: Path | None = None
    stated: StatedNumbers = StatedNumbers()
    answers: ImportOptions = ImportOptions()
    active: ActiveTables | None = None

    def identified(self, machine: Machine, files: Sequence[Path], options: IdentifyOptions) -> Identification | None:
        """The linear axes from their files; None if nothing was measured or stated of them."""
        errors = self.stated.errors(machine)
        if not files and errors is None:
            return None
        measurement = open_measurement(files, self.instrument, stated=errors, answers=self.answers)
        return identify_beside(machine, measurement, self.stated, options, self.active)


def _rotary_files(
    machine: Machine, measurements: Sequence[Path], options: IdentifyOptions, linear: LinearAxes
) -> tuple[RotaryResult, dict[str, Any], dict[str, str | bytes]]:
    """Errors of rotary and linear axes in one adjustment, their summary, and the files that say so."""
    from compgen.identification.with_rotary import identify_rotary, read_rotary_files

    read = read_rotary_files(machine, measurements)
    result = identify_rotary(machine, read, options, linear.identified(machine, read.others, options))
    return result, result.summary(), _with_summary(machine, measurements, result)


def _with_summary(machine: Machine, measurements: Sequence[Path], result: RotaryResult) -> dict[str, str | bytes]:
    """The files of an identification with rotary axes."""
    import json

    named = {"machine": machine.name, "chain": machine.chain.name}
    data = {**named, **result.summary(), "provenance": dict(provenance_of(machine.source, *measurements).inputs)}
    return {**result.files(), "identify.json": json.dumps(data, indent=2) + "\n"}


@dataclass
class RotaryRun:
    """``volcomp run`` for a machine with rotary axes: identified once, together with the linear ones, for all controls.

    ``added`` is what the identification of the linear axes becomes (:func:`compgen.pipeline.run`, ``beyond``).
    """

    machine: Machine
    measurements: tuple[Path, ...]
    controllers: tuple[str, ...]
    out: Path
    options: IdentifyOptions
    linear: LinearAxes
    allow_unverified: bool = False
    result: RotaryResult | None = None

    def check(self) -> None:
        """Find what is wrong with the controls before the work begins; InputError."""
        from compgen.cli.rotary_commands import pitch_format
        from compgen.controls.rotary_parameters import target_of
        from compgen.identification.with_rotary import read_rotary_files

        self.read = read_rotary_files(self.machine, self.measurements)
        for name in self.controllers:
            if name in ROTARY_TARGETS:
                target_of(self.machine, name)
                continue
            pitch_format(self.machine, name, self.allow_unverified)
            if self.read.runs is None:
                raise InputError(
                    f"contains no positioning of a rotary axis, which {name} takes; give runs (*.axis.csv)",
                    file=self.measurements[0],
                )

    def added(self, found: Identification) -> Identification:
        """The linear axes with what was read at poses."""
        from compgen.identification.with_rotary import identify_rotary

        self.result = identify_rotary(self.machine, self.read, self.options, found)
        return self.result.linear or found

    def export(self, *, apart: bool, as_json: bool) -> int:
        """Write parameters and tables of the rotary axes, each control into its own folder if there are several."""
        from compgen.cli.rotary_commands import export_parameters, export_tables
        from compgen.identification.with_rotary import identify_rotary

        if self.result is None:
            linear = self.linear.identified(self.machine, self.read.others, self.options)
            self.result = identify_rotary(self.machine, self.read, self.options, linear)
        files = _with_summary(self.machine, self.measurements, self.result)
        if not as_json:
            _show_rotary(self.result)
        codes = []
        for name in self.controllers:
            folder = self.out / name if apart else self.out
            write_all(folder, files)
            errors = folder / "identified.errors.csv"
            if name in ROTARY_TARGETS:
                codes.append(export_parameters(self.machine, errors, name, folder, as_json))
            else:
                codes.append(export_tables(self.machine, errors, name, folder, as_json, self.allow_unverified))
        return max(codes)


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
    the folder of ERRORS, its correlations are used, and fitted.covariance.npz is a copy of it; otherwise nodes are
    independent.

    \b
    Example:
      volcomp fit zha-gantry identified/identified.errors.csv --max-abs linear=20 --out fitted/
    """
    OutputFolder(out)
    table = open_errors(errors)
    known = covariance_of(errors, table, covariance, independent=independent)
    result = fit(machine, table, fitting, covariance=known)
    gained = [name for name in result.errors.squareness if name not in table.squareness]
    if gained:
        text = f"{', '.join(gained)} comes from the lines of straightness curves and the zeros of angles; if these are those of "
        text += f"instruments, write the comment # squareness = {SQUARENESS_APART} into {errors}"
        warnings.warn(text, CompgenWarning, stacklevel=2)
    source = covariance or covariance_file_of(errors, table)
    if known is None or source is None:
        write_all(out, fit_files(result))
    else:
        copied = "fitted.covariance.npz", read_bytes(source)
        write_all(out, {**fit_files(result, copied), copied[0]: copied[1]})
    answer(as_json, result.to_dict(), fit_table(result))
    return 0
