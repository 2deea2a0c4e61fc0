"""Reports with nominal and measured coordinates of features: prints of measuring machines, probe logs, DMIS, QIF.

Every form becomes a list of :class:`Feature`; :func:`imported_features` makes a part or an artefact of them, and asks what such a
report does not state: who measured (the signs are opposite), where the zero was in the machine, whether the nominal places are
calibrated, and what was one set-up. Nothing of this is guessed.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact, Part, join_artefacts
from compgen.data.files import read_bytes
from compgen.data.names import AXES
from compgen.errors import InputError
from compgen.foreign.answers import ImportOptions
from compgen.foreign.cells import CellGrid, plain_decimals
from compgen.foreign.column_names import MM_PER_LENGTH, is_index, known_unit, split_name, unaccented
from compgen.foreign.findings import Imported, unit_of_positions
from compgen.foreign.questions import Asking, Choice, choices_of
from compgen.foreign.source import Text, parse_number, shown

_NOMINAL, _ACTUAL, _DEVIATION = "nominal", "actual", "deviation"
#: Words for the three numbers of a coordinate, without accents.
_ROLES = {
    _NOMINAL: """nom nominal nominell nominel nominale theo theor theoretical theoretisch theorique soll sollwert sollmass
    setpoint target cad ref reference teorico consigne cal calibrated kal kalibriert kalibrierwert certified nennwert nennmass
    zielwert""",
    _ACTUAL: """act actual ist istwert istmass meas measured measure messwert gemessen mesure mesuree misurato misurata medido
    medida reel effettivo found""",
    _DEVIATION: """dev deviation abw abweichung diff difference differenz error err fehler delta ecart scarto desviacion
    deviazione""",
}
_ROLE = {word: role for role, words in _ROLES.items() for word in words.split()}
_CALIBRATED = frozenset(["cal", "calibrated", "kal", "kalibriert", "kalibrierwert", "certified"])
#: Words in names of coordinates that say nothing more.
_BESIDE = frozenset(
    """coordinate coordinates coord koordinate koordinaten koord pos position value wert center centre mitte mittelpunkt of in
    axis achse axe asse machine maschine""".split()  # noqa: SIM905
)
_FEATURE = frozenset(
    """feature features merkmal element messelement name label kugel ball sphere bohrung bohrungen hole bore circle kreis punkt
    point pointname id featurename characteristic prufmerkmal bezeichnung featureid item elementname no nr number nummer pt
    bauteilmerkmal loch zapfen boss caracteristique elemento caratteristica identifier target""".split()  # noqa: SIM905
)
_SETUP = frozenset(
    """setup setupno aufspannung spannung clamping lage pose fixture fixturing aufspannnr aufspannungnr orientation bridage
    serrage montage piazzamento""".split()  # noqa: SIM905
)
_AXIS_WORDS = frozenset(["ax", "axis", "achse", "axe", "asse", "coord", "koord"])
#: Columns of such reports that say nothing about the position.
_OTHER = re.compile(
    r"tol|toler|outtol|usl|lsl|limit|grenz|oberes?|unteres?|upper|lower|max|min|status|result|ergebnis|bewertung|pass|bonus|trend|"
    r"diam|durchmesser|radius|form|round|rund|zylind|unit|einheit|type|typ|date|time|datum|zeit|remark|comment|bemerkung|"
    r"position|tp|true|vector|normal|ijk"
)
_ANY_ROLE = "|".join(sorted(_ROLE, key=len, reverse=True))
_GLUED = re.compile(rf"({_ANY_ROLE})([xyz])|([xyz])({_ANY_ROLE})")
_NUMBER = r"([-+]?\d++(?:[.,]\d++)?+)"
#: A work offset or origin above a table: G54 X175 Y-325 Z-320.
_OFFSET = re.compile(
    rf"(?i)(G5[4-9](?:\.\d{{1,2}})?+(?:\s{{0,3}}P\d{{1,3}})?+|G5\d\d|work\s{{0,3}}offset|origin|ursprung|nullpunkt\w{{0,20}}+|"
    rf"datum\s{{0,3}}shift|zero\s{{0,3}}point)\b.{{0,80}}?"
    rf"X\s{{0,9}}[=:]?\s{{0,9}}{_NUMBER}[\s;,]{{1,9}}Y\s{{0,9}}[=:]?\s{{0,9}}{_NUMBER}[\s;,]{{1,9}}Z\s{{0,9}}[=:]?\s{{0,9}}{_NUMBER}"
)
_SETUP_LINE = re.compile(
    r"(?i)^[\W_]*+(?:set-?\s?up|aufspannung|spannlage|lage|clamping|pose|fixture|montage)\W*+(?:n[or]\b\W*+)?+(\d{1,3})\b"
)
_UNITS_LINE = re.compile(
    r"(?i)\b(?:units?|einheit(?:en)?|unites?|unita)(?:\s*+[=:/])?+\s*+\"?(mm|millimet\w*+|in(?:ch(?:es)?)?|um|\u00b5m)\b"
    r"|\bin (mm|inch(?:es)?)\b"
)
_LOCATION = re.compile(r"(?i)(?:location|position|lage)\s+(?:of|von)\s+\w+\s+([^\s,]+)")
_DIMENSION = re.compile(r"(?i)^\W*dim(?:ension)?\s+([^\s=,]+)\s*=?")
#: A number with decimals in a line of words: whole numbers count features, cycles and tolerance classes there.
_IN_WORDS = re.compile(r"(?<![\w.,])[-+]?\d{1,7}+[.,]\d{1,9}+(?![\w.,]*\d)")
#: What begins the name of a number in a line of words, and the results of HEIDENHAIN's measuring cycles (421 and its like).
_PHRASE = re.compile(r"(?i)\b(?:soll|ist|nom|act|meas|dev|diff|abw|q\d{2,3}\b)")
_Q_RESULTS = {"q151": "Ist X", "q152": "Ist Y", "q161": "Abw X", "q162": "Abw Y", "q273": "Soll X", "q274": "Soll Y"}
_Q = re.compile(r"(?i)\bq\d{2,3}\b")
#: A log in words has at least this many features, and numbers in each line; shares of its lines have the same names.
_LEAST_LINES, _LEAST_NUMBERS, _ALIKE = 3, 3, 0.5
#: Nominal and measured coordinates of one frame that are further apart are not those of one feature, mm.
MOST_APART_MM = 20.0
#: A feature is data only if it has this many neighbours.
LEAST_FEATURES = 3


def grid_of_phrases(source: Text) -> CellGrid | None:
    """Return a log in words as a table, of lines ``H1: Sollwert X 50.000 Istwert X 50.002``; None for anything else.

    A name without an axis is of the axis named before it; Q151, Q152, Q161, Q162 and Q273, Q274 are results and nominal values
    of HEIDENHAIN's cycles, in the plane XY.
    """
    found = [(number, _phrases(line)) for number, line in enumerate(source.text.split("\n"), start=1)]
    named = Counter(tuple(cells) for _, (_, cells) in found if len(cells) >= _LEAST_NUMBERS)
    if not named:
        return None
    ((names, count),) = named.most_common(1)
    lines = sum(bool(line.strip()) for line in source.text.split("\n"))
    roles = {word for name in names for word in _PHRASE.findall(name.lower())}
    if count < max(_LEAST_LINES, _ALIKE * lines) or len(roles) < 2:
        return None
    others = [number for number, (_, cells) in found if cells and tuple(cells) != names]
    if others:
        raise source.fail(
            f"does not name the same numbers as the other lines, each with its number: {', '.join(names)}", others[0]
        )
    rows = [(number, [feature, *cells.values()]) for number, (feature, cells) in found if tuple(cells) == names]
    note = f"each line names its numbers: {', '.join(names)}"
    if _Q.search(source.text):
        note += "; results of cycles (Q151 ...) were read as those of the plane XY"
    return CellGrid(
        source.path, [["Feature", *names], *(row for _, row in rows)], [rows[0][0], *(n for n, _ in rows)], (note,)
    )


def _phrases(line: str) -> tuple[str, dict[str, str]]:
    """Return the feature that a line of words begins with, and its numbers by their names."""
    feature, cells, end, axis = "", dict[str, str](), 0, ""
    for number in _IN_WORDS.finditer(line):
        words = line[end : number.start()].strip(" \t=:;,|()")
        end = number.end()
        begin = _PHRASE.search(words)
        if begin is None:
            return "", {}
        named = [word.lower() for word in _PHRASE.findall(words)]
        of_cycles = sum(word.startswith("q") for word in named)
        if of_cycles > 1 or len(named) - of_cycles > 1:
            return "", {"": words}  # a name whose number is missing: the next one is not its own
        if not cells:
            feature = words[: begin.start()].strip(" \t=:;,|-")
        q = _Q.search(words)
        name = _Q_RESULTS.get(q[0].lower(), q[0]) if q else " ".join(words[begin.start() :].split())
        letters = re.findall(r"\b[XYZxyz]\b", name)
        axis = letters[-1].upper() if letters else axis
        cells.setdefault(name if letters or not axis else f"{name} {axis}", number[0])
    return feature, cells


def names_setting(line: str) -> bool:
    """Whether a line states a zero, a set-up or the unit of what follows."""
    return any(pattern.search(line) for pattern in (_OFFSET, _SETUP_LINE, _UNITS_LINE))


@dataclass(frozen=True)
class Feature:
    """One feature of a report: coordinates in mm, nan for those that it does not give."""

    name: str
    nominal_mm: FloatArray
    actual_mm: FloatArray
    block: int
    line: int
    setup: int | None = None
    origin_mm: tuple[float, float, float] | None = None


@dataclass
class Report(Asking):
    """The features of a file, and what it says about them."""

    path: Path
    features: list[Feature] = field(default_factory=list)
    understood: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    calibrated: bool | None = None
    metadata: dict[str, str] = field(default_factory=dict)

    def fail(self, message: str, line: int | None = None, column: str | None = None) -> InputError:
        """Return the error about a line and column."""
        return InputError(message, file=self.path, line=line, field=column)


# What the name of a column says: which coordinate, and whether it is nominal, measured or their difference.


@dataclass(frozen=True)
class _Column:
    """A column: axis 0..2 or None, role or one of "feature", "setup", "axis", "other", "", and the unit in its name."""

    name: str
    axis: int | None
    role: str
    unit: str | None
    calibrated: bool = False

    @property
    def coordinate(self) -> bool:
        return self.role in _ROLES


def _column(name: str, above: str = "") -> _Column:
    """Return what a name says, with that of a group of columns above it.

    >>> [(c.axis, c.role, c.unit) for c in map(_column, ("Nom X", "Y Ist [mm]", "dZ", "ZSoll", "Feature", "+Tol", "Deviation"))]
    [(0, 'nominal', None), (1, 'actual', 'mm'), (2, 'deviation', None), (2, 'nominal', None), (None, 'feature', None), \
(None, 'other', None), (None, 'deviation', None)]
    """
    unit = split_name(name).unit or (split_name(above).unit if above else None)
    plain = re.sub(r"[\[(<{][^\[(<{\])>}]*+[\])>}]", " ", unaccented(f"{above} {name}"))
    words = [word for word in re.split(r"[^a-z0-9\u4e00-\u9fff]+", plain) if word and known_unit(word) is None]
    axes, roles, rest, calibrated = [], [], [], False
    for word in words:
        glued = _GLUED.fullmatch(word)
        if word in ("x", "y", "z"):
            axes.append("xyz".index(word))
        elif re.fullmatch(r"d[xyz]", word):
            axes.append("xyz".index(word[1]))
            roles.append(_DEVIATION)
        elif re.fullmatch(r"m[xyz]", word):
            axes.append("xyz".index(word[1]))
            roles.append(_ACTUAL)
        elif glued:
            axes.append("xyz".index(glued[2] or glued[3]))
            roles.append(_ROLE[glued[1] or glued[4]])
            calibrated |= (glued[1] or glued[4]) in _CALIBRATED
        elif word in _ROLE:
            roles.append(_ROLE[word])
            calibrated |= word in _CALIBRATED
        elif word not in _BESIDE:
            rest.append(word)
    axis = axes[0] if len(set(axes)) == 1 else None
    if not rest and len(set(roles)) == 1 and len(set(axes)) <= 1:
        return _Column(name, axis, roles[0], unit, calibrated)
    if not rest and not roles and len(axes) == 1:
        return _Column(name, axis, "", unit)
    joined = "".join(words)
    if joined in _AXIS_WORDS:
        return _Column(name, None, "axis", unit)
    if joined in _SETUP:
        return _Column(name, None, "setup", unit)
    if joined in _FEATURE or (
        words and not axes and not roles and words[0] in _FEATURE and all(w in _FEATURE for w in words)
    ):
        return _Column(name, None, "feature", unit)
    if _OTHER.search(joined) or is_index(name) or not joined:
        return _Column(name, None, "other", unit)
    return _Column(name, None, "unknown", unit)


def _merged_words(words: Sequence[str], width: int) -> list[str]:
    """Return the names of a header that was split at blanks: ``Nom X`` is one name, and so is ``X [mm]``."""
    found: list[str] = []
    for word in words:
        if found and word[:1] in "[(" and word[-1:] in "])":
            found[-1] += f" {word}"
        else:
            found.append(word)
    if len(found) == width:
        return found
    roles = [unaccented(word) in _ROLE for word in found]
    letters = [word.lower() in ("x", "y", "z") for word in found]
    first = next((k for k in range(len(found)) if roles[k] or letters[k]), 0)
    lead, joined, k = (roles, letters) if roles and roles[first] else (letters, roles), [], 0
    while k < len(found):
        if k + 1 < len(found) and lead[0][k] and lead[1][k + 1]:
            joined.append(f"{found[k]} {found[k + 1]}")
            k += 2
        else:
            joined.append(found[k])
            k += 1
    return joined


@dataclass(frozen=True)
class _Header:
    columns: tuple[_Column, ...]
    row: int
    long: bool

    def of(self, role: str) -> int | None:
        """Return the number of the only column of a role."""
        found = [k for k, column in enumerate(self.columns) if column.role == role]
        return found[0] if found else None


def _header_at(grid: CellGrid, k: int, options: ImportOptions, blanks: bool) -> _Header | None:
    """Return the header in row ``k``, whose names may stand below those of groups of columns; None if it is none."""
    row = [cell.strip() for cell in grid.rows[k]]
    if sum(parse_number(cell) is not None for cell in row) > 0 or len([cell for cell in row if cell]) < 2:
        return None
    if blanks:
        below = [
            len(other) for other in grid.rows[k + 1 : k + 4] if any(parse_number(cell) is not None for cell in other)
        ]
        row = _merged_words(row, below[0] if below else 0)
    columns = [_column(name) for name in row]
    if (
        k
        and not blanks
        and any(not c.role and c.axis is not None or (c.coordinate and c.axis is None) for c in columns)
    ):
        columns = _with_groups([cell.strip() for cell in grid.rows[k - 1]], row, columns)
    given = {name: key for key, name in options.columns.items()}
    meant = {**{letter: (n, _NOMINAL) for n, letter in enumerate("xyz")},
             **{f"{letter}a": (n, _ACTUAL) for n, letter in enumerate("xyz")},
             **{f"d{letter}": (n, _DEVIATION) for n, letter in enumerate("xyz")}, "feature": (None, "feature"),
             "setup": (None, "setup")}  # fmt: skip
    columns = [
        replace(c, axis=meant[given[c.name]][0], role=str(meant[given[c.name]][1])) if given.get(c.name) in meant else c
        for c in columns
    ]
    columns = [replace(c, role="other") if c.name in options.ignore else c for c in columns]
    columns = _numbered(columns)
    by_axis = [c for c in columns if c.coordinate and c.axis is not None]
    flat = [c for c in columns if c.coordinate and c.axis is None]
    kinds = {c.role for c in by_axis or flat}
    plain = [c for c in columns if not c.role and c.axis is not None]
    if kinds == {_ACTUAL} and plain and {c.axis for c in by_axis} <= {c.axis for c in plain}:
        columns = [replace(c, role=_NOMINAL) if c in plain else c for c in columns]
        return _Header(tuple(columns), k, False)
    if kinds == {_DEVIATION} and plain and {c.axis for c in by_axis} <= {c.axis for c in plain}:
        columns = [replace(c, role=_NOMINAL) if c in plain else c for c in columns]
        return _Header(tuple(columns), k, False)
    if len(kinds) < 2:
        return None
    return _Header(tuple(columns), k, not by_axis)


def _numbered(columns: Sequence[_Column]) -> list[_Column]:
    """Return columns with different names: the second X is ``X 2``."""
    seen: Counter[str] = Counter()
    found = []
    for column in columns:
        seen[column.name] += 1
        again = seen[column.name] > 1 and column.name
        found.append(replace(column, name=f"{column.name} {seen[column.name]}") if again else column)
    return found


def _with_groups(over: Sequence[str], row: Sequence[str], columns: Sequence[_Column]) -> list[_Column]:
    """Return columns with what the row above says of groups of them: Nominal over X, Y, Z, or X over Nominal, Measured."""
    last, found = "", []
    if not any(_column(cell).role in _ROLES or _column(cell).axis is not None for cell in over if cell):
        return list(columns)
    for n, (name, column) in enumerate(zip(row, columns, strict=True)):
        cell = over[n] if n < len(over) else ""
        last = cell or last
        half = (not column.role and column.axis is not None) or (column.coordinate and column.axis is None)
        found.append(_column(name, last) if half and last else column)
    return found


# Tables: one row for each feature (wide), or one for each coordinate (long).


def read_report(grid: CellGrid, options: ImportOptions) -> Report | None:
    """Return the features of a table with nominal and measured coordinates; None for any other table."""
    blanks = "columns are separated by blanks" in grid.notes
    headers = [found for k in range(len(grid.rows)) if (found := _header_at(grid, k, options, blanks)) is not None]
    rows = {header.row for header in headers}
    headers = [header for header in headers if header.row + 1 not in rows]  # else names of groups of columns
    if not headers:
        return None
    if not _is_report(grid, headers, options, blanks):
        return None
    report = Report(grid.path, notes=list(grid.notes))
    report.notes += [
        f"column {c.name!r} was excluded by --ignore" for c in headers[0].columns if c.name in options.ignore
    ]
    _read_blocks(grid, headers, report, options, blanks)
    return report


def _is_report(grid: CellGrid, headers: Sequence[_Header], options: ImportOptions, blanks: bool) -> bool:
    first = headers[0]
    if options.kind in ("part", "artefact"):
        return True
    if options.kind is not None:
        return False
    named = first.of("feature") is not None
    axes = {c.axis for c in first.columns if c.coordinate}
    if first.long:
        letters = first.of("axis")
        rows = grid.rows[first.row + 1 : first.row + 9]
        marked = [row[letters].strip().upper() for row in rows if letters is not None and letters < len(row)]
        return len({letter for letter in marked if letter in AXES}) > 1 or (
            named and len({_axis_of_name(row[first.of("feature") or 0])[1] for row in rows if row} - {None}) > 1
        )
    return len(axes) >= 2 and (named or len(axes) == 2)


def _axis_of_name(name: str) -> tuple[str, int | None]:
    """Return the feature and the axis of a name such as ``Bohrung1.X``, ``X-Wert_Kreis1``.

    >>> _axis_of_name("Bohrung 1.X"), _axis_of_name("X-Wert_Kreis1"), _axis_of_name("Durchmesser_Kreis1")
    (('Bohrung 1', 0), ('Kreis1', 0), ('Durchmesser_Kreis1', None))
    """
    whole = name.strip()
    behind = re.search(r"(?i)(?<=[\s._:/-])([XYZ])(?:[\s_-]?(?:wert|value|coord\w*+|koord\w*+))?+$", whole)
    if behind and (feature := whole[: behind.start()].rstrip(" \t._:/-")):
        return feature, AXES.index(behind[1].upper())
    before = re.fullmatch(r"(?i)([XYZ])[\s_-]?(?:wert|value|coord\w*|koord\w*)[\s._:/-]+(.+)", whole)
    return (before[2], AXES.index(before[1].upper())) if before else (name.strip(), None)


def _read_blocks(
    grid: CellGrid, headers: Sequence[_Header], report: Report, options: ImportOptions, blanks: bool
) -> None:
    """Read the rows below every header; lines between them name a set-up, a work offset, or a feature."""
    at = {header.row: header for header in headers}
    header: _Header | None = None
    heading, block = "", 0
    setup: int | None = None
    origin: tuple[float, float, float] | None = None
    raw: list[tuple[_Header, list[str], int, str, int | None, tuple[float, float, float] | None, int]] = []
    units: set[str] = set()
    for k, (row, line) in enumerate(zip(grid.rows, grid.lines, strict=True)):
        text = " ".join(cell for cell in row if cell)
        found_unit = _UNITS_LINE.search(text)
        if found_unit and k not in at:
            word = (found_unit[1] or found_unit[2]).lower()
            units.add("in" if word.startswith("in") else "mm" if word.startswith("m") else "um")
        offset = _OFFSET.search(text)
        if offset:
            x, y, z = (float(offset[n].replace(",", ".")) for n in (2, 3, 4))
            origin = (x, y, z)
            report.notes.append(f"line {line}: the zero of the coordinates is at {offset[0].strip()}")
            continue
        clamped = _SETUP_LINE.match(text)
        if clamped and not (header and _is_data(header, row)):
            setup = int(clamped[1])
            continue
        if k in at:
            header, block = at[k], block + 1
            continue
        if k + 1 in at and not _is_data(header, row):
            heading = text if header is not None and header.long or at[k + 1].long else heading
            if not blanks and any(_column(cell).coordinate for cell in row if cell):
                continue  # names of groups of columns
        if header is not None and (cells := _cells(header, row)) is not None:
            raw.append((header, cells, line, heading, setup, origin, block))
            continue
        numbers = sum(parse_number(cell) is not None for cell in row)
        if header is not None and numbers >= 2 and not _names_other(row):
            raise report.fail(
                f"{shown(text, 60)} has not the columns of the table above it: put it right, or take the line out", line
            )
        if header is not None and header.long and numbers == 0 and text:
            heading = text
        _remember(report, row)
    _finish(report, raw, units, options)


def _names_other(row: Sequence[str]) -> bool:
    """Whether a row is about something else than a place: its first cell names a size, a date, a tolerance."""
    label = next((cell for cell in row if cell), "")
    return parse_number(label) is None


def _remember(report: Report, row: Sequence[str]) -> None:
    cells = [cell for cell in row if cell]
    if not cells or len(report.metadata) > 30:
        return
    text = " ".join(cells).lstrip("#% ")
    if _DIMENSION.search(text):
        return
    if (found := re.search("[=:]", text)) and len(text) < 200:
        key, value = text[: found.start()].strip(), text[found.end() :].strip()
        if 0 < len(key) < 40 and value:
            report.metadata.setdefault(key.lower(), value)
        return
    if len(cells) == 2 and parse_number(cells[0]) is None:
        report.metadata.setdefault(cells[0].lower(), cells[1])


def _is_data(header: _Header | None, row: Sequence[str]) -> bool:
    return header is not None and _cells(header, row) is not None


def _cells(header: _Header, row: Sequence[str]) -> list[str] | None:
    """Return the cells of a row of data by column, the words of a feature's name together; None for another row."""
    width, cells = len(header.columns), [cell.strip() for cell in row]
    while len(cells) > width and not cells[-1]:
        cells.pop()
    surplus = len(cells) - width
    if surplus > 0 and header.columns[0].role == "feature":
        cells = [" ".join(cells[: surplus + 1]), *cells[surplus + 1 :]]
    if len(cells) > width and not header.long:
        return None
    cells = (cells + [""] * width)[:width]
    wanted = [k for k, column in enumerate(header.columns) if column.coordinate]
    known = sum(parse_number(cells[k]) is not None for k in wanted)
    filled = sum(bool(cells[k]) for k in wanted)
    return cells if known and 2 * known >= filled and 2 * known >= len(wanted) - 1 else None


