"""The acceptance policy: what new tables are held back for, with the figures behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.points import Points
from compgen.identify import joint_covariance
from compgen.pipeline import RunResult, identified_reversal
from compgen.recal.change import Change, change_between, likeness, spread_of, volume_points
from compgen.recal.inbox import holds_one_of
from compgen.recal.job import MachineJob, Policy
from compgen.recal.records import (
    RESERVATION,
    DecisionRecord,
    EventRecord,
    IdentificationRecord,
    MachineRecord,
    MeasurementRecord,
    TableRecord,
)
from compgen.recal.states import AFTER
from compgen.recal.store import Store
from compgen.verify import ReadTables, verify
from compgen.verify.diff import difference
from compgen.verify.verdict import MISFIT_CODES

#: A measurement from further in the future than this has a wrong time.
FUTURE = timedelta(days=1)
#: Kinds of events: the clock of the store went back; the folder of a machine was given to this store.
CLOCK, ADOPTED = "clock", "adopted"
#: Key of the figures of a version: which tables a file or a person says were on.
STATED = "active_table_stated"


@dataclass
class Judgement:
    """Reasons to hold tables back, reservations that are shown only, and figures by name; all grow while rules are looked at."""

    hold: list[str] = field(default_factory=list)
    reservations: list[str] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ActiveState:
    """The tables that are active now: parsed by control, their version, and the errors that they were made from."""

    version: int
    tables: Mapping[str, ReadTables]
    identification: IdentificationRecord


def judge_measurement(
    judgement: Judgement, policy: Policy, measurement: MeasurementRecord, now: datetime, latest: datetime | None
) -> None:
    """Look at age and temperature; ``latest`` is when the newest measurement behind an active table was made."""
    age = now - measurement.measured_at
    judgement.figures["age_days"] = age.total_seconds() / 86400.0
    if age < -FUTURE:
        judgement.hold.append(f"the measurement is dated {_day(measurement.measured_at)}, which lies in the future")
    elif policy.max_age_days is not None and age > timedelta(days=policy.max_age_days):
        days = judgement.figures["age_days"]
        judgement.hold.append(f"the measurement is {days:.1f} days old; at most {policy.max_age_days:g} are allowed")
    if latest is not None and measurement.measured_at < latest:
        judgement.hold.append(f"the active tables come from a newer measurement ({_day(latest)})")
    if policy.temperature_c is not None:
        judgement.hold += _temperature(policy.temperature_c, measurement.temperatures_c)


def judge_misfit(judgement: Judgement, result: RunResult) -> None:
    """Hold what a large misfit speaks against, and note what else keeps the verdict from a plain "accepted".

    A person may approve over a misfit, as `--allow-misfit` does; residuals above their uncertainty alone are shown only.
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


def judge_order(
    judgement: Judgement, store: Store, measurement: MeasurementRecord, tables: Sequence[TableRecord]
) -> None:
    """Hold what was measured before a proposal that waits, so that it does not take that proposal's place."""
    for table in tables:
        if table.state == "pending":
            made = store.identification(table.identification_id).measured_at
            if measurement.measured_at < made:
                judgement.hold.append(
                    f"version {table.version}, which waits, comes from a newer measurement ({_day(made)})"
                )


# --- which tables were on while the machine was measured --------------------------------------------------------------


@dataclass(frozen=True)
class Past:
    """What the store knows about a machine: decisions, tables with figures, measurements, events; all of them."""

    decisions: Sequence[DecisionRecord]
    tables: Sequence[TableRecord]
    measurements: Sequence[MeasurementRecord]
    events: Sequence[EventRecord]

    @property
    def swaps(self) -> list[DecisionRecord]:
        """Decisions that changed the active tables, since the folder was given to this store."""
        return [item for item in self.decisions if AFTER[item.kind] == "active" and item.at >= self._since]

    @property
    def stated(self) -> str | None:
        """What a file or a person said last of the tables that were on, since the folder was given to this store."""
        said = [(item.received_at, item.active_table) for item in self.measurements if item.active_table is not None]
        said += [(item.at, str(item.summary[STATED])) for item in self.tables if STATED in item.summary]
        return max((item for item in said if item[0] >= self._since), default=(None, None))[1]

    @property
    def _since(self) -> datetime:
        adopted = [item.at for item in self.events if item.kind == ADOPTED]
        return max(adopted, default=datetime.min.replace(tzinfo=UTC))


