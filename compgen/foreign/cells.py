"""From a text or a workbook to one table: cells, decimal marks, and where header and rows are.

:func:`grid_of_text` and :func:`read_sheets` give a :class:`CellGrid`; :func:`find_table` finds the longest block of numbers
below a row of names in it and returns a :class:`Table` with decimal points. Workbooks are checked as archives first.
"""

from __future__ import annotations

import csv
import datetime
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from compgen.errors import InputError, nearest
from compgen.foreign.column_names import (
    FIELDS,
    covariate_unit,
    is_index,
    is_known_name,
    known_unit,
    motion_in,
    names_run,
    run_in,
    split_name,
    statistic_in,
    way,
)
from compgen.foreign.source import LARGEST, MEGABYTE, Text, check_size, parse_number, shown

# Decimal commas and marks between thousands in the cells of a foreign table.


_THOUSANDS_COMMA = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d+")
_THOUSANDS_POINT = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d+")
#: Thousands separated by a blank or an apostrophe are unambiguous.
_THOUSANDS_BLANK = re.compile(r"[+-]?\d{1,3}([ \u00a0\u202f'\u2019]\d{3})+([.,]\d+)?")
_BLANKS = re.compile(r"[ \u00a0\u202f'\u2019]")
#: A number that may have a decimal comma or thousands.
_EITHER = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_POINT = re.compile(r"[+-]?\d*\.\d+([eE][+-]?\d+)?")


def plain_decimals(rows: list[list[str]], lines: Sequence[int], decimal: str | None) -> tuple[list[list[str]], bool]:
    """Convert decimal commas to points if the rows use them, and remove thousands separators.

    ``decimal`` is the choice of the user, "comma" or "point". Raises InputError for rows that mix both, and for numbers
    that may be either (1,000).
    """
    together = "".join(map("".join, rows))
    if _BLANKS.search(together):
        rows = [[_BLANKS.sub("", c) if _THOUSANDS_BLANK.fullmatch(c) else c for c in row] for row in rows]
    if decimal is not None:
        mark, other = (",", ".") if decimal == "comma" else (".", ",")
        meant = re.compile(rf"[+-]?(\d*|[1-9]\d{{0,2}}([{other}]\d{{3}})+)([{mark}]\d*)?([eE][+-]?\d+)?")
        read = []
        for row, line in zip(rows, lines, strict=True):
            numbers = [meant.fullmatch(cell) is not None for cell in row]
            for cell, good in zip(row, numbers, strict=True):
                if not good and (_COMMA.fullmatch(cell) or _POINT.fullmatch(cell)):
                    message = f"{shown(cell)} has no decimal {decimal}, and does not separate thousands"
                    raise InputError(message, line=line, field="--decimal")
            read.append(
                [c.replace(other, "").replace(mark, ".") if n else c for c, n in zip(row, numbers, strict=True)]
            )
        return read, decimal == "comma"
    if "," not in together:
        return rows, False
    # the lines of the first decimal comma, decimal point, and number that may have a comma or thousands (0: none)
    comma = point = either = 0
    for row, line in zip(rows, lines, strict=True):
        for cell in row:
            if _EITHER.fullmatch(cell):
                either = either or line
            elif _COMMA.fullmatch(cell) or _THOUSANDS_POINT.fullmatch(cell):
                comma = comma or line
            elif _POINT.fullmatch(cell) or _THOUSANDS_COMMA.fullmatch(cell):
                point = point or line
    if point:  # a number such as 1,000 has a decimal comma then, or is in conflict with the point
        comma, either = comma or either, 0
    if comma and point:
        message = f"a decimal comma here, a decimal point in line {point}; write all numbers alike, or give --decimal"
        raise InputError(f"{message} comma or point (the other separates thousands)", line=comma)
    if either and not comma:
        raise InputError(
            "numbers such as 1,000 may be 1000 or 1.000; give --decimal point (1000) or comma (1.000)", line=either
        )
    changed = comma or any(_THOUSANDS_COMMA.fullmatch(cell) for row in rows for cell in row)
    return [[_plain(cell) for cell in row] for row in rows] if changed else rows, bool(comma)


def _plain(cell: str) -> str:
    if _COMMA.fullmatch(cell):
        return cell.replace(",", ".")
    if _THOUSANDS_POINT.fullmatch(cell):
        return cell.replace(".", "").replace(",", ".")
    return cell.replace(",", "") if _THOUSANDS_COMMA.fullmatch(cell) else cell


