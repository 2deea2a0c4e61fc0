"""Tables of geometric errors: a row for each value, or a column for each error over the position of one axis."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.names import ERROR_INDEX, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.core.text import nearest
from compgen.imports.columns import MM_PER_LENGTH, RAD_PER_ANGLE, Column, known_unit, split_name
from compgen.imports.findings import Findings
from compgen.imports.grid import Grid
from compgen.imports.hypotheses import USUAL_URAD, usual_deviation_mm
from compgen.imports.source import parse_number, shown

#: An angle between two axes differs from 90 degrees by less.
_MOST_DEG = 0.5


def wide_errors(findings: Findings, columns: Mapping[str, Column]) -> ErrorTable:
    """Return errors that have a column each; those of one axis share the column of positions."""
    axes = {error_named(name).axis for name in columns if name not in SQUARENESS_NAMES}
    if len(axes) > 1 and "axis" not in findings.fields:
        findings.doubts.append("errors of several axes share one column of positions; give one table for each axis")
    position = findings.positions_mm("position", findings.numbers("position"))
    order = np.argsort(position, kind="stable")
    if np.any(np.diff(position[order]) == 0):
        raise findings.table.grid.fail("a position stands here twice", findings.table.header_line)
    curves, squareness = {}, {}
    for name, column in columns.items():
        findings.used.add(column.name)
        values = np.array(findings.table.numbers(column.name, empty=True))
        known = np.flatnonzero(np.isfinite(values[order]))
        si = _si(findings, name, column, values[order][known], float(np.ptp(position)))
        if name in SQUARENESS_NAMES:
            if np.ptp(si) > 0:
                raise findings.table.grid.fail(f"{name} is one number, several stand here", None, column.name)
            squareness[name] = (float(si[0]), float("nan"))
        else:
            curves[name] = Curve(position[order][known], si, np.full(len(known), np.nan))
    return _finished(findings, curves, squareness)


def long_errors(findings: Findings) -> ErrorTable:
    """Return errors that have a row for each value: name, position, value."""
    table = findings.table
    names = [cell.strip().upper() for cell in table.column(findings.fields["error"].name)]
    for name, line in zip(names, table.lines, strict=True):
        if name not in ERROR_INDEX:
            message = f"{shown(name)} is no error of ISO 230-1; {nearest(name, ERROR_NAMES)}"
            raise table.grid.fail(message, line, findings.fields["error"].name)
    values = findings.numbers("value")
    raw = np.array(table.numbers(findings.fields["position"].name, empty=True))
    span = raw[np.isfinite(raw)]
    position = np.full(len(raw), np.nan)
    if span.size:
        position[np.isfinite(raw)] = findings.positions_mm("position", span)
    curves, squareness = {}, {}
    for name in dict.fromkeys(names):
        rows = np.flatnonzero(np.array(names) == name)
        si = _si(findings, name, findings.fields["value"], values[rows], float(np.ptp(span)) if span.size else 0.0)
        u_si = _u_si(findings, name, rows, values[rows], si)
        if name in SQUARENESS_NAMES:
            if len(rows) > 1:
                raise table.grid.fail(f"{name} is one number, it stands here again", table.lines[int(rows[1])])
            squareness[name] = (float(si[0]), float(u_si[0]))
            continue
        order = np.argsort(position[rows])
        at = position[rows][order]
        if not np.all(np.isfinite(at)) or np.any(np.diff(at) == 0):
            raise table.grid.fail(f"{name} has a position that is empty or stands twice", table.lines[int(rows[0])])
        curves[name] = Curve(at, si[order], u_si[order])
    return _finished(findings, curves, squareness)


def _u_si(findings: Findings, name: str, rows: np.ndarray, values: np.ndarray, si: np.ndarray) -> FloatArray:
    """Standard uncertainties of rows in mm or rad, nan where none stands; in their own unit, else in that of the values."""
    if "u_value" not in findings.fields:
        return np.full(len(rows), np.nan)
    column = findings.fields["u_value"]
    u = np.array(findings.table.numbers(column.name, empty=True))[rows]
    if np.any(u < 0):
        line = findings.table.lines[int(rows[np.flatnonzero(u < 0)[0]])]
        raise findings.table.grid.fail("a standard uncertainty is not negative", line, column.name)
    units = RAD_PER_ANGLE if error_named(name).kind != "linear" else MM_PER_LENGTH
    unit = findings.given_unit("u_value") or column.unit
    largest = int(np.argmax(np.abs(values)))
    common = si[largest] / values[largest] if values[largest] else float("nan")
    return np.asarray(u * units.get(unit or "", common), dtype=np.float64)


def _si(findings: Findings, name: str, column: Column, values: np.ndarray, span_mm: float) -> np.ndarray:
    """Values of one error in mm or rad; a length may have an angle's unit (um/m) for squareness only."""
    if not len(values):
        raise findings.table.grid.fail("holds no value", findings.table.header_line, column.name)
    angular = error_named(name).kind != "linear"
    key = "value"
    findings.fields = {**findings.fields, key: column}
    units = RAD_PER_ANGLE if angular else MM_PER_LENGTH
    declared = findings.given_unit("angle" if angular else "linear") or column.unit
    if declared in units:
        findings.understood[f"unit_{'angle' if angular else 'length'}"] = declared
        return values * units[declared]
    findings.fields = {**findings.fields, key: Column(column.name, column.word, None)}
    usual = USUAL_URAD * 1e-6 if angular else usual_deviation_mm(span_mm)
    return findings.values_si(key, column.name, values, usual, angular=angular)


def _finished(findings: Findings, curves: dict[str, Curve], squareness: dict[str, tuple[float, float]]) -> ErrorTable:
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


def squareness_in(grid: Grid) -> tuple[ErrorTable, list[str]] | None:
    """Return the squareness errors of a sheet that holds nothing else, rad, and what it leaves open; None for another sheet.

    Each row has a name (EC0Y, or a pair of axes), a number and a unit, which may stand above. The sign of a bare pair is
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
                f"line {line}: no unit of {shown(called)} stands in the file; write urad, arcsec, um/m or deg beside it"
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
            raise grid.fail(f"{name} is one number, it stands here again", line)
        found[name] = (rad, float("nan"))
    return (ErrorTable({}, found, {"source": grid.path.name}), doubts) if found or doubts else None