def judge_assumption(
    judgement: Judgement, job: MachineJob, measurement: MeasurementRecord, past: Past, now: datetime, taken: int | None
) -> None:
    """Hold where the time of the measurement does not say which tables were on; ``taken`` is the version taken out.

    Only for a measurement that does not say it itself, of a machine that is measured with its tables on. A wrong
    assumption goes into the errors in full: the new tables then undo the compensation, or apply it twice.
    """
    swaps, margin = past.swaps, timedelta(minutes=job.policy.clock_minutes)
    if not swaps:
        said = past.stated
        if said is None or version_said(said) != taken:
            judgement.hold.append(
                "the store does not know which tables were on while the machine was measured: it never made any of "
                f"{job.name} active. If none were on: {how_to_state(job.name, measurement, 'none')}; if tables were on, "
                "switch them off and measure again"
            )
        return
    doubts = []
    if measurement.measured_at_source == "file time":
        doubts.append("the file does not say when it was measured, and the time of a file changes when it is copied")
    elif measurement.measured_at_source == "file, no zone":
        doubts.append("the time of the measurement has no zone")
    for before, swap in zip([None, *swaps], swaps, strict=False):
        since = None if before is None else before.at
        near = abs(measurement.measured_at - swap.at) < margin
        inside = (
            since is None or since - margin < measurement.measured_at
        ) and measurement.measured_at < swap.at + margin
        if near:
            away = abs(measurement.measured_at - swap.at).total_seconds() / 60.0
            doubts.append(
                f"it was measured {away:.0f} min from the decision of {_day(swap.at)} that changed the active tables; "
                f"{job.policy.clock_minutes:g} min are wanted, as clocks differ"
            )
        elif inside and _doubtful(swap, past, now):
            doubts.append(f"the clock went back, so the time of the decision of {_day(swap.at)} is not certain")
    if doubts:
        judgement.hold.append(
            "it is not certain which tables were on while the machine was measured, and "
            f"{'no table' if taken is None else f'version {taken}'} was taken out: "
            f"{'; '.join(dict.fromkeys(doubts))}; {how_to_state(job.name, measurement, 'VERSION|none')}"
        )


def version_said(text: str) -> int | str | None:
    """Return the version that ``active_table`` names, None for "none" or "bare", another text as it is."""
    word = text.lower()
    number = word.removeprefix("v")
    return None if word in ("none", "bare") else int(number) if number.isdecimal() and number.isascii() else text


def how_to_state(name: str, measurement: MeasurementRecord, tables: str) -> str:
    """Say how a person states which tables were on; ``tables`` is a version, "none" or how to write either."""
    return (
        f"state it: `volcomp recal reprocess {name} --measurement {measurement.id} --active-table {tables} --reason TEXT`, "
        f"or `# active_table = {tables}` in the next file"
    )


def _doubtful(decision: DecisionRecord, past: Past, now: datetime) -> bool:
    """Whether the clock stood ahead when this was decided: something that came later has an earlier time."""
    if decision.at > now:
        return True
    if any(item.at < decision.at <= _seen(item) for item in past.events if item.kind == CLOCK):
        return True
    known = {item.table_id for item in past.decisions if item.sequence <= decision.sequence}
    return any(table.at < decision.at for table in past.tables if table.id not in known)


def _seen(event: EventRecord) -> datetime:
    """Time of the newest entry when the clock was found to have gone back, from the end of the message."""
    try:
        return datetime.fromisoformat(event.message.rsplit(" ", 1)[-1]) + timedelta(seconds=1)
    except ValueError:
        return event.at


@dataclass(frozen=True)
class Earlier:
    """Tables that are or were active, by version, in the order in which they became active.

    ``taken`` is the version that was taken out of the readings, ``active`` the one that is active now; None for none.
    """

    tables: Mapping[int, ReadTables]
    taken: int | None
    active: int | None


def judge_likeness(
    judgement: Judgement,
    store: Store,
    job: MachineJob,
    machine: Machine,
    measurement: MeasurementRecord,
    result: RunResult,
    old: IdentificationRecord,
    earlier: Earlier,
) -> None:
    """Hold where the machine seems to have changed by what some tables add, or by the opposite.

    ``old`` are the errors behind the active tables, or behind the last ones that were.
    """
    identified = result.identification
    old_errors = store.errors_of(old)
    if not set(old_errors.names) <= set(identified.errors.names):
        return  # held for that; a part of the errors has no field to compare
    points = Points(volume_points(machine))
    adds = {version: _added(machine, tables, points) for version, tables in earlier.tables.items()}
    added = {f"version {version}": field for version, field in adds.items()}
    order, taken = list(adds), earlier.taken
    if taken in adds:  # the clock may be late: a later version was on already
        later = order[order.index(taken) + 1 :]
        added |= {f"version {version} in place of version {taken}": adds[version] - adds[taken] for version in later}
    missing = {f"version {version}": adds[version] for version in order if version in (taken, earlier.active)}
    new = (identified.errors, joint_covariance(identified) if identified.has_covariance else None)
    found = likeness(machine, new, (old_errors, store.covariance_of(old)), added, missing)
    if found is None:
        return
    judgement.figures["likeness"] = found.summary()
    was = "nothing was" if taken is None else f"version {taken} was"
    seems = "was on" if found.sign > 0 else "was off"
    what = "what" if found.sign > 0 else "the opposite of what"
    version = f"v{found.field.split()[1]}" if found.sign > 0 else "none"
    judgement.hold.append(
        f"the machine seems to have changed by {what} {found.field} adds ({found.words()}): as if {found.field} {seems} "
        f"while the machine was measured, but {was} taken out; "
        f"{how_to_state(job.name, measurement, version)}; if the machine has really changed, approve with --override"
    )


