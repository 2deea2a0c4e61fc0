"""Tables of geometric errors: a row for each value, a column for each error, or a list of squareness errors."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from compgen.data.error_table import LARGEST_RAD, Curve, ErrorTable
from compgen.data.names import CURVE_NAMES, ERROR_INDEX, ERROR_NAMES, RAD_PER_URAD, SQUARENESS_NAMES, error_named
from compgen.errors import InputError, nearest
from compgen.foreign.answers import ImportOptions
from compgen.foreign.cells import SQUARENESS_WORDS, CellGrid, plain_decimals
from compgen.foreign.column_names import (
    FIELDS,
    MM_PER_LENGTH,
    RAD_PER_ANGLE,
    NamedColumn,
    is_index,
    known_unit,
    quantity_of,
    split_name,
    unaccented,
)
from compgen.foreign.findings import USUAL_URAD, Imported, TableFindings, usual_deviation_mm
from compgen.foreign.questions import Asking, Choice, signs
from compgen.foreign.source import parse_number, shown


def wide_errors(findings: TableFindings, columns: Mapping[str, NamedColumn]) -> ErrorTable:
    """Return errors with a column each; those of one axis share the column of positions."""
    axes = {error_named(name).axis for name in columns if name not in SQUARENESS_NAMES}
    if len(axes) > 1 and "axis" not in findings.fields:
        findings.ask("errors of several axes share one column of positions: give one table for each axis")
    position = findings.positions_mm("position", findings.numbers("position"))
    order = np.argsort(position, kind="stable")
    if np.any(np.diff(position[order]) == 0):
        raise findings.table.grid.fail("a position appears twice", findings.table.header_line)
    curves, squareness = {}, {}
    for name, column in columns.items():
        findings.used.add(column.name)
        values = np.array(findings.table.numbers(column.name, empty=True))
        known = np.flatnonzero(np.isfinite(values[order]))
        si = si_values(findings, name, column, values[order][known], float(np.ptp(position)))
        if name in SQUARENESS_NAMES:
            if np.ptp(si) > 0:
                raise findings.table.grid.fail(f"{name} is a single number, but there are several", None, column.name)
            squareness[name] = (float(si[0]), float("nan"))
        else:
            curves[name] = Curve(position[order][known], si, np.full(len(known), np.nan))
    return _finished(findings, curves, squareness)


def long_errors(findings: TableFindings) -> ErrorTable:
    """Return errors with a row for each value: name, position, value."""
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
        si = si_values(
            findings, name, findings.fields["value"], values[rows], float(np.ptp(span)) if span.size else 0.0
        )
        u_si = np.full(len(rows), np.nan)
        if u_column is not None:  # in its unit, otherwise in that of the values
            u = np.array(table.numbers(u_column.name, empty=True))[rows]
            if np.any(u < 0):
                line = table.lines[int(rows[np.flatnonzero(u < 0)[0]])]
                raise table.grid.fail("expected a standard uncertainty of zero or more", line, u_column.name)
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


def si_values(
    findings: TableFindings, name: str, column: NamedColumn, values: np.ndarray, span_mm: float
) -> np.ndarray:
    """Values of one error in mm or rad; an angle unit such as um/m is allowed for squareness only."""
    if not len(values):
        raise findings.table.grid.fail("contains no value", findings.table.header_line, column.name)
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
        "sign": "errors" if sign > 0 else "corrections, sign reversed",
    }
    words = " ".join([*findings.table.header, *findings.table.metadata, *findings.table.metadata.values()]).lower()
    if findings.options.sign is None and any(word in words for word in ("correct", "compensat", "korrektur")):
        findings.ask("the file mentions corrections", "sign", signs(), "give --sign error or correction")
    turned = {name: Curve(curve.position_mm, sign * curve.value, curve.u) for name, curve in curves.items()}
    constants = {name: (sign * value, u) for name, (value, u) in squareness.items()}
    return ErrorTable(turned, constants, {"source": findings.table.grid.path.name})


#: Positions of readings that are taken step by step differ from the length of the base by less, mm.
_STEP_MM = 0.1


def summed_steps(findings: TableFindings, steps: ErrorTable, base_mm: float) -> ErrorTable:
    """Return the straightness from its differences over the base of a level or of an autocollimator's mirror, step by step.

    The difference at a position is that from there to the position plus ``base_mm``; the first value is zero. The
    uncertainties of the steps are independent.

    Raises
    ------
    InputError
        for positions that are not one base apart.
    """
    ((name, curve),) = steps.curves.items()
    away = np.abs(np.diff(curve.position_mm) - base_mm)
    if away.max(initial=0.0) > _STEP_MM:
        at = curve.position_mm[int(np.argmax(away))]
        text = f"the step from {at:g} mm on is not the base length of {base_mm:g} mm: a sum needs every step"
        raise findings.table.grid.fail(text, findings.table.header_line)
    findings.understood["base_length_mm"] = base_mm
    findings.notes.append(f"{name} is the sum of its differences over {base_mm:g} mm, each from its position on")
    at_mm = np.append(curve.position_mm, curve.position_mm[-1] + base_mm)
    u = np.sqrt(np.cumsum(np.concatenate([[0.0], curve.u**2])))
    return ErrorTable({name: Curve(at_mm, np.concatenate([[0.0], np.cumsum(curve.value)]), u)}, {})


# Lists of squareness errors: a row for each, by its name in ISO 230-1 or by a pair of axes.


#: Names of squareness in sheets of laboratories: the pair of axes, the error of ISO 230-1, and its sign for an angle
#: above 90 degrees between the positive axes.
_PAIRS = {"XY": ("EC0Y", 1.0), "XZ": ("EB0Z", -1.0), "YZ": ("EA0Z", 1.0)}
_ABOVE_90 = dict(_PAIRS.values())
_AXIS_WORD = r"(?:[\s\-]?(?:AXIS|ACHSE|AXE|ASSE|EJE))?"
_BETWEEN = r"(?:WITH RESPECT TO|RELATIVE TO|ZU|TO|\u00c0|A|VS|AND|UND|ET|E|GEGEN|(?<=\s)Y(?=\s))"
_PAIR = re.compile(
    rf"(?<![A-Z])([XYZ]){_AXIS_WORD}[\s\-/\u2013_:\u22a5\u27c2]*+(?:{_BETWEEN}[\s\-/\u2013_]*+)?([XYZ])(?![A-Z]){_AXIS_WORD}"
)
#: EC0Y, E_C0Y, C0Y; a rotation of X (EC0X) has another sign: it is refused.
_ISO = re.compile(r"(?<![A-Z0-9])(?:E_?([CBA])_?[0O]|([CBA])_?0)_?([XYZ])(?![A-Z0-9])")
#: What a column beside the value contains, by its name without accents: uncertainty, or the length of the deviation.
_BESIDE = {
    "k": re.compile(r"^k$"),
    "u": re.compile(r"(^|[^a-z])u([^a-z/]|$)|uncert|unsicher|incert"),
    "length": re.compile(r"length|lange|laenge|(^|\W)over(\W|$)|uber|ueber|longueur|lungh|longitud"),
}
_COVERAGE = re.compile(r"(?i)k\s*=\s*(\d+(?:[.,]\d+)?)")
_NUMBER = r"[+\-\u2212]?(?:\d++(?:[.,]\d*+)?|[.,]\d++)(?:[eE][+\-]?\d++)?"
#: Value, unit; length, unit; uncertainty; unit: ``12 ± 3 µrad``, ``0,02/300``, ``9 µm / 300 mm``, ``90.001°``.
_CELL = re.compile(
    rf"({_NUMBER})\s*+([^\d\s/\u00b1+\-.,]++(?:/m)?)?(?:\s*+/\s*+({_NUMBER})\s*+([^\d\s\u00b1+\-.,]++)?)?"
    rf"(?:\s*+(?:\u00b1|\+/?-)\s*+({_NUMBER}))?\s*+([^\d]*+)"
)
#: An angle between two axes differs from 90 degrees by less.
_MOST_DEG = 0.5
#: Name of a column with a standard uncertainty.
_STANDARD = re.compile(r"(?i:standard)|(?m:^u(?![a-zA-Z]))")
_EXPECTED = {
    "unit": "write urad, arcsec, um/m or deg next to it",
    "coverage factor k": "write it above the column: U (k=2), or u for a standard uncertainty",
}
#: A longer table is not a list of squareness errors.
_MOST_ROWS = 200
_PAGE = "docs/instruments.md, Sign of squareness"


@dataclass(frozen=True)
class Angle:
    """A cell as written: number, uncertainty, the length in mm that divides it (both nan if there is none), and unit."""

    value: float
    u: float
    length_mm: float
    unit: str


def angle_in(cell: str) -> Angle | None:
    """Return the number, unit and uncertainty of a cell; None if it is not a number with nothing but these.

    >>> angle_in("12 \u00b1 3 \u00b5rad"), angle_in("0,03 mm/300 mm").length_mm, angle_in("XY 12"), angle_in("12 kg")
    (Angle(value=12.0, u=3.0, length_mm=nan, unit='urad'), 300.0, None, None)
    """
    found = _CELL.fullmatch(cell.strip())
    if found is None:
        return None
    value, u, length = (parse_number(found[k]) if found[k] else float("nan") for k in (1, 5, 3))
    unit = known_unit(f"{found[2] or ''}{found[6]}") if found[2] or found[6] else ""
    over = MM_PER_LENGTH.get(known_unit(found[4]) or "") if found[4] else 1.0
    if value is None or u is None or length is None or unit is None or over is None or (found[4] and not unit):
        return None
    return Angle(value, u, length * over, "mm" if found[3] and not unit else unit)


def squareness_in(grid: CellGrid, options: ImportOptions, form: str) -> Imported | None:
    """Return the squareness errors of a table that contains only these, and what it leaves open; None for another table.

    Each row has a name (EC0Y, or a pair of axes), a number and a unit, which may be above; its uncertainty, and the length
    over which a deviation was read, may be beside it. The sign of a bare pair is never guessed: ``--sign`` gives it, or an
    angle near 90 degrees shows it.

    Raises
    ------
    InputError
        with the line, for another name, a pair that occurs twice, and numbers that are not understood.
    """
    cells = {cell for row in grid.rows[:_MOST_ROWS] for cell in row}
    other = any(cell.upper() in CURVE_NAMES or split_name(cell).word in FIELDS["position"] for cell in cells)
    if other or len(grid.rows) > _MOST_ROWS:
        return None
    named = SQUARENESS_WORDS.search(" ".join([*grid.notes[:1], *cells])) is not None
    # numbers with their units in one cell hide the separator: the cells were split at blanks
    whole = [" ".join(row).split(";") if any(";" in cell for cell in row) else row for row in grid.rows]
    try:
        rows, _ = plain_decimals([[cell.strip() for cell in row] for row in whole], grid.lines, options.decimal)
    except InputError as error:
        if named:
            raise grid.fail(error.message, error.line) from error
        return None
    reader = SquarenessRows(grid, options)
    for row, line in zip(rows, grid.lines, strict=True):
        angles = {n: angle for n, cell in enumerate(row) if (angle := angle_in(cell)) is not None}
        for n, cell in enumerate(row):
            if cell and not angles:
                reader.above.setdefault(n, []).append(cell)
        whole_name = any(pattern.fullmatch(cell.upper()) for cell in row for pattern in (_ISO, _PAIR))
        digits = re.search(r"\d", _ISO.sub("", " ".join(row).upper())) is not None
        if not angles and reader.name_of(row, {})[0] and (whole_name or digits):
            raise grid.fail(
                f"the number beside {shown(row[0])} is not understood; expected one such as 12 or 12 urad", line
            )
        if angles and quantity_of(split_name(row[0]).word) and reader.name_of(row, angles)[0] is None:
            continue  # a temperature, or when it was measured
        if angles and not named and reader.name_of(row, angles)[0] is None:
            return None
        if angles:
            reader.take(row, line, angles)
    return reader.result(form) if reader.found else None


@dataclass
class SquarenessRows(Asking):
    """Reads one row after the other; ``above`` contains the cells above each column, ``asked`` whose signs are open."""

    grid: CellGrid
    options: ImportOptions
    above: dict[int, list[str]] = field(default_factory=dict)
    found: dict[str, tuple[float, float]] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)

    def result(self, form: str) -> Imported:
        """Return all rows as errors, with what is open."""
        if self.asked:
            self.ask(
                "; ".join(self.asked),
                "sign",
                (
                    Choice("angle-above-90", "positive: the angle between the positive axes is above 90°"),
                    Choice("angle-below-90", "positive: the angle between the positive axes is below 90°"),
                    Choice("rotation", "the numbers are EC0Y, EB0Z, EA0Z of ISO 230-1"),
                ),
                "write EC0Y, EB0Z, EA0Z in place of pairs; or answer for all pairs: --sign angle-above-90 (positive: the angle "
                "between the positive axes is above 90 "
                f"degrees), angle-below-90, or rotation (the numbers are EC0Y, EB0Z, EA0Z of ISO 230-1); {_PAGE} explains them",
                picture="squareness",
            )
        understood = {
            "squareness_urad": {name: value / RAD_PER_URAD for name, (value, _) in self.found.items()},
            "u_urad": {name: u / RAD_PER_URAD for name, (_, u) in self.found.items() if np.isfinite(u)},
            "sign_of_squareness": self.options.sign
            or "as named: EC0Y, EB0Z, EA0Z of ISO 230-1; angles near 90 degrees",
        }
        errors = ErrorTable({}, self.found, {"source": self.grid.path.name})
        return Imported(self.grid.path, form, "errors", errors, understood, tuple(self.questions), self.grid.notes)

    def name_of(self, row: Sequence[str], angles: Mapping[int, Angle]) -> tuple[str | None, bool]:
        """Return the error that the words of a row name, and whether by its name in ISO 230-1; None if none or several."""
        label = " ".join(cell for n, cell in enumerate(row) if n not in angles).upper()
        iso = {f"E{a or b}0{c}" for a, b, c in _ISO.findall(label)}
        pairs = {"".join(sorted(pair)) for pair in _PAIR.findall(_ISO.sub(" ", label))} & set(_PAIRS)
        if iso:
            agree = len(iso) == 1 and iso <= set(SQUARENESS_NAMES) and {_PAIRS[pair][0] for pair in pairs} <= iso
            return (iso.pop() if agree else None), True
        return (_PAIRS[pairs.pop()][0] if len(pairs) == 1 else None), False

    def take(self, row: Sequence[str], line: int, angles: Mapping[int, Angle]) -> None:
        """Add the squareness of a row, or what is open about it."""
        called = shown(next((cell for n, cell in enumerate(row) if cell and n not in angles), ""))
        name, by_name = self.name_of(row, angles)
        if name is None:
            raise self.grid.fail(
                f"{called} is not a pair of axes; expected a row for each of EC0Y (Y to X), EB0Z (Z to X), EA0Z (Z to Y), or XY, "
                f"XZ, YZ; a rotation of X, EC0X, is -EC0Y ({_PAGE})",
                line,
            )
        if name in self.found:
            raise self.grid.fail(f"{name} is a single number, but it appears again", line)
        value, u, missing = self.number(row, line, angles)
        if missing:
            self.ask(f"line {line}: the file states no {missing} of {called}", how=_EXPECTED[missing])
            value, u = 0.0, float("nan")
        elif abs(value - np.pi / 2) < np.radians(_MOST_DEG):  # the angle itself
            value = _ABOVE_90[name] * (value - np.pi / 2)
        elif abs(value) > LARGEST_RAD:
            raise self.grid.fail(f"{value:.4g} rad is too large to be an error of a machine; check the unit", line)
        else:
            value *= self.sign(name, line, called, by_name=by_name)
        self.found[name] = (value, u)

    def sign(self, name: str, line: int, called: str, *, by_name: bool) -> float:
        """Return the sign that makes a number the error ``name``; a question if neither name nor user gives it."""
        above = _ABOVE_90[name]
        given = {"angle-above-90": above, "angle-below-90": -above, "rotation": 1.0}
        if by_name:
            given |= {"correction": -1.0}
        elif self.options.sign not in given:
            side = "more" if above > 0 else "less"
            self.asked.append(
                f"line {line}: the sign of {called} is not clear ({name} > 0: the angle between the positive axes is {side} "
                "than 90 degrees)"
            )
        return given.get(self.options.sign or "", 1.0)

    def columns(self, line: int, angles: Mapping[int, Angle]) -> dict[str, int]:
        """Return which number of a row is the value, its uncertainty ("u"), and the length of a deviation."""
        kinds: dict[str, int] = {}
        for n in angles:
            words = [cell for cell in self.above.get(n, []) if known_unit(cell.strip("[]() ")) is None]
            name = words[-1] if words else ""
            kind = next((key for key, pattern in _BESIDE.items() if pattern.search(unaccented(name))), "value")
            if is_index(name):
                continue
            if kind in kinds:
                raise self.grid.fail(
                    "contains several numbers; expected one value in a row, beside it the length over which it was read or its "
                    "uncertainty, with these names above the columns: Length [mm], U (k=2) [urad]",
                    line,
                )
            kinds[kind] = n
        if "value" not in kinds:
            raise self.grid.fail("contains no value; expected one beside uncertainty and length", line)
        return kinds

    def number(self, row: Sequence[str], line: int, angles: Mapping[int, Angle]) -> tuple[float, float, str]:
        """Return value and standard uncertainty of a row in rad (nan: not given), and what is missing."""
        kinds = self.columns(line, angles)
        n = kinds["value"]
        cell, length_mm = angles[n], angles[n].length_mm
        if "length" in kinds:
            at = kinds["length"]
            length_mm = angles[at].value * MM_PER_LENGTH.get(self.unit(row, at, angles, MM_PER_LENGTH), float("nan"))
            if not length_mm > 0:
                raise self.grid.fail("the length has no unit, or is not above zero; write Length [mm] above it", line)
        over = np.isfinite(length_mm)
        units = MM_PER_LENGTH if over else RAD_PER_ANGLE
        others = [word for k, word in enumerate(row) if k not in angles]
        if not over:  # the title of the sheet or the name of the first column: Squareness [urad]
            others += [word for k, words in self.above.items() if k not in angles for word in words]
        unit = self.unit(row, n, angles, units, *others)
        if not unit:
            return 0.0, float("nan"), "unit"
        scale = units[unit] / (length_mm if over else 1.0)
        expanded, named = cell.u, ""
        if "u" in kinds:
            at = kinds["u"]
            own = self.unit(row, at, angles, units) or unit
            expanded, named = angles[at].value * units[own] / units[unit], "\n".join(self.above[at])
        if not np.isfinite(expanded):
            return cell.value * scale, float("nan"), ""
        factor = _COVERAGE.search("\n".join([named, *row, *(word for words in self.above.values() for word in words)]))
        k = (
            1.0
            if factor is None and _STANDARD.search(named)
            else float(parse_number(factor[1]) or 0.0)
            if factor
            else 0.0
        )
        k = angles[kinds["k"]].value if "k" in kinds else k
        if k <= 0:
            return 0.0, float("nan"), "coverage factor k"
        return cell.value * scale, abs(expanded) * scale / k, ""

    def unit(
        self, row: Sequence[str], n: int, angles: Mapping[int, Angle], units: Mapping[str, float], *others: str
    ) -> str:
        """Return the unit of a number: by option, in its cell, behind it, above it, or in ``others``; "" if nowhere."""
        words = [row[n + 1] if n + 1 < len(row) and n + 1 not in angles else "", *self.above.get(n, [])[::-1], *others]
        stated = [angles[n].unit, *(known_unit(word) or split_name(f"v {word}").unit or "" for word in words if word)]
        given = self.options.given_unit("angle") if units is RAD_PER_ANGLE else None
        return given or next((unit for unit in stated if unit in units), "")