def _finish(report: Report, raw: Sequence[Any], units: set[str], options: ImportOptions) -> None:
    """Turn rows of text into features in mm."""
    if not raw:
        raise report.fail("has names of nominal and measured coordinates, and no rows of numbers below them")
    try:
        plain, commas = plain_decimals([item[1] for item in raw], [item[2] for item in raw], options.decimal)
    except InputError as error:
        raise report.fail(error.message, error.line) from error
    if commas:
        report.notes.append("decimal commas were read as decimal points")
    header: _Header = raw[0][0]
    _check_columns(report, raw, options)
    scale = _scales(report, header, plain, raw, units, options)
    groups: dict[tuple[Any, ...], dict[str, Any]] = {}
    skipped: Counter[str] = Counter()
    for (own, _, line, heading, setup, origin, block), cells in zip(raw, plain, strict=True):
        name, rows = _named(own, cells, heading, line, skipped)
        if name in options.ignore:
            report.notes.append(f"feature {name!r} was excluded by --ignore")
            continue
        place = own.of("setup")
        number = setup
        if place is not None:
            found = re.search(r"\d+", cells[place])
            if found is None:
                raise report.fail(f"{shown(cells[place])} is not the number of a set-up", line, own.columns[place].name)
            number = int(found[0])
        for axis, numbers in rows:
            values = {
                role: _number(report, cells[k], line, own.columns[k].name) * scale[role] for role, k in numbers.items()
            }
            key = (name, number, block if not own.long or own.of("feature") is not None else 0)
            item = groups.setdefault(
                key, {"line": line, "axes": {}, "origin": origin, "block": block, "setup": number, "name": name}
            )
            if axis in item["axes"]:  # a repeat further down
                item = groups.setdefault(
                    (*key, line),
                    {"line": line, "axes": {}, "origin": origin, "block": block, "setup": number, "name": name},
                )
            item["axes"][axis] = _pair(report, values, line)
    if skipped:
        listed = ", ".join(f"{what} ({count})" for what, count in skipped.most_common(6))
        report.notes.append(f"rows that are no coordinates were skipped: {listed}")
    _check_signs(report, header, plain, raw, scale)
    for item in groups.values():
        nominal, actual = np.full(3, np.nan), np.full(3, np.nan)
        for axis, (one, other) in item["axes"].items():
            nominal[axis], actual[axis] = one, other
        block = item["block"] if not header.long or header.of("feature") is not None else 0
        report.features.append(
            Feature(item["name"], nominal, actual, block, item["line"], item["setup"], item["origin"])
        )
    report.calibrated = True if any(c.calibrated for c in header.columns) else None
    report.understood["columns"] = {
        f"{c.role} {AXES[c.axis] if c.axis is not None else ''}".strip(): c.name
        for c in header.columns
        if c.role not in ("other", "unknown", "")
    }


