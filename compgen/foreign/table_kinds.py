"""A foreign table becomes runs, errors, tracer lengths or measured positions.

:func:`import_table` decides which kind a table is and calls the reader of that kind; :func:`merged_sheets` puts the sheets
of one workbook together.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compgen.data.axis_runs import AxisRuns, check_single, join_axis_runs
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Deviations
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Lengths
from compgen.data.messages import doubled, nearest
from compgen.data.names import AXES, ERROR_INDEX, ERROR_NAMES, MM_PER_UM, RAD_PER_URAD, SQUARENESS_NAMES, error_named
from compgen.data.records import LARGEST_DEVIATION_UM
from compgen.errors import InputError
from compgen.foreign.cells import CellGrid, find_table
from compgen.foreign.column_names import (
    MM_PER_LENGTH,
    RAD_PER_ANGLE,
    NamedColumn,
    error_columns,
    fields_of,
    known_unit,
    split_name,
)
from compgen.foreign.covariates import RowData, metadata_of, row_data_of
from compgen.foreign.findings import (
    USUAL_URAD,
    Data,
    Imported,
    ImportOptions,
    Kind,
    TableFindings,
    judge_lengths,
    slope_of,
    usual_deviation_mm,
)
from compgen.foreign.one_axis import OneAxis, check_error, earlier_rows, errors_of
from compgen.foreign.source import parse_number, shown
from compgen.foreign.table_axis import axis_readings
from compgen.identify.single_axes import POSITIONING, two_way_mean

# Tables of geometric errors: a row for each value, or a column for each error over the position of one axis.


#: An angle between two axes differs from 90 degrees by less.
_MOST_DEG = 0.5


def wide_errors(findings: TableFindings, columns: Mapping[str, NamedColumn]) -> ErrorTable:
    """Return errors that have a column each; those of one axis share the column of positions."""
    axes = {error_named(name).axis for name in columns if name not in SQUARENESS_NAMES}
    if len(axes) > 1 and "axis" not in findings.fields:
        findings.doubts.append("errors of several axes share one column of positions; give one table for each axis")
    position = findings.positions_mm("position", findings.numbers("position"))
    order = np.argsort(position, kind="stable")
    if np.any(np.diff(position[order]) == 0):
        raise findings.table.grid.fail("a position appears twice", findings.table.header_line)
    curves, squareness = {}, {}
    for name, column in columns.items():
        findings.used.add(column.name)
        values = np.array(findings.table.numbers(column.name, empty=True))
        known = np.flatnonzero(np.isfinite(values[order]))
        si = _si(findings, name, column, values[order][known], float(np.ptp(position)))
        if name in SQUARENESS_NAMES:
            if np.ptp(si) > 0:
                raise findings.table.grid.fail(f"{name} is a single number, but there are several", None, column.name)
            squareness[name] = (float(si[0]), float("nan"))
        else:
            curves[name] = Curve(position[order][known], si, np.full(len(known), np.nan))
    return _finished(findings, curves, squareness)


def long_errors(findings: TableFindings) -> ErrorTable:
    """Return errors that have a row for each value: name, position, value."""
    table = findings.table
    names = [cell.strip().upper() for cell in table.column(findings.fields["error"].name)]
    for name, line in zip(names, table.lines, strict=True):
        if name not in ERROR_INDEX:
            message = f"{shown(name)} is not an error of ISO 230-1; {nearest(name, ERROR_NAMES)}"
            raise table.grid.fail(message, line, findings.fields["error"].name)
    values = findings.numbers("value")
    raw = np.array(table.numbers(findings.fields["position"].name, empty=True))
    span = raw[np.isfinite(raw)]
    position = np.full(len(raw), np.nan)
    if span.size:
        position[np.isfinite(raw)] = findings.positions_mm("position", span)
    curves, squareness = {}, {}
    u_column = findings.fields.get("u_value")
    for name in dict.fromkeys(names):
        rows = np.flatnonzero(np.array(names) == name)
        si = _si(findings, name, findings.fields["value"], values[rows], float(np.ptp(span)) if span.size else 0.0)
        u_si = np.full(len(rows), np.nan)
        if u_column is not None:  # in its own unit, else in that of the values
            u = np.array(table.numbers(u_column.name, empty=True))[rows]
            if np.any(u < 0):
                line = table.lines[int(rows[np.flatnonzero(u < 0)[0]])]
                raise table.grid.fail("a standard uncertainty is not negative", line, u_column.name)
            largest = values[rows][np.argmax(np.abs(values[rows]))]
            common = si[np.argmax(np.abs(values[rows]))] / largest if largest else float("nan")
            units = RAD_PER_ANGLE if error_named(name).kind != "linear" else MM_PER_LENGTH
            u_si = np.asarray(u * units.get(findings.unit("u_value") or "", common))
        if name in SQUARENESS_NAMES:
            if len(rows) > 1:
                raise table.grid.fail(f"{name} is a single number, but it appears again", table.lines[int(rows[1])])
            squareness[name] = (float(si[0]), float(u_si[0]))
            continue
        order = np.argsort(position[rows])
        at = position[rows][order]
        if not np.all(np.isfinite(at)) or np.any(np.diff(at) == 0):
            raise table.grid.fail(f"{name} has a position that is empty or appears twice", table.lines[int(rows[0])])
        curves[name] = Curve(at, si[order], u_si[order])
    return _finished(findings, curves, squareness)


def _si(findings: TableFindings, name: str, column: NamedColumn, values: np.ndarray, span_mm: float) -> np.ndarray:
    """Values of one error in mm or rad; a length may have an angle's unit (um/m) for squareness only."""
    if not len(values):
        raise findings.table.grid.fail("holds no value", findings.table.header_line, column.name)
    angular = error_named(name).kind != "linear"
    key = "value"
    findings.fields = {**findings.fields, key: column}
    units = RAD_PER_ANGLE if angular else MM_PER_LENGTH
    declared = findings.options.given_unit("angle" if angular else "linear") or column.unit
    if declared in units:
        findings.understood[f"unit_{'angle' if angular else 'length'}"] = declared
        return values * units[declared]
    findings.fields = {**findings.fields, key: NamedColumn(column.name, column.word, None)}
    usual = USUAL_URAD * 1e-6 if angular else usual_deviation_mm(span_mm)
    return findings.values_si(key, column.name, values, usual, angular=angular)


