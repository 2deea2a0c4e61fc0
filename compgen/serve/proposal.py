"""Before and after of one set of tables: figures of the judgement, errors, text of the files."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.core.error_table import ErrorTable
from compgen.core.files import sha256_of
from compgen.core.names import error_named
from compgen.recal.records import (
    DecisionRecord,
    MachineRecord,
    MeasurementRecord,
    TableFile,
    TableRecord,
)
from compgen.recal.store import Store
from compgen.serve.chart import UNITS, Chart, Series, chart
from compgen.serve.history import COVERAGE, ErrorCache

#: Figures of the volume that are compared, and their names.
FIGURES = {
    "rms_um": "rms of the error vector",
    "p95_um": "95 % of the points stay below",
    "max_um": "largest error vector",
    "v_x_um": "range in X",
    "v_y_um": "range in Y",
    "v_z_um": "range in Z",
}
#: Curves that are drawn, lines of a difference and bytes of a file that are looked at.
DRAWN, DIFF_LINES, DIFF_BYTES = 6, 400, 400_000


@dataclass(frozen=True)
class Comparison:
    """Error of one control in the volume, um: rows of (name, without tables, with the active ones, with these).

    Without ``volumetric`` the figures hold the effect of the measured errors alone.
    """

    controller: str
    rows: Sequence[tuple[str, float | None, float | None, float | None]]
    largest_change_um: float | None
    reference_change_um: Mapping[str, float]
    accepted: bool | None
    volumetric: bool = True

    def bars(self, *values: float | None) -> list[float]:
        """Return the lengths of bars for some figures, the longest 200 px."""
        known = [value for value in values if value is not None]
        largest = max(known, default=0.0) or 1.0
        return [round(200.0 * value / largest, 1) for value in known]


@dataclass(frozen=True)
class FileView:
    """One file of the tables: its number in the set, contents' hash and size, difference to the active file."""

    number: int
    file: TableFile
    sha256: str
    difference: Sequence[str]
    note: str

    @property
    def size(self) -> int:
        """Size in bytes."""
        return len(self.file.content)


@dataclass(frozen=True)
class ErrorChange:
    """One error, identified now and behind the active tables, in ``unit``; ``expanded`` belongs to the change."""

    name: str
    unit: str
    now: float
    before: float | None
    expanded: float

    @property
    def change(self) -> float | None:
        """Now minus before."""
        return None if self.before is None else self.now - self.before

    @property
    def significant(self) -> bool:
        """Whether the change exceeds its expanded uncertainty."""
        return self.change is not None and abs(self.change) > self.expanded


@dataclass(frozen=True)
class Proposal:
    """Everything that the page of one set of tables shows."""

    machine: MachineRecord
    table: TableRecord
    active: TableRecord | None
    measurement: MeasurementRecord | None
    change: Mapping[str, Any]
    likeness: Mapping[str, Any]
    comparisons: Sequence[Comparison]
    squareness: Sequence[ErrorChange]
    curves: Sequence[Chart]
    files: Sequence[FileView]
    decisions: Sequence[DecisionRecord]


def find_table(store: Store, machine: MachineRecord, version: int) -> TableRecord | None:
    """Return one version of a machine's tables, None if there is none."""
    return next((table for table in store.tables(machine) if table.version == version), None)


def proposal(store: Store, errors_of: ErrorCache, machine: MachineRecord, table: TableRecord) -> Proposal:
    """Collect what a person needs to decide on a set of tables, as it is at one moment."""
    return store.together(lambda: _proposal(store, errors_of, machine, table))


def _proposal(store: Store, errors_of: ErrorCache, machine: MachineRecord, table: TableRecord) -> Proposal:
    identification = store.identification(table.identification_id)
    active = next((item for item in store.tables(machine) if item.state == "active"), None)
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
        comparisons(table),
        _squareness(now, before),
        _curves(now, before),
        file_views(store, table, active),
        [item for item in store.decisions(machine) if item.table_id == table.id],
    )