def _number(report: Report, cell: str, line: int, column: str) -> float:
    value = parse_number(cell)
    if value is None:
        what = "is empty" if not cell else f"{shown(cell)} is not a number"
        raise report.fail(
            f"{what}: leave the feature out (--ignore NAME, or delete the line), or give its number",
            line,
            f"column {column}",
        )
    return value


def _pair(report: Report, values: Mapping[str, float], line: int) -> tuple[float, float]:
    if _NOMINAL in values and _ACTUAL in values:
        return values[_NOMINAL], values[_ACTUAL]
    if _NOMINAL in values:
        return values[_NOMINAL], values[_NOMINAL] + values[_DEVIATION]
    return values[_ACTUAL] - values[_DEVIATION], values[_ACTUAL]


def _named(
    header: _Header, cells: Sequence[str], heading: str, line: int, skipped: Counter[str]
) -> tuple[str, list[tuple[int, dict[str, int]]]]:
    """Return the feature of a row and, for each of its coordinates, the columns of its numbers."""
    at = header.of("feature")
    name = cells[at] if at is not None and cells[at] else ""
    by_role = {c.role: k for k, c in enumerate(header.columns) if c.coordinate}
    if not header.long:
        found = []
        for axis in range(3):
            own = {c.role: k for k, c in enumerate(header.columns) if c.coordinate and c.axis == axis}
            if len(own) >= 2:
                found.append((axis, own))
        return name or f"line {line}", found
    letters = header.of("axis")
    axis_at: int | None
    if letters is not None:
        letter = cells[letters].strip().upper()[:1] if len(cells[letters].strip()) <= 2 else ""
        axis_at = AXES.index(letter) if letter in AXES else None
        what = cells[letters] or "?"
    else:
        name, axis_at = _axis_of_name(name)
        what = name
    if not name:
        match = _LOCATION.search(heading) or _DIMENSION.search(heading)
        name = match[1] if match else heading or f"line {line}"
    if axis_at is None:
        skipped[what] += 1
        return name, []
    return name, [(axis_at, by_role)]


