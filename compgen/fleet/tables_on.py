"""Which tables were on while a machine was measured: what files and persons state, what the time says, what the data say.

Whatever was on is removed from the readings, so a wrong assumption enters the errors in full: tables made from them undo
the compensation, or apply it twice. The ``judge_...`` functions add reasons to hold such tables back to a
:class:`Judgement`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from compgen.data.comparison import rms
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.errors import InputError
from compgen.fleet.change import axis_temperatures, likeness, volume_points
from compgen.fleet.evidence import (
    DriftSizes,
    Explanations,
    Held,
    TableState,
    explained,
    held_by,
    possible_states,
    tables_read,
)
from compgen.fleet.inbox import duration_s, names_of, time_in
from compgen.fleet.job import MachineJob
from compgen.fleet.records import (
    ADOPTED,
    AFTER,
    CLOCK,
    RESERVATION,
    RESTORED,
    DecisionRecord,
    EventRecord,
    EvidenceRecord,
    IdentificationRecord,
    MachineRecord,
    MeasurementRecord,
    TableRecord,
    active_id,
    active_of,
)
from compgen.fleet.store import Store
from compgen.identification.covariance import Covariance
from compgen.tables import ReadTables

#: A clock that was not set to daylight-saving time, or back, is wrong by this in addition to what clocks differ by.
DAYLIGHT_SAVING = timedelta(hours=1)
#: Key in a version's figures: which tables were on, as stated by a file or a person.
STATED = "active_table_stated"
#: Prior probability that the tables were as the history, the file or a person says, and as a backup shows.
ASSUMED, BELIEVED = 0.97, 0.999
#: Prior probability that a backup which shows another stored version than the history says is an old file.
MISFILED = 0.05
#: The rest: none were on, another version, a version times a factor, single tables or an axis of a version.
STATES = {"none": 0.2, "version": 0.3, "factor": 0.2, "part": 0.3}
#: Tables are held if what is assumed is less probable than the first, what a backup shows than the second.
CERTAIN, BELIEVABLE = 0.9, 0.5
#: States that differ by less over the volume do no harm, mm rms.
HARMLESS_MM = 0.25 * MM_PER_UM
#: At most so many explanations are named, and only these, with their probabilities.
MOST_NAMED, LEAST_NAMED = 4, 0.01
#: Statement of a backup that is no stored version.
OTHER = "other"
#: A change is compared with at most this many of the newest versions that were active.
LOOKED_BACK = 20


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

    def swaps(self, at: datetime) -> list[DecisionRecord] | None:
        """Decisions that changed the active tables, of the history that counts for a time; None if none does.

        What the store knew before its folder was given to it does not count. What a backup contains counts up to its
        last entry; what happened afterwards, until tables were made active again, is not known.
        """
        every = [item for item in self.decisions if AFTER[item.kind] == "active"]
        for event in reversed(self._beginnings):
            later = [item for item in every if item.at >= event.at]
            if later and at >= later[0].at:
                return later
            if event.kind != RESTORED or at > (until := datetime.fromisoformat(event.subject)):
                return None
            every = [item for item in every if item.at <= until]
        return every or None

    @property
    def stated(self) -> str | None:
        """Latest statement of which tables were on, by a file or a person, since this store got its history."""
        since = max((item.at for item in self._beginnings), default=datetime.min.replace(tzinfo=UTC))
        said = [(item.received_at, item.active_table) for item in self.measurements if item.active_table is not None]
        said += [(item.at, str(item.summary[STATED])) for item in self.tables if STATED in item.summary]
        return max((item for item in said if item[0] >= since), default=(None, None))[1]

    @property
    def _beginnings(self) -> list[EventRecord]:
        """Events after which the store does not know which tables are on, oldest first."""
        return sorted((item for item in self.events if item.kind in (ADOPTED, RESTORED)), key=lambda item: item.at)

    def has_begun_between(self, first: datetime, last: datetime) -> bool:
        """Whether the store got its history between two times."""
        return any(first < item.at <= last for item in self._beginnings)

    def why_unknown(self, name: str) -> str:
        """Say why the history does not tell which tables were on at some time."""
        last = next(iter(self._beginnings[::-1]), None)
        if last is None:
            return f"it has never made tables of {name} active"
        if last.kind == RESTORED:
            until = _day(datetime.fromisoformat(last.subject))
            return f"its history comes from a backup that ends at {until}, and what happened afterwards is not known"
        return f"it has published into the folder of {name} only since {_day(last.at)}, and had made no tables active since"


@dataclass(frozen=True)
class TablesOn:
    """The tables that are removed from readings: as parsed (None: none), which stored version they are, and in words.

    ``by_evidence``: a backup of the control shows that they were on.
    """

    tables: ReadTables | None
    version: TableRecord | None
    words: str
    by_evidence: bool = False


@dataclass(frozen=True)
class Case:
    """One measurement to be judged: the job of its machine, what the store knows of the machine, the current time.

    ``said`` states which tables were on during the measurement, by the file or, with ``by_person``, by a person; None if
    neither states it. ``evidence`` is the backup that came with it, ``held`` what it shows, or why it cannot be read.
    ``span``: earliest and latest time at which a reading may have been taken. ``on`` are the tables whose effect is removed
    from the readings.
    """

    store: Store
    job: MachineJob
    record: MachineRecord
    machine: Machine
    measurement: MeasurementRecord
    past: Past
    now: datetime
    said: str | None
    by_person: bool
    evidence: EvidenceRecord | None
    held: Held | str | None
    span: tuple[datetime, datetime]
    on: TablesOn

    @property
    def taken(self) -> TableRecord | None:
        """The stored version whose effect is removed, None if it is none of them."""
        return self.on.version

    @property
    def version_taken(self) -> int | None:
        """Number of the stored version whose effect is removed."""
        return None if self.taken is None else self.taken.version

    @property
    def margin(self) -> timedelta:
        """By how much clocks may differ."""
        return timedelta(minutes=self.job.policy.clock_minutes)


def removed_tables(
    store: Store,
    machine: Machine,
    job: MachineJob,
    measurement: MeasurementRecord,
    past: Past,
    said: str | None,
    held: Held | str | None,
    *,
    by_person: bool,
) -> TablesOn:
    """Return the tables to remove from the readings: as a person states, a backup shows, the file states, the history says.

    A backup shows what a control held, not whether it acted: if the job says that tables are switched off to measure, they
    were.
    """
    stated_on = said is not None and version_said(said) is not None
    on = job.measured_with == "active" or stated_on
    if isinstance(held, Held) and not by_person and (held.tables is None or on):
        version = next((table for table in past.tables if table.version == held.version), None)
        return TablesOn(held.tables, version, held.words, by_evidence=True)
    version = _version_then(job, measurement, past, said)
    if version is None:
        return TablesOn(None, None, "no tables")
    read = tables_read(store, machine, version, job.controllers[0])
    if read is None:
        text = f"version {version.version} was active, but contains no tables of {job.controllers[0]}"
        raise InputError(f"{text}; is the control right?")
    return TablesOn(read, version, f"version {version.version}")


def _version_then(job: MachineJob, measurement: MeasurementRecord, past: Past, said: str | None) -> TableRecord | None:
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


def what_it_held(
    store: Store, machine: Machine, job: MachineJob, past: Past, evidence: EvidenceRecord | None
) -> Held | str | None:
    """Read the backup that came with a measurement; a text says why it cannot be read, None: there is none."""
    if evidence is None:
        return None
    files = {name: store.blob(digest) for name, digest, _ in evidence.files}
    known = [table for table in past.tables if table.accepted][-LOOKED_BACK:]
    try:
        return held_by(store, machine, job.controllers, known, files)
    except InputError as error:
        return str(error)


def span_of(measurement: MeasurementRecord, contents: Mapping[str, bytes]) -> tuple[datetime, datetime]:
    """Return the earliest and the latest time at which a reading may have been taken.

    Files state one time, of their first or of their last reading; ``time_s`` says how long they took.
    """
    ends = [measurement.measured_at]
    for content in contents.values():
        stated, lasted = time_in(content), timedelta(seconds=duration_s(content))
        at = measurement.measured_at if stated is None else stated[0]
        ends += [at - lasted, at + lasted]
    return min(ends), max(ends)


def judge_tables_on(judgement: Judgement, case: Case) -> None:
    """Apply the rules about which tables were on that do not look at the errors: by evidence, statement or time."""
    if case.said is not None:
        judgement.figures[STATED] = case.said
    judgement.figures["tables_on"] = {"assumed": case.on.words, "by_evidence": case.on.by_evidence}
    _judge_backup(judgement, case)
    if case.on.by_evidence:
        judgement.figures[STATED] = _statement(case)
    elif case.said is not None:
        if not case.by_person:
            judge_statement(judgement, case)
    elif case.job.measured_with == "active":
        judge_assumption(judgement, case)


def _statement(case: Case) -> str:
    """What a backup states, as a file would: a version, none, or something that is neither."""
    if case.on.tables is None:
        return "none"
    return f"v{case.version_taken}" if case.taken is not None else OTHER


# --- what a backup of the control shows -------------------------------------------------------------------------------


def _judge_backup(judgement: Judgement, case: Case) -> None:
    """Hold if a backup is missing though required, cannot be read, contradicts a statement, or is of another time."""
    name, files = case.job.name, "" if case.evidence is None else case.evidence.names
    if isinstance(case.held, str):
        judgement.hold.append(f"the backup of the control ({files}) cannot be read: {case.held}")
    if not isinstance(case.held, Held):
        if case.job.policy.evidence == "required":
            judgement.hold.append(
                "the policy requires evidence of which tables were on (evidence = required): " + how_to_show(case)
            )
        return
    held, assumed = case.held, case.on.words
    _judge_owner(judgement, case)
    judgement.figures["evidence"] = {
        "files": files, "source": getattr(case.evidence, "source", ""), "tables": held.words, "version": held.version
    }  # fmt: skip
    if not case.on.by_evidence and not case.by_person:  # the job says that tables are switched off
        if case.said is None:
            judgement.hold.append(
                f"the backup of the control ({files}) contains {held.words}, and does not show whether it acted; the job says "
                f"that {name} is measured with its tables off. If they were: {how_to_state(name, case.measurement, 'none')}"
            )
        return
    said = None if case.said is None else version_said(case.said)
    if case.said is not None and said != (None if held.tables is None else held.version or OTHER):
        judgement.hold.append(
            f"{'a person' if case.by_person else 'the file'} states that {_was(_named(said))} on, but the backup of the control "
            f"({files}) shows {held.words}; {_was(assumed)} removed from the readings"
        )
    _judge_time_of_backup(judgement, case, held)
    expected = _expected(case)
    if expected is not None and expected != (None if held.tables is None else held.version or OTHER):
        judgement.reservations.append(
            f"{RESERVATION}the backup of the control shows {held.words}, but by the history {_named(expected)} should have been "
            "on: load the right tables"
        )


def _judge_owner(judgement: Judgement, case: Case) -> None:
    """Hold if the backup has files of another machine: with no history, no reading contradicts it."""
    assert case.evidence is not None
    found = case.store.same_tables_of_others(case.record, [digest for _, digest, _ in case.evidence.files])
    if found:
        others = ", ".join(dict.fromkeys(f"{name} (version {version})" for name, version in found))
        judgement.hold.append(
            f"the backup of the control ({case.evidence.names}) has files of {others}: make one of the control of {case.job.name}"
        )


def _named(version: int | str | None) -> str:
    return "no tables" if version is None else f"version {version}"


def _was(words: str) -> str:
    """Add the verb to tables in words.

    >>> _was("version 2"), _was("no tables")
    ('version 2 was', 'no tables were')
    """
    return f"{words} {'were' if words.startswith(('no tables', 'tables')) else 'was'}"


def _expected(case: Case) -> int | str | None:
    """The version that was active during the measurement by the history; what the backup shows if that is not known."""
    held = case.held
    assert isinstance(held, Held)
    own = None if held.tables is None else held.version or OTHER
    if case.past.swaps(case.measurement.measured_at) is None:
        return own
    version = _version_then(replace(case.job, measured_with="active"), case.measurement, case.past, None)
    return None if version is None else version.version


def _judge_time_of_backup(judgement: Judgement, case: Case, held: Held) -> None:
    """Hold if the active tables changed between the measurement and its backup, unless it shows those of before.

    What a control holds after such a decision says nothing about what it held before, and readings may be from before and
    after.
    """
    evidence, (first, last) = case.evidence, case.span
    assert evidence is not None
    written = max(datetime.fromisoformat(time) for _, _, time in evidence.files)
    made = written if first <= written <= evidence.at else evidence.at
    swaps = [item for item in case.past.decisions if AFTER[item.kind] == "active" and first < item.at < max(last, made)]
    if not swaps:
        return
    earlier = active_id([item for item in case.past.decisions if item.sequence < swaps[0].sequence])
    before = next((table.version for table in case.past.tables if table.id == earlier), None)
    if (None if held.tables is None else held.version or OTHER) != before:
        judgement.hold.append(
            f"the active tables were changed at {_day(swaps[0].at)}, between the first reading ({_day(first)}) and the backup of "
            f"the control ({_day(made)}), which shows {held.words}: it does not show what was on before; "
            f"{how_to_state(case.job.name, case.measurement, 'VERSION|none')}"
        )


def how_to_show(case: Case) -> str:
    """Tell a person how to show which tables were on."""
    stem = sorted(names_of(case.measurement.name), key=len)[0]
    return (
        f"put a backup of the control that was made with the measurement beside it, as {stem}.backup.EXT, or `volcomp recal "
        f"run {case.job.name} --backup FILE`"
    )


# --- what files, persons and the time say -----------------------------------------------------------------------------


def judge_statement(judgement: Judgement, case: Case) -> None:
    """Hold if what a file states cannot be true of all its readings.

    Before the store got its history from a backup, another history may have had a version of the same number; and no
    statement is true of readings from before and after other tables became active.
    """
    name, (first, last) = case.job.name, case.span
    state_it = how_to_state(name, case.measurement, "VERSION|none")
    if case.taken is not None and case.past.has_begun_between(case.measurement.measured_at, case.taken.at):
        judgement.hold.append(
            f"it states that version {case.version_taken} was on, but this store made it on {_day(case.taken.at)}, after the "
            f"measurement of {_day(case.measurement.measured_at)}; {case.past.why_unknown(name)}, and it may have had another "
            f"version {case.version_taken}; {state_it}"
        )
    for swap in _within(case):
        judgement.hold.append(
            f"it states one set of tables, but readings may have been taken from {_day(first)} to {_day(last)} (time_s), and "
            f"the active tables were changed at {_day(swap.at)}; if all of them were taken with the same tables, {state_it}"
        )


def _within(case: Case) -> list[DecisionRecord]:
    """Decisions between the first and the last reading that changed the active tables."""
    first, last = case.span
    return [item for item in case.past.decisions if AFTER[item.kind] == "active" and first < item.at < last]


def judge_assumption(judgement: Judgement, case: Case) -> None:
    """Hold if the time of the measurement does not determine which tables were on.

    Only for a measurement that does not state it, on a machine that is measured with its tables on.
    """
    job, measurement, past, taken = case.job, case.measurement, case.past, case.version_taken
    swaps = past.swaps(measurement.measured_at)
    if swaps is None:
        said = past.stated
        if said is None or version_said(said) != taken:
            judgement.hold.append(
                "the store does not know which tables were on while the machine was measured: "
                f"{past.why_unknown(job.name)}. If none were on: {how_to_state(job.name, measurement, 'none')}; if tables "
                "were on, state which, or switch them off and measure again"
            )
        return
    doubts = []
    if measurement.measured_at_source == "file time":
        doubts.append("the file does not state when it was measured, and the time of a file changes when it is copied")
    elif measurement.measured_at_source == "file, no zone":
        doubts.append("the time of the measurement has no zone")
    for before, swap in zip([None, *swaps], swaps, strict=False):
        doubts += _doubts_about(case, before, swap)
    if doubts:
        judgement.hold.append(
            "it is not certain which tables were on while the machine was measured (assumed: "
            f"{'none' if taken is None else f'version {taken}'}): "
            f"{'; '.join(dict.fromkeys(doubts))}; {how_to_state(job.name, measurement, 'VERSION|none')}"
        )


def _doubts_about(case: Case, before: DecisionRecord | None, swap: DecisionRecord) -> list[str]:
    """Doubts that come from one decision, and from the one before it."""
    (first, last), at, margin = case.span, case.measurement.measured_at, case.margin
    away = abs(at - swap.at)
    if away < margin + bool(margin) * DAYLIGHT_SAVING:
        minutes, required = away / timedelta(minutes=1), f"{case.job.policy.clock_minutes:g} min"
        why = f"{required} are required, because clocks differ"
        if away >= margin:
            why = f"{required} and an hour are required: a clock may be off by daylight-saving time, too"
        return [
            f"it was measured {minutes:.0f} min from the decision of {_day(swap.at)} that changed the active tables; {why}"
        ]
    if first - margin < swap.at < last + margin:
        return [
            f"readings may have been taken from {_day(first)} to {_day(last)} (time_s), and the active tables were changed at "
            f"{_day(swap.at)}"
        ]
    inside = (before is None or before.at - margin < at) and at < swap.at + margin
    if inside and _doubtful(swap, case.past, case.now):
        return [f"the clock went back, so the time of the decision of {_day(swap.at)} is not certain"]
    return []


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


# --- what the data say ------------------------------------------------------------------------------------------------


def judge_likeness(judgement: Judgement, case: Case, new: tuple[ErrorTable, Covariance | None]) -> None:
    """Hold if the machine seems to have changed by what some tables add, or by its opposite.

    The change is relative to the errors behind the active tables, or the last active ones; it is compared with what
    each version that is or was active adds.
    """
    machine = case.machine
    were_active, last = _were_active(case)
    if last is None:
        return
    old_errors = case.store.errors_of(last)
    if not set(old_errors.names) <= set(new[0].names):
        return  # already held for that; an incomplete set of errors has no field to compare
    added, missing = _added(case, were_active)
    old = (old_errors, case.store.covariance_of(last))
    found = likeness(machine, new, old, added, missing)
    if found is None:
        return
    judgement.figures["likeness"] = found.summary()
    assumed = _was(case.on.words)
    seems, what = ("was on", "what") if found.sign > 0 else ("was off", "the opposite of what")
    version = f"v{found.field.split()[1]}" if found.sign > 0 else "none"
    judgement.hold.append(
        f"the machine seems to have changed by {what} {found.field} adds ({found.words()}): as if {found.field} {seems} "
        f"while the machine was measured, but the evaluation assumed that {assumed} on; "
        f"{how_to_state(case.job.name, case.measurement, version)}; if the machine has really changed, approve with --override"
    )


def judge_states(judgement: Judgement, case: Case, new: tuple[ErrorTable, Covariance | None]) -> None:
    """Hold if tables in another state than assumed explain the change of the errors, or nothing but a jump does.

    The states are each version, and its usual distortions as a whole and in its single tables, each together with what the
    machine repeats and drifts, or a jump. Without a backup of the control a jump is not believed: what was on may be a state
    that is not in the list, such as edited tables. A backup is believed unless the data contradict it.
    """
    versions, last = _were_active(case)
    if last is None:
        return
    old_errors = case.store.errors_of(last)
    if set(old_errors.names) != set(new[0].names):
        if _needs_evidence(case) and set(old_errors.names) < set(new[0].names):
            judgement.hold.append(
                "more errors were measured than for the tables that were active last, so the change of the machine does not show "
                f"which tables were on; {how_to_show(case)}; or approve with --override"
            )
        return
    states = possible_states(case.machine, versions, volume_points(case.machine))
    removed = np.zeros_like(states[0].field_mm)
    if case.on.tables is not None:
        removed = case.on.tables.mean_correction(case.machine, volume_points(case.machine))
    others = [item for item in states if rms(np.linalg.norm(item.field_mm - removed, axis=1)) > HARMLESS_MM]
    assumed = BELIEVED if case.on.by_evidence else ASSUMED
    extra = np.array([np.zeros_like(removed), *(item.field_mm - removed for item in others)])
    share = {
        kind: (1.0 - assumed) * STATES[kind] / sum(item.kind == kind for item in others)
        for kind in {item.kind for item in others}
    }
    prior = np.array([assumed, *(share[item.kind] for item in others)])
    if case.on.by_evidence and (case.on.tables is None or case.taken is not None):
        expected = _expected(case)
        usual = [item.kind in ("none", "version") and item.words == _named(expected) for item in others]
        prior[1:][usual] = MISFILED
    old = (old_errors, case.store.covariance_of(last))
    found = explained(case.machine, new, old, extra, prior, _drift_sizes(case, last))
    likeliest = _likeliest(case, others, found)
    judgement.figures["tables_on"] |= {
        "change_um": found.rms_um,
        "drift_um": found.drift_um,
        "assumed_and_drift": float(found.without_jump[0]),
        "hypotheses": [{"tables": words, "probability": share} for words, share in likeliest],
    }
    listed = "; ".join(f"{words}: {_percent(share)}" for words, share in likeliest)
    if found.probability[0] < (BELIEVABLE if case.on.by_evidence else CERTAIN):
        what = (
            "contradict the backup of the control"
            if case.on.by_evidence
            else f"do not fit that {_was(case.on.words)} on"
        )
        judgement.hold.append(
            f"the readings {what}: the machine seems to have changed by {found.rms_um:.1f} um rms; what explains it: {listed}; "
            f"{how_to_show(case)}; if the machine has really changed, approve with --override"
        )
    elif found.without_jump[0] < CERTAIN and _needs_evidence(case):
        judgement.hold.append(
            f"the machine seems to have changed by {found.rms_um:.1f} um rms, more than drift explains (about "
            f"{found.drift_um:.1f} um), and no backup of the control shows which tables were on; what explains it: "
            f"{listed}; {how_to_show(case)}; if the machine has really changed, approve with --override"
        )


def _needs_evidence(case: Case) -> bool:
    """Whether the tables that were on are taken from the history or the file alone, on a machine measured with tables on."""
    return case.job.measured_with == "active" and not case.on.by_evidence and not case.by_person


def _likeliest(case: Case, others: Sequence[TableState], found: Explanations) -> list[tuple[str, float]]:
    """The states with the highest probabilities, in words: of what was assumed, with and without a jump of the machine."""
    drift, total = float(found.without_jump[0]), float(found.probability[0])
    known = [
        (f"{case.on.words} as assumed, and drift", drift),
        (f"{case.on.words} as assumed, and a jump of the machine", total - drift),
    ]
    known += [(item.words, float(share)) for item, share in zip(others, found.probability[1:], strict=True)]
    known.sort(key=lambda item: -item[1])
    return [item for item in known[:MOST_NAMED] if item[1] >= LEAST_NAMED]


def _percent(share: float) -> str:
    """Write a probability.

    >>> _percent(0.123), _percent(0.9994), _percent(1.0)
    ('12 %', 'over 99 %', 'over 99 %')
    """
    return f"{100.0 * share:.2g} %" if share < 0.995 else "over 99 %"


def _drift_sizes(case: Case, last: IdentificationRecord) -> DriftSizes:
    """What the machine may drift since the errors that the change is relative to."""
    days = abs(case.measurement.measured_at - last.measured_at) / timedelta(days=1)
    measured = {item.id: item for item in case.past.measurements}
    kelvin = np.full(3, np.nan)
    if last.measurement_id in measured:
        now, then = (
            axis_temperatures(item.temperatures_c) for item in (case.measurement, measured[last.measurement_id])
        )
        kelvin = now - then
    return DriftSizes.between(
        case.machine, days, kelvin, corrected=case.job.identify.get("temperature", True) is not False
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
        read = tables_read(case.store, case.machine, table, control)
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


def _day(time: datetime) -> str:
    return time.isoformat(timespec="minutes")
