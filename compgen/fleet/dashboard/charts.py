"""Charts and figures of one machine: errors over time, and proposed compared with active tables."""

from __future__ import annotations

import difflib
import math
import threading
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from compgen.data.error_table import ErrorTable
from compgen.data.files import sha256_of
from compgen.data.names import COVERAGE, error_named
from compgen.drawing.charts import LABEL, tick_texts, ticks
from compgen.fleet.decisions import excluded
from compgen.fleet.records import (
    OPEN,
    AttemptRecord,
    DecisionRecord,
    EventRecord,
    IdentificationRecord,
    MachineRecord,
    MeasurementRecord,
    StoredTableFile,
    TableRecord,
    active_of,
    comparable,
)
from compgen.fleet.store import Store, at_one_moment, counting

# --- geometry: plain numbers that a template turns into SVG; colours come from the style sheet -----------------------

#: Size of a chart and its margins (left, right, top, bottom), px.
WIDTH, HEIGHT = 620.0, 200.0
MARGINS = (64.0, 16.0, 12.0, 30.0)


@dataclass(frozen=True)
class ChartSeries:
    """One line: x, y and the half width of the interval about y (nan if unknown).

    ``marked``: whether its points are drawn.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    u: Sequence[float] = ()
    marked: bool = True


@dataclass(frozen=True)
class Mark:
    """One point in px; ``low`` and ``high`` are the ends of its interval."""

    x: float
    y: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Chart:
    """Everything in px: ticks as (position, text), lines as text for ``points``, marks with their intervals.

    ``left_out`` are points that do not count; they are drawn at the edge if outside the scale.
    """

    title: str
    x_ticks: Sequence[tuple[float, str]]
    y_ticks: Sequence[tuple[float, str]]
    lines: Sequence[tuple[str, str, Sequence[Mark]]]
    width: float = WIDTH
    height: float = HEIGHT
    left: float = MARGINS[0]
    right: float = WIDTH - MARGINS[1]
    top: float = MARGINS[2]
    bottom: float = HEIGHT - MARGINS[3]
    left_out: Sequence[Mark] = ()


def chart(
    title: str,
    series: Sequence[ChartSeries],
    x_ticks: Sequence[tuple[float, str]] | None = None,
    left_out: ChartSeries | None = None,
) -> Chart | None:
    """Return a chart of lines; None if there is no point to draw.

    ``x_ticks`` are positions and texts below the axis; by default round numbers. Points that are ``left_out`` do not
    extend the y scale.
    """
    kept = [_finite(item) for item in series]
    xs = [x for item in kept for x in item.x]
    if not xs:
        return None
    grey = None if left_out is None else _finite(left_out)
    xs += [] if grey is None else grey.x
    ys = [y + side * u for item in kept for y, u in zip(item.y, item.u, strict=True) for side in (-1.0, 1.0)]
    y_marks = ticks(min(ys), max(ys), around=True)
    low, high = min(*ys, y_marks[0]), max(*ys, y_marks[-1])
    across = _Scale(min(xs), max(xs), MARGINS[0] + 8, WIDTH - MARGINS[1] - 8)
    up = _Scale(low, high, HEIGHT - MARGINS[3], MARGINS[2])
    outside = []
    for mark in [] if grey is None else _line(grey, across, up)[2]:  # points beyond the scale go to its edge
        y = min(max(mark.y, MARGINS[2]), HEIGHT - MARGINS[3])
        outside.append(mark if y == mark.y else Mark(mark.x, y, None, None))
    if x_ticks is None:
        x_marks = ticks(min(xs), max(xs), around=True)
        x_ticks = list(zip(x_marks, tick_texts(x_marks), strict=True))
    return Chart(
        title,
        [(across(x), text) for x, text in x_ticks if min(xs) <= x <= max(xs)],
        [(up(y), text) for y, text in zip(y_marks, tick_texts(y_marks), strict=True)],
        [_line(item, across, up) for item in kept],
        left_out=outside,
    )


class _Scale:
    """Linear map from values to px; if all values are equal, they are drawn in the middle."""

    def __init__(self, low: float, high: float, start: float, end: float) -> None:
        self.low, self.span, self.start, self.end = low, high - low, start, end

    def __call__(self, value: float) -> float:
        part = (value - self.low) / self.span if self.span > 0.0 else 0.5
        return round(self.start + part * (self.end - self.start), 1)


def _finite(item: ChartSeries) -> ChartSeries:
    u = item.u or [0.0] * len(item.x)
    rows = [row for row in zip(item.x, item.y, u, strict=True) if math.isfinite(row[0]) and math.isfinite(row[1])]
    spread = [row[2] if math.isfinite(row[2]) else 0.0 for row in rows]
    return ChartSeries(item.label, [row[0] for row in rows], [row[1] for row in rows], spread, item.marked)


def _line(item: ChartSeries, across: _Scale, up: _Scale) -> tuple[str, str, list[Mark]]:
    marks = []
    for x, y, u in zip(item.x, item.y, item.u, strict=True):
        low, high = (up(y - u), up(y + u)) if u > 0.0 else (None, None)
        marks.append(Mark(across(x), up(y), low, high))
    return item.label, " ".join(f"{mark.x},{mark.y}" for mark in marks), marks if item.marked else []


# --- one machine over time -----------------------------------------------------------------------------------------

#: Number of measurements in the charts, and of rows that a page shows of ever-growing lists.
CHARTED, LISTED = 60, 200


@dataclass(frozen=True)
class ErrorHistory:
    """One error over the measurements: chart, newest value, change since the previous and since the first value.

    Values and expanded uncertainties in ``unit``; for an error that is a function of position the value is its largest
    minus its smallest value, without uncertainty.
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
        """The newest value compared with the first, in one word."""
        if self.since_first is None or self.since_first == 0.0:
            return "unchanged"
        return "up" if self.since_first > 0.0 else "down"