def comparisons(table: TableRecord) -> list[Comparison]:
    """Return for each control what the volume's error is without tables, with the active ones and with these."""
    results, remaining = _mapping(table.summary.get("result")), _mapping(table.summary.get("remaining"))
    moved = _mapping(table.summary.get("correction"))
    return [
        _comparison(name, _mapping(results.get(name)), _mapping(remaining.get(name)), _mapping(moved.get(name)))
        for name in table.controllers
    ]


def _comparison(
    name: str, result: Mapping[str, Any], remaining: Mapping[str, Any], moved: Mapping[str, Any]
) -> Comparison:
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
    return Comparison(
        name, known, _number(moved.get("max_change_um")), reference, accepted, result.get("volumetric") is not False
    )


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _squareness(now: ErrorTable, before: ErrorTable | None) -> list[ErrorChange]:
    found = []
    for name, (value, u) in now.squareness.items():
        error = error_named(name)
        old, old_u = (None, 0.0) if before is None else before.squareness.get(name, (None, 0.0))
        expanded = COVERAGE * float(np.hypot(u, old_u)) / error.si_per_unit
        old = None if old is None else old / error.si_per_unit
        found.append(ErrorChange(name, error.unit, value / error.si_per_unit, old, expanded))
    return found


def _curves(now: ErrorTable, before: ErrorTable | None) -> list[Chart]:
    """Draw the curves that changed most, or without earlier ones the largest: linear errors, then angles."""
    old = {} if before is None else before.curves

    def change(name: str) -> float:
        curve = now.curves[name]
        other = old[name].at(curve.position_mm) if name in old else 0.0
        return float(np.max(np.abs(curve.value - other))) / error_named(name).si_per_unit

    names = sorted(now.curves, key=lambda name: (error_named(name).kind != "linear", -change(name)))[:DRAWN]
    charts = (_curve_chart(name, now, old) for name in names)
    return [item for item in charts if item is not None]


def _curve_chart(name: str, now: ErrorTable, old: Mapping[str, Any]) -> Chart | None:
    error, curve = error_named(name), now.curves[name]
    factor = 1.0 / error.si_per_unit
    u = (curve.u * factor * COVERAGE).tolist()
    series = [Series("this measurement", curve.position_mm.tolist(), (curve.value * factor).tolist(), u)]
    if name in old:
        other = old[name]
        series.append(Series("behind the active tables", other.position_mm.tolist(), (other.value * factor).tolist()))
    return chart(f"{name}, {UNITS[error.unit]} over {'XYZ'[error.axis]}, mm", series)


def file_views(store: Store, table: TableRecord, active: TableRecord | None) -> list[FileView]:
    """Return the files of a set of tables with what differs from the active file of the same control and name."""
    others: dict[tuple[str, str], bytes] = {}
    if active is not None and active.id != table.id:
        others = {(file.controller, file.name): file.content for file in store.table_files(active)}
    views = []
    for number, file in enumerate(store.table_files(table), start=1):
        lines, note = _difference(others.get((file.controller, file.name)), file.content)
        views.append(FileView(number, file, sha256_of(file.content), lines, note))
    return views


def _difference(old: bytes | None, new: bytes) -> tuple[list[str], str]:
    if old is None:
        return [], "no active file to compare with"
    if old == new:
        return [], "the same bytes as the active file"
    if max(len(old), len(new)) > DIFF_BYTES or b"\0" in old or b"\0" in new:
        return [], "differs; too large or no text, so the difference is not shown"
    before, after = (content.decode("utf-8", "replace").splitlines() for content in (old, new))
    lines = list(difflib.unified_diff(before, after, "active", "this version", n=1, lineterm=""))
    note = "" if len(lines) <= DIFF_LINES else f"the first {DIFF_LINES} of {len(lines)} lines of the difference"
    return lines[:DIFF_LINES], note