# Cells of a text or a sheet, and the place of header and rows among them.


#: Rows of the largest possible sheet.
MOST_ROWS, MOST_COLUMNS, MOST_CELL = 1_048_576, 500, 2_000
#: Cells of a row, as in the widest possible sheet; targets may be columns.
MOST_WIDE = 16_384
#: Cells of a table; each takes some sixty bytes of memory.
MOST_CELLS = 10_000_000
#: Number of lines examined for the separator, and for the header.
_SAMPLE_LINES, _SAMPLE_CHARACTERS, _HEADER_LINES = 200, 20_000, 200
#: Number of rows of each table counted to find the longest.
_MEASURED_ROWS = 5_000
#: A number in any notation, which is determined later.
_NUMERAL = re.compile(r"[+\-\u2212]?(\d[\d.,' \u00a0\u202f]*)?[.,]?\d(e[+\-]?\d+)?", re.IGNORECASE)
#: Words for squareness, and its names in ISO 230-1.
SQUARENESS_WORDS = re.compile(r"(?i)rechtwinkl|square|perpendic|equerr|ortogonal|\u5782\u76f4|E[ABC]0[YZ]")
_ALL_WORDS = frozenset(word for words in FIELDS.values() for word in words)
#: Cells in a row of units that mean: no unit.
_NO_UNIT = ("", "-", "\u2013", "--", "/", "1")
#: A row above a table may contain a key and at most this many cells, the key included.
_MOST_PAIR = 6
#: Letters of words that Python accepts as numbers (inf, nan), and a comma: a column without them is converted at once.
_NOT_PLAIN = frozenset("infa,")


@dataclass(frozen=True)
class CellGrid:
    """Rows of cells with their line numbers; ``notes`` says how they were read, ``empty`` why cells may be empty."""

    path: Path
    rows: Sequence[Sequence[str]]
    lines: Sequence[int]
    notes: tuple[str, ...] = ()
    empty: str = ""

    def fail(self, message: str, line: int | None = None, column: str | None = None) -> InputError:
        """Return the error about a row and column."""
        return InputError(message, file=self.path, line=line, field=f"column {column}" if column else None)


@dataclass(frozen=True)
class Table:
    """A header and its rows, all of one width.

    ``metadata`` contains the lines above as ``key: value``, keys in lower case; ``comments`` the ``# key = value``
    unchanged.
    """

    grid: CellGrid
    header: tuple[str, ...]
    header_line: int
    rows: Sequence[Sequence[str]]
    lines: Sequence[int]
    metadata: dict[str, str] = field(default_factory=dict)
    comments: dict[str, str] = field(default_factory=dict)

    def column(self, name: str) -> list[str]:
        """Return the cells of a column."""
        k = self.header.index(name)
        return [row[k] for row in self.rows]

    def numbers(self, name: str, *, empty: bool = False) -> list[float]:
        """Return a column as numbers; with ``empty`` an empty cell is nan, otherwise an error like any text."""
        cells, found = self.column(name), []
        together = "".join(cells)
        if together.isascii() and "_" not in together and _NOT_PLAIN.isdisjoint(together.lower()):
            try:
                values = [float(cell) for cell in cells]
            except ValueError:
                values = [float("inf")]  # the cell is found below
            if max(map(abs, values)) < LARGEST:
                return values
        for cell, line in zip(cells, self.lines, strict=True):
            value = parse_number(cell)
            if value is None and not (empty and not cell):
                what = f"is empty{self.grid.empty}" if not cell else f"{shown(cell)} is not a number"
                raise self.grid.fail(f"{what}; expected a number", line, name)
            found.append(float("nan") if value is None else value)
        return found


