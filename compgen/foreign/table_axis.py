"""Tables of readings along axes: a row for each reading, or a row for each target and a column for each run.

:func:`axis_readings` finds runs, deviations, axes and directions. Columns that say the same thing twice (deviations next to
readings, means next to runs) are compared, and the user is asked where they disagree.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES
from compgen.errors import InputError
from compgen.foreign.column_names import (
    FIELDS,
    MM_PER_LENGTH,
    RUN_FIELD,
    RunColumn,
    is_deviation,
    run_columns,
    run_in,
    split_name,
    statistic_in,
    unaccented,
)
from compgen.foreign.covariates import RowData, directions_of, labels_of, row_data_of
from compgen.foreign.findings import USUAL_URAD, TableFindings, slope_of, usual_deviation_mm
from compgen.foreign.one_axis import IntArray, OneAxis, axis_in, cycles, earlier_rows, motion, remarks
from compgen.foreign.source import parse_number, shown
from compgen.identify.single_axes import SAME_TARGET_MM

#: Units that are tried for deviations without one, mm.
_LIKELY = {name: MM_PER_LENGTH[name] for name in ("um", "mm", "in", "nm")}
#: A column without a telling name holds readings, not deviations, if it follows the targets so closely.
FOLLOWS = 1e-2
_AXIS_KEYS = ("measuredaxis", "machineaxis", "testaxis", "gemesseneachse", "messachse", "maschinenachse", "axemesure",
              "assemisurato", "ejemedido")  # fmt: skip
_NAMED_AXIS = re.compile(
    r"\b([XYZ])[1-9]?[\s\-_]*(?:ACHSE|AXIS|AXE|ASSE|EJE|\u8f74)|(?:ACHSE|AXIS|AXE|ASSE|EJE|\u8f74)[\s\-_:]*([XYZ])[1-9]?\b"
)
#: Parts of words that speak of corrections.
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
    """Return the readings of each axis, "" where nothing says which it is, and the other columns."""
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
        beside = {name: values[rows.row[own]] for name, values in row_data.covariates.items()}
        by_rows = not rows.label[own].any() and findings.options.directions != "alternate"
        in_time = by_rows and bool(np.all(np.diff(rows.run[own]) >= 0))
        found[letter] = OneAxis(target[own], direction, run, value[own], line, beside, in_time)
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
        raise InputError(f"columns of runs are named, and {fields[key].name!r} holds {key}s: leave it out with --ignore",
                         file=findings.table.grid.path, field="--map")  # fmt: skip
    if key is None and not wide:
        raise findings.table.grid.fail(
            f"has positions but no deviations or readings; the header has {shown(', '.join(header), 200)}; "
            "give --map deviation=COLUMN, or --map run1+=COLUMN, run1-=COLUMN ... for a column each run",
            findings.table.header_line,
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
    """Directions as a column names them (rows,), 0 without such a column; signs of the axis count too (X+, X-)."""
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
    """Return numbers of runs, and directions where every cell of that column names one as well (1+, 1-, Lauf 2 vor)."""
    column = findings.fields["run"]
    cells = findings.table.column(column.name)
    read = {cell: run_in(cell) for cell in dict.fromkeys(cells)}
    named = [item for item in read.values() if item is not None and item.direction and parse_number(item.name) is None]
    if not named:
        return labels_of(findings, column), None
    unknown = next((k for k, cell in enumerate(cells) if (item := read[cell]) is None or not item.direction), None)
    if unknown is not None:
        message = f"{shown(cells[unknown])} names no direction, other cells of this column do ({shown(named[0].name)})"
        raise findings.table.grid.fail(message, findings.table.lines[unknown], column.name)
    runs = [item for cell in cells if (item := read[cell]) is not None]
    number = np.array([item.number for item in runs], dtype=np.int64)
    return number, np.array([item.direction for item in runs], dtype=np.int64)


def _compared(findings: TableFindings, key: str) -> str:
    """Compare deviations or corrections that are printed next to the readings with them; return the field that counts.

    The finer one counts where both agree; where they do not, or differ in sign, the user is asked.
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
                findings.notes.append(f"{name!r} has more digits and is taken")
                return other
            continue
        what = "has the opposite sign of" if found else "disagrees with"
        pair = f"{counting!r} minus target" if key == "actual" else repr(counting)
        findings.doubts.append(f"{name!r} {what} {pair}; leave out the wrong one: --ignore COLUMN")
    return key