def _finished(
    findings: TableFindings, curves: dict[str, Curve], squareness: dict[str, tuple[float, float]]
) -> ErrorTable:
    sign = -1.0 if findings.options.sign == "correction" else 1.0
    findings.understood |= {
        "errors": [*curves, *squareness],
        "sign": "errors" if sign > 0 else "corrections, turned round",
    }
    words = " ".join([*findings.table.header, *findings.table.metadata, *findings.table.metadata.values()]).lower()
    if findings.options.sign is None and any(word in words for word in ("correct", "compensat", "korrektur")):
        findings.doubts.append("the file speaks of corrections; give --sign error or correction")
    turned = {name: Curve(curve.position_mm, sign * curve.value, curve.u) for name, curve in curves.items()}
    constants = {name: (sign * value, u) for name, (value, u) in squareness.items()}
    return ErrorTable(turned, constants, {"source": findings.table.grid.path.name})


#: Names of squareness in sheets of laboratories: the pair of axes, the error of ISO 230-1, and the sign with which an angle
#: above 90 degrees between the positive axes enters it.
_PAIRS = {"XY": ("EC0Y", 1.0), "XZ": ("EB0Z", -1.0), "YZ": ("EA0Z", 1.0)}
_PAIR = re.compile(
    r"(?<![A-Z])([XYZ])\s*[-/\u2013_:]?\s*(?:ZU|TO|\u00c0|A|VS|AND|UND|ET|E|Y)?\s*[-/\u2013_]?\s*([XYZ])(?![A-Z])"
)
_ISO = re.compile(r"(?<![A-Z0-9])E_?([CBA])_?[0O]_?([YZ])(?![A-Z0-9])")