def _check_columns(report: Report, raw: Sequence[Any], options: ImportOptions) -> None:
    """Ask about columns of numbers that are not understood: nothing that looks like data is left out silently."""
    for header in {item[0].row: item[0] for item in raw}.values():
        rows = [item[1] for item in raw if item[0].row == header.row]
        for k, column in enumerate(header.columns):
            if column.role not in ("unknown", "") or (column.role == "" and column.axis is None):
                continue
            filled = [row[k] for row in rows if row[k]]
            if filled and 2 * sum(parse_number(cell) is not None for cell in filled) >= len(filled):
                keys = (
                    "x, xa, dx (nominal, measured, deviation), feature, setup"
                    if column.role
                    else "xa, ya, za for what was measured"
                )
                report.ask(
                    f"the column of numbers {column.name!r} is not understood",
                    "ignore",
                    (Choice(column.name, f"leave {column.name!r} out"),),
                    f"give --map FIELD={column.name!r} ({keys}), or leave it out: --ignore {column.name!r}",
                    picture="columns",
                )


def _scales(
    report: Report,
    header: _Header,
    plain: Sequence[Sequence[str]],
    raw: Sequence[Any],
    units: set[str],
    options: ImportOptions,
) -> dict[str, float]:
    """Return mm per unit of nominal and measured coordinates and of deviations."""
    stated = {c.unit for c in header.columns if c.coordinate and c.role != _DEVIATION and c.unit}
    stated = stated or (units if len(units) == 1 else set())
    given = options.given_unit("position", "x", "value", among=MM_PER_LENGTH, what="length")
    if given is None and len(stated | units) > 1 and not {c.unit for c in header.columns if c.coordinate and c.unit}:
        report.ask(
            f"several units are stated ({', '.join(sorted(stated | units))})",
            "units",
            choices_of(sorted(stated | units)),
            "give --unit position=UNIT",
            key="position",
        )
    unit = given or (next(iter(stated)) if len(stated) == 1 else None)
    if unit is None:
        columns = [k for k, c in enumerate(header.columns) if c.role in (_NOMINAL, _ACTUAL)]
        numbers = [value for row in plain for k in columns if (value := parse_number(row[k])) is not None]
        judged = unit_of_positions(float(np.ptp(numbers)) if numbers else 0.0)
        unit = "mm"
        if judged.best == "mm" and judged.shares["mm"] > 0.85:
            report.notes.append(f"the file states no unit; by the magnitude of the numbers {judged.text()}")
        else:
            report.ask(
                f"the file states no unit of the coordinates ({judged.text()})",
                "units",
                choices_of(("mm", "in")),
                "give --unit position=mm or in",
                key="position",
            )
    if unit not in MM_PER_LENGTH:
        raise report.fail(f"{unit} is not a unit of length; expected coordinates")
    report.understood["unit"] = unit
    mm = MM_PER_LENGTH[unit]
    own = {c.unit for c in header.columns if c.role == _DEVIATION and c.unit}
    deviation = options.given_unit("deviation", "dx", among=MM_PER_LENGTH, what="length") or (
        next(iter(own)) if len(own) == 1 else None
    )
    return {_NOMINAL: mm, _ACTUAL: mm, _DEVIATION: MM_PER_LENGTH.get(deviation or unit, mm)}


