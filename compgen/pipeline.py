"""The whole chain: identify, fit, export, read back from disk, verify; for one or several controls."""

from __future__ import annotations

import json
import shlex
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from compgen.controllers import controller_named
from compgen.core.csvio import FloatArray, format_csv
from compgen.core.deviations import Deviations, format_deviations
from compgen.core.error_table import Curve, ErrorTable, format_errors
from compgen.core.files import OutputFolder, read_bytes, sha256_of, working_folder
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.reversal import WORTH_MM, ReversalCurves, format_reversal
from compgen.effects import with_effects_reversal
from compgen.errors import CompgenWarning, ConvergenceError, InputError, UndeterminedError
from compgen.export import REJECTED_PREFIX, Export, Provenance, export, set_aside_superseded, usable_format
from compgen.fit import FitOptions, FitResult, fit
from compgen.identify import (
    Identification,
    IdentifyOptions,
    covariance,
    describe,
    identify_measurement,
)
from compgen.identify.evidence import evidence_files
from compgen.identify.measurement import Measurement
from compgen.identify.monte_carlo import SelfCheck
from compgen.identify.reversal import SIGNIFICANT
from compgen.imports import given_errors, open_measurement
from compgen.verify import Verification, read_tables, verify
from compgen.verify.active import ActiveTables, without_active
from compgen.verify.check_program import check_files
from compgen.verify.evidence import verification_files
from compgen.verify.safety import SafetyLimits
from compgen.verify.verdict import MISFIT_CODES, blocking_reasons, measurement_objections, taken_away_um

Progress = Callable[[str], None]


class Checks(TypedDict, total=False):
    """What :func:`run` may be told beyond the stages' options, see there."""

    active: ActiveTables | None
    limits: SafetyLimits | None
    instrument: str | Path | None
    allow_misfit: bool


@dataclass(frozen=True)
class ControllerResult:
    """Outcome for one control: what was exported, what the round trip on the written files says, and where they are."""

    export: Export
    verification: Verification
    paths: tuple[Path, ...]


@dataclass(frozen=True)
class RunResult:
    """Outcome of :func:`run`; ``accepted`` is True if every control's tables are.

    ``earlier_report`` says where the report of the tables that were in the folder before is kept.
    """

    identification: Identification
    fitted: FitResult
    results: tuple[ControllerResult, ...]
    earlier_report: tuple[Path, ...] = ()

    @property
    def accepted(self) -> bool:
        """Whether all tables may be loaded."""
        return all(result.verification.accepted for result in self.results)


def provenance_of(*paths: str | Path | None) -> Provenance:
    """Return name and SHA-256 of the given files."""
    files = [Path(path) for path in paths if path is not None]
    return Provenance(tuple((path.name, sha256_of(read_bytes(path))) for path in files))


def identification_files(
    result: Identification, provenance: Provenance, checked: SelfCheck | None = None
) -> dict[str, str | bytes]:
    """Return the contents of ``identified.errors.csv`` and its covariance, ``stations.csv`` and ``identify.json``.

    Where a reversal was found ``identified.reversal.csv`` stands beside them. The two-step method adds
    ``measured.deviations.csv``; deviations as input give no stations.
    """
    stations = result.stations
    columns: dict[str, Sequence[str] | FloatArray] = {
        "station": [item.station for item in stations],
        "setup": [str(item.setup) for item in stations],
        "segment": [str(item.segment) for item in stations],
        **{f"{axis}_mm": np.array([item.position_mm[k] for item in stations]) for k, axis in enumerate("xyz")},
        **{
            f"u_{axis}_um": 1e3 * np.array([item.u_position_mm[k] for item in stations]) for k, axis in enumerate("xyz")
        },
        "dead_length_mm": np.array([item.dead_length_mm for item in stations]),
        "u_dead_length_um": 1e3 * np.array([item.u_dead_length_mm for item in stations]),
        "readings": [str(item.readings) for item in stations],
        "residual_rms_um": np.array([item.rms_um for item in stations]),
    }
    summary = {**result.summary(), "inputs": [{"name": name, "sha256": digest} for name, digest in provenance.inputs]}
    files: dict[str, str | bytes] = {}
    if stations:
        files["stations.csv"] = format_csv(columns, {"machine": result.errors.metadata.get("machine", "")})
    if result.positions is not None:
        files["measured.deviations.csv"] = format_deviations(result.positions)
    if checked is not None:
        summary["monte_carlo"] = checked.summary()
    reversal = identified_reversal(result)
    if reversal is not None:
        files["identified.reversal.csv"] = format_reversal(reversal)
    return {
        **_errors_files(result),
        **files,
        "identify.json": json.dumps(summary, indent=2) + "\n",
    }


