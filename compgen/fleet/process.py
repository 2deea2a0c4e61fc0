"""One measurement through the pipeline, judged by the acceptance policy against the active tables.

:func:`process` runs the pipeline in a temporary folder and returns what is to be stored. The ``judge_...`` functions
are the rules of the policy: each adds reasons to hold the tables back, with their figures, to a :class:`Judgement`.
"""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.files import FOLDERS, read_bytes, working_folder
from compgen.data.lengths import Points
from compgen.data.machine import Machine, load_machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import CompgenWarning, InputError
from compgen.fleet.change import Change, change_between, likeness, volume_points
from compgen.fleet.decisions import active_table
from compgen.fleet.inbox import holds_one_of
from compgen.fleet.job import MachineJob, Policy
from compgen.fleet.records import (
    AFTER,
    RESERVATION,
    DecisionRecord,
    EventRecord,
    IdentificationRecord,
    MachineRecord,
    MeasurementRecord,
    NewResult,
    StoredTableFile,
    TableRecord,
    active_id,
    active_of,
)
from compgen.fleet.store import Store, counting
from compgen.identify import IdentifyOptions, joint_covariance
from compgen.identify.covariance import FILE_NAME as COVARIANCE
from compgen.identify.covariance import Covariance, covariance_or_independent
from compgen.pipeline import RunResult, identified_reversal, run
from compgen.tables import ReadTables, parse_tables, program_version, verify
from compgen.tables.active import ActiveTables, difference
from compgen.tables.judge import SafetyLimits
from compgen.tables.verification import MISFIT_CODES

#: A measurement dated further in the future than this has a wrong time.
FUTURE = timedelta(days=1)
#: A clock that was not set to daylight-saving time, or back, is wrong by this in addition to what clocks differ by.
DAYLIGHT_SAVING = timedelta(hours=1)
#: Kinds of events: the store's clock went back; a machine's folder was given to this store.
CLOCK, ADOPTED = "clock", "adopted"
#: Key in a version's figures: which tables were on, as stated by a file or a person.
STATED = "active_table_stated"


@dataclass
class Judgement:
    """Reasons to hold tables back, reservations that are only shown, and figures by name; each rule adds to them."""

    hold: list[str] = field(default_factory=list)
    reservations: list[str] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Past:
    """Everything the store knows about a machine: decisions, tables with figures, measurements, events."""

    decisions: Sequence[DecisionRecord]
    tables: Sequence[TableRecord]
    measurements: Sequence[MeasurementRecord]
    events: Sequence[EventRecord]

    @property
    def swaps(self) -> list[DecisionRecord]:
        """Decisions that changed the active tables since the folder was given to this store."""
        return [item for item in self.decisions if AFTER[item.kind] == "active" and item.at >= self._since]

    @property
    def stated(self) -> str | None:
        """Latest statement of which tables were on, by a file or a person, since this store got the folder."""
        said = [(item.received_at, item.active_table) for item in self.measurements if item.active_table is not None]
        said += [(item.at, str(item.summary[STATED])) for item in self.tables if STATED in item.summary]
        return max((item for item in said if item[0] >= self._since), default=(None, None))[1]

    @property
    def _since(self) -> datetime:
        adopted = [item.at for item in self.events if item.kind == ADOPTED]
        return max(adopted, default=datetime.min.replace(tzinfo=UTC))


