"""Tables of readings along axes: a row for each reading, or a row for each target and a column for each run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.identify.axis_runs import SAME_TARGET_MM
from compgen.imports.amounts import labels_of
from compgen.imports.columns import FIELDS, MM_PER_LENGTH, RunColumn, run_columns, split_name, way
from compgen.imports.findings import Findings
from compgen.imports.further import Further, further_of
from compgen.imports.hypotheses import USUAL_URAD, slope_of, usual_deviation_mm
from compgen.imports.one_axis import IntArray, OneAxis, axis_in, cycles, motion, remarks
from compgen.imports.source import shown

#: A column without a telling name holds readings, not deviations, if it follows the targets so closely.
FOLLOWS = 1e-2
_TELLING = (
    "deviation",
    "abweichung",
    "error",
    "fehler",
    "230",
    "ecart",
    "scarto",
    "errore",
    "desviac",
    "\u504f\u5dee",
    "\u8bef\u5dee",
)


@dataclass(frozen=True)
class _Rows:
    """Cells in reading order: row of the table, number of the one-way run (0: unknown), label of direction (0: none)."""

    row: IntArray
    run: IntArray
    label: IntArray
    value: FloatArray
    key: str
    name: str


def axis_readings(findings: Findings, *, angular: bool = False) -> tuple[dict[str, OneAxis], Further]:
    """Return the readings of each axis, "" where nothing says which it is, and what stands beside the rows."""
    rows = _rows(findings)
    target = findings.positions_mm("position", findings.numbers("position"))[rows.row]
    value = _deviations(findings, rows, target, angular=angular)
    letters = _axes(findings, rows.row)
    further = further_of(findings, "axis", once=len(np.unique(rows.row)) == len(rows.row))
    found = {}
    for letter in dict.fromkeys(letters):
        own = np.flatnonzero(np.array(letters) == letter)
        line = np.array(findings.table.lines, dtype=np.int64)[rows.row[own]]
        direction, run = _directions(findings, target[own], rows.run[own], rows.label[own])
        beside = {name: values[rows.row[own]] for name, values in further.covariates.items()}
        by_rows = not rows.label[own].any() and findings.options.directions != "alternate"
        in_time = by_rows and bool(np.all(np.diff(rows.run[own]) >= 0))
        found[letter] = OneAxis(target[own], direction, run, value[own], line, beside, in_time)
        findings.notes += remarks(found[letter], letter, angular=angular)
    return found, further


def _rows(findings: Findings) -> _Rows:
    fields, header = findings.fields, findings.table.header
    key = next((name for name in ("actual", "deviation", "correction", "value") if name in fields), None)
    wide = run_columns(header, [column.name for column in fields.values()])
    if key is None and not wide:
        raise findings.table.grid.fail(
            f"has positions but no deviations or readings; the header has {shown(', '.join(header))}; "
            "give --map deviation=COLUMN",
            findings.table.header_line,
        )
    labels = _labels(findings)
    findings.used |= {fields[key].name} if key else {column.name for column in wide}
    if key is None:
        return _wide(findings, wide, labels)
    values = findings.numbers(key)
    run = np.zeros(len(values), dtype=np.int64)
    if "run" in fields:
        run = labels_of(findings, fields["run"])
        gaps = sorted(set(range(1, min(int(run.max()), 10_000) + 1)) - set(run.tolist()))
        if 0 < len(gaps) <= len(np.unique(run)):
            findings.notes.append(f"there is no run {', '.join(map(str, gaps[:8]))}")
        run = run + 1 - min(0, int(run.min())) if run.min() < 1 else run
    return _Rows(np.arange(len(values), dtype=np.int64), run, labels, values, key, fields[key].name)


def _labels(findings: Findings) -> IntArray:
    rows = len(findings.table.rows)
    if "direction" not in findings.fields:
        return np.zeros(rows, dtype=np.int64)
    name = findings.fields["direction"].name
    ways = []
    for cell, line in zip(findings.table.column(name), findings.table.lines, strict=True):
        one = way(cell)
        if one is None:
            empty = findings.table.grid.empty if not cell else ""
            raise findings.table.grid.fail(f"{shown(cell)} is no direction{empty}; +1 or -1 is due", line, name)
        ways.append(one)
    return np.array(ways, dtype=np.int64)


def _wide(findings: Findings, columns: Sequence[RunColumn], labels: IntArray) -> _Rows:
    """Columns of runs, one after the other; an empty cell is a reading that was not taken."""
    parts = []
    for column in columns:
        values = np.array(findings.table.numbers(column.name, empty=True))
        row = np.flatnonzero(np.isfinite(values)).astype(np.int64)
        label = np.full(len(row), column.direction) if column.direction else labels[row]
        parts.append((row, np.full(len(row), column.number), label, values[row]))
    row, run, label, value = (np.concatenate([part[k] for part in parts]) for k in range(4))
    first = columns[0]
    return _Rows(row, run.astype(np.int64), label.astype(np.int64), value, "deviation", first.name)


def _deviations(findings: Findings, rows: _Rows, target: FloatArray, *, angular: bool) -> FloatArray:
    """Measured minus target, mm or rad."""
    key, value = rows.key, rows.value
    slope = slope_of(target, value)
    spread = float(np.ptp(value))
    scatter = float(np.std(value - slope.slope * target - slope.offset))
    follows = slope.unit_ratio in (1.0, 1e3, 25.4, 1 / 25.4) and scatter < FOLLOWS * spread
    if key == "actual" or (key == "deviation" and "deviation" not in findings.fields and follows and not angular):
        return _from_readings(findings, rows, target)
    if key not in findings.fields:
        findings.fields = {**findings.fields, key: split_name(rows.name)}
    usual = USUAL_URAD * 1e-6 if angular else usual_deviation_mm(float(np.ptp(target)))
    si = findings.values_si(key, rows.name, value, usual, angular=angular)
    return _signed(findings, key, si)


def _signed(findings: Findings, key: str, values: FloatArray) -> FloatArray:
    chosen = findings.options.sign
    if chosen is None and key == "correction":
        chosen = "correction"
        findings.notes.append("the column is called a correction: its sign is turned round")
    if chosen is None:
        words = " ".join([*findings.table.header, *findings.table.metadata, *findings.table.metadata.values()]).lower()
        if not any(word in words for word in (*_TELLING, *FIELDS["deviation"][:1])):
            findings.doubts.append("nothing says whether the values are errors or corrections; give --sign")
        chosen = "error"
    findings.understood["sign"] = (
        "measured minus target" if chosen == "error" else "target minus measured, turned round"
    )
    return -values if chosen == "correction" else values


def _from_readings(findings: Findings, rows: _Rows, target: FloatArray) -> FloatArray:
    """Reading minus target; unit and sign of the readings by their slope over the targets."""
    slope = slope_of(target, rows.value)
    column = findings.fields.get("actual")
    declared = findings.given_unit("actual") or (column.unit if column else None)
    scale = MM_PER_LENGTH.get(declared, 1.0) if declared else 1.0 / (slope.unit_ratio or 1.0)
    if slope.unit_ratio is None:
        findings.doubts.append(f"the readings follow the targets with the slope {slope.slope:.5g}, which is no unit")
    elif abs(scale * slope.unit_ratio - 1.0) > 0.01:
        findings.doubts.append(f"{rows.name!r} says {declared}, but one mm of travel is {slope.unit_ratio:g} in it")
        scale = 1.0 / slope.unit_ratio
    if slope.sign < 0:
        findings.doubts.append("the readings fall where the targets rise: the sign of one of them is turned round")
    sign = -1.0 if slope.sign < 0 and findings.options.sign == "correction" else 1.0
    offset = slope.offset * scale
    if abs(offset) > 1.0:
        findings.notes.append(f"readings are {offset:.6g} mm beside the targets at zero; nothing was taken off")
    findings.understood["slope_of_readings"] = slope.slope
    findings.understood["sign"] = "measured minus target"
    findings.understood["unit"] = next((u for u, mm in MM_PER_LENGTH.items() if abs(mm / scale - 1) < 1e-9), "mm")
    return sign * rows.value * scale - target


def _axes(findings: Findings, row: IntArray) -> list[str]:
    """Axis of each reading: by the user, a column, the metadata, the header, or the name of the sheet or file."""
    if findings.options.axis:
        return [findings.options.axis] * len(row)
    if "axis" in findings.fields:
        column = findings.fields["axis"].name
        letters = []
        for cell, line in zip(findings.table.column(column), findings.table.lines, strict=True):
            letter = axis_in(cell)
            if letter is None:
                empty = findings.table.grid.empty if not cell else ""
                raise findings.table.grid.fail(f"{shown(cell)} is no axis{empty}; X, Y or Z is due", line, column)
            letters.append(letter)
        return [letters[k] for k in row]
    metadata = findings.table.metadata
    words = [value for key, value in metadata.items() if key in ("axis", "achse")]
    words += [*findings.table.grid.notes[:1], findings.table.grid.path.stem.replace("_", " ").replace("-", " ")]
    for word in words:
        letter = axis_in(word)
        if letter:
            if word not in metadata.values():
                findings.notes.append(f"axis {letter} by the name of the sheet or file")
            return [letter] * len(row)
    findings.doubts.append(f"nothing says which axis it is; give --axis {', '.join(AXES)}")
    return [""] * len(row)


def _directions(findings: Findings, target: FloatArray, run: IntArray, label: IntArray) -> tuple[IntArray, IntArray]:
    """Direction of travel and number of the cycle: labels, against the order of the rows where that tells."""
    chosen = findings.options.directions
    one_way = run if run.any() else _sweeps(target)
    if chosen == "alternate":
        _, order = np.unique(one_way, return_inverse=True)
        direction = np.where(order % 2 == 0, 1, -1).astype(np.int64)
        return direction, cycles(direction, one_way)
    if not label.any():
        direction = motion(target, one_way)
        findings.understood.setdefault("directions_from", "the order of the rows")
        if not direction.all():
            findings.doubts.append("the direction of travel is not known everywhere; give --map direction=COLUMN")
        return direction, cycles(direction, one_way)
    if not label.all():
        findings.doubts.append("some columns name a direction and some do not; give --directions alternate or motion")
    turned = _contradicted(target, one_way, label)
    if chosen == "motion" or (turned and chosen is None):
        label = -label if turned else label
    if turned and chosen is None:
        findings.doubts.append(
            "the rows labelled as positive (forward) go down and the others up; direction follows the motion, so the labels "
            "were swapped: confirm with --directions motion, or keep them with --directions labels"
        )
    findings.understood.setdefault("directions_from", "the labels" if chosen != "motion" else "the order of the rows")
    return label, run if run.any() else cycles(label, _repeats(target, label))


def _sweeps(target: FloatArray) -> IntArray:
    """Number of the one-way run of each row: a new one begins where a target comes a second time."""
    keys = np.round(target / SAME_TARGET_MM).astype(np.int64).tolist()
    number, seen, result = 1, set[int](), []
    for key in keys:
        if key in seen:
            number, seen = number + 1, set()
        seen.add(key)
        result.append(number)
    return np.array(result, dtype=np.int64)


def _repeats(target: FloatArray, label: IntArray) -> IntArray:
    """How often the same target with the same label stood before, plus one."""
    keys = zip(np.round(target / SAME_TARGET_MM).astype(np.int64).tolist(), label.tolist(), strict=True)
    count: dict[tuple[int, int], int] = {}
    result = []
    for key in keys:
        count[key] = count.get(key, 0) + 1
        result.append(count[key])
    return np.array(result, dtype=np.int64)


def _contradicted(target: FloatArray, run: IntArray, label: IntArray) -> bool:
    """Whether the rows of each label go the other way, in every run; a table sorted by targets says nothing."""
    ways: dict[int, set[int]] = {1: set(), -1: set()}
    for number in np.unique(run):
        for sign in (1, -1):
            steps = np.diff(target[(run == number) & (label == sign)])
            if len(steps):
                ways[sign].add(int(np.sign(steps[0])) if np.all(np.sign(steps) == np.sign(steps[0])) else 0)
    return ways[1] == {-1} and ways[-1] == {1}
