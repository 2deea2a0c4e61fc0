"""The acceptance policy: what new tables are held back for, with the figures behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.points import Points
from compgen.identify import joint_covariance
from compgen.pipeline import RunResult, identified_reversal
from compgen.recal.change import Change, change_between, spread_of
from compgen.recal.job import Policy
from compgen.recal.records import IdentificationRecord, MeasurementRecord, TableRecord
from compgen.recal.store import Store
from compgen.verify import ReadTables, verify
from compgen.verify.diff import difference

#: A measurement from further in the future than this has a wrong time.
FUTURE = timedelta(days=1)


@dataclass
class Judgement:
    """Reasons to hold tables back, and figures by name; both grow while the rules are looked at."""

    hold: list[str] = field(default_factory=list)
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