#: What only some identifications write.
SOME_WRITE = ("stations.csv", "measured.deviations.csv", "identified.reversal.csv", covariance.FILE_NAME)


def add_identification(output: OutputFolder, files: Mapping[str, str | bytes]) -> None:
    """Add the files of an identification; those of an earlier one that have no successor are set aside.

    Else the reversal or the covariance of one measurement would be taken for that of the next.
    """
    for name, content in files.items():
        output.add(name, content)
    for name in SOME_WRITE:
        if name not in files and (output.folder / name).is_file():
            output.set_aside(name)


def identified_reversal(result: Identification) -> ReversalCurves | None:
    """Return the reversals that are far beyond their uncertainty and worth a table; None if there is none.

    Backlash of the machine file that was taken out of the readings is part of them.
    """
    return with_effects_reversal(result.layout.machine, _found_reversal(result), result.corrections.get("effects", {}))


def _found_reversal(result: Identification) -> ReversalCurves | None:
    """Return the reversals that the readings show.

    They belong to curves that are the means of both directions, so none is returned where the readings were not
    brought to that mean.
    """
    if result.reversal_curves is not None:
        return result.reversal_curves
    if result.reversal is None or not result.reversal.removed:
        return None
    curves = {}
    for name, axis in result.reversal.axes.items():
        for component, (value, u) in enumerate(zip(axis.vector_mm, axis.u_mm, strict=True)):
            if abs(value) > SIGNIFICANT * u and abs(value) >= WORTH_MM:
                key = (AXES.index(name), component)
                curves[key] = Curve(np.zeros(1), np.array([value]), np.array([u]))
    return ReversalCurves(curves, {"machine": result.errors.metadata.get("machine", "")}) if curves else None


def _errors_files(result: Identification) -> dict[str, str | bytes]:
    if not result.has_covariance:
        return {"identified.errors.csv": format_errors(result.errors)}
    text = format_errors(result.errors, {"covariance": covariance.FILE_NAME})
    content = covariance.format_covariance(covariance.joint_covariance(result), text)
    return {"identified.errors.csv": text, covariance.FILE_NAME: content}


def fit_files(result: FitResult) -> dict[str, str]:
    """Return the texts of ``fitted.errors.csv`` and ``fit.json``."""
    return {
        "fitted.errors.csv": format_errors(result.errors),
        "fit.json": json.dumps(result.to_dict(), indent=2) + "\n",
    }


def write_all(folder: str | Path, files: Mapping[str, str | bytes]) -> dict[str, Path]:
    """Write a set of files together, all or none."""
    output = OutputFolder(folder)
    for name, text in files.items():
        output.add(name, text)
    return output.commit()


def export_and_verify(
    machine: Machine,
    fitted: ErrorTable,
    identified: ErrorTable,
    controller: str,
    folder: str | Path,
    *,
    limits: SafetyLimits | None = None,
    **export_options: Any,
) -> ControllerResult:
    """Export, write to a temporary folder, read the bytes back from there, verify, and only then write to ``folder``.

    The verification moves the exact model with the ``identified`` errors, not with the fitted ones that made the
    tables. Files that are not accepted are written as ``NOT-ACCEPTED-...``; what the export itself could not hold (a
    limit that binds) is a reason too.
    """
    OutputFolder(folder)
    exported = export(machine, fitted, controller, **export_options)
    reversal: ReversalCurves | None = export_options.get("reversal")
    verification = verified_export(machine, exported, identified, reversal, limits)
    beside = check_files(machine, exported, identified, export_options.get("templates"), reversal)
    return _write_results(OutputFolder(folder), {"": (exported, verification, beside)})[0][0]


