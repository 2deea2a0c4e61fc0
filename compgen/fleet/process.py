"""One measurement through the pipeline, judged by the acceptance policy against the active tables.

:func:`process` runs the pipeline in a temporary folder and returns what is to be stored. The ``judge_...`` functions
are the rules of the policy: each adds reasons to hold the tables back, with their figures, to a :class:`Judgement`.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen.data.error_table import ErrorTable
from compgen.data.files import FOLDERS, named_below, naming_below, read_bytes, working_folder
from compgen.data.lengths import Points
from compgen.data.machine import Machine, load_machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import CompgenWarning
from compgen.fleet.change import (
    SOUND,
    STATE_NOW,
    Calibration,
    Change,
    calibrations_before,
    change_between,
    change_since,
    mean_temperatures,
)
from compgen.fleet.decisions import active_table
from compgen.fleet.evidence import tables_read
from compgen.fleet.inbox import holds_one_of, whose
from compgen.fleet.job import MachineJob, Policy
from compgen.fleet.records import (
    HELD_BACK,
    RESERVATION,
    IdentificationRecord,
    MachineRecord,
    MeasurementRecord,
    NewResult,
    StoredTableFile,
    active_of,
    comparable,
)
from compgen.fleet.store import Store, counting
from compgen.fleet.tables_on import (
    Case,
    Judgement,
    Past,
    judge_likeness,
    judge_states,
    judge_tables_on,
    removed_tables,
    span_of,
    what_it_held,
)
from compgen.identification import IdentifyOptions, joint_covariance
from compgen.identification.covariance import FILE_NAME as COVARIANCE
from compgen.identification.covariance import Covariance, covariance_or_independent
from compgen.pipeline import RunResult, identified_reversal, run
from compgen.tables import ReadTables, program_version, verify
from compgen.tables.active import ActiveTables, difference
from compgen.tables.judge import SafetyLimits
from compgen.tables.verification import MISFIT_CODES

if TYPE_CHECKING:
    from compgen.identification.heat_of_readings import HeatSource

#: A measurement dated further in the future than this has a wrong time.
FUTURE = timedelta(days=1)


@dataclass(frozen=True)
class ActiveState:
    """The tables that are active now: parsed, by control; their version; and the errors they were made from."""

    version: int
    tables: Mapping[str, ReadTables]
    identification: IdentificationRecord

    @classmethod
    def of(cls, case: Case) -> ActiveState | None:
        """Return the active state of the case's machine, None if no tables are active."""
        on = active_of(case.past.tables)
        if on is None:
            return None
        read = {control: tables_read(case.store, case.machine, on, control) for control in on.controllers}
        known = {control: found for control, found in read.items() if found is not None}
        return cls(on.version, known, case.store.identification(on.identification_id))


def judge_measurement(
    judgement: Judgement, policy: Policy, measurement: MeasurementRecord, now: datetime, latest: datetime | None
) -> None:
    """Check age and temperature; ``latest`` is the time of the newest measurement behind an active table."""
    age = now - measurement.measured_at
    judgement.figures["age_days"] = age.total_seconds() / 86400.0
    if age < -FUTURE:
        judgement.hold.append(f"the measurement is dated {_day(measurement.measured_at)}, which is in the future")
    elif policy.max_age_days is not None and age > timedelta(days=policy.max_age_days):
        days = judgement.figures["age_days"]
        judgement.hold.append(f"the measurement is {days:.1f} days old; at most {policy.max_age_days:g} are allowed")
    if latest is not None and measurement.measured_at < latest:
        judgement.hold.append(f"the active tables come from a newer measurement ({_day(latest)})")
    if policy.temperature_c is not None:
        judgement.hold += _temperature(policy.temperature_c, measurement.temperatures_c)


def judge_misfit(judgement: Judgement, result: RunResult) -> None:
    """Hold back tables with a large misfit, and note what else keeps the verdict from a plain "accepted".

    A person may approve despite a misfit, as `--allow-misfit` does, and tables of which it is doubtful that they make the
    machine better; residuals that only exceed their uncertainty are shown.
    """
    for item in result.results:
        found = item.verification
        if not found.accepted:
            continue
        waits = (*MISFIT_CODES, "doubtful")
        misfit = [objection.text for objection in found.objections if objection.code in waits]
        judgement.hold += [text for text in misfit if text not in judgement.hold]
        measured = found.objections or not found.volumetric or found.worse_as_it_stands
        if measured and not misfit:
            judgement.reservations.append(f"{RESERVATION}{found.controller}: {found.headline}")