@dataclass(frozen=True)
class History:
    """Everything that a machine's page shows, newest first; charts run from old to new.

    ``without_prior``: identifications that had none.
    """

    machine: MachineRecord
    active: TableRecord | None
    tables: Sequence[TableRecord]
    measurements: Sequence[MeasurementRecord]
    decisions: Sequence[DecisionRecord]
    failures: Sequence[AttemptRecord]
    events: Sequence[EventRecord]
    trends: Sequence[ErrorHistory]
    temperature: Chart | None
    versions: Mapping[int, int]
    without_prior: Collection[int] = ()

    @property
    def open(self) -> list[TableRecord]:
        """Versions of tables that wait for a decision."""
        return [table for table in self.tables if table.state in OPEN]

    @property
    def earlier(self) -> list[TableRecord]:
        """Tables that a rollback may bring back."""
        return [table for table in self.tables if table.state == "retired"]


@at_one_moment
def history(store: Store, errors_of: ErrorCache, machine: MachineRecord) -> History:
    """Collect the history of a machine at one moment."""
    tables = store.tables(machine)
    measurements = store.measurements(machine)
    failures = [attempt for attempt in store.attempts(machine) if attempt.outcome == "failed"]
    return History(
        machine,
        active_of(tables),
        tables[::-1][:LISTED],
        measurements[::-1][:LISTED],
        store.decisions(machine)[::-1][:LISTED],
        failures[::-1][:20],
        store.events(machine)[::-1][:20],
        trends(errors_of, counting(store, machine)[-CHARTED:], set(excluded(store, machine))),
        _temperatures(measurements[-CHARTED:]),
        {table.id: table.version for table in tables},
        store.without_prior(machine),
    )