def verified_export(
    machine: Machine,
    exported: Export,
    identified: ErrorTable,
    reversal: ReversalCurves | None = None,
    limits: SafetyLimits | None = None,
    known: covariance.Covariance | None = None,
) -> Verification:
    """Verify what stands in the files after they were written; InputError if they cannot be read.

    What the export itself could not hold (a limit that binds) is a reason too.
    """
    with working_folder() as staging:
        written = exported.write(staging, accepted=True)
        try:
            tables = read_tables(machine, written, exported.controller)
        except InputError as error:
            name = Path(error.file).name if error.file else None
            message = f"the rendered file cannot be read back, so its template is wrong: {error.message}"
            raise InputError(message, file=name, line=error.line) from error
        result = verify(machine, tables, identified, reversal=reversal, limits=limits, covariance=known)
        return replace(result, reasons=tuple(dict.fromkeys([*result.reasons, *exported.violations])))


def _with_objections(verification: Verification, identification: Identification, *, allow_misfit: bool) -> Verification:
    """Add what speaks against the measurement; what blocks is a reason against the tables, too."""
    before, after = verification.before_rigid_removed, verification.after_rigid_removed
    taken = taken_away_um(before.rms_um, after.rms_um) if verification.accepted else None  # else the tables are wrong
    found = measurement_objections(identification, taken, allow_misfit=allow_misfit)
    reasons = [*verification.reasons, *blocking_reasons(found)]
    return replace(verification, objections=found, reasons=tuple(dict.fromkeys(reasons)))


def _diagnosis_of(machine: Machine, measurements: Sequence[str | Path], folder: str | Path) -> str:
    """Return the command that looks for what the model lacks."""
    source = machine.name if machine.source is None else str(machine.source)
    words = ["volcomp", "diagnose", source, *map(str, measurements), "--out", str(Path(folder) / "diagnosis")]
    return shlex.join(words)


def identify_bare(
    machine: Machine,
    measurement: Measurement | ErrorTable,
    options: IdentifyOptions | None = None,
    active: ActiveTables | None = None,
) -> Identification:
    """Identify the machine without the tables that were active while it was measured, if there were any.

    Errors that another program identified are taken as they are given.

    What was taken out stands in ``corrections["active_tables"]`` of the result.
    """
    if active is None and isinstance(measurement, ErrorTable):
        return given_errors(machine, measurement)
    if active is None and not isinstance(measurement, ErrorTable):
        return identify_measurement(machine, measurement, options)
    if active is None or not isinstance(measurement, Lengths | Deviations):
        raise InputError(
            "tables that were active (--active) can be taken out of lengths and deviations only; measure anything else with "
            "the compensation off, and say so (no --active; in `volcomp recal` active_table = none or measured_with = bare)"
        )
    wider, moved, report = without_active(machine, measurement, active)
    result = identify_measurement(wider, moved, options)
    return replace(result, corrections={**result.corrections, "active_tables": report})


def _write_results(
    output: OutputFolder, checked: Mapping[str, tuple[Export, Verification, Mapping[str, str]]]
) -> tuple[list[ControllerResult], tuple[Path, ...]]:
    """Write what is in ``output`` and the tables of all controls, by sub-folder, together: all files or none.

    Returns
    -------
    tuple
        the result of each control, and where the report of the tables that were there before is kept.
    """
    results = []
    for sub_folder, (exported, verification, beside) in checked.items():
        prefix = "" if verification.accepted else REJECTED_PREFIX
        verification = replace(
            verification, files=tuple((prefix + name, digest) for name, digest in verification.files)
        )
        files = {**beside, **verification_files(verification)}
        names = exported.add_to(output, sub_folder, accepted=verification.accepted, beside=files)
        paths = tuple(output.folder / name for name in names)
        results.append(ControllerResult(exported, verification, paths))
    earlier_report = set_aside_superseded(output, list(checked))
    output.commit()
    return results, tuple(earlier_report)