def squareness_in(grid: CellGrid) -> tuple[ErrorTable, list[str]] | None:
    """Return the squareness errors of a sheet that holds nothing else, rad, and what it leaves open; None for another sheet.

    Each row has a name (EC0Y, or a pair of axes), a number and a unit, which may be above. The sign of a bare pair is
    never guessed; an angle in degrees near 90 shows it.
    """
    found: dict[str, tuple[float, float]] = {}
    doubts: list[str] = []
    above: dict[int, str] = {}
    for row, line in zip(grid.rows, grid.lines, strict=True):
        numbers = [n for n, cell in enumerate(row) if parse_number(cell) is not None]
        label = " ".join(cell for n, cell in enumerate(row) if n not in numbers).upper()
        if not numbers:
            above |= {
                n: unit for n, cell in enumerate(row) if (unit := known_unit(cell) or split_name(f"v {cell}").unit)
            }
            continue
        called = next((cell for n, cell in enumerate(row) if cell and n not in numbers), "")
        iso = {f"E{a}0{b}" for a, b in _ISO.findall(label)} & set(SQUARENESS_NAMES)
        pairs = {"".join(sorted(pair)) for pair in _PAIR.findall(label)} & set(_PAIRS)
        if len(numbers) != 1 or len(iso) + (0 if iso else len(pairs)) != 1:
            return None
        value = float(parse_number(row[numbers[0]]) or 0.0)
        own = (
            known_unit(cell) or split_name(f"v {cell}").unit for n, cell in enumerate(row) if n not in numbers and cell
        )
        unit = next((name for name in own if name in RAD_PER_ANGLE), above.get(numbers[0], ""))
        if unit not in RAD_PER_ANGLE:
            doubts.append(
                f"line {line}: the file gives no unit of {shown(called)}; write urad, arcsec, um/m or deg next to it"
            )
            continue
        if iso:
            name, rad = iso.pop(), value * RAD_PER_ANGLE[unit]
        else:
            name, sign = _PAIRS[pairs.pop()]
            rad = sign * (value - 90.0) * RAD_PER_ANGLE[unit]
            if unit != "deg" or abs(value - 90.0) > _MOST_DEG:
                meaning = f"{name} > 0: the angle between the positive axes is {'more' if sign > 0 else 'less'} than 90 degrees"
                doubts.append(
                    f"line {line}: the sign of {shown(called)} is not known; write {name} in its place ({meaning})"
                )
                continue
        if name in found:
            raise grid.fail(f"{name} is a single number, but it appears again", line)
        found[name] = (rad, float("nan"))
    return (ErrorTable({}, found, {"source": grid.path.name}), doubts) if found or doubts else None


# Tables of tracer lengths, and of measured positions, in space.


#: The unit of lengths by their geometry must agree with a known one so well (the machine's errors are far smaller).
UNIT_TOLERANCE = 0.03


def lengths_of(findings: TableFindings) -> Lengths:
    """Return tracer lengths; unit and sign are compared with the commanded points."""
    table, fields = findings.table, findings.fields
    position = _positions(findings, "xyz")
    rows = len(table.rows)
    names = table.column(fields["station"].name) if "station" in fields else ["S1"] * rows
    if "station" not in fields:
        findings.notes.append("there is no column of stations: all lengths belong to one, S1")
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
        raise findings.table.grid.fail(
            f"has no column of commanded {missing[0].upper()}; give --map {missing[0]}=COLUMN",
            findings.table.header_line,
        )
    raw = [findings.numbers(key) for key in keys]
    longest = int(np.argmax([np.ptp(values) for values in raw]))
    first = findings.positions_mm(keys[longest], raw[longest])
    factor = MM_PER_LENGTH[str(findings.understood["position_unit"])]
    columns = []
    for k, key in enumerate(keys):  # the other two in their own unit if they have one, else in that of the longest axis
        unit = findings.unit(key, "position") or ""
        columns.append(first if k == longest else raw[k] * MM_PER_LENGTH.get(unit, factor))
    return np.column_stack(columns)