def trends(
    errors_of: ErrorCache, identifications: Sequence[IdentificationRecord], left_out: Collection[int] = ()
) -> list[ErrorHistory]:
    """Return the squareness errors and the span of every curve over time, where identified.

    Measurements with ids in ``left_out`` are drawn, but do not count.
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
) -> ErrorHistory:
    error = error_named(name)
    times, values, spread = zip(*_figures(name, found), strict=True)
    grey = [(at, value) for at, value, _ in _figures(name, left_out)]
    what = "value" if error.kind == "squareness" else "largest minus smallest"
    series = ChartSeries(name, [time.timestamp() for time in times], values, spread)
    outside = ChartSeries("left out", [at.timestamp() for at, _ in grey], [value for _, value in grey])
    return ErrorHistory(
        name,
        what,
        error.unit,
        values[-1],
        spread[-1],
        values[-1] - values[-2] if len(values) > 1 else None,
        values[-1] - values[0] if len(values) > 1 else None,
        chart(f"{name}, {what}, {LABEL[error.unit]}", [series], time_ticks([*times, *(at for at, _ in grey)]), outside),
    )


def _figures(name: str, found: Sequence[tuple[datetime, ErrorTable]]) -> list[tuple[datetime, float, float]]:
    """Return time, value and expanded uncertainty of an error, in the units of files, from the tables that have it."""
    unit, rows = error_named(name).si_per_unit, []
    for at, table in found:
        if name in table.squareness:
            value, u = table.squareness[name]
            rows.append((at, value / unit, u / unit * COVERAGE))
        elif name in table.curves:
            rows.append((at, float(np.ptp(table.curves[name].value)) / unit, float("nan")))
    return rows


def _temperatures(measurements: Sequence[MeasurementRecord]) -> Chart | None:
    channels = sorted({name for item in measurements for name in item.temperatures_c})
    series = []
    for channel in channels:
        kept = [item for item in measurements if channel in item.temperatures_c]
        figures = [item.temperatures_c[channel].get("mean", float("nan")) for item in kept]
        series.append(ChartSeries(channel, [item.measured_at.timestamp() for item in kept], figures))
    times = [item.measured_at for item in measurements if item.temperatures_c]
    return chart("Temperatures while measuring, \N{DEGREE SIGN}C", series, time_ticks(times))


def time_ticks(times: Sequence[datetime], most: int = 4) -> list[tuple[float, str]]:
    """Return days, evenly spaced in time, as (seconds, text); if they span at most two days, with hour and minute."""
    if not times:
        return []
    first, last = min(times), max(times)
    count = 1 if first == last else most
    form = "%Y-%m-%d" if last - first > timedelta(days=2) else "%m-%d %H:%M"
    places = [first + (last - first) * (k / max(1, count - 1)) for k in range(count)]
    return [(place.timestamp(), place.strftime(form)) for place in places]


class ErrorCache:
    """Errors of identifications, which never change; the most recently requested stay in memory."""

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


# --- one set of tables: figures of the judgement, errors, text of the files, before and after ------------------------

#: Figures of the volume to compare, and their names.
FIGURES = {
    "rms_um": "rms of the error vector",
    "p95_um": "95th percentile of the error vector",
    "max_um": "largest error vector",
    "v_x_um": "range of the error in X",
    "v_y_um": "range of the error in Y",
    "v_z_um": "range of the error in Z",
}
#: Limits: curves drawn, lines of a difference, bytes of a compared file.
DRAWN, DIFF_LINES, DIFF_BYTES = 6, 400, 400_000


@dataclass(frozen=True)
class VolumeComparison:
    """Error of one control in the volume, um: rows of (name, without tables, with the active tables, with these).

    Without ``volumetric`` the figures contain only the effect of the measured errors.
    """

    controller: str
    rows: Sequence[tuple[str, float | None, float | None, float | None]]
    largest_change_um: float | None
    reference_change_um: Mapping[str, float]
    accepted: bool | None
    volumetric: bool = True

    def bars(self, *values: float | None) -> list[float]:
        """Return the lengths of bars for these figures, the longest 200 px."""
        known = [value for value in values if value is not None]
        largest = max(known, default=0.0) or 1.0
        return [round(200.0 * value / largest, 1) for value in known]


@dataclass(frozen=True)
class FileView:
    """One file of the tables: its number in the set, hash and size of its contents, difference from the active file."""

    number: int
    file: StoredTableFile
    sha256: str
    difference: Sequence[str]
    note: str

    @property
    def size(self) -> int:
        """Size in bytes."""
        return len(self.file.content)


@dataclass(frozen=True)
class ErrorComparison:
    """One error, as identified now and for the active tables, in ``unit``.

    ``expanded`` belongs to the change; None if one was identified with a prior and the other without.
    """

    name: str
    unit: str
    now: float
    before: float | None
    expanded: float | None

    @property
    def change(self) -> float | None:
        """Now minus before."""
        return None if self.before is None else self.now - self.before

    @property
    def significant(self) -> bool:
        """Whether the change exceeds its expanded uncertainty."""
        return self.change is not None and self.expanded is not None and abs(self.change) > self.expanded


@dataclass(frozen=True)
class Proposal:
    """Everything that the page of a set of tables shows."""

    machine: MachineRecord
    table: TableRecord
    active: TableRecord | None
    measurement: MeasurementRecord | None
    change: Mapping[str, Any]
    likeness: Mapping[str, Any]
    evidence: Mapping[str, Any]
    comparisons: Sequence[VolumeComparison]
    squareness: Sequence[ErrorComparison]
    curves: Sequence[Chart]
    files: Sequence[FileView]
    decisions: Sequence[DecisionRecord]
    without_prior: bool = False


def find_table(store: Store, machine: MachineRecord, version: int) -> TableRecord | None:
    """Return one version of a machine's tables, None if there is none."""
    return next((table for table in store.tables(machine) if table.version == version), None)


@at_one_moment
def proposal(store: Store, errors_of: ErrorCache, machine: MachineRecord, table: TableRecord) -> Proposal:
    """Collect what a person needs to decide on a set of tables, at one moment."""
    identification = store.identification(table.identification_id)
    active = active_of(store.tables(machine))
    behind = None if active is None or active.id == table.id else store.identification(active.identification_id)
    measured = [item for item in store.measurements(machine) if item.id == identification.measurement_id]
    now, before = errors_of(identification), None if behind is None else errors_of(behind)
    return Proposal(
        machine,
        table,
        active,
        measured[0] if measured else None,
        _mapping(table.summary.get("change")),
        _mapping(table.summary.get("likeness")),
        _mapping(table.summary.get("evidence")),
        comparisons(table),
        _squareness(now, before, alike=behind is None or comparable(identification.summary, behind.summary)),
        _curves(now, before),
        file_views(store, table, active),
        [item for item in store.decisions(machine) if item.table_id == table.id],
        identification.without_prior,
    )