def grid_of_text(source: Text) -> CellGrid:
    """Split a text file into cells: finds the separator, and decimal commas."""
    count = source.text.count("\n")
    if count > MOST_ROWS:
        raise source.fail(f"has {count} lines; at most {MOST_ROWS} are read: thin it out or split it")
    lines = source.text.split("\n")
    numbers = [k for k, line in enumerate(lines, start=1) if line and not line.isspace()]
    content = [lines[k - 1] for k in numbers] if len(numbers) < len(lines) else lines
    separator = _separator(content[:_SAMPLE_LINES])
    marks = source.text.count(separator) if separator else source.text.count(" ") + source.text.count("\t")
    widest = max((line.count(separator or " ") for line in content[:_SAMPLE_LINES]), default=0)
    cells = max(len(content) * (1 + widest), len(content) + marks)
    if cells > MOST_CELLS:
        raise source.fail(f"has about {cells} cells; at most {MOST_CELLS} are read: leave out columns or rows")
    if separator is None:
        rows = [line.split() for line in content]
    else:
        try:
            rows = [[cell.strip() for cell in row] for row in csv.reader(content, delimiter=separator)]
        except csv.Error as error:
            raise source.fail(f"is not readable as a table: {error}") from error
        if len(rows) != len(content):
            raise source.fail("a quoted cell contains a line end; write each row on one line")
    widest = max(map(len, rows), default=0)
    if widest > MOST_WIDE:
        line = numbers[next(k for k, row in enumerate(rows) if len(row) == widest)]
        raise source.fail(f"has {widest} cells; at most {MOST_WIDE} are read: is this a table?", line)
    names = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", None: "blanks"}
    notes = [f"columns are separated by {names[separator]}"]
    if source.encoding not in ("utf-8", "utf-8-sig"):
        notes.append(f"is not UTF-8; it was read as {source.encoding}")
    grid = CellGrid(source.path, rows, numbers, tuple(notes))
    if not source.ended and len(rows) > 2 and len(rows[-1]) < len(rows[-2]):
        raise source.fail(
            "the last line has no line end and fewer cells than the one before: it is truncated", numbers[-1]
        )
    return grid


def _separator(lines: Sequence[str]) -> str | None:
    """Return the mark that separates the most numbers in a block of lines with equally many cells; None for blanks.

    The score of a block is its count of numbers times their share of the filled cells. A later mark must be clearly
    better: decimal commas separate numbers, too.
    """
    best, score = None, 0.0
    for mark, margin in ((";", 1.0), ("\t", 1.0), ("|", 1.0), (",", 1.2), (None, 1.2)):
        longest, numbers, filled, width = 0.0, 0, 0, -1
        for line in lines:
            row = [cell.strip().strip('"') for cell in line[:_SAMPLE_CHARACTERS].split(mark)]
            if len(row) != width:
                numbers, filled, width = 0, 0, len(row)
            count = sum(_NUMERAL.fullmatch(cell) is not None for cell in row)
            numbers, filled = numbers + count, filled + (len(_filled(row)) if count else 0)
            if width > 1 and numbers:
                longest = max(longest, numbers * numbers / filled)
        if longest > margin * score:
            best, score = mark, longest
    return best


@dataclass(frozen=True)
class _Layout:
    """Where a table is in a grid: its rows of names from ``top`` on, rows of numbers from ``first`` to before ``end``.

    ``numbers`` counts its cells with numbers. ``labels`` > 0: each row is a run, and this many cells of it name it;
    then ``names`` are those of the rows.
    """

    top: int
    first: int
    end: int
    names: tuple[str, ...]
    numbers: int
    labels: int = 0


def find_table(grid: CellGrid, decimal: str | None = None) -> Table:
    """Find header and rows: the longest block of numbers below a row of names; the lines above are metadata.

    The targets may be rows or columns; the table that is returned has a row for each. ``decimal`` is the decimal mark,
    "comma" or "point", if the user says it.

    Raises InputError if there is none, for a row of another width below the header, and for a second block of numbers.
    """
    # the grid without columns at its left that are empty in every row
    margin = min((next((k for k, cell in enumerate(row) if cell), len(row)) for row in grid.rows), default=0)
    grid = replace(grid, rows=[row[margin:] for row in grid.rows]) if margin else grid
    best: _Layout | None = None
    for k in range(min(len(grid.rows), _HEADER_LINES)):
        found = _across(grid, k) or _down(grid, k)
        if found is not None and (best is None or found.numbers > best.numbers):
            best = found
        if found is not None and found.end == len(grid.rows):
            break
    if best is None:
        raise grid.fail(
            "contains no table; expected a header line with the names of the columns and rows of numbers below it"
            f"{grid.empty}"
        )
    metadata: dict[str, str] = {}
    comments: dict[str, str] = {}
    for row in grid.rows[: best.top]:
        _note(row, metadata, comments)
    _check_no_more_rows(grid, 0, best.top, 2)
    if not best.labels:
        return _table(grid, best, metadata, comments, decimal)
    _check_no_more_rows(grid, best.end, len(grid.rows))
    return _turned(grid, best, metadata, comments, decimal)


def _filled(row: Sequence[str]) -> list[str]:
    return [cell for cell in row if cell]


