"""What the simulation knows, held against what the program said: used by the test and by ``seeds.py``."""

from dataclasses import dataclass
from datetime import datetime

import numpy as np
from factory import Year
from plant import (
    CRASH,
    CRASH_EC0Y_URAD,
    CRASH_EYY_UM,
    DAYS_A_MONTH,
    EC0Y_URAD_A_MONTH,
    UM,
    UM_A_METRE_KELVIN,
    URAD,
)

import compgen
from compgen.data.error_table import Curve, ErrorTable
from compgen.fleet.change import Calibration, aligned, calibrations_of
from compgen.fleet.drift import Drift, DriftSettings, FigureDrift, drift_report, interval_of
from compgen.fleet.store import open_store
from compgen.identification.covariance import covariance_or_independent
from compgen.kinematics import volumetric_error
from compgen.kinematics.many_points import volume_grid


@dataclass(frozen=True)
class Held:
    """A stated interval and the truth."""

    what: str
    low: float
    high: float
    truth: float

    @property
    def inside(self) -> bool:
        return self.low <= self.truth <= self.high


def figure(drift: Drift, name: str) -> FigureDrift:
    return next(item for item in drift.figures if item.figure.name == name)


def drift_after(year: Year, name: str, count: int | None = None, **settings) -> Drift:
    """Drift as it was told when ``count`` calibrations were known (all by default)."""
    store = open_store(year.job.store)
    try:
        history, _, machine = calibrations_of(store, store.machine(name))
    finally:
        store.close()
    return drift_report(machine, history[:count], DriftSettings(**settings), name=name)


def named_drifts(drift: Drift) -> set[str]:
    """Figures that are said to drift."""
    return {item.figure.name for item in drift.figures if item.trend is not None and item.adjusted < 0.05}


def rate(drift: Drift) -> Held:
    """EC0Y of A, urad a month."""
    value, u = figure(drift, "EC0Y").trend.slope
    low, high = interval_of(value, u, 0.95)
    scale = DAYS_A_MONTH / URAD
    return Held("rate of EC0Y", low * scale, high * scale, EC0Y_URAD_A_MONTH)


def exit_of(year: Year, drift: Drift) -> Held:
    """When EC0Y of A leaves its tolerance, days after the last calibration; the truth in the gauge of the history.

    The limit is where the tables stand, which is known, plus the tolerance; the true EC0Y goes there in a straight line.
    """
    found = figure(drift, "EC0Y")
    machine, last = year.factory.machine("mill-a"), datetime.fromisoformat(drift.times[-1])
    at_last = aligned(machine, [_exact(year, last)]).figure_values()[0]
    names = [item.name for item in aligned(machine, [_exact(year, last)]).figures]
    limit = found.reference + found.tolerance
    days = (limit - at_last[names.index("EC0Y")]) / (EC0Y_URAD_A_MONTH * URAD / DAYS_A_MONTH)
    return Held("exit of EC0Y", found.forecast.low_days, found.forecast.high_days, float(days))


def _exact(year: Year, at: datetime) -> Calibration:
    """The truth as a calibration; its uncertainties stand for weights only."""
    table = year.factory.truth("mill-a", at)
    curves = {name: Curve(c.position_mm, c.value, np.full(len(c.value), UM)) for name, c in table.curves.items()}
    known = ErrorTable(curves, {name: (value, URAD) for name, (value, _) in table.squareness.items()})
    return Calibration(at, known, covariance_or_independent(known, None))


def steps_of(drift: Drift) -> dict[str, tuple[int, Held | None]]:
    """Steps by figure: the calibration after it, and its size beside the truth where there is one (um, urad)."""
    truth = {"EYY line": (CRASH_EYY_UM, UM), "EC0Y": (CRASH_EC0Y_URAD, URAD)}
    found = {}
    for after, steps in drift.gaps.items():
        for item, step in steps:
            size, unit = truth.get(item.name, (None, 1.0))
            low, high = (end / unit for end in interval_of(step.size, step.u, 0.95))
            found[item.name] = (after, None if size is None else Held(f"step of {item.name}", low, high, size))
    return found


def gap_of_the_crash(drift: Drift) -> int:
    """Number of the first calibration after the crash."""
    return sum(datetime.fromisoformat(time) < CRASH for time in drift.times)


def coefficients(year: Year, drift: Drift) -> list[Held]:
    """Growth of the travel of C by temperature, um/K."""
    found = []
    for axis, (name, c) in zip(year.factory.machine("mill-c").axes, UM_A_METRE_KELVIN.items(), strict=True):
        low, high = interval_of(*figure(drift, f"E{name}{name} line").trend.per_kelvin, 0.95)
        found.append(Held(f"E{name}{name} by temperature", low / UM, high / UM, c * np.ptp(axis.range_mm) / 1000.0))
    return found


@dataclass(frozen=True)
class Judged:
    """One judgement against active tables: the true change over the volume, um rms, and what was found."""

    machine: str
    true_um: float
    expected_um: float
    significant: bool
    outside_window: bool


def judged(year: Year) -> list[Judged]:
    """Every judgement of a change of the year beside the true change since the measurement behind the active tables."""
    measured = _measured_at(year)
    found = []
    for row in year.rows:
        change = None if row.table is None else row.table.summary.get("change")
        if change is None or "deviations" in row.file:
            continue
        now, then = (
            measured[row.machine, version] for version in (row.table.version, row.table.summary["active_version"])
        )
        found.append(
            Judged(
                row.machine,
                true_change_um(year, row.machine, then, now),
                change["expected_rms_um"],
                change["significant"],
                "degC" in " ".join(row.table.reasons),
            )
        )
    return found


def _measured_at(year: Year) -> dict[tuple[str, int], datetime]:
    """When the measurement behind each version was made."""
    store, found = open_store(year.job.store), {}
    try:
        for machine in store.machines():
            at = {item.id: item.measured_at for item in store.identifications(machine)}
            found |= {(machine.name, t.version): at[t.identification_id] for t in store.tables(machine)}
    finally:
        store.close()
    return found


def true_change_um(year: Year, name: str, then: datetime, now: datetime) -> float:
    """Rms over the volume of what really changed, rigid motion taken out."""
    machine = year.factory.machine(name)
    position = volume_grid(machine, tuple(np.linspace(*axis.range_mm, 6) for axis in machine.axes)).position_mm
    fields = [volumetric_error(machine, year.factory.warm_truth(name, at), position) for at in (now, then)]
    moved = compgen.without_rigid_motion(position, fields[0] - fields[1])
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))) / UM