def _reference(findings: TableFindings, key: str) -> tuple[FloatArray | None, float, float]:
    """Return the deviations by which others are judged, mm per unit of them, and the value of their last digit.

    None where readings do not follow the targets in a known unit; the user is asked elsewhere.
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
    """Return the value of the last digit that a column is written with."""
    decimals = [len(cell.partition(".")[2]) for cell in findings.table.column(name) if "e" not in cell.lower()]
    return float(10.0 ** -max(decimals, default=0))


def _wide(findings: TableFindings, columns: Sequence[RunColumn]) -> _Rows:
    """Columns of runs, one after the other; an empty cell is a reading that was not taken."""
    labels = _labels(findings)
    seen: dict[tuple[int, int], str] = {}
    for column in columns:
        earlier = seen.setdefault((column.number, column.direction), column.name)
        if earlier != column.name:
            message = f"{shown(earlier)} and {shown(column.name)} are the same run and direction; say which is which: "
            raise findings.table.grid.fail(message + "--map run1+=COLUMN, run1-=COLUMN ...", findings.table.header_line)
    units = {column.name: split_name(column.name).unit for column in columns}
    if len(set(units.values())) > 1 and findings.options.given_unit("deviation", "value") is None:
        text = ", ".join(f"{shown(name)} {unit or 'none'}" for name, unit in units.items())
        message = f"the runs have different units ({text}); if all have one, say it with --unit deviation=UNIT"
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
    """Tell means and other statistics from the runs; a mean must be that of the runs."""
    mm = MM_PER_LENGTH.get(split_name(columns[0].name).unit or "")
    taken = {*findings.used, *(column.name for column in findings.fields.values()), *findings.options.ignore}
    for name in findings.table.header:
        found = statistic_in(name)
        if name in taken or found is None:
            continue
        kind, way_of = found
        findings.used.add(name)
        findings.notes.append(f"{name!r} is a statistic over the runs, no run")
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
            findings.doubts.append(
                f"{name!r} says {printed[k]:g} in line {findings.table.lines[k]}, the mean of "
                f"{', '.join(repr(column.name) for column in own[:6])} is {runs[k].mean() / scale:.6g}: is a run missing, or one "
                f"named wrongly? If the runs are right, --ignore {shown(name)}"
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
        findings.notes.append("the column is called a correction: its sign is turned round")
    if chosen is None:
        above = findings.table.metadata
        words = unaccented(" ".join([*findings.table.header, *above, *above.values()]))
        told = any(word in words for word in (*_TELLING, *FIELDS["deviation"][:1]))
        told = told or any(is_deviation(name) for name in findings.table.header)
        if not told and len(findings.runs) > 1 and not any(word in words for word in _COUNTER):
            findings.notes.append("runs are measured: their values are taken as measured minus target")
        elif not told and not findings.checked_sign:
            findings.doubts.append(
                "nothing says whether the values are errors (measured minus target) or corrections; give --sign error or "
                "correction"
            )
        chosen = "error"
    findings.understood["sign"] = (
        "measured minus target" if chosen == "error" else "target minus measured, turned round"
    )
    return -si if chosen == "correction" else si


def _from_readings(findings: TableFindings, rows: _Rows, target: FloatArray) -> FloatArray:
    """Reading minus target; unit and sign of the readings by their slope over the targets."""
    slope = slope_of(target, rows.value)
    column = findings.fields.get("actual")
    declared = findings.options.given_unit("actual") or (column.unit if column else None)
    scale = MM_PER_LENGTH.get(declared, 1.0) if declared else 1.0 / (slope.unit_ratio or 1.0)
    if slope.unit_ratio is None:
        findings.doubts.append(
            f"the readings follow the targets with the slope {slope.slope:.5g}, which is not a ratio of units"
        )
    elif abs(scale * slope.unit_ratio - 1.0) > 0.01:
        findings.doubts.append(f"{rows.name!r} says {declared}, but one mm of travel is {slope.unit_ratio:g} in it")
        scale = 1.0 / slope.unit_ratio
    if slope.sign < 0:
        findings.doubts.append("the readings fall where the targets rise: the sign of one of them is turned round")
    sign = -1.0 if slope.sign < 0 and findings.options.sign == "correction" else 1.0
    offset = slope.offset * scale
    if abs(offset) > 1.0:
        findings.notes.append(f"readings are {offset:.6g} mm off the targets at zero; nothing was taken off")
    findings.understood["slope_of_readings"] = slope.slope
    findings.understood["sign"] = "measured minus target"
    findings.understood["unit"] = next((u for u, mm in MM_PER_LENGTH.items() if abs(mm / scale - 1) < 1e-9), "mm")
    return sign * rows.value * scale - target


def _axes(findings: TableFindings, row: IntArray) -> list[str]:
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
        other = f"the sheet or file is called {named}" if len(said) == 1 else "several axes are named"
        findings.doubts.append(f"the lines above the table say axis {', '.join(sorted(said))}, {other}; give --axis")
        return [sorted(said)[0]] * len(row)
    if named:
        findings.notes.append(f"axis {named} by the name of the sheet or file")
        return [named] * len(row)
    findings.doubts.append(f"nothing says which axis it is; give --axis {', '.join(AXES)}")
    return [""] * len(row)


def _directions(
    findings: TableFindings, target: FloatArray, run: IntArray, label: IntArray, value: FloatArray
) -> tuple[IntArray, IntArray]:
    """Direction of travel and number of the cycle: labels, against the order of the rows where that tells."""
    chosen = findings.options.directions
    one_way = run if run.any() else _sweeps(target)
    if chosen == "alternate":
        _, order = np.unique(one_way, return_inverse=True)
        direction = np.where(order % 2 == 0, 1, -1).astype(np.int64)
        return direction, cycles(direction, one_way)
    if not label.any():
        if len(set(zip(one_way.tolist(), target.tolist(), strict=True))) < len(target):
            one_way = _sweeps(target, one_way)  # a run that goes forth and back
        direction = motion(target, one_way)
        if len(findings.runs) > 1 and chosen is None:
            if _alternate(target, run, value):
                findings.doubts.append(
                    "no run names a direction, and odd and even runs differ as two directions do; say --directions alternate "
                    "(odd runs up, even runs down) or motion (all in the order of the rows)"
                )
            else:
                findings.notes.append("no run names a direction: all are taken as made in the order of the rows")
        findings.understood.setdefault("directions_from", "the order of the rows")
        if not direction.all():
            header = shown(", ".join(findings.table.header), 200)
            findings.doubts.append(
                f"there is no column of directions (the header has {header}), and the order of the rows does not tell them "
                "everywhere; give --map direction=COLUMN, or --directions alternate (odd runs up, even runs down)"
            )
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
    """Number of the one-way run of each row: a new one begins where a target comes a second time, or with another ``run``."""
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
    """Whether the rows of each label go the other way, in every run; a table sorted by targets says nothing."""
    ways: dict[int, set[int]] = {1: set(), -1: set()}
    for number in np.unique(run):
        for sign in (1, -1):
            steps = np.diff(target[(run == number) & (label == sign)])
            if len(steps):
                ways[sign].add(int(np.sign(steps[0])) if np.all(np.sign(steps) == np.sign(steps[0])) else 0)
    return ways[1] == {-1} and ways[-1] == {1}