def judge_order(judgement: Judgement, case: Case) -> None:
    """Hold a measurement older than a waiting proposal, so that it does not replace that proposal."""
    for table in case.past.tables:
        if table.state == "pending":
            made = case.store.identification(table.identification_id).measured_at
            if case.measurement.measured_at < made:
                judgement.hold.append(
                    f"version {table.version} waits for approval and comes from a newer measurement ({_day(made)})"
                )


def judge_twins(judgement: Judgement, case: Case) -> None:
    """Hold files that also arrived for another machine: readings belong to one machine."""
    store, job = case.store, case.job
    found = [f"{name} ({what})" for name, what in store.same_files_of_others(case.record, case.measurement)]
    contents = store.contents_of(case.measurement)
    for other in job.others:
        if not any(text.startswith(f"{other.name} (") for text in found) and holds_one_of(other, contents.values()):
            where = "the same inbox" if other.inbox.resolve() == job.inbox.resolve() else "its inbox"
            found.append(f"{other.name} ({where})")
    if found:
        judgement.figures["also_came_for"] = found
        judgement.hold.append(
            f"the same file also came for {', '.join(found)}; readings belong to one machine. Give each machine an inbox of "
            "its own and remove the file from the wrong one; then reject the version of the wrong machine with `volcomp "
            "recal reject` and approve that of the right one with --override"
        )


def judge_identity(judgement: Judgement, case: Case, contents: Mapping[str, bytes]) -> None:
    """Hold readings that say they are of another machine, or of one with another serial number.

    Comments have to fit; what users of other programs type into the head of a file counts if it names another machine.
    """
    comments, heads = whose(contents)
    job, machine = case.job, case.machine
    name, files = job.name.casefold(), [path for path in (machine.source, Path(job.machine)) if path is not None]
    others = {item.name.casefold() for item in case.store.machines()} - {name}
    own = {name, *({text.casefold() for text in (machine.name, *(path.stem for path in files))} - others)}
    named = [text for key in ("machine", "machine_name") for text in comments.get(key, [])]
    named += [text for text in heads.get("machine", []) if text.casefold() in others]
    for text in dict.fromkeys(named):
        if text.casefold() not in own:
            judgement.hold.append(
                f"the file says that it is of machine {text}, but it came for {job.name} (machine file: {machine.name}). If it "
                "is of another machine, move it to the inbox of that one and reject this version; if it is of "
                f"{job.name}, correct the comment, or approve with --override"
            )
    serials = comments.get("machine_serial", comments.get("machine_serial_number", heads.get("machine_serial", [])))
    _judge_serials(judgement, case, "machine", serials)
    if job.instrument is not None:  # whose constants are in a file of their own
        _judge_serials(judgement, case, "instrument", comments.get("serial_number", []))


def _judge_serials(judgement: Judgement, case: Case, what: str, serials: Sequence[str]) -> None:
    """Hold if a serial number is not that of the last measurement that gave one, and keep it for the next."""
    if not serials:
        return
    judgement.figures.setdefault(SERIALS, {})[what] = serials[0]
    known = [table.summary.get(SERIALS, {}).get(what) for table in case.past.tables if table.state != "rejected"]
    before = next((text for text in reversed(known) if text), serials[0])
    for text in serials:
        if text != before:
            judgement.hold.append(
                f"the file gives serial number {text} for the {what}, but earlier measurements {before}; if the {what} was "
                "exchanged, approve with --override"
            )


def _temperature(window_c: tuple[float, float], channels: Mapping[str, Mapping[str, float]]) -> list[str]:
    low, high = window_c
    if not channels:
        return [f"no temperature was logged, but the policy requires {low:g} to {high:g} degC"]
    outside: dict[str, list[str]] = {}
    for name, figures in channels.items():
        if figures["low"] < low or figures["high"] > high:
            outside.setdefault(f"went from {figures['low']:.2f} to {figures['high']:.2f} degC", []).append(name)
    allowed = f"{low:g} to {high:g} degC are allowed"
    return [f"{', '.join(names)} {went}; {allowed}" for went, names in outside.items()]


