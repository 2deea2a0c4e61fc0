"""Conversion of a foreign table to runs, errors, tracer lengths or measured positions.

:func:`import_table` decides which kind a table is and calls the reader of that kind; :func:`merged_sheets` puts the sheets
of one workbook together.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compgen.data.axis_runs import POSITIONING, SAME_TARGET_MM, AxisRuns, check_single, join_axis_runs, two_way_mean
from compgen.data.circles import LARGEST_RADIUS_MM, PLANES, Circles
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Deviations
from compgen.data.error_table import ARMS, SQUARENESS_APART, ErrorTable, ReversalCurves, marked_apart
from compgen.data.lengths import Lengths
from compgen.data.names import AXES, CURVE_NAMES, MM_PER_UM
from compgen.data.records import LARGEST_DEVIATION_UM
from compgen.errors import InputError, doubled
from compgen.foreign.answers import ImportOptions, Kind
from compgen.foreign.cells import CellGrid, find_table
from compgen.foreign.column_names import (
    FIELDS,
    MM_PER_LENGTH,
    RAD_PER_ANGLE,
    RUN_FIELD,
    MotionColumn,
    RunColumn,
    error_columns,
    fields_of,
    is_deviation,
    known_unit,
    motion_in,
    motions_in,
    run_columns,
    run_in,
    split_name,
    statistic_in,
    unaccented,
    way,
)
from compgen.foreign.covariates import RowData, directions_of, labels_of, metadata_of, row_data_of
from compgen.foreign.error_tables import long_errors, si_values, summed_steps, wide_errors
from compgen.foreign.findings import (
    USUAL_URAD,
    Data,
    Imported,
    TableFindings,
    judge_lengths,
    slope_of,
    usual_deviation_mm,
)
from compgen.foreign.one_axis import (
    IntArray,
    OneAxis,
    axis_in,
    check_error,
    cycles,
    earlier_rows,
    errors_of,
    motion,
    remarks,
)
from compgen.foreign.questions import (
    AXIS,
    Asking,
    Choice,
    OpenColumnsError,
    choices_of,
    directions,
    errors_along,
    signs,
    unit_choices,
)
from compgen.foreign.source import parse_number, shown

# Tables of readings along axes: a row for each reading, or a row for each target and a column for each run.
#
# :func:`axis_readings` finds runs, deviations, axes and directions. Redundant columns (deviations next to readings, means
# next to runs) are compared, and the user must decide if they disagree.

#: Units that are tried for deviations without one, mm.
_LIKELY = {name: MM_PER_LENGTH[name] for name in ("um", "mm", "in", "nm")}
#: A column without a clear name contains readings, not deviations, if it follows the targets this closely.
FOLLOWS = 1e-2
_AXIS_KEYS = ("measuredaxis", "machineaxis", "testaxis", "gemesseneachse", "messachse", "maschinenachse", "axemesure",
              "assemisurato", "ejemedido")  # fmt: skip
_NAMED_AXIS = re.compile(
    r"\b([XYZ])[1-9]?[\s\-_]*(?:ACHSE|AXIS|AXE|ASSE|EJE|\u8f74)|(?:ACHSE|AXIS|AXE|ASSE|EJE|\u8f74)[\s\-_:]*([XYZ])[1-9]?\b"
)
#: Parts of words for corrections.
_COUNTER = ("korr", "kompens", "compens", "correc", "correzion", "\u8865\u507f")
_TELLING = (
    "deviation", "abweichung", "error", "fehler", "230", "ecart", "scarto", "errore", "desviac", "accuracy",
    "genauigkeit", "precision", "precisione", "3441", "\u7cbe\u5ea6", "\u504f\u5dee", "\u8bef\u5dee",
)  # fmt: skip


@dataclass(frozen=True)
class _Rows:
    """Cells in reading order: row of the table, number of the one-way run (0: unknown), label of direction (0: none)."""

    row: IntArray
    run: IntArray
    label: IntArray
    value: FloatArray
    key: str
    name: str


def axis_readings(findings: TableFindings, *, angular: bool = False) -> tuple[dict[str, OneAxis], RowData]:
    """Return the readings of each axis, "" if the axis is not stated, and the other columns."""
    rows = _rows(findings)
    target = findings.positions_mm("position", findings.numbers("position"))[rows.row]
    value = _deviations(findings, rows, target, angular=angular)
    letters = _axes(findings, rows.row)
    row_data = row_data_of(findings, "axis", once=len(np.unique(rows.row)) == len(rows.row))
    found = {}
    for letter in dict.fromkeys(letters):
        own = np.flatnonzero(np.array(letters) == letter)
        line = np.array(findings.table.lines, dtype=np.int64)[rows.row[own]]
        direction, run = _directions(findings, target[own], rows.run[own], rows.label[own], value[own])
        covariates = {name: values[rows.row[own]] for name, values in row_data.covariates.items()}
        by_rows = not rows.label[own].any() and findings.options.directions != "alternate"
        in_time = by_rows and bool(np.all(np.diff(rows.run[own]) >= 0))
        found[letter] = OneAxis(target[own], direction, run, value[own], line, covariates, in_time)
        findings.notes += remarks(found[letter], letter, angular=angular)
    return found, row_data


def _rows(findings: TableFindings) -> _Rows:
    fields, header = findings.fields, findings.table.header
    taken = [*(column.name for column in fields.values()), *findings.options.ignore]
    given = [(RUN_FIELD.fullmatch(key), column.name) for key, column in fields.items()]
    said = [RunColumn(name, int(key[1]), {"+": 1, "-": -1, "": 0}[key[2]]) for key, name in given if key]
    wide = [*said, *run_columns(header, taken)]
    key = next((name for name in ("actual", "deviation", "correction", "value") if name in fields), None)
    if key is not None and said:
        raise InputError(f"columns of runs are given, and {fields[key].name!r} contains {key}s: exclude it with --ignore",
                         file=findings.table.grid.path, field="--map")  # fmt: skip
    if key is None and not wide:
        raise open_columns(
            findings,
            f"has positions but no deviations or readings; the header has {shown(', '.join(header), 200)}; "
            "give --map deviation=COLUMN, or --map run1+=COLUMN, run1-=COLUMN ... for one column per run",
        )
    if key is None:
        return _wide(findings, wide)
    key = _compared(findings, key)
    findings.used.add(fields[key].name)
    values = findings.numbers(key)
    run, labels = np.zeros(len(values), dtype=np.int64), _labels(findings)
    if "run" in fields:
        run, ways = _runs_in_cells(findings)
        labels = ways if ways is not None and not labels.any() else labels
        gaps = sorted(set(range(1, min(int(run.max()), 10_000) + 1)) - set(run.tolist()))
        if 0 < len(gaps) <= len(np.unique(run)):
            findings.notes.append(f"there is no run {', '.join(map(str, gaps[:8]))}")
        run = run + 1 - min(0, int(run.min())) if run.min() < 1 else run
    return _Rows(np.arange(len(values), dtype=np.int64), run, labels, values, key, fields[key].name)


def _labels(findings: TableFindings) -> IntArray:
    """Return directions from a column (rows,), 0 without one; signs of the axis are accepted, too (X+, X-)."""
    rows = len(findings.table.rows)
    signed = "axis" in findings.fields and "direction" not in findings.fields
    if signed:
        cells = findings.table.column(findings.fields["axis"].name)
        signs = [(cell.strip()[:1] + cell.strip()[-1:]).replace("\u2212", "-") for cell in cells]
        if all("+" in sign or "-" in sign for sign in signs):
            return np.array([1 if "+" in sign else -1 for sign in signs], dtype=np.int64)
    if "direction" not in findings.fields:
        return np.zeros(rows, dtype=np.int64)
    return directions_of(findings, findings.fields["direction"], empty=False)


def _runs_in_cells(findings: TableFindings) -> tuple[IntArray, IntArray | None]:
    """Return numbers of runs, and directions if every cell of that column also gives one (1+, 1-, Lauf 2 vor)."""
    column = findings.fields["run"]
    cells = findings.table.column(column.name)
    read = {cell: run_in(cell) for cell in dict.fromkeys(cells)}
    named = [item for item in read.values() if item is not None and item.direction and parse_number(item.name) is None]
    if not named:
        return labels_of(findings, column), None
    unknown = next((k for k, cell in enumerate(cells) if (item := read[cell]) is None or not item.direction), None)
    if unknown is not None:
        message = (
            f"{shown(cells[unknown])} gives no direction, but other cells of this column do ({shown(named[0].name)})"
        )
        raise findings.table.grid.fail(message, findings.table.lines[unknown], column.name)
    runs = [item for cell in cells if (item := read[cell]) is not None]
    number = np.array([item.number for item in runs], dtype=np.int64)
    return number, np.array([item.direction for item in runs], dtype=np.int64)


def _compared(findings: TableFindings, key: str) -> str:
    """Compare the readings with deviations or corrections printed next to them; return the field to use.

    If both agree, the finer one is used; if they do not, or differ in sign, the user must decide.
    """
    for other, sign in (("deviation", 1.0), ("correction", -1.0)):
        if other not in findings.fields or other == key or key not in ("actual", "deviation"):
            continue
        name, counting = findings.fields[other].name, findings.fields[key].name
        if not findings.is_numeric(name):
            continue
        reference, reference_mm, digit = _reference(findings, key)
        if reference is None:
            continue
        values, own_digit = np.array(findings.table.numbers(name, empty=True)), _last_digit(findings, name)
        declared = findings.unit(other, "value")
        one = MM_PER_LENGTH.get(declared or "")
        scales = list(_LIKELY.values()) if one is None else [one]
        found = set()
        for scale, turned in ((scale / reference_mm, turned) for scale in scales for turned in (1.0, -1.0)):
            away = np.abs(np.nan_to_num(turned * sign * values * scale - reference))
            if away.max() <= 0.55 * (2.0 * digit + own_digit * scale) + 1e-12:
                found.add(turned)
        findings.used.add(name)
        if 1.0 in found:
            findings.notes.append(f"{name!r} agrees with {counting!r}")
            findings.checked_sign |= found == {1.0}
            if key == "actual" and other == "deviation" and declared and own_digit * scales[0] / reference_mm < digit:
                findings.used.add(counting)
                findings.notes.append(f"{name!r} has more digits and is used")
                return other
            continue
        what = "has the opposite sign of" if found else "disagrees with"
        pair = f"{counting!r} minus target" if key == "actual" else repr(counting)
        findings.ask(
            f"{name!r} {what} {pair}",
            "ignore",
            choices_of((name, counting)),
            "exclude the wrong one: --ignore COLUMN",
        )
    return key


def _reference(findings: TableFindings, key: str) -> tuple[FloatArray | None, float, float]:
    """Return the deviations by which others are judged, mm per unit of them, and the value of their last digit.

    None if readings do not follow the targets in a known unit; the user is asked elsewhere.
    """
    values, digit = findings.numbers(key), _last_digit(findings, findings.fields[key].name)
    unit = findings.unit(key, *(["value"] if key == "deviation" else []))
    if key == "deviation":
        return (values if unit in MM_PER_LENGTH else None), MM_PER_LENGTH.get(unit or "", 1.0), digit
    target = findings.numbers("position")
    position_unit = findings.unit("position") or "mm"
    ratio = slope_of(target, values).unit_ratio
    if ratio is None or position_unit not in MM_PER_LENGTH:
        return None, 1.0, digit
    return values / ratio - target, MM_PER_LENGTH[position_unit], digit / ratio


def _last_digit(findings: TableFindings, name: str) -> float:
    """Return the value of the last digit in a column."""
    decimals = [len(cell.partition(".")[2]) for cell in findings.table.column(name) if "e" not in cell.lower()]
    return float(10.0 ** -max(decimals, default=0))


def _wide(findings: TableFindings, columns: Sequence[RunColumn]) -> _Rows:
    """Return the columns of runs, one after the other; an empty cell is a missing reading."""
    labels = _labels(findings)
    seen: dict[tuple[int, int], str] = {}
    for column in columns:
        earlier = seen.setdefault((column.number, column.direction), column.name)
        if earlier != column.name:
            message = (
                f"{shown(earlier)} and {shown(column.name)} are the same run and direction; distinguish them with "
            )
            raise findings.table.grid.fail(message + "--map run1+=COLUMN, run1-=COLUMN ...", findings.table.header_line)
    units = {column.name: split_name(column.name).unit for column in columns}
    if len(set(units.values())) > 1 and findings.options.given_unit("deviation", "value") is None:
        text = ", ".join(f"{shown(name)} {unit or 'none'}" for name, unit in units.items())
        message = f"the runs have different units ({text}); if all have the same, give --unit deviation=UNIT"
        raise findings.table.grid.fail(message, findings.table.header_line)
    numbers = {way: {column.number for column in columns if column.direction == way} for way in (1, -1)}
    if numbers[1] and numbers[-1] and numbers[1] != numbers[-1]:
        lonely = ", ".join(str(number) for number in sorted(numbers[1] ^ numbers[-1])[:8])
        findings.notes.append(f"run {lonely} has one direction only")
    findings.used |= {column.name for column in columns}
    findings.runs = [column.name for column in columns]
    parts = []
    for column in columns:
        values = np.array(findings.table.numbers(column.name, empty=True))
        row = np.flatnonzero(np.isfinite(values)).astype(np.int64)
        label = np.full(len(row), column.direction) if column.direction else labels[row]
        parts.append((row, np.full(len(row), column.number), label, values[row]))
        if not len(row):
            findings.notes.append(f"{column.name!r} is empty")
    if not any(len(part[0]) for part in parts):
        raise findings.table.grid.fail("the columns of the runs are empty", findings.table.header_line)
    _statistics(findings, columns)
    row, run, label, value = (np.concatenate([part[k] for part in parts]) for k in range(4))
    first = columns[0]
    return _Rows(row, run.astype(np.int64), label.astype(np.int64), value, "deviation", first.name)


def _statistics(findings: TableFindings, columns: Sequence[RunColumn]) -> None:
    """Separate means and other statistics from the runs; a mean must be that of the runs."""
    mm = MM_PER_LENGTH.get(split_name(columns[0].name).unit or "")
    taken = {*findings.used, *(column.name for column in findings.fields.values()), *findings.options.ignore}
    for name in findings.table.header:
        found = statistic_in(name)
        if name in taken or found is None or motions_in(name) != motions_in(columns[0].name):
            continue
        kind, way_of = found
        findings.used.add(name)
        findings.notes.append(f"{name!r} is a statistic over the runs, not a run")
        own = [column for column in columns if way_of in (0, column.direction)]
        if kind != "mean" or not own or not findings.is_numeric(name):
            continue
        printed = np.array(findings.table.numbers(name, empty=True))
        scale = MM_PER_LENGTH.get(split_name(name).unit or "", mm) / mm if mm else 1.0
        runs = np.column_stack([findings.table.numbers(column.name, empty=True) for column in own])
        known = np.isfinite(printed) & np.isfinite(runs).all(axis=1)
        allowed = 0.55 * (_last_digit(findings, name) * scale + _last_digit(findings, own[0].name)) + 1e-9
        away = np.where(known, np.abs(printed * scale - runs.mean(axis=1)), 0.0)
        if away.max(initial=0.0) > allowed:
            k = int(np.argmax(away))
            findings.ask(
                f"{name!r} states {printed[k]:g} in line {findings.table.lines[k]}, the mean of "
                f"{', '.join(repr(column.name) for column in own[:6])} is {runs[k].mean() / scale:.6g}: is a run missing, or one "
                "named wrongly?",
                "ignore",
                (Choice(name, f"the runs are right: leave {name!r} out"),),
                f"if the runs are right, --ignore {shown(name)}",
            )


def _deviations(findings: TableFindings, rows: _Rows, target: FloatArray, *, angular: bool) -> FloatArray:
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
    chosen = findings.options.sign
    if chosen is None and key == "correction":
        chosen = "correction"
        findings.notes.append("the name of the column says correction: its sign is reversed")
    if chosen is None:
        above = findings.table.metadata
        words = unaccented(" ".join([*findings.table.header, *above, *above.values()]))
        told = any(word in words for word in (*_TELLING, *FIELDS["deviation"][:1]))
        told = told or any(is_deviation(name) for name in findings.table.header)
        if not told and len(findings.runs) > 1 and not any(word in words for word in _COUNTER):
            findings.notes.append("runs are measured: their values are assumed to be measured minus target")
        elif not told and not findings.checked_sign:
            findings.ask(
                "it is not stated whether the values are errors (measured minus target) or corrections",
                "sign",
                signs(),
                "give --sign error or correction",
                picture="position",
            )
        chosen = "error"
    findings.understood["sign"] = (
        "measured minus target" if chosen == "error" else "target minus measured, sign reversed"
    )
    return -si if chosen == "correction" else si


def _from_readings(findings: TableFindings, rows: _Rows, target: FloatArray) -> FloatArray:
    """Reading minus target; unit and sign of the readings by their slope over the targets."""
    slope = slope_of(target, rows.value)
    column = findings.fields.get("actual")
    declared = findings.options.given_unit("actual") or (column.unit if column else None)
    scale = MM_PER_LENGTH.get(declared, 1.0) if declared else 1.0 / (slope.unit_ratio or 1.0)
    if slope.unit_ratio is None:
        findings.ask(f"the readings follow the targets with the slope {slope.slope:.5g}, which is not a ratio of units")
    elif abs(scale * slope.unit_ratio - 1.0) > 0.01:
        findings.ask(f"{rows.name!r} states {declared}, but one mm of travel is {slope.unit_ratio:g} in it")
        scale = 1.0 / slope.unit_ratio
    if slope.sign < 0:
        findings.ask("the readings decrease where the targets increase: the sign of one of them is reversed")
    sign = -1.0 if slope.sign < 0 and findings.options.sign == "correction" else 1.0
    offset = slope.offset * scale
    if abs(offset) > 1.0:
        findings.notes.append(f"readings differ from the targets by {offset:.6g} mm at zero; nothing was subtracted")
    findings.understood["slope_of_readings"] = slope.slope
    findings.understood["sign"] = "measured minus target"
    findings.understood["unit"] = next((u for u, mm in MM_PER_LENGTH.items() if abs(mm / scale - 1) < 1e-9), "mm")
    return sign * rows.value * scale - target


def _axes(findings: TableFindings, row: IntArray) -> list[str]:
    """Return the axis of each reading: from the option, a column, the metadata, the header, or the sheet or file name."""
    if findings.options.axis:
        return [findings.options.axis] * len(row)
    if "axis" in findings.fields:
        column = findings.fields["axis"].name
        letters = []
        for cell, line in zip(findings.table.column(column), findings.table.lines, strict=True):
            letter = axis_in(cell)
            if letter is None:
                empty = findings.table.grid.empty if not cell else ""
                raise findings.table.grid.fail(f"{shown(cell)} is not an axis{empty}; expected X, Y or Z", line, column)
            letters.append(letter)
        return [letters[k] for k in row]
    if findings.letter is not None:
        return [findings.letter] * len(row)
    said: set[str] = set()  # by a line above the table, such as ``Achse: X`` or a title ``Positionierung Y-Achse``
    for key, text in findings.table.metadata.items():
        word = split_name(key).word
        if word in FIELDS["axis"] or word in _AXIS_KEYS:
            said |= {axis_in(text) or ""} - {""}
            continue
        letters = [first or second for first, second in _NAMED_AXIS.findall(f"{key} {text}".upper())]
        said |= set(letters) if len(set(letters)) == 1 else set()
    names = [*findings.table.grid.notes[:1], findings.table.grid.path.stem.replace("_", " ").replace("-", " ")]
    named = next((letter for name in names if (letter := axis_in(name))), None)
    if len(said) == 1 and named in (None, *said):
        return [said.pop()] * len(row)
    if said:
        other = f"but the sheet or file is named {named}" if len(said) == 1 else "several axes"
        findings.ask(
            f"the lines above the table give axis {', '.join(sorted(said))}, {other}", "axis", AXIS, "give --axis"
        )
        return [sorted(said)[0]] * len(row)
    if named:
        findings.notes.append(f"axis {named} by the name of the sheet or file")
        return [named] * len(row)
    findings.ask("the axis is not stated", "axis", AXIS, f"give --axis {', '.join(AXES)}")
    return [""] * len(row)


def _directions(
    findings: TableFindings, target: FloatArray, run: IntArray, label: IntArray, value: FloatArray
) -> tuple[IntArray, IntArray]:
    """Return direction of travel and number of the cycle: from labels, checked with the order of the rows if possible."""
    chosen = findings.options.directions
    one_way = run if run.any() else _sweeps(target)
    if chosen == "alternate":
        _, order = np.unique(one_way, return_inverse=True)
        direction = np.where(order % 2 == 0, 1, -1).astype(np.int64)
        return direction, cycles(direction, one_way)
    if not label.any():
        if len(set(zip(one_way.tolist(), target.tolist(), strict=True))) < len(target):
            one_way = _sweeps(target, one_way)  # a run in both directions
        direction = motion(target, one_way)
        if len(findings.runs) > 1 and chosen is None:
            if _alternate(target, run, value):
                findings.ask(
                    "no run gives a direction, and odd and even runs differ like two directions",
                    "directions",
                    directions("alternate", "motion"),
                    "give --directions alternate (odd runs up, even runs down) or motion (all in the order of the rows)",
                )
            else:
                findings.notes.append("no run gives a direction: all are assumed to be in the order of the rows")
        findings.understood.setdefault("directions_from", "the order of the rows")
        if not direction.all():
            header = shown(", ".join(findings.table.header), 200)
            findings.ask(
                f"there is no column of directions (the header has {header}), and the order of the rows does not show them "
                "everywhere",
                "directions",
                directions("alternate"),
                "give --map direction=COLUMN, or --directions alternate (odd runs up, even runs down)",
            )
        return direction, cycles(direction, one_way)
    if not label.all():
        findings.ask(
            "some columns give a direction and some do not",
            "directions",
            directions("alternate", "motion"),
            "give --directions alternate or motion",
        )
    turned = _contradicted(target, one_way, label)
    if chosen == "motion" or (turned and chosen is None):
        label = -label if turned else label
    if turned and chosen is None:
        findings.ask(
            "the rows labelled as positive (forward) descend and the others ascend; direction follows the motion, so the labels "
            "were swapped",
            "directions",
            directions("motion", "labels"),
            "confirm with --directions motion, or keep them with --directions labels",
        )
    findings.understood.setdefault("directions_from", "the labels" if chosen != "motion" else "the order of the rows")
    return label, run if run.any() else cycles(
        label, earlier_rows(np.column_stack([np.round(target / SAME_TARGET_MM) + 0.0, label]))[1]
    )


def _alternate(target: FloatArray, run: IntArray, value: FloatArray) -> bool:
    """Whether odd and even runs differ by more than four standard uncertainties of their scatter: a reversal, most likely."""
    keys = np.round(target / SAME_TARGET_MM).astype(np.int64)
    gaps, squares, freedom = [], 0.0, 0
    for key in np.unique(keys):
        odd, even = (value[(keys == key) & (run % 2 == part)] for part in (1, 0))
        if not len(odd) or not len(even):
            continue
        gaps.append(odd.mean() - even.mean())
        squares += float(np.sum((odd - odd.mean()) ** 2) + np.sum((even - even.mean()) ** 2))
        freedom += len(odd) + len(even) - 2
    if not freedom or len(gaps) < 2:
        return False
    scatter = float(np.sqrt(squares / freedom))
    return bool(abs(float(np.mean(gaps))) > 4.0 * scatter * 2.0 / np.sqrt(len(value)))


def _sweeps(target: FloatArray, run: IntArray | None = None) -> IntArray:
    """Number of the one-way run of each row: a new one begins where a target is repeated, or ``run`` changes."""
    keys = np.round(target / SAME_TARGET_MM).astype(np.int64).tolist()
    runs = [0] * len(keys) if run is None else run.tolist()
    number, seen, result, last = 1, set[int](), [], runs[0] if runs else 0
    for key, own in zip(keys, runs, strict=True):
        if key in seen or own != last:
            number, seen = number + 1, set()
        seen.add(key)
        last = own
        result.append(number)
    return np.array(result, dtype=np.int64)


def _contradicted(target: FloatArray, run: IntArray, label: IntArray) -> bool:
    """Whether the rows of each label run in the opposite direction, in every run; a table sorted by targets shows nothing."""
    ways: dict[int, set[int]] = {}
    for sign in (1, -1):
        rows = np.flatnonzero(label == sign)
        rows = rows[np.argsort(run[rows], kind="stable")]
        steps = np.sign(np.diff(target[rows]))[np.diff(run[rows]) == 0]
        ways[sign] = set(steps.astype(np.int64).tolist())
    return ways[1] == {-1} and ways[-1] == {1}


# Tables of error motions in words: straightness, pitch, yaw and roll of one axis, with a column for each, or for each run.


#: What the answers to ``--sign`` mean for errors that are named in words.
_MEANING = (
    "--sign error: positive straightness is towards +X, +Y, +Z, and positive angles are right-handed about +X, +Y, +Z, both of "
    "the tool relative to the workpiece; --sign correction: all have the opposite sign; if they differ, import the columns one "
    "after the other, with --ignore for the others (docs/instruments.md, Level, Straightness)"
)


def _meanings(names: Sequence[str]) -> tuple[Choice, ...]:
    """What a positive number may mean for errors that are named in words: the tool relative to the workpiece."""
    said = ", ".join(_towards(name) for name in names[:3])
    return (
        Choice("error", f"positive: the tool {said}"),
        Choice("correction", f"negative: the tool {said}"),
    )


def _towards(name: str) -> str:
    """Return where a positive error moves or turns the tool."""
    if name[1] in "ABC":
        return f"turns right-handed about +{AXES['ABC'.index(name[1])]} ({name})"
    return f"is too far towards +{name[1]} ({name})"


def motion_columns(findings: TableFindings) -> list[MotionColumn]:
    """Return the columns of error motions, if one is named in words, or has a run or a direction; otherwise none."""
    given = {name: column.name for name, column in findings.fields.items() if name in CURVE_NAMES}
    taken = {*(column.name for column in findings.fields.values()), *findings.options.ignore}
    found = [motion for name in findings.table.header if name not in taken and (motion := motion_in(name))]
    exact = error_columns(findings.table.header)
    if not given and all(motion.run.name in [column.name for column in exact.values()] for motion in found):
        return []
    return [*(MotionColumn(RunColumn(column, 0, 0), name, frozenset()) for name, column in given.items()), *found]


def error_motions(findings: TableFindings, columns: Sequence[MotionColumn]) -> tuple[ErrorTable, ReversalCurves | None]:
    """Return the errors of one axis, as the means of both directions over all runs, and the reversals of straightness.

    A name in words does not state the sign: the user gives it. The uncertainty is that of the mean, from the scatter.
    """
    letters = {column.motion[2] for column in columns if column.exact}
    if len(letters) != 1 or findings.options.axis:
        letters = set(_axes(findings, np.arange(len(findings.table.rows), dtype=np.int64)))
    if len(letters) > 1:
        raise findings.table.grid.fail("errors of several axes share the columns; give one table for each axis")
    letter = letters.pop() or "X"
    found: dict[str, list[RunColumn]] = {}
    read = []
    for column in columns:
        name = column.error(letter)
        if name is None or not name.endswith(letter):
            raise OpenColumnsError(
                f"which error of {letter} this is remains open; name it by --map E..{letter}=COLUMN (EB{letter}: rotation about "
                f"Y, EY{letter}: straightness in Y), or exclude it: --ignore {shown(column.run.name)}",
                file=findings.table.grid.path,
                line=findings.table.header_line,
                field=f"column {column.run.name}",
            )
        found.setdefault(name, []).append(column.run)
        read += [] if column.exact or findings.options.sign else [f"{shown(column.run.name)} is {name}"]
    if "deviation" in findings.fields:
        found[f"E{letter}{letter}"] = [RunColumn(findings.fields["deviation"].name, 0, 0)]
    if read:
        others = [
            runs[0].name for runs in found.values() if not any(f"{shown(runs[0].name)} is" in text for text in read)
        ]
        also = f"; the answer applies to {', '.join(map(shown, others))} as well" if others else ""
        kinds = {name[1] in "ABC" for name in found}
        findings.ask(
            f"the sign of {', '.join(read)} is not stated (Z counts as vertical){also}",
            "sign",
            _meanings(sorted(found)),
            f"give {_MEANING}; where Z is not vertical, --map ERROR=COLUMN",
            picture="" if len(kinds) > 1 else f"{'rotation' if True in kinds else 'straightness'} {min(found)}",
        )
    words = unaccented(" ".join([*findings.table.header, *findings.table.metadata, *findings.table.metadata.values()]))
    if not read and findings.options.sign is None and any(word in words for word in _COUNTER):
        findings.ask("the file mentions corrections", "sign", signs(), "give --sign error or correction")
    findings.used |= {findings.fields[key].name for key in ("axis", "direction", "run") if key in findings.fields}
    results = [_over_position(findings, name, runs) for name, runs in found.items()]
    metadata = metadata_of(findings, row_data_of(findings, "errors"))
    curves = {name: curve for table, _ in results for name, curve in table.curves.items()}
    reversals = {key: curve for _, item in results if item is not None for key, curve in item.curves.items()}
    if reversals:
        findings.notes.append(
            "both directions differ: the mean is used, and import writes the reversal to a separate file"
        )
    findings.understood |= {"errors": list(curves), "sign": findings.options.sign or "errors"}
    return marked_apart(ErrorTable(curves, {}, metadata)), ReversalCurves(reversals, metadata) if reversals else None


def _over_position(
    findings: TableFindings, name: str, columns: Sequence[RunColumn]
) -> tuple[ErrorTable, ReversalCurves | None]:
    """Return one error over the positions from all of its columns, and its reversal."""
    rows = _wide(findings, columns)
    angular, unit = name[1] in "ABC", split_name(rows.name).unit
    base_mm = None if angular or name[1] == name[2] else findings.options.base_length_mm
    target = findings.positions_mm("position", findings.numbers("position"))[rows.row]
    if base_mm is not None and unit in RAD_PER_ANGLE:  # the slope of each step
        value = rows.value * RAD_PER_ANGLE[unit] * base_mm
    elif unit is not None and unit not in (RAD_PER_ANGLE if angular else MM_PER_LENGTH):
        text = f"is in {unit}, and {name} expected a unit of {'angle' if angular else 'length'}"
        raise findings.table.grid.fail(text, findings.table.header_line, rows.name)
    else:
        value = si_values(findings, name, split_name(rows.name), rows.value, float(np.ptp(target)))
    one_way = rows.run
    if "run" in findings.fields and not one_way.any():
        one_way = _runs_in_cells(findings)[0][rows.row]
    direction, run = _directions(findings, target, one_way, rows.label, value)
    line = np.array(findings.table.lines, dtype=np.int64)[rows.row]
    runs = OneAxis(target, direction, run, -value if findings.options.sign == "correction" else value, line)
    findings.notes += remarks(runs, name[2], angular=angular)
    found, reversal = errors_of(runs, name, {})
    return (found, reversal) if base_mm is None else (summed_steps(findings, found, base_mm), None)


# Tables of tracer lengths, and of measured positions, in space.


#: Required agreement of the unit of lengths from geometry with a known one (the machine's errors are far smaller).
UNIT_TOLERANCE = 0.03


def lengths_of(findings: TableFindings) -> Lengths:
    """Return tracer lengths; unit and sign are compared with the commanded points."""
    table, fields = findings.table, findings.fields
    position = _positions(findings, "xyz")
    rows = len(table.rows)
    names = table.column(fields["station"].name) if "station" in fields else ["S1"] * rows
    if "station" not in fields:
        findings.notes.append("there is no column of stations: all lengths are assigned to one, S1")
    points = table.column(fields["point"].name) if "point" in fields else [str(k + 1) for k in range(rows)]
    for cells, key in ((names, "station"), (points, "point")):
        empty = next((k for k, cell in enumerate(cells) if not cell), None)
        if empty is not None:
            raise table.grid.fail(
                f"is empty{table.grid.empty}; every row needs a label here", table.lines[empty], fields[key].name
            )
    stations = tuple(dict.fromkeys(names))
    station = np.array([stations.index(name) for name in names], dtype=np.int64)
    reading = findings.numbers("length")
    scale = _length_scale(findings, position, reading, station)
    findings.understood |= {"stations": len(stations), "readings": rows}
    row_data = row_data_of(findings, "lengths")
    labels = _numbered(findings, [names, points], position, reading, row_data)
    return Lengths(
        stations=stations,
        station=station,
        point=points,
        position_mm=position,
        length_mm=reading * scale,
        tool_mm=row_data.tool_mm,
        approach=row_data.approach,
        labels=labels,
        covariates=row_data.covariates,
        metadata=metadata_of(findings, row_data),
        origin=[(str(table.grid.path), line) for line in table.lines],
    )


def _positions(findings: TableFindings, keys: str) -> FloatArray:
    missing = [key for key in keys if key not in findings.fields]
    if missing:
        raise open_columns(findings, f"has no column of commanded {missing[0].upper()}; give --map {missing[0]}=COLUMN")
    raw = [findings.numbers(key) for key in keys]
    longest = int(np.argmax([np.ptp(values) for values in raw]))
    first = findings.positions_mm(keys[longest], raw[longest])
    factor = MM_PER_LENGTH[str(findings.understood["position_unit"])]
    columns = []
    for k, key in enumerate(
        keys
    ):  # the other two in their unit if they have one, otherwise in that of the longest axis
        unit = findings.unit(key, "position") or ""
        columns.append(first if k == longest else raw[k] * MM_PER_LENGTH.get(unit, factor))
    return np.column_stack(columns)


def _length_scale(
    findings: TableFindings, position: FloatArray, reading: FloatArray, station: NDArray[np.int64]
) -> float:
    """Return the signed mm per unit of the lengths: as declared, compared with the geometry of each station."""
    found = [judge_lengths(position[station == k], reading[station == k]) for k in np.unique(station)]
    geometry = [item for item in found if item is not None]
    declared = findings.unit("length", "value")
    ratio = float(np.median([item.mm_per_unit for item in geometry])) if geometry else None
    fitting = [name for name, mm in MM_PER_LENGTH.items() if ratio and abs(ratio / mm - 1.0) < UNIT_TOLERANCE]
    unit = fitting[0] if fitting else None
    signs = {item.sign for item in geometry}
    sign = signs.pop() if len(signs) == 1 else 0
    if declared is not None and declared not in MM_PER_LENGTH:
        raise findings.table.grid.fail(f"{declared} is not a unit of length", None, findings.fields["length"].name)
    if declared is None and unit is None:
        findings.ask(
            "the file states no unit of the lengths, and the points do not show it",
            "units",
            unit_choices("mm", "m", "um", "in"),
            "give --unit length=mm",
            key="length",
        )
    elif declared is None:
        findings.notes.append(f"the lengths fit the points in {unit}")
    elif unit is not None and unit != declared:
        findings.ask(
            f"the declared unit of the lengths is {declared}, but they fit the points in {unit}",
            "units",
            unit_choices(unit, declared),
            "give --unit length=...",
            key="length",
            default=unit,
        )
    if sign < 0:
        findings.notes.append("the lengths decrease with growing distance: their sign was reversed")
    if sign == 0:
        findings.notes.append(
            "the points do not show the sign of the lengths; they are assumed to grow with the distance"
        )
    chosen = declared or unit or "mm"
    findings.understood |= {"unit": chosen, "sign": "grows with the distance" if sign >= 0 else "reversed"}
    findings.understood["mm_per_unit_by_geometry"] = ratio
    return MM_PER_LENGTH[chosen] * (-1.0 if sign < 0 else 1.0)


def _numbered(
    findings: TableFindings, names: Sequence[Sequence[str]], position: FloatArray, value: FloatArray, row_data: RowData
) -> dict[str, NDArray[np.int64]]:
    """Return the labels; indistinguishable rows are numbered as repeats, or refused if they are a copy.

    Raises
    ------
    InputError
        if three or more rows repeat earlier ones, and each of them to the last digit: they were pasted twice.
    """
    first, count = earlier_rows(_keys(names, position, row_data))
    again = np.flatnonzero(count > 1)
    if not again.size:
        return row_data.labels
    if again.size >= 3 and np.array_equal(value[again], value[first[again]]):
        line, earlier = (findings.table.lines[k] for k in (int(again[0]), int(first[again[0]])))
        message = (
            f"{again.size} rows repeat earlier ones to the last digit (this one line {earlier}): remove the copies"
        )
        raise findings.table.grid.fail(message, line)
    findings.notes.append(
        f"{again.size} rows repeat a position without a run or repeat: they were numbered in order of occurrence"
    )
    if "repeat" in row_data.labels:
        count = count + row_data.labels["repeat"] * (1 + int(count.max()))
    return {**row_data.labels, "repeat": count}


def _keys(names: Sequence[Sequence[str]], position: FloatArray, row_data: RowData) -> FloatArray:
    """Return what distinguishes rows, a number for each column (rows, k)."""
    numbered = [np.unique(np.array(cells), return_inverse=True)[1] for cells in names]
    times = [row_data.covariates[key] for key in ("time_s", "approach") if key in row_data.covariates]
    vectors = [part for part in (position, row_data.tool_mm, row_data.approach) if part is not None]
    return np.column_stack([*numbered, *times, *row_data.labels.values(), *vectors]) + 0.0


def deviations_of(findings: TableFindings) -> Deviations:
    """Return measured minus commanded positions, from deviations or from measured positions."""
    position = _positions(findings, "xyz")
    deviation = np.full_like(position, np.nan)
    usual = usual_deviation_mm(float(np.ptp(position, axis=0).max()))
    for k, axis in enumerate("xyz"):
        if f"d{axis}" in findings.fields:
            name = findings.fields[f"d{axis}"].name
            values = findings.numbers(f"d{axis}")
            deviation[:, k] = findings.values_si(f"d{axis}", name, values, usual, angular=False)
        elif f"{axis}a" in findings.fields:
            deviation[:, k] = _measured(findings, f"{axis}a", position[:, k])
    if findings.options.sign == "correction":
        deviation = -deviation
        findings.understood["sign"] = "corrections, sign reversed"
    else:
        findings.understood["sign"] = "measured minus commanded"
    findings.understood["readings"] = len(position)
    row_data = row_data_of(findings, "deviations")
    return Deviations(
        position_mm=position,
        deviation_mm=deviation,
        tool_mm=row_data.tool_mm,
        approach=row_data.approach,
        labels=_numbered(findings, [], position, np.nan_to_num(deviation).sum(axis=1), row_data),
        covariates=row_data.covariates,
        metadata=metadata_of(findings, row_data),
        origin=[(str(findings.table.grid.path), line) for line in findings.table.lines],
    )


def check_largest(deviation_mm: FloatArray, origin: Sequence[tuple[str, int]]) -> None:
    """Refuse deviations that native files do not allow; ``deviation_mm`` is (n,) or (n, 3), nan where unknown."""
    size = np.nan_to_num(np.abs(deviation_mm)).reshape(len(deviation_mm), -1).max(axis=1)
    worst = int(np.argmax(size))
    if size[worst] > LARGEST_DEVIATION_UM * MM_PER_UM:
        file, line = origin[worst]
        raise InputError(
            f"a deviation of {size[worst]:.4g} mm is not plausible; is it a mistake, or another unit?",
            file=file,
            line=line,
        )


def _measured(findings: TableFindings, key: str, position: FloatArray) -> FloatArray:
    """Return measured minus commanded coordinate; unit and sign by the slope of measured over commanded."""
    values = findings.numbers(key)
    name, declared = findings.fields[key].name, findings.unit(key)
    scale = MM_PER_LENGTH.get(declared, 1.0) if declared else 1.0
    if np.ptp(position) > 0:
        slope = slope_of(position, values * scale)
        if slope.unit_ratio != 1.0 or slope.sign < 0:
            findings.ask(f"{name!r} follows the command with the slope {slope.slope:.5g}, not 1")
    return values * scale - position


# Tables of circular tests (ballbar): radial deviations or radii over the angle, with a column or words for the direction.
#
# There is no public specification of the text exports of ballbar programs. What is read are names of columns and lines
# above the table; that angles count from the first axis of the plane to the second one is inferred, and tested with both
# directions: they have one centre.


#: Words for both directions, letters only, longest first: "counterclockwise" contains "clockwise".
_TURNS = {
    "counterclockwise": 1, "anticlockwise": 1, "gegenuhrzeigersinn": 1, "antihoraire": 1, "antiorario": 1, "antihorario": 1,
    "imuhrzeigersinn": -1, "uhrzeigersinn": -1, "clockwise": -1, "horaire": -1, "orario": -1, "horario": -1,
    "ccw": 1, "acw": 1, "cw": -1, "\u9006\u65f6\u9488": 1, "\u987a\u65f6\u9488": -1,
}  # fmt: skip
#: What else the name of a column of one direction may say.
_OF_A_TURN = re.compile(r"radial|deviation|dev|abweichung|reading|run|lauf|nr|no|test|data|um|mm|nm")
#: The centres of both directions differ by more than this share of their distance from the centre in the other sense, and
#: by more than this many um, where the angles of one direction count backwards.
_MIRRORED, _MIRRORED_UM = 0.3, 2.0


def _turn(text: str) -> tuple[int, int] | None:
    """Direction and number (0: none) that a cell or the name of a column states; None if it states something else too."""
    letters = re.sub(r"[^a-z\u4e00-\u9fff]", "", text.lower().replace("\u00b5", "u").replace("\u03bc", "u"))
    word = next((word for word in _TURNS if word in letters), None)
    if word is None or _OF_A_TURN.sub("", letters.replace(word, "", 1)):
        return None
    numbers = re.findall(r"\d+", text)
    return (_TURNS[word], int(numbers[0]) if numbers else 0) if len(numbers) < 2 else None


#: XZ, ZY and YX are not among the names: their angles would count the other way.
_PLANE_NAMES = {**{name: k for k, name in enumerate(PLANES)}, "G17": 0, "G19": 1, "G18": 2}


def _plane(text: str) -> int:
    """Return the number of a plane as people write it (XY, X-Y, XY plane, G17 (XY)); -1 for anything else, and for two of them.

    >>> _plane("XY-Ebene"), _plane("Y/Z"), _plane("G18 (ZX)"), _plane("XZ"), _plane("G17 YZ")
    (0, 1, 2, -1, -1)
    """
    words = re.findall(r"G1[789]|[XYZ] ?[-/]? ?[XYZ](?![A-Z])", text.upper())
    found = {_PLANE_NAMES.get(re.sub(r"[-/ ]", "", word), -1) for word in words}
    return found.pop() if len(found) == 1 else -1


def circles_of(findings: TableFindings) -> Circles:
    """Return the radial deviations of a circular test, from deviations or from radii."""
    _need(findings, "angle")
    row, direction, run, value_mm, radius_mm = _radial(findings)
    angle = findings.numbers("angle")
    unit = findings.unit("angle") or ("deg" if np.ptp(angle) > 7.0 else None)
    if unit is None:
        unit = "rad"
        findings.ask(
            "the file states no unit of the angle",
            "units",
            unit_choices("deg", "rad"),
            "give --unit angle=rad or deg",
            key="angle",
        )
    given, stated = findings.options.plane, _above(findings, "plane")[0]
    if given is not None and _plane(stated) not in (-1, list(PLANES).index(given)):
        text = f"the file states the plane {shown(stated)}; give --plane {given} for files only that do not state another one"
        raise InputError(text, file=findings.table.grid.path, field="--plane")
    if given is None and not stated and "plane" in findings.fields:
        planes = findings.table.column(findings.fields["plane"].name)
    else:
        planes = [given or stated]
    plane = np.array([_plane(name) for name in planes], dtype=np.int64)
    if (plane < 0).any():
        findings.ask(
            "the file does not state the plane as XY, YZ or ZX, in which angles count from the first axis to the second",
            "plane",
            choices_of(tuple(PLANES)),
            "give --plane, if angles count from its first axis",
            picture="plane",
        )
        plane = np.zeros(1, dtype=np.int64)
    findings.understood["plane"] = ", ".join(list(PLANES)[k] for k in np.unique(plane))
    angle_rad = (angle * RAD_PER_ANGLE[unit])[row]
    _check_sense(findings, angle_rad, direction, value_mm)
    findings.understood |= {
        "angle": f"{unit}, from the first axis of the plane to the second (inferred)",
        "readings": len(row),
        "directions": sorted(set(direction.tolist())),
        "runs": len(np.unique(run)),
    }
    if findings.options.sign == "correction":
        value_mm = -value_mm
    findings.understood["sign"] = "corrections, sign reversed" if findings.options.sign == "correction" else (
        "actual minus nominal radius"
    )  # fmt: skip
    row_data = row_data_of(findings, "circle", once=len(row) == len(angle))
    covariates = {name: values[row] for name, values in row_data.covariates.items()}
    origin = [(str(findings.table.grid.path), int(findings.table.lines[k])) for k in row]
    check_largest(value_mm, origin)
    return Circles(
        plane=np.broadcast_to(plane, len(findings.table.lines))[row],
        angle_rad=angle_rad,
        radius_mm=np.full(len(row), radius_mm),
        deviation_mm=value_mm,
        direction=direction,
        run=run,
        setup=np.zeros(len(row), dtype=np.int64),
        centre_mm=np.full((len(row), 3), np.nan),
        u_mm=np.full(len(row), np.nan),
        covariates=covariates,
        metadata=metadata_of(findings, row_data),
        origin=origin,
    )


def _radial(findings: TableFindings) -> tuple[IntArray, IntArray, IntArray, FloatArray, float]:
    """Row, direction, run and radial deviation (mm) of each reading, and the nominal radius."""
    fields, table = findings.fields, findings.table
    taken = {column.name for column in fields.values()}
    turns = {name: found for name in table.header if name not in taken and (found := _turn(name)) is not None}
    if not turns and "deviation" not in fields and "actual" not in fields and "radius" in fields:
        # a radius that changes is a measured one
        findings.fields = {
            **{key: column for key, column in fields.items() if key != "radius"},
            "actual": fields["radius"],
        }
        fields = findings.fields
    stated, unit = _above(findings, "radius")
    number = parse_number(stated)
    radius_mm = 100.0  # until the user gives it
    if findings.options.radius_mm is not None:
        radius_mm = findings.options.radius_mm
    elif "radius" in fields and np.ptp(radii := findings.positions_mm("radius", findings.numbers("radius"))) == 0.0:
        radius_mm = float(radii[0])
    elif number is not None and unit in MM_PER_LENGTH:
        radius_mm = number * MM_PER_LENGTH[str(unit)]
    else:
        findings.ask("the file states no nominal radius with its unit", "radius_mm", (), "give --radius-mm")
    if not 0.0 < radius_mm <= LARGEST_RADIUS_MM:
        raise table.grid.fail(f"{radius_mm:g} mm is not a radius; expected above 0, up to {LARGEST_RADIUS_MM:g} mm")
    findings.understood["radius_mm"] = radius_mm
    usual_mm = usual_deviation_mm(2.0 * radius_mm)
    rows = np.arange(len(table.lines))
    if turns and "deviation" not in fields:
        units = {split_name(name).unit for name in turns}
        if len(units) > 1:
            raise table.grid.fail(
                "the columns of both directions have different units; write them alike", table.header_line
            )
        findings.fields = {**fields, "deviation": split_name(next(iter(turns)))}
        findings.used |= set(turns)
        whole = [np.array(table.numbers(name, empty=True)) for name in turns]
        row = np.tile(rows, len(turns))
        value, kept = np.concatenate(whole), np.isfinite(np.concatenate(whole))
        direction, run = (np.repeat([found[k] for found in turns.values()], len(rows)) for k in (0, 1))
        row, direction, run, value = row[kept], direction[kept], run[kept], value[kept]
        return (
            row,
            direction,
            run,
            findings.values_si("deviation", "deviation", value, usual_mm, angular=False),
            radius_mm,
        )
    if "direction" in fields:
        cells = table.column(fields["direction"].name)
        ways = []
        for cell, line in zip(cells, table.lines, strict=True):
            turned = _turn(cell)
            ways.append(turned[0] if turned else way(cell))
            if ways[-1] is None:
                message = f"{shown(cell)} is not a direction; write CCW or CW, 1 or -1"
                raise table.grid.fail(message, line, fields["direction"].name)
        direction = np.array(ways, dtype=np.int64)
    elif (stated_turn := _turn(_line_above(findings, "direction")[1])) is not None:
        direction = np.full(len(rows), stated_turn[0])
    else:
        direction = np.ones(len(rows), dtype=np.int64)
        findings.ask(
            "no column states the direction (CCW, CW)",
            "columns",
            choices_of(table.header),
            "give --map direction=COLUMN, or add such a column",
            key="direction",
        )
    run = labels_of(findings, fields["run"]) if "run" in fields else np.zeros(len(rows), dtype=np.int64)
    if "deviation" in fields:
        findings.used.add(fields["deviation"].name)
        values = findings.numbers("deviation")
        value_mm = findings.values_si("deviation", fields["deviation"].name, values, usual_mm, angular=False)
    else:
        _need(findings, "actual")
        findings.used.add(fields["actual"].name)
        value_mm = findings.positions_mm("actual", findings.numbers("actual")) - radius_mm
    return rows, direction, run, value_mm, radius_mm


def _above(findings: TableFindings, key: str) -> tuple[str, str | None]:
    """The value that a line above the table states for a field, and its unit; empty without such a line."""
    name, text = _line_above(findings, key)
    digits = [k for k, letter in enumerate(text) if letter.isdigit()]
    value, unit = (text[: digits[-1] + 1], text[digits[-1] + 1 :].strip()) if digits else ("", "")  # 150 mm, 150mm
    if key == "plane" or not value or len(value.split()) > 1:
        return text, None
    return value, split_name(name).unit or known_unit(unit)


def _line_above(findings: TableFindings, key: str) -> tuple[str, str]:
    """The line above the table about a field: its name and what it states; empty without one."""
    for name, text in findings.table.metadata.items():
        if split_name(name).word in FIELDS[key] and text.strip():
            return name, text.strip()
    return "", ""


def _check_sense(findings: TableFindings, angle_rad: FloatArray, direction: IntArray, value_mm: FloatArray) -> None:
    """Ask whether the angles of one direction count backwards, where the centres of both look mirrored."""
    if len(np.unique(direction)) < 2 or findings.options.directions == "labels":
        return
    centres = []
    for sense in (1, -1):
        t = angle_rad[direction == sense]
        design = np.column_stack([np.cos(t), np.sin(t), np.ones(len(t))])
        centres.append(1e3 * np.linalg.lstsq(design, value_mm[direction == sense], rcond=1e-6)[0][:2])
    apart = float(np.linalg.norm(centres[0] - centres[1]))
    mirrored = float(np.linalg.norm(centres[0] - centres[1] * [1.0, -1.0]))
    if apart > _MIRRORED_UM and mirrored < _MIRRORED * apart:
        findings.ask(
            f"the centres of both directions are mirrored ({apart:.3g} um apart): angles of one direction seem to count the "
            "other way",
            "directions",
            (Choice("labels", "they are right as the file has them"),),
            "correct them, or give --directions labels if they are right",
        )


# The kind of measurement of a table, and the combination of the sheets of a workbook.


#: Number of lines above a table that are shown.
_MOST_HEADER = 12


def import_table(grid: CellGrid, options: ImportOptions, form: str = "table") -> Imported:
    """Import one table; InputError if it is none or lacks what its kind needs."""
    table = find_table(grid, options.decimal)
    findings = TableFindings(table, fields_of(table.header, options.columns, options.ignore), options)
    findings.notes.extend(table.grid.notes)
    if not {"position", "x", "y", "z"}.isdisjoint(findings.fields) and options.kind != "circle":  # then not of a circle
        others = {"angle", "radius", "plane"} - set(options.columns)
        findings.fields = {key: column for key, column in findings.fields.items() if key not in others}
    _along_one_axis(findings)
    kind = options.kind or _kind(findings)
    findings.understood["columns"] = {key: column.name for key, column in findings.fields.items()}
    if table.metadata:
        findings.understood["header"] = dict(list(table.metadata.items())[:_MOST_HEADER])
    reversal: ReversalCurves | None = None
    data: Data
    if kind == "lengths":
        _need(findings, "length")
        data = lengths_of(findings)
    elif kind == "deviations":
        data = deviations_of(findings)
    elif kind == "circle":
        data = circles_of(findings)
    elif kind == "errors" and options.error is None and (motions := motion_columns(findings)):
        data, reversal = error_motions(findings, motions)
    elif kind == "errors" and options.error is None:
        columns = error_columns(table.header)
        if not columns:
            _need(findings, "error", "position", "value")
        else:
            _need(findings, "position")
        data = wide_errors(findings, columns) if columns else long_errors(findings)
        data = marked_apart(data.replace(metadata=metadata_of(findings, row_data_of(findings, "errors"))))
    else:
        _need(findings, "position")
        data, reversal, kind = _along_axes(findings)
    return Imported(
        grid.path,
        form,
        kind,
        data,
        findings.understood,
        tuple(findings.questions),
        tuple(dict.fromkeys(findings.notes)),
        reversal,
    )


def _along_one_axis(findings: TableFindings) -> None:
    """Use the only coordinate of a table as position, with its deviation: X [mm], dX [um]."""
    letters = [axis for axis in "xyz" if axis in findings.fields]
    own = [axis for axis in "xyz" if f"d{axis}" in findings.fields or f"{axis}a" in findings.fields]
    if "position" in findings.fields:
        letters = []
    if len(letters) > 1 or len({*letters, *own}) != 1 or findings.options.kind not in (None, "axis"):
        return
    (axis,) = {*letters, *own}
    names = {axis: "position"} if letters else {}
    findings.checked_sign = f"d{axis}" in findings.fields
    names |= {
        old: new for old, new in ((f"d{axis}", "deviation"), (f"{axis}a", "actual")) if new not in findings.fields
    }
    findings.fields = {names.get(key, key): column for key, column in findings.fields.items()}
    if "axis" not in findings.fields and findings.options.axis is None and findings.options.error is None:
        findings.letter = axis.upper()


def _kind(findings: TableFindings) -> Kind:
    fields = findings.fields
    space = {"x", "y", "z"} <= set(fields)
    if space and "length" in fields:
        return "lengths"
    if space and not {"dx", "dy", "dz", "xa", "ya", "za"}.isdisjoint(fields):
        return "deviations"
    if "position" in fields and (error_columns(findings.table.header) or {"error", "value"} <= set(fields)):
        return "errors"
    if "position" in fields and findings.options.error is None and motion_columns(findings):
        return "errors"
    if "position" in fields:
        return "axis"
    if "angle" in fields:
        return "circle"
    header = ", ".join(findings.table.header)
    raise open_columns(
        findings,
        f"its columns are not recognised: {shown(header)}; assign them: --map position=COLUMN --map deviation=COLUMN (axis "
        "runs), x y z length (lengths), x y z dx dy dz (deviations), error position value (errors)",
    )


def open_columns(findings: TableFindings, message: str) -> OpenColumnsError:
    """Return the error for columns that the user has to name, with the line of the header."""
    return OpenColumnsError(message, file=findings.table.grid.path, line=findings.table.header_line)


def _need(findings: TableFindings, *keys: str) -> None:
    for key in keys:
        if key not in findings.fields:
            header = ", ".join(findings.table.header)
            raise open_columns(
                findings, f"no column is recognised as {key}; the header has {shown(header)}; give --map {key}=COLUMN"
            )


def _along_axes(findings: TableFindings) -> tuple[Data, ReversalCurves | None, Kind]:
    error = findings.options.error
    angular = error is not None and error[1:2] in ("A", "B", "C")
    found, row_data = axis_readings(findings, angular=angular)
    metadata = metadata_of(findings, row_data)
    path = findings.table.grid.path
    if error is not None:
        if len(found) > 1:
            raise InputError("contains several axes; --error is for the error of one axis", file=path)
        ((letter, runs),) = found.items()
        check_error(error, letter or None, angular=angular)
        findings.understood |= _described(runs, 1e-6 if angular else MM_PER_UM)
        findings.questions[:] = [asked for asked in findings.questions if asked.option != "axis"]
        table, reversal = errors_of(runs, error, metadata)
        return table, reversal, "errors"
    above = findings.table.metadata
    told = set(motions_in(" ".join([*findings.table.grid.notes[:1], path.stem, *above, *above.values()])))
    if findings.options.kind is None and told & {"straightness", "yaw", "roll"}:
        own = next(iter(found)) if len(found) == 1 else ""
        findings.ask(
            f"the lines above the table, or a name, mention {', '.join(sorted(told))}",
            "error",
            errors_along(own),
            "give --error NAME (EYX: straightness of X in Y, ECX: yaw), or --kind axis if these are positioning deviations",
        )
    findings.understood["axes"] = {letter or "?": _described(runs, MM_PER_UM) for letter, runs in found.items()}
    return runs_of(found, str(path), metadata), None, "axis"


def _described(runs: OneAxis, unit: float) -> dict[str, object]:
    facts = runs.summary()
    name = "um" if unit == MM_PER_UM else "urad"
    return {
        **{key: value for key, value in facts.items() if key not in ("rms", "largest")},
        **{f"{key}_{name}": float(facts[key]) / unit for key in ("rms", "largest")},  # type: ignore[arg-type]
    }


def runs_of(found: dict[str, OneAxis], file: str, metadata: dict[str, str]) -> AxisRuns:
    """Return the readings of all axes as one object; an unknown axis counts as X until the user gives it."""
    parts = [(letter, item.ordered()) for letter, item in found.items()]
    runs = AxisRuns(
        axis=np.concatenate([np.full(len(item.value), AXES.index(letter or "X")) for letter, item in parts]),
        position_mm=np.concatenate([item.position_mm for _, item in parts]),
        direction=np.concatenate([item.direction for _, item in parts]),
        run=np.concatenate([item.run for _, item in parts]),
        deviation_mm=np.concatenate([item.value for _, item in parts]),
        covariates=_together([item.covariates for _, item in parts]),
        metadata=metadata,
        origin=[(file, int(line)) for _, item in parts for line in item.line],
    )
    check_single(runs)
    return runs


def merged_sheets(parts: Sequence[tuple[str, Imported]]) -> Imported:
    """Return several sheets of one workbook, each the runs of another axis or other errors, as one."""
    first = parts[0][1]
    kinds = {item.kind for _, item in parts}
    names = ", ".join(shown(name) for name, _ in parts)
    if len(parts) == 1:
        return first
    asking = Asking(
        questions=[
            replace(asked, reason=f"sheet {name}: {asked.reason}") for name, item in parts for asked in item.questions
        ]
    )
    errors = [item.data for _, item in parts if isinstance(item.data, ErrorTable)]
    other_errors = None
    if kinds == {"axis"} or kinds == {"axis", "errors"}:
        read = [item.data for _, item in parts if isinstance(item.data, AxisRuns)]
        # with the covariates that all sheets have
        common = set.intersection(*(set(part.covariates) for part in read))
        kept = [replace(r, covariates={k: v for k, v in r.covariates.items() if k in common}) for r in read]
        runs = replace(join_axis_runs(kept), metadata=read[0].metadata)
        data: Data = runs
        other_errors = _joined_errors(first, errors) if errors else None
        for axis in runs.axes:
            name, rows = POSITIONING[axis], runs.axis == axis
            if other_errors is not None and name in other_errors.curves:
                mean, _, _ = two_way_mean(runs.position_mm[rows], runs.direction[rows], runs.deviation_mm[rows])
                away = float(np.abs(mean.value - other_errors.curves[name].at(mean.position_mm)).max()) / MM_PER_UM
                asking.ask(
                    f"a sheet contains {name}, and the runs of {AXES[axis]} give it, too (their means differ by up to "
                    f"{away:.3g} um)",
                    "ignore",
                    choices_of([sheet for sheet, _ in parts]),
                    "exclude one sheet with --ignore SHEET",
                )
    elif kinds == {"errors"}:
        data = _joined_errors(first, errors)
    else:
        raise InputError(f"has several tables ({names}); choose one with --sheet", file=first.path)
    understood = {f"sheet {name}": dict(item.understood) for name, item in parts}
    notes = tuple(dict.fromkeys(text for _, item in parts for text in item.notes))
    kind: Kind = "errors" if kinds == {"errors"} else "axis"
    reversals = {key: curve for _, item in parts if item.reversal for key, curve in item.reversal.curves.items()}
    reversal = (
        ReversalCurves(reversals, next(item.reversal.metadata for _, item in parts if item.reversal))
        if reversals
        else None
    )
    return replace(
        first,
        kind=kind,
        data=data,
        understood=understood,
        questions=tuple(asking.questions),
        notes=notes,
        other_errors=other_errors,
        reversal=reversal,
    )


def _together(parts: Sequence[Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return the covariates that every part has, one after the other."""
    common = [name for name in parts[0] if all(name in part for part in parts)]
    return {name: np.concatenate([part[name] for part in parts]) for name in common}


def _joined_errors(first: Imported, parts: Sequence[ErrorTable]) -> ErrorTable:
    twice = doubled(name for item in parts for name in item.names)
    if twice is not None:
        raise InputError(f"{twice} is on two sheets; choose one with --sheet", file=first.path)
    curves = {name: curve for item in parts for name, curve in item.curves.items()}
    squareness = {name: value for item in parts for name, value in item.squareness.items()}
    metadata = {key: value for key, value in parts[0].metadata.items() if key != "squareness"}
    # what is on one sheet was measured together: curves with squareness, or both arms of a square
    arms = [pair for pair in ARMS.values() if set(pair) <= set(curves)]
    together = any(item.curves and item.squareness for item in parts)
    together |= not squareness and any(set(pair) <= set(item.curves) for item in parts for pair in arms)
    if (squareness or arms) and curves and not together:
        metadata["squareness"] = SQUARENESS_APART
    return marked_apart(ErrorTable(curves, squareness, metadata))