def _check_signs(
    report: Report, header: _Header, plain: Sequence[Sequence[str]], raw: Sequence[Any], scale: Mapping[str, float]
) -> None:
    """Compare printed deviations with measured minus nominal; one of the other sign, or another number, is asked."""
    worst, turned, count = 0.0, 0.0, 0
    for axis in (None, 0, 1, 2):
        own = {c.role: k for k, c in enumerate(header.columns) if c.coordinate and c.axis == axis}
        if set(own) != set(_ROLES):
            continue
        for row in plain:
            numbers = {role: parse_number(row[k]) for role, k in own.items()}
            if None in numbers.values():
                continue
            digits = sum(10.0 ** -len(row[k].partition(".")[2]) * scale[role] for role, k in own.items())
            real = numbers[_ACTUAL] * scale[_ACTUAL] - numbers[_NOMINAL] * scale[_NOMINAL]  # type: ignore[operator]
            said = numbers[_DEVIATION] * scale[_DEVIATION]  # type: ignore[operator]
            worst, turned = max(worst, abs(real - said) - 0.6 * digits), max(turned, abs(real + said) - 0.6 * digits)
            count += 1
    if count and worst > 0:
        what = "have the opposite sign of" if turned <= 0 else "disagree with"
        names = [c.name for c in header.columns if c.role == _DEVIATION]
        report.ask(
            f"the deviations {what} measured minus nominal: are the columns exchanged?",
            "ignore",
            choices_of(names, {name: f"leave {name!r} out" for name in names}),
            "leave the wrong ones out: " + " ".join(f"--ignore {name!r}" for name in names),
        )
    elif count:
        report.notes.append("the printed deviations agree with measured minus nominal")