def _length_scale(
    findings: TableFindings, position: FloatArray, reading: FloatArray, station: NDArray[np.int64]
) -> float:
    """Signed mm per unit of the lengths: declared, and compared with the geometry of each station."""
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
        findings.doubts.append(
            "the file gives no unit of the lengths, and the points do not show it; give --unit length=mm"
        )
    elif declared is None:
        findings.notes.append(f"the lengths fit the points in {unit}")
    elif unit is not None and unit != declared:
        findings.doubts.append(f"the lengths say {declared}, but they fit the points in {unit}; give --unit length=...")
    if sign < 0:
        findings.notes.append("the lengths shrink where the distance grows: their sign was turned round")
    if sign == 0:
        findings.notes.append(
            "the points do not tell the sign of the lengths; they are taken to grow with the distance"
        )
    chosen = declared or unit or "mm"
    findings.understood |= {"unit": chosen, "sign": "grows with the distance" if sign >= 0 else "turned round"}
    findings.understood["mm_per_unit_by_geometry"] = ratio
    return MM_PER_LENGTH[chosen] * (-1.0 if sign < 0 else 1.0)


def _numbered(
    findings: TableFindings, names: Sequence[Sequence[str]], position: FloatArray, value: FloatArray, row_data: RowData
) -> dict[str, NDArray[np.int64]]:
    """Return the labels; rows that nothing tells apart are numbered as repeats, or refused if they are a copy.

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
        message = f"{again.size} rows repeat earlier ones to the last digit (this one line {earlier}): take out what is a copy"
        raise findings.table.grid.fail(message, line)
    findings.notes.append(
        f"{again.size} rows repeat a position without a run or repeat: they were numbered as they come"
    )
    if "repeat" in row_data.labels:
        count = count + row_data.labels["repeat"] * (1 + int(count.max()))
    return {**row_data.labels, "repeat": count}


def _keys(names: Sequence[Sequence[str]], position: FloatArray, row_data: RowData) -> FloatArray:
    """Return what tells rows apart, a number for each column (rows, k)."""
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
        findings.understood["sign"] = "corrections, turned round"
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
    """Refuse deviations that no file of the contract may hold; ``deviation_mm`` is (n,) or (n, 3), nan where unknown."""
    size = np.nan_to_num(np.abs(deviation_mm)).reshape(len(deviation_mm), -1).max(axis=1)
    worst = int(np.argmax(size))
    if size[worst] > LARGEST_DEVIATION_UM * MM_PER_UM:
        file, line = origin[worst]
        raise InputError(
            f"a deviation of {size[worst]:.4g} mm is not plausible; is it a slip, or another unit?",
            file=file,
            line=line,
        )


def _measured(findings: TableFindings, key: str, position: FloatArray) -> FloatArray:
    """Measured minus commanded coordinate; unit and sign by the slope of the one over the other."""
    values = findings.numbers(key)
    name, declared = findings.fields[key].name, findings.unit(key)
    scale = MM_PER_LENGTH.get(declared, 1.0) if declared else 1.0
    if np.ptp(position) > 0:
        slope = slope_of(position, values * scale)
        if slope.unit_ratio != 1.0 or slope.sign < 0:
            findings.doubts.append(f"{name!r} follows the command with the slope {slope.slope:.5g}, not 1")
    return values * scale - position


# Which kind of measurement a table is, and the sheets of a workbook put together.


#: So many lines above a table are shown.
_MOST_HEADER = 12


def import_table(grid: CellGrid, options: ImportOptions, form: str = "table") -> Imported:
    """Import one table, or a list of squareness errors; InputError if it is none or lacks what its kind needs."""
    try:
        return _import_table(grid, options, form)
    except InputError:
        found = squareness_in(grid)
        if found is None:
            raise
    errors, doubts = found
    understood = {"squareness_urad": {name: value / RAD_PER_URAD for name, (value, _) in errors.squareness.items()}}
    return Imported(grid.path, form, "errors", errors, understood, tuple(doubts), grid.notes)


def _import_table(grid: CellGrid, options: ImportOptions, form: str) -> Imported:
    table = find_table(grid, options.decimal)
    findings = TableFindings(table, fields_of(table.header, options.columns, options.ignore), options)
    findings.notes.extend(table.grid.notes)
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
    elif kind == "errors" and options.error is None:
        columns = error_columns(table.header)
        if not columns:
            _need(findings, "error", "position", "value")
        else:
            _need(findings, "position")
        data = wide_errors(findings, columns) if columns else long_errors(findings)
        data = data.replace(metadata=metadata_of(findings, row_data_of(findings, "errors")))
    else:
        _need(findings, "position")
        data, reversal, kind = _along_axes(findings)
    return Imported(
        grid.path,
        form,
        kind,
        data,
        findings.understood,
        tuple(dict.fromkeys(findings.doubts)),
        tuple(dict.fromkeys(findings.notes)),
        reversal,
    )


def _along_one_axis(findings: TableFindings) -> None:
    """Take the one coordinate that a table has as position, and its deviation with it: X [mm], dX [um]."""
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
    if "position" in fields:
        return "axis"
    header = ", ".join(findings.table.header)
    raise findings.table.grid.fail(
        f"its columns are not known: {shown(header)}; say what they are: --map position=COLUMN --map deviation=COLUMN (axis "
        "runs), x y z length (lengths), x y z dx dy dz (deviations), error position value (errors)",
        findings.table.header_line,
    )


def _need(findings: TableFindings, *keys: str) -> None:
    for key in keys:
        if key not in findings.fields:
            header = ", ".join(findings.table.header)
            raise findings.table.grid.fail(
                f"no column is known as {key}; the header has {shown(header)}; give --map {key}=COLUMN",
                findings.table.header_line,
            )


def _along_axes(findings: TableFindings) -> tuple[Data, ReversalCurves | None, Kind]:
    error = findings.options.error
    angular = error is not None and error[1:2] in ("A", "B", "C")
    found, row_data = axis_readings(findings, angular=angular)
    metadata = metadata_of(findings, row_data)
    path = findings.table.grid.path
    if error is not None:
        if len(found) > 1:
            raise InputError("holds several axes; --error names the error of one", file=path)
        ((letter, runs),) = found.items()
        check_error(error, letter or None, angular=angular)
        findings.understood |= _described(runs, 1e-6 if angular else MM_PER_UM)
        findings.doubts[:] = [text for text in findings.doubts if "--axis" not in text]
        table, reversal = errors_of(runs, error, metadata)
        return table, reversal, "errors"
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
    """Return the readings of all axes as one object; an axis that is not known counts as X until the user has said it."""
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
    doubts = [f"sheet {name}: {text}" for name, item in parts for text in item.doubts]
    errors = [item.data for _, item in parts if isinstance(item.data, ErrorTable)]
    beside = None
    if kinds == {"axis"} or kinds == {"axis", "errors"}:
        read = [item.data for _, item in parts if isinstance(item.data, AxisRuns)]
        # with the covariates that all sheets have
        common = set.intersection(*(set(part.covariates) for part in read))
        kept = [replace(r, covariates={k: v for k, v in r.covariates.items() if k in common}) for r in read]
        runs = replace(join_axis_runs(kept), metadata=read[0].metadata)
        data: Data = runs
        beside = _joined_errors(first, errors) if errors else None
        for axis in runs.axes:
            name, rows = POSITIONING[axis], runs.axis == axis
            if beside is not None and name in beside.curves:
                mean, _, _ = two_way_mean(runs.position_mm[rows], runs.direction[rows], runs.deviation_mm[rows])
                away = float(np.abs(mean.value - beside.curves[name].at(mean.position_mm)).max()) / MM_PER_UM
                doubts.append(
                    f"a sheet holds {name}, and the runs of {AXES[axis]} give it as well (their means differ by up to "
                    f"{away:.3g} um); leave out one sheet with --ignore SHEET"
                )
    elif kinds == {"errors"}:
        data = _joined_errors(first, errors)
    else:
        raise InputError(f"has several tables ({names}); choose one with --sheet", file=first.path)
    understood = {f"sheet {name}": dict(item.understood) for name, item in parts}
    notes = tuple(dict.fromkeys(text for _, item in parts for text in item.notes))
    kind: Kind = "errors" if kinds == {"errors"} else "axis"
    return replace(first, kind=kind, data=data, understood=understood, doubts=tuple(doubts), notes=notes, beside=beside)


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
    return ErrorTable(curves, squareness, parts[0].metadata)