def _day(time: datetime) -> str:
    return time.isoformat(timespec="minutes")


def shows_all(judgement: Judgement, store: Store, result: RunResult, active: ActiveState) -> bool:
    """Whether the measurement shows every error that the active tables correct; otherwise the new ones would drop some.

    A laser along one axis shows only its positioning: tables made from that alone lose squareness, straightness and
    angular errors, and nothing in the measurement says so.
    """
    known = {*result.identification.errors.names}
    missing = [name for name in store.errors_of(active.identification).names if name not in known]
    if missing:
        judgement.figures["errors_not_shown"] = missing
        judgement.hold.append(
            f"the measurement does not show {', '.join(missing)}, which version {active.version} corrects and the new "
            "tables would not; measure them all"
        )
    return not missing


def _identified(result: RunResult) -> tuple[ErrorTable, Covariance | None]:
    """Return the errors of a run and their covariance, None if it is not known."""
    found = result.identification
    return found.errors, joint_covariance(found) if found.has_covariance else None


def judge_change(judgement: Judgement, case: Case, result: RunResult, active: ActiveState) -> Change | None:
    """Compare with the calibrations since those behind the active tables: the change must exceed what the machine repeats."""
    (errors, covariance), figures = _identified(result), result.identification.summary()
    new = covariance_or_independent(errors, covariance)
    old_errors = case.store.errors_of(active.identification)
    old = covariance_or_independent(old_errors, case.store.covariance_of(active.identification))
    if not comparable(figures, active.identification.summary):
        judgement.hold.append(_other_prior(case.job.name, active))
        return None
    if new is None or old is None:
        judgement.hold.append("the uncertainty of the errors is not known, so the change cannot be judged")
        return None
    measured, confidence = case.measurement, case.job.policy.confidence
    calibration = Calibration(measured.measured_at, errors, new, mean_temperatures(measured.temperatures_c))
    known, levels = calibrations_before(
        case.store, case.record, case.past.tables, active.identification, calibration, figures
    )
    corrected, machine = case.job.identify.get("temperature", True) is not False, case.machine
    # held for its age, as the history is of later times; or it shows more errors than were known before
    if measured.measured_at < active.identification.measured_at or STATE_NOW not in levels:
        change = change_between(machine, (errors, new), (old_errors, old), confidence)
    else:
        change = change_since(machine, [*known, calibration], [*levels, STATE_NOW], confidence, corrected=corrected)
    judgement.figures["change"] = change.summary()
    if not change.significant:
        judgement.hold.append(
            f"the change against version {active.version} ({change.rms_um:.2f} um rms) is within its uncertainty "
            f"({change.expected_rms_um:.2f} um rms expected, p = {change.p_value:.3f}, {1.0 - confidence:.2g} needed, "
            f"{change.known_from} earlier measurement{'s' if change.known_from > 1 else ''})"
            + (f"; most significant: {change.largest}" if change.largest else "")
        )
    return change


def _other_prior(name: str, active: ActiveState) -> str:
    """Say that uncertainties with and without a prior are not compared, and what to do."""
    without, record = active.identification.without_prior, active.identification
    return (
        f"the errors behind version {active.version} were identified {'without a' if without else 'with a'} prior, and these "
        f"{'with one' if without else 'without'}: the uncertainties cannot be compared, so the change cannot be judged; "
        f"`volcomp recal reprocess {name} --measurement {record.measurement_id} --reason TEXT` identifies the earlier "
        "measurement again, and `volcomp recal approve --override` accepts either version"
    )