@dataclass(frozen=True)
class Case:
    """One measurement to be judged: the job of its machine, what the store knows of the machine, the current time.

    ``said`` states which tables were on during the measurement, by a person or the file, None if neither states it;
    ``taken`` are the tables whose effect is removed from the readings, None if none were on.
    """

    store: Store
    job: MachineJob
    record: MachineRecord
    machine: Machine
    measurement: MeasurementRecord
    past: Past
    now: datetime
    said: str | None
    taken: TableRecord | None

    @property
    def version_taken(self) -> int | None:
        """Version of the tables whose effect is removed."""
        return None if self.taken is None else self.taken.version


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
        read = {control: _tables_read(case.store, case.machine, on, control) for control in on.controllers}
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

    A person may approve despite a misfit, as `--allow-misfit` does; residuals that only exceed their uncertainty are
    shown.
    """
    for item in result.results:
        found = item.verification
        if not found.accepted:
            continue
        misfit = [objection.text for objection in found.objections if objection.code in MISFIT_CODES]
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


# --- which tables were on while the machine was measured --------------------------------------------------------------


def judge_assumption(judgement: Judgement, case: Case) -> None:
    """Hold if the time of the measurement does not determine which tables were on.

    Only for a measurement that does not state it, on a machine that is measured with its tables on. A wrong assumption
    enters the errors in full: the new tables then undo the compensation, or apply it twice.
    """
    job, measurement, past, taken = case.job, case.measurement, case.past, case.version_taken
    swaps, margin = past.swaps, timedelta(minutes=job.policy.clock_minutes)
    if not swaps:
        said = past.stated
        if said is None or version_said(said) != taken:
            judgement.hold.append(
                "the store does not know which tables were on while the machine was measured: it has never made tables of "
                f"{job.name} active. If none were on: {how_to_state(job.name, measurement, 'none')}; if tables were on, "
                "switch them off and measure again"
            )
        return
    doubts = []
    if measurement.measured_at_source == "file time":
        doubts.append("the file does not state when it was measured, and the time of a file changes when it is copied")
    elif measurement.measured_at_source == "file, no zone":
        doubts.append("the time of the measurement has no zone")
    for before, swap in zip([None, *swaps], swaps, strict=False):
        since = None if before is None else before.at
        away = abs(measurement.measured_at - swap.at)
        near = away < margin
        hour_off = bool(margin) and not near and away < margin + DAYLIGHT_SAVING
        inside = (
            since is None or since - margin < measurement.measured_at
        ) and measurement.measured_at < swap.at + margin
        if near or hour_off:
            minutes, needed = away / timedelta(minutes=1), job.policy.clock_minutes
            required = f"{needed:g} min are required, because clocks differ"
            if hour_off:
                required = f"{needed:g} min and an hour are required: a clock may be off by daylight-saving time, too"
            doubts.append(
                f"it was measured {minutes:.0f} min from the decision of {_day(swap.at)} that changed the active tables; "
                f"{required}"
            )
        elif inside and _doubtful(swap, past, case.now):
            doubts.append(f"the clock went back, so the time of the decision of {_day(swap.at)} is not certain")
    if doubts:
        judgement.hold.append(
            "it is not certain which tables were on while the machine was measured (assumed: "
            f"{'none' if taken is None else f'version {taken}'}): "
            f"{'; '.join(dict.fromkeys(doubts))}; {how_to_state(job.name, measurement, 'VERSION|none')}"
        )


def version_said(text: str) -> int | str | None:
    """Return the version that ``active_table`` names, None for "none" or "bare", any other text unchanged."""
    word = text.lower()
    number = word.removeprefix("v")
    return None if word in ("none", "bare") else int(number) if number.isdecimal() and number.isascii() else text


def how_to_state(name: str, measurement: MeasurementRecord, tables: str) -> str:
    """Tell a person how to state which tables were on; ``tables`` is a version, "none" or a placeholder for either."""
    return (
        f"state it: `volcomp recal reprocess {name} --measurement {measurement.id} --active-table {tables} --reason TEXT`, "
        f"or `# active_table = {tables}` in the next file"
    )


def _doubtful(decision: DecisionRecord, past: Past, now: datetime) -> bool:
    """Whether the clock was ahead at this decision: a later entry has an earlier time."""
    if decision.at > now:
        return True
    if any(item.at < decision.at <= _seen(item) for item in past.events if item.kind == CLOCK):
        return True
    known = {item.table_id for item in past.decisions if item.sequence <= decision.sequence}
    return any(table.at < decision.at for table in past.tables if table.id not in known)


def _seen(event: EventRecord) -> datetime:
    """Time of the newest entry when the clock was found to have gone back, read from the end of the message."""
    try:
        return datetime.fromisoformat(event.message.rsplit(" ", 1)[-1]) + timedelta(seconds=1)
    except ValueError:
        return event.at


def judge_likeness(judgement: Judgement, case: Case, result: RunResult) -> None:
    """Hold if the machine seems to have changed by what some tables add, or by its opposite.

    The change is relative to the errors behind the active tables, or the last active ones; it is compared with what
    each version that is or was active adds.
    """
    machine, taken = case.machine, case.version_taken
    were_active, last = _were_active(case)
    if last is None:
        return
    old_errors = case.store.errors_of(last)
    if not set(old_errors.names) <= set(result.identification.errors.names):
        return  # already held for that; an incomplete set of errors has no field to compare
    added, missing = _added(case, were_active)
    old = (old_errors, case.store.covariance_of(last))
    found = likeness(machine, _identified(result), old, added, missing)
    if found is None:
        return
    judgement.figures["likeness"] = found.summary()
    assumed = "no tables were" if taken is None else f"version {taken} was"
    seems, what = ("was on", "what") if found.sign > 0 else ("was off", "the opposite of what")
    version = f"v{found.field.split()[1]}" if found.sign > 0 else "none"
    judgement.hold.append(
        f"the machine seems to have changed by {what} {found.field} adds ({found.words()}): as if {found.field} {seems} "
        f"while the machine was measured, but the evaluation assumed that {assumed} on; "
        f"{how_to_state(case.job.name, case.measurement, version)}; if the machine has really changed, approve with --override"
    )


def _were_active(case: Case) -> tuple[dict[int, ReadTables], IdentificationRecord | None]:
    """Return the tables that are or were active, by version in the order of activation, and the last errors."""
    by_id = {table.id: table for table in case.past.tables}
    order = [
        item.table_id for item in case.past.decisions if AFTER[item.kind] == "active" and item.table_id is not None
    ]
    known = [by_id[key] for key in dict.fromkeys(order[::-1])][:LOOKED_BACK][::-1]
    found: dict[int, ReadTables] = {}
    for table in known:
        control = next((name for name in case.job.controllers if name in table.controllers), table.controllers[0])
        read = _tables_read(case.store, case.machine, table, control)
        if read is not None:
            found[table.version] = read
    return found, case.store.identification(known[-1].identification_id) if found else None


def _added(case: Case, were_active: Mapping[int, ReadTables]) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """What tables add to the commands that may have been on by mistake, and that may have been off, in words.

    Each is the mean of both directions of travel at points of the volume, (n, 3), mm.
    """
    machine, taken, on = case.machine, case.version_taken, active_of(case.past.tables)
    points_mm = volume_points(machine)
    sides = [Points(points_mm, approach=np.full_like(points_mm, side)) for side in (1.0, -1.0)]
    adds = {
        version: np.asarray(0.5 * sum(tables.correction(machine, side) for side in sides))
        for version, tables in were_active.items()
    }
    added = {f"version {version}": field for version, field in adds.items()}
    if taken in adds:  # the clock may be slow: a later version may already have been on
        later = list(adds)[list(adds).index(taken) + 1 :]
        added |= {f"version {version} instead of version {taken}": adds[version] - adds[taken] for version in later}
    active = None if on is None else on.version
    return added, {f"version {version}": field for version, field in adds.items() if version in (taken, active)}


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
    """Compare with the errors behind the active tables: the change must exceed its uncertainty."""
    errors, covariance = _identified(result)
    new = covariance_or_independent(errors, covariance)
    old_errors = case.store.errors_of(active.identification)
    old = covariance_or_independent(old_errors, case.store.covariance_of(active.identification))
    if new is None or old is None:
        judgement.hold.append("the uncertainty of the errors is not known, so the change cannot be judged")
        return None
    change = change_between(case.machine, (errors, new), (old_errors, old), case.job.policy.confidence)
    judgement.figures["change"] = change.summary()
    if not change.significant:
        judgement.hold.append(
            f"the change against version {active.version} ({change.rms_um:.2f} um rms) is within its uncertainty "
            f"({change.expected_rms_um:.2f} um rms expected, p = {change.p_value:.3f})"
        )
    return change


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
#: A change is compared with at most this many of the newest versions that were active.
LOOKED_BACK = 20
#: Prefix of temporary folders; their names mean nothing to a reader.
FOLDER = "compgen-recal-"
_TEMPORARY = re.compile(rf"\S*{FOLDER}[^/\\]+[/\\](?:measurement|settings)[/\\]")


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
    past = store.together(
        lambda: Past(store.decisions(record), store.tables(record), store.measurements(record), store.events(record))
    )
    said = measurement.active_table if stated is None else stated
    taken = _active_then(job, measurement, past, said)
    case = Case(store, job, record, machine, measurement, past, store.now(), said, taken)
    with working_folder(FOLDER.removeprefix(FOLDERS)) as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", CompgenWarning)
        was_active = None if taken is None else _tables_read(store, machine, taken, job.controllers[0])
        if taken is not None and was_active is None:
            text = f"version {taken.version} was active, but contains no tables of {job.controllers[0]}"
            raise InputError(f"{text}; is the control right?")
        outcome = run(
            machine,
            write_files(Path(folder) / "measurement", store.contents_of(measurement)),
            job.controllers,
            Path(folder) / "out",
            identify_options=IdentifyOptions(**job.identify),
            templates=job.templates,
            allow_unverified=job.allow_unverified,
            active=None if was_active is None else ActiveTables(was_active),
            instrument=job.instrument,
            limits=SafetyLimits(job.policy.max_step_um),
            language=job.language,
            allow_misfit=True,  # a misfit that makes `run` refuse the tables holds them back here: judge_misfit
        )
        judgement = _judged(case, outcome)
        told = [str(item.message) for item in caught if issubclass(item.category, CompgenWarning)]
        judgement.figures["warnings"] = [without_folder(text) for text in told]
        result = _result(Path(folder) / "out", machine, outcome, judgement)
    kept = NewResult(
        **result,
        active_table_id=None if taken is None else taken.id,
        approve=job.approval == "auto",
        settings_sha256=settings,
        seconds=time.monotonic() - started,
    )
    on = active_of(past.tables)
    return Processed(kept, None if on is None else on.id)


def without_folder(message: str) -> str:
    """Return the message with the files of a measurement named as in the inbox."""
    return _TEMPORARY.sub("", message)


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


def _active_then(job: MachineJob, measurement: MeasurementRecord, past: Past, said: str | None) -> TableRecord | None:
    """Return the tables that were active during the measurement: as stated, else as the job says."""
    tables = past.tables
    version = None if said is None else version_said(said)
    if said is not None and version is None:
        return None
    if said is not None:
        found = next((table for table in tables if table.version == version), None)
        if found is None or not found.accepted:
            of_file = said == measurement.active_table
            raise InputError(
                f"says active_table = {said}, but {job.name} has no such tables; give a version or none",
                file=measurement.name if of_file else None,
                field=None if of_file else "--active-table",
            )
        return found
    if job.measured_with == "bare":
        return None
    then = active_id([decision for decision in past.decisions if decision.at <= measurement.measured_at])
    return next((table for table in tables if table.id == then), None)


def _tables_read(store: Store, machine: Machine, table: TableRecord, control: str) -> ReadTables | None:
    """Parse the table files of one control, without manifest and notes; None if there are none."""
    names = table.summary.get("tables", {}).get(control, [])
    files = {file.name: file.content for file in store.table_files(table) if file.controller == control}
    return parse_tables(machine, {name: files[name] for name in names}, control) if names else None


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
    tables = None if table is None else _tables_read(store, loaded, table, job.controllers[0])
    return loaded, store.errors_of(newest), store.covariance_of(newest), tables


# --- judgement -----------------------------------------------------------------------------------------------------


def _judged(case: Case, result: RunResult) -> Judgement:
    """Apply all rules, in the order in which a person reads their reasons."""
    judgement, active, policy = Judgement(), ActiveState.of(case), case.job.policy
    latest = None if active is None else active.identification.measured_at
    judge_measurement(judgement, policy, case.measurement, case.now, latest)
    new: dict[str, ReadTables] = {}
    for item in result.results:
        if item.verification.accepted:
            assert item.read is not None
            new[item.verification.controller] = item.read
    if active is not None and result.accepted and shows_all(judgement, case.store, result, active):
        judge_change(judgement, case, result, active)
        judge_tables(judgement, case.machine, result, new, active)
    if result.accepted:
        apply_limits(judgement, case.machine, new, {} if active is None else active.tables, policy)
    judge_misfit(judgement, result)
    judgement.figures["active_version"] = None if active is None else active.version
    judgement.figures["result"] = {item.verification.controller: item.verification.summary() for item in result.results}
    if not result.accepted:
        reasons = [reason for item in result.results for reason in item.verification.reasons]
        judgement.hold[:0] = list(dict.fromkeys(reasons))
    judge_order(judgement, case)
    if case.said is not None:
        judgement.figures[STATED] = case.said
    elif case.job.measured_with == "active":
        judge_assumption(judgement, case)
    if result.accepted:
        judge_likeness(judgement, case, result)
    judge_twins(judgement, case)
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