# DMIS: F(label) is the nominal feature, FA(label) the measured one.


_DMIS = re.compile(r"(?i)^(FA?)\(([^)]+)\)\s*=\s*FEAT/(\w+)\s*,(.*)$")


def is_dmis(text: str) -> bool:
    """Whether a text is the result of a DMIS program: it has measured features."""
    return re.search(r"(?im)^\s*FA\([^)]+\)\s*=\s*FEAT/", text) is not None


def read_dmis(source: Text, options: ImportOptions) -> Report:
    """Read the features that a DMIS output file gives as nominal, F(label), and measured, FA(label)."""
    report = Report(source.path)
    nominal: dict[str, FloatArray] = {}
    measured: list[tuple[str, str, FloatArray, int]] = []
    mm: float | None = None
    text = re.sub(r"\$\s*\n\s*", "", source.text)  # a line that ends with $ goes on
    for line, content in enumerate(text.splitlines(), 1):
        units = re.match(r"(?i)\s*UNITS/(\w+)", content)
        if units:
            mm = {"MM": 1.0, "CM": 10.0, "M": 1e3, "INCH": 25.4}.get(units[1].upper())
        found = _DMIS.match(content.strip())
        if not found:
            continue
        numbers = re.search(r"(?i)CART\s*+,([^,]++),([^,]++),\s*+([^,\s]++)", found[4])
        if numbers is None:
            if found[1].upper() == "FA":
                report.notes.append(f"line {line}: {found[2]} ({found[3].lower()}) has no place and was skipped")
            continue
        values = [parse_number(numbers[n].strip()) for n in (1, 2, 3)]
        if None in values:
            raise report.fail(f"{shown(content)} has a coordinate that is not a number", line)
        place = np.array(values, dtype=np.float64)
        if found[1].upper() == "F":
            nominal[found[2]] = place
        else:
            measured.append((found[2], found[3], place, line))
    given = options.given_unit("position", "value", among=MM_PER_LENGTH, what="length")
    mm = MM_PER_LENGTH[given] if given else mm
    if mm is None:
        report.ask(
            "the file states no UNITS/",
            "units",
            choices_of(("mm", "in")),
            "give --unit position=mm or in",
            key="position",
        )
    for name, kind, place, line in measured:
        if name not in nominal:
            raise report.fail(f"FA({name}) was measured, and there is no nominal feature F({name})", line)
        if name in options.ignore:
            report.notes.append(f"feature {name!r} was excluded by --ignore")
            continue
        if _has_place(report, name, kind, nominal[name], place):
            report.features.append(Feature(name, nominal[name] * (mm or 1.0), place * (mm or 1.0), 1, line))
    report.understood["unit"] = "mm" if mm == 1.0 else "in" if mm == 25.4 else f"{mm} mm"
    return report


# QIF (ISO 23952): results in XML.


def is_qif(head: str) -> bool:
    """Whether a text begins like a QIF document."""
    return "<QIFDocument" in head or ":QIFDocument" in head


def read_qif(path: Path, options: ImportOptions) -> Report:
    """Read the places of measured features and of their nominal ones from a QIF document."""
    content = read_bytes(path)
    if b"<!DOCTYPE" in content.upper() or b"<!ENTITY" in content.upper():
        raise InputError("declares XML entities; it is refused", file=path)
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise InputError(f"is not complete XML: {error}", file=path, line=error.position[0]) from error
    report = Report(path)
    nodes = {node.get("id"): node for node in root.iter() if node.get("id")}
    mm = _qif_unit(root, report, options)
    for block, node in _qif_results(root):
        item = nodes.get(_child(node, "FeatureItemId"))
        nominal = None if item is None else nodes.get(_child(item, "FeatureNominalId"))
        name = (_child(item, "FeatureName") if item is not None else "") or f"{_tag(node)} {node.get('id')}"
        if name in options.ignore:
            report.notes.append(f"feature {name!r} was excluded by --ignore")
            continue
        places = [_child(part, "Location") if part is not None else "" for part in (nominal, node)]
        if item is not None and any(_tag(part) == "Set" for part in item.iter()):
            report.notes.append(f"feature {name!r} was set, not measured, and was skipped")
            continue
        if not all(places):
            report.notes.append(f"feature {name!r} has no nominal or no measured place and was skipped")
            continue
        both = [np.array([float(word) for word in place.split()]) * mm for place in places if _is_place(place)]
        if len(both) != 2:
            raise report.fail(f"feature {name!r}: Location is not three numbers")
        if _has_place(report, name, re.sub("Feature(Actual|Measurement)$", "", _tag(node)), *both):
            report.features.append(Feature(name, both[0], both[1], block, 0))
    if not report.features and any(_tag(node).startswith("ExternalQIF") for node in root.iter()):
        raise report.fail(
            "refers to another QIF document for its features: export one document with nominal and measured features"
        )
    return report


def _qif_results(root: ElementTree.Element) -> Iterator[tuple[int, ElementTree.Element]]:
    """Yield the measured features, with the number of the measurement that they belong to."""
    count, of_node = 0, dict[int, int]()
    for node in root.iter():
        if _tag(node) == "MeasurementResults":
            count += 1
            of_node.update((id(part), count) for part in node.iter())
        if _tag(node).endswith(("FeatureActual", "FeatureMeasurement")):
            yield of_node.get(id(node), 1), node


