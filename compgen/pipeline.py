"""The whole chain: identify, fit, export, read back from disk, verify; for one or several controls."""

from __future__ import annotations

import json
import shlex
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen import effects, tables
from compgen.controls import controller_named
from compgen.data.arguments import names_of, of_kind, path_of, paths_of
from compgen.data.csv_files import FloatArray, format_csv
from compgen.data.error_table import (
    SIGNIFICANT,
    WORTH_MM,
    Curve,
    ErrorTable,
    ReversalCurves,
    format_errors,
    format_reversal,
)
from compgen.data.files import OutputFolder, Provenance, sha256_of_file, working_folder
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.drawing.display import Bars, Drawable, Overview, Panel
from compgen.errors import CompgenError, CompgenWarning, ConvergenceError, InputError, Message, UndeterminedError
from compgen.foreign.answers import ImportOptions
from compgen.foreign.heads import FileHead, heads_of
from compgen.foreign.opening import open_measurement
from compgen.identification import Identification, IdentifyOptions, covariance
from compgen.identification.any_measurement import (
    describe,
    evidence_files,
    identify_measurement,
    identify_mixed,
    known_alone,
)
from compgen.identification.kinds import Measurement, MixedMeasurement
from compgen.identification.options import StatedNumbers
from compgen.kinematics.kernel_switch import one_thread
from compgen.resources import LANGUAGES

if TYPE_CHECKING:
    from compgen.fitting import FitOptions, FitResult
    from compgen.identification.heat_of_readings import HeatSource
    from compgen.identification.monte_carlo import SelfCheck
    from compgen.identification.stated import Shown
    from compgen.planning.next_measurement import NextBest
    from compgen.tables import Export, ReadTables, SafetyLimits, Verification
    from compgen.tables.active import ActiveTables

Progress = Callable[[str], None]


@dataclass(frozen=True)
class ControllerResult:
    """Outcome for one control: what was exported, what the round trip on the written files says, and where they are.

    ``read`` are the tables as read back from the files.
    """

    export: Export
    verification: Verification
    paths: tuple[Path, ...]
    read: ReadTables | None = None


#: State of a control without tables, and the file in its folder that says why.
NO_TABLES, NOT_MADE = "no_tables", "NO-TABLES.txt"


@dataclass(frozen=True, repr=False)
class RunResult(Drawable):
    """Outcome of :func:`run`; ``accepted`` is True if every control's tables are.

    ``earlier_report`` is the path to which the report of the earlier tables in the folder was moved, ``next_best`` what to
    measure next; None where the readings determine every error. ``failed`` says, by name, why a control has no tables.

    Examples
    --------
    >>> import tempfile
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     result: compgen.RunResult = compgen.run(machine, ["examples/zha-gantry.lengths.csv"], ["isg-csv"], folder)
    >>> result
    <RunResult: isg-csv accepted>
    >>> result.results[0].verification.state
    'accepted'
    """

    identification: Identification
    fitted: FitResult
    results: tuple[ControllerResult, ...]
    earlier_report: tuple[Path, ...] = ()
    next_best: NextBest | None = None
    failed: Mapping[str, str] = field(default_factory=dict)

    @property
    def accepted(self) -> bool:
        """Whether all tables may be loaded."""
        return not self.failed and all(result.verification.accepted for result in self.results)

    def summary(self) -> dict[str, Any]:
        """Return the object that ``volcomp run --json`` prints; with one control its ``result.json`` plus the rest."""
        summaries = [item.verification.summary() for item in self.results]
        common = {
            "accepted": self.accepted,
            "identify": {**self.identification.summary(), **proposed_keys(self.next_best)},
            "paths": [str(path) for item in self.results for path in item.paths],
        }
        if len(summaries) == 1 and not self.failed:
            return {**summaries[0], **common}
        without = {
            name: {"controller": name, "accepted": False, "state": NO_TABLES, "reasons": [why]}
            for name, why in self.failed.items()
        }
        return {**common, "controllers": {**{item["controller"]: item for item in summaries}, **without}}

    def overview(self) -> Overview:
        """The verdict on the tables of each control."""
        checked = [item.verification for item in self.results]
        rows = tuple(
            (x.controller, f"{x.before.rms_um:.4g}", f"{x.after.rms_um:.4g}", x.state.replace("_", " "))
            for x in checked
        )
        title = "; ".join(f"{x.controller} {x.state.replace('_', ' ')}" for x in checked)
        return Overview(title, ("control", "before, rms (um)", "after, rms (um)", "verdict"), rows)

    def panels(self) -> Sequence[Panel]:
        """Root mean square of the error of the tool tip before and after, by control."""
        checked = [item.verification for item in self.results]
        names = tuple(item.controller for item in checked)
        before = Bars("before", names, tuple(item.before.rms_um for item in checked))
        after = Bars("after", names, tuple(item.after.rms_um for item in checked))
        return [Panel("error over the volume", "rms (um)", bars=(before, after))]


