"""One machine over time: measurements, identified errors, tables and decisions."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from compgen.core.error_table import ErrorTable
from compgen.core.names import error_named
from compgen.recal.counting import counting
from compgen.recal.exclude import excluded
from compgen.recal.records import (
    AttemptRecord,
    DecisionRecord,
    EventRecord,
    IdentificationRecord,
    MachineRecord,
    MeasurementRecord,
    TableRecord,
)
from compgen.recal.store import Store
from compgen.serve.chart import UNITS, Chart, Series, chart

#: Expanded uncertainty: this many standard uncertainties, about 95 %.
COVERAGE = 2.0
#: Measurements that the charts go back, and rows that a page shows of what grows for ever.
CHARTED, LISTED = 60, 200


@dataclass(frozen=True)
class Trend:
    """One error over the measurements: chart, newest value, change since the one before and since the first.

    Values and expanded uncertainties in ``unit``; for an error that is a function of position the value is its largest
    minus its smallest value, without an uncertainty.
    """

    name: str
    what: str
    unit: str
    value: float
    expanded: float
    since_last: float | None
    since_first: float | None
    chart: Chart | None

    @property
    def direction(self) -> str:
        """How the newest value lies to the first, in a word."""
        if self.since_first is None or self.since_first == 0.0:
            return "unchanged"
        return "up" if self.since_first > 0.0 else "down"


@dataclass(frozen=True)
class History:
    """Everything that the page of a machine shows, newest first; charts run from old to new."""

    machine: MachineRecord
    active: TableRecord | None
    tables: Sequence[TableRecord]
    measurements: Sequence[MeasurementRecord]
    decisions: Sequence[DecisionRecord]
    failures: Sequence[AttemptRecord]
    events: Sequence[EventRecord]
    trends: Sequence[Trend]
    temperature: Chart | None
    versions: Mapping[int, int]

    @property
    def open(self) -> list[TableRecord]:
        """Tables that wait for a person."""
        return [table for table in self.tables if table.state in ("pending", "held")]

    @property
    def earlier(self) -> list[TableRecord]:
        """Tables that a rollback may bring back."""
        return [table for table in self.tables if table.state == "retired"]


def history(store: Store, errors_of: ErrorCache, machine: MachineRecord) -> History:
    """Collect the history of a machine, as it is at one moment."""
    return store.together(lambda: _history(store, errors_of, machine))


def _history(store: Store, errors_of: ErrorCache, machine: MachineRecord) -> History:
    tables = store.tables(machine)
    measurements = store.measurements(machine)
    failures = [attempt for attempt in store.attempts(machine) if attempt.outcome == "failed"]
    return History(
        machine,
        next((table for table in tables if table.state == "active"), None),
        tables[::-1][:LISTED],
        measurements[::-1][:LISTED],
        store.decisions(machine)[::-1][:LISTED],
        failures[::-1][:20],
        store.events(machine)[::-1][:20],
        trends(errors_of, counting(store, machine)[-CHARTED:], set(excluded(store, machine))),
        _temperatures(measurements[-CHARTED:]),
        {table.id: table.version for table in tables},
    )


def trends(
    errors_of: ErrorCache, identifications: Sequence[IdentificationRecord], left_out: Collection[int] = ()
) -> list[Trend]:
    """Return the squareness errors and the span of every curve over time, as far as they were identified.

    Measurements whose ids are ``left_out`` are drawn, but do not count.
    """
    found = [(item.measured_at, errors_of(item), item.measurement_id in left_out) for item in identifications]
    counted = [(at, table) for at, table, out in found if not out]
    if not counted:
        return []
    others = [(at, table) for at, table, out in found if out]
    names = sorted(counted[-1][1].names, key=lambda name: error_named(name).kind != "squareness")
    return [_trend(name, counted, others) for name in names]


def _trend(
    name: str, found: Sequence[tuple[datetime, ErrorTable]], left_out: Sequence[tuple[datetime, ErrorTable]]
) -> Trend:
    error = error_named(name)
    rows = [(at, *_figure(table, name)) for at, table in found if name in table.names]
    grey = [(at, _figure(table, name)[0] / error.si_per_unit) for at, table in left_out if name in table.names]
    values = [row[1] / error.si_per_unit for row in rows]
    spread = [row[2] / error.si_per_unit * COVERAGE for row in rows]
    what = "value" if error.kind == "squareness" else "largest minus smallest"
    times = [row[0] for row in rows]
    series = Series(name, [time.timestamp() for time in times], values, spread)
    outside = Series("left out", [at.timestamp() for at, _ in grey], [value for _, value in grey])
    return Trend(
        name,
        what,
        error.unit,
        values[-1],
        spread[-1],
        values[-1] - values[-2] if len(values) > 1 else None,
        values[-1] - values[0] if len(values) > 1 else None,
        chart(f"{name}, {what}, {UNITS[error.unit]}", [series], time_ticks([*times, *(at for at, _ in grey)]), outside),
    )


def _figure(table: ErrorTable, name: str) -> tuple[float, float]:
    """Return value and standard uncertainty, mm or rad."""
    if name in table.squareness:
        return table.squareness[name]
    return float(np.ptp(table.curves[name].value)), float("nan")


def _temperatures(measurements: Sequence[MeasurementRecord]) -> Chart | None:
    channels = sorted({name for item in measurements for name in item.temperatures_c})
    series = []
    for channel in channels:
        kept = [item for item in measurements if channel in item.temperatures_c]
        figures = [item.temperatures_c[channel].get("mean", float("nan")) for item in kept]
        series.append(Series(channel, [item.measured_at.timestamp() for item in kept], figures))
    times = [item.measured_at for item in measurements if item.temperatures_c]
    return chart("Temperatures while measuring, \N{DEGREE SIGN}C", series, time_ticks(times))


def time_ticks(times: Sequence[datetime], most: int = 4) -> list[tuple[float, str]]:
    """Return days, evenly over the time, as (seconds, text); times of less than a day show the minute."""
    if not times:
        return []
    first, last = min(times), max(times)
    count = 1 if first == last else most
    form = "%Y-%m-%d" if last - first > timedelta(days=2) else "%m-%d %H:%M"
    places = [first + (last - first) * (k / max(1, count - 1)) for k in range(count)]
    return [(place.timestamp(), place.strftime(form)) for place in places]


class ErrorCache:
    """Errors of identifications, which never change; those that were asked for last stay in memory."""

    def __init__(self, store: Store, most: int = 5000) -> None:
        self._store, self._most, self._lock = store, most, threading.Lock()
        self._tables: OrderedDict[str, ErrorTable] = OrderedDict()

    def __call__(self, identification: IdentificationRecord) -> ErrorTable:
        """Return the errors, mm and rad."""
        key = identification.errors_sha256
        with self._lock:
            if key in self._tables:
                self._tables.move_to_end(key)
                return self._tables[key]
        table = self._store.errors_of(identification)
        with self._lock:
            self._tables[key] = table
            while len(self._tables) > self._most:
                self._tables.popitem(last=False)
        return table