def judge_tables(
    judgement: Judgement, machine: Machine, result: RunResult, new: Mapping[str, ReadTables], active: ActiveState
) -> None:
    """Compare the residuals of the new tables with those of the active ones now, and find how far the axes move."""
    remaining: dict[str, Any] = {}
    moved: dict[str, Any] = {}
    reversal = identified_reversal(result.identification)
    for item in result.results:
        control = item.verification.controller
        if control not in active.tables:
            continue
        now = verify(machine, active.tables[control], result.identification.errors, reversal=reversal)
        remaining[control] = {
            "active": {"as_it_stands": now.after.as_dict(), "rigid_removed": now.after_rigid_removed.as_dict()},
            "proposed": {
                "as_it_stands": item.verification.after.as_dict(),
                "rigid_removed": item.verification.after_rigid_removed.as_dict(),
            },
        }
        moved[control] = {"max_change_um": difference(machine, new[control], active.tables[control]).max_um}
    judgement.figures["remaining"] = remaining
    judgement.figures["correction"] = moved


def apply_limits(
    judgement: Judgement,
    machine: Machine,
    new: Mapping[str, ReadTables],
    active: Mapping[str, ReadTables],
    policy: Policy,
) -> None:
    """Hold back tables that do not shrink the residual, or move the axes by more than the limits."""
    moved = judgement.figures.setdefault("correction", {})
    for control, tables in new.items():
        shift = _at_reference(machine, tables, active.get(control))
        moved.setdefault(control, {})["reference_change_um"] = dict(zip("xyz", shift, strict=True))
        for axis, value in zip(AXES, shift, strict=True):
            if policy.max_reference_um is not None and abs(value) > policy.max_reference_um:
                judgement.hold.append(
                    f"{control}: the correction {axis} at the reference point changes by {value:+.1f} um; "
                    f"the limit is {policy.max_reference_um:g} um"
                )
        largest = moved[control].get("max_change_um")
        if largest is not None and policy.max_change_um is not None and largest > policy.max_change_um:
            judgement.hold.append(
                f"{control}: the correction changes by up to {largest:.1f} um; the limit is {policy.max_change_um:g} um"
            )
    for control, figures in judgement.figures.get("remaining", {}).items():
        before, after = (figures[key]["rigid_removed"]["rms_um"] for key in ("active", "proposed"))
        if not after < before - policy.min_shrink_um:
            judgement.hold.append(
                f"{control}: the residual does not shrink enough: {before:.2f} um rms with the active tables, {after:.2f} "
                "with the new ones"
            )


def _at_reference(machine: Machine, new: ReadTables, active: ReadTables | None) -> Sequence[float]:
    """Change of the correction at the reference point, um, x, y, z; the larger of the two directions of travel."""
    position = np.array([machine.reference_point_mm], dtype=np.float64)
    found = np.zeros(3)
    for side in (1.0, -1.0):
        points = Points(position, approach=np.full_like(position, side))
        shift = new.correction(machine, points)[0]
        if active is not None:
            shift = shift - active.correction(machine, points)[0]
        found = np.where(np.abs(shift) > np.abs(found), shift, found)
    return [float(value) / MM_PER_UM + 0.0 for value in found]


# --- the whole pipeline --------------------------------------------------------------------------------------------

#: Key in a version's figures: serial numbers of machine and instrument, as the measurement gives them.
SERIALS = "serial_numbers"
#: Files of a run that belong to the identification; with one control they share the folder of the control's files.
NOT_OF_A_CONTROL = (
    "identified.errors.csv",
    COVARIANCE,
    "identified.reversal.csv",
    "measured.deviations.csv",
    "stations.csv",
    "identify.json",
    "fitted.errors.csv",
    "fit.json",
)
#: Prefix of temporary folders; their names mean nothing to a reader.
FOLDER = "compgen-recal-"


@dataclass(frozen=True)
class Processed:
    """What is to be stored, and the id of the tables it was judged against."""

    result: NewResult
    judged_against: int | None