#: Features whose place is any point of theirs, so that nominal and measured places do not belong together; DMIS and QIF words.
_ANYWHERE = re.compile("(?i)plane|line|cyl|cone|parallel|cpar|torus|surf|gcurve|gsurf|edgpt|extru|pattern")
#: A point was probed along its normal if the rest of its deviation is below this share of it.
_ALONG = 1e-3


def _has_place(report: Report, name: str, kind: str, nominal: FloatArray, actual: FloatArray) -> bool:
    """Whether all coordinates of a feature were measured: those of centres are, and of points unless probed along one axis.

    A plane, a line or a cylinder has a place anywhere on it; of a point that was probed along an axis the other coordinates are
    where the machine was sent, and would count as errors of zero.
    """
    if _ANYWHERE.search(kind):
        report.notes.append(
            f"feature {name!r} ({kind.lower()}) has no place of its own, only a point on it, and was skipped"
        )
        return False
    away = np.sort(np.abs(actual - nominal))
    if re.search("(?i)point", kind) and away[2] > 0 and away[1] <= _ALONG * away[2]:
        report.notes.append(
            f"point {name!r} was probed along one axis only and was skipped: its other coordinates are not measured"
        )
        return False
    return True


def _is_place(text: str) -> bool:
    words = text.split()
    return len(words) == 3 and all(parse_number(word) is not None for word in words)


def _qif_unit(root: ElementTree.Element, report: Report, options: ImportOptions) -> float:
    given = options.given_unit("position", "value", among=MM_PER_LENGTH, what="length")
    if given:
        return MM_PER_LENGTH[given]
    for node in root.iter():
        if _tag(node) != "LinearUnit":
            continue
        factor = next((part.text for part in node.iter() if _tag(part) == "Factor"), None)
        name = _child(node, "UnitName") or _child(node, "SIUnitName")
        value = parse_number(factor.strip()) if factor else None
        mm = 1e3 * value if value is not None else MM_PER_LENGTH.get(known_unit(name) or "", 0.0)
        if mm:
            report.understood["unit"] = name
            return mm
    report.ask(
        "the file states no linear unit",
        "units",
        choices_of(("mm", "in")),
        "give --unit position=mm or in",
        key="position",
    )
    return 1.0


def _tag(node: ElementTree.Element) -> str:
    return node.tag.rpartition("}")[2]


def _child(node: ElementTree.Element, tag: str) -> str:
    return next(((part.text or "").strip() for part in node if _tag(part) == tag), "")


# A part or an artefact of features, with the questions that a report leaves open.


def imported_features(report: Report, form: str, options: ImportOptions) -> Imported:
    """Return the features as a part or an artefact; what was not stated is a doubt.

    Raises
    ------
    InputError
        for fewer than three features, features with different coordinates, nominal and measured places that are far apart.
    """
    kind = options.kind or ("artefact" if report.calibrated else None)
    _check_features(report, kind)
    origin = _origin(report, options)
    setup = _setups(report, options)
    if kind is None:
        report.ask(
            "nominal and measured coordinates of features: who measured them? The errors have opposite signs",
            "kind",
            (
                Choice("part", "this machine made the part; it was measured elsewhere (CMM)"),
                Choice("artefact", "this machine's own probe measured them"),
            ),
            "give --kind part (made by this machine, measured elsewhere) or --kind artefact (measured by this machine's probe)",
            picture="measured-by",
        )
    if origin is None:
        report.ask(
            "the file does not state where the zero of its coordinates was in the machine (machine coordinates in mm, for "
            "example those of G54; 0,0,0 if the coordinates are machine coordinates)",
            "origin",
            (),
            "give --origin X,Y,Z",
            picture="origin",
        )
    calibrated = {"yes": True, "no": False}.get(options.calibrated or "", report.calibrated)
    if kind == "artefact" and calibrated is None:
        report.ask(
            "are the nominal places those of a calibration, or of a drawing?",
            "calibrated",
            (Choice("yes", "of a calibration"), Choice("no", "of a drawing: nominal only")),
            "give --calibrated yes (calibration) or --calibrated no (drawing)",
        )
    if kind == "part" and options.calibrated is not None:
        raise report.fail(
            "applies to an artefact; the nominal places of a part are those of its drawing", None, "--calibrated"
        )
    places = np.array([item.origin_mm or origin or (0.0, 0.0, 0.0) for item in report.features])
    data = _artefact(report, setup, places, bool(calibrated)) if kind == "artefact" else _part(report, setup, places)
    components = [axis for k, axis in enumerate(AXES) if not np.isnan(report.features[0].actual_mm[k])]
    away = np.array([item.actual_mm - item.nominal_mm for item in report.features])
    report.understood |= {
        "features": len({item.name for item in report.features}),
        "coordinates": "".join(components),
        "set_ups": len(set(setup.tolist())),
        "origin_mm": None if origin is None else ", ".join(f"{value:g}" for value in origin),
        **({} if kind == "artefact" else {"largest_deviation_um": float(np.nanmax(np.abs(away))) * 1e3}),
        **({"calibrated": calibrated} if kind == "artefact" else {}),
        **({"header": dict(list(report.metadata.items())[:12])} if report.metadata else {}),
    }
    notes = tuple(dict.fromkeys(report.notes))
    return Imported(
        report.path,
        form,
        "artefact" if kind == "artefact" else "part",
        data,
        report.understood,
        tuple(report.questions),
        notes,
    )


def _check_features(report: Report, kind: str | None) -> None:
    if len(report.features) < LEAST_FEATURES:
        raise report.fail(
            f"contains {len(report.features)} features with nominal and measured coordinates; at least 3 are needed"
        )
    first = np.isnan(report.features[0].actual_mm)
    for item in report.features:
        if (np.isnan(item.actual_mm) != first).any():
            text = f"feature {item.name!r} has other coordinates than the first one, {report.features[0].name!r}: "
            raise report.fail(f"{text}leave it out with --ignore {item.name!r}, or complete it", item.line)
    away_mm = np.array([np.nanmax(np.abs(item.actual_mm - item.nominal_mm)) for item in report.features])
    if (
        kind == "artefact" or np.median(away_mm) > MOST_APART_MM
    ):  # another frame: where the artefact lay, or of the alignment
        return
    for k in np.flatnonzero(away_mm > MOST_APART_MM)[:1].tolist():
        item = report.features[k]
        text = (
            f"feature {item.name!r}: nominal and measured are {away_mm[k]:.4g} mm apart: another unit, or a mistake? "
        )
        raise report.fail(f"{text}Leave it out with --ignore {item.name!r} if only it is wrong", item.line or None)