def comparisons(table: TableRecord) -> list[VolumeComparison]:
    """Return for each control the error of the volume without tables, with the active tables and with these."""
    results, remaining = _mapping(table.summary.get("result")), _mapping(table.summary.get("remaining"))
    moved = _mapping(table.summary.get("correction"))
    return [
        _comparison(name, _mapping(results.get(name)), _mapping(remaining.get(name)), _mapping(moved.get(name)))
        for name in table.controllers
    ]


def _comparison(
    name: str, result: Mapping[str, Any], remaining: Mapping[str, Any], moved: Mapping[str, Any]
) -> VolumeComparison:
    def standing(key: str) -> Mapping[str, Any]:
        found = _mapping(remaining.get(key))
        return _mapping(found.get("as_it_stands", found))

    without, active = _mapping(result.get("before")), standing("active")
    proposed = _mapping(result.get("after")) or standing("proposed")
    rows = [
        (text, _number(without.get(key)), _number(active.get(key)), _number(proposed.get(key)))
        for key, text in FIGURES.items()
    ]
    reference = {
        str(k).upper(): float(v)
        for k, v in _mapping(moved.get("reference_change_um")).items()
        if _number(v) is not None
    }
    accepted = result.get("accepted") if isinstance(result.get("accepted"), bool) else None
    known = [row for row in rows if any(value is not None for value in row[1:])]
    return VolumeComparison(
        name, known, _number(moved.get("max_change_um")), reference, accepted, result.get("volumetric") is not False
    )


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _squareness(now: ErrorTable, before: ErrorTable | None, *, alike: bool) -> list[ErrorComparison]:
    """Compare the squareness errors; without the uncertainty of the change where the two are not ``alike``."""
    found = []
    for name, (value, u) in now.squareness.items():
        error = error_named(name)
        old, old_u = (None, 0.0) if before is None else before.squareness.get(name, (None, 0.0))
        expanded = COVERAGE * float(np.hypot(u, old_u)) / error.si_per_unit if alike or old is None else None
        old = None if old is None else old / error.si_per_unit
        found.append(ErrorComparison(name, error.unit, value / error.si_per_unit, old, expanded))
    return found


def _curves(now: ErrorTable, before: ErrorTable | None) -> list[Chart]:
    """Draw the curves that changed most, or the largest if there are no earlier ones: linear, then angular errors."""
    old = {} if before is None else before.curves

    def change(name: str) -> float:
        curve = now.curves[name]
        other = old[name].at(curve.position_mm) if name in old else 0.0
        return float(np.max(np.abs(curve.value - other))) / error_named(name).si_per_unit

    names = sorted(now.curves, key=lambda name: (error_named(name).kind != "linear", -change(name)))[:DRAWN]
    charts = []
    for name in names:
        error, curve = error_named(name), now.curves[name]
        scale = 1.0 / error.si_per_unit
        u = (curve.u * scale * COVERAGE).tolist()
        series = [ChartSeries("this measurement", curve.position_mm.tolist(), (curve.value * scale).tolist(), u)]
        if name in old:
            place, value = old[name].position_mm.tolist(), (old[name].value * scale).tolist()
            series.append(ChartSeries("measurement of the active tables", place, value))
        charts.append(chart(f"{name}, {LABEL[error.unit]} over {'XYZ'[error.axis]}, mm", series))
    return [item for item in charts if item is not None]


def file_views(store: Store, table: TableRecord, active: TableRecord | None) -> list[FileView]:
    """Return the files of a set of tables and their differences from the active file of the same control and name."""
    others: dict[tuple[str, str], bytes] = {}
    if active is not None and active.id != table.id:
        others = {(file.controller, file.name): file.content for file in store.table_files(active)}
    views = []
    for number, file in enumerate(store.table_files(table), start=1):
        old, new = others.get((file.controller, file.name)), file.content
        lines: list[str] = []
        if old is None:
            note = "no active file to compare with"
        elif old == new:
            note = "the same bytes as the active file"
        elif max(len(old), len(new)) > DIFF_BYTES or b"\0" in old or b"\0" in new:
            note = "differs; the difference is not shown because the file is too large or is not text"
        else:
            before, after = (content.decode("utf-8", "replace").splitlines() for content in (old, new))
            lines = list(difflib.unified_diff(before, after, "active", "this version", n=1, lineterm=""))
            note = "" if len(lines) <= DIFF_LINES else f"the first {DIFF_LINES} of {len(lines)} lines of the difference"
        views.append(FileView(number, file, sha256_of(new), lines[:DIFF_LINES], note))
    return views