def process(
    store: Store, job: MachineJob, record: MachineRecord, measurement: MeasurementRecord, stated: str | None = None
) -> Processed:
    """Run the pipeline for one measurement and judge the outcome; writes only to a temporary folder.

    Parameters
    ----------
    stated : the tables that were on during the measurement, as stated by a person: a version or "none". It takes
        precedence over the file; None if not stated.

    Raises
    ------
    CompgenError
        for a measurement that cannot be used, or does not determine the errors.
    """
    started = time.monotonic()
    settings = job.settings_sha256()
    machine = load_machine(job.machine)
    if job.original is not None:  # the name used in manifest and messages
        machine = replace(machine, source=job.original, copy=machine.source)
    machine = replace(machine, repeatability=replace(machine.repeatability, **job.repeatability))
    past = _past_of(store, record)
    said = measurement.active_table if stated is None else stated
    evidence = next((item for item in reversed(store.evidence(record)) if item.measurement_id == measurement.id), None)
    contents = store.contents_of(measurement)
    held = what_it_held(store, machine, job, past, evidence)
    on = removed_tables(store, machine, job, measurement, past, said, held, by_person=stated is not None)
    case = Case(
        store=store,
        job=job,
        record=record,
        machine=machine,
        measurement=measurement,
        past=past,
        now=store.now(),
        said=said,
        by_person=stated is not None,
        evidence=evidence,
        held=held,
        span=span_of(measurement, contents),
        on=on,
    )
    with working_folder(FOLDER.removeprefix(FOLDERS)) as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", CompgenWarning)
        copies = (folder / "measurement", *job.copies)
        with naming_below(*copies):
            outcome = run(
                machine,
                write_files(copies[0], contents),
                job.controllers,
                folder / "out",
                identify_options=IdentifyOptions(**job.identify),
                templates=job.templates,
                allow_unverified=job.allow_unverified,
                active=None if on.tables is None else ActiveTables(on.tables),
                instrument=job.instrument,
                heat=_heat_of(job, machine),
                limits=SafetyLimits(job.policy.max_step_um),
                language=job.language,
                allow_misfit=True,  # a misfit that makes `run` refuse the tables holds them back here: judge_misfit
            )
        judgement = _judged(case, outcome, contents)
        told = [str(item.message) for item in caught if issubclass(item.category, CompgenWarning)]
        judgement.figures["warnings"] = [named_below(text, *copies) for text in told]
        result = _result(folder / "out", machine, outcome, judgement)
    kept = NewResult(
        **result,
        active_table_id=None if on.version is None else on.version.id,
        evidence="" if evidence is None else evidence.key,
        approve=job.approval == "auto",
        settings_sha256=settings,
        seconds=time.monotonic() - started,
    )
    now_active = active_of(past.tables)
    return Processed(kept, None if now_active is None else now_active.id)


def _heat_of(job: MachineJob, machine: Machine) -> HeatSource | None:
    """The model of heat and the temperatures that a job names; None if it names none."""
    if job.heat is None and job.temperatures is None:
        return None
    from compgen.identification.heat_of_readings import heat_source

    return heat_source(machine, job.heat, job.temperatures)


def confirmation(store: Store, job: MachineJob, record: MachineRecord, measurement: MeasurementRecord) -> str:
    """Return the key of a backup that came later and shows what a measurement was judged with; "" to judge it again.

    Tables that are held back are judged again in any case: the backup may be what they waited for.
    """
    evidence = next((item for item in reversed(store.evidence(record)) if item.measurement_id == measurement.id), None)
    made = [item for item in store.identifications(record) if item.measurement_id == measurement.id]
    if evidence is None or not made:
        return ""
    last, past = max(made, key=lambda item: item.revision), _past_of(store, record)
    tables = [table for table in past.tables if table.identification_id == last.id and table.state not in HELD_BACK]
    if not tables:
        return ""
    held = what_it_held(store, load_machine(job.machine), job, past, evidence)
    version = (
        None if isinstance(held, str | None) else next((t.id for t in past.tables if t.version == held.version), None)
    )
    none = not isinstance(held, str | None) and held.tables is None
    was_known = "evidence" not in tables[-1].summary and last.active_table_id == version
    return evidence.key if was_known and (version is not None or none) else ""


def again_of(store: Store, record: MachineRecord, measurement: MeasurementRecord) -> dict[str, Any]:
    """Return the fields of a result that say how often a measurement was identified, and why again."""
    done = [item for item in store.identifications(record) if item.measurement_id == measurement.id]
    if not done:
        return {}
    names = [item.names for item in store.evidence(record) if item.measurement_id == measurement.id]
    why = (
        f"{measurement.name} processed again with the backup {names[-1]}"
        if names
        else f"{measurement.name} processed again"
    )
    return {"revision": 1 + max(item.revision for item in done), "reason": why}