def _down(grid: CellGrid, k: int) -> _Layout | None:
    """Return the table whose last row of names is row k, a row of units below it or not; None if there is none."""
    row = grid.rows[k]
    names = _filled(row)
    if len(names) < 2 or len(names) > MOST_COLUMNS or _is_comment(row):
        return None
    first = k + 1
    units: Sequence[str] = ()
    if first < len(grid.rows) and _are_units(grid.rows[first]):
        units, first = grid.rows[first], first + 1
    if first >= len(grid.rows) or not _has_number(grid.rows[first]):
        return None
    if first + 1 < len(grid.rows) and _numbers_runs(grid.rows[first], grid.rows[first + 1]) or _across(grid, first):
        return None  # that row has the names
    words = sum(parse_number(name) is None for name in names)
    if 2 * words < len(names) and not _numbers_runs(row, grid.rows[first]):
        return None
    top, joined = _joined_names(grid, k)
    # the row has the width of the header and mostly numbers (names of stations or axes may be among them); one of about
    # twice the width is accepted here and refused later: decimal commas between commas
    cells, named = _filled(grid.rows[first]), len(_filled(joined))
    count = sum(parse_number(cell) is not None for cell in cells)
    wide = 2 * named - 1 <= len(cells) <= (len(joined) if units else MOST_COLUMNS)
    if not count or 3 * count < len(cells) or named >= 2 * len(cells) or not (len(cells) <= named or wide):
        return None
    joined = [
        f"{name} [{unit}]" if unit else name
        for name, unit in zip_longest(
            joined,
            ["" if cell in _NO_UNIT else _unit_in_cell(cell) or cell.strip("[]() ") for cell in units],
            fillvalue="",
        )
    ]
    end, numbers = first, 0
    while end < min(len(grid.rows), first + _MEASURED_ROWS) and _as(grid.rows[first], grid.rows[end]):
        numbers += sum(parse_number(cell) is not None for cell in grid.rows[end])
        end += 1
    end = len(grid.rows) if end == first + _MEASURED_ROWS else end
    return _Layout(top, first, end, tuple(joined), numbers)


def _is_comment(row: Sequence[str]) -> bool:
    return row[0].startswith("#") and "=" in "".join(row)


def _has_number(row: Sequence[str]) -> bool:
    return any(parse_number(cell) is not None for cell in row)


def _unit_in_cell(cell: str) -> str | None:
    """Return the unit if a cell contains only a unit; brackets and "in" are ignored."""
    text = re.sub(r"^in\s+", "", cell.strip("[]() "))
    return text if known_unit(text) or covariate_unit(text) or text in _NO_UNIT else None


def _are_units(row: Sequence[str]) -> bool:
    """Whether every filled cell of a row is a unit; in brackets it may be an unknown one."""
    cells = _filled(row)
    known = [bool(_unit_in_cell(cell)) for cell in cells]
    bracketed = [cell[0] in "[(" and cell[-1] in "])" and parse_number(cell[1:-1]) is None for cell in cells]
    ways = all(way(cell) is not None for cell in cells)
    return not ways and (any(known) or all(bracketed)) and all(k or b for k, b in zip(known, bracketed, strict=True))


def _is_position(name: str) -> bool:
    return split_name(name).word in FIELDS["position"]


def _numbers_runs(row: Sequence[str], below: Sequence[str]) -> bool:
    """Whether a header names the positions, and every other column by the number of its run alone."""
    return _is_position(row[0]) and parse_number(below[0]) is not None and all(c.isdigit() for c in _filled(row[1:]))


def _joined_names(grid: CellGrid, k: int) -> tuple[int, list[str]]:
    """Return the first row of names above row k, and the names: a name above several columns belongs to each of them."""
    names = [name.lstrip("#% ") if n == 0 else name for n, name in enumerate(grid.rows[k])]
    below = grid.rows[k + 1 : k + 3]
    while names and not names[-1] and all(row[len(names) - 1 : len(names)] == [""] for row in below):
        names.pop()
    top = k
    while top > 0 and grid.lines[top] == grid.lines[top - 1] + 1:
        other = names[1:]
        bare = all(way(name) is not None or name.isdigit() or _unit_in_cell(name) for name in other)
        if all(names) and len(set(other)) == len(other) and not bare:
            break  # the names give the run of a column
        over, last = grid.rows[top - 1], ""
        group = _filled(over[1:])  # runs, directions or deviations, which several columns have in common
        if not group or _has_number(over[:1]) or not all(is_known_name(cell) or motion_in(cell) for cell in group):
            break
        top -= 1
        for n in range(1, max(len(names), len(over))):
            cell = over[n] if n < len(over) else ""
            last = cell or last
            own = names[n] if n < len(names) else ""
            alone = not cell and (statistic_in(own) is not None or split_name(own).word in _ALL_WORDS)
            joined = own if alone or own == last else f"{last} {own}".strip()
            names[n:] = [joined, *names[n + 1 :]]
        if over[0] and not (names[0] and _unit_in_cell(names[0]) is None):
            names[0] = f"{over[0]} {names[0]}".strip()
    while names and not names[-1]:
        names.pop()
    return top, names