@contextmanager
def failure_reported(folder: str | Path) -> Iterator[None]:
    """Write ``identify.json`` where the data do not determine the errors, or no optimum is found, and pass the error on.

    No error curve is written then; ``identified`` is false and the file gives the reason. A folder with the results of
    an earlier run is left as it is: a mixture of both would be taken for one result.
    """
    try:
        yield
    except (UndeterminedError, ConvergenceError) as error:
        if any((Path(folder) / name).exists() for name in ("identify.json", "identified.errors.csv", "manifest.json")):
            text = f"{folder}: nothing was written; the folder still has the results of an earlier run"
            warnings.warn(text, CompgenWarning, stacklevel=3)
            raise
        combinations = list(getattr(error, "combinations", []))
        report = {"identified": False, "error": str(error), "unobservable": combinations}
        write_all(folder, {"identify.json": json.dumps(report, indent=2) + "\n"})
        raise


def run(
    machine: Machine,
    measurements: Sequence[str | Path],
    controllers: Sequence[str],
    folder: str | Path,
    *,
    identify_options: IdentifyOptions | None = None,
    fit_options: FitOptions | None = None,
    templates: Path | None = None,
    allow_unverified: bool = False,
    progress: Progress = lambda _: None,
    **checks: Unpack[Checks],
) -> RunResult:
    """Run the whole chain and write everything to ``folder``, after the last step that may find bad input.

    Parameters
    ----------
    machine : the machine.
    measurements : ``*.lengths.csv``, ``*.deviations.csv``, ``*.sixdof.csv`` files.
    controllers : names of the controls; with one its files stand in ``folder``, with several each has its own
        sub-folder.
    folder : output folder.
    identify_options, fit_options, templates, allow_unverified : handed to the stages.
    progress : is told the name of each stage as it begins.
    checks : ``active``, tables that were active while the machine was measured (the new ones take their place),
        ``limits`` for the steps of the tables, and ``instrument``, the instrument file of six-DOF readings. Where these
        contradict the machine's chain, nothing is accepted. With ``allow_misfit`` residuals that are too large, or that a
        step or a drift explains, are a reservation, and no reason to refuse the tables.
    """
    sub_folders = {name: name if len(set(controllers)) > 1 else "" for name in controllers}
    if not sub_folders:
        raise InputError("no controller was given; name at least one")
    for name, sub_folder in sub_folders.items():  # wrong settings are found before the work begins
        OutputFolder(Path(folder) / sub_folder)
        controller_named(name).read_settings(machine)
        usable_format(name, templates, allow_unverified=allow_unverified)
    progress("reading the measurement")
    measurement = open_measurement(measurements, checks.get("instrument"))
    provenance = provenance_of(machine.source, *measurements, checks.get("instrument"))
    progress(f"identifying: {describe(measurement)}")
    with failure_reported(folder):
        identification = identify_bare(machine, measurement, identify_options, checks.get("active"))
    progress("fitting smooth curves")
    known = None if not identification.has_covariance else covariance.joint_covariance(identification)
    fitted = fit(machine, identification.errors, fit_options or FitOptions(), covariance=known)
    reversal = identified_reversal(identification)
    checked: dict[str, tuple[Export, Verification, Mapping[str, str]]] = {}
    for name, sub_folder in sub_folders.items():
        progress(f"exporting, reading back and verifying: {name}")
        exported = export(
            machine,
            fitted.errors,
            name,
            templates=templates,
            allow_unverified=allow_unverified,
            provenance=provenance,
            reversal=reversal,
        )
        verification = verified_export(machine, exported, identification.errors, reversal, checks.get("limits"), known)
        verification = _with_objections(verification, identification, allow_misfit=checks.get("allow_misfit", False))
        if any(item.code in MISFIT_CODES for item in verification.objections):
            verification = replace(verification, next_command=_diagnosis_of(machine, measurements, folder))
        beside = check_files(machine, exported, identification.errors, templates, reversal)
        checked[sub_folder] = exported, verification, beside
    evidence = evidence_files(machine, measurement, identification)
    output = OutputFolder(folder)
    add_identification(output, {**identification_files(identification, provenance), **fit_files(fitted), **evidence})
    results, earlier_report = _write_results(output, checked)
    return RunResult(identification, fitted, tuple(results), earlier_report)