def _past_of(store: Store, record: MachineRecord) -> Past:
    return store.together(
        lambda moment: Past(
            moment.decisions(record), moment.tables(record), moment.measurements(record), moment.events(record)
        )
    )


def write_files(folder: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write files into a temporary folder and return their paths."""
    paths = []
    for name, content in contents.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        paths.append(path)
    return paths


# --- active tables -------------------------------------------------------------------------------------------------


def machine_now(
    store: Store, machine: MachineRecord, job: MachineJob
) -> tuple[Machine, ErrorTable, Covariance | None, ReadTables | None] | None:
    """Return a machine with its newest identified errors, those of the bare machine, and the tables that are active.

    Tables are those of the first control of the job. None if nothing was identified.
    """
    records = counting(store, machine)
    if not records:
        return None
    newest = records[-1]
    loaded, table = store.machine_of(newest), active_table(store, machine)
    tables = None if table is None else tables_read(store, loaded, table, job.controllers[0])
    return loaded, store.errors_of(newest), store.covariance_of(newest), tables


# --- judgement -----------------------------------------------------------------------------------------------------


def _judged(case: Case, result: RunResult, contents: Mapping[str, bytes]) -> Judgement:
    """Apply all rules, in the order in which a person reads their reasons."""
    judgement, active, policy = Judgement(), ActiveState.of(case), case.job.policy
    latest = None if active is None else active.identification.measured_at
    judge_measurement(judgement, policy, case.measurement, case.now, latest)
    new: dict[str, ReadTables] = {}
    for item in result.results:
        if item.verification.accepted:
            assert item.read is not None
            new[item.verification.controller] = item.read
    if active is not None and shows_all(judgement, case.store, result, active) and result.accepted:
        judge_change(judgement, case, result, active)
        judge_tables(judgement, case.machine, result, new, active)
    if result.accepted:
        apply_limits(judgement, case.machine, new, {} if active is None else active.tables, policy)
    judgement.figures["active_version"] = None if active is None else active.version
    judgement.figures["result"] = {item.verification.controller: item.verification.summary() for item in result.results}
    if not result.accepted:
        reasons = [reason for item in result.results for reason in item.verification.reasons]
        judgement.hold[:0] = list(dict.fromkeys(reasons))
    before, temperature_c = len(judgement.hold), policy.temperature_c
    judge_misfit(judgement, result)
    judge_tables_on(judgement, case)
    judge_likeness(judgement, case, _identified(result))
    judge_states(judgement, case, _identified(result))
    judge_twins(judgement, case)
    judge_identity(judgement, case, contents)
    doubted = len(judgement.hold) > before or bool(
        temperature_c and _temperature(temperature_c, case.measurement.temperatures_c)
    )
    judgement.figures[SOUND] = not doubted
    judge_order(judgement, case)
    return judgement


def _result(folder: Path, machine: Machine, outcome: RunResult, judgement: Judgement) -> dict[str, Any]:
    """Return the fields of a :class:`NewResult` that come from the pipeline, whose files are in ``folder``."""
    judgement.figures["tables"] = {item.verification.controller: list(item.export.files) for item in outcome.results}
    files: list[StoredTableFile] = []  # of every control, by their names below the control's folder
    for item in outcome.results:
        control = item.verification.controller
        root = folder / control if len(outcome.results) > 1 else folder
        names = sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
        files += [
            StoredTableFile(control, name, read_bytes(root / name)) for name in names if name not in NOT_OF_A_CONTROL
        ]
    covariance = folder / COVARIANCE
    assert machine.file is not None
    return {
        "machine_text": read_bytes(machine.file),
        "errors_text": read_bytes(folder / "identified.errors.csv"),
        "covariance": read_bytes(covariance) if covariance.is_file() else None,
        "fitted_text": read_bytes(folder / "fitted.errors.csv"),
        "summary": outcome.identification.summary(),
        "program": program_version(),
        "files": tuple(files),
        "accepted": outcome.accepted,
        "hold": tuple(judgement.hold),
        "reservations": tuple(judgement.reservations),
        "judgement": judgement.figures,
    }