def _across(grid: CellGrid, k: int) -> _Layout | None:
    """Return the table of which row k is the first and whose targets go across, a row for each run; None if there is none."""
    row = grid.rows[k]
    labels = next((n for n, cell in enumerate(row) if parse_number(cell) is not None), 0)
    numbers = [parse_number(cell) for cell in row[labels:] if cell]
    if not labels or len(numbers) < 2 or None in numbers[:2] or not row[0] or _is_comment(row):
        return None
    end = k + 1
    while end < len(grid.rows) and grid.lines[end] == grid.lines[end - 1] + 1:
        below = grid.rows[end]  # a run has a label and then numbers
        if not _filled(below[:labels]) or not _has_number(below[labels:]) or _is_comment(below):
            break
        end += 1
    cells = grid.rows[k:end]
    # the first cells name a row: an empty one of several means the same as above, a bare number a run
    names, last = [], [""] * labels
    for own in cells:
        cut = zip(own[:labels], last, strict=False)
        last = [cell or (above if n < labels - 1 else "") for n, (cell, above) in enumerate(cut)]
        parts = [f"run {cell}" if re.fullmatch(r"\d{1,3}(\.0)?", cell) else cell for cell in last]
        names.append(" ".join(part.removesuffix(".0") for part in parts if part))
    count = sum(parse_number(cell) is not None for own in cells for cell in own[labels:])
    if (
        any(_is_position(name) for name in names[:3])
        and len(names) > 1
        and all(parse_number(row[0]) is None for row in cells[1:])
    ):
        return _Layout(k, k, end, tuple(names), count, labels)
    corner = [part for cell in row[:labels] for part in re.split(r"[/\\|]|->", cell)]
    if len(names) < 2 or not any(names_run(part) for part in corner):
        return None
    named = [run_in(name) is not None for name in names[1:]]
    targets = np.array([parse_number(cell) for cell in row[labels:] if cell], dtype=np.float64)
    if not any(named) or not (np.all(np.diff(targets) > 0) or np.all(np.diff(targets) < 0)):
        return None
    unit = next((split_name(part).unit for part in corner if _is_position(split_name(part).name)), None)
    names[0] = f"Position [{unit}]" if unit else "Position"
    return _Layout(k, k, end, tuple(names), count, labels)


def _turned(
    grid: CellGrid, layout: _Layout, metadata: dict[str, str], comments: dict[str, str], decimal: str | None
) -> Table:
    """Return a table with a row for each target, from one with a column for each."""
    names = _single_names(grid, layout.names, grid.lines[layout.first])
    below = grid.rows[layout.first : layout.end]
    width = max(n for row in below for n, cell in enumerate(row, start=1) if cell) - layout.labels
    cells = [[row[layout.labels + n] if layout.labels + n < len(row) else "" for row in below] for n in range(width)]
    lines = [grid.lines[layout.first]] * width
    note = "the targets are columns: each row of the file is a run"
    return _finished(
        replace(grid, notes=(*grid.notes, note)), names, cells, lines, lines[0], metadata, comments, decimal
    )


def _check_no_more_rows(grid: CellGrid, start: int, end: int, least: int = 1) -> None:
    """Refuse ``least`` adjacent rows of readings that do not belong to the table; statistics over the runs are allowed."""
    last, count = 0, 0
    for k in range(start, end):
        row = grid.rows[k]
        label = next(iter(_filled(row)), "")
        readings = sum(parse_number(cell) is not None for cell in row) >= 2 and statistic_in(label) is None
        readings = readings and (parse_number(label) is not None or run_in(label) is not None or _is_position(label))
        count = count + 1 if readings and (not count or k == last + 1) else int(readings)
        last = k
        if count >= least and not _is_summary(grid, k + 1 - count):
            message = "these rows of numbers do not belong to the table: put each table into a separate file or sheet"
            raise grid.fail(message, grid.lines[k + 1 - count])