def provenance_of(*paths: str | Path | None) -> Provenance:
    """Return name and SHA-256 of the given files."""
    files = [Path(path) for path in paths if path is not None]
    return Provenance(tuple((path.name, sha256_of_file(path)) for path in files))


def next_measurements(result: Identification) -> NextBest | None:
    """Return what to measure next; None where the readings determine every error, and without a prior."""
    if "posterior_means" not in result.details or result.posterior is None:
        return None
    from compgen.planning.next_measurement import next_best

    return next_best(result.posterior)


def proposed_keys(found: NextBest | None) -> dict[str, Any]:
    """Return the keys ``next_measurements`` and ``next_text`` of ``identify.json`` and ``result.json``."""
    return {"next_measurements": [], "next_text": ""} if found is None else found.summary()


def identification_files(
    result: Identification,
    provenance: Provenance,
    checked: SelfCheck | None = None,
    proposed: NextBest | None = None,
    measured_with: Sequence[FileHead] = (),
) -> dict[str, str | bytes]:
    """Return the contents of ``identified.errors.csv`` and its covariance, ``stations.csv`` and ``identify.json``.

    ``proposed`` is what to measure next, ``measured_with`` what each file says beside its readings. Where a reversal was
    found, ``identified.reversal.csv`` is added. The two-step method adds ``measured.deviations.csv``; deviations as input
    give no stations.
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
    summary = {
        **result.summary(),
        **proposed_keys(proposed),
        "inputs": [{"name": name, "sha256": digest} for name, digest in provenance.inputs],
        "files": [head.summary() for head in measured_with],
    }
    text = format_errors(result.errors, {"covariance": covariance.FILE_NAME} if result.has_covariance else {})
    files: dict[str, str | bytes] = {"identified.errors.csv": text}
    if result.has_covariance:
        files[covariance.FILE_NAME] = covariance.format_covariance(covariance.joint_covariance(result), text)
    if stations:
        files["stations.csv"] = format_csv(columns, {"machine": result.errors.metadata.get("machine", "")})
    if result.positions is not None:
        from compgen.data.deviations import format_deviations

        files["measured.deviations.csv"] = format_deviations(result.positions)
    if checked is not None:
        summary["monte_carlo"] = checked.summary()
    reversal = identified_reversal(result)
    if reversal is not None:
        files["identified.reversal.csv"] = format_reversal(reversal)
    return {**files, "identify.json": json.dumps(summary, indent=2) + "\n"}


#: Files that only some identifications write.
SOME_WRITE = (
    "stations.csv",
    "measured.deviations.csv",
    "identified.reversal.csv",
    "residuals.csv",
    covariance.FILE_NAME,
)


def add_identification(output: OutputFolder, files: Mapping[str, str | bytes]) -> None:
    """Add the files of an identification; files of an earlier one that are not replaced are set aside.

    Otherwise the reversal or the covariance of one measurement would be mistaken for that of the next.
    """
    for name, content in files.items():
        output.add(name, content)
    for name in SOME_WRITE:
        if name not in files and (output.folder / name).is_file():
            output.set_aside(name)


def identified_reversal(result: Identification) -> ReversalCurves | None:
    """Return the reversals that are well above their uncertainty and worth a table; None if there are none.

    Those of other instruments and of typed numbers count before those that lengths show, to which the backlash of the
    machine file belongs that was removed from the readings.
    """
    machine, taken_out = result.layout.machine, result.corrections.get("effects", {})
    found = _of_stops(result)
    found = effects.with_effects_reversal(machine, found, taken_out) if taken_out else found
    if found is None or result.reversal_curves is None:
        return found or result.reversal_curves
    return ReversalCurves({**found.curves, **result.reversal_curves.curves}, result.reversal_curves.metadata)


def _of_stops(result: Identification) -> ReversalCurves | None:
    """Reversals that lengths show at stops which were approached from both sides."""
    # a reversal belongs to curves that are the mean of both directions, so the readings must refer to that mean
    if result.reversal is None or not result.reversal.removed:
        return None
    curves = {}
    for name, axis in result.reversal.axes.items():
        for component, (value, u) in enumerate(zip(axis.vector_mm, axis.u_mm, strict=True)):
            if abs(value) > SIGNIFICANT * u and abs(value) >= WORTH_MM:
                curves[AXES.index(name), component] = Curve(np.zeros(1), np.array([value]), np.array([u]))
    return ReversalCurves(curves, {"machine": result.errors.metadata.get("machine", "")}) if curves else None


def fit_files(result: FitResult, covariance_file: tuple[str, bytes] | None = None) -> dict[str, str]:
    """Return the texts of ``fitted.errors.csv`` and ``fit.json``.

    ``covariance_file`` is the one of the errors that were fitted, with its name beside the new files.
    """
    known = {} if covariance_file is None else covariance.uncertainty_of_fitted(*covariance_file)
    return {
        "fitted.errors.csv": format_errors(result.errors, known),
        "fit.json": json.dumps(result.to_dict(), indent=2) + "\n",
    }


def write_all(folder: str | Path, files: Mapping[str, str | bytes]) -> dict[str, Path]:
    """Write a set of files together, all or none."""
    output = OutputFolder(folder)
    for name, text in files.items():
        output.add(name, text)
    return output.commit()


def export_and_verify(  # noqa: PLR0913  (options by keyword)
    machine: Machine,
    fitted: ErrorTable,
    identified: ErrorTable,
    controller: str,
    folder: str | Path,
    *,
    templates: Path | None = None,
    allow_unverified: bool = False,
    provenance: Provenance | None = None,
    reversal: ReversalCurves | None = None,
    limits: SafetyLimits | None = None,
    known: covariance.Covariance | None = None,
) -> ControllerResult:
    """Export, write to a temporary folder, read the bytes back from there, verify, and only then write to ``folder``.

    The verification moves the exact model with the ``identified`` errors, not with the fitted ones that made the
    tables. Files that are not accepted are written as ``NOT-ACCEPTED-...``; what the export itself could not express
    (an active limit) is a reason, too. ``known`` is the covariance of the identified errors.
    """
    OutputFolder(folder)
    exported = tables.export(
        machine,
        fitted,
        controller,
        templates=templates,
        allow_unverified=allow_unverified,
        provenance=provenance,
        reversal=reversal,
    )
    read, verification = verified_export(machine, exported, identified, reversal, limits, known)
    exported = tables.with_known(exported, verification.known_lines)
    extra_files = tables.check_files(machine, exported, identified, templates, reversal, read=read, covariance=known)
    return _write_results(OutputFolder(folder), {"": (exported, read, verification, extra_files)})[0][0]


def verified_export(
    machine: Machine,
    exported: Export,
    identified: ErrorTable,
    reversal: ReversalCurves | None = None,
    limits: SafetyLimits | None = None,
    known: covariance.Covariance | None = None,
) -> tuple[ReadTables, Verification]:
    """Read the written files back and verify what they contain; InputError if they cannot be read.

    What the export itself could not express (an active limit) is a reason, too.
    """
    with working_folder() as staging, one_thread():
        output = OutputFolder(staging)
        names = exported.add_to(output, accepted=True)
        paths = output.commit()
        try:
            parsed = tables.read_tables(machine, [paths[name] for name in names], exported.controller)
        except InputError as error:
            name = Path(error.file).name if error.file else None
            message = f"the rendered file cannot be read back, so its template is wrong: {error.message}"
            raise InputError(message, file=name, line=error.line) from error
        result = tables.verify(machine, parsed, identified, reversal=reversal, limits=limits, covariance=known)
        return parsed, replace(result, reasons=tuple(dict.fromkeys([*result.reasons, *exported.violations])))


def identify_bare(
    machine: Machine,
    measurement: Measurement | ErrorTable,
    options: IdentifyOptions | None = None,
    active: ActiveTables | None = None,
) -> Identification:
    """Identify the machine without the tables that were active while it was measured, if there were any.

    Errors that another program identified are used as given. ``corrections["active_tables"]`` of the result says what
    was removed.
    """
    if active is None and not isinstance(measurement, ErrorTable | MixedMeasurement):
        return identify_measurement(machine, measurement, options)
    from compgen.data.axis_runs import AxisRuns
    from compgen.data.circles import Circles
    from compgen.data.deviations import Deviations
    from compgen.foreign.converted import given_errors
    from compgen.tables.active import without_active

    if active is None and isinstance(measurement, ErrorTable):
        return known_alone(machine, None, given_errors(machine, measurement), options or IdentifyOptions())
    if active is None and isinstance(measurement, MixedMeasurement):
        tables_of = {name: part for name, part in measurement.parts if isinstance(part, ErrorTable)}
        # the arms of a square count where nothing else shows a squareness
        whole = all(
            not part.squareness if isinstance(part, ErrorTable) else isinstance(part, AxisRuns)
            for _, part in measurement.parts
        )
        known = {name: given_errors(machine, table, whole=whole) for name, table in tables_of.items()}
        return identify_mixed(machine, measurement, options or IdentifyOptions(), known)
    if active is None or not isinstance(measurement, Lengths | Deviations | Circles):
        raise InputError(
            Message(
                "active-kind-not-possible",
                "active tables (--active) can be removed from lengths, deviations and circles only; "
                "measure anything else with the compensation off, and state it (no --active; in "
                "`volcomp recal` active_table = none or measured_with = bare)",
            )
        )
    wider, moved, report = without_active(machine, measurement, active)
    result = identify_measurement(wider, moved, options)
    return replace(result, corrections={**result.corrections, "active_tables": report})


def identify_warm(
    machine: Machine,
    measurement: Measurement | ErrorTable,
    heat: HeatSource | None,
    numbers: StatedNumbers,
    options: IdentifyOptions | None = None,
    active: ActiveTables | None = None,
) -> Identification:
    """Identify as :func:`identify_beside` at the reference state of heat, if temperatures of the readings are known.

    ``corrections["heat"]`` of the result says what was taken out, a CompgenWarning too.
    """

    def identified(readings: Measurement | ErrorTable) -> Identification:
        return identify_beside(machine, readings, numbers, options, active)

    if heat is None:
        return identified(measurement)
    from compgen.identification.heat_of_readings import at_reference_heat, identified_at_reference

    found = at_reference_heat(machine, measurement, heat)
    warnings.warn(found.says(), CompgenWarning, stacklevel=2)
    return identified_at_reference(found, identified)


def identify_beside(
    machine: Machine,
    measurement: Measurement | ErrorTable,
    numbers: StatedNumbers,
    options: IdentifyOptions | None = None,
    active: ActiveTables | None = None,
) -> Identification:
    """Identify as :func:`identify_bare`, beside numbers that were typed: they are adjusted together with what was measured.

    ``measurement`` has the squareness and scale of the numbers among its parts already.

    Raises
    ------
    InputError
        for a number that contradicts a measurement of the same, and for a reversal of which the sign is open.
    """
    if not (numbers.squareness or numbers.scale or numbers.backlash or isinstance(measurement, MixedMeasurement)):
        return identify_bare(machine, measurement, options, active)
    from compgen.identification import stated  # loaded only where it is needed

    if numbers.squareness or numbers.scale:
        alone = _measured_alone(machine, stated.without_stated(measurement), options, active)
        if alone is not None:
            stated.check_errors(numbers, alone, stated.u_scale_of_runs(machine, measurement))
    result = identify_bare(machine, measurement, options, active)
    if not (numbers.backlash or isinstance(measurement, MixedMeasurement)):
        return result
    shown = stated.shown_reversals(measurement, result)
    own = effects.effects_reversal(machine)
    stated.check_signs(numbers, {**shown, **({} if own is None else {axis: own for axis, _ in own.curves})})
    return with_reversal(stated.with_contradictions(result, shown), numbers.reversal(), shown)


def _measured_alone(
    machine: Machine,
    measurement: Measurement | ErrorTable | None,
    options: IdentifyOptions | None,
    active: ActiveTables | None,
) -> Identification | None:
    """Identify what was measured; None where that is not determined. What is to say is said elsewhere."""
    if measurement is None:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        try:
            return identify_bare(machine, measurement, options, active)
        except CompgenError:
            return None


def with_reversal(result: Identification, stated: ReversalCurves | None, shown: Shown | None = None) -> Identification:
    """Return the identification with reversals that were typed, each adjusted together with what was measured of it.

    Parameters
    ----------
    stated : reversals along axes; None for none.
    shown : those that were measured, by axis; None for those of the result.

    Raises
    ------
    InputError
        for a number that contradicts what was measured, or the machine file.
    """
    if stated is None:
        return result
    from compgen.identification.stated import joined_reversal, shown_reversals

    machine = result.layout.machine
    measured = shown_reversals(None, result) if shown is None else shown
    own = effects.effects_reversal(machine)
    curves = {} if result.reversal_curves is None else dict(result.reversal_curves.curves)
    for (axis, along), number in stated.curves.items():
        sources = measured.get(axis, ())
        if not sources and own is not None and (axis, along) in own.curves:
            sources = [("the machine file", own.curves[axis, along])]
        curves[axis, along] = joined_reversal(axis, number, sources)
    return replace(result, reversal_curves=ReversalCurves(curves, {"machine": machine.name}))


def _write_results(
    output: OutputFolder, checked: Mapping[str, tuple[Export, ReadTables, Verification, Mapping[str, str]]]
) -> tuple[list[ControllerResult], tuple[Path, ...]]:
    """Write what is in ``output`` and the tables of all controls, by sub-folder, together: all files or none.

    Returns
    -------
    tuple
        the result of each control, and the path to which the report of the earlier tables was moved.
    """
    results = []
    for sub_folder, (exported, read, verification, extra_files) in checked.items():
        prefix = "" if verification.accepted else tables.REJECTED_PREFIX
        verification = replace(
            verification, files=tuple((prefix + name, digest) for name, digest in verification.files)
        )
        files = {**extra_files, **tables.verification_files(verification)}
        names = exported.add_to(output, sub_folder, accepted=verification.accepted, beside=files)
        paths = tuple(output.folder / name for name in names)
        results.append(ControllerResult(exported, verification, paths, read))
    earlier_report = tables.set_aside_superseded(output, list(checked))
    output.commit()
    return results, tuple(earlier_report)


@contextmanager
def _apart(name: str, failed: dict[str, str], of: int) -> Iterator[None]:
    """Note why a control gets no tables, so that the others get theirs; the error of the last one that is left goes on."""
    try:
        yield
    except CompgenError as error:
        failed[name] = str(error)
        if len(failed) == of:
            raise
        warnings.warn(
            Message("control-no-tables", "{name}: no tables: {error}", name=name, error=error),
            CompgenWarning,
            stacklevel=3,
        )


def _add_failed(output: OutputFolder, failed: Mapping[str, str]) -> None:
    """Add a file with the reason to the folder of every control without tables; those of an earlier run are set aside."""
    for path in output.folder.glob(f"*/{NOT_MADE}") if output.folder.is_dir() else ():
        if path.parent.name not in failed:
            output.set_aside(f"{path.parent.name}/{NOT_MADE}")
    for name, why in failed.items():
        output.add(f"{name}/{NOT_MADE}", f"{why}\n")


@contextmanager
def failure_reported(folder: str | Path) -> Iterator[None]:
    """Write ``identify.json`` where the data do not determine the errors, or no optimum is found, and pass the error on.

    No error curve is written then; ``identified`` is false and the file gives the reason. A folder with the results of
    an earlier run is left unchanged: a mixture of both could be mistaken for one result.
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