def _origin(report: Report, options: ImportOptions) -> tuple[float, float, float] | None:
    """Return the only origin, that of the options or of the file; the features keep those of their own tables."""
    stated = {item.origin_mm for item in report.features}
    given = options.origin_mm()
    known = stated - {None}
    if given is not None and known and known != {given}:
        text = (
            f"the file states {', '.join(f'{v:g}' for v in next(iter(known)) or ())}; take that line out if it is wrong"
        )
        raise report.fail(text, None, "--origin")
    if None in stated:
        return given
    return given or next(iter(known))


_CLAMPING = (Choice("one", "all in one set-up"), Choice("each", "each table is a set-up of its own"))


def _setups(report: Report, options: ImportOptions) -> Any:
    """Return the number of the set-up of every feature; what the file does not show is asked."""
    features = report.features
    if all(item.setup is not None for item in features):
        return np.array([item.setup for item in features], dtype=np.int64)
    if len({item.origin_mm for item in features}) > 1:  # another work offset for each table
        order = list(dict.fromkeys(item.origin_mm for item in features))
        report.notes.append("each work offset is a set-up of its own")
        return np.array([1 + order.index(item.origin_mm) for item in features], dtype=np.int64)
    blocks = list(dict.fromkeys(item.block for item in features))
    again = [name for name, count in Counter(item.name for item in features).items() if count > 1]
    if options.clamping == "each":
        return np.array([1 + blocks.index(item.block) for item in features], dtype=np.int64)
    if options.clamping is None and (len(blocks) > 1 or again):
        what = f"{len(blocks)} tables" if len(blocks) > 1 else f"feature {again[0]!r} several times"
        report.ask(
            f"the file contains {what} and does not number the set-ups",
            "clamping",
            _CLAMPING,
            "give --clamping one (all in one set-up), --clamping each (each table a set-up), or a column Setup",
        )
    elif options.clamping is None:
        report.notes.append("one table: all features count as one set-up; number several in a column Setup")
    return np.ones(len(features), dtype=np.int64)


def _part(report: Report, setup: Any, places: FloatArray) -> Part:
    nominal = np.array([item.nominal_mm for item in report.features])
    measured = np.array([item.actual_mm for item in report.features])
    one = places[0] if (places == places[0]).all() else np.zeros(3)
    nominal, measured = nominal + places - one, measured + places - one
    return Part(
        feature=[item.name for item in report.features],
        nominal_mm=np.nan_to_num(nominal),
        measured_mm=measured,
        setup=setup,
        origin_mm=one,
        metadata=_metadata(report),
        origin=[(str(report.path), item.line) for item in report.features],
    )


def _artefact(report: Report, setup: Any, places: FloatArray, calibrated: bool) -> Artefact:
    """Return features in machine coordinates; repeats in one set-up as their mean."""
    nominal = np.nan_to_num(np.array([item.nominal_mm for item in report.features]))
    measured = np.array([item.actual_mm for item in report.features]) + places
    missing = np.isnan(measured).all(axis=0)
    nominal = np.where(missing, nominal + places, nominal)
    names = [item.name for item in report.features]
    keys = list(zip(names, setup.tolist(), strict=True))
    kept = list(dict.fromkeys(keys))
    if len(kept) < len(keys):
        report.notes.append(f"{len(keys) - len(kept)} repeats of features in one set-up: their mean is used")
    rows = [[k for k, key in enumerate(keys) if key == one] for one in kept]
    return Artefact(
        feature=[name for name, _ in kept],
        nominal_mm=np.array([nominal[own].mean(axis=0) for own in rows]),
        u_nominal_mm=np.full((len(kept), 3), np.nan),
        measured_mm=np.array([measured[own].mean(axis=0) for own in rows]),
        setup=np.array([number for _, number in kept], dtype=np.int64),
        calibrated=np.full(len(kept), calibrated),
        metadata=_metadata(report),
        origin=[(str(report.path), report.features[own[0]].line) for own in rows],
    )


def _metadata(report: Report) -> dict[str, str]:
    clean = {
        re.sub(r"[^a-z0-9_]+", "_", key).strip("_"): " ".join(value.split()) for key, value in report.metadata.items()
    }
    taken = ("rows", "origin_mm", "calibrated", "u_probe_um", "expansion_um_per_m_k", "measured")
    return {"source": report.path.name, **{key: value for key, value in clean.items() if key and key not in taken}}


def merged_features(parts: Sequence[tuple[str, Imported]], options: ImportOptions) -> Imported:
    """Return the features on several sheets of a workbook as one part or artefact; which sheets are one set-up is asked."""
    first, setups, begin = parts[0][1], [], 1
    for _, item in parts:
        assert isinstance(item.data, Part | Artefact)  # the caller looked
        _, own = np.unique(item.data.setup, return_inverse=True)
        setups.append(own.ravel() + (1 if options.clamping == "one" else begin))
        begin += int(own.max()) + 1
    asking = Asking(
        questions=[
            replace(asked, reason=f"sheet {shown(name)}: {asked.reason}")
            for name, item in parts
            for asked in item.questions
        ]
    )
    if options.clamping is None:
        asking.ask(
            f"there are features on {len(parts)} sheets",
            "clamping",
            _CLAMPING,
            "give --clamping one (all in one set-up) or --clamping each (each sheet)",
        )
    setup = np.concatenate(setups).astype(np.int64)
    found = [item.data for _, item in parts]
    data: Part | Artefact
    if all(isinstance(item, Part) for item in found):
        data = _joined_parts([item for item in found if isinstance(item, Part)], setup)
    else:
        plates = [item for item in found if isinstance(item, Artefact)]
        if len(plates) < len(found):
            raise InputError("has parts and artefacts on its sheets; choose one with --sheet", file=first.path)
        data = replace(join_artefacts(plates), setup=setup)
    return replace(
        first,
        data=data,
        understood={f"sheet {name}": dict(item.understood) for name, item in parts},
        questions=tuple(asking.questions),
        notes=tuple(dict.fromkeys(text for _, item in parts for text in item.notes)),
    )


def _joined_parts(parts: Sequence[Part], setup: Any) -> Part:
    """Return parts in the frame of the first one."""
    origin = parts[0].origin_mm
    shift = [part.origin_mm - origin for part in parts]
    return replace(
        parts[0],
        feature=[name for part in parts for name in part.feature],
        nominal_mm=np.concatenate([part.nominal_mm + by for part, by in zip(parts, shift, strict=True)]),
        measured_mm=np.concatenate([part.measured_mm + by for part, by in zip(parts, shift, strict=True)]),
        setup=setup,
        origin=[place for part in parts for place in part.origin],
    )