def holds_readings(grid: CellGrid) -> bool:
    """Whether a sheet holds what looks like data: two rows or more with two numbers, no statistics; or numbers of squareness."""
    counts = [sum(parse_number(cell) is not None for cell in row) for row in grid.rows]
    labels = [next(iter(_filled(row)), "") for row in grid.rows]
    data = [k for k, count in enumerate(counts) if count >= 2 and statistic_in(labels[k]) is None]
    text = " ".join([*grid.notes, *(cell for row in grid.rows for cell in row)])
    return (len(data) >= 2 and not _is_summary(grid, data[0])) or (
        any(counts) and SQUARENESS_WORDS.search(text) is not None
    )


def _is_summary(grid: CellGrid, first: int) -> bool:
    """Whether the rows from ``first`` on are statistics, by the names above them."""
    for k in range(max(0, first - 2), first):
        layout = _down(grid, k)
        if layout is not None and layout.first <= first:
            return all(statistic_in(name) or _is_position(name) or is_index(name) for name in layout.names if name)
    return False


def _note(row: Sequence[str], metadata: dict[str, str], comments: dict[str, str]) -> None:
    """Read a line above a table: ``key = value``, ``key: value``, or a key and its value in the next cells."""
    cells = _filled(row)
    text = cells[0].lstrip("#% ") if cells else ""
    if cells and _is_comment([*cells]) and text.partition("=")[0].strip():
        key, _, value = text.partition("=")
        comments.setdefault(key.strip(), ", ".join(part for part in (value.strip(), *cells[1:]) if part))
        metadata.setdefault(key.strip().lower(), comments[key.strip()])
        return
    pairs = [n for n, cell in enumerate(cells) if cell.endswith(":") and n + 1 < len(cells)]
    if len(pairs) > 1 and pairs[0] == 0:
        for start, end in zip(pairs, [*pairs[1:], len(cells)], strict=True):
            metadata.setdefault(cells[start].rstrip(": ").lower(), " ".join(cells[start + 1 : end]))
        return
    if found := re.search("[=:]", text):  # the first one: "u: 2 um (k = 2)" is about u
        key, value = text[: found.start()], text[found.end() :].strip()
        metadata.setdefault(key.strip().lower(), " ".join([value, *cells[1:]]).strip())
        return
    if 2 <= len(cells) <= _MOST_PAIR:
        metadata.setdefault(text.lower(), " ".join(cells[1:]))
    elif len(cells) == 1:
        metadata.setdefault("title", text) if "title" not in metadata else metadata.setdefault(text.lower(), "")


def _single_names(grid: CellGrid, header: Sequence[str], line: int) -> tuple[str, ...]:
    """Return the names of columns, each only once: those of runs without a number are numbered, others refused."""
    names = [name or f"column {n}" for n, name in enumerate(header, start=1)]
    count = Counter(names)
    seen: Counter[str] = Counter()
    for n, name in enumerate(names):
        found = run_in(name) if count[name] > 1 else None
        if found is not None and found.number == 0:
            seen[name] += 1
            names[n] = f"{name} {seen[name]}"
    doubled = next((name for name, times in Counter(names).items() if times > 1), None)
    if doubled:
        raise grid.fail(f"the header names {shown(doubled)} twice; give each column a different name", line)
    return tuple(names)


def _table(
    grid: CellGrid, layout: _Layout, metadata: dict[str, str], comments: dict[str, str], decimal: str | None
) -> Table:
    line = grid.lines[layout.first - 1 if not _are_units(grid.rows[layout.first - 1]) else layout.first - 2]
    names = _single_names(grid, layout.names, line)
    rows: list[list[str]] = []
    lines: list[int] = []
    notes: list[str] = []  # what is left out: statistics, and remarks below the table
    for k, (row, at) in enumerate(
        zip(grid.rows[layout.first :], grid.lines[layout.first :], strict=True), layout.first
    ):
        if not any(row) or row[0].startswith("#"):
            continue
        if rows and not _as(rows[0], row):
            if at > lines[-1] + 1 + len(notes) or not _has_number(row):
                for other, below in zip(grid.rows[k:], grid.lines[k:], strict=True):
                    again = any(other) and not other[0].startswith("#") and _as(rows[0], other)
                    if again and len(_filled(other)) >= len(names):
                        message = f"rows of numbers follow again, below line {at} where the table ended: put each table into a"
                        raise grid.fail(f"{message} separate file or sheet", below)
                _check_no_more_rows(grid, k, len(grid.rows))
                notes.append(f"line {at} and everything below is not part of the table and was skipped")
                break
            label = next(iter(_filled(row)))
            if statistic_in(label) is not None and parse_number(rows[0][row.index(label)]) is not None:
                notes.append(f"line {at}, {label!r}, is a statistic over the rows and was skipped")
                continue
        rows.append(_fitted(grid, names, row, at))
        lines.append(at)
    if not rows:
        raise grid.fail("has a header but no rows", line)
    return _finished(replace(grid, notes=(*grid.notes, *notes)), names, rows, lines, line, metadata, comments, decimal)