def run(  # noqa: PLR0913  (the options of the whole chain, all by keyword)
    machine: Machine,
    measurements: Sequence[str | Path],
    controllers: Sequence[str],
    folder: str | Path,
    *,
    identify_options: IdentifyOptions | None = None,
    fit_options: FitOptions | None = None,
    templates: Path | None = None,
    allow_unverified: bool = False,
    active: ActiveTables | None = None,
    instrument: str | Path | None = None,
    stated: StatedNumbers | None = None,
    answers: ImportOptions | None = None,
    limits: SafetyLimits | None = None,
    allow_misfit: bool = False,
    language: str = LANGUAGES[0],
    progress: Progress = lambda _: None,
    beyond: Callable[[Identification], Identification] | None = None,
    heat: HeatSource | None = None,
) -> RunResult:
    """Run the whole chain and write everything to ``folder``, after the last step that may find bad input.

    Parameters
    ----------
    machine : the machine.
    measurements : files of any kinds, also of errors; what they determine together is identified.
    controllers : names of the controls; with one its files are in ``folder``, with several each has its own
        sub-folder.
    folder : output folder.
    identify_options, fit_options : how the errors are identified and the curves are fitted.
    templates : a folder of the user's own templates, searched before the shipped ones.
    allow_unverified : export formats that no public document fully describes.
    active : tables that were active during the measurement; the new ones replace them.
    instrument : the instrument file of six-DOF readings.
    stated : squareness, backlash and scales that are known without a file.
    answers : what files of other programs leave open, as the options of ``volcomp import``.
    limits : limits for the steps of the tables.
    allow_misfit : residuals that are too large, or that a step or a drift explains, are a reservation instead of a
        reason to refuse the tables.
    language : of the preflight list and the page of the check program, ``"en"`` or ``"de"``.
    progress : called with the name of each step when it begins.
    beyond : adds to the identified errors what was measured with the rotary axes of the machine.
    heat : temperatures of the readings, and the model that tells what they have moved.

    Raises
    ------
    InputError
        for files and settings that are missing or wrong; nothing is written.
    UndeterminedError, ConvergenceError
        if the readings do not determine the errors, or no optimum is found; ``identify.json`` gives the reason.

    Examples
    --------
    >>> import tempfile
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     result = compgen.run(machine, ["examples/zha-gantry.lengths.csv"], ["isg-csv"], folder)
    ...     names = sorted(path.name for path in result.results[0].paths)
    >>> result.accepted
    True
    >>> [name for name in names if name.startswith("volcomp0")]
    ['volcomp0.csv', 'volcomp0.lis']
    """
    from compgen.fitting import FitOptions, fit

    of_kind("machine", machine, Machine)
    measurements, controllers = paths_of("measurements", measurements), names_of("controllers", controllers)
    path_of("folder", folder)
    sub_folders = {name: name if len(set(controllers)) > 1 else "" for name in controllers}
    if not sub_folders:
        raise InputError(Message("no-controller", "no controller was given; give at least one"))
    for name, sub_folder in sub_folders.items():
        OutputFolder(Path(folder) / sub_folder)
        controller_named(name)
    failed: dict[str, str] = {}
    for name in sub_folders:  # wrong settings are found before the work begins
        with _apart(name, failed, len(sub_folders)):
            controller_named(name).read_settings(machine)
            tables.usable_format(name, templates, allow_unverified=allow_unverified)
    progress("reading the measurement")
    numbers = stated or StatedNumbers()
    numbers.reversal()  # wrong numbers are found before the work begins
    measurement = open_measurement(measurements, instrument, stated=numbers.errors(machine), answers=answers)
    warm = () if heat is None else heat.inputs
    provenance = provenance_of(machine.file, *measurements, instrument, *warm)
    progress(f"identifying: {describe(measurement)}")
    with failure_reported(folder):
        identification = identify_warm(machine, measurement, heat, numbers, identify_options, active)
        identification = identification if beyond is None else beyond(identification)
    progress("fitting smooth curves")
    known = None if not identification.has_covariance else covariance.joint_covariance(identification)
    smoothing = fit_options or FitOptions()
    if smoothing.smoothness is None and (
        "tied_nodes_mm" in identification.details or identification.details.get("posterior_means")
    ):
        # of few readings the curves are strongly correlated: each smoothed alone, they would no longer fit together; the
        # mean of a posterior is as smooth as the prior lets expect
        smoothing = replace(smoothing, smoothness=0.0)
    fitted = fit(machine, identification.errors, smoothing, covariance=known)
    reversal = identified_reversal(identification)
    proposed = next_measurements(identification)
    source = str(machine.source or machine.name)  # for the command that searches for the missing effect
    words = ["diagnose", source, *map(str, measurements), "--out", str(Path(folder) / "diagnosis")]
    diagnosis = shlex.join(["volcomp", *words])
    checked: dict[str, tuple[Export, ReadTables, Verification, Mapping[str, str]]] = {}
    for name, sub_folder in sub_folders.items():
        if name in failed:
            continue
        with _apart(name, failed, len(sub_folders)):
            progress(f"exporting, reading back and verifying: {name}")
            exported = tables.export(
                machine,
                fitted.errors,
                name,
                templates=templates,
                allow_unverified=allow_unverified,
                provenance=provenance,
                reversal=reversal,
                language=language,
            )
            read, verification = verified_export(machine, exported, identification.errors, reversal, limits, known)
            # findings on the measurement; those that block are also reasons against the tables
            before, after = verification.before_rigid_removed, verification.after_rigid_removed
            taken = (
                tables.taken_away_um(before.rms_um, after.rms_um) if verification.accepted else None
            )  # else they are wrong
            found = tables.measurement_objections(identification, taken, allow_misfit=allow_misfit)
            reasons = dict.fromkeys([*verification.reasons, *tables.blocking_reasons(found)])
            verification = replace(
                verification,
                objections=(*verification.objections, *found),
                reasons=tuple(reasons),
                remarks=identification.notes,
                proposed=proposed_keys(proposed),
            )
            if any(item.code in tables.MISFIT_CODES for item in verification.objections):
                verification = replace(verification, next_command=diagnosis)
            extra_files = tables.check_files(
                machine, exported, identification.errors, templates, reversal, language, read, known
            )
            exported = tables.with_known(exported, verification.known_lines, language)
            checked[sub_folder] = exported, read, verification, extra_files
    evidence = evidence_files(machine, measurement, identification)
    output = OutputFolder(folder)
    heads = heads_of(measurements)
    identified = identification_files(identification, provenance, proposed=proposed, measured_with=heads)
    covered = identified.get(covariance.FILE_NAME)
    own = (covariance.FILE_NAME, covered) if isinstance(covered, bytes) else None
    add_identification(output, {**identified, **fit_files(fitted, own), **evidence})
    _add_failed(output, failed)
    results, earlier_report = _write_results(output, checked)
    return RunResult(identification, fitted, tuple(results), earlier_report, proposed, failed)