def _added(machine: Machine, tables: ReadTables, points: Points) -> FloatArray:
    """What tables add to the commands, mean of both directions of travel, (n, 3), mm."""
    sides = [np.full_like(points.position_mm, side) for side in (1.0, -1.0)]
    return np.asarray(
        0.5 * sum(tables.correction(machine, Points(points.position_mm, approach=side)) for side in sides)
    )


def judge_twins(
    judgement: Judgement, store: Store, job: MachineJob, machine: MachineRecord, measurement: MeasurementRecord
) -> None:
    """Hold what came for another machine as well: readings belong to one machine."""
    found = [f"{name} ({what})" for name, what in store.same_files_of_others(machine, measurement)]
    contents = store.contents_of(measurement)
    for other in job.others:
        if not any(text.startswith(f"{other.name} (") for text in found) and holds_one_of(other, contents.values()):
            where = "the same inbox" if other.inbox.resolve() == job.inbox.resolve() else "its inbox"
            found.append(f"{other.name} ({where})")
    if found:
        judgement.figures["also_came_for"] = found
        judgement.hold.append(
            f"the same file also came for {', '.join(found)}; readings belong to one machine. Give each machine an inbox of "
            "its own and remove the file from the wrong one; then reject the version of the wrong machine with `compgen "
            "recal reject` and approve that of the right one with --override"
        )


def _temperature(window_c: tuple[float, float], channels: Mapping[str, Mapping[str, float]]) -> list[str]:
    low, high = window_c
    if not channels:
        return [f"no temperature was logged, but {low:g} to {high:g} degC are asked for"]
    outside: dict[str, list[str]] = {}
    for name, figures in channels.items():
        if figures["low"] < low or figures["high"] > high:
            outside.setdefault(f"went from {figures['low']:.2f} to {figures['high']:.2f} degC", []).append(name)
    allowed = f"{low:g} to {high:g} degC are allowed"
    return [f"{', '.join(names)} {went}; {allowed}" for went, names in outside.items()]


def _day(time: datetime) -> str:
    return time.isoformat(timespec="minutes")


def shows_all(judgement: Judgement, store: Store, result: RunResult, active: ActiveState) -> bool:
    """Whether the measurement shows every error that the active tables take out; otherwise the new ones would drop some.

    A laser along one axis shows its positioning only: tables from that alone forget squareness, straightness and angles,
    and nothing in that measurement says so.
    """
    known = {*result.identification.errors.names}
    missing = [name for name in store.errors_of(active.identification).names if name not in known]
    if missing:
        judgement.figures["errors_not_shown"] = missing
        judgement.hold.append(
            f"the measurement does not show {', '.join(missing)}, which version {active.version} takes out and the new "
            "tables would not; measure them all"
        )
    return not missing


def judge_change(
    judgement: Judgement, store: Store, machine: Machine, result: RunResult, active: ActiveState, policy: Policy
) -> Change | None:
    """Compare with the errors behind the active tables: the change must exceed its uncertainty."""
    identified = result.identification
    new = spread_of(identified.errors, joint_covariance(identified) if identified.has_covariance else None)
    old_errors = store.errors_of(active.identification)
    old = spread_of(old_errors, store.covariance_of(active.identification))
    if new is None or old is None:
        judgement.hold.append("the uncertainty of the errors is not known, so the change cannot be judged")
        return None
    change = change_between(machine, (identified.errors, new), (old_errors, old), policy.confidence)
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
    """Compare what the new tables leave with what the active ones leave now, and how far the axes move."""
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
    """Hold back what does not shrink the residual, or moves the axes by more than the limits."""
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
    """Change of the correction at the reference point, um, x, y, z; the larger one of both directions of travel."""
    position = np.array([machine.reference_point_mm], dtype=np.float64)
    found = np.zeros(3)
    for side in (1.0, -1.0):
        points = Points(position, approach=np.full_like(position, side))
        shift = new.correction(machine, points)[0]
        if active is not None:
            shift = shift - active.correction(machine, points)[0]
        found = np.where(np.abs(shift) > np.abs(found), shift, found)
    return [float(value) / MM_PER_UM + 0.0 for value in found]