def _finished(
    grid: CellGrid, names: tuple[str, ...], rows: list[list[str]], lines: list[int], header_line: int,
    metadata: dict[str, str], comments: dict[str, str], decimal: str | None,
) -> Table:  # fmt: skip
    """Return the table with decimal points; a file that says how many rows it has must have them."""
    try:
        plain, commas = plain_decimals(rows, lines, decimal)
    except InputError as error:
        raise grid.fail(error.message, error.line) from error
    if commas:
        grid = replace(grid, notes=(*grid.notes, "decimal commas were read as decimal points"))
    declared = comments.pop("rows", None)
    if declared is not None and parse_number(declared) != len(rows):
        raise grid.fail(f"declares {shown(declared)} rows but contains {len(rows)}: is it truncated?")
    return Table(grid, names, header_line, plain, lines, metadata, comments)


def _as(first: Sequence[str], row: Sequence[str]) -> bool:
    """Whether a row has numbers where the first row has them; an empty cell or a spreadsheet error is allowed."""
    numeric = [k for k, cell in enumerate(first) if parse_number(cell) is not None]
    cells = [row[k] if k < len(row) else "" for k in numeric]
    known = [parse_number(cell) is not None for cell in cells]
    return any(known) and all(good or not cell or cell.startswith("#") for good, cell in zip(known, cells, strict=True))


def _fitted(grid: CellGrid, names: Sequence[str], row: Sequence[str], line: int) -> list[str]:
    if _filled(row[len(names) :]):
        hint = ""
        if len(row) >= 2 * len(names) - 1:
            hint = "; decimal commas and commas between columns cannot be distinguished: save with semicolons or points"
        raise grid.fail(f"has {len(row)} cells, the header has {len(names)}{hint}", line)
    cells = row if len(row) == len(names) else [*row[: len(names)], *[""] * (len(names) - len(row))]
    if max(map(len, cells)) > MOST_CELL:
        raise grid.fail(f"a cell has more than {MOST_CELL} characters", line)
    return cells  # type: ignore[return-value]


# Excel workbooks (.xlsx): checked as archives before they are opened, then read row by row without formulas.


#: Limits of the archive: packed, unpacked, and members; a zip bomb is refused before it is unpacked.
MOST_PACKED, MOST_UNPACKED, MOST_MEMBERS = 64 * MEGABYTE, 256 * MEGABYTE, 2_000
#: One sheet, unpacked: about one and a half million cells, half a minute of reading.
MOST_SHEET = 48 * MEGABYTE
#: Unpacked bytes for each packed one, above which a member of more than a megabyte is a bomb; sheets have up to 60.
MOST_RATIO = 300
_FORBIDDEN = (b"<!DOCTYPE", b"<!ENTITY", "<!DOCTYPE".encode("utf-16-le"), "<!DOCTYPE".encode("utf-16-be"))
_BLOCK = 1 << 20
_EMPTY = " (of merged cells only the first is filled; a formula that was never calculated is empty: open and save the workbook)"


