"""Cells of a table as text or a sheet gives them, and where in them header and rows stand."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from compgen.errors import InputError
from compgen.imports.decimals import plain_decimals
from compgen.imports.source import LARGEST, Text, parse_number, shown

#: The rows of the largest sheet there is.
MOST_ROWS, MOST_COLUMNS, MOST_CELL = 1_048_576, 500, 2_000
#: Cells of a table; each takes some sixty bytes of memory.
MOST_CELLS = 10_000_000
#: So many lines are looked at for the separator, and for the header.
_SAMPLE_LINES, _HEADER_LINES = 200, 200
#: Letters of words that Python takes for numbers (inf, nan), and a comma: a column without them is converted at once.
_NOT_PLAIN = frozenset("infa,")


@dataclass(frozen=True)
class Grid:
    """Rows of cells with their line numbers; how they were read stands in ``notes``, why cells may be empty in ``empty``."""

    path: Path
    rows: Sequence[Sequence[str]]
    lines: Sequence[int]
    notes: tuple[str, ...] = ()
    empty: str = ""

    def fail(self, message: str, line: int | None = None, column: str | None = None) -> InputError:
        """Return the error that points at a row, and a column."""
        return InputError(message, file=self.path, line=line, field=f"column {column}" if column else None)


@dataclass(frozen=True)
class Table:
    """A header and its rows, all of one width; ``metadata`` holds what stands above as ``key: value``."""

    grid: Grid
    header: tuple[str, ...]
    header_line: int
    rows: Sequence[Sequence[str]]
    lines: Sequence[int]
    metadata: dict[str, str] = field(default_factory=dict)

    def column(self, name: str) -> list[str]:
        """Return the cells of a column."""
        k = self.header.index(name)
        return [row[k] for row in self.rows]

    def numbers(self, name: str, *, empty: bool = False) -> list[float]:
        """Return a column as numbers; with ``empty`` an empty cell is nan, else it is an error as any text is."""
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
                raise self.grid.fail(f"{what}; a number is due", line, name)
            found.append(float("nan") if value is None else value)
        return found


def grid_of_text(source: Text) -> Grid:
    """Split a text file into cells: finds the separator, and decimal commas."""
    count = source.text.count("\n")
    if count > MOST_ROWS:
        raise source.fail(f"has {count} lines; at most {MOST_ROWS} are read: thin it out or split it")
    content, numbers = _filled_lines(source.text)
    separator = _separator(content[:_SAMPLE_LINES])
    cells = len(content) * (1 + max((line.count(separator or " ") for line in content[:_SAMPLE_LINES]), default=0))
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
            raise source.fail("a quoted cell runs over a line end; write each row on one line")
    names = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", None: "blanks"}
    notes = [f"columns are separated by {names[separator]}"]
    if source.encoding not in ("utf-8", "utf-8-sig"):
        notes.append(f"is not UTF-8; it was read as {source.encoding}")
    grid = Grid(source.path, rows, numbers, tuple(notes))
    if not source.ended and len(rows) > 2 and len(rows[-1]) < len(rows[-2]):
        raise source.fail("the last line has no line end and fewer cells than the one before: it was cut", numbers[-1])
    return grid


def _filled_lines(text: str) -> tuple[list[str], list[int]]:
    """Return the lines that are not blank, and their numbers from 1."""
    lines = text.split("\n")
    numbers = [k for k, line in enumerate(lines, start=1) if line and not line.isspace()]
    return ([lines[k - 1] for k in numbers] if len(numbers) < len(lines) else lines), numbers


def _separator(lines: Sequence[str]) -> str | None:
    """The mark that stands equally often, and at least once, in most lines; blanks if there is none."""
    best, score = None, 0.0
    for mark in (";", "\t", "|", ","):
        counts = Counter(line.count(mark) for line in lines if mark in line)
        if not counts:
            continue
        number, times = counts.most_common(1)[0]
        share = times / len(lines)
        if number and share > 0.5 and share > score + (0.2 if mark == "," else 0.0):
            best, score = mark, share
    return best


def find_table(grid: Grid, decimal: str | None = None) -> Table:
    """Find header and rows: the first row of names that rows of numbers follow; what stands above is metadata.

    ``decimal`` is the decimal mark, "comma" or "point", if the user says it.

    Raises InputError if there is none, and for a row of another width below the header.
    """
    metadata: dict[str, str] = {}
    for k, row in enumerate(grid.rows[:_HEADER_LINES]):
        if _is_header(grid, k):
            return _table(grid, k, metadata, decimal)
        _note(row, metadata)
    raise grid.fail(
        f"holds no table: a header line with the names of the columns, and rows of numbers below it, are due{grid.empty}"
    )


def _filled(row: Sequence[str]) -> list[str]:
    return [cell for cell in row if cell]


def _is_header(grid: Grid, k: int) -> bool:
    """Whether row k holds names, and numbers stand in the row below, or below a row of units."""
    names = _filled(grid.rows[k])
    below = grid.rows[k + 1 : k + 3]
    if len(names) < 2 or not below or (grid.rows[k][0].startswith("#") and "=" in "".join(grid.rows[k])):
        return False
    words = sum(parse_number(name) is None for name in names)
    if 2 * words < len(names) or len(names) > MOST_COLUMNS:
        return False
    if len(below) == 2 and not _has_number(below[0]):
        return len(_filled(below[0])) <= len(names) and _like(names, below[1], len(names))
    return _like(names, below[0], MOST_COLUMNS)


def _has_number(row: Sequence[str]) -> bool:
    return any(parse_number(cell) is not None for cell in row)


def _like(names: Sequence[str], row: Sequence[str], most: int) -> bool:
    """Whether a row has the width of the header and mostly numbers (names of stations or axes may stand there too).

    A row of about twice the width is let through, up to ``most``: decimal commas between commas, refused further on.
    """
    cells = _filled(row)
    numbers = sum(parse_number(cell) is not None for cell in cells)
    fits = len(names) < 2 * len(cells) and (len(cells) <= len(names) or 2 * len(names) - 1 <= len(cells) <= most)
    return numbers >= 1 and fits and 3 * numbers >= len(cells)


def _note(row: Sequence[str], metadata: dict[str, str]) -> None:
    cells = _filled(row)
    text = cells[0].lstrip("#% ") if cells else ""
    for mark in ("=", ":"):
        if mark in text:
            key, _, value = text.partition(mark)
            metadata.setdefault(key.strip().lower(), (value.strip() or " ".join(cells[1:])).strip())
            return
    if len(cells) == 2:
        metadata.setdefault(text.lower(), cells[1])
    elif len(cells) == 1:
        metadata.setdefault("title", text)


def _table(grid: Grid, k: int, metadata: dict[str, str], decimal: str | None) -> Table:
    header = [name.lstrip("#% ") for name in grid.rows[k]]
    while header and not header[-1]:
        header.pop()
    first = k + 1
    if not _has_number(grid.rows[first]):  # a line of units
        units = [cell.strip("[]() ") for cell in grid.rows[first]]
        header = [f"{name} [{unit}]" if unit else name for name, unit in zip(header, units, strict=False)]
        first += 1
    names = tuple(name or f"column {n}" for n, name in enumerate(header, start=1))
    doubled = next((name for name, times in Counter(names).items() if times > 1), None)
    if doubled:
        raise grid.fail(f"the header names {shown(doubled)} twice; give each column a name of its own", grid.lines[k])
    rows, lines, below = _rows_below(grid, names, first)
    if not rows:
        raise grid.fail("has a header but no rows", grid.lines[k])
    if below:
        grid = replace(
            grid, notes=(*grid.notes, f"what stands from line {below} on is no row of the table and was left out")
        )
    try:
        plain, commas = plain_decimals(rows, lines, decimal)
    except InputError as error:
        raise grid.fail(error.message, error.line) from error
    if commas:
        grid = replace(grid, notes=(*grid.notes, "decimal commas were read as decimal points"))
    return Table(grid, names, grid.lines[k], plain, lines, metadata)


def _rows_below(grid: Grid, names: Sequence[str], first: int) -> tuple[list[list[str]], list[int], int]:
    """Return rows, their lines, and the line (or 0) where remarks below the table begin, after a blank line.

    Raises InputError if rows of numbers follow once more below the remarks: there is a second table.
    """
    rows: list[list[str]] = []
    lines: list[int] = []
    below = 0
    for row, line in zip(grid.rows[first:], grid.lines[first:], strict=True):
        if not any(row) or row[0].startswith("#"):
            continue
        if below or (rows and line > lines[-1] + 1 and not _as(rows[0], row)):
            if below and _as(rows[0], row) and len(_filled(row)) >= len(names):
                message = f"rows of numbers follow again, below line {below} where the table ended: put each table into a file"
                raise grid.fail(f"{message} or sheet of its own", line)
            below = below or line
            continue
        rows.append(_fitted(grid, names, row, line))
        lines.append(line)
    return rows, lines, below


def _as(first: Sequence[str], row: Sequence[str]) -> bool:
    """Whether a row has numbers where the first row has them; an empty cell or the error of a spreadsheet may stand there."""
    numeric = [k for k, cell in enumerate(first) if parse_number(cell) is not None]
    cells = [row[k] if k < len(row) else "" for k in numeric]
    known = [parse_number(cell) is not None for cell in cells]
    return any(known) and all(good or not cell or cell.startswith("#") for good, cell in zip(known, cells, strict=True))


def _fitted(grid: Grid, names: Sequence[str], row: Sequence[str], line: int) -> list[str]:
    if len(row) == len(names):
        if max(map(len, row)) > MOST_CELL:
            raise grid.fail(f"a cell has more than {MOST_CELL} characters", line)
        return row  # type: ignore[return-value]
    if len(_filled(row[len(names) :])):
        hint = ""
        if len(row) >= 2 * len(names) - 1:
            hint = "; decimal commas and commas between columns cannot be told apart: save with semicolons or points"
        raise grid.fail(f"has {len(row)} cells, the header has {len(names)}{hint}", line)
    cells = list(row[: len(names)])
    if any(len(cell) > MOST_CELL for cell in cells):
        raise grid.fail(f"a cell has more than {MOST_CELL} characters", line)
    return cells + [""] * (len(names) - len(cells))
