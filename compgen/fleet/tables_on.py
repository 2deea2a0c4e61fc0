"""Which tables were on while a machine was measured: what files and persons state, what the time says, what the data say.

Whatever was on is removed from the readings, so a wrong assumption enters the errors in full: tables made from them undo
the compensation, or apply it twice. The ``judge_...`` functions add reasons to hold such tables back to a
:class:`Judgement`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.errors import InputError
from compgen.fleet.change import likeness, volume_points
from compgen.fleet.inbox import duration_s, time_in
from compgen.fleet.job import MachineJob
from compgen.fleet.records import (
    ADOPTED,
    AFTER,
    CLOCK,
    RESTORED,
    DecisionRecord,
    EventRecord,
    IdentificationRecord,
    MachineRecord,
    MeasurementRecord,
    TableRecord,
    active_id,
    active_of,
)
from compgen.fleet.store import Store
from compgen.identify.covariance import Covariance
from compgen.tables import ReadTables, parse_tables

#: A clock that was not set to daylight-saving time, or back, is wrong by this in addition to what clocks differ by.
DAYLIGHT_SAVING = timedelta(hours=1)
#: Key in a version's figures: which tables were on, as stated by a file or a person.
STATED = "active_table_stated"
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
class Case:
    """One measurement to be judged: the job of its machine, what the store knows of the machine, the current time.

    ``said`` states which tables were on during the measurement, by the file or, with ``by_person``, by a person; None if
    neither states it. ``taken`` are the tables whose effect is removed from the readings, None if none were on. ``span``:
    earliest and latest time at which a reading may have been taken.
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
    taken: TableRecord | None
    span: tuple[datetime, datetime]

    @property
    def version_taken(self) -> int | None:
        """Version of the tables whose effect is removed."""
        return None if self.taken is None else self.taken.version

    @property
    def margin(self) -> timedelta:
        """By how much clocks may differ."""
        return timedelta(minutes=self.job.policy.clock_minutes)


def tables_read(store: Store, machine: Machine, table: TableRecord, control: str) -> ReadTables | None:
    """Parse the table files of one control, without manifest and notes; None if there are none."""
    names = table.summary.get("tables", {}).get(control, [])
    files = {file.name: file.content for file in store.table_files(table) if file.controller == control}
    return parse_tables(machine, {name: files[name] for name in names}, control) if names else None


def tables_taken(job: MachineJob, measurement: MeasurementRecord, past: Past, said: str | None) -> TableRecord | None:
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
    machine, taken = case.machine, case.version_taken
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