def read_sheets(path: Path, name: str | None = None) -> tuple[list[tuple[str, CellGrid]], list[str]]:
    """Return name and cells of every sheet that holds any, and the names of hidden ones, which are left out.

    ``name`` is a sheet to read even if it is hidden. InputError for a file that is not a workbook, or unsafe.

    Cells hold text; numbers have all their digits, whatever the format of the cell shows; formulas have their stored
    value.
    """
    check_size(path, MOST_PACKED)
    _check_archive(path)
    # reads .xlsx in a stream, without Excel; the one well-kept reader of that format; imported here: slow to load
    from openpyxl import load_workbook

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # unknown styles and extensions do not matter
            with closing(load_workbook(path, read_only=True, data_only=True, keep_links=False)) as book:
                sheets = book.worksheets
                hidden = [sheet.title for sheet in sheets if sheet.sheet_state != "visible" and sheet.title != name]
                if len(hidden) == len(sheets):
                    hidden = []
                found = [(sheet.title, _grid(path, sheet)) for sheet in sheets if sheet.title not in hidden]
    except (InputError, MemoryError):
        raise
    except Exception as error:  # a damaged workbook raises any of a dozen exceptions of three packages
        raise InputError(f"is a damaged workbook: {type(error).__name__}: {error}"[:300], file=path) from error
    filled = [(name, grid) for name, grid in found if grid.rows]
    if not filled:
        raise InputError("is a workbook without any filled cell", file=path)
    return filled, hidden


def chosen_sheet(path: Path, sheets: list[tuple[str, CellGrid]], name: str | None) -> tuple[str, CellGrid] | None:
    """Return the sheet given by the user, the only one, or None if there are several."""
    if name is not None:
        for title, grid in sheets:
            if title == name:
                return title, grid
        raise InputError(
            f"has no sheet {shown(name)}; {nearest(name, [title for title, _ in sheets])}", file=path, field="--sheet"
        )
    return sheets[0] if len(sheets) == 1 else None


def _check_archive(path: Path) -> None:
    """Unpack every part once, in blocks, and count: the declared sizes may be wrong."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            names = {member.filename for member in members}
            if "[Content_Types].xml" not in names or not any(name.startswith("xl/") for name in names):
                text = "is a zip archive but not an .xlsx workbook; if it is the backup of a control, unpack it and give its "
                raise InputError(f"{text}files to 'volcomp read', or to run with --active", file=path)
            declared = sum(member.file_size for member in members)
            if len(members) > MOST_MEMBERS or declared > MOST_UNPACKED:
                text = f"unpacks to {declared / MEGABYTE:.0f} MB in {len(members)} parts; at most "
                raise InputError(f"{text}{MOST_UNPACKED / MEGABYTE:.0f} MB in {MOST_MEMBERS} are read", file=path)
            for member in members:
                ratio = member.file_size / max(1, member.compress_size)
                if member.file_size > MEGABYTE and ratio > MOST_RATIO:
                    message = f"{shown(member.filename)} unpacks to {ratio:.0f} times its size"
                    raise InputError(f"{message}: it is not a measurement (a zip bomb?)", file=path)
                if member.filename.startswith("xl/worksheets/") and member.file_size > MOST_SHEET:
                    message = f"has a sheet of {member.file_size / MEGABYTE:.0f} MB unpacked; at most "
                    message += f"{MOST_SHEET / MEGABYTE:.0f} MB are read"
                    raise InputError(
                        f"{message}: save that sheet as CSV, which is read up to a million rows", file=path
                    )
                if not member.filename.endswith((".xml", ".rels", ".vml")):
                    continue
                tail = b""
                with archive.open(member) as stream:
                    while block := stream.read(_BLOCK):
                        seen = (tail + block).upper() if b"<!" in tail + block or b"<\0" in tail + block else b""
                        if any(mark.upper() in seen for mark in _FORBIDDEN):
                            raise InputError(
                                f"{shown(member.filename)} declares XML entities; it is refused", file=path
                            )
                        tail = block[-64:]
    except InputError:
        raise
    except (zipfile.BadZipFile, OSError, ValueError, RuntimeError, NotImplementedError, EOFError) as error:
        raise InputError(f"is a damaged or truncated workbook: {error}", file=path) from error
    except Exception as error:  # zlib.error and the like
        raise InputError(f"is a damaged workbook: {type(error).__name__}", file=path) from error


def _grid(path: Path, sheet: Any) -> CellGrid:
    rows, lines = [], []
    sheet.reset_dimensions()  # the stored size may be wrong
    for number, values in enumerate(sheet.iter_rows(values_only=True), start=1):
        if number > MOST_ROWS:
            raise InputError(f"sheet {shown(sheet.title)} has more than {MOST_ROWS} rows", file=path)
        cells = [_cell(value) for value in values[:MOST_COLUMNS]]
        if any(cells):
            rows.append(cells)
            lines.append(number)
    return CellGrid(path, rows, lines, (f"sheet {shown(sheet.title)}",), _EMPTY)


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, datetime.datetime | datetime.date | datetime.time):
        return value.isoformat()
    return " ".join(str(value).split())
